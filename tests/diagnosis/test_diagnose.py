"""The whole way from a model and recordings to ``diagnosis.json``, on one joint."""

import importlib
import json
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import jsonschema
import mujoco
import numpy as np
import pytest
from diagnosis.plants import double_pendulum, pendulum, record, smooth_torque

from torchrl_athletic.diagnosis import Diagnosis, diagnose
from torchrl_athletic.diagnosis.diagnose import BEHIND, ModelError, _decide, _others, load_model
from torchrl_athletic.diagnosis.fit import Hypothesis
from torchrl_athletic.diagnosis.gates import Evidence
from torchrl_athletic.diagnosis.report.words import grounds_words
from torchrl_athletic.diagnosis.result import Score
from torchrl_athletic.effects import CATALOGUE
from torchrl_athletic.recordings import RecordingError

stages = importlib.import_module("torchrl_athletic.diagnosis.diagnose")  # the function hides its module

NUMBER = {"type": "number"}
SHARE = {"type": "number", "minimum": 0, "maximum": 1}
INTERVAL = {"type": "array", "items": NUMBER, "minItems": 2, "maxItems": 2}
TEXT = {"type": "string", "minLength": 1}
JOINT = {"type": ["string", "null"]}
ERRORS = {"before": NUMBER, "after": NUMBER, "floor": NUMBER}


def leaving(share, joints=1):
    """A score that leaves a share of the error energy above the floor."""
    joint = {"before": np.sqrt(101.0), "after": np.sqrt(1.0 + 100.0 * share), "floor": 1.0}
    return Score(1.0, 1.0, 1.0, 0.0, {f"joint{k}": joint for k in range(joints)})


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


@pytest.mark.parametrize(("name", "far"), [("viscous_friction", True), ("coulomb_friction", False)])
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


@pytest.mark.parametrize(
    ("better", "left", "behind", "is_richer", "expected"),
    [
        (0.0, 0.1, 2.0, False, 0),  # the torques decide between equals
        (0.04, 0.1, 2.0, False, 0),  # and between what an optimiser makes equal
        (0.10, 0.1, 2.0, False, 1),  # a little on every window is enough for a rival
        (0.10, 0.08, 0.0, True, 0),  # not for a law that contains the first, and always gains a little
        (0.10, 0.07, 0.0, True, 1),
        (0.04, 0.07, 0.0, True, 0),
    ],
)
def test_the_simulation_decides_between_what_the_torques_leave_open(better, left, behind, is_richer, expected):
    errors = 10 * np.exp(0.01 * np.random.default_rng(0).normal(size=(2, 100, 1)))
    options = [Evidence(None, None), Evidence(None, None, behind, is_richer)]
    scores = [leaving(0.1), leaving(left)]
    chosen, against, _ = _decide(options, [errors[0], errors[1] * np.exp(-better)], scores, 0.5 * np.arange(100))
    assert chosen == expected
    assert against[chosen] == 0 or expected == 0


def test_a_richer_law_that_is_not_taken_does_not_keep_a_rival_from_being_preferred():
    noise = 10 * np.exp(0.01 * np.random.default_rng(0).normal(size=(3, 100, 1)))
    options = [Evidence(None, None), Evidence(None, None, 0.0, True), Evidence(None, None, 3.0)]
    errors, began = list(noise * np.exp([[[0.0]], [[-0.5]], [[-0.2]]])), 0.5 * np.arange(100)
    assert _decide(options, errors, [leaving(0.10), leaving(0.08), leaving(0.09)], began)[0] == 2
    assert _decide(options, errors, [leaving(0.10), leaving(0.02), leaving(0.09)], began)[0] == 1


def seldom(lost, turned=(), times=50.0, left=(0.99, 0.01), size=1.0):
    """Which of three is chosen: nothing, a spring that follows better but where it counts, a stop that follows there.

    Args:
        lost: Windows and joints that nothing and spring miss.
        turned: The same of the stop.
        times: How far.
        left: Share of the error energy that they leave, and that the stop leaves.
        size: Of the errors, in units of the floor.
    """
    rng = np.random.default_rng(0)
    plain = size * np.exp(0.2 * rng.normal(size=(400, 3)))  # what a start state adds is in all of them
    stop = plain.copy()
    plain[tuple(np.transpose(lost))] *= times
    if turned:
        stop[tuple(np.transpose(turned))] *= times
    spring = plain * np.exp(-0.3 * (1 + rng.normal(size=(400, 1))))
    options = [Evidence(None, None), Evidence(None, None, 3.0), Evidence(None, None, BEHIND)]
    scores = [leaving(left[0], 3), leaving(left[0], 3), leaving(left[1], 3)]
    return _decide(options, [plain, spring, stop], scores, 0.5 * np.arange(400))[0]


