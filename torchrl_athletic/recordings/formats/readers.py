"""Which reader takes what: a file by its suffix, a folder that is one bag or data set by what lies in it."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from pathlib import Path

from torchrl_athletic.recordings.formats.column_map import ColumnMap
from torchrl_athletic.recordings.formats.csv import read_csv
from torchrl_athletic.recordings.formats.foreign_library import decoding
from torchrl_athletic.recordings.formats.hdf5 import read_hdf5
from torchrl_athletic.recordings.formats.lerobot import is_lerobot, read_lerobot
from torchrl_athletic.recordings.formats.mat import read_mat
from torchrl_athletic.recordings.formats.mcap import read_mcap
from torchrl_athletic.recordings.formats.npz import read_npz
from torchrl_athletic.recordings.formats.parquet import read_parquet
from torchrl_athletic.recordings.formats.rosbag import is_rosbag2, read_rosbag
from torchrl_athletic.recordings.formats.take import RawTake, recording_from_take, with_commands
from torchrl_athletic.recordings.recording import Recording, RecordingError

_LEROBOT, _ROSBAG2 = "a LeRobot data set", "a ROS 2 bag"

SUFFIXES: dict[str, Callable[[Path, ColumnMap], Iterable[RawTake]]] = {
    ".npz": lambda path, _: read_npz(path),
    ".csv": lambda path, _: read_csv(path),
    ".csv.gz": lambda path, _: read_csv(path),
    ".parquet": lambda path, _: read_parquet(path),
    ".h5": read_hdf5,
    ".hdf5": read_hdf5,
    ".mat": read_mat,
    ".bag": read_rosbag,
    ".db3": read_rosbag,
    ".mcap": read_mcap,
}
"""Readers of files."""
_READERS = SUFFIXES | {_LEROBOT: read_lerobot, _ROSBAG2: read_rosbag}

_ROS = ("rosbags.highlevel", "rosbags.typesys", "rosbags.typesys.stores.ros2_humble")
_PARQUET = ("pyarrow.parquet", "pandas")  # by which pyarrow looks at dates, where it is installed
LIBRARIES = {
    ".npz": ("zipfile",),
    ".parquet": _PARQUET,
    ".h5": ("h5py",),
    ".hdf5": ("h5py",),
    ".mat": ("scipy.io", "h5py"),
    ".bag": _ROS,
    ".db3": _ROS,
    ".mcap": ("mcap.reader", "mcap_ros2.decoder"),
    _LEROBOT: _PARQUET,
    _ROSBAG2: _ROS,
}
"""What a reader imports when it is used, by kind of file."""


def read_source(source: Path, columns: ColumnMap) -> list[Recording]:
    """Every take of a file, or of a folder that is one bag or data set, read in this process.

    Raises:
        RecordingError: If something is missing, damaged, ambiguous or impossible.
        ImportError: If the library of the format is not installed.
    """
    with decoding(str(source), "a recording"):
        takes = _READERS[kind_of(source)](source, columns)
        if columns.command_file is not None:
            beside = source.parent / columns.command_file
            if not beside.is_file() or kind_of(beside) not in SUFFIXES:
                raise RecordingError(f"{source}: there is no {columns.command_file} beside it that could be read.")
            commands = list(SUFFIXES[kind_of(beside)](beside, columns))
            takes = [with_commands(take, commands, columns) for take in takes]
        return [recording_from_take(take, columns) for take in takes]


def kind_of(path: Path) -> str:
    """What is read as a whole: a known suffix or what a folder is; "" if it is neither."""
    if path.is_dir():
        return _LEROBOT if is_lerobot(path) else _ROSBAG2 if is_rosbag2(path) else ""
    name = path.name.lower()
    return max((suffix for suffix in SUFFIXES if name.endswith(suffix)), key=len, default="")
