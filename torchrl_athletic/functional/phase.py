"""The phases of a task: which one is on, for how long, whether it hands over, and what the policy is told of it."""

from __future__ import annotations

import math
from dataclasses import dataclass

import torch
from torch import Tensor

NEVER = 1 << 62
"""Steps of a phase that lasts as long as the episode."""


@dataclass(frozen=True)
class Phase:
    """One phase of a task."""

    name: str
    duration: float = math.inf
    """When it hands over to the next phase, since its own beginning [s]."""
    leave_probability: float = 1.0
    """Probability that it hands over, decided once: a phase that does not stays for the rest of the episode."""
    start_probability: float = 0.0
    """Probability that an episode starts in it. What the phases leave is the first one's."""
    timer: float | None = None
    """Time in which its timer goes from 0 to 1 [s], where it stays; None has none."""


@dataclass(frozen=True)
class PhaseSchedule:
    """Phases that follow one another.

    Args:
        phases: In their order.

    Raises:
        ValueError: If two have one name, a time is not above zero, or probabilities are none.

    Example:
        >>> throw_phases().names
        ('throw-set-up', 'throw', 'settle')
    """

    phases: tuple[Phase, ...]

    def __post_init__(self) -> None:
        if not self.phases or len(set(self.names)) < len(self.phases):
            raise ValueError(f"phases {list(self.names)} need at least one, each of a name of its own.")
        for phase in self.phases:
            if not phase.duration > 0 or not (phase.timer is None or phase.timer > 0):
                raise ValueError(
                    f"phase {phase.name!r} lasts {phase.duration} s with a timer of {phase.timer} s; needed is more "
                    "than 0, or no step would show it. Leave the phase or its timer out."
                )
            if not (0 <= phase.leave_probability <= 1 and 0 <= phase.start_probability <= 1):
                raise ValueError(f"phase {phase.name!r} has a probability outside of 0 to 1: {phase}.")
        if sum(phase.start_probability for phase in self.phases) > 1 + 1e-6:
            raise ValueError(
                f"the start probabilities {[phase.start_probability for phase in self.phases]} sum to more than 1. "
                "Leave the first phase's at 0: it starts whatever the others do not."
            )

    @property
    def names(self) -> tuple[str, ...]:
        return tuple(phase.name for phase in self.phases)

    @property
    def width(self) -> int:
        """Width of the embedding: a place for each phase, and one for the timer if any phase has one."""
        return len(self.phases) + any(phase.timer is not None for phase in self.phases)

    def index(self, name: str) -> int:
        """Place of a phase in the embedding."""
        if name not in self.names:
            raise ValueError(f"no phase is called {name!r}; there are {list(self.names)}.")
        return self.names.index(name)

    def duration_steps(self, dt: float) -> Tensor:
        """Steps after which each phase is over, :data:`NEVER` for those without an end. int64, shape (P,)."""
        finite = [phase.duration if math.isfinite(phase.duration) else None for phase in self.phases]
        return torch.tensor([NEVER if t is None else max(1, math.ceil(t / dt - 1e-6)) for t in finite])

    def timer_steps(self, dt: float) -> Tensor:
        """Steps in which each timer runs out, infinite for phases without one. Shape (P,)."""
        return torch.tensor([math.inf if phase.timer is None else phase.timer / dt for phase in self.phases])

    def leave_probability(self) -> Tensor:
        """Shape (P,)."""
        return torch.tensor([phase.leave_probability for phase in self.phases])

    def start_bounds(self) -> Tensor:
        """Upper bounds of the parts of [0, 1) that belong to starting in each phase. Shape (P,)."""
        others = torch.tensor([phase.start_probability for phase in self.phases[1:]], dtype=torch.float64)
        shares = torch.cat((1 - others.sum(dim=0, keepdim=True), others))
        return shares.cumsum(0).to(torch.float32)


def draw_phases(unit: Tensor, start_bounds: Tensor, leave_probability: Tensor) -> tuple[Tensor, Tensor]:
    """Decide an episode: in which phase it starts, and which is its last.

    Every phase's one decision to hand over is made here, ahead of its time, so that an episode needs no more draws.

    Args:
        unit: From [0, 1), the first for the start, the others for the phases. Shape (*B, 1 + P).
        start_bounds: Of :meth:`PhaseSchedule.start_bounds`. Shape (P,).
        leave_probability: Shape (P,).

    Returns:
        Number of the first phase and of the last one. int64, shape (*B, 1) each.

    Example:
        >>> schedule = snatch_phases()
        >>> unit = torch.tensor([[0.5, 0.89, 0.0], [0.5, 0.91, 0.0]])
        >>> draw_phases(unit, schedule.start_bounds(), schedule.leave_probability())[1].tolist()
        [[1], [0]]
    """
    number = torch.arange(len(start_bounds), device=unit.device)
    first = (unit[..., :1] >= start_bounds[:-1]).sum(-1, keepdim=True)
    goes_on = (unit[..., 1:] < leave_probability) | (number < first)
    last = goes_on[..., :-1].long().cumprod(-1).sum(-1, keepdim=True)
    return first, last


