"""The training loop: collect, estimate advantages, update; each of them one line that can be replaced."""

from __future__ import annotations

import time
import warnings
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial
from typing import Any

import torch
from tensordict import NestedKey, TensorDict, TensorDictBase
from tensordict.nn import ProbabilisticTensorDictSequential, TensorDictModuleBase
from torch import Tensor
from torchrl.envs import EnvBase
from torchrl.objectives.value import GAE
from tqdm import tqdm

from torchrl_athletic.losses import AdaptiveKL, SplitClipPPOLoss, SplitOptimizationStepper
from torchrl_athletic.networks import RunningNormalizer
from torchrl_athletic.physics import CapacityError
from torchrl_athletic.training.captured import CapturedRollout
from torchrl_athletic.training.checkpoint import Checkpoints
from torchrl_athletic.training.distributed import (
    ALONE,
    Processes,
    check_finite_everywhere,
    check_seeds_differ,
    standardized,
)
from torchrl_athletic.training.finite import check_finite
from torchrl_athletic.training.logging import MetricLogger
from torchrl_athletic.training.rollout import Rollout, under_next
from torchrl_athletic.transforms.stateful import base_env_of


@dataclass(frozen=True)
class PPO:
    """What is chosen by hand; the defaults are the paper's for pre-training, from scratch.

    Source:
        Fey et al. 2025, table "PPO Hyperparameters", https://arxiv.org/abs/2502.10894. What the table leaves out is
        that of rsl_rl, on which the paper builds: clipping at 0.2, gradients of length 1, advantages standardised over
        the batch.
    """

    discount: float = 0.99
    """Discount of the reward one step later, γ [1]."""
    gae_lambda: float = 0.95
    """Decay λ of the generalised advantage estimate [1]."""
    entropy_coeff: float = 0.01
    """Weight of the policy's entropy [reward/nat]."""
    actor_lr: float = 1e-3
    """First learning rate of the actor, which adapts."""
    least_actor_lr: float = 1e-5
    """Rate that it adapts down to, at most the first one. rsl_rl's is the one that a task is tuned with, which so
    cannot fall: the sled's divergence stayed at 0.008 where 0.001 was asked for."""
    critic_lr: float = 5e-4
    """Learning rate of the critic."""
    kl_target: float = 0.01
    """Divergence of policies that the actor's learning rate aims at [nat]."""
    kl_target_last: float | None = None
    """That divergence after ``anneal`` iterations, to which it falls in a line [nat]; None keeps it as it is."""
    anneal: int = 0
    """Iterations in which the divergence falls: as many as there will be."""
    horizon: int = 24
    """Steps of each environment per iteration."""
    num_envs: int = 4096
    """Environments, of all processes together; the builder of the environment is told."""
    epochs: int = 5
    """Passes over the batch per iteration."""
    actor_minibatches: int = 4
    """Steps of the actor per epoch."""
    critic_minibatches: int = 1
    """Steps of the critic per epoch: 1 is the paper's whole batch, ``actor_minibatches`` is common PPO."""
    weight_decay: float = 0.01
    """Weight decay of AdamW [1]."""
    clip_epsilon: float = 0.2
    """How much likelier an action may become before it stops earning [1]."""
    max_grad_norm: float = 1.0
    """Longest gradient of each network."""
    micro_batch: int = 24_576
    """Most samples that go through the critic at once."""
    warm_up: int = 0
    """Batches before the first update that nothing is learnt from: where all episodes begin with the same phase of a
    task, the curve would begin with that phase and fall as it ends."""
    critic_first: int = 0
    """Iterations in which the critic alone learns: for a policy that goes on without the critic that it had, or until
    first episodes, which begin in better order than others, are over."""

    def __post_init__(self) -> None:
        if self.actor_lr < self.least_actor_lr:
            raise ValueError(
                f"actor_lr is {self.actor_lr:g}, below least_actor_lr of {self.least_actor_lr:g}, to which a policy "
                "that moves too far would raise it. Lower least_actor_lr too."
            )
        if (self.kl_target_last is None) != (self.anneal == 0):
            raise ValueError(
                f"kl_target_last is {self.kl_target_last} and anneal is {self.anneal}: a divergence that falls needs "
                "its last value and the number of iterations. Give both, or none."
            )

    def kl_target_at(self, iteration: int) -> float:
        """Divergence to aim at in an iteration, the first of which is 0 [nat].

        Example:
            >>> [round(PPO(kl_target_last=0.002, anneal=4).kl_target_at(k), 3) for k in (0, 2, 4, 9)]
            [0.01, 0.006, 0.002, 0.002]
        """
        if self.kl_target_last is None:
            return self.kl_target
        share = min(1.0, iteration / self.anneal)
        return (1 - share) * self.kl_target + share * self.kl_target_last

    def annealed(self, iterations: int, first: float = 0.02, last: float = 0.002) -> PPO:
        """The same with a divergence that falls from ``first`` to ``last``, unless another than the default was told.

        With one that stays, what is learnt late is lost and learnt again. The rate may fall with it, to 1e-6.

        Example:
            >>> PPO().annealed(1000).kl_target_at(500), PPO(kl_target_last=0.001, anneal=9).annealed(1000).anneal
            (0.011, 9)
        """
        if self.anneal or self.kl_target != PPO().kl_target:
            return self
        least = min(self.least_actor_lr, 1e-6)
        return replace(self, kl_target=first, kl_target_last=last, anneal=iterations, least_actor_lr=least)


