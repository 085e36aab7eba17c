"""Search over combinations of effects in the torque domain.

A beam, then exchange and pruning, then the rivals of every term.
"""

from __future__ import annotations

from collections.abc import Callable, Collection, Iterable, Sequence
from dataclasses import dataclass, replace
from functools import partial
from itertools import combinations, takewhile

import numpy as np
from numpy.typing import NDArray

from torchrl_athletic.diagnosis.screen import Atom, Bank, Candidate, Fit, Key
from torchrl_athletic.diagnosis.thresholds import SEARCH

Array = NDArray[np.float64]

RIDGES = (1e-3, 1e-2, 1e-1, 1.0)
"""Ridges that are tried in predicting what is missing, whatever it is [1]."""


@dataclass(frozen=True, eq=False)
class Scored:
    """A fitted combination with its evidence; lower is better."""

    fit: Fit
    evidence: float


class Judge:
    """Scores combinations of a bank: twice the negative log evidence, by the count of independent samples.

    Every stretch of every joint has an error level of its own. So a limit that is reached in one second of a hundred
    counts, and a push in one take does not drown what the others say.

    Args:
        bank: Predictions of the candidates.
        noisy: Joints whose missing torque is noise, stronger than the sensors' own: what is usual there asks nothing.
    """

    def __init__(self, bank: Bank, noisy: Sequence[int] = ()) -> None:
        self.bank = bank
        self.total = np.maximum(bank.count, 1e-9)
        self.independent = bank.count / bank.correlation
        self.bare = bank.fit((), trimmed=False)
        """Nothing is adjusted."""
        self.floor = noise_level(bank) + SEARCH.accuracy**2 * self.mean_square(self.bare)
        if noisy:
            self.floor[noisy] = np.maximum(self.floor, SEARCH.open * self.usual(bank.fit(()))[:, None])[noisy]
        self._scores: dict[frozenset[Atom], Scored] = {}
        self._alternatives: dict[tuple[frozenset[Atom], Atom], list[Scored]] = {}

    def mean_square(self, fit: Fit) -> Array:
        """Mean square of the normalised residual, per joint and stretch. Shape (J, S)."""
        return np.asarray(fit.residual / self.total)

    def usual(self, fit: Fit) -> Array:
        """Median of the mean squares of a joint's stretches. Shape (J,)."""
        seen = self.bank.count > 0
        return np.array([np.median(m[s]) if s.any() else 0.0 for m, s in zip(self.mean_square(fit), seen, strict=True)])

    def level(self, fit: Fit) -> Array:
        """Mean square of the residual, at least what noise, smoothing and a right law leave. Shape (J, S)."""
        return np.maximum(self.mean_square(fit), self.floor)

    def excess(self, fit: Fit) -> Array:
        """Mean square beyond what noise and smoothing leave, per joint. Shape (J,)."""
        above = self.level(fit) - self.floor
        return np.asarray((self.total * above).sum(1) / self.total.sum(1))

    def score(self, atoms: Sequence[Atom], independent: Array | None = None, price: float | None = None) -> Scored:
        """Fit a combination and weigh it.

        Rows weigh by what is left around them, so that something unknown does not bend what the rest says.

        Args:
            atoms: The combination.
            independent: Independent samples in each stretch of each joint, if not those of white noise. Shape (J, S).
            price: Of a parameter; the logarithm of the number of samples (Schwarz 1978) if None.
        """
        key = frozenset(atoms)
        if independent is None and key in self._scores:
            return self._scores[key]
        fit = self.bank.fit(atoms)
        for _ in range(SEARCH.reweighted):
            fit = self.bank.fit(self.bank.near(fit), self.level(fit))
        count = self.independent if independent is None else independent
        penalty = (self.price(count) if price is None else price) * fit.freedom + SEARCH.term * fit.size
        evidence = float((count * np.log(self.level(fit))).sum())
        doubt = sum(_doubt(a) for a in fit.terms) if not fit.at_bound else np.inf
        scored = Scored(fit, evidence + float(penalty) + fit.strain + doubt)
        if independent is None:
            self._scores[key] = scored
        return scored

    @staticmethod
    def price(independent: Array) -> float:
        """Evidence that a parameter costs: the logarithm of the number of samples (Schwarz 1978)."""
        return float(np.log(max(independent.sum(), 3.0)))

    def promise(self, atoms: Sequence[Atom], parent: Fit) -> float:
        """Evidence of a combination fitted with the weights of its parent: cheap, and not above its own."""
        fit = self.bank.fit(atoms, self.level(parent))
        penalty = self.price(self.independent) * fit.freedom + SEARCH.term * fit.size
        return float((self.independent * np.log(self.level(fit))).sum()) + float(penalty) + fit.strain

    def is_open(self, fit: Fit) -> NDArray[np.bool_]:
        """Which joints miss more torque than noise explains, at least in some stretch. Shape (J,)."""
        usual = SEARCH.open * self.floor
        chance = 1.0 + SEARCH.chance * np.sqrt(2.0 / np.maximum(self.independent, 1.0))
        whole = fit.residual.sum(1) > (self.total * usual).sum(1)
        return np.asarray(whole | (self.mean_square(fit) > usual * chance).any(1))

    def helps(self, before: Fit, after: Fit) -> bool:
        """Whether the step closes a material share of what was open, or relieves the trims.

        What a true term leaves, because a real bearing is no formula, is not to be explained by another: a step that is
        smaller than that must close much and have the same strength on all recordings, as no such stand-in has.
        """
        if _relieves(before, after):
            return True
        _, share = self._closed(before, after)
        if not self.within_misfit(before, after):
            return share > SEARCH.material
        known = keys(before.terms)
        newest = [term for term in after.terms if term.candidate.key not in known]
        return share > SEARCH.richer and all(scatter(self.bank, after, term) < SEARCH.steady for term in newest)

    def within_misfit(self, before: Fit, after: Fit) -> bool:
        """Whether the step closes no more than what the terms may leave, being simpler than nature."""
        joint, _ = self._closed(before, after)
        bare, total = float(self.excess(self.bare)[joint]), float(self.total[joint].sum())
        misfit = max(
            (
                term.candidate.effect.misfit * min(float(energy[joint]) / total, bare)
                for term, energy in zip(before.terms, before.energy, strict=True)
                if term.candidate.joint == joint
            ),
            default=0.0,
        )
        return float(self.excess(before)[joint] - self.excess(after)[joint]) < misfit

    def closes(self, before: Fit, after: Fit) -> float:
        """Share of what was open that the step closes, on the joint where it does most."""
        return self._closed(before, after)[1]

    def _closed(self, before: Fit, after: Fit) -> tuple[int, float]:
        was, left = self.excess(before), self.excess(after)
        gained = (self.independent * np.log(self.level(before) / self.level(after))).sum(1)
        joint = int(np.argmax(gained))
        return joint, float(1.0 - left[joint] / was[joint]) if was[joint] > 0 else 0.0


