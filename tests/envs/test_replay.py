"""Replays start where the robot was, do what it was told, and tell how far the simulation comes from what it did."""

from dataclasses import replace
from types import SimpleNamespace

import mujoco
import numpy as np
import pytest
import torch
from identification.arms import commands, last_layer, recorded, robot
from tensordict import TensorDict
from torchrl.envs import Compose, TransformedEnv
from torchrl.envs.utils import check_env_specs

from torchrl_athletic.envs import ReplayTakes, Takes, TorqueEnv, replay_env
from torchrl_athletic.envs.replay import HISTORY, AddedTorque, _start_of
from torchrl_athletic.functional import actuator_dynamics, rewards
from torchrl_athletic.identification import Simulator, open_loop
from torchrl_athletic.networks import uan
from torchrl_athletic.robots import b2z1, with_options, z1
from torchrl_athletic.testing import no_host_sync
from torchrl_athletic.training import control_step, takes_of, torque_unit
from torchrl_athletic.transforms import EquivalentTarget, PDControl, TorqueSpeedClip, UANCorrection

ROBOT = robot()
DT = 0.005


def takes(lengths=(90, 60), torques=False):
    """Takes of the simulator itself: a replay of them without correction stays on them."""
    simulator = Simulator("itself", ROBOT)
    scale = 3.0 if torques else 0.5
    return takes_of([recorded(simulator, commands(n, seed=n, scale=scale, hold=15), torques) for n in lengths], ROBOT)


TAKES = takes()


def nothing(tensordict):
    return tensordict.set("action", torch.zeros_like(tensordict["torque_correction"]))


def played(env, policy, steps):
    """Shape (N, T)."""
    following, out = env.reset(), []
    for _ in range(steps):
        step, following = control_step(env, policy, following)
        out.append(step.clone())
    return torch.stack(out, 1)


def moved_net(state=False, seed=3, memory=()):
    torch.manual_seed(seed)
    told = {"joints": 2, "state_unit": [1.0, 1.0, 5.0, 5.0, 10.0, 10.0]} if state else {}
    net = uan(unit=(0.2, 2.0), torque_unit=[1.0, 1.5], memory=memory, **told)
    torch.nn.init.normal_(last_layer(net).weight, std=0.3)
    return net


def test_specs_match_the_data():
    check_env_specs(replay_env(ROBOT, TAKES, num_envs=2, max_steps=30))


@pytest.mark.parametrize("torques", [False, True])
def test_a_simulation_stays_on_takes_of_itself_and_earns_the_most(torques):
    env = replay_env(ROBOT, takes(torques=torques), num_envs=8)
    steps = played(env, nothing, 50)
    assert steps["next", "privileged"][..., 0].abs().max() < 1e-4
    assert steps["next", "reward"].min() > DT * 13.45
    assert not steps["next", "terminated"].any()


def test_a_heavier_simulation_leaves_the_takes():
    heavy = replace(ROBOT, build=lambda: _heavier(ROBOT.spec()))
    steps = played(replay_env(heavy, TAKES, num_envs=8), nothing, 50)
    assert steps["next", "privileged"][..., 0].abs().max() > 1e-2


def test_the_critic_is_told_how_far_and_how_fast_the_simulation_is_ahead():
    heavy = replace(ROBOT, build=lambda: _heavier(ROBOT.spec()))
    after = played(replay_env(heavy, TAKES, num_envs=4), nothing, 20)["next"]
    sample = after["sample"].squeeze(-1)
    ahead = after["joint_position"] - TAKES.position[sample], after["joint_velocity"] - TAKES.velocity[sample]
    torch.testing.assert_close(after["privileged"], torch.stack(ahead, -1))
    assert ahead[1].abs().max() > 1e-3


def test_an_episode_starts_as_fast_as_an_encoder_of_another_scale_said():
    simulator = corrected({"encoder_scale": {"scale": 1.25}})
    env = replay_env(ROBOT, TAKES, chain=simulator.chain(decimation=1), num_envs=64)
    shown = env.reset()
    torch.testing.assert_close(shown["joint_velocity"], TAKES.velocity[shown["sample"].squeeze(-1)])
    knee = env.base_env.physics.qvel[:, 1].float()
    torch.testing.assert_close(1.25 * knee, shown["joint_velocity"][:, 1])
    assert knee.abs().max() > 0.1


