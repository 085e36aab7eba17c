"""How much of the physics' own speed is left when the whole environment stands around it, and when it is learnt from.

    python benchmarks/control_step.py --learn                                # 512 robots on this machine's CPU
    python benchmarks/control_step.py --device cuda --num-envs 4096          # on a GPU
    python benchmarks/control_step.py --device cuda --num-envs 4096 --pairs 0 --learn    # whole PPO iterations, alone

The environment is the paper's for pre-training a B2 with a Z1, with everything on: rough ground, randomised robots,
pushes, random starts, restarts, delays, encoder offsets, PD law, actuator net, both clips, four physics steps per
action, commands, gait clock, 14 reward terms, ten frames of history. The robots walk as the shipped controller has
them, but when learning is timed on a CPU, where the nets are small and new. The rival does as many physics steps from
the same states, with the same robots and the torques that acted at the end of each control step, and nothing else:
MuJoCo's batch on the CPU, a bare CUDA graph of MuJoCo Warp on a GPU. Both are timed in turn; each pair gives one
ratio.
"""

from __future__ import annotations

import gc
import os
import platform
import subprocess
import time
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from statistics import median
from typing import Any

import torch
import tyro
from tensordict import TensorDictBase
from torchrl.envs import EnvBase
from tqdm import trange

from torchrl_athletic.envs import make_physics, whole_body_env
from torchrl_athletic.functional.commands import command_ranges
from torchrl_athletic.physics import Physics
from torchrl_athletic.robots import Robot, Terrain, b2z1
from torchrl_athletic.training import PPO, Learner, iterate, wbc_learner
from torchrl_athletic.training.captured import CapturedRollout, fuse_transforms
from torchrl_athletic.training.ppo import collect, estimate_advantage
from torchrl_athletic.training.wbc import read_wbc

DECIMATION = 4
KERNELS = {
    "physics": ("cuda_kernel_forward",),
    "nets": ("gemm", "nvjet", "cutlass", "sm90", "splitK"),
    "transforms, compiled": ("triton",),
    "copies": ("Memcpy", "Memset"),
}
"""Words in the names of kernels: of Warp, of torch's matrix products, of its compiler."""
STATE = ("qpos", "qvel", "qacc_warmstart")


@dataclass(frozen=True)
class Config:
    """Every field is a flag."""

    device: str = "cpu"
    """Where to run."""
    num_envs: int = 512
    """Robots."""
    flat: bool = False
    """Whether the ground is a plane."""
    cone: str = "pyramidal"
    """Cone of friction."""
    pairs: int = 20
    """Ratios; each compares ``steps`` control steps. 0 leaves the comparison out, and its memory."""
    steps: int = 6
    """Control steps of a measurement."""
    fuse: bool = False
    """Compile the transforms on the CPU too; on a GPU they are in any case."""
    policy: str = "wbc"
    """A shipped controller, or a file of ``pretrain_wbc.py``, that has the robots walk."""
    learn: bool = False
    """Also time PPO iterations, with nets of 3 x 512 on a GPU and 2 x 128 on a CPU."""
    iterations: int = 20
    """PPO iterations to time."""
    commit: str = ""
    """Commit of the code, where git cannot tell."""
    output: Path = Path("benchmarks/results")
    """Folder for the table."""


def main(cfg: Config) -> None:
    torch.manual_seed(0)
    torch.set_float32_matmul_precision("high")
    robot = b2z1(cone=cfg.cone, terrain=None if cfg.flat else Terrain())  # type: ignore[arg-type]
    rows = compare(robot, make_env(robot, cfg), cfg) if cfg.pairs else []
    if cfg.learn:
        gc.collect()  # or the environment above would count as memory of the training
        rows += learn(make_env(robot, cfg), cfg)
    table = "\n".join(["| what | figure |", "|---|---|", *(f"| {name} | {figure} |" for name, figure in rows)])
    text = f"{'Control step' if cfg.pairs else 'Where the time of an iteration goes'}:\n\n{table}\n\n{origin(cfg)}\n"
    print(text)
    cfg.output.mkdir(parents=True, exist_ok=True)
    name = "control_step" if cfg.pairs else "ppo_iteration"
    (cfg.output / f"{name}_{cfg.device}{'_fused' if cfg.fuse else ''}.md").write_text(text)


