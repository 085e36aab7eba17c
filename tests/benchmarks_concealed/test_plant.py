"""The concealed plant obeys mechanics; MuJoCo, which it does not know, is the witness."""

from __future__ import annotations

import mujoco
import numpy as np
import pytest

from benchmarks.concealed import laws
from benchmarks.concealed.hidden import Truth, conceal, nominal_body
from benchmarks.concealed.plant import STEP, Drive, inverse, simulate
from benchmarks.concealed.robots import SEALED, TUNING, Robot, perturbed, upright, with_point

ROBOTS = {**SEALED, **TUNING}


def robot_of(name: str, seed: int = 3) -> Robot:
    return ROBOTS[name](np.random.default_rng(seed))


def pushed(robot: Robot, torque: np.ndarray, period: float = 0.005, sample_late: float = 0.0) -> Drive:
    """Torques without feedback, held for a period each; perfect encoders."""
    samples, joints = torque.shape
    time, none = np.arange(samples) * period, np.zeros_like(torque)
    zero, limit = np.zeros(joints), np.full(joints, 1e9)
    fine = np.full(joints, 1e-14)
    return Drive(time, none, none, torque, zero, zero, limit, False, time - sample_late, none, fine, 0.0)


def run(robot: Robot, body, drive: Drive, start=None, step: float = STEP):
    """Readings and speeds at the instants of the loop."""
    begin = robot.centre if start is None else start
    out = simulate(body.tree, body.laws, body.elements, body.gear_elements, drive, begin, step)
    return out[3], out[4]


def hide(robot: Robot, truth: Truth, rich: bool = False, tree=None):
    body = nominal_body(robot, robot.tree if tree is None else tree)
    return conceal(body, robot, truth, rich, np.random.default_rng(0))


@pytest.mark.parametrize("name", ROBOTS)
def test_the_model_that_is_given_has_the_robots_inverse_dynamics(name):
    robot = robot_of(name)
    model = mujoco.MjModel.from_xml_string(robot.model_xml)
    model.opt.disableflags |= int(mujoco.mjtDisableBit.mjDSBL_CONSTRAINT)
    data = mujoco.MjData(model)
    q, v, a = np.random.default_rng(0).normal(size=(3, 10, robot.joints))
    ours = inverse(robot.tree, q, v, a)[0] + robot.armature * a + robot.damping * v
    for k in range(len(q)):
        data.qpos[:], data.qvel[:], data.qacc[:] = q[k], v[k], a[k]
        mujoco.mj_inverse(model, data)
        np.testing.assert_allclose(ours[k], data.qfrc_inverse, rtol=1e-9, atol=1e-9 * robot.torque_limit.max())


@pytest.mark.parametrize("name", ["arm6", "scara"])
def test_a_robot_that_hides_nothing_moves_as_mujoco_moves_it(name):
    robot = robot_of(name)
    model = mujoco.MjModel.from_xml_string(robot.model_xml)
    model.opt.timestep, model.opt.integrator = 0.00025, mujoco.mjtIntegrator.mjINT_RK4
    data = mujoco.MjData(model)
    data.qpos[:] = robot.centre
    push = 0.05 * robot.torque_limit * np.random.default_rng(1).uniform(-1, 1, (60, robot.joints))
    push += robot.gravity_torque(robot.centre)
    ours, _ = run(robot, nominal_body(robot, robot.tree), pushed(robot, push))
    for k in range(60):
        np.testing.assert_allclose(ours[k], data.qpos, atol=2e-6)
        data.ctrl[:] = push[k]
        mujoco.mj_step(model, data, nstep=20)
    assert np.abs(ours[-1] - ours[0]).max() > 0.01  # it did move


