"""The links of the actuation chain, alone and together, on joints whose motion can be written down."""

from typing import ClassVar

import pytest
import torch
from tensordict import TensorDict
from torch import nn
from torchrl.envs import Compose, SerialEnv, TransformedEnv

from torchrl_athletic.functional.actuation import brake_overspeed, pd_torque, torque_speed_limits, uan_features
from torchrl_athletic.testing import ToyEnv, TransformContract, make_actions, play
from torchrl_athletic.transforms import (
    ActionDelay,
    Decimation,
    EquivalentTarget,
    OverspeedBrake,
    PDControl,
    PowerClip,
    TorqueSpeedClip,
    UANCorrection,
)


class Recording(ToyEnv):
    """A toy that notes which actions reached it."""

    def _step(self, tensordict):
        self.__dict__.setdefault("arrived", []).append(tensordict.get(self.action_keys[0]).clone())
        return super()._step(tensordict)


class Last(nn.Module):
    """Shows what the net was shown: the errors number ``column``, oldest position error first."""

    def __init__(self, column):
        super().__init__()
        self.column = column

    def forward(self, errors):
        return errors[..., self.column, None]


def arrived(base):
    return torch.stack(base.arrived)


# PDControl


def test_the_policy_gives_a_target_and_the_environment_gets_a_torque():
    base = Recording(2, action="torque")
    env = TransformedEnv(base, PDControl([20.0, 10.0, 5.0], 0.5))
    shown = env.reset()
    target = torch.tensor([[0.1, 0.2, 0.3]] * 2)
    env.step(shown.set("action", target))
    expected = torch.tensor([20.0, 10.0, 5.0]) * (target - shown["joint_position"]) - 0.5 * shown["joint_velocity"]
    assert torch.equal(base.arrived[0], expected)
    assert list(env.action_keys) == ["action"]


def test_randomised_gains_multiply_the_nominal_ones():
    data = TensorDict(
        action=torch.ones(2, 3),
        joint_position=torch.zeros(2, 3),
        joint_velocity=torch.ones(2, 3),
        kp_scale=torch.tensor([[1.0], [2.0]]),
        kd_scale=torch.tensor([[1.0], [3.0]]),
        batch_size=[2],
    )
    torque = PDControl(20.0, 0.5).inv(data)["torque"]
    assert torque[:, 0].tolist() == [20.0 - 0.5, 40.0 - 1.5]


def test_a_target_that_is_missing_is_asked_for():
    with pytest.raises(KeyError, match=r"no 'action'.*policy's side"):
        PDControl(20.0, 0.5).inv(TensorDict(torque=torch.zeros(1, 3), batch_size=[1]))


# Clips


def test_torques_that_reach_the_motors_are_within_what_their_speed_allows():
    base = Recording(4, action="torque")
    limit, fastest = torch.tensor([0.5, 1.0, 2.0]), torch.tensor([1.0, 2.0, 3.0])
    env = TransformedEnv(base, TorqueSpeedClip(limit, fastest))
    steps, _ = play(env, make_actions(env, 12))
    low, high = torque_speed_limits(steps["joint_velocity"], limit, fastest)
    assert ((low <= arrived(base)) & (arrived(base) <= high)).all()
    assert (arrived(base) != steps["torque"]).any()


@pytest.mark.parametrize("joints", [None, [0, 2], "neighbours"])
def test_joints_of_the_group_that_turn_too_fast_are_braked_by_their_own_motors(joints):
    base = Recording(4, action="torque", joints=3)
    group = list(base.joint_groups.get(joints, joints) if isinstance(joints, str) else joints or [0, 1, 2])
    limit, fastest = torch.tensor([0.5, 1.0, 2.0])[group], torch.tensor([0.01, 0.02, 0.03])[group]
    steps, _ = play(TransformedEnv(base, OverspeedBrake(limit, fastest, joints)), make_actions(base, 12))
    asked, velocity = steps["torque"], steps["joint_velocity"]
    expected = asked.clone()
    expected[..., group] = brake_overspeed(asked[..., group], velocity[..., group], limit, fastest)
    assert torch.equal(arrived(base), expected)
    assert (arrived(base) != asked)[..., group].any((0, 1)).all()


