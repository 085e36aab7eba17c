"""Several processes that train one policy, each on rows of its own: ``torchrun --nproc-per-node 2 recipes/mine.py``."""

from __future__ import annotations

import os
import zlib
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from typing import Literal, TypeVar

import torch
import torch.distributed as dist
from tensordict import TensorDictBase
from torch import Tensor

from torchrl_athletic.networks.normalizer import moments
from torchrl_athletic.training.finite import NonFiniteError, check_finite

T = TypeVar("T")


@dataclass(frozen=True)
class Processes:
    """Those that train together, seen from one of them; :func:`join_processes` makes it.

    Every process calls the same methods in the same order, or all wait for one another. Of a single process each method
    does nothing, or gives back what it got.

    Args:
        rank: Number of this one, from 0; that one alone logs, measures and shows the bar.
        count: How many there are.
        device: Where this one trains.

    Example:
        >>> two = [Processes(rank, 2) for rank in range(2)]
        >>> [process.first_row(256) for process in two]
        [0, 128]
        >>> two[0].seed(7), two[1].seed(7) == 7
        (7, False)
    """

    rank: int = 0
    count: int = 1
    device: str = "cpu"

    def share(self, num_envs: int) -> int:
        """Rows of each process, of ``num_envs`` in all.

        Raises:
            ValueError: If they cannot be shared out evenly, since means over processes would not be those over rows.
        """
        if num_envs % self.count:
            fits = num_envs + self.count - num_envs % self.count
            raise ValueError(
                f"num_envs={num_envs} rows cannot be shared out evenly among {self.count} processes, so that some "
                f"samples would count more than others. Take a multiple, num_envs={fits} say."
            )
        return num_envs // self.count

    def first_row(self, num_envs: int) -> int:
        """Number of this process's first row, for transforms to draw what that row of one large batch draws."""
        return self.rank * self.share(num_envs)

    def seed(self, seed: int) -> int:
        """Seed of this process's generators: the first one's is ``seed``, the others explore otherwise."""
        return zlib.crc32(f"{seed}/{self.rank}".encode()) if self.rank else seed

    @torch.no_grad()
    def average_(self, tensors: Iterable[Tensor], weight: Tensor | None = None) -> None:
        """Replace tensors by their means over the processes, in one exchange.

        Args:
            tensors: Of the same shapes in every process.
            weight: How much those of this process count, their number of samples say; what has no weight may hold
                anything. None if all count the same. Shape ().
        """
        if self.count == 1:
            return
        tensors = list(tensors)
        flat = torch.cat([tensor.reshape(-1) for tensor in tensors])
        # A CUDA graph may be recording: nothing here is read by the host, no size depends on a value, and the exchange
        # is ordered on the stream that is current. Two H100 trained a whole controller so (torch 2.11).
        if weight is None:
            dist.all_reduce(flat)
            flat /= self.count
        else:
            flat = torch.cat((flat, flat.new_ones(1)))
            flat = torch.where(weight > 0, flat * weight, 0)
            dist.all_reduce(flat)
            flat = flat[:-1] / flat[-1].clamp_min(torch.finfo(flat.dtype).tiny)
        parts = flat.split([tensor.numel() for tensor in tensors])
        for tensor, part in zip(tensors, parts, strict=True):
            tensor.copy_(part.view_as(tensor))

    @torch.no_grad()
    def copy_from_first_(self, tensors: Iterable[Tensor]) -> None:
        """Replace tensors by those of the first process."""
        if self.count > 1:
            for tensor in tensors:
                dist.broadcast(tensor, src=0)

    def moments(self, value: Tensor) -> tuple[Tensor, Tensor, int]:
        """Mean, variance and number of the samples of all processes.

        Args:
            value: As many samples in every process. Shape (B, D).

        Returns:
            Mean (D,), variance without correction (D,) and count.
        """
        ours, variance, count = moments(value)
        if self.count == 1:
            return ours, variance, count
        mean = ours.clone()
        self.average_([mean])
        variance = variance + (ours - mean).square()
        self.average_([variance])
        return mean, variance, count * self.count

    def of_first(self, make: Callable[[], T]) -> T:
        """What the first process makes, in all of them; the others wait."""
        if self.count == 1:
            return make()
        made = [make() if self.rank == 0 else None]
        dist.broadcast_object_list(made, src=0, device=torch.device("cpu"))
        return made[0]  # type: ignore[return-value]

    def gather(self, value: T) -> list[T]:
        """What each has, by rank, in all of them."""
        if self.count == 1:
            return [value]
        values: list[T] = [value] * self.count
        dist.all_gather_object(values, value)
        return values

    def leave(self) -> None:
        """Close the connections, at the end of a run."""
        if self.count > 1 and dist.is_initialized():
            dist.destroy_process_group()


