"""Which of the combinations that were simulated is the answer, and who could stand in its place."""

from __future__ import annotations

from collections.abc import Collection, Sequence
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from torchrl_athletic.diagnosis.compare import falls, open_share, within_reach
from torchrl_athletic.diagnosis.proposal import Proposal, answer_set
from torchrl_athletic.diagnosis.result import Score
from torchrl_athletic.diagnosis.screen import Key
from torchrl_athletic.diagnosis.search import Scored, keys
from torchrl_athletic.diagnosis.stages import Decided, Simulated, Trial
from torchrl_athletic.diagnosis.thresholds import DECISION, SEARCH

Array = NDArray[np.float64]


def decide(simulated: Simulated) -> Decided:
    """Choose a trial by torques and simulation together; recordings kept aside have no part in it."""
    located, drive, trials = simulated.proposed.located, simulated.proposed.drive, simulated.trials
    if not trials:
        return Decided(located, drive)
    spoken_for, against, taken = decided_by(trials)
    chosen = fewest(spoken_for, trials)
    combinations = [(t, a) for t, a in zip(trials, against, strict=True) if not t.proposal.by_simulation]
    told = {keys(t.proposal.best.fit.terms): float(a) for t, a in combinations}
    needed = [needed_by(t) if ok else frozenset[Key]() for t, ok in zip(trials, taken, strict=True)]
    options = (*(t.proposal for t in trials), *simulated.untried)

    def compared(k: int) -> Proposal:
        return replace(trials[k].proposal, simulated=told, others=others_than(k, options, needed))

    proposal = compared(chosen)
    if proposal.motion:
        of_torques = [k for k, t in enumerate(trials) if not t.proposal.by_simulation]
        best = decided_by([trials[k] for k in of_torques])[0]
        proposal = replace(proposal, torques=compared(of_torques[best]))
    trial = replace(trials[chosen], proposal=proposal)
    beside = tuple(
        t for k, t in enumerate(trials) if (t.proposal.by_simulation or k in (0, spoken_for)) and k != chosen
    )
    decided = Decided(located, drive, trial, beside, torque_is_open(trial), simulated.asked)
    stated = {c.key for c in trial.fitted.hypothesis.terms}
    if trial.proposal.joints:  # of all numbers of all joints, those that the motion asks for
        stated = {key for key in stated if trial.closes.get(key, 1.0) >= DECISION.asked_for}
    sets = {
        term.candidate.key: answer_set(part, term)
        for part in decided.evidence
        for term in part.best.fit.terms
        if term.candidate.key in stated
    }
    return replace(decided, sets=sets)


def fewest(spoken_for: int, trials: Sequence[Trial]) -> int:
    """What the motion asks for, one after the other, in place of what torques and simulation speak for.

    Of many effects, each offered to the motion, most only stand in. Few take their place that have names and close a
    good part of what those close, though more of them follow better. What holds something that was not offered stays,
    and of a model that falls what follows much better: there either closes nearly all.

    Args:
        spoken_for: Which trial torques and simulation speak for.
        trials: All of them.
    """
    motion = next((k for k, t in enumerate(trials) if t.proposal.motion), spoken_for)
    if motion == spoken_for:
        return spoken_for
    few, many = trials[motion], trials[spoken_for]
    closed = [1.0 - open_share(t.scores["train"]) for t in (few, many)]
    named = {c.key for c in few.fitted.hypothesis.terms} & keys(few.proposal.best.fit.terms)
    offered = all(c.key in few.proposal.offered for c in many.fitted.hypothesis.terms)
    good = closed[0] > 0.0 and closed[0] >= DECISION.few * closed[1]
    near = not falls(few.scores["train"]) or _follows_alike(few.scores["train"], many.scores["train"])
    return motion if named and offered and good and near else spoken_for


def _follows_alike(one: Score, other: Score) -> bool:
    """Whether the error of the one, of all joints in units of their floors, is within a few times the other's."""
    pairs = [(one.per_joint[name], joint) for name, joint in other.per_joint.items()]
    floors = np.maximum([max(a["floor"], b["floor"]) for a, b in pairs], 1e-12)
    errors = [np.array([within_reach(joint, "after") for joint in joints]) for joints in zip(*pairs, strict=True)]
    mine, others = (float(np.mean(np.maximum(error / floors, 1.0) ** 2)) for error in errors)
    return mine <= DECISION.follows**2 * others


