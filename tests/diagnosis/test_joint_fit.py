"""The search of the standard joints: what it must find, and what it must not fall for."""

import sys
from dataclasses import dataclass, replace
from types import SimpleNamespace

import mujoco
import numpy as np
import pytest
from diagnosis.plants import behind_a_spring, pendulum, smooth_torque
from diagnosis.test_fitting import NOISE, RATE, STEP, integrated, parameter, recording

from torchrl_athletic.diagnosis import fit
from torchrl_athletic.diagnosis.deadline import Deadline
from torchrl_athletic.diagnosis.joint_fit import (
    DOUBT,
    WORTH,
    Linearised,
    Problem,
    affordable,
    descend,
    folded,
    folds_of,
    in_units,
    linearise,
    more_telling,
    part_of,
    problem_of,
    prune,
    search,
    stated,
    trusted,
    weighed,
    window_cost,
    without_torques,
)
from torchrl_athletic.diagnosis.prepare import prepare
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


@dataclass(frozen=True)
class Costs:
    """A problem whose one parameter is worth ``stated`` and ``weighed`` errors a window, in place of simulations."""

    stated: np.ndarray
    weighed: np.ndarray
    tuning: float = 1.0

    @property
    def hypothesis(self) -> SimpleNamespace:
        return SimpleNamespace(terms=(SimpleNamespace(joint=0, parameters=(None,)),))

    def of(self, without: bool) -> np.ndarray:
        return 1.0 + without * (self.stated if np.isinf(self.tuning) else self.weighed)


@pytest.mark.parametrize(
    ("stated", "weighed", "needed"),
    [
        (0.5 * WORTH, 0.5 * WORTH, False),  # not worth having
        (2.0 * WORTH, 0.0, True),  # the stated error must not rise, whatever its doubt
        (0.0, 0.9 * DOUBT * 0.2, False),  # within what folds leave open: 0.2
        (0.0, 1.1 * DOUBT * 0.2, True),
    ],
)
def test_a_parameter_goes_where_folds_do_not_ask_for_it(monkeypatch, stated, weighed, needed):
    windows = np.tile([-2.0, 2.0], 50)  # a mean of zero, a deviation of two
    problem = Costs(stated + windows * (stated > WORTH), weighed + windows * (weighed > WORTH))
    near = SimpleNamespace(problem=problem, free=np.ones(1, dtype=bool))
    monkeypatch.setattr(module, "folds_of", lambda problem: np.zeros(100, dtype=int))
    monkeypatch.setattr(module, "independent", lambda problem: 100)
    monkeypatch.setattr(module, "folded", lambda near, trials, fold, first_order=False: [t.any() for t in trials])
    monkeypatch.setattr(module, "window_cost", lambda problem, trials: np.array([problem.of(t) for t in trials]))
    assert prune(near, Deadline(np.inf)).tolist() == [needed]
    assert prune(near, Deadline(0.0)).tolist() == [True]  # without time nothing is found to be worthless
    monkeypatch.setattr(module, "independent", lambda problem: 4)  # which leaves five times the doubt
    assert prune(near, Deadline(np.inf)).tolist() == [stated > WORTH]


