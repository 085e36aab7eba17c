"""Score what the methods answered: tables in Markdown and the same numbers in JSON.

    python benchmarks/concealed/score.py --split sealed --seed 7

Draws every truth anew from its seed, and for the sealed split checks that their digest is the one that was committed.
"""

from __future__ import annotations

import hashlib
import json
import math
import subprocess
import sys
from collections import Counter
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass
from itertools import pairwise
from pathlib import Path
from typing import Any, get_args

import numpy as np
import tyro
from numpy.typing import NDArray

sys.path.append(str(Path(__file__).parents[2]))

from benchmarks.concealed.cases import CLASS_OF, DETECTABLE, Case, Split, key_json, prepare, source_digest
from benchmarks.concealed.hidden import OUTSIDE, OUTSIDE_TUNING, Truth
from benchmarks.concealed.run import COUNTS, Method, digest_of

RESULTS = Path("benchmarks/results")
SUPERSETS: dict[str, tuple[str, ...]] = {
    "coulomb_friction": ("stribeck_friction", "load_dependent_friction", "asymmetric_friction"),
    "viscous_friction": ("asymmetric_friction",),
    "torque_offset": ("asymmetric_friction", "joint_spring"),
    "torque_saturation": ("speed_torque_limit",),
    "torque_scale": ("gain_mismatch",),
    "compliance": ("backlash",),
}
"""Names whose law holds another one's as a special case: right, but listed apart."""
RIGHT = ("right", "superset")
"""Grades of a finding that count as true where probabilities are scored."""
ONLY_KD = 0.03
"""By which kp may be off where kd alone is wrong: what a log is off by in its gains."""
RATIOS = (0.0, 1.0, 2.0, 3.0, 6.0, 12.0, 30.0, np.inf)
"""Edges of the bins of the detection-limit curve."""
UNSIGNED = {"gravity_tilt", "thermal_drift"}
"""Effects whose sign is a convention that the generator does not know."""


@dataclass(frozen=True)
class Config:
    """Every field is a flag."""

    split: Split = "tuning"
    seed: int = 0
    folder: Path = Path("outputs/concealed")
    """As written by run.py."""
    output: Path = RESULTS
    rows: bool = False
    """Print every case with its truth and its answer."""


@dataclass(frozen=True)
class Row:
    """One case with its answer."""

    case: Case
    result: Mapping[str, Any]

    @property
    def findings(self) -> Sequence[Mapping[str, Any]]:
        """As stated, most probable first; none if the method failed."""
        found = self.result.get("answer", {}).get("findings", ())
        return sorted(found, key=lambda f: -f["probability"])

    @property
    def verdict(self) -> str:
        """'failed' if there is no answer."""
        return str(self.result.get("answer", {}).get("verdict", "failed"))

    def detectable(self, k: int = 0) -> bool:
        """Whether the oracle counts the k-th truth as detectable."""
        seen = self.result.get("visibility", [0.0] * 9)
        return bool(seen[k] >= DETECTABLE and self.result["beyond_nuisance"][k])

    def grade(self, finding: Mapping[str, Any]) -> str:
        """'right', 'superset', 'tolerated' or 'wrong'."""
        grades = {self._grade(finding, k) for k in range(len(self.case.truths))}
        if finding["effect"] in self.case.tolerated and finding["joint"] in {t.joint for t in self.case.truths}:
            grades.add("tolerated")
        return next((g for g in ("right", "superset", "tolerated") if g in grades), "wrong")

    def _grade(self, finding: Mapping[str, Any], k: int) -> str:
        said = (finding["effect"], finding["joint"])
        truth = self.case.truths[k]
        alike = self.case.equivalents[k] if k < len(self.case.equivalents) else ()
        same = (truth.effect, truth.joint) in _same(finding) and _is_same(truth, finding["effect"])
        if same or said in ((truth.effect, truth.joint), *alike):
            return "right"
        if said[0] in SUPERSETS.get(truth.effect, ()) and said[1] == truth.joint:
            return "superset"
        return "wrong"

    def names(self, k: int, findings: Iterable[Mapping[str, Any]]) -> bool:
        """Whether the k-th truth is among them, exactly or by an identity."""
        return any(self._grade(f, k) == "right" for f in findings)

    def wrong_names(self, equal: bool = False) -> list[str]:
        """Wrong names stated with a probability above one half; or of one half, too, which is what equals get."""
        stated = (f for f in self.findings if f["probability"] > 0.5 or (equal and f["probability"] >= 0.5))
        return [f["effect"] for f in stated if self.grade(f) == "wrong"]

    def over_floor(self, split: str) -> float | None:
        """Window error of the corrected simulation over the sensors' floor, on the joint where it is largest."""
        joints = self.result.get("answer", {}).get("fit", {}).get(split, {}).get("per_joint", {})
        return max((j["after"] / max(j["floor"], 1e-12) for j in joints.values()), default=None)

    def with_rivals(self) -> list[Mapping[str, Any]]:
        """The answer set: findings and their rivals, each with the names that it says are the same."""
        return [*self.findings, *(rival for f in self.findings for rival in f.get("rivals", ()))]


