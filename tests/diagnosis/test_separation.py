"""How far apart two explanations are, where it can be worked out by hand."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from diagnosis.columns import Given, Shifted, candidate, shifted, signals
from scipy.signal import lfilter

from torchrl_athletic.diagnosis.screen import Bank
from torchrl_athletic.diagnosis.search import Judge
from torchrl_athletic.diagnosis.separation import Coefficients, PairProducts, Rivals, every_nth
from torchrl_athletic.diagnosis.thresholds import PLAN, SEARCH
from torchrl_athletic.effects import Fingerprint, Parameter

N = 2000
PHASE = 2 * np.pi * np.arange(N) / 50
SINE, COSINE = np.sqrt(2) * np.sin(PHASE), np.sqrt(2) * np.cos(PHASE)


class Along(Given):
    """Predicts sums of the shoulder's position (first number) and velocity (second), one for each parameter."""

    def __init__(self, name: str, *sums: tuple[float, float], **bounds: float) -> None:
        super().__init__(name, np.zeros((1, len(sums))), **bounds)
        self.sums = sums

    def fingerprint(self, s, joint, fixed):
        q, v = s.position[:, 0], s.velocity[:, 0]
        out = np.zeros((len(q), 2, len(self.sums)))
        out[:, 0] = np.stack([a * q + b * v for a, b in self.sums], -1)
        return Fingerprint(out, fixed)


def motion(first, second, missing=None):
    """The shoulder moves; the elbow rests."""
    still = np.zeros_like(first)
    missing = still if missing is None else missing
    return signals(
        np.stack([missing, still], -1), position=np.stack([first, still], -1), velocity=np.stack([second, still], -1)
    )


def rivals(*effects: Along, size: float = 0.5, second=None):
    """Fitted to a take where the first column makes the missing torque, beside unit noise."""
    noise = np.random.default_rng(0).standard_normal(N)
    take = motion(SINE, SINE if second is None else second, size * SINE + noise)
    judge = Judge(Bank([take], [candidate(e) for e in effects], noise=np.ones(2)))
    scored = [judge.score([atom]) for atom in judge.bank.atoms]
    rivals = Rivals(judge, scored, None)
    known = rivals.products([every_nth(take)])
    return rivals, known, rivals.separations(known)


def planned(rivals: Rivals, known, first, second) -> np.ndarray:
    return rivals.separations(known + rivals.products([every_nth(motion(first, second))]))


def test_two_names_for_one_torque_are_never_apart():
    pair, known, now = rivals(Along("one", (1, 0)), Along("other", (2, 0)))
    assert now == pytest.approx([0], abs=1e-3)
    assert planned(pair, known, 5 * COSINE, SINE) == pytest.approx([0], abs=1e-3)


def test_what_looks_the_same_in_one_motion_is_told_apart_by_another_as_far_as_the_noise_lets_it():
    pair, known, now = rivals(Along("one", (1, 0)), Along("other", (0, 1)), size=0.1)
    assert now == pytest.approx([0], abs=1e-3)  # position and velocity were the same there
    # the first predicts 0.1 of a unit sine, which no cosine answers; as much in the old take it can, so both share
    after = planned(pair, known, SINE, -SINE)
    # the best answer is zero: 0.1² is left of both halves, whose noise has the variance 1
    expected = np.sqrt(2 * N / PLAN.every * np.log(1 + 0.1**2))
    assert after == pytest.approx([expected], rel=0.35)  # the sizes drawn scatter by a third
    assert planned(pair, known, 3 * SINE, -3 * SINE) > after


def test_more_parameters_that_absorb_the_difference_take_it_away():
    truth = Along("one", (1, 0))
    pair, known, _ = rivals(truth, Along("two", (0, 1), (1, 0)))
    assert planned(pair, known, SINE, -SINE)[0] > 3  # not the way round, as the larger may be the truth
    known_of_pair = known + pair.products([every_nth(motion(SINE, -SINE))])
    own = pair.draws[0][0]
    assert pair._evidence(known_of_pair, own, 0, 1, np.ones(4)) == pytest.approx(0, abs=1e-6)


