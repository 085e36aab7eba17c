from dataclasses import replace

import mujoco
import numpy as np
import pytest
from effects.arm import address, arm, record
from effects.explained import explained, projected
from effects.slider import MASS, STEP, push, slider, speed

from torchrl_athletic.effects import CoulombFriction, JointAddress, TorqueOffset, TorqueScale, project_recording
from torchrl_athletic.effects.torque import SpeedTorqueLimit, TorqueRipple, TorqueSaturation, fine_torque, leftover

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


# --- limits ---


def test_a_saturated_motor_gives_its_limit_either_way():
    (position,) = push(FORCE, (TorqueSaturation(), [1.8]))
    np.testing.assert_allclose(np.diff(speed(position)) / STEP, np.clip(FORCE[2:], -1.8, 1.8) / MASS, atol=1e-6)


@pytest.mark.parametrize("limits", [(1.8, 1.2), (1.2, 1.8)])
def test_of_two_limits_the_smaller_one_holds(limits):
    expected = np.clip(FORCE[2:], -1.2, 1.2) / MASS
    (twice,) = push(FORCE, *((TorqueSaturation(), [limit]) for limit in limits))
    (known,) = push(FORCE, (TorqueSaturation(), [limits[0]]), limit=limits[1])
    for position in (twice, known):
        np.testing.assert_allclose(np.diff(speed(position)) / STEP, expected, atol=1e-6)


@pytest.mark.parametrize("sign", [1, -1])
def test_a_motor_runs_up_to_its_no_load_speed(sign):
    stall, no_load = 4.0, 0.5
    (position,) = push(np.full(2000, sign * 100.0), (SpeedTorqueLimit(), [stall, no_load]))
    time = STEP * (np.arange(len(position) - 1) + 1.5)
    expected = no_load * (1 - np.exp(-stall / no_load / MASS * time))
    np.testing.assert_allclose(sign * speed(position), expected, atol=0.01 * no_load)


def test_a_motor_that_brakes_keeps_the_limit_of_standstill():
    force = np.where(np.arange(600) < 200, 100.0, -100.0)
    (position,) = push(force, (SpeedTorqueLimit(), [4.0, 0.5]))
    braking = np.diff(speed(position))[205:210] / STEP  # still forwards
    assert speed(position)[210] > 0.05
    np.testing.assert_allclose(braking, -4.0 / MASS, rtol=1e-6)


@pytest.mark.parametrize(
    ("effect", "joint", "values"),
    [
        (TorqueSaturation(), 0, (1.5,)),
        (TorqueSaturation(), 1, (0.5,)),
        (SpeedTorqueLimit(), 0, (2.0, 3.0)),
        (SpeedTorqueLimit(), 1, (0.7, 4.0)),
        (TorqueRipple(), 0, (0.2, 0.1, 7.0)),
        (TorqueRipple(), 1, (0.1, -0.05, 9.0)),
    ],
)
def test_their_fingerprints_are_what_the_simulation_misses(effect, joint, values):
    share, factor = explained(effect, joint, values, projected(effect, joint, values))
    assert share > 0.98
    assert factor == pytest.approx(1, abs=0.04)


