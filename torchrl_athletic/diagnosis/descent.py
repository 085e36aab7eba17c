"""Bounded least squares of a simulation's errors: Jacobians by finite differences, and steps by them."""

from __future__ import annotations

import time
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from torchrl_athletic.diagnosis.deadline import Deadline
from torchrl_athletic.diagnosis.problem import FOLDS, Mask, Problem, part_of
from torchrl_athletic.diagnosis.screen import bounded_least_squares

Array = NDArray[np.float64]

STEPS = 5
"""Steps by one Jacobian, which each of them mends (Broyden 1965)."""
DAMPING = (0.0, 1e-3, 1e-2, 1e-1, 1.0, 10.0)
"""Damping of the steps that are tried at once (Levenberg, Marquardt), per the normal equations' diagonal [1]."""
HIDDEN = 2e-4
"""Change of a window's error, in typical errors, that a unit of a parameter must make to be moved [1]."""
FLAT = 1e-3
"""Share of the cost that a step or a Jacobian must save to go on [1]."""
RIDGE = 1e-6
"""Pull towards the solution where windows say nothing, per what they say [1]."""
FINITE = 1e-2
"""Step of the finite differences, in units of a parameter [1]."""


def descend(
    problem: Problem, x: Array, free: Mask, slopes: int, deadline: Deadline, first: Linearised | None = None
) -> Array:
    """Bounded least squares from values (P,) over the free parameters; what is not free stays. Shape (P,).

    Each Jacobian is by finite differences, all of whose columns are one batch, and serves several steps. Of a step,
    several lengths are tried at once.

    Args:
        problem: What to minimise.
        x: Values to start from.
        free: Which of them may move.
        slopes: Jacobians at most.
        deadline: After which none is begun.
        first: The first Jacobian, if it is known; of any weights.
    """
    if not free.any():
        return x
    seconds = 0.0
    for k in range(slopes):
        if not deadline.allows(1.3 * seconds):
            break
        near = first if first is not None and not k else linearise_roughly(problem, x, free)
        seconds = near.seconds
        x, saved = _steps(problem, near, deadline)
        if saved < FLAT:
            break
    return x


def _steps(problem: Problem, near: Linearised, deadline: Deadline) -> tuple[Array, float]:
    """Values after a few steps by one Jacobian, and the share of the cost that they save."""
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
        moves = [bounded_least_squares(normal + (RIDGE + much) * size, -right, low - x, high - x) for much in DAMPING]
        trials = np.clip(x + np.stack(moves), low, high)
        values = np.repeat(near.values[None], len(trials), axis=0)
        values[:, free] = trials * scale
        errors = np.concatenate([problem.errors(values) * weight[:, None], problem.pull(values)])
        costs = (errors**2).sum(0)
        best = int(np.argmin(costs))
        if not costs[best] < cost:
            break
        move, saved = trials[best] - x, 1.0 - costs[best] / cost
        d += np.outer(errors[:, best] - r - d @ move, move) / max(float(move @ move), 1e-300)
        x, r, cost = trials[best], errors[:, best], float(costs[best])
        if saved < FLAT or deadline.over:
            break
    out = near.values.copy()
    out[free] = np.clip(x * scale, h.bounds[0][free], h.bounds[1][free])
    return out, 1.0 - cost / max(begin, 1e-300)


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
    """That it took, or that steps by it may take if that is more [s]."""
    ridges: tuple[float, ...] = (RIDGE,) * FOLDS
    """Pull towards the solution of the step that all folds but this one ask for, per what they say [1]; by the labels
    of all windows' folds."""
    damped: Mask | None = None
    """Which of the free parameters those ridges hold back; all of them if none is said. Shape (P,)."""

    @cached_property
    def normal(self) -> Array:
        """Each window's normal equations. Shape (W, P, P)."""
        d = self.columns * self.problem.row_weight[:, None]
        return np.stack([part.T @ part for part in np.split(d, self.problem.first[1:])])

    @cached_property
    def right(self) -> Array:
        """Gradient of half the squared error, of each window. Shape (W, P)."""
        both = (self.columns.T * (self.problem.row_weight**2 * self.errors)).T
        return np.asarray(np.add.reduceat(both, self.problem.first, axis=0), dtype=np.float64)

    def of_windows(self, windows: Mask) -> Linearised:
        """The same of some windows alone, with their share of the torques."""
        rows, share = windows[self.problem.window], np.sqrt(np.mean(windows))
        return replace(
            self,
            problem=part_of(self.problem, windows),
            errors=self.errors[rows],
            columns=self.columns[rows],
            pull=share * self.pull,
            pull_columns=share * self.pull_columns,
        )

    def alone(self) -> Linearised:
        """The same without what the torques say."""
        problem = replace(self.problem, torques=None)
        return replace(self, problem=problem, pull=self.pull[:0], pull_columns=self.pull_columns[:0])

    def without(self, gone: Mask) -> Linearised:
        """The same with some of the free parameters at the given model's, and free no more; the others stay.

        What errors change by that is simulated. For what makes up for it the slopes of before have to do.

        Args:
            gone: Which of the free parameters. Shape (P,).
        """
        if not gone.any():
            return self
        values, free = self.values.copy(), self.free.copy()
        free[self.free] = ~gone
        at_home = self.free & ~free
        values[at_home] = self.problem.hypothesis.nominal[at_home]
        return replace(
            self,
            values=values,
            free=free,
            errors=self.problem.errors(values[None])[:, 0],
            columns=self.columns[:, ~gone],
            pull=self.problem.pull(values[None])[:, 0],
            pull_columns=self.pull_columns[:, ~gone],
            damped=None if self.damped is None else self.damped[~gone],
        )

    def step(self, windows: Mask, held: Mask, ridge: float = RIDGE) -> Array:
        """Solution of some windows with some of the free parameters held at the given model's. All parameters."""
        h = self.problem.hypothesis
        out, scale = self.values.copy(), h.scale[self.free]
        move = self.move(windows, held, ridge)
        out[self.free] = np.clip(out[self.free] + move * scale, h.bounds[0][self.free], h.bounds[1][self.free])
        return out

    def move(self, windows: Mask, held: Mask, ridge: float = RIDGE) -> Array:
        """The move of the free parameters that those windows ask for, in units of their scale. Shape (P,).

        A larger ridge shortens it, but not what makes up for those that are held.
        """
        h = self.problem.hypothesis
        scale, start = h.scale[self.free], self.values[self.free]
        low, high = ((side[self.free] - start) / scale for side in h.bounds)
        home = (h.nominal[self.free] - start) / scale
        low, high = np.where(held, home, low), np.where(held, home, high)
        share, columns = float(np.mean(windows)), self.pull_columns
        n = self.normal[windows].sum(0) + share * columns.T @ columns
        hidden = _hidden(np.diag(n), int(windows.sum())) & ~held
        low, high = np.where(hidden, 0.0, low), np.where(hidden, 0.0, high)
        size, right = np.diag(n), self.right[windows].sum(0) + share * columns.T @ self.pull
        instead = np.zeros(len(n))
        if held.any() and ridge > RIDGE:
            instead = bounded_least_squares(n + RIDGE * np.diag(size), instead, low, high)
        pull = (ridge if self.damped is None else np.where(self.damped, ridge, RIDGE)) * size
        return bounded_least_squares(n + np.diag(pull), pull * instead - right, low, high)


