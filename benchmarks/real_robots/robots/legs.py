"""Robots with legs: Unitree's, held in the air or at a wall, and a compass gait walker's."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import mujoco
import numpy as np
import torch
from scipy.io import loadmat

from benchmarks.real_robots.robots.robot import (
    UNSEEN,
    Robot,
    delete_shapes,
)
from torchrl_athletic.recordings import Recording

_EMPTY: Any = np.zeros(0)
_ARRAYS: Any = [
    *((_EMPTY.__reduce__()[0], f"numpy.{core}.multiarray._reconstruct") for core in ("core", "_core")),
    *(np.ndarray, np.dtype, np.dtypes.Float32DType, np.dtypes.Float64DType),
]
"""What a file of tensors may hold beside them: arrays of NumPy 1 and 2."""


def unitree(data: Path, robot: str) -> Robot:
    """A Go2 held in the air, an Aliengo or a Z1 with its gripper, position targets at 200 Hz, gains as logged.

    One sweep of all joints between two poses, in periods from 3 to 0.4 s. Of the Go2 eight takes are fitted and two are
    kept aside, as the logs' authors do; the others have one take, whose last third, the fastest, is kept aside. The
    models are the maker's: what the authors fitted, friction, damping and rotors, is taken out again.
    """
    home = data / "sim2real-robot-identification"
    spec = mujoco.MjSpec.from_file(str(home / f"robot_model/{robot}/{robot}.xml"))
    delete_shapes(spec)
    for key in spec.keys:
        spec.delete(key)
    for joint in spec.joints:
        if joint.type == mujoco.mjtJoint.mjJNT_FREE:
            spec.delete(joint)
        else:
            joint.frictionloss, joint.damping, joint.armature = 0.0, np.zeros_like(joint.damping), 0.0
    names = tuple(joint.name for joint in spec.joints)

    def take(path: Path) -> Recording:
        with torch.serialization.safe_globals(_ARRAYS):
            content = torch.load(path, weights_only=True)
        logged = {name: np.asarray(column, dtype=np.float64) for name, column in content.items()}
        return Recording(
            logged["time"],
            names,
            logged["dof_pos"],
            velocity=logged["dof_vel"],
            position_target=logged["des_dof_pos"],
            kp=logged["kp"],
            kd=logged["kd"],
            source=f"{robot}/{path.stem}",
        )

    takes = [take(path) for path in sorted((home / f"datasets/{robot}").glob("traj_*.pt"))]
    if len(takes) > 1:
        return Robot(spec.to_xml(), takes[:-2], takes[-2:], "no")
    [whole] = takes
    third = 2 * whole.num_samples // 3
    looked = UNSEEN if robot == "z1" else "no"
    return Robot(spec.to_xml(), [whole.slice(0, third)], [whole.slice(third, whole.num_samples)], looked)


def compass_leg(data: Path) -> Robot:
    """The inner leg of a compass gait walker that swings about its hip, at 200 Hz: 28 s fitted, the last 50 s aside.

    First a free swing and steps of the motor's voltage, last steps and a chirp. The torque is that of the voltage by
    the data sheet, the link that of its authors, without friction.
    """
    xml = """<mujoco><option timestep="0.001" integrator="implicitfast"/><worldbody><body>
      <joint name="hip" axis="0 1 0"/>
      <inertial pos="0 0 -0.0448" mass="0.7" diaginertia="0.002919 0.002919 0.002919"/></body></worldbody>
      <actuator><motor joint="hip" ctrlrange="-0.2 0.2"/></actuator></mujoco>"""
    home = data / "SydneyCompassGait/System Identification/SysID_Experiment 1"
    log = loadmat(home / "realVSmodel_fwAnd5vstepsx3AndChirp_innerSW.mat")
    time, angle, volt = (np.asarray(log[f"data{name}all"], dtype=np.float64).ravel() for name in ("time", "out", "in"))
    torque = 0.0182 * volt  # N m per volt
    whole = Recording(time, ("hip",), np.radians(angle)[:, None], torque_command=torque[:, None], source="compass leg")
    return Robot(xml, [whole.where(time < 28.0)], [whole.where(time >= 28.0)], UNSEEN)
