"""A grid's surface against planes, which it must follow exactly, and its filters by hand."""

import pytest
import torch

from torchrl_athletic.functional.terrain import averaged, highest, surface_height


def test_a_slope_is_followed_exactly_between_the_heights():
    x, y = torch.linspace(-2, 2, 9), torch.linspace(-1, 1, 5)
    plane = 0.3 * x[None, :] - 0.2 * y[:, None] + 1.0
    place = torch.rand(200, 2) * torch.tensor([4.0, 2.0]) - torch.tensor([2.0, 1.0])
    torch.testing.assert_close(surface_height(plane, place, (2.0, 1.0)), 0.3 * place[:, 0] - 0.2 * place[:, 1] + 1.0)


def test_a_cell_is_folded_along_its_diagonal_from_least_to_greatest_corner():
    corner = torch.tensor([[0.0, 1.0], [0.0, 0.0]])  # only at greatest x and least y
    on_the_fold, beside, across = torch.tensor([[0.0, 0.0], [0.5, -0.5], [-0.5, 0.5]]).unbind()
    heights = [float(surface_height(corner, place, (1.0, 1.0))) for place in (on_the_fold, beside, across)]
    assert heights == pytest.approx([0.0, 0.5, 0.0])


def test_beyond_the_edge_the_edge_goes_on():
    heights = torch.tensor([[0.0, 1.0], [0.0, 1.0]])
    assert surface_height(heights, torch.tensor([[9.0, 0.0], [-9.0, 0.0]]), (1.0, 1.0)).tolist() == [1.0, 0.0]


def test_the_mean_keeps_a_slope_and_the_highest_covers_every_height_near():
    heights = torch.rand(20, 30)
    slope = torch.arange(30.0).expand(20, 30)
    torch.testing.assert_close(averaged(slope, 2, 3)[:, 3:-3], slope[:, 3:-3])
    high = highest(heights, 1, 1)
    for row in (-1, 0, 1):
        for column in (-1, 0, 1):
            near = heights.roll((row, column), (0, 1))[1:-1, 1:-1]
            assert (high[1:-1, 1:-1] >= near).all()


@pytest.mark.parametrize(("rows", "columns"), [(0, 2), (2, 0), (1, 3)])
def test_filters_look_as_far_along_each_axis_as_they_are_told(rows, columns):
    heights = torch.rand(9, 12)
    for found, of in ((averaged(heights, rows, columns), torch.mean), (highest(heights, rows, columns), torch.amax)):
        for r in range(9):
            for c in range(12):
                near = heights[max(r - rows, 0) : r + rows + 1, max(c - columns, 0) : c + columns + 1]
                torch.testing.assert_close(found[r, c], of(near))
