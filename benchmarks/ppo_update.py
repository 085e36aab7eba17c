"""What a PPO update costs with a batch of its own for actor and critic, against TorchRL's joint minibatches.

    python benchmarks/ppo_update.py                                         # two cores, minutes
    python benchmarks/ppo_update.py --samples 98304 --inputs 900 --hidden 512 512 512 --device cuda --tf32 --graph

Prints the table and writes it to ``--output``. Both see the same samples and as many of them: the stock loss in
``--minibatches`` minibatches, one AdamW for both networks; ours in as many actor minibatches and the whole batch for
the critic. They are run in turn (A B, B A, ...) and each pair gives one ratio, of CPU time on a CPU, since others may
be busy on it, and of the GPU's time on a GPU. Peak memory is what tensors take beyond networks, optimisers and batch.
"""

from __future__ import annotations

import os
import platform
import subprocess
import sys
import time
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from statistics import median

import torch
import tyro
from tensordict import TensorDict
from torch.profiler import ProfilerActivity, profile
from torchrl.envs.utils import ExplorationType, set_exploration_type
from torchrl.objectives import ClipPPOLoss
from tqdm import tqdm

from torchrl_athletic.losses import SplitClipPPOLoss, SplitOptimizationStepper
from torchrl_athletic.networks import actor, critic

Update = Callable[[], object]


@dataclass(frozen=True)
class Config:
    """Every field is a flag."""

    samples: int = 4096
    """In a batch."""
    inputs: int = 300
    """Features that actor and critic see."""
    actions: int = 19
    """Actions of the policy."""
    hidden: tuple[int, ...] = (128, 128, 128)
    """Layer sizes of both networks."""
    epochs: int = 5
    """Passes over the batch in one update."""
    minibatches: int = 4
    """Minibatches of the actor in each epoch."""
    micro_batches: tuple[int, ...] = (4096, 1024)
    """Most samples in the critic at once, a row each; on a GPU 98304 24576 say."""
    device: str = "cpu"
    """``cpu`` or ``cuda``."""
    tf32: bool = False
    """Let a GPU round matrix products to TF32."""
    graph: bool = False
    """Also time our update as one CUDA graph."""
    pairs: int = 5
    """Ratios per row."""
    output: Path = Path("benchmarks/results/ppo_update.md")
    """Where the table goes."""


def main(cfg: Config) -> None:
    torch.set_num_threads(1)
    torch.set_float32_matmul_precision("high" if cfg.tf32 else "highest")
    batch = made_up(cfg)
    stock = joint(cfg, batch)
    base = peak(cfg, stock)
    rows = [f"| stock, joint minibatches of {cfg.samples // cfg.minibatches} | {per_second(cfg, stock)} | 1 | {base} |"]
    cases = [(size, False) for size in cfg.micro_batches]
    cases += [(size, True) for size in cfg.micro_batches if cfg.graph]
    for size, graph in tqdm(cases, unit="row"):
        ours = split(cfg, batch, size, graph)
        ours()
        ratios = paired(cfg, ours, stock)
        spread = f"{median(ratios):.2f} ({min(ratios):.2f} to {max(ratios):.2f})"
        name = f"split, critic in micro-batches of {size}" + (", one CUDA graph" if graph else "")
        rows.append(f"| {name} | {per_second(cfg, ours)} | {spread} | {'' if graph else peak(cfg, ours)} |")
    report = "\n".join([*heading(cfg), *rows, ""])
    print(report)
    cfg.output.parent.mkdir(parents=True, exist_ok=True)
    temporary = cfg.output.with_suffix(".part")
    temporary.write_text(report)
    os.replace(temporary, cfg.output)


def networks(cfg: Config) -> tuple[torch.nn.Module, torch.nn.Module]:
    torch.manual_seed(0)
    policy = actor(cfg.inputs, cfg.actions, hidden=cfg.hidden, device=cfg.device)
    return policy, critic(cfg.inputs, hidden=cfg.hidden, device=cfg.device)


@torch.no_grad()
def made_up(cfg: Config) -> TensorDict:
    """What a collector and GAE would have left."""
    policy, value = networks(cfg)
    states = torch.randn(cfg.samples, cfg.inputs, device=cfg.device)
    with set_exploration_type(ExplorationType.RANDOM):
        batch = value(policy(TensorDict({"observation": states}, [cfg.samples])))
    for key in ("advantage", "value_target"):
        batch[key] = torch.randn(cfg.samples, 1, device=cfg.device)
    return batch


