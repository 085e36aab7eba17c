"""A correction is kept for a joint only where recordings kept aside do not get worse."""

from __future__ import annotations

from collections.abc import Callable, Sequence

import numpy as np
from numpy.typing import NDArray

from torchrl_athletic.diagnosis.compare import MOST_WINDOWS, well_started
from torchrl_athletic.diagnosis.fit import WINDOW, Hypothesis, draw_windows
from torchrl_athletic.diagnosis.replay import Take, simulate, window_rmse
from torchrl_athletic.diagnosis.screen import Candidate

Array = NDArray[np.float64]


WORSE = 1.01
"""Error per the given model's from which on a joint got worse; less is how the windows fall [1]."""
NOISE = 1.2
"""Error per the floor up to which it may be noise, which no correction is to blame for [1]."""


def vetoed(
    h: Hypothesis, values: Array, takes: Sequence[Take], rng: np.random.Generator, floor: Array
) -> tuple[Candidate, ...]:
    """Terms and trims to take back so that no joint follows its recordings worse than the given model does.

    All of a joint go together, since halves of a correction may be worse than none, and the joint that got worse most
    goes first: joints are coupled, so that this is asked again until none is worse. What belongs to the whole robot
    goes when nothing else is left. Where all would go so, one joint's after another's is put back instead, what helps
    most alone coming first, as long as no joint is worse: numbers that upset a neighbour once the one beside them is
    gone may be right.

    Args:
        h: The correction.
        values: Its numbers. Shape (P,).
        takes: Recordings kept aside.
        rng: As of the score that is stated, so that both look at the same windows.
        floor: Error that the sensors' noise alone makes [rad, m]. Shape (J,).
    """
    windows = [well_started(w) for w in draw_windows(takes, WINDOW, MOST_WINDOWS, rng)]

    def rmse(x: Array) -> Array:
        return window_rmse(windows, [simulate(w, h.build, x[None])[0] for w in windows])[0]

    def is_worse(after: Array) -> NDArray[np.bool_]:
        return np.asarray(after > np.maximum(WORSE * before, NOISE * floor), dtype=np.bool_)

    before, x = rmse(h.nominal), values.copy()
    gone: list[Candidate] = []
    parts = (*h.terms, *h.trims)
    while len(gone) < len(parts):
        after = rmse(x)
        worse = is_worse(after)
        if not worse.any():
            break
        left = [c for c in parts if c not in gone]
        own = [c for c in left if c.joint_name is not None and worse[c.joint]]
        worst = max(own, key=lambda c: after[c.joint] / before[c.joint], default=None)
        take_back = [c for c in own if worst is not None and c.joint == worst.joint]
        take_back = take_back or [c for c in left if c.joint_name is None] or left
        for c in take_back:
            h.values_of(c, x)[:] = [p.nominal for p in c.parameters]
        gone += take_back
    if len(gone) < len(parts):
        return tuple(gone)
    groups = [[c for c in parts if c.joint_name == joint] for joint in dict.fromkeys(c.joint_name for c in parts)]
    return tuple(_not_put_back(h, values, groups, rmse, is_worse)) if len(groups) > 1 else parts


def _not_put_back(
    h: Hypothesis,
    values: Array,
    groups: Sequence[Sequence[Candidate]],
    rmse: Callable[[Array], Array],
    is_worse: Callable[[Array], NDArray[np.bool_]],
) -> list[Candidate]:
    """What stays away where groups of a correction are put back into the given model as long as no joint is worse."""

    def beside(x: Array, group: Sequence[Candidate]) -> Array:
        x = x.copy()
        for c in group:
            h.values_of(c, x)[:] = h.values_of(c, values)
        return x

    alone = [rmse(beside(h.nominal, g)) for g in groups]
    order = np.argsort([np.log(np.maximum(after, 1e-12)).sum() for after in alone], kind="stable")
    x, away = h.nominal, list[Candidate]()
    for k in order:
        tried = beside(x, groups[k])
        after = alone[k] if (x == h.nominal).all() else rmse(tried)
        if is_worse(after).any():
            away += groups[k]
        else:
            x = tried
    return away


def veto_sentence(gone: Sequence[Candidate], moved: Sequence[str]) -> str:
    """What was taken back, and why.

    Args:
        gone: What was taken back.
        moved: Joints of which something had been corrected.
    """
    places = list(dict.fromkeys(c.where for c in gone if c.where in moved or c.joint_name is None))
    if not places:
        return ""
    return (
        f"What was corrected at {', '.join(places)} is taken back: recordings that were kept aside followed it worse "
        "than the given model."
    )
