"""How much of MuJoCo's own batch throughput is left behind ``BatchPhysics``, and what a Python loop would reach.

    python benchmarks/replay_throughput.py

Two minutes. Prints the table and writes it to ``--output``. The library and its rival replay the same inputs from the
same states in turn (A B, B A, A B, ...) and each pair gives one ratio, of CPU time and not of wall time: a busy machine
then disturbs both alike. Both must end in the same state to the last bit, or the benchmark stops.
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

import mujoco
import numpy as np
import torch
import tyro
from mujoco.batch import Batch
from tqdm import tqdm

from torchrl_athletic.physics import BatchPhysics

LOOP_PAIRS = 3
Replay = Callable[[], np.ndarray]
"""Advance all envs by all steps; returns where they end, (N, nq)."""


@dataclass(frozen=True)
class Config:
    """Every field is a flag."""

    num_envs: tuple[int, ...] = (16, 256, 1024)
    """Batch sizes."""
    threads: int = 1
    """Threads of library and rival; the Python loop has one."""
    pairs: int = 15
    """Ratios per row."""
    env_steps: int = 8192
    """Physics steps of one measurement, all envs together; at least 8 steps for each env."""
    output: Path = Path("benchmarks/results/replay_throughput.md")
    """Where the table goes."""


def main(cfg: Config) -> None:
    torch.set_num_threads(1)
    rows = []
    cases = [(name, num_envs, case) for name in MODELS for num_envs in cfg.num_envs for case in CASES]
    for name, num_envs, case in tqdm(cases, unit="row"):
        model = mujoco.MjModel.from_xml_string(MODELS[name])
        steps = max(8, cfg.env_steps // num_envs)
        ours, raw, loop = CASES[case](Take(model, num_envs, steps, cfg.threads))
        per_second = num_envs * steps / median(seconds(ours) for _ in range(3))
        to_raw, to_loop = ratios(ours, raw, cfg.pairs), ratios(ours, loop, min(cfg.pairs, LOOP_PAIRS))
        rows.append(f"| {name} | {num_envs} | {case} | {per_second / 1e3:.0f} k | {shown(to_raw)} | {shown(to_loop)} |")
    report = "\n".join([*heading(cfg), *rows, ""])
    print(report)
    cfg.output.parent.mkdir(parents=True, exist_ok=True)
    temporary = cfg.output.with_suffix(".part")
    temporary.write_text(report)
    os.replace(temporary, cfg.output)


def ratios(ours: Replay, rival: Replay, pairs: int) -> list[float]:
    """Throughput of ours over the rival's, pair by pair."""
    np.testing.assert_array_equal(ours(), rival())
    found: list[float] = []
    for k in range(pairs):
        first, second = (ours, rival) if k % 2 == 0 else (rival, ours)
        took = {first: seconds(first), second: seconds(second)}
        found.append(took[rival] / took[ours])
    return found


def seconds(replay: Replay) -> float:
    """CPU time, of all threads."""
    start = time.process_time()
    replay()
    return time.process_time() - start


def shown(found: list[float]) -> str:
    return f"{median(found):.2f} ({min(found):.2f} to {max(found):.2f})"


@dataclass(frozen=True)
class Take:
    """What is replayed: start velocities and torques."""

    model: mujoco.MjModel
    num_envs: int
    steps: int
    threads: int

    def velocity(self) -> np.ndarray:
        """Shape (N, nv)."""
        return np.random.default_rng(0).normal(size=(self.num_envs, self.model.nv))

    def torque(self) -> np.ndarray:
        """Shape (N, T, J)."""
        return np.random.default_rng(1).normal(size=(self.num_envs, self.steps, self.model.nv - self.first_dof))

    @property
    def first_dof(self) -> int:
        """Degrees of freedom of a floating base come first, and nothing drives them."""
        return 6 if self.model.jnt_type[0] == mujoco.mjtJoint.mjJNT_FREE.value else 0


def torque_each_step(take: Take) -> tuple[Replay, Replay, Replay]:
    """A controller's case: new torques before each step; what it reads are views, which cost nothing."""
    physics, batch = BatchPhysics(take.model, take.num_envs, take.threads), raw_batch(take)
    velocity, torque = take.velocity(), take.torque()
    given = list(torch.from_numpy(torque).unbind(1))

    def ours() -> np.ndarray:
        physics.reset(qvel=velocity)
        for tau in given:
            physics.apply_torque(tau)
            physics.step()
        return physics.qpos.numpy().copy()

    def raw() -> np.ndarray:
        restart(batch, velocity)
        qpos, forces = batch.bind("qpos"), batch.bind("qfrc_applied")
        for k in range(take.steps):
            forces[:, take.first_dof :] = torque[:, k]
            batch.step()
        return qpos.copy()

    return ours, raw, python_loop(take, torque)


def step_alone(take: Take) -> tuple[Replay, Replay, Replay]:
    """One call a step, nothing written."""
    physics, batch, velocity = BatchPhysics(take.model, take.num_envs, take.threads), raw_batch(take), take.velocity()

    def ours() -> np.ndarray:
        physics.reset(qvel=velocity)
        for _ in range(take.steps):
            physics.step()
        return physics.qpos.numpy().copy()

    def raw() -> np.ndarray:
        restart(batch, velocity)
        for _ in range(take.steps):
            batch.step()
        return batch.bind("qpos").copy()

    return ours, raw, python_loop(take, None)


