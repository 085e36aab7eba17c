"""What a diagnosis says comes back from its file as it was, or not at all."""

import json

import numpy as np
import pytest

from torchrl_athletic.diagnosis.result import Answer, Estimate, Finding, Location, Name, Rival, Score

PAIR = ((Name("torque_scale", "knee"), Name("clock_offset", None)),)
FINDING = Finding(
    effect="coulomb_friction",
    joint="knee",
    probability=0.8,
    sentence="dry",
    parameters={"coulomb": Estimate(0.3, (0.2, 0.4), "N·m")},
    regime="everywhere",
    rivals=(Rival("backlash", None, 0.1, "reverse", PAIR), Rival("stribeck", "knee", 0.05, "slow")),
    grounds={"share": 0.9},
    alternatives=PAIR,
)
ANSWER = Answer(
    verdict="partly_explained",
    summary=("one", "two"),
    findings=(FINDING,),
    locations=(Location("knee", "everywhere", 0.7, (0.6, 0.8)), Location("hip", "slow", 0.3, (0.2, 0.4))),
    fit={"train": Score(2.0, 1.0, 0.5, 0.67, {"knee": {"before": 2.0, "after": 1.0, "floor": 0.5}})},
    remarks=("a third",),
    complete=False,
    stage="simulate",
    seed=7,
)


def test_an_answer_comes_back_from_its_file_as_it_was():
    again = Answer.from_json(json.loads(json.dumps(ANSWER.to_json())))
    assert again == ANSWER
    for own in (again.summary, again.remarks, again.locations[0].ci95, again.findings[0].parameters["coulomb"].ci95):
        assert isinstance(own, tuple)
    assert hash(again.findings[0].rivals) == hash(FINDING.rivals)


def test_what_is_not_said_of_an_answer_is_that_it_is_whole_and_leaves_nothing():
    plain = Answer("nothing_missing", ())
    assert (plain.complete, plain.stage, plain.seed, plain.unexplained_share) == (True, "deliver", 0, 0.0)
    assert (plain.fit, plain.quality) == ({}, {})
    named = Finding("backlash", None, 0.5, "", {}, "everywhere")
    assert (named.energy_share, named.grounds, named.class_probability, named.law_probability) == (0.0, {}, 0.0, 0.0)


def test_arrays_and_numbers_of_numpy_are_plain_in_the_file():
    told = Answer("unexplained", (), quality={"units": (np.float64(0.5), np.arange(2), {3: np.bool_(True)})}).to_json()
    assert told["quality"] == {"units": [0.5, [0, 1], {"3": True}]}
    assert json.loads(json.dumps(told)) == told


@pytest.mark.parametrize("schema", [{}, {"schema": "torchrl_athletic/diagnosis/0"}])
def test_a_file_of_another_schema_or_of_none_is_refused(schema):
    content = {key: value for key, value in ANSWER.to_json().items() if key != "schema"}
    with pytest.raises(ValueError, match="this version reads 'torchrl_athletic/diagnosis/1'"):
        Answer.from_json({**content, **schema})
