"""The kinematics by which the reward's optimum is sought are MuJoCo's."""

import math

import mujoco
import numpy as np
import pytest
import torch

from benchmarks.reward_optimum import READINGS, Body, Config, best
from torchrl_athletic.functional import rotations
from torchrl_athletic.robots.b2z1 import LEGS


def test_hand_and_feet_are_where_mujoco_has_them():
    body = Body()
    data = mujoco.MjData(body.model)
    q = body.pose + 0.3 * torch.randn(len(body.names), generator=torch.Generator().manual_seed(0))
    height, roll, pitch = 0.5, 0.1, -0.2
    nod = torch.tensor([math.cos(pitch / 2), 0.0, math.sin(pitch / 2), 0.0])
    lean = torch.tensor([math.cos(roll / 2), math.sin(roll / 2), 0.0, 0.0])
    data.qpos[:3], data.qpos[3:7] = [0.0, 0.0, height], rotations.multiply(nod, lean).numpy()
    for angle, name in zip(q.tolist(), body.names, strict=True):
        data.qpos[body.model.joint(name).qposadr[0]] = angle
    mujoco.mj_kinematics(body.model, data)
    base = torch.tensor([height, roll, pitch])
    for chain, site in zip([body.hand, *body.feet], ["end_effector", *(f"{leg}_foot" for leg in LEGS)], strict=True):
        place, attitude = body.place(chain, q, base)
        np.testing.assert_allclose(place, data.site(site).xpos, atol=1e-5)
        np.testing.assert_allclose(rotations.matrix(attitude).flatten(), data.site(site).xmat, atol=1e-5)


def test_readings_differ_in_what_they_say():
    change = torch.tensor([[0.3, -0.4, 0.0]])
    assert [float(reading.deviation(change)) for reading in READINGS] == pytest.approx([0.7, 0.7, 0.5, 0.5], abs=1e-3)
    assert [4 * reading.weight for reading in READINGS] == pytest.approx([1, 4 / 3, 1, 4 / 3])


def test_more_starts_pay_no_less_and_a_cheaper_deviation_pays_more():
    few, many = (best(READINGS[0], "box", Config(goals=6, starts=starts, steps=60)) for starts in (1, 6))
    assert (many.reward >= few.reward - 1e-5).all()
    assert few.gain == 0
    assert many.gain >= 0
    cheap = best(READINGS[2], "box", Config(goals=6, starts=6, steps=60))
    assert cheap.reward.mean() > many.reward.mean()
    assert cheap.attitude.mean() < many.attitude.mean()


def test_a_base_that_may_not_tilt_stays_level_pays_less_and_brings_the_hand_less_near():
    free, little, level = (
        best(READINGS[1], "box", Config(goals=6, starts=6, steps=60), tilt) for tilt in (0.4, 0.1, 0)
    )
    assert (level.tilt == 0).all()
    assert 0 < little.tilt.abs().max() <= 0.1 + 1e-6 < free.tilt.abs().max() <= 0.4 + 1e-6
    assert level.reward.mean() < little.reward.mean() < free.reward.mean()
    assert level.attitude.mean() > free.attitude.mean()
