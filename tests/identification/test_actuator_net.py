"""A net learns the torque law that made a recording, and the simulation driven by it moves as the recording did."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import torch
from identification.arms import commands, recorded, robot

from torchrl_athletic.identification import Simulator
from torchrl_athletic.identification.actuator_net import ActuatorNetTraining, identify_actuator_net, samples
from torchrl_athletic.identification.open_loop import open_loop, score
from torchrl_athletic.recordings import Recording

ROBOT = robot()
WEAK = replace(ROBOT, kp=(20.0, 20.0), kd=(0.5, 0.5))
"""What the drives truly do, when they are told ``ROBOT``'s gains."""


def told_wrong_gains(take: Recording) -> Recording:
    """Torques of one net for both joints: the same true gains, wrongly stated."""
    return replace(take, kp=np.array(ROBOT.kp), kd=np.array(ROBOT.kd))


def test_it_learns_what_the_drives_do_and_follows_an_unseen_take() -> None:
    truth = Simulator("truth", WEAK)
    takes = [told_wrong_gains(recorded(truth, commands(1001, seed))) for seed in (1, 2, 3)]
    unseen = told_wrong_gains(recorded(truth, commands(801, 4)))
    quick = ActuatorNetTraining(history=4, hidden=(32, 32), batch=256, epochs=30, learning_rate=3e-3)
    found = identify_actuator_net(ROBOT, takes, quick)
    before, after = (score(open_loop(s, [unseen])).mse for s in (Simulator("default", ROBOT), found))
    assert after < before / 10
    assert found.kind == "torque"
    assert found.notes["torque_rmse"] < 0.25 * np.std(unseen.torque_measured)
    assert found.notes["data_seconds"] == pytest.approx(15.0)


@pytest.mark.parametrize("torques", [False, True], ids=["targets", "torques"])
def test_it_learns_from_the_errors_that_the_transform_will_show_it(torques: bool) -> None:
    """History by history, and each with the torque of the step that it leads to."""
    net = torch.nn.Sequential(torch.nn.Linear(2 * 3, 1))
    seen: list[torch.Tensor] = []
    net.register_forward_hook(lambda _, given, out: seen.append(given[0].clone()))
    take = recorded(Simulator("t", ROBOT, net=net, kind="torque"), commands(50, 5, 2.0 if torques else 0.5), torques)
    if torques:
        take = replace(take, torque_measured=take.torque_command, torque_semantics="current_derived")
    errors, torque = samples(ROBOT, take, history=3)
    steps = torch.stack([s[0] for s in seen if s.shape[0] == 1])[-49:]  # of one environment, after its specs were made
    torch.testing.assert_close(errors, steps[2:49], atol=1e-5, rtol=1e-4)
    if not torques:
        torch.testing.assert_close(torque, net(errors).squeeze(-1).detach(), atol=1e-4, rtol=1e-4)


def test_without_a_measured_torque_it_says_what_to_do() -> None:
    take = recorded(Simulator("t", ROBOT), commands(60, 1, 2.0), torques=True)
    with pytest.raises(ValueError, match="train an Unsupervised Actuator Net, which needs none"):
        identify_actuator_net(ROBOT, [take])
