"""The paper's pre-training environment: what it shows, what it rewards, when it ends."""

import math
from dataclasses import replace
from types import SimpleNamespace

import mujoco
import numpy as np
import pytest
import torch
from scipy.spatial.transform import Rotation
from tensordict import TensorDict
from torchrl.data import Composite, Unbounded
from torchrl.envs import StepCounter, Transform, check_env_specs

from torchrl_athletic.envs import (
    NO_DISTURBANCES,
    Disturbances,
    ball_throw_env,
    phase_inputs,
    sled_pull_env,
    whole_body_env,
    whole_body_rewards,
)
from torchrl_athletic.envs.whole_body import ACTION_SCALE, PRIVILEGED, TrackingErrors, _known, _scaling, fallen
from torchrl_athletic.functional.commands import CommandRanges
from torchrl_athletic.functional.phase import throw_phases
from torchrl_athletic.functional.rewards import WBC_SCALES
from torchrl_athletic.networks import actor, uan
from torchrl_athletic.robots import Handle, Terrain, b2z1, with_options, z1
from torchrl_athletic.training.rollout import control_step
from torchrl_athletic.transforms import (
    B2Z1_PUSHES,
    ActionDelay,
    CommandSampler,
    DomainRandomization,
    EncoderOffset,
    ExternalPush,
    GaitClock,
    InitialState,
    PDControl,
    PoseError,
    PowerClip,
    RandomizationRanges,
    RandomTransform,
    ReferenceTrajectory,
    SledRope,
    StartRanges,
    TaskPhase,
    UANCorrection,
)

ROBOT = b2z1()
POSE = torch.tensor(ROBOT.default_pose, dtype=torch.float32)
STILL = {"disturbances": NO_DISTURBANCES, "net": None}


def stand(tensordict):
    """The action zero is the default pose."""
    return tensordict.set("action", torch.zeros(*tensordict.batch_size, 19))


@pytest.fixture(scope="module")
def standing():
    """Half a second at the default pose, two robots."""
    env = whole_body_env(ROBOT, num_envs=2, disturbances=NO_DISTURBANCES, max_steps=20)
    return env.rollout(25, stand, break_when_any_done=False)


def test_specs_match_data():
    check_env_specs(whole_body_env(num_envs=2, max_steps=3), break_when_any_done="both")


def test_without_arguments_it_is_the_paper_s_pre_training():
    env = whole_body_env(num_envs=3)
    parts = {type(part): part for part in env.transform}
    assert parts.keys() >= {DomainRandomization, EncoderOffset, ActionDelay, ExternalPush, InitialState, UANCorrection}
    assert parts[DomainRandomization].ranges.mass_scale == (0.5, 1.5)
    assert (parts[EncoderOffset].low, parts[EncoderOffset].high) == (-0.05, 0.05)
    assert (parts[ActionDelay].min_steps, parts[ActionDelay].max_steps) == (0, 6)
    assert parts[InitialState].ranges == StartRanges(base_position=(12.0, 12.0, 0.0))
    assert parts[ExternalPush].pushes == B2Z1_PUSHES
    assert (parts[PowerClip].max_power, parts[StepCounter].max_steps, parts[TaskPhase].width) == (300.0, 1000, 4)
    assert "terrain" in env.base_env.robot.ground
    assert env.base_env.physics.model.opt.cone == mujoco.mjtCone.mjCONE_PYRAMIDAL
    assert whole_body_env.__kwdefaults__["num_envs"] == 4096
    td = env.reset()
    assert td["observation"].shape == (3, 770)
    assert td["privileged"].shape[-1] > 77 + 138


def test_every_term_of_the_paper_s_table_is_there_and_they_add_up(standing):
    terms = standing["next", "reward_terms"]
    assert set(terms.keys()) == set(WBC_SCALES)
    total = sum(terms.values(include_nested=True))
    torch.testing.assert_close(standing["next", "reward"], total, atol=1e-5, rtol=1e-5)