def _is_same(truth: Truth, name: str) -> bool:
    """Whether the other name states the truth: gains are viscous friction only where kd alone is too large."""
    if {truth.effect, name} != {"gain_mismatch", "viscous_friction"} or truth.effect == "viscous_friction":
        return True
    return abs(truth.parameters["kp_scale"] - 1.0) <= ONLY_KD and truth.parameters["kd_scale"] > 1.0


def _same(finding: Mapping[str, Any]) -> list[tuple[str, str | None]]:
    """Single names that are printed with a finding or a rival, because they are the same physics there."""
    return [(names[0]["effect"], names[0]["joint"]) for names in finding.get("alternatives", ()) if len(names) == 1]


def main(cfg: Config) -> None:
    lines = [f"# Concealed physics: the split `{cfg.split}`, seed {cfg.seed}", "", _provenance(cfg), ""]
    if cfg.split == "sealed":
        lines += [_checked_key(cfg), ""]
    content: dict[str, Any] = {}
    answers: dict[str, Sequence[Row]] = {}
    for method in (m for m in get_args(Method) if (cfg.folder / m).is_dir()):
        rows = load(cfg.folder / method, cfg.split, cfg.seed)
        if rows:
            answers[method], content[method] = rows, numbers(rows)
            lines += [f"`{method}`: {_answered_by(rows)}", ""]
            if cfg.rows:
                print("\n".join(line(row) for row in rows))
            if method == "diagnosis":
                lines += tables(rows, content[method])
    if not content:
        raise SystemExit(f"{cfg.folder} holds no answer of {cfg.split}, seed {cfg.seed}. Run run.py first.")
    lines += comparison(answers)
    cfg.output.mkdir(parents=True, exist_ok=True)
    path = cfg.output / f"concealed_{cfg.split}_{cfg.seed}"
    path.with_suffix(".md").write_text("\n".join(lines) + "\n", encoding="utf-8")
    path.with_suffix(".json").write_text(json.dumps(content, indent=1, sort_keys=True) + "\n", encoding="utf-8")
    print("\n".join(lines))


def load(folder: Path, split: Split, seed: int) -> list[Row]:
    """All answers of a split and a seed, each with its case drawn anew; answers to another generator are left out."""
    rows, source = [], source_digest()
    for path in sorted(folder.glob(f"{split}-*-{seed}-*.json")):
        block, index = path.stem.split("-")[1], int(path.stem.split("-")[3])
        result = json.loads(path.read_text(encoding="utf-8"))
        if result["source"] == source:
            rows.append(Row(prepare(split, block, index, seed).case, result))
    return rows


