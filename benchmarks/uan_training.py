"""How fast each way to train a UAN fits, over seeds: PPO as the paper has it, PPO joint by joint, and by gradient.

    python benchmarks/uan_training.py train --device cuda --minutes 3 --seeds 0 1 2
    python benchmarks/uan_training.py table

``train`` runs ``recipes/train_uan.py`` for each method and seed, one after the other unless ``--jobs`` says otherwise,
and leaves a folder each with curve and simulator; what is complete already stays. ``table`` writes
``uan_training.md`` and ``.svg``: mean square error of open-loop replays of 5 s windows that nothing was trained on, as
last measured, and the time after which 95 % of the improvement was there.
"""

from __future__ import annotations

import json
import subprocess
import sys
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from pathlib import Path
from statistics import mean
from typing import Annotated, Literal

import tyro

from torchrl_athletic.training import CSVTable

RECIPE = Path(__file__).parents[1] / "recipes" / "train_uan.py"
METHODS = {  # credit for the arm or by joint; last, what the net is told beside its errors
    "ppo_arm": ("--method", "ppo", "--credit", "arm"),
    "ppo_joint": ("--method", "ppo", "--credit", "joint"),
    "gradient": ("--method", "gradient"),
    "gradient_joint": ("--method", "gradient", "--knows", "joint"),
    "gradient_arm": ("--method", "gradient", "--knows", "arm"),
    "gradient_memory": ("--method", "gradient", "--memory", "0.003", "0.03"),
    "gradient_arm_memory": ("--method", "gradient", "--knows", "arm", "--memory", "0.003", "0.03"),
}
COLOURS = {
    "ppo_arm": "#C45552",
    "ppo_joint": "#E07A5F",
    "gradient": "#457B9D",
    "gradient_joint": "#52936C",
    "gradient_arm": "#2F4858",
    "gradient_memory": "#D4A373",
    "gradient_arm_memory": "#7F5539",
}


@dataclass(frozen=True)
class Config:
    """Every field is a flag."""

    action: Annotated[Literal["train", "table"], tyro.conf.Positional]
    """Train, or look at what was trained."""
    recordings: Path = Path("outputs/recordings/z1")
    """To train on."""
    output: Path = Path("outputs/uan_training")
    """Where folders of runs go."""
    results: Path = Path("benchmarks/results")
    """Where the table goes."""
    methods: tuple[str, ...] = tuple(METHODS)
    """Which."""
    seeds: tuple[int, ...] = (0, 1, 2)
    """Seeds of each method."""
    minutes: float = 3.0
    """Duration of each run [min]."""
    device: Literal["cpu", "cuda"] = "cpu"
    """To train on."""
    num_envs: int | None = None
    """Rows of each run; None as the recipe has it."""
    jobs: int = 1
    """Runs at a time; times of several say nothing."""


def main(cfg: Config) -> None:
    if cfg.action == "table":
        return write_table(cfg)
    runs = [(method, seed) for seed in cfg.seeds for method in cfg.methods]
    with ThreadPoolExecutor(cfg.jobs) as pool:
        for name, code in pool.map(lambda run: train(cfg, *run), runs):
            print(name, "done" if code == 0 else f"failed with exit status {code}, see log.txt", flush=True)


def train(cfg: Config, method: str, seed: int) -> tuple[str, int]:
    folder = cfg.output / f"{method}_{seed}"
    if (folder / "simulator.json").exists():
        return folder.name, 0
    folder.mkdir(parents=True, exist_ok=True)
    command = [sys.executable, str(RECIPE), *METHODS[method], "--recordings", str(cfg.recordings)]
    command += ["--seed", str(seed), "--minutes", str(cfg.minutes), "--device", cfg.device, "--output", str(folder)]
    command += [] if cfg.num_envs is None else ["--num-envs", str(cfg.num_envs)]
    with (folder / "log.txt").open("w") as log:
        return folder.name, subprocess.run(command, stdout=log, stderr=subprocess.STDOUT).returncode


@dataclass(frozen=True)
class Run:
    """A run as it went."""

    method: str
    seed: int
    seconds: list[float]
    mse: list[float]
    """Mean squared error of the windows, at these times [rad²]; first without a net."""

    def time_to(self, share: float = 0.95) -> float:
        """Until this share of the improvement was there, for good [s]."""
        needed = self.mse[0] - share * (self.mse[0] - self.mse[-1])
        late = [k for k, mse in enumerate(self.mse) if mse > needed]
        return self.seconds[late[-1] + 1] if late else 0.0


def load(folder: Path) -> Run:
    notes = json.loads((folder / "simulator.json").read_text(encoding="utf-8"))["notes"]
    rows = [row for row in CSVTable(folder / "progress.csv").rows if row.get("mse")]
    method, seed = folder.name.rsplit("_", 1)
    seconds = [0.0, *(float(row["seconds"]) for row in rows)]
    return Run(method, int(seed), seconds, [notes["validation_mse_before"], *(float(row["mse"]) for row in rows)])


def write_table(cfg: Config) -> None:
    runs = [load(folder.parent) for folder in sorted(cfg.output.glob("*/simulator.json"))]
    by_method = {name: [run for run in runs if run.method == name] for name in METHODS}
    lines = [
        "# Ways to train a UAN",
        "",
        "    python benchmarks/uan_training.py train && python benchmarks/uan_training.py table",
        "",
        "| method | seeds | mse [rad²], each seed | mse / without net, mean | to 95 % of the fit [s], each seed |",
        "|---|---|---|---|---|",
    ]
    for name, found in by_method.items():
        if not found:
            continue
        ends = ", ".join(f"{run.mse[-1]:.2e}" for run in found)
        times = ", ".join(f"{run.time_to():.0f}" for run in found)
        ratio = mean(run.mse[-1] / run.mse[0] for run in found)
        lines.append(f"| {name} | {', '.join(str(run.seed) for run in found)} | {ends} | {ratio:.3f} | {times} |")
    cfg.results.mkdir(parents=True, exist_ok=True)
    (cfg.results / "uan_training.md").write_text("\n".join(lines) + "\n", encoding="utf-8")
    print("\n".join(lines))
    draw(runs, cfg.results / "uan_training.svg")


def draw(runs: list[Run], path: Path) -> None:
    from matplotlib import pyplot as plt

    figure, axes = plt.subplots(figsize=(7.5, 3.4), layout="constrained")
    named: set[str] = set()
    for run in runs:
        label = None if run.method in named else run.method.replace("_", ", ")
        named.add(run.method)
        axes.semilogy(run.seconds, run.mse, color=COLOURS[run.method], label=label, linewidth=1.2)
    axes.set(xlabel="training [s]", ylabel="open-loop error of 5 s [rad²]")
    figure.legend(loc="outside right upper", frameon=False, fontsize=8)
    axes.spines[["top", "right"]].set_visible(False)
    figure.savefig(path)


if __name__ == "__main__":
    main(tyro.cli(Config, description=__doc__))
