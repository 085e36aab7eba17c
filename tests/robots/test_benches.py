"""The benches against the textbook: masses, gravity, friction and energy, without any recording."""

import mujoco
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from torchrl_athletic.robots.benches import pendulum, slider, two_link_arm, unbalanced_disk, xl330_pendulum

GRAVITY = 9.81
angles = st.floats(-np.pi, np.pi)
speeds = st.floats(-10.0, 10.0)

BENCHES = {
    "emps_slider": (slider, ("carriage",), 351.5065),
    "two_link_arm": (two_link_arm, ("shoulder", "elbow"), 10.0),
    "pendulum": (pendulum, ("pendulum",), 12.0),
    "xl330_pendulum": (xl330_pendulum, ("pendulum",), 0.7123329),
    "unbalanced_disk": (unbalanced_disk, ("disk",), 0.0687113),
}


def build(mjcf: str) -> tuple[mujoco.MjModel, mujoco.MjData]:
    model = mujoco.MjModel.from_xml_string(mjcf)
    return model, mujoco.MjData(model)


def mass_matrix(model: mujoco.MjModel, data: mujoco.MjData) -> np.ndarray:
    rows = np.zeros((model.nv, model.nv))
    for row, unit in zip(rows, np.eye(model.nv), strict=True):
        mujoco.mj_mulM(model, data, row, unit)
    return rows


@pytest.mark.parametrize("name", BENCHES)
def test_one_motor_a_joint_whose_control_is_the_joint_torque_up_to_its_limit(name):
    bench, joints, limit = BENCHES[name]
    model, data = build(bench())
    assert tuple(model.joint(j).name for j in range(model.njnt)) == joints
    assert [model.joint(int(j)).name for j in model.actuator_trnid[:, 0]] == list(joints)
    data.ctrl[:] = 0.5 * limit
    mujoco.mj_forward(model, data)
    np.testing.assert_allclose(data.qfrc_actuator, 0.5 * limit, rtol=1e-6)
    data.ctrl[:] = -9.0 * limit
    mujoco.mj_forward(model, data)
    np.testing.assert_allclose(data.qfrc_actuator, -limit, rtol=1e-5)


@pytest.mark.parametrize("name", BENCHES)
def test_positive_torque_starts_a_motion_in_the_positive_direction(name):
    bench, _, limit = BENCHES[name]
    model, data = build(bench())
    data.ctrl[0] = 0.5 * limit
    for _ in range(5):
        mujoco.mj_step(model, data)
    assert data.qpos[0] > 0


def test_carriage_settles_at_the_speed_where_friction_and_offset_eat_the_force():
    model, data = build(slider())
    data.ctrl[:] = 60.0
    while data.time < 6.0:  # 13 time constants M / Fv
        mujoco.mj_step(model, data)
    assert data.qvel[0] == pytest.approx((60.0 - 20.3935 + 3.1648) / 203.5034, rel=1e-4)
    data.ctrl[:] = -60.0
    while data.time < 12.0:
        mujoco.mj_step(model, data)
    assert data.qvel[0] == pytest.approx((-60.0 + 20.3935 + 3.1648) / 203.5034, rel=1e-4)


def test_carriage_sticks_below_the_coulomb_force_and_leaves_above_it():
    model, data = build(slider(offset=0.0))
    data.ctrl[:] = 0.98 * 20.3935
    for _ in range(1000):
        mujoco.mj_step(model, data)
    assert abs(data.qpos[0]) < 1e-7  # m; the default solref creeps a thousand times as far
    data.ctrl[:] = 1.02 * 20.3935
    for _ in range(1000):
        mujoco.mj_step(model, data)
    assert data.qvel[0] == pytest.approx(0.02 * 20.3935 / 203.5034 * (1 - np.exp(-203.5034 / 95.1089)), rel=0.02)


def test_frictionloss_stops_a_carriage_as_coulombs_law_does():
    model, data = build(slider(damping=0.0, offset=0.0))
    data.qvel[:] = 0.1
    while data.time < 1.0:
        mujoco.mj_step(model, data)
    # v² M / 2 Fc, and half a step of the start speed for the integrator, which moves with the speed after the step
    assert data.qpos[0] == pytest.approx(0.1**2 * 95.1089 / (2 * 20.3935), abs=0.1 * 0.001)
    assert abs(data.qvel[0]) < 1e-9


