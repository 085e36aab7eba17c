"""What a diagnosis found between the command and the joint, as part of the actuation chain."""

from __future__ import annotations

import json
import math
import os
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, TypeAlias

import torch
from tensordict import NestedKey, TensorDictBase
from torch import Tensor
from torchrl.data import Composite, TensorSpec, Unbounded
from torchrl.envs.batched_envs import BatchedEnvBase

from torchrl_athletic.functional import actuation, history
from torchrl_athletic.functional import actuator_dynamics as dynamics
from torchrl_athletic.functional.gears import link_joint
from torchrl_athletic.transforms.actuation import PerJoint, scaled
from torchrl_athletic.transforms.keys import beside
from torchrl_athletic.transforms.stateful import StatefulTransform, base_env_of, unbounded_like

SCHEMA = "torchrl_athletic/corrected/1"

IN_THE_MODEL = {
    "coulomb_friction": ("torque",),
    "viscous_friction": ("damping",),
    "reflected_inertia": ("armature",),
    "link_mass": ("mass",),
    "link_com": ("distance",),
    "link_com_shift": ("x", "y", "z"),
    "link_inertia": ("scale",),
    "payload": ("mass",),
    "offset_payload": ("mass", "moment_x", "moment_y", "moment_z"),
    "gravity_tilt": ("roll", "pitch"),
    "joint_spring": ("stiffness", "preload"),
}
"""Effects that ``corrected.xml`` holds, and their parameters."""

IN_THE_CHAIN = {
    "asymmetric_friction": ("coulomb_positive", "coulomb_negative", "viscous_positive", "viscous_negative"),
    "stribeck_friction": ("coulomb", "stribeck", "stribeck_speed"),
    "hysteresis": ("torque", "width"),
    "actuation_delay": ("delay",),
    "actuation_lag": ("time_constant",),
    "torque_scale": ("scale",),
    "torque_offset": ("torque",),
    "torque_saturation": ("limit",),
    "speed_torque_limit": ("stall_torque", "no_load_speed"),
    "torque_ripple": ("sine", "cosine", "periods"),
    "joint_stop": ("position", "side", "stiffness"),
    "encoder_offset": ("offset",),
    "encoder_scale": ("scale",),
    "clock_offset": ("offset",),
    "gain_mismatch": ("kp_scale", "kd_scale"),
}
"""Effects that :class:`CorrectedActuation` acts out, and their parameters.

Of the first two, the part that brakes both ways is in the model. A clock that is late is acted out as a delay of all
commands, which no recording tells from it; one that is early is left out, since nothing acts before its command.
"""

OF_THE_RECORDING = frozenset({"base_clock_shift", "clock_shift", "disturbance"})
"""Effects of one recording, which no robot has for good: how it was stamped, and what pushed it once."""

NOT_ACTED_OUT: Mapping[str, str] = {
    "backlash": "the motor needs an inertia and a position of its own; corrected.xml has them, for its own actuators",
    "compliance": "the motor needs an inertia and a position of its own; corrected.xml has them, for its own actuators",
    "coupled_drive": "its rotor and its friction act between two joints; corrected.xml has them, as a tendon",
    "load_dependent_friction": "its bristles are damped by the inertia of the joint, which the chain does not know",
    "thermal_drift": "an episode would have to say how warm the joint is; train with both ends of the drift instead",
}
"""Effects that a diagnosis can find and :class:`CorrectedActuation` refuses, each with the reason."""

_MOTOR = ("torque_saturation", "speed_torque_limit", "torque_ripple")

Correction: TypeAlias = str | os.PathLike[str] | Mapping[str, Any]
"""Path of a ``corrected.json``, or what stands in it."""