def numbers(rows: Sequence[Row]) -> dict[str, Any]:
    """Every figure of the tables, with the number of cases behind it as ``[value, n]``."""
    of = {block: [r for r in rows if r.case.block == block] for block in {r.case.block for r in rows}}
    single = [r for r in of.get("single", []) + of.get("heldout", []) if r.detectable()]
    quiet = of.get("nothing", []) + of.get("nuisance", [])
    open_set = of.get("outside", []) + of.get("leave_one_out", [])
    bare = of.get("bare", [])
    seen_open = [r for r in open_set if r.detectable()]
    pairs, triples = ([r for r in of.get(b, []) if _all_seen(r)] for b in ("pairs", "triples"))
    return {
        "cases": len(rows),
        "failed": _rate([r.verdict == "failed" for r in rows]),
        "single": {
            "detectable": _rate([r.detectable() for r in of.get("single", [])]),
            "name": _rate([bool(r.findings) and r.names(0, r.findings[:1]) for r in single]),
            "name_or_superset": _rate([bool(r.findings) and r.grade(r.findings[0]) != "wrong" for r in single]),
            "name_among_findings": _rate([r.names(0, r.findings) for r in single]),
            "class": _rate([bool(r.findings) and _same_class(r, r.findings[0]) for r in single]),
            "joint": _rate([bool(r.findings) and _same_joint(r, r.findings[0]) for r in single]),
            "in_answer_set": _rate([r.names(0, r.with_rivals()) for r in single]),
            "wrong_name_over_half": _rate([bool(r.wrong_names()) for r in single]),
            "wrong_name_half_or_more": _rate([bool(r.wrong_names(equal=True)) for r in single]),
            "heldout_excitation": _rate(
                [r.names(0, r.findings[:1]) for r in of.get("heldout", []) if r.detectable() and r.case.truths]
            ),
            "undetectable_wrong_name_over_half": _rate(
                [bool(r.wrong_names()) for r in of.get("single", []) if not r.detectable()]
            ),
            "by_effect": _by(single, lambda r: r.case.truths[0].effect),
            "by_severity": _by(of.get("single", []), lambda r: str(r.case.severity)),
            "by_robot": _by(single, lambda r: r.case.robot),
            "by_mode": _by(single, lambda r: r.case.mode),
            "by_rate": _by(single, lambda r: f"{r.case.rate:g}"),
            "by_ratio": _by_ratio(of.get("single", [])),
            "confusion": _confusion(single),
        },
        "quiet": {
            "false_alarm_nothing": _rate([_alarm(r) for r in of.get("nothing", [])]),
            "false_alarm_nuisance": _rate([_alarm(r) for r in of.get("nuisance", [])]),
            "false_alarm": _rate([_alarm(r) for r in quiet]),
            "verdict_nothing_missing": _rate([r.verdict == "nothing_missing" for r in quiet]),
        },
        "open_set": {
            "outside": _rate([_admitted(r) for r in of.get("outside", []) if r.detectable()]),
            "outside_by_law": _admitted_by_law(of.get("outside", [])),
            "leave_one_out": _rate([_admitted(r) for r in of.get("leave_one_out", []) if r.detectable()]),
            "both": _rate([_admitted(r) for r in seen_open]),
            "superset_or_tolerated": _rate(
                [any(f["probability"] > 0.5 and r.grade(f) != "wrong" for f in r.findings) for r in seen_open]
            ),
            "wrong_name_over_half": _rate([bool(r.wrong_names()) for r in seen_open]),
            "wrong_name_half_or_more": _rate([bool(r.wrong_names(equal=True)) for r in seen_open]),
            "mistaken": [_mistake(r) for r in seen_open if not _admitted(r)],
        },
        "pairs": {
            "both_named": _rate([all(r.names(k, r.findings) for k in range(2)) for r in pairs]),
            "one_named": _rate([any(r.names(k, r.findings) for k in range(2)) for r in pairs]),
            "wrong_name_over_half": _rate([bool(r.wrong_names()) for r in pairs]),
        },
        "triples": {
            "all_named": _rate([all(r.names(k, r.findings) for k in range(3)) for r in triples]),
            "two_named": _rate([sum(r.names(k, r.findings) for k in range(3)) >= 2 for r in triples]),
            "wrong_name_over_half": _rate([bool(r.wrong_names()) for r in triples]),
        },
        "bare": {
            "causes_named": _rate(
                [r.names(k, r.findings) for r in bare for k in range(len(r.case.truths)) if r.detectable(k)]
            ),
            "wrong_among_findings": _rate([r.grade(f) == "wrong" for r in bare for f in r.findings]),
        },
        "unidentifiable": {
            "one_of_the_set_named": _rate([r.names(0, r.findings) for r in of.get("unidentifiable", [])]),
            "truth_itself_in_answer_set": _rate([_exactly_in_set(r) for r in of.get("unidentifiable", [])]),
            "rivals_given": _rate([any(f.get("rivals") for f in r.findings) for r in of.get("unidentifiable", [])]),
        },
        "share_closed_median": _median([_closed(r) for r in single]),
        "parameter_coverage": _coverage(single + pairs),
        "parameter_coverage_by_effect": _coverage_by_effect(single + pairs),
        "calibration": _calibration(rows),
        "seconds": _spread([r.result.get("seconds") for r in rows]),
        "six_joints_over_120_s": _rate([r.result["seconds"] > 120.0 for r in rows if r.result.get("joints") == 6]),
        "megabytes": _spread([r.result.get("megabytes") for r in rows]),
        "seconds_by_joints": {
            str(n): _spread([r.result.get("seconds") for r in rows if r.result.get("joints") == n]) for n in range(1, 7)
        },
    }


