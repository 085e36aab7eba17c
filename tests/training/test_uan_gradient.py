"""The gradient that goes through the simulator is the simulator's own."""

import math
from copy import deepcopy
from dataclasses import replace

import pytest
import torch
from identification.arms import commands, recorded, robot
from tensordict import TensorDict

from torchrl_athletic.envs import TorqueEnv, replay_env
from torchrl_athletic.identification import Simulator
from torchrl_athletic.networks import uan
from torchrl_athletic.robots import b2z1, from_mjcf, z1
from torchrl_athletic.training import (
    DifferentiableTorqueEnv,
    GradientLearner,
    control_step,
    descend,
    set_aside,
    takes_of,
    torque_unit,
    train,
    units_of,
    validation_of,
)

PENDULUM = """
<mujoco model="pendulum">
  <option timestep="0.005" integrator="implicitfast"/>
  <worldbody>
    <body>
      <joint name="hinge" axis="0 1 0" damping="0.4"/>
      <inertial pos="0 0 -0.5" mass="2" diaginertia="0.01 0.01 0.01"/>
    </body>
  </worldbody>
  <actuator><motor joint="hinge" forcerange="-30 30"/></actuator>
</mujoco>"""


def test_the_derivative_of_a_step_is_that_of_a_pendulum():
    """Derivatives of v' = v + h (I + h d)⁻¹ (τ - d v - m g l sin q) and q' = q + h v', by q, v and τ."""
    h, inertia, damping, weight = 0.005, 0.01 + 2 * 0.25, 0.4, 2 * 9.81 * 0.5
    env = DifferentiableTorqueEnv(from_mjcf(PENDULUM), num_envs=1)
    shown = env.reset()
    env.physics.qpos[:], env.physics.qvel[:] = 0.7, -1.5
    given = {"joint_position": 0.7, "joint_velocity": -1.5, "torque": 2.0}
    leaves = {name: torch.full((1, 1), value, requires_grad=True) for name, value in given.items()}
    after = env._step(shown.update(leaves))
    gain = h / (inertia + h * damping)
    by_state = {"joint_position": -gain * weight * math.cos(0.7), "joint_velocity": 1 - gain * damping, "torque": gain}
    for name, leaf in leaves.items():
        speed = torch.autograd.grad(after["joint_velocity"].sum(), leaf, retain_graph=True)[0].item()
        place = torch.autograd.grad(after["joint_position"].sum(), leaf, retain_graph=True)[0].item()
        assert speed == pytest.approx(by_state[name], rel=1e-3)
        assert place == pytest.approx(h * by_state[name] + (name == "joint_position"), rel=1e-3)


def take(seed=0, samples=600):
    """Take of an arm with twice the friction, which is what a net has to learn."""
    real = replace(robot(), build=lambda: _stiff(robot().spec()))
    return recorded(Simulator("real", real), commands(samples, seed=seed))


def _stiff(spec):
    for joint in spec.joints:
        joint.damping[0] *= 4.0
        joint.frictionloss *= 3.0
    return spec


def replayed(net, num_envs=4, max_steps=400):
    base = DifferentiableTorqueEnv(robot(), num_envs=num_envs)
    return replay_env(robot(), takes_of([take()], robot()), base=base, unit=torque_unit(net), max_steps=max_steps)


def test_the_gradient_of_a_replay_is_its_slope():
    """By the correction of the first of five steps, against the error that follows, nudged for real."""
    net = uan()
    env = replayed(net, num_envs=2)
    env.transform[-1].by_row, env.transform[-1].starts = True, torch.tensor([200, 330])

    def error(first):
        following, total = env.reset(), 0.0
        for k in range(5):
            action = first if k == 0 else torch.zeros(2, 2)
            step, following = control_step(env, lambda td, action=action: td.set("action", action), following)
            total = total + step["next", "privileged"][..., 0].square().sum()
        return total

    action = torch.tensor([[0.5, -0.3], [1.0, 0.2]], requires_grad=True)
    slope = torch.autograd.grad(error(action), action)[0]
    with torch.no_grad():
        for row, joint in ((0, 0), (0, 1), (1, 0), (1, 1)):
            nudge = torch.zeros(2, 2)
            nudge[row, joint] = 0.1
            measured = (error(action + nudge) - error(action - nudge)) / 0.2
            assert slope[row, joint].item() == pytest.approx(measured.item(), rel=0.05, abs=1e-7)


