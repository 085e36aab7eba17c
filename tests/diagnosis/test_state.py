"""What is said, and which simulation stands for it: recordings kept aside choose no names, but may refuse a model."""

from types import SimpleNamespace

import numpy as np
import pytest

from torchrl_athletic.diagnosis import state as stating
from torchrl_athletic.diagnosis.fit import Hypothesis
from torchrl_athletic.diagnosis.proposal import Proposal
from torchrl_athletic.diagnosis.result import Score
from torchrl_athletic.diagnosis.stages import Decided, Trial
from torchrl_athletic.diagnosis.state import _best_followed, _damped, _quality, _trimmed, model_changes
from torchrl_athletic.diagnosis.thresholds import STATEMENT
from torchrl_athletic.effects import Parameter


def trial(aside: float, joints: bool = False, floor: float = 1.0) -> Trial:
    """One that leaves an error of ``aside`` on recordings kept aside, and follows the fitted ones alike."""
    scores = {split: Score(9.0, after, floor, 0.0, {}) for split, after in (("train", 2.0), ("heldout", aside))}
    fitted = SimpleNamespace(hypothesis=Hypothesis(()))
    return Trial(Proposal(None, None, joints=joints), fitted, scores, np.zeros((1, 1)), np.zeros(1))


@pytest.mark.parametrize(
    ("named", "standard", "taken"),
    [
        (4.0, 3.0, True),
        (3.0, 4.0, False),
        (3.0, 2.99, False),  # as the windows fall
        (30.0, 29.9, False),  # so far from the noise, too
        (1.1, 0.9, False),  # noise
    ],
)
def test_the_standard_joints_are_the_corrected_simulation_where_recordings_kept_aside_say_so(named, standard, taken):
    chosen, joints = trial(named), trial(standard, joints=True)
    found = _best_followed(chosen, (chosen, joints))
    assert (found.fitted is joints.fitted) is taken
    assert found.scores is (joints if taken else chosen).scores
    said = " ".join(found.sentences)
    assert ("standard joints instead of what is named: recordings that were kept aside are" in said) is taken


def test_names_that_make_the_simulation_worse_leave_it_to_what_helps():
    chosen, joints = trial(4.0), trial(5.0, joints=True)
    found = _best_followed(chosen, (joints,))
    assert found.fitted is joints.fitted
    assert found.sentences == (
        "The corrected simulation has the standard joints instead of what is named, which makes the fitted recordings "
        "worse.",
    )


def test_nothing_that_was_kept_aside_lets_the_fitted_recordings_say_so():
    chosen, first = trial(4.0), trial(3.0)
    for t in (chosen, first):
        del t.scores["heldout"]
    first.scores["train"] = Score(9.0, 1.5, 1.0, 0.0, {})
    [said] = _best_followed(chosen, (chosen, first)).sentences
    assert "what the torques alone speak for" in said
    assert "the fitted recordings" in said
    assert "with 75 % of the error" in said


def test_what_is_taken_back_is_gone_from_the_stated_errors_too(monkeypatch):
    own, gone = trial(4.0), [SimpleNamespace(where="hip")]
    own.scores["heldout"] = Score(9.0, 4.0, 1.0, 0.0, {"hip": {"floor": 1.0}})
    given = SimpleNamespace(rng=lambda name: name, joint_names=("hip",))
    fitted = SimpleNamespace(hypothesis="laws", values="numbers")
    ready = SimpleNamespace(given=given, held=SimpleNamespace(takes="kept aside"))
    asked = []
    monkeypatch.setattr(stating, "vetoed", lambda *told: asked.append(told) or list(gone))
    monkeypatch.setattr(stating, "without", lambda fitted, dropped: ("the rest", dropped))
    monkeypatch.setattr(stating, "scores_of", lambda fitted, ready: {"heldout": fitted})
    monkeypatch.setattr(stating, "veto_sentence", lambda dropped, names: "taken back")
    found = stating._kept(stating.Correction(fitted, own.scores, ("before",)), ready)
    [(laws, numbers, takes, rng, floor)] = asked
    assert (laws, numbers, takes, rng, floor.tolist()) == ("laws", "numbers", "kept aside", "heldout", [1.0])
    assert found.fitted == ("the rest", gone)
    assert found.scores == {"heldout": ("the rest", gone)}
    assert found.sentences == ("before", "taken back")
    assert found.taken_back == gone
    gone.clear()
    own_scores = {"train": own.scores["train"]}
    for correction, held in (
        (stating.Correction(fitted, own.scores), ready.held),  # nothing gets worse
        (stating.Correction(fitted, own_scores), ready.held),
        (stating.Correction(None, own.scores), ready.held),
        (stating.Correction(fitted, own.scores), None),
    ):
        assert stating._kept(correction, SimpleNamespace(given=given, held=held)) is correction
    assert len(asked) == 2


