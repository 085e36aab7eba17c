r"""A sled on a rope: how hard the rope pulls, and how the sled slides over level ground.

The paper's virtual mass, spring and damper, as functions: the rope goes from a grip, which is the robot's, to a hook on
the sled, and weighs nothing. One step of a simulation is :func:`slide` with the pull of the step before, then
:func:`span` and :func:`tension` at what has been reached. Left out: that a rope which rises to the grip lifts the sled
a little off its runners, and that a sled turns.
"""

from __future__ import annotations

import torch
from torch import Tensor

GRAVITY = 9.81
"""[m/s²]."""
STIFFNESS, DAMPING = 1000.0, 1.0
"""The paper's rope [N/m²] and [N·s²/m²]."""


def span(grip: Tensor, grip_velocity: Tensor, hook: Tensor, hook_velocity: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """How far the hook is from the grip, how fast that grows, and where it is.

    Args:
        grip: Position [m]. Shape (*B, 3).
        grip_velocity: [m/s]. Shape (*B, 3).
        hook: Position [m]. Shape (*B, 3).
        hook_velocity: [m/s]. Shape (*B, 3).

    Returns:
        Distance d [m] and its rate [m/s], shape (*B, 1) each, and the direction from the grip to the hook, of unit
        length [1], shape (*B, 3); 0 where they are in one place.

    Example:
        >>> grip, hook, still = torch.tensor([0.0, 0.0, 4.0]), torch.tensor([3.0, 0.0, 0.0]), torch.zeros(3)
        >>> [[round(float(x), 3) for x in part] for part in span(grip, torch.tensor([-1.0, 0.0, 0.0]), hook, still)]
        [[5.0], [0.6], [0.6, 0.0, -0.8]]
    """
    way = hook - grip
    distance = torch.linalg.vector_norm(way, dim=-1, keepdim=True)
    direction = way / distance.clamp(min=1e-9)
    rate = ((hook_velocity - grip_velocity) * direction).sum(-1, keepdim=True)
    return distance, rate, direction


def tension(
    distance: Tensor, rate: Tensor, length: Tensor, stiffness: float = STIFFNESS, damping: float = DAMPING
) -> Tensor:
    r"""How hard the rope pulls its ends together.

    .. math:: F = \max\!\left(k \max(d - l, 0)^2 - c\,\dot d^2,\; 0\right)

    The paper prints :math:`1000\,|d - l|^2`, by which a slack rope would pull as hard as a stretched one. This rope is
    slack at d < l.

    **The damping damps nothing that comes back.** As printed it has no sign: the square lessens the tension while the
    rope lengthens just as while it shortens, where a damper would raise it in the first case. With the energy
    :math:`\frac{k}{3} \max(d - l, 0)^3` in the rope, that of rope and masses together changes by

    .. math:: \dot E = \dot d \, \min\!\left(c\,\dot d^2,\; k \max(d - l, 0)^2\right),

    so it **grows** while the rope lengthens and falls while it shortens. The law looks the same backwards in time: a
    sled that runs away from a fixed grip comes back as fast as it went, and only friction takes energy away. Friction
    is the same at each speed, so a sled that a hand pulls evenly surges and stalls around :math:`F = \mu m g` without
    end, unless the hand gives way. A hand that pulls fast and yields slowly gains energy. It is little: at 1 m/s the
    term is 1 N.

    Args:
        distance: d between the ends [m]. Shape (*B, 1).
        rate: Of d [m/s]. Shape (*B, 1).
        length: l, the greatest distance at which it does not pull [m]. Shape (*B, 1).
        stiffness: k [N/m²].
        damping: c [N·s²/m²].

    Returns:
        F [N]. Shape (*B, 1).

    Source:
        Fey et al. 2025, appendix B-C.

    Example:
        >>> distance, rate = torch.tensor([[1.5], [2.5], [2.5]]), torch.tensor([[0.0], [0.0], [-5.0]])
        >>> tension(distance, rate, length=torch.tensor([[2.0]])).flatten()
        tensor([  0., 250., 225.])
    """
    stretch = (distance - length).clamp(min=0)
    return (stiffness * stretch.square() - damping * rate.square()).clamp(min=0)


def slide(
    position: Tensor, velocity: Tensor, pull: Tensor, mass: Tensor, friction: Tensor, dt: float
) -> tuple[Tensor, Tensor]:
    r"""A sled on level ground, one step later.

    .. math::
        v^* &= v + \frac{F}{m}\,dt \\
        v' &= v^* \max\!\left(1 - \frac{\mu g\,dt}{|v^*|},\; 0\right), \qquad x' = x + v'\,dt

    Dry friction takes at most :math:`\mu g\,dt` from the speed and turns nothing round, so a sled that a pull of less
    than :math:`\mu m g` finds at rest stays there exactly. The paper prints
    :math:`F^\mathrm{sled} = F^\mathrm{pull}_x + \mu m g`, though friction opposes the motion: so it does here, in both
    directions of the plane.

    Args:
        position: x and y [m]. Shape (*B, 2).
        velocity: [m/s]. Shape (*B, 2).
        pull: F, horizontal part of what pulls [N]. Shape (*B, 2).
        mass: m [kg]. Shape (*B, 1).
        friction: Coefficient μ [1]. Shape (*B, 1).
        dt: [s].

    Returns:
        Position [m] and velocity [m/s]. Shape (*B, 2) each.

    Source:
        Fey et al. 2025, appendix B-C.

    Example:
        >>> mass, friction, rest = torch.tensor([100.0]), torch.tensor([0.1]), torch.zeros(2)
        >>> [slide(rest, rest, torch.tensor([pull, 0.0]), mass, friction, dt=0.01)[1] for pull in (98.0, 198.1)]
        [tensor([0., 0.]), tensor([0.0100, 0.0000])]
    """
    velocity = velocity + pull / mass * dt
    speed = torch.linalg.vector_norm(velocity, dim=-1, keepdim=True)
    velocity = velocity * (1 - friction * (GRAVITY * dt) / speed.clamp(min=1e-9)).clamp(min=0)
    return position + velocity * dt, velocity
