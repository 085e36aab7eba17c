"""The throw: what is shown, what is rewarded, what counts, and where the ball goes."""

from dataclasses import replace
from functools import partial

import mujoco
import numpy as np
import pytest
import torch
from tensordict import TensorDict
from torchrl.data import Composite, Unbounded
from torchrl.envs import Compose, Transform, TransformedEnv, UnaryTransform, check_env_specs

from torchrl_athletic.envs import (
    ThrowFailure,
    TorqueEnv,
    actuation_chain,
    throw_distance,
    throw_env,
    throw_reference,
    throw_summary,
    throw_task,
)
from torchrl_athletic.envs.throw import BUCKET, DT, PLACED_AT, STEPS, AroundReference, throw_rewards
from torchrl_athletic.functional import rewards
from torchrl_athletic.functional.ball import GRAVITY
from torchrl_athletic.functional.phase import throw_phases
from torchrl_athletic.networks import uan
from torchrl_athletic.robots import Bucket, with_bucket, z1
from torchrl_athletic.testing import no_host_sync
from torchrl_athletic.training import CapturedRollout, Rollout
from torchrl_athletic.transforms import (
    BallFlight,
    Decimation,
    DomainRandomization,
    EncoderOffset,
    RandomizationRanges,
    StartRanges,
    TaskPhase,
)

ROBOT = with_bucket(z1(), BUCKET)
REFERENCE = throw_reference(ROBOT)
BALL = {"rim": BUCKET.rim, "radius": BUCKET.ball_radius}


def follow(env, offset=0.0, steps=STEPS):
    """Play the reference, every joint off by so much."""
    act = lambda td: td.set("action", torch.full((*td.shape, 6), offset))  # noqa: E731
    return env.rollout(steps, act, break_when_any_done=False)


@pytest.fixture(scope="module")
def thrown():
    """The throw made by hand, twice."""
    return follow(throw_env(ROBOT, num_envs=2, ends=False))


def test_specs_match_data():
    check_env_specs(throw_env(ROBOT, num_envs=2))


def test_specs_match_data_with_a_net_and_random_arms():
    chain = actuation_chain(ROBOT, net=uan(), max_delay=2)
    ranges = RandomizationRanges(friction=None, restitution=None)
    randomization = DomainRandomization(ranges, joints="arm")
    env = throw_env(ROBOT, num_envs=2, chain=chain, extra=[randomization], privileged=["randomization"])
    check_env_specs(env)
    drawn = env.observation_spec["randomization"].shape[-1]
    assert env.observation_spec["privileged"].shape[-1] == 12 + drawn


def test_the_reference_keeps_clear_of_the_limits_and_starts_and_ends_at_rest_at_home():
    limits = torch.tensor(ROBOT.position_limit)[:6]
    assert ((REFERENCE > limits[:, 0] + 0.3) & (REFERENCE < limits[:, 1] - 0.3)).all()
    home = torch.tensor(ROBOT.default_pose)[:6]
    torch.testing.assert_close(REFERENCE[[0, -1]], home.expand(2, -1))
    assert (REFERENCE[1] - REFERENCE[0]).abs().max() < 1e-3
    assert REFERENCE.diff(dim=0).abs().max() / DT < 2 * ROBOT.velocity_limit[1]


def test_the_throw_made_by_hand_counts_and_goes_forward(thrown):
    end = thrown[:, -1]["next"]
    assert not thrown["next", "throw_failed"].any()
    assert (throw_distance(end) > 1.0).all()
    assert (end["ball_position"][:, 2] == BUCKET.ball_radius).all()  # it lies on the floor
    torch.testing.assert_close(throw_distance(end), end["ball_position"][:, 0])


def test_where_it_will_land_is_known_from_the_moment_it_leaves(thrown):
    shown = thrown["next"]
    away = shown["ball_away"].squeeze(-1)
    assert 125 < away[0].int().argmax() < 175  # in the phase of throwing
    foreseen = throw_distance(shown)[away]
    torch.testing.assert_close(foreseen, foreseen.max().expand_as(foreseen), atol=2e-3, rtol=0)


