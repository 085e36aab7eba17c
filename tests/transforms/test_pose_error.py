"""The way that is left to a commanded pose, as scipy finds it."""

import numpy as np
import pytest
import torch
from scipy.spatial.transform import Rotation
from tensordict import TensorDict

from torchrl_athletic.testing import TransformContract
from torchrl_athletic.transforms import PoseError

POSES = {"base_position": (3,), "base_quaternion": (4,), "hand": (3,), "hand_turn": (4,), "goal": (9,)}


class TestContract(TransformContract):
    env_settings = {"extra": POSES}  # noqa: RUF012

    def make_transform(self, key=str, first_row=0):
        keys = {"command_key": key("goal"), "pose_keys": (key("hand"), key("hand_turn")), "error_key": key("left")}
        return PoseError(0.5, base_keys=(key("base_position"), key("base_quaternion")), **keys)


@pytest.mark.parametrize("length", [0.3, 0.7])
def test_it_leads_from_the_hand_s_keypoints_to_the_goal_s_as_the_base_sees_them(length):
    """On ground of any height; the frame that a command is told in stands upright 0.4 m over it."""
    rng, rows = np.random.default_rng(0), 20
    base, hand, place = rng.normal(size=(3, rows, 3))
    height = rng.uniform(0.3, 0.7, rows)
    turn, hand_turn, goal_turn = (Rotation.random(rows, rng=rng) for _ in range(3))
    columns = goal_turn.as_matrix()[..., :2].swapaxes(1, 2).reshape(rows, 6)
    shown = {
        "base_position": base,
        "base_quaternion": turn.as_quat(scalar_first=True),
        "base_height": height[:, None],
        "end_effector_position": hand,
        "end_effector_quaternion": hand_turn.as_quat(scalar_first=True),
        "end_effector_command": np.concatenate((place, columns), -1),
    }
    step = TensorDict({key: torch.tensor(value).float() for key, value in shown.items()}, [rows])
    heading = Rotation.from_euler("z", turn.as_euler("ZYX")[:, :1])
    origin = np.stack((base[:, 0], base[:, 1], base[:, 2] - height + 0.4), -1)
    goal, goal_axes = origin + heading.apply(place), (heading * goal_turn).as_matrix()
    way = [goal - hand]
    way += [goal + length * goal_axes[..., k] - hand - length * hand_turn.as_matrix()[..., k] for k in range(3)]
    expected = np.stack([heading.inv().apply(part) for part in way], 1)
    np.testing.assert_allclose(PoseError(0.4, length)(step)["pose_error"], expected, atol=1e-5)
