"""A correction in the chain moves the robot as the diagnosis' own corrected simulation does."""

import json
from types import SimpleNamespace

import mujoco
import numpy as np
import pytest
import torch
from tensordict import TensorDict
from torchrl.envs import Compose, Transform, TransformedEnv
from torchrl.envs.utils import check_env_specs

from torchrl_athletic.diagnosis.corrected import Simulation
from torchrl_athletic.diagnosis.corrected_xml import corrected_xml
from torchrl_athletic.diagnosis.fit import Hypothesis
from torchrl_athletic.diagnosis.replay import take_of
from torchrl_athletic.diagnosis.screen import Candidate
from torchrl_athletic.effects import CATALOGUE, FIT_TRIMS, JointAddress
from torchrl_athletic.envs import TorqueEnv
from torchrl_athletic.recordings import Recording, sensor_noise
from torchrl_athletic.robots import from_mjcf
from torchrl_athletic.robots.benches import pendulum, two_link_arm
from torchrl_athletic.transforms import CorrectedActuation, Decimation
from torchrl_athletic.transforms.corrected_actuation import (
    IN_THE_CHAIN,
    IN_THE_MODEL,
    NOT_ACTED_OUT,
    OF_THE_RECORDING,
    _in_model,
)

EFFECTS = {e.name: e for e in (*FIT_TRIMS, *CATALOGUE)}
RATE, STEP, SECONDS = 100.0, 0.002, 1.2
BENCHES = {
    "pendulum": (pendulum(timestep=STEP), 12.0, 0.4),
    "two_link_arm": (two_link_arm(timestep=STEP), 25.0, 0.6),
}
VALUES = {
    "coulomb_friction": [0.12, 0.0],
    "viscous_friction": [0.05],
    "asymmetric_friction": [0.15, 0.05, 0.06, 0.02],
    "reflected_inertia": [0.006],
    "link_mass": [0.9],
    "link_com": [0.3],
    "link_inertia": [1.4],
    "actuation_delay": [0.0153],
    "actuation_lag": [0.02],
    "torque_scale": [1.3],
    "torque_offset": [-0.2],
    "encoder_offset": [0.08],
    "gain_mismatch": [0.7, 1.5],
    "link_com_shift": [0.02, 0.0, -0.05],
    "payload": [0.15],
    "offset_payload": [0.15, 0.01, 0.0, 0.02],
    "gravity_tilt": [0.05, 0.2],
    "joint_spring": [0.5, 0.2],
    "stribeck_friction": [0.1, 0.06, 0.3],
    "hysteresis": [0.2, 0.05],
    "torque_saturation": [0.25],
    "speed_torque_limit": [0.4, 1.5],
    "torque_ripple": [0.1, -0.05, 7.0],
    "joint_stop": [-0.05, 1.0, 4.0],
    "encoder_scale": [1.1],
    "clock_offset": [0.0153],
}
TOGETHER = ("coulomb_friction", "link_mass", "actuation_delay", "actuation_lag", "torque_scale", "torque_offset",
            "encoder_offset", "gain_mismatch")  # fmt: skip
ALSO = ("stribeck_friction", "torque_ripple", "torque_saturation", "joint_stop", "hysteresis", "encoder_scale",
        "encoder_offset", "joint_spring", "actuation_lag", "gain_mismatch")  # fmt: skip


def correct(bench: str, terms: dict[str, list[float]], trims: dict[str, list[float]] | None = None) -> Simulation:
    """Effects on the last joint of a bench."""
    model = mujoco.MjModel.from_xml_string(BENCHES[bench][0])
    names = tuple(model.joint(i).name for i in range(model.njnt))
    address, last = JointAddress.of(model, names), len(names) - 1

    def candidates(named):
        where = {n: None if EFFECTS[n].whole_robot else names[last] for n in named}
        return tuple(Candidate(EFFECTS[n], last, where[n], EFFECTS[n].parameters(model, address, last)) for n in named)

    trims = trims or {}
    values = np.array([v for part in (terms, trims) for numbers in part.values() for v in numbers])
    return Simulation(model, names, Hypothesis(candidates(terms), candidates(trims)), values)


