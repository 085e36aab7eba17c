"""What the policy did in its last few steps."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import torch
from tensordict import NestedKey, TensorDictBase
from torch import Tensor
from torchrl.data import Composite, TensorSpec, Unbounded

from torchrl_athletic.functional import history
from torchrl_athletic.transforms.keys import beside
from torchrl_athletic.transforms.stateful import StatefulTransform, full_action_spec, unbounded_like


class ActionHistory(StatefulTransform):
    """Show the last ``length`` actions, oldest first: for the policy's eyes, and for terms of smoothness.

    It notes the action as it comes by. Placed outside :class:`~.Decimation` (after it in Compose), that is the policy's
    own action; placed inside, what acts at each physics step.

    Args:
        length: L.
        before: Action before the episode, shape (D,); None counts the first action as the one before, so that a
            first action is no jump. Until then zeros are shown.
        action_key: Shape (*B, D).
        history_key: Where to show them. Shape (*B, L, D).
        reset_key: As of :class:`StatefulTransform`.

    Source:
        Fey et al. 2025, section II-B: the controller observes its previous action, and a reward holds the last three.

    Example:
        >>> from torchrl.envs import GymEnv, TransformedEnv
        >>> env = TransformedEnv(GymEnv("Pendulum-v1"), ActionHistory(3))
        >>> seen = env.rollout(5)
        >>> bool((seen["next", "action_history"][4, :, 0] == seen["action"][2:5, 0]).all())
        True
    """

    before: Tensor | None

    def __init__(
        self,
        length: int = 3,
        *,
        before: Tensor | Sequence[float] | None = None,
        action_key: NestedKey = "action",
        history_key: NestedKey = "action_history",
        reset_key: NestedKey | None = None,
    ) -> None:
        if length < 1:
            raise ValueError(f"length is {length}, needed is at least 1: a history of no actions tells nothing.")
        self.fresh_key = beside(history_key, "fresh")
        super().__init__([], [history_key, self.fresh_key], reset_key=reset_key)
        self.length, self.action_key, self.history_key = length, action_key, history_key
        self.register_buffer("before", None if before is None else torch.as_tensor(before, dtype=torch.float32).clone())

    def _inv_call(self, tensordict: TensorDictBase) -> TensorDictBase:
        if self.parent is None:  # on its way into a buffer: noted already
            return tensordict
        action, past = tensordict.get(self.action_key), tensordict.get(self.history_key)
        if self.before is None:
            fresh = tensordict.get(self.fresh_key)
            past = torch.where(fresh.unsqueeze(-1), action.unsqueeze(-2), past)
            tensordict.set(self.fresh_key, torch.zeros_like(fresh))
        return tensordict.set(self.history_key, history.push(past, action))

    def initial(self, tensordict_reset: TensorDictBase) -> Mapping[NestedKey, Tensor]:
        action = full_action_spec(self)[self.action_key]
        before = action.zero() if self.before is None else self.before.to(action.dtype).expand(action.shape)
        fresh = torch.ones(*action.shape[:-1], 1, dtype=torch.bool, device=before.device)
        return {self.history_key: history.tile(before, self.length), self.fresh_key: fresh}

    def advance(self, tensordict: TensorDictBase, next_tensordict: TensorDictBase) -> None:
        for key in self.out_keys:
            next_tensordict.set(key, tensordict.get(key))

    def state_spec(self, observation_spec: Composite) -> Mapping[NestedKey, TensorSpec]:
        action = full_action_spec(self)[self.action_key]
        fresh = Unbounded(shape=(*action.shape[:-1], 1), dtype=torch.bool, device=action.device)
        shape = (*action.shape[:-1], self.length, action.shape[-1])
        return {self.history_key: unbounded_like(action, shape), self.fresh_key: fresh}
