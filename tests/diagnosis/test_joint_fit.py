"""The search of the standard joints: what it must find, and what it must not fall for."""

import sys
from dataclasses import dataclass, replace
from types import SimpleNamespace

import mujoco
import numpy as np
import pytest
from diagnosis.plants import behind_a_spring, pendulum, smooth_torque
from diagnosis.test_descent import with_a_limit
from diagnosis.test_fitting import NOISE, RATE, STEP, integrated, parameter, recording
from diagnosis.test_problem import each_its_own, following, moving, take_like

from torchrl_athletic.diagnosis import fit
from torchrl_athletic.diagnosis import problem as windows_module
from torchrl_athletic.diagnosis.deadline import Deadline
from torchrl_athletic.diagnosis.descent import descend, linearise
from torchrl_athletic.diagnosis.joint_fit import (
    DOUBT,
    WORTH,
    affordable,
    folded,
    more_telling,
    over_needed,
    prune,
    search,
    stated,
    trusted,
    without_doubtful_limits,
    without_torques,
)
from torchrl_athletic.diagnosis.prepare import prepare
from torchrl_athletic.diagnosis.problem import TUNING, Problem, problem_of, weighed, window_cost
from torchrl_athletic.diagnosis.replay import Windows
from torchrl_athletic.diagnosis.standard import agreement, seen_in, standard_joints
from torchrl_athletic.recordings import Recording

module = sys.modules["torchrl_athletic.diagnosis.joint_fit"]
TABLE = """<mujoco><option timestep="0.005" gravity="0 0 0"/><worldbody><body><joint name="pendulum" axis="0 0 1"/>
  <inertial pos="0 0 0" mass="0.1" diaginertia="{0} {0} {0}"/></body></worldbody>
  <actuator><motor joint="pendulum" ctrlrange="-20 20"/></actuator></mujoco>"""


def turned(command, *, inertia, friction=0.0, damping=0.0, limit=np.inf, fine=10):
    """Positions of a turntable at the samples. Shape (T, 1)."""
    step, q, v, out = 1 / RATE / fine, 0.0, 0.0, []
    for k, u in enumerate(np.repeat(command[:, 0], fine)):
        if k % fine == 0:
            out.append(q)
        free = v + step * (np.clip(u, -limit, limit) - damping * v) / inertia
        v = np.sign(free) * max(abs(free) - step * friction / inertia, 0.0)
        q += step * v
    return np.array(out)[:, None] + NOISE * np.random.default_rng(0).standard_normal((len(out), 1))


@pytest.fixture(scope="module")
def swings():
    """Recordings with dry friction and a weak motor, and all that a search needs."""
    command = smooth_torque(4.0, 2.5, 1)
    take = recording(command, integrated(command, friction=0.1, scale=0.8))
    prepared = prepare([take], mujoco.MjModel.from_xml_string(pendulum(STEP)))
    h = standard_joints(prepared, seen_in(prepared))
    return h, prepared, {(c.effect.name, p.name): k for k, (c, p) in enumerate(h_places(h))}


def h_places(h):
    return [(c, p) for c in h.terms for p in c.parameters]


def test_a_descent_from_numbers_by_hand_never_ends_worse(swings):
    """The error that is stated, from near the truth and from far off."""
    h, prepared, at = swings
    problem = problem_of(h, prepared.takes, 0.5, 20, np.random.default_rng(0), h.nominal)
    for friction, scale in ((0.1, 0.8), (0.5, 0.3)):
        x = h.nominal
        x[at["coulomb_friction", "torque"]], x[at["torque_scale", "scale"]] = friction, scale
        own = weighed(replace(problem, tuning=np.inf), x)
        y = descend(own, x, h.bounds[1] > h.bounds[0], 2, Deadline())
        before, after = window_cost(own, own.mean_square(np.stack([x, y]))).mean(1)
        assert after <= before


def test_torques_tell_a_motion_that_coasts_from_one_that_is_driven(swings):
    """A rotor of a hundred links follows half a second of smooth motion, but not the torques."""
    h, prepared, at = swings
    truth, coasting = h.nominal, h.nominal
    truth[at["coulomb_friction", "torque"]], truth[at["torque_scale", "scale"]] = 0.1, 0.8
    coasting[at["reflected_inertia", "armature"]] = 9.0
    rows = agreement(h, prepared).rows(np.stack([truth, coasting]))
    cost = (rows**2).sum(0)
    assert cost[0] < 1.0
    assert cost[1] > 100 * cost[0]


@pytest.mark.slow
def test_a_wrist_whose_rotor_is_a_hundred_times_its_link_is_found():
    command = 3 * smooth_torque(4.0, 2.5, 2)
    take = recording(command, turned(command, inertia=0.101, damping=0.05))
    fitted = fit(TABLE.format(0.001), [take], extended=False)
    assert parameter(fitted, "reflected_inertia").value == pytest.approx(0.1, rel=0.05)


@pytest.mark.slow
def test_a_limit_at_a_fifth_of_the_largest_command_is_found():
    command = 4 * smooth_torque(4.0, 2.5, 3)
    limit = 0.2 * float(np.abs(command).max())
    take = recording(command, turned(command, inertia=0.1, damping=0.2, limit=limit))
    fitted = fit(TABLE.format(0.1), [take], extended=False)
    assert parameter(fitted, "torque_saturation").value == pytest.approx(limit, rel=0.03)


@pytest.mark.slow
def test_what_only_ratios_show_gets_no_numbers():
    """Without gravity or friction, a motor's scale and the inertia are one number: no interval excludes either."""
    command = smooth_torque(4.0, 2.5, 4)
    fitted = fit(TABLE.format(0.1), [recording(command, turned(command, inertia=0.1))], extended=False)
    both = [parameter(fitted, "torque_scale"), parameter(fitted, "reflected_inertia")]
    assert all(p.value == p.given for p in both)
    assert any(p.state == "not identified" for p in both)


@pytest.mark.slow
def test_a_resonance_comes_back_as_a_gear_and_not_as_damping():
    """A drive whose link swings behind the encoder at 6.8 Hz, and which has next to no friction."""
    stiffness, link, rotor, rng = 40.0, 0.05, 0.04, np.random.default_rng(1)
    time, command, read = behind_a_spring(stiffness, link, rotor, rng)
    xml = TABLE.format(link).replace('axis="0 0 1"', f'axis="0 0 1" armature="{rotor}"')
    position = read[:, None] + 1e-5 * rng.standard_normal((len(read), 1))
    fitted = fit(xml, [Recording(time, ("pendulum",), position, torque_command=command[:, None])])
    assert parameter(fitted, "viscous_friction").value < 0.05
    assert parameter(fitted, "compliance", name="stiffness").value == pytest.approx(stiffness, rel=0.15)
    assert fitted.scores["train"].after < 0.05 * fitted.scores["train"].before


