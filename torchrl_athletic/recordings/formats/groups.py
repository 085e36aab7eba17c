"""Files that hold arrays in a tree (HDF5, MAT): one take at the root, or one in every group."""

from __future__ import annotations

from collections.abc import Mapping

from torchrl_athletic.recordings.formats.column_map import SIGNALS, ColumnMap
from torchrl_athletic.recordings.formats.take import Fields, Load, RawTake
from torchrl_athletic.recordings.recording import RecordingError


def takes_by_group(source: str, arrays: Mapping[str, Load], columns: ColumnMap) -> list[RawTake]:
    """Split arrays named by their path (``run_1/time``) into one take for each group that holds the stamps.

    In a file without stamps (``columns.rate``) the position marks a take. Arrays at the root, such as ``joint_names``,
    belong to every take.

    Raises:
        RecordingError: If a group holds a signal but no stamps.
    """
    mark = columns.column("position" if columns.rate is not None else "time")
    name = mark.name if mark is not None else ("position" if columns.rate is not None else "time")
    groups = [path.removesuffix(f"/{name}") for path in arrays if path.endswith(f"/{name}")]
    if name in arrays or not groups:
        return [RawTake(source, Fields(arrays))]
    shared = {path: load for path, load in arrays.items() if "/" not in path}
    inside = {path for path in arrays if any(path.startswith(f"{group}/") for group in groups)}
    for path in arrays:
        if path not in inside and any(part in SIGNALS for part in path.split("/")[1:]):
            raise RecordingError(
                f"{source}: {path} is there, but its group has no {name}. Add the stamps, or remove the group."
            )
    return [RawTake(f"{source}: {group}", Fields(shared | _within(group, arrays))) for group in groups]


def _within(group: str, arrays: Mapping[str, Load]) -> dict[str, Load]:
    return {path.removeprefix(f"{group}/"): load for path, load in arrays.items() if path.startswith(f"{group}/")}
