"""What the catalogue must know of an effect: its parameters, fingerprint, simulation, sentence and rivals."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from types import MappingProxyType
from typing import ClassVar, Literal

import mujoco
import numpy as np
from numpy.typing import NDArray

from torchrl_athletic.effects.plant import Plant
from torchrl_athletic.effects.signals import JointAddress, Signals

Array = NDArray[np.float64]


CLASSES: Mapping[str, str] = MappingProxyType(
    {
        "friction": "friction",
        "presliding": "friction that winds up before it slides",
        "transmission": "a gear that gives way",
        "coupling": "a drive that the joint before turns as well",
        "inertia": "another inertia, mass or direction of gravity",
        "timing": "a late drive",
        "torque": "a torque that differs from the commanded one",
        "elastic": "a spring or a stop",
        "sensing": "a sensor or a clock that is off",
        "control": "gains that differ from the logged ones",
        "change": "something that changes with time",
    }
)
"""Classes of effects, in words."""


@dataclass(frozen=True)
class Parameter:
    """One number of an effect, as it stands in the corrected model (not as a change to the given one)."""

    name: str
    unit: str
    nominal: float
    """Value at which the effect is absent, that is, the given model's."""
    lower: float
    """Physical bound."""
    upper: float
    """Physical bound."""
    scale: float
    """A change worth mentioning; the unit of the optimiser."""


@dataclass(frozen=True, eq=False)
class Fingerprint:
    """A prediction of the missing torque, linear in the changes of some parameters: y = sum of columns x changes.

    ``fixed`` holds the values of the parameters that enter nonlinearly; the columns are for the others, in their order.
    """

    columns: Array
    """Shape (N, J, K) for K linear parameters. With K = 0, ``constant`` is the whole prediction."""
    fixed: Mapping[str, float]
    constant: Array | None = None
    """Part of the prediction that no coefficient scales. Shape (N, J)."""


