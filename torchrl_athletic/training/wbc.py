"""What a whole-body controller is trained with, besides its environment."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

from tensordict import NestedKey
from tensordict.nn import TensorDictModuleBase
from torchrl.envs import EnvBase

from torchrl_athletic.networks import RunningNormalizer, actor, critic, write_network
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
"""Of a policy and the entries to store."""


def wbc_learner(
    env: EnvBase,
    config: PPO = PRE_TRAIN,
    *,
    hidden: Sequence[int] = (512, 512, 512),
    scale: float = 0.5,
    seed: int = 0,
    cuda_graph: bool = False,
    collect_by: MakeRollout | None = None,
    processes: Processes = ALONE,
) -> Learner:
    """A new policy that reads ``observation`` and a critic that reads ``privileged``, ready to be trained.

    The policy starts at the default pose. The first episodes start at random ages, so that they do not all end at once.

    Args:
        env: Of :func:`~torchrl_athletic.envs.whole_body_env`, or a task that shows the same entries.
        config: Numbers chosen by hand.
        hidden: Layers of both networks.
        scale: First standard deviation of the actions [1].
        seed: Of the order of samples.
        cuda_graph: Capture control step and update, on a GPU only.
        collect_by: Makes what collects in place of ``env``: a :class:`~.RayRollout`.
        processes: Those that train together.

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
    device = None if env.device is None else str(env.device)
    scales = {
        key: RunningNormalizer(size, device=device) for key, size in (("observation", seen), ("privileged", known))
    }
    width = env.action_spec.shape[-1]
    policy = actor(seen, width, hidden=hidden, scale=scale, gain=0.01, normalizer=scales["observation"], device=device)
    value = critic(known, in_keys=["privileged"], hidden=hidden, normalizer=scales["privileged"], device=device)
    rollout = None if collect_by is None else collect_by(policy, ["privileged", *under_next(WATCHED)])
    learner = Learner(
        env if rollout is None else rollout.env,
        policy,
        value,
        config,
        normalizer=scales,
        watch=WATCHED,
        seed=seed,
        cuda_graph=cuda_graph,
        rollout=rollout,
        processes=processes,
    )
    if rollout is None:
        learner.rollout.current["step_count"].random_(0, _longest_episode(env))
    return learner


def save_wbc(learner: Learner, folder: str | Path, **told: Any) -> Path:
    """Write ``wbc.npz`` and ``wbc_critic.npz``, for :func:`~torchrl_athletic.networks.read_network`.

    Args:
        learner: Of :func:`wbc_learner`.
        folder: Is made.
        told: What else a reader should know, in what JSON can hold.

    Returns:
        Path of the policy.
    """
    folder = Path(folder)
    told |= {"samples": learner.samples, "seconds": learner.seconds}
    write_network(folder / "wbc_critic.npz", learner.critic, **told)
    write_network(folder / "wbc.npz", learner.actor, **told)
    return folder / "wbc.npz"


def _longest_episode(env: Any) -> int:
    """Policy steps."""
    return max([1, *(part.max_steps for part in env.transform if getattr(part, "max_steps", None))])
