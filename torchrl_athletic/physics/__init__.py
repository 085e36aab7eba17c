"""Batched MuJoCo behind one protocol: CPU threads here, CUDA through an extra."""

from torchrl_athletic.physics.batch_physics import BatchPhysics, SimulationError
from torchrl_athletic.physics.protocol import Physics

__all__ = ["BatchPhysics", "Physics", "SimulationError"]
