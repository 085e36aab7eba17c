"""Where the numbers of a training run go: wandb without a network, TensorBoard, or one table."""

from __future__ import annotations

import csv
from collections.abc import Mapping
from pathlib import Path
from typing import Any, Literal, Protocol, get_args

from torchrl_athletic.recordings.whole_file import whole_file

LoggerName = Literal["wandb", "csv", "tensorboard", "none"]


class MetricLogger(Protocol):
    """What :func:`~torchrl_athletic.training.train` needs; TorchRL's loggers have it."""

    def log_metrics(self, metrics: dict[str, Any], step: int | None = None) -> Any:
        """Note numbers by their names."""


class CSVTable:
    """One file, a row per step, a column per number, on disk as soon as it is known.

    Names that appear later (those of an evaluation, say) become columns then; until then their cells are empty.

    Args:
        path: File to write; its folder is made. A file that is there is gone on with.

    Example:
        >>> import tempfile
        >>> table = CSVTable(Path(tempfile.mkdtemp()) / "progress.csv")
        >>> table.log_metrics({"reward": 0.5}, step=1)
        >>> table.log_metrics({"reward": 0.75, "error": 2.0}, step=2)
        >>> print(table.path.read_text().strip())
        step,reward,error
        1,0.5,
        2,0.75,2.0
    """

    def __init__(self, path: str | Path) -> None:
        self.path = Path(path)
        self.path.parent.mkdir(parents=True, exist_ok=True)
        self.rows = self._read()
        self.columns = list(self.rows[0]) if self.rows else ["step"]

    def log_metrics(self, metrics: Mapping[str, Any], step: int | None = None) -> None:
        """Append a row."""
        row = {"step": str(len(self.rows) if step is None else step)}
        row |= {name: str(float(value)) for name, value in metrics.items()}
        self.rows.append(row)
        new = [name for name in row if name not in self.columns]
        if new or len(self.rows) == 1:
            self.columns += new
            self._write()
        else:
            with self.path.open("a", newline="") as file:
                csv.DictWriter(file, self.columns, restval="").writerow(row)

    def state_dict(self) -> dict[str, Any]:
        """How far the table goes."""
        return {"rows": len(self.rows)}

    def load_state_dict(self, state_dict: dict[str, Any]) -> None:
        """Drop rows of steps that are about to be done again."""
        del self.rows[state_dict["rows"] :]
        self._write()

    def _read(self) -> list[dict[str, str]]:
        if not self.path.exists():
            return []
        with self.path.open(newline="") as file:
            return [{name: value or "" for name, value in row.items()} for row in csv.DictReader(file)]

    def _write(self) -> None:
        with whole_file(self.path) as part, part.open("w", newline="") as file:
            writer = csv.DictWriter(file, self.columns, restval="")
            writer.writeheader()
            writer.writerows(self.rows)


def make_logger(kind: LoggerName, folder: str | Path, name: str = "training") -> MetricLogger | None:
    """Somewhere to log to. Nothing here needs a network or an account.

    Args:
        kind: ``"wandb"`` writes an offline run, to be looked at with ``wandb sync`` later; ``"csv"`` writes
            ``progress.csv``; ``"tensorboard"`` its event files; ``"none"`` nothing.
        folder: Of the run; it is made.
        name: Of the run.

    Returns:
        The logger, or None for ``"none"``.

    Raises:
        ValueError: If there is no such kind.
        ModuleNotFoundError: If wandb or tensorboard is asked for and not installed.

    Example:
        >>> import tempfile
        >>> make_logger("csv", tempfile.mkdtemp()).path.name
        'progress.csv'
    """
    if kind not in get_args(LoggerName):
        raise ValueError(f"there is no logger {kind!r}. Take one of {get_args(LoggerName)}.")
    if kind == "none":
        return None
    if kind == "csv":
        return CSVTable(Path(folder) / "progress.csv")
    _require(kind)
    if kind == "tensorboard":
        from torchrl.record.loggers.tensorboard import TensorboardLogger

        return TensorboardLogger(exp_name=name, log_dir=str(folder))
    from torchrl.record.loggers.wandb import WandbLogger

    return WandbLogger(exp_name=name, offline=True, mode="offline", log_dir=str(folder), log_env_packages=False)


def _require(package: str) -> None:
    from importlib.util import find_spec

    if find_spec(package) is None:
        raise ModuleNotFoundError(
            f"{package} is not installed, so the run would leave no trace there. Install it with "
            "pip install 'torchrl-athletic[train]', or log to a table: --logger csv.",
            name=package,
        )
