"""What cannot be is refused where it is said, and what is just possible is not."""

from functools import partial
from math import inf

import pytest
import torch

from torchrl_athletic.functional.commands import CommandRanges
from torchrl_athletic.functional.phase import sled_phases
from torchrl_athletic.transforms import (
    ActionDelay,
    ActionHistory,
    AddedMass,
    BallFlight,
    CommandSampler,
    Decimation,
    EncoderOffset,
    EquivalentTarget,
    ExternalPush,
    GaitClock,
    LimitedTarget,
    ObservationHistory,
    PowerClip,
    Push,
    RandomizationRanges,
    ReferenceTrajectory,
    RewardTerms,
    SledRope,
    StaggeredEpisodes,
    StartRanges,
    TaskPhase,
    TorqueSpeedClip,
)

pushes = partial(ExternalPush, (Push(("base",)),))
TWO = {"a": torch.zeros(2, 4, 1)}
follow = partial(ReferenceTrajectory, TWO, 0.1, 0.1)


@pytest.mark.parametrize(
    ("make", "arguments"),
    [
        (ActionDelay, {"max_steps": 1, "min_steps": 2}),
        (ActionDelay, {"max_steps": 1, "min_steps": -1}),
        (ActionHistory, {"length": 0}),
        (AddedMass, {"mass": (-1.0, 1.0)}),
        (AddedMass, {"mass": (1.0, inf)}),
        (AddedMass, {"mass": (2.0, 1.0)}),
        (AddedMass, {"empty_mass": 0.0}),
        (BallFlight, {"dt": 0.0, "rim": 0.1, "radius": 0.1}),
        (CommandSampler, {"ranges": CommandRanges(), "dt": 0.0}),
        (Decimation, {"steps": 0}),
        (EncoderOffset, {"low": 0.1, "high": 0.0}),
        (EquivalentTarget, {"kp": [1.0, 0.0], "kd": 1.0}),
        (pushes, {"dt": 0.0}),
        (pushes, {"dt": 0.1, "rest": (-1.0, 1.0)}),
        (pushes, {"dt": 0.1, "rest": (2.0, 1.0)}),
        (pushes, {"dt": 0.1, "duration": (0.0, 1.0)}),
        (pushes, {"dt": 0.1, "duration": (2.0, 1.0)}),
        (ExternalPush, {"pushes": (), "dt": 0.1}),
        (GaitClock, {"dt": 0.1, "frequency": 5.0}),
        (GaitClock, {"dt": 0.1, "frequency": 0.0}),
        (LimitedTarget, {"kp": [1.0, 0.0], "kd": 1.0, "torque_limit": 1.0, "velocity_limit": 1.0}),
        (ObservationHistory, {"in_keys": ["a"], "length": 0}),
        (ObservationHistory, {"in_keys": ["a", "b"], "length": 2, "out_keys": ["c"]}),
        (ObservationHistory, {"in_keys": ["a", "b"], "length": 2, "out_keys": ["c", "b"]}),
        (PowerClip, {"max_power": 0.0}),
        (Push, {"bodies": ()}),
        (Push, {"bodies": ("base",), "force": (-1.0, 1.0)}),
        (Push, {"bodies": ("base",), "torque": (2.0, 1.0)}),
        (RandomizationRanges, {"friction": (2.0, 1.0)}),
        (RandomizationRanges, {"restitution": (0.0, 1.0)}),
        (RandomizationRanges, {"restitution": (-0.1, 0.1)}),
        (follow, {"lookahead": ()}),
        (follow, {"shown": ("a", "b")}),
        (follow, {"shown": ()}),
        (follow, {"probability": (0.5, 0.4)}),
        (follow, {"probability": (0.5, 0.6)}),
        (follow, {"probability": (-0.5, 1.5)}),
        (follow, {"probability": (1.0,)}),
        (follow, {"phase_keys": ("p", "s"), "random_start": True}),
        (follow, {"phase_keys": ("p", "s"), "probability": (0.5, 0.5)}),
        (ReferenceTrajectory, {"references": TWO, "table_dt": 0.0, "dt": 0.1}),
        (ReferenceTrajectory, {"references": TWO, "table_dt": 0.1, "dt": 0.0}),
        (ReferenceTrajectory, {"references": TWO | {"b": torch.zeros(2, 3, 1)}, "table_dt": 0.1, "dt": 0.1}),
        (RewardTerms, {"terms": {}, "scales": {}}),
        (SledRope, {"dt": 0.0}),
        (SledRope, {"dt": 0.1, "mass": (0.0, 1.0)}),
        (SledRope, {"dt": 0.1, "mass": (1.0, inf)}),
        (SledRope, {"dt": 0.1, "friction": (-0.1, 0.1)}),
        (SledRope, {"dt": 0.1, "friction": (0.1, inf)}),
        (SledRope, {"dt": 0.1, "length": 0.0}),
        (SledRope, {"dt": 0.1, "stiffness": 0.0}),
        (SledRope, {"dt": 0.1, "damping": -0.1}),
        (StaggeredEpisodes, {"max_steps": 0}),
        (StartRanges, {"base_turn": (0.1, -0.1, 0.1)}),
        (StartRanges, {"joint_velocity": -0.1}),
        (TaskPhase, {"schedule": sled_phases(), "dt": 0.0}),
        (TaskPhase, {"schedule": sled_phases(), "dt": 0.1, "width": sled_phases().width - 1}),
        (TaskPhase, {"schedule": None, "dt": 0.1}),
        (TorqueSpeedClip, {"torque_limit": [1.0, 0.0], "velocity_limit": 1.0}),
        (TorqueSpeedClip, {"torque_limit": 1.0, "velocity_limit": [1.0, 0.0]}),
    ],
    ids=lambda value: getattr(value, "__name__", None),
)
def test_what_cannot_be_is_refused(make, arguments):
    with pytest.raises(ValueError, match=r"\w+ .*\w+"):
        make(**arguments)


@pytest.mark.parametrize(
    ("make", "arguments"),
    [
        (ActionDelay, {"max_steps": 0}),
        (ActionDelay, {"max_steps": 2, "min_steps": 2}),
        (ActionHistory, {"length": 1}),
        (AddedMass, {"mass": (0.0, 0.0)}),
        (Decimation, {"steps": 1}),
        (EncoderOffset, {"low": 0.1, "high": 0.1}),
        (pushes, {"dt": 0.1, "rest": (0.0, 0.0)}),
        (pushes, {"dt": 0.1, "duration": (0.1, 0.1)}),
        (Push, {"bodies": ("base",), "force": (0.0, 0.0)}),
        (ObservationHistory, {"in_keys": ["a"], "length": 1}),
        (RandomizationRanges, {"friction": (1.0, 1.0), "restitution": (0.0, 0.0)}),
        (RandomizationRanges, {"friction": None, "restitution": None}),
        (follow, {"probability": (0.0, 1.0)}),
        (SledRope, {"dt": 0.1, "mass": (5.0, 5.0), "friction": (0.0, 0.0), "damping": 0.0}),
        (StaggeredEpisodes, {"max_steps": 1}),
        (StartRanges, {"joint_position": 0.0, "base_turn": (0.0, 0.0, 0.0)}),
        (TaskPhase, {"schedule": sled_phases(), "dt": 0.1, "width": sled_phases().width}),
        (TaskPhase, {"schedule": None, "dt": 0.1, "width": 1}),
    ],
    ids=lambda value: getattr(value, "__name__", None),
)
def test_what_is_just_possible_is_not(make, arguments):
    make(**arguments)
