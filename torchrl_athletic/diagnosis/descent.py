"""Bounded least squares of a simulation's errors: Jacobians by finite differences, and steps by them."""

from __future__ import annotations

import time
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from torchrl_athletic.diagnosis.deadline import Deadline
from torchrl_athletic.diagnosis.fit import Groups
from torchrl_athletic.diagnosis.problem import Problem
from torchrl_athletic.diagnosis.screen import bounded_least_squares

Array = NDArray[np.float64]
Mask = NDArray[np.bool_]

STEPS = 5
"""Steps by one Jacobian, which each of them mends (Broyden 1965)."""
DAMPING, LEAST_DAMPING, MOST_DAMPING = 1e-2, 1e-4, 100.0
"""Damping of a first step (Levenberg, Marquardt), per the normal equations' diagonal, and its bounds [1]."""
AROUND = (0.1, 1.0, 10.0)
"""Damping of the steps that are tried at once, per the one that helped last [1]."""
REFUSED = 1e3
"""Factor of the damping where none of them helps: the next ones are all shorter [1]."""
ROUNDS = 8
"""Jacobians joint by joint at most."""
FLAT, FLAT_JOINTWISE = 1e-3, 1e-2
"""Share of the cost that a whole Jacobian, or one of its steps, and one joint by joint must save to go on [1]."""
HIDDEN = 2e-4
"""Change of a window's error, in typical errors, that a unit of a parameter must make to be moved [1]."""
RIDGE = 1e-6
"""Pull towards the solution where windows say nothing, per what they say [1]."""
FINITE = 1e-2
"""Step of the finite differences, in units of a parameter [1]."""


def descend(
    problem: Problem,
    x: Array,
    free: Mask,
    slopes: int,
    deadline: Deadline,
    first: Linearised | None = None,
    whole: bool = True,
) -> Array:
    """Bounded least squares from values (P,) over the free parameters; what is not free stays. Shape (P,).

    Each Jacobian is by finite differences, all of whose columns are one batch, and serves several steps. Where like
    numbers of several joints are free, Jacobians joint by joint come first, for as long as they help: they stand for
    the first whole one. They end where joints pass nothing on, so that a whole one comes last.

    Args:
        problem: What to minimise.
        x: Values to start from.
        free: Which of them may move.
        slopes: Whole Jacobians at most, with what stands for them.
        deadline: After which none is begun.
        first: The first Jacobian, if it is known, as it is near a solution; of any weights.
        whole: Whether a whole one comes last; without, the solution is only near.
    """
    if not free.any() or deadline.over:
        return x
    if first is not None:
        x, _, saved = _steps(problem, first, DAMPING, deadline)
        return _descended(problem, x, free, slopes - 1 if saved >= FLAT else 0, deadline, first.seconds)[0]
    alike, seconds = problem.hypothesis.alike(free), 0.0
    if 2 * len(alike) <= free.sum():
        x, seconds = _descended(problem, x, free, ROUNDS, deadline, groups=alike)
        seconds *= (free.sum() + 1) / (len(alike) + 1)
        slopes = max(slopes - 1, 1) if whole else 0
    return _descended(problem, x, free, slopes, deadline, seconds)[0]


def _descended(
    problem: Problem,
    x: Array,
    free: Mask,
    slopes: int,
    deadline: Deadline,
    seconds: float = 0.0,
    groups: Groups | None = None,
) -> tuple[Array, float]:
    """Values (P,) after so many Jacobians at most, and the time that one takes, which is about ``seconds`` at first."""
    damping = DAMPING
    for _ in range(slopes):
        if not deadline.allows(1.3 * seconds):
            break
        near = linearise(problem, x, free, groups)
        seconds = near.seconds
        x, damping, saved = _steps(problem, near, damping, deadline)
        if saved < (FLAT if groups is None else FLAT_JOINTWISE):
            break
    return x, seconds


def _steps(problem: Problem, near: Linearised, damping: float, deadline: Deadline) -> tuple[Array, float, float]:
    """A few steps by one Jacobian.

    Args:
        problem: What to minimise.
        near: Where the steps begin, with the Jacobian; of any weights.
        damping: Of the first step, per the normal equations' diagonal [1].
        deadline: After which no step is begun.

    Returns:
        Values (P,), the damping to go on with, and the share of the cost that was saved.
    """
    h, free, weight = problem.hypothesis, near.free, problem.row_weight
    scale = h.scale[free]
    low, high = (side[free] / scale for side in h.bounds)
    x = near.values[free] / scale
    r = np.concatenate([near.errors * weight, near.pull])
    d = np.concatenate([near.columns * weight[:, None], near.pull_columns])
    begin = cost = float(r @ r)
    hidden = _hidden(np.diag(d.T @ d), len(problem.weight))
    low, high = np.where(hidden, x, low), np.where(hidden, x, high)
    for _ in range(STEPS):
        normal, right = d.T @ d, d.T @ r
        size = np.diag(np.diag(normal))
        tried = sorted({much if much > LEAST_DAMPING else 0.0 for much in damping * np.array(AROUND)})
        moves = [bounded_least_squares(normal + (RIDGE + much) * size, -right, low - x, high - x) for much in tried]
        trials = np.clip(x + np.stack(moves), low, high)
        values = np.repeat(near.values[None], len(trials), axis=0)
        values[:, free] = trials * scale
        errors = np.concatenate([problem.errors(values) * weight[:, None], problem.pull(values)])
        costs = (errors**2).sum(0)
        best = int(np.argmin(costs))
        if not costs[best] < cost:
            damping *= REFUSED
            if damping > MOST_DAMPING or cost < begin or deadline.over:
                break
            continue
        damping = tried[best]
        move, saved = trials[best] - x, 1.0 - costs[best] / cost
        d += np.outer(errors[:, best] - r - d @ move, move) / max(float(move @ move), 1e-300)
        x, r, cost = trials[best], errors[:, best], float(costs[best])
        if saved < FLAT or deadline.over:
            break
    out = near.values.copy()
    out[free] = np.clip(x * scale, h.bounds[0][free], h.bounds[1][free])
    return out, float(np.clip(damping, LEAST_DAMPING, MOST_DAMPING)), 1.0 - cost / begin if begin > 0.0 else 0.0


