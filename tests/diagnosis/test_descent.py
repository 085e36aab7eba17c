"""Bounded least squares: each step must be the best of those that are tried, and no more than windows say."""

import sys
from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
from diagnosis.test_problem import each_its_own, following, take_like

from torchrl_athletic.diagnosis import problem as windows_module
from torchrl_athletic.diagnosis.deadline import Deadline
from torchrl_athletic.diagnosis.descent import Linearised, descend, linearise
from torchrl_athletic.diagnosis.replay import Windows

module = sys.modules["torchrl_athletic.diagnosis.descent"]


def test_a_descent_weighs_windows_and_joints_as_its_problem_does(monkeypatch):
    """One whole step by one slope, on two windows that ask for 1 and 3, of which the second weighs three times."""
    problem, _ = following(monkeypatch, each_its_own(1.0, 3.0))
    monkeypatch.setattr(module, "DAMPING", (0.0,))
    monkeypatch.setattr(module, "STEPS", 1)
    for begin, unit in ((7.0, 0.1), (-7.0, 1e3)):
        uneven = replace(problem, weight=np.array([1.0, 3.0]), unit=np.array([unit]))
        assert descend(uneven, np.array([begin]), np.array([True]), 1, Deadline()) == pytest.approx([2.5], rel=1e-4)


@pytest.mark.parametrize(("low", "ends"), [(-99.0, -2.0), (-1.5, -1.5)])
def test_what_moves_is_counted_in_its_own_unit_and_stops_at_its_own_bound(monkeypatch, low, ends):
    windows = Windows(take_like(9, truth=[1.0, -2.0]), np.array([0, 4]), 4)
    problem, _ = following(monkeypatch, windows, nominal=(0.0, 0.0))
    problem.hypothesis.scale = np.array([9.0, 0.25])
    problem.hypothesis.bounds = (np.array([-0.1, low]), np.array([0.1, 9.0]))
    monkeypatch.setattr(module, "DAMPING", (0.0,))
    monkeypatch.setattr(module, "STEPS", 1)
    x = descend(problem, np.array([0.05, 5.0]), np.array([False, True]), 1, Deadline())
    assert x == pytest.approx([0.05, ends], rel=1e-4)


@pytest.mark.parametrize("damping", [(0.0,), (1e3, 0.0)])
def test_a_slope_is_mended_by_what_each_step_showed(monkeypatch, damping):
    """On an arc tangent, five steps from one by the first slope alone would end a quarter away from its zero."""
    problem = bent(monkeypatch, damping)
    assert abs(descend(problem, np.array([1.0]), np.array([True]), 1, Deadline())[0]) < 1e-3


def test_a_step_solves_for_the_windows_that_are_asked_and_for_their_share_of_the_torques(monkeypatch):
    """By hand: (x - 1)², (x - 3)² of two windows and (x - 5)² of the torques, half of it for one window."""
    torques = SimpleNamespace(rows=lambda values: 5.0 * (values[:, 0] - 5.0)[None])  # 0.02 · 2 windows · 25 = 1
    problem, _ = following(monkeypatch, each_its_own(1.0, 3.0), nominal=(-1.0,), scale=0.5, torques=torques)
    near = linearise(problem, np.array([2.0]), np.array([True]))
    yes, no = np.array([True]), np.array([False])
    both, first = np.array([True, True]), np.array([True, False])
    assert near.step(both, no) == pytest.approx([3.0], rel=1e-4)
    assert near.step(first, no) == pytest.approx([(1 + 2.5) / 1.5], rel=1e-4)
    assert near.move(both, no) == pytest.approx([2.0], rel=1e-4)  # units of 0.5
    assert near.step(both, yes).tolist() == [-1.0]
    uneven = linearise(replace(problem, torques=None, weight=np.array([2.0, 6.0])), np.array([2.0]), yes)
    assert uneven.step(both, no) == pytest.approx([(1 + 3 * 3) / 4], rel=1e-4)
    assert uneven.step(both, no, 1.0) == pytest.approx([2.25], rel=1e-4)  # half of the way
    alone = linearise(replace(problem, torques=None), np.array([2.0]), yes)
    for high, ends in ((2.5, 2.5), (99.0, 3.0)):
        problem.hypothesis.bounds = (np.array([0.0]), np.array([high]))
        assert alone.step(~first, no) == pytest.approx([ends], rel=1e-4)


