import itertools
from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
from diagnosis.columns import STEP, Curved, Given, Shifted, candidate, judge, shifted, signals
from effects.arm import address, arm
from scipy.signal import lfilter

from torchrl_athletic.diagnosis.screen import Bank, Candidate
from torchrl_athletic.diagnosis.search import (
    Judge,
    _between,
    _down,
    _invariant,
    _is_bent,
    _is_sided,
    _merge,
    _prune,
    _simplest,
    _simplify,
    alternatives,
    noise_level,
    noisy_joints,
    predictable_share,
    richer,
    rivals,
    scatter,
    search,
    singles,
)
from torchrl_athletic.diagnosis.thresholds import SEARCH
from torchrl_athletic.effects import AsymmetricFriction, CoulombFriction, Fingerprint, Parameter

N = 1000


def smooth(rng, size, rho=0.9):
    """Unit columns with a memory, as motion has."""
    return lfilter([np.sqrt(1 - rho**2)], [1, -rho], rng.normal(size=size), axis=-1)


def on_shoulder(torque, noise=None):
    return signals(np.stack([torque, np.zeros(N)], -1) + (0 if noise is None else noise))


def names(scored) -> set[tuple[str, str]]:
    return {atom.candidate.key for atom in scored.fit.terms}


def value_of(scored, name: str) -> np.ndarray:
    return next(
        v for a, v in zip(scored.fit.atoms, scored.fit.values(), strict=True) if a.candidate.effect.name == name
    )


@pytest.mark.parametrize("seed", range(4))
def test_a_planted_pair_is_found_among_many_with_its_coefficients(seed):
    rng = np.random.default_rng(seed)
    columns = dict(zip("abcdefgh", smooth(rng, (8, N)), strict=True))
    torque = 6 * columns["b"] - 4 * columns["e"]
    found = search(
        judge(on_shoulder(torque, rng.normal(size=(N, 2))), *(candidate(Given(*c)) for c in columns.items()))
    )
    assert names(found[0]) == {("b", "shoulder"), ("e", "shoulder")}
    assert value_of(found[0], "b") == pytest.approx([6], abs=0.3)
    assert value_of(found[0], "e") == pytest.approx([-4], abs=0.3)


def test_one_effect_on_each_joint_is_found_on_its_joint():
    rng = np.random.default_rng(0)
    a, b = smooth(rng, (2, N))
    take = signals(np.stack([5 * a, 5 * b], -1) + rng.normal(size=(N, 2)))
    both = [candidate(Given(*c), joint) for c in (("a", a), ("b", b)) for joint in (0, 1)]
    assert names(search(judge(take, *both))[0]) == {("a", "shoulder"), ("b", "elbow")}


def test_an_effect_that_reaches_an_open_joint_through_coupling_is_found():
    rng = np.random.default_rng(0)
    column = smooth(rng, N)
    elbow = np.zeros((N, 2, 1))
    elbow[:, 0, 0] = column  # of the elbow, felt at the shoulder
    found = search(judge(on_shoulder(5 * column, rng.normal(size=(N, 2))), candidate(Given("a", elbow), 1)))
    assert names(found[0]) == {("a", "elbow")}


def test_what_stops_at_a_physical_bound_is_a_stand_in_and_no_finding():
    """With ten times the torque that it may have, an effect leaves most of what is missing; at zero it would be one."""
    rng = np.random.default_rng(0)
    a, b = smooth(rng, (2, N))
    take = on_shoulder(50 * a + 5 * b, rng.normal(size=(N, 2)))
    bounded = candidate(Given("a", a, upper=5.0))
    (found,) = search(judge(take, bounded))
    assert names(found) == set()
    found = search(judge(take, bounded, candidate(Given("wide", a, upper=100.0)), candidate(Given("b", b))))[0]
    assert names(found) == {("wide", "shoulder"), ("b", "shoulder")}


def test_a_robot_that_has_nothing_of_what_its_model_has_is_at_a_bound_and_a_finding():
    rng = np.random.default_rng(0)
    column = smooth(rng, N)
    take = on_shoulder(-9.0 * column, rng.normal(size=(N, 2)))  # less than zero is left of the given model's
    for nominal in np.linspace(0.1, 4.0, 40):
        weigh = judge(take, candidate(Given("dry", column, lower=0.0, nominal=nominal)))
        fit = weigh.bank.fit(weigh.bank.atoms)
        assert fit.values()[0] == pytest.approx(0.0, abs=1e-9)
        assert not fit.at_bound


@pytest.mark.parametrize(("share", "expected"), [(0.005, {"a"}), (0.05, {"a", "b"})])
def test_what_a_gross_effect_leaves_below_one_per_cent_is_given_no_name(share, expected):
    """No law is right to a hundredth, however far above the noise that is."""
    rng = np.random.default_rng(0)
    a, b = smooth(rng, (2, N))
    take = on_shoulder(400 * (a + share * b), rng.normal(size=(N, 2)))
    found = search(judge(take, *(candidate(Given(n, c, -1e3, 1e3)) for n, c in (("a", a), ("b", b)))))[0]
    assert names(found) == {(name, "shoulder") for name in expected}


def test_white_noise_opens_no_question():
    for seed in range(5):
        rng = np.random.default_rng(seed)
        take = signals(rng.normal(size=(N, 2)))
        (found,) = search(judge(take, *(candidate(Given(str(k), c)) for k, c in enumerate(smooth(rng, (10, N))))))
        assert names(found) == set()


def test_an_unknown_disturbance_is_rarely_given_a_name():
    """Twenty times, ten innocent effects are offered for an open residual with a memory."""
    alarms = 0
    for seed in range(20):
        rng = np.random.default_rng(seed)
        take = on_shoulder(5 * smooth(rng, N, 0.8), rng.normal(size=(N, 2)))
        columns = smooth(rng, (10, N), 0.8)
        found = search(judge(take, *(candidate(Given(str(k), c, lower=-50, upper=50)) for k, c in enumerate(columns))))
        alarms += bool(names(found[0]))
    assert alarms <= 1


def test_what_nothing_predicts_is_noise_and_a_push_stands_out_of_it():
    """A stand-in that follows the noise itself, as teeth with play do, is no finding; a push of a second stays one."""
    rng = np.random.default_rng(0)
    noise = np.stack([1.3 * rng.normal(size=20 * N), rng.normal(size=20 * N)], -1)
    stand_in = np.where(rng.uniform(size=20 * N) < 0.66, 1.0, -1.0) * np.sign(noise[:, 0])
    push = np.zeros(20 * N)
    push[5000:5100] = smooth(rng, 100)
    take = signals(noise + np.stack([6 * push, 0 * push], -1))
    candidates = [candidate(Given("stand_in", stand_in)), candidate(Given("push", push))]
    weigh = judge(take, *candidates)
    assert names(search(weigh)[0]) == {("stand_in", "shoulder"), ("push", "shoulder")}
    assert noisy_joints(weigh) == [0]
    assert names(search(Judge(weigh.bank, noisy_joints(weigh)))[0]) == {("push", "shoulder")}


def test_effects_that_act_seldom_and_a_rich_catalogue_hide_nothing_that_can_be_predicted():
    """Hundreds of columns on a short record fit its noise, and one that acts on one block only knows no other."""
    rng = np.random.default_rng(0)
    column, *others = smooth(rng, (300, N))
    seldom = 1e-9 * smooth(rng, N)
    seldom[-100:] = 100 * others[0][-100:]
    given = [candidate(Given(f"e{k}", c)) for k, c in enumerate([column, seldom, *others])]
    weigh = judge(on_shoulder(3 * column, 2 * rng.normal(size=(N, 2))), *given)
    assert 0.4 < predictable_share(weigh.bank, 0) < 0.8  # nine parts of thirteen
    assert predictable_share(weigh.bank, 1) < SEARCH.predictable


