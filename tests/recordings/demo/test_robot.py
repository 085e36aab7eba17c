"""The closed forms and the MJCF describe the same robot."""

from dataclasses import replace

import mujoco
import numpy as np
import pytest

from torchrl_athletic.recordings.demo import excitation_for, machine_with, pendulum, simulate, slider, two_link_arm

ROBOTS = {robot.name: robot for robot in (slider(), pendulum(), two_link_arm())}


def in_mujoco(robot, command, rate=200.0):
    """Fourth order, ten steps a sample."""
    model = mujoco.MjModel.from_xml_string(robot.model_xml)
    model.opt.timestep, model.opt.integrator = 0.1 / rate, mujoco.mjtIntegrator.mjINT_RK4
    data, position = mujoco.MjData(model), []
    for u in command:
        position.append(data.qpos.copy())
        data.ctrl[:] = u
        mujoco.mj_step(model, data, 10)
    return np.array(position)


@pytest.mark.parametrize("robot", ROBOTS.values(), ids=ROBOTS)
def test_without_a_secret_the_machine_moves_as_in_mujoco(robot):
    command, _ = excitation_for(robot, "gaussian", seed=3, duration=4.0)
    position, _ = simulate(machine_with(robot), np.arange(len(command)) / 200, command)
    assert np.abs(position).max() > 0.1
    np.testing.assert_allclose(position, in_mujoco(robot, command), atol=1e-10)


@pytest.mark.parametrize("robot", ROBOTS.values(), ids=ROBOTS)
def test_springs_rotors_and_motor_limits_are_mujocos_too(robot):
    stiffer = tuple(replace(link, stiffness=3.0 + link.stiffness, armature=0.03, damping=0.2) for link in robot.links)
    robot = replace(robot, links=stiffer, torque_limit=tuple(0.5 * a for a in robot.torque_amplitude))
    command, _ = excitation_for(robot, "square", seed=1, duration=3.0)
    assert np.abs(command).max() > max(robot.torque_limit)
    position, _ = simulate(machine_with(robot), np.arange(len(command)) / 200, command)
    np.testing.assert_allclose(position, in_mujoco(robot, command), atol=1e-10)


@pytest.mark.parametrize("robot", ROBOTS.values(), ids=ROBOTS)
@pytest.mark.parametrize("kind", ["gaussian", "square", "sine", "chirp", "multisine"])
def test_excitation_keeps_the_robot_away_from_the_top(robot, kind):
    command, _ = excitation_for(robot, kind, seed=1, duration=10.0)
    position, velocity = simulate(machine_with(robot), np.arange(len(command)) / 200, command, step=0.005)
    assert np.abs(position).max() < 1.8
    assert (velocity.std(axis=0) > 0.2).all()


def test_the_step_of_the_model_can_be_chosen():
    assert mujoco.MjModel.from_xml_string(replace(pendulum(), timestep=5e-4).model_xml).opt.timestep == 5e-4
