"""Where a whole-body controller is examined: one condition after the other, a thousand whole episodes each."""

from __future__ import annotations

import json
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from torch import nn
from torchrl.envs import TransformedEnv

from torchrl_athletic.envs import NO_DISTURBANCES, Disturbances, whole_body_env
from torchrl_athletic.identification import with_actuation
from torchrl_athletic.networks import digest_of
from torchrl_athletic.recordings.whole_file import whole_file
from torchrl_athletic.robots import Robot, Terrain, b2z1, with_options
from torchrl_athletic.training.evaluation import Episodes, whole_episodes
from torchrl_athletic.training.rollout import Policy
from torchrl_athletic.transforms import B2Z1_PUSHES, RandomizationRanges

ERRORS = {
    "position": "hand [m]",
    "attitude": "hand [rad]",
    "keypoints": "key points [m]",
    "velocity": "velocity [m/s]",
    "yaw_rate": "yaw rate [rad/s]",
}
"""Entries under ``tracking`` that are averaged over an episode, and their titles."""


@dataclass(frozen=True)
class Condition:
    """A robot, its ground, and what happens to it."""

    robot: Robot
    disturbances: Disturbances
    substeps: int = 1
    """Physics steps for each of 5 ms."""

    def env(
        self, num_envs: int, *, actuation: str = "uan", seed: int = 0, first_row: int = 0, **told: Any
    ) -> TransformedEnv:
        """The environment.

        Args:
            num_envs: N.
            actuation: Of the arm, as of :func:`~torchrl_athletic.identification.with_actuation`.
            seed: Of all draws.
            first_row: Number of the first row.
            told: To :func:`~torchrl_athletic.envs.whole_body_env`.
        """
        rows = {"seed": seed, "first_row": first_row}
        chance, substeps = self.disturbances, self.substeps
        robot, chain = with_actuation(self.robot, actuation, delay=chance.delay, substeps=substeps, **rows)
        told |= {"disturbances": chance, "substeps": substeps, "chain": chain, **rows}
        return whole_body_env(robot, num_envs=num_envs, **told)


def wbc_conditions() -> dict[str, Condition]:
    """All conditions by name, the paper's randomisation first.

    The extremes of an axis have all links, joints or the ground at that end, and nothing else differs from the nominal
    robot on flat ground. Elliptic cones and steps of 1 ms are the randomised robots in a finer simulation, whose drives
    still act every 5 ms, and solvers that go on for ten times as long: what was learnt must not be the solver's error.
    No condition has the bumps of the training. Where starts are not random, all robots start alike, and differ by what
    they are told.

    Example:
        >>> list(wbc_conditions())[:3]
        ['all randomised', 'all randomised, 1 ms steps', 'all randomised, elliptic cones']
    """
    rough, flat = Terrain(seed=1), b2z1(cone="pyramidal")
    trained = b2z1(terrain=rough, cone="pyramidal")
    conditions = {
        "all randomised": Condition(trained, Disturbances()),
        "all randomised, 1 ms steps": Condition(with_options(trained, timestep=0.001), Disturbances(), substeps=5),
        "all randomised, elliptic cones": Condition(b2z1(terrain=rough, cone="elliptic"), Disturbances()),
        "all randomised, 100 iterations": Condition(
            with_options(trained, iterations=100, ls_iterations=50), Disturbances()
        ),
        "nominal": Condition(flat, NO_DISTURBANCES),
    }
    nothing = RandomizationRanges(**dict.fromkeys(vars(RandomizationRanges())))
    for field, name, unit in (
        ("friction", "friction", ""),
        ("restitution", "restitution", ""),
        ("stiffness_scale", "leg stiffness x", ""),
        ("damping_scale", "leg damping x", ""),
        ("torque_limit_scale", "leg stall torque x", ""),
        ("mass_scale", "masses x", ""),
        ("com_offset", "centres of mass", " m"),
    ):
        for end in getattr(RandomizationRanges(), field):
            ranges = replace(nothing, **{field: (end, end)})
            conditions[f"{name} {end:g}{unit}"] = Condition(flat, replace(NO_DISTURBANCES, randomization=ranges))
    for end in Disturbances().encoder_offset:
        conditions[f"encoders {end:+g} rad"] = Condition(flat, replace(NO_DISTURBANCES, encoder_offset=(end, end)))
    longest = Disturbances().delay[1]
    conditions[f"delay {5 * longest} ms"] = Condition(flat, replace(NO_DISTURBANCES, delay=(longest, longest)))
    conditions["pushes"] = Condition(flat, replace(NO_DISTURBANCES, pushes=B2Z1_PUSHES))
    for degrees in (5, 10):
        slope = Terrain(roughness=(0.0, 0.0), tiles=15, seed=1, slope=math.radians(degrees))
        conditions[f"slope {degrees}°"] = Condition(b2z1(terrain=slope, cone="pyramidal"), NO_DISTURBANCES)
    for height in (0.025, 0.05):
        bumps = Terrain(roughness=(height, height), tiles=11, seed=1)
        name = f"bumps {100 * height:g} cm"
        conditions[name] = Condition(b2z1(terrain=bumps, cone="pyramidal"), NO_DISTURBANCES)
    return conditions