def learner_of(net, **options):
    return GradientLearner(replayed(net, num_envs=8), net, minutes=1.0, windows=(16,), **options)


def test_a_jacobian_measured_along_the_recording_is_the_one_measured_there(monkeypatch):
    """At samples that were measured, before a correction has led away from them."""
    takes = takes_of([take()], robot())
    slopes = []
    for along in (None, takes):
        base = DifferentiableTorqueEnv(robot(), num_envs=3, along=along)
        env = replay_env(robot(), takes, base=base, num_envs=3, by_row=True, starts=torch.tensor([200, 328, 480]))
        if along is not None:
            monkeypatch.setattr(base, "_nudge_copies", None)  # nothing is measured any more
        action = torch.zeros(3, 2, requires_grad=True)
        after = env._step(env.reset().set("action", action))
        weights = torch.tensor([[[1.0, 0.1], [-2.0, 0.3]]])
        slopes.append(torch.autograd.grad((weights * after["privileged"]).sum(), action)[0])
    torch.testing.assert_close(slopes[0], slopes[1], rtol=1e-3, atol=1e-7)
    assert slopes[0].abs().min() > 1e-5


def test_a_jacobian_belongs_to_the_take_of_its_sample():
    """Where a take begins, none of the one before is used: the second arm hangs, the first was upright."""
    up, down = (replace(take(samples=205), position=take(samples=205).position + x) for x in (2.0, 0.0))
    both = takes_of([up, down], robot())
    jacobians, of_sample = DifferentiableTorqueEnv(robot(), num_envs=3, along=both).known
    alone, of_alone = DifferentiableTorqueEnv(robot(), num_envs=3, along=takes_of([down], robot())).known
    torch.testing.assert_close(jacobians[of_sample[205:]], alone[of_alone])
    assert (jacobians[of_sample[204]] - alone[0]).abs().max() > 1e-3
    assert of_sample[:17].tolist() == [0] * 8 + [1] * 8 + [2]


def test_a_row_that_is_lost_is_charged_and_counted():
    learner = learner_of(uan())
    sound = descend(learner)
    assert sound["lost"] == 0
    learner.env.transform[-1].bound = 1e-4
    report = descend(learner)
    assert report["lost"] == 1.0
    assert 0.3e-8 < report["train_mse"] <= 1e-8


def test_errors_far_beyond_what_is_usual_hardly_pull_and_small_ones_pull_as_ever():
    lengths, errors = [], []
    for outlier in (None, 10.0, 1e-4):
        torch.manual_seed(0)
        learner = learner_of(uan())
        learner.outlier = outlier
        report = descend(learner)
        lengths.append(float(report["grad_norm"]))
        errors.append(float(report["train_mse"]))
    assert errors[0] == errors[1] == errors[2]
    assert lengths[1] == pytest.approx(lengths[0], rel=1e-2)
    assert lengths[2] < 0.1 * lengths[0]


@pytest.mark.parametrize("known", [False, pytest.param(True, marks=pytest.mark.slow)])
def test_it_learns_friction_from_encoders_alone(known):
    """In 40 windows the error of windows that it never saw falls to less than half."""
    torch.manual_seed(0)
    pieces, windows = set_aside([take(seed) for seed in (0, 1)], seconds=1.0)
    takes = takes_of(pieces, robot())
    net = uan(**units_of(takes, robot()))
    validate = validation_of(Simulator("uan", robot()), windows, net)
    before = validate()["mse"]
    base = DifferentiableTorqueEnv(robot(), num_envs=8, along=takes if known else None)
    env = replay_env(robot(), takes, base=base, unit=torque_unit(net), max_steps=100)
    learner = GradientLearner(env, net, minutes=1.0, rate=3e-3, windows=(16,))
    train(learner, iterations=40, step=descend, progress=False)
    assert validate()["mse"] < before / 2


