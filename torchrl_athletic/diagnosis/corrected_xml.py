"""The corrected model as MJCF: what MuJoCo can say natively."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any, Literal, TypeAlias

import mujoco
import numpy as np

from torchrl_athletic.diagnosis.corrected import Array, Simulation
from torchrl_athletic.diagnosis.corrected_gears import write_gears
from torchrl_athletic.diagnosis.fit import Hypothesis
from torchrl_athletic.diagnosis.screen import Candidate, Key
from torchrl_athletic.effects import Effect, JointAddress, Plant
from torchrl_athletic.effects.presliding import Bristle
from torchrl_athletic.effects.signals import torque_range
from torchrl_athletic.effects.torque import wave_number
from torchrl_athletic.recordings import Recording

Commands: TypeAlias = Literal["torques", "targets"]
Gains: TypeAlias = Mapping[str, tuple[float, float]]
"""Joint -> kp [N·m/rad] and kd [N·m·s/rad]."""


@dataclass(frozen=True)
class Written:
    """A corrected model as MJCF."""

    xml: str
    left_out: tuple[str, ...]
    """What MJCF does not say, or in part only, such as 'clock_offset of the robot': it stands in corrected.json."""

    @property
    def warning(self) -> str:
        """That the file alone is half a correction, in a sentence; empty if it is a whole one."""
        if not self.left_out:
            return ""
        return (
            f"corrected.xml alone is not the whole correction: it needs corrected.json for {', '.join(self.left_out)}. "
            "Half a correction can be worse than none."
        )


def logged_gains(recordings: Sequence[Recording]) -> Gains | None:
    """Joint -> kp and kd, where all recordings followed their targets with the same."""
    if not recordings:
        return None
    names, found = recordings[0].joint_names, []
    for r in (r.ordered(names) for r in recordings):
        if r.kp is None or r.kd is None:
            return None
        found.append(np.stack([r.kp, r.kd], axis=1))
    if not all(np.array_equal(gains, found[0]) for gains in found):
        return None
    return {n: (float(p), float(d)) for n, (p, d) in zip(names, found[0], strict=True)}


def corrected_xml(
    xml: str,
    simulation: Simulation,
    commands: Commands | None = None,
    *,
    drive: bool = True,
    gains: Gains | None = None,
) -> str:
    """The MJCF of :func:`written`."""
    return written(xml, simulation, commands, drive=drive, gains=gains).xml


def written(
    xml: str,
    simulation: Simulation,
    commands: Commands | None = None,
    *,
    drive: bool = True,
    gains: Gains | None = None,
) -> Written:
    """The model with what MJCF can say of the correction.

    Friction loss with its softness, damping, armature, stiffness and spring reference of joints; mass, centre of mass
    and inertia of links, payloads included; gravity. Where one actuator without a state of its own drives a joint:
    offset and limit of its torque, and its scale, which a position servo has in its gains; of a motor lag, too; of a
    servo both gains; and the delay, where the actuator takes what was recorded as the command. A servo gets the gains
    that were logged, whatever the model's are; its target stays the actuator's own, gear times the joint's. Ripple and
    hysteresis are the cogging and the LuGre friction of a ``dcmotor`` without an input, soft gears and play a
    :mod:`second hinge <torchrl_athletic.diagnosis.corrected_gears>`. This package drives joints past actuators, by
    ``corrected.json``, so that none acts twice.

    What is not said (limits by speed, encoders, most laws of friction) is listed in a comment and stands in
    ``corrected.json``. An effect that is said in part, such as the breakaway torque of Stribeck friction, stands in
    both. A file that lacks anything says so at its top.

    Args:
        xml: The given model.
        simulation: The corrected one.
        commands: Whether torques or position targets were recorded as commands; None leaves delays out.
        drive: Whether actuators and gears are corrected as well; a chain of transforms takes the place of that.
        gains: Joint -> kp and kd with which all recordings followed their targets; an actuator's own if None.
    """
    spec = mujoco.MjSpec.from_string(xml)
    spec.compile()  # fuses what fusestatic fuses, so that bodies are those of the model
    _state_inertia(spec, simulation.model)
    plant = _plant(simulation)
    said: set[Key] = set()
    for j, name in enumerate(simulation.joint_names):
        _write_joint(spec.joint(name), plant, j, spec.compiler.degree)
        if drive:
            said |= {
                (effect, name) for effect in _write_drive(spec, name, _drive_of(simulation, name), commands, gains)
            }
    for body in range(1, simulation.model.nbody):
        _write_link(spec.bodies[body], plant, body)
    if "opt.gravity" in plant.fields:
        spec.option.gravity = plant.fields["opt.gravity"][0]
    links: dict[str, str] = {}
    if drive:
        links = write_gears(spec, plant, simulation.joint_names)
        parts = (*simulation.hypothesis.terms, *simulation.hypothesis.trims)
        said |= {c.key for c in parts if c.effect.mjcf == "gear" and c.joint_name in links}
        said |= {c.key for c in parts if c.effect.write(spec, c.where, simulation.values_of(c))}
        for j, name in enumerate(simulation.joint_names):
            passive = _write_passive(spec, plant, j, (name, links.get(name)), _drive_of(simulation, name))
            said |= {(effect, name) for effect in passive}
    spec.compile()
    left_out = [
        (c, bool(_plant(simulation, c).fields))
        for c in (*simulation.hypothesis.terms, *simulation.hypothesis.trims)
        if c.effect.mjcf != "model" and c.key not in said
    ]
    result = Written("", tuple(f"{c.effect.name} of {c.where}" for c, _ in left_out))
    note = f"\n  WARNING: {result.warning}" if left_out else ""
    note += "".join(
        f"\n  {'in part only' if in_part else 'not expressed'} here, see corrected.json: {c.effect.name} of {c.where}"
        for c, in_part in left_out
    )
    note += "".join(
        f"\n  {motor} is the motor's joint, which the encoder reads; {link} the link's" for motor, link in links.items()
    )
    head = f"<!-- corrected by torchrl_athletic{note.replace('--', '- -')} -->"
    return replace(result, xml=f"{head}\n{spec.to_xml()}")


def _plant(simulation: Simulation, only: Candidate | None = None) -> Plant:
    """One simulation with the correction in it, but for what effects write themselves; or with one effect of it."""
    plant = Plant(simulation.model, JointAddress.of(simulation.model, simulation.joint_names), 1)
    h = simulation.hypothesis
    if only is None:
        terms, trims = (tuple(c for c in group if not _writes(c)) for group in (h.terms, h.trims))
        own = [simulation.values_of(c) for c in (*terms, *trims)]
        Hypothesis(terms, trims).build(plant, np.concatenate([np.zeros(0), *own])[None])
    elif not _writes(only):
        only.effect.apply(plant, only.joint, simulation.hypothesis.values_of(only, simulation.values)[None])
    return plant


def _writes(c: Candidate) -> bool:
    """Whether an effect says in MJCF itself what it is."""
    return type(c.effect).write is not Effect.write


def _write_joint(joint: Any, plant: Plant, j: int, degrees: bool) -> None:
    """``degrees``: whether the model's angles are in degrees."""
    fields, dof, index = plant.fields, plant.address.dof[j], plant.address.joint[j]
    if any(joint.springdamper):  # which would make both anew, from the inertia that is written
        joint.springdamper = [0, 0]
        joint.stiffness[0] = np.ravel(plant.model.jnt_stiffness[index])[0]
        joint.damping[0] = np.ravel(plant.model.dof_damping[dof])[0]
    if "dof_frictionloss" in fields:
        joint.frictionloss = float(fields["dof_frictionloss"][0, dof])
        joint.solref_friction, joint.solimp_friction = fields["dof_solref"][0, dof], fields["dof_solimp"][0, dof]
    if "dof_damping" in fields:
        joint.damping[0] = np.ravel(fields["dof_damping"][0, dof])[0]
    if "dof_armature" in fields:
        joint.armature = float(fields["dof_armature"][0, dof])
    if "jnt_stiffness" in fields:
        joint.stiffness[0] = np.ravel(fields["jnt_stiffness"][0, index])[0]
        rest = float(fields["qpos_spring"][0, plant.address.qpos[j]])
        turns = joint.type == mujoco.mjtJoint.mjJNT_HINGE
        joint.springref = np.degrees(rest) if turns and degrees else rest


