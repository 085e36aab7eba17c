"""The pose of a floating robot's base: what is refused, and what a sign of a quaternion means."""

from dataclasses import replace

import numpy as np
import pytest

from torchrl_athletic.recordings import Recording, RecordingError, check_quality, resample, split_at_gaps
from torchrl_athletic.recordings.base import base_moves, base_pose
from torchrl_athletic.recordings.noise import base_noise
from torchrl_athletic.recordings.quality import with_known_base

TIME = np.arange(1200) / 200
TURN = 0.3 * np.sin(3 * TIME)
PLACE = np.stack([0.1 * np.sin(4 * TIME), 0.05 * np.cos(5 * TIME), 0.4 + 0.02 * TIME], -1)
ATTITUDE = np.stack([np.cos(TURN / 2), 0 * TIME, np.sin(TURN / 2), 0 * TIME], -1)


def swing(place=PLACE, attitude=ATTITUDE) -> Recording:
    hip = np.sin(5 * TIME)[:, None]
    return Recording(
        TIME, ("hip",), hip, torque_command=hip, base_position=place, base_orientation=attitude, source="take_7.npz"
    )


def changed(values, rows, value):
    out = np.array(values)
    out[rows] = value
    return out


@pytest.mark.parametrize(
    ("fields", "advice"),
    [
        ({"attitude": None}, r"base_orientation is missing\. .* give both, constant ones .*, or neither"),
        ({"place": None}, r"base_position is missing"),
        ({"place": PLACE[:-1]}, r"base_position has shape \(1199, 3\), needed is \(1200, 3\).* Interpolate"),
        ({"attitude": ATTITUDE[:, 1:]}, r"base_orientation has shape \(1200, 3\), needed is \(1200, 4\)"),
        ({"attitude": changed(ATTITUDE, 7, 0.0)}, r"at row 7, of length 0\. Give unit quaternions, w first"),
        ({"attitude": 1.02 * ATTITUDE}, r"at row 0, of length 1\.02"),
        ({"place": changed(PLACE, 5, np.nan)}, r"base_position is \[nan nan nan\] at row 5"),
        ({"attitude": changed(ATTITUDE, 5, np.nan)}, r"base_orientation is \[nan nan nan nan\] at row 5"),
    ],
)
def test_a_pose_that_cannot_be_right_is_refused(fields, advice):
    with pytest.raises(RecordingError, match=r"^take_7\.npz: .*" + advice):
        swing(**fields)


def test_rounded_quaternions_are_units():
    assert np.linalg.norm(base_pose(swing(attitude=ATTITUDE.round(3)))[:, 3:], axis=1) == pytest.approx(1.0, abs=1e-12)


def test_a_quaternion_and_its_negative_are_the_same_attitude():
    signs = np.where(np.random.default_rng(0).random(len(TIME)) < 0.3, -1.0, 1.0)
    signs[0] = 1.0
    np.testing.assert_allclose(base_pose(swing(attitude=signs[:, None] * ATTITUDE)), base_pose(swing()))
    flipped = check_quality(swing(attitude=signs[:, None] * ATTITUDE))
    assert not flipped.masks["base"].any()


def test_pieces_and_order_keep_the_pose():
    gap = swing()
    gap = replace(gap, time=np.where(TIME > 3.0, TIME + 1.0, TIME))
    first, last = split_at_gaps(gap)
    np.testing.assert_array_equal(np.vstack([first.base_position, last.base_position]), PLACE)
    np.testing.assert_array_equal(first.base_orientation, ATTITUDE[: first.num_samples])
    np.testing.assert_array_equal(gap.ordered(("hip",)).base_position, PLACE)


