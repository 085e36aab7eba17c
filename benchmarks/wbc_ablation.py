"""What each part of the pre-training is worth: the same training without it, one seed, the same number of samples.

    python benchmarks/wbc_ablation.py                                 # 4.9 million samples each: hours of two cores
    python benchmarks/wbc_ablation.py --device cuda --iterations 500  # 49 million samples each: half an hour
    python benchmarks/wbc_ablation.py --only ours "history of 1"      # some of them

Each variant is `recipes/pretrain_wbc.py` with its flags. Its policy is then examined on randomised robots that no
training saw, all variants on the same ones: the errors count, not the rewards, which differ. The same command goes on
after a kill.
"""

from __future__ import annotations

import os
import platform
import subprocess
import sys
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

import torch
import tyro

from torchrl_athletic.envs.whole_body_rewards import AUXILIARY, GAIT
from torchrl_athletic.networks import read_network
from torchrl_athletic.training import examine, wbc_conditions

VARIANTS: dict[str, list[str]] = {
    "ours": [],
    "without gait terms": ["--without", *GAIT],
    "without auxiliary terms": ["--without", *AUXILIARY],
    "without hand tracking": ["--without", "ee_pose_tracking"],
    "without velocity tracking": ["--without", "linear_velocity_tracking", "angular_velocity_tracking"],
    "without randomisation": ["--no-randomize"],
    "history of 1": ["--history", "1"],
    "joint minibatches": ["--minibatches", "joint"],
}
CONDITION = "all randomised"


@dataclass(frozen=True)
class Config:
    device: Literal["cpu", "cuda"] = "cpu"
    """Device of the trainings."""
    iterations: int = 400
    """Iterations of each training."""
    episodes: int = 300
    """Episodes of each examination."""
    only: tuple[str, ...] = ()
    """Names of variants; none takes all."""
    seed: int = 0
    """Seed of the trainings."""
    folder: Path = Path("outputs/wbc_ablation")
    """Folder for the trainings."""
    commit: str = ""
    """Commit of the code, where git cannot tell."""
    machine: str = ""
    """Where the policies were trained, if not here."""
    output: Path = Path("benchmarks/results")
    """Folder for the table."""


def main(cfg: Config) -> None:
    if unknown := [name for name in cfg.only if name not in VARIANTS]:
        raise SystemExit(f"there is no variant {unknown[0]!r}; there are {sorted(VARIANTS)}.")
    for name in cfg.only or VARIANTS:
        measured(name, cfg)
    there = [name for name in VARIANTS if (folder_of(name, cfg) / "evaluation.json").exists()]  # earlier ones too
    rows = {name: measured(name, cfg) for name in there}
    lines = [
        "| variant | falls | hand [m] | hand [rad] | key points [m] | velocity [m/s] | yaw rate [rad/s] |",
        "|---|---|---|---|---|---|---|",
    ]
    for name, row in rows.items():
        share, low, high = (100 * value for value in row["falls"])
        errors = (row[error] for error in ("position", "attitude", "keypoints", "velocity", "yaw_rate"))
        cells = [f"{share:.0f} % ({low:.0f} to {high:.0f})", *(f"{e[0]:.3f} ± {e[2] - e[0]:.3f}" for e in errors)]
        lines.append(f"| {name} | {' | '.join(cells)} |")
    text = "\n".join(lines) + f"\n\n{origin(cfg, next(iter(rows.values()))['samples'])}\n"
    print(text)
    cfg.output.mkdir(parents=True, exist_ok=True)
    (cfg.output / f"wbc_ablation_{cfg.device}.md").write_text(text)


def folder_of(name: str, cfg: Config) -> Path:
    return cfg.folder / f"{cfg.device}_{cfg.iterations}_{cfg.seed}" / name.replace(" ", "_")


def measured(name: str, cfg: Config) -> dict[str, Any]:
    """Train and examine a variant, or read what came out before."""
    folder = folder_of(name, cfg)
    policy = folder / "wbc.npz"
    if not policy.exists():
        flags = [
            "--device",
            cfg.device,
            "--iterations",
            str(cfg.iterations),
            "--minutes",
            "inf",
            "--seed",
            str(cfg.seed),
        ]
        command = [sys.executable, "recipes/pretrain_wbc.py", *flags, *VARIANTS[name], "--no-video"]
        subprocess.run([*command, "--output", str(folder)], check=True)
    history = 1 if "--history" in VARIANTS[name] else 10
    told: dict[str, Any] = {"episodes": cfg.episodes, "batch": cfg.episodes, "history": history}
    chosen = {CONDITION: wbc_conditions()[CONDITION]}
    with torch.no_grad():
        row = examine(read_network(policy), chosen, folder / "evaluation.json", **told)[CONDITION]
    samples = (folder / "progress.csv").read_text().splitlines()
    columns = samples[0].split(",")
    return row | {"samples": float(samples[-1].split(",")[columns.index("samples")])}


def origin(cfg: Config, samples: float) -> str:
    found = subprocess.run(["git", "rev-parse", "--short", "HEAD"], capture_output=True, text=True, check=False)
    commit = cfg.commit or found.stdout.strip()
    device = torch.cuda.get_device_name if cfg.device == "cuda" else lambda: f"{len(os.sched_getaffinity(0))} cores"
    where = cfg.machine or f"{device()} of {platform.machine()}"
    flags = f"--device {cfg.device} --iterations {cfg.iterations} --seed {cfg.seed} --episodes {cfg.episodes}"
    return (
        f"`python benchmarks/wbc_ablation.py {flags}`: {samples / 1e6:.1f} million samples each, examined on "
        f"{cfg.episodes} randomised episodes of 20 s. Commit {commit}, {where}."
    )


if __name__ == "__main__":
    main(tyro.cli(Config, description=__doc__))
