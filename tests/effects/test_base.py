"""A base that moves as it was recorded: by hand, in free fall, and against the same robot bolted down."""

from dataclasses import replace

import mujoco
import numpy as np
import pytest
from effects.hung import JOINTS, KD, KP, late, model, record
from numpy.typing import NDArray

from torchrl_athletic.diagnosis.compare import noise_floor
from torchrl_athletic.diagnosis.fit import Hypothesis
from torchrl_athletic.diagnosis.replay import simulate, take_of, windows_of
from torchrl_athletic.diagnosis.screen import trims_for
from torchrl_athletic.effects import TRIMS, BaseClockShift, EncoderScale, JointAddress, Plant, project_recording
from torchrl_athletic.effects.base import base_columns, base_motion, base_velocity, carried, free_joint
from torchrl_athletic.effects.gear import LinkMotion
from torchrl_athletic.effects.signals import inverse_dynamics
from torchrl_athletic.recordings import Recording, RecordingError

Array = NDArray[np.float64]
TIME = np.arange(0.0, 3.0, 0.002)
ROBOT = mujoco.MjModel.from_xml_string(model())
BOLTED = mujoco.MjModel.from_xml_string(model().replace('<freejoint name="root"/>', ""))


def take(position: Array, place: Array, attitude: Array) -> Recording:
    return Recording(
        TIME, JOINTS, position, torque_command=0 * position, base_position=place, base_orientation=attitude
    )


def about_y(angle: Array) -> Array:
    return np.stack([np.cos(angle / 2), 0 * angle, np.sin(angle / 2), 0 * angle], -1)


def second(x: Array) -> Array:
    return np.gradient(np.gradient(x, TIME, axis=0, edge_order=2), TIME, axis=0, edge_order=2)


def turned(vector: tuple[float, float], angle: Array) -> Array:
    """(x, z) of a body's vector after a turn about y."""
    x, z = vector
    return np.stack([x * np.cos(angle) + z * np.sin(angle), z * np.cos(angle) - x * np.sin(angle)], -1)


def moment(arm: Array, force: Array) -> Array:
    """About y."""
    return arm[:, 1] * force[:, 0] - arm[:, 0] * force[:, 1]


def test_newton_by_hand_of_a_leg_on_a_trunk_that_is_thrown_about():
    pitch, place = 0.4 * np.sin(5 * TIME), np.stack([0.2 * np.sin(4 * TIME), 0.15 * np.cos(6 * TIME)], -1)
    hip, knee = 0.5 * np.sin(6 * TIME + 1), 0.6 + 0.7 * np.cos(7 * TIME)
    thigh, shank = pitch + hip, pitch + hip + knee
    at_hip = place + turned((0.05, -0.03), pitch)
    at_knee = at_hip + turned((0.0, -0.2), thigh)
    centres = at_hip + turned((0.01, -0.1), thigh), at_knee + turned((0.0, -0.08), shank)
    up = np.array([0.0, 9.81])
    forces = [m * (second(c) + up) for m, c in zip((0.9, 0.35), centres, strict=True)]
    at_shank = moment(centres[1] - at_knee, forces[1]) + 0.0012 * second(shank)
    at_thigh = sum(moment(c - at_hip, f) for c, f in zip(centres, forces, strict=True))
    at_thigh += 0.006 * second(thigh) + 0.0012 * second(shank)
    at_thigh += 0.01 * second(hip) + 0.05 * np.gradient(hip, TIME)  # the rotor turns against the trunk
    at_shank += 0.004 * second(knee) + 0.03 * np.gradient(knee, TIME)

    where = np.stack([place[:, 0], 0 * TIME, place[:, 1]], -1)
    moved = take(np.stack([hip, knee, hip, 0 * knee], -1), where, about_y(pitch))
    s = project_recording(moved, ROBOT, np.zeros(4), kernel=0.01)
    by_hand = s.project_command(np.stack([np.interp(s.fine_time, TIME, x) for x in (at_thigh, at_shank)], -1))
    np.testing.assert_allclose(s.required[:, :2], by_hand, atol=0.01 * np.abs(by_hand).max())


