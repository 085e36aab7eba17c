"""Shoves at parts of the robot, at times it cannot foresee."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import torch
from tensordict import NestedKey, TensorDictBase
from torch import Tensor
from torchrl.data import Composite, TensorSpec, Unbounded

from torchrl_athletic.functional import randomization, streams
from torchrl_athletic.transforms.keys import beside
from torchrl_athletic.transforms.simulated import once_per_model, simulated_env
from torchrl_athletic.transforms.stateful import RandomTransform


@dataclass(frozen=True)
class Push:
    """Bodies that are pushed alike."""

    bodies: tuple[str, ...]
    """Names in the model, all equally likely."""
    force: tuple[float, float] = (0.0, 50.0)
    """Least and greatest force at the centre of mass, in any direction [N]."""
    torque: tuple[float, float] = (0.0, 5.0)
    """Least and greatest torque, about any axis [N·m]."""

    def __post_init__(self) -> None:
        for name in ("force", "torque"):
            low, high = getattr(self, name)
            if not 0 <= low <= high:
                raise ValueError(f"{name} is {(low, high)}, a magnitude: give 0 <= least <= greatest.")
        if not self.bodies:
            raise ValueError("a push names no bodies. Name at least one.")


B2Z1_PUSHES = (
    Push(("base",), force=(0.0, 200.0), torque=(0.0, 40.0)),
    Push(("FR_hip", "FL_hip", "RR_hip", "RL_hip"), force=(0.0, 60.0), torque=(0.0, 10.0)),
    Push(("FR_calf", "FL_calf", "RR_calf", "RL_calf"), force=(0.0, 40.0), torque=(0.0, 5.0)),
    Push(("link06",), force=(0.0, 30.0), torque=(0.0, 3.0)),
)
"""Base, hips, feet (which are part of the calves) and end effector of the B2 with a Z1. The paper states the places,
not the sizes: these are ours, about a third of the robot's weight at the base and less further out."""


