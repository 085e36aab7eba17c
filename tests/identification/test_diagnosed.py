"""A diagnosed simulator holds named physics alone, and only such as a policy's simulation can act out."""

from __future__ import annotations

import json
from dataclasses import replace

import numpy as np
import pytest
from identification.arms import commands, recorded, robot

from torchrl_athletic.identification import Simulator, open_loop, score
from torchrl_athletic.identification.cem import correction_of
from torchrl_athletic.identification.diagnosed import actable_effects, identify_diagnosed, within_limits
from torchrl_athletic.transforms.corrected_actuation import IN_THE_CHAIN, IN_THE_MODEL, NOT_ACTED_OUT

ROBOT = robot()
TRUTH = Simulator("truth", ROBOT, correction_of(ROBOT.joint_names, [2.0, 0.3, 0.5, 0.3, 0.03, 0.02]))


@pytest.mark.slow
def test_it_finds_the_friction_that_was_added_and_follows_takes_that_it_never_saw(tmp_path) -> None:
    takes = [recorded(TRUTH, commands(1201, seed)) for seed in (1, 2)]
    found = identify_diagnosed(ROBOT, takes, refine=None, output=tmp_path / "diagnosis")
    unseen = recorded(TRUTH, commands(801, 3))
    before, after = (score(open_loop(s, [unseen])).mse for s in (Simulator("default", ROBOT), found))
    assert after < before / 30
    assert [(f["effect"], f["joint"]) for f in found.notes["findings"]][:1] == [("coulomb_friction", "hip")]
    assert found.notes["data_seconds"] == pytest.approx(12.0)
    again = Simulator.load(found.save(tmp_path / "simulator"), ROBOT)
    assert score(open_loop(again, [unseen])).mse == after
    assert json.loads((tmp_path / "diagnosis" / "diagnosis.json").read_text())["verdict"] == found.notes["verdict"]


def test_only_effects_that_a_chain_or_a_model_of_any_robot_can_hold_are_looked_for() -> None:
    names = {effect.name for effect in actable_effects()}
    assert names <= IN_THE_CHAIN.keys() | IN_THE_MODEL.keys()
    assert not names & (
        NOT_ACTED_OUT.keys() | {"payload", "gravity_tilt", "joint_spring", "disturbance", "speed_torque_limit"}
    )
    assert {"coulomb_friction", "stribeck_friction", "actuation_lag", "reflected_inertia"} <= names


def test_within_limits_a_replay_without_limits_gets_the_torques_that_the_drives_gave() -> None:
    """Steps so large that the motors are cut off at first, and brake with less than the law asks for."""
    take = recorded(Simulator("default", ROBOT), commands(401, 6, scale=2.0))
    free = replace(ROBOT, velocity_limit=(1e9, 1e9), torque_limit=(1e9, 1e9))
    limited = within_limits(ROBOT, take)
    cut = np.abs(limited.position_target - take.position_target) > 1e-9
    assert 0.02 < cut.mean() < 0.9
    [with_limits], [without], [unaware] = (
        open_loop(Simulator("default", arm), [r]) for arm, r in ((ROBOT, take), (free, limited), (free, take))
    )
    np.testing.assert_allclose(without.position, with_limits.position, atol=2e-3)
    assert np.abs(unaware.position - with_limits.position).max() > 0.1


def test_torques_are_cut_at_the_same_limits() -> None:
    take = recorded(Simulator("default", ROBOT), commands(200, 6, scale=40.0), torques=True)
    torque, limit = within_limits(ROBOT, take).torque_command, np.array(ROBOT.torque_limit)
    assert (np.abs(torque) <= limit).all()
    forward = take.velocity > 6.0  # half of the greatest speed
    assert forward.any()
    assert (torque <= limit * (1 - take.velocity / 12.0).clip(0, 1) + 1e-9).all()
    assert (np.abs(take.torque_command) > limit).any()
