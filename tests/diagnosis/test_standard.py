"""The standard joint: what its numbers may be, and where the search for them begins."""

from dataclasses import replace

import mujoco
import numpy as np
import pytest
from diagnosis.plants import candidate, double_pendulum, pendulum, record, smooth_torque

from torchrl_athletic.diagnosis.coarse import coarse
from torchrl_athletic.diagnosis.deadline import Deadline
from torchrl_athletic.diagnosis.fit import Hypothesis
from torchrl_athletic.diagnosis.prepare import prepare
from torchrl_athletic.diagnosis.selection import select
from torchrl_athletic.diagnosis.standard import (
    DELAYS,
    LIMITS,
    NONLINEAR,
    Seen,
    agreement,
    columns_of,
    seen_in,
    standard_joints,
    starts,
    torque_domain,
)
from torchrl_athletic.effects import JointStop
from torchrl_athletic.effects.torque import torque_bound

SEEN = Seen(*(np.array([x]) for x in (5.0, 8.0, 2.0, 4.0, 0.1, 1.0)), period=0.03)
"""Asked for 5 N·m, needed 8 N·m, moved at 2 rad/s and 4 rad/s²."""


def prepared(*takes, xml=None):
    return prepare(takes, mujoco.MjModel.from_xml_string(pendulum() if xml is None else xml))


def swing(seed=0, seconds=2.0, xml=None, **servo):
    return record(pendulum() if xml is None else xml, smooth_torque(seconds, 1.5, seed), seed=seed, **servo)


def gains(kp, kd):
    return {"kp": np.array([kp]), "kd": np.array([kd])}


def by_name(h, what):
    return {(c.effect.name, p.name): what(p) for c in h.terms for p in c.parameters}


def given(p):
    return p.nominal


@pytest.fixture(scope="module")
def driven():
    """By torques; more damping than the model has, and dry friction."""
    stiff = pendulum(joint='damping="0.15" frictionloss="0.1"')
    return prepared(swing(1, 4.0, stiff), swing(2, 4.0, stiff))


@pytest.fixture(scope="module")
def followed():
    return prepared(swing(**gains(8.0, 0.5)))


def test_a_number_may_be_ten_times_what_the_recordings_hold_and_an_offset_pushes_either_way(driven):
    h = standard_joints(driven, SEEN)
    bounds = by_name(h, lambda p: (p.lower, p.upper))
    model, address = driven.takes[0].model, driven.takes[0].address
    assert bounds["coulomb_friction", "torque"] == (0.0, 80.0)
    assert bounds["coulomb_friction", "turnover"][0] == bounds["coulomb_friction", "turnover"][1]
    assert bounds["viscous_friction", "damping"] == (0.0, 40.0)
    assert bounds["reflected_inertia", "armature"] == (0.0, 20.0)
    assert bounds["actuation_delay", "delay"] == (0.0, pytest.approx(0.3))  # ten samples
    assert bounds["torque_offset", "torque"] == (-8.0, 8.0)
    assert bounds["torque_scale", "scale"] == (0.05, 20.0)
    # a limit below a fiftieth of what was asked for would explain any motion; above, the effect's own bound holds
    assert bounds["torque_saturation", "limit"] == (0.1, 2e6 * torque_bound(model, address, 0))
    assert -bounds["encoder_offset", "offset"][0] == bounds["encoder_offset", "offset"][1] > 0
    units = by_name(h, lambda p: p.scale)
    assert units["coulomb_friction", "torque"] == units["torque_offset", "torque"] == pytest.approx(0.16)
    assert units["viscous_friction", "damping"] == pytest.approx(0.08)
    assert units["torque_saturation", "limit"] == pytest.approx(0.1)


def test_what_little_was_seen_narrows_neither_an_effects_own_bound_nor_the_given_model(driven):
    """A rotor of twenty links, 0.2 s of delay, and the model's own damping."""
    own = {(c.effect.name, p.name): p for c in standard_joints(driven, SEEN).terms
           for p in c.effect.parameters(driven.takes[0].model, driven.takes[0].address, 0)}  # fmt: skip
    tiny = replace(SEEN, torque=np.array([1e-6]), period=1e-4)
    bounds = by_name(standard_joints(driven, tiny), lambda p: (p.lower, p.upper))
    for name in (("reflected_inertia", "armature"), ("actuation_delay", "delay")):
        assert bounds[name] == (0.0, own[name].upper)
    assert bounds["viscous_friction", "damping"] == (0.0, own["viscous_friction", "damping"].nominal) == (0.0, 0.05)
    asked = replace(SEEN, asked=np.array([1e12]))
    limit = own["torque_saturation", "limit"]
    assert by_name(standard_joints(driven, asked), lambda p: p.lower)["torque_saturation", "limit"] == limit.nominal


