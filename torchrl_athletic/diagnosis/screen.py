"""Which effects could explain the missing torque: a search over combinations, in the torque domain, without simulating.

Every effect of the catalogue predicts a part of the missing torque (see :mod:`torchrl_athletic.effects.signals`). A
combination is scored by an evidence that counts independent samples only (the autocorrelation of the residual decides
how many), and a term must also explain a material share of what was open, because on a real robot every superset wins
by a little.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import TypeAlias

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import lsq_linear

from torchrl_athletic.diagnosis.products import Library, Products, gains
from torchrl_athletic.diagnosis.thresholds import TORQUES
from torchrl_athletic.effects import (
    CATALOGUE,
    Effect,
    Fingerprint,
    Parameter,
    Signals,
)
from torchrl_athletic.effects.effect import torque_scale

Array = NDArray[np.float64]

KERNEL_CORRELATION = 2 * np.sqrt(np.pi)
"""Correlation time of white noise behind the Gaussian test function, in widths."""


Key: TypeAlias = tuple[str, str | None]
"""Effect and joint; no joint if the whole robot has it."""


@dataclass(frozen=True, eq=False)
class Candidate:
    """One effect on one joint."""

    effect: Effect
    joint: int
    """Index; 0 for an effect of the whole robot."""
    joint_name: str | None
    """None for an effect of the whole robot."""
    parameters: tuple[Parameter, ...]

    @property
    def where(self) -> str:
        """The joint, in a sentence."""
        return self.joint_name or "the robot"

    @property
    def key(self) -> Key:
        """(effect, joint)."""
        return self.effect.name, self.joint_name

    def allows(self, other: Candidate) -> bool:
        """Whether both may stand in one explanation."""
        everywhere = self.joint_name is None or other.joint_name is None
        if self.joint != other.joint and not everywhere:
            return True
        names = self.effect.name, other.effect.name
        return names[0] != names[1] and names[1] not in self.effect.excludes and names[0] not in other.effect.excludes

    def moves_beside(self, term: Candidate) -> bool:
        """Whether this, within its tolerance, may move beside a term of an explanation.

        What every model is a little wrong in, it is wherever something else is wrong, too: only what the trim itself
        excludes stops it, or terms would be weighed with unlike freedom.
        """
        everywhere = self.joint_name is None or term.joint_name is None
        if self.joint != term.joint and not everywhere:
            return True
        return term.effect.name != self.effect.name and term.effect.name not in self.effect.excludes


@dataclass(frozen=True, eq=False)
class Atom:
    """A candidate at one point of its nonlinear grid."""

    candidate: Candidate
    fixed: Mapping[str, float]
    linear: tuple[int, ...]
    """Index of the parameter behind each column that the data show; -1 for a constant prediction."""
    shown: tuple[int, ...]
    """Which of the fingerprint's columns these are; the constant comes last."""

    @property
    def freedom(self) -> int:
        """Number of parameters that are not held at the given model's value."""
        return sum(self.fixed.get(p.name) != p.nominal for p in self.candidate.parameters)