def _heavier(spec):
    for geom in spec.geoms:
        geom.mass *= 1.5
    return spec


def test_starts_are_measured_states_with_their_own_past_and_differ():
    env = replay_env(ROBOT, TAKES, num_envs=64)
    shown = env.reset()
    sample = shown["sample"].squeeze(-1)
    torch.testing.assert_close(shown["joint_position"], TAKES.position[sample])
    torch.testing.assert_close(shown["joint_velocity"], TAKES.velocity[sample])
    for row in (0, 17):
        past = slice(int(sample[row]) - HISTORY + 1, int(sample[row]) + 1)
        errors = torch.cat((TAKES.command[past] - TAKES.position[past], -TAKES.velocity[past]), 0)
        torch.testing.assert_close(shown["observation"][row], errors.T.reshape(2, 2, HISTORY).flatten(1))
    assert sample.unique().numel() > 30
    assert (shown["privileged"] == 0).all()


def test_no_episode_begins_before_a_history_or_runs_from_one_take_into_the_next():
    env = replay_env(ROBOT, TAKES, num_envs=64)
    steps = played(env, nothing, 150)
    take = steps["sample"] < 90
    assert (take == (steps["next", "sample"] < 90)).all()
    assert steps["next", "sample"].max() == 149
    offset = torch.where(take, steps["sample"], steps["sample"] - 90)
    assert offset.min() == HISTORY - 1
    at_end = (steps["next", "sample"] == 89) | (steps["next", "sample"] == 149)
    assert (steps["next", "truncated"] == at_end).all()
    assert (steps["next", "done"] == at_end).all()


def test_an_episode_is_truncated_when_its_time_is_over_and_another_begins_elsewhere():
    steps = played(replay_env(ROBOT, TAKES, num_envs=16, max_steps=5), nothing, 12)
    full = (steps["steps_left"][:, 0] == 5).squeeze(-1)
    assert full.sum() > 8
    assert steps["next", "truncated"][full][:, 4].all()
    assert not steps["next", "truncated"][full][:, :4].any()
    jumped = steps["sample"][full][:, 5] != steps["next", "sample"][full][:, 4]
    assert jumped.float().mean() > 0.8


def test_by_row_every_start_has_its_turn():
    starts = torch.tensor([30, 40, 100])
    env = replay_env(ROBOT, TAKES, num_envs=4, by_row=True, starts=starts)
    for _ in range(2):
        assert env.reset()["sample"].flatten().tolist() == [30, 40, 100, 30]


def chain_of(net, torques, innermost):
    """Chain of a policy's environment, from the joints outwards."""
    correction = UANCorrection(net)
    limit = TorqueSpeedClip(ROBOT.torque_limit, ROBOT.velocity_limit)
    law = (EquivalentTarget if torques else PDControl)(ROBOT.kp, ROBOT.kd)
    return [correction, limit, law] if innermost else [limit, correction, law]


@pytest.mark.parametrize("torques", [False, True])
@pytest.mark.parametrize("innermost", [False, True])
def test_the_net_does_in_a_policys_chain_what_it_did_in_the_replay(torques, innermost):
    """Torques and states are the same, bit for bit where targets are given; an equivalent target has to be rounded."""
    net, data, start, steps = moved_net(), takes(torques=torques), 30, 50
    env = replay_env(
        ROBOT,
        data,
        chain=chain_of(net, torques, innermost),
        unit=torque_unit(net),
        by_row=True,
        starts=torch.tensor([start]),
    )
    with torch.no_grad():
        replayed = played(env, lambda td: td.set("action", net[:-1](td["observation"]).squeeze(-1)), steps)

    chain = TransformedEnv(TorqueEnv(ROBOT, num_envs=1), Compose(*chain_of(net, torques, innermost)))
    begin = {"reset_qpos": data.position[None, start], "reset_qvel": data.velocity[None, start]}
    chain.base_env.physics.reset(qpos=begin["reset_qpos"], qvel=begin["reset_qvel"])
    shown = chain.reset()
    chain.base_env.physics.reset(qpos=begin["reset_qpos"], qvel=begin["reset_qvel"])
    shown["joint_position"], shown["joint_velocity"] = begin["reset_qpos"], begin["reset_qvel"]
    past = replayed["observation"][:, 0].unflatten(-1, (2, HISTORY))
    shown["error_history"] = torch.cat((torch.zeros_like(past[..., :1]), past[..., :-1]), -1)  # the newest is to come
    exact = {"rtol": 1e-4, "atol": 1e-5} if torques else {"rtol": 0, "atol": 0}
    for k in range(steps):
        with torch.no_grad():
            shown = chain._step(shown.set("action", data.command[None, start + k]))
        torch.testing.assert_close(shown["applied_torque"], replayed["next", "applied_torque"][:, k], **exact)
        torch.testing.assert_close(shown["joint_position"], replayed["next", "joint_position"][:, k], **exact)
    assert replayed["torque_correction"].abs().max() > 0.1


