"""How sure the ratios to the best rival are: a bootstrap over the windows kept aside.

    ATHLETIC_DATA=... python -m benchmarks.real_robots.intervals --data CLONES --fits FITS --cases so101 go1

``FITS`` is what :mod:`benchmarks.real_robots.run` left with ``--fits``; the rivals' numbers are those of its results.
Windows of one recording are alike, so the intervals are rather too narrow.
"""

from __future__ import annotations

import json
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import tyro
from numpy.typing import NDArray
from scipy.stats import bootstrap

from benchmarks.real_robots.replay import Replay, Window
from benchmarks.real_robots.robots import ROBOTS
from benchmarks.real_robots.run import folder_of
from torchrl_athletic.diagnosis.corrected import Simulation

DRAWS = 2000
FEWEST = 10
"""Windows that share no sample from which on an interval is drawn."""


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
    lines = [
        "| robot | best rival | windows that share no sample | ours / best rival | 95 % |",
        "|---|---|---|---|---|",
    ]
    for case in cfg.cases:
        robot = ROBOTS[case](cfg.data)
        held = Replay(robot, robot.heldout)
        corrected = json.loads((folder_of(cfg.fits, case) / "corrected.json").read_text("utf-8"))
        ours = held.mean_square_of(Simulation.from_json(corrected, held.given)).mean(1)
        told = {name: np.array(x) for name, x in known[case]["parameters"].items() if name != "given"}
        rivals = {name: held.mean_square(numbers).mean(1) for name, numbers in told.items()}
        best = min(rivals, key=lambda name: float(rivals[name].mean()))
        drawn = back_to_back(held.windows)
        said = "too few windows"
        if drawn.sum() >= FEWEST:
            low, high = interval(ours[drawn], rivals[best][drawn], np.random.default_rng(0))
            said = f"{low:.2f} to {high:.2f}"
        lines.append(f"| {case} | {best} | {drawn.sum()} | {ratio(ours, rivals[best]):.2f} | {said} |")
        print(lines[-1], flush=True)
    cfg.output.write_text("\n".join(lines) + "\n", "utf-8")


def back_to_back(windows: Sequence[Window]) -> NDArray[np.bool_]:
    """Which of the windows to draw from: the most that share no sample, since the others tell nothing new. Shape (W,).

    The first of each recording is one of them.
    """
    kept, recording, end = [], None, 0
    for w in windows:
        if w.recording is not recording or w.first >= end:
            recording, end = w.recording, w.first + len(w.measured)
            kept.append(True)
        else:
            kept.append(False)
    return np.array(kept)


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
