"""The Unitree Z1 arm bolted to a table."""

from __future__ import annotations

from dataclasses import dataclass

import mujoco

from torchrl_athletic.robots.arm import ARM_JOINTS, ARM_SENSORS, add_arm, add_motors
from torchrl_athletic.robots.robot import Robot, assemble
from torchrl_athletic.robots.scene import Cone, add_keyframe, empty_scene
from torchrl_athletic.robots.tools import Tool, add_tool, tool_bodies, tool_sensors


def z1(*, reinforced: bool = False, tool: Tool | None = None, cone: Cone = "elliptic") -> Robot:
    """The Z1 arm: 6 joints (group ``"arm"``) and a gripper that opens towards -1.57 rad (group ``"gripper"``).

    It weighs 5.221 kg and reaches 0.74 m from the shoulder to the flange. Figures and their sources stand in
    :mod:`torchrl_athletic.robots.arm`. The keyframe is called ``"default"``.

    Args:
        reinforced: Whether links 2 to 5 carry the paper's kind of reinforcement.
        tool: A :class:`~torchrl_athletic.robots.tools.Bucket` with a ball, a
            :class:`~torchrl_athletic.robots.tools.Dumbbell`, or a :class:`~torchrl_athletic.robots.tools.Handle` for a
            rope, in the gripper.
        cone: Of friction, see :func:`~torchrl_athletic.robots.scene.empty_scene`.

    Example:
        >>> robot = z1()
        >>> robot.model().nu, robot.joint_groups["arm"]
        (7, (0, 1, 2, 3, 4, 5))
    """
    return assemble(
        "z1",
        ARM_JOINTS,
        _Blueprint(reinforced, tool, cone),
        {**ARM_SENSORS, **tool_sensors(tool)},
        base=None,
        keyframe="default",
        loads=tool_bodies(tool),
    )


@dataclass(frozen=True)
class _Blueprint:
    reinforced: bool
    tool: Tool | None
    cone: Cone

    def __call__(self) -> mujoco.MjSpec:
        spec = empty_scene("z1", self.cone)
        add_arm(spec, spec.worldbody, (0.0, 0.0, 0.0), reinforced=self.reinforced)
        add_motors(spec, ARM_JOINTS)
        pose = [joint.default for joint in ARM_JOINTS]
        add_tool(spec, self.tool, pose)
        add_keyframe(spec, "default", pose)
        return spec
