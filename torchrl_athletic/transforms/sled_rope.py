"""A sled on a rope that is tied to the robot's hand."""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import Any

import torch
from tensordict import NestedKey, TensorDictBase
from torch import Tensor
from torchrl.data import Composite, TensorSpec

from torchrl_athletic.functional import rotations, sled, streams
from torchrl_athletic.transforms.simulated import once_per_model, simulated_env
from torchrl_athletic.transforms.stateful import RandomTransform, unbounded_like

_BODY = "handle"


class SledRope(RandomTransform):
    """Let a sled hang on a rope that is tied to the handle.

    See :mod:`torchrl_athletic.functional.sled`. It runs at the physics rate: put it before
    :class:`~torchrl_athletic.transforms.Decimation` in Compose, on an environment whose robot holds a
    :class:`~torchrl_athletic.robots.Handle` and that shows ``every_step`` at every step. What the rope pulls after a
    step acts in the next one, on the handle (:meth:`~torchrl_athletic.envs.TorqueEnv.set_wrench`) and as hard on the
    sled, so that none of their momentum is lost.

    When an episode begins, the sled stands ahead of the grip, where the base is heading, and the rope is just taut: its
    length is the distance to the hook. The robot has to walk backwards. Each episode draws a mass and a friction.

    Writes, in world axes:

    - ``sled_position`` [m], ``sled_velocity`` [m/s] (N, 2);
    - ``sled_mass`` [kg], ``sled_friction`` [1], ``rope_length`` [m], constant in an episode (N, 1);
    - ``sled_hook_height`` [m], where the rope is tied, constant too: the sled slides on a level (N, 1);
    - ``rope_tension`` [N] (N, 1) and ``rope_force`` [N], what it does to the hand (N, 3).

    Args:
        dt: Of a step at this place in the chain [s].
        mass: Least and greatest [kg]. The paper pulls up to 150 kg.
        friction: Least and greatest coefficient of the runners [1]. The paper's carts resisted with 113 N and 230 N.
        length: From the grip to the hook when an episode begins, over the ground [m].
        hook_height: Over the ground below the base when an episode begins, where the environment shows ``base_height``;
            else over z = 0 [m].
        stiffness: Of the rope [N/m²].
        damping: Of the rope [N·s²/m²].
        seed: Of the draws.
        first_row: As of :class:`RandomTransform`.
        reset_key: As of :class:`StatefulTransform`.

    Raises:
        ValueError: If no such sled can be; on an environment without a handle, one that shows it at the policy's rate
            only, or one whose base does not float.

    Source:
        Fey et al. 2025, appendix B-C. Ranges, length and height are ours.

    Example:
        >>> from torchrl.envs import TransformedEnv
        >>> from torchrl_athletic.envs import TorqueEnv
        >>> from torchrl_athletic.robots import Handle, b2z1
        >>> base = TorqueEnv(b2z1(tool=Handle()), num_envs=2, every_step=SledRope.every_step)
        >>> shown = TransformedEnv(base, SledRope(0.005, mass=(100.0, 100.0))).reset()
        >>> (shown["sled_position"] - shown["handle_position"][:, :2]).round(decimals=3), shown["sled_mass"].flatten()
        (tensor([[2., 0.],
                [2., 0.]]), tensor([100., 100.]))
    """

    every_step = ("handle_position", "handle_linear_velocity")
    """Sensors that it reads at every step of the physics."""

    def __init__(
        self,
        dt: float,
        *,
        mass: tuple[float, float] = (20.0, 180.0),
        friction: tuple[float, float] = (0.1, 0.2),
        length: float = 2.0,
        hook_height: float = 0.2,
        stiffness: float = sled.STIFFNESS,
        damping: float = sled.DAMPING,
        seed: int = 0,
        first_row: int = 0,
        reset_key: NestedKey | None = None,
    ) -> None:
        _check(dt, mass, friction, length, stiffness, damping)
        keys: list[NestedKey] = ["sled_position", "sled_velocity", "sled_mass", "sled_friction", "sled_hook_height"]
        keys += ["rope_length", "rope_tension", "rope_force"]
        super().__init__(list(self.every_step), keys, seed=seed, first_row=first_row, reset_key=reset_key)
        self.dt, self.mass, self.friction = dt, mass, friction
        self.length, self.hook_height, self.stiffness, self.damping = length, hook_height, stiffness, damping

    def _inv_call(self, tensordict: TensorDictBase) -> TensorDictBase:
        if self.parent is not None:  # else on its way into a buffer
            self._pull(tensordict.get("rope_force"))
        return tensordict

    def _pull(self, force: Tensor) -> None:
        wrench = torch.cat((force, torch.zeros_like(force)), -1).unsqueeze(-2)
        simulated_env(self).set_wrench("rope_force", once_per_model(self, self._body_id), wrench)

    def draw(self, key: Tensor, tensordict_reset: TensorDictBase) -> Mapping[NestedKey, Tensor]:
        grip = tensordict_reset.get("handle_position")
        forward = rotations.matrix(tensordict_reset.get("base_quaternion"))[..., :2, 0]
        heading = torch.nn.functional.normalize(forward, dim=-1)
        height = torch.full_like(grip[..., 2:], self.hook_height)
        above_ground = tensordict_reset.get("base_height", None)
        if above_ground is not None:
            height = height + tensordict_reset.get("base_position")[..., 2:] - above_ground
        position = grip[..., :2] + self.length * heading
        way = torch.cat((position, height), -1) - grip
        unit = streams.uniform(key, 2)
        return {
            "sled_position": position,
            "sled_velocity": torch.zeros_like(position),
            "sled_mass": _between(self.mass, unit[..., :1]),
            "sled_friction": _between(self.friction, unit[..., 1:]),
            "sled_hook_height": height,
            "rope_length": torch.linalg.vector_norm(way, dim=-1, keepdim=True),
            "rope_tension": torch.zeros_like(height),
            "rope_force": torch.zeros_like(grip),
        }

    def advance(self, tensordict: TensorDictBase, next_tensordict: TensorDictBase) -> None:
        position, velocity, mass, friction, height, length, _, force = (tensordict.get(key) for key in self.out_keys)
        position, velocity = sled.slide(position, velocity, -force[..., :2], mass, friction, self.dt)
        hook, hook_velocity = torch.cat((position, height), -1), torch.cat((velocity, torch.zeros_like(height)), -1)
        grip, grip_velocity = (next_tensordict.get(key) for key in self.every_step)
        distance, rate, direction = sled.span(grip, grip_velocity, hook, hook_velocity)
        tension = sled.tension(distance, rate, length, self.stiffness, self.damping)
        values = (position, velocity, mass, friction, height, length, tension, tension * direction)
        for key, value in zip(self.out_keys, values, strict=True):
            next_tensordict.set(key, value)

    def _reset(self, tensordict: TensorDictBase, tensordict_reset: TensorDictBase) -> TensorDictBase:
        once_per_model(self, self._body_id)
        return super()._reset(tensordict, tensordict_reset)

    def _body_id(self, env: Any) -> Tensor:
        """Number of the handle in the model, shape (1,), on an environment that shows all that this needs."""
        shown, physics = set(env.observation_spec.keys()), env.physics
        if missing := [key for key in self.every_step if key not in shown]:
            raise ValueError(
                f"SledRope ties its rope to a handle, but the environment does not show {missing}. Give the robot one: "
                "b2z1(tool=Handle())."
            )
        if missing := [key for key in self.every_step if key not in env.every_step]:
            raise ValueError(
                f"SledRope reads {missing} at every step of the physics, and within an action they are not shown. Make "
                "the environment with TorqueEnv(..., every_step=SledRope.every_step)."
            )
        if "base_quaternion" not in shown:
            raise ValueError(
                "SledRope puts its sled where the base is heading, but the environment shows no 'base_quaternion'. Put "
                "it on a robot with a floating base, such as b2z1(tool=Handle())."
            )
        return torch.tensor([physics.model.body(_BODY).id], device=physics.device)

    def state_spec(self, observation_spec: Composite) -> Mapping[NestedKey, TensorSpec]:
        once_per_model(self, self._body_id)
        grip = observation_spec["handle_position"]
        widths = (2, 2, 1, 1, 1, 1, 1, 3)
        return {
            key: unbounded_like(grip, (*grip.shape[:-1], width))
            for key, width in zip(self.out_keys, widths, strict=True)
        }


def _between(limits: tuple[float, float], unit: Tensor) -> Tensor:
    """The number in a range that one in [0, 1) stands for."""
    return limits[0] + (limits[1] - limits[0]) * unit


def _check(
    dt: float,
    mass: tuple[float, float],
    friction: tuple[float, float],
    length: float,
    stiffness: float,
    damping: float,
) -> None:
    if not dt > 0:
        raise ValueError(f"dt is {dt} s, needed is more than 0: the sled would never move.")
    if not 0 < mass[0] <= mass[1] < math.inf:
        raise ValueError(f"mass is {mass} kg: no sled weighs that. Give (least, greatest), both more than 0.")
    if not 0 <= friction[0] <= friction[1] < math.inf:
        raise ValueError(f"friction is {friction}: no coefficient is between. Give (least, greatest), neither below 0.")
    if not 0 < length < math.inf:
        raise ValueError(f"length is {length} m, needed is more than 0: the sled would stand below the hand.")
    if not stiffness > 0 or not damping >= 0:
        raise ValueError(
            f"stiffness {stiffness} N/m² and damping {damping} N·s²/m² make no rope. Give a stiffness of more than 0 "
            "and a damping of at least 0."
        )
