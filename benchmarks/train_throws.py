"""Train throwing policies in identified simulators, several at a time; ``throw_transfer.py`` then throws with them.

    python benchmarks/train_throws.py outputs/identification/default --output outputs/throw_base --iterations 100
    python benchmarks/train_throws.py outputs/identification/* --begin-with outputs/throw_base --iterations 40

Each training is a process that runs ``recipes/throw_arm.py`` in a folder of its own under ``--output``, with a copy of
the simulator that it is trained in. Of a method that was identified with several seeds (``uan_seed0``, ``uan_seed1``)
the policies' seeds take these in turn, so that each method has as many policies. Policies that have had their
iterations are left as they are, others go on from their checkpoint: the command may be stopped and given again.
A training that fails on a GPU is tried again on the CPU.
"""

from __future__ import annotations

import csv
import filecmp
import os
import re
import shutil
import subprocess
import sys
import time
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Annotated, Literal

import tyro
from tqdm import tqdm

RECIPE = Path(__file__).parents[1] / "recipes" / "throw_arm.py"
FILES = ("simulator.json", "corrected.json", "net.pt")
"""Files of a simulator."""
MINIBATCH = 8192
"""Minibatch of the actor [samples]; of a small batch a quarter."""
STARTING = 75.0
"""Share of a training's time, for what comes before its first iteration and after its last [s]."""


@dataclass(frozen=True)
class Config:
    """Every field is a flag."""

    folders: Annotated[tuple[Path, ...], tyro.conf.Positional]
    """Folders of simulators."""
    output: Path = Path("outputs/throw")
    """Where folders of policies go."""
    begin_with: Path | None = None
    """Folder of policies to begin with, whose folders end in the same seeds; none begins with the reference."""
    seeds: tuple[int, ...] = (0, 1, 2)
    """Seeds of the policies."""
    iterations: int = 120
    """Iterations of each training, so that all have learnt from as many samples."""
    num_envs: int = 512
    """Environments of each training."""
    horizon: int = 16
    """Steps of each environment per iteration."""
    evaluate_every: int = 10
    """Iterations between measurements, each of which takes as long as some tens of iterations."""
    jobs: int = 2
    """Trainings at a time, which share the cores."""
    device: Literal["cpu", "cuda"] = "cpu"
    """Where to train."""
    fuse: bool = False
    """Compile what surrounds the physics on a GPU."""
    gpus: int = 1
    """That the trainings share."""
    budget: float = 36_000.0
    """When all of them stop, whatever they have reached [s]."""


@dataclass(frozen=True)
class Job:
    """One policy."""

    folder: Path
    """Folder of the simulator."""
    seed: int
    output: Path
    device: str

    @property
    def else_tried(self) -> Job | None:
        """What to do instead if it fails."""
        return None if self.device == "cpu" else replace(self, device="cpu")


def main(cfg: Config) -> None:
    end = time.monotonic() + cfg.budget
    waiting = [job for job in jobs_of(cfg) if iterations_of(job.output) < cfg.iterations]
    running: dict[int, tuple[subprocess.Popen[bytes], Job]] = {}
    with tqdm(total=len(waiting)) as bar:
        while running or (waiting and time.monotonic() < end):
            while waiting and len(running) < cfg.jobs and time.monotonic() < end:
                place, job = min(set(range(cfg.jobs)) - set(running)), waiting.pop(0)
                running[place] = start(job, cfg, place, seconds=end - time.monotonic()), job
            time.sleep(0.5)
            for place, (process, job) in list(running.items()):
                stopped = process.poll() is None and time.monotonic() > end
                if stopped:
                    process.kill()  # its policy is that of its last measurement
                    process.wait()
                if process.returncode is None:
                    continue
                del running[place]
                failed = process.returncode != 0 and not stopped
                if failed and job.else_tried is not None:
                    tqdm.write(f"{job.output.name} failed, is tried otherwise: {last_line(job.output, failed)}")
                    waiting.insert(0, job.else_tried)
                    continue
                bar.update()
                said = "stopped" if stopped else last_line(job.output, failed)
                tqdm.write(f"{job.output.name}, {iterations_of(job.output)} iterations: {said}")


def jobs_of(cfg: Config) -> list[Job]:
    """First a policy of every method, then the second of each."""
    methods: dict[str, list[Path]] = {}
    for folder in cfg.folders:
        if (folder / "simulator.json").exists():
            methods.setdefault(re.sub(r"_seed\d+$", "", folder.name), []).append(folder)
    turns = [(k, seed, found[k % len(found)]) for k, seed in enumerate(cfg.seeds) for found in methods.values()]
    return [Job(folder, seed, cfg.output / f"{folder.name}-{seed}", cfg.device) for _, seed, folder in turns]


