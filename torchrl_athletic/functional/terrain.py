"""How high uneven ground is under a point, as MuJoCo has it."""

from __future__ import annotations

import torch
from torch import Tensor


def surface_height(heights: Tensor, place: Tensor, half_size: tuple[float, float]) -> Tensor:
    """Height of a grid's surface, which MuJoCo splits into triangles along each cell's diagonal.

    Args:
        heights: Rows along y, columns along x, evenly spaced from edge to edge [m]. Shape (R, C).
        place: x and y from the grid's centre [m]. Beyond the edge the edge goes on. Shape (*B, 2).
        half_size: Of the grid along x and along y [m].

    Returns:
        [m]. Shape (*B).

    Source:
        MuJoCo documentation, ``hfield``. The diagonal goes from a cell's least x and y to its greatest.

    Example:
        >>> heights = torch.tensor([[0.0, 1.0], [0.0, 1.0]])  # rises along x
        >>> surface_height(heights, torch.tensor([[0.0, 0.3], [0.5, 0.0]]), (1.0, 1.0)).tolist()
        [0.5, 0.75]
    """
    rows, columns = heights.shape
    x = _cells(place[..., 0], half_size[0], columns)
    y = _cells(place[..., 1], half_size[1], rows)
    column, row = x.floor().clamp(max=columns - 2), y.floor().clamp(max=rows - 2)
    along, across = x - column, y - row
    first = (row * columns + column).long()
    flat = heights.reshape(-1)
    near, far = flat[first], flat[first + columns + 1]
    beside = torch.where(along > across, flat[first + 1], flat[first + columns])  # the triangle's third corner
    greater, less = torch.maximum(along, across), torch.minimum(along, across)
    return near + (beside - near) * greater + (far - beside) * less


def _cells(place: Tensor, half_size: float, count: int) -> Tensor:
    """Distance from the first of ``count`` evenly spaced lines, in spacings, within them."""
    cells = (place + half_size) * ((count - 1) / (2 * half_size))
    return torch.nan_to_num(cells).clamp(0, count - 1)  # a robot that diverged is nowhere, and no index


def averaged(heights: Tensor, rows: int, columns: int) -> Tensor:
    """Each height as the mean of those around it, which rounds off bumps. Shape (R, C).

    Args:
        heights: [m]. Shape (R, C).
        rows: How many to each side count.
        columns: How many to each side count.

    Example:
        >>> averaged(torch.tensor([[0.0, 3.0, 0.0]]), 0, 1).tolist()
        [[1.5, 1.0, 1.5]]
    """
    size, margin = (2 * rows + 1, 2 * columns + 1), (rows, columns)
    pool = torch.nn.functional.avg_pool2d
    return pool(heights[None], size, stride=1, padding=margin, count_include_pad=False)[0]


def highest(heights: Tensor, rows: int, columns: int) -> Tensor:
    """Each height as the greatest of those around it: ground that covers every bump. As :func:`averaged`.

    Example:
        >>> highest(torch.tensor([[0.0, 3.0, 0.0, 0.0]]), 0, 1).tolist()
        [[3.0, 3.0, 3.0, 0.0]]
    """
    size, margin = (2 * rows + 1, 2 * columns + 1), (rows, columns)
    return torch.nn.functional.max_pool2d(heights[None], size, stride=1, padding=margin)[0]
