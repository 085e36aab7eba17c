"""Joints of one degree of freedom by name, and where they are in ``qpos`` and ``qvel``."""

from __future__ import annotations

from collections.abc import Sequence

import mujoco
import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

Columns = slice | Tensor
"""Columns of a (N, ...) tensor: a slice, which is quick and a view, where they follow one another."""


def driven_joints(model: mujoco.MjModel) -> tuple[str, ...]:
    """Hinges and slides in the order of the actuators that turn them; all of them if no actuator acts on a joint.

    An actuator without an input is friction or cogging, and turns none.
    """
    on_joint = (model.actuator_trntype == mujoco.mjtTrn.mjTRN_JOINT) & (model.actuator_ctrlnum > 0)
    driven = [name for j in model.actuator_trnid[on_joint, 0] if (name := model.joint(int(j)).name) in _known(model)]
    return tuple(dict.fromkeys(driven)) or tuple(_known(model))


def joint_columns(model: mujoco.MjModel, names: Sequence[str]) -> tuple[Columns, Columns]:
    """Columns of the joints in ``qpos`` and in ``qvel``.

    Raises:
        ValueError: If the model has no such hinge or slide, or a name comes twice, since one force would be lost.
    """
    unknown = [name for name in names if name not in _known(model)]
    if unknown:
        raise ValueError(f"the model has no hinge or slide {unknown[0]!r}; it has {_known(model)}.")
    if len(set(names)) < len(names):
        raise ValueError(f"joint_names {tuple(names)} must name each joint once.")
    joints = [model.joint(name).id for name in names]
    return _columns(model.jnt_qposadr[joints]), _columns(model.jnt_dofadr[joints])


def floating_heights(model: mujoco.MjModel) -> list[int]:
    """Columns of ``qpos`` that hold the height of a body with a free joint."""
    free = model.jnt_type == mujoco.mjtJoint.mjJNT_FREE.value
    return [int(first) + 2 for first in model.jnt_qposadr[free]]


def _known(model: mujoco.MjModel) -> list[str]:
    one_dof = (mujoco.mjtJoint.mjJNT_HINGE.value, mujoco.mjtJoint.mjJNT_SLIDE.value)
    return [model.joint(j).name for j in range(model.njnt) if model.jnt_type[j] in one_dof and model.joint(j).name]


def _columns(address: NDArray[np.int32]) -> Columns:
    if address.size and (np.diff(address) == 1).all():
        return slice(int(address[0]), int(address[-1]) + 1)
    return torch.from_numpy(address.astype(np.int64))
