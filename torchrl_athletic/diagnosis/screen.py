"""Which effects could explain the missing torque: a search over combinations, in the torque domain, without simulating.

Every effect of the catalogue predicts a part of the missing torque (see :mod:`torchrl_athletic.effects.signals`). A
combination is scored by an evidence that counts independent samples only (the autocorrelation of the residual decides
how many), and a term must also explain a material share of what was open, because on a real robot every superset wins
by a little.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from types import MappingProxyType

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import lsq_linear

from torchrl_athletic.effects import CATALOGUE, Effect, LinkCom, LinkInertia, LinkMass, Parameter, Signals, TorqueScale
from torchrl_athletic.effects.effect import torque_scale

Array = NDArray[np.float64]

BLOCK = 1.0
"""Length of a block of samples that is resampled together [s]."""
SCREEN_TRIMS: Mapping[Effect, float] = MappingProxyType({LinkMass(): 0.03})
"""Relative trust in the given masses while naming: a smaller change is a trim, no finding."""
FIT_TRIMS: Mapping[Effect, float] = MappingProxyType(
    {LinkMass(): 0.05, LinkCom(): 0.05, LinkInertia(): 0.15, TorqueScale(): 0.05}
)
"""The same once the findings are known, wider: the numbers of a CAD model are adjusted before they are blamed."""
TORQUE_FLOOR = 1e-3
"""Missing torque that nobody needs explained, as a share of the joint's typical torque."""


@dataclass(frozen=True, eq=False)
class Candidate:
    """One effect on one joint."""

    effect: Effect
    joint: int
    joint_name: str
    parameters: tuple[Parameter, ...]

    @property
    def key(self) -> tuple[str, str]:
        """(effect, joint)."""
        return self.effect.name, self.joint_name

    def allows(self, other: Candidate) -> bool:
        """Whether both may stand in one explanation."""
        if self.joint != other.joint:
            return True
        names = self.effect.name, other.effect.name
        return names[0] != names[1] and names[1] not in self.effect.excludes and names[0] not in other.effect.excludes


@dataclass(frozen=True, eq=False)
class Atom:
    """A candidate at one point of its nonlinear grid."""

    candidate: Candidate
    fixed: Mapping[str, float]
    columns: tuple[int, ...]
    """Columns of the bank, one for each linear parameter that the data show."""
    linear: tuple[int, ...]
    """Index of the parameter behind each column; -1 for a constant prediction."""


@dataclass(frozen=True, eq=False)
class Fit:
    """A combination of atoms, fitted."""

    atoms: tuple[Atom, ...]
    """Of the combination, then of the trims."""
    size: int
    """How many of the atoms are no trims."""
    coefficients: Array
    """One for each column of the atoms, in order."""
    residual: Array
    """Sum of squares per joint and block. Shape (J, B)."""

    @property
    def terms(self) -> tuple[Atom, ...]:
        """The combination without its trims."""
        return self.atoms[: self.size]

    @property
    def freedom(self) -> int:
        """Number of parameters of the combination."""
        return sum(len(atom.candidate.parameters) for atom in self.terms)

    def values(self) -> list[Array]:
        """Parameters of each atom in physical units. A list of (P,)."""
        out, at = [], 0
        for atom in self.atoms:
            value = np.array([atom.fixed.get(p.name, p.nominal) for p in atom.candidate.parameters])
            for k, parameter in enumerate(atom.linear):
                if parameter >= 0:
                    given = atom.candidate.parameters[parameter]
                    value[parameter] = atom.candidate.effect.value(given, float(self.coefficients[at + k]))
            at += len(atom.linear)
            out.append(value)
        return out


