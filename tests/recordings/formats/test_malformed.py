"""Any malformed file gets a RecordingError or the right result: never a wrong one, never another exception."""

import gzip
import io
import json
import os
import pickle
import sys
import zipfile
from contextlib import nullcontext

import h5py
import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest
import scipy.io
from hypothesis import given, settings
from hypothesis import strategies as st
from mcap.writer import Writer as McapWriter
from recordings.formats.foreign_files import WRITERS, make_recording, numbers_of, table_of

from torchrl_athletic.recordings import ColumnMap, RecordingError, read_recordings, write_recording
from torchrl_athletic.recordings.formats.readers import read_source

TAKE = make_recording("torque_command")
COLUMNS = ColumnMap(joint_names=("hip", "knee"), torque_semantics="link_side")
ONE_FILE = [kind for kind in WRITERS if not kind.startswith("rosbag2")]


def read_or_refuse(path, columns=COLUMNS):
    """The recording, or None when it is refused; another exception passes."""
    try:
        [recording] = read_recordings(path, columns)
    except RecordingError as error:
        refusal = str(error)
    else:
        return recording
    assert refusal.startswith(str(path))
    return None


def assert_part_of_the_take(recording):
    """Every row is a row of the take."""
    rows = np.searchsorted(TAKE.time, recording.time)
    for name in ("time", "position", "velocity", "torque_command", "torque_measured"):
        if getattr(recording, name) is not None:
            np.testing.assert_array_equal(getattr(recording, name), getattr(TAKE, name)[rows])


@pytest.fixture(scope="module")
def foreign_bytes(tmp_path_factory):
    folder = tmp_path_factory.mktemp("foreign")
    found = {}
    for kind in ONE_FILE:
        write, name = WRITERS[kind]
        (folder / kind.replace(" ", "_")).mkdir()
        path = folder / kind.replace(" ", "_") / name
        write(TAKE, path)
        found[kind] = (path.read_bytes(), name)
    return found


@pytest.mark.parametrize("kind", ONE_FILE)
@settings(max_examples=15)
@given(fraction=st.floats(0, 1, exclude_max=True))
def test_a_cut_off_file(kind, foreign_bytes, tmp_path_factory, fraction):
    raw, name = foreign_bytes[kind]
    path = tmp_path_factory.mktemp("cut") / name
    path.write_bytes(raw[: int(fraction * len(raw))])
    if (recording := read_or_refuse(path)) is not None:
        assert_part_of_the_take(recording)
        assert kind in ("csv", "mat")  # at the end of a line, of a variable; all others know how long they are


def test_a_mat_file_cut_off_within_a_variable_is_refused(foreign_bytes, tmp_path):
    """Even within its last bytes, which hold padding and metadata that scipy does without."""
    raw, name = foreign_bytes["mat"]
    path = tmp_path / name
    for cut in range(len(raw) - 8, len(raw)):
        path.write_bytes(raw[:cut])
        with pytest.raises(RecordingError, match="cut off"):
            read_recordings(path, COLUMNS)


@pytest.mark.parametrize("kind", [".npz", ".parquet", ".mcap"])
@settings(max_examples=40)
@given(data=st.data())
def test_a_flipped_byte_in_a_file_of_ours(kind, tmp_path_factory, data):
    """Ours are checksummed wherever a number stands, so that damage is noticed or harmless."""
    path = tmp_path_factory.mktemp("flip") / f"take{kind}"
    write_recording(TAKE, path)
    raw = bytearray(path.read_bytes())
    raw[data.draw(st.integers(0, len(raw) - 1))] ^= data.draw(st.integers(1, 255))
    path.write_bytes(raw)
    if (recording := read_or_refuse(path)) is not None:
        assert_part_of_the_take(recording)


@pytest.mark.parametrize("suffix", [".npz", ".csv", ".csv.gz", ".parquet", ".h5", ".mat", ".bag", ".db3", ".mcap"])
@settings(max_examples=15)
@given(raw=st.binary(max_size=300))
def test_arbitrary_bytes(suffix, tmp_path_factory, raw):
    path = tmp_path_factory.mktemp("bytes") / f"take{suffix}"
    path.write_bytes(raw)
    assert read_or_refuse(path) is None