def _drive_of(simulation: Simulation, joint: str) -> dict[str, Array]:
    """Effect -> values, of those that actuators of a joint may say."""
    h = simulation.hypothesis
    own = (c for c in (*h.terms, *h.trims) if c.joint_name == joint and c.effect.mjcf in ("actuator", "passive"))
    return {c.effect.name: h.values_of(c, simulation.values) for c in own}


def _write_drive(
    spec: mujoco.MjSpec,
    name: str,
    effects: Mapping[str, Array],
    commands: Commands | None,
    gains: Gains | None,
) -> set[str]:
    """Put a drive's effects into the joint's actuator, if there is one that can take them. Returns those it took."""
    own = _actuators_of(spec, name)
    takes = _commands_of(own[0]) if len(own) == 1 else None
    if takes is None:
        return set()
    (actuator,), said = own, set()
    of = {effect: float(values[0]) for effect, values in effects.items()}
    if takes == "torques" and ("torque_offset" in of or "torque_scale" in of):
        _keep_range(actuator)
    if "torque_offset" in of:
        actuator.biastype = mujoco.mjtBias.mjBIAS_AFFINE
        actuator.biasprm[0] += of["torque_offset"] / actuator.gear[0]
        said.add("torque_offset")
    if "torque_scale" in of and takes == "torques":
        actuator.gainprm[0] *= of["torque_scale"]
        said.add("torque_scale")
    servo = {"torque_scale", "gain_mismatch"} & of.keys()
    logged = gains[name] if gains is not None and commands == "targets" else None
    if takes == "targets" and (servo or logged is not None):
        scale = of.get("torque_scale", 1.0)
        kp, kd = (scale * float(x) for x in effects.get("gain_mismatch", np.ones(2)))
        if _write_gains(actuator, kp, kd, logged):
            said |= servo
    if "torque_saturation" in of and ("torque_scale" not in of or "torque_scale" in said):  # else no range says it
        most, offset = of["torque_saturation"] * of.get("torque_scale", 1.0), of.get("torque_offset", 0.0)
        if _limit(spec.joint(name), offset - most, offset + most):
            said.add("torque_saturation")
    if "actuation_lag" in of and takes == "torques" and not _key_has_activations(spec):
        actuator.dyntype, actuator.dynprm[0] = mujoco.mjtDyn.mjDYN_FILTEREXACT, of["actuation_lag"]
        said.add("actuation_lag")
    if "actuation_delay" in of and takes == commands:
        actuator.delay = of["actuation_delay"]
        actuator.nsample = max(1, int(np.ceil(actuator.delay / spec.option.timestep)))
        said.add("actuation_delay")
    return said