@pytest.mark.slow
def test_without_any_time_there_is_a_result_all_the_same():
    command = smooth_torque(3.0, 2.5, 5)
    fitted = fit(pendulum(STEP), [recording(command, integrated(command, friction=0.1))], time_budget=0.0)
    assert fitted.scores["train"].after <= fitted.scores["train"].before
    assert fitted.parameters


WAVE = np.tile([-1.0, 1.0], 50)


def terms_of(*counts, effect="coulomb_friction"):
    """A term of each joint, with so many numbers."""
    law = SimpleNamespace(name=effect)
    return tuple(SimpleNamespace(joint=j, parameters=(None,) * n, effect=law) for j, n in enumerate(counts))


def told_by_costs(problem, count):
    """What is linearised of a problem whose folds are told by costs, in place of simulations."""
    return SimpleNamespace(problem=problem, free=np.ones(count, dtype=bool), seconds=0.0)


@dataclass(frozen=True)
class Costs:
    """A problem whose one parameter is worth ``stated`` and ``weighed`` errors a window, in place of simulations."""

    stated: np.ndarray
    weighed: np.ndarray
    tuning: float = 1.0

    @property
    def hypothesis(self) -> SimpleNamespace:
        return SimpleNamespace(terms=terms_of(1))

    def of(self, without: bool) -> np.ndarray:
        return 1.0 + without * (self.stated if np.isinf(self.tuning) else self.weighed)


@pytest.mark.parametrize(
    ("stated", "weighed", "needed"),
    [
        (0.5 * WORTH, 0.5 * WORTH, False),  # not worth having
        (0.9 * DOUBT * 0.2, 0.0, False),  # within what folds leave open: 0.2
        (1.1 * DOUBT * 0.2, 0.0, True),
        (0.0, 0.9 * DOUBT * 0.2, False),
        (0.0, 1.1 * DOUBT * 0.2, True),
    ],
)
def test_a_parameter_goes_where_folds_do_not_ask_for_it(monkeypatch, stated, weighed, needed):
    windows = np.tile([-2.0, 2.0], 50)  # a mean of zero, a deviation of two
    problem = Costs(stated + windows * (stated > WORTH), weighed + windows * (weighed > WORTH))
    near = told_by_costs(problem, 1)
    monkeypatch.setattr(module, "folds_of", lambda problem: np.zeros(100, dtype=int))
    monkeypatch.setattr(module, "independent", lambda problem: 100)
    monkeypatch.setattr(module, "folded", lambda near, trials, fold, first_order=False: [t.any() for t in trials])
    monkeypatch.setattr(module, "window_cost", lambda problem, trials: np.array([problem.of(t) for t in trials]))
    assert prune(near, Deadline(np.inf)).tolist() == [needed]
    assert prune(near, Deadline(0.0)).tolist() == [True]  # without time nothing is found to be worthless
    monkeypatch.setattr(module, "independent", lambda problem: 4)  # which leaves five times the doubt
    assert prune(near, Deadline(np.inf)).tolist() == [False]


def test_starts_mix_the_best_numbers_of_each_joint():
    h = SimpleNamespace(terms=[SimpleNamespace(joint=j, parameters=[None] * n) for j, n in ((0, 2), (1, 1))])
    square = np.array([[[3, 1]] * 3 + [[9, 99]], [[1, 2]] * 3 + [[99, 9]], [[2, 3]] * 4], dtype=float)
    begin = np.arange(3.0)[:, None] + [0.0, 0.25, 0.5]
    problem = moving(99.0, np.ones(2), np.ones(4), h=h)
    assert [x.tolist() for x in module._mixed(problem, square, begin, 2)] == [[1, 1.25, 0.5], [2, 2.25, 1.5]]
    assert len(module._mixed(problem, square, begin, 9)) == 3


def test_of_points_the_best_are_kept_once_each_and_the_torques_have_a_say(monkeypatch):
    problem, _ = following(monkeypatch, each_its_own(1.0, 1.0))
    points = [np.array([x]) for x in (4.0, 1.5, 1.5, 2.5, 0.9)]
    assert [x[0] for x in module.best_of(problem, points, 3)] == [0.9, 1.5, 2.5]
    torques = SimpleNamespace(rows=lambda values: 1e3 * (values[:, 0] - 1.5)[None])
    assert [x[0] for x in module.best_of(replace(problem, torques=torques), points, 2)] == [1.5, 0.9]
    assert [x[0] for x in module.best_of(problem, points, 3, mixed=2)] == [0.9, 1.5, 2.5]
    points = [np.array([1.1]), np.array([1.5])]  # of 25 and 1 times the least square error, 12.0 and 0.9 robustly
    for size, best in ((20.0, 1.1), (25.0, 1.5)):  # a fiftieth of the torques' squares: 8.0 and 12.5
        told = SimpleNamespace(rows=lambda values, size=size: size * (values[:, 0] < 1.3)[None])
        assert module.best_of(replace(problem, torques=told), points, 1)[0] == best


def test_a_joint_that_is_stuck_is_not_the_answer_where_most_windows_hold_still(monkeypatch):
    """Stuck beyond 5, it follows still windows best, and has no slope; free, it follows those that move at 4."""
    wave = np.repeat([0.0, 0.0, 1.0, 0.0, 1.0, 0.0, 1.0, 0.0, 1.0, 0.0, 0.0, 0.0], 4)
    take = take_like(49)
    take.wave = np.append(0.0, wave)
    take.measured[:, 0] = 4.0 * take.wave
    problem, _ = following(monkeypatch, Windows(take, 4 * np.arange(12), 4))

    def simulate(w, build, values):
        moves = w.take.wave[w.index][None, :, :, None]
        x = values[:, None, None, :]
        return np.where(x > 5.0, 0.0, x * moves + 0.01 * (1.0 - moves))

    monkeypatch.setattr(windows_module, "simulate", simulate)
    monkeypatch.setattr(module, "affordable", lambda *_: 12)
    monkeypatch.setattr(module, "problem_of", lambda *_, **told: problem)
    begin = np.array([[9.0], [1.0], [8.0]])
    found = search(problem.hypothesis, [SimpleNamespace()], begin, np.random.default_rng(0), Deadline())
    assert found.values == pytest.approx([4.0], rel=1e-3)