@pytest.mark.parametrize("joints", [None, [0, 2], [1, 2], "apart", "neighbours"])
def test_the_power_of_the_group_is_bounded_and_other_joints_are_left_alone(joints):
    base = Recording(4, action="torque", joints=3)
    env = TransformedEnv(base, PowerClip(0.05, joints))
    steps, _ = play(env, make_actions(env, 12))
    group = base.joint_groups.get(joints, joints) if isinstance(joints, str) else joints or [0, 1, 2]
    others = [joint for joint in range(3) if joint not in group]
    power = (arrived(base) * steps["joint_velocity"])[..., list(group)].abs().sum(-1)
    asked = (steps["torque"] * steps["joint_velocity"])[..., list(group)].abs().sum(-1)
    assert (asked > 0.05).any()
    assert (power <= 0.05 * (1 + 1e-6)).all()
    assert torch.equal(arrived(base)[..., others], steps["torque"][..., others])


def test_a_group_that_the_environment_does_not_have_is_refused_with_those_it_has():
    env = TransformedEnv(ToyEnv(2, action="torque"), PowerClip(1.0, "arm"))
    with pytest.raises(ValueError, match=r"no group of joints 'arm'; it has \['apart', 'neighbours'\]"):
        env.rollout(1)


def test_around_workers_joints_are_named_by_their_numbers():
    env = TransformedEnv(SerialEnv(2, lambda: ToyEnv(2, action="torque")), PowerClip(1.0, "apart"))
    with pytest.raises(ValueError, match="give the joints' numbers"):
        env.rollout(1)
    assert TransformedEnv(SerialEnv(2, lambda: ToyEnv(2, action="torque")), PowerClip(1.0, [0, 2])).rollout(1).numel()


@pytest.mark.parametrize("kind", [TorqueSpeedClip, OverspeedBrake])
@pytest.mark.parametrize("limits", [([0.0, 1.0], 1.0), (1.0, [-1.0, 1.0])])
def test_a_motor_without_torque_or_speed_is_refused(kind, limits):
    with pytest.raises(ValueError, match="must be greater than zero"):
        kind(*limits)


# ActionDelay


@pytest.mark.parametrize("delay", [0, 1, 3])
def test_an_action_arrives_that_many_steps_later(delay):
    base = Recording(2, shortest=9)
    env = TransformedEnv(base, ActionDelay(delay, delay, before=[7.0, 7.0, 7.0]))
    given = play(env, make_actions(env, 8))[0]["action"]
    assert torch.equal(arrived(base)[delay:], given[: 8 - delay])
    assert (arrived(base)[:delay] == 7.0).all()


def test_without_a_command_before_the_episode_the_first_action_acts_at_once_and_is_held():
    base = Recording(2, shortest=9)
    env = TransformedEnv(base, ActionDelay(2, 2))
    given = play(env, make_actions(env, 6))[0]["action"]
    assert torch.equal(arrived(base)[:3], given[:1].expand(3, -1, -1))
    assert torch.equal(arrived(base)[2:], given[:4])


def test_without_a_command_before_the_episode_drawn_delays_are_kept_once_actions_are_there():
    base = Recording(8, shortest=9)
    steps, _ = play(TransformedEnv(base, ActionDelay(3, 1)), make_actions(base, 8))
    delays = steps["action_delay"][-1].flatten()
    assert delays.min() < delays.max() == 3
    late = torch.stack([steps["action"][7 - delay, row] for row, delay in enumerate(delays.tolist())])
    assert torch.equal(arrived(base)[7], late)


def test_within_decimation_the_delay_counts_steps_of_the_physics():
    base = Recording(1, shortest=9)
    env = TransformedEnv(base, Compose(ActionDelay(3, 3, before=[0.0, 0.0, 0.0]), Decimation(4)))
    given = play(env, make_actions(env, 2))[0]["action"]
    commanded = torch.cat((torch.zeros(3, 1, 3), given.repeat_interleave(4, 0)))
    assert torch.equal(arrived(base), commanded[:8])