def test_bounds_keep_a_rival_from_answering():
    free, known, _ = rivals(Along("one", (1, 0)), Along("other", (1, 0)))
    _, _, now = rivals(Along("one", (1, 0)), Along("other", (1, 0), lower=-0.8, upper=0.8), size=2.0)
    assert free.separations(known) == pytest.approx([0], abs=1e-3)
    assert now[0] > 3


def test_what_no_answer_meets_counts_by_the_logarithm_of_the_error_that_it_leaves():
    pair, known, now = rivals(Along("one", (1, 0)), Along("other", (0, 1)), size=0.15, second=COSINE)
    left, level = known.left[0], max(known.left[0], pair.floor[0])

    def apart(sizes):  # of sines against cosines, which answer nothing
        return np.mean([np.sqrt(N / PLAN.every * np.log(max(left + c**2, level) / level)) for (c,) in sizes])

    assert now == pytest.approx([np.mean([apart(sizes) for sizes in pair.draws])], rel=1e-3)


def test_twice_the_recording_is_twice_the_evidence():
    pair, known, now = rivals(Along("one", (1, 0)), Along("other", (0, 1)), size=0.15, second=COSINE)
    assert 2 < now[0] < PLAN.enough / 2
    assert pair.separations(known.times(2.0)) == pytest.approx(np.sqrt(2) * now, rel=0.02)
    assert pair.separations(known + known) == pytest.approx(np.sqrt(2) * now, rel=0.02)


def test_a_hundredth_of_what_is_missing_and_what_smoothing_bends_say_nothing():
    pair, known, _ = rivals(Along("one", (1, 0)), Along("other", (0, 1)))
    pair.draws = [np.array([[1.0]]), np.array([[1.0]])]
    near = 100 * SINE + 0.5 * COSINE  # half a hundredth of it is not what the other says
    far = 100 * SINE + 4 * COSINE
    assert planned(pair, known, 100 * SINE, near) == pytest.approx([0], abs=0.3)
    assert planned(pair, known, 100 * SINE, far)[0] > 3

    seen = motion(SINE, -SINE)
    sharp, bent = (known + pair.products([every_nth(replace(seen, bias=b * np.ones_like(seen.bias)))]) for b in (0, 2))
    assert pair.separations(bent)[0] < 0.8 * pair.separations(sharp)[0]


def test_noise_that_a_search_will_allow_hides_what_is_below_it():
    pair, known, now = rivals(Along("one", (1, 0)), Along("other", (0, 1)), size=0.15, second=COSINE)
    assert pair.separations(known, noise=2 * np.ones(2)) < now / 2


def test_a_quiet_recording_does_not_make_a_louder_plan_deaf():
    """Below the floor of the old take nobody asks; the plan's own noise is above it, so that all beyond it counts."""
    small = 0.1 * np.random.default_rng(0).standard_normal(N)
    take = replace(motion(SINE, SINE, 0.5 * SINE + small), noise=np.full(2, 0.1))
    judge = Judge(
        Bank([take], [candidate(Along(n, c)) for n, c in (("one", (1, 0)), ("other", (0, 1)))], noise=np.ones(2))
    )
    pair = Rivals(judge, [judge.score([atom]) for atom in judge.bank.atoms], None)
    known = pair.products([every_nth(take)])
    assert known.left == pytest.approx([0.01, 0.01], rel=0.2)
    assert pair.separations(known) == pytest.approx([0], abs=1e-3)
    loud = pair.products([every_nth(motion(SINE, -SINE))])
    assert loud.left == pytest.approx([1, 1], rel=0.01)
    quiet = pair.products([every_nth(replace(motion(SINE, -SINE), noise=np.full(2, 0.1)))])
    assert pair.separations(known + quiet) == pytest.approx([0], abs=1e-3)
    assert pair.separations(known + loud)[0] > 3


