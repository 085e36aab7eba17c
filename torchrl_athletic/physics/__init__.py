"""Batched MuJoCo behind one protocol: threads of a CPU, or a GPU through the extra ``warp``."""

from torchrl_athletic.physics.batch_physics import BatchPhysics, SimulationError
from torchrl_athletic.physics.protocol import CapacityError, Physics
from torchrl_athletic.physics.warp_physics import WarpPhysics

__all__ = ["BatchPhysics", "CapacityError", "Physics", "SimulationError", "WarpPhysics"]
