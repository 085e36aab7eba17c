"""Which combinations are tried in the simulation, and when effects are asked about alone."""

import importlib
import json
from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest

from torchrl_athletic.diagnosis.fit import Fitted, Hypothesis
from torchrl_athletic.diagnosis.proposal import Proposal
from torchrl_athletic.diagnosis.replay import Take
from torchrl_athletic.diagnosis.result import Score
from torchrl_athletic.diagnosis.screen import Candidate
from torchrl_athletic.diagnosis.simulate import _asked_alone, _with_joints, _with_motion, key_of
from torchrl_athletic.diagnosis.stages import Simulated, Trial
from torchrl_athletic.diagnosis.thresholds import DECISION, SIMULATION
from torchrl_athletic.effects import Parameter

stage = importlib.import_module("torchrl_athletic.diagnosis.simulate")


def test_combinations_are_chosen_by_the_windows_of_the_recordings_that_were_fitted(monkeypatch):
    """Those kept aside score the answer; to choose by them would make their score too good."""
    results = {"train": ("a", 0, "errors", "began"), "heldout": ("b", 1, "others", "else")}
    monkeypatch.setattr(stage, "_results", lambda fitted, ready: results)
    monkeypatch.setattr(stage, "_closes", lambda fitted, score, ready: f"{score} closes")
    trial = stage.scored(SimpleNamespace(behind=2.0), None, None)
    assert (trial.window_errors, trial.began, trial.closes) == ("errors", "began", "a closes")
    assert trial.scores == {"train": "a", "heldout": "b"}
    assert stage.scored(SimpleNamespace(behind=np.inf), None, None).closes == {}  # it gives no names


