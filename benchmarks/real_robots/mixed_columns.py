"""Logs that were mixed up: whether the check says so, and whether it says nothing of the logs as they are.

    ATHLETIC_DATA=... python -m benchmarks.real_robots.mixed_columns --data CLONES

In the recordings of a robot one command column at a time is turned round, one joint's axis is turned round (its
position and velocity), and two neighbouring command columns are exchanged. What the check says then has to name the
joint, with the right reason. No simulation is run.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import pairwise
from pathlib import Path

import mujoco
import numpy as np
import tyro

from benchmarks.by_case import Row, run_cases
from benchmarks.real_robots.robots import ROBOTS
from benchmarks.real_robots.robots.robot import Robot
from torchrl_athletic.diagnosis.prepare import prepare
from torchrl_athletic.diagnosis.torque_columns import torque_doubts
from torchrl_athletic.recordings import Recording, RecordingError, check_quality

COMMANDS = ("torque_command", "position_target")
MOTIONS = ("position", "velocity")
MOST = 4
"""Recordings of a robot that are mixed up."""
SAYS = {"commands turned round": "other sign", "axes turned round": "other sign", "commands exchanged": "exchanged"}


@dataclass(frozen=True)
class Config:
    """Every field is a flag."""

    data: Path = Path("clones")
    """Folder of clones; the five benches of ``load_dataset`` need none."""
    cases: tuple[str, ...] = tuple(ROBOTS)
    output: Path = Path("benchmarks/results/mixed_columns.md")


def main(cfg: Config) -> None:
    run_cases(cfg.cases, lambda case: mixed(ROBOTS[case](cfg.data)), table, cfg.output)


def mixed(robot: Robot) -> Row:
    """What is said of a robot's recordings as they are, and how many mistakes are found of how many."""
    takes = robot.recordings[:MOST]
    names, command = takes[0].joint_names, np.concatenate([r.command for r in takes])
    driven = np.flatnonzero(np.ptp(command, axis=0) > 0).tolist()
    tried: dict[str, list[tuple[tuple[int, ...], list[Recording]]]] = {
        "commands turned round": [((j,), [_turned(r, j, COMMANDS) for r in takes]) for j in driven],
        "axes turned round": [((j,), [_turned(r, j, MOTIONS) for r in takes]) for j in driven],
        "commands exchanged": [((j, k), [_exchanged(r, j, k) for r in takes]) for j, k in pairwise(driven)],
    }
    found = {
        mistake: [
            any(SAYS[mistake] in text and all(names[j] in text for j in joints) for text in said(robot, changed))
            for joints, changed in cases
        ]
        for mistake, cases in tried.items()
    }
    return {"as_is": said(robot, robot.recordings), **{m: [sum(f), len(f)] for m, f in found.items()}}


def said(robot: Robot, takes: Sequence[Recording]) -> list[str]:
    """What the check says of the columns of these recordings, each sentence once."""
    if takes[0].position_target is not None:
        every = [text for r in takes for text in check_quality(r).warnings]
        told = [text.split(": ", 1)[1] for text in every if "position_target" in text]
    else:
        try:
            told = [*torque_doubts(prepare(takes, mujoco.MjModel.from_xml_string(robot.xml), xml=robot.xml))]
        except RecordingError as error:  # an axis turned round may leave the joint's range
            told = [str(error)]
    return list(dict.fromkeys(told))


def _turned(recording: Recording, joint: int, fields: Sequence[str]) -> Recording:
    signs = np.where(np.arange(recording.num_joints) == joint, -1.0, 1.0)
    values = {field: getattr(recording, field) for field in fields}
    return replace(recording, **{field: signs * value for field, value in values.items() if value is not None})


def _exchanged(recording: Recording, one: int, other: int) -> Recording:
    order = np.arange(recording.num_joints)
    order[[one, other]] = other, one
    values = {field: getattr(recording, field) for field in COMMANDS}
    return replace(recording, **{field: value[:, order] for field, value in values.items() if value is not None})


def table(rows: Mapping[str, Row]) -> str:
    """A row a robot."""
    lines = [
        "Made by `python -m benchmarks.real_robots.mixed_columns --data CLONES`: mistakes found of those made.",
        "",
        f"| robot | {' | '.join(SAYS)} | said of the logs as they are | commit |",
        "|---" * (len(SAYS) + 3) + "|",
    ]
    for name, row in rows.items():
        counts = " | ".join("{} of {}".format(*row[mistake]) for mistake in SAYS)
        lines.append(f"| {name} | {counts} | {' '.join(row['as_is']) or 'nothing'} | {row['commit']} |")
    sums = [np.sum([row[mistake] for row in rows.values()], axis=0) for mistake in SAYS]
    lines.append(f"| all | {' | '.join(f'{found} of {made}' for found, made in sums)} | | |")
    return "\n".join(lines) + "\n"


if __name__ == "__main__":
    main(tyro.cli(Config))
