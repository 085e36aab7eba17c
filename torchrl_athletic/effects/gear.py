r"""A motor that drives its joint through a spring and a gap: how far the two deflect, along a take and in simulation.

The encoder sits on the motor, at θ; the link is at q = θ - x. With the link's inertia M, what its other forces ask for,
and the torque σ that the gear passes on,

.. math::
    M \ddot x = \mathrm{ID}_\mathrm{link}(\theta) - C \dot x - G x - \sigma, \qquad
    \sigma = K\,(x - \mathrm{clip}(x, \pm g/2)) + D \dot x \quad (\text{the latter while the teeth touch})

to first order in x (Spong 1987, doi:10.1115/1.3143860, section 2, with the load linearised about the motor's motion).
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field
from functools import cached_property
from typing import TYPE_CHECKING

import mujoco
import numpy as np
from numpy.typing import NDArray
from scipy.interpolate import CubicSpline

from torchrl_athletic.effects.base import BaseMotion
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

WARM_UP = (4.0, 1.5)
"""After which a deflection has forgotten where it started from, without play and with [s]."""
ONSET = 0.02
"""Time over which the torque that it starts from is averaged [s]."""
OBSERVER = 100.0
"""How fast the motor of an observer returns to the measured position [1/s]."""
OBSERVED = 0.5
"""Longest step of an observer, per the time in which its motor returns [1]: from 0.83 on it is unstable."""
CONTACT_STEP = 0.001
"""Time step of teeth that touch and part [s]."""
ROTOR_FLOOR = 0.02
"""Least inertia of a rotor in simulation, per that of its link: a model without armature gives it none [1]."""
STARTS = 100_000
"""Starts that are remembered at most."""
COARSE = 0.02
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
    """Results of :meth:`slopes`, by joint."""
    starts: dict[tuple[int, bool, bytes], Array] = field(default_factory=dict)
    """Results of :meth:`Gear.begin`, by joint, play, and what else decides them."""
    base: BaseMotion | None = None
    """Motion of the base of a floating robot. S samples."""

    @cached_property
    def acceleration(self) -> Array:
        """Shape (S, J)."""
        time = self.period * np.arange(len(self.velocity))
        return np.asarray(CubicSpline(time, self.velocity)(time, 1), dtype=np.float64)

    @cached_property
    def load(self) -> Array:
        """Torque that each link asks for, its own rotor left out, the model's dry friction included. Shape (S, J)."""
        motion = self.position, self.velocity, self.acceleration
        torque = inverse_dynamics(self._links, self.address, *motion, self.base)
        loss = self.model.dof_frictionloss[self.address.dof]
        for j in map(int, np.flatnonzero(loss)):
            torque[:, j] += loss[j] * self.sliding(j)
        return torque

    @cached_property
    def free_inertia(self) -> Array:
        """Inertia of each link about its joint, all other joints free to move [kg·m², kg]. Shape (S, J)."""
        full, armature = inertia_matrix(self.model, self.address, self._some[0]), self._armature
        return self._between(1.0 / np.diagonal(np.linalg.inv(full), axis1=1, axis2=2) - armature)

    def slopes(self, joint: int) -> Array:
        """∂ID/∂q, ∂ID/∂q̇ and ∂ID/∂q̈ of all links for one joint's motion: G, C and M. Shape (3, S, J)."""
        if joint not in self.derivatives:
            out = []
            for k, step in enumerate((1e-5, 1e-4, 1.0)):
                motion = list(self._some)
                motion[k] = motion[k].copy()
                motion[k][:, joint] += step
                q, v, a = motion
                changed = inverse_dynamics(self._links, self.address, q, v, a, self._some_base)
                out.append(self._between((changed - self._some_load) / step))
            self.derivatives[joint] = np.stack(out)
        return self.derivatives[joint]

    def sliding(self, joint: int) -> Array:
        """Direction of sliding. Shape (S,)."""
        position = self.position[:, joint]
        return bristle(position, max(1.5e-3 * min(float(np.ptp(position)), 1.0), 1e-9))

    @cached_property
    def _some(self) -> tuple[Array, Array, Array]:
        """Motion at the coarse step."""
        q, v, a = (x[:: self._stride] for x in (self.position, self.velocity, self.acceleration))
        return q, v, a

    @cached_property
    def _some_load(self) -> Array:
        return inverse_dynamics(self._links, self.address, *self._some, self._some_base)

    @property
    def _some_base(self) -> BaseMotion | None:
        return None if self.base is None else self.base[:: self._stride]

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
class JoinedMotion(LinkMotion):
    """Several motions of one model, one after the other: each is looked at alone."""

    pieces: tuple[LinkMotion, ...] = ()

    @classmethod
    def of(cls, pieces: tuple[LinkMotion, ...]) -> JoinedMotion:
        """Join motions with the same period."""
        first = pieces[0]
        position, velocity = (np.concatenate([getattr(p, name) for p in pieces]) for name in ("position", "velocity"))
        return cls(first.model, first.address, first.period, position, velocity, pieces=pieces)

    @cached_property
    def acceleration(self) -> Array:
        """Shape (S, J)."""
        return self._all(lambda piece: piece.acceleration)

    @cached_property
    def load(self) -> Array:
        """Shape (S, J)."""
        return self._all(lambda piece: piece.load)

    @cached_property
    def free_inertia(self) -> Array:
        """Shape (S, J)."""
        return self._all(lambda piece: piece.free_inertia)

    def slopes(self, joint: int) -> Array:
        """Shape (3, S, J)."""
        if joint not in self.derivatives:
            self.derivatives[joint] = np.concatenate([piece.slopes(joint) for piece in self.pieces], axis=1)
        return self.derivatives[joint]

    def sliding(self, joint: int) -> Array:
        """Shape (S,)."""
        return self._all(lambda piece: piece.sliding(joint))

    def _all(self, number: Callable[[LinkMotion], Array]) -> Array:
        return np.concatenate([number(piece) for piece in self.pieces])


