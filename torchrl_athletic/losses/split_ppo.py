"""PPO whose actor and critic each take the samples they are given: the actor minibatches, the critic the whole batch.

A small minibatch moves the policy several times an epoch; the whole batch gives the value function a gradient with
less noise. TorchRL's ``ClipPPOLoss`` sums both losses over the same samples, so it cannot give each its own.
"""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager

import torch
from tensordict import NestedKey, TensorDict, TensorDictBase
from tensordict.nn import CompositeDistribution, ProbabilisticTensorDictSequential, TensorDictModuleBase, dispatch
from torch import Tensor
from torch.distributions import Distribution, Normal
from torchrl.modules.distributions.utils import has_analytic_entropy, sample_and_log_prob
from torchrl.objectives import ClipPPOLoss, distance_loss
from torchrl.objectives.common import AUTO_LOSS_MASK_KEYS


def clipped_surrogate(log_ratio: Tensor, advantage: Tensor, low: Tensor, high: Tensor) -> Tensor:
    r"""PPO's pessimistic objective, negated so that descending it improves the policy.

    .. math:: -\min(\rho A,\; \mathrm{clip}(\rho, e^\mathrm{low}, e^\mathrm{high})\, A)

    Args:
        log_ratio: log ρ = log π(a|s) - log π_old(a|s) [nat]. Shape (*B, 1).
        advantage: A, a constant for the gradient [reward]. Shape (*B, 1).
        low: Least log ρ that still earns, log(1 - ε) [nat]. Shape ().
        high: Greatest log ρ that still earns, log(1 + ε) [nat]. Shape ().

    Returns:
        One value per sample [reward]. Shape (*B, 1).

    Source:
        Schulman et al. 2017, eq. 7, https://arxiv.org/abs/1707.06347.

    Example:
        A good action made half again as likely earns no more than 1 + ε = 1.2 times its advantage.

        >>> log_ratio, advantage = torch.tensor([[1.5]]).log(), torch.tensor([[2.0]])
        >>> clipped_surrogate(log_ratio, advantage, torch.tensor(0.8).log(), torch.tensor(1.2).log())
        tensor([[-2.4000]])
    """
    return -torch.minimum(log_ratio.exp() * advantage, log_ratio.clamp(low, high).exp() * advantage)


def gaussian_kl(old_loc: Tensor, old_scale: Tensor, loc: Tensor, scale: Tensor) -> Tensor:
    r"""How far a diagonal Gaussian has moved, KL(old ‖ new).

    .. math:: \sum_i \log\frac{\sigma_i}{\sigma_i'} + \frac{\sigma_i'^2 + (\mu_i' - \mu_i)^2}{2\sigma_i^2} - \frac12

    Args:
        old_loc: Mean μ' of the policy that collected, in the action's unit. Shape (*B, A).
        old_scale: Its standard deviation σ', in the action's unit. Shape (*B, A).
        loc: Mean μ now. Shape (*B, A).
        scale: Standard deviation σ now. Shape (*B, A).

    Returns:
        [nat]. Shape (*B, 1).

    Example:
        >>> one = torch.ones(1, 2)
        >>> gaussian_kl(0 * one, one, one, one)
        tensor([[1.]])
    """
    moved = (old_scale.square() + (old_loc - loc).square()) / (2 * scale.square())
    return ((scale / old_scale).log() + moved - 0.5).sum(-1, keepdim=True)


def sampled_kl(log_ratio: Tensor) -> Tensor:
    r"""Estimate of KL(old ‖ new) from the actions alone, for policies that are not Gaussian.

    .. math:: (\rho - 1) - \log\rho

    Its mean is the divergence if the old policy drew the actions, and no sample is negative, unlike those of
    :math:`-\log\rho`.

    Args:
        log_ratio: log π(a|s) - log π_old(a|s) [nat]. Shape (*B, 1).

    Returns:
        [nat]. Shape (*B, 1).

    Source:
        Schulman 2020, "Approximating KL divergence", estimator k3, http://joschu.net/blog/kl-approx.html.

    Example:
        >>> sampled_kl(torch.zeros(2, 1)).sum()
        tensor(0.)
    """
    return log_ratio.expm1() - log_ratio


