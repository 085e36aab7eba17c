"""The recipe for pre-training, run for a few iterations in each of its ways."""

import os
import subprocess
import sys
from dataclasses import replace
from pathlib import Path

import pytest
import torch
from recipes.test_commands import load

from torchrl_athletic.functional.commands import command_ranges
from torchrl_athletic.identification import Simulator
from torchrl_athletic.networks import read_metadata, read_network, uan
from torchrl_athletic.robots import z1
from torchrl_athletic.training import PRE_TRAIN, CSVTable
from torchrl_athletic.transforms import CommandSampler, CorrectedActuation, InitialState, UANCorrection

ROOT = Path(__file__).parents[2]
recipe = load("recipes/pretrain_wbc.py")
FLAGS = ["--iterations", "3", "--hidden", "16", "--num-envs", "8", "--ppo.horizon", "4", "--no-video"]
FEW = replace(PRE_TRAIN, horizon=3)


def short(output, **changes):
    return recipe.Config(iterations=2, hidden=(16,), num_envs=4, ppo=FEW, output=output, **({"video": False} | changes))


def parts_of(cfg):
    return {type(part): part for part in recipe.make_env(cfg, 2).transform}


def test_it_learns_logs_and_leaves_a_controller_curves_and_a_video(tmp_path, capsys, monkeypatch):
    drawn = []
    monkeypatch.setattr(recipe.training, "record_video", lambda env, policy, path, **_: drawn.append(path) or path)
    recipe.main(short(tmp_path, video=True))
    rows = CSVTable(tmp_path / "progress.csv").rows
    assert [row["step"] for row in rows] == ["1", "2"]
    assert float(rows[-1]["samples"]) == 3 * 4 * 3  # a batch more, for the scale of observations
    assert 0 < float(rows[-1]["tracking/position"]) < 2
    policy = read_network(tmp_path / "wbc.npz")
    assert policy(recipe.make_env(short(tmp_path), 2).reset())["action"].shape == (2, 19)
    assert (tmp_path / "curves.png").stat().st_size > 1000
    assert drawn == [tmp_path / "wbc.mp4"]
    told = read_metadata(tmp_path / "wbc.npz")
    assert (told["history"], told["commands"], told["actuation"]) == (10, "box", "uan")
    assert "policy:" in capsys.readouterr().out


def test_the_same_command_goes_on(tmp_path):
    for name, iterations in (("parts", 1), ("parts", 2), ("whole", 2)):
        recipe.main(replace(short(tmp_path / name), iterations=iterations))
    parts, whole = (read_network(tmp_path / name / "wbc.npz").state_dict() for name in ("parts", "whole"))
    for name, value in whole.items():
        assert torch.equal(parts[name], value), name


def test_the_arm_is_driven_as_it_is_told(tmp_path):
    assert UANCorrection in parts_of(short(tmp_path))
    assert UANCorrection not in parts_of(short(tmp_path, actuation="ideal"))
    found = {"schema": "torchrl_athletic/corrected/1", "joint_names": list(z1().joint_names), "trims": []}
    late = {"effect": "actuation_delay", "joint": "joint2", "parameters": {"delay": {"value": 0.012}}}
    heavy = {"effect": "reflected_inertia", "joint": "joint2", "parameters": {"armature": {"value": 0.1}}}
    for name, net in (("diagnosed", None), ("diagnosed_uan", uan())):
        kind = "none" if net is None else "correction"
        Simulator(name, z1(), found | {"effects": [late, heavy]}, net, kind).save(tmp_path / name)
        env = recipe.make_env(short(tmp_path, actuation=str(tmp_path / name)), 2)
        kinds = {type(part) for part in env.transform}
        assert CorrectedActuation in kinds
        assert (UANCorrection in kinds) == (net is not None)
        model = env.base_env.physics.model
        dof = model.joint("joint2").dofadr[0]
        assert model.dof_armature[dof] == pytest.approx(0.1)
        assert env.rollout(2)["observation"].isfinite().all()


def test_ablations_leave_out_what_they_say(tmp_path):
    env = recipe.make_env(short(tmp_path, without=("gait", "foot_clearance"), history=1), 2)
    shown = env.reset()
    assert shown["observation"].shape == (2, 77)
    assert "gait" not in shown["reward_terms"].keys()
    nominal = parts_of(short(tmp_path, randomize=False))
    assert InitialState not in nominal
    assert CommandSampler in nominal


@pytest.mark.parametrize(
    ("start", "given", "first"), [(None, 1e-3, 1e-3), ("wbc", 1e-3, 1e-5), ("wbc", 2e-4, 2e-4), (None, 2e-4, 2e-4)]
)
def test_a_controller_goes_on_by_small_steps_unless_told_otherwise(tmp_path, monkeypatch, start, given, first):
    rates = []

    def stop(env, ppo, **told):
        rates.append(ppo.actor_lr)
        raise KeyboardInterrupt

    monkeypatch.setattr(recipe.training, "wbc_learner", stop)
    monkeypatch.setattr(recipe, "make_env", lambda *args, **told: None)
    with pytest.raises(KeyboardInterrupt):
        recipe.main(replace(short(tmp_path, start=start), ppo=replace(FEW, actor_lr=given)))
    assert rates == [first]


