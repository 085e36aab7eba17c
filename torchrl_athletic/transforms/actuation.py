"""The chain between the policy and the motor, as transforms on the action's way in."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import torch
from tensordict import NestedKey, TensorDictBase, unravel_key
from tensordict.nn import TensorDictModuleBase
from torch import Tensor, nn
from torchrl.data import Composite, TensorSpec, Unbounded
from torchrl.envs import Transform

from torchrl_athletic.functional import actuation, actuator_dynamics, history, streams
from torchrl_athletic.transforms.stateful import (
    Joints,
    RandomTransform,
    StatefulTransform,
    full_action_spec,
    joint_index,
    unbounded_like,
)

PerJoint = Tensor | Sequence[float] | float
"""One value for every joint, or one for all."""


class _Torque(Transform):
    """Changes the torque on its way to the motor."""

    def __init__(self, torque_key: NestedKey, action_key: NestedKey | None = None) -> None:
        super().__init__(in_keys=[], out_keys=[], in_keys_inv=[torque_key], out_keys_inv=[action_key or torque_key])
        self.torque_key = torque_key

    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        """Leaves data as it is: the transform acts on the way in, as :meth:`inv` does."""
        return tensordict


class _Law(_Torque):
    """Makes the torque of what the policy gives instead."""

    action_key: NestedKey

    def transform_action_spec(self, action_spec: Composite) -> Composite:
        torque = action_spec[self.torque_key]
        if unravel_key(self.torque_key) != unravel_key(self.action_key):
            del action_spec[self.torque_key]
        action_spec[self.action_key] = unbounded_like(torque, torque.shape)
        return action_spec


class PDControl(_Law):
    """The action is a position target; a PD law makes a torque of it (:func:`~.functional.actuation.pd_torque`).

    Also notes the target under ``position_target``, for what corrects the torque further in.

    Args:
        kp: Stiffness [N·m/rad]. Shape (J,) or ().
        kd: Damping [N·m·s/rad]. Shape (J,) or ().
        torque_key: What the environment takes [N·m]. Shape (*B, J).
        action_key: What the policy gives instead [rad]. Shape (*B, J).
        position_key: As the encoders read it [rad].
        velocity_key: [rad/s].
        target_key: Where to note the target.
        scale_keys: Entries that multiply ``kp`` and ``kd`` where the tensordict has them, shape (*B, J) or (*B, 1):
            :class:`~.DomainRandomization` writes them.

    Example:
        >>> from torchrl_athletic.envs import TorqueEnv
        >>> from torchrl_athletic.robots import z1
        >>> from torchrl.envs import TransformedEnv
        >>> robot = z1()
        >>> env = TransformedEnv(TorqueEnv(robot, num_envs=2), PDControl(robot.kp, robot.kd))
        >>> env.action_key
        'action'
    """

    kp: Tensor
    kd: Tensor

    def __init__(
        self,
        kp: PerJoint,
        kd: PerJoint,
        *,
        torque_key: NestedKey = "torque",
        action_key: NestedKey = "action",
        position_key: NestedKey = "joint_position",
        velocity_key: NestedKey = "joint_velocity",
        target_key: NestedKey = "position_target",
        scale_keys: tuple[NestedKey, NestedKey] = ("kp_scale", "kd_scale"),
    ) -> None:
        super().__init__(torque_key, action_key)
        self.register_buffer("kp", _per_joint(kp))
        self.register_buffer("kd", _per_joint(kd))
        self.action_key, self.target_key, self.scale_keys = action_key, target_key, scale_keys
        self.position_key, self.velocity_key = position_key, velocity_key

    def _inv_call(self, tensordict: TensorDictBase) -> TensorDictBase:
        target = tensordict.get(self.action_key, None)
        if target is None:
            raise KeyError(
                f"PDControl found no {self.action_key!r}: there is no target to make a torque of. Give it data of the "
                "policy's side, not torques; on an environment, name the policy's action with action_key=..."
            )
        kp, kd = (scaled(gain, tensordict, key) for gain, key in zip((self.kp, self.kd), self.scale_keys, strict=True))
        position, velocity = (entry(self, tensordict, key) for key in (self.position_key, self.velocity_key))
        tensordict.set(self.torque_key, actuation.pd_torque(target, position, velocity, kp, kd))
        tensordict.set(self.target_key, target)
        return tensordict


class EquivalentTarget(_Law):
    r"""The action is a torque; note the position target whose PD law would command it.

    .. math:: q^* = q + (\tau + k_d \dot q) / k_p

    It takes the place of :class:`PDControl` where a robot is driven by torques, so that nets which look at errors of
    position and velocity see those that a drive with these gains would.

    Args:
        kp: Stiffness [N·m/rad]. Shape (J,) or ().
        kd: Damping [N·m·s/rad]. Shape (J,) or ().
        torque_key: What the environment takes [N·m]. Shape (*B, J).
        action_key: What the policy gives, the same torque [N·m]. Shape (*B, J).
        position_key: [rad].
        velocity_key: [rad/s].
        target_key: Where to note the target [rad].

    Raises:
        ValueError: If a stiffness is not positive: no target would command a torque.

    Example:
        >>> from tensordict import TensorDict
        >>> note = EquivalentTarget(kp=10.0, kd=2.0)
        >>> seen = TensorDict(action=[[5.0]], joint_position=[[1.0]], joint_velocity=[[0.5]], batch_size=[1])
        >>> note.inv(seen)["position_target"]
        tensor([[1.6000]])
    """

    kp: Tensor
    kd: Tensor

    def __init__(
        self,
        kp: PerJoint,
        kd: PerJoint,
        *,
        torque_key: NestedKey = "torque",
        action_key: NestedKey = "action",
        position_key: NestedKey = "joint_position",
        velocity_key: NestedKey = "joint_velocity",
        target_key: NestedKey = "position_target",
    ) -> None:
        super().__init__(torque_key, action_key)
        self.register_buffer("kp", _per_joint(kp))
        self.register_buffer("kd", _per_joint(kd))
        if not (self.kp > 0).all():
            raise ValueError(
                f"kp is {self.kp.tolist()}: with a stiffness of zero no target commands a torque, so the errors that "
                "nets look at would be infinite. Give the gains of a drive that could hold the robot."
            )
        self.action_key, self.target_key = action_key, target_key
        self.position_key, self.velocity_key = position_key, velocity_key

    def _inv_call(self, tensordict: TensorDictBase) -> TensorDictBase:
        torque = tensordict.get(self.action_key, None)
        if torque is None:
            raise KeyError(
                f"EquivalentTarget found no {self.action_key!r}: there is no torque to find a target for. Give it data "
                "of the policy's side; on an environment, name the policy's action with action_key=..."
            )
        position, velocity = (entry(self, tensordict, key) for key in (self.position_key, self.velocity_key))
        tensordict.set(self.target_key, position + (torque + self.kd * velocity) / self.kp)
        return tensordict.set(self.torque_key, torque)


class _Motors(_Torque):
    """Changes the torque as motors with limits do."""

    torque_limit: Tensor
    velocity_limit: Tensor

    def __init__(
        self, torque_limit: PerJoint, velocity_limit: PerJoint, torque_key: NestedKey, velocity_key: NestedKey
    ) -> None:
        super().__init__(torque_key)
        self.register_buffer("torque_limit", _per_joint(torque_limit))
        self.register_buffer("velocity_limit", _per_joint(velocity_limit))
        for name in ("torque_limit", "velocity_limit"):
            if not (getattr(self, name) > 0).all():
                raise ValueError(
                    f"{name} {getattr(self, name).tolist()} must be greater than zero for every joint: a motor without "
                    "torque or speed would never move. Leave joints without a limit out, or give them a large one."
                )
        self.velocity_key = velocity_key


class TorqueSpeedClip(_Motors):
    """A motor's torque falls with its speed (:func:`~.functional.actuation.clip_torque_speed`).

    Args:
        torque_limit: At standstill [N·m]. Shape (J,) or ().
        velocity_limit: Without load [rad/s]. Shape (J,) or ().
        torque_key: What is clipped [N·m]. Shape (*B, J).
        velocity_key: [rad/s]. Shape (*B, J).
        scale_key: Entry that multiplies ``torque_limit`` where the tensordict has it. Shape (*B, J) or (*B, 1).

    Source:
        Fey et al. 2025, section II-B, first constraint.

    Example:
        >>> from tensordict import TensorDict
        >>> clip = TorqueSpeedClip(torque_limit=[30.0], velocity_limit=[10.0])
        >>> clip.inv(TensorDict(torque=[[50.0]], joint_velocity=[[5.0]], batch_size=[1]))["torque"]
        tensor([[15.]])
    """

    def __init__(
        self,
        torque_limit: PerJoint,
        velocity_limit: PerJoint,
        *,
        torque_key: NestedKey = "torque",
        velocity_key: NestedKey = "joint_velocity",
        scale_key: NestedKey = "torque_limit_scale",
    ) -> None:
        super().__init__(torque_limit, velocity_limit, torque_key, velocity_key)
        self.scale_key = scale_key

    def _inv_call(self, tensordict: TensorDictBase) -> TensorDictBase:
        limit = scaled(self.torque_limit, tensordict, self.scale_key)
        torque, velocity = (entry(self, tensordict, key) for key in (self.torque_key, self.velocity_key))
        tensordict.set(self.torque_key, actuation.clip_torque_speed(torque, velocity, limit, self.velocity_limit))
        return tensordict


class OverspeedBrake(_Motors):
    """A motor brakes where something else turns it faster than it can (:func:`~.functional.actuation.brake_overspeed`).

    It belongs next to the joint, before all that makes torques in Compose. :class:`TorqueSpeedClip`, as in the paper,
    leaves such a motor without torque, so that a body which swings may whip an arm at any speed.

    Args:
        torque_limit: At standstill, of the group [N·m]. Shape (J,) or ().
        velocity_limit: Without load, of the group [rad/s]. Shape (J,) or ().
        joints: The group.
        torque_key: What is braked [N·m]. Shape (*B, J).
        velocity_key: [rad/s]. Shape (*B, J).

    Example:
        >>> from tensordict import TensorDict
        >>> brake = OverspeedBrake(torque_limit=30.0, velocity_limit=10.0, joints=[1])
        >>> brake.inv(TensorDict(torque=[[5.0, 5.0]], joint_velocity=[[15.0, 15.0]], batch_size=[1]))["torque"]
        tensor([[  5., -15.]])
    """

    def __init__(
        self,
        torque_limit: PerJoint,
        velocity_limit: PerJoint,
        joints: Joints = None,
        *,
        torque_key: NestedKey = "torque",
        velocity_key: NestedKey = "joint_velocity",
    ) -> None:
        super().__init__(torque_limit, velocity_limit, torque_key, velocity_key)
        self.joints = joints

    def _inv_call(self, tensordict: TensorDictBase) -> TensorDictBase:
        index = joint_index(self, self.joints)
        torque, velocity = tensordict.get(self.torque_key).clone(), tensordict.get(self.velocity_key)[..., index]
        torque[..., index] = actuation.brake_overspeed(
            torque[..., index], velocity, self.torque_limit, self.velocity_limit
        )
        return tensordict.set(self.torque_key, torque)


class PowerClip(_Torque):
    """Scale the torques of a group of joints so that its power stays in bounds.

    See :func:`~.functional.actuation.power_scale`.

    Args:
        max_power: Of the group, in magnitude [W].
        joints: The group.
        torque_key: What is scaled [N·m]. Shape (*B, J).
        velocity_key: [rad/s]. Shape (*B, J).

    Source:
        Fey et al. 2025, section II-B, second constraint.

    Example:
        >>> from tensordict import TensorDict
        >>> clip = PowerClip(max_power=20.0, joints=[1])
        >>> clip.inv(TensorDict(torque=[[50.0, 8.0]], joint_velocity=[[5.0, 5.0]], batch_size=[1]))["torque"]
        tensor([[50.,  4.]])
    """

    def __init__(
        self,
        max_power: float,
        joints: Joints = None,
        *,
        torque_key: NestedKey = "torque",
        velocity_key: NestedKey = "joint_velocity",
    ) -> None:
        super().__init__(torque_key)
        if not max_power > 0:
            raise ValueError(f"max_power is {max_power} W, needed is more than zero: the joints could not move.")
        self.max_power, self.joints, self.velocity_key = max_power, joints, velocity_key

    def _inv_call(self, tensordict: TensorDictBase) -> TensorDictBase:
        columns = joint_index(self, self.joints)
        torque, velocity = (entry(self, tensordict, key) for key in (self.torque_key, self.velocity_key))
        scale = actuation.power_scale(torque[..., columns], velocity[..., columns], self.max_power)
        if self.joints is None:
            return tensordict.set(self.torque_key, torque * scale)
        torque = torque.clone()
        torque[..., columns] *= scale
        return tensordict.set(self.torque_key, torque)


@dataclass(frozen=True)
class UANKeys:
    """Entries that a :class:`UANCorrection` reads and writes."""

    torque: NestedKey = "torque"
    """Torque that is corrected [N·m]. Shape (*B, J)."""
    target: NestedKey = "position_target"
    """Target that :class:`PDControl` notes [rad]. Shape (*B, J)."""
    position: NestedKey = "joint_position"
    """[rad]. Shape (*B, J)."""
    velocity: NestedKey = "joint_velocity"
    """[rad/s]. Shape (*B, J)."""
    correction: NestedKey = "torque_correction"
    """Correction, noted [N·m]. Shape (*B, J of the group)."""
    history: NestedKey = "error_history"
    """Errors, remembered. Shape (*B, J of the group, 2, length)."""
    wound: NestedKey = "wound_up"
    """How far joints have wound up, remembered. Shape (*B, J of the group, M)."""


class UANCorrection(StatefulTransform):
    r"""Add the torque that an Unsupervised Actuator Net thinks the simulation lacks.

    The net sees, for each joint alone, the position errors :math:`q^* - q` and the velocity errors :math:`-\dot q` of
    the last steps, oldest first, and gives a torque. One net serves all joints of the group. Place it further in than
    :class:`PDControl`, which notes the target, and within :class:`~.Decimation`: it runs at the physics rate.

    Args:
        net: Maps :func:`~.functional.actuation.uan_features`, (*B, J, 2 * length), to (*B, J, 1) [N·m]. Not trained
            here: it runs without gradients unless ``differentiable``.
        joints: Which it corrects.
        length: Steps that it sees, the newest included.
        scale: Unit of its output [N·m].
        state: Whether each joint is also shown positions, velocities and torques of the group, 3 J numbers more.
        memory: Ways [rad] over which each joint is shown how far it has wound up since it turned
            (:func:`~.functional.actuator_dynamics.wind_up`), a number more for each.
        timestep: Of a step at this place in the chain [s], by which a memory knows how far a joint has moved.
        differentiable: Whether gradients shall flow through the net.
        keys: Entries that it reads and writes.
        reset_key: As of :class:`StatefulTransform`.

    Source:
        Fey et al. 2025, section II-A, but for ``state`` and ``memory``.

    Example:
        >>> from torchrl_athletic.envs import TorqueEnv
        >>> from torchrl_athletic.robots import z1
        >>> from torchrl.envs import Compose, TransformedEnv
        >>> robot, net = z1(), nn.Linear(40, 1)
        >>> chain = Compose(UANCorrection(net, joints="arm"), PDControl(robot.kp, robot.kd))
        >>> env = TransformedEnv(TorqueEnv(robot, num_envs=2), chain)
        >>> env.rollout(3)["torque_correction"].shape
        torch.Size([2, 3, 6])
    """

    ways: Tensor

    def __init__(
        self,
        net: nn.Module | TensorDictModuleBase,
        joints: Joints = None,
        *,
        length: int = 20,
        scale: float = 1.0,
        state: bool = False,
        memory: Sequence[float] = (),
        timestep: float = 0.005,
        differentiable: bool = False,
        keys: UANKeys = UANKeys(),
        reset_key: NestedKey | None = None,
    ) -> None:
        super().__init__(
            in_keys=[],
            out_keys=[keys.correction, keys.history, *([keys.wound] if memory else [])],
            in_keys_inv=[keys.torque],
            out_keys_inv=[keys.torque],
            reset_key=reset_key,
        )
        self.net, self.joints, self.length = net, joints, length
        self.memory, self.timestep, self.wound_key = tuple(memory), timestep, keys.wound
        self.register_buffer("ways", torch.tensor(self.memory), persistent=False)
        self.scale, self.state, self.differentiable = scale, state, differentiable
        self.torque_key, self.target_key, self.position_key = keys.torque, keys.target, keys.position
        self.velocity_key, self.correction_key, self.history_key = keys.velocity, keys.correction, keys.history

    def _inv_call(self, tensordict: TensorDictBase) -> TensorDictBase:
        columns = joint_index(self, self.joints)
        position, velocity = tensordict.get(self.position_key), tensordict.get(self.velocity_key)
        target = tensordict.get(self.target_key, None)
        if target is None:
            raise KeyError(
                f"UANCorrection found no {self.target_key!r}: the errors that the net sees are undefined. Put "
                "PDControl after it in Compose, so that the action passes it first."
            )
        position, velocity = position[..., columns], velocity[..., columns]
        error = torch.stack((target[..., columns] - position, -velocity), -1)
        errors = tensordict.get(self.history_key, None)
        if errors is None:
            raise _nothing_remembered(self, self.history_key)
        errors, torque = history.push(errors, error, dim=-1), tensordict.get(self.torque_key)
        group = (position, velocity, torque[..., columns]) if self.state else ()
        wound = None
        if self.memory:
            moved = self.timestep * velocity.unsqueeze(-1)
            wound = actuator_dynamics.wind_up(tensordict.get(self.wound_key), moved, self.ways)
        with torch.set_grad_enabled(self.differentiable and torch.is_grad_enabled()):
            correction = self.scale * self.net(actuation.uan_features(errors, *group, wound=wound)).squeeze(-1)
        if self.joints is None:
            torque = torque + correction
        else:
            torque = torque.clone()
            torque[..., columns] += correction
        tensordict.set(self.torque_key, torque)
        if wound is not None:
            tensordict.set(self.wound_key, wound)
        tensordict.set(self.correction_key, correction)
        return tensordict.set(self.history_key, errors)

    def initial(self, tensordict_reset: TensorDictBase) -> Mapping[NestedKey, Tensor]:
        position = tensordict_reset.get(self.position_key)[..., joint_index(self, self.joints)]
        shapes = self._shapes(position.shape)
        return {key: position.new_zeros(shape) for key, shape in shapes.items()}  # as if it had rested at its target

    def advance(self, tensordict: TensorDictBase, next_tensordict: TensorDictBase) -> None:
        for key in self.out_keys:
            next_tensordict.set(key, tensordict.get(key))

    def state_spec(self, observation_spec: Composite) -> Mapping[NestedKey, TensorSpec]:
        position = observation_spec[self.position_key]
        shape = position.zero()[..., joint_index(self, self.joints)].shape
        return {key: unbounded_like(position, size) for key, size in self._shapes(shape).items()}

    def _shapes(self, joints: Sequence[int]) -> dict[NestedKey, tuple[int, ...]]:
        """Shapes of what it notes, for joints of a shape."""
        shapes = {self.correction_key: tuple(joints), self.history_key: (*joints, 2, self.length)}
        return shapes | ({self.wound_key: (*joints, len(self.memory))} if self.memory else {})


class ActionDelay(RandomTransform):
    """The action arrives late, by a number of steps that is drawn when an episode starts.

    Within :class:`~.Decimation` a step is a physics step. Until the first action of an episode can have arrived, what
    acts is ``before``.

    Args:
        max_steps: Greatest delay; 0 to ``max_steps`` are equally likely.
        min_steps: Least delay.
        before: What was commanded before the episode, shape (D,); None holds the first action from the start.
        action_key: What is delayed. Shape (*B, D).
        delay_key: Where the delay is noted [steps]. int64, shape (*B, 1).
        queue_key: Where actions on their way are kept. Shape (*B, max_steps + 1, D).
        seed: Of the draws.
        first_row: As of :class:`RandomTransform`.
        reset_key: As of :class:`StatefulTransform`.

    Source:
        Fey et al. 2025, table II: policy lag of 0 to 6 steps of 5 ms.

    Example:
        >>> from torchrl.envs import GymEnv, TransformedEnv
        >>> env = TransformedEnv(GymEnv("Pendulum-v1"), ActionDelay(max_steps=2, before=[0.0]))
        >>> env.rollout(3)["action_queue"].shape
        torch.Size([3, 3, 1])
    """

    before: Tensor | None

    def __init__(
        self,
        max_steps: int = 6,
        min_steps: int = 0,
        *,
        before: PerJoint | None = None,
        action_key: NestedKey = "action",
        delay_key: NestedKey = "action_delay",
        queue_key: NestedKey = "action_queue",
        seed: int = 0,
        first_row: int = 0,
        reset_key: NestedKey | None = None,
    ) -> None:
        if not 0 <= min_steps <= max_steps:
            raise ValueError(f"a delay of {min_steps} to {max_steps} steps is none: give 0 <= min_steps <= max_steps.")
        age_key = (*queue_key[:-1], f"{queue_key[-1]}_age") if isinstance(queue_key, tuple) else f"{queue_key}_age"
        self.age_key = age_key if before is None else None  # with something to act before, age makes no difference
        super().__init__(
            in_keys=[],
            out_keys=[delay_key, queue_key] if self.age_key is None else [delay_key, queue_key, self.age_key],
            in_keys_inv=[action_key],
            out_keys_inv=[action_key],
            seed=seed,
            first_row=first_row,
            reset_key=reset_key,
        )
        self.min_steps, self.max_steps = min_steps, max_steps
        self.action_key, self.delay_key, self.queue_key = action_key, delay_key, queue_key
        self.register_buffer("before", None if before is None else _per_joint(before))

    def _inv_call(self, tensordict: TensorDictBase) -> TensorDictBase:
        queue = tensordict.get(self.queue_key, None)
        if queue is None:
            raise _nothing_remembered(self, self.queue_key)
        if self.parent is None:  # on its way into a buffer: delayed already
            return tensordict
        queue = history.push(queue, tensordict.get(self.action_key))
        steps = tensordict.get(self.delay_key)
        if self.age_key is not None:
            age = tensordict.get(self.age_key)
            tensordict.set(self.age_key, torch.clamp(age + 1, max=self.max_steps))
            steps = torch.minimum(steps, age)
        tensordict.set(self.action_key, history.look_back(queue, steps))
        return tensordict.set(self.queue_key, queue)

    def draw(self, key: Tensor, tensordict_reset: TensorDictBase) -> Mapping[NestedKey, Tensor]:
        action = self._action_spec()
        size = (*key.shape, action.shape[-1])
        if self.before is None:
            before = torch.zeros(size, dtype=action.dtype, device=key.device)
        else:
            before = self.before.to(action.dtype).expand(size)
        steps = self.min_steps + streams.integers(key, 1, self.max_steps - self.min_steps + 1)
        queue = history.tile(before, self.max_steps + 1)
        first: dict[NestedKey, Tensor] = {self.delay_key: steps, self.queue_key: queue}
        return first if self.age_key is None else first | {self.age_key: torch.zeros_like(steps)}

    def advance(self, tensordict: TensorDictBase, next_tensordict: TensorDictBase) -> None:
        for key in self.out_keys:
            next_tensordict.set(key, tensordict.get(key))

    def state_spec(self, observation_spec: Composite) -> Mapping[NestedKey, TensorSpec]:
        action = self._action_spec()
        steps = Unbounded(shape=(*action.shape[:-1], 1), dtype=torch.int64, device=action.device)
        queue = (*action.shape[:-1], self.max_steps + 1, action.shape[-1])
        specs: dict[NestedKey, TensorSpec] = {self.delay_key: steps, self.queue_key: unbounded_like(action, queue)}
        return specs if self.age_key is None else specs | {self.age_key: steps.clone()}

    def _action_spec(self) -> TensorSpec:
        return full_action_spec(self)[self.action_key]


def _nothing_remembered(transform: Transform, key: NestedKey) -> KeyError:
    return KeyError(
        f"{type(transform).__name__} found no {key!r}, its memory: what a step does depends on those before. Put it on "
        "an environment and reset that first; a buffer of data that were collected so does not need it."
    )


def entry(transform: Transform, tensordict: TensorDictBase, key: NestedKey) -> Tensor:
    """What a law reads.

    Raises:
        KeyError: If it is not there.
    """
    value = tensordict.get(key, None)
    if value is None:
        raise KeyError(
            f"{type(transform).__name__} found no {key!r} among {sorted(map(str, tensordict.keys(True, True)))}. Give "
            "it data that hold it, or name the entry with the transform's ..._key argument."
        )
    return value


def _per_joint(value: PerJoint) -> Tensor:
    return torch.as_tensor(value, dtype=torch.float32).clone()


def scaled(value: Tensor, tensordict: TensorDictBase, key: NestedKey) -> Tensor:
    """The value, times the entry of the key where the tensordict has it."""
    scale = tensordict.get(key, None)
    return value if scale is None else value * scale
