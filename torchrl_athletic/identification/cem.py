"""Friction, damping and armature of every joint by the cross-entropy method, the paper's parametric baseline."""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from numpy.typing import ArrayLike, NDArray
from torch import Tensor

from torchrl_athletic.functional.actuation import clip_torque_speed, pd_torque
from torchrl_athletic.identification.open_loop import (
    MOST,
    gains_of,
    identified_joints,
    on_all_joints,
    stacked,
    windows_of,
)
from torchrl_athletic.identification.simulator import Simulator
from torchrl_athletic.physics import BatchPhysics
from torchrl_athletic.recordings import Recording
from torchrl_athletic.robots import Robot, with_correction
from torchrl_athletic.robots.corrected import SCHEMA

Array = NDArray[np.float64]

PARAMETERS = (
    ("coulomb_friction", "torque", "N·m", "dof_frictionloss", (1e-3, 30.0)),
    ("viscous_friction", "damping", "N·m·s/rad", "dof_damping", (1e-4, 30.0)),
    ("reflected_inertia", "armature", "kg·m²", "dof_armature", (1e-5, 1.0)),
)
"""Effect, its parameter, unit, the model's field, and the bounds of the search."""


@dataclass(frozen=True)
class CEM:
    """How long to look, and how closely."""

    generations: int = 120
    population: int = 16
    windows: int = 32
    """Of the recordings, drawn once."""
    window: float = 1.0
    """Length of each [s]."""
    spread: float = 0.7
    """First standard deviation, of the parameters' logarithms [1]."""


def identify_cem(
    robot: Robot,
    recordings: Sequence[Recording],
    settings: CEM | None = None,
    *,
    seed: int = 0,
    progress: Callable[[int, float], None] | None = None,
) -> Simulator:
    """Find the friction, damping and armature with which the robot's simulation follows the recordings best.

    Minimises the mean squared error of the position over open-loop windows by CMA-ES, the cross-entropy method that
    adapts a whole covariance, over the logarithms of three parameters a joint.

    Args:
        robot: Whose joints are identified: the group ``"arm"``, or all.
        recordings: Takes to fit, of the same gains, all of them of targets or all of torques.
        settings: None takes the defaults.
        seed: Of the windows and the search.
        progress: Called with the generation and the best error so far [rad²].

    Raises:
        ImportError: If ``cmaes`` is not installed.
        ValueError: If the recordings differ in their gains.

    Source:
        Fey et al. 2025, section III-A, baseline "CEM"; Hansen 2016, https://arxiv.org/abs/1604.00772.
    """
    try:
        from cmaes import CMA  # type: ignore[import-untyped]
    except ImportError as error:
        raise ImportError("identify_cem searches with cmaes, which is not installed: pip install cmaes.") from error
    settings = settings or CEM()
    started = time.perf_counter()
    objective = WindowError(robot, recordings, settings, seed)
    bounds = np.log(np.repeat([bound for *_, bound in PARAMETERS], len(objective.joints), axis=0))
    mean = np.clip(np.log(objective.nominal), bounds[:, 0] + 1.0, bounds[:, 1] - 1.0)
    search = CMA(mean, settings.spread, bounds, seed=seed, population_size=settings.population)
    best, least = mean, np.inf
    for generation in range(settings.generations):
        asked = np.stack([search.ask() for _ in range(search.population_size)])
        errors = objective(np.exp(asked))
        search.tell(list(zip(asked, errors.tolist(), strict=True)))
        if errors.min() < least:
            best, least = asked[errors.argmin()], float(errors.min())
        if progress is not None:
            progress(generation, least)
        if search.should_stop():
            break
    notes = {
        "seed": seed,
        "training_seconds": time.perf_counter() - started,
        "data_seconds": float(sum(r.duration for r in recordings)),
        "fit_mse": least,
        "generations": generation + 1,
    }
    return Simulator("cem", robot, correction_of(objective.joints, np.exp(best)), notes=notes)


def correction_of(joints: Sequence[str], values: ArrayLike) -> dict[str, Any]:
    """Friction, damping and armature as the content of a ``corrected.json``.

    Args:
        joints: Names. Length J.
        values: All frictions, then all dampings, then all armatures. Shape (3 J,).
    """
    found = np.split(np.asarray(values, dtype=np.float64), len(PARAMETERS))
    effects = [
        {"effect": effect, "joint": joint, "parameters": {name: {"value": float(value), "unit": unit}}}
        for (effect, name, unit, *_), of_joints in zip(PARAMETERS, found, strict=True)
        for joint, value in zip(joints, of_joints, strict=True)
    ]
    return {"schema": SCHEMA, "joint_names": list(joints), "effects": effects, "trims": []}


