"""What is drawn beside the robot lies where the numbers say."""

import math

import mujoco
import numpy as np
import pytest
import torch
from tensordict import TensorDict

from torchrl_athletic.envs.drawing import draw_ball, draw_command, draw_frame, draw_sled
from torchrl_athletic.functional import rotations
from torchrl_athletic.robots import z1


@pytest.fixture
def scene():
    return mujoco.MjvScene(z1().model(), maxgeom=10)


def ends(geom):
    """The middle of a connector, and where its z axis points."""
    return geom.pos, geom.mat.reshape(3, 3)[:, 2]


def test_the_axes_of_a_frame_are_red_green_and_blue(scene):
    origin, tips = np.array([1.0, 2.0, 3.0]), np.array([1.0, 2.0, 3.0]) + 0.2 * np.eye(3)
    draw_frame(scene, origin, tips)
    for axis, geom in enumerate(scene.geoms[:3]):
        np.testing.assert_allclose(geom.rgba[:3], np.eye(3)[axis])
        np.testing.assert_allclose(ends(geom)[1], np.eye(3)[axis], atol=1e-6)
        np.testing.assert_allclose(geom.pos, origin, atol=1e-6)
        np.testing.assert_allclose(geom.size, [0.008, 0.008, 0.2], atol=1e-6)  # thin, and as long as told


def test_a_command_is_drawn_in_its_frame_over_the_ground_below_a_robot_on_a_hill(scene):
    """The robot looks to the left; its command is 0.6 m ahead and 0.1 m over the frame."""
    step = TensorDict(
        base_position=torch.tensor([1.0, 2.0, 5.4]),
        base_height=torch.tensor([0.4]),
        base_quaternion=rotations.yaw_quaternion(torch.tensor([math.pi / 2])),
        end_effector_command=torch.tensor([0.6, 0.0, 0.1, 1.0, 0.0, 0.0, 0.0, 1.0, 0.0]),
    )
    draw_command(scene, step, frame_height=0.3)
    assert scene.ngeom == 3
    place, ahead = ends(scene.geoms[0])
    np.testing.assert_allclose(place, [1.0, 2.6, 5.0 + 0.3 + 0.1], atol=1e-5)
    np.testing.assert_allclose(ahead, [0.0, 1.0, 0.0], atol=1e-5)
    assert scene.geoms[0].size[2] == pytest.approx(0.15, rel=1e-3)


def test_a_ball_is_drawn_once_it_is_there(scene):
    draw_ball(scene, TensorDict(ball_position=torch.zeros(3)))
    assert scene.ngeom == 0
    draw_ball(scene, TensorDict(ball_position=torch.tensor([1.0, 0.0, 0.5])), radius=0.05)
    assert scene.ngeom == 1
    np.testing.assert_allclose(scene.geoms[0].pos, [1.0, 0.0, 0.5])
    np.testing.assert_allclose(scene.geoms[0].size, 0.05)
    red, green, blue, opacity = scene.geoms[0].rgba
    assert red > green > blue  # orange
    assert opacity == 1


def test_a_sled_stands_behind_its_hook_in_line_with_a_rope_that_is_red_while_it_pulls(scene):
    for tension in (0.0, 5.0):
        step = TensorDict(
            handle_position=torch.tensor([0.0, 0.0, 0.8]),
            sled_position=torch.tensor([1.2, 1.6]),
            rope_tension=torch.tensor([tension]),
        )
        draw_sled(scene, step, hook_height=0.2)
    box, slack, _, taut = scene.geoms[:4]
    np.testing.assert_allclose(box.pos, [1.2 + 0.4 * 0.6, 1.6 + 0.4 * 0.8, 0.12], atol=1e-6)
    np.testing.assert_allclose(box.mat.reshape(3, 3)[:, 0], [0.6, 0.8, 0.0], atol=1e-6)
    np.testing.assert_allclose(box.mat.reshape(3, 3)[:, 2], [0.0, 0.0, 1.0], atol=1e-6)
    np.testing.assert_allclose(box.size, [0.4, 0.3, 0.1])  # its front is at the hook
    assert box.size[0] == pytest.approx(np.hypot(*(box.pos[:2] - [1.2, 1.6])))
    rope = np.array([1.2, 1.6, 0.2 - 0.8])
    for geom in (slack, taut):
        assert geom.size[0] == pytest.approx(0.008)
        assert geom.size[2] == pytest.approx(np.linalg.norm(rope) / 2)  # from the hand to the hook
        np.testing.assert_allclose(geom.pos, [0.6, 0.8, 0.5], atol=1e-6)
    np.testing.assert_allclose(ends(slack)[1], rope / np.linalg.norm(rope), atol=1e-6)
    assert slack.rgba[0] == slack.rgba[1]
    assert taut.rgba[0] > 2 * taut.rgba[1]


def test_a_sled_straight_below_the_hand_is_drawn_all_the_same(scene):
    step = TensorDict(
        handle_position=torch.tensor([1.0, 2.0, 0.8]),
        sled_position=torch.tensor([1.0, 2.0]),
        rope_tension=torch.tensor([0.0]),
    )
    draw_sled(scene, step)
    for geom in scene.geoms[:2]:
        assert np.isfinite(geom.pos).all()
        assert np.isfinite(geom.mat).all()
