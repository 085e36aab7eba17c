"""What is handed over moves as what was fitted did, and holds nothing that it moves without."""

import sys
from types import SimpleNamespace

import mujoco
import numpy as np
import pytest
from diagnosis.plants import pendulum, record, smooth_torque

from torchrl_athletic.diagnosis.acting import acting
from torchrl_athletic.diagnosis.fit import Hypothesis
from torchrl_athletic.diagnosis.prepare import prepare
from torchrl_athletic.diagnosis.problem import problem_of
from torchrl_athletic.diagnosis.screen import Candidate
from torchrl_athletic.effects import ActuationDelay, EncoderOffset, Parameter, TorqueOffset, TorqueSaturation

module = sys.modules["torchrl_athletic.diagnosis.acting"]

EFFECTS = (TorqueSaturation(), TorqueOffset(), ActuationDelay(), EncoderOffset())
LIMIT = 0.6


@pytest.fixture(scope="module", params=[0.5, 3.0], ids=["never at its limit", "often at its limit"])
def fitted(request):
    """A motor with a limit, asked for so many times its limit; all terms at the given numbers."""
    xml = pendulum().replace('<motor joint="pendulum"/>', f'<motor joint="pendulum" forcerange="-{LIMIT} {LIMIT}"/>')
    model = mujoco.MjModel.from_xml_string(xml)
    torque = request.param * LIMIT * smooth_torque(4.0) / np.abs(smooth_torque(4.0)).max()
    takes = prepare([record(xml, torque)], model, xml=xml).takes
    address = takes[0].address
    h = Hypothesis(tuple(Candidate(e, 0, "pendulum", e.parameters(model, address, 0)) for e in EFFECTS))
    problem = problem_of(h, takes, 0.5, 30, np.random.default_rng(0), h.nominal)
    return problem, request.param > 1.0


@pytest.fixture
def two_joints(monkeypatch):
    """A limit of each of two joints that is met in five windows of thirty, the second's after the first's; made up.

    A term is its number, which is added to its joint's error; a limit is none but beside its joint's offset.
    """
    name = [f"{kind}_{joint}" for joint in "ab" for kind in ("offset", "limit")]
    parameter = Parameter("p", "1", 0.0, -9.0, 9.0, 1.0)
    terms = tuple(Candidate(SimpleNamespace(name=n), "ab".index(n[-1]), n[-1], (parameter,)) for n in name)
    met = np.zeros((30, 2))
    met[3:8, 0] = met[20:25, 1] = 1.0

    class Made(SimpleNamespace):
        def errors(self, values):
            out = np.zeros((len(self.met), 2))
            for c, v in zip(self.hypothesis.terms, values[0], strict=True):
                beside = any(o.joint == c.joint for o in self.hypothesis.terms if o is not c)
                out[:, c.joint] += v if "offset" in c.effect.name else beside * self.met[:, c.joint]
            return out.reshape(-1, 1)

        @property
        def window(self):
            return np.repeat(np.arange(len(self.met)), 2)

        def squares(self, errors):
            return errors.reshape(-1, 2) ** 2

    monkeypatch.setattr(module, "replace", lambda problem, hypothesis: Made(hypothesis=hypothesis, met=problem.met))
    monkeypatch.setattr(module, "part_of", lambda p, chosen: Made(met=p.met[chosen], unit=p.unit))
    return Made(hypothesis=Hypothesis(terms), met=met, unit=np.ones(2))


@pytest.mark.parametrize("told", [1, 3, 20])
def test_limits_that_are_met_in_turn_are_both_handed_over(two_joints, monkeypatch, told):
    """However few windows are asked at a time: one joint's first windows say nothing of the other's."""
    monkeypatch.setattr(module, "TOLD", told)
    x, needed = values(two_joints, offset_a=0.1, offset_b=0.2)
    assert names_of(acting(two_joints, x, needed)[0]) == {"offset_a", "limit_a", "offset_b", "limit_b"}
    two_joints.met[:, 1] = 0.02 * module.VISIBLE
    assert names_of(acting(two_joints, x, needed)[0]) == {"offset_a", "limit_a", "offset_b"}
    two_joints.met[12, 1] = 2 * module.VISIBLE
    assert "limit_b" in names_of(acting(two_joints, x, needed)[0])


def values(problem, **moved):
    """Values and what of them moved."""
    h = problem.hypothesis
    names = [c.effect.name for c in h.terms]
    x, needed = h.nominal.copy(), np.zeros(len(h.nominal), dtype=bool)
    for name, value in moved.items():
        x[names.index(name)], needed[names.index(name)] = value, True
    return x, needed


def names_of(h):
    return {c.effect.name for c in h.terms}


@pytest.mark.parametrize("moved", [{"torque_offset": 0.1}, {"torque_offset": -0.2, "actuation_delay": 0.02}])
def test_a_given_limit_that_is_met_before_an_offset_is_handed_over_beside_it(fitted, moved):
    problem, limited = fitted
    x, needed = values(problem, **moved)
    h, numbers = acting(problem, x, needed)
    assert names_of(h) == moved.keys() | ({"torque_saturation"} if limited else set())
    whole, less = (
        type(problem)(k, problem.windows, problem.unit, problem.weight).errors(v[None])
        for k, v in ((problem.hypothesis, x), (h, numbers))
    )
    np.testing.assert_allclose(less, whole, rtol=0, atol=1e-9)


def test_without_an_offset_the_given_limit_is_the_models_own(fitted):
    problem, _ = fitted
    h, numbers = acting(problem, *values(problem, actuation_delay=0.02))
    assert (names_of(h), list(numbers)) == ({"actuation_delay"}, [0.02])


def test_what_was_taken_back_takes_what_acted_beside_it_along(fitted):
    problem, _ = fitted
    x, needed = values(problem, torque_offset=0.1, actuation_delay=0.02)
    gone = [c for c in problem.hypothesis.terms if c.effect.name in ("torque_offset", "torque_saturation")]
    needed[[c in gone for c in problem.hypothesis.terms]] = False
    assert names_of(acting(problem, x, needed, gone)[0]) == {"actuation_delay"}


def test_where_nothing_moved_the_given_model_is_handed_over(fitted):
    problem, _ = fitted
    h, numbers = acting(problem, *values(problem))
    assert (h.terms, len(numbers)) == ((), 0)
