"""Cases: which robot hides what, how it is recorded, and what the diagnosis is given.

A case is drawn from (split, block, index, seed) alone. The splits ``tuning`` and ``sealed`` share neither robots nor
random numbers, and the laws of ``sealed`` are richer.
"""

from __future__ import annotations

import hashlib
import json
from collections.abc import Sequence
from dataclasses import asdict, dataclass, replace
from itertools import product
from pathlib import Path
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import gaussian_filter1d

from benchmarks.concealed import plant
from benchmarks.concealed.hidden import (
    EFFECTS,
    OUTSIDE,
    OUTSIDE_SEALED,
    OUTSIDE_TUNING,
    Body,
    Truth,
    Typical,
    conceal,
    draw,
    eligible,
    nominal_body,
)
from benchmarks.concealed.plant import Drive
from benchmarks.concealed.robots import SEALED, TUNING, Robot, perturbed, upright
from benchmarks.concealed.takes import (
    FIT_KINDS,
    HELDOUT_KINDS,
    Mode,
    Plan,
    Sensors,
    draw_sensors,
    drive_for,
    every_10_ms,
    log,
    nominal_torque,
    perfect,
    plan,
)
from torchrl_athletic.recordings import Recording

Array = NDArray[np.float64]
Split = Literal["tuning", "sealed"]
BLOCKS = (
    "single", "nothing", "nuisance", "outside", "leave_one_out", "pairs", "triples", "unidentifiable", "heldout",
    "bare",
)  # fmt: skip
"""The last is what a first model of a real robot looks like: every joint lacks its rotor and its friction."""

CLASSES: dict[str, tuple[str, ...]] = {
    "friction": ("coulomb_friction", "viscous_friction", "stribeck_friction", "load_dependent_friction",
                 "asymmetric_friction"),
    "presliding": ("hysteresis",),
    "transmission": ("backlash", "compliance"),
    "inertia": ("reflected_inertia", "link_mass", "link_com", "payload", "gravity_tilt"),
    "timing": ("actuation_delay", "actuation_lag"),
    "torque": ("torque_scale", "torque_offset", "torque_saturation", "speed_torque_limit", "torque_ripple"),
    "elastic": ("joint_spring", "joint_stop"),
    "sensing": ("encoder_offset", "encoder_scale", "clock_offset"),
    "control": ("gain_mismatch",),
    "change": ("thermal_drift", "disturbance"),
}  # fmt: skip
CLASS_OF = {effect: name for name, effects in CLASSES.items() for effect in effects}

CLASHES: tuple[set[str], ...] = (
    {"joint_spring", "torque_offset"}, {"torque_scale", "gain_mismatch"}, {"coulomb_friction", "thermal_drift"},
    {"stribeck_friction", "thermal_drift"}, {"load_dependent_friction", "thermal_drift"},
    {"asymmetric_friction", "thermal_drift"}, {"encoder_scale", "torque_scale"},
)  # fmt: skip
"""Pairs that would be one law on one joint, such as a spring that rests elsewhere."""

DRY = ("coulomb_friction", "coulomb_friction", "stribeck_friction", "load_dependent_friction")
"""Dry friction of a joint of a bare model: half of them are plain."""

DETECTABLE = 3.0
"""An effect counts as detectable from this ratio on: root mean square of the torque that it makes the model miss, over
that of the sensors' noise in the same band. With three, the noise holds a tenth of the energy of the missing torque,
which is what a name has to be read from; below, it could be found by averaging over minutes, but its shape drowns.
Set before any diagnosis was run."""
NUISANCE = 0.03
"""Share by which mass, centre of mass and inertia of each link err."""
OFFSET = 2e-3
"""Largest encoder offset that every case has [rad]."""


