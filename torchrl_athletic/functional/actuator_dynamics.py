"""What lies between a command and the torque at the joint: delay, lag, ripple, stops, and laws of friction."""

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


def ripple(position: Tensor, sine: Tensor, cosine: Tensor, wave_number: Tensor) -> Tensor:
    r"""Torque that comes back with every tooth or pole: :math:`A \sin(n q) + B \cos(n q)` [N·m].

    Args:
        position: Of the joint [rad]. Shape (*B, J).
        sine: A [N·m]. Shape (J,).
        cosine: B [N·m]. Shape (J,).
        wave_number: n [1/rad]. Shape (J,).

    Example:
        >>> ripple(torch.tensor([torch.pi / 12]), torch.tensor([0.2]), torch.tensor([0.1]), torch.tensor([6.0]))
        tensor([0.2000])
    """
    phase = wave_number * position
    return sine * torch.sin(phase) + cosine * torch.cos(phase)


def stribeck_relief(velocity: Tensor, excess: Tensor, speed: Tensor) -> Tensor:
    r"""What dry friction of the breakaway level brakes too much when it slides [N·m].

    .. math:: (F_s - F_c)\,(1 - \exp(-(\dot q / v_s)^2))\,\mathrm{sign}(\dot q)

    Args:
        velocity: [rad/s]. Shape (*B, J).
        excess: F_s - F_c [N·m]. Shape (J,).
        speed: v_s [rad/s]. Shape (J,).

    Source:
        Armstrong-Hélouvry et al. 1994, doi:10.1016/0005-1098(94)90209-7, section 2.

    Example:
        >>> stribeck_relief(torch.tensor([-5.0, 0.01, 5.0]), torch.tensor(0.3), torch.tensor(0.1))
        tensor([-0.3000,  0.0030,  0.3000])
    """
    return -excess * torch.expm1(-((velocity / speed) ** 2)) * torch.sign(velocity)


def stop_torque(position: Tensor, place: Tensor, side: Tensor, stiffness: Tensor) -> Tensor:
    r"""Torque of a one-sided spring, :math:`-s\,k \max(s\,(q - p), 0)` [N·m].

    Args:
        position: q [rad]. Shape (*B, J).
        place: Where the stop begins, p [rad]. Shape (J,).
        side: s = 1 if it stops motion towards larger positions, -1 if towards smaller [1]. Shape (J,).
        stiffness: k [N·m/rad]. Shape (J,).

    Example:
        >>> stop_torque(torch.tensor([0.5, 1.5]), torch.tensor(1.0), torch.tensor(1.0), torch.tensor(20.0))
        tensor([ -0., -10.])
    """
    return -side * stiffness * torch.clamp(side * (position - place), min=0)


def wind_up(wound: Tensor, moved: Tensor, width: Tensor) -> Tensor:
    r"""Direction of sliding after a small motion, which turns over within a way (Dahl 1968).

    Exact for motion one way: :math:`z' = s + (z - s)\,\exp(-|\Delta q| / w)` with :math:`s = \mathrm{sign}(\Delta q)`.

    Args:
        wound: z before, -1 to 1 [1]. Shape (*B, J).
        moved: Δq [rad]. Shape (*B, J).
        width: w [rad]. Shape (J,).

    Example:
        >>> wind_up(torch.tensor([-1.0, 0.3]), torch.tensor([0.5, 0.0]), torch.tensor(0.05))
        tensor([0.9999, 0.3000])
    """
    towards = torch.sign(moved)
    return towards + (wound - towards) * torch.exp(-moved.abs() / width)
