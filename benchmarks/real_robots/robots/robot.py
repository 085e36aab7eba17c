"""A robot's model and its recordings, and what several loaders need."""

from __future__ import annotations

import csv
import json
import re
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path

import mujoco
import numpy as np
from numpy.typing import NDArray

from torchrl_athletic.recordings import Recording

Array = NDArray[np.float64]

LOOKED = "yes, held-out part too"
"""Of :attr:`Robot.looked_at`, where no part was left unseen."""
UNSEEN = "not before its first fit"
"""Of :attr:`Robot.looked_at`, of a robot that was new to the program."""


@dataclass(frozen=True, eq=False)
class Robot:
    """A model and its recordings."""

    xml: str
    recordings: Sequence[Recording]
    heldout: Sequence[Recording]
    looked_at: str
    """Whether the program was changed while looking at it."""
    unit: str = "rad"
    model_of: Callable[[Recording], mujoco.MjModel] | None = None
    """Model with what a recording carried; None where all are of :attr:`xml`."""


def without_shapes(path: Path) -> str:
    """MJCF of a model with the masses that its shapes gave it, and without the shapes."""
    spec = mujoco.MjSpec.from_file(str(path))
    model = spec.compile()
    for body in spec.bodies[1:]:
        k = model.body(body.name).id
        body.explicitinertial = True
        body.mass, body.ipos, body.iquat = model.body_mass[k], model.body_ipos[k], model.body_iquat[k]
        body.inertia, body.fullinertia = model.body_inertia[k], np.full(6, np.nan)
    delete_shapes(spec)
    spec.compile()
    return str(spec.to_xml())


def arm_of(urdf: str) -> mujoco.MjSpec:
    """A URDF's links with a motor at each joint, without its shapes."""
    plain = re.sub(
        r"<(visual|collision)>.*?</\1>|<xacro:[^>]*/>|<transmission .*?</transmission>", "", urdf, flags=re.S
    )
    spec = mujoco.MjSpec.from_string(plain.strip())
    add_motors(spec)
    spec.compile()
    return spec


def add_motors(spec: mujoco.MjSpec) -> None:
    """A motor for each joint of a URDF, which gives what the joint allows."""
    for joint in spec.joints:
        motor = spec.add_actuator(name=joint.name, target=joint.name, trntype=mujoco.mjtTrn.mjTRN_JOINT)
        motor.set_to_motor()
        motor.forcelimited, motor.forcerange = True, joint.actfrcrange


def delete_shapes(spec: mujoco.MjSpec) -> None:
    for shape in (*spec.geoms, *spec.meshes, *spec.materials, *spec.textures):
        spec.delete(shape)


def cells(path: Path, column: str) -> Array:
    """A column whose cells are numbers or lists of numbers. Shape (T, ...)."""
    with path.open() as file:
        return np.array([np.atleast_1d(json.loads(row[column])) for row in csv.DictReader(file)], dtype=np.float64)