@pytest.mark.parametrize(
    ("asked", "limits", "begin", "found"),
    [
        ((3.0, 3.0), (9.0, 9.0), (12.0, 4.0, 1.0), (3.0, 3.0)),
        ((3.0, 5.0), (9.0, 9.0), (12.0, 4.0, 1.0), (3.0, 9.0)),  # windows ask for no limit below 5
        ((5.0, 5.0), (9.0, 9.0), (12.0, 4.0, 1.0), (9.0, 9.0)),
        ((3.0, 3.0), (9.0, 9.0), (12.0, 9.0, 8.95), (9.0, 9.0)),  # no start has a lower one
        ((4.95, 4.95), (9.0, 9.0), (12.0, 4.0, 1.0), (9.0, 9.0)),  # which saves less than a fiftieth
    ],
)
def test_a_torque_limit_that_is_not_met_is_tried_where_it_is(monkeypatch, asked, limits, begin, found):
    """Two joints that are driven with 5 move by that or by their limit, less noise of 0.5."""
    take = take_like(17, truth=list(asked))
    take.measured[1::2] += 0.5
    take.measured[2::2] -= 0.5
    problem, _ = following(monkeypatch, Windows(take, np.array([0, 4, 8, 12]), 4), nominal=(12.0, 12.0))

    def simulate(w, build, values):
        return np.minimum(values, 5.0)[:, None, None, :] * w.take.wave[w.index][None, :, :, None]

    monkeypatch.setattr(windows_module, "simulate", simulate)
    for term in problem.hypothesis.terms:
        term.effect.name = "torque_saturation"
    problem = replace(problem, tuning=np.inf)
    near = linearise(weighed(problem, x := np.array(limits)), x, np.ones(2, dtype=bool))
    points = np.column_stack([begin, begin])
    after = module._with_limits(near, problem, points, Deadline())
    assert after.values == pytest.approx(found, rel=1e-2)
    assert (after is near) is (found == limits)
    assert module._with_limits(replace(near, seconds=1.0), problem, points, Deadline(9.0)).seconds == 1.0
    unasked = replace(near, free=np.zeros(2, dtype=bool))
    assert module._with_limits(unasked, problem, points, Deadline()) is unasked


def test_of_two_joints_the_torques_have_their_say_once(monkeypatch):
    """Errors are a mean over joints: 12.0 and 0.9; of the torques' squares it is a hundredth, 9.0 or 13.0."""
    problem, _ = following(
        monkeypatch, Windows(take_like(9, truth=[1.0, 1.0]), np.array([0, 4]), 4), nominal=(0.0, 0.0)
    )
    points = [np.array([1.1, 1.1]), np.array([1.5, 1.5])]
    for size, best in ((30.0, 1.1), (36.0, 1.5)):
        told = SimpleNamespace(rows=lambda values, size=size: size * (values[:, 0] < 1.3)[None])
        assert module.best_of(replace(problem, torques=told), points, 1)[0][0] == best


def test_the_best_step_of_some_windows_is_by_what_they_weigh_in_units_and_with_the_torques(monkeypatch):
    """From 2 to 1, squares of windows that ask for 0 and 4 go from 4 and 4 to 1 and 9; torques ask for 5, 7 more."""
    torques = SimpleNamespace(rows=lambda values: 5.0 * (values[:, 0] - 5.0)[None])  # 0.02 · 2 windows · 25 = 1
    problem, _ = following(monkeypatch, each_its_own(0.0, 4.0))
    both, first = np.array([True, True]), np.array([True, False])
    for weight, unit, own, windows, good in (
        ((1.0, 3.0), 1.0, None, both, False),
        ((3.0, 1.0), 1.0, None, both, True),
        ((1.0, 3.0), 1.0, None, first, True),
        ((3.0, 1.0), 1.0, torques, both, False),
        ((3.0, 1.0), 0.5, torques, both, True),
    ):
        one = replace(problem, weight=np.array(weight), unit=np.array([unit]), torques=own)
        asked = []

        def step(told, held, ridge, windows=windows, asked=asked):
            assert told is windows
            assert not held.any()
            asked.append(ridge)
            return np.array([1.0 if ridge == module.RIDGE else 9.0])

        near = linearise(one, np.array([2.0]), np.array([True]))
        fake = SimpleNamespace(problem=one, values=near.values, free=near.free, errors=near.errors, step=step)
        assert module._best_ridge(fake, windows) == (module.RIDGE if good else module.STAYS)
        assert asked == [module.RIDGE, 1e-3, 1e-2, 1e-1, 1.0, 10.0]


@pytest.mark.parametrize(("mixed", "found"), [(0, [[1.0, 9.0]]), (1, [[1.0, 2.0]]), (2, [[1.0, 2.0], [5.0, 6.0]])])
def test_of_points_each_joints_best_numbers_are_tried_together_and_nothing_is_simulated_twice(
    monkeypatch, mixed, found
):
    """One point is right for the first joint, one for the second; the second best of both are together, too."""
    t = take_like(9, truth=[1.0, 2.0])
    problem, asked = following(monkeypatch, Windows(t, np.array([0, 4]), 4), nominal=(0.0, 0.0))
    points = [np.array(x) for x in ([1.0, 9.0], [9.0, 2.0], [5.0, 20.0], [20.0, 6.0], [1.0, 9.0])]
    best = [x.tolist() for x in module.best_of(problem, points, 6, mixed)]
    assert best[0] == found[0]
    assert all(x in best for x in found)
    simulated = np.concatenate(asked).tolist()
    assert len(simulated) == len({tuple(x) for x in simulated}) == 4 + mixed
    alone, asked = following(monkeypatch, each_its_own(1.0, 1.0))
    module.best_of(alone, [np.array([x]) for x in (4.0, 1.5, 2.5)], 3, mixed)
    assert len(np.concatenate(asked)) == 3  # of one joint what is mixed is there already


@pytest.mark.parametrize("first_order", [False, True])
@pytest.mark.parametrize(
    ("ridges", "square"),
    [((1e-6, 9.0, 1.0, 9.0), [16.0, 9.0]), ((1.0, 9.0, 1e-6, 9.0), [9.0, 16.0]), ((module.STAYS,) * 4, [4.0, 4.0])],
)
def test_each_fold_is_told_by_a_step_with_its_own_ridge(monkeypatch, first_order, ridges, square):
    """Two windows ask for 0 and 4, 2 is the solution of both, and each is told by what the other asks for."""
    problem, _ = following(monkeypatch, each_its_own(0.0, 4.0))
    near = replace(linearise(problem, np.array([2.0]), np.array([True])), ridges=ridges)
    fold = windows_module.folds_of(problem)
    assert fold.tolist() == [0, 2]
    told = folded(near, [np.array([False])], fold, first_order)
    assert told[0, :, 0] == pytest.approx(square, rel=1e-3)


@pytest.mark.parametrize(("wild", "ridge"), [(1.0004, module.RIDGE), (1.01, 1e-3), (np.nan, 1e-3)])
def test_the_least_ridge_is_taken_that_is_as_good_as_the_best(monkeypatch, wild, ridge):
    """Squares of two windows, per those after the best of the steps."""
    problem, _ = following(monkeypatch, each_its_own(0.0, 0.0))
    size = {module.RIDGE: np.sqrt(wild)}
    near = SimpleNamespace(problem=problem, values=np.array([5.0]), free=np.array([True]), errors=5.0 * np.ones(8),
                           step=lambda windows, held, ridge: np.array([size.get(ridge, 1.0)]))  # fmt: skip
    assert module._best_ridge(near, np.array([True, True])) == ridge


