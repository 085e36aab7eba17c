"""What is drawn is repeatable, hidden from the diagnosis, and independent of what it uses."""

from __future__ import annotations

import ast
import json
import re
from dataclasses import replace
from pathlib import Path

import mujoco
import numpy as np
import pytest

from benchmarks.concealed import cases
from benchmarks.concealed.baselines import signals
from benchmarks.concealed.cases import BLOCKS, DRY, beyond_nuisance, prepare, record, visibility
from benchmarks.concealed.hidden import EFFECTS, OUTSIDE, draw
from benchmarks.concealed.robots import SEALED, TUNING
from benchmarks.concealed.run import COUNTS, Seal, digest_of, export, seal
from torchrl_athletic.recordings import read_recordings

FOLDER = Path(cases.__file__).parent
GENERATOR = ("plant.py", "laws.py", "robots.py", "takes.py", "hidden.py", "cases.py", "harmonic.py")


@pytest.fixture(scope="module")
def session():
    """A pendulum, which is quick."""
    return prepare("sealed", "single", 0, seed=5)


def imported(name: str) -> set[str]:
    nodes = list(ast.walk(ast.parse((FOLDER / name).read_text(encoding="utf-8"))))
    whole = {a.name for node in nodes if isinstance(node, ast.Import) for a in node.names}
    return whole | {node.module or "" for node in nodes if isinstance(node, ast.ImportFrom)}


def foreign(name: str) -> set[str]:
    return {n for n in imported(name) if n.startswith(("mujoco", "torchrl_athletic"))}


def test_the_generator_knows_neither_mujoco_nor_the_catalogue():
    for name in GENERATOR:
        assert foreign(name) <= {"torchrl_athletic.recordings"}, name
    # the arm takes geometry and masses of a model, no dynamics
    assert foreign("arm.py") == {"mujoco", "torchrl_athletic.recordings", "torchrl_athletic.robots"}
    assert set(re.findall(r"\bmj_\w+", (FOLDER / "arm.py").read_text(encoding="utf-8"))) == {"mj_name2id"}


@pytest.mark.slow  # eleven seconds of the generator alone
def test_a_spring_that_is_far_away_does_not_harden():
    """The cube of its way would tear the robot out of its range, so that it was never recorded."""

    def hardening(block: str) -> float:
        session = next(
            s for s in (prepare("sealed", block, k, seed=1) for k in range(99))
            if s.case.truths[0].effect == "joint_spring"
        )  # fmt: skip
        joint = session.robot.joint_names.index(session.case.truths[0].joint)
        assert session.body.laws["spring"][joint] > 0
        return float(session.body.laws["spring_cubic"][joint])

    assert hardening("single") > 0
    assert hardening("unidentifiable") == 0


def test_what_diagnoses_knows_nothing_of_the_generator():
    text = (FOLDER / "diagnose_case.py").read_text(encoding="utf-8")
    assert "benchmarks.concealed" not in text.replace("benchmarks/concealed", "")


@pytest.mark.slow
def test_the_splits_share_no_robot():
    assert not set(SEALED) & set(TUNING)
    assert prepare("sealed", "nuisance", 1).robot.name in SEALED
    assert prepare("tuning", "nuisance", 1).robot.name in TUNING


def test_the_same_seed_is_the_same_case_and_another_one_is_not(session):
    again = prepare("sealed", "single", 0, seed=5)
    assert again.case == session.case
    assert again.model_xml == session.model_xml
    assert prepare("sealed", "single", 0, seed=6).case != session.case


def test_recording_it_again_gives_the_same_numbers(session):
    short = replace(session, plans=session.plans[:1])
    np.testing.assert_array_equal(record(short)[0][0].position, record(short)[0][0].position)


def test_a_stretch_of_singles_holds_every_effect_and_every_severity():
    drawn = [cases._choose("sealed", "single", k, cases.generator("sealed", "single", k, 0)) for k in range(112)]
    assert {effects[0] for effects, *_ in drawn} == set(EFFECTS)
    for effect in EFFECTS:
        assert {severity for effects, _, _, severity in drawn if effects == (effect,)} == {0, 1, 2, 3}
    assert {robot for _, robot, _, _ in drawn} == set(SEALED)
    assert 0.2 < np.mean([mode == "position_target" for *_, mode, _ in drawn]) < 0.45


