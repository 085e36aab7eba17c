"""What a method found is kept on disk, and acts on targets as the transforms that policies are trained with."""

from __future__ import annotations

import json
from dataclasses import replace

import pytest
import torch
from identification.arms import last_layer
from identification.arms import robot as two_joints
from tensordict.nn import TensorDictModule
from torchrl.envs import Compose, TransformedEnv

from torchrl_athletic.envs import TorqueEnv, actuation_chain
from torchrl_athletic.identification import Simulator, on_a_fit
from torchrl_athletic.networks import uan
from torchrl_athletic.robots import Bucket, z1
from torchrl_athletic.transforms import RandomizationRanges

ROBOT = z1()
FOUND = {
    "schema": "torchrl_athletic/corrected/1",
    "joint_names": ["joint2"],
    "effects": [
        {"effect": "coulomb_friction", "joint": "joint2", "parameters": {"torque": {"value": 4.0}}},
        {"effect": "actuation_delay", "joint": "joint2", "parameters": {"delay": {"value": 0.012}}},
    ],
    "trims": [],
}


def net_of(seed: int) -> torch.nn.Module:
    torch.manual_seed(seed)
    net = uan(history=5, hidden=(8,))
    torch.nn.init.normal_(last_layer(net).weight)
    return net


def always(action: torch.Tensor) -> TensorDictModule:
    return TensorDictModule(lambda position: action, in_keys=["joint_position"], out_keys=["action"])


def move(simulator: Simulator, steps: int = 6, **chain: object) -> torch.Tensor:
    env = TorqueEnv(simulator.robot, num_envs=3, fields=simulator.fields)
    env = TransformedEnv(env, Compose(*simulator.chain(**chain)))
    action = torch.tensor(simulator.robot.default_pose) + torch.linspace(-0.3, 0.3, 3)[:, None]
    return env.rollout(steps, policy=always(action))["next", "joint_position"]


@pytest.mark.parametrize(
    "simulator",
    [
        Simulator("default", ROBOT),
        Simulator("cem", ROBOT, FOUND),
        Simulator("uan", ROBOT, net=net_of(0), kind="correction"),
        Simulator("actuator_net", ROBOT, net=net_of(1), kind="torque"),
        Simulator("diagnosed_uan", ROBOT, FOUND, net_of(2), "correction", notes={"data_seconds": 20.0}),
        Simulator("dr", ROBOT, randomization=RandomizationRanges(friction=None, restitution=None)),
    ],
    ids=lambda simulator: simulator.name,
)
def test_a_simulator_read_back_moves_as_before(simulator: Simulator, tmp_path) -> None:
    again = Simulator.load(simulator.save(tmp_path), ROBOT)
    assert (again.name, again.kind, dict(again.notes)) == (simulator.name, simulator.kind, dict(simulator.notes))
    torch.testing.assert_close(move(again), move(simulator), rtol=0, atol=0)


def test_without_findings_it_is_the_actuation_chain() -> None:
    net = net_of(3)
    env = TransformedEnv(TorqueEnv(ROBOT, num_envs=3), Compose(*Simulator("default", ROBOT).chain()))
    other = TransformedEnv(TorqueEnv(ROBOT, num_envs=3), Compose(*actuation_chain(ROBOT)))
    assert [type(t) for t in env.transform] == [type(t) for t in other.transform]
    corrected = Simulator("uan", ROBOT, net=net, kind="correction")
    assert not torch.equal(move(corrected), move(Simulator("default", ROBOT)))


def test_found_friction_is_in_the_model_and_found_delay_in_the_chain() -> None:
    simulator = Simulator("diagnosed", ROBOT, FOUND)
    assert simulator.robot.model().joint("joint2").frictionloss[0] == 4.0
    late = move(simulator, steps=4, decimation=1)
    friction_alone = {**FOUND, "effects": FOUND["effects"][:1]}
    prompt = move(Simulator("diagnosed", ROBOT, friction_alone), steps=4, decimation=1)
    torch.testing.assert_close(late, prompt)  # what came before the first command is taken to be that command


@pytest.mark.parametrize("named", ["corrected.json", "."])
def test_a_net_on_a_fit_is_named_after_what_left_it(named: str, tmp_path) -> None:
    Simulator("cem", ROBOT, FOUND).save(tmp_path)
    given = on_a_fit(tmp_path / named, "uan_memory", ROBOT)
    assert (given.name, given.net, given.correction) == ("cem_uan_memory", None, FOUND)
    (tmp_path / "simulator.json").unlink()  # a diagnosis leaves none
    assert on_a_fit(tmp_path / named, "uan", ROBOT).name == "diagnosed_uan"