def rates_of(learner):
    return [group["lr"] for group in learner.optimizer.param_groups]


def test_windows_grow_and_the_rate_falls_with_the_time():
    learner = learner_of(uan())
    learner.windows, learner.usual = (4, 8, 16), math.inf  # no gradient counts as exploded
    seen = []
    for share in (0.0, 0.5, 0.99):
        learner.seconds = 60 * share
        report = descend(learner)
        seen.append((report["window"].item(), report["rate"].item()))
        assert rates_of(learner) == pytest.approx([seen[-1][1]])  # it is what the optimiser steps with
    assert [window for window, _ in seen] == [4, 8, 16]
    assert seen[0][1] == pytest.approx(learner.rate)
    assert seen[1][1] == pytest.approx(learner.rate / 2)
    assert seen[2][1] < learner.rate / 100
    assert learner.samples == 8 * (4 + 8 + 16)


def test_planned_by_iterations_a_run_does_not_depend_on_the_time():
    planned = learner_of(uan())
    planned.windows, planned.iterations = (4, 8), 4
    seen = []
    for seconds in (0.0, 59.0, 1.0, 30.0):
        planned.seconds = seconds
        report = descend(planned)
        seen.append((report["window"].item(), report["rate"].item() / planned.rate))
    assert [window for window, _ in seen] == [4, 4, 8, 8]
    expected = [0.5 * (1 + math.cos(math.pi * share)) for share in (0.0, 0.25, 0.5, 0.75)]
    assert [rate for _, rate in seen] == pytest.approx(expected)


def test_a_net_whose_gradient_explodes_is_taken_back_and_goes_on_at_half_the_rate():
    learner = learner_of(uan())
    kept = deepcopy(learner.kept[0])
    descend(learner)
    sound = learner.env.base_env._jacobian
    learner.env.base_env._jacobian = lambda: torch.full((8, 6, 4), 50.0)
    assert not descend(learner)["grad_norm"] < 20 * learner.usual  # not a number, here
    for name, value in learner.net.state_dict().items():
        assert name.endswith("extra_state") or (value == kept[name]).all()
    learner.env.base_env._jacobian = sound
    assert descend(learner)["rate"].item() == pytest.approx(learner.rate / 2)
    assert rates_of(learner) == pytest.approx([learner.rate / 2])
    assert all(parameter.isfinite().all() for parameter in learner.net.parameters())


def test_it_goes_on_where_it_was():
    torch.manual_seed(1)
    first, second = learner_of(uan()), learner_of(uan())
    descend(first)
    second.load_state_dict(deepcopy(first.state_dict()))
    for learner in (first, second):
        descend(learner)
    for one, other in zip(first.net.parameters(), second.net.parameters(), strict=True):
        torch.testing.assert_close(one, other)
    assert second.iteration == 2


def test_it_is_taken_back_to_the_states_that_were_kept_before_it_was_interrupted():
    first, second = learner_of(uan()), learner_of(uan())
    for _ in range(3):
        descend(first)
    second.load_state_dict(deepcopy(first.state_dict()))
    for learner in (first, second):
        learner.step_back()
    for one, other in zip(first.net.parameters(), second.net.parameters(), strict=True):
        torch.testing.assert_close(one, other, rtol=0, atol=0)


def test_a_state_holds_every_count_and_does_not_go_on_with_the_replay():
    first, second = learner_of(uan()), learner_of(uan())
    descend(first)
    counts = {"iteration": 3, "samples": 400, "seconds": 5.5, "caution": 0.25, "usual": 7.0}
    for name, count in counts.items():
        setattr(first, name, count)
    state = first.state_dict()
    stood = deepcopy(state)
    for value in first.current.values():
        value.zero_()
    descend(first)
    for name, value in stood["current"].items():
        assert value.equal(state["current"][name]), name
    second.load_state_dict(stood)
    assert {name: getattr(second, name) for name in counts} == counts


