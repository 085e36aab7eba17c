"""What a diagnosis says: the contract of ``diagnosis.json``, and the maps that the report draws beside it."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, field
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

SCHEMA = "torchrl_athletic/diagnosis/1"
Verdict = Literal["nothing_missing", "explained", "partly_explained", "unexplained"]


@dataclass(frozen=True)
class Estimate:
    """One fitted parameter with its 95 % interval, in ``unit``."""

    value: float
    ci95: tuple[float, float]
    unit: str


@dataclass(frozen=True)
class Name:
    """An effect of the catalogue on a joint; None for the whole robot."""

    effect: str
    joint: str | None


@dataclass(frozen=True)
class Rival:
    """Another effect that the recordings cannot rule out, and the experiment that would."""

    effect: str
    joint: str | None
    probability: float
    separating_experiment: str
    alternatives: tuple[tuple[Name, ...], ...] = ()
    """What states the same physics as it does: no recording favours one of them."""


@dataclass(frozen=True)
class Finding:
    """One piece of physics that the model leaves out."""

    effect: str
    """Name from the catalogue."""
    joint: str | None
    """Joint name; None for an effect of the whole robot."""
    probability: float
    """Probability that the statement is true."""
    sentence: str
    """The statement in words, with numbers and units."""
    parameters: Mapping[str, Estimate]
    regime: str
    """Where it shows: 'moving backwards', 'below 0.2 rad/s', 'everywhere'."""
    rivals: tuple[Rival, ...] = ()
    energy_share: float = 0.0
    """Share of the joint's missing torque that this effect accounts for, 0..1."""
    grounds: Mapping[str, float] = field(default_factory=dict)
    """What the probability rests on (see :class:`~torchrl_athletic.diagnosis.calibration.Grounds`)."""
    alternatives: tuple[tuple[Name, ...], ...] = ()
    """Other names of the same physics, which no recording can tell from this one; each may take several together."""
    class_name: str = ""
    """Class of the effect: 'friction', 'inertia', ..."""
    class_probability: float = 0.0
    """That physics of this class is missing at the joint, whatever its law."""
    law_probability: float = 0.0
    """That it is this law, given the class: ``probability`` over ``class_probability``."""


@dataclass(frozen=True)
class Location:
    """Where the error is, before any naming."""

    joint: str
    regime: str
    share_of_error: float
    """Share of the error energy of all joints, 0..1."""
    ci95: tuple[float, float]
    """Block-bootstrap band of the share."""


@dataclass(frozen=True)
class Score:
    """RMSE of the position over 0.5 s windows started from the measured state [rad, m for slides]."""

    before: float
    after: float
    floor: float
    """What the corrected simulation would score if it were the truth, given the noise of the sensors."""
    share_closed: float
    """(before - after) / (before - floor): the part of the closable gap that the correction closes."""
    per_joint: Mapping[str, Mapping[str, float]]
    """Joint -> {before, after, floor, before_within_reach, after_within_reach}.

    In the last two no window counts for more than a radian, a metre, or its motion if that is more.
    """


@dataclass(frozen=True)
class RegimeMap:
    """Missing torque of one joint against one quantity, before and after the correction."""

    joint: str
    feature: str
    """'speed', 'position', 'load', 'acceleration', 'time'."""
    unit: str
    """Unit of the feature."""
    torque_unit: str
    """'N·m' or 'N'."""
    centre: NDArray[np.float64]
    """Centre of each bin, in ``unit``. Shape (B,)."""
    before: NDArray[np.float64]
    """Mean missing torque in the bin. Shape (B,)."""
    before_band: NDArray[np.float64]
    """Block-bootstrap 95 % band of ``before``. Shape (B, 2)."""
    after: NDArray[np.float64]
    """Mean missing torque that the correction leaves in the bin. Shape (B,)."""
    after_band: NDArray[np.float64]
    """Shape (B, 2)."""
    noise: float
    """Standard deviation of one sample of the missing torque that sensor noise alone explains."""


