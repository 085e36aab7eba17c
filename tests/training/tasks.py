"""A small task for the tests of training: an arm whose every joint shall be at zero."""

import torch
from torchrl.envs import Compose, StepCounter, Transform, TransformedEnv

from torchrl_athletic.envs import TorqueEnv
from torchrl_athletic.networks import RunningNormalizer, actor, critic
from torchrl_athletic.robots import z1
from torchrl_athletic.training import PPO, Learner
from torchrl_athletic.transforms import ActionDelay, Decimation, PDControl, TorqueSpeedClip

SEEN = ["joint_position"]


class AtZero(Transform):
    """Reward: minus the distance of the joints from zero."""

    def _call(self, next_tensordict):
        if "reward" in next_tensordict.keys():
            next_tensordict["reward"] = -next_tensordict["joint_position"].norm(dim=-1, keepdim=True)
        return next_tensordict


def arm_env(num_envs=4, episode=5):
    """With a random delay, so that episodes differ, and episodes that end within a rollout."""
    robot = z1()
    return TransformedEnv(
        TorqueEnv(robot, num_envs=num_envs),
        Compose(
            TorqueSpeedClip(robot.torque_limit, robot.velocity_limit),
            PDControl(robot.kp, robot.kd),
            ActionDelay(3),
            Decimation(4),
            AtZero(),
            StepCounter(episode),
        ),
    )


def arm_learner(num_envs=4, seed=0, env=None, **options):
    torch.manual_seed(seed)
    normalizer = RunningNormalizer(7)
    policy = actor(7, 7, in_keys=SEEN, hidden=(16,), normalizer=normalizer)
    value = critic(7, in_keys=SEEN, hidden=(16,), normalizer=normalizer)
    config = PPO(num_envs=num_envs, horizon=6, epochs=2, actor_minibatches=2)
    env = arm_env(num_envs) if env is None else env
    return Learner(env, policy, value, config, normalizer=normalizer, normalized="joint_position", **options)
