"""The page on the diagnosis states the numbers and the fields that the code has."""

import importlib
import importlib.util
import re
from dataclasses import fields, is_dataclass
from pathlib import Path

import numpy as np
import pytest

from torchrl_athletic.diagnosis import Answer, Finding, Location, Rival, Score, thresholds
from torchrl_athletic.diagnosis.calibration import Grounds
from torchrl_athletic.diagnosis.corrected import SCHEMA
from torchrl_athletic.diagnosis.result import SCHEMA as ANSWER_SCHEMA
from torchrl_athletic.diagnosis.thresholds import SEARCH
from torchrl_athletic.effects import CATALOGUE, FIT_TRIMS, TRIMS

DOCS = Path(__file__).parents[2] / "docs"
PAGE = (DOCS / "diagnosis.md").read_text(encoding="utf-8")
FILES = PAGE[PAGE.index("## What is written") : PAGE.index("## Stopping")]


@pytest.fixture(scope="module")
def hook():
    """What writes the tables of thresholds as the pages are built."""
    spec = importlib.util.spec_from_file_location("tables", DOCS / "tables.py")
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


def test_thresholds_are_the_codes(hook):
    page = hook.on_page_markdown(PAGE)
    rows = re.findall(r"^\| `([a-z.]+)\.(\w+)` \| ([^|]+) \| ([^|]*) \| ([^|]*) \| [^|]{10,} \|$", page, re.M)
    assert len(rows) > 60
    for section, name, value, unit, kind in rows:
        if name.isupper():
            module = importlib.import_module(f"torchrl_athletic.{section}")
            given = getattr(module, name)
        else:
            given = getattr(getattr(thresholds, section.upper()), name)
            assert unit.strip()
            assert kind.strip() in KINDS
        np.testing.assert_allclose(np.atleast_1d(given), [float(number) for number in value.split(",")], rtol=1e-5)


KINDS = {"statistical", "physical", "tuned", "budget", "measured", "contract"}


def test_every_threshold_stands_in_a_table(hook):
    pages = hook.on_page_markdown(PAGE) + hook.on_page_markdown((DOCS / "experiments.md").read_text(encoding="utf-8"))
    sections = [kind for kind in vars(thresholds).values() if isinstance(kind, type) and is_dataclass(kind)]
    assert len(sections) >= 7
    missing = [f"{s.__name__}.{f.name}" for s in sections for f in fields(s)]
    assert [name for name in missing if f"`{name[0].lower()}{name[1:]}`" not in pages] == []


def test_trims_of_naming_and_of_the_fit():
    """Their tolerances are written from the code into the page of effects."""
    trims = " ".join(PAGE[PAGE.index("### Trims") : PAGE.index("## Simulate")].split())
    assert [e.name for e in TRIMS if f"`{e.name}`" not in trims] == []
    assert {e.name for e in FIT_TRIMS} - {e.name for e in TRIMS} == {"torque_scale"}
    assert "In the fit, `torque_scale` too" in trims


def test_what_a_probability_rests_on_is_listed():
    gates = PAGE[PAGE.index("## State") : PAGE.index("**Verdict.**")]
    assert [f.name for f in fields(Grounds) if f"`{f.name}`" not in gates] == []


def test_what_a_true_term_may_leave_is_said_by_class():
    special = {"friction": 0.02, "presliding": 0.02, "change": 0.02, "transmission": 0.03}
    assert {e.name for e in CATALOGUE if e.misfit != special.get(e.family, 0.005)} == set()
    text = " ".join(PAGE[PAGE.index("## Propose") : PAGE.index("### Trims")].split())
    assert "a term of friction, presliding or change on the joint it must explain 2 %" in text
    assert "beside a transmission 3 %, beside others half a percent" in text
    assert "odds of twenty for each term" in text
    assert np.exp(SEARCH.term / 2) == pytest.approx(20)


def test_decisive_evidence_is_odds_of_150_to_1():
    assert round(np.exp(SEARCH.decisive / 2) / 10) * 10 == 150


@pytest.mark.parametrize("kind", [Answer, Finding, Location, Rival, Score], ids=lambda kind: kind.__name__)
def test_every_field_of_diagnosis_json_is_listed(kind):
    assert [f.name for f in fields(kind) if f"`{f.name}`" not in FILES] == []


def test_schemas_and_what_mjcf_can_say():
    assert f"`{ANSWER_SCHEMA}`" in FILES
    assert f"`{SCHEMA}`" in FILES
    words = {
        "coulomb_friction": "friction loss",
        "viscous_friction": "damping",
        "reflected_inertia": "armature",
        "link_mass": "mass",
        "link_com": "centre of mass",
        "link_com_shift": "centre of mass",
        "link_inertia": "inertia",
        "payload": "payload",
        "gravity_tilt": "gravity",
        "joint_spring": "spring",
    }
    every = (*CATALOGUE, *FIT_TRIMS)
    assert set(words) == {e.name for e in every if e.mjcf == "model"}
    drive = {f"torque_{word}" for word in ("scale", "offset", "saturation")} | {"actuation_lag", "actuation_delay"}
    drive.add("gain_mismatch")
    assert {e.name for e in every if e.mjcf == "actuator"} == drive
    assert all(word in FILES for word in (*words.values(), "offset", "limit of its torque", "scale", "lag", "`delay`"))
