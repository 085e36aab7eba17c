"""The whole way from a model and recordings to ``diagnosis.json``, on one joint."""

import json
import sys
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import jsonschema
import mujoco
import numpy as np
import pytest
from diagnosis.plants import double_pendulum, pendulum, record, smooth_torque

from torchrl_athletic.diagnosis import Diagnosis, diagnose
from torchrl_athletic.diagnosis.model import ModelError, load_model
from torchrl_athletic.diagnosis.prepare import stood
from torchrl_athletic.diagnosis.report.words import grounds_words
from torchrl_athletic.diagnosis.resources import OutOfTime
from torchrl_athletic.diagnosis.stages import Decided, Given, Located, Proposed, Simulated
from torchrl_athletic.diagnosis.thresholds import SPENDING
from torchrl_athletic.effects import CATALOGUE
from torchrl_athletic.recordings import Recording, RecordingError

diagnosing = sys.modules["torchrl_athletic.diagnosis.diagnose"]

URDF_WITH_A_MESH = """<robot name="arm"><link name="base"/><link name="link">
<inertial><mass value="1"/><inertia ixx=".1" iyy=".1" izz=".1" ixy="0" ixz="0" iyz="0"/></inertial>
<collision><geometry><mesh filename="package://arm/base.obj"/></geometry></collision></link>
<joint name="hinge" type="revolute"><parent link="base"/><child link="link"/><axis xyz="0 0 1"/>
<limit lower="-1" upper="1" effort="5" velocity="1"/></joint></robot>"""
TETRAHEDRON = "v 0 0 0\nv 1 0 0\nv 0 1 0\nv 0 0 1\nf 1 3 2\nf 1 2 4\nf 2 3 4\nf 3 1 4\n"
NUMBER = {"type": "number"}
SHARE = {"type": "number", "minimum": 0, "maximum": 1}
INTERVAL = {"type": "array", "items": NUMBER, "minItems": 2, "maxItems": 2}
TEXT = {"type": "string", "minLength": 1}
JOINT = {"type": ["string", "null"]}
ERRORS = {"before": NUMBER, "after": NUMBER, "floor": NUMBER}


def an_object(properties, optional=()):
    return {"type": "object", "properties": properties, "required": [p for p in properties if p not in optional]}


def each(items):
    return {"type": "array", "items": items}


SCORE = an_object(
    {**ERRORS, "share_closed": NUMBER, "per_joint": {"type": "object", "additionalProperties": an_object(ERRORS)}}
)
RIVAL = an_object({"effect": TEXT, "joint": JOINT, "probability": SHARE, "separating_experiment": TEXT})
FINDING = an_object(
    {
        "effect": {"enum": [e.name for e in CATALOGUE]},
        "joint": JOINT,
        "probability": SHARE,
        "sentence": TEXT,
        "parameters": {
            "type": "object",
            "minProperties": 1,
            "additionalProperties": an_object({"value": NUMBER, "ci95": INTERVAL, "unit": TEXT}),
        },
        "regime": TEXT,
        "rivals": each(RIVAL),
    }
)
DIAGNOSIS = an_object(
    {
        "schema": {"const": "torchrl_athletic/diagnosis/1"},
        "verdict": {"enum": ["nothing_missing", "explained", "partly_explained", "unexplained"]},
        "findings": each(FINDING),
        "locations": each(an_object({"joint": TEXT, "regime": TEXT, "share_of_error": SHARE})),
        "fit": an_object({"train": SCORE, "heldout": SCORE}, optional=("heldout",)),
        "unexplained_share": SHARE,
        "quality": {"type": "object"},
    }
)
"""The design's contract."""

FEW = tuple(e for e in CATALOGUE if e.name in ("coulomb_friction", "viscous_friction", "torque_offset"))
MODEL = pendulum()


def recordings(kinds, **joint):
    true = pendulum(joint=" ".join(f'{key}="{value}"' for key, value in {"damping": 0.05, **joint}.items()))
    return [record(true, smooth_torque(5.0, 1.5, seed=k), noise=1e-4, seed=k) for k in kinds]


@pytest.fixture(scope="module")
def output(tmp_path_factory) -> Path:
    return tmp_path_factory.mktemp("out") / "new" / "folder"


