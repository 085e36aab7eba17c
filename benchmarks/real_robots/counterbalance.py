"""A KUKA KR300's hydraulic counterbalance, which its model lacks: what ``diagnose`` says at the shoulder.

    python -m benchmarks.real_robots.counterbalance --data CLONES

The links of the authors' model file are given, and their three logs of ten seconds: one to fit, two kept aside. Their
simulation adds a bladder accumulator on the shoulder, in a function of its own, and friction and rotors, all of which
the model that is diagnosed does not have. What the accumulator gives by its data sheet is the truth here.
"""

from __future__ import annotations

import platform
import time
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import tyro
from numpy.typing import NDArray

from benchmarks.by_case import commit
from benchmarks.real_robots.robots.arms import kr300
from torchrl_athletic.diagnosis import diagnose
from torchrl_athletic.diagnosis.corrected import write_atomically
from torchrl_athletic.diagnosis.result import Answer

Array = NDArray[np.float64]

SHOULDER = 1
"""Index of the joint: axis 2."""


@dataclass(frozen=True)
class Config:
    """Every field is a flag."""

    data: Path = Path("clones")
    """Folder of clones, see :mod:`benchmarks.real_robots.robots`."""
    seed: int = 0
    report: Path = Path("out/counterbalance")
    """Where the diagnosis goes."""
    output: Path = Path("benchmarks/results/counterbalance.md")


def main(cfg: Config) -> None:
    robot = kr300(cfg.data)
    begin = time.process_time()
    found = diagnose(robot.xml, robot.recordings, robot.heldout, seed=cfg.seed, output=cfg.report)
    used = time.process_time() - begin
    position = np.concatenate([r.position[:, SHOULDER] for r in (*robot.recordings, *robot.heldout)])
    write_atomically(cfg.output, table(found.answer, position, used))
    print(cfg.output.read_text("utf-8"))


def accumulator_torque(position: Array) -> Array:
    """Torque of the accumulator on the shoulder [N·m], upright at zero.

    Geometry and gas are those of ``hydraulic_weight_counterbalance.m``: anchors 0.8 and 0.2 m from the axis, least
    force at -95 degrees of a joint whose zero is at -90; a piston of 55 mm on a rod of 30 mm; two accumulators of
    0.48 l and 79.5 g of nitrogen at 328 K.
    """
    far, near, area = 0.8, 0.2, np.pi * (0.055**2 - 0.030**2) / 4
    turned = position + np.radians(5.0)
    length = np.sqrt(far**2 + near**2 - 2 * far * near * np.cos(turned))
    gas = 1.01 * 296.8 * 328.0 * 2 * 0.0795  # p V [J]
    pressure = gas / (2 * 0.00048 - (length - (far - near)) * area)
    return np.asarray(-np.sin(turned) * far * near / length * pressure * area, dtype=np.float64)


def table(answer: Answer, position: Array, seconds: float) -> str:
    """What was said of the shoulder and of the other joints, as Markdown."""
    slope, at_zero = np.polyfit(position, accumulator_torque(position), 1)
    springs = [f for f in answer.findings if (f.effect, f.joint) == ("joint_spring", "axis_2")]
    lines = [
        f"Made by `python -m benchmarks.real_robots.counterbalance --data CLONES`, at {commit()}, on "
        f"{platform.machine()}, in {seconds:.0f} s of CPU time.",
        "",
        "| spring at axis_2 | said, 95 % | by the accumulator's data |",
        "|---|---|---|",
    ]
    if springs:
        said = springs[0].parameters
        rows = (("stiffness", "N·m/rad", -slope), ("preload", "N·m, the torque at zero", at_zero))
        for name, unit, truth in rows:
            low, high = said[name].ci95
            lines.append(f"| {name} [{unit}] | {said[name].value:.0f} ({low:.0f} to {high:.0f}) | {truth:.0f} |")
    else:
        lines.append(f"| stiffness [N·m/rad] | none was named | {-slope:.0f} |")
    lines += ["", "| said | at | law | class |", "|---|---|---|---|"]
    for f in answer.findings:
        lines.append(f"| `{f.effect}` | {f.joint} | {f.probability:.0%} | {f.class_probability:.0%} |")
    heldout = answer.fit["heldout"]
    lines += ["", f"Error kept aside: {1e3 * heldout.before:.0f} mrad before, {1e3 * heldout.after:.0f} after."]
    return "\n".join(lines) + "\n"


if __name__ == "__main__":
    main(tyro.cli(Config))
