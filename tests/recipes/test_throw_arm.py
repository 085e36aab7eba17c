"""The recipe for throwing and its benchmark, run for a few iterations, and on an arm that hides nothing."""

import importlib.util
import json
import sys
from dataclasses import replace
from pathlib import Path
from typing import NamedTuple

import mujoco
import numpy as np
import pytest
import torch

ROOT = Path(__file__).parents[2]


def script(folder, name):
    """A script as a module."""
    spec = importlib.util.spec_from_file_location(f"{folder}_{name}", ROOT / folder / f"{name}.py")
    module = importlib.util.module_from_spec(spec)
    sys.modules[spec.name] = module  # where dataclasses look for annotations
    spec.loader.exec_module(module)
    return module


recipe, benchmark = script("recipes", "throw_arm"), script("benchmarks", "throw_transfer")
RobotSimulator = sys.modules["torchrl_athletic.identification"].Simulator
Ranges = sys.modules["torchrl_athletic.transforms"].RandomizationRanges


def short(output, **changes):
    config = recipe.Config(iterations=2, hidden=(16,), evaluate_every=2, output=output)
    return replace(config, ppo=replace(config.ppo, num_envs=4, horizon=4), **changes)


@pytest.fixture(scope="module")
def trained(tmp_path_factory):
    """A folder with a policy that has hardly learnt anything."""
    folder = tmp_path_factory.mktemp("throw") / "default-0"
    recipe.main(short(folder))
    simulator = RobotSimulator("default", recipe.z1()).save(folder.parent / "default")
    (folder / "simulator.txt").write_text(f"{simulator}\n")
    return folder


def test_it_learns_measures_and_leaves_a_policy(trained, capsys):
    recipe.main(short(trained))  # goes on where it ended
    assert "% of throws failed" in capsys.readouterr().out
    metadata = torch.load(trained / "policy.pt", weights_only=True)["metadata"]
    assert metadata["distance_m"] == pytest.approx(1.26, abs=0.1)  # that of the reference, where it begins
    assert metadata["sizes"] == {"seen": 340, "joints": 6, "adapts_to": 0, "hidden": [16]}
    policy = benchmark.load_policy(recipe, trained / "policy.pt")
    assert sum(p.numel() for p in policy.parameters()) == 340 * 16 + 16 + 16 * 6 + 6 + 6


def test_a_policy_that_adapts_throws_without_being_told_of_its_arm(tmp_path):
    ranges = Ranges(friction=None, restitution=None)
    simulator = RobotSimulator("roa", recipe.z1(), randomization=ranges).save(tmp_path / "roa")
    recipe.main(short(tmp_path / "roa-0", simulator=simulator))
    sizes = torch.load(tmp_path / "roa-0" / "policy.pt", weights_only=True)["metadata"]["sizes"]
    assert sizes["adapts_to"] > 20  # gains, limits, masses
    env = recipe.make_env(recipe.load_simulator(simulator), 2, randomize=False, ends=False)
    policy = benchmark.load_policy(recipe, tmp_path / "roa-0" / "policy.pt")
    assert policy(env.reset())["action"].shape == (2, 6)


def test_random_arms_are_drawn_for_training_alone():
    simulator = RobotSimulator(
        "dr", recipe.load_simulator(None).robot, randomization=Ranges(friction=None, restitution=None)
    )
    masses = [
        recipe.make_env(simulator, 2, randomize=randomize).reset().get("randomization", None)
        for randomize in (True, False)
    ]
    assert masses[0].abs().max() > 0
    assert masses[1] is None


class Reading(NamedTuple):
    position: np.ndarray
    velocity: np.ndarray
    torque: np.ndarray


class State(NamedTuple):
    site_position: np.ndarray
    site_rotation: np.ndarray
    site_velocity: np.ndarray


class OpenArm:
    """What the concealed arm promises, kept by the nominal simulation."""

    rate = 200.0

    def __init__(self):
        self.robot = recipe.load_simulator(None).robot
        self.model = self.robot.model()
        self.data = mujoco.MjData(self.model)

    def reset(self, pose):
        mujoco.mj_resetData(self.model, self.data)
        self.data.qpos[:] = pose
        return self.read()

    def step(self, target):
        robot, data = self.robot, self.data
        torque = np.array(robot.kp) * (target - data.qpos) - np.array(robot.kd) * data.qvel
        limit, used = np.array(robot.torque_limit), np.clip(data.qvel / np.array(robot.velocity_limit), -1, 1)
        data.qfrc_applied[:] = np.clip(torque, -limit * (1 + used.clip(max=0)), limit * (1 - used.clip(min=0)))
        mujoco.mj_step(self.model, data)
        return self.read()

    def read(self):
        mujoco.mj_forward(self.model, self.data)
        return Reading(self.data.qpos.copy(), self.data.qvel.copy(), self.data.qfrc_applied.copy())

    def true_state(self):
        site = self.data.site("bucket")
        velocity = self.data.sensor("bucket_linear_velocity").data
        return State(site.xpos.copy(), site.xmat.reshape(3, 3).copy(), velocity.copy())


