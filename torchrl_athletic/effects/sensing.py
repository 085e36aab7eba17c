"""Errors of the encoder."""

from __future__ import annotations

from collections.abc import Mapping
from typing import ClassVar

import mujoco

from torchrl_athletic.effects.effect import Array, Effect, Fingerprint, Parameter, is_slide
from torchrl_athletic.effects.plant import Plant
from torchrl_athletic.effects.signals import JointAddress, Signals

_STEP = 1e-3


class EncoderOffset(Effect):
    """The encoder's zero is not the model's.

    Parameters: ``offset`` [rad, m for slides], reading minus true position. Seen only through what depends on the pose:
    gravity, springs, the inertia of other joints.

    Fingerprint: ∂ID/∂q on every joint.

    Simulation: the joint starts at the reading less the offset, and the offset is added to what it reads.
    """

    name = "encoder_offset"
    shows_in = "position"
    equation = "q_read = q + o"
    source = "Khalil, Dombre 2002, Modeling, Identification and Control of Robots, chapter 11"
    experiments: ClassVar[Mapping[str, str]] = {
        "torque_offset": "hold {joint} at several angles far apart, on both sides of the vertical",
        "link_mass": "put {joint} against a stop or a plumb line and read the encoder",
    }

    def parameters(self, model: mujoco.MjModel, address: JointAddress, joint: int) -> tuple[Parameter, ...]:
        slide = is_slide(model, address, joint)
        bound = 0.05 if slide else 0.5
        return (Parameter("offset", "m" if slide else "rad", 0.0, -bound, bound, 0.02 * bound),)

    def grid(self, s: Signals, joint: int) -> list[Mapping[str, float]]:
        return [{}]

    def fingerprint(self, s: Signals, joint: int, fixed: Mapping[str, float]) -> Fingerprint:
        up, down = s.position.copy(), s.position.copy()
        up[:, joint] += _STEP
        down[:, joint] -= _STEP
        return Fingerprint(((s.inverse(position=up) - s.inverse(position=down)) / (2 * _STEP))[:, :, None], fixed)

    def apply(self, plant: Plant, joint: int, values: Array) -> None:
        plant.encoder_offset[:, joint] = values[:, 0]

    def sentence(self, joint: str, values: Mapping[str, float], parameters: tuple[Parameter, ...]) -> str:
        value, unit = values["offset"], parameters[0].unit
        return f"The encoder of {joint} reads {1e3 * value:+.3g} m{unit} off the model's zero."
