"""The answer for the terminal: three sentences, then a compact table."""

from __future__ import annotations

import textwrap
from collections.abc import Iterator

from torchrl_athletic.diagnosis.report.quantity import (
    CHOSEN,
    estimate,
    joint_units,
    percent,
    quantities,
    share_closed,
)
from torchrl_athletic.diagnosis.report.words import (
    IF_KNOWN,
    banners,
    besides,
    bridged_readings,
    joints_and_regimes,
    lead,
    next_takes,
    of_class,
    place,
    quality_counts,
    same_as,
    title,
    unexplained,
    verdict_words,
    words,
    would_change,
)
from torchrl_athletic.diagnosis.result import Answer, Finding, Score

WIDTH = 100
NAME = 46
"""Width of the first column."""
MOST_REGIMES = 4


def terminal_summary(answer: Answer, experiment: str = "") -> str:
    """What was found, where, how sure, and how much better it fits, in lines of at most 100 columns.

    Args:
        answer: What the diagnosis states.
        experiment: What the planned experiment asks for, in words, if there is one.

    Example:
        >>> print(terminal_summary(Answer("nothing_missing", ("The model explains the recordings.",), model="arm.xml")))
        ... # doctest: +ELLIPSIS
        arm.xml: nothing is missing.
        <BLANKLINE>
        The model explains the recordings.
        What would change this? A recording that the model follows clearly worse than these...
        <BLANKLINE>
        Record next: Nothing needs to be. ...
    """
    blocks = [
        _wrapped(f"{answer.model}: {verdict_words(answer)[0].lower()}."),
        *(_wrapped(sentence) for sentence in banners(answer)),
        "\n".join([*map(_wrapped, lead(answer)), _wrapped(f"What would change this? {would_change(answer)}")]),
        "\n".join(_findings(answer)),
        "\n".join(_fit(answer)),
        "\n".join(_where(answer)),
        "\n".join(_wrapped(remark) for remark in (*unexplained(answer), *besides(answer), *answer.remarks)),
        "\n".join(_next(answer, experiment)),
        "\n".join(_quality(answer)),
    ]
    return "\n\n".join(block for block in blocks if block)


def _findings(answer: Answer) -> Iterator[str]:
    if answer.findings:
        yield _row("missing", "sure")
    for finding in answer.findings:
        yield _row(f"{title(finding.effect)}, {place(finding.joint)}", percent(finding.probability))
        if of_class(finding):
            yield _row(f"  {of_class(finding)}", percent(finding.class_probability))
        yield from _parameters(finding)
        if finding.sentence not in lead(answer):
            yield _wrapped(finding.sentence, "    ", "    ")
        for sentence in same_as(finding, answer):
            yield _wrapped(sentence, "    ", "    ")
        yield _wrapped(f"shows {finding.regime}", "    ", "    ")
        for rival in finding.rivals:
            yield _row(f"  or {words(rival.effect)}, {place(rival.joint)}", percent(rival.probability))
            for sentence in same_as(rival, answer):
                yield _wrapped(sentence, "    ", "    ")
    if answer.findings:
        yield _wrapped(IF_KNOWN, "  ", "  ")


def _parameters(finding: Finding) -> Iterator[str]:
    width = max((len(words(name)) for name in finding.parameters), default=0)
    for name, parameter in finding.parameters.items():
        value, low, high, unit = estimate(parameter)
        interval = "" if name in CHOSEN else f"  (95 %: {low} to {high})"
        yield f"    {words(name):<{width}}  {f'{value} {unit}'.rstrip()}{interval}"


def _fit(answer: Answer) -> Iterator[str]:
    units = joint_units(answer)
    names = {"heldout": "kept aside", "heldout_uan": "kept aside, with a UAN", "train": "fitted"}
    shown = [(split, on) for split, on in names.items() if split in answer.fit]
    if shown:
        yield _row("error over 0.5 s", "before", "after", "floor", "closed")
    for i, (split, on) in enumerate(shown):
        score = answer.fit[split]
        used = {units[joint] for joint in score.per_joint} or {"rad"}
        rows = [(joint, units[joint], r["before"], r["after"], r["floor"]) for joint, r in score.per_joint.items()]
        if len(used) > 1:  # metres and radians make no sum
            kept = rows
        else:
            pooled = ("all joints", used.pop(), score.before, score.after, score.floor)
            kept = rows if len(rows) == 1 else [pooled, *(rows if i == 0 else ())]
        for joint, unit, before, after, floor in kept:
            numbers, name = quantities([before, after, floor], unit)
            closed = _closed(answer, score, joint, (before, after, floor))
            yield _row(f"{on}, {joint} [{name}]", *numbers, closed)


def _closed(answer: Answer, score: Score, joint: str, errors: tuple[float, float, float]) -> str:
    if answer.verdict == "nothing_missing":
        return ""
    pooled = joint == "all joints" or len(score.per_joint) == 1
    return percent(score.share_closed if pooled else share_closed(*errors))


def _where(answer: Answer) -> Iterator[str]:
    joints, regimes = joints_and_regimes(answer.locations)
    if answer.locations:
        yield _row("where the error is", "share", "95 %")
    for location in (*joints, *regimes[:MOST_REGIMES]):
        low, high = (percent(v).removesuffix(" %") for v in location.ci95)
        name = f"{location.joint}, {location.regime}"
        yield _row(name, percent(location.share_of_error), "" if low == high else f"{low} to {high}")


def _next(answer: Answer, experiment: str) -> Iterator[str]:
    for sentence in [experiment] if experiment else next_takes(answer):
        yield _wrapped(f"Record next: {sentence}", hanging="   ")


def _quality(answer: Answer) -> Iterator[str]:
    masked, warnings = quality_counts(answer.quality)
    if masked:
        yield _wrapped(
            "Left out by quality control: " + ", ".join(f"{n} samples ({why})" for why, n in masked.items()) + "."
        )
    if bridged := sum(map(bridged_readings, answer.quality.get("recordings", ()))):
        yield _wrapped(f"{bridged} readings that repeat or leave for a moment were put between their neighbours.")
    for warning in warnings:
        yield _wrapped(f"Warning: {warning}", hanging="   ")


def _row(name: str, *cells: str) -> str:
    """A name, wrapped in its column where it is too long, and cells that end below each other."""
    *above, last = textwrap.wrap(name, NAME, subsequent_indent="    ", break_on_hyphens=False) or [""]
    return "\n".join(f"  {line}".rstrip() for line in (*above, f"{last:<{NAME}}" + "".join(f"{c:>12}" for c in cells)))


def _wrapped(text: str, first: str = "", hanging: str = "") -> str:
    return textwrap.fill(
        text, WIDTH, initial_indent=first, subsequent_indent=hanging, break_long_words=False, break_on_hyphens=False
    )