def test_gains_are_asked_for_where_positions_were_commanded_and_several_gains_tell_them(driven, followed):
    assert ("torque_scale", "scale") not in by_name(standard_joints(followed, SEEN), given)
    assert ("gain_mismatch", "kp_scale") not in by_name(standard_joints(driven, SEEN), given)
    one = by_name(standard_joints(followed, SEEN), lambda p: (p.lower, p.upper))
    assert one["gain_mismatch", "kp_scale"] == (0.01, 100.0)
    assert one["gain_mismatch", "kd_scale"] == (1.0, 1.0)  # it damps as viscous friction does
    several = prepared(swing(**gains(8.0, 0.5)), swing(1, **gains(8.0, 1.0)))
    assert by_name(standard_joints(several, SEEN), lambda p: (p.lower, p.upper))["gain_mismatch", "kd_scale"] == (
        0.01,
        100.0,
    )
    mixed = by_name(standard_joints(prepared(swing(2), swing(**gains(8.0, 0.5))), SEEN), lambda p: (p.lower, p.upper))
    assert mixed["gain_mismatch", "kp_scale"] == mixed["gain_mismatch", "kd_scale"] == (0.01, 100.0)
    assert ("torque_scale", "scale") not in mixed
    limp = prepared(*(swing(k, start=0.8, **gains(0.0, kd)) for k, kd in enumerate((0.05, 0.1))))
    held = by_name(standard_joints(limp, SEEN), lambda p: (p.lower, p.upper))
    assert held["gain_mismatch", "kp_scale"] == (1.0, 1.0)


def test_what_is_seen_is_the_largest_of_all_takes_and_no_more_than_the_motor_has():
    slow, fast = swing(1), replace(swing(2, 3.0, rate=50.0))
    both = prepared(slow, fast)
    seen = seen_in(both)
    asked = max(np.abs(r.torque_command).max() for r in (slow, fast))
    assert seen.asked == pytest.approx(asked, rel=1e-6)
    assert seen.period == pytest.approx(0.02, rel=1e-6)
    speeds = np.concatenate([t.velocity for t in both.takes])
    assert seen.speed == pytest.approx(np.sqrt(np.mean(speeds**2)))
    assert seen.acceleration == pytest.approx(
        np.sqrt(np.mean(np.concatenate([s.acceleration for s in both.signals]) ** 2))
    )
    assert seen.inertia == pytest.approx(0.09)
    assert seen.travel == pytest.approx(np.ptp(np.concatenate([slow.position, fast.position])), rel=1e-2)
    needed = max(np.quantile(np.abs(s.required), 0.99) for s in both.signals)
    assert seen.torque == pytest.approx(max(asked, needed))
    beside = replace(slow, position=slow.position + 1.0)
    assert seen_in(prepared(slow, beside)).travel == pytest.approx(np.ptp(slow.position) + 1.0, rel=1e-2)
    logged = [replace(r, torque_command=0.1 * r.torque_command) for r in (slow, fast)]  # in another unit
    assert seen_in(prepared(*logged)).torque == pytest.approx(needed)
    motor = f'<motor joint="pendulum" ctrlrange="{-0.8 * asked} {0.8 * asked}"/>'
    limited = seen_in(prepared(slow, fast, xml=pendulum().replace('<motor joint="pendulum"/>', motor)))
    assert limited.asked == pytest.approx(0.8 * asked)


def test_the_torques_tell_friction_and_damping_before_any_simulation(driven):
    h = standard_joints(driven, seen_in(driven))
    x = torque_domain(h, driven)
    found = dict(zip(by_name(h, given), x, strict=True))
    assert found["viscous_friction", "damping"] == pytest.approx(0.15, abs=0.03)
    assert found["coulomb_friction", "torque"] == pytest.approx(0.1, abs=0.02)
    model = by_name(h, given)
    for name in (("actuation_delay", "delay"), ("torque_saturation", "limit"), ("encoder_offset", "offset")):
        assert found[name] == model[name]


