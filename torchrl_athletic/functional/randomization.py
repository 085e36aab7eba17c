"""From even random numbers to what differs between simulated robots."""

from __future__ import annotations

import math

import torch
from torch import Tensor


def in_range(unit: Tensor, low: Tensor | float, high: Tensor | float) -> Tensor:
    """Stretch [-1, 1] to [low, high].

    Example:
        >>> in_range(torch.tensor([-1.0, 0.0, 1.0]), 0.5, 1.5).tolist()
        [0.5, 1.0, 1.5]
    """
    return low + (high - low) * (0.5 + 0.5 * unit)


def restitution(damping: Tensor) -> Tensor:
    r"""Share of its speed that a body keeps when it bounces off a spring and damper that do not hold it back.

    .. math:: e = \exp\left(-\frac{\zeta}{\sqrt{1 - \zeta^2}}\,
        \mathrm{atan2}\left(2\zeta\sqrt{1 - \zeta^2},\, 2\zeta^2 - 1\right)\right)

    and the like with hyperbolic functions above ζ = 1, where it is exp(-2).

    Args:
        damping: Damping ratio ζ > 0, but for 1 itself [1].

    Source:
        Schwager, Pöschel 2007, Coefficient of restitution and linear-dashpot model revisited, equation 21,
        https://arxiv.org/abs/0709.4405.

    Example:
        >>> restitution(torch.tensor([0.001, 0.999, 1.001])).round(decimals=2)
        tensor([1.0000, 0.1400, 0.1400])
    """
    root = torch.sqrt((1 - damping.square()).abs())
    below = torch.atan2(2 * damping * root, 2 * damping.square() - 1)
    above = torch.log((damping + root) / (damping - root).clamp(min=1e-12))
    return torch.exp(-damping / root * torch.where(damping < 1, below, above))


def restitution_damping(value: Tensor) -> Tensor:
    """Damping ratio that makes a body bounce with this restitution: the inverse of :func:`restitution`.

    Args:
        value: e [1]. Below 0.05 it counts as 0.05, since more damping than that asks for a shorter time step.

    Returns:
        ζ, at most 2 [1].

    Example:
        >>> restitution_damping(torch.tensor([0.0, 0.5])).round(decimals=2)
        tensor([2.0000, 0.2600])
    """
    damping = torch.linspace(0.003, 2.0, 400, dtype=value.dtype, device=value.device)  # 1 is not among them
    found = restitution(damping)  # falls with the damping
    above = torch.searchsorted(-found, -value.contiguous()).clamp(1, len(found) - 1)
    left, right = found[above - 1], found[above]
    share = ((left - value) / (left - right)).clamp(0, 1)
    return damping[above - 1] + share * (damping[above] - damping[above - 1])


def restitution_solref(solref: Tensor, value: Tensor) -> Tensor:
    """MuJoCo's contact parameters for a restitution, on ground as stiff as before.

    MuJoCo's stiffness goes with 1 / (time constant x damping ratio)², so the time constant grows as the ratio falls.

    Args:
        solref: Time constant [s] and damping ratio [1] of the model. Shape (..., 2).
        value: Restitution [1]. Shape (...).

    Returns:
        Shape (..., 2).

    Source:
        MuJoCo documentation, Solver parameters.

    Example:
        >>> restitution_solref(torch.tensor([0.02, 1.0]), torch.tensor(0.5)).round(decimals=2)
        tensor([0.0800, 0.2600])
    """
    damping = restitution_damping(value)
    return torch.stack((solref[..., 0] * solref[..., 1] / damping, damping), -1)


def direction(unit: Tensor) -> Tensor:
    """A direction, all being equally likely, of two numbers that are even in [-1, 1]. Shape (*B, 2) to (*B, 3).

    Source:
        Archimedes: the height of a point on a sphere is even.

    Example:
        >>> float(direction(torch.tensor([0.3, -0.8])).norm().round(decimals=4))
        1.0
    """
    height, angle = unit[..., 0], math.pi * unit[..., 1]
    radius = torch.sqrt((1 - height.square()).clamp(min=0))
    return torch.stack((radius * angle.cos(), radius * angle.sin(), height), -1)


def turn(vector: Tensor) -> Tensor:
    """Quaternion (wxyz) of a turn about an axis by its length [rad]. Shape (*B, 3) to (*B, 4).

    Example:
        >>> turn(torch.tensor([0.0, 0.0, math.pi])).abs().round(decimals=4).tolist()
        [0.0, 0.0, 0.0, 1.0]
    """
    half = torch.linalg.vector_norm(vector, dim=-1, keepdim=True) / 2
    return torch.cat((half.cos(), 0.5 * vector * torch.sinc(half / math.pi)), -1)
