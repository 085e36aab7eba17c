"""MAT: MATLAB's variables, structs and cells of text."""

from __future__ import annotations

import struct
from collections.abc import Iterable, Iterator, Mapping
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from torchrl_athletic.recordings.formats.column_map import ColumnMap
from torchrl_athletic.recordings.formats.foreign_library import decoding
from torchrl_athletic.recordings.formats.groups import takes_by_group
from torchrl_athletic.recordings.formats.hdf5 import read_hdf5
from torchrl_athletic.recordings.formats.take import RawTake


def read_mat(path: Path, columns: ColumnMap) -> Iterable[RawTake]:
    """The takes of a MAT file. A field ``q`` of a struct ``log`` is named ``log/q``; of the second of several,
    ``log/2/q``.

    MATLAB knows no vectors: (T, 1) and (1, T) are read as (T,), (1, 1) as one number.
    """
    from scipy.io import loadmat, whosmat

    with decoding(str(path), "a MAT file"):
        with path.open("rb") as file:
            head = file.read(10)
        if head == b"MATLAB 7.3" or head.startswith(b"\x89HDF"):
            return read_hdf5(path, columns)
        _refuse_cut_off(path)
        content = loadmat(path, simplify_cells=True)
        for name, _, kind in whosmat(path):
            if kind == "logical":  # which loadmat gives as whole numbers
                content[name] = np.asarray(content[name], dtype=bool)
        arrays = {
            name: partial(np.asarray, array)
            for key, value in content.items()
            if not key.startswith("__")
            for name, array in _flat(key, value)
        }
    return takes_by_group(str(path), arrays, columns)


def _refuse_cut_off(path: Path) -> None:
    """Raise if a version 5 file ends within a variable, of which scipy may say nothing and leave it out.

    One that ends between two variables cannot be told from a whole one: the format states no total length.
    """
    from scipy.io.matlab import matfile_version

    if matfile_version(path)[0] != 1:
        return
    size = path.stat().st_size
    with path.open("rb") as file:
        order = "<" if file.read(128)[126:] == b"IM" else ">"
        while (start := file.tell()) < size:
            tag = file.read(8)
            end = start + 8 + struct.unpack(f"{order}I", tag[4:])[0] if len(tag) == 8 else size + 1
            if end > size:
                raise EOFError(f"the variable that starts at byte {start} is cut off at byte {size}")
            file.seek(end)


def _flat(name: str, value: Any) -> Iterator[tuple[str, NDArray[Any]]]:
    if isinstance(value, Mapping):
        for key, inner in value.items():
            yield from _flat(f"{name}/{key}", inner)
        return
    array = np.asarray(value)
    items = array.ravel().tolist() if array.dtype.kind == "O" else []
    if items and all(isinstance(item, Mapping) for item in items):
        for number, item in enumerate(items, 1):
            yield from _flat(f"{name}/{number}", item)
    elif items and all(isinstance(item, str) for item in items):
        yield name, np.array(items, dtype=np.str_)
    elif array.dtype.kind == "U" and array.ndim:
        yield name, np.char.rstrip(array)  # rows of a character matrix are padded with blanks
    else:
        yield name, array
