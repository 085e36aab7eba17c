"""The search for the standard joints' numbers, in simulation: several starts, growing horizons, one least squares.

What is minimised is the error that is stated, over windows of half a second. The given model is one of the starts.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence
from dataclasses import replace
from functools import partial

import numpy as np
from numpy.typing import NDArray

from torchrl_athletic.diagnosis.deadline import Deadline
from torchrl_athletic.diagnosis.descent import DAMPING, FLAT, RIDGE, Linearised, descend, linearise
from torchrl_athletic.diagnosis.fit import WINDOW, Hypothesis
from torchrl_athletic.diagnosis.problem import (
    TUNING,
    Mask,
    Problem,
    apart_from,
    folds_of,
    in_units,
    independent,
    part_of,
    problem_of,
    typical,
    weighed,
    window_cost,
)
from torchrl_athletic.diagnosis.replay import Take
from torchrl_athletic.diagnosis.standard import Agreement

Array = NDArray[np.float64]

HORIZONS = (0.1, 0.2)
"""Windows of the searches that forgive a poor start, before those of :data:`WINDOW` [s]."""
SEARCHED = 24
"""Windows of those searches."""
IMPROVED = 40
"""Windows of half a second by which starts are compared, and the best of their ends improved."""
COMPARED = 100
"""Windows of half a second by which ends are compared."""
KEPT = (4, 2)
"""Starts that go on to each further horizon."""
CHEAP = 3
"""Times as many that go on where :data:`MOST` windows are affordable; in proportion where fewer are."""
MIXED = 2
"""Points beside the ends of each horizon: in one each joint has its best numbers, in the other its second best."""
DELAYS = (0.0, 0.01, 0.02, 0.04, 0.08)
"""Delays that are tried at all joints at once [s]."""
SLOPES = (2, 2, 3)
"""Jacobians for each start at those horizons, at half a second, and for the best of them at the end."""
WORK = 5e6
"""Physics steps of all windows, parameters and joints that one Jacobian may cost; more windows are thinned."""
SHARE = 0.02
"""Share of a time budget that one Jacobian may take [1]."""
FEWEST, MOST = 20, 400
"""Windows of a fit at least, if there are so many, and at most."""
LOWER = 0.99
"""Share of its own at which a torque limit is another one [1]."""
TRIED = (0.25, 0.5, 0.75)
"""Which quantiles of the lower ones are tried [1]."""
WORTH = 0.005
"""Share of the squared error below which no parameter is worth having [1]."""
DOUBT = 0.5
"""Standard errors by which a parameter has to help where it was not fitted [1]."""
GAIN = 0.02
"""Share of the error of folds that a law must save, to first order and in simulation, or a limit of the error [1]."""
SURE = 1.0
"""Standard errors by which it must help [1]."""
SURE_WITHOUT = 2.0
"""Standard errors by which a fit must follow folds better that does without the torques [1]."""
WILD_GAIN = 0.1
"""Share of the error of folds that weights must save that take windows for wild [1]."""
STAYS = 1e9
"""A ridge by which a fold's step moves nothing but what is held, and what makes up for that [1]."""


def more_telling(near: Linearised, deadline: Deadline) -> Linearised:
    """Plain least squares in units of each joint or of all joints alike, by folds; robust ones if they save much.

    What is asked is the error that is stated, which is a plain one. Weights that take windows for wild are for logs in
    which some were pushed, or fell: they stay where they save :data:`WILD_GAIN` of the error of folds. One push, or
    pushes in most folds, save less than that, so that such windows are better left out of the recordings.
    """
    problem, best = near.problem, near
    if len(problem.unit) > 1:
        start = near
        for way, slopes in ((replace(problem, pooled=True), 1), (problem, SLOPES[2])):
            if not deadline.allows((2 + slopes) * near.seconds):
                break
            start = _from(way, start, slopes, deadline)
            best = start if follows_better(best, start, 0.0, 0.0) else best
    if deadline.allows((2 + SLOPES[2]) * near.seconds):
        robust = _from(replace(problem, tuning=TUNING), best, SLOPES[2], deadline)
        best = robust if follows_better(best, robust, WILD_GAIN) else best
    return best


def _from(way: Problem, start: Linearised, slopes: int, deadline: Deadline) -> Linearised:
    """The solution of a problem from that of another one of the same windows."""
    way = in_units(way, way.squares(start.errors))
    x = descend(way, start.values, start.free, slopes, deadline, start)
    return trusted(linearise(weighed(way, x), x, start.free))


