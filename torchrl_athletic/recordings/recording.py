"""One continuous take of a robot: what it was told, and what its encoders said."""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, fields, replace
from functools import cached_property
from typing import Any, Literal

import numpy as np
from numpy.typing import ArrayLike, NDArray

TorqueSemantics = Literal["link_side", "current_derived"]

_PER_SAMPLE = ("position", "velocity", "torque_command", "position_target", "torque_measured")
_PER_JOINT = ("kp", "kd")
_OF_BASE = {"base_position": 3, "base_orientation": 4}
_UNIT = 0.01
"""How much the length of a quaternion may differ from one: more than rounding to three decimals makes of it."""


_LONGEST = 3000
"""Characters of a message; a damaged file can have names of a gigabyte."""


class RecordingError(ValueError):
    """A recording that cannot be used as it is; the message names the file, the field, the row and the mend."""

    def __init__(self, message: str) -> None:
        half = _LONGEST // 2
        super().__init__(message if len(message) <= _LONGEST else f"{message[:half]} [...] {message[-half:]}")


BEGAN = "piece_of_take_begun_at"
"""Key of a piece's metadata: stamp at which its whole take began [s], by which slow drifts and pushes count."""
MEAN_READING = "piece_of_take_that_reads"
"""Another: what tells its whole take from others, :attr:`Recording.mean_reading`."""


@dataclass(frozen=True, eq=False)
class Recording:
    """One continuous take, in SI units, in the order of ``joint_names``.

    Exactly one of ``torque_command`` and ``position_target`` is the command. A command stamped ``t``
    acts from ``t`` until the next stamp (zero-order hold).

    Raises:
        RecordingError: If a shape, a length or a value cannot be right.

    Example:
        >>> import numpy as np
        >>> time = np.arange(0.0, 1.0, 0.01)
        >>> recording = Recording(time, ("hinge",), np.sin(time)[:, None], torque_command=np.zeros((100, 1)))
        >>> recording.num_joints, round(recording.rate)
        (1, 100)
    """

    time: NDArray[np.float64]
    """Sample times [s]. Shape (T,), strictly increasing."""
    joint_names: tuple[str, ...]
    """Names as in the model. Length J."""
    position: NDArray[np.float64]
    """Measured position [rad, m for slides]. Shape (T, J)."""
    velocity: NDArray[np.float64] | None = None
    """Measured velocity [rad/s, m/s]. Shape (T, J). None when the robot does not log it."""
    torque_command: NDArray[np.float64] | None = None
    """Torque sent to the motor [N·m, N]. Shape (T, J)."""
    position_target: NDArray[np.float64] | None = None
    """Target of the joint's PD controller [rad, m]. Shape (T, J). Needs ``kp`` and ``kd``."""
    kp: NDArray[np.float64] | None = None
    """Proportional gain [N·m/rad]. Shape (J,)."""
    kd: NDArray[np.float64] | None = None
    """Derivative gain [N·m·s/rad]. Shape (J,)."""
    torque_measured: NDArray[np.float64] | None = None
    """Measured torque [N·m]. Shape (T, J)."""
    torque_semantics: TorqueSemantics | None = None
    """Where ``torque_measured`` comes from: a sensor on the link, or motor current times a constant."""
    base_position: NDArray[np.float64] | None = None
    """Where the base of a floating robot was: origin of the body with the free joint, in the world [m].
    Shape (T, 3)."""
    base_orientation: NDArray[np.float64] | None = None
    """Its attitude as unit quaternion w, x, y, z, from the body's frame to the world's. Shape (T, 4). Either sign."""
    metadata: Mapping[str, Any] = field(default_factory=dict)
    """JSON-compatible notes: robot, payload, excitation, fixture, repeat id."""
    source: str = "memory"
    """The file it came from; every error message starts with it."""

    def __post_init__(self) -> None:
        object.__setattr__(self, "time", _floats(self, "time"))
        object.__setattr__(self, "joint_names", _names(self))
        for name in (*_PER_SAMPLE, *_PER_JOINT, *_OF_BASE):
            if getattr(self, name) is not None:
                object.__setattr__(self, name, _floats(self, name))
        _check(self)

    @property
    def num_joints(self) -> int:
        """Number of joints J."""
        return len(self.joint_names)

    @property
    def num_samples(self) -> int:
        """Number of samples T."""
        return len(self.time)

    @property
    def duration(self) -> float:
        """Time between the first and the last sample [s]."""
        return float(self.time[-1] - self.time[0])

    @property
    def began(self) -> float:
        """Stamp at which the take began that this is a piece of [s], by ``metadata[BEGAN]``; else its own first one."""
        noted = self.metadata.get(BEGAN)
        return float(noted) if isinstance(noted, int | float) and noted <= self.time[0] else float(self.time[0])

    @cached_property
    def mean_reading(self) -> float:
        """What tells a take from others: the time average of all joints' readings, the k-th of them counted k times.

        A piece of a take has that of the take, by ``metadata[MEAN_READING]``.
        """
        noted = self.metadata.get(MEAN_READING)
        if isinstance(noted, int | float):
            return float(noted)
        mean = np.trapezoid(self.position, self.time, axis=0) / self.duration
        return float(mean @ (1.0 + np.arange(self.num_joints)))

    @property
    def rate(self) -> float:
        """Median sampling rate [Hz]."""
        return float(1.0 / np.median(np.diff(self.time)))

    @property
    def command(self) -> NDArray[np.float64]:
        """Whatever was commanded: ``torque_command`` or ``position_target``. Shape (T, J)."""
        command = self.torque_command if self.torque_command is not None else self.position_target
        assert command is not None  # _check saw to it
        return command

    def driven_by_measured_torque(self) -> Recording:
        """A copy whose command is the measured torque, which takes the torque loop out of the question."""
        if self.metadata.get("driven_by") == "torque_measured":
            return self
        if self.torque_measured is None:
            raise RecordingError(
                f"{self.source}: there is no torque_measured to drive the simulation with. "
                "Use the commanded torque (drive='command'), or log the motor current."
            )
        driven = replace(self, torque_command=self.torque_measured, position_target=None, kp=None, kd=None)
        return replace(driven, torque_measured=None, torque_semantics=None)

    def ordered(self, joint_names: Sequence[str]) -> Recording:
        """A copy with its joints in another order.

        Raises:
            RecordingError: If the names are not the same joints.
        """
        if set(joint_names) != set(self.joint_names) or len(joint_names) != self.num_joints:
            raise RecordingError(
                f"{self.source}: joint_names are {self.joint_names}, needed are {tuple(joint_names)}. "
                "Diagnose takes of the same joints together."
            )
        order = [self.joint_names.index(name) for name in joint_names]
        if order == list(range(self.num_joints)):
            return self
        moved = {
            name: getattr(self, name)[..., order]
            for name in (*_PER_SAMPLE, *_PER_JOINT)
            if getattr(self, name) is not None
        }
        return replace(self, joint_names=tuple(joint_names), **moved)

    def with_base_held(self, position: ArrayLike, orientation: ArrayLike = (1.0, 0.0, 0.0, 0.0)) -> Recording:
        """A copy that says that the base stood still, such as with a clamped trunk and the legs in the air.

        Args:
            position: Of the base in the world [m]. Shape (3,).
            orientation: Unit quaternion w, x, y, z. Shape (4,).
        """
        position, orientation = (np.tile(value, (self.num_samples, 1)) for value in (position, orientation))
        return replace(self, base_position=position, base_orientation=orientation)

    def slice(self, start: int, stop: int) -> Recording:
        """Samples ``start`` to ``stop`` as a recording of its own."""
        rows = np.arange(self.num_samples)
        return self.where((rows >= start) & (rows < stop))

    def where(self, kept: NDArray[np.bool_]) -> Recording:
        """The samples that are kept, shape (T,), as if the others had not been logged."""
        cut = {
            f.name: getattr(self, f.name)[kept]
            for f in fields(self)
            if f.name in ("time", *_PER_SAMPLE, *_OF_BASE) and getattr(self, f.name) is not None
        }
        return replace(self, **cut)


