"""What the losses are given: TorchRL's GAE against the sums of the paper, at every way an episode can end."""

import itertools

import numpy as np
import pytest
import torch
from networks.samples import STATE
from tensordict import TensorDict
from torchrl.objectives.value import GAE

from torchrl_athletic.networks import critic

GAMMA, LAMBDA = 0.96875, 0.9375  # exact in float32, in which GAE keeps them
ENDS = [*itertools.product([False, True], repeat=2)]
"""(terminated, truncated)."""


def oracle(reward, value, next_value, terminated, truncated):
    """Schulman et al. 2016, eqs. 11 and 16, as a sum over the rest of the episode; shape (T,) each."""
    steps = len(reward)
    surprise = reward + GAMMA * next_value * ~terminated - value
    advantage = np.zeros(steps)
    for t in range(steps):
        for k in range(t, steps):
            advantage[t] += (GAMMA * LAMBDA) ** (k - t) * surprise[k]
            if terminated[k] or truncated[k]:
                break
    return advantage


def rollout(terminated, truncated, steps=6, at=2, seed=0):
    """One env whose episode ends at step ``at``; what it showed last is not what the next episode starts with."""
    torch.manual_seed(seed)
    states = torch.randn(1, steps + 1, STATE, dtype=torch.float64)
    batch = TensorDict({"observation": states[:, :-1]}, [1, steps])
    final = states[:, 1:].clone()
    if terminated or truncated:
        final[:, at] = torch.randn(STATE, dtype=torch.float64)
    ends = {key: torch.zeros(1, steps, 1, dtype=torch.bool) for key in ("terminated", "truncated")}
    ends["terminated"][:, at], ends["truncated"][:, at] = terminated, truncated
    ends["done"] = ends["terminated"] | ends["truncated"]
    batch["next"] = TensorDict(
        {"observation": final, "reward": torch.randn(1, steps, 1, dtype=torch.float64), **ends}, [1, steps]
    )
    batch.names = [None, "time"]
    return batch


def estimated(batch, value, **options):
    return GAE(gamma=GAMMA, lmbda=LAMBDA, value_network=value, **options)(batch.clone())


def values(batch, value):
    with torch.no_grad():
        return [value(part.clone())["state_value"][0, :, 0].numpy() for part in (batch, batch["next"])]


@pytest.fixture(scope="module")
def value():
    torch.manual_seed(0)
    return critic(STATE, hidden=(8,)).double()


@pytest.mark.parametrize("vectorized", [False, True])
@pytest.mark.parametrize("at", [0, 2, 5])
@pytest.mark.parametrize("end", ENDS, ids=lambda end: f"terminated={end[0]},truncated={end[1]}")
def test_advantages_are_the_sums_of_the_paper(value, vectorized, at, end):
    batch = rollout(*end, at=at)
    now, after = values(batch, value)
    last = [batch["next", key][0, :, 0].numpy() for key in ("reward", "terminated", "truncated")]
    expected = oracle(last[0], now, after, *last[1:])
    found = estimated(batch, value, vectorized=vectorized)
    np.testing.assert_allclose(found["advantage"][0, :, 0], expected, atol=1e-12)
    np.testing.assert_allclose(found["value_target"][0, :, 0], expected + now, atol=1e-12)


@pytest.mark.parametrize("end", ENDS[1:], ids=str)
def test_an_end_keeps_what_came_after_from_what_was_before(value, end):
    batch = rollout(*end)
    other = batch.clone()
    other["next", "reward"][:, 3:] += 7.0
    before, after = (estimated(b, value, vectorized=True)["advantage"] for b in (batch, other))
    assert before[:, :3].equal(after[:, :3])
    assert not before[:, 3:].equal(after[:, 3:])


def test_only_a_truncated_episode_is_worth_something_at_its_last_observation(value):
    found = {}
    for end in ((True, False), (False, True)):
        batch = rollout(*end)
        batch["next", "observation"][:, 2] *= -3.0
        changed = estimated(batch, value, vectorized=True)["advantage"][0, 2]
        found[end] = (changed - estimated(rollout(*end), value, vectorized=True)["advantage"][0, 2]).item()
    assert found[True, False] == 0
    assert found[False, True] != 0
