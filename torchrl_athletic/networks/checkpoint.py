"""Networks on disk: one file, written whole or not at all, read without running code that it brings."""

from __future__ import annotations

import os
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import torch
from torch import Tensor, nn

FORMAT = "torchrl_athletic/checkpoint/1"


def save_checkpoint(path: str | Path, metadata: Mapping[str, Any] | None = None, **modules: nn.Module) -> Path:
    """Write the state of modules under their names, replacing an older file only once the new one is complete.

    Args:
        path: File to write; its folder is made.
        metadata: What else a reader should know, of numbers, strings, lists and dicts.
        modules: By name.

    Returns:
        The path.

    Raises:
        ValueError: If no module is given.

    Example:
        >>> import tempfile
        >>> path = Path(tempfile.mkdtemp()) / "reach.pt"
        >>> path = save_checkpoint(path, {"task": "reach"}, net=nn.Linear(2, 1))
        >>> load_checkpoint(path, net=nn.Linear(2, 1))
        {'task': 'reach'}
    """
    if not modules:
        raise ValueError("there is no module to save. Give each by a name: save_checkpoint(path, actor=actor).")
    path = Path(path)
    path.parent.mkdir(parents=True, exist_ok=True)
    states = {name: module.state_dict() for name, module in modules.items()}
    shapes = {name: {key: list(value.shape) for key, value in tensors(state)} for name, state in states.items()}
    part = path.with_name(f"{path.name}.{os.getpid()}.part")
    try:
        torch.save({"format": FORMAT, "metadata": dict(metadata or {}), "shapes": shapes, "state": states}, part)
        os.replace(part, path)
    finally:
        part.unlink(missing_ok=True)
    return path


def load_checkpoint(path: str | Path, **modules: nn.Module) -> dict[str, Any]:
    """Read modules back by the names they were saved under; all of them or, if one does not fit, none.

    Args:
        path: File that :func:`save_checkpoint` wrote.
        modules: To be filled, on whatever device they are; names of the file that are not asked for are passed over.

    Returns:
        The metadata.

    Raises:
        ValueError: If the file is of another format, or lacks a module, or holds other shapes than a module has.

    Example:
        >>> import tempfile
        >>> path = save_checkpoint(Path(tempfile.mkdtemp()) / "a.pt", net=nn.Linear(2, 1))
        >>> load_checkpoint(path, net=nn.Linear(3, 1))
        Traceback (most recent call last):
        ...
        ValueError: a.pt: net.weight has shape [1, 2], the module [1, 3]. Build the module as it was when it was saved.
    """
    path = Path(path)
    found = torch.load(path, map_location="cpu", weights_only=True)
    if not isinstance(found, dict) or found.get("format") != FORMAT:
        raise ValueError(f"{path.name} is not a checkpoint of format {FORMAT}. Write it with save_checkpoint.")
    for name, module in modules.items():
        if name not in found["state"]:
            raise ValueError(f"{path.name} holds {sorted(found['state'])}, not {name!r}. Ask for one of these.")
        differences = mismatches(name, found["shapes"][name], module)
        if differences:
            raise ValueError(f"{path.name}: {'; '.join(differences)}. Build the module as it was when it was saved.")
    for name, module in modules.items():
        module.load_state_dict(found["state"][name])
    return found["metadata"]


def mismatches(name: str, shapes: Mapping[str, list[int]], module: nn.Module) -> list[str]:
    """What differs between a saved state and a module, in words."""
    wanted = {key: list(value.shape) for key, value in tensors(module.state_dict())}
    lines = [f"{name}.{key} is in the file alone" for key in shapes if key not in wanted]
    lines += [f"{name}.{key} is in the module alone" for key in wanted if key not in shapes]
    lines += [
        f"{name}.{key} has shape {shapes[key]}, the module {wanted[key]}"
        for key in shapes
        if key in wanted and shapes[key] != wanted[key]
    ]
    return lines


def tensors(state: Mapping[str, Any]) -> list[tuple[str, Tensor]]:
    return [(key, value) for key, value in state.items() if isinstance(value, Tensor)]
