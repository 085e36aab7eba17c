"""Inner products of columns, joint by joint: all that least squares needs of them, each taken once and kept."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]


class Products:
    """Grows with the columns that were asked for; time and memory are linear in the number of rows.

    A column belongs to one joint, with shape (rows,), or to all, with shape (rows, J) and ``joint`` -1.
    """

    def __init__(self, joints: int, rows: int) -> None:
        self.joints = joints
        self._size = 0
        self._columns = [np.empty((0, rows)) for _ in range(joints)]
        """Per joint, of the columns that touch it. Shape (at least its count, rows)."""
        self._places: list[list[int]] = [[] for _ in range(joints)]
        """Per joint, which columns they are."""
        self._gram = np.zeros((joints, 0, 0))

    def add(self, column: Array, joint: int) -> int:
        """Take a column in; its number comes back."""
        number = self._size
        self._size += 1
        if self._size > self._gram.shape[1]:
            grown = np.zeros((self.joints, 2 * self._size, 2 * self._size))
            grown[:, :number, :number] = self._gram[:, :number, :number]
            self._gram = grown
        for j in range(self.joints) if joint < 0 else (joint,):
            values = column[:, j] if joint < 0 else column
            here = self._places[j]
            if len(here) == len(self._columns[j]):
                room = np.empty((len(here) + 4, values.size))
                self._columns[j] = np.concatenate([self._columns[j], room])
            self._columns[j][len(here)] = values
            here.append(number)
            products = self._columns[j][: len(here)] @ values
            self._gram[j, number, here] = self._gram[j, here, number] = products
        return number

    def gram(self, numbers: Sequence[int]) -> Array:
        """Inner products of some columns with each other. Shape (J, n, n)."""
        at = np.asarray(numbers, dtype=np.intp)
        return self._gram[:, at[:, None], at]

    def touching(self, joint: int) -> Array:
        """All columns that are not zero on a joint, in the order in which they came. Shape (n, rows)."""
        return self._columns[joint][: len(self._places[joint])]

    def column(self, number: int, joint: int) -> Array | None:
        """One joint's part of a column, None where it is zero. Shape (rows,)."""
        here = self._places[joint]
        return self._columns[joint][here.index(number)] if number in here else None


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


def gains(gram: Array, cross: Array, active: Array, right: Array, low: Array, high: Array) -> Array:
    """How much groups of columns would lower a least-squares sum, each group alone beside the active columns.

    Args:
        gram: Of each group with itself. Shape (G, k, k).
        cross: With the active columns. Shape (G, k, A).
        active: Of the active columns with each other. Shape (A, A).
        right: With what is left now. Shape (G, k).
        low: Least coefficient. Shape (G, k).
        high: Greatest coefficient. Shape (G, k).

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
    return np.asarray(2 * np.einsum("gk,gk->g", right, x) - np.einsum("gk,gkl,gl->g", x, schur, x))
