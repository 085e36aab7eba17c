"""The split loss in a stock TorchRL script, on an environment that is not ours."""

import importlib.util
import sys
from pathlib import Path

import numpy as np
import pytest
import torch

RECIPE = Path(__file__).parents[2] / "recipes" / "ppo_split_loss.py"


@pytest.fixture(scope="module")
def recipe():
    pytest.importorskip("gymnasium")
    spec = importlib.util.spec_from_file_location("ppo_split_loss", RECIPE)
    module = importlib.util.module_from_spec(spec)
    sys.modules[spec.name] = module  # its dataclass looks there
    spec.loader.exec_module(module)
    return module


def test_it_runs_and_says_how_well_the_pendulum_swings(recipe, capsys):
    result = recipe.main(recipe.Config(num_envs=2, steps=8, updates=2))
    assert -16.3 * recipe.EPISODE < result < 0  # Pendulum's worst reward is -(π² + 0.1 · 8² + 0.001 · 2²)
    assert f"mean return of 2 episodes: {result:.0f}" in capsys.readouterr().out


def test_an_episode_that_is_cut_off_shows_its_true_last_observation(recipe):
    env = recipe.pendulums(recipe.Config(num_envs=2))
    episodes = env.rollout(recipe.EPISODE + 1, break_when_any_done=False)
    done = episodes["next", "done"][..., 0]
    assert done.nonzero()[:, 1].tolist() == [recipe.EPISODE - 1] * 2
    assert not episodes["next", "terminated"].any()
    state, action = (episodes[key][:, recipe.EPISODE - 1].double().numpy() for key in ("observation", "action"))
    cos, sin, speed = state.T
    speed = np.clip(speed + (15 * sin + 3 * action[:, 0].clip(-2, 2)) * 0.05, -8, 8)  # Pendulum's equation of motion
    angle = np.arctan2(sin, cos) + speed * 0.05
    shown = episodes["next", "observation"][:, recipe.EPISODE - 1]
    torch.testing.assert_close(shown[:, 0].double(), torch.from_numpy(np.cos(angle)), atol=1e-4, rtol=0)
    assert not shown.allclose(episodes["observation"][:, recipe.EPISODE])
