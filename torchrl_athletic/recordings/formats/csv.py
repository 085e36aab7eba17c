"""CSV, plain or gzipped: one row a sample, named columns."""

from __future__ import annotations

import csv
import gzip
import json
from contextlib import suppress
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from torchrl_athletic.recordings.formats.foreign_library import decoding
from torchrl_athletic.recordings.formats.take import RawTake, is_number
from torchrl_athletic.recordings.recording import RecordingError

_LONGEST = 1000
"""Characters of a text that are kept; no number has more."""


def read_csv(path: Path) -> list[RawTake]:
    """The one take of a CSV file with a header, separated by comma, semicolon or tab."""
    with decoding(str(path), "a CSV text in UTF-8"):
        raw = gzip.decompress(path.read_bytes()) if path.suffix.lower() == ".gz" else path.read_bytes()
        text = raw.decode("utf-8-sig")
    if not text.strip():
        raise RecordingError(
            f"{path}: is empty. Needed are a header with the names of the columns, and one line a sample."
        )
    if not text.endswith(("\n", "\r")):
        raise RecordingError(
            f"{path}: the last line has no end, so its last number may be cut off. Add a line end if the file is "
            "complete."
        )
    lines = text.lstrip().splitlines()
    header = lines[0].removeprefix("#")  # as numpy.savetxt writes it
    separator = max(",;\t", key=header.count)
    with decoding(str(path), "a CSV text"):
        rows = [
            (number, row) for number, row in enumerate(csv.reader([header, *lines[1:]], delimiter=separator), 1) if row
        ]
    names = [name.strip() for name in rows.pop(0)[1]]
    if len(set(names)) < len(names) or "" in names:
        raise RecordingError(f"{path}: the header is {', '.join(names)}; every column needs a name of its own.")
    if all(is_number(name) for name in names):
        raise RecordingError(
            f"{path}: the first line holds numbers. Put a header with the names of the columns above it."
        )
    for number, row in rows:
        if len(row) != len(names):
            raise RecordingError(
                f"{path}: line {number} has {len(row)} cells, but the header names {len(names)} columns. Complete the "
                "line, or leave it out; what stands above the header has to go."
            )
    columns = zip(*[row for _, row in rows], strict=True) if rows else [()] * len(names)
    return [RawTake(str(path), {name: _parsed(column) for name, column in zip(names, columns, strict=True)})]


def _parsed(cells: tuple[str, ...]) -> NDArray[Any]:
    """Numbers where every cell is one; text stays text, which only hurts where numbers are needed."""
    text = "".join(cells)
    if text.startswith("["):
        with suppress(ValueError, TypeError, RecursionError):
            return _lists(cells)
    if "_" not in text and text.isascii():  # Python reads 1_0 and other alphabets' digits as numbers
        with suppress(ValueError):
            return np.array(cells, dtype=np.float64)
    return np.array([cell[:_LONGEST] for cell in cells], dtype=np.str_)  # NumPy makes all as long as the longest


def _lists(cells: tuple[str, ...]) -> NDArray[Any]:
    """Cells that are JSON lists of as many numbers each, as an array (T, K).

    Raises:
        ValueError, TypeError: If they are not.
    """
    rows = [json.loads(cell, parse_constant=_refuse) for cell in cells]
    if not all(isinstance(row, list) and all(type(x) in (int, float) for x in row) for row in rows):
        raise ValueError("no lists of numbers")
    return np.array(rows, dtype=np.float64)


def _refuse(name: str) -> None:
    raise ValueError(f"{name} is no number")
