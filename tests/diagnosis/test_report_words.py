"""What the terminal and the page say in the same words: what leads, what follows, and what is not said."""

import shlex
from dataclasses import replace
from importlib.metadata import entry_points

import pytest

from torchrl_athletic.diagnosis import command
from torchrl_athletic.diagnosis.report.terminal import MOST_REGIMES, terminal_summary
from torchrl_athletic.diagnosis.report.words import (
    IF_KNOWN,
    banners,
    besides,
    bridged_readings,
    go_on,
    grounds_words,
    lead,
    next_takes,
    of_class,
    quality_counts,
    same_as,
    title,
    unexplained,
    verdict_words,
    would_change,
)
from torchrl_athletic.diagnosis.result import Answer, Finding, Location, Name, Rival, Score
from torchrl_athletic.diagnosis.thresholds import STATEMENT
from torchrl_athletic.effects.effect import CLASSES

FRICTION = Finding("coulomb_friction", "hip", 0.9, "Friction is missing.", {}, "everywhere")
TILT = Finding("gravity_tilt", None, 0.7, "Gravity is tilted.", {}, "everywhere")
PLACES = (
    Location("knee", "everywhere", 0.6, (0.5, 0.7)),
    Location("hip", "everywhere", 0.4, (0.4, 0.4)),
    Location("knee", "moving backwards", 0.5, (0.4, 0.6)),
    Location("hip", "moving forwards", 0.3, (0.2, 0.4)),
)
FOLLOWED = {"train": Score(9.0, 3.0, 1.0, 0.75, {})}


@pytest.mark.parametrize(
    ("summary", "led", "left"),
    [
        ((), [verdict_words(Answer("explained", ()))[1]], []),
        (("Friction is missing.", "A.", "B.", "C."), ["Friction is missing.", "A.", "B."], ["C."]),
        (("A.", "B.", "C.", "D."), ["A.", "B.", "C."], ["D."]),
        (
            ("A.", "Friction is missing.", "Gravity is tilted.", "B.", "C."),
            ["Two effects are likely missing: Coulomb friction (hip, 90 %) and gravity tilt (whole robot, 70 %).", "A.",
             "B."],
            ["C."],
        ),
    ],
)  # fmt: skip
def test_what_the_summary_says_is_said_once_likely_findings_first_and_the_rest_below(summary, led, left):
    answer = Answer("explained", summary, findings=(FRICTION, TILT))
    assert lead(answer) == led
    assert besides(answer) == left


def test_what_would_change_the_answer_is_its_first_rival_or_more_of_what_shows_the_rest():
    rivals = tuple(Rival(name, "hip", 0.1, f"Do {name}.") for name in ("viscous_friction", "backlash"))
    explained = Answer("explained", (), findings=(TILT, replace(FRICTION, rivals=rivals)))
    assert would_change(explained).endswith("or a next recording that favours viscous friction.")
    assert next_takes(explained) == ["Do viscous_friction.", "Do backlash."]
    bare = would_change(replace(explained, findings=(TILT,)))
    assert "favours" not in bare
    assert bare.endswith("more than here.")
    partly = Answer("partly_explained", (), locations=PLACES)
    assert would_change(partly).endswith("above all of knee, moving backwards.")
    assert would_change(replace(partly, locations=PLACES[:2])).endswith("Record more of the motion that shows it.")
    assert next_takes(partly)[0].endswith("what is left: knee, moving backwards.")
    assert next_takes(replace(partly, locations=()))[0].endswith("what is left: the joint with the largest error.")
    assert next_takes(replace(partly, verdict="unexplained"))[0].startswith("Knee alone:")
    assert next_takes(Answer("unexplained", ()))[0].startswith("One joint at a time:")


@pytest.mark.parametrize(("joint", "where"), [("hip", "the joint"), (None, "the joint that is explained worst")])
def test_grounds_are_those_that_were_kept_about_the_joint_that_counts(joint, where):
    told = replace(FRICTION, joint=joint, grounds={"energy": 0.4, "far": 0.0, "sure": 3.14})
    assert grounds_words(told) == [
        f"It accounts for 40 % of the missing torque of {where}.",
        "Its numbers lie 3.1 standard deviations from the given model's.",
    ]
    [far] = grounds_words(replace(told, grounds={"far": 1.0}))
    assert f"of {joint or 'some joint'} is still far" in far
    [refused] = grounds_words(replace(told, grounds={"refused": 1.0, "far": 0.0}))
    assert "kept aside" in refused
    [closes] = grounds_words(replace(told, grounds={"closes": 0.04}))
    assert "closes 4 % of the simulation's error" in closes
    assert grounds_words(FRICTION) == []


