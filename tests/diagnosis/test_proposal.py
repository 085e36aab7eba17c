"""Who could stand in a term's place: shares of the evidence, by torques and simulation."""

from types import SimpleNamespace

import numpy as np
import pytest

from torchrl_athletic.diagnosis import proposal
from torchrl_athletic.diagnosis.proposal import Proposal, answer_set


def atom(name: str, joint: str = "elbow"):
    return SimpleNamespace(candidate=SimpleNamespace(key=(name, joint), joint_name=joint))


def scored(evidence: float, *atoms):
    return SimpleNamespace(evidence=evidence, fit=SimpleNamespace(terms=atoms))


def test_probabilities_are_shares_of_the_evidence_among_those_who_could_stand_there(monkeypatch):
    kept, term, rival, far = atom("payload"), atom("coulomb"), atom("stribeck"), atom("backlash")
    options = [scored(100.0, kept, term), scored(104.0, kept, rival), scored(140.0, far, kept)]
    monkeypatch.setattr(proposal, "alternatives", lambda *_: options)
    found = answer_set(Proposal(None, options[0]), term)
    assert [o.atom for o in found] == [term, rival, far]
    shares = [o.share for o in found]
    assert sum(shares) == pytest.approx(1.0)
    assert shares[1] / shares[0] == pytest.approx(np.exp(-2.0))  # evidence is twice the log odds
    assert shares[2] < 1e-8


def test_what_the_simulation_says_of_a_combination_counts_beside_the_torque_domain(monkeypatch):
    term, rival = atom("coulomb"), atom("stribeck")
    options = [scored(100.0, term), scored(104.0, rival)]
    monkeypatch.setattr(proposal, "alternatives", lambda *_: options)
    against = {frozenset({("coulomb", "elbow")}): 10.0, frozenset({("stribeck", "elbow")}): 0.0}
    shares = {o.atom.candidate.key: o.share for o in answer_set(Proposal(None, options[0], simulated=against), term)}
    assert shares["stribeck", "elbow"] / shares["coulomb", "elbow"] == pytest.approx(np.exp(3.0))


def test_a_rival_that_was_not_simulated_gains_nothing_by_it(monkeypatch):
    term, rival = atom("coulomb"), atom("stribeck")
    options = [scored(100.0, term), scored(104.0, rival)]
    monkeypatch.setattr(proposal, "alternatives", lambda *_: options)
    part = Proposal(None, options[0], simulated={frozenset({("coulomb", "elbow")}): 10.0})
    shares = {o.atom.candidate.key: o.share for o in answer_set(part, term)}
    assert shares["stribeck", "elbow"] / shares["coulomb", "elbow"] == pytest.approx(np.exp(-2.0))


def exchanged(monkeypatch, term, best, other, behind: float = 2.0) -> dict:
    """Shares of who could stand in a term's place, where no single one could and another combination lies behind."""
    monkeypatch.setattr(proposal, "alternatives", lambda *_: [best])
    monkeypatch.setattr(proposal, "as_rival", lambda judge, best, atoms: scored(best.evidence + behind, *atoms))
    return {o.atom.candidate.key[0]: o.share for o in answer_set(Proposal(None, best, others=(other,)), term)}


def test_an_effect_that_does_alone_what_several_do_is_a_rival_of_each(monkeypatch):
    rotor, lag, kept, gains = atom("rotor"), atom("lag"), atom("payload", "wrist"), atom("gains")
    best, other = scored(100.0, rotor, lag, kept), scored(0.0, gains, kept)
    for term in (rotor, lag):
        shares = exchanged(monkeypatch, term, best, other)
        assert set(shares) == {term.candidate.key[0], "gains"}
        assert shares["gains"] / shares[term.candidate.key[0]] == pytest.approx(np.exp(-1.0))
    assert exchanged(monkeypatch, kept, best, other) == {"payload": 1.0}


def test_a_name_that_stands_there_alone_and_for_several_counts_as_the_better_of_the_two(monkeypatch):
    rotor, lag, gains = atom("rotor"), atom("lag"), atom("gains")
    best, alone, other = scored(100.0, rotor, lag), scored(130.0, gains, lag), scored(0.0, gains)
    monkeypatch.setattr(proposal, "alternatives", lambda *_: [best, alone])
    monkeypatch.setattr(proposal, "as_rival", lambda judge, best, atoms: scored(102.0, *atoms))
    found = {o.atom.candidate.key[0]: o.evidence for o in answer_set(Proposal(None, best, others=(other,)), rotor)}
    assert found == {"rotor": 100.0, "gains": 102.0}


def test_a_cause_of_the_whole_robot_is_a_rival_of_those_of_its_joints(monkeypatch):
    delays, clock = [atom("delay", joint) for joint in ("hip", "knee")], atom("clock", None)
    for delay in delays:
        assert set(exchanged(monkeypatch, delay, scored(100.0, *delays), scored(0.0, clock))) == {"delay", "clock"}


@pytest.mark.parametrize(
    ("best", "other"),
    [
        ((atom("gains"),), (atom("rotor"), atom("lag"))),  # which of two would it be
        ((atom("gains"), atom("offset")), (atom("rotor"), atom("lag"))),
        ((atom("gains"), atom("play", "wrist")), (atom("rotor"),)),  # nor does one joint's speak for another's
        ((atom("gains"), atom("play")), (atom("rotor", "wrist"),)),
        ((atom("gains"), atom("offset")), (atom("offset"),)),
        ((atom("gains"),), (atom("rotor"),)),  # that is in the list of those that stand in its place alone
    ],
)
def test_other_combinations_are_no_rivals_where_no_single_name_stands_for_several(monkeypatch, best, other):
    assert exchanged(monkeypatch, best[0], scored(100.0, *best), scored(0.0, *other)) == {"gains": 1.0}


