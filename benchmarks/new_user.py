"""From nothing to a report, as the README has it: a URDF, logs in CSV, a column map, a fresh virtual environment.

    python benchmarks/new_user.py

A simulated arm of four joints hides dry friction in its elbow. The user has its URDF and logs in degrees, with names of
his own, at 250 Hz. The only file written by hand is the column map. Steps are the commands of the README, run in a copy
of the tracked files; the table says how long each took.
"""

from __future__ import annotations

import json
import os
import platform
import subprocess
import sys
import tempfile
import time
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import mujoco
import numpy as np
import tyro

ROOT = Path(__file__).parents[1]
JOINTS = ("base", "shoulder", "elbow", "wrist")
AXES = ("0 0 1", "0 1 0", "0 1 0", "0 1 0")
MASSES, LENGTHS = (3.0, 2.5, 1.8, 0.8), (0.1, 0.35, 0.3, 0.15)
HIDDEN = 1.2
"""Dry friction of the elbow [N·m]."""
COLUMNS = {
    "joint_names": list(JOINTS),
    "time": {"name": "t_ms", "unit": "ms"},
    "position": {"name": "{joint}_deg", "unit": "deg"},
    "torque_command": {"name": "{joint}_tau", "unit": "N·m"},
}
STEP, SAMPLE = 0.001, 0.004


@dataclass(frozen=True)
class Config:
    """Time the way from a fresh environment to a report."""

    output: Path = Path("benchmarks/results/new_user.md")
    """Table that is written."""


def main(config: Config) -> None:
    """Make the user's files, follow the README, write the table."""
    with tempfile.TemporaryDirectory() as folder:
        user = Path(folder)
        copy, python = user / "torchrl_athletic", user / "venv/bin/python"
        subprocess.run(["git", "clone", "-q", str(ROOT), str(copy)], check=True)
        make_files(user)
        flags = ("--model", "arm.urdf", "--recordings", "train", "--heldout", "heldout", "--columns", "columns.json")
        steps: dict[str, Sequence[str | Path]] = {
            "python -m venv venv": (sys.executable, "-m", "venv", "venv"),
            "pip install .": (python, "-m", "pip", "install", "-q", copy),
            f"python recipes/diagnose.py {' '.join(flags)} --output out": (
                *(python, copy / "recipes/diagnose.py", *flags),
                *("--output", "out"),
            ),
        }
        seconds = {name: timed(command, user) for name, command in steps.items()}
        if not (user / "out/report.html").exists():
            sys.exit("no report was written")
        answer = json.loads((user / "out/diagnosis.json").read_text(encoding="utf-8"))
    config.output.write_text(table(seconds, answer), encoding="utf-8")
    print(config.output.read_text(encoding="utf-8"))


def make_files(user: Path) -> None:
    """URDF, logs to fit and to keep aside, and the column map."""
    (user / "arm.urdf").write_text(urdf(), encoding="utf-8")
    (user / "columns.json").write_text(json.dumps(COLUMNS), encoding="utf-8")
    for seed, (name, duration) in enumerate({"train/a": 20.0, "train/b": 20.0, "heldout/c": 15.0}.items()):
        path = user / f"{name}.csv"
        path.parent.mkdir(exist_ok=True)
        log = record(duration, np.random.default_rng(seed))
        header = ",".join(["t_ms", *(f"{j}_deg" for j in JOINTS), *(f"{j}_tau" for j in JOINTS)])
        np.savetxt(path, log, delimiter=",", header=header, comments="", fmt="%.6g")


def urdf() -> str:
    """Of the arm as its maker has it, without friction."""
    links, joints = ['<link name="floor"/>'], []
    for k, (name, axis, mass, length) in enumerate(zip(JOINTS, AXES, MASSES, LENGTHS, strict=True)):
        turn = mass * length**2 / 12 + 1e-3
        inertia = f'ixx="{turn}" iyy="{turn}" izz="{mass * 1e-3}" ixy="0" ixz="0" iyz="0"'
        links.append(
            f'<link name="{name}_link"><inertial><origin xyz="0 0 {length / 2}"/><mass value="{mass}"/>'
            f"<inertia {inertia}/></inertial></link>"
        )
        parent, height = (f"{JOINTS[k - 1]}_link", LENGTHS[k - 1]) if k else ("floor", 0.0)
        joints.append(
            f'<joint name="{name}" type="revolute"><parent link="{parent}"/><child link="{name}_link"/>'
            f'<origin xyz="0 0 {height}"/><axis xyz="{axis}"/>'
            '<limit lower="-3" upper="3" effort="60" velocity="10"/></joint>'
        )
    return f'<robot name="arm">{"".join(links)}{"".join(joints)}</robot>'


def record(duration: float, rng: np.random.Generator) -> np.ndarray:
    """Log of an arm that follows sines, with the friction hidden. Columns as in the header; shape (T, 9)."""
    model = mujoco.MjModel.from_xml_string(urdf())
    model.opt.timestep, model.opt.integrator = STEP, mujoco.mjtIntegrator.mjINT_IMPLICITFAST
    model.dof_frictionloss[2] = HIDDEN
    data = mujoco.MjData(model)
    kp, kd = np.array([40.0, 120.0, 60.0, 15.0]), np.array([4.0, 10.0, 5.0, 1.0])
    frequency, phase = rng.uniform(0.2, 1.2, (3, 4)), rng.uniform(0, 2 * np.pi, (3, 4))
    rows = []
    for k in range(round(duration / SAMPLE)):
        now = k * SAMPLE
        target = (0.35 * np.sin(2 * np.pi * frequency * now + phase)).sum(0) * min(1.0, now)
        torque = np.clip(kp * (target - data.qpos) - kd * data.qvel + data.qfrc_bias, -60, 60).round(3)
        read = data.qpos + rng.normal(0, 2e-4, 4)
        rows.append([1000 * now, *np.rad2deg(read), *torque])
        data.qfrc_applied[:] = torque
        mujoco.mj_step(model, data, round(SAMPLE / STEP))
    return np.array(rows)


def timed(command: Sequence[str | Path], folder: Path) -> float:
    """Seconds that a command takes."""
    alone = {k: v for k, v in os.environ.items() if k not in ("PYTHONPATH", "VIRTUAL_ENV")}
    start = time.perf_counter()
    subprocess.run(command, cwd=folder, check=True, env=alone)
    return time.perf_counter() - start


def table(seconds: dict[str, float], answer: dict[str, object]) -> str:
    """What is written."""
    findings = answer["findings"]
    assert isinstance(findings, list)
    said = "; ".join(f"{f['effect']} of {f['joint']}, {f['probability']:.0%}" for f in findings) or "nothing"
    commit = subprocess.run(["git", "rev-parse", "--short", "HEAD"], capture_output=True, text=True, check=True).stdout
    rows = [*((f"`{name}`", took) for name, took in seconds.items()), ("all", sum(seconds.values()))]
    return "\n".join(
        [
            "# A new user, from nothing to a report",
            "",
            f"`python benchmarks/new_user.py` at {commit.strip()}, {platform.machine()}, {os.cpu_count()} cores. An "
            "arm of four joints as URDF, 55 s of CSV at 250 Hz, a column map written by hand.",
            "",
            "| step | time |",
            "|---|---|",
            *(f"| {name} | {took:.0f} s |" for name, took in rows),
            "",
            f"Hidden: {HIDDEN} N·m of dry friction in the elbow. Said: {said}.",
            "",
        ]
    )


if __name__ == "__main__":
    main(tyro.cli(Config, description=__doc__))
