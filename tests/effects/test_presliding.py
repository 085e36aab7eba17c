from dataclasses import replace

import numpy as np
import pytest
from effects.arm import JOINTS, address, arm, record
from effects.explained import explained, projected
from effects.slider import MASS, STEP, push, speed

from torchrl_athletic.diagnosis.replay import simulate, take_of, windows_of
from torchrl_athletic.effects.presliding import Hysteresis, directions, sliding
from torchrl_athletic.effects.signals import bristle

WANDER = np.cumsum(np.random.default_rng(0).normal(0, 0.02, 2000))


def test_several_widths_are_what_each_is_alone():
    widths = np.array([0.002, 0.05, 0.7])
    together = sliding(WANDER, widths)
    for k, width in enumerate(widths):
        np.testing.assert_allclose(together[:, k], bristle(WANDER, width), atol=1e-12)


def test_a_creeping_joint_is_held_by_its_share_and_one_that_slides_by_no_more_than_all_of_it():
    s = projected(Hysteresis(), 0, (0.0, 0.1))
    early = {"presliding": 0.01, "creep": 0.2, "turnover": 0.05}
    plain, ahead = directions(s, 0, [{**early, "turnover": 0.0}, early]).T
    np.testing.assert_allclose(plain, np.clip(s.fine_velocity[:, 0] / 0.2, -1, 1))
    assert (np.abs(plain) == 1).any()
    shift = round(0.05 / s.fine_step)
    np.testing.assert_allclose(ahead[:-shift], plain[shift:], atol=0.05)


def test_relaxed_bristles_wind_up_over_their_width_and_unwind_after_a_reversal():
    way = np.linspace(0.0, 1.0, 200)
    out, back = sliding(np.concatenate([way, way[-2::-1]]), np.array([0.2]), relaxed=True)[:, 0].reshape(-1)[[150, -1]]
    assert out == pytest.approx(1 - np.exp(-way[150] / 0.2))
    top = 1 - np.exp(-1 / 0.2)
    assert back == pytest.approx(-1 + (top + 1) * np.exp(-1 / 0.2))


def test_what_never_moves_strains_nothing_and_the_way_back_is_the_mirror_image():
    assert not sliding(np.full(30, 0.4), np.array([0.1, 1.0])).any()
    widths = np.array([0.03, 0.3])
    np.testing.assert_allclose(sliding(-WANDER, widths, relaxed=True), -sliding(WANDER, widths, relaxed=True))
    np.testing.assert_array_equal(sliding(WANDER, widths, relaxed=True)[0], 0.0)


def test_the_force_left_to_accelerate_a_mass_is_the_push_less_the_wound_up_friction():
    force = 5.0 * np.sin(2 * np.pi * 2.0 * STEP * np.arange(1500))
    (position,) = push(force, (Hysteresis(), [1.5, 0.01]))
    travelled = np.concatenate([[0.0], position])  # it starts from zero
    acceleration = np.diff(speed(travelled)) / STEP
    wound = sliding(travelled, np.array([0.01]), relaxed=True)[1:-1, 0]
    np.testing.assert_allclose(MASS * acceleration, force[1:] - 1.5 * wound, atol=1e-6)


def test_it_springs_back_where_dry_friction_would_hold():
    force = np.where(np.arange(300) < 100, 1.0, 0.0)
    (position,) = push(force, (Hysteresis(), [20.0, 0.02]))
    assert position[100:].min() < 0.3 * position.max()


@pytest.mark.parametrize("joint", [0, 1], ids=JOINTS)
def test_a_window_in_the_middle_goes_on_with_bristles_bent_by_what_came_before(joint):
    values = np.array([[0.5, 0.3], [0.2, 0.3]][joint])
    recording = record(Hysteresis(), joint, values, seconds=4.0)
    take = take_of(recording, arm(), np.zeros(2))
    windows = windows_of(take, 0.4)

    def build(plant, rows):
        Hysteresis().apply(plant, joint, rows)

    (remembered,) = simulate(windows, build, values[None])
    error = np.sqrt(((remembered - windows.measured) ** 2).mean())
    (without,) = simulate(windows, lambda plant, rows: None, np.zeros((1, 0)))
    assert error < 0.05 * np.sqrt(((without - windows.measured) ** 2).mean())


@pytest.mark.parametrize(("joint", "values"), [(0, (0.5, 0.1)), (1, (0.15, 0.3))], ids=JOINTS)
def test_its_fingerprint_is_what_the_simulation_misses(joint, values):
    share, factor = explained(Hysteresis(), joint, values, projected(Hysteresis(), joint, values))
    assert share > 0.98
    assert factor == pytest.approx(1, abs=0.03)


def test_widths_shrink_with_the_travel_but_stay_beyond_those_of_dry_friction():
    s = projected(Hysteresis(), 0, (0.0, 0.1))
    travel = np.ptp(s.fine_position[:, 0])
    widths = [point["width"] for point in Hysteresis().grid(s, 0)]
    assert widths == sorted(widths)
    assert widths[0] >= 0.01 * min(travel, 1.0)
    assert widths[-1] < travel


def test_what_builds_up_within_the_presliding_of_dry_friction_is_no_hysteresis():
    s = projected(Hysteresis(), 0, (0.0, 0.1))
    parameters = Hysteresis().parameters(s.nominal, s.address, 0)
    narrowest = parameters[1].lower
    assert not Hysteresis().is_physical(parameters, np.array([1.0, narrowest]))
    assert Hysteresis().is_physical(parameters, np.array([1.0, 1.1 * narrowest]))
    slow = replace(s, fine_position=0.1 * s.fine_position)  # a tenth of the way: the finest widths would be narrower
    assert 0 < len(Hysteresis().grid(slow, 0)) < len(Hysteresis().grid(s, 0))
    assert min(point["width"] for point in Hysteresis().grid(slow, 0)) > narrowest


def test_the_sentence_says_torque_and_way():
    text = Hysteresis().sentence(
        "elbow", {"torque": 0.42, "width": 0.035}, Hysteresis().parameters(arm(), address(), 1)
    )
    assert "After every reversal of elbow" in text
    assert "0.42 N·m over 35 mrad" in text