@pytest.mark.parametrize("block", BLOCKS)
@pytest.mark.parametrize("split", ["sealed", "tuning"])
def test_a_block_hides_as_much_as_its_name_says(split, block):
    case = prepare(split, block, 1).case
    if block == "bare":
        joints = {truth.joint for truth in case.truths}
        assert len(case.truths) >= 2 * len(joints)
        assert (
            {"viscous_friction"}
            <= {truth.effect for truth in case.truths}
            <= {"reflected_inertia", "viscous_friction", *DRY}
        )
    else:
        assert len(case.truths) == {"nothing": 0, "nuisance": 0, "pairs": 2, "triples": 3}.get(block, 1)
    if block == "leave_one_out":
        assert case.truths[0].effect in case.removed
    if block == "outside":
        assert case.truths[0].effect in OUTSIDE
        assert case.truths[0].effect not in EFFECTS
    json.dumps(case.to_json(), allow_nan=False)


def test_more_severe_is_more_of_it(session):
    for effect in ("coulomb_friction", "actuation_delay", "link_com", "torque_offset", "encoder_scale"):
        sizes = []
        for level in range(4):
            truth = draw(effect, session.robot, 0, level, session.typical, session.base, True, np.random.default_rng(0))
            (value,) = truth.parameters.values()
            sizes.append(abs(np.log(value / float(np.linalg.norm(session.base.com[0])))) if effect == "link_com"
                         else abs(np.log(value)) if "scale" in effect else abs(value))  # fmt: skip
        assert sizes == sorted(sizes)
        assert sizes[3] > 3 * sizes[0]


def test_the_oracle_sees_a_gross_effect_and_hardly_a_faint_one():
    seen = {}
    for k in (0, 84):  # the same effect, faint and gross
        session = prepare("tuning", "single", k, seed=1)
        session = replace(session, plans=session.plans[:1], fitted=1)
        seen[session.case.severity] = visibility(session)[0]
        assert beyond_nuisance(session.case.truths[0], session)
    assert set(seen) == {0, 3}
    assert seen[3] > 3 * seen[0]


def test_the_diagnosis_is_given_a_model_and_takes_and_no_names(session, tmp_path):
    export(session, tmp_path)
    assert sorted(p.name for p in tmp_path.iterdir()) == ["aside", "fit", "model.xml"]
    fit, aside = read_recordings(tmp_path / "fit"), read_recordings(tmp_path / "aside")
    assert 3 <= len(fit) <= 4
    assert 1 <= len(aside) <= 2
    text = (tmp_path / "model.xml").read_text(encoding="utf-8") + str([dict(r.metadata) for r in (*fit, *aside)])
    assert not [name for name in (*EFFECTS, *OUTSIDE) if name in text]


def test_an_encoder_reads_in_whole_steps(session):
    take = record(replace(session, plans=session.plans[:1]))[0][0]
    steps = take.position / (2 * np.pi / 2**session.sensors.bits)
    np.testing.assert_allclose(steps, np.round(steps), atol=1e-6)


def test_the_seal_shows_a_digest_and_changes_with_what_is_hidden(tmp_path, monkeypatch, capsys):
    for block in COUNTS:
        monkeypatch.setitem(COUNTS, block, int(block in ("single", "pairs")))
    one, other = tmp_path / "one.sha256", tmp_path / "other.sha256"
    for seed, path in ((1, one), (2, one), (1, other)):
        seal(Seal(seed, path))
    assert digest_of(1, one) == digest_of(1, other) != digest_of(2, one)
    assert digest_of(2, other) is None
    assert len(digest_of(1, one)) == 64
    with pytest.raises(SystemExit, match="another seed"):
        seal(Seal(1, one))
    assert not [name for name in EFFECTS if name in capsys.readouterr().out]


@pytest.mark.parametrize("index", [0, 5])  # torques sent; position targets sent
def test_where_nothing_is_missing_mujoco_misses_what_the_sensors_noise_makes(index):
    session = prepare("tuning", "nothing", index)
    session = replace(session, plans=session.plans[:1], fitted=1)
    takes, _ = record(session)
    seen = signals(mujoco.MjModel.from_xml_string(session.model_xml), takes)
    missing = np.sqrt((seen.missing**2).mean(0))
    np.testing.assert_allclose(missing, cases._noise(session), rtol=0.25)
