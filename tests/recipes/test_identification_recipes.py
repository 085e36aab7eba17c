"""The recipes of identification run end to end, small: a simulator for each method, a table and a figure of them."""

import importlib.util
import json
import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from torchrl_athletic.identification import CEM, ActuatorNetTraining, Simulator, open_loop
from torchrl_athletic.identification.cem import correction_of
from torchrl_athletic.recordings import Recording, write_recording
from torchrl_athletic.robots import z1

ROOT, ARM = Path(__file__).parents[2], z1()


def recipe(name):
    spec = importlib.util.spec_from_file_location(f"recipes_{name}", ROOT / "recipes" / f"{name}.py")
    module = importlib.util.module_from_spec(spec)
    sys.modules[spec.name] = module  # where dataclasses look for annotations
    spec.loader.exec_module(module)
    return module


identify, compare = recipe("identify"), recipe("compare_identification")


def take(kind: str, split: str, seed: int, samples: int = 241) -> Recording:
    """Take of an arm with twice the friction."""
    steps = 0.2 * np.random.default_rng(seed).standard_normal((samples // 40 + 1, 7))
    steps[0] = steps[:, 6] = 0.0
    target = np.array(ARM.default_pose) + np.repeat(steps, 40, axis=0)[:samples]
    kp, kd = np.array(ARM.kp), np.array(ARM.kd)
    blank = Recording(0.005 * np.arange(samples), ARM.joint_names, target, position_target=target, kp=kp, kd=kd)
    truth = correction_of(ARM.joint_names[:6], np.repeat([2.0, 1.0, 0.03], 6))
    [rollout] = open_loop(Simulator("truth", ARM, truth), [blank])
    position = np.tile(ARM.default_pose, (samples, 1))
    position[1:, :6] = rollout.position[0]
    velocity = np.gradient(position, 0.005, axis=0)
    return replace(
        blank,
        position=position,
        velocity=velocity,
        torque_measured=kp * (target - position) - kd * velocity,
        torque_semantics="current_derived",
        metadata={"kind": kind, "split": split},
    )


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    folder = tmp_path_factory.mktemp("recipes")
    (folder / "takes").mkdir()
    for k, (kind, split) in enumerate(
        [("square", "train"), ("gaussian", "train"), ("gaussian", "heldout"), ("throw", "heldout")]
    ):
        write_recording(take(kind, split, seed=k), folder / "takes" / f"{kind}_{split}.npz")
    return folder


def config(folder, method, **changes):
    small = {
        "cem": CEM(generations=4, population=4, windows=4, window=0.2),
        "actuator_net": ActuatorNetTraining(hidden=(8,), epochs=2),
    }
    return identify.Config(method, folder / "takes", folder / "found", **small, **changes)


def test_each_method_leaves_a_simulator_and_the_comparison_scores_those_that_can_be_replayed(folder, capsys):
    for method in ("default", "cem", "actuator_net", "dr", "roa"):
        identify.main(config(folder, method))
    identify.main(config(folder, "cem", seed=1))
    found = sorted(path.name for path in (folder / "found").iterdir())
    assert found == ["actuator_net_seed0", "cem_seed0", "cem_seed1", "default", "dr", "roa"]
    simulators = tuple(sorted((folder / "found").iterdir()))
    compare.main(compare.Config(folder / "takes", simulators, folder / "out", windows=(0.2,)))
    results = json.loads((folder / "out" / "comparison.json").read_text())
    assert {r["group"] for r in results} == {"square & sine", "Gaussian", "Gaussian, unseen", "throw, unseen"}
    assert {r["method"] for r in results} == {"default", "cem", "actuator_net"}
    assert "| CEM |" in (folder / "out" / "comparison.md").read_text()
    assert "<svg" in (folder / "out" / "comparison.svg").read_text()
    capsys.readouterr()


def test_each_seed_of_a_diagnosis_has_a_folder_of_its_own_with_its_report_in_it(folder, tmp_path, monkeypatch):
    asked = {}

    def diagnosed(robot, recordings, *, seed, output, **_):
        asked[seed] = sorted(take.metadata["split"] for take in recordings), output
        return Simulator("diagnosed", robot, notes={"seed": seed})

    monkeypatch.setattr(identify, "identify_diagnosed", diagnosed)
    for seed in (0, 1):
        identify.main(replace(config(folder, "diagnosed", seed=seed), output=tmp_path))
        own = tmp_path / f"diagnosed_seed{seed}"
        assert asked[seed] == (["train", "train"], own / "diagnosis")
        assert Simulator.load(own, ARM).notes["seed"] == seed


def test_two_folders_of_one_method_and_seed_are_refused_by_name(folder, tmp_path):
    for name in ("old", "new"):
        Simulator("cem", ARM, notes={"seed": 1}).save(tmp_path / name)
    with pytest.raises(SystemExit, match=r"old and .*new both hold seed 1 of 'cem'"):
        compare.main(compare.Config(folder / "takes", (tmp_path / "old", tmp_path / "new"), tmp_path))


def test_scores_are_kept_beside_a_simulator_until_it_or_the_question_changes(folder, monkeypatch):
    identify.main(config(folder, "default"))
    simulator, calls = folder / "found" / "default", []
    monkeypatch.setattr(compare, "compare", lambda *given: calls.append(given) or [])
    throw = take("throw", "heldout", 3)
    loaded = Simulator.load(simulator, ARM)
    stiffer = replace(loaded, correction=correction_of(ARM.joint_names[:6], np.repeat([1.0, 1.0, 0.03], 6)))
    moved = replace(throw, position=throw.position + 1e-6)
    asked = [
        (loaded, throw, (None, 0.3)),
        (loaded, throw, (None, 0.3)),
        (loaded, throw, (None, 0.2)),
        (stiffer, throw, (None, 0.2)),
        (stiffer, moved, (None, 0.2)),
        (stiffer, moved, (None, 0.2)),
    ]
    scored = []
    for which, throw, windows in asked:
        compare.scored(simulator, which, {"throw, unseen": [throw]}, windows)
        scored.append(len(calls))
    assert scored == [1, 1, 2, 3, 4, 4]


def test_without_recordings_or_simulators_it_says_which_recipe_comes_first(folder, tmp_path):
    with pytest.raises(SystemExit, match=r"recipes/identify\.py"):
        compare.main(compare.Config(folder / "takes", (tmp_path,), tmp_path))
    (tmp_path / "takes").mkdir()
    write_recording(take("throw", "heldout", 3), tmp_path / "takes" / "throw.npz")
    with pytest.raises(SystemExit, match=r"recipes/collect_recordings\.py"):
        identify.main(identify.Config("cem", tmp_path / "takes", tmp_path))