def test_rewards_are_rates_over_the_time_of_an_action(standing):
    """Perfect pose tracking earns 5 x 4/3 a second, so 0.133 in 20 ms."""
    assert standing["next", "reward_terms", "ee_pose_tracking"][:, 0].min() > 0.05
    assert standing["next", "reward_terms", "ee_pose_tracking"].max() <= 0.4 / 3 + 1e-6
    twice = whole_body_env(
        b2z1(), num_envs=1, terms=({"one": lambda before, after: torch.ones(1, 1)}, {"one": 3.0}), **STILL
    )
    assert twice.rollout(2, stand)["next", "reward"].flatten().tolist() == pytest.approx([0.06, 0.06])


def test_a_robot_that_stands_neither_collides_nor_falls_nor_breaks_limits(standing):
    terms = standing["next", "reward_terms"]
    assert terms["collision"].abs().max() == 0
    assert terms["joint_limits"].abs().max() < 0.002
    assert not standing["next", "terminated"].any()


def test_episodes_end_at_their_length_and_start_anew(standing):
    assert standing["next", "truncated"].squeeze(-1).nonzero()[:, 1].unique().tolist() == [19]
    assert standing["step_count"][:, 20].unique().tolist() == [0]


def test_the_policy_sees_ten_frames_the_newest_last(standing):
    frame = standing["frame"]
    assert (standing["observation"][:, 12].unflatten(-1, (10, -1)) == frame[:, 3:13]).all()


def test_an_action_moves_the_target_from_the_default_pose_by_its_group_s_scale():
    env = whole_body_env(ROBOT, num_envs=1, **STILL)
    actions = iter([torch.full((1, 19), x) for x in (0.1, 0.2, 0.3)])
    steps = env.rollout(3, lambda td: td.set("action", next(actions)))
    assert steps["last_action"][0, :, 0].tolist() == pytest.approx([0.0, 0.1, 0.2])
    scale = torch.tensor([ACTION_SCALE["leg"]] * 12 + [ACTION_SCALE["arm"]] * 6 + [ACTION_SCALE["gripper"]])
    law = next(part for part in env.transform if isinstance(part, PDControl))
    seen = env.transform._inv_call(env.reset().set("action", torch.full((1, 19), 0.1)))
    torch.testing.assert_close(seen[law.target_key], POSE + 0.1 * scale.unsqueeze(0))


def test_offset_and_scale_can_be_one_s_own_and_a_group_left_out_is_named():
    env = whole_body_env(ROBOT, num_envs=1, action_offset=[0.5] * 19, action_scale=2.0, **STILL)
    law = next(part for part in env.transform if isinstance(part, PDControl))
    seen = env.transform._inv_call(env.reset().set("action", torch.full((1, 19), 0.1)))
    assert seen[law.target_key].unique().tolist() == pytest.approx([0.7])
    with pytest.raises(ValueError, match=r"knows the groups \['leg'\].*jointGripper.*never move"):
        whole_body_env(ROBOT, num_envs=1, action_scale={"leg": 0.25}, **STILL)


def test_actions_are_scaled_as_the_shipped_controllers_were_when_it_was_trained():
    """By Portela et al. for legs and arm; a gripper is no part of their task and hardly moves."""
    assert ACTION_SCALE == {"leg": 0.25, "arm": 0.5, "gripper": 0.1}


def test_a_new_actor_starts_at_the_default_pose():
    env = whole_body_env(num_envs=8)
    policy = actor(770, 19, gain=0.01)
    td = policy(env.reset())  # by its mean
    law = next(part for part in env.transform if isinstance(part, PDControl))
    target = env.transform._inv_call(td)[law.target_key]
    assert (target - POSE).abs().max() < 0.1


def test_a_fallen_robot_is_found_by_its_height_over_the_ground_on_a_slope_too():
    slope = b2z1(terrain=Terrain(roughness=(0.0, 0.0), slope=math.radians(15)))
    env = whole_body_env(slope, num_envs=2, **STILL)
    td = env.reset()
    physics = env.base_env.physics
    for x, height in ((-6.0, 0.55), (6.0, 0.2)):
        ground = x * math.tan(math.radians(15))
        physics.qpos[:, 0], physics.qpos[:, 2] = x, ground + height
        physics.forward()
        shown = env.base_env._observe(torch.zeros(2, 19))
        assert shown["base_height"].flatten().tolist() == pytest.approx([height] * 2, abs=2e-3)
        assert fallen(td.update(shown)).flatten().tolist() == [height < 0.25] * 2


