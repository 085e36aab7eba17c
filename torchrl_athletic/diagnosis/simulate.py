"""The proposed combinations, fitted and scored in the simulation; and others, where these leave most of the motion."""

from __future__ import annotations

import hashlib
from collections.abc import Collection, Mapping, Sequence
from dataclasses import replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from torchrl_athletic.diagnosis.coarse import coarse, fit_in_steps_of
from torchrl_athletic.diagnosis.compare import follows, open_share, score, well_started
from torchrl_athletic.diagnosis.decide import decided_by, fewest, torque_is_open
from torchrl_athletic.diagnosis.fit import (
    Fitted,
    Hypothesis,
    as_trims,
    draw_windows,
    idle_terms,
    set_back_together,
    shares_closed,
    without,
)
from torchrl_athletic.diagnosis.joints import (
    as_chosen,
    asked_of_motion,
    in_torques,
    rivals_in_torques,
    standard_joints_of,
)
from torchrl_athletic.diagnosis.proposal import Proposal
from torchrl_athletic.diagnosis.replay import Take, follow_targets
from torchrl_athletic.diagnosis.result import Score
from torchrl_athletic.diagnosis.screen import Candidate, Key, is_trim, trims_for
from torchrl_athletic.diagnosis.search import keys, singles
from torchrl_athletic.diagnosis.stages import Given, Proposed, Ready, Run, Simulated, Trial
from torchrl_athletic.diagnosis.thresholds import DECISION, SIMULATION, SPENDING, STATEMENT
from torchrl_athletic.effects import FIT_TRIMS, TRIMS

Array = NDArray[np.float64]


def simulate(proposed: Proposed, run: Run) -> Simulated:
    """Fit and score what was proposed, and more where that leaves most of the motion; Ctrl-C keeps what there is."""
    done = Simulated(proposed, untried=proposed.options)
    done = _with_joints(_with_motion(_tried_all(done, run, SPENDING.to_try), run), run)
    return _asked_alone(_explained(_tried_all(done, run)), run)


def _tried_all(done: Simulated, run: Run, share: float = SPENDING.to_fit) -> Simulated:
    """Try what is not tried yet until a share of the time is spent, and one combination in any case."""
    count = len(done.trials) + len(done.untried)
    while done.untried and not done.stopped and not (done.trials and run.late(share)):
        try:
            trial = _trial(done.untried[0], done.proposed, run)
        except KeyboardInterrupt:
            return replace(done, stopped=True)
        done = replace(done, trials=(*done.trials, trial), untried=done.untried[1:])
        run.progress.update(len(done.trials) / count)
    return done


def _with_motion(done: Simulated, run: Run) -> Simulated:
    """Add what the motion asks for, one effect after the other, where no combination closes nearly all of the error.

    It is chosen where the simulation is decisively better with it than with what the torques speak for most, or where
    :func:`~torchrl_athletic.diagnosis.decide.fewest` prefers its few names. A single joint's
    torques are its own, so that they say more than its motion.
    """
    if not _asks_motion(done, run):
        return done
    ready, judge = done.proposed.located.ready, done.trials[0].proposal.judge
    try:
        asked = asked_of_motion(ready, run, [t.fitted for t in done.trials])
        done = replace(done, asked=asked.classes if asked.complete else None)
        if not asked.fitted.hypothesis.terms:
            return done
        best, rivals = as_chosen(judge, asked.fitted), rivals_in_torques(judge, asked)
        offered = frozenset(c.key for c in asked.offered) if asked.complete else frozenset()
        proposal = Proposal(judge, best, DECISION.behind, on_trial=True, motion=True, rivals=rivals, offered=offered)
        trial = scored(proposal, _without_small(asked.fitted, ready.given), ready)
    except KeyboardInterrupt:
        return replace(done, stopped=True)
    return replace(done, trials=(*done.trials, trial))


