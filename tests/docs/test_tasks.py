"""The page of tasks: a task that is built from it learns, and Gymnasium makes what it says."""

import re
from pathlib import Path

import pytest
import torch

from torchrl_athletic import training
from torchrl_athletic.training import FINE_TUNE

PAGE = (Path(__file__).parents[2] / "docs" / "tasks.md").read_text(encoding="utf-8")


@pytest.fixture(scope="module")
def kick():
    """All that the page's code defines, but for what records a video."""
    scope = {}
    for block in re.findall(r"^```python\n(.*?)^```", PAGE, re.S | re.M):
        if "record_video" not in block and "fine_tune(" not in block:
            exec(compile(block, "tasks.md", "exec"), scope)
    return scope


def test_the_throw_that_the_page_records_is_one(monkeypatch):
    """The ball leaves in the throw, not while the arm is taken back."""
    recorded = []
    monkeypatch.setattr(
        training, "record_video", lambda env, policy, path, **told: recorded.append((env, policy, told))
    )
    block = next(code for code in re.findall(r"^```python\n(.*?)^```", PAGE, re.S | re.M) if "throw.mp4" in code)
    exec(compile(block, "tasks.md", "exec"), {})
    ((env, policy, told),) = recorded
    with torch.no_grad():
        steps = training.whole_rollout(env, policy, ["ball_away", "task_phase_index"], told["steps"])
    left = int(steps["ball_away"][0, :, 0].float().argmax())
    assert steps["ball_away"].any()
    assert steps["task_phase_index"][0, left].item() == 1
    assert not steps["terminated"].any()


def test_a_task_of_one_s_own_takes_less_than_a_hundred_lines():
    own = PAGE[PAGE.index("## A task of your own") :]
    assert sum(len(block.splitlines()) for block in re.findall(r"^```python\n(.*?)^```", own, re.S | re.M)) < 100


def test_the_kick_has_its_phases_and_rewards_the_foot_in_one_of_them(kick):
    steps = kick["kick_env"](2).rollout(85, lambda td: td.set("action", torch.zeros(2, 19)))
    phase = steps["task_phase_index"][0, :, 0].tolist()
    assert phase[:50] == [0] * 50
    assert phase[50:75] == [1] * 25
    foot = steps["next", "reward_terms", "foot"]
    assert foot[:, :50].abs().max() == 0
    assert foot[:, 50:75].abs().max() > 0
    assert steps["observation"].shape[-1] == 770
    thigh = steps["joint_reference"][0, :, 1]
    assert thigh[62].item() == pytest.approx(0.2, abs=0.02)


def test_the_kick_is_tuned_from_the_controller(kick):
    assert kick["learner"].samples == 8 * 8 * (FINE_TUNE.warm_up + 1)  # nothing is learnt from what comes first
    assert torch.isfinite(kick["report"]["reward"])


def test_the_kick_is_trained_as_the_recipes_train(kick, tmp_path):
    block = next(code for code in re.findall(r"^```python\n(.*?)^```", PAGE, re.S | re.M) if "fine_tune(" in code)
    small = "iterations=1, num_envs=2, episodes=1, video=False, ppo=replace(FINE_TUNE, horizon=4, warm_up=0)"
    code = block.replace("minutes=10.0", small).replace("outputs/kick", str(tmp_path))
    exec(compile(code.replace("steps=150", "steps=2"), "tasks.md", "exec"), dict(kick))
    assert {"kick.npz", "kick_critic.npz", "curves.png", "figures.json", "progress.csv"} <= {
        path.name for path in tmp_path.iterdir()
    }


def test_gymnasium_makes_the_sled(kick):
    assert kick["observation"].shape == (8, 770)
