"""What the tuned policies can do, where they were tuned and elsewhere: 100 episodes in each condition.

    python -m benchmarks.task_figures                                     # the shipped ones: two hours of two cores
    python -m benchmarks.task_figures --only throw --policy outputs/finetune_throw/throw.npz --output outputs/figures
    python -m benchmarks.task_figures --untuned      # the controllers that they were tuned from: three minutes

The same command goes on after a kill. Robots are randomised as in training, with other seeds. One condition differs
from the first by what its name says: a policy that learnt the solver's error, or the actuator net's, falls behind
there. The concealed arm is the rehearsal: its drives share no code with the simulator that the policy was tuned in. It
is to be compared with the steps of 0.2 ms that it needs; its gains and limits are not randomised, nor is its power
limited. Snatch and sled are played with masses of one kind too, to find the heaviest.
"""

from __future__ import annotations

import importlib
import json
import platform
from collections.abc import Iterator
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import mujoco
import torch
import tyro
from tensordict import TensorDict
from tqdm import tqdm

from benchmarks.by_case import commit
from benchmarks.concealed import on_legs
from torchrl_athletic.envs import NO_DISTURBANCES, Disturbances, sled_drift
from torchrl_athletic.functional.commands import sled_commands
from torchrl_athletic.networks import digest_of, pretrained, read_network
from torchrl_athletic.robots import with_options
from torchrl_athletic.training import controller_for, whole_rollout
from torchrl_athletic.transforms import RandomizationRanges

TASKS = ("throw", "snatch", "sled")
SHOWN = {
    "throw": (
        "distance_m",
        "spread_m",
        "release_speed_m_s",
        "elevation_deg",
        "azimuth_deg",
        "peak_leg_power_kw",
        "peak_arm_speed_rad_s",
        "thrown",
        "feet_slid_m",
        "failed",
    ),
    "snatch": ("held_s", "held_for_5_s", "lowest_hand_m", "highest_hand_m", "feet_slid_m", "failed"),
    "sled": (
        "sled_moved_m",
        "sled_10_m",
        "straight_10_m",
        "lateral_drift_m",
        "heading_drift_rad",
        "mean_tension_n",
        "feet_slid_m",
        "failed",
    ),
}
LOADED = 20.0
"""A foot that is pressed to the ground by more stands on it [N]."""
DUMBBELLS = (1.0, 4.0, 6.0, 8.0, 10.0)  # kg
SLEDS = (20.0, 50.0, 100.0, 150.0)  # kg
HEAVY = (150.0, 180.0, 210.0, 240.0)  # kg; tuned with up to 180
ELSEWHERE = ("1 ms steps", "0.2 ms steps", "friction 0.5", "friction 4", "concealed arm")
"""In which the figures that are asked for are played too."""
LONG = (1500, 3000)
"""Policy steps in which a sled is pulled 10 m or not: 30 s at 0.5 m/s, and 60 s for heavy ones."""


@dataclass(frozen=True)
class Config:
    only: tuple[str, ...] = ()
    """Names of tasks; none takes all."""
    conditions: tuple[str, ...] = ()
    """Names of conditions; none takes all. What was played before stays in the tables."""
    policy: str | None = None
    """A file that a recipe wrote; None takes the shipped policies."""
    untuned: bool = False
    """Play the controllers that tuning begins with, as it begins with them, in the first condition alone."""
    episodes: int = 100
    """In each condition."""
    seed: int = 2_000_003
    """Seed of robots and disturbances: other than in training and in the recipes' examination."""
    commit: str = ""
    """Commit of the code, where git cannot tell."""
    output: Path = Path("benchmarks/results")
    """Folder for the tables."""


