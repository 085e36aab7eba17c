"""Between motor and link: a gear that gives way, and teeth with play.

The recorded encoder sits on the motor, as on most drives. See :mod:`torchrl_athletic.effects.gear` for the equation.
"""

from __future__ import annotations

from abc import abstractmethod
from collections.abc import Mapping, Sequence
from typing import ClassVar
from weakref import WeakKeyDictionary

import mujoco
import numpy as np

from torchrl_athletic.effects.effect import Array, Effect, Fingerprint, Parameter, is_slide, per_speed_unit
from torchrl_athletic.effects.gear import Gear, LinkMotion, Spring, deflection
from torchrl_athletic.effects.plant import Plant
from torchrl_athletic.effects.signals import JointAddress, Signals, inertia_matrix

RIGID = 100.0
"""Resonance of the link on the held motor from which a gear is taken for rigid [Hz]."""
SOFTEST = 1.5
"""Least such resonance that is looked for [Hz]."""
CONTACT_DAMPING = 0.6
"""Damping ratio of a link that rests against the teeth of a held motor, which recordings hardly show [1]."""

WIDEST, WIDEST_SLIDE = 0.1, 0.01
"""Play of a gear [rad, m]; more is an encoder on another tooth, or a broken gear."""
NARROWEST = 1e-3
"""The least that is play, per the widest [1]."""


class _Transmission(Effect):
    """What both share: the prediction along the motion, and the gear in simulation."""

    family: ClassVar[str] = "transmission"
    own_joint: ClassVar[bool] = True
    misfit: ClassVar[float] = 0.03
    of_accelerations: ClassVar[bool] = True
    mjcf = "gear"
    shows_in = "load"
    chunk: ClassVar[tuple[float, float]]
    """The motion is cut into parts that are solved side by side: their length, and what each runs ahead of it [s]."""

    @abstractmethod
    def spring(self, values: Mapping[str, Array], inertia: float) -> Spring:
        """Spring that the parameters' values make, on the inertia of the link."""

    def fingerprint(self, s: Signals, joint: int, fixed: Mapping[str, float]) -> Fingerprint:
        return self.fingerprints(s, joint, [fixed])[0]

    def fingerprints(self, s: Signals, joint: int, grid: Sequence[Mapping[str, float]]) -> list[Fingerprint]:
        if not grid:
            return []
        link = _link_motion(s)
        inertia = _link_inertia(s.nominal, s.address, joint)
        spring = self.spring({name: np.array([fixed[name] for fixed in grid]) for name in grid[0]}, inertia)
        bent = _along(s, joint, spring, *self.chunk)  # (3, M, points)
        slopes = link.slopes(joint)[:, s.keep]  # (3, N, J)
        bent = s.project(np.moveaxis(bent, 0, 1))  # (N, 3, points): the slopes change little within the test function
        return [
            Fingerprint(np.zeros((*s.missing.shape, 0)), fixed, np.einsum("knj,nk->nj", slopes, bent[:, :, at]))
            for at, fixed in enumerate(grid)
        ]

    def apply(self, plant: Plant, joint: int, values: Array) -> None:
        parameters = self.parameters(plant.model, plant.address, joint)
        if parameters and (values != [p.nominal for p in parameters]).any():
            named = {p.name: value for p, value in zip(parameters, values.T, strict=True)}
            plant.gears.append(Gear(joint, self.spring(named, _link_inertia(plant.model, plant.address, joint))))