def _asks_motion(done: Simulated, run: Run) -> bool:
    """Whether several joints are neither followed nor nearly all of their error closed, by no more effects than joints.

    What falls without one of its frictions leaves so much error that many effects close nearly all of it.
    """
    if not _is_asked(done, run) or (joints := len(done.proposed.located.ready.given.joint_names)) < 2:
        return False
    best = done.trials[decided_by(done.trials)[0]]
    return len(best.fitted.hypothesis.terms) > joints or _asks_simulation(done, run)


def _asks_simulation(done: Simulated, run: Run) -> bool:
    """Whether the torques' combinations neither follow the recordings nor close nearly all of the error.

    Of those kept aside too: what is asked then may take longer than all else.
    """
    if not _is_asked(done, run):
        return False
    best = done.trials[decided_by(done.trials)[0]]
    return max(open_share(score) for score in best.scores.values()) >= DECISION.closed


def _is_asked(done: Simulated, run: Run) -> bool:
    """Whether there is time and no combination follows the recordings.

    Where a measured torque cuts the chain in two nothing is asked, which knows of no cut.
    """
    if not done.trials or done.stopped or run.late() or done.proposed.drive is not None:
        return False
    return not follows(done.trials[decided_by(done.trials)[0]].scores["train"], DECISION.follows)


def _with_joints(done: Simulated, run: Run) -> Simulated:
    """Add the fit of the standard joints, which folds of the recordings made.

    The simulation has to be decisively better with it, since it holds most simple laws as special cases. It gives no
    names where another combination explains the error, nor at joints of which a number stops at a bound, nor where the
    motion asks for something, one after the other.
    """
    if not _asks_simulation(done, run):
        return done
    ready, best = done.proposed.located.ready, done.trials[decided_by(done.trials)[0]]
    judge = done.trials[0].proposal.judge
    try:
        fitted = standard_joints_of(ready.given, run)
        if fitted is None:
            return done
        torques = in_torques(judge, fitted)
        asked = any(t.proposal.motion and t.proposal.offered for t in done.trials)
        names = open_share(best.scores["train"]) > STATEMENT.explained and bool(torques.fit.terms) and not asked
        proposal = Proposal(judge, torques, DECISION.behind if names else np.inf, on_trial=True, joints=True)
        trial = scored(proposal, _without_small(fitted, ready.given), ready)
    except KeyboardInterrupt:
        return replace(done, stopped=True)
    return replace(done, trials=(*done.trials, trial))


def _explained(done: Simulated) -> Simulated:
    """Take the names of the standard joints back where a combination explains the error that was tried after them."""
    others = [t for t in done.trials if not t.proposal.joints]
    if len(others) == len(done.trials):
        return done
    if open_share(others[decided_by(others)[0]].scores["train"]) > STATEMENT.explained:
        return done
    nameless = [
        replace(t, proposal=replace(t.proposal, behind=np.inf)) if t.proposal.joints else t for t in done.trials
    ]
    return replace(done, trials=tuple(nameless))


def _asked_alone(done: Simulated, run: Run) -> Simulated:
    """Where what fits the torques best leaves most of the motion open, each effect alone.

    A combination may mimic the torques of a joint that sticks, and move otherwise. And trims that take all of a
    small effect's torque for their own, since each is within its tolerance, may not move like it.

    What closes most of the torque comes first. The others that close a material share follow as long as nothing is
    named and most stays open; of so many, one may look better by chance or stand in, so that more is asked of them.
    """

    def asked(done: Simulated, proposals: Sequence[Proposal]) -> Simulated:
        return _tried_all(replace(done, untried=tuple(proposals)), run)

    if not done.trials or done.stopped or run.late() or not (_is_lost(done) or _is_unnamed(done)):
        return done
    judge = done.trials[0].proposal.judge
    known = {keys(p.best.fit.terms) for p in (*(t.proposal for t in done.trials), *done.untried)}
    material, others = singles(judge)
    alone = [s for s in material or others if keys(s.fit.terms) not in known]
    done = asked(done, [Proposal(judge, s, DECISION.behind, alone=True) for s in alone[: DECISION.alone]])
    later = [
        Proposal(judge, s, DECISION.behind, on_trial=True, alone=True) for s in alone[DECISION.alone :] if material
    ]
    while later and not done.stopped and _is_lost(done) and _is_unnamed(done) and not run.late():
        done = asked(done, later[: DECISION.alone])
        later = later[DECISION.alone :]
    return done


