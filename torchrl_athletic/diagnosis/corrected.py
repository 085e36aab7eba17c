"""The given and the corrected simulation: to replay recordings with, and to save."""

from __future__ import annotations

import json
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import mujoco
import numpy as np
from numpy.typing import NDArray

from torchrl_athletic.diagnosis.fit import Hypothesis
from torchrl_athletic.diagnosis.replay import simulate, take_of, windows_of
from torchrl_athletic.diagnosis.screen import Candidate
from torchrl_athletic.effects import CATALOGUE, FIT_TRIMS, Effect, JointAddress
from torchrl_athletic.effects.base import Base, held_base
from torchrl_athletic.recordings import Recording, sensor_noise
from torchrl_athletic.recordings.quality import with_known_base
from torchrl_athletic.recordings.whole_file import whole_file

Array = NDArray[np.float64]

SCHEMA = "torchrl_athletic/corrected/1"


@dataclass(frozen=True, eq=False)
class Simulation:
    """A model with the effects that a diagnosis added to it; with none, the model as given."""

    model: mujoco.MjModel
    joint_names: tuple[str, ...]
    hypothesis: Hypothesis
    values: Array
    """Shape (P,)."""
    base: Base = "recorded"
    """Whether the base of a floating robot moves as recorded, or is held where the model has it."""

    def rollout(self, recording: Recording, window: float | None = 0.5) -> Array:
        """Positions that the encoders would read if the simulated robot got the recorded command.

        What the metadata say was fastened to the robot (``payload_kg``) is not in :attr:`model`: replace it by
        :func:`~torchrl_athletic.diagnosis.prepare.carrying` for such a take.

        Args:
            recording: Of the same joints.
            window: Restart from the measured state every so often [s]; None is one open-loop rollout.

        Returns:
            At the recording's stamps; each start repeats the measured position [rad, m]. Shape (T, J).
        """
        given_order = recording.joint_names
        recording = recording.ordered(self.joint_names)
        if self.base == "fixed" and recording.base_position is None:
            recording = held_base(recording, self.model)
        take = take_of(with_known_base(recording), self.model, *sensor_noise(recording))
        windows = windows_of(take, window)
        predicted = simulate(windows, self.hypothesis.build, self.values[None])[0]
        path = take.position.copy()
        path[windows.index.ravel()] = predicted.reshape(-1, path.shape[1])
        last = int(windows.index.max()) if windows.index.size else 0
        if last + 1 < len(take.time):  # what does not fill a window
            rest = type(windows)(take, np.array([last]), len(take.time) - 1 - last)
            path[last + 1 :] = simulate(rest, self.hypothesis.build, self.values[None])[0, 0]
        at_stamps = np.stack([np.interp(recording.time, take.time, column) for column in path.T], axis=-1)
        return at_stamps[:, [self.joint_names.index(name) for name in given_order]]

    def values_of(self, candidate: Candidate) -> Array:
        """Numbers of one effect. Shape (its P,)."""
        return self.hypothesis.values_of(candidate, self.values)

    def to_json(self) -> dict[str, Any]:
        """All effects and trims with their values, as ``corrected.json`` holds them."""
        return {
            "schema": SCHEMA,
            "joint_names": list(self.joint_names),
            "base": self.base,
            "effects": [self._entry(c) for c in self.hypothesis.terms],
            "trims": [self._entry(c) for c in self.hypothesis.trims],
        }

    def _entry(self, candidate: Candidate) -> dict[str, Any]:
        values = self.hypothesis.values_of(candidate, self.values)
        return {
            "effect": candidate.effect.name,
            "joint": candidate.joint_name,
            "parameters": {
                p.name: {"value": float(v), "nominal": p.nominal, "unit": p.unit}
                for p, v in zip(candidate.parameters, values, strict=True)
            },
        }

    @classmethod
    def from_json(
        cls, content: dict[str, Any], model: mujoco.MjModel, catalogue: Sequence[Effect] = CATALOGUE
    ) -> Simulation:
        """Read :meth:`to_json` back, for the model that was diagnosed.

        Raises:
            ValueError: If the content is of another schema, or names an effect that the catalogue lacks.
        """
        if content.get("schema") != SCHEMA:
            raise ValueError(
                f"schema is {content.get('schema')!r}, this version reads {SCHEMA!r}. Run the diagnosis again."
            )
        names = tuple(content["joint_names"])
        address = JointAddress.of(model, names, "corrected.json")
        groups: list[tuple[Candidate, ...]] = []
        values: list[float] = []
        named = {effect.name: effect for effect in (*FIT_TRIMS, *catalogue)}
        beside = {effect.name: effect for effect in CATALOGUE} | named  # a trim needs no name of the user's
        for group, known in (("effects", named), ("trims", beside)):
            candidates = []
            for entry in content[group]:
                if entry["effect"] not in known:
                    raise ValueError(
                        f"effect {entry['effect']!r} is not in the catalogue, which has {sorted(known)}. Pass yours."
                    )
                effect = known[entry["effect"]]
                joint = 0 if entry["joint"] is None else names.index(entry["joint"])
                parameters = effect.parameters(model, address, joint)
                candidates.append(Candidate(effect, joint, entry["joint"], parameters))
                values.extend(entry["parameters"][p.name]["value"] for p in parameters)
            groups.append(tuple(candidates))
        base = content.get("base", "recorded")
        return cls(model, names, Hypothesis(*groups), np.array(values, dtype=np.float64), base)


def write_atomically(path: Path, text: str) -> None:
    """Write a whole file or none of it."""
    path.parent.mkdir(parents=True, exist_ok=True)
    with whole_file(path) as part:
        part.write_text(text, encoding="utf-8")


def write_json(path: Path, content: dict[str, Any]) -> None:
    """Write JSON that any reader takes: no NaN, no infinity."""
    write_atomically(path, json.dumps(content, indent=1, allow_nan=False, ensure_ascii=False) + "\n")
