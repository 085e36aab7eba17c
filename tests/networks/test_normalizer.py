import pytest
import torch
from networks.samples import STATE, collected
from torch import nn

from torchrl_athletic.losses import SplitClipPPOLoss
from torchrl_athletic.networks import RunningNormalizer, actor


def seen(*parts):
    normalizer = RunningNormalizer(3).double()
    for part in parts:
        normalizer.update(part)
    return normalizer


def samples(seed=0):
    torch.manual_seed(seed)
    return 5.0 + torch.tensor([0.5, 2.0, 7.0]) * torch.randn(1000, 3, dtype=torch.float64)


def test_what_it_has_seen_comes_out_with_mean_0_and_deviation_1():
    data = samples()
    out = seen(data)(data)
    torch.testing.assert_close(out.mean(0), torch.zeros(3).double(), atol=1e-9, rtol=0)
    torch.testing.assert_close(out.std(0, correction=0), torch.ones(3).double())


@pytest.mark.parametrize("cuts", [[1], [999], [10, 20, 700], list(range(1, 1000))], ids=len)
def test_it_does_not_matter_in_what_portions_it_has_seen_it(cuts):
    data = samples()
    whole, parts = seen(data), seen(*data.tensor_split(cuts))
    torch.testing.assert_close(parts.mean, whole.mean)
    torch.testing.assert_close(parts.variance, whole.variance)
    assert parts.count == whole.count == 1000


def test_leading_dims_are_samples():
    data = samples()
    torch.testing.assert_close(seen(data.view(10, 100, 3)).variance, seen(data).variance)


def test_before_it_has_seen_anything_it_passes_on():
    assert RunningNormalizer(3)(torch.tensor([1.0, -2.0, 3.0])).tolist() == [1.0, -2.0, 3.0]


def test_a_feature_that_never_moved_does_not_explode():
    normalizer = RunningNormalizer(1, clip=10.0, eps=1e-2)
    normalizer.update(torch.full((100, 1), 3.0))
    assert normalizer(torch.tensor([[3.0], [3.01], [99.0]])).flatten().tolist() == pytest.approx([0, 1, 10], abs=1e-4)


def test_acting_teaches_it_nothing():
    normalizer = RunningNormalizer(3).train()
    normalizer(torch.randn(10, 3))
    assert normalizer.count == 0


def test_another_width_is_refused():
    with pytest.raises(ValueError, match="Build it with size=4"):
        RunningNormalizer(3).update(torch.randn(10, 4))


def test_the_loss_sees_what_it_learns():
    normalizer = RunningNormalizer(STATE)
    policy = actor(STATE, 3, hidden=(8,), normalizer=normalizer)
    loss = SplitClipPPOLoss(policy)
    batch = collected(policy, 32)
    assert loss.loss_actor(batch)["kl"] < 1e-9
    mean = normalizer.mean
    normalizer.update(5 + batch["observation"])
    assert normalizer.mean is mean
    assert loss.loss_actor(batch)["kl"] > 1e-4


def test_its_memory_is_part_of_the_state():
    ours, other = seen(samples()), RunningNormalizer(3).double()
    other.load_state_dict(ours.state_dict())
    assert other.count == 1000
    assert isinstance(other, nn.Module)
    assert other(samples(1)).equal(ours(samples(1)))
