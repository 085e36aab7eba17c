"""Scores: a perfect model scores its floor, and the floor is what noise alone does."""

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
from diagnosis.plants import candidate, pendulum, record, smooth_torque, take

from torchrl_athletic.diagnosis import compare
from torchrl_athletic.diagnosis.compare import (
    _within_reach,
    far_joints,
    follows,
    harms,
    noise_floor,
    open_share,
    score,
    started,
    uncorrected,
    well_started,
)
from torchrl_athletic.diagnosis.fit import Hypothesis
from torchrl_athletic.diagnosis.replay import Windows, join, simulate, windows_of
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
    assert open_share(of(a=(0.1, 0.1, 1.0), b=(2.0, 1.5, 1.0))) == pytest.approx((1.5**2 - 1) / (2.0**2 - 1))
    assert open_share(of(a=(1.0, 1.0, 1.0))) == 0.0


def test_a_window_in_which_a_model_falls_errs_by_a_radian_or_its_motion_and_not_by_how_far_it_fell():
    """One of three falls by 200 rad; the joint moves by 4 rad in the last, whose ten samples count as five do twice."""
    t = made_up()
    t.measured[100] = -4.0, 0.0
    windows = [Windows(t, np.array([0, 40]), 5), Windows(t, np.array([100]), 10)]
    each = np.array([[200.0, 0.5], [0.3, 0.5], [200.0, 0.5]])
    fallen, calm = _within_reach(windows, each)
    assert fallen == pytest.approx(np.sqrt((1.0 + 0.3**2 + 2 * 16.0) / 4))
    assert calm == pytest.approx(0.5)


def test_shares_are_of_errors_within_reach_on_either_side():
    """A wrist without friction spins by 200 rad: of that 0.5 rad would be next to nothing, and nobody would use it."""
    score = of(wrist=(200.0, 0.5, 0.01), thumb=(0.2, 0.1, 0.01))
    score.per_joint["wrist"].update(before_within_reach=1.0, after_within_reach=0.5)
    was, left = (np.sum([(e / 0.01) ** 2 - 1 for e in errors]) for errors in ((1.0, 0.2), (0.5, 0.1)))
    assert open_share(score) == pytest.approx(left / was)
    assert far_joints([score]) == {"wrist", "thumb"}
    score.per_joint["wrist"].update(after=150.0, after_within_reach=1.0)
    assert open_share(score) == pytest.approx(((1 / 0.01) ** 2 - 1 + (0.1 / 0.01) ** 2 - 1) / was)
    again = uncorrected(score).per_joint["wrist"]
    assert (again["after"], again["after_within_reach"]) == (200.0, 1.0)


def test_a_correction_that_makes_the_fitted_takes_worse_is_none():
    better, worse = (Score(1.0, after, 0.1, 0.0, {}) for after in (0.9, 1.1))
    assert harms(worse)
    assert not harms(better)
    assert not harms(None)


def test_a_model_that_nothing_corrects_closes_nothing_at_any_joint():
    found = uncorrected(replace(of(a=(5.0, 4.0, 1.0), b=(3.0, 9.0, 2.0)), after=0.5, share_closed=0.7))
    assert (found.before, found.after, found.floor, found.share_closed) == (1.0, 1.0, 1.0, 0.0)
    assert {name: tuple(e.values()) for name, e in found.per_joint.items()} == {"a": (5, 5, 1), "b": (3, 3, 2)}


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


@pytest.mark.parametrize(("after", "share"), [(1.0, 0.0), (1.3, 0.0), (1.5, 1.0), (2.0, 1.0)])
def test_of_a_given_model_at_its_floor_all_is_open_once_a_correction_is_clearly_above_it(after, share):
    """An energy as large as the floor's, beyond the floor."""
    at_floor = Score(1.0, after, 1.0, 0.0, {"elbow": {"before": 1.0, "after": after, "floor": 1.0}})
    assert open_share(at_floor) == share


def test_a_correction_that_changes_nothing_harms_nothing():
    assert not harms(Score(1.0, 1.0, 0.1, 0.0, {}))


@pytest.mark.parametrize(
    ("before", "after", "far"),
    [(99.0, 8.5, False), (99.0, 11.0, True), (50.0, 8.5, True), (50.0, 7.5, False)],  # a tenth, and eight floors
)
@pytest.mark.parametrize("unit", [1.0, 0.01])
def test_a_joint_is_far_that_is_neither_near_its_floor_nor_at_a_tenth_of_its_error(before, after, far, unit):
    near = {"knee": {"before": 9.0, "after": 1.0, "floor": 1.0}}
    hip = {"before": before * unit, "after": after * unit, "floor": unit}
    scores = [Score(1, 1, 1, 0, near), Score(1, 1, 1, 0, {"hip": hip})]
    assert far_joints(scores) == ({"hip"} if far else set())


