from dataclasses import replace

import numpy as np
import pytest
from effects.arm import JOINTS, address, arm, record
from effects.slider import MASS, STEP, push, speed
from scipy.signal import lsim

from torchrl_athletic.effects import ActuationDelay, ActuationLag, project_recording
from torchrl_athletic.effects.timing import low_pass

TIME = STEP * np.arange(800)
FORCE = 4.0 * np.sin(2 * np.pi * 3.0 * TIME) * (TIME > 0.1)
STEP_AT = 100
STEP_FORCE = np.where(np.arange(800) < STEP_AT, 0.0, 3.0)


@pytest.mark.parametrize("steps", [1, 7, 60])
def test_a_delay_of_whole_steps_shifts_the_motion(steps):
    (now,) = push(FORCE)
    (late,) = push(FORCE, (ActuationDelay(), [steps * STEP]))
    np.testing.assert_allclose(late[steps:], now[:-steps], atol=1e-12)
    assert not late[:STEP_AT].any()


def test_a_delay_within_a_step_divides_the_force_between_two():
    (position,) = push(STEP_FORCE, (ActuationDelay(), [0.3 * STEP]))
    acceleration = np.diff(speed(position), prepend=[0.0, 0.0]) / STEP
    np.testing.assert_allclose(acceleration[STEP_AT - 1 : STEP_AT + 2], np.array([0, 0.7, 1]) * 3.0 / MASS, atol=1e-6)


def test_a_servo_gets_its_target_late():
    target = np.where(TIME < 0.1, 0.0, 0.05)
    (now,) = push(target, servo=(80.0, 5.0))
    (late,) = push(target, (ActuationDelay(), [0.025]), servo=(80.0, 5.0))
    np.testing.assert_allclose(late[25:], now[:-25], atol=1e-9)
    assert now[-1] > 0.02


@pytest.mark.parametrize("time_constant", [0.004, 0.05])
def test_a_lagged_step_of_force_gains_speed_as_the_closed_form_says(time_constant):
    (position,) = push(STEP_FORCE, (ActuationLag(), [time_constant]))
    t = STEP * (np.arange(1, 800) - STEP_AT + 1)  # at the end of each step
    impulse = 3.0 * (t - time_constant * (1 - np.exp(-t / time_constant)))
    np.testing.assert_allclose(speed(position), np.where(t > 0, impulse, 0.0) / MASS, atol=1e-9)


def test_a_lag_in_a_servo_acts_on_the_torque_and_not_on_the_target():
    target = np.where(TIME < 0.1, 0.0, 0.05)
    kp, kd, lag = 80.0, 5.0, 0.02
    (position,) = push(target, (ActuationLag(), [lag]), servo=(kp, kd))
    system = (  # position, speed, torque
        [[0, 1, 0], [0, 0, 1 / MASS], [-kp / lag, -kd / lag, -1 / lag]],
        [[0], [0], [kp / lag]],
        [[1, 0, 0]],
        [[0]],
    )
    exact = lsim(system, np.append(target, target[-1]), np.append(TIME, TIME[-1] + STEP), interp=False)[1]
    np.testing.assert_allclose(position, exact[1:], atol=0.02 * 0.05)


@pytest.mark.parametrize("time_constant", [0.0005, 0.005, 0.08])
def test_the_low_pass_is_the_exact_mean_response_to_held_values(time_constant):
    step, fine = 0.002, 200
    u = np.random.default_rng(0).normal(size=(40, 1))
    held = np.append(np.repeat(u[:, 0], fine), u[-1])
    time = step / fine * np.arange(len(held))
    system = ([-1 / time_constant], [1 / time_constant], [1.0], [0.0])
    exact = lsim(system, held, time, X0=[u[0, 0]], interp=False)[1]
    mean = [np.trapezoid(exact[k * fine : (k + 1) * fine + 1], dx=1 / fine) for k in range(40)]
    np.testing.assert_allclose(low_pass(u, time_constant, step)[:, 0], mean, atol=2e-4)


def test_the_low_pass_keeps_constants_and_tends_to_nothing_for_a_fast_loop():
    u = np.random.default_rng(1).normal(size=(50, 2))
    np.testing.assert_allclose(low_pass(np.full((20, 1), 0.7), 0.03, 0.002), 0.7)
    np.testing.assert_array_equal(low_pass(u, 0.0, 0.002), u)
    np.testing.assert_allclose(low_pass(u, 2e-6, 0.002), u, atol=5e-3)


@pytest.mark.parametrize(("effect", "name"), [(ActuationDelay(), "delay"), (ActuationLag(), "time_constant")])
def test_the_grid_lies_within_the_bounds_and_holds_the_sampling_period(effect, name):
    s = project_recording(record(seconds=2.0), arm(), np.zeros(2))
    times = [point[name] for point in effect.grid(s, 0)]
    (parameter,) = effect.parameters(arm(), address(), 0)
    assert times == sorted(set(times))
    assert all(parameter.lower < t < parameter.upper for t in times)
    assert any(t == pytest.approx(1 / 250.0) for t in times)


@pytest.mark.parametrize(("effect", "name"), [(ActuationDelay(), "delay"), (ActuationLag(), "time_constant")])
def test_a_slow_log_is_asked_for_half_a_sample_to_three(effect, name):
    """A drive that answers half a sample late is the commonest of all: no other entry of the grid is near at 30 Hz."""
    s = project_recording(record(seconds=2.0), arm(), np.zeros(2))
    slow = replace(s, recording=replace(s.recording, time=s.recording.time * 250.0 / 30.0))
    times = np.array([point[name] for point in effect.grid(slow, 0)])
    for samples in (0.5, 1.0, 1.5, 2.0, 3.0):
        assert np.abs(times - samples / 30.0).min() < 1e-9


@pytest.mark.parametrize("effect", [ActuationDelay(), ActuationLag()])
@pytest.mark.parametrize("joint", [0, 1], ids=JOINTS)
def test_a_time_is_no_coefficient_and_touches_one_joint(effect, joint):
    s = project_recording(record(seconds=3.0), arm(), np.zeros(2))
    (parameter,) = effect.parameters(arm(), address(), joint)
    fingerprint = effect.fingerprint(s, joint, {parameter.name: 0.02})
    assert fingerprint.columns.shape == (len(s.time), 2, 0)
    assert fingerprint.constant[:, joint].any()
    assert not fingerprint.constant[:, 1 - joint].any()
    nothing = effect.fingerprint(s, joint, {parameter.name: 0.0})
    np.testing.assert_allclose(nothing.constant, 0, atol=1e-12)


def test_a_short_delay_is_the_commands_slope_back_in_time():
    s = project_recording(record(seconds=3.0), arm(), np.zeros(2), kernel=0.04)
    slope = np.gradient(s.command[:, 1], s.time)
    late = ActuationDelay().fingerprint(s, 1, {"delay": 0.001}).constant[:, 1]
    np.testing.assert_allclose(late[1:-1], -0.001 * slope[1:-1], atol=0.03 * np.abs(late).max())
