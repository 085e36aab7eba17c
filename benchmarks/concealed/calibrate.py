"""Learn how probable findings are from the answers to tuning cases.

    python benchmarks/concealed/run.py --split tuning --jobs 2
    python benchmarks/concealed/calibrate.py

A logistic regression on the grounds of every finding that was stated, capped as the statement is; right is what the
score calls right. Writes ``torchrl_athletic/diagnosis/calibration.json``, and prints what cross-validation over cases
makes of several ridges, by which features and ridge are chosen. What scores does not tune: sealed cases are read only
of seeds that are said to be spent, whose score stands already. Answers of another generator or another diagnosis are
left out.
"""

from __future__ import annotations

import json
import sys
from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from importlib.resources import files
from pathlib import Path
from typing import Any

import numpy as np
import tyro
from numpy.typing import NDArray
from scipy.optimize import minimize

sys.path.append(str(Path(__file__).parents[2]))

from benchmarks.concealed.cases import CLASS_OF
from benchmarks.concealed.run import COUNTS, program_digest
from benchmarks.concealed.score import RIGHT, Row, known_parameters, load, reliability
from torchrl_athletic.diagnosis.calibration import Grounds, learnt

Array = NDArray[np.float64]

SIGNS = {
    "share": 1, "left": -1, "excess": -1, "scatter": -1, "open": -1, "energy": 1, "terms": -1, "strain": -1, "sure": 1,
    "plain": -1, "leans": -1, "far": -1, "rivals": -1,
}  # fmt: skip
"""Which way each feature may speak: more doubt never makes a finding more probable."""
FEATURES = tuple(SIGNS)
EFFECTS = tuple(sorted(CLASS_OF))
"""Each has a weight beside the features: how often what bears its name is right, other things equal."""
WIDTH = len(FEATURES) + len(EFFECTS)
FOLDS, REPEATS = 5, 4
"""Parts of the cases for cross-validation, and how often they are drawn."""
RIDGES = (0.1, 0.5, 2.0, 8.0)
"""That are compared."""


@dataclass(frozen=True)
class Config:
    """Every field is a flag."""

    answers: Path = Path("outputs/concealed/diagnosis")
    output: Path = Path("torchrl_athletic/diagnosis/calibration.json")
    seeds: tuple[int, ...] = (0, 1)
    """Seeds of the tuning cases."""
    spent: tuple[int, ...] = ()
    """Seeds of sealed cases that were scored before, and score no more."""
    ridge: float = 2.0
    """Strength of the pull of the weights to those in force, which were learnt from other findings."""
    anew: bool = False
    """Pull to zero instead: forget what was learnt before."""
    relative: float = 0.05
    """Share of a parameter's value: the least that its interval reaches to either side."""
    any_program: bool = False
    """Take answers of another state of the diagnosis, too; to look, not to commit."""
    dry: bool = False
    """Print, and write nothing."""


@dataclass(frozen=True, eq=False)
class Stated:
    """Every finding of the answers. F findings, K features and effects."""

    features: Array
    """Shape (F, K)."""
    most: Array
    """That may be stated of it. Shape (F,)."""
    grade: NDArray[np.str_]
    """As the score's. Shape (F,)."""
    weight: Array
    """Weight of its case, so that the blocks count as much as they do in the whole proof. Shape (F,)."""
    case: NDArray[np.int64]
    """Shape (F,)."""
    cases: int
    """All of them, those without any finding included."""

    @property
    def right(self) -> Array:
        """One where the score says right, else zero. Shape (F,)."""
        return np.isin(self.grade, RIGHT).astype(np.float64)


def main(cfg: Config) -> None:
    drawn = [row for seed in cfg.seeds for row in load(cfg.answers, "tuning", seed)]
    drawn += [row for seed in cfg.spent for row in load(cfg.answers, "sealed", seed)]
    rows = current(drawn, None if cfg.any_program else program_digest("diagnosis"))
    stated = findings(rows)
    if not 0 < stated.right.sum() < len(stated.right):
        raise SystemExit(f"{cfg.answers} holds no current answers to learn from. Run run.py --split tuning first.")
    start = np.zeros(1 + WIDTH) if cfg.anew else in_force()
    weights = fit(stated, cfg.ridge, start)
    factor = widening(intervals(rows), cfg.relative)
    kinds = "tuning cases" + (f" and of the spent sealed seeds {cfg.spent}" if cfg.spent else "")
    made_by = f"benchmarks/concealed/calibrate.py from {len(stated.right)} findings of {len(rows)} {kinds}, "
    made_by += f"{int(stated.right.sum())} of them right"
    if not cfg.anew:
        made_by += f"; before them: {learnt_by()}"
    content = {
        "made_by": made_by,
        "weights": {"intercept": round(float(weights[0]), 3)}
        | {name: round(float(w), 3) for name, w in zip(FEATURES, weights[1:], strict=False)},
        "effects": {name: round(float(w), 3) for name, w in zip(EFFECTS, weights[1 + len(FEATURES) :], strict=True)},
        "interval": {"widen": factor, "relative": cfg.relative},
        "class": dict(learnt("class")),  # of classes.py
    }
    if not cfg.dry:
        cfg.output.write_text(json.dumps(content, indent=1) + "\n", encoding="utf-8")
    print(json.dumps(content, indent=1))
    print("\n".join(words(stated, chance(weights, stated.features, stated.most), cfg.ridge, start)))


