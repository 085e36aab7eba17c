"""Rollouts that can be compared, number by number."""

from __future__ import annotations

from collections.abc import Collection, Sequence

import torch
from tensordict import NestedKey, TensorDictBase
from torchrl.envs import EnvBase


def make_actions(env: EnvBase, steps: int, seed: int = 0) -> TensorDictBase:
    """Actions to replay, drawn from the specs. Batch size (T, *B)."""
    with torch.random.fork_rng(devices=[]):
        torch.manual_seed(seed)
        return env.full_action_spec.to("cpu").rand((steps,)).to(env.device)


def play(
    env: EnvBase, actions: TensorDictBase, tensordict: TensorDictBase | None = None
) -> tuple[TensorDictBase, TensorDictBase]:
    """Let actions act, episodes starting anew where they end, as a collector does.

    Args:
        env: With batch size (*B,).
        actions: Batch size (T, *B).
        tensordict: Where to go on from; None resets first.

    Returns:
        The steps, batch size (T, *B), and where to go on from.

    Raises:
        AssertionError: If a step wrote to its input, or changed what an earlier one had returned.
    """
    tensordict = env.reset() if tensordict is None else tensordict
    returned, copies = [], []
    for action in actions.unbind(0):
        given = tensordict.copy().update(action.clone())
        before = given.clone()
        step, tensordict = env.step_and_maybe_reset(given)
        returned.append(step)
        copies.append(step.clone())
        changed = difference(step.select(*before.keys(True, True), strict=False), before)
        assert changed is None, f"the step changed what was given to it, {changed}: write to a copy"
    steps = torch.stack(copies, 0)
    changed = difference(torch.stack(returned, 0), steps)
    assert changed is None, f"later steps changed data that an earlier one had returned, {changed}: return copies"
    return steps, tensordict


def difference(
    first: TensorDictBase,
    second: TensorDictBase,
    *,
    tolerance: float = 0.0,
    skip: Collection[NestedKey] = (),
) -> str | None:
    """Where two tensordicts differ first, in words; None if they do not.

    Two NaNs are the same, as both say that there is no value.
    """
    keys = [set(td.keys(True, True)) - set(skip) for td in (first, second)]
    if keys[0] != keys[1]:
        return f"one has entries that the other lacks: {sorted(map(str, keys[0] ^ keys[1]))}"
    for key in sorted(keys[0], key=str):
        a, b = first.get(key), second.get(key)
        if a.shape != b.shape or a.dtype != b.dtype:
            return f"{key!r} is {tuple(a.shape)} {a.dtype} in one, {tuple(b.shape)} {b.dtype} in the other"
        if a.dtype == torch.bool:
            differs = a != b
        else:
            differs = ~torch.isclose(a, b, rtol=tolerance, atol=tolerance, equal_nan=True)
        if differs.any():
            where = tuple(torch.nonzero(differs)[0].tolist())
            return f"{key!r} at {where} is {a[where].item()!r} in one, {b[where].item()!r} in the other"
    return None


def rows_together(replicas: Sequence[TensorDictBase]) -> TensorDictBase:
    """Rollouts of environments of one row each, batch size (T, 1), as one of many rows, (T, N)."""
    return torch.cat(list(replicas), 1)