def corrected(more=None, *, net=None, kind="none"):
    """An arm whose commands come late, whose torques lag, whose hip winds up, and more at its knee."""
    entries = (
        ("actuation_delay", "hip", {"delay": 0.012}),
        ("actuation_lag", "knee", {"time_constant": 0.02}),
        ("hysteresis", "hip", {"torque": 0.4, "width": 0.02}),
        ("encoder_offset", "knee", {"offset": 0.05}),
        *((effect, "knee", values) for effect, values in (more or {}).items()),
    )
    effects = [
        {"effect": effect, "joint": joint, "parameters": {name: {"value": value} for name, value in values.items()}}
        for effect, joint, values in entries
    ]
    found = {"schema": "torchrl_athletic/corrected/1", "joint_names": list(ROBOT.joint_names)}
    return Simulator("diagnosed", ROBOT, found | {"effects": effects, "trims": []}, net, kind)


def test_errors_stay_those_of_the_late_command_where_a_diagnosis_found_a_delay():
    env = replay_env(
        ROBOT,
        TAKES,
        chain=corrected().chain(decimation=1, limits=False),
        num_envs=1,
        by_row=True,
        starts=torch.tensor([30]),
    )
    steps = played(env, nothing, 40)
    seen = steps["observation"][0].unflatten(-1, (2, HISTORY))[:, 0, 0, -1]
    command, position = TAKES.command[30:70, 0], steps["joint_position"][0, :, 0]
    earlier = 0.6 * TAKES.command[28:68, 0] + 0.4 * TAKES.command[27:67, 0]  # by 2.4 steps
    torch.testing.assert_close(seen, earlier - position)
    assert (seen - (command - position)).abs().max() > 0.1


def test_the_past_of_an_episode_ends_where_its_take_begins():
    """As if no take had been recorded before it."""
    first, second = (recorded(Simulator("itself", ROBOT), commands(60, seed=n, scale=2.0, hold=15)) for n in (1, 2))

    def shown(takes, start):
        chain = corrected(net=moved_net(memory=(0.05, 0.5)), kind="correction").chain(decimation=1)
        data, starts = takes_of(takes, ROBOT), torch.tensor([start])
        return replay_env(ROBOT, data, chain=chain, by_row=True, starts=starts).reset()

    alone, among = shown([second], 21), shown([first, second], 81)
    for key in alone.exclude("sample").keys():
        torch.testing.assert_close(among[key], alone[key])


def test_before_an_episode_the_net_sees_the_targets_that_the_motors_could_follow():
    far = replace(TAKES, command=TAKES.command + 3.0)
    env = replay_env(ROBOT, far, chain=corrected().chain(decimation=1), num_envs=1, by_row=True)
    env.transform[-1].starts = torch.tensor([40])
    knee = env.reset()["observation"][0, 1].unflatten(-1, (2, HISTORY))
    speed = -knee[1]
    most = 20.0 * (1 - (speed / 12.0).clamp(0, 1))  # of the motor, at its speed
    torch.testing.assert_close(30.0 * knee[0] - 0.8 * speed, most)
    torch.testing.assert_close(speed, TAKES.velocity[21:41, 1])


