"""What a diagnosis says: findings, verdict and the corrected simulation."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from torchrl_athletic.diagnosis.compare import harms, open_share, uncorrected
from torchrl_athletic.diagnosis.corrected import Simulation
from torchrl_athletic.diagnosis.fit import Fitted, Hypothesis, without
from torchrl_athletic.diagnosis.gates import judge_findings, refused, summarise, verdict_of
from torchrl_athletic.diagnosis.identities import with_alternatives
from torchrl_athletic.diagnosis.locate import regime_maps
from torchrl_athletic.diagnosis.prepare import PAYLOAD
from torchrl_athletic.diagnosis.remainder import remarks_on
from torchrl_athletic.diagnosis.result import Answer, Finding, RegimeMap, Score, Verdict
from torchrl_athletic.diagnosis.screen import Candidate, Key
from torchrl_athletic.diagnosis.search import keys
from torchrl_athletic.diagnosis.simulate import scores_of
from torchrl_athletic.diagnosis.stages import Decided, Given, Ready, Trial
from torchrl_athletic.diagnosis.thresholds import STATEMENT
from torchrl_athletic.diagnosis.veto import NOISE, WORSE, veto_sentence, vetoed
from torchrl_athletic.effects.effect import is_slide
from torchrl_athletic.recordings import Recording

Array = NDArray[np.float64]


@dataclass(frozen=True, eq=False)
class Stated:
    """The answer, with the two simulations that it compares."""

    decided: Decided
    answer: Answer
    nominal: Simulation
    corrected: Simulation
    maps: tuple[RegimeMap, ...]


@dataclass(frozen=True, eq=False)
class Correction:
    """What the corrected simulation has, and how well it follows."""

    fitted: Fitted | None
    """None for the given model."""
    scores: Mapping[str, Score]
    sentences: tuple[str, ...] = ()
    """What of the names it has not, and why."""
    taken_back: tuple[Candidate, ...] = ()
    """What recordings kept aside refuse."""


def state(decided: Decided, stopped_in: str = "") -> Stated:
    """Findings and verdict of what was decided, and the correction that recordings kept aside do not refuse.

    Args:
        decided: What there is.
        stopped_in: Stage that Ctrl-C stopped.
    """
    ready, trial = decided.located.ready, decided.trial
    given, scores = ready.given, trial.scores if trial else {}
    findings = _findings(decided)
    verdict, share = _verdict(decided, findings)
    correction, own = Correction(None, {split: uncorrected(score) for split, score in scores.items()}), False
    helpful = [t for t in decided.beside if t.scores["train"].after < t.scores["train"].before]
    if trial is not None and not harms(trial.scores["train"]):
        helpful = [trial, *helpful]
    harmful = trial is not None and not helpful
    if trial is not None and helpful and verdict != "nothing_missing":
        followed = _best_followed(trial, helpful)
        correction, own = _kept(followed, ready), followed.fitted is trial.fitted
        if correction.taken_back and own:
            findings = refused(findings, {(c.effect.name, c.joint_name) for c in correction.taken_back})
            verdict, share = _verdict(decided, findings)
    nominal = as_given(given)
    corrected = nominal
    if correction.fitted is not None:
        corrected = replace(nominal, hypothesis=correction.fitted.hypothesis, values=correction.fitted.values)
    scores = correction.scores
    last = None if harmful else scores.get("heldout", scores.get("train"))
    left = max((open_share(score) for score in scores.values()), default=share)  # by the correction, not by the names
    summary = summarise(verdict, findings, decided.located.locations, last, "heldout" in scores, left)
    if harmful:
        summary += ("What fits best makes the simulation worse, so that the corrected model is the given one.",)
    summary += correction.sentences
    if own and correction.fitted is not None:
        summary += _nameless(correction.fitted, findings)
    if stopped_in and trial is None:
        summary = ("Stopped before anything was named; where the error is stands below.",)
    summary += tuple(
        f"{joint} hardly moves, so that nothing is known of it."
        for joint, used in ready.train.used_share().items()
        if used < STATEMENT.exercised
    )
    answer = Answer(
        verdict=verdict,
        summary=summary,
        findings=findings,
        locations=decided.located.locations,
        fit=scores,
        unexplained_share=share,
        quality=_quality(ready),
        model=given.name,
        complete=not stopped_in,
        stage=stopped_in or "deliver",
        seed=given.seed,
        inputs=given.inputs,
        remarks=() if stopped_in else _remarks(decided, corrected),
    )
    return Stated(decided, answer, nominal, corrected, tuple(_maps(decided)))


def _findings(decided: Decided) -> tuple[Finding, ...]:
    ready, trial = decided.located.ready, decided.trial
    if trial is None:
        return ()
    given = ready.given
    findings = judge_findings(
        decided.evidence, trial.fitted, trial.scores.values(), decided.sets, _closes(decided, trial), decided.asked
    )
    applying = [e for e in given.catalogue if all(e.applies(s) for s in ready.train.signals)]
    return with_alternatives(findings, given.joint_names, applying, _damped(given.recordings))


def _verdict(decided: Decided, findings: Sequence[Finding]) -> tuple[Verdict, float]:
    """Of what was decided; where it needs numbers that have no name, something is missing."""
    trial = decided.trial
    scores: Mapping[str, Score] = trial.scores if trial else {}
    needed = trial is not None and bool(trial.fitted.hypothesis.terms)
    return verdict_of(decided.evidence, findings, scores.get("train"), scores.get("heldout"), decided.is_open or needed)


def _nameless(fitted: Fitted, findings: Sequence[Finding]) -> tuple[str, ...]:
    """Where the corrected simulation has numbers that are no findings, in a sentence."""
    named = {(f.effect, f.joint) for f in findings}
    where = dict.fromkeys(c.where for c in fitted.hypothesis.terms if c.key not in named)
    if not where:
        return ()
    return (f"The corrected simulation also has fitted numbers at {', '.join(where)} that are no findings.",)


def _closes(decided: Decided, trial: Trial) -> dict[Key, float]:
    """Share of the error that each term closes; what two torque channels show of a drive asks no simulation."""
    direct = keys(decided.drive.best.fit.terms) if decided.drive else frozenset()
    return {key: share for key, share in trial.closes.items() if key not in direct}


def _best_followed(trial: Trial, helpful: Sequence[Trial]) -> Correction:
    """The chosen trial, or another that helps and with which recordings that were kept aside are followed better.

    The names stay.
    """
    split = "heldout" if "heldout" in trial.scores else "train"
    best = min(helpful, key=lambda t: t.scores[split].after)
    own, other, helps = trial.scores[split], best.scores[split], trial in helpful
    if helps and own.after <= max(WORSE * other.after, NOISE * own.floor):
        return Correction(trial.fitted, trial.scores)
    of = best.proposal
    what = "the standard joints" if of.joints else "what the torques alone speak for"
    what = "what the motion asks for" if of.motion else what
    kind = "recordings that were kept aside" if split == "heldout" else "the fitted recordings"
    followed = f": {kind} are followed with {100 * other.after / own.after:.0f} % of the error"
    why = followed if helps else ", which makes the fitted recordings worse"
    said = f"The corrected simulation has {what} instead of what is named{why}."
    return Correction(best.fitted, best.scores, (said,))


def _kept(correction: Correction, ready: Ready) -> Correction:
    """Take back what makes a joint worse on recordings that were kept aside."""
    given, fitted, scores = ready.given, correction.fitted, correction.scores
    if ready.held is None or "heldout" not in scores or fitted is None:
        return correction
    floor = np.array([joint["floor"] for joint in scores["heldout"].per_joint.values()])
    gone = vetoed(fitted.hypothesis, fitted.values, ready.held.takes, given.rng("heldout"), floor)
    if not gone:
        return correction
    fitted = without(fitted, gone)
    said = (*correction.sentences, veto_sentence(gone, given.joint_names))
    return Correction(fitted, scores_of(fitted, ready), said, gone)


def as_given(given: Given) -> Simulation:
    """The given model."""
    return Simulation(given.model, given.joint_names, Hypothesis(()), np.zeros(0), given.base)


def _quality(ready: Ready) -> dict[str, Any]:
    s = ready.train.signals[0]
    units = {n: "m" if is_slide(s.nominal, s.address, j) else "rad" for j, n in enumerate(s.recording.joint_names)}
    report = ready.train.report()
    if ready.held is not None:
        report["recordings"] += ready.held.report()["recordings"]
    changes = model_changes((*ready.given.recordings, *ready.given.heldout))
    return {
        **report,
        "units": units,
        "drive": ready.given.drive,
        "model_changes": changes,
        "column_doubts": [*ready.doubts],
        "warnings": [*ready.given.warnings],
    }


def model_changes(recordings: Sequence[Recording]) -> list[str]:
    """What the recordings' own metadata changes of the given model, in sentences."""
    carried: dict[float, list[str]] = {}
    for r in recordings:
        if mass := float(r.metadata.get(PAYLOAD, 0.0)):
            carried.setdefault(mass, []).append(Path(r.source).name)
    return [
        f"The metadata of {', '.join(names)} say {PAYLOAD}: in {'its' if len(names) == 1 else 'their'} simulations "
        f"{mass:g} kg hang on the far end of the last link."
        for mass, names in carried.items()
    ]


