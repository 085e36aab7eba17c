"""Inner products that are kept are those of the columns, however many have come and whichever joint they touch."""

import numpy as np
import pytest
from scipy.optimize import lsq_linear

from torchrl_athletic.diagnosis.products import Library, Products, gains

STRETCH = np.repeat([0, 1, 2], [4, 7, 5])
ROWS, JOINTS = len(STRETCH), 2


@pytest.fixture(scope="module")
def grown():
    """Forty columns, more than there is room for at first: some of one joint, some of both. Shape (40, rows, J)."""
    rng = np.random.default_rng(0)
    products, whole = Products(JOINTS, STRETCH), np.zeros((40, ROWS, JOINTS))
    for k in range(40):
        joint = (-1, 0, 1)[k % 3]
        whole[k][:, slice(None) if joint < 0 else joint] = np.float32(rng.normal(size=(ROWS, JOINTS)))[
            :, slice(None) if joint < 0 else joint
        ]
        column = whole[k] if joint < 0 else whole[k][:, joint]
        assert products.add(column, joint) == k
    return products, whole


def test_products_are_of_each_stretch_and_joint(grown):
    products, whole = grown
    numbers = [37, 2, 0, 25, 39]
    gram = products.gram(numbers)
    assert gram.shape == (JOINTS, 3, 5, 5)
    for j in range(JOINTS):
        for s in range(3):
            part = whole[numbers][:, STRETCH == s, j]
            np.testing.assert_allclose(gram[j, s], part @ part.T, atol=1e-9)


def test_columns_come_back_in_their_order_and_none_where_they_are_zero(grown):
    products, whole = grown
    touching = [k for k in range(40) if k % 3 != 1]
    np.testing.assert_array_equal(products.touching(1), whole[touching][:, :, 1])
    np.testing.assert_array_equal(products.column(8, 1), whole[8][:, 1])
    assert products.column(8, 0) is None


def test_a_library_meets_columns_of_its_own_joint_alone(grown):
    products, whole = grown
    many = np.random.default_rng(1).normal(size=(7, ROWS))
    library = Library(many, 1)
    for number in (2, 3, 2, 1):  # of the second joint, of both, again, of the first
        expected = np.zeros(7) if number % 3 == 1 else many @ whole[number][:, 1]
        np.testing.assert_allclose(library.cross(products, number), expected)


@pytest.mark.parametrize("held", [0, 3])
def test_a_gain_is_what_least_squares_gains_where_no_bound_binds(held):
    rng = np.random.default_rng(2)
    unlike = np.array([1e-8, 1.0, 1e3])[:held]  # units
    a, groups, y = rng.normal(size=(50, held)) * unlike, rng.normal(size=(4, 50, 2)), rng.normal(size=50)
    start = np.linalg.lstsq(a, y)[0] if held else np.zeros(0)
    left = y - a @ start
    wide = np.full((4, 2), 1e6)
    told = gains(
        np.einsum("gri,grj->gij", groups, groups), np.einsum("gri,ra->gia", groups, a), a.T @ a,
        np.einsum("gri,r->gi", groups, left), -wide, wide, (np.full(held, -1e12), np.full(held, 1e12)),
    )  # fmt: skip
    for gain, group in zip(told, groups, strict=True):
        both = np.hstack([a, group])
        after = y - both @ np.linalg.lstsq(both, y)[0]
        assert gain == pytest.approx(left @ left - after @ after, rel=1e-6)


def test_what_a_bound_forbids_gains_nothing_and_what_stands_beside_it_may_not_make_room():
    column = np.random.default_rng(3).normal(size=(50, 1))
    beside, y = column + 0.1 * np.random.default_rng(4).normal(size=(50, 1)), column[:, 0]
    gram, cross = (column.T @ column)[None], (column.T @ beside)[None]
    right, none, one = (column.T @ y)[None], np.zeros((1, 1)), np.ones((1, 1))
    nothing = np.zeros((0, 0)), np.zeros((1, 1, 0)), (np.zeros(0), np.zeros(0))
    assert gains(gram, nothing[1], nothing[0], right, -one, none, nothing[2]) == 0
    half = gains(gram, nothing[1], nothing[0], right, none, 0.5 * one, nothing[2])
    assert half == pytest.approx(0.75 * y @ y)  # the residual is halved
    stuck = gains(gram, cross, beside.T @ beside, right, none, 0.5 * one, (np.zeros(1), np.zeros(1)))
    assert stuck == pytest.approx(half)


@pytest.mark.parametrize("sign", [1.0, -1.0])
@pytest.mark.parametrize("alike", [0.0, 0.9])
def test_each_of_two_columns_goes_as_far_as_its_own_bounds_let_it(sign, alike):
    """The two are a group that stands alone; however alike they are, all is as in bounded least squares."""
    rng = np.random.default_rng(6)
    first, second, rest = np.linalg.qr(rng.normal(size=(60, 3)))[0].T
    columns = np.stack([first, alike * first + np.sqrt(1 - alike**2) * second], -1)
    y = sign * (columns @ [2.0, 3.0]) + rest
    for reach in ((9.0, 0.5), (0.5, 9.0), (9.0, 9.0)):
        high = np.array([reach])
        told = gains(
            (columns.T @ columns)[None], np.zeros((1, 2, 0)), np.zeros((0, 0)), (y @ columns)[None], -high, high,
            (np.zeros(0), np.zeros(0)),
        )  # fmt: skip
        after = y - columns @ lsq_linear(columns, y, (-high[0], high[0])).x
        assert told == pytest.approx(y @ y - after @ after, rel=1e-3)


@pytest.mark.parametrize("sign", [1.0, -1.0])
def test_beside_a_group_the_active_columns_move_as_far_as_each_of_them_may(sign):
    """Whatever their units; a group that must have certain coefficients leaves the rest to bounded least squares."""
    rng = np.random.default_rng(5)
    group, y, unit = sign * rng.normal(size=(200, 2)), sign * rng.normal(size=200), np.array([1e-5, 1.0, 1e3])
    active = (rng.normal(size=(200, 3)) + 0.4 * group.sum(1, keepdims=True)) * unit
    left = y - active @ np.linalg.lstsq(active, y)[0]
    chosen = np.array([[2.0, -3.0]])
    rest = left - group @ chosen[0]
    reach = np.abs(np.linalg.lstsq(active, rest)[0]) * [0.5, 2.0, 0.25]  # the outer two are stopped short
    (told,) = gains(
        (group.T @ group)[None], (group.T @ active)[None], active.T @ active, (left @ group)[None], chosen, chosen,
        (-reach, reach),
    )  # fmt: skip
    move = lsq_linear(active / unit, rest, (-reach * unit, reach * unit)).x
    after = rest - (active / unit) @ move
    assert told == pytest.approx(left @ left - after @ after, rel=1e-6)