def test_the_ball_is_in_the_bucket_from_its_time_until_it_leaves(thrown):
    shown = thrown["next"][0]
    there = (torch.arange(STEPS) + 1) * DT >= PLACED_AT - 1e-9
    away = shown["ball_away"].squeeze(-1)
    gap = torch.linalg.vector_norm(shown["ball_position"] - shown["bucket_position"], dim=-1)
    assert gap[there & ~away].max() < BUCKET.rim
    assert (shown["ball_position"][~there] == 0).all()
    assert gap[away][-1] > 0.5


def test_a_ball_on_its_way_obeys_gravity(thrown):
    shown = thrown["next"][0]
    fell = shown["ball_linear_velocity"].diff(dim=0) / DT
    flies = shown["ball_away"].squeeze(-1) & (shown["ball_position"][:, 2] > BUCKET.ball_radius)
    flies = flies[:-1] & flies[1:]
    expected = torch.tensor([0.0, 0.0, -GRAVITY]).expand_as(fell[flies])
    torch.testing.assert_close(fell[flies], expected, atol=1e-3, rtol=0)


def test_it_throws_about_as_far_as_a_ball_with_contacts():
    """MuJoCo's own ball, in the same bucket, thrown by the same targets: walls have slack there, and friction."""
    robot = z1(tool=BUCKET)
    model = robot.model()
    data = mujoco.MjData(model)
    mujoco.mj_resetDataKeyframe(model, data, model.key("default").id)
    kp, kd, limit, fastest = (np.array(x) for x in (robot.kp, robot.kd, robot.torque_limit, robot.velocity_limit))
    home = np.array(robot.default_pose)
    for k in range(STEPS):
        target = home.copy()
        target[:6] = REFERENCE[k].numpy()
        for substep in range(4):
            if round(PLACED_AT / DT) * 4 >= 4 * k + substep:  # until then, and then for the last time, put it there
                mujoco.mj_forward(model, data)
                data.qpos[7:10] = data.sensor("bucket_position").data
                data.qvel[7:10] = data.sensor("bucket_linear_velocity").data
                data.qvel[10:] = 0
            used = np.clip(data.qvel[:7] / fastest, -1, 1)
            low, high = -limit * (1 + np.minimum(used, 0)), limit * (1 - np.maximum(used, 0))
            data.ctrl[:] = np.clip(kp * (target - data.qpos[:7]) - kd * data.qvel[:7], low, high)
            mujoco.mj_step(model, data)
            if data.qpos[9] < BUCKET.ball_radius + 0.01 and k > 130:
                break
        else:
            continue
        break
    with_contacts = data.qpos[7]
    without = throw_distance(follow(throw_env(ROBOT, num_envs=1, ends=False))[:, -1]["next"])
    assert with_contacts > 1.0
    assert float(without) == pytest.approx(with_contacts, rel=0.15)


def test_terms_add_up_and_the_ball_is_rewarded_in_its_phase_only(thrown):
    terms = thrown["next", "reward_terms"]
    total = sum(terms.values(include_nested=True))
    torch.testing.assert_close(thrown["next", "reward"], total, atol=1e-5, rtol=1e-5)
    phase = thrown["task_phase_index"]
    assert terms["forward"][phase != 1].abs().max() == 0
    assert terms["reference"][phase != 0].abs().max() == 0
    velocity = thrown["next", "ball_linear_velocity"]
    throw = phase.squeeze(-1) == 1
    torch.testing.assert_close(terms["forward"][throw], 20 * DT * velocity[throw][:, :1].clamp(min=0))
    torch.testing.assert_close(terms["upward"][throw], 20 * DT * velocity[throw][:, 2:].clamp(min=0))


