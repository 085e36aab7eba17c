"""The recorded pose of a floating robot's base."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from torchrl_athletic.recordings.recording import Recording


def base_pose(recording: Recording) -> NDArray[np.float64] | None:
    """Position [m] and orientation as unit quaternion w, x, y, z, whose sign never flips from a sample to the next.

    Returns:
        Shape (T, 7). None if no base was recorded.

    Example:
        >>> time = np.array([0.0, 0.01])
        >>> still = np.zeros((2, 1))
        >>> flipped = [[1.0, 0.0, 0.0, 0.0], [-1.0, 0.0, 0.0, 0.0]]  # the same attitude
        >>> take = Recording(time, ("hip",), still, torque_command=still, base_position=np.zeros((2, 3)),
        ...     base_orientation=np.array(flipped))
        >>> base_pose(take)[:, 3].tolist()
        [1.0, 1.0]
    """
    if recording.base_position is None or recording.base_orientation is None:
        return None
    unit = recording.base_orientation / np.linalg.norm(recording.base_orientation, axis=1, keepdims=True)
    flips = np.where((unit[1:] * unit[:-1]).sum(1) < 0, -1.0, 1.0)
    sign = np.concatenate([[1.0], np.cumprod(flips)])
    return np.hstack([recording.base_position, sign[:, None] * unit])


def base_moves(recording: Recording) -> bool:
    """Whether a base was recorded and did not stand perfectly still."""
    pose = base_pose(recording)
    return pose is not None and bool(np.ptp(pose, axis=0).any())
