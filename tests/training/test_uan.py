"""From recordings to a trained net: what may be learnt from, whose reward counts, and that it learns."""

import sys
from copy import deepcopy
from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
import torch
from identification.arms import commands, recorded, robot
from tensordict import TensorDict

from torchrl_athletic.envs import replay_env
from torchrl_athletic.envs.replay import HISTORY, Takes
from torchrl_athletic.identification import Simulator
from torchrl_athletic.networks import uan
from torchrl_athletic.recordings import Recording, RecordingError
from torchrl_athletic.robots import z1
from torchrl_athletic.training import (
    UAN,
    for_training,
    iterate,
    set_aside,
    takes_of,
    torque_unit,
    train,
    uan_learner,
    units_of,
    validation_of,
    with_gains_of,
)
from torchrl_athletic.training.uan import joint_rows
from torchrl_athletic.transforms import RandomizationRanges

module = sys.modules["torchrl_athletic.training.uan"]
ROBOT = robot()


def take(samples=300, seed=0, **changes):
    return replace(recorded(Simulator("real", ROBOT), commands(samples, seed=seed)), **changes)


def swinging(names=("joint2", "joint1"), rate=200.0, **changes):
    """Take of a Z1, by formulas."""
    time = np.arange(0.0, 1.0, 1 / rate)
    position = np.stack([1.5 + 0.2 * np.sin(6 * time), 0.3 * np.sin(4 * time)], -1)
    target = position + np.array([0.05, -0.1])
    return Recording(
        time, names, position, **{"position_target": target, "kp": [128.0, 64.0], "kd": [3.0, 1.5]} | changes
    )


def test_takes_are_in_the_robots_order_and_joints_that_are_not_named_rest():
    arm = z1()
    takes = takes_of([swinging()], arm)
    time = torch.arange(200) * 0.005
    torch.testing.assert_close(takes.position[:, 0], (0.3 * torch.sin(4 * time.double())).float())
    torch.testing.assert_close(takes.command[:, 1], (1.55 + 0.2 * torch.sin(6 * time.double())).float())
    rest = torch.tensor(arm.default_pose)[2:].expand(200, 5)
    torch.testing.assert_close(takes.position[:, 2:], rest)
    torch.testing.assert_close(takes.command[:, 2:], rest)
    assert takes.velocity[:, 2:].abs().max() == 0


def test_velocities_that_were_not_logged_are_slopes():
    velocity = takes_of([swinging()], z1()).velocity[:, 1]
    expected = 1.2 * torch.cos(6 * torch.arange(200) * 0.005)
    torch.testing.assert_close(velocity, expected, atol=2e-3, rtol=0)


def test_takes_of_another_rate_come_on_the_physics_grid():
    takes = takes_of([swinging(rate=400.0)], z1())
    assert takes.lengths == (200,)
    expected = 1.5 + 0.2 * torch.sin(6 * torch.arange(200) * 0.005)
    torch.testing.assert_close(takes.position[:, 1], expected, atol=1e-4, rtol=0)


def test_torques_need_no_gains_but_all_joints():
    took = take(kp=None, kd=None, position_target=None, torque_command=np.ones((300, 2)))
    took = replace(took, torque_measured=None, torque_semantics=None)
    takes = takes_of([took], ROBOT)
    assert takes.driven == "torque"
    assert (takes.command == 1).all()
    torques = swinging(position_target=None, kp=None, kd=None, torque_command=np.zeros((200, 2)))
    with pytest.raises(RecordingError, match="fall limp"):
        takes_of([torques], z1())
    with pytest.raises(RecordingError, match="Train on one kind"):
        takes_of([took, take()], ROBOT)


def test_takes_of_other_gains_or_joints_are_refused_and_a_robot_gets_the_gains_of_its_takes():
    other = swinging(kp=[100.0, 50.0])
    with pytest.raises(RecordingError, match=r"kd is \[3\.0, 2\.5\], z1's is \[3\.0, 1\.5\]"):
        takes_of([swinging(kd=[3.0, 2.5])], z1())
    with pytest.raises(RecordingError, match=r"kp is \[100\.0, 50\.0\], z1's is \[128\.0, 64\.0\]"):
        takes_of([other], z1())
    arm = with_gains_of(z1(), [other])
    assert arm.kp == (50.0, 100.0, *z1().kp[2:])
    assert with_gains_of(z1(), [swinging(kd=[4.0, 2.5])]).kd == (2.5, 4.0, *z1().kd[2:])
    assert takes_of([other], arm).lengths == (200,)
    with pytest.raises(RecordingError, match="none of z1's"):
        takes_of([swinging(names=("elbow", "joint1"))], z1())
    with pytest.raises(RecordingError, match="at least one"):
        takes_of([], z1())


