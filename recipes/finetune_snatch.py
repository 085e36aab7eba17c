"""Teach a B2 with a Z1 to lift a dumbbell from the ground and hold it overhead.

python recipes/finetune_snatch.py                  # two cores, nine minutes of training: first steps and a video
python recipes/finetune_snatch.py --device cuda    # the paper's scale: 4,096 robots, 15 minutes
python recipes/finetune_snatch.py --actuation outputs/identification/diagnosed_seed0   # in an identified simulator

Starts from the shipped whole-body controller. The same command goes on after Ctrl-C or a crash.
What came out: docs/task_snatch.md.
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
from torchrl.envs import TransformedEnv

from torchrl_athletic import training
from torchrl_athletic.envs import dumbbell_snatch_env
from torchrl_athletic.envs.dumbbell_snatch import KNOWN, hand_height
from torchrl_athletic.functional.phase import Phase, PhaseSchedule
from torchrl_athletic.identification import with_actuation
from torchrl_athletic.robots import Dumbbell, Robot, Terrain, b2z1

CURVES = {
    "reward": "reward per step",
    "reward_terms/ee_pose_tracking": "hand on its way down",
    "reward_terms/hand_height": "hand's height",
    "reward_terms/wrist": "wrist bent",
    "terminated": "falls per step",
}
STEPS, OVERHEAD, HELD = 500, 1.2, 250
"""Policy steps of an episode; height of the hand that counts as overhead [m]; steps that it shall stay there, 5 s."""
LOOK_AT = ["end_effector_position", "base_position", "base_height", "added_mass"]


@dataclass(frozen=True)
class Config(training.FineTune):
    start: str | None = "wbc_wide"
    """A shipped controller, or a file of ``pretrain_wbc.py``, to go on from; ``None`` begins anew."""
    output: Path = Path("outputs/finetune_snatch")
    """Folder for all that is written."""


def main(cfg: Config) -> None:
    training.fine_tune(
        cfg,
        partial(make_env, cfg.actuation),
        name="snatch",
        known=KNOWN,
        curves=CURVES,
        look_at=LOOK_AT,
        judge=judge,
        steps=STEPS,
    )


def nominal() -> Robot:
    return b2z1(terrain=Terrain(), cone="pyramidal", tool=Dumbbell())


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
    """The task; in an exam every episode has a lift in it."""
    rows: dict[str, Any] = {"seed": seed, "first_row": first_row, "substeps": substeps}
    robot, chain = with_actuation(robot or nominal(), actuation, delay=(0, 6), **rows)
    if exam:
        told["schedule"] = PhaseSchedule((Phase("snatch-set-up", duration=2.5), Phase("snatch")))
    return dumbbell_snatch_env(robot, num_envs=num_envs, chain=chain, **rows, **told)


def judge(episodes: TensorDict) -> dict[str, float]:
    """How long dumbbells were held overhead without a break, and how many for 5 s."""
    height = hand_height(*(episodes[key] for key in ("end_effector_position", "base_position", "base_height")))
    up = (height > OVERHEAD) & (episodes["added_mass"] > 0) & episodes["counts"]
    run, longest = torch.zeros_like(up[:, 0], dtype=torch.int64), torch.zeros_like(up[:, 0], dtype=torch.int64)
    for now in up.unbind(1):
        run = (run + 1) * now
        longest = torch.maximum(longest, run)
    counts, far = episodes["counts"], torch.inf
    return {
        "held_s": 0.02 * float(longest.float().mean()),
        "held_for_5_s": float((longest >= HELD).float().mean()),
        "lowest_hand_m": float(height.masked_fill(~counts, far).amin(1).mean()),
        "highest_hand_m": float(height.masked_fill(~counts, -far).amax(1).mean()),
        "failed": float(training.last_of(episodes, "terminated").float().mean()),
    }


if __name__ == "__main__":
    main(tyro.cli(Config, description=__doc__))
