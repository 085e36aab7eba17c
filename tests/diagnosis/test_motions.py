"""Motions keep what robot and surroundings can take."""

from dataclasses import replace
from types import SimpleNamespace

import mujoco
import numpy as np
import pytest
from diagnosis.plants import pendulum, record, slider, smooth_torque
from scipy.signal import periodogram

from torchrl_athletic.diagnosis import motions as module
from torchrl_athletic.diagnosis.experiment import _path
from torchrl_athletic.diagnosis.motions import Limits, motions, touches, way
from torchrl_athletic.diagnosis.prepare import prepare
from torchrl_athletic.diagnosis.thresholds import PLAN
from torchrl_athletic.effects import JointAddress
from torchrl_athletic.effects.effect import torque_scale
from torchrl_athletic.recordings import Recording
from torchrl_athletic.recordings.demo import make_recordings, two_link_arm


@pytest.fixture(scope="module")
def takes():
    robot = two_link_arm()
    return prepare(make_recordings(robot, duration=4.0), mujoco.MjModel.from_xml_string(robot.model_xml)).signals


def test_every_candidate_stays_within_range_and_speed(takes):
    limits = Limits.of(takes)
    found = list(motions(takes, limits, [0, 1], 8.0))
    assert {m.kind for m in found} >= {"sine", "sweep", "chirp", "mix", "multisine"}
    assert {m.joint for m in found} == {"shoulder", "elbow", "all joints"}
    start = takes[0].recording.position[0]
    for joint, other in ((0, 1), (1, 0)):  # slow and quick ones about both poses
        own = [m for m in found if m.joint == ("shoulder", "elbow")[joint]]
        for here in (True, False):
            assert {m.kind for m in own if (m.pose[other] == start[other]) == here} >= {"sine", "sweep", "mix"}
    for m in found:
        path = m.pose + m.wave
        assert (path >= limits.position[:, 0] - 1e-9).all()
        assert (path <= limits.position[:, 1] + 1e-9).all()
        if m.kind != "steps":  # rounded later
            assert (np.abs(np.diff(path, axis=0)) * PLAN.rate <= limits.velocity).all()
        np.testing.assert_allclose(np.abs(m.wave[-1]), 0, atol=0.02)


@pytest.mark.parametrize("frequency", [np.inf, 2.0])
def test_a_motion_says_the_highest_frequency_in_it(takes, frequency):
    limits = replace(Limits.of(takes), frequency=frequency)
    for m in motions(takes, limits, [0, 1], 8.0):
        path = _path(m, m.pose, limits)
        velocity = np.gradient(path, 1 / PLAN.rate, axis=0)[:, np.ptp(path, axis=0).argmax()]
        frequency, power = periodogram(velocity, PLAN.rate)
        above = power[frequency > 1.15 * m.highest + 1.0].sum() / power.sum()
        assert above < (0.1 if m.rounding else 0.02), m.words("rad")


def test_where_less_is_allowed_as_many_slower_motions_are_tried(takes):
    limits = replace(Limits.of(takes), frequency=3.0)
    found = list(motions(takes, limits, [0, 1], 8.0))
    assert max(m.highest for m in found) <= 3.0 + 1e-9
    assert {m.kind for m in found} >= {"sine", "sweep", "mix", "steps"}  # with rounder corners
    assert len(found) > 0.7 * PLAN.motions
    assert sum(m.kind == "mix" for m in found) >= 8  # of both joints about both poses, two bands at least


def test_a_motion_about_a_pose_near_an_end_keeps_as_clear_of_it_as_one_about_the_middle(takes):
    limits = Limits.of(takes)
    narrow = np.stack([takes[0].recording.position[0] - 0.01, limits.position[:, 1]], -1)
    clear = 0.5 * (1 - PLAN.margin) * np.ptp(narrow, axis=1)
    own = [m for m in motions(takes, replace(limits, position=narrow), [0], 8.0) if m.joint == "shoulder"]
    assert {"sine", "sweep"} <= {m.kind for m in own}
    for m in own:
        path = (m.pose + m.wave)[:, 0]
        assert path.min() >= narrow[0, 0] + clear[0] - 1e-9
        assert path.max() <= narrow[0, 1] - clear[0] + 1e-9


