from dataclasses import replace

import numpy as np
import pytest
from diagnosis.columns import NAMES, STEP, Curved, Given, Shifted, candidate, shifted, signals
from effects.arm import arm, record
from scipy.interpolate import CubicSpline
from scipy.optimize import lsq_linear
from scipy.signal import lfilter

from torchrl_athletic.diagnosis import screen
from torchrl_athletic.diagnosis.screen import (
    Atom,
    Bank,
    Fit,
    bounded_least_squares,
    candidates_for,
    correlation_time,
    is_trim,
    row_noise,
    trims_for,
)
from torchrl_athletic.diagnosis.thresholds import TORQUES
from torchrl_athletic.effects import (
    CATALOGUE,
    FIT_TRIMS,
    TRIMS,
    ActuationDelay,
    ClockOffset,
    ClockShift,
    CoulombFriction,
    GainMismatch,
    LinkCom,
    LinkMass,
    Payload,
    TorqueScale,
    project_recording,
)
from torchrl_athletic.effects.effect import torque_scale

N = 450  # four and a half blocks
NOISE = np.array([0.5, 2.0])


@pytest.fixture
def rng():
    return np.random.default_rng(0)


@pytest.fixture
def take(rng):
    return signals(rng.normal(0, 3, (N, 2)), rng.random((N, 2)) < 0.8)


def stacked(take, columns, noise=NOISE):
    """One plain least squares with all rows of both joints one under the other."""
    weight = (take.valid / noise).ravel()
    return columns.reshape(2 * N, -1) * weight[:, None], take.missing.ravel() * weight


def both(rng, count):
    return rng.normal(size=(N, 2, count))


def test_the_fit_is_least_squares_of_valid_rows_weighed_by_the_noise(rng, take):
    columns = both(rng, 3)
    bank = Bank([take], [candidate(Given("a", columns[..., :2])), candidate(Given("b", columns[..., 2:]))], noise=NOISE)
    fit = bank.fit(bank.atoms)
    matrix, target = stacked(take, columns)
    np.testing.assert_allclose(fit.coefficients, np.linalg.lstsq(matrix, target)[0], rtol=1e-6)
    assert fit.freedom == 3


@pytest.mark.parametrize("seed", range(5))
def test_the_fit_respects_bounds_as_scipy_does(seed):
    rng = np.random.default_rng(seed)
    take, columns = signals(rng.normal(0, 3, (N, 2))), both(rng, 4)
    columns[..., 3] += columns[..., 0]
    take = replace(take, missing=take.missing + columns @ [2.0, -1.5, 0.3, 1.0])
    bank = Bank([take], [candidate(Given("a", columns, lower=-0.5, upper=1.0))], noise=NOISE)
    matrix, target = stacked(take, columns)
    exact = lsq_linear(matrix, target, (-0.5, 1.0)).x
    assert ((exact < -0.49) | (exact > 0.99)).sum() >= 2
    np.testing.assert_allclose(bank.fit(bank.atoms).coefficients, exact, atol=1e-4)


def test_bounds_are_those_of_the_change_and_values_those_of_the_parameter(rng, take):
    column = rng.normal(size=N)
    take = replace(take, missing=3 * np.stack([column, 0 * column], -1))
    bank = Bank([take], [candidate(Given("a", column, lower=4.0, upper=6.5, nominal=5.0))], noise=NOISE)
    fit = bank.fit(bank.atoms)
    np.testing.assert_allclose(fit.coefficients, [1.5])
    np.testing.assert_allclose(fit.values(), [[6.5]])


def test_blocks_of_two_takes_are_not_mixed(rng):
    takes = [signals(rng.normal(size=(n, 2))) for n in (150, 230)]
    bank = Bank(takes, [], noise=NOISE)
    assert bank.block[149] == 1
    assert bank.block[150] == 2
    assert bank.block[-1] == 4
    np.testing.assert_allclose(bank.count, [[150, 230], [150, 230]])  # nor stretches


def test_blocks_begin_with_the_take_whenever_that_was(take):
    later = replace(take, fine_time=take.fine_time + 0.25 * TORQUES.block)
    assert Bank([later], [], noise=NOISE).block.tolist() == Bank([take], [], noise=NOISE).block.tolist()


