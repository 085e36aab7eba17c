from dataclasses import replace

import pytest
from diagnosis.sample import SAMPLES, arm, nothing_missing, partial, slider

from torchrl_athletic.diagnosis.report import terminal_summary
from torchrl_athletic.diagnosis.report.terminal import WIDTH
from torchrl_athletic.diagnosis.report.words import lead, would_change
from torchrl_athletic.diagnosis.result import Estimate

VERDICT_WORDS = {
    "nothing_missing": "nothing is missing",
    "explained": "explained",
    "partly_explained": "partly explained",
    "unexplained": "unexplained",
}


def flat(text: str) -> str:
    return " ".join(text.split())


@pytest.fixture(params=SAMPLES)
def answer(request):
    return SAMPLES[request.param]().answer


def test_everything_that_is_stated_is_said(answer):
    text = flat(terminal_summary(answer))
    stated = [*answer.summary, *answer.remarks]
    stated += [f.sentence for f in answer.findings]
    stated += [r.separating_experiment for f in answer.findings for r in f.rivals]
    for sentence in stated:
        assert sentence in text


def test_the_first_line_is_the_verdict_on_the_model(answer):
    assert terminal_summary(answer).splitlines()[0] == f"{answer.model}: {VERDICT_WORDS[answer.verdict]}."


def test_lines_fit_a_terminal_and_none_ends_in_blanks(answer):
    lines = terminal_summary(answer).splitlines()
    assert max(map(len, lines)) <= WIDTH
    assert [line for line in lines if line != line.rstrip()] == []


def row(text: str, name: str) -> list[str]:
    """The cells of the row of a table that starts with a name."""
    [line] = [line for line in text.splitlines() if line.strip().startswith(name)]
    return line.strip().removeprefix(name).split()


def test_parameters_come_with_interval_and_unit():
    text = terminal_summary(slider().answer)
    assert "viscous backward  240.4 N·s/m  (95 %: 236.1 to 244.9)" in text
    assert "Coulomb forward   20.14 N  (95 %: 19.60 to 20.70)" in text


@pytest.mark.parametrize("name", ["side", "take", "turnover"])
def test_a_parameter_that_names_a_case_has_no_interval(name):
    answer = arm().answer
    chosen = replace(answer.findings[0], parameters={name: Estimate(1.0, (1.0, 1.0), "1")})
    text = terminal_summary(replace(answer, findings=(chosen,)))
    assert name in text
    assert "95 %:" not in text


def test_the_answer_comes_first_and_in_at_most_three_sentences(answer):
    paragraphs = terminal_summary(answer).split("\n\n")
    told = paragraphs[1 + (not answer.complete)]
    assert flat(told) == flat(" ".join([*lead(answer), "What would change this?", would_change(answer)]))
    assert 1 <= len(lead(answer)) <= 3


def test_the_errors_stand_below_each_other_in_the_unit_of_the_joint():
    assert row(terminal_summary(slider().answer), "kept aside, carriage [mm]") == ["1.05", "0.52", "0.06", "54", "%"]
    text = terminal_summary(arm().answer)
    assert row(text, "kept aside, all joints [mrad]")[:3] == ["217", "27", "13"]
    assert row(text, "kept aside, elbow [mrad]") == ["296", "33", "16", "94", "%"]
    rows = [line for line in text.splitlines() if "[mrad]" in line]
    assert len({len(line) for line in rows}) == 1


def test_hinges_and_slides_are_not_pooled_into_one_number():
    mixed = replace(arm().answer, quality={"units": {"shoulder": "rad", "elbow": "m"}})
    text = terminal_summary(mixed)
    assert "217" not in text
    assert row(text, "kept aside, elbow [mm]")[:3] == ["296", "33", "16"]
    assert row(text, "kept aside, shoulder [mrad]")[:3] == ["82.0", "19.0", "9.0"]


def test_probabilities_of_findings_and_rivals_are_said():
    text = terminal_summary(arm().answer)
    assert row(text, "Coulomb friction, elbow") == ["98", "%"]
    assert row(text, "or link mass, forearm") == ["12", "%"]
    assert "shows everywhere in motion" in text


def test_a_planned_experiment_takes_the_place_of_the_general_advice():
    text = flat(terminal_summary(arm().answer, "Swing the elbow alone."))
    assert text.count("Record next:") == 1
    assert "Record next: Swing the elbow alone." in text


def test_no_gap_is_claimed_closed_where_nothing_was_missing():
    assert len(row(terminal_summary(nothing_missing().answer), "kept aside, elbow [mrad]")) == 3


def test_a_partial_answer_says_so_before_anything_else():
    lines = terminal_summary(partial().answer).splitlines()
    assert lines[2].startswith("Stopped early, in the stage 'simulate'")
    assert "Stopped early" not in terminal_summary(arm().answer)


def test_what_quality_control_left_out_is_counted_over_all_recordings():
    text = flat(terminal_summary(arm().answer))
    assert "45 samples (gap), 205 samples (stall)" in text  # 3 (1 + ... + 5), 5 x 41
    assert "Warning: multisine_2.csv: jitter of 0.6 ms" in text


def test_a_net_on_the_remainder_has_a_row_of_its_own():
    answer = slider().answer
    named = answer.fit["heldout"]
    learnt = replace(
        named, after=0.1e-3, per_joint={"carriage": {"before": 1.05e-3, "after": 0.1e-3, "floor": 0.06e-3}}
    )
    assert "with a UAN" not in terminal_summary(answer)
    text = terminal_summary(replace(answer, fit={**answer.fit, "heldout_uan": learnt}))
    assert row(text, "kept aside, with a UAN, carriage [mm]")[1] == "0.10"


@pytest.mark.parametrize(("law", "of_class", "said"), [(0.4, 0.9, True), (0.9, 0.99, False), (0.4, 0.4, False)])
def test_the_class_is_told_where_its_law_is_not_likely(law, of_class, said):
    answer = arm().answer
    finding = replace(answer.findings[0], probability=law, class_name="friction", class_probability=of_class)
    assert ("friction there, by whichever law" in terminal_summary(replace(answer, findings=(finding,)))) is said


def test_a_model_that_the_recordings_changed_is_told_before_anything_else():
    answer = arm().answer
    changed = replace(answer, quality={**answer.quality, "model_changes": ["0.5 kg hang on the last link."]})
    assert terminal_summary(changed).splitlines()[2] == "0.5 kg hang on the last link."


def test_readings_that_were_put_between_others_are_told():
    answer = arm().answer
    recordings = [{**r, "bridged": {"hip": 4}} for r in answer.quality["recordings"]]
    told = terminal_summary(replace(answer, quality={**answer.quality, "recordings": recordings}))
    said = f"{4 * len(recordings)} readings that repeat or leave for a moment"
    assert said in told
    assert said not in terminal_summary(answer)


def test_a_long_warning_is_indented_below_its_beginning_and_keeps_its_words_whole():
    """Names of files and of joints can be found again, whatever hyphens they have."""
    name = "-".join(["left-hand"] * 12)  # longer than a line
    answer = arm().answer
    told = replace(answer, quality={**answer.quality, "warnings": [f"{'some words ' * 15}{name} more-or-less"]})
    text = terminal_summary(told)
    at = next(k for k, line in enumerate(text.splitlines()) if line.startswith("Warning: some words"))
    below = text.splitlines()[at + 1 : at + 4]
    assert all(line.startswith("   ") for line in below)
    assert name in text