def test_what_is_held_out_and_what_throws_is_never_trained_on():
    kinds = [{"split": "train", "kind": "sine"}, {"split": "heldout", "kind": "gaussian"}, {"kind": "throw"}, {}]
    takes = [take(100, metadata=metadata) for metadata in kinds]
    assert for_training(takes) == [takes[0], takes[3]]
    with pytest.raises(RecordingError, match="all 1 recordings are held out"):
        for_training(takes[1:2])


def test_windows_to_validate_on_share_no_sample_with_the_pieces_to_train_on():
    takes = [take(samples, seed, source=str(samples)) for seed, samples in enumerate((1500, 900, 150))]
    pieces, windows = set_aside(takes, share=0.5, seconds=1.0)
    assert {r.num_samples for r in windows} == {200 + HISTORY}
    assert len([w for w in windows if w.source == "1500"]) == 3
    assert not [w for w in windows if w.source == "150"]
    for source in ("1500", "900", "150"):
        ours = [r.time for r in pieces if r.source == source]
        theirs = [r.time for r in windows if r.source == source]
        both = np.concatenate(ours + theirs)
        assert len(np.unique(both)) == len(both)
    places = [tuple(w.time[0] for w in set_aside(takes, 0.5, 1.0, seed)[1]) for seed in (0, 0, 1)]
    assert places[0] == places[1] != places[2]
    with pytest.raises(RecordingError, match=r"none can spare a window"):
        set_aside(takes[2:], seconds=1.0)


def test_validation_replays_whole_windows_again_and_again():
    heavy = replace(ROBOT, kp=ROBOT.kp, build=lambda: _heavier(ROBOT.spec()))
    windows = set_aside([take(900)], seconds=1.0)[1]
    same, other = (validation_of(Simulator("s", r), windows, uan(torque_unit=[1.0, 1.0])) for r in (ROBOT, heavy))
    assert same()["mse"] < 1e-8
    first = other()
    assert first["mse"] > 1e-5
    assert other() == first
    assert first["lost"] == 0


def test_a_lost_replay_is_charged_the_bound_until_the_window_ends():
    """Thrown off in its first steps, it would start anew and look good; the better its luck, the better the net."""
    windows = set_aside([take(900)], seconds=1.0)[1]
    net = uan(torque_unit=[1.0, 1.0])
    validate = validation_of(Simulator("s", ROBOT), windows, net)
    good, before = validate(), deepcopy(net.state_dict())
    torch.nn.init.constant_(net[1][-1].bias, 1e4)
    bad = validate()
    assert bad["lost"] == 1.0
    assert 0.8 * 1.5**2 < bad["mse"] <= 1.5**2
    assert validate.best[0] == good["mse"]
    for name, value in validate.best[1].items():
        assert name.endswith("extra_state") or (value == before[name]).all()


def test_what_follows_a_loss_is_charged_though_the_row_started_anew_and_tracks_well():
    windows = set_aside([take(900)], seconds=1.0)[1]
    validate = validation_of(Simulator("s", ROBOT), windows, uan(torque_unit=[1.0, 1.0]))
    lost = torch.tensor([[0, 1, 0, 0], [0, 0, 0, 0]], dtype=torch.bool).unsqueeze(-1)
    after = TensorDict(terminated=lost, privileged=torch.zeros(2, 4, 2, 1), batch_size=[2, 4])
    validate.rollout = lambda: TensorDict(next=after, batch_size=[2, 4])
    assert validate() == pytest.approx({"mse": 3 / 8 * validate.bound**2, "lost": 0.5})


def _heavier(spec):
    for geom in spec.geoms:
        geom.mass *= 1.3
    return spec


def arm_env(net, num_envs=6):
    takes = takes_of([take(300, seed) for seed in (0, 1)], ROBOT)
    return replay_env(ROBOT, takes, unit=torque_unit(net), num_envs=num_envs, max_steps=40)


