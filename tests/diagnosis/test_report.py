"""The page as a reader, a parser, a browser and somebody with bad intentions meet it."""

import ast
import html
import json
import re
import shutil
import subprocess
from collections import Counter
from dataclasses import replace
from functools import cache
from html.parser import HTMLParser
from pathlib import Path

import mujoco
import numpy as np
import pytest
from diagnosis.sample import ARM, SAMPLES, Sample, arm, partial, slider, unexplained

from torchrl_athletic.diagnosis.report import page as page_module
from torchrl_athletic.diagnosis.report import terminal_summary, write_report
from torchrl_athletic.diagnosis.report.page import render
from torchrl_athletic.diagnosis.report.words import grounds_words, lead, next_takes, would_change
from torchrl_athletic.diagnosis.result import Answer, Estimate, Finding, Location, Score

VOID = {"meta", "link", "input", "br", "img", "hr"}
HEADINGS = {
    "slider": "Partly explained",
    "arm": "Explained",
    "nothing_missing": "Nothing is missing",
    "unexplained": "Unexplained",
    "partial": "Partly explained",
}


class Page(HTMLParser):
    """What a page is made of: its elements, its words outside style sheets, and whether its tags close in order."""

    def __init__(self, text: str) -> None:
        super().__init__()
        self.elements: list[tuple[str, dict[str, str]]] = []
        self.words: list[str] = []
        self.rows: list[list[str]] = []
        self.code = ""
        self._open: list[str] = []
        self.feed(text)
        self.close()
        assert self._open == []

    def handle_startendtag(self, tag, attrs):
        self.elements.append((tag, dict(attrs)))

    def handle_starttag(self, tag, attrs):
        self.elements.append((tag, dict(attrs)))
        if tag not in VOID:
            self._open.append(tag)
        if tag == "tr":
            self.rows.append([])
        if tag in ("td", "th"):
            self.rows[-1].append("")

    def handle_endtag(self, tag):
        assert self._open.pop() == tag

    def handle_data(self, data):
        if "style" in self._open:
            return
        data = data.replace("\N{NO-BREAK SPACE}", " ")
        self.words.append(data)
        if "tr" in self._open and ("td" in self._open or "th" in self._open):
            self.rows[-1][-1] += data.strip()
        if "pre" in self._open:
            self.code += data

    @property
    def text(self) -> str:
        return " ".join("".join(self.words).split())


def text_of_sample(s: Sample) -> str:
    return render(s.answer, s.maps, s.overlays, model=s.model)


@cache
def text_of(name: str) -> str:
    return text_of_sample(SAMPLES[name]())


def short() -> Sample:
    """An arm with one map and one overlay."""
    s = arm()
    return replace(s, maps=s.maps[:1], overlays=s.overlays[3:4])


@cache
def harmless_text() -> str:
    return text_of_sample(short())


@pytest.fixture(params=SAMPLES)
def name(request) -> str:
    return request.param


def renamed(sample: Sample, old: str, new: str) -> Sample:
    """The sample with a joint (and all that is said of it) called otherwise."""
    content = json.dumps(sample.answer.to_json(), ensure_ascii=False).replace(
        old, json.dumps(new, ensure_ascii=False)[1:-1]
    )
    maps = tuple(replace(m, joint=m.joint.replace(old, new)) for m in sample.maps)
    overlays = tuple(
        replace(o, recording=new, joint_names=tuple(n.replace(old, new) for n in o.joint_names))
        for o in sample.overlays
    )
    spec = mujoco.MjSpec.from_string(ARM)
    spec.joint(old).name = new
    return Sample(Answer.from_json(json.loads(content)), maps, overlays, spec.compile())


def test_tags_close_in_order_and_ids_are_unique_and_found(name):
    page = Page(text_of(name))
    ids = Counter(attrs["id"] for _, attrs in page.elements if "id" in attrs)
    assert [i for i, n in ids.items() if n > 1] == []
    targets = {a["href"].removeprefix("#") for _, a in page.elements if a.get("href", "").startswith("#")}
    targets |= set(re.findall(r"url\(#([^)]+)\)", text_of(name)))
    assert targets - set(ids) == set()


def test_nothing_is_loaded_and_no_script_runs(name):
    page = Page(text_of(name))
    assert "://" not in text_of(name)
    assert {tag for tag, _ in page.elements} & {"script", "iframe", "object", "embed", "img", "base"} == set()
    for _, attrs in page.elements:
        assert not any(key.startswith("on") or key in ("src", "action", "srcset") for key in attrs)
        assert attrs.get("href", "#").startswith(("#", "data:,"))
    assert "@import" not in text_of(name)
    policy = next(a["content"] for _, a in page.elements if a.get("http-equiv") == "Content-Security-Policy")
    assert policy.startswith("default-src 'none'")


