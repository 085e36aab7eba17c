"""Rewards and randomisation keep the contract of transforms."""

from __future__ import annotations

from collections.abc import Callable

import pytest
from tensordict import NestedKey, TensorDictBase
from torch import Tensor
from torchrl.envs import Transform

from torchrl_athletic.functional import rewards
from torchrl_athletic.testing import TransformContract
from torchrl_athletic.transforms import ActionHistory, RewardTerms

Key = Callable[[str], NestedKey]


class TestActionHistory(TransformContract):
    def make_transform(self, key: Key = str, first_row: int = 0) -> Transform:
        return ActionHistory(3, action_key=key("action"), history_key=key("action_history"))


class SpeedBefore:
    """A term that does not look at the last observation, which an environment that resets itself does not show."""

    def __init__(self, key: NestedKey) -> None:
        self.key = key

    def __call__(self, tensordict: TensorDictBase, next_tensordict: TensorDictBase) -> Tensor:
        return rewards.square(tensordict[self.key])


class TestRewardTerms(TransformContract):
    def make_transform(self, key: Key = str, first_row: int = 0) -> Transform:
        term = SpeedBefore(key("joint_velocity"))
        keys = {"terms_key": key("reward_terms"), "sums_key": key("sums")}
        return RewardTerms({"a": term, "b": term}, {"a": 1.0, "b": -0.1}, **keys)

    @pytest.mark.skip(reason="its entries are nested already, and the clause takes groups away")
    def test_nested_keys(self, done_in_groups: bool) -> None: ...

    @pytest.mark.skip(reason="both add to one reward, and the order of a sum shows in its last bit")
    def test_two_instances(self) -> None: ...