@pytest.mark.parametrize("suffix", [".npz", ".parquet", ".h5", ".mat", ".bag", ".db3", ".mcap"])
def test_a_file_of_another_kind(suffix, foreign_bytes, tmp_path):
    path = tmp_path / f"take{suffix}"
    path.write_bytes(foreign_bytes["csv"][0])
    with pytest.raises(RecordingError, match="of another kind than its suffix says"):
        read_recordings(path)


def write_arrays(fields, path):
    """Any arrays, in the format of the suffix."""
    if path.suffix == ".npz":
        np.savez(path, **fields)
    elif path.suffix == ".mat":
        scipy.io.savemat(path, fields)
    else:
        with h5py.File(path, "w") as file:
            for name, values in fields.items():
                file[name] = values.tolist() if values.dtype.kind in "UO" else values


DAMAGES = {
    "missing": lambda values, draw: None,
    "rows missing": lambda values, draw: values[: draw(st.integers(0, len(values) - 1))],
    "joints missing": lambda values, draw: values[..., :1],
    "transposed": lambda values, draw: values.T,
    "another axis": lambda values, draw: values[..., None],
    "nan": lambda values, draw: spoilt(values, draw, np.nan),
    "inf": lambda values, draw: spoilt(values, draw, np.inf),
    "text": lambda values, draw: values.astype(str),
    "complex": lambda values, draw: values * 1j,
    "bool": lambda values, draw: values > 0,
    "one number": lambda values, draw: np.array(1.0),
    "empty": lambda values, draw: np.empty((0, 2)),
}
"""A field that could be mistaken for a good one."""


def spoilt(values, draw, bad):
    values = values.copy()
    values.ravel()[draw(st.integers(0, values.size - 1))] = bad
    return values


@pytest.mark.parametrize("suffix", [".npz", ".mat", ".h5"])
@pytest.mark.parametrize("damage", DAMAGES)
@settings(max_examples=8)
@given(data=st.data())
def test_a_damaged_field(suffix, damage, tmp_path_factory, data):
    fields = {name: np.array(values) for name, values in numbers_of(TAKE).items()}
    name = data.draw(st.sampled_from(list(fields)))
    damaged = DAMAGES[damage](fields[name], data.draw)
    fields = {**fields, name: damaged} if damaged is not None else {n: v for n, v in fields.items() if n != name}
    path = tmp_path_factory.mktemp("damaged") / f"take{suffix}"
    write_arrays(fields, path)
    columns = COLUMNS if "torque_measured" in fields else ColumnMap(joint_names=("hip", "knee"))
    recording = read_or_refuse(path, columns)
    harmless = damage == "missing" and name in ("velocity", "torque_measured")
    harmless |= damage in ("transposed",) and name == "time"  # a vector has no other side
    harmless |= damage == "joints missing" and name == "time" and False
    harmless |= (
        damage == "another axis" and suffix == ".mat"
    )  # MATLAB's (T, 1) is a vector; (T, 2, 1) loses its last axis
    assert (recording is not None) == harmless
    if recording is not None:
        assert_part_of_the_take(recording)


@pytest.mark.parametrize("shape", [(), (50, 2), (50, 1), (49,), (0,)])
@pytest.mark.parametrize("joint", ["hip", "knee"])
def test_a_column_of_another_shape(shape, joint, tmp_path):
    np.savez(tmp_path / "take.npz", **(table_of(TAKE) | {f"position/{joint}": np.zeros(shape)}))
    with pytest.raises(RecordingError, match=r"position has columns of different shapes \(position/hip \("):
        read_recordings(tmp_path / "take.npz", COLUMNS)


