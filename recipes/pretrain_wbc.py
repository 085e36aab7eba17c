"""Teach a B2 with a Z1 to walk where it is told and to bring its hand where it is told: the paper's pre-training.

python recipes/pretrain_wbc.py                                     # ten minutes of two cores: a curve that rises
python recipes/pretrain_wbc.py --device cuda --logger wandb        # the paper's scale: 4,096 robots, 24 steps
torchrun --nproc-per-node 2 recipes/pretrain_wbc.py --device cuda  # on two GPUs
RAY_ADDRESS=auto python recipes/pretrain_wbc.py --collectors ray --workers 64  # robots on the CPUs of many hosts
python recipes/pretrain_wbc.py --start wbc                         # goes on from the shipped controller

The same command goes on after Ctrl-C or a crash. What the shipped controller can do: docs/whole_body.md.
"""

import os
from dataclasses import dataclass, field, replace
from functools import partial
from pathlib import Path
from typing import Any, Literal

os.environ.setdefault("OMP_WAIT_POLICY", "PASSIVE")  # threads of torch that spin would take cores from the physics
import torch
import tyro
from torchrl.envs import TransformedEnv

from torchrl_athletic import training
from torchrl_athletic.envs import NO_DISTURBANCES, Disturbances, draw_command, whole_body_env, whole_body_rewards
from torchrl_athletic.functional.commands import CommandName, command_ranges
from torchrl_athletic.identification import actuation_identity, with_actuation
from torchrl_athletic.robots import Terrain, b2z1

TOLD = ("history", "commands", "actuation")
ONE_RUN = (*TOLD, "seed", "randomize", "start", "without", "hidden", "ppo", "collectors")


@dataclass(frozen=True)
class Config:
    device: Literal["cpu", "cuda"] = "cpu"  # of simulation and nets
    minutes: float | None = None  # when to stop; None takes 10 on CPUs and 29 on a GPU
    iterations: int | None = None  # when to stop; None takes 3,800 on a GPU, until which the divergence falls
    seed: int = 0  # of weights, robots, commands and exploration
    commands: CommandName | None = None  # goals to behind the head, ahead, or in a box ahead; None: those of ``start``
    actuation: str = "uan"
    """Actuation of the arm: ``uan``, the shipped net; ``ideal``; or the folder of an identified simulator."""
    randomize: bool = True  # whether robots, starts and delays differ, and pushes come; the ground is always rough
    start: str | None = None
    """A shipped controller, or a file of this recipe, to go on from, at 1e-5 unless told another rate than 1e-3."""
    without: tuple[str, ...] = ()  # terms of the reward to leave out
    minibatches: Literal["split", "joint"] = "split"  # what the critic learns from: the whole batch, or the actor's
    history: int = 10  # frames that the policy sees
    hidden: tuple[int, ...] | None = None
    """Layers of both networks; None takes 2 x 128 on CPUs and the paper's 3 x 512 on a GPU."""
    num_envs: int | None = None
    """Robots, of all processes or workers together; None takes 512 on CPUs and those of ``ppo`` on a GPU."""
    ppo: training.PPO = field(default_factory=lambda: training.PRE_TRAIN)  # what else is chosen by hand
    collectors: Literal["here", "ray"] = "here"  # where robots are simulated
    workers: int = 2  # of Ray
    logger: training.LoggerName = "csv"  # where numbers go; wandb stays offline
    output: Path = Path("outputs/pretrain_wbc")  # folder for all that is written
    video: bool = True  # whether to draw an episode at the end


