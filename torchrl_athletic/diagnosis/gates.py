"""What may be stated: findings with their rivals and probabilities, and the verdict.

A lower error proves no name. A finding is stated with the share of the evidence that it has among the effects that
could stand in its place, discounted by what stays unexplained on its joint; and every verdict, "nothing missing"
included, must pass the sensors' floor.
"""

from __future__ import annotations

from collections.abc import Collection, Mapping, Sequence
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from torchrl_athletic.diagnosis.calibration import Grounds, class_probability, probability, rival_probability, widened
from torchrl_athletic.diagnosis.compare import falls, far_joints, follows, open_share
from torchrl_athletic.diagnosis.fit import Fitted
from torchrl_athletic.diagnosis.locate import regime_of
from torchrl_athletic.diagnosis.proposal import Proposal, StandIn
from torchrl_athletic.diagnosis.result import Estimate, Finding, Location, Rival, Score, Verdict
from torchrl_athletic.diagnosis.screen import Atom, Candidate, Key
from torchrl_athletic.diagnosis.search import scatter
from torchrl_athletic.diagnosis.thresholds import SEARCH, STATEMENT
from torchrl_athletic.effects import Effect, Parameter
from torchrl_athletic.effects.effect import CLASSES

Array = NDArray[np.float64]


ANY_EXPERIMENT = "each joint alone, slowly both ways and fast, with and without a known payload"


def judge_findings(
    evidence: Sequence[Proposal],
    fitted: Fitted,
    scores: Collection[Score],
    sets: Mapping[Key, Sequence[StandIn]],
    closes: Mapping[Key, float],
    asked: Mapping[Key, float] | None = None,
) -> tuple[Finding, ...]:
    """State the terms of the fitted hypothesis, most probable first.

    Args:
        evidence: What was chosen: the mechanics, and the drive if it was looked at alone.
        fitted: The same in the simulation.
        scores: Of that fit.
        sets: Term that is stated -> who could stand in its place.
        closes: Term -> share of the error that it closes; what the simulation was not asked about is missing.
        asked: Class and joint that the motion was asked about -> share of the error that comes back without it.
    """
    still_open = max((open_share(s) for s in scores), default=1.0)
    stated = {c.key: c for c in fitted.hypothesis.terms}
    beside = [c.joint_name for c in fitted.hypothesis.terms if c.key in sets]
    above, far = _above_floor(scores), far_joints(scores)
    h = fitted.hypothesis
    senseless = {
        c.key
        for c in h.terms
        if not c.effect.is_physical(c.parameters, h.values_of(c, fitted.values)) or _is_noise(c, above)
    }
    out = [
        _finding(part, term, fitted, stated[key], sets[key], still_open, senseless, far, closes.get(key), beside, asked)
        for part in evidence
        for term in part.best.fit.terms
        if (key := term.candidate.key) in stated and key in sets
    ]
    if any(part.joints for part in evidence):
        out = one_class_of_each_joint(out)
    return tuple(sorted(out, key=_order))


def one_class_of_each_joint(findings: Sequence[Finding]) -> list[Finding]:
    """The same, where classes that the standard joints need at one joint share what is missing there.

    Each closes much beside the others: a weak gain and a low friction move a joint as the given ones do. Which of them
    the joint lacks the fit does not tell. They share by the probabilities of their laws, each no likelier than its
    share.
    """
    needed: dict[str | None, dict[str, float]] = {}
    for f in findings:
        if f.grounds["closes"] > STATEMENT.likely:
            of_joint = needed.setdefault(f.joint, {})
            of_joint[f.class_name] = of_joint.get(f.class_name, 0.0) + max(f.probability, 1e-9)
    out = []
    for f in findings:
        classes = needed.get(f.joint, {})
        if f.class_name in classes and f.class_probability > 0:
            share = classes[f.class_name] / sum(classes.values())
            held = max(f.probability, min(f.class_probability, share))
            f = replace(f, class_probability=held, law_probability=f.probability / held)
        out.append(f)
    return out


def _order(f: Finding) -> tuple[float, float, float]:
    """By whole per cent of the law, then of its class, then by what it accounts for."""
    return -round(f.probability, 2), -round(f.class_probability, 2), -f.energy_share


