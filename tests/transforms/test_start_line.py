"""Where an episode began stays known until the next one begins."""

import torch
from torchrl.envs import TransformedEnv

from torchrl_athletic.functional.rotations import yaw
from torchrl_athletic.testing import ToyEnv, TransformContract
from torchrl_athletic.transforms import StartLine


class TestContract(TransformContract):
    env_settings = {"extra": {"base_position": (3,), "base_quaternion": (4,)}}  # noqa: RUF012

    def make_transform(self, key=str, first_row=0):
        keys = (key("base_position"), key("base_quaternion"))
        return StartLine(base_keys=keys, line_key=key("start_line"))


def test_it_is_the_place_and_the_heading_of_the_first_step():
    toy = ToyEnv(3, shortest=3, extra={"base_position": (3,), "base_quaternion": (4,)})
    steps = TransformedEnv(toy, StartLine()).rollout(12, break_when_any_done=False)
    begins = torch.cat((torch.ones(3, 1, 1, dtype=torch.bool), steps["next", "done"][:, :-1]), 1).squeeze(-1)
    here = torch.cat((steps["base_position"][..., :2], yaw(steps["base_quaternion"])), -1)
    line = here[:, 0]
    for time in range(12):
        line = torch.where(begins[:, time, None], here[:, time], line)
        torch.testing.assert_close(steps["start_line"][:, time], line)
    assert begins.sum() > 6
