"""Laws beside the standard joint: which a joint may have, where their numbers start, and which are taken."""

from dataclasses import dataclass, replace
from types import SimpleNamespace

import mujoco
import numpy as np
import pytest
from diagnosis.plants import behind_a_spring, double_pendulum, pendulum, record, smooth_torque

from torchrl_athletic.diagnosis import extension, joint_fit
from torchrl_athletic.diagnosis.deadline import Deadline
from torchrl_athletic.diagnosis.descent import Linearised, descend, linearise
from torchrl_athletic.diagnosis.extension import (
    FINER,
    GAIN,
    GEARS,
    _beside,
    _bounded,
    _chosen,
    _joined,
    extend,
    gain_of,
    offers,
    with_gear,
)
from torchrl_athletic.diagnosis.prepare import prepare
from torchrl_athletic.diagnosis.problem import Problem, problem_of, weighed
from torchrl_athletic.diagnosis.replay import Windows
from torchrl_athletic.diagnosis.standard import Seen, seen_in, standard_joints
from torchrl_athletic.effects import Compliance, JointSpring, Parameter
from torchrl_athletic.recordings import Recording

SEEN = Seen(*(np.array([x]) for x in (5.0, 8.0, 2.0, 4.0, 0.1, 3.0)), period=0.01)
ON_A_SPRING = 'damping="0.05" stiffness="2" springref="20"'


@pytest.fixture(scope="module")
def swings():
    """On a spring that the model does not have."""
    sprung = pendulum(0.005, ON_A_SPRING)
    takes = [record(sprung, smooth_torque(4.0, 2.5, seed), noise=1e-5, seed=seed) for seed in (1, 2)]
    return prepare(takes, mujoco.MjModel.from_xml_string(pendulum(0.005)))


@pytest.fixture(scope="module")
def near(swings):
    """The standard joint, fitted to them."""
    h = standard_joints(swings, seen_in(swings))
    free = h.bounds[1] > h.bounds[0]
    problem = problem_of(h, swings.takes, 0.5, 20, np.random.default_rng(0), h.nominal)
    x = descend(problem, h.nominal, free, 2, Deadline())
    return linearise(weighed(problem, x), x, free)


def at(h, effect, name, values):
    (c,) = (c for c in h.terms if c.effect.name == effect)
    return h.values_of(c, values)[[p.name for p in c.parameters].index(name)]


def started(offered, name):
    return [dict(zip((p.name for p in o.candidate.parameters), o.start, strict=True)) for o in offered
            if o.candidate.effect.name == name]  # fmt: skip


def test_each_law_starts_from_the_friction_and_the_limit_that_it_takes_the_place_of(near, swings):
    h, values = near.problem.hypothesis, near.values.copy()
    for name, value in (("coulomb_friction", 0.3), ("viscous_friction", 0.7)):
        (c,) = (c for c in h.terms if c.effect.name == name)
        h.values_of(c, values)[0] = value
    offered = offers(replace(near, values=values), swings, SEEN)
    slow, fast = started(offered, "stribeck_friction")
    assert [x["stribeck_speed"] for x in (slow, fast)] == pytest.approx([0.2, 1.0])  # shares of 2 rad/s
    assert slow["coulomb"] == fast["coulomb"] == pytest.approx(0.3)
    (both,) = started(offered, "asymmetric_friction")
    assert [both[f"coulomb_{side}"] for side in ("positive", "negative")] == pytest.approx([0.3, 0.3])
    assert [both[f"viscous_{side}"] for side in ("positive", "negative")] == pytest.approx([0.7, 0.7])
    (speed,) = started(offered, "speed_torque_limit")
    assert speed["no_load_speed"] == pytest.approx(8.0)
    limit = at(h, "torque_saturation", "limit", values)
    assert speed["stall_torque"] == pytest.approx(limit)
    narrow, wide = started(offered, "hysteresis")
    assert [x["width"] for x in (narrow, wide)] == pytest.approx([0.03, 0.15])  # of a radian, though it travels three
    replaced = {o.candidate.effect.name: {c.effect.name for c in o.replaced} for o in offered}
    assert replaced["asymmetric_friction"] == {"coulomb_friction", "viscous_friction"}
    assert replaced["joint_spring"] == set()
    assert all(o.candidate.joint_name == "pendulum" for o in offered if not o.candidate.effect.whole_robot)
    for o in offered:
        assert all(p.lower <= x <= p.upper for p, x in zip(o.candidate.parameters, o.start, strict=True))


