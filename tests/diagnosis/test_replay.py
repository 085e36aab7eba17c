"""Replay is MuJoCo, step for step: closed forms, plain loops, and every sample exactly once."""

from dataclasses import replace
from types import SimpleNamespace

import mujoco
import numpy as np
import pytest
from diagnosis.plants import RATE, STEP, candidate, double_pendulum, pendulum, record, slider, smooth_torque, take
from hypothesis import given
from hypothesis import strategies as st

from torchrl_athletic.diagnosis import replay
from torchrl_athletic.diagnosis.corrected import Simulation
from torchrl_athletic.diagnosis.fit import Hypothesis
from torchrl_athletic.diagnosis.replay import _stiffness, join, simulate, take_of, window_rmse, windows_of
from torchrl_athletic.effects import Backlash, Compliance, Hysteresis, LoadDependentFriction, ThermalDrift
from torchrl_athletic.effects.base import BaseMotion
from torchrl_athletic.effects.plant import Law, Plant
from torchrl_athletic.recordings import Recording, sensor_noise
from torchrl_athletic.recordings.recording import BEGAN

NOTHING = np.zeros((1, 0))


def exact(model, data, first) -> np.ndarray:
    """Position to second order: a semi-implicit step moves by the velocity at its end, half a change of it too far."""
    return data.qpos - model.opt.timestep / 2 * (data.qvel - first)


def test_readings_are_exact_to_second_order_in_the_time_step():
    """Under a constant torque a free joint goes v t + a t² / 2, whatever the step."""
    model = mujoco.MjModel.from_xml_string("""
    <mujoco><option timestep="0.01" gravity="0 0 0"/><worldbody><body><joint name="x" type="slide" axis="1 0 0"/>
      <geom size="0.1" mass="2"/></body></worldbody></mujoco>""")
    time = np.arange(0.0, 2.0, 0.01)
    position = 0.3 * time[:, None] + 0.5 * 1.5 * time[:, None] ** 2
    take = take_of(Recording(time, ("x",), position, torque_command=np.full((200, 1), 3.0)), model, np.full(1, 1e-9))
    windows = windows_of(take, 0.5)
    start = (position[windows.start], 0.3 + 1.5 * time[windows.start][:, None])
    found = simulate(windows, lambda plant, values: None, np.zeros((1, 0)), start)[0]
    np.testing.assert_allclose(found, windows.measured, rtol=0, atol=1e-9)


def as_given(plant, values):
    """Build nothing."""


def random_steps(samples: int, joints: int = 1, seed: int = 0) -> np.ndarray:
    return np.random.default_rng(seed).normal(size=(samples, joints))


def plain_loop(model: mujoco.MjModel, q, v, torques: np.ndarray, substeps: int) -> np.ndarray:
    """Positions after every sample. Torques (steps, J)."""
    data = mujoco.MjData(model)
    data.qpos[:], data.qvel[:] = q, v
    out = []
    for i, torque in enumerate(torques):
        data.qfrc_applied[:] = torque
        mujoco.mj_step(model, data)
        if (i + 1) % substeps == 0:
            out.append(exact(model, data, v))
    return np.array(out)


@pytest.mark.parametrize("step", [0.01, 0.002])
def test_a_slider_follows_the_closed_form_within_the_integrators_half_step(step):
    force = 5 * random_steps(200)
    time, mass = np.arange(200) / RATE, 2.0
    v = np.concatenate([[0.0], np.cumsum(force[:-1, 0]) / RATE / mass])
    q = np.concatenate([[0.0], np.cumsum(v[:-1] / RATE + force[:-1, 0] / mass / RATE**2 / 2)])
    t = take(slider(step), Recording(time, ("carriage",), q[:, None], torque_command=force))
    w = windows_of(t, 0.5)
    predicted = simulate(w, as_given, NOTHING, start=(q[w.start, None], v[w.start, None]))[0, :, :, 0]
    gained = v[w.index] - v[w.start, None]  # semi-implicit Euler is late by half a step of it, exactly
    assert (np.abs(predicted - q[w.index]) <= step / 2 * np.abs(gained) + 1e-9).all()
    assert np.abs(gained).max() > 0.1


def test_a_pendulum_swings_as_the_damped_oscillator_does():
    step, inertia, damping, weight = 0.0005, 0.09, 0.05, 0.5 * 9.81 * 0.4
    decay, omega = damping / (2 * inertia), np.sqrt(weight / inertia - (damping / (2 * inertia)) ** 2)
    time = np.arange(0, 4, 1 / RATE)
    q = 1e-3 * np.exp(-decay * time) * np.cos(omega * time)
    v = -decay * q - 1e-3 * omega * np.exp(-decay * time) * np.sin(omega * time)
    t = take(pendulum(step), Recording(time, ("pendulum",), q[:, None], torque_command=np.zeros((400, 1))))
    for seconds in (0.5, None):
        w = windows_of(t, seconds)
        predicted = simulate(w, as_given, NOTHING, start=(q[w.start, None], v[w.start, None]))[0, :, :, 0]
        assert np.abs(predicted - q[w.index]).max() < 1e-3 * omega * step
    assert np.abs(t.velocity[5:-5, 0] - v[5:-5]).max() < 0.01 * np.abs(v).max()  # where windows start by themselves


def five_parameters(plant, values):
    damping, delay, lag, scale, offset = values.T
    plant.of("dof_damping")[:, 0] = damping
    plant.delay[:, 0], plant.lag[:, 0], plant.torque_scale[:, 0], plant.torque_offset[:, 0] = delay, lag, scale, offset


SETS = np.array([[0.1, 0.0, 0.0, 1.0, 0.0], [0.05, 0.013, 0.0, 1.2, 0.1], [0.0, 0.02, 0.03, 0.7, -0.2]])


@pytest.mark.parametrize("laws", [False, True])
def test_many_sets_at_once_give_what_each_gives_alone_bit_for_bit(monkeypatch, laws):
    t = take(pendulum(), record(pendulum(), smooth_torque(3.0)))
    w = windows_of(t, 0.5)

    def build(plant, values):
        five_parameters(plant, values)
        if laws:
            plant.laws.append(lambda now: -0.02 * now.velocity * np.abs(now.velocity))

    together = simulate(w, build, SETS)
    for k in range(len(SETS)):
        np.testing.assert_array_equal(together[k], simulate(w, build, SETS[k : k + 1])[0])
    monkeypatch.setattr(replay, "CHUNK", 1)
    np.testing.assert_array_equal(together, simulate(w, build, SETS))
    assert not np.array_equal(together[0], together[1])


def test_the_native_rollout_and_the_stepwise_one_agree():
    w = windows_of(take(pendulum(), record(pendulum(), smooth_torque(3.0))), 0.5)

    def stepwise(plant, values):
        five_parameters(plant, values)
        plant.laws.append(lambda now: np.zeros_like(now.velocity))

    np.testing.assert_allclose(simulate(w, stepwise, SETS), simulate(w, five_parameters, SETS), rtol=0, atol=1e-12)


def test_what_a_motor_can_is_the_same_step_by_step_as_in_one_go():
    """Its limit, and the model's range of what scale and offset make of it, either way."""
    motor = '<motor joint="carriage" forcerange="-0.3 0.35"/>'
    xml = slider().replace('<motor joint="carriage"/>', motor)
    w = windows_of(take(xml, record(slider(), 3 * smooth_torque(2.0))), 0.5)

    def build(plant, values, stepwise=False):
        plant.torque_limit[:, 0], plant.torque_scale[:, 0], plant.torque_offset[:, 0] = values.T
        if stepwise:
            plant.laws.append(lambda now: np.zeros_like(now.velocity))

    sets = np.array([[0.2, 1.0, 0.0], [np.inf, 1.0, 0.0], [0.25, 2.0, 0.1], [0.25, 2.0, -0.1], [9.0, 9.0, 9.0]])
    found = simulate(w, lambda plant, values: build(plant, values, True), sets)
    np.testing.assert_allclose(found, simulate(w, build, sets), rtol=0, atol=1e-12)
    assert len(np.unique(found[:, 0, -1, 0].round(6))) == len(sets)


def test_readings_lead_by_half_a_step_but_for_an_integrator_of_fourth_order():
    model = mujoco.MjModel.from_xml_string(slider())
    assert replay._lead(model) == STEP / 2
    model.opt.integrator = mujoco.mjtIntegrator.mjINT_RK4
    assert replay._lead(model) == 0.0


