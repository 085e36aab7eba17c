"""A public data set: recordings of a real bench, the model it starts from, and which takes are kept aside."""

from __future__ import annotations

from dataclasses import dataclass

from torchrl_athletic.recordings.recording import Recording


@dataclass(frozen=True, eq=False)
class Dataset:
    """Recordings of one bench, ready for a diagnosis."""

    name: str
    """What ``load_dataset`` and ``--dataset`` know it by."""
    model: str
    """MJCF of the bench as published, with the physics left out that a diagnosis is to find."""
    recordings: list[Recording]
    """Recordings for fitting, in a fixed order."""
    heldout: list[Recording]
    """Never fitted: motion of another kind than ``recordings``."""
    notes: str
    """Source, licence, how the takes were split and what is known to be odd about them."""
    extra: list[Recording]
    """Takes in neither split, such as repeats on another day without a torque signal. Often empty."""