def test_joints_as_rows_are_what_each_joint_saw_did_and_earned():
    torch.manual_seed(0)
    net = uan()
    learner = uan_learner(arm_env(net), net, replace(UAN, num_envs=6, horizon=50), credit="joint", scale=0.3)
    batch = super(type(learner.rollout), learner.rollout).__call__()
    rows = joint_rows(batch)
    assert rows.shape == (12, 50)
    for row, arm, joint in ((0, 0, 0), (5, 2, 1), (11, 5, 1)):
        for key in ("observation", "privileged", ("next", "observation"), ("next", "privileged")):
            assert (rows[key][row] == batch[key][arm, :, joint]).all()
        assert (rows["next", "reward"][row, :, 0] == batch["next", "joint_reward"][arm, :, joint]).all()
        for flag in ("done", "terminated", "truncated"):
            assert (rows["next", flag][row] == batch["next", flag][arm]).all()
        for key in ("loc", "scale", "action"):
            assert (rows[key][row, :, 0] == batch[key][arm, :, joint]).all()
        assert (rows["joint"][row] == joint).all()
        assert (rows["next", "joint"][row] == joint).all()
    assert not batch["next", "terminated"].equal(batch["next", "done"])
    assert batch["scale"].unique().tolist() == pytest.approx([0.3])
    torch.testing.assert_close(rows["action_log_prob"].unflatten(0, (6, 2)).sum(1), batch["action_log_prob"])


@pytest.mark.parametrize("credit", ["arm", "joint"])
def test_the_policy_that_collects_is_the_one_that_learns(credit):
    torch.manual_seed(0)
    net = uan(torque_unit=[1.0, 1.0])
    config = replace(UAN, num_envs=6, horizon=20)
    learner = uan_learner(arm_env(net), net, config, credit=credit, scale=0.3)
    seen = []
    loss_actor = learner.stepper.loss.loss_actor

    def noting(batch):
        report = loss_actor(batch)
        seen.append(report["kl"].item())
        return report

    learner.stepper.loss.loss_actor = noting
    for _ in range(2):
        seen.clear()
        iterate(learner)
        assert seen[0] == pytest.approx(0.0, abs=1e-5)
        assert max(seen) > 1e-4
    assert net[1][-1].weight.abs().max() > 0
    assert learner.samples == 2 * 6 * 20 * (2 if credit == "joint" else 1)


def test_the_best_net_so_far_is_kept_and_gone_on_with():
    windows = set_aside([take(900)], seconds=1.0)[1]
    first, second = (validation_of(Simulator("s", ROBOT), windows, uan(torque_unit=[1.0, 1.0])) for _ in range(2))
    shown = TensorDict(terminated=torch.zeros(1, 3, 1, dtype=torch.bool), batch_size=[1, 3])
    first.net[1][-1].bias.data.fill_(0.5)
    for error, bias in ((0.2, 1.0), (0.1, 2.0), (0.3, 3.0), (0.1, 4.0)):
        first.net[1][-1].bias.data.fill_(bias)
        after = shown.copy().set("privileged", torch.full((1, 3, 2, 1), error))
        first.rollout = lambda after=after: TensorDict(next=after, batch_size=[1, 3])
        assert first()["mse"] == pytest.approx(error**2)
    second.load_state_dict(first.state_dict())
    assert second.best[0] == pytest.approx(0.01)
    (bias,) = (value for name, value in second.best[1].items() if name.endswith("bias") and len(value) == 1)
    assert bias.tolist() == [2.0]


def test_units_of_torques_are_those_of_the_target_that_would_command_them():
    """Position error (τ + kd v) / kp, joint by joint, and what else a net is told only where it knows that."""
    torch.manual_seed(0)
    arm = replace(ROBOT, kp=(50.0, 80.0), kd=(4.0, 9.0))
    position, velocity, torque = torch.randn(3, 400, 2).unbind()
    takes = Takes(position, velocity, 3.0 * torque + 2.0 * velocity, (400,), "torque")
    off = (takes.command + torch.tensor(arm.kd) * velocity) / torch.tensor(arm.kp)
    plain = units_of(takes, arm)
    assert plain["unit"] == pytest.approx((float(off.std()), float(velocity.std())))
    assert plain.keys() == {"unit", "sharpness_of_velocity", "torque_unit"}
    assert units_of(takes, arm, memory=(0.1, 0.4))["memory"] == (0.1, 0.4)
    assert units_of(takes, arm, "joint") == plain | {"joints": 2}
    whole = units_of(takes, arm, "arm")
    limit = torch.tensor(arm.torque_limit)
    seen = (position, velocity, takes.command.clamp(-limit, limit))
    assert whole["state_unit"] == pytest.approx(torch.cat([each.std(0) for each in seen]).tolist())


