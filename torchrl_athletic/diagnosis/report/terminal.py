"""The answer in sentences, for the terminal."""

from __future__ import annotations

import textwrap
from collections.abc import Iterator

from torchrl_athletic.diagnosis.report.quantity import estimate, joint_units, percent, quantities
from torchrl_athletic.diagnosis.report.words import (
    place,
    quality_counts,
    stopped_early,
    title,
    unexplained,
    verdict_words,
    words,
)
from torchrl_athletic.diagnosis.result import Answer, Finding

WIDTH = 100


def terminal_summary(answer: Answer) -> str:
    """What was found, where, how sure, and how much better it fits, in sentences of at most 100 columns.

    Example:
        >>> print(terminal_summary(Answer("nothing_missing", ("The model explains the recordings.",), model="arm.xml")))
        arm.xml: nothing is missing.
        <BLANKLINE>
        The model explains the recordings.
    """
    told_below = {finding.sentence for finding in answer.findings}
    blocks = [
        _wrapped(f"{answer.model}: {verdict_words(answer)[0].lower()}."),
        *(_wrapped(sentence) for sentence in stopped_early(answer)),
        "\n".join(_wrapped(sentence) for sentence in answer.summary if sentence not in told_below),
        "\n\n".join("\n".join(_finding(i, f)) for i, f in enumerate(answer.findings, start=1)),
        "\n".join(_fit(answer)),
        "\n".join(_where(answer)),
        "\n".join(_wrapped(remark) for remark in (*unexplained(answer), *answer.remarks)),
        "\n".join(_quality(answer)),
    ]
    return "\n\n".join(block for block in blocks if block)


def _finding(rank: int, finding: Finding) -> Iterator[str]:
    yield _wrapped(f"{rank}. {finding.sentence}", hanging="   ")
    yield _wrapped(
        f"{title(finding.effect)}, {place(finding.joint)}: probability {percent(finding.probability)}. "
        f"Shows {finding.regime}.",
        first="   ",
        hanging="   ",
    )
    width = max((len(title(name)) for name in finding.parameters), default=0)
    for name, parameter in finding.parameters.items():
        value, low, high, unit = estimate(parameter)
        yield f"     {title(name):<{width}}  {value} {unit}".rstrip() + f"  (95 %: {low} to {high})"
    for rival in finding.rivals:
        yield _wrapped(
            f"Or {words(rival.effect)}, {place(rival.joint)} ({percent(rival.probability)}). "
            f"To tell them apart: {rival.separating_experiment}",
            first="   ",
            hanging="     ",
        )


def _fit(answer: Answer) -> Iterator[str]:
    units = joint_units(answer)
    for split, on in (("heldout", "On recordings kept aside"), ("train", "On the recordings of the fit")):
        if split not in answer.fit:
            continue
        score = answer.fit[split]
        used = {units[joint] for joint in score.per_joint} or {"rad"}
        if len(used) == 1:
            (b, a, f), unit = quantities([score.before, score.after, score.floor], used.pop())
            closed = "" if answer.verdict == "nothing_missing" else f", {percent(score.share_closed)} of the gap closed"
            yield _wrapped(f"{on}: error {b} → {a} {unit} over 0.5 s (noise floor {f} {unit}){closed}.")
        else:
            yield f"{on}:"
        if len(score.per_joint) > 1:
            width = max(map(len, score.per_joint))
            for joint, row in score.per_joint.items():
                (b, a, f), unit = quantities([row["before"], row["after"], row["floor"]], units[joint])
                yield f"   {joint:<{width}}  {b} → {a} {unit} (floor {f} {unit})"


def _where(answer: Answer) -> Iterator[str]:
    if answer.locations:
        yield "Where the error is:"
    for location in answer.locations[:5]:
        low, high = (percent(v) for v in location.ci95)
        band = "" if low == high else f" (95 %: {low} to {high})"
        yield _wrapped(
            f"{percent(location.share_of_error):>6}  {location.joint}, {location.regime}{band}",
            first="   ",
            hanging="           ",
        )


def _quality(answer: Answer) -> Iterator[str]:
    masked, warnings = quality_counts(answer.quality)
    if masked:
        yield _wrapped(
            "Left out by quality control: " + ", ".join(f"{n} samples ({why})" for why, n in masked.items()) + "."
        )
    for warning in warnings:
        yield _wrapped(f"Warning: {warning}", hanging="   ")


def _wrapped(text: str, first: str = "", hanging: str = "") -> str:
    return textwrap.fill(
        text, WIDTH, initial_indent=first, subsequent_indent=hanging, break_long_words=False, break_on_hyphens=False
    )
