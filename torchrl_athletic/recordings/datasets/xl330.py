"""Dynamixel XL330 on the pendulum bench of BAM, "better actuator models"."""

from __future__ import annotations

import gzip
import json
from pathlib import Path
from typing import Any

import numpy as np

from torchrl_athletic.recordings.datasets.dataset import Dataset
from torchrl_athletic.recordings.fetch import fetch
from torchrl_athletic.recordings.recording import Recording
from torchrl_athletic.robots.benches import xl330_pendulum

NOTES = """\
XL330 servo in position mode with a point mass of 0.49 kg at 0.1 m: four motions at each of four firmware gains, 6 s
each, resampled by the source to 200 Hz.
Source: github.com/Rhoban/bam at af2260462471, bam/data.bak/processed; Duclusaud, Passault et al. 2024,
arXiv:2410.08650. Licence: Apache-2.0.
Start: the published Coulomb-viscous model m1, with the firmware's law: duty cycle = P * ERROR_GAIN * (goal - position),
torque = kt / R * (7.4 V * duty cycle - kt * velocity), hence kp and kd; the duty cycle ends at 1, hence the limit.
Split: firmware gains 100, 200 and 800 are for fitting, 400 is kept aside.
'lift_and_drop' switches the motor off after 2 s: what follows is a take of its own, without torque and back-EMF.
Odd: the supply sags from 7.4 V to 5.8 V under load (metadata 'supply_voltage'), which a constant kp cannot know. And
the source's own integrator damps: it adds a dt²/2 to a step that is already semi-implicit, which acts here like a
viscous friction of 0.0012 N·m·s/rad. m1 was fitted through it, so that its mean absolute error over all takes is
0.082 rad there and 0.086 rad in MuJoCo."""

KT = 0.3866957639281311
"""Torque constant [N·m/A, V·s/rad], of m1."""
RESISTANCE = 4.017129222290597
"""[Ω], of m1."""
ERROR_GAIN = 4096 / (2 * np.pi) / (256 * 885)
"""Duty cycle per radian and unit of firmware gain [1/rad]: 4096 counts a turn, 885 for full duty, and a divisor that
BAM observed to be 256 where the manual says 128."""
HELD_OUT_GAIN = 400
"""Firmware gain P of the takes that are kept aside [1]."""


def load() -> Dataset:
    """Position targets and angles: three firmware gains to fit, one kept aside."""
    recordings: list[Recording] = []
    heldout: list[Recording] = []
    for path in sorted(fetch("xl330_bench").glob("*.json.gz")):
        with gzip.open(path, "rt") as file:
            log = json.load(file)
        (heldout if log["kp"] == HELD_OUT_GAIN else recordings).extend(_takes(log, path))
    return Dataset(name="xl330", model=xl330_pendulum(), recordings=recordings, heldout=heldout, notes=NOTES, extra=[])


def _takes(log: dict[str, Any], path: Path) -> list[Recording]:
    entries = log["entries"]
    off = next((k for k, entry in enumerate(entries) if not entry["torque_enable"]), len(entries))
    takes = [_driven(log, entries[:off], path)]
    if off < len(entries):
        takes.append(_free_swing(log, entries[off:], path))
    return takes


def _driven(log: dict[str, Any], entries: list[dict[str, Any]], path: Path) -> Recording:
    return Recording(
        **_motion(entries),
        position_target=_column(entries, "goal_position"),
        kp=np.array([KT / RESISTANCE * log["vin"] * log["kp"] * ERROR_GAIN]),
        kd=np.array([KT**2 / RESISTANCE]),
        metadata=_metadata(log, entries),
        source=path.name,
    )


def _free_swing(log: dict[str, Any], entries: list[dict[str, Any]], path: Path) -> Recording:
    return Recording(
        **_motion(entries),
        torque_command=np.zeros((len(entries), 1)),
        metadata={**_metadata(log, entries), "excitation": "free swing, motor off"},
        source=path.name,
    )


def _motion(entries: list[dict[str, Any]]) -> dict[str, Any]:
    return {
        "time": _column(entries, "timestamp").ravel(),
        "joint_names": ("pendulum",),
        "position": _column(entries, "position"),
        "velocity": _column(entries, "speed"),
    }


def _metadata(log: dict[str, Any], entries: list[dict[str, Any]]) -> dict[str, Any]:
    supply = _column(entries, "input_volts")
    return {
        "robot": "xl330_bench",
        "excitation": log["trajectory"],
        "payload": log["mass"],
        "firmware_kp": log["kp"],
        "supply_voltage": {"nominal": log["vin"], "mean": float(supply.mean()), "min": float(supply.min())},
    }


def _column(entries: list[dict[str, Any]], name: str) -> np.ndarray:
    return np.array([[entry[name]] for entry in entries], dtype=np.float64)
