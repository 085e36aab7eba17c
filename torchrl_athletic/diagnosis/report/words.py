"""The words that the terminal and the page share."""

from __future__ import annotations

import shlex
from collections import Counter
from collections.abc import Mapping, Sequence
from typing import Any

from torchrl_athletic.diagnosis.report.quantity import percent
from torchrl_athletic.diagnosis.result import Answer, Finding, Location, Name, Rival
from torchrl_athletic.diagnosis.thresholds import STATEMENT
from torchrl_athletic.effects.effect import CLASSES

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


IF_KNOWN = "These percentages hold if the physics is in the catalogue; if it is not, another name can fit as well."


def go_on(folder: str, payload: float) -> str:
    """The command that takes the recording of a planned experiment in, with the mass that it asks to fasten [kg]."""
    weight = f" --payload {payload:g}" if payload else ""
    return f"torchrl-athletic diagnose --output {shlex.quote(folder)} --continue new_recording.npz{weight}"


def lead(answer: Answer) -> list[str]:
    """The answer in at most three sentences: what is missing, where it shows, how much better the correction fits."""
    told = [f.sentence for f in answer.findings if f.sentence in answer.summary]
    rest = [s for s in answer.summary if s not in told]
    if len(told) > 1:
        likely = [f for f in answer.findings if f.sentence in told]
        named = [f"{words(f.effect)} ({place(f.joint)}, {percent(f.probability)})" for f in likely]
        told = [f"{_count(len(named))} effects are likely missing: {', '.join(named[:-1])} and {named[-1]}."]
    return ([*told, *rest] or [verdict_words(answer)[1]])[:3]


def besides(answer: Answer) -> list[str]:
    """What the summary says and :func:`lead` and the findings do not."""
    said = {*lead(answer), *(f.sentence for f in answer.findings)}
    return [s for s in answer.summary if s not in said]


def would_change(answer: Answer) -> str:
    """What would change the verdict."""
    if not answer.complete:
        return "The rest of the run: the same command, run to its end, goes on from here."
    if answer.verdict == "nothing_missing":
        return (
            "A recording that the model follows clearly worse than these. Nothing is known of motions that are faster, "
            "slower, heavier or colder than the recorded ones."
        )
    if answer.verdict == "explained":
        text = "A recording of another kind on which the corrected model errs clearly more than here"
        rival = next((r for f in answer.findings for r in f.rivals), None)
        return f"{text}; or a next recording that favours {words(rival.effect)}." if rival else f"{text}."
    if answer.verdict == "partly_explained":
        where = next((x for x in answer.locations if x.regime != "everywhere"), None)
        at = f", above all of {where.joint}, {where.regime}" if where else ""
        return f"A name for what is left. Record more of the motion that shows it{at}."
    return (
        "An effect that the catalogue does not have yet, or a slip in what was given: check units, signs, the order of "
        "the joints and the gains, then record another payload, speed and temperature."
    )


def grounds_words(finding: Finding) -> list[str]:
    """What the probability of a finding rests on, in sentences; none where it was not kept.

    Example:
        >>> f = Finding("backlash", "elbow", 0.9, "", {}, "", grounds={"share": 0.97, "left": 0.02, "scatter": 0.05})
        >>> grounds_words(f)[0]
        'It has 97 % of the evidence among the effects that could stand in its place.'
    """
    g = finding.grounds
    where = "the joint" if finding.joint else "the joint that is explained worst"
    said = {
        "share": "It has {} of the evidence among the effects that could stand in its place.",
        "energy": f"It accounts for {{}} of the missing torque of {where}.",
        "left": f"With everything named, {{}} of the missing torque of {where} stays.",
        "scatter": "Its strength differs by {} from take to take; physics has one value on all of them.",
        "open": "Of the simulation's error above the noise floor {} stays.",
        "closes": "Where the rest stays, it closes {} of the simulation's error.",
    }
    words = [text.format(percent(g[name])) for name, text in said.items() if name in g]
    if (asked := g.get("asked", -1.0)) > 0:
        words.append(f"The motion asks for its class: without, {percent(asked)} of the error comes back.")
    elif asked == 0:
        words.append("Asked for few effects, the motion does without its class.")
    if "sure" in g:
        words.append(f"Its numbers lie {g['sure']:.2g} standard deviations from the given model's.")
    if g.get("overruled"):
        words.append("The torques speak for something else, so that its law has one half at most.")
    if g.get("far"):
        at = finding.joint or "some joint"
        words.append(
            f"With all that is named the simulation of {at} is still far from the recordings: a law there is another."
        )
    if g.get("refused"):
        words.append("With it recordings that were kept aside are followed worse than by the given model.")
    return words


