"""Whatever a file does to the process that reads it, the one that asked gets an error with the file's name, in time."""

import io
import os
import signal
import subprocess
import sys
import threading
import time
import zipfile
from dataclasses import replace

import h5py
import numpy as np
import pytest
from recordings.formats.foreign_files import WRITERS, assert_same, make_recording, numbers_of

from torchrl_athletic.recordings import ColumnMap, RecordingError, read_recordings, write_recording
from torchrl_athletic.recordings.formats import child, readers

TAKE = make_recording("torque_command")
COLUMNS = ColumnMap(joint_names=("hip", "knee"), torque_semantics="link_side")


class Ask:
    """What the child calls when it is asked to read a file."""

    def __init__(self, function, *arguments):
        self.call = function, arguments

    def __reduce__(self):
        return self.call


def read_while(path, function, *arguments):
    return read_recordings(path, replace(COLUMNS, metadata={"note": Ask(function, *arguments)}))


@pytest.fixture
def path(tmp_path):
    write_recording(TAKE, tmp_path / "take.npz")
    return tmp_path / "take.npz"


def test_a_library_that_crashes_takes_no_other_file_with_it(path):
    with pytest.raises(
        RecordingError, match=r"take\.npz: the process that read it crashed \(Aborted\).*record it again"
    ):
        read_while(path, os.abort)
    assert_same(read_recordings(path)[0], TAKE)


def test_a_reader_that_never_ends_is_stopped(path, monkeypatch):
    monkeypatch.setattr(child, "SECONDS", 0.2)
    begin = time.monotonic()
    with pytest.raises(RecordingError, match=r"take\.npz: was not read within 0 s.*damaged"):
        read_while(path, time.sleep, 60)
    assert time.monotonic() - begin < 10
    monkeypatch.undo()
    assert_same(read_recordings(path)[0], TAKE)


def test_a_reader_that_asks_for_too_much_memory_is_refused_it(path):
    with pytest.raises(
        RecordingError, match=r"take\.npz: needs more than 1.5 GB of memory.*signals of the joints alone"
    ):
        read_while(path, bytearray, 3 << 30)


def write_npz(path, fields, name):
    """With an array of 8 TB by its header."""
    header = io.BytesIO()
    np.lib.format.write_array_header_1_0(header, {"descr": "<f8", "fortran_order": False, "shape": (10**12,)})
    np.savez(path, **fields)
    with zipfile.ZipFile(path, "a") as archive:
        archive.writestr(f"{name}.npy", header.getvalue())


def write_hdf5(path, fields, name):
    """With an array of 4 GB, none of which was written."""
    with h5py.File(path, "w") as file:
        for key, values in fields.items():
            file[key] = values
        file.create_dataset(name, shape=(250_000_000, 2), dtype="f8", chunks=(100_000, 2))


@pytest.mark.parametrize(("write", "suffix"), [(write_npz, "npz"), (write_hdf5, "h5")])
def test_a_bomb_in_a_signal_is_refused_and_one_in_another_field_stays_in_the_file(write, suffix, tmp_path):
    fields = {name: values for name, values in numbers_of(TAKE).items() if name != "velocity"}
    write(tmp_path / f"signal.{suffix}", fields, "velocity")
    with pytest.raises(RecordingError, match=r"needs more than 1\.\d GB of memory"):
        read_recordings(tmp_path / f"signal.{suffix}", COLUMNS)
    write(tmp_path / f"other.{suffix}", fields, "pictures")
    [read] = read_recordings(tmp_path / f"other.{suffix}", COLUMNS)
    np.testing.assert_array_equal(read.position, TAKE.position)
    assert read.metadata["not_read"] == ["pictures"]


def test_a_helper_that_was_killed_is_started_again(path):
    read_recordings(path)
    os.kill(child._helper(os.getpid()).process.pid, signal.SIGKILL)
    assert_same(read_recordings(path)[0], TAKE)


def test_threads_get_each_their_own_file(tmp_path):
    takes = [replace(TAKE, position=TAKE.position + k) for k in range(6)]
    for k, take in enumerate(takes):
        write_recording(take, tmp_path / f"{k}.npz")
    found = {}

    def read(k):
        found[k] = read_recordings(tmp_path / f"{k}.npz")[0]

    threads = [threading.Thread(target=read, args=(k,)) for k in range(6)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    for k, take in enumerate(takes):
        assert_same(found[k], take)


def test_a_forked_process_and_one_that_is_stopped_by_ctrl_c_read_on(path):
    code = f"""
import os, signal
from torchrl_athletic.recordings import ColumnMap, read_recordings
class Interrupt:
    def __reduce__(self):  # runs in the child, while the parent waits for it
        return exec, (f"import os, time; os.kill({{os.getpid()}}, {{int(signal.SIGINT)}}); time.sleep(60)",)
signal.signal(signal.SIGINT, signal.default_int_handler)  # tests in the background ignore it
read_recordings({str(path)!r})
if not os.fork():
    print("fork", read_recordings({str(path)!r})[0].num_samples, flush=True)
    os._exit(0)
print("parent", read_recordings({str(path)!r})[0].num_samples, flush=True)
os.wait()
try:
    read_recordings({str(path)!r}, ColumnMap(metadata={{"note": Interrupt()}}))
except KeyboardInterrupt:
    print("stopped", read_recordings({str(path)!r})[0].num_samples)
"""
    run = subprocess.run([sys.executable, "-P", "-c", code], capture_output=True, text=True, timeout=60)
    assert run.stderr == ""
    assert sorted(run.stdout.splitlines()) == ["fork 50", "parent 50", "stopped 50"]


def test_modules_that_lie_beside_the_recordings_are_not_run(path):
    for name in ("zipfile", "json", "torchrl_athletic", "h5py"):
        (path.parent / f"{name}.py").write_text("open('was_run', 'w')")
    code = "from torchrl_athletic.recordings import read_recordings; print(len(read_recordings('take.npz')))"
    run = subprocess.run(
        [sys.executable, "-P", "-c", code], cwd=path.parent, capture_output=True, text=True, check=True
    )
    assert run.stdout == "1\n"
    assert not (path.parent / "was_run").exists()


def test_any_exception_of_a_reader_is_told_as_the_file_s(path, monkeypatch):
    monkeypatch.setitem(readers._READERS, ".npz", lambda path, columns: {}["schema"])
    with pytest.raises(RecordingError, match=r"take\.npz: cannot be read as a recording \(KeyError: 'schema'\)"):
        readers.read_source(path, COLUMNS)


@pytest.mark.parametrize("kind", WRITERS)
def test_the_child_tells_what_the_reader_reads(kind, tmp_path):
    write, name = WRITERS[kind]
    write(TAKE, tmp_path / name)
    [told], [read] = read_recordings(tmp_path / name, COLUMNS), readers.read_source(tmp_path / name, COLUMNS)
    assert_same(told, read)
    assert told.source == read.source
