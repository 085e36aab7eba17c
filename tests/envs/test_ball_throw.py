"""The throw of the whole robot: ball, phases, rewards, distance."""

import math
from dataclasses import replace

import mujoco
import pytest
import torch
from tensordict import TensorDict
from torchrl.envs import check_env_specs

from torchrl_athletic.envs import NO_DISTURBANCES, Disturbances, ball_throw_distance, ball_throw_env, ball_throw_rewards
from torchrl_athletic.envs.ball_throw import KNOWN
from torchrl_athletic.envs.throw import BUCKET
from torchrl_athletic.envs.whole_body import PRIVILEGED
from torchrl_athletic.functional.ball import GRAVITY
from torchrl_athletic.functional.phase import throw_phases
from torchrl_athletic.robots import b2z1, with_bucket
from torchrl_athletic.transforms import BallFlight, Decimation, OverspeedBrake, StartRanges, UANCorrection

ROBOT = with_bucket(b2z1(), BUCKET)
PHASES = throw_phases(stay_probability=0.0, settle_probability=0.0)


def hold(td):
    """The pose to which the motion takes the arm, the legs as they stand."""
    action = torch.zeros(*td.shape, 19)
    default = torch.tensor(ROBOT.default_pose)[12:18]
    action[..., 12:18] = (td["joint_reference"][..., 12:18] - default) / 0.5
    return td.set("action", action)


@pytest.fixture(scope="module")
def played():
    env = ball_throw_env(ROBOT, num_envs=2, net=None, schedule=PHASES, disturbances=NO_DISTURBANCES, max_steps=180)
    return env.rollout(180, hold, break_when_any_done=False)


def test_specs_match_data():
    check_env_specs(ball_throw_env(num_envs=2))


def test_the_policy_sees_what_the_controller_sees_and_the_critic_the_ball():
    env = ball_throw_env(num_envs=2)
    shown = env.reset()
    assert shown["observation"].shape == (2, 770)
    widths = [shown[key].flatten(1).shape[-1] for key in KNOWN]
    assert widths == [3, 1, 3, 3]
    torch.testing.assert_close(shown["privileged"][:, -3:], shown["bucket_axis"])


def test_the_ball_runs_at_the_rate_of_the_physics():
    kinds = [type(part) for part in ball_throw_env(ROBOT, num_envs=1).transform]
    assert kinds.index(BallFlight) < kinds.index(Decimation)


def test_the_arm_s_motors_brake_next_to_the_joints_where_the_body_swings_them_too_fast():
    parts = list(ball_throw_env(ROBOT, num_envs=1).transform)
    kinds = [type(part) for part in parts]
    assert kinds.index(OverspeedBrake) < kinds.index(UANCorrection)  # the last on the way to the joint
    brake = parts[kinds.index(OverspeedBrake)]
    assert brake.torque_limit.tolist() == pytest.approx(ROBOT.torque_limit[12:18])
    assert brake.velocity_limit.tolist() == pytest.approx(ROBOT.velocity_limit[12:18])
    fast = TensorDict(torque=torch.zeros(1, 19), joint_velocity=torch.full((1, 19), 40.0), batch_size=[1])
    torque = brake.inv(fast)["torque"][0]
    assert (torque[12:18] < 0).all()
    assert not torque[[*range(12), 18]].any()


def test_the_motion_holds_the_ball_from_1_5_s_on_and_throws_it_forward_in_its_phase(played):
    there = (played["next", "ball_position"] != 0).any(-1)
    assert there.int().argmax(1).tolist() == [74, 74]  # what a step leads to: 1.5 s
    away = played["next", "ball_away"].squeeze(-1)
    leaves = away.int().argmax(1)
    assert ((leaves > 125) & (leaves <= 175)).all()
    assert not played["next", "terminated"][:, :150].any()
    assert (ball_throw_distance(played["next"][:, -1]) > 0.3).all()
    assert (played["next", "peak_power"].diff(dim=1) >= 0).all()


def test_terms_count_in_their_phases(played):
    terms, phase = played["next", "reward_terms"], played["task_phase_index"]
    assert terms["distance"][phase != 1].abs().max() == 0
    assert terms["reference"][phase != 0].abs().max() == 0
    assert terms["stance"][phase == 1].abs().max() == 0
    assert terms["stance"][phase == 2].abs().max() > 0


def test_a_launch_is_paid_once_by_how_far_the_ball_will_go(played):
    """As printed each step is paid, so that early throws earn more, and gravity takes from those that go up."""
    earned = played["next", "reward_terms", "distance"].squeeze(-1)
    assert (earned > 0).sum(1).tolist() == [1, 1]
    paid, last = earned.amax(1), played["next"][:, -1]
    assert (played["next", "ball_away"].squeeze(-1).int().argmax(1) == earned.argmax(1)).all()
    torch.testing.assert_close(paid, 10 * ball_throw_distance(last).squeeze(-1), atol=1e-3, rtol=1e-3)


