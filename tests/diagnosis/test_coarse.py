"""Longer physics steps for a search: taken where the motion stays what it was, refused elsewhere."""

from types import SimpleNamespace

import mujoco
import numpy as np
import pytest
from diagnosis.plants import STEP, pendulum, record, smooth_torque

from torchrl_athletic.diagnosis.coarse import ALIKE, LONGEST, coarse, fit_in_steps_of, in_steps_of, moves_alike
from torchrl_athletic.diagnosis.fit import WINDOW, Hypothesis
from torchrl_athletic.diagnosis.prepare import prepare
from torchrl_athletic.diagnosis.problem import problem_of

NOTHING = Hypothesis(())


def takes_of(xml, true_xml=None, start=0.0):
    """Takes of a robot that differs from its model."""
    recording = record(true_xml or xml, smooth_torque(8.0), start)
    return prepare([recording], mujoco.MjModel.from_xml_string(xml)).takes


def test_a_take_is_replayed_in_fewer_steps_of_the_same_samples():
    takes = takes_of(pendulum(STEP), pendulum(STEP, 'damping="0.2"'))
    ((copy, take),) = coarse(takes, NOTHING, np.zeros(0), np.random.default_rng(0)).items()
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
    assert set(coarse(takes, NOTHING, np.zeros(0), np.random.default_rng(0))) == set(takes)
    bent = takes[0].stepped(takes[0].substeps // 10)
    assert not moves_alike(bent, takes[0], NOTHING, np.zeros(0), np.random.default_rng(0))


def test_how_alike_is_measured_by_the_error_that_there_is():
    takes = takes_of(pendulum(STEP))  # nothing is missing: what the steps change is all there is
    assert set(coarse(takes, NOTHING, np.zeros(0), np.random.default_rng(0))) == set(takes)
    assert 0 < ALIKE < 1


@pytest.mark.parametrize("alike", [True, False])
def test_what_was_found_in_long_steps_is_fitted_again_in_the_takes_own_where_these_move_otherwise(monkeypatch, alike):
    names, told = fit_in_steps_of.__globals__, []
    found = iter([SimpleNamespace(values="first"), SimpleNamespace(values="second")])
    monkeypatch.setitem(names, "fit", lambda *given: told.append(given) or next(found))
    monkeypatch.setitem(names, "moves_alike", lambda copy, take, h, x, rng: alike or (copy, take, x) == ("b", "B", ""))
    fitted = fit_in_steps_of({"a": "A", "b": "B"}, "laws", "start", lambda purpose: purpose)
    assert told[0] == ("laws", ("a", "b"), "start", "fit")
    assert told[1:] == ([] if alike else [("laws", ("A", "B"), "first", "fit")])
    assert fitted.values == ("first" if alike else "second")


def test_a_problem_keeps_its_windows_in_other_steps():
    takes = takes_of(pendulum(STEP), pendulum(STEP, 'damping="0.2"'))
    copies = coarse(takes, NOTHING, np.zeros(0), np.random.default_rng(0))
    rough = problem_of(NOTHING, tuple(copies), WINDOW, 40, np.random.default_rng(1), np.zeros(0))
    fine = in_steps_of(rough, copies)
    assert [w.take for w in fine.windows] == list(takes)
    for a, b in zip(rough.windows, fine.windows, strict=True):
        np.testing.assert_array_equal(a.start, b.start)
    errors = [np.sqrt(p.mean_square(np.zeros((1, 0))).mean()) for p in (rough, fine)]
    assert errors[0] == pytest.approx(errors[1], rel=ALIKE)
    assert errors[0] != errors[1]
