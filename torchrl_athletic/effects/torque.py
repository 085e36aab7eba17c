"""Errors of the torque itself: its scale and its zero."""

from __future__ import annotations

from collections.abc import Mapping
from typing import ClassVar

import mujoco
import numpy as np

from torchrl_athletic.effects.effect import (
    Array,
    Effect,
    Fingerprint,
    Parameter,
    local,
    torque_bound,
    torque_scale,
    torque_unit,
)
from torchrl_athletic.effects.plant import Plant
from torchrl_athletic.effects.signals import JointAddress, Signals


class TorqueScale(Effect):
    """The joint receives a multiple of the commanded torque: a wrong torque constant, gear ratio or efficiency.

    Parameters: ``scale`` [1] of the command.

    Fingerprint: the torque that the motion asks for, since u = ID / k.

    Simulation: the command times the scale, within the motor's range.
    """

    name = "torque_scale"
    shows_in = "load"
    equation = "τ = k u"
    excludes = frozenset({"link_mass", "link_com"})  # one joint shows ratios of the three only
    source = "Gautier, Briot 2014, doi:10.1109/TRO.2013.2290862 (drive gains)"
    experiments: ClassVar[Mapping[str, str]] = {
        "link_mass": "hang a known weight on {joint} and hold it still in two poses",
        "reflected_inertia": "hold {joint} still against a known weight: a rotor has none",
        "viscous_friction": "let {joint} swing freely with no torque",
        "gain_mismatch": "change kp of {joint} by a known factor and repeat the take",
    }

    def parameters(self, model: mujoco.MjModel, address: JointAddress, joint: int) -> tuple[Parameter, ...]:
        return (Parameter("scale", "1", 1.0, 0.2, 3.0, 0.05),)

    def grid(self, s: Signals, joint: int) -> list[Mapping[str, float]]:
        return [{}]

    def fingerprint(self, s: Signals, joint: int, fixed: Mapping[str, float]) -> Fingerprint:
        # u = ID / k: scaling the command instead would let "no torque and no mass" explain everything
        return Fingerprint(local(s.required[:, joint], s, joint), fixed)

    def change(self, parameter: Parameter, value: float) -> float:
        return 1.0 - 1.0 / value

    def value(self, parameter: Parameter, change: float) -> float:
        return 1.0 / (1.0 - change)

    def apply(self, plant: Plant, joint: int, values: Array) -> None:
        plant.torque_scale[:, joint] = values[:, 0]

    def sentence(self, joint: str, values: Mapping[str, float], parameters: tuple[Parameter, ...]) -> str:
        percent = 100 * (values["scale"] - 1)
        word = "more" if percent > 0 else "less"
        return f"{joint} receives {abs(percent):.3g} % {word} torque than commanded (scale {values['scale']:.3g})."


class TorqueOffset(Effect):
    """A constant torque beside the command: a current sensor's zero, a cable, a counterweight, a slope.

    Parameters: ``torque`` [N·m, N for slides], added to the command.

    Fingerprint: 1.

    Simulation: the command plus the offset, within the motor's range.
    """

    name = "torque_offset"
    shows_in = "position"
    equation = "τ = u + o"
    source = "Janot, Gautier, Brunot 2019, nonlinearbenchmark.org (EMPS), equation 2"
    excludes = frozenset({"asymmetric_friction"})
    experiments: ClassVar[Mapping[str, str]] = {
        "encoder_offset": "hold {joint} at several angles far apart: an encoder offset changes with the pose, a torque "
        "offset does not",
        "link_mass": "hold {joint} at angles on both sides of the vertical",
        "coulomb_friction": "move {joint} slowly both ways over the same path",
        "asymmetric_friction": "move {joint} both ways at three constant speeds",
    }

    def parameters(self, model: mujoco.MjModel, address: JointAddress, joint: int) -> tuple[Parameter, ...]:
        limit, unit = torque_scale(model, address, joint), torque_unit(model, address, joint)
        bound = torque_bound(model, address, joint)
        return (Parameter("torque", unit, 0.0, -bound, bound, 0.02 * limit),)

    def grid(self, s: Signals, joint: int) -> list[Mapping[str, float]]:
        return [{}]

    def fingerprint(self, s: Signals, joint: int, fixed: Mapping[str, float]) -> Fingerprint:
        return Fingerprint(local(np.ones(len(s.time)), s, joint), fixed)

    def apply(self, plant: Plant, joint: int, values: Array) -> None:
        plant.torque_offset[:, joint] += values[:, 0]

    def sentence(self, joint: str, values: Mapping[str, float], parameters: tuple[Parameter, ...]) -> str:
        return (
            f"A constant {values['torque']:+.3g} {parameters[0].unit} acts on {joint} beside the command; "
            "the model has none."
        )