@pytest.mark.parametrize("torques", [False, True])
@pytest.mark.parametrize("state", [False, True])
def test_behind_a_diagnosed_drive_with_limits_the_net_sees_what_it_was_trained_on(torques, state):
    """Commands that motors cannot follow, delay, lag, hysteresis and an encoder that is off: equal to the bit."""
    net = moved_net(state=state)
    simulator = corrected(net=net, kind="correction")
    data = takes(torques=torques)
    data = replace(data, command=3.0 * data.command)
    chain = simulator.chain(command=data.driven, decimation=1)
    env = replay_env(ROBOT, data, chain=chain, unit=torque_unit(net), by_row=True, starts=torch.tensor([45]))
    with torch.no_grad():
        replayed = played(env, lambda td: td.set("action", net[:-1](td["observation"]).squeeze(-1)), 40)

    policy = TransformedEnv(TorqueEnv(ROBOT, num_envs=1), Compose(*simulator.chain(command=data.driven, decimation=1)))
    start = replayed[:, 0]
    position = start["joint_position"].clone()
    position[:, 1] -= 0.05  # behind the encoder
    shown = policy.reset()
    policy.base_env.physics.reset(qpos=position, qvel=start["joint_velocity"])
    shown.update(start.select(*(key for key in shown.keys() if key in start.keys() and key != "action")))
    past = start["observation"][..., : 2 * HISTORY].unflatten(-1, (2, HISTORY))
    shown["error_history"] = torch.cat((torch.zeros_like(past[..., :1]), past[..., :-1]), -1)  # the newest is to come
    limited = 0
    for k in range(40):
        with torch.no_grad():
            shown = policy._step(shown.set("action", data.command[None, 45 + k]))
        errors = shown["error_history"].flatten(-2)
        torch.testing.assert_close(errors, replayed["observation"][:, k, :, : 2 * HISTORY], rtol=0, atol=0)
        torch.testing.assert_close(shown["applied_torque"], replayed["next", "applied_torque"][:, k], rtol=0, atol=0)
        torch.testing.assert_close(shown["joint_position"], replayed["next", "joint_position"][:, k], rtol=0, atol=0)
        far = data.command[45 + k, 1] - replayed["joint_position"][0, k, 1]
        limited += int((errors[0, 1, HISTORY - 1] - far).abs() > 0.1)
    assert replayed["torque_correction"].abs().max() > 0.1
    assert torques or limited > 20


@pytest.mark.parametrize("memory", [(), (0.05, 0.5)])
def test_replays_of_training_and_of_scoring_are_one(memory):
    """A window of a take, by the environment that nets are trained in and by the one that recordings are scored in."""
    net = moved_net(memory=memory)
    simulator = corrected(net=net, kind="correction")
    take = recorded(Simulator("itself", ROBOT), commands(200, seed=7, scale=2.0, hold=15))
    [scored] = open_loop(simulator, [take], window=0.25)
    env = replay_env(
        ROBOT,
        takes_of([take], ROBOT),
        chain=simulator.chain(decimation=1),
        unit=torque_unit(net),
        num_envs=2,
        by_row=True,
        starts=torch.tensor([50, 100]),
    )
    with torch.no_grad():
        steps = played(env, lambda td: td.set("action", net[:-1](td["observation"]).squeeze(-1)), 50)
    np.testing.assert_allclose(steps["next", "joint_position"].numpy(), scored.position[1:3], atol=1e-5)
    assert np.abs(scored.error[1:3]).max() > 1e-2


def test_what_moves_as_a_take_begins_has_wound_up_that_way_in_training_and_in_scoring():
    """20 samples are known of the past, the net remembers 40."""
    net = moved_net(memory=(0.05, 0.5))
    simulator = Simulator("uan", ROBOT, net=net, kind="correction")
    whole = recorded(Simulator("itself", ROBOT), commands(200, seed=7, scale=2.0, hold=15))
    fast = int(np.abs(whole.velocity).min(1)[:100].argmax())
    take = whole.slice(fast, fast + 80)
    [scored] = open_loop(simulator, [take], window=20 * DT)
    env = replay_env(
        ROBOT,
        takes_of([take], ROBOT),
        chain=simulator.chain(decimation=1),
        unit=torque_unit(net),
        by_row=True,
        starts=torch.tensor([20]),
    )
    with torch.no_grad():
        steps = played(env, lambda td: td.set("action", net[:-1](td["observation"]).squeeze(-1)), 20)
    np.testing.assert_allclose(steps["next", "joint_position"][0].numpy(), scored.position[1], atol=1e-5)
    wound = torch.zeros(2, 2)
    for k in range(-19, 21):
        velocity = torch.tensor(take.velocity[max(k, 0)]).float()[:, None]
        wound = actuator_dynamics.wind_up(wound, DT * velocity, torch.tensor([0.05, 0.5]))
    torch.testing.assert_close(steps["observation"][0, 0, :, -2:], wound)
    assert (wound[:, 0].abs() > 0.5).all()


