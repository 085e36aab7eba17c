"""Observations brought to mean 0 and standard deviation 1 by what has been seen so far."""

from __future__ import annotations

from collections.abc import Callable

import torch
from torch import Tensor, nn


def moments(value: Tensor) -> tuple[Tensor, Tensor, int]:
    """Mean (D,), variance without correction (D,) and number of samples, (B, D)."""
    variance, mean = torch.var_mean(value, 0, correction=0)
    return mean, variance, len(value)


class RunningNormalizer(nn.Module):
    r"""Subtract the running mean and divide by the running standard deviation.

    It learns only when :meth:`update` is called, not in ``forward``: call it after the PPO update and before the next
    collection, so that the policy that learns is the policy that acted. Its statistics are buffers that are changed in
    place by torch operations alone, without a wait for the GPU (``VecNormV2`` waits at every call), so that it lives
    in CUDA graphs and in ``state_dict``.

    Args:
        size: Length of the last dimension, D.
        clip: Largest absolute value that leaves [1].
        eps: Smallest standard deviation, in the observation's unit.

    Source:
        Merging of moments: Chan, Golub, LeVeque 1979, eq. 2.1.

    Example:
        >>> normalizer = RunningNormalizer(1)
        >>> normalizer.update(torch.tensor([[1.0], [3.0]]))
        >>> normalizer(torch.tensor([[3.0]]))
        tensor([[1.]])
    """

    mean: Tensor
    variance: Tensor
    count: Tensor

    def __init__(self, size: int, clip: float = 10.0, eps: float = 1e-2, device: torch.device | str | None = None):
        super().__init__()
        self.clip = clip
        self.eps = eps
        self.register_buffer("mean", torch.zeros(size, device=device))
        self.register_buffer("variance", torch.ones(size, device=device))
        self.register_buffer("count", torch.zeros((), dtype=torch.float64, device=device))
        """Samples so far; of 400 million, 32 bits would not see that 16 more have come, as a small training's do."""

    def forward(self, value: Tensor) -> Tensor:
        """Shape (*B, D), as given."""
        return ((value - self.mean) / self.variance.sqrt().clamp_min(self.eps)).clamp(-self.clip, self.clip)

    @torch.no_grad()
    def update(self, value: Tensor, moments: Callable[[Tensor], tuple[Tensor, Tensor, Tensor | int]] = moments) -> None:
        """Learn from samples.

        Args:
            value: Shape (*B, D).
            moments: What finds mean, variance and number of samples (B, D); processes that train together take
                :meth:`.Processes.moments`, which finds those of all.

        Raises:
            ValueError: If the last dimension is not D.
        """
        if value.shape[-1:] != self.mean.shape:
            raise ValueError(
                f"the normalizer was built for {self.mean.numel()} features, but the samples have shape "
                f"{tuple(value.shape)}. Build it with size={value.shape[-1]}, or give the samples it was built for."
            )
        mean, variance, count = moments(value.reshape(-1, value.shape[-1]))
        total = self.count + count
        delta = mean - self.mean
        share = (count / total).to(self.mean.dtype)
        self.variance.lerp_(variance, share).add_(delta.square() * share * (1 - share))
        self.mean.add_(delta * share)
        self.count.copy_(total)