def current(rows: Sequence[Row], program: str | None) -> list[Row]:
    """Answers of this program; those of another one, and cases that failed, are counted on the terminal."""
    same = [r for r in rows if program in (None, r.result.get("program"))]
    answered = [r for r in same if "answer" in r.result]
    print(
        f"{len(answered)} answers; left out: {len(rows) - len(same)} of another state of the diagnosis, "
        f"{len(same) - len(answered)} that failed"
    )
    return answered


def findings(rows: Sequence[Row]) -> Stated:
    """Features, effect and grade of every finding but senseless and refused ones: theirs is no logistic answer."""
    of = [
        (number, row.grade(f), f)
        for number, row in enumerate(rows)
        for f in row.findings
        if not (f["grounds"].get("senseless", False) or f["grounds"].get("refused", False))
    ]
    drawn = Counter(row.case.block for row in rows)
    weight = {block: COUNTS[block] / sum(COUNTS.values()) * len(rows) / n for block, n in drawn.items()}
    return Stated(
        np.array([columns(Grounds(**f["grounds"]), f["effect"]) for *_, f in of]).reshape(-1, WIDTH),
        np.array([Grounds(**f["grounds"]).most for *_, f in of], dtype=np.float64),
        np.array([grade for _, grade, _ in of], dtype=np.str_),
        np.array([weight[rows[number].case.block] for number, *_ in of], dtype=np.float64),
        np.array([number for number, *_ in of], dtype=np.int64),
        len(rows),
    )


def columns(grounds: Grounds, effect: str) -> list[float]:
    """The features, and one for the effect. Length ``WIDTH``."""
    features = grounds.features()
    return [*(features[name] for name in FEATURES), *(float(effect == name) for name in EFFECTS)]


# --- probabilities ----------------------------------------------------------------------------------------------------


def chance(weights: Array, features: Array, most: Array) -> Array:
    """What is stated: :func:`~torchrl_athletic.diagnosis.calibration.probability` of each finding. Shape (F,)."""
    odds = np.clip(weights[0] + features @ weights[1:], -20, 20)
    return np.minimum(1.0 / (1.0 + np.exp(-odds)), most)


def fit(stated: Stated, ridge: float, start: Array, kept: NDArray[np.bool_] | None = None) -> Array:
    """Likeliest weights of what is stated, the intercept first; cases count by their weight. Shape (1 + K,).

    The cap makes the likelihood flat where it binds, so that the fit starts from the one without it.

    Args:
        stated: Findings to learn from.
        ridge: Strength of the pull to ``start``; nothing pulls the intercept.
        start: Weights that are taken where the findings say nothing. Shape (1 + K,).
        kept: Which findings to learn from; all if None. Shape (F,).
    """
    kept = np.ones(len(stated.right), dtype=bool) if kept is None else kept
    features, most, right, weight = (x[kept] for x in (stated.features, stated.most, stated.right, stated.weight))

    def loss(w: Array, cap: Array) -> float:
        p = np.clip(chance(w, features, cap), 1e-6, 1 - 1e-6)
        pull = ridge * ((w[1:] - start[1:]) ** 2).sum()
        return float(-weight @ np.log(np.where(right > 0, p, 1 - p)) + pull)

    bounds: list[tuple[float | None, float | None]] = [(None, None)] * (1 + WIDTH)
    for k, name in enumerate(FEATURES):
        bounds[1 + k] = (0, None) if SIGNS[name] > 0 else (None, 0)
    weights = start
    for cap in (np.ones_like(most), most):
        weights = minimize(loss, weights, args=(cap,), bounds=bounds, method="L-BFGS-B").x
    return np.asarray(weights)