def test_the_residual_is_what_is_left_in_each_stretch_of_each_joint(rng, take):
    bank = Bank([take], [candidate(Given("a", both(rng, 2)))], noise=NOISE)
    for fit in (bank.fit(bank.atoms), bank.fit(())):  # of columns kept in single precision
        square = (bank.rows(fit) * take.valid / NOISE) ** 2
        np.testing.assert_allclose(fit.residual.sum(1), square.sum(0), rtol=1e-7)
        exact = [[square[bank.stretch == k, j].sum() for k in range(2)] for j in range(2)]
        np.testing.assert_allclose(fit.residual, exact, rtol=1e-7)


def test_a_stretch_of_which_less_is_left_weighs_more(rng, take):
    columns = both(rng, 2)
    bank = Bank([take], [candidate(Given("a", columns))], noise=NOISE)
    level = np.array([[1.0, 2.0], [50.0, 0.3]])
    matrix, target = stacked(take, columns, NOISE * np.sqrt(level.T[bank.stretch]))
    np.testing.assert_allclose(bank.fit(bank.atoms, level).coefficients, np.linalg.lstsq(matrix, target)[0], rtol=1e-5)


@pytest.mark.parametrize("joint", [0, 1])
def test_the_gain_of_a_grid_point_is_what_a_fit_with_it_closes(rng, take, joint):
    class Gridded(Given):
        """The columns, each time turned by some rows."""

        def grid(self, s, joint):
            return [{"shift": float(k)} for k in range(5)]

        def fingerprint(self, s, joint, fixed):
            plain = super().fingerprint(s, joint, {})
            return replace(plain, columns=np.roll(plain.columns, int(fixed["shift"]), axis=0))

    base, one, two = (rng.normal(size=(N, k)) for k in (1, 1, 2))
    linear = candidate(Given("linear", both(rng, 1)))
    shelved = [candidate(Gridded("one", one, lower=0.0), joint), candidate(Gridded("two", two, -1.5, 0.02), joint)]
    bank = Bank([take], [linear, *shelved], [candidate(Given("trim", base))], noise=NOISE)
    level = np.array([2.0, 0.7])
    even = np.tile(level[:, None], 2)
    before = bank.fit(bank.atoms[:1], even)
    gained = bank.gains(before, level)
    assert len(gained) == 10
    for atom, gain in gained.items():
        after = bank.fit([bank.atoms[0], atom], even)
        assert gain == pytest.approx(float(((before.residual - after.residual) / even).sum()), rel=1e-5, abs=1e-5)


def test_the_gains_of_some_grid_points_are_those_among_the_gains_of_all(take):
    bank = Bank([take], [candidate(Shifted("late", np.empty((0, 1))))], noise=NOISE)
    fit = bank.fit(())
    whole, some = bank.gains(fit, np.ones(2)), bank.atoms[1:3]
    assert bank.gains(fit, np.ones(2), lambda atom: atom in some) == {a: pytest.approx(whole[a]) for a in some}
    assert len(whole) > len(some)
    assert all(bank.is_shelved(a) for a in whole)
    assert bank.gains(fit, np.ones(2), lambda atom: False) == {}


def test_no_gain_rests_on_a_trim_that_leaves_its_tolerance(take):
    """Else a limit of half a platform's weight looked good, since the platform could be lighter by as much."""
    time, seen = STEP * np.arange(N), take.valid[:, 0]
    early, between = shifted(time, 0.1), shifted(time, 0.4) - shifted(time, 0.1)
    missing = early - between * (early[seen] @ between[seen]) / (between[seen] @ between[seen])  # no trim is asked for
    take = replace(take, missing=np.stack([missing, 0 * time], -1))
    trim = candidate(Given("trim", between, lower=-0.02, upper=0.02))
    bank = Bank([take], [candidate(Shifted("late", np.empty((0, 1))))], [trim], noise=NOISE)
    before = bank.fit(())
    for atom, gain in bank.gains(before, np.ones(2)).items():
        after = bank.fit([atom])
        closed = before.residual.sum() - after.residual.sum() - bank.correlation * after.strain
        assert gain == pytest.approx(closed, rel=0.01)


def test_predictions_and_the_rest_are_the_missing_torque(rng, take):
    bank = Bank([take], [candidate(Given(name, both(rng, 2))) for name in "ab"], noise=NOISE)
    fit = bank.fit(bank.atoms)
    parts = sum(bank.prediction(fit, atom) for atom in fit.atoms)
    np.testing.assert_allclose(parts + bank.rows(fit), take.missing, atol=1e-12)
    first = bank.atoms[0]
    np.testing.assert_allclose(bank.prediction(fit, first), first.candidate.effect.columns @ fit.coefficients[:2])


