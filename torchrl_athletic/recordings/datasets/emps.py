"""EMPS: a carriage on a ball screw, from the public benchmark of nonlinear system identification."""

from __future__ import annotations

from pathlib import Path

from scipy.io import loadmat

from torchrl_athletic.recordings.datasets.dataset import Dataset
from torchrl_athletic.recordings.fetch import fetch
from torchrl_athletic.recordings.recording import Recording
from torchrl_athletic.robots.benches import slider

NOTES = """\
Electro-mechanical positioning system of ONERA and LS2N: motor, ball screw, carriage, encoder of 50 000 counts a turn.
Source: Janot, Gautier, Brunot 2019, https://www.nonlinearbenchmark.org, by way of
github.com/forgi86/sysid-neural-continuous. Licence: that repository is Apache-2.0; the data are the public benchmark.
Start: the published Coulomb-viscous model. Its constant offset of -3.1648 N is kept, as a rail that leans 0.19 degrees.
Split: one position profile for fitting; the same profile disturbed by pulses of 5 V is kept aside. 24.8 s each, 1 kHz.
Odd: both takes are closed loop; there is no velocity channel, and the carriage already moves at 7 mm/s at the start.
The voltage of the pulses file already contains the pulses, so that force = gtau * voltage in both.
The pulses excite a flexibility of the screw that a rigid carriage cannot follow."""


def load() -> Dataset:
    """Force and position of the carriage, one take to fit and one with pulses kept aside."""
    folder = fetch("emps")
    return Dataset(
        name="emps",
        model=slider(),
        recordings=[_recording(folder / "DATA_EMPS.mat", "position profile, closed loop")],
        heldout=[_recording(folder / "DATA_EMPS_PULSES.mat", "position profile with force pulses, closed loop")],
        notes=NOTES,
        extra=[],
    )


def _recording(path: Path, excitation: str) -> Recording:
    mat = loadmat(path)
    return Recording(
        time=mat["t"].ravel(),
        joint_names=("carriage",),
        position=mat["qm"],
        torque_command=mat["gtau"].item() * mat["vir"],
        metadata={"robot": "emps", "excitation": excitation, "torque_unit": "N"},
        source=path.name,
    )
