"""A combination of effects, fitted in the simulation over multiple-shooting windows."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from mujoco import minimize
from numpy.typing import NDArray

from torchrl_athletic.diagnosis.replay import (
    Take,
    Windows,
    follow_targets,
    motion_of,
    simulate,
    window_rmse,
    windows_of,
)
from torchrl_athletic.diagnosis.screen import Candidate, Key, bounded_least_squares
from torchrl_athletic.diagnosis.thresholds import SIMULATION
from torchrl_athletic.effects import Parameter, Plant

Array = NDArray[np.float64]


WINDOW = SIMULATION.window
"""Length of the windows that scores are stated for [s]."""
SHOOTING = (0.2, WINDOW)
"""Window lengths of the successive fits [s]: short ones are nearly linear and forgive a poor start."""
FIXED = 1e-9
"""Room of a parameter that may not move, in its scale [1]."""


@dataclass(frozen=True, eq=False)
class Hypothesis:
    """Which physics a model is said to lack, and which of its numbers may move within their tolerance beside it."""

    terms: tuple[Candidate, ...]
    trims: tuple[Candidate, ...] = ()
    """What every model is a little wrong in (see :func:`~torchrl_athletic.diagnosis.screen.trims_for`); no findings."""

    @property
    def parameters(self) -> tuple[Parameter, ...]:
        """Parameters of the terms, then of the trims, in the order of the value vector. Length P."""
        return tuple(p for c in (*self.terms, *self.trims) for p in c.parameters)

    @property
    def nominal(self) -> Array:
        """The given model. Shape (P,)."""
        return np.array([p.nominal for p in self.parameters])

    @property
    def scale(self) -> Array:
        """Units of the optimiser. Shape (P,)."""
        return np.array([p.scale for p in self.parameters])

    @property
    def bounds(self) -> tuple[Array, Array]:
        """Physical bounds of the terms, tolerances of the trims. Shapes (P,)."""
        return np.array([p.lower for p in self.parameters]), np.array([p.upper for p in self.parameters])

    def build(self, plant: Plant, values: Array) -> None:
        """Put values (rows, P) into a plant."""
        parts = [(c, self.values_of(c, values)) for c in (*self.terms, *self.trims)]
        for candidate, own in sorted(parts, key=lambda part: part[0].effect.adds_to_link):
            candidate.effect.apply(plant, candidate.joint, own)

    def values_of(self, candidate: Candidate, values: NDArray[Any]) -> NDArray[Any]:
        """The part of a value vector, or of a mask of it, that belongs to one candidate. Shape (..., its P)."""
        at = 0
        for other in (*self.terms, *self.trims):
            count = len(other.parameters)
            if other is candidate:
                return values[..., at : at + count]
            at += count
        raise ValueError(f"{candidate.key} is not part of the hypothesis")


@dataclass(frozen=True, eq=False)
class Fitted:
    """A hypothesis with its values, and what is needed to say how sure they are."""

    hypothesis: Hypothesis
    values: Array
    """Shape (P,)."""
    samples: Array
    """Values of block-bootstrap replicates. Shape (R, P)."""
    cost: float
    """Robust mean square of the windows' normalised error."""

    def interval(self) -> Array:
        """95 % interval of each parameter. Shape (P, 2)."""
        return np.quantile(self.samples, [0.025, 0.975], axis=0).T


