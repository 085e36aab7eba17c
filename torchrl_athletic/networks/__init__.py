"""Actor, critic, Unsupervised Actuator Net and the encoder of Regularized Online Adaptation, as TensorDict modules.

Checkpoints are written and read here too.
"""

from torchrl_athletic.networks.actor_critic import actor, critic, open_inputs, trunk_of
from torchrl_athletic.networks.actuator_net import Sizes, sizes_of, uan, uan_actor
from torchrl_athletic.networks.checkpoint import load_checkpoint, save_checkpoint
from torchrl_athletic.networks.normalizer import RunningNormalizer
from torchrl_athletic.networks.pretrained import (
    describe,
    digest_of,
    pretrained,
    read_metadata,
    read_network,
    shipped_path,
    write_network,
)
from torchrl_athletic.networks.roa import deploy, roa_actor

__all__ = [
    "RunningNormalizer",
    "Sizes",
    "actor",
    "critic",
    "deploy",
    "describe",
    "digest_of",
    "load_checkpoint",
    "open_inputs",
    "pretrained",
    "read_metadata",
    "read_network",
    "roa_actor",
    "save_checkpoint",
    "shipped_path",
    "sizes_of",
    "trunk_of",
    "uan",
    "uan_actor",
    "write_network",
]