def _hidden(curvature: Array, windows: int) -> Mask:
    """Parameters that no window shows, by the diagonal of the normal equations: they stay where they are.

    Damping in proportion to what windows say would let a nothing of a slope carry them to their bounds, where they are
    not hidden any more: an encoder's offset about a vertical axis, to the joint's stop. Shape (P,).
    """
    return np.asarray(curvature <= HIDDEN**2 * windows, dtype=np.bool_)


@dataclass(frozen=True, eq=False)
class Linearised:
    """A problem near its solution, to first order. P free parameters, in units of their scale."""

    problem: Problem
    values: Array
    """Solution, of all parameters."""
    free: Mask
    errors: Array
    """As the problem's. Shape (N,)."""
    columns: Array
    """Their Jacobian. Shape (N, P)."""
    pull: Array
    """The torques' rows. Shape (R,)."""
    pull_columns: Array
    """Shape (R, P)."""
    seconds: float = 0.0
    """That it took [s]."""
    ridge: float = RIDGE
    """Pull of a :meth:`step` towards the solution, per what windows say [1]."""

    @cached_property
    def normal(self) -> Array:
        """Each window's normal equations. Shape (W, P, P)."""
        d = self.columns * self.problem.row_weight[:, None]
        return np.stack([part.T @ part for part in np.split(d, self._first[1:])])

    @cached_property
    def right(self) -> Array:
        """Gradient of half the squared error, of each window. Shape (W, P)."""
        both = (self.columns.T * (self.problem.row_weight**2 * self.errors)).T
        return np.asarray(np.add.reduceat(both, self._first, axis=0), dtype=np.float64)

    @property
    def _first(self) -> NDArray[np.intp]:
        return np.flatnonzero(np.diff(self.problem.window, prepend=-1))

    def step(self, windows: Mask, held: Mask) -> Array:
        """Solution of some windows with some of the free parameters held at the given model's. All parameters."""
        h = self.problem.hypothesis
        out, scale = self.values.copy(), h.scale[self.free]
        move = self.move(windows, held)
        out[self.free] = np.clip(out[self.free] + move * scale, h.bounds[0][self.free], h.bounds[1][self.free])
        return out

    def move(self, windows: Mask, held: Mask) -> Array:
        """The move of the free parameters that those windows ask for, in units of their scale. Shape (P,)."""
        h = self.problem.hypothesis
        scale, start = h.scale[self.free], self.values[self.free]
        low, high = ((side[self.free] - start) / scale for side in h.bounds)
        home = (h.nominal[self.free] - start) / scale
        low, high = np.where(held, home, low), np.where(held, home, high)
        share, columns = float(np.mean(windows)), self.pull_columns
        n = self.normal[windows].sum(0) + share * columns.T @ columns
        hidden = _hidden(np.diag(n), int(windows.sum())) & ~held
        low, high = np.where(hidden, 0.0, low), np.where(hidden, 0.0, high)
        n = n + self.ridge * np.diag(np.diag(n))
        right = self.right[windows].sum(0) + share * columns.T @ self.pull
        return bounded_least_squares(n, -right, low, high)


def linearise(problem: Problem, x: Array, free: Mask, groups: Groups | None = None) -> Linearised:
    """Finite differences about values (P,), into the bounds.

    Args:
        problem: Windows to follow.
        x: Values.
        free: Which of them have a column.
        groups: Of the free parameters, as indices among them, that are moved together, as those of a sparse Jacobian
            are (Curtis, Powell, Reid 1974, doi:10.1093/imamat/13.1.117): each is taken to change the motion of its own
            joint alone. Each by itself, and to change all, if None.
    """
    begin = time.monotonic()
    h, count = problem.hypothesis, int(free.sum())
    step = FINITE * h.scale[free]
    step = np.where(x[free] + step > h.bounds[1][free], -step, step)
    index, alone = np.flatnonzero(free), np.repeat(x[None], count + 1, axis=0)
    alone[1:, free] += np.diag(step)
    per_unit, pull = step / h.scale[free], problem.pull(alone)
    if groups is None:
        e = problem.errors(alone)
        columns = (e[:, 1:] - e[:, :1]) / per_unit
    else:
        together = np.repeat(x[None], len(groups) + 1, axis=0)
        for k, group in enumerate(groups):
            together[k + 1, index[group]] += step[group]
        e = problem.errors(together)
        joint = np.array([c.joint for c in (*h.terms, *h.trims) for _ in c.parameters])[index]
        columns = np.zeros((len(e), count))
        for k, group in enumerate(groups):
            for i in group:
                rows = slice(joint[i], None, len(problem.unit)) if len(group) > 1 else slice(None)
                columns[rows, i] = (e[rows, k + 1] - e[rows, 0]) / per_unit[i]
    pull_columns = (pull[:, 1:] - pull[:, :1]) / per_unit
    return Linearised(problem, x, free, e[:, 0], columns, pull[:, 0], pull_columns, time.monotonic() - begin)
