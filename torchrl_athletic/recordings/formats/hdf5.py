"""HDF5: datasets at the root or one group a take; notes also as attributes. MATLAB's v7.3 files are HDF5 as well."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from torchrl_athletic.recordings.formats.column_map import ColumnMap
from torchrl_athletic.recordings.formats.foreign_library import decoding, import_format_library
from torchrl_athletic.recordings.formats.groups import takes_by_group
from torchrl_athletic.recordings.formats.take import NOTES, Take


def read_hdf5(path: Path, columns: ColumnMap) -> list[Take]:
    """The takes of an HDF5 file. Arrays of more than two dimensions, such as pictures, are not loaded."""
    h5py = import_format_library("h5py")
    arrays: dict[str, NDArray[Any]] = {}

    def visit(name: str, node: Any) -> None:
        prefix = f"{name}/" if name else ""
        if isinstance(node, h5py.Dataset):
            if not name.startswith("#"):  # MATLAB keeps the contents of cells under "#refs#"
                arrays[name] = _dataset(h5py, node)
        else:
            arrays.update({prefix + key: _attribute(node.attrs[key]) for key in NOTES if key in node.attrs})

    with decoding(str(path), "an HDF5 file"), h5py.File(path, "r") as file:
        visit("", file)
        file.visititems(visit)
    return takes_by_group(str(path), arrays, columns)


def _dataset(h5py: Any, dataset: Any) -> NDArray[Any]:
    matlab_class = dataset.attrs.get("MATLAB_class")
    if matlab_class is not None:
        return _matlab(h5py, dataset, bytes(matlab_class).decode())
    if h5py.check_string_dtype(dataset.dtype) is not None:
        return np.array(dataset.asstr()[()], dtype=np.str_)
    if dataset.dtype.kind in "iuf" and dataset.ndim <= 2:
        return np.asarray(dataset[()])
    return np.full(dataset.shape[:1], None, dtype=object)


def _matlab(h5py: Any, dataset: Any, matlab_class: str) -> NDArray[Any]:
    """A variable of a v7.3 file: column-major, text as UTF-16 code units, cells as references."""
    if matlab_class == "char":
        return np.array(np.asarray(dataset[()]).T.astype("<u2").tobytes().decode("utf-16-le"))
    if matlab_class == "cell":
        cells = [dataset.file[reference] for reference in np.ravel(dataset[()])]
        if all(bytes(cell.attrs.get("MATLAB_class", b"")) == b"char" for cell in cells):
            return np.array([str(_matlab(h5py, cell, "char")) for cell in cells])
    elif dataset.dtype.kind in "iuf" and dataset.ndim <= 2:
        return np.squeeze(np.asarray(dataset[()], dtype=bool if matlab_class == "logical" else None).T)
    return np.full(dataset.shape[:1], None, dtype=object)


def _attribute(value: Any) -> NDArray[Any]:
    array = np.asarray(value)
    if array.dtype.kind == "S":
        return np.char.decode(array, "utf-8")
    return array.astype(np.str_) if array.dtype.kind == "O" else array
