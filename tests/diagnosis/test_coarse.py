"""Longer physics steps for a search: taken where the motion stays what it was, refused elsewhere."""

from types import SimpleNamespace

import mujoco
import numpy as np
import pytest
from diagnosis.plants import STEP, pendulum, record, smooth_torque

from torchrl_athletic.diagnosis import coarse as coarse_module
from torchrl_athletic.diagnosis.coarse import (
    ALIKE,
    LONGEST,
    _halved,
    coarse,
    fit_in_steps_of,
    in_steps_of,
    moves_alike,
)
from torchrl_athletic.diagnosis.descent import linearise, linearise_roughly
from torchrl_athletic.diagnosis.fit import WINDOW, Hypothesis
from torchrl_athletic.diagnosis.prepare import prepare
from torchrl_athletic.diagnosis.problem import GRAIN, compared_every, problem_of
from torchrl_athletic.diagnosis.screen import Candidate
from torchrl_athletic.effects import ReflectedInertia, ViscousFriction

NOTHING = Hypothesis(())


def takes_of(xml, true_xml=None, start=0.0):
    """Takes of a robot that differs from its model."""
    recording = record(true_xml or xml, smooth_torque(8.0), start)
    return prepare([recording], mujoco.MjModel.from_xml_string(xml)).takes


def test_a_take_is_replayed_in_fewer_steps_of_the_same_samples():
    takes = takes_of(pendulum(STEP), pendulum(STEP, 'damping="0.2"'))
    ((copy, take),) = coarse(takes, NOTHING, [np.zeros(0)], np.random.default_rng(0)).items()
    assert take is takes[0]
    assert copy.substeps < take.substeps
    assert copy.model.opt.timestep == pytest.approx(LONGEST[0])
    assert copy.period == pytest.approx(take.period)
    np.testing.assert_array_equal(copy.measured, take.measured)
    assert take.model.opt.timestep == pytest.approx(STEP)  # as it was