def _write_gains(actuator: Any, kp_scale: float, kd_scale: float, logged: tuple[float, float] | None) -> bool:
    """Scale a position servo's gains, or the logged ones in their place. Whether it has gains that can be scaled.

    A gear turns the joint's angle into the actuator's, and the actuator's torque into the joint's: its square stands
    between the joint's gains, which were logged, and the actuator's.
    """
    kp, kd = float(actuator.gainprm[0]), -float(actuator.biasprm[2])
    if logged is not None:
        kp, kd = (gain / float(actuator.gear[0]) ** 2 for gain in logged)
    if kd < 0 or actuator.biasprm[1] != -actuator.gainprm[0]:  # a damping ratio, or no servo on its target
        return False
    actuator.gainprm[0], actuator.biasprm[1], actuator.biasprm[2] = kp_scale * kp, -kp_scale * kp, -kd_scale * kd
    return True


def _write_passive(
    spec: mujoco.MjSpec, plant: Plant, j: int, names: tuple[str, str | None], effects: Mapping[str, Array]
) -> set[str]:
    """Add motors without an input that say a joint's ripple and hysteresis. Returns those that they say.

    ``names``: of the joint that is driven, and of its link, if a gear parts them.
    """
    name, link = names
    said = set()
    if "hysteresis" in effects and not _key_has_activations(spec) and (link or _frees_range(spec, name)):
        (bristle,) = (law for law in plant.laws if isinstance(law, Bristle) and law.relaxed and law.joint == j)
        torque, width = float(bristle.level[0]), float(bristle.width[0])
        if _add_passive(spec, f"{name}_hysteresis", link or name, lugre=[torque / width, 0.0, torque, torque, 1.0]):
            said.add("hysteresis")
    beside = link is None and "hysteresis" in said
    mixed = "torque_saturation" in effects  # which may come after the ripple or before
    if "torque_ripple" in effects and not mixed and _limits_ripple(spec, plant, j, name, beside):
        sine, cosine, periods = effects["torque_ripple"]
        scale = effects["torque_scale"][0] if "torque_scale" in effects else 1.0
        waves = float(wave_number(periods, plant.model, plant.address, j))
        cogging = [float(scale * np.hypot(sine, cosine)), waves, float(np.arctan2(cosine, sine))]
        if _add_passive(spec, f"{name}_ripple", name, cogging=cogging):
            said.add("torque_ripple")
    return said


