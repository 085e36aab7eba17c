"""Steps per second of one environment in three libraries: ours, TorchRL's own MuJoCo environments, Gymnasium's vector.

    taskset -c 0,1 python benchmarks/env_rivals.py

Fifteen minutes. The environment is the hopper of TorchRL: its model, five physics steps of 5 ms per step, its
observation, reward and end of episode, from one start without noise. The rivals run it as they are meant to be run,
single environments in processes; TorchRL also in one process. Every library first looks for its own best batch size,
then the best ones are timed in turn, in wall time. All must show what ours shows, or the benchmark stops.

Gymnasium's own hopper imports imageio and glfw, for pictures. It takes part where they are installed, on TorchRL's
model; a lean one takes part in any case: MuJoCo's bindings alone, no ``info``, no wrappers.
"""

from __future__ import annotations

import inspect
import os
import platform
import subprocess
import sys
import time
from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from importlib.util import find_spec
from pathlib import Path
from statistics import median
from typing import Any

import gymnasium
import mujoco
import numpy as np
import torch
import torchrl
import tyro
from tensordict import TensorDictBase
from torch import Tensor
from torchrl.envs import (
    ActionScaling,
    CatTensors,
    Compose,
    EnvBase,
    HopperEnv,
    ParallelEnv,
    SerialEnv,
    StepCounter,
    TransformedEnv,
    UnaryTransform,
)
from tqdm import tqdm

from torchrl_athletic.envs import TorqueEnv
from torchrl_athletic.physics import BatchPhysics
from torchrl_athletic.robots.from_mjcf import from_mjcf
from torchrl_athletic.training.rollout import control_step
from torchrl_athletic.transforms import Decimation, RewardTerms

FRAME_SKIP, LIMIT = 5, 1000
"""Physics steps per step; steps of the longest episode."""
MODEL = Path(inspect.getfile(HopperEnv)).parent / "assets" / str(HopperEnv.XML_PATH)
SENSORS = """<sensor>
  <jointpos name="x" joint="rootx"/> <jointpos name="z" joint="rootz"/> <jointpos name="pitch" joint="rooty"/>
  <jointvel name="dx" joint="rootx"/> <jointvel name="dz" joint="rootz"/> <jointvel name="dpitch" joint="rooty"/>
</sensor>"""


@dataclass(frozen=True)
class Config:
    """Every field is a flag."""

    ours: tuple[int, ...] = (16, 64, 256, 1024, 4096)
    """Batch sizes to try."""
    rivals: tuple[int, ...] = (2, 4, 16, 64, 256)
    """Batch sizes to try with the rivals, a process each; those in one process take them too."""
    most_processes: int = 64
    """Larger batches are left out where each takes a process."""
    seconds: float = 3.0
    """Duration of one measurement."""
    pairs: int = 7
    """Ratios per row."""
    commit: str = ""
    """Commit of the code, where git cannot tell."""
    output: Path = Path("benchmarks/results/env_rivals.md")
    """Where the table goes."""


Step = Callable[[], None]
"""Step all environments once."""


def main(cfg: Config) -> None:
    torch.set_num_threads(1)
    check_agreement()
    tried = {name: {n: alone(name, n, cfg) for n in sizes(name, cfg)} for name in tqdm(VARIANTS, unit="library")}
    best = {name: max(found, key=lambda n: found[n]) for name, found in tried.items()}
    runs = {name: VARIANTS[name](n) for name, n in best.items()}
    rates: dict[str, list[float]] = {name: [] for name in runs}
    for k in tqdm(range(cfg.pairs), unit="round"):
        for name in list(runs)[:: 1 if k % 2 == 0 else -1]:
            rates[name].append(steps_per_second(runs[name], best[name], cfg))
    for run in runs.values():
        run.close()
    report = "\n".join([*heading(cfg), *rows(rates, best), "", *searched(tried), ""])
    print(report)
    cfg.output.parent.mkdir(parents=True, exist_ok=True)
    temporary = cfg.output.with_suffix(".part")
    temporary.write_text(report)
    os.replace(temporary, cfg.output)


def sizes(name: str, cfg: Config) -> tuple[int, ...]:
    if name in OURS:
        return cfg.ours
    return tuple(n for n in cfg.rivals if n <= cfg.most_processes or name == "TorchRL SerialEnv")


def alone(name: str, num_envs: int, cfg: Config) -> float:
    """Steps per second of all environments of a batch together."""
    run = VARIANTS[name](num_envs)
    found = steps_per_second(run, num_envs, cfg)
    run.close()
    return found


def steps_per_second(run: Run, num_envs: int, cfg: Config) -> float:
    run.step()
    count, start = 0, time.perf_counter()
    while time.perf_counter() - start < cfg.seconds:
        run.step()
        count += 1
    return count * num_envs / (time.perf_counter() - start)


