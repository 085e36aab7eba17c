"""Encoders whose zero is a little off."""

from __future__ import annotations

from collections.abc import Mapping

import torch
from tensordict import NestedKey, TensorDictBase
from torch import Tensor
from torchrl.data import Composite, TensorSpec

from torchrl_athletic.functional import streams
from torchrl_athletic.transforms.decimation import Decimation
from torchrl_athletic.transforms.stateful import Joints, RandomTransform, joint_index, reset_mask, unbounded_like


class EncoderOffset(RandomTransform):
    """Read joint positions with an offset, drawn for each joint when an episode starts.

    In place, the whole chain sees the reading, as a drive does: put the transform before :class:`~.Decimation`. The
    true position, for rewards and for the critic, goes to ``true_key`` then; under another ``out_key`` it stays.

    Args:
        low: Least offset [rad].
        high: Greatest offset [rad].
        joints: Whose encoders.
        position_key: What is read [rad]. Shape (*B, J).
        out_key: Where to show the reading; None shows it in place.
        true_key: Where to show the true position beside a reading in place; None does not. Shape (*B, J).
        offset_key: Where to show the offset, 0 for other joints [rad]. Shape (*B, J).
        seed: Of the draws.
        first_row: As of :class:`RandomTransform`.
        reset_key: As of :class:`StatefulTransform`.

    Raises:
        ValueError: Outside of Decimation in place, since the drive would read the offset in the first physics step of
            an action only.

    Source:
        Fey et al. 2025, appendix A, table of domain randomisation. It prints -0.05 to -0.05 rad, surely for -0.05 to
        0.05, which is the default.

    Example:
        >>> from torchrl_athletic.envs import TorqueEnv
        >>> from torchrl_athletic.robots import z1
        >>> from torchrl.envs import TransformedEnv
        >>> env = TransformedEnv(TorqueEnv(z1(), num_envs=2), EncoderOffset(out_key="joint_reading"))
        >>> td = env.rollout(3)
        >>> bool((td["joint_reading"] == td["joint_position"] + td["encoder_offset"]).all())
        True
    """

    def __init__(
        self,
        low: float = -0.05,
        high: float = 0.05,
        joints: Joints = None,
        *,
        position_key: NestedKey = "joint_position",
        out_key: NestedKey | None = None,
        true_key: NestedKey | None = None,
        offset_key: NestedKey = "encoder_offset",
        seed: int = 0,
        first_row: int = 0,
        reset_key: NestedKey | None = None,
    ) -> None:
        if not low <= high:
            raise ValueError(f"offsets between {low} and {high} rad are none. Give low <= high.")
        out_key = position_key if out_key is None else out_key
        out_keys = [out_key, offset_key] + ([] if true_key is None else [true_key])
        super().__init__([position_key], out_keys, seed=seed, first_row=first_row, reset_key=reset_key)
        self.low, self.high, self.joints = low, high, joints
        self.position_key, self.out_key, self.offset_key = position_key, out_key, offset_key
        self.true_key = true_key

    @property
    def in_place(self) -> bool:
        """Whether the true position is hidden."""
        return self.out_key == self.position_key

    def draw(self, key: Tensor, tensordict_reset: TensorDictBase) -> Mapping[NestedKey, Tensor]:
        position = tensordict_reset.get(self.position_key)
        offset, columns = torch.zeros_like(position), joint_index(self, self.joints)
        width = offset[..., columns].shape[-1]
        offset[..., columns] = streams.uniform(key, width, self.low, self.high).to(offset.dtype)
        return {self.offset_key: offset}

    def advance(self, tensordict: TensorDictBase, next_tensordict: TensorDictBase) -> None:
        next_tensordict.set(self.offset_key, tensordict.get(self.offset_key))
        self._read(next_tensordict)

    def _reset(self, tensordict: TensorDictBase, tensordict_reset: TensorDictBase) -> TensorDictBase:
        return self._read(super()._reset(tensordict, tensordict_reset))

    def _reset_on_native_autoreset(
        self, tensordict: TensorDictBase, tensordict_reset: TensorDictBase
    ) -> TensorDictBase:
        if self.in_place:  # the step has read all rows with the offsets of the episode before
            true = tensordict_reset.get(self.position_key) - tensordict.get(self.offset_key)
            starts = reset_mask(tensordict, self.reset_key)
            old = tensordict_reset.get(self.position_key)
            tensordict_reset = super()._reset(tensordict, tensordict_reset)
            read = true + tensordict_reset.get(self.offset_key)
            if self.true_key is not None:
                tensordict_reset.set(self.true_key, true)
            return tensordict_reset.set(self.position_key, read if starts is None else torch.where(starts, read, old))
        return self._reset(tensordict, tensordict_reset)

    def _read(self, tensordict: TensorDictBase) -> TensorDictBase:
        position = tensordict.get(self.position_key)
        if self.true_key is not None:
            tensordict.set(self.true_key, position)
        return tensordict.set(self.out_key, position + tensordict.get(self.offset_key))

    def state_spec(self, observation_spec: Composite) -> Mapping[NestedKey, TensorSpec]:
        position = observation_spec[self.position_key]
        return {self.offset_key: unbounded_like(position, position.shape)}

    def transform_observation_spec(self, observation_spec: Composite) -> Composite:
        inner = self.parent.transform
        if self.in_place and any(isinstance(part, Decimation) for part in inner.modules()):
            raise ValueError(
                "EncoderOffset stands after Decimation and changes positions in place: the drive would read the offset "
                "in the first physics step of an action and the true position in the others. Put it before Decimation, "
                "or give it an out_key."
            )
        observation_spec = super().transform_observation_spec(observation_spec)
        true = observation_spec[self.position_key].clone()
        if self.true_key is not None:
            observation_spec[self.true_key] = true
        observation_spec[self.out_key] = unbounded_like(true, true.shape)  # an offset leaves the joint's range
        return observation_spec