@dataclass(frozen=True, eq=False)
class Fit:
    """A combination of atoms, fitted."""

    atoms: tuple[Atom, ...]
    """Those of the combination, then those of the trims."""
    size: int
    """How many of the atoms are no trims."""
    coefficients: Array
    """One for each column of the atoms, in order."""
    bounds: tuple[Array, Array]
    """Least and greatest value of each coefficient."""
    strain: float
    """Sum of squares of the trims, each in standard deviations of what it may be: half its tolerance."""
    residual: Array
    """Weighted sum of squares that is left, per joint and stretch. Shape (J, S)."""
    energy: Array
    """Weighted sum of squares of what each term predicts, per joint. Shape (terms, J)."""

    @property
    def terms(self) -> tuple[Atom, ...]:
        """The combination without its trims."""
        return self.atoms[: self.size]

    @property
    def freedom(self) -> int:
        """Number of parameters of the combination."""
        return sum(atom.freedom for atom in self.terms)

    @property
    def at_bound(self) -> bool:
        """Whether a term of the combination is a stand-in (see :attr:`stand_ins`)."""
        return bool(self.stand_ins)

    @property
    def stand_ins(self) -> list[Atom]:
        """Terms of which a parameter stops at a physical bound, zero excepted: no estimate, but a stand-in.

        A motor three times too strong is one, whose torque something else then takes away. So are values that make no
        sense together.
        """
        out, at = [], 0
        for atom, values in zip(self.terms, self.values(), strict=False):
            stops = not atom.candidate.effect.is_physical(atom.candidate.parameters, values)
            for k, parameter in enumerate(atom.linear, at):
                low, high, x = self.bounds[0][k], self.bounds[1][k], self.coefficients[k]
                if parameter >= 0 and min(x - low, high - x) <= 1e-6 * (high - low):
                    p = atom.candidate.parameters[parameter]
                    stops |= min(abs(values[parameter]), abs(values[parameter] - p.nominal)) > 1e-6 * p.scale
            at += len(atom.linear)
            if stops:
                out.append(atom)
        return out

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
    """Predictions of every candidate for a set of recordings, and their products, which is all that a search needs.

    Rows are normalised by ``noise`` (J,), or that of each take (takes, J), so that a joint with nothing missing has a
    mean square of one. ``trims`` are fitted beside every combination that leaves room for them. Time and memory grow
    linearly with the recordings.
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
        self.noise = row_noise(takes) if noise is None else np.broadcast_to(noise, (len(self.takes), self.joints))
        self.products = Products(self.joints, self.stretch)
        self.products.add(self.target * self.weight, -1)
        self._numbers: dict[Atom, tuple[int, ...]] = {}
        """Columns of the atoms that some fit asked for."""
        self._whole: dict[Atom, Array] = {}
        self._kept: dict[Atom, NDArray[np.float32]] = {}
        """Columns of shelved atoms that reach other joints: too dear to predict again."""
        self._shelved: set[Atom] = set()
        self._coupled: set[Atom] = set()
        self._shelves: list[_Shelf] = []
        """Atoms of nonlinear grids, of which a search takes few."""
        self._near: dict[tuple[Candidate, frozenset[tuple[str, float]]], Atom] = {}
        """Atoms whose fingerprints hold near values that some fit gave them."""
        self.atoms: list[Atom] = []
        for trim in trims:
            self.add(trim, {})
        self.trims, self.atoms = tuple(self.atoms), []
        self.extend(candidates)

    def extend(self, candidates: Iterable[Candidate]) -> None:
        """Predict candidates at every point of their grids."""
        shelves: dict[tuple[int, int], _Shelf] = {}
        for candidate in candidates:
            effect, joint = candidate.effect, candidate.joint
            if all(effect.applies(s) for s in self.takes):
                grid = effect.grid_of(self.takes, joint)
                for atom, columns in self._predict(candidate, grid):
                    if len(grid) > 1 and not effect.whole_robot:
                        shelf = shelves.setdefault((joint, columns.shape[2]), _Shelf(joint))
                        shelf.put(atom, columns[:, joint])
                        self._shelved.add(atom)
                        if _coupled(columns, joint):
                            self._coupled.add(atom)
                            self._kept[atom] = columns.astype(np.float32)
                    else:
                        self._take(atom, columns)
        for shelf in shelves.values():
            shelf.close()
        self._shelves += shelves.values()

    def add(self, candidate: Candidate, fixed: Mapping[str, float]) -> Atom | None:
        """Predict a candidate at one point of its grid.

        None if it predicts nothing that the noise would let through.
        """
        added = self.add_all(candidate, [fixed])
        return added[0] if added else None

    def add_all(self, candidate: Candidate, grid: Sequence[Mapping[str, float]]) -> list[Atom]:
        """Predict a candidate at several points of its grid, without those that the noise would not let through."""
        out = []
        for atom, columns in self._predict(candidate, grid):
            self._take(atom, columns)
            out.append(atom)
        return out

    def _predict(self, candidate: Candidate, grid: Sequence[Mapping[str, float]]) -> Iterator[tuple[Atom, Array]]:
        """Atoms that the noise lets through, with their weighted columns. Shapes (rows, J, K)."""
        effect, parameters = candidate.effect, candidate.parameters
        prints = [effect.fingerprints(s, candidate.joint, grid) for s in self.takes] if grid else []
        for fixed, of_takes in zip(grid, zip(*prints, strict=True), strict=True):
            whole = _columns(of_takes) * self.weight[:, :, None]
            free = [k for k, p in enumerate(parameters) if p.name not in fixed][: of_takes[0].columns.shape[2]]
            linear = [*free, -1] if of_takes[0].constant is not None else free
            reach = [1.0 if k < 0 else _reach(effect, parameters[k]) for k in linear]
            # otherwise even the bound would hide in the noise
            shown = tuple(i for i in range(whole.shape[2]) if np.abs(whole[:, :, i]).max() * reach[i] > 1.0)
            if shown and np.abs(whole).max() < TORQUES.diverged:
                atom = Atom(candidate, dict(fixed), tuple(linear[i] for i in shown), shown)
                self.atoms.append(atom)
                yield atom, whole[:, :, list(shown)]

    def _take(self, atom: Atom, columns: Array) -> tuple[int, ...]:
        """Let fits use an atom. ``columns``: weighted, shape (rows, J, K)."""
        joint = atom.candidate.joint
        local = not _coupled(columns, joint)
        if not local:
            self._coupled.add(atom)
        self._numbers[atom] = tuple(
            self.products.add(columns[:, joint, k] if local else columns[:, :, k], joint if local else -1)
            for k in range(columns.shape[2])
        )
        return self._numbers[atom]

    def numbers(self, atom: Atom) -> tuple[int, ...]:
        """The atom's columns in :attr:`products`."""
        if atom in self._numbers:
            return self._numbers[atom]
        kept = self._kept.pop(atom, None)
        return self._take(atom, self.whole(atom) * self.weight[:, :, None] if kept is None else kept.astype(float))

    def whole(self, atom: Atom) -> Array:
        """What one unit of each coefficient of an atom predicts [N·m]. Shape (sum of N, J, K)."""
        if atom not in self._whole:
            c = atom.candidate
            prints = [c.effect.fingerprint(s, c.joint, atom.fixed) for s in self.takes]
            if len(self._whole) > 50:
                self._whole.clear()
            self._whole[atom] = _columns(prints)[:, :, list(atom.shown)]
        return self._whole[atom]

    @cached_property
    def weight(self) -> Array:
        """Inverse noise, zero where a sample is not to be used. Shape (sum of N, J)."""
        return np.concatenate([s.valid / noise for s, noise in zip(self.takes, self.noise, strict=True)])

    @cached_property
    def target(self) -> Array:
        """Missing torque of all takes [N·m]. Shape (sum of N, J)."""
        return np.concatenate([s.missing for s in self.takes])

    @cached_property
    def block(self) -> NDArray[np.intp]:
        """Block of each row. Shape (sum of N,)."""
        labels, first = [], 0
        for s in self.takes:
            own = ((s.time - s.time[0]) / TORQUES.block).astype(np.intp)
            labels.append(own + first)
            first += int(own[-1]) + 1
        return np.concatenate(labels)

    @cached_property
    def stretch(self) -> NDArray[np.intp]:
        """Stretch of each row: parts of a take, a few seconds long, each with its own level of error. Shape (rows,)."""
        seconds = max(TORQUES.stretch, sum(float(np.ptp(s.time)) for s in self.takes) / TORQUES.most_stretches)
        labels, first = [], 0
        for s in self.takes:
            count = max(1, round(float(np.ptp(s.time)) / seconds))
            labels.append(first + np.arange(len(s.time)) * count // len(s.time))
            first += count
        return np.concatenate(labels)

    @cached_property
    def correlation(self) -> float:
        """Rows per independent sample of white noise behind the Gaussian test function."""
        take = self.takes[0]
        return KERNEL_CORRELATION * take.kernel / (take.fine_step * float(np.diff(take.keep[:2])[0]))

    @cached_property
    def count(self) -> Array:
        """Valid rows per joint and stretch. Shape (J, S)."""
        used = (self.weight > 0).astype(float)
        return np.stack([np.bincount(self.stretch, used[:, j]) for j in range(self.joints)])

    def fit(self, atoms: Sequence[Atom], level: Array | None = None, trimmed: bool = True) -> Fit:
        """Bounded least squares of a combination, and of the trims that go with it.

        Args:
            atoms: The combination, without trims.
            level: Mean square to expect of the residual in each stretch of each joint, whose inverse is the weight.
                Shape (J, S); ones if None.
            trimmed: Whether trims are fitted beside it.
        """
        trims = [t for t in self.trims if all(t.candidate.moves_beside(a.candidate) for a in atoms)] if trimmed else []
        together = (*atoms, *trims)
        gram = self.products.gram([0, *(n for atom in together for n in self.numbers(atom))])
        low, high = _bounds(together)
        total = gram.sum((0, 1)) if level is None else np.tensordot(1.0 / level, gram, 2)
        doubt = self._doubt(trims, low, high)
        normal = total[1:, 1:] + self.correlation * np.diag(doubt)
        coefficients = bounded_least_squares(normal, total[1:, 0], low, high)
        x = np.append(1.0, -coefficients)
        strain = float(doubt @ coefficients**2)
        left = np.maximum((gram @ x) @ x, 0.0)
        energy, at = np.zeros((len(atoms), self.joints)), 1
        own = gram.sum(1)
        for k, atom in enumerate(atoms):
            part = slice(at, at + len(atom.linear))
            energy[k] = (own[:, part, part] @ x[part]) @ x[part]
            at = part.stop
        return Fit(together, len(atoms), coefficients, (low, high), strain, left, energy)

    def _doubt(self, trims: Sequence[Atom], low: Array, high: Array) -> Array:
        """Precision with which trims are known to be zero; zero for the rest, which stands before. Shape (columns,)."""
        out = np.zeros(len(low))
        count = sum(len(t.linear) for t in trims)
        if count:
            out[-count:] = (4.0 / (high[-count:] - low[-count:])) ** 2
        return out

    def near(self, fit: Fit) -> tuple[Atom, ...]:
        """The terms of a fit, with fingerprints that hold near its values."""
        out = []
        for atom, values in zip(fit.terms, fit.values(), strict=False):
            candidate = atom.candidate
            fixed = {**atom.fixed, **candidate.effect.near(candidate.parameters, values)}
            moved = atom if fixed == atom.fixed else replace(atom, fixed=fixed)
            out.append(self._near.setdefault((candidate, frozenset(fixed.items())), moved))
        return tuple(out)

    def is_coupled(self, atom: Atom) -> bool:
        """Whether an atom predicts torques of other joints than its own."""
        return atom in self._coupled

    def is_shelved(self, atom: Atom) -> bool:
        """Whether :meth:`gains` knows an atom."""
        return atom in self._shelved

    def gains(self, fit: Fit, level: Array, among: Callable[[Atom], bool] = lambda atom: True) -> dict[Atom, float]:
        """How much shelved atoms would lower the weighted sum of squares beside a fit, each on its own joint alone.

        Args:
            fit: Atoms that stay, with coefficients that move along unless they are at a bound.
            level: Mean square of each joint's residual. Shape (J,).
            among: Which atoms are asked about.
        """
        numbers = [n for atom in fit.atoms for n in self.numbers(atom)]
        low, high = fit.bounds
        margin = 1e-6 * (high - low)
        free = (fit.coefficients > low + margin) & (fit.coefficients < high - margin)
        moving = [n for n, f in zip(numbers, free, strict=True) if f]
        doubt = self.correlation * self._doubt(fit.atoms[fit.size :], low, high)[free]
        active = np.tensordot(1.0 / level, self.products.gram(moving).sum(1), 1) if moving else np.zeros((0, 0))
        active = active + np.diag(doubt)
        room = (low - fit.coefficients)[free], (high - fit.coefficients)[free]
        out: dict[Atom, float] = {}
        for shelf in self._shelves:
            asked = [k for k, atom in enumerate(shelf.atoms) if among(atom)]
            if not asked:
                continue
            rows = slice(None) if len(asked) == len(shelf.atoms) else asked  # a slice copies nothing
            j, shape = shelf.joint, (len(shelf.atoms), -1)
            left = shelf.cross(self.products, 0)
            for n, coefficient in zip(numbers, fit.coefficients, strict=True):
                left = left - coefficient * shelf.cross(self.products, n)
            right = left.reshape(shape)[rows]
            cross = [shelf.cross(self.products, n).reshape(shape)[rows] for n in moving]
            beside = np.stack(cross, -1) if cross else np.zeros((*right.shape, 0))
            least, most = (side[rows] for side in shelf.bounds)
            gram = shelf.gram[rows]
            gained = gains(gram / level[j], beside / level[j], active, right / level[j], least, most, room)
            out.update(zip((shelf.atoms[k] for k in asked), gained.tolist(), strict=True))
        return out

    def reaches(self, atom: Atom, joint: int) -> bool:
        """Whether an atom predicts anything on a joint."""
        return any(self.products.column(n, joint) is not None for n in self.numbers(atom))

    def rows(self, fit: Fit) -> Array:
        """What the combination leaves of the missing torque [N·m]. Shape (sum of N, J)."""
        left, at = self.target.copy(), 0
        for atom in fit.atoms:
            left -= self.whole(atom) @ fit.coefficients[at : at + len(atom.linear)]
            at += len(atom.linear)
        return left

    def prediction(self, fit: Fit, atom: Atom) -> Array:
        """The part of the missing torque that one atom of a combination explains [N·m]. Shape (sum of N, J)."""
        at = sum(len(other.linear) for other in fit.atoms[: fit.atoms.index(atom)])
        return np.asarray(self.whole(atom) @ fit.coefficients[at : at + len(atom.linear)])

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


class _Shelf:
    """Atoms of one joint with equally many columns."""

    def __init__(self, joint: int) -> None:
        self.joint = joint
        self.atoms: list[Atom] = []
        self._columns: list[Array] = []

    def put(self, atom: Atom, columns: Array) -> None:
        """``columns``: weighted, shape (rows, K)."""
        self.atoms.append(atom)
        self._columns.extend(np.ascontiguousarray(columns.T))

    def close(self) -> None:
        """All atoms are in."""
        columns = np.stack(self._columns)
        self._columns.clear()
        self._library = Library(columns, self.joint)
        groups = columns.reshape(len(self.atoms), -1, columns.shape[1])
        self.gram = groups @ groups.transpose(0, 2, 1)
        bounds = [_bounds([atom]) for atom in self.atoms]
        self.bounds = np.stack([b[0] for b in bounds]), np.stack([b[1] for b in bounds])

    def cross(self, products: Products, number: int) -> Array:
        """Inner products of all columns with one of the products' columns. Shape (columns,)."""
        return self._library.cross(products, number)


def _coupled(columns: Array, joint: int) -> bool:
    """Whether columns (rows, J, K) reach another joint."""
    return bool(np.delete(columns, joint, axis=1).any())


def _columns(prints: Sequence[Fingerprint]) -> Array:
    """Columns of all takes one after the other, the constant last. Shape (sum of N, J, K)."""
    return np.concatenate(
        [f.columns if f.constant is None else np.concatenate([f.columns, f.constant[:, :, None]], 2) for f in prints]
    )


def row_noise(takes: Sequence[Signals]) -> Array:
    """Standard deviation of the missing torque with nothing missing: sensor noise, and a floor below which nobody asks.

    Of sensors it is the mean over the takes with the same test function. Shape (takes, J).
    """
    alike = [[s.noise**2 for s in takes if s.kernel == one.kernel] for one in takes]
    noise = np.sqrt([np.mean(squares, axis=0) for squares in alike])
    typical = np.sqrt(np.mean(np.concatenate([s.command**2 + s.load**2 for s in takes]), axis=0))
    limit = np.array([torque_scale(takes[0].nominal, takes[0].address, j) for j in range(takes[0].num_joints)])
    return np.hypot(noise, TORQUES.torque_floor * np.maximum(np.minimum(limit, 10 * typical), typical))


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
        for joint, name in enumerate(s.recording.joint_names[: 1 if effect.whole_robot else None]):
            parameters = effect.parameters_of(takes, joint)
            if parameters:
                out.append(Candidate(effect, joint, None if effect.whole_robot else name, parameters))
    return out


def trims_for(takes: Sequence[Signals], trims: Sequence[Effect]) -> list[Candidate]:
    """What every model is a little wrong in, within a tolerance of the given numbers."""
    out = []
    for candidate in candidates_for(takes, trims):
        reach = candidate.effect.tolerance
        if candidate.effect.half_a_sample:  # is nobody's fault
            reach = max(reach, max(0.5 / s.recording.rate for s in takes) / candidate.parameters[0].scale)
        narrow = tuple(
            replace(p, lower=p.nominal - reach * p.scale, upper=p.nominal + reach * p.scale)
            for p in candidate.parameters
        )
        out.append(replace(candidate, parameters=narrow))
    return out


def is_trim(candidate: Candidate, values: Array, period: float, joints: int) -> bool:
    """Whether a fitted effect is no more than what every model and every log is off by.

    Args:
        candidate: The effect.
        values: Its parameters. Shape (P,).
        period: Of the recordings' samples [s]; the clock is off by half of it through nobody's fault.
        joints: Of the recordings. The clock makes them all late alike, so that of several not one alone.
    """
    if not candidate.effect.tolerance:
        return False
    reach = candidate.effect.tolerance * np.array([p.scale for p in candidate.parameters])
    if candidate.parameters[0].unit == "s" and (candidate.joint_name is None or joints == 1):
        reach = np.maximum(reach, 0.5 * period)
    return bool((np.abs(values - [p.nominal for p in candidate.parameters]) <= reach).all())


def _reach(effect: Effect, p: Parameter) -> float:
    """Greatest coefficient that the bounds allow."""
    return max(abs(effect.change(p, p.lower)), abs(effect.change(p, p.upper)), 1e-12)


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
    z = _within(n, r, lower, upper)
    if z is None:
        root = np.linalg.cholesky(n)
        z = lsq_linear(root.T, np.linalg.solve(root, r), (lower, upper), method="bvls").x
    x[free] = z * scale
    return x


def _within(n: Array, r: Array, lower: Array, upper: Array, rounds: int = 20) -> Array | None:
    """Least squares by moving whole sets to and from their bounds (Stark, Parker 1995); None if it goes in circles."""
    z: Array = np.asarray(np.linalg.solve(n, r), dtype=np.float64)
    bound = np.zeros(len(z), dtype=np.int8)
    for _ in range(rounds):
        out = np.where(bound == 0, np.where(z < lower, -1, np.where(z > upper, 1, 0)), 0)
        z = np.where(bound + out < 0, lower, np.where(bound + out > 0, upper, z))
        slope = r - n @ z  # what a step would gain
        back = (bound < 0) & (slope > 1e-12) | (bound > 0) & (slope < -1e-12)
        if not out.any() and not back.any():
            return z
        bound = np.where(back, 0, bound + out)
        inside = bound == 0
        z = z.copy()
        z[inside] = np.linalg.solve(n[np.ix_(inside, inside)], r[inside] - n[np.ix_(inside, ~inside)] @ z[~inside])
    return None
