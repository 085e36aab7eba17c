"""Motors that move a joint alike are told as the given one; others stay what they are."""

from types import SimpleNamespace

import mujoco
import numpy as np
import pytest
from diagnosis.plants import STEP, pendulum, record, smooth_torque
from diagnosis.test_joint_fit import TABLE, h_places

from torchrl_athletic.diagnosis import given_scale
from torchrl_athletic.diagnosis.deadline import Deadline
from torchrl_athletic.diagnosis.descent import linearise
from torchrl_athletic.diagnosis.fit import WINDOW
from torchrl_athletic.diagnosis.given_scale import held_back, with_given_scales
from torchrl_athletic.diagnosis.joint_fit import trusted
from torchrl_athletic.diagnosis.prepare import prepare
from torchrl_athletic.diagnosis.problem import problem_of
from torchrl_athletic.diagnosis.standard import agreement, seen_in, standard_joints

WEAK = 0.2
REAL = 'armature="0.5" damping="0.3"'


def solution(xml, true_xml, **values):
    """The fit of a recording about values of the standard joint."""
    prepared = prepare([record(true_xml, smooth_torque(8.0))], mujoco.MjModel.from_xml_string(xml))
    h = standard_joints(prepared, seen_in(prepared))
    at = {c.effect.name + "." + p.name: k for k, (c, p) in enumerate(h_places(h))}
    x = h.nominal
    for name, value in values.items():
        x[at[name.replace("__", ".")]] = value
    problem = problem_of(h, prepared.takes, WINDOW, 40, np.random.default_rng(0), x)
    near = trusted(linearise(problem, x, h.bounds[1] > h.bounds[0]))
    return near, agreement(h, prepared), at


@pytest.fixture(scope="module")
def turntable():
    """A rotor of 0.5 kg·m² with a damping of 0.3 N·m·s/rad, followed by a fifth of all behind a fifth of the torque.

    The table's own 0.1 kg·m² stays: a fifth of all is a rotor of 0.02.
    """
    xml, true = (TABLE.format(0.1).replace('axis="0 0 1"', f'axis="0 0 1" {has}') for has in ("", REAL))
    values = {
        "torque_scale__scale": WEAK,
        "reflected_inertia__armature": WEAK * 0.6 - 0.1,
        "viscous_friction__damping": WEAK * 0.3,
    }
    return solution(xml, true, **values)


def test_a_motor_that_turns_as_the_given_one_does_is_the_given_one(turntable):
    near, torques, at = turntable
    error = lambda x: np.sqrt(near.problem.mean_square(x[None]).mean())  # noqa: E731
    found = with_given_scales(near, torques, Deadline())
    assert found.values[at["torque_scale.scale"]] == 1.0
    assert found.values[at["reflected_inertia.armature"]] == pytest.approx(0.5, rel=0.02)
    assert found.values[at["viscous_friction.damping"]] == pytest.approx(0.3, rel=0.1)
    assert error(found.values) < 1.05 * error(near.values)
    assert found.free.tolist() == near.free.tolist()  # the scale is asked about again


def test_a_motor_whose_links_are_too_heavy_comes_as_near_to_the_given_one_as_they_let_it():
    """The true table has half the given 0.1 kg·m²: twice the torque and no rotor, or ten times behind one of 0.4."""
    xml, true = TABLE.format(0.1), TABLE.format(0.05).replace('axis="0 0 1"', 'axis="0 0 1" damping="0.3"')
    values = {
        "torque_scale__scale": 10.0,
        "reflected_inertia__armature": 10.0 * 0.05 - 0.1,
        "viscous_friction__damping": 10.0 * 0.3,
    }
    near, torques, at = solution(xml, true, **values)
    found = with_given_scales(near, torques, Deadline())
    assert found.values[at["torque_scale.scale"]] == pytest.approx(2.0, rel=0.1)
    assert found.values[at["reflected_inertia.armature"]] == pytest.approx(0.0, abs=0.01)
    assert found.values[at["viscous_friction.damping"]] == pytest.approx(0.6, rel=0.1)


def test_a_scale_that_the_windows_tell_is_not_put_nearer(monkeypatch):
    """It may go a third of the way, and no further."""
    at = lambda x, low, high, way=1.0: {0: (np.array([0]), np.array([10.0 ** (1.0 - way)]))}  # noqa: E731
    torques, problem = SimpleNamespace(at_given_scales=at), SimpleNamespace(hypothesis=SimpleNamespace(bounds=(0, 99)))
    for most, nearest in ((10 ** (2 / 3), None), (10**0.4, 10**0.4)):
        monkeypatch.setattr(given_scale, "_cost", lambda problem, x, most=most: 1.0 if x[0] >= most else 2.0)
        found = given_scale._toward_given(problem, torques, np.array([10.0]), 0, 1.01)
        assert found is None if nearest is None else found[0] == pytest.approx(nearest, rel=0.05)
    monkeypatch.setattr(given_scale, "_cost", lambda problem, x: np.nan)
    assert given_scale._toward_given(problem, torques, np.array([10.0]), 0, 1.01) is None


def test_a_weak_motor_on_a_pendulum_stays_weak():
    """Its weight tells the scale."""
    near, torques, _ = solution(
        pendulum(STEP), pendulum(STEP).replace('mass="0.5"', f'mass="{0.5 / WEAK}"'), torque_scale__scale=WEAK
    )
    assert with_given_scales(near, torques, Deadline()) is near


def test_without_time_the_solution_stays(turntable):
    near, torques, _ = turntable
    assert with_given_scales(near, torques, Deadline(0.0)) is near


def test_what_goes_goes_to_the_given_model_and_a_scale_takes_along_what_it_scales(turntable):
    near, torques, at = turntable
    h, gone = near.problem.hypothesis, np.zeros(len(near.values), dtype=bool)
    damping, armature = at["viscous_friction.damping"], at["reflected_inertia.armature"]
    gone[damping] = True
    alone = held_back(h, torques, near.values, gone)
    assert alone[damping] == h.nominal[damping]
    assert alone[at["torque_scale.scale"]] == WEAK
    assert alone[armature] == near.values[armature]
    gone[at["torque_scale.scale"]] = True
    both = held_back(h, torques, near.values, gone)
    assert both[at["torque_scale.scale"]] == 1.0
    assert both[damping] == h.nominal[damping]
    assert both[armature] == pytest.approx(0.5, rel=0.02)