def test_legs_in_free_fall_have_no_weight():
    pose = np.tile([1.2, -0.7, 0.4, 0.9], (len(TIME), 1))
    drop = np.stack([0 * TIME, 0 * TIME, -0.5 * 9.81 * TIME**2], -1)
    upright = about_y(0 * TIME)
    falls, hangs = (project_recording(take(pose, x, upright), ROBOT, np.zeros(4)) for x in (drop, 0 * drop))
    assert np.abs(hangs.required).max() > 1.0
    np.testing.assert_allclose(falls.required, 0.0, atol=1e-5)
    np.testing.assert_allclose(falls.load, hangs.load)  # what load-dependent friction goes by is the pose's
    for fall, weight in ((True, 0.01), (False, 0.1)):
        s = falls if fall else hangs
        link = LinkMotion(s.nominal, s.address, s.fine_step, s.fine_position, s.fine_velocity, base=s.fine_base)
        for felt in (link.load, link.slopes(0)[0], EncoderScale().fingerprint(s, 0, {}).columns):
            assert (np.abs(felt[20:-20]).max() < weight) == fall


def test_a_trunk_on_its_side_has_gravity_from_its_side():
    pose = np.zeros((len(TIME), 4))
    s = project_recording(take(pose, np.zeros((len(TIME), 3)), about_y(0 * TIME + np.pi / 2)), ROBOT, np.zeros(4))
    knee = 9.81 * 0.35 * 0.08
    np.testing.assert_allclose(np.abs(s.required[:, [1, 3]]), knee, rtol=1e-9)


def test_attitude_and_its_rates_follow_a_steady_turn_of_several_rounds():
    rate, axis = 4.0, np.array([1.0, 2.0, -2.0]) / 3
    half = rate * TIME / 2
    attitude = np.hstack([np.cos(half)[:, None], np.sin(half)[:, None] * axis])
    attitude[::3] *= -1  # the same attitude
    turning = take(np.zeros((len(TIME), 4)), np.zeros((len(TIME), 3)), attitude)
    motion = base_motion(turning, ROBOT, TIME, 0.02)
    assert motion is not None
    inner = slice(100, -100)
    np.testing.assert_allclose(motion.velocity[inner, 3:], np.tile(rate * axis, (len(TIME), 1))[inner], atol=1e-6)
    np.testing.assert_allclose(motion.acceleration[inner], 0.0, atol=1e-4)
    alike = np.abs((motion.pose[:, 3:] * attitude).sum(1))
    np.testing.assert_allclose(alike[inner], 1.0, atol=1e-9)


def test_acceleration_is_the_rate_of_velocity_and_velocity_that_of_the_pose():
    angle, wide = 1.5 * np.sin(9 * TIME), 0.05  # so wide that a mean of attitudes is far from a unit
    place = np.stack([np.sin(4 * TIME), np.cos(3 * TIME), 0 * TIME], -1)
    motion = base_motion(take(np.zeros((len(TIME), 4)), place, about_y(angle)), ROBOT, TIME, wide)
    assert motion is not None
    pose, velocity = (np.gradient(x, TIME, axis=0) for x in (motion.pose, motion.velocity))
    inner = slice(2, -2)
    np.testing.assert_allclose(base_velocity(motion.pose, pose)[inner], motion.velocity[inner], atol=0.01)
    np.testing.assert_allclose(velocity[inner], motion.acceleration[inner], atol=0.2)
    assert np.abs(motion.acceleration[:, 4]).max() > 50.0


def test_velocity_is_what_mujoco_integrates():
    rng = np.random.default_rng(0)
    pose, velocity, step = rng.normal(size=(20, 7)), rng.normal(size=(20, 6)), 1e-6
    pose[:, 3:] /= np.linalg.norm(pose[:, 3:], axis=1, keepdims=True)
    free = mujoco.MjModel.from_xml_string(
        "<mujoco><worldbody><body><freejoint/><geom size='.1'/></body></worldbody></mujoco>"
    )
    later = pose.copy()
    for q, v in zip(later, velocity, strict=True):
        mujoco.mj_integratePos(free, q, v, step)
    np.testing.assert_allclose(base_velocity(pose, (later - pose) / step), velocity, atol=1e-5)


def test_a_constant_pose_is_the_robot_bolted_there():
    held = record(seconds=3.0, held=True, noise=0.0)
    loose = held.with_base_held((0.0, 0.0, 0.3))
    pairs = [(held, BOLTED), (loose, ROBOT)]
    bolted, floating = (project_recording(r, m, np.full(4, 1e-4), kernel=0.02) for r, m in pairs)
    for name in ("required", "missing", "bias", "noise", "load", "rigid", "inertia"):
        np.testing.assert_allclose(getattr(floating, name), getattr(bolted, name), atol=1e-7)
    paths = [
        simulate(windows_of(take_of(r, m, np.full(4, 1e-6)), None), lambda plant, values: None, np.zeros((1, 0)))
        for r, m in pairs
    ]
    np.testing.assert_allclose(paths[1], paths[0], atol=1e-5)


