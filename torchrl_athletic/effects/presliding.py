"""What happens before a joint slides: the bristles of the contact, and the hysteresis that wide ones leave."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import ClassVar

import mujoco
import numpy as np

from torchrl_athletic.effects.effect import (
    Array,
    Effect,
    Fingerprint,
    Parameter,
    is_slide,
    local,
    torque_bound,
    torque_scale,
    torque_unit,
)
from torchrl_athletic.effects.plant import Law, Now, Plant, Start
from torchrl_athletic.effects.signals import JointAddress, Signals, presliding_width

NARROWEST = 6e-3
"""Width below which what builds up after a reversal is dry friction's presliding [rad]; a tenth of it in metres."""
WIDTHS = (0.012, 0.02, 0.033, 0.055, 0.09, 0.15, 0.24, 0.4)
"""Widths of a hysteresis, on a joint that travels a radian or more [rad].

The presliding of dry friction lies below them.
"""


def sliding(position: Array, widths: Array, relaxed: bool = False) -> Array:
    r"""Direction of sliding in [-1, 1], which turns over within a presliding width of a reversal.

    The exact solution of :math:`dz = (\mathrm{sign}(dq) - z)\,|dq| / w` along the motion (Dahl 1968), for several
    widths at once.

    Args:
        position: Shape (M,).
        widths: w > 0 [rad, m]. Shape (W,).
        relaxed: Whether it starts from 0, where nothing is strained, or as if it had always slid as it first does.

    Returns:
        Shape (M, W).

    Example:
        >>> sliding(np.array([0.0, 1.0, 2.0, 1.0]), np.array([0.5]))[:, 0].round(2).tolist()
        [1.0, 1.0, 1.0, -0.73]
    """
    step = np.diff(position)
    direction = np.sign(step)
    moving = np.flatnonzero(direction)
    if not len(moving):
        return np.zeros((len(position), len(widths)))
    starts = moving[np.flatnonzero(np.diff(direction[moving], prepend=0.0))]  # first step of each run in one direction
    towards = direction[starts]
    path = np.concatenate([[0.0], np.cumsum(np.abs(step))])
    kept = np.exp(-np.diff(np.append(path[starts], path[-1]))[:, None] / widths)
    state = np.empty((len(starts), len(widths)))  # at the start of each run
    state[0] = 0.0 if relaxed else towards[0]
    for run in range(len(starts) - 1):
        state[run + 1] = towards[run] + (state[run] - towards[run]) * kept[run]
    run_of = np.maximum(np.searchsorted(starts, np.arange(len(position)) - 1, side="right") - 1, 0)
    gone = np.maximum(path - path[starts][run_of], 0.0)
    ahead = towards[run_of][:, None]
    return np.asarray(ahead + (state[run_of] - ahead) * np.exp(-gone[:, None] / widths), dtype=np.float64)


def forms(s: Signals, joint: int) -> list[dict[str, float]]:
    """How dry friction may turn over at a reversal, which no parameter states and every dry friction tries alike.

    Over ``presliding`` widths of 0.3, 1.5 and 4 mrad, on a joint that travels a radian or more; or, where ``creep`` is
    positive, with the sign of the velocity, within that speed.
    """
    width, fastest = presliding_width(s, joint), float(np.abs(s.velocity[:, joint]).max())
    by_way = [{"presliding": share * width, "creep": 0.0} for share in (0.2, 1.0, 2.7)]
    return [*by_way, {"presliding": width, "creep": max(2e-3 * fastest, 1e-12)}]


def directions(s: Signals, joint: int, grid: Sequence[Mapping[str, float]]) -> Array:
    """Direction of sliding in each of several :func:`forms`, ``turnover`` seconds early. Shape (M, len(grid))."""
    width = presliding_width(s, joint)
    keys = [(f.get("presliding", width), f.get("creep", 0.0), f.get("turnover", 0.0)) for f in grid]
    distinct = sorted(set(keys))
    out = sliding(s.fine_position[:, joint], np.array([way for way, _, _ in distinct]))
    for k, (_, creep, turnover) in enumerate(distinct):
        if creep > 0:
            ahead = np.interp(s.fine_time + turnover, s.fine_time, s.fine_velocity[:, joint])
            out[:, k] = np.clip(ahead / creep, -1.0, 1.0)
    return out[:, [distinct.index(key) for key in keys]]