def test_a_smaller_motion_has_the_same_shape_and_says_its_own_size(takes):
    whole = next(m for m in motions(takes, Limits.of(takes), [1], 8.0) if m.kind == "mix")
    half = whole.smaller(0.5)
    np.testing.assert_allclose(half.wave, 0.5 * whole.wave)
    assert half.amplitude == 0.5 * whole.amplitude
    assert np.abs(half.wave).max() <= half.amplitude
    assert f"{half.amplitude:.2g} rad" in half.words("rad")


def test_only_the_named_joint_moves(takes):
    for m in motions(takes, Limits.of(takes), [1], 8.0):
        if m.joint == "elbow":
            assert not np.ptp(m.wave[:, 0])
            assert np.abs(m.wave[:, 1]).max() == pytest.approx(m.amplitude, rel=0.02)


def signals_of(joint: str = ""):
    take = record(pendulum(joint=joint), smooth_torque(3.0))
    return prepare([take], mujoco.MjModel.from_xml_string(pendulum(joint=joint))).signals


def test_the_models_range_holds_clear_of_the_stops():
    limits = Limits.of(signals_of('range="-60 80" limited="true"'))
    assert limits.position == pytest.approx(np.add(np.deg2rad([[-60, 80]]), [[0.06, -0.06]]))


def test_without_a_range_a_radian_to_both_sides_of_the_start_is_taken():
    s = signals_of()
    start = s[0].recording.position[0, 0]
    assert Limits.of(s).position == pytest.approx(np.array([[start - 1, start + 1]]))


def limits_of(xml, *commands, start=0.0):
    takes = [record(xml, command, start, seed=k) for k, command in enumerate(commands)]
    found = prepare(takes, mujoco.MjModel.from_xml_string(xml)).signals
    return Limits.of(found), takes, found


def test_a_slide_keeps_a_twentieth_of_its_range_clear_and_without_one_stays_where_it_was_seen():
    """A metre more than was recorded is nothing that a rail can be supposed to have."""
    push = 2 * smooth_torque(3.0)
    limits, takes, signals = limits_of(slider(joint='range="-3 5" limited="true"'), push)
    assert limits.position == pytest.approx(np.array([[-3 + 0.4, 5 - 0.4]]))
    free, takes, signals = limits_of(slider(), push)
    position = takes[0].position
    assert free.position == pytest.approx(np.array([[position.min(), position.max()]]))
    assert free.velocity == pytest.approx(1.5 * np.abs(signals[0].velocity).max())


def test_a_take_that_starts_beside_a_stop_may_stay_there():
    joint = 'range="-60 80" limited="true"'
    for start, side in ((np.deg2rad(-60) + 0.01, 0), (np.deg2rad(80) - 0.01, 1)):
        limits, takes, _ = limits_of(pendulum(joint=joint), smooth_torque(3.0), start=start)
        assert limits.position[0, side] == takes[0].position[0, 0]
        assert limits.position[0, 1 - side] == pytest.approx(np.deg2rad((80, -60)[side]) + (-0.06, 0.06)[side])


def test_half_more_speed_and_torque_than_any_take_had_is_allowed_and_at_least_what_every_joint_can():
    weak, strong = smooth_torque(3.0), 20 * smooth_torque(3.0, seed=1)
    limits, _, signals = limits_of(pendulum(), weak, strong)
    fastest = max(np.abs(s.velocity).max() for s in signals)
    assert fastest > 5
    assert limits.velocity == pytest.approx(1.5 * fastest)
    assert limits.torque == pytest.approx(1.5 * max(np.abs(s.command).max() for s in signals))
    tame, _, signals = limits_of(pendulum(), 0.1 * weak)
    assert tame.velocity == 2.0
    assert tame.torque == pytest.approx(torque_scale(signals[0].nominal, signals[0].address, 0))
    assert tame.torque > 1.5 * np.abs(signals[0].command).max()