def test_moving_forward_and_up_is_good_and_sideways_or_astray_is_bad():
    terms, scales = throw_rewards(ROBOT)
    reference = torch.cat((torch.zeros(1, 6), torch.ones(1, 6)), -1)  # that of later does not count
    before = TensorDict(task_phase_index=[[1]], throw_failed=[[False]], batch_size=[1])
    after = {"joint_position": torch.zeros(1, 7), "reference": reference, "throw_failed": torch.tensor([[True]])}

    def gain(name, velocity=(0.0, 0.0, 0.0), **changes):
        entries = {**after, "ball_linear_velocity": torch.tensor([velocity]), **changes}
        return scales[name] * float(terms[name](before, TensorDict(entries, batch_size=[1])))

    assert gain("forward", (2.0, 0.0, 0.0)) == pytest.approx(40.0)
    assert gain("forward", (-2.0, 0.0, 0.0)) == 0
    assert gain("upward", (0.0, 0.0, 3.0)) == pytest.approx(60.0)
    assert gain("lateral", (0.0, -2.0, 0.0)) == pytest.approx(-2.0)
    assert gain("failure") < 0
    before["task_phase_index"] = torch.tensor([[0]])
    assert gain("forward", (2.0, 0.0, 0.0)) == 0
    assert gain("reference", joint_position=torch.full((1, 7), 0.1)) == pytest.approx(-5 * 0.6)


def test_the_policy_sees_no_ball_but_the_critic_does():
    env = throw_env(ROBOT, num_envs=2, ends=False)
    shown = follow(env, steps=100)
    frame = shown["frame"][0, 99]
    assert frame.shape[-1] == 6 + 6 + 6 + 12 + 4
    now, moving = shown[0, 99], shown[0, 50]
    arm = [moving["joint_position"][:6], moving["joint_velocity"][:6], moving["action_history"][-1, :6]]
    assert torch.equal(moving["frame"], torch.cat((*arm, REFERENCE[50], REFERENCE[55], moving["task_phase"])))
    assert torch.equal(moving["action_history"][-1, :6], REFERENCE[49])
    of_the_ball = ("ball_position", "ball_linear_velocity", "bucket_position", "bucket_linear_velocity")
    assert torch.equal(now["privileged"], torch.cat([now[key] for key in of_the_ball]))
    assert now["ball_position"].abs().max() > 0


def test_zero_action_is_the_reference_and_the_gripper_stays_shut(thrown):
    history = thrown["next", "action_history"][0, :, -1]
    torch.testing.assert_close(history[:, :6], REFERENCE[:STEPS])
    assert (history[:, 6] == ROBOT.default_pose[6]).all()


def test_the_action_is_added_to_the_reference_and_counts_in_full_in_the_throw():
    targets = follow(throw_env(ROBOT, num_envs=1, ends=False), offset=0.1)["next", "action_history"][0, :, -1]
    beside = targets[:, :6] - REFERENCE[:STEPS]
    throw = torch.zeros(STEPS, 1)
    throw[125:175] = 1
    torch.testing.assert_close(beside, (0.025 + 0.075 * throw).expand_as(beside))


def fails(position=ROBOT.default_pose, height=0.5, away=False, phase=0, robot=ROBOT, **options):
    """Whether a step with such an end fails, and whether it ends the episode."""
    transform = ThrowFailure(robot, **options)
    before = TensorDict(task_phase_index=[[phase]], throw_failed=[[False]], batch_size=[1])
    flag = torch.zeros(1, 1, dtype=torch.bool)
    after = TensorDict(
        joint_position=torch.as_tensor(np.float32(position))[None],
        bucket_position=torch.tensor([[0.5, 0.0, height]]),
        ball_away=torch.tensor([[away]]),
        done=flag,
        terminated=flag.clone(),
        batch_size=[1],
    )
    transform.advance(before, after)
    assert after["done"].equal(after["terminated"])
    return bool(after["throw_failed"]), bool(after["done"])