def _all_seen(r: Row) -> bool:
    return "visibility" in r.result and all(r.detectable(k) for k in range(len(r.case.truths)))


def _same_class(r: Row, finding: Mapping[str, Any]) -> bool:
    accepted = {t.effect for t in r.case.truths} | {e for alike in r.case.equivalents for e, _ in alike}
    return CLASS_OF.get(finding["effect"]) in {CLASS_OF.get(e) for e in accepted}


def _same_joint(r: Row, finding: Mapping[str, Any]) -> bool:
    return finding["joint"] in {t.joint for t in r.case.truths} | {j for alike in r.case.equivalents for _, j in alike}


def _alarm(r: Row) -> bool:
    """Any name stated above one half, or no answer that says so."""
    return r.verdict in ("explained", "failed") or any(f["probability"] > 0.5 for f in r.findings)


def _admitted(r: Row) -> bool:
    """Says that something is unexplained, and blames nothing wrong."""
    return r.verdict in ("unexplained", "partly_explained") and not r.wrong_names()


def _admitted_by_law(rows: Sequence[Row]) -> dict[str, list[float | int | None]]:
    """Laws that the tuning split has as well, on other robots, and those that only the sealed one has."""
    of = {law: [r for r in rows if r.case.truths[0].effect == law and r.detectable()] for law in sorted(OUTSIDE)}
    known = [r for law in OUTSIDE_TUNING for r in of[law]]
    new = [r for law, found in of.items() if law not in OUTSIDE_TUNING for r in found]
    groups = {"all that tuning has, too": known, "all that it has not": new, **of}
    return {name: _rate([_admitted(r) for r in found]) for name, found in groups.items()}


def _mistake(r: Row) -> dict[str, Any]:
    """What stood in for physics that the catalogue lacks, and how far from the recordings that left the simulation."""
    first = r.findings[0] if r.findings else {"effect": "nothing", "probability": 1.0}
    return {
        "case": r.case.name,
        "concealed": ", ".join(t.effect for t in r.case.truths),
        "said": first["effect"],
        "probability": first["probability"],
        "verdict": r.verdict,
        "over_floor": {split: r.over_floor(split) for split in ("train", "heldout")},
    }


