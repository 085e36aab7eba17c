"""How much of what a simulated arm misses its effect's fingerprint explains."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np
from effects.arm import address, arm, record
from numpy.typing import ArrayLike

from torchrl_athletic.effects import Effect, Signals, project_recording


def projected(effect: Effect, joint: int, values: ArrayLike, seconds: float = 8.0) -> Signals:
    """What the arm records with the effect in it, without noise."""
    return project_recording(record(effect, joint, values, seconds=seconds), arm(), np.zeros(2), kernel=0.012)


def explained(
    effect: Effect, joint: int, values: Sequence[float], s: Signals, hidden: Mapping[str, float] | None = None
) -> tuple[float, float]:
    """Share of the missing torque that the fingerprint explains at the true values, and the factor that suits it best.

    Samples at which the joint turns around or sticks are left out: static friction takes any torque up to its limit.
    """
    parameters = effect.parameters(arm(), address(), joint)
    given = {p.name: v for p, v in zip(parameters, values, strict=True)}
    point = effect.grid(s, joint)[0] if hidden is None else {}
    fixed = {**point, **{n: v for n, v in given.items() if n in point}, **(hidden or {})}
    fingerprint = effect.fingerprint(s, joint, fixed)
    coefficients = [effect.change(p, given[p.name]) for p in parameters if p.name not in fixed]
    predicted = fingerprint.columns @ np.array(coefficients)
    if fingerprint.constant is not None:
        predicted = predicted + fingerprint.constant
    assert predicted.shape == s.missing.shape
    moving = np.abs(s.velocity[:, joint]) > 0.05 * np.abs(s.velocity[:, joint]).max()
    missing, predicted = s.missing[moving], predicted[moving]
    left = ((missing - predicted) ** 2).sum() / (missing**2).sum()
    return 1.0 - float(left), float(np.vdot(missing, predicted) / np.vdot(predicted, predicted))
