"""Collecting on a GPU with one CUDA graph for everything between two actions."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any

import torch
from tensordict import NestedKey, TensorDict, TensorDictBase
from torchrl.envs import Compose, EnvBase, Transform, TransformedEnv
from torchrl.envs.utils import ExplorationType, set_exploration_type

from torchrl_athletic.training.checkpoint import env_state, restore_env
from torchrl_athletic.training.rollout import Policy, Rollout, control_step
from torchrl_athletic.transforms import Decimation
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
        fuse: Compile what surrounds the physics before it is recorded (:func:`fuse_transforms`), which takes a minute.

    Raises:
        ValueError: If the environment has no physics that can be captured.

    Example:
        >>> from torchrl_athletic.envs import TorqueEnv
        >>> from torchrl_athletic.robots import z1
        >>> env = TorqueEnv(z1(), num_envs=2)  # device="cuda" on a GPU
        >>> CapturedRollout(env, env.rand_action, horizon=3)()["next", "joint_position"].shape
        torch.Size([2, 3, 7])
    """

    def __init__(
        self,
        env: EnvBase,
        policy: Policy,
        horizon: int,
        *,
        keys: Sequence[NestedKey] | None = None,
        fuse: bool = True,
    ) -> None:
        super().__init__(env, policy, horizon, keys=keys)
        physics = getattr(base_env_of(env), "physics", None)
        if physics is None:
            raise ValueError(
                f"{type(base_env_of(env)).__name__} has no physics of this library, so nobody knows how to record it. "
                "Collect with Rollout."
            )
        self.physics, self.fuse = physics, fuse
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

    def load_state_dict(self, state_dict: dict[str, Any]) -> None:
        """Go on from there. What was recorded reads the memory that it was recorded with, so that is written to."""
        recorded = self.current
        super().load_state_dict(state_dict)
        if self._replay is not None:
            self.current = recorded.update_(self.current.select(*recorded.keys(True, True)))

    def _record(self) -> Callable[[], None]:
        if self.fuse:
            fuse_transforms(self.env)
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
        keys = list(self.current.keys(True, True))
        torch._foreach_copy_([self.current.get(key) for key in keys], [following.get(key) for key in keys])
        self._time.add_(1).remainder_(self.horizon)


_OF_PHYSICS = (
    "reset",
    "step",
    "apply_torque",
    "apply_wrench",
    "set_field",
    "set_fields",
    "raise_up",
    "forward",
    "data",
    "field",
)
"""What a compiler must not look into."""


def fuse_transforms(env: EnvBase, backend: str = "inductor") -> None:
    """Compile an environment's transforms, so that hundreds of small kernels become a few.

    Changes the environment: from now on the chain of actions, what follows the physics, and the resets of all
    transforms run compiled. Numbers differ by rounding.

    Args:
        env: With a :class:`~torchrl_athletic.transforms.Decimation`; others stay as they are.
        backend: Of :func:`torch.compile`.
    """
    if not isinstance(env, TransformedEnv) or not isinstance(env.transform, Compose):
        return
    place = _place_of_decimation(env.transform)
    if place is None:
        return
    outer, decimation = env.transform, place[-1]
    split = 1 + next(k for k, item in enumerate(outer.transforms) if item is place[0])
    inside, outside = list(outer.transforms)[:split], list(outer.transforms)[split:]

    def after(tensordict: TensorDictBase, next_tensordict: TensorDictBase) -> TensorDictBase:
        for transform in outside:
            next_tensordict = transform._step(tensordict, next_tensordict)
        return next_tensordict

    compiled_after = torch.compile(after, backend=backend, dynamic=False)

    def step(tensordict: TensorDictBase, next_tensordict: TensorDictBase) -> TensorDictBase:
        for transform in inside:  # holds the physics
            next_tensordict = transform._step(tensordict, next_tensordict)
        return compiled_after(tensordict, next_tensordict)

    state = env_state(env)
    control_step(env, env.rand_action, env.reset())  # fills caches that cannot be filled while compiling
    restore_env(env, TensorDict(batch_size=env.batch_size), state)
    physics = getattr(base_env_of(env), "physics", None)
    for name in _OF_PHYSICS:
        if physics is not None:
            setattr(physics, name, torch.compiler.disable(getattr(physics, name)))
    chain = decimation.parent.transform
    outer._step = step
    outer._inv_call = torch.compile(outer._inv_call, backend=backend, dynamic=False)
    outer._reset = torch.compile(outer._reset, backend=backend, dynamic=False)
    chain._inv_call = torch.compile(chain._inv_call, backend=backend, dynamic=False)
    decimation.merge = torch.compile(decimation.merge, backend=backend, dynamic=False)


def _place_of_decimation(compose: Compose) -> list[Transform] | None:
    """The transforms, one within the other, that lead to it."""
    for transform in compose.transforms:
        if isinstance(transform, Decimation):
            return [transform]
        if isinstance(transform, Compose) and (found := _place_of_decimation(transform)):
            return [transform, *found]
    return None
