r"""A motor that drives its joint through a spring and a gap: how far the two deflect, along a take and in simulation.

The encoder sits on the motor, at θ; the link is at q = θ - x. With the link's inertia M, what its other forces ask for,
and the torque σ that the gear passes on,

.. math::
    M \ddot x = \mathrm{ID}_\mathrm{link}(\theta) - C \dot x - G x - \sigma, \qquad
    \sigma = K\,(x - \mathrm{clip}(x, \pm g/2)) + D \dot x \quad (\text{the latter while the teeth touch})

to first order in x (Spong 1987, doi:10.1115/1.3143860, section 2, with the load linearised about the motor's motion).
"""

from __future__ import annotations

from dataclasses import dataclass, field
from functools import cached_property
from typing import TYPE_CHECKING

import mujoco
import numpy as np
from numpy.typing import NDArray

from torchrl_athletic.effects.signals import (
    JointAddress,
    bristle,
    inertia_matrix,
    inverse_dynamics,
    smooth_dynamics,
)

if TYPE_CHECKING:
    from torchrl_athletic.effects.plant import Now, Plant, Start

Array = NDArray[np.float64]

WARM_UP = 2.0
"""After which a deflection has forgotten where it started from [s]."""
CONTACT_STEP = 0.0005
"""Time step of teeth that touch and part [s]."""
ROTOR_FLOOR = 0.02
"""Least inertia of a rotor in simulation, per that of its link: a model without armature gives it none [1]."""
COARSE = 0.01
"""Step at which the derivatives of the dynamics are found; between, they are interpolated [s]."""


@dataclass(frozen=True, eq=False)
class LinkMotion:
    """What a motion asks of the links. S samples, ``period`` seconds apart."""

    model: mujoco.MjModel
    address: JointAddress
    period: float
    position: Array
    """Shape (S, J)."""
    velocity: Array
    """Shape (S, J)."""
    derivatives: dict[int, Array] = field(default_factory=dict)
    """Of :meth:`slopes`, by joint."""

    @cached_property
    def acceleration(self) -> Array:
        """Shape (S, J)."""
        return np.gradient(self.velocity, self.period, axis=0)

    @cached_property
    def load(self) -> Array:
        """Torque that each link asks for, its own rotor left out, the model's dry friction included. Shape (S, J)."""
        torque = inverse_dynamics(self._links, self.address, self.position, self.velocity, self.acceleration)
        loss = self.model.dof_frictionloss[self.address.dof]
        for j in map(int, np.flatnonzero(loss)):
            torque[:, j] += loss[j] * self.sliding(j)
        return torque

    @cached_property
    def free_inertia(self) -> Array:
        """Inertia of each link about its joint, all other joints free to move [kg·m², kg]. Shape (S, J)."""
        full, armature = inertia_matrix(self.model, self.address, self.position[:: self._stride]), self._armature
        return self._between(1.0 / np.diagonal(np.linalg.inv(full), axis1=1, axis2=2) - armature)

    def slopes(self, joint: int) -> Array:
        """∂ID/∂q, ∂ID/∂q̇ and ∂ID/∂q̈ of all links for one joint's motion: G, C and M. Shape (3, S, J)."""
        if joint not in self.derivatives:
            some = slice(None, None, self._stride)
            motion = [x[some] for x in (self.position, self.velocity, self.acceleration)]
            out = []
            for k, step in enumerate((1e-4, 1e-3, 1.0)):
                up, down = [x.copy() for x in motion], [x.copy() for x in motion]
                up[k][:, joint] += step
                down[k][:, joint] -= step
                rise = inverse_dynamics(self._links, self.address, *up)
                out.append(self._between((rise - inverse_dynamics(self._links, self.address, *down)) / (2 * step)))
            self.derivatives[joint] = np.stack(out)
        return self.derivatives[joint]

    def sliding(self, joint: int) -> Array:
        """Direction of sliding. Shape (S,)."""
        position = self.position[:, joint]
        return bristle(position, max(1.5e-3 * min(float(np.ptp(position)), 1.0), 1e-9))

    @cached_property
    def _links(self) -> mujoco.MjModel:
        """Without rotors, each of which enters the equation of its own joint only."""
        links = smooth_dynamics(self.model)
        links.dof_armature[:] = 0.0
        return links

    @property
    def _armature(self) -> Array:
        return np.asarray(self.model.dof_armature[self.address.dof], dtype=np.float64)

    @property
    def _stride(self) -> int:
        return max(1, int(COARSE / self.period))

    def _between(self, some: Array) -> Array:
        """Interpolate what was found at every :attr:`_stride`-th sample. Shape (S, J)."""
        at = np.arange(len(self.position)) / self._stride
        return np.stack([np.interp(at, np.arange(len(some)), column) for column in some.T], -1)


