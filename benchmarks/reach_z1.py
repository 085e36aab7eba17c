"""How fast the recipe for reaching learns, over seeds, and what split minibatches do for it.

    python benchmarks/reach_z1.py --seed 0 --minibatches split --minutes 15 --output out/split_0    # one run of a set
    python benchmarks/reach_z1.py --table out/split_* out/joint_* --output benchmarks/results       # when all are there

The first command runs ``recipes/reach_z1.py`` and leaves its curve in ``progress.csv``, a row per iteration as soon as
it is done; what stands after the flags goes on to the recipe. The second writes ``reach_z1.md`` and ``reach_z1.svg``.
``joint`` gives the critic the actor's minibatches, and else changes nothing.
"""

from __future__ import annotations

import json
import os
import subprocess
import sys
from dataclasses import dataclass
from pathlib import Path
from statistics import mean
from typing import Annotated, Literal

import tyro

from torchrl_athletic.training import CSVTable

RECIPE = Path(__file__).parents[1] / "recipes" / "reach_z1.py"


@dataclass(frozen=True)
class Config:
    """Every field is a flag."""

    output: Path
    """Folder of the run, or of the table."""
    seed: int = 0
    """Seed of the run."""
    minibatches: Literal["split", "joint"] = "split"
    """What the critic learns from: the whole batch, or the actor's minibatches."""
    minutes: float = 15.0
    """Length of the run [min]."""
    evaluate_every: int = 25
    """Iterations between measurements."""
    table: tuple[Path, ...] = ()
    """Folders of runs: write table and picture instead of running."""
    recipe: Annotated[tuple[str, ...], tyro.conf.Positional] = ()
    """More flags of the recipe, after ``--``."""


@dataclass(frozen=True)
class Run:
    """A run as it went."""

    seed: int
    minibatches: str
    threads: int
    minutes: list[float]
    """When it was measured [min]."""
    samples: list[float]
    error: list[float]
    """Mean over the goals [cm]."""
    median: list[float]
    """Over the goals [cm]."""
    near: list[float]
    """Share of goals with less than 3 cm [1]."""
    attitude: list[float]
    """Mean over the goals [°]."""

    def minutes_to(self, error: float) -> float | None:
        """When the mean error was first that small."""
        return next((minute for minute, found in zip(self.minutes, self.error, strict=True) if found < error), None)


def main(cfg: Config) -> None:
    if cfg.table:
        runs = sorted((read(folder) for folder in cfg.table), key=lambda run: (run.minibatches != "split", run.seed))
        cfg.output.mkdir(parents=True, exist_ok=True)
        (cfg.output / "reach_z1.md").write_text(markdown(runs))
        draw(runs, cfg.output / "reach_z1.svg")
        print(markdown(runs))
        return
    cfg.output.mkdir(parents=True, exist_ok=True)
    threads = len(os.sched_getaffinity(0))
    about = {"seed": cfg.seed, "minibatches": cfg.minibatches, "threads": threads}
    (cfg.output / "run.json").write_text(json.dumps(about))
    flags = {
        "seed": cfg.seed,
        "minibatches": cfg.minibatches,
        "minutes": cfg.minutes,
        "evaluate-every": cfg.evaluate_every,
        "output": cfg.output,
        "logger": "csv",
    }
    words = [word for name, value in flags.items() for word in (f"--{name}", str(value))]
    subprocess.run([sys.executable, str(RECIPE), *words, "--no-video", *cfg.recipe], check=True)


def read(folder: Path) -> Run:
    """The curve of a run, which may still be going on."""
    about = json.loads((folder / "run.json").read_text())
    rows = [row for row in CSVTable(folder / "progress.csv").rows if row.get("error_cm")]
    if not rows:
        raise ValueError(f"{folder} holds no measurement yet, so it has no place in a table. Let it run on.")

    def column(name: str) -> list[float]:
        return [float(row[name]) for row in rows]

    return Run(
        **about,
        minutes=[second / 60 for second in column("seconds")],
        samples=column("samples"),
        error=column("error_cm"),
        median=column("median_cm"),
        near=column("share_below_3cm"),
        attitude=column("attitude_deg"),
    )


def markdown(runs: list[Run]) -> str:
    """A row per run, and the mean of each kind."""
    lines = [
        "| minibatches | seed | CPUs | minutes | samples "
        "| mean error | median | below 3 cm | attitude | to 3 cm | to 1 cm |",
        "|---|---|---|---|---|---|---|---|---|---|---|",
    ]
    for run in runs:
        end = f"{run.minutes[-1]:.1f} | {run.samples[-1]:,.0f} | {run.error[-1]:.2f} cm | {run.median[-1]:.2f} cm"
        reached = " | ".join(_minutes(run.minutes_to(error)) for error in (3.0, 1.0))
        lines.append(
            f"| {run.minibatches} | {run.seed} | {run.threads} | {end} | {100 * run.near[-1]:.0f} % "
            f"| {run.attitude[-1]:.1f}° | {reached} |"
        )
    for kind in dict.fromkeys(run.minibatches for run in runs):
        found = [run.error[-1] for run in runs if run.minibatches == kind]
        lines.append(f"| {kind} | mean of {len(found)} | | | | {mean(found):.2f} cm | | | | | |")
    return "\n".join(lines) + "\n"


def _minutes(value: float | None) -> str:
    return "not reached" if value is None else f"{value:.1f} min"


def draw(runs: list[Run], path: Path) -> None:
    """Error over time, a line per run."""
    import matplotlib

    matplotlib.use("Agg")
    from matplotlib import pyplot

    figure, axes = pyplot.subplots(figsize=(7, 4))
    for run in runs:
        colour, style = ("C0", "-") if run.minibatches == "split" else ("C1", "--")
        axes.semilogy(run.minutes, run.error, style, color=colour, label=f"{run.minibatches}, seed {run.seed}")
    axes.axhline(3.0, color="0.6", linewidth=0.8)
    axes.set(xlabel="minutes", ylabel="mean error on held-out goals [cm]", ylim=(0.3, None))
    axes.grid(alpha=0.3, which="both")
    axes.legend(fontsize="small")
    figure.tight_layout()
    figure.savefig(path)
    pyplot.close(figure)


if __name__ == "__main__":
    main(tyro.cli(Config, description=__doc__))
