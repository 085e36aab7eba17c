"""Parquet: columns ``time`` and ``position/<joint>``, and what has no rows in the schema's metadata."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from torchrl_athletic.recordings.formats.column_map import BASE, SIGNALS
from torchrl_athletic.recordings.formats.foreign_library import decoding, import_format_library
from torchrl_athletic.recordings.formats.metadata import metadata_text
from torchrl_athletic.recordings.formats.take import NOTES, RawTake, parse_json_object
from torchrl_athletic.recordings.recording import Recording, RecordingError

NOTES_KEY = b"torchrl_athletic"
"""Key in the schema's metadata of the JSON with the fields that have no value a sample."""


def read_parquet(path: Path) -> list[RawTake]:
    """The one take of a Parquet file: numeric columns, or lists of equal length."""
    arrays, metadata = read_columns(path)
    if NOTES_KEY in metadata:
        source = f"{path}: schema metadata {NOTES_KEY.decode()}"
        with decoding(source, f"JSON with {', '.join(NOTES)}"):
            notes = parse_json_object(metadata[NOTES_KEY].decode(), source)
            arrays |= {name: np.array(notes[name]) for name in NOTES if notes.get(name) is not None}
    return [RawTake(str(path), arrays)]


def read_columns(path: Path) -> tuple[dict[str, NDArray[Any]], dict[bytes, bytes]]:
    """Columns of a Parquet file as arrays (T,), or (T, K) of lists, and the schema's metadata.

    What holds neither numbers nor stamps, such as text and pictures, is not loaded: its array is of objects.
    """
    parquet = import_format_library("pyarrow.parquet")
    with decoding(str(path), "a Parquet file"), parquet.ParquetFile(path, page_checksum_verification=True) as file:
        schema = file.schema_arrow
        table = file.read(columns=[f.name for f in schema if _is_numeric(f.type)], use_threads=False)
        if len(set(schema.names)) < len(schema.names):
            raise RecordingError(
                f"{path}: the columns are {', '.join(schema.names)}; every one needs a name of its own."
            )
        loaded = {name: _array(table.column(name)) for name in table.column_names}
    unloaded = np.full(table.num_rows, None, dtype=object)
    return {name: loaded.get(name, unloaded) for name in schema.names}, schema.metadata or {}


def _is_numeric(kind: Any) -> bool:
    types = import_format_library("pyarrow").types
    if types.is_list(kind) or types.is_large_list(kind) or types.is_fixed_size_list(kind):
        kind = kind.value_type
    return any(test(kind) for test in (types.is_integer, types.is_floating, types.is_boolean, types.is_timestamp))


def _array(column: Any) -> NDArray[Any]:
    """A column as an array (T,), or (T, K) of lists of one length; else of objects."""
    if not hasattr(column.type, "value_type"):
        return np.asarray(column.to_numpy())
    rows = [None if row is None else np.asarray(row) for row in column.to_numpy()]
    lengths = {None if row is None else row.shape for row in rows}
    if len(lengths) == 1 and None not in lengths:
        return np.stack([row for row in rows if row is not None])
    return np.full(len(rows), None, dtype=object)


def write_parquet(recording: Recording, path: Path) -> None:
    """Write float64 columns, checksummed, and the notes as JSON."""
    pa, parquet = import_format_library("pyarrow"), import_format_library("pyarrow.parquet")
    columns = {"time": recording.time}
    for signal in SIGNALS:
        if (values := getattr(recording, signal)) is not None:
            columns |= {f"{signal}/{joint}": values[:, i] for i, joint in enumerate(recording.joint_names)}
    for name, axes in BASE.items():
        if (values := getattr(recording, name)) is not None:
            columns |= {f"{name}/{axis}": values[:, i] for i, axis in enumerate(axes)}
    notes = {
        "joint_names": recording.joint_names,
        "kp": None if recording.kp is None else recording.kp.tolist(),
        "kd": None if recording.kd is None else recording.kd.tolist(),
        "torque_semantics": recording.torque_semantics,
        "metadata": metadata_text(recording),
    }
    table = pa.table(columns).replace_schema_metadata({NOTES_KEY: json.dumps(notes).encode()})
    parquet.write_table(table, path, write_page_checksum=True)
