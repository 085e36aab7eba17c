"""The recipe for reaching and its benchmark, run for a few iterations."""

import importlib.util
import sys
from dataclasses import replace
from pathlib import Path

import pytest
import torch

ROOT = Path(__file__).parents[2]


def script(folder, name="reach_z1"):
    """A script as a module; recipes and benchmarks share names."""
    spec = importlib.util.spec_from_file_location(f"{folder}_{name}", ROOT / folder / f"{name}.py")
    module = importlib.util.module_from_spec(spec)
    sys.modules[spec.name] = module  # where dataclasses look for annotations
    spec.loader.exec_module(module)
    return module


recipe, benchmark = script("recipes"), script("benchmarks")


def short(output, **changes):
    config = recipe.Config(
        iterations=3, held_out=4, hidden=(16,), evaluate_every=2, logger="csv", output=output, video=False
    )
    return replace(config, ppo=replace(config.ppo, num_envs=4, horizon=4), **changes)


def test_it_learns_measures_logs_and_leaves_a_policy(tmp_path, capsys):
    recipe.main(short(tmp_path))
    rows = benchmark.CSVTable(tmp_path / "progress.csv").rows
    assert [row["step"] for row in rows] == ["1", "2", "3"]
    assert [bool(row["error_cm"]) for row in rows] == [False, True, True]
    assert float(rows[-1]["samples"]) == 4 * 4 * 4  # one batch more, for the scale of observations
    assert "mean error" in capsys.readouterr().out
    policy = recipe.actor(47, 7, hidden=(16,), scale=0.6, normalizer=recipe.RunningNormalizer(47))
    recipe_networks = sys.modules["torchrl_athletic.networks"]
    assert recipe_networks.load_checkpoint(tmp_path / "policy.pt", policy=policy)["error_cm"] > 0


def test_the_gripper_stays_shut_and_zero_is_the_default_pose():
    robot = recipe.z1()
    poses = recipe.reachable_poses(robot, 2)
    env = recipe.make_env(robot, poses, 2, by_row=True)
    shown = env.reset()
    for _ in range(25):
        shown = env._step(shown.set("action", torch.zeros(2, 7)))
    default = torch.tensor(robot.default_pose)
    assert (shown["joint_position"] - default).abs().max() < 0.2  # it sags under its weight
    for _ in range(25):
        shown = env._step(shown.set("action", -torch.ones(2, 7)))
    moved = (shown["joint_position"] - default).abs()
    assert moved[:, 0].min() > 0.1  # the first joint turns freely
    assert moved[:, 6].max() < 0.03


def test_the_reward_is_greatest_at_the_goal():
    robot = recipe.z1()
    start = recipe.make_env(robot, recipe.reachable_poses(robot, 2), 2).reset()
    here = torch.cat((start["end_effector_position"], start["end_effector_quaternion"]), -1)[:1]
    gained = []
    for height in (0.0, 0.05, 0.3):
        env = recipe.make_env(robot, here + torch.tensor([0, 0, height, 0, 0, 0, 0]), 1)
        gained.append(env._step(env.reset().set("action", torch.zeros(1, 7)))["reward"].item())
    assert gained == sorted(gained, reverse=True)
    assert gained[0] > 3.0  # of 4


def curve(folder, minibatches, seed, errors):
    folder.mkdir()
    (folder / "run.json").write_text(f'{{"seed": {seed}, "minibatches": "{minibatches}", "threads": 2}}')
    table = benchmark.CSVTable(folder / "progress.csv")
    for step, error in enumerate(errors, start=1):
        table.log_metrics({"samples": 100 * step, "seconds": 60 * step}, step=2 * step - 1)
        names = ("error_cm", "median_cm", "share_below_3cm", "attitude_deg")
        measured = dict(zip(names, (error, error / 2, 0.5, 4.0), strict=True))
        table.log_metrics({"samples": 100 * step, "seconds": 60 * step} | measured, step=2 * step)
    return folder


def test_the_table_says_when_errors_were_reached(tmp_path):
    folders = (
        curve(tmp_path / "b", "joint", 0, [9.0, 4.0]),
        curve(tmp_path / "a", "split", 1, [5.0, 2.0, 0.5]),
        curve(tmp_path / "c", "split", 0, [5.0, 2.5]),
    )
    benchmark.main(benchmark.Config(output=tmp_path / "results", table=folders))
    lines = (tmp_path / "results" / "reach_z1.md").read_text().splitlines()
    assert [line.split("|")[1:3] for line in lines[2:]] == [
        [" split ", " 0 "],
        [" split ", " 1 "],
        [" joint ", " 0 "],
        [" split ", " mean of 2 "],
        [" joint ", " mean of 1 "],
    ]
    assert "| 0.50 cm | 0.25 cm | 50 % | 4.0° | 2.0 min | 3.0 min |" in lines[3]
    assert lines[4].endswith("| not reached | not reached |")
    assert "| 1.50 cm |" in lines[5]
    assert (tmp_path / "results" / "reach_z1.svg").read_text().startswith("<?xml")


def test_a_run_without_a_measurement_has_no_place_in_the_table(tmp_path):
    with pytest.raises(ValueError, match="no measurement yet"):
        benchmark.read(curve(tmp_path / "a", "split", 0, []))