@pytest.fixture(scope="module")
def diagnosis(output) -> Diagnosis:
    train, heldout = recordings([0, 1], damping=0.2), recordings([2], damping=0.2)
    return diagnose(MODEL, train, heldout, catalogue=FEW, output=output)


def test_what_was_left_out_is_named_with_its_number(diagnosis):
    best = diagnosis.answer.findings[0]
    assert (best.effect, best.joint) == ("viscous_friction", "pendulum")
    assert best.parameters["damping"].value == pytest.approx(0.2, rel=0.05)
    assert diagnosis.answer.verdict == "explained"
    assert diagnosis.answer.fit["heldout"].after < 0.1 * diagnosis.answer.fit["heldout"].before


@pytest.mark.parametrize(
    ("name", "far"),
    [pytest.param("viscous_friction", True, marks=pytest.mark.slow), ("coulomb_friction", False)],  # see test_gates.py
)
def test_beside_a_simulation_that_is_still_far_off_no_name_has_more_than_one_half(name, far):
    train, heldout = recordings([0, 1], frictionloss=0.1), recordings([2], frictionloss=0.1)
    only = [effect for effect in CATALOGUE if effect.name == name]  # what a robot hides may not be in it
    (found,) = diagnose(MODEL, train, heldout, catalogue=only).answer.findings
    assert found.effect == name
    assert found.grounds["far"] is far
    assert (found.probability > 0.5) is not far
    assert ("some law is another" in found.sentence) is far
    assert any("no name there has more than one half" in said for said in grounds_words(found)) is far


def test_the_json_keeps_the_contract(diagnosis, output):
    text = (output / "diagnosis.json").read_text(encoding="utf-8")
    content = json.loads(text, parse_constant=lambda name: pytest.fail(f"{name} is not JSON"))
    jsonschema.validate(content, DIAGNOSIS)
    assert content["findings"]
    shares = [f["probability"] for f in content["findings"]]
    assert shares == sorted(shares, reverse=True)
    for finding in content["findings"]:
        assert finding["probability"] + sum(r["probability"] for r in finding["rivals"]) <= 1 + 1e-9
        assert all(r["probability"] <= finding["probability"] for r in finding["rivals"])
        for p in finding["parameters"].values():
            assert p["ci95"][0] <= p["value"] <= p["ci95"][1]


def test_a_torque_of_the_other_sign_is_said_before_all_else_and_while_it_runs():
    said = []
    progress = SimpleNamespace(stage=lambda name: None, update=lambda fraction: None, say=said.append, now="state")
    turned = [replace(r, torque_command=-r.torque_command) for r in recordings([0])]
    found = diagnose(MODEL, turned, catalogue=FEW[:1], progress=progress)
    (doubt,) = found.answer.quality["column_doubts"]
    assert doubt.startswith("the torque of pendulum has the other sign")
    assert said == [f"Warning: {doubt}"]


def test_what_was_saved_loads_as_it_was(diagnosis, output):
    back = Diagnosis.load(output)
    assert back.answer == diagnosis.answer
    r = recordings([3], damping=0.2)[0]
    for window in (0.5, None):
        np.testing.assert_array_equal(back.corrected.rollout(r, window), diagnosis.corrected.rollout(r, window))
        np.testing.assert_array_equal(back.nominal.rollout(r, window), diagnosis.nominal.rollout(r, window))
    before, after = (np.abs(s.rollout(r, None) - r.position).max() for s in (back.nominal, back.corrected))
    assert after < 0.1 * before


def test_the_folder_holds_the_four_files_and_nothing_else(diagnosis, output):
    assert {p.name for p in output.iterdir()} == {"diagnosis.json", "report.html", "corrected.xml", "corrected.json"}
    mujoco.MjModel.from_xml_path(str(output / "corrected.xml"))


def test_a_folder_without_a_diagnosis_says_so(tmp_path):
    with pytest.raises(FileNotFoundError, match=r"holds no diagnosis\.json\. Name the folder given as --output"):
        Diagnosis.load(tmp_path)


