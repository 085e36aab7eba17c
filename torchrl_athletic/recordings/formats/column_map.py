"""What a foreign file calls our signals, and in which units it counts them."""

from __future__ import annotations

import json
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, fields
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from torchrl_athletic.recordings.recording import RecordingError, TorqueSemantics

SIGNALS = ("position", "velocity", "torque_command", "position_target", "torque_measured")
"""Fields of a recording with one value a sample and joint."""
BASE = {"base_position": ("x", "y", "z"), "base_orientation": ("w", "x", "y", "z")}
"""Fields of a recording of a floating robot, and the numbers that each has a sample."""

_POSITION = {
    "rad": (1.0, 1.0), "m": (1.0, 1.0), "deg": (math.pi, 180.0), "rev": (math.tau, 1.0), "mm": (1.0, 1e3),
    "counts": (math.tau, 1.0),
}  # fmt: skip
_TORQUE = {
    "N·m": (1.0, 1.0), "Nm": (1.0, 1.0), "N": (1.0, 1.0), "mN·m": (1.0, 1e3), "mNm": (1.0, 1e3),
    "A": (1.0, 1.0), "mA": (1.0, 1e3), "V": (1.0, 1.0),
}  # fmt: skip
# Factor to SI as (multiply, divide): dividing by 1000 rounds correctly, multiplying by 0.001 does not.
UNITS: dict[str, dict[str, tuple[float, float]]] = {
    "time": {"s": (1.0, 1.0), "ms": (1.0, 1e3), "us": (1.0, 1e6), "ns": (1.0, 1e9)},
    "position": _POSITION,
    "position_target": _POSITION,
    "velocity": {
        "rad/s": (1.0, 1.0), "m/s": (1.0, 1.0), "deg/s": (math.pi, 180.0), "rev/s": (math.tau, 1.0),
        "rpm": (math.tau, 60.0), "mm/s": (1.0, 1e3), "counts/s": (math.tau, 1.0),
    },
    "torque_command": _TORQUE,
    "torque_measured": _TORQUE,
    "base_position": {"m": (1.0, 1.0), "mm": (1.0, 1e3)},
    "base_orientation": {"1": (1.0, 1.0)},
}  # fmt: skip
"""Units that a :class:`Column` may have, for each field."""

_CURRENTS = ("A", "mA", "V")


