"""Topics, stamps and joints of bags: clear, or refused."""

import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from mcap.writer import Writer
from recordings.formats.foreign_files import make_recording, write_rosbag1, write_rosbag2

from torchrl_athletic.recordings import Column, ColumnMap, RecordingError, read_recordings
from torchrl_athletic.recordings.formats.joint_state import Message, counted, take_from_messages
from torchrl_athletic.recordings.formats.take import recording_from_take

STATE, COMMAND = "/joint_states", "/joint_command"
TOPICS = {STATE: "sensor_msgs/msg/JointState", COMMAND: "sensor_msgs/msg/JointState", "/tf": "tf2_msgs/msg/TFMessage"}


def stamped(topic, seconds, received=None, **content):
    """A message stamped in its header."""
    nanoseconds = round(seconds * 1e9)
    stamp = {"sec": nanoseconds // 10**9, "nanosec": nanoseconds % 10**9}
    received = nanoseconds if received is None else round(received * 1e9)
    return Message(topic, received, {"header": {"stamp": stamp}, **content})


def state(seconds, position=0.0, name="hinge", **content):
    return stamped(STATE, seconds, name=[name], position=[position], **content)


def command(seconds, effort=0.0, name="hinge", **content):
    return stamped(COMMAND, seconds, name=[name], effort=[effort], **content)


def read(messages, columns=None, topics=TOPICS):
    columns = columns or ColumnMap()
    take = take_from_messages("bag", topics, lambda wanted: [m for m in messages if m.topic in wanted], columns)
    return recording_from_take(take, columns)


@given(
    states=st.lists(st.integers(0, 60), min_size=2, max_size=12, unique=True).map(sorted),
    commands=st.lists(st.integers(0, 60), min_size=1, max_size=12, unique=True).map(sorted),
)
def test_the_command_held_is_the_last_one_not_stamped_later(states, commands):
    """Against a loop over all commands; each command's value is its stamp."""
    messages = [state(t) for t in states] + [command(t, t) for t in commands]
    known = [t for t in states if t >= commands[0]]
    if len(known) < 2:
        with pytest.raises(RecordingError):
            read(messages)
        return
    recording = read(messages)
    assert recording.time.tolist() == known
    assert recording.torque_command[:, 0].tolist() == [max(c for c in commands if c <= t) for t in known]
    assert recording.metadata.get("before_first_command", 0) == len(states) - len(known)
    age = np.mean(recording.time - recording.torque_command[:, 0])
    assert recording.metadata.get("command_age", 0.0) == pytest.approx(age)


def test_messages_that_each_cover_some_joints_fill_a_row_together():
    messages = [
        m
        for t in (0, 1)
        for m in (state(t, t, "hip"), state(t, -t, "knee"), command(t, 5, "knee"), command(t, 4, "hip"))
    ]
    recording = read(messages)
    assert recording.joint_names == ("hip", "knee")
    assert recording.position.tolist() == [[0, 0], [1, -1]]
    assert recording.torque_command.tolist() == [[4, 5], [4, 5]]


def test_joints_that_never_share_a_stamp_are_refused_unless_chosen():
    messages = [m for t in (0, 1, 2) for m in (state(t, t, "hip"), state(t + 0.5, t, "gripper"), command(t, 1, "hip"))]
    with pytest.raises(
        RecordingError, match=r"/joint_states at the stamp 0 ns has no position of gripper.*choose joints"
    ):
        read(messages)
    assert read(messages, ColumnMap(joint_names=("hip",))).position[:, 0].tolist() == [0, 1, 2]


def test_a_command_for_other_joints_is_refused():
    messages = [state(0), state(1), command(0, name="gripper"), command(1, name="gripper")]
    with pytest.raises(RecordingError, match=r"/joint_command never mentions hinge; its joints are gripper"):
        read(messages)


def test_drivers_that_fill_nan_or_nothing_log_no_velocity():
    nothing = [state(t, velocity=[math.nan], effort=[]) for t in (0, 1)]
    recording = read([*nothing, command(0), command(1)])
    assert recording.velocity is None
    assert recording.torque_measured is None


def test_effort_of_the_state_needs_its_meaning():
    messages = [state(0, effort=[1.0]), state(1, effort=[2.0]), command(0), command(1)]
    with pytest.raises(RecordingError, match="torque_measured needs torque_semantics"):
        read(messages)
    read_as = read(messages, ColumnMap(torque_semantics="current_derived"))
    assert read_as.torque_measured[:, 0].tolist() == [1.0, 2.0]
    assert read(messages, ColumnMap(ignore=("torque_measured",))).torque_measured is None


def test_units_of_a_bag_may_be_mapped():
    messages = [state(0, 180.0), state(1, 90.0), command(0), command(1)]
    recording = read(messages, ColumnMap(position=Column("position", unit="deg")))
    np.testing.assert_allclose(recording.position[:, 0], [math.pi, math.pi / 2])


def both(t, **other):
    return stamped(COMMAND, t, name=["hinge"], position=[0.5], **other)


def test_a_command_of_position_and_effort_is_refused_unless_named():
    messages = [state(0), state(1), both(0, effort=[2.0]), both(1, effort=[3.0])]
    with pytest.raises(RecordingError, match="fills position, effort, so it is not clear what the robot followed"):
        read(messages)
    followed = read(messages, ColumnMap(torque_command="torque_command"))
    assert followed.torque_command[:, 0].tolist() == [2.0, 3.0]
    followed = read(messages, ColumnMap(position_target="position_target", kp=1.0, kd=0.0))
    assert followed.position_target[:, 0].tolist() == [0.5, 0.5]
    assert read(messages, ColumnMap(ignore=("position_target",))).torque_command[1, 0] == 3.0


def test_a_velocity_target_that_would_be_lost_is_refused():
    gains = ColumnMap(kp=1.0, kd=1.0)
    still = [state(0), state(1), both(0, velocity=[0.0]), both(1, velocity=[0.0])]
    assert read(still, gains).position_target[0, 0] == 0.5
    with pytest.raises(RecordingError, match="fills position, velocity"):
        read([*still[:3], both(1, velocity=[0.1])], gains)


def test_without_header_stamps_both_topics_go_by_the_recorder():
    messages = [m for t in (1, 2) for m in (stamped(STATE, 0, t, name=["hinge"], position=[t]), command(100 + t, t))]
    messages = [m._replace(received=round((k // 2 + 1) * 1e9)) for k, m in enumerate(messages)]
    recording = read(messages)
    assert recording.time.tolist() == [1.0, 2.0]
    assert recording.torque_command[:, 0].tolist() == [1.0, 2.0]
    assert recording.metadata["stamps"] == "received"


@pytest.mark.parametrize(
    ("messages", "advice"),
    [
        ([state(0), state(1), state(1), command(0)], "message 2 repeats position of hinge at the stamp 1000000000 ns"),
        ([state(0), state(1), command(1), command(0)], "/joint_command goes from 1000000000 ns to 0 ns at message 1"),
        ([state(1), state(0), command(0)], "time goes from 1.000000 s to 0.000000 s at row 1"),
        (
            [state(0), state(1), command(5)],
            "all of /joint_states is stamped before the first message of /joint_command",
        ),
        ([state(0), state(1)], "/joint_command holds no message"),
        ([state(0), state(1, math.nan), command(0)], r"position is \[nan\] at row 1"),
        (
            [stamped(STATE, 0, name=["a", "b"], position=[1.0]), command(0)],
            "message 0: position is .* one number a joint",
        ),
        ([stamped(STATE, 0, name=["a", "a"], position=[1.0, 2.0]), command(0)], "has a joint twice"),
        ([stamped(STATE, 0, name=[], position=[1.0, 2.0]), command(0)], "list of joint names"),
        ([stamped(STATE, 0, name="hinge", position=[1.0]), command(0)], "list of joint names"),
        ([stamped(STATE, 0, name=["a"], position="x"), command(0)], "one number a joint"),
        ([stamped(STATE, 0, name=["a"], position=5), command(0)], "one number a joint"),
        ([stamped(STATE, 0, name=["hinge"], effort=[1.0]), state(1), command(0)], "has no position of hinge"),
        ([stamped(STATE, 0, name=["hinge"], effort=[1.0]), command(0)], "/joint_states has no position"),
        ([Message(STATE, 0, {"header": {"stamp": "now"}, "name": ["a"]}), command(0)], "header.stamp is 'now'"),
        ([Message(STATE, 0, 7), command(0)], "list of joint names"),
        ([state(1e11), command(0)], "this is no time"),
    ],
)
def test_malformed_messages_are_named(messages, advice):
    with pytest.raises(RecordingError, match=advice):
        read(messages)


JOINT_STATE = "sensor_msgs/msg/JointState"


@pytest.mark.parametrize(
    ("names", "clear"),
    [
        (("/joint_states", "/joint_command"), True),
        (("/robot/state", "/robot/target"), True),
        (("/joint_states", "/joint_states_2"), False),
        (("/left/joint_states", "/right/joint_states", "/cmd"), False),
        (("/joint_states", "/cmd", "/desired"), False),
        (("/joint_command",), False),
        ((), False),
    ],
)
def test_topics_are_chosen_when_they_are_clear(names, clear):
    topics = dict.fromkeys(names, JOINT_STATE) | {"/tf": "tf2_msgs/msg/TFMessage"}
    messages = [m._replace(topic=t) for t, m in zip(names, (state(0), command(0)), strict=False)]
    messages += [m._replace(topic=t) for t, m in zip(names, (state(1), command(1)), strict=False)]
    if clear:
        assert read(messages, topics=topics).num_samples == 2
    else:
        with pytest.raises(
            RecordingError, match=r"not clear which.*Topics are .*/tf \(tf2_msgs/msg/TFMessage\).*state_topic="
        ):
            read(messages, topics=topics)


ALONE = {STATE: JOINT_STATE, "/tf": "tf2_msgs/msg/TFMessage"}


def test_of_states_alone_the_effort_drives_if_the_column_map_says_so():
    messages = [state(t, effort=[10.0 * t], velocity=[1.0]) for t in range(3)]
    with pytest.raises(RecordingError, match=r"what the robot was told.*/tf .*command_topic.*--drive measured"):
        read(messages, topics=ALONE)
    recording = read(messages, ColumnMap(measured_drives=True), ALONE)
    assert recording.torque_command[:, 0].tolist() == [0.0, 10.0, 20.0]
    assert recording.velocity[:, 0].tolist() == [1.0, 1.0, 1.0]
    assert recording.torque_measured is None
    amperes = Column("torque_measured", unit="A", torque_constant=2.0)
    recording = read(messages, ColumnMap(measured_drives=True, torque_measured=amperes), ALONE)
    assert recording.torque_command[:, 0].tolist() == [0.0, 20.0, 40.0]


def test_states_without_effort_or_command_are_refused():
    with pytest.raises(
        RecordingError, match=r"what the robot was told.*command_topic.*record the effort in /joint_states"
    ):
        read([state(0), state(1)], topics=ALONE)


def test_where_the_effort_drives_no_command_has_to_be_clear_but_a_clear_one_is_read():
    messages = [state(t, effort=[10.0 * t]) for t in range(3)] + [command(0, 5.0)]
    driven = ColumnMap(measured_drives=True)
    more = TOPICS | {"/cmd_other": JOINT_STATE}
    assert read(messages, driven, more).torque_command[:, 0].tolist() == [0.0, 10.0, 20.0]
    with pytest.raises(RecordingError, match="not clear which"):
        read(messages, topics=more)
    both = read(messages, ColumnMap(measured_drives=True, torque_semantics="link_side"))
    assert both.torque_command[:, 0].tolist() == [5.0, 5.0, 5.0]
    assert both.torque_measured[:, 0].tolist() == [0.0, 10.0, 20.0]


def test_a_topic_that_is_not_there_is_named():
    with pytest.raises(RecordingError, match=r"no topic /joints. Topics are /joint_command"):
        read([], ColumnMap(state_topic="/joints"))


@pytest.mark.parametrize("write", [write_rosbag1, write_rosbag2])
def test_topics_of_a_bag_are_named_in_the_column_map(write, tmp_path):
    recording, path = make_recording("torque_command"), tmp_path / ("take.bag" if write is write_rosbag1 else "take")
    write(recording, path, state="/a", command="/b")
    with pytest.raises(RecordingError, match=r"/a \(sensor_msgs/msg/JointState\), /b"):
        read_recordings(path)
    columns = ColumnMap(("hip", "knee"), state_topic="/a", command_topic="/b", torque_semantics="link_side")
    np.testing.assert_array_equal(read_recordings(path, columns)[0].torque_command, recording.torque_command)


def test_messages_missing_from_a_topic_are_noticed():
    with pytest.raises(RecordingError, match="/joint_states has 1 messages, but the file announces 2"):
        list(counted(iter([state(0)]), {STATE: 2}, "bag"))


def test_json_messages_that_are_no_objects_are_refused(tmp_path):
    with (tmp_path / "take.mcap").open("wb") as file:
        writer = Writer(file)
        writer.start()
        for topic in (STATE, COMMAND):
            channel = writer.register_channel(topic, "json", writer.register_schema("JointState", "jsonschema", b"{}"))
            writer.add_message(channel, log_time=0, publish_time=0, data=b"[1, 2]")
        writer.finish()
    with pytest.raises(RecordingError, match="a JSON message is the JSON of a list"):
        read_recordings(tmp_path / "take.mcap", ColumnMap(state_topic=STATE, command_topic=COMMAND))
