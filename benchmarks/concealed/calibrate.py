"""Learn how probable findings are from the answers to tuning cases.

    python benchmarks/concealed/run.py --split tuning --jobs 2
    python benchmarks/concealed/calibrate.py

A logistic regression on the grounds of every finding that was stated; right is what the score calls right. Writes
``torchrl_athletic/diagnosis/calibration.json``. Sealed cases are refused: what scores does not tune.
"""

from __future__ import annotations

import json
import sys
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import tyro
from numpy.typing import NDArray
from scipy.optimize import minimize

sys.path.append(str(Path(__file__).parents[2]))

from benchmarks.concealed.cases import prepare
from benchmarks.concealed.score import Row
from torchrl_athletic.diagnosis.calibration import Grounds

Array = NDArray[np.float64]

SIGNS = {"share": 1, "left": -1, "excess": -1, "scatter": -1, "open": -1, "energy": 1, "terms": -1, "strain": -1}
"""Which way each feature may speak: more doubt never makes a finding more probable."""


UNSIGNED = ("gravity_tilt", "disturbance")
"""Effects whose parameters have another convention in the key."""


@dataclass(frozen=True)
class Config:
    """Every field is a flag."""

    answers: Path = Path("outputs/concealed/diagnosis")
    output: Path = Path("torchrl_athletic/diagnosis/calibration.json")
    ridge: float = 0.5
    """Strength of the pull of the weights to zero."""
    relative: float = 0.05
    """Of a parameter's value: the least that its interval reaches to either side."""


def main(cfg: Config) -> None:
    features, right = findings(cfg.answers)
    names = list(features[0])
    x = np.array([[row[name] for name in names] for row in features])
    weights = fit(x, right, np.array([SIGNS[name] for name in names]), cfg.ridge)
    chance = _logistic(weights[0] + x @ weights[1:])
    content = {
        "made_by": f"benchmarks/concealed/calibrate.py from {len(right)} findings of tuning cases, "
        f"{int(right.sum())} of them right",
        "weights": {"intercept": round(float(weights[0]), 3)}
        | {name: round(float(w), 3) for name, w in zip(names, weights[1:], strict=True)},
    }
    in_force = json.loads(cfg.output.read_text(encoding="utf-8")).get("interval", {"widen": 1.0})["widen"]
    factor = in_force * widening(intervals(cfg.answers), cfg.relative)  # the answers' intervals are wider by it already
    content["interval"] = {"widen": factor, "relative": cfg.relative}
    cfg.output.write_text(json.dumps(content, indent=1) + "\n", encoding="utf-8")
    print(json.dumps(content, indent=1))
    for low, high in ((0, 0.2), (0.2, 0.5), (0.5, 0.8), (0.8, 0.95), (0.95, 1.01)):
        inside = (chance >= low) & (chance < high)
        if inside.any():
            print(f"stated {chance[inside].mean():.2f}: {right[inside].mean():.2f} of {inside.sum()} are right")


def findings(answers: Path) -> tuple[list[dict[str, float]], Array]:
    """Features of every finding of the tuning cases, and whether it is right."""
    features, right = [], []
    for path in sorted(answers.glob("tuning-*.json")):
        content = json.loads(path.read_text(encoding="utf-8"))
        if "answer" not in content:
            continue
        split, block, seed, index = content["case"].split("-")
        row = Row(prepare(split, block, int(index), int(seed)).case, content)
        for finding in row.findings:
            features.append(Grounds(**finding["grounds"]).features())
            right.append(row.grade(finding) != "wrong")
    return features, np.array(right, dtype=np.float64)


def intervals(answers: Path) -> Array:
    """Value, ends of the interval and truth of every parameter of a right finding. Shape (parameters, 4)."""
    rows = []
    for path in sorted(answers.glob("tuning-*.json")):
        content = json.loads(path.read_text(encoding="utf-8"))
        split, block, seed, index = content["case"].split("-")
        for truth in prepare(split, block, int(index), int(seed)).case.truths:
            for f in content["answer"]["findings"] if "answer" in content else ():
                if (f["effect"], f["joint"]) == (truth.effect, truth.joint) and truth.effect not in UNSIGNED:
                    known = truth.parameters.keys() & f["parameters"].keys()
                    estimates = {name: f["parameters"][name] for name in known}
                    rows += [[p["value"], *p["ci95"], truth.parameters[name]] for name, p in estimates.items()]
    return np.array(rows)


def widening(rows: Array, relative: float) -> float:
    """Factor on the bootstrap's intervals with which they hold 95 % of the truths, beside a relative least width."""
    value, low, high, truth = rows.T
    for factor in np.arange(1.0, 10.0, 0.25):
        least = relative * np.abs(value)
        below, above = np.hypot(factor * (value - low), least), np.hypot(factor * (high - value), least)
        if ((truth >= value - below) & (truth <= value + above)).mean() >= 0.945:
            break
    return float(factor)


def fit(x: Array, right: Array, signs: Array, ridge: float) -> Array:
    """Weights of a logistic regression whose signs are given, the intercept first. Shape (1 + features,)."""

    def loss(w: Array) -> float:
        odds = w[0] + x @ w[1:]
        return float(np.logaddexp(0, -np.where(right > 0, odds, -odds)).sum() + ridge * (w[1:] ** 2).sum())

    bounds = [(None, None)] + [(0, None) if sign > 0 else (None, 0) for sign in signs]
    return np.asarray(minimize(loss, np.zeros(1 + x.shape[1]), bounds=bounds, method="L-BFGS-B").x)


def _logistic(odds: Array) -> Array:
    return np.asarray(1.0 / (1.0 + np.exp(-odds)))


if __name__ == "__main__":
    main(tyro.cli(Config))
