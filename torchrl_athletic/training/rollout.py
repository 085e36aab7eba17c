"""Collecting experience: what TorchRL's collector gives, at the cost of the environment's own step."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any

import torch
from tensordict import NestedKey, TensorDict, TensorDictBase
from tensordict.nn import TensorDictModuleBase
from torch import Tensor
from torchrl.collectors import Collector
from torchrl.envs import EnvBase
from torchrl.envs.utils import ExplorationType, set_exploration_type, step_mdp

from torchrl_athletic.training.checkpoint import env_state, restore_env
from torchrl_athletic.transforms.stateful import spread

Policy = Callable[[TensorDictBase], TensorDictBase]


def control_step(env: EnvBase, policy: Policy, tensordict: TensorDictBase) -> tuple[TensorDictBase, TensorDictBase]:
    """Let the policy act once, and start anew the rows that are done.

    It does what ``env.step_and_maybe_reset(policy(tensordict))`` does, without the checks of specs and, on a GPU,
    without a look at values: shapes never change there and rows are merged by ``torch.where``, so that the whole step
    can be captured in a CUDA graph.

    Args:
        env: With one flag ``done`` per row, at the root.
        policy: Writes the action.
        tensordict: What the policy sees. Shape (N,).

    Returns:
        The step, with what it led to under ``next``, the true last observation of an episode included; and what the
        policy sees next, where rows that were done have started anew. Shape (N,) each.

    Example:
        >>> from torchrl.envs import GymEnv
        >>> env = GymEnv("Pendulum-v1")
        >>> step, following = control_step(env, env.rand_action, env.reset())
        >>> bool((step["next", "observation"] == following["observation"]).all())
        True
    """
    tensordict = policy(tensordict.copy())
    shown = env._step(tensordict)
    tensordict.set("next", shown)
    following = step_mdp(
        tensordict,
        exclude_action=True,
        action_keys=env.action_keys,
        reward_keys=env.reward_keys,
        done_keys=env.done_keys,
    )
    return tensordict, start_anew(env, following)


def start_anew(env: EnvBase, tensordict: TensorDictBase) -> TensorDictBase:
    """Reset the rows that are done, the others going on. Shape (N,)."""
    starts = done_rows(env, tensordict)
    if _on_host(starts) and not starts.any():
        return tensordict
    reset = TensorDict({reset_key_of(env): starts}, batch_size=env.batch_size, device=env.device)
    fresh = env._reset(reset)
    for key in fresh.keys(include_nested=True, leaves_only=True):
        value, old = fresh.get(key), tensordict.get(key, None)
        tensordict.set(key, value if old is None else torch.where(spread(starts, value), value, old))
    return tensordict.exclude(*reset.keys())


def done_rows(env: EnvBase, tensordict: TensorDictBase) -> Tensor:
    """Rows at their end by any of the environment's flags, bool. Shape (N, 1)."""
    flag, *others = (tensordict.get(key) for key in env.done_keys)
    for other in others:
        flag = flag | other
    return flag


def _on_host(tensor: Tensor) -> bool:
    """Whether values may be looked at: on a device a look would wait for it, and end a capture."""
    return tensor.device.type == "cpu"


def reset_key_of(env: EnvBase) -> NestedKey:
    """Where the environment looks for rows to reset.

    Raises:
        ValueError: If it has several such places.
    """
    keys = env.reset_keys
    if len(keys) != 1 or keys[0] != "_reset":
        raise ValueError(
            f"this environment ends episodes by {keys}, but the lean loop knows one flag per row, at the root. Collect "
            "with TorchRL's own collector: Rollout(..., collector=True)."
        )
    return keys[0]


