"""Recordings from files and folders."""

from __future__ import annotations

import os
from collections.abc import Iterable, Iterator
from pathlib import Path

from torchrl_athletic.recordings.formats.child import read_in_child
from torchrl_athletic.recordings.formats.column_map import ColumnMap
from torchrl_athletic.recordings.formats.readers import SUFFIXES, kind_of
from torchrl_athletic.recordings.recording import Recording, RecordingError


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

    Every file is read in a process of its own, which may take 15 s and 1.5 GB of memory, and more with the size of the
    file: one that crashes its library, or never ends, is refused like any other.

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
    sources = (source for path in paths for source in sources_of(Path(path)))
    states = (source for source in sources if source.name != columns.command_file)
    return [recording for source in states for recording in read_in_child(source, columns)]


def sources_of(path: Path) -> list[Path]:
    """The files to read, and the folders that are one recording or data set as a whole."""
    if not path.exists():
        raise RecordingError(f"{path}: there is no such file or folder.")
    if not path.is_dir() and not kind_of(path):
        raise RecordingError(
            f"{path}: {path.suffix or 'no suffix'} is not a known kind of file. Known are {', '.join(SUFFIXES)}."
        )
    found = [path] if kind_of(path) else list(_walk(path))
    if not found:
        names = sorted(str(p.relative_to(path)) for p in path.rglob("*") if p.is_file())
        listed = ", ".join(names[:20]) + (f" and {len(names) - 20} more" if len(names) > 20 else "")
        raise RecordingError(
            f"{path}: no file of a known kind ({', '.join(SUFFIXES)}). Found are: {listed or 'no files'}."
        )
    for source in found:
        _refuse_what_is_no_file(source)
    return found


def _walk(folder: Path) -> Iterator[Path]:
    if kind_of(folder):
        yield folder
        return
    for entry in sorted(os.scandir(folder), key=lambda entry: entry.name):
        if entry.name.startswith("."):
            continue
        if entry.is_dir(follow_symlinks=False):
            yield from _walk(Path(entry.path))
        elif not entry.is_dir() and kind_of(Path(entry.path)):
            yield Path(entry.path)


def _refuse_what_is_no_file(source: Path) -> None:
    """Pipes and devices, which have no end, also where a link leads to one."""
    for path in source.rglob("*") if source.is_dir() else [source]:
        if not path.is_file() and not path.is_dir():
            raise RecordingError(
                f"{path}: is a pipe, a device, or a link to something that is not there. Copy its content to a file."
            )
