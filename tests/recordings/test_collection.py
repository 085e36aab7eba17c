"""Takes are what was asked for, are watched, and leave the arm safe."""

from __future__ import annotations

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest

from torchrl_athletic.functional.actuation import pd_torque
from torchrl_athletic.recordings import (
    Excitation,
    ExcitationError,
    TakeStopped,
    Watchdog,
    beginning,
    gaussian,
    held,
    read_recordings,
    record,
    sine,
    through_poses,
    write_recording,
)

JOINTS = ("hip", "knee")
LIMIT = np.array([[-1.0, 1.0], [-2.0, 0.5]])
POSE, KP, KD = np.array([0.2, -0.5]), np.array([50.0, 20.0]), np.array([1.0, 0.5])
QUIET = Watchdog(10 * LIMIT, np.full(2, 1e3), np.full(2, 1e3))


class Follower:
    """An arm that is half way at its target with each command."""

    joint_names, rate = JOINTS, 200.0

    def __init__(self):
        self.stopped = 0

    def reset(self, pose, kp, kd):
        self.position, self.kp = np.array(pose), kp
        return self._report(np.zeros(2), np.zeros(2))

    def step(self, target):
        away = target - self.position
        self.position = self.position + 0.5 * away
        return self._report(0.5 * away * self.rate, self.kp * away)

    def stop(self):
        self.stopped += 1

    def _report(self, velocity, torque):
        return SimpleNamespace(position=self.position.copy(), velocity=velocity, torque=torque)


def wave(amplitude: float = 5.0, seconds: float = 1.0) -> Excitation:
    return sine(JOINTS, "hip", [(amplitude, 2.0)], seconds=seconds)


def test_a_held_pose_with_a_moving_target_is_the_same_torque_as_a_hold_and_a_wave():
    rng = np.random.default_rng(0)
    noise = gaussian(JOINTS, 2.0, seed=1, seconds=1.0)
    target = held(noise, POSE, KP, 10 * LIMIT).command
    q, v = rng.normal(size=(2, *target.shape))
    np.testing.assert_allclose(pd_torque(target, q, v, KP, KD), pd_torque(POSE, q, v, KP, KD) + noise.command)


def test_targets_stay_within_the_limits_and_the_note_says_how_often_they_were_cut():
    cut = held(wave(60.0), POSE, KP, LIMIT)
    assert cut.command[:, 0].max() == 1.0
    assert cut.metadata["clipped_targets"] == int((np.abs(0.2 + wave(60.0).command[:, 0] / 50.0) > 1.0).sum()) > 0
    assert held(wave(), POSE, KP, LIMIT).metadata["clipped_targets"] == 0
    assert (cut.command[:, 1] == -0.5).all()


@pytest.mark.parametrize(
    ("change", "advice"),
    [
        ({"excitation": replace(wave(), field="position_target")}, "Play it as it is"),
        ({"kp": np.array([50.0, 0.0])}, "Record torque commands instead"),
        ({"pose": np.array([0.2, 0.6])}, "knee is to be held at 0.6 rad, outside -2 to 0.5"),
        ({"pose": np.zeros(3)}, r"must be \(2,\), \(2,\) and \(2, 2\)"),
    ],
)
def test_a_hold_that_makes_no_sense_is_refused(change, advice):
    with pytest.raises(ExcitationError, match=advice):
        held(**{"excitation": wave(), "pose": POSE, "kp": KP, "position_limit": LIMIT, **change})


def test_a_motion_of_least_jerk_rests_in_its_poses_and_is_fastest_half_way():
    swing = through_poses(("hinge",), [(0.0, [0.0]), (1.0, [2.0]), (3.0, [-1.0])], rate=1000.0)
    speed = np.gradient(swing.command[:, 0], 1e-3)
    assert swing.command[[0, 1000], 0] == pytest.approx([0.0, 2.0])
    assert speed[[0, 1000, -1]] == pytest.approx([0.0, 0.0, 0.0], abs=1e-4)
    assert speed[:1000].max() == pytest.approx(1.875 * 2.0 / 1.0, rel=1e-4)
    assert int(np.argmax(speed[:1000])) == pytest.approx(500, abs=1)
    assert speed.min() == pytest.approx(-1.875 * 3.0 / 2.0, rel=1e-4)