def in_force() -> Array:
    """The weights that the diagnosis uses now, as :func:`fit` gives them. Shape (1 + K,)."""
    weights, effects = learnt("weights"), learnt("effects")
    return np.array([weights.get(n, 0.0) for n in ("intercept", *FEATURES)] + [effects.get(n, 0.0) for n in EFFECTS])


def learnt_by() -> str:
    """Where they come from."""
    text = files("torchrl_athletic.diagnosis").joinpath("calibration.json").read_text(encoding="utf-8")
    return str(json.loads(text)["made_by"])


def crossed(stated: Stated, ridge: float, seed: int, start: Array) -> Array:
    """What would be stated of each finding by weights that were learnt on other cases. Shape (F,)."""
    fold = np.random.default_rng(seed).permutation(stated.cases)[stated.case] % FOLDS
    out = np.empty(len(stated.right))
    for k in range(FOLDS):
        kept = fold != k
        weights = fit(stated, ridge, start, kept)
        out[~kept] = chance(weights, stated.features[~kept], stated.most[~kept])
    return out


def figures(stated: Stated, stating: Array) -> dict[str, float]:
    """How good probabilities are: calibration error, Brier score, wrong names and right ones above one half."""
    over = stating > 0.5
    wrong = np.unique(stated.case[over & (stated.grade == "wrong")])
    return {
        "calibration error": float(reliability(stating, stated.right > 0)["ece"]),
        "Brier": float(((stating - stated.right) ** 2).mean()),
        "cases with a wrong name over 0.5": len(wrong) / stated.cases,
        "right findings over 0.5": float(over[stated.right > 0].mean()),
    }


def words(stated: Stated, stating: Array, ridge: float, start: Array) -> list[str]:
    """The reliability of the fit, and what cross-validation says of the ridges, beside what was in force."""
    bins = reliability(stating, stated.right > 0)["bins"]
    out = [f"stated {b['stated']:.2f}: {b['true']:.2f} of {b['n']} are right" for b in bins]
    out += ["", _line("fitted", [figures(stated, stating)])]
    out.append(_line("before, without learning", [figures(stated, chance(start, stated.features, stated.most))]))
    for r in RIDGES:
        ways = [figures(stated, crossed(stated, r, seed, start)) for seed in range(REPEATS)]
        out.append(_line(f"cross-validated, ridge {r:g}", ways))
    rng = np.random.default_rng(0)
    least = np.mean([reliability(stating, rng.random(len(stating)) < stating)["ece"] for _ in range(200)])
    out.append(f"Faultless probabilities of {len(stating)} findings would show a calibration error of {least:.3f}.")
    return [*out, f"Ridge {ridge:g} is taken."]


def _line(name: str, ways: Sequence[Mapping[str, float]]) -> str:
    means = {key: np.mean([w[key] for w in ways]) for key in ways[0]}
    return f"{name:28}" + ", ".join(f"{key} {value:.3f}" for key, value in means.items())


# --- intervals --------------------------------------------------------------------------------------------------------


def intervals(rows: Sequence[Row]) -> Array:
    """Value, ends of the bootstrap's interval and truth of every parameter of a right finding. Shape (P, 4)."""
    out = []
    for row in rows:
        widened_by = row.result["calibration"]["interval"]
        for truth in row.case.truths:
            for f in row.findings:
                out += [[*bootstrap(estimate, widened_by), value] for estimate, value in known_parameters(truth, f)]
    return np.array(out).reshape(-1, 4)


def bootstrap(estimate: Mapping[str, Any], widened_by: Mapping[str, float]) -> tuple[float, float, float]:
    """Value and ends of the interval before it was widened, by what was in force when the answer was made."""
    value, (low, high) = estimate["value"], estimate["ci95"]
    least = widened_by["relative"] * abs(value)
    below, above = (np.sqrt(max(gap**2 - least**2, 0.0)) / widened_by["widen"] for gap in (value - low, high - value))
    return value, value - float(below), value + float(above)


def widening(rows: Array, relative: float) -> float:
    """Factor on the bootstrap's intervals with which they hold 95 % of the truths, beside a relative least width."""
    value, low, high, truth = rows.T
    for factor in np.arange(1.0, 10.0, 0.25):
        least = relative * np.abs(value)
        below, above = np.hypot(factor * (value - low), least), np.hypot(factor * (high - value), least)
        if ((truth >= value - below) & (truth <= value + above)).mean() >= 0.945:
            break
    return float(factor)


if __name__ == "__main__":
    main(tyro.cli(Config))