def both_at_once(w, build, values):
    """A simulation of the sum of two numbers, which nothing tells apart."""
    return values.sum(1)[:, None, None, None] * np.ones((*w.index.shape, 1))


def test_a_ridge_shortens_a_step_and_not_what_makes_up_for_a_number_that_is_held(monkeypatch):
    """Two numbers of which only the sum is seen, 2 at the solution: where the first goes, the second takes it all."""
    problem, _ = following(monkeypatch, each_its_own(1.0, 3.0), nominal=(0.0, 0.0))
    problem = replace(problem, unit=np.ones(1))
    monkeypatch.setattr(windows_module, "simulate", both_at_once)
    near = linearise(problem, np.array([2.0, 0.0]), np.array([True, True]))
    both, second, first = np.array([True, True]), np.array([False, True]), np.array([True, False])
    for ridge in (1e-6, 1.0, 1e9):
        assert near.step(both, first, ridge) == pytest.approx([0.0, 2.0], abs=1e-4)
    for ridge, sum_ in ((1e-6, 3.0), (1.0, 2 + 1 / 1.5), (1e9, 2.0)):  # two equal columns: half of the pull on each
        assert near.step(second, np.array([False, False]), ridge).sum() == pytest.approx(sum_, abs=1e-4)
        assert near.step(second, first, ridge) == pytest.approx([0.0, 2 + 1 / (1 + ridge)], abs=1e-4)


def with_a_limit(w, build, values):
    """A simulation of one number and another one of up to 3, beyond which it acts no more."""
    return (values[:, 0] + np.minimum(values[:, 1], 3.0))[:, None, None, None] * np.ones((*w.index.shape, 1))


def test_without_a_number_others_make_up_for_what_it_changes_and_not_for_its_slope(monkeypatch):
    """Their sum is 5 by 2.5 each; the second, given as a million, acts as 3, so that the first loses a half."""
    problem, _ = following(
        monkeypatch, each_its_own(5.0, 5.0), nominal=(0.0, 9.0, 1e6), low=-1e7, high=1e7
    )  # the second of three numbers is not free
    problem = replace(problem, unit=np.array([2.0]))
    monkeypatch.setattr(windows_module, "simulate", lambda w, build, x: with_a_limit(w, build, x[:, ::2]))
    near = linearise(problem, np.array([2.5, 8.0, 2.5]), np.array([True, False, True]))
    near, both = replace(near, damped=np.array([True, False])), np.array([True, True])
    fewer = near.without(np.array([False, True]))
    assert fewer.values.tolist() == [2.5, 8.0, 1e6]
    assert fewer.free.tolist() == [True, False, False]
    assert fewer.damped.tolist() == [True]
    assert fewer.columns.shape == (len(near.errors), 1)
    assert problem.squares(fewer.errors) == pytest.approx(np.full((2, 1), 0.25))
    assert fewer.step(both, np.array([False])) == pytest.approx([2.0, 8.0, 1e6], rel=1e-4)
    assert near.step(both, np.array([False, True]))[0] == pytest.approx(2.5 - 1e6, rel=1e-3)  # as its slope has it
    assert near.without(np.array([False, False])) is near


