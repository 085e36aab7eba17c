"""What an effect may change in a batch of simulations: fields of the model, and the way from command to torque.

The way of a torque, at every physics step and in every row: command (late by ``delay`` and ``clock_offset``), position
controller (``kp_scale``, ``kd_scale``, on what the encoder reads), ``lag``, ``torque_limit``, ``motor`` laws,
``torque_scale`` and ``torque_offset``, the model's motor range, ``gears``, and beside the joint the torques of
``laws``.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable
from dataclasses import dataclass, field
from functools import cached_property
from operator import attrgetter
from typing import TYPE_CHECKING

import mujoco
import numpy as np
from numpy.typing import NDArray

from torchrl_athletic.effects.signals import JointAddress

if TYPE_CHECKING:
    from torchrl_athletic.effects.gear import Gear, LinkMotion

Array = NDArray[np.float64]

STIFFEST = (0.99, 0.99, 1e-3, 0.5, 2.0)
"""MuJoCo's ``solimp`` of ideal dry friction."""


@dataclass(frozen=True, eq=False)
class Start:
    """Where the rows start: S samples of gap-free pieces, measured before the first prediction and after."""

    time: Array
    """Stamps of the grid [s]. Shape (S,)."""
    position: Array
    """As the encoder reads, locally smoothed [rad, m]. Shape (S, J)."""
    velocity: Array
    """Shape (S, J)."""
    command: Array
    """Torque commanded, with the logged gains where positions are, until the next sample [N·m, N]. Shape (S, J)."""
    sample: NDArray[np.intp]
    """From which each row starts. Shape (rows,)."""
    link: LinkMotion | None = None
    """What the links ask for along the pieces; only gears need it."""
    begins: NDArray[np.intp] = field(default_factory=lambda: np.zeros(1, dtype=np.intp))
    """Sample at which each piece begins, the first of which is 0: between them the motion jumps. Shape (pieces,)."""
    began: Array | None = None
    """Stamp at which the take of each piece began [s], if not with the piece. Shape (pieces,)."""
    mean_reading: Array | None = None
    """Mean reading of the take of each piece (see :attr:`Recording.mean_reading`). Shape (pieces,)."""

    @cached_property
    def piece(self) -> NDArray[np.intp]:
        """In which each row starts. Shape (rows,)."""
        return np.searchsorted(self.begins, self.sample, side="right") - 1

    @cached_property
    def first(self) -> NDArray[np.intp]:
        """First sample of each row's piece. Shape (rows,)."""
        return self.begins[self.piece]

    @cached_property
    def last(self) -> NDArray[np.intp]:
        """Last sample of each row's piece. Shape (rows,)."""
        return np.append(self.begins[1:], len(self.time))[self.piece] - 1

    def at(self, time: Array) -> NDArray[np.intp]:
        """Sample of its own piece that each row has reached. ``time``: stamps [s], shape (rows,)."""
        passed = (time - self.time[self.first]) / (self.time[1] - self.time[0])
        return np.clip(self.first + np.floor(passed + 1e-6).astype(np.intp), self.first, self.last)

    @cached_property
    def pieces(self) -> list[slice]:
        """Samples of each piece."""
        return [slice(a, b) for a, b in zip(self.begins, [*self.begins[1:], len(self.time)], strict=True)]

    def each(self, number: Callable[[slice], float]) -> Array:
        """A number of each row's piece, found once a piece. Shape (rows,)."""
        return np.array([number(piece) for piece in self.pieces])[self.piece]

    def of(self, history: Callable[..., Array], *parameters: Array) -> Array:
        """A hidden state at each row's start, found along the whole piece, once for rows with the same parameters.

        Args:
            history: Takes the piece and one number a parameter, returns the state at its samples. Shape (its S, ...).
            parameters: Shape (rows,) each.

        Returns:
            Shape (rows, ...).
        """
        distinct, row = np.unique(np.stack([self.piece, *parameters], -1), axis=0, return_inverse=True)
        found = [history(self.pieces[int(piece)], *values) for piece, *values in distinct]
        along = self.sample - self.first
        return np.stack([found[k][at] for k, at in zip(row.ravel(), along, strict=True)])


