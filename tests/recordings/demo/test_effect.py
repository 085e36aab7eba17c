"""Each effect changes the motion as its closed form says, with the sign that the catalogue gives it."""

from dataclasses import replace

import numpy as np
import pytest

from torchrl_athletic.effects import CATALOGUE
from torchrl_athletic.recordings.demo import (
    PARAMETERS,
    HiddenEffect,
    machine_with,
    make_recordings,
    pendulum,
    random_effect,
    simulate,
    slider,
    two_link_arm,
)
from torchrl_athletic.recordings.demo.robot import GRAVITY

TIME = np.arange(1601) / 200
BARE = replace(slider(), links=(replace(slider().links[0], damping=0.0, stiffness=0.0),))
MASS = BARE.links[0].mass


def pushed(name, force, robot=BARE, **parameters):
    """Motion of a slider under a force, or forces over TIME."""
    machine = machine_with(robot, [HiddenEffect(name, "carriage", parameters)])
    position, velocity = simulate(machine, TIME, np.broadcast_to(force, TIME.shape)[:, None])
    return position[:, 0], velocity[:, 0]


def rest(name, command=0.0, **parameters):
    """Angle at which a pendulum in honey comes to rest under a torque."""
    thick = replace(pendulum(), links=(replace(pendulum().links[0], damping=0.6),))
    machine = machine_with(thick, [HiddenEffect(name, "pendulum", parameters)])
    position, _ = simulate(machine, np.array([0.0, 15.0]), np.full((2, 1), command), step=0.005)
    return position[-1, 0]


def weight(mass):
    return mass * pendulum().links[0].com * GRAVITY


def test_coulomb_friction_subtracts_from_the_push():
    position, _ = pushed("coulomb_friction", 10.0, torque=4.0)
    np.testing.assert_allclose(position, 0.5 * (10.0 - 4.0) / MASS * TIME**2, atol=1e-9)


def test_viscous_friction_limits_the_speed():
    _, velocity = pushed("viscous_friction", 10.0, damping=8.0)
    np.testing.assert_allclose(velocity, 10.0 / 8.0 * (1 - np.exp(-8.0 / MASS * TIME)), atol=1e-9)


@pytest.mark.parametrize(("force", "speed"), [(10.0, (10.0 - 1.0) / 8.0), (-10.0, -(10.0 - 2.0) / 16.0)])
def test_asymmetric_friction_lets_each_direction_have_its_own_speed(force, speed):
    levels = {"coulomb_positive": 1.0, "coulomb_negative": 2.0, "viscous_positive": 8.0, "viscous_negative": 16.0}
    _, velocity = pushed("asymmetric_friction", force, **levels)
    assert velocity[-1] == pytest.approx(speed, rel=1e-5)


def test_asymmetric_friction_holds_more_one_way_than_the_other():
    levels = {"coulomb_positive": 6.0, "coulomb_negative": 2.0, "viscous_positive": 0.0, "viscous_negative": 0.0}
    assert (pushed("asymmetric_friction", 4.0, **levels)[0] == 0).all()
    np.testing.assert_allclose(
        pushed("asymmetric_friction", -4.0, **levels)[0], -0.5 * (4.0 - 2.0) / MASS * TIME**2, atol=1e-9
    )


def test_reflected_inertia_is_accelerated_with_the_mass():
    position, _ = pushed("reflected_inertia", 10.0, armature=2.0)
    np.testing.assert_allclose(position, 0.5 * 10.0 / (MASS + 2.0) * TIME**2, atol=1e-9)


def test_link_mass_pulls_with_its_weight_and_swings_with_its_inertia():
    assert rest("link_mass", 1.0, mass=1.1) == pytest.approx(np.arcsin(1.0 / weight(1.1)), abs=1e-6)
    link = replace(pendulum().links[0], damping=0.0, armature=0.0)
    heavier = machine_with(replace(pendulum(), links=(link,)), [HiddenEffect("link_mass", "pendulum", {"mass": 2.0})])
    nominal = machine_with(replace(pendulum(), links=(link,)))
    zero, start = np.zeros((len(TIME), 1)), np.array([1.0])
    np.testing.assert_allclose(  # weight and inertia in proportion: the free swing is the same
        simulate(heavier, TIME, zero, start=start)[0], simulate(nominal, TIME, zero, start=start)[0], atol=1e-9
    )


def test_torque_scale_multiplies_the_command():
    assert rest("torque_scale", 1.0, scale=1.3) == pytest.approx(np.arcsin(1.3 / weight(0.7)), abs=1e-6)


def test_torque_offset_adds_to_the_command_and_shifts_the_equilibrium():
    assert rest("torque_offset", torque=-0.4) == pytest.approx(-np.arcsin(0.4 / weight(0.7)), abs=1e-6)
    assert rest("torque_offset", 0.1, torque=-0.4) == pytest.approx(-np.arcsin(0.3 / weight(0.7)), abs=1e-6)


