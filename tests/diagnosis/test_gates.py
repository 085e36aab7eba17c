"""The verdict follows from the shares that are left; probabilities are shares of the evidence."""

import dataclasses
from types import SimpleNamespace

import numpy as np
import pytest
from diagnosis.columns import Given, candidate, judge, signals
from effects.arm import address, arm
from hypothesis import given
from hypothesis import strategies as st

from torchrl_athletic.diagnosis import gates
from torchrl_athletic.diagnosis.calibration import Grounds, probability, rival_probability
from torchrl_athletic.diagnosis.compare import far_joints
from torchrl_athletic.diagnosis.fit import Fitted, Hypothesis
from torchrl_athletic.diagnosis.gates import summarise, verdict_of
from torchrl_athletic.diagnosis.result import Estimate, Finding, Location, Rival, Score
from torchrl_athletic.diagnosis.screen import Candidate
from torchrl_athletic.diagnosis.thresholds import SEARCH, STATEMENT
from torchrl_athletic.effects import (
    AsymmetricFriction,
    Backlash,
    Compliance,
    CoulombFriction,
    GravityTilt,
    JointSpring,
    Parameter,
    StribeckFriction,
)

FLOOR = 1.0
FINDING = Finding(
    "coulomb_friction", "elbow", 0.9, "Dry friction.", {"torque": Estimate(1, (0.9, 1.1), "N·m")}, "everywhere"
)


def score(left: float, before: float = 10.0) -> Score:
    """A score with the given share of the error energy above the floor left."""
    after = float(np.sqrt(FLOOR**2 + left * (before**2 - FLOOR**2)))
    return Score(before, after, FLOOR, 0.0, {"elbow": {"before": before, "after": after, "floor": FLOOR}})


def evidence(left: float):
    return [SimpleNamespace(left=lambda: np.array([0.0, left]))]


def verdict(findings=(FINDING,), train=0.0, heldout=None, torque_left=0.0, is_open=True, before=10.0):
    heldout = None if heldout is None else score(heldout, before)
    return verdict_of(evidence(torque_left), findings, score(train, before), heldout, is_open)


@pytest.mark.parametrize(
    ("case", "expected"),
    [
        (dict(train=0.0), "explained"),
        (dict(train=STATEMENT.explained - 0.01), "explained"),
        (dict(train=STATEMENT.explained + 0.01), "partly_explained"),
        (dict(train=STATEMENT.partly - 0.01), "partly_explained"),
        (dict(train=STATEMENT.partly + 0.01), "unexplained"),
        (dict(train=0.01, before=70.0), "explained"),
        (dict(train=0.01, before=90.0), "partly_explained"),  # little of much is left, and still nine times the noise
        (dict(train=0.0, heldout=STATEMENT.explained + 0.01), "partly_explained"),  # the worse of the two decides
        (dict(train=0.0, heldout=0.9), "unexplained"),
        (dict(train=0.5, heldout=0.0), "partly_explained"),
        (dict(train=0.0, torque_left=2 * STATEMENT.explained - 0.01), "explained"),
        (
            dict(train=0.0, torque_left=2 * STATEMENT.explained + 0.01),
            "partly_explained",
        ),  # the torque must be explained as well
        (dict(findings=(), before=1.0, is_open=False), "nothing_missing"),
        (dict(findings=(), before=STATEMENT.near_floor - 0.1, is_open=False), "nothing_missing"),
        (dict(findings=(), train=1.0, before=STATEMENT.near_floor + 0.1, is_open=False), "unexplained"),
        (
            dict(findings=(), train=0.0, before=STATEMENT.near_floor + 0.1, is_open=False),
            "nothing_missing",
        ),  # trims suffice
        (
            dict(findings=(), before=1.0, is_open=True),
            "unexplained",
        ),  # at the floor, and torque is missing all the same
    ],
)
def test_the_verdict_table(case, expected):
    assert verdict(**case)[0] == expected


def test_what_makes_no_sense_or_is_as_likely_as_not_explains_nothing():
    even = dataclasses.replace(FINDING, probability=0.5)
    assert verdict([even])[0] == "partly_explained"
    shared = dataclasses.replace(even, rivals=(Rival("backlash", "elbow", 0.5, ""),))
    assert verdict([shared])[0] == "explained"
    assert verdict([dataclasses.replace(shared, grounds={"senseless": True})])[0] == "partly_explained"
    hardly = dataclasses.replace(FINDING, probability=0.2, rivals=(Rival("backlash", "elbow", 0.2, ""),))
    assert verdict([FINDING, hardly])[0] == "partly_explained"


@pytest.mark.parametrize("far_from", ["train", "heldout"])
def test_recordings_that_the_model_does_not_follow_are_not_made_up_for_by_others_that_it_does(far_from):
    near, far = score(1.0, 3.0), score(1.0, STATEMENT.near_floor + 1.0)
    train, heldout = (far, near) if far_from == "train" else (near, far)
    assert verdict_of([], [], train, heldout, False)[0] == "unexplained"
    assert verdict_of([], [], near, near, False)[0] == "nothing_missing"
    assert verdict_of([*evidence(0.0), *evidence(0.5)], [FINDING], score(0.0), None, True)[0] == "partly_explained"


def test_a_finding_with_no_evidence_beside_it_misses_no_torque():
    assert verdict_of([], [FINDING], score(0.0), None, True)[0] == "explained"


def test_the_unexplained_share_is_the_greater_one():
    assert verdict(train=0.1, heldout=0.3)[1] == pytest.approx(0.3)
    assert verdict(train=0.4, heldout=0.3)[1] == pytest.approx(0.4)
    assert verdict(findings=(), is_open=False, before=1.0)[1] == 0.0


def test_before_anything_was_scored_nothing_is_called_explained():
    assert verdict_of([], [FINDING], None, None, True)[0] == "partly_explained"
    assert verdict_of([], [], None, None, True)[0] == "unexplained"
    assert verdict_of([], [], None, None, False)[0] != "nothing_missing"
    assert [verdict_of([], [FINDING], None, None, is_open)[1] for is_open in (True, False)] == [1.0, 0.0]