def _names(recording: Recording) -> tuple[str, ...]:
    names = recording.joint_names
    if isinstance(names, str | bytes):
        raise RecordingError(
            f"{recording.source}: joint_names is the text {names!r}, which would name one joint a letter. "
            f"Give a sequence of names, such as ({names!r},)."
        )
    return tuple(str(name) for name in names)


def _floats(recording: Recording, name: str) -> NDArray[np.float64]:
    """As a read-only copy. Text, booleans and complex numbers, which NumPy would convert, mean a wrong column."""
    value: ArrayLike = getattr(recording, name)
    try:
        given = np.asarray(value)
    except (TypeError, ValueError) as error:  # rows of different lengths
        raise RecordingError(
            f"{recording.source}: {name} is no array of numbers ({error}). Convert it to floats in SI units."
        ) from error
    if given.dtype.kind not in "iuf":
        raise RecordingError(
            f"{recording.source}: {name} holds something that is not a number (type {given.dtype}). "
            "Convert it to floats in SI units."
        )
    array = np.array(given, dtype=np.float64)
    array.setflags(write=False)
    return array


def _check(r: Recording) -> None:
    samples, joints = len(np.atleast_1d(r.time)), len(r.joint_names)
    if r.time.ndim != 1 or samples < 2:
        raise RecordingError(
            f"{r.source}: time has shape {r.time.shape}, needed is (T,) with T >= 2. "
            "Store one stamp a sample, in seconds."
        )
    if joints == 0 or len(set(r.joint_names)) != joints:
        raise RecordingError(f"{r.source}: joint_names {r.joint_names} must name each joint once, as the model does.")
    shapes = {**dict.fromkeys(_PER_SAMPLE, (samples, joints)), **dict.fromkeys(_PER_JOINT, (joints,))}
    for name, shape in shapes.items():
        value = getattr(r, name)
        if value is not None and value.shape != shape:
            raise RecordingError(
                f"{r.source}: {name} has shape {value.shape}, but time ({samples} samples) and joint_names "
                f"({joints} joints) ask for {shape}. One row a sample and one column a joint."
            )
    _check_base(r)
    for name in ("time", *_PER_SAMPLE, *_OF_BASE):
        value = getattr(r, name)
        if value is not None and not np.isfinite(value).all():
            row = int(np.argwhere(~np.isfinite(value))[0][0])
            raise RecordingError(
                f"{r.source}: {name} is {np.ravel(value[row])} at row {row}. Cut the take there, or leave those rows "
                "out: a gap in time is understood, a NaN is not."
            )
    step = np.diff(r.time)
    if (step <= 0).any():
        row = int(np.argmax(step <= 0)) + 1
        raise RecordingError(
            f"{r.source}: time goes from {r.time[row - 1]:.6f} s to {r.time[row]:.6f} s at row {row}. Stamps must "
            "increase: drop the duplicates, or split the file where the clock was set back."
        )
    _check_command(r)
    _check_metadata(r)