@dataclass(frozen=True)
class CorrectedKeys:
    """Entries that a :class:`CorrectedActuation` reads and writes."""

    torque: NestedKey = "torque"
    """Torque that the environment takes [N·m]. Shape (*B, J)."""
    action: NestedKey = "action"
    """Target that the policy gives instead, where there are gains [rad]. Shape (*B, J)."""
    position: NestedKey = "joint_position"
    """[rad]. Shape (*B, J)."""
    velocity: NestedKey = "joint_velocity"
    """[rad/s]. Shape (*B, J)."""
    target: NestedKey = "position_target"
    """Target that acts, noted [rad]. Shape (*B, J)."""
    scales: tuple[NestedKey, NestedKey] = ("kp_scale", "kd_scale")
    """Scales of the gains, as of :class:`PDControl`."""
    limit_scale: NestedKey = "torque_limit_scale"
    """What multiplies the motors' torques at standstill, the diagnosed ones too, where the tensordict has it.

    Shape (*B, J) or (*B, 1).
    """
    state: NestedKey = "corrected_actuation"
    """Begins the keys of what is remembered, as far as needed.

    ``_queue``, commands on their way, shape (*B, L, J); ``_lag``, the state of the lag, (*B, J); ``_wound`` and
    ``_last``, how far hysteresis has built up, 0 at the start, and where, (*B, J); ``_fresh``, whether an episode has
    yet to get its first command, (*B, 1). What came before is taken to be that one.
    """


