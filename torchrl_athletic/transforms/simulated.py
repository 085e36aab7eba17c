"""For transforms that act on the simulation behind the environment, without knowing which one runs it."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from typing import Any, TypeVar

from torchrl.envs import Transform, TransformedEnv

from torchrl_athletic.transforms.stateful import base_env_of

Result = TypeVar("Result")


def simulated_env(transform: Transform) -> Any:
    """The environment under all transforms, whose ``physics`` follows :class:`~torchrl_athletic.physics.Physics`.

    Raises:
        ValueError: If it has none.
    """
    env = base_env_of(transform.parent)
    if getattr(env, "physics", None) is None:
        raise ValueError(
            f"{type(transform).__name__} acts on a simulation through env.physics, which {type(env).__name__} lacks. "
            "Put it on a TorqueEnv."
        )
    return env


def once_per_model(transform: Transform, make: Callable[[Any], Result]) -> Result:
    """What ``make(env)`` gives, made once for each model: a look into the model is a copy to its device.

    Example:
        >>> from torchrl_athletic.envs import TorqueEnv
        >>> from torchrl_athletic.robots import z1
        >>> from torchrl_athletic.transforms import InitialState
        >>> from torchrl.envs import TransformedEnv
        >>> env = TransformedEnv(TorqueEnv(z1()), InitialState())
        >>> once_per_model(env.transform, lambda base: base.physics.model.nu)
        7
    """
    env = simulated_env(transform)
    held = transform.__dict__.get("_per_model")
    if held is None or held[0] is not env.physics.model:
        held = transform.__dict__["_per_model"] = (env.physics.model, make(env))
    return held[1]


def refuse_undeclared(transform: Transform, fields: Sequence[str], mend: str) -> None:
    """Raise unless each env has values of its own for these fields of the model.

    Args:
        transform: That writes them.
        fields: By name.
        mend: What to do about it.
    """
    physics = getattr(base_env_of(transform.parent), "physics", None)
    declared = () if physics is None else physics.fields
    if missing := [field for field in fields if field not in declared]:
        raise ValueError(
            f"{type(transform).__name__} writes the model's fields {list(fields)}, but all rows of the environment "
            f"share {missing}. {mend}"
        )


def refuse_undoing(transform: Transform, rows: Mapping[str, set[int]]) -> None:
    """Raise if a transform before this one writes the same of the model: each of these has a method ``written``.

    Args:
        transform: That writes.
        rows: Of each field, by its name: what ``transform.written()`` gives.
    """
    parent = transform.parent
    earlier = parent.transform.modules() if isinstance(parent, TransformedEnv) else ()
    for other in (part for part in earlier if hasattr(part, "written")):
        twice = [name for name, written in other.written().items() if written & rows.get(name, set())]
        if twice:
            names = type(other).__name__, type(transform).__name__
            who = f"two {names[0]}" if names[0] == names[1] else " and ".join(names)
            raise ValueError(
                f"{who} write {twice} of the same bodies, geoms or joints: the later one would undo the other. Give "
                "them other bodies and joints, or set these ranges of a DomainRandomization to None."
            )
