"""Is the class of what is concealed found on real benches, and how probable is a class beside its law?

    python benchmarks/concealed/classes.py

Reads the committed answers of ``benchmarks/concealed_real.py``: cases in which physics was taken out of a bench's model
or put into its recordings, by more than three times the noise. A class is right if the physics that was concealed is of
it, on that joint. Nobody knows whether classes are true that the complete model's own diagnosis names: probabilities
are neither learnt from them nor judged by them, and cases in which only they are right are counted apart.

Prints the numbers that ``calibration.json`` holds, learnt from all benches, and writes what they are worth on a
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
from scipy.optimize import Bounds, differential_evolution

sys.path.append(str(Path(__file__).parents[2]))

from torchrl_athletic.diagnosis.calibration import class_probability, learnt
from torchrl_athletic.diagnosis.thresholds import STATEMENT
from torchrl_athletic.effects import CATALOGUE
from torchrl_athletic.recordings.whole_file import whole_file

Array = NDArray[np.float64]
Place = tuple[str, str | None]
"""Class and joint."""
CLASS = {e.name: e.family for e in CATALOGUE}
VISIBLE = 3.0
"""What concealing moves the takes by, over their noise."""
PRIOR = np.array([0.0, 1.0, 0.0])
"""A class that is as likely as its laws together, whatever it closes."""
BOUNDS = Bounds([-4.0, 0.0, 0.0], [4.0, 2.0, 2.0])
RIDGE = 0.5
"""Pull towards the prior."""


@dataclass(frozen=True)
class Config:
    """Every field is a flag."""

    answers: Path = Path("benchmarks/results/concealed_real.json")
    output: Path = Path("benchmarks/results/concealed_real_classes.md")


@dataclass(frozen=True, eq=False)
class Statement:
    """A finding whose class can be graded."""

    case: int
    bench: str
    place: Place
    law: float
    """Probability of the law."""
    alike: float
    """The same with its rivals of the same class and joint."""
    closed: float
    """Share of the error that the correction closes."""
    closes: float
    """Share of the simulation's error that it closes."""
    overruled: bool
    """Whether only the motion asks for it."""
    share: float
    """Of its class among all that could stand in its place."""
    senseless: bool
    """Whether its values are none that a robot has: then the class is no likelier than the law."""
    right: bool
    known: bool
    """Whether the complete model's diagnosis names this class there, too."""


def main(cfg: Config) -> None:
    content = json.loads(cfg.answers.read_text(encoding="utf-8"))
    cases = [c for c in content["cases"] if c["truths"] and c.get("over_noise", 0.0) >= VISIBLE]
    stated = statements(cases, known(content["cases"]))
    learning = [s for s in stated if not s.known]
    weights = learn(learning)
    print(", ".join(f"{name} {value:.3f}" for name, value in weights.items()), f"from {len(learning)} findings")
    crossed: dict[Statement, float] = {}
    for bench in {s.bench for s in stated}:
        others = learn([s for s in learning if s.bench != bench])
        crossed |= {s: probability(s, others) for s in stated if s.bench == bench}
    in_force = {s: probability(s, learnt("class")) for s in stated}
    lines = table(cases, {"in force, learnt on all benches": in_force, "learnt on the other benches": crossed})
    commits = ", ".join(f"`{c}`" for c in sorted({c["commit"] for c in cases}))
    head = f"Made by `python benchmarks/concealed/classes.py` from {cfg.answers.name}, answers of {commits}."
    with whole_file(cfg.output) as part:
        part.write_text("\n".join([head, "", *lines]) + "\n", encoding="utf-8")
    print("\n".join(lines))


def known(cases: Sequence[Mapping[str, Any]]) -> dict[str, set[Place]]:
    """Classes that each complete model's diagnosis names."""
    return {c["bench"]: {_place(f) for f in c.get("findings", ())} for c in cases if c["kind"] == "complete"}


