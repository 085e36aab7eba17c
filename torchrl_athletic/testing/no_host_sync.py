"""Catch, without a GPU, what would make a GPU wait for the host."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import ExitStack, contextmanager
from typing import Any
from unittest import mock

import torch
from torch import Tensor
from torch.overrides import TorchFunctionMode
from torch.utils._python_dispatch import TorchDispatchMode

_READS = {
    "item",
    "tolist",
    "numpy",
    "cpu",
    "__bool__",
    "__int__",
    "__float__",
    "__index__",
    "__contains__",
    "__array__",
}
_VALUES = {  # operators whose result, or its shape, the host must wait for
    "aten::_local_scalar_dense",
    "aten::item",
    "aten::is_nonzero",
    "aten::equal",
    "aten::nonzero",
    "aten::nonzero_numpy",
    "aten::masked_select",
    "aten::unique_dim",
    "aten::_unique2",
    "aten::unique_consecutive",
    "aten::repeat_interleave.Tensor",
    "aten::bincount",
}
_INDEXING = {"aten::index", "aten::index_put", "aten::index_put_", "aten::_index_put_impl_"}


class HostSyncError(RuntimeError):
    """Something was asked of a tensor that a GPU can answer only by making the host wait."""


@contextmanager
def no_host_sync() -> Iterator[None]:
    """Within it, what would synchronise with a GPU raises :class:`HostSyncError`, on tensors of the CPU too.

    That is reading a value (``item``, ``bool``, ``tolist``), shapes that depend on values (``nonzero``, boolean
    indices) and making tensors of Python numbers (``torch.tensor``, an index that is a list), which copies to the
    device.

    Code may take a shortcut on the CPU, such as stopping early once all rows are done, if it asks
    ``torch.compiler.is_compiling()`` first: that is true here. On CUDA, CUDA's own check applies as well.

    Raises:
        HostSyncError: On the CPU. On CUDA also RuntimeError.

    Example:
        >>> with no_host_sync():
        ...     smaller = torch.where(torch.ones(2) > 0, 1.0, 0.0)
        >>> with no_host_sync():
        ...     bool(torch.ones(2).any())
        Traceback (most recent call last):
        torchrl_athletic.testing.no_host_sync.HostSyncError: __bool__ reads a tensor on the host, ...
    """
    with ExitStack() as stack:
        stack.enter_context(mock.patch("torch.compiler.is_compiling", return_value=True))
        if torch.cuda.is_available():
            before = torch.cuda.get_sync_debug_mode()
            torch.cuda.set_sync_debug_mode("error")
            stack.callback(torch.cuda.set_sync_debug_mode, before)
        stack.enter_context(_Operators())
        stack.enter_context(_Methods())
        yield


class _Methods(TorchFunctionMode):
    """What is asked of tensors in Python."""

    def __torch_function__(
        self, func: Callable, types: Sequence[type], args: Sequence[Any] = (), kwargs: Mapping[str, Any] | None = None
    ) -> Any:
        name = getattr(func, "__name__", "")
        if name in _READS and args and isinstance(args[0], Tensor):
            raise HostSyncError(f"{name} reads a tensor on the host, which would wait for the GPU. Use torch.where.")
        if name in ("__getitem__", "__setitem__") and _has_list(args[1]):
            raise HostSyncError(
                f"the index {args[1]} holds a list, which is copied to the GPU each time. Index with a slice, or with "
                "a tensor that is there already."
            )
        if func in (torch.tensor, torch.as_tensor) and not isinstance(args[0] if args else None, Tensor):
            raise HostSyncError(
                f"torch.{name} copies Python numbers to the GPU. Use torch.full or torch.zeros, or make it once."
            )
        return func(*args, **(kwargs or {}))


class _Operators(TorchDispatchMode):
    """What those questions, and all other functions, come down to."""

    def __torch_dispatch__(
        self, func: Any, types: Sequence[type], args: Sequence[Any] = (), kwargs: Mapping[str, Any] | None = None
    ) -> Any:
        name = func._schema.name
        if name in _VALUES or f"{name}.{func._overloadname}" in _VALUES:
            raise HostSyncError(f"{name} needs values of a tensor on the host, which would wait for the GPU.")
        if name in _INDEXING and any(
            index is not None and index.dtype in (torch.bool, torch.uint8) and index.ndim for index in args[1]
        ):
            raise HostSyncError("a boolean index gives a shape that depends on values. Use torch.where.")
        return func(*args, **(kwargs or {}))


def _has_list(index: Any) -> bool:
    parts = index if isinstance(index, tuple) else (index,)
    return any(isinstance(part, (list, range)) for part in parts)
