"""Links whose mass, centre and inertia are far from the model's: all searched at once, where several are asked for.

One number of one link at a time leads nowhere there: each makes up for the others, until no slope is left.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from torchrl_athletic.diagnosis.deadline import Deadline
from torchrl_athletic.diagnosis.descent import Linearised
from torchrl_athletic.diagnosis.fit import Hypothesis
from torchrl_athletic.diagnosis.joint_fit import GAIN, search, stated
from torchrl_athletic.diagnosis.prepare import Prepared
from torchrl_athletic.diagnosis.screen import Candidate
from torchrl_athletic.diagnosis.standard import agreement
from torchrl_athletic.effects import LinkComShift, LinkInertia, LinkMass, Parameter

Array = NDArray[np.float64]

LINK = (LinkMass(), LinkComShift(), LinkInertia())
INERTIA = (0.05, 20.0)
"""Bounds of a link's inertia, per the given one: a mass that lies elsewhere may leave next to none [1]."""
DRAWS = 24
"""Starts by chance, half of them from the joints' own solution."""
FACTOR = 0.7
"""Standard deviation of the logarithm of a mass and of an inertia, per the given one, in these starts [1]."""
SHIFT = 4.0
"""That of a centre of mass, in changes worth mentioning [1]."""


def asks_for_links(near: Linearised) -> bool:
    """Whether folds asked for numbers of two links or more, one at a time."""
    names = {effect.name for effect in LINK}
    return len({c.joint for c in near.problem.hypothesis.terms if c.effect.name in names}) > 1


def with_links(
    near: Linearised, joints: Linearised, prepared: Prepared, rng: np.random.Generator, deadline: Deadline
) -> Linearised:
    """The fit, or one of the standard joints and all links if it follows folds clearly better.

    Args:
        near: Fit with laws, which is kept if it is no worse.
        joints: Fit of the standard joints, from whose solution half of the starts come.
        prepared: Recordings.
        rng: Draws starts and windows.
        deadline: When to come to an end.
    """
    h, take = joints.problem.hypothesis, prepared.takes[0]
    links = [
        Candidate(effect, j, name, tuple(_bounded(effect.name, p) for p in own))
        for j, name in enumerate(take.recording.joint_names)
        for effect in LINK
        if (own := effect.parameters(take.model, take.address, j))
    ]
    if not links or not deadline.allows(30 * near.seconds):
        return near
    wider = Hypothesis((*h.terms, *links))
    from_joints = np.append(joints.values, Hypothesis(tuple(links)).nominal)
    begin = [wider.nominal, from_joints]
    begin += [_drawn(wider, len(h.parameters), (wider.nominal, from_joints)[k % 2], rng) for k in range(DRAWS)]
    takes = tuple(dict.fromkeys(w.take for w in near.problem.windows))  # both are compared in the same steps
    found = search(wider, takes, np.stack(begin), rng, deadline, agreement(wider, prepared))
    return found if stated(found) < (1 - 2 * GAIN) * stated(near) else near


def _drawn(h: Hypothesis, first: int, x: Array, rng: np.random.Generator) -> Array:
    """Values (P,) with those from the ``first`` on drawn about the given ones."""
    factor = h.nominal * np.exp(FACTOR * rng.standard_normal(len(x)))
    shift = SHIFT * h.scale * rng.standard_normal(len(x))
    drawn = np.clip(np.where(h.nominal != 0.0, factor, shift), *h.bounds)
    return np.where(np.arange(len(x)) < first, x, drawn)


def _bounded(effect: str, p: Parameter) -> Parameter:
    low, high = INERTIA
    return replace(p, lower=low, upper=high) if effect == "link_inertia" else p
