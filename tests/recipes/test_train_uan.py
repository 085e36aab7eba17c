"""The recipe that trains a UAN, and the benchmark of its methods, on a toy and for a few iterations."""

import importlib.util
import json
import sys
from dataclasses import replace
from pathlib import Path

import pytest
import torch
from identification.arms import XML, commands, recorded, robot

from torchrl_athletic.identification import Simulator
from torchrl_athletic.identification.comparison import NAMES
from torchrl_athletic.networks import Sizes, sizes_of
from torchrl_athletic.recordings import write_recording
from torchrl_athletic.training import CSVTable

ROOT = Path(__file__).parents[2]


def script(folder, name):
    """A script as a module; recipes and benchmarks share names."""
    spec = importlib.util.spec_from_file_location(f"{folder}_{name}", ROOT / folder / f"{name}.py")
    module = importlib.util.module_from_spec(spec)
    sys.modules[spec.name] = module  # where dataclasses look for annotations
    spec.loader.exec_module(module)
    return module


recipe, benchmark = script("recipes", "train_uan"), script("benchmarks", "uan_training")


@pytest.fixture(scope="module")
def inputs(tmp_path_factory):
    """A robot's description, and its takes: of one with more friction, the second of them held out."""
    folder = tmp_path_factory.mktemp("inputs")
    (folder / "arm.xml").write_text(XML)
    real = Simulator("real", replace(robot(), build=lambda: _stiff(robot().spec())))
    for seed, split in enumerate(("train", "heldout")):
        take = replace(recorded(real, commands(600, seed=seed)), metadata={"split": split})
        write_recording(take, folder / f"take{seed}.npz")
    return folder


def _stiff(spec):
    for joint in spec.joints:
        joint.damping[0] *= 4.0
    return spec


def short(inputs, output, **changes):
    config = recipe.Config(
        recordings=inputs, robot=str(inputs / "arm.xml"), num_envs=4, minutes=1.0, device="cpu", output=output
    )
    return replace(config, **{"evaluate_every": 2, "iterations": 3, "window": 0.3} | changes)


@pytest.mark.parametrize(
    ("way", "name"),
    [
        (dict(method="gradient"), "UAN"),
        (dict(method="ppo"), "UAN by PPO, credit by joint"),
        (dict(method="ppo", credit="arm"), "UAN by PPO"),
    ],
)
def test_it_leaves_a_simulator_a_curve_and_what_it_was_made_of(inputs, tmp_path, way, name):
    made = recipe.main(short(inputs, tmp_path, **way))
    loaded = Simulator.load(tmp_path, robot())
    assert (NAMES[loaded.name], loaded.kind) == (name, "correction")
    errors = torch.randn(5, 2, 40)
    torch.testing.assert_close(loaded.net(errors), made.net(errors))
    rows = CSVTable(tmp_path / "progress.csv").rows
    assert [bool(row["mse"]) for row in rows] == [False, True, True]
    notes = json.loads((tmp_path / "simulator.json").read_text())["notes"]
    assert notes["data_seconds"] == pytest.approx(599 * 0.005, rel=0.01)  # of one take: the other is held out
    assert notes["training_seconds"] > 0
    assert notes["validation_mse_last"] == float(rows[-1]["mse"])
    measured = [notes["validation_mse_before"], *(float(row["mse"]) for row in rows if row["mse"])]
    assert notes["validation_mse"] == pytest.approx(min(measured))
    if min(measured) < measured[0]:
        assert made.net(errors).abs().max() > 0


def test_what_a_net_remembers_is_kept_with_it_and_another_memory_is_another_run(inputs, tmp_path):
    made = recipe.main(short(inputs, tmp_path, knows="joint", memory=(0.01, 0.1), hidden=(16,)))
    loaded = Simulator.load(tmp_path, robot())
    assert loaded.name == "uan_joint_memory"
    assert sizes_of(loaded.net) == sizes_of(made.net) == Sizes(20, (16,), 2, False, (0.01, 0.1))
    with pytest.raises(ValueError, match="memory"):
        recipe.main(short(inputs, tmp_path, knows="joint", memory=(0.02, 0.1), hidden=(16,)))


def test_a_killed_run_goes_on(inputs, tmp_path):
    recipe.main(short(inputs, tmp_path, iterations=2))
    recipe.main(short(inputs, tmp_path, iterations=4))
    assert [row["step"] for row in CSVTable(tmp_path / "progress.csv").rows] == ["1", "2", "3", "4"]


