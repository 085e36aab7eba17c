"""Every reader, on a file of its own library, tells the same take."""

import json
from dataclasses import replace

import numpy as np
import pandas as pd
import pyarrow as pa
import pyarrow.parquet as pq
import pytest
from recordings.formats.foreign_files import WRITERS, assert_same, make_recording, write_csv, write_npz

from torchrl_athletic.recordings import Column, ColumnMap, RecordingError, read_recordings, write_recording


def what_the_file_does_not_say(recording) -> ColumnMap:
    return ColumnMap(
        joint_names=("hip", "knee"),
        kp=None if recording.kp is None else tuple(recording.kp),
        kd=None if recording.kd is None else tuple(recording.kd),
        torque_semantics="link_side",
        metadata=recording.metadata,
    )


@pytest.mark.parametrize("command", ["position_target", "torque_command"])
@pytest.mark.parametrize("kind", WRITERS)
def test_all_formats_tell_the_same_take(kind, command, tmp_path):
    written = make_recording(command)
    write, name = WRITERS[kind]
    write(written, tmp_path / name)
    [read] = read_recordings(tmp_path / name, what_the_file_does_not_say(written))
    assert_same(read, written)
    assert read.source.startswith(str(tmp_path / name))


@pytest.mark.parametrize("kind", ["npz", "hdf5", "hdf5 group", "mat", "mat struct", "mat 7.3"])
def test_a_file_that_says_everything_needs_no_column_map(kind, tmp_path):
    write, name = WRITERS[kind]
    write(make_recording(), tmp_path / name)
    assert_same(read_recordings(tmp_path / name)[0], make_recording())


@pytest.mark.parametrize("kind", WRITERS)
def test_joints_are_chosen_renamed_and_put_in_order(kind, tmp_path):
    written = make_recording("torque_command")
    write, name = WRITERS[kind]
    write(written, tmp_path / name)
    names = None if "lists" not in kind else ("hip", "knee")  # nothing in that file names its joints
    columns = ColumnMap(
        joint_names=names or ("b", "a"),
        file_joint_names=None if names else ("knee", "hip"),
        torque_semantics="link_side",
    )
    [read] = read_recordings(tmp_path / name, columns)
    order = [0, 1] if names else [1, 0]
    assert read.joint_names == (names or ("b", "a"))
    np.testing.assert_array_equal(read.position, written.position[:, order])
    np.testing.assert_array_equal(read.torque_command, written.torque_command[:, order])
    np.testing.assert_array_equal(read.torque_measured, written.torque_measured[:, order])


@pytest.mark.parametrize("kind", [kind for kind in WRITERS if "lists" not in kind])
def test_one_joint_of_two(kind, tmp_path):
    written = make_recording()
    write, name = WRITERS[kind]
    write(written, tmp_path / name)
    columns = ColumnMap(joint_names=("knee",), torque_semantics="link_side")
    if kind not in ("npz", "mat", "mat struct", "mat 7.3", "hdf5", "hdf5 group"):
        columns = ColumnMap(joint_names=("knee",), torque_semantics="link_side", kp=20.5, kd=0.1)
    [read] = read_recordings(tmp_path / name, columns)
    np.testing.assert_array_equal(read.position_target, written.position_target[:, 1:])
    assert (read.kp.tolist(), read.kd.tolist()) == ([20.5], [0.1])


@pytest.mark.parametrize("separator", [",", ";", "\t"])
def test_csv_of_pandas_with_foreign_names_and_units(separator, tmp_path):
    written = make_recording("torque_command")
    frame = pd.DataFrame(
        {
            "label": ["a, b"] * written.num_samples,
            "t_ms": written.time * 1e3,
            "q1": np.rad2deg(written.position[:, 0]),
            "q2": np.rad2deg(written.position[:, 1]),
            "u1": written.torque_command[:, 0] * 1e3,
            "u2": written.torque_command[:, 1] * 1e3,
        }
    )
    frame.to_csv(tmp_path / "log.csv", sep=separator, index=False)
    columns = ColumnMap(
        joint_names=("hip", "knee"),
        file_joint_names=("1", "2"),
        time=Column("t_ms", unit="ms"),
        position=Column("q{joint}", unit="deg"),
        torque_command=Column("u{joint}", unit="mN·m"),
    )
    [read] = read_recordings(tmp_path / "log.csv", columns)
    np.testing.assert_allclose(read.time, written.time, rtol=1e-15)
    np.testing.assert_allclose(read.position, written.position, rtol=1e-14)
    np.testing.assert_allclose(read.torque_command, written.torque_command, rtol=1e-14)
    assert read.metadata["not_read"] == ["label"]