def test_a_search_begins_at_the_model_the_regression_its_neighbours_and_plausible_joints(driven):
    h = standard_joints(driven, SEEN)
    names = list(by_name(h, given))
    first, again, other = (starts(h, driven, SEEN, np.random.default_rng(seed), 200) for seed in (0, 0, 1))
    assert first.shape == (2 + len(DELAYS) + len(LIMITS) + 200, len(names))
    np.testing.assert_array_equal(first, again)
    assert (first[9:] != other[9:]).any()
    np.testing.assert_array_equal(first[0], h.nominal)
    regressed = np.clip(torque_domain(h, driven), *h.bounds)
    np.testing.assert_allclose(first[1], regressed)
    for rows, column, values in (
        (slice(2, 6), names.index(("actuation_delay", "delay")), 0.03 * np.array([0.5, 1, 2, 4])),
        (slice(6, 9), names.index(("torque_saturation", "limit")), 5.0 * np.array([0.4, 0.7, 0.9])),
    ):
        np.testing.assert_allclose(first[rows, column], values)
        beside = np.arange(len(names)) != column
        np.testing.assert_allclose(first[rows][:, beside], np.tile(regressed[beside], (len(values), 1)))
    tiny = replace(SEEN, torque=np.array([1e-6]))
    small = standard_joints(driven, tiny)
    for one, begun in ((h, first), (small, starts(small, driven, tiny, np.random.default_rng(0), 200))):
        low, high = one.bounds
        assert ((begun >= low) & (begun <= high)).all()
    assert_drawn(h, first[9:])


@pytest.mark.parametrize("kds", [(0.5,), (0.5, 1.0)])
def test_gains_are_drawn_over_two_decades(kds):
    takes = prepared(*(swing(k, **gains(8.0, kd)) for k, kd in enumerate(kds)))
    h = standard_joints(takes, SEEN)
    assert_drawn(h, starts(h, takes, SEEN, np.random.default_rng(0), 200)[9:])


def assert_drawn(h, begun):
    """Each number is the given model's every other time, else as many of its own size as a plausible joint has."""
    names = list(by_name(h, given))
    drawn = dict(zip(names, begun.T, strict=True))
    model = by_name(h, given)
    decades = {  # in sizes of what was seen
        ("coulomb_friction", "torque"): (8.0, -2.5, -0.3),
        ("viscous_friction", "damping"): (4.0, -2.5, -0.3),
        ("reflected_inertia", "armature"): (0.1, -1.5, 1.5),
        ("actuation_delay", "delay"): (0.03, -0.5, 0.7),
        ("torque_saturation", "limit"): (5.0, -0.5, 0.0),
        ("torque_scale", "scale"): (1.0, -0.5, 0.5),
        ("gain_mismatch", "kp_scale"): (1.0, -1.0, 1.0),
        ("gain_mismatch", "kd_scale"): (1.0, -1.0, 1.0),
    }
    fixed = by_name(h, lambda p: p.lower == p.upper)
    for name, (size, least, most) in decades.items():
        if fixed.get(name, True):
            continue
        moved = drawn[name] != model[name]
        assert 0.35 < moved.mean() < 0.65, name  # each is the given model's every other time
        log = np.log10(drawn[name][moved] / size)
        assert least <= log.min() < least + 0.15 * (most - least), name
        assert most - 0.15 * (most - least) < log.max() <= most + 1e-9, name
    for name in (("torque_offset", "torque"), ("encoder_offset", "offset"), ("coulomb_friction", "turnover")):
        assert (drawn[name] == model[name]).all(), name