def test_units_of_targets_are_those_of_joints_that_move_and_torques_those_of_the_servo():
    torch.manual_seed(0)
    arm = replace(ROBOT, kp=(50.0, 80.0), kd=(4.0, 9.0), torque_limit=(30.0, 20.0))
    position, velocity, target = torch.randn(3, 400, 2).unbind()
    takes = Takes(position, velocity, target, (400,))
    servo = torch.tensor(arm.kp) * (target - position) - torch.tensor(arm.kd) * velocity
    servo = torch.stack([servo[:, 0].clamp(-30, 30), servo[:, 1].clamp(-20, 20)], -1)
    found = units_of(takes, arm, "arm")
    assert found["unit"] == pytest.approx((float((target - position).std()), float(velocity.std())))
    assert found["state_unit"] == pytest.approx(torch.cat([v.std(0) for v in (position, velocity, servo)]).tolist())
    for still in (velocity, position, target):
        still[:, 1] = 0.0
    found = units_of(takes, arm, "arm")
    assert found["unit"] == pytest.approx((float((target - position)[:, 0].std()), float(velocity[:, 0].std())))
    assert found["state_unit"][1::2] == [pytest.approx(0.01)] * 3  # what stands still is not blown up


def test_strength_is_that_of_the_arms_own_motors_wherever_they_stand():
    arm = replace(z1(), joint_groups={"arm": (1, 2, 4)}, torque_limit=(5.0, 60.0, 30.0, 7.0, 15.0, 9.0, 8.0))
    moved = torch.rand(100, 7)
    found = units_of(Takes(moved, moved, 2 * moved, (100,)), arm, "arm")
    assert found["torque_unit"] == [2.0, 1.0, 0.5]
    assert found["joints"] == 3
    assert found["state_unit"][:3] == pytest.approx(moved[:, [1, 2, 4]].std(0).tolist())


def test_episodes_do_not_all_end_at_once():
    net = uan()
    left = uan_learner(arm_env(net, 32), net, replace(UAN, num_envs=32)).rollout.current["steps_left"]
    assert left.unique().numel() > 12
    assert left.min() >= 1


def test_a_net_of_these_takes_tells_creeping_from_rest():
    """Friction turns over there: a hundredth of the usual velocity is seen as more than five hundredths."""
    moved = torch.randn(100, 2, generator=torch.Generator().manual_seed(0))
    seen = uan(**units_of(Takes(moved, moved, moved, (100,)), ROBOT))[0]
    creeping = seen((0.01 * moved.std()).expand(1, 40))[0, 20]
    assert creeping > 0.05


@pytest.mark.slow
def test_it_learns_friction_by_trying():
    """In 100 iterations the error of windows that it never saw falls by a quarter; the gradient's does in ten."""
    torch.manual_seed(0)
    real = replace(ROBOT, build=lambda: _stiffer(ROBOT.spec()))
    takes = [recorded(Simulator("real", real), commands(600, seed=seed, scale=0.25)) for seed in (0, 1)]
    pieces, windows = set_aside(takes, seconds=1.0)
    found = takes_of(pieces, ROBOT)
    net = uan(**units_of(found, ROBOT))
    validate = validation_of(Simulator("uan", ROBOT), windows, net)
    before = validate()["mse"]
    env = replay_env(ROBOT, found, unit=torque_unit(net), num_envs=64)
    config = replace(UAN, num_envs=64, horizon=24, discount=0.9, gae_lambda=0.9)
    train(uan_learner(env, net, config, credit="joint", scale=0.3), iterations=100, progress=False)
    assert validate()["mse"] < 0.75 * before


def _stiffer(spec):
    for joint in spec.joints:
        joint.damping[0] *= 3.0
    return spec


