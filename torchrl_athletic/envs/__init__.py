"""Environments whose step is one step of the physics: torque in, state out, and the tasks built on that.

The actuation chain between the policy and the motor is not here: it is made of ``transforms``, applied at the physics
rate.
"""

from torchrl_athletic.envs.actuation_chain import actuation_chain
from torchrl_athletic.envs.ball_throw import ball_throw_distance, ball_throw_env, ball_throw_rewards
from torchrl_athletic.envs.drawing import draw_ball, draw_command, draw_sled
from torchrl_athletic.envs.dumbbell_snatch import dumbbell_snatch_env, dumbbell_snatch_rewards
from torchrl_athletic.envs.frozen_controller import FrozenController
from torchrl_athletic.envs.reach import PoseGoal, draw_goal, reach_errors, reachable_poses
from torchrl_athletic.envs.registration import register_with_gymnasium
from torchrl_athletic.envs.replay import ReplayTakes, Takes, replay_env
from torchrl_athletic.envs.sled_pull import sled_drift, sled_pull_env, sled_pull_rewards
from torchrl_athletic.envs.task_parts import references
from torchrl_athletic.envs.throw import (
    ThrowFailure,
    throw_distance,
    throw_env,
    throw_reference,
    throw_summary,
    throw_task,
)
from torchrl_athletic.envs.torque_env import TorqueEnv, make_physics
from torchrl_athletic.envs.whole_body import NO_DISTURBANCES, Disturbances, phase_inputs, whole_body_env
from torchrl_athletic.envs.whole_body_rewards import whole_body_rewards

__all__ = [
    "NO_DISTURBANCES",
    "Disturbances",
    "FrozenController",
    "PoseGoal",
    "ReplayTakes",
    "Takes",
    "ThrowFailure",
    "TorqueEnv",
    "actuation_chain",
    "ball_throw_distance",
    "ball_throw_env",
    "ball_throw_rewards",
    "draw_ball",
    "draw_command",
    "draw_goal",
    "draw_sled",
    "dumbbell_snatch_env",
    "dumbbell_snatch_rewards",
    "make_physics",
    "phase_inputs",
    "reach_errors",
    "reachable_poses",
    "references",
    "register_with_gymnasium",
    "replay_env",
    "sled_drift",
    "sled_pull_env",
    "sled_pull_rewards",
    "throw_distance",
    "throw_env",
    "throw_reference",
    "throw_summary",
    "throw_task",
    "whole_body_env",
    "whole_body_rewards",
]

register_with_gymnasium()
