"""One take of two joints, told by every foreign library in its own way."""

import csv
import gzip
import json
from pathlib import Path

import h5py
import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest
import scipy.io
from mcap.writer import Writer as McapWriter
from mcap_ros2.writer import Writer as McapRos2Writer
from rosbags.rosbag1 import Writer as Rosbag1Writer
from rosbags.rosbag2 import StoragePlugin
from rosbags.rosbag2 import Writer as Rosbag2Writer
from rosbags.typesys import Stores, get_typestore

from torchrl_athletic.recordings import Recording
from torchrl_athletic.recordings.formats.mcap import JOINT_STATE

JOINTS = ("hip", "knee")
NANOSECONDS = (np.arange(50) * 10_000_000 + np.arange(50) % 3 * 1_000).astype(np.int64)  # 100 Hz with a jitter of 2 µs


def make_recording(command: str = "position_target") -> Recording:
    rng = np.random.default_rng(0)
    position, velocity, other, measured = rng.normal(size=(4, len(NANOSECONDS), 2))
    gains = {"kp": np.array([30.0, 20.5]), "kd": np.array([1.0, 0.1])} if command == "position_target" else {}
    return Recording(
        time=NANOSECONDS / 1e9,
        joint_names=JOINTS,
        position=position,
        velocity=velocity,
        **{command: other},
        **gains,
        torque_measured=measured,
        torque_semantics="link_side",
        metadata={"robot": "two joints", "payload": 0.25, "repeat": [1, "ä"]},
    )


def write_csv(recording, path, opener=open):
    with opener(path, "wt", newline="") as file:
        writer = csv.writer(file)
        writer.writerow(table_of(recording))
        writer.writerows(zip(*[column.tolist() for column in table_of(recording).values()], strict=True))


def write_npz(recording, path):
    notes = {"joint_names": list(recording.joint_names), "torque_semantics": recording.torque_semantics}
    np.savez(path, **numbers_of(recording), **notes, metadata=json.dumps(dict(recording.metadata)))


def write_parquet(recording, path):
    pq.write_table(pa.table(table_of(recording)), path)


def write_parquet_of_lists(recording, path):
    columns = {n: v.tolist() for n, v in numbers_of(recording).items() if len(v) == recording.num_samples}
    pq.write_table(pa.table(columns), path, row_group_size=7)


def write_hdf5(recording, path):
    with h5py.File(path, "w") as file:
        for name, values in numbers_of(recording).items():
            file[name] = values
        file["joint_names"] = list(recording.joint_names)
        file["metadata"] = json.dumps(dict(recording.metadata))
        file.attrs["torque_semantics"] = recording.torque_semantics


def write_hdf5_group(recording, path):
    with h5py.File(path, "w") as file:
        run = file.create_group("run_1")
        for name, values in numbers_of(recording).items():
            run[name] = values
        file.attrs["joint_names"] = list(recording.joint_names)
        run.attrs["torque_semantics"] = np.bytes_(recording.torque_semantics)
        run.attrs["metadata"] = json.dumps(dict(recording.metadata))


def write_mat(recording, path):
    notes = {
        "joint_names": np.array(recording.joint_names, dtype=object),
        "torque_semantics": recording.torque_semantics,
    }
    scipy.io.savemat(path, numbers_of(recording) | notes | {"metadata": json.dumps(dict(recording.metadata))})


def write_mat_struct(recording, path):
    notes = {
        "joint_names": np.array(recording.joint_names, dtype=object),
        "torque_semantics": recording.torque_semantics,
    }
    log = numbers_of(recording) | notes | {"metadata": json.dumps(dict(recording.metadata))}
    scipy.io.savemat(path, {"log": log, "unrelated": {"comment": "none"}}, do_compression=True)


def write_mat_73(recording, path):
    """HDF5 as MATLAB lays it out: column-major, text as UTF-16 units, cells as references, a header of 512 bytes."""
    with h5py.File(path, "w", userblock_size=512) as file:

        def put(name, array, matlab_class):
            file[name] = array
            file[name].attrs["MATLAB_class"] = np.bytes_(matlab_class)

        def units(text):
            return np.frombuffer(text.encode("utf-16-le"), dtype="<u2")[:, None]

        for name, values in numbers_of(recording).items():
            put(name, np.atleast_2d(values.T) if values.ndim == 2 else values[None, :], "double")
        put("torque_semantics", units(recording.torque_semantics), "char")
        put("metadata", units(json.dumps(dict(recording.metadata), ensure_ascii=False)), "char")
        for i, joint in enumerate(recording.joint_names):
            put(f"#refs#/{i}", units(joint), "char")
        references = [[file[f"#refs#/{i}"].ref] for i in range(recording.num_joints)]
        file.create_dataset("joint_names", data=np.array(references, dtype=h5py.ref_dtype), dtype=h5py.ref_dtype)
        file["joint_names"].attrs["MATLAB_class"] = np.bytes_("cell")
    with open(path, "r+b") as file:
        file.write(b"MATLAB 7.3 MAT-file, Platform: GLNXA64".ljust(124) + b"\x00\x02IM")


def write_rosbag1(recording, path, **topics):
    store = get_typestore(Stores.ROS1_NOETIC)
    with Rosbag1Writer(path) as bag:
        _write_bag(bag, store, store.serialize_ros1, recording, **topics)


def write_rosbag2(recording, path, storage=StoragePlugin.SQLITE3, **topics):
    store = get_typestore(Stores.ROS2_JAZZY)
    with Rosbag2Writer(path, version=9, storage_plugin=storage) as bag:
        _write_bag(bag, store, store.serialize_cdr, recording, **topics)


