"""The tenth of the proof that runs for every change: the same cases each time, and limits that chance rarely breaks."""

from __future__ import annotations

import json

import pytest

from benchmarks.concealed.cases import prepare
from benchmarks.concealed.tenth import TABLE, at_least, at_most, chosen, limits, pooled


def numbers(**changed) -> dict:
    single = {"name": [0.9, 10], "joint": [1.0, 10], "wrong_name_over_half": [0.0, 10]}
    here = {"failed": [0.0, 20], "quiet": {"false_alarm": [0.0, 5]}, "open_set": {"both": [1.0, 3]}}
    return {**here, "single": single | changed.pop("single", {}), **changed}


@pytest.fixture(scope="module")
def table() -> dict:
    return json.loads(TABLE.read_text(encoding="utf-8"))["diagnosis"]


def test_the_cases_are_the_same_each_time_of_one_joint_and_of_every_larger_block():
    cases = chosen(10)
    assert cases == chosen(10)
    assert len(set(cases)) == len(cases) >= 12
    assert {"single", "nothing", "nuisance", "outside", "leave_one_out"} <= {block for block, _ in cases}
    session = prepare("tuning", *cases[0])
    assert session.robot.joints == 1
    assert len(chosen(5)) > 1.7 * len(cases)


def test_a_limit_is_what_chance_goes_beyond_once_in_a_hundred():
    # of ten at 0.9 each: six or fewer come with probability 0.0128, five or fewer with 0.0016
    assert at_least("named", [0.6, 10], 0.9) == ("named: 6 of 10, at least 6 expected", True)
    assert at_least("named", [0.5, 10], 0.9)[1] is False
    # of fifty at 0.02 each: four or more come with probability 0.0178, five or more with 0.0032
    assert at_most("alarms", [0.08, 50], 0.02) == ("alarms: 4 of 50, at most 4 expected", True)
    assert at_most("alarms", [0.10, 50], 0.02)[1] is False


def test_no_case_breaks_no_limit():
    assert at_least("named", [None, 0], 0.9)[1]
    assert at_most("alarms", [None, 0], 0.02)[1]


def test_rates_are_pooled_by_their_cases():
    assert pooled([[1.0, 9], [0.5, 3]]) == pytest.approx(0.875)


def test_the_tables_own_rates_break_no_limit(table):
    here = numbers(
        single={"name": table["single"]["name"], "joint": table["single"]["joint"]},
        open_set={"both": table["open_set"]["both"]},
    )
    assert [words for words, holds in limits(here, table).items() if not holds and "named" not in words] == []


@pytest.mark.parametrize(
    ("worse", "said"),
    [
        ({"failed": [0.05, 20]}, "no answer: 1 of 20"),
        ({"single": {"name": [0.3, 10]}}, "single effects named: 3 of 10"),
        ({"single": {"joint": [0.4, 10]}}, "single effects on the right joint: 4 of 10"),
        ({"single": {"wrong_name_over_half": [0.8, 10]}}, "wrong name stated over one half: 8 of 10"),
        ({"quiet": {"false_alarm": [0.4, 5]}}, "false alarms: 2 of 5"),
        ({"open_set": {"both": [0.0, 8]}}, "what no name fits said so: 0 of 8"),
    ],
)
def test_a_rate_that_falls_is_told(table, worse, said):
    assert all(limits(numbers(), table).values())
    broken = [words for words, holds in limits(numbers(**worse), table).items() if not holds]
    assert len(broken) == 1
    assert broken[0].startswith(said)