@pytest.mark.parametrize("kind", ["driven", "followed"])
def test_squares_of_the_rows_are_how_much_more_variance_values_leave_than_the_best_ones(kind, request):
    """By hand: the motor's torque is a scale-th of what motion, rotor and friction ask for; a servo has no scale."""
    takes = request.getfixturevalue(kind)
    h = standard_joints(takes, seen_in(takes))
    names = list(by_name(h, given))
    good = np.concatenate([s.valid[:, 0] for s in takes.signals])
    required, missing = (
        np.concatenate([getattr(s, name)[:, 0] for s in takes.signals])[good] for name in ("required", "missing")
    )
    columns, prints = [], []
    for c in h.terms:
        if c.effect.name in (*NONLINEAR, "torque_scale"):
            continue
        for k, column in enumerate(np.concatenate([part[:, 0] for part in columns_of(c, takes)])[good].T):
            if c.parameters[k].lower < c.parameters[k].upper:
                columns.append(names.index((c.effect.name, c.parameters[k].name)))
                prints.append(column)
    prints = np.stack(prints, -1)
    scales = kind == "driven"
    values = np.tile(h.nominal, (3, 1))
    values[1:, columns] += 0.05 * np.random.default_rng(0).random((2, len(columns)))
    if scales:
        values[1:, names.index(("torque_scale", "scale"))] = 0.8, 1.3
    design = np.column_stack([required, prints]) if scales else prints
    least = np.mean((missing - design @ np.linalg.lstsq(design, missing)[0]) ** 2)
    expected = []
    for x in values:
        scale = x[names.index(("torque_scale", "scale"))] if scales else 1.0
        told = (1 - 1 / scale) * required + prints @ (x[columns] - h.nominal[columns]) / scale
        expected.append(np.mean((missing - told) ** 2) / least - 1)
    found = (agreement(h, takes).rows(values) ** 2).sum(0)
    np.testing.assert_allclose(found, expected, rtol=1e-3)


def test_each_joint_of_two_has_its_own_friction():
    """The lower one's torques say nothing of the upper one's friction, though both are coupled."""
    stiff = double_pendulum().replace('name="lower" axis', 'name="lower" frictionloss="0.1" axis')
    command = np.hstack([smooth_torque(4.0, 1.5, 1), smooth_torque(4.0, 0.8, 2)])
    takes = prepared(record(stiff, command), xml=double_pendulum())
    logged = prepared(replace(record(stiff, command), torque_command=0.01 * command), xml=double_pendulum())
    least = [np.quantile(np.abs(logged.signals[0].required[:, j]), 0.99) for j in range(2)]
    np.testing.assert_allclose(seen_in(logged).torque, least)  # each by its own motion
    seen = seen_in(takes)
    h = standard_joints(takes, seen)
    x = torque_domain(h, takes)
    found = {c.joint_name: h.values_of(c, x)[0] for c in h.terms if c.effect.name == "coulomb_friction"}
    assert found["lower"] == pytest.approx(0.1, abs=0.02)
    assert abs(found["upper"]) < 0.02
    big = Seen(*(np.array([x, 100 * x]) for x in (5.0, 8.0, 2.0, 4.0, 0.1, 1.0)), period=0.03)
    wide = standard_joints(takes, big)
    drawn = starts(wide, takes, big, np.random.default_rng(0), 50)[9:]
    for c in wide.terms:
        least = {"reflected_inertia": 0.1 * 10**-1.5, "torque_saturation": 5.0 * 10**-0.5}.get(c.effect.name)
        if least is not None:
            own = wide.values_of(c, drawn)[:, 0]
            own = own[own != c.parameters[0].nominal] / 100.0**c.joint
            assert len(own) > 10
            assert (own >= 0.99 * least).all()
            assert (own <= 1e3 * least).all()
    values = np.stack([h.nominal, x])
    assert len(agreement(h, takes).parts) == 2
    cost = (agreement(h, takes).rows(values) ** 2).sum(0)
    assert cost[1] < 0.1 * cost[0]
    (signals,) = takes.signals
    signals.valid[:, 0] = np.arange(len(signals.valid)) % 100 == 50  # so little says nothing of the upper one
    seldom = torque_domain(h, takes)
    for c in h.terms:
        same = h.values_of(c, seldom) == h.values_of(c, h.nominal if c.joint_name == "upper" else x)
        assert same.all(), c.key
    assert len(agreement(h, takes).parts) == 1


