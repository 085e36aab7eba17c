"""Terms of rewards, as functions of tensors: the paper's tables for whole-body control and for the actuator net.

Each gives one value per row, shape (*B, 1), unscaled; :data:`WBC_SCALES` and :data:`UAN_SCALES` hold the paper's
scales. Feet are F, joints J, keypoints K.

Source:
    Fey et al. 2025, appendix A, tables of WBC rewards and of UAN rewards. Where a function departs from what is
    printed, it says so.
"""

from __future__ import annotations

from collections.abc import Mapping
from types import MappingProxyType

import torch
from torch import Tensor

WBC_SCALES: Mapping[str, float] = MappingProxyType(
    {
        "ee_pose_tracking": 5.0,
        "linear_velocity_tracking": 2.0,
        "angular_velocity_tracking": 1.0,
        "gait": -0.5,
        "foot_slip": -0.5,
        "foot_clearance": -40.0,
        "mechanical_power": -0.0001,
        "action_smoothness": -0.05,
        "linear_velocity_z": -2.0,
        "angular_velocity_xy": -0.05,
        "joint_deviation": -0.25,
        "collision": -5.0,
        "joint_limits": -10.0,
        "contact_force": -0.000004,
    }
)
"""Scales of the table of WBC rewards; those from ``mechanical_power`` on, below its dashed line, serve every task."""

UAN_SCALES: Mapping[str, float] = MappingProxyType(
    {
        "joint_position_error": -1.5,
        "joint_position_relaxed": 4.0,
        "joint_position_moderate": 4.0,
        "joint_position_strict": 5.0,
        "action_smoothness": 0.5,
    }
)
"""Scales of the table of UAN rewards. The three kernels are :func:`gaussian` with sharpness 100, 300 and 1000."""


def keypoint_tracking(keypoints: Tensor, command: Tensor, sharpness: float = 2.0) -> Tensor:
    r"""Closeness of a frame to its goal, both given by keypoints.

    .. math:: \sum_{i=0}^{3} \frac{1}{3} \exp(-2\,\|p^*_i - p_i\|)

    As printed: a third of each, of the four keypoints that the text counts, so 4/3 at most.

    Args:
        keypoints: Of :func:`~.rotations.keypoints` [m]. Shape (*B, K, 3).
        command: Goals [m]. Shape (*B, K, 3).
        sharpness: [1/m].

    Example:
        >>> off = torch.zeros(1, 4, 3)
        >>> off[..., 0] = 0.5
        >>> round(float(keypoint_tracking(off, torch.zeros(1, 4, 3))), 4)
        0.4905
    """
    distance = torch.linalg.vector_norm(command - keypoints, dim=-1)
    return torch.exp(-sharpness * distance).sum(-1, keepdim=True) / 3


def gaussian(value: Tensor, target: Tensor, sharpness: float) -> Tensor:
    r"""Closeness of two vectors: :math:`\exp(-s\,\|x^* - x\|^2)`.

    With sharpness 4 it tracks the base's planar velocity [s²/m²] and its yaw rate [s²/rad²]; with 100, 300 and 1000 the
    measured joint positions [1/rad²].

    Args:
        value: x. Shape (*B, D).
        target: x*. Shape (*B, D).
        sharpness: s, in the inverse square of the vectors' unit.

    Example:
        >>> round(float(gaussian(torch.tensor([1.0, 0.0]), torch.tensor([0.5, 0.0]), 4.0)), 4)
        0.3679
    """
    return torch.exp(-sharpness * square(target - value))


def square(value: Tensor) -> Tensor:
    """Squared length of a vector: of the base's vertical velocity, its roll and pitch rates. Shape (*B, D) to (*B, 1).

    Example:
        >>> square(torch.tensor([3.0, 4.0]))
        tensor([25.])
    """
    return value.square().sum(-1, keepdim=True)


def absolute_error(value: Tensor, target: Tensor) -> Tensor:
    """Sum of the absolute differences, such as of joints from their default pose [rad]. Shape (*B, D) to (*B, 1).

    Example:
        >>> absolute_error(torch.tensor([1.0, 0.0]), torch.tensor([0.0, 2.0]))
        tensor([3.])
    """
    return (target - value).abs().sum(-1, keepdim=True)


def premature_contact(in_swing: Tensor, foot_height: Tensor, threshold: float = 0.043) -> Tensor:
    """Feet that should swing but are down: the gait term.

    Args:
        in_swing: Whether each foot should be in the air, 1 or bool. Shape (*B, F).
        foot_height: Above the ground [m]. Shape (*B, F).
        threshold: Below it a foot counts as down [m]. The paper's figure: a B2's foot is a ball of radius 0.032 m,
            whose centre is meant.

    Returns:
        Number of such feet. Shape (*B, 1).

    Example:
        >>> premature_contact(torch.tensor([1.0, 1.0, 0.0]), torch.tensor([0.03, 0.10, 0.03]))
        tensor([1.])
    """
    return (in_swing * (foot_height < threshold)).sum(-1, keepdim=True, dtype=foot_height.dtype)


def foot_slip(in_stance: Tensor, foot_velocity: Tensor, sharpness: float = 0.1) -> Tensor:
    r"""Feet that should stand but move.

    .. math:: \sum_i c_i \left(1 - \exp(-0.1\,\|v_i\|^2)\right)

    The paper prints the exponential alone, at a negative scale, which would reward slipping; this is the form of the
    work that the term stems from.

    Args:
        in_stance: Whether each foot should be down, 1 or bool. Shape (*B, F).
        foot_velocity: In the world [m/s]. Shape (*B, F, 3).
        sharpness: [s²/m²].

    Source:
        Margolis, Agrawal 2022, https://arxiv.org/abs/2212.03238, table of rewards.

    Example:
        >>> still, fast = torch.zeros(1, 3), torch.tensor([[10.0, 0.0, 0.0]])
        >>> float(foot_slip(torch.ones(1), still)), round(float(foot_slip(torch.ones(1), fast)), 3)
        (0.0, 1.0)
    """
    return (in_stance * -torch.expm1(-sharpness * foot_velocity.square().sum(-1))).sum(-1, keepdim=True)