@dataclass(frozen=True)
class Column:
    """Where a field stands in a foreign file, and how its numbers become SI units.

    A raw number becomes ``scale * unit * (raw - zero)``, where ``unit`` stands for the unit's size in SI. ``unit``,
    ``scale``, ``zero``, ``counts_per_revolution`` and ``torque_constant`` are one value for all joints, or one a joint.

    Raises:
        RecordingError: If a unit needs a number that is not given, or a number cannot be right.

    Example:
        >>> encoder = Column("enc_{joint}", unit="counts", counts_per_revolution=4096, zero=2048, scale=(1, -1))
        >>> current = Column("current", unit="mA", torque_constant=0.091)
    """

    name: str | tuple[str, ...]
    """Name in the file. ``{joint}`` in it is replaced by the name that each joint has in the file; a name without it
    is that of an array (T, J). A tuple names one column a joint. For the base, ``{axis}`` stands for w, x, y and z,
    and a tuple names its three or four columns in this order."""
    unit: str | tuple[str, ...] | None = None
    """Unit of the numbers in the file. None: SI."""
    scale: float | tuple[float, ...] = 1.0
    """Further factor [1], such as -1 for a joint that counts the other way, or 1/6 for an encoder before a 6:1 gear."""
    zero: float | tuple[float, ...] = 0.0
    """Raw reading that means zero, in the unit of the file."""
    counts_per_revolution: float | tuple[float | None, ...] | None = None
    """Encoder counts a turn, for the units ``counts`` and ``counts/s``."""
    torque_constant: float | tuple[float | None, ...] | None = None
    """Torque a current or voltage makes [N·m/A, N·m/V], for the units ``A``, ``mA`` and ``V``."""

    def __post_init__(self) -> None:
        for f in fields(self):
            if isinstance(value := getattr(self, f.name), list):
                object.__setattr__(self, f.name, tuple(value))
        if not self.name or not all(isinstance(name, str) for name in _each(self.name)):
            raise RecordingError(f"column map: a Column's name is {self.name!r}; give the name in the file, as text.")
        if not all(isinstance(unit, str | None) for unit in _each(self.unit)):
            raise RecordingError(f"column map: unit of {self.name!r} is {self.unit!r}; give a text, such as 'deg'.")
        for key in ("scale", "zero", "counts_per_revolution", "torque_constant"):
            may_lack, may_be_zero = key in ("counts_per_revolution", "torque_constant"), key == "zero"
            for number in _each(getattr(self, key)):
                if not ((number is None and may_lack) or (_is_number(number) and (number != 0 or may_be_zero))):
                    advice = "." if may_be_zero else ", and not 0, which would wipe the signal out."
                    raise RecordingError(
                        f"column map: {key} of {self.name!r} is {getattr(self, key)!r}; give a finite number, one for "
                        f"all joints or one a joint{advice}"
                    )

    def to_si(self, raw: NDArray[np.float64], field_name: str, source: str) -> NDArray[np.float64]:
        """Convert raw numbers of one field, shape (T,) or (T, J), to SI units.

        Raises:
            RecordingError: If the unit is not one of this field, or there is not one value a joint.
        """
        joints = raw.shape[1] if raw.ndim == 2 else 1
        units = self._per_joint("unit", joints, source)
        if unknown := [unit for unit in units if unit is not None and unit not in UNITS[field_name]]:
            raise RecordingError(
                f"{source}: unit {unknown[0]!r} of column {self.name!r} is not one of {field_name}. Known are "
                f"{', '.join(UNITS[field_name])}; give another factor as scale."
            )
        multiply, divide = np.array([(1.0, 1.0) if unit is None else UNITS[field_name][unit] for unit in units]).T
        multiply = multiply * self._per_joint("scale", joints, source)
        for suffixes, key in ((("counts", "counts/s"), "counts_per_revolution"), (_CURRENTS, "torque_constant")):
            needs, numbers = [unit in suffixes for unit in units], self._per_joint(key, joints, source)
            if any(need and number is None for need, number in zip(needs, numbers, strict=True)):
                raise RecordingError(
                    f"{source}: column {self.name!r} is in {units[needs.index(True)]}, which needs {key}. Add it to "
                    "the column map."
                )
            if any(number is not None and not need for need, number in zip(needs, numbers, strict=True)):
                raise RecordingError(
                    f"{source}: column {self.name!r} has a {key}, but its unit is {units[needs.index(False)]!r}. Give "
                    f"unit={' or '.join(repr(s) for s in suffixes)}, or leave {key} out."
                )
            factor = np.array([1.0 if number is None else number for number in numbers])
            multiply, divide = (
                (multiply, divide * factor) if key == "counts_per_revolution" else (multiply * factor, divide)
            )
        if raw.ndim == 1:
            multiply, divide = multiply[0], divide[0]
        return (raw - self._per_joint("zero", joints, source)) * multiply / divide

    def is_current(self) -> bool:
        """Whether the column is a motor current or voltage, from which a torque is derived."""
        return any(unit in _CURRENTS for unit in _each(self.unit))

    def _per_joint(self, key: str, joints: int, source: str) -> tuple[Any, ...]:
        values = _each(getattr(self, key))
        if len(values) not in (1, joints):
            raise RecordingError(
                f"{source}: column {self.name!r} has {len(values)} values of {key} for {joints} joints. Give one for "
                "all or one a joint."
            )
        return values if len(values) == joints else values * joints


