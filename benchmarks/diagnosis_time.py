"""How long a whole diagnosis takes, and how much memory, against the length of the recordings.

    python benchmarks/diagnosis_time.py

Five minutes on two cores. Each length is a process of its own, so that its peak memory is its own. Prints the table and
writes it to ``--output``.
"""

from __future__ import annotations

import json
import os
import platform
import subprocess
import sys
from dataclasses import dataclass
from pathlib import Path

import tyro

CASE = """
import json, resource, sys, time
from torchrl_athletic.diagnosis import diagnose
from torchrl_athletic.recordings.demo import concealed_demo
demo = concealed_demo(seed=int(sys.argv[1]), duration=float(sys.argv[2]))
begin, cpu = time.monotonic(), time.process_time()
answer = diagnose(demo.model_xml, demo.recordings, demo.heldout).answer
print(json.dumps({
    "recorded": sum(r.duration for r in (*demo.recordings, *demo.heldout)),
    "seconds": time.monotonic() - begin,
    "cpu": time.process_time() - cpu,
    "megabytes": resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024,
    "named": answer.findings[0].effect == demo.secret.name if answer.findings else False,
}))
"""


@dataclass(frozen=True)
class Config:
    """Every field is a flag."""

    durations: tuple[float, ...] = (7.5, 15.0, 30.0, 60.0)
    """Of each of the demo's five takes [s]."""
    seed: int = 1
    """Of the demo."""
    output: Path = Path("benchmarks/results/diagnosis_time.md")


def main(cfg: Config) -> None:
    rows = []
    for duration in cfg.durations:
        run = subprocess.run(
            [sys.executable, "-c", CASE, str(cfg.seed), str(duration)],
            env={**os.environ, "OMP_NUM_THREADS": "1"},
            capture_output=True,
            text=True,
            check=True,
        )
        rows.append(json.loads(run.stdout.splitlines()[-1]))
        print(rows[-1])
    commit = subprocess.run(["git", "rev-parse", "--short", "HEAD"], capture_output=True, text=True, check=False).stdout
    lines = [
        f"Made by `python benchmarks/diagnosis_time.py` at {commit.strip()} on {platform.machine()}, {os.cpu_count()} "
        "cores, shared: CPU time is the steadier column. Two joints, 200 Hz, whole diagnosis without the report.",
        "",
        "| recorded | time | CPU time | CPU time per recorded second | peak memory | right name |",
        "|---|---|---|---|---|---|",
    ]
    for r in rows:
        lines.append(
            f"| {r['recorded']:.0f} s | {r['seconds']:.0f} s | {r['cpu']:.0f} s | {r['cpu'] / r['recorded']:.2f} s | "
            f"{r['megabytes']:.0f} MB | {'yes' if r['named'] else 'no'} |"
        )
    cfg.output.parent.mkdir(parents=True, exist_ok=True)
    cfg.output.write_text("\n".join(lines) + "\n")
    print(cfg.output.read_text())


if __name__ == "__main__":
    main(tyro.cli(Config))
