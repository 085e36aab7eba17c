"""Time that passes between a command and the torque: pure delay, and the lag of the torque loop."""

from __future__ import annotations

from collections.abc import Mapping
from typing import ClassVar

import mujoco
import numpy as np
from scipy.signal import lfilter

from torchrl_athletic.effects.effect import Array, Effect, Fingerprint, Parameter
from torchrl_athletic.effects.plant import Plant
from torchrl_athletic.effects.signals import JointAddress, Signals

_TIMES = (0.001, 0.002, 0.003, 0.005, 0.007, 0.010, 0.014, 0.020, 0.028, 0.040, 0.060)


class ActuationDelay(Effect):
    """The command acts late by a fixed time.

    Parameters: ``delay`` [s] between the stamp of a command and its action. A shift of the log's clock against the
    encoder looks the same.

    Fingerprint: u(t - T) - u(t), at delays T from 1 to 60 ms and of half a sample to three, refined by halving.

    Simulation: the recorded command, averaged over each physics step, T late.
    """

    name = "actuation_delay"
    family = "timing"
    own_joint = True
    tolerance = 0.2  # 1 ms
    between_torques = True
    before_sensor = True
    mjcf = "actuator"
    shows_in = "acceleration"
    equation = "τ(t) = u(t - T)"
    source = "Hwangbo et al. 2019, doi:10.1126/scirobotics.aau5872, supplement S2"
    excludes = frozenset({"actuation_lag"})
    experiments: ClassVar[Mapping[str, str]] = {
        "actuation_lag": "command {joint} with steps and with a chirp above 10 Hz: after a delay the full step "
        "arrives, after a lag it creeps in",
        "reflected_inertia": "chirp {joint} from 0.5 Hz to 20 Hz: a delay shifts the phase in proportion to frequency",
        "viscous_friction": "turn {joint} at constant speed: friction remains, a delay does not show",
    }

    def parameters(self, model: mujoco.MjModel, address: JointAddress, joint: int) -> tuple[Parameter, ...]:
        return (Parameter("delay", "s", 0.0, 0.0, 0.2, 0.005),)

    def grid(self, s: Signals, joint: int) -> list[Mapping[str, float]]:
        return [{"delay": time} for time in _times(s)]

    def fingerprint(self, s: Signals, joint: int, fixed: Mapping[str, float]) -> Fingerprint:
        late = s.torque_of(s.project_command(s.raw_command(fixed["delay"])))
        now = s.torque_of(s.project_command(s.raw_command()))
        return _constant(late - now, s, joint, fixed)

    def apply(self, plant: Plant, joint: int, values: Array) -> None:
        plant.delay[:, joint] = values[:, 0]

    def sentence(self, joint: str, values: Mapping[str, float], parameters: tuple[Parameter, ...]) -> str:
        return f"Commands to {joint} act {1e3 * values['delay']:.3g} ms late; the model acts at once."


class ActuationLag(Effect):
    """The torque follows its command through a first-order low-pass, as a current loop does.

    Parameters: ``time_constant`` [s].

    Fingerprint: the command's torque behind the low-pass less the torque itself, at time constants from 1 to 60 ms and
    of half a sample to three, refined by halving.

    Simulation: the exact low-pass at the physics step; a window starts with what earlier commands left in it.
    """

    name = "actuation_lag"
    family = "timing"
    own_joint = True
    tolerance = 0.2  # 1 ms
    between_torques = True
    before_sensor = True
    mjcf = "actuator"
    shows_in = "acceleration"
    equation = "T dτ/dt = u - τ"
    source = "Gautier, Janot, Vandanjon 2013, doi:10.1109/TCST.2012.2185697"
    excludes = frozenset({"actuation_delay"})
    experiments: ClassVar[Mapping[str, str]] = {
        "actuation_delay": "command {joint} with steps and with a chirp above 10 Hz",
        "reflected_inertia": "chirp {joint} from 0.5 Hz to 20 Hz, and log the motor current",
    }

    def parameters(self, model: mujoco.MjModel, address: JointAddress, joint: int) -> tuple[Parameter, ...]:
        return (Parameter("time_constant", "s", 0.0, 0.0, 0.3, 0.005),)

    def grid(self, s: Signals, joint: int) -> list[Mapping[str, float]]:
        return [{"time_constant": time} for time in _times(s)]

    def fingerprint(self, s: Signals, joint: int, fixed: Mapping[str, float]) -> Fingerprint:
        torque = s.raw_command()
        if s.recording.position_target is not None:
            assert s.recording.kp is not None
            assert s.recording.kd is not None
            torque = s.recording.kp * (torque - s.fine_position) - s.recording.kd * s.fine_velocity
        lagged = low_pass(torque, fixed["time_constant"], s.fine_step)
        return _constant(s.project_command(lagged - torque), s, joint, fixed)

    def apply(self, plant: Plant, joint: int, values: Array) -> None:
        plant.lag[:, joint] = values[:, 0]

    def sentence(self, joint: str, values: Mapping[str, float], parameters: tuple[Parameter, ...]) -> str:
        return (
            f"The torque of {joint} follows its command with a lag of {1e3 * values['time_constant']:.3g} ms "
            "(first order); the model's follows at once."
        )


def low_pass(u: Array, time_constant: float, step: float) -> Array:
    """First-order low-pass of samples that hold for ``step`` seconds, exact, averaged over each step. Shape (M, J)."""
    if time_constant < 1e-6:
        return u
    keep = np.exp(-step / time_constant)
    # the state relaxes towards u within the step; its mean over the step is u + (start - u) * mean decay
    mean_decay = (1 - keep) * time_constant / step
    start = np.vstack([u[:1], lfilter([1 - keep], [1, -keep], u, axis=0, zi=keep * u[:1])[0][:-1]])
    return u + (start - u) * mean_decay


def _times(s: Signals) -> list[float]:
    period = 1.0 / s.recording.rate
    return sorted({*_TIMES, *(n * period for n in (0.5, 1.0, 1.5, 2.0, 3.0) if n * period < 0.2)})


def _constant(torque: Array, s: Signals, joint: int, fixed: Mapping[str, float]) -> Fingerprint:
    out = np.zeros_like(torque)
    out[:, joint] = torque[:, joint]
    return Fingerprint(np.zeros((*torque.shape, 0)), fixed, out)