def _exactly_in_set(r: Row) -> bool:
    truth = r.case.truths[0]
    name = truth.effect, truth.joint
    said = r.with_rivals()
    return any(name == (f["effect"], f["joint"]) or (name in _same(f) and _is_same(truth, f["effect"])) for f in said)


def _closed(r: Row) -> float | None:
    score = r.result.get("answer", {}).get("fit", {}).get("heldout")
    return None if score is None else float(score["share_closed"])


def _rate(flags: Sequence[bool]) -> list[float | int | None]:
    return [round(float(np.mean(flags)), 4) if flags else None, len(flags)]


def _median(values: Sequence[float | None]) -> list[float | int | None]:
    known = [v for v in values if v is not None and np.isfinite(v)]
    return [round(float(np.median(known)), 4) if known else None, len(known)]


def _spread(values: Sequence[float | None]) -> dict[str, float | int] | None:
    known = [float(v) for v in values if v is not None]
    if not known:
        return None
    return {"median": round(float(np.median(known)), 1), "largest": round(max(known), 1), "n": len(known)}


def _by(rows: Sequence[Row], key: Callable[[Row], str]) -> dict[str, list[float | int | None]]:
    groups = sorted({key(r) for r in rows})
    return {g: _rate([bool(r.findings) and r.names(0, r.findings[:1]) for r in rows if key(r) == g]) for g in groups}


def _by_ratio(rows: Sequence[Row]) -> dict[str, dict[str, list[float | int | None]]]:
    out = {}
    for low, high in pairwise(RATIOS):
        inside = [r for r in rows if low <= r.result.get("visibility", [0.0])[0] < high]
        out[f"{low:g} to {high:g}"] = {
            "name": _rate([bool(r.findings) and r.names(0, r.findings[:1]) for r in inside]),
            "anything": _rate([r.verdict not in ("nothing_missing", "failed") for r in inside]),
        }
    return out


def _confusion(rows: Sequence[Row]) -> dict[str, dict[str, int]]:
    out: dict[str, Counter[str]] = {}
    for r in rows:
        truth = r.case.truths[0]
        said = "failed" if r.verdict == "failed" else "none"
        if r.findings:
            said = truth.effect if r.names(0, r.findings[:1]) else str(r.findings[0]["effect"])
            if said == truth.effect and not r.names(0, r.findings[:1]):
                said += " (other joint)"
        out.setdefault(truth.effect, Counter())[said] += 1
    return {truth: dict(said.most_common()) for truth, said in sorted(out.items())}


def _intervals(rows: Sequence[Row]) -> list[tuple[str, bool]]:
    out = []
    for r in rows:
        for truth in r.case.truths:
            for f in r.findings:
                for estimate, value in known_parameters(truth, f):
                    low, high = estimate["ci95"]
                    out.append((truth.effect, bool(low <= value <= high)))
    return out


def known_parameters(truth: Truth, finding: Mapping[str, Any]) -> list[tuple[Mapping[str, Any], float]]:
    """Estimates of a right finding's parameters that the key knows, each with the true value; none of another one's.

    Where the sign is a convention that the generator does not know, the true value takes the estimate's.
    """
    if (finding["effect"], finding["joint"]) != (truth.effect, truth.joint):
        return []
    out = []
    for name in sorted(truth.parameters.keys() & finding["parameters"].keys() - {"phase"}):
        estimate, value = finding["parameters"][name], truth.parameters[name]
        out.append((estimate, float(np.copysign(value, estimate["value"])) if truth.effect in UNSIGNED else value))
    return out


def _coverage(rows: Sequence[Row]) -> list[float | int | None]:
    return _rate([held for _, held in _intervals(rows)])


def _coverage_by_effect(rows: Sequence[Row]) -> dict[str, list[float | int | None]]:
    pairs = _intervals(rows)
    return {e: _rate([held for effect, held in pairs if effect == e]) for e in sorted({effect for effect, _ in pairs})}