def test_one_joint_far_from_its_floor_is_enough_not_to_call_the_model_complete():
    rows = {"a": dict(before=1.0, after=1.0, floor=1.0), "b": dict(before=9.0, after=9.0, floor=1.0)}
    both = Score(6.4, 6.4, 1.0, 0.0, rows)
    assert verdict_of([], [], both, None, False)[0] == "unexplained"
    assert (
        verdict_of([], [], dataclasses.replace(both, per_joint={"a": rows["a"]}), None, False)[0] == "nothing_missing"
    )


WHERE = (Location("elbow", "everywhere", 0.8, (0.7, 0.9)), Location("elbow", "moving backwards", 0.6, (0.5, 0.7)))


@pytest.mark.parametrize(
    ("viscous", "spread", "expected"),
    [
        ((1.0, 1.0), 0.02, True),
        ((1.0, 1.03), 0.001, True),  # seen, and nothing worth a name
        ((1.0, 1.052), 1e-4, True),  # a twentieth of the larger one
        ((1.052, 1.0), 1e-4, True),
        ((-1.0, -1.052), 1e-4, True),
        ((-1.052, -1.0), 1e-4, True),
        ((1.0, 1.056), 1e-4, False),
        ((1.0, 1.5), 0.4, True),  # not seen
        ((1.0, 1.5), 0.05, False),
    ],
)
@pytest.mark.parametrize("unit", [0.1, 10.0])
def test_friction_that_is_the_same_both_ways_has_no_claim_to_the_name_of_asymmetric(viscous, spread, expected, unit):
    names = ("coulomb_positive", "coulomb_negative", "viscous_positive", "viscous_negative")
    of = tuple(Parameter(name, "N·m", 0.0, 0.0, 10.0, 0.1) for name in names)
    values = unit * np.array([0.3, 0.3, *viscous])
    samples = values + unit * spread * np.random.default_rng(0).normal(size=(200, 4))
    assert gates._is_plain(Candidate(AsymmetricFriction(), 0, "elbow", of), values, samples) is expected
    dry = Candidate(CoulombFriction(), 0, "elbow", of[:1])
    assert not gates._is_plain(dry, values[:1], samples[:, :1])  # nothing is simpler


@pytest.mark.parametrize(("share", "plain"), [(0.02, False), (0.035, True)])
def test_what_sets_a_law_apart_is_seen_where_the_middle_95_percent_of_its_draws_say_so(share, plain, monkeypatch):
    """A share of a thousand draws lies on the other side of zero: draws of a difference, and draws of one number."""
    monkeypatch.setattr(gates, "widened", lambda value, low, high: (low, high))
    names = ("coulomb_positive", "coulomb_negative", "viscous_positive", "viscous_negative")
    of = tuple(Parameter(name, "N·m", 0.0, 0.0, 10.0, 0.1) for name in names)
    other_side = np.arange(1000) < share * 1000
    samples = np.tile([0.3, 0.3, 1.0, 1.0], (1000, 1))
    samples[:, 3] += np.where(other_side, -1.0, 1.0)
    assert (
        gates._is_plain(Candidate(AsymmetricFriction(), 0, "elbow", of), np.array([0.3, 0.3, 1, 2]), samples) is plain
    )
    spring = (Parameter("stiffness", "N·m/rad", 0.0, 0, 9, 0.1), Parameter("preload", "N·m", 0.0, -9, 9, 0.1))
    drawn = np.stack([np.where(other_side, -1.0, 1.0), np.zeros(1000)], -1)
    assert gates._is_plain(Candidate(JointSpring(), 0, "elbow", spring), np.array([1.0, 0.0]), drawn) is plain


def test_a_spring_without_stiffness_says_that_nothing_of_a_spring_is_seen():
    of = (Parameter("stiffness", "N·m/rad", 0.0, 0.0, 9.0, 0.1), Parameter("preload", "N·m", 0.0, -9.0, 9.0, 0.1))
    spring, values = Candidate(JointSpring(), 0, "elbow", of), np.array([0.006, -0.67])
    samples = np.abs(values) + np.random.default_rng(0).normal(size=(200, 2)) * [0.02, 0.03]
    assert gates._is_plain(spring, values, samples.clip(0))
    assert not gates._is_plain(spring, np.array([0.3, -0.67]), samples + np.array([0.3, 0.0]))
    named = {"stiffness": 0.006, "preload": -0.67}
    grounds = Grounds(1, 0, 0, 0, 0, 1, 1, 0, 30, plain=True)
    assert "nothing is seen" in gates._sentence(spring, named, grounds)
    assert "nothing is seen" not in gates._sentence(spring, named, dataclasses.replace(grounds, plain=False))
    assert probability(grounds, "joint_spring") < probability(dataclasses.replace(grounds, plain=False))


@pytest.mark.parametrize(("spread", "expected"), [(0.001, False), (0.003, False), (0.009, True)])
def test_play_whose_stated_interval_reaches_zero_may_be_a_soft_gear(spread, expected):
    """The bootstrap alone would call a gap of 0.02 ± 0.009 seen; the interval that is stated is wider."""
    play = Candidate(Backlash(), 1, "elbow", Backlash().parameters(arm(), address(), 1))
    values = np.array([0.02, 50.0])
    samples = values + np.random.default_rng(0).normal(size=(400, 2)) * [spread, 1.0]
    assert np.quantile(samples[:, 0], 0.025) > 0
    assert gates._is_plain(play, values, samples) is expected


@pytest.mark.parametrize(("given", "ends", "seen"), [(0.0, (0.01, 0.6), True), (0.0, (-0.6, -0.01), True),
                                                     (2.0, (1.9, 2.1), False), (2.0, (1.8, 1.9), True)])  # fmt: skip