def test_a_nonlinear_parameter_is_no_coefficient(take):
    late = shifted(take.time, 0.2)
    take = replace(take, missing=np.stack([late, 0 * late], -1))
    bank = Bank([take], [candidate(Shifted("late", np.empty((0, 1))))], noise=NOISE)
    assert [atom.fixed["delay"] for atom in bank.atoms] == [0.1, 0.2, 0.4]
    fits = [bank.fit([atom]) for atom in bank.atoms]
    assert [f.coefficients.tolist() for f in fits] == [[1.0]] * 3  # all of it or none
    assert [f.values()[0].tolist() for f in fits] == [[0.1], [0.2], [0.4]]
    assert fits[1].residual.sum() == pytest.approx(0, abs=1e-6)
    assert min(fits[0].residual.sum(), fits[2].residual.sum()) > 1000


def test_what_would_hide_in_the_noise_even_at_its_bound_is_left_out(rng, take):
    column = rng.uniform(0.5, 1, N)
    loud, quiet = Given("loud", column, upper=0.6, lower=0), Given("quiet", column, upper=0.4, lower=0)
    bank = Bank([take], [candidate(loud), candidate(quiet)], noise=NOISE)
    assert [a.candidate.effect.name for a in bank.atoms] == ["loud"]  # 0.6 and 0.4 against a noise of 0.5
    assert bank.add(candidate(quiet), {}) is None
    part = bank.add(candidate(Given("half", np.stack([0 * column, column], -1))), {})
    assert part.linear == (1,)  # of two parameters the data show the second
    take_all = bank.fit([part])
    assert take_all.values()[0][0] == 0.0


def test_what_the_recording_cannot_show_is_no_candidate(take):
    class Blind(Given):
        def applies(self, s):
            return False

    assert Bank([take], [candidate(Blind("blind", np.ones(N)))], noise=NOISE).atoms == []


def test_trims_are_fitted_beside_a_combination_unless_they_exclude_it(rng, take):
    a, b = rng.normal(size=(2, N))
    take = replace(take, missing=np.stack([2 * a + 5 * b, 0 * a], -1))
    main, rival = Given("a", a), Given("c", rng.normal(size=N))
    trim = candidate(Given("trim", b, lower=-1, upper=1, excludes=("c",)))
    bank = Bank([take], [candidate(main), candidate(rival)], [trim], noise=NOISE)
    fit = bank.fit(bank.atoms[:1])
    np.testing.assert_allclose(fit.coefficients[1], 1.0)  # at its bound
    assert [t.candidate.effect.name for t in fit.atoms] == ["a", "trim"]
    assert [t.candidate.effect.name for t in fit.terms] == ["a"]
    assert fit.freedom == 1
    assert len(bank.fit(bank.atoms[1:]).atoms) == 1
    assert len(bank.fit(()).atoms) == 1


def test_every_term_of_a_link_leaves_the_trims_the_same_freedom(take):
    """But for its own number: a shifted centre is not worse off than a payload, which excludes nothing."""
    of_link = [t for t in trims_for([take], TRIMS) if t.joint == 1 and t.effect.family == "inertia"]
    for effect in (Payload(), LinkCom(), LinkMass(), TorqueScale(), GainMismatch()):
        kept = {t.effect.name for t in of_link if t.moves_beside(candidate(effect, 1))}
        assert kept == {"link_mass", "link_com_shift", "link_inertia"} - {effect.name}


def test_trims_lie_within_a_share_of_the_given_numbers(take):
    trims = trims_for([take], FIT_TRIMS)
    assert {t.joint_name for t in trims} == {*NAMES, None}
    for trim in trims:
        for p in trim.parameters:
            reach = 0.5 * STEP if trim.effect.name == "clock_shift" else trim.effect.tolerance * p.scale
            assert p.upper - p.nominal == pytest.approx(reach)
            assert p.nominal - p.lower == pytest.approx(reach)


