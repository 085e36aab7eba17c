"""What an environment may ask of the simulation behind it, whatever runs it."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from typing import Protocol, TypeAlias, TypeVar, runtime_checkable

import mujoco
import torch
from numpy.typing import ArrayLike
from torch import Tensor

Envs: TypeAlias = Tensor | Sequence[int] | None
"""Which envs a call concerns: a bool mask (N,), ids, or None for all of them."""
Values: TypeAlias = Tensor | ArrayLike
"""One value for every env, or one row per env of the batch (N, ...); rows of envs not concerned are not looked at."""
Result = TypeVar("Result")


class CapacityError(RuntimeError):
    """Contacts or constraints were left out of a simulation, because no room had been set aside for them."""


@runtime_checkable
class Physics(Protocol):
    """N simulations of one MuJoCo model, advanced together.

    State is read and written in place through tensors that stay the same object: ``physics.qvel[3] = 0`` stops env 3.
    Inputs (``ctrl``, ``qfrc_applied``, ``xfrc_applied``) act until they are overwritten, as in MuJoCo. J joints of one
    degree of freedom each, ``joint_names``, are the ones that :meth:`apply_torque` drives.
    """

    model: mujoco.MjModel
    """What every env simulates but for its own ``fields``. It was copied: an edit afterwards changes no simulation."""
    num_envs: int
    """N."""
    device: torch.device
    dtype: torch.dtype
    joint_names: tuple[str, ...]
    """Length J."""
    fields: tuple[str, ...]
    """The ``mjModel`` fields that each env has values of its own for."""

    @property
    def timestep(self) -> float:
        """Duration of one physics step [s]."""

    @property
    def time(self) -> Tensor:
        """Since the env's reset [s]. Shape (N,)."""

    @property
    def qpos(self) -> Tensor:
        """Generalised positions [m, rad, quaternions 1]. Shape (N, nq)."""

    @property
    def qvel(self) -> Tensor:
        """Generalised velocities [m/s, rad/s]. Shape (N, nv)."""

    @property
    def ctrl(self) -> Tensor:
        """Inputs of the model's actuators, in their units. Shape (N, nu)."""

    @property
    def qfrc_applied(self) -> Tensor:
        """Generalised forces from outside [N, N·m]. Shape (N, nv)."""

    @property
    def xfrc_applied(self) -> Tensor:
        """Force [N] and torque [N·m] on each body's centre of mass, in world axes. Shape (N, nbody, 6)."""

    @property
    def joint_position(self) -> Tensor:
        """Positions of ``joint_names``, to be read [rad, m for slides]. Shape (N, J)."""

    @property
    def joint_velocity(self) -> Tensor:
        """Velocities of ``joint_names``, to be read [rad/s, m/s for slides]. Shape (N, J)."""

    @property
    def diverged(self) -> Tensor:
        """Envs whose simulation cannot be trusted since their last reset. Bool, shape (N,).

        MuJoCo on the CPU answers a bad state by restarting from the default pose, which looks healthy, and on a GPU by
        nothing at all: this mask tells.
        """

    def data(self, name: str) -> Tensor:
        """A field of ``mjData`` by name: ``"sensordata"``, ``"xpos"``, ``"qacc"``, ``"act"``. Shape (N, ...).

        State fields are to be written too. Derived ones are refreshed by each call; after :meth:`step` they describe
        the state before its last physics step, as after ``mj_step``, unless it was told to refresh them. What follows
        from accelerations and contact forces (``qacc``, sensors of touch and acceleration) always does: between a
        reset and the next step or :meth:`forward` it means nothing.
        """

    def field(self, name: str) -> Tensor:
        """Per-env values of one of ``fields``. Shape (N, ...).

        To be written directly only if ``mj_setConst`` does not read the field (``dof_frictionloss``, ``dof_damping``,
        ``geom_friction`` are free, masses are not), and unchecked. Otherwise take :meth:`set_field`.
        """

    def set_field(self, name: str, value: Values, envs: Envs = None) -> None:
        """Give envs their own values of one of ``fields``, with the constants that follow, and read them back.

        Raises:
            ValueError: If the field was not declared, or does not hold the values afterwards, or if the model's flags
                would make the simulation ignore them.
        """

    def set_fields(self, values: Mapping[str, Values], envs: Envs = None) -> None:
        """Write several of ``fields`` as :meth:`set_field` does, and compute what follows from all of them once.

        Args:
            values: By name.
            envs: Mask or ids; the others are not touched.
        """

    def raise_up(self, height: Tensor) -> None:
        """Lift all that floats freely, with everything that hangs on it.

        Positions in the world that were looked at through :meth:`data` follow.

        Args:
            height: By how much [m]. Shape (N, 1).
        """

    def reset(
        self, envs: Envs = None, keyframe: int | str = -1, qpos: Values | None = None, qvel: Values | None = None
    ) -> None:
        """Put envs at the model's default state or a keyframe, then at ``qpos`` and ``qvel`` where given.

        Time, inputs, activations, warm start and ``diverged`` of these envs start anew; their per-env fields stay.

        Args:
            envs: Mask or ids; the others are not touched.
            keyframe: Id or name; -1 for the default state.
            qpos: Shape (nq,) or (N, nq).
            qvel: Shape (nv,) or (N, nv).
        """

    def apply_torque(self, torque: Tensor) -> None:
        """Drive ``joint_names`` from now on, past actuators and their limits, through ``qfrc_applied``.

        Args:
            torque: [N·m, N for slides]. Shape (N, J).
        """

    def apply_wrench(self, body: str, force: Values = 0.0, torque: Values = 0.0) -> None:
        """Pull and twist a body at its centre of mass from now on, in world axes, through ``xfrc_applied``.

        Args:
            body: Name of the body.
            force: [N]. Shape (3,) or (N, 3).
            torque: [N·m]. Shape (3,) or (N, 3).
        """

    def step(self, nstep: int = 1, refresh: bool = False, envs: Envs = None) -> None:
        """Advance envs by ``nstep`` physics steps.

        Args:
            nstep: Physics steps under the same inputs.
            refresh: Whether poses (``xpos``, ``site_xpos``, ``subtree_com``...), velocities (``cvel``) and the sensors
                of position and velocity shall describe the new state.
            envs: Mask or ids of those that advance; the others are not touched.
        """

    def forward(self, envs: Envs = None) -> None:
        """Compute everything that follows from the state, which stays as it is."""

    def rollout(
        self, nstep: int, control: Tensor | None = None, into: str = "ctrl", record: Sequence[str] = ("qpos", "qvel")
    ) -> dict[str, Tensor]:
        """Advance every env by ``nstep`` physics steps, open loop.

        An env that diverges stops there and repeats its last record; see :attr:`diverged`.

        Args:
            nstep: Physics steps T.
            control: What acts during each step. Shape (N, T, ...). None leaves the inputs as they are.
            into: What ``control`` is: ``"torque"`` (N, T, J) as in :meth:`apply_torque`, ``"ctrl"`` (N, T, nu),
                ``"qfrc_applied"`` (N, T, nv) or ``"xfrc_applied"`` (N, T, nbody, 6).
            record: Names for :meth:`data`, recorded after each step.

        Returns:
            Name -> shape (N, T, ...).
        """

    def check(self) -> None:
        """Make sure that no contact and no constraint was left out for want of room. Waits for the device.

        Raises:
            CapacityError: If one was. Says which capacity it takes.
        """

    def capture(self, function: Callable[[], Result], warmup: int = 3) -> Callable[[], Result]:
        """Something that does what ``function`` does, faster where the device can replay recorded work.

        Args:
            function: A step of training or control that calls this physics. On CUDA all of it is recorded: it must
                not wait for the device, nor branch on values there, and it works on tensors that stay where they are.
                What it returns is overwritten by the next call.
            warmup: Calls before the recording. The simulation's state is put back afterwards; what else the function
                changes is not.

        Returns:
            The function to call instead.
        """