def test_what_terms_close_is_asked_over_windows_as_the_scores_fewer_where_there_are_many_terms(monkeypatch):
    asked = []
    monkeypatch.setattr(stage, "draw_windows", lambda *given: asked.append(given) or ["first", "second"])
    monkeypatch.setattr(stage, "well_started", lambda w: f"{w}, well started")
    monkeypatch.setattr(stage, "shares_closed", lambda *given: asked.append(given) or "shares")
    score = SimpleNamespace(per_joint={"hip": {"floor": 0.5}, "knee": {"floor": 0.0}})
    ready = SimpleNamespace(train=SimpleNamespace(takes="takes"), given=SimpleNamespace(rng=lambda purpose: purpose))
    term = SimpleNamespace(joint_name="hip")
    for count, most in ((1, SIMULATION.windows), (48, SIMULATION.weighed // 50)):  # as it is, each alone, and all
        fitted = SimpleNamespace(hypothesis=SimpleNamespace(terms=(term,) * count))
        assert stage._closes(fitted, score, ready) == "shares"
        assert asked[-2] == ("takes", SIMULATION.window, most, "closes")
        own, windows, near = asked[-1]
        assert (own, windows) == (fitted, ["first, well started", "second, well started"])
        assert near.tolist() == [DECISION.follows * 0.5, DECISION.follows * 1e-12]


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
        late, progress = lambda share=None: self.count >= self.late, SimpleNamespace(update=lambda fraction: None)
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
    ("left", "over", "named", "behind"),
    [
        (0.5, 9.0, ["term"], DECISION.behind),  # it may be the names if the simulation is decisively better
        (0.01, 9.0, ["term"], np.inf),  # nothing is left to be named
        (0.5, 9.0, [], np.inf),  # on each joint a number stops at a bound
        (0.5, 2.0, ["term"], None),  # what follows needs no other
        (0.009, 9.0, ["term"], None),  # the error has fallen to a tenth
    ],
)
def test_the_standard_joints_are_tried_where_nothing_follows(monkeypatch, left, over, named, behind):
    work = Started(monkeypatch, left, True, True, over)
    added = joints_added(monkeypatch, work, named)
    assert [p.behind for p in added] == ([] if behind is None else [behind])
    assert all(p.joints and p.on_trial for p in added)


@pytest.mark.parametrize(("aside", "asked"), [(0.009, False), (0.5, True)])
def test_the_standard_joints_are_tried_where_only_what_was_fitted_follows(monkeypatch, aside, asked):
    work = Started(monkeypatch, 0.009, True, True, 9.0)
    scores = work.begun.trials[0].scores
    scores["heldout"] = replace(scores["train"], before=aside)
    assert bool(joints_added(monkeypatch, work, ["term"])) == asked


def joints_added(monkeypatch: pytest.MonkeyPatch, work: Started, named: list[str]) -> list[Proposal]:
    """Proposals of the fit of the standard joints."""
    monkeypatch.setattr(stage, "standard_joints_of", lambda given, run: work.begun.trials[0].fitted)
    monkeypatch.setattr(stage, "in_torques", lambda judge, fitted: SimpleNamespace(fit=SimpleNamespace(terms=named)))
    monkeypatch.setattr(stage, "_without_small", lambda fitted, given: fitted)
    monkeypatch.setattr(stage, "scored", lambda proposal, fitted, ready: SimpleNamespace(proposal=proposal))
    located = SimpleNamespace(ready=SimpleNamespace(given=None))
    begun = replace(work.begun, proposed=SimpleNamespace(located=located, drive=None))
    return [t.proposal for t in _with_joints(begun, SimpleNamespace(late=lambda share=None: False)).trials[1:]]


def test_a_fit_in_which_a_mass_is_adjusted_is_not_taken_for_one_in_which_it_is_found():
    friction, mass, knee = candidate("friction"), candidate("link_mass"), candidate("friction", joint=1)
    zero = np.zeros(2)
    assert key_of(Hypothesis((friction, mass)), zero) != key_of(Hypothesis((friction,), (mass,)), zero)
    others = [(friction,), (knee,), (mass,), (friction, knee), ()]
    assert len({key_of(Hypothesis(terms), zero[: len(terms)]) for terms in others}) == len(others)


def test_a_fit_that_begins_elsewhere_or_within_other_bounds_is_another_fit():
    h, narrow = (Hypothesis((candidate("friction", high=high),)) for high in (10.0, 1.0))
    keys = {key_of(h, np.array([0.5])), key_of(h, np.array([0.4])), key_of(narrow, np.array([0.5]))}
    assert len(keys) == 3
    assert key_of(h, np.array([0.5])) in keys


def candidate(name, joint=0, low=0.0, high=10.0, nominal=0.0, excludes=()):
    p = Parameter("p", "1", nominal, low, high, 1.0)
    effect = SimpleNamespace(name=name, excludes=excludes)
    return Candidate(effect, joint, f"joint{joint}", (p,))


def found(*terms, trims=(), judge=None):
    """What was proposed: candidates with a number each."""
    atoms = [SimpleNamespace(candidate=c) for c, _ in (*terms, *trims)]
    values = [np.array([float(v)]) for _, v in (*terms, *trims)]
    fitted = SimpleNamespace(atoms=atoms, terms=atoms[: len(terms)], size=len(terms), values=lambda: values)
    return SimpleNamespace(best=SimpleNamespace(fit=fitted), judge=judge)


def test_the_simulation_moves_what_two_channels_say_of_the_drive_by_a_tenth_and_only_trims_that_all_may_move(
    monkeypatch,
):
    drive = [(candidate("scale"), 2.0), (candidate("lag", high=9.6), 9.5), (candidate("offset", low=-4.1), -4.0)]
    mechanics = candidate("friction"), candidate("mass", 1)
    trims = [
        candidate("known", nominal=1.0), candidate("unasked", 1, nominal=7.0), candidate("still"),
        candidate("kept_out", 1, excludes=("mass",)),
    ]  # fmt: skip
    monkeypatch.setattr(stage, "trims_for", lambda takes, which: trims if takes == "takes" else [])
    judge = SimpleNamespace(bank=SimpleNamespace(takes="takes"))
    option = found((mechanics[0], 0.5), (mechanics[1], 0.6), trims=[(trims[0], 1.25), (trims[2], 3.0)], judge=judge)
    adjusted = {t.key for t in trims if t.effect.name != "still"}
    h, start = stage._hypothesis(option, found(*drive, trims=[(candidate("clock"), 3.0)]), adjusted)
    assert [c.effect.name for c in h.terms] == ["scale", "lag", "offset", "friction", "mass"]
    assert h.terms[3:] == mechanics
    assert h.trims == (trims[0], trims[1])
    assert start.tolist() == [2.0, 9.5, -4.0, 0.5, 0.6, 1.25, 7.0]
    assert h.bounds[0][:3] == pytest.approx([1.8, 8.55, -4.1])
    assert h.bounds[1][:3] == pytest.approx([2.2, 9.6, -3.6])
    alone, start = stage._hypothesis(option, None, set())
    assert (alone.terms, alone.trims, start.tolist()) == (mechanics, (), [0.5, 0.6])
    assert stage._hypothesis(found(judge=judge), None, set())[1].shape == (0,)


@pytest.mark.parametrize(("value", "moved"), [(1.19, False), (1.21, True), (0.81, False), (0.79, True)])
def test_a_trim_may_move_where_the_torques_asked_for_a_tenth_of_its_tolerance_or_were_not_asked(
    monkeypatch, value, moved
):
    """The trim has a value of 1 in the model, with a tolerance of 2 to either side."""
    trims = [candidate(name, low=-1.0, high=3.0, nominal=1.0) for name in ("asked", "unasked", "torques_only")]
    monkeypatch.setattr(stage, "trims_for", lambda takes, which: trims)
    monkeypatch.setattr(stage, "TRIMS", (trims[2].effect,))
    judge = SimpleNamespace(bank=SimpleNamespace(takes=None))
    adjusted = stage._adjusted(found((candidate("friction"), 5.0), trims=[(trims[0], value)], judge=judge))
    assert adjusted == {trims[1].key} | ({trims[0].key} if moved else set())


def test_one_combination_is_tried_however_late_it_is_and_others_while_there_is_time(monkeypatch):
    told, late = [], [True]
    monkeypatch.setattr(stage, "_trial", lambda proposal, *_: f"trial of {proposal}")
    run = SimpleNamespace(late=lambda share: late[0], progress=SimpleNamespace(update=told.append))
    begun = Simulated(None, (), ("a", "b", "c", "d"))
    first = stage._tried_all(begun, run)
    assert (first.trials, first.untried) == (("trial of a",), ("b", "c", "d"))
    assert stage._tried_all(first, run) is first
    late[0] = False
    every = stage._tried_all(first, run)
    assert every.trials == tuple(f"trial of {x}" for x in "abcd")
    assert told == [0.25, 0.5, 0.75, 1.0]
    assert stage._tried_all(replace(first, stopped=True), run).trials == ("trial of a",)

    def stopped(*_):
        raise KeyboardInterrupt

    monkeypatch.setattr(stage, "_trial", stopped)
    halted = stage._tried_all(first, run)
    assert halted.stopped
    assert halted.untried == ("b", "c", "d")


def test_all_combinations_are_fitted_beside_the_same_trims_and_what_the_drive_shows_is_never_idle(monkeypatch):
    drive, friction, spring = candidate("scale"), candidate("friction"), candidate("spring")
    options = [found((friction, 1.0)), found((spring, 2.0))]
    told = {}
    h = Hypothesis((drive, friction, spring))
    copies = {"long take": "take"}
    monkeypatch.setattr(stage, "_in_long_steps", lambda ready, h, x: told.setdefault("steps", []).append(x) or copies)
    monkeypatch.setattr(stage, "_adjusted", lambda option: {option.best.fit.terms[0].candidate.effect.name})
    monkeypatch.setattr(
        stage, "_hypothesis", lambda option, drive, adjusted: told.update(adjusted=adjusted) or (h, np.arange(3.0))
    )
    fitted = SimpleNamespace(values="found")
    monkeypatch.setattr(stage, "fit_in_steps_of", lambda *given: told.update(fit=given) or fitted)
    monkeypatch.setattr(
        stage, "idle_terms", lambda fitted, takes, rng: told.update(idle=(fitted, takes, rng)) or h.terms
    )
    monkeypatch.setattr(stage, "without", lambda fitted, idle: (fitted, [c.effect.name for c in idle]))
    monkeypatch.setattr(stage, "_without_small", lambda fitted, given: fitted)
    monkeypatch.setattr(stage, "scored", lambda proposal, fitted, ready: (proposal, fitted))
    given = SimpleNamespace(rng=lambda purpose: f"dice for {purpose}")
    ready = SimpleNamespace(given=given, train=SimpleNamespace(takes="takes"))
    located = SimpleNamespace(ready=ready)
    checkpoint = SimpleNamespace(result=lambda key, compute, encode, decode: compute())
    for of_drive, idle in ((found((drive, 1.0)), ["friction", "spring"]), (None, ["scale", "friction", "spring"])):
        proposed = SimpleNamespace(located=located, drive=of_drive, options=options)
        trial = stage._trial(options[1], proposed, SimpleNamespace(checkpoint=checkpoint))
        assert trial == (options[1], (fitted, idle))
    assert told["adjusted"] == {"friction", "spring"}
    assert told["fit"][:2] + told["fit"][3:] == (copies, h, given.rng)
    assert told["fit"][2].tolist() == told["steps"][0].tolist() == [0.0, 1.0, 2.0]
    assert told["idle"] == (fitted, ("long take",), "dice for idle")
    assert told["steps"][1] == "found"  # another's numbers may ask for other steps


@pytest.mark.parametrize(
    ("targets", "gear", "steps"),
    [
        ([None, None], False, "own"),
        ([None, [0.5]], False, "long"),
        ([None, [0.5]], True, "own"),  # teeth meet within a step
    ],
)
def test_what_follows_targets_is_tried_in_longer_steps_but_for_gears(monkeypatch, targets, gear, steps):
    takes = tuple(Take(SimpleNamespace(position_target=t), *[None] * 8) for t in targets)
    ready = SimpleNamespace(train=SimpleNamespace(takes=takes), given=SimpleNamespace(rng=lambda purpose: purpose))
    terms = (SimpleNamespace(effect=SimpleNamespace(of_accelerations=gear)),)
    h, told = SimpleNamespace(terms=terms), []
    copies = {f"copy {k}": take for k, take in enumerate(takes)}
    monkeypatch.setattr(stage, "coarse", lambda *given: told.append(given) or copies)
    found = stage._in_long_steps(ready, h, "values")
    assert list(found) == ([*takes] if steps == "own" else ["copy 0", "copy 1"])
    assert list(found.values()) == [*takes]
    assert told == ([] if steps == "own" else [(takes, h, ["values"], "coarse")])


def test_each_set_of_recordings_is_scored_with_its_own_noise_and_windows(monkeypatch):
    sets = {name: SimpleNamespace(takes=f"{name} takes", position_noise=f"{name} noise", repeatability=f"{name} again")
            for name in ("train", "heldout")}  # fmt: skip
    ready = SimpleNamespace(given=SimpleNamespace(rng=lambda name: f"{name} dice"), splits=lambda: sets)
    monkeypatch.setattr(stage, "score", lambda *told: (" ".join(told), 0))
    scores = stage.scores_of(SimpleNamespace(hypothesis="h", values="x"), ready)
    assert scores == {name: f"{name} takes h x {name} noise {name} dice {name} again" for name in sets}


def test_a_fit_that_was_kept_comes_back_as_it_was_with_the_bounds_of_its_hypothesis(monkeypatch):
    h, kept = Hypothesis((candidate("friction"), candidate("spring"))), {}
    samples = np.arange(10.0).reshape(5, 2)
    monkeypatch.setattr(stage, "_adjusted", lambda option: set())
    monkeypatch.setattr(stage, "_hypothesis", lambda option, drive, adjusted: (h, np.zeros(2)))
    monkeypatch.setattr(stage, "fit_in_steps_of", lambda *_: Fitted(h, np.array([1.0, 2.0]), samples, 0.75))
    monkeypatch.setattr(stage, "idle_terms", lambda *_: ())
    monkeypatch.setattr(stage, "scored", lambda proposal, fitted, ready: fitted)
    monkeypatch.setattr(stage, "_without_small", lambda fitted, given: fitted)

    def result(key, compute, encode, decode):
        assert key == key_of(h, np.zeros(2))
        kept.setdefault(key, json.dumps(encode(compute())))
        return decode(json.loads(kept[key]))

    ready = SimpleNamespace(given=SimpleNamespace(rng=lambda purpose: None), train=SimpleNamespace(takes=()))
    proposed = SimpleNamespace(located=SimpleNamespace(ready=ready), drive=None, options=())
    found = stage._trial(None, proposed, SimpleNamespace(checkpoint=SimpleNamespace(result=result)))
    assert (found.hypothesis.terms, found.hypothesis.trims) == (h.terms, ())
    assert (found.values.tolist(), found.samples.tolist(), found.cost) == ([1.0, 2.0], samples.tolist(), 0.75)


@pytest.mark.parametrize("rates", [(100.0, 50.0), (50.0, 100.0)])
def test_what_is_too_small_for_a_name_by_the_slowest_clock_stays_as_a_trim(monkeypatch, rates):
    h, asked = Hypothesis((candidate("friction"), candidate("clock")), (candidate("mass"),)), []

    def is_trim(c, values, period, joints):
        asked.append((c, values.tolist(), period, joints))
        return c.effect.name == "clock"

    monkeypatch.setattr(stage, "is_trim", is_trim)
    given = SimpleNamespace(recordings=[SimpleNamespace(rate=rate) for rate in rates], joint_names=("hip", "knee"))
    found = stage._without_small(Fitted(h, np.array([1.0, 2.0, 3.0]), np.zeros((4, 3)), 0.0), given)
    assert asked == [(h.terms[0], [1.0], 0.02, 2), (h.terms[1], [2.0], 0.02, 2)]
    assert (found.hypothesis.terms, found.hypothesis.trims) == (h.terms[:1], (h.terms[1], h.trims[0]))
    assert found.values.tolist() == [1.0, 2.0, 3.0]


@pytest.mark.parametrize(
    ("change", "added"),
    [({}, 1), ({"trials": ()}, 0), ({"stopped": True}, 0), ({"late": True}, 0), ({"drive": "drive"}, 0),
     ({"kept": None}, 0)],
)  # fmt: skip
def test_the_standard_joints_need_time_a_first_trial_a_whole_chain_and_something_to_keep(monkeypatch, change, added):
    work, told = Started(monkeypatch, 0.5, True, True, 9.0), []
    fitted = change.get("kept", "fitted")
    monkeypatch.setattr(stage, "standard_joints_of", lambda given, run: told.append(given) or fitted)
    scored = lambda judge, fitted: SimpleNamespace(fit=SimpleNamespace(terms=["term"]), of=(judge, fitted))  # noqa: E731
    monkeypatch.setattr(stage, "in_torques", scored)
    monkeypatch.setattr(stage, "_without_small", lambda fitted, given: (fitted, given))
    monkeypatch.setattr(stage, "scored", lambda *given: SimpleNamespace(proposal=given[0], given=given[1:]))
    ready = SimpleNamespace(given="given")
    proposed = SimpleNamespace(located=SimpleNamespace(ready=ready), drive=change.get("drive"))
    begun = replace(work.begun, proposed=proposed, trials=change.get("trials", work.begun.trials),
                    stopped=change.get("stopped", False))  # fmt: skip
    run = SimpleNamespace(late=lambda share=None: change.get("late", False))
    new = _with_joints(begun, run).trials[len(begun.trials) :]
    assert len(new) == added
    for trial in new:
        assert trial.given == (("fitted", "given"), ready)
        assert trial.proposal.best.of == (work.begun.trials[0].proposal.judge, "fitted")
        assert told == ["given"]

    def stopped(*_):
        raise KeyboardInterrupt

    monkeypatch.setattr(stage, "standard_joints_of", stopped)
    assert _with_joints(begun, run).stopped is (bool(added) or "kept" in change or "stopped" in change)


@pytest.mark.parametrize(("left", "behind"), [(0.01, np.inf), (0.9, 1.0)])
def test_the_standard_joints_lose_their_names_to_what_was_tried_after_them_and_explains(monkeypatch, left, behind):
    joints, later = Proposal(None, None, 1.0, joints=True), Proposal(None, None, 2.0)
    trials = tuple(Trial(p, None, {"train": x}, None, None) for p, x in ((joints, 0.02), (later, left)))
    monkeypatch.setattr(stage, "open_share", lambda share: share)
    monkeypatch.setattr(stage, "decided_by", lambda trials: (len(trials) - 1,))
    told = stage._explained(Simulated(None, trials))
    assert [t.proposal.behind for t in told.trials] == [behind, 2.0]
    alone = Simulated(None, trials[1:])
    assert stage._explained(alone) is alone


def test_what_was_proposed_is_tried_first_then_what_the_motion_asks_for_and_then_each_effect_alone(monkeypatch):
    """In a hurry that and the standard joints come before what is left of the proposals."""
    told = []
    for name in ("_tried_all", "_with_motion", "_with_joints", "_asked_alone"):
        monkeypatch.setattr(stage, name, lambda *given, name=name: told.append((name, *given[1:])) or given[0])
    proposed = SimpleNamespace(options=("a", "b"))
    done = stage.simulate(proposed, "run")
    asked = [("_with_motion", "run"), ("_with_joints", "run")]
    assert told == [("_tried_all", "run", 0.4), *asked, ("_tried_all", "run"), ("_asked_alone", "run")]
    assert (done.proposed, done.trials, done.untried, done.stopped) == (proposed, (), ("a", "b"), False)


@pytest.mark.parametrize("terms", [(), ("friction",)])
def test_what_the_motion_asks_for_is_a_trial_and_its_classes_are_told_even_if_it_asks_for_nothing(monkeypatch, terms):
    work, told = Started(monkeypatch, 0.5, True, True, 9.0), []
    fitted = SimpleNamespace(hypothesis=SimpleNamespace(terms=terms))
    asked = SimpleNamespace(
        fitted=fitted, classes={("friction", "hip"): 0.4 * len(terms)}, complete=True,
        offered=[SimpleNamespace(key=("friction", "hip"))],
    )  # fmt: skip
    monkeypatch.setattr(stage, "asked_of_motion", lambda ready, run, proposed: told.append(proposed) or asked)
    monkeypatch.setattr(stage, "as_chosen", lambda judge, fitted: f"{len(fitted.hypothesis.terms)} in torques")
    monkeypatch.setattr(stage, "rivals_in_torques", lambda judge, asked: {"friction": "rivals"})
    monkeypatch.setattr(stage, "_without_small", lambda fitted, given: fitted)
    monkeypatch.setattr(stage, "scored", lambda *given: SimpleNamespace(proposal=given[0], fitted=given[1]))

    def of_joints(*names):
        given = SimpleNamespace(joint_names=names)
        return SimpleNamespace(located=SimpleNamespace(ready=SimpleNamespace(given=given)), drive=None)

    begun = replace(work.begun, proposed=of_joints("hip", "knee"))
    run = SimpleNamespace(late=lambda share=None: False)
    done = _with_motion(begun, run)
    assert told == [[t.fitted for t in begun.trials]]  # what the torques speak for is offered
    assert done.asked == asked.classes
    assert [t.proposal.best for t in done.trials[len(begun.trials) :]] == ["1 in torques"] * len(terms)
    for trial in done.trials[len(begun.trials) :]:
        p = trial.proposal
        assert (p.motion, p.on_trial, p.behind, p.rivals) == (True, True, DECISION.behind, {"friction": "rivals"})
        assert p.by_simulation
        assert p.offered == {("friction", "hip")}
    asked.complete = False  # there was no time to ask for all: nothing is said of what it does without
    cut = _with_motion(begun, run)
    assert cut.asked is None
    assert all(t.proposal.offered == frozenset() for t in cut.trials[len(begun.trials) :])
    asked.complete = True
    unasked = replace(begun, proposed=SimpleNamespace(located=None, drive="drive"))
    assert _with_motion(unasked, run) is unasked  # a measured torque cuts the chain
    alone = replace(begun, proposed=of_joints("hip"))
    assert _with_motion(alone, run) is alone  # a single joint's torques are its own

    def stopped(*_):
        raise KeyboardInterrupt

    monkeypatch.setattr(stage, "asked_of_motion", stopped)
    assert _with_motion(begun, run).stopped


def test_the_standard_joints_give_no_names_beside_what_the_motion_asks_for(monkeypatch):
    work = Started(monkeypatch, 0.5, True, True, 9.0)
    first = work.begun.trials
    monkeypatch.setattr(stage, "decided_by", lambda trials: (0,))
    for offered, behind in ((frozenset({("friction", "hip")}), np.inf), (frozenset(), DECISION.behind)):
        motion = work.trial(Proposal(None, None, motion=True, offered=offered), True, 0.5, 9.0)
        work.begun = replace(work.begun, trials=(*first, motion))
        assert joints_added(monkeypatch, work, ["term"])[-1].behind == behind  # unless there was no time to ask for all


@pytest.mark.parametrize(
    ("left", "over", "terms", "asked"),
    [
        (0.5, 9.0, 1, True),
        (0.5, 2.0, 3, False),  # what follows needs no other
        (0.009, 9.0, 2, False),  # the error has fallen to a tenth
        (0.009, 9.0, 3, True),  # by more effects than joints
    ],
)
def test_the_motion_is_asked_where_nothing_follows_or_more_effects_than_joints_close_the_error(
    monkeypatch, left, over, terms, asked
):
    work = Started(monkeypatch, left, True, True, over)
    work.begun.trials[0].fitted.hypothesis.terms = (None,) * terms
    given = SimpleNamespace(joint_names=("hip", "knee"))
    proposed = SimpleNamespace(located=SimpleNamespace(ready=SimpleNamespace(given=given)), drive=None)
    begun = replace(work.begun, proposed=proposed)
    assert stage._asks_motion(begun, SimpleNamespace(late=lambda share=None: False)) is asked
    assert not stage._asks_motion(begun, SimpleNamespace(late=lambda share=None: True))
