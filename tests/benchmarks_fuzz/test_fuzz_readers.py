"""A few of the inputs that the fuzzer makes by the hundred thousand."""

import itertools
import time
from concurrent.futures import ProcessPoolExecutor
from multiprocessing import get_context

import pytest

from benchmarks.fuzz_readers import KINDS, RUN, Outcome, fuzz, outcome, samples, turns


@pytest.fixture(scope="module")
def good(tmp_path_factory):
    return samples(tmp_path_factory.mktemp("good"))


def test_damaged_files_of_every_kind_are_read_or_refused(good, tmp_path):
    inputs = [RUN * k + number for k in range(len(good)) for number in range(4)]
    with ProcessPoolExecutor(1, get_context("spawn")) as own:  # whose children are the readers alone
        outcomes, memory = own.submit(fuzz, inputs, 1, tmp_path / "kept").result()
    assert {one.kind for one in outcomes} == set(good)
    assert [one for one in outcomes if one.failed] == []
    assert {one.said for one in outcomes} == {"read", "refused"}
    assert memory < 2 << 30
    assert not (tmp_path / "kept").exists()


def test_without_damage_every_sample_is_read(good):
    assert {outcome(kind, path).said for kind, path in good.items()} == {"read"}


def test_a_crash_a_hang_and_another_exception_are_failures(good, monkeypatch):
    def surprise(path, columns):
        raise KeyError("schema")

    assert Outcome("npz", "read", 21.0).failed
    monkeypatch.setattr("benchmarks.fuzz_readers.read_recordings", surprise)
    assert outcome("npz", good["npz"]).failed


def test_the_same_number_makes_the_same_input(good, monkeypatch, tmp_path):
    made = []
    monkeypatch.setattr("benchmarks.fuzz_readers.read_recordings", lambda path, columns: made.append(path.read_bytes()))
    clock = itertools.count(1.7e9, 60.0)
    monkeypatch.setattr(time, "time", lambda: next(clock))  # archives note when they were packed
    for numbers in (range(20), range(3, 20)):
        fuzz(numbers, seed=2, keep=tmp_path)
    assert made[3:20] == made[20:]
    assert len(set(made)) == 20


def test_one_kind_alone_has_the_inputs_that_it_has_when_all_take_turns():
    every = turns(2 * len(KINDS) * RUN)
    assert turns(RUN + 3) == [every[0], every[1][:3]]
    assert turns(RUN + 3, "csv") == [every[1], every[1 + len(KINDS)][:3]]
    with pytest.raises(SystemExit, match="no kind 'cvs'"):
        turns(1, "cvs")


def test_a_folder_that_a_reader_fails_on_is_kept_as_it_was(monkeypatch, tmp_path):
    read = []

    def surprise(path, columns):
        read.append({file.relative_to(path): file.read_bytes() for file in path.rglob("*.*")})
        raise KeyError("schema")

    monkeypatch.setattr("benchmarks.fuzz_readers.read_recordings", surprise)
    [number] = turns(1, "LeRobot folder")[0]
    fuzz([number], seed=0, keep=tmp_path / "kept")
    kept = tmp_path / "kept" / str(number)
    assert read == [{file.relative_to(kept): file.read_bytes() for file in kept.rglob("*.*")}]
    assert len(read[0]) == 3
