"""Unbalanced disk: the teaching set-up of TU Eindhoven, driven by a voltage."""

from __future__ import annotations

import numpy as np

from torchrl_athletic.recordings.datasets.dataset import Dataset
from torchrl_athletic.recordings.fetch import fetch
from torchrl_athletic.recordings.recording import Recording
from torchrl_athletic.robots.benches import DISK_TORQUE_PER_VOLT, unbalanced_disk

NOTES = """\
Disk with an off-centre mass on a DC motor, encoder of 2000 counts a turn, 875 s of multisine voltage at 40 Hz.
Source: github.com/GerbenBeintema/gym-unbalanced-disk, disc-benchmark-files/training-val-test-data.npz.
Licence: BSD-3-Clause.
Start: the parameters of the source's own simulator, without any delay. torque_command is the voltage times Ku J.
Split: the first 4000 samples are for fitting, the 31 000 after them are kept aside. This is not the benchmark's hidden
test, whose angles are not public.
Odd: 25 ms between samples, so that a delay of one sample is all that can be told apart; no velocity channel. The source
does not say in words that the angles are measured; the encoder step says so."""

RATE = 40.0
"""[Hz]"""
FIT_SAMPLES = 4000


def load() -> Dataset:
    """Torque and angle of the disk: the first 100 s to fit, the other 775 s kept aside."""
    path = fetch("unbalanced_disk") / "training-val-test-data.npz"
    with np.load(path, allow_pickle=False) as file:
        voltage, angle = file["u"], file["th"]
    take = Recording(
        time=np.arange(len(angle)) / RATE,
        joint_names=("disk",),
        position=angle[:, None],
        torque_command=DISK_TORQUE_PER_VOLT * voltage[:, None],
        metadata={
            "robot": "unbalanced_disk",
            "excitation": "multisine voltage",
            "torque_per_volt": DISK_TORQUE_PER_VOLT,
        },
        source=path.name,
    )
    return Dataset(
        name="unbalanced_disk",
        model=unbalanced_disk(),
        recordings=[take.slice(0, FIT_SAMPLES)],
        heldout=[take.slice(FIT_SAMPLES, take.num_samples)],
        notes=NOTES,
        extra=[],
    )