def _remarks(decided: Decided, corrected: Simulation) -> tuple[str, ...]:
    ready = decided.located.ready
    left: tuple[str, ...] = ()
    if decided.trial is not None and decided.drive is None:
        signals = ready.train.signals
        heldout = ready.held.signals if ready.held else ()
        left = remarks_on(signals, heldout, decided.trial.proposal.best, 0.133 / signals[0].kernel)
    return left + _trimmed(corrected)


def _maps(decided: Decided) -> list[RegimeMap]:
    """Missing torque before and after what was decided."""
    rng = decided.located.ready.given.rng("maps")
    if decided.trial is None:
        bank = decided.located.bank
        return regime_maps(bank, bank.target, rng)
    part = decided.trial.proposal
    return regime_maps(part.judge.bank, part.judge.bank.rows(part.best.fit), rng)


def _trimmed(corrected: Simulation) -> tuple[str, ...]:
    """Which of the given numbers were adjusted within their tolerance beside the findings."""
    h = corrected.hypothesis
    changes = []
    for trim in h.trims:
        for p, value in zip(trim.parameters, h.values_of(trim, corrected.values), strict=True):
            words = f"{trim.effect.name.replace('_', ' ')} of {trim.where}"
            if p.nominal and abs(value / p.nominal - 1) >= 0.01:
                changes.append(f"{words} {100 * (value / p.nominal - 1):+.0f} %")
            elif not p.nominal and abs(value) >= 0.1 * p.upper:
                changes.append(f"{words} {p.name} {value:+.2g} {p.unit}")
    if not changes:
        return ()
    return (f"Beside the findings the corrected model was adjusted within its tolerances: {', '.join(changes)}.",)


def _damped(recordings: Sequence[Recording]) -> list[str]:
    """Joints that follow their targets with one kd, above zero, in all recordings."""
    gains = [r.kd for r in recordings if r.kd is not None]
    if len(gains) < len(recordings):
        return []
    alike = (np.min(gains, axis=0) > 0) & (np.ptp(gains, axis=0) == 0)
    return [name for name, same in zip(recordings[0].joint_names, alike, strict=True) if same]
