"""Which combinations are tried in the simulation, and when effects are asked about alone."""

import importlib
from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest

from torchrl_athletic.diagnosis.fit import Hypothesis
from torchrl_athletic.diagnosis.proposal import Proposal
from torchrl_athletic.diagnosis.result import Score
from torchrl_athletic.diagnosis.simulate import _asked_alone, _with_joints, key_of
from torchrl_athletic.diagnosis.stages import Simulated
from torchrl_athletic.diagnosis.thresholds import DECISION

stage = importlib.import_module("torchrl_athletic.diagnosis.simulate")


def test_combinations_are_chosen_by_the_windows_of_the_recordings_that_were_fitted(monkeypatch):
    """Those kept aside score the answer; to choose by them would make their score too good."""
    results = {"train": ("a", 0, "errors", "began"), "heldout": ("b", 1, "others", "else")}
    monkeypatch.setattr(stage, "_results", lambda fitted, ready: results)
    trial = stage.scored(None, None, None)
    assert (trial.window_errors, trial.began) == ("errors", "began")
    assert trial.scores == {"train": "a", "heldout": "b"}


class Started:
    """A diagnosis that has tried its first proposal, which leaves ``left`` of the motion; six effects may act alone."""

    def __init__(self, monkeypatch: pytest.MonkeyPatch, left: float, is_open: bool, named: bool, over: float) -> None:
        self.alone = [SimpleNamespace(fit=SimpleNamespace(terms=[k])) for k in range(6)]
        self.few = False
        """Whether none of them closes a material share of the torque."""
        self.finds: dict[int, tuple[bool, float]] = {}
        """Number of a trial -> whether the choice falls on it with a name, and what it leaves."""
        self.late = 9
        """Number of trials from which on it is late."""
        self.chosen = 0
        first = Proposal(None, SimpleNamespace(fit=SimpleNamespace(terms=[])))
        self.begun = Simulated(None, (self.trial(first, named, left, over),), (first,))  # of two, time allowed one
        monkeypatch.setattr(stage, "singles", lambda judge: ([], self.alone) if self.few else (self.alone, []))
        monkeypatch.setattr(stage, "keys", id)
        monkeypatch.setattr(stage, "open_share", lambda score: score.before)
        monkeypatch.setattr(stage, "torque_is_open", lambda trial: is_open)
        monkeypatch.setattr(stage, "decided_by", lambda trials: (self.chosen,))
        monkeypatch.setattr(stage, "_trial", self.tried)

    @staticmethod
    def trial(proposal: Proposal, named: bool, left: float, over: float) -> SimpleNamespace:
        score = Score(left, 1.0, 1.0, 0.0, {"hip": {"before": over, "after": over, "floor": 1.0}})
        fitted = SimpleNamespace(hypothesis=SimpleNamespace(terms=(None,) * named))
        return SimpleNamespace(proposal=proposal, fitted=fitted, scores={"train": score})

    def tried(self, proposal: Proposal, *_: object) -> SimpleNamespace:
        number, self.count = self.count, self.count + 1
        named, left = self.finds.get(number, (False, 0.9))
        self.chosen = number if number in self.finds else self.chosen
        return self.trial(proposal, named, left, 9.0)

    def run(self) -> Simulated:
        self.count = len(self.begun.trials)
        late, progress = lambda: self.count >= self.late, SimpleNamespace(update=lambda fraction: None)
        return _asked_alone(self.begun, SimpleNamespace(late=late, progress=progress))


@pytest.mark.parametrize(
    ("left", "is_open", "named", "over", "asked"),
    [
        (0.9, True, True, 9.0, DECISION.alone),
        (0.9, True, False, 9.0, 6),  # as long as nothing is named and most is open
        (0.9, True, False, 2.0, DECISION.alone),  # so near the floor the simulation could tell nothing of so many
        (0.3, True, True, 9.0, 0),
        (0.9, False, True, 9.0, 0),
        (0.0, False, False, 3.0, DECISION.alone),  # trims took the torque, and the motion is not followed all the same
        (0.0, False, False, 2.0, 0),
        (0.0, False, True, 3.0, 0),
    ],
)
def test_effects_are_tried_alone_where_most_of_the_motion_stays_open(monkeypatch, left, is_open, named, over, asked):
    work = Started(monkeypatch, left, is_open, named, over)
    first, *more = [t.proposal for t in work.run().trials]
    assert first is work.begun.trials[0].proposal
    assert [p.best for p in more] == work.alone[:asked]
    assert [p.on_trial for p in more] == [False] * min(DECISION.alone, asked) + [True] * (asked - DECISION.alone)
    assert all(p.alone and p.behind == DECISION.behind for p in more)


