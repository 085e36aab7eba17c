"""Which few effects the motion asks for, one after the other: a forward selection in the simulation.

Torques that are made of currents, or of accelerations that encoders hardly show, speak for many effects at once. The
motion of the joints says which of them alone would move the model most of the way to the recordings.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from torchrl_athletic.diagnosis.deadline import Deadline
from torchrl_athletic.diagnosis.descent import descend
from torchrl_athletic.diagnosis.fit import WINDOW, Hypothesis
from torchrl_athletic.diagnosis.joint_fit import gain_of
from torchrl_athletic.diagnosis.problem import (
    Mask,
    Problem,
    evenly,
    independent,
    part_of,
    problem_of,
    weighed,
    window_cost,
)
from torchrl_athletic.diagnosis.replay import Take
from torchrl_athletic.diagnosis.screen import Candidate
from torchrl_athletic.diagnosis.standard import Agreement

Array = NDArray[np.float64]

SCREENED = 24
"""Windows by which every effect is tried at several sizes."""
COMPARED = 40
"""Windows by which those that moved the model most are fitted and compared."""
FEWEST = 10
"""Windows of either kind at least."""
WORK = 48_000
"""Physics steps, times joints, of the windows by which effects are compared; where a controller closes the loop, which
is looked at step by step, they count twice. Of arms that follow targets fewer windows are looked at."""
SIZES = 5
"""Sizes of an effect that are tried, on either side of the given number."""
FITTED = 4
"""Effects of a round that are fitted beside those that are chosen already."""
SLOPES = 2
"""Jacobians of such a fit."""
LEAST = 0.02
"""Share of what is open that an effect must close [1]."""
SURE = 2.0
"""Standard errors by which it must [1]."""
ODDS = 5.0
"""Standard errors beyond which a rival is out of the question."""
MOST = 8
"""Effects at most."""


@dataclass(frozen=True, eq=False)
class Rival:
    """An effect in the place of another one that follows the motion better."""

    candidate: Candidate
    values: Array
    """Shape (its P,)."""
    against: float
    """Twice the log odds: the square of the windows' paired z-score."""


@dataclass(frozen=True, eq=False)
class Selection:
    """Effects that the motion asks for, in the order in which it asked."""

    hypothesis: Hypothesis
    values: Array
    """Shape (P,)."""
    shares: tuple[float, ...]
    """Share of the error that comes back without each effect, the others fitted anew, 0..1."""
    rivals: tuple[tuple[Rival, ...], ...]
    """What else was fitted in each one's place when it was chosen."""
    complete: bool
    """Whether the time sufficed to choose as long as something was asked for."""


def select(
    h: Hypothesis,
    takes: Sequence[Take],
    rng: np.random.Generator,
    deadline: Deadline,
    torques: Agreement | None = None,
    starts: Mapping[Candidate, Sequence[Array]] | None = None,
) -> Selection:
    """Choose effects one by one, as long as each closes a share of the motion's error that is beyond doubt.

    What the others do without, once all are chosen and fitted anew, goes again: it stood in for one that came later.

    Args:
        h: Effects to choose from.
        takes: Recordings.
        rng: Draws windows.
        deadline: After which nothing is tried.
        torques: What they say of the parameters.
        starts: Values to try of some effects beside those from the unit to the bound. Shapes (its P,).
    """
    share = min(1.0, WORK / (COMPARED * _cost_of_window(takes[0])))
    compared, screened = (max(FEWEST, round(share * most)) for most in (COMPARED, SCREENED))
    problem = problem_of(h, takes, WINDOW, compared, rng, h.nominal, torques)
    few = part_of(problem, evenly(problem, screened))
    x, chosen = h.nominal, dict[Candidate, tuple[Rival, ...]]()
    while len(chosen) < MOST and not deadline.over:
        found = _next(few, problem, x, tuple(chosen), deadline, starts or {})
        if found is None:
            break
        c, x, chosen[c] = found
    x, shares = _needed(weighed(problem, x), x, tuple(chosen), deadline)
    kept = Hypothesis(tuple(shares))
    values = np.concatenate([h.values_of(c, x) for c in shares] or [np.zeros(0)])
    return Selection(kept, values, tuple(shares.values()), tuple(chosen[c] for c in shares), not deadline.over)


def _cost_of_window(take: Take) -> float:
    """Physics steps, times joints, of a window of half a second."""
    twice = 2 if take.recording.position_target is not None else 1
    return twice * len(take.address.dof) * WINDOW / float(take.model.opt.timestep)