def test_what_makes_a_throw_not_count():
    low, high = np.array(ROBOT.default_pose), np.array(ROBOT.default_pose)
    low[1], high[3] = ROBOT.position_limit[1][0] - 0.03, ROBOT.position_limit[3][1] + 0.03
    assert fails() == (False, False)
    assert fails(low) == (True, True)
    assert fails(high) == (True, True)
    assert fails(high, tolerance=0.05) == (False, False)
    assert fails(height=0.05) == (True, True)
    assert fails(away=True, phase=0) == (True, True)  # lost before its time
    assert fails(away=True, phase=1) == (False, False)
    assert fails(height=0.05, ends=False) == (True, False)


def test_a_failed_throw_is_of_no_length():
    place = torch.tensor([[1.0, 0.0, 1.0], [1.0, 0.0, 1.0], [1.0, 0.0, 1.0], [-2.0, 0.0, 1.0]])
    entries = {"ball_position": place, "ball_linear_velocity": torch.zeros(4, 3)}
    away, failed = torch.tensor([[True], [True], [False], [True]]), torch.tensor([[False], [True], [False], [False]])
    step = TensorDict({**entries, "ball_away": away, "throw_failed": failed}, batch_size=[4])
    assert throw_distance(step).tolist() == [1.0, 0.0, 0.0, -2.0]  # behind the base is less than nothing


def test_a_ball_that_is_lost_in_the_set_up_ends_the_episode():
    env = throw_env(with_bucket(z1(), Bucket(opening=(0.0, 0.0, 1.0))), num_envs=1)  # the bucket is upside down
    shown = follow(env, steps=100)["next"]
    ended = int(shown["terminated"].flatten().int().argmax())
    assert PLACED_AT / DT <= ended < PLACED_AT / DT + 10


def test_starts_differ_and_the_seed_says_how():
    first = [throw_env(ROBOT, num_envs=3, seed=seed).reset()["joint_position"] for seed in (0, 0, 1)]
    torch.testing.assert_close(first[0], first[1], atol=0, rtol=0)
    assert (first[0] != first[2]).any()
    assert len(first[0][:, 1].unique()) == 3
    assert (first[0] - torch.tensor(ROBOT.default_pose)).abs().max() <= 0.05


def test_a_step_waits_for_no_device():
    env = throw_env(ROBOT, num_envs=2)
    chain = env.transform
    step = env.reset().set("action", torch.zeros(2, 6))
    shown = env._step(step.copy())
    after = next(k for k, item in enumerate(chain) if isinstance(item, Decimation)) + 1
    with no_host_sync():
        inner = step.copy()
        for transform in list(chain)[after:][::-1]:
            inner = transform._inv_call(inner)
        for transform in (chain[1], *list(chain)[after:]):
            transform._step(inner, shown)
    assert shown["reward"].isfinite().all()


def test_it_collects_for_training():
    env = throw_env(ROBOT, num_envs=2)
    act = lambda td: td.set("action", torch.zeros(*td.shape, 6))  # noqa: E731
    for kind in (Rollout, CapturedRollout):
        batch = kind(env, act, horizon=3, keys=["observation", "privileged"])()
        assert batch["next", "privileged"].shape == (2, 3, 12)


def test_the_task_needs_no_simulation_of_ours():
    """Any environment will do that takes targets and shows the joints and the bucket: a robot's, say."""
    chain = throw_env(ROBOT, num_envs=1).transform
    outside = [type(item).__name__ for item in throw_task(ROBOT)]
    assert [type(item).__name__ for item in chain][-len(outside) :] == outside


def test_no_time_is_no_flight():
    with pytest.raises(ValueError, match="hang in the air"):
        BallFlight(0.0, **BALL)


