from dataclasses import replace

import pytest
from diagnosis.sample import SAMPLES, arm, nothing_missing, partial, slider

from torchrl_athletic.diagnosis.report import terminal_summary
from torchrl_athletic.diagnosis.report.terminal import WIDTH

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


def test_parameters_come_with_interval_and_unit():
    text = terminal_summary(slider().answer)
    assert "Viscous backward  240.4 N·s/m  (95 %: 236.1 to 244.9)" in text
    assert "Coulomb forward   20.14 N  (95 %: 19.60 to 20.70)" in text


def test_the_fit_is_in_the_units_of_the_joint():
    assert "error 1.05 → 0.52 mm over 0.5 s (noise floor 0.06 mm), 54 % of the gap closed" in flat(
        terminal_summary(slider().answer)
    )
    text = terminal_summary(arm().answer)
    assert "error 217 → 27 mrad" in text
    assert "elbow     296 → 33 mrad (floor 16 mrad)" in text


def test_hinges_and_slides_are_not_pooled_into_one_number():
    mixed = replace(arm().answer, quality={"units": {"shoulder": "rad", "elbow": "m"}})
    text = terminal_summary(mixed)
    assert "217" not in text
    assert "elbow     296 → 33 mm" in text
    assert "shoulder  82.0 → 19.0 mrad" in text


def test_probabilities_of_findings_and_rivals_are_said():
    text = flat(terminal_summary(arm().answer))
    for words in ("elbow: probability 98 %. Shows everywhere in motion.", "Or link mass, forearm (12 %)"):
        assert words in text


def test_no_gap_is_claimed_closed_where_nothing_was_missing():
    assert "gap closed" not in flat(terminal_summary(nothing_missing().answer))


def test_a_partial_answer_says_so_before_anything_else():
    lines = terminal_summary(partial().answer).splitlines()
    assert lines[2].startswith("Stopped early, in the stage 'fit'")
    assert "Stopped early" not in terminal_summary(arm().answer)


def test_what_quality_control_left_out_is_counted_over_all_recordings():
    text = flat(terminal_summary(arm().answer))
    assert "45 samples (gap), 205 samples (stall)" in text  # 3 (1 + ... + 5), 5 x 41
    assert "Warning: multisine_2.csv: jitter of 0.6 ms" in text
