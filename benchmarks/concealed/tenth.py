"""A tenth of the proof's quick cases, for every change of the code.

    python benchmarks/concealed/tenth.py --jobs 2
    python benchmarks/concealed/tenth.py --jobs 2 --write      # after a change that is meant

One joint, sent torques, block by block of the tuning split: one to two minutes on two cores. So few cases have no rates
worth a limit, so that each is held against its committed answer: every name that comes or goes and every probability
that moves is shown. Fails where a case has no answer, where a block has no case, and where more than one case has
become worse.
"""

from __future__ import annotations

import json
import os
import sys
import time
from collections.abc import Mapping, Sequence
from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass
from itertools import islice
from multiprocessing import get_context
from pathlib import Path
from typing import Any

import numpy as np
import tyro
from tqdm import tqdm

sys.path.append(str(Path(__file__).parents[2]))

from benchmarks.concealed.cases import _choose, beyond_nuisance, generator, prepare, record, visibility
from benchmarks.concealed.run import COUNTS, _pin
from benchmarks.concealed.score import RIGHT, Row, _admitted, line
from torchrl_athletic.diagnosis import diagnose
from torchrl_athletic.diagnosis.corrected import write_json
from torchrl_athletic.effects import CATALOGUE

TABLE = Path(__file__).parents[1] / "results" / "concealed_tenth.json"
ONE_JOINT = ("lift", "flap")
"""Robots of the tuning split."""
TRIED = ("single", "heldout", "nothing", "nuisance", "outside", "leave_one_out")
"""Blocks."""
SEVERE = 2
FASTEST = 200.0
"""[Hz] of the logs; faster ones take three times as long."""
TORQUES = "torque_command"
MOVED = 0.2
"""Change of a probability that is shown."""
WORSE = 1
"""Cases that may become worse: another processor's rounding may turn one that was close."""


@dataclass(frozen=True)
class Config:
    """Every field is a flag."""

    jobs: int = 2
    """Processes at a time, each on one core."""
    every: int = 10
    """One of so many quick cases is run: 10 is a tenth."""
    write: bool = False
    """Keep the answers as those to compare with."""


def main(cfg: Config) -> None:
    wanted = chosen(cfg.every)
    os.environ["OMP_NUM_THREADS"] = "1"  # of the processes to come
    context = get_context("spawn")
    with ProcessPoolExecutor(cfg.jobs, context, _pin, (context.Value("i", 0),)) as pool:
        results = list(tqdm(pool.map(answered, *zip(*wanted, strict=True)), total=len(wanted), unit="case"))
    rows = [Row(prepare("tuning", *case).case, result) for case, result in zip(wanted, results, strict=True)]
    print("\n".join(f"{line(row)} {result['seconds']:.0f} s" for row, result in zip(rows, results, strict=True)))
    print(f"{sum(r['seconds'] for r in results):.0f} s of processors")
    if cfg.write:
        write_json(TABLE, {"cases": {row.case.name: kept(row) for row in rows}})
    told, broken = compared(rows, json.loads(TABLE.read_text(encoding="utf-8"))["cases"])
    print("\n".join([f"{len(told)} answers have changed", *told]))
    if broken:
        sys.exit("\n".join(["The proof got worse:", *broken]))


def chosen(every: int) -> list[tuple[str, int]]:
    """One of so many quick cases of each block, the same at every call.

    Quick are those of one joint that is sent torques: a servo has to be asked for its torque at every physics step.
    Of single effects only the severe ones are taken, since those below the detection limit hold no rate.
    """
    out = []
    for block in TRIED:
        count = COUNTS[block]
        drawn = [_choose("tuning", block, k, generator("tuning", block, k, 0)) for k in range(count)]
        quick = [k for k, (_, robot, mode, _) in enumerate(drawn) if (robot in ONE_JOINT and mode == TORQUES)]
        severe = [k for k in quick if block != "single" or drawn[k][3] >= SEVERE]
        shuffled = (int(k) for k in np.random.default_rng(0).permutation(severe))
        slow = (k for k in shuffled if prepare("tuning", block, k).case.rate <= FASTEST)
        out += [(block, k) for k in sorted(islice(slow, max(1, round(len(quick) / every))))]
    return out


