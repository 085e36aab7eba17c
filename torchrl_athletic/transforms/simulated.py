"""For transforms that act on the simulation behind the environment, without knowing which one runs it."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, TypeVar

from torchrl.envs import Transform

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
