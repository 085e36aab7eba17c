"""How often the diagnosis names what the demo hides, with what error, and how long that takes.

    python benchmarks/concealed_demo.py --seeds 20

Each seed draws an effect, its joint and its severity, records a two-link arm by an integrator that is not MuJoCo, and
is diagnosed in a process of its own, so that its peak memory can be told. Twenty take ten minutes on two cores. Prints
the table and writes it to ``--output``.
"""

from __future__ import annotations

import json
import os
import platform
import resource
import subprocess
import sys
import time
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import tyro

from torchrl_athletic.diagnosis import diagnose
from torchrl_athletic.recordings.demo import concealed_demo


@dataclass(frozen=True)
class Config:
    """Every field is a flag."""

    seeds: int = 20
    first: int = 0
    jobs: int = 2
    """Processes at a time."""
    output: Path = Path("benchmarks/results/concealed_demo.md")
    case: int | None = None
    """Diagnose this seed alone and print its row as JSON: what the benchmark starts for each seed."""


def main(cfg: Config) -> None:
    if cfg.case is not None:
        print(json.dumps(run(cfg.case)))
        return
    rows = []
    with ThreadPoolExecutor(cfg.jobs) as pool:
        for row in pool.map(in_own_process, range(cfg.first, cfg.first + cfg.seeds)):
            rows.append(row)
            cfg.output.parent.mkdir(parents=True, exist_ok=True)
            cfg.output.write_text(table(rows, cfg), encoding="utf-8")
            print(table([row], cfg).splitlines()[-1], flush=True)
    print(table(rows, cfg))


def in_own_process(seed: int) -> dict[str, Any]:
    """One row, from a fresh interpreter."""
    done = subprocess.run(
        [sys.executable, __file__, "--case", str(seed)], capture_output=True, text=True, check=False,
        env={**os.environ, "OMP_NUM_THREADS": "1"},
    )  # fmt: skip
    if done.returncode:
        raise RuntimeError(f"seed {seed}: the diagnosis failed.\n{done.stderr}")
    row: dict[str, Any] = json.loads(done.stdout.splitlines()[-1])
    return row


def run(seed: int) -> dict[str, Any]:
    """Diagnose one concealed robot, and compare the answer with the secret."""
    demo = concealed_demo(seed)
    begin = time.monotonic()
    answer = diagnose(demo.model_xml, demo.recordings, demo.heldout, seed=0).answer
    seconds = time.monotonic() - begin
    secret = demo.secret
    first = answer.findings[0] if answer.findings else None
    named = first is not None and first.effect == secret.name
    right = next((f for f in answer.findings if (f.effect, f.joint) == (secret.name, secret.joint)), None)
    errors, covered = [], []
    for name, true in secret.parameters.items() if right else ():
        assert right is not None
        estimate = right.parameters[name]
        errors.append(abs(estimate.value / true - 1))
        covered.append(estimate.ci95[0] <= true <= estimate.ci95[1])
    return {
        "seed": seed,
        "secret": f"`{secret.name}` {secret.joint}",
        "answer": [f"`{f.effect}` {f.joint}" for f in answer.findings],
        "rivals": [f"`{r.effect}` {r.joint} ({r.probability:.0%})" for f in answer.findings for r in f.rivals],
        "name": named,
        "joint": first is not None and first.joint == secret.joint,
        "alone": len(answer.findings) == 1,
        "in_answer_set": right is not None
        or any((r.effect, r.joint) == (secret.name, secret.joint) for f in answer.findings for r in f.rivals),
        "error": max(errors, default=None),
        "covered": sum(covered),
        "intervals": len(covered),
        "verdict": answer.verdict,
        "probability": first.probability if first else None,
        "seconds": seconds,
        "memory": resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 2**20,  # kilobytes on Linux
    }


def table(rows: list[dict[str, Any]], cfg: Config) -> str:
    """The results as Markdown."""
    both = [r for r in rows if r["name"] and r["joint"]]
    errors = [r["error"] for r in both if r["error"] is not None]
    covered, intervals = (sum(r[k] for r in both) for k in ("covered", "intervals"))
    count, seconds = len(rows), [r["seconds"] for r in rows]
    lines = [
        f"Made by `python benchmarks/concealed_demo.py --seeds {cfg.seeds} --first {cfg.first}` at commit {_commit()} "
        f"on {platform.machine()}, {os.cpu_count()} cores. The machine was shared: times are upper bounds.",
        "",
        f"- right name and joint first: {len(both)} of {count}; nothing else named: {sum(r['alone'] for r in both)}; "
        f"truth in the answer set: {sum(r['in_answer_set'] for r in rows)}",
        f"- largest relative error of a parameter: median {np.median(errors):.1%}, worst {max(errors):.1%}; "
        f"within 10 %: {sum(e < 0.1 for e in errors)} of {len(errors)}"
        if errors
        else "- no parameter to compare",
        f"- 95 % intervals that hold the truth: {covered} of {intervals}",
        f"- verdict explained: {sum(r['verdict'] == 'explained' for r in rows)} of {count}",
        f"- time: median {np.median(seconds):.0f} s, worst {max(seconds):.0f} s; "
        f"peak memory {max(r['memory'] for r in rows):.2f} GiB",
        "",
        "| seed | hidden | named | rivals | parameter error | intervals | verdict | probability | time | memory |",
        "|---|---|---|---|---|---|---|---|---|---|",
    ]
    for r in rows:
        error = "" if r["error"] is None else f"{r['error']:.1%}"
        probability = "" if r["probability"] is None else f"{r['probability']:.2f}"
        lines.append(
            f"| {r['seed']} | {r['secret']} | {'<br>'.join(r['answer'])} | {'<br>'.join(r['rivals'])} | {error} | "
            f"{r['covered']}/{r['intervals']} | {r['verdict']} | {probability} | {r['seconds']:.0f} s | "
            f"{r['memory']:.2f} GiB |"
        )
    return "\n".join(lines) + "\n"


def _commit() -> str:
    done = subprocess.run(["git", "rev-parse", "--short", "HEAD"], capture_output=True, text=True, check=False)
    return done.stdout.strip() or "unknown"


if __name__ == "__main__":
    main(tyro.cli(Config))