def test_one_joint_may_be_late_on_a_clock_that_is_a_little_off():
    r = record(ActuationDelay(), 1, [0.006])
    early = CubicSpline(r.time, r.position)(r.time + 0.0015)
    s = project_recording(replace(r, position=early), arm(), np.zeros(2), kernel=0.012)
    bank = Bank([s], candidates_for([s], [ActuationDelay()]), trims_for([s], {ClockShift(): 2.0}))
    (late,) = bank.add_all(bank.atoms[-1].candidate, [{"delay": 0.006}])
    fit = bank.fit([late])
    np.testing.assert_allclose(fit.values(), [[0.006], [-0.0015]], atol=3e-4)
    assert fit.residual.sum() < 0.01 * bank.fit((), trimmed=False).residual.sum()


@pytest.mark.parametrize(
    ("effect", "values", "period", "joints", "expected"),
    [
        (GainMismatch(), (1.014, 1.024), 0.005, 2, True),
        (GainMismatch(), (1.014, 1.2), 0.005, 2, False),
        (GainMismatch(), (1.014, 1.2), 1.0, 1, False),  # a gain is not off by half a sample
        (ClockOffset(), (-0.0005,), 0.001, 2, True),
        (ClockOffset(), (-0.002,), 0.001, 2, False),
        (ClockOffset(), (-0.002,), 0.005, 2, True),  # half a sample is nobody's fault
        (ActuationDelay(), (0.002,), 0.005, 1, True),
        (ActuationDelay(), (0.002,), 0.005, 2, False),  # but the clock's, which makes the other joint as late
        (CoulombFriction(), (1e-6,), 0.005, 2, False),  # there is no friction that every model has
    ],
)
def test_what_every_log_is_off_by_is_a_trim(effect, values, period, joints, expected):
    whole = replace(candidate(effect), joint_name=None) if effect.whole_robot else candidate(effect)
    assert is_trim(whole, np.array(values), period, joints) is expected


def test_every_effect_is_a_candidate_on_every_joint(take):
    found = {c.key for c in candidates_for([take])}
    expected = {(e.name, name) for e in CATALOGUE for name in ((None,) if e.whole_robot else NAMES)}
    of_the_last = {(name, "shoulder") for name in ("payload", "offset_payload", "coupled_drive")}
    assert found == expected - of_the_last
    bank = Bank([take], [candidate(GainMismatch())], noise=NOISE)
    assert bank.atoms == []  # torque control has no gains


# --- bounded least squares ---


@pytest.mark.parametrize("seed", range(4))
def test_bounded_least_squares_is_scipys(seed):
    rng = np.random.default_rng(seed)
    matrix, target = rng.normal(size=(40, 5)) * [1, 1e3, 1e-3, 1, 1], rng.normal(size=40)
    free = np.linalg.lstsq(matrix, target)[0]
    low, high = free - np.abs(free) * [1, 1, -0.2, 1, 1], free + np.abs(free) * [1, -0.3, 1, 1, 1]
    got = bounded_least_squares(matrix.T @ matrix, matrix.T @ target, low, high)
    scale = np.abs(free)
    exact = lsq_linear(matrix * scale, target, (low / scale, high / scale), tol=1e-14).x * scale
    np.testing.assert_allclose(got / scale, exact / scale, atol=1e-5)
    assert (got >= low - 1e-12).all()
    assert (got <= high + 1e-12 * scale).all()


@pytest.mark.parametrize("in_circles", [False, True])
def test_bounds_that_are_met_on_the_way_and_left_again_are_no_trap(in_circles, monkeypatch):
    """The columns are nearly alike, and both ways to find the least squares are tried."""
    if in_circles:
        monkeypatch.setattr(screen, "_within", lambda *_: None)
    for seed in range(40):
        rng = np.random.default_rng(seed)
        matrix, target = rng.normal(size=(12, 4)) + 2 * rng.normal(size=(12, 1)), 3 * rng.normal(size=12)
        low, high = np.sort(rng.uniform(-1, 1, (2, 4)), axis=0)
        got = bounded_least_squares(matrix.T @ matrix, matrix.T @ target, low, high)
        np.testing.assert_allclose(got, lsq_linear(matrix, target, (low, high), method="bvls").x, atol=1e-5)


def test_equal_bounds_fix_a_coefficient(rng):
    matrix, target = rng.normal(size=(30, 3)), rng.normal(size=30)
    wide = np.full(3, 100.0)
    got = bounded_least_squares(
        matrix.T @ matrix, matrix.T @ target, np.array([-100, 1.0, -100]), np.array([100, 1.0, 100])
    )
    rest = np.linalg.lstsq(matrix[:, [0, 2]], target - matrix[:, 1])[0]
    np.testing.assert_allclose(got, [rest[0], 1.0, rest[1]], rtol=1e-7)
    np.testing.assert_array_equal(bounded_least_squares(matrix.T @ matrix, matrix.T @ target, wide, wide), wide)