def fit(
    hypothesis: Hypothesis,
    takes: Sequence[Take],
    start: Array,
    rng: np.random.Generator,
    max_windows: int = 60,
    max_iter: int = 8,
    progress: Callable[[float], None] = lambda fraction: None,
) -> Fitted:
    """Least squares of the window errors within physical bounds, by MuJoCo's box-constrained Gauss-Newton.

    Windows that the model cannot follow count less (Cauchy weights), so that a fall or a push does not steer the
    parameters. A take that the fitted model follows from end to end is fitted end to end as well: slow drift shows
    only there.

    Args:
        hypothesis: What may change.
        takes: Recordings to fit.
        start: First guess. Shape (P,).
        rng: Draws the windows when there are more than ``max_windows``, and the bootstrap.
        max_windows: Windows used in a fit.
        max_iter: Gauss-Newton iterations a round.
        progress: Told the finished fraction.
    """
    low, most = hypothesis.bounds
    high = np.maximum(most, low + FIXED * hypothesis.scale)  # the solver refuses a parameter without room
    unit = np.minimum(hypothesis.scale, np.maximum((high - low) / 4, 1e-12))
    x = np.clip(start, low, high) / unit
    if not len(x):
        return Fitted(hypothesis, start, np.zeros((200, 0)), 0.0)
    stepped = any(_is_stepped(hypothesis, take, x * unit) for take in takes)
    if stepped:  # a hundred times dearer; the torque domain's start is good enough for one round
        max_windows, max_iter = max_windows // 2, max_iter // 2
    rounds = [draw_windows(takes, seconds, max_windows, rng) for seconds in (SHOOTING[1:] if stepped else SHOOTING)]
    rounds[-1] = _with_telling(hypothesis, takes, x * unit, rounds[-1], rng)
    for done, windows in enumerate(rounds):
        x = _solve(_Problem(hypothesis, windows, unit, x), x, low / unit, high / unit, max_iter)
        progress((done + 1) / (len(rounds) + 1))
    ends = [simulate(w, hypothesis.build, (x * unit)[None])[0] for w in rounds[-1]]
    typical = window_rmse(rounds[-1], ends)[0]
    ends_to_end = [] if stepped else [windows_of(part, None) for take in takes for part in take.parts]
    whole = [w for w in ends_to_end if _follows(hypothesis, w, x * unit, typical)]
    final = _Problem(hypothesis, rounds[-1] + whole, unit, x)
    if whole:
        x = _solve(final, x, low / unit, high / unit, max_iter // 2)
    samples, cost = _bootstrap(final, x, rng, low / unit, high / unit)
    progress(1.0)
    return Fitted(hypothesis, np.clip(x * unit, low, most), np.clip(samples * unit, low, most), cost)


def _with_telling(
    h: Hypothesis,
    takes: Sequence[Take],
    values: Array,
    drawn: list[Windows],
    rng: np.random.Generator,
) -> list[Windows]:
    """The windows that were drawn, and those in which each term acts most: chance would miss what happens seldom."""
    if not h.terms:
        return drawn
    full = draw_windows(takes, WINDOW, _looked_at(takes), rng)
    moved, error, _ = _actions(h, full, values)
    act = (moved / np.maximum(error, 1e-24)).max(2)
    telling = {int(k) for row in act for k in np.argsort(row)[-SIMULATION.telling :]}
    starts: dict[Take, set[int]] = {w.take: {int(s) for s in w.start} for w in drawn}
    first = 0
    for w in full:
        starts.setdefault(w.take, set()).update(int(s) for k, s in enumerate(w.start, first) if k in telling)
        first += len(w.start)
    length = {w.take: w.length for w in (*drawn, *full)}
    return [Windows(take, np.array(sorted(s), dtype=np.intp), length[take]) for take, s in starts.items() if s]


def _looked_at(takes: Sequence[Take]) -> int:
    """Windows among which those are looked for in which a term acts: fewer where a controller closes the loop."""
    return SIMULATION.looked_at // 3 if follow_targets(takes) else SIMULATION.looked_at


def _solve(problem: _Problem, x: Array, low: Array, high: Array, max_iter: int) -> Array:
    x, _ = minimize.least_squares(
        x,
        problem.residual,
        bounds=[low, high],
        eps=1e-4,
        max_iter=max_iter,
        mu_factor=10**0.5,  # a fifth of the library's trials where steps are refused, as gears often do
        xtol=1e-3,
        verbose=minimize.Verbosity.SILENT,
    )
    return np.ravel(x)


def _is_stepped(hypothesis: Hypothesis, take: Take, values: Array) -> bool:
    """Whether the replay has to look at the state at every physics step, as it does where a gear gives way."""
    plant = Plant(take.model, take.address, 1)
    hypothesis.build(plant, values[None])
    return take.recording.position_target is not None or not plant.open_loop


def _follows(hypothesis: Hypothesis, whole: Windows, values: Array, typical: Array) -> bool:
    """Whether one open-loop rollout stays near the take: within a tenth of the travel and a few times a window's error.

    A chaotic or falling robot does not, nor does a drive without a spring or gravity, which drifts with hundredths of
    its friction: its end-to-end error measures the drift and not the physics.
    """
    if not len(whole.start):
        return False
    error, _ = window_rmse([whole], [simulate(whole, hypothesis.build, values[None])[0]])
    near = np.minimum(0.1 * np.ptp(whole.measured[0], axis=0), SIMULATION.drift * typical)
    return bool((error < near).all())


def idle_terms(fitted: Fitted, takes: Sequence[Take], rng: np.random.Generator) -> tuple[Candidate, ...]:
    """Terms that the simulation does without: nowhere do they move it by what is left of the error, and to its good.

    They were named for what another term, still coarse in the torque domain, left over. A term that acts in two windows
    of a hundred, as a joint's stop does, is not idle.
    """
    h, values = fitted.hypothesis, fitted.values
    windows = draw_windows(takes, WINDOW, _looked_at(takes), rng)
    moved, error, error_without = _actions(h, windows, values)
    acts = moved > SIMULATION.acts**2 * error
    helps = acts & (error_without - error > SIMULATION.helps * moved)
    once = (helps & (error < SIMULATION.leaves**2 * error_without)).any(
        1
    )  # a push comes once; no accident explains so much
    needed = ((helps.sum(1) >= np.where(once, 1, 2)) & (helps.sum(1) >= 0.5 * acts.sum(1))).any(1)
    return tuple(t for t, n in zip(h.terms, needed, strict=True) if not n)


def shares_closed(fitted: Fitted, windows: Sequence[Windows], near: Array) -> dict[Key, float]:
    """Share of the simulation's error that each term closes, 0..1: of three, the least.

    Each term is set back to the given model's numbers alone, with all terms at its joint, and with all terms. Alone, it
    closes its part of what is open where the others are right: what stays may be of another cause. With the others, it
    closes no more than they do together: two halves that only undo each other, such as a weak gain and a low friction,
    close nothing of what the given model left open.

    Joints count by how far the term moves them; of all windows and of the typical window the larger share is taken,
    since a push comes once, and since a fall counts more than all else.

    Args:
        fitted: All terms together.
        windows: Of the recordings.
        near: Error below which nothing stays [rad, m], shape (J,).
    """
    h, unit = fitted.hypothesis, near**2
    if not h.terms:
        return {}
    together = set_back_together(h)
    moved, error, error_without = _actions(h, windows, fitted.values, together)
    most = np.maximum(SIMULATION.fallen**2, motion_of(windows))  # what falls without a term errs by no more
    error, error_without = np.minimum(error, most), np.minimum(error_without, most)
    moves = moved.mean(1) / unit
    far = moves.sum(1, keepdims=True)
    acts = np.where(far > 0.0, moves / np.maximum(far, 1e-300), 1.0 / len(near))
    left = (acts * np.maximum(error.mean(0) / unit - 1.0, 0.0)).sum(1)
    least = np.ones(len(h.terms))
    for terms, without in zip(together, error_without, strict=True):
        closes = np.maximum((acts * ((without - error).mean(0) / unit)).sum(1), 0.0)
        of_all = np.where(left > 0.0, closes / np.maximum(closes + left, 1e-300), 1.0)
        typical = 1.0 - np.exp(np.log(np.maximum(error, unit) / np.maximum(without, unit)).mean(0))
        shares = np.maximum(of_all, (acts * np.maximum(typical, 0.0)).sum(1))
        least[terms] = np.minimum(least, shares)[terms]
    return {c.key: float(share) for c, share in zip(h.terms, least, strict=True)}


def set_back_together(h: Hypothesis) -> list[list[int]]:
    """Which terms :func:`shares_closed` sets back at once: each alone, those of each joint, and all."""
    alone = [[k] for k in range(len(h.terms))]
    joints = dict.fromkeys(c.joint_name for c in h.terms)
    of_joints = [[k for k, c in enumerate(h.terms) if c.joint_name == joint] for joint in joints]
    several = [terms for terms in of_joints if 1 < len(terms) < len(h.terms)]
    return alone + several + ([list(range(len(h.terms)))] if len(h.terms) > 1 else [])


def _actions(
    h: Hypothesis, windows: Sequence[Windows], values: Array, together: Sequence[Sequence[int]] | None = None
) -> tuple[Array, Array, Array]:
    """What setting terms back to the given model's numbers does to every window: each alone, or those told together.

    Returns:
        Mean square of the motion that each term alone makes, shape (terms, W, J); mean square error with all terms,
        shape (W, J); and without those that are set back together, shape (len(together), W, J).
    """
    sets = [values]
    for terms in together or [[k] for k in range(len(h.terms))]:
        sets.append(values.copy())
        for term in (h.terms[k] for k in terms):
            h.values_of(term, sets[-1])[:] = [p.nominal for p in term.parameters]
    moved, error = [], []
    for w in _in_blocks(windows):
        predicted = simulate(w, h.build, np.stack(sets))
        alone = predicted[1 : 1 + len(h.terms)]
        moved.append(((alone - predicted[:1]) ** 2).mean(2))
        error.append(((predicted - w.measured) ** 2).mean(2))
    errors = np.concatenate(error, axis=1)
    return np.concatenate(moved, axis=1), errors[0], errors[1:]


def _in_blocks(windows: Sequence[Windows]) -> Iterator[Windows]:
    for w in windows:
        for first in range(0, len(w.start), SIMULATION.at_once):
            yield replace(w, start=w.start[first : first + SIMULATION.at_once])


def without(fitted: Fitted, dropped: Sequence[Candidate]) -> Fitted:
    """Leave some terms or trims out of a fit; the values of the others stay."""
    terms, trims = (
        tuple(c for c in part if c not in dropped) for part in (fitted.hypothesis.terms, fitted.hypothesis.trims)
    )
    return _regrouped(fitted, Hypothesis(terms, trims))


def as_trims(fitted: Fitted, moved: Sequence[Candidate]) -> Fitted:
    """Count some terms of a fit as trims: their values stay, and they are no findings."""
    h = fitted.hypothesis
    return _regrouped(fitted, Hypothesis(tuple(t for t in h.terms if t not in moved), (*moved, *h.trims)))


def _regrouped(fitted: Fitted, smaller: Hypothesis) -> Fitted:
    """The values of a fit, in the order of a hypothesis of the same candidates or fewer."""
    h, kept = fitted.hypothesis, (*smaller.terms, *smaller.trims)
    values = np.concatenate([h.values_of(c, fitted.values) for c in kept]) if kept else np.zeros(0)
    samples = np.concatenate([h.values_of(c, fitted.samples) for c in kept], axis=1) if kept else fitted.samples[:, :0]
    return Fitted(smaller, values, samples, fitted.cost)


def draw_windows(takes: Sequence[Take], seconds: float, most: int, rng: np.random.Generator) -> list[Windows]:
    """Windows of all takes, thinned at random to about ``most``, evenly over the takes' lengths."""
    full = [windows_of(take, seconds) for take in takes]
    total = sum(len(w.start) for w in full)
    if total <= most:
        return [w for w in full if len(w.start)]
    out = []
    for w in full:
        count = max(1, round(most * len(w.start) / total))
        chosen = np.sort(rng.choice(len(w.start), min(count, len(w.start)), replace=False))
        out.append(Windows(w.take, w.start[chosen], w.length))
    return [w for w in out if len(w.start)]


class _Problem:
    """Weighted residuals of a fixed set of windows, as ``mujoco.minimize`` wants them."""

    def __init__(self, hypothesis: Hypothesis, windows: Sequence[Windows], unit: Array, x: Array) -> None:
        self.hypothesis, self.windows, self.unit = hypothesis, windows, unit
        nominal, (_low, high) = hypothesis.nominal, hypothesis.bounds
        free = sum(len(c.parameters) for c in hypothesis.terms)
        self.prior = np.where(np.arange(len(nominal)) >= free, 0.3 / np.maximum(high - nominal, 1e-12), 0.0)
        now = [p[0] for p in self.predict(x[:, None])]
        short = [k for k, w in enumerate(windows) if not _is_long(w)]
        _, each = window_rmse([windows[k] for k in short], [now[k] for k in short])
        typical = np.maximum(np.median(each, axis=0), 1e-9)
        self.weight = [_weights(w, p, typical) for w, p in zip(windows, now, strict=True)]

    def predict(self, x: Array) -> list[Array]:
        values = (x * self.unit[:, None]).T
        return [simulate(w, self.hypothesis.build, values) for w in self.windows]

    def residual(self, x: Array) -> Array:
        parts = [
            ((p - w.measured) * weight[:, None]).reshape(p.shape[0], -1)
            for w, p, weight in zip(self.windows, self.predict(x), self.weight, strict=True)
        ]
        trims = (x * self.unit[:, None] - self.hypothesis.nominal[:, None]) * self.prior[:, None]
        return np.concatenate([np.concatenate(parts, axis=1).T, trims])

    def groups(self) -> NDArray[np.intp]:
        """Block of each residual row.

        A window, or a quarter of a take that is followed end to end, where errors last long.
        """
        joints, sizes = self.weight[0].shape[1], []
        for w in self.windows:
            most = -(-w.length // 4) if _is_long(w) else w.length
            blocks = [min(most, w.length - first) for first in range(0, w.length, most)]
            sizes += [joints * size for _ in w.start for size in blocks]
        return np.repeat(np.arange(len(sizes)), sizes)


def _is_long(w: Windows) -> bool:
    return w.length * w.take.period > 2 * WINDOW


def _weights(w: Windows, predicted: Array, typical: Array) -> Array:
    """Weight of each window's residuals: over the typical error, less where the model cannot follow. Shape (W, J).

    A take that is followed end to end drifts by more than a window does; it counts as its length in windows, against
    its own error.
    """
    each = np.sqrt(((predicted - w.measured) ** 2).mean(1))
    share = w.length * w.take.period / WINDOW
    if _is_long(w):
        weight = np.sqrt(share) / np.maximum(each, typical)
    else:
        ratio = np.sqrt(((each / typical) ** 2).mean(1, keepdims=True))
        weight = np.sqrt(share / (1.0 + (ratio / 3.0) ** 2)) / typical
    return np.asarray(weight / np.sqrt(w.length * each.shape[1]), dtype=np.float64)


def _bootstrap(
    problem: _Problem, x: Array, rng: np.random.Generator, low: Array, high: Array, replicates: int = 200
) -> tuple[Array, float]:
    """One bounded Gauss-Newton step from the optimum for each resampled set of windows (a window is a block)."""
    step = 1e-3
    sets = np.concatenate([x[:, None], x[:, None] + step * np.eye(len(x))], axis=1)
    r = problem.residual(sets)
    jacobian, residual, group = (r[:, 1:] - r[:, :1]) / step, r[:, 0], problem.groups()
    prior = jacobian[len(group) :]
    jacobian, residual = jacobian[: len(group)], residual[: len(group)]
    count = int(group[-1]) + 1
    order = np.flatnonzero(np.diff(group, prepend=-1))
    normal = np.stack([part.T @ part for part in np.split(jacobian, order[1:])])
    right = np.add.reduceat(jacobian * residual[:, None], order, axis=0)
    # at the optimum the gradient is zero up to the solver's tolerance: the resampled one is centred on that
    centre = right.sum(0)
    out = np.empty((replicates, len(x)))
    for k in range(replicates):
        drawn = np.bincount(rng.integers(0, count, count), minlength=count).astype(float)
        n = np.tensordot(drawn, normal, 1) + prior.T @ prior
        n += 1e-9 * np.trace(n) / len(x) * np.eye(len(x))
        out[k] = x + bounded_least_squares(n, centre - drawn @ right, low - x, high - x)
    blind = np.linalg.norm(jacobian, axis=0) < 1e-9 * max(float(np.linalg.norm(jacobian)), 1e-300)
    out[:, blind] = rng.uniform(low[blind], high[blind], (replicates, int(blind.sum())))  # nothing is known of these
    return out, float(residual @ residual / count)