def examine(
    policy: nn.Module,
    conditions: Mapping[str, Condition],
    table: str | Path,
    *,
    episodes: int = 1000,
    steps: int = 1000,
    batch: int = 1000,
    seed: int = 1_000_003,
    actuation: str = "uan",
    device: str = "cpu",
    progress: bool = True,
    **told: Any,
) -> dict[str, dict[str, Any]]:
    """Play whole episodes in each condition, and keep what came out after each of them.

    Args:
        policy: Of ``observation``.
        conditions: By name.
        table: File of JSON to write; conditions that it holds already are not played again.
        episodes: In each condition.
        steps: Of an episode [policy steps].
        batch: Robots at once; episodes are played in parts of so many.
        seed: Of robots, commands and pushes: other than in training.
        actuation: Of the arm, as of :func:`~torchrl_athletic.identification.with_actuation`.
        device: Of the simulation.
        progress: Whether to show bars.
        told: To :func:`~torchrl_athletic.envs.whole_body_env`: ``history``...

    Returns:
        For each condition ``episodes``; ``falls`` and each of :data:`ERRORS` with 95 % intervals; and ``fallen``, the
        rows that fell.

    Raises:
        ValueError: If the table is of another policy, actuation, device, number of episodes or seed; if there are not
            two episodes.
    """
    table = Path(table)
    if episodes < 2:
        raise ValueError(f"episodes is {episodes}: one alone has no interval. Give 2 or more; 1,000 are usual.")
    header: dict[str, Any] = {"policy": digest_of(policy), "actuation": actuation, "device": device}
    header |= {"episodes": episodes, "steps": steps, "seed": seed}
    if "commands" in told:
        header["commands"] = str(told["commands"])
    found: dict[str, Any] = {**header, "conditions": {}}
    if table.exists():
        found = json.loads(table.read_text("utf-8"))
    for name, value in header.items():
        if found.get(name) != value:
            raise ValueError(
                f"{table} holds an examination with {name} {found.get(name)!r}, asked for is {value!r}: their rows "
                "would be compared as if they were alike. Give this one a file of its own."
            )
    results: dict[str, dict[str, Any]] = found["conditions"]
    told |= {"actuation": actuation, "device": device}
    for name, condition in conditions.items():
        if name not in results:
            parts = [
                _play(
                    policy,
                    condition,
                    min(batch, episodes - first),
                    first,
                    steps,
                    seed,
                    name if progress else None,
                    told,
                )
                for first in range(0, episodes, batch)
            ]
            results[name] = _told_of(_joined(parts))
            _write(table, found)
    return results


def _play(
    policy: Policy,
    condition: Condition,
    rows: int,
    first: int,
    steps: int,
    seed: int,
    label: str | None,
    told: Mapping[str, Any],
) -> Episodes:
    env = condition.env(rows, max_steps=steps, seed=seed, first_row=first, **told)
    episodes = whole_episodes(env, policy, [("tracking", name) for name in ERRORS], steps, progress=label)
    env.base_env.physics.check()
    return episodes


def _joined(parts: Sequence[Episodes]) -> Episodes:
    means = {name: np.concatenate([part.means[name] for part in parts]) for name in parts[0].means}
    return Episodes(
        np.concatenate([part.fell for part in parts]), np.concatenate([part.steps for part in parts]), means
    )


def _told_of(episodes: Episodes) -> dict[str, Any]:
    told: dict[str, Any] = {"episodes": len(episodes.fell), "falls": list(episodes.falls())}
    told |= {name: list(episodes.mean(f"tracking/{name}")) for name in ERRORS}
    return told | {"fallen": [int(row) for row in episodes.fell.nonzero()[0]]}


def _write(path: Path, content: Mapping[str, Any]) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    with whole_file(path) as part:
        part.write_text(json.dumps(content, indent=1), encoding="utf-8")


def table_of(results: Mapping[str, Mapping[str, Any]]) -> str:
    """What :func:`examine` returns, as a table in Markdown.

    Example:
        >>> row = {"episodes": 9, "falls": (0.0, 0.0, 0.3)} | dict.fromkeys(ERRORS, (0.1, 0.09, 0.11))
        >>> print(table_of({"nominal": row}).splitlines()[2][:60])
        | nominal | 0.0 % (0.0 to 30.0) | 0.100 ± 0.010 | 0.100 ± 0.
    """
    lines = ["| condition | falls | " + " | ".join(ERRORS.values()) + " |", "|---" * (2 + len(ERRORS)) + "|"]
    for name, row in results.items():
        share, low, high = (100 * value for value in row["falls"])
        errors = [f"{mean:.3f} ± {above - mean:.3f}" for mean, _, above in (row[error] for error in ERRORS)]
        lines.append(f"| {name} | {share:.1f} % ({low:.1f} to {high:.1f}) | " + " | ".join(errors) + " |")
    return "\n".join(lines)


def draw_conditions(results: Mapping[str, Mapping[str, Any]], path: str | Path) -> Path:
    """Falls and errors of each condition with their 95 % intervals, as a picture."""
    from matplotlib.figure import Figure

    shown = {"falls": "falls [%]"} | {name: ERRORS[name] for name in ("position", "attitude", "velocity", "yaw_rate")}
    figure = Figure(figsize=(12, 0.6 + 0.24 * len(results)), layout="constrained")
    axes = figure.subplots(1, len(shown), sharey=True)
    names = list(results)[::-1]
    for axis, (key, title) in zip(axes, shown.items(), strict=True):
        factor = 100 if key == "falls" else 1
        for height, name in enumerate(names):
            mean, low, high = (factor * value for value in results[name][key])
            axis.plot([low, high], [height, height], color="tab:blue", lw=2)
            axis.plot(mean, height, "o", color="tab:blue", ms=4)
        axis.set_title(title, fontsize=9)
        axis.set_xlim(left=0)
        axis.set_yticks(range(len(names)), names, fontsize=7)
        axis.tick_params(axis="x", labelsize=7)
        axis.grid(axis="x", alpha=0.3)
        axis.spines[["top", "right"]].set_visible(False)
    path = Path(path)
    path.parent.mkdir(parents=True, exist_ok=True)
    figure.savefig(path, dpi=120)
    return path