def test_a_folder_is_not_gone_on_with_by_a_run_of_something_else(inputs, tmp_path):
    recipe.main(short(inputs, tmp_path / "out", iterations=1))
    with pytest.raises(ValueError, match=r"holds a run whose seed is '0'; here it is '1'.*--output"):
        recipe.main(short(inputs, tmp_path / "out", iterations=2, seed=1))
    with pytest.raises(ValueError, match="whose knows is 'errors'"):
        recipe.main(short(inputs, tmp_path / "out", iterations=2, knows="joint"))
    (tmp_path / "other").mkdir()
    write_recording(recorded(Simulator("other", robot()), commands(600, seed=5)), tmp_path / "other" / "take.npz")
    with pytest.raises(ValueError, match="whose recordings is"):
        recipe.main(replace(short(inputs, tmp_path / "out", iterations=2), recordings=tmp_path / "other"))
    assert len(CSVTable(tmp_path / "out" / "progress.csv").rows) == 1


def test_the_best_net_survives_a_kill(inputs, tmp_path):
    """Even if all that comes after it is worse."""
    first = recipe.main(short(inputs, tmp_path, iterations=4))
    later = recipe.main(short(inputs, tmp_path, iterations=4))  # begins with the net of before training
    assert later.notes["validation_mse"] == first.notes["validation_mse"]
    errors = torch.randn(5, 2, 40)
    torch.testing.assert_close(later.net(errors), first.net(errors), rtol=0, atol=0)


@pytest.mark.parametrize("knows", ["joint", "arm"])
def test_a_net_that_knows_more_comes_back_as_it_was(inputs, tmp_path, knows):
    made = recipe.main(short(inputs, tmp_path, knows=knows, iterations=2))
    loaded = Simulator.load(tmp_path, robot())
    assert loaded.name == f"uan_{knows}"
    seen = torch.randn(5, 2, 46 if knows == "arm" else 40)
    torch.testing.assert_close(loaded.net(seen), made.net(seen))
    chain = loaded.chain()
    assert (chain[0].length, chain[0].state) == (20, knows == "arm")


def test_on_a_diagnosed_model_it_keeps_the_diagnosis(inputs, tmp_path):
    found = {"effect": "viscous_friction", "joint": "hip", "parameters": {"damping": {"value": 2.0}}}
    (tmp_path / "corrected.json").write_text(
        json.dumps(
            {"schema": "torchrl_athletic/corrected/1", "joint_names": ["hip", "knee"], "effects": [found], "trims": []}
        )
    )
    plain = recipe.main(short(inputs, tmp_path / "plain", iterations=1))
    made = recipe.main(short(inputs, tmp_path / "out", iterations=1, model=tmp_path))
    loaded = Simulator.load(tmp_path / "out", robot())
    assert loaded.name == "diagnosed_uan"
    assert loaded.robot.model().joint("hip").damping == [2.0]
    assert made.notes["validation_mse_before"] < plain.notes["validation_mse_before"]


def run_of(folder, name, mse):
    (folder / name).mkdir(parents=True)
    notes = {"validation_mse_before": 1.0}
    (folder / name / "simulator.json").write_text(json.dumps({"notes": notes}))
    table = CSVTable(folder / name / "progress.csv")
    for step, value in enumerate(mse, start=1):
        table.log_metrics({"seconds": 10.0 * step} | ({} if value is None else {"mse": value}), step=step)


def test_the_table_says_how_well_and_how_soon_each_method_fits(tmp_path):
    run_of(tmp_path / "runs", "gradient_0", [0.5, None, 0.14, 0.1])
    run_of(tmp_path / "runs", "gradient_1", [0.1, 0.3, 0.12, 0.1])
    run_of(tmp_path / "runs", "ppo_arm_0", [0.9, 0.8])
    benchmark.main(benchmark.Config("table", output=tmp_path / "runs", results=tmp_path / "results"))
    text = (tmp_path / "results" / "uan_training.md").read_text()
    rows = [line for line in text.splitlines() if line.startswith(("| ppo", "| gradient"))]
    assert rows == [
        "| ppo_arm | 0 | 8.00e-01 | 0.800 | 20 |",
        "| gradient | 0, 1 | 1.00e-01, 1.00e-01 | 0.100 | 30, 30 |",
    ]
    assert (tmp_path / "results" / "uan_training.svg").read_text().startswith("<?xml")
