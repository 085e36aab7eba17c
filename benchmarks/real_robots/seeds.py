"""How much of a ratio to the best rival is chance: the same fits by other seeds, which draw starts and windows.

    ATHLETIC_DATA=... python -m benchmarks.real_robots.seeds --data CLONES --cases so101 go1 --seeds 1 2

Rivals and seed 0 are those of :mod:`benchmarks.real_robots.run`. Of PACE's list alone a seed matters; it keeps its own.
"""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import tyro

from benchmarks.by_case import Row, run_cases
from benchmarks.real_robots import run
from benchmarks.real_robots.replay import JUDGE
from benchmarks.real_robots.robots import ROBOTS

SEED = ", seed "
"""Between a robot's name and the seed."""


@dataclass(frozen=True)
class Config:
    """Every field is a flag."""

    data: Path = Path("clones")
    """Folder of clones; the five benches of ``load_dataset`` need none."""
    cases: tuple[str, ...] = tuple(ROBOTS)
    seeds: tuple[int, ...] = (1, 2)
    results: Path = Path("benchmarks/results/real_robots.md")
    """What the first seed and the rivals reached."""
    output: Path = Path("benchmarks/results/real_robots_seeds.md")


def main(cfg: Config) -> None:
    known = json.loads(cfg.results.with_suffix(".json").read_text("utf-8"))
    for case in cfg.cases:
        if case not in known or known[case]["judge"] != JUDGE:
            raise ValueError(
                f"{cfg.results}: {case!r} is not there, or scored otherwise. Run real_robots.run on it first."
            )

    def fitted(draw: str) -> Row:
        case, seed = draw.rsplit(SEED, 1)
        asked = run.Config(data=cfg.data, seed=int(seed), output=cfg.results, fits=None, rivals=())
        return {**drawn(run.run(case, asked)), "judge": JUDGE}

    draws = [f"{case}{SEED}{seed}" for seed in cfg.seeds for case in cfg.cases]
    run_cases(draws, fitted, lambda rows: table(rows, known), cfg.output)


def drawn(row: Row) -> Row:
    """What is kept of a fit by another seed."""
    pooled = {split: float(np.sqrt(np.mean(np.square(e)))) for split, e in row["errors"]["ours"].items()}
    return {"ratio": run.ratio(row), "worse": run.worse(row), "cpu": row["cpu"], **pooled}


def table(rows: Mapping[str, Row], known: Mapping[str, Row]) -> str:
    """A row a robot: its ratio by each seed, in the order of their errors on what was fitted."""
    lines = [
        "Made by `python -m benchmarks.real_robots.seeds --data CLONES`: error kept aside over the best rival's.",
        "",
        "| robot | seed 0 | other seeds | all, lowest error on what was fitted first | joints made worse | CPU time "
        "| commits |",
        "|---" * 7 + "|",
    ]
    for case, first in known.items():
        draws = {name: row for name, row in rows.items() if name.rsplit(SEED, 1)[0] == case}
        others = [row for row in draws.values() if row["judge"] == first["judge"]]
        if others:
            lines.append(_row(case, [{**drawn(first), "commit": first["commits"]["ours"]}, *others]))
    return "\n".join(lines) + "\n"


def _row(case: str, draws: Sequence[Row]) -> str:
    said = [f"{d['ratio']:.2f}" for d in draws]
    order = np.argsort([d["train"] for d in draws], kind="stable")
    cells = (
        case,
        said[0],
        ", ".join(said[1:]),
        ", ".join(said[k] for k in order),
        ", ".join(sorted({name for d in draws for name in d["worse"]})) or "none",
        ", ".join(f"{d['cpu']:.0f} s" for d in draws),
        ", ".join(dict.fromkeys(d["commit"] for d in draws)),
    )
    return f"| {' | '.join(cells)} |"


if __name__ == "__main__":
    main(tyro.cli(Config))