def test_a_joint_that_misses_a_predictable_torque_is_not_called_noisy():
    rng = np.random.default_rng(0)
    column = smooth(rng, 2 * N)
    noise = 2 * rng.normal(size=2 * N)
    take = signals(np.stack([column + noise, 0 * noise], -1))  # a fifth of what is missing
    weigh = judge(take, candidate(Given("a", column)))
    search(weigh)
    assert noisy_joints(weigh) == []


@pytest.mark.parametrize(("size", "expected"), [(0.3, set()), (0.7, {("a", "shoulder")})])
def test_a_joint_is_asked_about_when_its_missing_torque_exceeds_the_noise_by_a_quarter(size, expected):
    rng = np.random.default_rng(0)
    column, noise = rng.normal(size=N), rng.normal(size=(N, 2))
    column = column / column.std()
    noise[:, 0] -= column * (noise[:, 0] @ column) / N
    found = search(judge(on_shoulder(size * column, noise / noise.std(0)), candidate(Given("a", column))))
    assert names(found[0]) == expected


@pytest.mark.parametrize(("rows", "expected"), [(60, set()), (600, {("a", "shoulder")})])
def test_a_fifth_of_the_missing_torque_is_named_once_there_is_enough_of_it(rows, expected):
    a, b = np.tile([1.0, -1.0], rows // 2), np.tile([1.0, 1.0, -1.0, -1.0], rows // 4)
    torque = 5 * (np.sqrt(0.2) * a + np.sqrt(0.8) * b)
    take = signals(np.stack([torque, 0 * torque], -1))
    assert names(search(judge(take, candidate(Given("a", a))))[0]) == expected


def test_noise_alone_of_a_level_that_smoothing_explains_is_no_question():
    rng = np.random.default_rng(0)
    column = smooth(rng, N)
    bent = 3 * np.stack([column, column], -1)
    take = signals(bent + rng.normal(size=(N, 2)), bias=bent)
    weigh = judge(take)
    expected = [[1 + (bent[weigh.bank.stretch == k, j] ** 2).mean() for k in range(5)] for j in range(2)]
    np.testing.assert_allclose(weigh.floor, expected, rtol=1e-3)  # and a ten-thousandth of what is missing
    (found,) = search(judge(take, candidate(Given("a", column))))
    assert names(found) == set()


def test_a_simpler_effect_is_preferred_to_one_that_contains_it():
    rng = np.random.default_rng(0)
    a, b = smooth(rng, (2, N))
    take = on_shoulder(6 * a + 0.8 * b, 4 * rng.normal(size=(N, 2)))  # the second number closes next to nothing
    larger = Given("asymmetric", np.stack([a, b], -1), excludes=("symmetric",))
    found = search(judge(take, candidate(larger), candidate(Given("symmetric", a))))
    assert names(found[0]) == {("symmetric", "shoulder")}


def test_a_simpler_effect_is_found_although_finer_points_of_its_grid_promise_more():
    """Friction that grows with the load is dry friction, whose turnover fits better at points with a number more."""

    class Turning(Given):
        def parameters(self, model, address, joint):
            return *super().parameters(model, address, joint), Parameter("turnover", "s", 0.0, 0.0, 1.0, 0.1)

        def grid(self, s, joint):
            return [{"turnover": x} for x in (0.0, 0.2, 0.3, 0.4)]

        def fingerprint(self, s, joint, fixed):
            plain = super().fingerprint(s, joint, fixed)
            late = smooth(np.random.default_rng(1), N)[:, None, None] * (plain.columns != 0)
            return Fingerprint(plain.columns + bool(fixed["turnover"]) * 0.1 * late, fixed)

    rng = np.random.default_rng(0)
    a, b = smooth(rng, (2, N))
    late = smooth(np.random.default_rng(1), N)
    take = on_shoulder(6 * a + 0.4 * late + 0.5 * b, 2 * rng.normal(size=(N, 2)))
    loaded = Given("loaded", np.stack([a, b], -1), excludes=("dry",))
    weigh = judge(take, candidate(loaded), candidate(Turning("dry", a)))
    found = _simplify(weigh, weigh.score(weigh.bank.atoms[:1]))
    assert names(found) == {("dry", "shoulder")}


def test_what_took_the_place_of_a_richer_law_is_given_up_as_well_where_less_will_do():
    """Friction by direction is not one that drifts, because friction that drifts is simpler: it is plain friction."""
    rng = np.random.default_rng(0)
    a, b, c = smooth(rng, (3, N))
    take = on_shoulder(6 * a + 0.8 * b, 2 * rng.normal(size=(N, 2)))
    laws = (("rich", [a, b, c]), ("middle", [a, b]), ("plain", [a]))
    weigh = judge(take, *(candidate(Given(n, np.stack(x, -1), excludes=[m for m, _ in laws])) for n, x in laws))
    rich, middle, plain = (weigh.score([atom]) for atom in weigh.bank.atoms)
    assert middle.evidence < plain.evidence
    assert names(_simplify(weigh, rich)) == names(middle)
    assert names(_simplest(weigh, rich)) == names(plain)


@pytest.mark.parametrize(("second", "expected"), [(0.0, set()), (1.0, {"asymmetric"}), (8.0, {"asymmetric"})])
def test_a_richer_law_that_was_given_up_is_left_to_the_simulation_where_its_evidence_is_decisive(second, expected):
    rng = np.random.default_rng(0)
    a, b = smooth(rng, (2, N))
    take = on_shoulder(9 * a + second * b, 2 * rng.normal(size=(N, 2)))
    larger = Given("asymmetric", np.stack([a, b], -1), excludes=("symmetric",))
    weigh = judge(take, candidate(larger), candidate(Given("symmetric", a)))
    rich = richer(weigh, weigh.score(weigh.bank.atoms[1:]))
    assert (set() if rich is None else {name for name, _ in names(rich)}) == expected


def test_a_richer_law_whose_special_cases_do_as_well_is_asked_about_as_these():
    """Friction by direction, beside viscous friction that was found: what it has in addition is the dry part."""
    rng = np.random.default_rng(0)
    dry, viscous, side = smooth(rng, (3, N))
    take = on_shoulder(2 * dry + 9 * viscous, rng.normal(size=(N, 2)))
    whole = Given("by_direction", np.stack([dry, viscous, side], -1), excludes=("dry", "viscous"))
    whole.special_cases = frozenset({"dry", "viscous"})  # type: ignore[misc]
    weigh = judge(take, candidate(whole), candidate(Given("dry", dry)), candidate(Given("viscous", viscous)))
    assert names(richer(weigh, weigh.score(weigh.bank.atoms[2:]))) == {("dry", "shoulder"), ("viscous", "shoulder")}


def test_effects_alone_are_told_by_what_they_close_whatever_their_evidence():
    rng = np.random.default_rng(0)
    a, b, c = smooth(rng, (3, N))
    take = on_shoulder(6 * a + 3 * b, rng.normal(size=(N, 2)))
    material, others = singles(judge(take, *(candidate(Given(*e)) for e in (("b", b), ("a", a), ("c", c)))))
    assert [name for s in material for name, _ in names(s)] == ["a", "b"]
    assert [name for s in others for name, _ in names(s)] == ["c"]


def test_close_rivals_are_told_with_the_evidence_that_they_lie_behind():
    rng = np.random.default_rng(0)
    a, other = smooth(rng, (2, N))
    effects = (("true", a), ("twin", a + 0.002 * other), ("else", other))
    weigh = judge(on_shoulder(6 * a, rng.normal(size=(N, 2))), *(candidate(Given(*e)) for e in effects))
    best = weigh.score(weigh.bank.atoms[:1])
    ((twin, behind),) = rivals(weigh, best, within=6.0)
    assert names(twin) == {("twin", "shoulder")}
    expected = weigh.score(twin.fit.terms).evidence - best.evidence
    assert behind == pytest.approx(max(expected, 0.0), abs=0.5)
    assert behind > 0
    assert rivals(weigh, best, within=behind) == []


def test_a_term_with_another_strength_on_each_take_goes_unless_it_accounts_for_much():
    rng = np.random.default_rng(0)
    a, b = smooth(rng, (2, N))
    unsteady = b * (1 + np.sin(np.arange(N) / 160))
    for size, expected in ((1.0, {"a"}), (8.0, {"a", "b"})):
        take = on_shoulder(6 * a + size * unsteady, 0.5 * rng.normal(size=(N, 2)))
        weigh = judge(take, candidate(Given("a", a)), candidate(Given("b", b)))
        kept = _invariant(weigh, weigh.score(weigh.bank.atoms))
        assert {name for name, _ in names(kept)} == expected


def test_a_cause_of_the_whole_robot_is_judged_where_it_accounts_for_most():
    """A lean of the base moves no joint that turns about the vertical, which may be the first."""
    rng = np.random.default_rng(0)
    a, b = smooth(rng, (2, N))
    unsteady = b * (1 + np.sin(np.arange(N) / 160))
    lean = np.zeros((N, 2, 1))
    lean[:, 1, 0] = b
    take = signals(np.stack([6 * a, 8 * unsteady], -1) + 0.5 * rng.normal(size=(N, 2)))
    weigh = judge(take, candidate(Given("a", a)), replace(candidate(Given("lean", lean)), joint_name=None))
    kept = _invariant(weigh, weigh.score(weigh.bank.atoms))
    assert names(kept) == {("a", "shoulder"), ("lean", None)}


def test_a_rival_is_weighed_at_its_own_best_value():
    """A delay that was found beside nothing lies elsewhere beside what came later; a rival is not judged by that."""
    rng = np.random.default_rng(0)
    time = STEP * np.arange(N)
    take = on_shoulder(shifted(time, 0.3), rng.normal(size=(N, 2)))
    late = candidate(Shifted("late", np.zeros((N, 1))))
    weigh = judge(take, late, candidate(Given("alike", shifted(time, 0.3))))
    weigh.bank.add_all(late, [{"delay": x} for x in (0.1, 0.102, 0.104, 0.106)])  # made fine beside another
    best = weigh.score([a for a in weigh.bank.atoms if a.candidate is not late])
    own, rival = alternatives(weigh, best, best.fit.terms[0])
    assert abs(rival.evidence - own.evidence) < 20
    (found,) = value_of(rival if names(own) == names(best) else own, "late")
    assert found == pytest.approx(0.3, abs=0.02)


def test_the_larger_effect_is_named_when_its_second_number_matters():
    rng = np.random.default_rng(0)
    a, b = smooth(rng, (2, N))
    take = on_shoulder(6 * a + 5 * b, rng.normal(size=(N, 2)))
    larger = Given("asymmetric", np.stack([a, b], -1), excludes=("symmetric",))
    found = search(judge(take, candidate(larger), candidate(Given("symmetric", a))))
    assert names(found[0]) == {("asymmetric", "shoulder")}


@pytest.mark.parametrize(
    ("strength", "second", "bent", "expected"),
    [
        (6.0, 0.3, 0.0, {"dry", "viscous"}),
        (6.0, 6.0, 0.0, {"warming"}),
        (100.0, 0.3, 0.0, {"dry", "viscous"}),  # above the noise, and less than any right law is exact to
        (100.0, 0.6, 0.06, {"dry", "viscous"}),  # as much as this bearing differs from its formula
        (100.0, 0.6, 0.0, {"warming"}),  # as little, but it is all that is left
    ],
)
def test_friction_that_changes_little_is_dry_and_viscous(strength, second, bent, expected):
    """The columns of a drift are those of dry and viscous friction, but for the first seconds of a take."""
    rng = np.random.default_rng(0)
    dry, viscous, later, bearing = smooth(rng, (4, N))
    both = np.stack([dry + 0.1 * second * later, viscous], -1)
    take = on_shoulder(strength * (both[:, 0] + 0.8 * viscous + bent * bearing), 2 * rng.normal(size=(N, 2)))
    wide = {"lower": -1e3, "upper": 1e3}
    drift = Given("warming", both, excludes=("dry", "viscous"), **wide)
    drift.special_cases = frozenset({"dry", "viscous"})  # type: ignore[misc]
    parts = (Given(name, column, **wide) for name, column in (("dry", dry), ("viscous", viscous)))
    weigh = judge(take, candidate(drift), *map(candidate, parts))
    found = _simplify(weigh, weigh.score(weigh.bank.atoms[:1]))
    assert names(found) == {(name, "shoulder") for name in expected}


@pytest.mark.parametrize(("strength", "bent"), [(6.0, True), (3.3, False)])
def test_where_both_are_good_to_the_noise_a_twentieth_of_the_joints_evidence_keeps_the_richer_law(strength, bent):
    rng = np.random.default_rng(0)
    a, b, bearing, elsewhere = smooth(rng, (4, N))
    noise = rng.normal(size=(N, 2))
    shoulder = strength * a + 0.4 * b + 0.2 * bearing
    take = signals(noise / noise.std(0) + np.stack([shoulder, 9 * elsewhere], -1))  # the elbow's evidence is the most
    plain, rich = Given("dry", a), Given("warming", np.stack([a, b], -1), excludes=("dry",))
    plain.misfit = 0.02  # type: ignore[misc]
    rich.special_cases = frozenset({"dry"})  # type: ignore[misc]
    weigh = judge(take, candidate(plain), candidate(rich), candidate(Given("elsewhere", elsewhere), 1))
    dry, warming, elbow = weigh.bank.atoms
    simple, more = weigh.score([dry, elbow]), weigh.score([warming, elbow])
    assert not weigh.is_open(simple.fit).any()
    assert weigh.within_misfit(simple.fit, more.fit)
    assert SEARCH.richer < weigh.closes(simple.fit, more.fit) < SEARCH.all
    assert _is_bent(weigh, simple, more, 0) == bent
    offered = {key[0] for s in alternatives(weigh, simple, dry) for key in names(s)}
    assert ("warming" not in offered) == bent  # what was given up is no rival


@pytest.mark.parametrize(
    ("difference", "bearing", "bent"),
    [(0.16, 0.05, True), (0.24, 0.05, False), (0.24, 0.5, True)],  # the last one is little beside what else is left
)
def test_friction_that_differs_by_direction_is_no_bearing_that_differs_from_its_formula(difference, bearing, bent):
    rng = np.random.default_rng(0)
    ahead, back, other = smooth(rng, (3, N))
    friction = (1 + difference / 2) * ahead + (1 - difference / 2) * back + bearing * other
    take, wide = on_shoulder(30 * friction, rng.normal(size=(N, 2))), {"lower": -1e3, "upper": 1e3}
    plain = Given("dry", ahead + back, **wide)
    rich = Given("by_direction", np.stack([ahead, back], -1), excludes=("dry",), **wide)
    plain.misfit = 0.02  # type: ignore[misc]
    rich.special_cases, rich.sets_apart = frozenset({"dry"}), (("p0", "p1"),)  # type: ignore[misc]
    weigh = judge(take, candidate(plain), candidate(rich))
    simple, more = (weigh.score([atom]) for atom in weigh.bank.atoms)
    assert weigh.is_open(simple.fit).any()
    assert weigh.within_misfit(simple.fit, more.fit)
    assert weigh.closes(simple.fit, more.fit) < SEARCH.all
    assert _is_bent(weigh, simple, more, 0) == bent


@pytest.mark.parametrize(
    ("dry", "viscous", "expected"),
    [
        ((1.0, 1.0), (0.1, 0.1), False),
        ((1.3, 0.7), (0.1, 0.1), True),
        ((1.0, 1.0), (0.002, 0.001), False),  # by a factor of two, of nothing
        ((1.0, 1.0), (1.0, 0.2), True),
    ],
)
def test_friction_as_a_whole_has_to_differ_by_direction(dry, viscous, expected):
    effect = AsymmetricFriction()
    law = Candidate(effect, 1, "elbow", effect.parameters(arm(), address(), 1))
    assert [p.name.split("_")[0] for p in law.parameters] == ["coulomb", "coulomb", "viscous", "viscous"]
    assert _is_sided(law, np.array([*dry, *viscous])) is expected
    stiff = CoulombFriction()
    assert not _is_sided(Candidate(stiff, 1, "elbow", stiff.parameters(arm(), address(), 1)), np.array([1.0, 0.0]))


def test_a_stand_in_for_two_effects_is_given_up_for_the_two():
    """Stand-ins fill the beam; each is better than either cause, and keeps the second out: only an exchange helps."""
    rng = np.random.default_rng(1)
    a, b, *others = rng.normal(size=(SEARCH.beam + 3, N))
    stand_ins = {f"stand_in_{k}": a + b + e for k, e in enumerate(others)}
    effects = [Given("a", a), Given("b", b), *(Given(n, c, excludes=["b", *stand_ins]) for n, c in stand_ins.items())]
    take = on_shoulder(8 * (a + b), rng.normal(size=(N, 2)))
    weigh = judge(take, *(candidate(e) for e in effects))
    single = sorted(weigh.bank.atoms, key=lambda atom: weigh.score([atom]).evidence)
    assert {atom.candidate.effect.name for atom in single[: SEARCH.beam]} <= set(stand_ins)
    assert names(search(weigh)[0]) == {("a", "shoulder"), ("b", "shoulder")}


def test_two_effects_are_merged_into_the_one_that_says_the_same():
    """Wrong gains are a weaker motor with more friction: one cause is likelier than two."""
    rng = np.random.default_rng(0)
    a, b = smooth(rng, (2, N))
    take = on_shoulder(6 * a + 5 * b, rng.normal(size=(N, 2)))
    one = Given("gains", np.stack([a, b], -1), excludes=("motor",))
    weigh = judge(take, candidate(Given("motor", a)), candidate(Given("friction", b)), candidate(one))
    two = weigh.score(weigh.bank.atoms[:2])
    assert names(_merge(weigh, two)) == {("gains", "shoulder")}


def test_two_effects_that_no_single_one_replaces_stay():
    rng = np.random.default_rng(0)
    a, b, c = smooth(rng, (3, N))
    take = on_shoulder(6 * a + 5 * b, rng.normal(size=(N, 2)))
    weigh = judge(take, candidate(Given("a", a)), candidate(Given("b", b)), candidate(Given("c", c)))
    two = weigh.score(weigh.bank.atoms[:2])
    assert names(_merge(weigh, two)) == {("a", "shoulder"), ("b", "shoulder")}


def test_the_same_delay_on_all_joints_is_a_clocks():
    rng = np.random.default_rng(0)
    time = STEP * np.arange(N)
    missing = np.stack([shifted(time, 0.2)] * 2, -1)

    class Everywhere(Shifted):
        whole_robot = True

        def fingerprint(self, s, joint, fixed):
            late = np.stack([shifted(s.time, fixed["delay"])] * 2, -1)
            return Fingerprint(np.zeros((*late.shape, 0)), fixed, late)

    column = np.zeros(N)
    late = [candidate(Shifted("late", column), joint) for joint in (0, 1)]
    clock = replace(candidate(Everywhere("clock", column, excludes=("late",))), joint_name=None)
    weigh = judge(signals(missing + rng.normal(size=(N, 2))), *late, clock)
    both = [next(a for a in weigh.bank.atoms if a.candidate is c and a.fixed["delay"] == 0.2) for c in late]
    assert names(_merge(weigh, weigh.score(both))) == {("clock", None)}


def test_what_closes_no_material_share_is_not_kept():
    rng = np.random.default_rng(0)
    a, b = smooth(rng, (2, N))
    take = on_shoulder(9 * a + 0.8 * b, 4 * rng.normal(size=(N, 2)))
    found = search(judge(take, candidate(Given("a", a)), candidate(Given("b", b))))
    assert names(found[0]) == {("a", "shoulder")}


def test_the_first_answer_has_the_best_evidence_and_no_answer_comes_twice():
    rng = np.random.default_rng(0)
    a, b = smooth(rng, (2, N))
    twin = a + 0.2 * rng.normal(size=N)
    take = on_shoulder(5 * a + 5 * b, rng.normal(size=(N, 2)))
    found = search(judge(take, *(candidate(Given(*c)) for c in (("a", a), ("b", b), ("twin", twin)))))
    assert [s.evidence for s in found] == sorted(s.evidence for s in found)
    assert len({frozenset(names(s)) for s in found}) == len(found)


def test_progress_goes_up_to_the_depth_that_is_left():
    told = []
    rng = np.random.default_rng(0)
    a = smooth(rng, N)
    search(judge(on_shoulder(5 * a, rng.normal(size=(N, 2))), candidate(Given("a", a))), told.append)
    assert told == sorted(told)
    assert 0 < told[0] <= told[-1] <= 1


def test_a_delay_between_two_grid_points_is_found():
    rng = np.random.default_rng(0)
    time = STEP * np.arange(N)
    for true in (0.13, 0.17, 0.31):
        take = on_shoulder(shifted(time, true), rng.normal(size=(N, 2)))
        found = search(judge(take, candidate(Shifted("late", np.empty((0, 1))))))
        assert names(found[0]) == {("late", "shoulder")}
        assert value_of(found[0], "late")[0] == pytest.approx(true, abs=0.2 / 8)


def test_an_effect_that_is_not_linear_is_weighed_near_the_value_that_it_has():
    """An inertia grows with the square of a distance: told from one that does not by that alone."""
    rng = np.random.default_rng(0)
    linear, square = 5 * smooth(rng, N), 2 * smooth(rng, N)
    curved = Curved("curved", np.stack([linear, square], -1))
    for true in (-1.3, 0.4, 2.0):
        take = on_shoulder(true * linear + true**2 * square, rng.normal(size=(N, 2)))
        weigh = judge(take, candidate(curved))
        found = weigh.score(weigh.bank.atoms)
        assert value_of(found, "curved")[0] == pytest.approx(true, abs=0.05)
        assert weigh.excess(found.fit).max() < 0.1 * weigh.excess(weigh.bare).max()


# --- weighing ---


def test_a_term_that_predicts_nothing_costs_its_numbers():
    rng = np.random.default_rng(0)
    take = on_shoulder(5 * smooth(rng, N))
    idle = np.full(N, 1.0)
    idle[1::2] = -1.0  # of no correlation with anything slow
    one, two = Given("one", idle), Given("two", np.stack([idle, np.roll(idle, 1) * np.linspace(0, 1, N)], -1))
    weigh = judge(take, candidate(one), candidate(two))
    nothing = weigh.score(())
    price = np.log(2 * N) + SEARCH.term
    assert weigh.score(weigh.bank.atoms[:1]).evidence - nothing.evidence == pytest.approx(price, abs=2)
    assert weigh.score(weigh.bank.atoms[1:]).evidence - nothing.evidence == pytest.approx(
        2 * price - SEARCH.term, abs=4
    )


def test_evidence_is_the_likelihood_of_independent_samples():
    rng = np.random.default_rng(0)
    take = signals(10 * rng.normal(size=(N, 2)))
    halved = signals(5 * take.missing / 10)
    gain = judge(take).score(()).evidence - judge(halved).score(()).evidence
    assert gain == pytest.approx(2 * N * np.log(4))
    few = np.array([[2.0], [4.0]]) * np.ones(5)
    gain = judge(take).score((), few).evidence - judge(halved).score((), few).evidence
    assert gain == pytest.approx(30 * np.log(4))


def test_below_the_floor_nothing_is_gained():
    take, quieter = (signals(np.full((N, 2), level)) for level in (0.9, 0.1))
    assert judge(take).score(()).evidence == pytest.approx(judge(quieter).score(()).evidence, abs=0.2)


def test_the_share_closed_is_that_of_what_was_open():
    column = np.where(np.arange(N) % 2, 1.0, -1.0)
    weigh = judge(on_shoulder(5 * column + 3.0), candidate(Given("a", column)))
    before, after = weigh.bank.fit(()), weigh.bank.fit(weigh.bank.atoms)
    assert weigh.closes(before, after) == pytest.approx(25 / (25 + 9 - 1), rel=1e-3)
    assert weigh.closes(before, before) == 0


def test_a_joint_that_was_never_valid_or_lies_below_the_floor_hides_no_other():
    rng = np.random.default_rng(0)
    column = smooth(rng, N)
    both = np.stack([column, column], -1)[:, :, None]  # reaches the elbow, too
    for elbow, valid in ((0.0, False), (0.5, True)):
        usable = np.tile([True, valid], (N, 1))
        take = signals(np.stack([5 * column, elbow * column], -1) + rng.normal(size=(N, 2)) * [1, 0], usable)
        found = search(judge(take, candidate(Given("a", both * [[5.0], [elbow]]))))
        assert names(found[0]) == {("a", "shoulder")}


def test_what_happens_in_one_second_of_a_hundred_is_found():
    rng = np.random.default_rng(0)
    column = np.zeros(10 * N)
    column[500:600] = smooth(rng, 100)
    noise = rng.normal(size=(10 * N, 2))
    take = signals(np.stack([4 * column, 0 * column], -1) + noise)
    assert (take.missing**2).mean(0).max() < 1.2
    others = [candidate(Given(str(k), c)) for k, c in enumerate(smooth(rng, (5, 10 * N)))]
    found = search(judge(take, candidate(Given("rare", column)), *others))
    assert names(found[0]) == {("rare", "shoulder")}
    assert value_of(found[0], "rare") == pytest.approx([4], abs=0.5)


def test_something_unknown_in_one_stretch_does_not_bend_what_the_rest_says():
    rng = np.random.default_rng(0)
    column = smooth(rng, 5 * N)
    push = np.zeros(5 * N)
    push[1000:1150] = 60.0 * column[1000:1150]
    take = signals(np.stack([3 * column + push, 0 * column], -1) + rng.normal(size=(5 * N, 2)))
    found = search(judge(take, candidate(Given("a", column))))
    assert value_of(found[0], "a") == pytest.approx([3], abs=0.15)


def test_a_number_that_somebody_wrote_is_doubted_later_than_one_that_nobody_wrote():
    rng = np.random.default_rng(0)
    column = smooth(rng, N)
    take = on_shoulder(5 * column, rng.normal(size=(N, 2)))
    written, unwritten = Given("mass", column), Given("rotor", column)
    written.odds = 1 / 3  # type: ignore[misc]
    weigh = judge(take, candidate(written), candidate(unwritten))
    assert names(search(weigh)[0]) == {("rotor", "shoulder")}
    mass, rotor = (weigh.score([atom]).evidence for atom in weigh.bank.atoms)
    assert mass - rotor == pytest.approx(2 * np.log(3))


def test_correlated_rows_count_for_less():
    take = signals(np.zeros((N, 2)))
    wide = signals(np.zeros((N, 2)))
    object.__setattr__(wide, "kernel", 4 * take.kernel)
    counts = [Judge(Bank([s], [], noise=np.ones(2))).independent for s in (take, wide)]
    np.testing.assert_allclose([c.sum(1) for c in counts], [[N, N], [N / 4, N / 4]])


# --- rivals ---


def two_alike(similarity: float):
    rng = np.random.default_rng(0)
    a, other, b = smooth(rng, (3, N))
    alike = similarity * a + np.sqrt(1 - similarity**2) * other
    take = on_shoulder(5 * a + 5 * b, rng.normal(size=(N, 2)))
    weigh = judge(take, *(candidate(Given(*c)) for c in (("a", a), ("alike", alike), ("b", b))))
    best = weigh.score([weigh.bank.atoms[0], weigh.bank.atoms[2]])
    return weigh, best, best.fit.terms[0]


def probabilities(rivals) -> np.ndarray:
    odds = np.exp(-0.5 * (np.array([s.evidence for s in rivals]) - rivals[0].evidence))
    return odds / odds.sum()


def test_identical_columns_tie():
    rivals = alternatives(*two_alike(1.0))
    found = [names(s) - {("b", "shoulder")} for s in rivals]
    assert sorted(found, key=sorted) == [{("a", "shoulder")}, {("alike", "shoulder")}]
    np.testing.assert_allclose(probabilities(rivals), 0.5, atol=1e-6)


def test_the_more_alike_a_rival_the_nearer_its_evidence():
    gaps = [np.diff([s.evidence for s in alternatives(*two_alike(x))])[0] for x in (0.999, 0.99, 0.9)]
    assert all(later > sooner for sooner, later in itertools.pairwise(gaps))
    assert gaps[-1] > 100


def test_the_term_itself_is_among_its_alternatives_and_the_others_stay():
    weigh, best, term = two_alike(0.9)
    rivals = alternatives(weigh, best, term)
    assert names(rivals[0]) == names(best)
    assert all(("b", "shoulder") in names(s) for s in rivals)
    assert [s.evidence for s in rivals] == sorted(s.evidence for s in rivals)


def test_the_same_statement_with_more_numbers_is_no_rival():
    rng = np.random.default_rng(0)
    a, b = smooth(rng, (2, N))
    larger = Given("asymmetric", np.stack([a, b], -1), excludes=("symmetric",))
    for second, expected in ((0.0, {"symmetric"}), (5.0, {"symmetric", "asymmetric"})):
        take = on_shoulder(6 * a + second * b, rng.normal(size=(N, 2)))
        weigh = judge(take, candidate(larger), candidate(Given("symmetric", a)))
        best = weigh.score(weigh.bank.atoms[1:])
        rivals = alternatives(weigh, best, best.fit.terms[0])
        assert {key[0] for s in rivals for key in names(s)} == expected


def test_a_richer_rival_that_closes_nothing_more_is_at_most_an_equal():
    rng = np.random.default_rng(0)
    a, b = smooth(rng, (2, N))
    take = on_shoulder(6 * a + 0.8 * b, 4 * rng.normal(size=(N, 2)))  # the data do prefer the richer one, by little
    weigh = judge(take, candidate(Given("rich", np.stack([a, b], -1))), candidate(Given("plain", a)))
    best = weigh.score(weigh.bank.atoms[1:])
    rivals = {key[0]: s.evidence for s in alternatives(weigh, best, best.fit.terms[0]) for key in names(s)}
    assert rivals["rich"] == rivals["plain"]


def special(columns: np.ndarray, *names: str) -> Given:
    """A law of friction that contains others, which it does not exclude."""
    rich = Given("rich", columns, -1e3, 1e3)
    rich.family, rich.special_cases = "friction", frozenset(names)  # type: ignore[misc]
    return rich


def test_what_a_bearing_is_beyond_a_formula_makes_no_rival_of_a_richer_law():
    rng = np.random.default_rng(0)
    a, b = smooth(rng, (2, N))
    plain = Given("plain", a, -1e3, 1e3)
    plain.misfit = 0.02  # type: ignore[misc]
    for beyond, expected in ((4.0, {"plain"}), (40.0, {"plain", "rich"})):  # parts of 100 that no formula has
        take = on_shoulder(100 * a + beyond * b, rng.normal(size=(N, 2)))
        weigh = judge(take, candidate(plain), candidate(special(np.stack([a, b], -1), "plain")))
        best = weigh.score(weigh.bank.atoms[:1])
        assert weigh.is_open(best.fit)[0]
        assert {key[0] for s in alternatives(weigh, best, best.fit.terms[0]) for key in names(s)} == expected


def test_a_law_that_contains_the_term_pays_for_each_number_by_how_much_is_recorded():
    rng = np.random.default_rng(0)
    a, b = smooth(rng, N), rng.normal(size=N)
    take = on_shoulder(6 * a + 0.6 * b, rng.normal(size=(N, 2)))
    against = []
    for contains in ((), ("plain",)):
        weigh = judge(take, candidate(Given("plain", a)), candidate(special(np.stack([a, b], -1), *contains)))
        best = weigh.score(weigh.bank.atoms[:1])
        evidence = {key[0]: s.evidence for s in alternatives(weigh, best, best.fit.terms[0]) for key in names(s)}
        against.append(evidence["rich"] - evidence["plain"])
    assert against[1] - against[0] == pytest.approx(np.log(weigh.independent.sum()) - SEARCH.rival_price, rel=0.03)


def test_a_correlated_residual_makes_rivals_nearer():
    rng = np.random.default_rng(0)
    a, other = smooth(rng, (2, N))
    alike = 0.9 * a + 0.4 * other
    gaps = []
    for unknown in (3 * rng.normal(size=N), 3 * smooth(rng, N, 0.98)):
        weigh = judge(on_shoulder(5 * a + unknown), candidate(Given("a", a)), candidate(Given("alike", alike)))
        best = weigh.score(weigh.bank.atoms[:1])
        first, second = alternatives(weigh, best, best.fit.terms[0])
        gaps.append(second.evidence - first.evidence)
    assert gaps[1] < 0.3 * gaps[0]


# --- the sums behind a weighing, by hand ---


def levels(*squares: float) -> np.ndarray:
    """A torque with these mean squares in the five stretches of the take."""
    return np.repeat(np.sqrt(squares), N // 5) * np.where(np.arange(N) % 2, 1.0, -1.0)


def test_what_is_usual_is_the_median_of_a_joints_stretches_and_what_is_beyond_the_floor_weighs_by_its_rows():
    valid = np.ones((N, 2), dtype=bool)
    valid[20 : N // 5] = False
    weigh = judge(signals(np.stack([levels(9.0, 0.5, 0.6, 0.7, 0.8), np.zeros(N)], -1), valid))
    assert weigh.usual(weigh.bare) == pytest.approx([0.7, 0.0])
    assert weigh.excess(weigh.bare) == pytest.approx([20 * (9.0 - weigh.floor[0, 0]) / (4 * N / 5 + 20), 0.0])
    assert weigh.floor[0] == pytest.approx(1.0 + SEARCH.accuracy**2 * np.array([9.0, 0.5, 0.6, 0.7, 0.8]))


@pytest.mark.parametrize(("one", "others", "is_open"), [(1.68, 0.5, False), (1.85, 0.5, True), (1.3, 1.3, True)])
def test_one_stretch_is_open_beyond_what_chance_makes_of_its_samples(one, others, is_open):
    """200 samples scatter by a tenth, of which four are allowed beyond a quarter; all together by no more than that."""
    weigh = judge(on_shoulder(levels(one, others, others, others, others)))
    assert weigh.is_open(weigh.bare).tolist() == [is_open, False]


def test_evidence_is_likelihood_price_strain_and_doubt():
    """A trim that has to take up a torque of twice its tolerance speaks against the combination, as a ridge would."""
    rng = np.random.default_rng(0)
    a, b, c = smooth(rng, (3, N))
    take = on_shoulder(5 * a + 0.8 * b, rng.normal(size=(N, 2)))
    doubtful = Given("a", np.stack([a, c], -1))
    doubtful.odds = 0.2  # type: ignore[misc]
    trim = Given("trim", b, lower=-1.0, upper=1.0)
    trim.odds = 0.1  # type: ignore[misc]  # which is no name, so that nothing speaks against it
    weigh = Judge(Bank([take], [candidate(doubtful)], [candidate(trim)], noise=np.ones(2)))
    for atoms, doubt in (((), 0.0), (weigh.bank.atoms, -2 * np.log(0.2))):
        scored = weigh.score(atoms)
        likelihood = float((weigh.independent * np.log(np.maximum(weigh.mean_square(scored.fit), weigh.floor))).sum())
        price = (2 * np.log(2 * N) + SEARCH.term) * len(atoms)  # of two numbers
        assert scored.fit.strain > 1.0
        assert scored.evidence == pytest.approx(likelihood + price + scored.fit.strain + doubt)
        promised = weigh.promise(atoms, scored.fit)  # with the weights that it has itself: the same but for the name
        assert promised == pytest.approx(scored.evidence - doubt, abs=0.01)


def test_trims_take_nothing_from_what_is_bare_and_what_they_leave_is_usual():
    trim = candidate(Given("trim", FAST))
    weigh = Judge(Bank([on_shoulder(4 * FAST + 2 * SLOW)], [], [trim], noise=np.ones(2)), noisy=[0])
    np.testing.assert_allclose(weigh.mean_square(weigh.bare)[0], 4.0**2 + 2.0**2)
    np.testing.assert_allclose(weigh.floor[0], SEARCH.open * 2.0**2, rtol=0.01)


def test_a_parameter_costs_the_logarithm_of_the_samples_that_are_said_to_be_independent():
    weigh = judge(on_shoulder(levels(9.0, 9.0, 9.0, 9.0, 9.0)), candidate(Given("idle", SLOW)))
    few = np.full((2, 5), 2.0)
    price = weigh.score(weigh.bank.atoms, few).evidence - weigh.score((), few).evidence
    assert price == pytest.approx(np.log(20.0) + SEARCH.term, abs=0.1)
    dear, free = (weigh.score(weigh.bank.atoms, few, own).evidence for own in (7.0, 0.0))
    assert dear - free == pytest.approx(7.0)  # unless another price is said


def test_the_joint_on_which_a_step_does_most_is_that_of_the_evidence_and_not_of_the_energy():
    excess, level = np.array([[999.0, 10.0], [899.0, 0.0]]), np.array([[[1e3], [11.0]], [[900.0], [1.0]]])
    asked = SimpleNamespace(excess=lambda k: excess[k], level=lambda k: level[k], independent=np.ones((2, 1)))
    assert Judge._closed(asked, 0, 1) == (1, 1.0)


def step(excess_before, excess_after, energy=((0.0, 0.0),), misfits=(0.02,), joints=(0,), bare=(100.0, 100.0)):
    """Whether a step stays within what terms of some misfit may leave, of two joints with 4 samples each."""
    terms = [
        SimpleNamespace(candidate=SimpleNamespace(joint=joint, effect=SimpleNamespace(misfit=misfit)))
        for joint, misfit in zip(joints, misfits, strict=True)
    ]
    judge = SimpleNamespace(
        bare=SimpleNamespace(excess=np.array(bare)),
        total=np.ones((2, 4)),
        excess=lambda fit: np.asarray(fit.excess),
        _closed=lambda before, after: (0, 0.5),
    )
    before = SimpleNamespace(excess=excess_before, terms=terms, energy=np.array(energy))
    return Judge.within_misfit(judge, before, SimpleNamespace(excess=excess_after))


@pytest.mark.parametrize(
    ("given", "within"),
    [
        ({"energy": [[400.0, 0.0]]}, True),  # of a mean square of 100 a fiftieth: 2
        ({"energy": [[400.0, 0.0]], "misfits": (0.01,)}, False),
        ({"energy": [[200.0, 0.0]]}, False),
        ({"energy": [[200.0, 0.0]] * 2, "misfits": (0.02, 0.04), "joints": (0, 0)}, True),  # the larger of two
        ({"energy": [[4000.0, 0.0]], "bare": (50.0, 100.0)}, False),  # terms that cancel miss no more than all that is
        ({"energy": [[0.0, 400.0]], "joints": (1,)}, False),  # another joint's misfit is no excuse
        ({"energy": [[400.0, 400.0]], "joints": (1,)}, False),
        ({"energy": np.zeros((0, 2)), "misfits": (), "joints": ()}, False),
    ],
)
def test_a_term_may_leave_its_misfit_of_what_it_explains_and_of_all_that_was_missing(given, within):
    assert step((3.0, 9.0), (1.5, 0.0), **given) is within


@pytest.mark.parametrize(
    ("share", "within", "scatters", "strain", "helps"),
    [
        (0.2, False, [9.0], 0.0, True),  # a material share beyond any misfit
        (0.05, False, [0.0], 0.0, False),
        (0.05, False, [9.0], 6.0, True),  # the trims are relieved
        (0.05, False, [9.0], -6.0, False),
        (0.2, True, [0.05], 0.0, False),  # within a misfit it must close much
        (0.4, True, [0.05], 0.0, True),
        (0.4, True, [0.2], 0.0, False),  # and be the same everywhere
        (0.4, True, [0.05, 0.2], 0.0, False),  # all that is new
    ],
)
def test_a_step_helps_that_closes_much_or_is_no_stand_in(share, within, scatters, strain, helps, monkeypatch):
    monkeypatch.setattr("torchrl_athletic.diagnosis.search.scatter", lambda bank, fit, term: term.scatter)
    asked = SimpleNamespace(_closed=lambda *_: (0, share), within_misfit=lambda *_: within, bank=None)
    old = SimpleNamespace(candidate=SimpleNamespace(key=("old", "hip")), scatter=9.0)  # which is not asked about
    new = [
        SimpleNamespace(candidate=SimpleNamespace(key=(f"new{k}", "hip")), scatter=x) for k, x in enumerate(scatters)
    ]
    before, after = SimpleNamespace(terms=[old], strain=strain), SimpleNamespace(terms=[old, *new], strain=0.0)
    assert Judge.helps(asked, before, after) is helps


def test_where_nothing_was_open_nothing_is_closed():
    weigh = judge(on_shoulder(levels(*[0.5] * 5)))
    assert weigh.closes(weigh.bare, weigh.bare) == 0.0


def test_a_search_may_go_as_deep_as_all_joints_together_have_effects():
    told = []
    rng = np.random.default_rng(0)
    a = smooth(rng, N)
    search(judge(on_shoulder(5 * a, rng.normal(size=(N, 2))), candidate(Given("a", a))), told.append)
    assert told[0] == pytest.approx(1 / (2 * SEARCH.most_per_joint))


@pytest.mark.parametrize("takes", [1, 2, 3, 4])
def test_scatter_is_that_of_the_strengths_between_takes_or_between_parts_of_a_few(takes):
    """One or two takes are compared sixth by sixth; two sixths are a third of all rows, wherever a take ends."""
    column = np.where(np.arange(N) % 2, 1.0, -1.0)
    rows = np.arange(takes * N)
    strengths = [2.0, 4.0, 3.0, 3.0][:takes] if takes > 2 else [2.0, 2.0, 4.0, 4.0, 4.0, 4.0]
    along = np.array(strengths)[rows * len(strengths) // len(rows)]
    given = [on_shoulder(along[k * N : (k + 1) * N] * column) for k in range(takes)]
    bank = Bank(given, [candidate(Given("a", column, upper=1.0))], noise=np.ones(2))
    fit = bank.fit(bank.atoms)  # a third of what it would be: its scatter is relative to what it should be
    expected = np.std(strengths) / np.mean(strengths)
    assert scatter(bank, fit, fit.terms[0]) == pytest.approx(expected, rel=0.02)


# --- which richer law, which rival, which noise ---

FAST, SLOW, SLOWER = (np.tile(np.repeat([1.0, -1.0], n), N // (2 * n)) for n in (1, 2, 4))
"""Unit columns that have nothing in common."""


@pytest.mark.parametrize(("second", "expected"), [(0.118, None), (0.16, {"asymmetric"})])
def test_a_richer_law_that_is_not_decisively_better_is_not_asked_about(second, expected):
    """Both close over a twentieth of what is open, and gain 12.6 and 22.9, less 7.6 as the price of a number."""
    take = on_shoulder(9 * FAST + second * SLOW + 1.05 * SLOWER)
    larger = Given("asymmetric", np.stack([FAST, SLOW], -1), excludes=("symmetric",))
    weigh = judge(take, candidate(larger), candidate(Given("symmetric", FAST)))
    rich = richer(weigh, weigh.score(weigh.bank.atoms[1:]))
    assert (None if rich is None else {name for name, _ in names(rich)}) == expected


def test_a_richer_law_that_closes_much_is_asked_about_however_little_its_evidence_is_beside_what_was_found():
    take = on_shoulder(9 * FAST + 0.6 * SLOW + 2 * SLOWER)
    larger = Given("asymmetric", np.stack([FAST, SLOW], -1), excludes=("symmetric",))
    weigh = judge(take, candidate(larger), candidate(Given("symmetric", FAST)))
    plain, rich = (weigh.score([atom]) for atom in weigh.bank.atoms[::-1])
    found, gained = weigh.score(()).evidence - plain.evidence, plain.evidence - rich.evidence
    assert SEARCH.decisive < gained < SEARCH.seen * found
    assert richer(weigh, plain) is rich


def test_of_two_richer_laws_the_likelier_is_asked_about_and_another_law_is_no_richer_one():
    take = on_shoulder(9 * FAST + 3 * SLOW + 2 * SLOWER)
    idle = np.tile(np.repeat([1.0, -1.0], 20), N // 40)
    laws = (("right", [FAST, SLOW]), ("wrong", [FAST, idle]), ("plain", [FAST]), ("other", [FAST + SLOW / 3]))
    weigh = judge(take, *(candidate(Given(n, np.stack(x, -1), excludes=("plain",))) for n, x in laws[:3]))
    plain = weigh.score([weigh.bank.atoms[2]])
    assert names(richer(weigh, plain)) == {("right", "shoulder")}
    few = judge(take, *(candidate(Given(n, np.stack(x, -1), excludes=("plain",))) for n, x in laws[2:]))
    plain, other = (few.score([atom]) for atom in few.bank.atoms)
    assert plain.evidence - other.evidence > SEARCH.decisive
    assert richer(few, plain) is None


def test_rivals_come_nearest_first_and_a_better_one_is_not_less_than_nothing_behind():
    """Four rivals differ by a hundredth each; the one that was found is neither the truth nor the worst."""
    rng = np.random.default_rng(0)
    a, other = smooth(rng, (2, N))
    effects = [(f"{k}", a + 0.01 * k * other) for k in (6, 2, 0, 1)]
    take = on_shoulder(6 * (a + 0.02 * other), rng.normal(size=(N, 2)))
    weigh = judge(take, *(candidate(Given(*e)) for e in effects))
    found = rivals(weigh, weigh.score([weigh.bank.atoms[2]]), within=100.0)
    behind = [x for _, x in found]
    assert behind == sorted(behind)
    assert behind[0] == 0.0
    assert names(found[2][0]) == {("6", "shoulder")}
    assert behind[2] > 10


def test_each_joint_has_effects_of_its_own_to_find():
    """Five in all, where a joint has four at most."""
    rng = np.random.default_rng(0)
    columns = dict(zip("abcde", smooth(rng, (5, N)), strict=True))
    shoulder, elbow = (5 * sum(columns[name] for name in joint) for joint in ("abc", "de"))
    take = signals(np.stack([shoulder, elbow], -1) + rng.normal(size=(N, 2)))
    given = [candidate(Given(name, column), int(name in "de")) for name, column in columns.items()]
    assert {name for name, _ in names(search(judge(take, *given))[0])} == set("abcde")


def test_a_term_that_is_decisive_and_closes_next_to_nothing_is_dropped():
    take = on_shoulder(9 * FAST + 0.8 * SLOW + 4 * SLOWER)
    weigh = judge(take, candidate(Given("a", FAST)), candidate(Given("b", SLOW)))
    one, both = weigh.score(weigh.bank.atoms[:1]), weigh.score(weigh.bank.atoms)
    assert one.evidence - both.evidence > SEARCH.decisive
    assert names(_prune(weigh, both)) == {("a", "shoulder")}


def test_an_effect_alone_that_stops_at_a_bound_is_told_in_neither_list():
    rng = np.random.default_rng(0)
    a, b = smooth(rng, (2, N))
    bounded, free = candidate(Given("bounded", a, upper=2.0)), candidate(Given("free", b))
    material, others = singles(judge(on_shoulder(6 * a + 3 * b, rng.normal(size=(N, 2))), bounded, free))
    assert {name for s in (*material, *others) for name, _ in names(s)} == {"free"}


def test_what_smoothing_bends_is_expected_of_the_joint_that_it_bends():
    bias = np.stack([np.full(N, 2.0), np.full(N, 3.0)], -1)
    weigh = judge(signals(np.zeros((N, 2)), bias=bias))
    np.testing.assert_allclose(noise_level(weigh.bank), np.repeat([[5.0], [10.0]], 5, 1))


@pytest.mark.parametrize(
    ("is_open", "usual", "share", "noisy"),
    [
        (True, 1.4, 0.05, True),
        (True, 1.2, 0.05, False),  # open now and then: 1.25 is what noise may do
        (False, 1.4, 0.05, False),
        (True, 1.4, 0.2, False),  # a part of it is predictable
    ],
)
def test_noise_is_what_is_open_all_the_time_and_cannot_be_predicted(is_open, usual, share, noisy, monkeypatch):
    monkeypatch.setattr("torchrl_athletic.diagnosis.search.predictable_share", lambda bank, joint: share)
    asked = SimpleNamespace(
        score=lambda atoms: SimpleNamespace(fit=None),
        is_open=lambda fit: np.array([False, is_open]),
        usual=lambda fit: np.array([9.0, usual]),
        floor=np.array([[1.0, 1.0, 1.0], [0.5, 1.0, 9.0]]),
        bank=None,
    )
    assert noisy_joints(asked) == [1] * noisy


def test_a_record_too_short_to_predict_a_part_from_the_rest_is_not_called_noise():
    noise = np.random.default_rng(0).normal(size=(N // 2, 2))
    weigh = judge(signals(3 * noise), candidate(Given("a", np.ones(N // 2))))
    assert predictable_share(weigh.bank, 0) == 1.0


def test_a_term_is_no_rival_of_itself_at_another_value():
    time = STEP * np.arange(N)
    take = on_shoulder(shifted(time, 0.2), np.random.default_rng(0).normal(size=(N, 2)))
    weigh = judge(take, candidate(Shifted("late", np.empty((0, 1)))))
    best = weigh.score([next(a for a in weigh.bank.atoms if a.fixed["delay"] == 0.1)])
    (own,) = alternatives(weigh, best, best.fit.terms[0])
    assert [a.fixed["delay"] for a in own.fit.terms] == [0.1]


@pytest.mark.parametrize(
    ("grid", "value", "bounds", "near"),
    [
        ((0.5, 1.0, 2.0, 4.0, 8.0), 2.0, (0.0, 10.0), [1.5, 3.0]),  # the nearest on either side
        ((1.0, 2.0), 2.0, (0.0, 10.0), [1.5, 2.5]),  # beyond an end as far as before it
        ((2.0, 4.0), 2.0, (0.0, 10.0), [1.0, 3.0]),
        ((1.0, 2.0), 2.0, (0.0, 2.2), [1.5, 2.2]),
        ((2.0, 4.0), 2.0, (1.7, 10.0), [1.7, 3.0]),
        ((2.0, 4.0), 2.0, (1.99, 2.5), [2.5]),  # a hundredth is no step
        ((2.0,), 2.0, (0.0, 10.0), []),
    ],
)
def test_a_grid_is_halved_to_both_sides_within_the_bounds(grid, value, bounds, near):
    assert _between(grid, value, *bounds) == near


@pytest.mark.parametrize(("found", "true"), [(0.1, 0.4), (0.4, 0.1), (0.1, 0.2), (0.2, 0.2)])
def test_a_grid_is_gone_down_either_way(found, true):
    time = STEP * np.arange(N)
    late = candidate(Shifted("late", np.empty((0, 1))))
    weigh = judge(on_shoulder(shifted(time, true)), late)
    start = weigh.score([next(a for a in weigh.bank.atoms if a.fixed["delay"] == found)])
    assert [a.fixed["delay"] for a in _down(weigh, start, late, "delay").fit.terms] == [true]


def test_what_is_usual_asks_nothing_of_any_joint_that_is_noisy():
    take = signals(np.stack([levels(*[4.0] * 5), levels(*[9.0] * 5)], -1), np.ones((N, 2), dtype=bool))
    floor = Judge(Bank([take], [], noise=np.ones(2)), noisy=[0, 1]).floor
    np.testing.assert_allclose(floor, SEARCH.open * np.repeat([[4.0], [9.0]], 5, axis=1))


def test_an_effect_alone_closes_nothing_of_what_trims_take():
    law, trim = candidate(Given("law", SLOW)), candidate(Given("trim", SLOW))
    material, others = singles(Judge(Bank([on_shoulder(3 * SLOW)], [law], [trim], noise=np.ones(2))))
    assert material == []
    assert len(others) == 1
