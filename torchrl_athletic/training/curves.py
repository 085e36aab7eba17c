"""Curves of a training run, drawn from its table."""

from __future__ import annotations

import csv
from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np
from numpy.typing import NDArray


def draw_curves(
    tables: Mapping[str, str | Path],
    columns: Mapping[str, str],
    path: str | Path,
    *,
    against: str = "samples",
    shaded: float = 0.0,
) -> Path:
    """Draw columns of ``progress.csv``, a panel for each, a line for each run.

    Args:
        tables: Paths of the tables by the runs' names.
        columns: Titles of the panels by the columns' names; a column that no table has is left out.
        path: Of the picture, ``.png`` or ``.svg``; its folder is made.
        against: Column of the horizontal axis.
        shaded: Until where on that axis the panels are grey: where the critic learns alone, say.

    Returns:
        The path.

    Raises:
        ValueError: If no table has any of the columns.
    """
    from matplotlib.figure import Figure
    from matplotlib.ticker import EngFormatter

    runs = {name: _columns_of(table) for name, table in tables.items()}
    shown = [name for name in columns if any(name in run for run in runs.values())]
    if not shown:
        raise ValueError(f"none of {sorted(columns)} is a column of {sorted(map(str, tables.values()))}.")
    wide = min(3, len(shown))
    figure = Figure(figsize=(4 * wide, 2.6 * -(-len(shown) // wide)), layout="constrained")
    for number, name in enumerate(shown):
        axis = figure.add_subplot(-(-len(shown) // wide), wide, number + 1)
        for label, run in runs.items():
            if name in run:
                known = ~np.isnan(run[name])
                axis.plot(run[against][known], smoothed(run[name][known]), label=label, lw=1.2)
        if shaded:
            axis.axvspan(0, shaded, color="0.9", lw=0)
        axis.set_title(columns[name], fontsize=9)
        axis.set_xlabel(against, fontsize=8)
        axis.xaxis.set_major_formatter(EngFormatter(sep=""))  # whole numbers of samples would run into each other
        axis.tick_params(labelsize=7)
        axis.grid(alpha=0.3)
        axis.spines[["top", "right"]].set_visible(False)
        if len(runs) > 1 and number == 0:
            axis.legend(fontsize=7, frameon=False)
    path = Path(path)
    path.parent.mkdir(parents=True, exist_ok=True)
    figure.savefig(path, dpi=120)
    return path


def smoothed(values: NDArray[np.float64], share: float = 0.02) -> NDArray[np.float64]:
    """Mean of each value and those around it, over a share of all. Shape (T,).

    Example:
        >>> smoothed(np.array([0.0, 3.0, 0.0]), share=1.0).tolist()
        [1.5, 1.0, 1.5]
    """
    reach = int(share * len(values)) // 2
    total = np.concatenate(([0.0], np.cumsum(values)))
    index = np.arange(len(values))
    first, last = np.maximum(index - reach, 0), np.minimum(index + reach + 1, len(values))
    return (total[last] - total[first]) / (last - first)


def _columns_of(table: str | Path) -> dict[str, NDArray[np.float64]]:
    with Path(table).open(newline="") as file:
        rows: Sequence[Mapping[str, str]] = list(csv.DictReader(file))
    names = rows[0] if rows else {}
    return {name: np.array([float(row[name] or "nan") for row in rows]) for name in names}
