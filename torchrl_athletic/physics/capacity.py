"""How many contacts and constraints a model may come to need, where memory for them is set aside beforehand."""

from __future__ import annotations

import mujoco
import numpy as np
from numpy.typing import NDArray

from torchrl_athletic.physics.joints import floating_heights

_POSES = 64
_STEPS = 60
_MARGIN = 1.5
_GROUND = (mujoco.mjtGeom.mjGEOM_PLANE.value, mujoco.mjtGeom.mjGEOM_HFIELD.value)


def estimate_capacity(model: mujoco.MjModel, seed: int = 0) -> tuple[int, int]:
    """Contacts and constraint rows to set aside for each env.

    Half as many again as was ever needed by 64 falls: from the default pose and the keyframes, then from joints
    anywhere in their ranges and free bodies at their height or lower, in any attitude, lifted out of what they are in,
    without any control. Pairs of geoms whose bounding spheres touch count as contacts, since the search for contacts
    keeps a list of them of the same length.

    Args:
        model: What will be simulated.
        seed: Of the poses.

    Returns:
        Contacts and constraint rows per env, multiples of eight.

    Example:
        >>> box = mujoco.MjModel.from_xml_string("<mujoco><worldbody><geom type='plane' size='1 1 1'/>"
        ...     "<body pos='0 0 .1'><freejoint/><geom type='box' size='.1 .1 .1'/></body></worldbody></mujoco>")
        >>> contacts, rows = estimate_capacity(box)
        >>> contacts >= 4 and rows >= 16  # four corners, four faces of a pyramid each
        True
    """
    rng, data = np.random.default_rng(seed), mujoco.MjData(model)
    poses = [model.qpos0, *model.key_qpos]
    poses += [_random_pose(model, poses[i % len(poses)], rng) for i in range(_POSES - len(poses))]
    contacts, rows = 1, 1
    for pose in poses:
        mujoco.mj_resetData(model, data)
        data.qpos[:] = pose
        _lift(model, data)
        for _ in range(_STEPS):
            mujoco.mj_step(model, data)
            contacts, rows = max(contacts, data.ncon, _close_pairs(model, data)), max(rows, data.nefc)
    return _rounded(contacts), _rounded(rows)


def _rounded(count: int) -> int:
    return 8 * int(np.ceil(_MARGIN * count / 8))


def _random_pose(model: mujoco.MjModel, near: NDArray[np.float64], rng: np.random.Generator) -> NDArray[np.float64]:
    pose = near.copy()
    for kind, at, limits in zip(model.jnt_type, model.jnt_qposadr, model.jnt_range, strict=True):
        if kind == mujoco.mjtJoint.mjJNT_FREE:
            pose[at + 2] *= rng.uniform(0.2, 1)
            pose[at + 3 : at + 7] = rng.normal(size=4)
        elif kind == mujoco.mjtJoint.mjJNT_BALL:
            pose[at : at + 4] = rng.normal(size=4)
        else:
            low, high = limits if limits[0] < limits[1] else (pose[at] - np.pi, pose[at] + np.pi)
            pose[at] = rng.uniform(low, high)
    mujoco.mj_normalizeQuat(model, pose)
    return pose


def _lift(model: mujoco.MjModel, data: mujoco.MjData) -> None:
    """Raise what floats until nothing is deep in anything, as far as that helps."""
    floating = floating_heights(model)
    for _ in range(8):
        mujoco.mj_forward(model, data)
        depth = -min([0.0, *data.contact.dist[: data.ncon]])
        if depth < 0.005 or not floating:
            return
        data.qpos[floating] += depth


def _close_pairs(model: mujoco.MjModel, data: mujoco.MjData) -> int:
    """Pairs of geoms that may collide and whose bounding spheres touch; that of ground is the half space below it."""
    first, second = np.triu_indices(model.ngeom, 1)
    kind, weld = model.geom_type, model.body_weldid[model.geom_bodyid]
    parent = model.body_weldid[model.body_parentid[weld]]
    mask = (model.geom_contype[first] & model.geom_conaffinity[second]) | (
        model.geom_contype[second] & model.geom_conaffinity[first]
    )
    related = (weld[first] == weld[second]) | (
        (weld[first] != 0) & (weld[second] != 0) & ((parent[first] == weld[second]) | (parent[second] == weld[first]))
    )
    possible = (mask != 0) & ~related
    first, second = first[possible], second[possible]
    of_field = np.isin(kind, _GROUND) & (kind != mujoco.mjtGeom.mjGEOM_PLANE.value)
    top = np.zeros(model.ngeom)
    top[of_field] = model.hfield_size[model.geom_dataid[of_field], 2]
    bound = np.where(of_field, 0.0, model.geom_rbound)
    margin = model.geom_margin[first] + model.geom_margin[second]
    distance = np.linalg.norm(data.geom_xpos[first] - data.geom_xpos[second], axis=1)
    for plane, other in ((first, second), (second, first)):
        flat = np.isin(kind[plane], _GROUND)
        normal = data.geom_xmat[plane].reshape(-1, 3, 3)[:, :, 2]
        height = np.einsum("pi,pi->p", data.geom_xpos[other] - data.geom_xpos[plane], normal) - top[plane]
        distance = np.where(flat, height, distance)
    return int((distance <= bound[first] + bound[second] + margin).sum())
