"""Conservation laws and closed forms that hold whatever the integrator."""

from dataclasses import replace

import numpy as np
import pytest

from torchrl_athletic.recordings.demo import (
    HiddenEffect,
    Link,
    excitation_for,
    machine_with,
    pendulum,
    simulate,
    slider,
    two_link_arm,
)
from torchrl_athletic.recordings.demo.robot import GRAVITY


def ideal(robot, **changes):
    """Without friction and springs, unless asked for."""
    return replace(robot, links=tuple(replace(a, **{"damping": 0.0, "stiffness": 0.0, **changes}) for a in robot.links))


def free(machine, start, seconds, rate=1000.0):
    """Let go at ``start``."""
    time = np.arange(int(seconds * rate) + 1) / rate
    return time, *simulate(machine, time, np.zeros((len(time), len(start))), start=np.asarray(start))


def energy(robot, q, v):
    """Energy of an arm, from the Cartesian motion of its centres of mass [J]."""
    angle, rate = np.cumsum(q, axis=1), np.cumsum(v, axis=1)
    total, joint = 0.0, np.zeros((len(q), 4))  # x, z, their rates
    for j, link in enumerate(robot.links):
        arm = np.stack([np.sin(angle[:, j]), -np.cos(angle[:, j])], -1)
        turn = np.stack([np.cos(angle[:, j]), np.sin(angle[:, j])], -1) * rate[:, j : j + 1]
        com = joint + link.com * np.hstack([arm, turn])
        total = total + link.mass * (0.5 * (com[:, 2:] ** 2).sum(1) + GRAVITY * com[:, 1])
        total = total + 0.5 * link.inertia * rate[:, j] ** 2 + 0.5 * link.armature * v[:, j] ** 2
        joint = joint + link.length * np.hstack([arm, turn])
    return total


@pytest.mark.parametrize(("robot", "start"), [(pendulum(), [2.0]), (two_link_arm(), [1.2, -0.7])], ids=["one", "two"])
def test_energy_is_conserved_without_friction(robot, start):
    robot = ideal(robot)
    _, q, v = free(machine_with(robot), start, 4.0)
    assert np.ptp(q, axis=0).min() > 0.5
    np.testing.assert_allclose(energy(robot, q, v), energy(robot, q, v)[0], atol=1e-9)


def test_dry_friction_takes_its_torque_times_the_path():
    robot, dry = ideal(two_link_arm()), (0.5, 0.25)
    effects = [HiddenEffect("coulomb_friction", n, {"torque": f}) for n, f in zip(robot.joint_names, dry, strict=True)]
    _, q, v = free(machine_with(robot, effects), [1.3, -0.9], 4.0)
    path = np.vstack([[0.0, 0.0], np.cumsum(np.abs(np.diff(q, axis=0)), axis=0)])
    np.testing.assert_allclose(energy(robot, q, v) - energy(robot, q, v)[0], -path @ dry, atol=2e-5)
    assert (v == 0).all(axis=1).any()  # and at last everything sticks
    assert (v[:, 1] == 0).sum() > (v == 0).all(axis=1).sum()  # the elbow stuck while the shoulder moved, too


def test_a_mass_under_less_than_its_friction_does_not_move_at_all():
    machine = machine_with(ideal(slider()), [HiddenEffect("coulomb_friction", "carriage", {"torque": 5.0})])
    time = np.arange(1001) / 1000
    position, velocity = simulate(machine, time, np.full((1001, 1), 4.999))
    assert (position == 0).all()
    assert (velocity == 0).all()
    position, _ = simulate(machine, time, np.full((1001, 1), -5.001))
    np.testing.assert_allclose(position[:, 0], -0.5 * (0.001 / 4.0) * time**2, atol=1e-12)


def test_a_push_carries_a_mass_as_far_as_friction_lets_it_and_there_it_stays():
    push, dry, mass, seconds = 20.0, 5.0, 4.0, 0.3
    machine = machine_with(ideal(slider()), [HiddenEffect("coulomb_friction", "carriage", {"torque": dry})])
    time = np.arange(2001) / 1000
    position, velocity = simulate(machine, time, np.where(time < seconds - 1e-9, push, 0.0)[:, None])
    speed = (push - dry) / mass * seconds
    stop = seconds + speed * mass / dry
    distance = 0.5 * speed * seconds + 0.5 * speed**2 * mass / dry
    np.testing.assert_allclose(position[time > stop, 0], distance, atol=1e-9)
    assert (velocity[time > stop] == 0).all()
    assert (velocity[(time > 0) & (time < stop - 1e-6)] > 0).all()


