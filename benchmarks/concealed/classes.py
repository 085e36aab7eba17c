"""Learn how probable a class is beside its law, from what was stated of five real benches.

    python benchmarks/concealed/classes.py

Reads the committed answers of ``benchmarks/concealed_real.py``: findings of cases in which physics was taken out of a
bench's model or put into its recordings, by more than three times the noise. A class is right if the physics that was
concealed is of it, on that joint; classes that the complete model's own diagnosis names are left out, since nobody
knows whether they are true. Prints the two numbers that ``calibration.json`` holds, and what they are worth on a robot
that they were not learnt on.
"""

from __future__ import annotations

import json
import sys
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import tyro
from numpy.typing import NDArray
from scipy.optimize import minimize

sys.path.append(str(Path(__file__).parents[2]))

from torchrl_athletic.effects import CATALOGUE

Array = NDArray[np.float64]
CLASS = {e.name: e.family for e in CATALOGUE}
VISIBLE = 3.0
"""What concealing moves the takes by, over their noise."""
RIDGE = 0.5
"""Pull of the steepness towards one."""


@dataclass(frozen=True)
class Config:
    """Every field is a flag."""

    answers: Path = Path("benchmarks/results/concealed_real.json")


@dataclass(frozen=True, eq=False)
class Stated:
    """Findings. Shapes (F,)."""

    bench: NDArray[np.str_]
    alike: Array
    """Probability of the law and of its rivals of the same class."""
    closed: Array
    """Share of the error kept aside that the correction closes."""
    right: Array


def main(cfg: Config) -> None:
    stated = read(json.loads(cfg.answers.read_text(encoding="utf-8"))["cases"])
    level, steepness = learn(stated.alike, stated.right)
    print(f"level {level:.3f}, steepness {steepness:.3f}, from {len(stated.right)} findings")
    crossed = np.empty(len(stated.right))
    for bench in np.unique(stated.bench):
        own = stated.bench == bench
        crossed[own] = chance(learn(stated.alike[~own], stated.right[~own]), stated.alike[own])
    crossed = np.minimum(crossed, np.maximum(stated.closed, stated.alike))
    over = crossed > 0.5
    found, wrong = (int((over & (stated.right == right)).sum()) for right in (1.0, 0.0))
    print(
        f"one robot left out: {found} of {int(stated.right.sum())} right classes above one half, "
        f"{wrong} of {int(over.sum())} above one half wrong, "
        f"Brier score {float(((crossed - stated.right) ** 2).mean()):.3f}"
    )


def read(cases: list[dict[str, Any]]) -> Stated:
    """Every finding whose class can be graded."""
    known = {c["bench"]: {_place(f) for f in c["findings"]} for c in cases if c["kind"] == "complete"}
    rows = []
    for c in cases:
        hidden = {(CLASS[effect], joint) for effect, joint in c["truths"]}
        if not hidden or c.get("over_noise", 0.0) < VISIBLE:
            continue
        floor = c["heldout"]["floor"] ** 2
        left = (c["heldout"]["after"] ** 2 - floor) / max(c["heldout"]["before"] ** 2 - floor, 1e-12)
        for f in c["findings"]:
            if _place(f) in hidden or _place(f) not in known[c["bench"]]:
                alike = f["probability"] + sum(p for e, j, p in f["rivals"] if (CLASS[e], j) == _place(f))
                rows.append((c["bench"], alike, 1.0 - np.clip(left, 0.0, 1.0), _place(f) in hidden))
    bench, alike_, closed, right = zip(*rows, strict=True)
    return Stated(np.array(bench), np.clip(alike_, 1e-3, 1 - 1e-3), np.array(closed), np.array(right, dtype=np.float64))


def _place(finding: dict[str, Any]) -> tuple[str, str | None]:
    return CLASS[finding["effect"]], finding["joint"]


def chance(weights: tuple[float, float], alike: Array) -> Array:
    """A logistic function of the log odds. Shape (F,)."""
    return np.asarray(1.0 / (1.0 + np.exp(-(weights[0] + weights[1] * np.log(alike / (1.0 - alike))))))


def learn(alike: Array, right: Array) -> tuple[float, float]:
    """Level and steepness (Platt 1999)."""

    def loss(w: Array) -> float:
        p = np.clip(chance((w[0], w[1]), alike), 1e-9, 1 - 1e-9)
        return float(-np.log(np.where(right > 0, p, 1 - p)).sum() + RIDGE * (w[1] - 1.0) ** 2)

    level, steepness = minimize(loss, np.array([0.0, 1.0]), bounds=[(None, None), (0, None)]).x
    return float(level), float(steepness)


if __name__ == "__main__":
    main(tyro.cli(Config))
