"""The whole update of split PPO: epochs, minibatches, two optimisers, and on a GPU all of it in one CUDA graph."""

from __future__ import annotations

import warnings
from collections.abc import Callable, Sequence
from typing import Any

import torch
from tensordict import NestedKey, TensorDict, TensorDictBase
from torch import Tensor, nn
from torchrl.trainers import OptimizationStepper, Trainer

from torchrl_athletic.losses.adaptive_kl import AdaptiveKL
from torchrl_athletic.losses.split_ppo import SplitClipPPOLoss, explained_variance

Average = Callable[[Sequence[Tensor], Tensor | None], None]
"""Replaces tensors by their means over the processes that train together, weighted by the second argument."""


SEEN = "_seen"
"""Entry of a step's report: whether any of its samples counts."""


class SplitOptimizationStepper(OptimizationStepper):
    """Several epochs over one batch: minibatches move the actor, all samples together move the critic.

    In a plain loop call :meth:`update`. In TorchRL's ``Trainer`` pass it as ``optimization_stepper``, with
    ``num_epochs=1`` and ``optim_steps_per_batch=1``, because the epochs are its own.

    The critic's batch is walked in micro-batches whose gradients add up to that of the whole, so that memory is bounded
    by ``micro_batch``. Nothing waits for the GPU, and ``cuda_graph=True`` captures the update at its first call; batch
    sizes must then stay as they are, or it is captured again. Matrix products take TF32 if you say
    ``torch.set_float32_matmul_precision("high")`` before the first update: several times faster on a data-centre GPU,
    with 10 bits of mantissa.

    Args:
        loss: Whose networks are trained; actor and critic may not share parameters.
        actor_lr: First learning rate of the actor; 1e-3 in training from scratch, 1e-5 in the paper's fine-tuning.
        critic_lr: Learning rate of the critic.
        adaptive_kl: What changes the actor's learning rate before each of its steps; None keeps it.
        weight_decay: Of AdamW, for both [1].
        epochs: Passes over the batch.
        minibatches: Actor steps in each epoch.
        critic_minibatches: Critic steps in each epoch; 1 is the paper's whole batch, ``minibatches`` is common PPO.
        micro_batch: Most samples that go through the critic at once; None for no limit.
        max_grad_norm: Longest gradient of each network, longer ones are scaled down; None for no limit.
        seed: Of the order in which samples are drawn.
        cuda_graph: Capture the update in a CUDA graph, on a GPU only.
        in_place: Entries that later batches hold in the same memory, as a :class:`~.training.Rollout`'s do: the graph
            reads them there instead of a copy of its own. Should they move, the update is captured again.
        average: For several processes that train one policy on a batch each, :meth:`.Processes.average_`: gradients,
            divergences and reports are then those of all batches together. On a GPU it is captured with the rest.

    Raises:
        ValueError: If the networks share parameters, or an argument is out of its range.

    Source:
        Fey et al. 2025, section III-B and table "PPO Hyperparameters", https://arxiv.org/abs/2502.10894.

    Example:
        >>> from torchrl_athletic.networks import actor, critic
        >>> stepper = SplitOptimizationStepper(SplitClipPPOLoss(actor(3, 2), critic(3)), epochs=2)
        >>> batch = stepper.loss.actor_network(TensorDict({"observation": torch.randn(64, 3)}, [64])).detach()
        >>> batch["advantage"], batch["value_target"] = torch.randn(64, 1), torch.randn(64, 1)
        >>> bool(stepper.update(batch)["kl"] > 0)
        True
    """

    def __init__(
        self,
        loss: SplitClipPPOLoss,
        *,
        actor_lr: float = 1e-3,
        critic_lr: float = 5e-4,
        adaptive_kl: AdaptiveKL | None = AdaptiveKL(),  # noqa: B008  frozen
        weight_decay: float = 0.01,
        epochs: int = 5,
        minibatches: int = 4,
        critic_minibatches: int = 1,
        micro_batch: int | None = 24_576,
        max_grad_norm: float | None = 1.0,
        seed: int = 0,
        cuda_graph: bool = False,
        in_place: Sequence[NestedKey] = (),
        average: Average | None = None,
    ) -> None:
        counts = {"epochs": epochs, "minibatches": minibatches, "critic_minibatches": critic_minibatches}
        for name, count in counts.items():
            if count < 1:
                raise ValueError(f"{name} is {count}, so nothing would be learnt. Give 1 or more.")
        if micro_batch is not None and micro_batch < 1:
            raise ValueError(f"micro_batch is {micro_batch}; give 1 sample or more, or None for no limit.")
        if adaptive_kl is not None and not adaptive_kl.bounds[0] <= actor_lr <= adaptive_kl.bounds[1]:
            raise ValueError(
                f"actor_lr is {actor_lr}, outside {adaptive_kl.bounds}, so that the first change would be a jump. "
                "Start within the bounds of adaptive_kl, or widen them."
            )
        if loss.reduction != "mean":
            raise ValueError(f"the loss has reduction={loss.reduction!r}, but micro-batches add up means: take 'mean'.")
        if loss.critic_network is None:
            raise ValueError("the loss has no critic to train. Give SplitClipPPOLoss a critic_network.")
        if average is not None and loss.normalize_advantage:
            raise ValueError(
                "normalize_advantage=True standardises the minibatch of each process by itself, so that gradients do "
                "not add up to that of one batch. Standardise all advantages before: training.standardized."
            )
        self.loss = loss
        self.adaptive_kl = adaptive_kl
        self.epochs = epochs
        self.minibatches = minibatches
        self.critic_minibatches = critic_minibatches
        self.micro_batch = micro_batch
        self.max_grad_norm = float("inf") if max_grad_norm is None else max_grad_norm
        # a copied loss runs with the parameters that it holds, not with those in its networks
        self.actor_parameters = trainable(loss.actor_network_params if loss.functional else loss.actor_network)
        self.critic_parameters = trainable(loss.critic_network_params if loss.functional else loss.critic_network)
        for name, found in (("actor", self.actor_parameters), ("critic", self.critic_parameters)):
            if not found:
                raise ValueError(
                    f"the {name} has no parameter that may learn. Load it with trainable=True (networks.pretrained, "
                    "networks.read_network), or let its parameters require gradients."
                )
        if {id(p) for p in self.actor_parameters} & {id(p) for p in self.critic_parameters}:
            raise ValueError(
                "actor and critic share parameters, which two optimisers would pull in turn. Give each its own "
                "network, or train with ClipPPOLoss and one optimiser."
            )
        self.device = self.actor_parameters[0].device
        if cuda_graph and self.device.type != "cuda":
            raise ValueError(f"cuda_graph=True, but the actor is on {self.device}. Move the networks to CUDA first.")
        self.cuda_graph, self.in_place, self.average = cuda_graph, tuple(in_place), average
        self.actor_lr = torch.tensor(actor_lr, device=self.device)
        self.critic_lr = torch.tensor(critic_lr, device=self.device)
        self.actor_optimizer = adamw(self.actor_parameters, self.actor_lr, weight_decay)
        self.critic_optimizer = adamw(self.critic_parameters, self.critic_lr, weight_decay)
        self.generator = torch.Generator(self.device).manual_seed(seed)
        self._graph: torch.cuda.CUDAGraph | None = None

    def update(self, batch: TensorDictBase) -> TensorDict:
        """Train on a batch, whatever its leading dims: samples are shuffled one by one, so no network may be recurrent.

        Args:
            batch: What ``loss`` reads: the networks' inputs, ``action``, its log-probability, ``advantage``,
                ``value_target``; ``loc`` and ``scale`` for the exact divergence. Shape (*B).

        Returns:
            Means over the steps of all that the losses report, ``actor_grad_norm`` and ``critic_grad_norm`` before
            clipping, ``actor_lr`` and ``critic_lr`` at the end, and ``explained_variance`` of the values before the
            update if the batch holds ``state_value``. Shape ().
        """
        data = self._inputs(batch)
        if data.numel() < max(self.minibatches, self.critic_minibatches):
            raise ValueError(
                f"the batch has {data.numel()} samples for {self.minibatches} minibatches of the actor and "
                f"{self.critic_minibatches} of the critic: some would be empty. Collect more, or take fewer."
            )
        order = self._order(data.numel())
        if not self.cuda_graph:
            return self._optimize(data, order)
        if self._anywhere(self._graph is None or not self._fits(data)):
            self.capture(batch)
        self._static.update_(data.exclude(*self.in_place))
        self._static_order.copy_(order)
        assert self._graph is not None
        self._graph.replay()
        return self._static_report.clone()

    def __deepcopy__(self, memo: dict[int, Any]) -> SplitOptimizationStepper:
        """Refused: optimisers of a copy would move the original's parameters, or none."""
        raise TypeError(
            "a SplitOptimizationStepper cannot be copied. Copy its loss, build another stepper of the copy, and hand "
            "it this one's state_dict()."
        )

    def step(self, trainer: Trainer, sub_batch: TensorDictBase) -> TensorDict:
        """What TorchRL's ``Trainer`` calls; the same as :meth:`update`."""
        return self.update(sub_batch)

    def capture(self, batch: TensorDictBase) -> None:
        """Capture an update of batches like this one in a CUDA graph; networks and optimisers stay as they are.

        :meth:`update` does so at its first call if ``cuda_graph`` is set. The graph reads and writes the parameters
        where they are: copy values into them, do not replace them. A policy whose distribution validates its arguments
        waits for the GPU and cannot be captured: give it ``distribution_kwargs={"validate_args": False}``.

        Raises:
            RuntimeError: If the networks are not on a GPU.
        """
        if self.device.type != "cuda":
            raise RuntimeError(f"a CUDA graph needs the networks on a GPU, they are on {self.device}.")
        data = self._inputs(batch)
        self._static = data.exclude(*self.in_place).clone().update(data.select(*self.in_place, strict=False))
        count = self._static.numel()
        self._static_order = torch.arange(count, device=self.device).expand(self.epochs, count).contiguous()
        saved = [tensor.detach().clone() for tensor in self._trained()]
        stream = torch.cuda.Stream(self.device)
        stream.wait_stream(torch.cuda.current_stream(self.device))
        with torch.cuda.stream(stream):  # libraries choose their kernels and workspaces here, not in the capture
            self._optimize(self._static, self._static_order)
        torch.cuda.current_stream(self.device).wait_stream(stream)
        with torch.no_grad():
            for tensor, before in zip(self._trained(), saved, strict=True):
                tensor.copy_(before)
        self.actor_optimizer.zero_grad()
        self.critic_optimizer.zero_grad()
        torch.cuda.synchronize(self.device)
        graph = torch.cuda.CUDAGraph()
        with torch.cuda.graph(graph, stream=stream, capture_error_mode="thread_local"):
            self._static_report = self._optimize(self._static, self._static_order)
        self._graph, self.cuda_graph = graph, True

    def release(self) -> None:
        """Forget what was captured; the next update captures anew."""
        self._graph = None

    def _fits(self, data: TensorDict) -> bool:
        """Whether the batch has its size, and entries that the graph reads where they were captured still are there."""
        if self._static.batch_size != data.batch_size:
            return False
        kept = data.select(*self.in_place, strict=False)
        return all(kept.get(key).data_ptr() == self._static.get(key).data_ptr() for key in kept.keys(True, True))

    def _anywhere(self, needed: bool) -> bool:
        """Whether some process captures: then all do, since a capture exchanges gradients. Asks hosts, no GPU."""
        if self.average is None:
            return needed
        share = torch.tensor(float(needed))
        self.average([share], None)
        return bool(share > 0)

    def state_dict(self) -> dict[str, Any]:
        """Optimisers, learning rates and the order of samples to come; the networks have a state of their own."""
        return {
            "actor_optimizer": self.actor_optimizer.state_dict(),
            "critic_optimizer": self.critic_optimizer.state_dict(),
            "generator": self.generator.get_state(),
        }

    def load_state_dict(self, state_dict: dict[str, Any]) -> None:
        """Go on where :meth:`state_dict` was taken."""
        load_optimizer(self.actor_optimizer, self.actor_lr, state_dict["actor_optimizer"])
        load_optimizer(self.critic_optimizer, self.critic_lr, state_dict["critic_optimizer"])
        self.generator.set_state(state_dict["generator"].cpu())
        self.release()  # it would go on with the optimisers' old tensors

    def _optimize(self, data: TensorDict, order: Tensor) -> TensorDict:
        """All epochs, in the order given: (epochs, B) indices."""
        actor_reports, critic_reports = [], []
        actor_data, critic_data = data.select(*self._actor_keys(data)), data.select(*self._critic_keys(data))
        for epoch in order.unbind():
            for index in epoch.tensor_split(self.minibatches):
                actor_reports.append(self._step_actor(actor_data[index]))
            if self.critic_minibatches == 1:  # all samples, in any order: spare the copy
                critic_reports.append(self._step_critic(critic_data))
                continue
            for index in epoch.tensor_split(self.critic_minibatches):
                critic_reports.append(self._step_critic(critic_data[index]))
        report = mean_of(actor_reports).update(mean_of(critic_reports))
        report["actor_lr"], report["critic_lr"] = self.actor_lr.clone(), self.critic_lr.clone()
        keys = self.loss.tensor_keys
        if keys.value in data.keys(True):
            mask = self.loss.valid(data, data[keys.value])
            report["explained_variance"] = explained_variance(data[keys.value], data[keys.value_target], mask)
        return report

    def _step_actor(self, minibatch: TensorDict) -> TensorDict:
        self.actor_optimizer.zero_grad()
        report = self.loss.loss_actor(minibatch)
        loss = report["loss_objective"]
        (loss + report["loss_entropy"] if self.loss.entropy_bonus else loss).backward()
        report = report.detach().update(self._seen(minibatch))
        self._exchange(self.actor_parameters, report, minibatch)
        if self.adaptive_kl is not None:
            self.adaptive_kl(self.actor_lr, report["kl"])
        report["actor_grad_norm"] = nn.utils.clip_grad_norm_(self.actor_parameters, self.max_grad_norm)
        self.actor_optimizer.step()
        return report

    def _step_critic(self, batch: TensorDict) -> TensorDict:
        self.critic_optimizer.zero_grad()
        pieces = batch.split(min(self.micro_batch or batch.numel(), batch.numel()))
        count = self._count(batch)
        reports = []
        for piece in pieces:
            report = self.loss.loss_critic(piece).exclude("explained_variance") * (self._count(piece) / count)
            report["loss_critic"].backward()
            reports.append(report.detach())
        total: TensorDict = sum(reports[1:], reports[0])
        total.update(self._seen(batch))
        self._exchange(self.critic_parameters, total, batch)
        total["critic_grad_norm"] = nn.utils.clip_grad_norm_(self.critic_parameters, self.max_grad_norm)
        self.critic_optimizer.step()
        return total

    def _exchange(self, parameters: list[nn.Parameter], report: TensorDict, batch: TensorDict) -> None:
        """Make gradients and report those of the minibatches of all processes, by how many samples count in each."""
        if self.average is None:
            return
        gradients = [parameter.grad for parameter in parameters if parameter.grad is not None]
        mask = self.loss.valid(batch)
        self.average([*gradients, *report.values()], None if mask is None else mask.sum(dtype=gradients[0].dtype))

    def _count(self, batch: TensorDict) -> Tensor | int:
        """Samples that count; on a GPU the host need not know."""
        mask = self.loss.valid(batch)
        return batch.numel() if mask is None else mask.sum(dtype=self.critic_parameters[0].dtype).clamp_min(1)

    def _seen(self, batch: TensorDict) -> dict[str, Tensor]:
        """One if any sample counts, zero if none, where a mask tells."""
        mask = self.loss.valid(batch)
        return {} if mask is None else {SEEN: mask.any().to(self.actor_parameters[0].dtype)}

    def _order(self, count: int) -> Tensor:
        """A permutation of the samples for each epoch, drawn outside the graph. Shape (epochs, B)."""
        return torch.rand((self.epochs, count), generator=self.generator, device=self.device).argsort(-1)

    def _inputs(self, batch: TensorDictBase) -> TensorDict:
        """What the losses read, one sample a row, without the rest of a collector's batch."""
        keys = dict.fromkeys([*self._actor_keys(batch), *self._critic_keys(batch)])
        return batch.select(*keys).reshape(-1).detach().to(self.device)

    def _actor_keys(self, batch: TensorDictBase) -> list[NestedKey]:
        keys, actor = self.loss.tensor_keys, self.loss.actor_network
        return present(
            batch,
            [
                *actor.in_keys,
                keys.action,
                keys.sample_log_prob,
                keys.advantage,
                *actor.dist_params_keys,
                *self.loss.mask_keys,
            ],
        )

    def _critic_keys(self, batch: TensorDictBase) -> list[NestedKey]:
        keys = self.loss.tensor_keys
        return present(batch, [*self.loss.critic_network.in_keys, keys.value_target, keys.value, *self.loss.mask_keys])

    def _trained(self) -> list[Tensor]:
        """Every tensor that an update changes."""
        optimizers = (self.actor_optimizer, self.critic_optimizer)
        moments = [value for optimizer in optimizers for state in optimizer.state.values() for value in state.values()]
        return [*self.actor_parameters, *self.critic_parameters, self.actor_lr, self.critic_lr, *moments]