def test_every_delay_is_equally_likely_and_stays_for_the_episode():
    env = TransformedEnv(ToyEnv(4000, shortest=3), ActionDelay(max_steps=3, min_steps=1))
    steps, _ = play(env, make_actions(env, 3))
    share = torch.bincount(steps["action_delay"][0].flatten(), minlength=4) / 4000
    assert share[0] == 0
    assert share[1:].tolist() == pytest.approx([1 / 3] * 3, abs=0.03)
    assert torch.equal(steps["action_delay"][1], steps["action_delay"][0])


def test_another_seed_draws_other_delays():
    delays = [TransformedEnv(ToyEnv(50), ActionDelay(6, seed=seed)).reset()["action_delay"] for seed in (0, 0, 1)]
    assert torch.equal(delays[0], delays[1])
    assert not torch.equal(delays[0], delays[2])


def test_a_delay_without_memory_says_that_it_needs_an_environment():
    with pytest.raises(KeyError, match="ActionDelay found no 'action_queue'"):
        ActionDelay(2).inv(TensorDict(action=torch.zeros(1, 3), batch_size=[1]))


@pytest.mark.parametrize(("most", "least"), [(2, 3), (2, -1)])
def test_a_delay_that_is_none_is_refused(most, least):
    with pytest.raises(ValueError, match="min_steps <= max_steps"):
        ActionDelay(most, least)


# UANCorrection


def uan(base, column, joints=None, **settings):
    correction = UANCorrection(Last(column), joints, length=3, **settings)
    return TransformedEnv(base, Compose(correction, PDControl(20.0, 0.5)))


@pytest.mark.parametrize("joints", [None, [0, 2], [1, 2]])
def test_the_net_s_torque_is_added_to_that_of_the_controller_for_its_joints_alone(joints):
    columns = joints or [0, 1, 2]
    base = Recording(2, action="torque")
    env = uan(base, 2, joints, scale=10.0)
    steps, _ = play(env, make_actions(env, 8))
    error = steps["action"] - steps["joint_position"]
    expected = 20.0 * error - 0.5 * steps["joint_velocity"]
    expected[..., columns] += 10.0 * error[..., columns]  # column 2 is the newest position error
    torch.testing.assert_close(arrived(base), expected)
    torch.testing.assert_close(steps["next", "torque_correction"], 10.0 * error[..., columns])


@pytest.mark.parametrize("column", range(6))
def test_the_net_sees_position_errors_before_velocity_errors_the_oldest_first_and_zero_before_the_episode(column):
    base = ToyEnv(1, action="torque", shortest=9)
    env = uan(base, column)
    steps, _ = play(env, make_actions(env, 8))
    error = steps["action"] - steps["joint_position"] if column < 3 else -steps["joint_velocity"]
    age = 2 - column % 3
    shown = torch.cat((torch.zeros(age, 1, 3), error))[:8]
    torch.testing.assert_close(steps["next", "torque_correction"], shown)


def test_the_net_sees_how_far_each_joint_has_wound_up_since_it_turned_however_long_it_has_rested():
    base = ToyEnv(2, action="torque", shortest=40)
    correction = UANCorrection(Last(7), length=3, memory=(0.02, 0.3), timestep=0.1)
    env = TransformedEnv(base, Compose(correction, PDControl(20.0, 0.5)))
    steps, _ = play(env, make_actions(env, 30))
    speed, shown = steps["joint_velocity"], steps["next", "wound_up"][..., 1]
    torch.testing.assert_close(steps["next", "torque_correction"], shown)  # behind six errors and the shorter way
    wound = torch.zeros_like(speed[0])
    for k in range(30):
        way = speed[k].sign()
        wound = way + (wound - way) * torch.exp(-0.1 * speed[k].abs() / 0.3)
        torch.testing.assert_close(shown[k], wound)
    assert shown.min() < -0.1
    assert shown.max() > 0.1


