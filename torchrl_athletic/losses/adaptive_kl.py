"""A learning rate that keeps each step of the policy about as long as it should be."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor


@dataclass(frozen=True)
class AdaptiveKL:
    """Change a learning rate in place by how far the policy has moved.

    Farther than twice the target, the rate is divided by ``factor``; not even half as far, it is multiplied. A policy
    that has not moved, and a divergence that is not a number, leave it alone; a rate of 0 stays. TorchRL's
    ``KLAdaptiveLR`` follows the same rule but reads the divergence on the host and puts a new object in the optimiser's
    place; this one stays on the rate's device, so that a captured CUDA graph goes on seeing it.

    Args:
        target: Wanted divergence of the policy from the one that collected [nat]. A tensor may be changed in place, and
            a captured graph sees it.
        factor: > 1 [1].
        bounds: Least and greatest learning rate.

    Raises:
        ValueError: If an argument is out of its range.

    Source:
        rsl_rl, ``PPO.update`` with ``schedule="adaptive"``; Rudin et al. 2021, https://arxiv.org/abs/2109.11978.
        Target: Fey et al. 2025, table "PPO Hyperparameters".

    Example:
        >>> rate = torch.tensor(3e-4)
        >>> AdaptiveKL(target=0.01)(rate, torch.tensor(0.05))
        >>> rate
        tensor(0.0002)
    """

    target: float | Tensor = 0.01
    factor: float = 1.5
    bounds: tuple[float, float] = (1e-5, 1e-2)

    def __post_init__(self) -> None:
        if not self.target > 0:
            raise ValueError(f"target is {self.target}, but a divergence cannot be held at or below 0. Give 0.01.")
        if not self.factor > 1:
            raise ValueError(f"factor is {self.factor}, so a policy too slow would be slowed down. Give more than 1.")
        if not 0 < self.bounds[0] <= self.bounds[1]:
            raise ValueError(f"bounds are {self.bounds}; give the least learning rate first, more than 0.")

    def __call__(self, rate: Tensor, kl: Tensor) -> None:
        """Change ``rate`` in place.

        Args:
            rate: Learning rate [1]. Shape ().
            kl: Mean divergence KL(old ‖ new) [nat]. Shape ().
        """
        least, greatest = self.bounds
        slower = (rate / self.factor).clamp_min(least)
        faster = (rate * self.factor).clamp_max(greatest)
        too_slow, too_fast = (kl > 0) & (kl < self.target / 2), (kl > 2 * self.target) & (rate > 0)
        rate.copy_(torch.where(too_fast, slower, torch.where(too_slow, faster, rate)))