def _write_bag(bag, store, serialize, recording, state="/joint_states", command="/joint_command"):
    types = store.types
    connections = {t: bag.add_connection(t, "sensor_msgs/msg/JointState", typestore=store) for t in (state, command)}
    ros1 = "seq" in types["std_msgs/msg/Header"].__dataclass_fields__
    for row, stamp in enumerate(NANOSECONDS.tolist()):
        time = types["builtin_interfaces/msg/Time"](sec=stamp // 10**9, nanosec=stamp % 10**9)
        header = types["std_msgs/msg/Header"](**({"seq": row} if ros1 else {}), stamp=time, frame_id="")
        for topic, content in ((state, state_of(recording, row)), (command, command_of(recording, row))):
            values = {key: np.array(value) for key, value in content.items() if key != "name"}
            message = types["sensor_msgs/msg/JointState"](header=header, name=content["name"], **values)
            bag.write(connections[topic], 1_000 + stamp, serialize(message, "sensor_msgs/msg/JointState"))


def write_mcap(recording, path):
    with path.open("wb") as file, McapRos2Writer(file) as writer:
        schema = writer.register_msgdef("sensor_msgs/msg/JointState", JOINT_STATE)
        for row, stamp in enumerate(NANOSECONDS.tolist()):
            header = {"stamp": {"sec": stamp // 10**9, "nanosec": stamp % 10**9}, "frame_id": ""}
            for topic, content in (
                ("/joint_states", state_of(recording, row)),
                ("/joint_command", command_of(recording, row)),
            ):
                writer.write_message(topic, schema, {"header": header, **content}, log_time=1_000 + stamp)


def write_mcap_json(recording, path):
    with path.open("wb") as file:
        writer = McapWriter(file)
        writer.start()
        schema = writer.register_schema("sensor_msgs/JointState", "jsonschema", b"{}")
        channels = [writer.register_channel(topic, "json", schema) for topic in ("/joint_states", "/joint_command")]
        for row, stamp in enumerate(NANOSECONDS.tolist()):
            header = {"stamp": {"sec": stamp // 10**9, "nanosec": stamp % 10**9}}
            for channel, content in zip(channels, (state_of(recording, row), command_of(recording, row)), strict=True):
                data = json.dumps({"header": header, **content}).encode()
                writer.add_message(channel, log_time=1_000 + stamp, publish_time=stamp, data=data)
        writer.finish()


def state_of(recording, row):
    """Content of a message, with the joints in turning order."""
    order = [0, 1] if row % 2 else [1, 0]
    quantities = {"position": recording.position, "velocity": recording.velocity, "effort": recording.torque_measured}
    return {"name": [JOINTS[i] for i in order]} | {k: v[row, order].tolist() for k, v in quantities.items()}


def command_of(recording, row):
    filled = "position" if recording.position_target is not None else "effort"
    empty = {"position": [], "velocity": [], "effort": []}
    return {"name": list(JOINTS), **empty, filled: recording.command[row].tolist()}


def table_of(recording):
    """Columns of plain numbers, as ``position/hip``."""
    columns = {"time": recording.time}
    for signal in ("position", "velocity", "torque_command", "position_target", "torque_measured"):
        if (values := getattr(recording, signal)) is not None:
            columns |= {f"{signal}/{joint}": values[:, i] for i, joint in enumerate(recording.joint_names)}
    return columns


def numbers_of(recording):
    """Arrays of numbers by field name."""
    names = ("time", "position", "velocity", "torque_command", "position_target", "torque_measured", "kp", "kd")
    return {name: getattr(recording, name) for name in names if getattr(recording, name) is not None}


def write_csv_gz(recording, path):
    write_csv(recording, path, gzip.open)


WRITERS = {
    "npz": (write_npz, "take.npz"),
    "csv": (write_csv, "take.csv"),
    "csv.gz": (write_csv_gz, "take.csv.gz"),
    "parquet": (write_parquet, "take.parquet"),
    "parquet of lists": (write_parquet_of_lists, "take.parquet"),
    "hdf5": (write_hdf5, "take.h5"),
    "hdf5 group": (write_hdf5_group, "take.hdf5"),
    "mat": (write_mat, "take.mat"),
    "mat struct": (write_mat_struct, "take.mat"),
    "mat 7.3": (write_mat_73, "take.mat"),
    "rosbag1": (write_rosbag1, "take.bag"),
    "rosbag2": (write_rosbag2, "take"),
    "rosbag2 of mcap": (lambda r, p: write_rosbag2(r, p, StoragePlugin.MCAP), "take"),
    "mcap": (write_mcap, "take.mcap"),
    "mcap of json": (write_mcap_json, "take.mcap"),
}


def assert_same(one: Recording, other: Recording) -> None:
    """Equal in every bit, but for the source."""
    for name in ("time", "position", "velocity", "torque_command", "position_target", "torque_measured", "kp", "kd"):
        a, b = getattr(one, name), getattr(other, name)
        assert (a is None) == (b is None), name
        if a is not None:
            assert a.shape == b.shape, name
            assert a.tobytes() == b.tobytes(), name
    assert one.joint_names == other.joint_names
    assert one.torque_semantics == other.torque_semantics
    assert dict(one.metadata) == dict(other.metadata)


@pytest.fixture
def recording() -> Recording:
    return make_recording()


@pytest.fixture(params=list(WRITERS))
def foreign(request):
    """Writes a recording with a foreign library into a folder, and says where."""
    write, name = WRITERS[request.param]

    def write_into(recording: Recording, folder: Path) -> Path:
        write(recording, folder / name)
        return folder / name

    return write_into