def test_parquet_stamps_may_be_dates(tmp_path):
    written = make_recording("torque_command")
    dates = pd.Timestamp("2024-05-01") + pd.to_timedelta(np.rint(written.time * 1e9).astype(int), unit="ns")
    frame = pd.DataFrame(
        {"time": dates, "position_a": written.position[:, 0], "torque_command_a": written.position[:, 1]}
    )
    frame.to_parquet(tmp_path / "log.parquet")
    [read] = read_recordings(tmp_path / "log.parquet")
    assert read.joint_names == ("a",)
    np.testing.assert_allclose(read.time - read.time[0], written.time - written.time[0], atol=3e-7)  # float64 of 2024
    assert read.time[0] == pd.Timestamp("2024-05-01").timestamp()


def test_a_folder_is_read_by_name_in_all_its_folders(tmp_path):
    written = make_recording("torque_command")
    for name in ("b/2.csv", "b/10.csv", "a.CSV", "c/deep/x.csv"):
        (tmp_path / name).parent.mkdir(parents=True, exist_ok=True)
        write_csv(written, tmp_path / name)
    WRITERS["rosbag2"][0](written, tmp_path / "bag")
    (tmp_path / "notes.txt").write_text("not a recording")
    (tmp_path / ".hidden.csv").write_text("")
    columns = ColumnMap(ignore=("torque_measured",))
    read = read_recordings(tmp_path, columns)
    names = [recording.source.removeprefix(f"{tmp_path}/") for recording in read]
    assert names == ["a.CSV", "b/10.csv", "b/2.csv", "bag", "c/deep/x.csv"]
    both = read_recordings([tmp_path / "b" / "2.csv", str(tmp_path / "a.CSV")], columns)
    assert [recording.source.rsplit("/")[-1] for recording in both] == ["2.csv", "a.CSV"]


def test_a_folder_without_recordings_says_what_is_there(tmp_path):
    (tmp_path / "inner").mkdir()
    (tmp_path / "inner" / "log.xlsx").write_text("")
    with pytest.raises(RecordingError, match=r"Found are: inner/log\.xlsx"):
        read_recordings(tmp_path)


@pytest.mark.parametrize(("name", "advice"), [("missing.npz", "no such file"), ("log.xlsx", r"Known are \.npz")])
def test_a_path_that_cannot_be_read_says_why(name, advice, tmp_path):
    (tmp_path / "log.xlsx").write_text("")
    with pytest.raises(RecordingError, match=advice):
        read_recordings(tmp_path / name)


def test_columns_of_different_joints_are_not_guessed_at(tmp_path):
    table = {"time": [0.0, 0.1], "position_hip": [0, 1], "position_error": [0, 1], "torque_command_hip": [0, 1]}
    pd.DataFrame(table).to_csv(tmp_path / "log.csv", index=False)
    with pytest.raises(RecordingError, match="joints hip, but position for hip, error"):
        read_recordings(tmp_path / "log.csv")
    [read] = read_recordings(tmp_path / "log.csv", ColumnMap(joint_names=("hip",)))
    assert read.metadata["not_read"] == ["position_error"]


def test_unknown_names_are_listed_with_an_example_map(tmp_path):
    pd.DataFrame({"t": [0.0, 0.1], "q": [0, 1], "u": [0, 1]}).to_csv(tmp_path / "log.csv", index=False)
    with pytest.raises(
        RecordingError, match=r"no position. Found are: t, q, u\. .*column map, for example ColumnMap\(.*--columns: \{"
    ):
        read_recordings(tmp_path / "log.csv")


def test_a_rate_replaces_missing_stamps(tmp_path):
    np.savez(tmp_path / "disk.npz", th=np.arange(4.0), u=np.ones(4))
    columns = ColumnMap(
        joint_names=("disk",), rate=40.0, position="th", torque_command=Column("u", unit="V", torque_constant=2.0)
    )
    [read] = read_recordings(tmp_path / "disk.npz", columns)
    np.testing.assert_array_equal(read.time, [0.0, 0.025, 0.05, 0.075])
    np.testing.assert_array_equal(read.torque_command, 2.0 * np.ones((4, 1)))
    write_npz(make_recording(), tmp_path / "take.npz")
    with pytest.raises(RecordingError, match="leave rate out"):
        read_recordings(tmp_path / "take.npz", ColumnMap(rate=40.0))


