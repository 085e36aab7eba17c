"""What named physics leaves is learnt from the fitted takes, and scored where the diagnosis scores."""

from __future__ import annotations

import json
from copy import copy
from dataclasses import replace
from functools import partial
from types import SimpleNamespace

import mujoco
import numpy as np
import pytest
import torch
from diagnosis.plants import pendulum, record, smooth_torque
from torch import nn

from torchrl_athletic.diagnosis import Diagnosis, Score, diagnose
from torchrl_athletic.diagnosis.corrected import Simulation
from torchrl_athletic.diagnosis.fit import Hypothesis
from torchrl_athletic.diagnosis.prepare import prepare
from torchrl_athletic.diagnosis.replay import simulate, windows_of
from torchrl_athletic.diagnosis.report.shares import energy_shares
from torchrl_athletic.diagnosis.screen import Candidate
from torchrl_athletic.effects import CATALOGUE, JointAddress, Plant
from torchrl_athletic.effects.plant import Now, Start
from torchrl_athletic.identification.simulator import load_net
from torchrl_athletic.recordings import Recording
from torchrl_athletic.training import remainder, train, uan_gradient
from torchrl_athletic.training.remainder import (
    LearnedTorque,
    WithNet,
    _remark,
    acted_out,
    driven_robot,
    learn_remainder,
    scored,
    without_gaps,
)

ONLY_VISCOUS = tuple(e for e in CATALOGUE if e.name == "viscous_friction")


class Brake(nn.Module):
    """A net that knows: a torque against the newest velocity error's opposite, ``damping`` times it."""

    def __init__(self, damping: float) -> None:
        super().__init__()
        self.damping = damping

    def forward(self, errors: torch.Tensor) -> torch.Tensor:
        return self.damping * errors[..., -1:]  # the velocity error is minus the velocity


def takes(kinds, **joint) -> list:
    true = pendulum(joint=" ".join(f'{key}="{value}"' for key, value in {"damping": 0.05, **joint}.items()))
    return [record(true, smooth_torque(4.0, 1.5, seed=k), noise=1e-4, seed=k) for k in kinds]


def test_a_robot_that_floats_is_left_to_its_names():
    take = takes([0])[0].with_base_held((0.0, 0.0, 1.0))
    with pytest.raises(ValueError, match=r"base of this robot floats.* leave out --uan"):
        learn_remainder(SimpleNamespace(recordings=(take,)))


@pytest.fixture(scope="module")
def damped() -> Diagnosis:
    """Nothing can be named: the catalogue is empty, and the pendulum is damped four times as much as the model says."""
    found = diagnose(pendulum(), takes([0, 1], damping=0.2), takes([2], damping=0.2), catalogue=())
    return replace(found, corrected=found.nominal)  # without what was adjusted within tolerances


def test_a_net_that_does_nothing_scores_as_the_named_physics(damped):
    robot = driven_robot(damped.xml, damped.recordings)
    score = scored(damped, damped.corrected, Brake(0.0), robot, "heldout")
    given = damped.answer.fit["heldout"].before
    assert score.before == pytest.approx(given, rel=1e-6)
    assert score.after == pytest.approx(given, rel=1e-6)


def test_a_net_that_knows_the_missing_damping_closes_the_gap_and_one_of_the_other_sign_opens_it(damped):
    robot = driven_robot(damped.xml, damped.recordings)
    right, wrong = (scored(damped, damped.corrected, Brake(b), robot, "heldout") for b in (0.15, -0.15))
    assert right.after < 0.1 * right.before
    assert wrong.after > 1.5 * wrong.before


def test_it_looks_back_through_what_was_measured_before_the_window(damped):
    class Oldest(nn.Module):
        def forward(self, errors: torch.Tensor) -> torch.Tensor:
            return 0.15 * errors[..., 20:21]  # twenty steps ago

    robot = driven_robot(damped.xml, damped.recordings)
    late = scored(damped, damped.corrected, Oldest(), robot, "heldout")
    assert late.after < 0.3 * late.before  # 40 ms late, and still a brake, from the window's first step on


