"""Torque-limited simple pendulum of DFKI's underactuated robotics lab, swung up by several controllers."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from torchrl_athletic.recordings.datasets.dataset import Dataset
from torchrl_athletic.recordings.fetch import fetch
from torchrl_athletic.recordings.recording import Recording
from torchrl_athletic.robots.benches import pendulum

NOTES = """\
Point mass of 0.546 kg at 0.5 m on a rod, AK80-6 drive.
Source: github.com/dfki-ric-underactuated-lab/torque_limited_simple_pendulum, results/*/data_{measured,desired}.csv;
Wiebe et al. 2022, doi:10.21105/joss.03884. Licence: BSD-3-Clause.
Start: the geometry alone, no rotor and no friction.
Split: the swing-up planned by DDP (6 s, 500 Hz) is for fitting, the one planned by direct collocation (3.5 s, 333 Hz)
is kept aside.
Extra: iLQR (50 Hz, turns over several times) and the PD run made for identification (its velocity feedback chatters at
up to 17 N·m, which 300 Hz cannot resolve): hard and unclean.
torque_command is the torque from the motor's current wherever the drive's own position loop was on: the source logs
only the feed-forward part of such commands. For iLQR, which commands torque alone, it is the command that was logged.
Odd: the published parameters contradict each other (m l of 0.10 kg·m against 0.30 kg·m from the geometry), and the run
by direct collocation went 11 % faster than its plan."""

FEEDBACK_IN_DRIVE = ("ddp", "direct_collocation", "pd_identification")


def load() -> Dataset:
    """Torque, position and velocity: one controller to fit, another kept aside."""
    return Dataset(
        name="pendulum",
        model=pendulum(),
        recordings=[_recording("ddp", "swing-up planned by DDP")],
        heldout=[_recording("direct_collocation", "swing-up planned by direct collocation")],
        notes=NOTES,
        extra=[
            _recording("ilqr", "swing-up by iLQR, model-predictive"),
            _recording("pd_identification", "planned swing-up followed by PD control"),
        ],
    )


def _recording(run: str, excitation: str) -> Recording:
    folder = fetch("pendulum") / run
    measured = _read(folder / "data_measured.csv")
    metadata = {"robot": "torque_limited_simple_pendulum", "excitation": excitation}
    if run in FEEDBACK_IN_DRIVE:
        return Recording(
            time=measured["time"],
            joint_names=("pendulum",),
            position=measured["position"][:, None],
            velocity=measured["velocity"][:, None],
            torque_command=measured["torque"][:, None],
            metadata={**metadata, "torque_command": "from motor current"},
            source=f"{run}/data_measured.csv",
        )
    return Recording(
        time=measured["time"],
        joint_names=("pendulum",),
        position=measured["position"][:, None],
        velocity=measured["velocity"][:, None],
        torque_command=_read(folder / "data_desired.csv")["torque"][:, None],
        torque_measured=measured["torque"][:, None],
        torque_semantics="current_derived",
        metadata=metadata,
        source=f"{run}/data_measured.csv",
    )


def _read(path: Path) -> NDArray[Any]:
    columns: NDArray[Any] = np.genfromtxt(path, delimiter=",", names=True)
    return columns