def test_where_slopes_are_right_a_fit_without_a_number_is_the_one_that_holds_it(monkeypatch):
    """Windows of unlike weights, and torques that tell of both numbers."""
    torques = SimpleNamespace(rows=lambda x: np.stack([3.0 * (x[:, 0] - 5.0), 2.0 * (x[:, 0] + x[:, 1] - 4.0)]))
    problem, _ = following(monkeypatch, each_its_own(1.0, 3.0), nominal=(0.5, -1.0), torques=torques)
    problem = replace(problem, unit=np.array([2.0]), weight=np.array([0.3, 1.0]))
    monkeypatch.setattr(windows_module, "simulate", both_at_once)
    near = linearise(problem, np.array([2.0, 0.5]), np.array([True, True]))
    both, one, second = np.array([True, True]), np.array([True, False]), np.array([False, True])
    for windows in (both, one):
        held = near.step(windows, second)
        assert held[1] == -1.0
        assert abs(held[0] - 2.0) > 0.1
        assert near.without(second).step(windows, np.array([False])) == pytest.approx(held, rel=1e-4)


def test_what_makes_up_for_a_held_number_stays_within_its_bounds_and_another_takes_the_rest(monkeypatch):
    """Of three numbers whose sum is 4 the first, 4, goes to nothing; the second may be 1 at most."""
    problem, _ = following(monkeypatch, each_its_own(4.0, 4.0), nominal=(0.0, 0.0, 0.0))
    problem = replace(problem, unit=np.ones(1))
    problem.hypothesis.bounds = (np.full(3, -99.0), np.array([99.0, 1.0, 99.0]))
    monkeypatch.setattr(windows_module, "simulate", both_at_once)
    near = linearise(problem, np.array([4.0, 0.0, 0.0]), np.array([True, True, True]))
    held, both = np.array([True, False, False]), np.array([True, True])
    for ridge in (1e-6, 1e9):
        assert near.step(both, held, ridge) == pytest.approx([0.0, 1.0, 3.0], abs=1e-3)


def test_a_ridge_holds_back_what_is_damped_alone(monkeypatch):
    problem, _ = following(monkeypatch, each_its_own(1.0, 3.0), nominal=(0.0, 0.0))
    problem = replace(problem, unit=np.ones(1))
    monkeypatch.setattr(windows_module, "simulate", both_at_once)
    near = linearise(problem, np.array([2.0, 0.0]), np.array([True, True]))
    near = replace(near, damped=np.array([True, False]))
    assert near.step(np.array([False, True]), np.array([False, False]), 1e9) == pytest.approx([2.0, 1.0], abs=1e-4)


def test_some_windows_of_a_problem_are_a_problem_of_them_with_their_share_of_the_torques(monkeypatch):
    torques = SimpleNamespace(rows=lambda values: 5.0 * (values[:, 0] - 5.0)[None])
    problem, _ = following(monkeypatch, each_its_own(1.0, 3.0, 8.0), torques=torques)
    near = replace(linearise(problem, np.array([2.0]), np.array([True])), ridges=(1.0, 2.0, 3.0, 4.0))
    chosen, no = np.array([True, False, True]), np.array([False])
    part = near.of_windows(chosen)
    assert part.ridges == near.ridges
    assert part.step(np.array([True, True]), no) == pytest.approx(near.step(chosen, no))
    again = linearise(part.problem, np.array([2.0]), np.array([True]))
    for name in ("errors", "columns", "pull", "pull_columns"):
        np.testing.assert_allclose(getattr(part, name), getattr(again, name), rtol=1e-12)
    alone = part.alone()
    assert (alone.problem.torques, alone.pull.size, alone.pull_columns.shape) == (None, 0, (0, 1))
    assert alone.step(np.array([True, True]), no) == pytest.approx([4.5], rel=1e-5)


@pytest.mark.parametrize("x", [0.0, 1.0])
def test_differences_are_taken_into_the_bounds(monkeypatch, x):
    problem, asked = following(monkeypatch, each_its_own(3.0, 3.0, length=1), nominal=(0.0, 0.0), low=0.0, high=1.0)
    near = linearise(problem, np.array([x, 0.5]), np.array([True, False]))
    assert 0.0 <= min(a.min() for a in asked) <= max(a.max() for a in asked) <= 1.0
    assert all((a[:, 1] == 0.5).all() for a in asked)
    np.testing.assert_allclose(near.columns, [[1.0], [0.0], [1.0], [0.0]], atol=1e-9)
    assert near.errors.tolist() == [x - 3.0, -2.5] * 2
    assert 0 < near.seconds < 60


