"""Policy and value function as TensorDict modules."""

from __future__ import annotations

from collections.abc import Sequence

import torch
from tensordict import NestedKey
from tensordict.nn import TensorDictModule
from torch import Tensor, nn
from torchrl.modules import MLP, IndependentNormal, ProbabilisticActor, ValueOperator

from torchrl_athletic.networks.normalizer import RunningNormalizer

HIDDEN = (512, 512, 512)
"""Layer sizes of the paper's whole-body controller and its critic."""


class Trunk(nn.Module):
    """Inputs side by side, normalised if asked, through an MLP of ELU layers. (*B, D1), (*B, D2), ... -> (*B, D)."""

    def __init__(
        self,
        in_features: int,
        out_features: int,
        hidden: Sequence[int],
        normalizer: nn.Module | None = None,
        device: torch.device | str | None = None,
    ):
        super().__init__()
        self.normalizer = nn.Identity() if normalizer is None else normalizer
        self.mlp = MLP(in_features, out_features, num_cells=list(hidden), activation_class=nn.ELU, device=device)

    def forward(self, *inputs: Tensor) -> Tensor:
        return self.mlp(self.normalizer(inputs[0] if len(inputs) == 1 else torch.cat(inputs, -1)))


class GaussianHead(nn.Module):
    """A network's output as mean, with a standard deviation that no state changes. -> loc (*B, A), scale (*B, A)."""

    def __init__(self, network: nn.Module, size: int, scale: float, device: torch.device | str | None = None):
        super().__init__()
        self.network = network
        self.log_scale = nn.Parameter(torch.full((size,), scale, device=device).log())

    def forward(self, *inputs: Tensor) -> tuple[Tensor, Tensor]:
        loc = self.network(*inputs)
        return loc, self.log_scale.exp().expand_as(loc)


def actor(
    in_features: int,
    action_size: int,
    *,
    in_keys: Sequence[NestedKey] = ("observation",),
    hidden: Sequence[int] = HIDDEN,
    scale: float = 1.0,
    gain: float = 1.0,
    normalizer: nn.Module | None = None,
    device: torch.device | str | None = None,
) -> ProbabilisticActor:
    """Policy with a Gaussian over actions, whose ``loc`` and ``scale`` stay in the tensordict beside the action.

    It acts on its mean unless exploration is set: TorchRL's collectors do so, in a loop of your own say
    ``with set_exploration_type(ExplorationType.RANDOM)``.

    Args:
        in_features: Of all inputs together.
        action_size: A.
        in_keys: What it sees, put side by side in this order.
        hidden: Layer sizes.
        scale: First standard deviation, in the action's unit; it is learnt, through its logarithm.
        gain: Of the last layer's first weights [1]. Near 0 a new policy acts by 0, which is the default pose
            where an environment counts actions from there (Andrychowicz et al. 2021).
        normalizer: What the inputs go through first, such as ``RunningNormalizer(in_features)``.
        device: Where its parameters are made.

    Returns:
        Module that writes ``loc``, ``scale``, ``action`` (*B, A) and ``action_log_prob`` (*B).

    Source:
        Fey et al. 2025, section IV-A (sizes, ELU), https://arxiv.org/abs/2502.10894; rsl_rl (Gaussian, one learnt
        standard deviation per action).

    Example:
        >>> from tensordict import TensorDict
        >>> policy = actor(5, 2, in_keys=["observation", "command"])
        >>> batch = policy(TensorDict({"observation": torch.zeros(4, 3), "command": torch.zeros(4, 2)}, [4]))
        >>> batch["action"].shape, batch["action_log_prob"].shape
        (torch.Size([4, 2]), torch.Size([4]))
    """
    trunk = Trunk(in_features, action_size, hidden, normalizer, device)
    with torch.no_grad():
        for parameter in trunk.mlp[-1].parameters():
            parameter.mul_(gain)
    return gaussian_actor(GaussianHead(trunk, action_size, scale, device), in_keys)


