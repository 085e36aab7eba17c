"""The concealed Z1 is a Z1, loses energy as a real one does, and tells no more than its drives know."""

from __future__ import annotations

import mujoco
import numpy as np
import pytest

from benchmarks.concealed import arm as source
from benchmarks.concealed.arm import RESOLUTION, ConcealedArm, bodies
from benchmarks.concealed.harmonic import STATES, advance, derivative, elastic_torque, ideal, workroom
from benchmarks.concealed.plant import inverse
from torchrl_athletic.robots import Bucket, b2z1, z1

POSE = np.array([0.3, 1.2, -1.6, -0.4, 0.2, -0.5, 0.0])


def witness(tool=None):
    """MuJoCo's model without what belongs to the drives, or touches."""
    model = z1(tool=tool).model()
    model.dof_armature[:] = model.dof_damping[:] = model.dof_frictionloss[:] = 0.0
    model.opt.disableflags |= int(mujoco.mjtDisableBit.mjDSBL_CONSTRAINT)
    return model


@pytest.fixture(scope="module")
def arm():
    return ConcealedArm()


def test_its_links_have_the_models_inverse_dynamics():
    tree, _, _ = bodies(z1())
    model = witness()
    data = mujoco.MjData(model)
    q, v, a = np.random.default_rng(0).normal(size=(3, 20, 6))
    ours, _ = inverse(tree, q, v, a)
    for k in range(len(q)):
        data.qpos[:6], data.qvel[:6], data.qacc[:6] = q[k], v[k], a[k]
        mujoco.mj_inverse(model, data)
        np.testing.assert_allclose(ours[k], data.qfrc_inverse[:6], rtol=1e-9, atol=1e-9)


def test_under_the_gears_torques_its_links_accelerate_as_mujocos_do():
    tree, _, _ = bodies(z1())
    p = ideal(6)
    model = witness()
    data = mujoco.MjData(model)
    rng = np.random.default_rng(1)
    x, out = np.zeros((6, STATES)), np.zeros((6, STATES))
    for _ in range(10):
        x[:, 0], x[:, 1], x[:, 3] = rng.normal(size=(3, 6))
        x[:, 2] = x[:, 0] + 1e-3 * rng.normal(size=6)
        derivative(tree, p, x, np.zeros(6), workroom(6), out)
        data.qpos[:6], data.qvel[:6], data.qacc[:6] = x[:, 0], x[:, 1], out[:, 1]
        mujoco.mj_inverse(model, data)
        np.testing.assert_allclose(data.qfrc_inverse[:6], 1e4 * (x[:, 2] - x[:, 0]), rtol=1e-6, atol=1e-6)


def test_the_stiffer_its_gears_the_closer_it_moves_to_a_rigid_arm():
    tree, _, _ = bodies(z1())
    model = witness()
    model.dof_armature[:] = 0.03
    model.opt.timestep, model.opt.integrator = 2.5e-4, mujoco.mjtIntegrator.mjINT_RK4
    data = mujoco.MjData(model)
    data.qpos[:] = POSE
    data.qpos[6] = 0.0
    torque = np.append(inverse(tree, POSE[None, :6], np.zeros((1, 6)), np.zeros((1, 6)))[0][0], 0.0) + 1.0
    model.dof_armature[6] = 1e6  # clamped
    data.ctrl[:] = torque
    mujoco.mj_step(model, data, nstep=800)

    away = []
    for stiffness in (5e3, 2e4):
        p, x = ideal(6), np.zeros((6, STATES))
        p["first_stiffness"], p["gear_damping"] = stiffness, 5.0
        x[:, 0] = POSE[:6]
        x[:, 2] = POSE[:6] + torque[:6] / stiffness
        advance(tree, p, x, torque[:6], 5e-5, 4000, workroom(6), np.zeros((5, 6, STATES)))
        away.append(np.abs(x[:, 0] - data.qpos[:6]).max())
    assert np.abs(data.qpos[:6] - POSE[:6]).max() > 0.3  # it did move
    assert away[1] < 0.35 * away[0]
    assert away[1] < 5e-3


def energy(tree, p, x, model, data) -> float:
    """Energy of links, rotors, springs and bristles [J]; MuJoCo weighs the links."""
    data.qpos[:6], data.qvel[:6] = x[:, 0], x[:, 1]
    mujoco.mj_forward(model, data)
    stored = data.energy.sum() + 0.5 * (p["rotor"] * x[:, 3] ** 2).sum()
    for j in range(6):
        windup = np.linspace(0.0, x[j, 2] - x[j, 0], 2001)
        torque = np.array([elastic_torque(p[j], w) for w in windup])
        stored += np.trapezoid(torque, windup)
    stored += 0.5 * (x[:, 4] ** 2 / p["bristle_stiffness"]).sum()
    stored += 0.5 * (x[:, 5] ** 2 / p["hysteresis_stiffness"]).sum()
    return float(stored)