def test_gradients_reach_the_net_only_where_asked_for():
    for differentiable in (False, True):
        net = nn.Linear(6, 1)
        env = TransformedEnv(
            ToyEnv(2, action="torque"),
            Compose(UANCorrection(net, length=3, differentiable=differentiable), PDControl(20.0, 0.5)),
        )
        following = env.step(env.reset().set("action", torch.ones(2, 3)))["next"]
        assert following["joint_position"].requires_grad is differentiable


def test_a_correction_without_a_target_is_told_where_to_stand():
    env = TransformedEnv(ToyEnv(1, action="torque"), Compose(PDControl(20.0, 0.5), UANCorrection(nn.Linear(40, 1))))
    with pytest.raises(KeyError, match="Put PDControl after it"):
        env.rollout(1)


def test_a_correction_that_asks_for_too_much_is_clipped_by_the_motor_further_in():
    base = Recording(2, action="torque")
    chain = Compose(
        TorqueSpeedClip(1.0, 5.0), UANCorrection(Last(2), length=3, scale=1e3), PDControl(20.0, 0.5), Decimation(2)
    )
    env = TransformedEnv(base, chain)
    play(env, make_actions(env, 6))
    assert (arrived(base).abs() <= 1.0).all()
    assert (arrived(base).abs() > 0.5).any()


class TestEquivalentTargetContract(TransformContract):
    env_settings: ClassVar = {"action": "torque"}

    def make_transform(self, key=str, first_row=0):
        names = {"torque": "torque", "position": "joint_position", "velocity": "joint_velocity"}
        names |= {"target": "position_target", "action": "action"}
        keys = {f"{name}_key": key(entry) for name, entry in names.items()}
        return EquivalentTarget(20.0, [0.5, 0.4, 0.3], **keys)


def test_a_pd_law_towards_the_equivalent_target_commands_the_torque():
    torch.manual_seed(0)
    seen = TensorDict(
        {name: torch.randn(5, 3) for name in ("action", "joint_position", "joint_velocity")}, batch_size=[5]
    )
    kp, kd = torch.tensor([10.0, 20.0, 5.0]), torch.tensor([0.5, 1.0, 2.0])
    noted = EquivalentTarget(kp, kd).inv(seen)
    again = pd_torque(noted["position_target"], seen["joint_position"], seen["joint_velocity"], kp, kd)
    torch.testing.assert_close(again, seen["action"])
    torch.testing.assert_close(noted["torque"], seen["action"])


def test_a_torque_needs_a_stiffness_to_have_a_target():
    with pytest.raises(ValueError, match="Give the gains of a drive that could hold the robot"):
        EquivalentTarget(kp=[10.0, 0.0], kd=1.0)


def test_what_a_joint_has_wound_up_stands_behind_all_else():
    errors, wound = torch.zeros(2, 2, 3), torch.tensor([[0.1, 0.2], [0.3, 0.4]])
    shown = uan_features(errors, torch.tensor([5.0, 6.0]), wound=wound)
    torch.testing.assert_close(shown[:, 6:], torch.tensor([[5.0, 6.0, 0.1, 0.2], [5.0, 6.0, 0.3, 0.4]]))


def test_what_a_net_sees_of_the_group_is_the_same_for_each_joint_and_stands_behind_its_own_errors():
    errors = torch.arange(12.0).reshape(1, 2, 2, 3)
    position, torque = torch.tensor([[5.0, 6.0]]), torch.tensor([[7.0, 8.0]])
    assert uan_features(errors, position, torque)[0].tolist() == [
        [0.0, 1.0, 2.0, 3.0, 4.0, 5.0, 5.0, 6.0, 7.0, 8.0],
        [6.0, 7.0, 8.0, 9.0, 10.0, 11.0, 5.0, 6.0, 7.0, 8.0],
    ]


def test_a_motor_drawn_weaker_or_stronger_is_clipped_at_its_own_torque():
    data = TensorDict(
        torque=torch.full((2, 3), 9.0),
        joint_velocity=torch.full((2, 3), 5.0),
        torque_limit_scale=torch.tensor([[1.0], [0.5]]),
        batch_size=[2],
    )
    assert TorqueSpeedClip(4.0, 10.0).inv(data)["torque"][:, 0].tolist() == [2.0, 1.0]