def logged(kd, **metadata):
    return SimpleNamespace(
        kd=None if kd is None else np.array(kd),
        joint_names=("hip", "knee", "foot"),
        metadata=metadata,
        source="a/b.npz",
    )


@pytest.mark.parametrize(
    ("kds", "joints"),
    [
        ([(3.0, 2.0, 0.0)], ["hip", "knee"]),
        ([(3.0, 2.0, 1.0), (3.0, 2.5, 1.0)], ["hip", "foot"]),
        ([(3.0, 2.0, 0.0), (3.0, 0.0, 0.0)], ["hip"]),
        ([(3.0, 2.0, 1.0), None], []),
        ([None], []),
    ],
)
def test_a_joint_is_damped_by_its_loop_where_one_kd_above_zero_is_logged_in_all_takes(kds, joints):
    assert _damped([logged(kd) for kd in kds]) == joints


def test_weights_are_said_with_the_takes_that_carry_them():
    takes = [replace_source(logged(None, payload_kg=mass), name) for name, mass in
             (("x/one.npz", 0.5), ("two.npz", 1.5), ("three.npz", 0.5), ("four.npz", 0.0))]  # fmt: skip
    first, second = model_changes(takes)
    assert first.startswith("The metadata of one.npz, three.npz say payload_kg: in their simulations 0.5 kg")
    assert second.startswith("The metadata of two.npz say payload_kg: in its simulations 1.5 kg")
    assert model_changes(takes[3:]) == []


def replace_source(take, source):
    take.source = source
    return take


def test_trims_that_moved_are_told_with_their_joint_and_by_how_much_of_the_given_number():
    def trim(name, where, *parameters):
        return SimpleNamespace(effect=SimpleNamespace(name=name), where=where, parameters=parameters)

    mass = Parameter("scale", "1", 2.0, 1.0, 3.0, 0.1)
    offset = Parameter("offset", "rad", 0.0, -0.5, 0.5, 0.1)
    trims = trim("link_mass", "hip", mass), trim("encoder_offset", "knee", offset), trim("link_mass", "foot", mass)
    for values, told in (
        ((2.1, 0.049, 1.9), "link mass of hip +5 %, link mass of foot -5 %"),
        ((2.019, -0.06, 2.04), "encoder offset of knee offset -0.06 rad, link mass of foot +2 %"),
        ((2.0, 0.0, 2.0), None),
    ):
        said = _trimmed(SimpleNamespace(hypothesis=Hypothesis((), trims), values=np.array(values)))
        sentence = f"Beside the findings the corrected model was adjusted within its tolerances: {told}."
        assert said == (() if told is None else (sentence,))


def test_the_quality_is_told_of_all_recordings_those_kept_aside_too(monkeypatch):
    monkeypatch.setattr("torchrl_athletic.diagnosis.state.is_slide", lambda model, address, joint: joint == 1)
    signals = SimpleNamespace(nominal=None, address=None, recording=logged(None))
    sets = [
        SimpleNamespace(signals=[signals], report=lambda name=name: {"recordings": [name], "used_share": name})
        for name in ("fitted", "aside")
    ]
    given = SimpleNamespace(
        recordings=[logged(None)], heldout=[logged(None, payload_kg=2.0)], drive="measured", warnings=("w",)
    )
    told = _quality(SimpleNamespace(train=sets[0], held=sets[1], given=given, doubts=("x",)))
    assert told["recordings"] == ["fitted", "aside"]
    assert told["used_share"] == "fitted"
    assert told["units"] == {"hip": "rad", "knee": "m", "foot": "rad"}
    assert (told["drive"], told["warnings"]) == ("measured", ["w"])
    assert "2 kg" in told["model_changes"][0]
    assert told["column_doubts"] == ["x"]
    assert _quality(SimpleNamespace(train=sets[0], held=None, given=given, doubts=()))["recordings"] == ["fitted"]