PRE_TRAIN = PPO()
"""The whole-body controller, from scratch."""
FINE_TUNE = PPO(entropy_coeff=0.0, actor_lr=1e-5, warm_up=6)
"""A task, from the whole-body controller; the first rate is that of the section on task-specific fine-tuning. What is
not learnt from lasts 2.9 s, longer than the set-up of the sled."""
UAN = PPO(discount=0.995, entropy_coeff=0.0, horizon=96)
"""The Unsupervised Actuator Net: 393,216 samples an iteration, minibatches of 98,304 for the actor."""


BAR = "{percentage:3.0f}%|{bar:20}| {elapsed} spent, {remaining} left{postfix}"


class Learner:
    """Everything that training changes, and nothing else; :func:`iterate` and :func:`train` work on it.

    Args:
        env: N environments, or this process's share of them; :attr:`.RayRollout.env` where others have them.
        actor: Policy with a distribution, as :func:`~torchrl_athletic.networks.actor` makes it.
        critic: Value function.
        config: Numbers chosen by hand.
        normalizer: Of the entry ``normalized``, which networks go through, or several by their entries; learns after
            every update.
        normalized: That entry, where there is one.
        watch: Entries of a step whose means are reported, :class:`~.RewardTerms`' ``"reward_terms"`` say.
        seed: Of the order of samples.
        collector: Collect with TorchRL's ``Collector``.
        cuda_graph: Capture the control step and the update in CUDA graphs, on a GPU only.
        rollout: Collects in place of one made here; of ``env``, with what the two networks read.
        processes: Those that train together (:func:`~.join_processes`), each with its share of the environments. They
            begin with the first one's networks.

    Raises:
        ValueError: If the environment has another size than configured, or two processes explore alike.

    Example:
        >>> from torchrl.envs import GymEnv, SerialEnv
        >>> from torchrl_athletic.networks import actor, critic
        >>> env = SerialEnv(2, lambda: GymEnv("Pendulum-v1"))
        >>> learner = Learner(env, actor(3, 1), critic(3), PPO(num_envs=2, horizon=8))
        >>> sorted(iterate(learner).keys())[:3]
        ['ESS', 'actor_grad_norm', 'actor_lr']
        >>> learner.samples
        16
    """

    def __init__(
        self,
        env: EnvBase,
        actor: ProbabilisticTensorDictSequential,
        critic: TensorDictModuleBase,
        config: PPO = PRE_TRAIN,
        *,
        normalizer: RunningNormalizer | Mapping[NestedKey, RunningNormalizer] | None = None,
        normalized: NestedKey = "observation",
        watch: Sequence[NestedKey] = (),
        seed: int = 0,
        collector: bool = False,
        cuda_graph: bool = False,
        rollout: Rollout | None = None,
        processes: Processes = ALONE,
    ) -> None:
        rows = env.numel() if rollout is None else rollout.num_envs
        if rows != processes.share(config.num_envs):
            shared = processes.count > 1
            told = f"num_envs={config.num_envs}" + (f" for {processes.count} processes" if shared else "")
            wanted = "processes.share(config.num_envs)" if shared else "config.num_envs"
            raise ValueError(
                f"the environment has {rows} rows, the configuration says {told}: batches would have another "
                f"size than was tuned. Build the environment with num_envs={wanted}."
            )
        check_seeds_differ(processes)
        processes.copy_from_first_(tensor for net in (actor, critic) for tensor in (*net.parameters(), *net.buffers()))
        self.env, self.actor, self.critic, self.config = env, actor, critic, config
        given = {} if normalizer is None else normalizer
        self.normalizers = {normalized: given} if isinstance(given, RunningNormalizer) else dict(given)
        self.watch, self.processes = watch, processes
        keys = [*critic.in_keys, *under_next(watch)]
        self.rollout: Rollout
        if rollout is not None:
            self.rollout = rollout
        elif cuda_graph:
            self.rollout = CapturedRollout(env, actor, config.horizon, keys=keys)
        else:
            self.rollout = Rollout(env, actor, config.horizon, keys=keys, collector=collector)
        self.advantage = GAE(  # estimate_advantage gives it the values, and standardises those of several processes
            gamma=config.discount,
            lmbda=config.gae_lambda,
            value_network=None,
            average_gae=processes.count == 1,
            vectorized=False,
        )
        self.kl_target = torch.tensor(config.kl_target, device=next(actor.parameters()).device)
        self.stepper = SplitOptimizationStepper(
            SplitClipPPOLoss(actor, critic, clip_epsilon=config.clip_epsilon, entropy_coeff=config.entropy_coeff),
            actor_lr=config.actor_lr,
            critic_lr=config.critic_lr,
            adaptive_kl=AdaptiveKL(self.kl_target, bounds=(config.least_actor_lr, 1e-2)),
            weight_decay=config.weight_decay,
            epochs=config.epochs,
            minibatches=config.actor_minibatches,
            critic_minibatches=config.critic_minibatches,
            micro_batch=config.micro_batch,
            max_grad_norm=config.max_grad_norm,
            seed=seed,
            cuda_graph=cuda_graph,
            in_place=[*actor.in_keys, *critic.in_keys],  # a rollout allocates its storage once
            average=processes.average_ if processes.count > 1 else None,
        )
        if config.critic_first:
            self.stepper.actor_lr.zero_()
        self.iteration = 0
        """Iterations done."""
        self.samples = 0
        """Steps of all environments of all processes so far."""
        self.seconds = 0.0
        """Time spent in :func:`train`, evaluations and earlier runs included [s]."""

    def close(self) -> None:
        """Leave the processes that train together, at the end of a run.

        Graphs go first: while they still hold work of NCCL, processes on GPUs that captured their updates hang here.
        """
        self.stepper.release()
        self.processes.leave()

    def state_dict(self) -> dict[str, Any]:
        """What it takes to go on: networks, optimisers, where the episodes stand, the counters."""
        return {
            "actor": self.actor.state_dict(),
            "critic": self.critic.state_dict(),
            "stepper": self.stepper.state_dict(),
            "rollout": self.rollout.state_dict(),
            "counters": {"iteration": self.iteration, "samples": self.samples, "seconds": self.seconds},
        }

    def load_state_dict(self, state_dict: dict[str, Any]) -> None:
        """Go on where :meth:`state_dict` was taken."""
        self.actor.load_state_dict(state_dict["actor"])
        self.critic.load_state_dict(state_dict["critic"])
        self.stepper.load_state_dict(state_dict["stepper"])
        self.rollout.load_state_dict(state_dict["rollout"])
        for name, count in state_dict["counters"].items():
            setattr(self, name, count)