@pytest.mark.parametrize(
    ("law", "class_probability", "name", "said"),
    [
        (STATEMENT.likely, 0.9, "friction", True),
        (STATEMENT.likely + 0.01, 0.9, "friction", False),
        (0.4, 0.405, "friction", False),
        (0.4, 0.42, "friction", True),
        (0.4, 0.9, "", False),
    ],
)
def test_a_class_is_told_where_it_says_more_than_its_law(law, class_probability, name, said):
    finding = replace(FRICTION, probability=law, class_name=name, class_probability=class_probability)
    assert of_class(finding) == ("friction there, by whichever law" if said else "")


@pytest.mark.parametrize(
    ("verdict", "fit", "share", "said"),
    [
        ("partly_explained", FOLLOWED, 0.25, ["25 % of the error energy above the noise floor stays unexplained."]),
        ("nothing_missing", FOLLOWED, 0.25, []),
        ("partly_explained", {}, 0.25, []),
        ("explained", FOLLOWED, 0.0, []),
    ],
)
def test_what_has_no_name_is_told_where_it_was_measured_and_is_some(verdict, fit, share, said):
    assert unexplained(Answer(verdict, (), fit=fit, unexplained_share=share)) == said


def test_masked_samples_add_up_over_the_recordings_and_each_warning_names_its_own():
    recordings = [
        {"source": "a", "masked": {"gap": 2, "stall": 0}, "warnings": ["slow"]},
        {"masked": {"gap": 3, "frozen": 1}, "warnings": ["loud"]},
    ]
    counted = quality_counts({"recordings": recordings, "warnings": ["thinned"]})
    assert counted == ({"gap": 5, "frozen": 1}, ["thinned", "a: slow", "a recording: loud"])
    assert quality_counts({}) == ({}, [])


def test_readings_that_were_put_between_others_are_counted_over_the_joints():
    assert bridged_readings({"bridged": {"hip": 2, "knee": 3}}) == 5
    assert bridged_readings({}) == 0  # of an earlier version's file


def test_a_changed_model_is_told_before_a_run_that_was_stopped():
    answer = Answer("explained", (), complete=False, stage="decide", quality={"model_changes": ["It carries 1 kg."]})
    first, second = banners(answer)
    assert first == "It carries 1 kg."
    assert second.startswith("Stopped early, in the stage 'decide'")
    assert banners(replace(answer, complete=True, quality={})) == []
    doubtful = replace(answer, quality={**answer.quality, "column_doubts": ["the torque of hip is none."]})
    assert banners(doubtful) == ["Warning: the torque of hip is none.", first, second]


def test_the_terminal_shows_joints_then_the_first_regimes_and_a_band_only_where_it_has_a_width():
    more = tuple(Location("knee", f"regime {k}", 0.1, (0.0, 0.2)) for k in range(MOST_REGIMES))
    lines = terminal_summary(Answer("partly_explained", (), locations=PLACES + more)).splitlines()
    start = next(k for k, line in enumerate(lines) if "where the error is" in line)
    rows = [line.split("  ") for line in lines[start + 1 : start + 1 + 2 + MOST_REGIMES]]
    told = [(" ".join(row).split()) for row in rows]
    assert told[0] == "knee, everywhere 60 % 50 to 70".split()
    assert told[1] == "hip, everywhere 40 %".split()
    assert told[2][:3] == ["knee,", "moving", "backwards"]
    assert not lines[start + 3 + MOST_REGIMES]
    assert f"regime {MOST_REGIMES - 2}" not in "\n".join(lines)


@pytest.mark.parametrize("joints", [("knee",), ("knee", "hip")])
def test_joints_are_told_apart_on_the_first_set_and_the_gap_closed_of_one_joint_is_the_scores(joints):
    rows = {joint: {"before": 9e-3, "after": 5e-3, "floor": 1e-3} for joint in joints}
    fit = {split: Score(9e-3, 5e-3, 1e-3, 0.25, rows) for split in ("train", "heldout")}
    text = terminal_summary(Answer("explained", (), fit=fit))
    told = {
        name: text.count(f"  {name}") for name in ("kept aside, all", "kept aside, knee", "fitted, all", "fitted, knee")
    }
    several = len(joints) > 1
    assert list(told.values()) == ([1, 1, 1, 0] if several else [0, 1, 0, 1])
    shares = [line.split()[-2] for line in text.splitlines() if "[mrad]" in line]
    assert shares == (["25", "50", "50", "25"] if several else ["25", "25"])


def test_a_finding_that_the_answer_does_not_lead_with_is_told_beside_its_name():
    answer = Answer("partly_explained", ("Friction is missing.",), findings=(FRICTION, TILT))
    text = " ".join(terminal_summary(answer).split())
    assert text.count("Friction is missing.") == text.count("Gravity is tilted.") == 1