def test_the_reward_is_the_tables():
    env = replay_env(ROBOT, TAKES, num_envs=4, unit=torch.tensor([2.0, 3.0]))
    steps = played(env, lambda td: td.set("action", torch.full_like(td["torque_correction"], 0.7)), 6)
    last, before = steps[:, 4], steps[:, 3]
    off = last["next", "privileged"][..., 0].double().numpy()
    distance = np.abs(off).sum(-1), np.square(off).sum(-1)
    table = -1.5 * distance[0] + sum(scale * np.exp(-s * distance[1]) for scale, s in ((4, 100), (4, 300), (5, 1000)))
    assert (before["action"] == last["action"]).all()
    np.testing.assert_allclose(last["next", "reward"].squeeze(-1), DT * (table + 0.5), rtol=1e-4)
    alone = -1.5 * np.abs(off) + sum(a * np.exp(-s * off**2) for a, s in ((4, 100), (4, 300), (5, 1000)))
    np.testing.assert_allclose(last["next", "joint_reward"], DT * (alone + 0.5), rtol=1e-4)
    first = steps[:, 0]  # the change from nothing to 0.7 on two joints is rough
    rough = rewards.uan_reward(*(torch.zeros(2) for _ in range(2)), torch.full((2,), 0.7), torch.zeros(2))
    assert (first["next", "reward"] < DT * rough + 1e-6).all()


def test_a_correction_counts_in_its_unit():
    env = replay_env(ROBOT, TAKES, num_envs=1, unit=torch.tensor([2.0, 3.0]), by_row=True, starts=torch.tensor([30]))
    plain = played(env, nothing, 1)["next", "applied_torque"][0, 0]
    pushed = played(env, lambda td: td.set("action", torch.tensor([[1.0, -1.0]])), 1)["next", "applied_torque"][0, 0]
    torch.testing.assert_close(pushed - plain, torch.tensor([2.0, -3.0]))


def test_a_joint_that_is_wrong_costs_its_own_reward_alone():
    env = replay_env(ROBOT, TAKES, num_envs=4, by_row=True, starts=torch.tensor([30, 40, 50, 60]))
    steps = played(env, lambda td: td.set("action", torch.tensor([[0.0, 3.0]]).expand(4, 2)), 10)
    off = steps["next", "privileged"][:, -1, :, 0].abs()
    earned = steps["next", "joint_reward"][:, -1]
    assert (off[:, 1] > 2 * off[:, 0]).all()
    assert (earned[:, 1] < earned[:, 0]).all()


def test_a_row_that_leaves_the_recording_ends_with_a_finite_penalty_and_starts_anew():
    env = replay_env(ROBOT, TAKES, num_envs=4)
    env.transform[-1].bound = 0.05

    def first_row_mad(tensordict):
        action = torch.zeros_like(tensordict["torque_correction"])
        action[0] = 1e4
        return tensordict.set("action", action)

    steps = played(env, first_row_mad, 30)
    failed = steps["next", "terminated"].squeeze(-1)
    assert failed[0].any()
    assert not failed[1:].any()
    assert (steps["next", "reward"][failed] == -10.0).all()
    assert (steps["next", "joint_reward"][failed] == -10.0).all()  # with credit by joint this is what counts
    for key in ("observation", "privileged", "reward", "joint_reward"):
        assert steps["next", key].isfinite().all()
    when = int(failed[0].nonzero()[0])
    assert when < 29
    assert steps["next", "done"][0, when]
    assert (steps["privileged"][0, when + 1] == 0).all()


def test_a_simulation_that_is_no_number_shows_the_policy_numbers():
    env = replay_env(ROBOT, TAKES, num_envs=2)
    shown = nothing(env.reset())
    env.base_env.physics.qvel[0] = torch.nan
    after = env._step(shown)
    assert after["terminated"].flatten().tolist() == [True, False]
    for key in ("observation", "privileged", "reward", "joint_reward"):
        assert after[key].isfinite().all()