@dataclass(eq=False)
class Now:
    """One physics step of all rows."""

    position: Array
    """Position of the joints: of the motor for ``motor`` laws, of the link for ``laws`` [rad, m]. Shape (rows, J)."""
    velocity: Array
    """Shape (rows, J)."""
    torque: Array
    """So far on its way from the motor to the joint [N·m, N]. Shape (rows, J)."""
    time: Array
    """In the take's stamps [s]. Shape (rows,)."""
    step: float
    """[s]."""


class Law(ABC):
    """A torque law with a hidden state, such as a bristle's deflection. A function of :class:`Now` does without one.

    Rows are independent: row k must not look at row n.
    """

    def begin(self, start: Start) -> None:  # noqa: B027  a law without a state has nothing to begin
        """Set the hidden state of every row, from the motion measured before it. Called once, before the first step."""

    @abstractmethod
    def __call__(self, now: Now) -> Array:
        """Torque [N·m, N]. Shape (rows, J)."""


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
    motor: list[Callable[[Now], Array]] = field(default_factory=list)
    """Each turns the motor's torque into another, in the order of the list."""
    laws: list[Callable[[Now], Array]] = field(default_factory=list)
    """Torques that MuJoCo cannot express, added at the joints, beside the motor and beyond its range."""
    gears: list[Gear] = field(default_factory=list)
    """Motors that do not sit rigidly on their joint."""
    delay: Array = field(init=False)
    """Delay of the command [s]."""
    lag: Array = field(init=False)
    """Time constant of the torque loop [s]."""
    torque_limit: Array = field(init=False)
    """Most torque of the motor in either direction, before its laws apply [N·m]."""
    torque_scale: Array = field(init=False)
    """Torque at the joint per commanded torque [1]."""
    torque_offset: Array = field(init=False)
    """Added to the torque [N·m]."""
    kp_scale: Array = field(init=False)
    """True gain per logged gain [1]."""
    kd_scale: Array = field(init=False)
    """True gain per logged gain [1]."""
    encoder_scale: Array = field(init=False)
    """Reading per true position [1]: reading = scale * true + offset, and its rate likewise."""
    encoder_offset: Array = field(init=False)
    """Reading at the true zero [rad]."""
    clock_offset: Array = field(init=False)
    """How late the stamps of positions are against those of commands [s], either sign. Shape (rows,)."""
    base_offset: Array = field(init=False)
    """How late the stamps of a floating base are against those of the joints [s], either sign. Shape (rows,)."""

    def __post_init__(self) -> None:
        shape = (self.rows, len(self.address.dof))
        for name in ("delay", "lag", "torque_offset", "encoder_offset"):
            setattr(self, name, np.zeros(shape))
        for name in ("torque_scale", "kp_scale", "kd_scale", "encoder_scale"):
            setattr(self, name, np.ones(shape))
        self.torque_limit = np.full(shape, np.inf)
        self.clock_offset, self.base_offset = np.zeros(self.rows), np.zeros(self.rows)

    def of(self, name: str) -> Array:
        """Per-row values of a model field, also ``"opt.gravity"``, to be written in place. Shape (rows, *field)."""
        if name not in self.fields:
            value = np.asarray(attrgetter(name)(self.model), dtype=np.float64)
            self.fields[name] = np.repeat(value[None], self.rows, axis=0)
        return self.fields[name]

    def set_dry_friction(self, joint: int, torque: Array) -> None:
        """Ideal Coulomb friction: MuJoCo's ``frictionloss`` with the stiffest regularisation that the time step allows.

        With the default ``solref`` the force turns over about 10 ms before the velocity does, which no bearing does.
        """
        dof = self.address.dof[joint]
        self.of("dof_frictionloss")[:, dof] = torque
        self.of("dof_solref")[:, dof] = (2 * self.model.opt.timestep, 1.0)
        self.of("dof_solimp")[:, dof] = STIFFEST

    @property
    def open_loop(self) -> bool:
        """True if no torque depends on the state."""
        return not (self.motor or self.laws or self.gears)