def main(cfg: Config) -> None:
    if unknown := [name for name in cfg.only if name not in TASKS]:
        raise SystemExit(f"there is no task {unknown[0]!r}; there are {list(TASKS)}.")
    if cfg.policy is not None and len(cfg.only) != 1:
        raise SystemExit("--policy is of one task: name it with --only.")
    if cfg.policy is not None and cfg.output == Config().output:
        raise SystemExit(f"{cfg.output} holds the tables of the shipped policies: give those of --policy an --output.")
    if cfg.policy is not None and cfg.untuned:
        raise SystemExit("--untuned names the policy, and so does --policy: give one of them.")
    torch.set_grad_enabled(False)
    cfg.output.mkdir(parents=True, exist_ok=True)
    for task in cfg.only or TASKS:
        policy: Any = untuned(task) if cfg.untuned else read_network(cfg.policy) if cfg.policy else pretrained(task)
        kind = "untuned" if cfg.untuned else "tuned"
        path = cfg.output / (f"task_{task}_untuned.json" if cfg.untuned else f"task_{task}.json")
        rows = played(task, policy, cfg, path)
        lines = [
            f"| {task} | {' | '.join(SHOWN[task])} |",
            "|---" * (len(SHOWN[task]) + 1) + "|",
            *(f"| {name} | {' | '.join(f'{row[key]:.3g}' for key in SHOWN[task])} |" for name, row in rows.items()),
        ]
        made = (
            f"`python -m benchmarks.task_figures --only {task}{' --untuned' * cfg.untuned}"
            f"{f' --policy {cfg.policy}' if cfg.policy else ''}`, {cfg.episodes} episodes "
            f"each, policy "
            f"{digest_of(policy)}, {platform.machine()}, MuJoCo {mujoco.__version__}, commit "
            f"{', '.join(dict.fromkeys(str(row['commit']) for row in rows.values()))}."
        )
        text = "\n".join([f"# What the {kind} policy can do: {task}", "", *lines, "", made, ""])
        print(text)
        path.with_suffix(".md").write_text(text)


def untuned(task: str) -> Any:
    """The controller of a task's recipe, deaf to phases as it is when its tuning begins."""
    recipe = importlib.import_module(f"recipes.finetune_{task}")
    return controller_for(recipe.make_env("ideal", 1), recipe.Config().start)


def played(task: str, policy: Any, cfg: Config, path: Path) -> dict[str, dict[str, Any]]:
    """Figures by condition, kept after each of them."""
    same = {"policy": digest_of(policy), "episodes": cfg.episodes, "seed": cfg.seed}
    known = json.loads(path.read_text("utf-8")) if path.exists() else {}
    rows = known["rows"] if {key: known.get(key) for key in same} == same else {}
    wanted = list(conditions(task))[: 1 if cfg.untuned else None]
    if unknown := [name for name in cfg.conditions if name not in dict(wanted)]:
        raise SystemExit(f"{task} has no condition {unknown[0]!r}; there are {[name for name, _ in wanted]}.")
    for name, told in tqdm(wanted, desc=task):
        complete = name in rows and set(SHOWN[task]) <= rows[name].keys()
        if not complete and name in (cfg.conditions or dict(wanted)):
            rows[name] = figures(task, policy, told, cfg) | {"commit": cfg.commit or commit()}
            part = path.with_name(f".{path.name}")
            part.write_text(json.dumps(same | {"rows": rows}, indent=1) + "\n", "utf-8")
            part.replace(path)
    return {name: rows[name] for name, _ in wanted if set(SHOWN[task]) <= rows.get(name, {}).keys()}