@pytest.mark.parametrize(("own", "equal", "better"), [(0.5, 0.5, True), (0.5, 1.0, False), (1.0, 0.5, False)])
def test_a_fit_is_better_by_the_steps_of_both_and_by_the_shorter_of_them(monkeypatch, own, equal, better):
    problem, _ = following(monkeypatch, each_its_own(1.0, 1.0))
    near = linearise(problem, np.array([0.1]), np.array([True]))
    here, there = replace(near, ridges=(1.0, 2.0, 3.0, 4.0)), replace(near, ridges=(4.0, 3.0, 2.0, 1.0), seconds=-1.0)
    asked = []

    def costs(fit):
        asked.append(fit.ridges)
        shorter = fit.ridges == (4.0, 3.0, 3.0, 4.0)
        return np.ones(100) if fit.seconds >= 0.0 else (equal if shorter else own) * np.ones(100)

    monkeypatch.setattr(module, "independent", lambda problem: 100)
    monkeypatch.setattr(module, "stated_of_windows", costs)
    assert module.follows_better(here, there) is better
    assert asked[:2] == [here.ridges, there.ridges]
    assert asked[2:] == ([(4.0, 3.0, 3.0, 4.0)] * 2 if own < 1.0 else [])
    asked.clear()
    module.follows_better(here, replace(there, ridges=here.ridges))
    assert asked == [here.ridges] * 2  # nothing is simulated twice


@pytest.mark.parametrize("first_order", [False, True])
def test_a_fold_is_told_by_the_others_and_never_by_itself(monkeypatch, first_order):
    """Windows ask for 1, 3 and 8: the last says 8 of the first two, they say 2 of it; a number that is held is 0."""
    problem, _ = following(monkeypatch, each_its_own(1.0, 3.0, 8.0))
    near = linearise(problem, np.array([4.0]), np.array([True]))
    trials = [np.array([False]), np.array([True])]
    square = folded(near, trials, np.array([0, 0, 1]), first_order)[:, :, 0]
    np.testing.assert_allclose(square, [[49, 25, 36], [1, 9, 64]], rtol=1e-4)


def test_windows_that_overlap_a_fold_do_not_tell_it(monkeypatch):
    """A fold that sees a 1 is told by the windows that see a 3, and not by the one that sees half of each."""
    problem, _ = following(monkeypatch, Windows(take_like(41), np.array([0, 5, 10, 20, 30]), 10))
    for aside, apart in (([0], [2, 3, 4]), ([2], [0, 3, 4]), ([1, 2], [3, 4]), ([3], [0, 1, 2, 4])):
        kept = np.isin(np.arange(5), aside)
        assert np.flatnonzero(module.apart_from(problem, kept)).tolist() == apart
    close, _ = following(monkeypatch, Windows(take_like(20), np.array([0, 3]), 10))
    assert module.apart_from(close, np.array([True, False])).tolist() == [False, True]  # better than nothing
    t = take_like(31)
    t.measured[11:, 0] = 3.0
    problem, _ = following(monkeypatch, Windows(t, np.array([0, 5, 10, 20]), 10))
    near = replace(linearise(problem, np.ones(1), np.ones(1, dtype=bool)), ridges=(0.0,) * 4)
    square = folded(near, [np.zeros(1, dtype=bool)], np.array([0, 1, 1, 1]))
    assert square[0, 0] == pytest.approx([4.0])  # by 3; with the one between by 8 / 3


@pytest.mark.parametrize(
    ("count", "asked"), [(400, [(0.5, 400), (0.5, 40), (0.5, 100)]), (100, [(0.5, 100), (0.5, 40)]), (30, [(0.5, 30)])]
)
def test_a_search_compares_few_windows_and_ends_on_all_of_them_and_the_torques(monkeypatch, count, asked):
    problem, _ = following(monkeypatch, each_its_own(1.0, 1.0))
    told, moved, spent, progress, made, compared, late = [], [], [], [], [], [], []
    deadline = SimpleNamespace(part=lambda share: share)

    def problem_of(h, takes, seconds, most, rng, x, *, torques, tuning):
        assert np.isinf(tuning)
        told.append((seconds, most, torques))
        assert (h, takes, rng) == (problem.hypothesis, "takes", "dice")
        assert seconds != 0.5 or x is begin[0] or x.tolist() == [2.0]
        made.append(replace(problem))
        return made[-1]

    def best_of(problem, points, most, mixed=0, best=module.best_of):
        compared.append((problem is made[2 if count > 100 else 0], mixed))
        return best(problem, points, most, mixed)

    def affordable(*given):
        assert given == (problem.hypothesis, "takes", deadline)
        return count

    def descend(problem, x, free, slopes, until):
        moved.append(x)
        spent.append((slopes, until))
        return x

    monkeypatch.setattr(module, "affordable", affordable)
    monkeypatch.setattr(module, "problem_of", problem_of)
    ends = []
    for last in ("more_telling", "without_torques"):
        monkeypatch.setattr(module, last, lambda near, deadline, last=last: ends.append((last, deadline)) or near)

    def escaped(near, until):
        assert until == 0.8
        return replace(near, seconds=-1.0)

    def trusted(near):
        assert near.seconds == -1.0
        ends.append("trusted")
        return near

    def with_delays(problem, few, x, free, until):
        place = [next(k for k, p in enumerate(made) if p is told) for told in (problem, few)]
        assert place == {400: [2, 1], 100: [0, 1], 30: [0, 0]}[count]
        assert (free.tolist(), until) == ([True], 0.6)
        late.append(len(moved))
        return np.array([77.0])

    monkeypatch.setattr(module, "escaped", escaped)
    monkeypatch.setattr(module, "trusted", trusted)
    monkeypatch.setattr(module, "_with_delays", with_delays)
    monkeypatch.setattr(module, "best_of", best_of)
    monkeypatch.setattr(module, "descend", descend)
    begin = np.arange(2.0, 12.0)[:, None]
    search(problem.hypothesis, "takes", begin, "dice", deadline, torques="said", progress=progress.append)
    assert list(dict.fromkeys(spent)) == [(2, 0.3), (2, 0.5), (3, 0.7)]
    assert progress == [0.25, 0.5, 0.7, 0.9]
    assert compared[:3] == [(True, 2)] * 3  # by a hundred windows, with two mixed points
    assert late == [len(moved) - 1]
    assert moved[-1].tolist() == [77.0]
    assert ends[0] == "trusted"
    assert ends[-2:] == [("more_telling", deadline), ("without_torques", deadline)]
    assert told == [(*each, "said") for each in (*asked, (0.1, 24), (0.2, 24))]
    each = 6 if count == 400 else 2  # of a robot that is cheap to simulate three times as many
    assert len(moved) == 2 * each + each + each + 1  # those that short windows like and long ones do are the same here


