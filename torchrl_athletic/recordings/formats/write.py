"""Recordings to files."""

from __future__ import annotations

from pathlib import Path

from torchrl_athletic.recordings.formats.mcap import write_mcap
from torchrl_athletic.recordings.formats.npz import write_npz
from torchrl_athletic.recordings.formats.parquet import write_parquet
from torchrl_athletic.recordings.recording import Recording, RecordingError
from torchrl_athletic.recordings.whole_file import whole_file

_WRITERS = {".npz": write_npz, ".parquet": write_parquet, ".mcap": write_mcap}


def write_recording(recording: Recording, path: str | Path) -> None:
    """Write ``.npz`` (canonical), ``.parquet`` or ``.mcap`` (ROS 2 ``JointState``), by suffix.

    Reading the file gives the same recording, bit for bit, but for ``source``. A file that is already there is replaced
    in one step: nobody sees half of the new one.

    Raises:
        RecordingError: If the suffix is unknown, or the format cannot hold the recording.
        ImportError: If the library of the format is not installed; says how to install it.
        OSError: If the disk is full, or the folder cannot be written to; names the file.

    Example:
        >>> import numpy as np
        >>> time = np.arange(0.0, 1.0, 0.01)
        >>> recording = Recording(time, ("hinge",), np.sin(time)[:, None], torque_command=np.zeros((100, 1)))
        >>> write_recording(recording, "take.npz")
    """
    path = Path(path)
    writer = _WRITERS.get(path.suffix.lower())
    if writer is None:
        raise RecordingError(
            f"{path}: {path.suffix or 'no suffix'} cannot be written. Known are {', '.join(_WRITERS)}."
        )
    with whole_file(path) as part:
        writer(recording, part)
