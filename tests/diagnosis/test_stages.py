"""What a run may still spend, whose random numbers are whose, and what the evidence is made of."""

import time
from types import SimpleNamespace

import numpy as np
import pytest

from torchrl_athletic.diagnosis.deadline import Deadline
from torchrl_athletic.diagnosis.stages import Decided, Given, Ready, Run


def run(budget, gone):
    return Run(None, None, budget, time.monotonic() - gone)


def test_combinations_are_begun_in_the_first_six_tenths_of_the_time():
    assert not run(100.0, 59.0).late()
    assert run(100.0, 61.0).late()
    assert not run(None, 1e6).late()
    assert run(100.0, 31.0).late(0.3)
    assert not run(100.0, 29.0).late(0.3)
    assert not Run(None, None, 100.0).late()  # it starts as it is made


def test_what_is_left_is_a_share_of_the_time_or_all_but_what_is_kept_whichever_is_less():
    assert run(100.0, 10.0).left(0.6) == pytest.approx(50.0, abs=0.1)
    assert run(100.0, 10.0).left(0.9, kept=5.0) == pytest.approx(80.0, abs=0.1)
    assert run(100.0, 10.0).left(0.9, kept=30.0) == pytest.approx(60.0, abs=0.1)
    assert run(100.0, 10.0).left(1.0) == pytest.approx(90.0, abs=0.1)
    assert run(None, 10.0).left(0.6) is None


def test_joints_stand_in_the_order_of_the_first_recording():
    takes = tuple(SimpleNamespace(joint_names=names) for names in (("hip", "knee"), ("knee", "hip")))
    assert Given(None, "", "", takes, (), ()).joint_names == ("hip", "knee")


def test_a_deadline_is_over_when_its_time_is_and_a_part_of_it_began_when_it_did():
    now = time.monotonic()
    whole = Deadline(100.0, now - 30.0)
    assert whole.left == pytest.approx(70.0, abs=0.1)
    assert whole.part(0.5).left == pytest.approx(20.0, abs=0.1)
    assert whole.allows(60.0)
    assert not whole.allows(80.0)
    assert not whole.over
    assert whole.part(0.2).over
    assert Deadline().allows(1e9)


def test_each_purpose_has_random_numbers_of_its_own_by_the_seed():
    def drawn(seed, purpose):
        return Given(None, "", "", (), (), (), seed=seed).rng(purpose).random(4)

    np.testing.assert_array_equal(drawn(3, "maps"), drawn(3, "maps"))
    for other in (drawn(4, "maps"), drawn(3, "heldout")):
        assert (drawn(3, "maps") != other).all()


def test_a_set_that_was_not_kept_aside_is_no_split():
    assert Ready(None, "train", None).splits() == {"train": "train"}
    assert Ready(None, "train", "held").splits() == {"train": "train", "heldout": "held"}


def test_the_evidence_is_that_of_the_drive_and_then_of_what_was_chosen():
    trial = SimpleNamespace(proposal="mechanics")
    assert Decided(None, "drive", trial).evidence == ("drive", "mechanics")
    assert Decided(None, None, trial).evidence == ("mechanics",)
    assert Decided(None).evidence == ()