def test_everything_that_is_stated_is_on_the_page(name):
    answer, text = SAMPLES[name]().answer, Page(text_of(name)).text
    stated = [*answer.summary, *answer.remarks]
    for f in answer.findings:
        stated += [f.sentence, f.regime, f"{100 * f.probability:.0f} %", *(r.separating_experiment for r in f.rivals)]
    for where in answer.locations:
        stated += [where.regime, f"{100 * where.share_of_error:.0f} %"]
    for r in answer.quality["recordings"]:
        stated += [r["source"], *(f"{n} samples ({reason})" for reason, n in r["masked"].items() if n), *r["warnings"]]
    assert [s for s in [*stated, *answer.quality["warnings"]] if s not in text] == []


def test_the_heading_is_the_verdict(name):
    [heading] = re.findall(r"<h1[^>]*>(?:<span[^>]*></span>)?([^<]*)</h1>", text_of(name))
    assert heading == HEADINGS[name]


def test_the_page_tells_its_story_in_order(name):
    sections = [a["id"] for tag, a in Page(text_of(name)).elements if tag == "section" and "id" in a]
    order = ["where", "why", "rivals", "fit", "next", "data", "use"]
    assert sections == [s for s in order if s in sections]
    assert {"why", "fit", "next", "data"} <= set(sections)


def test_the_answer_is_at_most_three_sentences_and_says_what_would_change_it(name):
    answer, text = SAMPLES[name]().answer, text_of(name)
    told = re.findall(r"<p>(.*?)</p>", re.search(r'<div class="lead">(.*?)</div>', text, re.DOTALL)[1], re.DOTALL)
    assert [html.unescape(s).replace("\N{NO-BREAK SPACE}", " ") for s in told] == lead(answer)
    assert len(told) <= 3
    assert f"What would change this? {would_change(answer)}" in Page(text).text


def test_each_verdict_is_changed_by_something_else():
    answers = [f().answer for f in SAMPLES.values()]
    assert len({would_change(a) for a in answers}) == len(answers)
    assert "load dependent friction" in would_change(arm().answer)  # the rival that would take its place
    assert "moving backwards" in would_change(slider().answer)  # where the rest is


def test_the_next_recording_is_asked_for_where_the_error_is():
    assert next_takes(replace(unexplained().answer))[0].startswith("Elbow alone: slow constant speeds")
    [asked] = next_takes(replace(slider().answer, findings=()))
    assert asked == "More of the motion that shows what is left: carriage, moving backwards."
    asked = next_takes(arm().answer)
    assert asked == [r.separating_experiment for f in arm().answer.findings for r in f.rivals]


def test_many_findings_are_told_in_one_sentence():
    answer = arm().answer
    answer = replace(answer, summary=(*(f.sentence for f in answer.findings), "Most of it at the elbow.", "B.", "C."))
    first, *rest = lead(answer)
    said = "Coulomb friction (elbow, 98 %) and reflected inertia (shoulder, 84 %)"
    assert first == f"Two effects are likely missing: {said}."
    assert rest == ["Most of it at the elbow.", "B."]
    page = Page(render(answer, (), ())).text
    assert all(s in page for s in answer.summary)


def test_the_robot_is_drawn_with_the_joint_of_the_finding_marked(name):
    s = SAMPLES[name]()
    [drawing] = re.findall(r'<svg role="img" class="robot".*?</svg>', text_of(name), re.DOTALL)
    marked = set(re.findall(r'<g class="joint guilty"><title>(\w+)</title>', drawing))
    assert marked == {f.joint for f in s.answer.findings}
    assert "robot" not in {a.get("class") for _, a in Page(render(s.answer, s.maps, s.overlays)).elements}


def test_the_grounds_of_a_probability_are_said_in_words():
    text = Page(text_of("slider")).text
    assert "It has 97 % of the evidence" in text
    assert "21 % of the missing torque of the joint stays" in text
    assert "differs by 6 % from take to take" in text
    assert "rest on" in text
    assert "rest on" not in Page(text_of("arm")).text  # older answers did not keep them