class Run:
    """An environment under random actions."""

    def __init__(self, step: Step, close: Callable[[], Any]) -> None:
        self.step, self.close = step, close


def hopper(num_envs: int) -> EnvBase:
    """TorchRL's hopper, put together from our parts."""
    robot = from_mjcf(
        MODEL.read_text().replace("</mujoco>", SENSORS + "</mujoco>"),
        torque_limit=200.0,
        sensors={"x": ("x",), "posture": ("z", "pitch"), "root_velocity": ("dx", "dz", "dpitch")},
    )
    physics = BatchPhysics(robot.model(), num_envs, usable_cpus(), joint_names=robot.joint_names)
    observed = ["posture", "joint_position", "root_velocity", "joint_velocity"]
    return TransformedEnv(
        TorqueEnv(robot, physics, terminate=fallen),
        Compose(
            ActionScaling(in_keys_inv=["torque"], out_keys_inv=["action"], loc=0.0, scale=200.0),
            Decimation(FRAME_SKIP),
            StepCounter(LIMIT),
            RewardTerms({"hop": partial(hop, dt=FRAME_SKIP * physics.timestep)}, {"hop": 1.0}, show=False),
            CatTensors(observed, "observation", del_keys=False, sort=False),
            UnaryTransform(["observation"], ["observation"], fn=clip_velocity),
        ),
    )


def fallen(tensordict: TensorDictBase) -> Tensor:
    height, pitch = tensordict["posture"].split(1, -1)
    return (height < HopperEnv.HEALTHY_Z_MIN) | (pitch.abs() > HopperEnv.HEALTHY_ANGLE_MAX)


def hop(before: TensorDictBase, after: TensorDictBase, dt: float) -> Tensor:
    effort = before["action"].square().sum(-1, keepdim=True)
    return (after["x"] - before["x"]) / dt + (~after["terminated"]).float() - HopperEnv.CTRL_COST_WEIGHT * effort


def clip_velocity(observation: Tensor) -> Tensor:
    return torch.cat((observation[..., :5], observation[..., 5:].clamp(-10, 10)), -1)


class GymHopper(gymnasium.Env):
    """The hopper in Gymnasium's terms, one env on MuJoCo's bindings."""

    def __init__(self) -> None:
        self.model = mujoco.MjModel.from_xml_path(str(MODEL))
        self.data = mujoco.MjData(self.model)
        self.dt, self.time = FRAME_SKIP * self.model.opt.timestep, 0
        self.observation_space = gymnasium.spaces.Box(-np.inf, np.inf, (11,))
        self.action_space = gymnasium.spaces.Box(-1.0, 1.0, (3,))

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> tuple[np.ndarray, dict]:
        super().reset(seed=seed)
        mujoco.mj_resetData(self.model, self.data)
        self.time = 0
        return self.observe(), {}

    def step(self, action: np.ndarray) -> tuple[np.ndarray, float, bool, bool, dict]:
        data, before = self.data, self.data.qpos[0]
        data.ctrl[:] = action
        mujoco.mj_step(self.model, data, FRAME_SKIP)
        self.time += 1
        healthy = data.qpos[1] >= HopperEnv.HEALTHY_Z_MIN and abs(data.qpos[2]) <= HopperEnv.HEALTHY_ANGLE_MAX
        reward = (data.qpos[0] - before) / self.dt + healthy - HopperEnv.CTRL_COST_WEIGHT * float(action @ action)
        return self.observe(), reward, not healthy, self.time >= LIMIT, {}

    def observe(self) -> np.ndarray:
        return np.concatenate((self.data.qpos[1:], self.data.qvel.clip(-10, 10))).astype(np.float32)


def torchrl_run(env: EnvBase, lean: bool = False) -> Run:
    """Step as TorchRL's collector does, or as our lean loop does."""
    current, action = env.reset(), env.full_action_spec.rand()

    def step() -> None:
        nonlocal current
        if lean:
            _, current = control_step(env, lambda tensordict: tensordict.update(action), current)
        else:
            _, current = env.step_and_maybe_reset(current.update(action))

    return Run(torch.no_grad()(step), partial(env.close, raise_if_closed=False))


def gymnasium_run(num_envs: int) -> Run:
    envs = gymnasium.vector.AsyncVectorEnv([GymHopper] * num_envs, context="fork")
    envs.reset()
    action = envs.action_space.sample()
    return Run(lambda: (envs.step(action), None)[1], envs.close)


def gymnasium_own_run(num_envs: int) -> Run:
    same: dict[str, Any] = {"xml_file": str(MODEL), "frame_skip": FRAME_SKIP, "reset_noise_scale": 0.0}
    envs = gymnasium.make_vec("Hopper-v5", num_envs, "async", vector_kwargs={"context": "fork"}, **same)
    envs.reset()
    action = envs.action_space.sample()
    return Run(lambda: (envs.step(action), None)[1], envs.close)


