"""What can be hidden in a robot: the true machine behind the one that the model describes."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np

from torchrl_athletic.recordings.demo.robot import Dynamics, Robot


@dataclass(frozen=True)
class HiddenEffect:
    """One piece of physics that the model lacks, by the names of :mod:`torchrl_athletic.effects`.

    A parameter is the true total, not a change to the model's: ``armature`` of ``reflected_inertia`` is the whole
    rotor.
    """

    name: str
    joint: str
    parameters: Mapping[str, float]


@dataclass(frozen=True)
class Friction:
    """Friction of one joint, by direction of motion [N·m, N·m·s/rad]."""

    coulomb_positive: float = 0.0
    coulomb_negative: float = 0.0
    viscous_positive: float = 0.0
    viscous_negative: float = 0.0

    @property
    def smooth(self) -> bool:
        """True if nothing happens when the velocity passes through zero."""
        return self.coulomb_positive == self.coulomb_negative == 0 and self.viscous_positive == self.viscous_negative


@dataclass(frozen=True)
class Drive:
    """The way from a command to the torque of one joint, and back through the encoder."""

    delay: float = 0.0
    """[s]"""
    time_constant: float = 0.0
    """Time constant of the torque loop, first order [s]."""
    scale: float = 1.0
    """Torque per commanded torque [1]."""
    torque: float = 0.0
    """Torque that acts beside the command [N·m]."""
    kp_scale: float = 1.0
    """True gain per logged gain [1]."""
    kd_scale: float = 1.0
    offset: float = 0.0
    """Reading of the encoder minus true position [rad]."""


@dataclass(frozen=True, eq=False)
class Machine:
    """A robot as it is, effects included. Tuples have one entry a joint."""

    robot: Robot
    """As the model describes it."""
    dynamics: Dynamics
    friction: tuple[Friction, ...]
    drives: tuple[Drive, ...]


def machine_with(robot: Robot, effects: Sequence[HiddenEffect] = ()) -> Machine:
    """The true machine behind a model.

    Raises:
        ValueError: If an effect, its joint or its parameters are not known.
    """
    links, drives = list(robot.links), [Drive() for _ in robot.links]
    friction = [Friction(*(link.frictionloss,) * 2, *(link.damping,) * 2) for link in links]
    for effect in effects:
        if effect.joint not in robot.joint_names:
            raise ValueError(f"{effect.name}: {robot.name} has no joint {effect.joint!r}, only {robot.joint_names}.")
        j, p = robot.joint_names.index(effect.joint), dict(effect.parameters)
        wanted = PARAMETERS.get(effect.name)
        if wanted is None:
            raise ValueError(f"{effect.name!r} cannot be hidden; known are {', '.join(PARAMETERS)}.")
        if set(p) != set(wanted):
            raise ValueError(f"{effect.name} has the parameters {', '.join(wanted)}; came {', '.join(p) or 'none'}.")
        if effect.name == "link_mass":
            links[j] = replace(links[j], mass=p["mass"], inertia=links[j].inertia * p["mass"] / links[j].mass)
        elif effect.name == "reflected_inertia":
            links[j] = replace(links[j], **p)
        elif effect.name == "coulomb_friction":
            friction[j] = replace(friction[j], coulomb_positive=p["torque"], coulomb_negative=p["torque"])
        elif effect.name == "viscous_friction":
            friction[j] = replace(friction[j], viscous_positive=p["damping"], viscous_negative=p["damping"])
        elif effect.name == "asymmetric_friction":
            friction[j] = Friction(**p)
        else:
            drives[j] = replace(drives[j], **p)
    return Machine(robot, replace(robot, links=tuple(links)).dynamics, tuple(friction), tuple(drives))


PARAMETERS: Mapping[str, tuple[str, ...]] = {
    "coulomb_friction": ("torque",),
    "viscous_friction": ("damping",),
    "asymmetric_friction": ("coulomb_positive", "coulomb_negative", "viscous_positive", "viscous_negative"),
    "reflected_inertia": ("armature",),
    "link_mass": ("mass",),
    "torque_scale": ("scale",),
    "torque_offset": ("torque",),
    "actuation_delay": ("delay",),
    "actuation_lag": ("time_constant",),
    "encoder_offset": ("offset",),
    "gain_mismatch": ("kp_scale", "kd_scale"),
}
"""Effects that can be hidden, with their parameters."""


def random_effect(robot: Robot, name: str, joint: str, seed: int) -> HiddenEffect:
    """An effect of a severity that is easy to see and still met in practice.

    Args:
        robot: Its torques and inertias set the scale.
        name: One of :data:`PARAMETERS`.
        joint: One of the robot's.
        seed: Of the severity.
    """
    rng = np.random.default_rng(seed)
    j = robot.joint_names.index(joint)
    link, torque = robot.links[j], robot.torque_amplitude[j]
    share = float(rng.uniform(1.0, 1.5))
    sign = float(rng.choice((-1.0, 1.0)))
    damping = max(link.damping, 0.05 * torque)
    inertia = link.mass if robot.slide else link.inertia + link.mass * link.com**2
    draws: Mapping[str, Callable[[], dict[str, float]]] = {
        "coulomb_friction": lambda: {"torque": link.frictionloss + 0.12 * share * torque},
        "viscous_friction": lambda: {"damping": link.damping + share * damping},
        "asymmetric_friction": lambda: {
            "coulomb_positive": link.frictionloss + 0.10 * (1 + 0.4 * sign) * share * torque,
            "coulomb_negative": link.frictionloss + 0.10 * (1 - 0.4 * sign) * share * torque,
            "viscous_positive": (1.8 + 0.8 * sign) * share * damping,
            "viscous_negative": (1.8 - 0.8 * sign) * share * damping,
        },
        "reflected_inertia": lambda: {"armature": link.armature + 0.6 * share * inertia},
        "link_mass": lambda: {"mass": (1 + 0.3 * share) * link.mass},
        "torque_scale": lambda: {"scale": 1 + 0.18 * sign * share},
        "torque_offset": lambda: {"torque": 0.10 * sign * share * torque},
        "actuation_delay": lambda: {"delay": 0.012 * share},
        "actuation_lag": lambda: {"time_constant": 0.020 * share},
        "encoder_offset": lambda: {"offset": (0.01 if robot.slide else 0.08) * sign * share},
        "gain_mismatch": lambda: {"kp_scale": 1 + 0.3 * sign * share, "kd_scale": 1 - 0.25 * sign * share},
    }
    return HiddenEffect(name, joint, draws[name]())
