"""The recipe for throwing, run for a few iterations."""

import importlib.util
import sys
from dataclasses import replace
from pathlib import Path

import pytest
import torch

from torchrl_athletic.identification import Simulator
from torchrl_athletic.networks import load_checkpoint, uan
from torchrl_athletic.transforms import RandomizationRanges

ROOT = Path(__file__).parents[2]


SPEC = importlib.util.spec_from_file_location("recipes_throw_arm_under_test", ROOT / "recipes" / "throw_arm.py")
recipe = importlib.util.module_from_spec(SPEC)
sys.modules[SPEC.name] = recipe  # where dataclasses look for annotations
SPEC.loader.exec_module(recipe)


def short(output, **changes):
    config = recipe.Config(iterations=2, hidden=(16,), evaluate_every=2, output=output)
    return replace(config, ppo=replace(config.ppo, num_envs=4, horizon=4), **changes)


@pytest.fixture
def briefly(monkeypatch):
    """Examinations end before the ball is thrown: how far it goes is not asked."""
    play = recipe.play
    monkeypatch.setattr(recipe, "play", lambda env, policy, steps: play(env, policy, 3))


@pytest.fixture(scope="module")
def trained(tmp_path_factory):
    """A folder with a policy that has hardly learnt anything."""
    folder = tmp_path_factory.mktemp("throw")
    recipe.main(short(folder))
    return folder


def test_it_learns_measures_and_leaves_a_policy(trained, capsys):
    recipe.main(short(trained))  # goes on where it ended
    assert "% of throws failed" in capsys.readouterr().out
    metadata = torch.load(trained / "policy.pt", weights_only=True)["metadata"]
    assert metadata["distance_m"] == pytest.approx(1.26, abs=0.1)  # that of the reference, where it begins
    assert metadata["sizes"] == {"seen": 340, "joints": 6, "adapts_to": 0, "hidden": [16]}
    assert (metadata["iterations"], metadata["samples"]) == (2, 2 * 4 * 4)
    policy = recipe.make_policy(**metadata["sizes"])
    load_checkpoint(trained / "policy.pt", policy=policy)
    assert sum(p.numel() for p in policy.parameters()) == 340 * 16 + 16 + 16 * 6 + 6 + 6


@pytest.mark.slow
def test_the_policy_that_threw_farthest_is_kept(tmp_path, monkeypatch):
    distances = iter((1.0, 3.0, 2.0))
    summary = lambda step: {"distance_m": next(distances), "spread_m": 0.0, "failed": 0.0}  # noqa: E731
    monkeypatch.setattr(recipe, "throw_summary", summary)
    recipe.main(short(tmp_path, iterations=3, evaluate_every=1))
    metadata = torch.load(tmp_path / "policy.pt", weights_only=True)["metadata"]
    assert (metadata["iterations"], metadata["distance_m"]) == (2, 3.0)
    others = [torch.load(path, weights_only=True) for path in sorted((tmp_path / "examined").iterdir())]
    assert [other["metadata"]["distance_m"] for other in others] == [1.0, 3.0, 2.0]
    assert [list(other["state"]) for other in others] == [["policy"]] * 3  # small: critics are not needed to throw


def test_what_was_learnt_elsewhere_is_where_it_begins(trained, briefly, tmp_path):
    recipe.main(short(tmp_path / "again", begin_with=trained / "policy.pt", minutes=0.0, iterations=None))
    states = [torch.load(folder / "policy.pt", weights_only=True)["state"] for folder in (trained, tmp_path / "again")]
    for name in ("policy", "critic"):
        for key, value in states[0][name].items():
            torch.testing.assert_close(states[1][name][key], value, atol=0, rtol=0)


def test_a_policy_that_adapts_throws_without_being_told_of_its_arm(briefly, tmp_path):
    ranges = RandomizationRanges(friction=None, restitution=None)
    simulator = Simulator("roa", recipe.z1(), randomization=ranges).save(tmp_path / "roa")
    recipe.main(short(tmp_path / "roa-0", simulator=simulator))
    sizes = torch.load(tmp_path / "roa-0" / "policy.pt", weights_only=True)["metadata"]["sizes"]
    assert sizes["adapts_to"] > 20  # gains, limits, masses
    env = recipe.make_env(recipe.load_simulator(simulator), 2, randomize=False, ends=False)
    policy = recipe.make_policy(**sizes)
    load_checkpoint(tmp_path / "roa-0" / "policy.pt", policy=policy)
    assert recipe.deployed(policy, sizes["adapts_to"])(env.reset())["action"].shape == (2, 6)


def test_random_arms_are_drawn_for_training_alone():
    simulator = Simulator(
        "dr", recipe.load_simulator(None).robot, randomization=RandomizationRanges(friction=None, restitution=None)
    )
    masses = [
        recipe.make_env(simulator, 2, randomize=randomize).reset().get("randomization", None)
        for randomize in (True, False)
    ]
    assert masses[0].abs().max() > 0
    assert masses[1] is None


def test_a_policy_is_examined_with_another_copy_of_the_net_than_it_is_trained_with(briefly, tmp_path, monkeypatch):
    """One that both shared would leave the GPU when the examination takes it to the CPU."""
    simulator = Simulator("uan", recipe.load_simulator(None).robot, net=uan(), kind="correction").save(tmp_path / "uan")
    make, nets = recipe.make_env, []

    def noted(simulator, *sizes, **task):
        nets.append(simulator.net)
        return make(simulator, *sizes, **task)

    monkeypatch.setattr(recipe, "make_env", noted)
    recipe.main(short(tmp_path / "uan-0", simulator=simulator))
    assert len(nets) == 2
    assert nets[0] is not nets[1]
