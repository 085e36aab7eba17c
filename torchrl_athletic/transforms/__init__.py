"""TorchRL transforms of the actuation chain and of observations: each fetches keys, calls ``functional``, writes keys.

They know tensordicts, never MuJoCo, so that any TorchRL project can use them; the folder is linked at the root of the
repository for that reason. What must survive a step is carried in the tensordict.
"""

from torchrl_athletic.transforms.action_history import ActionHistory
from torchrl_athletic.transforms.actuation import ActionDelay, PDControl, PowerClip, TorqueSpeedClip, UANCorrection
from torchrl_athletic.transforms.command_sampler import CommandSampler
from torchrl_athletic.transforms.decimation import Decimation
from torchrl_athletic.transforms.gait_clock import GaitClock
from torchrl_athletic.transforms.observation_history import ObservationHistory
from torchrl_athletic.transforms.reference_trajectory import ReferenceTrajectory
from torchrl_athletic.transforms.reward_terms import RewardTerm, RewardTerms, Term
from torchrl_athletic.transforms.stateful import RandomTransform, StatefulTransform
from torchrl_athletic.transforms.task_phase import TaskPhase

__all__ = [
    "ActionDelay",
    "ActionHistory",
    "CommandSampler",
    "Decimation",
    "GaitClock",
    "ObservationHistory",
    "PDControl",
    "PowerClip",
    "RandomTransform",
    "ReferenceTrajectory",
    "RewardTerm",
    "RewardTerms",
    "StatefulTransform",
    "TaskPhase",
    "Term",
    "TorqueSpeedClip",
    "UANCorrection",
]