class ExternalPush(RandomTransform):
    """Push one body at a time, for a while, then leave the robot alone for a while, and so on.

    A push is drawn after a step and acts from the next one on: a force and a torque in world axes, constant until it
    ends. It is added to what else acts on a body (:meth:`~torchrl_athletic.envs.TorqueEnv.set_wrench`). Two of these
    transforms in one environment need two keys.

    Args:
        pushes: Where, and how hard. Each group of bodies is equally likely.
        dt: Time from one step of this transform to the next [s]: the policy's period after :class:`~.Decimation` in
            Compose, the physics' time step before it.
        rest: Least and greatest time without a push [s]; an episode starts within one.
        duration: Least and greatest time of a push [s].
        push_key: Where to show the present push, for the critic: force [N] and torque [N·m] at each of the bodies in
            their order. Shape (*B, bodies, 6).
        seed: Of the draws.
        first_row: As of :class:`RandomTransform`.
        reset_key: As of :class:`StatefulTransform`.

    Raises:
        ValueError: If times are shorter than nothing; on an environment without such bodies or without physics.

    Source:
        Fey et al. 2025, section II-B; Grandia et al. 2024, https://arxiv.org/abs/2501.05204. Times and sizes are ours.

    Example:
        >>> from torchrl_athletic.envs import TorqueEnv
        >>> from torchrl_athletic.robots import z1
        >>> from torchrl.envs import TransformedEnv
        >>> push = ExternalPush([Push(("link06",), force=(5.0, 5.0))], dt=0.005, rest=(0.0, 0.01))
        >>> env = TransformedEnv(TorqueEnv(z1(), num_envs=2), push)
        >>> env.rollout(5)["push"][:, -1, 0, :3].norm(dim=-1).round()
        tensor([5., 5.])
    """

    def __init__(
        self,
        pushes: Sequence[Push],
        *,
        dt: float,
        rest: tuple[float, float] = (2.0, 6.0),
        duration: tuple[float, float] = (0.05, 0.5),
        push_key: NestedKey = "push",
        seed: int = 0,
        first_row: int = 0,
        reset_key: NestedKey | None = None,
    ) -> None:
        if not dt > 0 or not 0 <= rest[0] <= rest[1] or not 0 < duration[0] <= duration[1] or not pushes:
            raise ValueError(
                f"dt {dt} s, rest {rest} s, duration {duration} s and {len(pushes)} groups make no pushes: give times "
                "(least, greatest) that are not negative, and at least one group."
            )
        left, stream, on = (beside(push_key, name) for name in ("steps_left", "stream", "on"))
        keys = [push_key, left, stream, on]
        super().__init__([], keys, seed=seed, first_row=first_row, reset_key=reset_key)
        self.pushes, self.dt, self.rest, self.duration = tuple(pushes), dt, rest, duration
        self.push_key, self.left_key, self.stream_key, self.on_key = keys
        self.bodies = tuple(body for push in pushes for body in push.bodies)

    def _inv_call(self, tensordict: TensorDictBase) -> TensorDictBase:
        if self.parent is not None:  # else on its way into a buffer
            bodies = once_per_model(self, self._body_ids)
            simulated_env(self).set_wrench(self.push_key, bodies, tensordict.get(self.push_key))
        return tensordict

    def draw(self, key: Tensor, tensordict_reset: TensorDictBase) -> Mapping[NestedKey, Tensor]:
        return {
            self.push_key: torch.zeros(*key.shape, len(self.bodies), 6, device=key.device),
            self.left_key: self._steps(streams.uniform(key, 1), (0.0, self.rest[1])),
            self.stream_key: streams.advance(key).unsqueeze(-1),
            self.on_key: torch.zeros(*key.shape, 1, dtype=torch.bool, device=key.device),
        }

    def advance(self, tensordict: TensorDictBase, next_tensordict: TensorDictBase) -> None:
        push, left, stream, on = (tensordict.get(key) for key in self.out_keys)
        left = left - 1
        over = left <= 0
        if left.device.type != "cpu" or torch.compiler.is_compiling() or bool(over.any()):
            key = stream.squeeze(-1)
            unit = streams.uniform(key, 9)
            pause = self._steps(unit[..., :1], self.rest)
            lasts = self._steps(unit[..., :1], self.duration)
            left = torch.where(over, torch.where(on, pause, lasts), left)
            begins = over & ~on
            new = torch.where(begins.unsqueeze(-1), self._wrench(unit[..., 1:]), 0.0)
            push = torch.where(over.unsqueeze(-1), new, push)
            stream = torch.where(over, streams.advance(key).unsqueeze(-1), stream)
            on = torch.where(over, begins, on)
        for entry, value in zip(self.out_keys, (push, left, stream, on), strict=True):
            next_tensordict.set(entry, value)

    def _steps(self, unit: Tensor, seconds: tuple[float, float]) -> Tensor:
        """Whole steps, at least one, of a time that is drawn by a number in [0, 1)."""
        low, high = seconds
        return torch.round((low + (high - low) * unit) / self.dt).clamp(min=1).to(torch.int64)

    def _wrench(self, unit: Tensor) -> Tensor:
        """A push at one body of one group. Numbers in [0, 1), shape (*B, 8), to (*B, bodies, 6)."""
        which, within, strong, hard = (unit[..., k : k + 1] for k in range(4))
        group = (which * len(self.pushes)).long()
        signed = 2 * unit[..., 4:] - 1
        toward, about = randomization.direction(signed[..., :2]), randomization.direction(signed[..., 2:])
        wrenches = []
        for number, push in enumerate(self.pushes):
            force = push.force[0] + (push.force[1] - push.force[0]) * strong
            torque = push.torque[0] + (push.torque[1] - push.torque[0]) * hard
            body = (within * len(push.bodies)).long()
            here = (group == number) & (body == torch.arange(len(push.bodies), device=unit.device))
            wrenches.append(here.unsqueeze(-1) * torch.cat((force * toward, torque * about), -1).unsqueeze(-2))
        return torch.cat(wrenches, -2)

    def _body_ids(self, env: Any) -> Tensor:
        """Numbers of the bodies in the model."""
        physics = env.physics
        known = [physics.model.body(i).name for i in range(physics.model.nbody)]
        if unknown := [name for name in self.bodies if name not in known]:
            raise ValueError(
                f"ExternalPush: the model has no body {unknown[0]!r}; it has {known}. Push some of these, or nothing: "
                "Disturbances(pushes=...), which are by default those of a B2 with a Z1."
            )
        return torch.tensor([known.index(name) for name in self.bodies], device=physics.device)

    def state_spec(self, observation_spec: Composite) -> Mapping[NestedKey, TensorSpec]:
        env = simulated_env(self)
        once_per_model(self, self._body_ids)
        batch, device = env.batch_size, env.device
        return {
            self.push_key: Unbounded((*batch, len(self.bodies), 6), device=device),
            self.left_key: Unbounded((*batch, 1), dtype=torch.int64, device=device),
            self.stream_key: Unbounded((*batch, 1), dtype=torch.int64, device=device),
            self.on_key: Unbounded((*batch, 1), dtype=torch.bool, device=device),
        }