def test_a_take_stays_what_it_is_where_longer_steps_move_otherwise():
    """A spring of 20 Hz swings otherwise in the steps of a search."""
    springs = (f'stiffness="{k}" damping="0.05"' for k in (1420, 1380))
    takes = takes_of(*(pendulum(5e-4, spring) for spring in springs), start=0.1)
    assert set(coarse(takes, NOTHING, [np.zeros(0)], np.random.default_rng(0))) == set(takes)
    bent = takes[0].stepped(takes[0].substeps // 10)
    assert not moves_alike(bent, takes[0], NOTHING, np.zeros(0), np.random.default_rng(0))


def test_a_log_whose_samples_are_close_is_replayed_on_fewer_of_them(monkeypatch):
    """At 1 kHz a step cannot be longer than a sample; errors are compared each 5 ms in any case."""
    true, given = (pendulum(1e-3, f'damping="{damping}"') for damping in (0.2, 0.05))
    takes = prepare([record(true, smooth_torque(8.0, rate=1e3), rate=1e3)], mujoco.MjModel.from_xml_string(given)).takes
    ((copy, take),) = coarse(takes, NOTHING, [np.zeros(0)], np.random.default_rng(0)).items()
    assert take is takes[0]
    assert copy.period == copy.model.opt.timestep == pytest.approx(GRAIN)
    rough = problem_of(NOTHING, (copy,), WINDOW, 10, np.random.default_rng(1), np.zeros(0))
    fine = in_steps_of(rough, {copy: take})
    for a, b in zip(rough.windows, fine.windows, strict=True):
        np.testing.assert_allclose(a.take.time[a.index], b.take.time[b.index][:, 4::5])
    errors = [p.errors(np.zeros((1, 0)))[:, 0] for p in (rough, fine)]  # of the same instants, row by row
    assert np.abs(errors[0] - errors[1]).max() < 2 * ALIKE * np.abs(errors[1]).max()
    assert [(c.period, c.substeps) for c in _halved(copy, take)] == [(pytest.approx(GRAIN), n) for n in (1, 2)]
    monkeypatch.setattr(coarse_module, "ALIKE", 0.05)  # both are compared at the same instants
    assert moves_alike(copy, take, NOTHING, np.zeros(0), np.random.default_rng(0))


@pytest.mark.parametrize("period", [0.002, 0.0019999999, 0.0020000001])
def test_at_500_hz_every_other_sample_is_compared_whatever_the_last_digit(period):
    assert compared_every(SimpleNamespace(period=period)) == 2


def rotor_missing(stiffness, rotor):
    """Takes of a sprung pendulum whose model lacks its rotor, and that rotor as a hypothesis."""
    takes = takes_of(*(pendulum(5e-4, f'stiffness="{stiffness}" armature="{a}"') for a in (0.0, rotor)), start=0.1)
    law = ReflectedInertia()
    return takes, Hypothesis((Candidate(law, 0, "joint", law.parameters(takes[0].model, takes[0].address, 0)),))


def chosen_step(takes, h, *points):
    (copy,) = coarse(takes, h, [np.array([x]) for x in points], np.random.default_rng(0))
    return copy.model.opt.timestep


def test_steps_that_the_given_model_cannot_bear_are_taken_where_a_better_start_bears_them():
    """A spring of 60 Hz swings otherwise in long steps, and at 6 Hz with a rotor, which the robot has."""
    takes, h = rotor_missing(12800, 10.0)
    assert chosen_step(takes, h, 0.0) == pytest.approx(5e-4)
    assert chosen_step(takes, h, 0.0, 8.0) == pytest.approx(5e-3)


def test_a_start_that_follows_worse_has_no_say_in_the_steps():
    """With a rotor of a hundred times the link nothing moves in half a second, in steps of any length."""
    takes, h = rotor_missing(1400, 0.02)
    assert chosen_step(takes, h, 10.0) == pytest.approx(5e-3)
    assert chosen_step(takes, h, 0.018, 10.0) == chosen_step(takes, h, 0.018) < 4e-3


def test_how_alike_is_measured_by_the_error_that_there_is():
    takes = takes_of(pendulum(STEP))  # nothing is missing: what the steps change is all there is
    assert set(coarse(takes, NOTHING, [np.zeros(0)], np.random.default_rng(0))) == set(takes)
    assert 0 < ALIKE < 1


@pytest.mark.parametrize(
    ("own", "alike_from", "counts"),
    [
        (20, [2], [2]),
        (20, [3, 3], [2, 4]),
        (20, [3, 5, 5], [2, 4, 8]),  # by what is found in four steps a sample, four are too few
        (20, [9], [2, 20]),  # 16 of the take's 20 would save next to nothing
        (3, [2], [2]),  # nor would others than the copy between 2 and 3, but it moves alike
        (3, [3], [2, 3]),
    ],
)
def test_a_fit_is_made_again_in_shorter_steps_until_they_move_alike_by_what_it_finds(
    monkeypatch, own, alike_from, counts
):
    """Steps of a copy are halved; ``alike_from`` so many a sample they move alike, by the first fit, the second..."""
    (take,) = takes_of(pendulum(STEP))
    own = take.stepped(own)
    names, told = fit_in_steps_of.__globals__, []

    def fit(laws, takes, start, rng):
        told.append(([t.substeps for t in takes], start))
        return SimpleNamespace(values=len(told))

    def alike(copy, take, h, x, rng):
        return copy is take or copy.substeps >= alike_from[x - 1]

    monkeypatch.setitem(names, "fit", fit)
    monkeypatch.setitem(names, "moves_alike", alike)
    assert fit_in_steps_of({own.stepped(2): own}, "laws", 0, lambda purpose: purpose).values == len(counts)
    assert told == [([count], k) for k, count in enumerate(counts)]


def test_a_problem_keeps_its_windows_in_other_steps():
    takes = takes_of(pendulum(STEP), pendulum(STEP, 'damping="0.2"'))
    copies = coarse(takes, NOTHING, [np.zeros(0)], np.random.default_rng(0))
    rough = problem_of(NOTHING, tuple(copies), WINDOW, 40, np.random.default_rng(1), np.zeros(0))
    fine = in_steps_of(rough, copies)
    assert [w.take for w in fine.windows] == list(takes)
    for a, b in zip(rough.windows, fine.windows, strict=True):
        np.testing.assert_array_equal(a.start, b.start)
    errors = [np.sqrt(p.mean_square(np.zeros((1, 0))).mean()) for p in (rough, fine)]
    assert errors[0] == pytest.approx(errors[1], rel=ALIKE)
    assert errors[0] != errors[1]
    assert [w.take for w in fine.slope_windows] == list(copies)
    assert in_steps_of(fine, {take: copy for copy, take in copies.items()}).slope_windows == ()


def test_slopes_are_those_of_the_longer_steps_and_errors_those_of_the_takes_own():
    """Damping that a pendulum lacks: by steps of 5 ms a slope is nearly what it is by the model's own."""
    takes = takes_of(pendulum(STEP), pendulum(STEP, 'damping="0.2"'))
    law = ViscousFriction()
    h = Hypothesis((Candidate(law, 0, "joint", law.parameters(takes[0].model, takes[0].address, 0)),))
    copies = coarse(takes, h, [h.nominal], np.random.default_rng(0))
    rough = problem_of(h, tuple(copies), WINDOW, 40, np.random.default_rng(1), h.nominal)
    fine, free = in_steps_of(rough, copies), np.ones(1, dtype=bool)
    near, own = linearise_roughly(fine, h.nominal, free), linearise(fine, h.nominal, free)
    np.testing.assert_array_equal(near.errors, own.errors)
    np.testing.assert_array_equal(near.columns, linearise(rough, h.nominal, free).columns)
    np.testing.assert_allclose(near.columns, own.columns, atol=0.02 * np.abs(own.columns).max())
    assert not np.array_equal(near.columns, own.columns)
    assert near.seconds > own.seconds  # a step by it takes as long as many in the takes' own
