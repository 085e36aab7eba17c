"""Recordings from files and folders: which reader takes what."""

from __future__ import annotations

import os
from collections.abc import Callable, Iterable, Iterator
from pathlib import Path

from torchrl_athletic.recordings.formats.column_map import ColumnMap
from torchrl_athletic.recordings.formats.csv import read_csv
from torchrl_athletic.recordings.formats.hdf5 import read_hdf5
from torchrl_athletic.recordings.formats.lerobot import is_lerobot, read_lerobot
from torchrl_athletic.recordings.formats.mat import read_mat
from torchrl_athletic.recordings.formats.mcap import read_mcap
from torchrl_athletic.recordings.formats.npz import read_npz
from torchrl_athletic.recordings.formats.parquet import read_parquet
from torchrl_athletic.recordings.formats.rosbag import is_rosbag2, read_rosbag
from torchrl_athletic.recordings.formats.take import Take, recording_from_take
from torchrl_athletic.recordings.recording import Recording, RecordingError

_READERS: dict[str, Callable[[Path, ColumnMap], list[Take]]] = {
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


def read_recordings(
    path_or_paths: str | Path | Iterable[str | Path], columns: ColumnMap | None = None
) -> list[Recording]:
    """Read every take of a file, a folder, or several of them.

    - ``.npz``: the canonical format, one array a field of :class:`Recording`
    - ``.csv``, ``.csv.gz``: columns ``time``, ``position/<joint>`` or ``position_<joint>``, and so on
    - ``.parquet``: the same columns, or columns of lists
    - ``.h5``, ``.hdf5``: datasets named like the fields, at the root or one group a take; notes also as attributes
    - ``.mat``: variables named like the fields, or one struct a take
    - ``.bag``, ``.db3``, the folder of a ROS 2 bag: a topic of measured and a topic of commanded ``JointState``
    - ``.mcap``: the same, in CDR or JSON
    - the folder of a LeRobot data set (``meta/info.json``), v2.1 or v3: one recording an episode

    A folder is read with all folders below it, by name. Columns that no field is read from are listed in
    ``metadata["not_read"]``. Commands of bags are put on the stamps of the states by zero-order hold, never ahead:
    :func:`~torchrl_athletic.recordings.formats.joint_state.take_from_messages` says what that costs.

    Args:
        path_or_paths: File, folder or several.
        columns: Foreign names and units. None: the file uses our names and SI units.

    Returns:
        One recording a take, in the order of the paths and by name within a folder.

    Raises:
        RecordingError: If something is missing, damaged, ambiguous or impossible; says what, where and how to mend it.
        ImportError: If the library of a format is not installed; says how to install it.

    Example:
        >>> import numpy as np
        >>> from torchrl_athletic.recordings import Column
        >>> time = np.arange(0, 1, 0.01)
        >>> table = np.stack([1e3 * time, 90 * time, 0 * time], axis=1)
        >>> np.savetxt("log.csv", table, delimiter=",", header="t,angle,u")
        >>> columns = ColumnMap(
        ...     ("hinge",), time=Column("t", unit="ms"), position=Column("angle", unit="deg"), torque_command="u"
        ... )
        >>> [recording] = read_recordings("log.csv", columns)
        >>> print(recording.joint_names, recording.num_samples, recording.position[-1].round(3))
        ('hinge',) 100 [1.555]
    """
    paths = [path_or_paths] if isinstance(path_or_paths, str | Path) else list(path_or_paths)
    if not paths:
        raise RecordingError("no path to read recordings from; give a file or a folder.")
    columns = columns or ColumnMap()
    takes = (take for path in paths for source in _sources(Path(path)) for take in _read(source, columns))
    return [recording_from_take(take, columns) for take in takes]


def _read(source: Path, columns: ColumnMap) -> list[Take]:
    if not source.is_dir():
        return _READERS[_suffix(source)](source, columns)
    return read_lerobot(source, columns) if is_lerobot(source) else read_rosbag(source, columns)


def _sources(path: Path) -> list[Path]:
    """The files to read, and the folders that are one recording or data set as a whole."""
    if path.is_file():
        if _suffix(path) not in _READERS:
            raise RecordingError(
                f"{path}: {path.suffix or 'no suffix'} is not a known kind of file. Known are {', '.join(_READERS)}."
            )
        return [path]
    if not path.is_dir():
        raise RecordingError(f"{path}: there is no such file or folder.")
    found = list(_walk(path))
    if not found:
        names = sorted(str(p.relative_to(path)) for p in path.rglob("*") if p.is_file())
        listed = ", ".join(names[:20]) + (f" and {len(names) - 20} more" if len(names) > 20 else "")
        raise RecordingError(
            f"{path}: no file of a known kind ({', '.join(_READERS)}). Found are: {listed or 'no files'}."
        )
    return found


def _walk(folder: Path) -> Iterator[Path]:
    if is_lerobot(folder) or is_rosbag2(folder):
        yield folder
        return
    for entry in sorted(os.scandir(folder), key=lambda entry: entry.name):
        if entry.name.startswith("."):
            continue
        if entry.is_dir(follow_symlinks=False):
            yield from _walk(Path(entry.path))
        elif _suffix(Path(entry.path)) in _READERS:
            yield Path(entry.path)


def _suffix(path: Path) -> str:
    name = path.name.lower()
    return next(
        (suffix for suffix in sorted(_READERS, key=len, reverse=True) if name.endswith(suffix)), path.suffix.lower()
    )