def test_no_law_is_offered_twice_nor_without_what_it_replaces_nor_to_a_joint_that_rests(near, swings):
    offered = offers(near, swings, SEEN)
    spring = next(o for o in offered if o.candidate.effect.name == "joint_spring")
    friction = next(o for o in offered if o.candidate.effect.name == "stribeck_friction")
    for taken, gone in ((spring, {"joint_spring"}), (friction, {"stribeck_friction", "asymmetric_friction"})):
        h, x = _joined(near, [taken])
        left = offers(replace(near, problem=replace(near.problem, hypothesis=h), values=x), swings, SEEN)
        names = {o.candidate.effect.name for o in left}
        assert not names & gone
        assert names > {"hysteresis", "actuation_lag"}
    assert offers(near, swings, replace(SEEN, travel=np.array([0.9e-3]))) == []
    assert offers(near, swings, replace(SEEN, travel=np.array([1.1e-3])))
    half = offers(near, swings, replace(SEEN, travel=np.array([0.5])))
    assert [x["width"] for x in started(half, "hysteresis")] == pytest.approx([0.015, 0.075])  # of its travel


@pytest.mark.parametrize("count", [0, 1, 2])
def test_a_law_is_offered_where_it_applies_to_some_take(near, swings, count, monkeypatch):
    class Seldom(JointSpring):
        def applies(self, s):
            return any(s is own for own in swings.signals[:count])

    monkeypatch.setattr(extension, "LAWS", (Seldom(),))
    assert len(offers(near, swings, SEEN)) == bool(count)


def test_a_base_that_leans_is_offered_once_and_to_no_joint():
    command = np.hstack([smooth_torque(2.0, 1.0, 1), smooth_torque(2.0, 0.5, 2)])
    xml = double_pendulum(0.005)
    takes = prepare([record(xml, command)], mujoco.MjModel.from_xml_string(xml))
    h = standard_joints(takes, seen_in(takes))
    two = SimpleNamespace(problem=SimpleNamespace(hypothesis=h), values=h.nominal)
    keys = [o.candidate.key for o in offers(two, takes, seen_in(takes))]
    assert [key for key in keys if key[0] == "gravity_tilt"] == [("gravity_tilt", None)]
    assert [key for key in keys if key[0] == "joint_spring"] == [("joint_spring", n) for n in ("upper", "lower")]


def test_each_of_two_joints_is_offered_laws_of_its_own_size_that_start_from_its_own_friction():
    command = np.hstack([smooth_torque(2.0, 1.0, 1), smooth_torque(2.0, 0.5, 2)])
    take, xml = record(double_pendulum(0.005), command), double_pendulum(0.005)
    sizes = {"upper": (5.0, 8.0, 2.0, 4.0, 0.1, 0.6), "lower": (1.0, 3.0, 7.0, 2.0, 0.3, 0.2)}
    friction = {("coulomb_friction", "upper"): 0.3, ("coulomb_friction", "lower"): 0.2,
                ("viscous_friction", "upper"): 0.07, ("viscous_friction", "lower"): 0.04}  # fmt: skip
    told = []
    for names in (("upper", "lower"), ("lower", "upper")):
        one = prepare([take.ordered(names)], mujoco.MjModel.from_xml_string(xml))
        seen = Seen(*np.array([sizes[name] for name in names]).T, period=0.01)
        h = standard_joints(one, seen)
        values = h.nominal
        for c in h.terms:
            if c.key in friction:
                h.values_of(c, values)[0] = friction[c.key]
        near = SimpleNamespace(problem=SimpleNamespace(hypothesis=h), values=values)
        offered = [
            (*o.candidate.key, *(c.key for c in o.replaced), o.start.round(9).tolist(),
             [(p.lower, p.upper, p.scale) for p in o.candidate.parameters])
            for o in offers(near, one, seen) if not o.candidate.effect.whole_robot
        ]  # fmt: skip
        told.append(sorted(offered, key=str))
        at_rest = offers(near, one, replace(seen, travel=seen.travel * [name == "lower" for name in names]))
        assert {o.candidate.joint_name for o in at_rest} <= {"lower", None}
    assert told[0] == told[1]
    assert {joint for _, joint, *_ in told[0]} == {"upper", "lower"}


