"""The last few values of a signal, oldest first."""

from __future__ import annotations

import torch
from torch import Tensor


def tile(value: Tensor, length: int, dim: int = -2) -> Tensor:
    """A history in which the value never changed.

    Args:
        value: Shape (*B, D).
        length: L.
        dim: Where time runs in the history.

    Returns:
        With ``dim=-2`` shape (*B, L, D), with ``dim=-1`` shape (*B, D, L).

    Example:
        >>> tile(torch.tensor([1.0, 2.0]), 3).tolist()
        [[1.0, 2.0], [1.0, 2.0], [1.0, 2.0]]
    """
    shape = list(value.shape)
    shape.insert(len(shape) + 1 + dim, length)
    return value.unsqueeze(dim).expand(shape).clone()


def push(history: Tensor, value: Tensor, dim: int = -2) -> Tensor:
    """The history one step later: its oldest value is forgotten, the new one stands last.

    Args:
        history: Shape (*B, L, D), or (*B, D, L) with ``dim=-1``.
        value: Shape (*B, D).
        dim: Where time runs.

    Returns:
        Shape of ``history``, which is left as it was.

    Example:
        >>> push(torch.tensor([[1.0], [2.0], [3.0]]), torch.tensor([4.0])).squeeze(-1).tolist()
        [2.0, 3.0, 4.0]
    """
    return torch.cat((history.narrow(dim, 1, history.shape[dim] - 1), value.unsqueeze(dim)), dim)


def look_back(history: Tensor, steps: Tensor) -> Tensor:
    """The value of so many steps ago, a number per row of the batch.

    Args:
        history: Shape (*B, L, D).
        steps: 0 for the newest, up to L - 1. Integer, shape (*B, 1).

    Returns:
        Shape (*B, D).

    Example:
        >>> look_back(torch.tensor([[[1.0], [2.0], [3.0]]] * 2), torch.tensor([[0], [2]])).tolist()
        [[3.0], [1.0]]
    """
    length, width = history.shape[-2:]
    index = (length - 1 - steps).unsqueeze(-1).expand(*history.shape[:-2], 1, width)
    return history.gather(-2, index).squeeze(-2)
