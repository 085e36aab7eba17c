"""How the error divides: what the named physics explains, what stays, what is noise."""

from __future__ import annotations

import math
from collections.abc import Mapping

from torchrl_athletic.diagnosis.compare import within_reach
from torchrl_athletic.diagnosis.result import Answer, Score

NAMES = {
    "physics": "named physics",
    "uan": "UAN",
    "unexplained": "unexplained",
    "noise": "noise",
}
"""Part -> its name, in the order in which they are drawn."""


def energy_shares(answer: Answer, split: str) -> dict[str, float]:
    """Shares of the error energy (mean square) of the given model, averaged over the joints; they add up to one.

    A score ``SPLIT_uan``, with the remainder handed to a UAN, divides what is left once more.

    Args:
        answer: With a score of the split.
        split: 'heldout' or 'train'.

    Example:
        >>> score = Score(before=10.0, after=5.0, floor=1.0, share_closed=0.56, per_joint={})
        >>> energy_shares(Answer("explained", (), fit={"train": score}), "train")
        {'physics': 0.75, 'unexplained': 0.24, 'noise': 0.01}
    """
    corrected, learned = _rows(answer.fit[split]), _rows(answer.fit.get(f"{split}_uan"))
    parts: dict[str, list[float]] = {}
    for joint, row in corrected.items():
        whole = max(within_reach(row, "before") ** 2, 1e-300)
        noise = min(row["floor"] ** 2 / whole, 1.0)
        left = min(max(within_reach(row, "after") ** 2 / whole - noise, 0.0), 1.0 - noise)
        parts.setdefault("physics", []).append(1.0 - noise - left)
        if learned:
            rest = min(max(within_reach(learned[joint], "after") ** 2 / whole - noise, 0.0), left)
            parts.setdefault("uan", []).append(left - rest)
            left = rest
        parts.setdefault("unexplained", []).append(left)
        parts.setdefault("noise", []).append(noise)
    mean = {name: math.fsum(values) / len(values) for name, values in parts.items()}
    return {name: round(mean[name], 12) for name in NAMES if name in mean and math.isfinite(mean[name])}


def _rows(score: Score | None) -> Mapping[str, Mapping[str, float]]:
    if score is None:
        return {}
    pooled = {"before": score.before, "after": score.after, "floor": score.floor}
    return score.per_joint or {"all joints": pooled}
