from dataclasses import replace
from typing import ClassVar

import pytest
import torch
from tensordict import TensorDict
from torchrl.envs import TransformedEnv

from torchrl_athletic.functional import commands, rotations, streams
from torchrl_athletic.functional.commands import CommandRanges, sled_commands
from torchrl_athletic.testing import ToyEnv, TransformContract
from torchrl_athletic.transforms import CommandSampler

DT = 0.02
POSES = {
    "base_position": (3,),
    "base_quaternion": (4,),
    "end_effector_position": (3,),
    "end_effector_quaternion": (4,),
}
SHORT = CommandRanges(interval=0.05, duration=(0.01, 0.04))
"""New goals every third step, so that several fall into an episode."""


class TestContract(TransformContract):
    def make_transform(self, key=str, first_row=0):
        keys = {"velocity_key": key("velocity"), "pose_key": key("pose"), "memory_key": key("command")}
        return CommandSampler(SHORT, DT, base_keys=None, end_effector_keys=None, first_row=first_row, **keys)


class TestContractOfTheSled(TransformContract):
    env_settings: ClassVar = {"extra": POSES}

    def make_transform(self, key=str, first_row=0):
        keys = {"velocity_key": key("velocity"), "pose_key": key("pose"), "memory_key": key("command")}
        poses = {name: (key(f"{name}_position"), key(f"{name}_quaternion")) for name in ("base", "end_effector")}
        keys |= {f"{name}_keys": pose for name, pose in poses.items()}
        ranges = CommandRanges(interval=0.05, duration=(0.01, 0.04), straighten=0.5)
        return CommandSampler(ranges, DT, first_row=first_row, **keys)


def rollout(steps, ranges=None, num_envs=50, **settings):
    settings = {"base_keys": None, "end_effector_keys": None, **settings}
    sampler = CommandSampler(ranges or CommandRanges(standstill_probability=0.0), DT, **settings)
    return TransformedEnv(ToyEnv(num_envs, shortest=10_000, extra=POSES), sampler).rollout(steps)


@pytest.fixture(scope="module")
def long():
    """16 s."""
    return rollout(800)


def test_goals_change_every_seven_seconds_and_at_no_other_time(long):
    changed = (long["command_goal"][:, 1:] != long["command_goal"][:, :-1]).any(-1)
    assert changed.any(0).nonzero().squeeze(-1).tolist() == [349, 699]
    assert changed[:, [349, 699]].all()


def test_commands_reach_their_goals_within_two_to_five_seconds_and_wait_there(long):
    velocity, goal = long["base_velocity_command"], long["command_goal"][..., :3]
    for start in (0, 350):
        arrived = (velocity == goal)[:, start : start + 350].all(-1)
        assert not arrived[:, :99].any()
        assert arrived[:, 250:].all()
        first = arrived.long().argmax(-1) * DT
        assert first.min() < 2.5 < 4.5 < first.max()


def test_commands_never_jump(long):
    for key, speed in (("base_velocity_command", 1.0), ("end_effector_command", 2.0)):
        jump = (long[key][:, 1:] - long[key][:, :-1]).abs().max()
        assert 0 < jump < speed * DT * 1.1


def test_an_episode_starts_from_rest(long):
    assert not long["base_velocity_command"][:, 0].any()
    assert long["base_velocity_command"][:, 1].any()


def test_an_episode_starts_from_the_pose_that_the_end_effector_has():
    names = {f"{name}_keys": (f"{name}_position", f"{name}_quaternion") for name in ("base", "end_effector")}
    shown = rollout(1, **names)[:, 0]
    heading = rotations.yaw_quaternion(rotations.yaw(shown["base_quaternion"]))
    frame = torch.cat((shown["base_position"][:, :2], torch.full((50, 1), CommandRanges().frame_height)), -1)
    start = commands.goal_to_pose(shown["command_start"], torch.tensor(CommandRanges().shoulder))
    position = frame + rotations.rotate(heading, start[:, :3])
    torch.testing.assert_close(position, shown["end_effector_position"])
    attitude = rotations.matrix(rotations.multiply(heading, start[:, 3:]))
    torch.testing.assert_close(attitude, rotations.matrix(shown["end_effector_quaternion"]), atol=1e-5, rtol=1e-5)


def test_on_a_hill_the_hand_starts_where_it_is_over_the_ground():
    """A robot 5 m higher, on ground that is 5 m higher, is told what it would be told below."""
    names = {f"{name}_keys": (f"{name}_position", f"{name}_quaternion") for name in ("base", "end_effector")}
    sampler = CommandSampler(CommandRanges(), DT, **names)
    level = {key: torch.tensor(value) for key, value in zip(POSES, ([0, 0, 0.6], [1, 0, 0, 0]) * 2, strict=True)}
    level |= {"end_effector_position": torch.tensor([0.6, 0.1, 0.9]), "base_height": torch.tensor([0.6])}
    hill = level | {key: level[key] + torch.tensor([0, 0, 5.0]) for key in POSES if key.endswith("position")}
    starts = [sampler._present(torch.tensor(0), TensorDict(shown, [])) for shown in (level, hill)]
    torch.testing.assert_close(*starts)


