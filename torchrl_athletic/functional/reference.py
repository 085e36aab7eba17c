"""Tabulated references: several motions of different lengths, read at any time."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Literal, TypeAlias

import torch
from torch import Tensor

AtEnd: TypeAlias = Literal["hold", "loop"]
"""What follows the last sample: the same again for ever, or the first one."""
PEAK_SPEED = 15 / 8
"""Peak speed of the way between two key poses in :func:`interpolate_poses`, by its mean speed [1]."""


def interpolate_poses(times: Tensor, poses: Tensor, t: Tensor) -> Tensor:
    r"""A motion through key poses, which rests at each of them.

    Each column follows the quintic whose speed and acceleration are zero at both ends,

    .. math:: x_i + (x_{i+1} - x_i)\,(10 s^3 - 15 s^4 + 6 s^5), \quad s = (t - t_i) / (t_{i+1} - t_i)

    whose speed is greatest in the middle, :data:`PEAK_SPEED` times the mean. Before the first key pose and after the
    last one it stays there.

    Args:
        times: Of the key poses, rising [s]. Shape (P,).
        poses: Shape (P, D).
        t: When to read [s]. Shape (T,).

    Returns:
        Shape (T, D).

    Example:
        >>> times, poses = torch.tensor([0.0, 2.0]), torch.tensor([[0.0], [8.0]])
        >>> interpolate_poses(times, poses, torch.tensor([0.0, 0.5, 1.0, 2.0, 9.0])).squeeze(-1).tolist()
        [0.0, 0.828125, 4.0, 8.0, 8.0]
    """
    if len(times) == 1:
        return poses.expand(len(t), -1)
    leg = (torch.searchsorted(times, t, right=True) - 1).clamp(0, len(times) - 2)
    share = ((t - times[leg]) / (times[leg + 1] - times[leg])).clamp(0, 1).unsqueeze(-1)
    smooth = share**3 * (10 - 15 * share + 6 * share**2)
    return poses[leg] + smooth * (poses[leg + 1] - poses[leg])


def pad_references(references: Tensor | Sequence[Tensor]) -> tuple[Tensor, Tensor]:
    """References of different lengths as one table, the shorter ones going on with their last sample.

    Args:
        references: One reference of shape (T, D), several of shape (R, T, D), or R of shape (T_r, D).

    Returns:
        Table of shape (R, T, D), and the number of samples of each reference, int64 of shape (R,).

    Raises:
        ValueError: If a reference has no sample, or they differ in width.

    Example:
        >>> table, lengths = pad_references([torch.tensor([[1.0], [2.0]]), torch.tensor([[5.0]])])
        >>> table.squeeze(-1).tolist(), lengths.tolist()
        ([[1.0, 2.0], [5.0, 5.0]], [2, 1])
    """
    if isinstance(references, Tensor):
        references = references.unsqueeze(0) if references.ndim == 2 else references
        shape_of_one = references.shape[1:]
        one_by_one: Sequence[Tensor] = list(references.unbind(0)) if references.ndim == 3 else []
    else:
        one_by_one = [torch.as_tensor(reference) for reference in references]
        shape_of_one = one_by_one[0].shape if one_by_one else torch.Size()
    if not one_by_one or any(one.ndim != 2 or len(one) == 0 or one.shape[-1] != shape_of_one[-1] for one in one_by_one):
        raise ValueError(
            f"references of shapes {[tuple(one.shape) for one in one_by_one]} make no table: each needs (T, D), with "
            "at least one sample and the same D."
        )
    length = max(len(one) for one in one_by_one)
    rows = [torch.cat((one, one[-1:].expand(length - len(one), -1))) for one in one_by_one]
    return torch.stack(rows), torch.tensor([len(one) for one in one_by_one])


def sample_reference(
    table: Tensor,
    lengths: Tensor,
    reference: Tensor,
    position: Tensor,
    at_end: AtEnd = "hold",
    interpolate: bool = True,
) -> Tensor:
    """Values of references at times of their own.

    Columns are interpolated one by one. So a quaternion's are of unit length at the samples only: read those without
    interpolation, or at whole samples.

    Args:
        table: Of :func:`pad_references`. Shape (R, T, D).
        lengths: Samples of each reference. Shape (R,).
        reference: Which one. int64, shape (*B, 1).
        position: Time, counted in samples. Shape (*B, K).
        at_end: ``loop`` counts the last sample as one step before the first: do not repeat the first one at the end.
        interpolate: Linearly between samples; otherwise the last sample that was passed holds.

    Returns:
        Shape (*B, K, D).

    Example:
        >>> table, lengths = pad_references(torch.tensor([[0.0], [10.0], [30.0]]))
        >>> position = torch.tensor([0.5, 1.5, 2.5, 3.5])
        >>> [sample_reference(table, lengths, torch.tensor([0]), position, end).squeeze(-1).tolist()
        ...  for end in ("hold", "loop")]
        [[5.0, 20.0, 30.0, 30.0], [5.0, 20.0, 15.0, 5.0]]
    """
    length = lengths[reference]
    before = position.floor()
    share = (position - before).unsqueeze(-1)
    first = before.long()
    if at_end == "loop":
        first, second = torch.remainder(first, length), torch.remainder(first + 1, length)
    else:
        first, second = (torch.minimum((first + ahead).clamp(min=0), length - 1) for ahead in (0, 1))
    rows, row = table.flatten(0, 1), reference * table.shape[1]
    start = rows.index_select(0, (row + first).flatten()).unflatten(0, first.shape)
    if not interpolate:
        return start
    end = rows.index_select(0, (row + second).flatten()).unflatten(0, second.shape)
    return start + (end - start) * share
