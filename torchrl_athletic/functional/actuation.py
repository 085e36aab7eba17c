"""From a position target to the torque that a motor can deliver."""

from __future__ import annotations

import torch
from torch import Tensor


def pd_torque(target: Tensor, position: Tensor, velocity: Tensor, kp: Tensor | float, kd: Tensor | float) -> Tensor:
    r"""Torque of a proportional-derivative law that holds a position target at rest.

    .. math:: \tau = k_p\,(q^* - q) - k_d\,\dot q

    Args:
        target: q* [rad]. Shape (*B, J).
        position: q [rad]. Shape (*B, J).
        velocity: Of the joint [rad/s]. Shape (*B, J).
        kp: Stiffness [N·m/rad]. Shape (J,), (*B, J) or ().
        kd: Damping [N·m·s/rad]. As ``kp``.

    Returns:
        [N·m]. Shape (*B, J).

    Example:
        >>> pd_torque(torch.tensor([0.1]), torch.tensor([0.0]), torch.tensor([1.0]), kp=20.0, kd=0.5)
        tensor([1.5000])
    """
    return kp * (target - position) - kd * velocity


def torque_speed_limits(velocity: Tensor, torque_limit: Tensor, velocity_limit: Tensor) -> tuple[Tensor, Tensor]:
    r"""Least and greatest torque of a motor at its speed.

    .. math::
        -\tau_{max}\,(1 + \mathrm{clip}(\dot q / \dot q_{max}, -1, 0)) \le \tau \le
        \tau_{max}\,(1 - \mathrm{clip}(\dot q / \dot q_{max}, 0, 1))

    A motor that already turns at its greatest speed cannot push further, and brakes with all it has.

    Args:
        velocity: Of the joint [rad/s]. Shape (*B, J).
        torque_limit: At standstill [N·m]. Shape (J,) or (*B, J).
        velocity_limit: Without load [rad/s]. Shape (J,) or (*B, J).

    Returns:
        The two limits [N·m]. Shape (*B, J) each.

    Source:
        Fey et al. 2025, section II-B, after Shin et al. 2023.

    Example:
        >>> speed = torch.tensor([-12.0, -5.0, 0.0, 5.0, 12.0])
        >>> low, high = torque_speed_limits(speed, torch.tensor(30.0), torch.tensor(10.0))
        >>> low.tolist(), high.tolist()
        ([-0.0, -15.0, -30.0, -30.0, -30.0], [30.0, 30.0, 30.0, 15.0, 0.0])
    """
    used = velocity / velocity_limit
    return -torque_limit * (1 + used.clamp(-1, 0)), torque_limit * (1 - used.clamp(0, 1))


def clip_torque_speed(torque: Tensor, velocity: Tensor, torque_limit: Tensor, velocity_limit: Tensor) -> Tensor:
    """Torque within :func:`torque_speed_limits` [N·m]. Shape (*B, J).

    Args:
        torque: Asked for [N·m]. Shape (*B, J).
        velocity: Of the joint [rad/s]. Shape (*B, J).
        torque_limit: At standstill [N·m]. Shape (J,) or (*B, J).
        velocity_limit: Without load [rad/s]. Shape (J,) or (*B, J).
    """
    low, high = torque_speed_limits(velocity, torque_limit, velocity_limit)
    return torch.clamp(torque, low, high)


def brake_overspeed(torque: Tensor, velocity: Tensor, torque_limit: Tensor, velocity_limit: Tensor) -> Tensor:
    r"""Torque of a motor that something else turns faster than it can turn without load.

    .. math:: \mathrm{sign}(\dot q)\,\tau \le \tau_{max}\,(1 - \min(|\dot q| / \dot q_{max}, 2))
        \quad\text{where } |\dot q| > \dot q_{max}

    The line of torque over speed goes on below zero: the motor's own voltage is then above that of its supply and
    drives a current back into it. :func:`torque_speed_limits` ends at zero, as printed in the paper. At twice the speed
    the motor brakes with the torque that it has at standstill, and with no more beyond.

    Args:
        torque: Asked for [N·m]. Shape (*B, J).
        velocity: Of the joint [rad/s]. Shape (*B, J).
        torque_limit: At standstill [N·m]. Shape (J,) or (*B, J).
        velocity_limit: Without load [rad/s]. Shape (J,) or (*B, J).

    Returns:
        [N·m]. Shape (*B, J).

    Source:
        Hughes and Drury 2019, Electric Motors and Drives, chapter 3: above its no-load speed a motor generates.

    Example:
        >>> speed = torch.tensor([-15.0, 5.0, 10.0, 15.0, 30.0])
        >>> brake_overspeed(torch.zeros(5), speed, torch.tensor(30.0), torch.tensor(10.0)).tolist()
        [15.0, 0.0, 0.0, -15.0, -30.0]
    """
    beyond = (velocity.abs() / velocity_limit - 1).clamp(0, 1)
    way = velocity.sign()
    return torch.where(beyond > 0, way * torch.minimum(way * torque, -torque_limit * beyond), torque)


def power_scale(torque: Tensor, velocity: Tensor, max_power: Tensor | float) -> Tensor:
    r"""Factor that keeps the power of a group of joints within what its supply gives.

    .. math:: s = \min(1,\; P_{max} \,/\, |\tau|^\top |\dot q|)

    Args:
        torque: Of the joints of the group [N·m]. Shape (*B, J).
        velocity: [rad/s]. Shape (*B, J).
        max_power: P_max > 0 [W].

    Returns:
        In (0, 1], to multiply every torque of the group with [1]. Shape (*B, 1).

    Source:
        Fey et al. 2025, section II-B: the arm's torques are clipped a second time.

    Example:
        >>> power_scale(torch.tensor([10.0, -5.0]), torch.tensor([2.0, 4.0]), max_power=20.0)
        tensor([0.5000])
    """
    power = (torque.abs() * velocity.abs()).sum(-1, keepdim=True)
    return max_power / power.clamp(min=max_power)


def uan_features(errors: Tensor, *group: Tensor, wound: Tensor | None = None) -> Tensor:
    """What an Unsupervised Actuator Net sees of each joint.

    Args:
        errors: Of position [rad] and velocity [rad/s], oldest first. Shape (*B, J, 2, L).
        group: Values of all joints that each of them shall see too: positions [rad], velocities [rad/s] and the torques
            that come from the motors [N·m]. Shape (*B, J) each.
        wound: How far each joint has wound up since it turned (:func:`~.functional.actuator_dynamics.wind_up`), over
            each of M ways. Shape (*B, J, M).

    Returns:
        Position errors, velocity errors, then the group's values in their order, then ``wound``. Shape
        (*B, J, 2 L + G J + M), G values of the group being given.

    Source:
        Fey et al. 2025, section II-A, has the errors alone. What a joint at rest holds against gravity, and what a
        lighter rotor would do with a torque, depends on the pose and the torques too; what holds a joint at rest is
        friction, whose memory is longer than 100 ms.

    Example:
        >>> uan_features(torch.zeros(4, 6, 2, 20), torch.zeros(4, 6)).shape
        torch.Size([4, 6, 46])
    """
    joints = errors.shape[-3]
    shown = [value.unsqueeze(-2).expand(*value.shape[:-1], joints, value.shape[-1]) for value in group]
    return torch.cat((errors.flatten(-2), *shown, *(() if wound is None else (wound,))), -1)
