"""What makes a joint worse where it was not fitted is taken back."""

from collections.abc import Callable
from dataclasses import replace
from types import SimpleNamespace

import mujoco
import numpy as np
import pytest
from diagnosis.plants import double_pendulum, pendulum, record, smooth_torque, take

from torchrl_athletic.diagnosis import diagnose, veto
from torchrl_athletic.diagnosis.fit import Hypothesis
from torchrl_athletic.diagnosis.screen import Candidate
from torchrl_athletic.diagnosis.veto import veto_sentence, vetoed
from torchrl_athletic.effects import CoulombFriction, JointAddress, ViscousFriction


def damped(xml: str, *joints: str) -> Hypothesis:
    """Viscous friction of some joints."""
    model = mujoco.MjModel.from_xml_string(xml)
    names = tuple(model.joint(k).name for k in range(model.njnt))
    address = JointAddress.of(model, names)
    effect = ViscousFriction()
    at = [names.index(joint) for joint in joints]
    return Hypothesis(tuple(Candidate(effect, j, names[j], effect.parameters(model, address, j)) for j in at))


@pytest.fixture(scope="module")
def swings():
    """A pendulum with the damping of its model, 0.05."""
    return [take(pendulum(), record(pendulum(), smooth_torque(6.0), start=0.5))]


def test_what_makes_a_joint_worse_is_taken_back(swings):
    h = damped(pendulum(), "pendulum")
    gone = vetoed(h, np.array([0.4]), swings, np.random.default_rng(0), np.array([1e-5]))
    assert gone == h.terms
    assert "pendulum" in veto_sentence(gone, ["pendulum"])


def test_what_helps_stays_and_nothing_is_said():
    truth = pendulum(joint='damping="0.3"')
    takes = [take(pendulum(), record(truth, smooth_torque(6.0), start=0.5))]
    h = damped(pendulum(), "pendulum")
    assert vetoed(h, np.array([0.28]), takes, np.random.default_rng(0), np.array([1e-5])) == ()
    assert veto_sentence((), ["pendulum"]) == ""


def test_what_noise_hides_is_no_harm(swings):
    h = damped(pendulum(), "pendulum")
    assert vetoed(h, np.array([0.05005]), swings, np.random.default_rng(0), np.array([1e-3])) == ()


def test_one_joint_keeps_its_correction_where_the_other_loses_it():
    xml = double_pendulum().replace('name="upper" axis="0 -1 0"', 'name="upper" axis="0 -1 0" damping="0.01"')
    truth = xml.replace('damping="0.01"', 'damping="0.2"')
    takes = [take(xml, record(truth, np.zeros((600, 2)), start=np.array([0.5, 0.3])))]
    h = damped(xml, "upper", "lower")
    gone = vetoed(h, np.array([0.2, 1.0]), takes, np.random.default_rng(0), np.full(2, 1e-5))
    assert [c.joint_name for c in gone] == ["lower"]


def test_a_diagnosis_takes_back_what_recordings_kept_aside_contradict():
    """The pendulum was braked while it was fitted, and is free in what was kept aside."""
    braked = pendulum(joint='damping="0.05" frictionloss="0.15"')
    train, held = (
        record(xml, smooth_torque(6.0, seed=seed), start=0.6, seed=seed)
        for seed, xml in enumerate((braked, pendulum()))
    )
    diagnosis = diagnose(pendulum(), [train], [held])
    score = diagnosis.answer.fit["heldout"]
    assert score.after <= score.before
    assert any("taken back" in sentence for sentence in diagnosis.answer.summary)
    assert diagnosis.corrected.hypothesis.terms == ()


def test_what_is_taken_back_is_said_of_joints_where_something_was_corrected_and_of_the_whole_robot():
    def term(joint):
        return SimpleNamespace(joint_name=joint, where=joint or "the robot")

    gone = [term("elbow"), term("wrist"), term(None), term("elbow")]
    assert "corrected at elbow, the robot is taken back" in veto_sentence(gone, ["elbow", "hip"])
    assert veto_sentence(gone[1:2], ["elbow"]) == ""


# --- on errors that are given, so that who is worst and what helps is known ---

UPPER, LOWER = damped(double_pendulum(), "upper", "lower").terms
LOW_DRY = replace(LOWER, effect=CoulombFriction())
ROBOT = replace(UPPER, joint_name=None)


@pytest.fixture
def taken_back(monkeypatch):
    """What is taken back where the error of each joint is a function of the numbers, all of them 1 at first."""
    monkeypatch.setattr(veto, "draw_windows", lambda *_: [None])
    monkeypatch.setattr(veto, "well_started", lambda w: w)
    monkeypatch.setattr(veto, "simulate", lambda w, build, rows: rows)

    def asked(h: Hypothesis, error: Callable[[np.ndarray], list[float]], floor=1e-9) -> tuple[Candidate, ...]:
        monkeypatch.setattr(veto, "window_rmse", lambda windows, moved: np.array([error(moved[0])]))
        values = np.ones(len(h.parameters))
        gone = vetoed(h, values, [], np.random.default_rng(0), np.full(2, floor))
        assert values.tolist() == [1.0] * len(values)  # the correction itself is somebody else's to change
        return gone

    return asked