def iterations_of(output: Path) -> int:
    """That a training has had; 0 without a policy."""
    return int(most(output, "step")) if (output / "policy.pt").exists() else 0


def most(output: Path, column: str) -> float:
    """Greatest number of a column of a training's log; 0 where it has none."""
    log = output / "progress.csv"
    if not log.exists():
        return 0.0
    with log.open(newline="", encoding="utf-8") as file:
        return max((float(row[column] or 0) for row in csv.DictReader(file)), default=0.0)


def start(job: Job, cfg: Config, place: int, seconds: float) -> subprocess.Popen[bytes]:
    """A training as a process of its own, which ends within so many seconds, at one of ``cfg.jobs`` places."""
    keep_simulator(job.folder, job.output / "simulator")
    left = seconds - STARTING
    spent = most(job.output, "seconds") if (job.output / "checkpoints").exists() else 0.0  # by earlier runs
    flags = {
        "simulator": job.output / "simulator",
        "seed": job.seed,
        "output": job.output,
        "iterations": cfg.iterations,
        "minutes": (max(10.0, left) + spent) / 60,
        "device": job.device,
        "evaluate-every": cfg.evaluate_every,
        "ppo.num-envs": cfg.num_envs,
        "ppo.horizon": cfg.horizon,
        "ppo.actor-minibatches": max(4, cfg.num_envs * cfg.horizon // MINIBATCH),
        "ppo.critic-minibatches": 4,
    }
    if cfg.begin_with is not None:
        flags["begin-with"] = policy_of(job.seed, cfg.begin_with)
    words = [word for name, value in flags.items() for word in (f"--{name}", str(value))]
    words.append("--fuse" if cfg.fuse else "--no-fuse")
    cores = sorted(os.sched_getaffinity(0))
    own = {"OMP_NUM_THREADS": "1", "TORCHINDUCTOR_COMPILE_THREADS": str(max(1, len(cores) // cfg.jobs))}
    if job.device == "cuda":
        own["CUDA_VISIBLE_DEVICES"] = str(place % cfg.gpus)
    cores = cores[place :: cfg.jobs] or [cores[place % len(cores)]]  # simulations take a thread for each that they have
    with (job.output / "log.txt").open("ab") as log:
        process = subprocess.Popen(
            [
                sys.executable,
                str(RECIPE),
                *words,
            ],
            stdout=log,
            stderr=subprocess.STDOUT,
            env=os.environ | own,
        )
    os.sched_setaffinity(process.pid, cores)
    return process


def policy_of(seed: int, folder: Path) -> Path:
    """The one policy of a seed that a folder holds.

    Raises:
        ValueError: If there is none, or several.
    """
    found = sorted(folder.glob(f"*-{seed}/policy.pt"))
    if len(found) != 1:
        raise ValueError(
            f"{folder} holds {len(found)} policies of seed {seed}, so it is not known with which one to begin. Train "
            "one simulator alone with --output there, in each of these seeds."
        )
    return found[0]


def keep_simulator(folder: Path, copy: Path) -> None:
    """Copy what a policy is trained in, since a folder may be identified anew.

    Raises:
        ValueError: If the policy was begun in another simulator.
    """
    copy.mkdir(parents=True, exist_ok=True)
    names = [name for name in FILES if (folder / name).exists()]
    if not (copy / FILES[0]).exists():
        for name in reversed(names):  # simulator.json last: a folder that has it is complete
            shutil.copyfile(folder / name, copy / name)
    differing = [
        name for name in names if not (copy / name).exists() or not filecmp.cmp(folder / name, copy / name, False)
    ]
    if differing:
        raise ValueError(
            f"{copy.parent} was begun in another simulator than {folder} is now: {', '.join(differing)} differ. A "
            "policy of two simulators would tell about neither. Remove that folder, or give another --output."
        )


def last_line(output: Path, failed: bool = False) -> str:
    """What it said of its throws, or why it failed."""
    lines = (output / "log.txt").read_text(errors="replace").replace("\r", "\n").strip().splitlines()
    measured = [line for line in lines if " m, " in line and "failed" in line and not failed]
    return (measured or lines or ["it said nothing"])[-1]


def _main(arguments: Sequence[str] | None = None) -> None:
    main(tyro.cli(Config, description=__doc__, args=arguments))


if __name__ == "__main__":
    _main()