def native_rollout(take: Take) -> tuple[Replay, Replay, Replay]:
    """One call for all steps, torques given and positions and velocities recorded."""
    physics, batch, velocity = BatchPhysics(take.model, take.num_envs, take.threads), raw_batch(take), take.velocity()
    torque = take.torque()
    given = torch.from_numpy(torque)
    forces = np.concatenate((np.zeros((take.num_envs, take.steps, take.first_dof)), torque), axis=2)

    def ours() -> np.ndarray:
        physics.reset(qvel=velocity)
        return physics.rollout(take.steps, given, into="torque")["qpos"][:, -1].numpy()

    def raw() -> np.ndarray:
        restart(batch, velocity)
        spec = mujoco.mjtState.mjSTATE_QFRC_APPLIED.value
        return batch.rollout(take.steps, forces, spec, ("qpos", "qvel"))["qpos"][:, -1]

    return ours, raw, python_loop(take, torque)


def raw_batch(take: Take) -> Batch:
    return Batch(take.model, take.num_envs, take.threads)


def restart(batch: Batch, velocity: np.ndarray) -> None:
    batch.reset(stage=mujoco.mjtStage.mjSTAGE_NONE.value)
    batch.bind("qvel")[:] = velocity


def python_loop(take: Take, torque: np.ndarray | None) -> Replay:
    """``mj_step`` on one ``MjData`` an env, a step of all envs before the next."""
    envs = [mujoco.MjData(take.model) for _ in range(take.num_envs)]
    velocity, model, step = take.velocity(), take.model, mujoco.mj_step

    def loop() -> np.ndarray:
        for data, row in zip(envs, velocity, strict=True):
            mujoco.mj_resetData(model, data)
            data.qvel[:] = row
        for k in range(take.steps):
            for i, data in enumerate(envs):
                if torque is not None:
                    data.qfrc_applied[take.first_dof :] = torque[i, k]
                step(model, data)
        return np.stack([data.qpos for data in envs])

    return loop


def heading(cfg: Config) -> list[str]:
    commit = subprocess.run(["git", "rev-parse", "--short", "HEAD"], capture_output=True, text=True).stdout.strip()
    return [
        "# Replay throughput of BatchPhysics",
        "",
        f"    python {' '.join([Path(__file__).parent.name + '/' + Path(__file__).name, *sys.argv[1:]])}",
        "",
        f"Commit {commit}; {processor()}, {os.cpu_count()} CPUs, {platform.system()}; "
        f"Python {platform.python_version()}, MuJoCo {mujoco.__version__}, torch {torch.__version__}; {cfg.threads} "
        "thread(s) for library and raw batch.",
        "",
        "Steps/s are physics steps of all envs together per second of CPU time, the median of three runs. Ratios are "
        f"those of BatchPhysics over the rival's: median (least to greatest) of {cfg.pairs} interleaved pairs against "
        f"the raw batch, of {min(cfg.pairs, LOOP_PAIRS)} against the loop.",
        "",
        "| model | envs | case | steps/s | over raw `mujoco.batch` | over a Python loop of `mj_step` |",
        "|---|---|---|---|---|---|",
    ]


def processor() -> str:
    info = Path("/proc/cpuinfo")
    lines = info.read_text().splitlines() if info.exists() else []
    names = [line.partition(":")[2].strip() for line in lines if line.startswith("model name")]
    return names[0] if names else platform.machine()


def link(joint: str, at: str, inside: str = "") -> str:
    return (
        f"<body pos='{at}'><joint name='{joint}' axis='0 1 0' damping='0.1' armature='0.01'/>"
        f"<geom type='capsule' fromto='0 0 0 0 0 -0.2' size='0.03' mass='0.5'/>{inside}</body>"
    )


def world(inside: str) -> str:
    apart = (
        "<default><geom contype='0' conaffinity='0'/><default class='contact'><geom contype='1'/></default></default>"
    )
    floor = "<geom type='plane' size='0 0 1' conaffinity='1'/>"
    option = "<option timestep='0.005' integrator='implicitfast'/>"
    return f"<mujoco>{option}{apart}<worldbody>{floor}{inside}</worldbody></mujoco>"


def arm(joints: int) -> str:
    body = ""
    for j in reversed(range(joints)):
        body = link(f"j{j}", "0 0 -0.2" if j else "0 0 2", body)
    return body


def quadruped() -> str:
    foot = "<geom class='contact' pos='0 0 -0.2' size='0.04' mass='0.1'/>"
    legs = "".join(
        link(f"hip{x}{y}", f"{0.2 * x} {0.1 * y} 0", link(f"knee{x}{y}", "0 0 -0.2", foot))
        for x in (-1, 1)
        for y in (-1, 1)
    )
    trunk = "<geom class='contact' type='box' size='0.25 0.1 0.05' mass='8'/>"
    return f"<body pos='0 0 0.45'><freejoint/>{trunk}{legs}</body>"


MODELS = {
    "pendulum, 1 joint": world(arm(1)),
    "arm, 6 joints": world(arm(6)),
    "quadruped, 8 joints, floating, contacts": world(quadruped()),
}
CASES = {"torque each step": torque_each_step, "step alone": step_alone, "native rollout": native_rollout}

if __name__ == "__main__":
    main(tyro.cli(Config))