@pytest.mark.parametrize(("reach", "ridge"), [(99.0, module.RIDGE), (1.5, 1.0), (0.1, module.STAYS)])
def test_a_fold_is_told_by_the_step_that_does_the_other_folds_most_good(monkeypatch, reach, ridge):
    """Each of two windows asks for a number that is 2 from the solution of both; beyond its reach all is wild."""
    problem, _ = following(monkeypatch, each_its_own(0.0, 4.0))

    def simulate(w, build, values):
        x = values[:, None, None, :]
        return (x + 50.0 * (np.abs(x - 2.0) > reach)) * np.ones((*w.index.shape, 1))

    monkeypatch.setattr(windows_module, "simulate", simulate)
    near = trusted(linearise(problem, np.array([2.0]), np.array([True])))
    assert [near.ridges[k] for k in windows_module.folds_of(problem)] == [ridge, ridge]
    assert stated(near) == pytest.approx((2.0 + 2.0 / (1.0 + ridge)) ** 2, rel=1e-3)


def test_each_fold_has_a_step_of_its_own_and_is_told_by_windows_that_share_none_of_its_samples(monkeypatch):
    """The second of four windows overlaps the first and the third."""
    problem, _ = following(monkeypatch, Windows(take_like(41), np.array([0, 5, 10, 30]), 10))
    told = []

    def best(near, windows):
        told.append(windows.tolist())
        return 0.1 * len(told)

    monkeypatch.setattr(module, "_best_ridge", best)
    near = trusted(linearise(problem, np.ones(1), np.ones(1, dtype=bool)))
    assert near.ridges == pytest.approx((0.1, 0.2, 0.3, 0.4))
    assert told == [[False, False, True, True], [False, False, False, True], [True, False, False, True],
                    [True, True, True, False]]  # fmt: skip


def late(monkeypatch, *windows, nominal):
    """A problem of joints with one number each, all but the first of which are delays."""
    problem, _ = following(monkeypatch, *windows, nominal=nominal)
    for k, c in enumerate(problem.hypothesis.terms):
        c.effect.name = "actuation_delay" if k else "drag"
    return problem


def test_delays_are_tried_at_all_joints_alike_first_beside_all_else_and_then_with_it(monkeypatch):
    """A number and two delays, the last of which is fixed; all windows and the few are other problems."""
    few = late(monkeypatch, each_its_own(1.0), nominal=(3.0, 0.005, 0.0))
    free, moved = np.array([True, True, False]), []
    monkeypatch.setattr(module, "weighed", lambda problem, x: (problem, x.tolist()))
    monkeypatch.setattr(module, "descend", lambda way, x, *told: moved.append((way, x.tolist(), *told)) or x + 1.0)
    monkeypatch.setattr(module, "best_of", lambda problem, points, *told: [points[-1]] if told == (1, 2) else None)
    x, until = few.hypothesis.nominal, Deadline()
    for cost, delay in ((1.01, 2.08), (1.0, 0.005)):  # it goes back where that is no worse
        monkeypatch.setattr(module, "_costs", lambda problem, x, cost=cost: np.array([1.0, cost]))
        assert module._with_delays("all", few, x, free, until).tolist() == [5.0, delay, 2.0]
    each = zip(moved[:10:2], moved[1:10:2], (0.0, 0.01, 0.02, 0.04, 0.08), strict=True)
    for (way, at, *beside), (then, ends, *all_), delay in each:
        assert (way, at) == ((few, [3.0, delay, 0.0]), [3.0, delay, 0.0])
        assert (then, ends) == ((few, [4.0, delay + 1.0, 1.0]), [4.0, delay + 1.0, 1.0])
        for told, may in ((beside, [True, False, False]), (all_, [True, True, False])):
            assert (told[0].tolist(), *told[1:]) == (may, 1, until)
    moved.clear()
    assert module._with_delays("all", few, x, free, Deadline(0.0)) is x
    assert module._with_delays("all", few, x, np.array([True, False, False]), until) is x
    assert moved == []


def test_each_joint_takes_its_own_delay_and_one_that_rests_keeps_what_it_had(monkeypatch):
    """The second joint asks for 40 ms, the third for 10 ms, and nothing of the last one is seen."""
    t = take_like(9, truth=[0.0, 0.04, 0.01, 0.0])
    problem = late(monkeypatch, Windows(t, np.array([0, 4]), 4), nominal=(0.0, 0.0, 0.0, 0.0))

    def simulate(w, build, values):
        seen = values * [1.0, 1.0, 1.0, 0.0]
        return seen[:, None, None, :] * np.ones((*w.index.shape, 4))

    monkeypatch.setattr(windows_module, "simulate", simulate)
    monkeypatch.setattr(module, "descend", lambda problem, x, *_: x)
    free = np.array([False, True, True, True])
    x = np.array([0.0, 0.0, 0.08, 0.003])
    assert module._with_delays(problem, problem, x, free, Deadline()).tolist() == [0.0, 0.04, 0.01, 0.003]


@pytest.mark.parametrize(("ends", "found"), [(3.5, 3.5), (-9.0, 1.0), (1.0005, 1.0)])
def test_a_minimum_that_one_fold_holds_is_left_by_the_others_if_all_are_followed_better_from_there(
    monkeypatch, ends, found
):
    """Without one of two windows, which ask for 3 and 4, a descent leads away from 1; that of both then ends there."""
    problem, _ = following(monkeypatch, each_its_own(4.0, 3.0), torques=SimpleNamespace(rows=lambda values: values.T))
    near, moved = linearise(problem, np.array([1.0]), np.array([True])), []

    def descend(way, x, free, slopes, deadline, first=None):
        moved.append((len(way.weight), x[0], slopes, deadline))
        assert way.torques is problem.torques
        if len(way.weight) == 2:
            assert way.unit == pytest.approx(weighed(problem, x).unit)
            return np.array([ends])
        assert first.problem is way
        return np.array([7.0]) if way.squares(first.errors)[0, 0] > 5.0 else x

    monkeypatch.setattr(module, "descend", descend)
    out = module.escaped(near, deadline := Deadline())
    assert out.values.tolist() == [found]
    assert moved == [(1, 1.0, 1, deadline), (1, 1.0, 1, deadline), (2, 7.0, 1, deadline)]
    assert (out is near) == (found == 1.0)
    if found != 1.0:
        assert out.errors.tolist() == linearise(problem, out.values, near.free).errors.tolist()
    moved.clear()
    slow = replace(near, seconds=1.0)
    assert module.escaped(slow, Deadline(1.9)) is slow  # two Jacobians for each fold
    assert moved == []


