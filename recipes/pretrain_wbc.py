"""Teach a B2 with a Z1 to walk where it is told and to bring its hand where it is told: the paper's pre-training.

python recipes/pretrain_wbc.py                                    # ten minutes of two cores: a curve that rises
python recipes/pretrain_wbc.py --device cuda --logger wandb       # the paper's scale: 4,096 robots, 24 steps
torchrun --nproc-per-node 2 recipes/pretrain_wbc.py --device cuda # on two GPUs

The same command goes on after Ctrl-C or a crash. What the shipped controller can do: docs/whole_body.md.
"""

from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Literal

import torch
import tyro
from torchrl.envs import TransformedEnv

from torchrl_athletic import training
from torchrl_athletic.envs import NO_DISTURBANCES, Disturbances, whole_body_env, whole_body_rewards
from torchrl_athletic.identification import Simulator
from torchrl_athletic.networks import RunningNormalizer, actor, critic, write_network
from torchrl_athletic.robots import Terrain, b2z1
from torchrl_athletic.training import PPO, PRE_TRAIN, Checkpoints, Learner


@dataclass(frozen=True)
class Config:
    device: Literal["cpu", "cuda"] = "cpu"
    """Of simulation and nets."""
    minutes: float | None = None
    """When to stop [min]; None takes 10 on the CPU and 20 on a GPU."""
    iterations: int | None = None
    """When to stop in any case."""
    seed: int = 0
    """Of weights, robots, commands and exploration."""
    actuation: str = "uan"
    """Of the arm: ``uan``, the shipped net; ``ideal``; or the folder of an identified simulator."""
    randomize: bool = True
    """Whether robots, ground, starts and delays differ, and pushes come."""
    without: tuple[str, ...] = ()
    """Reward terms to leave out."""
    minibatches: Literal["split", "joint"] = "split"
    """What the critic learns from: the whole batch, or the actor's minibatches."""
    history: int = 10
    """Frames that the policy sees."""
    hidden: tuple[int, ...] | None = None
    """Layers of both networks; None takes 2 x 128 on the CPU and the paper's 3 x 512 on a GPU."""
    ppo: PPO = field(default_factory=lambda: PRE_TRAIN)
    """What else is chosen by hand; the CPU takes an eighth of the robots."""
    logger: training.LoggerName = "csv"
    """Where numbers go besides; wandb stays offline."""
    output: Path = Path("outputs/pretrain_wbc")
    """Folder for all that is written."""
    video: bool = True
    """Whether to draw an episode at the end."""


def main(cfg: Config) -> None:
    torch.manual_seed(cfg.seed)
    torch.set_float32_matmul_precision("high")
    on_gpu = cfg.device == "cuda"
    hidden = cfg.hidden or ((512, 512, 512) if on_gpu else (128, 128))
    joint = cfg.ppo.actor_minibatches if cfg.minibatches == "joint" else 1
    ppo = replace(cfg.ppo, critic_minibatches=joint, num_envs=cfg.ppo.num_envs if on_gpu else cfg.ppo.num_envs // 8)
    env = make_env(cfg, ppo.num_envs)

    sizes = {key: env.observation_spec[key].shape[-1] for key in ("observation", "privileged")}
    normalizers = {key: RunningNormalizer(size, device=cfg.device) for key, size in sizes.items()}
    told = {"in_features": sizes["observation"], "action_size": env.action_spec.shape[-1], "hidden": hidden}
    policy = actor(**told, scale=0.5, gain=0.01, normalizer=normalizers["observation"], device=cfg.device)
    value = critic(
        sizes["privileged"],
        in_keys=["privileged"],
        hidden=hidden,
        normalizer=normalizers["privileged"],
        device=cfg.device,
    )
    watch = ["reward_terms", "tracking", "terminated"]
    learner = Learner(env, policy, value, ppo, normalizer=normalizers, watch=watch, seed=cfg.seed, cuda_graph=on_gpu)
    learner.rollout.current["step_count"].random_(0, 1000)  # so that episodes do not end all at once
    training.train(
        learner,
        minutes=cfg.minutes or (20.0 if on_gpu else 10.0),
        iterations=cfg.iterations,
        logger=training.make_logger(cfg.logger, cfg.output, "pretrain_wbc"),
        checkpoints=Checkpoints(cfg.output / "checkpoints"),
        checkpoint_every=200 if on_gpu else 20,
        show=["reward", "tracking/position", "tracking/velocity", "terminated"],
    )
    write_network(cfg.output / "wbc.npz", policy, "actor", {**told, "normalized": True}, seed=cfg.seed)


def make_env(cfg: Config, num_envs: int) -> TransformedEnv:
    robot = b2z1(terrain=Terrain(), cone="pyramidal")
    chance = Disturbances() if cfg.randomize else NO_DISTURBANCES
    chain, net = None, "uan" if cfg.actuation == "uan" else None
    if cfg.actuation not in ("uan", "ideal"):
        simulator = Simulator.load(cfg.actuation, robot)
        robot, chain = simulator.robot, simulator.chain(arm_power=300.0, max_delay=chance.delay, seed=cfg.seed)
    return whole_body_env(
        robot,
        num_envs=num_envs,
        device=cfg.device,
        net=net,
        chain=chain,
        terms=whole_body_rewards(robot, "true_joint_position" if cfg.randomize else "joint_position", cfg.without),
        disturbances=chance,
        history=cfg.history,
        seed=cfg.seed,
    )


if __name__ == "__main__":
    main(tyro.cli(Config, description=__doc__))