class WindowError:
    """Error of a population of parameter sets over open-loop windows, all simulated at once.

    Args:
        robot: As given.
        recordings: To draw windows from.
        settings: How many, and how long; the population.
        seed: Of the draw.
    """

    def __init__(self, robot: Robot, recordings: Sequence[Recording], settings: CEM, seed: int = 0) -> None:
        given = Simulator("default", robot)
        takes = [on_all_joints(given, recording) for recording in recordings]
        if len({gains_of(recording) for recording in recordings}) > 1:
            raise ValueError(
                "the recordings were made with several sets of gains, or some with torques: they cannot be simulated "
                "in one batch. Fit those of one kind."
            )
        self.joints = [n for n in identified_joints(given) if n in recordings[0].joint_names]
        self.columns = [robot.joint_names.index(name) for name in self.joints]
        start = _draw([windows_of(r, settings.window) for r in recordings], settings.windows, seed)
        steps = max(1, round(settings.window * recordings[0].rate))
        self.command = stacked([t.command for t in takes], start, range(steps)).double()
        self.position = stacked([t.position for t in takes], start, range(steps + 1)).double()
        self.velocity = stacked([t.velocity for t in takes], start, range(1)).double()[:, 0]
        gains = (takes[0].kp, takes[0].kd)
        self.gains = None if gains[0] is None else tuple(torch.from_numpy(g) for g in gains if g is not None)
        self.limits = torch.tensor(robot.torque_limit), torch.tensor(robot.velocity_limit)
        model = robot.model()
        self.dof = [int(model.joint(name).dofadr[0]) for name in self.joints]
        self.qpos = [int(model.joint(name).qposadr[0]) for name in robot.joint_names]
        self.qvel = [int(model.joint(name).dofadr[0]) for name in robot.joint_names]
        self.nominal = self._nominal(robot, model)
        # the softness of friction with which the found values will be simulated
        model = with_correction(robot, correction_of(self.joints, self.nominal)).model()
        self.rest = torch.tensor(model.key(robot.keyframe).qpos)
        fields = [field for *_, field, _ in PARAMETERS]
        rows = settings.population * len(self.command)
        self.physics = BatchPhysics(model, rows, fields=fields, joint_names=robot.joint_names)

    def _nominal(self, robot: Robot, model: Any) -> Array:
        """What the model has; where that is nothing, a small part of what the motor can do. Shape (3 J,)."""
        limit = np.asarray(robot.torque_limit)[self.columns]
        little = (0.02 * limit, 0.01 * limit, np.full(len(limit), 1e-3))
        given = (np.ravel(getattr(model, field))[self.dof] for *_, field, _ in PARAMETERS)
        return np.concatenate([np.where(g > 0, g, small) for g, small in zip(given, little, strict=True)])

    def __call__(self, values: Array) -> Array:
        """Mean squared error of each parameter set [rad²].

        Args:
            values: All frictions, then all dampings, then all armatures, of K sets. Shape (K, 3 J).

        Returns:
            Shape (K,). An error counts for no more than :data:`~.open_loop.MOST`.
        """
        sets, windows = len(values), len(self.command)
        full = np.concatenate([values, np.repeat(values[:1], self.physics.num_envs // windows - sets, axis=0)])
        of_rows = np.repeat(full, windows, axis=0)
        for (*_, field, _), part in zip(PARAMETERS, np.split(of_rows, len(PARAMETERS), axis=1), strict=True):
            held = self.physics.field(field)
            held.reshape(len(held), held.shape[1], -1)[:, self.dof, 0] = torch.from_numpy(part)
        times = self.physics.num_envs // windows
        qpos = self.rest.expand(self.physics.num_envs, -1).clone()
        qvel = torch.zeros(self.physics.num_envs, self.physics.model.nv, dtype=torch.float64)
        qpos[:, self.qpos] = self.position[:, 0].repeat(times, 1)
        qvel[:, self.qvel] = self.velocity.repeat(times, 1)
        self.physics.reset(qpos=qpos, qvel=qvel)
        squared = torch.zeros(self.physics.num_envs, dtype=torch.float64)
        for k in range(self.command.shape[1]):
            self.physics.apply_torque(self._torque(self.command[:, k].repeat(times, 1)))
            self.physics.step()
            error = self.physics.joint_position[:, self.columns] - self.position[:, k + 1, self.columns].repeat(
                times, 1
            )
            squared += error.nan_to_num(MOST).clamp(-MOST, MOST).square().mean(-1)
        mean = squared.reshape(times, windows).mean(-1) / self.command.shape[1]
        return mean[:sets].numpy()

    def _torque(self, command: Tensor) -> Tensor:
        """As :meth:`Simulator.chain` without a net makes it of a command."""
        position, velocity = self.physics.joint_position, self.physics.joint_velocity
        torque = command if self.gains is None else pd_torque(command, position, velocity, *self.gains)
        return clip_torque_speed(torque, velocity, *self.limits)


def _draw(windows: Sequence[NDArray[np.intp]], count: int, seed: int) -> list[NDArray[np.intp]]:
    """Starts of ``count`` of all windows, without repeats, by take."""
    sizes = [len(w) for w in windows]
    chosen = np.random.default_rng(seed).permutation(sum(sizes))[:count]
    first = np.concatenate([[0], np.cumsum(sizes)])
    return [
        w[np.sort(chosen[(chosen >= first[k]) & (chosen < first[k + 1])]) - first[k], 0] - 1
        for k, w in enumerate(windows)
    ]