def test_a_number_is_seen_where_its_interval_excludes_the_given_one_however_wide_it_is(given, ends, seen, monkeypatch):
    monkeypatch.setattr(gates, "widened", lambda value, low, high: ends)
    of = (Parameter("stiffness", "N·m/rad", given, 0, 9, 0.1), Parameter("preload", "N·m", 0.0, -9, 9, 0.1))
    values = np.array([np.mean(ends), -0.67])
    assert gates._is_plain(Candidate(JointSpring(), 0, "elbow", of), values, np.tile(values, (9, 1))) is not seen


@pytest.mark.parametrize(("unit", "seen"), [("N·m", False), ("N·m/rad", True)])
def test_a_number_that_is_next_to_nothing_of_another_in_its_unit_is_not_seen(unit, seen, monkeypatch):
    """Beside the largest of them."""
    monkeypatch.setattr(gates, "widened", lambda value, low, high: (0.01, 0.03))
    names = (("stiffness", unit), ("preload", "N·m"), ("rest", "N·m"))
    of = tuple(Parameter(name, its_unit, 0.0, -9, 9, 0.1) for name, its_unit in names)
    values = np.array([0.02, -0.67, 0.01])
    assert gates._is_plain(Candidate(JointSpring(), 0, "elbow", of), values, np.tile(values, (9, 1))) is not seen


def test_the_energy_of_a_term_is_what_its_joint_misses_without_it_beside_the_others():
    """A term with four of its joint's seven units of power has four sevenths; another joint's hum does not count."""
    one, two, rest, hum = np.linalg.qr(np.random.default_rng(0).normal(size=(400, 4)))[0].T * 20.0
    take = signals(np.stack([2 * one + np.sqrt(2) * two + rest, 9 * hum], -1))
    weigh = judge(take, candidate(Given("one", one)), candidate(Given("two", two)))
    best = weigh.score(weigh.bank.atoms)
    shares = [gates._energy_share(SimpleNamespace(judge=weigh, best=best), term) for term in best.fit.terms]
    assert shares == pytest.approx([4 / 7, 2 / 7], rel=1e-3)


def test_a_term_accounts_for_a_share_of_its_own_joint_and_for_no_more_than_all_nor_less_than_nothing():
    """Residuals of stretches: bare 1 + 3 on the second joint; the first joint's are another story."""
    term, other = (SimpleNamespace(candidate=SimpleNamespace(joint=1)) for _ in range(2))
    fit = lambda *left: SimpleNamespace(residual=np.array([[9.0, 9.0], left]), terms=[term, other])  # noqa: E731
    asked = []
    for without, best, share in (((1.0, 2.0), (0.5, 0.5), 0.5), ((5.0, 2.0), (0.5, 0.5), 1.0),
                                 ((0.2, 0.2), (0.5, 0.5), 0.0)):  # fmt: skip
        bank = SimpleNamespace(fit=lambda atoms, without=without: asked.append(atoms) or fit(*without))
        part = SimpleNamespace(
            judge=SimpleNamespace(bank=bank, bare=fit(1.0, 3.0)), best=SimpleNamespace(fit=fit(*best))
        )
        assert gates._energy_share(part, term) == pytest.approx(share)
    assert asked == [[other]] * 3


@pytest.mark.parametrize(("more", "said"), [(0.01, True), (-0.01, False)])
def test_a_term_of_another_strength_on_each_recording_stands_in_for_something(more, said):
    dry = Candidate(CoulombFriction(), 1, "elbow", CoulombFriction().parameters(arm(), address(), 1))
    grounds = Grounds(1, 0, 0, SEARCH.invariant + more, 0, 1, 1, 0, 30)
    assert ("on each" in gates._sentence(dry, {"torque": 0.5, "turnover": 0.0}, grounds)) is said


def test_what_makes_no_sense_is_hardly_believed_and_what_stands_beside_it_more():
    sure = Grounds(1, 0, 0, 0, 0, 1, 1, 0, 30)
    odd, beside = (dataclasses.replace(sure, **{how: True}) for how in ("senseless", "leans"))
    assert probability(odd) == STATEMENT.senseless < probability(beside) <= probability(sure)
    of = tuple(Parameter(n, "N·m", 0.0, 0.0, 9.0, 0.1) for n in ("coulomb", "stribeck", "stribeck_speed"))
    law = Candidate(StribeckFriction(), 0, "elbow", of)
    assert law.effect.is_physical(of, np.array([0.5, 0.5, 0.1]))
    assert not law.effect.is_physical(of, np.array([0.0, 0.5, 0.1]))
    named = {"coulomb": 0.0, "stribeck": 0.5, "stribeck_speed": 0.1}
    assert "stands in for something else" in gates._sentence(law, named, odd)


@pytest.mark.parametrize(
    ("after", "before", "expected"),
    [
        (STATEMENT.near_floor + 0.1, 20.0, True),
        (STATEMENT.near_floor - 0.1, 20.0, False),  # near the floor: drives' filters leave as much
        (STATEMENT.near_floor + 0.1, 200.0, False),  # a bearing that is no formula leaves a little of much
    ],
)
def test_a_joint_is_far_beyond_eight_floors_and_a_tenth_of_what_it_was(after, before, expected):
    rows = {
        "elbow": {"before": before, "after": after, "floor": 1.0},
        "wrist": {"before": 9.0, "after": 1.0, "floor": 1.0},
    }
    near = Score(1, 1, 1, 0, {"elbow": {"before": before, "after": 1.0, "floor": 1.0}})
    assert ("elbow" in far_joints([Score(1, 1, 1, 0, rows), near])) is expected  # in one of the splits is enough
    assert "wrist" not in far_joints([Score(1, 1, 1, 0, rows), near])
    assert far_joints([]) == frozenset()


def test_beside_a_simulation_that_is_far_off_a_name_is_believed_less_and_says_so():
    sure = Grounds(1, 0, 0, 0, 0, 1, 1, 0, 30)
    off = dataclasses.replace(sure, far=True)
    assert probability(off) < probability(sure)
    dry = Candidate(CoulombFriction(), 1, "elbow", CoulombFriction().parameters(arm(), address(), 1))
    named = {"torque": 0.5, "turnover": 0.0}
    assert "some law is another" in gates._sentence(dry, named, off)
    assert "some law is another" not in gates._sentence(dry, named, sure)