def test_equal_columns_share_a_coefficient_and_stay_finite(rng):
    column = rng.normal(size=(50, 1))
    matrix = np.hstack([column, column])
    got = bounded_least_squares(matrix.T @ matrix, matrix.T @ (3 * column[:, 0]), np.full(2, -10.0), np.full(2, 10.0))
    np.testing.assert_allclose(got, [1.5, 1.5], rtol=1e-4)


# --- independent samples ---


@pytest.mark.parametrize("rho", [0.0, 0.5, 0.9])
def test_the_correlation_time_of_an_autoregression(rho, rng):
    x = lfilter([1], [1, -rho], rng.normal(size=100_000))
    assert correlation_time(x) == pytest.approx((1 + rho) / (1 - rho), rel=0.1)
    assert correlation_time(1e-6 * x + 5.0) == pytest.approx(correlation_time(x), rel=1e-6)


def test_a_constant_and_a_zigzag_are_not_correlated_beyond_a_sample():
    assert correlation_time(np.full(100, 3.0)) == 1.0
    assert correlation_time((-1.0) ** np.arange(100)) == 1.0


def test_a_correlation_that_never_ends_counts_as_far_as_it_is_known():
    assert correlation_time(np.array([-1.0, -1.0, 1.0, 1.0])) == pytest.approx(1 + 2 * 0.25)


def test_independent_samples_count_valid_rows_over_the_correlation_time_of_each_joint(rng):
    white = rng.normal(size=(4000, 2))
    left = np.stack([white[:, 0], lfilter([1], [1, -0.8], white[:, 1])], -1)
    half = np.ones((4000, 2), dtype=bool)
    half[2000:, 0] = False
    bank = Bank([signals(left, half)], [], noise=np.ones(2))
    np.testing.assert_allclose(bank.independent_samples(left), [2000, 4000 / 9], rtol=0.2)


def test_the_row_noise_has_a_floor_below_which_nobody_asks(rng):
    command = np.stack([np.full(N, 2.0), np.full(N, 0.1)], -1)
    quiet = replace(signals(np.zeros((N, 2)), command=command), noise=np.array([1e-9, 0.5]))
    quiet.__dict__["load"] = np.zeros((N, 2))
    (noise,) = row_noise([quiet])
    assert 0.999 * TORQUES.torque_floor * 2.0 < noise[0] < 1.001 * TORQUES.torque_floor * 20.0
    assert noise[1] == pytest.approx(0.5, rel=1e-3)


def test_takes_behind_different_test_functions_are_weighed_by_their_own_noise(rng):
    wide, alike = (replace(signals(rng.normal(size=(N, 2))), noise=n * np.ones(2)) for n in (1.0, 7.0))
    narrow = replace(wide, noise=100 * np.ones(2), kernel=wide.kernel / 10)
    noise = row_noise([wide, narrow, alike])
    np.testing.assert_allclose(noise[:, 0], [5, 100, 5], rtol=1e-3)  # the mean square of one and seven is 25
    bank = Bank([wide, narrow], [])
    np.testing.assert_allclose(bank.weight[:N] / bank.weight[N:], 100, rtol=1e-3)


@pytest.mark.parametrize(
    ("value", "stands_in"), [(1.5, True), (4.0, True), (2.5, False), (1.501, False), (3.999, False)]
)
def test_a_number_at_either_bound_is_no_estimate(value, stands_in):
    assert fit_of(value, 1.5, 4.0).at_bound is stands_in


def test_a_number_that_stops_at_zero_or_at_the_given_value_is_one():
    assert not fit_of(0.0, 0.0, 4.0, nominal=2.0).at_bound
    assert not fit_of(2.0, 2.0, 4.0, nominal=2.0).at_bound
    assert all(fit_of(x, x, 4.0, nominal=2.0).at_bound for x in (0.5, 0.05, 1.95, 2.05))


def fit_of(value, low, high, nominal=1.0):
    """A combination of one law with one number."""
    law = Given("law", np.zeros((1, 1)), low, high, nominal)
    law.value = lambda parameter, change: change
    nothing = np.zeros((2, 1))
    atom = Atom(candidate(law), {}, (0,), (0,))
    return Fit((atom,), 1, np.array([value]), (np.array([low]), np.array([high])), 0.0, nothing, nothing)