def iterate(learner: Learner, progress: bool = False) -> TensorDict:
    """Collect once and learn from it.

    The very first time, ``warm_up`` batches go before it, and one more shows the normaliser what observations look
    like: were it to learn that after the first update only, the policy would be another at once.

    Args:
        learner: Changed in place.
        progress: Whether to show a bar of those batches.

    Returns:
        What the update reports, and the means of ``reward`` and of what is watched; over all processes. Shape ().

    Raises:
        NonFiniteError: If a NaN or an infinity was collected, or an update made one.
    """
    if learner.iteration == 0:
        _warm_up(learner, progress)
    if learner.iteration and learner.iteration == learner.config.critic_first:
        learner.stepper.actor_lr.fill_(learner.config.actor_lr)
    learner.kl_target.fill_(learner.config.kl_target_at(learner.iteration))
    batch = collect(learner)
    estimate_advantage(learner, batch)
    report = learner.stepper.update(batch)
    shown = batch["next"].select("reward", *learner.watch)
    for key in shown.keys(include_nested=True, leaves_only=True):
        report[key if isinstance(key, str) else "/".join(key)] = shown.get(key).float().mean()
    learner.processes.average_(report.values())
    check_finite(report, "update")
    _learn_scale(learner, batch)
    learner.iteration += 1
    return report