def test_rounded_steps_are_no_faster_than_allowed_and_sweeps_say_their_speed(takes):
    """Steps that would be are left out; lower frequencies round them more, so that some are slow enough."""
    limits, steps = Limits.of(takes), 0
    for share, highest in ((1.0, 3.0), (0.5, 2.0)):
        slower = replace(limits, velocity=share * limits.velocity, frequency=highest)
        for m in motions(takes, slower, [0, 1], 8.0):
            if m.kind == "steps":
                speed = np.abs(np.diff(_path(m, m.pose, slower), axis=0)).max(0) * PLAN.rate
                assert (speed <= slower.velocity).all()
                steps += 1
            elif m.kind == "sweep":
                j = ("shoulder", "elbow").index(m.joint)
                speed = np.median(np.abs(np.diff(m.wave[:, j]))) * PLAN.rate
                assert f"constant {speed:.2g} rad/s" in m.words("rad")
                assert 1 / 8.0 <= m.frequency <= 2.0  # it turns at least once in its time
    assert steps > 3
    sweeps = [m for m in motions(takes, limits, [0], 20.0) if m.kind == "sweep"]
    first = [m.frequency for m in sweeps if m.amplitude == sweeps[0].amplitude]
    assert max(first) == pytest.approx(8 * min(first))  # the quickest and the slowest of three speeds


def test_a_sweep_lasts_whole_periods_and_as_long_as_asked_and_is_never_faster_than_it_says(takes):
    """On the way home, too, which is part of what is meant to be seen at that speed."""
    sweeps = [m for m in motions(takes, Limits.of(takes), [0, 1], 8.0) if m.kind == "sweep"]
    assert len({m.frequency for m in sweeps}) > 2
    for m in sweeps:
        own = m.wave[:, ("shoulder", "elbow").index(m.joint)]
        steps = np.abs(np.diff(own)) * PLAN.rate
        assert steps.max() == pytest.approx(4 * m.amplitude * m.frequency, rel=0.02)
        seconds = len(own) / PLAN.rate
        assert 8.0 - 1 / PLAN.rate <= seconds <= 8.0 + 1.5 / m.frequency


@pytest.mark.parametrize(("rate", "passed"), [(PLAN.rate, 1.0), (4 * PLAN.rate, 1.0), (0.5 * PLAN.rate, 0.5)])
def test_the_quickest_mix_is_what_a_log_still_shows_at_its_rate_or_the_plans(rate, passed):
    """Faster logging of earlier takes does not help, since the plan is sent at its own rate; slower logging harms."""
    time = np.arange(0.0, 2.0, 1 / rate)
    still = np.zeros((len(time), 1))
    take = SimpleNamespace(recording=Recording(time, ("hip",), still, torque_command=still))
    limits = Limits(np.array([[-1.0, 1.0]]), np.array([5.0]), np.array([1.0]))
    mixes = [m for m in motions([take], limits, [0], 8.0) if m.kind == "mix"]
    assert mixes[0].highest == pytest.approx(module.QUICK[0] * passed * module.HALF_POWER * PLAN.rate / 1.2, rel=0.01)


def test_a_motor_that_is_weaker_one_way_is_planned_for_as_weak_both_ways():
    for least, greatest in ((-2, 5), (-5, 2)):
        motor = f'<motor joint="pendulum" ctrllimited="true" ctrlrange="{least} {greatest}"/>'
        xml = pendulum().replace('<motor joint="pendulum"/>', motor)
        assert limits_of(xml, 0.5 * smooth_torque(3.0))[0].torque == pytest.approx(2.0)


def test_the_motors_range_is_the_limit_where_there_is_one(takes):
    assert Limits.of(takes).torque == pytest.approx(two_link_arm().torque_limit)


def test_the_way_is_from_rest_to_rest_at_half_the_speed(takes):
    limits = Limits.of(takes)
    start, end = np.array([0.0, 0.3]), np.array([0.9, -0.2])
    path = way(start, end, limits)
    speed = np.diff(path, axis=0) * PLAN.rate
    np.testing.assert_array_equal(path[0], start)
    np.testing.assert_allclose(path[-1], end)
    np.testing.assert_allclose(speed[[0, -1]], 0, atol=1e-12)
    still = (np.abs(path - start).max(1) < 1e-9).sum() / PLAN.rate, (np.abs(path - end).max(1) < 1e-9).sum() / PLAN.rate
    assert all(0.2 <= seconds < 0.25 for seconds in still)
    assert (np.abs(speed) / limits.velocity).max() == pytest.approx(0.5, rel=0.02)