@pytest.mark.parametrize(
    ("change", "asked"),
    [
        ({"finds": {4: (True, 0.9)}}, 4),  # a name
        ({"finds": {3: (False, 0.2)}}, 4),  # adjusted numbers that explain it
        ({"finds": {4: (False, 0.9)}}, 6),
        ({"late": 3}, 2),
        ({"late": 1}, 0),
        ({"few": True}, 2),
    ],
)
def test_no_further_effect_is_tried_alone_than_it_takes(monkeypatch, change, asked):
    work = Started(monkeypatch, 0.9, True, False, 9.0)
    vars(work).update(change)
    assert len(work.run().trials) == 1 + asked


def test_what_was_proposed_before_is_not_tried_alone(monkeypatch):
    work = Started(monkeypatch, 0.9, True, False, 9.0)
    again = work.trial(Proposal(None, work.alone[0]), False, 0.9, 9.0)
    work.begun = Simulated(None, (*work.begun.trials, again))
    assert [t.proposal.best for t in work.run().trials[1:]] == work.alone


def test_ctrl_c_keeps_the_trials_that_were_made(monkeypatch):
    work = Started(monkeypatch, 0.9, True, False, 9.0)
    made = work.tried

    def stopped(proposal: Proposal, *_: object) -> SimpleNamespace:
        if work.count == 3:
            raise KeyboardInterrupt
        return made(proposal)

    monkeypatch.setattr(stage, "_trial", stopped)
    done = work.run()
    assert done.stopped
    assert [t.proposal.best for t in done.trials[1:]] == work.alone[:2]


@pytest.mark.parametrize(
    ("left", "over", "evidence", "behind"),
    [
        (0.5, 9.0, 3.0, DECISION.behind),  # it may be the names if the simulation is decisively better
        (0.01, 9.0, 3.0, np.inf),  # nothing is left to be named
        (0.5, 9.0, np.inf, np.inf),  # a number of it stops at a bound
        (0.5, 2.0, 3.0, None),  # what follows needs no other
        (0.009, 9.0, 3.0, None),  # the error has fallen to a tenth
    ],
)
def test_the_standard_joints_are_tried_where_nothing_follows(monkeypatch, left, over, evidence, behind):
    work = Started(monkeypatch, left, True, True, over)
    monkeypatch.setattr(stage, "standard_joints_of", lambda given, run: work.begun.trials[0].fitted)
    monkeypatch.setattr(stage, "in_torques", lambda judge, fitted: SimpleNamespace(evidence=evidence))
    monkeypatch.setattr(stage, "_without_small", lambda fitted, given: fitted)
    monkeypatch.setattr(stage, "scored", lambda proposal, fitted, ready: SimpleNamespace(proposal=proposal))
    located = SimpleNamespace(ready=SimpleNamespace(given=None))
    begun = replace(work.begun, proposed=SimpleNamespace(located=located, drive=None))
    added = [t.proposal for t in _with_joints(begun, SimpleNamespace(late=lambda: False)).trials[1:]]
    assert [p.behind for p in added] == ([] if behind is None else [behind])
    assert all(p.joints and p.on_trial for p in added)


def test_a_fit_in_which_a_mass_is_adjusted_is_not_taken_for_one_in_which_it_is_found():
    friction, mass = (SimpleNamespace(effect=SimpleNamespace(name=n), where="hip") for n in ("friction", "link_mass"))
    assert key_of(Hypothesis((friction, mass))) != key_of(Hypothesis((friction,), (mass,)))