@dataclass(frozen=True, eq=False)
class Spring:
    """Torque that teeth pass on at a deflection. Every field broadcasts against the deflections."""

    stiffness: Array
    """[N·m/rad, N/m]."""
    damping: Array
    """While the teeth touch [N·m·s/rad, N·s/m]."""
    gap: Array
    """Total play [rad, m]."""

    def softness(self, inertia: Array, step: float) -> Array:
        """Torque added by a step of unit relative acceleration, so that free vibration keeps its period [N·m·s²/rad].

        Of x' = x + h w', the centred force K (x + g h (w' - w)) with g = 1/(2 - 2 cos φ) - 1/φ² vibrates at
        φ = h √(K / inertia) radians a step, exactly; at g = 1/4 any stiffness is stable (Newmark 1959).
        """
        phi = step * np.sqrt(self.stiffness / inertia)
        gentle = np.clip(phi, 1e-2, 2.4)
        share = np.where(phi < 2.4, 1 / (2 - 2 * np.cos(gentle)) - 1 / gentle**2, 0.25)
        return share * self.stiffness * step**2 + self.damping * step / 2

    def torque(self, x: Array, w: Array, push: Array, inertia: Array, softness: Array, step: float) -> Array:
        """Mean torque over a step that starts at deflection ``x`` and rate ``w`` [N·m, N].

        Args:
            x: Deflection.
            w: Its rate.
            push: Acceleration of the deflection without the spring.
            inertia: That the spring sees.
            softness: See :meth:`softness`.
            step: [s].
        """
        linear = (self.stiffness * x + self.damping * w + softness * push) / (1 + softness / inertia)
        if not self.gap.any():
            return linear
        half, ahead = self.gap / 2, x + step * w
        side = np.sign(ahead)
        pressed = side * linear - self.stiffness * half / (1 + softness / inertia)
        return np.where(np.abs(ahead) >= half, side * np.maximum(pressed, 0.0), 0.0)


def deflection(load: Array, slopes: Array, spring: Spring, period: float) -> tuple[Array, Array, Array]:
    """Solve the equation of this module along a motion, from rest at the deflection of the first load.

    Args:
        load: What the link asks for [N·m, N]. Shape (S, ...).
        slopes: G, C and M of its own joint. Shape (3, S, ...).
        spring: Fields broadcast against ``load[0]``.
        period: Between samples [s]; loads are interpolated.

    Returns:
        Deflection x, its rate, and the torque passed on, at the samples. Shapes (S, ...).
    """
    substeps = _substeps(spring, period)
    step = period / substeps
    x = load[0] / spring.stiffness
    x = x + np.sign(x) * spring.gap / 2
    w = np.zeros_like(x)
    softness = spring.softness(slopes[2].mean(0), step)
    out = np.empty((3, len(load), *x.shape))
    for k in range(len(load)):
        gravity, damping, inertia = slopes[:, k]
        rise = load[min(k + 1, len(load) - 1)] - load[k]
        for n in range(substeps):
            push = (load[k] + rise * (n / substeps) - damping * w - gravity * x) / inertia
            torque = spring.torque(x, w, push, inertia, softness, step)
            ahead = w + step * (push - torque / inertia)  # half a step later: the scheme is a leapfrog
            if n == 0:
                out[:, k] = x, (w + ahead) / 2, torque
            w = ahead
            x = x + step * w
    return out[0], out[1], out[2]


