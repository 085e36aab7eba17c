"""How much of the physics' own speed is left when the whole environment stands around it.

    python benchmarks/control_step.py                                        # 1,024 robots on this machine's CPU
    python benchmarks/control_step.py --device cuda --num-envs 4096             # on a GPU
    python benchmarks/control_step.py --device cuda --num-envs 4096 --pairs 0 --learn    # whole PPO iterations, alone

The environment is the paper's for pre-training a B2 with a Z1: PD law, Unsupervised Actuator Net, both clips, delay,
four physics steps per action, commands, gait clock, task phase, a reference, 14 reward terms, ten frames of history,
resets. Its rival does as many physics steps from the same states, under the torques that acted at the end of each
control step, and nothing else: MuJoCo's batch on the CPU, a bare CUDA graph of MuJoCo Warp on a GPU. Both are timed in
turn; each pair gives one ratio.
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
from torchrl.envs import ActionScaling, EnvBase
from tqdm import trange

from torchrl_athletic.envs import make_physics, whole_body_env
from torchrl_athletic.networks import actor, critic, uan
from torchrl_athletic.physics import Physics
from torchrl_athletic.robots import Robot, b2z1
from torchrl_athletic.training import PPO, Learner, iterate
from torchrl_athletic.training.captured import CapturedRollout, fuse_transforms
from torchrl_athletic.training.ppo import collect, estimate_advantage
from torchrl_athletic.transforms import ReferenceTrajectory

DECIMATION = 4
STATE = ("qpos", "qvel", "qacc_warmstart")


@dataclass(frozen=True)
class Config:
    """Every field is a flag."""

    device: str = "cpu"
    """Where to run."""
    num_envs: int = 1024
    """Robots."""
    cone: str = "pyramidal"
    """Of friction."""
    pairs: int = 20
    """Ratios; each compares ``steps`` control steps. 0 leaves the comparison out, and its memory."""
    steps: int = 6
    """Control steps of a measurement."""
    noise: float = 0.3
    """Standard deviation of the actions about the default pose [rad]: keeps the robots in motion."""
    fuse: bool = False
    """Compile the transforms on the CPU too; on a GPU they are in any case."""
    learn: bool = False
    """Also time PPO iterations with nets of 3 x 512."""
    iterations: int = 20
    """PPO iterations to time."""
    commit: str = ""
    """Of the code, where git cannot tell."""
    output: Path = Path("benchmarks/results")
    """Folder for the table."""


def main(cfg: Config) -> None:
    torch.manual_seed(0)
    robot = b2z1(cone=cfg.cone)  # type: ignore[arg-type]
    rows = compare(robot, make_env(robot, cfg), cfg) if cfg.pairs else []
    if cfg.learn:
        gc.collect()  # or the environment above would count as memory of the training
        rows += learn(make_env(robot, cfg), cfg)
    table = "\n".join(["| what | figure |", "|---|---|", *(f"| {name} | {figure} |" for name, figure in rows)])
    text = f"# {'Control step' if cfg.pairs else 'PPO iteration'}\n\n{table}\n\n{origin(cfg)}\n"
    print(text)
    cfg.output.mkdir(parents=True, exist_ok=True)
    name = "control_step" if cfg.pairs else "ppo_iteration"
    (cfg.output / f"{name}_{cfg.device}{'_fused' if cfg.fuse else ''}.md").write_text(text)


def make_env(robot: Robot, cfg: Config) -> EnvBase:
    swing = torch.stack([torch.linspace(0, 1, 200)] * 7, -1)
    reference = ReferenceTrajectory({"arm": swing}, table_dt=0.02, dt=0.02)
    env = whole_body_env(
        robot, num_envs=cfg.num_envs, device=cfg.device, net=uan().to(cfg.device), extra=(reference,), max_steps=200
    )
    pose = torch.tensor(robot.default_pose, dtype=torch.float32)
    return env.append_transform(ActionScaling(loc=pose, scale=torch.full_like(pose, cfg.noise)))


def explore(robot: Robot, cfg: Config) -> Callable[[TensorDictBase], TensorDictBase]:
    """A policy that costs nothing: noise about the default pose."""
    size, device = (cfg.num_envs, len(robot.joint_names)), cfg.device
    return lambda tensordict: tensordict.set("action", torch.randn(size, device=device))


def compare(robot: Robot, env: Any, cfg: Config) -> list[tuple[str, str]]:
    if cfg.fuse and cfg.device == "cpu":
        fuse_transforms(env)
    rollout = CapturedRollout(env, explore(robot, cfg), cfg.steps, keys=["observation", "applied_torque"])
    rival = make_physics(robot, cfg.num_envs, cfg.device)
    physics: Physics = env.base_env.physics
    for _ in trange(10, desc="set robots in motion"):
        batch = rollout()
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
    torch.set_float32_matmul_precision("high")
    width, actions = env.observation_spec["observation"].shape[-1], env.action_spec.shape[-1]
    policy = actor(width, actions).to(cfg.device)
    learner = Learner(
        env, policy, critic(width).to(cfg.device), PPO(num_envs=cfg.num_envs), cuda_graph=cfg.device != "cpu"
    )
    for _ in range(3):
        iterate(learner)
    if cfg.device != "cpu":
        torch.cuda.reset_peak_memory_stats()
    times = [seconds(lambda: iterate(learner), cfg.device) for _ in trange(cfg.iterations, desc="learn")]
    rows = [(f"PPO iteration of {24 * cfg.num_envs:,} samples", f"{median(times):.3f} s")]
    if cfg.device != "cpu":
        peak, reserved = torch.cuda.max_memory_allocated(), torch.cuda.memory_reserved()
        torch.cuda.empty_cache()
        free, total = torch.cuda.mem_get_info()
        others = total - free - torch.cuda.memory_reserved()
        rows.append(("peak memory: torch's tensors, and all else", f"{peak / 2**30:.2f} + {others / 2**30:.2f} GiB"))
        rows.append(("reserved by torch, caches and graphs included", f"{reserved / 2**30:.2f} GiB"))
        rows.append(("held with caches emptied", f"{(total - free) / 2**30:.2f} GiB"))
    for name, phase in phases(learner).items():
        if cfg.device != "cpu":
            torch.cuda.reset_peak_memory_stats()
        took = f"{seconds(phase, cfg.device):.3f} s"
        if cfg.device != "cpu":
            took += f", torch's tensors up to {torch.cuda.max_memory_allocated() / 2**30:.2f} GiB"
        rows.append((f"{name} alone", took))
    return rows


def phases(learner: Learner) -> dict[str, Callable[[], object]]:
    """An iteration in its parts, one after the other."""
    held: list[TensorDictBase] = []
    return {
        "collecting": lambda: held.append(collect(learner)),
        "advantages": lambda: estimate_advantage(learner, held[-1]),
        "update": lambda: learner.stepper.update(held[-1]),
    }


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
    flags += (" --fuse" if cfg.fuse else "") + ("" if cfg.pairs else " --pairs 0")
    machine = f"{where} of {platform.machine()}, torch {torch.__version__}"
    return f"`python benchmarks/control_step.py {flags}`, commit {commit}, {machine}."


if __name__ == "__main__":
    main(tyro.cli(Config))