class Compliance(_Transmission):
    """The gear between motor and link gives way like a spring, so that the link swings behind the encoder.

    Parameters: ``stiffness`` [N·m/rad, N/m for slides] and ``damping`` [N·m·s/rad, N·s/m for slides] between motor and
    link. The given model is rigid: its stiffness stands as the one at which the link would ring at 100 Hz on a held
    motor, which nothing sampled at a few hundred hertz tells from rigid.

    Fingerprint: M ẍ + C ẋ + G x on every joint, with the deflection x that the measured motion of the motor drives, at
    link resonances from 1.5 to 50 Hz.

    Simulation: the joint is the link, the motor with the armature runs ahead of it, and the encoder reads the motor. A
    model without armature gets a rotor of 2 % of the link's inertia.
    """

    name = "compliance"
    equation = "τ = K (θ - q) + D (θ̇ - q̇)"
    source = "Spong 1987, doi:10.1115/1.3143860; Albu-Schäffer, Ott, Hirzinger 2007, doi:10.1177/0278364907073776"
    excludes = frozenset({"backlash"})
    chunk = (4.0, 2.0)
    experiments: ClassVar[Mapping[str, str]] = {
        "backlash": "load {joint} at several torque levels, and bias it to one side so that play stays closed: a "
        "spring gives way all the same",
        "actuation_delay": "chirp {joint} through 1 to 30 Hz: a spring resonates, a delay does not",
        "actuation_lag": "chirp {joint} through 1 to 30 Hz, then with the output locked: only a lag stays",
        "reflected_inertia": "chirp {joint} through 1 to 30 Hz: a spring's torque turns over at the resonance",
        "link_mass": "hold {joint} still in two poses and compare with a fast chirp: a spring holds as a rigid gear "
        "does",
        "joint_spring": "lock the output of {joint} and push: only a gear's spring gives way",
    }

    def parameters(self, model: mujoco.MjModel, address: JointAddress, joint: int) -> tuple[Parameter, ...]:
        inertia, slide = _link_inertia(model, address, joint), is_slide(model, address, joint)
        if inertia <= 0:
            return ()
        rigid, typical = _stiffness(inertia, RIGID), _stiffness(inertia, 5.0)
        most = 0.01 * rigid
        unit = "N/m" if slide else "N·m/rad"
        return (
            Parameter("stiffness", unit, rigid, _stiffness(inertia, 0.5), rigid, 0.1 * typical),
            Parameter("damping", per_speed_unit(model, address, joint), 0.0, 0.0, most, 0.001 * typical),
        )

    def grid(self, s: Signals, joint: int) -> list[Mapping[str, float]]:
        return [
            {"stiffness": stiffness, "damping": settling * stiffness}
            for stiffness in _stiffnesses(s, joint, SOFTEST, RIGID / 2, 14)
            for settling in (0.001, 0.006)
        ]

    def spring(self, values: Mapping[str, Array], inertia: float) -> Spring:
        return Spring(values["stiffness"], values["damping"], np.zeros(()))

    def sentence(self, joint: str, values: Mapping[str, float], parameters: tuple[Parameter, ...]) -> str:
        stiffness, damping = parameters
        return (
            f"The gear of {joint} gives way: {values['stiffness']:.3g} {stiffness.unit} with "
            f"{values['damping']:.3g} {damping.unit} between motor and link; the model's is rigid "
            f"({stiffness.nominal:.3g} {stiffness.unit} or more)."
        )


class Backlash(_Transmission):
    """The teeth between motor and link have play: while they part, the link moves freely.

    Parameters: ``gap`` [rad, m for slides], the whole play, and ``stiffness`` [N·m/rad, N/m for slides] of the touching
    teeth, which rattle above what is sampled at a few hundred hertz: the stiffness is an effective one, at best a lower
    bound, and damped so that the link comes to rest on a tooth within a swing (ratio 0.6).

    Fingerprint: as of ``compliance``, with a spring that starts at half the gap.

    Simulation: as of ``compliance``; teeth push and never pull.
    """

    name = "backlash"
    equation = "τ = K (x - clip(x, ±g/2)), x = θ - q"
    source = "Nordin, Gutman 2002, doi:10.1016/S0005-1098(02)00047-X, section 2"
    excludes = frozenset({"compliance"})
    sets_apart = ("gap",)
    chunk = (2.0, 1.0)
    experiments: ClassVar[Mapping[str, str]] = {
        "compliance": "load {joint} at several torque levels, and bias it to one side so that the play stays closed: "
        "a spring gives way all the same",
        "hysteresis": "reverse {joint} by 0.02, 0.1 and 0.5 rad with different loads: play has one width",
        "coulomb_friction": "hold the motor of {joint} and move the link by hand: play is felt, friction is not",
        "actuation_delay": "reverse {joint} slowly and fast: play costs an angle, a delay costs a time",
        "encoder_offset": "bring {joint} to one pose from both sides",
    }

    def parameters(self, model: mujoco.MjModel, address: JointAddress, joint: int) -> tuple[Parameter, ...]:
        inertia, slide = _link_inertia(model, address, joint), is_slide(model, address, joint)
        if inertia <= 0:
            return ()
        rigid, typical = _stiffness(inertia, RIGID), _stiffness(inertia, 20.0)
        widest = WIDEST_SLIDE if slide else WIDEST
        return (
            Parameter("gap", "m" if slide else "rad", 0.0, 0.0, widest, 0.02 * widest),
            Parameter(
                "stiffness", "N/m" if slide else "N·m/rad", rigid, _stiffness(inertia, 2.0), rigid, 0.1 * typical
            ),
        )

    def is_physical(self, parameters: Sequence[Parameter], values: Array) -> bool:
        """Teeth that always touch have no play, and a gap as wide as none is stands in for an offset."""
        return bool(NARROWEST * parameters[0].upper < values[0] < 0.99 * parameters[0].upper)

    def highest_frequency(self, parameters: Sequence[Parameter], values: Array) -> float:
        """Half the resonance of the link on the held motor: how teeth rattle near it is not in two numbers."""
        return float(0.5 * RIGID * np.sqrt(values[1] / parameters[1].nominal))

    def grid(self, s: Signals, joint: int) -> list[Mapping[str, float]]:
        unit = 0.1 if is_slide(s.nominal, s.address, joint) else 1.0
        return [
            {"gap": float(gap) * unit, "stiffness": stiffness}
            for gap in np.geomspace(0.004, 0.09, 12)
            for stiffness in _stiffnesses(s, joint, 4.5, 36.0, 4)
        ]

    def spring(self, values: Mapping[str, Array], inertia: float) -> Spring:
        damping = 2 * CONTACT_DAMPING * np.sqrt(values["stiffness"] * inertia)
        return Spring(values["stiffness"], damping, values["gap"])

    def sentence(self, joint: str, values: Mapping[str, float], parameters: tuple[Parameter, ...]) -> str:
        gap, stiffness = parameters
        return (
            f"The gear of {joint} has {1e3 * values['gap']:.3g} m{gap.unit} of play, with teeth of at least about "
            f"{values['stiffness']:.3g} {stiffness.unit}; the model has none (rigid: {stiffness.nominal:.3g} "
            f"{stiffness.unit} or more)."
        )