class CorrectedActuation(StatefulTransform):
    r"""Drive the joints as a diagnosis found that the real ones are driven.

    It takes the place of :class:`PDControl`: with gains, the action is a position target, else a torque. On the way
    from there to the joint come, where the diagnosis found them,

    1. the delay of the command,
    2. the gains as they truly are, on what the encoder reads,
    3. the lag of the torque loop,
    4. the motor's saturation, limit by speed and ripple, in the order of the file,
    5. the scale and the offset of the torque,
    6. the motor's limit,
    7. what the motor's limit does not touch: stops, hysteresis, what Stribeck friction saves at speed, and the part of
       friction by direction that is alike in both.

    ``joint_position`` and ``joint_velocity`` show what the encoder reads. All of it happens once per torque: place
    the transform nearest to the motor, before :class:`~.Decimation`. What MuJoCo expresses itself (dry and viscous
    friction, inertia, masses, springs, gravity) is in the model that the diagnosis wrote, ``corrected.xml``: build the
    robot from it, :func:`~torchrl_athletic.robots.from_mjcf`, and domain randomisation is then about the corrected
    values too.

    Args:
        correction: Path of a ``corrected.json``, or its content.
        timestep: For which a torque is held, that of the physics but for ``TorqueEnv(substeps=...)`` [s].
        joint_names: Of the environment's joints, those of the diagnosis among them; None takes the latter. Length J.
        kp: Gains as the drive is told [N·m/rad]; None for torques. Shape (J,) or ().
        kd: [N·m·s/rad]. Shape (J,) or ().
        torque_limit: Of the motors [N·m]. Shape (J,) or ().
        keys: Entries that it reads and writes.
        reset_key: As of :class:`StatefulTransform`.

    Raises:
        ValueError: If the file names an effect that is not known here, is of another schema, or names other joints; on
            an environment, if its model, joints or time step are not those of the correction.

    Example:
        >>> from torchrl_athletic.envs import TorqueEnv
        >>> from torchrl_athletic.robots import z1
        >>> from torchrl.envs import TransformedEnv
        >>> robot = z1()
        >>> late = {"effect": "actuation_delay", "joint": "joint2", "parameters": {"delay": {"value": 0.012}}}
        >>> found = {"schema": "torchrl_athletic/corrected/1", "joint_names": ["joint2"]}
        >>> found |= {"effects": [late], "trims": []}
        >>> chain = CorrectedActuation(
        ...     found, timestep=0.005, joint_names=robot.joint_names,
        ...     kp=robot.kp, kd=robot.kd, torque_limit=robot.torque_limit)
        >>> env = TransformedEnv(TorqueEnv(robot, num_envs=2), chain)
        >>> env.rollout(3)["corrected_actuation_queue"].shape
        torch.Size([2, 3, 4, 7])
    """

    weights: Tensor
    lag_end: Tensor
    lag_shown: Tensor
    torque_scale: Tensor
    torque_offset: Tensor
    torque_limit: Tensor
    even_constant: Tensor
    even_slope: Tensor
    stall_torque: Tensor
    no_load_speed: Tensor
    ripple_sine: Tensor
    ripple_cosine: Tensor
    ripple_wave: Tensor
    stribeck_excess: Tensor
    stribeck_speed: Tensor
    hysteresis_torque: Tensor
    hysteresis_width: Tensor
    stop_place: Tensor
    stop_side: Tensor
    stop_stiffness: Tensor
    encoder_offset: Tensor
    encoder_scale: Tensor
    kp: Tensor
    kd: Tensor

    def __init__(
        self,
        correction: Correction,
        *,
        timestep: float,
        joint_names: Sequence[str] | None = None,
        kp: PerJoint | None = None,
        kd: PerJoint | None = None,
        torque_limit: PerJoint = torch.inf,
        keys: CorrectedKeys = CorrectedKeys(),
        reset_key: NestedKey | None = None,
    ) -> None:
        content = _read(correction)
        self.joint_names = tuple(content["joint_names"] if joint_names is None else joint_names)
        self.entries = _known_entries(content, self.joint_names)
        if (kp is None) != (kd is None):
            raise ValueError("CorrectedActuation got one of kp and kd: a PD law needs both, a torque neither.")
        self.closed_loop = kp is not None
        if not self.closed_loop and (odd := [e for e in self.entries if e[0] == "gain_mismatch"]):
            raise ValueError(
                f"the correction holds gain_mismatch of {odd[0][1]!r}, but without kp and kd there are no gains to "
                "correct. Give CorrectedActuation the gains that the drive is told."
            )
        queue, lag, wound, last, fresh = (
            beside(keys.state, name) for name in ("queue", "lag", "wound", "last", "fresh")
        )
        late = zip(self._column("actuation_delay"), self._column("clock_offset"), strict=True)
        delays, lags = [delay + max(offset, 0.0) for delay, offset in late], self._column("actuation_lag")
        self.present = frozenset(effect for effect, _, _ in self.entries)
        self.motor = tuple(name for name in dict.fromkeys(e[0] for e in self.entries) if name in _MOTOR)
        self.queue_key, self.lag_key = queue if any(delays) else None, lag if any(lags) else None
        winds = "hysteresis" in self.present
        self.wound_key, self.last_key = wound if winds else None, last if winds else None
        self.fresh_key = fresh if self.queue_key or self.lag_key or self.wound_key else None
        needed = (self.queue_key, self.lag_key, self.wound_key, self.last_key, self.fresh_key)
        memory = [key for key in needed if key is not None]
        policy_key = keys.action if self.closed_loop else keys.torque
        reads = [keys.position, keys.velocity] if "encoder_scale" in self.present else [keys.position]
        super().__init__(reads, [*reads, *memory], [keys.torque], [policy_key], reset_key)
        self.memory, self.timestep, self.policy_key, self.torque_key = memory, timestep, policy_key, keys.torque
        self.position_key, self.velocity_key = keys.position, keys.velocity
        self.target_key, self.scale_keys, self.limit_scale_key = keys.target, keys.scales, keys.limit_scale
        self._make_buffers(delays, lags, kp, kd, torque_limit)

    def _column(self, effect: str, parameter: int = 0, absent: float = 0.0) -> list[float]:
        """A parameter of an effect, by joint; of two entries for one joint the later counts, as in the diagnosis."""
        found = {joint: values[parameter] for name, joint, values in self.entries if name == effect}
        return [found.get(name, absent) for name in self.joint_names]

    def _make_buffers(
        self, delays: list[float], lags: list[float], kp: PerJoint | None, kd: PerJoint | None, limit: PerJoint
    ) -> None:
        lag_end, lag_mean = dynamics.lag_factors(lags, self.timestep)
        forth_back = [self._column("asymmetric_friction", k) for k in range(4)]
        forth, back, forth_slope, back_slope = (torch.tensor(column) for column in forth_back)
        values = {
            "weights": dynamics.delay_weights(delays, self.timestep),
            "lag_end": lag_end,
            # A torque acts as its mean over the step; that of a closed loop as at its end. So did the replay that
            # fitted the time constant.
            "lag_shown": lag_end if self.closed_loop else lag_mean,
            "torque_scale": self._column("torque_scale", absent=1.0),
            "torque_offset": self._column("torque_offset"),
            "torque_limit": limit,
            "even_constant": (forth - back) / 2,
            "even_slope": (forth_slope - back_slope) / 2,
            "stall_torque": [
                min(both)
                for both in zip(
                    self._column("torque_saturation", absent=torch.inf),
                    self._column("speed_torque_limit", absent=torch.inf),
                    strict=True,
                )
            ],
            "no_load_speed": self._column("speed_torque_limit", 1, torch.inf),
            "ripple_sine": self._column("torque_ripple"),
            "ripple_cosine": self._column("torque_ripple", 1),
            "ripple_wave": self._column("torque_ripple", 2),
            "stribeck_excess": self._column("stribeck_friction", 1),
            "stribeck_speed": self._column("stribeck_friction", 2, 1.0),
            "hysteresis_torque": self._column("hysteresis"),
            "hysteresis_width": self._column("hysteresis", 1, 1.0),
            "stop_place": self._column("joint_stop"),
            "stop_side": torch.tensor(self._column("joint_stop", 1, 1.0)).sign(),
            "stop_stiffness": self._column("joint_stop", 2),
            "encoder_offset": self._column("encoder_offset"),
            "encoder_scale": self._column("encoder_scale", absent=1.0),
        }
        if self.closed_loop:
            for k, (name, gain) in enumerate((("kp", kp), ("kd", kd))):
                values[name] = _float(gain) * _float(self._column("gain_mismatch", k, 1.0))
        for name, value in values.items():
            self.register_buffer(name, _float(value))

    def _inv_call(self, tensordict: TensorDictBase) -> TensorDictBase:
        if self.parent is None:  # on its way into a buffer: what acted is noted already
            return tensordict
        command = tensordict.get(self.policy_key)
        if self.queue_key is not None:
            command = self._late(command, tensordict)
        read, rate = tensordict.get(self.position_key), tensordict.get(self.velocity_key)
        torque = command
        if self.closed_loop:
            kp, kd = self._gains(tensordict)
            torque = actuation.pd_torque(command, read, rate, kp, kd)
            tensordict.set(self.target_key, command)
        if self.lag_key is not None:
            torque = self._lagging(torque, tensordict)
        position, velocity = (read - self.encoder_offset) / self.encoder_scale, rate / self.encoder_scale
        stall_torque, limit = (
            scaled(value, tensordict, self.limit_scale_key) for value in (self.stall_torque, self.torque_limit)
        )
        for name in self.motor:
            if name == "torque_ripple":
                wave = self.ripple_sine, self.ripple_cosine, self.ripple_wave
                torque = torque + dynamics.ripple(position, *wave)
            else:
                torque = actuation.clip_torque_speed(torque, velocity, stall_torque, self.no_load_speed)
        torque = torch.clamp(torque * self.torque_scale + self.torque_offset, -limit, limit)
        torque = self._beside_the_motor(torque, position, velocity, tensordict)
        if self.fresh_key is not None:
            tensordict.set(self.fresh_key, torch.zeros_like(tensordict.get(self.fresh_key)))
        return tensordict.set(self.torque_key, torque)

    def _beside_the_motor(
        self, torque: Tensor, position: Tensor, velocity: Tensor, tensordict: TensorDictBase
    ) -> Tensor:
        """Add what acts at the joint itself, at its true position and velocity."""
        if "asymmetric_friction" in self.present:
            torque = torque + dynamics.even_friction(velocity, self.even_constant, self.even_slope)
        if "stribeck_friction" in self.present:
            torque = torque + dynamics.stribeck_relief(velocity, self.stribeck_excess, self.stribeck_speed)
        if "joint_stop" in self.present:
            torque = torque + dynamics.stop_torque(position, self.stop_place, self.stop_side, self.stop_stiffness)
        if self.wound_key is not None:
            last = torch.where(tensordict.get(self.fresh_key), position, tensordict.get(self.last_key))
            wound = dynamics.wind_up(tensordict.get(self.wound_key), position - last, self.hysteresis_width)
            tensordict.set(self.wound_key, wound).set(self.last_key, position)
            torque = torque - self.hysteresis_torque * wound
        return torque

    def _late(self, command: Tensor, tensordict: TensorDictBase) -> Tensor:
        fresh = tensordict.get(self.fresh_key).unsqueeze(-1)
        queue = torch.where(fresh, command.unsqueeze(-2), tensordict.get(self.queue_key))
        queue = history.push(queue, command)
        tensordict.set(self.queue_key, queue)
        return dynamics.delayed(queue, self.weights)

    def _lagging(self, torque: Tensor, tensordict: TensorDictBase) -> Tensor:
        state = torch.where(tensordict.get(self.fresh_key), torque, tensordict.get(self.lag_key))
        tensordict.set(self.lag_key, dynamics.low_pass(torque, state, self.lag_end))
        return dynamics.low_pass(torque, state, self.lag_shown)

    def _gains(self, tensordict: TensorDictBase) -> tuple[Tensor, Tensor]:
        kp, kd = (scaled(gain, tensordict, k) for gain, k in zip((self.kp, self.kd), self.scale_keys, strict=True))
        return kp, kd

    def initial(self, tensordict_reset: TensorDictBase) -> Mapping[NestedKey, Tensor]:
        position = tensordict_reset.get(self.position_key)
        first: dict[NestedKey, Tensor] = {}
        if self.queue_key is not None:
            first[self.queue_key] = history.tile(torch.zeros_like(position), len(self.weights))
        if self.lag_key is not None:
            first[self.lag_key] = torch.zeros_like(position)
        for key in (self.wound_key, self.last_key):
            if key is not None:
                first[key] = torch.zeros_like(position)
        if self.fresh_key is not None:
            first[self.fresh_key] = torch.ones_like(position[..., :1], dtype=torch.bool)
        return first

    def advance(self, tensordict: TensorDictBase, next_tensordict: TensorDictBase) -> None:
        self._read_encoder(next_tensordict)
        for key in self.memory:
            next_tensordict.set(key, tensordict.get(key))

    def _reset(self, tensordict: TensorDictBase, tensordict_reset: TensorDictBase) -> TensorDictBase:
        return self._read_encoder(super()._reset(tensordict, tensordict_reset))

    def _reset_on_native_autoreset(
        self, tensordict: TensorDictBase, tensordict_reset: TensorDictBase
    ) -> TensorDictBase:
        return super()._reset(tensordict, tensordict_reset)  # the step has read the encoder already

    def _read_encoder(self, tensordict: TensorDictBase) -> TensorDictBase:
        position = tensordict.get(self.position_key) * self.encoder_scale + self.encoder_offset
        if "encoder_scale" in self.present:
            tensordict.set(self.velocity_key, tensordict.get(self.velocity_key) * self.encoder_scale)
        return tensordict.set(self.position_key, position)

    def state_spec(self, observation_spec: Composite) -> Mapping[NestedKey, TensorSpec]:
        position = observation_spec[self.position_key]
        self._check_environment(position.shape[-1])
        specs: dict[NestedKey, TensorSpec] = {}
        if self.queue_key is not None:
            shape = (*position.shape[:-1], *self.weights.shape)
            specs[self.queue_key] = unbounded_like(position, shape)
        for key in (self.lag_key, self.wound_key, self.last_key):
            if key is not None:
                specs[key] = unbounded_like(position, position.shape)
        if self.fresh_key is not None:
            specs[self.fresh_key] = Unbounded((*position.shape[:-1], 1), dtype=torch.bool, device=position.device)
        return specs

    def transform_action_spec(self, action_spec: Composite) -> Composite:
        if self.closed_loop:
            torque = action_spec[self.torque_key]
            if self.torque_key != self.policy_key:
                del action_spec[self.torque_key]
            action_spec[self.policy_key] = unbounded_like(torque, torque.shape)
        return action_spec

    def _check_environment(self, joints: int) -> None:
        """Raise unless the environment is the one that the correction is for."""
        if joints != len(self.joint_names):
            raise ValueError(
                f"CorrectedActuation is for {len(self.joint_names)} joints, the environment has {joints}. Give it "
                "joint_names of all of them; those that the diagnosis did not look at stay as they are."
            )
        env = base_env_of(self.parent)
        physics = None if isinstance(env, BatchedEnvBase) else getattr(env, "physics", None)
        if physics is None:  # an environment in another process cannot be asked
            return
        if tuple(physics.joint_names) != self.joint_names:
            raise ValueError(
                f"CorrectedActuation is for the joints {self.joint_names}, the environment has "
                f"{tuple(physics.joint_names)}: corrections would act on other joints. Give it joint_names in that "
                "order."
            )
        step = getattr(env, "substeps", 1) * physics.timestep
        if abs(step - self.timestep) > 1e-9:
            raise ValueError(
                f"CorrectedActuation counts steps of {self.timestep} s, the environment holds a torque for {step} s: "
                f"delays and lags would be off in proportion. Give it timestep={step}."
            )
        carries = {joint for effect, joint, _ in self.entries if effect in ("payload", "offset_payload")}
        for effect, joint, values in self.entries:
            if effect in ("link_mass", "link_com") and joint in carries:  # their sum is in the model
                continue
            wanted, has = _in_model(physics.model, effect, joint, values)
            if abs(has - wanted) > 1e-3 * abs(wanted) + 1e-9:
                name = (IN_THE_MODEL | IN_THE_CHAIN)[effect][0]
                raise ValueError(
                    f"the correction holds {effect} of {joint!r}, {name} {wanted:.4g}, but the model has {has:.4g}: it "
                    "would be left out. Build the robot from corrected.xml, which the diagnosis wrote beside "
                    "corrected.json."
                )


