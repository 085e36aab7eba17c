"""Reference motions made by hand: a few key poses in a file that can be read and written.

A file holds phases, a phase holds key poses, and a key pose says all of itself: what it leaves out is as in the robot's
default pose, not as in the key pose before. :mod:`torchrl_athletic.robots.motion_tables` makes tables of it.
"""

from __future__ import annotations

import json
import math
import re
import tomllib
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, fields
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np
import torch
from numpy.typing import ArrayLike, NDArray

from torchrl_athletic.functional.reference import interpolate_poses

Velocity = tuple[float, float, float]
SHIPPED = Path(__file__).with_name("motions")


@dataclass(frozen=True)
class KeyPose:
    """Where joints and base are at one time, at rest.

    Raises:
        ValueError: If a number is none, or the base lies in the ground or stands on its head.

    Example:
        >>> KeyPose(1.2, {"joint2": 0.8}, base_height=0.55).joints
        {'joint2': 0.8}
    """

    time: float
    """Since the phase's beginning [s]."""
    joints: Mapping[str, float] = field(default_factory=dict)
    """Positions by name [rad]. Joints not named are as in the robot's default pose."""
    base_height: float | None = None
    """Height over the ground [m]. None has the robot stand as in its default pose."""
    base_pitch: float = 0.0
    """Nose down [rad]."""
    base_velocity: Velocity = (0.0, 0.0, 0.0)
    """Velocity to command there: forward and to the left [m/s], counter-clockwise [rad/s]."""

    def __post_init__(self) -> None:
        where = f"key pose at {self.time} s"
        if not isinstance(self.joints, Mapping):
            raise ValueError(f"{where}: joints is {self.joints!r}, needed are positions by name: {{ joint2 = 0.8 }}.")
        if isinstance(self.base_velocity, str | float | int) or len(self.base_velocity) != 3:
            raise ValueError(
                f"{where}: base_velocity is {self.base_velocity!r}, needed are three numbers: forward and left [m/s], "
                "counter-clockwise [rad/s]."
            )
        numbers = {"time": self.time, "base_pitch": self.base_pitch}
        numbers |= {} if self.base_height is None else {"base_height": self.base_height}
        for name, value in numbers.items():
            object.__setattr__(self, name, _number(value, f"{where}: {name}"))
        joints = {name: _number(value, f"{where}: joints.{name}") for name, value in self.joints.items()}
        object.__setattr__(self, "joints", joints)
        velocity = tuple(_number(value, f"{where}: base_velocity") for value in self.base_velocity)
        object.__setattr__(self, "base_velocity", velocity)
        if self.base_height is not None and not self.base_height > 0:
            raise ValueError(f"{where}: base_height is {self.base_height} m, in the ground. Give more than 0.")
        if not abs(self.base_pitch) < math.pi / 2:
            raise ValueError(
                f"{where}: base_pitch is {self.base_pitch} rad, which turns the heading round. Give less than a right "
                "angle, in radians."
            )


@dataclass(frozen=True)
class PhaseMotion:
    """The key poses of one phase.

    Raises:
        ValueError: If there is none, the first is not at 0 s, or times do not rise.
    """

    name: str
    poses: tuple[KeyPose, ...]
    """Key poses in the order of their times, the first at 0 s."""

    def __post_init__(self) -> None:
        object.__setattr__(self, "poses", tuple(self.poses))
        if not self.name or not isinstance(self.name, str):
            raise ValueError(f"a phase's name is {self.name!r}. Give the name that the task has for it.")
        times = [pose.time for pose in self.poses]
        if not times or times[0] != 0:
            raise ValueError(
                f"phase {self.name!r}: its first pose is at {times[0] if times else 'no'} s, needed is one at time = "
                "0.0, where the phase begins."
            )
        for before, after in pairwise(times):
            if not after > before:
                raise ValueError(
                    f"phase {self.name!r}: after the pose at time = {before} s comes one at {after} s. Times have to "
                    "rise; they count from the phase's own beginning."
                )

    @property
    def duration(self) -> float:
        """[s]. Afterwards the last pose holds."""
        return self.poses[-1].time