def test_in_a_finer_simulation_it_sees_the_newest_moment_and_others_a_period_apart(damped):
    seen = []

    class Watching(nn.Module):
        def forward(self, errors: torch.Tensor) -> torch.Tensor:
            seen.append(errors[0, 0, 20:].tolist())
            return torch.zeros_like(errors[..., :1])

    robot = replace(driven_robot(damped.xml, damped.recordings), kp=(1.0,), kd=(0.3,))
    (take,) = prepare(damped.recordings[:1], damped.nominal.model).takes
    model = take.halved().model
    plant = Plant(model, JointAddress.of(model, robot.joint_names), 1)
    law, none = LearnedTorque(Watching(), robot, plant, np.ones((1, 1))), np.zeros((1, 1))
    law.past = np.zeros((1, 40, 1, 2))
    for k in range(41):
        now = Now(none, np.full((1, 1), -float(k)), none, none[0], law.step)
        law.note(now)
    law(now)
    assert seen == [list(range(2, 41, 2))]


def test_in_a_finer_simulation_the_history_begins_with_what_was_measured_a_step_apart(damped):
    """The torque rises by 1 N·m each second, so that it tells how long ago it was."""
    robot = replace(driven_robot(damped.xml, damped.recordings), kp=(1.0,), kd=(0.0,))
    (take,) = prepare(damped.recordings[:1], damped.nominal.model).takes
    model = take.halved().model
    law = LearnedTorque(Brake(0.0), robot, Plant(model, JointAddress.of(model, robot.joint_names), 1), np.ones((1, 1)))
    time = np.arange(400) * law.period
    rows = np.ones((400, 1))
    law.begin(Start(time, 0 * rows, 0 * rows, time[:, None], np.array([300])))
    back = np.diff(law.past[0, :, 0, 0])
    assert law.stride == 2
    np.testing.assert_allclose(np.abs(back), law.step, rtol=1e-6)


@pytest.mark.parametrize("servo", [False, True])
def test_a_net_sees_no_other_take_of_a_joined_one(damped, servo):
    """Stamps of both takes are the same."""

    class Both(nn.Module):
        def forward(self, errors: torch.Tensor) -> torch.Tensor:
            return 0.05 * errors[..., 20:21] + 0.1 * errors.mean(-1, keepdim=True)

    robot = driven_robot(damped.xml, damped.recordings)
    robot = replace(robot, kd=(0.3,)) if servo else robot
    (together,) = prepare(damped.recordings, damped.nominal.model).takes
    assert len(together.parts) == 2
    build = WithNet((), (), Both(), robot).build
    found, *alone = (simulate(windows_of(take, 0.4), build, np.ones((1, 1)))[0] for take in (together, *together.parts))
    np.testing.assert_allclose(found, np.concatenate(alone), rtol=0, atol=1e-6)


def test_what_is_named_keeps_its_numbers_beside_a_net_and_the_last_number_says_whether_that_acts(damped):
    """A brake of 0.2 by the net and 0.1 by friction are 0.3 by friction; a net that does not act is none."""
    robot = driven_robot(damped.xml, damped.recordings)
    (take,) = prepare(damped.recordings[:1], damped.nominal.model).takes
    address = JointAddress.of(damped.nominal.model, ("pendulum",))
    viscous = ONLY_VISCOUS[0]
    term = Candidate(viscous, 0, "pendulum", viscous.parameters(damped.nominal.model, address, 0))
    windows = windows_of(take, 0.4)
    named = Hypothesis((term,)).build
    beside = WithNet((term,), (), Brake(0.2), robot).build
    weak, strong = (simulate(windows, named, np.array([[damping]]))[0] for damping in (0.1, 0.3))
    silent, acting = (simulate(windows, beside, np.array([[0.1, share]]))[0] for share in (0.0, 1.0))
    np.testing.assert_allclose(silent, weak, rtol=0, atol=1e-12)
    assert np.abs(acting - strong).max() < 0.05 * np.abs(weak - strong).max()


