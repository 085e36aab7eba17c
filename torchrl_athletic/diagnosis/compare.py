"""How well a model follows recordings, against the least that the sensors' noise allows."""

from __future__ import annotations

from collections.abc import Collection, Mapping, Sequence
from dataclasses import replace
from typing import Literal

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import gaussian_filter1d

from torchrl_athletic.diagnosis.fit import WINDOW, Hypothesis, draw_windows
from torchrl_athletic.diagnosis.replay import Take, Windows, motion_of, rms_over, simulate, window_rmse
from torchrl_athletic.diagnosis.result import Score
from torchrl_athletic.diagnosis.thresholds import SIMULATION, STATEMENT
from torchrl_athletic.effects.signals import kernel_for

Array = NDArray[np.float64]


MOST_WINDOWS = SIMULATION.windows
"""Windows that a score is stated over."""


def score(
    takes: Sequence[Take],
    hypothesis: Hypothesis,
    values: Array,
    position_noise: Array,
    rng: np.random.Generator,
    repeatability: Array | None = None,
) -> tuple[Score, Array, Array, Array]:
    """Error of the given and of the corrected model over windows started from the measured state.

    The floor is what the corrected simulation scores against itself, started from states with the measured noise and
    read with the measured noise; where repeats of a take scatter more than that, their scatter is the floor.

    Returns:
        The score; the error of each window before and after [rad, m], shapes (W, J); and when each starts (see
        :func:`started`), shape (W,).
    """
    windows = [well_started(w) for w in draw_windows(takes, WINDOW, MOST_WINDOWS, rng)]
    sets = np.stack([hypothesis.nominal, values]) if len(values) else np.zeros((2, 0))
    both = [simulate(w, hypothesis.build, sets) for w in windows]
    before, each_before = window_rmse(windows, [b[0] for b in both])
    after, each_after = window_rmse(windows, [b[1] for b in both])
    floor = noise_floor(windows, hypothesis, values, [b[1] for b in both], position_noise, rng)
    if repeatability is not None:
        floor = np.maximum(floor, repeatability)
    names = takes[0].recording.joint_names
    within = [_within_reach(windows, each) for each in (each_before, each_after)]
    rows = zip(before, after, floor, *within, strict=True)
    keys = "before", "after", "floor", "before_within_reach", "after_within_reach"
    per_joint = {name: dict(zip(keys, map(float, row), strict=True)) for name, row in zip(names, rows, strict=True)}
    was, left, least = (float(np.sqrt(np.mean(x**2))) for x in (before, after, floor))
    gap = was - least
    closed = float(np.clip((was - left) / gap, -1.0, 1.0)) if gap > 0 else 0.0
    return Score(was, left, least, closed, per_joint), each_before, each_after, started(windows)


def started(windows: Sequence[Windows]) -> Array:
    """When each window starts, what was recorded without a gap placed one after the other [s]. Shape (W,)."""
    times, end = [], 0.0
    for w in windows:
        parts = np.searchsorted(w.take.begins, w.start, side="right") - 1
        for part, first in enumerate(w.take.begins):
            times.append(end + w.take.time[w.start[parts == part]] - w.take.time[first])
            end += SIMULATION.between + w.take.parts[part].recording.duration
    return np.concatenate(times)


def well_started(windows: Windows) -> Windows:
    """Move each window by up to a quarter of its length to where its start is known best.

    That is where the local fit that it starts from is wide, and where the command is quiet: a step of the command bends
    the velocity, and the fit rounds the bend. An error of the start would be charged to the model.
    """
    take, reach = windows.take, windows.length // 4
    command = take.commands(0.0).reshape(len(take.time), take.substeps, -1).mean(1)
    change = np.abs(np.diff(command, axis=0, prepend=command[:1])) / np.maximum(command.std(0), 1e-12)
    loud = gaussian_filter1d(change.max(1), max(kernel_for([take.recording]) / take.period, 1.0))
    noise = doubt_of_starts(take)
    start, ends = [], np.append(take.begins[1:], len(take.time))
    for first in windows.start:
        part = int(np.searchsorted(take.begins, first, side="right")) - 1
        low = max(take.begins[part], first - reach)
        high = min(ends[part] - 1 - windows.length, first + reach) + 1
        near = noise[low:high]
        start.append(low + int(np.argmin(np.where(near <= np.median(near), loud[low:high], np.inf))))
    return Windows(take, np.unique(np.array(start, dtype=np.intp)), windows.length)