ALONE = Processes()
"""One process, for which nothing changes."""


def join_processes(device: Literal["cpu", "cuda"] = "cpu") -> Processes:
    """Join those that ``torchrun`` started beside this one; without it, there is one.

    Processes on CPUs speak through gloo and share out the CPUs that they may use; on GPUs they speak through NCCL, each
    on the GPU of its number on the host.

    Args:
        device: What to train on.

    Raises:
        RuntimeError: If the host has fewer GPUs than processes.

    Example:
        >>> join_processes().count
        1
    """
    rank, count, on_host, of_host = (int(os.environ.get(name, alone)) for name, alone in TOLD.items())
    if count == 1:
        return Processes(device=device)
    place = f"cuda:{on_host}" if device == "cuda" else device
    if device == "cuda":
        if on_host >= torch.cuda.device_count():
            raise RuntimeError(
                f"process {on_host} of this host finds {torch.cuda.device_count()} GPUs, but each process needs one of "
                "its own. Start as many as there are: torchrun --nproc-per-node gpu."
            )
        torch.cuda.set_device(place)  # what is put on plain "cuda" goes there too
    else:
        _keep_to_share_of_cpus(on_host, of_host)
    if not dist.is_initialized():
        if device == "cuda":  # what hosts must know of one another goes by gloo, without a wait for the GPU
            dist.init_process_group("cpu:gloo,cuda:nccl", device_id=torch.device(place))
        else:
            dist.init_process_group("gloo")
    return Processes(rank, count, place)


TOLD = {"RANK": 0, "WORLD_SIZE": 1, "LOCAL_RANK": 0, "LOCAL_WORLD_SIZE": 1}
"""What torchrun tells a process, and what it is without."""


def _keep_to_share_of_cpus(number: int, count: int) -> None:
    """Give each process its own CPUs; otherwise the threads of one process wait for those of the others."""
    if hasattr(os, "sched_getaffinity"):
        cpus = sorted(os.sched_getaffinity(0))
        ours = cpus[len(cpus) * number // count : len(cpus) * (number + 1) // count]
        os.sched_setaffinity(0, ours or cpus)  # threads that start from now on are held to it too


def standardized(value: Tensor, processes: Processes) -> Tensor:
    """Advantages with mean 0 and standard deviation 1 over the samples of all processes.

    It is what ``GAE(average_gae=True)`` makes of its one batch: the deviation is that of a sample, over n - 1, and 1e-4
    at least.

    Args:
        value: Shape (*B, 1).
        processes: That train together, with as many samples each.
    """
    mean, variance, count = processes.moments(value.reshape(-1, 1))
    return (value - mean) / (variance * (count / (count - 1))).sqrt().clamp_min(1e-4)


def check_finite_everywhere(batch: TensorDictBase, processes: Processes) -> None:
    """Make sure that every number of every process is finite, so that none goes on alone and waits for ever.

    Raises:
        NonFiniteError: In all processes, if one is not. Says in which, and what :func:`~.check_finite` says there.
    """
    if processes.count == 1:
        return check_finite(batch)
    complaint = ""
    try:
        check_finite(batch)
    except NonFiniteError as error:
        complaint = str(error)
    for rank, said in enumerate(processes.gather(complaint)):
        if said:
            raise NonFiniteError(f"in process {rank} of {processes.count}: {said}")


def check_seeds_differ(processes: Processes) -> None:
    """Make sure that no two processes explore alike.

    Raises:
        ValueError: If PyTorch's generators began with one seed in two of them.
    """
    seeds: Sequence[int] = processes.gather(torch.initial_seed())
    if len(set(seeds)) < len(seeds):
        raise ValueError(
            f"the generators of the {processes.count} processes began with the seeds {seeds}: two alike try the same "
            "actions, and the batch is worth less than its size. Seed each by torch.manual_seed(processes.seed(seed))."
        )
