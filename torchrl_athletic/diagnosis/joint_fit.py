"""The search for the standard joints' numbers, in simulation: several starts, growing horizons, one least squares.

What is minimised is the error that is stated, over windows of half a second, joint by joint in units of what it was. A
search never ends worse than it began: the given model is one of its starts.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace

import numpy as np
from mujoco import minimize
from numpy.typing import NDArray

from torchrl_athletic.diagnosis.compare import well_started
from torchrl_athletic.diagnosis.fit import WINDOW, Hypothesis, draw_windows
from torchrl_athletic.diagnosis.replay import Take, Windows, simulate
from torchrl_athletic.diagnosis.screen import bounded_least_squares

Array = NDArray[np.float64]

HORIZONS = (0.1, 0.2)
"""Windows of the searches that forgive a poor start, before those of :data:`WINDOW` [s]."""
SEARCHED = 24
"""Windows of those searches."""
STEPS = (5, 5, 8, 15)
"""Gauss-Newton iterations for each horizon, for that of :data:`WINDOW`, and for the best of them."""
KEPT = (4, 2)
"""Starts that go on to each further horizon."""
GRAIN = 0.005
"""Between samples of a window that are compared [s]: half a second holds no faster motion worth it."""
AT_ONCE = 200
"""Windows simulated at a time: bounds the memory."""
WORK = 6e5
"""Physics steps of all windows, parameters and joints that one Jacobian may cost; more windows are thinned."""
FEWEST, MOST = 40, 400
"""Windows of a fit at least, if there are so many, and at most."""
ENOUGH = 60
"""Windows of half a second; fewer are made up by some that overlap."""
TUNING = 3.0
"""Typical errors at which a window weighs half."""
FOLDS = 4
"""Parts of the recordings, each of which is kept aside once."""
WORTH = 0.005
"""Share of the squared error below which no parameter is worth having [1]."""
DOUBT = 0.5
"""Standard errors by which a parameter has to help where it was not fitted [1]."""
RIDGE = 1e-6
"""Pull towards the solution where windows say nothing, per what they say [1]."""
FINITE = 1e-2
"""Step of the finite differences, in units of a parameter [1]."""


@dataclass(frozen=True, eq=False)
class Problem:
    """Windows to follow, and what an error of each joint weighs."""

    hypothesis: Hypothesis
    windows: tuple[Windows, ...]
    unit: Array
    """Errors of the joints that count as one [rad, m]. Shape (J,)."""
    weight: Array
    """Of each window [1]. Shape (W,)."""
    tuning: float = TUNING
    """Typical errors at which a window weighs half [1]; infinite for plain least squares."""

    def predict(self, values: Array) -> Iterator[tuple[Windows, Array]]:
        """Errors of blocks of windows, thinned. Shapes (K, W, length, J) for values (K, P)."""
        for w in self.windows:
            every = max(1, round(GRAIN / w.take.period))
            for first in range(0, len(w.start), AT_ONCE):
                block = replace(w, start=w.start[first : first + AT_ONCE])
                error = simulate(block, self.hypothesis.build, values) - block.measured
                yield block, error[:, :, every - 1 :: every]

    def mean_square(self, values: Array) -> Array:
        """Of each window and joint [rad², m²]. Shape (K, W, J) for values (K, P)."""
        return np.concatenate([(error**2).mean(2) for _, error in self.predict(values)], axis=1)

    def residual(self, values: Array) -> Array:
        """Errors in units, each window's of the weight that its length gives it. Shape (N, K) for values (K, P)."""
        parts, first = [], 0
        for block, error in self.predict(values):
            weight = np.sqrt(self.weight[first : first + len(block.start)] / error.shape[2])
            parts.append((error / self.unit * weight[:, None, None]).reshape(len(values), -1))
            first += len(block.start)
        return np.concatenate(parts, axis=1).T

    def blocks(self) -> NDArray[np.intp]:
        """Window of each row of the residual. Shape (N,)."""
        sizes = []
        for w in self.windows:
            every = max(1, round(GRAIN / w.take.period))
            sizes += [len(range(every - 1, w.length, every)) * w.measured.shape[2]] * len(w.start)
        return np.repeat(np.arange(len(sizes)), sizes)

    def rmse(self, values: Array) -> Array:
        """Of each joint over all windows [rad, m]. Shape (K, J) for values (K, P)."""
        return np.asarray(np.sqrt(self.mean_square(values).mean(1)))


