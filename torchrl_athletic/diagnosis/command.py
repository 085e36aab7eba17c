"""The command line of a diagnosis: ``torchrl-athletic diagnose`` and ``recipes/diagnose.py``."""

from __future__ import annotations

import hashlib
import sys
from collections.abc import Callable
from dataclasses import dataclass, fields, replace
from pathlib import Path
from typing import Annotated, Literal

import tyro

from torchrl_athletic.diagnosis.checkpoint import Checkpoint
from torchrl_athletic.diagnosis.continuation import as_before, recall, remember
from torchrl_athletic.diagnosis.diagnose import CHECKPOINT, diagnose
from torchrl_athletic.diagnosis.fitting import Fit
from torchrl_athletic.diagnosis.folder import locked
from torchrl_athletic.diagnosis.inputs import (
    COPIES,
    checked,
    columns_for,
    columns_of,
    freed,
    inputs,
    listed,
    refuse_wrong_flags,
    wrong_flags,
)
from torchrl_athletic.diagnosis.model import ModelError
from torchrl_athletic.diagnosis.outcome import Diagnosis
from torchrl_athletic.diagnosis.prepare import PAYLOAD
from torchrl_athletic.diagnosis.progress import Progress
from torchrl_athletic.diagnosis.report import terminal_summary
from torchrl_athletic.diagnosis.report.words import go_on
from torchrl_athletic.effects.base import Base
from torchrl_athletic.recordings import (
    FetchError,
    Recording,
    RecordingError,
    read_recordings,
    write_recording,
)


@dataclass(frozen=True)
class Config:
    """Say what physics a MuJoCo model leaves out, from recordings of the robot."""

    model: Path | None = None
    """MJCF of the robot."""
    recordings: tuple[Path, ...] = ()
    """Files or folders to fit: npz, CSV, Parquet, LeRobot, HDF5, MAT, ROS 1/2 bags, MCAP."""
    heldout: tuple[Path, ...] = ()
    """Files or folders kept aside, best of another kind of motion: the fit is scored on them."""
    output: Path = Path("out/diagnosis")
    """Folder for diagnosis.json, report.html, corrected.xml and corrected.json; a stopped run resumes from it."""
    continue_with: Annotated[tuple[Path, ...], tyro.conf.arg(name="continue")] = ()
    """New files or folders that join those of the earlier diagnosis in the output folder, such as a recording of its
    next_experiment.npz."""
    payload: float = 0.0
    """Mass fastened to the end of the last link while the files of --continue were recorded, as the plan asked [kg]."""
    columns: Path | None = None
    """JSON column map for foreign names and units."""
    lock: tuple[str, ...] = ()
    """Joints that stood still, as NAME or NAME=POSITION: they become part of their links in the model."""
    check: bool = False
    """Say all that is wrong with the inputs, and do nothing else."""
    drive: Literal["command", "measured"] = "command"
    """Torque that drives the simulation: what was commanded, or what was measured."""
    base: Base = "recorded"
    """Base of a floating robot in the air: its recorded pose, or held where the model has it."""
    dataset: Literal["emps", "two_link_arm", "pendulum", "xl330", "unbalanced_disk"] | None = None
    """Diagnose a public recording of a real robot instead."""
    demo: int = 0
    """Seed of the concealed demo, which runs when nothing else is asked for."""
    fit_only: bool = False
    """Fit the standard joints alone and name nothing, as ``torchrl-athletic fit`` does: fit.json."""
    time_budget: float | None = None
    """Time after which it says what it has found by then [s]."""
    memory: float | None = None
    """Memory that it may take [GB]; half of what is free unless said. Of longer logs, stretches are used."""
    seed: int = 0
    """Seed of the bootstrap and of the choice of windows."""
    highest_frequency: float | None = None
    """Highest frequency of the planned experiment for rivals [Hz]. Give less than the logs allow where something
    on the robot is loose."""
    uan: bool = False
    """Hand what no named physics explains to an Unsupervised Actuator Net: two more minutes, and uan.pt."""


