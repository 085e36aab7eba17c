"""On a new grid nothing is shifted, lost or made up."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from torchrl_athletic.recordings import Recording, RecordingError, resample, split_at_gaps


def take(time, position=None, velocity=None, **fields):
    position = np.zeros(len(time)) if position is None else position
    velocity = None if velocity is None else velocity[:, None]
    return Recording(
        time, ("hinge",), position[:, None], velocity, **{"torque_command": np.zeros((len(time), 1)), **fields}
    )


@given(
    steps=st.lists(st.floats(0.002, 0.009), min_size=20, max_size=60),
    step=st.floats(0.003, 0.03),
    seed=st.integers(0, 99),
)
def test_the_impulse_of_the_command_is_the_same_up_to_every_new_stamp(steps, step, seed):
    time = np.concatenate(([0.0], np.cumsum(steps)))
    torque = np.random.default_rng(seed).normal(size=len(time))
    new = resample(take(time, torque_command=torque[:, None]), step)
    held = np.clip(np.minimum(np.append(time[1:], np.inf), new.time[:, None]) - time, 0, None)  # (new, old)
    impulse = step * np.concatenate(([0.0], np.cumsum(new.torque_command[:-1, 0])))
    np.testing.assert_allclose(impulse, held @ torque, atol=1e-9)


def test_a_held_command_keeps_its_edges():
    time = np.arange(0, 1, 0.01)
    torque = np.where(time < 0.4995, 0.0, 2.0)
    fine = resample(take(time, torque_command=torque[:, None]), 0.005)
    assert fine.torque_command[:, 0] == pytest.approx(np.where(fine.time < 0.4995, 0.0, 2.0))
    coarse = resample(take(time, torque_command=torque[:, None]), 0.04)  # the edge is half way in [0.48, 0.52)
    assert coarse.torque_command[[11, 12, 13], 0] == pytest.approx([0.0, 1.0, 2.0])


def test_the_same_grid_changes_nothing():
    rng = np.random.default_rng(0)
    time = np.arange(200) / 200
    old = take(
        time,
        rng.normal(size=200),
        rng.normal(size=200),
        torque_command=rng.normal(size=(200, 1)),
        torque_measured=rng.normal(size=(200, 1)),
        torque_semantics="link_side",
    )
    new = resample(old, 1 / 200)
    for name in ("time", "position", "velocity", "torque_command", "torque_measured"):
        np.testing.assert_allclose(getattr(new, name), getattr(old, name), atol=1e-12, err_msg=name)


def test_velocity_makes_the_position_exact_to_third_order():
    time = np.sort(np.random.default_rng(0).uniform(0, 1, 60))
    position, velocity = 2 * time**3 - time, 6 * time**2 - 1
    new = resample(take(time, position, velocity), 0.004, max_gap=0.5)
    np.testing.assert_allclose(new.position[:, 0], 2 * new.time**3 - new.time, atol=1e-12)


def test_without_velocity_a_joint_at_rest_does_not_overshoot_and_turning_points_stay_round():
    time = np.arange(0, 1, 0.01)
    position = np.where(time < 0.5, 0.0, 1.0)
    new = resample(take(time, position), 0.001)
    assert new.position.min() == 0.0
    assert new.position.max() == 1.0
    smooth = resample(take(time, np.sin(6 * time)), 0.003)
    np.testing.assert_allclose(smooth.position[:, 0], np.sin(6 * smooth.time), atol=2e-5)


def test_a_target_is_held_and_keeps_its_gains():
    time = np.arange(0, 1, 0.01)
    old = take(time, torque_command=None, position_target=time[:, None], kp=[3.0], kd=[0.1])
    new = resample(old, 0.02)
    assert new.position_target[:-1, 0] == pytest.approx(new.time[:-1] + 0.005)  # mean of two samples 10 ms apart
    assert (new.kp, new.kd) == ([3.0], [0.1])


def with_gap():
    time = np.concatenate((np.arange(50), np.arange(80, 130), [200], np.arange(300, 310))) / 100
    return take(time, np.sin(time))


def test_nothing_is_interpolated_across_a_gap():
    with pytest.raises(RecordingError, match=r"between 0\.490 s and 0\.800 s \(row 49; 3 such gaps\).*split_at_gaps"):
        resample(with_gap(), 0.005)


def test_the_pieces_hold_every_sample_and_the_lone_one_is_reported():
    with pytest.warns(UserWarning, match="1 samples stand alone"):
        pieces = split_at_gaps(with_gap())
    assert [piece.num_samples for piece in pieces] == [50, 50, 10]
    assert pieces[1].source == "memory [rows 50 to 99]"
    assert all(np.diff(piece.time).max() < 0.02 for piece in pieces)
    for piece in pieces:
        assert resample(piece, 0.005).position == pytest.approx(np.sin(resample(piece, 0.005).time)[:, None], abs=1e-3)


def test_a_take_without_a_gap_is_one_piece_and_a_longer_gap_may_be_allowed():
    time = np.arange(100) / 100
    assert [piece.num_samples for piece in split_at_gaps(take(time))] == [100]
    assert [piece.num_samples for piece in split_at_gaps(with_gap(), max_gap=2.0)] == [111]
    with pytest.raises(RecordingError, match=r"no two samples are closer than max_gap = 0\.001 s"):
        split_at_gaps(take(time), max_gap=0.001)


@pytest.mark.parametrize("step", [0.0, -0.1, 5.0, float("nan")])
def test_a_step_that_does_not_fit_is_refused(step):
    with pytest.raises(RecordingError, match="Give a step in seconds"):
        resample(take(np.arange(100) / 100), step)
