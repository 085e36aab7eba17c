"""Links whose mass, centre and inertia are far from the model's: all searched at once, where several are asked for.

One number of one link at a time leads nowhere there: each makes up for the others, until no slope is left.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from torchrl_athletic.diagnosis.deadline import Deadline
from torchrl_athletic.diagnosis.descent import Linearised, descend, linearise
from torchrl_athletic.diagnosis.fit import Hypothesis
from torchrl_athletic.diagnosis.joint_fit import GAIN, SLOPES, follows_better, search, trusted
from torchrl_athletic.diagnosis.prepare import Prepared
from torchrl_athletic.diagnosis.problem import weighed
from torchrl_athletic.diagnosis.screen import Candidate
from torchrl_athletic.diagnosis.standard import agreement
from torchrl_athletic.effects import LinkComShift, LinkInertia, LinkMass, Parameter

Array = NDArray[np.float64]

LINK = (LinkMass(), LinkComShift(), LinkInertia())
INERTIA = (0.05, 20.0)
"""Bounds of a link's inertia, per the given one: a mass that lies elsewhere may leave next to none [1]."""
DRAWS = 24
"""Starts by chance, half of them with all else as the fit has it."""
FACTOR = 0.7
"""Standard deviation of the logarithm of a mass and of an inertia, per the given one, in these starts [1]."""
SHIFT = 4.0
"""That of a centre of mass, in changes worth mentioning [1]."""


def asks_for_links(near: Linearised) -> bool:
    """Whether folds asked for numbers of two links or more, one at a time."""
    names = {effect.name for effect in LINK}
    return len({c.joint for c in near.problem.hypothesis.terms if c.effect.name in names}) > 1


def with_links(near: Linearised, prepared: Prepared, rng: np.random.Generator, deadline: Deadline) -> Linearised:
    """The fit, or one with all numbers of all links if it follows folds of the fit's windows clearly better.

    Args:
        near: Fit with laws, some of them of links.
        prepared: Recordings.
        rng: Draws starts and windows.
        deadline: When to come to an end.
    """
    h, take = near.problem.hypothesis, prepared.takes[0]
    names = {effect.name for effect in LINK}
    links = [
        Candidate(effect, j, name, tuple(_bounded(effect.name, p) for p in own))
        for j, name in enumerate(take.recording.joint_names)
        for effect in LINK
        if (own := effect.parameters(take.model, take.address, j))
    ]
    if not links or not deadline.allows(30 * near.seconds):
        return near
    kept = [c for c in h.terms if c.effect.name not in names]
    wider, first = Hypothesis((*kept, *links)), sum(len(c.parameters) for c in kept)
    found = np.concatenate([*(h.values_of(c, near.values) for c in kept), Hypothesis(tuple(links)).nominal])
    begin = [wider.nominal, found]
    begin += [_drawn(wider, first, (wider.nominal, found)[k % 2], rng) for k in range(DRAWS)]
    takes, torques = tuple(dict.fromkeys(w.take for w in near.problem.windows)), agreement(wider, prepared)
    linked = search(wider, takes, np.stack(begin), rng, Deadline(deadline.left), torques)
    same = replace(near.problem, hypothesis=wider, torques=near.problem.torques and torques)
    free = wider.bounds[1] > wider.bounds[0]
    x = descend(weighed(same, linked.values), linked.values, free, SLOPES[1], deadline)
    judged = trusted(linearise(weighed(same, x), x, free))  # a search has windows of its own, and errors of those
    return linked if follows_better(near, judged, 2 * GAIN) else near


def _drawn(h: Hypothesis, first: int, x: Array, rng: np.random.Generator) -> Array:
    """Values (P,) with those from the ``first`` on drawn about the given ones."""
    factor = h.nominal * np.exp(FACTOR * rng.standard_normal(len(x)))
    shift = SHIFT * h.scale * rng.standard_normal(len(x))
    drawn = np.clip(np.where(h.nominal != 0.0, factor, shift), *h.bounds)
    return np.where(np.arange(len(x)) < first, x, drawn)


def _bounded(effect: str, p: Parameter) -> Parameter:
    low, high = INERTIA
    return replace(p, lower=low, upper=high) if effect == "link_inertia" else p