def make_env(robot: Robot, cfg: Config) -> EnvBase:
    goals = command_ranges("box")
    return whole_body_env(robot, num_envs=cfg.num_envs, device=cfg.device, commands=goals, staggered=True)


def compare(robot: Robot, env: Any, cfg: Config) -> list[tuple[str, str]]:
    if cfg.fuse and cfg.device == "cpu":
        fuse_transforms(env)
    policy = read_wbc(cfg.policy)[0].to(cfg.device)
    rollout = CapturedRollout(env, policy, cfg.steps, keys=["privileged", "applied_torque"])
    rollout.current["step_count"].random_(0, 1000)  # so that robots restart at all times
    physics: Physics = env.base_env.physics
    rival = make_physics(robot, cfg.num_envs, cfg.device, fields=physics.fields)
    for _ in trange(10, desc="set robots in motion"):
        batch = rollout()
    rival.set_fields({name: physics.field(name) for name in physics.fields})
    bare = rival.capture(lambda: rival.step(DECIMATION), warmup=1)

    collected: list[TensorDictBase] = []

    def collect() -> None:
        collected.append(rollout())

    def replay() -> None:
        for torque in torques:
            rival.apply_torque(torque)
            bare()

    ours, theirs = [], []
    for _ in trange(cfg.pairs, desc="compare"):
        start = {name: physics.data(name).clone() for name in STATE}
        ours.append(seconds(collect, cfg.device) / cfg.steps)
        batch = collected.pop()
        torques = batch["next", "applied_torque"].clone().unbind(1)
        for name, value in start.items():
            rival.data(name).copy_(value)
        theirs.append(seconds(replay, cfg.device) / cfg.steps)
    ratios = sorted(t / o for t, o in zip(theirs, ours, strict=True))
    done = float(batch["next", "done"].float().mean())
    return [
        ("robots", f"{cfg.num_envs:,}, {cfg.cone} cones"),
        ("control step, whole environment", f"{1e3 * median(ours):.2f} ms"),
        (f"the same {DECIMATION} physics steps alone", f"{1e3 * median(theirs):.2f} ms"),
        ("alone / whole", f"{median(ratios):.3f} ({ratios[len(ratios) // 4]:.3f} to {ratios[-len(ratios) // 4]:.3f})"),
        ("whole / alone", f"{1 / median(ratios):.3f}"),
        ("robots that restart, share per step", f"{done:.4f}"),
    ]