def masked_mean(value: Tensor, mask: Tensor | None) -> Tensor:
    """Mean over the samples that count; 0 where none does.

    Args:
        value: Shape (*B, 1).
        mask: True where a sample counts; None if all do. Shape (*B, 1).

    Returns:
        Shape ().

    Example:
        >>> masked_mean(torch.tensor([[1.0], [torch.nan]]), torch.tensor([[True], [False]]))
        tensor(1.)
    """
    if mask is None:
        return value.mean()
    return torch.where(mask, value, 0).sum() / mask.sum().clamp_min(1)


class SplitClipPPOLoss(ClipPPOLoss):
    """``ClipPPOLoss`` in two parts, each of which takes a batch of its own.

    ``loss_actor`` and ``loss_critic`` read a tensordict each and return one; ``forward`` calls both on the same batch
    and then gives ``ClipPPOLoss``'s values and gradients. Keys are renamed with ``set_keys``. No step waits for the
    GPU, so that an update can be captured in a CUDA graph.

    Samples that ``("collector", "mask")`` or ``"shifted_valid"`` excludes (``loss_mask_key`` names another, or None)
    count nowhere, and their advantage, return and log-probability may hold anything.

    The divergence ``kl`` from the collecting policy is exact where the batch holds the ``loc`` and ``scale`` that the
    actor wrote when it acted and the policy is a Gaussian, or a Gaussian behind a fixed map such as ``TanhNormal``.
    Elsewhere it is :func:`sampled_kl`.

    Args:
        actor_network: Policy that gives a distribution, a ``ProbabilisticActor`` say.
        critic_network: Value function; None for an actor alone.
        clip_epsilon: ε, or (ε_low, ε_high) [1].
        entropy_bonus: Whether ``loss_entropy`` is part of the actor's loss.
        samples_mc_entropy: Draws that estimate the entropy of a distribution without a formula for it.
        entropy_coeff: Weight of the entropy [reward/nat].
        critic_coeff: Weight of ``loss_critic``; None or 0 leaves it out of ``forward`` (unlike in ``ClipPPOLoss``,
            where None means 1).
        loss_critic_type: ``"l2"``, ``"l1"`` or ``"smooth_l1"``.
        normalize_advantage: Standardise the advantages of each batch that ``loss_actor`` is given. To do it once over
            all samples, take ``GAE(average_gae=True)`` instead.
        clip_value: How far a value may move from ``state_value`` of the batch before it stops paying [reward]; True
            for ``clip_epsilon``, None not to clip.
        separate_losses: Keep the critic's loss out of parameters shared with the actor.
        functional: Whether parameters are held by the loss, see ``LossModule``.
        reduction: ``"mean"``, ``"sum"`` or ``"none"``.
        log_explained_variance: Whether ``loss_critic`` reports the part of the returns' variance that it explains.

    Source:
        The split: Fey et al. 2025, section III-B, https://arxiv.org/abs/2502.10894. The loss: Schulman et al. 2017.

    Example:
        >>> from torchrl_athletic.networks import actor, critic
        >>> loss = SplitClipPPOLoss(actor(3, 2), critic(3), clip_epsilon=0.2)
        >>> batch = loss.actor_network(TensorDict({"observation": torch.randn(8, 3)}, [8]))
        >>> batch["advantage"], batch["value_target"] = torch.randn(8, 1), torch.randn(8, 1)
        >>> loss.loss_actor(batch[:2].detach())["kl"].item()
        0.0
        >>> sorted(loss.loss_critic(batch.detach()).keys())
        ['explained_variance', 'loss_critic']
    """

    def __init__(
        self,
        actor_network: ProbabilisticTensorDictSequential,
        critic_network: TensorDictModuleBase | None = None,
        *,
        clip_epsilon: float | tuple[float, float] = 0.2,
        entropy_bonus: bool = True,
        samples_mc_entropy: int = 1,
        entropy_coeff: float = 0.01,
        critic_coeff: float | None = 1.0,
        loss_critic_type: str = "smooth_l1",
        normalize_advantage: bool = False,
        clip_value: bool | float | None = None,
        separate_losses: bool = False,
        functional: bool = True,
        reduction: str = "mean",
        log_explained_variance: bool = True,
        device: torch.device | None = None,
    ) -> None:
        super().__init__(
            actor_network,
            critic_network,
            clip_epsilon=clip_epsilon,
            entropy_bonus=entropy_bonus,
            samples_mc_entropy=samples_mc_entropy,
            entropy_coeff=entropy_coeff,
            critic_coeff=None if critic_network is None else critic_coeff or 0.0,
            loss_critic_type=loss_critic_type,
            normalize_advantage=normalize_advantage,
            clip_value=clip_value or None,
            separate_losses=separate_losses,
            functional=functional,
            reduction=reduction,
            log_explained_variance=log_explained_variance,
            device=device,
        )
        if reduction not in ("mean", "sum", "none"):
            raise ValueError(f"reduction is {reduction!r}; give 'mean', 'sum' or 'none'.")

    _out_keys: list[str] | None

    @property
    def out_keys(self) -> list[str]:
        if self._out_keys is None:
            keys = ["loss_objective", "kl", "clip_fraction"]
            keys += ["loss_entropy", "entropy"] if self.entropy_bonus else []
            if self.critic_coeff is not None:
                keys += ["loss_critic"]
                keys += ["value_clip_fraction"] if self.clip_value is not None else []
                keys += ["explained_variance"] if self.log_explained_variance else []
            self._out_keys = [*keys, "ESS", "kl_approx", "max_ratio", "mean_ratio"]
        return self._out_keys

    @out_keys.setter
    def out_keys(self, values: list[str]) -> None:
        self._out_keys = values

    @dispatch
    def forward(self, tensordict: TensorDictBase) -> TensorDict:
        """Both losses of the same samples, with advantages estimated first where the batch has none."""
        tensordict = tensordict.clone(recurse=False)
        if self.tensor_keys.advantage not in tensordict.keys(True):
            if self.critic_network is None:
                self._read(tensordict, self.tensor_keys.advantage)  # which says what is missing
            params = self.critic_network_params.detach() if self.functional else None
            self.value_estimator(tensordict, params=params, target_params=self.target_critic_network_params)
        out = self.loss_actor(tensordict)
        return out.update(self.loss_critic(tensordict)) if self.critic_coeff is not None else out

    def loss_actor(self, batch: TensorDictBase) -> TensorDict:
        """The actor's part: surrogate and entropy, to be added and descended, and what tells how the policy moved.

        Args:
            batch: With the actor's inputs, ``action``, its log-probability and ``advantage`` (*B, 1). Shape (*B).

        Returns:
            Shape (), without gradient but for the losses: ``loss_objective`` [reward], ``loss_entropy`` [reward],
            ``entropy``, ``kl``, ``kl_approx`` [nat], ``clip_fraction``, ``ESS`` (effective share of the samples),
            ``max_ratio``, ``mean_ratio`` [1].

        Raises:
            KeyError: If the batch lacks one of them.
            ValueError: If the advantage lacks its last dimension, since (B,) and (B, 1) would broadcast to (B, B).
        """
        self._refuse_lists()
        advantage = self._read(batch, self.tensor_keys.advantage)
        mask = self.valid(batch, advantage)
        advantage = blank(advantage, mask)
        old_log_prob = self._read(batch, self.tensor_keys.sample_log_prob).unsqueeze(-1)
        if advantage.shape != old_log_prob.shape:
            raise ValueError(
                f"{self.tensor_keys.advantage!r} has shape {tuple(advantage.shape)} and the log-probabilities "
                f"{tuple(old_log_prob.shape)}: they would broadcast to products of unrelated samples. Give the "
                "advantage one value per sample and a last dimension of 1, as GAE does."
            )
        if self.normalize_advantage:
            advantage = standardized(advantage, mask)
        old = self._collecting_distribution(batch)
        with held(self.actor_network_params, self.actor_network):
            dist = self.actor_network.get_dist(batch.clone(recurse=False))
        if isinstance(dist, CompositeDistribution):
            raise _is_composite("the policy's distribution is a CompositeDistribution")
        log_prob = dist.log_prob(self._read(batch, self.tensor_keys.action)).unsqueeze(-1)
        log_ratio = blank(log_prob - old_log_prob, mask)

        low, high = self._clip_bounds
        out = TensorDict({"loss_objective": self._reduced(clipped_surrogate(log_ratio, advantage, low, high), mask)})
        if self.entropy_bonus:
            entropy = self._entropy_of(dist)
            out["loss_entropy"] = self._reduced(-self.entropy_coeff * entropy, mask)
            out["entropy"] = masked_mean(entropy.detach(), mask)
        with torch.no_grad():
            out.update(movement(log_ratio, mask, low, high))
            out["kl"] = masked_mean(divergence(old, dist, log_ratio), mask)
        return out

    def loss_critic(self, batch: TensorDictBase) -> TensorDict:
        """The critic's part: distance between values and returns, times ``critic_coeff``.

        Args:
            batch: With the critic's inputs and ``value_target`` (*B, 1), and ``state_value`` if values are clipped.
                Shape (*B).

        Returns:
            Shape (): ``loss_critic``, and without gradient ``value_clip_fraction``, ``explained_variance`` [1].

        Raises:
            KeyError: If the batch lacks one of them.
            RuntimeError: If the loss was built without a critic.
        """
        if self.critic_network is None:
            raise RuntimeError("this loss was built without a critic. Give SplitClipPPOLoss a critic_network.")
        target = self._read(batch, self.tensor_keys.value_target)
        mask = self.valid(batch, target)
        target = blank(target, mask)
        given = batch.detach() if self.separate_losses else batch.clone(recurse=False)
        with held(self.critic_network_params, self.critic_network):
            value = self.critic_network(given).get(self.tensor_keys.value)
        loss = distance_loss(target, value, self.loss_critic_type)
        out = TensorDict()
        if self.clip_value is not None:
            old = blank(self._read(batch, self.tensor_keys.value), mask)
            moved = (value - old).clamp(-self.clip_value, self.clip_value)
            loss = torch.maximum(loss, distance_loss(target, old + moved, self.loss_critic_type))
            out["value_clip_fraction"] = masked_mean((moved != value - old).to(value.dtype), mask)
        out["loss_critic"] = self._reduced(loss if self.critic_coeff is None else self.critic_coeff * loss, mask)
        if self.log_explained_variance:
            out["explained_variance"] = explained_variance(value.detach(), target.detach(), mask)
        return out

    def valid(self, batch: TensorDictBase, like: Tensor | None = None) -> Tensor | None:
        """Which samples count: every mask of ``loss_mask_key`` that the batch holds, or None if it holds none.

        Args:
            batch: Shape (*B).
            like: What is to be masked: with several agents a sample has a value for each. Shape (*B, ..., 1).

        Returns:
            Bool. Shape (*B, 1), or that of ``like``.
        """
        mask = None
        for name in self.mask_keys:
            found = batch.get(name, None)
            if found is not None:
                found = found.reshape(*batch.batch_size, 1)
                mask = found if mask is None else mask & found
        if mask is None or like is None:
            return mask
        return mask.reshape(*batch.batch_size, *[1] * (like.ndim - batch.ndim)).expand(like.shape)

    @property
    def mask_keys(self) -> tuple[NestedKey, ...]:
        """Where ``valid`` looks, as ``loss_mask_key`` tells."""
        key = self.loss_mask_key
        return () if key is None else AUTO_LOSS_MASK_KEYS if key == "auto" else (key,)

    def _collecting_distribution(self, batch: TensorDictBase) -> Distribution | None:
        """Distribution of the policy that acted, if the batch remembers its parameters."""
        keys = self.actor_network.dist_params_keys
        if any(batch.get(key, None) is None for key in keys):
            return None
        return self.actor_network.build_dist_from_params(batch.select(*keys))

    def _refuse_lists(self) -> None:
        for name in ("action", "sample_log_prob"):
            if not isinstance(key := getattr(self.tensor_keys, name), (str, tuple)):
                raise _is_composite(f"{name} is {key!r}, several keys")

    def _entropy_of(self, dist: Distribution) -> Tensor:
        """Shape (*B, 1)."""
        if has_analytic_entropy(dist):
            return dist.entropy().unsqueeze(-1)
        draws = (self.samples_mc_entropy,)
        _, log_prob = sample_and_log_prob(dist, draws, reparameterize=dist.has_rsample)
        return -log_prob.mean(0).unsqueeze(-1)

    def _reduced(self, value: Tensor, mask: Tensor | None) -> Tensor:
        if self.reduction == "mean":
            return masked_mean(value, mask)
        value = blank(value, mask)
        return value.sum() if self.reduction == "sum" else value.squeeze(-1)

    def _read(self, batch: TensorDictBase, key: NestedKey) -> Tensor:
        value = batch.get(key, None)
        if value is None:
            raise KeyError(
                f"the batch has no {key!r}, only {sorted(map(str, batch.keys(True, True)))}. Write it before the "
                "update (advantage and value_target come from GAE, the log-probability from an actor with "
                "return_log_prob=True), or name it with set_keys."
            )
        if not isinstance(value, Tensor):
            raise _is_composite(f"{key!r} holds a {type(value).__name__}")
        if value.requires_grad:
            raise RuntimeError(f"{key!r} of the batch requires a gradient, but it is data. Detach the batch.")
        return value


