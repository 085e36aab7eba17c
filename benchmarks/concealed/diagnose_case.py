"""Diagnose one folder: ``model.xml``, ``fit/*.npz``, ``aside/*.npz``. All that a diagnosis may know stands in it.

    python benchmarks/concealed/diagnose_case.py FOLDER --without backlash compliance

Writes ``answer.json`` into the folder. Nothing of the generator is imported here.
"""

from __future__ import annotations

import json
import resource
import time
from dataclasses import dataclass
from pathlib import Path

import tyro

from torchrl_athletic.diagnosis import diagnose
from torchrl_athletic.diagnosis.calibration import learnt
from torchrl_athletic.effects import CATALOGUE
from torchrl_athletic.recordings import read_recordings


@dataclass(frozen=True)
class Config:
    """Every field is a flag."""

    folder: tyro.conf.Positional[Path]
    without: tuple[str, ...] = ()
    """Names of effects taken out of the catalogue."""
    only: tuple[str, ...] = ()
    """Names of effects that make up the whole catalogue: the oracle's, which knows what is hidden."""
    time_budget: float | None = None
    """[s]"""


def main(cfg: Config) -> None:
    catalogue = [
        effect for effect in CATALOGUE if effect.name not in cfg.without and (not cfg.only or effect.name in cfg.only)
    ]
    model = (cfg.folder / "model.xml").read_text(encoding="utf-8")
    fit, aside = read_recordings(cfg.folder / "fit"), read_recordings(cfg.folder / "aside")
    begin, cpu = time.monotonic(), time.process_time()
    answer = diagnose(model, fit, aside, catalogue=catalogue, seed=0, time_budget=cfg.time_budget).answer
    content = {
        "answer": answer.to_json(),
        "seconds": time.monotonic() - begin,
        "cpu_seconds": time.process_time() - cpu,
        "megabytes": resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024,
        "recorded_seconds": sum(r.duration for r in (*fit, *aside)),
        "joints": fit[0].num_joints,
        "calibration": {part: dict(learnt(part)) for part in ("weights", "interval")},
        "names": sorted({effect.name for effect in catalogue}),
    }
    (cfg.folder / "answer.json").write_text(json.dumps(content), encoding="utf-8")


if __name__ == "__main__":
    main(tyro.cli(Config))