def test_two_findings_that_show_in_one_map_share_a_picture():
    s = arm()
    friction = s.answer.findings[0]
    both = replace(s.answer, findings=(friction, replace(friction, effect="viscous_friction")))
    text = render(both, s.maps, s.overlays, model=s.model)
    assert text.count("why0-law-line") == 1
    assert "why1-law-line" not in text
    assert "Coulomb friction and viscous friction, elbow: missing torque against speed" in Page(text).text
    assert "Coulomb friction, 1 more" in text  # below the joint's name


def test_an_effect_of_the_whole_robot_is_shown_where_it_shows_most():
    s = arm()
    tilt = replace(s.answer.findings[0], effect="gravity_tilt", joint=None, rivals=())
    text = render(replace(s.answer, findings=(tilt,)), s.maps, s.overlays, model=s.model)
    assert "Gravity tilt, whole robot" in Page(text).text
    assert "missing torque of shoulder against position" in Page(text).text  # 0.02 N·m there, 0.01 at the elbow
    assert text.count('class="link guilty"') == 2


def test_a_number_and_its_unit_stay_on_one_line_and_code_as_it_is():
    s = arm()
    text = render(replace(s.answer, summary=("It is 5 % of 0.3 N·m at 2 Hz.",)), (), (), folder="run 5 m")
    assert "It is 5\N{NO-BREAK SPACE}% of 0.3\N{NO-BREAK SPACE}N·m at 2\N{NO-BREAK SPACE}Hz." in text
    assert "&#39;run 5 m&#39;" in text


def test_what_a_parameter_chooses_has_no_interval():
    s = arm()
    stop = replace(s.answer.findings[0], parameters={"side": Estimate(1.0, (1.0, 1.0), "1")})
    rows = {row[0]: row[1:] for row in Page(render(replace(s.answer, findings=(stop,)), (), ())).rows}
    assert rows["Side"][1] == ""


def test_shares_of_the_data_are_percentages_not_a_programs_words():
    answer = replace(arm().answer, quality={"used_share": {"shoulder": 1.0, "elbow": 0.5}, "drive": "command"})
    text = Page(render(answer, (), ())).text
    assert "shoulder 100 %, elbow 50 %" in text
    assert "{" not in text


def test_a_finding_is_only_as_sure_as_the_catalogue_is_whole():
    said = "hold if the physics is in the catalogue"
    s = arm()
    for answer, there in ((s.answer, True), (replace(s.answer, findings=()), False)):
        assert (said in Page(render(answer, (), ())).text) is there
        assert (said in " ".join(terminal_summary(answer).split())) is there


def test_the_planned_experiment_is_given_with_its_file_and_how_to_go_on():
    s = arm()
    page = Page(render(s.answer, (), (), "my out", experiment="Swing the elbow alone."))
    assert "Swing the elbow alone." in page.text
    assert "next_experiment.npz" in page.text
    assert "--output 'my out' --continue new_recording.npz" in page.code
    assert "--payload" not in page.code
    loaded = Page(render(s.answer, (), (), "my out", experiment="Swing the elbow alone.", payload=0.5))
    assert "--continue new_recording.npz --payload 0.5" in loaded.code
    assert "next_experiment.npz" not in Page(text_of("arm")).text


def test_a_robot_of_many_joints_makes_a_page_of_less_than_400_kilobytes():
    s = arm()
    joints = tuple(f"joint_{i:02d}" for i in range(18))
    maps = tuple(replace(m, joint=j) for j in joints for m in s.maps[:4])
    wide = {k: np.repeat(getattr(s.overlays[3], k)[:, :1], 18, axis=1) for k in ("measured", "before", "after")}
    overlays = tuple(replace(o, joint_names=joints, **wide) for o in s.overlays)
    text = render(replace(s.answer, fit={}), maps, overlays, model=s.model)
    assert len(text.encode()) < 400e3


def test_parameters_are_rounded_and_not_changed():
    rows = {row[0]: row[1:] for row in Page(text_of("slider")).rows}
    for key, p in slider().answer.findings[0].parameters.items():
        value, interval, unit = rows[key.replace("_", " ").capitalize()]
        low, high = interval.split(" to ")
        assert unit == p.unit
        assert [float(x) for x in (value, low, high)] == pytest.approx([p.value, *p.ci95], abs=0.051)


