"""Windows to follow: what an error in each weighs, and which of them tell of which."""

import sys
from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest

from torchrl_athletic.diagnosis.problem import Problem, folds_of, in_units, part_of, problem_of, window_cost
from torchrl_athletic.diagnosis.replay import Windows

module = sys.modules["torchrl_athletic.diagnosis.problem"]


def take_like(samples, begins=(0,), period=0.005, truth=1.0):
    """A take of one joint or more, each of which follows its own number times a wave."""
    wave = np.ones(samples)
    time = period * np.arange(samples)
    return SimpleNamespace(
        time=time, begins=np.array(begins), period=period, wave=wave, address=None,
        parts=[SimpleNamespace(time=part) for part in np.split(time, begins[1:])],
        measured=wave[:, None] * np.atleast_2d(truth),
    )  # fmt: skip


def following(monkeypatch, *windows, nominal=(0.0,), low=-99.0, high=99.0, scale=1.0, torques=None):
    """A problem whose simulation is a number of each joint times the take's wave, with the values that it was asked."""
    asked = []

    def simulate(w, build, values):
        asked.append(values.copy())
        return values[:, None, None, :] * w.take.wave[w.index][None, :, :, None]

    monkeypatch.setattr(module, "simulate", simulate)
    ones = np.ones(len(nominal))
    h = SimpleNamespace(
        terms=tuple(
            SimpleNamespace(effect=SimpleNamespace(name=""), joint=j, parameters=(None,)) for j in range(len(ones))
        ), build=None,
        nominal=np.array(nominal, dtype=float), scale=scale * ones, bounds=(low * ones, high * ones),
    )  # fmt: skip
    count = sum(len(w.start) for w in windows)
    return Problem(h, windows, ones, np.ones(count), torques=torques), asked


def each_its_own(*truths, length=4):
    """Windows back to back, each of which was made by another number."""
    t = take_like(len(truths) * length + 1)
    t.measured[1:, 0] = np.repeat(truths, length)
    return Windows(t, length * np.arange(len(truths)), length)


@pytest.mark.parametrize("at_once", [1, 200])
def test_errors_are_those_of_the_thinned_samples_window_by_window(monkeypatch, at_once):
    """By hand, on a wave of 0, 1, 2...: every sample of 5 ms, and each fifth of 1 ms."""
    monkeypatch.setattr(module, "AT_ONCE", at_once)
    slow, fast = take_like(7, truth=[0.0, 0.0]), take_like(11, period=0.001, truth=[0.0, 0.0])
    slow.wave, fast.wave = np.arange(7.0), np.arange(11.0)
    problem, _ = following(monkeypatch, Windows(slow, np.array([0, 3]), 3), Windows(fast, np.array([0]), 10),
                           nominal=(0.0, 0.0))  # fmt: skip
    x = np.array([[1.0, 2.0], [3.0, 0.0]])
    square = np.array([14 / 3, 77 / 3, (25 + 100) / 2])  # of 1, 2, 3; of 4, 5, 6; of 5 and 10
    np.testing.assert_allclose(problem.mean_square(x), square[None, :, None] * np.array([[[1, 4]], [[9, 0]]]))
    errors = problem.errors(x)
    assert problem.window.tolist() == [0] * 6 + [1] * 6 + [2] * 4
    assert errors.shape == (16, 2)
    assert errors[:4, 0] * np.sqrt(3) == pytest.approx([1, 2, 2, 4])  # joints side by side
    np.testing.assert_allclose(problem.squares(errors[:, 1]), np.outer(square, [9, 0]))
    told = replace(problem, weight=np.array([1.0, 4.0, 9.0]), unit=np.array([2.0, 10.0])).row_weight
    assert told == pytest.approx([0.5, 0.1] * 3 + [1.0, 0.2] * 3 + [1.5, 0.3] * 2)


