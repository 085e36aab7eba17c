"""Files that are there as a whole, or not at all."""

from __future__ import annotations

import os
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

UNFINISHED = ".*.unfinished"
"""What a process that was killed leaves behind."""


@contextmanager
def whole_file(path: Path) -> Iterator[Path]:
    """A path beside ``path`` to write to; its file then takes the place of ``path`` in one step.

    If writing fails, nothing is left of it.

    Raises:
        OSError: The one that came, which names ``path``: a full disk alone does not say what it was full for.

    Example:
        >>> with whole_file(Path("answer.txt")) as part:
        ...     _ = part.write_text("42")
        >>> [path.name for path in Path(".").iterdir()]
        ['answer.txt']
    """
    part = path.with_name(f".{path.name}.{os.getpid()}{UNFINISHED.rpartition('*')[2]}")
    try:
        yield part
        os.replace(part, path)
    except OSError as error:
        if error.errno is not None:  # else it holds but a sentence
            error.filename = str(path)
        raise
    finally:
        part.unlink(missing_ok=True)