def test_an_arm_that_is_as_simulated_throws_as_far_as_simulated(trained):
    throws = benchmark.score(trained, [OpenArm(), OpenArm()])
    assert throws.method == "default"
    assert min(throws.real) > 1.0
    assert throws.real == pytest.approx(throws.simulated, abs=0.01)
    assert throws.failed == [False, False]


def some(method, name, simulated, real, failed=(False, False)):
    return benchmark.Throws(method, name, list(simulated), list(real), list(failed))


FOUND = [
    some("uan", "uan_seed0-0", (2.0, 2.2), (2.0, 2.0)),
    some("uan", "uan_seed1-0", (2.0, 2.0), (1.9, 2.1)),
    some("default", "default-0", (3.0, 3.0), (0.0, 0.5), (True, False)),
    some("mine", "mine-0", (1.0, 1.0), (1.0, 1.0)),
]


def test_the_table_gives_each_policy_and_the_mean_of_a_method():
    lines = benchmark.markdown(FOUND).splitlines()[2:]
    assert [[cell.strip() for cell in line.split("|")[1:3]] for line in lines] == [
        ["default", "default-0"],
        ["uan", "uan_seed0-0"],
        ["uan", "uan_seed1-0"],
        ["uan", "mean of 2"],
        ["mine", "mine-0"],
    ]
    assert "| 3.000 ± 0.000 m | 0.250 ± 0.250 m | 2.750 ± 0.250 m | 91.7 % | 1 of 2 |" in lines[0]
    assert "| 2.100 ± 0.100 m | 2.000 ± 0.000 m | 0.100 ± 0.100 m | 4.8 % | 0 of 2 |" in lines[1]
    assert "| 2.050 ± 0.087 m | 2.000 ± 0.071 m | 0.100 ± 0.071 m | 4.9 % | 0 of 4 |" in lines[3]


def test_the_figure_has_a_bar_for_each_method(tmp_path):
    benchmark.draw(FOUND, tmp_path / "figure.svg")
    text = (tmp_path / "figure.svg").read_text()
    assert all(f"<!-- {method} -->" in text for method in ("default", "uan", "mine"))


def test_policies_that_are_there_are_not_trained_again(trained, tmp_path, monkeypatch):
    started = []

    def start(folder, seed, output, cfg):
        started.append((folder.name, seed, output.name))
        output.mkdir(parents=True)
        (output / "log.txt").write_text("9 %\n1.50 ± 0.10 m, 0 % of throws failed\npolicy: here\n")
        return benchmark.subprocess.Popen([sys.executable, "-c", ""]), benchmark.time.monotonic(), output

    monkeypatch.setattr(benchmark, "start", start)
    (tmp_path / "default-0").mkdir()
    (tmp_path / "default-0" / "policy.pt").touch()
    folders = (trained.parent / "default", tmp_path)  # the latter holds no simulator
    benchmark.main(benchmark.Config("train", folders, output=tmp_path, seeds=(0, 1)))
    assert started == [("default", 1, "default-1")]
    assert benchmark.last_line(tmp_path / "default-1" / "log.txt", 0).startswith("1.50 ± 0.10 m")


def test_a_training_is_told_all_that_it_needs(trained, tmp_path, monkeypatch):
    told = []
    monkeypatch.setattr(benchmark.subprocess, "Popen", lambda words, **_: told.append(words))
    cfg = benchmark.Config("train", (), device="cuda", minutes=2.0, num_envs=64)
    benchmark.start(trained.parent / "default", 3, tmp_path / "default-3", cfg)
    flags = dict(zip(told[0][2::2], told[0][3::2], strict=True))
    assert flags["--ppo.num-envs"] == "64"
    assert flags["--seed"] == "3"
    assert flags["--simulator"] == str(trained.parent / "default")
    assert (tmp_path / "default-3" / "simulator.txt").read_text().strip() == flags["--simulator"]
    parsed = benchmark.tyro.cli(recipe.Config, args=told[0][2:])
    assert parsed.device == "cuda"
    assert parsed.ppo.num_envs == 64


def test_scores_are_written_for_all_policies(trained, tmp_path, monkeypatch):
    monkeypatch.setattr(benchmark, "ConcealedArm", lambda robot, seed: OpenArm())
    monkeypatch.setattr(benchmark, "score", lambda folder, arms: some("default", folder.name, (1.0,), (1.1,)))
    benchmark.main(benchmark.Config("score", (trained, tmp_path), results=tmp_path / "results"))
    rows = json.loads((tmp_path / "results" / "throw_transfer.json").read_text())
    assert [row["name"] for row in rows] == ["reference", "default-0"]
    assert (tmp_path / "results" / "throw_transfer.md").read_text().count("default-0") == 1