def refused(findings: Sequence[Finding], places: Collection[tuple[str, str | None]]) -> tuple[Finding, ...]:
    """The same, those held back that recordings kept aside refuse, most probable first.

    Args:
        findings: As stated of the fitted recordings.
        places: Effects and joints of what is taken back.
    """
    out = []
    for f in findings:
        if (f.effect, f.joint) in places:
            held = min(f.probability, STATEMENT.refused)
            f = replace(
                f,
                probability=held,
                class_probability=held,
                law_probability=1.0,
                sentence=f"{f.sentence} Recordings that were kept aside refuse it.",
                rivals=tuple(replace(r, probability=min(r.probability, held)) for r in f.rivals),
                grounds={**f.grounds, "refused": True},
            )
        out.append(f)
    return tuple(sorted(out, key=_order))


def verdict_of(
    evidence: Sequence[Proposal], findings: Sequence[Finding], train: Score | None, heldout: Score | None, is_open: bool
) -> tuple[Verdict, float]:
    """The verdict, and the share of the error energy above the floor that no finding explains."""
    deciding = [s for s in (heldout, train) if s is not None]
    if not deciding:
        return ("partly_explained" if findings else "unexplained"), float(bool(is_open))
    share, near = max(open_share(s) for s in deciding), all(follows(s, STATEMENT.near_floor) for s in deciding)
    if not findings:
        nothing = not is_open and near  # within the tolerances of the trims
        return ("nothing_missing", 0.0) if nothing else ("unexplained", share)
    torque_left = max((float(part.left().max(initial=0.0)) for part in evidence), default=0.0)
    likely = all(_of_all(f) > STATEMENT.likely and not f.grounds.get("senseless") for f in findings)
    if near and share <= STATEMENT.explained and torque_left <= 2 * STATEMENT.explained and likely:
        return "explained", share
    return ("partly_explained" if share <= STATEMENT.partly else "unexplained"), share


def _of_all(finding: Finding) -> float:
    """That a finding or one of its rivals is true."""
    return finding.probability + sum(rival.probability for rival in finding.rivals)


def summarise(
    verdict: Verdict,
    findings: Sequence[Finding],
    locations: Sequence[Location],
    score: Score | None,
    heldout: bool,
    left: float,
) -> tuple[str, ...]:
    """The answer in a few sentences, most important first.

    ``left``: share of the error energy that the corrected simulation leaves, 0..1.
    """
    out = []
    if verdict == "nothing_missing":
        out.append(_nothing_missing(score))
    elif not findings:
        out.append("The model and the robot differ, and no effect of the catalogue explains how.")
    out += [f.sentence for f in findings if f.probability > STATEMENT.likely]
    out += not_identified([f for f in findings if f.probability <= STATEMENT.likely])
    where = [x for x in locations if x.regime != "everywhere" and x.joint == locations[0].joint]
    if verdict != "nothing_missing" and locations:
        text = f"{100 * locations[0].share_of_error:.0f} % of the error arises at {locations[0].joint}"
        if where:
            words = where[0].regime
            if words.startswith(("moving", "accelerating", "slower", "faster")):
                words = f"when {words}"
            elif words.startswith(("position", "load", "command")):
                words = f"with {words}"
            text += f"; it is densest {words}"
        out.append(text + ".")
    if score is not None and findings:
        kind = "recordings kept aside" if heldout else "the fitted recordings (none were kept aside)"
        out.append(
            f"Over 0.5 s windows of {kind} the error falls to {100 * score.after / max(score.before, 1e-12):.0f} % "
            f"of what it was; the correction leaves {100 * left:.0f} % of its energy above the sensors' floor"
            f"{_with_falls(score)}."
        )
    return tuple(out)


def _with_falls(score: Score) -> str:
    """How the share of the energy is counted, where windows fall and it is no longer what the errors say."""
    return ", where a window that falls counts as a radian off, or as its motion" if falls(score) else ""


def _nothing_missing(score: Score | None) -> str:
    """That nothing is missing, and how far the model is from its floor where that is far."""
    joints = {} if score is None else score.per_joint
    times, worst = max(((e["after"] / max(e["floor"], 1e-12), name) for name, e in joints.items()), default=(0.0, ""))
    if times <= STATEMENT.at_floor:
        return "Nothing is missing: the model follows the recordings as closely as the sensors' noise allows."
    return (
        f"Nothing is missing that the torques show, within the tolerances of the model's numbers: its error at {worst} "
        f"is {times:.1f} times what the sensors' noise allows."
    )