def _float(value: Any) -> Tensor:
    """A float32 tensor of its own."""
    return value.float().clone() if isinstance(value, Tensor) else torch.tensor(value, dtype=torch.float32)


def _read(correction: Correction) -> Mapping[str, Any]:
    content = correction if isinstance(correction, Mapping) else json.loads(Path(correction).read_text("utf-8"))
    if content.get("schema") != SCHEMA:
        raise ValueError(
            f"schema is {content.get('schema')!r}, CorrectedActuation reads {SCHEMA!r}. Give it the corrected.json of "
            "a diagnosis made by this version."
        )
    return content


def _known_entries(
    content: Mapping[str, Any], joint_names: tuple[str, ...]
) -> list[tuple[str, str | None, tuple[float, ...]]]:
    """Effect, joint and values, all of which the chain or the model can express."""
    known = IN_THE_CHAIN | IN_THE_MODEL
    entries: list[tuple[str, str | None, tuple[float, ...]]] = []
    for entry in (*content["effects"], *content["trims"]):
        effect, joint, given = entry["effect"], entry["joint"], entry["parameters"]
        if effect in OF_THE_RECORDING:
            continue
        if effect not in known:
            why = f" ({NOT_ACTED_OUT[effect]})" if effect in NOT_ACTED_OUT else ""
            raise ValueError(
                f"effect {effect!r} of {joint!r} is not one that CorrectedActuation can act out{why}: it knows "
                f"{sorted(known)}. Leave it out of the correction if the policy may be trained without it."
            )
        if joint is not None and joint not in joint_names:
            raise ValueError(
                f"{effect} was found on joint {joint!r}, which is not among joint_names {joint_names}. Name the "
                "environment's joints as the diagnosed model does."
            )
        values = tuple(float(given[name]["value"]) for name in known[effect])
        if effect == "torque_ripple" and given["periods"].get("unit") == "1/m":  # else a revolution
            values = (*values[:2], 2 * math.pi * values[2])
        whose = content["joint_names"] if effect == "clock_offset" else [joint]
        entries += [(effect, name, values) for name in whose]
    return entries