def test_no_name_is_stated_above_its_share_of_the_evidence():
    sure = Grounds(1, 0, 0, 0, 0, 1, 1, 0, 30)
    assert probability(dataclasses.replace(sure, share=0.55)) <= 0.55 < probability(sure)


@given(likely=st.floats(0, 1), shares=st.lists(st.floats(1e-6, 1), min_size=2, max_size=6))
def test_rivals_share_by_the_odds_and_have_no_more_than_the_finding(likely, shares):
    own, *others = np.array(shares) / sum(shares)
    has = [rival_probability(likely, own, share) for share in others]
    assert likely + sum(has) <= 1 + 1e-9
    assert all(0 <= p <= likely for p in has)
    assert np.all(np.diff(np.array(has)[np.argsort(others)]) >= 0)
    if likely <= own and max(others) <= own:  # nothing speaks for anything but the shares
        np.testing.assert_allclose(has, likely * np.array(others) / own)


def test_the_summary_says_the_most_important_first():
    text = summarise("explained", [FINDING], WHERE, score(0.0), True, 0.04)
    assert text[0] == FINDING.sentence
    assert text[1] == "80 % of the error arises at elbow; it is densest when moving backwards."
    assert text[2].startswith("Over 0.5 s windows of recordings kept aside the error falls to 10 %")
    assert "the correction leaves 4 % of its energy above the sensors' floor" in text[2]
    other = (Location("wrist", "everywhere", 0.9, (0.8, 1.0)), *WHERE)
    assert summarise("explained", [FINDING], other, None, True, 0.0)[1] == "90 % of the error arises at wrist."
    other = (*other, Location("wrist", "at rest", 0.1, (0.0, 0.2)))  # of the joint with the error, not of any
    assert summarise("explained", [FINDING], other, None, True, 0.0)[1].endswith("at wrist; it is densest at rest.")
    even = dataclasses.replace(FINDING, probability=STATEMENT.likely)
    told = summarise("unexplained", [FINDING, even], (), None, True, 0.5)
    assert told[1] == "Not identified at elbow; coulomb friction fits best, at 50 %."
    assert summarise("explained", [dataclasses.replace(FINDING, probability=0.6)], (), None, True, 0.0) == text[:1]
    assert "none were kept aside" in summarise("explained", [FINDING], WHERE, score(0.0), False, 0.04)[2]
    quarter = summarise("explained", [FINDING], WHERE, Score(4.0, 1.0, 0.1, 0.0, {}), True, 0.5)[2]
    assert "falls to 25 %" in quarter
    assert "50 % of its energy" in quarter
    twice = (*WHERE, dataclasses.replace(WHERE[1], regime="at rest"))  # the first is the densest
    assert "densest when moving backwards." in summarise("explained", [FINDING], twice, None, True, 0.0)[1]
    assert summarise("explained", [FINDING], WHERE[:1], None, True, 0.0)[1] == "80 % of the error arises at elbow."


@pytest.mark.parametrize(
    ("regime", "said"),
    [
        ("moving backwards", "when moving backwards"),
        ("accelerating", "when accelerating"),
        ("slower than 1 rad/s", "when slower than 1 rad/s"),
        ("faster than 1 rad/s", "when faster than 1 rad/s"),
        ("position above 1 rad", "with position above 1 rad"),
        ("load above 1 N·m", "with load above 1 N·m"),
        ("command above 1 N·m", "with command above 1 N·m"),
        ("at rest", "at rest"),
    ],
)
def test_where_the_error_is_densest_is_said_in_words(regime, said):
    where = (WHERE[0], dataclasses.replace(WHERE[1], regime=regime))
    assert f"; it is densest {said}." in summarise("explained", [FINDING], where, None, True, 0.0)[1]


@pytest.mark.parametrize("rivals", [(), (Rival("backlash", "elbow", 0.1, "hang a weight on elbow"),)])
@pytest.mark.parametrize("of_class", [0.3, 0.9])
def test_what_is_not_likely_is_not_identified_and_the_summary_says_what_would(rivals, of_class):
    vague = dataclasses.replace(
        FINDING, probability=0.2, rivals=rivals, class_name="friction", class_probability=of_class
    )
    first, would, *_ = summarise("unexplained", [vague], WHERE, None, True, 1.0)
    assert FINDING.sentence not in first
    assert first.startswith("Likely missing at elbow: friction (90 %)" if of_class > 0.5 else "Not identified at elbow")
    assert would.startswith("What would identify it: " + ("hang a weight on elbow." if rivals else "each joint alone"))
    assert not any("identif" in line for line in summarise("explained", [FINDING], WHERE, None, True, 0.0))


def test_what_is_not_identified_may_be_of_the_robot_of_a_class_of_ones_own_and_be_told_by_the_first_experiment():
    rivals = tuple(Rival(name, None, 0.1, f"swing for {name}") for name in ("backlash", "stribeck_friction"))
    whole = dataclasses.replace(
        FINDING, joint=None, probability=0.2, rivals=rivals, class_name="odd_physics", class_probability=0.9
    )
    first, would = gates.not_identified([whole])
    assert first.startswith("Likely missing at the robot: odd physics (90 %)")
    assert would == "What would identify it: swing for backlash."


def test_classes_that_are_hardly_probable_are_counted_and_not_told_one_by_one():
    of = [
        dataclasses.replace(FINDING, probability=0.01, joint=joint, class_name=name, class_probability=p)
        for joint, name, p in (("hip", "friction", 0.3), ("hip", "friction", 0.01), ("knee", "inertia", 0.04),
                               ("ankle", "inertia", 0.02))
    ]  # fmt: skip
    first, rest, would = gates.not_identified(of)
    assert first.startswith("Not identified at hip")
    assert rest == "2 more have less than 5 %."
    assert would.startswith("What would identify it")
    only, rest, _ = gates.not_identified(of[2:])  # the first is told in any case
    assert (only[:22], rest) == ("Not identified at knee", "1 more has less than 5 %.")
    assert len(gates.not_identified(of[:1])) == 2


