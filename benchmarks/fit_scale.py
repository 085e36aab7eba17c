"""What a fit of a long log takes: time, memory, and whether it holds its budgets.

    python -m benchmarks.fit_scale --minutes 3 60 --rate 1000

A Z1 arm with dry friction swings for a minute, and again, and again. Memory is the most that the process held while
fitting; what was loaded before counts.
"""

from __future__ import annotations

import time
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

import mujoco
import numpy as np
import tyro
from numpy.typing import NDArray

from benchmarks.by_case import Row, run_cases
from benchmarks.real_robots.run import forget_memory, most_memory
from torchrl_athletic.diagnosis import fit
from torchrl_athletic.recordings import Recording
from torchrl_athletic.robots import z1

Array = NDArray[np.float64]

PERIOD = 60.0
"""After which the motion repeats [s]."""


@dataclass(frozen=True)
class Config:
    """Every field is a flag."""

    minutes: tuple[float, ...] = (3.0, 60.0)
    rate: float = 1000.0
    """[Hz]."""
    time_budget: float | None = None
    """[s]."""
    memory: float | None = None
    """[GB]."""
    output: Path = Path("benchmarks/results/fit_scale.md")


def main(cfg: Config) -> None:
    names = {f"{m:g} min at {cfg.rate:g} Hz, budget {cfg.time_budget or 'none'}": m for m in cfg.minutes}
    run_cases(list(names), lambda case: run(names[case], cfg), table, cfg.output)


def run(minutes: float, cfg: Config) -> Row:
    """Fit one log."""
    xml, take = arm(minutes, cfg.rate)
    forget_memory()
    begin, used = time.monotonic(), time.process_time()
    fitted = fit(xml, [take], time_budget=cfg.time_budget, memory=cfg.memory)
    score = fitted.scores["train"]
    return {
        "values": take.position.size,
        "wall": time.monotonic() - begin,
        "cpu": time.process_time() - used,
        "memory": most_memory() / 1e9,
        "before": score.before,
        "after": score.after,
    }


def arm(minutes: float, rate: float) -> tuple[str, Recording]:
    """A Z1 whose gripper is closed for good, and a log of it with dry friction that the model lacks."""
    spec = z1().spec()
    names = tuple(name for name in z1().joint_names if "ripper" not in name)
    for joint in list(spec.joints):
        if joint.name not in names:
            for actuator in list(spec.actuators):
                if actuator.target == joint.name:
                    spec.delete(actuator)
            spec.delete(joint)
    model = spec.compile()
    xml = spec.to_xml()
    rubbed = mujoco.MjModel.from_xml_string(xml)
    rubbed.opt.timestep = 1.0 / rate
    rubbed.dof_frictionloss[:] = 0.5
    data = mujoco.MjData(rubbed)
    time = np.arange(int(PERIOD * rate)) / rate
    rng = np.random.default_rng(0)
    pose = np.array(z1().default_pose)[: model.nq]
    tones = np.round(rng.uniform(0.1, 0.8, (3, model.nq)) * PERIOD) / PERIOD
    target = pose + 0.15 * np.sin(2 * np.pi * tones * time[:, None, None] + rng.uniform(0, 6, tones.shape)).sum(1)
    data.qpos[:] = target[0]
    position, torque = np.empty_like(target), np.empty_like(target)
    for k in (*range(len(time)), *range(len(time))):  # the second time it is periodic
        u = 60.0 * (target[k] - data.qpos) - 3.0 * data.qvel
        position[k], torque[k] = data.qpos, u
        data.qfrc_applied[:] = u
        mujoco.mj_step(rubbed, data)
    repeats = int(np.ceil(60 * minutes / PERIOD))
    long = np.arange(int(60 * minutes * rate)) / rate
    position, torque = (np.tile(x, (repeats, 1))[: len(long)] for x in (position, torque))
    position = position + 1e-4 * rng.standard_normal(position.shape)
    return xml, Recording(long, names, position, torque_command=torque)


def table(rows: Mapping[str, Row]) -> str:
    """The results as Markdown."""
    lines = [
        "Made by `python -m benchmarks.fit_scale`. A Z1 arm, six joints. The machine was shared: times are upper "
        "bounds.",
        "",
        "| log | readings | wall time | CPU time | memory | error: given, fitted | commit | machine |",
        "|---|---|---|---|---|---|---|---|",
    ]
    lines += [
        f"| {case} | {r['values'] / 1e6:.1f} M | {r['wall']:.0f} s | {r['cpu']:.0f} s | {r['memory']:.2f} GB | "
        f"{1e3 * r['before']:.1f}, {1e3 * r['after']:.1f} mrad | {r['commit']} | {r['machine']} |"
        for case, r in rows.items()
    ]
    return "\n".join(lines) + "\n"


if __name__ == "__main__":
    main(tyro.cli(Config))
