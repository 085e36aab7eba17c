"""Diagnose one folder: ``model.xml``, ``fit/*.npz``, ``aside/*.npz``. All that a diagnosis may know stands in it.

    python benchmarks/concealed/diagnose_case.py FOLDER --without backlash compliance

Writes ``answer.json`` into the folder. Nothing of the generator is imported here.
"""

from __future__ import annotations

import json
import resource
import time
from dataclasses import dataclass, replace
from pathlib import Path

import tyro

from torchrl_athletic.diagnosis import Answer, Diagnosis, diagnose
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
    uan: float | None = None
    """Name nothing, and teach an Unsupervised Actuator Net alone for so long [min]: what a net does without physics."""
    time_budget: float | None = None
    """[s]"""


def main(cfg: Config) -> None:
    catalogue = [
        effect for effect in CATALOGUE if effect.name not in cfg.without and (not cfg.only or effect.name in cfg.only)
    ]
    model = (cfg.folder / "model.xml").read_text(encoding="utf-8")
    fit, aside = read_recordings(cfg.folder / "fit"), read_recordings(cfg.folder / "aside")
    begin, cpu = time.monotonic(), time.process_time()
    if cfg.uan is None:
        answer = diagnose(model, fit, aside, catalogue=catalogue, seed=0, time_budget=cfg.time_budget).answer
    else:
        answer = by_net(diagnose(model, fit, aside, catalogue=(), seed=0), cfg.uan)
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


def by_net(diagnosis: Diagnosis, minutes: float) -> Answer:
    """The given model with a net, its score in the place of the named physics'."""
    from torchrl_athletic.training import learn_remainder  # torch and its environments, for this method only

    bare = replace(diagnosis, corrected=diagnosis.nominal)
    fit = learn_remainder(bare, minutes=minutes, progress=False).answer.fit
    scores = {split: fit[f"{split}_uan"] for split in ("train", "heldout")}
    return replace(diagnosis.answer, findings=(), verdict="unexplained", fit=scores)


if __name__ == "__main__":
    main(tyro.cli(Config))