def test_parts_that_would_collide_are_seen_and_those_that_always_touch_are_not():
    xml = """<mujoco><worldbody>
      <geom name="post" type="box" size=".05 .05 .05" pos=".4 0 0"/>
      <geom name="socket" size=".06" pos="0 0 .02"/>
      <body><joint name="arm" axis="0 -1 0"/><geom type="capsule" fromto="0 0 0 0 0 -.4" size=".02"/></body>
    </worldbody></mujoco>"""
    model = mujoco.MjModel.from_xml_string(xml)
    address = JointAddress.of(model, ("arm",))
    swing = np.linspace(0, 1, 400)[:, None]
    assert not touches(model, address, 0.5 * swing)
    assert touches(model, address, 1.7 * swing)


def test_each_kind_of_motion_has_its_turn_until_all_are_at_their_ends():
    assert "".join(module._in_turn([iter("ad"), iter("b"), iter(""), iter("cef")])) == "abcdef"


@pytest.mark.parametrize(
    ("kind", "words"),
    [
        ("sine", "move hip in a sine of ±0.5 rad at 2 Hz about"),
        ("sweep", "move hip both ways over ±0.5 rad at a constant 4 rad/s about"),  # four amplitudes in half a second
        ("steps", "step hip by ±0.5 rad at 2 Hz about"),
        ("chirp", "move hip in a sine of ±0.5 rad that rises from 0.2 to 2 Hz about"),
        ("mix", "move hip in a mix of sines by up to ±0.5 rad, up to 2 Hz about"),
        ("multisine", "move all joints at once by up to ±0.5 rad, up to 2 Hz about"),
    ],
)
def test_a_motion_is_an_instruction_about_its_pose_and_knows_the_highest_frequency_of_its_corners(kind, words):
    motion = module.Motion("hip", kind, 0.5, 2.0, np.array([0.25, -1.0]), np.zeros((3, 2)))
    assert motion.words("rad") == f"{words} (0.25, -1.00)"
    assert motion.highest == 2.0
    assert replace(motion, rounding=0.01).highest == pytest.approx(module.HALF_POWER / 0.01)
    assert replace(motion, rounding=10.0).highest == 2.0


@pytest.mark.parametrize(("frequency", "steps", "sweep"), [(np.inf, 0.02, 0.05), (1.0, None, None)])
def test_corners_are_as_sharp_as_a_drive_can_follow_and_as_the_limits_allow(frequency, steps, sweep):
    limits = module.Limits(np.zeros((1, 2)), np.ones(1), np.ones(1), frequency)
    for kind, least in (("steps", steps), ("sweep", sweep)):
        assert module._rounding(kind, limits) == pytest.approx(module.HALF_POWER if least is None else least)


def test_a_wave_fades_in_and_out_within_half_a_second_and_comes_home_at_the_speed_allowed():
    fade = module._fade(round(3 * PLAN.rate) + 1)
    assert fade[[0, -1]] == pytest.approx([0, 0])
    assert fade[[round(0.25 * PLAN.rate), -1 - round(0.25 * PLAN.rate)]] == pytest.approx([0.5, 0.5], abs=0.02)
    np.testing.assert_allclose(fade[round(0.5 * PLAN.rate) : -round(0.5 * PLAN.rate)], 1, atol=1e-3)
    wave = np.array([[0.0, 0.0], [0.2, -0.5]])
    home = module._home(wave, 2.0)
    np.testing.assert_array_equal(home[:2], wave)
    assert len(home) == 2 + round(0.25 * PLAN.rate)  # from 0.5 at 2 rad/s
    np.testing.assert_allclose(np.diff(home[1:], axis=0) * PLAN.rate, np.tile([-0.8, 2.0], (len(home) - 2, 1)))
    np.testing.assert_allclose(home[-1], 0, atol=1e-12)


def two_joints(velocity=(1.0, 4.0)):
    """Candidates for two joints of one range and unlike speeds, from a start that is not the middle."""
    time = np.arange(0.0, 2.0, 1 / PLAN.rate)
    still = np.full((len(time), 2), 0.25)
    take = SimpleNamespace(recording=Recording(time, ("hip", "knee"), still, torque_command=still))
    limits = Limits(np.array([[-2.0, 2.0]] * 2), np.array(velocity), np.ones(2))
    return list(motions([take], limits, [0, 1], 8.0)), limits


