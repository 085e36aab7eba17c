"""Throws with policies that hardly learnt anything, on an arm that hides nothing."""

import json
import shutil
from dataclasses import replace
from typing import NamedTuple

import mujoco
import numpy as np
import pytest
import torch
from tensordict import TensorDict

from benchmarks import throw_transfer
from benchmarks.throw_report import ARM
from benchmarks.throw_transfer import AtRelease, Config, Trained, load_recipe, score, side_by_side, stay_on_reference
from torchrl_athletic.identification import Simulator
from torchrl_athletic.identification.cem import correction_of
from torchrl_athletic.networks import save_checkpoint, uan

recipe = load_recipe()


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    """Folder of a policy that was trained for two iterations."""
    folder = tmp_path_factory.mktemp("throw") / "default-0"
    simulator = Simulator("default", recipe.z1()).save(folder / "simulator")
    config = recipe.Config(simulator=simulator, iterations=2, hidden=(16,), evaluate_every=2, output=folder)
    play = recipe.play
    with pytest.MonkeyPatch.context() as patch:  # examined briefly: nobody asks how far it threw there
        patch.setattr(recipe, "play", lambda env, policy, steps: play(env, policy, 3))
        recipe.main(replace(config, ppo=replace(config.ppo, num_envs=4, horizon=4)))
    return folder


class Reading(NamedTuple):
    position: np.ndarray
    velocity: np.ndarray
    torque: np.ndarray


class State(NamedTuple):
    site_position: np.ndarray
    site_rotation: np.ndarray
    site_velocity: np.ndarray
    velocity: np.ndarray


class OpenArm:
    """What the concealed arm promises, kept by the nominal simulation."""

    rate = 200.0

    def __init__(self, robot, seed=0):
        self.robot = robot
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
        return State(site.xpos.copy(), site.xmat.reshape(3, 3).copy(), velocity.copy(), self.data.qvel.copy())


def test_an_arm_that_is_as_simulated_throws_as_far_as_simulated(folder, tmp_path, monkeypatch):
    monkeypatch.setattr(throw_transfer, "ConcealedArm", OpenArm)
    throw_transfer.main(Config((folder, tmp_path), results=tmp_path / "results", images=tmp_path / "images", throws=2))
    by_hand, learnt = json.loads((tmp_path / "results" / "throw_transfer.json").read_text())
    assert (by_hand["name"], learnt["name"], learnt["samples"]) == ("reference", "default-0", 32)
    for each in (by_hand, learnt):
        simulated, real = each["throws"]["default"], each["throws"][ARM]
        assert min(real["distance"]) > 1.0
        assert real["distance"] == pytest.approx(simulated["distance"], abs=0.01)
        assert real["failed"] == [False, False]
        assert real["release"]["release_time"] == pytest.approx(simulated["release"]["release_time"], abs=0.0051)
        gap = np.subtract(real["release"]["release_joint_velocity"], simulated["release"]["release_joint_velocity"])
        assert abs(gap).max() < 0.1
        assert 2.5 < real["release"]["release_time"][0] < 3.5
    assert by_hand["throws"] != learnt["throws"]
    assert "default-0" in (tmp_path / "results" / "throw_transfer.md").read_text()
    assert {path.name for path in (tmp_path / "images").iterdir()} == {"throw_transfer.svg", "throw_matrix.svg"}


def test_policies_are_thrown_in_every_simulator_from_starts_of_their_own(monkeypatch):
    monkeypatch.setattr(throw_transfer, "ConcealedArm", OpenArm)
    monkeypatch.setattr(throw_transfer, "STEPS", 3)
    net = uan()
    torch.nn.init.constant_([m for m in net.modules() if isinstance(m, torch.nn.Linear)][-1].bias, 2.0)
    worlds = {"default": recipe.load_simulator(None)}
    worlds["uan_seed0"] = Simulator("uan", worlds["default"].nominal, net=net, kind="correction")
    seen = []

    def watched(step):
        seen.append(step["joint_position"].clone())
        return stay_on_reference(step)

    policies = [Trained(f"{world}-0", watched, "m", world, simulator) for world, simulator in worlds.items()]
    scores = score(policies, throws=2)
    assert [list(each.throws) for each in scores] == [["default", "uan_seed0", ARM]] * 2
    starts = [seen[0], seen[1], seen[6], seen[7], seen[12], seen[13]]  # both policies, in each world
    for first, again in zip(starts[:2] * 2, starts[2:], strict=True):
        torch.testing.assert_close(first, again)
    assert (starts[0] != starts[1]).any()
    assert (seen[4] - seen[10]).abs().max() > 1e-4  # two steps later the net has pushed
    torch.testing.assert_close(seen[4], seen[16], atol=1e-3, rtol=0)


def test_throws_in_several_processes_are_those_of_one(monkeypatch):
    monkeypatch.setattr(throw_transfer, "ConcealedArm", OpenArm)
    monkeypatch.setattr(throw_transfer, "STEPS", 3)
    simulator = recipe.load_simulator(None)
    policies = [Trained(f"default-{k}", stay_on_reference, "m", "default", simulator) for k in range(3)]
    assert score(policies, throws=1, jobs=2) == score(policies, throws=1)


