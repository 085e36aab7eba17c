"""PPO with minibatches of their own for actor and critic, a learning rate that follows the KL divergence, the stepper.

The terms are functions of tensors and the modules only fetch them. Like ``transforms``, this room knows torch,
tensordict and TorchRL alone, and is linked at the root of the repository.
"""

from torchrl_athletic.losses.adaptive_kl import AdaptiveKL
from torchrl_athletic.losses.split_ppo import SplitClipPPOLoss, clipped_surrogate, gaussian_kl, sampled_kl
from torchrl_athletic.losses.stepper import SplitOptimizationStepper

__all__ = [
    "AdaptiveKL",
    "SplitClipPPOLoss",
    "SplitOptimizationStepper",
    "clipped_surrogate",
    "gaussian_kl",
    "sampled_kl",
]
