"""The baselines of the paper: cross-entropy method, supervised actuator net, domain randomisation, online adaptation.

They explain a mismatch by numbers alone, which is what ``diagnosis`` is measured against.
"""

from torchrl_athletic.identification.actuation import actuation_identity, with_actuation
from torchrl_athletic.identification.actuator_net import ActuatorNetTraining, identify_actuator_net
from torchrl_athletic.identification.cem import CEM, identify_cem
from torchrl_athletic.identification.comparison import Result, compare, every_seed, figure, name_of_uan, table
from torchrl_athletic.identification.diagnosed import identify_diagnosed
from torchrl_athletic.identification.open_loop import OpenLoopScore, Replay, open_loop, score
from torchrl_athletic.identification.randomization import ARM_RANGES, randomized
from torchrl_athletic.identification.simulator import Simulator, inertia_of, load_net, on_a_fit, read_correction
from torchrl_athletic.identification.takes import digest_of, on_all_joints, on_grid

__all__ = [
    "ARM_RANGES",
    "CEM",
    "ActuatorNetTraining",
    "OpenLoopScore",
    "Replay",
    "Result",
    "Simulator",
    "actuation_identity",
    "compare",
    "digest_of",
    "every_seed",
    "figure",
    "identify_actuator_net",
    "identify_cem",
    "identify_diagnosed",
    "inertia_of",
    "load_net",
    "name_of_uan",
    "on_a_fit",
    "on_all_joints",
    "on_grid",
    "open_loop",
    "randomized",
    "read_correction",
    "score",
    "table",
    "with_actuation",
]