# --- which candidates stand beside each other ---


def of(name, joint, excludes=()):
    """A law of a joint, or of the whole robot if that is None."""
    law = candidate(Given(name, np.ones(2), excludes=excludes), joint or 0)
    return law if joint is not None else replace(law, joint_name=None)


@pytest.mark.parametrize(
    ("one", "other", "together", "beside"),
    [
        (of("a", 0), of("b", 0), True, True),
        (of("a", 0), of("a", 0), False, False),
        (of("a", 0), of("a", 1), True, True),
        (of("a", 0, "b"), of("b", 0), False, False),
        (of("a", 0, "b"), of("b", 1), True, True),  # what excludes it does so on its own joint
        (of("a", 0), of("b", 0, "a"), False, True),  # a trim stays unless it is the one that excludes
        (of("a", None, "b"), of("b", 1), False, False),  # what the whole robot has is on every joint
        (of("a", 1, "b"), of("b", None), False, False),
        (of("a", 1), of("b", None), True, True),
    ],
)
def test_on_one_joint_no_two_of_a_name_nor_what_excludes_another(one, other, together, beside):
    assert one.allows(other) is other.allows(one) is together
    assert one.moves_beside(other) is beside


def test_the_second_of_two_terms_may_be_the_one_at_its_bound():
    """One law has two numbers and the other has one: the last of the three, which may stop at its bound."""
    two, one = Given("two", np.zeros((2, 2)), 0.0, 9.0), Given("one", np.zeros(2), 1.0, 4.0)
    atoms = tuple(Atom(candidate(law), {}, linear, linear) for law, linear in ((two, (0, 1)), (one, (0,))))
    low, high, nothing = np.array([0.0, 0.0, 1.0]), np.array([9.0, 9.0, 4.0]), np.zeros((2, 1))
    for last, stops in ((4.0, True), (2.0, False)):
        fit = Fit(atoms, 2, np.array([2.0, 3.0, last]), (low, high), 0.0, nothing, nothing)
        assert fit.at_bound is stops
        assert fit.stand_ins == [atoms[1]] * stops


def test_numbers_that_make_no_sense_together_are_no_estimate(monkeypatch):
    law, nothing = Given("law", np.zeros((2, 2))), np.zeros((2, 1))
    fit = Fit((Atom(candidate(law), {}, (0, 1), (0, 1)),), 1, np.array([2.0, 3.0]), (np.full(2, -9.0), np.full(2, 9.0)),
              0.0, nothing, nothing)  # fmt: skip
    assert not fit.at_bound
    monkeypatch.setattr(Given, "is_physical", lambda self, parameters, values: values[0] > values[1])
    assert fit.at_bound


def test_a_number_on_its_grid_counts_unless_it_is_the_given_models():
    parameters = candidate(Given("law", np.zeros((2, 3)))).parameters
    law = replace(candidate(Given("law", np.zeros((2, 3)))), parameters=parameters)
    assert Atom(law, {}, (0, 1, 2), (0, 1, 2)).freedom == 3
    assert Atom(law, {"p0": 2.0}, (1, 2), (0, 1)).freedom == 3
    assert Atom(law, {"p0": 0.0}, (1, 2), (0, 1)).freedom == 2


# --- stretches, rows and what is predicted at all ---


def test_stretches_are_as_long_as_they_may_be_and_none_lies_in_two_takes(rng):
    """Takes of 450 and of 350 samples of 10 ms make two stretches each, the longest of 2.25 s; one of 100 makes one."""
    bank = Bank([signals(rng.normal(size=(n, 2))) for n in (450, 350, 100)], [], noise=NOISE)
    assert np.bincount(bank.stretch).tolist() == [225, 225, 175, 175, 100]
    assert (np.diff(bank.stretch) >= 0).all()


def test_only_rows_that_can_be_used_are_counted(take):
    bank = Bank([take], [], noise=NOISE)
    np.testing.assert_array_equal(bank.count.sum(1), take.valid.sum(0))