def linearise(problem: Problem, x: Array, free: Mask) -> Linearised:
    """Finite differences about values (P,), into the bounds, in the problem's own steps."""
    begin = time.monotonic()
    errors = problem.errors(_about(problem, x, free))
    return _by_differences(problem, x, free, errors[:, 0], errors, begin)


def linearise_roughly(problem: Problem, x: Array, free: Mask) -> Linearised:
    """:func:`linearise`, with the slopes of the windows in longer steps if the problem has such, many times as quick.

    They are a few per cent off where a parameter moves much, and tens where it hardly does: good enough for a step, of
    which the errors tell whether it helps, but for no interval.
    """
    if not problem.slope_windows:
        return linearise(problem, x, free)
    begin = time.monotonic()
    errors = problem.errors(x[None])[:, 0]
    once = time.monotonic() - begin
    around = replace(problem, windows=problem.slope_windows).errors(_about(problem, x, free))
    near = _by_differences(problem, x, free, errors, around, begin)
    return replace(near, seconds=near.seconds + STEPS * len(DAMPING) * once)  # steps by it take longer than it did


def _about(problem: Problem, x: Array, free: Mask) -> Array:
    """Values (P,), and those with one of the free parameters moved. Shape (1 + F, P)."""
    values = np.repeat(x[None], int(free.sum()) + 1, axis=0)
    values[1:, free] += np.diag(_differences(problem, x, free) * problem.hypothesis.scale[free])
    return values


def _differences(problem: Problem, x: Array, free: Mask) -> Array:
    """How far each of the free parameters is moved, into its bounds, in units of its scale. Shape (F,)."""
    h = problem.hypothesis
    return np.where(x[free] + FINITE * h.scale[free] > h.bounds[1][free], -FINITE, FINITE)


def _by_differences(problem: Problem, x: Array, free: Mask, errors: Array, around: Array, begin: float) -> Linearised:
    """A problem about values (P,) with errors (N,), by the errors (N, 1 + F) of :func:`_about`."""
    pull, step = problem.pull(_about(problem, x, free)), _differences(problem, x, free)
    columns, pull_columns = ((y[:, 1:] - y[:, :1]) / step for y in (around, pull))
    return Linearised(problem, x, free, errors, columns, pull[:, 0], pull_columns, time.monotonic() - begin)