def test_resampling_keeps_attitudes_unit_and_near():
    flipped = np.where(np.arange(len(TIME))[:, None] % 2, -ATTITUDE, ATTITUDE)  # whose means are not attitudes at all
    finer = resample(swing(attitude=flipped), 0.002)
    np.testing.assert_allclose(np.linalg.norm(finer.base_orientation, axis=1), 1.0)
    angle = 2 * np.arctan2(finer.base_orientation[:, 2], finer.base_orientation[:, 0])
    np.testing.assert_allclose(angle, 0.3 * np.sin(3 * finer.time), atol=1e-4)
    np.testing.assert_allclose(finer.base_position[:, 0], 0.1 * np.sin(4 * finer.time), atol=1e-4)


def test_a_held_base_stands_still():
    bare = replace(swing(), base_position=None, base_orientation=None)
    held = bare.with_base_held((0.0, 0.1, 0.5), (0.0, 1.0, 0.0, 0.0))
    assert base_pose(held)[[0, -1]].tolist() == [[0.0, 0.1, 0.5, 0.0, 1.0, 0.0, 0.0]] * 2
    assert [base_moves(r) for r in (bare, held, swing())] == [False, False, True]
    assert base_pose(bare) is None


def test_noise_of_the_base_is_found_for_place_and_angle():
    rng, (linear, angular) = np.random.default_rng(0), (3e-4, 1e-3)
    place = PLACE + rng.normal(0, linear, PLACE.shape)
    w, x, y, z = ATTITUDE.T
    dx, dy, dz = rng.normal(0, angular / 2, (3, len(TIME)))  # half the angle about each axis of the body
    noisy = np.stack([w - x * dx - y * dy - z * dz, x + w * dx + y * dz - z * dy,
                      y + w * dy + z * dx - x * dz, z + w * dz + x * dy - y * dx], -1)  # fmt: skip
    noisy /= np.linalg.norm(noisy, axis=1, keepdims=True)
    np.testing.assert_allclose(base_noise(swing(place, noisy)), [linear, angular], rtol=0.1)
    assert base_noise(replace(swing(), base_position=None, base_orientation=None)).tolist() == [0.0, 0.0]


@pytest.mark.parametrize(
    ("fields", "rows"),
    [
        ({"place": changed(PLACE, slice(500, 502), 0.0)}, slice(500, 502)),
        ({"attitude": changed(ATTITUDE, 700, [1.0, 0.0, 0.0, 0.0])}, slice(700, 701)),
        ({"place": changed(PLACE, slice(101, 106), PLACE[100])}, slice(101, 106)),
        (
            {
                "place": changed(PLACE + 1.0, slice(300, 340), 0.0),
                "attitude": changed(ATTITUDE, slice(300, 340), [1.0, 0.0, 0.0, 0.0]),
            },
            slice(300, 340),
        ),
    ],
)
def test_poses_that_drop_out_or_freeze_are_masked_for_all_joints_and_counted(fields, rows):
    quality = check_quality(swing(**fields))
    assert quality.masks["base"][rows].all()
    assert quality.masks["base"].sum() <= (rows.stop - rows.start) + 4
    assert not quality.usable()[rows].any()
    assert quality.report()["masked"]["base"] == quality.masks["base"].sum()
    assert any("Look for lost markers" in w for w in quality.warnings)


def test_a_clean_pose_is_left_alone_and_millimetres_are_suspected():
    quality = check_quality(swing())
    assert not quality.masks["base"].any()
    assert not any("base" in w for w in quality.warnings)
    assert any("looks like millimetres" in w for w in check_quality(swing(1e3 * PLACE)).warnings)


def test_samples_whose_pose_was_lost_are_left_out_and_the_others_stay():
    take = swing(changed(PLACE, slice(500, 502), 0.0))
    known = with_known_base(take)
    assert set(take.time[500:502]).isdisjoint(known.time)
    assert known.num_samples >= take.num_samples - 6
    clean = swing()
    assert with_known_base(clean) is clean


def test_a_slower_log_that_is_held_is_told():
    rows = np.arange(len(TIME)) // 2 * 2
    warnings = check_quality(swing(PLACE[rows], ATTITUDE[rows])).warnings
    assert any("50% of its poses are the one before" in w and "Interpolate" in w for w in warnings)