def test_a_spring_against_dry_friction_loses_four_dead_zones_a_cycle():
    stiffness, dry, start = 100.0, 2.0, 0.31
    robot = ideal(slider(), stiffness=stiffness)
    machine = machine_with(robot, [HiddenEffect("coulomb_friction", "carriage", {"torque": dry})])
    half = np.pi * np.sqrt(robot.links[0].mass / stiffness)
    turns = half * np.arange(12)
    position, _ = simulate(machine, turns, np.zeros((12, 1)), start=np.array([start]))
    expected = [start]
    while abs(expected[-1]) > dry / stiffness:  # sticks inside its dead zone
        expected.append(-np.sign(expected[-1]) * (abs(expected[-1]) - 2 * dry / stiffness))
    expected += [expected[-1]] * (12 - len(expected))
    np.testing.assert_allclose(position[:, 0], expected, atol=1e-10)


def test_a_damped_spring_follows_its_closed_form():
    stiffness, damping, mass, start = 150.0, 12.0, 4.0, 0.2
    time, position, velocity = free(machine_with(slider()), [start], 2.0)
    decay = damping / (2 * mass)
    frequency = np.sqrt(stiffness / mass - decay**2)
    wave = np.cos(frequency * time) + decay / frequency * np.sin(frequency * time)
    np.testing.assert_allclose(position[:, 0], start * np.exp(-decay * time) * wave, atol=1e-10)
    slope = -start * stiffness / mass / frequency * np.exp(-decay * time) * np.sin(frequency * time)
    np.testing.assert_allclose(velocity[:, 0], slope, atol=1e-9)


def test_an_arm_with_a_seized_elbow_is_a_pendulum():
    upper, lower = two_link_arm().links
    seized = HiddenEffect("coulomb_friction", "elbow", {"torque": 1e3})
    _, q, v = free(machine_with(two_link_arm(), [seized]), [1.0, 0.0], 3.0)
    mass = upper.mass + lower.mass
    com = (upper.mass * upper.com + lower.mass * (upper.length + lower.com)) / mass
    inertia = upper.inertia + lower.inertia + upper.mass * (upper.com - com) ** 2
    inertia += lower.mass * (upper.length + lower.com - com) ** 2
    one = replace(pendulum(), links=(Link(mass, com, inertia, 0.5, armature=upper.armature, damping=upper.damping),))
    _, q_one, _ = free(machine_with(one), [1.0], 3.0)
    np.testing.assert_allclose(q[:, 0], q_one[:, 0], atol=1e-10)
    assert (v[:, 1] == 0).all()
    assert (q[:, 1] == 0).all()


def test_a_stuck_elbow_bears_no_more_than_its_friction():
    robot, dry = two_link_arm(), 0.25
    machine = machine_with(robot, [HiddenEffect("coulomb_friction", "elbow", {"torque": dry})])
    command, _ = excitation_for(robot, "gaussian", seed=0, duration=4.0)
    command[:, 1] = 0.0
    q, v = simulate(machine, np.arange(len(command)) / 200, command)
    stuck = (v[:, 1] == 0) & (v[:, 0] != 0)
    assert stuck.sum() > 20
    for row in np.flatnonzero(stuck[:-1] & stuck[1:]):  # in the middle of sticking
        m11, m12, _, b1, b2 = robot.dynamics(*q[row], *v[row])
        acceleration = (command[row, 0] - b1 - robot.links[0].damping * v[row, 0]) / m11
        assert abs(m12 * acceleration + b2) <= dry + 1e-9


def test_a_shorter_step_changes_nothing():
    robot = two_link_arm()
    effect = HiddenEffect("asymmetric_friction", "elbow", dict(zip(
        ("coulomb_positive", "coulomb_negative", "viscous_positive", "viscous_negative"), (0.1, 0.05, 0.2, 0.1),
        strict=True,
    )))  # fmt: skip
    command, _ = excitation_for(robot, "square", seed=2, duration=4.0)
    time = np.arange(len(command)) / 200
    coarse, _ = simulate(machine_with(robot, [effect]), time, command)
    fine, _ = simulate(machine_with(robot, [effect]), time, command, step=0.0001)
    np.testing.assert_allclose(coarse, fine, atol=2e-6)