@dataclass(frozen=True)
class Motion:
    """Phases that follow one another.

    Raises:
        ValueError: If there is no phase, or two have one name.
    """

    name: str
    phases: tuple[PhaseMotion, ...]
    robot: str | None = None
    """Name of the robot that it is made for; None fits all that have its joints."""

    def __post_init__(self) -> None:
        object.__setattr__(self, "phases", tuple(self.phases))
        names = [phase.name for phase in self.phases]
        if not names or len(set(names)) < len(names):
            raise ValueError(f"phases are {names}. Give at least one [[phase]], each of a name of its own.")
        if self.robot is not None and not isinstance(self.robot, str):
            raise ValueError(f"robot is {self.robot!r}, needed is a robot's name, or none.")


def read_motion(source: str | Path) -> Motion:
    """Read a motion from a TOML file.

    .. code-block:: toml

        robot = "b2z1"

        [[phase]]
        name = "throw-set-up"

        [[phase.pose]]
        time = 0.0  # s

        [[phase.pose]]
        time = 1.2
        joints = { joint2 = 0.8, joint3 = -2.3 }  # rad
        base_height = 0.55  # m over the ground
        base_pitch = -0.1  # rad, nose down positive
        base_velocity = [0.0, 0.0, 0.0]  # m/s, m/s, rad/s

    Args:
        source: Path of the file; a string without ``.toml`` at its end is the name of a shipped motion: ``"throw"``,
            ``"snatch"``, ``"sled"``.

    Raises:
        ValueError: If the file has an unknown key, lacks one, or holds a value that cannot be right.

    Example:
        >>> [(phase.name, phase.duration) for phase in read_motion("throw").phases]
        [('throw-set-up', 2.5), ('throw', 1.0), ('settle', 1.5)]
    """
    path = Path(source)
    if isinstance(source, str) and path.suffix != ".toml":
        path = SHIPPED / f"{source}.toml"
        if not path.is_file():
            names = sorted(file.stem for file in SHIPPED.glob("*.toml"))
            raise ValueError(f"no motion {source!r} is shipped. Take one of {names}, or give the path of a .toml file.")
    try:
        return _motion_of(path.stem, tomllib.loads(path.read_text(encoding="utf-8")))
    except ValueError as error:
        raise ValueError(f"{path}: {error}") from error


def write_motion(motion: Motion, path: str | Path) -> Path:
    """Write a motion as :func:`read_motion` reads it. The motion's name is that of the file.

    Args:
        motion: What to write.
        path: ``.toml``; its folder is made.

    Returns:
        The path.

    Example:
        >>> path = write_motion(read_motion("sled"), "sled.toml")
        >>> read_motion(path) == read_motion("sled")
        True
    """
    path = Path(path)
    if path.suffix != ".toml":
        raise ValueError(f"{path.name}: a motion is a .toml file. Name it so.")
    lines = [] if motion.robot is None else [f"robot = {_quoted(motion.robot)}", ""]
    for phase in motion.phases:
        lines += ["[[phase]]", f"name = {_quoted(phase.name)}", ""]
        for pose in phase.poses:
            lines += ["[[phase.pose]]", *_pose_lines(pose), ""]
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text("\n".join(lines[:-1]) + "\n", encoding="utf-8")
    return path


