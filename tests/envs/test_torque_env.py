"""One step of the environment is one step of MuJoCo, and what it shows is the state that the step led to."""

from dataclasses import replace
from types import SimpleNamespace

import mujoco
import numpy as np
import pytest
import torch
from tensordict import TensorDict
from torchrl.envs import check_env_specs

from torchrl_athletic.envs import TorqueEnv
from torchrl_athletic.envs import torque_env as module
from torchrl_athletic.physics import BatchPhysics
from torchrl_athletic.robots import Robot, Terrain, b2z1, z1

ARM, DOG = z1(), b2z1()


def torques(env, steps, size=5.0, seed=0):
    generator = torch.Generator().manual_seed(seed)
    return size * torch.randn(steps, env.numel(), len(env.robot.joint_names), generator=generator)


def roll(env, actions, tensordict=None):
    tensordict = env.reset() if tensordict is None else tensordict
    shown = []
    for torque in actions:
        tensordict = env.step(tensordict.set("torque", torque))["next"]
        shown.append(tensordict)
    return shown


@pytest.mark.parametrize("robot", [ARM, DOG], ids=["z1", "b2z1"])
def test_specs_match_data(robot):
    check_env_specs(TorqueEnv(robot, num_envs=2))


@pytest.mark.parametrize("robot", [ARM, DOG], ids=["z1", "b2z1"])
def test_a_row_moves_as_a_loop_of_mj_step_does(robot):
    env = TorqueEnv(robot, num_envs=3)
    actions = torques(env, 20)
    shown = roll(env, actions)
    model = robot.model()
    data = mujoco.MjData(model)
    mujoco.mj_resetDataKeyframe(model, data, model.key(robot.keyframe).id)
    dofs = [model.joint(name).dofadr[0] for name in robot.joint_names]
    for action, seen in zip(actions, shown, strict=True):
        data.qfrc_applied[dofs] = action[1].double()
        mujoco.mj_step(model, data)
        position = [data.joint(name).qpos[0] for name in robot.joint_names]
        velocity = [data.joint(name).qvel[0] for name in robot.joint_names]
        np.testing.assert_array_equal(seen["joint_position"][1], np.float32(position))
        np.testing.assert_array_equal(seen["joint_velocity"][1], np.float32(velocity))


def test_sensors_and_base_describe_the_state_after_the_step():
    env = TorqueEnv(DOG, num_envs=2)
    seen = roll(env, torques(env, 30, size=20.0))[-1][0]
    model = DOG.model()
    data = mujoco.MjData(model)
    data.qpos[:], data.qvel[:] = env.physics.qpos[0], env.physics.qvel[0]
    mujoco.mj_forward(model, data)
    at = {name: data.sensor(names[0]).data for name, names in DOG.sensors.items()}
    for key in ("end_effector_position", "end_effector_quaternion", "end_effector_linear_velocity"):
        np.testing.assert_allclose(seen[key], at[key], atol=1e-6, rtol=1e-5)
    base = data.body("base")
    turned = base.xmat.reshape(3, 3)
    np.testing.assert_allclose(seen["base_position"], base.xpos, atol=1e-6)
    np.testing.assert_allclose(seen["base_linear_velocity"], turned.T @ data.qvel[:3], atol=1e-5)
    np.testing.assert_allclose(seen["projected_gravity"], turned.T @ [0, 0, -1], atol=1e-5)
    spin = np.zeros(6)
    mujoco.mj_objectVelocity(model, data, mujoco.mjtObj.mjOBJ_XBODY, base.id, spin, 1)
    np.testing.assert_allclose(seen["base_angular_velocity"], spin[:3], atol=1e-5)


def test_a_dropped_robot_falls_freely_in_its_base_s_axes():
    env = TorqueEnv(DOG, num_envs=1)
    qpos = env.physics.qpos.clone()
    qpos[:, 2] += 2.0
    env.reset()
    dropped = env._reset(TensorDict(reset_qpos=qpos, batch_size=[1]))
    seen = roll(env, torch.zeros(20, 1, 19), dropped)[-1]
    assert seen["base_linear_velocity"][0, 2] == pytest.approx(-9.81 * 0.1, rel=2e-2)
    assert seen["foot_force"].abs().max() == 0