@pytest.mark.parametrize(("unit", "most"), [("N·m", 80.0), ("N", 80.0), ("N·m·s/rad", 40.0), ("N·s/m", 40.0)])
def test_torques_and_dampings_go_up_to_ten_times_what_was_seen_both_ways(unit, most):
    p = _bounded(Parameter("p", unit, 0.0, -1e9, 1e9, 1.0), 0, SEEN)
    assert (p.lower, p.upper) == (-most, most)
    assert p.scale == pytest.approx(0.002 * most)
    tight = _bounded(Parameter("p", unit, 1.0, 0.5, 3.0, 1.0), 0, SEEN)
    assert (tight.lower, tight.upper) == (0.5, 3.0)
    given = _bounded(Parameter("p", unit, 5e3, 0.0, 1e9, 1.0), 0, SEEN)
    assert (given.lower, given.upper) == (0.0, 5e3)
    below = _bounded(Parameter("p", unit, -5e3, -1e9, 1e9, 1.0), 0, SEEN)
    assert (below.lower, below.upper) == (-5e3, most)
    other = Parameter("p", "rad", 0.0, -1e9, 1e9, 1.0)
    assert _bounded(other, 0, SEEN) is other


def test_what_a_law_replaces_goes_and_all_else_keeps_its_number(near, swings):
    law = next(o for o in offers(near, swings, SEEN) if o.candidate.effect.name == "asymmetric_friction")
    h, x = _joined(near, [law])
    names = [c.effect.name for c in h.terms]
    assert "coulomb_friction" not in names
    assert "viscous_friction" not in names
    assert names[-1] == "asymmetric_friction"
    np.testing.assert_array_equal(h.values_of(law.candidate, x), law.start)
    for c in h.terms[:-1]:
        np.testing.assert_array_equal(h.values_of(c, x), near.problem.hypothesis.values_of(c, near.values))


@pytest.mark.parametrize("name", ["joint_spring", "stribeck_friction"])
def test_a_law_beside_the_others_is_linearised_as_all_of_it_would_be(near, swings, name):
    law = next(o for o in offers(near, swings, SEEN) if o.candidate.effect.name == name)
    beside = _beside(replace(near, ridges=(0.1, 0.2, 0.3, 0.4)), law)
    assert beside.ridges == (0.1, 0.2, 0.3, 0.4)
    assert beside.damped.tolist() == [c is not law.candidate for c in _joined(near, [law])[0].terms
                                      for p in c.parameters if p.upper > p.lower]  # fmt: skip
    h, x = _joined(near, [law])
    free = h.bounds[1] > h.bounds[0]
    np.testing.assert_array_equal(beside.values, x)
    np.testing.assert_array_equal(beside.free, free)
    whole = linearise(replace(near.problem, hypothesis=h), x, free)
    np.testing.assert_allclose(beside.errors, whole.errors, atol=1e-9)
    own = h.values_of(law.candidate, np.arange(len(x)))
    new = np.isin(np.flatnonzero(free), own)
    np.testing.assert_allclose(beside.columns[:, new], whole.columns[:, new], rtol=1e-4, atol=1e-9)
    if name == "joint_spring":  # beside a law that replaces none, the others act as they did
        np.testing.assert_allclose(beside.columns[:, ~new], whole.columns[:, ~new], rtol=1e-2, atol=1e-6)