def statements(cases: Sequence[Mapping[str, Any]], of_control: Mapping[str, set[Place]]) -> list[Statement]:
    """Every finding of these cases; answers from before laws were bounded by what they close are bounded here."""
    return [
        Statement(
            case=number,
            bench=case["bench"],
            place=_place(f),
            law=min(f["probability"], closes),
            alike=min(f["probability"] + sum(p for e, j, p in f["rivals"] if (CLASS[e], j) == _place(f)), closes),
            closed=1.0 - f["grounds"]["open"],
            closes=closes,
            overruled=f["grounds"].get("overruled", f["grounds"].get("asked", 0.0) > 0.0),
            share=_share_of_class(f),
            senseless=f["grounds"]["senseless"],
            right=_place(f) in _hidden(case),
            known=_place(f) in of_control[case["bench"]],
        )
        for number, case in enumerate(cases)
        for f in case.get("findings", ())
        for closes in (f["grounds"].get("closes", 1.0),)
    ]


def _share_of_class(finding: Mapping[str, Any]) -> float:
    """Of a finding's class, at its joint, among it and its rivals."""
    likely = [(_place(finding), finding["probability"])]
    likely += [((CLASS[e], j), p) for e, j, p in finding["rivals"]]
    whole = sum(p for _, p in likely)
    return sum(p for place, p in likely if place == _place(finding)) / whole if whole > 0.0 else 1.0


def _hidden(case: Mapping[str, Any]) -> set[Place]:
    return {(CLASS[effect], joint) for effect, joint in case["truths"]}


def _place(finding: Mapping[str, Any]) -> Place:
    return CLASS[finding["effect"]], finding["joint"]


def table(cases: Sequence[Mapping[str, Any]], by: Mapping[str, Mapping[Statement, float]]) -> list[str]:
    """Cases whose class is found; then, where the control is silent, how many classes over one half are wrong."""
    head = ("probabilities", "cases", "class and joint named", "over one half", "named, control silent",
            "over one half, control silent", "classes over one half", "of these wrong", "Brier score")  # fmt: skip
    lines = [f"| {' | '.join(head)} |", "|" + "---|" * len(head)]
    for name, of in by.items():
        right = {s: p for s, p in of.items() if s.right}
        judged = {s: p for s, p in of.items() if not s.known}
        over = {s: p for s, p in judged.items() if p > STATEMENT.likely}
        cells = [
            len(cases),
            len({s.case for s in right}),
            len({s.case for s, p in right.items() if p > STATEMENT.likely}),
            len({s.case for s in judged if s.right}),
            len({s.case for s in over if s.right}),
            len({(s.case, s.place) for s in over}),
            len({(s.case, s.place) for s in over if not s.right}),
        ]
        brier = sum((p - s.right) ** 2 for s, p in judged.items()) / max(1, len(judged))
        lines.append(f"| {name} | {' | '.join(map(str, cells))} | {brier:.3f} |")
    return lines


def probability(s: Statement, weights: Mapping[str, float]) -> float:
    """Of its class, by these weights."""
    if s.senseless:
        return s.law
    likely = class_probability(s.law, s.alike, s.closed, s.closes, weights)
    return max(s.law, min(likely, s.share)) if s.overruled else likely


def learn(stated: Sequence[Statement]) -> dict[str, float]:
    """Weights of :func:`class_probability`, as it is used: under its bounds.

    A wrong statement that a bound has cut teaches no more than what is left of it.
    """
    right = np.array([s.right for s in stated])

    def loss(w: Array) -> float:
        p = np.clip([probability(s, _weights(w)) for s in stated], 1e-3, 1 - 1e-3)
        return float(-np.log(np.where(right, p, 1 - p)).sum() + RIDGE * ((w - PRIOR) ** 2).sum())

    return _weights(differential_evolution(loss, BOUNDS, popsize=8, tol=1e-3, seed=0).x)  # the bounds make it kink


def _weights(w: Array) -> dict[str, float]:
    return dict(zip(("level", "alike", "closes"), map(float, w), strict=True))


if __name__ == "__main__":
    main(tyro.cli(Config))
