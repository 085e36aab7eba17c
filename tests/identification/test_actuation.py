"""The arm's actuation by its name: what stands between targets and motors, and how late they are."""

import pytest
import torch
from tensordict.nn import TensorDictModule
from torchrl.envs import Compose, TransformedEnv

from torchrl_athletic.envs import TorqueEnv
from torchrl_athletic.identification import Simulator, actuation_identity, with_actuation
from torchrl_athletic.networks import digest_of, pretrained, uan
from torchrl_athletic.robots import with_options, z1
from torchrl_athletic.transforms import ActionDelay, CorrectedActuation, PowerClip, UANCorrection

ARM = z1()
FOUND = {
    "schema": "torchrl_athletic/corrected/1",
    "joint_names": list(ARM.joint_names),
    "effects": [
        {"effect": "reflected_inertia", "joint": "joint2", "parameters": {"armature": {"value": 0.1}}},
        {"effect": "actuation_delay", "joint": "joint2", "parameters": {"delay": {"value": 0.012}}},
    ],
    "trims": [],
}


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    return str(Simulator("diagnosed", ARM, FOUND, uan(), "correction").save(tmp_path_factory.mktemp("found") / "uan"))


def parts_of(actuation, **told):
    return {type(part): part for part in with_actuation(ARM, actuation, **told)[1]}


def test_the_shipped_net_is_all_that_tells_uan_from_ideal_motors():
    ideal, corrected = parts_of("ideal"), parts_of("uan")
    assert list(corrected) == [UANCorrection, *ideal]
    assert digest_of(corrected[UANCorrection].net) == digest_of(pretrained("uan"))
    assert with_actuation(ARM, "uan")[0] is ARM


def test_a_folder_brings_the_robot_and_the_chain_that_were_identified(folder):
    robot, chain = with_actuation(ARM, folder)
    model = robot.model()
    assert model.dof_armature[model.joint("joint2").dofadr[0]] == pytest.approx(0.1)
    assert {CorrectedActuation, UANCorrection, PowerClip} <= {type(part) for part in chain}


@pytest.mark.parametrize("actuation", ["ideal", "uan", "folder"])
def test_every_kind_has_the_power_and_the_delays_that_it_is_told(actuation, folder):
    actuation = folder if actuation == "folder" else actuation
    rows = {"delay": (2, 5), "seed": 3}
    parts = parts_of(actuation, arm_power=123.0, **rows)
    assert parts[PowerClip].max_power == 123.0
    assert (parts[ActionDelay].min_steps, parts[ActionDelay].max_steps) == (2, 5)
    assert parts_of(actuation, arm_power=None).keys().isdisjoint({PowerClip, ActionDelay})

    def delays(num_envs, **told):
        robot, chain = with_actuation(ARM, actuation, **(rows | told))
        return TransformedEnv(TorqueEnv(robot, num_envs=num_envs), Compose(*chain)).reset()["action_delay"].flatten()

    whole = delays(64)
    assert whole.unique().tolist() == [2, 3, 4, 5]
    assert torch.equal(delays(4, first_row=60), whole[60:])
    assert not torch.equal(delays(64, seed=4), whole)


def test_what_is_identified_anew_in_the_same_folder_is_another_simulator(tmp_path):
    def identified(net, found=FOUND):
        return actuation_identity(str(Simulator("diagnosed", ARM, found, net, "correction").save(tmp_path / "found")))

    torch.manual_seed(0)
    one, other = uan(), uan()
    first = identified(one)
    assert first.startswith(str(tmp_path / "found"))
    assert identified(one) == first != identified(other)
    later = {**FOUND["effects"][1], "parameters": {"delay": {"value": 0.02}}}
    assert identified(one, {**FOUND, "effects": [FOUND["effects"][0], later]}) != first
    assert [actuation_identity(name) for name in ("ideal", "uan", "nowhere")] == ["ideal", "uan", "nowhere"]


def test_a_name_that_is_neither_is_refused_with_what_to_name():
    with pytest.raises(FileNotFoundError, match=r"iedal holds no simulator\.json.*Name the folder"):
        with_actuation(ARM, "iedal")


def test_drives_are_as_late_in_a_finer_simulation(folder):
    def moved(timestep, substeps):
        robot, chain = with_actuation(with_options(ARM, timestep=timestep), folder, substeps=substeps)
        env = TransformedEnv(TorqueEnv(robot, num_envs=1, substeps=substeps), Compose(*chain))
        target = torch.tensor([robot.default_pose]) + 0.2
        policy = TensorDictModule(lambda position: target, in_keys=["joint_position"], out_keys=["action"])
        shown = env.rollout(5, policy=policy)
        return shown["next", "joint_position"][0, :, 1] - robot.default_pose[1]

    coarse, fine = moved(0.005, 1), moved(0.0005, 10)
    assert coarse[-1] > 0.1
    torch.testing.assert_close(fine, coarse, rtol=0, atol=0.02)