@pytest.mark.parametrize(
    ("has_trial", "drive", "asked"), [(True, None, True), (True, "drive", False), (False, None, False)]
)
def test_a_remainder_is_looked_for_in_both_sets_where_the_mechanics_alone_were_named(
    has_trial, drive, asked, monkeypatch
):
    told = []
    monkeypatch.setattr(stating, "remarks_on", lambda *given: told.append(given) or ("rings",))
    monkeypatch.setattr(stating, "_trimmed", lambda corrected: ("adjusted",))
    (train, held) = (SimpleNamespace(signals=(SimpleNamespace(kernel=k),)) for k in (0.0266, 0.5))
    best = Trial(Proposal(None, "best"), None, {}, np.zeros((1, 1)), np.zeros(1)) if has_trial else None
    for aside, signals in ((held, held.signals), (None, ())):
        told.clear()
        located = SimpleNamespace(ready=SimpleNamespace(train=train, held=aside))
        said = stating._remarks(Decided(located, drive, best), "corrected")
        assert said == (("rings",) if asked else ()) + ("adjusted",)
        assert told == ([(train.signals, signals, "best", pytest.approx(5.0))] if asked else [])  # up to 5 Hz


@pytest.mark.parametrize(
    ("verdict", "worse", "trials", "stopped", "corrected", "helped"),
    [
        ("explained", False, True, "", True, False),
        ("nothing_missing", False, True, "", False, False),
        ("partly_explained", True, True, "", False, False),  # of the fitted recordings
        ("unexplained", False, False, "simulate", False, False),
        ("unexplained", False, False, "", False, False),
        ("explained", False, True, "report", True, False),
        ("explained", False, True, "", True, True),  # by another trial: what is named makes it worse
    ],
)
@pytest.mark.parametrize("last_of", ["heldout", "train"])
def test_the_corrected_simulation_is_the_given_one_unless_a_trial_is_better(
    monkeypatch, verdict, worse, trials, stopped, corrected, last_of, helped
):
    own = trial(4.0)
    if last_of == "train":  # nothing was kept aside
        del own.scores["heldout"]
    own.scores["train"] = Score(9.0, 9.5 if worse or helped else 2.0, 1.0, 0.0, {})
    useless, helping = trial(1.0), (trial(3.0),) if helped else ()
    useless.scores["train"] = Score(9.0, 9.0, 1.0, 0.0, {})  # it changes nothing
    kept = stating.Correction(SimpleNamespace(hypothesis="laws", values="numbers"), {last_of: "kept"}, ("Why.",))
    told = {"remarked": []}
    given = SimpleNamespace(name="m", seed=7, inputs="digest", model="model", joint_names=("hip",), base="fixed")
    used = {"hip": STATEMENT.exercised, "knee": 0.9 * STATEMENT.exercised}
    ready = SimpleNamespace(given=given, train=SimpleNamespace(used_share=lambda: used))
    located = SimpleNamespace(ready=ready, locations=("where",))
    decided = Decided(located, None, own if trials else None, (useless, *helping), is_open=True)
    monkeypatch.setattr(stating, "_findings", lambda decided: ("finding",))
    monkeypatch.setattr(stating, "verdict_of", lambda *a: told.update(judged=a) or (verdict, 0.25))
    best = SimpleNamespace(fitted=own.fitted)
    monkeypatch.setattr(stating, "_best_followed", lambda trial, helpful: told.update(helpful=helpful) or best)
    monkeypatch.setattr(stating, "_nameless", lambda fitted, findings: (f"Of {fitted.values}.",))
    monkeypatch.setattr(stating, "_kept", lambda best, ready: told.update(kept=(best, ready)) or kept)
    monkeypatch.setattr(stating, "summarise", lambda *a: told.update(summed=a) or ("Summary.",))
    monkeypatch.setattr(stating, "open_share", lambda score: 0.125 if score == "kept" else 0.5)
    monkeypatch.setattr(stating, "_quality", lambda ready: "quality")
    monkeypatch.setattr(stating, "_remarks", lambda *given: told["remarked"].append(given) or ("remark",))
    monkeypatch.setattr(stating, "_maps", lambda decided: ["map"])
    said = stating.state(decided, stopped)
    assert (
        (said.corrected.hypothesis, said.corrected.values) == ("laws", "numbers")
        if corrected
        else (said.corrected is said.nominal)
    )
    if corrected:
        assert told["helpful"] == ([*helping] if helped else [own])
    assert said.nominal.hypothesis.terms == ()
    assert said.nominal.base == "fixed"
    scores = own.scores if trials else {}
    assert told["judged"] == (decided.evidence, ("finding",), scores.get("train"), scores.get("heldout"), True)
    left = {split: Score(9.0, 9.0, 1.0, 0.0, {}) for split in scores}  # the given model's
    last = None if worse else "kept" if corrected else left.get(last_of)
    share = (0.125 if corrected else 0.5) if trials else 0.25  # that the correction leaves
    assert told["summed"] == (verdict, ("finding",), ("where",), last, trials and last_of == "heldout", share)
    assert said.answer.fit == (kept.scores if corrected else left)
    sentences = said.answer.summary
    unnamed = bool(stopped) and not trials
    assert ("Summary." in sentences) is not unnamed
    assert sentences[0].startswith("Stopped before anything was named") is unnamed
    assert any("makes the simulation worse" in x for x in sentences) is worse
    assert ("Why." in sentences) is corrected
    assert ("Of numbers." in sentences) is corrected  # though some of the trial's own were taken back
    assert sentences[-1] == "knee hardly moves, so that nothing is known of it."
    assert not any("hip hardly" in x for x in sentences)
    assert (said.answer.complete, said.answer.stage) == (not stopped, stopped or "deliver")
    assert said.answer.remarks == (() if stopped else ("remark",))
    assert (said.answer.unexplained_share, said.answer.seed) == (0.25, 7)
    assert (said.answer.model, said.answer.inputs, said.answer.quality) == ("m", "digest", "quality")
    assert (said.answer.verdict, said.answer.findings, said.answer.locations) == (verdict, ("finding",), ("where",))
    assert (said.decided, said.maps) == (decided, ("map",))
    assert told["remarked"] == ([] if stopped else [(decided, said.corrected)])
    if corrected:
        assert told["kept"] == (best, ready)


