"""Four small models, each with something that a batch could get wrong, and the serial loop that it must equal."""

from collections.abc import Sequence

import mujoco
import numpy as np

PENDULUM = """
<mujoco><option timestep="0.001" integrator="RK4"/><worldbody>
  <body><joint name="hinge" axis="0 1 0"/><inertial pos="0 0 -0.5" mass="2" diaginertia="0.1 0.1 0.1"/></body>
</worldbody></mujoco>"""

SLIDER = """
<mujoco><option timestep="0.01"/><worldbody>
  <body name="carriage"><joint name="rail" type="slide" axis="1 0 0"/><geom size="0.1" mass="4"/></body>
</worldbody></mujoco>"""

ARM = """
<mujoco><compiler angle="radian"/><option timestep="0.002" integrator="implicitfast"/>
<default><geom contype="0" conaffinity="0"/></default>
<worldbody>
  <body name="upper"><joint name="shoulder" axis="0 1 0" damping="0.1" frictionloss="0.2" armature="0.01"/>
    <geom type="capsule" fromto="0 0 0 0 0 -0.3" size="0.03" mass="1"/>
    <body name="lower" pos="0 0 -0.3"><joint name="elbow" axis="0 1 0" range="-2 2"/>
      <geom type="capsule" fromto="0 0 0 0 0 -0.3" size="0.03" mass="0.5"/></body></body>
</worldbody>
<actuator><motor joint="elbow"/><motor joint="shoulder"/></actuator></mujoco>"""

HOPPER = """
<mujoco><option timestep="0.005" integrator="implicitfast" cone="elliptic"/><worldbody>
  <geom type="plane" size="5 5 0.1"/>
  <body name="base" pos="0 0 0.38"><freejoint name="float"/><geom type="box" size="0.2 0.1 0.05" mass="5"/>
    <site name="imu"/>
    <body name="thigh" pos="0.1 0 0"><joint name="hip" axis="0 1 0" damping="0.5"/>
      <geom type="capsule" fromto="0 0 0 0 0 -0.15" size="0.03" mass="1"/>
      <body name="foot" pos="0 0 -0.2"><joint name="knee" axis="0 1 0" damping="0.5"/>
        <inertial pos="0 0 0" mass="0.5" diaginertia="0.01 0.01 0.01"/><geom size="0.08"/></body></body></body>
</worldbody>
<actuator><motor joint="hip" gear="10"/><motor joint="knee" gear="10"/></actuator>
<sensor><accelerometer site="imu"/><gyro site="imu"/><jointpos joint="knee"/></sensor>
<keyframe><key name="crouch" qpos="0 0 0.3 1 0 0 0 0.4 -0.8" qvel="0.1 0 0 0 0 0 0 0"/></keyframe></mujoco>"""

MODELS = {"pendulum": PENDULUM, "slider": SLIDER, "arm": ARM, "hopper": HOPPER}


def compiled(name: str) -> mujoco.MjModel:
    return mujoco.MjModel.from_xml_string(MODELS[name])


class Loop:
    """One ``MjModel`` and ``MjData`` an env, stepped in turn by Python: what a batch must equal to the last bit."""

    def __init__(self, models: Sequence[mujoco.MjModel]):
        self.models = models
        self.data = [mujoco.MjData(model) for model in models]

    def write(self, field: str, rows: np.ndarray) -> None:
        for data, row in zip(self.data, rows, strict=True):
            getattr(data, field)[:] = row

    def read(self, field: str) -> np.ndarray:
        return np.stack([getattr(data, field) for data in self.data])

    def step(self) -> None:
        for model, data in zip(self.models, self.data, strict=True):
            mujoco.mj_step(model, data)
