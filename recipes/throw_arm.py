"""Teach a Z1 arm, bolted to the floor, to throw a ball from a bucket as far as it can, in an identified simulator.

python recipes/throw_arm.py                                                    # the nominal model, on two cores
python recipes/throw_arm.py --simulator outputs/identification/uan_seed0 --output outputs/throw/uan_seed0
python recipes/throw_arm.py --device cuda --ppo.num-envs 4096 --minutes 3      # on a GPU
"""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Literal

import torch
import tyro
from tensordict import TensorDict
from tensordict.nn import ProbabilisticTensorDictSequential
from torchrl.envs import EnvBase, RewardScaling

from torchrl_athletic.envs import throw_distance, throw_env
from torchrl_athletic.envs.throw import ARM_POWER, BUCKET, STEPS
from torchrl_athletic.identification import Simulator
from torchrl_athletic.networks import actor, critic, load_checkpoint, save_checkpoint
from torchrl_athletic.robots import with_bucket, z1
from torchrl_athletic.training import PPO, Checkpoints, Learner, LoggerName, make_logger, play, record_video, train


@dataclass(frozen=True)
class Config:
    simulator: Path | None = None
    """Folder that an identification wrote; the nominal model by default."""
    minutes: float = 5.0
    """When to stop [min]."""
    iterations: int | None = None
    """When to stop in any case."""
    seed: int = 0
    """Of weights, starts and exploration."""
    device: Literal["cpu", "cuda"] = "cpu"
    """Where to simulate and learn."""
    hidden: tuple[int, ...] = (256, 128)
    """Layers of both networks."""
    ppo: PPO = field(
        default_factory=lambda: PPO(num_envs=256, entropy_coeff=0.0, actor_lr=1e-4, critic_lr=1e-3, kl_target=0.015)
    )
    """What else is chosen by hand."""
    evaluate_every: int = 50
    """Iterations between measurements."""
    throws: int = 32
    """That are measured, from starts that differ by 0.05 rad."""
    logger: LoggerName = "csv"
    """Where numbers go."""
    output: Path = Path("outputs/throw/default")
    """Folder for all that is written."""
    video: bool = False
    """Whether to draw a throw at the end."""


def main(cfg: Config) -> None:
    torch.manual_seed(cfg.seed)
    simulator = load_simulator(cfg.simulator)
    ppo, joints = cfg.ppo, len(simulator.robot.joint_groups["arm"])
    env = make_env(simulator, ppo.num_envs, device=cfg.device, seed=cfg.seed)
    exam = make_env(simulator, cfg.throws, device=cfg.device, seed=1_000_000, randomize=False, ends=False)

    seen = env.observation_spec["observation"].shape[-1]
    known = env.observation_spec["privileged"].shape[-1]
    policy = make_policy(seen, joints, cfg.hidden, cfg.device)
    value = critic(seen + known, in_keys=["observation", "privileged"], hidden=cfg.hidden, device=cfg.device)

    watch = ["reward_terms", "throw_failed"]
    learner = Learner(env, policy, value, ppo, watch=watch, seed=cfg.seed, cuda_graph=cfg.device == "cuda")
    learner.rollout.current["step_count"].random_(0, STEPS)  # so that episodes do not end all at once
    found = train(
        learner,
        minutes=cfg.minutes,
        iterations=cfg.iterations,
        evaluate=lambda: measure(exam, policy),
        evaluate_every=cfg.evaluate_every,
        logger=make_logger(cfg.logger, cfg.output, "throw_arm"),
        checkpoints=Checkpoints(cfg.output / "checkpoints", keep=1),
        show=["reward", "distance_m"],
    )
    print(f"{found['distance_m']:.2f} ± {found['spread_m']:.2f} m, {100 * found['failed']:.0f} % of throws failed")
    metadata = {"simulator": simulator.name, "hidden": list(cfg.hidden), "seed": cfg.seed} | found
    print("policy:", save_checkpoint(cfg.output / "policy.pt", metadata, policy=policy))
    if cfg.video:
        print("video:", record_video(exam, policy, cfg.output / "throw.mp4", steps=STEPS))


def load_simulator(folder: Path | None) -> Simulator:
    """With the bucket in the arm's jaws, whatever it was identified with."""
    robot = with_bucket(z1(), BUCKET)
    return Simulator("default", robot) if folder is None else Simulator.load(folder, robot)


def make_env(
    simulator: Simulator, num_envs: int, *, device: str = "cpu", seed: int = 0, randomize: bool = True, **task: Any
) -> EnvBase:
    """The task in an identified simulator; the critic is told what was randomised."""
    chain = simulator.chain(arm_power=ARM_POWER, randomize=randomize, seed=seed)
    known = ["randomization"] if simulator.randomization is not None and randomize else []
    env = throw_env(
        simulator.robot, num_envs=num_envs, device=device, chain=chain, privileged=known, seed=seed, **task
    )
    return env.append_transform(RewardScaling(loc=0.0, scale=0.1))  # returns of order one are soon learnt


def make_policy(seen: int, joints: int, hidden: tuple[int, ...], device: str) -> ProbabilisticTensorDictSequential:
    """That begins with the reference, less what it explores."""
    policy = actor(seen, joints, hidden=hidden, scale=0.15, device=device)
    *_, last = (layer for layer in policy.modules() if isinstance(layer, torch.nn.Linear))
    torch.nn.init.zeros_(last.weight)
    return policy


def load_policy(path: Path, env: EnvBase) -> ProbabilisticTensorDictSequential:
    """What :func:`main` saved, for an environment that shows the same."""
    hidden = torch.load(path, map_location="cpu", weights_only=True)["metadata"]["hidden"]
    seen, joints = env.observation_spec["observation"].shape[-1], env.action_spec.shape[-1]
    policy = make_policy(seen, joints, tuple(hidden), "cpu")
    load_checkpoint(path, policy=policy)
    return policy


def measure(exam: EnvBase, policy: ProbabilisticTensorDictSequential) -> dict[str, float]:
    """Distances of throws without the noise of exploration; a throw that fails counts as 0 m."""
    end: TensorDict = play(exam, policy, STEPS)[:, -1]["next"]
    distance = throw_distance(end)
    failed = end["throw_failed"].float().mean()
    return {"distance_m": float(distance.mean()), "spread_m": float(distance.std()), "failed": float(failed)}


if __name__ == "__main__":
    main(tyro.cli(Config, description=__doc__))
