"""What was seen in the last few steps."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

from tensordict import NestedKey, TensorDictBase
from torch import Tensor
from torchrl.data import Composite, TensorSpec

from torchrl_athletic.functional import history
from torchrl_athletic.transforms.stateful import StatefulTransform, unbounded_like


class ObservationHistory(StatefulTransform):
    """Show the last ``length`` values of entries, oldest first, the present one included.

    An episode starts with its first value in every place. Unlike :class:`~torchrl.envs.CatFrames` it keeps nothing
    in buffers: a checkpoint loads with any number of environments, and the step has no branch.

    Args:
        in_keys: Entries of shape (*B, D).
        length: L.
        out_keys: Where to show them; None appends ``_history`` to each key.
        flatten: Shape (*B, L * D), for a network, instead of (*B, L, D).
        reset_key: As of :class:`StatefulTransform`.

    Source:
        Fey et al. 2025, section II-B: the controller observes the last 10 steps, 200 ms.

    Example:
        >>> from torchrl.envs import GymEnv, TransformedEnv
        >>> env = TransformedEnv(GymEnv("Pendulum-v1"), ObservationHistory(["observation"], length=4))
        >>> seen = env.rollout(6)
        >>> bool((seen["observation_history"][5, -2] == seen["observation"][4]).all())
        True
    """

    def __init__(
        self,
        in_keys: Sequence[NestedKey],
        length: int,
        out_keys: Sequence[NestedKey] | None = None,
        *,
        flatten: bool = False,
        reset_key: NestedKey | None = None,
    ) -> None:
        if length < 1:
            raise ValueError(f"length is {length}, needed is at least 1: the present value is part of the history.")
        names = [_with_suffix(key) for key in in_keys] if out_keys is None else list(out_keys)
        if len(names) != len(in_keys) or set(names) & set(in_keys):
            raise ValueError(
                f"out_keys {names} must name one new entry for each of {list(in_keys)}: a history that replaced its "
                "own source could not be continued."
            )
        super().__init__(in_keys=in_keys, out_keys=names, reset_key=reset_key)
        self.length, self.flatten = length, flatten

    def initial(self, tensordict_reset: TensorDictBase) -> Mapping[NestedKey, Tensor]:
        pairs = zip(self.in_keys, self.out_keys, strict=True)
        return {out: self._shown(history.tile(tensordict_reset.get(key), self.length)) for key, out in pairs}

    def advance(self, tensordict: TensorDictBase, next_tensordict: TensorDictBase) -> None:
        for key, out in zip(self.in_keys, self.out_keys, strict=True):
            value, seen = next_tensordict.get(key), tensordict.get(out)
            if self.flatten:
                seen = seen.unflatten(-1, (self.length, value.shape[-1]))
            next_tensordict.set(out, self._shown(history.push(seen, value)))

    def state_spec(self, observation_spec: Composite) -> Mapping[NestedKey, TensorSpec]:
        specs = {}
        for key, out in zip(self.in_keys, self.out_keys, strict=True):
            value = observation_spec[key]
            width = value.shape[-1]
            tail = (self.length * width,) if self.flatten else (self.length, width)
            specs[out] = unbounded_like(value, (*value.shape[:-1], *tail))
        return specs

    def _shown(self, seen: Tensor) -> Tensor:
        return seen.flatten(-2) if self.flatten else seen


def _with_suffix(key: NestedKey) -> NestedKey:
    return f"{key}_history" if isinstance(key, str) else (*key[:-1], f"{key[-1]}_history")
