r"""The base of a floating robot, whose motion is prescribed: it was recorded, or it was held still.

The joints move relative to it. What gravity and the base's own motion ask of them stands in the rows of the joints,

.. math:: M_{jj} \ddot q_j + M_{jb}\, a_b + c_j(q, v) = \tau_j,

and the rows of the base, with the forces that carry it, are left out: nobody recorded them. In simulation the base is
so heavy that nothing disturbs it, and is pushed as it was accelerated.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Literal

import mujoco
import numpy as np
from numpy.typing import NDArray
from scipy.interpolate import CubicSpline
from scipy.ndimage import gaussian_filter1d

from torchrl_athletic.recordings.base import base_pose
from torchrl_athletic.recordings.recording import Recording, RecordingError

Array = NDArray[np.float64]
Base = Literal["recorded", "fixed"]
"""Whether the base of a floating robot moves as recorded, or stands where the model has it."""

HEAVY = 1e8
"""Inertia that carries a base in simulation, per its own: its joints disturb its acceleration by a 1e-8 of theirs."""
TOLERANCE = 1e-16
"""Tolerance of the solver: at its default of 1e-8 it stops before the small friction of a leg is found."""
APART = -1e6
"""Margin of a pair of geoms that never meets [m]."""


@dataclass(frozen=True, eq=False)
class BaseMotion:
    """How the base moves at N instants, in MuJoCo's convention for free joints."""

    pose: Array
    """Position in the world [m], and unit quaternion w, x, y, z. Shape (N, 7)."""
    velocity: Array
    """Linear in the world [m/s], and angular in the body's frame [rad/s]. Shape (N, 6)."""
    acceleration: Array
    """Its rate, number by number. Shape (N, 6)."""

    def __getitem__(self, at: slice | NDArray[np.intp]) -> BaseMotion:
        """At some of the instants."""
        return BaseMotion(self.pose[at], self.velocity[at], self.acceleration[at])

    def moved(self, convert: Callable[[Array], Array]) -> BaseMotion:
        """With each of its numbers resampled; the quaternion is made a unit again."""
        pose, velocity, acceleration = (convert(x) for x in (self.pose, self.velocity, self.acceleration))
        turn = pose[..., 3:] / np.linalg.norm(pose[..., 3:], axis=-1, keepdims=True)
        return BaseMotion(np.concatenate([pose[..., :3], turn], -1), velocity, acceleration)

    @property
    def at_rest(self) -> BaseMotion:
        """In the same poses, without moving."""
        still = np.zeros_like(self.velocity)
        return BaseMotion(self.pose, still, still)

    @classmethod
    def joined(cls, motions: list[BaseMotion]) -> BaseMotion:
        """One after the other."""
        return cls(*(np.concatenate([getattr(m, n) for m in motions]) for n in ("pose", "velocity", "acceleration")))


def free_joint(model: mujoco.MjModel) -> int | None:
    """The first that carries other joints; None if there is none, and the robot is bolted to the world."""
    free = model.jnt_type == mujoco.mjtJoint.mjJNT_FREE
    roots = set(model.body_rootid[model.jnt_bodyid[~free]].tolist())
    return next((int(j) for j in np.flatnonzero(free) if int(model.jnt_bodyid[j]) in roots), None)


def held_base(recording: Recording, model: mujoco.MjModel) -> Recording:
    """The recording with the base of a floating robot where the model has it; itself if that is bolted to the world."""
    joint = free_joint(model)
    if joint is None:
        return recording
    at = int(model.jnt_qposadr[joint])
    return recording.with_base_held(model.qpos0[at : at + 3], model.qpos0[at + 3 : at + 7])


def base_columns(model: mujoco.MjModel) -> tuple[slice, slice]:
    """Columns of a floating base in ``qpos`` and in ``qvel``; empty ones if the base is bolted to the world."""
    joint = free_joint(model)
    if joint is None:
        return slice(0, 0), slice(0, 0)
    q, v = int(model.jnt_qposadr[joint]), int(model.jnt_dofadr[joint])
    return slice(q, q + 7), slice(v, v + 6)


def pose_of(recording: Recording, model: mujoco.MjModel) -> Array | None:
    """Recorded pose of the model's base, of a sign that never flips. Shape (T, 7); None if it is bolted to the world.

    Raises:
        RecordingError: If the model floats and the recording does not say where, or the other way round.
    """
    pose, joint = base_pose(recording), free_joint(model)
    if joint is None and pose is not None:
        raise RecordingError(
            f"{recording.source}: base_position was recorded, but the base of the model is bolted to the world. Give "
            "its trunk a <freejoint/>, or leave base_position and base_orientation out."
        )
    if joint is not None and pose is None:
        name = model.joint(joint).name or model.body(int(model.jnt_bodyid[joint])).name
        raise RecordingError(
            f"{recording.source}: the base of the model floats (free joint {name!r}), and base_position and "
            "base_orientation were not recorded. If it was clamped or hung still with its legs in the air, say so: "
            "base='fixed' (--base fixed), or Recording.with_base_held at its pose. Else record its pose."
        )
    return pose