def search(
    judge: Judge,
    progress: Callable[[float], None] = lambda fraction: None,
    late: Callable[[], bool] = lambda: False,
) -> list[Scored]:
    """The best combinations, best first. The empty one is among them only if nothing material was found.

    Args:
        judge: Scores them.
        progress: Told the finished fraction.
        late: Whether nothing further is to be asked: what was found by then comes back.
    """
    bank = judge.bank
    beam, finished = [judge.score(())], []
    most = SEARCH.most_per_joint * bank.joints
    for depth in range(most):
        grown: dict[frozenset[Key], Scored] = {}
        for parent in beam:
            children = _extensions(judge, parent)
            if not children:
                finished.append(parent)
            for child in children:
                key = keys(child.fit.terms)
                if key not in grown or child.evidence < grown[key].evidence:
                    grown[key] = child
        progress((depth + 1) / most)
        if not grown:
            break
        if late():
            finished.extend(sorted(grown.values(), key=lambda s: s.evidence)[: SEARCH.beam])
            break
        beam = [_refine(judge, s) for s in sorted(grown.values(), key=lambda s: s.evidence)[: SEARCH.beam]]
    else:
        finished.extend(beam)
    best = sorted(finished, key=lambda s: s.evidence)[: SEARCH.beam]
    in_time = takewhile(lambda _: not late(), best)  # what is not polished looks better than it is
    polished = [_polish(judge, s) for s in in_time] or best
    unique = {keys(s.fit.terms): s for s in sorted(polished, key=lambda s: -s.evidence)}
    return sorted(unique.values(), key=lambda s: s.evidence)


