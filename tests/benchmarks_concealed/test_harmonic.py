"""Drives with a rotor, a gear and a link obey mechanics, each law against its closed form."""

from __future__ import annotations

import numpy as np
import pytest

from benchmarks.concealed.harmonic import (
    FRICTION,
    HYSTERESIS,
    POSITION,
    ROTOR,
    ROTOR_SPEED,
    SPEED,
    STATES,
    TORQUE,
    advance,
    derivative,
    elastic_torque,
    ideal,
    slip_level,
    stop_torque,
    workroom,
)
from benchmarks.concealed.plant import Tree


def wheel(inertia: float = 0.1) -> Tree:
    """One link about a vertical axis, which gravity does not turn."""
    return Tree(
        np.array([-1]), np.zeros(1, dtype=bool), np.array([[0.0, 0.0, 1.0]]), np.zeros((1, 3)), np.eye(3)[None],
        np.array([1.0]), np.zeros((1, 3)), inertia * np.eye(3)[None], np.array([0.0, 0.0, -9.81]),
    )  # fmt: skip


def drive(**figures: float) -> np.ndarray:
    p = ideal(1)
    for name, value in figures.items():
        p[name] = value
    return p


def run(p, torque, tree=None, x=None, step: float = 1e-4, steps: int = 10) -> np.ndarray:
    """States after each of the torques, held for ``steps`` each. Shape (T, 7)."""
    x = np.zeros((1, STATES)) if x is None else x
    tree, room, slopes, out = tree or wheel(), workroom(1), np.zeros((5, 1, STATES)), []
    for u in np.atleast_1d(torque):
        advance(tree, p, x, np.array([float(u)]), step, steps, room, slopes)
        out.append(x[0].copy())
    return np.array(out)


GEAR = drive(
    first_stiffness=3400.0, second_stiffness=4700.0, third_stiffness=5700.0, first_torque=2.0, second_torque=6.9
)


def test_the_gear_is_as_stiff_as_its_catalogue_says_in_each_piece():
    first, second = 2.0 / 3400, 2.0 / 3400 + 4.9 / 4700
    assert elastic_torque(GEAR[0], 0.5 * first) == pytest.approx(1.0)
    assert elastic_torque(GEAR[0], first) == pytest.approx(2.0)
    assert elastic_torque(GEAR[0], second) == pytest.approx(6.9)
    assert elastic_torque(GEAR[0], second + 1e-3) == pytest.approx(6.9 + 5.7)
    assert elastic_torque(GEAR[0], -second - 1e-3) == pytest.approx(-6.9 - 5.7)


def test_a_frictionless_drive_speeds_up_as_one_inertia():
    states = run(drive(gear_damping=5.0), np.full(500, 1.3))
    assert states[-1, SPEED] == pytest.approx(1.3 / (0.1 + 0.03) * 0.5, rel=2e-3)


def test_link_and_rotor_swing_against_each_other_at_their_own_frequency():
    x = np.zeros((1, STATES))
    x[0, ROTOR] = 1e-3
    windup = np.diff(run(drive(first_stiffness=3000.0), np.zeros(4000), x=x, steps=1)[:, [POSITION, ROTOR]], axis=1)
    crossings = np.flatnonzero(np.diff(np.sign(windup[:, 0])) > 0) * 1e-4
    expected = np.sqrt(3000.0 * (1 / 0.1 + 1 / 0.03)) / (2 * np.pi)
    assert (len(crossings) - 1) / (crossings[-1] - crossings[0]) == pytest.approx(expected, rel=3e-3)


@pytest.mark.parametrize("sign", [1.0, -1.0])
def test_sliding_friction_opposes_motion_with_its_level(sign):
    p = drive(coulomb=2.0, bristle_stiffness=2000.0, viscous=1.5, gear_damping=5.0)
    end = run(p, np.full(3000, 5.0 * sign))[-1]
    assert end[FRICTION] == pytest.approx(2.0 * sign, rel=1e-4)
    assert end[ROTOR_SPEED] == pytest.approx(sign * (5.0 - 2.0) / 1.5, rel=1e-3)  # nothing else is left