@dataclass(frozen=True)
class ColumnMap:
    """Foreign names and units of a recording's fields. What stands here replaces what the file says.

    A field that is not given is looked for under its own name (``position``, ``position/<joint>``,
    ``position_<joint>``) in SI units. A plain name stands for ``Column(name)``.

    Raises:
        RecordingError: If the entries contradict each other.

    Example:
        >>> columns = ColumnMap(
        ...     joint_names=("hip", "knee"), file_joint_names=("1", "2"),
        ...     time=Column("t", unit="ms"), position=Column("q{joint}", unit="deg"),
        ...     position_target=Column("q_des{joint}", unit="deg"), kp=(30.0, 20.0), kd=1.0,
        ... )
    """

    joint_names: tuple[str, ...] | None = None
    """Joints to read, named and ordered as in the model. None: all that the file names. In a file that does not name
    its joints these are the columns of its arrays, in order."""
    file_joint_names: tuple[str, ...] | None = None
    """What the file calls the joints of ``joint_names``, in that order. None: the same."""
    time: Column | str | None = None
    """Stamps."""
    rate: float | None = None
    """Sampling rate [Hz], for files without stamps; the first sample is then at 0 s."""
    position: Column | str | None = None
    """Measured position."""
    velocity: Column | str | None = None
    """Measured velocity."""
    torque_command: Column | str | None = None
    """Torque sent to the motor. Naming it keeps ``position_target`` from being looked for, and the other way round."""
    position_target: Column | str | None = None
    """Target of the joint's PD controller."""
    torque_measured: Column | str | None = None
    """Measured torque. Needs ``torque_semantics``, unless it is a current."""
    torque_semantics: TorqueSemantics | None = None
    """``link_side`` or ``current_derived``."""
    base_position: Column | str | None = None
    """Position of a floating robot's base."""
    base_orientation: Column | str | None = None
    """Its attitude, a unit quaternion: ``Column(("qw", "qx", "qy", "qz"))``."""
    kp: float | tuple[float, ...] | None = None
    """Proportional gain [N·m/rad], one for all joints or one a joint, as ``joint_names`` orders them."""
    kd: float | tuple[float, ...] | None = None
    """Derivative gain [N·m·s/rad], one for all joints or one a joint, as ``joint_names`` orders them."""
    model_gains: Mapping[str, tuple[float, float]] = field(default_factory=dict)
    """kp and kd of each joint of the model, for files with targets that say no gains."""
    command_file: str | None = None
    """Name of the file beside each file of states that holds its commands, with stamps of the same name. Its columns
    are called ``<name>:<column>``, and are put on the stamps of the states by zero-order hold, never ahead."""
    measured_drives: bool = False
    """Whether a measured torque may stand for a command that was not logged."""
    ignore: tuple[str, ...] = ()
    """Fields not to look for, such as ``("torque_measured",)`` when the driver fills it with zeros."""
    state_topic: str | None = None
    """Topic of a bag or MCAP file that carries the measured state."""
    command_topic: str | None = None
    """Topic of a bag or MCAP file that carries the command."""
    metadata: Mapping[str, Any] = field(default_factory=dict)
    """Notes to add to those of the file."""

    def __post_init__(self) -> None:
        for f in fields(self):
            if isinstance(value := getattr(self, f.name), list):
                object.__setattr__(self, f.name, tuple(value))
        for name in ("time", *SIGNALS, *BASE):
            if isinstance(value := getattr(self, name), str):
                object.__setattr__(self, name, Column(value))
            elif isinstance(value, Mapping):
                _refuse_unknown_keys(value, Column, f"{name} in the column map")
                object.__setattr__(self, name, Column(**value))
            elif not (value is None or isinstance(value, Column)):
                raise RecordingError(f"column map: {name} is {value!r}; give a name in the file, or a Column.")
        _check(self)

    @classmethod
    def load(cls, path: str | Path) -> ColumnMap:
        """Read a column map from a JSON file: an object with the names of the fields above.

        A column is a text, or an object with the names of the fields of :class:`Column`.

        Raises:
            RecordingError: If the file is not such an object.
        """
        if not Path(path).is_file():
            raise RecordingError(f"{path}: there is no such column map. Write one like {EXAMPLE_JSON}")
        try:
            content = json.loads(Path(path).read_text(encoding="utf-8"))
        except (OSError, ValueError, RecursionError) as error:
            raise RecordingError(
                f"{path}: not a column map in JSON ({error}). Write one like {EXAMPLE_JSON}"
            ) from error
        if not isinstance(content, dict):
            raise RecordingError(f"{path}: a column map is a JSON object, like {EXAMPLE_JSON}")
        try:
            _refuse_unknown_keys(content, cls, "the column map")
            return cls(**content)
        except RecordingError as error:
            raise RecordingError(f"{path}: {error}") from error

    def column(self, name: str) -> Column | None:
        """Entry of one field, or None."""
        value: Column | None = getattr(self, name)
        return value


