"""What the torques are asked about: the whole chain, or drive and mechanics apart where a current tells the torque."""

from types import SimpleNamespace

import numpy as np
import pytest

from torchrl_athletic.diagnosis import propose as proposing
from torchrl_athletic.diagnosis.proposal import Proposal
from torchrl_athletic.diagnosis.thresholds import DECISION, SEARCH


def effect(name, *, between=False, before=False, own=False):
    return SimpleNamespace(name=name, between_torques=between, before_sensor=before, own_joint=own)


CATALOGUE = effect("delay", between=True, before=True), effect("scale", between=True), effect("friction")


def signals(semantics="current_derived", command=True):
    recording = SimpleNamespace(torque_semantics=semantics, torque_command=np.zeros(1) if command else None)
    return SimpleNamespace(recording=recording, kernel=0.07)


def scored(*names, evidence=0.0):
    terms = [SimpleNamespace(candidate=SimpleNamespace(key=(name, "hip"))) for name in names]
    return SimpleNamespace(fit=SimpleNamespace(terms=terms), evidence=evidence)


@pytest.fixture
def asked(monkeypatch):
    """What is searched: signals, names of effects, trims and what is taken; and how the measured torque is prepared."""
    told = SimpleNamespace(searched=[], prepared=[], progress=[])

    def searched(takes, catalogue, trims, run, taken=frozenset(), progress=None):
        told.searched.append((takes, [e.name for e in catalogue], trims, taken))
        told.progress.append(progress)
        best = scored("scale" if len(told.searched) == 1 else "friction")
        return [Proposal(None, best), Proposal(None, scored("second"))]

    def prepare(*given):
        told.prepared.append(given)
        return SimpleNamespace(signals=("measured",))

    monkeypatch.setattr(proposing, "_searched", searched)
    monkeypatch.setattr(proposing, "prepare", prepare)
    monkeypatch.setattr(proposing, "drive_signals", lambda train: "drive")
    monkeypatch.setattr(proposing, "trims_for", lambda takes, trims: ["trims of", takes])
    return told


def proposed(*takes, drive="command"):
    given = SimpleNamespace(catalogue=CATALOGUE, drive=drive, recordings="r", model="m", joined=3, xml="x")
    located = SimpleNamespace(ready=SimpleNamespace(train=SimpleNamespace(signals=takes), given=given))
    return proposing.propose(located, SimpleNamespace(progress=SimpleNamespace(update="bar")))


def test_a_current_cuts_the_chain_and_what_the_drive_has_is_not_asked_of_the_mechanics(asked):
    found = proposed(signals(), signals())
    (drive, mechanics), (prepared,) = asked.searched, asked.prepared
    assert drive == ("drive", ["delay", "scale"], (), frozenset())
    assert mechanics == (("measured",), ["scale", "friction"], ["trims of", ("measured",)], {("scale", "hip")})
    assert prepared == ("r", "m", "measured", 0.07, 3, "x")  # with the test function of the commands
    assert asked.progress == [None, "bar"]
    assert found.drive is not None
    assert len(found.options) == 2


@pytest.mark.parametrize(
    "takes", [(signals("link_side"),), (signals(), signals("link_side")), (signals(), signals(command=False))]
)
def test_else_all_is_asked_of_the_commands(asked, takes):
    found = proposed(*takes)
    ((where, names, _, taken),) = asked.searched
    assert (where, names, taken) == (takes, ["delay", "scale", "friction"], frozenset())
    assert found.drive is None
    assert asked.prepared == []


def test_a_measured_torque_that_drives_the_simulation_has_passed_the_drive(asked):
    found = proposed(signals(), drive="measured")
    ((_, names, _, _),) = asked.searched
    assert names == ["scale", "friction"]
    assert found.drive is None


def names_of(options):
    return ["".join(t.candidate.key[0] for t in o.best.fit.terms) for o in options]


@pytest.mark.parametrize("rich", [None, scored("a", "rich")])
def test_the_best_comes_first_then_a_richer_law_on_trial_and_near_ones_once_each(monkeypatch, rich):
    first = scored("a", evidence=100.0)
    near = [(scored("b"), 3.0), (scored("a"), 1.0), (scored("c"), SEARCH.decisive + 0.1)]
    others = [scored("d", evidence=102.0), scored("b", evidence=101.0)]
    monkeypatch.setattr(proposing, "richer", lambda judge, best: rich)
    monkeypatch.setattr(proposing, "rivals", lambda judge, best, asked: near if asked == DECISION.asked else [])
    options = proposing._options("judge", [first, *others])
    names = names_of(options)
    assert names == (["a"] if rich is None else ["a", "arich"]) + ["b", "d"]
    assert [o.behind for o in options][-2:] == [1.0, 2.0]  # of two ways to b the nearer one
    assert [o.on_trial for o in options] == [name == "arich" for name in names]
    near.clear()  # what the search found is asked about up to what is decisive
    far = [scored(name, evidence=100.0 + SEARCH.decisive + x) for name, x in (("f", -0.1), ("g", 0.1))]
    assert names_of(proposing._options("judge", [first, *far]))[-1] == "f"
    near[:] = [(scored(f"n{k}"), 0.1 * k) for k in range(50)]
    assert len(proposing._options("judge", [first])) == DECISION.most_fits
    assert names_of(proposing._options("judge", [first], late=lambda: True)) == names[: 1 + (rich is not None)]


@pytest.mark.parametrize(("noisy", "rounds"), [([], 1), ([1], 2)])
def test_only_joints_that_miss_torque_are_asked_about_effects_of_their_own(monkeypatch, noisy, rounds):
    """A joint that follows the model may still feel what is shared; what the drive has is left out."""
    judged, searched, offered = [], [], []

    def candidate(name, joint, own):
        return SimpleNamespace(key=(name, joint), joint=joint, effect=SimpleNamespace(own_joint=own))

    pool = [candidate("a", 0, True), candidate("b", 1, True), candidate("c", 0, False), candidate("taken", 1, True)]
    bank = SimpleNamespace(extend=lambda candidates: offered.extend(c.key for c in candidates))

    def judge(of, noisy=()):
        judged.append(noisy)
        return SimpleNamespace(bank=of, bare="bare", is_open=lambda fit: np.array([False, True]))

    monkeypatch.setattr(proposing, "Bank", lambda takes, candidates, trims: setattr(bank, "trims", trims) or bank)
    monkeypatch.setattr(proposing, "Judge", judge)
    monkeypatch.setattr(proposing, "candidates_for", lambda takes, catalogue: pool)
    monkeypatch.setattr(proposing, "search", lambda *given, late: searched.append((*given, late())) or ["found"])
    monkeypatch.setattr(proposing, "noisy_joints", lambda judge: noisy)
    monkeypatch.setattr(proposing, "_options", lambda judge, found, late: found)
    trims = [SimpleNamespace(key=("mass", 0)), SimpleNamespace(key=("taken", 1))]
    run = SimpleNamespace(late=lambda share: share)
    assert proposing._searched("takes", "catalogue", trims, run, {("taken", 1)}, "bar") == ["found"]
    assert [given[1:] for given in searched] == [("bar", 0.3), (0.3,)][:rounds]
    assert offered == [("b", 1), ("c", 0)]
    assert [t.key for t in bank.trims] == [("mass", 0)]
    assert len(searched) == rounds
    assert judged == [(), *([noisy] if noisy else [])]