def test_hdf5_groups_are_takes_and_none_is_lost(tmp_path):
    import h5py

    with h5py.File(tmp_path / "takes.h5", "w") as file:
        file.attrs["joint_names"] = ["hip", "knee"]
        for name, offset in (("run_1", 0.0), ("run_2", 1.0)):
            file[f"{name}/time"] = np.arange(3.0) + offset
            file[f"{name}/position"] = np.zeros((3, 2))
            file[f"{name}/torque_command"] = np.zeros((3, 2))
    first, second = read_recordings(tmp_path / "takes.h5")
    assert (first.time[0], second.time[0]) == (0.0, 1.0)
    assert second.source == f"{tmp_path}/takes.h5: run_2"
    with h5py.File(tmp_path / "takes.h5", "a") as file:
        del file["run_2/time"]
    with pytest.raises(RecordingError, match=r"run_2/position is there, but its group has no time"):
        read_recordings(tmp_path / "takes.h5")


def test_matlab_arrays_of_structs_are_takes(tmp_path):
    import scipy.io

    runs = np.zeros(2, dtype=[("time", object), ("position", object), ("torque_command", object)])
    for number in range(2):
        runs[number] = (np.arange(3.0)[:, None], np.full((3, 1), number), np.zeros((3, 1)))
    scipy.io.savemat(tmp_path / "runs.mat", {"run": runs, "joint_names": "hinge"})
    first, second = read_recordings(tmp_path / "runs.mat")
    assert (first.joint_names, second.position[0, 0]) == (("hinge",), 1.0)


@pytest.fixture
def lerobot(tmp_path):
    """A data set of three episodes of 4, 5 and 6 frames; v3 holds several in a file, v2.1 one."""

    def write(version, state_names=("hip.pos", "knee.pos"), action_names=("hip.pos", "knee.pos")):
        lengths = (4, 5, 6)
        rng = np.random.default_rng(0)
        tables = [
            pa.table(
                {
                    "observation.state": pa.array(
                        list(rng.normal(size=(n, len(state_names))).astype(np.float32)), pa.list_(pa.float32())
                    ),
                    "action": pa.array(
                        list(rng.normal(size=(n, len(action_names))).astype(np.float32)), pa.list_(pa.float32())
                    ),
                    "timestamp": np.arange(n, dtype=np.float32) / 50,
                    "episode_index": np.full(n, episode),
                    "task": ["pick"] * n,
                }
            )
            for episode, n in enumerate(lengths)
        ]
        (tmp_path / "meta").mkdir()
        (tmp_path / "data" / "chunk-000").mkdir(parents=True)
        names = {"v2.1": lambda x: {"motors": x}, "v3.0": lambda x: x}[version]
        features = {
            "observation.state": {"names": names(list(state_names))},
            "action": {"names": names(list(action_names))},
        }
        info = {"codebase_version": version, "robot_type": "so101", "fps": 50, "features": features}
        (tmp_path / "meta" / "info.json").write_text(json.dumps(info))
        if version == "v2.1":
            for episode, table in enumerate(tables):
                pq.write_table(table, tmp_path / f"data/chunk-000/episode_{episode:06d}.parquet")
        else:
            pq.write_table(pa.concat_tables(tables[:2]), tmp_path / "data/chunk-000/file-000.parquet")
            pq.write_table(tables[2], tmp_path / "data/chunk-000/file-001.parquet")
        return [
            {name: np.stack(t.column(name).to_pylist()) for name in ("observation.state", "action")} for t in tables
        ]

    return write


@pytest.mark.parametrize("version", ["v2.1", "v3.0"])
def test_lerobot_gives_one_recording_an_episode(version, lerobot, tmp_path):
    episodes = lerobot(version)
    columns = ColumnMap(
        position=Column("observation.state", unit="deg"), position_target=Column("action", unit="deg"), kp=20.0, kd=0.5
    )
    read = read_recordings(tmp_path, columns)
    assert [recording.num_samples for recording in read] == [4, 5, 6]
    assert read[0].joint_names == ("hip", "knee")
    assert read[2].metadata == {"robot": "so101", "episode": 2, "not_read": ["task"]}
    for recording, episode in zip(read, episodes, strict=True):
        np.testing.assert_allclose(recording.position, np.deg2rad(episode["observation.state"]), rtol=1e-14)
        np.testing.assert_allclose(recording.position_target, np.deg2rad(episode["action"]), rtol=1e-14)
        np.testing.assert_allclose(np.diff(recording.time), 0.02, atol=1e-7)


def test_lerobot_units_are_never_guessed(lerobot, tmp_path):
    lerobot("v3.0")
    with pytest.raises(RecordingError, match=r"does not say its units and gains.*unit='deg'"):
        read_recordings(tmp_path, ColumnMap(kp=20.0, kd=0.5))