def test_joints_in_another_order_are_the_same_joints():
    """Unlike in their loads, their motors' ranges, their torques' unit and their gains."""
    motors = '<motor joint="upper" ctrlrange="-1 1"/><motor joint="lower" ctrlrange="-0.1 0.2"/>'
    xml = double_pendulum().replace("</mujoco>", f"<actuator>{motors}</actuator></mujoco>")
    torque = np.hstack([smooth_torque(2.0, 1.5, 1), smooth_torque(2.0, 0.8, 2)])
    driven = replace(record(xml, torque), torque_command=torque * [0.1, 1.0])
    followed = [
        record(xml, np.hstack([smooth_torque(2.0, 0.3, k), smooth_torque(2.0, 0.6, k + 1)]), kp=np.array([8.0, 3.0]),
               kd=np.array([0.5, kd])) for k, kd in ((1, 0.1), (2, 0.2))
    ]  # fmt: skip
    for takes in ([driven], followed):
        told = []
        for names in (("upper", "lower"), ("lower", "upper")):
            one = prepared(*(r.ordered(names) for r in takes), xml=xml)
            seen = seen_in(one)
            h = standard_joints(one, seen)
            begun = starts(h, one, seen, np.random.default_rng(0), 0)
            keys = [(*c.key, p.name) for c in h.terms for p in c.parameters]
            numbers = {
                key: (p.lower, p.upper, p.scale, *x) for key, p, x in zip(keys, h.parameters, begun.T, strict=True)
            }
            for name in ("asked", "torque", "speed", "acceleration", "inertia", "travel"):
                numbers.update({(name, joint): value for joint, value in zip(names, getattr(seen, name), strict=True)})
            cost = (agreement(h, one).rows(begun) ** 2).sum(0)
            told.append(numbers | {"torques": cost})
        own, turned = told
        assert own.keys() == turned.keys()
        assert own["asked", "lower"] == pytest.approx(0.2)  # either way is as far as a limit may have to reach
        for key, numbers in own.items():
            assert turned[key] == pytest.approx(numbers, rel=1e-4, abs=1e-6), key


def test_gains_are_told_by_the_takes_that_follow_targets_beside_others_that_do_not():
    """A loop that is a fifth stiffer than was logged; in the takes of torques no gain acts."""
    followed = [replace(swing(k, **gains(9.6, kd)), kp=np.array([8.0])) for k, kd in ((1, 0.5), (2, 0.25))]
    takes = prepared(swing(3), *followed)
    h = standard_joints(takes, seen_in(takes))
    (gain,) = (c for c in h.terms if c.effect.name == "gain_mismatch")
    blocks = columns_of(gain, takes)
    assert [block.shape for block in blocks] == [(*s.missing.shape, 2) for s in takes.signals]
    assert [bool(block.any()) for block in blocks] == [s.recording.position_target is not None for s in takes.signals]
    x = torque_domain(h, takes)
    assert h.values_of(gain, x) == pytest.approx([1.2, 1.0], abs=0.05)
    cost = (agreement(h, takes).rows(np.stack([h.nominal, x])) ** 2).sum(0)
    assert cost[1] < 0.1 * cost[0]


def test_the_columns_of_an_effect_are_of_the_numbers_that_its_grid_does_not_hold(driven):
    """A stop's columns are its spring's and its damper's, wherever it is: where it stands contradicts no torque."""
    h = standard_joints(driven, seen_in(driven))
    stop = candidate(JointStop(), driven.takes[0].recording, pendulum())
    both = Hypothesis((*h.terms, stop))
    told, size = agreement(both, driven), len(both.nominal)
    place = [p.name for p in stop.parameters].index("position")
    moved = np.tile(both.nominal, (2, 1))
    moved[1, size - len(stop.parameters) + place] = stop.parameters[place].upper
    rows = (told.rows(moved) ** 2).sum(0)
    assert rows[0] == pytest.approx(rows[1])


def test_a_servo_that_sticks_is_asked_about_along_its_targets():
    """Position targets close the loop in the simulation, whose steps are finer."""
    robot = pendulum(joint='damping="0.05" frictionloss="0.15"')
    targets = smooth_torque(8.0, 1.5, 1)
    takes = prepared(record(robot, targets, **gains(8.0, 0.5)))
    h = standard_joints(takes, seen_in(takes))
    copies = tuple(coarse(takes.takes, h, [h.nominal], np.random.default_rng(0)))
    found = select(h, copies, np.random.default_rng(1), Deadline(), agreement(h, takes))
    assert found.hypothesis.terms[0].effect.name == "coulomb_friction"
    assert found.values[0] == pytest.approx(0.15, rel=0.1)
