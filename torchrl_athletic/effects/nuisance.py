"""What every model and every log is a little wrong in: adjusted within a tolerance beside the findings, never found."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace

import mujoco
import numpy as np

from torchrl_athletic.effects.effect import Array, Effect, Fingerprint, Parameter, is_slide
from torchrl_athletic.effects.inertia import carries_link, recompute_constants
from torchrl_athletic.effects.plant import Plant
from torchrl_athletic.effects.signals import JointAddress, Signals
from torchrl_athletic.recordings.base import base_moves

_AXES = ("x", "y", "z")


class LinkComShift(Effect):
    """The link's centre of mass lies a little beside where the model has it, in any direction.

    Parameters: ``x``, ``y``, ``z`` [m] in the body's frame, added to the given centre.

    Fingerprint: -∂ID/∂c on every joint, from the inverse dynamics with the centre moved.

    Simulation: the position of the body's centre of mass.
    """

    name = "link_com_shift"
    family = "inertia"
    tolerance = 0.6  # 3 % of the link's size
    mjcf = "model"
    shows_in = "load"
    equation = "c → c + Δc"
    source = "Atkeson, An, Hollerbach 1986, doi:10.1177/027836498600500306"

    def parameters(self, model: mujoco.MjModel, address: JointAddress, joint: int) -> tuple[Parameter, ...]:
        body = address.body[joint]
        mass = float(model.body_mass[body])
        if is_slide(model, address, joint) or not mass or not carries_link(address, joint):
            return ()
        size = float(np.sqrt(model.body_inertia[body].sum() / (2 * mass)) + np.linalg.norm(model.body_ipos[body]))
        return tuple(Parameter(axis, "m", 0.0, -size, size, 0.05 * size) for axis in _AXES)

    def grid(self, s: Signals, joint: int) -> list[Mapping[str, float]]:
        return [{}]

    def fingerprint(self, s: Signals, joint: int, fixed: Mapping[str, float]) -> Fingerprint:
        body, columns = s.address.body[joint], []
        step = 1e-3 * float(np.linalg.norm(s.model.body_ipos[body]) + 0.01)
        for axis in range(3):
            model = s.model.__copy__()
            model.body_ipos[body, axis] += step
            recompute_constants(model)
            columns.append(-(s.inverse(model) - s.rigid) / step)
        return Fingerprint(np.stack(columns, -1), fixed)

    def apply(self, plant: Plant, joint: int, values: Array) -> None:
        plant.of("body_ipos")[:, plant.address.body[joint]] += values

    def sentence(self, joint: str, values: Mapping[str, float], parameters: tuple[Parameter, ...]) -> str:
        shift = ", ".join(f"{1e3 * values[axis]:+.3g}" for axis in _AXES)
        return f"The centre of mass of the link moved by {joint} lies ({shift}) mm from where the model has it."


class BaseClockShift(Effect):
    """The pose of a floating robot's base was stamped by another clock than its joints, or came later.

    Parameters: ``offset`` [s] by which the base is stamped late against the joints.

    Fingerprint: -∂ID/∂t on every joint, where time passes for the base alone.

    Simulation: the base moves by its recording, the offset early.
    """

    name = "base_clock_shift"
    family = "sensing"
    tolerance = 2.0  # 10 ms of a base that another computer saw
    whole_robot = True
    shows_in = "acceleration"
    equation = "base(t) = recorded(t + o)"
    source = "Furgale, Rehder, Siegwart 2013, doi:10.1109/IROS.2013.6696514"

    def parameters(self, model: mujoco.MjModel, address: JointAddress, joint: int) -> tuple[Parameter, ...]:
        return (Parameter("offset", "s", 0.0, -0.05, 0.05, 0.005),)

    def parameters_of(self, takes: Sequence[Signals], joint: int) -> tuple[Parameter, ...]:
        moves = any(base_moves(s.recording) for s in takes)
        return super().parameters_of(takes, joint) if moves else ()

    def grid(self, s: Signals, joint: int) -> list[Mapping[str, float]]:
        return [{}]

    def fingerprint(self, s: Signals, joint: int, fixed: Mapping[str, float]) -> Fingerprint:
        assert s.fine_base is not None
        torques = []
        for ahead in (1, -1):
            at = (np.arange(len(s.fine_time)) + ahead).clip(0, len(s.fine_time) - 1)
            torques.append(replace(s, base=s.fine_base[at].moved(s.project)).inverse())
        return Fingerprint(-((torques[0] - torques[1]) / (2 * s.fine_step))[:, :, None], fixed)

    def apply(self, plant: Plant, joint: int, values: Array) -> None:
        plant.base_offset += values[:, 0]

    def sentence(self, joint: str, values: Mapping[str, float], parameters: tuple[Parameter, ...]) -> str:
        return f"The base is stamped {1e3 * values['offset']:+.3g} ms late against the joints."


class ClockShift(Effect):
    """The positions are stamped a fraction of a sample late or early against the commands.

    Parameters: ``offset`` [s] by which positions are stamped late; all joints alike.

    Fingerprint: the derivative of the command's torque.

    Simulation: the command moved by the offset.
    """

    name = "clock_shift"
    family = "sensing"
    tolerance = 1.0  # 1 ms
    half_a_sample = True
    whole_robot = True
    shows_in = "acceleration"
    equation = "τ(t) = u(t - o)"
    excludes = frozenset({"clock_offset"})
    source = "Gautier, Janot, Vandanjon 2013, doi:10.1109/TCST.2012.2185697"

    def parameters(self, model: mujoco.MjModel, address: JointAddress, joint: int) -> tuple[Parameter, ...]:
        return (Parameter("offset", "s", 0.0, -0.05, 0.05, 0.001),)

    def grid(self, s: Signals, joint: int) -> list[Mapping[str, float]]:
        return [{}]

    def fingerprint(self, s: Signals, joint: int, fixed: Mapping[str, float]) -> Fingerprint:
        step = 0.25 / s.recording.rate
        late, early = (s.torque_of(s.project_command(s.raw_command(sign * step))) for sign in (1, -1))
        return Fingerprint(((late - early) / (2 * step))[:, :, None], fixed)

    def apply(self, plant: Plant, joint: int, values: Array) -> None:
        plant.clock_offset += values[:, 0]

    def sentence(self, joint: str, values: Mapping[str, float], parameters: tuple[Parameter, ...]) -> str:
        return f"Positions are stamped {1e3 * values['offset']:+.3g} ms late against the commands."
