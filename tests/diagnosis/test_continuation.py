"""A second diagnosis takes over what the first one was made of."""

import json
from dataclasses import dataclass, replace
from pathlib import Path

import pytest

from torchrl_athletic.diagnosis.continuation import as_before, recall, remember


@dataclass(frozen=True)
class Settings:
    model: Path | None = None
    recordings: tuple[Path, ...] = ()
    continue_with: tuple[Path, ...] = ()
    heldout: tuple[Path, ...] = ()
    columns: Path | None = None
    lock: tuple[str, ...] = ()
    output: Path = Path("out")
    dataset: str | None = None
    seed: int = 0


def test_new_recordings_join_the_old_ones_from_wherever_it_is_called(tmp_path, monkeypatch):
    (tmp_path / "elsewhere").mkdir()
    monkeypatch.chdir(tmp_path)
    for name, columns in (("out", None), ("mapped", Path("map.json"))):
        remember(Settings(Path("robot.xml"), (Path("a"), Path("b")), columns=columns, seed=4), tmp_path / name)
    monkeypatch.chdir("elsewhere")
    first = recall(Settings(continue_with=(Path("c"),), output=tmp_path / "out"), tmp_path / "out")
    assert first.model == tmp_path / "robot.xml"
    assert first.recordings == (tmp_path / "a", tmp_path / "b")
    assert first.columns is None
    assert recall(Settings(continue_with=(Path("c"),)), tmp_path / "mapped").columns == tmp_path / "map.json"
    assert first.seed == 4
    assert first.output == tmp_path / "out"
    assert [p.resolve() for p in first.continue_with] == [tmp_path / "elsewhere/c"]


def test_what_joined_once_stays_and_joins_once_only(tmp_path):
    remember(Settings(tmp_path / "robot.xml", (tmp_path / "a",), (tmp_path / "c",)), tmp_path)
    again = recall(Settings(continue_with=(tmp_path / "c", tmp_path / "d")), tmp_path)
    assert again.continue_with == (tmp_path / "c", tmp_path / "d")


def test_every_setting_comes_back_as_it_was_paths_as_paths_and_names_as_names(tmp_path):
    told = Settings(tmp_path / "robot.xml", (tmp_path / "a",), heldout=(tmp_path / "h",), columns=tmp_path / "map.json",
                    lock=("elbow=0.3", "wrist"), seed=4)  # fmt: skip
    remember(told, tmp_path)
    assert recall(Settings(continue_with=(tmp_path / "c",)), tmp_path) == replace(told, continue_with=(tmp_path / "c",))


def test_what_is_said_anew_wins_and_what_stands_as_before_is_told(tmp_path):
    first = Settings(tmp_path / "robot.xml", (tmp_path / "a b", tmp_path / "c"), columns=tmp_path / "map.json", seed=4)
    remember(first, tmp_path)
    anew = Settings(columns=tmp_path / "new.json", lock=("wrist",), continue_with=(tmp_path / "n",), output=tmp_path)
    recalled = recall(anew, tmp_path)
    assert recalled == replace(anew, model=first.model, recordings=first.recordings, seed=4)
    assert as_before(anew, recalled) == (
        f"As in the earlier diagnosis: --model {tmp_path}/robot.xml --recordings '{tmp_path}/a b' {tmp_path}/c --seed 4"
    )
    assert as_before(first, first) == ""


def test_a_model_or_a_dataset_that_is_said_anew_stands_for_the_other_one(tmp_path):
    remember(Settings(dataset="emps"), tmp_path)
    anew = Settings(tmp_path / "robot.xml", (tmp_path / "a",), continue_with=(tmp_path / "n",))
    assert recall(anew, tmp_path) == anew
    remember(anew, tmp_path)
    assert recall(Settings(dataset="xl330", continue_with=(tmp_path / "n",)), tmp_path).dataset == "xl330"


def test_a_public_dataset_can_be_continued_too(tmp_path):
    remember(Settings(dataset="emps"), tmp_path)
    assert recall(Settings(continue_with=(tmp_path / "new.npz",)), tmp_path).dataset == "emps"


def test_without_new_recordings_nothing_is_recalled(tmp_path):
    remember(Settings(dataset="emps"), tmp_path)
    assert recall(Settings(), tmp_path) == Settings()


def test_a_folder_without_a_diagnosis_cannot_be_continued(tmp_path):
    with pytest.raises(FileNotFoundError, match="folder of the earlier diagnosis"):
        recall(Settings(continue_with=(Path("c"),)), tmp_path)


def test_inputs_of_another_diagnosis_than_the_one_beside_them_are_refused(tmp_path):
    """As when a run in the folder of an older one was killed between the two files."""
    answer = tmp_path / "diagnosis.json"
    answer.write_text('{"inputs": "those of the old one"}')
    remember(Settings(dataset="emps"), tmp_path)
    new = Settings(continue_with=(tmp_path / "new.npz",))
    answer.write_text('{"inputs": "those of the old one", "findings": "with a net on top"}')
    assert recall(new, tmp_path).dataset == "emps"
    answer.write_text('{"inputs": "those of the new one"}')
    with pytest.raises(ValueError, match=r"inputs\.json is of another diagnosis .* Give --model and --recordings"):
        recall(new, tmp_path)


@pytest.mark.parametrize("content", ['{"schema": "other"}', '{"digest": null}'])
def test_inputs_of_another_version_are_refused(content, tmp_path):
    (tmp_path / "inputs.json").write_text(content)
    with pytest.raises(ValueError, match="another version"):
        recall(Settings(continue_with=(Path("c"),)), tmp_path)


def test_a_setting_that_is_no_longer_known_is_left_aside(tmp_path):
    remember(Settings(dataset="emps", seed=4), tmp_path)
    path = tmp_path / "inputs.json"
    path.write_text(json.dumps({**json.loads(path.read_text()), "gone": 1}))
    assert recall(Settings(continue_with=(tmp_path / "new.npz",)), tmp_path).seed == 4
