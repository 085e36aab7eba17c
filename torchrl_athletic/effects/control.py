"""Errors of the joint's position controller."""

from __future__ import annotations

from collections.abc import Mapping
from typing import ClassVar

import mujoco
import numpy as np

from torchrl_athletic.effects.effect import Array, Effect, Fingerprint, Parameter, local
from torchrl_athletic.effects.plant import Plant
from torchrl_athletic.effects.signals import JointAddress, Signals


class GainMismatch(Effect):
    """The drive's gains are not the logged ones, often because firmware counts in units of its own.

    Only recordings with ``position_target`` can show it.

    Parameters: ``kp_scale``, ``kd_scale`` [1], true gain per logged gain. ``kd_scale`` cannot be told from viscous
    friction in a closed loop; with ``kd = 0`` logged it is not fitted.

    Fingerprint: kp (q* - q) and -kd q̇, with the logged gains.

    Simulation: the position controller with the logged gains times these factors.
    """

    name = "gain_mismatch"
    family = "control"
    own_joint = True
    tolerance = 1.0  # 5 %
    mjcf = "actuator"
    shows_in = "load"
    equation = "τ = a kp (q* - q) - c kd q̇"
    source = "Isaac Lab, actuators; PACE (Bjelonic et al. 2025, arXiv:2509.06342)"
    excludes = frozenset(
        {"torque_scale", "link_mass", "link_com", "viscous_friction"}
    )  # a loop shows their ratios only
    identical_to = (frozenset({"viscous_friction"}),)  # where kd alone is off
    experiments: ClassVar[Mapping[str, str]] = {
        "torque_scale": "hang a known weight on {joint} and hold it at two gains",
        "viscous_friction": "let {joint} swing freely with the drive off",
        "link_mass": "hang a known weight on {joint} and hold it still",
    }

    def applies(self, s: Signals) -> bool:
        return s.recording.position_target is not None

    def parameters(self, model: mujoco.MjModel, address: JointAddress, joint: int) -> tuple[Parameter, ...]:
        return tuple(Parameter(name, "1", 1.0, 0.1, 10.0, 0.05) for name in ("kp_scale", "kd_scale"))

    def grid(self, s: Signals, joint: int) -> list[Mapping[str, float]]:
        return [{}]

    def fingerprint(self, s: Signals, joint: int, fixed: Mapping[str, float]) -> Fingerprint:
        assert s.recording.kp is not None
        assert s.recording.kd is not None
        target = s.project_command(s.raw_command())
        proportional = s.recording.kp[joint] * (target - s.position)[:, joint]
        derivative = -s.recording.kd[joint] * s.velocity[:, joint]
        return Fingerprint(local(np.stack([proportional, derivative], -1), s, joint), fixed)

    def apply(self, plant: Plant, joint: int, values: Array) -> None:
        plant.kp_scale[:, joint], plant.kd_scale[:, joint] = values.T

    def sentence(self, joint: str, values: Mapping[str, float], parameters: tuple[Parameter, ...]) -> str:
        return (
            f"The gains of {joint} are not the logged ones: kp is {values['kp_scale']:.3g} times and kd "
            f"{values['kd_scale']:.3g} times what the log says."
        )