@given(q=st.tuples(angles, angles), v=st.tuples(speeds, speeds))
def test_two_link_arm_obeys_the_textbook_with_inertias_about_the_joints(q, v):
    (m1, m2), (i1, i2), (r1, r2), l1 = (0.6, 0.7), (0.06, 0.03), (0.28, 0.18), 0.31
    rotor, gear = 8e-5, 6.0
    mjcf = two_link_arm(mass=(m1, m2), inertia=(i1, i2), com=(r1, r2), length=(l1, 0.2), rotor_inertia=rotor, gear=gear)
    model, data = build(mjcf)
    data.qpos[:], data.qvel[:] = q, v
    mujoco.mj_forward(model, data)
    coupling = m2 * l1 * r2
    m12 = i2 + coupling * np.cos(q[1]) - gear * rotor
    expected = [
        [i1 + i2 + m2 * l1**2 + 2 * coupling * np.cos(q[1]) + (gear**2 + 1) * rotor, m12],
        [m12, i2 + gear**2 * rotor],
    ]
    np.testing.assert_allclose(mass_matrix(model, data), expected, atol=1e-9)
    centrifugal = coupling * np.sin(q[1])
    gravity = m2 * GRAVITY * r2 * np.sin(q[0] + q[1])
    bias = [
        -centrifugal * v[1] * (2 * v[0] + v[1]) + (m1 * r1 + m2 * l1) * GRAVITY * np.sin(q[0]) + gravity,
        centrifugal * v[0] ** 2 + gravity,
    ]
    np.testing.assert_allclose(data.qfrc_bias, bias, atol=1e-8)


def test_links_alone_have_neither_friction_nor_rotor():
    model, _ = build(two_link_arm())
    for loss in (model.dof_damping, model.dof_frictionloss, model.dof_armature, model.tendon_armature):
        assert not loss.any()


@pytest.mark.parametrize("mjcf", [two_link_arm(), pendulum()], ids=["two_link_arm", "pendulum"])
def test_without_friction_no_energy_is_lost(mjcf):
    model, data = build(mjcf)
    model.opt.enableflags |= mujoco.mjtEnableBit.mjENBL_ENERGY
    data.qpos[:] = 1.0
    mujoco.mj_forward(model, data)
    start, energy = data.energy.sum(), []
    while data.time < 4.0:
        mujoco.mj_step(model, data)
        energy.append(data.energy.sum())
    swing = GRAVITY * model.body_mass.sum() * 0.5  # J, about what gravity can give
    np.testing.assert_allclose(energy, start, atol=0.01 * swing)


@given(q=angles)
def test_pendulum_is_a_point_mass_on_a_uniform_rod(q):
    model, data = build(pendulum(mass=0.5, rod_mass=0.2, length=0.4, armature=0.003))
    data.qpos[:] = q
    mujoco.mj_forward(model, data)
    assert mass_matrix(model, data).item() == pytest.approx((0.5 + 0.2 / 3) * 0.4**2 + 0.003)
    assert data.qfrc_bias[0] == pytest.approx((0.5 + 0.2 / 2) * 0.4 * GRAVITY * np.sin(q))


@given(q=angles)
def test_xl330_hangs_still_where_its_encoder_reads_minus_the_tilt(q):
    model, data = build(xl330_pendulum(mass=0.5, length=0.1, armature=0.002, tilt=0.03))
    data.qpos[:] = q
    mujoco.mj_forward(model, data)
    assert mass_matrix(model, data).item() == pytest.approx(0.5 * 0.1**2 + 0.002, rel=1e-6)
    assert data.qfrc_bias[0] == pytest.approx(0.5 * 0.1 * 9.80665 * np.sin(q + 0.03), abs=1e-9)


@given(q=angles)
def test_disk_has_the_published_frequency_whatever_its_mass(q):
    model, data = build(unbalanced_disk())
    data.qpos[:] = q
    mujoco.mj_forward(model, data)
    inertia = mass_matrix(model, data).item()
    assert inertia == pytest.approx(2.4421e-4)
    assert data.qfrc_bias[0] / inertia == pytest.approx(11.339847**2 * np.sin(q), abs=1e-6)


def test_disk_under_constant_voltage_settles_where_gravity_and_friction_hold_it():
    model, data = build(unbalanced_disk(frictionloss=0.0))
    data.ctrl[:] = 28.136158 * 2.4421e-4 * 1.5  # 1.5 V
    while data.time < 20.0:
        mujoco.mj_step(model, data)
    assert np.sin(data.qpos[0]) == pytest.approx(28.136158 * 1.5 / 11.339847**2, abs=1e-4)