def not_identified(findings: Sequence[Finding]) -> list[str]:
    """What fits best where no law is likely, a sentence for each class and joint, and what would identify it."""
    first: dict[tuple[str, str | None], Finding] = {}
    for f in findings:
        first.setdefault((f.class_name, f.joint), f)
    told = {place: f for k, (place, f) in enumerate(first.items()) if not k or f.class_probability >= STATEMENT.told}
    out = []
    for (kind, joint), f in told.items():
        at, law = joint or "the robot", f"{f.effect.replace('_', ' ')} fits best, at {100 * f.probability:.0f} %"
        if f.class_probability > STATEMENT.likely:
            what = CLASSES.get(kind, kind.replace("_", " "))
            sure = f"{100 * f.class_probability:.0f} %"
            out.append(f"Likely missing at {at}: {what} ({sure}). Its law is not identified; {law}.")
        else:
            out.append(f"Not identified at {at}; {law}.")
    if more := len(first) - len(told):
        out.append(f"{more} more {'has' if more == 1 else 'have'} less than {100 * STATEMENT.told:.0f} %.")
    asked = list(dict.fromkeys(r.separating_experiment for f in first.values() for r in f.rivals))
    if asked:
        out.append(f"What would identify it: {asked[0]}.")
    elif out:
        out.append(f"What would identify it: {ANY_EXPERIMENT}.")
    return out


def _finding(
    part: Proposal,
    term: Atom,
    fitted: Fitted,
    chosen: Candidate,
    rated: Sequence[StandIn],
    still_open: float,
    senseless: Collection[Key],
    far: Collection[str],
    closes: float | None,
    beside: Sequence[str | None],
    asked: Mapping[Key, float] | None,
) -> Finding:
    bank, candidate, h = part.judge.bank, term.candidate, fitted.hypothesis
    values, samples = h.values_of(chosen, fitted.values), h.values_of(chosen, fitted.samples)
    band = h.values_of(chosen, fitted.interval().T).T
    own = next(option.share for option in rated if option.atom.candidate.key == candidate.key)
    of_motion = (asked or {}).get((candidate.effect.family, candidate.joint_name))
    grounds = Grounds(
        share=own,
        left=part.left_of(candidate),
        excess=part.excess_of(candidate),
        scatter=scatter(bank, part.best.fit, term),
        open=still_open,
        energy=_energy_share(part, term),
        terms=sum(candidate.joint_name in (None, joint) for joint in beside),
        strain=part.best.fit.strain,
        sure=_certainty(chosen, values, samples),
        plain=_is_plain(chosen, values, samples),
        senseless=chosen.key in senseless,
        leans=any(c.key in senseless and c.joint_name == chosen.joint_name for c in h.terms if c.key != chosen.key),
        far=bool(far) if candidate.joint_name is None else candidate.joint_name in far,
        closes=1.0 if closes is None else closes,
        overruled=part.motion and part.backing(candidate.key) is None,
        asked=-1.0 if of_motion is None else of_motion,
    )
    likely = probability(grounds, candidate.effect.name)
    effect, joint = candidate.effect, candidate.where
    named = {p.name: float(v) for p, v in zip(candidate.parameters, values, strict=True)}
    others = [option for option in rated if option.atom.candidate.key != candidate.key]
    rivals = [
        Rival(
            option.atom.candidate.effect.name,
            option.atom.candidate.joint_name,
            rival_probability(likely, own, option.share),
            effect.experiment(option.atom.candidate.effect.name, joint),
        )
        for option in others
        if option.share > STATEMENT.least_share
    ]
    alike = sum(rival_probability(likely, own, o.share) for o in others if _is_alike(o.atom.candidate, candidate))
    of_class = likely
    if not grounds.senseless:
        of_class = class_probability(likely, likely + alike, 1.0 - still_open, closes)
        if grounds.overruled:  # what else the motion would take there has its share
            alike_share = sum(o.share for o in rated if _is_alike(o.atom.candidate, candidate))
            of_class = max(likely, min(of_class, alike_share))
    explained = bank.prediction(part.best.fit, term)
    return Finding(
        effect=effect.name,
        joint=candidate.joint_name,
        probability=likely,
        sentence=_sentence(candidate, named, grounds),
        parameters={
            p.name: Estimate(float(v), _within(p, widened(float(v), float(low), float(high))), p.unit)
            for p, v, (low, high) in zip(candidate.parameters, values, band, strict=True)
        },
        regime=regime_of(bank, explained, candidate.joint, effect.shows_in),
        rivals=tuple(rivals),
        energy_share=grounds.energy,
        grounds=grounds.to_json(),
        class_name=effect.family,
        class_probability=of_class,
        law_probability=likely / of_class if of_class > 0 else 0.0,
    )


