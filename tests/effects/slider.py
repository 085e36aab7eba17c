"""A mass on a rail, pushed: every effect on it has a closed form."""

from __future__ import annotations

import mujoco
import numpy as np
from numpy.typing import ArrayLike, NDArray

from torchrl_athletic.diagnosis.replay import simulate, take_of, windows_of
from torchrl_athletic.effects import Effect, Plant
from torchrl_athletic.recordings import Recording

Array = NDArray[np.float64]

MASS, STEP = 2.0, 1e-3
SLIDER = f"""
<mujoco><option timestep="{STEP}"/><worldbody><body><joint name="rail" type="slide" axis="1 0 0" LIMIT/>
  <inertial pos="0 0 0" mass="{MASS}" diaginertia="0.01 0.01 0.01"/></body></worldbody></mujoco>"""


def slider(limit: float | None = None) -> mujoco.MjModel:
    """``limit`` of the motor [N]."""
    attribute = "" if limit is None else f'actuatorfrcrange="{-limit} {limit}"'
    return mujoco.MjModel.from_xml_string(SLIDER.replace("LIMIT", attribute))


def push(
    force: Array,
    *effects: tuple[Effect, ArrayLike],
    limit: float | None = None,
    servo: tuple[float, float] | None = None,
) -> Array:
    """Readings from rest, one a step. ``force`` is a target [m] under the gains of a ``servo``. (T,) to (rows, T)."""
    time, told = STEP * np.arange(len(force) + 1), np.append(force, force[-1])[:, None]
    still = np.zeros_like(told)
    if servo is None:
        recording = Recording(time, ("rail",), still, torque_command=told)
    else:
        kp, kd = np.array(servo)[:, None]
        recording = Recording(time, ("rail",), still, position_target=told, kp=kp, kd=kd)
    rows = [np.atleast_2d(np.asarray(values, dtype=float)) for _, values in effects]

    def build(plant: Plant, values: Array) -> None:
        at = 0
        for (effect, _), own in zip(effects, rows, strict=True):
            effect.apply(plant, 0, values[:, at : at + own.shape[1]])
            at += own.shape[1]

    values = np.concatenate(rows, axis=1) if rows else np.zeros((1, 0))
    moved = simulate(windows_of(take_of(recording, slider(limit), np.zeros(1)), None), build, values)
    return stepped(moved[:, 0, :, 0])


def stepped(reading: Array) -> Array:
    """Positions of MuJoCo's semi-implicit steps, of which a reading from rest is the mean of two. (..., T)."""
    position = np.zeros_like(reading)
    last = np.zeros_like(reading[..., 0])
    for k in range(reading.shape[-1]):
        last = 2 * reading[..., k] - last
        position[..., k] = last
    return position


def speed(position: Array) -> Array:
    """Mean speed over each step. (..., T) to (..., T - 1)."""
    return np.diff(position, axis=-1) / STEP
