"""A motion, drawn: its joints over time within their limits, the hand's path, and the robot on its way."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

import mujoco
import numpy as np
import torch
from numpy.typing import NDArray

from torchrl_athletic.robots.motion import Motion
from torchrl_athletic.robots.motion_tables import (
    DT,
    PosedRobot,
    check_names,
    joint_position,
    phase_starts,
    sample_phase,
    unchecked_tables,
)
from torchrl_athletic.robots.robot import Robot

if TYPE_CHECKING:
    from matplotlib.axes import Axes


def draw_motion(motion: Motion, robot: Robot, path: str | Path) -> Path:
    """Draw the arm's joints over time, what their limits forbid in red, and where the end effector goes.

    Dots are key poses, bands are phases. Limits are shown and not checked, so that a motion which
    :func:`~torchrl_athletic.robots.check_motion` refuses can be looked at.

    Args:
        motion: To draw.
        robot: Has a panel for each joint of its group ``"arm"``, or for every joint if there is no such group.
        path: Of the picture, ``.png`` or ``.svg``; its folder is made.

    Returns:
        The path.

    Example:
        >>> from torchrl_athletic.robots import b2z1, read_motion
        >>> draw_motion(read_motion("throw"), b2z1(), "throw.png").name
        'throw.png'
    """
    from matplotlib.figure import Figure

    check_names(motion, robot)
    tables = unchecked_tables(motion, PosedRobot(robot), DT, frame_height=0.0)
    joints = robot.joint_groups.get("arm", tuple(range(len(robot.joint_names))))
    rows = -(-len(joints) // 2) + 1
    figure = Figure(figsize=(9, 1.6 * rows + 0.5), layout="constrained")
    panels = figure.subplots(rows, 2, sharex=True, squeeze=False)
    for axis, joint in zip(panels[:-1].flat, joints, strict=False):
        _draw_curve(axis, motion, [table[:, joint].numpy() for table in tables["joint_position"]], "C0")
        _draw_key_poses(axis, motion, robot, joint)
        _shade_limits(axis, *robot.position_limit[joint])
        axis.set_title(f"{robot.joint_names[joint]} [rad]", fontsize=9)
    titles = {2: "end effector over the ground [m]", 0: "end effector ahead of the base [m]"}
    for axis, (column, title) in zip(panels[-1], titles.items(), strict=True):
        _draw_curve(axis, motion, [table[:, column].numpy() for table in tables["end_effector_command"]], "C2")
        axis.set_title(title, fontsize=9)
        axis.set_xlabel("time [s]", fontsize=8)
    for axis in panels.flat:
        _shade_phases(axis, motion, named=axis in panels[0])
        axis.tick_params(labelsize=8)
    figure.suptitle(f"{motion.name}, {robot.name}", fontsize=10)
    path = Path(path)
    path.parent.mkdir(parents=True, exist_ok=True)
    figure.savefig(path, dpi=110)
    return path


def motion_frames(
    motion: Motion, robot: Robot, count: int = 8, size: tuple[int, int] = (360, 360)
) -> NDArray[np.uint8]:
    """Draw the robot at times evenly spread over the motion, side by side.

    The legs of a robot that shows ``foot_position`` are bent so that its feet stay where they stand.

    Args:
        motion: To draw.
        robot: That makes it.
        count: Of the pictures.
        size: Height and width of each [pixel].

    Returns:
        Image of shape (height, count * width, 3).

    Raises:
        RuntimeError: If MuJoCo cannot draw here.
    """
    check_names(motion, robot)
    posed = PosedRobot(robot)
    rows = torch.cat([sample_phase(phase, posed, DT) for phase in motion.phases])
    feet = _feet(posed)
    try:
        renderer = mujoco.Renderer(posed.model, *size)
    except Exception as error:  # what a missing driver raises differs between drivers
        raise RuntimeError(
            "MuJoCo finds no way to draw here. Set the environment variable MUJOCO_GL to egl or osmesa before the "
            "first import of mujoco."
        ) from error
    with renderer:
        frames = []
        for number in torch.linspace(0, len(rows) - 1, count).round().long():
            posed.place(rows[number])
            _plant(posed, feet)
            renderer.update_scene(posed.data, _camera(posed))
            frames.append(renderer.render())
    return np.concatenate(frames, axis=1)


def _camera(posed: PosedRobot) -> mujoco.MjvCamera:
    """View from the right, so that ahead is to the right."""
    camera = mujoco.MjvCamera()
    camera.lookat[:] = (0.15, 0.0, 0.5 + 0.4 * posed.stand)
    camera.distance, camera.azimuth, camera.elevation = 2.0 + 1.5 * posed.stand, 90.0, -8.0
    return camera


def _feet(posed: PosedRobot) -> dict[int, NDArray[np.float64]]:
    """Where the feet stand in the keyframe [m], by the number of their site."""
    names = posed.robot.sensors.get("foot_position", ()) if posed.robot.base else ()
    sites = [int(posed.model.sensor(name).objid[0]) for name in names]
    return {site: posed.data.site_xpos[site].copy() for site in sites}


def _plant(posed: PosedRobot, feet: dict[int, NDArray[np.float64]], steps: int = 30) -> None:
    """Bend the legs until the feet are there: Gauss-Newton."""
    if not feet:
        return
    model, data = posed.model, posed.data
    joints = [model.joint(posed.robot.joint_names[index]) for index in posed.robot.joint_groups["leg"]]
    qpos, dof = (
        [int(address[0]) for address in column] for column in zip(*((j.qposadr, j.dofadr) for j in joints), strict=True)
    )
    for _ in range(steps):
        mujoco.mj_kinematics(model, data)
        mujoco.mj_comPos(model, data)
        away, jacobian = [], np.zeros((len(feet), 3, model.nv))
        for part, (site, place) in zip(jacobian, feet.items(), strict=True):
            mujoco.mj_jacSite(model, data, part, None, site)
            away.append(place - data.site_xpos[site])
        data.qpos[qpos] += np.linalg.lstsq(jacobian[..., dof].reshape(-1, len(dof)), np.concatenate(away), rcond=None)[
            0
        ]
    mujoco.mj_kinematics(model, data)


def _draw_curve(axis: Axes, motion: Motion, tables: list[NDArray[np.float32]], colour: str) -> None:
    for start, phase, values in zip(phase_starts(motion), motion.phases, tables, strict=True):
        axis.plot(start + np.minimum(np.arange(len(values)) * DT, phase.duration), values, color=colour, lw=1.4)


def _draw_key_poses(axis: Axes, motion: Motion, robot: Robot, joint: int) -> None:
    for start, phase in zip(phase_starts(motion), motion.phases, strict=True):
        positions = [joint_position(pose, robot, joint) for pose in phase.poses]
        axis.plot([start + pose.time for pose in phase.poses], positions, "o", color="C0", ms=3)


def _shade_limits(axis: Axes, low: float, high: float) -> None:
    bottom, top = axis.get_ylim()
    bottom, top = min(bottom, low - 0.3), max(top, high + 0.3)
    axis.axhspan(bottom, low, color="C3", alpha=0.25, lw=0)
    axis.axhspan(high, top, color="C3", alpha=0.25, lw=0)
    axis.set_ylim(bottom, top)


def _shade_phases(axis: Axes, motion: Motion, named: bool) -> None:
    for number, (start, phase) in enumerate(zip(phase_starts(motion), motion.phases, strict=True)):
        end = start + phase.duration
        axis.axvspan(start, end, color="0.90" if number % 2 else "0.97", zorder=0, lw=0)
        if named:
            above = axis.get_xaxis_transform()
            axis.text((start + end) / 2, 0.96, phase.name, transform=above, fontsize=7, ha="center", va="top")