class Effect(ABC):
    """One piece of physics that a model may lack. Subclass it to add your own; see ``docs/effects.md``.

    ``joint`` is an index into the recording's joints.
    """

    name: ClassVar[str]
    """Fixed: findings and files carry it."""
    equation: ClassVar[str]
    """In symbols, for the report."""
    source: ClassVar[str]
    """Citation."""
    excludes: ClassVar[frozenset[str]] = frozenset()
    """Effects that make no sense beside it on the same joint, since one contains the other."""
    shows_in: ClassVar[str] = "speed"
    """Feature along which it shows: 'speed', 'acceleration', 'position', 'load' or 'time'."""
    family: ClassVar[str] = ""
    """Its class: 'friction', 'presliding', 'transmission', 'coupling', 'inertia', 'timing', 'torque', 'elastic',
    'sensing', 'control' or 'change'."""
    own_joint: ClassVar[bool] = False
    """Whether only its own joint shows it, so that a joint which follows the model cannot have it."""
    tolerance: ClassVar[float] = 0.0
    """How far its numbers may be off without being a finding, in their scales: what every model and every log is a
    little wrong in."""
    half_a_sample: ClassVar[bool] = False
    """Whether half a sample of the recordings is within its tolerance."""
    odds: ClassVar[float] = 1.0
    """Prior odds that this is what is missing, beside an effect of which the model says nothing: a number that somebody
    wrote is less likely wrong than one that nobody wrote, a clock than a motor."""
    misfit: ClassVar[float] = 0.005
    """Share of the torque of the right name that its law may get wrong, being simpler than nature's."""
    of_accelerations: ClassVar[bool] = False
    """Whether its fingerprint is made of measured accelerations, whose noise can look like it."""
    between_torques: ClassVar[bool] = False
    """Whether it can happen between a command and a measured torque."""
    before_sensor: ClassVar[bool] = False
    """Whether a torque that is measured has passed it."""
    mjcf: ClassVar[Literal["model", "actuator", "passive", "gear", ""]] = ""
    """What of MJCF says it: fields of the ``model``, the joint's ``actuator``, a ``passive`` motor without an input, a
    ``gear`` with a hinge on each side; nothing but what :meth:`write` says if empty."""
    whole_robot: ClassVar[bool] = False
    """Whether it belongs to no joint, as a tilt does. It is asked for joint 0 only; its finding names none."""
    adds_to_link: ClassVar[bool] = False
    """Whether its simulation adds to a link, whatever other effects made of that; it is put in after them."""
    identical_to: ClassVar[tuple[frozenset[str], ...]] = ()
    """Sets of other effects that together state the same physics, so that no recording can tell which it is."""
    special_cases: ClassVar[frozenset[str]] = frozenset()
    """Effects that together are this one but for what makes it special; they win unless it explains a quarter more."""
    sets_apart: ClassVar[tuple[str | tuple[str, str], ...]] = ()
    """Parameters without which it is a simpler law: one that has the given model's value, or two that are equal. Where
    the recordings show none of this, its name is not supported, however well it fits: the interval that is stated with
    the one reaches the given value, or two that are equal do not differ by their bootstrap."""
    experiments: ClassVar[Mapping[str, str]] = {}
    """Rival -> the experiment that separates the two; ``{joint}`` is filled in."""

    @abstractmethod
    def parameters(self, model: mujoco.MjModel, address: JointAddress, joint: int) -> tuple[Parameter, ...]:
        """Parameters with units, bounds and the given model's values."""

    def parameters_of(self, takes: Sequence[Signals], joint: int) -> tuple[Parameter, ...]:
        """Parameters, with the bounds of what the takes could show."""
        return self.parameters(takes[0].nominal, takes[0].address, joint)

    @abstractmethod
    def grid(self, s: Signals, joint: int) -> list[Mapping[str, float]]:
        """Values to try for the parameters that enter nonlinearly.

        ``[{}]`` if none does, ``[]`` if the joint cannot have the effect.
        """

    def grid_of(self, takes: Sequence[Signals], joint: int) -> list[Mapping[str, float]]:
        """Grid for several takes: that of the take with the longest travel, unless an effect knows better."""
        return self.grid(max(takes, key=lambda s: float(np.ptp(s.fine_position[:, joint]))), joint)

    @abstractmethod
    def fingerprint(self, s: Signals, joint: int, fixed: Mapping[str, float]) -> Fingerprint:
        """Prediction of the missing torque y = ID - command, with the nonlinear parameters ``fixed``.

        The sign: y is the joint torque that the effect adds to the commanded one; friction predicts -Fc sign(v).
        """

    def fingerprints(self, s: Signals, joint: int, grid: Sequence[Mapping[str, float]]) -> list[Fingerprint]:
        """:meth:`fingerprint` at each point of a grid; override it where the points share work."""
        return [self.fingerprint(s, joint, fixed) for fixed in grid]

    def turns(self, model: mujoco.MjModel, address: JointAddress, joint: int) -> tuple[int, ...]:
        """Joints whose torques a regression asks for it together."""
        return (joint,)

    def near(self, parameters: Sequence[Parameter], values: Array) -> Mapping[str, float]:
        """What to add to ``fixed`` of a fingerprint that is not quite linear, so that it holds near values (P,)."""
        return {}

    def change(self, parameter: Parameter, value: float) -> float:
        """Coefficient of the fingerprint's column at a value of the parameter; zero at the nominal one."""
        return value - parameter.nominal

    def value(self, parameter: Parameter, change: float) -> float:
        """Value of the parameter that a coefficient stands for: the inverse of :meth:`change`."""
        return parameter.nominal + change

    def is_physical(self, parameters: Sequence[Parameter], values: Array) -> bool:
        """Whether values (P,), each within its bounds, make sense together."""
        return True

    def highest_frequency(self, parameters: Sequence[Parameter], values: Array) -> float:
        """Up to which its law says how the robot moves [Hz]: no experiment is planned beyond."""
        return np.inf

    @abstractmethod
    def apply(self, plant: Plant, joint: int, values: Array) -> None:
        """Put the effect into a batch of simulations. ``values`` has shape (rows, P), in the parameters' order."""

    def write(self, spec: mujoco.MjSpec, joint: str, values: Array) -> bool:
        """Say it in MJCF, for effects that ``mjcf`` does not place. Whether it is said. ``values``: shape (P,)."""
        return False

    @abstractmethod
    def sentence(self, joint: str, values: Mapping[str, float], parameters: tuple[Parameter, ...]) -> str:
        """The statement in words, with numbers and units."""

    def applies(self, s: Signals) -> bool:
        """Whether the recording could show the effect at all."""
        return True

    def experiment(self, rival: str, joint: str) -> str:
        """The recording that would tell this effect from ``rival``."""
        text = self.experiments.get(
            rival,
            "record {joint} alone with slow constant speeds both ways, a fast chirp, and a second payload, "
            "and run the diagnosis on all three",
        )
        return text.format(joint=joint)