def _polish(judge: Judge, scored: Scored) -> Scored:
    """Exchange, drop, merge, simplify, drop again: what is superfluous must not be merged into a false whole.

    What does not hold everywhere may have kept up a richer law beside it, so that one is asked about again.
    """
    for term in scored.fit.terms:  # those that came later move what the earlier ones were
        scored = _refine(judge, scored, term.candidate)
    needed = _prune(judge, _exchange(judge, scored))
    simple = _prune(judge, _simplest(judge, _merge(judge, needed)))
    kept = _invariant(judge, simple)
    return kept if kept is simple else _prune(judge, _simplest(judge, kept))


def richer(judge: Judge, best: Scored) -> Scored | None:
    """The combination with a richer law for one that it contains, if its evidence is decisively better.

    The search gave it up, since every superset wins by a little. Whether that little is physics, the simulation knows:
    in the torque domain a joint that mostly sticks says nothing of how it slides.
    """
    terms, joints = best.fit.terms, {a.candidate.joint_name for a in best.fit.terms}
    trials = []
    for candidate in {a.candidate: None for a in judge.bank.atoms if a.candidate.joint_name in joints}:
        beside = [t for t in terms if t.candidate.joint_name == candidate.joint_name]
        parts = tuple(t for t in beside if not candidate.allows(t.candidate))
        if parts and all(t.candidate is not candidate for t in parts):
            trial = _merged(judge, terms, parts, candidate)
            more = [a for a in trial.fit.terms if a.candidate is candidate]
            if more and all(_is_richer(more[0], t) for t in parts):
                trials.append(trial)
    if not trials:
        return None
    rich = min(trials, key=lambda s: s.evidence)
    plain = _simplest(judge, rich)  # friction by direction may be the dry part that viscous friction alone lacked
    found = judge.score(()).evidence - best.evidence
    for trial in (rich,) if keys(plain.fit.terms) == keys(best.fit.terms) else (plain, rich):
        gained = best.evidence - trial.evidence
        if gained > SEARCH.decisive and (
            gained > SEARCH.seen * found or judge.closes(best.fit, trial.fit) > SEARCH.seen
        ):
            return trial
    return None


def rivals(judge: Judge, best: Scored, within: float) -> list[tuple[Scored, float]]:
    """Combinations with another effect in the place of one term, each with the evidence that it lies behind.

    Args:
        judge: Of the search.
        best: What it found.
        within: Evidence behind which a rival is left out.
    """
    out: dict[frozenset[Key], tuple[Scored, float]] = {}
    for term in best.fit.terms:
        found = alternatives(judge, best, term)
        own = next(s for s in found if keys(s.fit.terms) == keys(best.fit.terms))
        for s in found:
            behind = max(s.evidence - own.evidence, 0.0)
            if s is not own and behind < within and keys(s.fit.terms) not in out:
                out[keys(s.fit.terms)] = judge.score(s.fit.terms), behind
    return sorted(out.values(), key=lambda r: r[1])


def singles(judge: Judge) -> tuple[list[Scored], list[Scored]]:
    """Effects alone: those that close a material share, what closes most first, whatever their evidence; the others.

    Where trims take all of the missing torque, nothing is left to be closed. The others come by their evidence.
    """
    nothing = judge.score(())
    alone = [judge.score([atom]) for atom in _promising(judge, nothing, _shortlist(judge, nothing))]
    closed = {s: judge.closes(nothing.fit, s.fit) for s in alone if not s.fit.at_bound}
    material = sorted((s for s in closed if closed[s] > SEARCH.material), key=lambda s: -closed[s])
    return material, sorted((s for s in closed if closed[s] <= SEARCH.material), key=lambda s: s.evidence)


def noise_level(bank: Bank) -> Array:
    """Mean square of the normalised missing torque where nothing is missing: sensor noise, and what smoothing bends.

    Shape (J, S).
    """
    bias = (np.concatenate([s.bias for s in bank.takes]) * bank.weight) ** 2
    total = np.stack([np.bincount(bank.stretch, bias[:, j]) for j in range(bank.joints)])
    return np.asarray(1.0 + total / np.maximum(bank.count, 1.0), dtype=np.float64)