def test_rows_and_goals_of_one_row_are_drawn_apart(long):
    first, second, third = long["command_goal"][:, [0, 400, 750], 0].unbind(-1)
    assert len(first.unique()) == 50
    for one, other in ((first, second), (second, third), (first, third)):
        assert torch.corrcoef(torch.stack((one, other)))[0, 1].abs() < 0.4


@pytest.mark.parametrize("rate", [0.5, 0.2])
def test_a_sled_is_pulled_back_to_its_line_at_the_rate_asked_for(rate):
    names = {f"{name}_keys": (f"{name}_position", f"{name}_quaternion") for name in ("base", "end_effector")}
    steps = rollout(20, replace(sled_commands(), straighten=rate), **names)
    velocity = steps["base_velocity_command"][:, 1:]
    x, y, angle = steps["command_line"][:, 1:].unbind(-1)
    position = steps["base_position"][:, 1:]
    lateral = (position[..., 1] - y) * angle.cos() - (position[..., 0] - x) * angle.sin()
    walks = velocity[..., 0] != 0
    assert 0.5 < walks.double().mean() < 1
    torch.testing.assert_close(velocity[..., 1][walks], -rate * lateral[walks])
    assert not velocity[~walks].any()


def test_a_pose_that_the_environment_does_not_show_is_refused():
    env = TransformedEnv(ToyEnv(2), CommandSampler(CommandRanges(), DT))
    with pytest.raises(KeyError, match="pass end_effector_keys=None"):
        env.reset()


def test_straightening_needs_the_pose_of_the_base():
    with pytest.raises(ValueError, match="name the base's pose"):
        CommandSampler(sled_commands(), DT, base_keys=None)


def test_one_goal_in_ten_is_to_stand():
    many = commands.draw_goal(streams.stream(0, torch.arange(5000)), CommandRanges().bounds(), 0.1)[0][:, :3]
    assert (many == 0).all(-1).float().mean().item() == pytest.approx(0.1, abs=0.02)


def test_a_pose_is_told_from_a_shoulder_and_in_a_frame_of_one_s_own():
    names = {f"{name}_keys": (f"{name}_position", f"{name}_quaternion") for name in ("base", "end_effector")}
    own = CommandRanges(shoulder=(0.3, 0.1, -0.1), frame_height=0.2)
    steps = rollout(3, own, **names)
    heading = rotations.yaw_quaternion(rotations.yaw(steps["base_quaternion"][:, 0]))
    frame = torch.cat((steps["base_position"][:, 0, :2], torch.full((50, 1), 0.2)), -1)
    seen = rotations.rotate_inverse(heading, steps["end_effector_position"][:, 0] - frame)
    torch.testing.assert_close(steps["end_effector_command"][:, 0, :3], seen, atol=1e-5, rtol=1e-5)
    goal = steps["command_goal"][:, 0]
    distance = (commands.goal_to_pose(goal, torch.tensor(own.shoulder))[:, :3] - torch.tensor(own.shoulder)).norm(
        dim=-1
    )
    torch.testing.assert_close(distance, goal[:, 3])
    start = commands.goal_to_pose(steps["command_start"][:, 0], torch.tensor(own.shoulder))[:, :3]
    torch.testing.assert_close(start, seen, atol=1e-5, rtol=1e-5)


def test_goals_of_a_box_are_drawn_from_it():
    ranges = commands.command_ranges("box")
    steps = rollout(400, replace(ranges, standstill_probability=0.0))
    places = commands.goal_to_pose(steps["command_goal"][:, [0, -1]], torch.tensor(ranges.shoulder))[..., :3]
    low, high = torch.tensor(ranges.box).T
    assert ((places > low - 1e-4) & (places < high + 1e-4)).all()
    assert (places[:, 0] != places[:, 1]).any(-1).all()


@pytest.mark.parametrize(
    ("interval", "dt", "steps"), [(0.3, 0.1, 3), (7.0, 0.02, 350), (0.29, 0.01, 29), (0.01, 0.1, 1)]
)
def test_goals_last_the_number_of_steps_next_to_their_time(interval: float, dt: float, steps: int) -> None:
    assert CommandSampler(CommandRanges(interval=interval, duration=(0.01, 0.01)), dt).interval_steps == steps


def test_memory_stands_in_the_group_that_is_named():
    sampler = CommandSampler(CommandRanges(), 0.02, memory_key=("robot", "command"))
    assert {("robot", f"command_{name}") for name in ("start", "goal", "duration", "stream", "step")} <= set(
        sampler.out_keys
    )