def _check_base(r: Recording) -> None:
    missing = [name for name in _OF_BASE if getattr(r, name) is None]
    if len(missing) == 1:
        raise RecordingError(
            f"{r.source}: {missing[0]} is missing. The pose of the base is base_position (T, 3) in m and "
            "base_orientation (T, 4), w x y z; give both, constant ones of a base that was held, or neither."
        )
    for name, columns in _OF_BASE.items():
        value = getattr(r, name)
        if value is not None and value.shape != (len(r.time), columns):
            raise RecordingError(
                f"{r.source}: {name} has shape {value.shape}, needed is ({len(r.time)}, {columns}): one row for each "
                "stamp in time. Interpolate the base's log at the joints' stamps."
            )
    if r.base_orientation is not None:
        length = np.linalg.norm(r.base_orientation, axis=1)
        wrong = np.abs(length - 1.0) > _UNIT
        if wrong.any():
            row = int(np.argmax(wrong))
            raise RecordingError(
                f"{r.source}: base_orientation is {r.base_orientation[row]} at row {row}, of length {length[row]:.3g}. "
                "Give unit quaternions, w first; Euler angles and rotation vectors must be converted."
            )


def _check_command(r: Recording) -> None:
    if (r.torque_command is None) == (r.position_target is None):
        found = "both" if r.torque_command is not None else "neither"
        raise RecordingError(
            f"{r.source}: {found} of torque_command and position_target given. Name the one command that the robot "
            "followed."
        )
    if r.position_target is not None:
        missing = [name for name in _PER_JOINT if getattr(r, name) is None]
        if missing:
            raise RecordingError(
                f"{r.source}: position_target needs the gains {' and '.join(missing)} (J,), in N·m/rad and N·m·s/rad, "
                "since the torque depends on them. Add them, even as a first guess: gain_mismatch then tells how wrong "
                "they are."
            )
    for name in _PER_JOINT:
        gain = getattr(r, name)
        if gain is not None and not (np.isfinite(gain) & (gain >= 0)).all():
            raise RecordingError(
                f"{r.source}: {name} is {gain}. Give finite gains that are not negative: a negative one pushes away "
                "from the target."
            )
    if (r.torque_measured is None) != (r.torque_semantics is None):
        raise RecordingError(
            f"{r.source}: torque_measured and torque_semantics go together. Say 'link_side' for a torque sensor, "
            "'current_derived' for motor current times a constant."
        )
    if r.torque_semantics not in (None, "link_side", "current_derived"):
        raise RecordingError(
            f"{r.source}: torque_semantics is {r.torque_semantics!r}; known are 'link_side' and 'current_derived'."
        )


def _check_metadata(r: Recording) -> None:
    if not isinstance(r.metadata, Mapping):
        raise RecordingError(f"{r.source}: metadata is {r.metadata!r}. Give a dict of notes, or leave it out.")
    for key, value in r.metadata.items():
        try:
            same = json.loads(json.dumps(value, allow_nan=False)) == value
        except (TypeError, ValueError, RecursionError):
            same = False
        if not same or not isinstance(key, str):
            raise RecordingError(
                f"{r.source}: metadata {key!r} is {value!r}, which JSON cannot keep. Use texts, finite numbers, lists "
                "and dicts with text keys."
            )