def test_a_gain_counts_where_it_is_two_per_cent_and_more_than_one_standard_error():
    before = np.full(100, 2.0)
    assert gain_of(before, before - 0.1, 100) == pytest.approx(0.05)
    assert gain_of(before, before - 0.99 * GAIN * 2.0, 100) == 0
    wavers = np.where(np.arange(100) % 2, 0.2, -0.1)  # three standard errors
    assert gain_of(before, before - wavers, 100, sure=2.0) == pytest.approx(0.025)
    assert gain_of(before, before - wavers, 100, sure=4.0) == 0
    assert gain_of(before, before + 0.1, 100) == 0
    luck = np.where(np.arange(100) % 2, 2.5, -2.1)  # a tenth is saved in the mean, and as doubtful
    assert gain_of(before, before - luck, 100) == 0
    assert gain_of(before, before - np.where(np.arange(100) % 2, 0.1, 0.2), 100) == pytest.approx(0.075)


def test_the_spring_is_chosen_and_fitted_and_nothing_is_begun_without_time(near, swings, monkeypatch):
    monkeypatch.setattr(extension, "ROUNDS", 1)
    seen = seen_in(swings)
    first, *rest = _chosen(near, offers(near, swings, seen), Deadline())
    assert first.candidate.effect.name == "joint_spring"
    assert not rest  # one law a joint at a time
    told = []
    better = extend(near, swings, seen, Deadline(), told.append)
    (spring,) = (c for c in better.problem.hypothesis.terms if c.effect.name == "joint_spring")
    values = dict(zip((p.name for p in spring.parameters), better.problem.hypothesis.values_of(spring, better.values),
                      strict=True))  # fmt: skip
    assert values["stiffness"] == pytest.approx(2.0, rel=0.1)
    assert told == sorted(told)
    assert 0 < told[0] < told[-1] <= 1
    assert extend(near, swings, seen, Deadline(0.0)) is near
    slow = replace(near, seconds=1e6)
    assert extend(slow, swings, seen, Deadline(3.9e6)) is slow  # a round takes four times as long


@dataclass(frozen=True)
class Named:
    """A fit that is no more than its name."""

    name: str
    problem: object = None
    seconds: float = 0.0
    ridges: tuple[float, ...] = (1e-6,) * 4


@pytest.mark.parametrize("size", [1.0, 1e-4])
@pytest.mark.parametrize(("both", "kept"), [(1.5, "a"), (1.005, "a"), (0.992, "a"), (0.985, "ab"), (0.5, "ab")])
def test_two_laws_that_get_into_each_others_way_leave_the_better_one_and_one_that_does_not_help_none(
    monkeypatch, both, kept, size
):
    """Both together must save a hundredth of an error of any size."""
    costs = {"": size, "ab": both * size, "a": 0.5 * size, "b": 0.4 * size}
    near = Named("")
    rounds = iter([["a", "b"], []])
    monkeypatch.setattr(extension, "offers", lambda *_: [])
    monkeypatch.setattr(extension, "_chosen", lambda *_: next(rounds))
    monkeypatch.setattr(extension, "_with", lambda n, chosen, *_: Named("".join(chosen)))
    monkeypatch.setattr(joint_fit, "stated_of_windows", lambda n: np.full(9, costs[n.name]))
    monkeypatch.setattr(joint_fit, "independent", lambda problem: 9)
    assert extend(near, None, None, Deadline()).name == kept
    costs["a"], costs["ab"], rounds = 0.999 * size, 1.1 * size, iter([["a", "b"]])
    assert extend(near, None, None, Deadline()) is near