@dataclass(frozen=True)
class Overlay:
    """Recorded and simulated position of one recording, for the eye."""

    recording: str
    """Its source."""
    heldout: bool
    time: NDArray[np.float64]
    """[s]. Shape (T,)."""
    joint_names: tuple[str, ...]
    measured: NDArray[np.float64]
    """Shape (T, J)."""
    before: NDArray[np.float64]
    """Given model, 0.5 s windows. Shape (T, J)."""
    after: NDArray[np.float64]
    """Corrected model, 0.5 s windows. Shape (T, J)."""


@dataclass(frozen=True)
class Answer:
    """Everything that a diagnosis states, without the simulations behind it."""

    verdict: Verdict
    summary: tuple[str, ...]
    """Sentences for the terminal and the head of the report, most important first."""
    findings: tuple[Finding, ...] = ()
    locations: tuple[Location, ...] = ()
    fit: Mapping[str, Score] = field(default_factory=dict)
    """'train' and, when recordings were kept aside, 'heldout'."""
    unexplained_share: float = 0.0
    quality: Mapping[str, Any] = field(default_factory=dict)
    """{recordings: [{source, rate, duration, masked: {reason: samples}, warnings: [...]}], warnings: [...],
    column_doubts: [...]}"""
    model: str = "model"
    """Name of the diagnosed model."""
    complete: bool = True
    """False when the run was stopped early: what is stated then is the state at that point."""
    stage: str = "deliver"
    """The stage that a run ended in."""
    seed: int = 0
    inputs: str = ""
    """Digest of the model, the recordings and the settings that it was made of."""
    remarks: tuple[str, ...] = ()
    """What the gates observed and the findings do not say, such as a flexibility that the held-out takes excite."""

    def to_json(self) -> dict[str, Any]:
        """The content of ``diagnosis.json``, schema 1, as plain dicts, lists, strings and numbers."""
        return {"schema": SCHEMA, **_plain(asdict(self))}

    @classmethod
    def from_json(cls, content: Mapping[str, Any]) -> Answer:
        """Read :meth:`to_json` back.

        Raises:
            ValueError: If the content is of another schema.
        """
        if content.get("schema") != SCHEMA:
            raise ValueError(
                f"schema is {content.get('schema')!r}, this version reads {SCHEMA!r}. Run the diagnosis again."
            )
        c = {key: value for key, value in content.items() if key != "schema"}
        c["findings"] = tuple(_finding(f) for f in c["findings"])
        c["locations"] = tuple(Location(**{**x, "ci95": tuple(x["ci95"])}) for x in c["locations"])
        c["fit"] = {split: Score(**score) for split, score in c["fit"].items()}
        c["summary"], c["remarks"] = tuple(c["summary"]), tuple(c["remarks"])
        return cls(**c)


def _finding(f: Mapping[str, Any]) -> Finding:
    parameters = {name: Estimate(**{**p, "ci95": tuple(p["ci95"])}) for name, p in f["parameters"].items()}
    rivals = tuple(Rival(**{**r, "alternatives": _alternatives(r)}) for r in f["rivals"])
    return Finding(**{**f, "parameters": parameters, "rivals": rivals, "alternatives": _alternatives(f)})


def _alternatives(content: Mapping[str, Any]) -> tuple[tuple[Name, ...], ...]:
    return tuple(tuple(Name(**name) for name in names) for names in content.get("alternatives", ()))


def _plain(value: Any) -> Any:
    if isinstance(value, Mapping):
        return {str(key): _plain(item) for key, item in value.items()}
    if isinstance(value, np.ndarray):
        return value.tolist()
    if isinstance(value, Sequence) and not isinstance(value, str):
        return [_plain(item) for item in value]
    if isinstance(value, np.generic):
        return value.item()
    return value
