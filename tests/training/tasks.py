"""Small tasks for the tests of training: an arm whose every joint shall be at zero, and numbers to be repeated."""

import torch
from tensordict import TensorDict
from torchrl.data import Unbounded
from torchrl.envs import Compose, EnvBase, StepCounter, Transform, TransformedEnv

from torchrl_athletic.envs import TorqueEnv
from torchrl_athletic.networks import RunningNormalizer, actor, critic
from torchrl_athletic.robots import z1
from torchrl_athletic.training import PPO, Learner
from torchrl_athletic.training.distributed import ALONE
from torchrl_athletic.transforms import ActionDelay, Decimation, PDControl, TorqueSpeedClip

SEEN = ["joint_position"]


class AtZero(Transform):
    """Reward: minus the distance of the joints from zero."""

    def _call(self, next_tensordict):
        if "reward" in next_tensordict.keys():
            next_tensordict["reward"] = -next_tensordict["joint_position"].norm(dim=-1, keepdim=True)
        return next_tensordict


def arm_env(num_envs=4, episode=5, first_row=0):
    """With a random delay, so that episodes differ, and episodes that end within a rollout."""
    robot = z1()
    return TransformedEnv(
        TorqueEnv(robot, num_envs=num_envs),
        Compose(
            TorqueSpeedClip(robot.torque_limit, robot.velocity_limit),
            PDControl(robot.kp, robot.kd),
            ActionDelay(3, first_row=first_row),
            Decimation(4),
            AtZero(),
            StepCounter(episode),
        ),
    )


def arm_learner(num_envs=4, seed=0, env=None, processes=ALONE, **options):
    torch.manual_seed(processes.seed(seed))
    normalizer = RunningNormalizer(7)
    policy = actor(7, 7, in_keys=SEEN, hidden=(16,), normalizer=normalizer)
    value = critic(7, in_keys=SEEN, hidden=(16,), normalizer=normalizer)
    config = PPO(num_envs=num_envs, horizon=6, epochs=2, actor_minibatches=2)
    if env is None:
        env = arm_env(processes.share(num_envs), first_row=processes.first_row(num_envs))
    options |= {"normalizer": normalizer, "normalized": "joint_position", "processes": processes}
    return Learner(env, policy, value, config, **options)


class Repeat(EnvBase):
    """Reward: minus the squared distance of the action from the two numbers that are shown, new ones at every step."""

    def __init__(self, num_envs):
        super().__init__(device="cpu", batch_size=[num_envs])
        self.observation_spec["observation"] = Unbounded((num_envs, 2))
        self.action_spec, self.reward_spec = Unbounded((num_envs, 2)), Unbounded((num_envs, 1))

    def _shown(self):
        flags = {name: torch.zeros(*self.batch_size, 1, dtype=torch.bool) for name in ("done", "terminated")}
        return TensorDict({"observation": torch.rand(*self.batch_size, 2), **flags}, self.batch_size)

    def _reset(self, tensordict):
        self.shown = self._shown()
        return self.shown.copy()

    def _step(self, tensordict):
        error = tensordict["action"] - tensordict["observation"]
        return self._shown().set("reward", -error.square().sum(-1, keepdim=True))

    def _set_seed(self, seed):
        """It draws from PyTorch's generator."""


def repeat_learner(num_envs, seed=0, processes=ALONE, **options):
    torch.manual_seed(processes.seed(seed))
    env = TransformedEnv(Repeat(processes.share(num_envs)), StepCounter(4))
    config = PPO(num_envs=num_envs, horizon=8, epochs=4, actor_lr=5e-3, critic_lr=5e-3, entropy_coeff=0.0)
    nets = actor(2, 2, hidden=(16,)), critic(2, hidden=(16,))
    return Learner(env, *nets, config, processes=processes, **options)
