"""What is written is read back bit for bit, by us and by others."""

import dataclasses
import json
import os

import numpy as np
import pyarrow.parquet as pq
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays
from mcap.reader import make_reader
from mcap_ros2.decoder import DecoderFactory
from recordings.formats.foreign_files import assert_same, make_recording
from rosbags.highlevel import AnyReader
from rosbags.rosbag2 import StoragePlugin
from rosbags.rosbag2 import Writer as Rosbag2Writer
from rosbags.typesys import Stores, get_typestore

from torchrl_athletic.recordings import ColumnMap, Recording, RecordingError, read_recordings, write_recording

SUFFIXES = (".npz", ".parquet", ".mcap")
FINITE = st.floats(allow_nan=False, allow_infinity=False)  # also denormal numbers and -0.0
JSON = st.recursive(
    st.none() | st.booleans() | st.integers() | FINITE | st.text(),
    lambda inner: st.lists(inner, max_size=3) | st.dictionaries(st.text(), inner, max_size=3),
    max_leaves=5,
)
NAMES = st.text(st.characters(codec="utf-8", exclude_characters="\0"), max_size=8)


@st.composite
def recordings(draw) -> Recording:
    joints = draw(st.lists(NAMES, min_size=1, max_size=3, unique=True))
    steps = draw(st.lists(st.floats(1e-6, 1e3), min_size=1, max_size=5))
    time = draw(st.floats(-1e6, 1e6)) + np.cumsum([0.0, *steps])
    signal = arrays(np.float64, (len(time), len(joints)), elements=FINITE)
    gain = arrays(np.float64, len(joints), elements=st.floats(0, 1e6))
    command = draw(st.sampled_from(["torque_command", "position_target"]))
    gains = draw(st.just({}) if command == "torque_command" else st.fixed_dictionaries({"kp": gain, "kd": gain}))
    measured = draw(st.sampled_from(["link_side", "current_derived", None]))
    return Recording(
        time=time,
        joint_names=tuple(joints),
        position=draw(signal),
        velocity=draw(st.none() | signal),
        **{command: draw(signal)},
        **gains,
        torque_measured=draw(signal) if measured else None,
        torque_semantics=measured,
        metadata=draw(st.dictionaries(st.text(), JSON, max_size=3)),
    )


@pytest.mark.parametrize("suffix", SUFFIXES)
@settings(max_examples=40)
@given(recording=recordings())
def test_round_trip_is_exact(suffix, tmp_path_factory, recording):
    path = tmp_path_factory.mktemp("round") / f"take{suffix}"
    write_recording(recording, path)
    assert_same(read_recordings(path)[0], recording)


@pytest.mark.parametrize("suffix", SUFFIXES)
def test_a_failed_write_leaves_the_old_file_and_nothing_else(suffix, tmp_path):
    path = tmp_path / f"take{suffix}"
    write_recording(make_recording(), path)
    before = path.read_bytes()
    odd = Recording([0.0, 1.0], ("a",), [[0.0], [0.0]], torque_command=[[0.0], [0.0]], metadata={"robot": "a"})
    odd.metadata["robot"] = np.float64  # after the recording was checked
    with pytest.raises(TypeError, match="not JSON serializable"):
        write_recording(odd, path)
    assert path.read_bytes() == before
    assert os.listdir(tmp_path) == [path.name]


@pytest.mark.parametrize("suffix", SUFFIXES)
def test_a_write_that_is_interrupted_leaves_nothing_behind(suffix, tmp_path, monkeypatch):
    def interrupt(*paths):
        raise KeyboardInterrupt

    monkeypatch.setattr(os, "replace", interrupt)
    with pytest.raises(KeyboardInterrupt):
        write_recording(make_recording(), tmp_path / f"take{suffix}")
    assert os.listdir(tmp_path) == []


@pytest.mark.parametrize(("start", "received"), [(5.0, 5_000_000_000), (-5.0, 0)])
def test_mcap_is_received_when_it_is_stamped_unless_before_zero(start, received, tmp_path):
    recording = make_recording("torque_command")
    write_recording(dataclasses.replace(recording, time=recording.time + start), tmp_path / "take.mcap")
    with (tmp_path / "take.mcap").open("rb") as file:
        assert make_reader(file).get_summary().statistics.message_start_time == received
    assert read_recordings(tmp_path / "take.mcap")[0].time[0] == start


def test_an_unknown_suffix_is_refused(tmp_path):
    with pytest.raises(RecordingError, match=r"\.mat cannot be written. Known are \.npz, \.parquet, \.mcap"):
        write_recording(make_recording(), tmp_path / "take.mat")