@pytest.mark.parametrize("robot", [ARM, DOG], ids=["z1", "b2z1"])
def test_a_masked_reset_leaves_the_other_rows_to_the_last_bit(robot):
    """Also those whose feet press into the ground, out of which a robot that starts is lifted."""
    env = TorqueEnv(robot, num_envs=3)
    last = roll(env, torques(env, 10))[-1]
    before = env.physics.qpos.clone()
    shown = env.reset(TensorDict({"_reset": torch.tensor([[False], [True], [False]])}, [3]))
    assert (env.physics.qpos[[0, 2]] == before[[0, 2]]).all()
    assert shown["joint_position"][1].tolist() == pytest.approx(robot.default_pose)
    assert last["joint_position"][1].tolist() != pytest.approx(robot.default_pose)


def test_an_episode_starts_where_the_reset_is_told_to():
    env = TorqueEnv(ARM, num_envs=2)
    env.reset()
    qpos, qvel = env.physics.qpos + 0.1, torch.full((2, env.physics.model.nv), 0.3, dtype=torch.float64)
    shown = env._reset(TensorDict({"reset_qpos": qpos, "reset_qvel": qvel}, [2]))
    assert shown["joint_position"][0].tolist() == pytest.approx([x + 0.1 for x in ARM.default_pose])
    assert shown["joint_velocity"].unique().tolist() == pytest.approx([0.3])


def test_rows_left_out_of_a_step_stay_as_they_are():
    env = TorqueEnv(ARM, num_envs=2)
    env.reset()
    before = env.physics.qpos.clone()
    env._step(TensorDict({"torque": torch.ones(2, 7), "_step": torch.tensor([True, False])}, [2]))
    assert (env.physics.qpos[1] == before[1]).all()
    assert (env.physics.qpos[0] != before[0]).any()


def test_a_substep_shows_joints_only():
    env = TorqueEnv(DOG, num_envs=1)
    env.reset()
    shown = env._step(TensorDict({"torque": torch.zeros(1, 19), "_substep": torch.zeros(1, 1)}, [1]))
    joints = {"joint_position", "joint_velocity", "joint_power"}
    assert set(shown.keys()) == joints | {"reward", "done", "terminated", "truncated"}


def test_an_episode_ends_where_it_is_told_to():
    env = TorqueEnv(ARM, num_envs=2, terminate=lambda shown: shown["joint_position"][..., :1] > 0.05)
    push = torch.zeros(40, 2, 7)
    push[:, 1, 0] = 10.0
    shown = roll(env, push)[-1]
    assert shown["terminated"].tolist() == shown["done"].tolist() == [[False], [True]]


@pytest.mark.parametrize("terminate", [None, lambda shown: torch.zeros(2, 1, dtype=torch.bool)])
def test_a_simulation_that_diverges_ends_its_episode_and_no_other(terminate):
    env = TorqueEnv(ARM, num_envs=2, terminate=terminate)
    env.reset()
    env.physics.qvel[1] = 1e12
    shown = env.step(TensorDict(torque=torch.zeros(2, 7), batch_size=[2]))["next"]
    assert shown["terminated"].tolist() == shown["done"].tolist() == [[False], [True]]
    assert not shown["truncated"].any()  # a value is not carried on from there


def test_between_the_steps_of_an_action_nobody_asks_whether_the_episode_has_failed():
    """Nothing is shown there to tell it by."""
    env = TorqueEnv(ARM, terminate=lambda shown: shown["end_effector_position"][..., 2:] > -9.0)
    step = TensorDict(torque=torch.zeros(1, 7), batch_size=[1])
    assert env._step(step)["terminated"].all()
    assert not env._step(step.set("_substep", torch.zeros(1, 1)))["terminated"].any()