def foot_clearance(in_swing: Tensor, command: Tensor, foot_height: Tensor) -> Tensor:
    """Squared height errors of the feet that should swing [m²].

    Args:
        in_swing: Whether each foot should be in the air, 1 or bool. Shape (*B, F).
        command: Heights that they should have [m]. Shape (*B, F).
        foot_height: [m]. Shape (*B, F).

    Example:
        >>> heights = torch.tensor([0.1, 0.1]), torch.tensor([0.0, 0.0])
        >>> round(float(foot_clearance(torch.tensor([1.0, 0.0]), *heights)), 4)
        0.01
    """
    return (in_swing * (command - foot_height).square()).sum(-1, keepdim=True)


def mechanical_power(torque: Tensor, velocity: Tensor) -> Tensor:
    r"""Size of the power that all joints together exchange: :math:`|\tau \cdot \dot q|` [W].

    Args:
        torque: [N·m]. Shape (*B, J).
        velocity: [rad/s]. Shape (*B, J).

    Example:
        >>> mechanical_power(torch.tensor([2.0, -3.0]), torch.tensor([1.0, 1.0]))
        tensor([1.])
    """
    return (torque * velocity).sum(-1, keepdim=True).abs()


def action_roughness(history: Tensor) -> Tensor:
    r"""First and second difference of the actions.

    .. math:: \|a_t - a_{t-1}\|^2 + \tfrac{1}{2} \|a_t - 2 a_{t-1} + a_{t-2}\|^2

    Args:
        history: Actions, oldest first, at least three. Shape (*B, L, D).

    Example:
        >>> action_roughness(torch.tensor([[0.0], [0.0], [1.0]]))
        tensor([1.5000])
    """
    first = history[..., -1, :] - history[..., -2, :]
    second = first - (history[..., -2, :] - history[..., -3, :])
    return square(first) + 0.5 * square(second)


def action_steadiness(history: Tensor, sharpness: float = 0.5) -> Tensor:
    r"""Closeness of an action to the last: :math:`\exp(-0.5\,\|a_t - a_{t-1}\|_1)`, of the actuator net.

    The paper prints no order of the norm; the row of its table that is named L1 is printed alike.

    Args:
        history: Actions, oldest first, at least two. Shape (*B, L, D).
        sharpness: [1/N·m].

    Example:
        >>> float(action_steadiness(torch.tensor([[1.0], [1.0]])))
        1.0
    """
    return torch.exp(-sharpness * absolute_error(history[..., -1, :], history[..., -2, :]))


def uan_reward(position: Tensor, measured: Tensor, action: Tensor, previous: Tensor) -> Tensor:
    r"""All terms of the table of UAN rewards, scaled and added up: 13.5 where simulation and robot agree and it rests.

    .. math::
        -1.5\,\|q - \hat q\|_1 + 4 e^{-100 \|q - \hat q\|^2} + 4 e^{-300 \|q - \hat q\|^2}
        + 5 e^{-1000 \|q - \hat q\|^2} + 0.5\, e^{-0.5 \|a - a'\|_1}

    Args:
        position: Simulated [rad]. Shape (*B, D).
        measured: [rad]. Shape (*B, D).
        action: Corrective torque now [N·m]. Shape (*B, D).
        previous: And a step before [N·m]. Shape (*B, D).

    Example:
        >>> here, one = torch.zeros(2), torch.ones(2)
        >>> uan_reward(here, here, one, one)
        tensor([13.5000])
        >>> bool(uan_reward(here + 0.1, here, one, one) < 3.0)
        True
    """
    kernels = {"relaxed": 100.0, "moderate": 300.0, "strict": 1000.0}
    tracking = UAN_SCALES["joint_position_error"] * absolute_error(position, measured)
    for name, sharpness in kernels.items():
        tracking = tracking + UAN_SCALES[f"joint_position_{name}"] * gaussian(position, measured, sharpness)
    steady = action_steadiness(torch.stack((previous, action), -2))
    return tracking + UAN_SCALES["action_smoothness"] * steady


def beyond_limits(position: Tensor, limits: Tensor) -> Tensor:
    """By how much joints are beyond their limits, in sum [rad].

    Args:
        position: [rad]. Shape (*B, J).
        limits: Least and greatest [rad]. Shape (J, 2).

    Example:
        >>> round(float(beyond_limits(torch.tensor([-1.2, 0.0, 1.5]), torch.tensor([[-1.0, 1.0]] * 3))), 3)
        0.7
    """
    low, high = limits[..., 0], limits[..., 1]
    return ((low - position).clamp(min=0) + (position - high).clamp(min=0)).sum(-1, keepdim=True)


def any_above(force: Tensor, threshold: float = 0.1) -> Tensor:
    """1 where any of the forces, squared, is above a threshold, else 0: the collision term.

    Args:
        force: On bodies that should touch nothing [N]. Shape (*B, C).
        threshold: [N²].

    Example:
        >>> any_above(torch.tensor([[0.0, 0.0], [0.0, 3.0]])).flatten()
        tensor([0., 1.])
    """
    return (force.square() > threshold).any(-1, keepdim=True).to(force.dtype)
