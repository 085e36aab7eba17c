"""Errors of what is measured: the encoder's zero and scale, and the clock of the log."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import ClassVar

import mujoco
import numpy as np

from torchrl_athletic.effects.effect import Array, Effect, Fingerprint, Parameter, is_slide
from torchrl_athletic.effects.plant import Plant
from torchrl_athletic.effects.signals import JointAddress, Signals, inverse_dynamics

_STEP = 1e-3
_TIMES = (0.001, 0.002, 0.003, 0.005, 0.007, 0.010, 0.014, 0.020, 0.030)
"""Shifts of a clock to try, either way [s]."""


class EncoderOffset(Effect):
    """The encoder's zero is not the model's.

    Parameters: ``offset`` [rad, m for slides], reading minus true position. Seen only through what depends on the pose:
    gravity, springs, the inertia of other joints.

    Fingerprint: ∂ID/∂q on every joint.

    Simulation: the joint starts at the reading less the offset, and the offset is added to what it reads.
    """

    name = "encoder_offset"
    family = "sensing"
    tolerance = 0.3  # 3 mrad
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


class EncoderScale(Effect):
    """The encoder counts in another unit than the model: a wrong gear ratio, a belt, a magnet off its axis.

    Parameters: ``scale`` [1], reading per true position, about zero. Speed and acceleration are read wrong by the same
    factor, so that all inertia and friction of the joint seem too large, but gravity does not.

    Fingerprint: the derivative of ID along (q, q̇, q̈) of that joint, on every joint.

    Simulation: the joint starts at the reading over the scale, and reads the scale times its position.
    """

    name = "encoder_scale"
    family = "sensing"
    shows_in = "position"
    equation = "q_read = s q"
    source = "Khalil, Dombre 2002, Modeling, Identification and Control of Robots, chapter 11"
    experiments: ClassVar[Mapping[str, str]] = {
        "encoder_offset": "turn {joint} by a known angle, from one stop or plumb line to another",
        "torque_scale": "turn {joint} by a known angle; hang a known weight on it and hold it still",
        "reflected_inertia": "hold {joint} still at several angles far apart, under gravity",
        "link_mass": "turn {joint} by a known angle, from one stop or plumb line to another",
    }

    def parameters(self, model: mujoco.MjModel, address: JointAddress, joint: int) -> tuple[Parameter, ...]:
        return (Parameter("scale", "1", 1.0, 0.75, 1.33, 0.01),)

    def grid(self, s: Signals, joint: int) -> list[Mapping[str, float]]:
        return [{}]

    def fingerprint(self, s: Signals, joint: int, fixed: Mapping[str, float]) -> Fingerprint:
        def scaled(by: float) -> Array:
            q, v, a = s.position.copy(), s.velocity.copy(), s.acceleration.copy()
            for x in (q, v, a):
                x[:, joint] *= by
            return inverse_dynamics(s.model, s.address, q, v, a, s.base)

        return Fingerprint(((scaled(1 + _STEP) - scaled(1 - _STEP)) / (2 * _STEP))[:, :, None], fixed)

    def change(self, parameter: Parameter, value: float) -> float:
        return 1.0 - 1.0 / value  # the true motion is the reading over the scale

    def value(self, parameter: Parameter, change: float) -> float:
        return 1.0 / (1.0 - change)

    def apply(self, plant: Plant, joint: int, values: Array) -> None:
        plant.encoder_scale[:, joint] = values[:, 0]

    def sentence(self, joint: str, values: Mapping[str, float], parameters: tuple[Parameter, ...]) -> str:
        percent = 100 * (values["scale"] - 1)
        word = "too much" if percent > 0 else "too little"
        return f"The encoder of {joint} reads {abs(percent):.3g} % {word} (scale {values['scale']:.4g})."


class ClockOffset(Effect):
    """The clock that stamped the positions is not the one that stamped the commands.

    Parameters: ``offset`` [s], by which commands show late in the motion, as a delay does: stamps of the positions less
    those of the commands. It is negative where the motion seems to run ahead of its command, which no delay can do.
    On a robot with one joint, or where all joints share one delay, a positive offset and ``actuation_delay`` are the
    same; with one joint it is called a delay.

    Fingerprint: u(t - T) - u(t) on all joints, at offsets T up to 30 ms either way and of half a sample to three.

    Simulation: the recorded commands of all joints, T late.
    """

    name = "clock_offset"
    family = "sensing"
    tolerance = 0.2  # 1 ms
    odds = 1 / 3
    whole_robot = True
    shows_in = "acceleration"
    equation = "τ(t) = u(t - T) on all joints, T of either sign"
    source = "Furgale, Rehder, Siegwart 2013, doi:10.1109/IROS.2013.6696514"
    excludes = frozenset({"actuation_delay"})
    identical_to = (frozenset({"actuation_delay"}),)
    experiments: ClassVar[Mapping[str, str]] = {
        "actuation_delay": "knock on the robot where one clock stamps both a force and the encoders, or give single "
        "joints such as {joint} steps in turn: an offset is the same on all, and may be negative",
        "actuation_lag": "command {joint} with steps and with a chirp above 10 Hz",
        "reflected_inertia": "chirp {joint} from 0.5 Hz to 20 Hz: its phase grows in proportion to frequency",
        "viscous_friction": "turn {joint} at constant speed: friction remains, an offset does not show",
    }

    def parameters(self, model: mujoco.MjModel, address: JointAddress, joint: int) -> tuple[Parameter, ...]:
        return (Parameter("offset", "s", 0.0, -0.2, 0.2, 0.005),)

    def grid(self, s: Signals, joint: int) -> list[Mapping[str, float]]:
        period = 1.0 / s.recording.rate
        times = {*_TIMES, *(n * period for n in (0.5, 1.0, 1.5, 2.0, 3.0) if n * period < 0.2)}
        signs = (-1.0, 1.0) if s.num_joints > 1 else (-1.0,)  # one joint's late command is an actuation_delay
        return [{"offset": sign * time} for sign in signs for time in sorted(times)]

    def fingerprint(self, s: Signals, joint: int, fixed: Mapping[str, float]) -> Fingerprint:
        return self.fingerprints(s, joint, [fixed])[0]

    def fingerprints(self, s: Signals, joint: int, grid: Sequence[Mapping[str, float]]) -> list[Fingerprint]:
        now = s.torque_of(s.project_command(s.raw_command()))
        none = np.zeros((*now.shape, 0))
        return [
            Fingerprint(none, fixed, s.torque_of(s.project_command(s.raw_command(fixed["offset"]))) - now)
            for fixed in grid
        ]

    def apply(self, plant: Plant, joint: int, values: Array) -> None:
        plant.clock_offset[:] = values[:, 0]

    def sentence(self, joint: str, values: Mapping[str, float], parameters: tuple[Parameter, ...]) -> str:
        late = "late" if values["offset"] >= 0 else "early"
        return (
            f"The positions of all joints are stamped {abs(1e3 * values['offset']):.3g} ms {late} against the "
            "commands; the model has none of this."
        )
