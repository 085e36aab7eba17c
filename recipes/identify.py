"""Identify an arm's simulator from recordings, by one of the paper's baselines or by diagnosis.

python recipes/identify.py --method cem                    # friction, damping, armature of each joint; five minutes
python recipes/identify.py --method actuator_net --seed 1  # supervised by the torque that the motors' current tells of
python recipes/identify.py --method diagnosed              # physics that has a name; its report lies beside it
python recipes/identify.py --method dr                     # nothing is fitted: a policy meets another arm each episode

Each writes a simulator to outputs/identification/METHOD_seedN, which recipes/compare_identification.py scores and
recipes/throw_arm.py trains policies in. Takes with "split": "heldout" in their metadata are not looked at. An
Unsupervised Actuator Net is trained by recipes/train_uan.py.
"""

from dataclasses import dataclass, field
from pathlib import Path
from typing import Literal

import tyro
from tqdm import tqdm

from torchrl_athletic.identification import (
    CEM,
    ActuatorNetTraining,
    Simulator,
    identify_actuator_net,
    identify_cem,
    identify_diagnosed,
    open_loop,
    randomized,
    score,
)
from torchrl_athletic.recordings import Recording, read_recordings
from torchrl_athletic.robots import Robot, from_mjcf, z1
from torchrl_athletic.training import with_gains_of

Method = Literal["default", "cem", "actuator_net", "diagnosed", "dr", "roa"]


@dataclass(frozen=True)
class Config:
    method: Method
    """What identifies."""
    recordings: Path = Path("outputs/recordings/z1")
    """Folder of takes."""
    output: Path = Path("outputs/identification")
    """Folder of simulators."""
    robot: str = "z1"
    """``z1``, or the path of an MJCF."""
    seed: int = 0
    """Seed of the search, the weights, the windows."""
    cem: CEM = field(default_factory=CEM)
    """How long and how closely CEM looks."""
    actuator_net: ActuatorNetTraining = field(default_factory=ActuatorNetTraining)
    """How the supervised net is trained."""
    seconds_per_take: float = 6.0
    """What the diagnosis looks at of each take [s]."""
    time_budget: float = 600.0
    """Time budget of the diagnosis [s]."""


def main(cfg: Config) -> None:
    takes = [take for take in read_recordings(cfg.recordings) if take.metadata.get("split") != "heldout"]
    if not takes:
        raise SystemExit(f"{cfg.recordings} holds no takes to fit. Record some: recipes/collect_recordings.py.")
    robot = with_gains_of(z1() if cfg.robot == "z1" else from_mjcf(cfg.robot), takes)
    simulator = identify(robot, takes, cfg)
    folder = simulator.save(folder_of(cfg))
    before, after = (score(open_loop(s, takes, window=0.5)).mse for s in (Simulator("default", robot), simulator))
    print(f"mean squared error over 0.5 s windows of what was fitted: {before:.2e} -> {after:.2e} rad²")
    print(f"{simulator.notes.get('training_seconds', 0.0):.0f} s. Simulator: {folder}")


def identify(robot: Robot, takes: list[Recording], cfg: Config) -> Simulator:
    if cfg.method == "default":
        return Simulator("default", robot, notes={"training_seconds": 0.0, "data_seconds": 0.0})
    if cfg.method in ("dr", "roa"):
        return randomized(robot, adaptation=cfg.method == "roa")
    if cfg.method == "diagnosed":
        return identify_diagnosed(
            robot,
            takes,
            seed=cfg.seed,
            seconds_per_take=cfg.seconds_per_take,
            refine=cfg.cem,
            time_budget=cfg.time_budget,
            output=folder_of(cfg) / "diagnosis",
        )
    rounds = cfg.cem.generations if cfg.method == "cem" else cfg.actuator_net.epochs
    with tqdm(total=rounds, desc=cfg.method) as bar:

        def show(_: int, error: float) -> None:
            bar.set_postfix(error=f"{error:.3g}", refresh=False)
            bar.update()

        if cfg.method == "cem":
            return identify_cem(robot, takes, cfg.cem, seed=cfg.seed, progress=show)
        return identify_actuator_net(robot, takes, cfg.actuator_net, seed=cfg.seed, progress=show)


def folder_of(cfg: Config) -> Path:
    seeded = cfg.method in ("cem", "actuator_net", "diagnosed")
    return cfg.output / (f"{cfg.method}_seed{cfg.seed}" if seeded else cfg.method)


if __name__ == "__main__":
    main(tyro.cli(Config, description=__doc__))
