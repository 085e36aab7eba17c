"""The concealed arm's drives on a robot that walks: bodies and ground are MuJoCo's, what drives the links is not.

The arm of :mod:`benchmarks.concealed.arm` stands on a table. A policy that was tuned in a simulator of it is to be
rehearsed on a quadruped, so its drives, the very same records and delays, turn the links of the whole robot here: gears
that bend, lag behind and rub, loops of their own at 1 kHz on rotor encoders, and readings from there. MuJoCo moves the
links at 0.2 ms, and the rotors follow by Runge-Kutta steps of half of that, while the links go on at their speed. What
the arm hides of its masses stays on the table.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any

import mujoco
import numpy as np
import torch
from numba import njit
from numpy.typing import NDArray
from tensordict import TensorDictBase
from torch import Tensor
from torchrl.envs import Transform, TransformedEnv

from benchmarks.concealed.arm import SIZES, ConcealedArm
from benchmarks.concealed.harmonic import (
    LOOP,
    PERIOD,
    RESOLUTION,
    SPEED_FILTER,
    SPEED_RESOLUTION,
    STEP,
    elastic_torque,
    slip_level,
)
from torchrl_athletic.physics import BatchPhysics
from torchrl_athletic.robots import Robot, with_options, z1
from torchrl_athletic.transforms import ActionDelay
from torchrl_athletic.transforms.simulated import simulated_env

TIMESTEP = 2 * STEP
"""Time step of MuJoCo [s]."""
SUBSTEPS = round(PERIOD / TIMESTEP)
"""Steps of MuJoCo between two commands."""
ROTOR, SPEED, FRICTION, HYSTERESIS, TORQUE = range(5)
"""Columns of a drive's state: [rad], [rad/s], [N·m], [N·m], [N·m]."""


class ConcealedDrives(BatchPhysics):
    """Robots whose arm joints are driven by the concealed drives; other joints take torques as before.

    Args:
        model: Of :func:`without_drives`.
        num_envs: N.
        robot: Gives gains and the joints of its arm, the first six of which are driven.
        fields: As of :class:`~torchrl_athletic.physics.BatchPhysics`.
    """

    def __init__(self, model: mujoco.MjModel, num_envs: int, robot: Robot, fields: tuple[str, ...] = ()) -> None:
        super().__init__(model, num_envs, fields=fields, joint_names=robot.joint_names)
        if not np.isclose(model.opt.timestep, TIMESTEP):
            raise ValueError(f"the model's step is {model.opt.timestep} s: the drives need {TIMESTEP} s.")
        arm = ConcealedArm(z1())
        self.arm = list(robot.joint_groups["arm"])[: len(SIZES)]
        joints = [model.joint(robot.joint_names[column]) for column in self.arm]
        self._q = np.array([int(joint.qposadr[0]) for joint in joints])
        self._v = np.array([int(joint.dofadr[0]) for joint in joints])
        gains = [np.array(gain)[self.arm] for gain in (robot.kp, robot.kd)]
        self._told = (arm._drives, *gains, arm._limit, arm._no_load, arm._torque_scale, arm._delay)
        shape = (num_envs, len(self.arm))
        self._x, self._register = np.zeros((*shape, 5)), np.zeros((2, *shape))
        self._targets = np.zeros((2, *shape))  # the last one, and the one before
        self._rest(np.arange(num_envs))

    def send(self, target: Tensor) -> None:
        """New position targets for the whole robot [rad], of which the drives take the arm's. Shape (N, joints)."""
        self._targets[1] = self._targets[0]
        self._targets[0] = target[:, self.arm].double().numpy()

    def reset(self, envs: Any = None, *arguments: Any, **told: Any) -> None:
        super().reset(envs, *arguments, **told)
        ids = self._ids(envs)
        self._rest(np.arange(self.num_envs) if ids is None else ids)

    def step(self, nstep: int = 1, refresh: bool = False, envs: Any = None) -> None:
        if nstep != SUBSTEPS:
            raise ValueError(f"{nstep} steps at once: the drives get a command every {SUBSTEPS}.")
        ids = self._ids(envs)
        rows = np.arange(self.num_envs) if ids is None else ids
        position, velocity, force = self.qpos.numpy(), self.qvel.numpy(), self._forces
        for step in range(nstep):
            force[np.ix_(rows, self._v)] = drive(
                self._x, self._register, rows, position[:, self._q], velocity[:, self._v], step, *self._targets,
                *self._told,
            )  # fmt: skip
            super().step(1, refresh and step == nstep - 1, envs)

    @property
    def joint_position(self) -> Tensor:
        read = super().joint_position.clone()
        read[:, self.arm] = torch.from_numpy(np.round(self._x[..., ROTOR] / RESOLUTION) * RESOLUTION)
        return read

    @property
    def joint_velocity(self) -> Tensor:
        read = super().joint_velocity.clone()
        read[:, self.arm] = torch.from_numpy(self._register[1])
        return read

    def _rest(self, rows: NDArray[np.int64]) -> None:
        """Drives stand where their links do."""
        link = self.qpos.numpy()[np.ix_(rows, self._q)]
        self._x[rows] = 0.0
        self._x[rows, :, ROTOR] = link
        self._register[0, rows], self._register[1, rows] = np.round(link / RESOLUTION) * RESOLUTION, 0.0
        self._targets[:, rows] = link


