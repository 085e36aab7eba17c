"""Springs at a joint: one that always pulls, and a stop that pushes back."""

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
from torchrl_athletic.effects.plant import Now, Plant
from torchrl_athletic.effects.signals import JointAddress, Signals

_INTO_TRAVEL = (0.2, 0.14, 0.1, 0.07, 0.045, 0.03, 0.018, 0.01, 0.005)
"""Where a stop may begin, from the end of the travel, as a share of it."""
_GIVES = (0.5, 0.05)
"""How far a stop gives way to the motor, at most: a hinge's [rad], a slide's [m]."""


class JointSpring(Effect):
    """A spring pulls the joint: a cable, a hose, a counterbalance.

    Parameters, in total, in the corrected model: ``stiffness`` [N·m/rad, N/m for slides], and ``preload`` [N·m, N], the
    torque at position zero; the spring rests where the two cancel.

    Fingerprint: -q and 1.

    Simulation: the joint's stiffness and spring reference.
    """

    name = "joint_spring"
    family = "elastic"
    own_joint = True
    mjcf = "model"
    sets_apart = ("stiffness",)
    shows_in = "position"
    equation = "τ = p - k q = -k (q - p/k)"
    source = "Siciliano et al. 2009, Robotics, section 7.3; MuJoCo's joint stiffness"
    excludes = frozenset({"torque_offset"})
    experiments: ClassVar[Mapping[str, str]] = {
        "torque_offset": "hold {joint} at several angles over its whole travel: a spring's torque grows with them",
        "link_mass": "hold {joint} over its whole travel with its axis vertical, then horizontal: a mass needs gravity",
        "encoder_offset": "hold {joint} at several angles with its axis vertical",
        "gravity_tilt": "hold {joint} at several angles, then turn the base by a quarter and repeat",
        "hysteresis": "move {joint} slowly both ways over its whole travel: a spring returns along the same line",
    }

    def parameters(self, model: mujoco.MjModel, address: JointAddress, joint: int) -> tuple[Parameter, ...]:
        scale, bound = torque_scale(model, address, joint), torque_bound(model, address, joint)
        slide, unit = is_slide(model, address, joint), torque_unit(model, address, joint)
        per, steepest = ("N/m", 1000 * bound) if slide else ("N·m/rad", 20 * bound)
        stiffness, preload = _spring(model, address, joint)
        return (
            Parameter("stiffness", per, stiffness, 0.0, max(steepest, 5 * stiffness), 0.02 * scale),
            Parameter("preload", unit, preload, -max(bound, 5 * -preload), max(bound, 5 * preload), 0.02 * scale),
        )

    def grid(self, s: Signals, joint: int) -> list[Mapping[str, float]]:
        return [{}]

    def fingerprint(self, s: Signals, joint: int, fixed: Mapping[str, float]) -> Fingerprint:
        q = s.position[:, joint]
        return Fingerprint(local(np.stack([-q, np.ones_like(q)], -1), s, joint), fixed)

    def apply(self, plant: Plant, joint: int, values: Array) -> None:
        stiffness, preload = values.T
        stiffness = np.where(preload != 0, np.maximum(stiffness, 1e-12), stiffness)  # then it rests very far away
        at = plant.address.qpos[joint]
        rest = np.divide(preload, stiffness, out=plant.of("qpos_spring")[:, at].copy(), where=stiffness > 0)
        plant.of("jnt_stiffness")[:, plant.address.joint[joint]] = stiffness
        plant.of("qpos_spring")[:, at] = rest

    def sentence(self, joint: str, values: Mapping[str, float], parameters: tuple[Parameter, ...]) -> str:
        stiffness, preload = parameters
        k, p = values["stiffness"], values["preload"]
        length = "m" if stiffness.unit == "N/m" else "rad"
        rest = f", that is, towards {p / k:.3g} {length}" if k > 0 else ""
        has = f"{stiffness.nominal:.3g} {stiffness.unit}" if stiffness.nominal else "none"
        if preload.nominal:
            has += f" and {preload.nominal:.3g} {preload.unit}"
        return (
            f"A spring of {k:.3g} {stiffness.unit} pulls {joint}, with {p:+.3g} {preload.unit} at position zero{rest}; "
            f"the model has {has}."
        )