@pytest.mark.parametrize("kind", ["npz", "csv", "parquet"])
@settings(max_examples=15)
@given(order=st.permutations(range(len(TAKE.time))))
def test_shuffled_rows(kind, tmp_path_factory, order):
    write, name = WRITERS[kind]
    path = tmp_path_factory.mktemp("shuffled") / name
    shuffled = type("Fields", (), {**vars(TAKE), "num_samples": 50, "num_joints": 2})
    for field in ("time", "position", "velocity", "torque_command", "torque_measured"):
        setattr(shuffled, field, getattr(TAKE, field)[list(order)])
    write(shuffled, path)
    recording = read_or_refuse(path)
    assert (recording is not None) == (list(order) == sorted(order))


@pytest.mark.parametrize(
    ("text", "advice"),
    [
        ("", "is empty"),
        ("\n\n", "is empty"),
        ("time,position_a,torque_command_a\n", r"time has shape \(0,\)"),
        ("time,position_a,torque_command_a\n0,1,2\n1,1,2", "the last line has no end"),
        ("time,position_a,torque_command_a\n0,1,2\n1,1\n", "line 3 has 2 cells, but the header names 3"),
        ("time,position_a,torque_command_a\n0,1,2\n1,,2\n", "position_a is the text '' at row 1"),
        ("time;position_a;torque_command_a\n0;0,5;2\n1;1;2\n", "position_a is the text '0,5' at row 0.* with a point"),
        ("time,position_a,torque_command_a\n0,1_0,2\n1,1,2\n", "text '1_0' at row 0"),
        ("time,position_a,torque_command_a\n0,0x10,2\n1,1,2\n", "text '0x10' at row 0"),
        ("time,position_a,torque_command_a\n0,nan,2\n1,1,2\n", r"position is \[nan\] at row 0"),
        ("time,position_a,torque_command_a\n0,1e999,2\n1,1,2\n", r"position is \[inf\] at row 0"),
        ("time,position_a,torque_command_a\n0,1,2\n0,1,2\n", "time goes from 0.000000 s to 0.000000 s at row 1"),
        ("time,time,position_a\n0,1,2\n", "a name of its own"),
        ("0,1,2\n1,1,2\n", "Put a header"),
        ("time,position_a\n0,1\n1,1\n", "neither of torque_command and position_target"),
        ("time,position_a,position/a,torque_command_a\n0,1,2,3\n1,1,1,1\n", "position is there as"),
        ("time,position_a,position_target_a\n0,1,2\n1,1,2\n", "needs the gains kp and kd"),
        ('time,position_a,torque_command_a\n0,"[1, 2]",2\n1,1,2\n', r"text '\[1, 2\]' at row 0"),
    ],
)
def test_csv_mistakes_are_named(text, advice, tmp_path):
    (tmp_path / "log.csv").write_text(text)
    with pytest.raises(RecordingError, match=advice) as caught:
        read_recordings(tmp_path / "log.csv")
    assert str(caught.value).startswith(str(tmp_path / "log.csv"))


def test_csv_in_another_encoding_or_gzip_is_refused(tmp_path):
    (tmp_path / "log.csv").write_bytes("time,größe\n0,1\n".encode("latin-1"))
    with pytest.raises(RecordingError, match="UTF-8"):
        read_recordings(tmp_path / "log.csv")
    (tmp_path / "log.csv.gz").write_bytes(gzip.compress(b"time,position_a\n" * 100)[:-9])
    with pytest.raises(RecordingError, match="cut off"):
        read_recordings(tmp_path / "log.csv.gz")


def test_a_long_cell_of_a_csv_costs_no_more_than_itself(tmp_path):
    """Beside 20,000 empty ones, which would be made as long as it: 7.5 GB."""
    rows = "".join(f"{row},0,0,\n" for row in range(20_000))
    (tmp_path / "log.csv").write_text(f"time,position_a,torque_command_a,note\n{rows}20000,0,0,{'x' * 100_000}\n")
    [recording] = read_recordings(tmp_path / "log.csv")
    assert recording.num_samples == 20_001
    with pytest.raises(RecordingError, match="note is the text '' at row 0"):
        read_recordings(tmp_path / "log.csv", ColumnMap(position="note", joint_names=("a",)))


