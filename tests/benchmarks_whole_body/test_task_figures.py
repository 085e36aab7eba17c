"""What a task's policy is examined in, and what is read off its episodes."""

import json
from pathlib import Path

import pytest
import torch
from tensordict import TensorDict

from benchmarks.task_figures import ELSEWHERE, TASKS, Config, conditions, main, slid, untuned
from torchrl_athletic.networks import digest_of, pretrained

RESULTS = Path(__file__).parents[2] / "benchmarks" / "results"


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


@pytest.mark.parametrize("task", TASKS)
def test_the_committed_tables_are_of_the_policies_that_are_shipped(task):
    tuned, before = (json.loads((RESULTS / f"task_{task}{kind}.json").read_text()) for kind in ("", "_untuned"))
    assert tuned["policy"] == digest_of(pretrained(task))
    assert before["policy"] == digest_of(untuned(task))
    assert tuned["rows"].keys() == {name for name, _ in conditions(task)}


def test_figures_of_a_policy_of_ones_own_do_not_take_the_place_of_the_shipped_ones():
    with pytest.raises(SystemExit, match="holds the tables of the shipped policies"):
        main(Config(only=("throw",), policy="mine.npz"))
