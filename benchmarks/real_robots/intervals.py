"""How sure the ratios to the best rival are: a bootstrap over the windows kept aside.

    ATHLETIC_DATA=... python -m benchmarks.real_robots.intervals --data CLONES --fits FITS --cases so101 go1

``FITS`` is what :mod:`benchmarks.real_robots.run` left with ``--fits``; the rivals' numbers are those of its results.
Windows of one recording are alike, so the intervals are rather too narrow.
"""

from __future__ import annotations

import json
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import tyro
from numpy.typing import NDArray
from scipy.stats import bootstrap

from benchmarks.real_robots.replay import Replay
from benchmarks.real_robots.robots import ROBOTS
from benchmarks.real_robots.run import folder_of
from torchrl_athletic.diagnosis.corrected import Simulation

DRAWS = 2000


@dataclass(frozen=True)
class Config:
    data: Path
    """Folder of clones."""
    fits: Path
    """Folder of our fits."""
    cases: tuple[str, ...]
    """Names of robots."""
    results: Path = Path("benchmarks/results/real_robots.json")
    """Holds the rivals' numbers."""
    output: Path = Path("benchmarks/results/real_robots_intervals.md")


def main(cfg: Config) -> None:
    known = json.loads(cfg.results.read_text("utf-8"))
    lines = ["| robot | best rival | windows | ours / best rival | 95 % |", "|---|---|---|---|---|"]
    for case in cfg.cases:
        robot = ROBOTS[case](cfg.data)
        held = Replay(robot, robot.heldout)
        corrected = json.loads((folder_of(cfg.fits, case) / "corrected.json").read_text("utf-8"))
        simulation = Simulation.from_json(corrected, held.given)
        ours = apart(held.mean_square_of(simulation).mean(1), held.overlapping)
        told = {name: np.array(x) for name, x in known[case]["parameters"].items() if name != "given"}
        rivals = {name: apart(held.mean_square(numbers).mean(1), held.overlapping) for name, numbers in told.items()}
        best = min(rivals, key=lambda name: float(rivals[name].mean()))
        low, high = interval(ours, rivals[best], np.random.default_rng(0))
        lines.append(f"| {case} | {best} | {len(ours)} | {ratio(ours, rivals[best]):.2f} | {low:.2f} to {high:.2f} |")
        print(lines[-1], flush=True)
    cfg.output.write_text("\n".join(lines) + "\n", "utf-8")


def apart(square: NDArray[np.float64], overlapping: int) -> NDArray[np.float64]:
    """Means of as many windows (W,) as share samples, which tell but once.

    Example:
        >>> apart(np.array([1.0, 3.0, 5.0]), 2).tolist()
        [2.0, 5.0]
    """
    first = np.arange(0, len(square), overlapping)
    return np.asarray(np.add.reduceat(square, first) / np.diff(first, append=len(square)), dtype=np.float64)


def interval(ours: NDArray[np.float64], rival: NDArray[np.float64], rng: np.random.Generator) -> tuple[float, float]:
    """Of the ratio of two root mean squares over the same windows, 95 %.

    Example:
        >>> interval(np.ones(9), 4 * np.ones(9), np.random.default_rng(0))
        (0.5, 0.5)
    """
    drawn = bootstrap((ours, rival), ratio, paired=True, n_resamples=DRAWS, method="percentile", random_state=rng)
    found = drawn.confidence_interval
    return float(found.low), float(found.high)


def ratio(ours: NDArray[np.float64], rival: NDArray[np.float64], axis: int = -1) -> Any:
    """Of root mean squares."""
    return np.sqrt(ours.mean(axis) / rival.mean(axis))


if __name__ == "__main__":
    main(tyro.cli(Config, description=__doc__))
