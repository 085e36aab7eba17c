"""What the motion asks for, one effect after the other: what is missing, nothing else, and what could stand there."""

from dataclasses import replace
from types import SimpleNamespace

import mujoco
import numpy as np
import pytest
from diagnosis.plants import record, smooth_torque

from torchrl_athletic.diagnosis import selection
from torchrl_athletic.diagnosis.coarse import coarse
from torchrl_athletic.diagnosis.deadline import Deadline
from torchrl_athletic.diagnosis.fit import Hypothesis
from torchrl_athletic.diagnosis.prepare import prepare
from torchrl_athletic.diagnosis.selection import LEAST, ODDS, _against, _needed, _sizes, select
from torchrl_athletic.diagnosis.standard import agreement, seen_in, standard_joints

SECONDS = 12.0


def arm(upper='damping="0.05"', lower='damping="0.02"', mass=0.4):
    """Two links that hang."""
    return f"""
<mujoco><option timestep="0.002" integrator="implicitfast"/>
  <worldbody><body name="upper"><joint name="upper" axis="0 -1 0" {upper}/>
    <inertial pos="0 0 -0.2" mass="0.6" diaginertia="0.004 0.004 0.004"/>
    <body name="lower" pos="0 0 -0.4"><joint name="lower" axis="0 -1 0" {lower}/>
      <inertial pos="0 0 -0.2" mass="{mass}" diaginertia="0.002 0.002 0.002"/></body></body></worldbody>
  <actuator><motor joint="upper"/><motor joint="lower"/></actuator>
</mujoco>"""


def command():
    return np.hstack([smooth_torque(SECONDS, 2.0, 1), smooth_torque(SECONDS, 0.8, 2)])


def problem(robot, scale=(1.0, 1.0)):
    """The given arm, recorded as ``robot`` that gives a share of the torque that is logged."""
    logged = command()
    taken = record(robot, logged * np.array(scale))
    prepared = prepare([replace(taken, torque_command=logged)], mujoco.MjModel.from_xml_string(arm()))
    h = standard_joints(prepared, seen_in(prepared))
    takes = tuple(coarse(prepared.takes, h, [h.nominal], np.random.default_rng(0)))
    return h, takes, agreement(h, prepared)


def asked(robot, scale=(1.0, 1.0), **settings):
    h, takes, torques = problem(robot, scale)
    return select(h, takes, np.random.default_rng(1), Deadline(), torques, **settings)


@pytest.mark.parametrize(
    ("robot", "scale", "key", "value"),
    [
        pytest.param(
            arm(lower='damping="0.02" frictionloss="0.06"'),
            (1, 1),
            ("coulomb_friction", "lower"),
            0.06,
            marks=pytest.mark.slow,
        ),
        (arm(upper='damping="0.05" armature="0.05"'), (1, 1), ("reflected_inertia", "upper"), 0.05),
        (arm(lower='damping="0.08"'), (1, 1), ("viscous_friction", "lower"), 0.08),
        pytest.param(arm(), (1, 0.8), ("torque_scale", "lower"), 0.8, marks=pytest.mark.slow),
    ],
)
def test_the_motion_asks_first_for_what_is_missing_and_for_nothing_beside_it(robot, scale, key, value):
    found = asked(robot, scale)
    assert found.hypothesis.terms[0].key == key
    assert found.values[0] == pytest.approx(value, rel=0.1)
    assert found.shares[0] > 0.5
    assert all(share < 0.2 for share in found.shares[1:])


def test_of_a_model_that_lacks_nothing_the_motion_asks_for_next_to_nothing():
    assert len(asked(arm()).hypothesis.terms) <= 1


def test_two_effects_are_asked_for_one_after_the_other():
    found = asked(arm(upper='damping="0.05" armature="0.05"', lower='damping="0.02" frictionloss="0.06"'))
    assert {c.key for c in found.hypothesis.terms[:2]} == {
        ("reflected_inertia", "upper"),
        ("coulomb_friction", "lower"),
    }
    assert len(found.rivals) == len(found.shares) == len(found.hypothesis.terms)


def test_what_stands_in_for_a_later_one_goes_again():
    """Viscous friction, fitted alone, takes the place of dry friction, and is not needed beside it."""
    h, takes, torques = problem(arm(lower='damping="0.02" frictionloss="0.06"'))
    chosen = [c for c in h.terms if c.key in {("viscous_friction", "lower"), ("coulomb_friction", "lower")}]
    part = selection.problem_of(h, takes, 0.5, 40, np.random.default_rng(1), h.nominal, torques)
    x = selection.descend(part, h.nominal, selection._free(h, chosen), 3, Deadline())
    x, shares = _needed(selection.weighed(part, x), x, chosen, Deadline())
    assert [c.key for c in shares] == [("coulomb_friction", "lower")]
    assert min(shares.values()) > LEAST
    gone = next(c for c in chosen if c not in shares)
    np.testing.assert_array_equal(h.values_of(gone, x), [p.nominal for p in gone.parameters])


