"""What the torque domain proposes, and who could stand in the place of a term of it."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace

import numpy as np
from numpy.typing import NDArray

from torchrl_athletic.diagnosis.screen import Atom, Candidate, Key
from torchrl_athletic.diagnosis.search import Judge, Scored, alternatives, as_rival, keys

Array = NDArray[np.float64]


@dataclass(frozen=True, eq=False)
class Proposal:
    """A combination of effects that the torques speak for: of the mechanics, or of the drive alone."""

    judge: Judge
    best: Scored
    behind: float = 0.0
    """Evidence that the recordings' torques give against it, beside the first; infinite for one that gives no names."""
    on_trial: bool = False
    """Whether the simulation has to be decisively better with it than with the first, and to close much of what that
    leaves: a law that holds the first as a special case, and an effect that is asked about late."""
    alone: bool = False
    """Whether it is an effect that was asked about alone, whatever the torques say."""
    joints: bool = False
    """Whether it is what the fit of the standard joints needs."""
    motion: bool = False
    """Whether it is what the motion asks for, one effect after the other."""
    offered: frozenset[Key] = frozenset()
    """What the motion might have asked for; nothing where the time did not suffice to ask for all."""
    torques: Proposal | None = None
    """What the torques speak for beside it."""
    rivals: Mapping[Key, Sequence[tuple[Atom, float]]] = field(default_factory=dict)
    """Of such a term, what could stand in its place: twice the log odds that the motion gives against it."""
    simulated: Mapping[frozenset[Key], float] = field(default_factory=dict)
    """Combination -> twice the log odds that the simulation gives against it, for those that were fitted."""
    others: tuple[Scored, ...] = ()
    """Other combinations that neither torques nor simulation refute."""

    @property
    def by_simulation(self) -> bool:
        """Whether the simulation has chosen it, whatever the torques say."""
        return self.joints or self.motion

    def backing(self, key: Key) -> Atom | None:
        """The term of that name that the torques speak for as well."""
        terms = self.torques.best.fit.terms if self.torques is not None else ()
        return next((a for a in terms if a.candidate.key == key), None)

    def left_of(self, candidate: Candidate) -> float:
        """Share of the excess that is left where an effect acts: on its joint, or on the one explained worst."""
        left = self.left()
        return float(left.max() if candidate.joint_name is None else left[candidate.joint])

    def excess_of(self, candidate: Candidate) -> float:
        """Mean square that stays there, beyond the noise and in its units."""
        excess = self.judge.excess(self.best.fit)
        return float(excess.max() if candidate.joint_name is None else excess[candidate.joint])

    def left(self) -> Array:
        """Share of each joint's excess missing torque that is left. Shape (J,)."""
        before, after = (self.judge.excess(fit) for fit in (self.judge.bare, self.best.fit))
        return np.where(before > 1.0, np.clip(after / np.maximum(before, 1e-12), 0.0, 1.0), 0.0)


@dataclass(frozen=True, eq=False)
class StandIn:
    """What could stand in a term's place."""

    atom: Atom
    """Its name."""
    scored: Scored
    """The combination that has it."""
    evidence: float
    """Evidence of torques and simulation against that combination; lower is better."""
    share: float = 0.0
    """Share of the evidence among all that could stand there."""


def answer_set(part: Proposal, term: Atom) -> list[StandIn]:
    """Who could stand in a term's place, itself included, with the share of the evidence that each has.

    Each other effect in its place, beside all other terms; and an effect that alone does what this term and others of
    its joint do together, as gains that are off do of a rotor with a lag. Of what the simulation has chosen
    and the torques do not speak for, only the motion says what could stand in its place.
    """
    if part.by_simulation:
        backing = part.backing(term.candidate.key)
        if part.torques is not None and backing is not None:
            return answer_set(part.torques, backing)
        return _by_simulation(part, term)
    found = keys(part.best.fit.terms)
    beside = found - {term.candidate.key}
    replaced = alternatives(part.judge, part.best, term)
    options = [(next(a for a in s.fit.terms if a.candidate.key not in beside), s) for s in replaced]
    for other in part.others:
        atom = _instead(part.best, other)
        if atom is not None and term.candidate.key not in keys(other.fit.terms):
            options.append((atom, as_rival(part.judge, part.best, other.fit.terms)))
    untried = part.simulated.get(found, 0.0)  # by the simulation: no better than the best
    out = [StandIn(a, s, s.evidence + part.simulated.get(keys(s.fit.terms), untried)) for a, s in options]
    best: dict[Key, StandIn] = {}
    for option in sorted(out, key=lambda o: o.evidence):
        best.setdefault(option.atom.candidate.key, option)
    least = min(o.evidence for o in best.values())
    weights = np.exp(-0.5 * np.array([o.evidence - least for o in best.values()]))
    return [replace(o, share=float(w)) for o, w in zip(best.values(), weights / weights.sum(), strict=True)]


def _by_simulation(part: Proposal, term: Atom) -> list[StandIn]:
    """What the motion would take in a term's place, as far as it was asked."""
    rest = [a for a in part.best.fit.terms if a is not term]
    options = [StandIn(term, part.best, 0.0)]
    for atom, against in part.rivals.get(term.candidate.key, ()):
        if all(atom.candidate.allows(a.candidate) for a in rest):
            options.append(StandIn(atom, as_rival(part.judge, part.best, [*rest, atom]), against))
    weights = np.exp([-0.5 * o.evidence for o in options])
    return [replace(o, share=float(w)) for o, w in zip(options, weights / weights.sum(), strict=True)]


def _instead(best: Scored, other: Scored) -> Atom | None:
    """The only term that a combination has and the best has not, if it stands for several of its joint; else None."""
    new = [a for a in other.fit.terms if a.candidate.key not in keys(best.fit.terms)]
    gone = [a for a in best.fit.terms if a.candidate.key not in keys(other.fit.terms)]
    if len(new) != 1 or len(gone) < 2:
        return None
    joints = {a.candidate.joint_name for a in (*new, *gone)} - {None}
    return new[0] if new[0].candidate.joint_name is None or len(joints) == 1 else None
