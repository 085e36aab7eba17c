"""What the commands are given: a model and recordings, as they are, and what is wrong with them."""

from __future__ import annotations

import shlex
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import NamedTuple, Protocol

import mujoco
import numpy as np

from torchrl_athletic.diagnosis.locking import locked_joints
from torchrl_athletic.diagnosis.model import ModelError, load_model
from torchrl_athletic.diagnosis.prepare import PAYLOAD, Drive, prepare, stood
from torchrl_athletic.diagnosis.resources import room_for_data, within_memory
from torchrl_athletic.diagnosis.torque_columns import torque_doubts
from torchrl_athletic.effects import JointAddress
from torchrl_athletic.effects.base import Base
from torchrl_athletic.recordings import (
    ColumnMap,
    FetchError,
    Recording,
    RecordingError,
    check_quality,
    read_recordings,
)
from torchrl_athletic.recordings.formats.read import sources_of

CHANGES_MODEL = (PAYLOAD,)
"""Notes of a recording that change the model it is compared with."""
COPIES = "with_payload"
"""Folder beside the report of copies of recordings that say what was fastened."""
ABOVE_ZERO = {"time_budget": " s", "memory": " GB", "highest_frequency": " Hz"}
"""Flags that are more than zero, and their units."""
NOT_BELOW_ZERO = {"payload": " kg", "seed": "", "demo": ""}
"""Flags that may be zero, too."""


class Asked(Protocol):
    """The flags that say what to read."""

    @property
    def model(self) -> Path | None: ...
    @property
    def recordings(self) -> tuple[Path, ...]: ...
    @property
    def heldout(self) -> tuple[Path, ...]: ...
    @property
    def columns(self) -> Path | None: ...
    @property
    def lock(self) -> tuple[str, ...]: ...
    @property
    def drive(self) -> Drive: ...
    @property
    def dataset(self) -> str | None: ...
    @property
    def output(self) -> Path: ...


class Inputs(NamedTuple):
    """A model and recordings that can be used."""

    model: Path | str
    recordings: list[Recording]
    heldout: list[Recording]

    @property
    def notes(self) -> list[str]:
        """What changes the model, as lines to print first."""
        out = []
        for name in CHANGES_MODEL:
            said = sorted({float(r.metadata[name]) for r in (*self.recordings, *self.heldout) if r.metadata.get(name)})
            if said:
                values = ", ".join(f"{v:g}" for v in said)
                out.append(f"Notes of the recordings change the model: {name} = {values}, fastened to the last link.")
        if any(r.metadata.get("gains") == "of the model" for r in self.recordings):
            out.append("The recordings say no gains: those of the model's position actuators are taken.")
        if any(r.metadata.get("driven_by") == "torque_measured" for r in self.recordings):
            out.append("The recordings hold no command: the measured torque drives the simulation.")
            return out
        model = load_model(self.model)[0]
        if any(r.torque_command is not None for r in self.recordings):
            out += _gained(model, self.recordings[0].joint_names)
        return [*out, *_left_out(model)]


def inputs(asked: Asked, demo: int = 0) -> Inputs:
    """Model, recordings to fit and recordings kept aside: the user's, a public dataset's, or the demo's.

    Gains that the recordings lack are those of the model's position actuators. Joints that are locked leave the model
    and the recordings.

    Raises:
        RecordingError: If recordings are named without a model, or a model without recordings, or one cannot be used.
        ModelError: If MuJoCo cannot compile the model.
    """
    if asked.dataset is not None:
        from torchrl_athletic.recordings.datasets import load_dataset

        dataset = load_dataset(asked.dataset)
        return Inputs(dataset.model, list(dataset.recordings), list(dataset.heldout))
    if asked.model is None and not asked.recordings:
        from torchrl_athletic.recordings.demo import concealed_demo

        made = concealed_demo(demo)
        return Inputs(made.model_xml, list(made.recordings), list(made.heldout))
    if asked.model is None or not asked.recordings:
        missing = "--model" if asked.model is None else "--recordings"
        raise RecordingError(f"{missing} is missing. Give both, or --dataset NAME, or nothing at all for the demo.")
    columns = columns_for(asked)
    recordings, heldout = (
        read_recordings(paths, columns) if paths else [] for paths in (asked.recordings, asked.heldout)
    )
    if not asked.lock:
        return Inputs(asked.model, recordings, heldout)
    xml, _ = locked_joints(asked.model, asked.lock, recordings)
    return Inputs(xml, [freed(r, asked.lock) for r in recordings], [freed(r, asked.lock) for r in heldout])


