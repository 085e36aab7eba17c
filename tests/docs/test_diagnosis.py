"""The page on the diagnosis states the numbers and the fields that the code has."""

import importlib
import importlib.util
import re
from dataclasses import fields, is_dataclass
from pathlib import Path

import numpy as np
import pytest

from torchrl_athletic.diagnosis import (
    Answer,
    Finding,
    Location,
    Rival,
    Score,
    joint_fit,
    problem,
    selection,
    standard,
    thresholds,
)
from torchrl_athletic.diagnosis.calibration import Grounds
from torchrl_athletic.diagnosis.corrected import SCHEMA
from torchrl_athletic.diagnosis.result import SCHEMA as ANSWER_SCHEMA
from torchrl_athletic.diagnosis.thresholds import SEARCH
from torchrl_athletic.effects import CATALOGUE, FIT_TRIMS, TRIMS

fitting, standard_fit, coarse = (
    importlib.import_module(f"torchrl_athletic.diagnosis.{name}") for name in ("fit", "fitting", "coarse")
)
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
    special = {"friction": 0.02, "presliding": 0.02, "coupling": 0.02, "change": 0.02, "transmission": 0.03}
    assert {e.name for e in CATALOGUE if e.misfit != special.get(e.family, 0.005)} == set()
    text = " ".join(PAGE[PAGE.index("## Propose") : PAGE.index("### Trims")].split())
    assert "a term of friction, presliding, coupling or change on the joint it must explain 2 %" in text
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
        "offset_payload": "payload",
        "gravity_tilt": "gravity",
        "joint_spring": "spring",
    }
    every = (*CATALOGUE, *FIT_TRIMS)
    assert set(words) == {e.name for e in every if e.mjcf == "model"}
    drive = {f"torque_{word}" for word in ("scale", "offset", "saturation")} | {"actuation_lag", "actuation_delay"}
    drive.add("gain_mismatch")
    assert {e.name for e in every if e.mjcf == "actuator"} == drive
    assert all(word in FILES for word in (*words.values(), "offset", "limit of its torque", "scale", "lag", "`delay`"))


COUNTED = {2: "two", 3: "three", 4: "four", 5: "five", 8: "eight", 10: "ten"}
SHARES = {0.1: "a tenth", 0.25: "a quarter", 0.5: "half"}
S, D, M, T, P = (getattr(thresholds, name) for name in ("SEARCH", "DECISION", "SIMULATION", "STATEMENT", "SPENDING"))
SAID = {
    "diagnosis": [
        f"more than {S.open:g} times the floor, or one stretch {COUNTED[S.chance]} standard deviations above chance",
        f"keeps the {COUNTED[S.beam]} best combinations",
        f"must bring odds of 150 to 1 **and** close {SHARES[S.material]} of what is open at a joint",
        f"where it closes {SHARES[S.richer]} of what is open and has the same strength on all recordings to "
        f"{SHARES[S.steady]}",
        f"unless it closes {SHARES[S.richer]} more",
        f"scatter by more than {S.invariant:g} of their mean",
        f"is fitted there, with up to {COUNTED[D.most_fits - 1]} more",
        f"where these leave more than {SHARES[D.lost]} of the motion's error energy, or where nothing was named and "
        f"the trims alone leave more than {D.follows:g} floors",
        f"Where nothing follows the recordings of several joints to {D.follows:g} floors, or closes "
        f"{100 * (1 - D.closed):.0f} % of the",
        f"is tried at {COUNTED[selection.SIZES]} sizes to either side, the {COUNTED[selection.FITTED]} effects",
        f"if it saves {100 * selection.LEAST:.0f} % of the windows' cost and {COUNTED[selection.SURE]} standard errors",
        f"the torques' combination lacks it: {T.likely:g} at most",
        f"leaves more than {100 * T.explained:.0f} % of the error energy, and the simulation with them is better by "
        f"odds of 150 to 1 and leaves {SHARES[S.richer]} less",
        "first of {:g} s and then of {:g} s".format(*fitting.SHOOTING),
        f"has the {COUNTED[M.telling]} windows in which a term acts most",
        f"resampling the windows {M.samples} times",
        f"on up to {M.windows} windows of {M.window:g} s",
        f"Others above {100 * T.least_share:.0f} % are **rivals**",
        f"a gear on a joint that the given model follows: {T.senseless:g} at most",
        f"is taken back, and its names have {T.refused:g} at most",
        f"| `refused` | taken back: {T.refused:g} at most |",
        f"is more than {COUNTED[T.near_floor]} floors off on its joint and keeps more than {SHARES[T.kept]} of the",
        f"`rivals` have more than {SHARES[1 - T.refutes]} of the evidence",
        f"errs by at most {COUNTED[T.near_floor]} floors on every joint",
        f"at most {100 * T.explained:.0f} % of the error energy above the floor and {200 * T.explained:.0f} % of any",
        f"at most {100 * T.partly:.0f} % is left",
        f"predict more than {100 * S.predictable:.0f} % of the missing torque",
        f"Once {100 * P.to_propose:.0f} % of `--time-budget` is spent, the search of the torques comes to an end",
        f"From {100 * P.to_try:.0f} % on the motion is asked, until {100 * P.to_select:.0f} %, and the standard joints "
        "come before further combinations",
        f"none of which begins after {100 * P.to_fit:.0f} %",
        f"At {100 * P.to_find:.0f} % what was found is stated",
        f"{SHARES[P.share]} of what is free], stretches of {P.stretch:.0f} s spread evenly",
    ],
    "fitting": [
        "Windows grow from {:g} s over {:g} s to {:g} s".format(*joint_fit.HORIZONS, joint_fit.WINDOW),
        f"physics steps of {1e3 * coarse.LONGEST[0]:g} ms, or of {1e3 * coarse.LONGEST[1]:g} where",
        f"but for {SHARES[coarse.ALIKE]} of its error, and {standard_fit.SCARCE} windows",
        f"cut into {COUNTED[problem.FOLDS]} folds",
        f"{COUNTED[standard.ROOM]} times what their torques, speeds and accelerations allow",
        f"At most {standard_fit.LONGEST:.0f} s of recordings are fitted",
    ],
}


@pytest.mark.parametrize(("page", "said"), [(page, said) for page, all_said in SAID.items() for said in all_said])
def test_the_prose_says_the_numbers_that_are_in_force(page, said):
    assert said in " ".join((DOCS / f"{page}.md").read_text(encoding="utf-8").split())
