"""Kill a diagnosis and three trainings at random moments, go on, and compare the answer with an undisturbed run's.

    python benchmarks/kills.py

Half an hour on two busy cores. A run is killed by ``kill -9`` at a moment drawn evenly between its first sign of work
and the end of an undisturbed run; the same command is given again, and killed again, up to three times; then it runs to
its end. The answer has to be the same to the last bit, but for times. What a kill loses is the work between the last
state on disk and the kill.
"""

from __future__ import annotations

import csv
import json
import os
import platform
import runpy
import shutil
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Mapping, Sequence
from contextlib import redirect_stderr, redirect_stdout
from dataclasses import dataclass, field
from multiprocessing import get_context
from multiprocessing.process import BaseProcess
from pathlib import Path
from typing import Any
from unittest.mock import patch

import numpy as np
import torch
import tyro
from tqdm import tqdm

from torchrl_athletic.diagnosis.progress import Progress
from torchrl_athletic.recordings import write_recording
from torchrl_athletic.recordings.demo import HiddenEffect, make_recordings, pendulum
from torchrl_athletic.recordings.demo.takes import Kind

ROOT = Path(__file__).parents[1]
FRESH = get_context("forkserver")
"""Makes processes that know nothing of each other, from one that has imported what they need and done nothing."""
PRELOADED = ["torchrl_athletic.diagnosis.command", "torchrl_athletic.training", "matplotlib.figure", "jinja2", "tyro"]
STAGES = "stages.txt"
IN_A_ROW = 3
"""Most kills of one run."""
TIMES = {"seconds", "training_seconds"}
"""Numbers of an answer that say how long something took."""


@dataclass(frozen=True)
class Config:
    """Every field is a flag."""

    kills: int = 100
    """How many, of all jobs together."""
    jobs: tuple[str, ...] = ("diagnosis", "UAN, gradient", "UAN, PPO", "WBC")
    """What is killed; each has its share of the kills of all four."""
    seed: int = 0
    """Seed of the moments."""
    output: Path = Path("benchmarks/results/kills.md")
    """Table to write."""


@dataclass(frozen=True)
class Job:
    """A command, and what of its output folder is its answer."""

    name: str
    share: int
    """Kills of a hundred."""
    arguments: Callable[[Path], list[str]]
    """Command line by the folder of the inputs, without ``--output``."""
    answer: Callable[[Path], Any]
    """What has to be the same, from the output folder."""
    states: Sequence[str]
    """Patterns of the files that hold a state to go on from."""


@dataclass
class Outcome:
    """What became of the kills of one job."""

    undisturbed: float = 0.0
    """Length of the undisturbed run from its first sign of work [s]."""
    same: int = 0
    gone_on: int = 0
    """Runs that found a state to go on from."""
    lost: list[float] = field(default_factory=list)
    """Work lost by each kill [s]."""
    places: dict[str, int] = field(default_factory=dict)
    """Kills by what was being done."""
    different: list[str] = field(default_factory=list)
    """Parts of the answers that differ, and after which kills."""


def table(path: Path) -> list[dict[str, str]]:
    """Rows of a training's numbers, without times."""
    with path.open(newline="") as file:
        return [{k: v for k, v in row.items() if k not in TIMES} for row in csv.DictReader(file)]


def numbers(path: Path) -> dict[str, list[Any]]:
    """Arrays of a network's file by name, and what else it says."""
    with np.load(path) as content:
        arrays = {name: content[name] for name in content.files}
    said = json.loads(arrays.pop("metadata").tobytes())
    return {"metadata": without_times(said)} | {name: array.tolist() for name, array in arrays.items()}


def without_times(content: Any) -> Any:
    """JSON content without the entries that say how long something took."""
    if isinstance(content, dict):
        return {k: without_times(v) for k, v in content.items() if k not in TIMES}
    return [without_times(item) for item in content] if isinstance(content, list) else content


def diagnosed(output: Path) -> Mapping[str, Any]:
    """All files but the inputs' record, byte by byte."""
    return {p.name: p.read_bytes() for p in sorted(output.iterdir()) if p.is_file()}


def corrected(output: Path) -> Mapping[str, Any]:
    """The net, what is said of it, and the curve."""
    (path,) = output.glob("*.pt")
    state = torch.load(path, weights_only=True)["state"]["net"]
    net = {key: value.tolist() if isinstance(value, torch.Tensor) else value for key, value in state.items()}
    said = without_times(json.loads((output / "simulator.json").read_text()))
    return {"net": net, "simulator.json": said, "progress.csv": table(output / "progress.csv")}


