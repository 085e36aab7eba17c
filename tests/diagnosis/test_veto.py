"""What makes a joint worse where it was not fitted is taken back."""

from types import SimpleNamespace

import mujoco
import numpy as np
import pytest
from diagnosis.plants import double_pendulum, pendulum, record, smooth_torque, take

from torchrl_athletic.diagnosis import diagnose
from torchrl_athletic.diagnosis.fit import Hypothesis
from torchrl_athletic.diagnosis.screen import Candidate
from torchrl_athletic.diagnosis.veto import veto_sentence, vetoed
from torchrl_athletic.effects import JointAddress, ViscousFriction


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