def without_torques(near: Linearised, deadline: Deadline) -> Linearised:
    """The solution that the torques have no say in, where it follows folds that it was not fitted to better.

    A servo whose gain, delay and limit are not as given asks for other torques than its law with the given ones does,
    often far from where the search ended: hence twice the Jacobians, and plain windows, none of which is wild yet.
    It has to save as much as a new law would, and more surely: torques keep a simulation from coasting.
    """
    slopes = 2 * SLOPES[2]
    if near.problem.torques is None or not deadline.allows((1 + slopes) * near.seconds):
        return near
    start = near.alone()
    other = _from(replace(start.problem, tuning=np.inf, pooled=False), start, slopes, deadline)
    return other if follows_better(near, other, sure=SURE_WITHOUT) else near


def follows_better(near: Linearised, other: Linearised, least: float = GAIN / 2, sure: float = SURE) -> bool:
    """Whether another fit of the same windows has less of the error that is stated, and by more than it is in doubt.

    By the steps of each, and by the shorter of both: a fold that hardly moves is told by what it was fitted to.
    """
    count = independent(near.problem)
    shorter = tuple(map(max, near.ridges, other.ridges))
    ways = [(near, other)]
    if near.ridges != other.ridges:
        ways.append((replace(near, ridges=shorter), replace(other, ridges=shorter)))
    return all(gain_of(stated_of_windows(a), stated_of_windows(b), count, least, sure) > 0 for a, b in ways)


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
    plain = partial(problem_of, torques=torques, tuning=np.inf)  # as the stated error is
    full = plain(h, takes, WINDOW, count, rng, begin[0])
    few = plain(h, takes, WINDOW, IMPROVED, rng, begin[0]) if count > IMPROVED else full
    more = plain(h, takes, WINDOW, COMPARED, rng, begin[0]) if count > COMPARED else full
    points = list(begin)
    times = max(1, CHEAP * count // MOST)
    for horizon, (seconds, kept) in enumerate(zip(HORIZONS, (times * k for k in KEPT), strict=True)):
        problem = plain(h, takes, seconds, SEARCHED, rng, points[0])
        if not horizon:
            half = kept // 2  # short windows forgive, and like what coasts; long ones know what is right already
            points = [p for q in (problem, few) for p in _mixed(q, q.mean_square(begin), begin, half)]
        ends = [descend(weighed(problem, x), x, free, SLOPES[0], deadline.part(0.3)) for x in points]
        points = best_of(more, [*ends, *points, *begin[:2]], kept, MIXED)
        progress((horizon + 1) / 4)
    ends = [descend(weighed(few, x), x, free, SLOPES[1], deadline.part(0.5)) for x in points]
    progress(0.7)
    x = best_of(more, [*ends, *points], 1, MIXED)[0]
    x = _with_delays(more, few, x, free, deadline.part(0.6))
    x = descend(weighed(full, x), x, free, SLOPES[2], deadline.part(0.7))
    near = trusted(escaped(linearise(weighed(full, x), x, free), deadline.part(0.8)))
    near = _with_limits(near, few, begin, deadline.part(0.85)) if times > 1 else near
    progress(0.9)
    return without_torques(more_telling(near, deadline), deadline)


def _with_delays(problem: Problem, few: Problem, x: Array, free: Mask, deadline: Deadline) -> Array:
    """Values (P,), or better ones with other delays: the same at all joints, as of one bus, or each joint its own.

    A fit with a delay that is missing, or too long, has a rotor, gains and friction that make up for it, so that no
    slope leads from one to the other.

    Args:
        problem: Windows to compare by.
        few: Windows to improve by.
        x: Values. Shape (P,).
        free: Which of them may move. Shape (P,).
        deadline: When to come to an end.
    """
    late, tried = free & _of_effect(few, "actuation_delay"), [x]
    for delay in DELAYS if late.any() else ():
        if deadline.over:
            break
        y = np.where(late, delay, x)
        y = descend(weighed(few, y), y, free & ~late, 1, deadline)  # beside it, before it leaves
        tried.append(descend(weighed(few, y), y, free, 1, deadline))
    if len(tried) == 1:
        return x
    y = best_of(problem, tried, 1, MIXED)[0].copy()
    back = np.where(np.eye(len(x), dtype=bool)[late], x, y)  # of a joint that rests no delay is better than another
    cost = _costs(problem, np.stack([y, *back]))
    y[late] = np.where(cost[1:] <= cost[0], x[late], y[late])
    return y


def _of_effect(problem: Problem, name: str) -> Mask:
    """Which numbers are of an effect. Shape (P,)."""
    return np.array([c.effect.name == name for c in problem.hypothesis.terms for _ in c.parameters])


def _with_limits(near: Linearised, few: Problem, begin: Array, deadline: Deadline) -> Linearised:
    """The solution with torque limits tried lower, of joints that do without theirs, if that saves :data:`GAIN`.

    No slope leads from a limit that is hardly met to the true one just below. One that saves less would hold back
    faster motion than was fitted, for next to nothing.

    Args:
        near: Solution.
        few: Windows to try it by.
        begin: Starts; quartiles of their limits below a joint's own are tried. Shape (K, P).
        deadline: When to come to an end.
    """
    problem, h, x = near.problem, near.problem.hypothesis, near.values
    limit = near.free & _of_effect(problem, "torque_saturation")
    if not limit.any() or not deadline.allows(10 * near.seconds):
        return near
    limit[limit] = _idle(few, x, limit)
    tried = []
    for share in TRIED:
        y = x.copy()
        for k in np.flatnonzero(limit):
            lower = begin[begin[:, k] < min(h.nominal[k], LOWER * x[k]), k]
            y[k] = np.quantile(lower, share) if len(lower) else x[k]
        if (y != x).any():
            y = descend(weighed(few, y), y, near.free & (y == x), 1, deadline)  # beside it, before it leaves
            tried.append(descend(weighed(few, y), y, near.free, SLOPES[1], deadline))
    if not tried:
        return near
    both = np.stack([x, *tried])
    y = best_of(problem, [*tried, *_mixed(few, few.mean_square(both), both, 1)], 1)[0]
    x, y = (descend(problem, z, near.free, SLOPES[1], deadline) for z in (x, y))
    limit[limit] = _idle(problem, y, limit)
    y[limit] = x[limit]
    cost = _costs(problem, np.stack([x, y]))
    return trusted(linearise(weighed(problem, y), y, near.free)) if cost[1] < (1 - GAIN) * cost[0] else near


def _idle(problem: Problem, x: Array, which: Mask) -> Mask:
    """Which of some numbers values (P,) do without: without it the given one follows as well. Shape (sum of which,)."""
    without = np.where(np.eye(len(x), dtype=bool)[which], problem.hypothesis.nominal, x)
    cost = _costs(problem, np.stack([x, *without]))
    return np.asarray(cost[1:] < (1 + WORTH) * cost[0], dtype=np.bool_)


def _mixed(problem: Problem, square: Array, begin: Array, count: int) -> list[Array]:
    """Starts in which each joint has its own best numbers, its second best, and so on."""
    joint = np.array([c.joint for c in problem.hypothesis.terms for _ in c.parameters])
    order = np.argsort(typical(problem, square), axis=0)  # (K, J)
    return [begin[order[rank, joint], np.arange(len(joint))] for rank in range(min(count, len(begin)))]


def best_of(problem: Problem, points: Sequence[Array], count: int, mixed: int = 0) -> list[Array]:
    """Those of the least cost, none twice; it counts errors in units of the least typical one of each joint.

    Args:
        problem: Windows.
        points: Values. Shapes (P,).
        count: How many.
        mixed: Points to try beside them, in which each joint has its best numbers of all, its second best, and so on.
    """
    values = np.stack(list({tuple(x): x for x in points}.values()))
    square = problem.mean_square(values)
    known = set(map(tuple, values))
    more = {tuple(x): x for x in _mixed(problem, square, values, mixed) if tuple(x) not in known}
    if more:
        values = np.concatenate([values, np.stack(list(more.values()))])
        square = np.concatenate([square, problem.mean_square(values[len(square) :])])
    return [values[k] for k in np.argsort(_costs_of(problem, values, square))[:count]]


def _costs(problem: Problem, values: Array) -> Array:
    """Cost of values (K, P), in units of the least typical error of each joint. Shape (K,)."""
    return _costs_of(problem, values, problem.mean_square(values))


def _costs_of(problem: Problem, values: Array, square: Array) -> Array:
    """:func:`_costs` of known mean squares (K, W, J)."""
    unit = np.sqrt(np.maximum(typical(problem, square).min(0), 1e-18))
    cost = window_cost(replace(problem, unit=unit), square).mean(1)
    return np.asarray(cost + problem.charge(values), dtype=np.float64)


def trusted(near: Linearised) -> Linearised:
    """With the ridge for each fold by whose step the others are followed best.

    Far from the solution a simulation is not linear: the whole step that the other folds ask for may be no fit of them,
    and says nothing of the fold that is kept aside. A fit of them would try several lengths as well, and stay where
    none does them good.
    """
    fold, ridges = folds_of(near.problem), list(near.ridges)
    for k in np.unique(fold):
        others = apart_from(near.problem, fold == k)
        ridges[k] = _best_ridge(near, others) if others.any() else STAYS
    return replace(near, ridges=tuple(ridges))


def _best_ridge(near: Linearised, telling: Mask) -> float:
    """The least ridge by whose step some windows, weighed as they were, are followed as well as by the best of them."""
    part, nothing = part_of(near.problem, telling), np.zeros(int(near.free.sum()), dtype=bool)
    ridges = (RIDGE, *DAMPING[1:])
    steps = np.stack([near.step(telling, nothing, ridge) for ridge in ridges])
    values = np.concatenate([steps, near.values[None]])
    square = np.concatenate([part.mean_square(steps), near.problem.squares(near.errors)[telling][None]])
    cost = (part.weight[:, None] * square / part.unit**2).sum((1, 2)) + (part.pull(values) ** 2).sum(0)
    return (*ridges, STAYS)[int(np.argmax(cost <= (1 + FLAT) * np.nanmin(cost)))]


def escaped(near: Linearised, deadline: Deadline) -> Linearised:
    """The solution, or a better one: each fold is left out once, and all windows are fitted from where the others lead.

    One fold can hold a search in a minimum that the others would leave, and where all of them meet again further on.
    """
    problem, fold, tried = near.problem, folds_of(near.problem), [near.values]
    for k in np.unique(fold):
        apart = apart_from(problem, fold == k)
        if not apart.any() or not deadline.allows(2 * near.seconds):
            break
        others = near.of_windows(apart)
        x = descend(others.problem, near.values, near.free, 1, deadline, others)
        if (x != near.values).any():
            tried.append(descend(weighed(problem, x), x, near.free, 1, deadline))
    if len(tried) == 1:
        return near
    x = best_of(problem, tried, 1, MIXED)[0]
    costs = _costs(problem, np.stack([near.values, x]))
    return linearise(weighed(problem, x), x, near.free) if costs[1] < (1 - FLAT) * costs[0] else near


def prune(near: Linearised, deadline: Deadline, progress: Callable[[float], None] = lambda fraction: None) -> Mask:
    """Which parameters folds that are kept aside ask for; the others are held at the given model's. Shape (P,), of all.

    Backwards: of each joint the parameter goes whose absence costs least to first order, as long as folds that were
    kept aside allow it: their stated error must not rise by more than half its uncertainty, nor, in a fit of weighed
    windows, the weighed one. The fits without a fold and without a parameter are one bounded step from the solution,
    which the fold's ridge shortens; their errors are simulated. Torque limits go first, by a rule of their own.
    """
    near = without_doubtful_limits(near, deadline)
    problem, fold = near.problem, folds_of(near.problem)
    index = np.flatnonzero(near.free)
    joint = np.array([c.joint for c in problem.hypothesis.terms for _ in c.parameters])[index]
    held, asking = np.zeros(len(index), dtype=bool), ~_limits(near)
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
            allowed &= cost <= np.maximum(DOUBT * doubt, WORTH * least[k].mean())
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


def without_doubtful_limits(near: Linearised, deadline: Deadline) -> Linearised:
    """The fit without the torque limits that folds do not ask for as clearly as for a law, the least asked for first.

    A limit holds back faster motion than was fitted, of which no fold tells. And it has no slope beyond the largest
    torque: to hold it at the given model's by its slope would make up for what never happens.
    """
    problem, fold, limits = near.problem, folds_of(near.problem), _limits(near)
    if not limits.any() or independent(problem) < 2 or not deadline.allows(near.seconds):
        return near

    def costs(fit: Linearised) -> list[Array]:
        square = folded(fit, [np.zeros(int(fit.free.sum()), dtype=bool)], fold)
        return [window_cost(way, square)[0] for way in (replace(problem, tuning=np.inf), problem)]

    each = np.eye(len(limits), dtype=bool)[limits]
    order = np.argsort([costs(near.without(one))[1].mean() for one in each], kind="stable")
    gone, left = np.zeros(len(limits), dtype=bool), near
    every = now = costs(near)
    for one in each[order]:
        fewer = near.without(gone | one)
        without = costs(fewer)
        asked = [
            gain_of(*both, independent(problem)) for kept in (every, now) for both in zip(without, kept, strict=True)
        ]
        if any(asked) or deadline.over:
            break
        gone, left, now = gone | one, fewer, without
    return left


def over_needed(near: Linearised, needed: Mask) -> Array:
    """Values (P,) to first order over what is needed, shape (P,); limits that are not are gone as they were asked."""
    near = near.without(_limits(near) & ~needed[near.free])
    return near.step(np.ones(len(near.normal), dtype=bool), ~needed[near.free])


def _limits(near: Linearised) -> Mask:
    """Which of the free parameters are torque limits. Shape (P,)."""
    return _of_effect(near.problem, "torque_saturation")[near.free]


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
                errors[rows] = near.errors[rows] + near.columns[rows] @ near.move(others, held, near.ridges[k])
                out[n, fold == k] = problem.squares(errors)[fold == k]
        else:
            values = np.stack([near.step(others, held, near.ridges[k]) for held in trials])
            out[:, fold == k] = part_of(problem, fold == k).mean_square(values)
    return out