def test_groups_name_columns_of_the_joints():
    env = TorqueEnv(DOG, num_envs=1)
    assert [DOG.joint_names[j] for j in env.joint_groups["gripper"]] == [DOG.joint_names[-1]]


def test_physics_of_other_joints_is_refused():
    physics = BatchPhysics(ARM.model(), 1, joint_names=ARM.joint_names[::-1])
    with pytest.raises(ValueError, match=r"joint_names=robot\.joint_names"):
        TorqueEnv(ARM, physics)


def test_a_robot_without_sensors_of_its_base_is_read_off_its_free_joint():
    """To what the sensors of one that has them say."""
    sensing, bare = TorqueEnv(DOG, num_envs=2), TorqueEnv(replace(DOG, sensors={}), num_envs=2)
    actions = torques(sensing, 30, size=20.0)
    one, other = (roll(env, actions)[-1] for env in (sensing, bare))
    keys = {"base_position", "base_quaternion", "base_linear_velocity", "base_angular_velocity", "projected_gravity"}
    assert keys <= set(other.keys())
    for key in keys:
        torch.testing.assert_close(other[key], one[key], atol=1e-5, rtol=1e-4, msg=key)
    assert one["base_angular_velocity"].abs().max() > 0.1


def test_torques_lie_within_what_the_motors_give_at_rest():
    space, limit = TorqueEnv(ARM, num_envs=2).full_action_spec["torque"].space, torch.tensor(ARM.torque_limit)
    torch.testing.assert_close(space.high, limit.expand(2, -1))
    torch.testing.assert_close(space.low, -limit.expand(2, -1))


def test_the_ground_below_the_base_is_the_mean_of_as_large_a_square_as_one_likes():
    rough = b2z1(terrain=Terrain(roughness=(0.1, 0.1)))
    env = TorqueEnv(rough, footprint=1.5)
    place = torch.rand(50, 3, generator=torch.Generator().manual_seed(0)) * 4 - 2
    below = place[:, 2:] - env.heights(place, None)["base_height"]
    torch.testing.assert_close(below, env.ground.averaged(1.5).height(place[:, :2]))
    assert (below - env.ground.averaged(0.5).height(place[:, :2])).abs().max() > 1e-3
    feet = place.reshape(25, 2, 3)
    below = feet[..., 2] - env.heights(place[:25], feet)["foot_height"]
    torch.testing.assert_close(below, env.ground.height(feet[..., :2]).squeeze(-1))  # every bump is felt by a foot


def test_a_push_takes_the_place_of_the_last_one_of_its_name_adds_to_others_and_ends_with_its_episode():
    """A body that is named twice is pushed twice."""
    env = TorqueEnv(ARM, num_envs=2)
    env.reset()
    twice, other = torch.tensor([2, 2, 3]), torch.tensor([3])
    first = torch.arange(36.0).reshape(2, 3, 6)
    env.set_wrench("hand", twice, first)
    env.set_wrench("wind", other, torch.full((2, 1, 6), 100.0))
    env.set_wrench("hand", twice, 10 * first)
    applied = env.physics.xfrc_applied
    torch.testing.assert_close(applied[:, 2].float(), 10 * (first[:, 0] + first[:, 1]))
    torch.testing.assert_close(applied[:, 3].float(), 10 * first[:, 2] + 100.0)
    env.reset(TensorDict({"_reset": torch.tensor([[True], [False]])}, [2]))
    assert not env.physics.xfrc_applied[0].any()
    env.set_wrench("hand", twice, first)
    torch.testing.assert_close(env.physics.xfrc_applied[0, 3].float(), first[0, 2])  # the wind has ended there
    torch.testing.assert_close(env.physics.xfrc_applied[1, 3].float(), first[1, 2] + 100.0)
    env.reset()
    env.set_wrench("hand", twice, first)
    torch.testing.assert_close(env.physics.xfrc_applied[:, 3].float(), first[:, 2])