TWICE = ((20, 1), (21, 1), (200, 1))


def test_what_acts_on_two_occasions_is_taken_where_it_alone_explains_the_error():
    assert seldom(TWICE) == 2


@pytest.mark.parametrize(
    "case",
    [
        {"lost": TWICE, "turned": ((300, 0),)},  # elsewhere it is the other way round
        {"lost": ((20, 1), (21, 1), (23, 1))},  # one occasion may be a blow that nobody recorded
        {"lost": ((20, 1), (200, 2))},  # two joints, one occasion each
        {"lost": TWICE, "left": (0.99, 0.15)},  # it does not explain the error
        {"lost": TWICE, "left": (0.40, 0.01)},  # the others do not leave it
        {"lost": TWICE, "times": 2.0},  # what they leave is hardly more than the floor
        {"lost": TWICE, "size": 0.01},  # it is below all floors
        {"lost": TWICE, "times": 5.0, "size": 20.0},  # the stop does not follow either
    ],
)
def test_what_acts_seldom_refutes_nothing_that_it_does_not_clearly_beat(case):
    assert seldom(**case) != 2


def test_a_richer_law_that_is_not_taken_refutes_nothing():
    plain = np.ones((400, 1))
    plain[[20, 200]] = 50.0
    options = [Evidence(None, None), Evidence(None, None, 0.0, True)]
    scores = [leaving(0.99), leaving(0.01)]
    chosen, against, _ = _decide(options, [plain, np.ones((400, 1))], scores, 0.5 * np.arange(400))
    assert (chosen, against[0]) == (0, 0)


def test_what_the_simulation_refutes_does_not_need_or_was_asked_about_alone_is_no_other_explanation():
    def option(*names: str, alone: bool = False) -> Evidence:
        terms = [SimpleNamespace(candidate=SimpleNamespace(key=(name, "hip"))) for name in names]
        return Evidence(None, SimpleNamespace(fit=SimpleNamespace(terms=terms)), alone=alone)

    found, gains, refuted, idle, late = (option(n) for n in ("rotor", "gains", "richer", "offset", "spring"))
    both, stop = option("gains", "rotor"), option("stop", alone=True)
    options = (found, gains, refuted, idle, both, stop, late)
    needed = [{("rotor", "hip")}, {("gains", "hip")}, set(), set(), {("gains", "hip")}, {("stop", "hip")}]
    assert _others(options, needed, 0) == (gains.best, both.best, late.best)  # that was not fitted for lack of time
    assert _others(options, needed, 5) == ()


class Started:
    """A diagnosis that has compared its first fit, which leaves ``left`` of the motion; six effects may act alone."""

    def __init__(self, monkeypatch: pytest.MonkeyPatch, left: float, is_open: bool, named: bool, over: float) -> None:
        self.alone = [SimpleNamespace(fit=SimpleNamespace(terms=[k])) for k in range(6)]
        self.few = False
        """Whether none of them closes a material share of the torque."""
        monkeypatch.setattr(stages, "singles", lambda judge: ([], self.alone) if self.few else (self.alone, []))
        monkeypatch.setattr(stages, "keys", id)
        monkeypatch.setattr(stages, "open_share", lambda score: score.before)
        first = Evidence(None, SimpleNamespace(fit=SimpleNamespace(terms=[])))
        self.options: tuple[Evidence, ...] = (first, first)  # of which time allowed one
        self.fits, self.scores, self.chosen = [self.fit(named)], [self.score(left, over)], 0
        self.finds: dict[int, tuple[bool, float]] = {}
        """Number of an option -> whether the choice falls on it with a name, and what it leaves."""
        self.late = 9
        """Number of fits from which on it is late."""
        self.is_open = is_open

    @staticmethod
    def fit(named: bool) -> Any:
        return SimpleNamespace(hypothesis=SimpleNamespace(terms=(None,) * named))

    @staticmethod
    def score(left: float, over: float) -> dict[str, Score]:
        return {"train": Score(left, 1.0, 1.0, 0.0, {"hip": {"before": over, "after": over, "floor": 1.0}})}

    def _late(self) -> bool:
        return len(self.fits) >= self.late

    def _is_open(self, fitted: object) -> bool:
        return self.is_open

    def _fit(self) -> None:
        for k in range(len(self.fits), len(self.options)):
            named, _ = self.finds.get(k, (False, 0.0))
            self.fits.append(self.fit(named))

    def _compare(self) -> None:
        for k in range(len(self.scores), len(self.fits)):
            self.scores.append(self.score(self.finds.get(k, (False, 0.9))[1], 9.0))
            self.chosen = k if k in self.finds else self.chosen

    _start_over = stages._Work._start_over
    _ask = stages._Work._ask
    _is_lost = stages._Work._is_lost
    _is_unnamed = stages._Work._is_unnamed