@pytest.mark.parametrize("length", range(5, 12))
def test_rows_are_counted_as_they_are_made_whatever_a_windows_length(monkeypatch, length):
    problem, _ = following(monkeypatch, Windows(take_like(30, period=0.001), np.array([0, 9]), length))
    assert problem.window.tolist() == sorted([0, 1] * (length // 5))
    assert len(problem.errors(np.ones((1, 1)))) == len(problem.window) == len(problem.row_weight)


def test_of_a_slow_log_every_sample_is_compared(monkeypatch):
    problem, _ = following(monkeypatch, Windows(take_like(30, period=0.02), np.array([0, 9]), 5))
    assert len(problem.errors(np.ones((1, 1)))) == len(problem.window) == 10


def test_a_window_weighs_less_the_more_typical_errors_it_is_off_and_in_plain_least_squares_as_any_other():
    square = np.array([[1.0, 4.0], [9.0, 4.0], [2.0, 4.0], [500.0, 160.0]])
    problem = moving(99.0, np.ones(2), np.ones(4))
    robust = in_units(problem, square)
    assert robust.unit == pytest.approx([2, 2])  # means of the best three of four: 4
    ratio = np.array([0.625, 1.625, 0.75, 82.5])
    assert robust.weight == pytest.approx(1 / (1 + ratio / 9))
    assert window_cost(robust, square[None])[0] == pytest.approx(9 * np.log(1 + ratio / 9))
    plain = in_units(replace(problem, tuning=np.inf), square)
    assert plain.unit**2 == pytest.approx([128, 43])
    assert plain.weight.tolist() == [1, 1, 1, 1]
    assert window_cost(plain, square[None])[0, 0] == pytest.approx((1 / 128 + 4 / 43) / 2)
    assert in_units(moving(99.0, np.ones(2), np.ones(4), pooled=True), square).unit ** 2 == pytest.approx([4, 4])
    pooled = in_units(replace(problem, tuning=np.inf, pooled=True), square)
    assert pooled.unit**2 == pytest.approx([85.5, 85.5])


def moving(distance, unit, weight, **told):
    """A problem without windows, in each of which a joint moves by ``distance``."""
    problem = Problem(told.pop("h", None), (), unit, weight, **told)
    problem.__dict__["motion"] = np.full((len(weight), len(unit)), distance**2)
    return problem


def test_a_typical_error_is_that_of_the_three_quarters_that_are_followed_best():
    """Of twelve windows half hold still; a median would be 4.5."""
    square = np.array([0.0, 9.0, 0.0, 1e9, 0.0, 9.0, 0.0, 0.0, 1e9, 9.0, 0.0, 1e9])[:, None]
    problem = moving(1e9, np.ones(1), np.ones(12))
    assert module.typical(problem, square) == pytest.approx([27 / 9])
    assert module.typical(problem, np.stack([square, 2 * square])) == pytest.approx(np.array([[3.0], [6.0]]))
    assert module.typical(moving(9.0, np.ones(1), np.ones(2)), square[:2]) == [4.5]  # of two, neither is left out


def test_of_a_joint_the_windows_tell_in_which_it_moves():
    """A gripper that moves in four windows of twenty, and an arm that does in all; neither is followed in the last."""
    problem = moving(3.0, np.ones(2), np.ones(20))
    problem.motion[4:, 0] = 1e-6
    square = np.full((20, 2), 0.01)
    square[:4, 0], square[3, 0] = 4.0, 8.0
    assert module.typical(problem, square) == pytest.approx([4.0, 0.01])
    problem.motion[4:, 0] = 9.0
    assert module.typical(problem, square) == pytest.approx([0.01, 0.01])


def test_a_joint_that_stands_still_has_the_scale_of_its_own_error():
    """A model that sags while the robot holds still is off by much more than the motion, which is none."""
    assert in_units(moving(0.0, np.ones(1), np.ones(8)), np.full((8, 1), 0.04)).unit == pytest.approx([0.2])


@pytest.mark.parametrize("wild", [4, 7, 10])
def test_windows_that_go_astray_set_no_scale_up_to_half_of_them_and_however_far(wild):
    """Of 24, which move by 2: those that are followed to 0.1 weigh nearly one, the wild ones nothing."""
    square = np.full((24, 1), 0.01)
    square[:wild] = 1e8
    for size in (1e2, 1e8):
        square[:wild] = size
        found = in_units(moving(2.0, np.ones(1), np.ones(24)), square)
        assert found.unit[0] <= 2.0
        assert (found.weight[wild:] > 0.4).all()
        assert (found.weight[:wild] < 0.3).all()


def test_a_motion_is_counted_from_where_its_window_begins(monkeypatch):
    take = take_like(5)
    take.measured = np.array([0.0, 1.0, 1.0, 3.0, 5.0])[:, None]
    problem, _ = following(monkeypatch, Windows(take, np.array([0, 2]), 2))
    assert problem.motion == pytest.approx(np.array([[1.0], [(4 + 16) / 2]]))


def test_windows_that_overlap_count_once():
    apart = Windows(take_like(80), np.array([0, 10, 20, 35]), 10)
    denser = Windows(take_like(80), np.array([13, 0, 3, 5, 10, 20, 35]), 10)
    shifted = Windows(take_like(80), np.array([2, 9, 12, 19, 22]), 10)  # 2, 12 and 22, by tens 0, 10, 20 too
    for windows, count in (((apart,), 4), ((denser,), 4), ((shifted,), 3), ((apart, denser), 8)):
        assert module.independent(Problem(None, windows, np.ones(1), np.ones(1))) == count


def test_a_sample_is_told_by_as_many_windows_as_see_it():
    apart, denser = (Windows(take_like(80), np.array(at), 10) for at in ([0, 10, 20, 35], [0, 0, 0, 40]))
    half = Windows(take_like(80), np.array([0, 5]), 10)  # five of each ten are seen twice
    for windows, count in (((apart,), 1.0), ((denser,), (3 * 3 + 1) / 4), ((half,), 1.5), ((apart, half), 7 / 6)):
        assert module.tellings(Problem(None, windows, np.ones(1), np.ones(1))) == pytest.approx(count)


def test_windows_that_overlap_lie_evenly_within_their_own_recordings_where_starts_are_known():
    take = take_like(60, (0, 40))
    take.start_noise = np.ones((2, 60, 1))
    w = Windows(take, np.array([0, 10, 20, 40]), 10)
    even = module._overlapping(w, 16)
    assert set(even.start) <= {*range(30), *range(40, 50)}  # 30 + 10 is the next recording's first
    assert len(even.start) == 16
    assert np.diff(even.start[even.start < 40]).max() == 3
    assert module._overlapping(w, 400).start.tolist() == [*range(30), *range(40, 50)]  # none is there twice
    take.start_noise[1, :5] = 3.0
    assert module._overlapping(w, 400).start.tolist() == [*range(5, 30), *range(40, 50)]
    take.start_noise[0, :20] = 9.0
    assert module._overlapping(w, 3).start.tolist() == [20, 29, 49]
    alone = take_like(60)
    alone.start_noise = np.where(np.arange(60)[:, None] < 20, 9.0, np.ones((2, 60, 1)))  # at all places
    assert module._overlapping(Windows(alone, np.array([0]), 40), 3).start.tolist() == [0, 9, 19]


def test_windows_overlap_where_logs_hold_less_than_half_of_what_is_enough(monkeypatch):
    monkeypatch.setattr(module, "WINDOW", 0.05)
    started = []
    monkeypatch.setattr(module, "well_started", lambda w: started.append(w) or replace(w, start=w.start + 1))
    problem, _ = following(monkeypatch)
    long, short = take_like(412), take_like(52)
    for take in (long, short):
        take.address = SimpleNamespace(dof=[0])
        take.start_noise = np.ones((2, len(take.time), 1))
    for seconds, most, count, overlap in (
        (0.05, 400, 100, True),  # 41 back to back, and 5
        (0.05, 92, 46, False),
        (0.05, 46, 46, False),
        (0.05, 20, 20, False),  # drawn of them
        (0.1, 400, 22, False),
    ):
        args = problem.hypothesis, [long, short], seconds, most, np.random.default_rng(0), np.zeros(1)
        found = problem_of(*args, "torques")
        assert len(found.weight) == count
        assert found.torques == "torques"
        assert len(started) == (0 if overlap else 2)
        started.clear()
        length = found.windows[0].length
        assert all((w.start % length == 1).all() for w in found.windows) is not overlap
        if overlap:
            assert [len(w.start) for w in found.windows] == [89, 11]  # in proportion to those back to back
    assert problem_of(*args).weight.max() < 1.0
    assert problem_of(*args, tuning=np.inf).weight.tolist() == 22 * [1.0]


def test_folds_are_whole_recordings_as_even_as_can_be_and_of_few_recordings_stretches_of_time():
    one = Windows(take_like(40, (0, 10, 20)), np.array([0, 1, 2, 3, 4, 5, 10, 11, 12, 20]), 3)
    two = Windows(take_like(20, (0, 10)), np.array([0, 1, 10, 11, 12]), 3)
    fold = folds_of(SimpleNamespace(windows=(one, two)))
    recording = np.repeat(np.arange(5), [6, 3, 1, 2, 3])
    assert all(len(set(fold[recording == k])) == 1 for k in range(5))
    assert sorted(np.bincount(fold)) == [3, 3, 3, 6]
    four = Windows(take_like(40, (0, 10, 20, 30)), np.array([0, 1, 2, 3, 4, 10, 20, 30]), 3)
    assert sorted(np.bincount(folds_of(SimpleNamespace(windows=(four,))))) == [1, 1, 1, 5]
    alone = Windows(take_like(90), np.array([40, 0, 10, 20, 30, 50, 60, 70]), 3)
    assert folds_of(SimpleNamespace(windows=(alone,))).tolist() == [2, 0, 0, 1, 1, 2, 3, 3]
    halves = tuple(Windows(take_like(50), np.array([30, 0, 10, 20]), 3) for _ in range(2))
    assert folds_of(SimpleNamespace(windows=halves)).tolist() == [1, 0, 0, 1, 3, 2, 2, 3]


def test_a_part_of_a_problem_is_its_windows_with_their_weights(monkeypatch):
    first, gone, last = each_its_own(1.0, 2.0), each_its_own(3.0), each_its_own(4.0, 5.0, 6.0)
    whole, _ = following(monkeypatch, first, gone, last)
    chosen = np.array([False, True, False, True, False, True])
    part = part_of(replace(whole, weight=np.arange(6.0)), chosen)
    assert len(part.windows) == 2
    assert part.weight.tolist() == [1, 3, 5]
    np.testing.assert_array_equal(part.mean_square(np.zeros((1, 1)))[0, :, 0], [4, 16, 36])
