"""What lies between a command and the torque at the joint: delay, lag, and friction that knows a direction."""

from __future__ import annotations

import math
from collections.abc import Sequence

import torch
from torch import Tensor


def delay_weights(delays: Sequence[float], step: float) -> Tensor:
    """How much each of the last commands contributes to a late one, which need not be late by whole steps.

    A command holds for a step, so one that is late by n + f steps is, in the mean over a step, 1 - f of the command of
    n steps ago and f of the one before it.

    Args:
        delays: Of each joint [s]. Length J.
        step: From one command to the next [s].

    Returns:
        Oldest first; the last row belongs to the command of now. Shape (L, J).

    Raises:
        ValueError: If a delay is negative, since the command to come is not known.

    Example:
        >>> delay_weights([0.0, 0.005], step=0.002)[:, 1]
        tensor([0.5000, 0.5000, 0.0000, 0.0000], dtype=torch.float64)
    """
    if min(delays) < 0:
        raise ValueError(f"delays {list(delays)} s: a command cannot act before it was given. Give 0 or more.")
    steps = [delay / step for delay in delays]
    whole = [math.floor(n + 1e-9) for n in steps]
    length = max(math.ceil(n - 1e-9) for n in steps) + 1
    weights = torch.zeros(length, len(delays), dtype=torch.float64)
    for joint, (n, late) in enumerate(zip(steps, whole, strict=True)):
        part = max(n - late, 0.0) if n - late > 1e-9 else 0.0
        weights[length - 1 - late, joint] = 1 - part
        if part:
            weights[length - 2 - late, joint] = part
    return weights


def delayed(queue: Tensor, weights: Tensor) -> Tensor:
    """The command that arrives now. Shapes (*B, L, J) and (L, J) to (*B, J); see :func:`delay_weights`."""
    return (queue * weights).sum(-2)


def lag_factors(time_constants: Sequence[float], step: float) -> tuple[Tensor, Tensor]:
    """What a first-order low-pass keeps of its distance to a constant input over a step: at its end, and in the mean.

    Args:
        time_constants: Of each joint, 0 for none [s]. Length J.
        step: [s].

    Returns:
        Both in [0, 1). Shape (J,) each.

    Example:
        >>> end, mean = lag_factors([0.0, 0.01], step=0.01)
        >>> [round(float(x), 4) for x in (*end, *mean)]
        [0.0, 0.3679, 0.0, 0.6321]
    """
    end = [math.exp(-step / t) if t > 1e-6 else 0.0 for t in time_constants]
    mean = [(1 - keep) * t / step if t > 1e-6 else 0.0 for keep, t in zip(end, time_constants, strict=True)]
    return torch.tensor(end, dtype=torch.float64), torch.tensor(mean, dtype=torch.float64)


def low_pass(value: Tensor, state: Tensor, kept: Tensor) -> Tensor:
    """Relax towards ``value``, of which ``kept`` of the distance remains. Shapes (*B, J), (*B, J), (J,) to (*B, J).

    Example:
        >>> low_pass(torch.tensor([1.0]), torch.tensor([0.0]), torch.tensor([0.25]))
        tensor([0.7500])
    """
    return value + (state - value) * kept


def even_friction(velocity: Tensor, constant: Tensor, slope: Tensor) -> Tensor:
    r"""What friction that differs by direction does alike in both: :math:`-c - s\,|\dot q|` [N·m].

    Args:
        velocity: [rad/s]. Shape (*B, J).
        constant: Half of what Coulomb friction is higher forwards than backwards [N·m]. Shape (J,).
        slope: The same of viscous friction [N·m·s/rad]. Shape (J,).

    Example:
        >>> even_friction(torch.tensor([-2.0]), torch.tensor([0.1]), torch.tensor([0.05]))
        tensor([-0.2000])
    """
    return -constant - slope * velocity.abs()
