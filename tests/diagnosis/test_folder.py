"""One process at a time writes a diagnosis, and what a killed one left is cleared away."""

from concurrent.futures import ThreadPoolExecutor
from types import SimpleNamespace

import pytest
from diagnosis.plants import pendulum, record, smooth_torque

from torchrl_athletic.diagnosis import diagnose, fit
from torchrl_athletic.diagnosis.fitting import Fit
from torchrl_athletic.diagnosis.folder import locked
from torchrl_athletic.diagnosis.outcome import Diagnosis
from torchrl_athletic.diagnosis.progress import Progress


def enter(folder):
    with locked(folder, "fit.json"):
        return "entered"


def from_outside(folder):
    """Enter from another thread, which the lock takes for a stranger as it does another process."""
    with ThreadPoolExecutor(1) as pool:
        return pool.submit(enter, folder).result()


def test_who_is_outside_stays_out_until_the_first_one_has_left(tmp_path):
    with (
        locked(tmp_path, "fit.json"),
        pytest.raises(BlockingIOError, match=f"^{tmp_path}: another run is writing there.*Wait"),
    ):
        from_outside(tmp_path)
    assert from_outside(tmp_path) == "entered"


class Told(Progress):
    """Notes the stages that begin."""

    def __init__(self, stages: list[str]) -> None:
        super().__init__()
        self.stage = stages.append


SAVED = {
    "fit.json": Diagnosis(SimpleNamespace(), None, None, ""),
    "diagnosis.json": Fit((), None, None, {}, (), "", "", 0.0),
}
"""What may be saved, by the file that says that another kind of answer lies there."""


@pytest.mark.parametrize(("other", "answer"), SAVED.items())
def test_what_is_saved_waits_for_nobody_and_is_not_mixed_with_an_answer_of_another_kind(tmp_path, other, answer):
    with locked(tmp_path, "fit.json"), ThreadPoolExecutor(1) as pool, pytest.raises(BlockingIOError):
        pool.submit(answer.save, tmp_path).result()
    tmp_path.mkdir(exist_ok=True)  # it was left empty
    (tmp_path / other).write_text("{}")
    with pytest.raises(FileExistsError, match=f"^{tmp_path} holds {other}.*another --output"):
        answer.save(tmp_path)
    assert [path.name for path in tmp_path.iterdir()] == [other]


@pytest.mark.parametrize(("run", "other"), [(diagnose, "fit.json"), (fit, "diagnosis.json")])
def test_a_folder_with_an_answer_of_another_kind_is_refused_before_the_work(tmp_path, run, other):
    (tmp_path / other).write_text("{}")
    stages = []
    with pytest.raises(FileExistsError, match=f"^{tmp_path} holds {other}"):
        run(pendulum(), [record(pendulum(), smooth_torque(1.0))], output=tmp_path, progress=Told(stages))
    assert stages == []


def test_who_is_inside_enters_again_and_stays_inside(tmp_path):
    with locked(tmp_path / "out", "fit.json"):
        with locked(tmp_path / "." / "out", "fit.json"):
            pass
        with pytest.raises(BlockingIOError):
            from_outside(tmp_path / "out")


def test_what_a_killed_process_left_half_written_is_removed_and_nothing_else(tmp_path):
    for name in (".diagnosis.json.123.unfinished", ".gitignore", "diagnosis.json"):
        (tmp_path / name).write_text("{")
    with locked(tmp_path, "fit.json"):
        assert sorted(path.name for path in tmp_path.iterdir()) == [".gitignore", "diagnosis.json"]


def test_a_folder_that_stays_empty_does_not_stay(tmp_path):
    with pytest.raises(ValueError, match="wrong"), locked(tmp_path / "a" / "b", "fit.json"):
        raise ValueError("wrong")
    assert not (tmp_path / "a" / "b").exists()


def test_who_comes_back_locks_it_again(tmp_path):
    for _ in range(2):
        with locked(tmp_path, "fit.json"):
            (tmp_path / "note").touch()
            with pytest.raises(BlockingIOError):
                from_outside(tmp_path)


def test_where_files_cannot_be_locked_nothing_half_written_is_taken_for_a_dead_process_s(tmp_path, monkeypatch):
    def unknown(descriptor, how):
        raise OSError("no locks here")

    monkeypatch.setattr("fcntl.flock", unknown)
    (tmp_path / ".diagnosis.json.123.unfinished").write_text("{")
    with locked(tmp_path, "fit.json"):
        assert len(list(tmp_path.iterdir())) == 1
    assert len(list(tmp_path.iterdir())) == 1


def test_who_is_inside_two_folders_is_inside_both(tmp_path):
    one, two = tmp_path / "one", tmp_path / "two"
    with locked(one, "fit.json"), locked(two, "fit.json"), locked(one, "fit.json"):
        (one / "note").touch()
    assert one.exists()
    assert not two.exists()