def test_feet_that_stand_on_rough_ground_are_not_read_as_lifted():
    env = whole_body_env(
        num_envs=32, net=None, disturbances=Disturbances(None, (), Disturbances().starts, (0, 0), (0, 0))
    )
    steps = env.rollout(50, stand, break_when_any_done=False)
    feet, force = steps["next", "foot_height"][:, 25:], steps["next", "foot_force"][:, 25:]
    stands = force > 50.0
    assert stands.float().mean() > 0.8
    assert (feet[stands] > 0.043).float().mean() < 0.01  # 12 to 25 % by the height over z = 0
    assert (steps["next", "foot_position"][:, 25:, :, 2][stands] > 0.043).float().mean() > 0.1


def test_a_command_is_the_same_place_over_the_ground_wherever_the_robot_stands():
    high, low = (
        whole_body_env(b2z1(terrain=Terrain(roughness=(0.0, 0.0), slope=slope)), num_envs=1, **STILL)
        for slope in (math.radians(10), 0.0)
    )
    errors = []
    for env, up in ((high, True), (low, False)):
        td = env.reset()
        if up:  # 5 m up the slope, every height is 0.88 m more
            env.base_env.physics.qpos[:, 0] = 5.0
            env.base_env.physics.qpos[:, 2] += 5.0 * math.tan(math.radians(10))
            env.base_env.physics.forward()
        shown = td.update(env.base_env._observe(torch.zeros(1, 19)))
        error = next(part for part in env.transform if type(part).__name__ == "PoseError")
        errors.append(error(shown)["pose_error"])
    torch.testing.assert_close(errors[0], errors[1], atol=2e-3, rtol=0)


@pytest.mark.parametrize("height", [0.5, 0.3])
def test_an_episode_begins_with_the_hand_where_it_is_told_to_be(height):
    """In whatever frame that is told."""
    shown = whole_body_env(ROBOT, num_envs=3, commands=CommandRanges(frame_height=height), net=None).reset()
    assert shown["tracking", "position"].max() < 1e-3
    assert shown["tracking", "attitude"].max() < 1e-2


def test_a_sampler_of_one_s_own_brings_its_frame():
    sampler = CommandSampler(CommandRanges(frame_height=0.3), 0.02)
    shown = whole_body_env(ROBOT, num_envs=1, commands=[sampler, Watcher("dof_damping")], **STILL).reset()
    assert shown["pose_error"].abs().max() < 1e-5


def test_the_errors_shown_are_those_of_an_independent_program():
    env = whole_body_env(num_envs=4, commands=CommandRanges(duration=(0.1, 0.2)))
    shown = env.rollout(12, break_when_any_done=False)["next"][:, -1]
    position, turn = (
        shown["base_position"].numpy(),
        Rotation.from_quat(shown["base_quaternion"].numpy(), scalar_first=True),
    )
    heading = Rotation.from_euler("z", turn.as_euler("ZYX")[:, :1])
    origin = position.copy()
    origin[:, 2] += 0.5 - shown["base_height"][:, 0].numpy()
    command = shown["end_effector_command"].numpy()
    goal = origin + heading.apply(command[:, :3])
    axes = np.stack((command[:, 3:6], command[:, 6:], np.cross(command[:, 3:6], command[:, 6:])), -1)
    wanted = heading * Rotation.from_matrix(axes)
    there = Rotation.from_quat(shown["end_effector_quaternion"].numpy(), scalar_first=True)
    expected = np.linalg.norm(goal - shown["end_effector_position"].numpy(), axis=1)
    np.testing.assert_allclose(shown["tracking", "position"][:, 0], expected, atol=1e-4)
    np.testing.assert_allclose(shown["tracking", "attitude"][:, 0], (wanted.inv() * there).magnitude(), atol=2e-3)
    velocity = shown["base_linear_velocity"][:, :2] - shown["base_velocity_command"][:, :2]
    np.testing.assert_allclose(shown["tracking", "velocity"][:, 0], velocity.norm(dim=-1), atol=1e-6)


