import numpy as np
import pytest
import torch

from torchrl_athletic.functional.reference import PEAK_SPEED, interpolate_poses, pad_references, sample_reference

SHORT, LONG = torch.randn(4, 2), torch.randn(7, 2)
TABLE, LENGTHS = pad_references([SHORT, LONG])


def sampled(reference, position, **settings):
    position = torch.as_tensor(position, dtype=torch.float32).reshape(1, -1)
    return sample_reference(TABLE, LENGTHS, torch.tensor([[reference]]), position, **settings)[0]


def test_whole_samples_are_read_to_the_last_bit():
    for at_end in ("hold", "loop"):
        assert torch.equal(sampled(0, range(4), at_end=at_end), SHORT)
        assert torch.equal(sampled(1, range(7), at_end=at_end), LONG)


def test_between_samples_it_is_what_numpy_interpolates():
    position = np.random.default_rng(0).uniform(0, 8, 200)
    expected = np.stack([np.interp(position, range(7), LONG[:, d]) for d in range(2)], -1)
    np.testing.assert_allclose(sampled(1, position), expected, atol=1e-5)


def test_a_loop_comes_round_after_as_many_samples_as_it_has():
    position = np.random.default_rng(0).uniform(0, 4, 200)
    once, again = sampled(0, position, at_end="loop"), sampled(0, position + 4, at_end="loop")
    torch.testing.assert_close(once, again, atol=1e-5, rtol=0)
    torch.testing.assert_close(sampled(0, [3.5], at_end="loop")[0], (SHORT[3] + SHORT[0]) / 2)


def test_what_ended_holds_its_last_sample_and_not_the_padding_of_a_longer_one():
    assert torch.equal(sampled(0, [3.0, 3.4, 5.0, 6.9, 1e5]), SHORT[-1:].expand(5, -1))
    assert torch.equal(sampled(1, [-3.0, -0.5]), LONG[:1].expand(2, -1))


def test_without_interpolation_a_sample_holds_until_the_next():
    assert torch.equal(sampled(1, [2.0, 2.4, 2.99], interpolate=False), LONG[2:3].expand(3, -1))


def test_each_row_reads_its_own_reference_at_its_own_times():
    reference, position = torch.tensor([[0], [1], [0]]), torch.tensor([[0.0, 1.0], [5.0, 6.0], [2.5, 3.0]])
    seen = sample_reference(TABLE, LENGTHS, reference, position)
    for row in range(3):
        assert torch.equal(seen[row], sampled(reference[row].item(), position[row]))


def test_one_reference_and_several_of_one_length_need_no_list():
    table, lengths = pad_references(LONG)
    assert torch.equal(table, LONG[None])
    assert lengths.tolist() == [7]
    table, lengths = pad_references(torch.stack((LONG, LONG)))
    assert table.shape == (2, 7, 2)
    assert lengths.tolist() == [7, 7]


@pytest.mark.parametrize("references", [[SHORT, LONG[:, :1]], [], [SHORT[:0]], SHORT[0]])
def test_references_that_make_no_table_are_refused(references):
    with pytest.raises(ValueError, match="at least one sample and the same D"):
        pad_references(references)


def test_a_motion_passes_its_key_poses_at_rest_and_is_fastest_half_way():
    times, poses = torch.tensor([0.0, 1.0, 3.0]).double(), torch.tensor([[0.0, 1.0], [2.0, -1.0], [2.0, 3.0]]).double()
    t = torch.linspace(0, 3, 3001).double().requires_grad_()
    assert torch.equal(interpolate_poses(times, poses, times), poses)
    for column in range(2):
        [speed] = torch.autograd.grad(interpolate_poses(times, poses, t)[:, column].sum(), t, create_graph=True)
        [acceleration] = torch.autograd.grad(speed.sum(), t)
        rests = torch.tensor([1, 999, 1001, 2999])  # 1 ms beside the key poses
        assert speed[rests].abs().max() < 1e-3
        assert acceleration[rests].abs().max() < 0.2
        for leg, middle in enumerate((500, 2000)):
            mean = (poses[leg + 1, column] - poses[leg, column]) / (times[leg + 1] - times[leg])
            assert speed[middle].item() == pytest.approx(PEAK_SPEED * mean.item())
            between = speed[1000 * leg : 1000 + 2000 * leg]
            assert between.abs().max().item() <= PEAK_SPEED * abs(mean.item()) + 1e-9


def test_before_and_after_its_key_poses_a_motion_stays_there():
    times, poses = torch.tensor([0.0, 1.0]), torch.tensor([[1.0], [2.0]])
    assert interpolate_poses(times, poses, torch.tensor([-1.0, 0.0, 1.0, 5.0])).flatten().tolist() == [1, 1, 2, 2]
    assert interpolate_poses(times[:1], poses[:1], torch.tensor([-1.0, 5.0])).flatten().tolist() == [1, 1]
