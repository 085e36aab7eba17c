"""Episodes that a task ends, besides those that a fall ends."""

from __future__ import annotations

from collections.abc import Callable, Sequence

from tensordict import NestedKey, TensorDictBase
from torch import Tensor
from torchrl.envs import Transform


class EarlyTermination(Transform):
    """End an episode as failed where a condition holds.

    Stands after the transforms whose entries the condition reads, and before those that keep count of episodes' ends.

    Args:
        condition: Of what a step started from and what it led to, whether the task has failed. bool, shape (*B, 1).
        done_keys: Flags to raise; None takes those of the environment that tell of an end or of a failure.

    Raises:
        ValueError: In a step, if the condition has another shape than the flags.

    Example:
        >>> import torch
        >>> from torchrl.envs import GymEnv, TransformedEnv
        >>> spins = EarlyTermination(lambda before, after: after["observation"][..., 2:].abs() > 0)
        >>> len(TransformedEnv(GymEnv("Pendulum-v1"), spins).rollout(5))
        1
    """

    def __init__(
        self,
        condition: Callable[[TensorDictBase, TensorDictBase], Tensor],
        done_keys: Sequence[NestedKey] | None = None,
    ) -> None:
        super().__init__(in_keys=[], out_keys=[])
        self.condition, self.done_keys = condition, done_keys

    def _step(self, tensordict: TensorDictBase, next_tensordict: TensorDictBase) -> TensorDictBase:
        failed = self.condition(tensordict, next_tensordict)
        keys = self.done_keys
        if keys is None:
            keys = [key for key in self.parent.done_keys if _name(key) in ("done", "terminated")]
        for key in keys:
            flag = next_tensordict.get(key)
            if failed.shape != flag.shape:
                raise ValueError(
                    f"the condition gives shape {tuple(failed.shape)} and {key!r} has {tuple(flag.shape)}: one row's "
                    "failure would end others. Give one flag a row and a last dimension of 1."
                )
            next_tensordict.set(key, flag | failed)
        return next_tensordict

    def _call(self, next_tensordict: TensorDictBase) -> TensorDictBase:
        return next_tensordict

    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        """Leaves data as it is: they have their flags."""
        return tensordict


def _name(key: NestedKey) -> str:
    return key if isinstance(key, str) else key[-1]
