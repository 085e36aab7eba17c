"""Teach a Z1 arm to bring its end effector to a pose and hold it there.

python recipes/reach_z1.py                                   # five minutes, numbers to wandb, offline
python recipes/reach_z1.py --logger csv --output out/reach   # the same command goes on after Ctrl-C or a crash

Goals are poses of the end effector at random joint positions within 1 rad of the default, so that all can be reached.
Distance to the goal in the last half second of two, mean of 512 goals never trained on, after 5 minutes on two cores,
seeds 0, 1, 2: 0.52, 0.71, 0.70 cm; control, joint minibatches: 0.43, 0.54, 0.78 cm. Curves: docs/reach.md.
"""

from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Literal

import torch
import tyro
from torch import Tensor
from torchrl.envs import ActionScaling, CatTensors, Compose, StepCounter, TransformedEnv

from torchrl_athletic.envs import PoseGoal, TorqueEnv, draw_goal, reach_errors, reachable_poses
from torchrl_athletic.functional import rewards
from torchrl_athletic.networks import RunningNormalizer, actor, critic, save_checkpoint
from torchrl_athletic.robots import Robot, z1
from torchrl_athletic.training import PPO, Checkpoints, Learner, LoggerName, make_logger, play, record_video, train
from torchrl_athletic.transforms import ActionHistory, Decimation, PDControl, RewardTerms, Term, TorqueSpeedClip

STEPS = 100
"""Actions per episode: 2 s at 50 Hz."""
SEEN = ["joint_position", "joint_velocity", "goal_observation"]


@dataclass(frozen=True)
class Config:
    minutes: float = 5.0
    """When to stop [min]."""
    iterations: int | None = None
    """When to stop in any case."""
    seed: int = 0
    """Seed of weights, goals and exploration."""
    minibatches: Literal["split", "joint"] = "split"
    """What the critic learns from: the whole batch, or the actor's minibatches."""
    hidden: tuple[int, ...] = (128, 128)
    """Layers of both networks."""
    ppo: PPO = field(
        default_factory=lambda: PPO(num_envs=256, horizon=16, discount=0.9, entropy_coeff=0.0, kl_target=0.02)
    )
    """What else is chosen by hand."""
    spread: float = 1.0
    """How far a goal's joints may be from their default [rad]."""
    held_out: int = 512
    """Goals to measure by."""
    evaluate_every: int = 50
    """Iterations between measurements."""
    logger: LoggerName = "wandb"
    """Where numbers go; wandb stays offline."""
    output: Path = Path("outputs/reach_z1")
    """Folder for all that is written."""
    video: bool = True
    """Whether to draw an episode at the end."""


def main(cfg: Config) -> None:
    torch.manual_seed(cfg.seed)
    robot = z1()
    poses, others = (reachable_poses(robot, m, spread=cfg.spread, seed=m) for m in (20_000, cfg.held_out))
    env = make_env(robot, poses, cfg.ppo.num_envs, seed=cfg.seed)
    exam = make_env(robot, others, cfg.held_out, by_row=True)

    seen, joints = env.observation_spec["observation"].shape[-1], len(robot.joint_names)
    normalizer = RunningNormalizer(seen)
    policy = actor(seen, joints, hidden=cfg.hidden, scale=0.6, normalizer=normalizer)
    value = critic(seen, hidden=cfg.hidden, normalizer=normalizer)

    ppo = replace(cfg.ppo, critic_minibatches=1 if cfg.minibatches == "split" else cfg.ppo.actor_minibatches)
    learner = Learner(env, policy, value, ppo, normalizer=normalizer, watch=["reward_terms"], seed=cfg.seed)
    learner.rollout.current["step_count"].random_(0, STEPS)  # so that episodes do not end all at once
    errors = train(
        learner,
        minutes=cfg.minutes,
        iterations=cfg.iterations,
        evaluate=lambda: reach_errors(play(exam, policy, STEPS)),
        evaluate_every=cfg.evaluate_every,
        logger=make_logger(cfg.logger, cfg.output, "reach_z1"),
        checkpoints=Checkpoints(cfg.output / "checkpoints"),
        show=["reward", "error_cm"],
    )
    print(
        f"mean error {errors['error_cm']:.2f} cm, median {errors['median_cm']:.2f} cm, {errors['attitude_deg']:.1f} °"
    )
    print("policy:", save_checkpoint(cfg.output / "policy.pt", errors, policy=policy))
    if cfg.video:
        print("video:", record_video(exam, policy, cfg.output / "reach.mp4", steps=STEPS, annotate=draw_goal))


def make_env(robot: Robot, poses: Tensor, num_envs: int, *, by_row: bool = False, seed: int = 0) -> TransformedEnv:
    """From the motor outwards: an action passes the transforms from the last to the first, four times for each."""
    sharpness = {"far": 2.0, "near": 10.0, "there": 50.0}  # [1/m]; the paper's is 2
    terms = {
        name: Term(rewards.keypoint_tracking, "keypoints", "goal_keypoints", sharpness=value)
        for name, value in sharpness.items()
    } | {"rough": Term(rewards.action_roughness, "action_history")}
    arm = robot.joint_groups["arm"]
    scale = [1.0 if joint in arm else 0.01 for joint in range(len(robot.joint_names))]  # the gripper stays shut
    chain = Compose(
        TorqueSpeedClip(robot.torque_limit, robot.velocity_limit),  # what a motor can give at its speed
        PDControl(robot.kp, robot.kd),  # position targets [rad] to torques [N·m]
        Decimation(4),  # the two above at 200 Hz, all below at 50 Hz
        ActionScaling(loc=torch.tensor(robot.default_pose), scale=torch.tensor(scale)),  # 0 is the default pose
        ActionHistory(3),
        PoseGoal(poses, by_row=by_row, seed=seed),
        RewardTerms(terms, {"far": 1.5, "near": 0.75, "there": 0.75, "rough": -0.005}),
        CatTensors(SEEN, "observation", del_keys=False),
        StepCounter(STEPS),
    )
    return TransformedEnv(TorqueEnv(robot, num_envs=num_envs), chain)


if __name__ == "__main__":
    main(tyro.cli(Config, description=__doc__))
