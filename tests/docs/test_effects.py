"""The page of effects says what the catalogue holds, and its example is an effect that is found."""

import importlib.util
import re
from pathlib import Path

import mujoco
import numpy as np
import pytest
from effects.arm import JOINTS, address, arm, record

from torchrl_athletic.diagnosis.screen import Bank, candidates_for
from torchrl_athletic.diagnosis.search import Judge, search
from torchrl_athletic.effects import CATALOGUE, CoulombFriction, Effect, JointAddress, project_recording

DOCS = Path(__file__).parents[2] / "docs"
INCLUDED = (DOCS / "generated/catalogue.md").read_text(encoding="utf-8")
PAGE = (DOCS / "effects.md").read_text(encoding="utf-8").replace('--8<-- "docs/generated/catalogue.md"', INCLUDED)
OWN = PAGE[PAGE.index("## Add your own effect") :]


@pytest.fixture(scope="module")
def writer():
    spec = importlib.util.spec_from_file_location("catalogue", DOCS / "catalogue.py")
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


@pytest.fixture(scope="module")
def example() -> tuple[Effect, ...]:
    """The catalogue that the page's example makes."""
    [code] = re.findall(r"^```python\n(.*?)^```", OWN, re.S | re.M)
    scope: dict[str, object] = {}
    exec(compile(code, "docs/effects.md", "exec"), scope)
    return scope["catalogue"]


def test_the_page_includes_what_the_catalogue_writes(writer):
    assert INCLUDED in PAGE
    assert writer.page() == INCLUDED, "run python docs/catalogue.py"


@pytest.mark.parametrize("effect", CATALOGUE, ids=lambda e: e.name)
def test_each_effect_says_its_equation_parameters_fingerprint_simulation_rivals_and_source(effect):
    _, _, part = PAGE.partition(f"### {effect.name}\n")
    part = part.partition("\n### ")[0]
    for name in ("Equation", "Parameters", "Fingerprint", "Simulation", "Source"):
        assert len(re.search(rf"\*\*{name}:\*\* (.*)", part)[1]) > 2, name
    assert "Changes `" in part
    for p in effect.parameters(arm(), address(), 0):
        assert f"`{p.name}`" in part
    for rival in effect.experiments:
        assert f"| `{rival}` |" in part


def test_every_class_is_introduced_and_every_identity_stated():
    classes = PAGE[PAGE.index("## Classes") : PAGE.index("## Identities")]
    assert set(re.findall(r"^\| (\w+) \|", classes, re.M)) - {"class"} == {e.family for e in CATALOGUE}
    for effect in CATALOGUE:
        part = PAGE.partition(f"### {effect.name}\n")[2].partition("\n### ")[0]
        assert ("States the same physics as" in part) == bool(effect.identical_to)
        assert ("names no joint" in part) == effect.whole_robot


def test_dry_friction_turns_over_as_early_as_the_page_says():
    model = mujoco.MjModel.from_xml_string(
        '<mujoco><worldbody><body><joint name="joint" axis="0 1 0" frictionloss="0.1"/>'
        '<inertial pos="0 0 -0.2" mass="1" diaginertia="0.01 0.01 0.01"/></body></worldbody></mujoco>'
    )
    turnover = CoulombFriction().parameters(model, JointAddress.of(model, ("joint",)), 0)[1]
    assert f"| {1e3 * turnover.nominal:.2g} ms | a simulation's" in PAGE


def test_the_way_to_an_effect_of_ones_own_is_short():
    assert OWN.count("\n") < 60


def test_the_example_changes_nothing_at_its_given_value_and_is_found_when_it_is_there(example):
    own = example[-1]
    assert own not in CATALOGUE
    (given,) = own.parameters(arm(), address(), 0)
    np.testing.assert_array_equal(record(own, 0, [given.nominal]).position, record().position)
    recording = record(own, 0, [0.3])
    s = project_recording(recording, arm(), np.full(2, 1e-5), kernel=0.01)
    columns = own.fingerprint(s, 0, {}).columns[:, :, 0]
    assert np.vdot(columns, s.missing) / np.vdot(columns, columns) == pytest.approx(0.3, rel=0.05)
    judge = Judge(Bank([s], candidates_for([s], example)))
    best = search(judge)[0]
    assert [a.candidate.key for a in best.fit.terms] == [("air_drag", JOINTS[0])]
    assert "shoulder with 0.3 N·m·s²/rad²" in own.sentence("shoulder", {"drag": 0.3}, (given,))