def advance_phase(index: Tensor, step: Tensor, last: Tensor, duration_steps: Tensor) -> tuple[Tensor, Tensor]:
    """The phase, and its age, one step later.

    Args:
        index: Phase that is on. int64, shape (*B, 1).
        step: Its age [steps]. int64, shape (*B, 1).
        last: Phase that does not hand over. int64, shape (*B, 1).
        duration_steps: Of :meth:`PhaseSchedule.duration_steps`. Shape (P,).

    Returns:
        Phase and age. int64, shape (*B, 1) each.
    """
    step = step + 1
    over = (step >= duration_steps[index]) & (index < last)
    return index + over, torch.where(over, 0, step)


def embed_phase(index: Tensor, step: Tensor, timer_steps: Tensor, width: int) -> Tensor:
    """What the policy is told: a 1 at the phase that is on, then the phase's timer, then zeros up to the width.

    Args:
        index: Phase that is on. int64, shape (*B, 1).
        step: Its age [steps]. int64, shape (*B, 1).
        timer_steps: Of :meth:`PhaseSchedule.timer_steps`. Shape (P,).
        width: d.

    Returns:
        float32. Shape (*B, d).

    Source:
        Fey et al. 2025, appendix B-A: one-hot vector and timer.

    Example:
        >>> timers = throw_phases().timer_steps(dt=0.02)
        >>> embed_phase(torch.tensor([1]), torch.tensor([25]), timers, width=4).tolist()
        [0.0, 1.0, 0.0, 0.5]
    """
    count = len(timer_steps)
    told = torch.zeros(*index.shape[:-1], width, device=index.device).scatter_(-1, index, 1.0)
    if width > count:
        told[..., count : count + 1] = (step / timer_steps[index]).clamp(max=1.0)
    return told


def throw_phases(
    stay_probability: float = 0.3, stay_in: str = "throw-set-up", settle_probability: float = 0.1
) -> PhaseSchedule:
    """Swing back for 2.5 s, throw until 3.5 s, then stand still.

    The paper says that the policy "remains in the ``throw`` state with a probability of 0.3", as the cure for a policy
    that leaned ever further in the set-up and fell unless it was let go. An episode that stays in ``throw`` would not
    punish that lean, one that stays in the set-up does, and of the snatch the paper says that "a similar strategy"
    lengthens its set-up. So the set-up is what stays here; ``stay_in="throw"`` takes the sentence at its word.

    Args:
        stay_probability: That this phase lasts for the rest of the episode.
        stay_in: Which one: ``throw-set-up`` or ``throw``.
        settle_probability: That an episode starts with standing still. The paper does so and gives no figure: this one
            is chosen here.

    Source:
        Fey et al. 2025, appendix B-A.
    """
    if stay_in not in ("throw-set-up", "throw"):
        raise ValueError(f"stay_in is {stay_in!r}; it is 'throw-set-up' or 'throw': 'settle' lasts in any case.")
    leave = {stay_in: 1 - stay_probability}
    return PhaseSchedule(
        (
            Phase("throw-set-up", duration=2.5, leave_probability=leave.get("throw-set-up", 1.0)),
            Phase("throw", duration=1.0, leave_probability=leave.get("throw", 1.0), timer=1.0),
            Phase("settle", start_probability=settle_probability),
        )
    )


def snatch_phases() -> PhaseSchedule:
    """Lower the gripper for 2.5 s, then, nine times in ten, lift.

    Source:
        Fey et al. 2025, appendix B-B.
    """
    return PhaseSchedule((Phase("snatch-set-up", duration=2.5, leave_probability=0.9), Phase("snatch")))


def sled_phases() -> PhaseSchedule:
    """Take up the pose for 2.5 s, then pull.

    Source:
        Fey et al. 2025, appendix B-C.
    """
    return PhaseSchedule((Phase("sled-set-up", duration=2.5), Phase("pull")))