def _is_composite(what: str) -> TypeError:
    return TypeError(f"{what}, but SplitClipPPOLoss takes one tensor of actions: take ClipPPOLoss.")


@contextmanager
def held(params: TensorDictBase | None, module: TensorDictModuleBase) -> Iterator[None]:
    """Run a module with the parameters that the loss holds, if it holds them."""
    if params is None:
        yield
    else:
        with params.to_module(module, preserve_module_state=False):
            yield


def blank(value: Tensor, mask: Tensor | None) -> Tensor:
    """Zero what does not count, before a NaN in it can reach a gradient. Shape (*B, 1)."""
    return value if mask is None else torch.where(mask, value, 0)


def standardized(value: Tensor, mask: Tensor | None) -> Tensor:
    """Mean 0 and standard deviation 1 over the samples that count; one alone has no spread and stays. Shape (*B, 1)."""
    count = torch.ones_like(value, dtype=torch.bool).sum() if mask is None else mask.sum()
    centred = blank(value - masked_mean(value, mask), mask)
    scale = (centred.square().sum() / (count - 1).clamp_min(1)).sqrt()
    return torch.where(count > 1, centred / scale.clamp_min(1e-6), blank(value, mask))


def explained_variance(value: Tensor, target: Tensor, mask: Tensor | None = None) -> Tensor:
    """1 - Var(target - value) / Var(target): 1 for a perfect critic, 0 for one that knows the mean. Shape ()."""
    error = target - value
    unexplained = masked_mean((error - masked_mean(error, mask)).square(), mask)
    total = masked_mean((target - masked_mean(target, mask)).square(), mask)
    return 1 - unexplained / (total + torch.finfo(total.dtype).eps)


