"""A recording that exists can be used; every other is refused with the file, the field and the mend."""

import json
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra import numpy as hnp

from torchrl_athletic.recordings import Recording, RecordingError

T, J = 4, 2
TORQUE = {"torque_command": np.ones((T, J))}
TARGET = {"position_target": np.ones((T, J)), "kp": [10.0, 5.0], "kd": [1.0, 0.0]}
MEASURED = {"torque_measured": np.ones((T, J)), "torque_semantics": "link_side"}


def make(command: dict[str, Any] = TORQUE, **fields: Any) -> Recording:
    given = {"time": np.arange(T) / 100, "joint_names": ("hip", "knee"), "position": np.zeros((T, J))}
    return Recording(**{**given, **command, **fields, "source": "take_7.npz"})


def refused(match: str, command: dict[str, Any] = TORQUE, **fields: Any) -> None:
    with pytest.raises(RecordingError, match=match) as caught:
        make(command, **fields)
    assert str(caught.value).startswith("take_7.npz: ")
    assert str(caught.value).rstrip().endswith(".")


def with_one(value: float, row: int = 2) -> np.ndarray:
    out = np.zeros((T, J))
    out[row, 1] = value
    return out


def test_lengths_rate_and_command():
    take = make(time=[1.0, 1.01, 1.02, 1.04])
    assert (take.num_joints, take.num_samples) == (J, T)
    assert take.duration == pytest.approx(0.04)
    assert take.rate == pytest.approx(100)
    assert take.command is take.torque_command
    target = make(TARGET)
    assert target.command is target.position_target


@pytest.mark.parametrize("kind", [int, np.uint8, np.float16, np.float32, float])
def test_every_real_number_becomes_a_double(kind):
    take = make(position=np.full((T, J), 3, dtype=kind))
    assert take.position.dtype == np.float64
    assert (take.position == 3).all()


def test_a_recording_cannot_change_and_shares_no_memory_with_what_it_was_made_of():
    position = np.zeros((T, J))
    take = make(position=position)
    position[0] = 1.0
    assert not take.position.any()
    with pytest.raises(ValueError, match="read-only"):
        take.position[0] = 1.0


def test_names_may_come_as_an_array():
    assert make(joint_names=np.array(["hip", "knee"])).joint_names == ("hip", "knee")


@pytest.mark.parametrize("names", ["ab", np.str_("ab"), b"ab"])
def test_one_text_is_not_a_list_of_letters(names):
    refused(r"joint_names is the text .*one joint a letter.*Give a sequence", joint_names=names)


@pytest.mark.parametrize(("names", "shown"), [((), r"\(\)"), (("knee", "knee"), "'knee', 'knee'")])
def test_each_joint_is_named_once(names, shown):
    refused(f"joint_names .*{shown}.* must name each joint once", joint_names=names)


@pytest.mark.parametrize(
    "values",
    [
        np.full((T, J), "0.5"),
        np.full((T, J), b"0.5"),
        np.ones((T, J), dtype=bool),
        np.ones((T, J), dtype=complex),
        np.full((T, J), None),
        np.full((T, J), np.datetime64("2026-01-01")),
    ],
    ids=lambda values: values.dtype.name,
)
def test_only_real_numbers_are_numbers(values):
    refused("position holds something that is not a number .*Convert", position=values)
    refused("torque_measured holds something that is not a number", **{**MEASURED, "torque_measured": values})


def test_stamps_that_are_text_are_refused():
    refused("time holds something that is not a number", time=["0.0", "0.1", "0.2", "0.3"])


def test_rows_of_different_lengths_are_refused():
    refused("position is no array of numbers", position=[[0.0, 0.0], [0.0], [0.0, 0.0], [0.0, 0.0]])


@pytest.mark.parametrize("time", [0.0, [0.0], [], np.zeros((T, 1))], ids=["number", "one", "none", "column"])
def test_stamps_are_a_row_of_at_least_two(time):
    refused(r"time has shape .* needed is \(T,\) with T >= 2", time=time)


@pytest.mark.parametrize("name", ["position", "velocity", "torque_command", "torque_measured"])
@pytest.mark.parametrize("shape", [(T, J + 1), (T - 1, J), (T,), (J, T)], ids=str)
def test_a_sample_has_one_value_a_joint(name, shape):
    fields = {**(MEASURED if name == "torque_measured" else {}), name: np.zeros(shape)}
    refused(rf"{name} has shape .* time \({T} samples\) and joint_names \({J} joints\) ask for \(4, 2\)", **fields)


@pytest.mark.parametrize(("name", "value"), [("position_target", np.zeros((T, 1))), ("kp", [1.0]), ("kd", 1.0)])
def test_targets_and_gains_have_one_value_a_joint(name, value):
    refused(
        rf"{name} has shape .* ask for \({'4, 2' if name == 'position_target' else '2,'}\)", TARGET, **{name: value}
    )