def motion_from_table(
    time: ArrayLike,
    joint_position: ArrayLike,
    joint_names: Sequence[str],
    name: str,
    phase: str,
    tolerance: float = 0.02,
    *,
    base_height: ArrayLike | None = None,
    base_pitch: ArrayLike | None = None,
) -> Motion:
    """Key poses of a motion that was recorded, as few as one walk through it finds.

    From one key pose it goes to the farthest sample that lets everything between stay within the tolerance of the
    samples. Swift motions that do not come to rest take many: the quintic rests at each key pose, and is 15/8 as fast
    between them as a straight line, which :func:`check_motion` holds against the limits.

    Args:
        time: Of the samples, such as of a :class:`~torchrl_athletic.recordings.Recording` [s]. Shape (T,).
        joint_position: [rad]. Shape (T, J).
        joint_names: Length J.
        name: Of the motion.
        phase: Name of the one phase that it becomes.
        tolerance: Largest distance from the samples, of joints [rad] and base [m, rad]. At least 0.001, since key
            poses are rounded to 0.0001.
        base_height: Over the ground, for a floating base [m]. Shape (T,).
        base_pitch: Nose down [rad]. Shape (T,).

    Returns:
        A motion for any robot of these joints. It starts where the samples do.

    Raises:
        ValueError: If shapes do not fit, values are not finite or times do not rise.

    Example:
        >>> time = np.linspace(0.0, 1.0, 101)
        >>> nod = 0.4 * time**3 * (10 - 15 * time + 6 * time**2)
        >>> motion_from_table(time, nod[:, None], ["joint2"], "nod", "nod").phases[0].poses[1:]
        (KeyPose(time=1.0, joints={'joint2': 0.4}, base_height=None, base_pitch=0.0, base_velocity=(0.0, 0.0, 0.0)),)
    """
    if not 0.001 <= tolerance < math.inf:
        raise ValueError(f"tolerance is {tolerance}, needed is 0.001 or more: key poses are rounded to 0.0001.")
    base = {
        name: value for name, value in (("base_height", base_height), ("base_pitch", base_pitch)) if value is not None
    }
    times, samples = _samples(time, joint_position, joint_names, base)
    poses, count = samples.round(4), len(joint_names)
    chosen = [0]
    while chosen[-1] < len(times) - 1:
        chosen.append(_farthest(times, samples, poses, chosen[-1], tolerance))
    keys = [
        KeyPose(
            float(times[row]),
            dict(zip(joint_names, poses[row, :count].tolist(), strict=True)),
            **dict(zip(base, poses[row, count:].tolist(), strict=True)),
        )
        for row in chosen
    ]
    return Motion(name, (PhaseMotion(phase, tuple(keys)),))


def _motion_of(name: str, table: Mapping[str, Any]) -> Motion:
    _check_keys(table, ("robot", "phase"), "the file")
    phases = []
    for number, given in enumerate(_tables_of(table, "phase", "the file"), 1):
        where = f"phase {number}"
        _check_keys(given, ("name", "pose"), where)
        if "name" not in given:
            raise ValueError(f"{where} has no name. Give the name that the task has for it.")
        where = f"phase {given['name']!r}"
        poses = []
        for count, pose in enumerate(_tables_of(given, "pose", where), 1):
            _check_keys(pose, [part.name for part in fields(KeyPose)], f"{where}, pose {count}")
            if "time" not in pose:
                raise ValueError(f"{where}, pose {count} has no time. Give seconds since the phase's beginning.")
            try:
                poses.append(KeyPose(**pose))
            except ValueError as error:
                raise ValueError(f"{where}: {error}") from error
        phases.append(PhaseMotion(given["name"], tuple(poses)))
    return Motion(name, tuple(phases), table.get("robot"))


def _check_keys(table: Mapping[str, Any], known: Sequence[str], where: str) -> None:
    if unknown := [key for key in table if key not in known]:
        raise ValueError(
            f"{where} has {unknown[0]!r}, which no motion has. Known are {list(known)}: correct it or leave it out."
        )


def _tables_of(table: Mapping[str, Any], key: str, where: str) -> list[dict[str, Any]]:
    """The tables that stand one after another under one name."""
    given = table.get(key, [])
    header = "[[phase]]" if key == "phase" else f"[[phase.{key}]]"
    if not isinstance(given, list) or not given or not all(isinstance(one, dict) for one in given):
        raise ValueError(f"{where} has {given!r} for {key!r}, needed is at least one table. Begin it with {header}.")
    return given


def _number(value: object, what: str) -> float:
    if isinstance(value, bool) or not isinstance(value, int | float) or not math.isfinite(value):
        raise ValueError(f"{what} is {value!r}, needed is a finite number. Correct it.")
    return float(value)


