"""Goals, and things that are computed beside the simulation, in a picture of it."""

from __future__ import annotations

import mujoco
import numpy as np
from numpy.typing import NDArray
from tensordict import TensorDictBase

from torchrl_athletic.functional import rotations
from torchrl_athletic.functional.commands import pose_to_world


def draw_frame(scene: mujoco.MjvScene, origin: NDArray[np.float64], tips: NDArray[np.float64]) -> None:
    """Add a frame, red, green and blue for x, y and z.

    Args:
        scene: To draw into.
        origin: In the world [m]. Shape (3,).
        tips: Of the axes [m]. Shape (3, 3).
    """
    for tip, colour in zip(tips, np.eye(3), strict=True):
        geom = scene.geoms[scene.ngeom]
        kind = mujoco.mjtGeom.mjGEOM_ARROW.value
        mujoco.mjv_initGeom(geom, kind, np.zeros(3), np.zeros(3), np.zeros(9), np.array([*colour, 0.8], np.float32))
        mujoco.mjv_connector(geom, kind, 0.008, origin, tip)
        scene.ngeom += 1


def draw_command(scene: mujoco.MjvScene, step: TensorDictBase, frame_height: float = 0.5) -> None:
    """Add to a picture where a whole-body controller's end effector is told to be.

    Args:
        scene: To draw into.
        step: With ``end_effector_command``, ``base_position``, ``base_quaternion`` and ``base_height``.
        frame_height: Of the commands' frame over the ground [m].
    """
    base, height = step["base_position"], step["base_height"]
    goal = pose_to_world(step["end_effector_command"], base, step["base_quaternion"], frame_height, base[2:] - height)
    origin, *tips = rotations.keypoints(*goal, length=0.15).double().cpu().numpy()
    draw_frame(scene, origin, np.array(tips))


def draw_ball(scene: mujoco.MjvScene, step: TensorDictBase, radius: float = 0.035) -> None:
    """Add to a picture where the ball of a throw is, once it is there.

    Args:
        scene: To draw into.
        step: With ``ball_position``.
        radius: Of the ball [m].
    """
    place = step["ball_position"].double().cpu().numpy()
    if place.any():
        kind, orange = mujoco.mjtGeom.mjGEOM_SPHERE.value, np.array([0.95, 0.55, 0.1, 1.0], np.float32)
        geom = scene.geoms[scene.ngeom]
        mujoco.mjv_initGeom(geom, kind, np.full(3, radius), place, np.eye(3).ravel(), orange)
        scene.ngeom += 1


def draw_sled(scene: mujoco.MjvScene, step: TensorDictBase, hook_height: float = 0.2) -> None:
    """Add to a picture a sled and its rope, which is red where it is taut.

    Args:
        scene: To draw into.
        step: With ``sled_position``, ``handle_position`` and ``rope_tension``.
        hook_height: Where the rope is tied, over the ground [m].
    """
    grip, sled = (step[key].double().cpu().numpy() for key in ("handle_position", "sled_position"))
    hook = np.array([*sled, hook_height])
    ahead = hook[:2] - grip[:2]
    c, s = ahead / max(float(np.linalg.norm(ahead)), 1e-9)
    size, centre = np.array([0.4, 0.3, 0.1]), hook + np.array([0.4 * c, 0.4 * s, 0.12 - hook_height])
    turn, grey = np.array([c, -s, 0, s, c, 0, 0, 0, 1]), np.array([0.35, 0.37, 0.4, 1.0], np.float32)
    mujoco.mjv_initGeom(scene.geoms[scene.ngeom], mujoco.mjtGeom.mjGEOM_BOX.value, size, centre, turn, grey)
    scene.ngeom += 1
    rope, taut = scene.geoms[scene.ngeom], float(step["rope_tension"]) > 0
    colour = [0.8, 0.1, 0.1, 1.0] if taut else [0.5, 0.5, 0.5, 1.0]
    kind = mujoco.mjtGeom.mjGEOM_CAPSULE.value
    mujoco.mjv_initGeom(rope, kind, np.zeros(3), np.zeros(3), np.zeros(9), np.array(colour, np.float32))
    mujoco.mjv_connector(rope, kind, 0.008, grip, hook)
    scene.ngeom += 1
