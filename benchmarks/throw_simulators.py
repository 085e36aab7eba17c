"""Policies learn to throw in several simulators of the arm; how far do they throw on the concealed arm?

    python -m benchmarks.throw_simulators --policies outputs/throws --simulators outputs/identification

Each policy lies in a folder named after the simulator that it was tuned in, as `recipes/finetune_throw.py` left it:

    python recipes/finetune_throw.py --actuation outputs/identification/cem_seed0 --output outputs/throws/cem_seed0

It throws 100 times in its own simulator with the usual steps, there with the steps of 0.2 ms that the concealed arm
needs, and on the concealed arm. Robots are randomised as in training, with other seeds.
"""

from __future__ import annotations

import json
import platform
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import torch
import tyro
from tqdm import tqdm

from benchmarks.by_case import commit
from benchmarks.concealed import on_legs
from benchmarks.task_figures import Config as Exam
from benchmarks.task_figures import figures
from torchrl_athletic.diagnosis.corrected import write_json
from torchrl_athletic.networks import digest_of, read_network

NAMES = {
    "ideal": "Default",
    "cem_seed0": "CEM",
    "uan": "UAN",
    "diagnosed_seed0": "Diagnosed",
    "diagnosed_uan_seed0": "Diagnosed + UAN",
}
WORLDS: dict[str, dict[str, Any]] = {
    "own": {},
    "own, 0.2 ms": {"options": {"timestep": on_legs.TIMESTEP}, "substeps": on_legs.SUBSTEPS},
    "concealed": {"actuation": "concealed", "substeps": on_legs.SUBSTEPS},
}


@dataclass(frozen=True)
class Config:
    policies: Path = Path("outputs/throws")
    """Folder of the folders of policies."""
    simulators: Path = Path("outputs/identification")
    """Folder of simulators."""
    episodes: int = 100
    """Throws of each policy in each world."""
    output: Path = Path("benchmarks/results/throw_simulators.json")
    """For figures; a table goes beside it."""


def main(cfg: Config) -> None:
    torch.set_grad_enabled(False)
    kept = json.loads(cfg.output.read_text("utf-8")) if cfg.output.exists() else {"figures": {}}
    for name in (bar := tqdm(NAMES)):
        policy: Any = read_network(cfg.policies / name / "throw.npz")
        own = name if name in ("ideal", "uan") else str(cfg.simulators / name)
        same = {"policy": digest_of(policy), "episodes": cfg.episodes}
        rows = kept["figures"].setdefault(name, {})
        for world, told in WORLDS.items():
            bar.set_postfix_str(f"{name}, {world}")
            if {key: rows.get(world, {}).get(key) for key in same} != same:
                found = figures("throw", policy, {"actuation": own} | told, Exam(episodes=cfg.episodes))
                rows[world] = found | same | {"commit": commit(), "machine": platform.machine()}
                write_json(cfg.output, kept)
    cfg.output.with_suffix(".md").write_text(table(kept["figures"]), "utf-8")
    print(table(kept["figures"]))


def table(found: dict[str, dict[str, dict[str, Any]]]) -> str:
    """Mean distances, what is lost from the finer steps to the concealed arm, and how many throws fail there."""
    lines = [
        "| tuned in | own [m] | own, 0.2 ms steps [m] | concealed arm [m] | difference | fails: own, concealed |",
        "|---|---|---|---|---|---|",
    ]
    for name, worlds in found.items():
        distances = [worlds[world]["distance_m"] for world in WORLDS]
        cells = [f"{distance:.1f}" for distance in distances]
        cells += [f"{distances[2] / distances[1] - 1:+.0%}"]
        cells += [f"{worlds['own']['failed']:.0%}, {worlds['concealed']['failed']:.0%}"]
        lines.append(f"| {NAMES[name]} | {' | '.join(cells)} |")
    return "\n".join(lines) + "\n"


if __name__ == "__main__":
    main(tyro.cli(Config, description=__doc__))
