"""How long a whole diagnosis takes, and how much memory, against the length of the recordings and the robot.

    python benchmarks/diagnosis_time.py

Fifteen minutes on two cores. Recordings are those of concealed arms with six joints at 200 Hz, of 1 to 60 minutes, and
of the demo's two joints. Each row is a process of its own, so that its peak memory is its own. Prints the table and
writes it to ``--output``.
"""

from __future__ import annotations

import json
import os
import platform
import subprocess
import sys
import tempfile
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TypeAlias

import numpy as np
import tyro
from tqdm import tqdm

sys.path.append(str(Path(__file__).parents[1]))

from benchmarks.concealed.cases import Session, prepare, record
from torchrl_athletic.recordings import Recording, resample, write_recording
from torchrl_athletic.recordings.demo import concealed_demo

Row: TypeAlias = tuple[str, str, Sequence[Recording], Sequence[Recording], dict[str, float]]
SEED = 20261121
"""One seed of the sealed cases that were scored before; their truths are known."""
DIAGNOSE = """
import json, resource, sys, time
from pathlib import Path
from torchrl_athletic.diagnosis import diagnose
from torchrl_athletic.recordings import read_recordings
folder = Path(sys.argv[1])
fit, aside = read_recordings(folder / "fit"), read_recordings(folder / "aside")
begin, cpu = time.monotonic(), time.process_time()
answer = diagnose((folder / "model.xml").read_text(), fit, aside, **json.loads(sys.argv[2])).answer
print(json.dumps({
    "recorded": sum(r.duration for r in (*fit, *aside)),
    "seconds": time.monotonic() - begin,
    "cpu": time.process_time() - cpu,
    "megabytes": resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024,
    "said": ", ".join(f.effect for f in answer.findings[:3]) or answer.verdict,
    "stage": answer.stage,
}))
"""


@dataclass(frozen=True)
class Config:
    """Every field is a flag."""

    cases: tuple[int, ...] = (56, 158)
    """Indices of single concealed effects on six joints: dry friction under torques, a tilt under position targets."""
    lengths: tuple[float, ...] = (1.0, 3.0, 10.0, 30.0, 60.0)
    """Lengths of the log of the first case [min]."""
    budgets: tuple[float, ...] = (10.0, 20.0)
    """Budgets of time for the first case [s]."""
    minutes: float = 20.0
    """Length of a long log at 1 kHz, the demo's takes one after the other [min]."""
    memory: float = 1.5
    """That it may take [GB]."""
    output: Path = Path("benchmarks/results/diagnosis_time.md")


def main(cfg: Config) -> None:
    made = concealed_demo(seed=1, duration=30.0)
    rows: list[Row] = [("2 joints, the demo", made.model_xml, list(made.recordings), list(made.heldout), {})]
    long = [at_1_khz(r, cfg.minutes / len(made.recordings)) for r in made.recordings]
    rows.append(
        (
            f"2 joints, 1 kHz, {cfg.memory:g} GB allowed",
            made.model_xml,
            long,
            list(made.heldout),
            {"memory": cfg.memory},
        )
    )
    for k, index in enumerate(cfg.cases):
        session = prepare("sealed", "single", index, SEED)
        case, (fit, aside) = session.case, record(session)
        what = (
            f"{session.robot.joints} joints, {case.truths[0].effect.replace('_', ' ')}, {case.mode.replace('_', ' ')}"
        )
        logs = [of_length(session, minutes) for minutes in cfg.lengths] if k == 0 else [fit]
        rows.extend((what, session.model_xml, log, aside, {}) for log in logs)
        for budget in cfg.budgets if k == 0 else ():
            told = f"the same, {budget:g} s allowed"
            rows.append((told, session.model_xml, fit, aside, {"time_budget": budget}))
    lines = [
        *header(),
        *(line(what, measure(xml, fit, aside, asked)) for what, xml, fit, aside, asked in tqdm(rows, unit="diagnosis")),
    ]
    cfg.output.parent.mkdir(parents=True, exist_ok=True)
    cfg.output.write_text("\n".join(lines) + "\n", encoding="utf-8")
    print("\n".join(lines))


def of_length(session: Session, minutes: float) -> list[Recording]:
    """The takes of a session over and over, the noise drawn anew, each cut so that they last as long as asked."""
    takes: list[Recording] = []
    while sum(take.duration for take in takes) < 60 * minutes:
        case = replace(session.case, seed=session.case.seed + len(takes))
        takes += record(replace(session, case=case))[0]
    share = 60 * minutes / sum(take.duration for take in takes)
    return [take.slice(0, round(share * take.num_samples)) for take in takes]


def at_1_khz(recording: Recording, minutes: float) -> Recording:
    """A take over and over, to and fro, on a grid of 1 ms: only its size counts, since nothing moves backwards so."""
    fine = resample(recording, 1e-3)
    size, count = fine.num_samples, int(60e3 * minutes)
    there = np.arange(count) % (2 * size - 2)
    at = np.where(there < size, there, 2 * size - 2 - there)
    time = np.arange(count, dtype=np.float64) / 1e3
    return Recording(
        time, fine.joint_names, fine.position[at], torque_command=fine.command[at], source=f"long {recording.source}"
    )


def measure(
    xml: str, fit: Sequence[Recording], aside: Sequence[Recording], asked: dict[str, float]
) -> dict[str, float | str]:
    """One diagnosis in a process of its own."""
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        (folder / "model.xml").write_text(xml, encoding="utf-8")
        for part, takes in (("fit", fit), ("aside", aside)):
            (folder / part).mkdir()
            for k, take in enumerate(takes):
                write_recording(take, folder / part / f"{k}.npz")
        command = [sys.executable, "-c", DIAGNOSE, name, json.dumps(asked)]
        environment = {**os.environ, "OMP_NUM_THREADS": "1"}
        run = subprocess.run(command, env=environment, stdout=subprocess.PIPE, text=True, check=True)
    row: dict[str, float | str] = json.loads(run.stdout.splitlines()[-1])
    return row


def header() -> list[str]:
    """Who made the table, and its first lines."""
    head = subprocess.run(["git", "rev-parse", "--short", "HEAD"], capture_output=True, text=True, check=False).stdout
    commit = head.strip() or os.environ.get("COMMIT", "unknown")
    return [
        f"Made by `python benchmarks/diagnosis_time.py` at {commit} on {platform.machine()}, {os.cpu_count()} "
        "cores, shared: CPU time is the steadier column. Whole diagnosis without the report, 200 Hz.",
        "",
        "| robot and what is concealed | recorded | time | CPU time | CPU time a recorded second | memory | said |",
        "|---|---|---|---|---|---|---|",
    ]


def line(what: str, row: dict[str, float | str]) -> str:
    """A line of the table."""
    recorded, cpu = float(row["recorded"]), float(row["cpu"])
    said = row["said"] if row["stage"] == "deliver" else f"stopped in `{row['stage']}`: {row['said']}"
    return (
        f"| {what} | {recorded:.0f} s | {float(row['seconds']):.0f} s | {cpu:.0f} s | {cpu / recorded:.2f} s | "
        f"{float(row['megabytes']):.0f} MB | {said} |"
    )


if __name__ == "__main__":
    main(tyro.cli(Config))