def main(config: Config, hand_over: Callable[[Diagnosis, Path], Diagnosis] | None = None) -> Diagnosis | Fit:
    """Run a diagnosis, print its summary, and leave the report in ``config.output``.

    Args:
        config: The flags.
        hand_over: What ``--uan`` asks for, since a diagnosis knows of no training:
            :func:`~torchrl_athletic.training.learn_remainder`.
    """
    if config.check:
        text, usable = _checked(config)
        print(text)
        sys.exit(0 if usable else 1)
    if config.fit_only:
        from torchrl_athletic.diagnosis import fit_command  # which takes its inputs from here

        same = {f.name: getattr(config, f.name) for f in fields(fit_command.FitConfig) if f.name != "draws"}
        return fit_command.main(fit_command.FitConfig(**same))
    try:
        if config.output.is_file():  # said now, not after the fit
            raise NotADirectoryError(f"--output {config.output} is a file. Name a folder.")
        with locked(config.output, "fit.json"):
            return _main(config, hand_over)
    except (RecordingError, FetchError, ModelError, OSError, ImportError) as error:
        sys.exit(f"error: {' '.join(str(error).split())}")


def _checked(asked: Config) -> tuple[str, bool]:
    """What is wrong with the inputs, those of the earlier diagnosis that is continued among them."""
    try:
        config = recall(asked, asked.output)
    except (RecordingError, OSError) as error:
        return listed([*wrong_flags(asked), str(error)])
    return checked(config, config.continue_with)


def _main(asked: Config, hand_over: Callable[[Diagnosis, Path], Diagnosis] | None) -> Diagnosis:
    try:
        refuse_wrong_flags(asked)
        recalled = recall(asked, asked.output)
        if before := as_before(asked, recalled):
            print(before)
        config = fastened(asked, recalled)
        given = inputs(config, config.demo)
        print("\n".join(given.notes), end="\n" if given.notes else "")
        new = joined(config)
        with Progress() as progress:
            diagnosis = diagnose(
                given.model,
                given.recordings,
                given.heldout,
                joined=new,
                drive=config.drive,
                base=config.base,
                seed=config.seed,
                time_budget=config.time_budget,
                memory=config.memory,
                highest_frequency=config.highest_frequency,
                output=config.output,
                progress=progress,
            )
    except KeyboardInterrupt:
        sys.exit("Stopped before there was anything to report.")
    remember(config, config.output)  # last, or it would speak of a diagnosis that is yet to come
    if config.uan and hand_over is not None and diagnosis.answer.complete:
        try:
            diagnosis = hand_over(diagnosis, config.output)
        except ValueError as error:
            print(f"No UAN was trained: {error}\n")
    plan = diagnosis.experiment
    print(terminal_summary(diagnosis.answer, plan.sentence if plan else ""))
    if plan:
        print(f"With its recording the diagnosis goes on:\n  {go_on(str(config.output), plan.payload)}")
    print(f"\nReport: {config.output / 'report.html'}")
    if not diagnosis.answer.complete:
        kept = Checkpoint(config.output / CHECKPOINT, diagnosis.answer.inputs).kept
        print(f"Stopped early. {stopped_sentence(kept, config.time_budget)}")
    return diagnosis


def stopped_sentence(kept: bool, time_budget: float | None) -> str:
    """What to do after a run that was stopped, of which something was kept or not."""
    if kept:
        return "The same command goes on from here."
    more = "" if time_budget is None else f", with a larger --time-budget than {time_budget:g} s"
    return f"No fit was finished by then, so that nothing is kept: begin anew{more}."


def fastened(asked: Config, config: Config) -> Config:
    """The recalled settings with copies of the files that joined now, which say what was fastened."""
    if not asked.payload:
        return config
    folder = (config.output / COPIES).resolve()
    copies: list[Path] = []
    folder.mkdir(parents=True, exist_ok=True)
    for r in joined(replace(config, continue_with=asked.continue_with)):
        mark = hashlib.sha256(str(Path(r.source).resolve()).encode()).hexdigest()[:8]  # every round's may be new.npz
        take = sum(copy.name.startswith(f"{mark}-") for copy in copies)
        copies.append(folder / f"{mark}-{take}-{Path(r.source).stem}.npz")
        write_recording(replace(r, metadata={**r.metadata, PAYLOAD: asked.payload}), copies[-1])
    new = {p.resolve() for p in (*asked.continue_with, *copies)}
    kept = tuple(p for p in config.continue_with if p.resolve() not in new)
    return replace(config, continue_with=(*kept, *copies), payload=0.0)


def joined(config: Config) -> list[Recording]:
    """The new recordings, without the joints that are locked."""
    columns = columns_for(config)
    return [
        freed(r, config.lock)
        for path in config.continue_with
        for r in read_recordings(path, columns_of(path, config, columns))
    ]