def main(cfg: Config) -> None:
    processes, on_gpu = training.join_processes(cfg.device), cfg.device == "cuda"
    torch.manual_seed(processes.seed(cfg.seed))
    torch.set_float32_matmul_precision("high")
    ppo = replace(cfg.ppo, num_envs=cfg.num_envs or (cfg.ppo.num_envs if on_gpu else 512))
    ppo = replace(ppo, critic_minibatches=ppo.actor_minibatches if cfg.minibatches == "joint" else 1)
    if cfg.start is not None and ppo.actor_lr == training.PRE_TRAIN.actor_lr:
        ppo = replace(ppo, actor_lr=training.FINE_TUNE.actor_lr)  # that of the beginning would undo what was learnt
    iterations = 3800 if on_gpu and cfg.iterations is None else cfg.iterations
    ppo = ppo.annealed(iterations, last=0.006) if on_gpu and iterations else ppo  # below, the rate fell to 1e-6
    cfg = replace(cfg, ppo=ppo, iterations=iterations, commands=cfg.commands or training.commands_of(cfg.start))
    cfg = replace(cfg, hidden=cfg.hidden or ((512, 512, 512) if on_gpu else (128, 128)))
    same = {n: str(getattr(cfg, n)) for n in ONE_RUN} | {"actuation": actuation_identity(cfg.actuation)}
    rows, first_row = processes.share(ppo.num_envs), processes.first_row(ppo.num_envs)
    learner = training.wbc_learner(
        make_env(cfg, 1 if cfg.collectors == "ray" else rows, first_row, processes.device, staggered=True),
        ppo,
        start=cfg.start,
        hidden=cfg.hidden or (),
        seed=cfg.seed,
        cuda_graph=on_gpu,
        collect_by=partial(collect_by_ray, cfg, ppo) if cfg.collectors == "ray" else None,
        processes=processes,
    )
    training.train(
        learner,
        minutes=(29.0 if on_gpu else 10.0) if cfg.minutes is None else cfg.minutes,
        iterations=cfg.iterations,
        logger=training.make_logger(cfg.logger, cfg.output, "pretrain_wbc") if processes.rank == 0 else None,
        checkpoints=training.Checkpoints(cfg.output / "checkpoints", made_of=same),
        checkpoint_every=200 if on_gpu else 20,
        show=["reward", "tracking/position", "tracking/velocity"],
    )
    if processes.rank == 0:
        told: dict[str, Any] = {"trained_as": str(cfg)} | {n: getattr(cfg, n) for n in TOLD}
        print("policy:", training.save_wbc(learner, cfg.output, **told))
        if (table := cfg.output / "progress.csv").exists():
            print("curves:", training.draw_curves({"": table}, training.CURVES, cfg.output / "curves.png"))
        if cfg.video:
            env, policy, path = make_env(cfg, 1), learner.actor.to("cpu"), cfg.output / "wbc.mp4"
            print("video:", training.record_video(env, policy, path, steps=500, annotate=draw_command))
    learner.close()


def make_env(cfg: Config, num_envs: int, first_row: int = 0, device: str = "cpu", **told: Any) -> TransformedEnv:
    chance, rows = Disturbances() if cfg.randomize else NO_DISTURBANCES, {"seed": cfg.seed, "first_row": first_row}
    robot, chain = with_actuation(b2z1(terrain=Terrain(), cone="pyramidal"), cfg.actuation, delay=chance.delay, **rows)
    terms = whole_body_rewards(robot, "true_joint_position" if cfg.randomize else "joint_position", cfg.without)
    told |= rows | {"chain": chain, "terms": terms, "disturbances": chance, "history": cfg.history}
    told["commands"] = command_ranges(cfg.commands or training.commands_of(cfg.start))
    return whole_body_env(robot, num_envs=num_envs, device=device, **told)


def collect_by_ray(cfg: Config, ppo: training.PPO, policy: Any, keys: Any) -> training.RayRollout:
    make, rows = partial(make_env, cfg, staggered=True), training.rows_of_a_worker(ppo.num_envs, cfg.workers)
    return training.RayRollout(make, policy, ppo.horizon, rows=rows, workers=cfg.workers, keys=keys, seed=cfg.seed)


if __name__ == "__main__":
    main(tyro.cli(Config, description=__doc__))