def conditions(task: str) -> Iterator[tuple[str, dict[str, Any]]]:
    """Names, and what is told to the recipe's ``make_env``; ``options`` and ``steps`` go elsewhere."""
    yield "as tuned, other seeds", {}
    yield "1 ms steps", {"options": {"timestep": 0.001}, "substeps": 5}
    yield "0.2 ms steps", {"options": {"timestep": on_legs.TIMESTEP}, "substeps": on_legs.SUBSTEPS}
    yield "elliptic cones", {"options": {"cone": mujoco.mjtCone.mjCONE_ELLIPTIC}}
    yield "100 solver iterations", {"options": {"iterations": 100, "ls_iterations": 50}}
    for field, name in (("friction", "friction"), ("restitution", "restitution")):
        for end in getattr(RandomizationRanges(), field):
            ranges = replace(RandomizationRanges(), **{field: (end, end)})
            yield f"{name} {end:g}", {"disturbances": replace(Disturbances(), randomization=ranges)}
    yield "nothing randomised", {"disturbances": NO_DISTURBANCES}
    yield "ideal arm", {"actuation": "ideal"}
    yield "concealed arm", {"actuation": "concealed", "substeps": on_legs.SUBSTEPS}
    if task == "snatch":
        for mass in DUMBBELLS:
            yield f"{mass:g} kg", {"mass": (mass, mass)}
    if task == "sled":
        for mass, steps in (*((mass, LONG[0]) for mass in SLEDS), *((mass, LONG[1]) for mass in HEAVY)):
            yield f"{mass:g} kg, {0.02 * steps:.0f} s", pulls(mass, steps)
    asked = {"snatch": ("8 kg", {"mass": (8.0, 8.0)}), "sled": ("150 kg, 60 s", pulls(150.0, LONG[1]))}
    if task in asked:
        figure, told = asked[task]
        for name, elsewhere in conditions("throw"):
            if name in ELSEWHERE:
                yield f"{figure}, {name}", told | elsewhere


def pulls(mass: float, steps: int) -> dict[str, Any]:
    """A sled of one mass, and so many policy steps in which it is pulled all the time."""
    back = replace(sled_commands(), forward=(-0.5, -0.5), standstill_probability=0.0)
    return {"mass": (mass, mass), "velocity": back, "max_steps": steps, "steps": steps}


def figures(task: str, policy: Any, told: dict[str, Any], cfg: Config) -> dict[str, Any]:
    recipe = importlib.import_module(f"recipes.finetune_{task}")
    told = dict(told)
    robot, steps = with_options(recipe.nominal(), **told.pop("options", {})), told.pop("steps", recipe.STEPS)
    exam = not (task == "sled" and "velocity" in told)  # else the recipe's own velocity would take its place
    told |= {"exam": exam, "seed": cfg.seed}
    if (actuation := told.pop("actuation", "uan")) == "concealed":
        robot = on_legs.without_drives(robot)
        env = on_legs.put_on(recipe.make_env("ideal", cfg.episodes, robot=robot, **told), robot)
    else:
        env = recipe.make_env(actuation, cfg.episodes, robot=robot, **told)
    episodes = whole_rollout(env, policy, [*recipe.LOOK_AT, "foot_velocity", "foot_force"], steps)
    found: dict[str, float] = recipe.judge(episodes)
    return found | {"feet_slid_m": slid(episodes)} | (pulled(episodes) if task == "sled" else {})


def slid(episodes: TensorDict) -> float:
    """How far a foot moves over the ground in an episode while it is pressed to it, mean over feet and episodes [m].

    By the velocity of its centre at 50 Hz, so that a foot that rolls, or lands, counts a little.
    """
    stands = (episodes["foot_force"] > LOADED) & episodes["counts"]
    speed = torch.linalg.vector_norm(episodes["foot_velocity"][..., :2], dim=-1)
    return float(0.02 * torch.where(stands, speed, 0.0).sum(1).mean())


def pulled(episodes: TensorDict) -> dict[str, float]:
    """Shares of episodes in which the sled came 10 m, and in which the robot was within 0.5 m of its line just then."""
    way = torch.linalg.vector_norm(episodes["sled_position"] - episodes["sled_position"][:, :1], dim=-1)
    there = (way >= 10) & episodes["counts"].squeeze(-1)
    lateral = sled_drift(episodes)[0].squeeze(-1).abs()
    first = there.int().argmax(1, keepdim=True)
    straight = there.any(1) & (lateral.gather(1, first).squeeze(1) < 0.5)
    return {"sled_10_m": float(there.any(1).float().mean()), "straight_10_m": float(straight.float().mean())}


if __name__ == "__main__":
    main(tyro.cli(Config, description=__doc__))