def _pose_lines(pose: KeyPose) -> list[str]:
    lines = [f"time = {pose.time!r}"]
    if pose.joints:
        lines.append(f"joints = {{ {', '.join(f'{_key(name)} = {value!r}' for name, value in pose.joints.items())} }}")
    if pose.base_height is not None:
        lines.append(f"base_height = {pose.base_height!r}")
    if pose.base_pitch:
        lines.append(f"base_pitch = {pose.base_pitch!r}")
    if any(pose.base_velocity):
        lines.append(f"base_velocity = {list(pose.base_velocity)!r}")
    return lines


def _key(name: str) -> str:
    return name if re.fullmatch(r"[A-Za-z0-9_-]+", name) else _quoted(name)


def _quoted(text: str) -> str:
    return json.dumps(text, ensure_ascii=False)


def _samples(
    time: ArrayLike, joint_position: ArrayLike, joint_names: Sequence[str], base: Mapping[str, ArrayLike]
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Times from 0 on [s], shape (T,), and joints and base side by side, shape (T, D)."""
    times, position = np.asarray(time, np.float64), np.asarray(joint_position, np.float64)
    if times.ndim != 1 or len(times) == 0 or position.shape != (len(times), len(joint_names)):
        raise ValueError(
            f"time has the shape {times.shape}, joint_position {position.shape} for {len(joint_names)} joint_names; "
            "needed are (T,) and (T, J) with at least one sample."
        )
    columns = {name: np.asarray(column, np.float64) for name, column in base.items()}
    for name, column in columns.items():
        if column.shape != times.shape:
            raise ValueError(f"{name} has the shape {column.shape}, needed is that of time, {times.shape}.")
    samples = np.column_stack([position, *columns.values()])
    if not (np.diff(times) > 1e-6).all() or not np.isfinite(samples).all() or not np.isfinite(times).all():
        raise ValueError(
            "time does not rise, or there is a sample that is not finite: nothing can be fitted to that. Leave out "
            "such samples."
        )
    return (times - times[0]).round(6), samples


def _farthest(
    times: NDArray[np.float64],
    samples: NDArray[np.float64],
    poses: NDArray[np.float64],
    start: int,
    tolerance: float,
) -> int:
    """Number of the farthest sample to which one quintic from a key pose stays close to all samples between."""
    ahead = samples[start:]
    # The quintic of a joint rises or falls: no sample beyond a fall and a rise of twice the tolerance is in its reach.
    fall, rise = np.maximum.accumulate(ahead) - ahead, ahead - np.minimum.accumulate(ahead)
    turned = ((np.maximum.accumulate(fall) > 2 * tolerance) & (np.maximum.accumulate(rise) > 2 * tolerance)).any(1)
    last = start + (int(turned.argmax()) if turned.any() else len(ahead) - 1)
    ends = np.arange(start + 2, last + 1)
    probes = start + np.multiply.outer(ends - start, np.linspace(0, 1, 17)).astype(int)  # few samples tell most ends
    for end in ends[_stay_close(times, samples, poses, start, ends, probes, tolerance)][::-1]:
        between = np.arange(start, end + 1)[None]
        if _stay_close(times, samples, poses, start, end[None], between, tolerance)[0]:
            return int(end)
    return start + 1


def _stay_close(
    times: NDArray[np.float64],
    samples: NDArray[np.float64],
    poses: NDArray[np.float64],
    start: int,
    ends: NDArray[np.int64],
    probes: NDArray[np.int64],
    tolerance: float,
) -> NDArray[np.bool_]:
    """Whether the quintics from one key pose to E others stay close to K samples each, shape (E, K). Shape (E,)."""
    share = (times[probes] - times[start]) / (times[ends] - times[start])[:, None]
    unit = torch.tensor([0.0, 1.0], dtype=torch.float64)
    smooth = interpolate_poses(unit, unit[:, None], torch.from_numpy(share.ravel())).numpy()
    passed = poses[start] + smooth.reshape(*share.shape, 1) * (poses[ends] - poses[start])[:, None]
    return (np.abs(passed - samples[probes]) <= tolerance).all((1, 2))