def test_power_and_forces_are_means_over_the_four_steps_of_an_action():
    """Against the same robot stepped by MuJoCo alone, with the torques of the chain."""
    env = whole_body_env(ROBOT, num_envs=1, arm_power=None, **STILL)
    td = stand(env.reset())
    model, data = ROBOT.model(), mujoco.MjData(ROBOT.model())
    mujoco.mj_resetDataKeyframe(model, data, model.key("stand").id)
    kp, kd, limit = (np.array(value) for value in (ROBOT.kp, ROBOT.kd, ROBOT.torque_limit))
    columns = [int(model.sensor(f"{leg}_foot_force").adr[0]) for leg in ("FR", "FL", "RR", "RL")]
    for _ in range(5):
        power, force = [], []
        for _ in range(4):
            velocity = data.qvel[6:]
            torque = kp * (np.array(ROBOT.default_pose) - data.qpos[7:]) - kd * velocity
            most = limit * (1 - np.clip(velocity / ROBOT.velocity_limit, 0, 1))
            least = -limit * (1 + np.clip(velocity / ROBOT.velocity_limit, -1, 0))
            data.qfrc_applied[6:] = np.clip(torque, least, most)
            mujoco.mj_step(model, data)
            power.append(data.qfrc_applied[6:] * data.qvel[6:])
            force.append(data.sensordata[columns].copy())
        td = stand(env.step(td)["next"])
        np.testing.assert_allclose(td["joint_power"][0], np.mean(power, 0), atol=2e-3)
        np.testing.assert_allclose(td["foot_force"][0], np.mean(force, 0), rtol=1e-3, atol=0.5)
    assert td["reward_terms", "mechanical_power"].item() == pytest.approx(
        -1e-4 * 0.02 * abs(np.mean(power, 0).sum()), rel=0.02
    )


def test_rewards_and_critic_know_the_true_joints_while_the_drives_read_their_encoders():
    chance = Disturbances(None, (), None, (0.05, 0.05), (0, 0))
    env = whole_body_env(ROBOT, num_envs=2, net=None, disturbances=chance)
    td = env.rollout(3, stand)[:, -1]
    torch.testing.assert_close(td["joint_position"] - td["true_joint_position"], torch.full((2, 19), 0.05))
    torch.testing.assert_close(td["next", "true_joint_position"], env.base_env.physics.joint_position.float())
    deviation = (td["next", "true_joint_position"] - POSE).abs().sum(-1, keepdim=True)
    torch.testing.assert_close(td["next", "reward_terms", "joint_deviation"], -0.25 * 0.02 * deviation)
    assert {"true_joint_position", "encoder_offset"} <= set(PRIVILEGED)


@pytest.mark.parametrize("part", ["thigh", "calf", "shin"])
def test_legs_do_not_pass_through_the_ground(part):
    model = ROBOT.model()
    data = mujoco.MjData(model)
    data.qpos[3], data.qpos[7:] = 1.0, ROBOT.default_pose
    data.qpos[2] = -1.0  # all of it is below the floor
    mujoco.mj_forward(model, data)
    touching = {model.geom(g).name for pair in data.contact.geom for g in pair}
    assert {f"{leg}_{part}" for leg in ("FR", "FL", "RR", "RL")} <= touching


