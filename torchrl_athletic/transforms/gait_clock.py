"""A clock in the observation, to which the policy steps."""

from __future__ import annotations

from collections.abc import Mapping

import torch
from tensordict import NestedKey, TensorDictBase
from torch import Tensor
from torchrl.data import Bounded, Composite, TensorSpec

from torchrl_athletic.functional import gait, streams
from torchrl_athletic.transforms.stateful import RandomTransform


class GaitClock(RandomTransform):
    r"""Show :math:`\sin 2 \pi f t`, t being the time since the episode began (:func:`~.functional.gait.gait_phase`).

    Args:
        dt: Of a step at this place in the chain [s]: the policy's, if it stands outside :class:`~.Decimation`.
        frequency: f [Hz].
        cosine: Whether to show the cosine as well.
        random_start: Start anywhere in the cycle, drawn anew for each episode, instead of at 0.
        phase_key: What the policy sees. Shape (*B, 1), or (*B, 2) with the cosine.
        cycle_key: Share of the cycle that has passed [1], the memory; :func:`~.functional.gait.foot_height` takes it.
            Shape (*B, 1).
        seed: Of the draws.
        first_row: As of :class:`RandomTransform`.
        reset_key: As of :class:`StatefulTransform`.

    Source:
        Fey et al. 2025, section II-B: f = 2.2 Hz.

    Example:
        >>> from torchrl.envs import GymEnv, TransformedEnv
        >>> env = TransformedEnv(GymEnv("Pendulum-v1"), GaitClock(dt=0.05, frequency=5.0))
        >>> env.rollout(4)["gait_phase"].squeeze(-1).abs().round(decimals=3).tolist()
        [0.0, 1.0, 0.0, 1.0]
    """

    def __init__(
        self,
        dt: float,
        frequency: float = 2.2,
        *,
        cosine: bool = False,
        random_start: bool = False,
        phase_key: NestedKey = "gait_phase",
        cycle_key: NestedKey = "gait_cycle",
        seed: int = 0,
        first_row: int = 0,
        reset_key: NestedKey | None = None,
    ) -> None:
        if not 0 < frequency * dt < 0.5:
            raise ValueError(
                f"a clock of {frequency} Hz shown every {dt} s passes {frequency * dt:g} cycles a step; needed is more "
                "than 0 and less than half a cycle, or it would seem to run backwards. Give dt in seconds."
            )
        super().__init__([], [phase_key, cycle_key], seed=seed, first_row=first_row, reset_key=reset_key)
        self.dt, self.frequency, self.cosine, self.random_start = dt, frequency, cosine, random_start
        self.phase_key, self.cycle_key = phase_key, cycle_key

    def draw(self, key: Tensor, tensordict_reset: TensorDictBase) -> Mapping[NestedKey, Tensor]:
        cycle = streams.uniform(key, 1) if self.random_start else torch.zeros(*key.shape, 1, device=key.device)
        return self._shown(cycle)

    def advance(self, tensordict: TensorDictBase, next_tensordict: TensorDictBase) -> None:
        cycle = gait.advance_cycle(tensordict.get(self.cycle_key), self.frequency, self.dt)
        for key, value in self._shown(cycle).items():
            next_tensordict.set(key, value)

    def state_spec(self, observation_spec: Composite) -> Mapping[NestedKey, TensorSpec]:
        batch, device = observation_spec.shape, observation_spec.device
        return {
            self.phase_key: Bounded(-1.0, 1.0, shape=(*batch, 2 if self.cosine else 1), device=device),
            self.cycle_key: Bounded(0.0, 1.0, shape=(*batch, 1), device=device),
        }

    def _shown(self, cycle: Tensor) -> dict[NestedKey, Tensor]:
        return {self.phase_key: gait.gait_phase(cycle, self.cosine), self.cycle_key: cycle}
