"""Which goals of the hand's attitude a whole-body controller misses, and how far its base is from upright then.

    python benchmarks/wbc_attitude.py                      # the shipped one: a minute of two cores
    python benchmarks/wbc_attitude.py --policy wbc.npz

Nominal robots on flat ground, so that neither encoders nor pushes nor bumps have a part in it.
"""

from __future__ import annotations

import platform
import sys
from dataclasses import dataclass
from itertools import pairwise
from pathlib import Path
from typing import Any

import torch
import tyro
from tensordict import TensorDict
from torch import Tensor

sys.path.append(str(Path(__file__).parents[1]))

from benchmarks.by_case import commit
from torchrl_athletic.functional import rotations
from torchrl_athletic.functional.commands import command_ranges
from torchrl_athletic.recordings.whole_file import whole_file
from torchrl_athletic.training import wbc_conditions, whole_rollout
from torchrl_athletic.training.wbc import read_wbc

EDGES = (-90, -20, 0, 20, 90)
"""Of the bins [deg]."""


@dataclass(frozen=True)
class Config:
    """Every field is a flag."""

    policy: str = "wbc"
    """A shipped controller, or a file of ``pretrain_wbc.py``."""
    robots: int = 96
    steps: int = 1000
    """Of an episode [policy steps]."""
    seed: int = 1_000_003
    """Seed of the commands."""
    output: Path = Path("benchmarks/results/wbc_attitude.md")


def main(cfg: Config) -> None:
    torch.set_grad_enabled(False)
    told: dict[str, Any] = {"max_steps": cfg.steps, "seed": cfg.seed, "commands": command_ranges("box")}
    env = wbc_conditions()["nominal"].env(cfg.robots, **told)
    keys = ["end_effector_command", "tracking", "base_quaternion"]
    shown = whole_rollout(env, read_wbc(cfg.policy)[0], keys, cfg.steps, progress=f"{cfg.robots} robots")
    head = ("the hand is to point up by", "share of the time", "attitude, mean error [rad]", "base, mean tilt [rad]")
    lines = [f"| {' | '.join(head)} |", "|---" * len(head) + "|"]
    for words, share, error, leans in binned(shown):
        lines.append(f"| {words} | {100 * share:.0f} % | {error:.3f} | {leans:.3f} |")
    flag = "" if cfg.policy == "wbc" else f" --policy {cfg.policy}"
    made = f"`python benchmarks/wbc_attitude.py{flag}`, {cfg.robots} nominal robots, 20 s, commit {commit()}, "
    with whole_file(cfg.output) as part:
        part.write_text("\n".join([*lines, "", f"{made}{platform.machine()}.", ""]), encoding="utf-8")
    print("\n".join(lines))


def binned(shown: TensorDict) -> list[tuple[str, float, float, float]]:
    """Words, share of the time, mean error and mean tilt of the base [rad] of each bin that has any, then of all."""
    counts = shown["counts"].squeeze(-1)
    error = shown["tracking", "attitude"].squeeze(-1)[counts]
    leans = tilt(shown["base_quaternion"][counts])
    up = elevation(shown["end_effector_command"][counts])
    rows = []
    for low, high in pairwise(EDGES):
        inside = (up > low) & (up <= high)
        if inside.any():
            share = float(inside.float().mean())
            rows.append((f"{low} to {high}°", share, float(error[inside].mean()), float(leans[inside].mean())))
    return [*rows, ("all", 1.0, float(error.mean()), float(leans.mean()))]


def tilt(quaternion: Tensor) -> Tensor:
    """Angle of a base from upright [rad]; its rocking in a gait cycle hardly counts. Shape (*B, 4), wxyz, to (*B,)."""
    return (-rotations.projected_gravity(quaternion)[..., 2]).clamp(-1, 1).acos()


def elevation(command: Tensor) -> Tensor:
    """How far the x axis of a commanded hand points up [deg]. Shape (*B, 9) to (*B,)."""
    return torch.asin(command[..., 5].clamp(-1, 1)).rad2deg()


if __name__ == "__main__":
    main(tyro.cli(Config, description=__doc__))