@pytest.mark.parametrize("named", [True, False])
def test_maps_show_what_the_named_physics_leaves_and_before_any_name_all_that_is_missing(named, monkeypatch):
    monkeypatch.setattr(stating, "regime_maps", lambda *given: given)
    known, searched = (
        SimpleNamespace(target=f"missing, {name}", rows=lambda fit: f"left by {fit}")
        for name in ("located", "searched")
    )
    judge, best = SimpleNamespace(bank=searched), SimpleNamespace(fit="friction")
    own = Trial(Proposal(judge, best), None, {}, np.zeros((1, 1)), np.zeros(1)) if named else None
    ready = SimpleNamespace(given=SimpleNamespace(rng=lambda purpose: purpose))
    found = stating._maps(Decided(SimpleNamespace(ready=ready, bank=known), None, own))
    assert found == ((searched, "left by friction", "maps") if named else (known, "missing, located", "maps"))


def test_another_name_is_that_of_an_effect_that_acts_in_every_take(monkeypatch):
    """One that some take rules out is no other name for what all of them show."""
    catalogue = [
        SimpleNamespace(name=name, applies=lambda take, takes=takes: take in takes)
        for name, takes in (("everywhere", ("one", "two")), ("once", ("one",)), ("nowhere", ()))
    ]
    asked = []

    def judged(evidence, fitted, scores, sets, closes, of_motion):
        assert of_motion == {("friction", "hip"): 0.5}
        asked.append((evidence, fitted, list(scores), sets, closes))
        return "findings"

    monkeypatch.setattr(stating, "_closes", lambda decided, own: f"what each closes of {own.scores['train'].after}")
    monkeypatch.setattr(stating, "judge_findings", judged)
    monkeypatch.setattr(stating, "with_alternatives", lambda *given: given)
    given = SimpleNamespace(
        catalogue=catalogue, joint_names=("hip", "knee", "foot"), recordings=[logged((3.0, 0.0, 1.0))]
    )
    located = SimpleNamespace(ready=SimpleNamespace(given=given, train=SimpleNamespace(signals=("one", "two"))))
    own = trial(2.0)
    found, names, applying, damped = stating._findings(
        Decided(located, "drive", own, asked={("friction", "hip"): 0.5}, sets={"term": "stand-ins"})
    )
    (of_evidence, *of_fit) = asked[0]
    assert of_evidence == ("drive", own.proposal)
    assert of_fit == [own.fitted, list(own.scores.values()), {"term": "stand-ins"}, "what each closes of 2.0"]
    assert (found, names, damped) == ("findings", given.joint_names, ["hip", "foot"])
    assert [effect.name for effect in applying] == ["everywhere"]
    assert stating._findings(Decided(located)) == ()