def test_a_torque_is_held_for_as_many_steps_as_told():
    action = torques(TorqueEnv(ARM, num_envs=2), 1)
    (once,) = roll(TorqueEnv(ARM, num_envs=2, substeps=3), action)
    *_, last = roll(TorqueEnv(ARM, num_envs=2), action.repeat(3, 1, 1))
    for key in ("joint_position", "joint_velocity"):
        assert once[key].equal(last[key])
    assert once["applied_torque"].equal(action[0])
    torch.testing.assert_close(once["joint_power"], action[0] * once["joint_velocity"])


def test_what_every_step_shows_must_be_a_sensor_and_forces_are_averaged_over_an_action_as_power_is():
    with pytest.raises(ValueError, match=r"every_step names \['nothing'\]"):
        TorqueEnv(DOG, every_step=["nothing", "foot_force"])
    env = TorqueEnv(DOG, every_step=["foot_force", "foot_position"])
    assert env.averaged_keys == ("joint_power", "foot_force")  # a place has no mean over the way there
    assert TorqueEnv(DOG).averaged_keys == ("joint_power",)


SENSED = """<mujoco><worldbody><body><freejoint/><geom size="1"/><site name="a"/><site name="b"/></body></worldbody>
  <sensor><framepos name="p" objtype="site" objname="a"/><framepos name="q" objtype="site" objname="b"/>
  <touch name="t" site="a"/><touch name="u" site="b"/><touch name="v" site="a"/>
  <touch name="w" site="b"/></sensor></mujoco>"""


@pytest.mark.parametrize(
    ("names", "columns", "shape"),
    [
        ("t", [6], (1,)),
        ("p", [0, 1, 2], (3,)),
        ("tu", [6, 7], (2,)),
        ("tvuw", [6, 8, 7, 9], (4,)),  # no block, though it ends as one
        ("qp", [3, 4, 5, 0, 1, 2], (2, 3)),  # in the order that they are named in
    ],
)
def test_sensors_are_columns_in_the_order_of_their_names(names, columns, shape):
    found, size = module._columns(mujoco.MjModel.from_xml_string(SENSED), list(names), torch.device("cpu"))
    assert module._numbers(found) == columns
    assert size == shape
    assert isinstance(found, slice) is (names not in ("qp", "tvuw"))


def test_a_base_without_a_free_joint_floats_not():
    model = mujoco.MjModel.from_xml_string(SENSED)
    assert module._free_joint(model, None) == (None, None)
    with pytest.raises(ValueError, match="no free joint"):
        module._free_joint(ARM.model(), ARM.model().body(ARM.model().joint(ARM.joint_names[0]).bodyid[0]).name)


TWO = """<mujoco><worldbody><body name="pole"><geom size="0.1"/></body>
  <body name="ball" pos="0 0 9"><freejoint/><geom size="0.1"/></body>
  <body name="base" pos="3 0 9"><freejoint/><geom size="0.1"/><site name="s"/><site name="top" pos="0 0 1"/>
  <body pos="0 0 1"><joint name="hip" axis="0 1 0"/><geom size="0.1"/></body></body></worldbody>
  <sensor><touch name="felt" site="s"/><jointpos name="turned" joint="hip"/>
  <framepos name="where" objtype="site" objname="top"/></sensor>
  <keyframe><key name="first"/><key name="second" qpos="0 0 8 1 0 0 0  4 0 7 1 0 0 0  0.5"/></keyframe></mujoco>"""


def floating(**changes):
    """A body that floats beside another one that does, with one joint."""
    robot = Robot(
        name="two", joint_names=("hip",), joint_groups={}, default_pose=(0.5,), kp=(1.0,), kd=(0.1,),
        torque_limit=(1.0,), velocity_limit=(9.0,), position_limit=((-1.0, 1.0),), base="base", sensors={},
        build=lambda: mujoco.MjSpec.from_string(TWO), keyframe="second", ground=(),
    )  # fmt: skip
    return replace(robot, **changes)