def test_what_the_simulation_says_of_another_combination_counts_as_well(monkeypatch):
    rotor, lag, gains = atom("rotor"), atom("lag"), atom("gains")
    best, other = scored(100.0, rotor, lag), scored(0.0, gains)
    monkeypatch.setattr(proposal, "alternatives", lambda *_: [best])
    monkeypatch.setattr(proposal, "as_rival", lambda judge, best, atoms: scored(best.evidence, *atoms))
    part = Proposal(None, best, simulated={frozenset({("gains", "elbow")}): 2.0}, others=(other,))
    shares = {o.atom.candidate.key[0]: o.share for o in answer_set(part, rotor)}
    assert shares["gains"] / shares["rotor"] == pytest.approx(np.exp(-1.0))


def test_equals_share_the_probability_and_odds_do_not_depend_on_the_level(monkeypatch):
    term, rival = atom("coulomb"), atom("stribeck")
    for level in (-1e5, 0.0, 1e5):
        options = [scored(level, term), scored(level, rival)]
        monkeypatch.setattr(proposal, "alternatives", lambda *_, options=options: options)
        assert [o.share for o in answer_set(Proposal(None, options[0]), term)] == [0.5, 0.5]


def test_what_is_no_match_at_all_has_no_share_however_far_behind_it_is(monkeypatch):
    term, rival = atom("coulomb"), atom("stribeck")
    options = [scored(0.0, term), scored(1e5, rival)]
    asked = []
    monkeypatch.setattr(proposal, "alternatives", lambda *given: asked.append(given) or options)
    assert [o.share for o in answer_set(Proposal("judge", options[0]), term)] == [1.0, 0.0]
    assert asked == [("judge", options[0], term)]


def test_one_joints_effect_may_stand_for_another_of_it_and_a_cause_of_the_whole_robot(monkeypatch):
    delay, clock, lag = atom("delay"), atom("clock", None), atom("lag")
    best, other = scored(100.0, delay, clock), scored(0.0, lag)
    assert set(exchanged(monkeypatch, delay, best, other)) == {"delay", "lag"}


def test_what_is_left_is_that_of_a_terms_joint_and_of_the_worst_one_for_a_cause_of_the_whole_robot():
    before, after = np.array([4.0, 10.0, 0.5, 1.5]), np.array([1.0, 12.0, 0.4, 0.75])
    judge = SimpleNamespace(bare="bare", excess=lambda fit: before if fit == "bare" else after)
    part = Proposal(judge, SimpleNamespace(fit="best"))
    assert part.left().tolist() == [0.25, 1.0, 0.0, 0.5]  # no more than all, and of noise nothing
    of = [SimpleNamespace(joint_name=f"{j}", joint=j) for j in range(3)]
    assert [part.left_of(c) for c in of] == [0.25, 1.0, 0.0]
    assert [part.excess_of(c) for c in of] == [1.0, 12.0, 0.4]
    whole = SimpleNamespace(joint_name=None, joint=0)
    assert (part.left_of(whole), part.excess_of(whole)) == (1.0, 12.0)


def test_numbers_of_the_standard_joints_have_no_rivals_in_the_torques_that_the_simulation_overruled(monkeypatch):
    term, rival = atom("rotor"), atom("lag")
    monkeypatch.setattr(proposal, "alternatives", lambda *_: [scored(100.0, term), scored(50.0, rival)])
    best = scored(100.0, term)
    (own,) = answer_set(Proposal(None, best, joints=True), term)
    assert (own.atom, own.scored, own.share) == (term, best, 1.0)
    assert [o.atom for o in answer_set(Proposal(None, best), term)] == [rival, term]


def allowing(name: str, joint: str = "elbow", beside=lambda other: True):
    return SimpleNamespace(candidate=SimpleNamespace(key=(name, joint), joint_name=joint, allows=beside))


def test_what_the_motion_asks_for_shares_with_what_it_would_take_in_its_place(monkeypatch):
    kept, term, rival = allowing("payload"), allowing("rotor"), allowing("lag")
    barred = allowing("mass", beside=lambda other: other is not kept.candidate)
    monkeypatch.setattr(proposal, "as_rival", lambda judge, best, atoms: atoms)
    part = Proposal(
        "judge", scored(7.0, kept, term), motion=True, rivals={("rotor", "elbow"): ((rival, 4.0), (barred, 0.0))}
    )
    found = answer_set(part, term)
    assert [o.atom for o in found] == [term, rival]
    assert [o.scored for o in found] == [part.best, [kept, rival]]
    assert found[1].share / found[0].share == pytest.approx(np.exp(-2.0))
    assert sum(o.share for o in found) == pytest.approx(1.0)
    assert [o.share for o in answer_set(part, kept)] == [1.0]  # nothing else was tried there


def test_a_name_that_the_torques_speak_for_as_well_has_its_share_from_them(monkeypatch):
    term, own, rival = atom("rotor"), atom("rotor"), atom("lag")
    options = [scored(100.0, own), scored(102.0, rival)]
    monkeypatch.setattr(proposal, "alternatives", lambda judge, best, of: options if of is own else [])
    torques = Proposal(None, options[0])
    part = Proposal(None, scored(7.0, term), motion=True, torques=torques)
    assert part.backing(("rotor", "elbow")) is own
    assert part.backing(("lag", "elbow")) is None
    assert [(o.atom, o.share) for o in answer_set(part, term)] == [
        (own, pytest.approx(1 / (1 + np.exp(-1.0)))), (rival, pytest.approx(1 / (1 + np.exp(1.0)))),
    ]  # fmt: skip