def noisy_joints(judge: Judge) -> list[int]:
    """Joints that miss torque all the time, of which nothing tried so far predicts a part: noise, nobody's physics."""
    bare = judge.score(()).fit
    always = judge.is_open(bare) & (judge.usual(bare) > SEARCH.open * np.median(judge.floor, axis=1))
    return [int(j) for j in np.flatnonzero(always) if predictable_share(judge.bank, int(j)) <= SEARCH.predictable]


def predictable_share(bank: Bank, joint: int) -> float:
    """Share of the missing torque that motion and command predict on blocks that were not fitted, 0..1.

    All columns that the search has tried are a rich basis. Where even that predicts nothing, what looks open is noise
    with a memory. A basis as rich as the recordings are long would fit their noise, so that the best of several ridges
    counts; they are in units of the columns' energy on all blocks, since many columns act on few.
    """
    columns = bank.products.touching(joint)  # the target comes first
    if len(np.unique(bank.block)) < 2 * SEARCH.folds:
        return 1.0
    folds = (
        columns[:, bank.block % SEARCH.folds == fold] for fold in range(SEARCH.folds)
    )  # one at a time: they are large
    gram = np.stack([part @ part.T for part in folds])
    whole = gram.sum(0)
    scale = 1.0 / np.sqrt(np.maximum(np.diag(whole), 1e-300))
    left = np.zeros(len(RIDGES))
    for aside in gram:
        g, h = (part * scale * scale[:, None] for part in (whole - aside, aside))
        for k, ridge in enumerate(RIDGES):
            x = np.append(1.0, -np.linalg.solve(g[1:, 1:] + ridge * np.eye(len(g) - 1), g[1:, 0]))
            left[k] += float(x @ h @ x)
    return float(np.clip(1.0 - left.min(), 0.0, 1.0))


def alternatives(judge: Judge, best: Scored, term: Atom) -> list[Scored]:
    """The combination with one term replaced by each other candidate, at its best grid point; best first.

    Scored with the number of independent samples that the best combination's residual has. A law of which the term is a
    special case is no rival where the search gave it up for the term, and pays the full price for its numbers: at
    Akaike's, it would keep its share however much is recorded.
    """
    key = frozenset(best.fit.terms), term
    if key not in judge._alternatives:
        judge._alternatives[key] = _alternatives(judge, best, term)
    return judge._alternatives[key]


def as_rival(judge: Judge, best: Scored, atoms: Sequence[Atom]) -> Scored:
    """A combination as :func:`alternatives` weighs it: by the independent samples that the best one's residual has."""
    return judge.score(atoms, _independent(judge, best), SEARCH.rival_price)


def _independent(judge: Judge, best: Scored) -> Array:
    samples = judge.bank.independent_samples(judge.bank.rows(best.fit))
    return judge.independent * np.minimum(1.0, samples / np.maximum(judge.independent.sum(1), 1e-9))[:, None]


def _alternatives(judge: Judge, best: Scored, term: Atom) -> list[Scored]:
    independent = _independent(judge, best)
    rest = [a for a in best.fit.terms if a is not term]
    own = judge.score(best.fit.terms, independent, SEARCH.rival_price)
    out = {term.candidate.key: own}
    kept = judge.score(rest)
    promising = _promising(judge, kept, _shortlist(judge, kept), 2 * SEARCH.promising)
    promising.sort(key=lambda a: judge.score([*rest, a]).evidence)
    for rank, rival in enumerate(promising):
        whole = judge.score([*rest, rival])
        atom = _of(_refine(judge, whole, rival.candidate) if rank < SEARCH.refined else whole, rival.candidate)
        scored = judge.score([*rest, atom], independent, SEARCH.rival_price)
        key = atom.candidate.key
        little = judge.closes(best.fit, scored.fit) < SEARCH.richer and not _relieves(best.fit, scored.fit)
        if _is_special(term, atom):  # the gain of its further numbers is chance, however much is recorded
            seen = judge.is_open(best.fit)[term.candidate.joint]
            little |= seen and judge.within_misfit(best.fit, scored.fit)
            little |= _is_bent(judge, best, scored, term.candidate.joint)
            more = scored.fit.freedom - best.fit.freedom
            scored = replace(scored, evidence=scored.evidence + more * (judge.price(independent) - SEARCH.rival_price))
        if little:
            if _contains(atom, term) or _is_special(term, atom):
                continue  # the same statement with more numbers
            if _is_richer(atom, term):  # it was given up for the simpler one: at most its equal
                scored = replace(scored, evidence=max(scored.evidence, own.evidence))
        if key != term.candidate.key and (key not in out or scored.evidence < out[key].evidence):
            out[key] = scored
    return sorted(out.values(), key=lambda s: s.evidence)


