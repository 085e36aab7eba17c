"""How much of the variance of a task's advantages few samples hold, of shipped policies with their critics.

    python -m benchmarks.advantages                                  # sled and throw: five minutes
    python -m benchmarks.advantages --policies sled=outputs/finetune_sled/sled.npz

The advantages are those of a training (GAE of 0.99 and 0.95), of robots that explore, before they are standardised.
Where a few samples hold most of the variance, a step of PPO is theirs.
"""

from __future__ import annotations

import importlib
from dataclasses import dataclass
from pathlib import Path

import torch
import tyro
from torchrl.envs import TransformedEnv
from torchrl.envs.utils import ExplorationType, set_exploration_type
from torchrl.objectives.value.functional import generalized_advantage_estimate
from tqdm import trange

from benchmarks.by_case import commit
from torchrl_athletic.training.wbc import read_wbc

POLICIES = ("sled=sled", "throw=throw")
SHARE = 0.01
"""Of the samples, those of the largest advantages."""


@dataclass(frozen=True)
class Config:
    """Every field is a flag."""

    policies: tuple[str, ...] = POLICIES
    """Tasks and policies: shipped ones, or files that a recipe wrote."""
    num_envs: int = 128
    begin: int = 200
    """Steps before the first one that counts."""
    steps: int = 700
    seed: int = 78
    output: Path = Path("benchmarks/results/advantages.md")


def main(cfg: Config) -> None:
    lines = [
        f"Made by `python -m benchmarks.advantages` at `{commit()}`.",
        "",
        "| task, policy | standard deviation | share of the variance in the largest 1 % | falls |",
        "|---|---|---|---|",
    ]
    for told in cfg.policies:
        task, _, policy = told.partition("=")
        advantage, falls = advantages(task, policy, cfg)
        square = (advantage - advantage.mean()).pow(2).flatten().sort(descending=True).values
        share = float(square[: int(SHARE * len(square))].sum() / square.sum())
        lines.append(f"| {told} | {float(advantage.std()):.2f} | {share:.0%} | {falls} of {len(square)} steps |")
        print("\n".join(lines))
    cfg.output.write_text("\n".join(lines) + "\n", encoding="utf-8")


def make_env(task: str, num_envs: int, seed: int) -> TransformedEnv:
    """As a training of that task has it."""
    if task == "wbc":
        recipe = importlib.import_module("recipes.pretrain_wbc")
        return recipe.make_env(recipe.Config(commands="ahead", seed=seed), num_envs, staggered=True)
    return importlib.import_module(f"recipes.finetune_{task}").make_env("uan", num_envs, seed=seed, staggered=True)


@torch.no_grad()
def advantages(task: str, policy: str, cfg: Config) -> tuple[torch.Tensor, int]:
    """Advantages, shape (T, N), and the number of falls."""
    torch.manual_seed(cfg.seed)
    (actor, critic), env = read_wbc(policy), make_env(task, cfg.num_envs, cfg.seed)
    shown, kept = env.reset(), []
    with set_exploration_type(ExplorationType.RANDOM):
        for step in trange(cfg.begin + cfg.steps, desc=task):
            full, shown = env.step_and_maybe_reset(critic(actor(shown)))
            if step >= cfg.begin:
                full["next"] = critic(full["next"])
                keys = ("reward", "done", "terminated", "state_value")
                kept.append((full["state_value"], *(full["next", key] for key in keys)))
    value, reward, done, terminated, next_value = (torch.stack(x, 1) for x in zip(*kept, strict=True))  # (N, T, 1)
    found, _ = generalized_advantage_estimate(0.99, 0.95, value, next_value, reward, done, terminated)
    return found.squeeze(-1).T[:-50], int(terminated.sum())


if __name__ == "__main__":
    main(tyro.cli(Config, description=__doc__))
