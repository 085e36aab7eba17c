"""The most that motors gave at once."""

from __future__ import annotations

from collections.abc import Mapping

import torch
from tensordict import NestedKey, TensorDictBase
from torch import Tensor
from torchrl.data import Composite, TensorSpec

from torchrl_athletic.transforms.stateful import Joints, StatefulTransform, joint_index, unbounded_like


class PeakPower(StatefulTransform):
    """Show the greatest power that joints have given together since the episode's start.

    Before :class:`~.Decimation` in Compose it reads every step of the physics, as a fuse would.

    Args:
        joints: That share a supply.
        power_key: Of each joint, torque times velocity [W]. Shape (*B, J).
        peak_key: Where to show it [W]. Shape (*B, 1).
        reset_key: As of :class:`StatefulTransform`.

    Example:
        >>> from torchrl.envs import TransformedEnv
        >>> from torchrl_athletic.envs import TorqueEnv
        >>> from torchrl_athletic.robots import b2z1
        >>> shown = TransformedEnv(TorqueEnv(b2z1()), PeakPower("leg")).rollout(9)["next"]
        >>> bool((shown["peak_power"].diff(dim=1) >= 0).all())
        True
    """

    def __init__(
        self,
        joints: Joints = "leg",
        *,
        power_key: NestedKey = "joint_power",
        peak_key: NestedKey = "peak_power",
        reset_key: NestedKey | None = None,
    ) -> None:
        super().__init__([power_key], [peak_key], reset_key=reset_key)
        self.joints, self.power_key, self.peak_key = joints, power_key, peak_key

    def initial(self, tensordict_reset: TensorDictBase) -> Mapping[NestedKey, Tensor]:
        return {self.peak_key: torch.zeros_like(tensordict_reset.get(self.power_key)[..., :1])}

    def advance(self, tensordict: TensorDictBase, next_tensordict: TensorDictBase) -> None:
        power = next_tensordict.get(self.power_key)[..., joint_index(self, self.joints)].sum(-1, keepdim=True)
        next_tensordict.set(self.peak_key, torch.maximum(tensordict.get(self.peak_key), power))

    def state_spec(self, observation_spec: Composite) -> Mapping[NestedKey, TensorSpec]:
        power = observation_spec[self.power_key]
        return {self.peak_key: unbounded_like(power, (*power.shape[:-1], 1))}