def stock_hopper() -> EnvBase:
    return HopperEnv(backend="mujoco", reset_noise_scale=0.0, max_episode_steps=LIMIT)


def check_agreement(steps: int = 8) -> None:
    """Stop unless the three show the same for the same actions."""
    mine, stock, gym = hopper(2), stock_hopper(), GymHopper()
    shown, theirs = mine.reset(), stock.reset()
    np.testing.assert_allclose(shown["observation"][:1], theirs["observation"], atol=1e-6)
    np.testing.assert_allclose(shown["observation"][0], gym.reset()[0], atol=1e-6)
    for k in range(steps):
        action = torch.from_numpy(np.random.default_rng(k).uniform(-1, 1, (1, 3))).float()
        shown = mine.step(shown.set("action", action.expand(2, 3).clone()))["next"]
        theirs = stock.step(theirs.set("action", action))["next"]
        observation, reward, terminated, *_ = gym.step(action[0].numpy())
        for ours_, stock_, gym_ in (
            (shown["observation"][0], theirs["observation"][0], observation),
            (shown["reward"][0, 0], theirs["reward"][0, 0], reward),
        ):
            np.testing.assert_allclose(ours_, stock_, rtol=1e-3, atol=1e-3)
            np.testing.assert_allclose(ours_, gym_, rtol=1e-3, atol=1e-3)
        assert bool(shown["done"][0]) == bool(theirs["done"][0]) == terminated
        if terminated:
            break


OURS: dict[str, Callable[[int], Run]] = {
    "ours, lean loop": lambda n: torchrl_run(hopper(n), lean=True),
    "ours": lambda n: torchrl_run(hopper(n)),
}
VARIANTS: dict[str, Callable[[int], Run]] = OURS | {
    "TorchRL ParallelEnv": lambda n: torchrl_run(ParallelEnv(n, stock_hopper, mp_start_method="fork")),
    "TorchRL SerialEnv": lambda n: torchrl_run(SerialEnv(n, stock_hopper)),
    "Gymnasium AsyncVectorEnv, lean env": gymnasium_run,
}
if find_spec("imageio") and find_spec("glfw"):
    VARIANTS["Gymnasium make_vec, its Hopper-v5"] = gymnasium_own_run


def rows(rates: dict[str, list[float]], best: dict[str, int]) -> list[str]:
    lines = ["| environment | envs | steps/s | ours / it | ours, lean loop / it |", "|---|---|---|---|---|"]
    for name, found in rates.items():
        cells = []
        for mine in ("ours", "ours, lean loop"):
            ratios = [a / b for a, b in zip(rates[mine], found, strict=True)]
            shown = f"{median(ratios):.1f} ({min(ratios):.1f} to {max(ratios):.1f})"
            cells.append("" if name in OURS else shown)
        lines.append(f"| {name} | {best[name]} | {median(found) / 1e3:.1f} k | {' | '.join(cells)} |")
    return lines


def searched(tried: dict[str, dict[int, float]]) -> list[str]:
    lines = ["The search for the best batch size, steps/s:", ""]
    for name, found in tried.items():
        lines.append(f"- {name}: " + ", ".join(f"{n} envs {rate / 1e3:.1f} k" for n, rate in found.items()))
    return lines


def heading(cfg: Config) -> list[str]:
    return [
        "# One environment in three libraries",
        "",
        f"    python benchmarks/{Path(__file__).name} {' '.join(sys.argv[1:])}".rstrip(),
        "",
        f"Commit {cfg.commit or commit()}; {processor()}, {platform.system()}; Python {platform.python_version()}, "
        f"MuJoCo {mujoco.__version__}, torch {torch.__version__}, torchrl {torchrl.__version__}, "
        f"gymnasium {gymnasium.__version__}.",
        "",
        f"TorchRL's hopper, {FRAME_SKIP} physics steps per step, random actions, episodes starting anew where they "
        f"end; its best batch size for each. Wall time; ratios are medians (least to greatest) of {cfg.pairs} rounds. "
        "Ours and TorchRL's are stepped by `step_and_maybe_reset`; the lean loop is that of `Rollout`.",
        "",
    ]


def usable_cpus() -> int:
    """Those that this process may use, which ``taskset`` limits."""
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1


def commit() -> str:
    found = subprocess.run(["git", "rev-parse", "--short", "HEAD"], capture_output=True, text=True)
    return found.stdout.strip() or "unknown"


def processor() -> str:
    info = Path("/proc/cpuinfo")
    lines = info.read_text().splitlines() if info.exists() else []
    names = [line.partition(":")[2].strip() for line in lines if line.startswith("model name")]
    return f"{names[0] if names else platform.machine()}, {usable_cpus()} of {os.cpu_count()} CPUs"


if __name__ == "__main__":
    main(tyro.cli(Config))