def doubt_of_starts(take: Take) -> Array:
    """Noise of the state that a window would start from at each sample, per the typical one [1]. Shape (T,)."""
    typical = np.maximum(np.median(take.start_noise, axis=1, keepdims=True), 1e-12)
    return np.asarray((take.start_noise / typical).max((0, 2)), dtype=np.float64)


def noise_floor(
    windows: Sequence[Windows],
    hypothesis: Hypothesis,
    values: Array,
    truth: Sequence[Array],
    position_noise: Array,
    rng: np.random.Generator,
) -> Array:
    """Error of a perfect model.

    Noise of the starting states carried through the window, of the readings, and of the time step.

    The time step's part is twice the change that halving it makes, since MuJoCo's integrators are of first order.
    Shape (J,).
    """
    square, weight = np.zeros(len(position_noise)), 0.0
    for w, ideal in zip(windows, truth, strict=True):
        take = w.take
        q = take.position[w.start] + take.start_noise[0][w.start] * rng.standard_normal(
            (len(w.start), len(position_noise))
        )
        v = take.velocity[w.start] + take.start_noise[1][w.start] * rng.standard_normal(
            (len(w.start), len(position_noise))
        )
        noisy = simulate(replace(w, take=take.misread(rng)), hypothesis.build, values[None], start=(q, v))[0]
        finer = simulate(replace(w, take=w.take.halved()), hypothesis.build, values[None])[0]
        wrong = (noisy - ideal) ** 2 + 4 * (finer - ideal) ** 2
        square += np.minimum(wrong.mean(1), np.quantile(wrong.mean(1), 0.95, axis=0)).mean(0) * len(w.start) * w.length
        weight += len(w.start) * w.length
    return np.sqrt(square / max(weight, 1.0) + position_noise**2)


def harms(score: Score | None) -> bool:
    """Whether a correction makes the fitted recordings worse: then it is none."""
    return score is not None and score.after > score.before


def uncorrected(score: Score) -> Score:
    """The score of the given model, which nothing corrects."""
    per_joint = {name: {k: e[k.replace("after", "before")] for k in e} for name, e in score.per_joint.items()}
    return replace(score, after=score.before, share_closed=0.0, per_joint=per_joint)


def follows(score: Score, times: float) -> bool:
    """Whether the corrected model's error is within so many times the floor, on every joint."""
    return all(joint["after"] <= times * max(joint["floor"], 1e-12) for joint in score.per_joint.values())


def _within_reach(windows: Sequence[Windows], each: Array) -> Array:
    """RMSE of the windows, none of which counts for more than a radian, a metre, or its motion if that is more.

    ``each``: errors of the windows, shape (W, J). Shape (J,).
    """
    return rms_over(windows, np.minimum(each**2, np.maximum(SIMULATION.fallen**2, motion_of(windows))))


def within_reach(joint: Mapping[str, float], when: Literal["before", "after"]) -> float:
    """Error of a joint that shares are made of: where a model falls it counts as a radian off, or as its motion.

    A frictionless wrist that spins away by 200 rad would else make half a radian next to nothing.
    """
    return joint.get(f"{when}_within_reach", joint[when])


def open_share(score: Score) -> float:
    """Share of the error energy above the floor that is left, each joint in units of its floor, 0..1.

    A joint that the correction makes worse counts with what it was made worse by, as far as that is
    :func:`within_reach`.
    """
    was = left = 0.0
    for joint in score.per_joint.values():
        unit = max(joint["floor"], 1e-12) ** 2
        was += max(within_reach(joint, "before") ** 2 / unit - 1.0, 0.0)
        left += max(within_reach(joint, "after") ** 2 / unit - 1.0, 0.0)
    return float(np.clip(left / was, 0.0, 1.0)) if was > 0 else float(left > 1.0)


def falls(score: Score) -> bool:
    """Whether the given model falls, so that some of its error counts no longer as what it is."""
    return any(within_reach(joint, "before") < 0.99 * joint["before"] for joint in score.per_joint.values())


def far_joints(scores: Collection[Score]) -> frozenset[str]:
    """Joints that the corrected model does not follow, in fitted recordings or in those kept aside."""
    return frozenset(
        name
        for s in scores
        for name, e in s.per_joint.items()
        if e["after"] > STATEMENT.near_floor * max(e["floor"], 1e-12)
        and e["after"] > STATEMENT.kept * within_reach(e, "before")
    )