def test_a_correction_follows_where_every_joint_does():
    assert follows(of(a=(9.0, 2.0, 1.0), b=(9.0, 0.2, 0.1)), 2.0)
    assert not follows(of(a=(9.0, 2.1, 1.0), b=(9.0, 0.1, 0.1)), 2.0)
    assert not follows(of(a=(9.0, 2.0, 1.0), b=(9.0, 0.3, 0.1)), 2.0)


# --- windows and their errors, of a take that is made up ---


def made_up(samples: int = 200, begins: tuple[int, ...] = (0, 100), command: np.ndarray | None = None, **given):
    """Two joints at 100 Hz, cut into pieces; quiet unless something is given."""
    ends = (*begins[1:], samples)
    told = {
        "time": 0.01 * np.arange(samples),
        "begins": np.array(begins),
        "period": 0.01,
        "substeps": 1,
        "commands": lambda delay: np.zeros((samples, 2)) if command is None else command,
        "start_noise": np.ones((2, samples, 2)),
        "position": np.zeros((samples, 2)),
        "velocity": np.zeros((samples, 2)),
        "measured": np.zeros((samples, 2)),
        "recording": SimpleNamespace(joint_names=("hip", "knee")),
        "parts": [
            SimpleNamespace(recording=SimpleNamespace(duration=0.01 * (end - first)))
            for first, end in zip(begins, ends, strict=True)
        ],
    }
    return SimpleNamespace(**told | given)


def noisy_at(*samples: int) -> np.ndarray:
    """Noise of the second joint's velocity, beside that of positions, which is larger and the same everywhere."""
    noise = np.full((2, 200, 2), 100.0)
    noise[1, :, 1] = 0.1
    noise[1, list(samples), 1] = 0.2
    return noise


@pytest.mark.parametrize(
    ("start", "loud", "noisy", "expected"),
    [
        (50, (55,), (), 40),  # by a quarter of its length at most, away from the step
        (50, (42,), (), 47),
        (50, (55,), range(40, 46), 46),  # but not where the start is known badly
        (50, (), range(40, 45), 45),
        (100, (), (), 100),  # not into the piece before
        (55, range(40, 58), (), 59),  # nor with its end into the piece after: that starts at 100
        (155, (), (), 145),
    ],
)
def test_a_window_moves_to_where_its_start_is_known_best_and_its_command_is_quiet(
    start, loud, noisy, expected, monkeypatch
):
    monkeypatch.setattr(compare, "kernel_for", lambda recordings: 0.01)
    command = np.zeros((200, 2))
    command[:, 1] = np.cumsum(np.isin(np.arange(200), list(loud)))
    t = made_up(command=command, start_noise=noisy_at(*noisy))
    (found,) = well_started(Windows(t, np.array([start]), 40)).start
    assert found == expected


@pytest.mark.parametrize(("kernel", "quiet"), [(0.0005, 46), (0.03, 54)])
def test_a_step_of_either_joint_either_way_is_loud_for_its_size_and_as_long_as_the_fit_is_wide(
    kernel, quiet, monkeypatch
):
    """The knee's command steps down by one at 42, while the hip's, in another unit, rises to a thousand."""
    monkeypatch.setattr(compare, "kernel_for", lambda recordings: kernel)
    command = np.stack([np.linspace(0, 1000, 400), -1.0 * (np.arange(400) >= 84)], -1)  # two physics steps a sample
    t = made_up(substeps=2, commands=lambda delay: command)
    (found,) = well_started(Windows(t, np.array([50]), 40)).start
    assert quiet <= found <= 60


def test_one_start_that_is_known_very_badly_makes_no_other_one_good(monkeypatch):
    """Half of the starts are twice as noisy as the rest, which is loud: the rest it is, unless it is the mean."""
    monkeypatch.setattr(compare, "kernel_for", lambda recordings: 0.01)
    noise = noisy_at(*range(51, 60))
    noise[1, 60, 1] = 50.0
    command = np.zeros((200, 2))
    command[:, 1] = np.cumsum(np.isin(np.arange(200), range(38, 52)))
    t = made_up(command=command, start_noise=noise)
    (found,) = well_started(Windows(t, np.array([50]), 40)).start
    assert found <= 50


def test_windows_that_meet_are_one(monkeypatch):
    monkeypatch.setattr(compare, "kernel_for", lambda recordings: 0.01)
    t = made_up(start_noise=noisy_at(*range(35, 45)))
    assert well_started(Windows(t, np.array([50, 51, 52]), 40)).start.tolist() == [45]


def test_pieces_start_a_minute_after_the_end_of_the_one_before():
    one, two = made_up(time=7.0 + 0.01 * np.arange(200)), made_up()
    began = started([Windows(one, np.array([0, 50, 100, 120]), 10), Windows(two, np.array([10, 110]), 10)])
    np.testing.assert_allclose(began, [0.0, 0.5, 61.0, 61.2, 122.1, 183.1])
    uneven = made_up(begins=(0, 150))  # of a second and a half, and of half a second
    began = started([Windows(uneven, np.array([0, 150]), 10), Windows(two, np.array([0]), 10)])
    np.testing.assert_allclose(began, [0.0, 61.5, 122.0])


