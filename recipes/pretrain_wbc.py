"""Teach a B2 with a Z1 to walk where it is told and to bring its hand where it is told: the paper's pre-training.

python recipes/pretrain_wbc.py                                     # ten minutes of two cores: a curve that rises
python recipes/pretrain_wbc.py --device cuda --logger wandb        # the paper's scale: 4,096 robots, 24 steps
torchrun --nproc-per-node 2 recipes/pretrain_wbc.py --device cuda  # on two GPUs
python recipes/pretrain_wbc.py --collectors ray --workers 64       # robots on the CPUs of many hosts

The same command goes on after Ctrl-C or a crash. What the shipped controller can do: docs/whole_body.md.
"""

import os
from dataclasses import dataclass, field, replace
from functools import partial
from pathlib import Path
from typing import Any, Literal

os.environ.setdefault("OMP_WAIT_POLICY", "PASSIVE")  # threads of torch that spin would take cores from the physics
# ruff: noqa: E402
import torch
import tyro
from torchrl.envs import TransformedEnv

from torchrl_athletic import training
from torchrl_athletic.envs import NO_DISTURBANCES, Disturbances, draw_command, whole_body_env, whole_body_rewards
from torchrl_athletic.identification import Simulator
from torchrl_athletic.robots import Terrain, b2z1


@dataclass(frozen=True)
class Config:
    device: Literal["cpu", "cuda"] = "cpu"  # of simulation and nets
    minutes: float | None = None
    """When to stop [min]; None takes 10 on CPUs and 25 on a GPU."""
    iterations: int | None = None
    """When to stop in any case."""
    seed: int = 0  # of weights, robots, commands and exploration
    actuation: str = "uan"
    """Of the arm: ``uan``, the shipped net; ``ideal``; or the folder of an identified simulator."""
    randomize: bool = True
    """Whether robots, ground, starts and delays differ, and pushes come."""
    without: tuple[str, ...] = ()
    """Terms of the reward to leave out."""
    minibatches: Literal["split", "joint"] = "split"
    """What the critic learns from: the whole batch, or the actor's minibatches."""
    history: int = 10  # frames that the policy sees
    hidden: tuple[int, ...] | None = None
    """Layers of both networks; None takes 2 x 128 on CPUs and the paper's 3 x 512 on a GPU."""
    ppo: training.PPO = field(default_factory=lambda: training.PRE_TRAIN)
    """What else is chosen by hand; CPUs take an eighth of its robots."""
    collectors: Literal["here", "ray"] = "here"
    """Where robots are simulated."""
    workers: int = 2  # of Ray
    logger: training.LoggerName = "csv"
    """Where numbers go; wandb stays offline."""
    output: Path = Path("outputs/pretrain_wbc")
    """Folder for all that is written."""
    video: bool = True
    """Whether to draw an episode at the end."""


def main(cfg: Config) -> None:
    processes = training.join_processes(cfg.device)
    torch.manual_seed(processes.seed(cfg.seed))
    torch.set_float32_matmul_precision("high")
    on_gpu = cfg.device == "cuda"
    ppo = cfg.ppo if on_gpu else replace(cfg.ppo, num_envs=cfg.ppo.num_envs // 8)
    ppo = replace(ppo, critic_minibatches=ppo.actor_minibatches if cfg.minibatches == "joint" else 1)
    make = partial(make_env, cfg, device=processes.device)
    learner = training.wbc_learner(
        make(num_envs=processes.share(ppo.num_envs), first_row=processes.first_row(ppo.num_envs)),
        ppo,
        hidden=cfg.hidden or ((512, 512, 512) if on_gpu else (128, 128)),
        seed=cfg.seed,
        cuda_graph=on_gpu,
        collect_by=partial(collect_by_ray, cfg, ppo) if cfg.collectors == "ray" else None,
        processes=processes,
    )
    training.train(
        learner,
        minutes=cfg.minutes or (25.0 if on_gpu else 10.0),
        iterations=cfg.iterations,
        logger=training.make_logger(cfg.logger, cfg.output, "pretrain_wbc") if processes.rank == 0 else None,
        checkpoints=training.Checkpoints(cfg.output / "checkpoints"),
        checkpoint_every=200 if on_gpu else 20,
        show=["reward", "tracking/position", "tracking/velocity"],
    )
    if processes.rank == 0:
        print("policy:", training.save_wbc(learner, cfg.output, trained_as=str(cfg)))
        if cfg.logger == "csv":
            curves = training.draw_curves({"": cfg.output / "progress.csv"}, training.CURVES, cfg.output / "curves.png")
            print("curves:", curves)
        if cfg.video:
            env, policy, path = make_env(cfg, 1), learner.actor.to("cpu"), cfg.output / "wbc.mp4"
            print("video:", training.record_video(env, policy, path, steps=500, annotate=draw_command))
    processes.leave()


def make_env(cfg: Config, num_envs: int, first_row: int = 0, device: str = "cpu") -> TransformedEnv:
    robot, chain = b2z1(terrain=Terrain(), cone="pyramidal"), None
    chance = Disturbances() if cfg.randomize else NO_DISTURBANCES
    if cfg.actuation not in ("uan", "ideal"):
        simulator = Simulator.load(cfg.actuation, robot)
        robot, delay = simulator.robot, chance.delay[1]
        chain = simulator.chain(arm_power=300.0, max_delay=delay, seed=cfg.seed, first_row=first_row)
    terms = whole_body_rewards(robot, "true_joint_position" if cfg.randomize else "joint_position", cfg.without)
    net = "uan" if cfg.actuation == "uan" else None
    told: dict[str, Any] = {"net": net, "chain": chain, "terms": terms, "disturbances": chance, "history": cfg.history}
    return whole_body_env(robot, num_envs=num_envs, device=device, seed=cfg.seed, first_row=first_row, **told)


def collect_by_ray(cfg: Config, ppo: training.PPO, policy: Any, keys: Any) -> training.RayRollout:
    def make(worker: int) -> TransformedEnv:
        return make_env(cfg, ppo.num_envs // cfg.workers, first_row=worker * (ppo.num_envs // cfg.workers))

    return training.RayRollout(make, policy, ppo.horizon, workers=cfg.workers, keys=keys, seed=cfg.seed)


if __name__ == "__main__":
    main(tyro.cli(Config, description=__doc__))
