"""Friction, damping and armature of every joint by the cross-entropy method, the paper's parametric baseline."""

from __future__ import annotations

import time
from collections.abc import Callable, Mapping, Sequence
from copy import deepcopy
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import torch
from numpy.typing import ArrayLike, NDArray

from torchrl_athletic.identification.open_loop import (
    MOST,
    gains_of,
    identified_joints,
    open_loop_env,
    simulate,
    windows_of,
)
from torchrl_athletic.identification.simulator import Simulator
from torchrl_athletic.identification.takes import on_all_joints
from torchrl_athletic.recordings import Recording
from torchrl_athletic.robots import Robot
from torchrl_athletic.robots.corrected import SCHEMA

Array = NDArray[np.float64]

PARAMETERS = (
    ("coulomb_friction", "torque", "N·m", "dof_frictionloss", (1e-3, 30.0)),
    ("viscous_friction", "damping", "N·m·s/rad", "dof_damping", (1e-4, 30.0)),
    ("reflected_inertia", "armature", "kg·m²", "dof_armature", (1e-5, 1.0)),
)
"""Effect, its parameter, unit, the model's field, and the bounds of the search."""
HELD = {
    "asymmetric_friction": ("coulomb_friction", "viscous_friction"),
    "stribeck_friction": ("coulomb_friction",),
}
"""Effects of a given correction that hold a joint's friction in numbers of their own, which then stay as they are."""


@dataclass(frozen=True)
class Free:
    """A number that is searched for."""

    effect: str
    parameter: str
    unit: str
    field: str
    bounds: tuple[float, float]
    joint: str


@dataclass(frozen=True)
class CEM:
    """How long to look, and how closely."""

    generations: int = 120
    population: int = 16
    windows: int = 32
    """Number of windows of the recordings, drawn once."""
    window: float = 1.0
    """Length of each [s]."""
    spread: float = 0.7
    """First standard deviation, of the parameters' logarithms [1]."""


