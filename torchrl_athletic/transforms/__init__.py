"""TorchRL transforms of the actuation chain and of observations: each fetches keys, calls ``functional``, writes keys.

They know tensordicts, never MuJoCo, so that any TorchRL project can use them; the folder is linked at the root of the
repository for that reason. What must survive a step is carried in the tensordict.
"""

from torchrl_athletic.transforms.action_history import ActionHistory
from torchrl_athletic.transforms.actuation import (
    ActionDelay,
    EquivalentTarget,
    OverspeedBrake,
    PDControl,
    PowerClip,
    TorqueSpeedClip,
    UANCorrection,
    UANKeys,
)
from torchrl_athletic.transforms.actuator_net import ActuatorNet
from torchrl_athletic.transforms.added_mass import AddedMass
from torchrl_athletic.transforms.ball_flight import BallFlight
from torchrl_athletic.transforms.command_sampler import CommandSampler
from torchrl_athletic.transforms.corrected_actuation import CorrectedActuation, CorrectedKeys
from torchrl_athletic.transforms.decimation import Decimation
from torchrl_athletic.transforms.domain_randomization import DomainRandomization, RandomizationRanges
from torchrl_athletic.transforms.early_termination import EarlyTermination
from torchrl_athletic.transforms.encoder_offset import EncoderOffset
from torchrl_athletic.transforms.external_push import B2Z1_PUSHES, ExternalPush, Push
from torchrl_athletic.transforms.gait_clock import GaitClock
from torchrl_athletic.transforms.initial_state import InitialState, StartRanges
from torchrl_athletic.transforms.limited_target import LimitedTarget
from torchrl_athletic.transforms.observation_history import ObservationHistory
from torchrl_athletic.transforms.peak_power import PeakPower
from torchrl_athletic.transforms.pose_error import PoseError
from torchrl_athletic.transforms.reference_trajectory import ReferenceKeys, ReferenceTrajectory
from torchrl_athletic.transforms.reward_terms import InPhase, RewardTerm, RewardTerms, Term
from torchrl_athletic.transforms.sled_rope import SledRope
from torchrl_athletic.transforms.staggered_episodes import StaggeredEpisodes
from torchrl_athletic.transforms.start_line import StartLine
from torchrl_athletic.transforms.stateful import RandomTransform, StatefulTransform
from torchrl_athletic.transforms.task_phase import TaskPhase

__all__ = [
    "B2Z1_PUSHES",
    "ActionDelay",
    "ActionHistory",
    "ActuatorNet",
    "AddedMass",
    "BallFlight",
    "CommandSampler",
    "CorrectedActuation",
    "CorrectedKeys",
    "Decimation",
    "DomainRandomization",
    "EarlyTermination",
    "EncoderOffset",
    "EquivalentTarget",
    "ExternalPush",
    "GaitClock",
    "InPhase",
    "InitialState",
    "LimitedTarget",
    "ObservationHistory",
    "OverspeedBrake",
    "PDControl",
    "PeakPower",
    "PoseError",
    "PowerClip",
    "Push",
    "RandomTransform",
    "RandomizationRanges",
    "ReferenceKeys",
    "ReferenceTrajectory",
    "RewardTerm",
    "RewardTerms",
    "SledRope",
    "StaggeredEpisodes",
    "StartLine",
    "StartRanges",
    "StatefulTransform",
    "TaskPhase",
    "Term",
    "TorqueSpeedClip",
    "UANCorrection",
    "UANKeys",
]