def _warm_up(learner: Learner, progress: bool) -> None:
    for _ in tqdm(range(learner.config.warm_up), "warm-up", unit="batch", leave=False, disable=not progress):
        collect(learner)
    if learner.normalizers:
        _learn_scale(learner, collect(learner))


def collect(learner: Learner) -> TensorDict:
    """The next samples, all of them finite. Shape (N, T)."""
    batch = learner.rollout()
    check_finite_everywhere(batch, learner.processes)
    learner.samples += batch.numel() * learner.processes.count
    return batch


@torch.no_grad()
def estimate_advantage(learner: Learner, batch: TensorDictBase) -> None:
    """Write ``advantage``, ``value_target`` and ``state_value``.

    Values are taken in pieces of ``micro_batch`` samples. (GAE itself would first stack all observations with all next
    ones, and with nets of 3 x 512 their copies and activations take several times the batch's memory.)
    """
    for shown in (batch, batch.get("next")):
        shown.set("state_value", _values(learner.critic, shown, learner.config.micro_batch))
    learner.advantage(batch)
    if learner.processes.count > 1:
        batch.set("advantage", standardized(batch.get("advantage"), learner.processes))


def _values(critic: TensorDictModuleBase, shown: TensorDictBase, piece: int) -> Tensor:
    """Shape (N, T, 1)."""
    rows = shown.select(*critic.in_keys).reshape(-1).split(piece)
    return torch.cat([critic(row).get("state_value") for row in rows]).reshape(*shown.shape, 1)


def _learn_scale(learner: Learner, batch: TensorDictBase) -> None:
    for key, normalizer in learner.normalizers.items():
        normalizer.update(batch.get(key), learner.processes.moments)


def check_end(**most: float | None) -> None:
    """Make sure that a training ends, by its name and value what says when.

    Raises:
        ValueError: If one is negative or no number.

    Example:
        >>> check_end(minutes=9.0, iterations=None)
    """
    for name, value in most.items():
        if value is not None and not value >= 0:
            raise ValueError(f"{name} is {value}, so that training would never end. Give 0 or more.")


