import pytest
import torch

from torchrl_athletic.functional.history import look_back, push, tile

VALUES = torch.randn(12, 5, 3, generator=torch.Generator().manual_seed(0))


def pushed(length, dim=-2):
    seen = tile(VALUES[0], length, dim)
    for value in VALUES[1:]:
        seen = push(seen, value, dim)
    return seen


@pytest.mark.parametrize("length", [1, 4, 12])
def test_a_history_holds_the_last_values_oldest_first(length):
    assert torch.equal(pushed(length), VALUES[-length:].transpose(0, 1))


def test_time_may_run_along_the_last_dimension():
    assert torch.equal(pushed(4, dim=-1), pushed(4).mT)


def test_a_tiled_history_never_changed_and_is_its_own():
    seen = tile(VALUES[0], 3)
    assert torch.equal(seen, VALUES[0].unsqueeze(1).expand(5, 3, 3))
    seen[:, 0] = 0
    assert (seen[:, 1] == VALUES[0]).all()


def test_pushing_leaves_the_old_history_as_it_was():
    seen = tile(VALUES[0], 3)
    before = seen.clone()
    push(seen, VALUES[1])
    assert torch.equal(seen, before)


def test_each_row_looks_back_as_far_as_it_wants():
    seen, steps = pushed(6), torch.tensor([[0], [1], [2], [4], [5]])
    found = look_back(seen, steps)
    for row in range(5):
        assert torch.equal(found[row], VALUES[-1 - steps[row].item(), row])