def test_what_kneels_counts_as_a_collision():
    env = whole_body_env(
        ROBOT,
        num_envs=1,
        net=None,
        disturbances=NO_DISTURBANCES,
        terminate=lambda td: torch.zeros(1, 1, dtype=torch.bool),
    )
    env.reset()
    physics = env.base_env.physics
    kneeling = ROBOT.default_pose
    physics.qpos[:, 7:] = torch.tensor(kneeling, dtype=torch.float64)
    for leg in range(4):
        physics.qpos[:, 7 + 3 * leg + 1], physics.qpos[:, 7 + 3 * leg + 2] = 1.2, -2.7
    physics.qpos[:, 2] = 0.3
    td = env.reset()
    physics.qpos[:, 2] = 0.25
    for leg in range(4):
        physics.qpos[:, 7 + 3 * leg + 1], physics.qpos[:, 7 + 3 * leg + 2] = 1.2, -2.7
    steps = []
    for _ in range(40):
        td = env.step(td.set("action", torch.tensor([[0.0, 2.1, -5.6] * 4 + [0.0] * 7])))["next"]
        steps.append(td["reward_terms", "collision"].item())
    assert min(steps) == pytest.approx(-0.1)


def test_a_task_brings_phases_terms_and_ends_of_its_own():
    env = whole_body_env(
        ROBOT,
        num_envs=2,
        schedule=throw_phases(),
        terms=whole_body_rewards(ROBOT, without=("gait", "foot_clearance")),
        terminate=lambda td: td["base_position"][..., :1] > -99.0,
        **STILL,
    )
    steps = env.rollout(3, stand)
    assert steps.shape == (2, 1)
    assert steps["next", "terminated"].all()
    assert (steps["task_phase"] != 0).any()
    assert set(WBC_SCALES) - set(steps["next", "reward_terms"].keys()) == {"gait", "foot_clearance"}


def test_a_finer_time_step_leaves_drives_and_policy_at_their_rates():
    coarse = whole_body_env(ROBOT, num_envs=1, **STILL)
    fine = whole_body_env(with_options(ROBOT, timestep=0.001), num_envs=1, substeps=5, **STILL)
    one, other = (env.rollout(25, stand)["next"][:, -1] for env in (coarse, fine))
    assert float(fine.base_env.physics.time) == pytest.approx(0.5)
    assert one["gait_cycle"].item() == pytest.approx(other["gait_cycle"].item())
    torch.testing.assert_close(one["joint_position"], other["joint_position"], atol=0.01, rtol=0)


@pytest.mark.parametrize(
    ("robot", "told"),
    [
        (z1(), "z1 lacks .*a body with a free joint"),
        (replace(ROBOT, ground=()), "lacks ground, a plane"),
        (
            replace(ROBOT, sensors={k: v for k, v in ROBOT.sensors.items() if k != "leg_force"}),
            "lacks sensors 'leg_force'",
        ),
        (replace(ROBOT, sensors={"foot_force": ROBOT.sensors["foot_force"]}), "lacks sensors 'end_effector_position'"),
    ],
)
def test_a_robot_of_one_s_own_is_told_what_it_lacks(robot, told):
    with pytest.raises(ValueError, match=f"{told}.*Add them to its MJCF"):
        whole_body_env(robot, num_envs=1, action_scale=0.2, **STILL)


@pytest.mark.parametrize(("make", "mend"), [(sled_pull_env, r"tool=Handle\(\)"), (ball_throw_env, "with_bucket")])
def test_a_robot_with_an_empty_hand_is_told_what_to_hold(make, mend):
    with pytest.raises(ValueError, match=f"reads .*Put into its hand.*{mend}"):
        make(ROBOT, num_envs=1)


@pytest.mark.parametrize(("part", "name"), [("objects", "SledRope"), ("extra", "GaitClock"), ("commands", "Reference")])
def test_a_part_that_counts_in_other_steps_than_the_robot_is_refused(part, name):
    """MuJoCo's own time step is 2 ms, at which the paper's motions would be over in 2/5 of their time."""
    robot = with_options(b2z1(tool=Handle()), timestep=0.002)
    made = {
        "objects": SledRope(0.005),
        "extra": GaitClock(0.02),
        "commands": ReferenceTrajectory({"end_effector_command": torch.zeros(2, 9)}, table_dt=0.02, dt=0.02),
    }
    with pytest.raises(ValueError, match=rf"{name}.* takes a step for 0\.0.* lasts 0\.00[28] s.*timestep=0\.005"):
        whole_body_env(robot, num_envs=1, **{part: [made[part]]}, **STILL)