def test_the_summary_of_no_finding_tells_nothing_missing_from_unexplained():
    assert summarise("nothing_missing", [], WHERE, score(0.0), True, 0.0) == (
        "Nothing is missing: the model follows the recordings as closely as the sensors' noise allows.",
    )
    assert "no effect of the catalogue explains how" in summarise("unexplained", [], WHERE, score(1.0), True, 1.0)[0]


def test_a_model_that_nothing_is_missing_from_is_told_with_its_distance_from_the_floor_where_that_is_far():
    def scored(wrist):
        rows = {"elbow": (2.0, 1.9), "wrist": (wrist, 0.5)}
        return Score(9.0, 9.0, 1.0, 0.0, {n: {"before": e, "after": e, "floor": f} for n, (e, f) in rows.items()})

    near, far = (summarise("nothing_missing", [], WHERE, scored(wrist), True, 0.0) for wrist in (0.74, 1.2))
    assert near == summarise("nothing_missing", [], WHERE, None, False, 0.0)
    assert far == (
        "Nothing is missing that the torques show, within the tolerances of the model's numbers: its error at wrist is "
        "2.4 times what the sensors' noise allows.",
    )


def test_a_joint_is_as_far_above_its_floor_as_in_the_worst_of_the_scores():
    def scored(**before):
        return Score(1, 1, 1, 0, {name: {"before": b, "after": 1.0, "floor": 0.5} for name, b in before.items()})

    assert gates._above_floor([scored(elbow=1.0, wrist=3.0), scored(elbow=4.0)]) == {"elbow": 8.0, "wrist": 6.0}


@pytest.mark.parametrize(("before", "expected"), [(1.2, True), (4.0, False)])
def test_a_gear_is_not_read_from_the_noise_of_a_joint_that_the_given_model_follows(before, expected):
    seen = gates._above_floor([Score(1, 1, 1, 0, {"elbow": {"before": before, "after": 1.0, "floor": 1.0}})])
    compliance, dry = (
        Candidate(effect, 1, "elbow", effect.parameters(arm(), address(), 1))
        for effect in (Compliance(), CoulombFriction())
    )
    assert gates._is_noise(compliance, seen) is expected
    assert not gates._is_noise(compliance, {})  # of a joint that no score tells of
    assert not gates._is_noise(dry, seen)


def friction(values, nominal=0.0):
    parameters = tuple(Parameter(f"p{k}", "1", nominal, 0.0, 2.0, 0.5) for k in range(len(values)))
    return Candidate(CoulombFriction(), 1, "elbow", parameters)


def test_a_finding_is_as_sure_as_the_surest_of_its_numbers_in_deviations_of_its_draws():
    samples = np.array([[1.0, 0.4], [3.0, 0.6]])  # deviations 1 and 0.1
    assert gates._certainty(friction((2.0, 0.5)), np.array([2.0, 0.5]), samples) == pytest.approx(5.0)
    assert gates._certainty(friction((2.0, 0.5)), np.array([-7.0, 0.1]), samples) == pytest.approx(7.0)
    off = np.array([1.5, 1.0])  # from what is given; not from zero
    assert gates._certainty(friction(off, nominal=1.0), off, samples) == pytest.approx(0.5)
    still = np.ones((3, 1))  # draws that are all alike do not make it certain beyond a thousandth of its scale
    assert gates._certainty(friction((1.0,)), np.array([0.5]), still) == pytest.approx(1000.0)


def test_an_interval_ends_at_the_bounds_of_its_parameter():
    p = Parameter("p", "1", 0.0, 0.0, 2.0, 1.0)
    assert gates._within(p, (-0.5, 1.5)) == (0.0, 1.5)
    assert gates._within(p, (0.5, 2.5)) == (0.5, 2.0)


def terms():
    """Dry friction and a soft gear of the elbow, and dry friction of the wrist."""
    where = ((CoulombFriction(), 1, "elbow"), (Compliance(), 1, "elbow"), (CoulombFriction(), 2, "wrist"))
    return [Candidate(*each, (Parameter("torque", "N·m", 0.0, 0.0, 1.2, 1.0),)) for each in where]


def test_effects_are_alike_that_are_of_one_class_on_one_joint():
    dry, soft, elsewhere = terms()
    stribeck = Candidate(StribeckFriction(), 1, "elbow", dry.parameters)
    assert [gates._is_alike(c, dry) for c in (stribeck, soft, elsewhere)] == [True, False, False]


