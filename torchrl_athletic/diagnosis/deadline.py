"""When work has to end, whatever it has found by then."""

from __future__ import annotations

import time
from dataclasses import dataclass, field

import numpy as np


@dataclass(frozen=True)
class Deadline:
    """An amount of time, of which parts of the work may use parts.

    Example:
        >>> whole = Deadline(100.0)
        >>> round(whole.part(0.2).left)
        20
        >>> Deadline().over
        False
    """

    seconds: float = np.inf
    """From :attr:`begun` on [s]."""
    begun: float = field(default_factory=time.monotonic)

    @property
    def left(self) -> float:
        """[s]."""
        return self.begun + self.seconds - time.monotonic()

    @property
    def over(self) -> bool:
        """Whether nothing is left."""
        return self.left <= 0.0

    def allows(self, seconds: float) -> bool:
        """Whether something may begin that takes so long [s]."""
        return self.left > seconds

    def part(self, share: float) -> Deadline:
        """A deadline at this share of the whole time, 0..1."""
        return Deadline(share * self.seconds, self.begun)