def test_the_state_that_a_net_is_taken_back_to_is_between_one_and_two_intervals_old(monkeypatch):
    monkeypatch.setattr("torchrl_athletic.training.uan_gradient.STEADY", 2)
    learner = learner_of(uan())
    learner.windows, states = (1,), [deepcopy(learner.net.state_dict())]
    for _ in range(6):
        descend(learner)
        states.append(deepcopy(learner.net.state_dict()))
    for kept, wanted in zip(learner.kept, (states[3], states[5]), strict=True):  # after the third and the fifth
        for name, value in wanted.items():
            assert name.endswith("extra_state") or kept[name].equal(value), name
    learner.step_back()
    for kept in (*learner.kept, learner.net.state_dict()):
        for name, value in states[3].items():
            assert name.endswith("extra_state") or kept[name].equal(value), name


def test_what_is_usual_follows_the_gradients_slowly_and_the_state_to_go_back_to_later_still():
    learner = learner_of(uan())
    learner.windows, lengths, began = (2,), [], deepcopy(learner.net.state_dict())
    for _ in range(3):
        lengths.append(float(descend(learner)["grad_norm"]))
    usual = lengths[0]
    for length in lengths:
        usual = 0.95 * usual + 0.05 * length
    assert learner.usual == pytest.approx(usual)
    for name, value in began.items():  # nor is what it is taken back to renewed at each window
        assert name.endswith("extra_state") or learner.kept[0][name].equal(value), name


def test_gradients_may_pass_through_some_joints_alone_each_nudged_by_its_own_strength():
    """A second joint alone has the gradient that both joints give it, and its torque is nudged by its own limit."""
    arm = replace(robot(), torque_limit=(10.0, 40.0))
    slopes = []
    for joints in (None, (1,)):
        env = DifferentiableTorqueEnv(arm, joints=joints, num_envs=1)
        shown = env.reset()
        torque = torch.tensor([[0.3, -0.2]], requires_grad=True)
        after = env._step(shown.set("torque", torque))
        slopes.append(torch.autograd.grad(after["joint_velocity"][0, 1], torque)[0])
        assert env.steps[-1] == pytest.approx(40e-3)
    assert slopes[1][0, 0] == 0
    torch.testing.assert_close(slopes[0][0, 1], slopes[1][0, 1], rtol=1e-2, atol=0)
    assert slopes[0][0, 1] > 0


def test_jacobians_along_takes_of_torques_are_measured_under_those_torques(monkeypatch):
    applied = []
    nudged = DifferentiableTorqueEnv._nudge_copies
    monkeypatch.setattr(
        DifferentiableTorqueEnv,
        "_nudge_copies",
        lambda env, torque: applied.append(torque.clone()) or nudged(env, torque),
    )
    seen, arm = takes_of([take(samples=60)], robot()), robot()
    DifferentiableTorqueEnv(arm, num_envs=8, along=seen)
    DifferentiableTorqueEnv(arm, num_envs=8, along=replace(seen, driven="torque"))
    kp, kd = torch.tensor(arm.kp), torch.tensor(arm.kd)
    servo = kp * (seen.command - seen.position) - kd * seen.velocity
    torch.testing.assert_close(applied[0], servo[::8])  # at every eighth sample
    torch.testing.assert_close(applied[-1], seen.command[::8])
    assert (applied[0] - applied[-1]).abs().max() > 0.1


def test_what_follows_a_loss_in_a_window_is_charged_though_the_row_tracks_well_again(monkeypatch):
    learner = learner_of(uan())
    learner.windows, weight, times = (4,), next(learner.net.parameters()), iter(range(4))
    lost = torch.tensor([[[0], [1], [0], [0]], [[0], [0], [0], [0]]], dtype=torch.bool)

    def scripted(env, policy, following):
        t = next(times)
        error = 0.1 * torch.ones(2, 2, 2) + 0.0 * weight.sum()
        after = {"privileged": error, "terminated": lost[:, t], "reward": torch.full((2, 1), float(t))}
        return TensorDict(next=TensorDict(after, [2]), batch_size=[2]), following

    monkeypatch.setattr("torchrl_athletic.training.uan_gradient.control_step", scripted)
    report = descend(learner)
    assert report["lost"] == 0.5
    assert report["train_mse"].item() == pytest.approx((3 * learner.env.transform[-1].bound ** 2 + 5 * 0.01) / 8)
    assert report["reward"] == 1.5