def test_the_floor_is_of_noisy_starts_readings_and_twice_the_step_of_each_joint(monkeypatch):
    """Draws are all of two deviations."""
    noise = np.zeros((2, 200, 2))
    noise[0, :, 0], noise[1, :, 1] = 3.0, 4.0

    def replayed(windows, build, values, start=None):
        out = np.zeros((1, len(windows.start), windows.length, 2))
        if start is not None:
            out += np.abs(np.stack([start[0][:, 0] - 10.0, start[1][:, 1] - 20.0], -1))[None, :, None]
        return out + {"halved": 0.5, "misread": 1.0}[windows.take]

    class Draws:
        standard_normal = staticmethod(lambda shape: np.full(shape, 2.0))

    t = made_up(
        start_noise=noise, position=np.full((200, 2), 10.0), velocity=np.full((200, 2), 20.0), halved=lambda: "halved"
    )
    t.misread = lambda rng: "misread"
    monkeypatch.setattr(compare, "simulate", replayed)
    monkeypatch.setattr(compare, "replace", lambda windows, take: Windows(take, windows.start, windows.length))
    windows = [Windows(t, np.arange(10), 5)]
    floor = noise_floor(windows, Hypothesis(()), np.zeros(0), [np.zeros((10, 5, 2))], np.array([1.0, 2.0]), Draws())
    np.testing.assert_allclose(floor, np.sqrt([(6 + 1) ** 2 + 4 * 0.25 + 1, (8 + 1) ** 2 + 4 * 0.25 + 4]))


def test_a_score_is_the_root_of_the_joints_mean_square_and_of_the_given_and_the_corrected_numbers(monkeypatch):
    t = made_up()
    t.measured[[0, 40]] = -0.5, 2.5  # from there the joints move to zero
    windows = [Windows(t, np.array([0, 40]), 10)]
    monkeypatch.setattr(compare, "draw_windows", lambda takes, seconds, most, rng: windows if seconds == 0.5 else [])
    monkeypatch.setattr(compare, "well_started", lambda w: w)
    monkeypatch.setattr(
        compare, "simulate", lambda w, build, sets: sets[:, None, None, :] * np.ones((1, 2, 10, 1))
    )  # a parameter is an error of its joint
    told = []
    monkeypatch.setattr(compare, "noise_floor", lambda *given: told.append(given[3]) or np.array([0.1, 0.7]))
    h = SimpleNamespace(nominal=np.array([3.0, 4.0]), build=None)
    rng = np.random.default_rng(0)
    found, before, after, _ = score([t], h, np.array([1.0, 2.0]), np.ones(2), rng, np.array([0.2, 0.3]))
    assert found.per_joint["hip"] == pytest.approx({
        "before": 3.0, "after": 1.0, "floor": 0.2, "before_within_reach": 1.0, "after_within_reach": 1.0,
    })  # fmt: skip
    assert found.per_joint["knee"] == pytest.approx({
        "before": 4.0, "after": 2.0, "floor": 0.7, "before_within_reach": 2.5, "after_within_reach": 2.0,
    })  # fmt: skip
    was, left, least = np.sqrt([12.5, 2.5, (0.04 + 0.49) / 2])
    assert (found.before, found.after, found.floor) == pytest.approx((was, left, least))
    assert found.share_closed == pytest.approx((was - left) / (was - least))
    assert (before.tolist(), after.tolist()) == ([[3.0, 4.0]] * 2, [[1.0, 2.0]] * 2)
    np.testing.assert_array_equal(told[0][0], np.ones((2, 10, 2)) * [1.0, 2.0])  # the floor is of the corrected one
    worse = score([t], h, np.array([4.0, 6.0]), np.ones(2), rng)[0]
    assert -1.0 < worse.share_closed < 0.0
    for values, share in ((np.array([30.0, 40.0]), -1.0), (np.zeros(2), 1.0)):  # below the floor is no more than all
        assert score([t], h, values, np.ones(2), rng)[0].share_closed == share


def test_of_many_windows_a_wild_one_counts_in_the_floor_as_the_worst_of_the_others_does(monkeypatch):
    """Each joint by its own: forty windows are off by one, one of the first joint by a thousand."""
    off = np.ones((40, 1, 2)) * [1.0, 2.0]
    off[7, 0, 0] = 1000.0

    def replayed(windows, build, values, start=None):
        return (off if start is not None else 0.0 * off)[None] * np.ones((1, 40, 5, 2))

    t = made_up(halved=lambda: None, misread=lambda rng: None)
    monkeypatch.setattr(compare, "simulate", replayed)
    monkeypatch.setattr(compare, "replace", lambda windows, take: windows)
    windows, rng = [Windows(t, np.arange(40), 5)], np.random.default_rng(0)
    floor = noise_floor(windows, Hypothesis(()), np.zeros(0), [np.zeros((40, 5, 2))], np.zeros(2), rng)
    np.testing.assert_allclose(floor, [1.0, 2.0])