def test_a_joint_sticks_below_breakaway_and_starts_above_it():
    p = drive(
        coulomb=2.0, breakaway_ratio=1.5, stribeck_speed=0.1, bristle_stiffness=2000.0, viscous=1.0, gear_damping=5.0
    )
    ramp = np.arange(0.0, 2.8, 0.002)
    bent = -3.0 / 2000.0 * np.log(1 - ramp[-1] / 3.0)  # of a bristle whose level is 3 N·m
    assert run(p, ramp)[-1, ROTOR] == pytest.approx(bent, rel=0.1)
    assert run(p, np.append(ramp, np.full(1000, 3.2)))[-1, ROTOR] > 0.1


def test_friction_falls_with_speed_and_grows_with_load():
    p = drive(coulomb=2.0, breakaway_ratio=1.5, stribeck_speed=0.1, load_coefficient=0.1)
    assert slip_level(p[0], 0.0, 0.0) == pytest.approx(3.0)
    assert slip_level(p[0], -5.0, 0.0) == pytest.approx(2.0)
    assert slip_level(p[0], 5.0, -10.0) == pytest.approx(3.0)
    assert slip_level(p[0], 0.1, 0.0) == pytest.approx(2.0 * (1 + 0.5 / np.e))


def test_the_loop_of_wind_up_is_as_wide_as_twice_the_hysteresis_over_the_stiffness():
    p = drive(first_stiffness=5000.0, hysteresis=2.0, hysteresis_stiffness=4000.0, gear_damping=2.0)
    wave = 20.0 * np.sin(2 * np.pi * np.arange(4000) / 2000)  # two slow loops, the link as good as locked
    states = run(p, wave, wheel(1e9))
    windup = states[2000:, ROTOR] - states[2000:, POSITION]
    at_zero = windup[[999, 1999]]
    assert at_zero[0] - at_zero[1] == pytest.approx(2 * 2.0 / 5000.0, rel=0.05)
    gear = wave[2000:]  # quasi-static: the torque is the gear's
    lost = float(np.sum(0.5 * (gear[1:] + gear[:-1]) * np.diff(windup)))
    assert lost > 0.0
    assert lost == pytest.approx(4 * 2.0 * windup.max(), rel=0.15)  # a rectangle, but for its corners


def test_the_motor_answers_after_its_lag():
    states = run(drive(lag=0.004), np.full(4, 3.0))
    np.testing.assert_allclose(states[:, TORQUE], 3.0 * (1 - np.exp(-np.arange(1, 5) / 4)), rtol=1e-6)


def test_a_stop_pushes_inwards_and_never_pulls():
    p = drive(lowest=-1.0, highest=1.0, stop_stiffness=1000.0, stop_damping=1000.0)[0]
    assert stop_torque(p, 0.99, 5.0) == 0.0
    assert stop_torque(p, 1.01, 0.0) == pytest.approx(-10.0)
    assert stop_torque(p, -1.01, 0.0) == pytest.approx(10.0)
    assert stop_torque(p, 1.01, 0.5) < stop_torque(p, 1.01, 0.0)  # harder on the way in
    assert stop_torque(p, 1.01, -50.0) == 0.0
    assert stop_torque(p, -1.01, 50.0) == 0.0


def test_halving_the_step_makes_the_error_of_a_smooth_motion_sixteen_times_smaller():
    x0 = np.zeros((1, STATES))
    x0[0, ROTOR] = 2e-3
    ends = [
        run(drive(first_stiffness=2000.0), 0.0, x=x0.copy(), step=4e-4 / n, steps=100 * n)[-1, ROTOR] for n in (1, 2, 4)
    ]
    assert (ends[0] - ends[1]) / (ends[1] - ends[2]) == pytest.approx(16, rel=0.25)


def test_bristle_and_hysteresis_never_bear_more_than_their_level():
    p = drive(coulomb=1.5, bristle_stiffness=1500.0, hysteresis=1.0, hysteresis_stiffness=2000.0, gear_damping=2.0)
    states = run(p, 8.0 * np.random.default_rng(0).normal(size=400))
    assert np.abs(states[:, FRICTION]).max() <= 1.5 * (1 + 1e-6)
    assert 0.5 < np.abs(states[:, HYSTERESIS]).max() <= 1.0 * (1 + 1e-6)


def test_at_rest_and_without_torque_nothing_changes():
    out = np.ones((1, STATES))
    derivative(wheel(), GEAR, np.zeros((1, STATES)), np.zeros(1), workroom(1), out)
    assert (out == 0.0).all()