def test_npz_is_the_canonical_format(tmp_path):
    """Names, shapes and types as the design says, without a pickle."""
    recording = make_recording()
    write_recording(recording, tmp_path / "take.npz")
    with np.load(tmp_path / "take.npz", allow_pickle=False) as file:
        assert set(file.files) == {
            "time", "joint_names", "position", "velocity", "position_target", "kp", "kd", "torque_measured",
            "torque_semantics", "metadata",
        }  # fmt: skip
        assert file["joint_names"].tolist() == ["hip", "knee"]
        assert file["position"].dtype == np.float64
        assert str(file["torque_semantics"]) == "link_side"
        assert json.loads(str(file["metadata"])) == recording.metadata


def test_parquet_is_a_table_of_plain_columns(tmp_path):
    recording = make_recording()
    write_recording(recording, tmp_path / "take.parquet")
    frame = pq.read_table(tmp_path / "take.parquet").to_pandas()
    assert list(frame)[:3] == ["time", "position/hip", "position/knee"]
    np.testing.assert_array_equal(frame["torque_measured/knee"], recording.torque_measured[:, 1])


@pytest.mark.parametrize("command", ["position_target", "torque_command"])
def test_mcap_is_read_by_its_own_reader(command, tmp_path):
    recording = make_recording(command)
    write_recording(recording, tmp_path / "take.mcap")
    with (tmp_path / "take.mcap").open("rb") as file:
        reader = make_reader(file, validate_crcs=True, decoder_factories=[DecoderFactory()])
        messages = [(c.topic, m.log_time, d) for _, c, m, d in reader.iter_decoded_messages()]
    states = [d for topic, _, d in messages if topic == "/joint_states"]
    commands = [d for topic, _, d in messages if topic == "/joint_command"]
    assert (len(states), len(commands)) == (50, 50)
    assert states[7].name == ["hip", "knee"]
    assert (states[7].header.stamp.sec, states[7].header.stamp.nanosec) == (0, 70_001_000)
    assert messages[14][1] == 70_001_000
    assert list(states[7].effort) == recording.torque_measured[7].tolist()
    filled, empty = ("position", "effort") if command == "position_target" else ("effort", "position")
    assert list(getattr(commands[7], filled)) == recording.command[7].tolist()
    assert list(getattr(commands[7], empty)) == []


def test_mcap_is_read_by_rosbags(tmp_path):
    """Its reader wants a ROS 2 bag's folder: one made by rosbags, with our file as its storage."""
    recording, bag = make_recording(), tmp_path / "bag"
    store = get_typestore(Stores.ROS2_JAZZY)
    with Rosbag2Writer(bag, version=9, storage_plugin=StoragePlugin.MCAP) as writer:
        connections = [
            writer.add_connection(t, "sensor_msgs/msg/JointState", typestore=store)
            for t in ("/joint_states", "/joint_command")
        ]
        for stamp in np.rint(recording.time * 1e9).astype(int).tolist():
            for connection in connections:
                writer.write(connection, stamp, b"")
    write_recording(recording, bag / "bag.mcap")
    with AnyReader([bag]) as reader:
        positions = [
            reader.deserialize(raw, c.msgtype).position for c, _, raw in reader.messages() if c.topic == "/joint_states"
        ]
    np.testing.assert_array_equal(positions, recording.position)


def test_times_that_ros_cannot_stamp_are_refused(tmp_path):
    close = Recording([0.0, 1e-10], ("a",), [[0.0], [0.0]], torque_command=[[0.0], [0.0]])
    with pytest.raises(RecordingError, match=r"whole nanoseconds.*Write \.npz or \.parquet"):
        write_recording(close, tmp_path / "take.mcap")


def test_a_stale_attachment_does_not_override_the_stamps(tmp_path, monkeypatch):
    """Exact times count only while they are those of the messages."""
    from torchrl_athletic.recordings.formats import mcap

    recording = make_recording("torque_command")
    shifted = Recording(recording.time + 1 / 3, ("hip", "knee"), recording.position, torque_command=recording.command)
    write_recording(shifted, tmp_path / "take.mcap")
    [take] = mcap.read_mcap(tmp_path / "take.mcap", ColumnMap())
    rounded = np.rint(shifted.time * 1e9) / 1e9
    assert take.fields["time"].tobytes() == shifted.time.tobytes() != rounded.tobytes()
    stale = mcap._with_notes(take, {}, (shifted.time + 1.0).tobytes())
    assert stale.fields["time"].tobytes() == shifted.time.tobytes()
