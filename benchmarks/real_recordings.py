"""What a diagnosis says of five real robots, and how much of the gap it closes on recordings that it never fitted.

    ATHLETIC_DATA=... python benchmarks/real_recordings.py

A quarter of an hour on two cores. Prints the table and writes it to ``--output``; a data set that is there already is
replaced, the others stay. The reports go to ``--reports``.
"""

from __future__ import annotations

import sys
import time
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import tyro
from numpy.typing import NDArray

sys.path.append(str(Path(__file__).parents[1]))

from benchmarks.by_case import Row, run_cases
from torchrl_athletic.diagnosis import Diagnosis, diagnose
from torchrl_athletic.diagnosis.report import summary_figure
from torchrl_athletic.recordings import Recording
from torchrl_athletic.recordings.datasets import load_dataset


@dataclass(frozen=True)
class Config:
    """Every field is a flag."""

    cases: tuple[str, ...] = ("emps", "two_link_arm:measured", "two_link_arm", "unbalanced_disk", "pendulum", "xl330")
    """Data sets; ``:measured`` drives the simulation with the measured torque."""
    seed: int = 0
    output: Path = Path("benchmarks/results/real_recordings.md")
    reports: Path | None = Path("out/real")
    """Where pages and pictures go; None for none, without matplotlib."""


def main(cfg: Config) -> None:
    run_cases(cfg.cases, lambda case: run(case, cfg), table, cfg.output)


def run(case: str, cfg: Config) -> Row:
    """Diagnose one data set and score it on the recordings kept aside."""
    name, _, drive = case.partition(":")
    data = load_dataset(name)
    begin = time.monotonic()
    folder = None if cfg.reports is None else cfg.reports / case.replace(":", "_")
    diagnosis = diagnose(
        data.model,
        data.recordings,
        data.heldout,
        drive="measured" if drive else "command",
        seed=cfg.seed,
        output=folder,
    )
    seconds = time.monotonic() - begin
    if folder is not None:
        summary_figure(diagnosis.answer, diagnosis.maps, diagnosis.overlays).savefig(folder / "summary.png", dpi=150)
    heldout = [r.driven_by_measured_torque() if drive else r for r in data.heldout]
    what, before, after = METRICS[name](diagnosis, heldout)
    answer = diagnosis.answer
    named = [
        f"`{f.effect}` {f.joint} ({f.probability:.0%}): "
        + ", ".join(f"{p} {e.value:.3g} {'' if e.unit == '1' else e.unit}".rstrip() for p, e in f.parameters.items())
        + "".join(f"; or `{r.effect}` ({r.probability:.0%})" for r in f.rivals)
        for f in answer.findings
    ]
    score = answer.fit["heldout"]
    return {
        "verdict": answer.verdict,
        "named": named,
        "metric": what,
        "before": before,
        "after": after,
        "closed": f"{score.share_closed:.0%}",
        "unexplained": f"{answer.unexplained_share:.0%}",
        "remarks": list(answer.remarks),
        "seconds": round(seconds),
    }


def table(rows: Mapping[str, Row]) -> str:
    """The results as Markdown."""
    lines = [
        "Made by `python benchmarks/real_recordings.py`. Errors are on recordings kept aside. "
        "The machine was shared: times are upper bounds.",
        "",
        "| data set | verdict | named | error | given model | corrected | gap closed | unexplained | time | commit |",
        "|---|---|---|---|---|---|---|---|---|---|",
    ]
    for case, r in rows.items():
        named = "<br>".join(r["named"]) if isinstance(r["named"], list) else ""
        lines.append(
            f"| {case} | {r['verdict']} | {named} | {r['metric']} | {r['before']} | {r['after']} | {r['closed']} | "
            f"{r['unexplained']} | {r['seconds']} s | {r['commit']} |"
        )
    remarks = [f"- {case}: {text}" for case, r in rows.items() for text in _texts(r["remarks"])]
    return "\n".join([*lines, "", *remarks]).rstrip() + "\n"


def open_loop(unit: float, name: str) -> Callable[[Diagnosis, list[Recording]], tuple[str, str, str]]:
    """RMSE of one rollout over each whole take."""

    def metric(diagnosis: Diagnosis, heldout: list[Recording]) -> tuple[str, str, str]:
        before, after = (
            np.sqrt(np.concatenate([(s.rollout(r, None) - r.position) ** 2 for r in heldout]).mean())
            for s in (diagnosis.nominal, diagnosis.corrected)
        )
        return f"whole take, RMSE [{name}]", f"{unit * before:.3g}", f"{unit * after:.3g}"

    return metric


def windows(diagnosis: Diagnosis, heldout: list[Recording]) -> tuple[str, str, str]:
    """Median over 0.5 s windows of the RMSE of each joint."""

    def medians(simulation: str) -> str:
        each = [_windows(getattr(diagnosis, simulation).rollout(r), r) for r in heldout]
        return " / ".join(f"{x:.3f}" for x in np.median(np.concatenate(each), axis=0))

    return "median 0.5 s window, RMSE [rad]", medians("nominal"), medians("corrected")


def mean_absolute(diagnosis: Diagnosis, heldout: list[Recording]) -> tuple[str, str, str]:
    """Mean absolute error of closed-loop rollouts over whole takes."""
    before, after = (
        np.concatenate([np.abs(s.rollout(r, None) - r.position) for r in heldout]).mean()
        for s in (diagnosis.nominal, diagnosis.corrected)
    )
    return "whole take, closed loop, MAE [rad]", f"{before:.4f}", f"{after:.4f}"


def _windows(predicted: NDArray[np.float64], r: Recording, seconds: float = 0.5) -> NDArray[np.float64]:
    size = round(seconds * r.rate)
    error = (predicted - r.position)[: len(r.time) // size * size] ** 2
    return np.asarray(np.sqrt(error.reshape(-1, size, r.num_joints).mean(1)))


METRICS = {
    "emps": open_loop(1e3, "mm"),
    "two_link_arm": windows,
    "unbalanced_disk": open_loop(1.0, "rad"),
    "pendulum": windows,
    "xl330": mean_absolute,
}


def _texts(value: object) -> list[str]:
    return [str(text) for text in value] if isinstance(value, list) else []


if __name__ == "__main__":
    main(tyro.cli(Config))