def local(column: Array, s: Signals, joint: int) -> Array:
    """Columns that touch one joint only: (N,) or (N, K) to (N, J, K)."""
    column = column.reshape(len(column), -1)
    out = np.zeros((len(column), s.num_joints, column.shape[1]))
    out[:, joint] = column
    return out


def torque_unit(model: mujoco.MjModel, address: JointAddress, joint: int) -> str:
    """``N·m`` for a hinge, ``N`` for a slide."""
    return "N" if is_slide(model, address, joint) else "N·m"


def is_slide(model: mujoco.MjModel, address: JointAddress, joint: int) -> bool:
    """Whether the joint is a slide."""
    return bool(model.jnt_type[address.joint[joint]] == mujoco.mjtJoint.mjJNT_SLIDE)


def per_speed_unit(model: mujoco.MjModel, address: JointAddress, joint: int) -> str:
    """Unit of a damping coefficient."""
    return "N·s/m" if is_slide(model, address, joint) else "N·m·s/rad"


def damping(model: mujoco.MjModel, address: JointAddress, joint: int) -> float:
    """Linear damping of the given model [N·m·s/rad]."""
    return float(np.ravel(model.dof_damping[address.dof[joint]])[0])


def torque_bound(model: mujoco.MjModel, address: JointAddress, joint: int) -> float:
    """A torque that hardly a part of the joint exceeds [N·m].

    The motor's limit, else a hundred times :func:`torque_scale`, which rotors and friction of a bare horn can exceed.
    """
    from torchrl_athletic.effects.signals import torque_range

    limit = torque_range(model, address)[1][joint]
    return float(limit) if np.isfinite(limit) and limit > 0 else 100.0 * torque_scale(model, address, joint)


def damping_bound(model: mujoco.MjModel, address: JointAddress, joint: int) -> float:
    """A linear damping that no joint has [N·m·s/rad]: it would take all of the motor at 0.05 rad/s, or 0.01 m/s."""
    crawl = 0.01 if is_slide(model, address, joint) else 0.05
    return max(torque_bound(model, address, joint) / crawl, 5 * damping(model, address, joint))


def dry_friction(name: str, model: mujoco.MjModel, address: JointAddress, joint: int) -> Parameter:
    """A level of dry friction, of which the model may have some."""
    limit, unit = torque_scale(model, address, joint), torque_unit(model, address, joint)
    nominal = float(model.dof_frictionloss[address.dof[joint]])
    return Parameter(name, unit, nominal, 0.0, max(torque_bound(model, address, joint), 3 * nominal), 0.02 * limit)


def torque_scale(model: mujoco.MjModel, address: JointAddress, joint: int) -> float:
    """A torque typical of the joint, to scale the optimiser [N·m].

    The motor's limit; else the torque of gravity, or of 1 rad/s² if that is more.
    """
    from torchrl_athletic.effects.signals import torque_range

    limit = torque_range(model, address)[1][joint]
    if np.isfinite(limit) and limit > 0:
        return float(limit)
    data, dof, gravity = mujoco.MjData(model), address.dof[joint], []
    for _ in range(2):  # a quarter turn apart, since a link that hangs down feels no gravity
        mujoco.mj_forward(model, data)
        gravity.append(abs(data.qfrc_bias[dof]))
        data.qpos[address.qpos[joint]] += np.pi / 2
    full = np.zeros((model.nv, model.nv))
    mujoco.mj_fullM(model, data, full)
    return float(max(*gravity, full[dof, dof], 1e-6))
