"""A take as a file tells it, and its translation into a :class:`Recording`."""

from __future__ import annotations

import json
import re
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from functools import cache
from typing import Any

import numpy as np
from numpy.typing import NDArray

from torchrl_athletic.recordings.formats.column_map import BASE, EXAMPLE_JSON, SIGNALS, Column, ColumnMap
from torchrl_athletic.recordings.recording import Recording, RecordingError

_OPTIONAL = ("velocity", "torque_command", "position_target", "torque_measured")
NOTES = ("joint_names", "kp", "kd", "torque_semantics", "metadata")
"""Fields of a recording without a value a sample."""
_TEXTS = ("joint_names", "torque_semantics", "metadata")
_DEEPEST = 100
"""Levels of metadata: JSON that is much deeper is read by one process and not by the next, whose stack is fuller."""


Load = Callable[[], NDArray[Any]]


class Fields(Mapping[str, NDArray[Any]]):
    """Arrays that are read when they are first asked for: what no signal needs may be large, and stays in the file."""

    def __init__(self, load: Mapping[str, Load]) -> None:
        self._load = {name: cache(one) for name, one in load.items()}

    def __getitem__(self, name: str) -> NDArray[Any]:
        return self._load[name]()

    def __contains__(self, name: object) -> bool:
        return name in self._load

    def __iter__(self) -> Iterator[str]:
        return iter(self._load)

    def __len__(self) -> int:
        return len(self._load)


@dataclass(frozen=True)
class RawTake:
    """One continuous take before its names and units are understood."""

    source: str
    """File, and the group or episode in it."""
    fields: Mapping[str, NDArray[Any]]
    """Arrays by the name they have in the file, in the order of the file. Text is an array of strings."""
    metadata: Mapping[str, Any] = field(default_factory=dict)
    """What the reader itself has to note."""


def recording_from_take(take: RawTake, columns: ColumnMap) -> Recording:
    """Translate names and units, and check.

    Raises:
        RecordingError: If a field is missing, ambiguous or malformed.
    """
    used: set[str] = set()
    found = {name: _column(take, columns, name) for name in SIGNALS if name not in columns.ignore}
    if columns.torque_command is not None:
        found.pop("position_target", None)
    if columns.position_target is not None:
        found.pop("torque_command", None)
    position = found["position"]
    if position is None:
        raise RecordingError(f"{take.source}: no position. {_advice(take)}")
    names, labels = _joints(take, columns, position)
    signals = {}
    for name, column in found.items():
        if column is not None:
            if columns.column(name) is None:
                _check_same_joints(take, name, column, labels, columns)
            signals[name] = _signal(take, name, column, labels, used)
    base_position, base_orientation = (_of_base(take, columns, name, used) for name in BASE)
    time = _time(take, columns, len(signals["position"]), used)
    kp, kd = (_gain(take, columns, key, labels, used) for key in ("kp", "kd"))
    metadata = {**_metadata(take), **take.metadata, **columns.metadata}
    if _is_deeper(metadata, _DEEPEST):
        raise RecordingError(
            f"{take.source}: the metadata has lists or objects within each other, over {_DEEPEST} levels deep. Make it "
            "flat, or leave it out."
        )
    alone = "torque_measured" in signals and not {"torque_command", "position_target"} & signals.keys()
    if alone and not columns.measured_drives:
        raise RecordingError(
            f"{take.source}: there is a measured torque, but no command. Let it drive the simulation, with --drive "
            "measured or ColumnMap(measured_drives=True), or name the command."
        )
    semantics = _semantics(take, columns, found.get("torque_measured"))
    if "position_target" in signals and (kp is None or kd is None) and all(n in columns.model_gains for n in names):
        of_model = np.array([columns.model_gains[n] for n in names]).T
        kp, kd = (own if given is None else given for given, own in zip((kp, kd), of_model, strict=True))
        metadata["gains"] = "of the model"
    if alone:
        signals["torque_command"], semantics = signals.pop("torque_measured"), None
        metadata["driven_by"] = "torque_measured"
    if not_read := [name for name in take.fields if name not in used.union(_TEXTS)]:
        metadata["not_read"] = not_read
    return Recording(
        time=time,
        joint_names=names,
        **signals,
        base_position=base_position,
        base_orientation=base_orientation,
        kp=kp,
        kd=kd,
        torque_semantics=semantics,
        metadata=metadata,
        source=take.source,
    )


