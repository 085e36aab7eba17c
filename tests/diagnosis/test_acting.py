"""What is handed over moves as what was fitted did, and holds nothing that it moves without."""

import mujoco
import numpy as np
import pytest
from diagnosis.plants import pendulum, record, smooth_torque

from torchrl_athletic.diagnosis.acting import acting
from torchrl_athletic.diagnosis.fit import Hypothesis
from torchrl_athletic.diagnosis.prepare import prepare
from torchrl_athletic.diagnosis.problem import problem_of
from torchrl_athletic.diagnosis.screen import Candidate
from torchrl_athletic.effects import ActuationDelay, EncoderOffset, TorqueOffset, TorqueSaturation

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
