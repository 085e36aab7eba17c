"""What the stages of a diagnosis hand on: each a frozen dataclass that holds the one before it."""

from __future__ import annotations

import time
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field

import mujoco
import numpy as np
from numpy.typing import NDArray

from torchrl_athletic.diagnosis.checkpoint import Checkpoint
from torchrl_athletic.diagnosis.fit import Fitted
from torchrl_athletic.diagnosis.prepare import Drive, Prepared
from torchrl_athletic.diagnosis.progress import Progress
from torchrl_athletic.diagnosis.proposal import Proposal, StandIn
from torchrl_athletic.diagnosis.result import Location, Score
from torchrl_athletic.diagnosis.screen import Bank, Key
from torchrl_athletic.diagnosis.thresholds import SPENDING
from torchrl_athletic.effects import Effect
from torchrl_athletic.effects.base import Base
from torchrl_athletic.recordings import Recording

Array = NDArray[np.float64]


@dataclass(frozen=True, eq=False)
class Given:
    """What is asked: a model, recordings and settings."""

    model: mujoco.MjModel
    xml: str
    name: str
    recordings: tuple[Recording, ...]
    heldout: tuple[Recording, ...]
    catalogue: tuple[Effect, ...]
    drive: Drive = "command"
    base: Base = "recorded"
    seed: int = 0
    joined: int = 0
    """How many of the recordings, the last ones, are of experiments."""
    highest_frequency: float | None = None
    """Highest frequency that a planned experiment may have [Hz]."""
    warnings: tuple[str, ...] = ()
    """What was left out of the recordings before."""
    inputs: str = ""
    """Digest of all this."""

    @property
    def joint_names(self) -> tuple[str, ...]:
        """In the order of the first recording."""
        return self.recordings[0].joint_names

    def rng(self, purpose: str) -> np.random.Generator:
        """Randomness for one purpose, the same whatever else is drawn."""
        return np.random.default_rng([self.seed, *purpose.encode()])


@dataclass(frozen=True, eq=False)
class Run:
    """What a run may spend, and where it tells how far it is."""

    progress: Progress
    checkpoint: Checkpoint
    """Finished fits."""
    time_budget: float | None = None
    """Time that the whole diagnosis may take [s]."""
    started: float = field(default_factory=time.monotonic)

    def late(self, share: float = SPENDING.to_fit) -> bool:
        """Whether a share of the time is spent: that after which no fit begins, unless told another."""
        left = self.left(share)
        return left is not None and left <= 0

    def left(self, share: float, kept: float = 0.0) -> float | None:
        """Time until a share of the budget is spent, or all but some seconds [s]; None without a budget."""
        if self.time_budget is None:
            return None
        return min(share * self.time_budget, self.time_budget - kept) - (time.monotonic() - self.started)


@dataclass(frozen=True, eq=False)
class Ready:
    """Recordings in the torque domain and on the simulation's grid."""

    given: Given
    train: Prepared
    held: Prepared | None
    doubts: tuple[str, ...] = ()
    """What is wrong with columns of commands."""

    def splits(self) -> Mapping[str, Prepared]:
        """'train' and, when recordings were kept aside, 'heldout'."""
        return {"train": self.train} if self.held is None else {"train": self.train, "heldout": self.held}


@dataclass(frozen=True, eq=False)
class Located:
    """Where the error is."""

    ready: Ready
    bank: Bank
    """The missing torque."""
    locations: tuple[Location, ...]


@dataclass(frozen=True, eq=False)
class Proposed:
    """Combinations of effects that the torques speak for, best first."""

    located: Located
    drive: Proposal | None
    """What the torques say of the drive, where a measured torque cuts the chain in two."""
    options: tuple[Proposal, ...]
    """What they say of the mechanics, or of drive and mechanics together."""


@dataclass(frozen=True, eq=False)
class Trial:
    """A combination in the simulation."""

    proposal: Proposal
    fitted: Fitted
    scores: Mapping[str, Score]
    """How well the fit follows 'train' and 'heldout'."""
    window_errors: Array
    """Error of every window of the fitted recordings [rad, m]. Shape (W, J)."""
    began: Array
    """When these windows start, the same for all trials [s]. Shape (W,)."""
    closes: Mapping[Key, float] = field(default_factory=dict)
    """Share of the error that each closes, 0..1 (see :func:`~torchrl_athletic.diagnosis.fit.shares_closed`); none of a
    trial that gives no names."""


@dataclass(frozen=True, eq=False)
class Simulated:
    """The combinations that were tried in the simulation, and those that time did not allow."""

    proposed: Proposed
    trials: tuple[Trial, ...] = ()
    untried: tuple[Proposal, ...] = ()
    asked: Mapping[Key, float] | None = None
    """Class and joint that the motion was asked about -> share of the error that comes back without it; None where it
    was not asked."""
    stopped: bool = False
    """By Ctrl-C."""


@dataclass(frozen=True, eq=False)
class Decided:
    """What torques and simulation speak for."""

    located: Located
    drive: Proposal | None = None
    trial: Trial | None = None
    """The chosen one; none if nothing was simulated."""
    beside: tuple[Trial, ...] = ()
    """Others that may follow better: what the torques speak for, what the motion asks for, and the standard joints."""
    is_open: bool = False
    """Whether some joint misses torque that noise does not explain, with all numbers within their tolerances."""
    asked: Mapping[Key, float] | None = None
    """What the motion asks for (see :attr:`Simulated.asked`)."""
    sets: Mapping[Key, Sequence[StandIn]] = field(default_factory=dict)
    """Term of the chosen trial or of the drive -> who could stand in its place."""

    @property
    def evidence(self) -> tuple[Proposal, ...]:
        """The parts of what was chosen: the drive, if it was looked at alone, and the mechanics."""
        mechanics = self.trial.proposal if self.trial else None
        return tuple(p for p in (self.drive, mechanics) if p is not None)
