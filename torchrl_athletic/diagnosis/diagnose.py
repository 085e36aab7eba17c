"""From a model and recordings to a statement of what physics the model leaves out, and a simulation that has it."""

from __future__ import annotations

from collections.abc import Sequence
from contextlib import nullcontext
from dataclasses import replace
from pathlib import Path

from torchrl_athletic.diagnosis.checkpoint import Checkpoint, inputs_digest
from torchrl_athletic.diagnosis.decide import decide
from torchrl_athletic.diagnosis.folder import locked
from torchrl_athletic.diagnosis.locate import locate
from torchrl_athletic.diagnosis.model import Model, load_model
from torchrl_athletic.diagnosis.outcome import Diagnosis, deliver
from torchrl_athletic.diagnosis.prepare import Drive, prepare, stood
from torchrl_athletic.diagnosis.progress import Progress
from torchrl_athletic.diagnosis.propose import propose
from torchrl_athletic.diagnosis.resources import OutOfTime, alarm, room_for_data, within_memory
from torchrl_athletic.diagnosis.screen import Bank
from torchrl_athletic.diagnosis.simulate import simulate
from torchrl_athletic.diagnosis.stages import Decided, Given, Located, Ready, Run, Simulated
from torchrl_athletic.diagnosis.state import state
from torchrl_athletic.diagnosis.thresholds import SPENDING
from torchrl_athletic.diagnosis.torque_columns import column_doubts
from torchrl_athletic.effects import CATALOGUE, Effect
from torchrl_athletic.effects.base import Base
from torchrl_athletic.recordings import Recording

CHECKPOINT = "progress.json"


def diagnose(
    model: Model,
    recordings: Sequence[Recording],
    heldout: Sequence[Recording] = (),
    *,
    joined: Sequence[Recording] = (),
    catalogue: Sequence[Effect] = CATALOGUE,
    drive: Drive = "command",
    base: Base = "recorded",
    seed: int = 0,
    time_budget: float | None = None,
    memory: float | None = None,
    highest_frequency: float | None = None,
    output: str | Path | None = None,
    progress: Progress | None = None,
) -> Diagnosis:
    """Locate where a model and recordings differ, say what physics was left out, model it, and measure the gain.

    Args:
        model: MJCF as a path, as text or as an ``MjSpec``; every joint of it must be recorded. Its base may float, in
            the air: nobody records the forces of the ground.
        recordings: Takes to fit.
        heldout: Takes of another kind, used only to compare and to score.
        joined: Takes of experiments that an earlier diagnosis proposed, to fit as well.
        catalogue: Effects to consider.
        drive: Whether the commanded or the measured torque drives the simulation.
        base: Of a floating robot: ``"recorded"`` takes its pose from the recordings, ``"fixed"`` holds it where the
            model has it.
        seed: Of the bootstrap and of the choice of windows.
        time_budget: Wall-clock time of the whole [s]. The search of the torques ends once 30 % of it are spent. From
            40 % on the motion is asked, until 55 %, and the standard joints come before further combinations and end at
            75 %. No fit begins after 60 %, and what was found is stated once 85 % are; without a signal of time, as in
            another thread, after the stage.
        memory: That it may take [GB]; half of what is free if None. Of longer logs, stretches are used.
        highest_frequency: Of the experiment that is planned for rivals [Hz]; as high as the logs allow if None.
        output: Folder for the report. Without it nothing is written, and nothing can be resumed.
        progress: Bar to move.

    Returns:
        The diagnosis; ``answer.complete`` is False if a KeyboardInterrupt or the end of the time stopped it, and what
        was found by then stands in it.

    Raises:
        RecordingError: If the recordings cannot be used, or do not fit the model.
        ModelError: If MuJoCo cannot compile the model.
        ValueError: If ``highest_frequency`` is not above zero.
        BlockingIOError: If another diagnosis or fit is writing to the same folder.
        FileExistsError: If the folder holds a fit.
        OSError: If the disk is full, or the folder cannot be written to; names the file.
        KeyboardInterrupt: If it came before anything was found.

    Example:
        >>> from torchrl_athletic.recordings.demo import concealed_demo
        >>> demo = concealed_demo(seed=3)
        >>> diagnosis = diagnose(demo.model_xml, demo.recordings, demo.heldout)  # doctest: +SKIP
        >>> diagnosis.answer.findings[0].effect == demo.secret.name  # doctest: +SKIP
        True
    """
    if highest_frequency is not None and not highest_frequency > 0:
        raise ValueError(f"highest_frequency is {highest_frequency} Hz. Give more than 0, or leave it out.")
    compiled, xml, name = load_model(model)
    order = recordings[0].joint_names if recordings else ()
    every = within_memory((*recordings, *joined, *heldout), room_for_data(memory))
    fits = len(recordings) + len(joined)
    takes = every.recordings[:fits], every.recordings[fits:]
    fitted, aside = (tuple(stood(r.ordered(order), compiled, base) for r in group) for group in takes)
    given = _with_digest(
        Given(
            compiled,
            xml,
            name,
            fitted,
            aside,
            tuple(catalogue),
            drive,
            base,
            seed,
            len(joined),
            highest_frequency,
            (every.warning,) if every.warning else (),
        )
    )
    folder = None if output is None else Path(output)
    with locked(folder, "fit.json") if folder is not None else nullcontext():
        checkpoint = Checkpoint(None if folder is None else folder / CHECKPOINT, given.inputs)
        diagnosis = _diagnosed(given, Run(progress or Progress(), checkpoint, time_budget), folder)
        if diagnosis.answer.complete:
            checkpoint.remove()
    return diagnosis


