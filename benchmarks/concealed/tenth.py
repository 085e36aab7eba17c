"""A tenth of the proof's quick cases, for every change of the code.

    python benchmarks/concealed/tenth.py --jobs 2

One joint, sent torques, block by block of the tuning split: one to two minutes on two cores. Fails where a rate is
worse than the committed table's by more than chance explains, once in a hundred runs.
"""

from __future__ import annotations

import json
import os
import sys
import time
from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass
from itertools import islice
from multiprocessing import get_context
from pathlib import Path
from typing import Any

import numpy as np
import tyro
from scipy.stats import binom
from tqdm import tqdm

sys.path.append(str(Path(__file__).parents[2]))

from benchmarks.concealed.cases import _choose, beyond_nuisance, generator, prepare, record, visibility
from benchmarks.concealed.run import COUNTS, _pin
from benchmarks.concealed.score import Row, line, numbers
from torchrl_athletic.diagnosis import diagnose
from torchrl_athletic.effects import CATALOGUE

TABLE = Path(__file__).parents[1] / "results" / "concealed_sealed.json"
ONE_JOINT = {"tuning": ("lift", "flap"), "sealed": ("slider", "pendulum")}
SCORED = ("single", "heldout", "nothing", "nuisance", "outside", "leave_one_out")
"""Blocks whose rates have a limit."""
SEVERE = 2
FASTEST = 200.0
"""[Hz] of the logs; faster ones take three times as long."""
TORQUES = "torque_command"
CHANCE = 0.01
"""That a limit is broken although nothing has become worse."""


@dataclass(frozen=True)
class Config:
    """Every field is a flag."""

    jobs: int = 2
    """Processes at a time, each on one core."""
    every: int = 10
    """Of so many quick cases one is run: 10 is a tenth."""


def main(cfg: Config) -> None:
    wanted = chosen(cfg.every)
    os.environ["OMP_NUM_THREADS"] = "1"  # of the processes to come
    context = get_context("spawn")
    with ProcessPoolExecutor(cfg.jobs, context, _pin, (context.Value("i", 0),)) as pool:
        results = list(tqdm(pool.map(answered, *zip(*wanted, strict=True)), total=len(wanted), unit="case"))
    rows = [Row(prepare("tuning", *case).case, result) for case, result in zip(wanted, results, strict=True)]
    print("\n".join(f"{line(row)} {result['seconds']:.0f} s" for row, result in zip(rows, results, strict=True)))
    table = json.loads(TABLE.read_text(encoding="utf-8"))["diagnosis"]
    print(f"{sum(r['seconds'] for r in results):.0f} s of processors")
    broken = [words for words, holds in limits(numbers(rows), table).items() if not holds]
    if broken:
        sys.exit("\n".join(["The proof got worse:", *broken]))


def chosen(every: int) -> list[tuple[str, int]]:
    """One of so many quick cases of each block, the same at every call.

    Quick are those of one joint that is sent torques: a servo has to be asked for its torque at every physics step.
    Of single effects only the severe ones are taken, since those below the detection limit hold no rate.
    """
    out = []
    for block in SCORED:
        count = COUNTS[block]
        drawn = [_choose("tuning", block, k, generator("tuning", block, k, 0)) for k in range(count)]
        quick = [k for k, (_, robot, mode, _) in enumerate(drawn) if (robot in ONE_JOINT["tuning"] and mode == TORQUES)]
        severe = [k for k in quick if block != "single" or drawn[k][3] >= SEVERE]
        shuffled = (int(k) for k in np.random.default_rng(0).permutation(severe))
        slow = (k for k in shuffled if prepare("tuning", block, k).case.rate <= FASTEST)
        out += [(block, k) for k in sorted(islice(slow, round(len(quick) / every)))]
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


def limits(here: dict[str, Any], table: dict[str, Any]) -> dict[str, bool]:
    """Limits in words, and whether they hold.

    Args:
        here: As ``score.numbers`` counts it, of the cases that were run.
        table: The same of the committed table.
    """
    single, quiet = here["single"], here["quiet"]
    named = pooled([table["single"]["by_robot"][robot] for robot in ONE_JOINT["sealed"]])
    return dict(
        [
            at_most("no answer", here["failed"], 0.0),
            at_least("single effects named", single["name"], named),
            at_least("single effects on the right joint", single["joint"], table["single"]["joint"][0]),
            at_most("wrong name stated over one half", single["wrong_name_over_half"],
                    table["single"]["wrong_name_over_half"][0]),
            at_most("false alarms", quiet["false_alarm"], max(0.02, table["quiet"]["false_alarm"][0])),
            at_least("what no name fits said so", here["open_set"]["both"], table["open_set"]["both"][0]),
        ]
    )  # fmt: skip


def pooled(rates: list[list[float]]) -> float:
    """One rate of several ``[rate, cases]``."""
    return sum(rate * n for rate, n in rates) / sum(n for _, n in rates)


def at_least(what: str, counted: list[float], rate: float) -> tuple[str, bool]:
    """A limit from below on ``[rate, cases]``, where ``rate`` is expected."""
    hits, n = _hits(counted)
    least = int(binom.ppf(CHANCE, n, rate)) if n else 0
    return f"{what}: {hits} of {n}, at least {least} expected", hits >= least


def at_most(what: str, counted: list[float], rate: float) -> tuple[str, bool]:
    """A limit from above on ``[rate, cases]``, where ``rate`` is expected."""
    hits, n = _hits(counted)
    most = int(binom.ppf(1 - CHANCE, n, rate)) if n else 0
    return f"{what}: {hits} of {n}, at most {most} expected", hits <= most


def _hits(counted: list[float]) -> tuple[int, int]:
    rate, n = counted
    return (round(rate * n), int(n)) if n else (0, 0)


if __name__ == "__main__":
    main(tyro.cli(Config))
