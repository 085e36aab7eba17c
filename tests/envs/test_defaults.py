"""Numbers of the paper and of the docstrings, for those who say nothing: users notice if they change."""

import inspect
import math

import pytest

from torchrl_athletic.envs import (
    FrozenController,
    PoseGoal,
    ReplayTakes,
    Takes,
    ThrowFailure,
    TorqueEnv,
    actuation_chain,
    ball_throw_env,
    draw_ball,
    draw_command,
    draw_sled,
    dumbbell_snatch_env,
    dumbbell_snatch_rewards,
    reach_errors,
    reachable_poses,
    replay_env,
    sled_pull_env,
    sled_pull_rewards,
    throw_env,
    throw_task,
    whole_body_env,
    whole_body_rewards,
)
from torchrl_athletic.envs.gymnasium_env import GymnasiumVectorEnv
from torchrl_athletic.envs.task_parts import auxiliary_rewards
from torchrl_athletic.envs.throw import AroundReference
from torchrl_athletic.envs.whole_body import PRIVILEGED, TrackingErrors


@pytest.mark.parametrize(
    ("made", "defaults"),
    [
        (FrozenController, {"history": 10}),
        (PoseGoal, {"by_row": False, "seed": 0, "first_row": 0}),
        (
            ReplayTakes,
            {
                "max_steps": 4000,
                "by_row": False,
                "bound": 1.5,
                "penalty": -10.0,
                "state": False,
                "seed": 0,
                "first_row": 0,
            },
        ),
        (Takes, {"driven": "position"}),
        *(
            (made, {"position_key": "joint_position"})
            for made in (whole_body_rewards, auxiliary_rewards, sled_pull_rewards, dumbbell_snatch_rewards)
        ),
        (GymnasiumVectorEnv, {"num_envs": 1, "autoreset": True}),
        (AroundReference, {"share": 0.25, "reference_key": "reference", "phase_key": "task_phase_index"}),
        (TrackingErrors, {"length": 0.3}),
        (whole_body_env, {"device": "cpu", "privileged": PRIVILEGED, "objects": (), "extra": ()}),
        (throw_env, {"device": "cpu", "sensing": (), "extra": (), "privileged": ()}),
        (TorqueEnv.__init__, {"num_envs": 1, "device": "cpu", "every_step": (), "substeps": 1, "footprint": 0.5}),
        (ThrowFailure, {"tolerance": 0.01, "clearance": 0.1, "ends": True}),
        (actuation_chain, {"max_delay": 0, "min_delay": 0, "decimation": 4, "seed": 0, "first_row": 0}),
        (ball_throw_env, {"num_envs": 4096, "motion": "throw", "max_steps": 300, "seed": 0, "first_row": 0}),
        (draw_ball, {"radius": 0.035}),
        (draw_command, {"frame_height": 0.5}),
        (draw_sled, {"hook_height": 0.2}),
        (
            dumbbell_snatch_env,
            {"num_envs": 4096, "mass": (0.0, 10.0), "motion": "snatch", "max_steps": 500, "seed": 0, "first_row": 0},
        ),
        (reach_errors, {"last": 25}),
        (reachable_poses, {"spread": math.inf, "seed": 0, "clearance": 0.05}),
        (replay_env, {"unit": 1.0, "num_envs": 1, "max_steps": 4000, "by_row": False, "seed": 0}),
        (
            sled_pull_env,
            {
                "num_envs": 4096,
                "mass": (20.0, 180.0),
                "friction": (0.1, 0.2),
                "motion": "sled",
                "max_steps": 1000,
                "seed": 0,
                "first_row": 0,
            },
        ),
        (throw_env, {"spread": 0.05, "tolerance": 0.01, "ends": True, "seed": 0, "first_row": 0}),
        (throw_task, {"tolerance": 0.01, "ends": True}),
        (
            whole_body_env,
            {
                "num_envs": 4096,
                "net": "uan",
                "arm_power": 300.0,
                "history": 10,
                "max_steps": 1000,
                "task_width": 4,
                "staggered": False,
                "substeps": 1,
                "seed": 0,
                "first_row": 0,
            },
        ),
    ],
)
def test_what_is_not_said_is_as_documented(made, defaults):
    parameters = inspect.signature(made).parameters
    assert {name: parameters[name].default for name in defaults} == defaults