def test_a_difference_is_a_hundredth_of_a_unit_up_as_long_as_its_own_bound_leaves_room(monkeypatch):
    problem, asked = following(monkeypatch, each_its_own(3.0, length=1), nominal=(0.0, 0.0), scale=0.5)
    problem.hypothesis.bounds = (np.zeros(2), np.array([9.0, 1.0]))
    for x, tried in ((0.992, 0.997), (0.996, 0.991)):
        linearise(problem, np.array([0.5, x]), np.array([False, True]))
        assert asked[-1][:, 1] == pytest.approx([x, tried])


def test_a_descent_ends_at_the_least_squares_or_at_the_bound_before_it_and_moves_only_what_may(monkeypatch):
    windows = Windows(take_like(9, truth=[1.0, -2.0]), np.array([0, 4]), 4)
    problem, _ = following(monkeypatch, windows, nominal=(0.0, 0.0), low=-1.5, high=9.0, scale=0.25)
    begin = np.array([7.0, 5.0])
    assert descend(problem, begin, np.array([True, True]), 3, Deadline()) == pytest.approx([1.0, -1.5], abs=1e-3)
    assert descend(problem, begin, np.array([True, False]), 3, Deadline()) == pytest.approx([1.0, 5.0], abs=1e-3)
    assert descend(problem, begin, np.array([False, False]), 3, Deadline()) is begin
    monkeypatch.setattr(module, "DAMPING", (10.0, 0.0))
    monkeypatch.setattr(module, "STEPS", 1)  # the longer of two
    assert descend(problem, begin, np.array([True, True]), 1, Deadline()) == pytest.approx([1.0, -1.5], abs=1e-3)


def bent(monkeypatch, damping, steps=5):
    """A problem whose error is the arc tangent of its only number, so that a whole step from 2 leads to -3.5."""
    problem, _ = following(monkeypatch, each_its_own(0.0, 0.0))
    wave = lambda w: w.take.wave[w.index][None, :, :, None]  # noqa: E731
    monkeypatch.setattr(windows_module, "simulate", lambda w, build, values: np.arctan(values)[:, None, None] * wave(w))
    monkeypatch.setattr(module, "DAMPING", damping)
    monkeypatch.setattr(module, "STEPS", steps)
    return problem


def test_a_step_that_would_go_too_far_is_damped_and_one_that_is_worse_is_not_taken(monkeypatch):
    free, begin = np.array([True]), np.array([2.0])
    assert descend(bent(monkeypatch, (0.0,)), begin, free, 1, Deadline()) == pytest.approx(begin)
    assert abs(descend(bent(monkeypatch, (0.0, 0.1, 1.0)), begin, free, 3, Deadline())[0]) < 0.1


def test_each_of_several_steps_by_one_slope_goes_on_with_what_the_last_one_learned(monkeypatch):
    """On a straight line the slope stays: damped by ten, each step goes an eleventh of the rest of the way."""
    problem, _ = following(monkeypatch, each_its_own(1.0, 1.0))
    monkeypatch.setattr(module, "DAMPING", (10.0,))
    free = np.array([True])
    x, saved = module._steps(problem, linearise(problem, np.array([12.0]), free), Deadline())
    assert x == pytest.approx([1 + 11 * (10 / 11) ** 5], rel=1e-4)
    assert saved == pytest.approx(1 - (10 / 11) ** 10, rel=1e-3)
    out_of_time, _ = module._steps(problem, linearise(problem, np.array([12.0]), free), Deadline(0.0))
    assert out_of_time == pytest.approx([11.0], rel=1e-4)
    monkeypatch.setattr(module, "DAMPING", (1e4,))  # which saves two parts of ten thousand
    assert module._steps(problem, linearise(problem, np.array([12.0]), free), Deadline())[0] == pytest.approx(
        [12 - 11e-4], abs=1e-5
    )


