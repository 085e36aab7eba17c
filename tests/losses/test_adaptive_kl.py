import math

import pytest
import torch

from torchrl_athletic.losses import AdaptiveKL


def after(rate, kl, **options):
    tensor = torch.tensor(rate, dtype=torch.float64)
    AdaptiveKL(**options)(tensor, torch.tensor(kl))
    return tensor.item()


def rsl_rl(rate, kl, target=0.01):
    """The rule as rsl_rl writes it, on the host."""
    if kl > 2 * target:
        return max(1e-5, rate / 1.5)
    if 0 < kl < target / 2:
        return min(1e-2, rate * 1.5)
    return rate


@pytest.mark.parametrize("rate", [1e-5, 1.2e-5, 1e-3, 8e-3, 1e-2])
@pytest.mark.parametrize("kl", [-0.1, 0.0, 1e-9, 0.0049, 0.0051, 0.01, 0.0199, 0.0201, 3.0, math.inf])
def test_it_is_the_rule_of_rsl_rl(rate, kl):
    assert after(rate, kl) == pytest.approx(rsl_rl(rate, kl), rel=1e-12)


def test_a_divergence_that_is_not_a_number_changes_nothing():
    assert after(1e-3, math.nan) == 1e-3


def test_the_band_follows_the_target_and_the_step_the_factor():
    assert after(1e-3, 0.05, target=0.1, factor=2.0) == 1e-3
    assert after(1e-3, 0.049, target=0.1, factor=2.0) == pytest.approx(2e-3)
    assert after(1e-3, 0.21, target=0.1, factor=2.0) == pytest.approx(5e-4)


@pytest.mark.parametrize("kl", [1e-9, 0.01, 3.0])
def test_a_rate_of_zero_stays_and_bounds_may_be_one_number(kl):
    assert after(0.0, kl) == 0.0
    assert after(1e-3, kl, bounds=(1e-3, 1e-3)) == pytest.approx(1e-3)


def test_the_rate_stays_the_same_tensor():
    rate = torch.tensor(1e-3)
    optimizer = torch.optim.AdamW([torch.nn.Parameter(torch.zeros(1))], lr=rate)
    AdaptiveKL()(rate, torch.tensor(1.0))
    assert optimizer.param_groups[0]["lr"] is rate
    assert rate.item() == pytest.approx(1e-3 / 1.5)


@pytest.mark.parametrize(
    ("options", "advice"),
    [
        ({"target": 0.0}, "Give 0.01"),
        ({"factor": 1.0}, "Give more than 1"),
        ({"bounds": (1e-2, 1e-5)}, "least learning rate first"),
        ({"bounds": (0.0, 1e-2)}, "least learning rate first"),
    ],
)
def test_a_rule_that_cannot_work_is_refused(options, advice):
    with pytest.raises(ValueError, match=advice):
        AdaptiveKL(**options)