def record(bench: str, targets: bool) -> Recording:
    """A take that rests at first, so that it is known what the actuators did before it. Its motion is made up."""
    xml, kp, kd = BENCHES[bench]
    names = from_mjcf(xml).joint_names
    time = np.arange(round(SECONDS * RATE)) / RATE
    moves = np.clip(time - 0.2, 0, None)[:, None]
    phase = np.arange(len(names))
    command = 0.5 * np.sin(2 * np.pi * 0.9 * moves + phase) - 0.5 * np.sin(phase) + 0.2 * np.sign(np.sin(9 * moves))
    still = np.zeros_like(command)
    if targets:
        gains = {"kp": np.full(len(names), kp), "kd": np.full(len(names), kd)}
        return Recording(time, names, still, position_target=command, **gains)
    return Recording(time, names, still, torque_command=0.5 * command)


class Start(Transform):
    """Episodes start at given positions, at rest."""

    def __init__(self, qpos: np.ndarray) -> None:
        super().__init__()
        self.qpos = torch.tensor(qpos)

    def _reset_env_preprocess(self, tensordict):
        tensordict = TensorDict(batch_size=self.parent.batch_size) if tensordict is None else tensordict
        return tensordict.set("reset_qpos", self.qpos).set("reset_qvel", torch.zeros_like(self.qpos))

    def _call(self, next_tensordict):
        return next_tensordict

    def _reset(self, tensordict, tensordict_reset):
        return tensordict_reset


