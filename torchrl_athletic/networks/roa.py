"""Regularized Online Adaptation: a policy that is told what was randomised, and learns to guess it from its history."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import torch
from tensordict import NestedKey
from torch import Tensor, nn
from torchrl.modules import MLP, ProbabilisticActor

from torchrl_athletic.networks.actor_critic import HIDDEN, GaussianHead, Trunk, gaussian_actor


class RegularizedAdaptation(nn.Module):
    r"""The latent :math:`z` by which a policy knows its environment, from what was drawn or from what it has felt.

    While it trains, :math:`z = \mu(e)` encodes what was randomised, and its gradient includes that of

    .. math:: \lambda \lVert \mu(e) - \mathrm{sg}[\phi(h)] \rVert_2 + \lVert \mathrm{sg}[\mu(e)] - \phi(h) \rVert_2

    (sg: no gradient), so that the adaptation module φ learns to read the latent from the history h, and μ tells nothing
    that a history does not show. Deployed (:func:`deploy`), :math:`z = \phi(h)`. Any loss that is back-propagated
    through the latent brings the term along, with weight 1: losses and optimisers need not know of it.

    Unlike the source, experience is collected with μ alone; there every twentieth iteration used φ.

    Args:
        privileged_size: E, of what was randomised.
        history_size: H, of the history, flat.
        latent: Z.
        hidden: Layer sizes of the encoder and of the adaptation module.
        ramp: Passes with a gradient over which λ grows from 0 to 1.
        device: Where its parameters are made.

    Source:
        Fu et al. 2023, section 3.2, https://arxiv.org/abs/2210.10044.

    Example:
        >>> adaptation = RegularizedAdaptation(privileged_size=5, history_size=30)
        >>> adaptation(torch.randn(4, 5), torch.randn(4, 30)).shape
        torch.Size([4, 20])
    """

    passes: Tensor

    def __init__(
        self,
        privileged_size: int,
        history_size: int,
        latent: int = 20,
        *,
        hidden: Sequence[int] = (64, 64),
        ramp: int = 2000,
        device: torch.device | str | None = None,
    ):
        super().__init__()
        sizes: dict[str, Any] = {"num_cells": list(hidden), "activation_class": nn.ELU, "device": device}
        self.encoder = MLP(privileged_size, latent, **sizes)
        self.adapter = MLP(history_size, latent, **sizes)
        self.ramp, self.deployed = ramp, False
        self.register_buffer("passes", torch.zeros((), device=device))

    def forward(self, privileged: Tensor, history: Tensor) -> Tensor:
        """Shapes (*B, E), which is not looked at when deployed, and (*B, H) to (*B, Z)."""
        if self.deployed:
            return self.adapter(history)
        told = self.encoder(privileged)
        if not torch.is_grad_enabled():
            return told
        felt = self.adapter(history)
        self.passes += 1
        weight = (self.passes / self.ramp).clamp(max=1.0)
        return _WithLoss.apply(told, adaptation_loss(told, felt, weight))


def adaptation_loss(told: Tensor, felt: Tensor, weight: Tensor | float) -> Tensor:
    """Mean over samples of λ |told - sg felt| + |sg told - felt|.

    Args:
        told: Latent of the encoder [1]. Shape (*B, Z).
        felt: Latent of the adaptation module [1]. Shape (*B, Z).
        weight: λ [1].

    Returns:
        Shape ().

    Example:
        >>> adaptation_loss(torch.tensor([[3.0, 4.0]]), torch.zeros(1, 2), 0.5)
        tensor(7.5000)
    """
    held = torch.linalg.vector_norm(told - felt.detach(), dim=-1).mean()
    learned = torch.linalg.vector_norm(told.detach() - felt, dim=-1).mean()
    return weight * held + learned


class _WithLoss(torch.autograd.Function):
    """The value as it is; whoever back-propagates through it back-propagates the loss too, with weight 1."""

    @staticmethod
    def forward(ctx: Any, value: Tensor, loss: Tensor) -> Tensor:
        return value.view_as(value)

    @staticmethod
    def backward(ctx: Any, *gradients: Tensor) -> tuple[Tensor, Tensor]:
        (gradient,) = gradients
        return gradient, gradient.new_ones(())


class _AdaptiveTrunk(nn.Module):
    """What a policy sees and the latent, through an MLP."""

    def __init__(self, trunk: nn.Module, adaptation: RegularizedAdaptation, normalizer: nn.Module | None):
        super().__init__()
        self.trunk, self.adaptation = trunk, adaptation
        self.normalizer = nn.Identity() if normalizer is None else normalizer

    def forward(self, observation: Tensor, privileged: Tensor, history: Tensor) -> Tensor:
        return self.trunk(self.normalizer(observation), self.adaptation(privileged, history))


def roa_actor(
    in_features: int,
    action_size: int,
    privileged_size: int,
    history_size: int,
    *,
    in_keys: tuple[NestedKey, NestedKey, NestedKey] = ("observation", "randomization", "history"),
    latent: int = 20,
    hidden: Sequence[int] = HIDDEN,
    ramp: int = 2000,
    scale: float = 1.0,
    normalizer: nn.Module | None = None,
    device: torch.device | str | None = None,
) -> ProbabilisticActor:
    """Policy as :func:`~torchrl_athletic.networks.actor`, with a latent of :class:`RegularizedAdaptation` beside it.

    Args:
        in_features: Of the observation.
        action_size: A.
        privileged_size: Of what was randomised.
        history_size: Of the flat history.
        in_keys: Observation, what was randomised (``DomainRandomization``'s ``drawn_key``), history; the last may be
            the first again.
        latent: Size of the latent.
        hidden: Layer sizes of the policy.
        ramp: As of :class:`RegularizedAdaptation`: a learner makes ``epochs * minibatches`` passes an iteration.
        scale: First standard deviation, in the action's unit.
        normalizer: What the observation goes through first.
        device: Where its parameters are made.

    Example:
        >>> from tensordict import TensorDict
        >>> policy = roa_actor(3, 2, privileged_size=5, history_size=30)
        >>> seen = {"observation": torch.zeros(4, 3), "randomization": torch.zeros(4, 5), "history": torch.zeros(4, 30)}
        >>> policy(TensorDict(seen, [4]))["action"].shape
        torch.Size([4, 2])
    """
    adaptation = RegularizedAdaptation(privileged_size, history_size, latent, ramp=ramp, device=device)
    trunk = Trunk(in_features + latent, action_size, hidden, device=device)
    head = GaussianHead(_AdaptiveTrunk(trunk, adaptation, normalizer), action_size, scale, device)
    return gaussian_actor(head, in_keys)


def deploy(policy: nn.Module, deployed: bool = True) -> nn.Module:
    """Let a policy take the latent from its history, as on a robot, or again from what was randomised. In place.

    Raises:
        ValueError: If nothing in it adapts.
    """
    found = [module for module in policy.modules() if isinstance(module, RegularizedAdaptation)]
    if not found:
        raise ValueError("the policy holds no RegularizedAdaptation, so nothing adapts. Make it with roa_actor.")
    for module in found:
        module.deployed = deployed
    return policy
