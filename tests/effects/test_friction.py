import mujoco
import numpy as np
import pytest
from effects.slider import MASS, STEP, push, slider, speed

from torchrl_athletic.effects import (
    AsymmetricFriction,
    CoulombFriction,
    JointAddress,
    ViscousFriction,
    project_recording,
)
from torchrl_athletic.recordings import Recording

PUSH = np.full(1000, 3.0)


def test_what_pushes_less_than_dry_friction_does_not_move_it_and_what_pushes_more_does():
    below, above = push(PUSH, (CoulombFriction(), [[3.3], [2.7]]))
    assert np.abs(below).max() < 1e-3  # MuJoCo's friction creeps
    assert above[-1] > 0.05


def test_dry_friction_takes_its_force_from_the_acceleration_either_way():
    for sign in (1, -1):
        (position,) = push(sign * PUSH, (CoulombFriction(), [1.0]))
        acceleration = np.diff(speed(position))[200:] / STEP
        np.testing.assert_allclose(acceleration, sign * (3.0 - 1.0) / MASS, rtol=1e-6)


def test_dry_friction_stops_a_coasting_mass_after_its_kinetic_energy_is_spent():
    force = np.where(np.arange(2000) < 500, 4.0, 0.0)
    (position,) = push(force, (CoulombFriction(), [1.5]))
    v = speed(position)
    distance = position[-1] - position[499]
    assert distance == pytest.approx(MASS * v[499] ** 2 / 2 / 1.5, rel=0.01)
    assert abs(v[-1]) < 1e-4


def test_viscous_friction_approaches_the_speed_at_which_it_balances_the_push():
    (position,) = push(np.full(3000, 3.0), (ViscousFriction(), [6.0]))
    time = STEP * (np.arange(len(position) - 1) + 1.5)
    np.testing.assert_allclose(speed(position), 3.0 / 6.0 * (1 - np.exp(-6.0 / MASS * time)), atol=2e-3)


@pytest.mark.parametrize("sign", [1, -1])
def test_the_terminal_speed_of_asymmetric_friction_is_that_of_its_direction(sign):
    coulomb, viscous = {1: (0.5, 4.0), -1: (1.25, 7.0)}[sign]
    (position,) = push(sign * np.full(3500, 3.0), (AsymmetricFriction(), [0.5, 1.25, 4.0, 7.0]))
    assert speed(position)[-1] == pytest.approx(sign * (3.0 - coulomb) / viscous, rel=1e-3)


def test_asymmetric_friction_with_equal_sides_is_coulomb_and_viscous_friction():
    force = 4.0 * np.sin(2 * np.pi * 2.0 * STEP * np.arange(1500))
    both = push(force, (AsymmetricFriction(), [0.7, 0.7, 3.0, 3.0]))
    apart = push(force, (CoulombFriction(), [0.7]), (ViscousFriction(), [3.0]))
    np.testing.assert_allclose(both, apart, atol=1e-9)


def test_asymmetric_friction_holds_a_mass_at_rest_up_to_the_level_of_each_direction():
    moved = [push(np.full(400, f), (AsymmetricFriction(), [1.0, 2.0, 0.0, 0.0]))[0, -1] for f in (0.9, 1.2, -1.9, -2.2)]
    assert np.abs(moved[0]) < 1e-3
    assert np.abs(moved[2]) < 1e-3
    assert moved[1] > 5e-3
    assert moved[3] < -5e-3


def test_a_saturated_motor_does_not_lift_the_friction_of_a_direction():
    """Friction is beside the motor, whose limit it must not share."""
    (position,) = push(np.full(3500, -9.0), (AsymmetricFriction(), [0.5, 1.5, 4.0, 4.0]), limit=3.0)
    assert speed(position)[-1] == pytest.approx(-(3.0 - 1.5) / 4.0, rel=1e-3)


def rail_take(position):
    """Signals of a motion on the rail, without noise."""
    time = 0.002 * np.arange(len(position))
    recording = Recording(time, ("rail",), position[:, None], torque_command=np.zeros((len(time), 1)))
    return project_recording(recording, slider(), np.zeros(1), kernel=0.02)


def test_the_columns_of_asymmetric_friction_are_one_sided_and_add_up_to_the_symmetric_ones():
    time = 0.002 * np.arange(3000)
    s = rail_take(np.sin(2 * time) + 0.2 * np.sin(5 * time))
    columns = AsymmetricFriction().fingerprint(s, 0, {}).columns[:, 0]
    dry = CoulombFriction().fingerprint(s, 0, {}).columns[:, 0, 0]
    viscous = ViscousFriction().fingerprint(s, 0, {}).columns[:, 0, 0]
    np.testing.assert_allclose(columns[:, 0] + columns[:, 1], dry, atol=1e-12)
    np.testing.assert_allclose(columns[:, 2] + columns[:, 3], viscous, atol=1e-4)
    v = s.velocity[:, 0]
    fast = np.abs(v) > 0.5
    np.testing.assert_allclose(columns[fast, 0], -(v[fast] > 0).astype(float), atol=0.03)  # brakes the forward motion
    np.testing.assert_allclose(columns[fast, 1], (v[fast] < 0).astype(float), atol=0.03)
    np.testing.assert_allclose(columns[fast, 2], -np.maximum(v[fast], 0), atol=1e-2)
    np.testing.assert_allclose(columns[fast, 3], -np.minimum(v[fast], 0), atol=1e-2)


def test_a_link_without_a_motor_limit_may_have_friction_beyond_its_weight():
    model = mujoco.MjModel.from_xml_string(
        '<mujoco><worldbody><body><joint name="hinge" axis="0 1 0"/>'
        '<inertial pos="0 0 -0.4" mass="0.5" diaginertia="1e-3 1e-3 1e-3"/></body></worldbody></mujoco>'
    )
    (torque,) = CoulombFriction().parameters(model, JointAddress.of(model, ("hinge",)), 0)
    weight = 0.5 * 9.81 * 0.4  # felt a quarter turn away: hanging down it feels none
    assert torque.upper >= weight
    assert torque.scale == pytest.approx(0.02 * weight)