def _add_passive(spec: mujoco.MjSpec, name: str, joint: str, **law: list[float]) -> bool:
    """Add a motor without an input, unless the name is in use. Whether it is there."""
    if spec.actuator(name) is not None:
        return False
    no = mujoco.mjtLimited.mjLIMITED_FALSE
    actuator = spec.add_actuator(  # none of the model's defaults is meant for it
        name=name,
        target=joint,
        trntype=mujoco.mjtTrn.mjTRN_JOINT,
        gear=[1, 0, 0, 0, 0, 0],
        forcelimited=no,
        forcerange=[0, 0],
        ctrllimited=no,
        ctrlrange=[0, 0],
        actlimited=no,
        actrange=[0, 0],
        delay=0,
        nsample=0,
        armature=0,
        damping=[0, 0, 0],
    )
    without_input = int(mujoco.mjtCtrlInput.mjINPUT_NONE)
    actuator.set_to_dcmotor(motorconst=[0.0, 0.0], resistance=1.0, ctrlspec=without_input, **law)
    return True


def _actuators_of(spec: mujoco.MjSpec, joint: str) -> list[Any]:
    return [a for a in spec.actuators if a.target == joint and a.trntype == mujoco.mjtTrn.mjTRN_JOINT]


def _key_has_activations(spec: mujoco.MjSpec) -> bool:
    """Whether another state of an actuator would make a keyframe's length wrong."""
    return any(len(key.act) for key in spec.keys)


def _frees_range(spec: mujoco.MjSpec, name: str) -> bool:
    """Make a joint's range of force its only motor's, so that friction beside that is not limited. Whether it is."""
    joint, own = spec.joint(name), _actuators_of(spec, name)
    if joint.actfrclimited == mujoco.mjtLimited.mjLIMITED_FALSE or not np.ptp(joint.actfrcrange):
        return True
    if len(own) != 1 or not own[0].gear[0] or joint.actgravcomp or _has_other_transmissions(spec):
        return False
    (actuator,) = own
    low, high = np.sort(np.asarray(joint.actfrcrange) / actuator.gear[0])
    if actuator.forcelimited != mujoco.mjtLimited.mjLIMITED_FALSE and np.ptp(actuator.forcerange):
        low, high = max(low, actuator.forcerange[0]), min(high, actuator.forcerange[1])
    if low >= high:
        return False
    actuator.forcerange, actuator.forcelimited = [low, high], mujoco.mjtLimited.mjLIMITED_TRUE
    joint.actfrcrange, joint.actfrclimited = [0, 0], mujoco.mjtLimited.mjLIMITED_FALSE
    return True


def _limits_ripple(spec: mujoco.MjSpec, plant: Plant, j: int, name: str, beside: bool) -> bool:
    """Make the range of a motor the joint's, so that it limits motor and ripple together. Whether it does.

    ``beside``: whether friction acts at the joint, which the motor's range must not limit.
    """
    low, high = (float(limit[j]) for limit in torque_range(plant.model, plant.address))
    if not np.isfinite([low, high]).any():
        return True
    own = _actuators_of(spec, name)
    limited = [a for a in own if a.forcelimited != mujoco.mjtLimited.mjLIMITED_FALSE and np.ptp(a.forcerange)]
    if beside or not np.isfinite([low, high]).all() or len(own) > 1 or _has_other_transmissions(spec):
        return False
    joint = spec.joint(name)
    joint.actfrcrange, joint.actfrclimited = [low, high], mujoco.mjtLimited.mjLIMITED_TRUE
    for actuator in limited:
        actuator.forcerange, actuator.forcelimited = [0, 0], mujoco.mjtLimited.mjLIMITED_FALSE
    return True