def test_a_law_adds_its_torque_at_every_step():
    t = take(slider(), record(slider(), smooth_torque(2.0)))
    w = windows_of(t, 0.5)

    def law(plant, values):
        plant.laws.append(lambda now: -3.0 * now.position - 4.0 * now.velocity)

    for n, (start, found) in enumerate(zip(w.start, simulate(w, law, NOTHING)[0], strict=True)):
        data = mujoco.MjData(t.model)
        data.qpos[:], data.qvel[:] = t.position[start], t.velocity[start]
        for k in range(w.length * t.substeps):
            u = t.recording.torque_command[start + k // t.substeps]
            data.qfrc_applied[:] = u - 3.0 * data.qpos - 4.0 * data.qvel
            mujoco.mj_step(t.model, data)
            if (k + 1) % t.substeps == 0:
                np.testing.assert_allclose(
                    found[k // t.substeps], exact(t.model, data, t.velocity[start]), atol=1e-13, err_msg=f"window {n}"
                )


@pytest.mark.parametrize("delay", [0.0, 2 * STEP, 0.014])
def test_pd_recordings_are_a_plain_loop_of_mj_step(delay):
    gains = {"kp": np.array([8.0]), "kd": np.array([0.3])}
    r = record(pendulum(), smooth_torque(2.0), **gains)
    t = take(pendulum(), r)
    w = windows_of(t, 0.5)

    def build(plant, values):
        plant.delay[:], plant.kp_scale[:], plant.kd_scale[:] = delay, 1.5, 0.5

    late = round(delay / STEP)
    target = np.repeat(r.position_target[:, 0], t.substeps)
    target = np.concatenate([np.full(late, target[0]), target])
    for start, found in zip(w.start, simulate(w, build, NOTHING)[0], strict=True):
        data = mujoco.MjData(t.model)
        data.qpos[:], data.qvel[:] = t.position[start], t.velocity[start]
        for i in range(w.length * t.substeps):
            u = target[start * t.substeps + i]
            data.qfrc_applied[:] = 1.5 * 8.0 * (u - data.qpos) - 0.5 * 0.3 * data.qvel
            mujoco.mj_step(t.model, data)
            if (i + 1) % t.substeps == 0:
                read = exact(t.model, data, t.velocity[start])
                np.testing.assert_allclose(found[i // t.substeps], read, rtol=0, atol=1e-12)


def lagged_by_small_steps(command: np.ndarray, constant: float, step: float, fine: int = 400) -> np.ndarray:
    """Mean of a first-order lag over each step, settled on the first command. Shape (N,)."""
    state, out = command[0], np.empty(len(command))
    for i, u in enumerate(command):
        path = []
        for _ in range(fine):
            half = state + (u - state) * step / fine / 2 / constant
            path.append(half)
            state = state + (u - half) * step / fine / constant
        out[i] = np.mean(path)
    return out


@pytest.mark.parametrize(("delay", "lag"), [(0.0, 0.0), (0.006, 0.0), (0.013, 0.0), (0.0, 0.03), (0.006, 0.008)])
def test_delay_lag_scale_and_offset_are_those_of_a_plain_loop(delay, lag):
    r = record(slider(), 5 * random_steps(150))
    t = take(slider(), r)
    w = windows_of(t, 0.3)

    def build(plant, values):
        plant.delay[:], plant.lag[:], plant.torque_scale[:], plant.torque_offset[:] = delay, lag, 0.8, 0.05

    instants = (np.arange(150 * t.substeps * 10) + 0.5) * STEP / 10 - delay  # ten in each physics step
    held = r.torque_command[np.clip(np.searchsorted(r.time, instants, side="right") - 1, 0, None), 0]
    torque = held.reshape(-1, 10).mean(1)
    if lag:
        torque = lagged_by_small_steps(torque, lag, STEP)
    torque = 0.8 * torque + 0.05
    for start, found in zip(w.start, simulate(w, build, NOTHING)[0], strict=True):
        part = torque[start * t.substeps :][: w.length * t.substeps, None]
        expected = plain_loop(t.model, t.position[start], t.velocity[start], part, t.substeps)
        np.testing.assert_allclose(found, expected, rtol=0, atol=1e-6)
        assert np.ptp(expected) > 1e-3


def test_the_lag_of_a_position_loop_carries_over_into_the_next_window():
    gains = {"kp": np.array([3.0]), "kd": np.array([0.3])}
    xml = pendulum(step=0.0005)
    r = record(xml, 0.5 * np.sign(np.sin(2 * np.pi * np.arange(150) / 27))[:, None], **gains)
    t = take(xml, r)

    def build(plant, values):
        plant.lag[:] = 0.06

    path = np.vstack([t.position[:1], simulate(windows_of(t, None), build, NOTHING)[0, 0]])
    lagged = Recording(r.time, r.joint_names, path, position_target=r.position_target, **gains)  # its own motion
    w = windows_of(take(xml, lagged, noise=1e-9), 0.1)
    assert np.abs(simulate(w, build, NOTHING)[0] - w.measured).max() < 0.01 * np.ptp(path)
    assert np.abs(simulate(w, as_given, NOTHING)[0] - w.measured).max() > 0.1 * np.ptp(path)


def test_the_motor_saturates_where_the_model_says():
    limited = slider().replace('<motor joint="carriage"/>', '<motor joint="carriage" forcerange="-0.5 0.5"/>')
    r = record(slider(), 3 * smooth_torque(2.0))
    t = take(limited, r)
    w = windows_of(t, None)
    torque = np.repeat(np.clip(r.torque_command, -0.5, 0.5), t.substeps, axis=0)[: w.length * t.substeps]
    expected = plain_loop(t.model, t.position[0], t.velocity[0], torque, t.substeps)
    np.testing.assert_allclose(simulate(w, as_given, NOTHING)[0, 0], expected, atol=1e-12)


def test_an_encoder_offset_shifts_the_reading_and_not_the_robot():
    t = take(pendulum(), record(pendulum(), smooth_torque(2.0), start=0.4))
    w = windows_of(t, 0.5)
    start = (t.position[w.start], t.velocity[w.start])

    def offset(plant, values):
        plant.encoder_offset[:] = values

    true = simulate(w, as_given, NOTHING, start=start)[0]
    read = simulate(w, offset, np.array([[0.1]]), start=(start[0] + 0.1, start[1]))[0]
    np.testing.assert_allclose(read, true + 0.1, rtol=0, atol=1e-12)


def test_an_encoder_scale_stretches_the_reading_and_not_the_robot():
    t = take(pendulum(), record(pendulum(), smooth_torque(2.0), start=0.4))
    w = windows_of(t, 0.5)
    true = (t.position[w.start], t.velocity[w.start])

    def stretched(plant, values):
        plant.encoder_scale[:, 0], plant.encoder_offset[:, 0] = values.T

    straight = simulate(w, as_given, NOTHING, start=true)[0]
    read = simulate(w, stretched, np.array([[1.2, 0.1]]), start=(1.2 * true[0] + 0.1, 1.2 * true[1]))[0]
    np.testing.assert_allclose(read, 1.2 * straight + 0.1, rtol=0, atol=1e-12)


@pytest.mark.parametrize("delay", [0.0, 0.006])
@pytest.mark.parametrize("pd", [{}, {"kp": np.array([8.0]), "kd": np.array([0.3])}])
@pytest.mark.parametrize("offset", [0.02, -0.03])
def test_a_clock_that_stamps_positions_late_shows_the_motion_late(offset, pd, delay):
    wave = smooth_torque(3.0)
    r = record(pendulum(), wave, **pd)
    t = take(pendulum(), r)
    sooner = np.interp(r.time + offset, r.time, wave[:, 0])[:, None]  # what acts at the instants that are stamped later
    shifted = take(pendulum(), record(pendulum(), sooner, **pd))
    w = windows_of(t, None)
    w_shifted = type(w)(shifted, np.array([20]), 200)
    w = type(w)(t, w_shifted.start, w_shifted.length)
    start = (np.array([[0.1]]), np.array([[0.2]]))

    def build(plant, values):
        plant.clock_offset[:], plant.delay[:, 0] = values.T

    found = simulate(w_shifted, build, np.array([[offset, delay]]), start=start)[0]
    expected = simulate(w, build, np.array([[0.0, delay]]), start=start)[0]
    np.testing.assert_allclose(found, expected, atol=2e-4)
    assert np.abs(simulate(w_shifted, as_given, NOTHING, start=start)[0] - expected).max() > 2e-3


def test_a_drive_acts_on_what_its_encoder_reads():
    gains = {"kp": np.array([8.0]), "kd": np.array([0.3])}
    t = take(pendulum(), record(pendulum(), smooth_torque(1.0), **gains))
    w = windows_of(t, None)

    def build(plant, values):
        plant.encoder_scale[:], plant.encoder_offset[:] = 1.3, 0.05

    data = mujoco.MjData(t.model)
    data.qpos[:], data.qvel[:] = (t.position[0] - 0.05) / 1.3, t.velocity[0] / 1.3
    found = simulate(w, build, NOTHING)[0, 0]
    for i in range(w.length * t.substeps):
        read, rate = 1.3 * data.qpos + 0.05, 1.3 * data.qvel
        data.qfrc_applied[:] = 8.0 * (t.recording.position_target[i // t.substeps] - read) - 0.3 * rate
        mujoco.mj_step(t.model, data)
        if (i + 1) % t.substeps == 0:
            read = 1.3 * exact(t.model, data, t.velocity[0] / 1.3) + 0.05
            np.testing.assert_allclose(found[i // t.substeps], read, rtol=0, atol=1e-12)


class Motor(Law):
    """Notes what it is told, and squares the torque."""

    def begin(self, start):
        self.start, self.seen = start, []

    def __call__(self, now):
        self.seen.append((now.time.copy(), now.torque.copy(), now.position.copy()))
        return now.torque**2


def test_motor_laws_come_after_the_lag_and_before_the_scale_and_the_limit():
    limited = slider().replace('<motor joint="carriage"/>', '<motor joint="carriage" forcerange="-0.5 0.5"/>')
    r = record(slider(), 3 * smooth_torque(2.0))
    w = windows_of(take(limited, r), 0.5)
    law, beside = Motor(), []

    def build(plant, values):
        plant.delay[:], plant.lag[:], plant.torque_scale[:], plant.torque_offset[:] = 0.01, 0.02, 0.7, -0.1
        plant.motor.append(law)
        plant.laws.append(lambda now: beside.append(now.torque) or np.zeros_like(now.torque))

    def chain_alone(plant, values):
        plant.delay[:], plant.lag[:] = 0.01, 0.02
        plant.laws.append(lambda now: reached.append(now.torque) or np.zeros_like(now.torque))

    simulate(w, build, NOTHING)
    reached: list[np.ndarray] = []
    simulate(type(w)(take(slider(), r), w.start, w.length), chain_alone, NOTHING)
    np.testing.assert_allclose([torque for _, torque, _ in law.seen], reached, atol=1e-12)
    expected = np.clip(0.7 * np.square(reached) - 0.1, -0.5, 0.5)
    np.testing.assert_allclose(beside, expected, atol=1e-12)
    assert (expected == 0.5).any()


def test_a_law_knows_the_sample_and_the_time_that_each_row_starts_from():
    t = take(pendulum(), record(pendulum(), smooth_torque(2.0)))
    w, law = windows_of(t, 0.5), Motor()
    simulate(w, lambda plant, values: plant.motor.append(law), np.zeros((3, 0)))
    np.testing.assert_array_equal(law.start.sample, np.tile(w.start, 3))
    np.testing.assert_array_equal(law.start.position, t.position)
    np.testing.assert_allclose(law.start.command, t.recording.torque_command, atol=1e-9)
    time, _, position = law.seen[0]
    np.testing.assert_allclose(time, np.tile(t.time[w.start], 3))
    np.testing.assert_allclose(position, np.tile(t.position[w.start], (3, 1)))
    np.testing.assert_allclose(law.seen[-1][0], time + (len(law.seen) - 1) * t.model.opt.timestep)


@given(samples=st.integers(20, 300), seconds=st.floats(0.005, 4.0), rate=st.sampled_from([50.0, 100.0, 333.0]))
def test_windows_cover_every_sample_once(samples, seconds, rate):
    time = np.arange(samples) / rate
    t = take(slider(), Recording(time, ("carriage",), np.sin(time)[:, None], torque_command=np.zeros((samples, 1))))
    w = windows_of(t, seconds)
    covered = w.index.ravel()
    np.testing.assert_array_equal(covered, np.arange(1, len(covered) + 1))
    assert len(covered)  # a take that is shorter than a window is one
    assert 0 <= len(t.time) - 1 - len(covered) < w.length
    np.testing.assert_array_equal(w.measured[:, 0], t.measured[w.start + 1])
    assert windows_of(t, None).index.ravel().tolist() == list(range(1, len(t.time)))


def simulation(xml: str, names=("carriage",)) -> Simulation:
    return Simulation(mujoco.MjModel.from_xml_string(xml), names, Hypothesis(()), np.zeros(0))


def test_a_rollout_is_positions_at_the_recordings_stamps():
    heavier = slider().replace('mass="2"', 'mass="4"')
    r = record(slider(), smooth_torque(3.07, 2.0), noise=1e-6)
    same, other = simulation(slider()).rollout(r, window=0.5), simulation(heavier).rollout(r, window=0.5)
    assert same.shape == other.shape == r.position.shape
    assert np.abs(same - r.position).max() < 2e-3
    away = np.abs(other - r.position)[:, 0]
    assert away[0] < 1e-4
    assert away[50] > 10 * away[51]  # the end of a window has drifted, the sample after it starts anew
    assert away[-1] > 3 * away[301]  # so does the rest that fills no window


def test_without_windows_a_rollout_is_one_open_loop():
    r = record(slider(), smooth_torque(3.0), noise=0.0)
    found = simulation(slider()).rollout(r, window=None)
    model = mujoco.MjModel.from_xml_string(slider())
    t = take_of(r, model, *sensor_noise(r))
    torque = np.repeat(r.torque_command, t.substeps, axis=0)[: (len(r.time) - 1) * t.substeps]
    expected = plain_loop(t.model, found[0], t.velocity[0], torque, t.substeps)
    np.testing.assert_allclose(found[1:], expected, atol=1e-12)


def test_two_joints_stay_in_the_recordings_order():
    r = record(double_pendulum(), np.zeros((100, 2)), start=(0.3, -0.2))
    swapped = Recording(r.time, ("lower", "upper"), r.position[:, ::-1], torque_command=np.zeros((100, 2)))
    one = simulation(double_pendulum(), r.joint_names).rollout(r)
    two = simulation(double_pendulum(), swapped.joint_names).rollout(swapped)
    np.testing.assert_allclose(one, two[:, ::-1], atol=1e-12)
    assert np.abs(one - r.position).max() < 0.01


def explosion():
    r = record(slider(), smooth_torque(1.0), kp=np.array([10.0]), kd=np.array([1.0]))
    w = windows_of(take(slider(), r), 0.5)

    def explosive(plant, values):
        plant.kp_scale[:] = -1e6

    return simulate(w, explosive, NOTHING)


def test_a_simulation_that_diverges_stays_finite_and_says_nothing(every_cpu, monkeypatch, tmp_path, capfd):
    monkeypatch.chdir(tmp_path)  # where MuJoCo would write its log
    found = explosion()
    assert np.isfinite(found).all()
    assert np.abs(found).max() > 100  # it did diverge
    assert not any(capfd.readouterr())
    assert not list(tmp_path.iterdir())
    assert mujoco.get_mju_user_warning() is None


def test_who_listens_to_the_warnings_of_mujoco_hears_of_what_diverges(every_cpu):
    heard = []
    mujoco.set_mju_user_warning(heard.append)
    try:
        explosion()
    finally:
        mujoco.set_mju_user_warning(None)
    assert heard
    assert all("Nan, Inf or huge value" in text for text in heard)


def test_other_warnings_of_mujoco_are_passed_on_each_once(monkeypatch):
    def warned(*args):
        for text in ("Nan, Inf or huge value in QACC at DOF 0.", "Too many contacts.", "Too many contacts."):
            mujoco.get_mju_user_warning()(text)
        return np.zeros((1, 1, 1, 1))

    monkeypatch.setattr(replay, "_simulate", warned)
    with pytest.warns(RuntimeWarning) as told:
        explosion()
    assert [str(w.message) for w in told] == ["Too many contacts."]


def test_samples_between_the_physics_steps_are_met_by_a_whole_number_of_them():
    r = record(slider(), smooth_torque(2.0), rate=RATE)
    for step in (0.0007, 0.003, 0.02):
        t = take(slider(step), r)
        assert t.period == pytest.approx(1 / RATE, rel=0.2)
        assert t.substeps * t.model.opt.timestep == pytest.approx(t.period)
        assert t.model.opt.timestep <= 1.001 / RATE
        assert t.time[-1] <= r.time[-1] + 1e-9


def lagged(plant):
    plant.lag[:] = 0.03


def hidden(effect, values):
    return lambda plant: effect.apply(plant, 0, np.tile(values, (plant.rows, 1)))


@pytest.mark.parametrize("targets", [False, True])
@pytest.mark.parametrize(
    "change",
    [
        lagged,
        hidden(Hysteresis(), [0.1, 0.02]),
        hidden(ThermalDrift(), [0.02, 0.3, 0.1, 3.0]),
        hidden(LoadDependentFriction(), [0.02, 0.2]),
        hidden(Backlash(), [0.05, 40.0]),
    ],
    ids=["lag", "bristle", "warming", "load", "backlash"],
)
def test_joined_pieces_move_as_each_does_alone(change, targets):
    r = record(pendulum(), smooth_torque(6.0), **({"kp": np.full(1, 8.0), "kd": np.full(1, 0.3)} if targets else {}))
    other = replace(r, position=r.position[::-1].copy())  # another take, whose stamps are the same
    cut = [r.slice(0, 200), r.slice(215, 350), other.slice(375, 600), other.slice(0, 150)]
    notes = [{BEGAN: began} for began in (0.0, 0.0, -2.0, -2.0)]
    pieces = [
        take(pendulum(), replace(piece, metadata=note), period=1 / RATE) for piece, note in zip(cut, notes, strict=True)
    ]
    (together,) = join(pieces)
    assert together.begins.tolist() == [0, 200, 335, 560]

    def build(plant, values):
        change(plant)

    found = simulate(windows_of(together, 0.4), build, NOTHING)[0]
    alone = np.concatenate([simulate(windows_of(piece, 0.4), build, NOTHING)[0] for piece in pieces])
    np.testing.assert_allclose(found, alone, rtol=0, atol=1e-12)
    assert np.abs(found - simulate(windows_of(together, 0.4), as_given, NOTHING)[0]).max() > 1e-4


def test_takes_of_another_step_or_a_moment_s_length_stay_alone():
    r = record(pendulum(), smooth_torque(6.0))
    cuts = [r.slice(*ends) for ends in ((0, 200), (200, 400), (400, 450), (400, 600))]
    first, second, short = (take(pendulum(), cut, period=1 / RATE) for cut in cuts[:3])
    other = take(pendulum(step=0.001), cuts[3], period=1 / RATE)
    heavier = take(pendulum().replace('mass="0.5"', 'mass="0.6"'), cuts[1], period=1 / RATE)
    joined = join([first, other, second, short, heavier])
    assert [t.parts for t in joined] == [(first, second), (other,), (short,), (heavier,)]


def test_takes_with_other_gains_stay_alone():
    r = record(pendulum(), smooth_torque(4.0), kp=np.full(1, 8.0), kd=np.full(1, 0.3))
    same = r.slice(200, 400)
    others = replace(same, kp=np.full(1, 9.0)), replace(same, kd=np.full(1, 0.2))
    takes = [take(pendulum(), part, period=1 / RATE) for part in (r.slice(0, 200), same, *others)]
    assert [t.parts for t in join(takes)] == [(takes[0], takes[1]), (takes[2],), (takes[3],)]


def test_a_gear_looks_at_the_inertia_of_its_own_piece():
    """A folded arm has another inertia than a straight one."""
    xml = double_pendulum()
    r = record(xml, np.repeat(smooth_torque(4.0), 2, 1))
    bent = replace(r, position=r.position + np.array([0.0, 2.0]))
    pieces = [take(xml, part, period=1 / RATE) for part in (r.slice(0, 200), bent.slice(200, 400))]
    (together,) = join(pieces)

    def build(plant, values):
        Backlash().apply(plant, 0, np.tile([0.02, 40.0], (plant.rows, 1)))

    found = simulate(windows_of(together, 0.4), build, NOTHING)[0]
    alone = np.concatenate([simulate(windows_of(piece, 0.4), build, NOTHING)[0] for piece in pieces])
    np.testing.assert_allclose(found, alone, rtol=0, atol=1e-12)


def test_warmth_counts_from_where_the_take_began_and_not_its_piece():
    r = record(pendulum(), smooth_torque(6.0))
    late = r.slice(300, 600)
    warm, cold = (take(pendulum(), replace(late, metadata=note)) for note in ({BEGAN: r.began}, {}))

    def build(plant, values):
        ThermalDrift().apply(plant, 0, np.array([[0.0, 0.3, 0.0, 3.0]]).repeat(plant.rows, 0))

    one, other = (simulate(windows_of(t, 0.4), build, NOTHING)[0] for t in (warm, cold))
    assert np.abs(one[0] - other[0]).max() > 1e-3  # after 3 s two thirds of it are there


def test_a_velocity_that_is_logged_is_listened_to():
    """A tachometer is worth more than the slope of noisy positions."""
    time = np.arange(400) / RATE
    rng = np.random.default_rng(0)
    position = np.sin(6 * time)[:, None] + 1e-3 * rng.standard_normal((400, 1))
    velocity = 6 * np.cos(6 * time)[:, None] + 1e-3 * rng.standard_normal((400, 1))
    log = Recording(time, ("pendulum",), position, torque_command=np.zeros((400, 1)), velocity=velocity)
    model = mujoco.MjModel.from_xml_string(pendulum())
    told = [take_of(log, model, np.array([1e-3]), noise) for noise in (None, np.array([1e-3]))]
    error = [np.sqrt(np.mean((t.velocity[20:-20, 0] - 6 * np.cos(6 * t.time[20:-20])) ** 2)) for t in told]
    assert error[1] < 0.3 * error[0]


def test_where_noise_is_alike_from_sample_to_sample_a_start_is_known_less_well():
    """A mean over many samples is off by the square root of (1 + r) / (1 - r) more than one of independent noise."""
    model = mujoco.MjModel.from_xml_string(pendulum())
    time = np.arange(200) / RATE
    r = Recording(time, ("pendulum",), 0.1 * np.sin(time)[:, None], torque_command=np.zeros((200, 1)))
    white, slow = (take_of(r, model, np.array([1e-3]), noise_correlation=c).start_noise for c in (0.0, 0.6))
    np.testing.assert_allclose(slow, 2.0 * white, rtol=1e-6)


# --- by hand ---


def test_half_of_two_neighbours_lies_between_them_and_the_last_stays():
    np.testing.assert_allclose(
        replay._until_next(np.array([[0.0, 1.0], [2.0, 1.0], [6.0, 5.0]])), [[1, 1], [4, 3], [6, 5]]
    )


def test_what_diverges_keeps_its_last_finite_values_for_good_and_in_its_own_row():
    fine, wild = np.arange(8.0).reshape(4, 2), np.arange(8.0).reshape(4, 2)
    wild[2, 1] = np.nan
    lost = np.full((4, 2), 2e4)
    start = np.array([[0.0, 1.0], [0.0, 1.0], [3.0, 4.0]])
    found = replay._hold_finite(np.stack([fine, wild, lost]), start)
    np.testing.assert_array_equal(found, [fine, [[0, 1], [2, 3], [2, 3], [2, 3]], [[3, 4]] * 4])


def test_a_wheel_that_has_turned_two_thousand_times_is_followed_as_well_as_one_that_has_not():
    pushed = record(slider(), np.full((200, 1), 4.0))
    for ahead in (0.0, 2e4):
        t = take(slider(), replace(pushed, position=pushed.position + ahead))
        w = windows_of(t, 0.5)
        assert window_rmse([w], [simulate(w, as_given, np.zeros((1, 0)))[0]])[0] < 1e-3


def test_an_error_over_all_windows_weighs_them_by_their_length():
    def windows(length: int, *starts: int) -> replay.Windows:
        return replay.Windows(SimpleNamespace(measured=np.zeros((50, 2))), np.array(starts), length)

    both = [windows(10, 0, 10), windows(20, 0)]
    predicted = [np.array([1.0, 2.0])[:, None, None] * np.ones((2, 10, 2)), np.full((1, 20, 2), 3.0) * [1.0, 0.0]]
    whole, each = replay.window_rmse(both, predicted)
    np.testing.assert_allclose(each, [[1, 1], [2, 2], [3, 0]])
    np.testing.assert_allclose(whole, np.sqrt([(10 * 1 + 10 * 4 + 20 * 9) / 40, (10 * 1 + 10 * 4) / 40]))


def test_each_joints_torque_is_limited_scaled_and_shifted_in_this_order_within_the_motors_range(monkeypatch):
    monkeypatch.setattr(replay, "torque_range", lambda model, address: (np.array([-9.0, -1.5]), np.array([9.0, 1.0])))
    plant = SimpleNamespace(
        torque_limit=np.array([[2.0, np.inf], [np.inf, 0.5]]),
        torque_scale=np.array([[3.0, 1.0], [1.0, 2.0]]),
        torque_offset=np.array([[0.5, 0.0], [0.0, -0.25]]),
    )
    asked = np.array([[[4.0, 4.0], [-4.0, -4.0]], [[4.0, 4.0], [-4.0, -4.0]]])
    driven = replay._drive(asked, plant, SimpleNamespace(model=None, address=None))
    np.testing.assert_allclose(driven, [[[6.5, 1.0], [-5.5, -1.5]], [[4.0, 0.75], [-4.0, -1.25]]])


def test_jitter_of_the_stamps_is_told_from_gaps():
    rng = np.random.default_rng(0)
    time = 0.01 * np.arange(4000) + 1e-3 * rng.normal(size=4000)
    time[2000:] += 5.0
    assert replay._stamp_jitter(time) == pytest.approx(1e-3, rel=0.05)


def test_each_joint_is_interpolated_from_its_own_readings():
    read = replay._interpolate(
        np.array([0.5, 1.0]), np.array([0.0, 1.0, 3.0]), np.array([[0.0, 4.0], [1.0, 2.0], [9.0, 0.0]])
    )
    np.testing.assert_allclose(read, [[0.5, 3.0], [1.0, 2.0]])


def test_local_fits_are_as_noisy_as_they_say_in_the_middle_and_at_both_ends():
    rng = np.random.default_rng(0)
    noise = rng.normal(size=(60, 2000)) * 0.5
    for order in (0, 1):
        for value, sigma in replay._cubics(noise, order, 0.1, 1.5, np.full(2000, 0.5)):
            scatter = value.std(1)
            np.testing.assert_allclose(scatter, np.broadcast_to(sigma, value.shape)[:, 0], rtol=0.08)


def test_a_local_fit_is_the_quietest_that_agrees_with_all_noisier_ones():
    rough, fine, wide = np.array([[1.0] * 4, [1.2, 5.0, 1.2, 3.5], [1.1, 1.0, 9.0, 1.0]])[:, None]
    estimates = [(wide, np.full((1, 4), 0.1)), (rough, np.ones((1, 4))), (fine, np.full((1, 4), 0.4))]
    best, sigma = replay._local_fit(estimates)
    np.testing.assert_allclose(best, [[1.1, 1.0, 1.2, 3.5]])  # the wide one, the rough one, the one between
    np.testing.assert_allclose(sigma, [[0.1, 1.0, 0.4, 0.4]])


def test_the_torque_of_a_position_loop_is_that_of_the_mean_state_until_the_next_sample():
    r = record(pendulum(), smooth_torque(1.0))
    kp, kd = np.array([8.0]), np.array([0.3])
    r = replace(r, torque_command=None, position_target=0.5 * r.position, kp=kp, kd=kd)
    t = take(pendulum(), r)
    q, v = ((x[:-1] + x[1:]) / 2 for x in (t.position, t.velocity))
    target = t.commands(0.0).reshape(len(t.time), -1, 1).mean(1)[:-1]
    np.testing.assert_allclose(t.torque[:-1], kp * (target - q) - kd * v)


def test_the_step_is_short_for_the_derivative_gain_whatever_the_proportional_one():
    r = record(pendulum(), smooth_torque(1.0))
    model = mujoco.MjModel.from_xml_string(pendulum())
    data, inertia = mujoco.MjData(model), np.zeros((1, 1))
    mujoco.mj_forward(model, data)
    mujoco.mj_fullM(model, data, inertia)
    kd = np.array([inertia[0, 0] / model.opt.timestep])  # three times what an explicit step bears well
    for kp in (1e-3, 1e3):
        t = take(pendulum(), replace(r, torque_command=None, position_target=r.position, kp=np.array([kp]), kd=kd))
        assert 0.15 < kd[0] * t.model.opt.timestep / inertia[0, 0] <= 0.3
        assert t.period == pytest.approx(1 / r.rate)


@pytest.mark.parametrize(("integrator", "implicit"), [("implicitfast", True), ("Euler", True), ("RK4", False)])
def test_a_joint_that_stops_in_microseconds_asks_for_no_steps_as_short(integrator, implicit):
    """A wrist without a rotor in its model: explicit steps as short are the oracle."""
    light = wrist().replace("implicitfast", integrator)
    r = record(light, smooth_torque(1.0))
    gains = {"kp": np.array([2.0]), "kd": np.array([0.2])}
    r = replace(r, torque_command=None, position_target=0.3 * np.sin(4 * r.time)[:, None], **gains)
    t = take(light, r, period=0.02)
    assert t.substeps == (20 if implicit else t.explicit.substeps)
    assert t.explicit.model.opt.timestep <= 0.3 * t.inertia[0] / 0.2
    w = windows_of(t, 0.5)
    exact = simulate(replace(w, take=t.explicit), as_given, np.zeros((1, 0)))
    found = simulate(w, as_given, np.zeros((1, 0)))
    moved = np.abs(exact - exact[:, :, :1]).max()
    assert moved > 0.05
    assert np.abs(found - exact).max() < 0.01 * moved


def wrist(inertia: float = 1e-4) -> str:
    """No rotor."""
    return f"""
<mujoco><option timestep="0.002" integrator="implicitfast"/>
  <worldbody><body><joint name="wrist" axis="0 0 1"/>
    <inertial pos="0 0 0" mass="0.1" diaginertia="{inertia} {inertia} {inertia}"/></body></worldbody>
  <actuator><motor joint="wrist"/></actuator>
</mujoco>"""


@pytest.mark.parametrize("target", ["sine", "square"])
@pytest.mark.parametrize(
    ("inertia", "drive", "within"),
    [
        (1e-4, {"torque_limit": 0.3}, 0.02),
        (1e-4, {"torque_limit": 0.05}, 0.02),
        (1e-4, {"torque_limit": 0.01}, 0.02),
        (1e-5, {"torque_limit": 0.1}, 0.03),  # which takes it past the target's speed within a step
        (1e-4, {"lag": 0.02}, 0.05),
        (1e-4, {"lag": 0.005}, 0.05),
        (2e-5, {"torque_scale": 3.0}, 0.03),
        (2e-5, {"torque_scale": 0.3}, 0.03),
        (1e-4, {"kd_scale": 30.0}, 0.03),
    ],
)
def test_what_a_drive_does_to_the_damping_of_a_light_joint_is_simulated_as_in_steps_of_microseconds(
    inertia, drive, within, target
):
    xml = wrist(inertia)
    r = record(xml, smooth_torque(1.0))
    path = 0.3 * np.sin(4 * r.time) if target == "sine" else 0.15 * np.sign(np.sin(4 * np.pi * r.time))
    gains = {"kp": np.array([2.0]), "kd": np.array([0.2])}
    t = take(xml, replace(r, torque_command=None, position_target=path[:, None], **gains), period=0.02)

    def driven(plant, values):
        for name, value in drive.items():
            getattr(plant, name)[:] = value

    fine = t.explicit
    while fine.model.opt.timestep > 0.3 * inertia / (0.2 * drive.get("kd_scale", 1.0)):
        fine = fine.halved()
    w = windows_of(t, 0.5)
    exact, found = (simulate(each, driven, np.zeros((1, 0))) for each in (replace(w, take=fine), w))
    assert np.abs(found - exact).max() < within * np.abs(exact - exact[:, :, :1]).max()


def test_a_model_whose_dampers_are_off_is_stepped_explicitly():
    xml = wrist().replace("/>", '><flag damper="disable"/></option>', 1)
    r = record(xml, smooth_torque(0.2))
    gains = {"kp": np.array([2.0]), "kd": np.array([0.2])}
    t = take(xml, replace(r, torque_command=None, position_target=r.position, **gains), period=0.02)
    assert t.explicit is t
    assert t.substeps > 20


def test_a_stiff_joint_with_a_rotor_is_stepped_explicitly_and_one_behind_a_gear_in_finer_steps():
    r = record(wrist(), smooth_torque(1.0))
    gains = {"kp": np.array([2.0]), "kd": np.array([0.2])}
    r = replace(r, torque_command=None, position_target=r.position, **gains)
    t = take(wrist(), r, period=0.02)

    def stiff(armature, kd_scale=1.0):
        plant = Plant(t.model, t.address, 1)
        plant.of("dof_armature")[:, 0] = armature
        plant.kd_scale[:] = kd_scale
        return _stiffness(t, plant, step)[0, 0]

    step = t.model.opt.timestep
    assert stiff(0.0) == pytest.approx(0.2 - 0.3 * 1e-4 / step)
    assert stiff(2e-4) == pytest.approx(0.2 - 0.3 * 3e-4 / step)
    assert stiff(0.0, kd_scale=0.1) == 0.0
    assert stiff(0.01) == 0.0


def test_a_motor_before_a_gear_is_stepped_finer_where_its_controller_damps_it_and_the_step_still_shows():
    xml = wrist().replace('axis="0 0 1"', 'axis="0 0 1" armature="2e-4"')
    r, gains = record(xml, smooth_torque(1.0)), {"kp": np.array([2.0]), "kd": np.array([0.2])}
    path = 0.3 * np.sin(4 * r.time)[:, None]
    r = replace(r, position=path, velocity=None, torque_command=None, position_target=path, **gains)
    t = take(xml, r, period=0.02)
    seen = []

    def soft(plant, values):
        seen.append(plant.model.opt.timestep)
        candidate(Compliance(), r, xml).effect.apply(plant, 0, values)

    values, w = np.array([[5.0, 0.01]]), windows_of(t, 0.2)
    out = simulate(w, soft, values)
    assert seen == [t.model.opt.timestep, t.explicit.model.opt.timestep]
    half = simulate(replace(w, take=t.halved()), soft, values)
    assert seen[-1] == t.explicit.model.opt.timestep / 2 < t.model.opt.timestep / 2
    heavy = take(xml.replace("1e-4", "1e-2").replace("0.0001", "0.01"), r, period=0.02)
    simulate(windows_of(heavy, 0.2), soft, values)
    assert seen[-1] == heavy.model.opt.timestep  # a gear on a joint that is heavy enough asks for nothing finer
    assert np.abs(out).max() < 1.0
    assert 0.0 < np.abs(half - out).max() < 1e-2


def test_half_the_step_is_that_of_every_piece():
    whole = record(pendulum(), smooth_torque(4.0))
    (joined,) = join([take(pendulum(), whole.slice(*ends), period=0.01) for ends in ((0, 150), (200, 400))])
    half = joined.halved()
    for before, after in zip((joined, *joined.pieces), (half, *half.pieces), strict=True):
        assert after.model.opt.timestep == before.model.opt.timestep / 2
        assert after.period == before.period
    assert half.commands(0.0).shape == (2 * len(joined.commands(0.0)), 1)


def test_every_fifth_sample_of_every_piece_is_driven_by_the_mean_command_between_them():
    whole = record(pendulum(1e-3), smooth_torque(4.0, rate=1e3), rate=1e3)
    (joined,) = join([take(pendulum(1e-3), whole.slice(*ends), period=1e-3) for ends in ((0, 1503), (2000, 4000))])
    thin = joined.thinned(5)
    assert thin.period == thin.model.opt.timestep == pytest.approx(5e-3)
    assert thin.begins.tolist() == [0, 301]
    assert joined.period == pytest.approx(1e-3)  # as it was
    for name in ("time", "measured", "position", "velocity"):
        own = [getattr(piece, name)[::5] for piece in joined.pieces]
        np.testing.assert_array_equal(getattr(thin, name), np.concatenate(own))
    assert thin.start_noise.shape == (2, 701, 1)
    fine = joined.pieces[1].commands(0.0).reshape(-1, 5, 1).mean(1)
    np.testing.assert_allclose(thin.commands(0.0)[301:], fine, atol=1e-12)


def test_windows_of_every_fifth_sample_are_those_of_all_of_them():
    whole = record(pendulum(1e-3), smooth_torque(4.0, rate=1e3), rate=1e3)
    (joined,) = join([take(pendulum(1e-3), whole.slice(*ends), period=1e-3) for ends in ((0, 1503), (2000, 4000))])
    thin = windows_of(joined.thinned(5), 0.5)
    own = thin.of(joined)
    assert len(own.start) == len(thin.start) > 4
    np.testing.assert_array_equal(own.measured[:, 4::5], thin.measured)
    np.testing.assert_array_equal(thin.of(thin.take.stepped(3)).start, thin.start)


def test_a_base_is_thinned_with_the_joints():
    t = take(pendulum(), record(pendulum(), smooth_torque(4.0)))
    count = len(t.time)
    speed = np.arange(6.0 * count).reshape(count, 6)
    base = BaseMotion(np.zeros((count, 7)), speed, np.zeros((count, 6)))
    thin = replace(t, base=base, base_noise=speed).thinned(4)
    np.testing.assert_array_equal(thin.base.velocity, speed[::4])
    np.testing.assert_array_equal(thin.base_noise, speed[::4])
    assert len(thin.base.pose) == len(thin.time)


def test_a_base_is_misread_by_the_noise_of_each_of_its_axes():
    t = take(pendulum(), record(pendulum(), smooth_torque(4.0)))
    assert t.misread(np.random.default_rng(0)) is t
    count = len(t.time)
    base, noise = BaseMotion(np.zeros((count, 7)), np.ones((count, 6)), np.zeros((count, 6))), 0.1 * np.arange(6.0)
    read = replace(t, base=base, base_noise=noise[None]).misread(np.random.default_rng(0)).base
    np.testing.assert_allclose(read.velocity.std(0), noise, rtol=0.15)
    np.testing.assert_allclose(read.velocity.mean(0), 1.0, atol=0.1)
    np.testing.assert_array_equal(read.pose, base.pose)


@pytest.mark.parametrize("logged", [False, True])
def test_stamps_that_jitter_make_a_start_as_uncertain_as_the_joint_is_fast(logged):
    """A reading is off by what the joint moved meanwhile, and a speed by what it gained."""
    rng = np.random.default_rng(0)
    time = np.arange(600) / RATE + 2e-4 * rng.normal(size=600)
    time -= time[0]
    noise = []
    for size in (0.2, 0.4):
        speed = 6 * size * np.cos(6 * time)[:, None] if logged else None
        r = Recording(time, ("pendulum",), size * np.sin(6 * time)[:, None], speed, torque_command=np.zeros((600, 1)))
        t = take_of(r, mujoco.MjModel.from_xml_string(pendulum()), np.full(1, 1e-9), np.full(1, 1e-9))
        noise.append(np.median(t.start_noise, axis=1)[:, 0])
    np.testing.assert_allclose(noise[1] / noise[0], 2.0, rtol=0.1)


def test_a_start_is_known_no_worse_than_one_reading_and_its_speed_less_well():
    t = take(pendulum(), record(pendulum(), smooth_torque(2.0), noise=1e-3), 1e-3)
    assert (t.start_noise[0] <= 1e-3 + 1e-12).all()
    assert (t.start_noise[1] > 3e-3).all()


def test_a_base_at_rest_seems_to_move_as_much_as_its_noise_says(monkeypatch):
    """The noise is a millimetre, and a hundredth of a radian about each axis, of which a quaternion has the half."""
    rng = np.random.default_rng(0)
    time = np.arange(3000) / RATE
    half_turn = 0.5 * 1e-2 * rng.normal(size=(3000, 3))
    pose = np.hstack([1e-3 * rng.normal(size=(3000, 3)), np.ones((3000, 1)), half_turn])
    monkeypatch.setattr(replay, "pose_of", lambda recording, model: pose)
    monkeypatch.setattr(replay, "base_noise", lambda recording: (1e-3, 1e-2))
    base, noise = replay._base_of(SimpleNamespace(time=time), None, time, 0.1, 0.0)
    inside = slice(100, -100)
    typical = 1.4826 * np.median(np.abs(base.velocity[inside]), axis=0)
    np.testing.assert_allclose(typical, np.median(noise[inside], axis=0), rtol=0.4)
    np.testing.assert_allclose(np.linalg.norm(base.pose[:, 3:], axis=1), 1.0, rtol=1e-12)
    np.testing.assert_allclose(base.acceleration[inside].mean(0), 0.0, atol=0.05)


def test_the_bases_of_joined_pieces_move_one_after_the_other_each_with_its_own_noise():
    whole, pieces = record(pendulum(), smooth_torque(4.0)), []
    for size, ends in enumerate(((0, 150), (200, 400)), start=1):
        t = take(pendulum(), whole.slice(*ends), period=0.01)
        base = BaseMotion(*(np.full((len(t.time), k), float(size)) for k in (7, 6, 6)))
        pieces.append(replace(t, base=base, base_noise=np.full((len(t.time), 6), 0.1 * size)))
    (joined,) = join(pieces)
    assert joined.base_noise[:, 0].tolist() == [0.1] * len(pieces[0].time) + [0.2] * len(pieces[1].time)
    np.testing.assert_array_equal(joined.base.velocity, 10 * joined.base_noise)


def test_a_window_is_as_long_as_asked_where_one_piece_holds_it_and_shorter_pieces_have_none():
    whole = record(pendulum(), smooth_torque(5.0))
    (joined,) = join([take(pendulum(), whole.slice(*ends), period=0.01) for ends in ((0, 120), (200, 420))])
    first = len(joined.pieces[0].time)
    windows = windows_of(joined, 0.01 * (first + 20))
    assert (windows.length, windows.start.tolist()) == (first + 20, [first])


# --- two joints that have nothing in common ---

UNLIKE = {  # of the upper and the lower joint, in two sets
    "delay": [[0.004, 0.013], [0.0, 0.006]],
    "lag": [[0.03, 0.0], [0.01, 0.05]],
    "kp_scale": [[1.3, 0.8], [0.7, 1.2]],
    "kd_scale": [[0.6, 1.5], [1.4, 0.5]],
    "encoder_scale": [[1.1, 0.9], [0.95, 1.05]],
    "encoder_offset": [[0.05, -0.1], [-0.02, 0.03]],
    "torque_limit": [[0.6, 0.25], [0.3, np.inf]],
    "torque_scale": [[0.8, 1.2], [1.1, 0.9]],
    "torque_offset": [[0.02, -0.05], [-0.03, 0.01]],
}


def unlike(names):
    """Builds a set by its number, for joints in this order; the lower one has play, and is rubbed by a law."""
    order = [("upper", "lower").index(name) for name in names]
    low = names.index("lower")

    def build(plant, values):
        chosen = values[:, 0].astype(int)
        for name, table in UNLIKE.items():
            getattr(plant, name)[:] = np.array(table)[chosen][:, order]
        Backlash().apply(plant, low, np.array([[0.02, 40.0], [0.01, 60.0]])[chosen])
        Hysteresis().apply(plant, low, np.array([[0.05, 0.02], [0.02, 0.05]])[chosen])

    return build


def of_two_joints(targets: bool):
    command = np.hstack([smooth_torque(1.2, 0.8, 1), smooth_torque(1.2, 0.4, 2)])
    motors = '<motor joint="upper" ctrlrange="-0.5 0.4"/><motor joint="lower" ctrlrange="-0.1 0.2"/>'
    xml = double_pendulum().replace("</mujoco>", f"<actuator>{motors}</actuator></mujoco>")
    gains = {"kp": np.array([8.0, 3.0]), "kd": np.array([0.3, 0.1])} if targets else {}
    return xml, record(xml, command, start=(0.3, -0.2), **gains)


@pytest.mark.parametrize("targets", [False, True])
def test_each_joint_and_each_set_has_numbers_of_its_own_whatever_their_order(targets):
    xml, r = of_two_joints(targets)
    found = []
    for names in (("upper", "lower"), ("lower", "upper")):
        w = windows_of(take(xml, r.ordered(names)), 0.5)
        both = simulate(w, unlike(names), np.array([[0.0], [1.0]]))
        found.append(both)
    np.testing.assert_allclose(both[1], simulate(w, unlike(names), np.array([[1.0]]))[0], rtol=0, atol=1e-12)
    np.testing.assert_allclose(found[0], found[1][..., ::-1], rtol=0, atol=1e-9)
    assert np.abs(found[0][0] - found[0][1]).max() > 0.01


@pytest.mark.parametrize("targets", [False, True])
def test_joints_in_another_order_are_started_and_driven_alike(targets):
    xml, r = of_two_joints(targets)
    r = replace(r, velocity=np.gradient(r.position, r.time, axis=0))
    noise = np.array([1e-5, 2e-4])
    own, turned = (
        take_of(x, mujoco.MjModel.from_xml_string(xml), n, 10 * n)
        for x, n in ((r, noise), (r.ordered(("lower", "upper")), noise[::-1]))
    )
    assert own.model.opt.timestep == turned.model.opt.timestep
    for name in ("measured", "position", "velocity", "torque"):
        np.testing.assert_allclose(getattr(own, name), getattr(turned, name)[:, ::-1], atol=1e-12, err_msg=name)
    np.testing.assert_allclose(own.start_noise, turned.start_noise[:, :, ::-1])
    for delay in (0.0, 0.007):
        np.testing.assert_array_equal(own.commands(delay), turned.commands(delay)[:, ::-1])


def test_half_the_step_drives_each_piece_by_its_own_command():
    whole = record(pendulum(), smooth_torque(4.0))
    (joined,) = join([take(pendulum(), whole.slice(*ends), period=0.01) for ends in ((0, 150), (200, 400))])
    for delay in (0.0, 0.01):
        fine = joined.halved().commands(delay)
        np.testing.assert_allclose(fine.reshape(-1, 2, 1).mean(1), joined.commands(delay), atol=1e-9)


@pytest.mark.parametrize("joint", [0, 1])
def test_the_step_is_short_for_the_joint_whose_gain_asks_for_it(joint):
    xml, r = of_two_joints(True)
    given = take(xml, r)
    inertia = np.diag(replay.inertia_matrix(given.model, given.address, r.position[:1])[0])
    kd = np.where(np.arange(2) == joint, inertia / STEP, 1e-6)  # three times what an explicit step bears well
    t = take(xml, replace(r, kd=kd))
    assert 0.2 < t.model.opt.timestep * kd[joint] / inertia[joint] <= 0.3
    assert t.period == pytest.approx(1 / RATE)


@pytest.mark.parametrize("rate", [50.0, 400.0])
@pytest.mark.parametrize(
    ("effect", "values", "gap"), [(Compliance(), [10.0, 0.5], 0.0), (Backlash(), [0.02, 10.0], 0.02)]
)
def test_what_rests_under_a_load_stays_at_rest_behind_a_gear_that_gives_way(effect, values, gap, rate):
    """The encoder reads the motor, which is ahead of the link by half of the gap and by what the load bends."""
    load = 0.5 * 9.81 * 0.4 * np.sin(0.5)
    still = np.ones((int(rate), 1))
    time, read = np.arange(len(still)) / rate, 0.5 + gap / 2 + load / 10.0
    held = Recording(time, ("pendulum",), read * still, torque_command=load * still)
    w = windows_of(take(pendulum(joint='armature="0.02"'), held), 0.3)
    seen = []

    def build(plant, x):
        effect.apply(plant, 0, np.tile(values, (plant.rows, 1)))
        plant.laws.append(lambda now: seen.append(now.position.copy()) or np.zeros_like(now.torque))

    np.testing.assert_allclose(simulate(w, build, NOTHING)[0], read, atol=2e-3)
    np.testing.assert_allclose(seen, 0.5, atol=2e-3)  # laws beside the joint act on the link


def test_what_is_joined_is_each_piece_after_the_other_in_all_that_was_measured():
    whole = record(pendulum(), smooth_torque(4.0), noise=1e-3)
    pieces = [take(pendulum(), whole.slice(*ends), 1e-3, period=0.01) for ends in ((0, 150), (200, 400))]
    (joined,) = join(pieces)
    for name in ("time", "measured", "position", "velocity", "torque"):
        expected = np.concatenate([getattr(piece, name) for piece in pieces])
        np.testing.assert_array_equal(getattr(joined, name), expected, err_msg=name)
    np.testing.assert_array_equal(joined.start_noise, np.hstack([piece.start_noise for piece in pieces]))
    assert np.abs(joined.measured - joined.position).max() > 1e-4
    assert windows_of(joined, 1e-4).length == 1  # no window is shorter than a sample


def test_a_base_that_swings_is_as_fast_as_its_path_and_as_uncertain_as_its_stamps_make_it(monkeypatch):
    time = np.arange(600) / RATE
    pose = np.hstack([np.sin(3 * time)[:, None], np.zeros((600, 2)), np.ones((600, 1)), np.zeros((600, 3))])
    monkeypatch.setattr(replay, "pose_of", lambda recording, model: pose)
    monkeypatch.setattr(replay, "base_noise", lambda recording: (1e-6, 1e-6))
    (base, quiet), (_, late) = (replay._base_of(SimpleNamespace(time=time), None, time, 0.1, s) for s in (0.0, 1e-3))
    inside = slice(50, -50)
    np.testing.assert_allclose(base.velocity[inside, 0], 3 * np.cos(3 * time[inside]), atol=0.02)
    np.testing.assert_allclose(base.acceleration[inside, 0], -9 * np.sin(3 * time[inside]), atol=0.2)
    assert np.median(late[:, 0]) > 100 * np.median(quiet[:, 0])
    np.testing.assert_allclose(late[:, 1:], quiet[:, 1:])  # what does not move is not off


def test_a_rough_velocity_is_smoothed_over_the_longest_test_function_and_no_less_than_a_sample():
    """White noise: a derivative behind a Gaussian of twice the width has 2^1.5 times less of it."""
    noise = np.random.default_rng(0).normal(size=(4000, 8))
    narrow, wide = (replay._rough_velocity(noise, 0.01, longest).std() for longest in (0.05, 0.1))
    assert narrow / wide == pytest.approx(2**1.5, rel=0.05)
    np.testing.assert_array_equal(*(replay._rough_velocity(noise, 0.01, longest) for longest in (0.01, 0.001)))
    ramp = np.arange(50.0)[:, None]
    np.testing.assert_allclose(replay._rough_velocity(ramp, 0.5, 0.5)[5:-5], 2.0)


SWUNG = """<mujoco><worldbody><body><joint name="beam" axis="0 0 1"/><geom size="0.1"/></body>
  <body pos="0 0 1"><freejoint/><geom size="0.1"/>
  <body><joint name="hip" axis="0 1 0"/><geom size="0.05" pos="0 0 -0.3"/></body></body></worldbody></mujoco>"""


def swung_base(late):
    """Ten samples in two pieces, of which the k-th has a base as fast as k squared, and rows that start in both."""
    model = mujoco.MjModel.from_xml_string(SWUNG)
    model.dof_armature[:] = np.arange(1.0, model.nv + 1)
    sample = np.arange(10.0)[:, None]
    pose = np.hstack([sample * np.ones(3), np.ones((10, 1)), np.zeros((10, 3))])
    base = BaseMotion(pose, sample**2 * np.arange(1.0, 7.0), 0.0 * sample * np.ones(6))
    t = SimpleNamespace(base=base, period=0.01, substeps=2, model=model)
    start = SimpleNamespace(sample=np.array([1, 2, 7]), first=np.array([0, 0, 6]), last=np.array([5, 5, 9]))
    return start, SimpleNamespace(rows=3, base_offset=np.array(late)), t


@pytest.mark.parametrize(
    ("late", "reached"),
    [
        ((0.0, 0.0, 0.0), [[1, 2, 3], [2, 3, 4], [7, 8, 9]]),
        ((0.005, -0.005, 0.0), [[1.5, 2.5, 3.5], [1.5, 2.5, 3.5], [7, 8, 9]]),  # stamps that are put right
        ((0.03, -0.03, 0.02), [[4, 5, 5], [0, 0, 1], [9, 9, 9]]),  # within the piece
    ],
)
def test_a_base_is_where_it_was_at_each_rows_own_samples_between_which_it_goes_straight(late, reached):
    start, plant, t = swung_base(late)
    found = replay._base_from(start, plant, t, 2)
    np.testing.assert_allclose(found.pose[..., :3], np.array(reached)[..., None] * np.ones(3))
    whole = np.floor(reached)
    between = (whole**2 + (np.array(reached) - whole) * (2 * whole + 1))[..., None] * np.arange(1.0, 7.0)
    np.testing.assert_allclose(found.velocity, between)


def test_a_base_is_carried_by_what_its_mass_asks_for_in_each_step_of_a_sample():
    """In a model with a beam before the base and a hip after it, the base's masses are the second to the seventh."""
    start, plant, t = swung_base((0.0, 0.0, 0.0))
    found = replay._carry(start, plant, replay.Windows(t, np.zeros(3), 2))
    gained = np.array([[3.0, 5.0], [5.0, 7.0], [15.0, 17.0]]).repeat(2, axis=1)[..., None] * np.arange(1.0, 7.0)
    np.testing.assert_allclose(found, np.arange(2.0, 8.0) * gained / 0.01)
    t.base = None
    assert replay._carry(start, plant, replay.Windows(t, np.zeros(3), 2)).shape == (3, 4, 0)


def test_a_lag_begins_where_the_torques_before_it_in_its_piece_have_brought_it():
    """A step of each joint's target at the eleventh of forty samples, of a drive that rests; a second piece is settled.

    The torque is what is left of the way by one minus the exponential of the time since, over the lag.
    """
    asked, target = [], np.repeat([0.0, 1.0], [10, 30])[:, None] * [2.0, -3.0]
    t = SimpleNamespace(
        position=np.zeros((40, 2)), velocity=np.zeros((40, 2)), period=0.01, begins=np.array([0, 25]),
        recording=SimpleNamespace(kp=np.array([5.0, 7.0]), kd=np.ones(2)),
        commands=lambda late, joint: asked.append(late) or target[:, [joint]].repeat(4, axis=0),
    )  # fmt: skip
    lag, scale = np.array([[0.05, 0.1], [0.02, 0.2]]), np.array([[1.0, 2.0], [0.5, 3.0]])
    plant = SimpleNamespace(
        delay=np.array([[0.01, 0.02], [0.03, 0.04]]).repeat(3, 0), clock_offset=np.array([0.1, 0.2]).repeat(3),
        kp_scale=scale.repeat(3, 0), kd_scale=np.ones((6, 2)), lag=lag.repeat(3, 0),
    )  # fmt: skip
    found = replay._lag_state(replay.Windows(t, np.array([5, 17, 30]), 4), plant, 2)
    final = scale * [10.0, -21.0]
    passed = final * (1 - np.exp(-0.07 / lag))
    np.testing.assert_allclose(found, np.stack([0 * final, passed, final], 1).reshape(6, 2))
    assert asked == pytest.approx([0.11, 0.23, 0.12, 0.24])
    t.velocity += 1.0
    plant.kd_scale[:] = scale.repeat(3, 0)
    slowed = replay._lag_state(replay.Windows(t, np.array([5, 17, 30]), 4), plant, 2)
    np.testing.assert_allclose(slowed, found - scale.repeat(3, 0))
    asked.clear()
    for table in (plant.delay, plant.kp_scale, plant.kd_scale, plant.lag):
        table[3:, 1] = table[:3, 1]
    plant.clock_offset[3:] = plant.clock_offset[:3]
    shared = replay._lag_state(replay.Windows(t, np.array([5, 17, 30]), 4), plant, 2)
    np.testing.assert_allclose(shared[:, 1], np.tile(slowed[:3, 1], 2))
    np.testing.assert_allclose(shared[:3, 0], slowed[:3, 0])
    assert asked == pytest.approx([0.11, 0.13, 0.12])  # what two sets share is asked once


@pytest.mark.parametrize("pieces", [False, True])
def test_the_commands_of_one_joint_are_its_column(pieces):
    torque = 0.1 * np.sin(0.1 * np.arange(400)[:, None] * [1.0, 2.0])
    whole = take(double_pendulum(), record(double_pendulum(), torque), noise=1e-9)
    if pieces:
        (whole,) = join([whole, whole])
        assert len(whole.parts) == 2
    for delay in (0.0, 0.0037):
        both = whole.commands(delay)
        assert both.shape == (len(whole.time) * whole.substeps, 2)
        for joint in range(2):
            np.testing.assert_array_equal(whole.commands(delay, joint), both[:, [joint]])