def test_a_message_is_no_longer_than_somebody_reads(tmp_path):
    np.savez(tmp_path / "take.npz", **{f"field_{k}": np.zeros(1) for k in range(1000)})
    with pytest.raises(RecordingError, match=r"no position\..* \[\.\.\.\] .*in a column map, for example") as caught:
        read_recordings(tmp_path / "take.npz")
    assert len(str(caught.value)) < 3100


def link_to_another_file(file, outside):
    file["velocity"] = h5py.ExternalLink(outside.name, "velocity")


def store_in_another_file(file, outside):
    file.create_dataset("velocity", shape=(50, 2), dtype="f8", external=[(outside.name, 0, 800)])


def map_another_file(file, outside):
    layout = h5py.VirtualLayout(shape=(50, 2), dtype="f8")
    layout[:] = h5py.VirtualSource(outside.name, "velocity", shape=(50, 2))
    file.create_virtual_dataset("velocity", layout)


@pytest.mark.parametrize("elsewhere", [link_to_another_file, store_in_another_file, map_another_file])
def test_hdf5_reads_no_other_file(elsewhere, tmp_path):
    outside = tmp_path / "secret.h5"
    with h5py.File(outside, "w") as file:
        file["velocity"] = TAKE.velocity
    with h5py.File(tmp_path / "take.h5", "w") as file:
        write_fields = {name: values for name, values in numbers_of(TAKE).items() if name != "velocity"}
        for name, values in write_fields.items():
            file[name] = values
        elsewhere(file, outside)
    with pytest.raises(RecordingError, match=r"take\.h5: /?velocity is kept in another file \(secret\.h5\)"):
        read_recordings(tmp_path / "take.h5", COLUMNS)


@pytest.mark.parametrize("make", [os.mkfifo, lambda path: path.symlink_to("/dev/zero")], ids=["pipe", "device"])
@pytest.mark.parametrize("where", ["take.npz", "data/take.parquet"])
def test_what_has_no_end_is_no_file(make, where, tmp_path):
    (tmp_path / "data").mkdir()
    (tmp_path / "meta").mkdir()
    if where.startswith("data"):
        (tmp_path / "meta/info.json").write_text("{}")
    make(tmp_path / where)
    for path in {tmp_path, tmp_path / where}:
        with pytest.raises(RecordingError, match="is a pipe, a device, or a link to something that is not there"):
            read_recordings(path, COLUMNS)


class Bomb:
    """Leaves a mark when it is unpickled."""

    def __reduce__(self):
        return (exec, ("import sys; sys.bomb_went_off = True",))


@pytest.mark.parametrize("suffix", [".npz", ".npz of pickle", ".mat", ".h5", ".csv"])
def test_nothing_is_unpickled(suffix, tmp_path):
    path = tmp_path / f"take{suffix.split()[0]}"
    if suffix == ".npz":
        np.savez(path, **numbers_of(TAKE), joint_names=np.array([Bomb(), Bomb()], dtype=object), allow_pickle=True)
    else:
        path.write_bytes(pickle.dumps(Bomb()))
    with pytest.raises(RecordingError, match=str(path)):
        read_recordings(path)
    assert not hasattr(sys, "bomb_went_off")


def test_an_array_of_objects_is_named(tmp_path):
    np.savez(tmp_path / "take.npz", **(numbers_of(TAKE) | {"velocity": np.array([None, 1])}), allow_pickle=True)
    with pytest.raises(RecordingError, match=r"take.npz: velocity: cannot be read .*allow_pickle=False"):
        read_recordings(tmp_path / "take.npz", COLUMNS)


def test_an_npz_with_a_bare_array_is_refused(tmp_path):
    np.save(tmp_path / "take.npy", np.zeros(3))
    (tmp_path / "take.npy").rename(tmp_path / "take.npz")
    with pytest.raises(RecordingError, match="one bare array"):
        read_recordings(tmp_path / "take.npz")


def test_a_zip_with_other_things_is_refused(tmp_path):
    with zipfile.ZipFile(tmp_path / "take.npz", "w") as archive:
        archive.writestr("time", "0 1 2")
    with pytest.raises(RecordingError, match=r"take\.npz"):
        read_recordings(tmp_path / "take.npz", COLUMNS)