class Bank:
    """Predictions of every candidate for a set of recordings, as Gram matrices per joint and block.

    Rows are normalised by ``noise`` (J,), so that a joint with nothing missing has a mean square of one. ``trims`` are
    fitted beside every combination that leaves room for them.
    """

    def __init__(
        self,
        takes: Sequence[Signals],
        candidates: Iterable[Candidate],
        trims: Iterable[Candidate] = (),
        noise: Array | None = None,
    ) -> None:
        self.takes = list(takes)
        self.joints = takes[0].num_joints
        self.noise = row_noise(takes) if noise is None else noise
        self.atoms: list[Atom] = []
        self._columns: list[Array] = []  # each (sum of N, J) or, for a local effect, zero elsewhere
        for candidate in candidates:
            if all(candidate.effect.applies(s) for s in takes):
                for fixed in candidate.effect.grid(takes[0], candidate.joint):
                    self.add(candidate, fixed)
        atoms, self.atoms = self.atoms, []
        for trim in trims:
            self.add(trim, {})
        self.trims, self.atoms = tuple(self.atoms), atoms

    def add(self, candidate: Candidate, fixed: Mapping[str, float]) -> Atom | None:
        """Predict a candidate at one point of its grid.

        None if it predicts nothing that the noise would let through.
        """
        prints = [candidate.effect.fingerprint(s, candidate.joint, fixed) for s in self.takes]
        free = [k for k, p in enumerate(candidate.parameters) if p.name not in fixed]
        columns = [np.concatenate([f.columns[:, :, k] for f in prints]) for k in range(prints[0].columns.shape[2])]
        linear = list(free[: len(columns)])
        if prints[0].constant is not None:
            columns.append(np.concatenate([f.constant for f in prints if f.constant is not None]))
            linear.append(-1)
        reach = [
            1.0 if k < 0 else max(abs(candidate.parameters[k].upper - candidate.parameters[k].nominal), 1e-12)
            for k in linear
        ]
        seen = [
            i for i, column in enumerate(columns) if np.abs(column * self.weight).max() * reach[i] > 1.0
        ]  # otherwise even the bound would hide in the noise
        if not seen:
            return None
        start = len(self._columns)
        self._columns.extend(columns[i] for i in seen)
        atom = Atom(candidate, dict(fixed), tuple(range(start, start + len(seen))), tuple(linear[i] for i in seen))
        self.atoms.append(atom)
        self.__dict__.pop("_gram", None)
        return atom

    @cached_property
    def weight(self) -> Array:
        """Inverse noise, zero where a sample is not to be used. Shape (sum of N, J)."""
        return np.concatenate([s.valid / self.noise for s in self.takes])

    @cached_property
    def target(self) -> Array:
        """Missing torque of all takes [N·m]. Shape (sum of N, J)."""
        return np.concatenate([s.missing for s in self.takes])

    @cached_property
    def block(self) -> NDArray[np.intp]:
        """Block of each row. Shape (sum of N,)."""
        labels, first = [], 0
        for s in self.takes:
            own = ((s.time - s.time[0]) / BLOCK).astype(np.intp)
            labels.append(own + first)
            first += int(own[-1]) + 1
        return np.concatenate(labels)

    @cached_property
    def count(self) -> Array:
        """Valid rows per joint and block. Shape (J, B)."""
        ones = (self.weight > 0).astype(float)
        return np.stack([np.bincount(self.block, ones[:, j]) for j in range(self.joints)])

    @cached_property
    def _gram(self) -> list[tuple[NDArray[np.intp], Array]]:
        """Per joint: where each column stands (-1: not here), and Grams of [columns, target].

        Shape (B, C + 1, C + 1).
        """
        starts = np.flatnonzero(np.diff(self.block, prepend=-1))
        out = []
        for j in range(self.joints):
            here = [c for c, column in enumerate(self._columns) if column[:, j].any()]
            place = np.full(len(self._columns), -1, dtype=np.intp)
            place[here] = np.arange(len(here))
            rows = (
                np.stack([*(self._columns[c][:, j] for c in here), self.target[:, j]], -1) * self.weight[:, j : j + 1]
            )
            gram = np.stack([part.T @ part for part in np.split(rows, starts[1:])])
            out.append((place, gram))
        return out

    def fit(
        self, atoms: Sequence[Atom], blocks: NDArray[np.intp] | None = None, coefficients: Array | None = None
    ) -> Fit:
        """Bounded least squares of a combination, and of the trims that go with it.

        Args:
            atoms: The combination, without trims.
            blocks: Blocks that decide the coefficients; all if None.
            coefficients: Skip the fit and score these.
        """
        chosen = tuple(atoms)
        atoms = (*chosen, *(t for t in self.trims if all(t.candidate.allows(a.candidate) for a in chosen)))
        columns = [c for atom in atoms for c in atom.columns]
        pieces = []
        for place, gram in self._gram:
            at = place[columns]
            pieces.append(
                (at >= 0, gram[:, [*at[at >= 0], gram.shape[1] - 1]][:, :, [*at[at >= 0], gram.shape[1] - 1]])
            )
        if coefficients is None:
            normal, right = np.zeros((len(columns), len(columns))), np.zeros(len(columns))
            for inside, gram in pieces:
                total = gram.sum(0) if blocks is None else gram[blocks].sum(0)
                normal[np.ix_(inside, inside)] += total[:-1, :-1]
                right[inside] += total[:-1, -1]
            coefficients = bounded_least_squares(normal, right, *_bounds(atoms))
        residual = np.empty((self.joints, len(pieces[0][1])))
        for j, (inside, gram) in enumerate(pieces):
            x = np.append(-coefficients[inside], 1.0)
            residual[j] = np.einsum("i,bij,j->b", x, gram, x)
        return Fit(atoms, len(chosen), coefficients, np.maximum(residual, 0.0))

    def gram(self, joint: int) -> Array:
        """Gram matrices of all columns that touch a joint and, last, of the target, per block.

        Shape (B, C + 1, C + 1).
        """
        return self._gram[joint][1]

    def reaches(self, atom: Atom, joint: int) -> bool:
        """Whether an atom predicts anything on a joint."""
        return any(self._gram[joint][0][c] >= 0 for c in atom.columns)

    def rows(self, fit: Fit) -> Array:
        """What the combination leaves of the missing torque [N·m]. Shape (sum of N, J)."""
        left = self.target.copy()
        for column, coefficient in zip((c for a in fit.atoms for c in a.columns), fit.coefficients, strict=True):
            left -= coefficient * self._columns[column]
        return left

    def prediction(self, fit: Fit, atom: Atom) -> Array:
        """The part of the missing torque that one atom of a combination explains [N·m]. Shape (sum of N, J)."""
        out, at = np.zeros_like(self.target), 0
        for other in fit.atoms:
            for column in other.columns:
                if other is atom:
                    out += fit.coefficients[at] * self._columns[column]
                at += 1
        return out

    def independent_samples(self, left: Array) -> Array:
        """Number of independent samples per joint: rows over the autocorrelation time of what is left. Shape (J,)."""
        out = np.zeros(self.joints)
        for j in range(self.joints):
            first = 0
            for s in self.takes:
                rows = slice(first, first + len(s.time))
                first += len(s.time)
                good = self.weight[rows, j] > 0
                if good.any():
                    out[j] += good.sum() / correlation_time(np.where(good, left[rows, j], 0.0))
        return np.maximum(out, 2.0)