def test_torques_that_somebody_else_holds_are_left_as_they_are():
    for joints in (None, [0, 2], [1, 2]):
        given = torch.full((1, 3), 9.0)
        shown = {"joint_position": torch.zeros(1, 3), "position_target": torch.ones(1, 3)}
        data = TensorDict(torque=given, joint_velocity=torch.ones(1, 3), **shown, batch_size=[1])
        size = 3 if joints is None else 2
        data["error_history"] = torch.zeros(1, size, 2, 3)
        for link in (PowerClip(1.0, joints), UANCorrection(Last(2), joints, length=3), TorqueSpeedClip(1.0, 9.0)):
            changed = link._inv_call(data.copy())["torque"]
            assert not torch.equal(changed, given)
            assert (given == 9.0).all()


def test_before_the_episode_each_joint_has_a_command_of_its_own():
    delay = ActionDelay(2, 1, before=[1.0, 2.0, 3.0], queue_key=("robot", "queue"), action_key="torque")
    shown = TransformedEnv(ToyEnv(2, action="torque"), delay).reset()
    assert shown["robot", "queue"].tolist() == [[[1.0, 2.0, 3.0]] * 3] * 2
    assert ("robot", "queue_age") not in shown.keys(True)
    fresh = ActionDelay(2, queue_key=("robot", "queue"), action_key="torque")
    assert TransformedEnv(ToyEnv(2, action="torque"), fresh).reset()["robot", "queue_age"].tolist() == [[0], [0]]


def test_limits_are_each_joint_s_own():
    """The last two of three joints are a group; they turn too fast by 5 rad/s and by 2 rad/s."""
    brake = OverspeedBrake([30.0, 8.0], [10.0, 4.0], joints=[1, 2])
    seen = TensorDict(
        torque=torch.tensor([[1.0, 1.0, 1.0]]), joint_velocity=torch.tensor([[15.0, 15.0, 6.0]]), batch_size=[1]
    )
    assert brake.inv(seen.clone())["torque"].tolist() == [[1.0, -15.0, -4.0]]
    clip = TorqueSpeedClip([30.0, 8.0, 6.0], [20.0, 30.0, 12.0])
    seen["torque"] = torch.full((1, 3), 50.0)
    assert clip.inv(seen)["torque"].tolist() == [[7.5, 4.0, 3.0]]


def test_each_gain_is_scaled_by_its_own_scale():
    law = PDControl([20.0, 10.0], [2.0, 1.0])
    seen = TensorDict(
        action=torch.ones(1, 2), joint_position=torch.zeros(1, 2), joint_velocity=torch.ones(1, 2), batch_size=[1]
    )
    seen["kp_scale"], seen["kd_scale"] = torch.tensor([[2.0, 1.0]]), torch.tensor([[1.0, 3.0]])
    found = law.inv(seen)
    assert found["torque"].tolist() == [[40.0 - 2.0, 10.0 - 3.0]]
    assert found["position_target"].tolist() == [[1.0, 1.0]]


def test_a_net_sees_positions_velocities_and_torques_of_its_group_in_this_order():
    seen = []

    def net(features):
        seen.append(features)
        return features[..., :1]

    state = {
        "joint_position": torch.tensor([[1.0, 2.0, 3.0]]),
        "joint_velocity": torch.tensor([[10.0, 20.0, 30.0]]),
        "torque": torch.tensor([[100.0, 200.0, 300.0]]),
        "position_target": torch.zeros(1, 3),
        "error_history": torch.zeros(1, 2, 2, 1),
    }
    UANCorrection(net, joints=[2, 0], length=1, state=True)._inv_call(TensorDict(state, batch_size=[1]))
    group = [3.0, 1.0, 30.0, 10.0, 300.0, 100.0]
    assert seen[0].tolist() == [[[-3.0, -30.0, *group], [-1.0, -10.0, *group]]]
