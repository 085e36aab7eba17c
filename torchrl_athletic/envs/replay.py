"""Replaying what a real robot did, for a net to learn what the simulation lacks: the UAN's training environment."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any, Literal

import torch
from tensordict import NestedKey, TensorDict, TensorDictBase
from torch import Tensor
from torchrl.data import Composite, TensorSpec, Unbounded
from torchrl.envs import Compose, Transform, TransformedEnv

from torchrl_athletic.envs.torque_env import TorqueEnv
from torchrl_athletic.functional import actuation, actuator_dynamics, history, rewards, streams
from torchrl_athletic.physics.joints import joint_columns
from torchrl_athletic.robots import Robot
from torchrl_athletic.transforms import CorrectedActuation, EquivalentTarget, PDControl, TorqueSpeedClip, UANCorrection
from torchrl_athletic.transforms.simulated import once_per_model, simulated_env
from torchrl_athletic.transforms.stateful import Joints, RandomTransform, joint_index

HISTORY = 20
"""Physics steps of 5 ms that a UAN looks back: 100 ms."""
WARM_UP = 40
"""Recorded steps before a start that delays and lags of the chain are filled with."""
Driven = Literal["position", "torque"]
"""What the robot was told: targets of its PD controllers, or torques."""


@dataclass(frozen=True, eq=False)
class Takes:
    """Takes of a real robot, one after the other, on the grid of the physics.

    S samples of all takes, J joints in the robot's order. ``command[k]`` acts from ``position[k]`` on.

    Raises:
        ValueError: If shapes or lengths contradict each other, a number is not finite, or no take is longer than the
            net's history.

    Example:
        >>> still = torch.zeros(200, 7)
        >>> Takes(still, still, still, lengths=(120, 80), driven="position").starts().numel()
        160
    """

    position: Tensor
    """Measured [rad]. Shape (S, J)."""
    velocity: Tensor
    """Measured [rad/s]. Shape (S, J)."""
    command: Tensor
    """Position target [rad] or torque [N·m]. Shape (S, J)."""
    lengths: tuple[int, ...]
    """Samples of each take; their sum is S."""
    driven: Driven = "position"

    def __post_init__(self) -> None:
        shapes = {tuple(value.shape) for value in (self.position, self.velocity, self.command)}
        if len(shapes) != 1 or self.position.ndim != 2 or sum(self.lengths) != len(self.position):
            raise ValueError(
                f"takes have shapes {sorted(shapes)} and lengths {self.lengths}, needed are position, velocity and "
                "command of one shape (S, J), S being the sum of the lengths: else takes would run into each other."
            )
        if not all(bool(value.isfinite().all()) for value in (self.position, self.velocity, self.command)):
            raise ValueError("a take holds numbers that are not finite: rows would start there. Cut them out.")
        if max(self.lengths) <= HISTORY:
            raise ValueError(
                f"the longest take has {max(self.lengths)} samples, but a start needs {HISTORY} to fill the net's "
                f"history and one more to go to: give takes of {HISTORY + 1} samples or more."
            )

    def starts(self, room: int = 1) -> Tensor:
        """Samples that an episode may start at: with a whole history behind, and ``room`` steps before the take's end.

        int64, shape (M,).
        """
        begin, found = 0, []
        for length in self.lengths:
            found.append(torch.arange(begin + HISTORY - 1, begin + max(length - room, HISTORY - 1)))
            begin += length
        return torch.cat(found)

    def ends(self) -> Tensor:
        """The last sample of each sample's take. int64, shape (S,)."""
        lengths = torch.tensor(self.lengths)
        return (lengths.cumsum(0) - 1).repeat_interleave(lengths)


class AddedTorque(Transform):
    """Add what the policy gives to the torque of some joints, at the place in the chain where a UAN stands.

    Args:
        joints: Which.
        unit: Of the correction [N·m]. Shape () or (J of the group,).
        torque_key: [N·m]. Shape (*B, J).
        correction_key: In units. Shape (*B, J of the group).

    Example:
        >>> add = AddedTorque(joints=[1])
        >>> step = TensorDict(torque=[[1.0, 2.0]], torque_correction=[[0.5]], batch_size=[1])
        >>> add.inv(step)["torque"]
        tensor([[1.0000, 2.5000]])
    """

    unit: Tensor

    def __init__(
        self,
        joints: Joints = None,
        unit: Tensor | float = 1.0,
        *,
        torque_key: NestedKey = "torque",
        correction_key: NestedKey = "torque_correction",
    ) -> None:
        super().__init__(in_keys=[], out_keys=[], in_keys_inv=[torque_key], out_keys_inv=[torque_key])
        self.register_buffer("unit", torch.as_tensor(unit, dtype=torch.float32).clone())
        self.joints, self.torque_key, self.correction_key = joints, torque_key, correction_key

    def _inv_call(self, tensordict: TensorDictBase) -> TensorDictBase:
        torque, correction = tensordict.get(self.torque_key), tensordict.get(self.correction_key)
        added = torch.zeros_like(torque)
        added[..., joint_index(self, self.joints)] = self.unit * correction
        return tensordict.set(self.torque_key, torque + added)


