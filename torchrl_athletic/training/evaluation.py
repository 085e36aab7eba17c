"""A policy at work, without the noise that it explores with, as numbers."""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np
import torch
from numpy.typing import NDArray
from scipy import stats
from tensordict import NestedKey, TensorDict, TensorDictBase
from torch import Tensor
from torchrl.envs import EnvBase
from torchrl.envs.utils import ExplorationType, set_exploration_type, step_mdp
from tqdm import trange

from torchrl_athletic.training.rollout import Policy, control_step, done_rows


@torch.no_grad()
def play(env: EnvBase, policy: Policy, steps: int) -> TensorDict:
    """Let a policy act by its mean, from new episodes until the first of them ends.

    Args:
        env: N environments.
        policy: Writes the action.
        steps: At most so many.

    Returns:
        Shape (N, T).

    Example:
        >>> from torchrl.envs import GymEnv, SerialEnv
        >>> env = SerialEnv(2, lambda: GymEnv("Pendulum-v1"))
        >>> play(env, env.rand_action, steps=5)["next", "reward"].shape
        torch.Size([2, 5, 1])
    """
    return torch.stack(list(acting(env, policy, steps)), env.ndim)


def acting(env: EnvBase, policy: Policy, steps: int) -> Iterator[TensorDictBase]:
    """The steps of :func:`play`, one by one. Shape (N,)."""
    following = env.reset()
    with set_exploration_type(ExplorationType.DETERMINISTIC):
        for _ in range(steps):
            step = policy(following).copy()
            step.set("next", env._step(step))
            following = step_mdp(
                step,
                exclude_action=True,
                action_keys=env.action_keys,
                reward_keys=env.reward_keys,
                done_keys=env.done_keys,
            )
            yield step
            if done_rows(env, following).any():
                return


@dataclass(frozen=True)
class Episodes:
    """What became of N episodes, each whole."""

    fell: NDArray[np.bool_]
    """Whether it was terminated, rather than came to its time. Shape (N,)."""
    steps: NDArray[np.int64]
    """How long it was [policy steps]. Shape (N,)."""
    means: dict[str, NDArray[np.float64]]
    """Means over its steps of what was looked at, by the name of the entry. Shape (N,) each."""

    def falls(self) -> tuple[float, float, float]:
        """Share that fell, and its 95 % interval (Wilson's) [1]."""
        count, total = int(self.fell.sum()), len(self.fell)
        interval = stats.binomtest(count, total).proportion_ci(method="wilson")
        return count / total, float(interval.low), float(interval.high)

    def mean(self, name: str) -> tuple[float, float, float]:
        """Mean over the episodes of one of :attr:`means`, and its 95 % interval (Student's), in the entry's unit."""
        values = self.means[name]
        half = stats.t.ppf(0.975, max(1, len(values) - 1)) * values.std(ddof=1) / math.sqrt(len(values))
        return float(values.mean()), float(values.mean() - half), float(values.mean() + half)


@torch.no_grad()
def whole_episodes(
    env: EnvBase, policy: Policy, keys: Sequence[NestedKey], steps: int, *, progress: str | None = None
) -> Episodes:
    """Play one episode of each environment to its end, by the policy's mean.

    Each row counts once, from its start until it is done: short episodes, which are the failed ones, are neither more
    nor less often seen than long ones. (To stop at the first end in the batch, as :func:`play` does, would leave the
    falls to come out of the count; to count all episodes of a fixed time would have the fallen start again and again.)

    Args:
        env: N environments.
        policy: Writes the action.
        keys: Entries of one number per row to take the means of.
        steps: The longest episode [policy steps].
        progress: Label of a progress bar; None shows none.

    Example:
        >>> from torchrl.envs import GymEnv, SerialEnv, StepCounter, TransformedEnv
        >>> env = TransformedEnv(SerialEnv(2, lambda: GymEnv("Pendulum-v1")), StepCounter(5))
        >>> episodes = whole_episodes(env, env.rand_action, ["reward"], steps=5)
        >>> episodes.steps.tolist(), episodes.falls()[0]
        ([5, 5], 0.0)
    """
    tensordict = env.reset()
    goes = torch.ones(*env.batch_size, 1, dtype=torch.bool, device=env.device)
    count = torch.zeros(*env.batch_size, 1, dtype=torch.int64, device=env.device)
    fell = torch.zeros_like(goes)
    sums: dict[NestedKey, Tensor] = {}
    with set_exploration_type(ExplorationType.DETERMINISTIC):
        for _ in trange(steps, desc=progress, disable=progress is None):
            step, tensordict = control_step(env, policy, tensordict)
            shown = step.get("next")
            count += goes
            fell |= goes & shown.get("terminated")
            for key in keys:
                value = torch.where(goes, shown.get(key).double().reshape(count.shape), 0.0)
                sums[key] = sums.get(key, 0.0) + value
            goes &= ~done_rows(env, shown)
            if not goes.any():
                break
    means = {_name(key): (total / count).flatten().cpu().numpy() for key, total in sums.items()}
    return Episodes(fell.flatten().cpu().numpy(), count.flatten().cpu().numpy(), means)


@torch.no_grad()
def whole_rollout(
    env: EnvBase, policy: Policy, keys: Sequence[NestedKey], steps: int, *, progress: str | None = None
) -> TensorDict:
    """Play one episode of each environment to its end, by the policy's mean, and keep entries of what was shown.

    Args:
        env: N environments.
        policy: Writes the action.
        keys: Entries to keep.
        steps: The longest episode [policy steps].
        progress: Label of a progress bar; None shows none.

    Returns:
        The entries, ``terminated``, and ``counts``, whether the step belongs to the row's episode, bool (N, T, 1): what
        comes after its end does not. Shape (N, T).

    Example:
        >>> from torchrl.envs import GymEnv, SerialEnv, StepCounter, TransformedEnv
        >>> env = TransformedEnv(SerialEnv(2, lambda: GymEnv("Pendulum-v1")), StepCounter(5))
        >>> whole_rollout(env, env.rand_action, ["observation"], steps=5)["observation"].shape
        torch.Size([2, 5, 3])
    """
    tensordict = env.reset()
    goes = torch.ones(*env.batch_size, 1, dtype=torch.bool, device=env.device)
    kept = []
    with set_exploration_type(ExplorationType.DETERMINISTIC):
        for _ in trange(steps, desc=progress, disable=progress is None):
            step, tensordict = control_step(env, policy, tensordict)
            shown = step.get("next")
            kept.append(shown.select(*keys, "terminated").clone().set("counts", goes.clone()))
            goes &= ~done_rows(env, shown)
            if not goes.any():
                break
    return torch.stack(kept, env.ndim).cpu()


def last_of(episodes: TensorDict, key: NestedKey) -> Tensor:
    """What an entry of :func:`whole_rollout` was when each episode ended. (N, T, ...) to (N, ...).

    Example:
        >>> counts = torch.tensor([[[True], [True], [False]]])
        >>> last_of(TensorDict(counts=counts, x=torch.tensor([[[1.0], [2.0], [9.0]]]), batch_size=[1, 3]), "x")
        tensor([[2.]])
    """
    last = episodes["counts"].squeeze(-1).sum(-1) - 1
    value: Tensor = episodes[key]
    return value[torch.arange(len(value)), last]


def _name(key: NestedKey) -> str:
    return key if isinstance(key, str) else "/".join(key)
