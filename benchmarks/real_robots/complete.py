"""Arms of several joints with a hand fit in their models, so that physics can be concealed in them.

Their published models lack friction and rotors, or hold such that make every error longer. So the numbers below were
found by :func:`benchmarks.real_robots.rivals.by_hand`, which shares nothing with our fit but MuJoCo: on 100 windows of
the double pendulum's six takes, 60 of AIRBOT's five, of which three are fitted here, and 60 of eight of the SO-101.
Those of the UR10e are our own fit's, of three takes of other days, since by hand its last wrist sticks. An empty arm
does not show the gains of its last two wrists: they are the published ones, and the rest there is scaled with them.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from pathlib import Path

import mujoco
import numpy as np

from benchmarks.real_robots.robots.arms import airbot, so101, ur10e_empty, ur10e_loaded
from benchmarks.real_robots.robots.benches import double_pendulum
from benchmarks.real_robots.robots.robot import Robot
from torchrl_athletic.recordings import Recording

MOTIONS = (
    "multisine", "prbs_excitation", "frequency_sweep", "large_amplitude",
    "random_waypoints", "step_response", "inertia_coupling", "sinusoidal_sweep",
)  # fmt: skip
"""Of the SO-101, that the hand fit used; the diagnosis has the first four."""


@dataclass(frozen=True)
class HandFit:
    """Numbers of each joint, in the order of the recordings' joints."""

    frictionloss: tuple[float, ...]
    """[N m]."""
    damping: tuple[float, ...]
    """[N m s/rad]."""
    armature: tuple[float, ...]
    """[kg m²]."""
    torque: tuple[float, ...] | None = None
    """Torque per logged torque."""
    stiffness: tuple[float, ...] | None = None
    """Gain per logged gain."""


def _double_pendulum(data: Path) -> Robot:
    return double_pendulum(data, "C.1")


def _airbot(data: Path) -> Robot:
    robot = airbot(data, second=True)
    return replace(robot, recordings=robot.recordings[:3], heldout=robot.heldout[:2])


def _so101(data: Path) -> Robot:
    robot = so101(data)
    return replace(robot, recordings=[r for r in robot.recordings if r.source in MOTIONS[:4]])


ARMS: Mapping[str, tuple[Callable[[Path], Robot], HandFit]] = {
    "double_pendulum": (
        _double_pendulum,
        HandFit(
            frictionloss=(0.2348, 0.1821),
            damping=(0.005428, 0.001751),
            armature=(0.003944, 0.004766),
            torque=(0.9731, 1.091),
        ),
    ),
    "airbot": (
        _airbot,
        HandFit(
            frictionloss=(0.09179, 0.0, 0.0, 0.0, 0.06485, 0.06177),
            damping=(0.0966, 0.69, 0.3222, 0.0, 0.0, 0.00506),
            armature=(1.431, 4.541, 2.456, 0.243, 0.02019, 0.008353),
            torque=(2.279, 2.244, 2.337, 0.6487, 0.94, 0.8557),
        ),
    ),
    "so101": (
        _so101,
        HandFit(
            frictionloss=(0.5385, 2.293, 2.74, 0.7669, 1.488, 0.1909),
            damping=(0.7461, 0.0, 0.0, 0.7085, 1.814, 1.153),
            armature=(0.06562, 0.01577, 0.001779, 0.0368, 0.0003751, 0.1292),
            stiffness=(0.05, 0.05, 0.05, 0.05, 0.0837, 0.05),
        ),
    ),
    "ur10e": (
        ur10e_empty,
        HandFit(
            frictionloss=(15.79, 18.19, 7.166, 2.233, 2.919, 2.54),
            damping=(19.48, 18.36, 6.496, 2.682, 2.219, 2.862),
            armature=(5.242, 7.462, 1.83, 0.4264, 0.404, 0.4266),
            torque=(1.068, 1.107, 0.9938, 0.919, 1.0, 1.0),
        ),
    ),
}


def complete_arm(name: str, data: Path) -> Robot:
    """An arm with its hand fit: friction and rotors in the model, scales in the recordings.

    Args:
        name: Of :data:`ARMS`.
        data: Folder of clones, see :mod:`benchmarks.real_robots.robots`.

    Example:
        >>> complete_arm("airbot", Path("clones")).recordings[0].num_joints  # doctest: +SKIP
        6
    """
    load, fitted = ARMS[name]
    return _completed(load(data), fitted)


def loaded_arm(data: Path, harmonics: int) -> Robot:
    """The complete UR10e with a take of 14 or 15 harmonics in which it carries 2.805 kg that the model lacks.

    Args:
        data: Folder of clones, see :mod:`benchmarks.real_robots.robots`.
        harmonics: Of the motion.
    """
    return _completed(ur10e_loaded(data, harmonics), ARMS["ur10e"][1])


def _completed(robot: Robot, fitted: HandFit) -> Robot:
    spec = mujoco.MjSpec.from_string(robot.xml)
    for k, joint in enumerate(robot.recordings[0].joint_names):
        found = spec.joint(joint)
        found.frictionloss, found.armature = fitted.frictionloss[k], fitted.armature[k]
        found.damping[0] = fitted.damping[k]
    spec.compile()
    fit, aside = ([_scaled(r, fitted) for r in group] for group in (robot.recordings, robot.heldout))
    return replace(robot, xml=spec.to_xml(), recordings=fit, heldout=aside)


def _scaled(recording: Recording, fitted: HandFit) -> Recording:
    if fitted.torque is not None:
        assert recording.torque_command is not None
        recording = replace(recording, torque_command=recording.torque_command * np.array(fitted.torque))
    if fitted.stiffness is not None:
        assert recording.kp is not None
        recording = replace(recording, kp=recording.kp * np.array(fitted.stiffness))
    return recording