class JointStop(Effect):
    """A stop that the model lacks, or has farther out: a bumper, a cable at its end, the link against its housing.

    Parameters: ``position`` [rad, m for slides] where it begins, ``side`` [1], +1 if it stops motion towards larger
    positions and -1 if towards smaller, and ``stiffness`` [N·m/rad, N/m].

    Fingerprint: -max(q - p, 0) or max(p - q, 0), at positions p in the outer fifth of the travel. Near the model's own
    limits nothing is judged.

    Simulation: a one-sided spring beside the motor. One that the motor pushes in by half a radian, or 5 cm, stops
    nothing: it stands in for what a spring or a ripple leaves. Without a limit of the motor it is gravity that pushes,
    and a fifth of the stiffest that the time step follows is always enough.
    """

    name = "joint_stop"
    family = "elastic"
    own_joint = True
    shows_in = "position"
    equation = "τ = -k max(q - p, 0)"
    source = "Hunt, Crossley 1975, doi:10.1115/1.3423596, without its damping"
    experiments: ClassVar[Mapping[str, str]] = {
        "joint_spring": "move {joint} slowly over its whole travel: a stop leaves the middle free",
        "torque_saturation": "move {joint} slowly into the end of its travel, then with a weight in the middle of it",
        "torque_ripple": "move {joint} slowly over its whole travel, twice",
    }

    def parameters(self, model: mujoco.MjModel, address: JointAddress, joint: int) -> tuple[Parameter, ...]:
        slide, bound = is_slide(model, address, joint), torque_bound(model, address, joint)
        inertia = 1.0 / max(float(model.dof_invweight0[address.dof[joint]]), 1e-12)
        stable = 0.2 * inertia / float(model.opt.timestep) ** 2
        steepest = min((1e4 if slide else 1e3) * bound, stable)
        softest = min(torque_scale(model, address, joint) / _GIVES[slide], 0.2 * steepest)
        reach = 10.0 if slide else 4 * np.pi
        return (
            Parameter("position", "m" if slide else "rad", 0.0, -reach, reach, 0.005),
            Parameter("side", "1", 1.0, -1.0, 1.0, 0.4),
            Parameter("stiffness", "N/m" if slide else "N·m/rad", 0.0, 0.0, steepest, softest),
        )

    def is_physical(self, parameters: Sequence[Parameter], values: Array) -> bool:
        """What gives way to the motor stops nothing; the unit of the stiffness is the least that does."""
        return bool(values[2] >= parameters[2].scale)

    def grid(self, s: Signals, joint: int) -> list[Mapping[str, float]]:
        return self.grid_of([s], joint)

    def grid_of(self, takes: Sequence[Signals], joint: int) -> list[Mapping[str, float]]:
        """Places in the outer fifth of what all takes travel, either side."""
        low = min(float(s.fine_position[:, joint].min()) for s in takes)
        high = max(float(s.fine_position[:, joint].max()) for s in takes)
        if high <= low:
            return []
        return [
            {"position": (high if side > 0 else low) - side * share * (high - low), "side": side}
            for side in (1.0, -1.0)
            for share in _INTO_TRAVEL
        ]

    def fingerprint(self, s: Signals, joint: int, fixed: Mapping[str, float]) -> Fingerprint:
        return self.fingerprints(s, joint, [fixed])[0]

    def fingerprints(self, s: Signals, joint: int, grid: Sequence[Mapping[str, float]]) -> list[Fingerprint]:
        position, side = (np.array([fixed[name] for fixed in grid]) for name in ("position", "side"))
        columns = s.project(_pushed_back(s.fine_position[:, joint, None], position, side))
        return [Fingerprint(local(columns[:, k], s, joint), fixed) for k, fixed in enumerate(grid)]

    def apply(self, plant: Plant, joint: int, values: Array) -> None:
        position, side, stiffness = values.T
        side = np.sign(side)

        def stopped(now: Now) -> Array:
            torque = np.zeros_like(now.position)
            torque[:, joint] = stiffness * _pushed_back(now.position[:, joint], position, side)
            return torque

        plant.laws.append(stopped)

    def sentence(self, joint: str, values: Mapping[str, float], parameters: tuple[Parameter, ...]) -> str:
        position, _, stiffness = parameters
        beyond = "above" if values["side"] > 0 else "below"
        return (
            f"A stop pushes {joint} back {beyond} {1e3 * values['position']:.4g} m{position.unit} (side "
            f"{values['side']:+.0f}) with {values['stiffness']:.3g} {stiffness.unit}; the model has none there."
        )


def _pushed_back(position: Array, stop: Array, side: Array) -> Array:
    """Torque of a stop per stiffness, against penetration."""
    return np.asarray(-side * np.maximum(side * (position - stop), 0.0), dtype=np.float64)


def _spring(model: mujoco.MjModel, address: JointAddress, joint: int) -> tuple[float, float]:
    """Stiffness of the given model's joint, and its torque at position zero."""
    stiffness = float(np.ravel(model.jnt_stiffness[address.joint[joint]])[0])
    return stiffness, stiffness * float(model.qpos_spring[address.qpos[joint]])