@pytest.mark.parametrize("loss", [0.0, 0.1])
def test_torques_move_the_legs_of_a_carried_robot_as_of_a_bolted_one(loss):
    command = 0.6 * np.sin(2 * np.pi * np.outer(TIME, [0.7, 1.3, 1.1, 0.6]))
    told = Recording(TIME, JOINTS, 0 * command, torque_command=command)
    paths = []
    for given, r in ((BOLTED, told), (ROBOT, told.with_base_held((0.0, 0.0, 0.3)))):
        dry = given.__copy__()
        dry.dof_frictionloss[-4:] = loss
        windows = windows_of(take_of(r, dry, np.zeros(4)), 1.0)
        paths.append(simulate(windows, lambda plant, values: None, np.zeros((1, 0))))
    np.testing.assert_allclose(paths[1], paths[0], atol=1e-5)


def test_a_replay_on_the_recorded_base_follows_the_robot_that_swung():
    swung = record(seconds=6.0, noise=0.0)
    still = replace(swung, base_position=None, base_orientation=None).with_base_held((0.0, 0.0, 0.3))
    error = []
    for r in (swung, still):
        windows = windows_of(take_of(r, ROBOT, np.full(4, 1e-9)).halved(), 0.5)
        (path,) = simulate(windows, lambda plant, values: None, np.zeros((1, 0)))
        error.append(float(np.sqrt(((path - windows.measured) ** 2).mean())))
    assert error[0] < 0.003 < 0.03 < error[1]


def test_what_carries_a_base_is_heavy_and_touches_nothing_that_stands():
    heavy = carried(ROBOT)
    data = mujoco.MjData(heavy)
    data.qpos[2] = 0.01  # the legs are in the floor
    data.qfrc_applied[6:] = 50.0
    mujoco.mj_forward(heavy, data)
    assert data.ncon == 0
    assert np.abs(data.qacc[:6]).max() < 1e-4 < 1.0 < np.abs(data.qacc[6:]).min()
    assert carried(BOLTED) is BOLTED
    again = carried(heavy)
    np.testing.assert_allclose(again.dof_armature, heavy.dof_armature, rtol=1e-6)


def test_noise_of_the_base_is_counted_in_what_it_asks_of_the_legs():
    clean, noisy = (record(seconds=8.0, noise=n) for n in (0.0, 3.0))
    noisy = replace(noisy, position=clean.position)
    exact, read = (project_recording(r, ROBOT, np.zeros(4), kernel=0.01) for r in (clean, noisy))
    scatter = (read.missing - exact.missing).std(0)
    np.testing.assert_allclose(read.noise, scatter, rtol=0.25)
    assert (exact.noise < 0.01 * scatter).all()


def test_a_base_that_is_stamped_late_leaves_its_fingerprint():
    right = record(seconds=6.0, noise=0.0)
    given, shifted = (project_recording(r, ROBOT, np.zeros(4), kernel=0.01) for r in (right, late(right, 0.001)))
    column = BaseClockShift().fingerprint(shifted, 0, {}).columns[:, :, 0]
    left, inner = shifted.missing - given.missing, slice(20, -20)
    np.testing.assert_allclose(0.001 * column[inner], left[inner], atol=0.03 * np.abs(left).max())
    assert np.abs(left).max() > 0.01


def test_a_base_that_is_stamped_late_is_replayed_in_time():
    right = record(seconds=6.0, noise=0.0)
    right_way, other_way = ([[0.008]], [[-0.008]])
    paths = []
    for r, offset in ((right, [[0.0]]), (late(right, 0.008), right_way), (late(right, 0.008), other_way)):
        windows = windows_of(take_of(r, ROBOT, np.full(4, 1e-9)), 0.5)

        def build(plant: Plant, values: Array) -> None:
            BaseClockShift().apply(plant, 0, values)

        paths.append(simulate(windows, build, np.array(offset))[0, 1:])
    np.testing.assert_allclose(paths[1], paths[0], atol=2e-3)
    assert np.abs(paths[2] - paths[0]).max() > 0.02


