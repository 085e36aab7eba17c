"""Replayed commands move the simulated robot as they moved the one that made the recording."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import torch
from identification.arms import commands, last_layer, recorded, robot
from torch import nn

from torchrl_athletic.identification import Simulator
from torchrl_athletic.identification.open_loop import MOST, OpenLoopScore, open_loop, score
from torchrl_athletic.networks import uan
from torchrl_athletic.recordings import Recording, resample
from torchrl_athletic.robots import z1

ROBOT = robot()
COULOMB = {"effect": "coulomb_friction", "joint": "knee", "parameters": {"torque": {"value": 1.5}}}


def correction(*effects: dict) -> dict:
    return {
        "schema": "torchrl_athletic/corrected/1",
        "joint_names": list(ROBOT.joint_names),
        "effects": list(effects),
        "trims": [],
    }


def net_of(seed: int, kind: str = "correction") -> Simulator:
    torch.manual_seed(seed)
    net = uan(history=20, hidden=(16,))
    nn.init.normal_(last_layer(net).weight, std=1.0)
    return Simulator(kind, ROBOT, net=net, kind=kind)


LATE = {"effect": "actuation_delay", "joint": "hip", "parameters": {"delay": {"value": 0.017}}}
LAG = {"effect": "actuation_lag", "joint": "knee", "parameters": {"time_constant": {"value": 0.02}}}
TRUTHS = [
    Simulator("default", ROBOT),
    Simulator("cem", ROBOT, correction(COULOMB)),
    Simulator("diagnosed", ROBOT, correction(COULOMB, LATE, LAG)),
    net_of(0),
    net_of(1, "torque"),
    replace(net_of(2), correction=correction(COULOMB, LATE)),
]


@pytest.mark.parametrize("truth", TRUTHS, ids=lambda s: s.name)
@pytest.mark.parametrize("torques", [False, True], ids=["targets", "torques"])
def test_the_simulator_that_made_a_recording_follows_it_to_the_end(truth: Simulator, torques: bool) -> None:
    take = recorded(truth, commands(400, scale=2.0 if torques else 0.5), torques)
    [rollout] = open_loop(truth, [take])
    assert np.ptp(take.position, axis=0).min() > 5e-3  # it moves, a net that was never trained only a little
    np.testing.assert_allclose(rollout.position[0], take.position[1:], atol=1e-4)


@pytest.mark.parametrize("truth", TRUTHS, ids=lambda s: s.name)
def test_windows_start_with_the_memory_that_the_robot_had(truth: Simulator) -> None:
    """Histories, commands on their way and lags: without them the first 100 ms of each window would go astray."""
    take = recorded(truth, commands(400))
    [rollout] = open_loop(truth, [take], window=0.15)
    assert rollout.position.shape == (13, 30, 2)
    np.testing.assert_allclose(rollout.position, take.position[rollout.index], atol=2e-4)


def test_another_simulator_misses_and_the_error_is_the_mean_square() -> None:
    take = recorded(TRUTHS[1], commands(400))
    [rollout] = open_loop(TRUTHS[0], [take])
    missed = rollout.position[0] - take.position[1:]
    assert score([rollout]).mse == pytest.approx(np.mean(missed**2))
    assert np.mean(missed**2) > 1e-4
    assert score([rollout]).per_joint["knee"] == pytest.approx(np.mean(missed[:, 1] ** 2))
    assert score([rollout, rollout]).mse == pytest.approx(score([rollout]).mse)


def test_takes_of_other_lengths_and_gains_are_each_replayed_with_their_own() -> None:
    soft = replace(ROBOT, kp=(20.0, 15.0))
    takes = [
        recorded(Simulator("a", ROBOT), commands(300, 1)),
        recorded(Simulator("b", soft), commands(200, 2)),
        recorded(Simulator("c", ROBOT), commands(120, 3)),
        recorded(Simulator("d", ROBOT), commands(250, 4, 2.0), torques=True),
    ]
    rollouts = open_loop(Simulator("default", ROBOT), takes)
    for take, rollout in zip(takes, rollouts, strict=True):
        assert rollout.recording is take
        np.testing.assert_allclose(rollout.position[0], take.position[1:], atol=1e-4)


def test_what_the_encoder_reads_is_compared_with_what_it_read() -> None:
    offset = {"effect": "encoder_offset", "joint": "hip", "parameters": {"offset": {"value": 0.1}}}
    truth = Simulator("diagnosed", ROBOT, correction(offset))
    take = recorded(truth, commands(300))
    assert take.position[0, 0] == pytest.approx(0.1)
    for window in (None, 0.2):
        assert score(open_loop(truth, [take], window)).mse < 1e-8
    assert score(open_loop(TRUTHS[0], [take])).mse > 1e-5  # of gravity elsewhere


def test_a_rollout_that_runs_away_is_said_to_diverge_and_counts_for_a_finite_error() -> None:
    take = recorded(TRUTHS[0], commands(400))
    pushing = uan(history=20, hidden=(4,))
    nn.init.constant_(last_layer(pushing).bias, 500.0)
    found = score(
        open_loop(Simulator("uan", replace(ROBOT, velocity_limit=(1e9,) * 2), net=pushing, kind="correction"), [take])
    )
    assert found.diverged == 1.0
    assert 1.0 < found.mse <= MOST**2
    assert score(open_loop(TRUTHS[0], [take])) == OpenLoopScore(
        pytest.approx(0, abs=1e-8), pytest.approx({"hip": 0, "knee": 0}, abs=1e-8), 0.0
    )


def test_joints_that_were_not_recorded_rest_and_are_not_judged() -> None:
    arm = z1()
    hold = np.tile(arm.default_pose, (60, 1))[:, :6]
    kp, kd = np.array(arm.kp[:6]), np.array(arm.kd[:6])
    take = hold_of(hold, arm.joint_names[:6], kp, kd)
    [rollout] = open_loop(Simulator("default", arm), [take])
    assert rollout.joints == arm.joint_names[:6]
    assert np.abs(rollout.error).max() < 0.2


def hold_of(position: np.ndarray, names: tuple[str, ...], kp: np.ndarray, kd: np.ndarray) -> Recording:
    return Recording(0.005 * np.arange(len(position)), names, position, position_target=position, kp=kp, kd=kd)


def test_a_take_of_another_rate_is_replayed_on_the_grid_of_the_physics() -> None:
    """Commands that change every 30 ms, logged at 200 Hz and at 400 Hz; and at 199.5 Hz, where 5 s are 12 ms off."""
    take = recorded(TRUTHS[0], commands(1001, scale=0.3))
    fine = resample(take, 0.0025)
    odd = replace(resample(take, 1 / 199.5), velocity=None)
    for logged, least in ((fine, 1e-3), (odd, 3e-3)):
        [rollout] = open_loop(TRUTHS[0], [logged])
        assert round(rollout.recording.rate, 3) == 200.0
        assert np.sqrt(np.mean(rollout.error**2)) < least
    assert np.ptp(take.position, axis=0).min() > 0.2


def test_missing_joints_are_refused() -> None:
    take = recorded(TRUTHS[0], commands(100))
    hip = hold_of(take.position[:, :1], ("hip",), np.array([40.0]), np.array([1.0]))
    with pytest.raises(ValueError, match=r"\['knee'\] of 'two_joints' are missing"):
        open_loop(TRUTHS[0], [hip])