def test_what_no_robot_can_have_is_not_chosen_however_well_it_follows(monkeypatch):
    h, takes, torques = problem(arm(lower='damping="0.3"'))
    viscous = next(c for c in h.terms if c.key == ("viscous_friction", "lower"))
    monkeypatch.setattr(type(viscous.effect), "is_physical", lambda self, parameters, values: bool(values[0] < 0.1))
    found = select(h, takes, np.random.default_rng(1), Deadline(), torques)
    assert found.hypothesis.terms
    assert viscous not in found.hypothesis.terms
    assert all(r.candidate is not viscous for rivals in found.rivals for r in rivals)


def test_nothing_is_tried_once_the_time_is_over():
    h, takes, torques = problem(arm(lower='damping="0.3"'))
    found = select(h, takes, np.random.default_rng(1), Deadline(0.0), torques)
    assert found.hypothesis.terms == ()
    assert found.values.shape == (0,)
    assert not found.complete


def test_a_limit_that_clips_is_asked_for_from_where_it_is_known_to_begin():
    """From its unit to its bound it has no size below the torques that were asked for."""
    logged = command()
    taken = record(arm(), np.stack([logged[:, 0], np.clip(logged[:, 1], -0.25, 0.25)], 1))
    prepared = prepare([replace(taken, torque_command=logged)], mujoco.MjModel.from_xml_string(arm()))
    h = standard_joints(prepared, seen_in(prepared))
    limit = next(c for c in h.terms if c.key == ("torque_saturation", "lower"))
    takes = tuple(coarse(prepared.takes, h, [h.nominal], np.random.default_rng(0)))
    asked = np.abs(logged[:, 1]).max()
    starts = {limit: [np.array([share * asked]) for share in (0.4, 0.7, 0.9)]}
    found = select(h, takes, np.random.default_rng(1), Deadline(), agreement(h, prepared), starts)
    assert found.hypothesis.terms[0] is limit
    assert found.values[0] == pytest.approx(0.25, rel=0.05)
    assert found.complete


def test_sizes_reach_from_a_unit_to_the_bound_on_either_side_and_leave_the_rest():
    h, _, _ = problem(arm())
    scale = next(c for c in h.terms if c.key == ("torque_scale", "lower"))
    others = Hypothesis(tuple(c for c in h.terms if c is not scale))
    sets = np.array(_sizes(h, scale, h.nominal))
    own = h.values_of(scale, sets)[:, 0]
    assert (own < 1).sum() == (own > 1).sum() == selection.SIZES
    assert scale.parameters[0].lower < own.min() < 0.2
    assert 15 < own.max() < scale.parameters[0].upper
    for c in others.terms:
        assert (h.values_of(c, sets) == h.values_of(c, h.nominal)).all()


def test_rivals_are_weighed_by_how_surely_they_follow_worse():
    rng = np.random.default_rng(0)
    noise = rng.standard_normal(400)
    noise = (noise - noise.mean()) / noise.std()
    assert _against(noise, 400) == pytest.approx(0.0, abs=1e-9)
    assert _against(0.1 * noise + 0.02, 100) == pytest.approx(4.0)  # a tenth over the root of a hundred, twice
    assert _against(np.full(10, 1.0), 10) == ODDS**2
    assert _against(np.full(10, -1.0), 10) == 0.0  # one that follows better is no worse


@pytest.mark.parametrize(
    ("steps", "joints", "targets", "windows"),
    [(100, 6, False, (40, 24)), (250, 2, False, (40, 24)), (250, 6, True, (16, 10)), (500, 7, True, (10, 10))],
)
def test_arms_that_follow_targets_are_asked_over_fewer_windows(monkeypatch, steps, joints, targets, windows):
    recording = SimpleNamespace(position_target=targets or None)
    model = SimpleNamespace(opt=SimpleNamespace(timestep=0.5 / steps))
    take = SimpleNamespace(recording=recording, model=model, address=SimpleNamespace(dof=range(joints)))
    asked = []
    monkeypatch.setattr(selection, "problem_of", lambda h, takes, seconds, most, *_: asked.append(most) or "problem")
    monkeypatch.setattr(selection, "evenly", lambda problem, count: asked.append(count))
    monkeypatch.setattr(selection, "part_of", lambda problem, chosen: problem)
    monkeypatch.setattr(selection, "weighed", lambda problem, x: problem)
    monkeypatch.setattr(selection, "_needed", lambda problem, x, chosen, deadline: (x, {}))
    select(Hypothesis(()), [take], np.random.default_rng(0), Deadline(0.0))
    assert tuple(asked) == windows