@dataclass(frozen=True)
class Case:
    """What is known of a case before it is recorded: nothing here is shown to the diagnosis."""

    split: Split
    block: str
    index: int
    seed: int
    robot: str
    mode: Mode
    rate: float
    severity: int
    """0..3, -1 where nothing is hidden."""
    truths: tuple[Truth, ...]
    equivalents: tuple[tuple[tuple[str, str | None], ...], ...] = ()
    """For each truth, (effect, joint) that the recordings cannot tell from it, by the physics of this robot."""
    tolerated: tuple[str, ...] = ()
    """Names that are true of a part of what is hidden, where no name is true of all."""
    removed: tuple[str, ...] = ()
    """Names taken out of the catalogue before the diagnosis."""

    @property
    def name(self) -> str:
        """Name of its files."""
        return f"{self.split}-{self.block}-{self.seed}-{self.index:04d}"

    def to_json(self) -> dict[str, Any]:
        """As plain dicts and lists."""
        content: dict[str, Any] = json.loads(json.dumps(asdict(self)))
        return content


@dataclass(frozen=True, eq=False)
class Session:
    """A case with everything that it takes to record it."""

    case: Case
    robot: Robot
    body: Body
    plans: tuple[Plan, ...]
    """Plans of the takes to fit, then of those kept aside."""
    fitted: int
    sensors: Sensors
    kp: Array
    kd: Array
    typical: Typical
    base: plant.Tree
    """Bodies with their nuisance errors, before anything was hidden."""

    @property
    def model_xml(self) -> str:
        """The nominal model."""
        return self.robot.model_xml


def generator(split: str, block: str, index: int, seed: int) -> np.random.Generator:
    """Random numbers of a case."""
    return np.random.default_rng([seed, index, *f"{split}/{block}".encode()])


def prepare(split: Split, block: str, index: int, seed: int = 0) -> Session:
    """Draw a case: robot, takes, sensors, and what is hidden. Cheap; nothing moves yet.

    Raises:
        ValueError: If the block or the split does not exist.
    """
    if block not in BLOCKS or split not in ("tuning", "sealed"):
        raise ValueError(f"{split}/{block} does not exist. Splits are tuning and sealed, blocks {', '.join(BLOCKS)}.")
    rng = generator(split, block, index, seed)
    rich = split == "sealed"
    robots = SEALED if rich else TUNING
    effects, make, mode, severity = _choose(split, block, index, rng)
    robot = robots[make](rng)
    rate = float(rng.choice([200.0, 100.0, 500.0, 60.0, 1000.0], p=[0.68, 0.1, 0.14, 0.04, 0.04]))
    plans, fitted = _plan(robot, block, rate, rng, "slow" if effects == ("slow_lag",) else "any")
    typical = _typical(robot, plans[:fitted])
    exact = block == "nothing"
    tree = robot.tree if exact else perturbed(robot, NUISANCE, rng)
    sensors = draw_sensors(rng, rate)
    if exact:
        sensors = replace(sensors, loop_jitter=0.0, stamp_jitter=0.0, dropouts=0.0, clock_offset=0.0)
    body = nominal_body(robot, tree)
    if not exact:
        units = np.where(robot.tree.slide, 0.2, 1.0)
        body.laws["encoder_offset"] = rng.uniform(-OFFSET, OFFSET, robot.joints) * units
    body.clock[0] = sensors.clock_offset
    frequency = rng.uniform(3.0, 6.0) if mode == "position_target" else rng.uniform(1.2, 2.5)
    kp = typical.inertia * (2 * np.pi * frequency) ** 2
    kd = 2 * rng.uniform(0.5, 0.9) * np.sqrt(kp * typical.inertia)
    if block == "unidentifiable":
        truths, equivalents = _alike(effects[0], robot, mode, typical, rng)
    else:
        truths = _truths(effects, robot, block, severity, typical, tree, rich, rng)
        equivalents = tuple(identities(t, robot, mode) for t in truths)
    for truth in truths:
        body = conceal(body, robot, truth, rich, rng)
    sensors = replace(sensors, clock_offset=body.clock[0])
    removed: tuple[str, ...] = ()
    if block == "leave_one_out":
        alike = {e for e, joint in equivalents[0] if joint in (truths[0].joint, None) or truths[0].joint is None}
        removed = (truths[0].effect, *sorted(alike - {truths[0].effect}))
    tolerated = OUTSIDE[truths[0].effect] if block == "outside" else ()
    case = Case(
        split, block, index, seed, make, mode, rate, severity, truths, equivalents, tolerated, removed,
    )  # fmt: skip
    return Session(case, robot, body, plans, fitted, sensors, kp, kd, typical, tree)