def wrong_flags(asked: object) -> Iterator[str]:
    """What is wrong with the numbers of a command's flags, and with flags that need another one."""
    for name, unit in (ABOVE_ZERO | NOT_BELOW_ZERO).items():
        value = getattr(asked, name, None)
        if value is None or (np.isfinite(value) and (value > 0 or (value == 0 and name in NOT_BELOW_ZERO))):
            continue
        least = "0 or more" if name in NOT_BELOW_ZERO else "more than 0"
        yield f"--{name.replace('_', '-')} is {value}{unit}. Give {least}, or leave it out."
    if getattr(asked, "payload", 0) and not getattr(asked, "continue_with", ()):
        yield "--payload speaks of the recordings of --continue. Name them, too."


def refuse_wrong_flags(asked: object) -> None:
    """Say what is wrong with a command's flags before any work.

    Raises:
        RecordingError: If a number is none or too small, or a flag lacks another one.
    """
    if wrong := list(wrong_flags(asked)):
        raise RecordingError(" ".join(wrong))


def columns_for(asked: Asked) -> ColumnMap:
    """The column map that is asked for, or none, with what else the flags and the model say of the files."""
    columns = mapped(asked)
    if asked.model is None or not Path(asked.model).is_file():
        return columns
    return replace(columns, model_gains=gains_of(load_model(asked.model)[0]))


def mapped(asked: Asked) -> ColumnMap:
    """The column map that is asked for, or none, with what else the flags say of the files."""
    columns = ColumnMap() if asked.columns is None else ColumnMap.load(asked.columns)
    return replace(columns, measured_drives=columns.measured_drives or asked.drive == "measured")


def columns_of(source: Path, asked: Asked, columns: ColumnMap) -> ColumnMap | None:
    """The column map of a file; copies that say what was fastened are canonical, whatever the map says."""
    return None if source.parent == (asked.output / COPIES).resolve() else columns


def gains_of(model: mujoco.MjModel) -> Mapping[str, tuple[float, float]]:
    """Gains kp and kd of the joints that one position actuator drives, for targets of the joint [N·m/rad, N·m·s/rad].

    An actuator with a gear has its square: the joint's angle is geared up, and so is the torque.
    """
    out = {}
    for j in range(model.njnt):
        drives = [
            a
            for a in range(model.nu)
            if model.actuator_trntype[a] == mujoco.mjtTrn.mjTRN_JOINT and model.actuator_trnid[a, 0] == j
        ]
        if len(drives) != 1:
            continue
        [a] = drives
        gain, bias = float(model.actuator_gainprm[a, 0]), model.actuator_biasprm[a]
        squared = float(model.actuator_gear[model.actuator_outadr[a], 0]) ** 2
        servo = model.actuator_biastype[a] == mujoco.mjtBias.mjBIAS_AFFINE and np.isclose(bias[1], -gain)
        if servo and squared * gain > 0:
            out[model.joint(j).name] = (squared * gain, squared * max(float(-bias[2]), 0.0))
    return out


def _gained(model: mujoco.MjModel, joints: Sequence[str]) -> Iterator[str]:
    """Motors whose control is not their joint's torque, as corrected.xml has them, in a line to print."""
    scales = {}
    for a in range(model.nu):
        kind = model.actuator_dyntype[a], model.actuator_gaintype[a], model.actuator_trntype[a]
        motor = kind == (mujoco.mjtDyn.mjDYN_NONE, mujoco.mjtGain.mjGAIN_FIXED, mujoco.mjtTrn.mjTRN_JOINT)
        joint = model.joint(model.actuator_trnid[a, 0]).name if motor else ""
        scale = float(model.actuator_gainprm[a, 0] * model.actuator_gear[model.actuator_outadr[a], 0])
        if joint in joints and not model.actuator_biasprm[a, 1:3].any() and scale != 1.0:
            scales[joint] = scale
    if scales:
        yield (
            f"The model's motors give {', '.join(f'{s:.3g} ({j})' for j, s in scales.items())} times their control; "
            "torque_command is taken as the joint's torque. A log of controls needs these scales in columns.json."
        )


