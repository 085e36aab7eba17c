"""Training in a corrected simulation: collection, advantages, updates, evaluation, checkpoints, logging."""

from torchrl_athletic.training.captured import CapturedRollout, fuse_transforms
from torchrl_athletic.training.checkpoint import Checkpoints
from torchrl_athletic.training.curves import draw_curves
from torchrl_athletic.training.distributed import Processes, join_processes, standardized
from torchrl_athletic.training.evaluation import Episodes, last_of, play, whole_episodes, whole_rollout
from torchrl_athletic.training.fine_tune import FineTune, controller_for, fine_tune, task_learner
from torchrl_athletic.training.finite import NonFiniteError, check_finite
from torchrl_athletic.training.logging import CSVTable, LoggerName, MetricLogger, make_logger
from torchrl_athletic.training.ppo import FINE_TUNE, PPO, PRE_TRAIN, UAN, Learner, iterate, train
from torchrl_athletic.training.ray_rollout import RayRollout, rows_of_a_worker
from torchrl_athletic.training.remainder import learn_remainder
from torchrl_athletic.training.rollout import Rollout, control_step
from torchrl_athletic.training.uan import (
    Credit,
    JointRollout,
    Knows,
    Validation,
    chain_with,
    for_training,
    set_aside,
    takes_of,
    torque_unit,
    uan_learner,
    units_of,
    validation_of,
    with_gains_of,
)
from torchrl_athletic.training.uan_gradient import DifferentiableTorqueEnv, GradientLearner, descend
from torchrl_athletic.training.video import View, draw_episode, frame_strip, record_video, write_video
from torchrl_athletic.training.wbc import CURVES, commands_of, read_wbc, save_wbc, wbc_learner
from torchrl_athletic.training.wbc_evaluation import Condition, draw_conditions, examine, table_of, wbc_conditions

__all__ = [
    "CURVES",
    "FINE_TUNE",
    "PPO",
    "PRE_TRAIN",
    "UAN",
    "CSVTable",
    "CapturedRollout",
    "Checkpoints",
    "Condition",
    "Credit",
    "DifferentiableTorqueEnv",
    "Episodes",
    "FineTune",
    "GradientLearner",
    "JointRollout",
    "Knows",
    "Learner",
    "LoggerName",
    "MetricLogger",
    "NonFiniteError",
    "Processes",
    "RayRollout",
    "Rollout",
    "Validation",
    "View",
    "chain_with",
    "check_finite",
    "commands_of",
    "control_step",
    "controller_for",
    "descend",
    "draw_conditions",
    "draw_curves",
    "draw_episode",
    "examine",
    "fine_tune",
    "for_training",
    "frame_strip",
    "fuse_transforms",
    "iterate",
    "join_processes",
    "last_of",
    "learn_remainder",
    "make_logger",
    "play",
    "read_wbc",
    "record_video",
    "rows_of_a_worker",
    "save_wbc",
    "set_aside",
    "standardized",
    "table_of",
    "takes_of",
    "task_learner",
    "torque_unit",
    "train",
    "uan_learner",
    "units_of",
    "validation_of",
    "wbc_conditions",
    "wbc_learner",
    "whole_episodes",
    "whole_rollout",
    "with_gains_of",
    "write_video",
]
