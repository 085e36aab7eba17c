"""LeRobot data sets, v2.1 and v3: ``meta/info.json`` and ``data/**.parquet``, one recording an episode."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from torchrl_athletic.recordings.formats.column_map import ColumnMap
from torchrl_athletic.recordings.formats.foreign_library import decoding
from torchrl_athletic.recordings.formats.parquet import read_columns
from torchrl_athletic.recordings.formats.take import RawTake, parse_json_object
from torchrl_athletic.recordings.recording import RecordingError

_STATE, _ACTION = "observation.state", "action"


def is_lerobot(folder: Path) -> bool:
    """Whether the folder is the root of a LeRobot data set."""
    return (folder / "meta" / "info.json").is_file()


def read_lerobot(folder: Path, columns: ColumnMap) -> list[RawTake]:
    """One take an episode, by episode index.

    The fields keep LeRobot's names ``observation.state`` and ``action``; joints named ``hip.pos`` are called ``hip``.
    Where state and action do not name the same joints (a state with velocities in it), they are split into
    ``observation.state/<name>`` and ``action/<name>``.

    Raises:
        RecordingError: If a file is malformed; or if the column map does not say what state and action are, since the
            data set does not: SO-101 logs degrees or -100..100, others radians.
    """
    if columns.position is None or (columns.position_target is None and columns.torque_command is None):
        raise RecordingError(
            f"{folder}: a LeRobot data set does not say its units and gains. Give them in a column map, for example "
            f"ColumnMap(position=Column('{_STATE}', unit='deg'), position_target=Column('{_ACTION}', unit='deg'), "
            "kp=20.0, kd=0.5)."
        )
    info_file = folder / "meta" / "info.json"
    with decoding(str(info_file), "UTF-8"):
        info = parse_json_object(info_file.read_text(encoding="utf-8"), str(info_file))
    files = sorted((folder / "data").rglob("*.parquet"))
    if not files:
        raise RecordingError(f"{folder}: no data/**.parquet beside meta/info.json. Download the data set in full.")
    episodes: dict[int, list[dict[str, NDArray[Any]]]] = {}
    for file in files:
        arrays, _ = read_columns(file)
        index = _column(arrays, "episode_index", file)
        if index.ndim != 1 or index.dtype.kind not in "iu":
            raise RecordingError(f"{file}: episode_index is of type {index.dtype}; needed is one whole number a row.")
        for episode in np.unique(index).tolist():
            rows = index == episode
            episodes.setdefault(episode, []).append({name: array[rows] for name, array in arrays.items()})
    names = {feature: _names(info, feature, info_file) for feature in (_STATE, _ACTION)}
    return [_take(folder, columns, info, episode, episodes[episode], names) for episode in sorted(episodes)]


def _take(
    folder: Path,
    columns: ColumnMap,
    info: dict[str, Any],
    episode: int,
    parts: list[dict[str, NDArray[Any]]],
    names: dict[str, list[str] | None],
) -> RawTake:
    source = f"{folder}: episode {episode}"
    if any(part.keys() != parts[0].keys() for part in parts):
        raise RecordingError(f"{source}: the files that hold it have different columns.")
    with decoding(source, "columns of one shape"):
        fields = {name: np.concatenate([part[name] for part in parts]) for name in parts[0] if name != "episode_index"}
    if columns.time is None and "timestamp" in fields:
        fields["time"] = fields.pop("timestamp")
    state = names[_STATE]
    if state is not None and names[_ACTION] in (None, state):
        plain = [name.removesuffix(".pos") for name in state] if all(name.endswith(".pos") for name in state) else state
        fields["joint_names"] = np.array(plain, dtype=np.str_)
    else:
        for feature, parts_of in names.items():
            if parts_of is not None and feature in fields:
                array = fields.pop(feature)
                if array.ndim != 2 or array.shape[1] != len(parts_of):
                    raise RecordingError(
                        f"{source}: {feature} has shape {array.shape}, but info.json names {', '.join(parts_of)}."
                    )
                fields |= {f"{feature}/{name}": array[:, i] for i, name in enumerate(parts_of)}
    robot = info.get("robot_type")
    return RawTake(source, fields, {"robot": robot, "episode": episode} if robot else {"episode": episode})


def _column(arrays: dict[str, NDArray[Any]], name: str, file: Path) -> NDArray[Any]:
    if name not in arrays:
        raise RecordingError(
            f"{file}: no column {name}; found are {', '.join(arrays)}. This is no LeRobot v2.1 or v3 data set."
        )
    return arrays[name]


def _names(info: dict[str, Any], feature: str, info_file: Path) -> list[str] | None:
    """Names of a feature's entries: a list, or one under "motors"."""
    features = info.get("features")
    described = features.get(feature) if isinstance(features, dict) else None
    names = described.get("names") if isinstance(described, dict) else None
    if isinstance(names, dict) and len(names) == 1:
        names = next(iter(names.values()))
    if names is None:
        return None
    if not isinstance(names, list) or not all(isinstance(name, str) for name in names) or len(set(names)) < len(names):
        raise RecordingError(f"{info_file}: names of {feature} are {names!r}; needed is a list of different texts.")
    return names
