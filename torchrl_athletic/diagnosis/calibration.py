"""How probable a statement is: learnt on concealed robots, scored on others (``benchmarks/concealed``)."""

from __future__ import annotations

import json
from collections.abc import Mapping
from dataclasses import asdict, dataclass
from functools import cache
from importlib.resources import files

import numpy as np
from scipy.special import expit, logit

from torchrl_athletic.diagnosis.thresholds import STATEMENT


@dataclass(frozen=True)
class Grounds:
    """What the probability of a finding rests on."""

    share: float
    """Share of the evidence among all effects that could stand in its place, 0..1."""
    left: float
    """Share of its joint's missing torque that stays unexplained, 0..1."""
    excess: float
    """Mean square of what stays there, beyond the noise, in units of the noise."""
    scatter: float
    """Relative spread of its strength between takes (see :func:`~torchrl_athletic.diagnosis.search.scatter`)."""
    open: float
    """Share of the simulation's error energy above the floor that stays, 0..1."""
    energy: float
    """Share of its joint's missing torque that it accounts for, 0..1."""
    terms: int
    """Findings on its joint, itself included: a real robot has some on every joint, a wrong answer many on one. All of
    them for a cause of the whole robot."""
    strain: float
    """Sum of squares of the trims, each in standard deviations of what it may be."""
    sure: float
    """How far its parameters lie from the given model's, in standard deviations."""
    plain: bool = False
    """Whether the recordings show nothing of what sets its law apart from simpler ones."""
    senseless: bool = False
    """Whether its values, together, are none that a robot has."""
    leans: bool = False
    """Whether another finding on its joint is senseless, so that the two may be halves of something else."""
    far: bool = False
    """Whether the simulation with it is still far from the recordings on its joint, so that the law may be another."""
    closes: float = 1.0
    """Share of the simulation's error that it closes, 0..1, alone and with other findings
    (see :func:`~torchrl_athletic.diagnosis.fit.shares_closed`)."""
    refused: bool = False
    """Whether recordings kept aside are followed worse with what was found at its joint than by the given model."""
    overruled: bool = False
    """Whether only the motion asks for it, and what the torques speak for has it not."""
    asked: float = -1.0
    """Share of the simulation's error that comes back without its class at its joint where few effects explain the
    motion, 0..1 (see :mod:`~torchrl_athletic.diagnosis.selection`); below 0 where the motion was not asked."""

    @property
    def most(self) -> float:
        """The probability that it may have at most."""
        most = min(STATEMENT.senseless if self.senseless else self.share, self.closes)
        most = min(most, STATEMENT.likely) if self.overruled else most
        return min(most, STATEMENT.refused) if self.refused else most

    def features(self) -> dict[str, float]:
        """Numbers of order one, in which the log odds are linear."""
        share = float(np.clip(self.share, 1e-3, 1 - 1e-3))
        return {
            "share": float(np.log(share / (1 - share))) / 3,
            "left": float(np.log10(self.left + 1e-4)) + 2,
            "excess": float(np.log10(self.excess + 0.1)),
            "scatter": float(np.log10(self.scatter + 0.01)) + 1,
            "open": float(np.log10(self.open + 1e-4)) + 2,
            "energy": float(np.log10(self.energy + 1e-3)),
            "terms": float(np.log2(self.terms)),
            "strain": float(np.log10(self.strain + 1.0)),
            "sure": float(np.log10(np.clip(self.sure, 0.1, 100.0))) - 1,
            "plain": float(self.plain),
            "leans": float(self.leans),
            "far": float(self.far),
            "rivals": float(self.share < STATEMENT.refutes),
        }

    def to_json(self) -> dict[str, float]:
        """As plain numbers."""
        return asdict(self)


@cache
def learnt(part: str) -> Mapping[str, float]:
    """What is in force: ``"weights"`` of the features, of the ``"effects"``, or how an ``"interval"`` is widened."""
    content = json.loads(files(__package__).joinpath("calibration.json").read_text(encoding="utf-8"))
    return {name: float(value) for name, value in content.get(part, {}).items()}