def with_commands(take: RawTake, commands: Sequence[RawTake], columns: ColumnMap) -> RawTake:
    """A take of states with the columns of its file of commands, each held until the next stamp.

    Raises:
        RecordingError: If there is not one take of commands, or one of both has no stamps.
    """
    if len(commands) != 1:
        raise RecordingError(f"{take.source}: {columns.command_file} holds {len(commands)} takes; needed is one.")
    [other] = commands
    column = columns.column("time") or Column("time")
    stamps = [_numbers(one, str(column.name), "time", set()) for one in (take, other)]
    if not len(stamps[1]) or (np.diff(stamps[1]) < 0).any():
        raise RecordingError(f"{other.source}: the stamps of the commands must increase.")
    at = np.searchsorted(stamps[1], stamps[0], side="right") - 1
    known = at >= 0  # before the first command nobody knows what was commanded
    if not known.any():
        raise RecordingError(f"{other.source}: all commands come after the states. Give both one clock.")
    samples = len(stamps[0])
    fields = {n: v[known] if v.ndim and len(v) == samples else v for n, v in take.fields.items()}
    for name, values in other.fields.items():
        if values.ndim and len(values) == len(stamps[1]):
            fields[f"{columns.command_file}:{name}"] = values[at[known]]
    return RawTake(take.source, fields, take.metadata)


def joints_by_pattern(fields: Iterable[str], signal: str) -> dict[str, list[str]]:
    """Joints of the columns ``signal/<joint>`` and ``signal_<joint>``: ``{"position/{joint}": ["hip", "knee"]}``."""
    joints: dict[str, list[str]] = {}
    for name in fields:
        if _owner(name) == signal and name != signal:
            joints.setdefault(name[: len(signal) + 1] + "{joint}", []).append(name[len(signal) + 1 :])
    return joints


def _owner(name: str) -> str | None:
    """Signal that a column belongs to by its name; ``position_target_hip`` is none of the position's."""
    return max((s for s in SIGNALS if name == s or name.startswith((f"{s}/", f"{s}_"))), key=len, default=None)


def _column(take: RawTake, columns: ColumnMap, signal: str) -> Column | None:
    """Where the signal stands: as the map says, else under its own name; None when it is not there."""
    if (column := columns.column(signal)) is not None:
        return column
    if signal in take.fields:
        return Column(signal)
    patterns = list(joints_by_pattern(take.fields, signal))
    if len(patterns) > 1:
        raise RecordingError(
            f"{take.source}: {signal} is there as {' and as '.join(patterns)}. Name the right one in a column map."
        )
    return Column(patterns[0]) if patterns else None


def _joints(take: RawTake, columns: ColumnMap, position: Column) -> tuple[tuple[str, ...], tuple[str, ...]]:
    """Names of the joints in the model, and in the file."""
    if columns.joint_names is not None:
        return columns.joint_names, columns.file_joint_names or columns.joint_names
    labels = _file_joints(take)
    if labels is None and isinstance(position.name, str) and "{joint}" in position.name:
        before, after = map(re.escape, position.name.split("{joint}", 1))
        of_position = [name for name in take.fields if _owner(name) in (None, "position")]
        labels = tuple(
            match[1] for name in of_position if (match := re.fullmatch(f"{before}(.+){after}", name, re.DOTALL))
        )
        if not labels:
            raise RecordingError(f"{take.source}: no column is named like {position.name!r}. {_advice(take)}")
    if labels is None:
        raise RecordingError(
            f"{take.source}: no joint_names. Say them in a column map: ColumnMap(joint_names=('hip', 'knee'))."
        )
    return labels, labels