def trunk_of(network: nn.Module) -> Trunk:
    """Where a network of :func:`actor` or :func:`critic` takes its inputs in.

    Raises:
        ValueError: If it is another network.

    Example:
        >>> trunk_of(actor(5, 2, hidden=(8,))).mlp[0].in_features
        5
    """
    for module in network.modules():
        if isinstance(module, Trunk):
            return module
    raise ValueError(f"{type(network).__name__} has no Trunk. Give a network of networks.actor or networks.critic.")


@torch.no_grad()
def open_inputs(network: nn.Module, columns: Sequence[int] = (), new: Sequence[float] = ()) -> None:
    """Make a trained network deaf to some of its inputs, and add others, so that it may learn to listen to them.

    In pre-training such an input was always 0: weights that it left as they were drawn, and a normaliser that has seen
    no spread, would make a new policy of the first number that comes. With weights of 0 the network does what it did.

    Args:
        network: Of :func:`actor` or :func:`critic`; is changed.
        columns: Inputs to begin with anew.
        new: For each input to add, behind those that it has, what it is divided by where inputs are normalised: its
            usual size, in its own unit.

    Source:
        Fey et al. 2025, section II-C: the task embedding is added for fine-tuning.

    Example:
        >>> from tensordict import TensorDict
        >>> value, seen = critic(2, hidden=(8,)), torch.tensor([[1.0, 2.0, 7.0]])
        >>> before = value(TensorDict(observation=seen[:, :2], batch_size=[1]))["state_value"]
        >>> open_inputs(value, new=[1.0])
        >>> bool((value(TensorDict(observation=seen, batch_size=[1]))["state_value"] == before).all())
        True
    """
    trunk = trunk_of(network)
    first, more = trunk.mlp[0], len(new)
    first.weight[:, list(columns)] = 0.0
    first.weight = nn.Parameter(nn.functional.pad(first.weight, (0, more)), first.weight.requires_grad)
    first.in_features += more
    normalizer = trunk.normalizer
    if isinstance(normalizer, RunningNormalizer):
        normalizer.mean[list(columns)], normalizer.variance[list(columns)] = 0.0, 1.0
        normalizer.mean = nn.functional.pad(normalizer.mean, (0, more))
        normalizer.variance = torch.cat((normalizer.variance, normalizer.variance.new_tensor(new).square()))


def gaussian_actor(head: nn.Module, in_keys: Sequence[NestedKey]) -> ProbabilisticActor:
    """Policy around a network that gives mean and standard deviation."""
    return ProbabilisticActor(
        TensorDictModule(head, in_keys=list(in_keys), out_keys=["loc", "scale"]),
        in_keys=["loc", "scale"],
        distribution_class=IndependentNormal,
        distribution_kwargs={"validate_args": False},  # validation waits for the GPU
        return_log_prob=True,
    )


def critic(
    in_features: int,
    *,
    in_keys: Sequence[NestedKey] = ("observation",),
    hidden: Sequence[int] = HIDDEN,
    normalizer: nn.Module | None = None,
    device: torch.device | str | None = None,
) -> ValueOperator:
    """Value function.

    Args:
        in_features: Of all inputs together.
        in_keys: What it sees, ``privileged`` say, put side by side in this order.
        hidden: Layer sizes.
        normalizer: What the inputs go through first, such as ``RunningNormalizer(in_features)``.
        device: Where its parameters are made.

    Returns:
        Module that writes ``state_value`` [reward] (*B, 1).

    Source:
        Fey et al. 2025, section IV-A: as the policy, with weights of its own, https://arxiv.org/abs/2502.10894.

    Example:
        >>> from tensordict import TensorDict
        >>> critic(3)(TensorDict({"observation": torch.zeros(4, 3)}, [4]))["state_value"].shape
        torch.Size([4, 1])
    """
    return ValueOperator(Trunk(in_features, 1, hidden, normalizer, device), in_keys=list(in_keys))