def _needed(
    problem: Problem, x: Array, chosen: Sequence[Candidate], deadline: Deadline
) -> tuple[Array, dict[Candidate, float]]:
    """Values of the chosen effects that are needed, and the share of the error that comes back without each.

    The others are fitted anew without it, as long as there is time. That which is missed least goes first.
    """
    h, left = problem.hypothesis, list(chosen)
    while True:
        now, shares, without = _cost(problem, x), dict[Candidate, float](), dict[Candidate, Array]()
        for c in left:
            begin = x.copy()
            h.values_of(c, begin)[:] = [p.nominal for p in c.parameters]
            without[c] = descend(problem, begin, _free(h, [o for o in left if o is not c]), SLOPES, deadline)
            shares[c] = gain_of(_cost(problem, without[c]), now, independent(problem), LEAST, SURE)
        idle = min(left, key=lambda c: shares[c], default=None)
        if idle is None or shares[idle] > 0.0:
            return x, shares
        left.remove(idle)
        x = without[idle]


def _next(
    few: Problem,
    problem: Problem,
    x: Array,
    chosen: Sequence[Candidate],
    deadline: Deadline,
    starts: Mapping[Candidate, Sequence[Array]],
) -> tuple[Candidate, Array, tuple[Rival, ...]] | None:
    """The effect that closes most beside those that are chosen, the values with it, and what was tried in its place."""
    h = problem.hypothesis
    few, problem = weighed(few, x), weighed(problem, x)
    before = _cost(problem, x)
    tried: list[tuple[Candidate, Array, Array]] = []
    for c, begin in _most_promising(few, x, chosen, starts)[:FITTED]:
        if deadline.over:
            break
        y = descend(problem, begin, _free(h, [*chosen, c]), SLOPES, deadline)
        if c.effect.is_physical(c.parameters, h.values_of(c, y)):  # no robot has the others
            tried.append((c, y, _cost(problem, y)))
    if not tried:
        return None
    count = independent(problem)
    best, y, cost = min(tried, key=lambda t: float(t[2].mean()))
    if gain_of(before, cost, count, LEAST, SURE) <= 0.0:
        return None
    rivals = tuple(Rival(c, h.values_of(c, z), _against(other - cost, count)) for c, z, other in tried if c is not best)
    return best, y, rivals


def _against(worse: Array, count: int) -> float:
    """The square of the z-score of what windows (W,) of which so many are independent cost more."""
    doubt = float(worse.std()) / np.sqrt(max(count, 1))
    return float(np.clip(worse.mean() / max(doubt, 1e-12), 0.0, ODDS)) ** 2


def _most_promising(
    problem: Problem, x: Array, chosen: Sequence[Candidate], starts: Mapping[Candidate, Sequence[Array]]
) -> list[tuple[Candidate, Array]]:
    """Effects at the size that moves the model nearest to the recordings, the nearest first."""
    h = problem.hypothesis
    sets, of = [x], [-1]
    for k, c in enumerate(h.terms):
        if c in chosen or not all(c.allows(other) for other in chosen):
            continue
        for trial in (*_sizes(h, c, x), *_started(h, c, x, starts)):
            sets.append(trial)
            of.append(k)
    both = np.stack(sets)
    cost = window_cost(problem, problem.mean_square(both)).mean(1) + problem.charge(both)
    best: dict[int, int] = {}
    for n in np.argsort(cost[1:], kind="stable") + 1:
        if cost[n] < cost[0]:
            best.setdefault(of[n], int(n))
    return [(h.terms[k], sets[n]) for k, n in best.items()]


def _cost(problem: Problem, x: Array) -> Array:
    """Cost of each window, and what the torques have against the values (P,). Shape (W,)."""
    return np.asarray(window_cost(problem, problem.mean_square(x[None]))[0] + problem.charge(x[None])[0])


def _sizes(h: Hypothesis, c: Candidate, x: Array) -> list[Array]:
    """Values with one parameter of an effect at several sizes: from its unit to its bound, by equal factors."""
    index = h.values_of(c, np.arange(len(x)))
    out = []
    for i, p in zip(index, c.parameters, strict=True):
        for bound in (p.lower, p.upper):
            reach = abs(bound - p.nominal)
            if not np.isfinite(reach) or reach <= 1e-12:
                continue
            steps = np.geomspace(min(p.scale, 0.5 * reach), 0.9 * reach, SIZES)
            for step in steps:
                y = x.copy()
                y[i] = p.nominal + np.sign(bound - p.nominal) * step
                out.append(y)
    return out


def _started(h: Hypothesis, c: Candidate, x: Array, starts: Mapping[Candidate, Sequence[Array]]) -> list[Array]:
    """Values with an effect at the sizes that are known from elsewhere."""
    out = [x.copy() for _ in starts.get(c, ())]
    for y, start in zip(out, starts.get(c, ()), strict=True):
        h.values_of(c, y)[:] = start
    return out


def _free(h: Hypothesis, terms: Sequence[Candidate]) -> Mask:
    free = np.zeros(len(h.nominal), dtype=bool)
    for c in terms:
        h.values_of(c, free)[:] = [p.upper > p.lower for p in c.parameters]
    return free