def test_sensors_at_the_physics_rate_are_fresh():
    env = TorqueEnv(ROBOT, num_envs=1, every_step=BallFlight.every_step)
    env.reset()
    torque = torch.full((1, 7), 5.0)
    for _ in range(5):
        shown = env._step(TensorDict(torque=torque, _substep=torch.zeros(1, 1), batch_size=[1]))
    assert "end_effector_position" not in shown.keys()
    env.physics.forward()
    torch.testing.assert_close(shown["bucket_position"], env.physics.data("sensordata").float()[:, _place()])


def _place():
    sensor = ROBOT.model().sensor("bucket_position")
    return slice(int(sensor.adr[0]), int(sensor.adr[0]) + 3)


def test_a_sensor_that_is_not_there_is_refused():
    with pytest.raises(ValueError, match=r"every_step names \['bucket_axis'\].*end_effector_position"):
        TorqueEnv(z1(), every_step=["bucket_axis"])


def test_the_ball_flies_the_same_whatever_stands_outside():
    """Its physics is inside Decimation: the same steps one by one."""
    torques = torch.full((1, 7), -3.0)
    flight = partial(BallFlight, 0.005, **BALL, placed_at=0.01)
    base = TorqueEnv(ROBOT, num_envs=1, every_step=BallFlight.every_step)
    inside = TransformedEnv(base, Compose(flight(), Decimation(4)))
    alone = TransformedEnv(TorqueEnv(ROBOT, num_envs=1), flight())
    act = lambda td: td.set("torque", torques)  # noqa: E731
    few, many = inside.rollout(5, act)["next"], alone.rollout(20, act)["next"]
    for key in ("ball_position", "ball_linear_velocity", "ball_away", "ball_age"):
        torch.testing.assert_close(few[key], many[key][:, 3::4])


ORDER = [
    "EncoderOffset", "InitialState", "BallFlight", "PowerClip", "TorqueSpeedClip", "PDControl", "Decimation",
    "DomainRandomization", "StepCounter", "TaskPhase", "ReferenceTrajectory", "ActionHistory", "ThrowFailure",
    "RewardTerms", "UnaryTransform", "UnaryTransform", "UnaryTransform", "CatTensors", "ObservationHistory",
    "CatTensors", "AroundReference",
]  # fmt: skip


def test_every_part_stands_in_its_place_and_is_told_what_the_environment_was():
    randomization = DomainRandomization(RandomizationRanges(friction=None, restitution=None), joints="arm")
    told = {"spread": 0.02, "tolerance": 0.3, "ends": False, "seed": 5, "first_row": 3}
    env = throw_env(ROBOT, num_envs=2, sensing=[EncoderOffset()], extra=[randomization], **told)
    assert [type(part).__name__ for part in env.transform] == ORDER
    part = {type(part).__name__: part for part in env.transform}
    start, flight, failure = part["InitialState"], part["BallFlight"], part["ThrowFailure"]
    assert (start.seed, start.first_row) == (5, 3)
    assert start.ranges == StartRanges(0.02, 0.0, (0.0,) * 3, (0.0,) * 3, (0.0,) * 3, (0.0,) * 3)
    assert (flight.dt, flight.rim, flight.radius) == (0.005, BUCKET.rim, BUCKET.ball_radius)
    assert (flight.placed, flight.phase, part["PowerClip"].max_power) == (300, None, 300.0)
    limits = torch.tensor(ROBOT.position_limit)[:6]
    torch.testing.assert_close(failure.limits, limits + torch.tensor([-0.3, 0.3]))
    assert failure.ends is False
    assert part["StepCounter"].max_steps == STEPS
    torch.testing.assert_close(part["ActionHistory"].before, torch.tensor(ROBOT.default_pose))


