"""Which way is down."""

from __future__ import annotations

from collections.abc import Mapping
from typing import ClassVar

import mujoco
import numpy as np

from torchrl_athletic.effects.effect import Array, Effect, Fingerprint, Parameter
from torchrl_athletic.effects.plant import Plant
from torchrl_athletic.effects.signals import JointAddress, Signals

_STEP = 0.01


class GravityTilt(Effect):
    """The robot does not stand as upright as its model: the table slopes, or the base was bolted on askew.

    Parameters: ``roll`` and ``pitch`` [rad] of the robot's base about the model's x and y axes, at most 20 degrees. A
    turn about the vertical changes nothing.

    Fingerprint: -∂ID/∂roll and -∂ID/∂pitch on every joint, from the inverse dynamics under tilted gravity.

    Simulation: the model's gravity, turned the other way.
    """

    name = "gravity_tilt"
    family = "inertia"
    mjcf = "model"
    whole_robot = True
    shows_in = "position"
    equation = "g → Rx(-roll) Ry(-pitch) g"
    source = "Hollerbach, Khalil, Gautier 2016, Springer Handbook of Robotics, chapter 6"
    experiments: ClassVar[Mapping[str, str]] = {
        "encoder_offset": "put a spirit level under {joint}, or hold still in poses that differ in two joints: a tilt "
        "turns with the first joint, an encoder's zero does not",
        "torque_offset": "hold {joint} still in several poses far apart: a tilt pulls with the cosine of the pose",
        "link_mass": "put a spirit level under {joint}, or hold still on both sides of the vertical",
        "link_com": "put a spirit level under {joint}, or turn the base by a quarter about the vertical and repeat the "
        "take",
        "joint_spring": "put a spirit level under {joint}, or sweep slowly through a full turn",
        "payload": "put a spirit level under {joint}, or take the payload off and repeat the take",
    }

    def parameters(self, model: mujoco.MjModel, address: JointAddress, joint: int) -> tuple[Parameter, ...]:
        if not _falls(model):
            return ()
        return tuple(Parameter(angle, "rad", 0.0, -0.35, 0.35, 0.01) for angle in ("roll", "pitch"))

    def grid(self, s: Signals, joint: int) -> list[Mapping[str, float]]:
        return [{}] if _falls(s.model) else []

    def applies(self, s: Signals) -> bool:
        return _falls(s.model) and bool(np.abs(self.fingerprint(s, 0, {}).columns).max() > 1e-9)

    def fingerprint(self, s: Signals, joint: int, fixed: Mapping[str, float]) -> Fingerprint:
        columns = []
        for step in _STEP * np.eye(2):
            torques = []
            for angles in (step, -step):
                model = s.model.__copy__()
                model.opt.gravity[:] = tilted(model.opt.gravity[None], angles[None])[0]
                torques.append(s.inverse(model))
            columns.append((torques[1] - torques[0]) / (2 * _STEP))
        return Fingerprint(np.stack(columns, -1), fixed)

    def apply(self, plant: Plant, joint: int, values: Array) -> None:
        if values.any():
            plant.of("opt.gravity")[:] = tilted(plant.of("opt.gravity"), values)

    def sentence(self, joint: str, values: Mapping[str, float], parameters: tuple[Parameter, ...]) -> str:
        off = np.degrees(np.arccos(np.cos(values["roll"]) * np.cos(values["pitch"])))
        return (
            f"The robot stands {off:.2g} degrees off the upright, rolled by {1e3 * values['roll']:+.3g} mrad and "
            f"pitched by {1e3 * values['pitch']:+.3g} mrad; the model has none of it."
        )


def tilted(gravity: Array, angles: Array) -> Array:
    """Gravity as a base sees it that is pitched about its y axis, then rolled about its x axis.

    Args:
        gravity: Before [m/s²]. Shape (rows, 3).
        angles: Roll and pitch [rad]. Shape (rows, 2).

    Returns:
        Shape (rows, 3).

    Example:
        >>> tilted(np.array([[0.0, 0.0, -10.0]]), np.array([[0.0, np.pi / 6]])).round(3).tolist()  # nose down
        [[5.0, 0.0, -8.66]]
    """
    (cos_roll, cos_pitch), (sin_roll, sin_pitch) = np.cos(angles).T, np.sin(angles).T
    x, y, z = gravity.T
    x, z = cos_pitch * x - sin_pitch * z, sin_pitch * x + cos_pitch * z
    return np.stack([x, cos_roll * y + sin_roll * z, cos_roll * z - sin_roll * y], -1)


def _falls(model: mujoco.MjModel) -> bool:
    """Whether the model has gravity at all."""
    disabled = int(model.opt.disableflags) & int(mujoco.mjtDisableBit.mjDSBL_GRAVITY)
    return not disabled and bool(np.any(model.opt.gravity))