def test_no_step_waits_for_a_gpu():
    env = replay_env(ROBOT, TAKES, num_envs=4)
    shown = nothing(env.reset())
    replayed, add = env.transform[-1], env.transform[0]
    after = env._step(shown.copy())
    reset = TensorDict({"_reset": torch.tensor([[True], [False], [True], [False]])}, [4])
    with no_host_sync():
        inner = add.inv(replayed._inv_call(shown.copy()).set("torque", torch.zeros(4, 2)))
        replayed.advance(inner, after.copy())
        replayed._reset_env_preprocess(reset.copy())
        replayed.draw(replayed.upcoming(reset), after)
    assert inner["torque"].shape == (4, 2)


def test_rows_draw_the_same_starts_alone_as_among_others():
    starts = [replay_env(ROBOT, TAKES, num_envs=n, seed=4).reset()["sample"].flatten()[:2] for n in (2, 9)]
    assert (starts[0] == starts[1]).all()
    assert (replay_env(ROBOT, TAKES, num_envs=9, seed=5).reset()["sample"].flatten()[:2] != starts[0]).any()


def test_a_correction_is_not_cut_off_with_the_motors_torque():
    """Far from its target a motor gives all it has; friction at the joint takes from that."""
    far = replace(TAKES, command=TAKES.command + 5.0)
    env = replay_env(ROBOT, far, num_envs=1, by_row=True, starts=torch.tensor([30]))
    assert [type(item) for item in env.transform] == [AddedTorque, TorqueSpeedClip, PDControl, ReplayTakes]
    plain = played(env, nothing, 1)["next", "applied_torque"][0, 0]
    braked = played(env, lambda td: td.set("action", torch.tensor([[-4.0, -3.0]])), 1)["next", "applied_torque"][0, 0]
    torch.testing.assert_close(braked - plain, torch.tensor([-4.0, -3.0]))
    assert (plain < 0.5 * 5.0 * torch.tensor(ROBOT.kp)).all()


def test_a_shorter_step_earns_less_by_as_much_as_it_is_shorter():
    quick = with_options(ROBOT, timestep=DT / 4)
    env = replay_env(quick, TAKES, num_envs=1, by_row=True, starts=torch.tensor([30]))
    earned = played(env, nothing, 1)["next"]
    assert earned["privileged"][..., 0].abs().max() < 1e-2
    for key in ("reward", "joint_reward"):
        assert 13.0 * DT / 4 < earned[key].max() <= 13.5 * DT / 4 + 1e-6


def test_what_goes_into_a_buffer_stays_as_the_policy_chose_it():
    replayed = own_replay().transform[-1]
    alone = replayed.clone()
    step = TensorDict(action=torch.ones(2, 2), sample=torch.tensor([[30], [40]]), batch_size=[2])
    assert alone.inv(step.clone())["action"].equal(step["action"])


def test_takes_that_contradict_themselves_are_refused():
    still = torch.zeros(50, 2)
    with pytest.raises(ValueError, match="sum of the lengths"):
        Takes(still, still, still, (40,))
    for flat in (still[:, 0], still.unsqueeze(-1)):
        with pytest.raises(ValueError, match=r"one shape \(S, J\)"):
            Takes(flat, flat, flat, (50,))
    for broken in range(3):
        with pytest.raises(ValueError, match="not finite"):
            Takes(*(still / 0 if k == broken else still for k in range(3)), (50,))
    with pytest.raises(ValueError, match="20 to fill"):
        Takes(still[:20], still[:20], still[:20], (20,))
    with pytest.raises(ValueError, match=r"robot\.joint_names"):
        replay_env(ROBOT, Takes(*[torch.zeros(50, 3)] * 3, (50,)))


def test_starts_have_a_history_behind_them_and_room_before_them_in_takes_of_every_length():
    still = torch.zeros(60, 2)
    several = Takes(still, still, still, (25, 10, 25))
    assert several.starts().tolist() == [*range(19, 24), *range(54, 59)]
    assert several.starts(room=4).tolist() == [19, 20, 54, 55]
    assert several.ends().tolist() == [24] * 25 + [34] * 10 + [59] * 25


def own_replay(num_envs=2, lagging=False, **told):
    chain = [TorqueSpeedClip(ROBOT.torque_limit, ROBOT.velocity_limit), PDControl(ROBOT.kp, ROBOT.kd)]
    chain = corrected().chain(decimation=1) if lagging else chain
    replayed = ReplayTakes(TAKES, ROBOT, chain=chain, by_row=True, **told)
    return TransformedEnv(TorqueEnv(ROBOT, num_envs=num_envs), Compose(AddedTorque(), *chain, replayed))