def test_only_a_launch_in_the_throw_ahead_of_the_start_is_paid_and_sideways_costs():
    terms, scales = ball_throw_rewards(ROBOT, PHASES)
    left = math.pi / 2

    def earned(name, velocity, was_away=False, away=True, phase=1):
        before = TensorDict(task_phase_index=[[phase]], ball_away=[[was_away]], batch_size=[1])
        after = TensorDict(
            ball_position=[[3.0, 1.0, 0.035 + 9.81 / 2]],  # falls for a second
            ball_linear_velocity=[velocity],
            ball_launch_velocity=[velocity],
            ball_away=[[away]],
            start_line=[[3.0, 1.0, left]],
            batch_size=[1],
        )
        return scales[name] * float(terms[name](before, after))

    assert earned("distance", [0.0, 2.0, 0.0]) == pytest.approx(1000.0, rel=1e-4)
    assert earned("distance", [0.0, -2.0, 0.0]) == 0.0
    assert earned("distance", [0.0, 2.0, 0.0], was_away=True) == 0.0
    assert earned("distance", [0.0, 2.0, 0.0], away=False) == 0.0
    assert earned("distance", [0.0, 2.0, 0.0], phase=2) == 0.0
    assert earned("lateral", [2.0, 0.0, 0.0]) == pytest.approx(-2.0)
    assert earned("lateral", [-2.0, 5.0, 1.0]) == pytest.approx(-2.0)


def test_as_printed_each_step_of_the_throw_pays_the_ball_s_velocity_and_a_loss_costs_nothing():
    terms, scales = ball_throw_rewards(ROBOT, PHASES, as_printed=True)
    assert not {"distance", "overspeed", "lost_ball", "failure"} & scales.keys()
    assert terms.keys() == scales.keys()

    def earned(velocity, phase=1):
        """Forward, upward, lateral; the robot looks to the left."""
        before = TensorDict(task_phase_index=[[phase]], batch_size=[1])
        line = [[3.0, 1.0, math.pi / 2]]
        after = TensorDict(ball_linear_velocity=[velocity], start_line=line, batch_size=[1])
        return [scales[name] * float(terms[name](before, after)) for name in ("forward", "upward", "lateral")]

    assert earned([-2.0, 3.0, 4.0]) == pytest.approx([60.0, 80.0, -2.0], rel=1e-5)
    assert earned([0.0, -3.0, -4.0]) == pytest.approx([0.0, 0.0, 0.0], abs=1e-5)
    assert earned([-2.0, 3.0, 4.0], phase=0) == [0.0, 0.0, 0.0]


def test_what_an_arm_s_joint_turns_beyond_its_motor_costs_either_way_and_legs_do_not():
    terms, scales = ball_throw_rewards(ROBOT, PHASES)
    arm = list(ROBOT.joint_groups["arm"])
    limit = torch.tensor([ROBOT.velocity_limit[j] for j in arm])
    velocity = torch.full((1, len(ROBOT.velocity_limit)), 99.0)
    velocity[0, arm] = limit - 0.1
    velocity[0, arm[1]], velocity[0, arm[4]] = limit[1] + 2.0, -limit[4] - 0.5
    cost = terms["overspeed"](TensorDict(batch_size=[1]), TensorDict(joint_velocity=velocity, batch_size=[1]))
    assert scales["overspeed"] * cost.item() == pytest.approx(-20 * 2.5, rel=1e-5)


def test_the_distance_is_ahead_of_the_start_whatever_way_the_robot_looks():
    flies = TensorDict(
        ball_position=[[2.0, 5.0, 0.035]] * 3,
        ball_linear_velocity=torch.zeros(3, 3),
        ball_away=[[True], [True], [False]],
        start_line=[[2.0, 1.0, math.pi / 2], [2.0, 1.0, 0.0], [2.0, 1.0, math.pi / 2]],
        batch_size=[3],
    )
    assert ball_throw_distance(flies).flatten().tolist() == pytest.approx([4.0, 0.0, 0.0], abs=1e-5)


def test_robots_that_look_elsewhere_throw_as_far():
    heading = StartRanges(0.0, 0.0, (0.0,) * 3, (0.0, 0.0, 3.0), (0.0,) * 3, (0.0,) * 3)
    turned = Disturbances(None, (), heading, (0.0, 0.0), (0, 0))
    env = ball_throw_env(ROBOT, num_envs=3, net=None, schedule=PHASES, disturbances=turned, max_steps=180)
    steps = env.rollout(180, hold, break_when_any_done=False)
    assert steps["start_line"][:, 0, 2].std() > 0.1
    away = steps["next", "ball_away"].squeeze(-1).int().argmax(1)
    distance = ball_throw_distance(steps["next"][torch.arange(3), away])
    assert distance.std() < 0.2 * distance.mean()


def test_a_ball_that_is_lost_in_the_set_up_ends_the_episode_and_one_that_is_thrown_does_not(played):
    env = ball_throw_env(ROBOT, num_envs=1, net=None, schedule=PHASES, disturbances=NO_DISTURBANCES)
    still = lambda td: td.set("action", torch.zeros(1, 19))  # noqa: E731  the bucket hangs upside down in front
    steps = env.rollout(120, still)
    assert 75 < steps.shape[1] < 100
    assert steps["next", "terminated"][0, -1]
    cost = steps["next", "reward_terms", "lost_ball"][0]
    assert cost[-1] == pytest.approx(-20.0)
    assert (cost[:-1] == 0).all()
    assert (played["next", "reward_terms", "lost_ball"] == 0).all()  # a ball that is thrown is not lost
    throws = played["next", "ball_away"] & (played["task_phase_index"] == 1)
    assert throws.any()
    assert not played["next", "terminated"][throws].any()


