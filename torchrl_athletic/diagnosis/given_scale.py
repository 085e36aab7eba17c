"""Motors put back to their given strength where the joint moves alike so.

About a vertical axis, and wherever links weigh little beside the rotor, a motor of half the strength moves half the
rotor against half the friction alike. A search ends at any of them; the given motor is the one to state. What the
torques say of the joint's other numbers says how they change with the scale
(:meth:`~torchrl_athletic.diagnosis.standard.Agreement.at_given_scales`).
"""

from __future__ import annotations

from torchrl_athletic.diagnosis.deadline import Deadline
from torchrl_athletic.diagnosis.fit import Hypothesis
from torchrl_athletic.diagnosis.joint_fit import (
    Array,
    Linearised,
    Mask,
    Problem,
    descend,
    linearise,
    trusted,
    weighed,
    window_cost,
)
from torchrl_athletic.diagnosis.standard import Agreement

ALIKE = 1.01
"""Cost of the windows up to which a motor of the given strength moves the joint alike [1]."""


def with_given_scales(near: Linearised, torques: Agreement, deadline: Deadline) -> Linearised:
    """The solution with the torque scales of the given model, joint by joint, where it follows as well so."""
    problem, x, left = near.problem, near.values, near.free.copy()
    if not deadline.allows(2.2 * near.seconds):
        return near
    cost = _cost(problem, x)
    for index, values in torques.at_given_scales(x, *problem.hypothesis.bounds):
        y = x.copy()
        y[index] = values
        if (other := _cost(problem, y)) <= ALIKE * cost:
            x, cost, left[index[0]] = y, min(cost, other), False
    if x is near.values:
        return near
    x = descend(weighed(problem, x), x, left, 1, deadline)
    return trusted(linearise(weighed(problem, x), x, near.free))


def held_back(h: Hypothesis, torques: Agreement, x: Array, gone: Mask) -> Array:
    """Values (P,) with some as the given model has them; what a scale among them scales changes with it."""
    out = x.copy()
    for index, values in torques.at_given_scales(x, *h.bounds):
        if gone[index[0]]:
            out[index] = values
    out[gone] = h.nominal[gone]
    return out


def _cost(problem: Problem, x: Array) -> float:
    return float(window_cost(problem, problem.mean_square(x[None])).mean() + problem.charge(x[None])[0])
