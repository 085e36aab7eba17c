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
    reach_errors,
    reachable_poses,
    replay_env,
    sled_pull_env,
    throw_env,
    throw_task,
    whole_body_env,
)


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
                "mass": (20.0, 150.0),
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