@pytest.fixture
def told(monkeypatch):
    """What the environment below is told, where nothing is a default."""
    asked = {}
    below = "torchrl_athletic.envs.ball_throw"
    monkeypatch.setattr(f"{below}.whole_body_env", lambda robot, **told: asked.update(told, robot=robot))
    monkeypatch.setattr(f"{below}.references", lambda *motion: [motion])
    ball_throw_env(ROBOT, schedule=PHASES, disturbances=OFF, motion="other", **GIVEN)
    return asked


OFF = replace(NO_DISTURBANCES, encoder_offset=(0.0, 0.1))
GIVEN = {"num_envs": 7, "max_steps": 9, "seed": 5, "first_row": 3, "history": 2}


def test_the_environment_below_is_told_all_that_the_task_was(told):
    assert told.items() >= {**GIVEN, "robot": ROBOT, "schedule": PHASES, "disturbances": OFF}.items()
    assert told["commands"] == [("other", ROBOT, PHASES)]
    assert told["privileged"] == (*PRIVILEGED, *KNOWN)
    _, flight, peak = told["objects"]
    assert (flight.dt, flight.rim, flight.radius) == (0.005, BUCKET.rim, BUCKET.ball_radius)
    assert (flight.placed, flight.phase, peak.joints) == (300, 0, "leg")
    assert [type(part).__name__ for part in told["extra"]] == ["StartLine", "EarlyTermination"]


def test_true_joints_are_what_counts_where_encoders_are_off(told):
    terms, scales = told["terms"]
    assert terms.keys() == scales.keys()
    assert terms["joint_limits"].keys == terms["joint_deviation"].keys == ("true_joint_position",)
    position, reference = torch.zeros(1, 19), torch.zeros(1, 19)
    position[0, 3], position[0, 13], position[0, 18] = 1.0, 0.2, 1.0  # a leg, the arm, the gripper
    after = TensorDict(true_joint_position=position, joint_reference=reference, batch_size=[1])
    cost = terms["reference"](TensorDict(task_phase_index=[[0]], batch_size=[1]), after)
    assert scales["reference"] * cost.item() == pytest.approx(-5 * 0.2)
    assert (scales["stance"], scales["failure"], scales["lost_ball"]) == (-5.0, -1000.0, -1000.0)


def test_a_ball_is_lost_that_is_away_in_the_set_up(told):
    away, phase = torch.tensor([[True], [True], [True], [False]]), torch.tensor([[0], [1], [2], [0]])
    before, after = TensorDict(task_phase_index=phase, batch_size=[4]), TensorDict(ball_away=away, batch_size=[4])
    assert told["extra"][1].condition(before, after).flatten().tolist() == [True, False, False, False]


def test_without_arguments_it_is_the_paper_s_task_for_the_robot_of_the_pre_training_with_a_bucket(monkeypatch):
    made = []
    monkeypatch.setattr(
        "torchrl_athletic.envs.ball_throw.whole_body_env", lambda *robot, **told: made.append((robot, told))
    )
    ball_throw_env()
    [([robot], told)] = made
    assert robot.ground == ("floor", "terrain")
    assert "bucket_axis" in robot.sensors
    assert robot.model().opt.cone == mujoco.mjtCone.mjCONE_PYRAMIDAL
    assert (told["schedule"], told["disturbances"]) == (throw_phases(), Disturbances())
    assert [told[name] for name in ("num_envs", "max_steps", "seed", "first_row")] == [4096, 300, 0, 0]


def test_a_ball_is_down_when_its_underside_is():
    """It falls for half a second, at 2 m/s to the left of the world, where the robot looked."""
    down = BUCKET.ball_radius + GRAVITY * 0.5**2 / 2
    flies = TensorDict(
        ball_position=[[3.0, 1.0, down]],
        ball_linear_velocity=[[0.0, 2.0, 0.0]],
        ball_away=[[True]],
        start_line=[[3.0, 0.0, math.pi / 2]],
        batch_size=[1],
    )
    assert ball_throw_distance(flies).item() == pytest.approx(2.0, abs=1e-4)


def test_what_the_critic_is_new_to_is_as_large_as_it_is_said_to_be(played):
    """Flags and axes are 1 at most; the hand throws at some 5 m/s, and so the ball flies."""
    shown = played["next"]
    assert shown["bucket_axis"].norm(dim=-1).max() == pytest.approx(KNOWN["bucket_axis"], rel=1e-3)
    assert shown["ball_away"].max() == KNOWN["ball_away"]
    for key in ("ball_launch_velocity", "bucket_linear_velocity"):
        assert 0.4 < shown[key].norm(dim=-1).max() / KNOWN[key] < 2.5, key