def test_what_the_fit_says_of_a_term_is_stated_with_its_own_numbers_rivals_and_class(monkeypatch):
    one, beside, far = terms()
    rival = Candidate(StribeckFriction(), 1, "elbow", one.parameters)
    faint = Candidate(JointSpring(), 1, "elbow", one.parameters)
    h = Hypothesis((beside, one, far))
    samples = np.stack([np.linspace(*ends, 201) for ends in ((0.1, 0.3), (0.8, 1.0), (0.4, 0.6))], 1)
    fitted = Fitted(h, np.array([0.2, 0.9, 0.5]), samples, 0.0)
    best = SimpleNamespace(fit=SimpleNamespace(terms=[], strain=3.0))
    bank = SimpleNamespace(prediction=lambda fit, term: f"torque of {term.candidate.effect.name}")
    part = SimpleNamespace(
        judge=SimpleNamespace(bank=bank),
        best=best,
        motion=False,
        left_of=lambda c: 0.11 * c.joint,
        excess_of=lambda c: 0.7 * c.joint,
    )
    grounds, of_class, asked = [], [], []
    monkeypatch.setattr(gates, "_sentence", lambda candidate, named, grounds: str(named))
    monkeypatch.setattr(gates, "scatter", lambda *told: asked.append(told) or 0.05)
    monkeypatch.setattr(gates, "_energy_share", lambda *told: asked.append(told) or 0.6)
    monkeypatch.setattr(gates, "_certainty", lambda *told: asked.append(told) or 7.0)
    monkeypatch.setattr(gates, "_is_plain", lambda *told: asked.append(told) or True)
    monkeypatch.setattr(gates, "regime_of", lambda b, explained, joint, name: f"{b is bank}, {explained} of {joint}")
    monkeypatch.setattr(gates, "probability", lambda g, effect: grounds.append(g) or 0.4)
    monkeypatch.setattr(gates, "rival_probability", lambda likely, own, share: share / own * likely)
    monkeypatch.setattr(gates, "class_probability", lambda *told: of_class.append(told) or told[1])
    rated = [
        SimpleNamespace(atom=SimpleNamespace(candidate=c), share=share)
        for c, share in ((rival, 0.3), (one, 0.6), (faint, 0.02))
    ]
    term = SimpleNamespace(candidate=one)
    found = gates._finding(
        part, term, fitted, one, rated, 0.3, {beside.key}, frozenset({"wrist"}), 0.85, ["elbow", "elbow"],
        {(one.effect.family, "elbow"): 0.4, (one.effect.family, "wrist"): 0.9},
    )  # fmt: skip
    (g,) = grounds
    assert (g.sure, g.plain, g.closes, g.asked) == (7.0, True, 0.85, 0.4)
    assert asked[:2] == [(bank, best.fit, term), (part, term)]
    for c, values, drawn in asked[2:]:
        assert c is one
        assert values.tolist() == [0.9]
        np.testing.assert_array_equal(drawn, samples[:, 1:2])
    assert (found.energy_share, found.grounds, found.class_name) == (0.6, g.to_json(), one.effect.family)
    assert (g.share, g.left, g.excess, g.scatter, g.open, g.energy) == (0.6, 0.11, 0.7, 0.05, 0.3, 0.6)
    assert (g.terms, g.strain, g.senseless, g.leans, g.far) == (2, 3.0, False, True, False)
    assert (found.effect, found.joint, found.probability) == ("coulomb_friction", "elbow", 0.4)
    assert found.parameters["torque"].value == 0.9
    low, high = found.parameters["torque"].ci95
    assert low < 0.805
    assert 0.995 < high <= 1.2
    assert [(r.effect, r.joint, r.probability) for r in found.rivals] == [
        ("stribeck_friction", "elbow", pytest.approx(0.2))
    ]
    assert found.sentence == "{'torque': 0.9}"
    assert of_class == [(0.4, pytest.approx(0.6), pytest.approx(0.7), 0.85)]
    assert found.class_probability == pytest.approx(0.4 + 0.2)  # with what is of its class, not with the spring
    assert found.law_probability == pytest.approx(0.4 / 0.6)
    assert found.regime == "True, torque of coulomb_friction of 1"
    alike = Candidate(Backlash(), 1, "elbow", one.parameters)
    assert gates._is_alike(alike, beside)
    beside_it = gates._finding(
        part, SimpleNamespace(candidate=beside), fitted, beside,
        [SimpleNamespace(atom=SimpleNamespace(candidate=c), share=0.5) for c in (beside, alike)], 0.3, {beside.key},
        frozenset({"elbow"}), 1.0, ["elbow"], {(one.effect.family, "elbow"): 0.4},
    )  # fmt: skip
    assert (grounds[1].senseless, grounds[1].leans, grounds[1].far) == (True, False, True)
    assert grounds[1].asked < 0  # the motion was not asked about its class
    assert beside_it.class_probability == beside_it.probability  # nonsense speaks for no class
    monkeypatch.setattr(gates, "probability", lambda g, effect: 0.0)
    assert (
        gates._finding(part, term, fitted, one, rated[1:2], 0.3, (), frozenset(), 1.0, [], None).law_probability == 0.0
    )


@pytest.mark.parametrize(
    ("doubts", "said"),
    [
        ({}, None),
        ({"closes": 0.03}, "closes only 3 % of the simulation's error"),
        ({"closes": 0.51}, None),
        ({"far": True}, "some law is another"),
        ({"closes": 0.03, "far": True}, "closes only"),
        ({"plain": True, "closes": 0.03}, "nothing is seen"),
        ({"senseless": True, "closes": 0.03}, "stands in for something else"),
    ],
)
def test_a_sentence_says_the_first_doubt(doubts, said):
    effect = SimpleNamespace(
        name="drag", sentence=lambda joint, named, parameters: f"Drag {named['torque']} at {joint}."
    )
    drag = SimpleNamespace(effect=effect, where="elbow", parameters=())
    sure = Grounds(share=1, left=0, excess=0, scatter=0, open=0, energy=1, terms=1, strain=0, sure=9)
    sentence = gates._sentence(drag, {"torque": 0.5}, dataclasses.replace(sure, **doubts))
    assert sentence.startswith("Drag 0.5 at elbow.")
    assert (sentence == "Drag 0.5 at elbow.") if said is None else (said in sentence)