def test_terms_of_all_phases_are_what_they_are_by_hand():
    torch.manual_seed(0)
    terms, scales = throw_rewards(ROBOT)
    failed = torch.tensor([[False], [True], [False], [True]])
    before = TensorDict(throw_failed=torch.tensor([[False], [False], [True], [True]]), batch_size=[4])
    shapes = {"applied_torque": (7,), "joint_velocity": (7,), "joint_position": (7,), "action_history": (3, 7)}
    after = TensorDict({key: 2 * torch.randn(4, *shape) for key, shape in shapes.items()}, [4])
    after["throw_failed"], after["arm_force"] = failed, torch.tensor([[0.0, 0.0], [9.0, 0.0], [0.0, 9.0], [0.1, 0.1]])
    position, pose = after["joint_position"], torch.tensor(ROBOT.default_pose)
    low, high = torch.tensor(ROBOT.position_limit).T
    first, second, third = after["action_history"].unbind(1)
    expected = {
        "mechanical_power": (after["applied_torque"] * after["joint_velocity"]).sum(-1).abs(),
        "action_smoothness": (third - second).square().sum(-1) + (third - 2 * second + first).square().sum(-1) / 2,
        "joint_deviation": (position - pose).abs().sum(-1),
        "collision": torch.tensor([0.0, 1.0, 1.0, 0.0]),
        "joint_limits": ((low - position).clamp(min=0) + (position - high).clamp(min=0)).sum(-1),
        "failure": torch.tensor([0.0, 1.0, 0.0, 0.0]),  # once
    }
    for name, value in expected.items():
        torch.testing.assert_close(terms[name](before, after)[:, 0], value, msg=name)
    own = {"reference": -5.0, "forward": 20.0, "upward": 20.0, "lateral": -0.5, "failure": -1000.0}
    assert scales == own | {name: rewards.WBC_SCALES[name] for name in expected if name != "failure"}


def test_a_throw_that_failed_stays_failed():
    transform = ThrowFailure(ROBOT, ends=False)
    before = TensorDict(task_phase_index=[[1], [1]], throw_failed=[[True], [False]], batch_size=[2])
    pose = torch.tensor(ROBOT.default_pose).expand(2, -1)
    high, held = torch.tensor([[0.5, 0.0, 0.5]] * 2), torch.zeros(2, 1, dtype=torch.bool)
    after = TensorDict(joint_position=pose, bucket_position=high, ball_away=held, batch_size=[2])
    transform.advance(before, after)
    assert after["throw_failed"].flatten().tolist() == [True, False]


def test_a_summary_counts_failed_throws_as_of_no_length():
    flies = {"ball_position": torch.tensor([[3.0, 0.0, 0.035]] * 3), "ball_linear_velocity": torch.zeros(3, 3)}
    flags = {"ball_away": torch.ones(3, 1, dtype=torch.bool), "throw_failed": torch.tensor([[True], [False], [False]])}
    found = throw_summary(TensorDict({**flies, **flags}, [3]))
    assert found == {k: pytest.approx(x) for k, x in zip(found, (2.0, 2**0.5, 1 / 3), strict=True)}
    assert list(found) == ["distance_m", "spread_m", "failed"]


def test_what_goes_into_a_buffer_stays_as_the_policy_chose_it():
    step = TensorDict(
        action=torch.ones(2, 6), reference=torch.ones(2, 12), task_phase_index=torch.ones(2, 1), batch_size=[2]
    )
    assert AroundReference(ROBOT).inv(step.clone())["action"].equal(step["action"])


class Asking(Transform):
    """A part that asks for a field of the model."""

    def __init__(self, field):
        super().__init__()
        self.fields = (field,)


def test_the_simulation_is_made_where_it_is_asked_for_with_all_fields_that_any_part_changes(monkeypatch):
    made = []

    def refuse(robot, **told):
        made.append(told)
        raise NotImplementedError

    monkeypatch.setattr("torchrl_athletic.envs.throw.TorqueEnv", refuse)
    parts = {name: [Asking(field)] for name, field in (("sensing", "b"), ("chain", "c"), ("extra", "a"))}
    with pytest.raises(NotImplementedError):
        throw_env(ROBOT, num_envs=3, device="cuda:1", **parts)
    [told] = made
    assert (told["num_envs"], told["device"], told["fields"]) == (3, "cuda:1", ["a", "b", "c"])