def test_without_output_nothing_is_written(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    fine = pendulum(step=0.0005)  # half a step of the integrator is a delay that the diagnosis would notice
    r = record(fine, smooth_torque(5.0, 1.5), noise=1e-4)
    found = diagnose(fine, [r], catalogue=FEW)
    assert "heldout" not in found.answer.fit
    assert found.answer.findings == ()  # and what is not missing is not found
    assert found.answer.verdict == "nothing_missing"
    assert list(tmp_path.iterdir()) == []


def test_the_same_seed_gives_the_same_answer(diagnosis):
    train, heldout = recordings([0, 1], damping=0.2), recordings([2], damping=0.2)
    assert diagnose(MODEL, train, heldout, catalogue=FEW).answer == diagnosis.answer


def test_a_model_comes_as_a_path_a_text_or_a_spec(tmp_path, monkeypatch):
    (tmp_path / "robot.xml").write_text(MODEL)
    monkeypatch.chdir(tmp_path)
    ways = [tmp_path / "robot.xml", str(tmp_path / "robot.xml"), "robot.xml", MODEL, mujoco.MjSpec.from_string(MODEL)]
    loaded = [load_model(way) for way in ways]
    assert len({xml for _, xml, _ in loaded}) == 1
    assert {name for *_, name in loaded} == {"pendulum"}
    assert {model.body("link").mass[0] for model, *_ in loaded} == {0.5}


OBJ = "v 0 0 0\nv .1 0 0\nv 0 .1 0\nv 0 0 .1\nf 1 3 2\nf 1 2 4\nf 2 3 4\nf 1 4 3\n"


def test_the_corrected_model_of_one_with_meshes_compiles_anywhere(tmp_path, monkeypatch):
    (tmp_path / "robot" / "assets").mkdir(parents=True)
    (tmp_path / "robot" / "assets" / "link.obj").write_text(OBJ)
    geom = '<geom type="mesh" mesh="link"/></body></worldbody>'
    asset = '<compiler meshdir="assets"/><asset><mesh name="link" file="link.obj"/></asset><worldbody>'
    text = MODEL.replace("</body></worldbody>", geom).replace("<worldbody>", asset)
    (tmp_path / "robot" / "robot.xml").write_text(text)
    monkeypatch.chdir(tmp_path / "robot")
    spec = mujoco.MjSpec.from_file(str(tmp_path / "robot" / "robot.xml"))
    for way in ("robot.xml", spec):
        _, xml, _ = load_model(way)
        monkeypatch.chdir(tmp_path)
        assert mujoco.MjModel.from_xml_string(xml).nmesh == 1
        monkeypatch.chdir(tmp_path / "robot")
    assert spec.meshdir == "assets"  # the caller's stays as it was


@pytest.mark.parametrize(
    ("text", "says"), [("<mujoco><worldbody><body><joint/></body></worldbody></mujoco>", "mass"), ("<nonsense", "XML")]
)
def test_a_model_that_does_not_compile_is_refused_in_one_line(text, says, tmp_path):
    (tmp_path / "bad.xml").write_text(text)
    for way, name in ((tmp_path / "bad.xml", "bad.xml"), (text, "the model")):
        with pytest.raises(ModelError, match=f"{name}: MuJoCo cannot compile it .*{says}") as caught:
            load_model(way)
        assert "\n" not in str(caught.value)


def test_a_urdf_whose_meshes_are_elsewhere_says_how_to_name_their_folder(tmp_path):
    (tmp_path / "arm.urdf").write_text(URDF_WITH_A_MESH)
    with pytest.raises(ModelError, match=r"arm\.urdf: .*/base\.obj.*<compiler meshdir=\"FOLDER\" strippath"):
        load_model(tmp_path / "arm.urdf")
    for missing in ('<include file="base.obj"/>', '<asset><texture type="2d" file="base.png"/></asset>'):  # no meshes
        with pytest.raises(ModelError, match=r"Error opening file .* Mend it until MuJoCo's viewer opens it\.$"):
            load_model(f"<mujoco>{missing}</mujoco>")
    (tmp_path / "shapes").mkdir()
    (tmp_path / "shapes" / "base.obj").write_text(TETRAHEDRON)
    named = '<robot name="arm"><mujoco><compiler meshdir="shapes" strippath="true"/></mujoco>'
    (tmp_path / "arm.urdf").write_text(URDF_WITH_A_MESH.replace('<robot name="arm">', named))
    assert load_model(tmp_path / "arm.urdf")[0].nmesh == 1


def test_a_model_that_is_not_there_is_named():
    with pytest.raises(FileNotFoundError, match=r"nowhere\.xml: there is no such model\. Name an MJCF file"):
        diagnose("nowhere.xml", recordings([0]))


@pytest.mark.parametrize(
    ("model", "makes", "says"),
    [
        (MODEL, lambda: [], "no recordings: name a file or a folder"),
        (
            pendulum(name="knee"),
            lambda: recordings([0]),
            r"take_0: joint_names has 'pendulum', the model has \['knee'\]",
        ),
        (
            MODEL,
            lambda: [*recordings([0]), record(double_pendulum(), np.zeros((200, 2)), (0.1, 0))],
            "Diagnose takes of the same joints together",
        ),
        (MODEL, lambda: [recordings([0])[0].slice(0, 20)], r"take_0: the take lasts 0\.19 s, at least .* Leave it out"),
    ],
)
def test_recordings_that_cannot_be_used_are_refused_with_the_mend(model, makes, says):
    with pytest.raises(RecordingError, match=says):
        diagnose(model, makes(), catalogue=FEW)


def test_the_measured_torque_can_only_drive_where_it_was_measured():
    with pytest.raises(RecordingError, match="there is no torque_measured"):
        diagnose(MODEL, recordings([0]), drive="measured", catalogue=FEW)


def test_what_joins_is_fitted_behind_the_first_takes_and_the_answer_is_of_just_these_inputs(monkeypatch):
    """Where a take is used makes another diagnosis, though the takes are the same and in the same order."""
    told = []
    unfinished = SimpleNamespace(answer=SimpleNamespace(complete=False))
    monkeypatch.setattr(diagnosing, "_diagnosed", lambda given, *_: told.append(given) or unfinished)
    monkeypatch.setattr(diagnosing, "room_for_data", lambda memory: memory)
    thinned = {1.0: "Thinned.", 2.0: ""}
    monkeypatch.setattr(
        diagnosing, "within_memory", lambda takes, room: SimpleNamespace(recordings=takes, warning=thinned[room])
    )
    time, still = np.arange(10) / 100, np.zeros((10, 2))
    first = Recording(time, ("upper", "lower"), still, torque_command=still, source="a")
    turned = Recording(time, ("lower", "upper"), still, torque_command=still, source="b")
    takes = [first, turned, replace(first, source="c"), replace(turned, source="d")]
    for fitted, joined, memory in ((1, 1, 1.0), (2, 0, 2.0), (3, 0, 1.0)):
        aside = takes[fitted + joined :]
        diagnose(double_pendulum(), takes[:fitted], aside, joined=takes[fitted : fitted + joined], memory=memory)
    for given, fitted, joined, warnings in zip(told, ("ab", "ab", "abc"), (1, 0, 0), (True, False, True), strict=True):
        assert "".join(r.source for r in given.recordings) == fitted
        assert "".join(r.source for r in given.heldout) == "abcd".removeprefix(fitted)
        assert {r.joint_names for r in (*given.recordings, *given.heldout)} == {("upper", "lower")}
        assert given.joined == joined
        assert given.warnings == (("Thinned.",) if warnings else ())
    assert len({given.inputs for given in told}) == 3


@pytest.mark.parametrize("highest", [0.0, -1.0, float("nan")])
def test_a_highest_frequency_that_is_none_is_refused(highest):
    with pytest.raises(ValueError, match=r"highest_frequency is .* Give more than 0"):
        diagnose(MODEL, recordings([0]), highest_frequency=highest)


@pytest.mark.parametrize("complete", [True, False])
def test_a_run_keeps_its_fits_in_the_folder_until_its_report_is_whole(tmp_path, monkeypatch, complete):
    told, held = [], []

    @contextmanager
    def locked(folder, unlike):
        assert unlike == "fit.json"
        held.append(folder)
        yield
        held.remove(folder)

    def diagnosed(given, run, folder):
        told.append((given, run, folder))
        run.checkpoint.result("fit", lambda: 1, int, int)
        assert held == [tmp_path]
        return SimpleNamespace(answer=SimpleNamespace(complete=complete))

    monkeypatch.setattr(diagnosing, "_diagnosed", diagnosed)
    monkeypatch.setattr(diagnosing, "locked", locked)
    settings = {"seed": 7, "drive": "command", "base": "recorded", "highest_frequency": 5.0}
    diagnose(MODEL, recordings([0]), catalogue=FEW, time_budget=60.0, output=tmp_path, progress="bar", **settings)
    ((given, run, folder),) = told
    assert {name: getattr(given, name) for name in settings} == settings
    assert (given.catalogue, given.name) == (FEW, "pendulum")
    assert (run.progress, run.time_budget, folder) == ("bar", 60.0, tmp_path)
    assert (run.checkpoint.path, run.checkpoint.digest) == (tmp_path / diagnosing.CHECKPOINT, given.inputs)
    assert (tmp_path / diagnosing.CHECKPOINT).exists() is not complete


FLOATING = """<mujoco><worldbody><body pos="0 0 1"><freejoint/><geom size="0.1"/>
  <body><joint name="hip" axis="0 1 0"/><geom size="0.05" pos="0 0 -0.3"/></body></body></worldbody></mujoco>"""


def test_a_base_is_held_only_where_it_floats_and_nobody_recorded_it():
    time, still = np.arange(11) / 100.0, np.zeros((11, 1))
    bare = Recording(time, ("hip",), still, torque_command=still, source="a take")
    moved = replace(bare, base_position=np.zeros((11, 3)), base_orientation=np.tile([1.0, 0, 0, 0], (11, 1)))
    floating = mujoco.MjModel.from_xml_string(FLOATING)
    bolted = mujoco.MjModel.from_xml_string(FLOATING.replace("<freejoint/>", ""))
    for model in (floating, bolted):
        for take in (bare, moved):
            assert stood(take, model, "recorded") is take
    assert stood(bare, floating, "fixed").base_position is not None
    assert stood(moved, bolted, "fixed").base_position is not None  # which says nothing of a joint
    with pytest.raises(RecordingError, match="a take: base_position was recorded, and base is said to be 'fixed'"):
        stood(moved, floating, "fixed")
    with pytest.raises(ValueError, match="base is 'held', needed is one of 'recorded', 'fixed'"):
        stood(bare, floating, "held")


def test_what_is_kept_aside_is_seen_in_the_band_of_what_is_fitted(monkeypatch):
    told = []

    def prepared(takes, model, drive, kernel=None, joined=0, xml=""):
        told.append((takes, model, drive, kernel, joined, xml))
        return SimpleNamespace(signals=[SimpleNamespace(kernel=0.25), SimpleNamespace(kernel=0.5)])

    monkeypatch.setattr(diagnosing, "prepare", prepared)
    monkeypatch.setattr(diagnosing, "column_doubts", lambda train, held: ())
    given = Given("model", "xml", "m", ("a", "b"), ("c",), (), "measured", joined=1)
    run = SimpleNamespace(progress=SimpleNamespace(update=lambda share: None))
    assert diagnosing._prepare(given, run).held is not None
    assert told == [
        (("a", "b"), "model", "measured", None, 1, "xml"),
        (("c",), "model", "measured", 0.25, 0, "xml"),
    ]
    assert diagnosing._prepare(replace(given, heldout=()), run).held is None


LOCATED = Located("ready", "bank", ())
SIMULATED = Simulated(Proposed(LOCATED, None, ()))
DECIDED = Decided(LOCATED)


def staged(monkeypatch, stops="", error=KeyboardInterrupt, simulated=SIMULATED):
    """A run whose stages give what is known, but one that stops. Names of those begun, and the run."""
    begun = []

    def stage(name, result):
        def go(*_):
            if name == stops:
                raise error
            return result

        return go

    results = {
        "_prepare": "ready", "_locate": LOCATED, "propose": SIMULATED.proposed, "simulate": simulated,
        "decide": DECIDED, "state": "stated", "deliver": "delivered",
    }  # fmt: skip
    for name, result in results.items():
        monkeypatch.setattr(diagnosing, name, stage(name, result))
    progress = SimpleNamespace(stage=begun.append, update=lambda share: None, now="now")
    return begun, SimpleNamespace(progress=progress, left=lambda *_: None)


def test_each_stage_works_on_what_the_last_one_found_until_its_share_of_the_time_is_spent(monkeypatch):
    """All but what it takes to tell is there to find; a part of that is there to tell."""
    told, rings, shares = [], [], []

    @contextmanager
    def alarm(seconds):
        rings.append((seconds, len(told)))
        yield

    _, run = staged(monkeypatch)
    names = ("_prepare", "_locate", "propose", "simulate", "decide", "state", "deliver")
    for name in names:
        result = getattr(diagnosing, name)()
        monkeypatch.setattr(diagnosing, name, lambda *given, result=result: told.append(given) or result)
    monkeypatch.setattr(diagnosing, "alarm", alarm)
    run.left = lambda *share: shares.append(share) or len(shares)
    run.progress.update = lambda share: told.append(share)
    assert diagnosing._diagnosed("given", run, "out") == "delivered"
    assert told == [
        ("given", run), ("ready",), (LOCATED, run), (SIMULATED.proposed, run), (SIMULATED,), (DECIDED,),
        ("stated", "out"), 1.0,
    ]  # fmt: skip
    assert shares == [(SPENDING.to_find, SPENDING.telling), (SPENDING.to_tell,)]
    assert rings == [(1, 2), (2, 6)]


def test_where_the_error_is_is_looked_for_in_what_was_fitted_by_the_seed(monkeypatch):
    monkeypatch.setattr(diagnosing, "Bank", lambda signals, candidates: (signals, candidates))
    monkeypatch.setattr(diagnosing, "locate", lambda bank, rng: ("where", bank, rng))
    ready = SimpleNamespace(
        train=SimpleNamespace(signals="signals"), given=SimpleNamespace(rng=lambda purpose: f"dice for {purpose}")
    )
    found = diagnosing._locate(ready)
    assert (found.ready, found.bank) == (ready, ("signals", ()))
    assert found.locations == ("where", ("signals", ()), "dice for locate")


@pytest.mark.parametrize("error", [KeyboardInterrupt, MemoryError])
@pytest.mark.parametrize(
    ("stops", "found"),
    [
        ("propose", LOCATED),
        ("simulate", LOCATED),
        ("decide", SIMULATED),
        ("state", DECIDED),
        ("deliver", DECIDED),
    ],
)
def test_a_run_that_is_stopped_states_the_last_of_what_it_found(monkeypatch, stops, error, found):
    begun, run = staged(monkeypatch, stops, error)
    monkeypatch.setattr(diagnosing, "_stopped", lambda *given: given)
    assert diagnosing._diagnosed("given", run, "out") == (found, run, "out")
    assert begun[-1] == stops


def test_before_anything_is_found_a_stop_is_a_stop_and_a_simulation_that_was_stopped_is_not_decided_as_a_whole(
    monkeypatch,
):
    for stage in ("_prepare", "_locate"):
        _, run = staged(monkeypatch, stage)
        with pytest.raises(KeyboardInterrupt):
            diagnosing._diagnosed("given", run, None)
    monkeypatch.setattr(diagnosing, "_stopped", lambda found, *_: found)
    cut = replace(SIMULATED, stopped=True)
    begun, run = staged(monkeypatch, simulated=cut)
    assert diagnosing._diagnosed("given", run, None) is cut
    assert begun[-1] == "simulate"
    begun, run = staged(monkeypatch)
    assert diagnosing._diagnosed("given", run, None) == "delivered"
    assert begun == ["prepare", "locate", "propose", "simulate", "decide", "state", "deliver"]


@pytest.mark.parametrize("error", [OutOfTime, MemoryError, None])
@pytest.mark.parametrize("found", [LOCATED, SIMULATED, DECIDED])
def test_a_stopped_run_without_time_or_memory_to_decide_says_where_the_error_is(monkeypatch, found, error):
    _, run = staged(monkeypatch)
    asked = []

    def state(decided, stopped_in):
        asked.append((decided, stopped_in))
        if error is not None and len(asked) == 1:
            raise error
        return "stated"

    monkeypatch.setattr(diagnosing, "state", state)
    monkeypatch.setattr(diagnosing, "deliver", lambda *given: given)
    assert diagnosing._stopped(found, run, "out") == ("stated", "out")
    decided = [decided for decided, stopped_in in asked if stopped_in == "now"]
    assert len(decided) == (1 if error is None else 2)
    assert (decided[0] is DECIDED) is (found is not LOCATED)
    assert decided[-1].located is LOCATED
    assert decided[-1].trial is None