def test_rows_of_a_part_of_a_batch_start_where_those_of_the_whole_do():
    starts = torch.tensor([30, 40, 100])
    assert own_replay(2, starts=starts, first_row=2).reset()["sample"].flatten().tolist() == [100, 30]


@pytest.mark.parametrize("lagging", [False, True])
@pytest.mark.parametrize("state", [False, True])
def test_a_row_that_left_the_recording_is_shown_the_recording(state, lagging):
    """Its errors and, where asked for, positions, velocities and torques: those of an episode that starts there."""
    told = {"bound": 0.01, "penalty": -3.0, "state": state, "lagging": lagging}
    env = own_replay(starts=torch.tensor([30, 40]), **told)
    mad = torch.tensor([[20.0, 0.0], [0.0, 0.0]])
    step = next(step for step in played(env, lambda td: td.set("action", mad), 15)[0] if step["next", "terminated"])
    after = step["next"]
    assert after["reward"].item() == -3.0
    assert (after["joint_reward"] == -3.0).all()
    fresh = own_replay(starts=after["sample"].flatten(), **told).reset()["observation"][0]
    newest = [HISTORY - 1, 2 * HISTORY - 1, *range(2 * HISTORY, fresh.shape[-1])]
    torch.testing.assert_close(after["observation"][:, newest], fresh[:, newest])


def test_a_row_may_be_off_by_one_and_a_half_radians_and_no_more():
    env = own_replay(2, starts=torch.tensor([30]))
    shown = nothing(env.reset())
    env.base_env.physics.qpos[:, 0] += torch.tensor([1.4, 1.6], dtype=torch.float64)
    assert env._step(shown)["terminated"].flatten().tolist() == [False, True]


def test_of_a_robot_with_a_gripper_the_arm_is_corrected():
    arm = z1()
    pose = torch.tensor(arm.default_pose).expand(30, -1)
    shown = replay_env(arm, Takes(pose, torch.zeros_like(pose), pose, (30,)), num_envs=2).reset()
    assert shown["torque_correction"].shape == (2, 6)
    torch.testing.assert_close(shown["joint_position"], pose[:2])


def test_what_no_recording_tells_starts_as_the_robot_stands():
    dog = b2z1()
    start, key = _start_of(TorqueEnv(dog)), dog.model().key(dog.keyframe)
    np.testing.assert_array_equal(start.qpos, key.qpos)
    np.testing.assert_array_equal(start.qvel, key.qvel)
    assert start.qpos[2] > 0.3


def test_a_correction_may_be_added_to_any_entry_and_a_replay_made_on_any_device(monkeypatch):
    add = AddedTorque([1], 2.0, torque_key="effort", correction_key="lacking")
    step = TensorDict(effort=torch.tensor([[1.0, 2.0]]), lacking=torch.tensor([[0.5]]), batch_size=[1])
    assert add.inv(step)["effort"].tolist() == [[1.0, 3.0]]
    made = []

    def refuse(robot, **told):
        made.append((robot.sensors, told))
        raise NotImplementedError

    monkeypatch.setattr("torchrl_athletic.envs.replay.TorqueEnv", refuse)
    with pytest.raises(NotImplementedError):
        replay_env(z1(), TAKES, num_envs=3, device="cuda:1")
    assert made == [({}, {"num_envs": 3, "device": "cuda:1"})]  # nothing is read but joints


KEYS = """<mujoco><worldbody><body><joint name="hinge"/><geom size="1"/></body></worldbody>
  <keyframe><key name="first" qpos="1"/><key name="second" qpos="2" qvel="3"/></keyframe></mujoco>"""


def test_it_starts_at_the_robots_own_keyframe():
    physics = SimpleNamespace(model=mujoco.MjModel.from_xml_string(KEYS), dtype=torch.float64, device="cpu")
    robot = SimpleNamespace(joint_names=("hinge",), keyframe="second")
    start = _start_of(SimpleNamespace(physics=physics, robot=robot))
    assert (start.qpos.tolist(), start.qvel.tolist()) == ([2.0], [3.0])


def test_nowhere_to_start_is_refused():
    with pytest.raises(ValueError, match="no take is long enough to start in"):
        own_replay(starts=torch.zeros(0, dtype=torch.int64))