def answered(block: str, index: int) -> dict[str, Any]:
    """A case recorded and diagnosed, in the form that ``run.py`` keeps."""
    session = prepare("tuning", block, index)
    out: dict[str, Any] = {
        "visibility": visibility(session),
        "beyond_nuisance": [bool(beyond_nuisance(t, session)) for t in session.case.truths],
    }
    begin = time.process_time()
    try:
        catalogue = [e for e in CATALOGUE if e.name not in session.case.removed]
        out["answer"] = diagnose(session.model_xml, *record(session), catalogue=catalogue).answer.to_json()
    except Exception as error:  # a case that fails is a result, and must not stop the others
        out["error"] = f"{type(error).__name__}: {error}"
    return out | {"seconds": time.process_time() - begin}


def kept(row: Row) -> dict[str, Any]:
    """What the committed table holds of an answer."""
    findings = [
        {"effect": f["effect"], "joint": f["joint"], "probability": round(f["probability"], 3)} for f in row.findings
    ]
    return {"verdict": row.verdict, "findings": findings}


def compared(rows: Sequence[Row], table: Mapping[str, Any]) -> tuple[list[str], list[str]]:
    """What has changed since the committed answers, and what of it must not stand, in words.

    Args:
        rows: Cases that were run.
        table: Name of a case -> as :func:`kept` made it. Cases that it does not hold are not compared.
    """
    told, worse, broken = [], [], []
    for row in rows:
        if row.verdict == "failed":
            broken.append(f"{row.case.name}: no answer: {row.result.get('error', '')[-200:]}")
        elif row.case.name in table:
            before = Row(row.case, {"answer": table[row.case.name]})
            told += [f"{row.case.name}: {words}" for words in changes(before, row)]
            worse += [f"{row.case.name}: {', '.join(lost)}" for lost in [losses(before, row)] if lost]
    unknown = [r.case.name for r in rows if r.case.name not in table]
    told += [f"{name}: is new" for name in unknown]
    broken += [f"{block}: no case" for block in TRIED if block not in {r.case.block for r in rows}]
    return told, broken + (worse if len(worse) > WORSE else [])


def changes(before: Row, now: Row) -> list[str]:
    """Names that came or went, probabilities that moved by more than ``MOVED``, another verdict."""
    old, new = ({f"{f['effect']}@{f['joint']}": float(f["probability"]) for f in row.findings} for row in (before, now))
    out = [f"{name} {old[name]:.2f} is gone" for name in old if name not in new]
    out += [f"{name} {new[name]:.2f} has come" for name in new if name not in old]
    moved = [name for name in old if name in new and abs(new[name] - old[name]) > MOVED]
    out += [f"{name} {old[name]:.2f} -> {new[name]:.2f}" for name in moved]
    return out + ([f"{before.verdict} -> {now.verdict}"] if before.verdict != now.verdict else [])


def losses(before: Row, now: Row) -> list[str]:
    """What has become worse: a true name lost, a wrong one above one half, doubt that is no longer said."""
    true_before, true_now = (
        {f"{f['effect']}@{f['joint']}" for f in row.findings if row.grade(f) in RIGHT} for row in (before, now)
    )
    out = [f"{name} is no longer named" for name in sorted(true_before - true_now)]
    out += [f"{name} is stated wrongly" for name in sorted({*now.wrong_names()} - {*before.wrong_names()})]
    doubtful = now.case.block in ("outside", "leave_one_out") and _admitted(before) and not _admitted(now)
    return out + (["nothing is said to be unexplained"] if doubtful else [])


if __name__ == "__main__":
    main(tyro.cli(Config))