def test_a_piece_of_a_single_instant_counts_as_one():
    pair, known, now = rivals(Along("one", (1, 0)), Along("other", (0, 1)), size=0.15, second=COSINE)
    whole = every_nth(motion(SINE, COSINE))
    alone = pair.products([every_nth(whole, len(whole.time))])
    assert alone.count == pytest.approx([1, 1])
    assert pair.separations(known + alone) == pytest.approx(now, rel=0.01)


def test_coefficients_stand_for_the_parameters_of_the_fit():
    pair, *_ = rivals(Along("one", (1, 0)), Along("other", (1, 0), (0, 1), nominal=0.25), second=COSINE)
    for fitted, coefficients in zip(pair.rivals, pair.known, strict=True):
        given = np.concatenate(fitted.fit.values())
        np.testing.assert_allclose(coefficients.parameters(coefficients.values), given)
        np.testing.assert_allclose(coefficients.parameters(0 * given), coefficients.free[0][0].nominal)


def test_products_of_a_recording_twice_as_long_count_twice_as_many_samples():
    rows = np.arange(1.0, 3.0)
    own = PairProducts({(0, 0): np.ones((2, 1, 1))}, rows, 2 * rows, 3 * rows, 4 * rows)
    longer = own.times(2.5)
    assert longer.count.tolist() == [2.5, 5.0]
    assert longer.of[0, 0].flatten().tolist() == [2.5, 2.5]
    for name in ("bent", "left", "noise"):  # means of a sample
        assert getattr(longer, name).tolist() == getattr(own, name).tolist()
    both = own + longer
    assert both.count.tolist() == [1.0, 2.0, 2.5, 5.0]
    assert both.noise.tolist() == [4.0, 8.0, 4.0, 8.0]


def test_pairs_weigh_by_how_probable_both_are_and_alike_where_nobody_says():
    told, *_ = rivals(*(Along(name, (1.0, 0.0)) for name in "abc"))
    np.testing.assert_allclose(told.weight, [1 / 3] * 3)
    judge = Judge(Bank(told.takes, [candidate(Along(name, (1.0, 0.0))) for name in "abc"], noise=np.ones(2)))
    weighed = Rivals(judge, [judge.score([atom]) for atom in judge.bank.atoms], [0.6, 0.3, 0.1])
    np.testing.assert_allclose(weighed.weight, np.array([0.18, 0.06, 0.03]) / 0.27)  # (a, b), (a, c), (b, c)


# --- the sums, and what is not linear, by hand ---


def test_products_are_sums_over_what_counts_in_units_of_the_noise():
    """Half of the rows count, each for a quarter of a sample, beside noise of 2 and 3 N·m."""
    pair, *_ = rivals(Along("one", (1, 0)), Along("other", (0, 1)), second=COSINE)
    pair.memory, pair.unnamed = np.ones(2), np.array([0.2, 0.3])
    half = np.arange(N) < N // 2
    seen = motion(SINE, COSINE)
    seen = replace(seen, valid=np.stack([half, half], -1), bias=np.full((N, 2), 0.6), noise=np.full(2, 0.5),
                   kernel=4 * seen.kernel)  # fmt: skip
    found = pair.products([seen], np.array([[2.0, 3.0]]))
    assert found.count == pytest.approx([N / 8, N / 8])
    assert found.bent == pytest.approx([0.36 / 4, 0.36 / 9])
    assert found.left == pytest.approx([(0.25 + 0.2) / 4, (0.25 + 0.3) / 9])
    assert found.noise == pytest.approx([2.0, 3.0])
    for (a, b), expected in {(0, 0): SINE @ (half * SINE), (1, 1): COSINE @ (half * COSINE), (0, 1): 0.0}.items():
        assert found.of[a, b][:, 0, 0] == pytest.approx([expected / 4 / 4, 0.0], abs=1e-6)
    twice = pair.products([seen, seen], np.array([[2.0, 3.0]] * 2))
    assert twice.count == pytest.approx(2 * found.count)
    assert (twice.bent, twice.left) == (pytest.approx(found.bent), pytest.approx(found.left))
    assert pair.products([seen, seen], np.array([[2.0, 3.0], [4.0, 3.0]])).noise == pytest.approx([10**0.5, 3.0])
    pair.memory = np.array([0.5, 1.0])
    assert pair.products([seen]).count == pytest.approx([N / 16, N / 8])


