"""Tables and picture of the documentation from the examination that the shipped controller carries in its file.

python benchmarks/wbc_tables.py
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import tyro

from torchrl_athletic.networks import describe
from torchrl_athletic.recordings.whole_file import whole_file
from torchrl_athletic.training import draw_conditions, table_of

TARGETS = {
    "falls": ("falls", 0.02, "{:.1%}"),
    "keypoints": ("hand, mean of the four key points", 0.06, "{:.3f} m"),
    "attitude": ("hand, attitude", 0.15, "{:.3f} rad"),
    "velocity": ("planar velocity", 0.15, "{:.3f} m/s"),
    "yaw_rate": ("yaw rate", 0.15, "{:.3f} rad/s"),
}
"""Words, bound and unit of each figure that is asked for."""
ALL = "all randomised"
FINER = ("all randomised, 1 ms steps", "all randomised, elliptic cones")


@dataclass(frozen=True)
class Config:
    """Every field is a flag."""

    output: Path = Path("benchmarks/results")
    pictures: Path = Path("docs/images")


def main(cfg: Config) -> None:
    told = describe("wbc")
    results: dict[str, Any] = told["evaluation"]
    made = f"Trained on {told['machine']}: `{told['trained_with']}`. {told['evaluated_with']}"
    for name, text in (("wbc_targets", targets(results)), ("wbc_evaluation", table_of(results))):
        with whole_file(cfg.output / f"{name}.md") as part:
            part.write_text(f"{text}\n\n{made}\n" if name == "wbc_evaluation" else f"{text}\n", encoding="utf-8")
    print(targets(results))
    print("picture:", draw_conditions(results, cfg.pictures / "wbc_evaluation.svg"))


def targets(results: Mapping[str, Mapping[str, Any]]) -> str:
    """What is asked for beside what was measured, there and in finer simulations."""
    lines = ["| figure | measured | asked | | 1 ms steps | elliptic cones |", "|---|---|---|---|---|---|"]
    for key, (words, bound, unit) in TARGETS.items():
        value, *others = (results[name][key][0] for name in (ALL, *FINER))
        verdict = "met" if value < bound else "missed"
        shown = [unit.format(number) for number in (value, bound, *others)]
        lines.append(f"| {words} | {shown[0]} | under {shown[1]} | {verdict} | {shown[2]} | {shown[3]} |")
    return "\n".join(lines)


if __name__ == "__main__":
    main(tyro.cli(Config, description=__doc__))
