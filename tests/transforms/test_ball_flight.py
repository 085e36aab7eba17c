"""The ball and the phases of its task; its way is tested with the arm that throws it."""

from functools import partial

import pytest
import torch
from tensordict import TensorDict
from torchrl.envs import Compose, StepCounter, TransformedEnv

from torchrl_athletic.envs import TorqueEnv
from torchrl_athletic.functional.phase import Phase, PhaseSchedule
from torchrl_athletic.robots import Bucket, with_bucket, z1
from torchrl_athletic.transforms import BallFlight, Decimation, TaskPhase

BUCKET = Bucket()
FLIGHT = partial(BallFlight, 0.005, rim=BUCKET.rim, radius=BUCKET.ball_radius, placed_at=0.06)


def shown(schedule, steps=10, **told):
    base = TorqueEnv(with_bucket(z1(), BUCKET), num_envs=8, every_step=BallFlight.every_step)
    env = TransformedEnv(base, Compose(FLIGHT(**told), Decimation(4), StepCounter(steps), TaskPhase(schedule, 0.02)))
    return env.rollout(2 * steps, lambda td: td.set("torque", torch.zeros(8, 7)), break_when_any_done=False)


def placed(steps):
    return (steps["next", "ball_position"] != 0).any(-1)


def test_the_time_of_the_ball_counts_from_its_phase_and_an_episode_past_it_has_none():
    schedule = PhaseSchedule((Phase("set-up", 0.1), Phase("settle", start_probability=0.5)))
    steps = shown(schedule, phase=0)
    for episode in (slice(0, 10), slice(10, 20)):
        first = steps["task_phase_index"][:, episode][:, 0, 0]
        assert placed(steps)[:, episode][first == 0].int().tolist() == [[0, 0, *[1] * 8]] * int((first == 0).sum())
        assert not placed(steps)[:, episode][first == 1].any()
    assert 0 < steps["task_phase_index"][:, 0].sum() < 8


def test_a_ball_stays_there_when_its_phase_is_over():
    schedule = PhaseSchedule((Phase("set-up", 0.04), Phase("throw")))
    assert placed(shown(schedule, phase=0))[:, :10].int().tolist() == [[0, 0, *[1] * 8]] * 8


def test_without_a_phase_it_counts_from_the_start_of_the_episode():
    schedule = PhaseSchedule((Phase("set-up", 0.1), Phase("settle", start_probability=0.5)))
    assert placed(shown(schedule)).int().tolist() == [[0, 0, *[1] * 8] * 2] * 8


def test_a_ball_that_is_away_is_not_caught_again_and_one_inside_turns_with_its_walls():
    """Its bucket points along x; the first ball flies below it, the second is carried, by a bucket that turns."""
    flight = BallFlight(0.005, rim=0.05, radius=0.035, placed_at=0.005)
    axis = torch.tensor([[1.0, 0.0, 0.0], [0.0, 0.0, 1.0]])
    before = TensorDict(
        ball_position=[[-1.0, 0.0, 3.0], [0.0, 0.0, 0.04]],
        ball_linear_velocity=torch.zeros(2, 3),
        ball_away=[[True], [False]],
        ball_age=[[9], [9]],
        ball_launch_velocity=[[1.0, 2.0, 3.0], [1.0, 2.0, 3.0]],
        bucket_axis=axis,
        batch_size=[2],
    )
    turned = torch.tensor([[0.0, 1.0, 0.0], [0.6, 0.0, 0.8]])
    bucket = {"bucket_position": torch.zeros(2, 3), "bucket_linear_velocity": torch.zeros(2, 3), "bucket_axis": turned}
    after = TensorDict(bucket, [2])
    flight.advance(before, after)
    assert after["ball_away"].flatten().tolist() == [True, False]
    torch.testing.assert_close(after["ball_linear_velocity"][0], torch.tensor([0.0, 0.0, -9.81 * 0.005]))
    launch = after["ball_launch_velocity"]
    assert launch[0].tolist() == [1.0, 2.0, 3.0]  # gravity changes what flies, not how it was thrown
    torch.testing.assert_close(launch[1], after["ball_linear_velocity"][1])
    above = after["ball_position"][1].norm()
    sideways = torch.tensor([0.8, 0.0, -0.6])  # across the walls that turn
    turning = above * ((turned - axis)[1] @ sideways) / 0.005
    torch.testing.assert_close(after["ball_linear_velocity"][1] @ sideways, turning)


@pytest.mark.parametrize(("age", "there"), [(0, False), (58, False), (59, True)])
def test_a_ball_is_put_where_the_bucket_is_and_as_fast_as_it_and_was_nowhere_before(age: int, there: bool) -> None:
    """After 0.3 s, in steps of 0.005 s; whatever is remembered of an earlier ball is gone."""
    flight = BallFlight(0.005, rim=0.05, radius=0.035, placed_at=0.3)
    axis = torch.tensor([[0.0, 0.0, 1.0]])
    bucket = {"bucket_position": [[1.0, 2.0, 3.0]], "bucket_linear_velocity": [[4.0, 5.0, 6.0]], "bucket_axis": axis}
    before = TensorDict(
        ball_position=torch.full((1, 3), 7.0),
        ball_linear_velocity=torch.full((1, 3), 7.0),
        ball_away=[[False]],
        ball_age=[[age]],
        ball_launch_velocity=torch.zeros(1, 3),
        bucket_axis=axis,
        batch_size=[1],
    )
    after = TensorDict(bucket, [1])
    flight.advance(before, after)
    assert after["ball_position"].tolist() == [[1.0, 2.0, 3.0] if there else [0.0] * 3]
    assert after["ball_linear_velocity"].tolist() == [[4.0, 5.0, 6.0] if there else [0.0] * 3]
    assert not after["ball_away"].any()


@pytest.mark.parametrize(("placed_at", "dt", "steps"), [(0.3, 0.1, 3), (1.5, 0.005, 300), (0.29, 0.01, 29)])
def test_the_ball_comes_at_the_step_next_to_its_time(placed_at: float, dt: float, steps: int) -> None:
    assert BallFlight(dt, rim=0.05, radius=0.035, placed_at=placed_at).placed == steps


@pytest.mark.parametrize("radius", [0.035, 0.1])
def test_a_ball_that_lands_rests_on_the_ground_with_its_radius(radius: float) -> None:
    axis = torch.tensor([[0.0, 0.0, 1.0]])
    before = TensorDict(
        ball_position=[[1.0, 0.0, radius + 0.001]],
        ball_linear_velocity=[[0.0, 0.0, -2.0]],
        ball_away=[[True]],
        ball_age=[[9]],
        ball_launch_velocity=torch.zeros(1, 3),
        bucket_axis=axis,
        batch_size=[1],
    )
    after = TensorDict({"bucket_position": axis, "bucket_linear_velocity": 0 * axis, "bucket_axis": axis}, [1])
    BallFlight(0.005, rim=0.2, radius=radius, placed_at=0.005).advance(before, after)
    torch.testing.assert_close(after["ball_position"], torch.tensor([[1.0, 0.0, radius]]))
    assert after["ball_linear_velocity"].tolist() == [[0.0, 0.0, 0.0]]
