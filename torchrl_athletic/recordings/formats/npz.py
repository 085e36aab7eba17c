"""The canonical file: one array a field in an npz archive, text as text, nothing pickled."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import fields
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from torchrl_athletic.recordings.formats.foreign_library import decoding
from torchrl_athletic.recordings.formats.metadata import metadata_text
from torchrl_athletic.recordings.formats.take import Fields, RawTake
from torchrl_athletic.recordings.recording import Recording, RecordingError


def read_npz(path: Path) -> Iterator[RawTake]:
    """The one take of an npz archive."""
    with decoding(str(path), "an npz archive"):
        archive = np.load(path, allow_pickle=False)
    if not isinstance(archive, np.lib.npyio.NpzFile):
        raise RecordingError(
            f"{path}: holds one bare array, not an npz archive. Write it with numpy.savez(path, time=..., "
            "position=...)."
        )

    def load(name: str) -> NDArray[Any]:
        with decoding(f"{path}: {name}", "an array of numbers or text"):
            return np.asarray(archive[name])

    with archive:
        yield RawTake(str(path), Fields({name: partial(load, name) for name in archive.files}))


def write_npz(recording: Recording, path: Path) -> None:
    """Write one array a field; ``joint_names``, ``torque_semantics`` and ``metadata`` (JSON) as text."""
    arrays: dict[str, Any] = {f.name: getattr(recording, f.name) for f in fields(recording) if f.name != "source"}
    arrays["joint_names"] = np.array(recording.joint_names, dtype=np.str_)
    arrays["metadata"] = metadata_text(recording)
    with path.open("wb") as file:
        np.savez_compressed(
            file, allow_pickle=False, **{name: value for name, value in arrays.items() if value is not None}
        )
