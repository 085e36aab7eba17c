"""Teach a B2 with a Z1 to throw a ball as far as it can.

python recipes/finetune_throw.py                  # two cores, nine minutes of training: first steps and a video
python recipes/finetune_throw.py --device cuda    # the paper's scale: 4,096 robots, 14 minutes
python recipes/finetune_throw.py --actuation outputs/identification/diagnosed_seed0   # in an identified simulator

Starts from the shipped whole-body controller. The same command goes on after Ctrl-C or a crash.
What came out: docs/task_throw.md.
"""

import os
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

os.environ.setdefault("OMP_WAIT_POLICY", "PASSIVE")  # threads of torch that spin would take cores from the physics
import torch
import tyro
from tensordict import TensorDict
from torch import Tensor
from torchrl.envs import TransformedEnv

from torchrl_athletic import training
from torchrl_athletic.envs import ball_throw_distance, ball_throw_env, draw_ball
from torchrl_athletic.envs.ball_throw import KNOWN
from torchrl_athletic.envs.throw import BUCKET
from torchrl_athletic.functional import rotations
from torchrl_athletic.functional.phase import throw_phases
from torchrl_athletic.identification import with_actuation
from torchrl_athletic.robots import Robot, Terrain, b2z1, with_bucket

CURVES = {
    "reward": "reward per step",
    "reward_terms/distance": "reward for distance",
    "reward_terms/reference": "arm off its motion",
    "terminated": "falls and lost balls per step",
}
STEPS = 300
BALL = ["ball_position", "ball_linear_velocity", "ball_launch_velocity", "ball_away"]
LOOK_AT = [*BALL, "start_line", "peak_power", "joint_velocity"]


@dataclass(frozen=True)
class Config(training.FineTune):
    start: str | None = "wbc_wide"
    """A shipped controller, or a file of ``pretrain_wbc.py``, to go on from; ``None`` begins anew."""
    output: Path = Path("outputs/finetune_throw")
    """Folder for all that is written."""


def main(cfg: Config) -> None:
    training.fine_tune(
        cfg,
        partial(make_env, cfg.actuation),
        name="throw",
        known=KNOWN,
        curves=CURVES,
        look_at=LOOK_AT,
        judge=judge,
        annotate=draw_ball,
        steps=STEPS,
    )


def nominal() -> Robot:
    return with_bucket(b2z1(terrain=Terrain(), cone="pyramidal"), BUCKET)


def make_env(
    actuation: str,
    num_envs: int,
    *,
    robot: Robot | None = None,
    exam: bool = False,
    seed: int = 0,
    first_row: int = 0,
    substeps: int = 1,
    **told: Any,
) -> TransformedEnv:
    """The task; in an exam every episode has a throw in it."""
    rows: dict[str, Any] = {"seed": seed, "first_row": first_row, "substeps": substeps}
    robot, chain = with_actuation(robot or nominal(), actuation, delay=(0, 6), **rows)
    if exam:
        told["schedule"] = throw_phases(stay_probability=0.0, settle_probability=0.0)
    return ball_throw_env(robot, num_envs=num_envs, chain=chain, **rows, **told)


def judge(episodes: TensorDict) -> dict[str, float]:
    """Distance, launch, peaks of the legs' power and the arm's speed. A ball lost in the set-up, or kept: 0 m."""
    shown = TensorDict({key: training.last_of(episodes, key) for key in episodes.keys()}, [len(episodes)])
    away = episodes["ball_away"] & episodes["counts"]
    leaves = away & (away.cumsum(1) == 1) & ~episodes["terminated"]  # a ball that is lost ends its episode
    thrown = leaves.any(1)
    distance = torch.where(thrown, ball_throw_distance(shown), 0.0)
    forward, aside, upward = rotations.rotate_inverse(
        rotations.yaw_quaternion(shown["start_line"][..., 2:]), shown["ball_launch_velocity"]
    ).unbind(-1)
    level = torch.hypot(forward, aside)
    arm = episodes["joint_velocity"][..., list(nominal().joint_groups["arm"])] * episodes["counts"]

    def mean(values: Tensor) -> float:
        return float(values[thrown.squeeze(-1)].mean()) if thrown.any() else 0.0

    return {
        "distance_m": float(distance.mean()),
        "spread_m": float(distance.std(correction=0)),
        "release_speed_m_s": mean(torch.hypot(level, upward)),
        "elevation_deg": mean(torch.atan2(upward, level).rad2deg()),
        "azimuth_deg": mean(torch.atan2(aside, forward).rad2deg()),
        "peak_leg_power_kw": float(shown["peak_power"].mean()) / 1000,
        "peak_arm_speed_rad_s": float(arm.abs().amax((1, 2)).mean()),
        "thrown": float(thrown.float().mean()),
        "failed": float(shown["terminated"].float().mean()),
    }


if __name__ == "__main__":
    main(tyro.cli(Config, description=__doc__))