@pytest.mark.parametrize("name", ["leg3", "scara"])
def test_without_friction_energy_stays(name):
    robot = robot_of(name)
    body = nominal_body(robot, robot.tree)
    body.laws["viscous_positive"] = body.laws["viscous_negative"] = 0.0
    start = robot.centre + 0.3 * robot.reach
    q, v = run(robot, body, pushed(robot, np.zeros((200, robot.joints))), start)
    model = mujoco.MjModel.from_xml_string(robot.model_xml)
    model.opt.enableflags |= int(mujoco.mjtEnableBit.mjENBL_ENERGY)
    data, energy = mujoco.MjData(model), []
    for k in range(0, 200, 10):
        data.qpos[:], data.qvel[:] = q[k], v[k]
        mujoco.mj_forward(model, data)
        energy.append(data.energy.copy())
    total, kinetic = np.sum(energy, axis=1), np.array(energy)[:, 1]
    assert np.ptp(total) < 1e-5 * kinetic.max()


def test_halving_the_step_changes_a_smooth_motion_by_a_millionth():
    robot = robot_of("arm3")
    push = robot.gravity_torque(robot.centre) + 0.1 * robot.torque_limit * np.sin(np.arange(100) / 7)[:, None]
    body = nominal_body(robot, robot.tree)
    coarse, _ = run(robot, body, pushed(robot, push))
    fine, _ = run(robot, body, pushed(robot, push), step=STEP / 2)
    assert np.abs(coarse - fine).max() < 1e-6 * np.ptp(fine)


def level_slider() -> Robot:
    robots = (robot_of("slider", seed) for seed in range(20))
    return next(r for r in robots if abs(r.tree.turn[0][2] @ r.tree.axis[0]) < 1e-12)


@pytest.mark.parametrize("rich", [False, True])
def test_dry_friction_holds_below_its_torque_and_takes_it_off_above(rich):
    robot = level_slider()
    body = hide(robot, Truth("coulomb_friction", "carriage", {"torque": 2.0}, {"presliding": 1e-3}), rich)
    body.laws["viscous_positive"] = body.laws["viscous_negative"] = 0.0
    stuck, _ = run(robot, body, pushed(robot, np.full((200, 1), 1.5)))
    assert abs(stuck[-1, 0] - stuck[0, 0]) < 2e-3
    _, speed = run(robot, body, pushed(robot, np.full((100, 1), 5.0)))
    mass = robot.tree.mass[0] + robot.armature[0]
    assert (speed[-1, 0] - speed[-21, 0]) / 0.1 == pytest.approx((5.0 - 2.0) / mass, rel=1e-3)


def test_a_slow_joint_feels_the_breakaway_level_and_a_fast_one_the_sliding_level():
    law = laws.plain(1)
    law["coulomb_positive"], law["breakaway_ratio"], law["stribeck_speed"] = 2.0, 1.5, 0.1
    assert laws.friction_level(law[0], 0.0, 0.0, 0.0, 1.0) == pytest.approx(3.0)
    assert laws.friction_level(law[0], 0.0, 2.0, 0.0, 1.0) == pytest.approx(2.0)
    law["load_coefficient"] = 0.1
    assert laws.friction_level(law[0], 0.0, 2.0, -30.0, 1.0) == pytest.approx(2.0 + 3.0)


def test_a_gap_bears_nothing_inside_and_half_of_it_is_lost_on_either_side():
    law = laws.plain(1)
    law["gap"] = 0.04
    assert laws.flank(law[0], 0.015) == laws.flank(law[0], -0.02) == 0.0
    assert laws.flank(law[0], 0.05) == pytest.approx(0.03)
    assert laws.flank(law[0], -0.05) == pytest.approx(-0.03)
    law["rounding"] = 0.002
    assert laws.flank(law[0], 0.0) == pytest.approx(0.0, abs=1e-12)
    assert laws.flank(law[0], 0.05) == pytest.approx(0.03, abs=2e-4)


def test_a_very_stiff_gear_is_a_rigid_one():
    robot = robot_of("leg2")
    push = 0.1 * robot.torque_limit * np.sin(np.arange(80) / 5)[:, None]
    rigid, _ = run(robot, nominal_body(robot, robot.tree), pushed(robot, push))
    stiff = Truth("compliance", "hip", {"stiffness": 3e4}, {"damping": 5.0})
    geared, _ = run(robot, hide(robot, stiff), pushed(robot, push), step=2e-5)
    soft = Truth("compliance", "hip", {"stiffness": 10.0}, {"damping": 0.05})
    loose, _ = run(robot, hide(robot, soft), pushed(robot, push))
    assert np.abs(geared - rigid).max() < 0.01 * np.abs(loose - rigid).max()