def joint(cfg: Config, batch: TensorDict) -> Update:
    """PPO as TorchRL's examples write it."""
    loss = ClipPPOLoss(*networks(cfg), loss_critic_type="l2")
    optimizer = torch.optim.AdamW(loss.parameters(), lr=3e-4, weight_decay=0.01, fused=True)
    parameters = list(loss.parameters())

    def update() -> None:
        for _ in range(cfg.epochs):
            for index in torch.randperm(cfg.samples, device=cfg.device).tensor_split(cfg.minibatches):
                out = loss(batch[index])
                optimizer.zero_grad()
                (out["loss_objective"] + out["loss_entropy"] + out["loss_critic"]).backward()
                torch.nn.utils.clip_grad_norm_(parameters, 1.0)
                optimizer.step()

    return update


def split(cfg: Config, batch: TensorDict, micro_batch: int, graph: bool) -> Update:
    loss = SplitClipPPOLoss(*networks(cfg), loss_critic_type="l2")
    stepper = SplitOptimizationStepper(
        loss, epochs=cfg.epochs, minibatches=cfg.minibatches, micro_batch=micro_batch, cuda_graph=graph
    )
    return lambda: stepper.update(batch)


def paired(cfg: Config, ours: Update, stock: Update) -> list[float]:
    """Time of ours over that of the stock update, pair by pair."""
    found = []
    for k in range(cfg.pairs):
        first, second = (ours, stock) if k % 2 == 0 else (stock, ours)
        took = {first: seconds(cfg, first), second: seconds(cfg, second)}
        found.append(took[ours] / took[stock])
    return found


def seconds(cfg: Config, update: Update) -> float:
    clock = time.process_time if cfg.device == "cpu" else time.perf_counter
    if cfg.device != "cpu":
        torch.cuda.synchronize()
    start = clock()
    update()
    if cfg.device != "cpu":
        torch.cuda.synchronize()
    return clock() - start


def per_second(cfg: Config, update: Update) -> str:
    """Samples of the batch, all epochs done, per second; and the seconds."""
    took = median(seconds(cfg, update) for _ in range(3))
    return f"{cfg.samples / took / 1e3:.1f} k | {took:.3f} s"


def peak(cfg: Config, update: Update) -> str:
    """Most memory that tensors of an update take at once, on top of what stays [MB]."""
    update()
    if cfg.device != "cpu":
        torch.cuda.synchronize()
        torch.cuda.reset_peak_memory_stats()
        before = torch.cuda.memory_allocated()
        update()
        torch.cuda.synchronize()
        return f"{(torch.cuda.max_memory_allocated() - before) / 1e6:.0f} MB"
    with profile(activities=[ProfilerActivity.CPU], profile_memory=True) as recorded:
        update()
    taken = most = 0
    for event in recorded.profiler.kineto_results.events():
        if event.name() == "[memory]":
            taken += event.nbytes()
            most = max(most, taken)
    return f"{most / 1e6:.0f} MB"


def heading(cfg: Config) -> list[str]:
    commit = subprocess.run(["git", "rev-parse", "--short", "HEAD"], capture_output=True, text=True).stdout.strip()
    clock = "CPU time of one thread" if cfg.device == "cpu" else "time"
    return [
        "# PPO update, split against joint minibatches",
        "",
        f"    python benchmarks/{Path(__file__).name} {' '.join(sys.argv[1:])}".rstrip(),
        "",
        f"Commit {commit}; {processor(cfg)}; Python {platform.python_version()}, torch {torch.__version__}"
        f"{', TF32' if cfg.tf32 else ''}. {cfg.samples} samples of {cfg.inputs} inputs, layers "
        f"{'-'.join(map(str, cfg.hidden))}, {cfg.epochs} epochs, {cfg.minibatches} minibatches.",
        "",
        f"Samples/s count each sample once, all epochs done; {clock}, median of 3. The ratio is that of our time over "
        f"the stock one's: median (least to greatest) of {cfg.pairs} interleaved pairs, so less is faster. Memory is "
        "the most that tensors of an update take at once beyond networks, optimisers and batch.",
        "",
        "| update | samples/s | time | over stock | peak memory |",
        "|---|---|---|---|---|",
    ]


def processor(cfg: Config) -> str:
    if cfg.device != "cpu":
        return torch.cuda.get_device_name()
    info = Path("/proc/cpuinfo")
    lines = info.read_text().splitlines() if info.exists() else []
    names = [line.partition(":")[2].strip() for line in lines if line.startswith("model name")]
    return f"{names[0] if names else platform.machine()}, {os.cpu_count()} CPUs"


if __name__ == "__main__":
    main(tyro.cli(Config))
