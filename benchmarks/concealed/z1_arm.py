"""The concealed Z1, as ``recipes/collect_recordings.py --arm`` takes an arm."""

from __future__ import annotations

import sys
from pathlib import Path

sys.path.append(str(Path(__file__).parents[2]))

from benchmarks.concealed.arm import ConcealedArm


def make_arm(seed: int) -> ConcealedArm:
    """Return the arm whose noise the seed draws."""
    return ConcealedArm(seed=seed)
