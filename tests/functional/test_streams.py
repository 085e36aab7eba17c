import pytest
import torch

from torchrl_athletic.functional.streams import advance, integers, normal, stream, uniform

ROWS = torch.arange(100_000)


def correlation(*values):
    return torch.corrcoef(torch.stack([value.double() for value in values]))


@pytest.mark.parametrize("row", [0, 7, 4095])
def test_a_row_draws_alone_what_it_draws_among_thousands(row):
    rows, one = torch.arange(4099), torch.tensor([row])
    for draw in (lambda key: uniform(key, 3, -1.0, 2.0), lambda key: normal(key, 3), lambda key: integers(key, 3, 7)):
        assert torch.equal(draw(stream(1, rows, rows * 0 + 2))[row : row + 1], draw(stream(1, one, one * 0 + 2)))


def test_splitmix64_gives_its_published_number():
    """The first output of Vigna's splitmix64.c from the state 1234567."""
    assert advance(torch.tensor(1234567)).item() % (1 << 64) == 6457827717110365317


def test_uniform_numbers_are_uniform():
    unit = uniform(stream(0, ROWS), 2)
    assert ((unit >= 0) & (unit < 1)).all()
    counts = torch.histc(unit, bins=50, min=0, max=1)
    chi_square = ((counts - unit.numel() / 50) ** 2 / (unit.numel() / 50)).sum()
    assert chi_square < 85  # 49 degrees of freedom: passed once in a thousand
    assert uniform(stream(0, ROWS), 1, 2.0, 5.0).mean().item() == pytest.approx(3.5, abs=0.01)


def test_normal_numbers_are_normal():
    values = normal(stream(0, ROWS), 2).double()
    for power, moment in ((1, 0.0), (2, 1.0), (3, 0.0), (4, 3.0)):
        assert values.pow(power).mean().item() == pytest.approx(moment, abs=0.06)
    assert (values.abs() > 1.96).double().mean().item() == pytest.approx(0.05, abs=0.003)
    assert values.isfinite().all()


def test_integers_are_equally_likely_and_stay_in_bounds():
    counts = torch.bincount(integers(stream(0, ROWS), 1, 7).flatten())
    assert len(counts) == 7
    assert (counts - len(ROWS) / 7).abs().max() < 500


def test_rows_episodes_seeds_places_and_steps_of_a_stream_are_independent():
    key = stream(0, ROWS, ROWS * 0)
    draws = [
        *uniform(key, 2).unbind(-1),
        uniform(key, 1).roll(1, 0)[:, 0],
        uniform(stream(0, ROWS, ROWS * 0 + 1), 1)[:, 0],
        uniform(stream(1, ROWS, ROWS * 0), 1)[:, 0],
        uniform(advance(key), 1)[:, 0],
        uniform(stream(0, ROWS * 0, ROWS), 1)[:, 0],
    ]
    off_diagonal = correlation(*draws) - torch.eye(len(draws))
    assert off_diagonal.abs().max() < 0.02


def test_the_same_name_gives_the_same_stream_and_any_integer_is_a_seed():
    for seed in (0, -5, (1 << 70) + 3):
        assert torch.equal(stream(seed, ROWS[:5]), stream(seed, ROWS[:5]))
    assert not torch.equal(stream(-1, ROWS[:5]), stream(1, ROWS[:5]))
    assert len(stream(0, ROWS).unique()) == len(ROWS)
