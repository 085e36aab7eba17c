"""What a task's policy is examined in, and what is read off its episodes."""

import pytest
import torch
from tensordict import TensorDict

from benchmarks.task_figures import ELSEWHERE, conditions, slid


@pytest.mark.parametrize(("task", "figure"), [("snatch", "8 kg"), ("sled", "150 kg, 60 s")])
def test_the_figure_that_is_asked_for_is_played_elsewhere_too_with_the_same_mass(task, figure):
    played = dict(conditions(task))
    for name in ELSEWHERE:
        assert played[f"{figure}, {name}"] == played[figure] | played[name] != played[figure]


def test_a_foot_slides_only_while_it_is_pressed_to_the_ground_and_the_episode_lasts():
    force, velocity = torch.zeros(1, 3, 4), torch.zeros(1, 3, 4, 3)
    force[0, :, 0], velocity[..., :] = 100.0, torch.tensor([0.3, 0.4, 7.0])
    counts = torch.tensor([[[True], [True], [False]]])
    episodes = TensorDict(foot_force=force, foot_velocity=velocity, counts=counts, batch_size=[1, 3])
    assert slid(episodes) == pytest.approx(0.5 * 0.02 * 2 / 4)
