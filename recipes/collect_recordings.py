"""Record what a Unsupervised Actuator Net learns from: the paper's square, sine and Gaussian torques on a Z1 arm.

python recipes/collect_recordings.py                          # the whole set, 15 minutes of the arm's time
python recipes/collect_recordings.py --seconds-per-take 2     # a look, in seconds

The arm is simulated: a concealed one that stands for the real Z1, on harmonic drives. The same command goes on after
Ctrl-C, or after the watchdog has stopped a take. Your own arm: give `main` anything with `reset`, `step` and `stop`,
see docs/collecting.md. All torques are added to a hold at the default pose.
"""

import sys
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import tyro
from tqdm import tqdm

from torchrl_athletic.recordings import (
    Arm,
    Excitation,
    Safety,
    Watchdog,
    amplitude_frequency_pairs,
    gaussian,
    held,
    record,
    sine,
    square,
    through_poses,
    write_recording,
)
from torchrl_athletic.robots import Robot, z1

THROW = (
    (0.0, (0.0, 1.5, -1.0, -0.54, 0.0, 0.0, 0.0)),
    (1.5, (0.0, 0.9, -0.9, -0.9, 0.0, 0.0, 0.0)),  # cocked
    (2.1, (0.0, 1.8, -1.7, 0.0, 0.0, 0.0, 0.0)),  # swung forward
    (3.5, (0.0, 1.5, -1.0, -0.54, 0.0, 0.0, 0.0)),
    (5.0, (0.0, 1.5, -1.0, -0.54, 0.0, 0.0, 0.0)),
)  # fmt: skip
"""When [s] and where [rad] a throw passes: nothing like it is in the other takes."""


@dataclass(frozen=True)
class Config:
    output: Path = Path("outputs/recordings/z1")
    """Folder for the takes."""
    amplitude: float = 0.6
    """Largest of the square and sine waves [share of the torque limit]."""
    deviation: float = 0.25
    """Standard deviation of the Gaussian torques [share of the torque limit]."""
    slew: float = 50.0
    """Fastest change of a torque [torque limits / s]."""
    margin: float = 0.1
    """Which targets keep from the ends of the joints [rad]."""
    gaussian_seconds: float = 300.0
    """Length of a Gaussian take [s]."""
    seconds_per_take: float | None = None
    """Cuts every take to this length [s], to try things out."""
    seed: int = 0
    """Of the Gaussian torques and of the simulated noise."""


def main(cfg: Config, arm: Arm | None = None, robot: Robot | None = None) -> None:
    robot = robot or z1()
    arm = arm or concealed_arm(cfg.seed)
    takes = excitations(robot, cfg)
    missing = {name: take for name, take in takes.items() if not (cfg.output / f"{name}.npz").exists()}
    cfg.output.mkdir(parents=True, exist_ok=True)
    with tqdm(total=sum(len(take.time) for take, _ in missing.values()), unit="samples") as bar:
        for name, (take, notes) in missing.items():
            bar.set_postfix_str(name)
            kp, kd, pose = robot.kp, robot.kd, robot.default_pose
            recording = record(arm, take, pose, kp, kd, watchdog(robot), notes, each=bar.update)
            write_recording(recording, cfg.output / f"{name}.npz")
    print(f"{len(takes)} takes in {cfg.output}, {len(missing)} of them new")


def excitations(robot: Robot, cfg: Config) -> dict[str, tuple[Excitation, dict[str, object]]]:
    """Name -> position targets and notes, in the order of recording."""
    names, limit, kp = robot.joint_names, np.array(robot.torque_limit), np.array(robot.kp)
    moving = np.isin(np.arange(len(names)), robot.joint_groups["arm"])
    safety = Safety(limit=limit, clip=True, slew=cfg.slew * limit)
    room = np.array(robot.position_limit) + cfg.margin * np.array([1.0, -1.0])
    room[~moving] = robot.position_limit[-1]
    common = {"robot": robot.name, "fixture": "table", "payload": 0.0}

    takes: dict[str, tuple[Excitation, dict[str, object]]] = {}
    for j in robot.joint_groups["arm"]:
        pairs = amplitude_frequency_pairs(cfg.amplitude * limit[j])
        for make in (square, sine):
            wave = make(names, names[j], pairs, safety=safety)
            takes[f"{wave.kind}_{names[j]}"] = (wave, {"split": "train", "repeat": 0})
    for repeat, split in enumerate(("train", "heldout")):
        seed = 1000 * cfg.seed + repeat
        wave = gaussian(names, cfg.deviation * limit * moving, seed, cfg.gaussian_seconds, safety=safety)
        takes[f"gaussian_{repeat}"] = (wave, {"split": split, "repeat": repeat})
    takes["throw"] = (through_poses(names, THROW), {"split": "heldout", "repeat": 0})
    return {
        name: (shortened(take if take.kind == "throw" else held(take, robot.default_pose, kp, room), cfg),
               {"kind": take.kind, **notes, **common})
        for name, (take, notes) in takes.items()
    }  # fmt: skip


def shortened(take: Excitation, cfg: Config) -> Excitation:
    if cfg.seconds_per_take is None:
        return take
    count = int((take.time < cfg.seconds_per_take).sum())
    return Excitation(
        take.time[:count], take.command[:count], take.joint_names, take.kind, take.field, {**take.metadata, "cut": True}
    )


def watchdog(robot: Robot) -> Watchdog:
    """Beyond what the excitations ask for, below what breaks a gear."""
    position, velocity, torque = (np.array(x) for x in (robot.position_limit, robot.velocity_limit, robot.torque_limit))
    return Watchdog(position + np.array([-0.02, 0.02]), 1.5 * velocity, 1.2 * torque)


def concealed_arm(seed: int) -> Arm:
    sys.path.append(str(Path(__file__).parents[1]))  # benchmarks/ is no part of the package
    from benchmarks.concealed.arm import ConcealedArm

    return ConcealedArm(seed=seed)


if __name__ == "__main__":
    main(tyro.cli(Config, description=__doc__))
