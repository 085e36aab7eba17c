"""A PD law around the default pose, as the plainest controller there is."""

import mujoco
import numpy as np
from numpy.typing import NDArray

from torchrl_athletic.robots import Robot


class Plant:
    """A robot's model at its keyframe, with its joints by name."""

    def __init__(self, robot: Robot, model: mujoco.MjModel | None = None) -> None:
        self.robot, self.model = robot, model or robot.model()
        self.data = mujoco.MjData(self.model)
        mujoco.mj_resetDataKeyframe(self.model, self.data, self.model.key(robot.keyframe).id)
        joints = [self.model.joint(name) for name in robot.joint_names]
        self.qpos = np.array([joint.qposadr[0] for joint in joints])
        self.dof = np.array([joint.dofadr[0] for joint in joints])
        mujoco.mj_forward(self.model, self.data)

    def hold(self, seconds: float, target: NDArray[np.float64] | None = None) -> None:
        """Pull every joint to its target, the default pose unless told otherwise."""
        target = np.array(self.robot.default_pose) if target is None else target
        kp, kd = np.array(self.robot.kp), np.array(self.robot.kd)
        for _ in range(round(seconds / self.model.opt.timestep)):
            error = target - self.data.qpos[self.qpos]
            self.data.ctrl[:] = kp * error - kd * self.data.qvel[self.dof]
            mujoco.mj_step(self.model, self.data)

    def sensed(self, key: str) -> NDArray[np.float64]:
        """An observation as the robot's table of sensors defines it, of the present state."""
        mujoco.mj_forward(self.model, self.data)
        return np.array([self.data.sensor(name).data for name in self.robot.sensors[key]]).squeeze()