THREE = """
<mujoco><option timestep="0.005"/><worldbody>
  <body name="one"><joint name="one" axis="0 -1 0"/><inertial pos="0 0 -0.3" mass="0.5" diaginertia="1 1 1"/>
    <body name="two"><joint name="two" axis="0 -1 0"/><inertial pos="0 0 -0.3" mass="0.5" diaginertia="1 1 1"/>
      <body name="three"><joint name="three" axis="0 -1 0"/>
        <inertial pos="0 0 -0.3" mass="0.5" diaginertia="1 1 1"/></body></body></body></worldbody>
  <actuator><motor joint="one" forcerange="-10 10"/><motor joint="two" forcerange="-20 20"/>
    <motor joint="three" forcerange="-30 30"/></actuator></mujoco>"""


def test_of_takes_in_another_order_each_joint_has_its_own_gains_limits_errors_and_torques():
    """Logged as (three, one, two); the net is asked joint by joint in the robot's order, and answers in it."""
    logged = ("three", "one", "two")
    at, time = {"one": 1.0, "two": 2.0, "three": 3.0}, np.arange(4) * 0.005
    by_joint = np.array([at[name] for name in logged])
    still = np.tile(by_joint, (4, 1))
    take = Recording(time, logged, still, position_target=still, kp=10 * by_joint, kd=0.1 * by_joint)
    robot = driven_robot(THREE, [take])
    assert robot.joint_names == ("one", "two", "three")
    assert (robot.kp, robot.kd) == ((10.0, 20.0, 30.0), pytest.approx((0.1, 0.2, 0.3)))
    assert robot.torque_limit == (10.0, 20.0, 30.0)
    seen = []

    class Asked(nn.Module):
        def forward(self, errors: torch.Tensor) -> torch.Tensor:
            seen.append(errors[0])
            return torch.tensor([[[100.0], [200.0], [300.0]]])

    model = mujoco.MjModel.from_xml_string(THREE)
    plant = Plant(model, JointAddress.of(model, logged), 1)
    law, none = LearnedTorque(Asked(), robot, plant, np.full((1, 1), 0.5)), np.zeros((1, 3))
    law.past = np.zeros((1, 20, 3, 2))
    velocity = np.array([[7.0, 8.0, 9.0]])
    now = Now(none, velocity, 6.0 * by_joint[None], none[:, 0], 0.005)
    law.note(now)
    np.testing.assert_array_equal(law(now), [[150.0, 50.0, 100.0]])
    newest = [(8.0, 6.0, 1.0), (9.0, 6.0 * 2, 2.0), (7.0, 6.0 * 3, 3.0)]  # velocity, torque, number of one, two, three
    for joint, (speed, torque, number) in enumerate(newest):
        assert seen[0][joint, 19].item() == pytest.approx((torque + 0.1 * number * speed) / (10 * number))
        assert seen[0][joint, -1].item() == -speed


def test_a_net_is_taught_written_and_its_share_is_told(damped, tmp_path):
    hour = 60.0  # so that the pace of a machine changes neither window nor rate
    found = learn_remainder(damped, tmp_path, minutes=hour, rate=5e-4, iterations=40, rows=8, progress=False)
    fit = found.answer.fit
    assert fit["heldout_uan"].after < 0.6 * fit["heldout"].after
    content = json.loads((tmp_path / "diagnosis.json").read_text(encoding="utf-8"))
    assert {"train_uan", "heldout_uan"} <= content["fit"].keys()
    assert energy_shares(found.answer, "heldout")["uan"] > 0.3
    assert "A UAN on the remainder takes another" in found.answer.remarks[-1]
    net, robot = load_net(tmp_path / "uan.pt"), driven_robot(damped.xml, damped.recordings)
    again = scored(damped, damped.corrected, net, robot, "heldout")
    assert again.after == pytest.approx(fit["heldout_uan"].after, rel=1e-6)