def test_an_action_is_added_to_the_reference_whatever_their_entries_are_called(monkeypatch):
    monkeypatch.setattr(AroundReference, "parent", "an environment")
    names = {"action_key": "steer", "reference_key": "course", "phase_key": "part"}
    around = AroundReference(ROBOT, 0.5, **names)
    phases = torch.tensor([[0], [1], [2]])
    step = TensorDict(steer=torch.ones(3, 6), course=torch.arange(12.0).repeat(3, 1), part=phases, batch_size=[3])
    target = around._inv_call(step)["steer"]
    assert target[:, 0].tolist() == [0.5, 1.0, 0.5]
    assert (target[:, 5] - target[:, 0]).tolist() == [5.0] * 3
    spec = Composite(full_action_spec=Composite(steer=Unbounded(7)))
    assert around.transform_input_spec(spec)["full_action_spec"]["steer"].shape == (6,)


def test_an_arm_that_does_not_begin_with_the_first_joint_is_thrown_with_and_judged_by_its_own_joints():
    robot = replace(ROBOT, joint_groups={"arm": tuple(range(1, 7))})
    pose, limits = torch.tensor(robot.default_pose), torch.tensor(robot.position_limit)
    torch.testing.assert_close(throw_reference(robot)[0], pose[1:])
    parts = throw_task(robot)
    counted = torch.arange(7.0).expand(2, 3, 7)
    shown = [part._fn(counted) for part in parts if isinstance(part, UnaryTransform)]
    assert [each[0].flatten()[-6:].tolist() for each in shown] == [[1.0, 2.0, 3.0, 4.0, 5.0, 6.0]] * 3
    assert [each.shape for each in shown] == [(2, 3, 6), (2, 3, 6), (2, 6)]
    [failure] = (part for part in parts if isinstance(part, ThrowFailure))
    torch.testing.assert_close(failure.limits, limits[1:] + torch.tensor([-0.01, 0.01]))
    for joint, beyond in ((0, False), (6, True)):
        assert fails(pose + 99.0 * (torch.arange(7) == joint), robot=robot)[0] is beyond
    terms, _ = throw_rewards(robot)
    before = TensorDict(task_phase_index=[[0]], batch_size=[1])
    after = TensorDict(joint_position=torch.arange(7.0)[None], reference=torch.arange(1.0, 13.0)[None], batch_size=[1])
    assert terms["reference"](before, after).item() == 0.0
    [phases] = (part for part in parts if isinstance(part, TaskPhase))
    assert phases.schedule == throw_phases(stay_probability=0.0, settle_probability=0.0)


def test_the_reference_waits_for_the_phase_of_throwing_swings_in_it_and_waits_until_it_is_over():
    """Back by 1.9 s; the throw is on from 2.5 s to 3.5 s; home at 4 s."""
    moves = REFERENCE.diff(dim=0).abs().amax(1) > 1e-6
    times = torch.arange(STEPS) * DT
    swings = (times >= 2.5 - 1e-6) & (times < 2.9 - 1e-6)
    assert moves.equal((times < 1.9 - 1e-6) | swings | (times >= 3.5 - 1e-6))


def test_an_episode_that_ended_otherwise_stays_ended_though_its_throw_counts():
    before = TensorDict(task_phase_index=[[1]], throw_failed=[[False]], batch_size=[1])
    no, yes = torch.zeros(1, 1, dtype=torch.bool), torch.ones(1, 1, dtype=torch.bool)
    pose, high = torch.tensor([ROBOT.default_pose]), torch.tensor([[0.5, 0.0, 0.5]])
    after = {"joint_position": pose, "bucket_position": high, "ball_away": no, "done": yes, "terminated": no}
    after = TensorDict(after, [1])
    ThrowFailure(ROBOT).advance(before, after)
    assert [bool(after[key]) for key in ("throw_failed", "done", "terminated")] == [False, True, False]
