"""A controller that learns no more, led by a policy that commands it: the paper's No-E2E."""

from __future__ import annotations

from typing import Any

import torch
from tensordict import NestedKey, TensorDict, TensorDictBase
from torch import Tensor
from torchrl.data import Composite
from torchrl.envs import Transform
from torchrl.envs.utils import ExplorationType, set_exploration_type

from torchrl_athletic.functional import rotations
from torchrl_athletic.transforms.stateful import unbounded_like

SCALE = (0.5, 0.25, 0.5, *(0.3,) * 3, *(0.5,) * 6)
"""By how much an action of 1 moves the commands: velocity [m/s, m/s, rad/s], position [m], two columns of the attitude
[1]."""


class FrozenController(Transform):
    """The action moves the commands of the newest frame, and a frozen controller does what they say.

    Stands last in Compose. Zeros let the controller follow the reference; older frames keep what they showed. One of
    the pre-training has not learnt what phases are: make it deaf to them, as below.

    Args:
        controller: Reads ``observation`` and acts by its mean; learns nothing here.
        history: Frames that it sees.
        scale: Of an action, for each of the twelve numbers of the commands.
        observation_key: Of the controller.
        action_key: Of the leading policy further out, shape (*B, 12); of the controller further in, shape (*B, 19).

    Source:
        Fey et al. 2025, section V-B, No-E2E: "a high-level policy that outputs commands for a frozen pre-trained WBC".

    Example:
        >>> from torchrl_athletic.envs import ball_throw_env, phase_inputs
        >>> from torchrl_athletic.networks import open_inputs, pretrained
        >>> env, controller = ball_throw_env(num_envs=2), pretrained("wbc")
        >>> open_inputs(controller, phase_inputs(env))
        >>> env = env.append_transform(FrozenController(controller))
        >>> env.rollout(2)["action"].shape
        torch.Size([2, 2, 12])
    """

    scale: Tensor

    def __init__(
        self,
        controller: Any,
        *,
        history: int = 10,
        scale: tuple[float, ...] = SCALE,
        observation_key: NestedKey = "observation",
        action_key: NestedKey = "action",
    ) -> None:
        super().__init__(in_keys=[], out_keys=[], in_keys_inv=[action_key], out_keys_inv=[action_key])
        self.__dict__["controller"] = controller  # no module of this one: nobody shall find its parameters to train
        self.history, self.observation_key, self.action_key = history, observation_key, action_key
        self.register_buffer("scale", torch.tensor(scale), persistent=False)

    def _inv_call(self, tensordict: TensorDictBase) -> TensorDictBase:
        if self.parent is None:  # on its way into a buffer
            return tensordict
        observation = tensordict.get(self.observation_key)
        led = self.lead(observation, tensordict.get(self.action_key))
        with torch.no_grad(), set_exploration_type(ExplorationType.DETERMINISTIC):
            seen = TensorDict({self.observation_key: led}, batch_size=observation.shape[:-1])
            action = self.controller(seen).get("loc")
        return tensordict.set(self.action_key, action)

    def lead(self, observation: Tensor, action: Tensor) -> Tensor:
        """What the controller is shown in place of what the environment shows. Shapes (*B, L * D), (*B, 12)."""
        start = observation.shape[-1] - observation.shape[-1] // self.history + 3  # behind gravity, of the newest frame
        before, commands, after = observation.split((start, 12, observation.shape[-1] - start - 12), -1)
        moved = commands + self.scale * action
        turn = rotations.from_two_columns(moved[..., 6:])
        columns = torch.cat((turn[..., 0], turn[..., 1]), -1)
        return torch.cat((before, moved[..., :6], columns, after), -1)

    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        """Leaves data as it is: the transform acts on the way in."""
        return tensordict

    def transform_action_spec(self, action_spec: Composite) -> Composite:
        joints = action_spec[self.action_key]
        action_spec[self.action_key] = unbounded_like(joints, (*joints.shape[:-1], len(self.scale)))
        return action_spec