def train(
    learner: Any,
    *,
    iterations: int | None = None,
    minutes: float | None = None,
    evaluate: Callable[[], Mapping[str, float]] | None = None,
    evaluate_every: int = 50,
    logger: MetricLogger | None = None,
    checkpoints: Checkpoints | None = None,
    checkpoint_every: int = 50,
    checkpoint_seconds: float = 45.0,
    progress: bool = True,
    show: Sequence[str] = ("reward", "kl"),
    step: Callable[[Any], TensorDict] = iterate,
) -> dict[str, float]:
    """Iterate, and tell how it goes. A run that was interrupted goes on from its newest checkpoint.

    Of several processes the first one evaluates, logs, shows the bar and has the clock; all save their state.

    Args:
        learner: Changed in place. Those that train together are its ``processes``, if it has some.
        iterations: When to stop, counted from the very start.
        minutes: When to stop, in time spent here, evaluations and earlier runs included.
        evaluate: Measures the policy; what it returns is logged.
        evaluate_every: Iterations between evaluations; there is one at the end in any case.
        logger: Where the numbers go, see :func:`~torchrl_athletic.training.make_logger`.
        checkpoints: Where the state goes.
        checkpoint_every: Most iterations between checkpoints; there is one at the end in any case.
        checkpoint_seconds: Most time between checkpoints, but for the iteration that is under way [s]: a kill loses no
            more than about a minute.
        progress: Whether to show a bar with samples per second and the time left.
        show: Entries to show beside it.
        step: What an iteration is; a method other than PPO brings its own, and a learner with ``iteration``,
            ``samples``, ``seconds``, ``state_dict`` and ``load_state_dict``.

    Returns:
        The last numbers that were logged.

    Raises:
        ValueError: If nothing says when to stop, or what says so is negative.
    """
    if iterations is None and minutes is None:
        raise ValueError("neither iterations nor minutes is given, so training would never end. Give one of them.")
    check_end(iterations=iterations, minutes=minutes)
    processes: Processes = getattr(learner, "processes", ALONE)
    logger, progress = (logger, progress) if processes.rank == 0 else (None, False)
    if checkpoints is not None and checkpoints.resume(learner, logger) and processes.rank == 0:
        tqdm.write(f"going on after iteration {learner.iteration}")
    began, first_sample = time.perf_counter() - learner.seconds, learner.samples

    def clock() -> float:
        return processes.of_first(lambda: time.perf_counter() - began)  # or they would stop at different times

    if progress and step is iterate:
        step = partial(iterate, progress=True)
    metrics: dict[str, float] = {}
    share = _share_done(learner, iterations, minutes)
    with tqdm(total=1.0, initial=share, bar_format=BAR, disable=not progress) as bar:
        started = saved = learner.seconds
        while share < 1:
            metrics = _numbers(step(learner))
            learner.seconds = clock()
            share = _share_done(learner, iterations, minutes)
            if evaluate is not None and (share == 1 or learner.iteration % evaluate_every == 0):
                metrics |= processes.of_first(evaluate)
                learner.seconds = clock()
            metrics |= {"samples": float(learner.samples), "seconds": learner.seconds}
            if logger is not None:
                logger.log_metrics(metrics, step=learner.iteration)
            late = learner.seconds - saved >= checkpoint_seconds
            if share == 1 or late or learner.iteration % checkpoint_every == 0:
                _check_room(learner)
                if checkpoints is not None:
                    checkpoints.save(learner, logger)
                saved = learner.seconds
            rate = (learner.samples - first_sample) / (learner.seconds - started)
            shown = {name: f"{metrics[name]:.3g}" for name in show if name in metrics}
            bar.set_postfix({"samples": f"{learner.samples:,}", "samples/s": f"{rate:,.0f}", **shown}, refresh=False)
            bar.update(share - bar.n)
    if not metrics and evaluate is not None:  # an earlier run had come to its end
        return dict(processes.of_first(evaluate))
    return metrics


def _check_room(learner: Any) -> None:
    """Tell if contacts were left out: a training outlives one now and then, its user should know."""
    physics = getattr(base_env_of(getattr(learner, "env", None)), "physics", None)
    try:
        if physics is not None:
            physics.check()
    except CapacityError as error:
        warnings.warn(str(error), stacklevel=3)


def _numbers(report: TensorDict) -> dict[str, float]:
    """On the host, in one copy."""
    return dict(zip(report.keys(), torch.stack(list(report.values())).tolist(), strict=True))


def _share_done(learner: Any, iterations: int | None, minutes: float | None) -> float:
    """0 at the start, 1 when training is over."""
    by_count = learner.iteration / iterations if iterations else float(iterations is not None)
    by_time = learner.seconds / (60 * minutes) if minutes else float(minutes is not None)
    return min(1.0, max(by_count, by_time))