def test_a_gear_is_hinted_at_where_it_leaves_much_less_of_what_the_torques_leave_open(swings, near):
    """By the stiffness that the torques like best, beside the joint's own drag; a spring to the world is no gear."""
    stiffness, rng = 40.0, np.random.default_rng(1)
    time, command, read = behind_a_spring(stiffness, link=0.05, rotor=0.04, rng=rng)
    xml = """<mujoco><option timestep="0.005" gravity="0 0 0"/><worldbody><body>
      <joint name="table" axis="0 0 1" armature="0.04"/>
      <inertial pos="0 0 0" mass="0.1" diaginertia="0.05 0.05 0.05"/></body></worldbody>
      <actuator><motor joint="table" ctrlrange="-20 20"/></actuator></mujoco>"""
    position = read[:, None] + 1e-6 * rng.standard_normal((len(read), 1))
    command = command + 0.3 * np.gradient(read, time)
    take = Recording(time, ("table",), position, torque_command=command[:, None])
    bent = prepare([take], mujoco.MjModel.from_xml_string(xml))
    hints = extension._hints(standard_joints(bent, seen_in(bent)), bent)
    assert 0 < len(hints) <= extension.MANY
    names = {o.candidate.effect.name for o in hints}
    assert len(names) == 1
    assert names <= {law.name for law in GEARS}
    best = dict(zip((p.name for p in hints[0].candidate.parameters), hints[0].start, strict=True))
    assert min(FINER) * best["stiffness"] < stiffness < max(FINER) * best["stiffness"]  # among which a search begins
    assert extension._hints(near.problem.hypothesis, swings) == []


def test_the_soft_one_of_two_joints_is_hinted_at_though_nothing_of_the_first_one_can_be_used(monkeypatch):
    monkeypatch.setattr(extension, "GEARS", (Compliance(),))
    time, command, read = behind_a_spring(40.0, link=0.05, rotor=0.04, rng=np.random.default_rng(1))
    step = time[1] - time[0]
    speed = np.cumsum(np.append(0.0, command[:-1])) * step / 0.09
    stiff = np.append(0.0, np.cumsum(speed[:-1] + step / 2 * command[:-1] / 0.09) * step)
    table = '<body><joint name="{0}" axis="0 0 1" armature="0.04"/><inertial pos="0 0 0" mass="0.1" diaginertia="{1}"/>'
    tables = "".join(table.format(name, "0.05 0.05 0.05") + "</body>" for name in ("stiff", "soft"))
    model = mujoco.MjModel.from_xml_string(
        f'<mujoco><option timestep="0.005" gravity="0 0 0"/><worldbody>{tables}</worldbody></mujoco>'
    )
    position = np.stack([stiff, read], -1) + 1e-6 * np.random.default_rng(0).standard_normal((len(read), 2))
    dragged = command + 0.3 * np.gradient(read, time)  # which its own damping explains, and not the other's
    take = Recording(time, ("stiff", "soft"), position, torque_command=np.stack([command, dragged], -1))
    bent = prepare([take.slice(0, 600)], model)
    h = standard_joints(bent, seen_in(bent))
    bent.signals[0].valid[:, 0] = False
    hints = extension._hints(h, bent)
    assert {(o.candidate.joint, o.candidate.joint_name) for o in hints} == {(1, "soft")}


def test_each_round_builds_on_the_last_one_and_must_save_a_hundredth(monkeypatch):
    costs = {"": 1.0, "a": 0.98, "ab": 0.95, "abc": 0.1}
    seen, told = [], []
    near = Named("")
    monkeypatch.setattr(extension, "offers", lambda n, *given: seen.append(n.name) or given)
    monkeypatch.setattr(extension, "_with", lambda n, chosen, *_: Named(n.name + chosen[0]))
    monkeypatch.setattr(joint_fit, "stated_of_windows", lambda n: np.full(9, costs[n.name]))
    monkeypatch.setattr(joint_fit, "independent", lambda problem: 9)
    for first, name in ((0.98, "ab"), (0.991, "")):
        costs["a"], rounds = first, iter([["a"], ["b"], ["c"]])
        monkeypatch.setattr(
            extension, "_chosen", lambda n, tried, _, rounds=rounds: next(rounds) if tried == ("takes", "seen") else []
        )
        assert extend(near, "takes", "seen", Deadline(), told.append).name == name
    assert seen == ["", "a", ""]
    assert told == pytest.approx([0.3, 0.5, 0.8, 1.0, 0.3])


