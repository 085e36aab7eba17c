import numpy as np
import pytest
from effects.arm import address, arm, record
from effects.slider import MASS, STEP, push, speed

from torchrl_athletic.effects import TorqueOffset, TorqueScale, project_recording

FORCE = 3.0 * np.sin(np.arange(500) * 0.02)


@pytest.mark.parametrize("scale", [0.5, 1.0, 1.7])
def test_the_acceleration_is_that_of_the_scaled_torque(scale):
    (position,) = push(FORCE, (TorqueScale(), [scale]))
    np.testing.assert_allclose(np.diff(speed(position)) / STEP, scale * FORCE[2:] / MASS, atol=1e-6)


@pytest.mark.parametrize("offset", [-1.2, 0.4])
def test_the_acceleration_is_that_of_the_torque_and_the_offset(offset):
    (position,) = push(FORCE, (TorqueOffset(), [offset]))
    np.testing.assert_allclose(np.diff(speed(position)) / STEP, (FORCE[2:] + offset) / MASS, atol=1e-6)


def test_the_offset_is_not_scaled():
    (position,) = push(FORCE, (TorqueOffset(), [0.4]), (TorqueScale(), [1.5]))
    np.testing.assert_allclose(np.diff(speed(position)) / STEP, (1.5 * FORCE[2:] + 0.4) / MASS, atol=1e-6)


def test_a_scaled_torque_stays_within_the_motors_range():
    (position,) = push(FORCE, (TorqueScale(), [2.0]), limit=2.5)
    np.testing.assert_allclose(np.diff(speed(position)) / STEP, np.clip(2 * FORCE[2:], -2.5, 2.5) / MASS, atol=1e-6)


def test_each_row_gets_its_own_torque():
    positions = push(FORCE, (TorqueScale(), [[1.0], [2.0], [0.5]]))
    np.testing.assert_allclose(positions[1], 2 * positions[0], atol=1e-12)
    np.testing.assert_allclose(positions[2], positions[0] / 2, atol=1e-12)


def test_an_offset_is_a_constant_and_a_scale_is_what_the_motion_asks_for():
    s = project_recording(record(seconds=3.0), arm(), np.zeros(2))
    offset, scale = (effect.fingerprint(s, 1, {}).columns for effect in (TorqueOffset(), TorqueScale()))
    np.testing.assert_array_equal(offset[:, 1, 0], 1.0)
    np.testing.assert_allclose(scale[:, 1, 0], s.missing[:, 1] + s.command[:, 1], atol=1e-12)
    assert not offset[:, 0].any()
    assert not scale[:, 0].any()


@pytest.mark.parametrize(("scale", "words"), [(1.1, "10 % more"), (0.75, "25 % less")])
def test_a_scale_is_told_as_more_or_less(scale, words):
    text = TorqueScale().sentence("elbow", {"scale": scale}, TorqueScale().parameters(arm(), address(), 1))
    assert f"elbow receives {words} torque than commanded" in text


def test_the_bounds_of_an_offset_are_the_motors():
    (offset,) = TorqueOffset().parameters(arm(), address(), 1)
    assert (offset.lower, offset.upper) == (-15.0, 15.0)
