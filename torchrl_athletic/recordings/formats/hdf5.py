"""HDF5: datasets at the root or one group a take; notes also as attributes. MATLAB's v7.3 files are HDF5 as well."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import ExitStack
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from torchrl_athletic.recordings.formats.column_map import ColumnMap
from torchrl_athletic.recordings.formats.foreign_library import decoding, import_format_library
from torchrl_athletic.recordings.formats.groups import takes_by_group
from torchrl_athletic.recordings.formats.take import NOTES, Load, RawTake
from torchrl_athletic.recordings.recording import RecordingError


def read_hdf5(path: Path, columns: ColumnMap) -> Iterator[RawTake]:
    """The takes of an HDF5 file. Arrays of more than two dimensions, such as pictures, are not loaded."""
    h5py = import_format_library("h5py")
    arrays: dict[str, Load] = {}

    def load(node: Any) -> NDArray[Any]:
        with decoding(f"{path}: {node.name}", "a data set of an HDF5 file"):
            return _dataset(h5py, node)

    def visit(name: str, node: Any) -> None:
        prefix = f"{name}/" if name else ""
        if isinstance(node, h5py.Dataset):
            if not name.startswith("#"):  # MATLAB keeps the contents of cells under "#refs#"
                arrays[name] = partial(load, node)
        else:
            arrays.update({prefix + key: partial(_attribute, node.attrs[key]) for key in NOTES if key in node.attrs})

    def visit_link(name: str, link: Any) -> None:
        if isinstance(link, h5py.ExternalLink):
            arrays[name] = partial(_refuse, f"{path}: {name}", link.filename)

    with ExitStack() as stack:
        with decoding(str(path), "an HDF5 file"):
            file = stack.enter_context(h5py.File(path, "r"))
            visit("", file)
            file.visititems(visit)
            file.visititems_links(visit_link)
        yield from takes_by_group(str(path), arrays, columns)


def _refuse(where: str, other: str) -> NDArray[Any]:
    """Raise: a recording that can read any file of the machine could be sent to somebody to find out what is there."""
    raise RecordingError(
        f"{where} is kept in another file ({other}), which is not read. Copy the data into one file (h5repack)."
    )


def _dataset(h5py: Any, dataset: Any) -> NDArray[Any]:
    matlab_class = dataset.attrs.get("MATLAB_class")
    if matlab_class is not None:
        return _matlab(h5py, dataset, bytes(matlab_class).decode())
    if h5py.check_string_dtype(dataset.dtype) is not None:
        return np.array(_values(dataset, dataset.asstr()), dtype=np.str_)
    if dataset.dtype.kind in "iuf" and dataset.ndim <= 2:
        return _values(dataset)
    return np.full(dataset.shape[:1], None, dtype=object)


def _values(dataset: Any, view: Any = None) -> NDArray[Any]:
    """All that a data set holds, through a view of it; refused where it is kept in another file."""
    where = f"{dataset.file.filename}: {dataset.name}"
    if dataset.external:
        _refuse(where, dataset.external[0][0])
    if dataset.is_virtual:
        _refuse(where, dataset.virtual_sources()[0].file_name)
    return np.asarray((dataset if view is None else view)[()])


def _matlab(h5py: Any, dataset: Any, matlab_class: str) -> NDArray[Any]:
    """A variable of a v7.3 file: column-major, text as UTF-16 code units, cells as references."""
    if matlab_class == "char":
        return np.array(_values(dataset).T.astype("<u2").tobytes().decode("utf-16-le"))
    if matlab_class == "cell":
        cells = [dataset.file[reference] for reference in np.ravel(_values(dataset))]
        if all(bytes(cell.attrs.get("MATLAB_class", b"")) == b"char" for cell in cells):
            return np.array([str(_matlab(h5py, cell, "char")) for cell in cells])
    elif dataset.dtype.kind in "iuf" and dataset.ndim <= 2:
        return np.squeeze(_values(dataset).astype(bool if matlab_class == "logical" else dataset.dtype).T)
    return np.full(dataset.shape[:1], None, dtype=object)


def _attribute(value: Any) -> NDArray[Any]:
    array = np.asarray(value)
    if array.dtype.kind == "S":
        return np.char.decode(array, "utf-8")
    return array.astype(np.str_) if array.dtype.kind == "O" else array
