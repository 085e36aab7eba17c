"""A fit in one picture: each joint as it was recorded, as the given model and as the fitted one move it."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from torchrl_athletic.diagnosis.model import position_unit
from torchrl_athletic.diagnosis.prepare import carrying
from torchrl_athletic.diagnosis.report.figures import AFTER, BEFORE, INK
from torchrl_athletic.diagnosis.thresholds import SIMULATION

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

    from torchrl_athletic.diagnosis.corrected import Simulation
    from torchrl_athletic.diagnosis.fitting import Fit
    from torchrl_athletic.recordings import Recording

Array = NDArray[np.float64]

SECONDS = 5.0
"""Length that is drawn of one recording [s]."""
MOST = 8
"""Joints that are drawn, those of the largest error first."""


def fit_picture(fit: Fit) -> Figure:
    """Recorded and simulated positions of one recording, one joint a row, in windows of half a second."""
    from matplotlib.figure import Figure

    recording = (*fit.heldout, *fit.recordings)[0]
    split = "heldout" if fit.heldout else "train"
    score = fit.scores[split]
    names = sorted(score.per_joint, key=lambda name: -score.per_joint[name]["before"])[:MOST]
    paths = [_loaded(simulation, fit.xml, recording).rollout(recording) for simulation in (fit.nominal, fit.corrected)]
    shown = recording.time - recording.time[0] <= SECONDS
    figure = Figure(figsize=(9, 1.2 + 1.9 * len(names)), layout="constrained")
    for axes, name in zip(np.ravel(figure.subplots(len(names), 1, sharex=True, squeeze=False)), names, strict=True):
        j, error = recording.joint_names.index(name), score.per_joint[name]
        time = recording.time[shown] - recording.time[0]
        axes.plot(time, recording.position[shown, j], color=INK, linewidth=2.2, alpha=0.5, label="recorded")
        for path, colour, label in zip(paths, (BEFORE, AFTER), ("given model", "fitted"), strict=True):
            axes.plot(time, path[shown, j], color=colour, linewidth=1.1, label=label)
        unit = position_unit(fit.nominal.model, name)
        axes.set_ylabel(f"[{unit}]")
        told = f"error over {SIMULATION.window:g} s {error['before']:.3g} → {error['after']:.3g} {unit}"
        left = _look_at(axes, recording.position[shown, j], *(path[shown, j] for path in paths))
        told += "; the given model leaves the picture" if left else ""
        axes.set_title(f"{name}: {told}", loc="left", fontsize=10)
    axes.set_xlabel(f"time [s], {'kept aside' if fit.heldout else 'fitted'}: {Path(recording.source).name}")
    lines, labels = figure.axes[0].get_legend_handles_labels()
    figure.legend(lines, labels, frameon=False, ncols=3, loc="outside upper right", fontsize=9)
    return figure


def _loaded(simulation: Simulation, xml: str, recording: Recording) -> Simulation:
    """The simulation with what was fastened to the robot, as the fit had it."""
    model = carrying(simulation.model, xml, recording.ordered(simulation.joint_names))
    return simulation if model is simulation.model else replace(simulation, model=model)


def _look_at(axes: Axes, recorded: Array, given: Array, fitted: Array) -> bool:
    """Limit the picture to what is near the recorded and the fitted motion. Whether the given model leaves it.

    Beside a model that falls by hundreds of radians nobody would see how well the fitted one follows.
    """
    near = np.concatenate([recorded, fitted])
    reach = np.ptp(near) + 1e-9
    low, high = (np.clip(edge, near.min() - reach, near.max() + reach) for edge in (given.min(), given.max()))
    low, high = min(low, near.min()), max(high, near.max())
    margin = 0.05 * (high - low) + 1e-9
    axes.set_ylim(low - margin, high + margin)
    return bool(given.min() < low - margin or given.max() > high + margin)
