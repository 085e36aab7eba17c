"""The parts of the page one by one, with pictures that only say what they were asked to show."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from diagnosis.sample import arm, slider
from markupsafe import Markup

from torchrl_athletic.diagnosis.report import page
from torchrl_athletic.diagnosis.report.figures import torque_limit
from torchrl_athletic.diagnosis.report.telling import by_telling, telling_window
from torchrl_athletic.diagnosis.result import Answer, Finding, Location, Score
from torchrl_athletic.effects import CATALOGUE

ROWS = {
    "hip": {"before": 0.4, "after": 0.2, "floor": 0.1},
    "knee": {"before": 0.3, "after": 0.05, "floor": 0.01},
    "toe": {"before": 0.2, "after": 0.15, "floor": 0.2},
}
RADIANS = dict.fromkeys(ROWS, "rad")


def score(*joints: str) -> Score:
    return Score(0.5, 0.25, 0.125, 0.9, {joint: ROWS[joint] for joint in joints})


@pytest.fixture
def drawn(monkeypatch):
    """Figures as (kind, what it shows), and the names and descriptions of the pictures made of them."""
    pictures = []
    for kind in ("fit", "why", "regime", "overlay"):
        monkeypatch.setattr(page, f"{kind}_figure", lambda *given, kind=kind: (kind, *given))
    monkeypatch.setattr(page, "svg", lambda *given: pictures.append(given) or given[1])
    return pictures


# --- how well it fits ---


def test_the_first_picture_is_of_what_was_kept_aside_worst_beside_its_floor_first(drawn):
    answer = Answer("explained", (), fit={"train": score("hip"), "heldout": score("hip", "knee", "toe")})
    hero = page._hero(answer, RADIANS)
    ((figure, name, alt),) = drawn
    assert (hero["split"], hero["left_out"], hero["share_closed"], name) == ("heldout", 0, 0.9, "fit")
    assert figure == ("fit", [(joint, "rad", *ROWS[joint].values()) for joint in ("knee", "hip", "toe")])
    assert "knee 0.300 rad before, 50.0 mrad after, noise floor 10.0 mrad; hip 0.400 rad before" in alt
    assert hero["numbers"] == (["0.500", "0.250", "0.125"], "rad")
    assert page._hero(replace(answer, fit={"train": score("hip")}), RADIANS)["split"] == "train"
    assert page._hero(replace(answer, fit={}), RADIANS) is None
    silent = replace(score("hip", "toe"), per_joint={"hip": ROWS["hip"], "toe": {**ROWS["toe"], "floor": 0.0}})
    page._hero(replace(answer, fit={"train": silent}), RADIANS)
    assert [row[0] for row in drawn[-1][0][1]] == ["toe", "hip"]


def test_without_joints_the_whole_is_drawn_and_metres_and_radians_have_no_common_number(drawn):
    whole = Answer("explained", (), fit={"train": score()})
    assert page._hero(whole, {})["left_out"] == 0
    assert drawn[0][0] == ("fit", [("all joints", "rad", 0.5, 0.25, 0.125)])
    rails = Answer("explained", (), fit={"train": score("hip", "knee")})
    assert page._hero(rails, {"hip": "m", "knee": "m"})["numbers"][1] == "m"
    assert page._hero(rails, {"hip": "m", "knee": "rad"})["numbers"] is None


@pytest.mark.parametrize(
    ("joints", "units", "names"),
    [
        (("hip", "knee"), RADIANS, ["all joints", "hip", "knee"]),
        (("hip",), RADIANS, ["hip"]),
        (("hip", "knee"), {"hip": "rad", "knee": "m"}, ["hip", "knee"]),
        ((), {}, ["all joints"]),
    ],
)
def test_the_table_has_the_whole_first_where_there_is_one_number_for_it(joints, units, names):
    rows = page._fit_rows(score(*joints), units)
    assert [row["joint"] for row in rows] == names


def test_the_share_closed_is_told_only_where_there_was_a_gap():
    closed = {row["joint"]: row["closed"] for row in page._fit_rows(score("hip", "toe"), RADIANS)}
    assert closed == {"all joints": pytest.approx(2 / 3), "hip": pytest.approx(2 / 3), "toe": None}


def test_parts_of_the_error_are_named_by_whether_anything_was_found():
    fit = {"train": Score(5.0, 3.0, 1.0, 0.5, {}), "train_uan": Score(5.0, 1.0, 1.0, 0.5, {})}
    finding = arm().answer.findings[0]
    found = page._shares(Answer("explained", (), findings=(finding,), fit=fit), "train")
    assert [(part, name) for part, name, _ in found] == [
        ("physics", "named physics"), ("uan", "UAN"), ("unexplained", "unexplained"), ("noise", "noise")
    ]  # fmt: skip
    nothing = page._shares(Answer("unexplained", (), fit=fit), "train")
    assert [name for _, name, _ in nothing] == ["adjusted within tolerances", "UAN", "noise"]
    still = page._shares(Answer("nothing_missing", (), fit={"train": Score(5.0, 5.0, 2.0, 0.0, {})}), "train")
    assert [name for _, name, _ in still] == ["beyond the noise", "noise"]


# --- why it is said ---


def test_each_map_that_gave_findings_away_is_drawn_once_with_their_laws(drawn):
    s = arm()
    friction, inertia = (replace(f, joint="elbow") for f in s.answer.findings)
    answer = replace(s.answer, findings=(friction, inertia, replace(friction, effect="my_own", regime="speed")))
    first, second = page._whys(answer, s.maps)
    assert [(w["findings"], w["feature"]) for w in (first, second)] == [
        ([friction, answer.findings[2]], "speed"), ([inertia], "acceleration")
    ]  # fmt: skip
    (law,) = [e for e in CATALOGUE if e.name == "coulomb_friction"]
    assert first["laws"] == [(law.equation, law.source)]
    assert [(figure[0], name) for figure, name, _ in drawn] == [("why", "why0"), ("why", "why1")]
    assert all(alt.startswith("Missing torque of elbow") for *_, alt in drawn)


def test_without_findings_the_joint_with_most_of_the_error_is_drawn_along_what_shows_most(drawn):
    s = arm()
    (why,) = page._whys(replace(s.answer, findings=()), s.maps[::-1])
    assert (why["joint"], why["findings"], why["force"]) == ("elbow", [], "torque")
    assert drawn[0][0] == ("regime", by_telling([m for m in s.maps if m.joint == "elbow"])[0])


def test_maps_of_a_joint_share_a_scale_most_telling_first_while_there_is_room(drawn, monkeypatch):
    monkeypatch.setattr(page, "MOST_MAPS", 6)
    s = arm()
    groups = page._regimes(s.answer, s.maps)
    assert [(g["joint"], len(g["panels"]), g["left_out"]) for g in groups] == [("elbow", 4, 0), ("shoulder", 2, 2)]
    assert [name for _, name, _ in drawn] == [f"map{k}" for k in range(6)]
    for joint, figures in (("elbow", drawn[:4]), ("shoulder", drawn[4:])):
        own = by_telling([m for m in s.maps if m.joint == joint])
        assert [figure for figure, *_ in figures] == [("regime", m, torque_limit(own)) for m in own[: len(figures)]]
    assert {g["force"] for g in page._regimes(slider().answer, slider().maps)} == {"force"}


def test_a_map_in_words_has_its_extremes_where_they_are_and_what_is_left_whatever_its_sign():
    m = slider().maps[1]
    rows = {"centre": np.array([0.5, 1.0, 2.0, 3.0]), "before": np.array([np.nan, -2.0, 3.0, 1.0]),
            "after": np.array([np.nan, -0.5, 0.25, np.nan])}  # fmt: skip
    words = page._spoken(replace(m, **rows, noise=0.125))
    assert "from −2.00 N at 1.00 m/s to 3.00 N at 2.00 m/s. After: at most 0.500 N. Sensor noise: 0.125 N." in words
    assert page._spoken(replace(m, before=np.full(3, np.nan))).endswith("no bin holds enough samples.")


# --- the motion ---


def test_each_recording_shows_its_telling_seconds_of_the_joints_that_matter_while_there_is_room(drawn, monkeypatch):
    monkeypatch.setattr(page, "MOST_OVERLAYS", 3)
    s = arm()
    kept = [replace(o, recording=name) for o, name in zip(s.overlays[:3], "abc", strict=True)]
    motion = page._motion(s.answer, kept, {"shoulder": "m"})
    assert [len(g["panels"]) for g in motion["groups"]] == [2, 1]
    assert [g["left_out"] for g in motion["groups"]] == [0, 1]
    assert len(motion["left_out"]) == 1
    overlay = motion["groups"][0]["overlay"]
    window = telling_window(overlay)
    assert (motion["groups"][0]["start"], motion["groups"][0]["stop"]) == tuple(overlay.time[window][[0, -1]])
    assert [(figure[2], figure[3], figure[4]) for figure, *_ in drawn[:2]] == [
        ("elbow", "rad", window), ("shoulder", "m", window)
    ]  # fmt: skip
    assert [name for _, name, _ in drawn] == ["motion0", "motion1", "motion2"]


def test_the_errors_beside_a_motion_are_those_of_its_joint_in_its_seconds(drawn):
    o = arm().overlays[0]
    window = np.zeros(len(o.time), dtype=bool)
    window[500:1250] = True
    off = np.where(window[:, None], [0.5, 0.25], 0.0)
    seen = replace(o, before=o.measured + off, after=o.measured + off / 10)
    (group,) = page._motion(arm().answer, [seen], {})["groups"]
    told = {panel["joint"]: panel["numbers"] for panel in group["panels"]}
    assert told == {"shoulder": "0.500 → 0.050 rad", "elbow": "250 → 25 mrad"}
    assert all("Error in these seconds" in alt for *_, alt in drawn)


# --- the robot ---


def locations(*shares: float) -> tuple[Location, ...]:
    places = [Location(f"j{k}", "everywhere", share, (0, 1)) for k, share in enumerate(shares)]
    return (*places, Location("j1", "moving backwards", 0.5, (0, 1)))


@pytest.mark.parametrize(
    ("verdict", "shares", "notes"),
    [
        ("explained", (0.6, 0.01), {"j0": "Coulomb friction, 1 more", "j1": "1 % of the error"}),
        ("nothing_missing", (0.6, 0.01), {"j0": "", "j1": ""}),
        (
            "explained",
            (0.6, *[0.05] * 6, 0.01),  # of many joints those that matter
            {"j0": "Coulomb friction, 1 more"} | {f"j{k}": "5 % of the error" for k in range(1, 7)},
        ),
    ],
)
def test_the_robot_has_notes_of_its_findings_and_of_where_the_error_is(verdict, shares, notes, monkeypatch):
    asked = []
    monkeypatch.setattr(page, "robot_svg", lambda *given: asked.append(given) or "")
    findings = tuple(Finding(effect, joint, 0.9, "", {}, "") for effect, joint in (
        ("coulomb_friction", "j0"), ("backlash", "j0"), ("gravity_tilt", None)))  # fmt: skip
    answer = Answer(verdict, (), findings=findings, locations=locations(*shares))
    page._robot(answer, "model")
    assert asked == [("model", {"j0": None, None: None}, notes)]
    assert page._robot(answer, None) is None


# --- the recordings, and small things ---


def test_recordings_are_told_with_what_was_masked_and_lasted_together():
    quality = {
        "recordings": [
            {"source": "a", "rate": 100.0, "duration": 2.0, "masked": {"gap": 3, "stall": 0},
             "bridged": {"hip": 2, "knee": 1}, "warnings": ["late"]},
            {"source": "b", "rate": 100.0, "duration": 3.0},
        ],
        "warnings": ["in all"], "units": {"hip": "rad"}, "left_out": [], "base": None,
        "used_share": {"hip": 0.25}, "model_changes": ["heavier"],
    }  # fmt: skip
    told = page._quality(quality)
    assert told["recordings"][0] == {
        "source": "a", "rate": "100 Hz", "duration": "2.00 s", "masked": {"gap": 3}, "bridged": 3,
        "warnings": ["late"],
    }  # fmt: skip
    assert told["total"] == "5.00 s"
    assert told["warnings"] == ["in all"]
    assert told["notes"] == {"Used share": "hip 25 %", "Model changes": "['heavier']"}
    assert page._note({"hip": 0.5, "why": "stuck"}) == "{'hip': 0.5, 'why': 'stuck'}"


@pytest.mark.parametrize("unit", ["%", "mrad", "rad", "ms", "s", "mm", "µm", "N·m", "N", "kg", "Hz"])
def test_a_number_stays_with_its_unit_and_code_as_it_is(unit):
    assert page._together(f"of 5 {unit} in all") == f"of 5\N{NO-BREAK SPACE}{unit} in all"
    assert page._together(Markup(f"5 {unit}")) == f"5 {unit}"
    assert page._together("5 samples") == "5 samples"


def test_the_page_says_the_folder_it_lies_in_and_the_weight_that_the_plan_asks_for(tmp_path, drawn, monkeypatch):
    monkeypatch.setattr(page, "robot_svg", lambda *given: "a robot")
    s = arm()
    path = page.write_report(s.answer, s.maps, s.overlays, tmp_path / "mine" / "report.html", s.model, "Swing it.", 0.5)
    text = path.read_text("utf-8")
    assert "--output mine --continue new_recording.npz --payload 0.5" in text
    assert "a robot" in text
    assert text.index('<td class="split">kept aside') < text.index('<td class="split">fitted')