def drive(simulation: Simulation, bench: str, recording: Recording, decimation: int | None = None) -> np.ndarray:
    """What the encoders read at the recording's stamps, half a step back as the replay has it. Shape (T, J)."""
    robot = from_mjcf(corrected_xml(BENCHES[bench][0], simulation))
    gains = {} if recording.kp is None else {"kp": recording.kp, "kd": recording.kd}
    chain = CorrectedActuation(
        json.loads(json.dumps(simulation.to_json())), timestep=STEP, torque_limit=robot.torque_limit, **gains
    )
    start = (torch.tensor(recording.position[:1]).float() - chain.encoder_offset) / chain.encoder_scale
    transforms = [Start(start.numpy()), chain] + ([] if decimation is None else [Decimation(decimation)])
    env = TransformedEnv(TorqueEnv(robot), Compose(*transforms))
    td = env.reset()
    path, rates, substeps = [td["joint_position"]], [td["joint_velocity"]], round(1 / RATE / STEP)
    for command in recording.command[:-1]:
        for _ in range(substeps if decimation is None else substeps // decimation):
            td = env.step(td.set(chain.policy_key, torch.tensor(command[None], dtype=torch.float32)))["next"]
        path.append(td["joint_position"])
        rates.append(td["joint_velocity"])
    return (torch.cat(path) - STEP / 2 * torch.cat(rates)).numpy()


CASES = [
    *(("pendulum", (name,), False) for name in VALUES if name != "gain_mismatch"),
    *(("two_link_arm", (name,), True) for name in VALUES),
    *(("two_link_arm", effects, False) for effects in (("actuation_lag",), ("actuation_delay",), TOGETHER[:-1])),
    ("two_link_arm", TOGETHER, True),
    ("pendulum", TOGETHER, True),
    ("two_link_arm", ALSO, True),
    ("pendulum", ALSO[:-1], False),
    ("pendulum", (), True),
]


@pytest.mark.parametrize(
    ("bench", "effects", "targets"), CASES, ids=lambda c: "+".join(c) or "none" if isinstance(c, tuple) else str(c)
)
def test_the_chain_moves_as_the_corrected_simulation(bench, effects, targets):
    trims = {name: VALUES[name] for name in effects if name in ("link_inertia", "link_com_shift")}
    simulation = correct(bench, {name: VALUES[name] for name in effects if name not in trims}, trims)
    recording = record(bench, targets)
    take = take_of(recording, simulation.model, *sensor_noise(recording))
    assert take.model.opt.timestep == pytest.approx(STEP)  # the replay's steps are the chain's
    expected = simulation.rollout(recording, window=None)
    np.testing.assert_allclose(drive(simulation, bench, recording), expected, rtol=0, atol=1e-4)
    if effects:
        assert np.abs(expected - correct(bench, {}).rollout(recording, None)).max() > 2e-3


def test_within_decimation_it_runs_at_the_physics_rate():
    simulation = correct("two_link_arm", {name: VALUES[name] for name in TOGETHER})
    recording = record("two_link_arm", True)
    single = drive(simulation, "two_link_arm", recording)
    np.testing.assert_array_equal(drive(simulation, "two_link_arm", recording, decimation=5), single)


def chain(terms, **kwargs) -> CorrectedActuation:
    content = correct("pendulum", terms).to_json()
    return CorrectedActuation(content, timestep=STEP, kp=12.0, kd=0.4, torque_limit=12.0, **kwargs)


def pendulum_env(n=3, terms=None, **kwargs) -> TransformedEnv:
    names = ("actuation_delay", "actuation_lag", "encoder_offset") if terms is None else terms
    robot = from_mjcf(BENCHES["pendulum"][0])
    return TransformedEnv(TorqueEnv(robot, num_envs=n), chain({name: VALUES[name] for name in names}, **kwargs))


def test_specs_hold():
    check_env_specs(pendulum_env())
    check_env_specs(pendulum_env(terms=()))
    check_env_specs(pendulum_env(terms=("hysteresis", "encoder_scale", "torque_ripple", "joint_stop")))


def test_rows_that_start_anew_forget_what_was_on_its_way_and_the_others_do_not():
    env, torque = pendulum_env(), torch.tensor([[1.0], [2.0], [3.0]])
    td = env.reset()
    for _ in range(20):
        td = env.step(td.set("action", torque))["next"]
    before = td.clone()
    td = env.reset(td.set("_reset", torch.tensor([[True], [False], [False]])))
    assert td["corrected_actuation_fresh"].flatten().tolist() == [True, False, False]
    assert (td["corrected_actuation_queue"][0] == 0).all()
    for key in ("corrected_actuation_queue", "corrected_actuation_lag"):
        assert torch.equal(td[key][1:], before[key][1:])
    assert torch.equal(td["joint_position"][1:], before["joint_position"][1:])
    assert td["joint_position"][0].item() == pytest.approx(VALUES["encoder_offset"][0])


def test_a_command_arrives_late_by_its_delay_and_not_before():
    robot = from_mjcf(BENCHES["pendulum"][0])
    late = CorrectedActuation(correct("pendulum", {"actuation_delay": [0.005]}).to_json(), timestep=STEP)
    env = TransformedEnv(TorqueEnv(robot), late)
    td, felt = env.reset(), []
    for command in (0.0, 1.0, 1.0, 1.0, 1.0, 1.0):
        td = env.step(td.set("torque", torch.full((1, 1), command)))["next"]
        felt.append(td["applied_torque"].item())
    assert felt == [0.0, 0.0, 0.0, 0.5, 1.0, 1.0]  # 5 ms are two and a half steps


@pytest.mark.parametrize(
    "name",
    [
        *("coulomb_friction", "viscous_friction", "asymmetric_friction", "stribeck_friction", "reflected_inertia"),
        *("link_mass", "link_com", "joint_spring", "gravity_tilt"),
    ],
)
def test_a_model_without_the_correction_is_refused(name):
    env = pendulum_env(terms=(name,))
    joint = None if name == "gravity_tilt" else "'pendulum'"
    with pytest.raises(ValueError, match=f"{name} of {joint}.*corrected.xml"):
        env.reset()


@pytest.mark.parametrize("load", [{"payload": [0.15]}, {"offset_payload": [0.15, 0.01, 0.0, 0.02]}])
def test_a_payload_counts_with_the_mass_of_its_link(load):
    terms = {"link_mass": [0.9], **load}
    robot = from_mjcf(corrected_xml(BENCHES["pendulum"][0], correct("pendulum", terms)))
    given, terms_alone = BENCHES["pendulum"][0], {"link_mass": [0.9]}
    without = from_mjcf(corrected_xml(given, correct("pendulum", terms_alone)))
    TransformedEnv(TorqueEnv(robot), chain(terms)).reset()  # refuses a model without the payload
    assert robot.model().body_mass.sum() - without.model().body_mass.sum() == pytest.approx(0.15, rel=1e-6)


def test_a_late_clock_is_a_delay_of_all_joints_and_an_early_one_is_none():
    for offset, length in ((0.004, 3), (-0.004, None)):
        content = correct("two_link_arm", {"clock_offset": [offset]}).to_json()
        late = CorrectedActuation(content, timestep=STEP)
        assert (late.queue_key is None) == (length is None)
        if length is not None:
            assert late.weights.shape == (length, 2)
            np.testing.assert_array_equal(late.weights[:, 0], late.weights[:, 1])


def test_hysteresis_starts_unbent_in_every_episode_and_builds_up_over_its_way():
    env = pendulum_env(terms=("hysteresis",))
    _, width = VALUES["hysteresis"]
    td = env.reset()
    positions = [td["joint_position"]]
    for _ in range(60):
        td = env.step(td.set("action", torch.full((3, 1), 1.0)))["next"]
        positions.append(td["joint_position"])
    way = (positions[-2] - positions[0]).abs()  # the last step's motion comes after its torque
    built = 1 - torch.exp(-way / width)
    assert built.min() > 0.5
    torch.testing.assert_close(td["corrected_actuation_wound"], built, rtol=1e-3, atol=1e-4)
    td = env.reset(td.set("_reset", torch.tensor([[True], [False], [False]])))
    assert td["corrected_actuation_wound"][0] == 0
    torch.testing.assert_close(td["corrected_actuation_wound"][1:], built[1:], rtol=1e-3, atol=1e-4)


def test_a_ripple_of_a_rail_is_counted_in_metres():
    content = correct("pendulum", {"torque_ripple": [0.1, 0.0, 7.0]}).to_json()
    assert CorrectedActuation(content, timestep=STEP).ripple_wave.item() == pytest.approx(7)
    content["effects"][0]["parameters"]["periods"]["unit"] = "1/m"
    assert CorrectedActuation(content, timestep=STEP).ripple_wave.item() == pytest.approx(2 * np.pi * 7)


def test_what_it_does_not_know_is_refused_by_name(tmp_path):
    content = correct("pendulum", {"torque_scale": [1.1]}).to_json()
    (tmp_path / "corrected.json").write_text(json.dumps(content))
    assert CorrectedActuation(tmp_path / "corrected.json", timestep=STEP).torque_scale.item() == pytest.approx(1.1)
    content["effects"][0]["effect"] = "backlash"
    with pytest.raises(ValueError, match=r"'backlash' of 'pendulum'.*act out \(the motor needs an inertia"):
        CorrectedActuation(content, timestep=STEP)
    with pytest.raises(ValueError, match="schema is 'other'"):
        CorrectedActuation({**content, "schema": "other"}, timestep=STEP)
    with pytest.raises(ValueError, match="without kp and kd there are no gains"):
        CorrectedActuation(correct("pendulum", {"gain_mismatch": [0.7, 1.5]}).to_json(), timestep=STEP)


def test_other_joints_and_another_time_step_are_refused():
    robot = from_mjcf(BENCHES["two_link_arm"][0])
    content = correct("pendulum", {"torque_scale": [1.1]}).to_json()
    with pytest.raises(ValueError, match="not among joint_names"):
        CorrectedActuation(content, timestep=STEP, joint_names=robot.joint_names)
    env = TransformedEnv(TorqueEnv(from_mjcf(BENCHES["pendulum"][0])), CorrectedActuation(content, timestep=0.005))
    with pytest.raises(ValueError, match=r"steps of 0.005 s, the environment holds a torque for 0.002 s"):
        env.reset()


def test_it_knows_every_effect_of_the_catalogue():
    """Each is acted out, or in the model, or of no robot, or refused: one that is new has to be put somewhere."""
    places = [set(IN_THE_CHAIN), set(IN_THE_MODEL), OF_THE_RECORDING, set(NOT_ACTED_OUT)]
    assert set(EFFECTS) == set().union(*places)
    assert sum(map(len, places)) == len(EFFECTS)


def test_how_a_recording_was_stamped_is_left_out():
    content = correct("pendulum", {"torque_scale": [1.1]}).to_json()
    content["trims"].append({"effect": "clock_shift", "joint": None, "parameters": {"offset": {"value": 0.002}}})
    assert CorrectedActuation(content, timestep=STEP).torque_scale.item() == pytest.approx(1.1)


def test_a_motor_drawn_stronger_or_weaker_has_that_limit_here_too():
    limits = [
        {
            "effect": "speed_torque_limit",
            "joint": "a",
            "parameters": {"stall_torque": {"value": 4.0}, "no_load_speed": {"value": 10.0}},
        }
    ]
    found = {"schema": "torchrl_athletic/corrected/1", "joint_names": ["a", "b"], "effects": limits, "trims": []}
    seen = TensorDict(
        action=torch.ones(2, 2),
        joint_position=torch.zeros(2, 2),
        joint_velocity=torch.full((2, 2), 2.0),
        torque_limit_scale=torch.tensor([[1.0, 1.0], [0.5, 0.9]]),
        batch_size=[2],
    )
    chain = CorrectedActuation(found, timestep=0.002, kp=100.0, kd=0.0, torque_limit=6.0)
    env = TransformedEnv(TorqueEnv(from_mjcf(TWO, torque_limit=[9.0, 9.0]), num_envs=2), chain)
    shown = env.reset().update(seen)
    torque = env.transform._inv_call(shown.copy())["torque"]
    assert torque.tolist() == [pytest.approx([3.2, 6.0]), pytest.approx([1.6, 5.4])]
    shown["kp_scale"], shown["kd_scale"] = torch.tensor([[0.01, 0.02]] * 2), torch.tensor([[1.0, 2.0]] * 2)
    chain.kd.fill_(0.1)
    torque = env.transform._inv_call(shown)["torque"]
    assert torque.tolist() == [pytest.approx([1.0 - 0.2, 2.0 - 0.4])] * 2


TWO = """<mujoco><worldbody><body><joint name="a"/><geom size=".1"/><body pos="1 0 0"><joint name="b"/><geom size=".1"/>
</body></body></worldbody><actuator><motor joint="a"/><motor joint="b"/></actuator></mujoco>"""


def test_a_link_weighs_what_it_weighs_without_those_that_hang_on_it():
    model = mujoco.MjModel.from_xml_string(BENCHES["two_link_arm"][0])
    for joint in range(2):
        body = model.body(model.jnt_bodyid[joint])
        assert _in_model(model, "link_mass", model.joint(joint).name, (0.1,)) == (0.1, body.mass[0])


def test_a_centre_of_mass_counts_by_its_distance_from_the_axis():
    model = mujoco.MjModel.from_xml_string(
        '<mujoco><worldbody><body><joint name="one" axis="0 1 0" pos="0.1 0 0"/>'
        '<inertial pos="0.4 0.2 0" mass="1" diaginertia="1 1 1"/></body></worldbody></mujoco>'
    )
    assert _in_model(model, "link_com", "one", (0.3,)) == pytest.approx((0.3, 0.3))


class Mounted(CorrectedActuation):
    """As if on an environment, so that single steps can be asked of it without one."""

    parent = TransformedEnv


STILL, TURNS = (0.5, 0.5), (2.0, 2.0)


def entry(effect, values, joint="b"):
    names = (IN_THE_CHAIN | IN_THE_MODEL)[effect]
    return {
        "effect": effect,
        "joint": joint,
        "parameters": {name: {"value": value} for name, value in zip(names, values, strict=True)},
    }


def correction(*effects, names=("a", "b")):
    return {"schema": "torchrl_athletic/corrected/1", "joint_names": list(names), "effects": effects, "trims": []}


def mounted(*effects, kind=Mounted, **options):
    return kind(correction(*effects), timestep=STEP, **options)


def step_of(chain, command=(1.0, 1.0), position=STILL, velocity=TURNS, **entries):
    """One physics step from the start of an episode, and what it left."""
    step = TensorDict(joint_position=torch.tensor([position]), joint_velocity=torch.tensor([velocity]), batch_size=[1])
    step.update(chain.initial(step)).update(entries)
    return chain._inv_call(step.set(chain.policy_key, torch.tensor([command])))


@pytest.mark.parametrize(
    ("effects", "b"),
    [
        ([entry("torque_scale", [1.3])], 1.3),
        ([entry("torque_offset", [-0.2])], 0.8),
        ([entry("torque_saturation", [0.25])], 0.25),
        ([entry("speed_torque_limit", [0.8, 4.0])], 0.4),  # half of its speed, half of its torque
        ([entry("speed_torque_limit", [0.8, 4.0]), entry("torque_saturation", [0.6])], 0.3),  # the lesser at standstill
        ([entry("speed_torque_limit", [0.6, 4.0]), entry("torque_saturation", [0.8])], 0.3),
        ([entry("speed_torque_limit", [0.8, 4.0]), entry("encoder_scale", [2.0])], 0.6),  # turns half as fast
        ([entry("asymmetric_friction", [0.15, 0.05, 0.06, 0.02])], 0.91),  # brakes 0.27, of which the model has 0.18
        ([entry("stribeck_friction", [0.1, 0.06, 0.3])], 1.06),  # slides long since: nothing of the 0.06 is left
        ([entry("stribeck_friction", [0.1, 0.06, 2e3])], 1.0),  # too slow to slide yet
        ([entry("joint_stop", [0.4, 2.0, 3.0])], 0.7),
        ([entry("joint_stop", [0.6, -2.0, 3.0])], 1.3),
        ([entry("joint_stop", [0.6, 2.0, 3.0])], 1.0),
        ([entry("joint_stop", [0.4, 1.0, 3.0]), entry("encoder_offset", [0.08])], 0.94),  # 0.02 behind the stop
        ([entry("joint_stop", [0.2, 1.0, 3.0]), entry("encoder_scale", [2.0])], 0.85),  # 0.05 behind the stop
        ([entry("joint_stop", [0.4, 1.0, 3.0]), entry("torque_scale", [9.0])], 1.2),  # the motor gives its most, 1.5
        ([entry("torque_ripple", [0.1, 0.3, np.pi])], 1.1),  # a quarter of a period from 0: all sine
        ([entry("torque_ripple", [0.1, 0.3, 2 * np.pi])], 0.7),  # half a period: the cosine against it
        ([entry("torque_ripple", [0.1, 0.3, np.pi]), entry("encoder_offset", [0.5])], 1.3),  # is at 0: all cosine
        ([entry("hysteresis", [0.2, 0.05])], 1.0),  # unbent at first
    ],
)
def test_each_effect_acts_at_its_own_joint_by_its_own_numbers(effects, b):
    found = step_of(mounted(*effects, torque_limit=1.5))
    torch.testing.assert_close(found["torque"], torch.tensor([[1.0, b]]))


def test_joints_that_were_not_found_different_stay_as_they_are_beside_all_that_were():
    effects = [entry(name, VALUES[name]) for name in IN_THE_CHAIN if name in VALUES and name != "clock_offset"]
    chain = mounted(*effects, kp=2.0, kd=0.5)
    first = step_of(chain, velocity=(-2.0, -2.0))
    later = chain._inv_call(first.set("action", torch.tensor([[3.0, 3.0]])).set("joint_position", torch.ones(1, 2)))
    assert first["torque"].isfinite().all()
    torch.testing.assert_close(later["torque"][0, 0], torch.tensor(2.0 * (3.0 - 1.0) + 0.5 * 2.0))


def test_a_late_clock_delays_the_joints_that_were_diagnosed_and_no_others():
    late = entry("clock_offset", [20 * STEP], joint=None)
    chain = Mounted(correction(late, names=("b",)), timestep=STEP, joint_names=("a", "b"), kp=1.0, kd=0.0)
    first = step_of(chain)
    found = chain._inv_call(first.set("action", torch.full((1, 2), 7.0)))
    assert found["position_target"].tolist() == [[7.0, 1.0]]


def test_hysteresis_holds_back_by_all_of_its_torque_once_it_has_built_up():
    chain = mounted(entry("hysteresis", [0.2, 0.05]))
    first = step_of(chain)
    for place, torque in ((1.5, 0.8), (0.5, 1.2), (0.5, 1.2)):
        found = chain._inv_call(
            first.set("torque", torch.ones(1, 2)).set("joint_position", torch.tensor([[place, place]]))
        )
        torch.testing.assert_close(found["torque"], torch.tensor([[1.0, torque]]))


@pytest.mark.parametrize("closed", [False, True])
def test_a_lag_of_one_joint_starts_at_its_first_torque_and_moves_on_from_there(closed):
    """Over a step the mean of a torque acts, unless a drive closes the loop: then that at the end."""
    gains = {"kp": 1.0, "kd": 0.0} if closed else {}
    chain = mounted(entry("actuation_lag", [STEP]), **gains)
    first = step_of(chain, position=(0.0, 0.0))
    torch.testing.assert_close(first["torque"], torch.ones(1, 2))
    found = chain._inv_call(first.set(chain.policy_key, torch.full((1, 2), 2.0)))["torque"]
    left = np.exp(-1.0)
    torch.testing.assert_close(found, torch.tensor([[2.0, 2.0 - (left if closed else 1 - left)]], dtype=torch.float32))


def test_gains_and_their_scales_belong_to_stiffness_and_damping_each():
    chain = mounted(entry("gain_mismatch", [0.5, 3.0]), kp=10.0, kd=1.0)
    scales = {"kp_scale": torch.tensor([[2.0, 2.0]]), "kd_scale": torch.tensor([[0.1, 0.1]])}
    found = step_of(chain, **scales)
    torch.testing.assert_close(found["torque"], torch.tensor([[10.0 - 0.2, 5.0 - 0.6]]))


def test_the_target_that_is_noted_is_the_one_that_acts():
    chain = mounted(entry("actuation_delay", [STEP]), kp=10.0, kd=0.0)
    first = step_of(chain)
    found = chain._inv_call(first.set("action", torch.full((1, 2), 7.0)))
    assert found["position_target"].tolist() == [[7.0, 1.0]]


def test_one_gain_without_the_other_is_refused():
    for gains in ({"kp": 1.0}, {"kd": 1.0}):
        with pytest.raises(ValueError, match="one of kp and kd"):
            mounted(**gains)


TWO_JOINTS = mujoco.MjModel.from_xml_string(
    '<mujoco><worldbody><body><joint name="a" damping="0.1" armature="0.01" stiffness="2" frictionloss="0.2"/>'
    '<geom size="0.1" mass="1.5"/><body><joint name="b" damping="0.3" armature="0.02" stiffness="4" '
    'frictionloss="0.16"/><geom size="0.1" mass="2.5"/></body></body></worldbody></mujoco>'
)


@pytest.mark.parametrize(
    ("effect", "values", "wanted", "has"),
    [
        ("coulomb_friction", (0.1,), 0.1, 0.16),
        ("asymmetric_friction", (0.15, 0.05, 0.0, 0.0), 0.1, 0.16),
        ("stribeck_friction", (0.1, 0.06, 0.3), 0.16, 0.16),
        ("viscous_friction", (0.1,), 0.1, 0.3),
        ("reflected_inertia", (0.05,), 0.05, 0.02),
        ("joint_spring", (1.0, 0.5), 1.0, 4.0),
        ("link_mass", (1.0,), 1.0, 2.5),
        ("gravity_tilt", (0.05, -0.2), -0.2, 0.0),
    ],
)
def test_what_the_model_should_have_is_looked_up_where_it_stands(effect, values, wanted, has):
    assert _in_model(TWO_JOINTS, effect, "b", values) == pytest.approx((wanted, has))


@pytest.mark.parametrize(
    ("effects", "names", "timestep", "advice"),
    [
        ([entry("reflected_inertia", [0.0202])], "ab", STEP, "reflected_inertia of 'b'"),
        ([entry("reflected_inertia", [0.0198])], "ab", STEP, "reflected_inertia of 'b'"),
        ([entry("payload", [1.0]), entry("viscous_friction", [0.2])], "ab", STEP, "viscous_friction of 'b'"),
        ([entry("payload", [1.0], "a"), entry("link_mass", [9.0])], "ab", STEP, "link_mass of 'b'"),
        ([], "ba", STEP, "corrections would act on other joints"),
        ([], "ab", 1.01 * STEP, "counts steps"),
        ([], "ab", 0.99 * STEP, "counts steps"),
        ([], "ab", STEP, None),
        ([entry("reflected_inertia", [0.02])], "ab", STEP, None),
        ([entry("payload", [1.0]), entry("link_mass", [9.0]), entry("link_com", [9.0])], "ab", STEP, None),
    ],
)
def test_only_an_environment_that_is_as_corrected_is_accepted(effects, names, timestep, advice):
    class Placed(CorrectedActuation):
        parent = SimpleNamespace(
            physics=SimpleNamespace(joint_names=tuple(names), timestep=timestep, model=TWO_JOINTS), batch_size=[1]
        )

    chain = mounted(*effects, kind=Placed)
    if advice is None:
        chain._check_environment(2)
    else:
        with pytest.raises(ValueError, match=advice):
            chain._check_environment(2)
    for joints in (1, 3):
        with pytest.raises(ValueError, match="is for 2 joints"):
            chain._check_environment(joints)
