"""Samples as a collector and GAE would leave them, from a policy that has moved on since."""

import torch
from tensordict import TensorDict
from torchrl.envs.utils import ExplorationType, set_exploration_type

from torchrl_athletic.networks import actor, critic

STATE, ACTION = 5, 3


def networks(dtype=torch.float32, seed=0):
    torch.manual_seed(seed)
    return actor(STATE, ACTION, hidden=(16, 16)).to(dtype), critic(STATE, hidden=(16, 16)).to(dtype)


def collected(policy, *shape, seed=1):
    """What ``policy`` does in random states, with made-up advantages and returns."""
    torch.manual_seed(seed)
    dtype = next(policy.parameters()).dtype
    states = TensorDict({"observation": torch.randn(*shape, STATE, dtype=dtype)}, shape)
    with torch.no_grad(), set_exploration_type(ExplorationType.RANDOM):
        batch = policy(states)
    for key in ("advantage", "value_target", "state_value"):
        batch[key] = torch.randn(*shape, 1, dtype=dtype)
    return batch


def move(network, by=0.1, seed=2):
    """So that the ratio is not 1 and nothing is at its start."""
    torch.manual_seed(seed)
    with torch.no_grad():
        for parameter in network.parameters():
            parameter.add_(by * torch.randn_like(parameter))


def gradients(loss, network):
    return torch.autograd.grad(loss, list(network.parameters()), retain_graph=True)
