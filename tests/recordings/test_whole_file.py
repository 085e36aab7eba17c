"""A file is there as a whole or not at all, and a disk that is full says what it was full for."""

import resource
import subprocess
import sys
from contextlib import contextmanager

import numpy as np
import pytest

from torchrl_athletic.recordings import Recording, write_recording
from torchrl_athletic.recordings.whole_file import UNFINISHED, whole_file


@contextmanager
def full_disk():
    """No file of this process may grow beyond 1 kB, as if the disk were full; not pytest's own output either."""
    limits = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (1000, limits[1]))
    try:
        yield
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, limits)


def test_a_full_disk_names_the_file_and_leaves_the_old_one(tmp_path):
    time_ = np.arange(100.0)
    noise = np.random.default_rng(0).normal(size=(100, 1))
    (tmp_path / "take.npz").write_text("old")
    with pytest.raises(OSError, match=r"take\.npz'") as caught, full_disk():
        write_recording(Recording(time_, ("hip",), noise, torque_command=noise), tmp_path / "take.npz")
    assert caught.value.filename == str(tmp_path / "take.npz")
    assert (tmp_path / "take.npz").read_text() == "old"
    assert [path.name for path in tmp_path.iterdir()] == ["take.npz"]


def test_a_folder_that_is_not_there_is_told_by_the_file_that_was_asked_for(tmp_path):
    with pytest.raises(FileNotFoundError, match=r"No such file or directory: '.*nowhere/a.json'"):
        with whole_file(tmp_path / "nowhere" / "a.json") as part:
            part.write_text("{}")


def test_until_the_end_the_old_file_is_there_and_a_killed_process_leaves_a_part_that_is_known_as_one(tmp_path):
    path = tmp_path / "answer.json"
    path.write_text("old")
    code = f"""
import time
from pathlib import Path
from torchrl_athletic.recordings.whole_file import whole_file
with whole_file(Path({str(path)!r})) as part:
    part.write_text("new")
    print(flush=True)
    time.sleep(60)
"""
    process = subprocess.Popen([sys.executable, "-c", code], stdout=subprocess.PIPE)
    process.stdout.readline()
    assert path.read_text() == "old"
    process.kill()
    process.communicate()
    assert path.read_text() == "old"
    assert [part.name for part in tmp_path.glob(UNFINISHED)] == [f".answer.json.{process.pid}.unfinished"]