def test_lerobot_state_with_velocities_is_split_by_name(lerobot, tmp_path):
    episodes = lerobot("v3.0", state_names=("hip.pos", "hip.vel"), action_names=("hip.pos",))
    columns = ColumnMap(
        joint_names=("hip",),
        position="observation.state/{joint}.pos",
        velocity="observation.state/{joint}.vel",
        position_target="action/{joint}.pos",
        kp=20.0,
        kd=0.5,
    )
    read = read_recordings(tmp_path, columns)
    np.testing.assert_array_equal(read[1].velocity[:, 0], episodes[1]["observation.state"][:, 1].astype(np.float32))


@pytest.mark.parametrize("key", ["kp", "kd"])
def test_different_gains_in_a_map_without_joints_are_not_given_out_in_the_order_of_the_columns(tmp_path, key):
    table = "time,q knee,q hip,sp knee,sp hip\n" + "".join(f"{k / 100},0,0,0.1,0.1\n" for k in range(3))
    (tmp_path / "log.csv").write_text(table)
    names = {"position": "q {joint}", "position_target": "sp {joint}"}
    gains = {"kp": 3.0, "kd": (1.0, 1.0)}
    [read] = read_recordings(tmp_path / "log.csv", ColumnMap(**names, **gains))
    assert (read.joint_names, read.kp.tolist(), read.kd.tolist()) == (("knee", "hip"), [3.0, 3.0], [1.0, 1.0])
    gains[key] = (40.0, 20.0)
    with pytest.raises(RecordingError, match=rf"log\.csv: .* {key} as 40, 20, .* Add joint_names .* knee, hip in the"):
        read_recordings(tmp_path / "log.csv", ColumnMap(**names, **gains))
    [read] = read_recordings(tmp_path / "log.csv", ColumnMap(joint_names=("hip", "knee"), **names, **gains))
    assert dict(zip(read.joint_names, getattr(read, key), strict=True)) == {"hip": 40.0, "knee": 20.0}


def test_different_gains_in_a_map_are_those_of_the_joints_that_a_file_names(tmp_path):
    still = np.zeros((3, 2))
    file = {"time": np.arange(3) / 100, "joint_names": ["knee", "hip"], "position": still, "position_target": still}
    np.savez(tmp_path / "log.npz", **file)
    [read] = read_recordings(tmp_path / "log.npz", ColumnMap(kp=(40.0, 20.0), kd=(2.0, 1.0)))
    assert dict(zip(read.joint_names, read.kp, strict=True)) == {"knee": 40.0, "hip": 20.0}


def test_what_a_foreign_file_calls_kp_is_no_gain_of_a_torque_command(tmp_path):
    import scipy.io

    file = {"t": np.arange(3.0), "qm": np.zeros(3), "vir": np.ones(3), "kp": 160.18}
    scipy.io.savemat(tmp_path / "emps.mat", file, oned_as="column")
    force = Column("vir", unit="V", torque_constant=35.0)
    columns = ColumnMap(joint_names=("carriage",), time="t", position="qm", torque_command=force)
    [read] = read_recordings(tmp_path / "emps.mat", columns)
    assert read.kp is None
    assert read.metadata["not_read"] == ["kp"]
    assert read.torque_command[0, 0] == 35.0


def test_emps_by_a_column_map_is_the_data_set(real_recordings):
    """The data set's own loader goes through scipy alone."""
    from torchrl_athletic.recordings.datasets import load_dataset

    force = Column("vir", unit="V", torque_constant=35.15065)
    columns = ColumnMap(joint_names=("carriage",), time="t", position="qm", torque_command=force)
    [read] = read_recordings(real_recordings / "emps" / "DATA_EMPS.mat", columns)
    [loaded] = load_dataset("emps").recordings
    np.testing.assert_array_equal(read.time, loaded.time)
    np.testing.assert_array_equal(read.position, loaded.position)
    np.testing.assert_allclose(read.torque_command, loaded.torque_command, rtol=1e-6)


def test_a_folder_of_two_link_arm_logs(real_recordings):
    columns = ColumnMap(
        joint_names=("shoulder", "elbow"),
        file_joint_names=("1", "2"),
        position="pos_meas{joint}",
        velocity="vel_meas{joint}",
        torque_command="tau_con{joint}",
        torque_measured="tau_meas{joint}",
        torque_semantics="current_derived",
    )
    logs = sorted((real_recordings / "two_link_arm" / "20220815").glob("*.csv.gz"))
    for path, read in zip(logs, read_recordings(logs, columns), strict=True):
        frame = np.genfromtxt(path, delimiter=",", names=True)
        np.testing.assert_array_equal(read.time, frame["time"])
        np.testing.assert_array_equal(read.position, np.stack([frame["pos_meas1"], frame["pos_meas2"]], 1))
        np.testing.assert_array_equal(read.torque_measured, np.stack([frame["tau_meas1"], frame["tau_meas2"]], 1))