ALIKE = (
    "clock_or_delay", "tilt_or_offset", "masses_of_a_slider", "tilt_or_encoder_offset", "asymmetric_or_two",
    "gain_or_scale", "far_spring", "slow_lag",
)  # fmt: skip
"""Pairs of physics that recordings of a certain robot cannot tell apart."""


def _choose(split: Split, block: str, index: int, rng: np.random.Generator) -> tuple[tuple[str, ...], str, Mode, int]:
    """Effects, robot, mode and severity: such that every stretch of cases holds all of them."""
    robots = list(SEALED if split == "sealed" else TUNING)
    single = [r for r in robots if r in ("pendulum", "slider", "lift", "flap")]
    several = [r for r in robots if r not in single]
    slider = "slider" if split == "sealed" else "lift"
    hinge = "pendulum" if split == "sealed" else "flap"
    mode: Mode = "position_target" if rng.random() < 0.3 else "torque_command"
    robot = robots[(index + index // len(EFFECTS)) % len(robots)]
    if block in ("nothing", "nuisance"):
        return (), robots[index % len(robots)], mode, -1
    if block == "outside":
        laws = OUTSIDE_SEALED if split == "sealed" else OUTSIDE_TUNING
        return (
            (laws[index % len(laws)],),
            robots[(index // len(laws) + index) % len(robots)],
            mode,
            2 + (index // len(laws)) % 2,
        )
    if block == "unidentifiable":
        kind = ALIKE[index % len(ALIKE)]
        made = {
            "clock_or_delay": single[(index // len(ALIKE)) % len(single)], "tilt_or_offset": slider,
            "masses_of_a_slider": slider, "tilt_or_encoder_offset": hinge,
        }  # fmt: skip
        robot = made.get(kind, several[(index // len(ALIKE)) % len(several)])
        wanted: Mode = "position_target" if kind == "gain_or_scale" else "torque_command"
        return (kind,), robot, wanted, 2
    if block == "bare":
        few = [r for r in robots if r not in ("arm4", "arm6")]
        return ("reflected_inertia", "dry", "viscous_friction"), few[index % len(few)], mode, 2
    if block in ("pairs", "triples"):
        count = 2 if block == "pairs" else 3
        if rng.random() < 0.75 or count == 3:
            robot = several[index % len(several)]
        names: list[str] = []
        while len(names) < count:
            effect = str(rng.choice([e for e in EFFECTS if e not in ("clock_offset", "disturbance")]))
            if effect == "gain_mismatch":
                mode = "position_target"
            apart = CLASS_OF[effect] not in [CLASS_OF[n] for n in names]
            if robot in single:
                apart = apart and not any({effect, n} in CLASHES for n in names)
            if apart and _possible(effect, robot, split):
                names.append(effect)
        return tuple(names), robot, mode, int(rng.integers(2, 4))
    effect = EFFECTS[index % len(EFFECTS)]
    severity = (index // len(EFFECTS) + index) % 4 if block == "single" else 2 + (index // len(EFFECTS) + index) % 2
    tries = 0
    while not _possible(effect, robot, split):
        tries += 1
        robot = robots[(index + index // len(EFFECTS) + tries) % len(robots)]
    if effect == "gain_mismatch":
        mode = "position_target"
    return (effect,), robot, mode, severity


def _possible(effect: str, robot: str, split: Split) -> bool:
    make = (SEALED if split == "sealed" else TUNING)[robot]
    return bool(eligible(effect, make(np.random.default_rng(0))))


def _plan(robot: Robot, block: str, rate: float, rng: np.random.Generator, pace: str) -> tuple[tuple[Plan, ...], int]:
    kinds = list(rng.permutation(FIT_KINDS)[: int(rng.integers(3, 5))])
    if "sweep" not in kinds and "square" not in kinds:
        kinds[0] = "sweep"
    if not {"multisine", "chirp"} & set(kinds):
        kinds[-1] = "multisine"
    heldout = list(rng.permutation(HELDOUT_KINDS)[: int(rng.integers(1, 3))])
    if block == "heldout":
        heldout = list(HELDOUT_KINDS)
    if pace == "slow":
        kinds = ["sweep", "sweep", "sweep"]
    plans = []
    for k, kind in enumerate([*kinds, *heldout]):
        long = block == "heldout" and k >= len(kinds)
        duration = 60.0 if long else float(rng.uniform(20.0, 40.0) if k < len(kinds) else rng.uniform(15.0, 25.0))
        amplitude = 1.0 if k == 0 else float(rng.uniform(0.4, 1.0))
        plans.append(plan(robot, str(kind), duration, rate, amplitude, rng))
    return tuple(plans), len(kinds)


def _typical(robot: Robot, plans: Sequence[Plan]) -> Typical:
    plans = [every_10_ms(p) for p in plans]
    torque = np.concatenate([nominal_torque(robot, p) for p in plans])
    position = np.concatenate([p.position for p in plans])
    speed = np.abs(np.concatenate([p.velocity for p in plans]))
    weight = np.abs([robot.gravity_torque(q) for q in position[:: max(1, len(position) // 200)]]).max(0)
    return Typical(
        np.sqrt((torque**2).mean(0)), np.quantile(np.abs(torque), 0.995, axis=0), weight,
        np.sqrt((speed**2).mean(0)), np.quantile(speed, 0.995, axis=0), position.min(0), position.max(0),
        np.diag(robot.mass_matrix(robot.centre)).copy(),
    )  # fmt: skip


def _truths(
    effects: Sequence[str], robot: Robot, block: str, severity: int, typical: Typical, tree: plant.Tree, rich: bool,
    rng: np.random.Generator,
) -> tuple[Truth, ...]:  # fmt: skip
    truths: list[Truth] = []
    if block == "bare":
        for effect, j in product(effects, range(robot.joints)):
            name = str(rng.choice(DRY)) if effect == "dry" else effect
            if j in eligible(name, robot):
                truths.append(draw(name, robot, j, int(rng.integers(1, 4)), typical, tree, rich, rng))
        return tuple(truths)
    for effect in effects:
        joints = list(range(robot.joints)) if effect in OUTSIDE else eligible(effect, robot)
        elsewhere = rng.random() < 0.6
        taken = [
            robot.joint_names.index(t.joint)
            for t in truths
            if t.joint is not None and (elsewhere or {effect, t.effect} in CLASHES)
        ]
        free = [j for j in joints if j not in taken]
        j = int(rng.choice(free or joints))
        truths.append(draw(effect, robot, j, severity, typical, tree, rich, rng))
    return tuple(truths)


def identities(truth: Truth, robot: Robot, mode: Mode) -> tuple[tuple[str, str | None], ...]:
    """What else is the same physics in recordings of this robot: (effect, joint), the truth left out."""
    effect, joint, alone = truth.effect, truth.joint, robot.joints == 1
    first = robot.joint_names[0]
    slide = alone and bool(robot.tree.slide[0])
    level = slide and abs(float(robot.tree.turn[0][2] @ robot.tree.axis[0])) < 1e-9
    masses = (("link_mass", first), ("payload", first), ("reflected_inertia", first))
    out: list[tuple[str, str | None]] = []
    if alone and effect in ("actuation_delay", "clock_offset"):
        out = [("clock_offset", None), ("actuation_delay", first)]
    elif mode == "position_target" and effect == "torque_scale":
        out = [("gain_mismatch", joint), *(masses if level else ())]
    elif effect == "torque_scale" and level:
        out = list(masses)
    elif effect == "payload" or (effect == "link_mass" and joint == robot.joint_names[-1]):
        out = [("payload", joint), ("link_mass", joint)] if slide else []
    elif effect == "torque_offset" and slide:
        out = [("gravity_tilt", None)]
    elif effect == "reflected_inertia" and joint is not None:
        j = robot.joint_names.index(joint)
        if upright(robot, j) and j == 0 and not slide:
            out = [("link_mass", joint), ("link_com", joint)]
    elif effect == "encoder_offset" and alone:
        out = [("gravity_tilt", None)]
    return tuple(a for a in out if a != (effect, joint))


def _alike(
    kind: str, robot: Robot, mode: Mode, typical: Typical, rng: np.random.Generator
) -> tuple[tuple[Truth, ...], tuple[tuple[tuple[str, str | None], ...], ...]]:
    """One of two or more causes that the recordings cannot tell apart."""
    first, last = robot.joint_names[0], robot.joint_names[-1]
    t = typical.torque
    j = int(rng.integers(robot.joints))
    name = robot.joint_names[j]
    sign = float(rng.choice([-1.0, 1.0]))
    options: list[tuple[str, str | None]]
    match kind:
        case "clock_or_delay":
            delay = float(rng.uniform(0.004, 0.012))
            options = [("clock_offset", None), ("actuation_delay", first)]
            truths = [Truth("clock_offset", None, {"offset": delay}), Truth("actuation_delay", first, {"delay": delay})]
        case "tilt_or_offset":
            options = [("gravity_tilt", None), ("torque_offset", first)]
            angle = sign * float(rng.uniform(0.05, 0.15))
            truths = [
                Truth("torque_offset", first, {"torque": sign * float(0.1 * robot.tree.mass[0] * 9.81)}),
                Truth("gravity_tilt", None, {"roll": 0.0, "pitch": angle}),
            ]
            if robot.name == "lift":  # a small tilt hardly changes its weight
                truths = truths[:1]
        case "masses_of_a_slider":
            mass = float(robot.tree.mass[0])
            options = [("link_mass", first), ("payload", first)]
            if abs(robot.tree.turn[0][2] @ robot.tree.axis[0]) < 1e-9:
                options.append(("reflected_inertia", first))
            truths = [
                Truth("payload", first, {"mass": 0.4 * mass}), Truth("link_mass", first, {"mass": 1.4 * mass}),
            ]  # fmt: skip
        case "tilt_or_encoder_offset":
            angle = sign * float(rng.uniform(0.06, 0.15))
            options = [("gravity_tilt", None), ("encoder_offset", first)]
            truths = [
                Truth("encoder_offset", first, {"offset": angle}),
                Truth("gravity_tilt", None, {"roll": 0.0, "pitch": angle}),
            ]
        case "asymmetric_or_two":
            c = float(rng.uniform(0.4, 0.6)) * sign
            b = float(robot.damping[j])
            options = [("asymmetric_friction", name), ("coulomb_friction", name), ("torque_offset", name)]
            truths = [Truth(
                "asymmetric_friction", name,
                {"coulomb_positive": 0.25 * t[j] * (1 + c), "coulomb_negative": 0.25 * t[j] * (1 - c),
                 "viscous_positive": b, "viscous_negative": b},
                {"presliding": 5e-4 * (float(robot.reach[j]) if robot.tree.slide[j] else 1.0)},
            )]  # fmt: skip
        case "gain_or_scale":
            scale = float(np.exp(sign * rng.uniform(0.2, 0.4)))
            options = [("torque_scale", name), ("gain_mismatch", name)]
            truths = [
                Truth("torque_scale", name, {"scale": scale}),
                Truth("gain_mismatch", name, {"kp_scale": scale, "kd_scale": scale}),
            ]
        case "far_spring":  # so soft and so far away that it pulls with the same torque everywhere
            far = 60.0 * float(typical.high[j] - typical.low[j]) * sign
            options = [("joint_spring", name), ("torque_offset", name)]
            truths = [
                Truth("joint_spring", name, {"stiffness": float(0.2 * t[j] / abs(far)),
                                             "rest": float(robot.centre[j] + far)}),
                Truth("torque_offset", name, {"torque": float(0.2 * t[j] * sign)}),
            ]  # fmt: skip
        case "slow_lag":
            delay = float(rng.uniform(0.003, 0.005))
            options = [("actuation_lag", last), ("actuation_delay", last)]
            truths = [
                Truth("actuation_lag", last, {"time_constant": delay}),
                Truth("actuation_delay", last, {"delay": delay}),
            ]
        case _:
            raise ValueError(f"{kind!r} is not known; known are {', '.join(ALIKE)}.")
    truth = truths[int(rng.integers(len(truths)))]
    return (truth,), (tuple(o for o in options if o != (truth.effect, truth.joint)),)


def record(session: Session, step: float = plant.STEP) -> tuple[list[Recording], list[Recording]]:
    """Move the robot through all takes: recordings to fit, and recordings kept aside.

    Takes are replanned smaller when the robot leaves the range of its model.

    Raises:
        RuntimeError: If it leaves it even when it hardly moves.
    """
    robot, case = session.robot, session.case
    for shrink in (1.0, 0.7, 0.5, 0.35, 0.25):
        recordings = []
        for take, motion in enumerate(session.plans):
            rng = generator(case.split, case.block, case.index, case.seed + 7919 * (take + 1))
            smaller = _smaller(robot, motion, shrink)
            drive = drive_for(robot, smaller, case.mode, session.kp, session.kd, session.sensors, take, rng)
            command, reading, speed, clean, _ = move(session.body, robot, drive, step)
            if not _inside(robot, clean):
                break
            source = f"take_{take + 1}" if take < session.fitted else f"aside_{take + 1 - session.fitted}"
            recordings.append(log(robot, drive, session.sensors, command, reading, speed, source, rng))
        else:
            return recordings[: session.fitted], recordings[session.fitted :]
    raise RuntimeError(f"{case.name}: the robot runs away whatever it is told. Draw it less severe.")


def move(body: Body, robot: Robot, drive: Drive, step: float = plant.STEP) -> tuple[Array, Array, Array, Array, Array]:
    """One take of a robot, by :func:`plant.simulate`, from rest at its centre."""
    out: tuple[Array, Array, Array, Array, Array] = plant.simulate(
        body.tree, body.laws, body.elements, body.gear_elements, drive, robot.centre, step
    )
    return out


def _smaller(robot: Robot, motion: Plan, shrink: float) -> Plan:
    if shrink == 1.0:
        return motion
    position = robot.centre + shrink * (motion.position - robot.centre)
    return Plan(
        motion.kind,
        motion.time,
        position,
        shrink * motion.velocity,
        shrink * motion.acceleration,
        shrink * motion.dither,
    )


def _inside(robot: Robot, position: Array) -> bool:
    room = 2.0 * robot.reach + np.where(robot.tree.slide, 0.5, 1.2) - 0.1
    return bool(np.isfinite(position).all() and (np.abs(position - robot.centre) < room).all())


def visibility(session: Session) -> list[float]:
    """For each truth: torque that the model misses because of it, over the sensors' noise, on its clearest joint [1].

    The oracle knows the robot exactly: the effect alone, no nuisance, an encoder that does not err. The missing torque
    is the momentum's change over a sample, less what was commanded; both are smoothed over 10 ms. What remains of it
    without the effect (truncation) is subtracted in squares. The noise is what the readings of these sensors do to the
    same torque.
    """
    robot, case = session.robot, session.case
    noise = _noise(session)
    none = _missing(session, nominal_body(robot, robot.tree))
    out = []
    for truth in case.truths:
        rng = generator(case.split, case.block, case.index, case.seed)
        body = conceal(nominal_body(robot, robot.tree), robot, _on_nominal(truth, session), case.split == "sealed", rng)
        missing = np.sqrt(np.maximum(_missing(session, body) ** 2 - none**2, 0.0))
        out.append(float((missing / noise).max()))
    return out


def _on_nominal(truth: Truth, session: Session) -> Truth:
    """Carry the change over to a robot whose links do not err: totals that start from an erring link are moved."""
    if truth.effect not in ("link_mass", "link_com") or truth.joint is None:
        return truth
    j = session.robot.joint_names.index(truth.joint)
    true, model = session.base, session.robot.tree
    ((name, value),) = truth.parameters.items()
    if name == "mass":
        return replace(truth, parameters={name: value * float(model.mass[j] / true.mass[j])})
    return replace(truth, parameters={name: value * float(np.linalg.norm(model.com[j]) / np.linalg.norm(true.com[j]))})


def _missing(session: Session, body: Body) -> Array:
    """Root mean square of the torque that the model misses, over the takes to fit. Shape (J,)."""
    robot, case = session.robot, session.case
    sensors = replace(perfect(session.sensors), clock_offset=body.clock[0])
    total, samples = np.zeros(robot.joints), 0
    for take, motion in enumerate(session.plans[: session.fitted]):
        rng = generator(case.split, case.block, case.index, case.seed + 7919 * (take + 1))
        drive = drive_for(robot, motion, case.mode, session.kp, session.kd, sensors, take, rng)
        command, reading, speed, _, _ = move(body, robot, drive)
        step = np.diff(drive.time)[:, None]
        q = 0.5 * (reading[1:] + reading[:-1]) - step / 8 * np.diff(speed, axis=0)
        v = np.diff(reading, axis=0) / step
        needed, _ = plant.inverse(robot.tree, q, v, np.diff(speed, axis=0) / step)
        needed += robot.armature * np.diff(speed, axis=0) / step + robot.damping * v
        given = command[:-1]
        if case.mode == "position_target":
            given = np.clip(drive.kp * (given - q) - drive.kd * v, -drive.limit, drive.limit)
        y = gaussian_filter1d(needed - given, 0.010 * case.rate, axis=0)
        total, samples = total + (y**2).sum(0), samples + len(y)
    return np.sqrt(total / samples)


def _noise(session: Session) -> Array:
    """Root mean square of the torque that the readings' errors look like. Shape (J,)."""
    robot, case, sensors = session.robot, session.case, session.sensors
    rng = generator(case.split, case.block, case.index, case.seed + 104729)
    samples, step = 4000, 1.0 / float(case.rate)
    motion = session.plans[0]
    q = motion.position[np.arange(samples) % len(motion.position)]
    still = np.zeros_like(q)
    silent = Plan("noise", np.linspace(0.0, step * (samples - 1), samples), q, still, still, still)
    drive = drive_for(robot, silent, case.mode, session.kp, session.kd, sensors, 0, rng)
    error = drive.noise + drive.resolution * rng.uniform(-0.5, 0.5, q.shape)
    error += session.typical.speed * (sensors.stamp_jitter * step) * rng.normal(size=(samples, 1))
    width = 0.010 * case.rate
    rate = np.gradient(error, step, axis=0)
    if sensors.velocity == "measured":
        rate = sensors.velocity_noise * rng.normal(size=q.shape)
    acceleration = gaussian_filter1d(np.gradient(rate, step, axis=0), width, axis=0)
    torque = acceleration @ robot.mass_matrix(robot.centre).T
    if case.mode == "position_target":
        torque += gaussian_filter1d(session.kp * error + session.kd * rate, width, axis=0)
    return np.asarray(np.sqrt((torque**2).mean(0)))


def beyond_nuisance(truth: Truth, session: Session) -> bool:
    """Whether an effect exceeds three times what every case has of its kind: inertial errors, encoder, clock."""
    p, robot = truth.parameters, session.robot
    j = robot.joint_names.index(truth.joint) if truth.joint is not None else 0
    base = session.base
    match truth.effect:
        case "link_mass":
            return abs(p["mass"] / robot.tree.mass[j] - 1) >= 3 * NUISANCE
        case "link_com":
            return abs(p["distance"] / float(np.linalg.norm(base.com[j])) - 1) >= 3 * NUISANCE
        case "payload":
            return p["mass"] / robot.tree.mass[j] >= 3 * NUISANCE
        case "reflected_inertia":
            link = session.typical.inertia[j] - robot.armature[j]
            return bool((p["armature"] - robot.armature[j]) / link >= 3 * NUISANCE)
        case "encoder_offset":
            return abs(p["offset"]) >= 3 * OFFSET * (0.2 if robot.tree.slide[j] else 1.0)
        case "gravity_tilt":
            return float(np.hypot(p["roll"], p["pitch"])) >= 3 * OFFSET
        case "clock_offset":
            return abs(p["offset"]) >= 0.75 / session.case.rate
        case "actuation_delay":
            return robot.joints > 1 or p["delay"] >= 0.75 / session.case.rate
        case _:
            return True


def key_json(split: Split, seed: int, counts: dict[str, int]) -> str:
    """All that the sealed cases hide, as text with a fixed order, and the digest of the generator's source."""
    cases = [prepare(split, block, k, seed).case.to_json() for block in BLOCKS for k in range(counts.get(block, 0))]
    return json.dumps({"source": source_digest(), "cases": cases}, sort_keys=True)


def source_digest() -> str:
    """Digest of the files that decide what is drawn and recorded."""
    digest = hashlib.sha256()
    for name in ("plant.py", "laws.py", "robots.py", "takes.py", "hidden.py", "cases.py"):
        digest.update((Path(__file__).parent / name).read_bytes())
    return digest.hexdigest()
