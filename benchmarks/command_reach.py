"""How much of what a whole-body controller is told can be done at all: inverse kinematics of the commanded hand poses.

    python benchmarks/command_reach.py

For each goal of the command ranges, the arm's six joints, and the base's height, roll and pitch within what a standing
B2 does, are sought that bring the hand's keypoints nearest to those commanded, by least squares from four starts
(``mujoco.minimize``). Nothing collides and nothing moves.
"""

from __future__ import annotations

import math
import subprocess
from dataclasses import dataclass, replace
from pathlib import Path

import mujoco
import numpy as np
import torch
import tyro
from mujoco import minimize
from numpy.typing import NDArray
from tqdm import tqdm

from torchrl_athletic.functional import streams
from torchrl_athletic.functional.commands import CommandRanges, command_ranges, goal_to_pose
from torchrl_athletic.robots import Robot, b2z1

LENGTH = 0.3
"""Length of the keypoints' axes [m]."""
BASE = np.array([[0.42, -0.25, -0.25], [0.62, 0.25, 0.25]])
"""Least and greatest height [m], roll and pitch [rad] of a base that helps."""
STILL = np.array([[0.549, -1e-6, -1e-6], [0.551, 1e-6, 1e-6]])
"""Base of a robot that stands as it settles under its gains."""

Array = NDArray[np.float64]


@dataclass(frozen=True)
class Config:
    goals: int = 500
    """Goals of each kind."""
    starts: int = 4
    """Starts of the search for each goal."""
    seed: int = 0
    """Seed of goals and starts."""
    output: Path = Path("benchmarks/results")
    """Folder for the table."""


def main(cfg: Config) -> None:
    lines = ["| goals | base | within 2 cm | hand | attitude |", "|---|---|---|---|---|"]
    for name, ranges in kinds().items():
        for base, limits in (("helps", BASE), ("stands still", STILL)):
            errors = np.array([nearest(pose, limits, cfg) for pose in tqdm(goals(ranges, cfg), desc=f"{name}, {base}")])
            near = (errors[:, 0] < 0.02).mean()
            position, attitude = errors[:, 1:].mean(0)
            lines.append(f"| {name} | {base} | {100 * near:.0f} % | {100 * position:.1f} cm | {attitude:.3f} rad |")
    table = "\n".join(lines)
    told = f"`python benchmarks/command_reach.py --goals {cfg.goals}`, MuJoCo {mujoco.__version__}, commit {commit()}."
    text = f"# Commands within reach\n\n{table}\n\n{told}\n"
    print(text)
    cfg.output.mkdir(parents=True, exist_ok=True)
    (cfg.output / "command_reach.md").write_text(text)


def commit() -> str:
    command = ["git", "rev-parse", "--short", "HEAD"]
    return subprocess.run(command, capture_output=True, text=True, check=False).stdout.strip()


def kinds() -> dict[str, CommandRanges]:
    """What is compared."""
    whole = CommandRanges()
    (low, high), level = whole.elevation, math.pi / 2
    return {
        "all": whole,
        "ahead of the shoulder": replace(whole, elevation=(low, level)),
        "behind it": replace(whole, elevation=(level, high)),
        "`--commands ahead`": command_ranges("ahead"),
        "`--commands box`": command_ranges("box"),
        "all, attitudes twice as wide": replace(
            whole, roll=_twice(whole.roll), pitch=_twice(whole.pitch), yaw=_twice(whole.yaw)
        ),
    }


def _twice(between: tuple[float, float]) -> tuple[float, float]:
    return 2 * between[0], 2 * between[1]


def goals(ranges: CommandRanges, cfg: Config) -> list[Array]:
    """Keypoints in the world of a base that heads along x. Shape (4, 3) each [m]."""
    drawn, _ = ranges.draw(streams.stream(cfg.seed, torch.arange(cfg.goals)))
    poses = []
    for pose in goal_to_pose(drawn, torch.tensor(ranges.shoulder)).double().numpy():
        turn = np.zeros(9)
        mujoco.mju_quat2Mat(turn, pose[3:])
        poses.append(keypoints(pose[:3] + np.array([0, 0, ranges.frame_height]), turn.reshape(3, 3)))
    return poses


def keypoints(origin: Array, turn: Array) -> Array:
    return np.vstack([origin, origin + LENGTH * turn.T])


class Body:
    """The robot's kinematics: arm joints, then the base's height, roll and pitch, to the hand's keypoints."""

    def __init__(self, robot: Robot):
        self.model = robot.model()
        self.data = mujoco.MjData(self.model)
        arm = [robot.joint_names[joint] for joint in robot.joint_groups["arm"]]
        self.columns = [int(self.model.joint(name).qposadr[0]) for name in arm]
        self.limits = np.array([robot.position_limit[robot.joint_names.index(name)] for name in arm]).T
        self.pose = np.array([robot.default_pose[robot.joint_names.index(name)] for name in arm])

    def __call__(self, x: Array) -> Array:
        self.data.qpos[:] = self.model.key("stand").qpos
        self.data.qpos[2] = x[6]
        mujoco.mju_euler2Quat(self.data.qpos[3:7], np.array([x[7], x[8], 0.0]), "xyz")
        self.data.qpos[self.columns] = x[:6]
        mujoco.mj_kinematics(self.model, self.data)
        hand = self.data.site("end_effector")
        return keypoints(hand.xpos, hand.xmat.reshape(3, 3))


BODY = Body(b2z1())


def nearest(goal: Array, base: Array, cfg: Config) -> tuple[float, float, float]:
    """Mean distance of the keypoints [m], of the origin [m], and angle [rad], at the best of some searches."""
    low, high = np.hstack((BODY.limits, base))
    rng, best = np.random.default_rng(cfg.seed), (np.inf, np.inf, np.inf)
    for start in range(cfg.starts):
        shaken = np.hstack((BODY.pose, base.mean(0))) + (start > 0) * 0.4 * rng.normal(size=9)
        first = np.clip(shaken, low, high)
        found, _ = minimize.least_squares(
            first, lambda many: np.array([(BODY(x) - goal).ravel() for x in many.T]).T, bounds=[low, high],
            verbose=0, max_iter=80,
        )  # fmt: skip
        way = BODY(found) - goal
        far = np.linalg.norm(way, axis=1)
        angle = 2 * np.arcsin(min(1.0, float(np.linalg.norm(way[1:] - way[0])) / (LENGTH * 8**0.5)))
        best = min(best, (float(far.mean()), float(far[0]), float(angle)))
        if best[0] < 0.005:
            break
    return best


if __name__ == "__main__":
    main(tyro.cli(Config, description=__doc__))