def test_with_a_law_all_is_fitted_anew_and_the_torques_have_their_say_of_it(monkeypatch):
    problem = Problem(None, (), np.ones(1), np.ones(3), torques="old")
    h = SimpleNamespace(bounds=(np.zeros(2), np.array([1.0, 0.0])))
    told = []
    monkeypatch.setattr(extension, "_joined", lambda near, chosen: (h, f"values with {chosen}"))
    monkeypatch.setattr(extension, "agreement", lambda h, prepared: ("torques", h, prepared))
    monkeypatch.setattr(extension, "weighed", lambda problem, x: (problem, x))
    monkeypatch.setattr(extension, "descend", lambda *given: told.append(given) or "fitted")
    monkeypatch.setattr(extension, "linearise", lambda weighed, x, free: (weighed, x, free.tolist()))
    monkeypatch.setattr(extension, "trusted", lambda near: ("trusted", *near))
    word, (found, at_values), x, free = extension._with(SimpleNamespace(problem=problem), "laws", "takes", "deadline")
    assert (word, at_values, x, free) == ("trusted", "fitted", "fitted", [True, False])
    assert (found.hypothesis, found.torques) == (h, ("torques", h, "takes"))
    (((begun, at_values), x, free, slopes, deadline),) = told
    assert begun == found
    assert (at_values, x, free.tolist(), slopes, deadline) == (*["values with laws"] * 2, [True, False], 2, "deadline")


def test_of_each_joint_the_best_law_by_its_slope_is_simulated_and_the_best_of_these_comes_first(monkeypatch):
    """Costs of folds to first order and in simulation; without a law 1 and 0.9."""
    laws = {  # joint, first order, simulated
        "second": (0, 0.7, 0.6), "misled": (0, 0.5, 0.89),  # the slope promises what is not kept
        "slight": (5, 0.95, 0.85), "good": (1, 0.75, 0.8), "better": (2, 0.8, 0.3),
        "weak": (3, 0.99, 0.1), "worse": (4, 1.2, 0.1),
    }  # fmt: skip
    tried = [SimpleNamespace(name=name, candidate=SimpleNamespace(joint=joint)) for name, (joint, *_) in laws.items()]
    monkeypatch.setattr(extension, "folds_of", lambda problem: 2 * np.arange(len(problem.weight)))
    monkeypatch.setattr(extension, "_beside", lambda few, offer: offer)
    monkeypatch.setattr(extension, "_nothing", lambda near: None)
    monkeypatch.setattr(extension, "_cost", lambda few, cost: [np.full(9, cost)])

    def folded(near, trials, fold, first_order=False):
        if not hasattr(near, "name"):
            few.append(near)
        assert fold.tolist() == (2 * few[0].problem.weight).tolist()  # as of all windows
        return laws[near.name][1 if first_order else 2] if hasattr(near, "name") else 1.0 if first_order else 0.9

    monkeypatch.setattr(extension, "folded", folded)
    windows = Windows(SimpleNamespace(period=0.005), np.arange(100), 2)  # of two rows each
    few, problem = [], Problem(None, (windows,), np.ones(1), np.arange(100.0), torques="said")
    rows = np.repeat(np.arange(100.0), 2)
    near = Linearised(
        problem, np.zeros(2), np.ones(2, dtype=bool), rows, np.stack([rows, -rows], -1), np.ones(3), np.ones((3, 2))
    )
    assert [offer.name for offer in _chosen(near, tried, Deadline(1000.0))] == ["better", "good", "slight"]
    part = few[0].problem
    assert part.torques is None
    assert len(part.weight) == 32
    assert part.weight.tolist() == np.linspace(0, 99, 32).astype(int).tolist()
    assert part.weight[[0, -1]].tolist() == [0, 99]  # over all of the recordings
    for one in few:
        assert one.problem is part
        assert one.errors.tolist() == np.repeat(part.weight, 2).tolist()
        assert one.columns.tolist() == np.stack([one.errors, -one.errors], -1).tolist()
        assert (one.pull.shape, one.pull_columns.shape) == ((0,), (0, 2))
    assert _chosen(near, tried, Deadline(0.0)) == []


