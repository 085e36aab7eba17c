"""Where an episode began, and which way it looked."""

from __future__ import annotations

from collections.abc import Mapping

from tensordict import NestedKey, TensorDictBase
from torch import Tensor
from torchrl.data import Composite, TensorSpec

from torchrl_athletic.functional import commands
from torchrl_athletic.transforms.stateful import StatefulTransform, unbounded_like


class StartLine(StatefulTransform):
    """Remember the place and the heading of the base at the episode's start.

    "Forward" of a throw, and the line that a sled shall be pulled along, are those of the start: robots start with any
    heading, and turn. :func:`~.functional.commands.deviation_from_line` reads what is remembered.

    Args:
        base_keys: Position (*B, 3) [m] and quaternion (*B, 4), wxyz, in the world.
        line_key: Where to show x, y [m] and yaw [rad]. Shape (*B, 3).
        reset_key: As of :class:`StatefulTransform`.

    Example:
        >>> from torchrl.envs import TransformedEnv
        >>> from torchrl_athletic.envs import TorqueEnv
        >>> from torchrl_athletic.robots import b2z1
        >>> TransformedEnv(TorqueEnv(b2z1()), StartLine()).rollout(2)["start_line"].shape
        torch.Size([1, 2, 3])
    """

    def __init__(
        self,
        *,
        base_keys: tuple[NestedKey, NestedKey] = ("base_position", "base_quaternion"),
        line_key: NestedKey = "start_line",
        reset_key: NestedKey | None = None,
    ) -> None:
        super().__init__(list(base_keys), [line_key], reset_key=reset_key)

    def initial(self, tensordict_reset: TensorDictBase) -> Mapping[NestedKey, Tensor]:
        position, quaternion = (tensordict_reset.get(key) for key in self.in_keys)
        return {self.out_keys[0]: commands.line_ahead(position, quaternion)}

    def advance(self, tensordict: TensorDictBase, next_tensordict: TensorDictBase) -> None:
        next_tensordict.set(self.out_keys[0], tensordict.get(self.out_keys[0]))

    def state_spec(self, observation_spec: Composite) -> Mapping[NestedKey, TensorSpec]:
        position = observation_spec[self.in_keys[0]]
        return {self.out_keys[0]: unbounded_like(position, position.shape)}