def take_like(samples, begins=(0,), period=0.005, truth=1.0):
    """A take of one joint or more, each of which follows its own number times a wave."""
    wave = np.ones(samples)
    return SimpleNamespace(
        time=period * np.arange(samples), begins=np.array(begins), period=period, wave=wave, address=None,
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
        terms=tuple(SimpleNamespace(joint=j, parameters=(None,)) for j in range(len(ones))), build=None,
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


def test_few_windows_are_made_up_by_some_that_overlap_within_their_own_recordings(monkeypatch):
    windows = Windows(take_like(40, (0, 20)), np.array([0, 11, 20, 31]), 8)
    denser = module._overlapping(windows, 8)
    assert denser.start.tolist() == [*range(8), 11, *range(20, 28), 31]  # 12 + 8 is the next recording's first
    assert module._overlapping(windows, 16).start.tolist() == denser.start.tolist()  # none is there twice
    asked = []
    monkeypatch.setattr(module, "_overlapping", lambda w, times: asked.append(times) or w)
    many = Windows(take_like(90), np.arange(10), 2)
    monkeypatch.setattr(module, "well_started", lambda w: many if w == "drawn" else w)
    monkeypatch.setattr(module, "draw_windows", lambda takes, seconds, most, rng: ["drawn", "drawn"])
    problem, _ = following(monkeypatch, many, many)
    take = SimpleNamespace(address=SimpleNamespace(dof=[0]))
    for seconds, most in ((0.5, 400), (0.5, 30), (0.5, 20), (0.2, 400)):
        found = problem_of(problem.hypothesis, [take], seconds, most, None, np.zeros(1), "torques")
        assert len(found.weight) == 20
        assert found.torques == "torques"
    assert asked == [3, 3, 2, 2]  # up to 60 of 20, and to no more than were asked for: 30
    monkeypatch.setattr(module, "draw_windows", lambda takes, seconds, most, rng: ["drawn"] * 7)
    assert len(problem_of(problem.hypothesis, [take], 0.5, 400, None, np.zeros(1)).weight) == 70
    assert len(asked) == 4  # which are enough


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

    monkeypatch.setattr(module, "simulate", simulate)
    monkeypatch.setattr(module, "affordable", lambda *_: 12)
    monkeypatch.setattr(module, "problem_of", lambda *_: problem)
    begin = np.array([[9.0], [1.0], [8.0]])
    found = search(problem.hypothesis, [SimpleNamespace()], begin, np.random.default_rng(0), Deadline())
    assert found.values == pytest.approx([4.0], rel=1e-3)


def test_of_two_joints_the_torques_have_their_say_once(monkeypatch):
    """Errors are a mean over joints: 12.0 and 0.9; of the torques' squares it is a hundredth, 9.0 or 13.0."""
    problem, _ = following(
        monkeypatch, Windows(take_like(9, truth=[1.0, 1.0]), np.array([0, 4]), 4), nominal=(0.0, 0.0)
    )
    points = [np.array([1.1, 1.1]), np.array([1.5, 1.5])]
    for size, best in ((30.0, 1.1), (36.0, 1.5)):
        told = SimpleNamespace(rows=lambda values, size=size: size * (values[:, 0] < 1.3)[None])
        assert module.best_of(replace(problem, torques=told), points, 1)[0][0] == best


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


def test_some_windows_follow_no_worse_by_what_they_weigh_in_units_and_with_the_torques(monkeypatch):
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
        near = linearise(one, np.array([2.0]), np.array([True]))
        assert module._does_good(near, windows, np.array([1.0])) is good


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
    assert replace(uneven, ridge=1.0).step(both, no) == pytest.approx([2.25], rel=1e-4)  # half of the way
    alone = linearise(replace(problem, torques=None), np.array([2.0]), yes)
    for high, ends in ((2.5, 2.5), (99.0, 3.0)):
        problem.hypothesis.bounds = (np.array([0.0]), np.array([high]))
        assert alone.step(~first, no) == pytest.approx([ends], rel=1e-4)


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
    near = replace(linearise(problem, np.ones(1), np.ones(1, dtype=bool)), ridge=0.0)
    square = folded(near, [np.zeros(1, dtype=bool)], np.array([0, 1, 1, 1]))
    assert square[0, 0] == pytest.approx([4.0])  # by 3; with the one between by 8 / 3


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
    monkeypatch.setattr(module, "simulate", lambda w, build, values: np.arctan(values)[:, None, None] * wave(w))
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


@pytest.mark.parametrize(("count", "asked"), [(400, [(0.5, 400), (0.5, 40)]), (30, [(0.5, 30)])])
def test_a_search_compares_few_windows_and_ends_on_all_of_them_and_the_torques(monkeypatch, count, asked):
    problem, _ = following(monkeypatch, each_its_own(1.0, 1.0))
    told, moved, spent, progress = [], [], [], []
    deadline = SimpleNamespace(part=lambda share: share)

    def problem_of(h, takes, seconds, most, rng, x, torques=None):
        told.append((seconds, most, torques))
        assert (h, takes, rng) == (problem.hypothesis, "takes", "dice")
        assert seconds != 0.5 or x is begin[0] or x.tolist() == [2.0]
        return problem

    def affordable(*given):
        assert given == (problem.hypothesis, "takes", deadline)
        return count

    def descend(problem, x, free, slopes, until):
        moved.append(x)
        spent.append((slopes, until))
        return x

    monkeypatch.setattr(module, "affordable", affordable)
    monkeypatch.setattr(module, "problem_of", problem_of)
    for last in ("more_telling", "without_torques"):
        monkeypatch.setattr(module, last, lambda near, deadline: near)
    monkeypatch.setattr(module, "descend", descend)
    begin = np.arange(2.0, 12.0)[:, None]
    search(problem.hypothesis, "takes", begin, "dice", deadline, torques="said", progress=progress.append)
    assert list(dict.fromkeys(spent)) == [(2, 0.3), (2, 0.5), (3, 0.7)]
    assert progress == [0.25, 0.5, 0.7, 0.9]
    assert told == [(*each, "said") for each in (*asked, (0.1, 24), (0.2, 24))]
    assert len(moved) == 2 * 2 + 2 + 2 + 1  # two that short windows like and two that long ones do are the same here


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

    monkeypatch.setattr(module, "simulate", simulate)
    free = np.array([True, True])
    assert descend(problem, np.array([9.0, 0.0]), free, 3, Deadline()) == pytest.approx([2.0, 0.0], abs=1e-3)
    near = linearise(problem, np.array([2.0, 0.0]), free)
    assert near.step(np.array([True, False]), ~free) == pytest.approx([1.0, 0.0], abs=1e-3)
    home = near.step(np.array([True, False]), np.array([False, True]))
    assert home[1] == pytest.approx(0.5)  # what is held is the given model's, shown or not


@pytest.mark.parametrize(("reach", "ridge"), [(99.0, module.RIDGE), (1.5, 1.0)])
def test_a_fold_is_told_by_steps_no_longer_than_they_do_the_other_folds_good(monkeypatch, reach, ridge):
    """Each of two windows asks for a number that is 2 from the solution of both; beyond its reach all is wild."""
    problem, _ = following(monkeypatch, each_its_own(0.0, 4.0))

    def simulate(w, build, values):
        x = values[:, None, None, :]
        return (x + 50.0 * (np.abs(x - 2.0) > reach)) * np.ones((*w.index.shape, 1))

    monkeypatch.setattr(module, "simulate", simulate)
    near = trusted(linearise(problem, np.array([2.0]), np.array([True])))
    assert near.ridge == ridge
    assert stated(near) == pytest.approx((2.0 + 2.0 / (1.0 + ridge)) ** 2, rel=1e-3)


def test_a_descent_goes_on_from_where_it_is_as_long_as_it_pays(monkeypatch):
    """Its first slope may be given; each other one is taken where the last one ended."""
    monkeypatch.setattr(module, "linearise", lambda problem, x, free: SimpleNamespace(seconds=0.0, values=x))
    saved = iter([0.5, 0.002, 0.0005, 0.5])
    monkeypatch.setattr(module, "_steps", lambda problem, near, deadline: (near.values + 1, next(saved)))
    given = SimpleNamespace(seconds=0.0, values=np.array([10.0]))
    free = np.array([True])
    assert descend(None, np.zeros(1), free, 2, Deadline(), given).tolist() == [12.0]
    assert descend(None, np.zeros(1), free, 5, Deadline()).tolist() == [1.0]  # 0.05 % is not worth a slope
    slow = SimpleNamespace(seconds=100.0, values=np.array([10.0]))
    assert descend(None, np.zeros(1), free, 5, Deadline(120.0), slow).tolist() == [11.0]


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


def test_whichever_weights_follow_folds_best_are_taken(monkeypatch):
    """Each way goes on from the best so far, and the weighed one begins once more where each plain one ended."""
    name = lambda problem: "pooled" if problem.pooled else "plain" if np.isinf(problem.tuning) else "weighed"  # noqa: E731
    errors, moved, units = {}, [], []

    def descend(problem, x, free, slopes, deadline, first):
        assert (free, first.values) == ("free", x)
        moved.append((x, slopes))
        return f"{name(problem)} after {x}" if name(problem) == "weighed" else name(problem)

    monkeypatch.setattr(module, "in_units", lambda problem, square: units.append(square) or problem)
    monkeypatch.setattr(module, "weighed", lambda problem, x: problem)
    monkeypatch.setattr(module, "descend", descend)
    monkeypatch.setattr(module, "stated", lambda near: errors[near.values])
    monkeypatch.setattr(
        module,
        "linearise",
        lambda problem, x, free: SimpleNamespace(problem=problem, values=x, free=free, errors=f"of {x}", seconds=10.0),
    )
    monkeypatch.setattr(module, "trusted", lambda near: near)
    monkeypatch.setattr(Problem, "squares", lambda self, errors: errors)
    own = ("near", "plain", "weighed after plain", "pooled", "weighed after pooled")

    def best(*told, joints=2, left=np.inf):
        errors.update(zip(own, told, strict=True))
        problem = Problem(None, (), np.ones(joints), np.ones(1))
        near = SimpleNamespace(problem=problem, values="near", free="free", errors="of near", seconds=10.0)
        moved.clear()
        return more_telling(near, Deadline(left)).values

    assert best(1.0, 2.0, 2.0, 3.0, 3.0) == "near"
    assert moved == [("near", 1), ("plain", 3), ("near", 1), ("pooled", 3)]
    assert units == [f"of {x}" for x, _ in moved]  # windows are weighed by what each way begins with
    for k, ended in enumerate(own):
        assert best(*np.where(np.arange(5) == k, 1.0, 2.0)) == ended
    assert best(3.0, 2.0, 1.0, 2.0, 2.0) == "weighed after plain"
    assert moved == [("near", 1), ("plain", 3), ("weighed after plain", 1), ("pooled", 3)]
    assert best(3.0, 2.0, 2.0, 1.0, 1.0, joints=1) == "plain"  # of one joint there is nothing to pool
    assert best(3.0, 2.0, 1.0, 1.0, 1.0, left=25.0) == "near"  # each takes two slopes more than its descent
    assert best(3.0, 2.0, 1.0, 1.0, 1.0, left=45.0) == "pooled"  # no time for the weighed one after plain


def test_plain_least_squares_leads_out_of_a_place_where_all_is_wild_and_is_not_led_astray_by_pushes():
    """By friction of 0.5 and a scale of 0.3 the joint is stuck; two pushes that no log tells of pull plain numbers."""
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
    problem = problem_of(h, prepared.takes, 0.5, 24, np.random.default_rng(0), stuck)
    found = more_telling(trusted(linearise(problem, stuck, free)), Deadline())
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


def test_without_torques_plain_windows_are_weighed_again_and_both_ways_are_compared_by_one_ridge(monkeypatch):
    problem, _ = following(monkeypatch, each_its_own(1.0, 1.0), torques=SimpleNamespace(rows=lambda values: values.T))
    x, free, ways, compared = np.array([0.1]), np.array([True]), [], []
    near = replace(linearise(replace(problem, tuning=np.inf, pooled=True), x, free), ridge=10.0)

    def descend(way, x, *_):
        ways.append((way.tuning, way.pooled))
        return x

    monkeypatch.setattr(module, "descend", descend)
    told = lambda a, b, sure: compared.append((a.ridge, b.ridge, sure)) is None  # noqa: E731
    monkeypatch.setattr(module, "follows_better", told)
    found = without_torques(near, Deadline())
    assert ways == [(np.inf, False), (module.TUNING, False)]
    assert all(a == b for a, b, _ in compared)
    assert compared[0] == (10.0, 10.0, module.SURE_WITHOUT)
    assert found.ridge != 10.0  # each keeps its own


def test_a_search_whose_every_descent_goes_astray_ends_at_the_best_of_its_starts(monkeypatch):
    problem, _ = following(monkeypatch, each_its_own(1.0, 1.0))
    take = SimpleNamespace()
    monkeypatch.setattr(module, "affordable", lambda *_: 400)
    monkeypatch.setattr(module, "problem_of", lambda *_: problem)
    monkeypatch.setattr(module, "more_telling", lambda near, deadline: near)
    monkeypatch.setattr(module, "descend", lambda problem, x, free, slopes, deadline: x + 50.0 * (slopes < 3))
    begin, told = np.array([[9.0], [8.0], [7.0], [6.0], [1.25], [5.0]]), []
    found = search(problem.hypothesis, [take], begin, np.random.default_rng(0), Deadline(), progress=told.append)
    assert found.values.tolist() == [1.25]
    assert told == sorted(told)
    monkeypatch.setattr(module, "descend", lambda problem, x, *_: 0.5 * (x + 1.0))
    closer = search(problem.hypothesis, [take], begin, np.random.default_rng(0), Deadline())
    assert closer.values == pytest.approx([1 + 0.25 / 16])  # four descents, each of which halves the way


@pytest.mark.parametrize(
    ("together", "needed"),
    [(0.0, [False, True, False, True]), (5.0, [False, True, True, True])],  # of two that stand for each other, one
)
def test_of_each_joint_the_least_needed_goes_and_of_two_that_stand_for_each_other_one(monkeypatch, together, needed):
    """Two numbers of two joints: the first of each is worth next to nothing, or, without the other's, a lot."""
    worth = WORTH * np.array([0.1, 20.0, 0.2, 20.0])
    joints = tuple(SimpleNamespace(joint=j, parameters=(None, None)) for j in (0, 1))
    problem = replace(Problem(None, (), np.ones(1), np.ones(100)), hypothesis=SimpleNamespace(terms=joints))
    near = SimpleNamespace(problem=problem, free=np.array([True, True, True, True]))

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
    joints = tuple(SimpleNamespace(joint=j, parameters=(None,) * n) for j, n in enumerate(counts))
    problem = replace(Problem(None, (), np.ones(1), np.ones(100)), hypothesis=SimpleNamespace(terms=joints))
    near, told = SimpleNamespace(problem=problem, free=np.ones(4, dtype=bool)), []
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
    joint = (SimpleNamespace(joint=0, parameters=(None, None)),)
    problem = replace(Problem(None, (), np.ones(1), np.ones(100)), hypothesis=SimpleNamespace(terms=joint))
    near = SimpleNamespace(problem=problem, free=np.ones(2, dtype=bool))

    def folded(near, trials, fold, first_order=False):
        return [1.0 + WORTH * np.array(guess if first_order else truth) @ t for t in trials]

    monkeypatch.setattr(module, "folds_of", lambda problem: np.zeros(100, dtype=int))
    monkeypatch.setattr(module, "independent", lambda problem: 100)
    monkeypatch.setattr(module, "folded", folded)
    monkeypatch.setattr(module, "window_cost", lambda problem, told: np.array(told)[:, None] * np.ones(100))
    assert prune(near, Deadline()).tolist() == list(needed)


@pytest.mark.parametrize("side", [1.0, -1.0])
def test_what_is_held_goes_to_the_given_models_number(side):
    h = SimpleNamespace(
        scale=np.array([0.5, 0.1]), nominal=np.array([3.0 - side, 1.0]), bounds=(np.full(2, -9.0), np.full(2, 9.0))
    )
    problem = SimpleNamespace(hypothesis=h, row_weight=np.ones(3), window=np.array([0, 0, 0]))
    columns = np.array([[1.0, 0.0], [0.0, 1.0], [1.0, 1.0]])
    near = Linearised(
        problem, np.array([3.0, 1.0]), np.ones(2, dtype=bool), np.zeros(3), columns, np.zeros(1), np.zeros((1, 2))
    )
    one = np.ones(1, dtype=bool)
    assert near.move(one, np.array([True, True])) == pytest.approx([-2.0 * side, 0.0])
    other = near.move(one, np.array([True, False]))
    assert other == pytest.approx([-2.0 * side, 1.0 * side], rel=1e-4)  # which makes up for it
    assert near.step(one, np.array([True, True])) == pytest.approx([3.0 - side, 1.0])