def test_white_noise_behind_the_test_function_is_independent_every_so_many_rows(rng):
    """As signals are made here each row is; of a test function twice as wide, or of coarser rows, it is not."""
    take = signals(rng.normal(size=(N, 2)))
    assert Bank([take], [], noise=NOISE).correlation == pytest.approx(1.0)
    assert Bank([replace(take, kernel=2 * take.kernel)], [], noise=NOISE).correlation == pytest.approx(2.0)
    assert Bank([replace(take, fine_step=2 * STEP)], [], noise=NOISE).correlation == pytest.approx(0.5)


def test_what_one_of_two_takes_cannot_show_is_no_candidate(take):
    class Half(Given):
        def applies(self, s):
            return s is take

    half = candidate(Half("half", np.ones(N)))
    assert Bank([take, replace(take)], [half], noise=NOISE).atoms == []
    assert len(Bank([take], [half], noise=NOISE).atoms) == 1


def test_the_grid_is_that_of_all_takes_together(take):
    class Longest(Given):
        def grid_of(self, takes, joint):
            return [{"of": float(len(takes))}]

        def fingerprint(self, s, joint, fixed):
            return replace(super().fingerprint(s, joint, {}), fixed=fixed)

    bank = Bank([take, replace(take)], [candidate(Longest("law", np.ones(N)))], noise=NOISE)
    assert [atom.fixed for atom in bank.atoms] == [{"of": 2.0}]


def test_noise_behind_a_gaussian_is_correlated_over_its_squared_sum_per_sum_of_squares():
    weight = np.exp(-0.5 * (np.arange(-200, 201) / 20.0) ** 2)
    assert screen.KERNEL_CORRELATION * 20.0 == pytest.approx(weight.sum() ** 2 / (weight**2).sum())


def test_an_equation_of_motion_that_has_run_away_predicts_nothing(take):
    runaway = candidate(Given("runaway", np.geomspace(1.0, 1e17, N)))
    assert Bank([take], [runaway], noise=NOISE).atoms == []


class Two(Given):
    """Has two forms of its column."""

    def grid(self, s, joint):
        return [{"form": 1.0}, {"form": -1.0}]


def test_a_number_that_nothing_shows_is_no_coefficient_beside_a_constant(take):
    class Unseen(Two):
        def parameters(self, model, address, joint):
            return super().parameters(model, address, joint) * 2

        def fingerprint(self, s, joint, fixed):
            plain = super().fingerprint(s, joint, {})
            return replace(plain, constant=5 * plain.columns[:, :, 0])

    assert Bank([take], [candidate(Unseen("half", np.ones(N)))], noise=NOISE).atoms[0].linear == (0, -1)


def test_what_the_whole_robot_has_is_not_weighed_on_one_joint_alone(take):
    law, whole = Two("law", np.ones(N)), Two("whole", np.ones(N))
    whole.whole_robot = True
    bank = Bank([take], [candidate(law), candidate(whole)], noise=NOISE)
    assert {atom.candidate.effect.name for atom in bank.gains(bank.fit(()), np.ones(2))} == {"law"}


@pytest.mark.parametrize("sign", [1.0, -1.0])
@pytest.mark.parametrize(("upper", "least"), [(1.0, 0.9999), (2.0, 0.8), (9.0, 0.9999)])
def test_beside_a_new_term_the_old_one_moves_as_far_as_its_bound_is_away(upper, least, sign):
    """It has 1.5 and would have 3.1: it stands at its bound, has 0.5 left (where the gain is a guess), or is free."""
    u, w = np.linalg.qr(np.random.default_rng(0).normal(size=(N, 2)))[0].T * 30.0
    take = signals(sign * np.stack([1.5 * u + 2 * w, 0 * u], -1))
    old, new = candidate(Given("old", u, *sorted([0.0, sign * upper]))), candidate(Two("new", w - 0.8 * u))
    bank = Bank([take], [old, new], noise=np.ones(2))
    before = bank.fit(bank.atoms[:1])
    for atom, gain in bank.gains(before, np.ones(2)).items():
        after = bank.fit([bank.atoms[0], atom])
        closed = before.residual.sum() - after.residual.sum()
        assert least * closed < gain < closed * (1 + 1e-6)


def test_a_trim_is_pulled_to_zero_by_half_its_tolerance_as_one_deviation():
    """By hand, of rows every other of which is independent, with 16 for the square of two over a half."""
    column = np.full(900, 4.0)
    take = signals(np.stack([0.4 * column, 0 * column], -1))
    take = replace(take, kernel=2 * take.kernel)
    bank = Bank([take], [], [candidate(Given("trim", column, -0.5, 0.5))], noise=np.ones(2))
    fit = bank.fit(())
    (found,) = fit.coefficients
    assert found == pytest.approx(0.4 * 900 * 16 / (900 * 16 + 2 * 16), rel=1e-6)
    assert fit.strain == pytest.approx(16 * found**2)