class Bristle(Law):
    """Friction with a presliding ``width``: ``level`` times the direction of sliding, against the motion.

    Dry friction's bristles are a spring on which a joint could ring: half the critical damping acts while they bend, as
    long as both together stay within the level. Bristles that start relaxed are wide, and rub enough by themselves.

    Args:
        joint: Index.
        width: [rad, m]. Shape (rows,).
        level: Greatest torque [N·m, N]. Shape (rows,).
        plant: Its time step and inertia bound how stiff the bristles may be.
        relaxed: See :func:`sliding`.
    """

    def __init__(self, joint: int, width: Array, level: Array, plant: Plant, relaxed: bool = False) -> None:
        self.joint, self.relaxed, self.level = joint, relaxed, level
        self.step = float(plant.model.opt.timestep)
        self.inertia = 1.0 / max(float(plant.model.dof_invweight0[plant.address.dof[joint]]), 1e-12)
        self.width = self._stable(width, level)
        self.direction = np.zeros(plant.rows)
        self.last: Array | None = None

    def _stable(self, width: Array, level: Array) -> Array:
        """Wide enough that the bristles' spring is no faster than the time step can follow."""
        return np.maximum(width, 2 * np.abs(level) * self.step**2 / self.inertia)

    def level_of(self, now: Now) -> Array:
        """Torque while it slides [N·m, N]. Shape (rows,)."""
        return self.level

    def begin(self, start: Start) -> None:
        """Bend the bristles as the measured motion did."""

        def history(piece: slice, width: float) -> Array:
            return sliding(start.position[piece, self.joint], np.array([width]), self.relaxed)[:, 0]

        self.direction, self.last = start.of(history, self.width), None

    def __call__(self, now: Now) -> Array:
        """Torque on its joint [N·m, N]. Shape (rows, J)."""
        position, velocity = now.position[:, self.joint], now.velocity[:, self.joint]
        if self.last is not None:
            moved = position - self.last
            towards = np.sign(moved)
            self.direction = towards + (self.direction - towards) * np.exp(-np.abs(moved) / self.width)
        self.last = position.copy()
        level = self.level_of(now)
        friction = level * self.direction
        if not self.relaxed:
            damping = np.minimum(np.sqrt(np.abs(level) / self.width * self.inertia), 0.3 * self.inertia / self.step)
            friction = np.clip(friction + np.sign(level) * damping * velocity, -np.abs(level), np.abs(level))
        torque = np.zeros_like(now.velocity)
        torque[:, self.joint] = -friction
        return torque


class Hysteresis(Effect):
    """Friction that builds up over a way: a seal, a cable or a preloaded strain-wave gear that winds up, then slides.

    Parameters, in total, in the corrected model: ``torque`` [N·m, N for slides] once it slides, and ``width`` [rad, m],
    the way over which it turns to 1/e of the new direction after a reversal. Widths start at 12 mrad on a joint that
    travels a radian, and at 6 mrad at least; what turns over sooner is dry friction.

    Fingerprint: -z, the direction of sliding with that width, relaxed at the start of the take.

    Simulation: a bristle of that width beside the motor, bent by the measured motion before the start.
    """

    name = "hysteresis"
    family = "presliding"
    own_joint = True
    misfit = 0.02
    mjcf = "passive"
    shows_in = "position"
    equation = "τ = -Fh z,  dz = (sign(q̇) - z) |dq| / w"
    source = "Dahl 1968, A solid friction model; Swevers et al. 2000, doi:10.1109/9.847103"
    experiments: ClassVar[Mapping[str, str]] = {
        "coulomb_friction": "reverse {joint} slowly after moves of very different lengths: dry friction turns over at "
        "once, hysteresis over a way",
        "joint_spring": "move {joint} slowly both ways over the whole travel: a spring returns along the same line",
        "backlash": "push {joint} to and fro within the gap with the smallest torque: backlash lets it go, hysteresis "
        "springs back",
        "compliance": "hold {joint} at the output and load the motor: a compliant gear has no loop",
    }

    def parameters(self, model: mujoco.MjModel, address: JointAddress, joint: int) -> tuple[Parameter, ...]:
        limit, unit = torque_scale(model, address, joint), torque_unit(model, address, joint)
        way = Parameter("width", "rad", 1.0, NARROWEST, 3.0, 0.01)
        if is_slide(model, address, joint):
            way = Parameter("width", "m", 1.0, 0.1 * NARROWEST, 3.0, 0.001)
        return (Parameter("torque", unit, 0.0, 0.0, torque_bound(model, address, joint), 0.02 * limit), way)

    def is_physical(self, parameters: Sequence[Parameter], values: Array) -> bool:
        """At the least width it is dry friction."""
        return bool(values[1] > 1.01 * parameters[1].lower)

    def grid(self, s: Signals, joint: int) -> list[Mapping[str, float]]:
        travel = float(np.ptp(s.fine_position[:, joint]))
        if travel <= 0:
            return []
        narrowest = (0.1 if is_slide(s.nominal, s.address, joint) else 1.0) * NARROWEST
        widths = [width * min(travel, 1.0) for width in WIDTHS]
        return [{"width": width} for width in widths if width > 1.01 * narrowest]

    def fingerprint(self, s: Signals, joint: int, fixed: Mapping[str, float]) -> Fingerprint:
        return self.fingerprints(s, joint, [fixed])[0]

    def fingerprints(self, s: Signals, joint: int, grid: Sequence[Mapping[str, float]]) -> list[Fingerprint]:
        widths = np.array([fixed["width"] for fixed in grid])
        columns = -s.project(sliding(s.fine_position[:, joint], widths, relaxed=True))
        return [Fingerprint(local(columns[:, k], s, joint), fixed) for k, fixed in enumerate(grid)]

    def apply(self, plant: Plant, joint: int, values: Array) -> None:
        plant.laws.append(Bristle(joint, values[:, 1], values[:, 0], plant, relaxed=True))

    def sentence(self, joint: str, values: Mapping[str, float], parameters: tuple[Parameter, ...]) -> str:
        torque, width = parameters
        return (
            f"After every reversal of {joint}, friction builds up to {values['torque']:.3g} {torque.unit} over "
            f"{1e3 * values['width']:.3g} m{width.unit} (hysteresis); the model has none."
        )