def _extensions(judge: Judge, parent: Scored) -> list[Scored]:
    is_open = judge.is_open(parent.fit)
    if not parent.fit.terms or parent.fit.strain > SEARCH.decisive:  # trims may hide an effect
        is_open |= judge.is_open(judge.bare)
    if not is_open.any():
        return []
    best: dict[Key, Scored] = {}
    atoms = [a for a in _shortlist(judge, parent) if is_open[a.candidate.joint] or _coupled(judge.bank, a, is_open)]
    for atom in _promising(judge, parent, atoms):
        scored = judge.score([*parent.fit.terms, atom])
        key = atom.candidate.key
        if key not in best or scored.evidence < best[key].evidence:
            best[key] = scored
    good = [
        s for s in best.values() if parent.evidence - s.evidence > SEARCH.decisive and judge.helps(parent.fit, s.fit)
    ]
    return sorted(good, key=lambda s: s.evidence)


def _promising(judge: Judge, parent: Scored, atoms: Sequence[Atom], most: int = SEARCH.promising) -> list[Atom]:
    """The atoms that promise most beside a combination, one a candidate."""
    best: dict[Key, tuple[float, Atom]] = {}
    for atom in atoms:
        promise = judge.promise([*parent.fit.terms, atom], parent.fit)
        if atom.candidate.key not in best or promise < best[atom.candidate.key][0]:
            best[atom.candidate.key] = promise, atom
    return [atom for _, atom in sorted(best.values(), key=lambda b: b[0])[:most]]


def _refine(judge: Judge, scored: Scored, candidate: Candidate | None = None, rounds: int = 3) -> Scored:
    """Go down the grid of every nonlinear parameter of a term, the newest if none is named, and halve it there.

    What a coarse delay leaves would otherwise be given other names. Going down comes first: the grid may have been made
    fine elsewhere, beside other terms.
    """
    if not scored.fit.terms:
        return scored
    candidate = scored.fit.terms[-1].candidate if candidate is None else candidate
    rest = [a for a in scored.fit.terms if a.candidate is not candidate]
    here = _of(scored, candidate)
    own = {p.name for p in candidate.parameters}
    if not here.fixed.get("creep", 0.0):
        own.add("presliding")  # no parameter, but what a wrong one leaves hides weaker effects
    for name in sorted(own & here.fixed.keys()):
        scored = _down(judge, scored, candidate, name)
        for _ in range(rounds):
            here = _of(scored, candidate)
            value = here.fixed[name]
            near = _between({a.fixed[name] for a in _line(judge, here, name)}, value, *_range(here, name))
            for atom in judge.bank.add_all(candidate, [{**here.fixed, name: x} for x in near]):
                scored = min(scored, judge.score([*rest, atom]), key=lambda s: s.evidence)
    return scored


def _down(judge: Judge, scored: Scored, candidate: Candidate, name: str) -> Scored:
    """Move one parameter of a term from grid point to grid point while the evidence gains."""
    rest = [a for a in scored.fit.terms if a.candidate is not candidate]
    while True:
        here = _of(scored, candidate)
        line = sorted(_line(judge, here, name), key=lambda a: a.fixed[name])
        at = next(k for k, a in enumerate(line) if a.fixed[name] == here.fixed[name])
        best = min((judge.score([*rest, a]) for a in line[max(at - 1, 0) : at + 2]), key=lambda s: s.evidence)
        if best.evidence >= scored.evidence:
            return scored
        scored = best


def _line(judge: Judge, here: Atom, name: str) -> list[Atom]:
    """All points of an atom's grid that differ from it in one parameter at most."""
    return [a for a in judge.bank.atoms if a.candidate is here.candidate and _differs_in(a, here, name)]


def _of(scored: Scored, candidate: Candidate) -> Atom:
    """The term of a combination that is a candidate's."""
    return next(a for a in scored.fit.terms if a.candidate is candidate)