def test_what_a_term_closes_counts_unless_two_torque_channels_show_it(monkeypatch):
    monkeypatch.setattr(stating, "keys", lambda terms: frozenset(terms))
    own = SimpleNamespace(closes={"friction": 0.2, "scale": 0.1})
    drive = SimpleNamespace(best=SimpleNamespace(fit=SimpleNamespace(terms=("scale",))))
    assert stating._closes(SimpleNamespace(drive=None), own) == own.closes
    assert stating._closes(SimpleNamespace(drive=drive), own) == {"friction": 0.2}


@pytest.mark.parametrize("own", [True, False])
def test_names_of_what_recordings_kept_aside_refuse_are_held_back_and_the_verdict_is_of_these(own, monkeypatch):
    """Not where the correction is another trial's, of which nothing was named."""
    named = trial(4.0)
    gone = SimpleNamespace(effect=SimpleNamespace(name="viscous_friction"), joint_name="hip")
    kept = stating.Correction(None, named.scores, taken_back=(gone,))
    followed = SimpleNamespace(fitted=named.fitted if own else "another trial's")
    monkeypatch.setattr(stating, "_findings", lambda decided: ("finding",))
    monkeypatch.setattr(stating, "refused", lambda findings, places: (*findings, *places))
    verdicts = []
    monkeypatch.setattr(stating, "verdict_of", lambda *a: verdicts.append(a[1]) or (f"verdict {len(verdicts)}", 0.25))
    monkeypatch.setattr(stating, "_best_followed", lambda trial, helpful: followed)
    monkeypatch.setattr(stating, "_kept", lambda best, ready: kept)
    monkeypatch.setattr(stating, "summarise", lambda *a: ())
    for name in ("_quality", "_remarks"):
        monkeypatch.setattr(stating, name, lambda *a: ())
    monkeypatch.setattr(stating, "_maps", lambda decided: [])
    given = SimpleNamespace(name="m", seed=7, inputs="digest", model="model", joint_names=("hip",), base="fixed")
    ready = SimpleNamespace(given=given, train=SimpleNamespace(used_share=dict))
    answer = stating.state(Decided(SimpleNamespace(ready=ready, locations=()), None, named, is_open=True)).answer
    expected = ("finding", ("viscous_friction", "hip")) if own else ("finding",)
    assert (answer.findings, verdicts[-1]) == (expected, expected)
    assert answer.verdict == ("verdict 2" if own else "verdict 1")


def term(name, joint):
    return SimpleNamespace(key=(name, joint), where=joint or "the robot")


@pytest.mark.parametrize(("terms", "is_open"), [([term("friction", "hip")], True), ([], False)])
def test_where_numbers_are_needed_that_have_no_name_something_is_missing(terms, is_open, monkeypatch):
    """Or the correction that needs them would be given up for a model that lacks nothing."""
    own = trial(4.0)
    own.fitted.hypothesis = SimpleNamespace(terms=terms)
    monkeypatch.setattr(stating, "verdict_of", lambda *told: told)
    assert stating._verdict(Decided(None, None, own, is_open=False), ())[-1] is is_open
    assert stating._verdict(Decided(None, None, own, is_open=True), ())[-1] is True
    assert stating._verdict(Decided(None, None, None, is_open=False), ()) == ((), (), None, None, False)


def test_numbers_of_the_correction_that_are_no_findings_are_told_by_their_joints():
    named = SimpleNamespace(effect="friction", joint="hip")
    of = lambda *terms: SimpleNamespace(hypothesis=SimpleNamespace(terms=terms))  # noqa: E731
    fitted = of(term("friction", "hip"), term("scale", "knee"), term("rotor", "knee"), term("tilt", None))
    (said,) = stating._nameless(fitted, [named])
    assert said == "The corrected simulation also has fitted numbers at knee, the robot that are no findings."
    assert stating._nameless(of(term("friction", "hip")), [named]) == ()