@njit(cache=True)
def drive(  # type: ignore[no-untyped-def]
    x, register, rows, position, velocity, step, target, last, p, kp, kd, limit, no_load, torque_scale, delay
):
    """Move the drives on by :data:`TIMESTEP`, and say with what mean torque their gears turn the links.

    Args:
        x: States, overwritten. Shape (N, J, 5).
        register: Last encoder reading [rad] and estimate of the speed [rad/s], overwritten. Shape (2, N, J).
        rows: That move. Shape (R,).
        position: Of the links [rad]. Shape (N, J).
        velocity: [rad/s]. Shape (N, J).
        step: How many were done since the last command.
        target: [rad]. Shape (N, J).
        last: The one before. Shape (N, J).
        p: Drives, records of :data:`~.harmonic.JOINT`. Shape (J,).
        kp: [N·m/rad]. Shape (J,).
        kd: [N·m·s/rad]. Shape (J,).
        limit: [N·m]. Shape (J,).
        no_load: [rad/s]. Shape (J,).
        torque_scale: [1]. Shape (J,).
        delay: [s].

    Returns:
        [N·m]. Shape (R, J).
    """
    out = np.zeros((rows.shape[0], p.shape[0]))
    per_loop = round(LOOP / TIMESTEP)
    loop_starts = step % per_loop == 0
    late = (step // per_loop) * LOOP < delay - 1e-9
    k, s = np.zeros((4, 5)), np.zeros(5)
    for i in range(rows.shape[0]):
        row = rows[i]
        for j in range(p.shape[0]):
            if loop_starts:
                reading = np.round(x[row, j, ROTOR] / RESOLUTION) * RESOLUTION
                register[1, row, j] += SPEED_FILTER * ((reading - register[0, row, j]) / LOOP - register[1, row, j])
                if abs(register[1, row, j]) < SPEED_RESOLUTION:
                    register[1, row, j] = 0.0
                register[0, row, j] = reading
            wanted = last[row, j] if late else target[row, j]
            speed = register[1, row, j]
            used = speed / no_load[j]
            torque = kp[j] * (wanted - register[0, row, j]) - kd[j] * speed
            torque = min(torque, limit[j] * (1.0 - min(max(used, 0.0), 1.0)))
            torque = max(torque, -limit[j] * (1.0 + max(min(used, 0.0), -1.0)))
            torque = torque_scale[j] * torque
            for half in range(2):
                here = position[row, j] + half * STEP * velocity[row, j]
                for stage in range(4):
                    share = 0.0 if stage == 0 else (1.0 if stage == 3 else 0.5)
                    for column in range(5):
                        s[column] = x[row, j, column] + share * STEP * (k[stage - 1, column] if stage > 0 else 0.0)
                    gear = slope(p[j], s, here + share * STEP * velocity[row, j], velocity[row, j], torque, k[stage])
                    out[i, j] += gear * (1.0 if stage in (0, 3) else 2.0) / 12.0
                for column in range(5):
                    x[row, j, column] += (
                        STEP / 6.0 * (k[0, column] + 2.0 * k[1, column] + 2.0 * k[2, column] + k[3, column])
                    )
    return out


@njit(cache=True)
def slope(p, s, position, velocity, wanted, out):  # type: ignore[no-untyped-def]
    """Time derivative of a drive's state, of shape (5,), beside its link; returns the gear's torque [N·m].

    The laws stand in :mod:`benchmarks.concealed.harmonic`.
    """
    windup_speed = s[SPEED] - velocity
    carried = elastic_torque(p, s[ROTOR] - position) + s[HYSTERESIS]
    gear = carried + p.gear_damping * windup_speed
    out[ROTOR] = s[SPEED]
    out[SPEED] = (s[TORQUE] - s[FRICTION] - p.viscous * s[SPEED] - gear) / p.rotor
    level = slip_level(p, s[SPEED], carried)
    out[FRICTION] = p.bristle_stiffness * (s[SPEED] - abs(s[SPEED]) * s[FRICTION] / level)
    out[HYSTERESIS] = p.hysteresis_stiffness * (windup_speed - abs(windup_speed) * s[HYSTERESIS] / p.hysteresis)
    out[TORQUE] = (wanted - s[TORQUE]) / p.lag
    return gear


def without_drives(robot: Robot) -> Robot:
    """A robot whose arm's joints turn freely: rotors and friction are the drives'. Steps are of :data:`TIMESTEP`."""
    names = tuple(robot.joint_names[column] for column in list(robot.joint_groups["arm"])[: len(SIZES)])
    return with_options(replace(robot, build=_WithoutDrives(robot.build, names)), timestep=TIMESTEP)


@dataclass(frozen=True)
class _WithoutDrives:
    build: Callable[[], mujoco.MjSpec]
    joints: tuple[str, ...]

    def __call__(self) -> mujoco.MjSpec:
        spec = self.build()
        for name in self.joints:
            joint = spec.joint(name)
            joint.armature, joint.frictionloss = 0.0, 0.0
            joint.damping = np.zeros_like(joint.damping)
        return spec


class SendTargets(Transform):
    """Hands position targets to the drives, between the delay of actions and the PD law of the other joints."""

    def __init__(self) -> None:
        super().__init__()

    def _inv_call(self, tensordict: TensorDictBase) -> TensorDictBase:
        simulated_env(self).physics.send(tensordict.get("action"))
        return tensordict


def put_on(env: TransformedEnv, robot: Robot) -> TransformedEnv:
    """Give an environment of :func:`without_drives`, made with ``substeps=SUBSTEPS``, the concealed drives."""
    physics = env.base_env.physics
    env.base_env.physics = ConcealedDrives(physics.model, physics.num_envs, robot, physics.fields)
    place = next(k for k, part in enumerate(env.transform.transforms) if isinstance(part, ActionDelay))
    return env.insert_transform(place, SendTargets())