def _calibration(rows: Sequence[Row]) -> dict[str, Any]:
    """Calibration of every finding of every block."""
    stated = [(float(f["probability"]), r.grade(f) in RIGHT) for r in rows for f in r.findings]
    return reliability(np.array([p for p, _ in stated]), np.array([right for _, right in stated], dtype=bool))


def reliability(stated: NDArray[np.float64], right: NDArray[np.bool_]) -> dict[str, Any]:
    """Expected calibration error over ten bins, and the bins.

    Args:
        stated: Probability of each finding, 0..1. Shape (F,).
        right: Whether it is true. Shape (F,).
    """
    bins, error = [], 0.0
    of = np.minimum((10 * stated).astype(np.int64), 9)
    for inside in (of == k for k in np.unique(of)):
        mean, true = float(stated[inside].mean()), float(right[inside].mean())
        error += float(inside.mean()) * abs(mean - true)
        bins.append({"stated": round(mean, 4), "true": round(true, 4), "n": int(inside.sum())})
    return {"ece": round(error, 4) if len(stated) else None, "n": len(stated), "bins": bins}


def _provenance(cfg: Config) -> str:
    commit = subprocess.run(
        ["git", "rev-parse", "--short", "HEAD"], capture_output=True, text=True, check=False, cwd=Path(__file__).parent
    ).stdout.strip()
    return f"Made by `benchmarks/concealed/score.py` at commit `{commit or 'unknown'}`."


def _answered_by(rows: Sequence[Row]) -> str:
    """Which program answered, and whether it was one."""
    programs = Counter(str(r.result.get("program", "unknown"))[:12] for r in rows)
    learnt = {json.dumps(r.result["calibration"], sort_keys=True) for r in rows if "calibration" in r.result}
    text = ", ".join(f"{n} answers of the program `{name}`" for name, n in programs.most_common())
    return text + (f", **with {len(learnt)} calibrations**." if len(learnt) > 1 else ".")


def _checked_key(cfg: Config) -> str:
    """Check that the key's digest is the committed one, and write the key out.

    Another machine's sine may round a drawn number the other way. There the published key has to have the committed
    digest, and what is drawn to be the same but for rounding.
    """
    key, committed = key_json("sealed", cfg.seed, COUNTS), digest_of(cfg.seed)
    name, digest = f"concealed_key_{cfg.seed}.json", hashlib.sha256(key.encode()).hexdigest()
    if committed in (None, digest):
        cfg.output.mkdir(parents=True, exist_ok=True)
        (cfg.output / name).write_text(key + "\n", encoding="utf-8")
        if committed is None:
            return f"**No digest was committed before the run**; the key's is `{digest}`."
        return f"The key (`{name}`) has the digest that was committed before the run, `{digest}`."
    published = (RESULTS / name).read_text(encoding="utf-8").strip() if (RESULTS / name).exists() else "null"
    is_published = hashlib.sha256(published.encode()).hexdigest() == committed
    if not is_published or not same_but_rounding(json.loads(key), json.loads(published)):
        raise SystemExit(
            f"The key of seed {cfg.seed} has the digest {digest} now, {committed} was committed: cases or generator "
            "have changed since. Score it at the commit that ran it, or seal another seed."
        )
    return (
        f"The key (`{name}`) has the digest that was committed before the run, `{committed}`; what is drawn here "
        "differs from it by rounding alone."
    )


def same_but_rounding(drawn: object, published: object) -> bool:
    """Whether two keys, as read from JSON, are equal, numbers within 1e-12 of their size."""
    if isinstance(drawn, float) and isinstance(published, float):
        return math.isclose(drawn, published, rel_tol=1e-12)
    if isinstance(drawn, dict) and isinstance(published, dict):
        return drawn.keys() == published.keys() and all(same_but_rounding(v, published[k]) for k, v in drawn.items())
    if isinstance(drawn, list) and isinstance(published, list):
        return len(drawn) == len(published) and all(map(same_but_rounding, drawn, published))
    return drawn == published