def test_a_part_of_a_batch_is_what_it_is_in_the_whole():
    whole, part = whole_body_env(num_envs=3, net=None), whole_body_env(num_envs=1, first_row=2, net=None)
    one, other = whole.reset(), part.reset()
    for _ in range(20):
        _, one = control_step(whole, stand, one)
        _, other = control_step(part, stand, other)
    for key in ("joint_position", "randomization", "end_effector_command", "push", "action_delay"):
        torch.testing.assert_close(one[key][2:], other[key], atol=1e-5, rtol=1e-5, msg=key)


def test_a_robot_without_torque_falls_and_its_episode_ends():
    env = whole_body_env(ROBOT, num_envs=1, arm_power=None, **STILL)
    for module in env.transform.modules():
        if hasattr(module, "kp"):
            module.kp.zero_()
            module.kd.zero_()
    steps = env.rollout(200, stand)
    assert steps["next", "terminated"][0, -1]
    assert fallen(steps["next"][:, -1]).all()
    assert len(steps[0]) < 100


def test_the_arm_is_corrected_by_the_net_that_is_given():
    net = uan()
    env = whole_body_env(ROBOT, num_envs=1, net=net, disturbances=NO_DISTURBANCES)
    assert next(part for part in env.transform if isinstance(part, UANCorrection)).net is net


def test_no_robot_starts_in_a_slope_though_all_start_level():
    slope = b2z1(terrain=Terrain(roughness=(0.0, 0.0), slope=math.radians(10)), cone="pyramidal")
    env = whole_body_env(slope, num_envs=2, **STILL)
    td = env.reset()
    model = slope.model()
    ground = {model.geom(name).id for name in slope.ground}
    for qpos in env.base_env.physics.qpos.numpy():
        data = mujoco.MjData(model)
        data.qpos[:] = qpos
        mujoco.mj_forward(model, data)
        assert min([0.0, *(contact.dist for contact in data.contact if set(contact.geom) & ground)]) > -1e-3
    most = 0.0
    for _ in range(25):
        td = env.step(stand(td))["next"]
        most = max(most, td["foot_force"].max().item())
    assert most < 5 * 9.81 * model.body_mass.sum()
    assert not td["terminated"].any()


def test_staggered_robots_are_of_all_ages_when_a_training_begins():
    told = {"num_envs": 8, "max_steps": 40, **STILL}
    env = whole_body_env(ROBOT, staggered=True, **told)
    ages = env.reset()["step_count"].flatten()
    assert len(ages.unique()) > 3
    assert ages.max() < 40
    assert (env.reset()["step_count"] == 0).all()
    assert (whole_body_env(ROBOT, **told).reset()["step_count"] == 0).all()
    part = whole_body_env(ROBOT, staggered=True, first_row=6, **(told | {"num_envs": 2}))
    assert part.reset()["step_count"].flatten().tolist() == ages[6:].tolist()


def test_the_critic_knows_what_no_robot_can_sense():
    env = whole_body_env(ROBOT, num_envs=2, net=None)
    td = env.reset()
    known = {key: torch.randn_like(td[key].float()) for key in ("frame", *PRIVILEGED)}
    seen = env.transform[-1]._call(td.clone().update(known))["privileged"]
    assert torch.equal(seen, torch.cat([value.flatten(1) for value in known.values()], -1))
    assert torch.equal(td["frame"], td["observation"][:, -77:])
    order = ("projected_gravity", "base_velocity_command", "end_effector_command", "joint_position", "joint_velocity",
             "last_action", "gait_phase", "task_phase")  # fmt: skip
    assert torch.equal(td["frame"], torch.cat([td[key] for key in order], -1))  # as shipped controllers learnt it
    assert td["action_history"].shape == (2, 3, 19)


class Watcher(Transform):
    """A part that asks for a field of the model and, as an object, for a sensor at every step."""

    def __init__(self, field):
        super().__init__()
        self.fields, self.every_step = (field,), ("end_effector_position",)


