import math

import pytest
import torch

from torchrl_athletic.functional.gait import TROT, advance_cycle, foot_height, gait_phase, in_swing

CYCLE = torch.linspace(0, 1, 1001)[:-1].unsqueeze(-1)
OFFSET = torch.tensor(TROT)


def test_after_a_whole_period_the_clock_shows_what_it_showed():
    cycle = torch.tensor([0.1, 0.5, 0.9])
    later = cycle
    for _ in range(50):
        later = advance_cycle(later, frequency=2.0, dt=0.01)
    torch.testing.assert_close(later, cycle)


def test_a_quarter_of_the_cycle_after_its_start_the_sine_is_at_its_top():
    assert gait_phase(torch.tensor([0.25])).item() == pytest.approx(1)
    assert gait_phase(torch.tensor([0.75])).item() == pytest.approx(-1)


def test_in_a_trot_diagonal_feet_step_together_and_one_pair_always_stands():
    height = foot_height(CYCLE, OFFSET)
    torch.testing.assert_close(height[:, 0], height[:, 3])
    torch.testing.assert_close(height[:, 1], height[:, 2])
    assert (height[:, 0] * height[:, 1] == 0).all()


def test_a_foot_rises_to_its_apex_in_the_middle_of_its_swing_and_no_higher():
    height = foot_height(CYCLE, torch.zeros(1), apex=0.08, duty=0.6)
    assert height.max().item() == pytest.approx(0.08)
    assert CYCLE[height.argmax()].item() == pytest.approx(0.8, abs=1e-3)
    assert (height[CYCLE < 0.6] == 0).all()
    assert (height[(CYCLE > 0.61) & (CYCLE < 0.99)] > 0).all()


def test_a_foot_leaves_and_meets_the_ground_without_speed():
    swing = torch.tensor([[0.5], [1 - 1e-6]], dtype=torch.float64, requires_grad=True)
    foot_height(swing, torch.zeros(1, dtype=torch.float64)).sum().backward()
    torch.testing.assert_close(swing.grad, torch.zeros(2, 1, dtype=torch.float64), atol=1e-4, rtol=0)


def test_a_foot_that_is_ahead_shows_what_the_clock_shows_later():
    ahead, later = foot_height(CYCLE, torch.tensor([0.3])), foot_height(CYCLE + 0.3, torch.zeros(1))
    torch.testing.assert_close(ahead, later, atol=1e-6, rtol=0)
    assert math.isclose(ahead.max().item(), 0.1, rel_tol=1e-5)


@pytest.mark.parametrize("duty", [0.5, 0.75])
def test_a_foot_swings_from_the_end_of_its_stance_to_the_end_of_its_cycle(duty):
    cycle = torch.tensor([[0.0], [duty - 0.125], [duty], [0.875], [1.0]])
    assert in_swing(cycle, torch.zeros(1), duty).flatten().tolist() == [False, False, True, True, False]
    ahead = in_swing(cycle - 0.25, torch.tensor([0.25]), duty)
    assert torch.equal(ahead, in_swing(cycle, torch.zeros(1), duty))
    assert ((foot_height(CYCLE, OFFSET, duty=duty) > 0) <= in_swing(CYCLE, OFFSET, duty)).all()