@pytest.mark.parametrize(
    ("chosen", "senseless", "far", "expected"),
    [
        (0, (1,), ("wrist",), (2, True, False)),  # what makes no sense on the same joint leans on it
        (0, (2,), ("elbow",), (2, False, True)),
        (0, (0,), (), (2, False, False)),  # no term on itself
        (3, (), ("wrist",), (4, False, True)),  # of the whole robot is what any joint lacks
        (3, (), (), (4, False, False)),
        (2, (1,), ("elbow",), (1, False, False)),
    ],
)
def test_terms_beside_a_finding_are_those_of_its_own_joint_and_of_the_robot_all(
    chosen, senseless, far, expected, monkeypatch
):
    everywhere = Candidate(GravityTilt(), 0, None, terms()[0].parameters)
    h, grounds = Hypothesis((*terms(), everywhere)), []
    c = h.terms[chosen]
    fitted = Fitted(h, np.full(4, 0.5), np.tile(np.linspace(0.4, 0.6, 21)[:, None], 4), 0.0)
    bank = SimpleNamespace(prediction=lambda fit, term: None)
    part = SimpleNamespace(
        judge=SimpleNamespace(bank=bank), best=SimpleNamespace(fit=SimpleNamespace(strain=0.0)),
        left_of=lambda c: 0.0, excess_of=lambda c: 0.0, motion=False,
    )  # fmt: skip
    monkeypatch.setattr(gates, "_sentence", lambda *_: "")
    monkeypatch.setattr(gates, "scatter", lambda *_: 0.0)
    monkeypatch.setattr(gates, "_energy_share", lambda *_: 1.0)
    monkeypatch.setattr(gates, "regime_of", lambda *_: "everywhere")
    monkeypatch.setattr(gates, "probability", lambda g, effect: grounds.append(g) or 0.4)
    rated = [SimpleNamespace(atom=SimpleNamespace(candidate=c), share=1.0)]
    without = {h.terms[k].key for k in senseless}
    term, places = SimpleNamespace(candidate=c), [c.joint_name for c in h.terms]
    gates._finding(part, term, fitted, c, rated, 0.0, without, frozenset(far), 1.0, places, None)
    gates._finding(part, term, fitted, c, rated, 0.0, without, frozenset(far), None, [c.joint_name], None)
    g, alone = grounds
    assert (g.terms, g.leans, g.far) == expected
    assert (alone.terms, alone.closes) == (1, 1.0)  # what is not stated does not count, nor what was not asked


def part_of(*candidates, joints=False):
    """A proposal with these terms."""
    fit = SimpleNamespace(terms=[SimpleNamespace(candidate=c) for c in candidates])
    return SimpleNamespace(joints=joints, best=SimpleNamespace(fit=fit))


def test_the_worst_of_the_scores_says_how_much_is_open(monkeypatch):
    told = []
    one, *_ = terms()
    part = part_of(one)
    monkeypatch.setattr(gates, "_finding", lambda *a: told.append(a[5]) or FINDING)
    fitted = Fitted(Hypothesis((one,)), np.array([0.5]), np.full((3, 1), 0.5), 0.0)
    for scores in ([score(0.2), score(0.7)], []):
        gates.judge_findings([part], fitted, scores, {one.key: ()}, {})
    assert told == [pytest.approx(0.7), 1.0]


def test_each_term_of_each_part_is_stated_with_its_own_number_stand_ins_and_far_joints(monkeypatch):
    told, (dry, soft, elsewhere) = [], terms()
    drive, mechanics = part_of(soft), part_of(elsewhere, dry)
    kept = [dataclasses.replace(c) for c in (dry, soft, elsewhere)]  # as the fit has them, with bounds of its own
    fitted = Fitted(Hypothesis(tuple(kept)), np.full(3, 0.5), np.full((3, 3), 0.5), 0.0)
    monkeypatch.setattr(gates, "_finding", lambda *a: told.append(a) or FINDING)
    monkeypatch.setattr(gates, "far_joints", lambda scores: frozenset({f"far in {len(scores)}"}))
    sets = {c.key: f"beside {c.effect.name} of {c.joint_name}" for c in kept}
    gates.judge_findings(
        [drive, mechanics], fitted, [score(0.2, 4.0)], sets, {kept[0].key: 0.25}, "what the motion asks for"
    )
    expected = [(drive, soft, kept[1]), (mechanics, elsewhere, kept[2]), (mechanics, dry, kept[0])]
    for (part, term, own, chosen, rated, _, _, far, closes, beside, asked), (its_part, c, its_own) in zip(
        told, expected, strict=True
    ):
        assert part is its_part
        assert asked == "what the motion asks for"
        assert (term.candidate, chosen) == (c, its_own)
        assert chosen is its_own
        assert (own, rated, far) == (fitted, sets[c.key], {"far in 1"})
        assert closes == (0.25 if chosen is kept[0] else None)
        assert beside == [c.joint_name for c in kept]


@pytest.mark.parametrize(("gear", "friction", "before", "senseless"),
                         [(0.5, 0.5, 1.2, {"compliance"}), (0.5, 0.5, 4.0, set()), (-1.0, 0.5, 4.0, {"compliance"}),
                          (0.5, -1.0, 4.0, {"coulomb_friction"})])  # fmt: skip
def test_what_no_robot_has_and_a_gear_in_the_noise_make_no_sense_each_alone(
    gear, friction, before, senseless, monkeypatch
):
    told, (dry, soft, _) = [], terms()
    for effect in (CoulombFriction, Compliance):
        monkeypatch.setattr(effect, "is_physical", lambda self, parameters, values: values[0] > 0)
    monkeypatch.setattr(gates, "_finding", lambda *a: told.append(a[6]) or FINDING)
    part = part_of(dry)
    fitted = Fitted(Hypothesis((dry, soft)), np.array([friction, gear]), np.zeros((3, 2)), 0.0)
    gates.judge_findings([part], fitted, [score(0.2, before)], {dry.key: ()}, {})
    assert told == [{(name, "elbow") for name in senseless}]


def test_findings_are_told_by_whole_per_cent_and_then_by_what_they_account_for(monkeypatch):
    one, *_ = terms()
    told = [
        dataclasses.replace(FINDING, probability=p, energy_share=e) for p, e in ((0.8, 0.9), (0.901, 0.2), (0.899, 0.6))
    ]
    left = list(told)
    monkeypatch.setattr(gates, "_finding", lambda *_: left.pop(0))
    part = part_of(one, one, one)
    fitted = Fitted(Hypothesis((one,)), np.array([0.5]), np.full((3, 1), 0.5), 0.0)
    found = gates.judge_findings([part], fitted, [score(0.2)], {one.key: ()}, {})
    assert found == (told[2], told[1], told[0])
    # of laws that are alike by whole per cent, what is likelier of its class
    left[:] = [dataclasses.replace(told[1], class_probability=c) for c in (0.3, 0.7, 0.5)]
    of_class = [f.class_probability for f in gates.judge_findings([part], fitted, [score(0.2)], {one.key: ()}, {})]
    assert of_class == [0.7, 0.5, 0.3]


