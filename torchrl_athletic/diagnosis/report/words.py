"""The words that the terminal and the page share."""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping
from typing import Any

from torchrl_athletic.diagnosis.report.quantity import percent
from torchrl_athletic.diagnosis.result import Answer

_VERDICTS = {
    "nothing_missing": ("Nothing is missing", "The simulation explains the recordings as well as sensor noise allows."),
    "explained": ("Explained", "The physics that the model left out is named, and the named physics closes the gap."),
    "partly_explained": ("Partly explained", "Some of the missing physics is named; part of the error has no name."),
    "unexplained": ("Unexplained", "Simulation and robot differ, and no effect of the catalogue explains how."),
}
_PROPER = {"coulomb": "Coulomb", "stribeck": "Stribeck"}


def verdict_words(answer: Answer) -> tuple[str, str]:
    """The verdict as a heading and as a sentence."""
    return _VERDICTS[answer.verdict]


def words(identifier: str) -> str:
    """An identifier as words.

    Example:
        >>> words("coulomb_friction"), words("reflected_inertia")
        ('Coulomb friction', 'reflected inertia')
    """
    return " ".join(_PROPER.get(word, word) for word in identifier.split("_"))


def title(identifier: str) -> str:
    """:func:`words` with a capital."""
    text = words(identifier)
    return text[:1].upper() + text[1:]


def place(joint: str | None) -> str:
    """The joint, or the words for an effect of all of them."""
    return "whole robot" if joint is None else joint


def stopped_early(answer: Answer) -> list[str]:
    """For an incomplete answer, what it is worth and how to complete it."""
    if answer.complete:
        return []
    return [
        f"Stopped early, in the stage '{answer.stage}': this is the state at that point, not the final answer. "
        "Run the same command again to resume."
    ]


def unexplained(answer: Answer) -> list[str]:
    """How much of the error has no name, where a part of it has none and the simulation has measured it."""
    if answer.verdict == "nothing_missing" or not answer.fit or answer.unexplained_share <= 0:
        return []
    return [f"{percent(answer.unexplained_share)} of the error energy above the noise floor has no named cause."]


def quality_counts(quality: Mapping[str, Any]) -> tuple[dict[str, int], list[str]]:
    """Masked samples by reason over all recordings, and all warnings with the recording that they are about."""
    masked: Counter[str] = Counter()
    warnings = [str(w) for w in quality.get("warnings", ())]
    for recording in quality.get("recordings", ()):
        masked.update({reason: int(n) for reason, n in recording.get("masked", {}).items() if n})
        warnings += [f"{recording.get('source', 'a recording')}: {w}" for w in recording.get("warnings", ())]
    return dict(masked), warnings
