"""The Unsupervised Actuator Net: one small network, shared by all joints, that corrects each joint's torque."""

from __future__ import annotations

from collections.abc import Sequence

import torch
from tensordict import NestedKey
from torch import Tensor, nn
from torchrl.modules import MLP, ProbabilisticActor

from torchrl_athletic.networks.actor_critic import GaussianHead, gaussian_actor

HISTORY = 20
"""Physics steps of 5 ms that a UAN looks back: 100 ms."""

LINEAR = 1e-3
"""Sharpness at which a scale is linear to a part in a million."""


def uan(
    history: int = HISTORY,
    hidden: Sequence[int] = (128, 128),
    device: torch.device | str | None = None,
    *,
    unit: tuple[float, float] = (1.0, 1.0),
    sharpness_of_velocity: float = 0.0,
    torque_unit: float | Sequence[float] = 1.0,
) -> nn.Sequential:
    """Network from a joint's recent tracking errors to a corrective torque.

    It maps (*B, J, 2 history), position errors [rad] and then velocity errors [rad/s], to (*B, J, 1) [N·m]; the joints
    are samples to it. Its last layer starts at zero, so that an untrained one corrects nothing.

    Args:
        history: Physics steps it sees.
        hidden: Layer sizes.
        device: Where its parameters are made.
        unit: What the position errors [rad] and the velocity errors [rad/s] are divided by first, their standard
            deviations in the data say; kept with the parameters. The paper states none.
        sharpness_of_velocity: How much finer velocities are seen about zero, where friction turns over, than at their
            unit (:class:`InUnits`); 0 sees all alike, as in the paper.
        torque_unit: What the output is multiplied with [N·m], for each joint where they differ: a joint with two motors
            has twice the friction of one with one. Kept with the parameters.

    Source:
        Fey et al. 2025, section III-A, https://arxiv.org/abs/2502.10894.

    Example:
        >>> uan()(torch.randn(4, 6, 40)).shape
        torch.Size([4, 6, 1])
    """
    net = MLP(2 * history, 1, num_cells=list(hidden), activation_class=nn.ELU, device=device)
    nn.init.zeros_(net[-1].weight)
    nn.init.zeros_(net[-1].bias)
    units = torch.tensor(unit, device=device).repeat_interleave(history)
    sharpness = torch.tensor([LINEAR, max(sharpness_of_velocity, LINEAR)], device=device).repeat_interleave(history)
    return nn.Sequential(InUnits(units, sharpness), net, OutUnits(torque_unit, device))


def uan_actor(
    net: nn.Module,
    *,
    in_keys: Sequence[NestedKey] = ("observation",),
    scale: float = 1.0,
    device: torch.device | str | None = None,
) -> ProbabilisticActor:
    """Policy that explores around a UAN, to train it by PPO; ``net`` itself is what is kept.

    Args:
        net: As :func:`uan` gives it.
        in_keys: Where its input (*B, J, 2 history) is.
        scale: First standard deviation of all joints [N·m].
        device: Where that is made.

    Returns:
        Module that writes ``loc``, ``scale``, ``action`` (*B, J) and ``action_log_prob`` (*B).

    Example:
        >>> from tensordict import TensorDict
        >>> uan_actor(uan())(TensorDict({"observation": torch.randn(4, 6, 40)}, [4]))["action"]
        tensor([[0., 0., 0., 0., 0., 0.],
                [0., 0., 0., 0., 0., 0.],
                [0., 0., 0., 0., 0., 0.],
                [0., 0., 0., 0., 0., 0.]], grad_fn=<SqueezeBackward1>)
    """
    return gaussian_actor(GaussianHead(PerJoint(net), 1, scale, device), in_keys)


class InUnits(nn.Module):
    r"""Each feature divided by its unit, and seen on a scale that is fine about zero. Shape (*B, F).

    .. math:: \mathrm{asinh}(s\,x / u) \,/\, \mathrm{asinh}(s)

    Args:
        unit: u. Shape (F,).
        sharpness: s > 0 [1]: how much finer than at the unit; near 0 the scale is linear. Shape (F,).
    """

    unit: Tensor
    sharpness: Tensor

    def __init__(self, unit: Tensor, sharpness: Tensor):
        super().__init__()
        self.register_buffer("unit", unit)
        self.register_buffer("sharpness", sharpness)

    def forward(self, value: Tensor) -> Tensor:
        return torch.asinh(self.sharpness * value / self.unit) / torch.asinh(self.sharpness)


class OutUnits(nn.Module):
    """Each joint's output times its unit, which goes into the state as plain numbers. Shape (*B, J, 1)."""

    unit: Tensor

    def __init__(self, unit: float | Sequence[float], device: torch.device | str | None = None):
        super().__init__()
        self.register_buffer("unit", torch.tensor(unit, device=device).reshape(-1, 1), persistent=False)

    def forward(self, value: Tensor) -> Tensor:
        return value * self.unit

    def get_extra_state(self) -> list[float]:
        return self.unit.flatten().tolist()

    def set_extra_state(self, state: list[float]) -> None:
        self.unit = self.unit.new_tensor(state).reshape(-1, 1)


class PerJoint(nn.Module):
    """One number a joint, without the dimension of one. (*B, J, F) -> (*B, J)."""

    def __init__(self, net: nn.Module):
        super().__init__()
        self.net = net

    def forward(self, joints: Tensor) -> Tensor:
        return self.net(joints).squeeze(-1)
