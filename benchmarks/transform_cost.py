"""What each transform adds to an environment's step, next to the stock transform that is nearest to it.

    taskset -c 0,1 python benchmarks/transform_cost.py

Five minutes. The environment is the package's toy, pure torch, whose episodes end now and then, so that masked resets
are part of what is timed. All variants take turns, a step each, in an order drawn anew; a cost is the difference of
medians over rounds with and without the transform, in CPU time of one thread. The stock transforms are ``CatFrames``,
of the same entry and length, for ``ObservationHistory``, and ``StepCounter`` with a limit for the others, whatever they
do.
"""

from __future__ import annotations

import os
import platform
import random
import subprocess
import sys
import time
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from statistics import median, quantiles

import torch
import torchrl
import tyro
from torch import nn
from torchrl.envs import CatFrames, Compose, EnvBase, StepCounter, Transform, TransformedEnv
from tqdm import trange

from torchrl_athletic import transforms as ours
from torchrl_athletic.functional import rewards
from torchrl_athletic.functional.commands import CommandRanges
from torchrl_athletic.functional.phase import throw_phases
from torchrl_athletic.testing import ToyEnv

JOINTS = 7
"""Joints of the toy: those of an arm with its gripper. Its observation is twice as wide."""
HISTORY = 10
NEVER = 1_000_000
"""Steps: StepCounter has a limit, as everybody gives it one, but the toy ends its episodes itself."""


@dataclass(frozen=True)
class Config:
    """Every field is a flag."""

    num_envs: tuple[int, ...] = (1, 1024, 4096)
    """Batch sizes."""
    rounds: int = 40
    """Measurements of each variant."""
    steps: int = 54
    """Steps of each environment in a round: an episode."""
    episode: int = 50
    """Least length of an episode [steps]; rows differ by up to 4."""
    only: tuple[str, ...] = ()
    """Names of transforms; none means all."""
    commit: str = ""
    """Commit of the code, where git cannot tell."""
    output: Path = Path("benchmarks/results/transform_cost.md")
    """Where the table goes."""


def main(cfg: Config) -> None:
    torch.set_num_threads(1)
    random.seed(0)
    names = [name for name in OURS if not cfg.only or name in cfg.only]
    tables = [table(num_envs, measure(num_envs, names, cfg), names) for num_envs in cfg.num_envs]
    report = "\n".join([*heading(cfg), *(line for lines in tables for line in lines), ""])
    print(report)
    cfg.output.parent.mkdir(parents=True, exist_ok=True)
    temporary = cfg.output.with_suffix(".part")
    temporary.write_text(report)
    os.replace(temporary, cfg.output)


def measure(num_envs: int, names: list[str], cfg: Config) -> dict[str, list[float]]:
    """Time per step of each variant, round by round [s]."""
    variants = {BARE: Compose} | STOCK | {name: OURS[name] for name in names}
    runs = {name: Run(make(), num_envs, cfg) for name, make in variants.items()}
    times: dict[str, list[float]] = {name: [] for name in runs}
    order = list(runs)
    for run in runs.values():
        run()
    for _ in trange(cfg.rounds, desc=f"{num_envs} envs", unit="round"):
        took = dict.fromkeys(runs, 0.0)
        for _ in range(cfg.steps):
            random.shuffle(order)
            for name in order:
                start = time.process_time()
                runs[name]()
                took[name] += time.process_time() - start
        for name, total in took.items():
            times[name].append(total / cfg.steps)
    return times


class Run:
    """One more step of an environment with one transform."""

    def __init__(self, transform: Transform, num_envs: int, cfg: Config) -> None:
        toy = ToyEnv(num_envs=num_envs, joints=JOINTS, shortest=cfg.episode)
        self.env: EnvBase = TransformedEnv(toy, transform)
        self.current = self.env.reset()
        self.action = self.env.full_action_spec.rand()

    @torch.no_grad()
    def __call__(self) -> None:
        self.current.update(self.action)
        _, self.current = self.env.step_and_maybe_reset(self.current)


def table(num_envs: int, times: dict[str, list[float]], names: list[str]) -> list[str]:
    lines = [
        f"## {num_envs:,} env{'s' * (num_envs > 1)}",
        "",
        f"The environment alone: {1e6 * median(times[BARE]):.0f} µs a step.",
        "",
        "| transform | µs a step | stock one | µs a step | ours / stock |",
        "|---|---|---|---|---|",
    ]
    for name in names:
        stock = "CatFrames" if name.startswith("ObservationHistory") else "StepCounter"
        mine, theirs = (1e6 * (median(times[key]) - median(times[BARE])) for key in (name, stock))
        low, high = interval(times[name], times[stock], times[BARE])
        lines.append(
            f"| {name} | {mine:.0f} | {stock} | {theirs:.0f} | {mine / theirs:.2f} ({low:.2f} to {high:.2f}) |"
        )
    return [*lines, ""]


def interval(mine: list[float], stock: list[float], bare: list[float], draws: int = 500) -> tuple[float, float]:
    """Bounds of the ratio of costs, by drawing rounds anew: nine times in ten it is within them."""
    found = []
    for _ in range(draws):
        rounds = random.choices(range(len(bare)), k=len(bare))
        a, b, c = (median(times[k] for k in rounds) for times in (mine, stock, bare))
        found.append((a - c) / (b - c))
    bounds = quantiles(found, n=20)
    return bounds[0], bounds[-1]