@pytest.mark.parametrize(
    ("notes", "advice"),
    [
        ({"metadata": "{"}, "metadata is not JSON"),
        ({"metadata": "[1]"}, "needed is an object"),
        ({"metadata": '{"x": NaN}'}, "metadata is not JSON"),
        ({"metadata": 3.0}, "needed is one text"),
        ({"metadata": "[" * 100_000}, "metadata is not JSON"),
        ({"torque_semantics": "guessed"}, "torque_semantics is 'guessed'"),
        ({"joint_names": [1.0, 2.0]}, "joint_names is of type float64"),
        ({"joint_names": ["hip", "hip"]}, "must name each joint once"),
        ({"joint_names": ["hip"]}, "One column a joint"),
        ({"joint_names": ["hip", "knee", "foot"]}, "One column a joint"),
        ({"joint_names": [["hip", "knee"]]}, "one text a joint"),
        ({"kp": [1.0]}, "kp has shape"),
        ({"kp": "high"}, "kp is the text 'high'"),
        ({"kp": [1.0, -1.0], "kd": [1.0, 1.0]}, "One|negative|kp"),
    ],
)
def test_malformed_notes_are_named(notes, advice, tmp_path):
    good = {"joint_names": ["hip", "knee"], "torque_semantics": "link_side", "metadata": "{}"}
    position_target = {"position_target": TAKE.torque_command, "kd": np.ones(2), "kp": np.ones(2)}
    fields = {n: v for n, v in numbers_of(TAKE).items() if n != "torque_command"} | position_target
    np.savez(tmp_path / "take.npz", **(fields | good | notes))
    with pytest.raises(RecordingError, match=advice):
        read_recordings(tmp_path / "take.npz")


@pytest.mark.parametrize(
    ("column", "advice"),
    [
        (pa.array([[1.0], [1.0, 2.0]]), "plain numbers"),
        (pa.array([[1.0], None]), "plain numbers"),
        (pa.array([1.0, None]), r"position is \[nan\] at row 1"),
        (pa.array(["1", "2"]), "plain numbers"),
        (pa.array([True, False]), "plain numbers"),
        (pa.array([{"x": 1}, {"x": 2}]), "plain numbers"),
        (pa.array([[1.0, 2.0], [1.0, 2.0]]), "One column a joint"),
    ],
)
def test_parquet_columns_that_are_no_signal_are_named(column, advice, tmp_path):
    table = pa.table({"time": [0.0, 1.0], "position": column, "torque_command": [0.0, 1.0]})
    pq.write_table(table, tmp_path / "take.parquet")
    with pytest.raises(RecordingError, match=advice):
        read_recordings(tmp_path / "take.parquet", ColumnMap(joint_names=("a",)))


@pytest.mark.parametrize(
    "notes", [b"\xff", b"{", b"[]", b'{"kp": [[1], [1, 2]]}', b'{"metadata": 3}', b'{"joint_names": 3}']
)
def test_malformed_notes_of_a_parquet_file_are_named(notes, tmp_path):
    table = pa.table(table_of(TAKE)).replace_schema_metadata({b"torchrl_athletic": notes})
    pq.write_table(table, tmp_path / "take.parquet")
    assert read_or_refuse(tmp_path / "take.parquet") is None or notes == b'{"joint_names": 3}'


