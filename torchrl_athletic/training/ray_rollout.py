"""Collecting on the CPUs of many hosts, with TorchRL's Ray collector."""

from __future__ import annotations

import os
import sys
import zlib
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from copy import deepcopy
from functools import partial
from importlib.util import find_spec
from typing import Any, Self

import torch
from tensordict import NestedKey, TensorDict, TensorDictBase
from torch import nn
from torchrl.envs import EnvBase
from torchrl.envs.utils import ExplorationType

from torchrl_athletic.training.rollout import Policy, Rollout, check_horizon, kept_keys


def rows_of_a_worker(num_envs: int, workers: int) -> int:
    """How many robots each of some workers has.

    Raises:
        ValueError: If there are no workers, or the robots cannot be dealt out evenly.

    Example:
        >>> rows_of_a_worker(4096, 64)
        64
    """
    if workers < 1 or num_envs % workers:
        near = max(1, num_envs // max(workers, 1)) * max(workers, 1)
        raise ValueError(
            f"{num_envs} robots (num_envs) cannot be dealt out evenly to {workers} workers. "
            f"Take 1 worker or more, and a multiple of their number, as num_envs={near}."
        )
    return num_envs // workers


class RayRollout(Rollout):
    """A :class:`~.Rollout` whose rows are shared out among workers, each a process with an environment of its own.

    Each call sends the policy's weights to the workers, lets them act for ``horizon`` steps and joins what they saw in
    the workers' order: the batch is that of their environments side by side. The workers start at the first call, on
    this machine or on a cluster that runs, and stay until :meth:`close`.

    A state holds how many batches there were, no more: what stands in the workers cannot be carried over. A run that
    goes on has its networks, optimisers and counters, and its workers begin new episodes, with random numbers that were
    not drawn before.

    Args:
        make_env: Makes the environment of a worker, given how many rows it has and the number of its first one, of
            which it tells the transforms. It travels to the workers: a function of a script may, one of a module has to
            be importable there.
        policy: As of :class:`~.Rollout`; it acts on the workers' CPUs.
        horizon: As of :class:`~.Rollout`.
        workers: How many; each takes one CPU.
        rows: Of each worker.
        keys: As of :class:`~.Rollout`. What is not asked for does not travel.
        seed: Of the workers' exploration.
        device: Where batches are put; None where the policy is.
        address: Of a cluster that runs, ``"auto"`` for that of this machine; None takes Ray's own variable
            ``RAY_ADDRESS``, and else starts one here, which needs no network and reports to nobody.
        init: Further arguments of ``ray.init``.

    Attributes:
        env: Of one row, for its specs and for :class:`~.Learner`; nobody steps it.
        num_envs: Rows of all workers.

    Raises:
        ModuleNotFoundError: If Ray is not installed.

    Example:
        >>> with RayRollout(make_env, policy, 24, workers=8, rows=64) as rollout:  # doctest: +SKIP
        ...     config = PPO(num_envs=rollout.num_envs, horizon=24)
        ...     learner = Learner(rollout.env, policy, critic, config, rollout=rollout)
        ...     train(learner, minutes=60)
    """

    def __init__(
        self,
        make_env: Callable[[int, int], EnvBase],
        policy: Policy,
        horizon: int,
        *,
        workers: int,
        rows: int,
        keys: Sequence[NestedKey] | None = None,
        seed: int = 0,
        device: torch.device | str | None = None,
        address: str | None = None,
        init: Mapping[str, Any] | None = None,
    ) -> None:
        check_horizon(horizon)
        for name, count in (("workers", workers), ("rows", rows)):
            if count < 1:
                raise ValueError(f"{name} is {count}, so that nobody would collect. Give 1 or more.")
        if find_spec("ray") is None:
            raise ModuleNotFoundError(
                "ray is not installed, which starts the workers and talks to them. Install it with "
                "pip install 'torchrl-athletic[ray]', or collect here, with Rollout.",
                name="ray",
            )
        self.make_env, self.policy, self.horizon, self.keys = make_env, policy, horizon, keys
        self.workers, self.seed, self.init = workers, seed, dict(init or {})
        self.address = address or os.environ.get("RAY_ADDRESS") or None
        self.rows = rows
        self.env = make_env(1, 0)
        self.num_envs = workers * rows
        self.batches = 0
        """Collected so far, earlier runs included; names the workers' random numbers when they start."""
        self.device = device if device is not None else _device_of(policy)
        self._collector: Any = None
        self._held: TensorDict | None = None

    @torch.no_grad()
    def __call__(self) -> TensorDict:
        """Collect. Shape (N, T), whose second dimension is called time; the next call overwrites it."""
        if self._collector is None:
            self._start()
        if isinstance(self.policy, nn.Module):
            self._collector.update_policy_weights_(self.policy)  # RayCollector sends none by itself
        found = next(self._batches).flatten(0, 1)  # it stacks the workers' batches: (workers, rows, T)
        self.batches += 1
        if self._held is None:
            self._held = found.to(self.device)
            self._held.names = [None, "time"]
        else:
            self._held.update_(found)  # in place, as a captured update reads it
        return self._held

    def state_dict(self) -> dict[str, Any]:
        """How many batches there were."""
        return {"batches": self.batches}

    def load_state_dict(self, state_dict: dict[str, Any]) -> None:
        """Go on from there, with new episodes: workers that run are stopped, and others start at the next call."""
        self.close()
        self.batches = state_dict.get("batches", 0)

    def close(self) -> None:
        """Stop the workers, and Ray if it was started here."""
        if self._collector is None:
            return
        import ray

        self._collector.shutdown()
        self._collector = None
        if self._owns_ray:
            ray.shutdown()

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *error: object) -> None:
        self.close()

    def _start(self) -> None:
        import ray
        from torchrl.collectors.distributed import RayCollector

        self._owns_ray = not ray.is_initialized()
        if self._owns_ray:
            os.environ.setdefault("RAY_USAGE_STATS_ENABLED", "0")  # or it would call home
            here = {"num_cpus": self.workers, "include_dashboard": False} if self.address is None else {}
            options = {"log_to_driver": False, "logging_level": "warning", **here, **self.init}
            ray.init(address=self.address or "local", **options)
        try:
            self._check_resources(ray.cluster_resources())
            self._collector = RayCollector(
                [partial(_made, self.make_env, self.rows, w, self._seed(w)) for w in range(self.workers)],
                deepcopy(self.policy).cpu() if isinstance(self.policy, nn.Module) else self.policy,
                frames_per_batch=self.horizon * self.num_envs,
                total_frames=sys.maxsize,  # the default of -1 ends before the first batch
                sync=True,  # all workers' batches at once, in the order of workers
                exploration_type=ExplorationType.RANDOM,
                collector_kwargs={
                    "postproc": self._selection(),  # in the workers: RayCollector's own runs here, after the journey
                    "track_traj_ids": False,
                    "auto_register_policy_transforms": False,
                },
                remote_configs={"num_cpus": 1, "num_gpus": 0},  # by default also 2 GB and a fifth of a GPU for each
            )
        except BaseException:
            if self._owns_ray:
                ray.shutdown()
            raise
        self._batches: Iterator[TensorDictBase] = iter(self._collector)

    def _check_resources(self, resources: Mapping[str, float]) -> None:
        """Ray waits for CPUs for ever."""
        found = int(resources.get("CPU", 0))
        if found < self.workers:
            raise ValueError(
                f"there are {self.workers} workers but {found} CPUs in the Ray cluster: the others would never start. "
                f"Take workers={found}, or join more hosts to it: ray start --address=HOST:PORT."
            )

    def _selection(self) -> Callable[[TensorDictBase], TensorDictBase] | None:
        return None if self.keys is None else partial(_selected, keys=kept_keys(self.env, self.policy, self.keys))

    def _seed(self, worker: int) -> int:
        """All workers would begin with PyTorch's own, and explore alike."""
        return zlib.crc32(f"{self.seed}/{worker}/{self.batches}".encode())


def _made(make_env: Callable[[int, int], EnvBase], rows: int, worker: int, seed: int) -> EnvBase:
    """What a worker begins with."""
    torch.manual_seed(seed)
    with _one_cpu():
        env = make_env(rows, worker * rows)
    if env.numel() != rows:
        raise ValueError(
            f"make_env({rows}, {worker * rows}) has {env.numel()} rows: batches would not have the size that was asked "
            f"for. Make an environment of {rows}."
        )
    return env


@contextmanager
def _one_cpu() -> Iterator[None]:
    """A worker has been given one; physics would start a thread for every CPU of the host, in each worker."""
    if not hasattr(os, "sched_getaffinity"):
        yield
        return
    cpus = os.sched_getaffinity(0)
    os.sched_setaffinity(0, [min(cpus)])
    try:
        yield
    finally:
        os.sched_setaffinity(0, cpus)


def _selected(tensordict: TensorDictBase, keys: Sequence[NestedKey]) -> TensorDictBase:
    return tensordict.select(*keys, strict=False)


def _device_of(policy: Policy) -> torch.device:
    parameters = policy.parameters() if isinstance(policy, nn.Module) else iter(())
    return next((parameter.device for parameter in parameters), torch.device("cpu"))
