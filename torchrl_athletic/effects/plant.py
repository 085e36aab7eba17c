"""What an effect may change in a batch of simulations: fields of the model, and the way from command to torque."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field

import mujoco
import numpy as np
from numpy.typing import NDArray

from torchrl_athletic.effects.signals import JointAddress

Array = NDArray[np.float64]
Law = Callable[[Array, Array], Array]
"""Joint torque added at each physics step, of position and velocity: (rows, J), (rows, J) -> (rows, J) [N·m]."""


@dataclass(eq=False)
class Plant:
    """``rows`` copies of one model, each with its own parameters. Effects edit it in place.

    Every per-joint field has shape (rows, J), in the order of the recording's joints.
    """

    model: mujoco.MjModel
    address: JointAddress
    rows: int
    fields: dict[str, Array] = field(default_factory=dict)
    """Per-row values of ``mjModel`` fields; see :meth:`of`."""
    laws: list[Law] = field(default_factory=list)
    """Torques that MuJoCo cannot express."""
    delay: Array = field(init=False)
    """Of the command [s]."""
    lag: Array = field(init=False)
    """Time constant of the torque loop [s]."""
    torque_scale: Array = field(init=False)
    """Torque at the joint per commanded torque [1]."""
    torque_offset: Array = field(init=False)
    """Added to the torque [N·m]."""
    kp_scale: Array = field(init=False)
    """True gain per logged gain [1]."""
    kd_scale: Array = field(init=False)
    """True gain per logged gain [1]."""
    encoder_offset: Array = field(init=False)
    """Reading minus true position [rad]."""

    def __post_init__(self) -> None:
        shape = (self.rows, len(self.address.dof))
        for name in ("delay", "lag", "torque_offset", "encoder_offset"):
            setattr(self, name, np.zeros(shape))
        for name in ("torque_scale", "kp_scale", "kd_scale"):
            setattr(self, name, np.ones(shape))

    def of(self, name: str) -> Array:
        """Per-row values of a model field, to be written in place. Shape (rows, *field)."""
        if name not in self.fields:
            value = np.asarray(getattr(self.model, name), dtype=np.float64)
            self.fields[name] = np.repeat(value[None], self.rows, axis=0)
        return self.fields[name]

    def set_dry_friction(self, joint: int, torque: Array) -> None:
        """Ideal Coulomb friction: MuJoCo's ``frictionloss`` with the stiffest regularisation that the time step allows.

        With the default ``solref`` the force turns over about 10 ms before the velocity does, which no bearing does.
        """
        dof = self.address.dof[joint]
        self.of("dof_frictionloss")[:, dof] = torque
        self.of("dof_solref")[:, dof] = (2 * self.model.opt.timestep, 1.0)
        self.of("dof_solimp")[:, dof] = (0.99, 0.99, 1e-3, 0.5, 2.0)

    @property
    def open_loop(self) -> bool:
        """True if no extra torque depends on the state."""
        return not self.laws