ORDER = [
    "EncoderOffset", "Watcher", "PowerClip", "TorqueSpeedClip", "PDControl", "ActionDelay", "Decimation",
    "StepCounter", "StaggeredEpisodes", "InitialState", "DomainRandomization", "ExternalPush", "TaskPhase",
    "CommandSampler", "GaitClock", "Watcher", "PoseError", "TrackingErrors", "ActionScaling", "ActionHistory",
    "RewardTerms", "UnaryTransform", "CatTensors", "ObservationHistory", "Privileged",
]  # fmt: skip


def test_every_part_stands_in_its_place_and_is_told_what_the_environment_was():
    """An action lasts 4 * 3 * 1 ms, which is nobody's default."""
    randomization = RandomizationRanges(mass_scale=(0.7, 0.8))
    chance = Disturbances(randomization, B2Z1_PUSHES[1:2], StartRanges(0.01), (0.02, 0.03), (1, 4))
    ranges, phases = CommandRanges(frame_height=0.4), throw_phases()
    told = {"substeps": 3, "arm_power": 77.0, "history": 3, "max_steps": 9, "task_width": 6, "seed": 5, "first_row": 3}
    env = whole_body_env(
        with_options(ROBOT, timestep=0.001), num_envs=2, net=None, commands=ranges, schedule=phases,
        disturbances=chance, objects=[Watcher("dof_armature")], extra=[Watcher("dof_damping")], staggered=True, **told,
    )  # fmt: skip
    assert [type(part).__name__ for part in env.transform] == ORDER
    drawn = [part for part in env.transform if isinstance(part, RandomTransform)]
    assert {(part.seed, part.first_row) for part in drawn} == {(5, 3)}
    assert len(drawn) == 9
    part = {type(part).__name__: part for part in env.transform}
    for name in ("ExternalPush", "TaskPhase", "CommandSampler", "GaitClock"):
        assert part[name].dt == pytest.approx(0.012), name
    scales = {name: 0.012 * scale for name, scale in WBC_SCALES.items()}
    assert part["RewardTerms"].scales == pytest.approx(scales)
    assert (part["PowerClip"].max_power, part["PowerClip"].joints) == (77.0, "arm")
    assert (part["ActionDelay"].min_steps, part["ActionDelay"].max_steps) == (1, 4)
    assert torch.equal(part["ActionDelay"].before, POSE)
    assert torch.equal(part["ActionHistory"].before, torch.zeros(19))
    assert (part["EncoderOffset"].low, part["EncoderOffset"].high) == (0.02, 0.03)
    assert part["StepCounter"].max_steps == part["StaggeredEpisodes"].max_steps == 9
    assert (part["InitialState"].ranges, part["DomainRandomization"].ranges) == (chance.starts, randomization)
    assert (part["ExternalPush"].pushes, part["CommandSampler"].ranges) == (chance.pushes, ranges)
    assert (part["TaskPhase"].schedule, part["TaskPhase"].width) == (phases, 6)
    assert (part["PoseError"].frame_height, part["ObservationHistory"].length) == (0.4, 3)
    assert {"dof_armature", "dof_damping", "body_mass"} <= set(env.base_env.physics.fields)
    forces = ("foot_force", "leg_force", "trunk_force", "arm_force", "hand_force")
    assert set(env.base_env.every_step) == {*forces, "end_effector_position"}


def test_it_is_made_on_the_device_that_is_asked_for(monkeypatch):
    made = []

    def refuse(robot, **told):
        made.append(told["device"])
        raise NotImplementedError

    monkeypatch.setattr("torchrl_athletic.envs.whole_body.TorqueEnv", refuse)
    with pytest.raises(NotImplementedError):
        whole_body_env(ROBOT, device="cuda:1", net=None)
    assert made == ["cuda:1"]