def test_a_training_that_was_killed_goes_on_to_the_same_net_and_leaves_no_checkpoints(damped, tmp_path, monkeypatch):
    never = 1e12  # a rate that fell with the time that is left would fall otherwise in a run that was killed
    run = {"minutes": never, "rate": 5e-4, "iterations": 4, "rows": 2, "progress": False}
    learn_remainder(damped, tmp_path / "whole", **run)

    def killed_after(iterations):
        def step(learner):
            if learner.iteration == iterations:
                raise KeyboardInterrupt
            return uan_gradient.descend(learner)

        return step

    often = partial(train, checkpoint_every=2)
    monkeypatch.setattr(remainder, "train", often)
    monkeypatch.setattr(remainder, "descend", killed_after(3))
    with pytest.raises(KeyboardInterrupt):
        learn_remainder(damped, tmp_path / "killed", **run)
    begun = []
    monkeypatch.setattr(
        remainder, "descend", lambda learner: begun.append(learner.iteration) or uan_gradient.descend(learner)
    )
    learn_remainder(damped, tmp_path / "killed", **run)
    assert begun == [2, 3]
    whole, again = (load_net(tmp_path / name / "uan.pt").state_dict() for name in ("whole", "killed"))
    for name, value in whole.items():
        torch.testing.assert_close(again[name], value, rtol=0, atol=0)
    assert sorted(path.name for path in (tmp_path / "killed").iterdir() if path.is_dir()) == []


def test_drop_outs_cut_the_takes_that_a_net_learns_from(damped):
    first = damped.recordings[0]
    logged = (first.time < 1.5) | ((first.time > 1.6) & (first.time < 2.0)) | (first.time > 2.1)
    holed = replace(damped, recordings=(first.where(logged),))
    before, after = without_gaps(holed.recordings)
    assert before.duration == pytest.approx(1.5, abs=0.02)  # 0.4 s are too short for a window
    assert after.time[0] > 2.1
    assert without_gaps([first.slice(0, 100)])[0].duration < 1.0  # without a drop-out it is taken as it is
    pieces = first.where((first.time * 10).astype(int) % 8 < 6)
    with pytest.raises(ValueError, match=r"longest has 0\.(59|60) s.*Leave out --uan"):
        without_gaps([pieces.slice(0, pieces.num_samples - 30)])  # of which the last is shorter
    found = learn_remainder(holed, minutes=60.0, iterations=1, rows=4, progress=False)
    assert found.answer.fit["train_uan"].after > 0


def test_a_diagnosis_without_recordings_is_refused(damped):
    with pytest.raises(ValueError, match="hand over what diagnose"):
        learn_remainder(replace(damped, recordings=()))


def test_takes_of_several_gains_are_refused(damped):
    servo = [replace(r, torque_command=None, position_target=r.position, kp=np.array([k]), kd=np.array([1.0]))
             for r, k in zip(damped.recordings, (10.0, 20.0), strict=True)]  # fmt: skip
    with pytest.raises(ValueError, match="several gains"):
        driven_robot(damped.xml, servo)
    with pytest.raises(ValueError, match="several gains"):
        driven_robot(damped.xml, [servo[0], replace(servo[0], kd=np.array([2.0]))])
    robot = driven_robot(damped.xml, servo[:1])
    assert (robot.kp, robot.kd) == ((10.0,), (1.0,))


def test_what_no_policys_simulation_acts_out_is_left_to_the_net():
    by_name = {e.name: e for e in CATALOGUE}
    model, names = mujoco.MjModel.from_xml_string(pendulum()), ("pendulum",)
    address = JointAddress.of(model, names)
    kinds = [by_name["viscous_friction"], by_name["load_dependent_friction"]]
    terms = tuple(Candidate(e, 0, "pendulum", e.parameters(model, address, 0)) for e in kinds)
    for order, values in ((terms, [0.2, 0.3, 0.1]), (terms[::-1], [0.3, 0.1, 0.2])):
        kept = acted_out(Simulation(model, names, Hypothesis(order), np.array(values)))
        assert [c.effect.name for c in kept.hypothesis.terms] == ["viscous_friction"]
        np.testing.assert_array_equal(kept.values, [0.2])
    trimmed = Simulation(model, names, Hypothesis(terms[1:], terms[:1]), np.array([0.3, 0.1, 0.2]))
    kept = acted_out(trimmed)  # what was adjusted within tolerances is acted out with the model
    assert (kept.hypothesis.terms, kept.hypothesis.trims) == ((), terms[:1])
    np.testing.assert_array_equal(kept.values, [0.2])


