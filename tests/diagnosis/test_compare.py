"""Scores: a perfect model scores its floor, and the floor is what noise alone does."""

import numpy as np
import pytest
from diagnosis.plants import candidate, pendulum, record, smooth_torque, take

from torchrl_athletic.diagnosis.compare import harms, noise_floor, open_share, score, started
from torchrl_athletic.diagnosis.fit import Hypothesis
from torchrl_athletic.diagnosis.replay import join, simulate, windows_of
from torchrl_athletic.diagnosis.result import Score
from torchrl_athletic.effects import ViscousFriction

FINE = pendulum(step=0.001)  # the integrator's own error is far below the noise
NOISE = 2e-4


def recording(xml=FINE, seconds=6.0, seed=0):
    return record(xml, smooth_torque(seconds, 0.5, seed=seed), noise=NOISE, seed=seed)


def test_the_floor_is_the_mean_over_many_noisy_starts_and_readings():
    t = take(FINE, recording(seconds=5.0), NOISE)
    w, nothing = windows_of(t, 0.5), Hypothesis(())
    ideal = simulate(w, nothing.build, np.zeros((1, 0)))[0]
    rng = np.random.default_rng(1)
    square = []
    for _ in range(60):
        q = t.position[w.start] + t.start_noise[0, w.start] * rng.standard_normal((len(w.start), 1))
        v = t.velocity[w.start] + t.start_noise[1, w.start] * rng.standard_normal((len(w.start), 1))
        reading = ideal + NOISE * rng.standard_normal(ideal.shape)
        square.append(((simulate(w, nothing.build, np.zeros((1, 0)), start=(q, v))[0] - reading) ** 2).mean())
    floors = [
        noise_floor([w], nothing, np.zeros(0), [ideal], np.array([NOISE]), np.random.default_rng(s))[0]
        for s in range(6)
    ]
    assert np.mean(floors) == pytest.approx(np.sqrt(np.mean(square)), rel=0.15)
    assert np.mean(floors) > 1.2 * NOISE  # readings alone are not all of it


def test_a_perfect_model_scores_its_floor():
    square, floors = [], []
    for seed in range(3):
        t = take(FINE, recording(seed=seed), NOISE)
        total, before, after, _ = score([t], Hypothesis(()), np.zeros(0), np.array([NOISE]), np.random.default_rng(0))
        assert total.before == total.after
        np.testing.assert_array_equal(before, after)
        assert after.shape == (11, 1)
        square.append((after[1:] ** 2).mean())  # the first window starts from the end of a fit, which is worse
        floors.append(total.floor)
    assert 0.7 < np.sqrt(np.mean(square)) / np.mean(floors) < 1.7


def scored(damping: float, repeatability=None) -> Score:
    r = recording(pendulum(step=0.001, joint='damping="0.2"'))
    h = Hypothesis((candidate(ViscousFriction(), r, FINE),))
    total, *_ = score(
        [take(FINE, r, NOISE)], h, np.array([damping]), np.array([NOISE]), np.random.default_rng(0), repeatability
    )
    return total


def test_the_share_closed_is_what_lies_between_before_and_the_floor():
    for damping in (0.2, 0.15, 0.05, 0.01):
        s = scored(damping)
        assert s.share_closed == pytest.approx(np.clip((s.before - s.after) / (s.before - s.floor), -1, 1))
    assert scored(0.2).share_closed == pytest.approx(1.0, abs=0.05)
    assert scored(0.05).share_closed == 0.0  # nothing was changed
    assert scored(0.01).share_closed < 0.0  # worse than before
    assert 0.0 < scored(0.1).share_closed < 1.0


def test_the_given_model_is_what_was_before():
    assert scored(0.2).before == scored(0.1).before > 5 * scored(0.2).after
    assert scored(0.05).after == scored(0.05).before


def test_repeats_that_scatter_more_than_the_sensors_raise_the_floor():
    quiet = scored(0.2)
    assert scored(0.2, repeatability=np.array([2 * quiet.floor])).floor == pytest.approx(2 * quiet.floor)
    assert scored(0.2, repeatability=np.array([0.5 * quiet.floor])).floor == quiet.floor
    assert scored(0.2, repeatability=np.array([1.0])).share_closed == 0.0  # no gap that repeats would not show too


def of(**joints: tuple[float, float, float]) -> Score:
    rows = {name: dict(zip(("before", "after", "floor"), x, strict=True)) for name, x in joints.items()}
    return Score(1.0, 1.0, 1.0, 0.0, rows)


def test_the_open_share_is_energy_above_the_floor_that_is_left():
    assert open_share(of(a=(5.0, 3.0, 3.0))) == 0.0
    assert open_share(of(a=(5.0, 4.0, 3.0))) == pytest.approx((16 - 9) / (25 - 9))
    assert open_share(of(a=(5.0, 9.0, 3.0))) == 1.0
    assert open_share(of(a=(5.0, 5.0, 1.0), b=(5.0, 1.0, 1.0))) == pytest.approx(0.5)
    assert open_share(of(a=(1.05, 1.05, 1.0), b=(100.0, 1.0, 1.0))) < 0.01  # a joint at its floor has no say
    assert open_share(of(a=(1.0, 100.0, 1.0), b=(2.0, 1.0, 1.0))) == 1.0  # one that the correction ruins has
    assert open_share(of(a=(1.0, 1.0, 1.0))) == 0.0


def test_a_correction_that_makes_the_fitted_takes_worse_is_none():
    better, worse = (Score(1.0, after, 0.1, 0.0, {}) for after in (0.9, 1.1))
    assert harms(worse)
    assert not harms(better)
    assert not harms(None)


def test_windows_of_several_pieces_start_one_after_the_other_and_far_apart():
    whole = record(pendulum(), smooth_torque(4.0), noise=NOISE)
    ends = (0, 160), (0, 160), (200, 400)
    first, *pieces = (take(pendulum(), whole.slice(*e), NOISE, period=0.01) for e in ends)
    joined = join(pieces)
    assert len(joined) == 1  # one batch, two pieces
    windows = [windows_of(t, 0.5) for t in (first, *joined)]
    began = started(windows)
    assert len(began) == sum(len(w.start) for w in windows)
    steps = np.diff(began)
    assert (steps > 0).all()
    assert (steps > 30.0).sum() == 2
    np.testing.assert_allclose(steps[steps < 30.0], 0.5, atol=0.02)


@pytest.mark.parametrize(("after", "share"), [(1.0, 0.0), (1.3, 0.0), (2.0, 1.0)])
def test_of_a_given_model_at_its_floor_all_is_open_once_a_correction_is_clearly_above_it(after, share):
    """An energy as large as the floor's, beyond the floor."""
    at_floor = Score(1.0, after, 1.0, 0.0, {"elbow": {"before": 1.0, "after": after, "floor": 1.0}})
    assert open_share(at_floor) == share