@pytest.mark.parametrize("effect", [TorqueSaturation(), SpeedTorqueLimit(), TorqueRipple()])
def test_many_points_of_a_grid_are_what_each_is_alone(effect):
    s = project_recording(record(seconds=3.0), arm(), np.zeros(2))
    grid = effect.grid(s, 1)
    together = effect.fingerprints(s, 1, grid)
    for k in (0, len(grid) // 2, len(grid) - 1):
        alone = effect.fingerprint(s, 1, grid[k])
        assert together[k].fixed == grid[k]
        np.testing.assert_allclose(together[k].columns, alone.columns, atol=1e-12)
        if alone.constant is not None:
            np.testing.assert_allclose(together[k].constant, alone.constant, atol=1e-12)


def test_a_limit_met_in_one_second_of_thirty_shows_in_that_second_alone():
    recording = record(seconds=30.0)
    command = recording.command.copy()
    rare = (recording.time >= 20) & (recording.time < 21)
    command[rare, 1] *= 5
    s = project_recording(replace(recording, torque_command=command), arm(), np.zeros(2))
    limit = 0.9 * np.abs(command[rare, 1]).max()
    shown = TorqueSaturation().fingerprint(s, 1, {"limit": limit}).constant[:, 1]
    near = (s.time > 19.8) & (s.time < 21.2)
    assert np.abs(shown[near]).max() > 0.05 * limit
    np.testing.assert_allclose(shown[~near], 0, atol=1e-9)
    assert min(point["limit"] for point in TorqueSaturation().grid(s, 1)) < limit


def test_limits_beyond_the_command_say_nothing_and_every_one_that_is_tried_is_met():
    s = project_recording(record(seconds=3.0), arm(), np.zeros(2))
    most = np.abs(fine_torque(s, 0)).max()
    np.testing.assert_array_equal(TorqueSaturation().fingerprint(s, 0, {"limit": 1.01 * most}).constant, 0.0)
    for effect in (TorqueSaturation(), SpeedTorqueLimit()):
        grid = effect.grid(s, 0)
        assert len(grid) > 20
        assert all(f.constant.any() for f in effect.fingerprints(s, 0, grid))


def test_a_limit_beside_the_models_own_counts_from_there():
    recording = record(seconds=3.0)
    loud = replace(recording, torque_command=30 * recording.command)  # beyond the 40 and 15 N·m of the model
    s = project_recording(loud, arm(), np.zeros(2))
    assert np.abs(fine_torque(s, 0)).max() == 40.0
    np.testing.assert_array_equal(TorqueSaturation().fingerprint(s, 0, {"limit": 40.0}).constant, 0.0)


def test_a_model_without_a_limit_is_told_apart_from_one_with_a_high_one():
    rail = JointAddress.of(slider(), ("rail",))
    free, limited = TorqueSaturation().parameters(slider(), rail, 0), TorqueSaturation().parameters(arm(), address(), 0)
    assert "the model has no limit" in TorqueSaturation().sentence("rail", {"limit": 2.0}, free)
    assert "the model allows 40 N·m" in TorqueSaturation().sentence("shoulder", {"limit": 2.0}, limited)


def test_a_limit_that_no_model_states_is_none_for_the_rotor_of_a_bare_horn():
    """Its link asks for micronewtons; motors that one holds in a hand give a newton metre."""
    horn = mujoco.MjModel.from_xml_string("""<mujoco><worldbody><body><joint name="horn" axis="0 0 1"/>
      <inertial pos="0 0 0" mass="0.015" diaginertia="2e-6 2e-6 2e-6"/></body></worldbody>
      <actuator><motor joint="horn"/></actuator></mujoco>""")
    (limit,) = TorqueSaturation().parameters(horn, JointAddress.of(horn, ("horn",)), 0)
    assert limit.nominal > 100.0
    assert limit.lower < 0.01
    assert limit.upper > limit.nominal


# --- ripple ---


def test_ripple_gives_and_takes_the_energy_of_its_potential():
    """Over a whole number of its periods it does no work."""
    sine, cosine, per_metre = 1.0, 0.5, 40.0
    (position,) = push(np.full(800, 4.0), (TorqueRipple(), [sine, cosine, per_metre]))
    k = 2 * np.pi * per_metre
    work = 4.0 * position + (sine * (1 - np.cos(k * position)) + cosine * np.sin(k * position)) / k
    middle = (position[1:-1], speed(position)[1:] / 2 + speed(position)[:-1] / 2)
    np.testing.assert_allclose(MASS * middle[1] ** 2 / 2, work[1:-1], atol=0.01 * work.max())


def test_teeth_finer_than_any_fixed_grid_are_proposed_from_the_missing_torque():
    values = (0.05, 0.08, 143.0)
    s = projected(TorqueRipple(), 0, values)
    found = np.array([point["periods"] for point in TorqueRipple().grid(s, 0)])
    assert np.abs(found - 143.0).min() < 0.5 * 2 * np.pi / np.ptp(s.position[:, 0])


def test_periods_are_a_revolution_or_a_metre():
    hinge = TorqueRipple().parameters(arm(), address(), 0)[2]
    rail = TorqueRipple().parameters(slider(), JointAddress.of(slider(), ("rail",)), 0)[2]
    assert (hinge.unit, rail.unit) == ("1/rev", "1/m")


def test_what_friction_and_inertia_explain_is_not_left_over():
    s = projected(CoulombFriction(), 0, (0.3, 0.0))
    moving = np.abs(s.velocity[:, 0]) > 0.5
    assert np.std(leftover([s], 0)[moving]) < 0.1 * np.std(s.missing[moving, 0])