@pytest.mark.parametrize("size", [1.0, 1e-4])
@pytest.mark.parametrize(("after", "taken"), [(0.95, True), (0.97, False)])
def test_a_gear_is_searched_for_from_the_given_and_the_fitted_joint_at_many_stiffnesses(
    monkeypatch, after, taken, size
):
    """Twice a law's share of the error must go, since all is searched for anew."""
    searched = []

    def hint(*start):
        own = tuple(Parameter(n, "1", x, 0.0, 99.0, 1.0) for n, x in (("play", 0.5), ("stiffness", 90.0)))
        return SimpleNamespace(candidate=SimpleNamespace(parameters=own), start=np.array(start))

    def search(h, takes, begin, rng, deadline, torques):
        searched.append((h, begin))
        assert (takes, rng, torques) == (("one", "two"), "dice", ("torques", h, prepared))  # in the fit's own steps
        assert deadline.seconds == pytest.approx(62.0, abs=1.0)  # all that is left
        return found

    own = SimpleNamespace(parameters=(Parameter("drag", "1", 1.0, 0.0, 9.0, 1.0),))
    windows = [SimpleNamespace(take=take) for take in ("one", "two", "one")]
    problem = SimpleNamespace(hypothesis=extension.Hypothesis((own,)), windows=windows)
    near = SimpleNamespace(problem=problem, values=np.array([2.0]), seconds=2.0)
    found = SimpleNamespace()
    hints = [hint(0.1, 10.0), hint(0.2, 20.0)]
    monkeypatch.setattr(extension, "_hints", lambda h, prepared: hints)
    monkeypatch.setattr(extension, "search", search)
    monkeypatch.setattr(extension, "agreement", lambda h, prepared: ("torques", h, prepared))
    monkeypatch.setattr(extension, "stated", lambda n: size if n is near else after * size)
    prepared = SimpleNamespace(takes="in the model's own steps")
    assert with_gear(near, prepared, "dice", Deadline(62.0)) is (found if taken else near)
    ((h, begin),) = searched
    assert h.terms == (own, hints[0].candidate)
    assert begin.shape == (1 + 25 + 25 + 1, 3)
    assert begin[[0, -1]].tolist() == [[1.0, 0.5, 90.0], [1.0, 0.2, 20.0]]  # rigid; the next hint
    assert begin[1:51, 0].tolist() == [1.0] * 25 + [2.0] * 25
    assert (begin[1:51, 1] == 0.1).all()
    assert begin[[1, 25, 26, 50], 2] == pytest.approx([4.0, 25.0, 4.0, 25.0])
    assert with_gear(near, prepared, None, Deadline(38.0)) is near
    hints.clear()
    assert with_gear(near, prepared, None, Deadline()) is near
    assert len(searched) == 1


def test_a_law_stays_where_it_saves_a_hundredth_and_more_than_a_standard_error_of_windows_that_do_not_overlap(
    monkeypatch,
):
    """Half of the windows save a fifth, half lose some: of a hundred windows that is no chance, of four it is."""
    one = np.ones(100)
    one[0] = 0.0
    saved = {"": np.ones(100), "much": np.where(np.arange(100) % 2, 0.8, 1.1), "one": one,
             "just": np.full(100, 0.985), "little": np.full(100, 0.991)}  # fmt: skip
    monkeypatch.setattr(joint_fit, "stated_of_windows", lambda near: saved[near.name])
    monkeypatch.setattr(joint_fit, "independent", lambda problem: problem)
    for name, count, better in (
        ("much", 100, True), ("much", 4, False), ("one", 100, False), ("just", 4, True), ("just", 1, False),
        ("little", 100, False), ("", 100, False),
    ):  # fmt: skip
        near, other = (Named(n, count) for n in ("", name))
        assert extension.follows_better(near, other) == better