def _is_lost(done: Simulated) -> bool:
    """Whether most of the motion is still open, and torque that noise does not explain."""
    trial = done.trials[fewest(decided_by(done.trials)[0], done.trials)]
    return open_share(trial.scores["train"]) >= DECISION.lost and torque_is_open(trial)


def _is_unnamed(done: Simulated) -> bool:
    """Whether nothing is named and the simulation does not follow."""
    trial = done.trials[fewest(decided_by(done.trials)[0], done.trials)]
    return not trial.fitted.hypothesis.terms and not follows(trial.scores["train"], DECISION.follows)


def _trial(proposal: Proposal, proposed: Proposed, run: Run) -> Trial:
    """Fit a combination beside the trims that may move in all fits alike, and score it."""
    ready, drive = proposed.located.ready, proposed.drive
    given = ready.given
    adjusted = set().union(*map(_adjusted, proposed.options))
    hypothesis, start = _hypothesis(proposal, drive, adjusted)

    def compute() -> Fitted:
        return fit_in_steps_of(_in_long_steps(ready, hypothesis, start), hypothesis, start, given.rng)

    def decode(content: dict[str, Any]) -> Fitted:
        samples = np.array(content["samples"]).reshape(len(content["samples"]), len(content["values"]))
        return Fitted(hypothesis, np.array(content["values"]), samples, content["cost"])

    fitted = run.checkpoint.result(key_of(hypothesis, start), compute, _encode, decode)
    direct = keys(drive.best.fit.terms) if drive else ()  # two channels show it
    takes = tuple(_in_long_steps(ready, hypothesis, fitted.values))
    idle = [c for c in idle_terms(fitted, takes, given.rng("idle")) if c.key not in direct]
    return scored(proposal, _without_small(without(fitted, idle), given), ready)


def _in_long_steps(ready: Ready, h: Hypothesis, values: Array) -> Mapping[Take, Take]:
    """Copies of the fitted recordings -> these: of an arm that follows targets, which each step asks, in fewer steps.

    But not of gears, whose teeth meet within a step.
    """
    takes = ready.train.takes
    if not follow_targets(takes) or any(c.effect.of_accelerations for c in h.terms):
        return {take: take for take in takes}
    return coarse(takes, h, [values], ready.given.rng("coarse"))


def _without_small(fitted: Fitted, given: Given) -> Fitted:
    """Turn what is too small for a finding into a trim of the same fit."""
    h, period = fitted.hypothesis, max(1.0 / r.rate for r in given.recordings)
    small = [t for t in h.terms if is_trim(t, h.values_of(t, fitted.values), period, len(given.joint_names))]
    return as_trims(fitted, small)


def scored(proposal: Proposal, fitted: Fitted, ready: Ready) -> Trial:
    """A fit with its errors; to choose by them, the windows of the fitted recordings are kept."""
    results = _results(fitted, ready)
    train, _, errors, began = results["train"]  # what was kept aside scores the answer, it does not choose it
    closes = _closes(fitted, train, ready) if np.isfinite(proposal.behind) else {}
    return Trial(proposal, fitted, {split: r[0] for split, r in results.items()}, errors, began, closes)