@pytest.mark.parametrize("value", [np.nan, np.inf, -np.inf], ids=str)
@pytest.mark.parametrize("name", ["position", "velocity", "torque_command", "torque_measured"])
def test_values_are_finite(name, value):
    fields = {**(MEASURED if name == "torque_measured" else {}), name: with_one(value)}
    refused(rf"{name} is .*{value}.* at row 2\. Cut the take there", **fields)


def test_stamps_are_finite():
    refused(r"time is \[nan\] at row 3", time=[0.0, 0.01, 0.02, np.nan])


@pytest.mark.parametrize("late", [0.01, 0.005], ids=["again", "back"])
def test_stamps_increase(late):
    refused(r"time goes from 0.010000 s to 0.0\d+ s at row 2\. Stamps must increase", time=[0.0, 0.01, late, 0.03])


def test_there_is_exactly_one_command():
    refused("neither of torque_command and position_target given", {})
    refused("both of torque_command and position_target given", {**TORQUE, **TARGET})


@pytest.mark.parametrize("missing", [("kp",), ("kd",), ("kp", "kd")], ids=" and ".join)
def test_a_target_needs_its_gains(missing):
    refused(f"needs the gains {' and '.join(missing)} ", {k: v for k, v in TARGET.items() if k not in missing})


@pytest.mark.parametrize("value", [-1.0, np.nan, np.inf], ids=str)
@pytest.mark.parametrize("name", ["kp", "kd"])
@pytest.mark.parametrize("command", [TORQUE, TARGET], ids=["torque", "target"])
def test_gains_are_finite_and_pull_towards_the_target(name, value, command):
    refused(rf"{name} is \[.*{str(value).removesuffix('.0')}.*\]\. Give finite gains", command, **{name: [1.0, value]})


@pytest.mark.parametrize("name", ["torque_measured", "torque_semantics"])
def test_a_measured_torque_and_its_meaning_go_together(name):
    refused("torque_measured and torque_semantics go together", **{name: MEASURED[name]})


def test_the_meaning_of_a_measured_torque_is_one_of_two():
    assert make(**MEASURED).torque_semantics == "link_side"
    assert make(**{**MEASURED, "torque_semantics": "current_derived"}).torque_semantics == "current_derived"
    refused("torque_semantics is 'motor'; known are", **{**MEASURED, "torque_semantics": "motor"})


@pytest.mark.parametrize(
    "value",
    [
        np.float64,
        float("nan"),
        float("inf"),
        {1: "one"},
        np.zeros(2),
        (1, 2),
        b"x",
        pytest.param({"deep": [object()]}, id="an object deep inside"),
    ],
    ids=repr,
)
def test_notes_are_what_json_can_keep(value):
    refused("metadata 'payload' is .* which JSON cannot keep", metadata={"robot": "arm", "payload": value})


def test_notes_have_texts_for_keys():
    refused("metadata 1 is 'one'", metadata={1: "one"})


def test_notes_are_a_mapping():
    refused("metadata is 'payload 2 kg'. Give a dict", metadata="payload 2 kg")


def test_good_notes_are_kept():
    notes = {"robot": "arm", "repeat": 2, "gains": [1.5, None, True], "fixture": {"table": "b"}}
    assert json.loads(json.dumps(make(metadata=notes).metadata)) == notes


def test_the_measured_torque_can_take_the_commands_place():
    driven = make(TARGET, **MEASURED).driven_by_measured_torque()
    np.testing.assert_array_equal(driven.command, MEASURED["torque_measured"])
    left = (driven.position_target, driven.kp, driven.kd, driven.torque_measured, driven.torque_semantics)
    assert left == (None,) * 5
    with pytest.raises(RecordingError, match=r"take_7.npz: there is no torque_measured"):
        make().driven_by_measured_torque()


def test_a_slice_cuts_every_channel_alike():
    take = make(TARGET, velocity=np.arange(T * J).reshape(T, J), **MEASURED)
    part = take.slice(1, 3)
    assert part.num_samples == 2
    np.testing.assert_array_equal(part.time, take.time[1:3])
    np.testing.assert_array_equal(part.velocity, [[2, 3], [4, 5]])
    np.testing.assert_array_equal(part.kp, take.kp)
    assert (part.source, part.joint_names) == (take.source, take.joint_names)
    with pytest.raises(RecordingError, match="time has shape"):
        take.slice(1, 2)


@given(
    hnp.arrays(
        st.sampled_from([np.dtype(kind) for kind in ("f8", "i4", "?", "c8", "U3", "O")]),
        hnp.array_shapes(min_dims=0, max_dims=3, max_side=T),
    )
)
def test_whatever_comes_as_position_is_taken_as_it_is_or_refused(values):
    try:
        take = make(position=values)
    except RecordingError:
        return
    assert take.position.shape == (T, J)
    np.testing.assert_array_equal(take.position, values)