def trainable(module: nn.Module) -> list[nn.Parameter]:
    return [parameter for parameter in module.parameters() if parameter.requires_grad]


def adamw(parameters: list[nn.Parameter], rate: Tensor, weight_decay: float) -> torch.optim.AdamW:
    """AdamW whose rate is a tensor and whose moments exist from the start, as a CUDA graph needs them."""
    on_gpu = rate.device.type == "cuda"
    optimizer = torch.optim.AdamW(parameters, lr=rate, weight_decay=weight_decay, fused=True, capturable=on_gpu)
    first = rate.clone()
    rate.zero_()  # a step of no length makes the moments
    for parameter in parameters:
        parameter.grad = torch.zeros_like(parameter)
    with warnings.catch_warnings():
        warnings.filterwarnings("ignore", message=".*capturable")  # it steps outside a graph, and may stay there
        optimizer.step()
    optimizer.zero_grad()
    rate.copy_(first)
    for state in optimizer.state.values():
        state["step"].zero_()
    return optimizer


def load_optimizer(optimizer: torch.optim.Optimizer, rate: Tensor, state: dict[str, Any]) -> None:
    """Load a state but keep the rate's tensor, which others hold, and what depends on the GPU."""
    (group,) = optimizer.param_groups
    capturable = group["capturable"]
    optimizer.load_state_dict(state)
    (group,) = optimizer.param_groups
    rate.copy_(torch.as_tensor(group["lr"]))
    group.update(lr=rate, capturable=capturable)


def present(batch: TensorDictBase, keys: list[NestedKey]) -> list[NestedKey]:
    """Those that the batch holds, each once; the loss says which it misses."""
    held = batch.keys(include_nested=True)
    return [key for key in dict.fromkeys(keys) if key in held]


def mean_of(reports: list[TensorDict]) -> TensorDict:
    """Mean over the steps, those left out of which no sample counts."""
    if SEEN not in reports[0].keys():
        return torch.stack(reports).mean(0)
    seen = torch.stack([report[SEEN] for report in reports])
    parts = [
        report.exclude(SEEN) * share for report, share in zip(reports, seen / seen.sum().clamp_min(1), strict=True)
    ]
    total: TensorDict = sum(parts[1:], parts[0])
    return total
