"""Models of robots built from primitives with ``MjSpec``; joint groups, default poses, gains, limits as dataclasses.

A robot is data. What moves it lives in ``physics``, and what it is asked to do in ``envs``.
"""

from torchrl_athletic.robots.b2z1 import b2z1
from torchrl_athletic.robots.corrected import with_correction
from torchrl_athletic.robots.from_mjcf import from_mjcf
from torchrl_athletic.robots.motion import KeyPose, Motion, PhaseMotion, motion_from_table, read_motion, write_motion
from torchrl_athletic.robots.motion_drawing import draw_motion, motion_frames
from torchrl_athletic.robots.motion_tables import check_motion, motion_tables
from torchrl_athletic.robots.robot import Joint, Robot, with_options
from torchrl_athletic.robots.terrain import Terrain
from torchrl_athletic.robots.tools import Bucket, Dumbbell, Handle, with_bucket
from torchrl_athletic.robots.z1 import z1

__all__ = [
    "Bucket",
    "Dumbbell",
    "Handle",
    "Joint",
    "KeyPose",
    "Motion",
    "PhaseMotion",
    "Robot",
    "Terrain",
    "b2z1",
    "check_motion",
    "draw_motion",
    "from_mjcf",
    "motion_frames",
    "motion_from_table",
    "motion_tables",
    "read_motion",
    "with_bucket",
    "with_correction",
    "with_options",
    "write_motion",
    "z1",
]