def identify_cem(
    robot: Robot,
    recordings: Sequence[Recording],
    settings: CEM | None = None,
    *,
    given: Simulator | None = None,
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
        given: Where to start from instead of the robot as it is, a diagnosed simulator say, whose other physics stays.
        seed: Of the windows and the search.
        progress: Called with the generation and the best error so far [rad²].

    Returns:
        A simulator of the name ``"cem"``, or of the given one's.

    Raises:
        ImportError: If ``cmaes`` is not installed.
        ValueError: If the recordings differ in their gains.

    Source:
        Fey et al. 2025, section III-A, baseline "CEM"; Hansen 2016, https://arxiv.org/abs/1604.00772.
    """
    try:
        from cmaes import CMA  # type: ignore[import-untyped]
    except ImportError as error:
        raise ImportError(
            "identify_cem searches with cmaes, which is not installed. Install the extra: "
            "pip install 'torchrl-athletic[identification]'."
        ) from error
    settings, started = settings or CEM(), time.perf_counter()
    base = Simulator("cem", robot) if given is None else given
    objective = WindowError(base, recordings, settings, seed)
    bounds = np.log([free.bounds for free in objective.free])
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
    seconds = float(base.notes.get("training_seconds", 0.0)) + time.perf_counter() - started
    seen = float(base.notes.get("data_seconds", 0.0))  # by what gave the base; of the windows some may be the same
    notes = {
        **base.notes,
        "seed": seed,
        "training_seconds": seconds,
        "data_seconds": min(seen + objective.seconds, sum(r.duration for r in recordings)),
        "fit_mse": least,
        "generations": generation + 1,
    }
    return replace(base, correction=correction_with(base.correction, objective.free, np.exp(best)), notes=notes)


def correction_of(joints: Sequence[str], values: ArrayLike) -> dict[str, Any]:
    """Friction, damping and armature as the content of a ``corrected.json``.

    Args:
        joints: Names. Length J.
        values: All frictions, then all dampings, then all armatures. Shape (3 J,).
    """
    return correction_with(None, free_parameters(joints, None), values)


def correction_with(given: Mapping[str, Any] | None, free: Sequence[Free], values: ArrayLike) -> dict[str, Any]:
    """A correction with numbers changed, or added where it has none of that effect and joint."""
    content: dict[str, Any] = {"schema": SCHEMA, "effects": [], "trims": []}
    content["joint_names"] = list(dict.fromkeys(f.joint for f in free))
    if given is not None:
        content = deepcopy(dict(given))
    entries = {(e["effect"], e["joint"]): e for e in (*content["effects"], *content["trims"])}
    for f, value in zip(free, np.asarray(values, dtype=np.float64), strict=True):
        if (f.effect, f.joint) in entries:
            entries[f.effect, f.joint]["parameters"][f.parameter]["value"] = float(value)
        else:
            parameter = {f.parameter: {"value": float(value), "unit": f.unit}}
            content["effects"].append({"effect": f.effect, "joint": f.joint, "parameters": parameter})
    return content


def free_parameters(joints: Sequence[str], given: Mapping[str, Any] | None) -> list[Free]:
    """Three numbers a joint, but for those that a given correction holds in another form."""
    entries = [] if given is None else [*given["effects"], *given["trims"]]
    held = {(effect, e["joint"]) for e in entries for effect in HELD.get(e["effect"], ())}
    return [
        Free(effect, parameter, unit, field, bounds, joint)
        for effect, parameter, unit, field, bounds in PARAMETERS
        for joint in joints
        if (effect, joint) not in held
    ]


class WindowError:
    """Error of a population of parameter sets over open-loop windows, all simulated at once.

    Args:
        simulator: Without a net; what it holds beside the searched numbers stays.
        recordings: To draw windows from.
        settings: How many, and how long; the population.
        seed: Of the draw.
    """

    def __init__(
        self, simulator: Simulator, recordings: Sequence[Recording], settings: CEM | None = None, seed: int = 0
    ) -> None:
        if len({gains_of(recording) for recording in recordings}) > 1:
            raise ValueError(
                "the recordings were made with several sets of gains, or some with torques: they cannot be simulated "
                "in one batch. Fit those of one kind."
            )
        settings, robot = settings or CEM(), simulator.robot
        joints = [n for n in identified_joints(simulator) if n in recordings[0].joint_names]
        self.columns = [robot.joint_names.index(name) for name in joints]
        self.free = free_parameters(joints, simulator.correction)
        self.nominal = _nominal(robot, self.free)
        # with the softness of friction that the found values will be simulated with
        simulator = replace(simulator, correction=correction_with(simulator.correction, self.free, self.nominal))
        takes = [on_all_joints(recording, robot) for recording in recordings]
        index = _draw([windows_of(take, settings.window) for take in takes], settings.windows, seed)
        self.takes, self.index = zip(*[(t, i) for t, i in zip(takes, index, strict=True) if len(i)], strict=True)
        self.steps = max(i.shape[1] for i in self.index)
        self.seconds = sum(i.size for i in self.index) * float(robot.model().opt.timestep)
        self.measured = np.concatenate([t.position[i] for t, i in zip(self.takes, self.index, strict=True)])
        self.population = settings.population
        fields = tuple(dict.fromkeys(f.field for f in self.free))
        self.env = open_loop_env(simulator, takes[0], self.population * len(self.measured), fields)
        self.dof = [int(robot.model().joint(f.joint).dofadr[0]) for f in self.free]

    def __call__(self, values: Array) -> Array:
        """Mean squared error of each parameter set [rad²].

        Args:
            values: Of the numbers in :attr:`free`, of K sets, no more than the population. Shape (K, P).

        Returns:
            Shape (K,). An error counts for no more than :data:`~.open_loop.MOST`.
        """
        sets, windows, physics = len(values), len(self.measured), self.env.base_env.physics
        full = np.concatenate([values, np.repeat(values[:1], self.population - sets, axis=0)])
        of_rows = torch.from_numpy(np.repeat(full, windows, axis=0))
        for k, (free, dof) in enumerate(zip(self.free, self.dof, strict=True)):
            field = physics.field(free.field)
            field.reshape(len(field), field.shape[1], -1)[:, dof, 0] = of_rows[:, k]
        times = self.population
        position, _ = simulate(self.env, self.takes * times, self.index * times, self.steps)
        error = position.reshape(times, *self.measured.shape)[..., self.columns] - self.measured[..., self.columns]
        squared = np.clip(np.nan_to_num(error, nan=MOST), -MOST, MOST) ** 2
        return np.asarray(squared.mean((1, 2, 3))[:sets])


def _nominal(robot: Robot, free: Sequence[Free]) -> Array:
    """What the model has; where that is nothing, a small part of what the motor can do. Shape (P,)."""
    model = robot.model()
    limit = dict(zip(robot.joint_names, robot.torque_limit, strict=True))
    little = {"dof_frictionloss": 0.02, "dof_damping": 0.01, "dof_armature": 1e-3}
    out = []
    for f in free:
        has = float(np.ravel(getattr(model, f.field)[model.joint(f.joint).dofadr[0]])[0])
        small = little[f.field] * (1.0 if f.field == "dof_armature" else limit[f.joint])
        out.append(has if has > 0 else small)
    return np.array(out)


def _draw(windows: Sequence[NDArray[np.intp]], count: int, seed: int) -> list[NDArray[np.intp]]:
    """``count`` of all windows, without repeats, by take."""
    sizes = [len(w) for w in windows]
    chosen = np.random.default_rng(seed).permutation(sum(sizes))[:count]
    first = np.concatenate([[0], np.cumsum(sizes)])
    return [
        w[np.sort(chosen[(chosen >= first[k]) & (chosen < first[k + 1])]) - first[k]] for k, w in enumerate(windows)
    ]
