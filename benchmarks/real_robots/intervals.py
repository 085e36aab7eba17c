"""How sure the ratios to the best rival are: a bootstrap over the windows kept aside.

    ATHLETIC_DATA=... python -m benchmarks.real_robots.intervals --data CLONES --fits FITS --cases so101 go1

``FITS`` is what :mod:`benchmarks.real_robots.run` left with ``--fits``; the rivals' numbers are those of its results.
Windows of one recording are alike, so the intervals are rather too narrow.
"""

from __future__ import annotations

import json
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import tyro
from numpy.typing import NDArray

from benchmarks.real_robots.replay import Replay
from benchmarks.real_robots.robots import ROBOTS
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
        held = Replay(ROBOTS[case](cfg.data), ROBOTS[case](cfg.data).heldout)
        folder = "".join(letter if letter.isalnum() else "_" for letter in case)
        corrected = json.loads((cfg.fits / folder / "corrected.json").read_text("utf-8"))
        ours = held.mean_square_of(Simulation.from_json(corrected, held.given)).mean(1)
        told = {name: np.array(x) for name, x in known[case]["parameters"].items() if name != "given"}
        rivals = {name: held.mean_square(numbers).mean(1) for name, numbers in told.items()}
        best = min(rivals, key=lambda name: float(rivals[name].mean()))
        low, high = interval(ours, rivals[best], np.random.default_rng(0))
        ratio = np.sqrt(ours.mean() / rivals[best].mean())
        lines.append(f"| {case} | {best} | {len(ours)} | {ratio:.2f} | {low:.2f} to {high:.2f} |")
        print(lines[-1], flush=True)
    cfg.output.write_text("\n".join(lines) + "\n", "utf-8")


def interval(ours: NDArray[np.float64], rival: NDArray[np.float64], rng: np.random.Generator) -> tuple[float, float]:
    """Of the ratio of two root mean squares over the same windows, 95 %.

    Example:
        >>> interval(np.ones(9), 4 * np.ones(9), np.random.default_rng(0))
        (0.5, 0.5)
    """
    drawn = rng.integers(0, len(ours), (DRAWS, len(ours)))
    ratios = np.sqrt(ours[drawn].mean(1) / rival[drawn].mean(1))
    low, high = np.percentile(ratios, [2.5, 97.5])
    return float(low), float(high)


if __name__ == "__main__":
    main(tyro.cli(Config, description=__doc__))
