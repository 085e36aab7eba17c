"""How far rival explanations are apart, on recordings at hand and along motions that nobody has recorded yet.

In the torque domain a rival's fingerprint says what torque it adds along any motion. Two rivals are as far apart as the
torques that one predicts are from anything that the other can still predict, once its parameters and the trims are
fitted again to old and planned recordings together.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import combinations, permutations
from typing import TypeAlias

import numpy as np
from numpy.typing import NDArray

from torchrl_athletic.diagnosis.screen import KERNEL_CORRELATION, Atom, Key, bounded_least_squares
from torchrl_athletic.diagnosis.search import Judge, Scored
from torchrl_athletic.diagnosis.thresholds import PLAN, SEARCH
from torchrl_athletic.effects import Parameter, Signals

Array = NDArray[np.float64]
Cache: TypeAlias = dict[tuple[Key, tuple[tuple[str, float], ...]], Array]


@dataclass(frozen=True, eq=False)
class PairProducts:
    """Inner products of what the rivals predict, one group of rows a joint and set of takes. G groups."""

    of: dict[tuple[int, int], Array]
    """(rival, rival) -> products of their columns, in variances of the noise. Shapes (G, K, K')."""
    count: Array
    """Independent samples in each group. Shape (G,)."""
    bent: Array
    """Mean square of what smoothing bends into the missing torque, in variances of the noise. Shape (G,)."""
    left: Array
    """Mean square that a rival which is right leaves, in variances of the noise. Shape (G,)."""
    noise: Array
    """Standard deviation of the missing torque that noise explains [N·m]. Shape (G,)."""

    def __add__(self, other: PairProducts) -> PairProducts:
        of = {pair: np.concatenate([own, other.of[pair]]) for pair, own in self.of.items()}
        groups = ((getattr(self, name), getattr(other, name)) for name in ("count", "bent", "left", "noise"))
        return PairProducts(of, *(np.concatenate(both) for both in groups))

    def times(self, factor: float) -> PairProducts:
        """Products of takes that are longer by a factor."""
        longer = {pair: factor * own for pair, own in self.of.items()}
        return replace(self, of=longer, count=factor * self.count)


class Rivals:
    """The rivals, what they predict, and how far apart they are."""

    def __init__(self, judge: Judge, rivals: Sequence[Scored], probabilities: Sequence[float] | None) -> None:
        bank, best = judge.bank, rivals[0]
        p = np.asarray(probabilities if probabilities is not None else np.ones(len(rivals)), dtype=float)
        self.rivals, self.takes = list(rivals), bank.takes
        self.pairs = list(combinations(range(len(rivals)), 2))
        self.weight = np.array([p[a] * p[b] for a, b in self.pairs]) / sum(p[a] * p[b] for a, b in self.pairs)
        total, independent = judge.total, judge.independent.sum(1)
        self.sigma = bank.noise
        """Noise of each take [N·m]. Shape (takes, J)."""
        left = (total * judge.mean_square(best.fit)).sum(1) / total.sum(1)
        sensed = _rms(np.stack([s.noise for s in bank.takes])) ** 2
        self.unnamed = np.maximum(left * _rms(self.sigma) ** 2 - sensed, 0.0)
        """Mean square that the likeliest rival leaves beyond the sensors' noise [(N·m)²]. Shape (J,)."""
        self.floor = (total * judge.floor).sum(1) / total.sum(1)
        """Below it a difference is no evidence. Shape (J,)."""
        self.level = np.maximum(left, self.floor)
        self.memory = np.minimum(bank.independent_samples(bank.rows(best.fit)) / np.maximum(independent, 1e-9), 1.0)
        """Share of the independent samples that the residual's autocorrelation leaves. Shape (J,)."""
        self.known = [Coefficients(s, bank.takes[0]) for s in rivals]
        self.draws: list[Array] | None = None

    def products(self, takes: Sequence[Signals], noise: Array | None = None) -> PairProducts:
        """Products of some takes, as one set.

        ``noise``: of the missing torque of each take [N·m], shape (takes, J); that of the recordings at hand if None.
        """
        noise = np.broadcast_to(_rms(self.sigma), (len(takes), self.sigma.shape[1])) if noise is None else noise
        columns: list[list[Array]] = [[] for _ in self.rivals]
        count, bent, left = np.zeros((3, noise.shape[1]))
        for s, sigma in zip(takes, noise, strict=True):
            cache: Cache = {}
            step = float(np.median(np.diff(s.time))) if len(s.time) > 1 else np.inf  # of a piece between drop-outs
            share = min(step / (KERNEL_CORRELATION * s.kernel), 1.0) * self.memory
            count += share * s.valid.sum(0)
            bent += share * (s.valid * s.bias**2).sum(0) / sigma**2
            left += share * s.valid.sum(0) * (s.noise**2 + self.unnamed) / sigma**2
            weight = s.valid * np.sqrt(share) / sigma
            for own, rival in zip(columns, self.known, strict=True):
                own.append(rival.columns(s, cache) * weight[:, :, None])
        whole = [np.concatenate(own).transpose(1, 0, 2) for own in columns]
        many = range(len(whole))
        pairs = [*permutations(many, 2), *((a, a) for a in many)]
        of = {(a, b): whole[a].transpose(0, 2, 1) @ whole[b] for a, b in pairs}
        usable = np.maximum(count, 1e-9)
        return PairProducts(of, count, bent / usable, left / usable, _rms(noise))

    def separations(self, products: PairProducts, noise: Array | None = None) -> Array:
        """Separation of each pair: root of the evidence for the truth against the rival's best answer. Shape (pairs,).

        The mean of both directions, as either may be true, since they may be far from equal: a lag that was fitted
        larger than the delay says more. Of rivals that differ in their count of parameters the larger, as one that
        contains the other can always imitate it, and only that count speaks against it then.

        Args:
            products: Of the recordings at hand, which come first, and of what is planned.
            noise: Of a search through all of them [N·m], shape (G,); that of the products if None. Stronger motion
                asks for torques in which more passes for noise.
        """
        if self.draws is None:
            rng = np.random.default_rng(0)
            weighted = [products.of[n, n] / self.level[:, None, None] for n in range(len(self.known))]
            self.draws = [rival.draw(w.sum(0), rng) for rival, w in zip(self.known, weighted, strict=True)]
        quiet = np.ones(len(products.noise)) if noise is None else (products.noise / noise) ** 2
        out = []
        for a, b in self.pairs:
            ways = [
                np.mean(
                    [min(np.sqrt(self._evidence(products, x, one, other, quiet)), PLAN.enough) for x in self.draws[one]]
                )
                for one, other in ((a, b), (b, a))
            ]
            alike = self.rivals[a].fit.freedom == self.rivals[b].fit.freedom
            out.append(float(np.mean(ways) if alike else max(ways)))
        return np.array(out)

    def _evidence(self, products: PairProducts, truth: Array, a: int, b: int, quiet: Array) -> float:
        """For rival a with coefficients ``truth`` against rival b fitted to what that predicts, as a search weighs.

        ``quiet``: variance of the products' noise in that of the search's. Shape (G,).
        """
        own_square = (products.of[a, a] @ truth) @ truth
        count = np.maximum(products.count, 1e-9)
        left, scale = products.left * quiet, quiet
        # of a strong motion more is allowed to smoothing and to laws that are right
        floor = np.maximum(
            np.resize(self.floor, len(count)), 1.0 + products.bent + SEARCH.accuracy**2 * own_square / count
        )
        level = np.maximum(left, 1.0 + (floor - 1.0) * scale)
        own, other, cross = self.known[a], self.known[b], products.of[a, b]
        weight = (scale / level)[:, None, None]
        normal = (weight * products.of[b, b]).sum(0) + np.diag(other.doubt)
        answer = bounded_least_squares(normal, truth @ (weight * cross).sum(0), other.low, other.high)
        square = own_square - 2 * truth @ cross @ answer
        square = scale * np.maximum(square + (products.of[b, b] @ answer) @ answer, 0.0)
        worse = np.maximum(left + square / count, level)
        strain = float(other.doubt @ answer**2 - own.doubt @ truth**2)
        return max(float(products.count @ np.log(worse / level)) + strain, 0.0)


class Coefficients:
    """A rival's coefficients: of its linear parameters, and of small changes to its nonlinear ones. K in all."""

    def __init__(self, scored: Scored, example: Signals) -> None:
        fit, at, rows = scored.fit, 0, []
        self.parts: list[tuple[Atom, Array, list[tuple[str, float]]]] = []
        self.free: list[list[Parameter]] = []
        """Parameters that the first coefficients of each atom stand for."""
        for k, atom in enumerate(fit.atoms):
            given = fit.coefficients[at : at + len(atom.linear)]
            at += len(atom.linear)
            free, own, ends, steps = _numbers(atom, given, example)
            self.free.append(free)
            self.parts.append((atom, own, [(name, 0.1 * reach) for name, reach in steps]))
            trim = k >= fit.size
            for value, (low, high, likely) in zip(own, ends, strict=True):
                doubt = (4 / (high - low)) ** 2 if trim else 0.0
                rows.append((value, low, high, doubt, likely**-2))
            rows += [(0.0, -abs(reach), abs(reach), (2 / reach) ** 2, 1.0) for _, reach in steps]
        self.values, self.low, self.high, self.doubt, prior = np.array(rows).T
        self.prior = np.maximum(prior, self.doubt)
        """Precision about the fitted values of what nobody has recorded."""

    def columns(self, s: Signals, cache: Cache) -> Array:
        """Columns of all coefficients [N·m]. Shape (N, J, K)."""
        out = []
        for atom, own, steps in self.parts:
            here = _fingerprint(s, atom, atom.fixed, cache)
            out.append(here)
            for name, step in steps:
                there = _fingerprint(s, atom, {**atom.fixed, name: atom.fixed[name] + step}, cache)
                out.append(((there - here) @ own / step)[:, :, None])
        return np.concatenate(out, axis=2)

    def prediction(self, s: Signals) -> Array:
        """Missing torque along a motion [N·m]. Shape (N, J)."""
        return np.asarray(self.columns(s, {}) @ self.values)

    def parameters(self, coefficients: Array) -> Array:
        """What coefficients stand for, in physical units: the parameters of all atoms in a row. Shape (P,)."""
        out, at = [], 0
        for (atom, own, steps), free in zip(self.parts, self.free, strict=True):
            value = {p.name: atom.fixed.get(p.name, p.nominal) for p in atom.candidate.parameters}
            for p, coefficient in zip(free, coefficients[at:], strict=False):
                value[p.name] = atom.candidate.effect.value(p, float(coefficient))
            for (name, _), change in zip(steps, coefficients[at + len(own) :], strict=False):
                value[name] += float(change)
            at += len(own) + len(steps)
            out += list(value.values())
        return np.array(out)

    def draw(self, gram: Array, rng: np.random.Generator) -> Array:
        """The fitted coefficients, and others that the recordings allow as well. Shape (PLAN.draws, K)."""
        normal = gram + np.diag(self.prior)
        scale = 1 / np.sqrt(np.diag(normal))
        root = np.linalg.cholesky(normal * scale * scale[:, None] + 1e-10 * np.eye(len(scale)))
        steps = np.linalg.solve(root.T, rng.standard_normal((len(scale), PLAN.draws - 1))).T * scale
        linear = np.concatenate([[1.0] * len(own) + [0.0] * len(steps) for _, own, steps in self.parts])
        drawn = [bounded_least_squares(normal, normal @ (self.values + step), self.low, self.high) for step in steps]
        return np.stack([self.values, *drawn]) * linear


def _numbers(
    atom: Atom, given: Array, example: Signals
) -> tuple[list[Parameter], Array, list[tuple[float, float, float]], list[tuple[str, float]]]:
    """Linear parameters of an atom, and its coefficients with their bounds and likely sizes, shown or not.

    Then the nonlinear parameters, each with the change over which it is taken as linear.
    """
    effect, parameters = atom.candidate.effect, atom.candidate.parameters
    sample = effect.fingerprint(every_nth(example, 50), atom.candidate.joint, atom.fixed)
    free = [p for p in parameters if p.name not in atom.fixed][: sample.columns.shape[2]]
    own = np.zeros(len(free))
    ends = []
    for p in free:
        likely = PLAN.unseen * max(abs(effect.change(p, p.nominal + p.scale)), 1e-12)
        ends.append((effect.change(p, p.lower), effect.change(p, p.upper), likely))
    if sample.constant is not None:
        own = np.append(own, 1.0)
        ends.append((1.0, 1.0, 1.0))
    own[list(atom.shown)] = given
    steps = []
    for p in parameters:
        if p.name in atom.fixed and p.upper > p.lower:
            value = atom.fixed[p.name]
            reach = 0.5 * max(abs(value), p.scale)
            steps.append((p.name, reach if value + 0.1 * reach <= p.upper else -reach))
    return free, own, ends, steps


def _fingerprint(s: Signals, atom: Atom, fixed: Mapping[str, float], cache: Cache) -> Array:
    key = atom.candidate.key, tuple(sorted(fixed.items()))
    if key not in cache:
        f = atom.candidate.effect.fingerprint(s, atom.candidate.joint, fixed)
        cache[key] = f.columns if f.constant is None else np.concatenate([f.columns, f.constant[:, :, None]], 2)
    return cache[key]


def _rms(noise: Array) -> Array:
    return np.asarray(np.sqrt(np.mean(noise**2, axis=0)))


def every_nth(s: Signals, every: int = PLAN.every) -> Signals:
    names = ("keep", "position", "velocity", "acceleration", "command", "required", "missing", "bias", "valid")
    base = None if s.base is None else s.base[::every]
    return replace(s, base=base, **{name: getattr(s, name)[::every] for name in names})