def test_a_step_follows_its_own_windows_gradient_and_no_longer_a_one_than_is_allowed():
    twins = [learner_of(uan(), max_grad_norm=1e-3) for _ in range(2)]
    twins[1].load_state_dict(deepcopy(twins[0].state_dict()))
    for parameter in twins[1].net.parameters():
        parameter.grad = torch.full_like(parameter, 1e3)  # of a window before
    for learner in twins:
        assert descend(learner)["grad_norm"] > 1e-3
        length = torch.stack([p.grad.norm() for p in learner.net.parameters() if p.grad is not None]).norm()
        assert length.item() == pytest.approx(1e-3, rel=1e-3)
    for one, other in zip(*(learner.net.parameters() for learner in twins), strict=True):
        torch.testing.assert_close(one, other, rtol=0, atol=0)


def test_a_net_that_is_taken_back_begins_new_episodes_and_forgets_how_it_was_moved():
    learner = learner_of(uan())
    descend(learner)
    assert learner.optimizer.state
    left = learner.current
    learner.step_back()
    assert not learner.optimizer.state
    assert learner.current is not left
    assert not learner.current["torque_correction"].any()
    assert {id(p) for group in learner.optimizer.param_groups for p in group["params"]} == {
        id(p) for p in learner.net.parameters()
    }


def test_episodes_of_a_learner_do_not_all_end_at_once_and_its_time_ends():
    learner = GradientLearner(replayed(uan(), num_envs=32, max_steps=50), uan(), minutes=1.0, windows=(2, 4))
    left = learner.current["steps_left"]
    assert left.unique().numel() > 12
    assert left.min() >= 1
    learner.seconds = 90.0  # later than planned it stands still, and does not take off again
    assert (learner.share, learner.window) == (1.0, 4)
    assert descend(learner)["rate"] == pytest.approx(0.0, abs=1e-12)


def test_a_motor_without_a_limit_is_nudged_as_a_strong_one():
    arm = replace(robot(), torque_limit=(math.inf, 40.0))
    steps = DifferentiableTorqueEnv(arm, num_envs=1).steps
    torch.testing.assert_close(steps.float(), torch.tensor([1e-3] * 4 + [0.1, 0.04]))


def test_a_walking_robot_and_no_time_are_refused():
    with pytest.raises(ValueError, match="Bolt it to the world"):
        DifferentiableTorqueEnv(b2z1())
    with pytest.raises(ValueError, match="minutes is 0"):
        GradientLearner(replayed(uan()), uan(), minutes=0.0)


def test_copies_of_a_row_begin_as_the_row_does_but_for_what_is_nudged(monkeypatch):
    """Also the solver, so that no difference is its own; two rows, so that none is taken for the other."""
    env = DifferentiableTorqueEnv(robot(), num_envs=2)
    env.reset()
    env.physics.qpos[:], env.physics.qvel[:] = torch.tensor([[0.1, 0.2], [0.3, 0.4]]), torch.tensor([[1.0, 2], [3, 4]])
    env.physics.data("qacc_warmstart")[:] = torch.tensor([[5.0, 6.0], [7.0, 8.0]])
    monkeypatch.setattr(env.copies, "step", lambda: None)
    env._nudge_copies(torch.zeros(2, 2))
    of_row = {"qpos": env.copies.qpos, "qvel": env.copies.qvel, "warm": env.copies.data("qacc_warmstart")}
    moved = {name: copies.unflatten(0, (2, 6)) for name, copies in of_row.items()}
    for row in range(2):
        place, speed = moved["qpos"][row] - env.physics.qpos[row], moved["qvel"][row] - env.physics.qvel[row]
        one = torch.zeros(6, 2, dtype=place.dtype)
        one[[0, 1], [0, 1]] = 1e-3
        torch.testing.assert_close(place, one)
        torch.testing.assert_close(speed, one.roll(2, 0))
        assert moved["warm"][row].equal(env.physics.data("qacc_warmstart")[row].expand(6, 2))