def corrected() -> Transform:
    """Delay, lag, torque scale and limit, as a diagnosis might have found them."""
    joints = [f"joint{k}" for k in range(JOINTS)]
    found = {
        "actuation_delay": {"delay": {"value": 0.012}},
        "actuation_lag": {"time_constant": {"value": 0.004}},
        "torque_scale": {"scale": {"value": 0.9}},
    }
    effects = [
        {"effect": name, "joint": joint, "parameters": parameters}
        for name, parameters in found.items()
        for joint in joints
    ]
    correction = {"schema": "torchrl_athletic/corrected/1", "joint_names": joints, "effects": effects, "trims": []}
    return ours.CorrectedActuation(
        correction, timestep=0.005, kp=20.0, kd=0.5, torque_limit=30.0, keys=ours.CorrectedKeys("action", "target")
    )


def reward_terms() -> Transform:
    """Two terms, shown."""
    terms = {name: ours.Term(rewards.square, f"joint_{name}") for name in ("position", "velocity")}
    return ours.RewardTerms(terms, dict.fromkeys(terms, -1e-3))


def reference() -> Transform:
    swing = torch.linspace(0, 1, 101).unsqueeze(-1).expand(-1, JOINTS)
    return ours.ReferenceTrajectory({"arm": swing}, table_dt=0.02, dt=0.02)


BARE = "no transform"
STOCK: dict[str, Callable[[], Transform]] = {
    "CatFrames": lambda: CatFrames(HISTORY, dim=-1, in_keys=["observation"], out_keys=["history"]),
    "StepCounter": lambda: StepCounter(NEVER),
}
OURS: dict[str, Callable[[], Transform]] = {
    "ObservationHistory": lambda: ours.ObservationHistory(["observation"], HISTORY, ["history"]),
    "ObservationHistory, flat": lambda: ours.ObservationHistory(["observation"], HISTORY, ["history"], flatten=True),
    "ActionHistory, 3 long": lambda: ours.ActionHistory(3),
    "ActionDelay, up to 6": lambda: ours.ActionDelay(6, before=0.0),
    "TorqueSpeedClip": lambda: ours.TorqueSpeedClip(30.0, 10.0, torque_key="action"),
    "OverspeedBrake": lambda: ours.OverspeedBrake(30.0, 10.0, torque_key="action"),
    "PowerClip": lambda: ours.PowerClip(200.0, torque_key="action"),
    "PowerClip of some joints": lambda: ours.PowerClip(200.0, joints="neighbours", torque_key="action"),
    "PDControl": lambda: ours.PDControl(20.0, 0.5, torque_key="action", action_key="target"),
    "UANCorrection, net of one layer": lambda: ours.UANCorrection(
        nn.Linear(40, 1), keys=ours.UANKeys("action", "action")
    ),
    "CorrectedActuation": corrected,
    "Decimation(1)": lambda: ours.Decimation(1),
    "TaskPhase, throw": lambda: ours.TaskPhase(throw_phases(), dt=0.02),
    "GaitClock": lambda: ours.GaitClock(dt=0.02),
    "ReferenceTrajectory": reference,
    "CommandSampler": lambda: ours.CommandSampler(CommandRanges(), dt=0.02, base_keys=None, end_effector_keys=None),
    "RewardTerms, two": reward_terms,
}


def heading(cfg: Config) -> list[str]:
    return [
        "# Cost of transforms",
        "",
        f"    python benchmarks/{Path(__file__).name} {' '.join(sys.argv[1:])}".rstrip(),
        "",
        f"Commit {cfg.commit or commit()}; {processor()}, {platform.system()}; Python {platform.python_version()}, "
        f"torch {torch.__version__}, torchrl {torchrl.__version__}.",
        "",
        f"CPU time of one thread that a transform adds to `step_and_maybe_reset` of a `TransformedEnv` with an empty "
        f"`Compose`, {JOINTS} joints, an episode's end every {cfg.episode} to {cfg.episode + 4} steps of a row; "
        f"`CatFrames` and `ObservationHistory` hold {HISTORY} frames of {2 * JOINTS} numbers. Differences of medians "
        f"of {cfg.rounds} rounds of {cfg.steps} steps; in brackets the 90 % interval of the ratio (bootstrap over "
        "rounds). An episode's end costs too, so that rows with many random numbers to draw pay there.",
        "",
    ]


def commit() -> str:
    found = subprocess.run(["git", "rev-parse", "--short", "HEAD"], capture_output=True, text=True)
    return found.stdout.strip() or "unknown"


def processor() -> str:
    info = Path("/proc/cpuinfo")
    lines = info.read_text().splitlines() if info.exists() else []
    names = [line.partition(":")[2].strip() for line in lines if line.startswith("model name")]
    usable = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count()
    return f"{names[0] if names else platform.machine()}, {usable} of {os.cpu_count()} CPUs"


if __name__ == "__main__":
    main(tyro.cli(Config))
