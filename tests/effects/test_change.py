from dataclasses import replace

import numpy as np
import pytest
from effects.arm import JOINTS, address, arm, record
from effects.explained import explained, projected
from effects.slider import MASS, STEP, push, speed

from torchrl_athletic.diagnosis.prepare import _pieces
from torchrl_athletic.diagnosis.replay import simulate, take_of, windows_of
from torchrl_athletic.effects import project_recording
from torchrl_athletic.effects.change import Disturbance, ThermalDrift, _uncut


def acceleration(force, *effects):
    """Acceleration of the mass on its rail, from the third step on."""
    (position,) = push(force, *effects)
    return np.diff(speed(position)) / STEP


# --- warming up ---


def test_friction_approaches_its_final_level_with_the_time_constant():
    force, amplitude, constant = np.full(1500, 5.0), 2.0, 0.4
    time = STEP * np.arange(2, 1500)
    expected = (force[2:] - amplitude * (1 - np.exp(-time / constant))) / MASS
    np.testing.assert_allclose(
        acceleration(force, (ThermalDrift(), [0.0, amplitude, 0.0, constant])), expected, atol=2e-3
    )


@pytest.mark.parametrize("lost", [-2.0, -3.0])
def test_cold_friction_that_goes_is_that_of_the_start_at_first_and_nothing_in_the_end(lost):
    """No more goes than there was: friction never pushes, nor is it greater at the start than it was said to be."""
    force, cold, constant = np.full(3000, 5.0), 2.0, 0.4
    time = STEP * np.arange(2, 3000)
    expected = (force[2:] - cold * np.exp(-time / constant)) / MASS
    np.testing.assert_allclose(acceleration(force, (ThermalDrift(), [cold, lost, 0.0, constant])), expected, atol=5e-3)


def test_grease_that_thins_gives_back_what_a_damper_takes():
    force, constant = np.full(1500, 5.0), 0.4
    (position,) = push(force, (ThermalDrift(), [0.0, 0.0, -1.5, constant]))
    v = speed(position)
    time = STEP * np.arange(2, 1500)
    expected = (5.0 + 1.5 * (1 - np.exp(-time / constant)) * v[:-1]) / MASS
    np.testing.assert_allclose(np.diff(v) / STEP, expected, rtol=5e-3)


def test_a_warm_joint_stands_against_what_pushes_less_than_its_friction():
    force = np.where(np.arange(3000) < 1000, 0.0, 1.0)
    (position,) = push(force, (ThermalDrift(), [0.0, 2.0, 0.0, 0.1]))
    assert np.abs(position).max() < 2e-3  # a cold one moves 1 m