@pytest.mark.parametrize("times", [(0.0,), (0.5, 1.0), (0.0, 1.0, 1.0)])
def test_poses_come_later_and_later_from_zero_on(times):
    with pytest.raises(ExcitationError, match="later and later, from 0 on"):
        through_poses(("hinge",), [(time, [0.0]) for time in times])


def test_each_row_was_read_before_its_target_was_sent():
    arm, take = Follower(), held(wave(), POSE, KP, LIMIT)
    recording = record(arm, take, POSE, KP, KD, QUIET)
    expected = [POSE]
    for target in take.command[:-1]:
        expected.append(0.5 * (expected[-1] + target))
    np.testing.assert_allclose(recording.position, expected)
    np.testing.assert_array_equal(recording.position_target, take.command)
    assert arm.stopped == 1


def test_a_take_carries_its_notes_through_a_file(tmp_path):
    take = held(wave(), POSE, KP, LIMIT)
    recording = record(Follower(), take, POSE, KP, KD, QUIET, {"kind": "sine", "repeat": 2})
    write_recording(recording, tmp_path / "take.npz")
    again = read_recordings(tmp_path / "take.npz")[0]
    assert again.metadata["segments"] == [{"start": 0.0, "amplitude": 5.0, "frequency": 2.0}]
    assert (again.metadata["kind"], again.metadata["repeat"], again.metadata["hold"]) == ("sine", 2, [0.2, -0.5])
    np.testing.assert_array_equal(again.kd, KD)
    assert again.torque_semantics == "current_derived"


@pytest.mark.parametrize(
    ("watchdog", "complaint"),
    [
        (replace(QUIET, position=np.array([[-1.0, 0.25], [-2.0, 0.5]])), "position of hip is .* limit is -1 to 0.25"),
        (replace(QUIET, velocity=np.array([0.2, 1e3])), "velocity of hip is .* limit is 0.2"),
        (replace(QUIET, torque=np.array([0.5, 1e3])), "torque of hip is .* limit is 0.5"),
    ],
)
def test_the_watchdog_stops_the_arm_and_says_why(watchdog, complaint):
    arm = Follower()
    with pytest.raises(TakeStopped, match=complaint):
        record(arm, held(wave(), POSE, KP, LIMIT), POSE, KP, KD, watchdog)
    assert arm.stopped == 1


def test_the_watchdog_sees_both_sides_and_what_is_no_number():
    watchdog, still = Watchdog(LIMIT, np.full(2, 3.0), np.full(2, 9.0)), np.zeros(2)
    watchdog.check(JOINTS, 0.0, still, still, still)
    for position, velocity, torque in (
        ([-1.1, 0.0], still, still), ([0.0, 0.6], still, still), (still, [0.0, -3.1], still),
        (still, still, [-9.1, 0.0]), (still, [np.nan, 0.0], still),
    ):  # fmt: skip
        with pytest.raises(TakeStopped, match="lower the amplitudes"):
            watchdog.check(JOINTS, 0.0, np.array(position), np.array(velocity), np.array(torque))


def test_an_arm_that_fails_is_stopped_too():
    arm = Follower()
    arm.step = lambda target: 1 / 0
    with pytest.raises(ZeroDivisionError):
        record(arm, held(wave(), POSE, KP, LIMIT), POSE, KP, KD, QUIET)
    assert arm.stopped == 1


@pytest.mark.parametrize(
    ("take", "advice"),
    [
        (wave(), r"Pass it through held\(\)"),
        (through_poses(("a", "b"), [(0.0, POSE), (1.0, POSE)]), "Make it with the arm's joint_names"),
        (through_poses(JOINTS, [(0.0, POSE), (1.0, POSE)], rate=100.0), "rate=200"),
    ],
)
def test_a_take_for_another_arm_is_refused_before_it_moves(take, advice):
    arm = Follower()
    with pytest.raises(ExcitationError, match=advice):
        record(arm, take, POSE, KP, KD, QUIET)
    assert not hasattr(arm, "position")


def test_the_beginning_of_a_take_is_its_first_samples_and_says_that_it_was_cut():
    whole = held(wave(), POSE, KP, LIMIT)
    part = beginning(whole, 0.25)
    np.testing.assert_array_equal(part.command, whole.command[:50])
    assert part.metadata["cut"] == 0.25
    assert beginning(whole, np.inf).metadata == whole.metadata
    with pytest.raises(ExcitationError, match="at least two"):
        beginning(whole, 0.005)