@pytest.mark.parametrize("delay", [0.015, 0.0123])
def test_a_delay_shifts_the_response(delay):
    force = np.where(TIME >= 0.5, 10.0, 0.0)
    position, _ = pushed("actuation_delay", force, delay=delay)
    np.testing.assert_allclose(position, 0.5 * 10.0 / MASS * np.clip(TIME - 0.5 - delay, 0, None) ** 2, atol=1e-9)


def test_a_lag_lets_the_force_creep_in():
    force = np.where(TIME >= 0.5, 10.0, 0.0)
    _, velocity = pushed("actuation_lag", force, time_constant=0.04)
    late = np.clip(TIME - 0.5, 0, None)
    np.testing.assert_allclose(velocity, 10.0 / MASS * (late - 0.04 * (1 - np.exp(-late / 0.04))), atol=1e-9)


def test_an_encoder_offset_is_reading_minus_true_position():
    effect = HiddenEffect("encoder_offset", "elbow", {"offset": 0.07})
    [shifted] = make_recordings(two_link_arm(), [effect], seed=4, duration=2.0)
    [plain] = make_recordings(two_link_arm(), [], seed=4, duration=2.0)
    assert (shifted.position - plain.position)[:, 0] == pytest.approx(0.0, abs=1e-15)
    assert (shifted.position - plain.position)[:, 1] == pytest.approx(0.07)


def test_under_position_control_the_reading_with_its_offset_reaches_the_target():
    machine = machine_with(BARE, [HiddenEffect("encoder_offset", "carriage", {"offset": 0.03})])
    position, _ = simulate(machine, TIME, np.full((len(TIME), 1), 0.1), position_control=True)
    assert position[-1, 0] + 0.03 == pytest.approx(0.1, abs=1e-9)


def test_gains_scale_the_drives_own():
    kp, kd, stiffness = 1500.0 * 0.7, 80.0 * 1.5, 150.0
    robot = replace(BARE, links=(replace(BARE.links[0], stiffness=stiffness),))
    machine = machine_with(robot, [HiddenEffect("gain_mismatch", "carriage", {"kp_scale": 0.7, "kd_scale": 1.5})])
    target = np.full((len(TIME), 1), 0.1)
    position, _ = simulate(machine, TIME, target, position_control=True, drive_period=0.00025)
    goal, decay = 0.1 * kp / (kp + stiffness), kd / (2 * MASS)
    frequency = np.sqrt((kp + stiffness) / MASS - decay**2)
    wave = np.exp(-decay * TIME) * (np.cos(frequency * TIME) + decay / frequency * np.sin(frequency * TIME))
    np.testing.assert_allclose(position[:, 0], goal * (1 - wave), atol=5e-4)
    assert position[-1, 0] == pytest.approx(goal, abs=1e-9)


def test_the_motor_gives_no_more_than_its_limit():
    position, _ = pushed("torque_scale", 100.0, scale=1.5)
    np.testing.assert_allclose(position, 0.5 * BARE.torque_limit[0] / MASS * TIME**2, rtol=1e-9)


def test_effects_and_parameters_bear_the_names_of_the_catalogue():
    assert set(PARAMETERS) <= {effect.name for effect in CATALOGUE}
    for effect in CATALOGUE:
        for name in PARAMETERS.get(effect.name, ()):
            assert f"``{name}``" in (effect.__doc__ or "")


@pytest.mark.parametrize("name", PARAMETERS)
@pytest.mark.parametrize("robot", [slider(), two_link_arm()], ids=["slider", "arm"])
def test_every_drawn_effect_moves_the_robot_otherwise(robot, name):
    for joint in robot.joint_names:
        effect = random_effect(robot, name, joint, seed=1)
        assert effect == random_effect(robot, name, joint, seed=1)
        assert effect != random_effect(robot, name, joint, seed=2)
        command = {"seed": 5, "duration": 1.0, "field": "position_target"}
        [with_it] = make_recordings(robot, [effect], **command)
        [without] = make_recordings(robot, [], **command)
        column = robot.joint_names.index(joint)
        assert np.abs(with_it.position - without.position)[:, column].max() > 5e-4


@pytest.mark.parametrize(
    ("effect", "advice"),
    [
        (HiddenEffect("coulomb_friction", "wrist", {"torque": 1.0}), "no joint 'wrist', only"),
        (HiddenEffect("magic", "elbow", {"torque": 1.0}), "known are coulomb_friction"),
        (HiddenEffect("viscous_friction", "elbow", {"torque": 1.0}), "has the parameters damping; came torque"),
    ],
)
def test_what_cannot_be_hidden_is_refused(effect, advice):
    with pytest.raises(ValueError, match=advice):
        machine_with(two_link_arm(), [effect])