def test_each_joint_moves_at_its_own_speed_in_every_kind_of_motion():
    """What one of them may do the other may not; of what each may most is used."""
    found, limits = two_joints()
    fastest = {}
    for m in found:
        if m.kind in ("sweep", "mix", "multisine"):
            speed = np.abs(np.diff(m.wave, axis=0)).max(0) * PLAN.rate / limits.velocity
            assert (speed <= 1).all()
            fastest[m.kind] = np.maximum(fastest.get(m.kind, np.zeros(2)), speed)
    assert {kind: speed.min() > 0.7 for kind, speed in fastest.items()} == dict.fromkeys(fastest, True)
    slowest = next(m for m in found if m.kind == "multisine")  # over most of the range, were there the speed for it
    speed = np.abs(np.diff(slowest.wave, axis=0)).max(0) * PLAN.rate
    assert speed == pytest.approx(PLAN.margin * limits.velocity)


def test_of_many_joints_a_band_too_narrow_to_tell_them_apart_is_left_out_and_wider_ones_are_not():
    limits = Limits(np.array([[-2.0, 2.0]] * 4), np.ones(4), np.ones(4))
    found = list(module._of_all(tuple("abcd"), np.zeros(4), np.ones(4), limits, 8.0))
    assert [m.frequency for m in found] == [1.2, 3.0]


def test_a_mix_keeps_to_half_of_the_range_about_its_pose_both_ways_alike():
    found, _ = two_joints(velocity=(100.0, 100.0))
    mixes = [m for m in found if m.kind == "mix"]
    for m in mixes:
        own = m.wave[:, ("hip", "knee").index(m.joint)]
        assert np.abs(own).max() == pytest.approx(m.amplitude)
        assert m.amplitude <= 0.5 * PLAN.margin * 2.0 + 1e-9
        assert abs(own.mean()) < 0.2 * m.amplitude
        assert np.abs(own[[0, -1]]).max() < 1e-2 * m.amplitude
    assert max(m.amplitude for m in mixes) == pytest.approx(0.5 * PLAN.margin * 2.0)


def test_both_joints_have_their_turn_about_the_start_before_any_other_pose():
    """The second pose is half-way to the upper end, where gravity pulls otherwise."""
    found, _ = two_joints()
    first = [(m.joint, m.pose.tolist()) for m in found if m.joint != "all joints"][:4]
    assert [joint for joint, _ in first] == ["hip", "knee", "hip", "knee"]
    others = [pose["knee hip".split().index(joint)] for joint, pose in first]
    assert others == pytest.approx([0.25, 0.25, 1.0, 1.0])


def test_steps_end_where_they_began():
    found, _ = two_joints(velocity=(100.0, 100.0))
    kinds = {m.kind: m for m in found}
    assert kinds["steps"].wave[-1] == pytest.approx([0, 0], abs=1e-9)
    assert (kinds["steps"].rounding, kinds["sweep"].rounding) == (0.02, 0.05)


def test_the_range_without_a_model_is_that_of_all_takes():
    limits, takes, _ = limits_of(slider(), 2 * smooth_torque(3.0), 5 * smooth_torque(3.0, seed=1))
    position = np.concatenate([take.position for take in takes])
    assert limits.position == pytest.approx(np.array([[position.min(), position.max()]]))
    assert np.ptp(position) > np.ptp(takes[0].position)


def test_a_pose_a_hair_below_zero_is_said_as_zero():
    motion = module.Motion("hip", "sine", 0.5, 2.0, np.array([-0.0]), np.zeros((3, 1)))
    assert motion.words("rad").endswith("(0.00)")


def test_a_way_of_no_length_takes_half_a_second_and_the_joint_with_the_longest_way_sets_the_time():
    limits = module.Limits(np.zeros((2, 2)), np.array([1.0, 4.0]), np.ones(2))
    still = round(0.2 * PLAN.rate)
    assert len(way(np.zeros(2), np.zeros(2), limits)) == 2 * still + round(0.5 * PLAN.rate)
    # 15/8 of 2 rad at half of 1 rad/s take 7.5 s, of 4 rad at 2 rad/s half as long
    assert len(way(np.zeros(2), np.array([2.0, -4.0]), limits)) == 2 * still + round(7.5 * PLAN.rate)