def test_a_class_is_called_as_it_is_in_sentences_and_a_name_keeps_its_own_capitals():
    (key, said) = next((key, said) for key, said in CLASSES.items() if said != key.replace("_", " "))
    finding = replace(FRICTION, probability=0.4, class_name=key, class_probability=0.9)
    assert of_class(finding) == f"{said} there, by whichever law"
    assert title("my_PID_loop") == "My PID loop"
    assert title("") == ""


def test_names_that_are_one_thing_are_told_with_their_partners_and_those_of_a_rival_without():
    late = (Name("actuation_delay", "hip"), Name("actuation_delay", "knee"))
    clock = replace(TILT, effect="clock_offset", alternatives=(late,))
    lag = replace(FRICTION, effect="actuation_lag", joint="hip", alternatives=(late,))
    answer = Answer("explained", (), findings=(clock, lag, FRICTION))
    same = "actuation delay of hip with actuation delay of knee: no recording tells them apart."
    assert same_as(clock, answer) == [f"Clock offset, which together with actuation lag of hip is the same as {same}"]
    own = "actuation delay with actuation delay of knee: no recording tells them apart."
    (of_lag,) = same_as(lag, answer)
    assert of_lag == f"Actuation lag, which together with clock offset of the whole robot is the same as {own}"
    rival = Rival("actuation_lag", "hip", 0.1, "", alternatives=(late,))
    assert same_as(rival, answer) == [f"Actuation lag, which here is the same as {own}"]
    assert same_as(FRICTION, answer) == []


def test_what_several_rivals_ask_for_is_asked_for_once_and_only_what_the_summary_says_leads():
    rivals = tuple(Rival(name, "hip", 0.1, "Swing it.") for name in ("viscous_friction", "backlash"))
    lag = Finding("actuation_lag", "knee", 0.6, "The knee is late.", {}, "", rivals=rivals)
    answer = Answer("explained", ("Gravity is tilted.", "The knee is late."), findings=(FRICTION, TILT, lag))
    assert next_takes(answer) == ["Swing it."]
    (told,) = lead(answer)
    assert told.endswith("likely missing: gravity tilt (whole robot, 70 %) and actuation lag (knee, 60 %).")


@pytest.mark.parametrize("findings", [(FRICTION,), ()])
def test_that_a_name_holds_if_the_physics_is_known_is_said_beside_names(findings):
    said = " ".join(terminal_summary(Answer("unexplained", (), findings=findings)).split())
    assert (IF_KNOWN in said) is bool(findings)


def test_going_on_takes_the_folder_whatever_it_is_called_and_the_weight():
    assert go_on("my run", 0.5).endswith("--output 'my run' --continue new_recording.npz --payload 0.5")
    assert go_on("run", 0.0).endswith("--output run --continue new_recording.npz")


def test_going_on_is_a_command_that_is_there_without_a_checkout(monkeypatch, capsys):
    program, *arguments = shlex.split(go_on("run", 0.5))
    [entry] = [e for e in entry_points(group="console_scripts") if e.name == program]
    monkeypatch.setattr(command, "main", lambda config, *_: print(config.output, *config.continue_with, config.payload))
    monkeypatch.setattr("sys.argv", [program, *arguments])
    entry.load()()
    assert capsys.readouterr().out == "run new_recording.npz 0.5\n"


def test_the_terminal_tells_splits_classes_rivals_and_remarks_each_in_its_place():
    late = (Name("actuation_delay", "hip"),)
    rivals = (Rival("actuation_lag", "hip", 0.1, "", alternatives=(late,)),)
    law = replace(FRICTION, probability=0.4, class_name="friction", class_probability=0.85, rivals=rivals)
    fit = {split: FOLLOWED["train"] for split in ("train", "heldout_uan", "heldout")}
    summary = ("One.", "Two.", "Three.", "Four.")
    answer = Answer("partly_explained", summary, findings=(law,), fit=fit, unexplained_share=0.25, remarks=("Five.",))
    text = terminal_summary(answer)
    splits = [text.index(f"  {name}, all joints") for name in ("kept aside", "kept aside, with a UAN", "fitted")]
    assert splits == sorted(splits)
    rows = [line.split() for line in text.splitlines()]
    assert ["friction", "there,", "by", "whichever", "law", "85", "%"] in rows
    assert "Actuation lag, which here is the same as actuation delay" in " ".join(text.split())
    for remark in ("25 % of the error energy above the noise floor stays unexplained.", "Four.", "Five."):
        assert remark in text.splitlines()