def base_motion(recording: Recording, model: mujoco.MjModel, time: Array, width: float) -> BaseMotion | None:
    """The recorded base along a Gaussian test function, as the joints are.

    Args:
        recording: One gap-free take.
        model: With a free joint, or without.
        time: Even stamps within the take [s]. Shape (N,).
        width: Standard deviation of the test function [s].

    Returns:
        None if the model's base is bolted to the world.
    """
    pose = pose_of(recording, model)
    if pose is None:
        return None
    step = float(time[1] - time[0])
    fine = CubicSpline(recording.time, pose)(time)
    x, rate, second = (_smooth(fine, width / step, order) / step**order for order in range(3))
    turn, spin = x[:, 3:], rate[:, 3:]
    square, velocity = (turn**2).sum(1, keepdims=True), base_velocity(x, rate)
    faster = _vector_part(turn, second[:, 3:]) - (turn * spin).sum(1, keepdims=True) * velocity[:, 3:]
    unit = np.hstack([x[:, :3], turn / np.sqrt(square)])
    return BaseMotion(unit, velocity, np.hstack([second[:, :3], 2 * faster / square]))


def base_velocity(pose: Array, rate: Array) -> Array:
    """Velocity of a free joint, from the seven numbers of its pose and their rates. The quaternion has any length.

    Args:
        pose: Shape (N, 7).
        rate: Shape (N, 7).

    Returns:
        Linear in the world [m/s], angular in the body's frame [rad/s]. Shape (N, 6).

    Example:
        >>> half = np.pi / 4  # a quarter turn about z, at 2 rad/s
        >>> pose = np.array([[0, 0, 0, np.cos(half), 0, 0, np.sin(half)]])
        >>> rate = np.array([[0, 0, 1, -np.sin(half), 0, 0, np.cos(half)]])
        >>> base_velocity(pose, rate).round(3).tolist()
        [[0.0, 0.0, 1.0, 0.0, 0.0, 2.0]]
    """
    turn, spin = pose[:, 3:], rate[:, 3:]
    return np.hstack([rate[:, :3], 2 * _vector_part(turn, spin) / (turn**2).sum(1, keepdims=True)])


def carried(model: mujoco.MjModel) -> mujoco.MjModel:
    """The model with a base that only its own motion moves: heavy, and clear of what stands in the world.

    The same model if its base is bolted to the world. Robots in the air touch nothing but themselves; the floor of a
    model may be elsewhere than that of the laboratory.
    """
    if free_joint(model) is None:
        return model
    model = model.__copy__()
    _, dof = base_columns(model)
    mass = np.zeros((model.nv, model.nv))
    data = mujoco.MjData(model)
    mujoco.mj_forward(model, data)
    mujoco.mj_fullM(model, data, mass)
    model.dof_armature[dof] = HEAVY * (np.diag(mass) - model.dof_armature)[dof]
    mujoco.mj_setConst(model, mujoco.MjData(model))
    model.opt.tolerance = min(model.opt.tolerance, TOLERANCE)
    _refuse_ties(model)
    standing = model.body_weldid[model.geom_bodyid] == 0
    model.geom_contype[standing] = model.geom_conaffinity[standing] = 0
    model.pair_margin[standing[model.pair_geom1] | standing[model.pair_geom2]] = APART
    return model


def _refuse_ties(model: mujoco.MjModel) -> None:
    """Refuse constraints between the base and the world, which no inertia withstands."""
    joint = free_joint(model)
    trunk = int(model.body_weldid[model.jnt_bodyid[joint]])
    for k in range(model.neq):
        if model.eq_objtype[k] != mujoco.mjtObj.mjOBJ_BODY or not model.eq_active0[k]:
            continue
        ends = {int(model.body_weldid[model.eq_obj1id[k]]), int(model.body_weldid[model.eq_obj2id[k]])}
        if ends == {0, trunk}:
            raise RecordingError(
                f"equality {model.equality(k).name or k!r} of the model ties {model.body(trunk).name!r} to the world, "
                "and the base is prescribed by the recordings. Take the equality out of the model."
            )


def _vector_part(turn: Array, other: Array) -> Array:
    """Vector part of the product of a conjugated quaternion with another, w, x, y, z. Shapes (N, 4) to (N, 3)."""
    w, v = turn[:, :1], turn[:, 1:]
    return np.asarray(w * other[:, 1:] - other[:, :1] * v - np.cross(v, other[:, 1:]), dtype=np.float64)


def _smooth(x: Array, width: float, order: int) -> Array:
    """Project on a Gaussian or its derivative. Beyond its ends the motion goes on as it came, turned by half a turn."""
    reach = min(int(7 * width + 0.5), len(x) - 1)
    longer = np.pad(x, ((reach, reach), (0, 0)), mode="reflect", reflect_type="odd")
    return np.asarray(gaussian_filter1d(longer, width, axis=0, order=order, truncate=7.0)[reach : -reach or None])