def test_a_remark_names_what_the_net_stands_in_for_and_says_when_it_does_not_help():
    def fit(after: float) -> Score:
        return Score(1.0, after, 0.0, 0.0, {})

    helped = _remark({"train": fit(0.5)}, {"train_uan": fit(0.4)}, ["backlash of knee"])
    assert helped == (
        "A UAN in place of backlash of knee takes another 20 % off the error on recordings that it was fitted on."
    )
    for after in (0.5, 0.6):
        assert "does not help on recordings kept aside" in _remark(
            {"heldout": fit(0.5)}, {"heldout_uan": fit(after)}, []
        )


def test_behind_a_servo_it_sees_the_errors_of_the_target():
    gains = {"kp": np.array([8.0]), "kd": np.array([0.5])}
    swing = [record(pendulum(joint='damping="0.4"'), smooth_torque(3.0, 1.2, seed=k), noise=1e-4, seed=k, **gains)
             for k in (0, 1)]  # fmt: skip
    found = diagnose(pendulum(), swing[:1], swing[1:], catalogue=())
    robot = driven_robot(found.xml, found.recordings)

    class Softer(nn.Module):  # a softer servo, and the damping that is missing
        def forward(self, errors: torch.Tensor) -> torch.Tensor:
            return -2.0 * errors[..., 19:20] + 0.35 * errors[..., -1:]

    class Damped(nn.Module):
        def forward(self, errors: torch.Tensor) -> torch.Tensor:
            return 0.35 * errors[..., -1:]

    right = scored(found, found.nominal, Damped(), robot, "heldout")
    assert right.after < 0.1 * right.before
    softer = replace(swing[1], kp=np.array([6.0]))
    soft = scored(replace(found, heldout=(softer,)), found.nominal, Damped(), robot, "heldout")
    same = scored(found, found.nominal, Softer(), robot, "heldout")
    assert same.after == pytest.approx(soft.after, rel=0.02)  # the newest position error is that of the target


def test_a_run_goes_on_in_the_folder_of_its_own_diagnosis_and_arguments(damped, tmp_path):
    run = {"minutes": 1.0, "rows": 2, "rate": 1e-3, "iterations": None}
    reseeded = replace(damped, answer=replace(damped.answer, seed=7))
    fewer = replace(damped, recordings=damped.recordings[:1])
    friction = Simulation(damped.nominal.model, ("pendulum",), *named_friction(damped.nominal.model))
    others = [{**run, name: 3} for name in run]
    folders = [remainder._checkpoints(damped, tmp_path, told).folder for told in (run, *others)]
    changed = (reseeded, fewer, replace(damped, corrected=friction))
    folders += [remainder._checkpoints(other, tmp_path, run).folder for other in changed]
    assert len(set(folders)) == 8
    assert remainder._checkpoints(damped, tmp_path, dict(run)).folder == folders[0]


def named_friction(model):
    viscous = ONLY_VISCOUS[0]
    term = Candidate(viscous, 0, "pendulum", viscous.parameters(model, JointAddress.of(model, ("pendulum",)), 0))
    return Hypothesis((term,)), np.array([0.1])