EXAMPLE_JSON = (
    '{"time": {"name": "t", "unit": "ms"}, "position": {"name": "q_{joint}", "unit": "deg"}, '
    '"torque_command": {"name": "tau_{joint}", "unit": "N·m"}}'
)


def _check(columns: ColumnMap) -> None:
    for key in ("joint_names", "file_joint_names", "ignore"):
        names = getattr(columns, key)
        if names is None:
            continue
        if (
            not isinstance(names, tuple)
            or not all(isinstance(name, str) for name in names)
            or len(set(names)) < len(names)
        ):
            raise RecordingError(f"column map: {key} is {names!r}; give a list of different names, even for one.")
    if columns.joint_names == ():
        raise RecordingError("column map: joint_names is empty; name the joints to read, or leave it out.")
    if columns.file_joint_names is not None and len(columns.file_joint_names) != len(columns.joint_names or ()):
        raise RecordingError(
            f"column map: file_joint_names {columns.file_joint_names} must match joint_names {columns.joint_names} one "
            "by one."
        )
    known = ("velocity", "torque_command", "position_target", "torque_measured")
    if unknown := set(columns.ignore) - set(known):
        raise RecordingError(
            f"column map: ignore names {sorted(unknown)}; what can be left out are {', '.join(known)}."
        )
    if both := [name for name in columns.ignore if getattr(columns, name) is not None]:
        raise RecordingError(f"column map: {both[0]} is both given and ignored; decide.")
    if columns.torque_command is not None and columns.position_target is not None:
        raise RecordingError(
            "column map: torque_command and position_target are both given; name the one the robot followed."
        )
    if columns.rate is not None and not (_is_number(columns.rate) and columns.rate > 0):
        raise RecordingError(f"column map: rate is {columns.rate!r}; give a number of samples a second above 0.")
    if columns.rate is not None and columns.time is not None:
        raise RecordingError("column map: time and rate are both given; rate is for files without stamps.")
    for key in ("kp", "kd"):
        if getattr(columns, key) is not None and not all(map(_is_number, _each(getattr(columns, key)))):
            raise RecordingError(f"column map: {key} is {getattr(columns, key)!r}; give one number, or one a joint.")
    for key in ("state_topic", "command_topic", "torque_semantics"):
        if not isinstance(getattr(columns, key), str | None):
            raise RecordingError(f"column map: {key} is {getattr(columns, key)!r}; give a text.")
    if not isinstance(columns.metadata, Mapping):
        raise RecordingError(f"column map: metadata is {columns.metadata!r}; give names with their values.")


def _refuse_unknown_keys(content: Mapping[str, Any], cls: type, where: str) -> None:
    known = [f.name for f in fields(cls)]
    if unknown := [key for key in content if key not in known]:
        raise RecordingError(f"unknown key {unknown[0]!r} in {where}; known are {', '.join(known)}.")
    if cls is Column and "name" not in content:
        raise RecordingError(f"{where} has no name; give the name in the file.")


def _each(value: Any) -> tuple[Any, ...]:
    return tuple(value) if isinstance(value, Sequence) and not isinstance(value, str) else (value,)


def _is_number(value: Any) -> bool:
    """Whether it is one finite number."""
    if isinstance(value, bool) or not isinstance(value, int | float | np.integer | np.floating):
        return False
    try:
        return math.isfinite(value)
    except OverflowError:  # a whole number too large for a float
        return False
