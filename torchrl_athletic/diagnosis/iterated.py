"""Iterated local search: out of a local minimum by chance, joint by joint.

A joint that sticks answers to no small change of any of its numbers, so that a descent ends where it began.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from torchrl_athletic.diagnosis.deadline import Deadline
from torchrl_athletic.diagnosis.descent import descend
from torchrl_athletic.diagnosis.problem import Problem, weighed

Array = NDArray[np.float64]

ROUNDS = 4
"""Rounds at most."""
KICKS = 32
"""Points that are tried about the best one, in each round."""
SLOPES = 2
"""Jacobians of the descent from the best of them."""
FACTOR = 0.5
"""Standard deviation of the logarithm of a kicked number over the best one [1]."""
UNITS = 3.0
"""Standard deviation of what is added to it, in units of the parameter: a friction of zero has no factor [1]."""
GAIN = 0.01
"""Share of the squared error below which a round is the last one [1]."""


def iterated_local_search(problem: Problem, x: Array, rng: np.random.Generator, deadline: Deadline) -> Array:
    """Kick half of the numbers, descend from each joint's best kick, keep what follows better (Lourenço et al. 2003).

    Joints are compared each by its own error: of some kicks one has freed the shoulder and another one the jaw.

    Args:
        problem: What to minimise.
        x: Values that end a descent. Shape (P,).
        rng: Draws the kicks.
        deadline: After which no round is begun.

    Returns:
        Values of no greater cost, in units of the joints' errors at x. Shape (P,).
    """
    h = problem.hypothesis
    free = h.bounds[1] > h.bounds[0]
    joint = np.array([c.joint for c in h.terms for _ in c.parameters])
    for _ in range(ROUNDS):
        if deadline.over:
            break
        factor = np.exp(FACTOR * rng.standard_normal((KICKS, len(x))))
        moved = x * factor + UNITS * h.scale * rng.standard_normal(factor.shape)
        kicks = np.clip(np.where(free & (rng.random(factor.shape) < 0.5), moved, x), *h.bounds)
        best = problem.mean_square(kicks).mean(1).argmin(0)
        y = kicks[best[joint], np.arange(len(x))]
        y = descend(weighed(problem, y), y, free, SLOPES, deadline)
        own, other = problem.mean_square(np.stack([x, y])).mean(1)
        mixed = np.where((other < own)[joint], y, x)
        points, square = np.stack([x, y, mixed]), np.stack([own, other, problem.mean_square(mixed[None])[0].mean(0)])
        cost = (square / np.maximum(own, 1e-18)).mean(1) + problem.charge(points)
        x = points[cost.argmin()]
        if cost.min() > (1.0 - GAIN) * cost[0]:
            break
    return x