@pytest.mark.parametrize("sigma", [1.0, 2.0])
def test_what_the_likeliest_leaves_beyond_the_sensors_is_carried_over_to_what_is_planned(sigma):
    noise = np.random.default_rng(0).standard_normal((2, N))
    take = replace(motion(SINE, COSINE, 0.5 * SINE + noise[0]), noise=np.full(2, 0.3))
    judge = Judge(Bank([take], [candidate(Along("one", (1, 0)))], noise=np.full(2, sigma)))
    best = judge.score(judge.bank.atoms)
    pair = Rivals(judge, [best], None)
    left = (judge.bank.rows(best.fit) ** 2).mean(0)
    assert pair.unnamed == pytest.approx(np.maximum(left - 0.3**2, 0.0))
    assert pair.products([take]).left[0] == pytest.approx(left[0] / sigma**2)


def test_a_residual_with_a_memory_counts_for_less_and_one_without_for_no_more_than_its_samples():
    """Rows that the test function makes depend on each other are fewer samples already, however white they look."""
    noise = np.random.default_rng(0).standard_normal(N)
    slow = lfilter([np.sqrt(1 - 0.8**2)], [1, -0.8], noise)
    found = {}
    for name, left, wider in (("slow", slow, 1), ("white", noise, 4)):
        take = motion(SINE, COSINE, left)
        take = replace(take, kernel=wider * take.kernel)
        judge = Judge(Bank([take], [candidate(Along("one", (1, 0)))], noise=np.ones(2)))
        found[name] = Rivals(judge, [judge.score(judge.bank.atoms)], None).memory[0]
    assert found["slow"] == pytest.approx(0.2 / 1.8, rel=0.3)
    assert found["white"] == 1.0


def test_farther_apart_than_enough_is_enough():
    pair, known, _ = rivals(Along("one", (1, 0)), Along("other", (0, 1)), second=COSINE)
    pair.draws = [np.array([[5.0], [9.0]])] * 2  # a mean of draws is not more than enough because one of them is far
    assert pair.separations(known) == pytest.approx([PLAN.enough])


@pytest.mark.parametrize("floor", [1.0, 3.0])
@pytest.mark.parametrize("louder", [1.0, 1.5, 2.0])
def test_noise_of_a_search_is_compared_by_its_variance(louder, floor):
    """What stands above the noise as a floor is as much torque beside louder noise, and fewer of its variances."""
    pair, known, _ = rivals(Along("one", (1, 0)), Along("other", (0, 1)), size=0.5, second=COSINE)
    pair.floor, known = np.full(2, floor), known.times(0.05)
    c, quiet = 2.5, louder**-2
    left = known.left[0] * quiet
    level = max(left, 1.0 + (max(floor, 1.0 + SEARCH.accuracy**2 * c**2) - 1.0) * quiet)
    expected = known.count[0] * np.log(max(left + c**2 * quiet, level) / level)
    assert expected > 1  # else nothing were compared
    found = pair._evidence(known, np.array([c]), 0, 1, np.full(2, quiet))
    assert found == pytest.approx(expected, rel=1e-3)
    pair.draws = [np.array([[c]]), np.array([[0.0]])]  # of the other nothing is to be told from the first
    apart = pair.separations(known, noise=np.full(2, louder))
    assert apart == pytest.approx([np.sqrt(expected) / 2], rel=1e-3)