def problem_of(
    h: Hypothesis, takes: Sequence[Take], seconds: float, most: int, rng: np.random.Generator, x: Array
) -> Problem:
    """Windows of some length, each started where its state is known best, weighed by how values (P,) follow them."""
    windows = [well_started(w) for w in draw_windows(takes, seconds, most, rng)]
    if seconds == WINDOW and (few := sum(len(w.start) for w in windows)) < ENOUGH:
        windows = [_overlapping(w, -(-ENOUGH // few)) for w in windows]
    count = sum(len(w.start) for w in windows)
    return weighed(Problem(h, tuple(windows), np.ones(len(takes[0].address.dof)), np.ones(count)), x)


def weighed(problem: Problem, x: Array) -> Problem:
    """The same, in units of the joints' typical errors; what the model cannot follow, a fall or chaos, weighs less.

    Cauchy weights (Holland, Welsch 1977) of whole windows; none for plain least squares.
    """
    square = problem.mean_square(x[None])[0]
    typical = square.mean(0) if np.isinf(problem.tuning) else np.median(square, axis=0)
    unit = np.sqrt(np.maximum(typical, 1e-18))
    ratio = (square / unit**2).mean(1)
    return replace(problem, unit=unit, weight=1.0 / (1.0 + ratio / problem.tuning**2))


def window_cost(problem: Problem, square: Array) -> Array:
    """What a problem's weights minimise, of each window [1]. Shape (K, W) for mean squares (K, W, J)."""
    ratio = (square / problem.unit**2).mean(2)
    return np.asarray(
        ratio if np.isinf(problem.tuning) else problem.tuning**2 * np.log1p(ratio / problem.tuning**2),
        dtype=np.float64,
    )


def more_telling(problem: Problem, x: Array) -> tuple[Array, Problem]:
    """The weighed solution or that of plain least squares, whichever follows folds better that did not fit it.

    What is asked is the error that is stated. Plain least squares minimises it where a few wild windows do not lead it
    astray; folds tell.

    Args:
        problem: The weighed one.
        x: Its solution. Shape (P,).
    """
    free = problem.hypothesis.bounds[1] > problem.hypothesis.bounds[0]
    plain = weighed(replace(problem, tuning=np.inf), x)
    other = descend(plain, x, free, STEPS[-1])
    fold = folds_of(problem)
    nothing = np.zeros(int(free.sum()), dtype=bool)
    error = [
        (_folded(linearise(p, at, free), [nothing], fold)[0] / plain.unit**2).mean()
        for p, at in ((problem, x), (plain, other))
    ]
    return (other, weighed(plain, other)) if error[1] < error[0] else (x, problem)


def _overlapping(w: Windows, times: int) -> Windows:
    """The same and others that start between them, so that no window's start weighs much."""
    shifts = w.length * np.arange(times) // times
    starts = np.unique(w.start[:, None] + shifts)
    ends = np.append(w.take.begins[1:], len(w.take.time))
    last = ends[np.searchsorted(w.take.begins, starts, side="right") - 1] - 1
    return Windows(w.take, starts[starts + w.length <= last], w.length)


def affordable(h: Hypothesis, takes: Sequence[Take]) -> int:
    """Windows of half a second that one Jacobian can afford."""
    steps = WINDOW / float(takes[0].model.opt.timestep)
    joints = len(takes[0].address.dof)
    free = int((h.bounds[1] > h.bounds[0]).sum()) + 1
    return int(np.clip(WORK / (steps * joints * free), FEWEST, MOST))


def descend(problem: Problem, x: Array, free: NDArray[np.bool_], iterations: int) -> Array:
    """Bounded least squares from values (P,) over the free parameters; what is not free stays. Shape (P,).

    MuJoCo's box-constrained Gauss-Newton, with a Jacobian by finite differences: all columns are one batch.
    """
    if not free.any():
        return x
    low, high = (side[free] for side in problem.hypothesis.bounds)
    scale = problem.hypothesis.scale[free]

    def residual(z: Array) -> Array:
        values = np.repeat(x[None], z.shape[1], axis=0)
        values[:, free] = (z * scale[:, None]).T
        return problem.residual(values)

    z, _ = minimize.least_squares(
        x[free] / scale,
        residual,
        bounds=[low / scale, high / scale],
        eps=FINITE,
        max_iter=iterations,
        mu_factor=10**0.5,
        xtol=1e-3,
        verbose=minimize.Verbosity.SILENT,
    )
    out = x.copy()
    out[free] = np.clip(np.ravel(z) * scale, low, high)
    return out


def search(
    h: Hypothesis,
    takes: Sequence[Take],
    begin: Array,
    rng: np.random.Generator,
    progress: Callable[[float], None] = lambda fraction: None,
) -> tuple[Array, Problem]:
    """Fit from several starts, over growing horizons.

    Args:
        h: What may change.
        takes: Recordings.
        begin: Starts, of which the first is the given model. Shape (K, P).
        rng: Draws windows.
        progress: Told the finished fraction.

    Returns:
        Values, shape (P,), and the problem of the stated error that they solve.
    """
    free = h.bounds[1] > h.bounds[0]
    full = problem_of(h, takes, WINDOW, affordable(h, takes), rng, begin[0])
    points = list(begin)
    for horizon, (seconds, steps, kept) in enumerate(zip(HORIZONS, STEPS[:2], KEPT, strict=True)):
        problem = problem_of(h, takes, seconds, SEARCHED, rng, points[0])
        if not horizon:
            points = _mixed(h, problem.mean_square(begin), begin, kept)
        points = [descend(weighed(problem, x), x, free, steps) for x in points]
        points = _best(full, [*points, *begin[:2]], kept)
        progress((horizon + 1) / 4)
    ends = [descend(weighed(full, x), x, free, STEPS[2]) for x in points]
    progress(0.9)
    x = _best(full, [*ends, *points], 1)[0]
    x = descend(weighed(full, x), x, free, STEPS[-1])
    return more_telling(weighed(full, x), x)


def _mixed(h: Hypothesis, square: Array, begin: Array, count: int) -> list[Array]:
    """Starts in which each joint has its own best numbers, its second best, and so on."""
    joint = np.array([c.joint for c in h.terms for _ in c.parameters])
    order = np.argsort(np.median(square, axis=1), axis=0)  # (K, J)
    return [begin[order[rank, joint], np.arange(len(joint))] for rank in range(min(count, len(begin)))]


def _best(problem: Problem, points: Sequence[Array], count: int) -> list[Array]:
    """Those of the least robust error, none twice."""
    distinct = list({tuple(x): x for x in points}.values())
    square = problem.mean_square(np.stack(distinct))
    unit = np.sqrt(np.maximum(np.median(square, axis=1).min(0), 1e-18))
    cost = window_cost(replace(problem, unit=unit), square).mean(1)
    return [distinct[k] for k in np.argsort(cost)[:count]]


@dataclass(frozen=True, eq=False)
class Linearised:
    """A problem near its solution: each window's normal equations. P free parameters, in units of their scale."""

    problem: Problem
    values: Array
    """Solution, of all parameters."""
    free: NDArray[np.bool_]
    normal: Array
    """Shape (W, P, P)."""
    right: Array
    """Gradient of half the squared error. Shape (W, P)."""
    square: Array
    """Sum of squares. Shape (W,)."""
    rows: int
    """Of the residual."""

    def step(self, windows: NDArray[np.bool_], held: NDArray[np.bool_]) -> Array:
        """Solution of some windows with some of the free parameters held at the given model's. All parameters."""
        h = self.problem.hypothesis
        scale, start = h.scale[self.free], self.values[self.free]
        low, high = ((side[self.free] - start) / scale for side in h.bounds)
        home = (h.nominal[self.free] - start) / scale
        low, high = np.where(held, home, low), np.where(held, home, high)
        n = self.normal[windows].sum(0)
        n = n + RIDGE * np.diag(np.diag(n))
        out = self.values.copy()
        move = bounded_least_squares(n, -self.right[windows].sum(0), low, high)
        out[self.free] = np.clip(start + move * scale, h.bounds[0][self.free], h.bounds[1][self.free])
        return out


def linearise(problem: Problem, x: Array, free: NDArray[np.bool_]) -> Linearised:
    """Finite differences about values (P,), into the bounds."""
    h, step = problem.hypothesis, FINITE
    scale = h.scale[free]
    sign = np.where(x[free] + step * scale > h.bounds[1][free], -1.0, 1.0)
    values = np.repeat(x[None], int(free.sum()) + 1, axis=0)
    values[1:, free] += np.diag(sign * step * scale)
    r = problem.residual(values)
    jacobian, residual = (r[:, 1:] - r[:, :1]) / (sign * step), r[:, 0]
    first = np.flatnonzero(np.diff(problem.blocks(), prepend=-1))
    normal = np.stack([part.T @ part for part in np.split(jacobian, first[1:])])
    right = np.add.reduceat(jacobian * residual[:, None], first, axis=0)
    return Linearised(problem, x, free, normal, right, np.add.reduceat(residual**2, first), len(residual))


def folds_of(problem: Problem, count: int = FOLDS) -> NDArray[np.intp]:
    """Fold of each window: whole recordings where there are enough, else stretches of time. Shape (W,)."""
    parts, take, at = [], 0, []
    for w in problem.windows:
        piece = np.searchsorted(w.take.begins, w.start, side="right") - 1
        parts.append(take + piece)
        at.append(w.start)
        take += len(w.take.begins)
    part = np.concatenate(parts)
    names, part = np.unique(part, return_inverse=True)
    if len(names) >= count:
        size = np.bincount(part)
        fold, filled = np.zeros(len(names), dtype=np.intp), np.zeros(count)
        for k in np.argsort(-size):
            fold[k] = int(np.argmin(filled))
            filled[fold[k]] += size[k]
        return fold[part]
    order = np.lexsort((np.concatenate(at), part))
    out = np.empty(len(part), dtype=np.intp)
    out[order] = np.arange(len(part)) * count // len(part)
    return out


def prune(near: Linearised, progress: Callable[[float], None] = lambda fraction: None) -> NDArray[np.bool_]:
    """Which parameters folds that are kept aside ask for; the others are held at the given model's. Shape (P,), of all.

    Backwards: the parameter whose absence costs least goes first, one a joint at a time, as long as folds that were
    kept aside allow it: their stated error must not rise, and the weighed one by less than its own uncertainty. The
    fits without a fold and without a parameter are one bounded Gauss-Newton step from the solution; their errors are
    simulated.
    """
    h = near.problem.hypothesis
    fold = folds_of(near.problem)
    index = np.flatnonzero(near.free)
    joint = np.array([c.joint for c in h.terms for _ in c.parameters])[index]
    held = np.zeros(len(index), dtype=bool)
    best = [np.full(len(fold), np.inf)] * 2
    while not held.all():
        left = np.flatnonzero(~held)
        trials = [held, *(held | (np.arange(len(index)) == k) for k in left)]
        square = _folded(near, trials, fold)
        allowed, cost = np.ones(len(left), dtype=bool), np.zeros(len(left))
        for k, problem in enumerate((replace(near.problem, tuning=np.inf), near.problem)):
            error = window_cost(problem, square)  # (trials, W)
            best[k] = min((best[k], *error), key=lambda e: float(e.mean()))
            rise = error[1:] - best[k]
            cost, doubt = rise.mean(1), rise.std(1) / np.sqrt(len(fold))
            allowed &= cost <= np.maximum(DOUBT * k * doubt, WORTH * best[k].mean())
        if not allowed.any():
            break
        for j in np.unique(joint[left]):
            mine = np.flatnonzero((joint[left] == j) & allowed)
            if len(mine):
                held = held | (np.arange(len(index)) == left[mine[np.argmin(cost[mine])]])
        progress(float(held.mean()))
    needed = np.zeros(len(near.free), dtype=bool)
    needed[index[~held]] = True
    return needed


def _folded(near: Linearised, trials: Sequence[NDArray[np.bool_]], fold: NDArray[np.intp]) -> Array:
    """Mean square error of each window by what the other folds say [rad², m²]. Shape (trials, W, J)."""
    out = np.empty((len(trials), len(fold), len(near.problem.unit)))
    for k in np.unique(fold):
        values = np.stack([near.step(fold != k, held) for held in trials])
        out[:, fold == k] = _part(near.problem, fold == k).mean_square(values)
    return out


def _part(problem: Problem, chosen: NDArray[np.bool_]) -> Problem:
    windows, first = [], 0
    for w in problem.windows:
        keep = chosen[first : first + len(w.start)]
        first += len(w.start)
        if keep.any():
            windows.append(replace(w, start=w.start[keep]))
    return replace(problem, windows=tuple(windows), weight=problem.weight[chosen])
