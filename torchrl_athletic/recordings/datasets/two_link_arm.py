"""Two-link arm: the double pendulum of DFKI's underactuated robotics lab, design A.0."""

from __future__ import annotations

import gzip
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from torchrl_athletic.recordings.datasets.dataset import Dataset
from torchrl_athletic.recordings.fetch import fetch
from torchrl_athletic.recordings.recording import Recording
from torchrl_athletic.robots.benches import two_link_arm

NOTES = """\
Vertical double pendulum on two AK80-6 drives (gear 6), links of 0.3 m and 0.2 m, 500 Hz with jitter to 3.8 ms.
Source: github.com/dfki-ric-underactuated-lab/double_pendulum, data/experiment_records/design_A.0.
Licence: BSD-3-Clause.
Start: the published links alone (model_2.1), without rotor inertia and without friction.
Split: the six takes with a sine on both motors are for fitting; kept aside are the swing-up by a trajectory controller
and the two takes where the elbow alone is driven. torque_command is what was asked for, torque_measured comes from the
motor current.
Extra: three open-loop takes of three days earlier that log no torque (two of them repeat the command of trajectory_00
and trajectory_01: metadata 'repeat'), and 10 s of standstill at 200 Hz, which shows the noise of the sensors.
Odd: the drive follows its command late."""

BOTH = "open-loop sines on both joints"
EXCITATION = {
    "trajectory_00": BOTH,
    "trajectory_01": BOTH,
    "trajectory_02": BOTH,
    "trajectory_03": BOTH,
    "trajectory_04": BOTH + ", the lower link goes over the top",
    "trajectory_05": BOTH + ", the lower link goes over the top",
    "trajectory_11": "swing-up by a trajectory-tracking controller",
    "trajectory_12": "open-loop sines on the elbow",
    "trajectory_13": "open-loop sines on the elbow",
}
HELD_OUT = ("trajectory_11", "trajectory_12", "trajectory_13")
SAME_COMMAND = {
    "trajectory_00": "00",
    "20220812-055032-PM_measured": "00",
    "trajectory_01": "01",
    "20220812-055640-PM_measured": "01",
}


def load() -> Dataset:
    """Torque, position and velocity of both joints: six takes to fit, three of another kind kept aside."""
    folder = fetch("two_link_arm")
    takes = {name: _recording(folder / "20220815" / f"{name}.csv.gz", kind) for name, kind in EXCITATION.items()}
    return Dataset(
        name="two_link_arm",
        model=two_link_arm(),
        recordings=[take for name, take in takes.items() if name not in HELD_OUT],
        heldout=[takes[name] for name in HELD_OUT],
        notes=NOTES,
        extra=[
            *(_commanded_only(path) for path in sorted((folder / "20220812").glob("*.csv.gz"))),
            _recording(folder / "20220815" / "noise" / "velocity_measurement" / "trajectory.csv.gz", "standstill"),
        ],
    )


def _recording(path: Path, excitation: str) -> Recording:
    column = _read(path)
    return Recording(
        time=column["time"],
        joint_names=("shoulder", "elbow"),
        position=_both(column, "pos_meas"),
        velocity=_both(column, "vel_meas"),
        torque_command=_both(column, "tau_con"),
        torque_measured=_both(column, "tau_meas"),
        torque_semantics="current_derived",
        metadata=_metadata(path, excitation),
        source=path.name,
    )


def _commanded_only(path: Path) -> Recording:
    column = _read(path)
    return Recording(
        time=column["time"],
        joint_names=("shoulder", "elbow"),
        position=_both(column, "pos"),
        velocity=_both(column, "vel"),
        torque_command=_both(column, "tau"),
        metadata=_metadata(path, BOTH),
        source=path.name,
    )


def _metadata(path: Path, excitation: str) -> dict[str, Any]:
    name = path.name.removesuffix(".csv.gz")
    repeat = {"repeat": SAME_COMMAND[name]} if name in SAME_COMMAND else {}
    return {"robot": "two_link_arm design A.0", "excitation": excitation, **repeat}


def _read(path: Path) -> NDArray[Any]:
    with gzip.open(path, "rt") as file:
        columns: NDArray[Any] = np.genfromtxt(file, delimiter=",", names=True)
    return columns


def _both(column: NDArray[Any], name: str) -> NDArray[np.float64]:
    return np.column_stack((column[f"{name}1"], column[f"{name}2"]))
