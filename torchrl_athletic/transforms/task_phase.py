"""Which phase of its task an episode is in."""

from __future__ import annotations

from collections.abc import Mapping

import torch
from tensordict import NestedKey, TensorDictBase
from torch import Tensor
from torchrl.data import Bounded, Composite, TensorSpec

from torchrl_athletic.functional import phase, streams
from torchrl_athletic.functional.phase import PhaseSchedule
from torchrl_athletic.transforms.stateful import RandomTransform


class TaskPhase(RandomTransform):
    """Lead each episode through the phases of a task, and show them: one-hot, with a timer.

    Phases hand over after their time, with a probability that is decided once for an episode. A step's ``next`` shows
    the phase that is on when the step is over; what an action was taken in stands beside the action.

    Before there is a task, in pre-training, ``TaskPhase(None, dt, width=4)`` shows zeros in the same places.

    Args:
        schedule: Such as :func:`~.functional.phase.throw_phases`; None has no phases, and shows zeros.
        dt: Of a step at this place in the chain [s]: the policy's, if it stands outside :class:`~.Decimation`.
        width: Of what is shown, d; None takes what the schedule needs. More is filled with zeros, so that one network
            serves several tasks: 4 holds each of the paper's.
        phase_key: What the policy sees (:func:`~.functional.phase.embed_phase`). Shape (*B, d).
        index_key: Number of the phase. int64, shape (*B, 1).
        step_key: Its age [steps]. int64, shape (*B, 1).
        last_key: Number of the phase that will not hand over, for nobody to see. int64, shape (*B, 1).
        seed: Of the draws.
        first_row: As of :class:`RandomTransform`.
        reset_key: As of :class:`StatefulTransform`.

    Source:
        Fey et al. 2025, section II-C and appendix B.

    Example:
        >>> from torchrl.envs import GymEnv, TransformedEnv
        >>> from torchrl_athletic.functional.phase import sled_phases
        >>> env = TransformedEnv(GymEnv("Pendulum-v1"), TaskPhase(sled_phases(), dt=0.05))
        >>> env.rollout(60)["task_phase"][[0, 49, 50]].tolist()
        [[1.0, 0.0], [1.0, 0.0], [0.0, 1.0]]
    """

    start_bounds: Tensor
    leave_probability: Tensor
    duration_steps: Tensor
    timer_steps: Tensor

    def __init__(
        self,
        schedule: PhaseSchedule | None,
        dt: float,
        *,
        width: int | None = None,
        phase_key: NestedKey = "task_phase",
        index_key: NestedKey = "task_phase_index",
        step_key: NestedKey = "task_phase_step",
        last_key: NestedKey = "task_phase_last",
        seed: int = 0,
        first_row: int = 0,
        reset_key: NestedKey | None = None,
    ) -> None:
        if not dt > 0:
            raise ValueError(f"dt is {dt} s, needed is more than 0: no phase would ever be over.")
        needed = 1 if schedule is None else schedule.width
        if (schedule is None and width is None) or (width is not None and width < needed):
            told = "no phases" if schedule is None else f"phases {list(schedule.names)}, with their timer,"
            raise ValueError(f"width is {width}, but {told} need at least {needed} places in the policy's input.")
        memory = [] if schedule is None else [index_key, step_key, last_key]
        super().__init__([], [phase_key, *memory], seed=seed, first_row=first_row, reset_key=reset_key)
        self.schedule, self.dt, self.width = schedule, dt, needed if width is None else width
        self.phase_key, self.index_key, self.step_key, self.last_key = phase_key, index_key, step_key, last_key
        if schedule is not None:  # computed from the schedule, so that no checkpoint has to hold them
            self.register_buffer("start_bounds", schedule.start_bounds(), persistent=False)
            self.register_buffer("leave_probability", schedule.leave_probability(), persistent=False)
            self.register_buffer("duration_steps", schedule.duration_steps(dt), persistent=False)
            self.register_buffer("timer_steps", schedule.timer_steps(dt), persistent=False)

    def draw(self, key: Tensor, tensordict_reset: TensorDictBase) -> Mapping[NestedKey, Tensor]:
        if self.schedule is None:
            return {self.phase_key: torch.zeros(*key.shape, self.width, device=key.device)}
        unit = streams.uniform(key, 1 + len(self.schedule.phases))
        first, last = phase.draw_phases(unit, self.start_bounds, self.leave_probability)
        return self._shown(first, torch.zeros_like(first)) | {self.last_key: last}

    def advance(self, tensordict: TensorDictBase, next_tensordict: TensorDictBase) -> None:
        if self.schedule is None:
            next_tensordict.set(self.phase_key, tensordict.get(self.phase_key))
            return
        last = tensordict.get(self.last_key)
        index, step = tensordict.get(self.index_key), tensordict.get(self.step_key)
        index, step = phase.advance_phase(index, step, last, self.duration_steps)
        for key, value in self._shown(index, step).items():
            next_tensordict.set(key, value)
        next_tensordict.set(self.last_key, last)

    def state_spec(self, observation_spec: Composite) -> Mapping[NestedKey, TensorSpec]:
        batch, device = observation_spec.shape, observation_spec.device
        specs = {self.phase_key: Bounded(0.0, 1.0, shape=(*batch, self.width), device=device)}
        if self.schedule is None:
            return specs
        number = Bounded(0, len(self.schedule.phases) - 1, shape=(*batch, 1), dtype=torch.int64, device=device)
        age = Bounded(0, phase.NEVER, shape=(*batch, 1), dtype=torch.int64, device=device)
        return specs | {self.index_key: number, self.step_key: age, self.last_key: number.clone()}

    def _shown(self, index: Tensor, step: Tensor) -> dict[NestedKey, Tensor]:
        embedding = phase.embed_phase(index, step, self.timer_steps, self.width)
        return {self.phase_key: embedding, self.index_key: index, self.step_key: step}
