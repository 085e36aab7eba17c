"""A two-link arm in the vertical plane, and what it records when it has an effect that its model lacks."""

from __future__ import annotations

from dataclasses import replace

import mujoco
import numpy as np
from numpy.typing import ArrayLike, NDArray

from torchrl_athletic.diagnosis.replay import simulate, take_of, windows_of
from torchrl_athletic.effects import Effect, JointAddress, Plant
from torchrl_athletic.recordings import Recording

Array = NDArray[np.float64]

ARM = """
<mujoco><compiler angle="radian"/><option timestep="0.001"/><worldbody>
  <body name="upper"><joint name="shoulder" axis="0 1 0" armature="0.02" damping="0.4" actuatorfrcrange="-40 40"/>
    <inertial pos="0.01 0 -0.2" mass="1.5" diaginertia="0.02 0.02 0.002"/>
    <body name="lower" pos="0 0 -0.4">
      <joint name="elbow" axis="0 1 0" armature="0.005" damping="0.08" actuatorfrcrange="-15 15"/>
      <inertial pos="0 0.005 -0.15" mass="0.8" diaginertia="0.008 0.007 0.002"/></body></body>
</worldbody></mujoco>"""
JOINTS = ("shoulder", "elbow")
KP, KD = np.array([30.0, 10.0]), np.array([1.5, 0.4])
RATE = 250.0


def arm() -> mujoco.MjModel:
    return mujoco.MjModel.from_xml_string(ARM)


def address() -> JointAddress:
    return JointAddress.of(arm(), JOINTS)


def waves(time: Array, amplitude: ArrayLike, seed: int = 0) -> Array:
    """Five sines from 0.2 to 1.5 Hz a joint, that start from zero. Shape (T, J)."""
    amplitude = np.asarray(amplitude)
    rng = np.random.default_rng(seed)
    frequency = np.linspace(0.2, 1.5, 5)[:, None] * rng.uniform(0.9, 1.1, (5, len(amplitude)))
    return amplitude / 2 * np.sin(2 * np.pi * frequency * time[:, None, None]).sum(1)


def record(
    effect: Effect | None = None,
    joint: int = 0,
    values: ArrayLike = (),
    position_control: bool = False,
    seconds: float = 8.0,
    seed: int = 0,
    model: mujoco.MjModel | None = None,
) -> Recording:
    """Simulate the arm from rest with one effect in it, without noise."""
    time = np.arange(0.0, seconds, 1 / RATE)
    still = np.zeros((len(time), 2))
    if position_control:
        told = Recording(time, JOINTS, still, position_target=waves(time, (0.5, 0.5), seed), kp=KP, kd=KD)
    else:
        told = Recording(time, JOINTS, still, torque_command=waves(time, (2.5, 0.9), seed))

    def build(plant: Plant, rows: Array) -> None:
        if effect is not None:
            effect.apply(plant, joint, rows)

    take = take_of(told, arm() if model is None else model, np.zeros(2))
    (moved,) = simulate(windows_of(take, None), build, np.atleast_2d(np.asarray(values, dtype=float)))
    return replace(told, position=np.concatenate([still[:1], moved[0]]))