def _stiffness(inertia: float, frequency: float) -> float:
    """Stiffness at which the link rings at a frequency [Hz] on a held motor."""
    return inertia * (2 * np.pi * frequency) ** 2


def _stiffnesses(s: Signals, joint: int, low: float, high: float, count: int) -> list[float]:
    inertia = _link_inertia(s.nominal, s.address, joint)
    if inertia <= 0:
        return []
    return [float(k) for k in np.geomspace(_stiffness(inertia, low), _stiffness(inertia, high), count)]


def _link_inertia(model: mujoco.MjModel, address: JointAddress, joint: int) -> float:
    """Inertia of the link about its joint, without the rotor, median of 16 poses [kg·m², kg]."""
    shape = (16, len(address.dof))
    poses = np.asarray(model.qpos0)[address.qpos] + np.random.default_rng(0).uniform(-1.5, 1.5, shape)
    inertia = inertia_matrix(model, address, poses)[:, joint, joint]
    return float(np.median(inertia) - model.dof_armature[address.dof[joint]])


_MOTIONS: WeakKeyDictionary[Signals, LinkMotion] = WeakKeyDictionary()


def _link_motion(s: Signals) -> LinkMotion:
    """What the lightly smoothed motion asks of the links, found once a recording."""
    if s not in _MOTIONS:
        _MOTIONS[s] = LinkMotion(s.nominal, s.address, s.fine_step, s.fine_position, s.fine_velocity, base=s.fine_base)
    return _MOTIONS[s]


def _along(s: Signals, joint: int, spring: Spring, length: float, ahead: float) -> Array:
    """Deflection, its rate and its acceleration along a motion, for springs of shape (P,). Shape (3, M, P).

    Each part starts with what the command leaves for the gear to pass on.
    """
    link, first = _link_motion(s), int(s.keep[0])
    samples = len(link.position) - first  # the edge of the recording bends the acceleration
    part, run = round(length / link.period), round(ahead / link.period)
    at = np.arange(0, samples, part) + np.arange(-run, part)[:, None]
    index = first + at.clip(0, samples - 1)
    passed = s.command[:, joint] - s.nominal.dof_armature[s.address.dof[joint]] * s.acceleration[:, joint]
    starts = [np.interp(s.fine_time[index[0]], s.time, p)[:, None] for p in (passed, np.gradient(passed, s.time))]
    bent = deflection(
        link.load[index, joint][:, :, None],
        link.slopes(joint)[:, :, joint][:, index, None],
        spring,
        link.period,
        np.stack(starts),
        (at < 0)[:, :, None],
    )
    out = np.moveaxis(bent[:, run:], 1, 2).reshape(3, -1, bent.shape[-1])[:, :samples]
    return np.concatenate([np.repeat(out[:, :1], first, axis=1), out], axis=1)