def _between(grid: Iterable[float], value: float, lower: float, upper: float) -> list[float]:
    """Half-way from a grid point to its neighbours; as far beyond an end of the grid, within the parameter's bounds.

    Example:
        >>> _between({1.0, 2.0, 2.001, 4.0}, 2.0, 0.0, 10.0)
        [1.5, 3.0]
        >>> _between({1.0, 2.0}, 2.0, 0.0, 2.2)
        [1.5, 2.2]
    """
    steps = [
        x - value for x in grid if abs(x - value) > SEARCH.finest * abs(value)
    ]  # periods of samples lie beside the grid
    down, up = (max((s for s in steps if s < 0), default=None), min((s for s in steps if s > 0), default=None))
    down, up = down if down is not None or up is None else -up, up if up is not None or down is None else -down
    near = [min(max(value + step / 2, lower), upper) for step in (down, up) if step is not None]
    return [x for x in near if abs(x - value) > SEARCH.finest * abs(value)]


def _range(atom: Atom, name: str) -> tuple[float, float]:
    """Bounds of a parameter; none of a number that is no parameter is passed."""
    known = {p.name: (p.lower, p.upper) for p in atom.candidate.parameters}
    return known.get(name, (atom.fixed[name], atom.fixed[name]))


def _differs_in(one: Atom, other: Atom, name: str) -> bool:
    """Whether two grid points of a candidate lie on one line."""
    return all(one.fixed[k] == v for k, v in other.fixed.items() if k != name)


def _exchange(judge: Judge, scored: Scored, rounds: int = 3) -> Scored:
    """Replace single terms while the evidence gains.

    The first term of a greedy search is often a stand-in for two others. What cannot reach its joint stands for none
    of what it did.
    """
    for _ in range(rounds):
        better = scored
        for term in scored.fit.terms:
            rest = [a for a in scored.fit.terms if a is not term]
            kept = judge.score(rest)
            near = {j for j in range(judge.bank.joints) if judge.bank.reaches(term, j)}
            for atom in _promising(judge, kept, _shortlist(judge, kept, partial(_may_reach, judge.bank, near)), 6):
                trial = judge.score([*rest, atom])
                if trial.evidence < better.evidence - 1.0:
                    better = trial
            parts = _split(judge, kept, term, term.candidate.effect.excludes)
            if parts.evidence < better.evidence - 1.0:
                better = parts
        if better is scored:
            break
        scored = better
    return scored


def _may_reach(bank: Bank, joints: Collection[int], atom: Atom) -> bool:
    """Whether an effect is of one of these joints, or acts on others than its own."""
    own = atom.candidate.effect.own_joint and not bank.is_coupled(atom)
    return not own or atom.candidate.joint in joints


def _merge(judge: Judge, scored: Scored) -> Scored:
    """Replace two terms of a joint, or all that a cause of the whole robot excludes, by one that explains as much.

    Gains that are off look like a weaker motor with more friction, a late clock like late motors on all joints.
    """
    everywhere = {a.candidate for a in judge.bank.atoms if a.candidate.joint_name is None}
    while True:
        terms = scored.fit.terms
        pairs = [
            pair for pair in combinations(terms, 2) if pair[0].candidate.joint_name == pair[1].candidate.joint_name
        ]
        trials = [_merged(judge, terms, pair, None) for pair in pairs]
        for candidate in sorted(everywhere, key=lambda c: c.effect.name):
            parts = tuple(t for t in terms if not candidate.allows(t.candidate))
            if len(parts) > 1:
                trials.append(_merged(judge, terms, parts, candidate))
        best = min([scored, *trials], key=lambda s: s.evidence)
        if best is scored:
            return scored
        scored = best


def _merged(judge: Judge, terms: Sequence[Atom], parts: Sequence[Atom], whole: Candidate | None) -> Scored:
    """The combination with the best single term instead of some: one of their joint, or the given one."""
    kept = judge.score([t for t in terms if t not in parts])

    def fits(atom: Atom) -> bool:
        c = atom.candidate
        return c.joint_name == parts[0].candidate.joint_name if whole is None else c is whole

    atoms = _shortlist(judge, kept, fits)
    trials = [judge.score([*kept.fit.terms, atom]) for atom in _promising(judge, kept, atoms, 3)]
    return _refine(judge, min(trials, key=lambda s: s.evidence)) if trials else kept