def _diagnosed(given: Given, run: Run, output: Path | None) -> Diagnosis:
    """All stages in order. Ctrl-C, the end of the time or of the memory stop them, and what was found is stated."""
    found: Located | Simulated | Decided | None = None
    try:
        run.progress.stage("prepare")
        ready = _prepare(given, run)
        run.progress.stage("locate")
        found = located = _locate(ready)
        with alarm(run.left(SPENDING.to_find, SPENDING.telling)):
            run.progress.stage("propose")
            proposed = propose(located, run)
            run.progress.stage("simulate")
            found = simulated = simulate(proposed, run)
            if simulated.stopped:
                raise KeyboardInterrupt
            run.progress.stage("decide")
            found = decided = decide(simulated)
            run.progress.stage("state")
            stated = state(decided)
        with alarm(run.left(SPENDING.to_tell)):
            run.progress.stage("deliver")
            diagnosis = deliver(stated, output)
    except (KeyboardInterrupt, MemoryError):
        if found is None:
            raise
        return _stopped(found, run, output)
    run.progress.update(1.0)
    return diagnosis


def _stopped(found: Located | Simulated | Decided, run: Run, output: Path | None) -> Diagnosis:
    """What a stopped run has found; where the error is, if there is no time or memory for more."""
    try:
        with alarm(run.left(SPENDING.to_tell)):
            stated = state(_decided(found), stopped_in=run.progress.now)
    except (OutOfTime, MemoryError):
        located = found if isinstance(found, Located) else _located(found)
        stated = state(Decided(located), stopped_in=run.progress.now)
    return deliver(stated, output)


def _located(found: Simulated | Decided) -> Located:
    return found.located if isinstance(found, Decided) else found.proposed.located


def _prepare(given: Given, run: Run) -> Ready:
    """Check the recordings, and put them in the torque domain and on the simulation's grid."""
    train = prepare(given.recordings, given.model, given.drive, joined=given.joined, xml=given.xml)
    run.progress.update(0.6)
    kernel = train.signals[0].kernel
    held = prepare(given.heldout, given.model, given.drive, kernel, xml=given.xml) if given.heldout else None
    doubts = column_doubts(train, held)
    for doubt in doubts:
        run.progress.say(f"Warning: {doubt}")
    return Ready(given, train, held, doubts)


def _locate(ready: Ready) -> Located:
    """Say where the error is, before any naming."""
    bank = Bank(ready.train.signals, ())
    return Located(ready, bank, locate(bank, ready.given.rng("locate")))


def _decided(found: Located | Simulated | Decided) -> Decided:
    """What can be decided of what a stopped run has found."""
    if isinstance(found, Simulated):
        return decide(found)
    return Decided(found) if isinstance(found, Located) else found


def _with_digest(given: Given) -> Given:
    settings = {
        "drive": given.drive,
        "seed": given.seed,
        "catalogue": [e.name for e in given.catalogue],
        "fitted": len(given.recordings),
        "joined": given.joined,
    }
    return replace(given, inputs=inputs_digest(given.xml, (*given.recordings, *given.heldout), settings))
