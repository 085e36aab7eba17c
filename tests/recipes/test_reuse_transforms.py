"""Our transforms on environments that are not ours."""

import importlib.util
import re
import sys
from pathlib import Path

import pytest
import torch
from torchrl.envs import ParallelEnv, SerialEnv

ROOT = Path(__file__).parents[2]
RECIPE = ROOT / "recipes" / "reuse_transforms.py"


@pytest.fixture(scope="module")
def recipe():
    pytest.importorskip("gymnasium")
    spec = importlib.util.spec_from_file_location("reuse_transforms", RECIPE)
    module = importlib.util.module_from_spec(spec)
    sys.modules[spec.name] = module  # where a process of ParallelEnv looks for what it is sent
    spec.loader.exec_module(module)
    yield module
    del sys.modules[spec.name]


@pytest.fixture(scope="module")
def rollouts(recipe):
    return recipe.main(recipe.Config(pendulums=4, steps=16))


def test_it_says_what_the_policy_sees(recipe, capsys):
    recipe.main(recipe.Config(pendulums=2, steps=3))
    shown = capsys.readouterr().out
    assert "the policy sees 12 of history + 3 of the phase" in shown
    assert "the policy sees 44 of history + 3 of the phase" in shown


def test_the_history_holds_the_last_four_observations(rollouts):
    for rollout in rollouts.values():
        for time in range(3, rollout.shape[-1]):
            recent = rollout["observation"][..., time - 3 : time + 1, :]
            since_start = rollout["next", "done"][..., time - 3 : time, :].any(-2)  # an episode began in between
            same = recent.flatten(-2) == rollout["observation_history"][..., time, :]
            assert (same.all(-1, keepdim=True) | since_start).all()


def test_pendulums_get_the_torque_that_was_asked_for_so_many_steps_ago(recipe, rollouts):
    rollout = rollouts["4 of them"]
    delay = rollout["action_delay"][:, 0, 0]
    assert len(set(delay.tolist())) > 1
    for row, late in zip(rollout.unbind(0), delay.tolist(), strict=True):
        acted = torch.cat((torch.zeros(late, 1), row["action"]))[: len(row)]
        _, sin, rate = row["observation"].double().unbind(-1)
        weak = 2 * (1 - rate.abs() / 8).clamp(min=0)  # in the direction of motion; the other way there is no loss
        low, high = torch.where(rate < 0, -weak, -2.0), torch.where(rate > 0, weak, 2.0)
        torque = acted[:, 0].double().clamp(low, high)
        expected = (rate + (15 * sin + 3 * torque) * 0.05).clamp(-8, 8)  # Pendulum's equation of motion
        torch.testing.assert_close(row["next", "observation"][:, 2].double(), expected, atol=1e-4, rtol=0)


def test_the_phase_goes_by_each_episodes_own_time(rollouts):
    phase = rollouts["Gymnasium's pendulum"]["task_phase"]
    assert phase[3].tolist() == [1, 0, 0]  # 0.15 s of 0.2 s
    assert phase[4].tolist() == [0, 1, 0]
    torch.testing.assert_close(phase[9], torch.tensor([0.0, 1.0, 0.5]))  # 0.25 s of the timer's 0.5 s


@pytest.mark.parametrize("batch", [SerialEnv, ParallelEnv])
def test_transforms_inside_of_workers_do_what_those_around_them_do(recipe, batch):
    keys = ["observation", "action_delay", "policy_input"]
    kind = {} if batch is SerialEnv else {"mp_start_method": "fork"}
    rows = [make_row(recipe, number) for number in range(2)]
    inside = batch(2, rows, **kind)
    outside = recipe.pendulum(SerialEnv(2, lambda: recipe.GymEnv("Pendulum-v1")), seed=5)
    found = []
    for env in (inside, outside):
        env.set_seed(0)
        torch.manual_seed(0)
        found.append(env.rollout(6).select(*keys))
        env.close()
    for key in keys:
        assert torch.equal(found[0][key], found[1][key]), key


def make_row(recipe, number):
    return lambda: recipe.pendulum(recipe.GymEnv("Pendulum-v1"), seed=5, first_row=number)


def test_the_page_prints_what_it_says(recipe, capsys):
    page = (ROOT / "docs" / "reuse.md").read_text(encoding="utf-8")
    scope: dict[str, object] = {}
    for code, printed in re.findall(r"^```python\n(.*?)^```\s*^```text\n(.*?)^```", page, re.S | re.M):
        exec(compile(code, "docs/reuse.md", "exec"), scope)
        assert capsys.readouterr().out.endswith(printed)