def _left_out(model: mujoco.MjModel) -> Iterator[str]:
    """Dynamics of the model's actuators, which the simulation of a diagnosis does not have, as lines to print."""
    for a in map(int, np.flatnonzero(model.actuator_dyntype != mujoco.mjtDyn.mjDYN_NONE)):
        kind = mujoco.mjtDyn(int(model.actuator_dyntype[a])).name.removeprefix("mjDYN_").lower()
        after = f", {model.actuator_dynprm[a, 0]:g} s" if kind.startswith("filter") else ""
        name = model.actuator(a).name or a
        yield f"The model's actuator {name} has dynamics of its own ({kind}{after}). They are left out."


def freed(recording: Recording, lock: Sequence[str]) -> Recording:
    """A recording without the joints that are locked.

    Raises:
        RecordingError: If no other one is recorded.
    """
    locked = {entry.partition("=")[0] for entry in lock}
    kept = [n for n in recording.joint_names if n not in locked]
    if len(kept) == recording.num_joints:
        return recording
    if not kept:
        raise RecordingError(f"{recording.source}: --lock names all of its joints. Leave out one that moves.")
    at = [recording.joint_names.index(n) for n in kept]
    fields = ("position", "velocity", "torque_command", "position_target", "torque_measured", "kp", "kd")
    cut = {f: getattr(recording, f)[..., at] for f in fields if getattr(recording, f) is not None}
    return replace(recording, joint_names=tuple(kept), **cut)


WARNING = "warning: "
REFUSALS = (RecordingError, ModelError, FetchError, ImportError, OSError)
"""What a command says in a line, and not as a traceback."""


def checked(asked: Asked, joined: Sequence[Path] = ()) -> tuple[str, bool]:
    """All that is wrong with the inputs, as a list to print, and whether they can be used all the same.

    Args:
        asked: The flags.
        joined: Files of experiments that join the recordings.
    """
    wrong = list(wrong_flags(asked))
    model, groups = _gathered(asked, joined, wrong)
    every = [r for group in groups for r in group]
    for r in every:
        wrong += _of_one(r)
        if set(r.joint_names) != set(every[0].joint_names):
            wrong.append(f"{r.source}: its joints are {', '.join(r.joint_names)}; {every[0].source} has other ones.")
    if model is not None and all(text.startswith(WARNING) for text in wrong):
        wrong += _unprepared(asked, model, groups)
    return listed(wrong)


def listed(wrong: Sequence[str]) -> tuple[str, bool]:
    """What is wrong as a list to print, each thing once, and whether all of it is warnings."""
    said = [f"- {' '.join(text.split())}" for text in dict.fromkeys(wrong)]
    usable = all(text.startswith(f"- {WARNING}") for text in said)
    return "\n".join([*said, "The inputs can be used." if usable else "The inputs cannot be used."]), usable