def line(row: Row) -> str:
    """One case for the terminal."""
    truths = ", ".join(f"{t.effect}@{t.joint}" for t in row.case.truths) or "-"
    seen = ", ".join(f"{v:.1f}" for v in row.result.get("visibility", []))
    said = ", ".join(f"{f['effect']}@{f['joint']} {f['probability']:.2f} {row.grade(f)}" for f in row.findings)
    return (
        f"{row.case.block:14} {row.case.index:4d} {row.case.robot:9} {row.case.mode[:3]} {row.case.rate:5g} "
        f"s{row.case.severity:2d} [{seen:>8}] {truths:44} -> {row.verdict:16} {said} "
        f"{str(row.result.get('error', ''))[-100:]}"
    ).replace("\n", " ")


def _show(value: list[float | int | None]) -> str:
    rate, n = value
    return "-" if rate is None else f"{rate:.3f} ({n})"


def tables(rows: Sequence[Row], n: Mapping[str, Any]) -> list[str]:
    """The tables of the diagnosis, with the targets beside them."""
    s, quiet, open_set, cal = n["single"], n["quiet"], n["open_set"], n["calibration"]
    wanted = [
        ("single, detectable: name", s["name"], "0.90"),
        ("... or a name that holds it as a special case", s["name_or_superset"], ""),
        ("... name among the findings", s["name_among_findings"], ""),
        ("... class", s["class"], "0.95"),
        ("... joint", s["joint"], "0.98"),
        ("... wrong name over 0.5", s["wrong_name_over_half"], "0.02 or less"),
        ("... wrong name with 0.5 or more", s["wrong_name_half_or_more"], ""),
        ("... of them another excitation was kept aside: name", s["heldout_excitation"], ""),
        ("below the limit: wrong name over 0.5", s["undetectable_wrong_name_over_half"], ""),
        ("false alarms: nothing missing", quiet["false_alarm_nothing"], ""),
        ("false alarms: nuisance only", quiet["false_alarm_nuisance"], ""),
        ("false alarms: both", quiet["false_alarm"], "0.02 or less"),
        ("outside the catalogue: said so", open_set["outside"], ""),
        ("leave one out: said so", open_set["leave_one_out"], ""),
        ("both: said so, no wrong name", open_set["both"], "0.90"),
        ("both: wrong name over 0.5", open_set["wrong_name_over_half"], ""),
        ("both: wrong name with 0.5 or more", open_set["wrong_name_half_or_more"], ""),
        ("both: stated a superset or a part", open_set["superset_or_tolerated"], ""),
        ("two effects, both named with their joints", n["pairs"]["both_named"], "0.80"),
        ("three effects, all named", n["triples"]["all_named"], ""),
        ("three effects, at least two named", n["triples"]["two_named"], ""),
        ("bare models: detectable causes named with their joints", n["bare"]["causes_named"], ""),
        ("bare models: findings that are wrong", n["bare"]["wrong_among_findings"], ""),
        ("answer set holds the truth: single", s["in_answer_set"], "0.95"),
        ("answer set holds the truth: unidentifiable", n["unidentifiable"]["truth_itself_in_answer_set"], "0.95"),
        ("unidentifiable: one of the set named", n["unidentifiable"]["one_of_the_set_named"], ""),
        ("held-out gap closed, median", n["share_closed_median"], "0.90"),
        ("parameter intervals hold the truth", n["parameter_coverage"], "0.90 to 0.98"),
        ("six joints: longer than 120 s", n["six_joints_over_120_s"], ""),
        ("failed", n["failed"], ""),
    ]
    out = ["| figure | value (cases) | target |", "|---|---|---|"]
    out += [f"| {name} | {_show(value)} | {target} |" for name, value, target in wanted]
    out += [f"| expected calibration error | {cal['ece']} ({cal['n']} findings) | 0.05 or less |", ""]
    out += ["| stated probability | true | findings |", "|---|---|---|"]
    out += [f"| {b['stated']:.2f} | {b['true']:.2f} | {b['n']} |" for b in cal["bins"]]
    out += ["", "| visibility (effect over noise) | named | anything stated |", "|---|---|---|"]
    out += [f"| {k} | {_show(v['name'])} | {_show(v['anything'])} |" for k, v in s["by_ratio"].items()]
    for title, key in (("effect", "by_effect"), ("robot", "by_robot"), ("mode", "by_mode"), ("rate [Hz]", "by_rate"),
                       ("severity, all", "by_severity")):  # fmt: skip
        out += ["", f"| {title} | named |", "|---|---|"]
        out += [f"| {k} | {_show(v)} |" for k, v in s[key].items()]
    out += ["", "| truth (single, detectable) | stated first |", "|---|---|"]
    out += [f"| {k} | {', '.join(f'{e} {c}' for e, c in v.items())} |" for k, v in s["confusion"].items()]
    out += ["", "| effect | parameter intervals hold the truth |", "|---|---|"]
    out += [f"| {k} | {_show(v)} |" for k, v in n["parameter_coverage_by_effect"].items()]
    out += ["", "| law outside the catalogue | said so |", "|---|---|"]
    out += [f"| {k} | {_show(v)} |" for k, v in open_set["outside_by_law"].items()]
    out += ["", *_mistaken(open_set["mistaken"])]
    out += ["", "| joints | median time [s] | largest [s] | cases |", "|---|---|---|---|"]
    out += [f"| {k} | {v['median']} | {v['largest']} | {v['n']} |" for k, v in n["seconds_by_joints"].items() if v]
    if n["megabytes"]:
        out += ["", f"Peak memory: median {n['megabytes']['median']} MB, largest {n['megabytes']['largest']} MB."]
    return [*out, ""]