def test_a_base_that_stands_has_no_clock():
    held = record(seconds=2.0, held=True)
    loose, swung = held.with_base_held((0.0, 0.0, 0.3)), record(seconds=2.0)
    named = []
    for r, given in ((held, BOLTED), (loose, ROBOT), (swung, ROBOT)):
        trims = trims_for([project_recording(r, given, np.zeros(4))], TRIMS)
        named.append("base_clock_shift" in {t.effect.name for t in trims})
    assert named == [False, False, True]


def test_noise_of_the_base_is_counted_in_the_floor_of_a_replay():
    clean, noisy = (record(seconds=8.0, noise=n) for n in (0.0, 5.0))
    noisy = replace(noisy, position=clean.position)
    exact, read = (take_of(r, ROBOT, np.full(4, 1e-6)) for r in (clean, noisy))
    scatter = np.sqrt(np.mean((read.base.velocity - exact.base.velocity) ** 2, axis=0))
    np.testing.assert_allclose(np.sqrt(np.mean(read.base_noise**2, axis=0)), scatter, rtol=0.35)
    windows, nothing = windows_of(read, 0.5), Hypothesis(())
    path, true, misread = (
        simulate(windows_of(t, 0.5), nothing.build, np.zeros((1, 0)))[0]
        for t in (read, exact, read.misread(np.random.default_rng(0)))
    )
    made, guessed = (np.sqrt(((other - path) ** 2).mean((0, 1))) for other in (true, misread))
    assert (0.5 * made < guessed).all()
    assert (guessed < 1.2 * made).all()
    truth = [path]
    floors = [
        noise_floor([replace(windows, take=t)], nothing, np.zeros(0), truth, np.zeros(4), np.random.default_rng(0))
        for t in (read, replace(read, base_noise=0 * read.base_noise))
    ]
    assert (floors[0] > floors[1]).all()


def test_a_ball_in_the_room_is_no_base():
    ball = "<body pos='1 0 1'><freejoint name='ball'/><geom size='.1'/></body></worldbody>"
    beside = mujoco.MjModel.from_xml_string(model().replace("</worldbody>", ball))
    root = free_joint(beside)
    assert root is not None
    assert beside.joint(root).name == "root"
    with pytest.raises(RecordingError, match="joint 'ball' moves in the model but was not recorded"):
        JointAddress.of(beside, JOINTS)
    alone = mujoco.MjModel.from_xml_string(f"<mujoco><worldbody>{ball}</mujoco>")
    assert free_joint(alone) is None
    assert base_columns(alone) == (slice(0, 0), slice(0, 0))


def test_a_base_that_floats_must_be_recorded_and_one_that_does_not_must_not():
    held = Recording(TIME, JOINTS, np.zeros((len(TIME), 4)), position_target=np.zeros((len(TIME), 4)), kp=KP, kd=KD)
    with pytest.raises(RecordingError, match=r"free joint 'root'.* not recorded\. If it was clamped .*base='fixed'"):
        project_recording(held, ROBOT, np.zeros(4))
    with pytest.raises(RecordingError, match="were not recorded"):
        take_of(held, ROBOT, np.zeros(4))
    with pytest.raises(RecordingError, match=r"bolted to the world\. Give its trunk a <freejoint/>, or leave"):
        project_recording(held.with_base_held((0.0, 0.0, 0.3)), BOLTED, np.zeros(4))


def test_a_base_that_nobody_speaks_of_rests_where_the_model_has_it():
    at = JointAddress.of(ROBOT, JOINTS)
    q, v, a = np.random.default_rng(0).normal(size=(3, 5, 4))
    bolted = inverse_dynamics(BOLTED, JointAddress.of(BOLTED, JOINTS), q, v, a)
    np.testing.assert_allclose(inverse_dynamics(ROBOT, at, q, v, a), bolted, atol=1e-9)


def test_a_base_that_the_model_ties_to_the_world_is_refused():
    def tied(active: str) -> mujoco.MjModel:
        weld = f'<equality><weld name="gantry" body1="trunk" active="{active}"/></equality></mujoco>'
        return mujoco.MjModel.from_xml_string(model().replace("</mujoco>", weld))

    with pytest.raises(RecordingError, match="equality 'gantry' of the model ties 'trunk' to the world"):
        carried(tied("true"))
    carried(tied("false"))
