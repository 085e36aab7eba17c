"""Format libraries are imported when used, and whatever they raise is told in our words."""

from __future__ import annotations

import importlib
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

from torchrl_athletic.recordings.recording import RecordingError

DAMAGED = (
    "The file is damaged, cut off, or of another kind than its suffix says: copy or record it again, or export it to "
    "another format."
)


def import_format_library(module: str) -> Any:
    """Import an optional library.

    Raises:
        ImportError: If it is not installed; the message says how to install it.
    """
    try:
        return importlib.import_module(module)
    except ImportError as error:
        raise ImportError(
            f"reading or writing this format needs the library {module.split('.')[0]!r}, which cannot be imported "
            f"({error}). Run: pip install torchrl-athletic[formats]",
            name=module,
        ) from error


@contextmanager
def decoding(source: str, content: str) -> Iterator[None]:
    """Turn what a library raises on damaged bytes into a :class:`RecordingError`.

    Args:
        source: File, and the field or topic within it.
        content: What the bytes should have been, such as "an npz archive".
    """
    try:
        yield
    except (RecordingError, ImportError, MemoryError):
        raise
    except Exception as error:  # damaged bytes make a decoder raise any exception there is
        raise RecordingError(
            f"{source}: cannot be read as {content} ({type(error).__name__}: {error}). {DAMAGED}"
        ) from error