def controlled(output: Path) -> Mapping[str, Any]:
    """The controller, its critic, and the curve."""
    nets = {p.name: numbers(p) for p in sorted(output.glob("*.npz"))}
    return nets | {"progress.csv": table(output / "progress.csv")}


def diagnosis(folder: Path) -> list[str]:
    data = ["--model", f"{folder}/arm.xml", "--recordings", f"{folder}/train", "--heldout", f"{folder}/heldout"]
    return ["recipes/diagnose.py", *data]


def uan(folder: Path, method: str, iterations: int, every: int, rows: int) -> list[str]:
    data = ["--recordings", f"{folder}/targets", "--robot", f"{folder}/coarse.xml"]
    data += ["--method", method, "--device", "cpu"]
    size = ["--hidden", "16", "--num-envs", str(rows), "--window", "1.0", "--minutes", "60"]
    return ["recipes/train_uan.py", *data, *size, "--iterations", str(iterations), "--evaluate-every", str(every)]


def wbc(folder: Path) -> list[str]:
    size = ["--hidden", "16", "--num-envs", "2", "--ppo.horizon", "2", "--ppo.epochs", "1", "--history", "2"]
    return ["recipes/pretrain_wbc.py", *size, "--iterations", "26", "--no-video"]


CHECKPOINTS = ("checkpoints/checkpoint-*/*",)
JOBS = (
    Job("diagnosis", 40, diagnosis, diagnosed, ("progress.json", "diagnosis.json")),
    Job("UAN, gradient", 20, lambda f: uan(f, "gradient", 20, 4, 8), corrected, CHECKPOINTS),
    Job("UAN, PPO", 10, lambda f: uan(f, "ppo", 8, 2, 8), corrected, CHECKPOINTS),
    Job("WBC", 30, wbc, controlled, CHECKPOINTS),
)


def main(cfg: Config) -> None:
    os.environ["OMP_NUM_THREADS"] = "1"
    FRESH.set_forkserver_preload(PRELOADED)
    rng = np.random.default_rng(cfg.seed)
    outcomes = {}
    with tempfile.TemporaryDirectory() as scratch, tqdm(total=cfg.kills) as bar:
        folder = Path(scratch)
        robot, kinds = pendulum(), list[Kind](("gaussian", "square", "multisine"))
        dry = [HiddenEffect("coulomb_friction", "pendulum", {"torque": 0.15})]
        torques = make_recordings(robot, dry, kinds, 0, 4.0)
        targets = make_recordings(robot, dry, kinds, 0, 4.0, field="position_target")
        (folder / "arm.xml").write_text(robot.model_xml)
        (folder / "coarse.xml").write_text(robot.model_xml.replace('timestep="0.001"', 'timestep="0.005"'))
        for name, takes in (("train", torques[:2]), ("heldout", torques[2:]), ("targets", targets)):
            (folder / name).mkdir()
            for k, take in enumerate(takes):
                write_recording(take, folder / name / f"{k}.npz")
        for job in (j for j in JOBS if j.name in cfg.jobs):
            outcomes[job] = killed_and_gone_on_with(job, folder, round(cfg.kills * job.share / 100), rng, bar)
            cfg.output.parent.mkdir(parents=True, exist_ok=True)
            cfg.output.write_text(report(outcomes, cfg))
    print(report(outcomes, cfg))


def killed_and_gone_on_with(job: Job, inputs: Path, kills: int, rng: np.random.Generator, bar: Any) -> Outcome:
    """Run a job undisturbed, then with kills, until there were so many."""
    outcome = Outcome()
    whole = inputs / f"{job.name} whole"
    process, began = start(job, inputs, whole)
    finish(process)
    outcome.undisturbed = time.time() - began
    expected = job.answer(whole / "out")
    while len(outcome.lost) < kills:
        place = inputs / f"{job.name} {len(outcome.lost)} {rng.integers(2**31)}"
        before, moments = len(outcome.lost), rng.uniform(0.0, outcome.undisturbed, IN_A_ROW)
        for moment in moments[: kills - before]:
            process, began = start(job, inputs, place)
            process.join(max(0.0, moment + began - time.time()))
            if process.exitcode is not None:
                break  # it had come to its end
            process.kill()
            at = time.time()
            process.join()
            doing = what_it_did(job, place)
            saved = [p.stat().st_mtime for pattern in job.states for p in (place / "out").glob(pattern)]
            outcome.gone_on += bool(saved)
            outcome.lost.append(at - max([began, *saved]))
            outcome.places[doing] = outcome.places.get(doing, 0) + 1
            bar.update()
        finish(start(job, inputs, place)[0])  # which says the same again, where it had come to its end
        answer, times = job.answer(place / "out"), len(outcome.lost) - before
        wrong = sorted(name for name in expected.keys() | answer.keys() if expected.get(name) != answer.get(name))
        if wrong:
            outcome.different.append(f"{', '.join(wrong)} after {times} kills at {moments[:times].round(1)} s")
        else:
            outcome.same += times
        shutil.rmtree(place)
        bar.set_postfix(same=outcome.same, of=len(outcome.lost), lost=max(outcome.lost, default=0.0))
    return outcome