def _closes(fitted: Fitted, score: Score, ready: Ready) -> dict[Key, float]:
    """What each term closes down to what counts as followed, over windows that start as those of the score do."""
    floor = np.array([joint["floor"] for joint in score.per_joint.values()])
    most = min(SIMULATION.windows, SIMULATION.weighed // (len(set_back_together(fitted.hypothesis)) + 1))
    drawn = draw_windows(ready.train.takes, SIMULATION.window, most, ready.given.rng("closes"))
    return shares_closed(fitted, [well_started(w) for w in drawn], DECISION.follows * np.maximum(floor, 1e-12))


def scores_of(fitted: Fitted, ready: Ready) -> dict[str, Score]:
    """Errors of a fit, of 'train' and 'heldout'."""
    return {split: r[0] for split, r in _results(fitted, ready).items()}


def _results(fitted: Fitted, ready: Ready) -> dict[str, tuple[Score, Array, Array, Array]]:
    rng, h, x = ready.given.rng, fitted.hypothesis, fitted.values
    return {
        split: score(p.takes, h, x, p.position_noise, rng(split), p.repeatability)
        for split, p in ready.splits().items()
    }


def _hypothesis(option: Proposal, drive: Proposal | None, adjusted: Collection[Key]) -> tuple[Hypothesis, Array]:
    """Terms of the mechanics and of the drive, with the values that the torque domain gave them.

    What the two torque channels say of the drive is direct; the simulation may move it by a tenth only.

    Args:
        option: The mechanics.
        drive: The drive, if it was looked at alone.
        adjusted: Trims that may move: the same for all options, which are compared.
    """
    terms, start = [], []
    if drive is not None:
        for atom, values in zip(drive.best.fit.terms, drive.best.fit.values(), strict=False):
            narrow = tuple(
                replace(p, lower=max(p.lower, v - 0.1 * abs(v)), upper=min(p.upper, v + 0.1 * abs(v) + 1e-9))
                for p, v in zip(atom.candidate.parameters, values, strict=True)
            )
            terms.append(replace(atom.candidate, parameters=narrow))
            start.append(values)
    fitted = option.best.fit
    found = fitted.values()
    terms += [a.candidate for a in fitted.terms]
    start += found[: fitted.size]
    known = {a.candidate.key: v for a, v in zip(fitted.atoms, found, strict=True)}
    trims = [
        t
        for t in trims_for(option.judge.bank.takes, FIT_TRIMS)
        if t.key in adjusted and all(t.moves_beside(c) for c in terms)
    ]
    start += [known.get(t.key, np.array([p.nominal for p in t.parameters])) for t in trims]
    return Hypothesis(tuple(terms), tuple(trims)), np.concatenate(start) if start else np.zeros(0)


def _adjusted(option: Proposal) -> set[Key]:
    """Trims that the torque domain asked for, and those that it was not asked about."""
    fitted = option.best.fit
    known = {a.candidate.key: v for a, v in zip(fitted.atoms, fitted.values(), strict=True)}
    return {t.key for t in trims_for(option.judge.bank.takes, FIT_TRIMS) if _moved(t, known.get(t.key))}


def _moved(trim: Candidate, value: Array | None) -> bool:
    """Whether the torque domain asked for a trim; one that it was not asked about may move in the simulation."""
    if value is None:
        return trim.effect not in TRIMS
    reach = np.array([p.upper - p.nominal for p in trim.parameters])
    return bool((np.abs(value - [p.nominal for p in trim.parameters]) > DECISION.worth * reach).any())


def key_of(hypothesis: Hypothesis, start: Array) -> str:
    """Key of a fit in the checkpoint; a mass that is found and one that is adjusted have other bounds.

    A search that was hurried starts it elsewhere.
    """
    terms, trims = ([f"{c.effect.name}/{c.where}" for c in part] for part in (hypothesis.terms, hypothesis.trims))
    begun = hashlib.sha256(np.concatenate([*hypothesis.bounds, start]).tobytes()).hexdigest()
    return " ".join(["fit", *terms, "|", *trims, "|", begun[:12]])


def _encode(fitted: Fitted) -> dict[str, Any]:
    return {"values": fitted.values.tolist(), "samples": fitted.samples.tolist(), "cost": fitted.cost}
