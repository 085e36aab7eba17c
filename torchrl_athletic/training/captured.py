"""Collecting on a GPU with one CUDA graph for everything between two actions."""

from __future__ import annotations

import itertools
from collections.abc import Callable, Sequence
from functools import partial
from typing import Any

import torch
from tensordict import NestedKey, TensorDict, TensorDictBase
from torchrl.envs import Compose, EnvBase, StepCounter, Transform, TransformedEnv
from torchrl.envs.utils import ExplorationType, set_exploration_type

from torchrl_athletic.training.checkpoint import env_state, restore_env
from torchrl_athletic.training.rollout import Policy, Rollout, control_step
from torchrl_athletic.transforms import AddedMass, Decimation, DomainRandomization, ExternalPush, SledRope
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
        physics = getattr(base_env_of(env), "physics", None)
        if physics is None:
            raise ValueError(
                f"{type(base_env_of(env)).__name__} has no physics of this library, so nobody knows how to record it. "
                "Collect with Rollout."
            )
        super().__init__(env, policy, horizon, keys=keys)
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
        before, state = self.current.clone(), env_state(self.env)
        replay: Callable[[], None] = self.physics.capture(self._advance)
        self.current.update_(restore_env(self.env, before, state))  # as if the warm-up had not been
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
_NOT_COMPILED = (AddedMass, DomainRandomization, ExternalPush, SledRope)
"""They write to the physics. TorchRL's StepCounter looks up specs in its reset, which cannot be traced either."""


def fuse_transforms(env: EnvBase, backend: str = "inductor") -> None:
    """Compile an environment's transforms, so that hundreds of small kernels become a few.

    Changes the environment: from now on the chain of actions, what follows the physics, and the resets of all
    transforms run compiled, in groups between those that write to the physics. Numbers differ by rounding.

    Args:
        env: With a :class:`~torchrl_athletic.transforms.Decimation`; others stay as they are.
        backend: Of :func:`torch.compile`.
    """
    if not isinstance(env, TransformedEnv) or not isinstance(env.transform, Compose):
        return
    place = _place_of_decimation(env.transform)
    if place is None:
        return
    compiled = partial(torch.compile, backend=backend, dynamic=False)
    outer, decimation = env.transform, place[-1]
    split = 1 + next(k for k, item in enumerate(outer.transforms) if item is place[0])
    inside, outside = list(outer.transforms)[:split], list(outer.transforms)[split:]

    state = env_state(env)
    control_step(env, env.rand_action, env.reset())  # fills caches that cannot be filled while compiling
    restore_env(env, TensorDict(batch_size=env.batch_size), state)
    base = base_env_of(env)
    physics = getattr(base, "physics", None)
    for name in _OF_PHYSICS:
        if physics is not None:
            setattr(physics, name, torch.compiler.disable(getattr(physics, name)))
    for name in ("heights", "clearance"):
        if hasattr(base, name):
            setattr(base, name, compiled(getattr(base, name)))
    for transform in outside:
        if isinstance(transform, DomainRandomization):
            for name in ("draw", "values_of"):
                setattr(transform, name, compiled(getattr(transform, name)))

    after = _in_groups(outside, "_step", compiled)

    def step(tensordict: TensorDictBase, next_tensordict: TensorDictBase) -> TensorDictBase:
        for transform in inside:  # holds the physics
            next_tensordict = transform._step(tensordict, next_tensordict)
        return after(tensordict, next_tensordict)

    chain = decimation.parent.transform
    outer._step = step
    outer._inv_call = _in_groups([*reversed(outside), *reversed(inside)], "_inv_call", compiled)
    outer._reset = _in_groups([*inside, *outside], "_reset", compiled)
    outer._reset_env_preprocess = compiled(outer._reset_env_preprocess)
    chain._inv_call = _in_groups([*reversed(list(chain.transforms))], "_inv_call", compiled)
    decimation.merge = compiled(decimation.merge)


def _in_groups(
    transforms: Sequence[Transform], method: str, compiled: Callable[..., Any]
) -> Callable[..., TensorDictBase]:
    """A method of transforms one after the other, each changing the last argument; neighbours are compiled as one."""

    def of(group: list[Transform]) -> Callable[..., TensorDictBase]:
        def run(*tensordicts: TensorDictBase) -> TensorDictBase:
            *before, changed = tensordicts
            for transform in group:
                changed = getattr(transform, method)(*before, changed)
            return changed

        # Code of its own: a compiler gives up on code of which it has seen many kinds.
        run.__code__ = run.__code__.replace(co_name=f"{method}_from_{type(group[0]).__name__}")
        return run

    def stays(transform: Transform) -> bool:
        return isinstance(transform, _NOT_COMPILED) or (method == "_reset" and isinstance(transform, StepCounter))

    groups = [(apart, list(group)) for apart, group in itertools.groupby(transforms, stays)]
    steps = [of(group) if apart else compiled(of(group)) for apart, group in groups]

    def run_all(*tensordicts: TensorDictBase) -> TensorDictBase:
        *before, changed = tensordicts
        for step in steps:
            changed = step(*before, changed)
        return changed

    return run_all


def _place_of_decimation(compose: Compose) -> list[Transform] | None:
    """The transforms, one within the other, that lead to it."""
    for transform in compose.transforms:
        if isinstance(transform, Decimation):
            return [transform]
        if isinstance(transform, Compose) and (found := _place_of_decimation(transform)):
            return [transform, *found]
    return None
