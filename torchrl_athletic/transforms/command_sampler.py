"""Random commands for the pre-training of a whole-body controller."""

from __future__ import annotations

from collections.abc import Mapping

import torch
from tensordict import NestedKey, TensorDictBase
from torch import Tensor
from torchrl.data import Composite, TensorSpec, Unbounded

from torchrl_athletic.functional import commands, rotations, streams
from torchrl_athletic.functional.commands import VELOCITY, CommandRanges
from torchrl_athletic.transforms.stateful import RandomTransform

Pose = tuple[NestedKey, NestedKey]
"""Keys of a position (*B, 3) [m] and a quaternion (*B, 4), wxyz, both in the world."""


class CommandSampler(RandomTransform):
    """Command a velocity of the base and a pose of the end effector: new goals now and then, and a smooth way there.

    An episode starts from rest and from the pose that the end effector has; its first goal is set at once. The way from
    one command to the next goal leads around the shoulder (:func:`~.functional.commands.blend_goals`). Poses are given
    in a frame that follows the base's place and heading at a fixed height above the ground.

    Args:
        ranges: What is drawn, and when.
        dt: Of a step at this place in the chain [s]: the policy's, if it stands outside :class:`~.Decimation`.
        base_keys: Pose of the base; None has it rest at the world's origin, as an arm's does.
        height_key: Height of the base over the ground [m], shape (*B, 1), where the environment shows it: the ground
            is that much below the base. Else it is at z = 0.
        end_effector_keys: Pose of the end effector; None starts from the middle of the ranges.
        velocity_key: Where to command: forward, lateral [m/s], yaw rate [rad/s]. Shape (*B, 3).
        pose_key: Where to command: position [m] and the first two columns of the rotation matrix. Shape (*B, 9).
            :func:`~.functional.commands.pose_to_world` says where that is.
        memory_key: Goals and times are remembered under this name with endings. Shapes (*B, 10), (*B, 2) and (*B, 1).
        seed: Of the draws.
        first_row: As of :class:`RandomTransform`.
        reset_key: As of :class:`StatefulTransform`.

    Raises:
        ValueError: If ``ranges.straighten`` is asked for without ``base_keys``.
        KeyError: If the environment does not show a pose that is named.

    Source:
        Fey et al. 2025, section II-B, after Fu et al. 2023 (Deep Whole-Body Control).

    Example:
        >>> from torchrl.envs import GymEnv, TransformedEnv
        >>> sampler = CommandSampler(CommandRanges(), dt=0.05, base_keys=None, end_effector_keys=None)
        >>> env = TransformedEnv(GymEnv("Pendulum-v1"), sampler)
        >>> rollout = env.rollout(3)
        >>> rollout["base_velocity_command"][0].tolist(), rollout["end_effector_command"].shape
        ([0.0, 0.0, 0.0], torch.Size([3, 9]))
    """

    bounds: Tensor
    centre: Tensor
    shoulder: Tensor

    def __init__(
        self,
        ranges: CommandRanges,
        dt: float,
        *,
        base_keys: Pose | None = ("base_position", "base_quaternion"),
        height_key: NestedKey = "base_height",
        end_effector_keys: Pose | None = ("end_effector_position", "end_effector_quaternion"),
        velocity_key: NestedKey = "base_velocity_command",
        pose_key: NestedKey = "end_effector_command",
        memory_key: NestedKey = "command",
        seed: int = 0,
        first_row: int = 0,
        reset_key: NestedKey | None = None,
    ) -> None:
        if not dt > 0:
            raise ValueError(f"dt is {dt} s, needed is more than 0: the first goal would never be reached.")
        if ranges.straighten and base_keys is None:
            raise ValueError("straighten leads the base back to a line, but base_keys is None: name the base's pose.")
        names = ("start", "goal", "duration", "stream", "step") + (("line",) if ranges.straighten else ())
        memory_keys = {name: _with_ending(memory_key, name) for name in names}
        super().__init__(
            [], [velocity_key, pose_key, *memory_keys.values()], seed=seed, first_row=first_row, reset_key=reset_key
        )
        self.ranges, self.dt, self.keys = ranges, dt, memory_keys
        self.base_keys, self.height_key, self.end_effector_keys = base_keys, height_key, end_effector_keys
        self.velocity_key, self.pose_key = velocity_key, pose_key
        self.interval_steps = max(1, round(ranges.interval / dt))
        self.register_buffer("bounds", ranges.bounds(), persistent=False)
        self.register_buffer("centre", ranges.centre(), persistent=False)
        self.register_buffer("shoulder", torch.tensor(ranges.shoulder), persistent=False)

    def draw(self, key: Tensor, tensordict_reset: TensorDictBase) -> Mapping[NestedKey, Tensor]:
        start = self._present(key, tensordict_reset)
        goal, duration = self._goal(key)
        step = torch.zeros_like(key).unsqueeze(-1)
        memory = {"start": start, "goal": goal, "duration": duration, "stream": key.unsqueeze(-1), "step": step}
        if self.ranges.straighten:
            memory["line"] = commands.line_ahead(*self._base(tensordict_reset))
        return self._entries(memory, start, tensordict_reset)

    def advance(self, tensordict: TensorDictBase, next_tensordict: TensorDictBase) -> None:
        memory = {name: tensordict.get(key) for name, key in self.keys.items()}
        memory["step"] = memory["step"] + 1
        command = self._blend(memory)
        due = memory["step"] >= self.interval_steps
        if torch.compiler.is_compiling() or due.device.type != "cpu" or due.any():  # a look costs a GPU a stop
            memory |= self._renewed(memory, command, due)
        for key, value in self._entries(memory, command, next_tensordict).items():
            next_tensordict.set(key, value)

    def state_spec(self, observation_spec: Composite) -> Mapping[NestedKey, TensorSpec]:
        batch, device = observation_spec.shape, observation_spec.device
        widths = {"start": 10, "goal": 10, "duration": 2, "stream": 1, "step": 1, "line": 3}
        whole = {"stream", "step"}
        dtypes = {name: torch.int64 if name in whole else torch.float32 for name in self.keys}
        return {
            self.velocity_key: Unbounded((*batch, 3), device=device),
            self.pose_key: Unbounded((*batch, 9), device=device),
            **{
                key: Unbounded((*batch, widths[name]), dtype=dtypes[name], device=device)
                for name, key in self.keys.items()
            },
        }

    def _goal(self, key: Tensor) -> tuple[Tensor, Tensor]:
        box_from = self.shoulder if self.ranges.box else None
        return commands.draw_goal(key, self.bounds, self.ranges.standstill_probability, box_from)

    def _blend(self, memory: dict[str, Tensor]) -> Tensor:
        elapsed = memory["step"] * self.dt
        return commands.blend_goals(memory["start"], memory["goal"], elapsed, memory["duration"])

    def _renewed(self, memory: dict[str, Tensor], command: Tensor, due: Tensor) -> dict[str, Tensor]:
        """New goals for the rows that are due, to be reached from what they are told now."""
        key = streams.advance(memory["stream"])
        goal, duration = self._goal(key.squeeze(-1))
        new = {"start": command, "goal": goal, "duration": duration, "stream": key, "step": torch.zeros_like(key)}
        return {name: torch.where(due, value, memory[name]) for name, value in new.items()}

    def _entries(self, memory: dict[str, Tensor], command: Tensor, shown: TensorDictBase) -> dict[NestedKey, Tensor]:
        velocity = command[..., VELOCITY]
        if self.ranges.straighten:
            lateral, heading = commands.deviation_from_line(memory["line"], *self._base(shown))
            velocity = commands.straighten(velocity, lateral, heading, self.ranges.straighten)
        pose = commands.goal_to_pose(command, self.shoulder)
        pose = torch.cat((pose[..., :3], rotations.two_columns(pose[..., 3:])), -1)
        return {self.velocity_key: velocity, self.pose_key: pose} | {
            self.keys[name]: memory[name] for name in self.keys
        }

    def _present(self, key: Tensor, tensordict: TensorDictBase) -> Tensor:
        """Command to stand, with the end effector where it is."""
        centre = self.centre.expand(*key.shape, -1)
        if self.end_effector_keys is None:
            return centre.clone()
        position, quaternion = _pose(tensordict, self.end_effector_keys, "end_effector_keys")
        if self.base_keys is None:
            base = torch.zeros_like(position), rotations.yaw_quaternion(torch.zeros_like(position[..., :1]))
        else:
            base = self._base(tensordict)
        ground: Tensor | float = 0.0
        if self.base_keys is not None and (height := tensordict.get(self.height_key, None)) is not None:
            ground = base[0][..., 2:] - height
        pose = commands.pose_to_frame(position, quaternion, *base, self.ranges.frame_height, ground)
        return commands.pose_to_goal(pose, self.shoulder)

    def _base(self, tensordict: TensorDictBase) -> tuple[Tensor, Tensor]:
        assert self.base_keys is not None
        return _pose(tensordict, self.base_keys, "base_keys")


def _pose(tensordict: TensorDictBase, keys: Pose, argument: str) -> tuple[Tensor, Tensor]:
    position, quaternion = (tensordict.get(key, None) for key in keys)
    if position is None or quaternion is None:
        raise KeyError(
            f"CommandSampler's {argument} are {keys}, which the environment does not show both: commands could not "
            f"start from the present pose. Name other keys, or pass {argument}=None."
        )
    return position.float(), quaternion.float()


def _with_ending(key: NestedKey, ending: str) -> NestedKey:
    return f"{key}_{ending}" if isinstance(key, str) else (*key[:-1], f"{key[-1]}_{ending}")
