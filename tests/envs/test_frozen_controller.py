"""A controller that is led: what it is shown, and that it learns nothing."""

import pytest
import torch
from tensordict import TensorDict
from torchrl.envs import check_env_specs

from torchrl_athletic.envs import FrozenController, ball_throw_env
from torchrl_athletic.envs.whole_body import FRAME
from torchrl_athletic.functional import rotations
from torchrl_athletic.networks import pretrained


@pytest.fixture(scope="module")
def env():
    return ball_throw_env(num_envs=2).append_transform(FrozenController(pretrained("wbc")))


def test_specs_match_data(env):
    check_env_specs(env)


def test_zeros_let_the_controller_do_as_it_would(env):
    plain = ball_throw_env(num_envs=2)
    shown = plain.reset()
    own = pretrained("wbc")(shown.clone())["loc"]
    led = env.transform[-1]._inv_call(shown.clone().set("action", torch.zeros(2, 12)))["action"]
    torch.testing.assert_close(led, own, rtol=1e-3, atol=1e-4)


def test_an_action_moves_the_commands_of_the_newest_frame_alone(env):
    assert FRAME[:3] == ("projected_gravity", "base_velocity_command", "end_effector_command")
    shown = env.reset()
    action = torch.zeros(2, 12)
    action[:, 0], action[:, 3], action[:, 7] = 1.0, -1.0, 0.4
    seen = env.transform[-1].lead(shown["observation"], action).unflatten(-1, (10, 77))
    was = shown["observation"].unflatten(-1, (10, 77))
    assert seen[:, :-1].equal(was[:, :-1])
    change = seen[:, -1] - was[:, -1]
    assert change[:, [3, 6]].tolist() == [pytest.approx([0.5, -0.3])] * 2
    assert change[:, [*range(3), 4, 5, 7, 8, *range(15, 77)]].abs().max() == 0
    turn = rotations.from_two_columns(seen[:, -1, 9:15])
    columns = torch.cat((turn[..., 0], turn[..., 1]), -1)
    torch.testing.assert_close(columns, seen[:, -1, 9:15])  # still an attitude


def test_its_parameters_are_nobody_s_to_train(env):
    assert list(env.transform[-1].parameters()) == []


def test_each_number_of_an_action_moves_its_own_command_by_its_own_scale():
    """Velocities by 0.5, 0.25 and 0.5, places by 0.3, both columns of the attitude by 0.5."""
    scale = (0.5, 0.25, 0.5, 0.3, 0.3, 0.3, *(0.5,) * 6)
    torch.manual_seed(0)
    for frames, told, size in ((10, {}, scale), (2, {"history": 2, "scale": (0.1,) * 12}, (0.1,) * 12)):
        led = FrozenController(lambda seen: seen, **told)
        seen, action = torch.randn(3, frames * 20), torch.randn(3, 12)
        after = led.lead(seen, action)
        commands = slice(20 * (frames - 1) + 3, 20 * (frames - 1) + 15)
        moved = seen[:, commands] + torch.tensor(size) * action
        torch.testing.assert_close(after[:, commands][:, :6], moved[:, :6])
        turn = rotations.from_two_columns(moved[:, 6:])
        torch.testing.assert_close(after[:, commands][:, 6:], torch.cat((turn[..., 0], turn[..., 1]), -1))
        assert torch.equal(after[:, : commands.start], seen[:, : commands.start])
        assert torch.equal(after[:, commands.stop :], seen[:, commands.stop :])


def test_no_gradient_goes_through_the_controller(env):
    told = TensorDict(observation=torch.zeros(2, 770), action=torch.zeros(2, 12, requires_grad=True), batch_size=[2])
    assert not env.transform[-1]._inv_call(told)["action"].requires_grad


def test_what_goes_into_a_buffer_stays_as_the_leader_chose_it():
    step = TensorDict(observation=torch.ones(2, 770), action=torch.ones(2, 12), batch_size=[2])
    assert FrozenController(pretrained("wbc")).inv(step.clone())["action"].equal(step["action"])


def test_the_controller_acts_on_what_it_is_led_to_see_whatever_the_entries_are_called(monkeypatch):
    monkeypatch.setattr(FrozenController, "parent", "an environment")
    names = {"observation_key": "seen", "action_key": "steer"}
    leader = FrozenController(lambda seen: seen.set("loc", 2.0 * seen["seen"]), **names)
    torch.manual_seed(0)
    step = TensorDict(seen=torch.randn(3, 200), steer=torch.randn(3, 12), batch_size=[3])
    wanted = 2.0 * leader.lead(step["seen"], step["steer"])
    assert leader._inv_call(step.clone())["steer"].equal(wanted)
    assert not wanted.equal(2.0 * step["seen"])