def test_thrown_in_their_own_simulators_alone_policies_throw_as_they_do_everywhere(monkeypatch):
    monkeypatch.setattr(throw_transfer, "ConcealedArm", OpenArm)
    monkeypatch.setattr(throw_transfer, "STEPS", 3)
    monkeypatch.setattr(throw_transfer, "outcome", lambda end: end["joint_position"].tolist())
    default = recipe.load_simulator(None)
    weak = Simulator("cem", default.nominal, {**correction_of(["joint2"], [20.0, 1.0, 0.1])})
    worlds = {"default": default, "cem_seed0": weak}
    policies = [Trained(f"{world}-0", stay_on_reference, "m", world, s) for world, s in worlds.items()]
    everywhere, alone = (score(policies, throws=2, everywhere=everywhere) for everywhere in (True, False))
    for whole, own in zip(everywhere, alone, strict=True):
        assert list(own.throws) == [own.own, ARM]
        assert own.throws == {world: whole.throws[world] for world in own.throws}
    assert alone[0].throws["default"] != alone[1].throws["cem_seed0"]


@pytest.mark.slow
def test_policies_are_compared_after_as_many_samples(folder, tmp_path, monkeypatch):
    monkeypatch.setattr(throw_transfer, "ConcealedArm", OpenArm)
    other = tmp_path / "uan_seed0-0"
    for copy, sizes in ((tmp_path / "default-0", (32, 64)), (other, (32,))):
        shutil.copytree(folder, copy)
        for samples in sizes:
            kept = torch.load(folder / "policy.pt", weights_only=True)
            kept["metadata"]["samples"] = samples
            (copy / "examined").mkdir(exist_ok=True)
            torch.save(kept, copy / "examined" / f"{samples:06d}.pt")
    found = sorted(tmp_path.iterdir())
    throw_transfer.main(Config(found, results=tmp_path, images=tmp_path, throws=1, by_samples=(32, 64, 128)))
    numbers = json.loads((tmp_path / "throw_samples.json").read_text())
    assert [(each["name"], each["samples"]) for each in numbers] == [
        *(("default-0", 32), ("uan_seed0-0", 32)),
        ("default-0", 64),  # none had 128
    ]
    assert "| Default | " in (tmp_path / "throw_samples.md").read_text()


def test_every_policy_acts_on_its_own_rows():
    policies = [lambda td, k=k: td.set("action", torch.full((*td.shape, 1), float(k))) for k in (3, 5)]
    acted = side_by_side(policies, throws=2)(TensorDict(batch_size=[4]))
    assert acted["action"].flatten().tolist() == [3, 3, 5, 5]


def test_policies_of_no_more_samples_are_compared(tmp_path):
    for samples, distance in ((10, 1.2), (20, 1.6), (30, 1.5), (40, 2.0)):
        about = {"samples": samples, "distance_m": distance}
        save_checkpoint(tmp_path / "examined" / f"{samples:06d}.pt", about, policy=torch.nn.Linear(1, 1))
    chosen = [throw_transfer.farthest(tmp_path, samples) for samples in (9, 10, 30, 40)]
    assert [path and path.stem for path in chosen] == [None, "000010", "000020", "000040"]
    assert throw_transfer.farthest(tmp_path) is None  # without a policy.pt


def test_two_simulators_of_one_name_are_not_mixed(folder, tmp_path):
    other = tmp_path / "default-1"
    Simulator("default", recipe.z1(), notes={"seed": 1}).save(other / "simulator")
    (other / "policy.pt").write_bytes((folder / "policy.pt").read_bytes())
    with pytest.raises(ValueError, match="default-1 was trained in another default"):
        throw_transfer.trained([folder, other])


def test_what_was_at_the_release_stays():
    transform = AtRelease("joint_velocity")
    flag = lambda *rows: torch.tensor([[row] for row in rows])  # noqa: E731
    shown = lambda age, speed, away: TensorDict(  # noqa: E731
        ball_age=torch.full((2, 1), age),
        ball_linear_velocity=torch.full((2, 3), speed),
        joint_velocity=torch.full((2, 7), -speed),
        ball_away=away,
        batch_size=[2],
    )
    step = shown(0, 0.0, flag(False, False))
    step.update(transform.initial(step))
    for age, speed, away in (
        (400, 1.0, flag(False, False)),
        (500, 2.0, flag(True, False)),
        (560, 3.0, flag(True, True)),
    ):
        following = shown(age, speed, away)
        transform.advance(step, following)
        step = following
    assert step["release_time"].flatten().tolist() == pytest.approx([2.5, 2.8])
    assert step["release_velocity"][:, 0].tolist() == [2.0, 3.0]
    assert step["release_joint_velocity"][:, 6].tolist() == [-2.0, -3.0]