def _mistaken(cases: Sequence[Mapping[str, Any]]) -> list[str]:
    """Detectable physics outside the catalogue that is not said to be unexplained, and what the stand-in leaves."""
    out = ["| not in the catalogue | taken for | probability | verdict | error over the floor, fitted | kept aside |"]
    out += ["|---|---|---|---|---|---|"]
    for m in sorted(cases, key=lambda m: m["over_floor"]["heldout"] or 0.0):
        left = " | ".join("-" if (x := m["over_floor"][part]) is None else f"{x:.1f}" for part in ("train", "heldout"))
        cells = m["concealed"], m["said"], f"{m['probability']:.2f}", m["verdict"]
        out.append(f"| {' | '.join(cells)} | {left} |")
    return out if cases else []


def comparison(answers: Mapping[str, Sequence[Row]]) -> list[str]:
    """All methods side by side, the diagnosis once more on the cases of each other one."""
    of = dict(answers)
    for method, rows in answers.items() if "diagnosis" in answers else ():
        cases = {r.case.name for r in rows} & {r.case.name for r in answers["diagnosis"]}
        if method != "diagnosis":
            of[method] = [r for r in rows if r.case.name in cases]
            of[f"diagnosis, cases of {method}"] = [r for r in answers["diagnosis"] if r.case.name in cases]
    out = ["| method | single: name | class | joint | wrong over 0.5 | false alarms | outside, left out | pairs | "
           "held-out gap closed | s |", "|---|---|---|---|---|---|---|---|---|---|"]  # fmt: skip
    for method, rows in of.items():
        n = numbers(rows)
        s = n["single"]
        cells = [s["name"], s["class"], s["joint"], s["wrong_name_over_half"], n["quiet"]["false_alarm"],
                 n["open_set"]["both"], n["pairs"]["both_named"], n["share_closed_median"]]  # fmt: skip
        seconds = n["seconds"]["median"] if n["seconds"] else "-"
        out.append(f"| {method} | {' | '.join(_show(c) for c in cells)} | {seconds} |")
    return out


if __name__ == "__main__":
    main(tyro.cli(Config))
