"""Windows of recordings to follow in simulation, and what an error in each of them weighs."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from torchrl_athletic.diagnosis.compare import doubt_of_starts, well_started
from torchrl_athletic.diagnosis.fit import WINDOW, Hypothesis, draw_windows
from torchrl_athletic.diagnosis.replay import Take, Windows, motion_of, simulate
from torchrl_athletic.diagnosis.standard import Agreement

Array = NDArray[np.float64]
Mask = NDArray[np.bool_]

GRAIN = 0.005
"""Between samples of a window that are compared [s]: half a second holds no faster motion worth it."""
AT_ONCE = 200
"""Windows simulated at a time: bounds the memory."""
ENOUGH = 100
"""Windows of half a second, which overlap where logs hold less than half as many."""
VAGUE = 2.0
"""Noise of a start, per the typical one, from which on no overlapping window begins there, as at a log's ends [1]."""
TUNING = 3.0
"""Typical errors at which a window weighs half."""
WILD = 0.25
"""Share of the windows that say nothing of what a typical error is [1]."""
RESTS = 0.1
"""Motion in a window, per the root mean square of all, below which a joint rests [1]."""
FOLDS = 4
"""Parts of the recordings, each of which is kept aside once."""
TORQUES = 0.02
"""Share of a joint's squared error that it is worth to halve the unexplained variance of its torque [1]."""


def compared_every(take: Take) -> int:
    """Of how many samples of a take one is compared, such that these are about :data:`GRAIN` apart."""
    return max(1, round(GRAIN / take.period - 1e-6))  # at 500 Hz 2, whatever the last digit of the period


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
    slope_windows: tuple[Windows, ...] = ()
    """The same windows in longer physics steps, in which a descent takes slopes; in their own if there are none."""

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
            every = compared_every(w.take)
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
        return motion_of(self.windows)

    @cached_property
    def window(self) -> NDArray[np.intp]:
        """Window of each row of the errors; those of a window follow each other. Shape (N,)."""
        joints, sizes = len(self.unit), []
        for w in self.windows:
            every = compared_every(w.take)
            sizes += [len(range(every - 1, w.length, every)) * joints] * len(w.start)
        return np.repeat(np.arange(len(sizes)), sizes)

    @cached_property
    def first(self) -> NDArray[np.intp]:
        """First row of each window in the errors. Shape (W,)."""
        return np.flatnonzero(np.diff(self.window, prepend=-1))

    @property
    def row_weight(self) -> Array:
        """What each row of the errors is multiplied by for the least squares. Shape (N,)."""
        return np.asarray(np.sqrt(self.weight[self.window]) / np.tile(self.unit, len(self.window) // len(self.unit)))

    def squares(self, errors: Array) -> Array:
        """Mean squares, shape (W, J), of errors (N,)."""
        rows = (errors.reshape(-1, len(self.unit))) ** 2
        return np.asarray(np.add.reduceat(rows, self.first // len(self.unit), axis=0), dtype=np.float64)


def problem_of(
    h: Hypothesis,
    takes: Sequence[Take],
    seconds: float,
    most: int,
    rng: np.random.Generator,
    x: Array,
    torques: Agreement | None = None,
    tuning: float = TUNING,
) -> Problem:
    """Windows of some length, weighed by how values (P,) follow them.

    Each starts where its state is known best; where they overlap, evenly.
    """
    windows, wanted = draw_windows(takes, seconds, most, rng), min(ENOUGH, most)
    if seconds == WINDOW and 2 * (few := sum(len(w.start) for w in windows)) < wanted:
        windows = [_overlapping(w, round(len(w.start) * wanted / few)) for w in windows]
    else:
        windows = [well_started(w) for w in windows]
    count = sum(len(w.start) for w in windows)
    unit = np.ones(len(takes[0].address.dof))
    return weighed(Problem(h, tuple(windows), unit, np.ones(count), tuning, torques=torques), x)


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

    Of a joint those count in which it moves: a gripper that rests in four windows of five is told by the fifth. A
    median would be that of standing still where most windows hold still, so that a joint that is stuck looks best. No
    window counts for more than its motion or the median: up to half of the windows may go astray.
    """
    moves = problem.motion > RESTS**2 * problem.motion.mean(-2)
    moves |= ~moves.any(0)
    most = np.maximum(problem.motion, np.median(square, axis=-2, keepdims=True))
    capped = np.sort(np.where(moves, np.minimum(square, most), np.inf), axis=-2)
    count = moves.sum(0)
    best = np.arange(square.shape[-2])[:, None] < count - (WILD * count).astype(int)
    return np.asarray(np.where(best, capped, 0.0).sum(-2) / best.sum(0), dtype=np.float64)


def window_cost(problem: Problem, square: Array) -> Array:
    """What a problem's weights minimise, of each window [1]. Shape (K, W) for mean squares (K, W, J)."""
    ratio = (square / problem.unit**2).mean(2)
    return np.asarray(
        ratio if np.isinf(problem.tuning) else problem.tuning**2 * np.log1p(ratio / problem.tuning**2),
        dtype=np.float64,
    )


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


def _overlapping(w: Windows, count: int) -> Windows:
    """About so many windows in place of those back to back, evenly, so that no window's start weighs much."""
    ends = np.append(w.take.begins[1:], len(w.take.time))
    places = np.concatenate([np.arange(*p) for p in zip(w.take.begins, ends - w.length, strict=True)])
    known = places[doubt_of_starts(w.take)[places] < VAGUE]
    places = known if len(known) else places
    return replace(w, start=places[np.linspace(0, len(places) - 1, min(count, len(places))).astype(int)])


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
    return replace(problem, windows=tuple(windows), weight=problem.weight[chosen], slope_windows=())
