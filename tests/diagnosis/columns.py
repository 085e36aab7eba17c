"""Missing torque and effects made up of given columns, so that a search has a known answer."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import mujoco
import numpy as np
from numpy.typing import ArrayLike, NDArray

from torchrl_athletic.diagnosis.screen import KERNEL_CORRELATION, Bank, Candidate
from torchrl_athletic.diagnosis.search import Judge
from torchrl_athletic.effects import Effect, Fingerprint, JointAddress, Parameter, Plant, Signals
from torchrl_athletic.effects.signals import smooth_dynamics
from torchrl_athletic.recordings import Recording

Array = NDArray[np.float64]

STEP = 0.01
NAMES = ("shoulder", "elbow")
ARM = """
<mujoco><worldbody><body><joint name="shoulder" axis="0 1 0"/><geom size="0.1" pos="0 0 -0.2"/>
  <body pos="0 0 -0.4"><joint name="elbow" axis="0 1 0"/><geom size="0.1" pos="0 0 -0.2"/></body></body></worldbody>
</mujoco>"""


def signals(missing: ArrayLike, valid: ArrayLike | None = None, **given: Array) -> Signals:
    """An arm with a missing torque of (N, 2), every row of which counts as independent. Signals not ``given`` are 0."""
    missing = np.asarray(missing, dtype=float)
    model, zero = mujoco.MjModel.from_xml_string(ARM), np.zeros_like(missing)
    time = STEP * np.arange(len(missing))
    names = ("position", "velocity", "acceleration", "command", "required", "bias")
    motion = dict.fromkeys(names, zero) | given
    return Signals(
        recording=Recording(time, NAMES, motion["position"], torque_command=motion["command"]),
        model=smooth_dynamics(model),
        nominal=model,
        address=JointAddress.of(model, NAMES),
        kernel=STEP / KERNEL_CORRELATION,
        fine_step=STEP,
        fine_time=time,
        keep=np.arange(len(missing)),
        missing=missing,
        noise=np.ones(2),
        valid=np.ones(missing.shape, dtype=bool) if valid is None else np.asarray(valid),
        fine_position=motion["position"],
        fine_velocity=motion["velocity"],
        **motion,
    )


class Given(Effect):
    """Predicts the given columns, one a parameter ``p0``, ``p1``, ...: of its joint, (N, K), or of both, (N, 2, K)."""

    equation = source = "given"

    def __init__(
        self,
        name: str,
        columns: Array,
        lower: float = -10.0,
        upper: float = 10.0,
        nominal: float = 0.0,
        excludes: Sequence[str] = (),
    ) -> None:
        self.name, self.columns, self.bounds, self.excludes = (
            name,
            columns,
            (nominal, lower, upper),
            frozenset(excludes),
        )  # type: ignore[misc]
        if columns.ndim == 1:
            self.columns = columns[:, None]

    def parameters(self, model: mujoco.MjModel, address: JointAddress, joint: int) -> tuple[Parameter, ...]:
        return tuple(Parameter(f"p{k}", "N·m", *self.bounds, 1.0) for k in range(self.columns.shape[-1]))

    def grid(self, s: Signals, joint: int) -> list[Mapping[str, float]]:
        return [{}]

    def fingerprint(self, s: Signals, joint: int, fixed: Mapping[str, float]) -> Fingerprint:
        if self.columns.ndim == 3:
            return Fingerprint(self.columns, fixed)
        out = np.zeros((len(s.time), s.num_joints, self.columns.shape[1]))
        out[:, joint] = self.columns
        return Fingerprint(out, fixed)

    def apply(self, plant: Plant, joint: int, values: Array) -> None:
        raise NotImplementedError

    def sentence(self, joint: str, values: Mapping[str, float], parameters: tuple[Parameter, ...]) -> str:
        return self.name


class Shifted(Given):
    """Predicts a sine, late by a parameter that enters nonlinearly; the rest of the sine is already there."""

    def parameters(self, model: mujoco.MjModel, address: JointAddress, joint: int) -> tuple[Parameter, ...]:
        return (Parameter("delay", "s", 0.0, 0.0, 1.0, 0.01),)

    def grid(self, s: Signals, joint: int) -> list[Mapping[str, float]]:
        return [{"delay": delay} for delay in (0.1, 0.2, 0.4)]

    def fingerprint(self, s: Signals, joint: int, fixed: Mapping[str, float]) -> Fingerprint:
        out = np.zeros((len(s.time), s.num_joints))
        out[:, joint] = shifted(s.time, fixed["delay"])
        return Fingerprint(np.zeros((*out.shape, 0)), fixed, out)


class Curved(Given):
    """Grows with its parameter's square beside the parameter."""

    def near(self, parameters: Sequence[Parameter], values: Array) -> Mapping[str, float]:
        return {"near": float(np.round(values[0], 1))}

    def fingerprint(self, s: Signals, joint: int, fixed: Mapping[str, float]) -> Fingerprint:
        linear, square = self.columns.T
        out = np.zeros((len(s.time), s.num_joints, 1))
        out[:, joint, 0] = linear + fixed.get("near", 0.0) * square
        return Fingerprint(out, fixed)


def shifted(time: Array, delay: float) -> Array:
    return 40 * (np.sin(3 * (time - delay)) - np.sin(3 * time))


def candidate(effect: Effect, joint: int = 0) -> Candidate:
    model = mujoco.MjModel.from_xml_string(ARM)
    return Candidate(effect, joint, NAMES[joint], effect.parameters(model, JointAddress.of(model, NAMES), joint))


def judge(take: Signals, *candidates: Candidate) -> Judge:
    """With unit noise and a floor of one."""
    return Judge(Bank([take], candidates, noise=np.ones(2)))