@dataclass(frozen=True, eq=False)
class Spring:
    """Torque that teeth pass on at a deflection. Every field broadcasts against the deflections."""

    stiffness: Array
    """[N·m/rad, N/m]."""
    damping: Array
    """While the teeth touch [N·m·s/rad, N·s/m]."""
    gap: Array
    """Total play [rad, m]."""

    @cached_property
    def play(self) -> bool:
        """Whether any gap is open."""
        return bool(self.gap.any())

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
        rigid, half = 1 + softness / inertia, self.gap / 2
        linear = (self.stiffness * x + self.damping * w + softness * push) / rigid
        if not self.play:
            return linear
        ahead = x + step * w
        side = np.sign(ahead)
        pressed = np.maximum(side * linear - self.stiffness * half / rigid, 0.0)
        return side * pressed * (side * ahead >= half)


def deflection(
    load: Array, slopes: Array, spring: Spring, period: float, passed: Array, held: NDArray[np.bool_] | None = None
) -> Array:
    """Solve the equation of this module along a motion.

    Args:
        load: What the link asks for [N·m, N]. Shape (S, ...).
        slopes: G, C and M of its own joint. Shape (3, S, ...).
        spring: Fields broadcast against ``load[0]``.
        period: Between samples [s]; loads are interpolated.
        passed: What the gear passes on at the first sample, and its rate. Shape (2, ...).
        held: Samples at which the first deflection still holds. Shape (S, ...).

    Returns:
        Deflection x at the samples, its rate and its acceleration. Shape (3, S, ...).
    """
    substeps = _substeps(spring, period)
    step = period / substeps
    rate = passed[1] / spring.stiffness
    first = (passed[0] - spring.damping * rate) / spring.stiffness
    first, rate = np.broadcast_arrays(first, rate, load[0])[:2]
    first = first + np.sign(first) * spring.gap / 2
    x, w = first, rate
    softness = spring.softness(slopes[2].mean(0), step)
    out = np.empty((3, len(load), *x.shape))
    with np.errstate(over="ignore", invalid="ignore"):  # of gears that diverge, which nobody takes
        for k in range(len(load)):
            if held is not None:
                x, w = np.where(held[k], first, x), np.where(held[k], rate, w)
            gravity, damping, inertia = slopes[:, k]
            rise = load[min(k + 1, len(load) - 1)] - load[k]
            for n in range(substeps):
                push = (load[k] + rise * (n / substeps) - damping * w - gravity * x) / inertia
                torque = spring.torque(x, w, push, inertia, softness, step)
                acceleration = push - torque / inertia
                ahead = w + step * acceleration  # half a step later: the scheme is a leapfrog
                if n == 0:
                    out[:, k] = x, (w + ahead) / 2, acceleration
                w = ahead
                x = x + step * w
    return out


