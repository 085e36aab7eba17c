"""Episodes that do not all end at once."""

from __future__ import annotations

from collections.abc import Mapping

import torch
from tensordict import NestedKey, TensorDictBase
from torch import Tensor
from torchrl.data import Composite, TensorSpec

from torchrl_athletic.functional import streams
from torchrl_athletic.transforms.stateful import RandomTransform


class StaggeredEpisodes(RandomTransform):
    """Let the first episode of each row begin at an age of its own, all later ones at 0.

    A batch of environments that begin together would end together for hours: every iteration would see one part of an
    episode. Stands after ``StepCounter``. Only the first reset of each row begins so: after one of your own, or of
    ``check_env_specs``, make the environment anew. TorchRL's ``RandomTruncationTransform`` does the like with a memory
    that no checkpoint holds and no seed rules.

    Args:
        max_steps: Of the ``StepCounter``.
        step_count_key: Of the ``StepCounter``.
        seed: Of the ages.
        first_row: As of :class:`RandomTransform`.
        reset_key: As of :class:`StatefulTransform`.

    Raises:
        ValueError: If episodes have no steps.

    Example:
        >>> from torchrl.envs import Compose, GymEnv, SerialEnv, StepCounter, TransformedEnv
        >>> pendulums = SerialEnv(3, lambda: GymEnv("Pendulum-v1"))
        >>> env = TransformedEnv(pendulums, Compose(StepCounter(200), StaggeredEpisodes(200)))
        >>> first, second = env.reset()["step_count"], env.reset()["step_count"]
        >>> first.unique().numel(), second.flatten().tolist()
        (3, [0, 0, 0])
    """

    def __init__(
        self,
        max_steps: int,
        *,
        step_count_key: NestedKey = "step_count",
        seed: int = 0,
        first_row: int = 0,
        reset_key: NestedKey | None = None,
    ) -> None:
        if max_steps < 1:
            raise ValueError(f"max_steps is {max_steps}: there is no age to begin at. Give the length of an episode.")
        super().__init__([step_count_key], [step_count_key], seed=seed, first_row=first_row, reset_key=reset_key)
        self.max_steps, self.step_count_key = max_steps, step_count_key

    def draw(self, key: Tensor, tensordict_reset: TensorDictBase) -> Mapping[NestedKey, Tensor]:
        count = tensordict_reset.get(self.step_count_key)
        age = (streams.uniform(key, 1) * self.max_steps).to(count.dtype).reshape(count.shape)
        return {self.step_count_key: torch.where(self.episode.reshape(count.shape) == 1, age, count)}

    def advance(self, tensordict: TensorDictBase, next_tensordict: TensorDictBase) -> None:
        """Nothing: the counter counts."""

    def state_spec(self, observation_spec: Composite) -> Mapping[NestedKey, TensorSpec]:
        return {}