@dataclass(frozen=True, eq=False)
class _Past:
    """The past of every sample of takes, S of them."""

    error: Tensor
    """Errors of position [rad] and velocity [rad/s] that the chain notes on the recorded states. Shape (S, J, 2)."""
    torque: Tensor
    """Torque that the motors gave [N·m]. Shape (S, J)."""
    wound: Tensor
    """How far joints have wound up since they turned [1]. Shape (S, J, M)."""
    memory: Mapping[NestedKey, Tensor]
    """What the chain remembers of the steps before. Shape (S, ...) each."""


@dataclass(frozen=True, eq=False)
class _Start:
    """The model's start state and where the joints are in it, on its device."""

    qpos: Tensor
    qvel: Tensor
    joint_qpos: Any
    joint_dof: Any


class ReplayTakes(RandomTransform):
    r"""Start at a moment of a take and send the commands that followed; the action is a torque for what is missing.

    An episode starts at a sample drawn uniformly of all that have a whole history behind them, with the measured
    position and velocity as state. It is truncated after ``max_steps`` steps or where the take ends. Rows whose
    simulation diverges, or leaves the recording by more than ``bound``, are terminated with the reward ``penalty``.

    Place it last in Compose, outside the controller's law. Entries, A joints of the group, float32:

    - ``action`` (N, A): the corrective torques, in units of :class:`AddedTorque`;
    - ``observation`` (N, A, 2L): for each joint the position errors [rad] and then the velocity errors [rad/s] of the
      last L steps, oldest first, of the simulated state, before an episode's start of the recorded one; with ``state``
      (N, A, 2L + 3A), positions, velocities and torques of all joints behind them; then ``wound_up`` (N, A, M), for the
      M ways of ``memory``. They are what a
      :class:`~torchrl_athletic.transforms.UANCorrection` in the same place sees, since the chain itself is asked for
      the targets and the torques that it is about to note: limited, late, or whatever it makes of a command;
    - ``privileged`` (N, A, 2): simulated minus measured position and velocity, for a critic;
    - ``reward``: :func:`~torchrl_athletic.functional.rewards.uan_reward` of all joints of the group, times the time
      step as Isaac's reward manager does it, so that values stay near ten; and under ``joint_reward`` (N, A) that of
      each joint alone;
    - ``sample``, ``steps_left`` (N, 1) int64: where in the takes the row is, and how long its episode has to go.

    Args:
        takes: What to replay.
        joints: Which are corrected and compared.
        chain: What stands between the command and the net, from the joints outwards; the very transforms that act.
        max_steps: Longest episode [steps].
        by_row: Start row i at entry i of ``starts``, modulo its length, in each episode.
        starts: Samples to start at. Shape (M,). None takes all that are possible.
        bound: Greatest difference of a joint's position from the recording [rad].
        penalty: Reward of a terminated step.
        state: Whether each joint is shown the state of the group.
        memory: Ways [rad] over which each joint is shown how far it has wound up since it turned.
        seed: Of the draws.
        first_row: As of :class:`~torchrl_athletic.transforms.RandomTransform`.

    Source:
        Fey et al. 2025, section II-A, "Task Design".
    """

    position: Tensor
    velocity: Tensor
    command: Tensor
    ends: Tensor
    starts: Tensor
    ways: Tensor
    lookback: Tensor

    def __init__(
        self,
        takes: Takes,
        robot: Robot,
        joints: Joints = None,
        *,
        chain: Sequence[Transform],
        max_steps: int = 4000,
        by_row: bool = False,
        starts: Tensor | None = None,
        bound: float = 1.5,
        penalty: float = -10.0,
        state: bool = False,
        memory: Sequence[float] = (),
        seed: int = 0,
        first_row: int = 0,
    ) -> None:
        super().__init__(
            ["joint_position", "joint_velocity"],
            ["sample", "steps_left", "observation", "privileged", "torque_correction", "joint_reward", "wound_up"],
            in_keys_inv=["action"],
            out_keys_inv=["action"],
            seed=seed,
            first_row=first_row,
        )
        if takes.position.shape[1] != len(robot.joint_names):
            raise ValueError(
                f"the takes have {takes.position.shape[1]} joints, {robot.name!r} has {len(robot.joint_names)}: order "
                "and fill their columns as robot.joint_names says (training.takes_of does)."
            )
        self.joints, self.max_steps, self.by_row = joints, max_steps, by_row
        self.bound, self.penalty, self.chain, self.state = bound, penalty, tuple(chain), state
        self.dt = float(robot.model().opt.timestep)
        starts = takes.starts() if starts is None else starts
        if not len(starts):
            raise ValueError("no take is long enough to start in. Give takes of more than 20 samples.")
        tables = {
            "position": takes.position.float(),
            "velocity": takes.velocity.float(),
            "command": takes.command.float(),
            "ends": takes.ends(),
            "starts": starts.to(torch.int64),
            "lookback": torch.arange(1 - HISTORY, 1),
            "ways": torch.tensor(tuple(memory)),
        }
        for name, table in tables.items():
            self.register_buffer(name, table.clone())

    def _noted(self, seen: TensorDictBase) -> tuple[Tensor, Tensor]:
        """Errors of position [rad] and velocity [rad/s] that the chain is about to note, and the torques [N·m].

        Args:
            seen: Joints as read, the command under ``action``, and what the chain remembers; left as it is.

        Returns:
            Shapes (*B, J, 2), (*B, J).
        """
        acted = _through(self.chain, seen.copy())
        error = acted.get("position_target") - seen.get("joint_position")
        return torch.stack((error, -seen.get("joint_velocity")), -1), acted.get("torque")

    @torch.no_grad()
    def _past(self) -> _Past:
        """Find the past of every sample, by playing the recorded steps before it through the chain.

        What came before a take's first sample is not known: commands, torques and velocities count as those of that
        sample, as in rollouts that are scored. So a joint that moves as the take begins has wound up that way.
        """
        laws = [law for law in self.chain if isinstance(law, CorrectedActuation)]
        memory = [key for law in laws for key in law.memory]
        samples = torch.arange(len(self.position), device=self.position.device)
        first = samples == torch.cat((-torch.ones_like(samples[:1]), self.ends[:-1])) + 1
        begin = torch.where(first, samples, 0).cummax(0).values  # of each sample's take
        seen = TensorDict({"joint_position": self.position}, [len(samples)], device=samples.device)
        for law in laws:
            seen.update(dict(law.initial(seen)))
        for back in range(WARM_UP if memory else 0, -1, -1):
            at = torch.maximum(samples - back, begin)
            seen.set("joint_position", self.position[at]).set("joint_velocity", self.velocity[at])
            seen.set("action", self.command[at])
            if back:
                seen = _through(self.chain, seen)
        wound = self.position.new_zeros(*self.position.shape, len(self.ways))
        for back in range(WARM_UP - 1 if len(self.ways) else -1, -1, -1):
            wound = self._wound_further(wound, self.velocity[torch.maximum(samples - back, begin)])
        error, torque = self._noted(seen)
        return _Past(error, torque, wound, {key: seen.get(key).clone() for key in memory})

    def _wound_further(self, wound: Tensor, velocity: Tensor) -> Tensor:
        """Wind up by a step at a velocity. Shapes (*B, J, M), (*B, J)."""
        return actuator_dynamics.wind_up(wound, self.dt * velocity.unsqueeze(-1), self.ways)

    def _known(self, env: Any) -> tuple[_Start, _Past]:
        """What stays the same from episode to episode."""
        return _start_of(env), self._past()

    def _inv_call(self, tensordict: TensorDictBase) -> TensorDictBase:
        if self.parent is None:  # on its way into a buffer
            return tensordict
        tensordict.set("previous_correction", tensordict.get("torque_correction"))
        tensordict.set("torque_correction", tensordict.get("action"))
        return tensordict.set("action", self.command[tensordict.get("sample").squeeze(-1)])

    def _reset_env_preprocess(self, tensordict: TensorDictBase | None) -> TensorDictBase:
        env, (model, _) = simulated_env(self), once_per_model(self, self._known)
        if tensordict is None:
            tensordict = TensorDict(batch_size=env.batch_size, device=env.device)
        sample = self._draw_start(self.upcoming(tensordict))
        qpos = model.qpos.expand(*env.batch_size, -1).clone()
        qvel = model.qvel.expand(*env.batch_size, -1).clone()
        read, rate = self.position[sample], self.velocity[sample]
        for law in self.chain:
            if isinstance(law, CorrectedActuation):  # whose encoders read that
                read, rate = (read - law.encoder_offset) / law.encoder_scale, rate / law.encoder_scale
        qpos[:, model.joint_qpos], qvel[:, model.joint_dof] = read.to(qpos), rate.to(qvel)
        return tensordict.set("reset_qpos", qpos).set("reset_qvel", qvel)

    def _draw_start(self, key: Tensor) -> Tensor:
        """int64, shape (N,)."""
        if self.by_row:
            row = torch.arange(key.numel(), device=key.device) + self.first_row
            return self.starts[row % len(self.starts)]
        return self.starts[streams.integers(key, 1, len(self.starts)).squeeze(-1)]

    def draw(self, key: Tensor, tensordict_reset: TensorDictBase) -> Mapping[NestedKey, Tensor]:
        sample, (_, past) = self._draw_start(key), once_per_model(self, self._known)
        columns = joint_index(self, self.joints)
        errors = past.error[sample.unsqueeze(-1) + self.lookback][:, :, columns]  # (N, L, A, 2)
        state = self.position[sample], self.velocity[sample], past.torque[sample]
        wound = past.wound[sample][:, columns]
        left = (self.ends[sample] - sample).clamp(max=self.max_steps)
        return {
            "sample": sample.unsqueeze(-1),
            "steps_left": left.unsqueeze(-1),
            "observation": self._shown(errors.permute(0, 2, 3, 1), wound, *state),
            "wound_up": wound,
            "privileged": errors.new_zeros(*errors.shape[::2], 2),
            "torque_correction": errors.new_zeros(errors.shape[::2]),
            "joint_reward": errors.new_zeros(errors.shape[::2]),
            **{name: value[sample] for name, value in past.memory.items()},
        }

    def _shown(self, errors: Tensor, wound: Tensor, *group: Tensor) -> Tensor:
        """Errors (N, A, 2, L), ways (N, A, M), and values of all joints (N, J) each, as a net sees them."""
        columns = joint_index(self, self.joints)
        return actuation.uan_features(errors, *(value[:, columns] for value in group if self.state), wound=wound)

    def advance(self, tensordict: TensorDictBase, next_tensordict: TensorDictBase) -> None:
        columns = joint_index(self, self.joints)
        sample, left = tensordict.get("sample") + 1, tensordict.get("steps_left") - 1
        at = sample.squeeze(-1)
        real, real_speed = self.position[at], self.velocity[at]
        position, speed = next_tensordict.get("joint_position"), next_tensordict.get("joint_velocity")
        near = ((position - real).abs() < self.bound).all(-1, keepdim=True)  # false of what is not a number
        failed = next_tensordict.get("terminated") | ~near | ~speed.isfinite().all(-1, keepdim=True)
        position, speed = torch.where(failed, real, position), torch.where(failed, real_speed, speed)

        _, past = once_per_model(self, self._known)
        seen = next_tensordict.copy().set("joint_position", position).set("joint_velocity", speed)
        errors, torque = self._noted(seen.set("action", self.command[at]))
        errors = torch.where(failed.unsqueeze(-1), past.error[at], errors)[:, columns]
        torque = torch.where(failed, past.torque[at], torque)
        observation = tensordict.get("observation")[..., : 2 * HISTORY].unflatten(-1, (2, HISTORY))
        wound = self._wound_further(tensordict.get("wound_up"), speed[:, columns])
        observation = self._shown(history.push(observation, errors, dim=-1), wound, position, speed, torque)
        correction, previous = tensordict.get("torque_correction"), tensordict.get("previous_correction")
        position, real = position[:, columns], real[:, columns]
        reward = self.dt * rewards.uan_reward(position, real, correction, previous)
        each = (value.unsqueeze(-1) for value in (position, real, correction, previous))
        joint_reward = self.dt * rewards.uan_reward(*each).squeeze(-1)
        truncated = left <= 0
        shown = {
            "sample": sample,
            "steps_left": left,
            "observation": observation,
            "wound_up": wound,
            "privileged": torch.stack((position - real, (speed - real_speed)[:, columns]), -1),
            "torque_correction": correction,
            "reward": torch.where(failed, self.penalty, reward),
            "joint_reward": torch.where(failed, self.penalty, joint_reward),
            "terminated": failed,
            "truncated": truncated,
            "done": failed | truncated,
        }
        for key, value in shown.items():
            next_tensordict.set(key, value)

    def state_spec(self, observation_spec: Composite) -> Mapping[NestedKey, TensorSpec]:
        position = observation_spec["joint_position"]
        rows, joints = position.zero()[..., joint_index(self, self.joints)].shape
        counter = Unbounded(shape=(rows, 1), dtype=torch.int64, device=position.device)
        features = 2 * HISTORY + 3 * joints * self.state + len(self.ways)
        sizes: dict[NestedKey, tuple[int, ...]] = {"observation": (joints, features), "privileged": (joints, 2)}
        sizes |= {"wound_up": (joints, len(self.ways)), "torque_correction": (joints,), "joint_reward": (joints,)}
        return {"sample": counter, "steps_left": counter.clone()} | {
            key: Unbounded(shape=(rows, *size), device=position.device) for key, size in sizes.items()
        }

    def transform_input_spec(self, input_spec: Composite) -> Composite:
        input_spec = super().transform_input_spec(input_spec)
        correction = input_spec["full_state_spec"]["torque_correction"]
        input_spec["full_action_spec"]["action"] = correction.clone()
        return input_spec