def observed(
    load: Array, slopes: Array, spring: Spring, period: float, passed: Array, rotor: Array, held: NDArray[np.bool_]
) -> Array:
    """Where a link is behind its motor at the last sample, from the measured motion and the command before it.

    A motor that follows its measured position as if on a critically damped spring, at :data:`OBSERVER`, and is driven
    by what was commanded: the teeth then part and meet when the commanded torque makes them, not when the noise of a
    prescribed position does (Luenberger 1964).

    Args:
        load: What the link asks for at the measured position [N·m, N]. Shape (S, rows).
        slopes: G, C and M of its own joint. Shape (3, S, rows).
        spring: Fields of shape (rows,).
        period: Between samples [s].
        passed: What the measured motor would pass on: its command less its own acceleration's torque. Shape (S, rows).
        rotor: Inertia of the motor [kg·m², kg]. Shape (rows,).
        held: Samples at which the first deflection still holds. Shape (S, rows).

    Returns:
        Deflection, its rate, its acceleration, and the torque passed on. Shape (4, rows).
    """
    substeps = max(_substeps(spring, period), int(np.ceil(period * OBSERVER / OBSERVED - 1e-6)))
    step = period / substeps
    first = passed[: max(1, int(ONSET / period))].mean(0) / spring.stiffness
    first = first + np.sign(first) * spring.gap / 2
    state = np.zeros((4, len(first)))  # deflection from the measured motor, and of the motor from that; their rates
    seen = 1.0 / (1.0 / rotor + 1.0 / slopes[2].mean(0))
    softness = spring.softness(seen, step)
    state[0] = first
    for k in range(len(load)):
        if held[k].any():
            state = np.where(held[k], np.stack([first, *np.zeros((3, len(first)))]), state)
        x, e, w, f = state
        gravity, damping, inertia = slopes[:, k]
        after = min(k + 1, len(load) - 1)
        for n in range(substeps):
            asked = load[k] + (load[after] - load[k]) * (n / substeps)
            drive = passed[k] + (passed[after] - passed[k]) * (n / substeps)
            link = (asked - damping * w - gravity * x) / inertia
            motor = drive / rotor - 2 * OBSERVER * f - OBSERVER**2 * e
            torque = spring.torque(x + e, w + f, link + motor, seen, softness, step)
            faster = link - torque / inertia, motor - torque / rotor
            if k == len(load) - 1:
                break
            w, f = w + step * faster[0], f + step * faster[1]
            x, e = x + step * w, e + step * f
        state = np.stack([x, e, w, f])
    rate = w + f + step / 2 * (faster[0] + faster[1])  # the scheme is a leapfrog
    return np.stack([x + e, rate, faster[0] + faster[1], torque])