def _split(judge: Judge, kept: Scored, term: Atom, names: Collection[str]) -> Scored:
    """A combination without a term, with two of the named simpler effects of its joint instead."""
    parts = [
        atom
        for atom in judge.bank.atoms
        if atom.candidate.joint_name == term.candidate.joint_name
        and atom.candidate.effect.name in names
        and atom.freedom < term.freedom
    ]
    best = kept
    for _ in range(2):
        beside = [a.candidate for a in best.fit.terms]
        allowed = [atom for atom in parts if all(atom.candidate.allows(other) for other in beside)]
        trials = [judge.score([*best.fit.terms, atom]) for atom in _promising(judge, best, allowed, 3)]
        best = min([best, *trials], key=lambda s: s.evidence)
    return best


def _simplest(judge: Judge, scored: Scored, rounds: int = 3) -> Scored:
    """Simplify while something simpler will do: what took a law's place may have to be given up as well."""
    for _ in range(rounds):
        simpler = _simplify(judge, scored)
        if simpler is scored:
            break
        scored = simpler
    return scored


def _simplify(judge: Judge, scored: Scored) -> Scored:
    """Give up an effect for a simpler one or its special cases, unless it closes a material share more.

    A superset always wins by a little: friction by direction or over time, where it is neither.
    """
    for term in scored.fit.terms:
        rest = [a for a in scored.fit.terms if a is not term]
        kept = judge.score(rest)
        smaller = _shortlist(judge, kept, partial(_is_richer, term))
        simpler = [judge.score([*rest, atom]) for atom in _promising(judge, kept, smaller, 4)]
        if simpler:
            best = min(simpler, key=lambda s: s.evidence)
            if judge.closes(best.fit, scored.fit) < SEARCH.richer and not _relieves(best.fit, scored.fit):
                scored = best
                continue
        if term.candidate.effect.special_cases:
            parts = _split(judge, kept, term, term.candidate.effect.special_cases)
            little = judge.closes(parts.fit, scored.fit) < SEARCH.richer and not _relieves(parts.fit, scored.fit)
            if little or _is_bent(judge, parts, scored, term.candidate.joint):
                scored = parts
    return scored


def _is_bent(judge: Judge, plain: Scored, rich: Scored, joint: int) -> bool:
    """Whether a richer law may owe what it explains more to a bearing that is no formula.

    Not if it explains all of it; nor, where both are good to the noise or it tells directions apart as no bearing does,
    if much of the joint's evidence speaks for it.
    """
    if judge.closes(plain.fit, rich.fit) >= SEARCH.all or not judge.within_misfit(plain.fit, rich.fit):
        return False
    bare, without, level = (judge.level(fit)[joint] for fit in (judge.bare, plain.fit, rich.fit))
    found, gained = (float(judge.independent[joint] @ np.log(before / level)) for before in (bare, without))
    known = keys(plain.fit.terms)
    sided = any(
        _is_sided(term.candidate, values)
        for term, values in zip(rich.fit.terms, rich.fit.values(), strict=False)
        if term.candidate.joint == joint and term.candidate.key not in known
    )
    return (bool(judge.is_open(plain.fit)[joint]) and not sided) or gained < SEARCH.seen * found


def _is_sided(candidate: Candidate, values: Array) -> bool:
    """Whether numbers that simpler laws have equal are far from it, all of them together, in units of their scales."""
    of = {p.name: value / p.scale for p, value in zip(candidate.parameters, values, strict=True)}
    pairs = [(of[pair[0]], of[pair[1]]) for pair in candidate.effect.sets_apart if not isinstance(pair, str)]
    return bool(sum(abs(a - b) for a, b in pairs) > SEARCH.sided * sum(abs(a) + abs(b) for a, b in pairs) / 2)


def scatter(bank: Bank, fit: Fit, term: Atom) -> float:
    """How much a term's strength differs between takes, relative to its mean, weighted by what it predicts there.

    Physics has one value on all recordings; a stand-in for other physics needs another one on each (Peters, Bühlmann,
    Meinshausen 2016, invariant prediction). The other terms keep their values.
    """
    predicted, left = bank.prediction(fit, term) * bank.weight, bank.rows(fit) * bank.weight
    rows = len(predicted)
    if len(bank.takes) >= 3:
        part = np.repeat(np.arange(len(bank.takes)), [len(s.time) for s in bank.takes])
    else:
        part = np.arange(rows) * SEARCH.parts // rows
    energy = np.bincount(part, (predicted**2).sum(1))
    strength = np.bincount(part, (predicted * (left + predicted)).sum(1)) / np.maximum(energy, 1e-300)
    mean = float(energy @ strength / max(energy.sum(), 1e-300))
    spread = float(np.sqrt(energy @ (strength - mean) ** 2 / max(energy.sum(), 1e-300)))
    return spread / max(abs(mean), 1e-12)


