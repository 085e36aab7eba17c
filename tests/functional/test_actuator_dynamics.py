"""Laws between a command and a joint, by hand and by symmetry."""

import pytest
import torch

from torchrl_athletic.functional.actuator_dynamics import ripple, stop_torque, stribeck_relief, wind_up


def test_a_ripple_comes_back_after_a_period_and_has_its_amplitude():
    q = torch.linspace(-2.0, 2.0, 4001, dtype=torch.float64)
    sine, cosine, wave = torch.tensor(0.3), torch.tensor(0.4), torch.tensor(9.0)
    torque = ripple(q, sine, cosine, wave)
    torch.testing.assert_close(torque, ripple(q + 2 * torch.pi / 9, sine, cosine, wave), rtol=0, atol=1e-6)
    assert torque.max() == pytest.approx(0.5, rel=1e-4)
    assert ripple(torch.zeros(1), sine, cosine, wave) == pytest.approx(0.4)
    assert ripple(torch.tensor([0.01]), sine, cosine, wave) > 0.4  # the sine rises first


@pytest.mark.parametrize("way", [1.0, -1.0])
def test_stribeck_friction_falls_from_breakaway_to_coulomb_and_always_brakes(way):
    coulomb, excess, speed = 0.2, 0.3, torch.tensor(0.1)
    v = way * torch.tensor([1e-6, 0.1, 10.0], dtype=torch.float64)
    friction = -(coulomb + excess) * torch.sign(v) + stribeck_relief(v, torch.tensor(excess), speed)
    left = torch.tensor([1.0, torch.e**-1, 0.0], dtype=torch.float64)
    torch.testing.assert_close(friction, -way * (coulomb + excess * left), rtol=1e-6, atol=1e-6)


@pytest.mark.parametrize("side", [1.0, -1.0])
def test_a_stop_pushes_back_and_never_pulls(side):
    place, stiffness = torch.tensor(0.4), torch.tensor(50.0)
    q = 0.4 + side * torch.tensor([-0.3, -1e-3, 0.02])
    torque = stop_torque(q, place, torch.tensor(side), stiffness)
    torch.testing.assert_close(torque, torch.tensor([0.0, 0.0, -side * 1.0]), rtol=1e-4, atol=0)


def test_winding_up_one_way_counts_the_way_and_not_the_steps():
    width = torch.tensor(0.05, dtype=torch.float64)
    steps = torch.tensor([0.01, 0.002, 0.03], dtype=torch.float64)
    start = torch.tensor(-0.7, dtype=torch.float64)
    by_steps = start
    for step in steps:
        by_steps = wind_up(by_steps, step, width)
    torch.testing.assert_close(by_steps, wind_up(start, steps.sum(), width))
    torch.testing.assert_close(-by_steps, wind_up(-start, -steps.sum(), width))  # no side is preferred
    assert wind_up(start, torch.tensor(10.0, dtype=torch.float64), width) == pytest.approx(1.0)
    assert wind_up(start, torch.tensor(0.0, dtype=torch.float64), width) == start
