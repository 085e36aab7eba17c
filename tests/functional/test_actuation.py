"""From a position target to a torque, against the paper's inequalities and limit cases."""

import math

import pytest
import torch

from torchrl_athletic.functional.actuation import (
    brake_overspeed,
    clip_torque_speed,
    pd_torque,
    power_scale,
    torque_speed_limits,
)

LIMIT, FASTEST = torch.tensor(30.0), torch.tensor(10.0)


def grid() -> tuple[torch.Tensor, torch.Tensor]:
    """Torques up to three times the limit, at speeds up to twice the fastest."""
    torque, velocity = torch.meshgrid(torch.linspace(-90, 90, 61), torch.linspace(-20, 20, 41), indexing="ij")
    return torque, velocity


def test_a_joint_at_rest_at_its_target_is_left_alone():
    at = torch.tensor([0.3, -1.0])
    assert pd_torque(at, at, torch.zeros(2), 20.0, 0.5).tolist() == [0.0, 0.0]


@pytest.mark.parametrize(("target", "velocity", "sign"), [(1.0, 0.0, 1), (-1.0, 0.0, -1), (0.0, 1.0, -1)])
def test_a_spring_pulls_towards_the_target_and_a_damper_against_the_motion(target, velocity, sign):
    torque = pd_torque(torch.tensor([target]), torch.zeros(1), torch.tensor([velocity]), 20.0, 0.5)
    assert torch.sign(torque) == sign


def test_a_critically_damped_joint_comes_to_rest_at_its_target_without_overshoot():
    inertia, kp = 2.0, 50.0
    kd = 2 * math.sqrt(kp * inertia)
    q, v, highest = torch.zeros(1, dtype=torch.float64), torch.zeros(1, dtype=torch.float64), 0.0
    for _ in range(20_000):
        v = v + 1e-4 * pd_torque(torch.ones_like(q), q, v, kp, kd) / inertia
        q = q + 1e-4 * v
        highest = max(highest, q.item())
    rate = math.sqrt(kp / inertia)
    assert q.item() == pytest.approx(1 - (1 + rate * 2.0) * math.exp(-rate * 2.0), abs=1e-3)
    assert highest <= 1.0


def test_the_paper_s_inequalities_hold_for_every_torque_and_speed():
    torque, velocity = grid()
    out = clip_torque_speed(torque, velocity, LIMIT, FASTEST)
    used = velocity / FASTEST
    assert (out <= LIMIT * (1 - used.clamp(0, 1))).all()
    assert (out >= -LIMIT * (1 + used.clamp(-1, 0))).all()


def test_a_torque_within_the_limits_passes_unchanged():
    torque, velocity = grid()
    low, high = torque_speed_limits(velocity, LIMIT, FASTEST)
    inside = (torque >= low) & (torque <= high)
    assert inside.any()
    assert not inside.all()
    assert torch.equal(clip_torque_speed(torque, velocity, LIMIT, FASTEST)[inside], torque[inside])


def test_a_motor_is_the_same_in_both_directions():
    torque, velocity = grid()
    there = clip_torque_speed(torque, velocity, LIMIT, FASTEST)
    assert torch.equal(clip_torque_speed(-torque, -velocity, LIMIT, FASTEST), -there)


@pytest.mark.parametrize(
    ("velocity", "most"),
    [(0.0, 30.0), (2.5, 22.5), (5.0, 15.0), (10.0, 0.0), (20.0, 0.0), (-5.0, 30.0), (-20.0, 30.0)],
)
def test_what_a_motor_pushes_falls_linearly_with_speed_and_what_it_brakes_with_does_not(velocity, most):
    asked = torch.tensor([1000.0])
    assert clip_torque_speed(asked, torch.tensor([velocity]), LIMIT, FASTEST).item() == pytest.approx(most)


def test_a_motor_up_to_its_fastest_is_not_braked_and_faster_it_takes_power_in():
    torque, velocity = grid()
    braked, faster = brake_overspeed(torque, velocity, LIMIT, FASTEST), velocity.abs() > FASTEST
    assert torch.equal(braked[~faster], torque[~faster])
    assert ((braked * velocity)[faster] < 0).all()
    assert torch.equal(brake_overspeed(-torque, -velocity, LIMIT, FASTEST), -braked)


@pytest.mark.parametrize(
    ("asked", "velocity", "left"),
    [(30.0, 15.0, -15.0), (-10.0, 15.0, -15.0), (-20.0, 15.0, -20.0), (30.0, 20.0, -30.0), (0.0, 35.0, -30.0)],
)
def test_the_line_of_torque_over_speed_goes_on_below_zero_to_the_torque_at_standstill(asked, velocity, left):
    there = brake_overspeed(torch.tensor([asked]), torch.tensor([velocity]), LIMIT, FASTEST)
    assert there.item() == pytest.approx(left)


def test_power_stays_in_bounds_and_the_torques_keep_their_proportions():
    generator = torch.Generator().manual_seed(0)
    torque = 50 * torch.randn(500, 6, generator=generator)
    velocity = 5 * torch.randn(500, 6, generator=generator)
    scale = power_scale(torque, velocity, 150.0)
    power = ((scale * torque).abs() * velocity.abs()).sum(-1)
    assert (power <= 150.0 * (1 + 1e-6)).all()
    assert ((0 < scale) & (scale <= 1)).all()
    bound = scale.squeeze(-1) < 1
    assert bound.any()
    assert power[bound] == pytest.approx(150.0, rel=1e-5)


def test_power_below_the_bound_costs_no_torque():
    torque, velocity = torch.tensor([[10.0, -5.0]]), torch.tensor([[1.0, 1.0]])
    assert power_scale(torque, velocity, 15.001).item() == 1.0


def test_braking_counts_as_much_as_pushing():
    velocity = torch.tensor([2.0, 4.0])
    pushing, braking = torch.tensor([10.0, 5.0]), torch.tensor([-10.0, 5.0])
    assert power_scale(pushing, velocity, 20.0) == power_scale(braking, velocity, 20.0) == 0.5


def test_a_robot_at_rest_is_not_scaled_nor_divided_by_zero():
    assert power_scale(torch.full((1, 3), 100.0), torch.zeros(1, 3), 1.0).item() == 1.0