def test_what_holds_near_old_values_is_moved_to_the_new_ones(take):
    bank = Bank([take], [candidate(Curved("law", np.ones((N, 2))))], noise=NOISE)
    (near,) = bank.near(replace(bank.fit(bank.atoms), coefficients=np.array([2.0])))
    assert near.fixed == {"near": 2.0}
    (moved,) = bank.near(replace(bank.fit([near]), coefficients=np.array([3.0])))
    assert moved.fixed == {"near": 3.0}


def test_a_load_counts_as_a_torque_below_which_a_share_is_not_asked_for():
    """A joint that holds ten newton-metres by friction of its gear, and one that is told to."""
    command = np.stack([np.full(N, 0.1), np.full(N, 10.0)], -1)
    s = replace(signals(np.zeros((N, 2)), command=command), noise=np.full(2, 1e-9))
    s.__dict__["load"] = command[:, ::-1]
    strong, weak = (torque_scale(s.nominal, s.address, j) for j in range(2))
    assert weak < 10.0 < strong < 100.0
    floor = TORQUES.torque_floor * np.array([strong, 10.0])
    np.testing.assert_allclose(row_noise([s])[0], floor, rtol=1e-3)
    loud = replace(s, noise=floor)  # as much again, of the sensors
    loud.__dict__["load"] = s.load
    np.testing.assert_allclose(row_noise([loud])[0], np.sqrt(2) * floor, rtol=1e-3)


def test_half_a_sample_of_the_slowest_log_is_nobodys_fault(take):
    """Whether it is the first one or not."""
    r = take.recording
    slow = replace(take, recording=replace(r, time=4 * r.time))
    for takes in ([take, slow], [slow, take]):
        (trim,) = trims_for(takes, [ClockShift()])
        assert trim.parameters[0].upper == pytest.approx(2 * STEP)


def test_predictions_of_what_stands_behind_others_are_its_own(rng, take):
    """A trim's coefficients come after those of the terms, however many numbers each has."""
    laws = [candidate(Given(name, both(rng, count))) for name, count in (("a", 1), ("b", 2))]
    bank = Bank([take], laws, [candidate(Given(name, both(rng, 1))) for name in ("c", "d")], noise=NOISE)
    fit = bank.fit(bank.atoms)
    for atom, part in zip(fit.atoms, np.split(fit.coefficients, [1, 3, 4]), strict=True):
        np.testing.assert_allclose(bank.prediction(fit, atom), atom.candidate.effect.columns @ part)


def test_of_a_law_that_is_shown_in_part_the_part_predicts(rng):
    """The first of its two columns is nothing at all, and no number stands for it."""
    column = rng.normal(size=N)
    take = signals(np.stack([3 * column, 0 * column], -1))
    bank = Bank([take], [candidate(Given("law", np.stack([0 * column, column], -1)))], noise=NOISE)
    fit = bank.fit(bank.atoms)
    np.testing.assert_allclose(bank.prediction(fit, fit.atoms[0])[:, 0], 3 * column)
    np.testing.assert_allclose(bank.rows(fit), 0, atol=1e-6)


def test_the_energy_of_each_term_is_that_of_what_it_predicts_on_each_joint(rng, take):
    laws = [candidate(Given(name, both(rng, count))) for name, count in (("a", 2), ("b", 1), ("c", 2))]
    bank = Bank([take], laws, noise=NOISE)
    fit = bank.fit(bank.atoms)
    for atom, energy in zip(fit.terms, fit.energy, strict=True):
        np.testing.assert_allclose(energy, ((bank.weight * bank.prediction(fit, atom)) ** 2).sum(0))


def test_the_numbers_of_a_law_are_those_of_all_takes_on_its_own_joint(take, monkeypatch):
    law, asked = Given("law", np.zeros((1, 1))), []
    monkeypatch.setattr(Given, "parameters_of", lambda self, takes, joint: asked.append((takes, joint)) or ())
    assert candidates_for([take, take], [law]) == []  # of no numbers there is none
    assert asked == [([take, take], j) for j in range(take.num_joints)]
