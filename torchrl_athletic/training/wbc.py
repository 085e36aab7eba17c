"""What a whole-body controller is trained with, besides its environment."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any, cast

from tensordict import NestedKey
from tensordict.nn import TensorDictModuleBase
from torch import nn
from torchrl.envs import EnvBase

from torchrl_athletic.functional.commands import CommandName
from torchrl_athletic.networks import (
    RunningNormalizer,
    actor,
    critic,
    read_metadata,
    read_network,
    shipped_path,
    trunk_of,
    write_network,
)
from torchrl_athletic.training.distributed import ALONE, Processes
from torchrl_athletic.training.ppo import PPO, PRE_TRAIN, Learner
from torchrl_athletic.training.rollout import Rollout, under_next

WATCHED = ("reward_terms", "tracking", "terminated")
CURVES = {
    "reward": "reward per step",
    "tracking/position": "hand's position error [m]",
    "tracking/attitude": "hand's attitude error [rad]",
    "tracking/velocity": "velocity error [m/s]",
    "tracking/yaw_rate": "yaw rate error [rad/s]",
    "terminated": "falls per step",
}
"""Columns of ``progress.csv`` that tell how a training goes."""

MakeRollout = Callable[[TensorDictModuleBase, Sequence[NestedKey]], Rollout]
"""Makes a rollout of a policy and the entries to store."""


def wbc_learner(
    env: EnvBase,
    config: PPO = PRE_TRAIN,
    *,
    start: str | Path | None = None,
    hidden: Sequence[int] = (512, 512, 512),
    scale: float = 0.5,
    watch: Sequence[str] = (),
    seed: int = 0,
    cuda_graph: bool = False,
    collect_by: MakeRollout | None = None,
    processes: Processes = ALONE,
) -> Learner:
    """A policy that reads ``observation`` and a critic that reads ``privileged``, ready to be trained.

    A new policy starts at the default pose.

    Args:
        env: Of :func:`~torchrl_athletic.envs.whole_body_env`, or a task that shows the same entries.
        config: Numbers chosen by hand.
        start: A shipped policy, ``"wbc"``, or a file of :func:`save_wbc`, to go on from; None begins anew.
        hidden: Layers of both networks, if they are new.
        scale: First standard deviation of the actions, if they are new [1].
        watch: Entries of a step whose means are reported, beside :data:`WATCHED`.
        seed: Of the order of samples.
        cuda_graph: Capture control step and update, on a GPU only.
        collect_by: Makes what collects in place of ``env``: a :class:`~.RayRollout`.
        processes: Those that train together.

    Raises:
        ValueError: If a network to start from sees or does something else than this environment shows and takes.

    Source:
        Fey et al. 2025, section II-B. Its critic is of the policy's size; what it sees is not said.

    Example:
        >>> from torchrl_athletic.envs import whole_body_env
        >>> learner = wbc_learner(whole_body_env(num_envs=2), PPO(num_envs=2, horizon=4), hidden=(32,))
        >>> learner.actor.in_keys, learner.critic.in_keys
        (['observation'], ['privileged'])
    """
    shown = env.observation_spec
    seen, known = (shown[key].shape[-1] for key in ("observation", "privileged"))
    width = env.action_spec.shape[-1]
    if start is None:
        policy = actor(seen, width, hidden=hidden, scale=scale, gain=0.01, normalizer=RunningNormalizer(seen))
        value = critic(known, in_keys=["privileged"], hidden=hidden, normalizer=RunningNormalizer(known))
    else:
        policy, value = read_wbc(start, trainable=True)
        check_sizes(str(start), {"observation": (policy, seen, width), "privileged": (value, known, 1)})
    policy, value = policy.to(env.device), value.to(env.device)
    scales: dict[NestedKey, Any] = {
        "observation": trunk_of(policy).normalizer,
        "privileged": trunk_of(value).normalizer,
    }
    rollout = None if collect_by is None else collect_by(policy, ["privileged", *under_next((*WATCHED, *watch))])
    return Learner(
        env if rollout is None else rollout.env,
        policy,
        value,
        config,
        normalizer=scales,
        watch=(*WATCHED, *watch),
        seed=seed,
        cuda_graph=cuda_graph,
        rollout=rollout,
        processes=processes,
    )


def save_wbc(learner: Learner, folder: str | Path, name: str = "wbc", **told: Any) -> Path:
    """Write ``wbc.npz`` and ``wbc_critic.npz``, for :func:`~torchrl_athletic.networks.read_network`.

    Args:
        learner: Of :func:`wbc_learner`.
        folder: Is made.
        name: Of the policy, in place of ``wbc``.
        told: What else a reader should know, in what JSON can hold.

    Returns:
        Path of the policy.
    """
    folder = Path(folder)
    told |= {"samples": learner.samples, "seconds": learner.seconds}
    write_network(folder / f"{name}_critic.npz", learner.critic, **told)
    write_network(folder / f"{name}.npz", learner.actor, **told)
    return folder / f"{name}.npz"


def commands_of(start: str | Path | None) -> CommandName:
    """Name of the :func:`~torchrl_athletic.functional.commands.command_ranges` on which a controller was trained.

    Args:
        start: As of :func:`wbc_learner`; a new controller has the ``"box"``, a file that does not say ``"around"``.

    Example:
        >>> commands_of("wbc_wide"), commands_of(None)
        ('around', 'box')
    """
    if start is None:
        return "box"
    told = read_metadata(start if Path(start).suffix else shipped_path(str(start)))
    return cast("CommandName", told.get("commands", "around"))


def read_wbc(name: str | Path, *, trainable: bool = False) -> tuple[Any, Any]:
    """A policy and its critic.

    Args:
        name: A shipped policy, ``"wbc"``, or a file of :func:`save_wbc`; the critic's lies beside it.
        trainable: Whether they shall learn.

    Raises:
        FileNotFoundError: If a file is missing.

    Example:
        >>> policy, value = read_wbc("wbc")
        >>> policy.in_keys, value.in_keys
        (['observation'], ['privileged'])
    """
    path = Path(name) if Path(name).suffix else shipped_path(str(name))
    beside = path.with_name(f"{path.stem}_critic{path.suffix}")
    for file in (path, beside):
        if not file.exists():
            complete = sorted(
                f.name.removesuffix("_critic.npz") for f in shipped_path("wbc").parent.glob("*_critic.npz")
            )
            raise FileNotFoundError(
                f"{file} is missing: a policy goes on with its critic, {path.name} and {beside.name}. "
                f"Of the shipped ones {', '.join(complete)} have theirs."
            )
    return read_network(path, trainable=trainable), read_network(beside, trainable=trainable)


def check_sizes(start: str, wanted: Mapping[str, tuple[Any, int, int]]) -> None:
    """Make sure that networks take in and give what an environment shows and takes.

    Args:
        start: Where they come from.
        wanted: By the entry that it reads, a network, and how many numbers it shall take in and give.

    Raises:
        ValueError: If one has other sizes.
    """
    for key, (network, seen, made) in wanted.items():
        layers = [layer for layer in trunk_of(network).mlp if isinstance(layer, nn.Linear)]
        if (layers[0].in_features, layers[-1].out_features) != (seen, made):
            raise ValueError(
                f"{start} makes {layers[-1].out_features} numbers of {layers[0].in_features} of {key!r}, asked is "
                f"for {made} of {seen}. Give both the same robot, history and randomisation, or begin anew."
            )