@pytest.mark.parametrize("credit", ["arm", "joint"])
def test_a_critic_sees_errors_in_the_nets_units_and_how_far_the_simulation_is_off_in_finer_ones(monkeypatch, credit):
    left = torch.tensor([[1], [40]])
    monkeypatch.setattr(module, "JointRollout", lambda *_: None)
    monkeypatch.setattr(
        module, "Learner",
        lambda env, policy, critic, *_, **told: SimpleNamespace(
            critic=critic, rollout=SimpleNamespace(current={"steps_left": left})),
    )  # fmt: skip
    env = SimpleNamespace(observation_spec={"observation": torch.zeros(2, 6, 2 * HISTORY)}, device="cpu")
    critic = uan_learner(env, uan(unit=(0.3, 8.0)), replace(UAN, num_envs=2), credit=credit).critic
    unit = critic.module.units.get_buffer("unit")
    assert unit.tolist() == pytest.approx([0.3] * HISTORY + [8.0] * HISTORY + [0.05, 2.0])
    assert left[0] == 1
    assert 1 <= left[1] <= 40


@pytest.mark.parametrize("credit", ["arm", "joint"])
def test_whoever_is_credited_the_learner_is_told_its_seed_its_processes_and_the_critics_layers(monkeypatch, credit):
    told, two, config = {}, SimpleNamespace(count=2), replace(UAN, num_envs=2, horizon=7)

    def learner(env, policy, critic, config, **options):
        told.update(options, critic=critic, config=config)
        return SimpleNamespace(rollout=SimpleNamespace(current={"steps_left": torch.ones(2, 1, dtype=torch.int64)}))

    monkeypatch.setattr(module, "Learner", learner)
    monkeypatch.setattr(module, "JointRollout", lambda env, policy, horizon: (env, horizon))
    env = SimpleNamespace(observation_spec={"observation": torch.zeros(2, 6, 2 * HISTORY)}, device="cpu")
    uan_learner(env, uan(), config, credit=credit, hidden=(5, 4), seed=6, cuda_graph=True, processes=two)
    assert (told["seed"], told["cuda_graph"], told["config"]) == (6, True, config)
    assert told["processes"] is two
    layers = [layer.out_features for layer in told["critic"].modules() if isinstance(layer, torch.nn.Linear)]
    assert layers == [5, 4, 1]
    assert told.get("rollout") == (None if credit == "arm" else (env, 7))


def test_a_critic_of_joints_is_told_which_one_it_values():
    value = module._JointValue(torch.ones(3), 3, [], None)
    layer = value.mlp[-1]
    with torch.no_grad():
        layer.weight.copy_(torch.tensor([[0.0, 0.0, 0.0, 1.0, 10.0, 100.0]]))
        layer.bias.zero_()
    found = value(torch.randn(3, 2), torch.randn(3, 1), torch.tensor([[2], [0], [1]]))
    assert found.flatten().tolist() == [100.0, 1.0, 10.0]


@pytest.mark.parametrize("torques", [False, True])
def test_windows_are_replayed_from_their_first_moments_by_what_drove_them(monkeypatch, torques):
    asked = {}
    monkeypatch.setattr(module, "replay_env", lambda robot, takes, **told: asked.update(told) or "env")
    monkeypatch.setattr(module, "Validation", lambda *told: told)
    windows = [recorded(Simulator("real", ROBOT), commands(50, seed=k), torques) for k in (0, 1, 2)]
    net = uan(torque_unit=[2.0, 0.5])
    found = validation_of(Simulator("s", ROBOT), windows, net, "cuda:1")
    assert found == ("env", net, 50 - HISTORY)
    assert asked["starts"].tolist() == [HISTORY - 1 + 50 * k for k in (0, 1, 2)]
    assert asked["unit"].tolist() == [2.0, 0.5]
    assert (asked["num_envs"], asked["max_steps"], asked["by_row"]) == (3, 50 - HISTORY, True)
    assert asked["device"] == "cuda:1"
    kinds = [type(part).__name__ for part in asked["chain"]]
    assert kinds == ["UANCorrection", "TorqueSpeedClip", "EquivalentTarget" if torques else "PDControl"]