@pytest.mark.parametrize(("own", "other"), [(0.0, 0.0), (0.0, 300.0), (300.0, 300.0), (40.0, 300.0)])
def test_what_strains_the_answer_speaks_against_it_and_what_strains_the_truth_against_that(own, other):
    """Two that say the same, but the second pulls its number towards zero as a trim is pulled: a ridge, by hand."""
    pair, known, _ = rivals(Along("one", (1, 0)), Along("other", (1, 0)))
    pair.known[0].doubt, pair.known[1].doubt = np.array([own]), np.array([other])
    c, samples = 0.5, known.of[0, 0][0, 0, 0]
    level = max(known.left[0], pair.floor[0], 1.0 + SEARCH.accuracy**2 * c**2 * samples / known.count[0])
    answer = c * (samples / level) / (samples / level + other)
    worse = max(known.left[0] + (c - answer) ** 2 * samples / known.count[0], level)
    expected = max(known.count[0] * np.log(worse / level) + other * answer**2 - own * c**2, 0.0)
    assert pair._evidence(known, np.array([c]), 0, 1, np.ones(2)) == pytest.approx(expected, rel=1e-3, abs=1e-9)


def late(delay: float, beside: Along | None = None):
    """Coefficients of a delay at a point of its grid, and of a linear effect of the elbow."""
    take = motion(SINE, COSINE)
    given = [candidate(Shifted("late", np.empty((0, 1))))] + ([] if beside is None else [candidate(beside, 1)])
    judge = Judge(Bank([take], given, noise=np.ones(2)))
    judge.bank.add_all(given[0], [{"delay": delay}])
    atoms = [next(a for a in judge.bank.atoms if a.fixed == {"delay": delay})]
    atoms += [a for a in judge.bank.atoms if a.candidate is given[-1]][: len(given) - 1]
    scored = judge.score(atoms)
    return Coefficients(scored, take), scored, take


def test_a_nonlinear_number_counts_by_the_slope_of_what_it_predicts():
    """40 (sin 3(t - d) - sin 3t) has the slope -120 cos 3(t - d) by d, and is nearly linear 10 ms about 0.2 s."""
    found, _, take = late(0.2)
    columns = found.columns(take, {})
    np.testing.assert_allclose(columns[:, 0, 0], shifted(take.time, 0.2))
    np.testing.assert_allclose(columns[:, 0, 1], -120 * np.cos(3 * (take.time - 0.2)), atol=2.0)
    np.testing.assert_allclose(found.prediction(take)[:, 0], shifted(take.time, 0.2))
    assert found.parameters(np.array([1.0, 0.05])) == pytest.approx([0.25])
    assert (found.low[1], found.high[1]) == pytest.approx((-0.1, 0.1))  # half of its value, either way
    assert found.doubt[1] == pytest.approx(1 / 0.05**2)  # which are two deviations


def test_a_number_at_its_upper_end_is_changed_the_other_way(monkeypatch):
    """What lies beyond a bound may have no meaning, and the slope is the same."""
    asked = []
    whole = Shifted.fingerprint
    monkeypatch.setattr(
        Shifted,
        "fingerprint",
        lambda self, s, joint, fixed: asked.append(fixed["delay"]) or whole(self, s, joint, fixed),
    )
    found, _, take = late(1.0)
    columns = found.columns(take, {})
    assert max(asked) <= 1.0
    assert (found.low[1], found.high[1]) == pytest.approx((-0.5, 0.5))
    np.testing.assert_allclose(columns[:, 0, 1], -120 * np.cos(3 * (take.time - 1.0)), atol=12.0)


def test_a_number_beside_a_nonlinear_one_keeps_its_own_coefficient():
    found, scored, take = late(0.2, Along("beside", (1, 0), nominal=0.25))
    np.testing.assert_allclose(found.parameters(found.values), np.concatenate(scored.fit.values()))
    assert found.parameters(np.array([1.0, 0.05, 2.0])) == pytest.approx([0.25, 2.25])
    assert found.prior[2] == PLAN.unseen**-2  # of one scale of change, from wherever the given model is
    columns = found.columns(take, {})
    assert columns.shape == (N, 2, 3)
    np.testing.assert_allclose(columns[:, 0, 2], SINE)


