"""Models of robots built from primitives with ``MjSpec``; joint groups, default poses, gains, limits as dataclasses.

A robot is data. What moves it lives in ``physics``, and what it is asked to do in ``envs``.
"""

from torchrl_athletic.robots.b2z1 import b2z1
from torchrl_athletic.robots.corrected import with_correction
from torchrl_athletic.robots.from_mjcf import from_mjcf
from torchrl_athletic.robots.robot import Joint, Robot, with_options
from torchrl_athletic.robots.terrain import Terrain
from torchrl_athletic.robots.tools import Bucket, Dumbbell, with_bucket
from torchrl_athletic.robots.z1 import z1

__all__ = [
    "Bucket",
    "Dumbbell",
    "Joint",
    "Robot",
    "Terrain",
    "b2z1",
    "from_mjcf",
    "with_bucket",
    "with_correction",
    "with_options",
    "z1",
]
