"""Numbers of the paper and of the docstrings, for those who say nothing: users notice if they change."""

import inspect

import pytest

from torchrl_athletic.training import (
    FINE_TUNE,
    PPO,
    PRE_TRAIN,
    UAN,
    CapturedRollout,
    Checkpoints,
    Condition,
    FineTune,
    GradientLearner,
    Learner,
    Processes,
    RayRollout,
    Rollout,
    draw_curves,
    draw_episode,
    examine,
    iterate,
    join_processes,
    learn_remainder,
    make_logger,
    read_wbc,
    record_video,
    save_wbc,
    set_aside,
    task_learner,
    train,
    uan_learner,
    units_of,
    validation_of,
    wbc_learner,
)


@pytest.mark.parametrize(
    ("made", "defaults"),
    [
        (
            PPO,
            {
                "discount": 0.99,
                "gae_lambda": 0.95,
                "entropy_coeff": 0.01,
                "actor_lr": 0.001,
                "least_actor_lr": 1e-5,
                "critic_lr": 0.0005,
                "kl_target": 0.01,
                "anneal": 0,
                "horizon": 24,
                "num_envs": 4096,
                "epochs": 5,
                "actor_minibatches": 4,
                "critic_minibatches": 1,
                "weight_decay": 0.01,
                "clip_epsilon": 0.2,
                "max_grad_norm": 1.0,
                "micro_batch": 24576,
                "warm_up": 0,
                "critic_first": 0,
            },
        ),
        (CapturedRollout, {"fuse": True}),
        (Checkpoints, {"keep": 3}),
        (Condition, {"substeps": 1}),
        (FineTune, {"device": "cpu", "minutes": None, "iterations": None, "num_envs": None}),
        (FineTune, {"seed": 0, "start": "wbc", "actuation": "uan", "episodes": 100, "logger": "csv", "video": True}),
        (
            GradientLearner,
            {"iterations": None, "rate": 0.001, "windows": (32, 48), "max_grad_norm": 1.0, "outlier": None},
        ),
        (Processes, {"rank": 0, "count": 1, "device": "cpu"}),
        (join_processes, {"device": "cpu"}),
        (validation_of, {"device": "cpu"}),
        (Condition.env, {"actuation": "uan", "seed": 0, "first_row": 0}),
        (wbc_learner, {"config": PRE_TRAIN, "start": None}),
        (Learner, {"config": PRE_TRAIN, "watch": ()}),
        (task_learner, {"config": FINE_TUNE, "known": {}}),
        (uan_learner, {"config": UAN}),
        (units_of, {"memory": ()}),
        (RayRollout, {"address": None, "device": None, "keys": None}),
        (learn_remainder, {"output": None, "iterations": None}),
        (train, {"show": ("reward", "kl"), "step": iterate, "iterations": None, "minutes": None}),
        (examine, {"device": "cpu"}),
        (Learner, {"normalized": "observation", "seed": 0, "collector": False, "cuda_graph": False}),
        (RayRollout, {"seed": 0}),
        (Rollout, {"collector": False}),
        (draw_curves, {"against": "samples", "shaded": 0.0}),
        (draw_episode, {"size": (480, 640), "camera": -1}),
        (
            examine,
            {"episodes": 1000, "steps": 1000, "batch": 1000, "seed": 1000003, "actuation": "uan", "progress": True},
        ),
        (learn_remainder, {"minutes": 2.0, "rows": 16, "rate": 0.002, "progress": True}),
        (make_logger, {"name": "training"}),
        (read_wbc, {"trainable": False}),
        (record_video, {"steps": 200, "frame_rate": 50.0, "size": (480, 640), "camera": -1}),
        (save_wbc, {"name": "wbc"}),
        (set_aside, {"share": 0.1, "seconds": 5.0, "seed": 0}),
        (task_learner, {"start": "wbc", "seed": 0, "cuda_graph": False}),
        (train, {"evaluate_every": 50, "checkpoint_every": 50, "checkpoint_seconds": 45.0, "progress": True}),
        (uan_learner, {"credit": "arm", "scale": 1.0, "hidden": (256, 256), "seed": 0, "cuda_graph": False}),
        (units_of, {"knows": "errors"}),
        (wbc_learner, {"hidden": (512, 512, 512), "scale": 0.5, "seed": 0, "cuda_graph": False}),
    ],
)
def test_what_is_not_said_is_as_documented(made, defaults):
    parameters = inspect.signature(made).parameters
    assert {name: parameters[name].default for name in defaults} == defaults


def test_a_task_is_tuned_by_the_numbers_for_tuning_unless_told_otherwise():
    assert FineTune().ppo == FINE_TUNE != PRE_TRAIN
