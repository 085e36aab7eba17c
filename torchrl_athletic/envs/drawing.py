"""Goals in a picture of the simulation."""

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