def test_left_alone_it_never_gains_energy(arm):
    tree, _, _ = bodies(z1())
    p = arm._drives.copy()
    p["lowest"], p["highest"] = -np.inf, np.inf
    model = witness()
    model.opt.enableflags |= int(mujoco.mjtEnableBit.mjENBL_ENERGY)
    data = mujoco.MjData(model)
    x = np.zeros((6, STATES))
    x[:, 0] = x[:, 2] = POSE[:6]
    x[:, 1] = x[:, 3] = np.array([2.0, -1.0, 2.0, 3.0, -2.0, 2.0])
    room, slopes, course = workroom(6), np.zeros((5, 6, STATES)), []
    for _ in range(100):
        course.append(energy(tree, p, x, model, data))
        advance(tree, p, x, np.zeros(6), 1e-4, 50, room, slopes)
    assert np.diff(course).max() < 1e-6 * np.ptp(course)
    assert np.ptp(course) > 1.0


def test_a_take_is_the_same_as_its_steps(arm):
    target = POSE + 0.2 * np.sin(np.arange(40) / 5)[:, None]
    target[:, 6] = 0.0
    recording = arm.play(target)
    readings = [arm.reset(target[0])] + [arm.step(row) for row in target[:-1]]
    np.testing.assert_array_equal(recording.position, [r.position for r in readings])
    np.testing.assert_array_equal(recording.velocity, [r.velocity for r in readings])
    torque = np.array([r.torque for r in readings])
    np.testing.assert_allclose(recording.torque_measured, torque, atol=8 * 0.005 * 60.0)  # noise of both
    assert np.abs(torque).max() > 10.0  # far above that noise
    assert recording.rate == pytest.approx(arm.rate)
    assert recording.torque_semantics == "current_derived"


def test_the_seed_draws_the_noise_of_the_current_and_nothing_else():
    target = np.tile(POSE, (30, 1))
    first, again, other = (ConcealedArm(seed=seed).play(target) for seed in (0, 0, 1))
    np.testing.assert_array_equal(first.torque_measured, again.torque_measured)
    np.testing.assert_array_equal(first.position, other.position)
    assert 0.1 < np.std(first.torque_measured - other.torque_measured) < 0.5


def test_what_it_tells_is_the_rotor_and_not_the_link(arm):
    reading, truth = arm.reset(POSE), arm.true_state()
    steps = reading.position / RESOLUTION
    np.testing.assert_allclose(steps, np.round(steps), atol=1e-6)
    windup = reading.position[2] - truth.position[2]
    assert -1e-2 < windup < -2e-4  # the forearm's weight winds its gear up


def test_its_drives_close_the_loop_with_the_gains_that_they_are_given(arm):
    soft = arm.reset(POSE, kp=0.5 * np.array(z1().kp))
    stiff = arm.reset(POSE, kp=4.0 * np.array(z1().kp))
    assert abs(soft.position - POSE)[2] > 3 * abs(stiff.position - POSE)[2] > 0.0


def test_more_damping_makes_it_slower(arm):
    target = np.tile(POSE, (60, 1))
    target[:, 0] += 0.4
    light, heavy = (arm.play(target, start=POSE, kd=k * np.array(z1().kd)).velocity[:, 0].max() for k in (1.0, 10.0))
    push = 0.4 * z1().kp[0]
    assert 0.3 < heavy < push / (10.0 * z1().kd[0])  # what damping alone would leave
    assert light > 1.5 * heavy


def test_a_joint_that_rests_has_no_speed(arm):
    speed = arm.play(np.tile(POSE, (100, 1))).velocity
    assert (speed[-1, [0, 5]] == 0.0).all()
    assert ((speed == 0.0) | (np.abs(speed) >= 1e-6)).all()


def test_a_target_takes_time_to_arrive_and_to_act(arm):
    arm.reset(POSE)
    before = arm.true_state().position[0]
    arm.step(POSE + np.array([0.4, 0, 0, 0, 0, 0, 0]))
    after = arm.true_state().position[0]
    immediate = 0.5 * 0.4 * 64.0 / 0.2 * 0.005**2  # constant torque on the least inertia that joint 1 has
    assert 0.0 <= abs(after - before) < 0.3 * immediate
    for _ in range(40):
        arm.step(POSE + np.array([0.4, 0, 0, 0, 0, 0, 0]))
    assert arm.true_state().position[0] - before > 0.25