def _in_model(model: Any, effect: str, joint: str | None, values: tuple[float, ...]) -> tuple[float, float]:
    """What the model should have for an effect and what it has, alike where that cannot be told."""
    if effect == "gravity_tilt" and not model.opt.gravity[:2].any():  # straight down
        return max(values, key=abs), 0.0
    if joint is None:
        return 0.0, 0.0
    at = model.joint(joint)
    if effect != "reflected_inertia":
        at = model.joint(link_joint(model, joint))
    dry = {
        "coulomb_friction": values[0],
        "asymmetric_friction": sum(values[:2]) / 2,
        "stribeck_friction": sum(values[:2]),
    }
    if effect in dry:
        return dry[effect], float(at.frictionloss[0])
    if effect == "viscous_friction":
        return values[0], float(at.damping.flat[0])
    if effect == "reflected_inertia":
        return values[0], float(at.armature[0])
    if effect == "joint_spring":
        return values[0], float(at.stiffness.flat[0])
    body = model.body(at.bodyid[0])
    if effect == "link_mass":
        return values[0], float(body.mass[0])
    if effect == "link_com":
        offset = body.ipos - at.pos
        lever = offset - at.axis * (at.axis @ offset)
        return values[0], float((lever @ lever) ** 0.5)
    return 0.0, 0.0
