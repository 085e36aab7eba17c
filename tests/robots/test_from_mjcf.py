"""A robot described by its own model."""

import pickle

import pytest

from torchrl_athletic.envs import TorqueEnv
from torchrl_athletic.functional.gears import link_joint
from torchrl_athletic.physics.joints import driven_joints
from torchrl_athletic.robots import b2z1, from_mjcf, z1
from torchrl_athletic.robots.benches import pendulum, two_link_arm

SERVO = """
<mujoco model="servo"><worldbody>
  <body><joint name="b" axis="0 1 0" range="-60 60" actuatorfrcrange="-2 3"/><geom size=".1"/>
    <body pos="0 0 .3"><joint name="a" axis="0 1 0"/><geom size=".1"/></body></body>
</worldbody>
<actuator><position joint="a" kp="7" kv="0.3" forcerange="-5 5"/><position joint="b" kp="9"/></actuator></mujoco>"""


def test_joints_stand_in_the_order_of_actuators_with_their_gains_and_limits():
    robot = from_mjcf(SERVO)
    assert robot.joint_names == ("a", "b")
    assert (robot.kp, robot.kd) == ((7.0, 9.0), (0.3, 0.0))
    assert robot.torque_limit == (5.0, 2.0)
    assert robot.position_limit[1] == pytest.approx((-1.0472, 1.0472), abs=1e-4)
    assert from_mjcf(SERVO, kp=3.0, torque_limit=[1.0, 2.0]).kp == (3.0, 3.0)
    geared = from_mjcf(SERVO.replace('joint="a" kp', 'joint="a" gear="2" kp'))
    assert geared.kp == (28.0, 9.0)  # as MuJoCo: the joint's angle is geared up, and so is the torque
    assert geared.kd == pytest.approx((1.2, 0.0))
    assert geared.torque_limit == (10.0, 2.0)


def test_its_own_servos_do_not_pull():
    env = TorqueEnv(from_mjcf(SERVO.replace("<worldbody>", '<option gravity="0 0 0"/><worldbody>')))
    env.reset()
    env.physics.qpos[:] = 0.5
    td = env.rand_action(env.reset())
    env.physics.qpos[:] = 0.5
    shown = env.step(td.set("torque", td["torque"] * 0))["next"]
    assert shown["joint_position"].flatten().tolist() == [0.5, 0.5]


@pytest.mark.parametrize("make", [z1, b2z1])
def test_our_robots_are_found_in_their_own_xml(make):
    robot = make()
    found = from_mjcf(robot.spec().to_xml())
    assert (found.joint_names, found.base, found.keyframe) == (robot.joint_names, robot.base, robot.keyframe)
    assert found.default_pose == pytest.approx(robot.default_pose, abs=1e-5)
    assert found.torque_limit == pytest.approx(robot.torque_limit)
    assert found.model().body_mass.sum() == pytest.approx(robot.model().body_mass.sum(), rel=1e-5)


def test_a_ball_that_lies_about_is_no_base():
    """Neither of an arm that is bolted down, nor of a robot that stands behind the ball in its model."""
    ball = '<worldbody><body name="ball" pos="3 0 1"><freejoint/><geom size="0.1"/></body>'
    for robot in (z1(), b2z1()):
        spec = robot.spec()
        for key in spec.keys:
            spec.delete(key)  # whose states have no place for the ball
        assert from_mjcf(spec.to_xml().replace("<worldbody>", ball)).base == robot.base


def test_it_goes_to_another_process_and_into_an_environment(tmp_path):
    path = tmp_path / "arm.xml"
    path.write_text(two_link_arm())
    robot = pickle.loads(pickle.dumps(from_mjcf(path, joint_groups={"tip": ["elbow"]})))
    assert robot.joint_groups == {"tip": (1,)}
    assert TorqueEnv(robot, num_envs=2).rollout(3)["joint_position"].shape == (2, 3, 2)


def test_a_motor_without_a_limit_and_an_unknown_keyframe_are_refused():
    with pytest.raises(ValueError, match="'a' has no torque limit"):
        from_mjcf(SERVO.replace('forcerange="-5 5"', ""))
    with pytest.raises(ValueError, match="no keyframe 'jump'"):
        from_mjcf(pendulum(), keyframe="jump")


def test_friction_and_cogging_without_an_input_drive_no_joint():
    passive = '<dcmotor joint="b" input="none" motorconst="0" resistance="1" lugre="9 0 1 1 .1"/>'
    robot = from_mjcf(SERVO.replace("<actuator>", "<actuator>" + passive))
    assert (robot.joint_names, robot.kp, robot.torque_limit) == (("a", "b"), (7.0, 9.0), (5.0, 2.0))
    assert driven_joints(robot.model()) == ("a", "b")


def test_a_joint_whose_name_ends_in_link_is_no_link_behind_a_gear():
    both = SERVO.replace('name="a"', 'name="b_link"').replace('joint="a"', 'joint="b_link"')
    robot = from_mjcf(both)
    assert link_joint(robot.model(), "b") == "b"
    assert robot.position_limit[robot.joint_names.index("b")] == pytest.approx((-1.0472, 1.0472), abs=1e-4)


UNNAMED = """
<mujoco><worldbody><geom type="plane" size="1 1 1" pos="0 0 .2"/><geom type="box" size=".1 .1 .1" pos="3 3 0"/>
  <body name="base" pos="0 0 1"><freejoint/><geom size=".1"/>
    <body><joint name="a"/><geom size=".1" pos="0 0 -.2"/></body></body>
</worldbody><actuator><motor joint="a" forcerange="-1 1"/></actuator></mujoco>"""


def test_ground_without_a_name_is_ground_all_the_same():
    robot = from_mjcf(UNNAMED)
    assert robot.ground == ("ground0",)
    shown = TorqueEnv(robot, num_envs=2).reset()
    assert shown["base_height"].flatten().tolist() == pytest.approx([0.8, 0.8])
    named = from_mjcf(UNNAMED.replace('type="plane"', 'type="plane" name="lawn"'))
    assert named.ground == ("lawn",)