def row_noise(takes: Sequence[Signals]) -> Array:
    """Standard deviation of the missing torque with nothing missing: sensor noise, and a floor below which nobody asks.

    Shape (J,).
    """
    noise = np.sqrt(np.mean([s.noise**2 for s in takes], axis=0))
    typical = np.sqrt(np.mean(np.concatenate([s.command**2 + s.load**2 for s in takes]), axis=0))
    limit = np.array([torque_scale(takes[0].nominal, takes[0].address, j) for j in range(takes[0].num_joints)])
    return np.hypot(noise, TORQUE_FLOOR * np.maximum(np.minimum(limit, 10 * typical), typical))


def correlation_time(x: Array) -> float:
    """Integrated autocorrelation time in samples, by the initial positive sequence (Geyer 1992). At least 1."""
    x = x - x.mean()
    size = 2 ** int(np.ceil(np.log2(2 * len(x))))
    power = np.abs(np.fft.rfft(x, size)) ** 2
    correlation = np.fft.irfft(power)[: len(x) // 2]
    if correlation[0] <= 0:
        return 1.0
    correlation = correlation / correlation[0]
    stop = int(np.argmax(correlation <= 0)) if (correlation <= 0).any() else len(correlation)
    return max(1.0, 1.0 + 2.0 * float(correlation[1:stop].sum()))


def candidates_for(takes: Sequence[Signals], catalogue: Sequence[Effect] = CATALOGUE) -> list[Candidate]:
    """Every effect on every joint, with the parameters that the model gives it."""
    s = takes[0]
    out = []
    for effect in catalogue:
        for joint, name in enumerate(s.recording.joint_names):
            parameters = effect.parameters(s.nominal, s.address, joint)
            if parameters:
                out.append(Candidate(effect, joint, name, parameters))
    return out


def trims_for(takes: Sequence[Signals], trust: Mapping[Effect, float]) -> list[Candidate]:
    """What every model is a little wrong in, within a relative tolerance of the given numbers."""
    out = []
    for candidate in candidates_for(takes, tuple(trust)):
        (p,) = candidate.parameters
        reach = trust[candidate.effect] * abs(p.nominal)
        narrow = replace(p, lower=p.nominal - reach, upper=p.nominal + reach)
        out.append(replace(candidate, parameters=(narrow,)))
    return out


def _bounds(atoms: Sequence[Atom]) -> tuple[Array, Array]:
    low, high = [], []
    for atom in atoms:
        for k in atom.linear:
            if k < 0:
                low.append(1.0)
                high.append(1.0)
            else:
                p = atom.candidate.parameters[k]
                low.append(atom.candidate.effect.change(p, p.lower))
                high.append(atom.candidate.effect.change(p, p.upper))
    return np.array(low), np.array(high)


def bounded_least_squares(normal: Array, right: Array, low: Array, high: Array) -> Array:
    """Minimise x'Nx/2 - r'x within bounds; equal bounds fix a coefficient."""
    x = low.copy()
    free = np.flatnonzero(high > low)
    if not len(free):
        return x
    fixed = np.setdiff1d(np.arange(len(x)), free)
    n, r = normal[np.ix_(free, free)], right[free] - normal[np.ix_(free, fixed)] @ x[fixed]
    scale = 1.0 / np.sqrt(np.maximum(np.diag(n), 1e-300))
    n, r = n * scale * scale[:, None] + 1e-10 * np.eye(len(free)), r * scale
    lower, upper = low[free] / scale, high[free] / scale
    z = np.linalg.solve(n, r)
    if (z < lower).any() or (z > upper).any():
        root = np.linalg.cholesky(n)
        z = lsq_linear(root.T, np.linalg.solve(root, r), (lower, upper), method="bvls").x
    x[free] = z * scale
    return x