def test_drawn_numbers_scatter_as_the_recordings_allow_about_those_fitted(monkeypatch):
    """By the inverse of the normal matrix; a change of a nonlinear number is for the answer, not for the truth."""
    monkeypatch.setattr("torchrl_athletic.diagnosis.separation.PLAN", replace(PLAN, draws=4001))
    found, _, _ = late(0.2, Along("beside", (1, 0), lower=-1e3, upper=1e3))
    gram = np.diag([1e9, 1e9, 25.0])
    drawn = found.draw(gram, np.random.default_rng(0))
    assert drawn.shape == (4001, 3)
    assert (drawn[:, 1] == 0).all()
    np.testing.assert_array_equal(drawn[0], found.values)
    assert drawn[1:, 2].std() == pytest.approx(1 / np.sqrt(25.0 + found.prior[2]), rel=0.05)
    assert drawn[1:, 2].mean() == pytest.approx(found.values[2], abs=0.02)


def test_numbers_that_the_recordings_tie_together_are_drawn_together_and_those_not_shown_as_likely(monkeypatch):
    monkeypatch.setattr("torchrl_athletic.diagnosis.separation.PLAN", replace(PLAN, draws=1001))
    take = motion(SINE, COSINE, 0.5 * SINE)
    three = candidate(Along("three", (1, 0), (0, 1), (1, 1), lower=-1e3, upper=1e3))
    judge = Judge(Bank([take], [three], noise=np.ones(2)))
    found = Coefficients(judge.score(judge.bank.atoms), take)
    tied = np.array([[25.0, 20.0, 0.0], [20.0, 25.0, 0.0], [0.0, 0.0, 0.0]])
    drawn = found.draw(tied, np.random.default_rng(0))[1:]
    expected = np.linalg.inv(tied[:2, :2])
    np.testing.assert_allclose(np.cov(drawn[:, :2].T), expected, rtol=0.15)
    assert drawn[:, 2].std() == pytest.approx(PLAN.unseen, rel=0.1)


def test_one_effect_on_two_joints_is_two_rivals(monkeypatch):
    def own(self, s, joint, fixed):
        out = np.zeros((len(s.time), 2, 1))
        out[:, joint, 0] = s.position[:, 0]
        return Fingerprint(out, fixed)

    monkeypatch.setattr(Along, "fingerprint", own)
    both = Along("one", (1, 0))
    judge = Judge(Bank([motion(SINE, COSINE, SINE)], [candidate(both, 0), candidate(both, 1)], noise=np.ones(2)))
    pair = Rivals(judge, [judge.score([atom]) for atom in judge.bank.atoms], None)
    found = pair.products(pair.takes)
    assert found.of[0, 1] == pytest.approx(np.zeros((2, 1, 1)))
    assert [group[0, 0] > 0 for group in found.of[1, 1]] == [False, True]


def test_a_number_without_a_column_of_its_own_is_no_coefficient(monkeypatch):
    two = (Parameter("seen", "1", 0.0, -1.0, 1.0, 1.0), Parameter("unseen", "1", 0.0, -1.0, 1.0, 1.0))
    monkeypatch.setattr(Along, "parameters", lambda self, model, address, joint: two)
    take = motion(SINE, COSINE, 0.5 * SINE)
    judge = Judge(Bank([take], [candidate(Along("half", (1, 0)))], noise=np.ones(2)))
    assert Coefficients(judge.score(judge.bank.atoms), take).values == pytest.approx([0.5])


def test_thinned_signals_keep_the_base_of_the_rows_that_are_left():
    take = every_nth(replace(motion(SINE, COSINE), base=np.arange(N)), 3)
    np.testing.assert_array_equal(take.base, np.arange(0, N, 3))