def test_the_fit_table_holds_every_joint_of_both_splits_in_milliradians():
    rows = [row for row in Page(text_of("arm")).rows if "mrad" in row]
    assert [row[1] for row in rows] == ["all joints", "shoulder", "elbow"] * 2
    assert [row[0] for row in rows] == ["kept aside", "", "", "fitted", "", ""]
    for split, chunk in (("heldout", rows[:3]), ("train", rows[3:])):
        score = arm().answer.fit[split]
        for row in chunk[1:]:
            truth = score.per_joint[row[1]]
            assert [float(x) for x in row[2:5]] == pytest.approx([1e3 * truth[k] for k in ("before", "after", "floor")])
            closed = (truth["before"] - truth["after"]) / (truth["before"] - truth["floor"])
            assert row[-1] == f"{100 * closed:.0f} %"


def test_probability_bars_are_as_long_as_they_are_probable():
    meters = [a for tag, a in Page(text_of("arm")).elements if a.get("role") == "meter"]
    sure = [float(a["aria-valuenow"]) for a in meters if a["aria-label"] == "probability that this is true"]
    assert sure == [0.98, 0.84]
    rivals = [float(a["aria-valuenow"]) for a in meters if a["aria-label"].startswith("probability of")]
    assert rivals == [0.98, 0.06, 0.84, 0.12, 0.03]
    assert "width:98.0%" in text_of("arm")
    assert "width:84.0%" in text_of("arm")


def test_every_picture_says_what_it_shows(name):
    pictures = [a for tag, a in Page(text_of(name)).elements if tag == "svg"]
    assert len(pictures) >= 3
    for a in pictures:
        assert a["role"] == "img"
        assert re.search(r"\d", a["aria-label"]), a["aria-label"]


def test_a_picture_speaks_of_its_extremes():
    s = slider()
    speed = next(m for m in s.maps if m.feature == "speed")
    at = speed.centre[np.argmax(speed.before)]
    alts = [a["aria-label"] for tag, a in Page(text_of("slider")).elements if tag == "svg"]
    alt = next(alt for alt in alts if "against speed" in alt)
    assert f"to {speed.before.max():.1f} N at {at:.3f} m/s" in alt


def test_a_partial_report_says_so_on_top_and_has_no_held_out_numbers():
    text = Page(text_of("partial")).text
    assert text.index("Stopped early") < text.index("Partly explained", text.index("Stopped early"))
    assert "No recordings were kept aside" in text
    assert "error, kept aside" not in text
    assert "Stopped early" not in Page(text_of("arm")).text


def test_no_effect_is_claimed_where_none_was_found():
    for quiet in ("nothing_missing", "unexplained"):
        assert "No effect is stated" in Page(text_of(quiet)).text
        assert "sure" not in Page(text_of(quiet)).text.split()


@pytest.mark.parametrize(
    "hostile",
    [
        "<script>alert(1)</script>",
        '"><img src=x onerror=alert(1)>',
        "</style></svg>&amp;",
        "$x$ {{ 7 * 7 }}",
        "关节 " * 40,
    ],
)
def test_hostile_names_are_only_text(hostile):
    page, harmless = Page(text_of_sample(renamed(short(), "elbow", hostile))), Page(harmless_text())
    assert Counter(tag for tag, _ in page.elements) == Counter(tag for tag, _ in harmless.elements)
    assert " ".join(hostile.split()) in page.text


def test_the_example_is_python_whatever_the_folder_is_called():
    s = slider()
    for folder in ("out", 'it\'s "<b>" \\ here'):
        code = ast.parse(Page(render(s.answer, (), (), folder=folder)).code)
        strings = {node.value for node in ast.walk(code) if isinstance(node, ast.Constant)}
        assert {folder, f"{folder}/corrected.xml"} <= strings


def test_values_that_are_not_numbers_do_not_break_the_page():
    s = arm()
    nothing = np.full_like(s.maps[0].before, np.nan)
    maps = (replace(s.maps[0], before=nothing, after=nothing), *s.maps[1:])
    gone = s.overlays[3].after.copy()
    gone[300:] = np.inf
    nan = np.full_like(gone, np.nan)
    overlays = (replace(s.overlays[3], after=gone), replace(s.overlays[4], before=nan, after=nan))
    text = render(s.answer, maps, overlays)
    page = Page(text)
    assert not re.search(r'(width|left):nan|[ML] ?nan|"nan"', text)
    assert "no bin holds enough samples" in text
    assert page.text.count("in these seconds") == 4


def test_an_answer_with_nothing_but_a_verdict_makes_a_page():
    page = Page(render(Answer("unexplained", ()), (), ()))
    assert "Simulation and robot differ" in page.text
    assert not [a for tag, a in page.elements if tag == "svg"]