def test_robots_that_a_simulator_draws_are_not_drawn_where_a_net_is_trained():
    takes = takes_of([take(100)], ROBOT)
    drawn = Simulator("random", ROBOT, randomization=RandomizationRanges(friction=None, restitution=None))
    for simulator in (drawn, Simulator("plain", ROBOT)):
        kinds = [type(part).__name__ for part in module.chain_with(simulator, uan(), takes)]
        assert kinds == ["UANCorrection", "TorqueSpeedClip", "PDControl"]


@pytest.mark.parametrize("rate", [200.0, 400.0])
def test_a_window_may_lie_anywhere_and_all_beside_it_but_scraps_is_trained_on(rate):
    """A take is twice as long as its window, which may be at either end; a scrap is too short to step in."""
    length, first = round(0.15 * rate) + HISTORY, set()
    took = swinging(rate=rate).slice(0, 2 * length)
    for seed in range(300):
        pieces, (window,) = set_aside([took], seconds=0.15, seed=seed)
        start = int(np.searchsorted(took.time, window.time[0]))
        first.add(start)
        assert window.num_samples == length
        beside = [part for part in (took.time[:start], took.time[start + length :]) if len(part) > 2 * HISTORY]
        assert [piece.time.tolist() for piece in pieces] == [part.tolist() for part in beside]
    assert first >= {0, length}
    with pytest.raises(RecordingError, match=r"no take lasts 0\.3 s"):
        set_aside([took.slice(0, 2 * length - 1)], seconds=0.15)


def test_as_many_windows_are_set_aside_as_make_up_the_share_and_one_at_least():
    took = swinging(rate=200.0)
    for share, count in ((0.1, 1), (0.5, 3), (0.75, 5)):
        assert len(set_aside([took], share=share, seconds=0.05)[1]) == count


def test_gains_may_be_off_by_rounding_and_no_more_and_takes_without_any_are_passed_over():
    arm = z1()
    assert takes_of([swinging(kp=[128.06, 64.0])], arm).lengths == (200,)
    with pytest.raises(RecordingError, match="replayed torques would be others"):
        takes_of([swinging(kp=[129.0, 64.0])], arm)
    still = np.zeros((200, 7))
    bare = Recording(np.arange(200) * 0.005, arm.joint_names, still, torque_command=still)
    assert with_gains_of(arm, [bare, swinging(kp=[100.0, 50.0])]).kp[:2] == (50.0, 100.0)
    with pytest.raises(RecordingError, match="none of z1's"):
        with_gains_of(arm, [swinging(names=("elbow", "joint1"))])


def test_rows_of_joints_are_written_where_an_update_reads_them(monkeypatch):
    batches = iter([TensorDict(seen=torch.full((2, 3), value), batch_size=[2, 3]) for value in (1.0, 2.0)])
    monkeypatch.setattr(module.CapturedRollout, "__call__", lambda rollout: next(batches))
    monkeypatch.setattr(module, "joint_rows", lambda batch: batch)
    rollout = object.__new__(module.JointRollout)
    rollout._rows = None
    first = rollout()["seen"]
    assert rollout()["seen"].data_ptr() == first.data_ptr()
    assert first.unique().tolist() == [2.0]


def test_a_net_that_is_told_which_joint_is_which_cannot_be_credited_joint_by_joint():
    env = SimpleNamespace(observation_spec={"observation": torch.zeros(2, 6, 2 * HISTORY)}, device="cpu")
    with pytest.raises(ValueError, match="credit='arm', or the gradient method"):
        uan_learner(env, uan(joints=6), replace(UAN, num_envs=2), credit="joint")


@pytest.mark.parametrize("kind", ["_ArmValue", "_JointValue"])
def test_a_critic_sees_small_errors_as_a_net_does_and_is_smooth(kind):
    """In its unit an error of one is seen as an actuator net sees it; what is negative still has a slope."""
    torch.manual_seed(0)
    value = getattr(module, kind)(torch.full((3,), 2.0), 2, (4,), None)
    alike = uan(unit=(2.0, 2.0))[0]
    error = torch.tensor([0.02, 2.0, -5.0])
    torch.testing.assert_close(value.units(error), alike(torch.cat((error, torch.zeros(37))))[:3])
    low, high = value.mlp[1](torch.tensor([-1.0, 9.0])).tolist()
    assert low < -0.5
    assert high == 9.0