def test_what_leads_out_of_a_minimum_shares_no_sample_with_the_fold_that_is_left_out(monkeypatch):
    problem, _ = following(monkeypatch, Windows(take_like(41), np.array([0, 5, 10, 30]), 10))
    near, parts = linearise(problem, np.array([1.0]), np.array([True])), []
    monkeypatch.setattr(module, "descend", lambda way, x, *_: parts.append(len(way.weight)) or x)
    assert module.escaped(near, Deadline()) is near
    assert parts == [2, 1, 2, 3]
    alone, _ = following(monkeypatch, each_its_own(1.0))
    near = linearise(alone, np.array([2.0]), np.array([True]))
    assert module.escaped(near, Deadline()) is near  # of one window there are no others
    assert trusted(near).ridges[0] == module.STAYS


def test_from_where_several_folds_lead_each_joint_takes_its_best(monkeypatch):
    """Without either of two windows, one joint is followed better and the other worse."""
    t = take_like(9, truth=[1.0, 2.0])
    problem, _ = following(monkeypatch, Windows(t, np.array([0, 4]), 4), nominal=(0.0, 0.0))
    near, ends = linearise(problem, np.array([5.0, 5.0]), np.array([True, True])), iter([[1.0, 9.0], [9.0, 2.0]])

    def descend(way, x, *_):
        return x if len(way.weight) == 2 else np.array(next(ends))

    monkeypatch.setattr(module, "descend", descend)
    assert module.escaped(near, Deadline()).values.tolist() == [1.0, 2.0]


@pytest.mark.parametrize(("step", "count"), [(0.005, 400), (0.0001, 100), (1e-5, 20)])
def test_windows_are_as_many_as_five_million_steps_allow(monkeypatch, step, count):
    """Half a second of two joints, for four numbers and the solution itself; and as many as a budget allows."""
    take = SimpleNamespace(
        model=SimpleNamespace(opt=SimpleNamespace(timestep=step)), address=SimpleNamespace(dof=[0, 1])
    )
    h = SimpleNamespace(nominal=np.zeros(5), bounds=(np.zeros(5), np.array([1.0, 1.0, 1.0, 1.0, 0.0])))
    assert affordable(h, [take], Deadline()) == count
    now, sizes = [1e5], []

    def mean_square(values):
        now[0] += 1.0
        sizes.append(len(values))

    tried = SimpleNamespace(weight=np.ones(10), mean_square=mean_square)
    monkeypatch.setattr(module, "problem_of", lambda *_: tried)
    monkeypatch.setattr(module, "time", SimpleNamespace(monotonic=lambda: now[0]))
    # a fiftieth of 300 s is 6 s, of a tenth of a second each
    assert affordable(h, [take], Deadline(300.0)) == min(count, 60)
    assert sizes == [5]


@dataclass(frozen=True)
class Ended:
    """A fit that is no more than where it ended."""

    problem: Problem
    values: str
    free: str = "free"
    errors: str = ""
    seconds: float = 10.0
    ridges: tuple[float, ...] = (1e-6,) * 4


def test_pooled_and_plain_numbers_stay_by_folds_and_weights_if_they_save_a_tenth(monkeypatch):
    """Pooled and plain least squares by what is stated; weights where they save a tenth of it."""
    errors, moved, units = {}, [], []

    def name(problem):
        return "weighed" if np.isfinite(problem.tuning) else "pooled" if problem.pooled else "plain"

    def descend(problem, x, free, slopes, deadline, first):
        assert (free, first.values) == ("free", x)
        moved.append((x, slopes))
        return f"{name(problem)} after {x}"

    monkeypatch.setattr(module, "in_units", lambda problem, square: units.append(square) or problem)
    monkeypatch.setattr(module, "weighed", lambda problem, x: problem)
    monkeypatch.setattr(module, "descend", descend)
    monkeypatch.setattr(module, "independent", lambda problem: 100)
    monkeypatch.setattr(module, "stated_of_windows", lambda near: errors.get(near.values, 1.0) * np.ones(100))
    monkeypatch.setattr(module, "linearise", lambda problem, x, free: Ended(problem, x, errors=f"of {x}"))
    monkeypatch.setattr(module, "trusted", lambda near: near)
    monkeypatch.setattr(Problem, "squares", lambda self, errors: errors)

    def best(joints=2, left=np.inf, **told):
        errors.clear()
        errors.update({key.replace("_", " "): value for key, value in told.items()})
        moved.clear()
        near = Ended(Problem(None, (), np.ones(joints), np.ones(1), tuning=np.inf), "near", errors="of near")
        return more_telling(near, Deadline(left)).values

    pooled, again = "pooled after near", "plain after pooled after near"
    assert best(near=0.9) == "near"
    assert moved == [("near", 1), (pooled, 3), ("near", 3)]
    assert units == [f"of {x}" for x, _ in moved]  # windows are weighed by what each way begins with
    assert best(pooled_after_near=0.9) == pooled
    assert moved[-1] == (pooled, 3)
    assert best(plain_after_pooled_after_near=0.9) == again
    assert moved[-1] == (again, 3)
    for saved, ended in ((0.09, "near"), (0.11, "weighed after near")):
        assert best(near=0.9, weighed_after_near=0.9 * (1 - saved)) == ended
    assert best(joints=1) == "near"  # of one joint there is nothing to pool
    assert moved == [("near", 3)]
    assert best(left=45.0, weighed_after_near=0.5) == "near"  # five slopes of 10 s
    assert moved == [("near", 1)]
    assert best(left=0.0, pooled_after_near=0.5) == "near"


def test_weights_that_take_windows_for_wild_are_not_led_astray_by_pushes():
    """Two pushes that no log tells of. Plain numbers lead out of a place where the joint is stuck, to wrong ones."""
    command = smooth_torque(12.0, 2.5, 1)
    push = np.zeros_like(command)
    for begin in (300, 700):
        push[begin : begin + 20] = 5.0  # 4 N·m, which a scale of 0.8 leaves
    take = recording(command, integrated(command + push, friction=0.1, scale=0.8))
    prepared = prepare([take], mujoco.MjModel.from_xml_string(pendulum(STEP)))
    h = standard_joints(prepared, seen_in(prepared))
    at = {(c.effect.name, p.name): k for k, (c, p) in enumerate(h_places(h))}
    own = [at["coulomb_friction", "torque"], at["torque_scale", "scale"]]
    free, stuck = np.zeros(len(h.nominal), dtype=bool), h.nominal
    free[own] = True
    stuck[at["viscous_friction", "damping"]] = 0.05
    stuck[own] = 0.5, 0.3
    problem = problem_of(h, prepared.takes, 0.5, 50, np.random.default_rng(0), stuck, tuning=np.inf)
    plain = descend(weighed(problem, stuck), stuck, free, 3, Deadline())
    assert plain[own[1]] > 0.6
    assert plain[own] != pytest.approx([0.1, 0.8], rel=0.1)
    found = more_telling(trusted(linearise(weighed(problem, plain), plain, free)), Deadline())
    assert np.isfinite(found.problem.tuning)
    assert found.values[own] == pytest.approx([0.1, 0.8], rel=0.1)