def _has_other_transmissions(spec: mujoco.MjSpec) -> bool:
    """Whether tendons, sites or bodies are driven, which may move any joint."""
    return any(a.trntype != mujoco.mjtTrn.mjTRN_JOINT for a in spec.actuators)


def _commands_of(actuator: Any) -> Commands | None:
    """What an actuator without a state of its own is told: torques, or the position that it holds; None of others."""
    stateless = actuator.dyntype == mujoco.mjtDyn.mjDYN_NONE and actuator.gaintype == mujoco.mjtGain.mjGAIN_FIXED
    if not stateless or not actuator.gear[0]:
        return None
    if actuator.biastype == mujoco.mjtBias.mjBIAS_NONE:
        return "torques"
    return "targets" if actuator.biastype == mujoco.mjtBias.mjBIAS_AFFINE and actuator.biasprm[1] else None


def _limit(joint: Any, low: float, high: float) -> bool:
    """Limit the torque of a joint's actuators, within what is there. Returns whether anything is left of it."""
    if joint.actfrclimited != mujoco.mjtLimited.mjLIMITED_FALSE and np.ptp(joint.actfrcrange):
        low, high = max(low, joint.actfrcrange[0]), min(high, joint.actfrcrange[1])
    if low >= high:
        return False
    joint.actfrcrange, joint.actfrclimited = [low, high], mujoco.mjtLimited.mjLIMITED_TRUE
    return True


def _keep_range(actuator: Any) -> None:
    """A motor's range is that of its command; what its torque is scaled and shifted to keeps it."""
    if actuator.ctrllimited == mujoco.mjtLimited.mjLIMITED_FALSE or not np.ptp(actuator.ctrlrange):
        return
    low, high = np.sort(actuator.gainprm[0] * np.asarray(actuator.ctrlrange))
    if actuator.forcelimited != mujoco.mjtLimited.mjLIMITED_FALSE and np.ptp(actuator.forcerange):
        low, high = max(low, actuator.forcerange[0]), min(high, actuator.forcerange[1])
    actuator.forcerange, actuator.forcelimited = [low, high], mujoco.mjtLimited.mjLIMITED_TRUE


def _state_inertia(spec: mujoco.MjSpec, model: mujoco.MjModel) -> None:
    """Write every body's inertia down where the compiler would make it from geometry, bounds or a total mass."""
    compiler = spec.compiler
    from_geometry = compiler.inertiafromgeom == mujoco.mjtInertiaFromGeom.mjINERTIAFROMGEOM_TRUE
    if not from_geometry and max(compiler.boundmass, compiler.boundinertia, compiler.settotalmass) <= 0:
        return
    for body in range(1, model.nbody):
        _set_inertia(spec.bodies[body], *(getattr(model, name)[body] for name in _INERTIAL))
    compiler.inertiafromgeom = mujoco.mjtInertiaFromGeom.mjINERTIAFROMGEOM_AUTO
    compiler.boundmass, compiler.boundinertia, compiler.settotalmass = 0.0, 0.0, -1.0


_INERTIAL = ("body_mass", "body_ipos", "body_iquat", "body_inertia")


def _write_link(link: Any, plant: Plant, body: int) -> None:
    """Mass, centre of mass and principal moments, where they changed."""
    given = [getattr(plant.model, name)[body] for name in _INERTIAL]
    corrected = [
        plant.fields[name][0, body] if name in plant.fields else value
        for name, value in zip(_INERTIAL, given, strict=True)
    ]
    if not all(np.array_equal(c, g) for c, g in zip(corrected, given, strict=True)):
        _set_inertia(link, *corrected)


def _set_inertia(link: Any, mass: Array, position: Array, orientation: Array, moments: Array) -> None:
    link.mass, link.ipos, link.iquat, link.inertia = float(mass), position, orientation, moments
    link.fullinertia = [np.nan, 0, 0, 0, 0, 0]  # which would count instead
    link.explicitinertial = True