def probability(grounds: Grounds, effect: str = "") -> float:
    """That a finding with these grounds is true: a logistic regression's answer.

    It is at most what :attr:`Grounds.most` allows: no name is more probable than its share of the evidence, nor than
    the share that it closes of the simulation's error.

    Args:
        grounds: Of the finding.
        effect: Its name: some stand in for other physics more often than others.

    Example:
        >>> clear = Grounds(share=0.99, left=0, excess=0, scatter=0.01, open=0, energy=1, terms=1, strain=1, sure=30)
        >>> vague = Grounds(share=0.6, left=0.4, excess=9, scatter=0.3, open=0.5, energy=0.5, terms=3, strain=9, sure=1)
        >>> probability(clear) > 0.8 > probability(vague)
        True
    """
    weights = learnt("weights")
    odds = weights["intercept"] + sum(weights.get(name, 0.0) * x for name, x in grounds.features().items())
    odds += learnt("effects").get(effect, 0.0)
    return float(min(1.0 / (1.0 + np.exp(-np.clip(odds, -20, 20))), grounds.most))


def class_probability(
    law: float, alike: float, closed: float, closes: float | None, weights: Mapping[str, float] | None = None
) -> float:
    """That physics of a finding's class is missing at its joint, whatever the law: learnt on real benches.

    What the motion asks for is of the right class more often than what the torques alone ask for, whatever its law. The
    probability is no larger than the share of the error that all findings close, nor than the share that this one
    closes, since what stays may be of another class; and no smaller than the law's.

    Args:
        law: Probability of the finding.
        alike: The same with its rivals of the same class and joint.
        closed: Share of the simulation's error energy above the floor that the correction closes, 0..1.
        closes: Share of the error that the finding closes, 0..1 (see :attr:`Grounds.closes`); None where the
            simulation was not asked, which speaks neither for it nor against it.
        weights: Level, and slopes in the log odds of ``alike`` and of ``closes``; None takes those in force.

    Example:
        >>> class_probability(law=0.05, alike=0.05, closed=1.0, closes=0.95) > 0.5
        True
        >>> class_probability(law=0.05, alike=0.05, closed=1.0, closes=0.5) < 0.5
        True
        >>> class_probability(law=0.2, alike=0.9, closed=0.3, closes=1.0)
        0.3
    """
    weights = weights or learnt("class")
    odds = weights["level"] + weights["alike"] * logit(np.clip(alike, 1e-3, 1 - 1e-3))
    if closes is not None:  # all that is followed has 1: no more than the most that was often seen
        odds += weights["closes"] * logit(np.clip(closes, 0.1, 0.9))
    return float(max(law, min(expit(odds), closed, 1.0 if closes is None else closes)))


def rival_probability(likely: float, own: float, share: float) -> float:
    """That another effect is true in a finding's place.

    It has its share of what the finding has or leaves, and no more than the finding, which all the evidence put before
    it: where the simulation decided against the torques, what the finding lacks is nobody's.

    Args:
        likely: Probability of the finding.
        own: The finding's share of the evidence among all that could stand there.
        share: The other effect's.

    Example:
        >>> round(rival_probability(likely=0.6, own=0.75, share=0.25), 3)
        0.2
        >>> rival_probability(likely=0.01, own=0.01, share=0.99)
        0.01
    """
    per_share = min(likely / max(own, 1e-9), (1.0 - likely) / max(1.0 - own, 1e-9))
    return min(share * per_share, likely)


def widened(value: float, low: float, high: float) -> tuple[float, float]:
    """A 95 % interval that holds as often as it says; the bootstrap knows nothing of laws simpler than nature's.

    Args:
        value: Estimate.
        low: Lower end of the bootstrap's interval.
        high: Upper end.

    Returns:
        Lower and upper end, wider by what was learnt on concealed robots.
    """
    by = learnt("interval")
    least = by["relative"] * abs(value)
    below, above = (float(np.hypot(by["widen"] * max(gap, 0.0), least)) for gap in (value - low, high - value))
    return value - below, value + above