@pytest.mark.parametrize("tuning", [3.0, np.inf])
@pytest.mark.parametrize(
    ("truths", "without"),
    [
        ((3.0, 3.1, 2.9, 3.0) * 2, True),
        ((2.5, -1.6, 2.4, -1.5) * 2, False),  # 0.45 in the mean, but for how much they differ
        ((3.0,) * 4 + (0.0,) * 36, False),  # of forty, four that no other fold speaks for
    ],
)
def test_torques_have_no_say_where_folds_are_followed_clearly_better_without(monkeypatch, truths, without, tuning):
    """Torques ask for 0.1; windows for 3, or for this and that."""
    torques = SimpleNamespace(rows=lambda values: 1e3 * (values.T - 0.1))
    problem, _ = following(monkeypatch, each_its_own(*truths), torques=torques)
    x, free = np.array([0.1]), np.array([True])
    near = trusted(linearise(weighed(replace(problem, tuning=tuning), x), x, free))
    found = without_torques(near, Deadline())
    assert (found is near) != without
    if without:
        assert found.problem.torques is None
        assert found.values == pytest.approx([3.0], rel=0.05)
    assert without_torques(near, Deadline(0.0)) is near
    alone = linearise(replace(problem, torques=None), x, free)
    assert without_torques(alone, Deadline()) is alone


def test_without_torques_windows_are_plain_and_slopes_are_twice_as_many(monkeypatch):
    problem, _ = following(monkeypatch, each_its_own(1.0, 1.0), torques=SimpleNamespace(rows=lambda values: values.T))
    x, free, ways = np.array([0.1]), np.array([True]), []
    near = linearise(replace(problem, tuning=TUNING, pooled=True), x, free)

    def descend(way, x, free, slopes, *_):
        ways.append((way.tuning, way.pooled, slopes))
        return x

    monkeypatch.setattr(module, "descend", descend)
    monkeypatch.setattr(module, "stated_of_windows", lambda near: np.ones(2))
    assert without_torques(near, Deadline()) is near
    assert ways == [(np.inf, False, 2 * module.SLOPES[2])]


@pytest.mark.parametrize(
    ("saved", "doubt", "taken"), [(0.5, 1.5, False), (0.5, 2.5, True), (0.009, 99.0, False), (0.011, 99.0, True)]
)
def test_torques_keep_their_say_unless_a_hundredth_is_saved_by_two_standard_errors(monkeypatch, saved, doubt, taken):
    """Of a hundred windows, by ``saved`` in the mean, which is ``doubt`` standard errors."""
    problem, _ = following(monkeypatch, each_its_own(1.0, 1.0), torques=SimpleNamespace(rows=lambda values: values.T))
    near = linearise(problem, np.array([0.1]), np.array([True]))
    spread = np.tile([-1.0, 1.0], 50)
    after = 1.0 - saved - saved / doubt * np.sqrt(99.0) * spread
    monkeypatch.setattr(module, "independent", lambda problem: 100)
    told = lambda fit: np.ones(100) if fit.problem.torques is not None else after  # noqa: E731
    monkeypatch.setattr(module, "stated_of_windows", told)
    assert (without_torques(near, Deadline()) is not near) == taken


def test_a_search_whose_every_descent_goes_astray_ends_at_the_best_of_its_starts(monkeypatch):
    problem, _ = following(monkeypatch, each_its_own(1.0, 1.0))
    take = SimpleNamespace()
    monkeypatch.setattr(module, "affordable", lambda *_: 400)
    monkeypatch.setattr(module, "problem_of", lambda *_, **told: problem)
    monkeypatch.setattr(module, "more_telling", lambda near, deadline: near)
    monkeypatch.setattr(module, "descend", lambda problem, x, free, slopes, *_: x + 50.0 * (slopes < 3))
    begin, told = np.array([[9.0], [8.0], [7.0], [6.0], [1.25], [5.0]]), []
    found = search(problem.hypothesis, [take], begin, np.random.default_rng(0), Deadline(), progress=told.append)
    assert found.values.tolist() == [1.25]
    assert told == sorted(told)
    monkeypatch.setattr(module, "descend", lambda problem, x, *_: 0.5 * (x + 1.0))
    closer = search(problem.hypothesis, [take], begin, np.random.default_rng(0), Deadline())
    assert closer.values == pytest.approx([1 + 0.25 / 64])  # six descents, each of which halves the way


@pytest.mark.parametrize(
    ("together", "needed"),
    [(0.0, [False, True, False, True]), (5.0, [False, True, True, True])],  # of two that stand for each other, one
)
def test_of_each_joint_the_least_needed_goes_and_of_two_that_stand_for_each_other_one(monkeypatch, together, needed):
    """Two numbers of two joints: the first of each is worth next to nothing, or, without the other's, a lot."""
    worth = WORTH * np.array([0.1, 20.0, 0.2, 20.0])
    joints = terms_of(2, 2)
    problem = replace(Problem(None, (), np.ones(1), np.ones(100)), hypothesis=SimpleNamespace(terms=joints))
    near = told_by_costs(problem, 4)

    def cost(held):
        return 1.0 + worth @ held + WORTH * together * bool(held[0] and held[2])

    monkeypatch.setattr(module, "folds_of", lambda problem: np.zeros(100, dtype=int))
    monkeypatch.setattr(module, "independent", lambda problem: 100)
    monkeypatch.setattr(module, "folded", lambda near, trials, fold, first_order=False: [cost(t) for t in trials])
    monkeypatch.setattr(module, "window_cost", lambda problem, told: np.array(told)[:, None] * np.ones(100))
    assert prune(near, Deadline()).tolist() == needed


@pytest.mark.parametrize("rank", [(20.0, 0.1, 0.2), (0.1, 20.0, 0.2), (0.1, 0.2, 20.0)])
@pytest.mark.parametrize("first", [True, False])
def test_a_joint_gives_up_all_that_it_does_not_need_and_is_left_alone_when_it_needs_the_rest(monkeypatch, rank, first):
    """Beside another joint, before it or after, that needs its only number; in far less time than there is."""
    counts = (3, 1) if first else (1, 3)
    worth = WORTH * np.array([*rank, 20.0] if first else [20.0, *rank])
    joints = terms_of(*counts)
    problem = replace(Problem(None, (), np.ones(1), np.ones(100)), hypothesis=SimpleNamespace(terms=joints))
    near, told = told_by_costs(problem, 4), []
    monkeypatch.setattr(module, "folds_of", lambda problem: np.zeros(100, dtype=int))
    monkeypatch.setattr(module, "independent", lambda problem: 100)
    monkeypatch.setattr(
        module, "folded", lambda near, trials, fold, first_order=False: [1.0 + worth @ t for t in trials]
    )
    monkeypatch.setattr(module, "window_cost", lambda problem, told: np.array(told)[:, None] * np.ones(100))
    assert prune(near, Deadline(1000.0), told.append).tolist() == (worth > WORTH).tolist()
    assert told == sorted(told)
    assert told[-1] == 1.0


