"""The search for the standard joints' numbers, in simulation: several starts, growing horizons, one least squares.

What is minimised is the error that is stated, over windows of half a second. A search never ends worse than it began:
the given model is one of its starts.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from torchrl_athletic.diagnosis.compare import well_started
from torchrl_athletic.diagnosis.deadline import Deadline
from torchrl_athletic.diagnosis.fit import WINDOW, Hypothesis, draw_windows
from torchrl_athletic.diagnosis.replay import Take, Windows, simulate
from torchrl_athletic.diagnosis.screen import bounded_least_squares
from torchrl_athletic.diagnosis.standard import Agreement

Array = NDArray[np.float64]
Mask = NDArray[np.bool_]

HORIZONS = (0.1, 0.2)
"""Windows of the searches that forgive a poor start, before those of :data:`WINDOW` [s]."""
SEARCHED = 24
"""Windows of those searches."""
COMPARED = 40
"""Windows of half a second by which the best of their ends are compared and improved."""
KEPT = (4, 2)
"""Starts that go on to each further horizon."""
SLOPES = (2, 2, 3)
"""Jacobians for each start at those horizons, at half a second, and for the best of them at the end."""
STEPS = 5
"""Steps by one Jacobian, which each of them mends (Broyden 1965)."""
DAMPING = (0.0, 1e-3, 1e-2, 1e-1, 1.0, 10.0)
"""Damping of the steps that are tried at once (Levenberg, Marquardt), per the normal equations' diagonal [1]."""
HIDDEN = 2e-4
"""Change of a window's error, in typical errors, that a unit of a parameter must make to be moved [1]."""
FLAT = 1e-3
"""Share of the cost that a step or a Jacobian must save to go on [1]."""
GRAIN = 0.005
"""Between samples of a window that are compared [s]: half a second holds no faster motion worth it."""
AT_ONCE = 200
"""Windows simulated at a time: bounds the memory."""
WORK = 5e6
"""Physics steps of all windows, parameters and joints that one Jacobian may cost; more windows are thinned."""
SHARE = 0.02
"""Share of a time budget that one Jacobian may take [1]."""
FEWEST, MOST = 20, 400
"""Windows of a fit at least, if there are so many, and at most."""
ENOUGH = 60
"""Windows of half a second; fewer are made up by some that overlap."""
TUNING = 3.0
"""Typical errors at which a window weighs half."""
WILD = 0.25
"""Share of the windows that say nothing of what a typical error is [1]."""
FOLDS = 4
"""Parts of the recordings, each of which is kept aside once."""
WORTH = 0.005
"""Share of the squared error below which no parameter is worth having [1]."""
DOUBT = 0.5
"""Standard errors by which a parameter has to help where it was not fitted [1]."""
GAIN = 0.02
"""Share of the error of folds that a law must save, to first order and in simulation [1]."""
SURE = 1.0
"""Standard errors by which it must help [1]."""
SURE_WITHOUT = 2.0
"""Standard errors by which a fit must follow folds better that does without the torques: two are tried [1]."""
RIDGE = 1e-6
"""Pull towards the solution where windows say nothing, per what they say [1]."""
TORQUES = 0.02
"""Share of a joint's squared error that it is worth to halve the unexplained variance of its torque [1]."""
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
    """Weight of each window [1]. Shape (W,)."""
    tuning: float = TUNING
    """Typical errors at which a window weighs half [1]; infinite for plain least squares."""
    pooled: bool = False
    """Whether all joints have one unit, as they have in an error that is stated of all."""
    torques: Agreement | None = None
    """What the torques say of the parameters; a fit pays for contradicting them."""

    def pull(self, values: Array) -> Array:
        """Rows that the least squares has beside the windows'. Shape (R, K) for values (K, P)."""
        if self.torques is None:
            return np.zeros((0, len(values)))
        return np.sqrt(TORQUES * len(self.weight)) * self.torques.rows(values)

    def charge(self, values: Array) -> Array:
        """What those rows add to the mean cost of a window and joint. Shape (K,) for values (K, P)."""
        return np.asarray((self.pull(values) ** 2).sum(0) / (len(self.weight) * len(self.unit)), dtype=np.float64)

    def predict(self, values: Array) -> Iterator[tuple[Windows, Array]]:
        """Errors of blocks of windows, thinned. Shapes (K, W, length, J) for values (K, P)."""
        for w in self.windows:
            every = max(1, round(GRAIN / w.take.period))
            for first in range(0, len(w.start), AT_ONCE):
                block = replace(w, start=w.start[first : first + AT_ONCE])
                error = simulate(block, self.hypothesis.build, values) - block.measured
                yield block, error[:, :, every - 1 :: every]

    def mean_square(self, values: Array) -> Array:
        """Mean square error of each window and joint [rad², m²]. Shape (K, W, J) for values (K, P)."""
        return np.concatenate([(error**2).mean(2) for _, error in self.predict(values)], axis=1)

    def errors(self, values: Array) -> Array:
        """Such that their squares sum up to :meth:`mean_square`. Shape (N, K) for values (K, P)."""
        parts = [(e / np.sqrt(e.shape[2])).reshape(len(values), -1) for _, e in self.predict(values)]
        return np.concatenate(parts, axis=1).T

    @cached_property
    def motion(self) -> Array:
        """Mean square distance from where a window begins: its error where nothing moves [rad², m²]. Shape (W, J)."""
        return np.concatenate([((w.measured - w.take.measured[w.start][:, None]) ** 2).mean(1) for w in self.windows])

    @cached_property
    def window(self) -> NDArray[np.intp]:
        """Window of each row of the errors; those of a window follow each other. Shape (N,)."""
        joints, sizes = len(self.unit), []
        for w in self.windows:
            every = max(1, round(GRAIN / w.take.period))
            sizes += [len(range(every - 1, w.length, every)) * joints] * len(w.start)
        return np.repeat(np.arange(len(sizes)), sizes)

    @property
    def row_weight(self) -> Array:
        """What each row of the errors is multiplied by for the least squares. Shape (N,)."""
        return np.asarray(np.sqrt(self.weight[self.window]) / np.tile(self.unit, len(self.window) // len(self.unit)))

    def squares(self, errors: Array) -> Array:
        """Mean squares, shape (W, J), of errors (N,)."""
        first = np.flatnonzero(np.diff(self.window, prepend=-1))
        rows = (errors.reshape(-1, len(self.unit))) ** 2
        return np.asarray(np.add.reduceat(rows, first // len(self.unit), axis=0), dtype=np.float64)


def problem_of(
    h: Hypothesis,
    takes: Sequence[Take],
    seconds: float,
    most: int,
    rng: np.random.Generator,
    x: Array,
    torques: Agreement | None = None,
) -> Problem:
    """Windows of some length, each started where its state is known best, weighed by how values (P,) follow them."""
    windows = [well_started(w) for w in draw_windows(takes, seconds, most, rng)]
    if seconds == WINDOW and (few := sum(len(w.start) for w in windows)) < min(ENOUGH, most):
        windows = [_overlapping(w, -(-min(ENOUGH, most) // few)) for w in windows]
    count = sum(len(w.start) for w in windows)
    unit = np.ones(len(takes[0].address.dof))
    return weighed(Problem(h, tuple(windows), unit, np.ones(count), torques=torques), x)


def weighed(problem: Problem, x: Array) -> Problem:
    """Count errors in units of the joints' typical ones, and weigh less what the model cannot follow, a fall or chaos.

    Cauchy weights (Holland, Welsch 1977) of whole windows; none for plain least squares.
    """
    return in_units(problem, problem.mean_square(x[None])[0])


def in_units(problem: Problem, square: Array) -> Problem:
    """:func:`weighed` by mean squares (W, J)."""
    usual = square.mean(0) if np.isinf(problem.tuning) else typical(problem, square)
    unit = np.sqrt(np.maximum(np.full_like(usual, usual.mean()) if problem.pooled else usual, 1e-18))
    ratio = (square / unit**2).mean(1)
    return replace(problem, unit=unit, weight=1.0 / (1.0 + ratio / problem.tuning**2))


def typical(problem: Problem, square: Array) -> Array:
    """Mean square error of the windows that are followed best, of all but :data:`WILD`. Shape (..., J) of (..., W, J).

    A median would be that of standing still where most windows hold still, so that a joint that is stuck looks best. No
    window counts for more than its motion or the median: up to half of the windows may go astray.
    """
    count = square.shape[-2]
    most = np.maximum(problem.motion, np.median(square, axis=-2, keepdims=True))
    capped = np.sort(np.minimum(square, most), axis=-2)[..., : count - int(WILD * count), :]
    return np.asarray(capped.mean(-2), dtype=np.float64)


def window_cost(problem: Problem, square: Array) -> Array:
    """What a problem's weights minimise, of each window [1]. Shape (K, W) for mean squares (K, W, J)."""
    ratio = (square / problem.unit**2).mean(2)
    return np.asarray(
        ratio if np.isinf(problem.tuning) else problem.tuning**2 * np.log1p(ratio / problem.tuning**2),
        dtype=np.float64,
    )


def more_telling(near: Linearised, deadline: Deadline) -> Linearised:
    """The solution of whichever weights follow folds best that it was not fitted to: the weighed one, or a plain one.

    What is asked is the error that is stated. Plain least squares minimises it where a few wild windows do not lead it
    astray, joint by joint or of all joints together; folds tell. Where it ends, the weighed one begins once more: it
    may have been stuck where it took for wild what can be followed.
    """
    problem, best, least = near.problem, near, stated(near)
    plain = replace(problem, tuning=np.inf)
    others = [plain] if len(problem.unit) == 1 else [plain, replace(plain, pooled=True)]
    for other in others:
        start = best
        for way, slopes in ((other, 1), (problem, SLOPES[2])):
            if not deadline.allows((2 + slopes) * near.seconds):
                break
            way = in_units(way, problem.squares(start.errors))
            x = descend(way, start.values, near.free, slopes, deadline, start)
            start = trusted(linearise(weighed(way, x), x, near.free))
            if (error := stated(start)) < least:
                best, least = start, error
    return best


def without_torques(near: Linearised, deadline: Deadline) -> Linearised:
    """The solution that the torques have no say in, where it follows folds that it was not fitted to better.

    A servo whose gain, delay and limit are not as given asks for other torques than its law with the given ones does.
    It has to save as much as a new law would, and more surely: torques keep a simulation from coasting. Both are
    compared with the larger ridge of the two, or the one whose folds hardly move would be judged by what it was fitted
    to.
    """
    problem, best, start = near.problem, near, near
    if problem.torques is None:
        return near
    alone = replace(problem, torques=None, tuning=TUNING, pooled=False)
    for way in (replace(alone, tuning=np.inf), alone):
        if not deadline.allows((1 + SLOPES[2]) * near.seconds):
            break
        start = replace(start, pull=start.pull[:0], pull_columns=start.pull_columns[:0])
        way = in_units(way, problem.squares(start.errors))
        x = descend(way, start.values, near.free, SLOPES[2], deadline, start)
        start = trusted(linearise(weighed(way, x), x, near.free))
        ridge = max(best.ridge, start.ridge)
        if follows_better(replace(best, ridge=ridge), replace(start, ridge=ridge), SURE_WITHOUT):
            best = start
    return best


def follows_better(near: Linearised, other: Linearised, sure: float = SURE) -> bool:
    """Whether another fit of the same windows has less of the error that is stated, and by more than it is in doubt."""
    count = independent(near.problem)
    return gain_of(stated_of_windows(near), stated_of_windows(other), count, GAIN / 2, sure) > 0


def gain_of(before: Array, after: Array, count: int, least: float = GAIN, sure: float = SURE) -> float:
    """Share of the windows' cost (W,) that is saved; nothing where it is in doubt, as where one window alone saves it.

    Args:
        before: Cost of each window.
        after: Cost of each window.
        count: Windows that are independent of each other.
        least: Share that it must save [1].
        sure: Standard errors by which it must [1].
    """
    if count < 2:
        return 0.0
    saved = before - after
    doubt = float(saved.std(ddof=1)) / np.sqrt(count)
    gain = float(saved.mean())
    return gain / float(before.mean()) if gain > max(least * float(before.mean()), sure * doubt) else 0.0


def stated(near: Linearised) -> float:
    """Mean square error of folds by what the others say, all joints together."""
    return float(stated_of_windows(near).mean())


def stated_of_windows(near: Linearised) -> Array:
    """That error of each window. Shape (W,)."""
    nothing = np.zeros(int(near.free.sum()), dtype=bool)
    return np.asarray(folded(near, [nothing], folds_of(near.problem))[0].mean(1), dtype=np.float64)


def independent(problem: Problem) -> int:
    """The most windows of which no two overlap: as many as a standard error may count."""
    count = 0
    for w in problem.windows:
        end = -1
        for start in np.sort(w.start):
            if start >= end:
                count, end = count + 1, int(start) + w.length
    return count


def tellings(problem: Problem) -> float:
    """Windows in which a sample is seen, the mean over all windows' samples: 1 where none overlap."""
    shared = [np.clip(1.0 - np.abs(w.start[:, None] - w.start) / w.length, 0.0, 1.0).sum() for w in problem.windows]
    return float(np.sum(shared) / sum(len(w.start) for w in problem.windows))


def _overlapping(w: Windows, times: int) -> Windows:
    """Add windows that start between the given ones, so that no window's start weighs much."""
    shifts = w.length * np.arange(times) // times
    starts = np.unique(w.start[:, None] + shifts)
    ends = np.append(w.take.begins[1:], len(w.take.time))
    last = ends[np.searchsorted(w.take.begins, starts, side="right") - 1] - 1
    return Windows(w.take, starts[starts + w.length <= last], w.length)


def affordable(h: Hypothesis, takes: Sequence[Take], deadline: Deadline) -> int:
    """Windows of half a second that one Jacobian can afford; of a time budget, by what a few of them take."""
    steps = WINDOW / float(takes[0].model.opt.timestep)
    joints = len(takes[0].address.dof)
    free = int((h.bounds[1] > h.bounds[0]).sum()) + 1
    count = WORK / (steps * joints * free)
    if np.isfinite(deadline.seconds):
        tried = problem_of(h, takes, WINDOW, 10, np.random.default_rng(0), h.nominal)
        begin = time.monotonic()
        tried.mean_square(np.repeat(h.nominal[None], free, axis=0))
        each = (time.monotonic() - begin) / max(len(tried.weight), 1)
        count = min(count, SHARE * deadline.seconds / each)
    return int(np.clip(count, FEWEST, MOST))


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
        near = first if first is not None and not k else linearise(problem, x, free)
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


def search(
    h: Hypothesis,
    takes: Sequence[Take],
    begin: Array,
    rng: np.random.Generator,
    deadline: Deadline,
    torques: Agreement | None = None,
    most: int = MOST,
    progress: Callable[[float], None] = lambda fraction: None,
) -> Linearised:
    """Fit from several starts, over growing horizons.

    Args:
        h: What may change.
        takes: Recordings.
        begin: Starts, of which the first is the given model. Shape (K, P).
        rng: Draws windows.
        deadline: When to come to an end.
        torques: What they say of the parameters.
        most: Windows of half a second at most.
        progress: Told the finished fraction.

    Returns:
        The problem of the stated error about its solution.
    """
    free = h.bounds[1] > h.bounds[0]
    count = min(affordable(h, takes, deadline), most)
    full = problem_of(h, takes, WINDOW, count, rng, begin[0], torques)
    few = problem_of(h, takes, WINDOW, COMPARED, rng, begin[0], torques) if count > COMPARED else full
    points = list(begin)
    for horizon, (seconds, kept) in enumerate(zip(HORIZONS, KEPT, strict=True)):
        problem = problem_of(h, takes, seconds, SEARCHED, rng, points[0], torques)
        if not horizon:
            half = kept // 2  # short windows forgive, and like what coasts; long ones know what is right already
            points = [p for q in (problem, few) for p in _mixed(q, q.mean_square(begin), begin, half)]
        ends = [descend(weighed(problem, x), x, free, SLOPES[0], deadline.part(0.3)) for x in points]
        points = best_of(few, [*ends, *points, *begin[:2]], kept)
        progress((horizon + 1) / 4)
    ends = [descend(weighed(few, x), x, free, SLOPES[1], deadline.part(0.5)) for x in points]
    progress(0.7)
    x = best_of(full, [*ends, *points], 1)[0]
    x = descend(weighed(full, x), x, free, SLOPES[2], deadline.part(0.7))
    near = trusted(linearise(weighed(full, x), x, free))
    progress(0.9)
    return without_torques(more_telling(near, deadline), deadline)


def _mixed(problem: Problem, square: Array, begin: Array, count: int) -> list[Array]:
    """Starts in which each joint has its own best numbers, its second best, and so on."""
    joint = np.array([c.joint for c in problem.hypothesis.terms for _ in c.parameters])
    order = np.argsort(typical(problem, square), axis=0)  # (K, J)
    return [begin[order[rank, joint], np.arange(len(joint))] for rank in range(min(count, len(begin)))]


def best_of(problem: Problem, points: Sequence[Array], count: int) -> list[Array]:
    """Those of the least robust error, none twice."""
    distinct = list({tuple(x): x for x in points}.values())
    square = problem.mean_square(np.stack(distinct))
    unit = np.sqrt(np.maximum(typical(problem, square).min(0), 1e-18))
    cost = window_cost(replace(problem, unit=unit), square).mean(1)
    cost = cost + problem.charge(np.stack(distinct))
    return [distinct[k] for k in np.argsort(cost)[:count]]


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


def linearise(problem: Problem, x: Array, free: Mask) -> Linearised:
    """Finite differences about values (P,), into the bounds."""
    begin = time.monotonic()
    h, step = problem.hypothesis, FINITE
    scale = h.scale[free]
    sign = np.where(x[free] + step * scale > h.bounds[1][free], -1.0, 1.0)
    values = np.repeat(x[None], int(free.sum()) + 1, axis=0)
    values[1:, free] += np.diag(sign * step * scale)
    e, pull = problem.errors(values), problem.pull(values)
    columns, pull_columns = ((y[:, 1:] - y[:, :1]) / (sign * step) for y in (e, pull))
    return Linearised(problem, x, free, e[:, 0], columns, pull[:, 0], pull_columns, time.monotonic() - begin)


def trusted(near: Linearised) -> Linearised:
    """With the least ridge by which a step from the solution, asked for by all folds but one, does those folds good.

    Far from the solution a simulation is not linear, so that a long step is no fit of the windows that ask for it, and
    says nothing of the one that is kept aside.
    """
    fold, nothing = folds_of(near.problem), np.zeros(int(near.free.sum()), dtype=bool)
    for ridge in (RIDGE, *DAMPING[1:]):
        near = replace(near, ridge=ridge)
        if all(_does_good(near, fold != k, near.step(fold != k, nothing)) for k in np.unique(fold)):
            break
    return near


def _does_good(near: Linearised, windows: Mask, x: Array) -> bool:
    """Whether some windows, weighed as they were, do not follow worse by values (P,) than by the solution."""
    part = part_of(near.problem, windows)
    both = np.stack([near.values, x])
    square = np.stack([near.problem.squares(near.errors)[windows], part.mean_square(x[None])[0]])
    cost = (part.weight[:, None] * square / part.unit**2).sum((1, 2)) + (part.pull(both) ** 2).sum(0)
    return bool(cost[1] <= cost[0])


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


def prune(near: Linearised, deadline: Deadline, progress: Callable[[float], None] = lambda fraction: None) -> Mask:
    """Which parameters folds that are kept aside ask for; the others are held at the given model's. Shape (P,), of all.

    Backwards: of each joint the parameter goes whose absence costs least to first order, as long as folds that were
    kept aside allow it: their stated error must not rise, and the weighed one by less than its own uncertainty. The
    fits without a fold and without a parameter are one bounded Gauss-Newton step from the solution; their errors are
    simulated.
    """
    problem, fold = near.problem, folds_of(near.problem)
    index = np.flatnonzero(near.free)
    joint = np.array([c.joint for c in problem.hypothesis.terms for _ in c.parameters])[index]
    held, asking = np.zeros(len(index), dtype=bool), np.ones(len(index), dtype=bool)
    now = folded(near, [held], fold)
    ways, count = (replace(problem, tuning=np.inf), problem), independent(problem)
    least = [window_cost(way, now)[0] for way in ways]
    seconds = 0.0
    while (asking & ~held).any() and deadline.allows(1.3 * seconds):
        begin = time.monotonic()
        left = np.flatnonzero(asking & ~held)
        one = [held | (np.arange(len(index)) == k) for k in left]
        guess = window_cost(problem, folded(near, one, fold, first_order=True)).mean(1)
        chosen = [left[joint[left] == j][np.argmin(guess[joint[left] == j])] for j in np.unique(joint[left])]
        trials = [one[int(np.flatnonzero(left == k)[0])] for k in chosen]
        trials += [np.logical_or.reduce(trials)] if len(trials) > 1 else []
        square = folded(near, trials, fold)
        allowed, cost = np.ones(len(trials), dtype=bool), np.zeros(len(trials))
        for k, way in enumerate(ways):
            error = window_cost(way, square)  # (trials, W)
            least[k] = min((least[k], *error), key=lambda e: float(e.mean()))
            rise = error - least[k]
            cost, doubt = rise.mean(1), rise.std(1) / np.sqrt(count)
            allowed &= cost <= np.maximum(DOUBT * k * doubt, WORTH * least[k].mean())
        alone = np.flatnonzero(allowed[: len(chosen)])
        if allowed[-1]:
            held = trials[-1]
        elif len(alone):
            held = trials[alone[np.argmin(cost[alone])]]
        asking &= ~np.isin(joint, joint[[k for n, k in enumerate(chosen) if not allowed[n]]])
        progress(float((held | ~asking).mean()))
        seconds = time.monotonic() - begin
    needed = np.zeros(len(near.free), dtype=bool)
    needed[index[~held]] = True
    return needed


def folded(near: Linearised, trials: Sequence[Mask], fold: NDArray[np.intp], first_order: bool = False) -> Array:
    """Mean square error of each window by what the other folds say [rad², m²]. Shape (trials, W, J).

    Args:
        near: About the solution of all folds.
        trials: Which of the free parameters are held at the given model's. Shapes (P,).
        fold: Of each window. Shape (W,).
        first_order: Whether the errors are those of the Jacobian, and not simulated.
    """
    problem = near.problem
    out = np.empty((len(trials), len(fold), len(problem.unit)))
    for k in np.unique(fold):
        others = apart_from(problem, fold == k)
        if first_order:
            rows = np.isin(problem.window, np.flatnonzero(fold == k))
            for n, held in enumerate(trials):
                errors = np.zeros(len(rows))
                errors[rows] = near.errors[rows] + near.columns[rows] @ near.move(others, held)
                out[n, fold == k] = problem.squares(errors)[fold == k]
        else:
            values = np.stack([near.step(others, held) for held in trials])
            out[:, fold == k] = part_of(problem, fold == k).mean_square(values)
    return out


def apart_from(problem: Problem, aside: Mask) -> Mask:
    """Windows that share no sample with those that are kept aside; all others where none is so far away. Shape (W,)."""
    apart, first = ~aside, 0
    for w in problem.windows:
        own = slice(first, first + len(w.start))
        first = own.stop
        far = np.abs(w.start[:, None] - w.start[aside[own]]) >= w.length
        apart[own] &= far.all(axis=1)
    return apart if apart.any() else ~aside


def evenly(problem: Problem, count: int) -> Mask:
    """So many of the windows, evenly over all of them. Shape (W,)."""
    chosen = np.zeros(len(problem.weight), dtype=bool)
    chosen[np.linspace(0, len(chosen) - 1, min(count, len(chosen))).astype(int)] = True
    return chosen


def part_of(problem: Problem, chosen: Mask) -> Problem:
    """Some of the windows."""
    windows, first = [], 0
    for w in problem.windows:
        keep = chosen[first : first + len(w.start)]
        first += len(w.start)
        if keep.any():
            windows.append(replace(w, start=w.start[keep]))
    return replace(problem, windows=tuple(windows), weight=problem.weight[chosen])