def _start_of(env: Any) -> _Start:
    physics, robot = env.physics, env.robot
    model = physics.model
    place, dof = (
        columns.to(physics.device) if isinstance(columns, Tensor) else columns
        for columns in joint_columns(model, robot.joint_names)
    )
    key = model.key(robot.keyframe)
    qpos, qvel = (torch.tensor(value, dtype=physics.dtype, device=physics.device) for value in (key.qpos, key.qvel))
    return _Start(qpos, qvel, place, dof)


def _through(chain: Sequence[Transform], tensordict: TensorDictBase) -> TensorDictBase:
    """A command on its way in: the outermost transform comes first."""
    for transform in reversed(chain):
        tensordict = transform._inv_call(tensordict)
    return tensordict


def replay_env(
    robot: Robot,
    takes: Takes,
    *,
    chain: Sequence[Transform] | None = None,
    joints: Joints = None,
    unit: Tensor | float = 1.0,
    num_envs: int = 1,
    device: torch.device | str = "cpu",
    base: TorqueEnv | None = None,
    max_steps: int = 4000,
    by_row: bool = False,
    starts: Tensor | None = None,
    seed: int = 0,
) -> TransformedEnv:
    """The environment that a UAN is trained in: a step is one of the physics, and the action what the torque lacks.

    The correction acts where the chain holds a :class:`~torchrl_athletic.transforms.UANCorrection`, whose place it
    takes, else nearest to the joint: friction and inertia know no limits of a motor, and a net that is cut off where
    the motor saturates neither acts nor learns there.

    Args:
        robot: To be corrected; its gains are those of the takes.
        takes: What the real one did.
        chain: What stands between a command and the joints of a policy's environment, from the joints outwards, without
            decimation; None takes the motor's limit by speed and the PD law of the robot. What a diagnosis found comes
            in here.
        joints: Which are corrected and compared; None takes the group ``"arm"``, or all joints of a robot without one.
        unit: Of the action [N·m], for each joint where they differ. Shape () or (A,).
        num_envs: N.
        device: Of the physics.
        base: In place of one made here.
        max_steps: Longest episode [steps]; 20 s by default.
        by_row: As of :class:`ReplayTakes`.
        starts: As of :class:`ReplayTakes`.
        seed: Of the starts.

    Source:
        Fey et al. 2025, section II-A and table of UAN rewards, https://arxiv.org/abs/2502.10894.

    Example:
        >>> from torchrl_athletic.robots import z1
        >>> robot = z1()
        >>> still = torch.tensor(robot.default_pose).repeat(100, 1)
        >>> env = replay_env(robot, Takes(still, 0 * still, still, lengths=(100,)), num_envs=2)
        >>> env.rollout(3)["observation"].shape
        torch.Size([2, 3, 6, 40])
    """
    if joints is None and "arm" in robot.joint_groups:
        joints = "arm"
    chain = list(_plain_chain(robot, takes.driven) if chain is None else chain)
    base = base or TorqueEnv(replace(robot, sensors={}), num_envs=num_envs, device=device)
    place = next((k for k, item in enumerate(chain) if isinstance(item, UANCorrection)), None)
    inner, outer = ([], chain) if place is None else (chain[:place], chain[place + 1 :])
    replayed = ReplayTakes(
        takes,
        robot,
        joints,
        chain=outer,
        max_steps=max_steps,
        by_row=by_row,
        starts=starts,
        state=place is not None and chain[place].state,
        memory=() if place is None else chain[place].memory,
        seed=seed,
    )
    return TransformedEnv(base, Compose(*inner, AddedTorque(joints, unit), *outer, replayed))


def _plain_chain(robot: Robot, driven: Driven) -> list[Transform]:
    law = PDControl(robot.kp, robot.kd) if driven == "position" else EquivalentTarget(robot.kp, robot.kd)
    return [TorqueSpeedClip(robot.torque_limit, robot.velocity_limit), law]