def test_a_window_in_the_middle_is_as_warm_as_the_take():
    values = np.array([0.0, 0.4, 0.1, 2.0])
    take = take_of(record(ThermalDrift(), 0, values, seconds=6.0), arm(), np.zeros(2))
    windows = windows_of(take, 0.4)

    def build(plant, rows):
        ThermalDrift().apply(plant, 0, rows)

    warm, cold = simulate(windows, build, np.array([values, 0 * values + [0, 0, 0, 1]]))
    late = slice(len(windows.start) // 2, None)
    error = [np.sqrt(((x - windows.measured)[late] ** 2).mean()) for x in (warm, cold)]
    assert error[0] < 0.1 * error[1]


@pytest.mark.parametrize(("joint", "values"), [(0, (0.1, 0.3, 0.2, 2.0)), (1, (0.15, -0.1, 0.1, 4.0))], ids=JOINTS)
def test_the_fingerprint_of_a_drift_is_what_the_simulation_misses(joint, values):
    share, factor = explained(ThermalDrift(), joint, values, projected(ThermalDrift(), joint, values, seconds=12.0))
    assert share > 0.97
    assert factor == pytest.approx(1, abs=0.03)


def test_a_short_take_shows_no_drift_and_the_longest_take_sets_the_time_constants():
    short, long = (project_recording(record(seconds=t), arm(), np.zeros(2)) for t in (4.0, 12.0))
    assert ThermalDrift().grid(short, 0) == []
    assert ThermalDrift().grid_of([short, long], 0) == ThermalDrift().grid(long, 0)
    constants = [point["time_constant"] for point in ThermalDrift().grid(long, 0)]
    assert constants == sorted(constants)
    assert 3.0 <= constants[0] < 0.6 * 12.0  # nothing that a motor turns warms up in two seconds


def test_the_clock_of_a_drift_starts_with_the_take():
    recording = record(seconds=12.0)
    later = replace(recording, time=recording.time + 1e4)
    prints = [
        ThermalDrift().fingerprint(project_recording(r, arm(), np.zeros(2)), 1, {"time_constant": 3.0}).columns
        for r in (recording, later)
    ]
    np.testing.assert_allclose(prints[0], prints[1], atol=1e-6)


# --- a push, once ---


def test_a_push_gives_its_impulse_once():
    start, duration, torque = 0.2004, 0.1003, 3.0  # edges within a step
    position = push(np.zeros(800), (Disturbance(), [start, duration, torque, 0.0]))[0]
    v = speed(position)
    assert not v[:199].any()
    np.testing.assert_allclose(v[310:], torque * duration / MASS, rtol=1e-6)


def test_a_push_belongs_to_one_take():
    recording = record(seconds=4.0)
    take = take_of(recording, arm(), np.zeros(2))
    whole = windows_of(take, None)
    here = (recording.position[1:] + recording.position[:-1]).mean(0) / 2 @ [1, 2]

    def build(plant, rows):
        Disturbance().apply(plant, 1, rows)

    again = here + 1e-4 * float(np.ptp(recording.position))  # as under control, repeated
    takes = np.array([[1, 0.2, 0, here], [1, 0.2, 0.5, here], [1, 0.2, 0.5, 9.0], [1, 0.2, 0.5, again]])
    none, same, *others = simulate(whole, build, takes)
    for other in others:
        np.testing.assert_allclose(other, none, atol=1e-12)
    assert np.abs(same - none).max() > 0.01


def pushed(start: float, duration: float, torque: float, noise: float = 0.0, seed: int = 0, joint: int = 1):
    """Signals of an arm that was pushed once, with encoder noise and another clock.

    The take it simulates is at rest: signature 0.
    """
    recording = record(Disturbance(), joint, (start, duration, torque, 0.0), seconds=10.0, seed=seed)
    read = recording.position + np.random.default_rng(seed).normal(0, noise, recording.position.shape)
    later = replace(recording, position=read, time=recording.time + 1000.0)
    return project_recording(later, arm(), np.full(2, noise), kernel=0.015)


@pytest.mark.parametrize(
    ("start", "duration", "torque"),
    [(2.0, 0.5, 0.25), (6.3, 0.12, -0.5), (4.0, 2.0, 0.2), (8.9, 1.0, 0.5), (0.1, 1.0, 0.5)],  # also at a take's ends
)
def test_the_matched_filter_finds_the_interval_under_noise(start, duration, torque):
    s = pushed(start, duration, torque, noise=1e-4)
    first = Disturbance().grid(s, 1)[0]
    assert first["start"] == pytest.approx(start, abs=0.04)
    assert first["duration"] == pytest.approx(duration, abs=0.06)
    column = Disturbance().fingerprint(s, 1, first).columns[:, 1, 0]
    assert column @ s.missing[:, 1] / (column @ column) == pytest.approx(torque, rel=0.1)


def test_a_push_that_throws_the_joint_does_not_bend_what_it_is_seen_against():
    first = Disturbance().grid(pushed(4.0, 1.5, 4.0, noise=1e-4), 1)[0]  # sixteen times the commanded torque
    assert first["start"] == pytest.approx(4.0, abs=0.04)
    assert first["duration"] == pytest.approx(1.5, abs=0.06)


def cut(s, *gaps):
    """Signals of the pieces that drop-outs leave of a take, as the diagnosis cuts it."""
    rows = s.recording.time - s.recording.time[0]
    kept = np.all([(rows < a) | (rows > b) for a, b in gaps], axis=0)
    pieces = _pieces(s.recording.where(kept))
    assert len(pieces) == len(gaps) + 1
    return [project_recording(piece, arm(), np.full(2, 1e-4), kernel=0.015) for piece in pieces]


def test_a_push_is_one_push_although_drop_outs_cut_the_take_while_it_lasts():
    start, duration, torque = 4.0, 1.2, 0.4
    whole = pushed(start, duration, torque, noise=1e-4)
    pieces = cut(whole, (3.4, 3.5), (4.3, 4.4), (4.9, 5.0))  # one of them is nothing but push
    first = Disturbance().grid_of(pieces, 1)[0]
    assert first["start"] == pytest.approx(start, abs=0.04)
    assert first["duration"] == pytest.approx(duration, abs=0.06)
    columns = [Disturbance().fingerprint(s, 1, first).columns[:, 1, 0] for s in pieces]
    assert [c.any() for c in columns] == [False, True, True, True]
    assert (columns[2] < -0.9).all() or (columns[2] > 0.9).all()


def test_takes_that_read_alike_and_what_lies_beyond_a_long_gap_are_looked_at_apart():
    whole = pushed(4.0, 1.2, 0.4)
    assert [len(group) for group in _uncut([whole, whole])] == [1, 1]
    pieces = cut(whole, (2.0, 2.1), (4.0, 7.0))
    assert [len(group) for group in _uncut([*pieces, *pieces])] == [2, 1, 2, 1]


def test_the_pieces_of_a_take_simulate_the_push_of_the_whole():
    pieces = [s.recording for s in cut(pushed(4.0, 1.2, 0.4), (3.4, 3.5), (4.3, 4.4), (4.9, 5.0), (6.0, 6.1))]
    (here,) = {piece.mean_reading for piece in pieces}

    def build(plant, rows):
        Disturbance().apply(plant, 1, rows)

    values = np.array([[4.0, 1.2, 0.0, here], [4.0, 1.2, 0.4, here], [4.0, 1.2, 0.4, here + 1.0]])
    felt = []
    for piece in pieces:
        none, push, other = simulate(windows_of(take_of(piece, arm(), np.zeros(2)), None), build, values)
        np.testing.assert_array_equal(other, none)
        felt.append(np.abs(push - none).max() > 0.01)
    assert felt == [False, True, True, True, False]


def test_the_fingerprint_of_a_push_is_what_the_simulation_misses_in_its_take_alone():
    s, another = pushed(3.0, 0.4, 0.3), pushed(5.0, 0.3, 0.3, seed=1)
    own = Disturbance().grid(s, 1)[0]["take"]
    share, factor = explained(
        Disturbance(), 1, (3.0, 0.4, 0.3, own), s, hidden={"start": 3.0, "duration": 0.4, "take": own}
    )
    assert share > 0.95
    assert factor == pytest.approx(1, abs=0.03)
    assert not Disturbance().fingerprint(another, 1, {"start": 3.0, "duration": 0.4, "take": own}).columns.any()


def test_the_pushes_of_all_takes_are_proposed_and_no_more_than_a_few():
    takes = [pushed(3.0, 0.4, 0.6), pushed(5.0, 0.3, 0.6, seed=1)]
    grid = Disturbance().grid_of(takes, 1)
    assert len(grid) <= 8
    for s, start in zip(takes, (3.0, 5.0), strict=True):
        (own,) = {point["take"] for point in Disturbance().grid(s, 1)}
        best = next(point for point in grid if point["take"] == own)
        assert best["start"] == pytest.approx(start, abs=0.04)


def test_the_sentences_say_when_and_how_much():
    drift = ThermalDrift().parameters(arm(), address(), 0)
    text = ThermalDrift().sentence(
        "shoulder", {"coulomb": 0.3, "amplitude": -0.2, "damping": 0.03, "time_constant": 40.0}, drift
    )
    assert "time constant of 40 s" in text
    assert "-0.2 N·m" in text
    once = Disturbance().parameters(arm(), address(), 0)
    values = {"start": 12.25, "duration": 0.3, "torque": 1.5, "take": 0.1}
    text = Disturbance().sentence("shoulder", values, once)
    assert "+1.5 N·m acted on shoulder once, 12.25 s after its start, for 300 ms" in text


@pytest.mark.parametrize(("constant", "warms"), [(3.0, False), (3.02, False), (3.1, True), (40.0, True)])
def test_a_drift_at_the_quickest_that_can_be_is_none(constant, warms):
    parameters = ThermalDrift().parameters(arm(), address(), 0)
    assert ThermalDrift().is_physical(parameters, np.array([0.2, 0.1, 0.0, constant])) == warms


def test_a_drift_is_no_slower_than_the_longest_take_can_show():
    s = project_recording(record(seconds=12.0), arm(), np.zeros(2))
    *_, slow = ThermalDrift().parameters_of([s], 0)
    assert max(point["time_constant"] for point in ThermalDrift().grid(s, 0)) <= slow.upper * (1 + 1e-9)
    assert slow.upper == pytest.approx(1.5 * s.recording.duration, rel=0.01)