# --- the base of a floating robot ---


def floating():
    plain = make_recording()
    turn = 0.2 * np.sin(plain.time)
    return replace(
        plain,
        base_position=np.stack([np.sin(plain.time), np.cos(plain.time), 0 * plain.time], -1),
        base_orientation=np.stack([np.cos(turn / 2), 0 * turn, np.sin(turn / 2), 0 * turn], -1),
    )


def write_base_csv(path, recording, columns):
    table = {"time": recording.time}
    for i, joint in enumerate(recording.joint_names):
        table |= {f"position/{joint}": recording.position[:, i], f"target/{joint}": recording.position_target[:, i]}
    values = np.hstack([recording.base_position, recording.base_orientation])
    table |= dict(zip(columns, values.T, strict=True))
    pd.DataFrame(table).to_csv(path, index=False)


@pytest.mark.parametrize("name", ["take.npz", "take.parquet"])
def test_what_is_written_of_a_base_is_read_back(name, tmp_path):
    write_recording(floating(), tmp_path / name)
    [read] = read_recordings(tmp_path / name)
    assert_same(read, floating())
    np.testing.assert_array_equal(read.base_position, floating().base_position)
    np.testing.assert_array_equal(read.base_orientation, floating().base_orientation)
    assert "not_read" not in read.metadata


@pytest.mark.parametrize("mark", ["/", "_"])
def test_a_csv_has_one_column_an_axis(mark, tmp_path):
    names = [f"base_position{mark}{a}" for a in "xyz"] + [f"base_orientation{mark}{a}" for a in "wxyz"]
    write_base_csv(tmp_path / "take.csv", floating(), names)
    columns = ColumnMap(position_target="target/{joint}", kp=1.0, kd=0.1)
    [read] = read_recordings(tmp_path / "take.csv", columns)
    np.testing.assert_allclose(read.base_position, floating().base_position, rtol=1e-12)
    np.testing.assert_allclose(read.base_orientation, floating().base_orientation, rtol=1e-12)


def test_a_column_map_finds_a_base_in_millimetres_with_w_last(tmp_path):
    names = ["px", "py", "pz", "qw", "qx", "qy", "qz"]
    write_base_csv(
        tmp_path / "take.csv", replace(floating(), base_position=1e3 * floating().base_position), names[:3] + names[3:]
    )
    columns = ColumnMap(
        position_target="target/{joint}",
        kp=1.0,
        kd=0.1,
        base_position=Column("p{axis}", unit="mm"),
        base_orientation=Column(("qw", "qx", "qy", "qz")),
    )
    [read] = read_recordings(tmp_path / "take.csv", columns)
    np.testing.assert_allclose(read.base_position, floating().base_position, rtol=1e-12)
    np.testing.assert_allclose(read.base_orientation, floating().base_orientation, rtol=1e-12)


def test_a_base_with_columns_missing_is_refused_by_name(tmp_path):
    names = ["base_position/x", "other", "base_position/z", *(f"base_orientation/{a}" for a in "wxyz")]
    write_base_csv(tmp_path / "take.csv", floating(), names)
    with pytest.raises(RecordingError, match=r"base_position is looked for in 'base_position/y', which is not there"):
        read_recordings(tmp_path / "take.csv", ColumnMap(position_target="target/{joint}", kp=1.0, kd=0.1))
    columns = ColumnMap(position_target="target/{joint}", kp=1.0, kd=0.1, base_position=Column(("other",)))
    with pytest.raises(RecordingError, match=r"base_position has shape \(\d+, 1\); needed is \(T, 3\), for x, y, z"):
        read_recordings(tmp_path / "take.csv", columns)
    columns = ColumnMap(position_target="target/{joint}", kp=1.0, kd=0.1, base_position=Column(("other",) * 4))
    with pytest.raises(RecordingError, match=r"base_position has shape \(\d+, 4\); needed is \(T, 3\), for x, y, z"):
        read_recordings(tmp_path / "take.csv", columns)


def test_joint_states_have_no_place_for_a_base(tmp_path):
    with pytest.raises(RecordingError, match=r"no place for base_position .* Write \.npz or \.parquet"):
        write_recording(floating(), tmp_path / "take.mcap")