def _check_same_joints(take: RawTake, signal: str, column: Column, labels: tuple[str, ...], columns: ColumnMap) -> None:
    """Columns found by themselves must be of the same joints for every signal, unless the map chose the joints."""
    there = joints_by_pattern(take.fields, signal).get(str(column.name), [])
    if columns.joint_names is None and there and _file_joints(take) is None and set(there) != set(labels):
        raise RecordingError(
            f"{take.source}: {signal} is there for the joints {', '.join(there)}, but position for "
            f"{', '.join(labels)}. Name the joints to read in a column map: ColumnMap(joint_names=...), or ignore the "
            "field."
        )


def _signal(take: RawTake, signal: str, column: Column, labels: tuple[str, ...], used: set[str]) -> NDArray[np.float64]:
    """Values of one signal in SI units. Shape (T, J)."""
    if isinstance(column.name, tuple) or "{joint}" in column.name:
        patterns = column.name if isinstance(column.name, tuple) else (column.name,) * len(labels)
        if len(patterns) != len(labels):
            raise RecordingError(
                f"{take.source}: {signal} names {len(patterns)} columns for joints {', '.join(labels)}. Name one each."
            )
        names = [pattern.replace("{joint}", label) for pattern, label in zip(patterns, labels, strict=True)]
        parts = [_numbers(take, name, signal, used) for name in names]
        if parts[0].ndim != 1 or len({part.shape for part in parts}) > 1:
            shapes = ", ".join(f"{name} {part.shape}" for name, part in zip(names, parts, strict=True))
            raise RecordingError(
                f"{take.source}: {signal} has columns of different shapes ({shapes}). All must be (T,)."
            )
        raw = np.stack(parts, axis=1)
    else:
        raw = _numbers(take, column.name, signal, used)
        if raw.ndim == 1 and len(labels) == 1:
            raw = raw[:, None]
        if raw.ndim != 2:
            raise RecordingError(
                f"{take.source}: {signal} is read from {column.name}, which has shape {raw.shape}; needed is (T, "
                f"{len(labels)}), one column a joint ({', '.join(labels)})."
            )
        raw = _select(take, column.name, raw, labels)
    return column.to_si(raw, signal, take.source)


def _of_base(take: RawTake, columns: ColumnMap, name: str, used: set[str]) -> NDArray[np.float64] | None:
    """Position or attitude of the base in SI units: one array, or one column an axis. Shape (T, 3) or (T, 4)."""
    axes = BASE[name]
    column = columns.column(name)
    if column is None:
        there = [f"{name}{mark}{{axis}}" for mark in "/_" if f"{name}{mark}{axes[-1]}" in take.fields]
        if name not in take.fields and not there:
            return None
        column = Column(name if name in take.fields else there[0])
    if isinstance(column.name, str) and "{axis}" not in column.name:
        raw = _numbers(take, column.name, name, used)
    else:
        pattern = column.name
        named = pattern if isinstance(pattern, tuple) else [pattern.replace("{axis}", axis) for axis in axes]
        raw = np.stack([_numbers(take, one, name, used) for one in named], axis=-1)
    if raw.ndim != 2 or raw.shape[1] != len(axes):
        raise RecordingError(
            f"{take.source}: {name} has shape {raw.shape}; needed is (T, {len(axes)}), for {', '.join(axes)}."
        )
    return column.to_si(raw, name, take.source)


def _select(take: RawTake, name: str, array: NDArray[np.float64], labels: tuple[str, ...]) -> NDArray[np.float64]:
    """Entries of the wanted joints along the last axis."""
    there = _file_joints(take)
    if there is not None and array.shape[-1] == len(there):
        if missing := [label for label in labels if label not in there]:
            raise RecordingError(
                f"{take.source}: no joint {missing[0]!r}; the file names {', '.join(there)}. Give these as "
                "file_joint_names of the column map."
            )
        return array[..., [there.index(label) for label in labels]]
    if array.shape[-1] != len(labels if there is None else there):
        raise RecordingError(
            f"{take.source}: {name} has shape {array.shape}, but the joints are {', '.join(there or labels)}. One "
            "column a joint."
        )
    return array