def test_its_torques_stay_within_the_line_of_the_data_sheet(arm):
    target = np.tile(POSE, (100, 1))
    target[50:, 0] += 1.5
    recording = arm.play(target)
    noise = 5 * 0.005 * 30.0
    assert 20.0 < recording.torque_measured[:, 0].max() < 30.0 + noise
    fast = recording.velocity[:, 0] > 2.0
    assert fast.any()
    assert recording.torque_measured[fast, 0].max() < 30.0 * (1 - 1.5 / 3.14) + noise


def test_it_stays_near_the_ends_of_its_joints(arm):
    target = np.tile(POSE, (200, 1))
    target[:, 4] = 3.0
    arm.play(target)
    assert 1.3439 < arm.true_state().position[4] < 1.3439 + 0.05


def test_the_tool_is_where_mujoco_has_it_and_moves_as_its_place_does():
    robot = z1(tool=Bucket())
    arm = ConcealedArm(robot, payload=0.1)
    arm.reset(POSE)
    for k in range(20):
        arm.step(POSE + np.append(0.02 * k * np.ones(6), 0.0))
    now = arm.true_state()
    model = robot.model()
    data = mujoco.MjData(model)
    data.qpos[:7], data.qvel[:7] = now.position, now.velocity
    mujoco.mj_forward(model, data)
    np.testing.assert_allclose(now.site_position, data.site("bucket").xpos, atol=1e-9)
    np.testing.assert_allclose(now.site_rotation, data.site("bucket").xmat.reshape(3, 3), atol=1e-9)
    np.testing.assert_allclose(now.site_velocity, data.sensor("bucket_linear_velocity").data, atol=1e-9)
    assert np.linalg.norm(now.site_velocity) > 0.1


@pytest.mark.parametrize("tool", [None, Bucket()])
def test_a_payload_pulls_by_its_weight_at_the_tool(tool):
    robot = z1(tool=tool)
    still = np.zeros((1, 6))
    without, with_it = (inverse(bodies(robot, m)[0], POSE[None, :6], still, still)[0][0] for m in (0.0, 0.7))
    model = robot.model()
    data = mujoco.MjData(model)
    data.qpos[:7] = POSE
    mujoco.mj_forward(model, data)
    jacobian = np.zeros((3, model.nv))
    mujoco.mj_jacSite(model, data, jacobian, None, model.site("bucket" if tool else "end_effector").id)
    np.testing.assert_allclose(with_it - without, 9.81 * 0.7 * jacobian[2, :6], atol=1e-9)


def test_a_tool_changes_nothing_that_the_arm_hides():
    empty, armed = ConcealedArm(), ConcealedArm(z1(tool=Bucket()))
    assert (empty._drives == armed._drives).all()
    np.testing.assert_array_equal(empty._torque_scale, armed._torque_scale)
    np.testing.assert_array_equal(empty._tree.mass[:5], armed._tree.mass[:5])
    assert armed._tree.mass[5] - empty._tree.mass[5] == pytest.approx(0.2)  # the bucket was weighed


def test_its_links_are_not_quite_those_of_the_data_sheet(arm):
    nominal, _, _ = bodies(z1())
    share = arm._tree.mass / nominal.mass - 1
    assert 0.005 < np.std(share) < 0.1
    np.testing.assert_array_equal(arm._tree.place, nominal.place)


def test_two_motors_hold_the_shoulder():
    drives = np.stack([source._drives(z1(), np.random.default_rng(seed)) for seed in range(200)])
    for name in ("rotor", "coulomb", "first_stiffness", "hysteresis"):
        assert drives[name][:, 1].mean() / drives[name][:, 0].mean() == pytest.approx(2.0, rel=0.1)


@pytest.mark.parametrize(
    ("act", "advice"),
    [
        (lambda arm: ConcealedArm(b2z1()), "Give z1\\(\\)"),
        (lambda arm: ConcealedArm(payload=-1.0), "mass of 0 or more"),
        (lambda arm: arm.reset(np.zeros(6)), "one finite number for each of joint1"),
        (lambda arm: arm.step(np.full(7, np.nan)), "one finite number for each"),
        (lambda arm: arm.play(np.zeros((10, 6))), "\\(T, 7\\)"),
    ],
)
def test_what_it_cannot_do_is_said(arm, act, advice):
    with pytest.raises(ValueError, match=advice):
        act(arm)
