"""Record what an Unsupervised Actuator Net learns from: the paper's square, sine and Gaussian torques on a Z1 arm.

python recipes/collect_recordings.py                          # the whole set, 15 minutes of the arm's time
python recipes/collect_recordings.py --seconds-per-take 2     # a look, in seconds

The arm is simulated: a concealed one that stands for the real Z1, three minutes on one core. The same command goes on
after Ctrl-C, or after the watchdog stopped a take. For your own arm, see docs/collecting.md.
"""

from dataclasses import dataclass
from functools import partial
from pathlib import Path
from runpy import run_path
from typing import Any

import numpy as np
import tyro
from matplotlib.figure import Figure
from tqdm import tqdm

from torchrl_athletic.recordings import (
    Arm,
    Excitation,
    Safety,
    Watchdog,
    amplitude_frequency_pairs,
    beginning,
    gaussian,
    held,
    read_recordings,
    record,
    recorded,
    sine,
    square,
    through_poses,
    write_recording,
)
from torchrl_athletic.robots import Robot, z1

FORWARD, COCKED, SWUNG = (0, 1.5, -1.0, -0.54, 0, 0, 0), (0, 0.9, -0.9, -0.9, 0, 0, 0), (0, 1.8, -1.7, 0, 0, 0, 0)
THROW = ((0.0, FORWARD), (1.5, COCKED), (2.1, SWUNG), (3.5, FORWARD), (5.0, FORWARD))
"""When [s] and where [rad] a throw passes, made by hand: nothing like it is in the other takes."""


@dataclass(frozen=True)
class Config:
    output: Path = Path("outputs/recordings/z1")
    """Folder for the takes, and a picture of them."""
    arm: Path = Path(__file__).parents[1] / "benchmarks/concealed/z1_arm.py"
    """Python file whose ``make_arm(seed)`` returns the arm to record."""
    pose: tuple[float, ...] = (0.0, 1.2, -1.6, -0.4, 0.0, 0.0, 0.0)
    """Held while torques are added: all joints have room, and nothing reaches the table [rad]."""
    amplitude: float = 1.0
    """Largest of the square and sine waves [share of the torque limit]."""
    deviation: float = 0.4
    """Standard deviation of the Gaussian torques [share of the torque limit]."""
    seconds_per_take: float = np.inf
    """Cuts every take to this length [s], to try things out."""
    seed: int = 0
    """Seed of the Gaussian torques and of the simulated noise."""


def main(cfg: Config, arm: Arm | None = None) -> None:
    robot, arm = z1(), arm or run_path(str(cfg.arm))["make_arm"](cfg.seed)
    takes = excitations(robot, cfg)
    speed, torque = np.array(robot.velocity_limit), np.array(robot.torque_limit)
    watchdog = Watchdog(np.add(robot.position_limit, (-0.02, 0.02)), 2.0 * speed, 1.2 * torque)
    missing = {name: take for name, take in takes.items() if not recorded(cfg.output / f"{name}.npz", take[0])}
    cfg.output.mkdir(parents=True, exist_ok=True)
    with tqdm(total=sum(len(take.time) for take, _ in missing.values()), unit="samples") as bar:
        for name, (take, notes) in missing.items():
            bar.set_postfix_str(name)
            recording = record(arm, take, take.command[0], robot.kp, robot.kd, watchdog, notes, each=bar.update)
            write_recording(recording, cfg.output / f"{name}.npz")
    draw(cfg.output)
    print(f"{len(takes)} takes in {cfg.output}, {len(missing)} of them new")


def excitations(robot: Robot, cfg: Config) -> dict[str, tuple[Excitation, dict[str, Any]]]:
    """Name -> position targets and notes, in the order of recording."""
    names, arm, limit = robot.joint_names, robot.joint_groups["arm"], np.array(robot.torque_limit)
    safety = Safety(limit=limit, clip=True, slew=50.0 * limit)  # a step of the limit takes 20 ms
    hold = partial(held, pose=cfg.pose, kp=robot.kp, position_limit=robot.position_limit)
    takes: dict[str, tuple[Excitation, str, int]] = {}
    for j in arm:
        pairs = amplitude_frequency_pairs(cfg.amplitude * limit[j])
        for make in (square, sine):
            takes[f"{make.__name__}_{names[j]}"] = (hold(make(names, names[j], pairs, safety=safety)), "train", 0)
    deviation = cfg.deviation * limit * np.isin(np.arange(len(names)), arm)
    for repeat, split in enumerate(("train", "heldout")):
        noise = gaussian(names, deviation, seed=1000 * cfg.seed + repeat, safety=safety)
        takes[f"gaussian_{repeat}"] = (hold(noise), split, repeat)
    takes["throw"] = (through_poses(names, THROW), "heldout", 0)
    notes = {"robot": robot.name, "fixture": "table"}
    return {
        name: (beginning(t, cfg.seconds_per_take), {"kind": t.kind, "split": split, "repeat": repeat, **notes})
        for name, (t, split, repeat) in takes.items()
    }


def draw(folder: Path) -> None:
    """Targets (grey) and what came of them, a take of each kind at the joint that moves most: look before you train."""
    takes = {r.metadata["kind"]: r for r in reversed(read_recordings(folder))}
    figure = Figure(figsize=(9.0, 2.2 * len(takes)), layout="constrained")
    for axes, (kind, take) in zip(figure.subplots(len(takes)), takes.items(), strict=True):
        j, shown = np.ptp(take.command, axis=0).argmax(), abs(take.time - 0.5 * take.duration) < 2.0
        axes.plot(take.time[shown], take.command[shown, j], color="0.6")
        axes.plot(take.time[shown], take.position[shown, j])
        axes.set(title=f"{kind}: target grey, measured blue", ylabel=f"{take.joint_names[j]} [rad]", xlabel="time [s]")
    figure.savefig(folder / "takes.png", dpi=110)


if __name__ == "__main__":
    main(tyro.cli(Config, description=__doc__))