@pytest.mark.parametrize(
    ("damage", "advice"),
    [
        (lambda folder: (folder / "meta/info.json").write_text("{"), "info.json is not JSON"),
        (lambda folder: (folder / "data/file-000.parquet").unlink(), "no data/.*parquet"),
        (lambda folder: (folder / "data/file-000.parquet").write_bytes(b"PAR1"), "cannot be read as a Parquet file"),
        (
            lambda folder: (folder / "meta/info.json").write_text('{"features": {"action": {"names": [1]}}}'),
            "names of action",
        ),
    ],
)
def test_a_damaged_lerobot_data_set_is_named(damage, advice, tmp_path):
    (tmp_path / "meta").mkdir()
    (tmp_path / "data").mkdir()
    (tmp_path / "meta/info.json").write_text(json.dumps({"features": {}}))
    columns = {
        "observation.state": [[0.0], [0.0]],
        "action": [[0.0], [0.0]],
        "timestamp": [0.0, 0.1],
        "episode_index": [0, 0],
    }
    pq.write_table(pa.table(columns), tmp_path / "data/file-000.parquet")
    mapped = ColumnMap(joint_names=("a",), position="observation.state", position_target="action", kp=1.0, kd=1.0)
    assert read_recordings(tmp_path, mapped)[0].num_samples == 2
    damage(tmp_path)
    with pytest.raises(RecordingError, match=advice):
        read_recordings(tmp_path, mapped)


@pytest.mark.parametrize(("levels", "fine"), [(99, True), (100, False), (900, False)])
def test_metadata_is_as_deep_as_any_process_can_read(levels, fine, tmp_path):
    """A hundred levels with the metadata itself; of 900 the process that asks may have no stack left to take them."""
    deep = "[" * levels + "]" * levels
    np.savez(tmp_path / "take.npz", **table_of(TAKE), metadata=f'{{"a": {deep}}}')
    (tmp_path / "set/meta").mkdir(parents=True)
    (tmp_path / "set/data").mkdir()
    (tmp_path / "set/meta/info.json").write_text(f'{{"robot_type": {deep}}}')
    columns = {"state": [0.0, 0.0], "action": [0.0, 0.0], "timestamp": [0.0, 0.1], "episode_index": [0, 0]}
    pq.write_table(pa.table(columns), tmp_path / "set/data/file-000.parquet")
    mapped = ColumnMap(joint_names=("a",), position="state", position_target="action", kp=1.0, kd=1.0)
    for path, known in ((tmp_path / "take.npz", COLUMNS), (tmp_path / "set", mapped)):
        with nullcontext() if fine else pytest.raises(RecordingError, match="over 100 levels deep"):
            assert len(read_recordings(path, known)) == 1


def test_a_json_message_that_is_none_is_told_with_its_file(tmp_path):
    path = tmp_path / "take.mcap"
    with path.open("wb") as file:
        writer = McapWriter(file)
        writer.start()
        for topic in ("/joint_states", "/joint_command"):
            schema = writer.register_schema("sensor_msgs/JointState", "jsonschema", b"{}")
            writer.add_message(writer.register_channel(topic, "json", schema), 0, b"{", 0)
        writer.finish()
    with pytest.raises(RecordingError, match=rf"{path}: a JSON message is not JSON"):
        read_recordings(path)


@pytest.mark.parametrize("fraction", [0.0, 0.3, 0.6, 0.99])
def test_a_cut_off_ros2_bag(fraction, tmp_path):
    WRITERS["rosbag2"][0](TAKE, tmp_path / "bag")
    [database] = (tmp_path / "bag").glob("*.db3")
    bare = read_recordings(database, COLUMNS)[0]
    np.testing.assert_array_equal(bare.position, TAKE.position)
    raw = database.read_bytes()
    database.write_bytes(raw[: int(fraction * len(raw))])
    assert read_or_refuse(tmp_path / "bag") is None
    assert read_or_refuse(database) is None


def test_a_missing_library_says_how_to_install_it(tmp_path, monkeypatch):
    (tmp_path / "take.h5").write_bytes(b"")
    monkeypatch.setitem(sys.modules, "h5py", None)
    with pytest.raises(ImportError, match=r"'h5py'.*pip install torchrl-athletic\[formats\]"):
        read_source(tmp_path / "take.h5", COLUMNS)


def test_no_columns_are_dropped_unseen(tmp_path):
    buffer = io.BytesIO()
    np.savez(buffer, **numbers_of(TAKE), joint_names=["hip", "knee"], torque_semantics="link_side", velocty=np.zeros(3))
    (tmp_path / "take.npz").write_bytes(buffer.getvalue())
    assert read_recordings(tmp_path / "take.npz")[0].metadata == {"not_read": ["velocty"]}