def of_class(finding: Finding) -> str:
    """What is said of the class of a finding that is not likely itself; empty where that says no more.

    Example:
        >>> f = Finding("stribeck_friction", "hip", 0.4, "", {}, "", class_name="friction", class_probability=0.9)
        >>> of_class(f)
        'friction there, by whichever law'
    """
    says_more = finding.probability <= STATEMENT.likely and finding.class_probability >= finding.probability + 0.01
    if not finding.class_name or not says_more:
        return ""
    return f"{CLASSES.get(finding.class_name, words(finding.class_name))} there, by whichever law"


def same_as(finding: Finding | Rival, answer: Answer) -> list[str]:
    """The other names of what a finding states, or a rival of one would, in sentences.

    Example:
        >>> f = Finding("clock_offset", None, 0.9, "", {}, "", alternatives=((Name("actuation_delay", "disk"),),))
        >>> same_as(f, Answer("explained", (), findings=(f,)))
        ['Clock offset, which here is the same as actuation delay of disk: no recording tells them apart.']
    """
    out = []
    for names in finding.alternatives:
        others = () if isinstance(finding, Rival) else answer.findings  # a rival's names are its own, without partners
        together = [g for g in others if g is not finding and names in g.alternatives]
        partners = " and ".join(_named(g, finding.joint) for g in together)
        which = f"which together with {partners}" if partners else "which here"
        said = " with ".join(_named(n, finding.joint) for n in names)
        out.append(f"{title(finding.effect)}, {which} is the same as {said}: no recording tells them apart.")
    return out


def _named(name: Name | Finding, here: str | None) -> str:
    """Words for a name, with its joint where that is another one."""
    at = "" if name.joint == here else f" of {'the ' if name.joint is None else ''}{place(name.joint)}"
    return f"{words(name.effect)}{at}"


def next_takes(answer: Answer) -> list[str]:
    """What to record next: what separates the rivals, else what would test the answer most."""
    asked = list(dict.fromkeys(r.separating_experiment for f in answer.findings for r in f.rivals))
    if asked:
        return asked
    joints, regimes = joints_and_regimes(answer.locations)
    if answer.verdict == "nothing_missing":
        return ["Nothing needs to be. To test the model further: motions faster, slower, heavier or colder than these."]
    if answer.verdict == "explained":
        return ["Nothing is left to tell apart. To test the answer: a motion of another kind, to keep aside."]
    where = f"{regimes[0].joint}, {regimes[0].regime}" if regimes else "the joint with the largest error"
    if answer.verdict == "partly_explained":
        return [f"More of the motion that shows what is left: {where}."]
    who = f"{joints[0].joint} alone" if joints else "one joint at a time"
    return [f"{who[0].upper()}{who[1:]}: slow constant speeds both ways, a fast chirp, and both with a second payload."]


def joints_and_regimes(locations: Sequence[Location]) -> tuple[list[Location], list[Location]]:
    """Whole joints, and regimes of them."""
    return [x for x in locations if x.regime == "everywhere"], [x for x in locations if x.regime != "everywhere"]


def _count(n: int) -> str:
    return {2: "Two", 3: "Three", 4: "Four", 5: "Five", 6: "Six"}.get(n, str(n))


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


def banners(answer: Answer) -> list[str]:
    """What has to be known before anything else.

    Torques that are not their joints', a model that the recordings changed, and a run that was stopped.
    """
    doubts = [f"Warning: {text}" for text in answer.quality.get("column_doubts", ())]
    return [*doubts, *map(str, answer.quality.get("model_changes", ())), *stopped_early(answer)]


def unexplained(answer: Answer) -> list[str]:
    """How much of the error the correction leaves, where it leaves some and the simulation has measured it."""
    if answer.verdict == "nothing_missing" or not answer.fit or answer.unexplained_share <= 0:
        return []
    return [f"{percent(answer.unexplained_share)} of the error energy above the noise floor stays unexplained."]


def quality_counts(quality: Mapping[str, Any]) -> tuple[dict[str, int], list[str]]:
    """Masked samples by reason over all recordings, and all warnings with the recording that they are about."""
    masked: Counter[str] = Counter()
    warnings = [str(w) for w in quality.get("warnings", ())]
    for recording in quality.get("recordings", ()):
        masked.update({reason: int(n) for reason, n in recording.get("masked", {}).items() if n})
        warnings += [f"{recording.get('source', 'a recording')}: {w}" for w in recording.get("warnings", ())]
    return dict(masked), warnings


def bridged_readings(recording: Mapping[str, Any]) -> int:
    """How many readings of a recording, of all joints, were put between good ones."""
    return sum(int(n) for n in recording.get("bridged", {}).values())