def _invariant(judge: Judge, scored: Scored) -> Scored:
    """Drop terms that do not hold everywhere, the worst first.

    The last one stays, and one that accounts for much of what is missing: as a stand-in of low probability.
    """
    kept: set[Candidate] = set()
    while len(scored.fit.terms) > 1:
        terms = [t for t in scored.fit.terms if t.candidate not in kept]
        scatters = [scatter(judge.bank, scored.fit, term) for term in terms]
        if not terms or max(scatters) <= SEARCH.invariant:
            break
        worst = terms[int(np.argmax(scatters))]
        smaller = judge.score([t for t in scored.fit.terms if t is not worst])
        missing, without, left = (judge.excess(f) for f in (judge.bare, smaller.fit, scored.fit))
        share = (without - left) / np.maximum(missing, 1e-12)
        everywhere = worst.candidate.joint_name is None
        if (share[missing > 1.0].max(initial=0.0) if everywhere else share[worst.candidate.joint]) > SEARCH.much:
            kept.add(worst.candidate)
        else:
            scored = smaller
    return scored


def _prune(judge: Judge, scored: Scored) -> Scored:
    """Drop terms that others have made superfluous."""
    while scored.fit.terms:
        trials = [judge.score([a for a in scored.fit.terms if a is not term]) for term in scored.fit.terms]
        weakest = min(trials, key=lambda s: s.evidence)
        if weakest.evidence - scored.evidence > SEARCH.decisive and judge.helps(weakest.fit, scored.fit):
            break
        scored = weakest
    return scored


def _shortlist(judge: Judge, parent: Scored, among: Callable[[Atom], bool] = lambda atom: True) -> list[Atom]:
    """What may stand beside a combination: of each nonlinear candidate the grid points that promise most.

    Args:
        judge: Of the bank.
        parent: The combination.
        among: Which atoms are asked about; points that are not take no places from those that are.
    """
    bank, chosen = judge.bank, [a.candidate for a in parent.fit.terms]
    total = judge.total.sum(1)
    gained = bank.gains(parent.fit, (judge.total * judge.level(parent.fit)).sum(1) / total, among)
    ranks: dict[Key, list[Atom]] = {}
    for atom in sorted(gained, key=lambda a: -gained[a]):
        ranks.setdefault(atom.candidate.key, []).append(atom)
    promising = {atom for rank in ranks.values() for atom in rank[: SEARCH.shortlist]}
    return [
        a
        for a in bank.atoms
        if (a in promising or (not bank.is_shelved(a) and among(a)))
        and all(a.candidate.allows(c) for c in chosen)
        and sum(c.joint == a.candidate.joint for c in chosen) < SEARCH.most_per_joint
    ]


def _coupled(bank: Bank, atom: Atom, is_open: NDArray[np.bool_]) -> bool:
    return any(bank.reaches(atom, int(j)) for j in np.flatnonzero(is_open))


def _relieves(before: Fit, after: Fit) -> bool:
    """Whether trims have decisively less to make up for."""
    return before.strain - after.strain > SEARCH.decisive / 2


def _doubt(atom: Atom) -> float:
    """Prior: evidence against the name, whatever the recordings say."""
    return -2 * np.log(atom.candidate.effect.odds)


def _is_richer(one: Atom, other: Atom) -> bool:
    """Whether an effect of the same joint has more parameters."""
    return one.candidate.joint_name == other.candidate.joint_name and one.freedom > other.freedom


def _contains(larger: Atom, smaller: Atom) -> bool:
    """Whether one effect is the other with more parameters."""
    return _is_richer(larger, smaller) and smaller.candidate.effect.name in larger.candidate.effect.excludes


def _is_special(simple: Atom, rich: Atom) -> bool:
    """Whether one effect is a special case of the other, on the same joint."""
    return _is_richer(rich, simple) and simple.candidate.effect.name in rich.candidate.effect.special_cases


def keys(atoms: Iterable[Atom]) -> frozenset[Key]:
    """Effects and joints of a combination."""
    return frozenset(a.candidate.key for a in atoms)