def test_hinges_and_slides_are_not_pooled_into_one_number():
    answer = replace(arm().answer, quality={"units": {"shoulder": "rad", "elbow": "m"}})
    text = Page(render(answer, (), ())).text
    assert "all joints" not in text
    assert "217" not in text
    assert "mm" in text.split()


def test_what_there_is_no_room_for_is_said(monkeypatch):
    s = arm()
    joints = tuple(f"joint_{i:02d}" for i in range(9))
    maps = tuple(replace(m, joint=j) for j in joints[:2] for m in s.maps[:4])
    wide = {k: np.repeat(getattr(s.overlays[3], k)[:, :1], 9, axis=1) for k in ("measured", "before", "after")}
    overlays = (replace(s.overlays[3], joint_names=joints, **wide), replace(s.overlays[0], recording="left_out.csv"))
    monkeypatch.setattr("torchrl_athletic.diagnosis.report.page.MOST_MAPS", 6)
    monkeypatch.setattr("torchrl_athletic.diagnosis.report.page.MOST_OVERLAYS", 2)
    page = Page(render(replace(s.answer, fit={}), maps, overlays))
    assert sum(tag == "svg" for tag, _ in page.elements) == 6 + 2 + 1  # and the map of the first screen
    assert "7 more joints are not drawn" in page.text
    assert "Not drawn: left_out.csv" in page.text
    assert "2 more maps of this joint are not drawn" in page.text


def test_the_file_is_written_in_one_step(tmp_path, monkeypatch):
    s = partial()
    path = write_report(s.answer, s.maps, s.overlays, tmp_path / "new" / "report.html")
    before = path.read_text(encoding="utf-8")
    assert "Stopped early" in before
    assert "new/corrected.xml" in before
    monkeypatch.setattr("os.replace", lambda *_: (_ for _ in ()).throw(OSError("disk full")))
    with pytest.raises(OSError, match="disk full"):
        write_report(slider().answer, (), (), path)
    assert path.read_text(encoding="utf-8") == before
    assert [p.name for p in path.parent.iterdir()] == ["report.html"]


@pytest.fixture(scope="module")
def browse(tmp_path_factory):
    """Open a page in a headless browser: its console and its screenshot."""
    browser = next(
        (found for b in ("chromium", "chromium-browser", "google-chrome") if (found := shutil.which(b))), None
    )
    if browser is None:
        pytest.skip("no Chromium on the path: apt-get install chromium")

    def open_page(path: Path, *flags: str) -> tuple[list[str], np.ndarray]:
        from matplotlib.image import imread

        folder = tmp_path_factory.mktemp("browser")
        command = [
            browser,
            "--headless",
            "--no-sandbox",
            "--disable-gpu",
            "--disable-quic",
            "--no-first-run",
            "--disable-background-networking",
            "--disable-component-update",
            "--disable-sync",
            "--hide-scrollbars",
            "--enable-logging=stderr",
            "--window-size=1280,800",
            f"--user-data-dir={folder}",
            f"--screenshot={folder / 'shot.png'}",
            *flags,  # of two that say the same the last counts
            path.as_uri(),
        ]
        run = subprocess.run(command, capture_output=True, text=True, timeout=120, check=True)
        console = [line for line in run.stderr.splitlines() if "CONSOLE" in line]
        return console, imread(folder / "shot.png")[..., :3]

    return open_page


def test_the_console_check_would_see_an_error(browse, tmp_path):
    bad = tmp_path / "bad.html"
    bad.write_text(text_of("partial").replace("</body>", "<script>1</script></body>"), encoding="utf-8")
    assert any("Content Security Policy" in line for line in browse(bad)[0])


@pytest.mark.parametrize("name", ["slider"])
def test_a_browser_shows_the_page_without_complaint(browse, tmp_path, name):
    path = tmp_path / "report.html"
    path.write_text(text_of(name), encoding="utf-8")
    console, light = browse(path)
    assert console == []
    assert light.shape == (800, 1280, 3)
    paper = light[5, 5]
    assert 0.03 < (np.abs(light - paper).max(axis=-1) > 0.2).mean() < 0.5  # text and figures on calm ground
    assert paper.mean() > 0.9


