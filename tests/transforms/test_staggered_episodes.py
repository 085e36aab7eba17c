"""Robots that begin together do not end together."""

import pytest
import torch
from torchrl.envs import Compose, StepCounter, TransformedEnv
from torchrl.envs.utils import check_env_specs

from torchrl_athletic.testing import ToyEnv
from torchrl_athletic.transforms import StaggeredEpisodes


def make_env(num_envs=200, max_steps=50, **told):
    """A toy that lasts longer than the counter lets it."""
    counted = Compose(StepCounter(max_steps), StaggeredEpisodes(max_steps, **told))
    return TransformedEnv(ToyEnv(num_envs=num_envs, shortest=1000), counted)


def ages(**told):
    return make_env(**told).reset()["step_count"].flatten()


def test_specs_hold():
    check_env_specs(make_env(3))


def test_first_ages_are_even_over_an_episode():
    found = ages(num_envs=2000)
    assert found.min() == 0
    assert found.max() == 49
    assert found.bincount().min() > 0.3 * 2000 / 50
    assert found.float().mean().item() == pytest.approx(24.5, abs=1.0)


def test_only_the_first_episode_of_a_row_begins_old():
    env = make_env(num_envs=20, max_steps=8)
    steps = env.rollout(30, break_when_any_done=False)
    first, ends = steps["step_count"][:, 0].flatten(), steps["next", "truncated"].squeeze(-1)
    assert len(first.unique()) > 5
    assert torch.equal(ends.int().argmax(1), 7 - first)  # what is left of it
    assert all((row.nonzero().diff(dim=0) == 8).all() for row in ends)
    assert (env.reset()["step_count"] == 0).all()


def test_a_row_that_starts_alone_leaves_the_ages_of_the_others():
    env = make_env(num_envs=6)
    td = env.reset()
    before = td["step_count"].clone()
    again = env.reset(td.set("_reset", torch.tensor([[True], [False]] * 3)))["step_count"]
    assert (again[::2] == 0).all()
    assert torch.equal(again[1::2], before[1::2])


def test_ages_are_those_of_the_seed_and_of_the_row():
    whole = ages(seed=1)
    assert torch.equal(ages(seed=1), whole)
    assert torch.equal(ages(seed=1, num_envs=50, first_row=150), whole[150:])
    assert not torch.equal(ages(seed=2), whole)


def test_episodes_without_steps_are_refused():
    with pytest.raises(ValueError, match=r"max_steps is 0.*Give the length"):
        StaggeredEpisodes(0)
    assert ages(num_envs=9, max_steps=1).tolist() == [0] * 9