@pytest.mark.parametrize(
    ("device", "minutes", "iterations", "ppo", "schedule"),
    [
        ("cpu", None, 2, FEW, (0.01, None, 0)),
        ("cuda", None, None, FEW, (0.02, 0.006, 3800)),
        ("cuda", 60.0, None, FEW, (0.02, 0.006, 3800)),  # a slower GPU goes on with the same run
        ("cuda", 5.0, 7, FEW, (0.02, 0.006, 7)),
        ("cuda", None, 0, FEW, (0.01, None, 0)),
        ("cuda", None, 7, replace(FEW, kl_target=0.005), (0.005, None, 0)),
    ],
)
def test_on_a_gpu_the_divergence_falls_until_the_last_iteration(
    tmp_path, monkeypatch, device, minutes, iterations, ppo, schedule
):
    seen = []

    def stop(learner, **told):
        seen.append(told["iterations"])
        raise KeyboardInterrupt

    alone = recipe.training.join_processes("cpu")
    monkeypatch.setattr(recipe.training, "join_processes", lambda device: alone)
    told = lambda env, ppo, **told: seen.append((ppo.kl_target, ppo.kl_target_last, ppo.anneal))  # noqa: E731
    monkeypatch.setattr(recipe.training, "wbc_learner", told)
    monkeypatch.setattr(recipe.training, "train", stop)
    monkeypatch.setattr(recipe, "make_env", lambda *args, **told: None)
    with pytest.raises(KeyboardInterrupt):
        recipe.main(replace(short(tmp_path), device=device, minutes=minutes, iterations=iterations, ppo=ppo))
    assert seen == [schedule, 3800 if device == "cuda" and iterations is None else iterations]


def test_goals_are_those_of_the_controller_that_it_goes_on_from(tmp_path):
    for start, commands in {None: "box", "wbc": "box", "wbc_wide": "around"}.items():
        assert parts_of(short(tmp_path, start=start))[CommandSampler].ranges == command_ranges(commands)
    assert parts_of(short(tmp_path, commands="ahead"))[CommandSampler].ranges == command_ranges("ahead")


@pytest.mark.parametrize(
    ("changes", "told"),
    [
        ({"seed": 1}, r"whose seed is '0'; here it is '1'"),
        ({"without": ("gait",)}, r"whose without is '\(\)'"),
        ({"actuation": "ideal"}, r"whose actuation is 'uan'; here it is 'ideal'"),
        ({"randomize": True}, r"whose randomize is 'False'"),
        ({"history": 2}, r"whose history is '1'"),
        ({"ppo": replace(FEW, discount=0.5)}, r"whose ppo is .*discount=0\.99.* here it is .*discount=0\.5"),
        ({"num_envs": 6}, r"whose ppo is .*num_envs=4.* here it is .*num_envs=6"),
        ({"minibatches": "joint"}, r"whose ppo is .*critic_minibatches=1"),
        ({"hidden": (8,)}, r"whose hidden is '\(16,\)'"),
        ({"start": "wbc"}, r"whose ppo is .*actor_lr=0\.001.* here it is .*actor_lr=1e-05"),
        ({"collectors": "ray"}, r"whose collectors is 'here'"),
    ],
    ids=lambda value: next(iter(value)) if isinstance(value, dict) else "",
)
def test_a_folder_of_another_run_is_refused_and_left_as_it_was(of_a_run, changes, told, monkeypatch):
    """The learner itself is another's: what is asked here is only whether the folder is taken."""
    folder, learner = of_a_run
    before = {path: path.stat().st_mtime_ns for path in folder.rglob("*")}
    monkeypatch.setattr(recipe.training, "wbc_learner", lambda *args, **told: learner)
    monkeypatch.setattr(recipe, "make_env", lambda *args, **told: None)
    with pytest.raises(ValueError, match=told + r"(?s:.*)a folder of its own"):
        recipe.main(replace(nominal(folder), **changes))
    assert {path: path.stat().st_mtime_ns for path in folder.rglob("*")} == before


@pytest.fixture(scope="module")
def of_a_run(tmp_path_factory):
    """A folder in which a run stands at its first iteration, and its learner."""
    folder, kept = tmp_path_factory.mktemp("run"), []
    original = recipe.training.wbc_learner
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(recipe.training, "wbc_learner", lambda *a, **k: kept.append(original(*a, **k)) or kept[0])
        recipe.main(nominal(folder))
    return folder, kept[0]


def nominal(folder):
    return replace(short(folder, history=1, randomize=False), iterations=1)


@pytest.mark.slow
def test_two_processes_train_one_controller(tmp_path):
    command = [sys.executable, "-m", "torch.distributed.run", "--standalone", "--nproc-per-node", "2"]
    command += ["recipes/pretrain_wbc.py", *FLAGS, "--output", str(tmp_path)]
    subprocess.run(command, cwd=ROOT, env=os.environ | {"OMP_NUM_THREADS": "1"}, check=True)
    rows = CSVTable(tmp_path / "progress.csv").rows
    assert [row["step"] for row in rows] == ["1", "2", "3"]
    assert float(rows[-1]["samples"]) == 4 * 8 * 4
    assert (tmp_path / "wbc.npz").exists()


@pytest.mark.slow
def test_robots_on_ray_s_workers_train_a_controller(tmp_path):
    pytest.importorskip("ray")
    command = [sys.executable, "recipes/pretrain_wbc.py", "--collectors", "ray", *FLAGS, "--output", str(tmp_path)]
    subprocess.run(command, cwd=ROOT, env=os.environ | {"OMP_NUM_THREADS": "1"}, check=True)
    rows = CSVTable(tmp_path / "progress.csv").rows
    assert float(rows[-1]["samples"]) == 4 * 8 * 4