def movement(log_ratio: Tensor, mask: Tensor | None, low: Tensor, high: Tensor) -> TensorDict:
    """What tells how far the policy is from the one that collected. Shape ()."""
    counted = log_ratio if mask is None else log_ratio.masked_fill(~mask, -torch.inf)
    counted = counted.flatten()
    count = counted.isfinite().sum() if mask is None else mask.sum()
    ess = (2 * counted.logsumexp(0) - (2 * counted).logsumexp(0)).exp() / count
    outside = (log_ratio < low) | (log_ratio > high)
    return TensorDict(
        {
            "clip_fraction": masked_mean(outside.to(log_ratio.dtype), mask),
            "kl_approx": masked_mean(-log_ratio, mask),
            "ESS": torch.where(count > 0, ess, 0),
            "max_ratio": counted.max().exp(),
            "mean_ratio": masked_mean(log_ratio.exp(), mask),
        }
    )


def divergence(old: Distribution | None, new: Distribution, log_ratio: Tensor) -> Tensor:
    """KL(old ‖ new) [nat], exact for Gaussians, else estimated from the actions. Shape (*B, 1)."""
    before, after = gaussian_of(old), gaussian_of(new)
    if before is None or after is None:
        return sampled_kl(log_ratio)
    return gaussian_kl(before.loc, before.scale, after.loc, after.scale)


def gaussian_of(dist: Distribution | None) -> Normal | None:
    """The Gaussian beneath a distribution: a map that both policies share leaves their divergence as it is."""
    while dist is not None and not isinstance(dist, Normal):
        dist = getattr(dist, "base_dist", None)
    return dist