def test_draws_scatter_with_the_level_of_the_error():
    pair, known, _ = rivals(Along("one", (1, 0)), Along("other", (0, 1)), size=0.15, second=COSINE)
    quiet, pair.draws, pair.level = pair.draws, None, 4 * pair.level
    pair.separations(known)
    for few, many, own in zip(quiet, pair.draws, pair.known, strict=True):
        np.testing.assert_allclose(many - own.values, 2 * (few - own.values), rtol=0.02)


def test_what_is_left_and_the_floor_are_means_over_the_rows_that_count():
    """A fifth of the take, of which a tenth counts, has most of the torque and of what smoothing bends."""
    first = np.arange(N) < N // 5
    valid = np.stack([~first | (np.arange(N) < N // 50), np.ones(N, dtype=bool)], -1)
    missing, bias = (np.stack([np.where(first, size, 0.5), np.zeros(N)], -1) for size in (6.0, 3.0))
    bias[~first] = 0.0
    idle = np.stack([np.where(np.arange(N) % 2, 2.0, -2.0), np.zeros(N)], -1)
    take = replace(signals(missing, valid, bias=bias, position=idle), noise=np.zeros(2))
    judge = Judge(Bank([take], [candidate(Along("idle", (1, 0)))], noise=np.ones(2)))
    pair = Rivals(judge, [judge.score(judge.bank.atoms)], None)
    counted = valid[:, 0]
    assert pair.unnamed[0] == pytest.approx((missing[counted, 0] ** 2).mean())
    assert pair.floor[0] == pytest.approx(1.0 + (bias[counted, 0] ** 2).mean(), rel=1e-3)
    assert pair.level[0] == pytest.approx(max(pair.unnamed[0], pair.floor[0]))


def test_of_a_fit_each_number_is_one_coefficient_and_a_trim_is_pulled_by_half_its_tolerance():
    take = motion(SINE, COSINE, 0.5 * SINE + 0.25 * COSINE)
    two, trim = candidate(Along("two", (1, 0), (0, 1))), candidate(Along("trim", (5, 5), lower=-0.4, upper=0.4), 1)
    judge = Judge(Bank([take], [two], [trim], noise=np.ones(2)))
    best = judge.score(judge.bank.atoms[:1])
    found = Coefficients(best, take)
    np.testing.assert_allclose(found.values, best.fit.coefficients)
    np.testing.assert_allclose(found.doubt, [0.0, 0.0, 1 / 0.2**2])
    assert (found.low.tolist(), found.high.tolist()) == ([-10.0, -10.0, -0.4], [10.0, 10.0, 0.4])
    np.testing.assert_allclose(found.prior, [PLAN.unseen**-2, PLAN.unseen**-2, 1 / 0.2**2])  # of scales of one


def test_of_rivals_with_as_many_numbers_either_may_be_true_and_of_others_the_larger(monkeypatch):
    """One says of the other's truth that it is 5 apart, the other 2."""
    monkeypatch.setattr(Rivals, "_evidence", lambda self, products, x, one, other, quiet: (5.0, 2.0)[one] ** 2)
    for sums, expected in ((((0, 1),), 3.5), (((0, 1), (1, 1)), 5.0)):
        pair, known, _ = rivals(Along("one", (1, 0)), Along("other", *sums), second=COSINE)
        assert pair.separations(known) == pytest.approx([expected])


def test_a_number_that_the_recordings_do_not_show_is_the_given_models_beside_one_that_they_do():
    take = motion(SINE, COSINE, 0.5 * SINE)
    judge = Judge(Bank([take], [candidate(Along("two", (0, 0), (1, 0)))], noise=np.ones(2)))
    assert Coefficients(judge.score(judge.bank.atoms), take).values == pytest.approx([0.0, 0.5], abs=1e-6)


def test_a_small_number_is_changed_by_half_of_what_is_worth_mentioning(monkeypatch):
    coarse = (Parameter("delay", "s", 0.0, 0.0, 1.0, 0.5),)
    monkeypatch.setattr(Shifted, "parameters", lambda self, model, address, joint: coarse)
    found, *_ = late(0.2)
    assert (found.low[1], found.high[1]) == pytest.approx((-0.25, 0.25))
