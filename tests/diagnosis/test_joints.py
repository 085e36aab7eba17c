"""The fit of the standard joints as a trial: its draws, what of it is a name, and its way through a checkpoint."""

import json
from types import SimpleNamespace

import mujoco
import numpy as np
import pytest
from diagnosis.plants import pendulum

from torchrl_athletic.diagnosis.corrected import Simulation
from torchrl_athletic.diagnosis.fit import Hypothesis
from torchrl_athletic.diagnosis.fitting import JointParameter
from torchrl_athletic.diagnosis.joints import _decode, _encode, _with_draws, standard_joints_of
from torchrl_athletic.diagnosis.screen import Candidate
from torchrl_athletic.diagnosis.stages import Given
from torchrl_athletic.effects import CATALOGUE, FIT_TRIMS, JointAddress


def fit(catalogue=tuple(CATALOGUE)):
    """Three numbers with intervals of unlike widths, of which the last one is what every model is a little wrong in."""
    model, names = mujoco.MjModel.from_xml_string(pendulum()), ("pendulum",)
    address = JointAddress.of(model, names)
    dry, damping = (next(e for e in CATALOGUE if e.name == name) for name in ("coulomb_friction", "viscous_friction"))
    trim = next(e for e in FIT_TRIMS if e.name not in {e.name for e in CATALOGUE})
    terms = tuple(Candidate(e, 0, "pendulum", e.parameters(model, address, 0)) for e in (trim, damping, dry))
    h = Hypothesis(terms)
    values = np.array([p.nominal + 0.3 * (p.upper - p.nominal) for p in h.parameters])
    widths = 1e-3 * (1.0 + np.arange(len(values)))
    place = [(c, p) for c in terms for p in c.parameters]
    said = [
        JointParameter(c.where, c.effect.name, p.name, p.unit, p.nominal, v, (v - w / 2, v + w / 2), "identified")
        for (c, p), v, w in zip(place, values, widths, strict=True)
    ]
    given = Given(model, "", "", (), (), catalogue, seed=3)
    found = SimpleNamespace(corrected=Simulation(model, names, h, values), parameters=said[::-1])
    return _with_draws(found, given), h, values, widths


def test_draws_have_the_widths_of_the_stated_intervals_each_its_own():
    drawn, h, values, widths = fit()
    for c in h.terms:
        samples, own = drawn.hypothesis.values_of(c, drawn.samples), h.values_of(c, values)
        np.testing.assert_array_equal(drawn.hypothesis.values_of(c, drawn.values), own)
        low, high = np.quantile(samples, [0.025, 0.975], axis=0)
        np.testing.assert_allclose(high - low, h.values_of(c, widths), rtol=0.25)
        np.testing.assert_allclose(samples.mean(0), own, atol=2e-3)


def test_what_is_no_effect_of_the_catalogue_is_a_trim():
    drawn, h, _, _ = fit()
    trim, *terms = h.terms
    assert drawn.hypothesis.trims == (trim,)
    assert drawn.hypothesis.terms == tuple(terms)
    drawn, h, _, _ = fit((*CATALOGUE, trim.effect))  # whoever wants it named gets a name
    assert (drawn.hypothesis.trims, drawn.hypothesis.terms) == ((), h.terms)


def test_a_fit_comes_back_from_a_checkpoint_as_it_was():
    drawn, _, _, _ = fit()
    known = {e.name: e for e in (*FIT_TRIMS, *CATALOGUE)}
    again = _decode(json.loads(json.dumps(_encode(drawn))), known)
    for group in ("terms", "trims"):
        ours, theirs = (getattr(f.hypothesis, group) for f in (again, drawn))
        assert [(c.key, c.joint, c.parameters) for c in ours] == [(c.key, c.joint, c.parameters) for c in theirs]
    np.testing.assert_array_equal(again.values, drawn.values)
    np.testing.assert_array_equal(again.samples, drawn.samples)
    assert again.values == pytest.approx(drawn.values)


def test_with_an_empty_catalogue_nothing_is_fitted_since_nothing_could_be_kept():
    unasked = SimpleNamespace(result=lambda *told: pytest.fail("a fit was asked for"))
    assert standard_joints_of(SimpleNamespace(catalogue=()), SimpleNamespace(checkpoint=unasked)) is None