def learn(env: Any, cfg: Config) -> list[tuple[str, str]]:
    """Whole PPO iterations: collect, estimate advantages, update."""
    on_gpu = cfg.device != "cpu"
    hidden, start = ((512, 512, 512), cfg.policy) if on_gpu else ((128, 128), None)
    config = PPO(num_envs=cfg.num_envs, actor_lr=1e-5)
    learner = wbc_learner(env, config, start=start, hidden=hidden, cuda_graph=on_gpu)
    for _ in range(3 if on_gpu else 1):
        iterate(learner)
    if on_gpu:
        torch.cuda.reset_peak_memory_stats()
    times = [seconds(lambda: iterate(learner), cfg.device) for _ in trange(cfg.iterations, desc="learn")]
    rows = [(f"PPO iteration of {24 * cfg.num_envs:,} samples, nets of {hidden}", f"{median(times):.3f} s")]
    if on_gpu:
        peak, reserved = torch.cuda.max_memory_allocated(), torch.cuda.memory_reserved()
        torch.cuda.empty_cache()
        free, total = torch.cuda.mem_get_info()
        others = total - free - torch.cuda.memory_reserved()
        rows.append(("peak memory: torch's tensors, and all else", f"{peak / 2**30:.2f} + {others / 2**30:.2f} GiB"))
        rows.append(("reserved by torch, caches and graphs included", f"{reserved / 2**30:.2f} GiB"))
    for name, phase in phases(learner).items():
        rows.append((f"{name} alone", f"{seconds(phase, cfg.device):.3f} s"))
    if on_gpu:
        rows += [(f"kernels of collecting: {kind}", f"{spent:.3f} s") for kind, spent in kernels(learner).items()]
    else:
        rows.append(("physics within collecting", f"{stepping(learner, env.base_env.physics):.3f} s"))
    physics = env.base_env.physics
    rival = make_physics(env.base_env.robot, cfg.num_envs, cfg.device, fields=physics.fields)
    rival.set_fields({name: physics.field(name) for name in physics.fields})
    bare, state = rival.capture(lambda: rival.step(DECIMATION), warmup=1), {}
    for name in (*STATE, "qfrc_applied"):
        state[name] = physics.data(name).clone()
    alone = []
    for _ in range(20):
        for name, value in state.items():
            rival.data(name).copy_(value)
        alone.append(seconds(bare, cfg.device))
    rows.append((f"{DECIMATION} physics steps alone, from states of the training", f"{1e3 * median(alone):.2f} ms"))
    share = 24 * median(alone) / median(times)
    return [*rows, ("training samples/s against bare physics", f"{share:.3f}")]


def phases(learner: Learner) -> dict[str, Callable[[], object]]:
    """An iteration in its parts, one after the other."""
    held: list[TensorDictBase] = []
    return {
        "collecting": lambda: held.append(collect(learner)),
        "advantages": lambda: estimate_advantage(learner, held[-1]),
        "update": lambda: learner.stepper.update(held[-1]),
    }


def stepping(learner: Learner, physics: Any) -> float:
    """Time that a batch's physics takes while it is collected [s]."""
    step, spent = physics.step, []

    def timed(*args: Any, **told: Any) -> None:
        spent.append(seconds(lambda: step(*args, **told), "cpu"))

    physics.step = timed
    collect(learner)
    physics.step = step
    return sum(spent)


def kernels(learner: Learner) -> dict[str, float]:
    """Time of a batch's kernels by what they are for [s]; what is between them, and within loops of the solver that a
    profiler does not see into, is in none.
    """
    with torch.profiler.profile(activities=[torch.profiler.ProfilerActivity.CUDA]) as profile:
        collect(learner)
        torch.cuda.synchronize()
    spent: dict[str, float] = {}
    for event in profile.key_averages():
        kind = next((kind for kind, words in KERNELS.items() if any(word in event.key for word in words)), "the rest")
        spent[kind] = spent.get(kind, 0.0) + 1e-6 * event.self_device_time_total
    return spent


def seconds(function: Callable[[], object], device: str) -> float:
    if device != "cpu":
        torch.cuda.synchronize()
    start = time.perf_counter()
    function()
    if device != "cpu":
        torch.cuda.synchronize()
    return time.perf_counter() - start


def origin(cfg: Config) -> str:
    commit = (
        cfg.commit
        or subprocess.run(
            ["git", "rev-parse", "--short", "HEAD"], capture_output=True, text=True, check=False
        ).stdout.strip()
    )
    where = torch.cuda.get_device_name() if cfg.device != "cpu" else f"{len(os.sched_getaffinity(0))} cores"
    flags = f"--device {cfg.device} --num-envs {cfg.num_envs} --cone {cfg.cone}{' --learn' if cfg.learn else ''}"
    flags += (" --flat" if cfg.flat else "") + (f" --policy {cfg.policy}" if cfg.policy != "wbc" else "")
    flags += (" --fuse" if cfg.fuse else "") + ("" if cfg.pairs else " --pairs 0")
    machine = f"{where} of {platform.machine()}, torch {torch.__version__}"
    return f"`python benchmarks/control_step.py {flags}`, commit {commit}, {machine}."


if __name__ == "__main__":
    main(tyro.cli(Config))
