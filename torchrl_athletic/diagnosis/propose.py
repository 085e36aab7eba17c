"""The combinations of effects that the torques speak for, to be tried in the simulation."""

from __future__ import annotations

from collections.abc import Callable, Collection, Sequence
from functools import partial

from torchrl_athletic.diagnosis.prepare import drive_signals, prepare
from torchrl_athletic.diagnosis.proposal import Proposal
from torchrl_athletic.diagnosis.screen import Bank, Candidate, Key, candidates_for, trims_for
from torchrl_athletic.diagnosis.search import Judge, Scored, keys, noisy_joints, richer, rivals, search
from torchrl_athletic.diagnosis.stages import Located, Proposed, Run
from torchrl_athletic.diagnosis.thresholds import DECISION, SEARCH, SPENDING
from torchrl_athletic.effects import TRIMS, Effect, Signals


def propose(located: Located, run: Run) -> Proposed:
    """Search combinations in the torque domain; a measured torque cuts the chain into drive and mechanics."""
    ready, given = located.ready, located.ready.given
    signals, catalogue = ready.train.signals, given.catalogue
    drive: Proposal | None = None
    cut = given.drive == "command" and all(
        s.recording.torque_semantics == "current_derived" and s.recording.torque_command is not None for s in signals
    )
    if cut:
        of_drive = [e for e in catalogue if e.between_torques]
        drive = _searched(drive_signals(ready.train), of_drive, (), run)[0]
        measured = prepare(given.recordings, given.model, "measured", signals[0].kernel, given.joined, given.xml)
        signals = measured.signals
    if cut or given.drive == "measured":  # what was measured has passed the drive's lags and limits
        catalogue = tuple(e for e in catalogue if not e.before_sensor)
    taken = keys(drive.best.fit.terms) if drive else frozenset[Key]()
    options = _searched(signals, catalogue, trims_for(signals, TRIMS), run, taken, run.progress.update)
    return Proposed(located, drive, tuple(options))


def _searched(
    signals: Sequence[Signals],
    catalogue: Sequence[Effect],
    trims: Sequence[Candidate],
    run: Run,
    taken: Collection[Key] = frozenset(),
    progress: Callable[[float], None] = lambda fraction: None,
) -> list[Proposal]:
    bank = Bank(signals, (), [t for t in trims if t.key not in taken])
    judge = Judge(bank)
    is_open = judge.is_open(judge.bare)
    if is_open.any():
        candidates = [c for c in candidates_for(signals, catalogue) if c.key not in taken]
        bank.extend(c for c in candidates if is_open[c.joint] or not c.effect.own_joint)
    late = partial(run.late, SPENDING.to_propose)
    found = search(judge, progress, late=late)
    if noisy := noisy_joints(judge):
        judge = Judge(bank, noisy)
        found = search(judge, late=late)
    return _options(judge, found, late)


def _options(judge: Judge, found: Sequence[Scored], late: Callable[[], bool] = lambda: False) -> list[Proposal]:
    """What the simulation decides about: the best combination, a richer law that it gave up, what rivals it closely.

    In a hurry nobody asks for rivals beyond what the search has found.
    """
    first, rich = found[0], richer(judge, found[0])
    out = [Proposal(judge, first)] + ([Proposal(judge, rich, 0.0, on_trial=True)] if rich is not None else [])
    near = [] if late() else [Proposal(judge, s, behind) for s, behind in rivals(judge, first, DECISION.asked)]
    near += [Proposal(judge, s, s.evidence - first.evidence) for s in found[1:]]
    for option in sorted(near, key=lambda e: e.behind):
        if all(keys(option.best.fit.terms) != keys(e.best.fit.terms) for e in out):
            out.append(option)
    return [option for option in out if option.behind <= SEARCH.decisive][: DECISION.most_fits]