def _substeps(spring: Spring, period: float) -> int:
    return int(np.ceil(period / CONTACT_STEP - 1e-6)) if spring.gap.any() else 1


@dataclass(eq=False)
class Gear:
    """The motors of one joint in all rows, in simulation. MuJoCo moves the links, whose armature the motor takes over.

    The torque that a gear passes on in a step is found from both sides at once, with the link's acceleration of the
    step before, so that a stiff gear on a light rotor is as stable as a soft one.
    """

    joint: int
    spring: Spring
    """Fields of shape (rows,)."""
    deflection: Array = field(init=False)
    """Of the motor ahead of the link [rad, m]. Shape (rows,)."""
    velocity: Array = field(init=False)
    """Of the motor. Shape (rows,)."""

    def begin(self, start: Start, plant: Plant, velocity: Array) -> tuple[Array, Array]:
        """Take over the rotor, and find where the links are behind the measured motors.

        Returns:
            How far the links are behind, and how fast they fall behind. Shapes (rows,).
        """
        link, j, dof = start.link, self.joint, plant.address.dof[self.joint]
        assert link is not None
        back = np.arange(-max(1, int(WARM_UP / link.period)), 1)[:, None]
        before = np.maximum(start.sample + back, 0)  # a take's first sample is held: the robot rested there
        load = link.load[before, j]
        if "dof_frictionloss" in plant.fields:
            more = plant.fields["dof_frictionloss"][:, dof] - plant.model.dof_frictionloss[dof]
            load = load + more * link.sliding(j)[before]
        if "dof_damping" in plant.fields:
            more = (
                plant.fields["dof_damping"][:, dof].reshape(plant.rows, -1)[:, 0]
                - np.ravel(plant.model.dof_damping[dof])[0]
            )
            load = load + more * link.velocity[before, j]
        slopes = link.slopes(j)[:, before, j]
        x, rate, torque = (part[-1] for part in deflection(load, slopes, self.spring, link.period))

        armature = plant.of("dof_armature")
        self._link_inertia = link.free_inertia[:, j]
        self._rotor = np.maximum(armature[:, dof], ROTOR_FLOOR * self._link_inertia.mean())
        armature[:, dof] = 0.0
        self._origin, self._period = start.time[0], link.period
        self._torque, self._link_velocity = torque, np.full(plant.rows, np.nan)
        self._own = link.acceleration[start.sample, j] - torque / self._link_inertia[start.sample]
        self.deflection, self.velocity = x, velocity
        return x, rate

    def step(self, torque: Array, link_velocity: Array, now: Now) -> Array:
        """Move the motors by one step; return the torque on the links [N·m, N]. Shapes (rows,)."""
        at = ((now.time - self._origin) / self._period + 0.5).astype(np.intp)
        inertia = self._link_inertia[np.minimum(at, len(self._link_inertia) - 1)]
        own = (link_velocity - self._link_velocity) / now.step - self._torque / inertia
        own = np.where(np.isnan(self._link_velocity), self._own, own)  # nothing is behind the first step
        seen = 1.0 / (1.0 / self._rotor + 1.0 / inertia)
        substeps = _substeps(self.spring, now.step)
        step = now.step / substeps
        softness = self.spring.softness(seen, step)
        push, passed = torque / self._rotor - own, np.zeros_like(torque)
        x, w = self.deflection, self.velocity - link_velocity
        for _ in range(substeps):
            part = self.spring.torque(x, w, push, seen, softness, step)
            w = w + step * (push - part / seen)
            x = x + step * w
            passed = passed + part / substeps
        self.deflection, self.velocity = x, self.velocity + now.step * (torque - passed) / self._rotor
        self._torque, self._link_velocity = passed, link_velocity.copy()
        return passed
