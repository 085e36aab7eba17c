"""A guard against numbers that are none: it names the first entry in which one appeared."""

from __future__ import annotations

import torch
from tensordict import NestedKey, TensorDictBase
from torch import Tensor


class NonFiniteError(FloatingPointError):
    """A NaN or an infinity has appeared."""


def check_finite(batch: TensorDictBase, what: str = "batch") -> None:
    """Make sure that every number is finite. Waits for the device once.

    Args:
        batch: Shape (N, T) with time as second dimension, or any other shape.
        what: Its name in the message.

    Raises:
        NonFiniteError: If one is not. Names the entry in which the first one in time appeared; of several at one time
            that which comes first in the order of cause: what is observed, what the policy makes of it, what follows.

    Example:
        >>> from tensordict import TensorDict
        >>> observation = torch.zeros(2, 3, 4)
        >>> observation[1, 2, 0] = torch.nan
        >>> check_finite(TensorDict({"observation": observation}, [2, 3]))
        Traceback (most recent call last):
        ...
        torchrl_athletic.training.finite.NonFiniteError: 'observation' of the batch is nan in row 1 at step 2...
    """
    leaves = {key: batch.get(key) for key in batch.keys(include_nested=True, leaves_only=True)}
    keys = [key for key, value in leaves.items() if value.is_floating_point() and value.numel()]
    if not keys:
        return
    sound = torch.stack([_sound(leaves[key]) for key in keys])
    if bool(sound.all()):
        return
    bad = [key for key, fine in zip(keys, sound.tolist(), strict=True) if not fine]
    first = min(bad, key=lambda key: (_first_step(batch, batch.get(key)), _order_of_cause(key)))
    value = batch.get(first)
    others = [repr(key) for key in bad if key != first]
    raise NonFiniteError(
        f"{first!r} of the {what} is {_first_bad(batch, value)}; "
        + (f"then also {', '.join(others)}. " if others else "all else is finite. ")
        + _advice(first)
    )


def _sound(value: Tensor) -> Tensor:
    """Whether all of it is finite, without a copy of its size. Shape ()."""
    least, greatest = torch.aminmax(value)  # NaN if any is
    return torch.isfinite(least) & torch.isfinite(greatest)


def _first_step(batch: TensorDictBase, value: Tensor) -> int:
    if batch.ndim < 2:
        return 0
    wrong = ~torch.isfinite(value).flatten(2).all(-1) if value.ndim > 2 else ~torch.isfinite(value)
    return int(wrong.any(0).nonzero()[0])


MADE_BY_POLICY = ("loc", "scale", "action", "action_log_prob")
MADE_AFTER = ("reward", "advantage", "value_target")


def _order_of_cause(key: NestedKey) -> tuple[bool, int]:
    """What is observed, what the policy makes of it, what follows, and what that is worth."""
    path = (key,) if isinstance(key, str) else key
    stages = ("", *MADE_BY_POLICY, *MADE_AFTER)
    return path[0] == "next", stages.index(path[-1]) if path[-1] in stages else 0


def _first_bad(batch: TensorDictBase, value: Tensor) -> str:
    if batch.ndim < 2:
        bad = value[~torch.isfinite(value)]
        return f"{bad[0].item()} in {bad.numel()} of {value.numel()} numbers"
    step = _first_step(batch, value)
    column = value[:, step]
    rows = (~torch.isfinite(column)).reshape(len(column), -1).any(-1).nonzero().squeeze(-1)
    bad = column[rows[0]]
    number = bad[~torch.isfinite(bad)].reshape(-1)[0].item()
    others = f" and {len(rows) - 1} other rows" if len(rows) > 1 else ""
    return f"{number} in row {int(rows[0])}{others} at step {step}"


def _advice(key: NestedKey) -> str:
    if key in MADE_BY_POLICY:
        return "Its inputs are finite, so the network's weights are not: lower the learning rate, or clip gradients."
    return "The environment made it: end episodes that diverge, and look at what this entry is computed from."