def test_seeds_rates_and_times_reach_the_training_and_what_is_left_out_the_remark(damped, tmp_path, monkeypatch):
    told = {}

    def noting(name, answer=None):
        return lambda *arguments, **options: told.setdefault(name, (arguments, options)) and answer

    for name in ("replay_env", "GradientLearner", "train", "_checkpoints", "save_checkpoint"):
        monkeypatch.setattr(remainder, name, noting(name, name))
    monkeypatch.setattr(remainder, "DifferentiableTorqueEnv", noting("base", "base"))
    monkeypatch.setattr(remainder, "scored", lambda diagnosis, *told: diagnosis.answer.fit[told[-1]])
    monkeypatch.setattr(torch, "manual_seed", noting("seed"))
    monkeypatch.setattr(remainder, "corrected_xml", noting("xml", damped.xml))
    address = JointAddress.of(damped.nominal.model, ("pendulum",))
    [effect] = (e for e in CATALOGUE if e.name == "load_dependent_friction")
    term = Candidate(effect, 0, "pendulum", effect.parameters(damped.nominal.model, address, 0))
    usual = np.array([parameter.nominal for parameter in term.parameters])
    loaded = Simulation(damped.nominal.model, ("pendulum",), Hypothesis((term,)), usual)
    answer = replace(damped.answer, seed=7, remarks=("said before",))
    diagnosis = replace(damped, answer=answer, corrected=loaded)
    found = learn_remainder(diagnosis, tmp_path, minutes=3.0, rows=5, rate=4e-3, iterations=9, progress=False)
    assert found.answer.remarks[:-1] == ("said before",)
    assert found.answer.remarks[-1].startswith("A UAN in place of load dependent friction of pendulum")
    scores = {f"{split}_uan": score for split, score in damped.answer.fit.items()}
    assert found.answer.fit == {**damped.answer.fit, **scores}
    assert told["save_checkpoint"][0][1] == {"hidden": [32, 32], "history": 20}
    assert told["seed"][0] == (7,)
    (xml, named), options = told["xml"]
    assert (xml, named.hypothesis.terms, options) == (damped.xml, (), {"drive": False})  # the chain is the drive
    replayed = told["replay_env"][1]
    step = mujoco.MjModel.from_xml_string(pendulum()).opt.timestep
    assert (replayed["seed"], replayed["base"], replayed["unit"].tolist()) == (7, "base", [1.0])
    assert replayed["max_steps"] * step == pytest.approx(0.5)
    assert told["base"][1] == {"num_envs": 5}
    assert told["GradientLearner"][1] == {"minutes": 3.0, "rate": 4e-3}
    assert told["_checkpoints"][0][2] == {"minutes": 3.0, "rows": 5, "rate": 4e-3, "iterations": 9}
    options = told["train"][1]
    assert (options["minutes"], options["iterations"], options["checkpoints"]) == (3.0, 9, "_checkpoints")
    assert (options["progress"], options["show"]) == (False, ["train_mse"])
    told.clear()  # without takes kept aside, and nowhere to write to
    alone = replace(answer, fit={"train": answer.fit["train"]})
    found = learn_remainder(replace(diagnosis, heldout=(), answer=alone), progress=False)
    assert found.answer.fit.keys() == {"train", "train_uan"}
    assert told["train"][1]["checkpoints"] is None
    assert "save_checkpoint" not in told


def test_a_score_without_a_net_is_the_diagnosis_own_to_its_noise(damped):
    """Its draws and what repeats itself in the takes are those of the split."""
    robot = driven_robot(damped.xml, damped.recordings)
    for split, given in damped.answer.fit.items():
        found = scored(damped, damped.corrected, Brake(0.0), robot, split)
        assert found.before == pytest.approx(given.before, rel=1e-6), split
        assert found.floor == pytest.approx(given.floor, rel=0.01), split  # a little was adjusted then


def test_a_net_sees_what_the_motor_gives_at_last(damped):
    robot = driven_robot(damped.xml, damped.recordings)
    model = damped.nominal.model
    plant = Plant(model, JointAddress.of(model, robot.joint_names), 1)
    late = lambda now: now.torque  # noqa: E731
    plant.motor.append(late)
    WithNet((), (), Brake(0.1), robot).build(plant, np.ones((1, 1)))
    assert plant.motor[0] is late
    assert plant.motor[-1] == plant.laws[-1].note


