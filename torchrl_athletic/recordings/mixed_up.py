"""Columns of a log that stand at the wrong joint."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import linear_sum_assignment
from scipy.sparse.csgraph import connected_components

from torchrl_athletic.recordings.recording import Recording

LEAVES = 0.5
"""Share of itself by which what is left has to fall [1]."""
TURNED = 0.25
"""Square of what a joint leaves of the opposite of its target, per what it leaves of the target and of its variance."""
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
    gains = left[np.arange(len(left)), column] < LEAVES * np.diag(left)
    _, exchange = connected_components(np.eye(len(left))[column], directed=False)
    return [(j, int(k)) for j, k in enumerate(column) if j != k and gains[exchange == exchange[j]].all()]


def exchange_sentence(joints: Sequence[str], field: str, pairs: Sequence[tuple[int, int]]) -> str:
    """What is said of such an exchange, with the mend."""
    told = ", ".join(f"{joints[k]}'s follows the motion of {joints[j]}" for j, k in pairs)
    return (
        f"the {field} columns look exchanged: {told}. Put them in the order of joint_names, or name them in the "
        "column map."
    )


def target_doubts(recording: Recording, noise: NDArray[np.float64]) -> list[str]:
    """Targets that another joint follows, or that are followed with the other sign, in sentences with the mend.

    Nothing is said of joints that hold still, whose motor is off, or that follow badly either way.

    Args:
        recording: A take.
        noise: Of the position, standard deviation [rad, m]. Shape (J,).
    """
    if recording.position_target is None or recording.kp is None:
        return []
    names = recording.joint_names
    position, target = (x - x.mean(0) for x in (recording.position, recording.position_target))
    moved, asked = position.var(0), target.var(0)
    moves = np.flatnonzero((np.minimum(moved, asked) > (10 * noise) ** 2) & (recording.kp > 0)).tolist()
    both = position.T @ target / len(position)
    left = (moved[:, None] + asked - 2 * both)[np.ix_(moves, moves)]
    far = left > LEAVES * asked[moves]
    never = far & ~np.eye(len(moves), dtype=bool)
    pairs = mixed_up(np.where(never, 10.0 * left.max(initial=0.0), left))
    exchanged = {moves[j] for j, _ in pairs}
    found = [exchange_sentence(names, "position_target", [(moves[j], moves[k]) for j, k in pairs])] if pairs else []
    turned = moved + asked + 2 * np.diag(both)
    return found + [
        f"the position of {names[j]} follows its position_target with the other sign. Flip one of them; only a servo "
        "much softer than what it carries, shaken fast, looks like this, too."
        for k, j in enumerate(moves)
        if j not in exchanged and turned[j] < TURNED * min(left[k, k], asked[j])
    ]