def test_on_inertia_alone_the_joints_keep_the_friction_of_the_nominal_model(tmp_path) -> None:
    rotor = {"effect": "reflected_inertia", "joint": "joint2", "parameters": {"armature": {"value": 0.7}}}
    Simulator("cem", ROBOT, {**FOUND, "effects": [*FOUND["effects"], rotor]}).save(tmp_path)
    whole, alone = on_a_fit(tmp_path, "uan", ROBOT), on_a_fit(tmp_path, "uan", ROBOT, inertia_only=True)
    assert alone.name == "inertia_uan"
    found, nominal = (s.robot.model().joint("joint2") for s in (alone, Simulator("default", ROBOT)))
    assert found.armature == 0.7 != nominal.armature
    assert found.frictionloss == nominal.frictionloss != whole.robot.model().joint("joint2").frictionloss


def test_an_identification_holds_for_the_arm_with_a_bucket() -> None:
    simulator = Simulator("cem", ROBOT, FOUND).on(z1(tool=Bucket()))
    model = simulator.robot.model()
    assert model.joint("joint2").frictionloss[0] == 4.0
    assert model.body("bucket").mass[0] == pytest.approx(0.2)


def test_torques_reach_the_motor_as_commanded_and_nets_see_errors_of_the_equivalent_target() -> None:
    simulator = Simulator("uan", ROBOT, net=net_of(4), kind="correction")
    env = TransformedEnv(TorqueEnv(ROBOT, num_envs=1), Compose(*simulator.chain(command="torque", decimation=1)))
    torque = torch.full((1, 7), 0.5)
    shown = env.rollout(1, policy=always(torque))
    errors = shown["next", "error_history"][0, 0, :, 0, -1]
    assert errors.tolist() == pytest.approx([0.5 / kp for kp in ROBOT.kp[:6]], rel=1e-4)  # at rest
    correction = shown["next", "torque_correction"][0, 0]
    torch.testing.assert_close(shown["next", "applied_torque"][0, 0, :6], 0.5 + correction)


def test_randomised_rows_differ_only_where_policies_are_trained() -> None:
    ranges = RandomizationRanges(friction=None, restitution=None)
    simulator = Simulator("dr", ROBOT, randomization=ranges)
    assert set(simulator.fields) == {"body_mass", "body_inertia", "body_ipos"}
    same = move(simulator, randomize=False)
    torch.testing.assert_close(same, move(Simulator("default", ROBOT)))
    assert not torch.equal(move(simulator), same)


def test_a_net_without_a_place_is_refused() -> None:
    with pytest.raises(ValueError, match="Give both a net and 'correction' or 'torque'"):
        Simulator("uan", ROBOT, net=net_of(0))


def test_an_unfinished_folder_and_another_version_are_refused(tmp_path) -> None:
    with pytest.raises(FileNotFoundError, match="no method has finished there"):
        Simulator.load(tmp_path, ROBOT)
    folder = Simulator("default", ROBOT).save(tmp_path)
    content = json.loads((folder / "simulator.json").read_text())
    (folder / "simulator.json").write_text(json.dumps({**content, "schema": "torchrl_athletic/simulator/0"}))
    with pytest.raises(ValueError, match="Identify it again"):
        Simulator.load(folder, ROBOT)


def test_a_robot_of_other_joints_or_a_net_under_other_gains_is_refused(tmp_path) -> None:
    folder = Simulator("uan", ROBOT, net=net_of(0), kind="correction").save(tmp_path / "net")
    with pytest.raises(ValueError, match=r"\['joint1', .*\] were identified, 'two_joints' has the joints"):
        Simulator.load(folder, two_joints())
    softer = replace(ROBOT, kp=tuple(0.5 * kp for kp in ROBOT.kp))
    with pytest.raises(ValueError, match=r"dataclasses.replace\(robot, kp="):
        Simulator.load(folder, softer)
    found = Simulator("cem", ROBOT, FOUND).save(tmp_path / "numbers")
    assert Simulator.load(found, softer).robot.kp == softer.kp  # friction is friction, whatever drives it


def test_a_digest_changes_with_whatever_acts() -> None:
    heavier = {**FOUND, "effects": FOUND["effects"][:1]}
    all_different = [
        Simulator("a", ROBOT),
        Simulator("a", ROBOT, FOUND),
        Simulator("a", ROBOT, heavier),
        Simulator("a", ROBOT, net=net_of(0), kind="correction"),
        Simulator("a", ROBOT, net=net_of(1), kind="correction"),
        Simulator("a", ROBOT, net=net_of(0), kind="torque"),
        Simulator("a", replace(ROBOT, kp=tuple(2 * kp for kp in ROBOT.kp))),
    ]
    assert len({simulator.digest for simulator in all_different}) == len(all_different)
    assert Simulator("b", ROBOT, FOUND, notes={"seed": 3}).digest == all_different[1].digest