def _is_alike(one: Candidate, other: Candidate) -> bool:
    """Whether two effects are of one class, on the same joint."""
    return one.effect.family == other.effect.family and one.joint_name == other.joint_name


def _certainty(candidate: Candidate, values: Array, samples: Array) -> float:
    """Largest distance of a parameter from the given model's, in standard deviations of the bootstrap."""
    change = np.abs(values - [p.nominal for p in candidate.parameters])
    deviation = np.maximum(samples.std(0), 1e-3 * np.array([p.scale for p in candidate.parameters]))
    return float((change / deviation).max(initial=0.0))


def _is_plain(candidate: Candidate, values: Array, samples: Array) -> bool:
    """Whether all that sets an effect apart from simpler laws may be nothing, by its intervals."""
    of = {p.name: (values[k], samples[:, k]) for k, p in enumerate(candidate.parameters)}
    given = {p.name: p.nominal for p in candidate.parameters}
    units = {p.name: p.unit for p in candidate.parameters}
    beside_it = {n: max((abs(of[m][0]) for m in of if m != n and units[m] == units[n]), default=0.0) for n in of}

    def is_seen(what: str | tuple[str, str]) -> bool:
        if isinstance(what, str):  # by the interval that is stated with it
            ends = widened(float(of[what][0]), *np.quantile(of[what][1], [0.025, 0.975]))
            low, high = np.array(ends) - given[what]
            least = STATEMENT.same_number * beside_it[what]
        else:
            (one, drawn), (other, beside) = of[what[0]], of[what[1]]
            low, high = np.quantile(drawn - beside, [0.025, 0.975])
            least = STATEMENT.same_number * max(abs(one), abs(other))
        return bool(low > least or high < -least)

    contrasts = candidate.effect.sets_apart
    return bool(contrasts) and not any(is_seen(what) for what in contrasts)


def _above_floor(scores: Collection[Score]) -> Mapping[str, float]:
    """Window error of the given model over the floor, on each joint."""
    joints = {name for s in scores for name in s.per_joint}
    errors = {name: [s.per_joint[name] for s in scores if name in s.per_joint] for name in joints}
    return {name: max(e["before"] / max(e["floor"], 1e-12) for e in of) for name, of in errors.items()}


def _is_noise(candidate: Candidate, above: Mapping[str, float]) -> bool:
    """Whether a gear gives way on a joint that the given model follows as it is.

    What a gear predicts is made of measured accelerations, so that their noise can look like a gear.
    """
    name = candidate.joint_name or ""
    return candidate.effect.of_accelerations and above.get(name, np.inf) < STATEMENT.shown


def _within(parameter: Parameter, ends: tuple[float, float]) -> tuple[float, float]:
    """An interval within the parameter's physical bounds."""
    low, high = (min(max(end, parameter.lower), parameter.upper) for end in ends)
    return low, high


def _sentence(candidate: Candidate, named: Mapping[str, float], grounds: Grounds) -> str:
    effect, joint = candidate.effect, candidate.where
    if grounds.scatter > SEARCH.invariant:
        return _stand_in(effect, joint)
    said = effect.sentence(joint, named, candidate.parameters)
    if grounds.senseless:
        return f"{said} No robot is likely to have that: it stands in for something else."
    if grounds.plain:
        return f"{said} Of what makes it more than a simpler law nothing is seen."
    if grounds.closes < STATEMENT.likely:
        share = f"{100 * grounds.closes:.0f} % of the simulation's error"
        return f"{said} It closes only {share}: it may stand in for something else."
    return (
        f"{said} With it the simulation is still far from the recordings: some law is another, perhaps this one."
        if grounds.far
        else said
    )


def _stand_in(effect: Effect, joint: str) -> str:
    words = effect.name.replace("_", " ")
    return (
        f"No effect of the catalogue holds on all recordings of {joint}; {words} fits best, with another strength "
        "on each, so it stands in for something else."
    )


def _energy_share(part: Proposal, term: Atom) -> float:
    """Share of the joint's missing torque that comes back when the term is taken away."""
    joint = term.candidate.joint
    without = part.judge.bank.fit([a for a in part.best.fit.terms if a is not term])
    before, rest, left = (float(fit.residual[joint].sum()) for fit in (part.judge.bare, without, part.best.fit))
    gained = rest - left
    return float(np.clip(gained / max(before, 1e-12), 0.0, 1.0))