class Rollout:
    """Collects the next ``horizon`` steps of every environment each time it is called.

    Episodes go on from one call to the next. The batch is that of TorchRL's ``Collector`` for the same seed, entry by
    entry, but only with the entries that are asked for: the memory of transforms (error histories, action queues) is
    carried from step to step but not stored. Storage is allocated once: the next call overwrites the batch.

    Args:
        env: N environments.
        policy: Writes the action; explores.
        horizon: Steps T per call.
        keys: Entries of the environment to store, here and under ``next``, or there alone if they begin so. What the
            policy reads and writes, rewards and flags are stored in any case. None stores everything.
        collector: Take TorchRL's ``Collector``: slower, and for environments with several flags per row.
        step: In place of :func:`control_step`, a captured one for example.

    Example:
        >>> from torchrl.envs import GymEnv, SerialEnv
        >>> env = SerialEnv(2, lambda: GymEnv("Pendulum-v1"))
        >>> Rollout(env, env.rand_action, horizon=5, keys=["observation"])()["next", "observation"].shape
        torch.Size([2, 5, 3])
    """

    def __init__(
        self,
        env: EnvBase,
        policy: Policy,
        horizon: int,
        *,
        keys: Sequence[NestedKey] | None = None,
        collector: bool = False,
        step: Callable[[TensorDictBase], tuple[TensorDictBase, TensorDictBase]] | None = None,
    ) -> None:
        check_horizon(horizon)
        self.env, self.policy, self.horizon, self.keys = env, policy, horizon, keys
        self.num_envs = env.numel()
        self._step = step or (lambda tensordict: control_step(env, policy, tensordict))
        self._storage: list[tuple[NestedKey, Tensor]] = []
        self._collector = None
        if collector:
            self._collector = Collector(
                env, policy, frames_per_batch=horizon * env.numel(), total_frames=-1, track_traj_ids=False
            )
            self._batches = iter(self._collector)
            return
        reset_key_of(env)
        if env.ndim != 1:
            raise ValueError(
                f"the environment has batch size {tuple(env.batch_size)}, but the lean loop takes one dimension of "
                "rows. Put a single environment into SerialEnv(1, ...), or collect with TorchRL's own collector: "
                "Rollout(..., collector=True)."
            )
        self.current = env.reset()
        """What the policy sees next. Shape (N,)."""

    @torch.no_grad()
    def __call__(self) -> TensorDict:
        """Collect. Shape (N, T), whose second dimension is called time."""
        if self._collector is not None:
            return self._select(next(self._batches))
        with set_exploration_type(ExplorationType.RANDOM):
            for time in range(self.horizon):
                step, self.current = self._step(self.current)
                if not self._storage:
                    self._allocate(step)
                for key, buffer in self._storage:
                    buffer[:, time] = step.get(key)
        return self._batch()

    def state_dict(self) -> dict[str, Any]:
        """Where the episodes stand; empty with TorchRL's collector, which starts new ones."""
        if self._collector is not None:
            return {}
        return {"current": self.current.clone().to_dict(), "env": env_state(self.env)}

    def load_state_dict(self, state_dict: dict[str, Any]) -> None:
        """Go on from there, or with new episodes where :func:`~.checkpoint.restore_env` cannot."""
        if self._collector is None and "current" in state_dict:
            current = TensorDict(state_dict["current"], device=self.env.device).auto_batch_size_(self.env.ndim)
            self.current = restore_env(self.env, current, state_dict["env"])

    def _allocate(self, step: TensorDictBase) -> None:
        kept = self._select(step)
        for key in kept.keys(include_nested=True, leaves_only=True):
            value = kept.get(key)
            size = (value.shape[0], self.horizon, *value.shape[1:])
            self._storage.append((key, torch.empty(size, dtype=value.dtype, device=value.device)))

    def _batch(self) -> TensorDict:
        size = (self.env.batch_size[0], self.horizon)
        batch = TensorDict({}, size, device=self.env.device, names=[None, "time"])
        for key, buffer in self._storage:
            batch.set(key, buffer)
        return batch

    def _select(self, tensordict: TensorDictBase) -> TensorDictBase:
        if self.keys is None:
            return tensordict
        return tensordict.select(*kept_keys(self.env, self.policy, self.keys), strict=False)


def check_horizon(horizon: int) -> None:
    """Make sure that there is something to collect."""
    if horizon < 1:
        raise ValueError(f"horizon is {horizon}, needed is at least 1 step: an empty batch would teach nothing.")


def kept_keys(env: EnvBase, policy: Policy, keys: Sequence[NestedKey]) -> list[NestedKey]:
    """What is stored of a step if ``keys`` are asked for; some need not be there."""
    of_next = [key for key in keys if _path(key)[0] == "next"]
    shown = [*(key for key in keys if key not in of_next), *env.done_keys]
    acted = [*policy.in_keys, *policy.out_keys] if isinstance(policy, TensorDictModuleBase) else env.action_keys
    return [*shown, *acted, *of_next, *under_next([*shown, *env.reward_keys])]


def under_next(keys: Sequence[NestedKey]) -> list[NestedKey]:
    """Entries of what a step led to."""
    return [("next", *_path(key)) for key in keys]


def _path(key: NestedKey) -> tuple[str, ...]:
    return (key,) if isinstance(key, str) else key
