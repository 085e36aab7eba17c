"""The Unsupervised Actuator Net: one small network, shared by all joints, that corrects each joint's torque."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

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
    joints: int | None = None,
    state_unit: Sequence[float] | None = None,
    memory: Sequence[float] = (),
    odd: bool = False,
) -> nn.Sequential:
    """Network from a joint's recent tracking errors to a corrective torque.

    It maps (*B, J, 2 history), position errors [rad] and then velocity errors [rad/s], to (*B, J, 1) [N·m]; the joints
    are samples to it. Its last layer starts at zero, so that an untrained one corrects nothing. The paper's net knows
    no more; ``joints`` and ``state_unit`` let it know which joint it serves, and how the arm stands and moves;
    ``memory``, where the joint turned, however long ago.

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
        joints: J, for a net that is told which of them it serves (:class:`WhichJoint`). None as in the paper.
        state_unit: For a net of ``joints`` that is also shown positions, velocities and torques of all of them
            (:func:`~.functional.actuation.uan_features`), what they are divided by. Length 3 J.
        memory: Ways [rad] within which a joint winds up when it turns: for each the net is shown how far, -1 to 1.
        odd: Whether its torque turns about with all that it is shown (:class:`Odd`), as friction and inertia do. Where
            the state is shown, the arm then has to hang as it is mirrored, with all positions at 0.

    Raises:
        ValueError: If there is a ``state_unit`` without ``joints``, or not one for each value.

    Source:
        Fey et al. 2025, section III-A, https://arxiv.org/abs/2502.10894.

    Example:
        >>> uan()(torch.randn(4, 6, 40)).shape
        torch.Size([4, 6, 1])
    """
    state = torch.tensor([] if state_unit is None else list(state_unit), device=device)
    if state_unit is not None and (joints is None or len(state) != 3 * joints):
        raise ValueError(
            f"state_unit has {len(state)} numbers for {joints} joints, needed are the units of the position, the "
            "velocity and the torque of each: joints=6 and 18 numbers, say."
        )
    wound = torch.ones(len(memory), device=device)
    units = torch.cat((torch.tensor(unit, device=device).repeat_interleave(history), state, wound))
    sharpness = torch.tensor([LINEAR, max(sharpness_of_velocity, LINEAR)], device=device).repeat_interleave(history)
    sharpness = torch.cat((sharpness, torch.full_like(units[2 * history :], LINEAR)))
    told = [] if joints is None else [WhichJoint(joints, state=state_unit is not None, device=device)]
    net = MLP(len(units) + (joints or 0), 1, num_cells=list(hidden), activation_class=nn.ELU, device=device)
    nn.init.zeros_(net[-1].weight)
    nn.init.zeros_(net[-1].bias)
    law = Odd(net, stays=joints or 0) if odd else net
    return nn.Sequential(InUnits(units, sharpness, memory), *told, law, OutUnits(torque_unit, device))


@dataclass(frozen=True)
class Sizes:
    """What a net of :func:`uan` looks at, and how large it is."""

    history: int
    """Steps."""
    hidden: tuple[int, ...]
    joints: int | None
    """Number of joints that it tells apart; None if it does not know which one it serves."""
    state: bool
    """Whether it is shown positions, velocities and torques of all joints."""
    memory: tuple[float, ...] = ()
    """Ways over which it is shown how far the joint has wound up [rad]."""
    odd: bool = False
    """Whether its torque turns about with what it is shown."""

    def net(self) -> nn.Sequential:
        """An untrained one of these sizes."""
        unit = [1.0] * (3 * (self.joints or 0)) if self.state else None
        return uan(self.history, self.hidden, joints=self.joints, state_unit=unit, memory=self.memory, odd=self.odd)


def sizes_of(net: nn.Module) -> Sizes:
    """Sizes of a net that :func:`uan` made.

    Example:
        >>> sizes_of(uan(history=5, hidden=(8,), joints=6))
        Sizes(history=5, hidden=(8,), joints=6, state=False, memory=(), odd=False)
    """
    linears = [layer for layer in net.modules() if isinstance(layer, nn.Linear)]
    told = next((module for module in net.modules() if isinstance(module, WhichJoint)), None)
    joints = None if told is None else told.joints
    state = told is not None and told.state
    memory = next((module.memory for module in net.modules() if isinstance(module, InUnits)), ())
    features = linears[0].in_features - (joints or 0) * (4 if state else 1) - len(memory)
    odd = any(isinstance(module, Odd) for module in net.modules())
    return Sizes(features // 2, tuple(layer.out_features for layer in linears[:-1]), joints, state, memory, odd)


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
        memory: What the last features are wound up over [rad]; noted for :func:`sizes_of`.
    """

    unit: Tensor
    sharpness: Tensor

    def __init__(self, unit: Tensor, sharpness: Tensor, memory: Sequence[float] = ()):
        super().__init__()
        self.memory = tuple(memory)
        self.register_buffer("unit", unit)
        self.register_buffer("sharpness", sharpness)

    def forward(self, value: Tensor) -> Tensor:
        return torch.asinh(self.sharpness * value / self.unit) / torch.asinh(self.sharpness)


class WhichJoint(nn.Module):
    """Beside each joint's features, which joint it is: one for itself, zero for the others. (*B, J, F + J).

    A layer that follows learns a vector for each joint, which is what is called an embedding.

    Args:
        joints: J.
        state: Whether the features hold the state of all joints; noted for :func:`sizes_of`.
        device: Where it is.
    """

    which: Tensor

    def __init__(self, joints: int, state: bool = False, device: torch.device | str | None = None):
        super().__init__()
        self.joints, self.state = joints, state
        self.register_buffer("which", torch.eye(joints, device=device), persistent=False)

    def forward(self, value: Tensor) -> Tensor:
        return torch.cat((value, self.which.to(value.dtype).expand(*value.shape[:-1], -1)), -1)


class Odd(nn.Module):
    """The odd part of a net, (f(x) - f(-x)) / 2: what it learns of a motion holds for the mirrored one too.

    Dry and viscous friction and a missing inertia are odd in a joint's errors, so that a few takes teach twice as much;
    a friction that is stronger one way is not, and is left out. (*B, F) -> (*B, 1).

    Args:
        net: f.
        stays: How many of the last features are not mirrored: which joint it is.
    """

    def __init__(self, net: nn.Module, stays: int = 0):
        super().__init__()
        self.net, self.stays = net, stays

    def forward(self, value: Tensor) -> Tensor:
        turns = value.shape[-1] - self.stays
        mirrored = torch.cat((-value[..., :turns], value[..., turns:]), -1)
        here, there = self.net(torch.stack((value, mirrored)))
        return 0.5 * (here - there)


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
