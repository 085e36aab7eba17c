"""Environments whose step is one step of the physics: torque in, state out, and the tasks built on that.

The actuation chain between the policy and the motor is not here: it is made of ``transforms``, applied at the physics
rate.
"""

from torchrl_athletic.envs.actuation_chain import actuation_chain
from torchrl_athletic.envs.torque_env import TorqueEnv, make_physics

__all__ = ["TorqueEnv", "actuation_chain", "make_physics"]