@pytest.mark.parametrize("width", [390, 1180])
def test_nothing_sticks_out_at_the_side_even_with_all_folds_open(browse, tmp_path, width):
    page = tmp_path / "report.html"
    page.write_text(re.sub("<details ?>", "<details open>", text_of("arm")), encoding="utf-8")
    around = tmp_path / "around.html"
    around.write_text(
        f'<!doctype html><body style="margin:0"><iframe src="report.html" scrolling="no" '
        f'style="width:{width}px;height:9000px;border:0"></iframe>',
        encoding="utf-8",
    )
    _, shot = browse(around, "--window-size=1280,9000")
    margin = shot[:, width - 12 : width]
    assert (np.abs(margin - shot[5, 5]).max(axis=-1) < 0.1).all()
    assert (np.abs(shot[:, 20 : width - 20] - shot[5, 5]).max(axis=-1) > 0.2).mean() > 0.02  # the page is there


def test_the_page_is_dark_for_those_who_like_it_dark(browse, tmp_path):
    path = tmp_path / "report.html"
    path.write_text(text_of("partial"), encoding="utf-8")
    _, dark = browse(path, "--blink-settings=preferredColorScheme=0")
    assert dark[5, 5].mean() < 0.2
    assert (dark.mean(axis=-1) > 0.6).mean() > 0.01  # light text on it


def test_the_first_picture_has_the_joints_that_err_most_beside_their_floor_and_counts_the_rest(monkeypatch):
    monkeypatch.setattr(page_module, "MOST_TRACKS", 2)
    monkeypatch.setattr(page_module, "fit_figure", lambda rows: rows)
    monkeypatch.setattr(page_module, "svg", lambda figure, name, alt: alt)
    errors = {"quiet": (9.0, 9.0), "worst": (4.0, 0.5), "bad": (5.0, 1.0)}
    rows = {
        joint: {"before": before, "after": 0.5 * before, "floor": floor} for joint, (before, floor) in errors.items()
    }
    fit = {split: Score(6.0, 3.0, 2.0, 0.75, rows) for split in ("train", "heldout")}
    units = dict.fromkeys(errors, "rad")
    hero = page_module._hero(Answer("explained", (), fit=fit), units)
    assert (hero["split"], hero["left_out"]) == ("heldout", 1)
    assert re.findall(r"(\w+) \S+ rad before", str(hero["figure"])) == ["worst", "bad"]
    assert page_module._hero(Answer("explained", (), fit={"train": fit["train"]}), units)["split"] == "train"
    assert [row["joint"] for row in page_module._fit_rows(fit["train"], units)] == ["all joints", *errors]
    one = replace(fit["train"], per_joint={"bad": rows["bad"]})
    assert [row["joint"] for row in page_module._fit_rows(one, units)] == ["bad"]
    pooled = page_module._hero(Answer("explained", (), fit={"train": replace(one, per_joint={})}), {})
    assert pooled["left_out"] == 0
    assert "all joints 6.00 rad before" in str(pooled["figure"])


@pytest.mark.parametrize(("joints", "noted"), [(7, 7), (8, 3)])
def test_of_many_joints_those_that_matter_get_notes_and_findings_stand_in_their_joints_place(
    joints, noted, monkeypatch
):
    told = []
    monkeypatch.setattr(page_module, "robot_svg", lambda *given: told.append(given) or "")
    shares = [0.5, 0.3, 0.03, *[0.02] * (joints - 3)]
    places = tuple(Location(f"j{k}", "everywhere", share, (0.0, 1.0)) for k, share in enumerate(shares))
    friction = replace(arm().answer.findings[0], effect="coulomb_friction", joint="j1")
    answer = Answer("explained", (), locations=places, findings=(friction, replace(friction, joint=None)))
    page_module._robot(answer, "model")
    [(model, guilty, notes)] = told
    assert (model, list(guilty), len(notes)) == ("model", ["j1", None], noted)
    assert (notes["j0"], notes["j1"], notes["j2"]) == ("50 % of the error", "Coulomb friction", "3 % of the error")
    page_module._robot(replace(answer, verdict="nothing_missing", findings=()), "model")
    assert set(told[1][2].values()) == {""}
    assert page_module._robot(answer, None) is None


def test_what_the_motion_asks_for_is_said_among_the_grounds():
    found = Finding("backlash", "elbow", 0.4, "", {}, "", grounds={"asked": 0.34, "overruled": True})
    assert grounds_words(found) == [
        "The motion asks for its class: without, 34 % of the error comes back.",
        "The torques speak for something else, so that its law has one half at most.",
    ]
    assert grounds_words(replace(found, grounds={"asked": 0.0})) == [
        "Asked for few effects, the motion does without its class."
    ]
    assert grounds_words(replace(found, grounds={"asked": -1.0, "overruled": False})) == []  # it was not asked
