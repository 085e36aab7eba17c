"""Numbers of the paper and of the docstrings, for those who say nothing: users notice if they change."""

import inspect
import math

import pytest

from torchrl_athletic.transforms import (
    ActionDelay,
    ActionHistory,
    ActuatorNet,
    AddedMass,
    BallFlight,
    CommandSampler,
    CorrectedActuation,
    CorrectedKeys,
    DomainRandomization,
    EncoderOffset,
    ExternalPush,
    GaitClock,
    InitialState,
    InPhase,
    LimitedTarget,
    ObservationHistory,
    PDControl,
    PeakPower,
    PoseError,
    Push,
    RandomizationRanges,
    ReferenceTrajectory,
    RewardTerms,
    SledRope,
    StaggeredEpisodes,
    StartRanges,
    TaskPhase,
    TorqueSpeedClip,
    UANCorrection,
    UANKeys,
)


@pytest.mark.parametrize(
    ("made", "defaults"),
    [
        (ActionDelay, {"max_steps": 6, "min_steps": 0, "seed": 0, "first_row": 0}),
        (ActionHistory, {"length": 3}),
        (ActuatorNet, {"length": 20}),
        (
            AddedMass,
            {"body": "dumbbell", "mass": (0.0, 10.0), "phase": 1, "empty_mass": 0.001, "seed": 0, "first_row": 0},
        ),
        (BallFlight, {"placed_at": 1.5}),
        (CommandSampler, {"seed": 0, "first_row": 0}),
        (CorrectedActuation, {"torque_limit": math.inf}),
        (DomainRandomization, {"joints": "leg", "every_episode": True, "seed": 0, "first_row": 0}),
        (EncoderOffset, {"low": -0.05, "high": 0.05, "seed": 0, "first_row": 0}),
        (ExternalPush, {"rest": (2.0, 6.0), "duration": (0.05, 0.5), "seed": 0, "first_row": 0}),
        (GaitClock, {"frequency": 2.2, "cosine": False, "random_start": False, "seed": 0, "first_row": 0}),
        (InitialState, {"seed": 0, "first_row": 0}),
        (ObservationHistory, {"flatten": False}),
        (PeakPower, {"joints": "leg"}),
        (PoseError, {"length": 0.3}),
        (Push, {"force": (0.0, 50.0), "torque": (0.0, 5.0)}),
        (
            RandomizationRanges,
            {
                "friction": (0.5, 4.0),
                "restitution": (0.0, 0.5),
                "stiffness_scale": (0.9, 1.1),
                "damping_scale": (0.5, 1.5),
                "torque_limit_scale": (0.9, 1.1),
                "mass_scale": (0.5, 1.5),
                "com_offset": (-0.02, 0.02),
            },
        ),
        (
            ReferenceTrajectory,
            {
                "lookahead": (0,),
                "flatten": True,
                "at_end": "hold",
                "interpolate": True,
                "random_start": False,
                "seed": 0,
                "first_row": 0,
            },
        ),
        (RewardTerms, {"show": True}),
        (
            SledRope,
            {
                "mass": (20.0, 180.0),
                "friction": (0.1, 0.2),
                "length": 2.0,
                "hook_height": 0.2,
                "stiffness": 1000.0,
                "damping": 1.0,
                "seed": 0,
                "first_row": 0,
            },
        ),
        (StaggeredEpisodes, {"seed": 0, "first_row": 0}),
        (
            StartRanges,
            {
                "joint_position": 0.2,
                "joint_velocity": 0.5,
                "base_position": (0.0, 0.0, 0.0),
                "base_turn": (0.1, 0.1, 3.14159),
                "base_linear_velocity": (0.5, 0.5, 0.2),
                "base_angular_velocity": (0.3, 0.3, 0.3),
            },
        ),
        (TaskPhase, {"seed": 0, "first_row": 0}),
        (UANCorrection, {"length": 20, "scale": 1.0, "state": False, "timestep": 0.005, "differentiable": False}),
    ],
)
def test_what_is_not_said_is_as_documented(made, defaults):
    parameters = inspect.signature(made).parameters
    assert {name: parameters[name].default for name in defaults} == defaults


@pytest.mark.parametrize(
    "told",
    [
        [(PDControl, "scale_keys"), (CorrectedKeys, "scales"), (LimitedTarget, "scale_keys")],
        [
            (DomainRandomization, "torque_limit_key"),
            (TorqueSpeedClip, "scale_key"),
            (CorrectedKeys, "limit_scale"),
            (LimitedTarget, "limit_scale_key"),
        ],
        [(PDControl, "target_key"), (CorrectedKeys, "target"), (UANKeys, "target"), (ActuatorNet, "target_key")],
        [(PDControl, "torque_key"), (CorrectedKeys, "torque"), (UANKeys, "torque"), (ActuatorNet, "torque_key")],
        [(PDControl, "action_key"), (CorrectedKeys, "action"), (LimitedTarget, "action_key")],
        [
            (PDControl, "position_key"),
            (CorrectedKeys, "position"),
            (UANKeys, "position"),
            (EncoderOffset, "position_key"),
        ],
        [
            (PDControl, "velocity_key"),
            (CorrectedKeys, "velocity"),
            (UANKeys, "velocity"),
            (TorqueSpeedClip, "velocity_key"),
        ],
        [(TaskPhase, "index_key"), (BallFlight, "phase_key"), (AddedMass, "phase_key"), (InPhase, "phase_key")],
        [(CommandSampler, "pose_key"), (PoseError, "command_key")],
        [(CommandSampler, "base_keys"), (PoseError, "base_keys")],
        [(CommandSampler, "height_key"), (PoseError, "height_key")],
        [(CommandSampler, "end_effector_keys"), (PoseError, "pose_keys")],
    ],
    ids=str,
)
def test_what_one_writes_is_what_the_others_read(told):
    names = {inspect.signature(made).parameters[argument].default for made, argument in told}
    assert len(names) == 1


def test_scales_are_written_where_drives_read_them():
    written = inspect.signature(DomainRandomization).parameters
    read = inspect.signature(PDControl).parameters["scale_keys"].default
    assert (written["kp_key"].default, written["kd_key"].default) == read