def of_joint(effect, kind, joint="wrist", law=0.05, of_class=0.6, closes=0.9):
    return dataclasses.replace(
        FINDING, effect=effect, joint=joint, probability=law, class_name=kind, class_probability=of_class,
        law_probability=law / of_class, grounds={"closes": closes},
    )  # fmt: skip


def test_classes_that_the_standard_joints_need_at_one_joint_share_what_is_missing_there():
    findings = [
        of_joint("coulomb_friction", "friction", law=0.08),
        of_joint("viscous_friction", "friction", law=0.02, closes=0.6),
        of_joint("reflected_inertia", "inertia", law=0.06),
        of_joint("gain_mismatch", "control", law=0.04),
        of_joint("torque_offset", "torque", of_class=0.1, closes=0.2),  # the motion hardly needs it
        of_joint("reflected_inertia", "inertia", joint="elbow"),  # alone at its joint
    ]
    found = gates.one_class_of_each_joint(findings)
    assert [f.class_probability for f in found] == pytest.approx([0.5, 0.5, 0.3, 0.2, 0.1, 0.6])
    assert all(f.law_probability * f.class_probability == pytest.approx(f.probability) for f in found)
    sure = of_joint("coulomb_friction", "friction", law=0.4, of_class=0.4)
    other = of_joint("reflected_inertia", "inertia", law=0.6)
    assert gates.one_class_of_each_joint([sure, other])[0].class_probability == 0.4  # never less than its law


@pytest.mark.parametrize("joints", [True, False])
def test_only_the_standard_joints_classes_share(joints, monkeypatch):
    one, *_ = terms()
    monkeypatch.setattr(gates, "_finding", lambda *_: FINDING)
    monkeypatch.setattr(gates, "one_class_of_each_joint", lambda findings: [])
    fitted = Fitted(Hypothesis((one,)), np.array([0.5]), np.full((3, 1), 0.5), 0.0)
    part = part_of(one, joints=joints)
    assert gates.judge_findings([part], fitted, [score(0.2)], {one.key: ()}, {}) == (() if joints else (FINDING,))


def test_a_term_that_the_fit_does_not_have_is_not_stated(monkeypatch):
    one, *_ = terms()
    monkeypatch.setattr(gates, "_finding", lambda *_: FINDING)
    part = part_of(one)
    nothing = Fitted(Hypothesis(()), np.zeros(0), np.zeros((3, 0)), 0.0)
    assert gates.judge_findings([part], nothing, [score(0.2)], {one.key: ()}, {}) == ()
    fitted = Fitted(Hypothesis((one,)), np.array([0.5]), np.full((3, 1), 0.5), 0.0)
    assert gates.judge_findings([part], fitted, [score(0.2)], {}, {}) == ()  # nor what is not to be stated
    assert gates.judge_findings([part], fitted, [score(0.2)], {one.key: ()}, {}) == (FINDING,)


def test_a_refused_name_is_held_back_with_its_class_and_its_rivals_and_says_so():
    rival = Rival("coulomb_friction", "hip", 0.3, "")
    sure = Finding(
        "viscous_friction", "hip", 0.8, "Viscous.", {}, "", rivals=(rival,), energy_share=0.9,
        grounds={"share": 1.0}, class_probability=0.9, law_probability=0.8 / 0.9,
    )  # fmt: skip
    other = dataclasses.replace(sure, joint="knee", probability=0.6)
    first, second = gates.refused((sure, other), {("viscous_friction", "hip")})
    assert first is other
    assert (second.probability, second.class_probability, second.law_probability) == (STATEMENT.refused,) * 2 + (1.0,)
    assert [r.probability for r in second.rivals] == [STATEMENT.refused]
    assert second.sentence == "Viscous. Recordings that were kept aside refuse it."
    assert second.grounds["refused"]


@pytest.mark.parametrize(("backed", "rated_share", "most"), [(True, 0.3, 1.0), (False, 0.3, 0.3), (False, 0.9, 0.9)])
def test_what_only_the_motion_asks_for_has_its_share_among_what_that_would_take_in_its_place(
    monkeypatch, backed, rated_share, most
):
    one, _, elsewhere = terms()
    rival = dataclasses.replace(elsewhere, joint=1, joint_name="elbow", effect=JointSpring())
    h = Hypothesis((one,))
    fitted = Fitted(h, np.array([0.5]), np.linspace(0.4, 0.6, 21)[:, None], 0.0)
    term, grounds = SimpleNamespace(candidate=one), []
    part = SimpleNamespace(
        judge=SimpleNamespace(bank=SimpleNamespace(prediction=lambda fit, term: None)), motion=True,
        best=SimpleNamespace(fit=SimpleNamespace(strain=0.0)), left_of=lambda c: 0.0, excess_of=lambda c: 0.0,
        backing=lambda key: term if backed and key == one.key else None,
    )  # fmt: skip
    for name in ("scatter", "_energy_share"):
        monkeypatch.setattr(gates, name, lambda *_: 0.0)
    monkeypatch.setattr(gates, "_sentence", lambda *_: "")
    monkeypatch.setattr(gates, "regime_of", lambda *_: "everywhere")
    monkeypatch.setattr(gates, "probability", lambda g, effect: grounds.append(g) or 0.1)
    monkeypatch.setattr(gates, "class_probability", lambda *_: 0.95)
    rated = [
        SimpleNamespace(atom=SimpleNamespace(candidate=c), share=share)
        for c, share in ((one, rated_share), (rival, 1.0 - rated_share))
    ]
    found = gates._finding(part, term, fitted, one, rated, 0.0, (), frozenset(), 1.0, ["elbow"], {})
    assert grounds[0].overruled is not backed
    assert found.class_probability == pytest.approx(min(0.95, most))


def test_a_law_that_the_torques_do_not_speak_for_has_one_half_at_most():
    clear = Grounds(share=0.99, left=0, excess=0, scatter=0.01, open=0, energy=1, terms=1, strain=1, sure=30)
    assert probability(clear) > 0.8
    assert probability(dataclasses.replace(clear, overruled=True)) == 0.5
