import csv
import sys

import pytest

from torchrl_athletic.training import CSVTable, make_logger


def test_a_table_has_a_row_per_step_and_columns_for_what_comes_later(tmp_path):
    table = CSVTable(tmp_path / "run" / "one" / "progress.csv")
    table.log_metrics({"reward": 1.0}, step=5)
    table.log_metrics({"reward": 2.0}, step=6)
    assert table.path.read_text().split() == ["step,reward", "5,1.0", "6,2.0"]
    table.log_metrics({"reward": 3.0, "error": 0.5}, step=7)
    table.log_metrics({"error": 0.25}, step=8)
    assert table.path.read_text().split() == ["step,reward,error", "5,1.0,", "6,2.0,", "7,3.0,0.5", "8,,0.25"]


def test_a_table_is_gone_on_with(tmp_path):
    path = tmp_path / "progress.csv"
    CSVTable(path).log_metrics({"reward": 1.0}, step=1)
    CSVTable(path).log_metrics({"reward": 2.0}, step=2)
    assert path.read_text().split() == ["step,reward", "1,1.0", "2,2.0"]


def test_a_table_that_is_gone_on_with_keeps_columns_that_come_seldom(tmp_path):
    """A row that a kill cut short has empty cells, and a row without an evaluation is no reason to forget it."""
    path = tmp_path / "progress.csv"
    path.write_text("step,error,reward\n1,0.5,1.0\n2,0.25\n")
    table = CSVTable(path)
    assert table.rows[1] == {"step": "2", "error": "0.25", "reward": ""}
    table.log_metrics({"reward": 3.0}, step=3)
    assert [row["reward"] for row in CSVTable(path).rows] == ["1.0", "", "3.0"]
    assert [row["error"] for row in CSVTable(path).rows] == ["0.5", "0.25", ""]
    assert path.read_text().splitlines()[0] == "step,error,reward"


def test_steps_that_are_done_again_are_taken_out(tmp_path):
    table = CSVTable(tmp_path / "progress.csv")
    table.log_metrics({"reward": 1.0}, step=1)
    position = table.state_dict()
    table.log_metrics({"reward": 2.0}, step=2)
    table.load_state_dict(position)
    table.log_metrics({"reward": 3.0}, step=2)
    assert table.path.read_text().split() == ["step,reward", "1,1.0", "2,3.0"]


def test_rows_without_a_step_are_numbered(tmp_path):
    table = CSVTable(tmp_path / "progress.csv")
    for reward in (1.0, 2.0, 3.0):
        table.log_metrics({"reward": reward})
    assert [row["step"] for row in CSVTable(table.path).rows] == ["0", "1", "2"]


def test_a_step_of_zero_is_a_step(tmp_path):
    table = CSVTable(tmp_path / "progress.csv")
    for step in (7, 0):
        table.log_metrics({"reward": 1.0}, step=step)
    assert [row["step"] for row in CSVTable(table.path).rows] == ["7", "0"]


def test_a_first_row_without_numbers_has_a_head_all_the_same(tmp_path):
    table = CSVTable(tmp_path / "progress.csv")
    table.log_metrics({}, step=4)
    assert table.path.read_text().split() == ["step", "4"]
    table.log_metrics({"reward": 1.0}, step=5)
    assert [row["step"] for row in CSVTable(table.path).rows] == ["4", "5"]


def test_a_table_that_cannot_be_written_anew_stays_as_it_was(tmp_path, monkeypatch):
    table = CSVTable(tmp_path / "progress.csv")
    table.log_metrics({"reward": 1.0}, step=1)
    before = table.path.read_text()

    def full(writer, rows):
        raise OSError("no space left")

    monkeypatch.setattr(csv.DictWriter, "writerows", full)
    with pytest.raises(OSError, match="no space"):
        table.log_metrics({"reward": 2.0, "error": 3.0}, step=2)
    assert table.path.read_text() == before
    assert [path.name for path in tmp_path.iterdir()] == ["progress.csv"]


def test_no_logger_is_none(tmp_path):
    assert make_logger("none", tmp_path) is None


def test_an_unknown_logger_is_refused_with_the_names_of_the_known(tmp_path):
    with pytest.raises(ValueError, match=r"there is no logger 'paper'.*'csv'"):
        make_logger("paper", tmp_path)


@pytest.mark.parametrize("kind", ["wandb", "tensorboard"])
def test_a_logger_that_is_not_installed_says_how_to_get_it(kind, tmp_path, monkeypatch):
    monkeypatch.setattr("importlib.util.find_spec", lambda name: None)
    with pytest.raises(ModuleNotFoundError, match=r"torchrl-athletic\[train\].*--logger csv"):
        make_logger(kind, tmp_path)


def test_tensorboard_writes_its_event_file(tmp_path):
    pytest.importorskip("tensorboard")
    logger = make_logger("tensorboard", tmp_path, "reach")
    logger.log_metrics({"reward": 1.0}, step=1)
    logger.experiment.flush()
    (events,) = tmp_path.rglob("events.out.tfevents*")
    assert "reach" in events.relative_to(tmp_path).parts


def test_wandb_stays_on_this_machine(tmp_path, monkeypatch):
    pytest.importorskip("wandb")
    for name in ("WANDB_API_KEY", "WANDB_MODE"):
        monkeypatch.delenv(name, raising=False)
    monkeypatch.setenv("WANDB_BASE_URL", "http://127.0.0.1:9")  # where nobody answers
    monkeypatch.setenv("WANDB_SILENT", "true")
    logger = make_logger("wandb", tmp_path, "reach")
    logger.log_metrics({"reward": 1.0}, step=1)
    assert logger.experiment.settings.mode == "offline"
    logger.experiment.finish()
    sys.modules["wandb"].teardown()
    assert list(tmp_path.rglob("*.wandb"))


def test_small_numbers_are_written_as_they_are(tmp_path):
    table = CSVTable(tmp_path / "progress.csv")
    table.log_metrics({"actor_lr": 1.25e-5}, step=1)
    assert table.path.read_text().split()[1] == "1,1.25e-05"


def test_wandb_is_told_the_run_its_folder_and_to_stay_offline(tmp_path, monkeypatch):
    told = {}
    monkeypatch.setattr("importlib.util.find_spec", lambda name: name)
    monkeypatch.setattr("torchrl.record.loggers.wandb.WandbLogger", lambda **options: told.update(options))
    make_logger("wandb", tmp_path, "reach")
    assert (told["exp_name"], told["log_dir"]) == ("reach", str(tmp_path))
    assert (told["offline"], told["mode"]) == (True, "offline")


def test_a_table_lies_in_the_folder_of_the_run_where_curves_are_drawn_of(tmp_path):
    make_logger("csv", tmp_path / "run").log_metrics({"reward": 1.0})
    assert (tmp_path / "run" / "progress.csv").exists()
