"""Several fits of the same recordings, each a draw of starts and windows, of which the best one stays."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np

from torchrl_athletic.diagnosis.deadline import Deadline
from torchrl_athletic.diagnosis.fitting import Fit


def best_of_draws(
    once: Callable[[int, float | None], Fit], draws: int, seed: int = 0, time_budget: float | None = None
) -> Fit:
    """Fit by several seeds, and keep the fit that follows the recordings best that it was fitted to.

    A search ends where its starts and windows lead it, so that one fit is a draw. Recordings kept aside have no say in
    which one stays. Ctrl-C keeps the best of those that are done.

    Args:
        once: A fit by a seed and a time budget [s].
        draws: How many.
        seed: Of the first; the others follow.
        time_budget: Of all together [s].

    Raises:
        ValueError: If no fit is asked for.

    Example:
        >>> best_of_draws(lambda seed, seconds: fit(model, recordings, seed=seed), draws=3)  # doctest: +SKIP
    """
    if draws < 1:
        raise ValueError(f"draws is {draws}. Ask for one fit or more.")
    deadline, fits = Deadline(np.inf if time_budget is None else time_budget), list[Fit]()
    for k in range(draws):
        try:
            fits.append(once(seed + k, None if time_budget is None else max(deadline.left, 0.0) / (draws - k)))
        except KeyboardInterrupt:
            if not fits:
                raise
            break
    errors = [found.scores["train"].after for found in fits]
    kept = int(np.argmin(errors))
    if len(fits) == 1:
        return fits[0]
    told = ", ".join(f"{error:.3g}" for error in errors)
    remark = (
        f"Of {len(fits)} fits by seeds from {seed} on, whose errors on what was fitted are {told}, that of seed "
        f"{seed + kept} stays."
    )
    seconds = sum(found.seconds for found in fits)
    return replace(fits[kept], remarks=(*fits[kept].remarks, remark), seconds=seconds)