@pytest.mark.parametrize(
    ("left", "is_open", "named", "over", "asked"),
    [
        (0.9, True, True, 9.0, stages.ALONE),
        (0.9, True, False, 9.0, 6),  # as long as nothing is named and most is open
        (0.9, True, False, 2.0, stages.ALONE),  # so near the floor the simulation could tell nothing of so many
        (0.3, True, True, 9.0, None),
        (0.9, False, True, 9.0, None),
        (0.0, False, False, 3.0, stages.ALONE),  # trims took the torque, and the motion is not followed all the same
        (0.0, False, False, 2.0, None),
        (0.0, False, True, 3.0, None),
    ],
)
def test_effects_are_tried_alone_where_most_of_the_motion_stays_open(monkeypatch, left, is_open, named, over, asked):
    work = Started(monkeypatch, left, is_open, named, over)
    first = work.options[0]
    work._start_over()
    assert len(work.options) == (2 if asked is None else 1 + asked)
    if asked is not None:  # options and fits stay in step, and nothing is against the first one
        assert work.options[0] is first
        assert [o.best for o in work.options[1:]] == work.alone[:asked]
        assert [o.on_trial for o in work.options[1:]] == [False] * stages.ALONE + [True] * (asked - stages.ALONE)
        assert all(o.alone and o.behind == stages.BEHIND for o in work.options[1:])


@pytest.mark.parametrize(
    ("change", "asked"),
    [
        ({"finds": {4: (True, 0.9)}}, 4),  # a name
        ({"finds": {3: (False, 0.2)}}, 4),  # adjusted numbers that explain it
        ({"finds": {4: (False, 0.9)}}, 6),
        ({"late": 3}, 2),
        ({"late": 1}, None),
        ({"few": True}, 2),
    ],
)
def test_no_further_effect_is_tried_alone_than_it_takes(monkeypatch, change, asked):
    work = Started(monkeypatch, 0.9, True, False, 9.0)
    vars(work).update(change)
    work._start_over()
    assert len(work.options) == (2 if asked is None else 1 + asked)


def test_what_was_an_option_before_is_not_tried_alone(monkeypatch):
    work = Started(monkeypatch, 0.9, True, False, 9.0)
    work.options = (work.options[0], Evidence(None, work.alone[0]))
    work.fits, work.scores = 2 * work.fits, 2 * work.scores
    work._start_over()
    assert [o.best for o in work.options[1:]] == work.alone


@pytest.mark.parametrize(("left", "better", "chosen"), [(0.6, 0.7, 1), (0.9, 0.7, 0), (0.6, 0.99, 0)])
def test_a_late_effect_has_to_be_decisively_better_and_to_close_much(left, better, chosen):
    options = [Evidence(None, None), Evidence(None, None, BEHIND, on_trial=True, alone=True)]
    errors = np.random.default_rng(0).normal(10.0, 1.0, (2, 400, 1)) * np.array([1.0, better])[:, None, None]
    found, _, taken = _decide(options, errors, [leaving(0.95), leaving(left)], 0.5 * np.arange(400))
    assert (found, taken) == (chosen, [True, bool(chosen)])


def test_a_fit_in_which_a_mass_is_adjusted_is_not_taken_for_one_in_which_it_is_found():
    friction, mass = (SimpleNamespace(effect=SimpleNamespace(name=n), where="hip") for n in ("friction", "link_mass"))
    assert stages._key(Hypothesis((friction, mass))) != stages._key(Hypothesis((friction,), (mass,)))


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
