"""The folder of a diagnosis or a fit: one process writes there at a time, and answers of one kind."""

from __future__ import annotations

import fcntl
import os
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from contextvars import ContextVar
from pathlib import Path

from torchrl_athletic.recordings.whole_file import UNFINISHED

_HELD: ContextVar[frozenset[Path]] = ContextVar("folders that are locked here", default=frozenset())


@contextmanager
def locked(folder: Path, unlike: str) -> Iterator[None]:
    """Make the folder, and keep every other run out of it; one within this one may enter.

    What a process that was killed there left half written is removed; so is the folder, if nothing comes into it. File
    systems that know no locks are not locked.

    Args:
        folder: Where to write.
        unlike: File of the other kind of answer, whose ``corrected.json`` would be overwritten: ``fit.json`` to a
            diagnosis, ``diagnosis.json`` to a fit.

    Raises:
        BlockingIOError: If another diagnosis or fit is in it.
        FileExistsError: If the other kind of answer lies there.

    Example:
        >>> with locked(Path("out"), "fit.json"), locked(Path("out"), "fit.json"):
        ...     _ = Path("out/note.txt").write_text("mine alone")
    """
    if (folder / unlike).exists():
        raise FileExistsError(
            f"{folder} holds {unlike}, and its corrected.json would no longer be that one's. Name another --output."
        )
    folder.mkdir(parents=True, exist_ok=True)
    key = folder.resolve()
    if key in _HELD.get():
        yield
        return
    descriptor = os.open(folder, os.O_RDONLY)
    try:
        if _lock(descriptor, folder):
            for part in folder.glob(UNFINISHED):
                part.unlink(missing_ok=True)
        outside = _HELD.set(_HELD.get() | {key})
        try:
            yield
        finally:
            _HELD.reset(outside)
            with suppress(OSError):
                folder.rmdir()
    finally:
        os.close(descriptor)


def _lock(descriptor: int, folder: Path) -> bool:
    try:
        fcntl.flock(descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except BlockingIOError as error:
        raise BlockingIOError(
            f"{folder}: another run is writing there, and two would mix their answers. Wait until it has ended, "
            "or name another --output."
        ) from error
    except OSError:
        return False
    return True
