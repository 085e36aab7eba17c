"""How far the end effector is from where it is told to be."""

from __future__ import annotations

from tensordict import NestedKey, TensorDictBase
from torch import Tensor
from torchrl.data import Composite
from torchrl.envs import Transform

from torchrl_athletic.functional import rotations
from torchrl_athletic.functional.commands import pose_to_world
from torchrl_athletic.transforms.stateful import unbounded_like

Pose = tuple[NestedKey, NestedKey]
"""Keys of a position (*B, 3) [m] and a quaternion (*B, 4), wxyz, both in the world."""


class PoseError(Transform):
    """Show the way from the end effector's keypoints to those of its command, seen from the base's heading.

    The keypoints are the frame's origin and one point on each of its axes
    (:func:`~torchrl_athletic.functional.rotations.keypoints`). The command is given in a frame that follows the base's
    place and heading at a fixed height over the ground, as :class:`CommandSampler` writes it.

    Args:
        frame_height: Of the commands' frame over the ground [m].
        length: Of the axes on which the keypoints stand [m]. With 0.3 m, 1° of attitude counts as 5 mm. The paper does
            not say; its authors' earlier work has points on a cube of 0.3 m (Portela et al. 2024).
        command_key: Position [m] and two columns of the rotation matrix. Shape (*B, 9).
        pose_keys: Of the end effector.
        base_keys: Of the base.
        height_key: Of the base over the ground [m], shape (*B, 1), where the environment shows it; else z counts.
        error_key: Where to show the ways, origin first [m]. Shape (*B, 4, 3).

    Source:
        Fey et al. 2025, section II-B, reward function.

    Example:
        >>> import torch
        >>> from tensordict import TensorDict
        >>> ahead = torch.tensor([[1.0, 0.0, 0.0, 0.0]])
        >>> shown = TensorDict(
        ...     end_effector_command=[[0.6, 0.0, 0.1, 1.0, 0.0, 0.0, 0.0, 1.0, 0.0]], end_effector_quaternion=ahead,
        ...     end_effector_position=[[0.6, 0.0, 0.5]], base_quaternion=ahead, base_position=[[0.0, 0.0, 0.55]],
        ...     batch_size=[1])
        >>> PoseError(frame_height=0.5)(shown)["pose_error"][0, 0].round(decimals=3).abs().tolist()
        [0.0, 0.0, 0.10000000149011612]
    """

    def __init__(
        self,
        frame_height: float,
        length: float = 0.3,
        *,
        command_key: NestedKey = "end_effector_command",
        pose_keys: Pose = ("end_effector_position", "end_effector_quaternion"),
        base_keys: Pose = ("base_position", "base_quaternion"),
        height_key: NestedKey = "base_height",
        error_key: NestedKey = "pose_error",
    ) -> None:
        super().__init__(in_keys=[command_key, *pose_keys, *base_keys], out_keys=[error_key])
        self.frame_height, self.length, self.height_key = frame_height, length, height_key
        self.command_key, self.pose_keys, self.base_keys, self.error_key = command_key, pose_keys, base_keys, error_key

    def _call(self, next_tensordict: TensorDictBase) -> TensorDictBase:
        position, attitude = (next_tensordict.get(key) for key in self.pose_keys)
        base, turn = (next_tensordict.get(key) for key in self.base_keys)
        height = next_tensordict.get(self.height_key, None)
        ground: Tensor | float = 0.0 if height is None else base[..., 2:] - height
        goal = pose_to_world(next_tensordict.get(self.command_key), base, turn, self.frame_height, ground)
        way = rotations.keypoints(*goal, self.length) - rotations.keypoints(
            position, rotations.matrix(attitude), self.length
        )
        heading = rotations.yaw_quaternion(rotations.yaw(turn)).unsqueeze(-2).expand(*way.shape[:-1], 4)
        return next_tensordict.set(self.error_key, rotations.rotate_inverse(heading, way))

    def _reset(self, tensordict: TensorDictBase, tensordict_reset: TensorDictBase) -> TensorDictBase:
        return self._call(tensordict_reset)

    forward = _call

    def transform_observation_spec(self, observation_spec: Composite) -> Composite:
        position = observation_spec[self.pose_keys[0]]
        observation_spec[self.error_key] = unbounded_like(position, (*position.shape[:-1], 4, 3))
        return observation_spec
