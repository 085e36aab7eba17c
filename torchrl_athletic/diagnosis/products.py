"""Inner products of columns, joint by joint: all that least squares needs of them, each taken once and kept."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]

SWEEPS = 3
"""Rounds in which active coefficients make up for those that reached a bound."""


class Products:
    """Grows with the columns that were asked for; time and memory are linear in the number of rows.

    A column belongs to one joint, with shape (rows,), or to all, with shape (rows, J) and ``joint`` -1.

    Args:
        joints: J.
        stretch: Stretch of each row, increasing by one from 0; products are kept for each of the S stretches. Shape
            (rows,).
    """

    def __init__(self, joints: int, stretch: NDArray[np.intp]) -> None:
        self.joints = joints
        self._slices = [slice(*ends) for ends in _runs(stretch)]
        self._columns = [np.empty((0, len(stretch)), dtype=np.float32) for _ in range(joints)]
        """Per joint, of the columns that touch it, rounded, to be kept in half the memory; their products are exact.
        Shape (at least its count, rows)."""
        self._gram = [np.zeros((len(self._slices), 0, 0)) for _ in range(joints)]
        self._place: list[dict[int, int]] = [{} for _ in range(joints)]
        """Per joint, column -> where it stands."""
        self._size = 0

    def add(self, column: Array, joint: int) -> int:
        """Take a column in; its number comes back."""
        number = self._size
        self._size += 1
        for j in range(self.joints) if joint < 0 else (joint,):
            values = column[:, j] if joint < 0 else column
            at = len(self._place[j])
            if at == len(self._columns[j]):
                self._grow(j)
            self._columns[j][at] = values
            self._place[j][number] = at
            gram, held = self._gram[j], self._columns[j][: at + 1]
            for k, rows in enumerate(self._slices):
                part = held[:, rows].astype(np.float64)
                gram[k, at, : at + 1] = gram[k, : at + 1, at] = part @ part[at]
        return number

    def _grow(self, joint: int) -> None:
        size = len(self._columns[joint])
        more = size // 4 + 16
        columns, gram = self._columns[joint], self._gram[joint]
        self._columns[joint] = np.concatenate([columns, np.empty((more, columns.shape[1]), dtype=np.float32)])
        self._gram[joint] = np.zeros((len(gram), size + more, size + more))
        self._gram[joint][:, :size, :size] = gram

    def gram(self, numbers: Sequence[int]) -> Array:
        """Inner products of some columns with each other, in each stretch of each joint. Shape (J, S, n, n)."""
        out = np.zeros((self.joints, len(self._slices), len(numbers), len(numbers)))
        for j, place in enumerate(self._place):
            here = np.array([k for k, n in enumerate(numbers) if n in place], dtype=np.intp)
            at = np.array([place[numbers[k]] for k in here], dtype=np.intp)
            out[j][:, here[:, None], here] = self._gram[j][:, at[:, None], at]
        return out

    def touching(self, joint: int) -> Array:
        """All columns that are not zero on a joint, in the order in which they came. Shape (n, rows)."""
        return self._columns[joint][: len(self._place[joint])].astype(np.float64)

    def column(self, number: int, joint: int) -> Array | None:
        """One joint's part of a column, None where it is zero. Shape (rows,)."""
        at = self._place[joint].get(number)
        return None if at is None else self._columns[joint][at].astype(np.float64)


def _runs(stretch: NDArray[np.intp]) -> list[tuple[int, int]]:
    starts = np.flatnonzero(np.diff(stretch, prepend=-1))
    return list(zip(starts.tolist(), [*starts[1:].tolist(), len(stretch)], strict=True))


class Library:
    """Many columns of one joint, of which a search takes few: their products with columns of a :class:`Products`.

    Args:
        columns: Shape (C, rows).
        joint: Which joint's.
    """

    def __init__(self, columns: Array, joint: int) -> None:
        self.columns, self.joint = columns, joint
        self._cross: dict[int, Array] = {}

    def cross(self, products: Products, number: int) -> Array:
        """Inner products of all columns with one. Shape (C,)."""
        if number not in self._cross:
            other = products.column(number, self.joint)
            self._cross[number] = np.zeros(len(self.columns)) if other is None else self.columns @ other
        return self._cross[number]


def gains(
    gram: Array, cross: Array, active: Array, right: Array, low: Array, high: Array, room: tuple[Array, Array]
) -> Array:
    """How much groups of columns would lower a least-squares sum, each group alone beside the active columns.

    Args:
        gram: Of each group with itself. Shape (G, k, k).
        cross: With the active columns. Shape (G, k, A).
        active: Of the active columns with each other. Shape (A, A).
        right: With what is left now. Shape (G, k).
        low: Least coefficient. Shape (G, k).
        high: Greatest coefficient. Shape (G, k).
        room: How far the active coefficients may move, down and up. Shapes (A,).

    Returns:
        Shape (G,), not below what zero coefficients give if the bounds allow those.
    """
    if active.size:
        scale = 1.0 / np.sqrt(np.maximum(np.diag(active), 1e-300))
        inner = active * scale * scale[:, None] + 1e-9 * np.eye(len(scale))
        reduced = cross * scale
        schur = gram - reduced @ np.linalg.solve(inner, reduced.transpose(0, 2, 1))
    else:
        schur = gram
    diagonal = np.maximum(np.einsum("gkk->gk", schur), 1e-9 * np.einsum("gkk->gk", gram) + 1e-300)
    x = np.clip(np.zeros_like(right), low, high)
    for _ in range(1 if right.shape[1] == 1 else 30):  # coordinate descent within the bounds
        for k in range(right.shape[1]):
            rest = right[:, k] - np.einsum("gk,gk->g", schur[:, k], x) + schur[:, k, k] * x[:, k]
            x[:, k] = np.clip(rest / diagonal[:, k], low[:, k], high[:, k])
    closed = 2 * np.einsum("gk,gk->g", right, x) - np.einsum("gk,gkl,gl->g", x, gram, x)
    if not active.size:
        return np.asarray(closed)
    asked = -np.einsum("gk,gka->ga", x, cross)
    move = np.clip(np.linalg.solve(inner, (asked * scale).T).T * scale, *room)
    for _ in range(SWEEPS):  # what one may not do, the others do
        for k, own in enumerate(active):
            move[:, k] = np.clip(move[:, k] + (asked[:, k] - move @ own) / max(own[k], 1e-300), room[0][k], room[1][k])
    return np.asarray(closed + 2 * (asked * move).sum(1) - np.einsum("ga,ab,gb->g", move, active, move))
