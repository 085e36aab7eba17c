"""Columns of a log that stand at the wrong joint."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import linear_sum_assignment

HALF = 0.5
"""Share of itself by which what is left has to fall [1]."""
LEAST = 1e-9
"""What is left of a column that is followed to the digit, in the largest one."""


def mixed_up(left: NDArray[np.float64]) -> list[tuple[int, int]]:
    """Joints and the columns that belong to them, where the ones that they have do not.

    All joints of an exchange have to gain by it: what is left has to fall by more than half. So a joint that explains
    another one's column by chance, as where all move alike, is none.

    Args:
        left: What the motion of each joint leaves of each column, squared. Shape (joints, columns), square.

    Returns:
        Pairs of a joint and its column; none where all are in order.

    Example:
        >>> mixed_up(np.array([[0.9, 0.1, 0.8], [0.05, 1.0, 0.7], [0.9, 0.8, 0.1]]))
        [(0, 1), (1, 0)]
    """
    left = np.maximum(left, LEAST * max(float(left.max(initial=0.0)), 1e-300))
    _, column = linear_sum_assignment(np.log(left))
    gains = left[np.arange(len(left)), column] < HALF * np.diag(left)
    return [(j, int(column[j])) for cycle in _cycles(column) if gains[cycle].all() for j in cycle]


def _cycles(order: Sequence[int] | NDArray[np.intp]) -> list[list[int]]:
    """Joints that exchange columns among themselves, of each exchange; a joint that keeps its own is in none."""
    seen: set[int] = set()
    out = []
    for first in range(len(order)):
        cycle, j = [], first
        while j not in seen:
            seen.add(j)
            cycle.append(j)
            j = int(order[j])
        if len(cycle) > 1:
            out.append(cycle)
    return out


def exchange_sentence(joints: Sequence[str], field: str, pairs: Sequence[tuple[int, int]]) -> str:
    """What is said of such an exchange, with the mend."""
    told = ", ".join(f"{joints[k]}'s follows the motion of {joints[j]}" for j, k in pairs)
    return (
        f"the {field} columns look exchanged: {told}. Put them in the order of joint_names, or name them in the "
        "column map."
    )
