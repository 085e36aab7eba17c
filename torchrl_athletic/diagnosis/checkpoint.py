"""Results of finished stages, kept beside the report so that a stopped diagnosis goes on where it was."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Callable, Iterable
from pathlib import Path
from typing import Any, TypeVar

import numpy as np

from torchrl_athletic import __version__
from torchrl_athletic.diagnosis.corrected import write_json
from torchrl_athletic.recordings import Recording

T = TypeVar("T")


class Checkpoint:
    """Stage results as JSON, valid for exactly the same inputs, settings and version.

    Args:
        path: The file; None keeps nothing.
        digest: Of the inputs (see :func:`inputs_digest`).
    """

    def __init__(self, path: Path | None, digest: str) -> None:
        self.path, self.digest = path, digest
        self._results: dict[str, Any] = {}
        if path is not None and path.exists():
            try:
                content = json.loads(path.read_text(encoding="utf-8"))
            except ValueError:
                content = {}
            if isinstance(content, dict) and content.get("digest") == digest:
                self._results = content["results"]

    def result(self, key: str, compute: Callable[[], T], encode: Callable[[T], Any], decode: Callable[[Any], T]) -> T:
        """What ``compute`` gave before, or gives now."""
        if key in self._results:
            return decode(self._results[key])
        value = compute()
        self._results[key] = encode(value)
        if self.path is not None:
            write_json(self.path, {"digest": self.digest, "results": self._results})
        return value

    @property
    def kept(self) -> bool:
        """Whether there is something to go on from."""
        return bool(self._results)

    def remove(self) -> None:
        """Forget: the report is complete."""
        if self.path is not None:
            self.path.unlink(missing_ok=True)


def inputs_digest(xml: str, recordings: Iterable[Recording], settings: dict[str, Any]) -> str:
    """Fingerprint of everything that a diagnosis depends on."""
    digest = hashlib.sha256(f"{__version__}\n{xml}\n{json.dumps(settings, sort_keys=True)}".encode())
    for r in recordings:
        digest.update(json.dumps([r.source, r.joint_names, r.metadata], default=str).encode())
        for name in (
            "time",
            "position",
            "velocity",
            "torque_command",
            "position_target",
            "kp",
            "kd",
            "torque_measured",
            "base_position",
            "base_orientation",
        ):
            value = getattr(r, name)
            digest.update(name.encode() + (b"" if value is None else np.ascontiguousarray(value).tobytes()))
    return digest.hexdigest()