def _time(take: RawTake, columns: ColumnMap, samples: int, used: set[str]) -> NDArray[np.float64]:
    if columns.rate is not None:
        if "time" in take.fields:
            raise RecordingError(f"{take.source}: there is a time in the file, so leave rate out of the column map.")
        return np.arange(samples) / columns.rate
    column = columns.column("time") or Column("time")
    name = column.name
    if not isinstance(name, str):
        raise RecordingError(f"{take.source}: time is {name!r} in the column map; give the name of one column.")
    if name not in take.fields:
        raise RecordingError(f"{take.source}: there is no {name!r} to take the time from. {_advice(take)}")
    raw = take.fields[name]
    if raw.dtype.kind in "mM":  # a date says its unit itself
        column = Column(name, unit="ns")
        if np.isnat(raw).any():
            raise RecordingError(
                f"{take.source}: {name} is empty at row {int(np.argmax(np.isnat(raw)))}. Leave that row out."
            )
        used.add(name)
        seconds = raw.astype(f"{raw.dtype.kind}8[ns]").astype(np.int64).astype(np.float64)
    else:
        seconds = _numbers(take, name, "time", used)
    if seconds.ndim != 1:
        raise RecordingError(f"{take.source}: {name} has shape {seconds.shape}; needed is (T,), one stamp a sample.")
    return column.to_si(seconds, "time", take.source)


def _semantics(take: RawTake, columns: ColumnMap, measured: Column | None) -> Any:
    """What the measured torque is; a file that says it without having one is left to be refused."""
    if "torque_measured" in columns.ignore:
        return None
    said = _text(take, "torque_semantics")
    if measured is None:
        return said
    semantics = columns.torque_semantics or said or ("current_derived" if measured.is_current() else None)
    if semantics is None and not (columns.measured_drives and _is_all_there_is(take, columns)):
        raise RecordingError(
            f"{take.source}: torque_measured needs torque_semantics. Give a column map: "
            "ColumnMap(torque_semantics='link_side') for a torque sensor, 'current_derived' for motor current times a "
            "constant, ignore=('torque_measured',) to leave it out."
        )
    return semantics


def _is_all_there_is(take: RawTake, columns: ColumnMap) -> bool:
    """Whether the measured torque stands for a command that was not logged."""
    commands = (name for name in ("torque_command", "position_target") if name not in columns.ignore)
    return all(_column(take, columns, name) is None for name in commands)


def _gain(
    take: RawTake, columns: ColumnMap, key: str, labels: tuple[str, ...], used: set[str]
) -> NDArray[np.float64] | None:
    """Gains as the map says, else of the file; what a foreign file with a torque command calls ``kp`` is left alone."""
    given = getattr(columns, key)
    if given is not None:
        used.add(key)
        _check_whose(take, columns, key, labels)
        one_a_joint = given if isinstance(given, tuple) else (given,) * len(labels)
        return np.array(one_a_joint, dtype=np.float64)
    if key not in take.fields or columns.torque_command is not None:
        return None
    values = _numbers(take, key, key, used)
    if values.ndim == 0 and len(labels) == 1:
        values = values[None]
    return _select(take, key, values, labels) if values.ndim == 1 else values


def _check_whose(take: RawTake, columns: ColumnMap, key: str, labels: tuple[str, ...]) -> None:
    """A list of different gains needs an order of the joints: that of a file's columns is nobody's intention."""
    given = getattr(columns, key)
    if isinstance(given, tuple) and len(set(given)) > 1 and columns.joint_names is None and _file_joints(take) is None:
        raise RecordingError(
            f"{take.source}: the column map gives {key} as {', '.join(f'{gain:g}' for gain in given)}, but neither it "
            f"nor the file says whose these are. Add joint_names to the map, {', '.join(labels)} in the order of the "
            "numbers."
        )


