"""Teach a B2 with a Z1 to pull a heavy sled backwards on a straight line.

python recipes/finetune_sled.py                  # 13 minutes of two cores: first steps, curves and a video
python recipes/finetune_sled.py --device cuda    # the paper's scale: 4,096 robots, 13 minutes
python recipes/finetune_sled.py --actuation outputs/identification/diagnosed_seed0   # in an identified simulator

Starts from the shipped whole-body controller. The same command goes on after Ctrl-C or a crash.
What came out: docs/task_sled.md.
"""

import os
from dataclasses import dataclass, field, replace
from functools import partial
from pathlib import Path
from typing import Any

os.environ.setdefault("OMP_WAIT_POLICY", "PASSIVE")  # threads of torch that spin would take cores from the physics
import torch
import tyro
from tensordict import TensorDict
from torchrl.envs import TransformedEnv

from torchrl_athletic import training
from torchrl_athletic.envs import draw_sled, sled_drift, sled_pull_env
from torchrl_athletic.envs.sled_pull import KNOWN
from torchrl_athletic.functional.commands import sled_commands
from torchrl_athletic.identification import with_actuation
from torchrl_athletic.robots import Handle, Robot, Terrain, b2z1

CURVES = {
    "reward": "reward per step",
    "reward_terms/velocity": "reward for velocity",
    "rope_tension": "tension of the rope [N]",
    "reward_terms/lateral_drift": "reward for lateral drift",
    "reward_terms/heading_drift": "reward for heading drift",
    "terminated": "falls per step",
}
STEPS = 1000
LOOK_AT = ["base_position", "base_quaternion", "start_line", "sled_position", "sled_mass", "rope_tension"]


@dataclass(frozen=True)
class Config(training.FineTune):
    epochs: int | None = None
    """Passes over a batch; None takes those of ``ppo``. On CPUs it is 1, with smaller steps, unless ``ppo`` is told."""
    ppo: training.PPO = field(default_factory=lambda: replace(training.FINE_TUNE, critic_first=36))
    """What else is chosen by hand. Drift grows over a robot's first episode, in which the critic learns alone."""
    output: Path = Path("outputs/finetune_sled")
    """Folder for all that is written."""


def main(cfg: Config) -> None:
    if cfg.device == "cpu" and cfg.epochs is None and cfg.ppo == Config().ppo:
        # A batch of 256 robots says little: one pass over more batches, smaller steps, and a critic that knows more.
        ppo = replace(cfg.ppo, critic_first=72, kl_target=0.0025, least_actor_lr=1e-6)
        cfg = replace(cfg, epochs=1, ppo=ppo)
    training.fine_tune(
        cfg,
        partial(make_env, cfg.actuation),
        name="sled",
        known=KNOWN,
        curves=CURVES,
        look_at=LOOK_AT,
        judge=judge,
        watch=["rope_tension"],
        annotate=draw_sled,
        view=training.View(distance=5.5, azimuth=45.0, elevation=-25.0),
        steps=STEPS,
    )


def nominal() -> Robot:
    return b2z1(terrain=Terrain(), cone="pyramidal", tool=Handle())


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
    """The task; in an exam the robot is told to walk at 0.5 m/s all the time."""
    rows: dict[str, Any] = {"seed": seed, "first_row": first_row, "substeps": substeps}
    robot, chain = with_actuation(robot or nominal(), actuation, delay=(0, 6), **rows)
    if exam:
        told["velocity"] = replace(sled_commands(), forward=(-0.5, -0.5), standstill_probability=0.0)
    return sled_pull_env(robot, num_envs=num_envs, chain=chain, **rows, **told)


def judge(episodes: TensorDict) -> dict[str, float]:
    """How far sleds came, and how far to the side the robots were when their episodes ended."""
    keys = ("base_position", "base_quaternion", "start_line")
    last = TensorDict({key: training.last_of(episodes, key) for key in keys}, [len(episodes)])
    lateral, heading = sled_drift(last)
    way = training.last_of(episodes, "sled_position") - episodes["sled_position"][:, 0]
    return {
        "sled_moved_m": float(torch.linalg.vector_norm(way, dim=-1).mean()),
        "lateral_drift_m": float(lateral.abs().mean()),
        "heading_drift_rad": float(heading.abs().mean()),
        "mean_tension_n": float(episodes["rope_tension"][episodes["counts"]].mean()),
        "failed": float(training.last_of(episodes, "terminated").float().mean()),
    }


if __name__ == "__main__":
    main(tyro.cli(Config, description=__doc__))