def start(job: Job, inputs: Path, place: Path) -> tuple[BaseProcess, float]:
    """A process and the time of its first sign of work: a stage, the output folder, or a line of its log."""
    place.mkdir(exist_ok=True)
    (place / STAGES).unlink(missing_ok=True)
    before = sign(place)
    process = FRESH.Process(target=run, args=(place, job.arguments(inputs)))
    process.start()
    while process.is_alive() and sign(place) == before:
        time.sleep(0.01)
    return process, time.time()


def sign(place: Path) -> tuple[bool, bool, int]:
    log = place / "log.txt"
    return (place / STAGES).exists(), (place / "out").exists(), log.stat().st_size if log.exists() else 0


def run(place: Path, arguments: Sequence[str]) -> None:
    """Do as ``python SCRIPT FLAGS --output OUT`` does, and note which stage of a diagnosis has come."""
    begin = Progress.stage

    def stage(bar: Progress, name: str) -> None:
        with (place / STAGES).open("a") as file:
            file.write(name + "\n")
        begin(bar, name)

    noting = patch.object(Progress, "stage", stage)
    script, *flags = arguments
    os.chdir(place)  # what is written says how it was made, folder included
    sys.argv = [str(ROOT / script), *flags, "--output", "out"]
    with (place / "log.txt").open("a") as log, redirect_stdout(log), redirect_stderr(log), noting:
        runpy.run_path(sys.argv[0], run_name="__main__")


def finish(process: BaseProcess) -> None:
    """Wait for a run's end.

    Raises:
        RuntimeError: If it failed.
    """
    process.join()
    if process.exitcode:
        raise RuntimeError(f"{process.name} ended with {process.exitcode}")


def what_it_did(job: Job, place: Path) -> str:
    """Stage of a diagnosis, or how far a training was."""
    if job.name == "diagnosis":
        stages = (place / STAGES).read_text().split() if (place / STAGES).exists() else []
        return stages[-1] if stages else "start"
    rows = place / "out" / "progress.csv"
    if not rows.exists():
        return "before an iteration"
    return "in training" if any((place / "out").glob("checkpoints/checkpoint-*")) else "before a checkpoint"


def report(outcomes: Mapping[Job, Outcome], cfg: Config) -> str:
    """The tables as Markdown."""
    commit = subprocess.run(["git", "rev-parse", "--short", "HEAD"], capture_output=True, text=True, cwd=ROOT).stdout
    machine = f"{platform.machine()}, {os.cpu_count()} cores, shared with other work, torch {torch.__version__}"
    lines = [
        "# Kills",
        "",
        f"Made by `python benchmarks/kills.py --kills {cfg.kills} --seed {cfg.seed}` at {commit.strip()} on {machine}.",
        "",
        "| job | undisturbed [s] | kills | found a state | same answer | lost, median [s] | lost, most [s] |",
        "|---|---|---|---|---|---|---|",
    ]
    total = Outcome()
    for job, o in outcomes.items():
        lines.append(_row(job.name, f"{o.undisturbed:.1f}", o))
        total.same, total.gone_on, total.lost = total.same + o.same, total.gone_on + o.gone_on, total.lost + o.lost
    lines += [_row("all", "", total), "", "| job | killed while | kills |", "|---|---|---|"]
    lines += [f"| {job.name} | {place} | {n} |" for job, o in outcomes.items() for place, n in o.places.items()]
    different = [f"- {job.name}: {what}" for job, o in outcomes.items() for what in o.different]
    return "\n".join([*lines, *(["", "Different answers:", "", *different] if different else []), ""])


def _row(name: str, length: str, o: Outcome) -> str:
    lost = (f"{np.median(o.lost):.1f}", f"{max(o.lost):.1f}") if o.lost else ("", "")
    return f"| {name} | {length} | {len(o.lost)} | {o.gone_on} | {o.same} | {lost[0]} | {lost[1]} |"


if __name__ == "__main__":
    main(tyro.cli(Config, description=__doc__))