def _numbers(take: RawTake, name: str, signal: str, used: set[str]) -> NDArray[np.float64]:
    """A field as floats; refuses text, booleans, dates, complex numbers and objects."""
    if name not in take.fields:
        raise RecordingError(f"{take.source}: {signal} is looked for in {name!r}, which is not there. {_advice(take)}")
    used.add(name)
    values = take.fields[name]
    if values.dtype.kind == "U":
        row = next((row for row, text in enumerate(values.ravel()) if not is_number(text)), 0)
        raise RecordingError(
            f"{take.source}: {name} is the text {str(values.ravel()[row : row + 1].tolist())[1:-1]} at row {row}, not "
            "a number. Write numbers as 0.25, with a point, and leave incomplete rows out."
        )
    if values.dtype.kind not in "iuf":
        raise RecordingError(
            f"{take.source}: {name} is of type {values.dtype}, but {signal} must be plain numbers, without empty cells "
            "or rows of unequal length. Store it as float64."
        )
    return values.astype(np.float64)


def is_number(text: str) -> bool:
    """Whether a text is one plain decimal number."""
    pattern = r"[-+]?(\d+\.?\d*|\.\d+)(e[-+]?\d+)?|[-+]?(nan|inf|infinity)"
    return re.fullmatch(pattern, text.strip(), re.ASCII | re.IGNORECASE) is not None


def _file_joints(take: RawTake) -> tuple[str, ...] | None:
    """What the file itself calls its joints."""
    names = take.fields.get("joint_names")
    if names is None:
        return None
    if names.dtype.kind != "U" or names.ndim > 1 or not names.size:
        raise RecordingError(
            f"{take.source}: joint_names is of type {names.dtype} and shape {names.shape}; needed is one text a joint, "
            "shape (J,)."
        )
    joints = tuple(np.atleast_1d(names).tolist())
    if len(set(joints)) < len(joints):
        raise RecordingError(f"{take.source}: joint_names {joints} must name each joint once.")
    return joints


def _text(take: RawTake, name: str) -> str | None:
    value = take.fields.get(name)
    if value is None:
        return None
    if value.dtype.kind != "U" or value.size != 1:
        raise RecordingError(
            f"{take.source}: {name} is of type {value.dtype} and shape {value.shape}; needed is one text."
        )
    return str(value.item())


def _metadata(take: RawTake) -> dict[str, Any]:
    text = _text(take, "metadata")
    return {} if text is None else parse_json_object(text, f"{take.source}: metadata")


def _is_deeper(value: Any, levels: int) -> bool:
    """Whether lists and objects lie in one another on more levels than these."""
    layer = [value]
    for _ in range(levels + 1):
        holders = [one for one in layer if isinstance(one, dict | list)]
        layer = [inner for one in holders for inner in (one.values() if isinstance(one, dict) else one)]
    return bool(holders)


def parse_json_object(text: str, source: str) -> dict[str, Any]:
    """Parse the JSON text of an object.

    Raises:
        RecordingError: If it is something else.
    """
    try:
        content = json.loads(text, parse_constant=_refuse_constant)
    except (ValueError, RecursionError) as error:
        raise RecordingError(f"{source} is not JSON ({error}). Write it with json.dumps.") from error
    if not isinstance(content, dict):
        raise RecordingError(
            f"{source} is the JSON of a {type(content).__name__}; needed is an object, names with their values."
        )
    return content


def _refuse_constant(name: str) -> None:
    raise ValueError(f"{name} is no JSON")


def _advice(take: RawTake) -> str:
    return (
        f"Found are: {', '.join(take.fields) or 'no fields at all'}. Say what is what in a column map, for example "
        "ColumnMap(joint_names="
        "('hip', 'knee'), time=Column('t', unit='ms'), position=Column('q_{joint}', unit='deg'), "
        f"torque_command='tau_{{joint}}'); in a JSON file, for --columns: {EXAMPLE_JSON}"
    )