def test_a_row_that_is_no_number_any_more_has_no_slope():
    env = DifferentiableTorqueEnv(robot(), num_envs=2)
    env.reset()
    env._nudge_copies(torch.zeros(2, 2))
    env.physics.step()
    env.copies.qvel[0], env.physics.qvel[1] = torch.nan, torch.inf
    jacobian = env._jacobian()
    assert jacobian.isfinite().all()
    assert not jacobian[1, :, 2:].any()
    assert jacobian[0, 1:].any()


def test_a_gradient_that_is_twenty_times_as_long_as_usual_has_exploded(monkeypatch):
    """Here every window's is as long as the last one's. Windows and rates go by the iterations, if they are told."""
    learner = learner_of(uan(), iterations=8, outlier=1e3)
    learner.windows, weight = (1,), next(learner.net.parameters())
    length = 1e4 * 2 * 0.01

    def scripted(env, policy, following):
        after = {"privileged": weight.flatten()[0].expand(2, 1, 2), "terminated": torch.zeros(2, 1, dtype=torch.bool)}
        return TensorDict(next=TensorDict({**after, "reward": torch.zeros(2, 1)}, [2]), batch_size=[2]), following

    monkeypatch.setattr("torchrl_athletic.training.uan_gradient.control_step", scripted)
    for times, caution in ((19.0, 1.0), (21.0, 0.5)):
        torch.nn.init.constant_(weight, 0.01)
        learner.usual = length / times
        assert float(descend(learner)["grad_norm"]) == pytest.approx(length, rel=1e-3)
        assert learner.caution == caution
    assert (learner.share, learner.outlier) == (2 / 8, 1e3)
    learner.outlier, learner.usual = 0.01, length
    torch.nn.init.constant_(weight, 0.01)  # an error as large as that pulls half as much
    assert float(descend(learner)["grad_norm"]) == pytest.approx(length / 2, rel=1e-3)


def test_rows_are_made_where_they_are_asked_for_and_read_nothing_but_joints(monkeypatch):
    made = []

    def refuse(env, robot, **told):
        made.append((robot.sensors, told))
        raise NotImplementedError

    monkeypatch.setattr(TorqueEnv, "__init__", refuse)
    with pytest.raises(NotImplementedError):
        DifferentiableTorqueEnv(z1(), num_envs=3, device="cuda:1")
    assert made == [({}, {"num_envs": 3, "device": "cuda:1"})]


@pytest.mark.parametrize("known", [False, True])
def test_joints_may_be_told_in_another_order_than_the_model_has_them(known):
    """Each slope is that of the same joint, measured where the arm is or along takes of it."""
    arm = robot()
    names = ("joint_names", "default_pose", "kp", "kd", "torque_limit", "velocity_limit", "position_limit")
    turned = replace(arm, **{name: getattr(arm, name)[::-1] for name in names}, joint_groups={})
    took, slopes = take(samples=60), []
    assert arm.torque_limit[0] != arm.torque_limit[1]
    for each in (arm, turned):
        env = DifferentiableTorqueEnv(each, num_envs=8, along=takes_of([took], each) if known else None)
        if not known:
            shown = env.reset()
            by_name = torch.tensor([0.4, -0.9]) if each is arm else torch.tensor([-0.9, 0.4])
            env._nudge_copies(by_name.expand(8, 2))
            env.physics.apply_torque(by_name.expand(8, 2))
            env.physics.step()
            assert shown["joint_position"].shape == (8, 2)
        jacobian = env._jacobian() if env.known is None else env.known[0]
        slopes.append(jacobian.unflatten(-1, (2, 2)).unflatten(1, (3, 2)))
    torch.testing.assert_close(slopes[1], slopes[0].flip(2, 4), rtol=1e-3, atol=1e-5)
    assert (slopes[1] - slopes[0]).abs().max() > 1e-3