def test_a_late_command_moves_the_robot_as_much_later():
    robot = level_slider()
    push = np.random.default_rng(0).normal(size=(100, 1))
    time = np.arange(100) * 0.005
    prompt, _ = run(robot, nominal_body(robot, robot.tree), pushed(robot, push))
    late, _ = run(robot, hide(robot, Truth("actuation_delay", "carriage", {"delay": 0.0123})), pushed(robot, push))
    then = np.interp(time[10:] - 0.0123, time, prompt[:, 0])
    moved = np.ptp(prompt)
    assert np.abs(late[10:, 0] - then).max() < 1e-3 * moved < 0.2 * np.abs(late - prompt).max()


def test_position_stamps_that_are_late_show_an_earlier_position():
    robot = level_slider()
    push, body = np.ones((100, 1)), nominal_body(robot, robot.tree)
    drive = pushed(robot, push, sample_late=0.004)
    _, reading, _, clean, _ = simulate(
        body.tree, body.laws, body.elements, body.gear_elements, drive, robot.centre, STEP
    )
    before = np.interp(drive.time - 0.004, drive.time, clean[:, 0])
    np.testing.assert_allclose(reading[10:, 0], before[10:], atol=2e-5 * np.ptp(clean))
    assert (reading[10:, 0] < clean[10:, 0]).all()


def test_what_is_declared_the_same_physics_gives_the_same_recording():
    robot = level_slider()
    mass = float(robot.tree.mass[0])
    push = np.sin(np.arange(60) / 4)[:, None]
    payload, _ = run(robot, hide(robot, Truth("payload", "carriage", {"mass": 0.4 * mass})), pushed(robot, push))
    heavy, _ = run(robot, hide(robot, Truth("link_mass", "carriage", {"mass": 1.4 * mass})), pushed(robot, push))
    rotor = Truth("reflected_inertia", "carriage", {"armature": float(robot.armature[0]) + 0.4 * mass})
    geared, _ = run(robot, hide(robot, rotor), pushed(robot, push))
    light, _ = run(robot, nominal_body(robot, robot.tree), pushed(robot, push))
    np.testing.assert_allclose(payload, heavy, atol=1e-12)
    np.testing.assert_allclose(geared, heavy, atol=1e-12)
    assert np.abs(light - heavy).max() > 1e-4


def test_a_point_mass_at_the_tip_loads_the_joint_by_its_lever():
    robot = robot_of("pendulum")
    loaded = with_point(robot.tree, 0, 0.5, robot.tip[0])
    q = np.array([[0.7]])
    still = np.zeros((1, 1))
    more = inverse(loaded, q, still, still)[0] - inverse(robot.tree, q, still, still)[0]
    lever = np.linalg.norm(robot.tip[0]) * np.sin(0.7)
    assert abs(more[0, 0]) == pytest.approx(0.5 * 9.81 * lever)
    spin = inverse(loaded, q, still, still + 1)[1] - inverse(robot.tree, q, still, still + 1)[1]
    assert spin[0, 0, 0] == pytest.approx(0.5 * np.linalg.norm(robot.tip[0]) ** 2)


def test_models_err_by_three_percent_and_no_more():
    robot = robot_of("arm6")
    tree = perturbed(robot, 0.03, np.random.default_rng(0))
    share = tree.mass / robot.tree.mass - 1
    assert 0.005 < np.abs(share).max() <= 0.03
    size = np.linalg.norm(tree.inertia, axis=(1, 2)) / np.linalg.norm(robot.tree.inertia, axis=(1, 2)) - 1
    assert 0.005 < np.abs(size).max() <= 0.03 + 1e-12


def test_only_axes_along_gravity_are_upright():
    assert [upright(robot_of("arm3"), j) for j in range(3)] == [True, False, False]
    assert [upright(robot_of("scara"), j) for j in range(4)] == [True, True, False, False]
