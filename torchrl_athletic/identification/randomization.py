"""Domain randomisation of an arm: no single simulator but many, of which the robot is hoped to be one."""

from __future__ import annotations

from torchrl_athletic.identification.simulator import Simulator
from torchrl_athletic.robots import Robot
from torchrl_athletic.transforms import RandomizationRanges

ARM_RANGES = RandomizationRanges(
    friction=None,
    restitution=None,
    joint_friction_scale=(0.5, 3.5),
    joint_damping_scale=(0.3, 2.0),
    armature_scale=(0.33, 2.33),
)
"""Gains, torque limits, masses and centres of mass as the paper's table has them for its legs and links. It states no
figures for friction and armature of the arm: these span what is known of harmonic drives of the Z1's size, of whose
nominal values :mod:`torchrl_athletic.robots.arm` tells."""


def randomized(robot: Robot, *, adaptation: bool = False) -> Simulator:
    """The simulator in which a policy meets another arm in each episode; nothing is fitted to recordings.

    Args:
        robot: As given.
        adaptation: Whether the policy shall adapt online, :func:`~torchrl_athletic.networks.roa_actor`: the same
            simulator under the name ``"roa"`` instead of ``"dr"``.

    Source:
        Fey et al. 2025, section III-A, baselines "DR" and "ROA", and appendix A.

    Example:
        >>> from torchrl_athletic.robots import z1
        >>> sorted(randomized(z1()).fields)
        ['body_inertia', 'body_ipos', 'body_mass', 'dof_armature', 'dof_damping', 'dof_frictionloss']
    """
    notes = {"training_seconds": 0.0, "data_seconds": 0.0}
    return Simulator("roa" if adaptation else "dr", robot, randomization=ARM_RANGES, notes=notes)
