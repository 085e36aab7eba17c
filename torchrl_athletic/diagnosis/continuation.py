"""What a diagnosis was made of, kept in its folder, so that new recordings can join the old ones."""

from __future__ import annotations

import json
import shlex
from dataclasses import fields, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any, TypeVar

from torchrl_athletic.diagnosis.corrected import write_json
from torchrl_athletic.recordings import RecordingError

if TYPE_CHECKING:
    from _typeshed import DataclassInstance

    Settings = TypeVar("Settings", bound=DataclassInstance)

SCHEMA = "torchrl_athletic/inputs/2"
FILE = "inputs.json"
DIGEST = "digest"
JOINED = "continue_with"
"""The field of the settings that names new recordings."""
PATHS = ("model", "recordings", "heldout", "columns", JOINED)
"""Fields of the settings that are paths."""


def remember(settings: DataclassInstance, output: Path) -> None:
    """Write ``inputs.json``, once its diagnosis is written, whose digest it notes.

    It holds all settings but the folder itself, with paths made absolute.
    """
    content = {f.name: _plain(getattr(settings, f.name)) for f in fields(settings) if f.name != "output"}
    write_json(output / FILE, {"schema": SCHEMA, DIGEST: _digest(output), **content})


def _digest(output: Path) -> str | None:
    """Digest of a diagnosis' inputs, as the diagnosis in a folder states it."""
    path = output / "diagnosis.json"
    return json.loads(path.read_text(encoding="utf-8")).get("inputs") if path.is_file() else None


def recall(settings: Settings, output: Path) -> Settings:
    """The settings of the earlier diagnosis in a folder, with the new recordings added to those added before.

    What is said anew, other than by default, wins. Settings that name no new recordings come back as they are.

    Raises:
        FileNotFoundError: If the folder holds no earlier diagnosis.
        RecordingError: If its inputs are of another schema, or of another diagnosis than the one that lies beside them.
    """
    new: tuple[Path, ...] = getattr(settings, JOINED)
    if not new:
        return settings
    path = output / FILE
    if not path.is_file():
        raise FileNotFoundError(
            f"{path} does not exist, so there is nothing to continue. Name the folder of the earlier diagnosis as "
            "--output, or give --model and --recordings without --continue."
        )
    content = json.loads(path.read_text(encoding="utf-8"))
    if content.pop("schema", None) != SCHEMA:
        raise RecordingError(
            f"{path} is of another version. Give --model and --recordings, with the new ones among them."
        )
    if content.pop(DIGEST) != _digest(output):
        raise RecordingError(
            f"{path} is of another diagnosis than the diagnosis.json beside it: a later run was stopped before its "
            "end. Give --model and --recordings, with the new ones among them."
        )
    known = {f.name for f in fields(settings)}
    earlier = {name: _read(name, value) for name, value in content.items() if name in known}
    anew = said(settings)
    if anew & {"model", "recordings"}:
        earlier.pop("dataset", None)  # which would stand for both
    earlier[JOINED] = (*earlier.get(JOINED, ()), *(p for p in new if p.resolve() not in earlier.get(JOINED, ())))
    return replace(settings, **{name: value for name, value in earlier.items() if name == JOINED or name not in anew})


def said(settings: DataclassInstance) -> set[str]:
    """Names of the settings that are other than by default."""
    return {f.name for f in fields(settings) if getattr(settings, f.name) != f.default}


def as_before(settings: DataclassInstance, recalled: DataclassInstance) -> str:
    """The flags that stand as an earlier diagnosis was told, in a line to print; empty if there are none."""
    names = [f.name for f in fields(recalled) if f.name in said(recalled) - said(settings)]
    flags = [f"--{name.replace('_', '-')} {_shown(getattr(recalled, name))}".removesuffix(" True") for name in names]
    return f"As in the earlier diagnosis: {' '.join(flags)}" if flags else ""


def _shown(value: Any) -> str:
    return shlex.join(map(str, value if isinstance(value, tuple) else (value,)))


def _plain(value: Any) -> Any:
    if isinstance(value, Path):
        return str(value.resolve())
    return [_plain(item) for item in value] if isinstance(value, tuple) else value


def _read(name: str, value: Any) -> Any:
    """A value of a field, as it was before it was written."""
    if isinstance(value, list):
        return tuple(_read(name, item) for item in value)
    return Path(value) if name in PATHS and value is not None else value
