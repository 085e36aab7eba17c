"""Teach a Z1 arm, bolted to the floor, to throw a ball from a bucket as far as it can, in an identified simulator.

python recipes/throw_arm.py --ppo.critic-minibatches 4 --iterations 100  # nominal: 1.76 to 2.07 m; by hand 1.26 m
python recipes/throw_arm.py --simulator outputs/identification/uan_seed0 --output outputs/throw/uan_seed0-0
"""

from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

import torch
import tyro
from torchrl.envs import EnvBase, UnaryTransform

from torchrl_athletic.envs import throw_env, throw_summary
from torchrl_athletic.envs.throw import ARM_POWER, BUCKET, STEPS
from torchrl_athletic.identification import Simulator
from torchrl_athletic.networks import actor, critic, deploy, load_checkpoint, roa_actor, save_checkpoint
from torchrl_athletic.robots import with_bucket, z1
from torchrl_athletic.training import PPO, CapturedRollout, Checkpoints, Learner, make_logger, play, train

THROW = PPO(num_envs=512, horizon=16, entropy_coeff=0.0, actor_lr=1e-4, critic_lr=1e-3, kl_target=0.02)


@dataclass(frozen=True)
class Config:
    simulator: Path | None = None  # folder that an identification wrote; the nominal model by default
    minutes: float = 5.0  # when to stop; iterations stop it in any case
    iterations: int | None = None
    seed: int = 0
    device: Literal["cpu", "cuda"] = "cpu"
    fuse: bool = True  # compile all on a GPU: it takes a minute, and pays after hundreds of iterations
    begin_with: Path | None = None  # policy.pt that was learnt in another simulator
    hidden: tuple[int, ...] = (128, 64)
    ppo: PPO = THROW
    evaluate_every: int = 10  # iterations; policy.pt is the one that threw farthest in its simulation
    output: Path = Path("outputs/throw/default-0")


def main(cfg: Config) -> None:
    torch.manual_seed(cfg.seed)
    simulator = load_simulator(cfg.simulator)
    env = make_env(simulator, cfg.ppo.num_envs, device=cfg.device, seed=cfg.seed)
    exam = make_env(load_simulator(cfg.simulator), 32, seed=1_000_000, randomize=False, ends=False)  # has its own net
    width = {key: env.observation_spec[key].shape[-1] for key in ("observation", "privileged")}
    sizes = {"seen": width["observation"], "joints": env.action_spec.shape[-1], "hidden": list(cfg.hidden)}
    sizes["adapts_to"] = env.observation_spec["randomization"].shape[-1] if simulator.name == "roa" else 0
    policy = make_policy(**sizes, device=cfg.device)
    value = critic(sum(width.values()), in_keys=list(width), hidden=cfg.hidden, device=cfg.device)
    if cfg.begin_with is not None:
        load_checkpoint(cfg.begin_with, policy=policy, critic=value)
    watch, graph = ["reward_terms", "throw_failed"], cfg.device == "cuda"
    rollout = CapturedRollout(env, policy, cfg.ppo.horizon, keys=[*width, *watch], fuse=cfg.fuse)
    learner = Learner(env, policy, value, cfg.ppo, watch=watch, seed=cfg.seed, cuda_graph=graph, rollout=rollout)
    learner.rollout.current["step_count"].random_(0, STEPS)  # so that episodes do not end all at once
    copy = make_policy(**sizes)
    examined = deployed(copy, sizes["adapts_to"])
    best = {"distance_m": float("-inf")}

    def evaluate() -> dict[str, float]:
        copy.load_state_dict(policy.state_dict())
        found = throw_summary(play(exam, examined, STEPS)[:, -1]["next"])
        about = {"sizes": sizes, "iterations": learner.iteration, "samples": learner.samples, **found}
        save_checkpoint(cfg.output / "examined" / f"{learner.iteration:06d}.pt", about, policy=policy)
        if found["distance_m"] >= best["distance_m"]:
            best.update(found)
            save_checkpoint(cfg.output / "policy.pt", about, policy=policy, critic=value)
        return found

    train(
        learner,
        minutes=cfg.minutes,
        iterations=cfg.iterations,
        evaluate=evaluate,
        evaluate_every=cfg.evaluate_every,
        logger=make_logger("csv", cfg.output, "throw_arm"),
        checkpoints=Checkpoints(cfg.output / "checkpoints", keep=1),
        checkpoint_every=cfg.evaluate_every,
    )
    print(f"{best['distance_m']:.2f} ± {best['spread_m']:.2f} m, {100 * best['failed']:.0f} % of throws failed")


def load_simulator(folder: Path | None) -> Simulator:
    """With the bucket in the arm's jaws, whatever it was identified with."""
    robot = with_bucket(z1(), BUCKET)
    return Simulator("default", robot) if folder is None else Simulator.load(folder, robot)


def make_env(simulator: Simulator, num_envs: int, *, seed: int = 0, randomize: bool = True, **task: Any) -> EnvBase:
    """The task in an identified simulator."""
    chain = simulator.chain(arm_power=ARM_POWER, randomize=randomize, seed=seed)
    known = ["randomization"] if simulator.name == "roa" and randomize else []
    env = throw_env(simulator.robot, num_envs=num_envs, chain=chain, privileged=known, seed=seed, **task)
    # returns of order one are soon learnt; RewardScaling would do, but asks a tensor, which no CUDA graph can hold
    return env.append_transform(UnaryTransform(["reward"], ["reward"], fn=lambda reward: 0.1 * reward))


def make_policy(seen: int, joints: int, adapts_to: int, hidden: tuple[int, ...], device: str = "cpu") -> Any:
    """That begins with the reference, but for what it explores."""
    if adapts_to:
        keys = ("observation", "randomization", "observation")
        policy = roa_actor(seen, joints, adapts_to, seen, in_keys=keys, hidden=hidden, scale=0.15, device=device)
    else:
        policy = actor(seen, joints, hidden=hidden, scale=0.15, device=device)
    outputs = [m for m in policy.modules() if isinstance(m, torch.nn.Linear) and m.out_features == joints]
    torch.nn.init.zeros_(outputs[-1].weight)
    return policy


def deployed(policy: Any, adapts_to: int) -> Any:
    """As it acts on a robot, where nobody tells it what was randomised; changes the policy, if that adapts."""
    if not adapts_to:
        return policy
    alone = deploy(policy)
    return lambda td: alone(td.set("randomization", torch.zeros(*td.shape, adapts_to, device=td.device)))


if __name__ == "__main__":
    main(tyro.cli(Config, description=__doc__))