@pytest.mark.parametrize(
    ("guess", "truth", "needed"),
    [
        ((0.1, 0.2), (9.0, 0.1), (True, True)),  # what costs least to first order is asked about, and refused
        ((0.2, 0.1), (9.0, 0.1), (True, False)),
        ((-2.0, 1.5), (-2.0, 1.5), (False, True)),  # without the first all is better, and better than with neither
        ((-2.0, 0.5), (-2.0, 0.5), (False, False)),
    ],
)
def test_what_goes_is_guessed_by_slopes_and_allowed_by_the_best_that_was_found(monkeypatch, guess, truth, needed):
    """One joint has two numbers, worth multiples of the share of the error for which a number is just worth having."""
    joint = terms_of(2)
    problem = replace(Problem(None, (), np.ones(1), np.ones(100)), hypothesis=SimpleNamespace(terms=joint))
    near = told_by_costs(problem, 2)

    def folded(near, trials, fold, first_order=False):
        return [1.0 + WORTH * np.array(guess if first_order else truth) @ t for t in trials]

    monkeypatch.setattr(module, "folds_of", lambda problem: np.zeros(100, dtype=int))
    monkeypatch.setattr(module, "independent", lambda problem: 100)
    monkeypatch.setattr(module, "folded", folded)
    monkeypatch.setattr(module, "window_cost", lambda problem, told: np.array(told)[:, None] * np.ones(100))
    assert prune(near, Deadline()).tolist() == list(needed)


@dataclass(frozen=True)
class Limited:
    """A fit of torque limits, one a joint, whose absence costs each window something."""

    problem: Problem
    absence: np.ndarray
    """Shape (limits, windows)."""
    held: tuple[int, ...] = ()
    seconds: float = 1.0

    @property
    def free(self):
        return np.isin(np.arange(len(self.absence)), self.held, invert=True)

    def without(self, gone):
        assert len(gone) == len(self.absence)
        return replace(self, held=tuple(np.flatnonzero(gone)))

    @property
    def cost(self):
        return 1.0 + self.absence[list(self.held)].sum(0)


def limited(monkeypatch, *absence, count=100):
    h = SimpleNamespace(terms=terms_of(*(1,) * len(absence), effect="torque_saturation"))
    problem = replace(Problem(None, (), np.ones(1), np.ones(100)), hypothesis=h)
    monkeypatch.setattr(module, "folds_of", lambda problem: np.zeros(100, dtype=int))
    monkeypatch.setattr(module, "independent", lambda problem: count)
    monkeypatch.setattr(module, "folded", lambda near, trials, fold: near)
    monkeypatch.setattr(module, "window_cost", lambda problem, near: near.cost[None])
    return Limited(problem, np.stack([np.broadcast_to(a, 100) for a in absence]))


@pytest.mark.parametrize(
    ("absence", "stay"),
    [
        ((0.03, 0.03), [True, True]),
        ((0.03, 0.01), [True, False]),
        ((0.015, 0.012), [True, False]),  # either may go; together they are missed
        ((0.1, 3.0 * WAVE), [True, False]),  # what is missed surely is not hidden behind what is in doubt
        ((0.1, 0.2 + 3.0 * WAVE), [True, True]),  # nor is anything asked past what is missed surely
        ((0.02 + 0.5 * WAVE,), [False]),
        ((0.2 + 0.5 * WAVE,), [True]),
    ],
)
def test_limits_go_that_folds_do_not_ask_for_as_for_a_law(monkeypatch, absence, stay):
    """A fiftieth of the error of folds and a standard error keep one: of a hundred windows a tenth of their scatter."""
    near = limited(monkeypatch, *absence)
    assert without_doubtful_limits(near, Deadline()).free.tolist() == stay
    assert without_doubtful_limits(near, Deadline(0.5)) is near  # which asks for a second


def test_of_limits_nothing_is_said_by_one_window_nor_without_limits(monkeypatch):
    near = limited(monkeypatch, 0.0, 9.0, count=1)
    assert without_doubtful_limits(near, Deadline()) is near
    plain = told_by_costs(replace(near.problem, hypothesis=SimpleNamespace(terms=terms_of(2))), 2)
    assert without_doubtful_limits(plain, Deadline()) is plain


def test_a_limit_stays_that_the_stated_error_asks_for_where_windows_are_weighed(monkeypatch):
    near = limited(monkeypatch, 1.0)
    monkeypatch.setattr(
        module, "window_cost", lambda way, near: np.ones((1, 100)) + (near.cost - 1.0) * np.isinf(way.tuning)
    )
    assert without_doubtful_limits(near, Deadline()).free.all()


def test_a_limit_beyond_all_torques_goes_and_what_makes_up_for_it_is_what_it_changed(monkeypatch):
    """The motion is a number and a limit, of up to 3; each is 2.5, and the limit is not needed."""
    problem, _ = following(monkeypatch, each_its_own(5.01, 4.99, 5.01, 4.99), nominal=(0.0, 1e6), low=-1e7, high=1e7)
    problem.hypothesis.terms = tuple(
        SimpleNamespace(effect=SimpleNamespace(name=name), joint=0, parameters=(None,))
        for name in ("coulomb_friction", "torque_saturation")
    )
    problem = replace(problem, unit=np.array([0.01]), tuning=np.inf)
    monkeypatch.setattr(windows_module, "simulate", with_a_limit)
    near = trusted(linearise(problem, np.array([2.5, 2.5]), np.array([True, True])))
    needed = prune(near, Deadline())
    assert needed.tolist() == [True, False]
    assert over_needed(near, needed) == pytest.approx([2.0, 1e6], rel=1e-3)
    assert prune(near, Deadline(0.0)).all()
    problem.hypothesis.nominal[1] = 0.5  # given far too low: all windows ask for another one
    apart = trusted(linearise(replace(problem, unit=np.array([0.01])), np.array([2.5, 2.5]), np.array([False, True])))
    assert module._limits(apart).tolist() == [True]
    assert prune(apart, Deadline()).tolist() == [False, True]


def test_a_limit_that_folds_asked_for_is_not_asked_again_by_its_slope(monkeypatch):
    near = limited(monkeypatch, 0.0)
    monkeypatch.setattr(module, "without_doubtful_limits", lambda near, deadline: near)
    assert prune(near, Deadline()).tolist() == [True]
