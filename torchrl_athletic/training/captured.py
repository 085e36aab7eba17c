"""Collecting on a GPU with one CUDA graph for everything between two actions."""

from __future__ import annotations

from collections.abc import Callable, Sequence

import torch
from tensordict import NestedKey, TensorDict
from torchrl.envs import EnvBase
from torchrl.envs.utils import ExplorationType, set_exploration_type

from torchrl_athletic.training.rollout import Policy, Rollout, control_step
from torchrl_athletic.transforms.stateful import base_env_of


class CapturedRollout(Rollout):
    """A :class:`~.Rollout` whose step is a CUDA graph: policy, chain, physics, rewards, resets and storage.

    A GPU does such a step in milliseconds, but takes several times as long to be told of its hundreds of small kernels
    one by one. The first call runs a few steps to load every kernel, records one, and goes on from where the episodes
    stood before. On the CPU it collects as :class:`~.Rollout` does.

    The graph holds on to tensors: parameters of the policy may change in place, as optimisers do, not be replaced. A
    policy whose distribution validates its arguments waits for the GPU and cannot be recorded: give it
    ``distribution_kwargs={"validate_args": False}``.

    Args:
        env: On a :class:`~torchrl_athletic.envs.TorqueEnv`.
        policy: As of :class:`~.Rollout`.
        horizon: As of :class:`~.Rollout`.
        keys: As of :class:`~.Rollout`.

    Raises:
        ValueError: If the environment has no physics that can be captured.

    Example:
        >>> from torchrl_athletic.envs import TorqueEnv
        >>> from torchrl_athletic.robots import z1
        >>> env = TorqueEnv(z1(), num_envs=2)  # device="cuda" on a GPU
        >>> CapturedRollout(env, env.rand_action, horizon=3)()["next", "joint_position"].shape
        torch.Size([2, 3, 7])
    """

    def __init__(self, env: EnvBase, policy: Policy, horizon: int, *, keys: Sequence[NestedKey] | None = None) -> None:
        super().__init__(env, policy, horizon, keys=keys)
        physics = getattr(base_env_of(env), "physics", None)
        if physics is None:
            raise ValueError(
                f"{type(base_env_of(env)).__name__} has no physics of this library, so nobody knows how to record it. "
                "Collect with Rollout."
            )
        self.physics = physics
        self._replay: Callable[[], None] | None = None
        self._time = torch.zeros(1, dtype=torch.int64, device=env.device)

    @torch.no_grad()
    def __call__(self) -> TensorDict:
        """Collect. Shape (N, T), whose second dimension is called time."""
        if self.physics.device.type == "cpu":
            return super().__call__()
        with set_exploration_type(ExplorationType.RANDOM):
            replay = self._replay = self._replay or self._record()
            self._time.zero_()
            for _ in range(self.horizon):
                replay()
        return self._batch()

    def _record(self) -> Callable[[], None]:
        self.current = self.current.clone()  # memory of its own, which the graph reads and writes
        before = self.current.clone()
        replay: Callable[[], None] = self.physics.capture(self._advance)  # puts the physics back
        self.current.update_(before)
        return replay

    def _advance(self) -> None:
        step, following = control_step(self.env, self.policy, self.current)
        if not self._storage:
            self._allocate(step)
        for key, buffer in self._storage:
            buffer.index_copy_(1, self._time, step.get(key).unsqueeze(1))
        self.current.update_(following.select(*self.current.keys(True, True)))
        self._time.add_(1).remainder_(self.horizon)