def test_where_joint_after_joint_would_go_what_helps_without_the_others_is_put_back(taken_back):
    """The lower joint's numbers harm it a little; without them the upper's harm, unless the robot's go as well."""

    def error(x):
        upper, lower, robot = x != 0
        harmed = 1.1 if lower else 2.0 if upper and robot else 1.0
        return [0.2 if upper and not robot else 1.0, harmed]

    h = Hypothesis((UPPER, LOWER, ROBOT))
    assert set(taken_back(h, error)) == {LOWER, ROBOT}


def test_where_nothing_helps_alone_all_goes(taken_back):
    h = Hypothesis((UPPER, LOWER))
    assert set(taken_back(h, lambda x: [2.0, 2.0] if x.any() else [1.0, 1.0])) == {UPPER, LOWER}


@pytest.mark.parametrize(("worst", "terms"), [(0, (UPPER,)), (1, (LOWER,))])
def test_the_joint_that_got_worst_beside_its_own_error_goes_first_and_may_cure_the_other(worst, terms, taken_back):
    """Both got worse; without the one whose error has tripled nobody is, without the other that one still is."""
    given = np.array([100.0, 100.0])
    given[worst] = 1.0  # three times a small error is less than twice a large one

    def error(x):
        times = np.ones(2)
        if x[worst]:
            times[worst], times[1 - worst] = 3.0, 2.0 if x[1 - worst] else 1.0
        return given * times

    assert taken_back(Hypothesis((UPPER, LOWER)), error) == terms


def test_all_of_a_joint_goes_together_trims_too_and_nothing_of_another(taken_back):
    """Halves of a correction may be worse than none, so that no half stays although it does no harm alone."""
    h = Hypothesis((UPPER, LOWER), (LOW_DRY,))
    gone = taken_back(h, lambda x: [1.0, 2.0 if x[1] and x[2] else 1.0])
    assert gone == (LOWER, LOW_DRY)


def test_what_belongs_to_the_whole_robot_goes_once_nothing_of_the_joint_is_left(taken_back):
    h = Hypothesis((LOWER, ROBOT))
    assert taken_back(h, lambda x: [1.0, 2.0 if x[1] else 1.0]) == (ROBOT,)  # the joint's went first, and came back
    assert taken_back(h, lambda x: [2.0 if x[1] else 1.0, 1.0]) == (ROBOT,)  # which the lower joint has no part in


def test_a_joint_that_another_makes_worse_costs_that_ones_correction(taken_back):
    assert taken_back(Hypothesis((LOWER,)), lambda x: [2.0 if x[0] else 1.0, 1.0]) == (LOWER,)


@pytest.mark.parametrize(("after", "floor", "goes"), [(1.009, 0.1, False), (1.02, 0.1, True), (1.02, 0.9, False)])
def test_a_hundredth_more_and_a_fifth_over_the_noise_are_how_windows_fall(after, floor, goes, taken_back):
    gone = taken_back(Hypothesis((LOWER,)), lambda x: [1.0, after if x[0] else 1.0], floor)
    assert bool(gone) is goes


def test_a_number_that_is_taken_back_is_the_models_own(taken_back):
    """Which need not be zero: a joint has some damping already."""
    own = replace(LOWER, parameters=tuple(replace(p, nominal=0.25) for p in LOWER.parameters))
    seen = []
    gone = taken_back(Hypothesis((UPPER, own)), lambda x: seen.append(x.tolist()) or [1.0, 1.0 + abs(x[1] - 0.25)])
    assert gone == (own,)
    assert seen == [[0.0, 0.25], [1.0, 1.0], [1.0, 0.25]]  # the given model, the correction, what is left of it


def test_a_place_is_named_once_however_much_of_it_goes():
    assert "corrected at lower is taken back" in veto_sentence([LOWER, LOW_DRY], ["lower"])


def test_both_scores_are_over_the_windows_of_the_stated_one_well_started(monkeypatch):
    rng, drawn, seen = np.random.default_rng(3), [], []
    monkeypatch.setattr(veto, "draw_windows", lambda *asked: drawn.append(asked) or ["one", "other"])
    monkeypatch.setattr(veto, "well_started", lambda w: f"{w}, started")
    monkeypatch.setattr(veto, "simulate", lambda w, build, rows: rows)
    monkeypatch.setattr(veto, "window_rmse", lambda windows, moved: seen.append(windows) or np.ones((1, 2)))
    assert vetoed(Hypothesis((UPPER,)), np.ones(1), ["take"], rng, np.zeros(2)) == ()
    assert drawn == [(["take"], veto.WINDOW, veto.MOST_WINDOWS, rng)]
    assert seen == [["one, started", "other, started"]] * 2
