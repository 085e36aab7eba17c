"""Iterated local search: a joint that sticks comes free, and nothing that goes astray is kept."""

import sys

import mujoco
import numpy as np
import pytest
from diagnosis.plants import pendulum, smooth_torque
from diagnosis.test_fitting import STEP, integrated, recording
from diagnosis.test_problem import each_its_own, following

from torchrl_athletic.diagnosis.deadline import Deadline
from torchrl_athletic.diagnosis.descent import descend
from torchrl_athletic.diagnosis.iterated import iterated_local_search
from torchrl_athletic.diagnosis.prepare import prepare
from torchrl_athletic.diagnosis.problem import problem_of, weighed
from torchrl_athletic.diagnosis.standard import seen_in, standard_joints

module = sys.modules["torchrl_athletic.diagnosis.iterated"]


@pytest.mark.parametrize("seed", range(3))
def test_a_joint_that_sticks_comes_free(seed):
    """Much dry friction and hardly any torque: no small change of any number moves it."""
    command = smooth_torque(4.0, 2.5, 1)
    take = recording(command, integrated(command, friction=0.1, scale=0.8))
    prepared = prepare([take], mujoco.MjModel.from_xml_string(pendulum(STEP)))
    h = standard_joints(prepared, seen_in(prepared))
    rng = np.random.default_rng(seed)
    problem = problem_of(h, prepared.takes, 0.5, 20, rng, h.nominal)
    stuck = h.nominal
    names = [(c.effect.name, p.name) for c in h.terms for p in c.parameters]
    stuck[names.index(("coulomb_friction", "torque"))] = 10 * np.abs(command).max()
    stuck[names.index(("torque_saturation", "limit"))] = 0.02 * np.abs(command).max()
    ends = [
        descend(weighed(problem, stuck), stuck, h.bounds[1] > h.bounds[0], 4, Deadline()),
        iterated_local_search(problem, stuck, rng, Deadline()),
    ]
    before, after = problem.mean_square(np.stack(ends)).mean((1, 2))
    assert after < 0.01 * before


@pytest.mark.parametrize(
    ("moved", "kept"),
    [((1.0, 9.0), (1.0, 3.0)), ((9.0, 1.0), (2.0, 1.0)), ((9.0, 9.0), (2.0, 3.0)), ((1.5, 1.5), (1.5, 1.5))],
)
def test_each_joint_keeps_what_follows_better(monkeypatch, moved, kept):
    problem, _ = following(monkeypatch, each_its_own(1.0, 1.0), nominal=(0.0, 0.0))
    for w in problem.windows:
        w.take.measured = np.ones((9, 2))
    descents = []

    def astray(problem, x, free, slopes, deadline):
        descents.append(x)
        return np.array(moved)

    monkeypatch.setattr(module, "descend", astray)
    x = np.array([2.0, 3.0])
    assert iterated_local_search(problem, x, np.random.default_rng(0), Deadline()).tolist() == list(kept)
    assert len(descents) == (1 if kept == (2.0, 3.0) else 2)  # a round that saves nothing is the last one


def test_a_descent_begins_at_each_joints_best_kick_within_the_bounds(monkeypatch):
    problem, asked = following(monkeypatch, each_its_own(1.0), nominal=(0.0, 0.0), low=-2.0, high=4.0)
    problem.windows[0].take.measured = np.array([[0.0, 0.0]] + 4 * [[1.0, -1.0]])
    begun = []
    monkeypatch.setattr(module, "descend", lambda problem, x, *_: begun.append(x) or x)
    iterated_local_search(problem, np.array([4.0, 4.0]), np.random.default_rng(0), Deadline())
    kicks = asked[0]
    assert kicks.shape == (module.KICKS, 2)
    assert kicks.min() >= -2.0
    assert kicks.max() <= 4.0
    assert begun[0].tolist() == [kicks[np.abs(kicks[:, 0] - 1).argmin(), 0], kicks[np.abs(kicks[:, 1] + 1).argmin(), 1]]


def test_the_torques_have_their_say_and_no_round_is_begun_too_late(monkeypatch):
    class Say:
        def rows(self, values):
            return 1e3 * (values.T - 2.0)

    problem, _ = following(monkeypatch, each_its_own(1.0), torques=Say())
    monkeypatch.setattr(module, "descend", lambda problem, x, *_: np.ones(1))
    x = np.array([2.0])
    assert iterated_local_search(problem, x, np.random.default_rng(0), Deadline()).tolist() == [2.0]
    monkeypatch.setattr(problem.torques, "rows", lambda values: 0.0 * values.T, raising=False)
    assert iterated_local_search(problem, x, np.random.default_rng(0), Deadline(-1.0)).tolist() == [2.0]
    assert iterated_local_search(problem, x, np.random.default_rng(0), Deadline()).tolist() == [1.0]