def _substeps(spring: Spring, period: float) -> int:
    return int(np.ceil(period / CONTACT_STEP - 1e-6)) if spring.play else 1


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
    """Deflection of the motor ahead of the link [rad, m]. Shape (rows,)."""
    velocity: Array = field(init=False)
    """Velocity of the motor. Shape (rows,)."""

    def begin(self, start: Start, plant: Plant, velocity: Array) -> tuple[Array, Array]:
        """Take over the rotor, and find where the links are behind the measured motors.

        Returns:
            How far the links are behind, and how fast they fall behind. Shapes (rows,).
        """
        link, j, dof = start.link, self.joint, plant.address.dof[self.joint]
        assert link is not None
        more = np.zeros((2, plant.rows))
        if "dof_frictionloss" in plant.fields:
            more[0] = plant.fields["dof_frictionloss"][:, dof] - plant.model.dof_frictionloss[dof]
        if "dof_damping" in plant.fields:
            more[1] = (
                plant.fields["dof_damping"][:, dof].reshape(plant.rows, -1)[:, 0]
                - np.ravel(plant.model.dof_damping[dof])[0]
            )
        typical = start.each(lambda piece: float(link.free_inertia[piece, j].mean()))
        rotor = np.maximum(plant.of("dof_armature")[:, dof], ROTOR_FLOOR * typical)
        x, rate, its_rate, torque = self._behind(start, more, rotor)

        armature = plant.of("dof_armature")
        self._link_inertia = link.free_inertia[:, j]
        self._rotor = rotor
        armature[:, dof] = 0.0
        self._start, self._period = start, link.period
        self._torque, self._link_velocity, self._steps = torque, velocity - rate, 0
        self._own = link.acceleration[start.sample, j] - its_rate - torque / self._link_inertia[start.sample]
        self.deflection, self.velocity = x, velocity.copy()
        return x, rate

    def _behind(self, start: Start, more: Array, rotor: Array) -> Array:
        """What :func:`observed` finds at each row's start, once for rows that start alike.

        The rows of a gradient mostly do: few of its parameters belong to the gear. Shape (4, rows).
        """
        link, j, spring = start.link, self.joint, self.spring
        assert link is not None
        alike = np.stack(
            np.broadcast_arrays(start.sample, spring.stiffness, spring.damping, spring.gap, *more, rotor), -1
        )
        _, some, row = np.unique(alike, axis=0, return_index=True, return_inverse=True)
        names = [(j, spring.play, alike[k].tobytes()) for k in some]
        if len(link.starts) > STARTS:
            link.starts.clear()
        new = some[[name not in link.starts for name in names]]
        if len(new):
            back = np.arange(-max(1, int(WARM_UP[int(spring.play)] / link.period)), 1)[:, None]
            first = start.first[new]
            before = np.maximum(start.sample[new] + back, first)
            load = link.load[before, j] + more[1, new] * link.velocity[before, j]
            if more[0].any():
                load += more[0, new] * link.sliding(j)[before]
            passed = start.command[before, j] - rotor[new] * link.acceleration[before, j]
            its_own = Spring(*alike[new, 1:4].T)
            found = observed(
                load, link.slopes(j)[:, before, j], its_own, link.period, passed, rotor[new],
                start.sample[new] + back < first,
            )  # fmt: skip
            link.starts.update(zip((n for n in names if n not in link.starts), found.T, strict=True))
        return np.stack([link.starts[name] for name in names], -1)[:, row.ravel()]

    def step(self, torque: Array, link_velocity: Array, now: Now) -> Array:
        """Move the motors by one step; return the torque on the links [N·m, N]. Shapes (rows,)."""
        if self._steps % max(1, round(COARSE / now.step)) == 0:
            self._look(now)
        own = self._own
        if self._steps:  # what moved the link in the step before, less the gear
            own = (link_velocity - self._link_velocity) / now.step - self._torque / self._inertia
        x, w, push = self.deflection, self.velocity - link_velocity, torque / self._rotor - own
        passed = np.zeros_like(torque)
        for _ in range(self._substeps):
            part = self.spring.torque(x, w, push, self._seen, self._softness, now.step / self._substeps)
            w = w + now.step / self._substeps * (push - part / self._seen)
            x = x + now.step / self._substeps * w
            passed += part / self._substeps
        self.deflection, self.velocity = x, self.velocity + now.step * (torque - passed) / self._rotor
        self._torque, self._link_velocity, self._steps = passed, link_velocity.copy(), self._steps + 1
        return passed

    def _look(self, now: Now) -> None:
        """Inertias of the pose that the recording has reached."""
        self._inertia = self._link_inertia[self._start.at(now.time + self._period / 2)]
        self._seen = 1.0 / (1.0 / self._rotor + 1.0 / self._inertia)
        self._substeps = _substeps(self.spring, now.step)
        self._softness = self.spring.softness(self._seen, now.step / self._substeps)
