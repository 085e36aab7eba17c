"""Motors put back to their given strength where the joint moves alike so.

About a vertical axis, and wherever links weigh little beside the rotor, a motor of half the strength moves half the
rotor against half the friction alike. A search ends at any of them; the given motor is the one to state, or the nearest
to it where the given links are too heavy for it. What the torques say of the joint's other numbers says how they change
with the scale
(:meth:`~torchrl_athletic.diagnosis.standard.Agreement.at_given_scales`).
"""

from __future__ import annotations

from torchrl_athletic.diagnosis.deadline import Deadline
from torchrl_athletic.diagnosis.descent import Linearised, descend, linearise
from torchrl_athletic.diagnosis.fit import Hypothesis
from torchrl_athletic.diagnosis.joint_fit import trusted
from torchrl_athletic.diagnosis.problem import Array, Mask, Problem, weighed, window_cost
from torchrl_athletic.diagnosis.standard import Agreement

ALIKE = 1.01
"""Cost of the windows up to which a motor of another strength moves the joint alike [1]."""
NEARER = 0.5
"""Share of the way to the given strength from which on a motor is put nearer: a scale that windows tell goes less far
[1]."""
HALVINGS = 6
"""Of that way, to find how far a motor may go."""


def with_given_scales(near: Linearised, torques: Agreement, deadline: Deadline) -> Linearised:
    """The solution with the torque scales of the given model, or near to them, where it follows as well so."""
    problem, x, left = near.problem, near.values, near.free.copy()
    if not deadline.allows(2.2 * near.seconds):
        return near
    cost = _cost(problem, x)
    for scale in torques.at_given_scales(x, *problem.hypothesis.bounds):
        if deadline.over:
            break
        y = _toward_given(problem, torques, x, scale, ALIKE * cost)
        if y is not None:
            x, cost, left[scale] = y, min(cost, _cost(problem, y)), False
    if x is near.values:
        return near
    x = descend(weighed(problem, x), x, left, 1, deadline)
    return trusted(linearise(weighed(problem, x), x, near.free))


def _toward_given(problem: Problem, torques: Agreement, x: Array, scale: int, most: float) -> Array | None:
    """Values (P,) with one torque scale as near to the given one as costs no more; None if that is not worth it."""

    def at(way: float) -> Array:
        index, values = torques.at_given_scales(x, *problem.hypothesis.bounds, way)[scale]
        y = x.copy()
        y[index] = values
        return y

    if _cost(problem, given := at(1.0)) <= most:
        return given
    if not _cost(problem, at(NEARER)) <= most:  # nor where it is no number
        return None
    least, beyond = NEARER, 1.0
    for _ in range(HALVINGS):
        way = 0.5 * (least + beyond)
        least, beyond = (way, beyond) if _cost(problem, at(way)) <= most else (least, way)
    return at(least)


def held_back(h: Hypothesis, torques: Agreement, x: Array, gone: Mask) -> Array:
    """Values (P,) with some as the given model has them; what a scale among them scales changes with it."""
    out = x.copy()
    for scale, (index, values) in torques.at_given_scales(x, *h.bounds).items():
        if gone[scale]:
            out[index] = values
    out[gone] = h.nominal[gone]
    return out


def _cost(problem: Problem, x: Array) -> float:
    return float(window_cost(problem, problem.mean_square(x[None])).mean() + problem.charge(x[None])[0])