def test_a_base_is_read_from_its_own_columns_and_starts_at_the_robots_own_keyframe():
    env = TorqueEnv(floating(), num_envs=1)
    env.reset()
    env.physics.qvel[:] = torch.arange(13.0)
    shown = env._observe(torch.zeros(1, 1))
    assert shown["base_position"].tolist() == [[4.0, 0.0, 7.0]]
    assert shown["joint_position"].tolist() == [[0.5]]
    assert shown["base_linear_velocity"].tolist() == [[6.0, 7.0, 8.0]]
    assert shown["base_angular_velocity"].tolist() == [[9.0, 10.0, 11.0]]


def test_a_body_without_any_joint_floats_not_though_the_last_joint_is_free():
    bodies = '<body name="pole"><geom size="1"/></body><body pos="9 0 0"><freejoint/><geom size="1"/></body>'
    model = mujoco.MjModel.from_xml_string(f"<mujoco><worldbody>{bodies}</worldbody></mujoco>")
    with pytest.raises(ValueError, match="no free joint"):
        module._free_joint(model, "pole")


def test_readings_of_which_one_is_no_force_are_not_averaged():
    env = TorqueEnv(floating(sensors={"both": ("felt", "turned"), "felt": ("felt",)}), every_step=["both", "felt"])
    assert env.averaged_keys == ("joint_power", "felt")


def test_what_is_shown_does_not_change_with_the_physics_of_single_precision():
    live = torch.zeros(2)
    shown = TorqueEnv._copied(live)
    live += 1.0
    assert shown.tolist() == [0.0, 0.0]


@pytest.mark.parametrize(("device", "told"), [("cpu", True), ("cuda", False)])
def test_rows_that_are_done_are_spared_where_that_saves_time(device, told):
    env = SimpleNamespace(physics=SimpleNamespace(device=torch.device(device)))
    assert TorqueEnv.supports_partial_step.fget(env) is told


@pytest.mark.parametrize(
    ("every_step", "sensors", "substep", "wanted"),
    [
        ((), {}, False, False),
        ((), {"felt": ("felt",)}, False, False),
        ((), {"turned": ("turned",), "felt": ("felt",)}, False, True),
        (("felt",), {"turned": ("turned",), "felt": ("felt",)}, True, False),
        (("felt", "turned"), {"turned": ("turned",), "felt": ("felt",)}, True, True),
    ],
)
def test_sensors_are_refreshed_where_one_that_is_shown_is_not_computed_by_the_step(
    every_step, sensors, substep, wanted, monkeypatch
):
    """It takes time: between the steps of an action only those count that are shown there."""
    env, told = TorqueEnv(floating(sensors=sensors), every_step=every_step), []
    step = env.physics.step
    monkeypatch.setattr(env.physics, "step", lambda *count, refresh, envs: told.append(refresh) or step(*count))
    shown = TensorDict(torque=torch.zeros(1, 1), batch_size=[1])
    env._step(shown.set("_substep", torch.zeros(1, 1)) if substep else shown)
    assert told == [wanted]


def test_fields_that_differ_between_robots_are_made_on_either_device(monkeypatch):
    assert "body_mass" in TorqueEnv(ARM, num_envs=2, fields=["body_mass"]).physics.fields
    made = []

    def refuse(model, count, **told):
        made.append((count, told))
        raise NotImplementedError

    monkeypatch.setattr("torchrl_athletic.physics.WarpPhysics", refuse)
    with pytest.raises(NotImplementedError):
        TorqueEnv(ARM, num_envs=3, device="cuda:1", fields=["body_mass"])
    told = {"device": torch.device("cuda:1"), "fields": ["body_mass"], "joint_names": ARM.joint_names}
    assert made == [(3, told)]


def test_a_sensor_of_the_base_goes_before_what_is_computed_and_the_rest_is_computed():
    env = TorqueEnv(floating(sensors={"base_position": ("where",)}))
    shown = env.reset()
    assert shown["base_position"].tolist() == [[4.0, 0.0, 8.0]]
    assert shown["base_quaternion"].tolist() == [[1.0, 0.0, 0.0, 0.0]]
    assert shown["projected_gravity"].tolist() == [[0.0, 0.0, -1.0]]
