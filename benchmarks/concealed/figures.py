"""Draw what the sealed cases say of probabilities and of the detection limit.

    python benchmarks/concealed/figures.py

Reads the numbers that ``score.py`` wrote and runs nothing.
"""

from __future__ import annotations

import json
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import matplotlib as mpl
import numpy as np
import tyro
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from scipy.stats import binomtest

BLUE, GREY, ORANGE = "#1D3557", "#8D99AE", "#E76F51"


@dataclass(frozen=True)
class Config:
    """Every field is a flag."""

    scores: Path = Path("benchmarks/results/concealed_sealed_20261134.json")
    """As written by score.py."""
    output: Path = Path("docs/images/proof.svg")


def main(cfg: Config) -> None:
    scores = json.loads(cfg.scores.read_text(encoding="utf-8"))["diagnosis"]
    mpl.rcParams["svg.hashsalt"] = "proof"  # the same numbers draw the same file
    figure = Figure(figsize=(9.5, 4.2), layout="constrained")
    left, right = figure.subplots(1, 2)
    reliability(left, scores["calibration"])
    detection(right, scores["single"]["by_ratio"])
    cfg.output.parent.mkdir(parents=True, exist_ok=True)
    figure.savefig(cfg.output, metadata={"Date": None})
    print(f"{cfg.output} drawn from {cfg.scores}")


def interval(rate: float, n: int) -> tuple[float, float]:
    """95 % of the true rate behind ``rate`` of ``n`` cases (Clopper, Pearson 1934).

    Example:
        >>> interval(0.0, 160)[1] < 0.03
        True
    """
    ends = binomtest(round(rate * n), n).proportion_ci()
    return float(ends.low), float(ends.high)


def reliability(ax: Axes, calibration: Mapping[str, Any]) -> None:
    """How often findings are right that are stated with a probability."""
    bins = calibration["bins"]
    stated, true = (np.array([b[key] for b in bins]) for key in ("stated", "true"))
    ends = np.array([interval(b["true"], b["n"]) for b in bins]).T
    ax.plot([0, 1], [0, 1], color=GREY, linewidth=1, label="as stated")
    ax.errorbar(
        stated, true, np.abs(ends - true), fmt="o", color=BLUE, capsize=2, label="sealed findings, 95 % if independent"
    )
    for b, top in zip(bins, ends[1], strict=True):
        ax.annotate(str(b["n"]), (b["stated"], min(top + 0.015, 1.01)), ha="center", fontsize=7, color=GREY)
    ax.set(xlim=(0, 1), ylim=(0, 1.06), xlabel="stated probability", ylabel="share that is right")
    ax.set_title(f"Probabilities: calibration error {calibration['ece']:.3f}", loc="left", fontsize=10)
    ax.legend(frameon=False, loc="lower right", fontsize=8)


def detection(ax: Axes, by_ratio: Mapping[str, Mapping[str, Any]]) -> None:
    """How often single effects are named whose torque is some times that of the sensors' noise."""
    edges = sorted(by_ratio, key=lambda name: float(name.split()[0]))
    place = np.arange(len(edges))
    for key, label, colour in (("anything", "anything stated", ORANGE), ("name", "named, with its joint", BLUE)):
        rate, n = (np.array([by_ratio[e][key][k] for e in edges], dtype=float) for k in (0, 1))
        ends = np.array([interval(r, int(k)) for r, k in zip(rate, n, strict=True)]).T
        ax.errorbar(place, rate, np.abs(ends - rate), fmt="o-", color=colour, capsize=2, label=label)
    counts = [by_ratio[e]["name"][1] for e in edges]
    ranges = [f"over {e.split()[0]}" if e.endswith("inf") else e.replace(" to ", "–") for e in edges]
    labels = [f"{e}\n({n})" for e, n in zip(ranges, counts, strict=True)]
    ax.set_xticks(place, labels, fontsize=8)
    ax.set(
        ylim=(0, 1.06),
        xlabel="missing torque over the sensors' noise (cases)",
        ylabel="share of single effects",
    )
    ax.set_title("Detection limit", loc="left", fontsize=10)
    ax.legend(frameon=False, loc="lower right", fontsize=8)


if __name__ == "__main__":
    main(tyro.cli(Config))