def test_a_descent_pays_for_contradicting_the_torques(monkeypatch):
    """(x - 1)², (x - 3)² of two windows and (x - 5)² of the torques."""
    torques = SimpleNamespace(rows=lambda values: 5.0 * (values[:, 0] - 5.0)[None])
    problem, _ = following(monkeypatch, each_its_own(1.0, 3.0), torques=torques)
    assert descend(problem, np.array([3.5]), np.array([True]), 2, Deadline()) == pytest.approx([3.0], abs=1e-3)


def test_a_number_is_shown_by_two_ten_thousandths_of_a_typical_error_a_window():
    curvature = 5 * 4e-8 * np.array([0.99, 1.01])
    assert module._hidden(curvature, 5).tolist() == [True, False]


@pytest.mark.parametrize("way", [1.0, -1.0])
def test_a_number_that_no_window_shows_stays_where_it_is(monkeypatch, way):
    """A nothing of a slope, by the difference of two windows, would carry it to its bound, past a stop at 5."""
    problem, _ = following(monkeypatch, each_its_own(1.0, 3.0), nominal=(0.0, 0.5))

    def simulate(w, build, values):
        side = way * np.where(w.index > 4, 1e-7, -1e-7)[None, :, :, None]
        x, hidden = values[:, :1, None, None], values[:, 1:, None, None]
        return (x + side * hidden + 50.0 * (np.abs(hidden) > 5.0)) * np.ones(2)

    monkeypatch.setattr(windows_module, "simulate", simulate)
    free = np.array([True, True])
    assert descend(problem, np.array([9.0, 0.0]), free, 3, Deadline()) == pytest.approx([2.0, 0.0], abs=1e-3)
    near = linearise(problem, np.array([2.0, 0.0]), free)
    assert near.step(np.array([True, False]), ~free) == pytest.approx([1.0, 0.0], abs=1e-3)
    home = near.step(np.array([True, False]), np.array([False, True]))
    assert home[1] == pytest.approx(0.5)  # what is held is the given model's, shown or not


def test_a_descent_goes_on_from_where_it_is_as_long_as_it_pays(monkeypatch):
    """Its first slope may be given; each other one is taken where the last one ended."""
    monkeypatch.setattr(module, "linearise_roughly", lambda problem, x, free: SimpleNamespace(seconds=0.0, values=x))
    saved = iter([0.5, 0.002, 0.0005, 0.5])
    monkeypatch.setattr(module, "_steps", lambda problem, near, deadline: (near.values + 1, next(saved)))
    given = SimpleNamespace(seconds=0.0, values=np.array([10.0]))
    free = np.array([True])
    assert descend(None, np.zeros(1), free, 2, Deadline(), given).tolist() == [12.0]
    assert descend(None, np.zeros(1), free, 5, Deadline()).tolist() == [1.0]  # 0.05 % is not worth a slope
    slow = SimpleNamespace(seconds=100.0, values=np.array([10.0]))
    assert descend(None, np.zeros(1), free, 5, Deadline(120.0), slow).tolist() == [11.0]


@pytest.mark.parametrize("side", [1.0, -1.0])
def test_what_is_held_goes_to_the_given_models_number(side):
    h = SimpleNamespace(
        scale=np.array([0.5, 0.1]), nominal=np.array([3.0 - side, 1.0]), bounds=(np.full(2, -9.0), np.full(2, 9.0))
    )
    problem = SimpleNamespace(hypothesis=h, row_weight=np.ones(3), first=np.array([0]))
    columns = np.array([[1.0, 0.0], [0.0, 1.0], [1.0, 1.0]])
    near = Linearised(
        problem, np.array([3.0, 1.0]), np.ones(2, dtype=bool), np.zeros(3), columns, np.zeros(1), np.zeros((1, 2))
    )
    one = np.ones(1, dtype=bool)
    assert near.move(one, np.array([True, True])) == pytest.approx([-2.0 * side, 0.0])
    other = near.move(one, np.array([True, False]))
    assert other == pytest.approx([-2.0 * side, 1.0 * side], rel=1e-4)  # which makes up for it
    assert near.step(one, np.array([True, True])) == pytest.approx([3.0 - side, 1.0])