def _gathered(
    asked: Asked, joined: Sequence[Path], wrong: list[str]
) -> tuple[Path | str | None, list[list[Recording]]]:
    """Model without what is locked, recordings to fit, that join and are kept aside; what is wrong joins a list."""
    try:
        if asked.dataset is not None or (asked.model is None and not asked.recordings):
            given = inputs(asked, getattr(asked, "demo", 0))
            if asked.dataset is None:
                wrong.append(f"{WARNING}neither a model nor recordings are named: this is of the demo.")
            return given.model, [given.recordings, _read(joined, asked, columns_for(asked), wrong), given.heldout]
        model = _model(asked, wrong)
        if not asked.recordings:
            wrong.append("--recordings is missing.")
        columns = mapped(asked) if model is None else columns_for(asked)
    except REFUSALS as error:
        wrong.append(str(error))
        return None, []
    groups = [_read(paths, asked, columns, wrong) for paths in (asked.recordings, joined, asked.heldout)]
    if model is None:
        return None, groups
    held: Sequence[str] = asked.lock
    try:
        if asked.lock:
            xml, _ = locked_joints(model, asked.lock, groups[0])
            groups = [[freed(r, asked.lock) for r in group] for group in groups]
            model, held = xml, ()
    except RecordingError as error:
        wrong.append(str(error))
    compiled = load_model(model)[0]
    wrong += [text for group in groups for r in group for text in _beside(r, compiled, held)]
    return model, groups


def _model(asked: Asked, wrong: list[str]) -> Path | str | None:
    if asked.model is None:
        wrong.append("--model is missing.")
        return None
    try:
        load_model(asked.model)
    except (ModelError, OSError) as error:
        wrong.append(str(error))
        return None
    return asked.model


def _read(paths: Sequence[Path], asked: Asked, columns: ColumnMap, wrong: list[str]) -> list[Recording]:
    """Recordings of all files that can be read; what is wrong with the others is added to a list."""
    out: list[Recording] = []
    for path in paths:
        try:
            sources = sources_of(path)
        except (RecordingError, OSError) as error:
            wrong.append(str(error))
            continue
        for source in sources:
            try:
                out += read_recordings(source, columns_of(source, asked, columns))
            except (RecordingError, ImportError, OSError) as error:
                wrong.append(str(error))
    return out


def _of_one(r: Recording) -> Iterator[str]:
    try:
        for w in check_quality(r).warnings:
            yield f"{WARNING}{w}" if w.startswith(r.source) else f"{WARNING}{r.source}: {w}"
    except RecordingError as error:
        yield str(error)


def _unprepared(asked: Asked, model: Path | str, groups: Sequence[Sequence[Recording]]) -> Iterator[str]:
    """What a run would refuse or leave out as it prepares its recordings, such as takes that are too short."""
    compiled, xml, _ = load_model(model)
    fitted, joined, aside = map(len, groups)
    every = within_memory([r for group in groups for r in group], room_for_data(getattr(asked, "memory", None)))
    try:
        base: Base = getattr(asked, "base", "recorded")
        order = every.recordings[0].joint_names if every.recordings else ()
        takes = [stood(r.ordered(order), compiled, base) for r in every.recordings]
        train = prepare(takes[: fitted + joined], compiled, asked.drive, joined=joined, xml=xml)
        held = None
        yield from (f"{WARNING}{text}" for text in train.left_out)
        if aside:
            kernel = train.signals[0].kernel
            held = prepare(takes[fitted + joined :], compiled, asked.drive, kernel, xml=xml)
            yield from (f"{WARNING}{text}" for text in held.left_out)
        yield from (f"{WARNING}{text}" for text in torque_doubts(train, held))
    except REFUSALS as error:
        yield str(error)


def _beside(r: Recording, model: mujoco.MjModel, locked: Sequence[str]) -> Iterator[str]:
    names = {model.joint(j).name for j in range(model.njnt)}
    if unknown := [n for n in r.joint_names if n not in names]:
        yield f"{r.source}: the model has no joint {', '.join(unknown)}; it has {', '.join(sorted(names))}."
    free = [model.joint(j).name for j in range(model.njnt) if model.jnt_type[j] >= 2]
    fixed = {n.partition("=")[0] for n in locked}
    if silent := [n for n in free if n not in r.joint_names and n not in fixed]:
        mend = f"Record it, or say --lock {shlex.quote(silent[0])}."
        yield f"{r.source}: {', '.join(silent)} of the model is not recorded. {mend}"
    floating = any(model.jnt_type == mujoco.mjtJoint.mjJNT_FREE)
    if not unknown and not silent and not fixed and not floating:
        try:
            JointAddress.of(model, r.joint_names, r.source)
        except RecordingError as error:
            yield str(error)
