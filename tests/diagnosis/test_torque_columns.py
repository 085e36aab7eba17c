"""Torques that were mixed up before they came here: their sign, their joint, their meaning."""

from dataclasses import replace

import mujoco
import numpy as np
import pytest
from diagnosis.plants import double_pendulum, pendulum, record, slider, smooth_torque

from torchrl_athletic.diagnosis.prepare import prepare
from torchrl_athletic.diagnosis.torque_columns import column_doubts, explained, torque_doubts


def two_torques(seconds: float = 8.0) -> np.ndarray:
    return np.hstack([smooth_torque(seconds, 1.5, seed=1), smooth_torque(seconds, 0.8, seed=5)])


def doubts(recording, xml, held=None, **flags):
    model = mujoco.MjModel.from_xml_string(xml)
    train = prepare([recording], model, xml=xml, **flags)
    return torque_doubts(train, None if held is None else prepare([held], model, xml=xml, **flags))


def turned(recording, joint=0):
    command = recording.torque_command.copy()
    command[:, joint] *= -1
    return replace(recording, torque_command=command)


@pytest.mark.parametrize("seed", range(3))
@pytest.mark.parametrize("xml", [pendulum(), slider(joint='damping="3"'), slider(joint='frictionloss="0.3"')])
def test_says_nothing_of_torques_in_order_and_finds_the_sign_turned(xml, seed):
    take = record(xml, smooth_torque(8, seed=seed), seed=seed)
    assert not doubts(take, xml)
    (text,) = doubts(turned(take), xml)
    assert "the other sign than its motion" in text


@pytest.mark.parametrize("mass", [0.5, 2.0])
@pytest.mark.parametrize("joint", ['damping="0.3"', 'frictionloss="0.2"', 'armature="0.2"', 'stiffness="4"'])
def test_a_model_that_lacks_physics_is_no_mistake_of_the_log(joint, mass):
    robot = pendulum(joint=joint).replace('mass="0.5"', f'mass="{0.5 * mass}"')
    take = record(robot, smooth_torque(8))
    assert not doubts(take, pendulum(joint=""))


def test_finds_an_exchange_of_two_columns_and_says_nothing_else_of_them():
    take = record(double_pendulum(), two_torques())
    assert not doubts(take, double_pendulum())
    (text,) = doubts(replace(take, torque_command=take.torque_command[:, ::-1].copy()), double_pendulum())
    assert "lower's follows the motion of upper, upper's follows the motion of lower" in text


def test_finds_the_joint_of_two_whose_sign_is_turned():
    take = record(double_pendulum(), two_torques())
    (text,) = doubts(turned(take, 1), double_pendulum())
    assert text.startswith("the torque of lower has the other sign")


def test_a_column_that_is_no_torque_has_little_to_do_with_the_motion():
    take = record(pendulum(), smooth_torque(8))
    other = np.repeat(np.random.default_rng(7).normal(size=(80, 1)), 10, axis=0)
    (text,) = doubts(replace(take, torque_command=other), pendulum())
    assert "little to do with its motion" in text


def test_asks_of_the_torque_that_drives():
    take = record(pendulum(), smooth_torque(8))
    take = replace(take, torque_measured=-take.torque_command, torque_semantics="link_side")
    assert not doubts(take, pendulum())
    (text,) = doubts(take, pendulum(), drive="measured")
    assert text.startswith("the torque of pendulum")


def test_what_is_wrong_of_both_sets_is_said_once_and_of_one_with_its_name():
    take, other = (record(pendulum(), smooth_torque(8, seed=k)) for k in range(2))
    assert len(doubts(turned(take), pendulum(), turned(other))) == 1
    (text,) = doubts(take, pendulum(), turned(other))
    assert text.startswith("Kept aside, the torque of pendulum has the other sign")


def test_says_nothing_without_torques():
    """A motor that is off, and a joint that follows targets."""
    off = record(pendulum(), np.zeros((800, 1)), start=1.0)
    assert not doubts(off, pendulum())
    assert np.isnan(explained(prepare([off], mujoco.MjModel.from_xml_string(pendulum())).signals)[0]).all()
    held = record(pendulum(), -smooth_torque(8), kp=np.array([20.0]), kd=np.array([1.0]))
    assert not doubts(held, pendulum())


def test_shares_are_those_of_a_least_squares_fit():
    take = record(pendulum(), smooth_torque(8))
    prepared = prepare([take], mujoco.MjModel.from_xml_string(pendulum()))
    (s,) = prepared.signals
    ok = s.valid[:, 0]
    speed = s.velocity[ok, 0]
    parts = np.stack([s.required[ok, 0], s.acceleration[ok, 0], np.sign(speed), speed, np.ones(ok.sum())], 1)
    error = s.command[ok, 0] - parts @ np.linalg.lstsq(parts, s.command[ok, 0], rcond=None)[0]
    plain = 1 - error.var() / s.command[ok, 0].var()
    share = explained([s])[0][0, 0]
    assert share <= plain + 1e-9
    assert share == pytest.approx(plain, abs=0.01)


@pytest.mark.parametrize("late", [2, 5, 8])
@pytest.mark.parametrize("robot", [pendulum(), slider(), slider(joint='damping="3"')])
def test_a_drive_that_answers_late_is_no_mistake_of_the_log(robot, late):
    """Its command came so many samples of 10 ms before."""
    waves = np.sum([np.sin(2 * np.pi * f * np.arange(800) / 100) for f in (3.0, 4.0, 5.0)], axis=0)[:, None]
    take = record(robot, waves)
    assert not doubts(replace(take, torque_command=np.vstack([waves[late:], np.zeros((late, 1))])), robot)


def test_a_torque_sensor_may_have_another_zero_in_each_recording():
    takes = [record(pendulum(), smooth_torque(8, seed=k), seed=k) for k in range(4)]
    zeros = [replace(t, torque_command=t.torque_command + z) for t, z in zip(takes, (0.0, 3.0, -2.0, 5.0), strict=True)]
    assert not torque_doubts(prepare(zeros, mujoco.MjModel.from_xml_string(pendulum())))


def test_of_the_sets_each_mistake_is_said_by_itself():
    """Noise to fit, and a turned torque kept aside, of one joint."""
    take, other = (record(pendulum(), smooth_torque(8, seed=k)) for k in range(2))
    noise = replace(take, torque_command=np.repeat(np.random.default_rng(7).normal(size=(80, 1)), 10, axis=0))
    first, second = doubts(noise, pendulum(), turned(other))
    assert "little to do" in first
    assert "Kept aside" in second


def test_targets_that_are_turned_round_are_said_beside_torques():
    gains = {"kp": np.array([80.0]), "kd": np.array([2.0])}
    take = record(pendulum(), smooth_torque(8), **gains)
    wrong = replace(take, position_target=-take.position_target)
    prepared = prepare([wrong, wrong], mujoco.MjModel.from_xml_string(pendulum()))
    (text,) = column_doubts(prepared)
    assert "follows its position_target with the other sign" in text
    assert not column_doubts(prepare([take], mujoco.MjModel.from_xml_string(pendulum())))
