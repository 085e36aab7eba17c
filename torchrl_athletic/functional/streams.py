"""Random numbers as functions: a row of a batch draws the same numbers alone as among thousands.

A stream is one integer per row. Its draws depend on nothing else: not on the size of the batch, on the device, on what
other rows did, nor on a generator's hidden state. So a batched environment can be checked against copies of size one,
bit for bit, a checkpoint holds the whole truth, and a CUDA graph may hold the draws.

Source:
    Steele, Lea, Flood 2014, Fast splittable pseudorandom number generators (SplitMix64), https://doi.org/10.1145/2660193.2660195.
"""

from __future__ import annotations

import math

import torch
from torch import Tensor

_GOLDEN = 0x9E3779B97F4A7C15 - (1 << 64)  # as a signed 64-bit integer; products wrap, as they should
_INVERSE = 0xF1DE83E19937733D - (1 << 64)  # of _GOLDEN, modulo 2**64
_MIX_1 = 0xBF58476D1CE4E5B9 - (1 << 64)
_MIX_2 = 0x94D049BB133111EB - (1 << 64)


def stream(seed: int, *counters: Tensor) -> Tensor:
    """Open a stream per row, named by a seed and integers such as the row's number and its episode's.

    Args:
        seed: Any integer.
        counters: Integer tensors of one shape (*B,).

    Returns:
        int64. Shape (*B,).

    Example:
        >>> rows = torch.arange(3)
        >>> bool((stream(0, rows)[2] == stream(0, torch.tensor(2))).all())
        True
    """
    key = torch.full_like(counters[0], (seed + (1 << 63)) % (1 << 64) - (1 << 63), dtype=torch.int64)
    for counter in counters:
        key = _mix(key + _GOLDEN) ^ counter
    return _mix(key + _GOLDEN)


def branch(key: Tensor, counter: Tensor) -> Tensor:
    """The stream of one more counter: for those that count often, what is fixed need not be mixed anew. Shape (*B,).

    Example:
        >>> row, episode = torch.arange(3), torch.tensor([5, 6, 7])
        >>> torch.equal(branch(stream(1, row), episode), stream(1, row, episode))
        True
    """
    return advance(key ^ counter)


def advance(key: Tensor) -> Tensor:
    """The stream at its next step: draws from it are independent of those before. Shape of ``key``."""
    return _mix(key + _GOLDEN)


def uniform(key: Tensor, size: int, low: Tensor | float = 0.0, high: Tensor | float = 1.0) -> Tensor:
    """Draw ``size`` numbers per row from [low, high); the same key gives the same numbers.

    Args:
        key: Of :func:`stream`. Shape (*B,).
        size: D.
        low: Broadcastable to (*B, D).
        high: Broadcastable to (*B, D).

    Returns:
        float32. Shape (*B, D).

    Example:
        >>> drawn = uniform(stream(0, torch.arange(10_000)), 2, low=-1.0)
        >>> bool(drawn.mean().abs() < 0.02), bool((drawn >= -1).all() & (drawn < 1).all())
        (True, True)
    """
    unit = (_bits(key, size) & 0xFFFFFF).float() / (1 << 24)  # 24 bits are exact in float32, and below 1
    return low + (high - low) * unit


def normal(key: Tensor, size: int) -> Tensor:
    """Draw ``size`` standard normal numbers per row. float32, shape (*B, D).

    Source:
        Box, Muller 1958.
    """
    bits = _bits(key, 2 * size)
    unit = ((bits & 0xFFFFFF).float() + 0.5) / (1 << 24)
    radius = torch.sqrt(-2 * torch.log(unit[..., :size]))
    return radius * torch.cos(2 * math.pi * unit[..., size:])


def integers(key: Tensor, size: int, high: int) -> Tensor:
    """Draw ``size`` integers per row from 0 to ``high`` - 1. int64, shape (*B, D)."""
    return ((_bits(key, size) & 0xFFFFFFFF) * high) >> 32


def _bits(key: Tensor, size: int) -> Tensor:
    index = torch.arange(1, size + 1, device=key.device)
    return _mix((_mix(key).unsqueeze(-1) * _INVERSE + index) * _GOLDEN)  # Triton would take _GOLDEN * index for 32 bits


def _mix(x: Tensor) -> Tensor:
    x = _fold(x, 30).mul_(_MIX_1)
    x = _fold(x, 27).mul_(_MIX_2)
    return _fold(x, 31)


def _fold(x: Tensor, bits: int) -> Tensor:
    """Combined with itself, shifted to the right without the sign; in memory of its own."""
    return (x >> bits).bitwise_and_((1 << (64 - bits)) - 1).bitwise_xor_(x)