def torque_is_open(trial: Trial) -> bool:
    """Whether some joint misses torque that noise does not explain, with all numbers within their tolerances."""
    proposal, small = trial.proposal, {c.key for c in trial.fitted.hypothesis.trims}
    within = [a for a in proposal.best.fit.terms if a.candidate.key in small]
    return bool(proposal.judge.is_open(proposal.judge.score(within).fit).any())


def needed_by(trial: Trial) -> frozenset[Key]:
    """Terms of its combination that the simulation needs, as small as they may be."""
    h, terms = trial.fitted.hypothesis, [a.candidate for a in trial.proposal.best.fit.terms]
    return frozenset(c.key for c in (*h.terms, *h.trims) if c in terms)


def decided_by(trials: Sequence[Trial]) -> tuple[int, Array, list[bool]]:
    """Which trial torques and simulation speak for, what the simulation says against each, and which are not refuted.

    ``trials``: the preferred one first.
    """
    errors, options = [t.window_errors for t in trials], [t.proposal for t in trials]
    scores, began = [t.scores["train"] for t in trials], trials[0].began
    floors = [np.maximum([joint["floor"] for joint in s.per_joint.values()], 1e-12) for s in scores]
    logs = [np.log(np.maximum(e, floor)).sum(1) for e, floor in zip(errors, floors, strict=True)]
    left = [open_share(s) for s in scores]
    taken = [
        bool(np.isfinite(option.behind))
        and (
            not option.on_trial or (_against(logs[0] - e) >= SEARCH.decisive and share <= (1 - SEARCH.richer) * left[0])
        )
        for option, e, share in zip(options, logs, left, strict=True)
    ]
    least = min((k for k, t in enumerate(taken) if t), key=lambda k: left[k])
    if left[least] <= DECISION.clear:  # a stop that is reached twice says nothing in the mean of all windows
        for k, error in enumerate(errors):
            floor = np.maximum(floors[k], floors[least])
            if left[k] >= DECISION.lost and _misses(error, errors[least], floor, began):
                taken[k] = False
    best = min((e for e, t in zip(logs, taken, strict=True) if t), key=lambda e: float(e.mean()))
    against = np.array([_against(e - best) if t else SEARCH.decisive for e, t in zip(logs, taken, strict=True)])
    behind = np.array([o.behind if t else np.inf for o, t in zip(options, taken, strict=True)])
    return int(np.argmin(against + behind)), against, taken


def others_than(own: int, options: Sequence[Proposal], needed: Sequence[Collection[Key]]) -> tuple[Scored, ...]:
    """Combinations beside one of them that are not refuted, and of which the simulation needs what is new.

    For effects that were asked about alone only the simulation speaks, and it has decided. So it has for what
    it has chosen itself.

    Args:
        options: All of them.
        needed: Terms that the simulation needs, as small as they may be, of each that was fitted; none of those that it
            refutes.
        own: Number of the one.
    """
    found = keys(options[own].best.fit.terms)
    if options[own].alone:
        return ()
    return tuple(
        o.best
        for k, o in enumerate(options)
        if k != own
        and not (o.alone or o.by_simulation)
        and (k >= len(needed) or keys(o.best.fit.terms) - found <= set(needed[k]))
    )


def _misses(worse: Array, better: Array, floor: Array, began: Array) -> bool:
    """Whether the one misses some joint on two occasions or more, the other follows there, and nowhere the reverse.

    Args:
        worse: Error of each window. Shape (W, J).
        better: The same of the other option.
        floor: Of the error, shape (J,).
        began: When each window starts [s]. Shape (W,).
    """
    if (better > DECISION.follows * np.maximum(worse, floor)).any():
        return False
    lost = (worse > DECISION.follows * np.maximum(better, floor)) & (better <= DECISION.follows * floor)
    return any((np.diff(began[joint]) > DECISION.occasions).any() for joint in lost.T)


def _against(worse: Array) -> float:
    """Twice the log odds against a combination whose windows have larger log errors.

    The square of their paired z-score, beyond the few per cent by which optimisers that stop sooner differ.
    """
    error = float(worse.std() / np.sqrt(max(len(worse), 1)))
    beyond = max(float(worse.mean()) - DECISION.equally_good, 0.0)
    return float(np.clip((beyond / error) ** 2, 0.0, SEARCH.decisive)) if error > 0 else 0.0
