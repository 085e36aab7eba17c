"""Small models, and recordings of them made by a plain ``mj_step`` loop."""

from __future__ import annotations

import mujoco
import numpy as np

from torchrl_athletic.diagnosis.replay import Take, take_of
from torchrl_athletic.diagnosis.screen import Candidate
from torchrl_athletic.effects import Effect, JointAddress
from torchrl_athletic.recordings import Recording

STEP = 0.002
RATE = 100.0
NOISE = 1e-5


def slider(step: float = STEP, joint: str = "") -> str:
    """2 kg on a rail."""
    return f"""
<mujoco model="slider"><option timestep="{step}" integrator="implicitfast"/>
  <worldbody><body name="carriage"><joint name="carriage" type="slide" axis="1 0 0" {joint}/>
    <inertial pos="0 0 0" mass="2" diaginertia="0.01 0.01 0.01"/></body></worldbody>
  <actuator><motor joint="carriage"/></actuator>
</mujoco>"""


def pendulum(step: float = STEP, joint: str = 'damping="0.05"', name: str = "pendulum") -> str:
    """0.5 kg at 0.4 m, 0 when hanging; inertia about the pivot 0.09 kg·m²."""
    return f"""
<mujoco model="pendulum"><option timestep="{step}" integrator="implicitfast"/>
  <worldbody><body name="link"><joint name="{name}" axis="0 -1 0" {joint}/>
    <inertial pos="0 0 -0.4" mass="0.5" diaginertia="0.01 0.01 0.01"/></body></worldbody>
  <actuator><motor joint="{name}"/></actuator>
</mujoco>"""


def double_pendulum(step: float = STEP) -> str:
    """Two equal links without friction, chaotic at large amplitudes."""
    return f"""
<mujoco model="double"><option timestep="{step}" integrator="implicitfast"/>
  <worldbody><body name="upper"><joint name="upper" axis="0 -1 0"/>
    <inertial pos="0 0 -0.3" mass="0.5" diaginertia="0.001 0.001 0.001"/>
    <body name="lower" pos="0 0 -0.3"><joint name="lower" axis="0 -1 0"/>
      <inertial pos="0 0 -0.3" mass="0.5" diaginertia="0.001 0.001 0.001"/></body></body></worldbody>
</mujoco>"""


def smooth_torque(seconds: float, amplitude: float = 0.8, seed: int = 0, rate: float = RATE) -> np.ndarray:
    """Sum of three sines. Shape (T, 1)."""
    time = np.arange(round(seconds * rate)) / rate
    rng = np.random.default_rng(seed)
    waves = [np.sin(2 * np.pi * (f * time + rng.random())) for f in (0.4, 0.9, 1.7)]
    return amplitude * np.mean(waves, axis=0)[:, None]


def record(
    xml: str, command: np.ndarray, start=0.0, noise: float = NOISE, seed: int = 0, rate: float = RATE, **pd: np.ndarray
) -> Recording:
    """Hold each torque (or target, with ``kp`` and ``kd``) for one sample and read the position before it acts."""
    model = mujoco.MjModel.from_xml_string(xml)
    data = mujoco.MjData(model)
    data.qpos[:] = start
    position = []
    for u in command:
        position.append(data.qpos.copy())
        for _ in range(round(1 / rate / model.opt.timestep)):
            data.qfrc_applied[:] = pd["kp"] * (u - data.qpos) - pd["kd"] * data.qvel if pd else u
            mujoco.mj_step(model, data)
    read = np.array(position) + noise * np.random.default_rng(seed).standard_normal(np.shape(position))
    names = tuple(model.joint(i).name for i in range(model.njnt))
    field = "position_target" if pd else "torque_command"
    return Recording(np.arange(len(command)) / rate, names, read, **{field: command}, **pd, source=f"take_{seed}")


def take(xml: str, recording: Recording, noise: float = NOISE, period: float | None = None) -> Take:
    """The recording on the simulation's grid."""
    model = mujoco.MjModel.from_xml_string(xml)
    return take_of(recording, model, np.full(recording.num_joints, noise), period=period)


def candidate(effect: Effect, recording: Recording, xml: str, joint: int = 0) -> Candidate:
    """An effect on a joint of the model."""
    model = mujoco.MjModel.from_xml_string(xml)
    address = JointAddress.of(model, recording.joint_names)
    return Candidate(effect, joint, recording.joint_names[joint], effect.parameters(model, address, joint))


def behind_a_spring(
    stiffness: float, link: float, rotor: float, rng: np.random.Generator
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Six seconds of a motor whose link swings behind the encoder: time, torque and what is read. Shape (T,) each."""
    rate, fine = 200.0, 50
    time = np.arange(int(6 * rate)) / rate
    tones = ((0.7, 1.3, 2.1, 3.4, 5.1, 6.3, 7.2), rng.uniform(0, 6, 7))
    command = sum(0.6 * (0.3 + f / 7) * np.sin(2 * np.pi * f * time + p) for f, p in zip(*tones, strict=True))
    motor = speed = body = its_speed = 0.0
    read, step = [], 1 / rate / fine
    for k, u in enumerate(np.repeat(command, fine)):
        if k % fine == 0:
            read.append(motor)
        spring = stiffness * (motor - body)
        speed, its_speed = speed + step * (u - spring) / rotor, its_speed + step * spring / link
        motor, body = motor + step * speed, body + step * its_speed
    return time, np.asarray(command), np.array(read)
