"""A robot of two legs whose trunk hangs in springs, so that its legs swing it, and what it records.

The forces of the springs are never recorded. The whole robot is integrated here, as the free body that it is, by the
classical Runge-Kutta method; the diagnosis prescribes the trunk and solves for the legs alone.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import mujoco
import numpy as np
from numpy.typing import NDArray
from scipy.interpolate import CubicSpline

from torchrl_athletic.recordings import Recording

Array = NDArray[np.float64]
LEG = """
  <body name="{side}_thigh" pos="0.05 {y} -0.03">
    <joint name="{side}_hip" axis="0 1 0" armature="{armature}" damping="0.05"/>
    <inertial pos="0.01 0.02 -0.1" mass="0.9" diaginertia="0.006 0.006 0.001"/>
    <body name="{side}_shank" pos="0 0 -0.2">
      <joint name="{side}_knee" axis="0 1 0" armature="0.004" damping="0.03"/>
      <inertial pos="0 0.005 -0.08" mass="0.35" diaginertia="0.0012 0.0012 0.0002"/></body></body>"""
MODEL = """
<mujoco><compiler angle="radian"/><option timestep="0.002"/><worldbody>
  <geom name="floor" type="plane" size="5 5 .1"/>
  <body name="trunk" pos="0 0 0.3"><freejoint name="root"/>
    <inertial pos="0.02 0 0.01" mass="3" diaginertia="0.02 0.03 0.04"/>
    <geom type="box" size=".1 .08 .04"/>{legs}</body>
</worldbody></mujoco>"""
JOINTS = ("left_hip", "left_knee", "right_hip", "right_knee")
KP, KD = np.array([25.0, 12.0, 25.0, 12.0]), np.array([0.8, 0.3, 0.8, 0.3])
RATE, STEP = 200.0, 0.001
SPRINGS, DAMPERS = np.array([80.0, 80.0, 400.0, 8.0, 8.0, 8.0]), np.array([5.0, 5.0, 10.0, 0.3, 0.3, 0.3])
"""Stiffness and damping that hold the trunk's position [N/m, N·s/m] and attitude [N·m/rad, N·m·s/rad]."""
POSITION_NOISE, BASE_NOISE = 1e-4, (1e-4, 2e-4)
"""Noise of encoders [rad], and of the trunk's position [m] and attitude [rad], as a motion capture has it."""


def model(armature: float = 0.01) -> str:
    """MJCF. ``armature``: of the right hip [kg·m²]; the left one has 0.01."""
    legs = [("left", 0.1, 0.01), ("right", -0.1, armature)]
    return MODEL.format(legs="".join(LEG.format(side=s, y=y, armature=a) for s, y, a in legs))


def record(
    seconds: float = 12.0,
    armature: float = 0.01,
    friction: float = 0.0,
    held: bool = False,
    seed: int = 0,
    noise: float = 1.0,
) -> Recording:
    """A take under position control.

    Args:
        seconds: Of the take.
        armature: Of the right hip [kg·m²].
        friction: Dry, of the left knee [N·m].
        held: Whether the trunk is clamped; its pose is then not recorded.
        seed: Of the motion and the noise.
        noise: Times what the sensors have.
    """
    xml = model(armature)
    given = mujoco.MjModel.from_xml_string(xml.replace('<freejoint name="root"/>', "") if held else xml)
    given.opt.disableflags |= int(mujoco.mjtDisableBit.mjDSBL_CONTACT)
    data = mujoco.MjData(given)
    time = np.arange(0.0, seconds, 1 / RATE)
    target, read = _waves(time, seed), np.empty((len(time), given.nq))

    def acceleration(q: Array, v: Array, wanted: Array) -> Array:
        data.qpos[:], data.qvel[:] = q, v
        torque = KP * (wanted - q[-4:]) - KD * v[-4:]
        torque[1] -= friction * np.tanh(v[-3] / 0.02)
        data.qfrc_applied[-4:] = torque
        if not held:
            data.qfrc_applied[:6] = _springs(given, q, v)
        mujoco.mj_forward(given, data)
        return data.qacc.copy()

    q, v = given.qpos0.copy(), np.zeros(given.nv)
    for k in range(len(time)):
        read[k] = q
        for _ in range(round(1 / RATE / STEP)):
            q, v = _step(given, q, v, lambda *state, wanted=target[k]: acceleration(*state, wanted))
    rng = np.random.default_rng(seed)
    position = read[:, -4:] + rng.normal(0, noise * POSITION_NOISE, (len(time), 4))
    take = Recording(time, JOINTS, position, position_target=target, kp=KP, kd=KD, source=f"hung-{seed}")
    if held:
        return take
    place = read[:, :3] + rng.normal(0, noise * BASE_NOISE[0], (len(time), 3))
    attitude = read[:, 3:7] + rng.normal(0, noise * BASE_NOISE[1] / 2, (len(time), 4))
    unit = attitude / np.linalg.norm(attitude, axis=1, keepdims=True)
    return replace(take, base_position=place, base_orientation=unit)


def late(recording: Recording, by: float) -> Recording:
    """A copy whose poses of the trunk are stamped late [s]."""
    pose = np.hstack([recording.base_position, recording.base_orientation])
    there = CubicSpline(recording.time, pose)(np.maximum(recording.time - by, recording.time[0]))
    turn = there[:, 3:] / np.linalg.norm(there[:, 3:], axis=1, keepdims=True)
    return replace(recording, base_position=there[:, :3], base_orientation=turn)


def _springs(given: mujoco.MjModel, q: Array, v: Array) -> Array:
    """What holds the trunk: its weight, springs to where it hangs, and little damping. Shape (6,)."""
    turned = np.empty(3)
    mujoco.mju_quat2Vel(turned, q[3:7], 1.0)
    force = -SPRINGS * np.concatenate([q[:3] - given.qpos0[:3], turned]) - DAMPERS * v[:6]
    force[2] += 9.81 * given.body_subtreemass[1]
    return force


def _step(
    given: mujoco.MjModel, q: Array, v: Array, acceleration: Callable[[Array, Array], Array]
) -> tuple[Array, Array]:
    """One step of the classical Runge-Kutta method."""

    def moved(rate: Array, by: float) -> Array:
        out = q.copy()
        mujoco.mj_integratePos(given, out, rate, by)
        return out

    a1 = acceleration(q, v)
    v2 = v + STEP / 2 * a1
    a2 = acceleration(moved(v, STEP / 2), v2)
    v3 = v + STEP / 2 * a2
    a3 = acceleration(moved(v2, STEP / 2), v3)
    v4 = v + STEP * a3
    a4 = acceleration(moved(v3, STEP), v4)
    mean = (v + 2 * v2 + 2 * v3 + v4) / 6
    return moved(mean, STEP), v + STEP / 6 * (a1 + 2 * a2 + 2 * a3 + a4)


def _waves(time: Array, seed: int) -> Array:
    """Five sines from 0.3 to 2.5 Hz a joint, that start from zero. Shape (T, 4)."""
    rng = np.random.default_rng(seed)
    frequency = np.linspace(0.3, 2.5, 5)[:, None] * rng.uniform(0.85, 1.15, (5, 4))
    return 0.35 * np.sin(2 * np.pi * frequency * time[:, None, None]).sum(1) * [0.6, 1.0, 0.6, 1.0]
