"""Is the class of what is concealed found on real benches, and how probable is a class beside its law?

    python benchmarks/concealed/classes.py

Reads the committed answers of ``benchmarks/concealed_real.py``: cases in which physics was taken out of a bench's model
or put into its recordings, by more than three times the noise. A class is right if the physics that was concealed is of
it, on that joint. Nobody knows whether classes are true that the complete model's own diagnosis names: they count
neither as wrong nor for learning, and cases whose class is among them are also counted apart.

Prints the two numbers that ``calibration.json`` holds, learnt from all benches, and writes what they are worth on a
bench that they were not learnt on.
"""

from __future__ import annotations

import json
import sys
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import tyro
from numpy.typing import NDArray
from scipy.optimize import minimize

sys.path.append(str(Path(__file__).parents[2]))

from torchrl_athletic.diagnosis.thresholds import STATEMENT
from torchrl_athletic.effects import CATALOGUE
from torchrl_athletic.recordings.whole_file import whole_file

Array = NDArray[np.float64]
Place = tuple[str, str | None]
"""Class and joint."""
CLASS = {e.name: e.family for e in CATALOGUE}
VISIBLE = 3.0
"""What concealing moves the takes by, over their noise."""
RIDGE = 0.5
"""Pull of the steepness towards one."""


@dataclass(frozen=True)
class Config:
    """Every field is a flag."""

    answers: Path = Path("benchmarks/results/concealed_real.json")
    output: Path = Path("benchmarks/results/concealed_real_classes.md")


@dataclass(frozen=True)
class Statement:
    """A finding whose class can be graded."""

    case: int
    bench: str
    place: Place
    law: float
    """Probability of the law."""
    alike: float
    """The same with its rivals of the same class and joint."""
    most: float
    """That the class may have at most, as in :func:`~torchrl_athletic.diagnosis.calibration.class_probability`."""
    in_force: float
    """What the diagnosis stated for the class."""
    right: bool
    known: bool
    """Whether the complete model's diagnosis names this class there, too."""


def main(cfg: Config) -> None:
    content = json.loads(cfg.answers.read_text(encoding="utf-8"))
    cases = [c for c in content["cases"] if c["truths"] and c.get("over_noise", 0.0) >= VISIBLE]
    stated = statements(cases, known(content["cases"]))
    learning = [s for s in stated if s.right or not s.known]
    level, steepness = learn(learning)
    print(f"level {level:.3f}, steepness {steepness:.3f}, from {len(learning)} findings")
    crossed: dict[Statement, float] = {}
    for bench in {s.bench for s in stated}:
        weights = learn([s for s in learning if s.bench != bench])
        crossed |= {s: probability(s, weights) for s in stated if s.bench == bench}
    lines = table(cases, {"as stated": {s: s.in_force for s in stated}, "one bench left out": crossed})
    commits = ", ".join(f"`{c}`" for c in sorted({c["commit"] for c in cases}))
    head = f"Made by `python benchmarks/concealed/classes.py` from {cfg.answers.name}, answers of {commits}."
    with whole_file(cfg.output) as part:
        part.write_text("\n".join([head, "", *lines]) + "\n", encoding="utf-8")
    print("\n".join(lines))


def known(cases: Sequence[Mapping[str, Any]]) -> dict[str, set[Place]]:
    """Classes that each complete model's diagnosis names."""
    return {c["bench"]: {_place(f) for f in c["findings"]} for c in cases if c["kind"] == "complete"}


def statements(cases: Sequence[Mapping[str, Any]], of_control: Mapping[str, set[Place]]) -> list[Statement]:
    """Every finding of these cases."""
    return [
        Statement(
            case=number,
            bench=case["bench"],
            place=_place(f),
            law=f["probability"],
            alike=f["probability"] + sum(p for e, j, p in f["rivals"] if (CLASS[e], j) == _place(f)),
            most=0.0 if f["senseless"] else min(1.0 - f["open"], f["energy"]),
            in_force=f["class_probability"],
            right=_place(f) in _hidden(case),
            known=_place(f) in of_control[case["bench"]],
        )
        for number, case in enumerate(cases)
        for f in case.get("findings", ())
    ]


def _hidden(case: Mapping[str, Any]) -> set[Place]:
    return {(CLASS[effect], joint) for effect, joint in case["truths"]}


def _place(finding: Mapping[str, Any]) -> Place:
    return CLASS[finding["effect"]], finding["joint"]


def table(cases: Sequence[Mapping[str, Any]], by: Mapping[str, Mapping[Statement, float]]) -> list[str]:
    """Cases whose class is found, and classes above one half that are wrong."""
    head = ("probabilities", "cases", "class and joint named", "over one half", "of these the control is silent in",
            "classes over one half", "of these wrong")  # fmt: skip
    lines = [f"| {' | '.join(head)} |", "|" + "---|" * len(head)]
    for name, of in by.items():
        over = [s for s, p in of.items() if p > STATEMENT.likely and (s.right or not s.known)]
        cells = [
            len(cases),
            len({s.case for s in of if s.right}),
            len({s.case for s in over if s.right}),
            len({s.case for s in over if s.right and not s.known}),
            len({(s.case, s.place) for s in over}),
            len({(s.case, s.place) for s in over if not s.right}),
        ]
        lines.append(f"| {name} | {' | '.join(map(str, cells))} |")
    return lines


def probability(stated: Statement, weights: tuple[float, float]) -> float:
    """Of its class, by these weights."""
    return max(stated.law, min(float(chance(weights, np.array(stated.alike))), stated.most))


def chance(weights: tuple[float, float], alike: Array) -> Array:
    """A logistic function of the log odds. Shape (F,)."""
    p = np.clip(alike, 1e-3, 1 - 1e-3)
    return np.asarray(1.0 / (1.0 + np.exp(-(weights[0] + weights[1] * np.log(p / (1.0 - p))))))


def learn(stated: Sequence[Statement]) -> tuple[float, float]:
    """Level and steepness (Platt 1999)."""
    alike, right = (np.array([getattr(s, name) for s in stated]) for name in ("alike", "right"))

    def loss(w: Array) -> float:
        p = np.clip(chance((w[0], w[1]), alike), 1e-9, 1 - 1e-9)
        return float(-np.log(np.where(right, p, 1 - p)).sum() + RIDGE * (w[1] - 1.0) ** 2)

    level, steepness = minimize(loss, np.array([0.0, 1.0]), bounds=[(None, None), (0, None)]).x
    return float(level), float(steepness)


if __name__ == "__main__":
    main(tyro.cli(Config))