@pytest.mark.parametrize("driven", ["position", "torque"])
def test_commands_reach_the_corrected_joints_as_the_robots_own_motors_would_act_on_them(driven, monkeypatch):
    told = {}
    monkeypatch.setattr(remainder, "CorrectedActuation", lambda found, **options: told.update(options) or found)
    bare = driven_robot(THREE, [SimpleNamespace(kp=None, kd=None)])
    assert (bare.kp, bare.kd) == ((1.0,) * 3, (0.0,) * 3)  # a torque is the error of position, whatever the velocity
    robot = replace(bare, kp=(3.0, 4.0, 5.0), kd=(0.3, 0.4, 0.5))
    law, *behind = remainder.chain_of(SimpleNamespace(to_json=lambda: "found"), robot, driven)
    servo = {"kp": robot.kp, "kd": robot.kd} if driven == "position" else {"kp": None, "kd": None}
    limits = {"timestep": 0.005, "joint_names": robot.joint_names, "torque_limit": (10.0, 20.0, 30.0)}
    assert (law, told) == ("found", servo | limits)
    assert [type(part).__name__ for part in behind] == ([] if driven == "position" else ["EquivalentTarget"])
    for part in behind:
        assert part.kp.tolist() == [3.0, 4.0, 5.0]
        assert part.kd.tolist() == pytest.approx([0.3, 0.4, 0.5])


def test_a_net_is_scored_beside_what_is_named_and_what_was_adjusted(damped, monkeypatch):
    asked, net = [], Brake(0.1)
    monkeypatch.setattr(remainder, "score", lambda *told: asked.append(told) or ["found"])
    noted = SimpleNamespace(takes="takes", position_noise="noise", repeatability="repeats")
    monkeypatch.setattr(remainder, "prepare", lambda takes, model: asked.append((takes, model)) or noted)
    (named,) = named_friction(damped.nominal.model)[0].terms
    robot = driven_robot(damped.xml, damped.recordings)
    for whole in (Hypothesis((named,), ()), Hypothesis((), (named,))):
        corrected = Simulation(copy(damped.nominal.model), ("pendulum",), whole, np.array([0.3]))
        for split, recordings in (("train", damped.recordings), ("heldout", damped.heldout)):
            assert scored(damped, corrected, net, robot, split) == "found"
            taken, (takes, hypothesis, values, noise, _, repeats) = asked
            assert taken == (recordings, corrected.model)
            assert (takes, noise, repeats) == ("takes", "noise", "repeats")
            asked.clear()
        assert (hypothesis.terms, hypothesis.trims, hypothesis.net) == (whole.terms, whole.trims, net)
        assert values.tolist() == [0.3, 1.0]


@pytest.mark.parametrize(("step", "stride"), [("0.003", 3), ("0.009", 1), ("0.02", 1)])
def test_a_period_of_the_robot_is_a_whole_number_of_steps_of_the_simulation(step, stride):
    """Though 0.009 / 0.003 is a little less than 3 to a computer; in a coarser one it sees each step."""
    robot = driven_robot(THREE.replace("0.005", "0.009"), [SimpleNamespace(kp=None, kd=None)])
    model = mujoco.MjModel.from_xml_string(THREE.replace("0.005", step))
    plant = Plant(model, JointAddress.of(model, robot.joint_names), 1)
    assert LearnedTorque(Brake(0.0), robot, plant, np.ones((1, 1))).stride == stride


def test_what_sensors_of_torque_read_is_no_part_of_a_training():
    still = np.zeros((40, 3))
    logged = ("three", "one", "two")
    torques = {"torque_command": still, "torque_measured": still, "torque_semantics": "link_side"}
    take = Recording(np.arange(40) * 0.005, logged, still + np.array([3.0, 1.0, 2.0]), **torques)
    found = remainder._named(take, driven_robot(THREE, [take]))
    assert (found.torque_measured, found.torque_semantics) == (None, None)
    assert found.joint_names == ("one", "two", "three")
    assert found.position[0].tolist() == [1.0, 2.0, 3.0]
