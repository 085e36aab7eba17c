import mujoco
import numpy as np
import pytest
import torch
from scipy.spatial.transform import Rotation

from torchrl_athletic.functional import rotations

GENERATOR = torch.Generator().manual_seed(0)
Q, P = (torch.nn.functional.normalize(torch.randn(200, 4, generator=GENERATOR).double(), dim=-1) for _ in range(2))
V = torch.randn(200, 3, generator=GENERATOR).double()


def of_scipy(quaternion):
    return Rotation.from_quat(quaternion.numpy(), scalar_first=True)


def test_a_product_is_mujocos():
    expected = np.zeros((200, 4))
    for row in range(200):
        mujoco.mju_mulQuat(expected[row], Q[row].numpy(), P[row].numpy())
    np.testing.assert_allclose(rotations.multiply(Q, P), expected, atol=1e-12)


def test_turning_a_vector_is_mujocos_and_turning_it_back_undoes_it():
    expected = np.zeros((200, 3))
    for row in range(200):
        mujoco.mju_rotVecQuat(expected[row], V[row].numpy(), Q[row].numpy())
    there = rotations.rotate(Q, V)
    np.testing.assert_allclose(there, expected, atol=1e-12)
    torch.testing.assert_close(rotations.rotate_inverse(Q, there), V)


def test_a_matrix_is_scipys_and_its_columns_are_the_bodys_axes():
    matrix = rotations.matrix(Q)
    np.testing.assert_allclose(matrix, of_scipy(Q).as_matrix(), atol=1e-12)
    torch.testing.assert_close(rotations.rotate(Q, V), (matrix @ V.unsqueeze(-1)).squeeze(-1))


def test_gravity_in_the_body_is_the_worlds_down_turned_back():
    down = torch.tensor([0.0, 0.0, -1.0], dtype=torch.float64).expand(200, 3)
    torch.testing.assert_close(rotations.projected_gravity(Q), rotations.rotate_inverse(Q, down))
    heading = rotations.yaw_quaternion(V[:, :1])
    torch.testing.assert_close(
        rotations.projected_gravity(rotations.multiply(heading, Q)), rotations.projected_gravity(Q)
    )


def test_yaw_is_where_the_nose_points_seen_from_above():
    np.testing.assert_allclose(rotations.yaw(Q)[:, 0], of_scipy(Q).as_euler("ZYX")[:, 0], atol=1e-9)
    nose = rotations.matrix(Q)[..., 0]
    torch.testing.assert_close(rotations.yaw(Q)[:, 0], torch.atan2(nose[:, 1], nose[:, 0]))
    torch.testing.assert_close(rotations.yaw(rotations.yaw_quaternion(V[:, :1])), V[:, :1])


def test_the_heading_of_a_row_does_not_depend_on_the_batch():
    single = Q.float()
    alone = torch.cat([rotations.yaw(row) for row in single.split(1)])
    assert torch.equal(alone, rotations.yaw(single))


def test_two_columns_hold_the_whole_attitude():
    columns = rotations.two_columns(Q)
    torch.testing.assert_close(columns[:, :3], rotations.matrix(Q)[..., 0])
    torch.testing.assert_close(columns[:, 3:], rotations.matrix(Q)[..., 1])
    torch.testing.assert_close(rotations.from_two_columns(columns), rotations.matrix(Q))


def test_any_two_columns_make_a_rotation_whose_first_axis_they_keep():
    columns = torch.randn(200, 6, generator=GENERATOR).double()
    matrix = rotations.from_two_columns(columns)
    eye = torch.eye(3, dtype=torch.float64).expand(200, 3, 3)
    torch.testing.assert_close(matrix.mT @ matrix, eye)
    torch.testing.assert_close(torch.linalg.det(matrix), torch.ones(200, dtype=torch.float64))
    torch.testing.assert_close(matrix[..., 0], torch.nn.functional.normalize(columns[:, :3], dim=-1))
    assert ((matrix[..., 1] * columns[:, 3:]).sum(-1) > 0).all()


def test_keypoints_are_the_origin_and_a_point_on_each_axis():
    points = rotations.keypoints(V, rotations.matrix(Q), length=0.3)
    torch.testing.assert_close(points[:, 0], V)
    for axis in range(3):
        unit = torch.eye(3, dtype=torch.float64)[axis].expand(200, 3)
        torch.testing.assert_close(points[:, axis + 1], V + 0.3 * rotations.rotate(Q, unit))


@pytest.mark.parametrize("quaternion", [Q, P])
def test_a_quaternion_and_its_negative_are_one_attitude(quaternion):
    for function in (rotations.matrix, rotations.projected_gravity, rotations.yaw, rotations.two_columns):
        torch.testing.assert_close(function(-quaternion), function(quaternion))