def test_errors_of_keypoints_and_of_turning_are_distances_by_hand():
    torch.manual_seed(0)
    shapes = {"pose_error": (5, 4, 3)} | dict.fromkeys(
        ("base_linear_velocity", "base_angular_velocity", "base_velocity_command"), (5, 3)
    )
    shown = TensorDict({key: torch.randn(shape) for key, shape in shapes.items()}, [5])
    errors = TrackingErrors()._call(shown.clone())["tracking"]
    way = shown["pose_error"]
    torch.testing.assert_close(errors["position"], way[:, 0].norm(dim=-1, keepdim=True))
    torch.testing.assert_close(errors["keypoints"][:, 0], sum(way[:, k].norm(dim=-1) for k in range(4)) / 4)
    turning = shown["base_angular_velocity"][:, 2:] - shown["base_velocity_command"][:, 2:]
    torch.testing.assert_close(errors["yaw_rate"], turning.abs())


def test_a_robot_has_fallen_that_is_low_or_leans_by_more_than_60_degrees():
    lean = torch.deg2rad(torch.tensor([0.0, 0.0, 59.0, 61.0, 180.0]))
    gravity = torch.stack((lean.sin(), torch.zeros(5), -lean.cos()), -1)
    height = torch.tensor([[0.24], [0.26], [0.5], [0.5], [0.5]])
    shown = TensorDict(base_height=height, projected_gravity=gravity, batch_size=[5])
    assert fallen(shown).flatten().tolist() == [True, False, False, True, True]


def test_a_scale_by_group_is_that_of_the_groups_joints_in_whatever_order_groups_are_told():
    told = {"gripper": 0.1, "arm": 0.2, "leg": 0.3}
    for order in (list(told), sorted(told), list(told)[::-1]):
        scaling = _scaling(ROBOT, None, {group: told[group] for group in order})
        assert scaling.scale.tolist() == pytest.approx([0.3] * 12 + [0.2] * 6 + [0.1])
        torch.testing.assert_close(scaling.loc, POSE)


def test_entries_within_others_are_found_and_those_that_are_not_there_passed_over():
    env = SimpleNamespace(full_observation_spec=Composite(tracking=Composite(position=Unbounded(1)), push=Unbounded(1)))
    assert _known(env, ["push", ("tracking", "position"), "pull"]) == ["push", ("tracking", "position")]


def test_the_phase_is_shown_in_each_frame_behind_all_else():
    env = whole_body_env(ROBOT, num_envs=1, history=3, task_width=5, schedule=throw_phases(), **STILL)
    for frames, seen in ((None, 3), (1, 1), (2, 2)):
        places = phase_inputs(env, frames=frames)
        assert places == [78 * frame + 73 + column for frame in range(seen) for column in range(5)]
    shown = env.reset()
    assert shown["observation"][0, phase_inputs(env)[-5:]].equal(shown["task_phase"][0])


def test_parts_that_are_given_keep_their_order_and_get_their_fields_and_a_net_is_found_by_its_name(monkeypatch):
    made, asked = [], []

    def refuse(base, parts):
        made.append((base, list(parts)))
        raise NotImplementedError

    monkeypatch.setattr("torchrl_athletic.envs.whole_body.TransformedEnv", refuse)
    monkeypatch.setattr("torchrl_athletic.envs.whole_body.TorqueEnv", lambda robot, **told: told)
    monkeypatch.setattr("torchrl_athletic.envs.whole_body.shipped_net", lambda name, _: asked.append(name) or uan())
    steer = [Watcher("first"), Watcher("second")]
    chain = [Watcher("dof_frictionloss"), PDControl(ROBOT.kp, ROBOT.kd)]
    for told in ({"chain": chain}, {"net": "mine"}):
        with pytest.raises(NotImplementedError):
            whole_body_env(ROBOT, num_envs=2, commands=steer, disturbances=NO_DISTURBANCES, **told)
    (base, parts), (_, netted) = made
    assert [part.fields for part in parts if part in steer] == [("first",), ("second",)]
    assert base["fields"] == ["dof_frictionloss"]
    [error] = (part for part in parts if isinstance(part, PoseError))
    assert error.frame_height == CommandRanges().frame_height == 0.5
    assert asked == ["mine"]
    assert any(isinstance(part, UANCorrection) for part in netted)
