"""When a foot steps: the clock of a gait, and how high a foot should be at its tick."""

from __future__ import annotations

import math

import torch
from torch import Tensor

TROT = (0.0, 0.5, 0.5, 0.0)
"""How far ahead of the clock each foot is [cycles]: the diagonals step in turn. Front, then rear, as left, right."""


def advance_cycle(cycle: Tensor, frequency: float, dt: float) -> Tensor:
    """The clock one step later.

    Args:
        cycle: Share of the cycle that has passed [1], from 0 to below 1. Any shape.
        frequency: Of the gait [Hz].
        dt: Of the step [s].

    Example:
        >>> advance_cycle(torch.tensor([0.0, 0.75]), frequency=2.0, dt=0.25).tolist()
        [0.5, 0.25]
    """
    return torch.remainder(cycle + frequency * dt, 1.0)


def gait_phase(cycle: Tensor, cosine: bool = False) -> Tensor:
    r"""What a policy sees of the clock: :math:`\sin 2 \pi f t`, and the cosine beside it if asked for.

    The sine alone cannot tell the rise before its top from the fall behind it; a policy with a history can.

    Args:
        cycle: Share of the cycle that has passed [1]. Shape (*B, 1).
        cosine: Whether to add it.

    Returns:
        Shape (*B, 1), or (*B, 2) with the cosine.

    Source:
        Fey et al. 2025, section II-B, observation space.

    Example:
        >>> gait_phase(torch.tensor([0.25]), cosine=True).abs().round(decimals=3).tolist()
        [1.0, 0.0]
    """
    angle = 2 * math.pi * cycle
    return torch.cat((angle.sin(), angle.cos()), -1) if cosine else angle.sin()


def in_swing(cycle: Tensor, offset: Tensor, duty: float = 0.5) -> Tensor:
    """Whether each foot should be in the air, as :func:`foot_height` has it.

    Args:
        cycle: Share of the clock's cycle [1]. Shape (*B, 1).
        offset: How far ahead of the clock each foot is [cycles]. Shape (F,).
        duty: Share of the cycle for which a foot stands.

    Returns:
        Bool, shape (*B, F).

    Example:
        >>> in_swing(torch.tensor([0.25]), torch.tensor(TROT)).tolist()
        [False, True, True, False]
    """
    return torch.remainder(cycle + offset, 1.0) >= duty


def foot_height(cycle: Tensor, offset: Tensor, apex: Tensor | float = 0.1, duty: float = 0.5) -> Tensor:
    r"""Height above the ground that each foot should have: none in stance, one smooth arc in swing.

    .. math:: h = \tfrac{1}{2} h_{apex}\,(1 - \cos 2 \pi s)

    with s, the share of the swing, from 0 where the foot lifts off to 1 where it lands. At both ends the foot is at
    rest in the vertical.

    Args:
        cycle: Share of the clock's cycle [1]. Shape (*B, 1).
        offset: How far ahead of the clock each foot is [cycles], such as :data:`TROT`. Shape (F,).
        apex: Greatest height [m].
        duty: Share of the cycle for which a foot stands, below 1. It stands first, then swings.

    Returns:
        [m]. Shape (*B, F).

    Source:
        The target of the foot clearance term of Fey et al. 2025, table III. The paper does not give its shape: this
        one, the apex and the duty factor of a trot are chosen here.

    Example:
        >>> foot_height(torch.tensor([0.25]), torch.tensor(TROT)).tolist()  # the right front swings, at its apex
        [0.0, 0.10000000149011612, 0.10000000149011612, 0.0]
    """
    own = torch.remainder(cycle + offset, 1.0)
    swing = ((own - duty) / (1 - duty)).clamp(min=0.0)
    return apex * 0.5 * (1 - torch.cos(2 * math.pi * swing))
