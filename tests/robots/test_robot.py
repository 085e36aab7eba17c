"""What every robot promises, whatever it is."""

import pickle

import mujoco
import numpy as np
import pytest
from robots.standing import Plant

from torchrl_athletic.robots import Bucket, Dumbbell, Terrain, b2z1, with_options, z1

ROBOTS = {
    "z1": z1(),
    "z1 reinforced": z1(reinforced=True),
    "z1 with a bucket": z1(tool=Bucket()),
    "z1 with a dumbbell": z1(tool=Dumbbell()),
    "b2z1": b2z1(),
    "b2z1 pyramidal": b2z1(cone="pyramidal"),
    "b2z1 with everything": b2z1(reinforced=True, tool=Bucket(), payload=5.0, terrain=Terrain(tiles=1)),
}


@pytest.fixture(params=ROBOTS, scope="module")
def plant(request):
    return Plant(ROBOTS[request.param])


def test_its_joints_are_the_motors_in_their_order_and_come_first(plant):
    robot, model = plant.robot, plant.model
    assert [model.joint(int(j)).name for j in model.actuator_trnid[:, 0]] == list(robot.joint_names)
    first_dof = 0 if robot.base is None else 6
    assert plant.dof.tolist() == list(range(first_dof, first_dof + len(robot.joint_names)))
    assert (plant.qpos - plant.dof == (0 if robot.base is None else 1)).all()


def test_control_is_the_joint_torque_up_to_its_limit(plant):
    limit = np.array(plant.robot.torque_limit)
    for ctrl, torque in ((0.5 * limit, 0.5 * limit), (-9.0 * limit, -limit)):
        plant.data.ctrl[:] = ctrl
        mujoco.mj_forward(plant.model, plant.data)
        np.testing.assert_allclose(plant.data.qfrc_actuator[plant.dof], torque)


def test_its_limits_are_those_of_the_model_and_hold_the_default_pose(plant):
    robot, model = plant.robot, plant.model
    ranges = np.array([model.joint(name).range for name in robot.joint_names])
    np.testing.assert_allclose(ranges, robot.position_limit)
    assert model.jnt_limited[[model.joint(name).id for name in robot.joint_names]].all()
    assert ((ranges[:, 0] <= robot.default_pose) & (robot.default_pose <= ranges[:, 1])).all()


def test_the_keyframe_is_the_default_pose_at_rest(plant):
    key = plant.model.key(plant.robot.keyframe)
    np.testing.assert_allclose(key.qpos[plant.qpos], plant.robot.default_pose)
    assert not key.qvel.any()


def test_groups_split_the_joints(plant):
    groups = plant.robot.joint_groups
    legs = groups.get("leg", ())
    assert sorted((*legs, *groups["arm"], *groups["gripper"])) == list(range(len(plant.robot.joint_names)))
    assert sorted(groups.get("hip", ()) + groups.get("thigh", ()) + groups.get("calf", ())) == list(legs)


def test_every_sensor_of_its_table_exists_and_none_is_left_out(plant):
    named = [name for names in plant.robot.sensors.values() for name in names]
    assert sorted(named) == sorted(plant.model.sensor(i).name for i in range(plant.model.nsensor))


def test_every_moving_body_could_be_made_of_matter(plant):
    moments = np.sort(plant.model.body_inertia[plant.model.body_mass > 0], axis=1)
    assert (moments > 0).all()
    assert (moments[:, 2] <= moments[:, 0] + moments[:, 1]).all()  # what no distribution of mass can break
    massless = np.flatnonzero(plant.model.body_mass == 0)
    assert massless.tolist() == [0]  # the world


def test_it_survives_the_way_to_another_process_and_builds_the_same_model(plant):
    there = pickle.loads(pickle.dumps(plant.robot))
    assert there == plant.robot
    assert there.spec().to_xml() == plant.robot.spec().to_xml()


def test_robots_are_equal_if_they_are_built_alike():
    assert z1(tool=Bucket()) == z1(tool=Bucket())
    assert z1(tool=Bucket()) != z1(tool=Dumbbell())
    assert b2z1() != b2z1(cone="pyramidal")


def test_two_specs_are_two_objects():
    robot = z1()
    spec = robot.spec()
    spec.body("link02").mass = 9.0
    assert robot.model().body("link02").mass != pytest.approx(9.0)


def test_end_effector_sensors_follow_the_site_through_space(plant):
    rng = np.random.default_rng(0)
    plant.data.qvel[plant.dof] = rng.normal(size=len(plant.dof))
    before, turn = plant.sensed("end_effector_position"), plant.sensed("end_effector_quaternion")
    velocity, spin = plant.sensed("end_effector_linear_velocity"), plant.sensed("end_effector_angular_velocity")
    dt = 1e-6
    mujoco.mj_integratePos(plant.model, plant.data.qpos, plant.data.qvel, dt)
    np.testing.assert_allclose((plant.sensed("end_effector_position") - before) / dt, velocity, atol=1e-4)
    turned = np.zeros(3)
    mujoco.mju_subQuat(turned, plant.sensed("end_effector_quaternion"), turn)  # in the body's frame
    world = np.zeros(3)
    mujoco.mju_rotVecQuat(world, turned / dt, turn)
    np.testing.assert_allclose(world, spin, atol=1e-4)


def test_an_unknown_cone_is_refused():
    with pytest.raises(ValueError, match="Choose one of"):
        z1(cone="round").model()


def test_in_another_simulation_it_differs_in_the_options_alone():
    robot = b2z1()
    other = with_options(robot, timestep=0.001, iterations=77)
    model, nominal = other.model(), robot.model()
    assert (model.opt.timestep, model.opt.iterations) == (0.001, 77)
    assert (nominal.opt.timestep, nominal.opt.iterations) != (0.001, 77)
    model.opt.timestep, model.opt.iterations = nominal.opt.timestep, nominal.opt.iterations
    assert with_options(other, timestep=nominal.opt.timestep, iterations=nominal.opt.iterations).spec().to_xml() == (
        robot.spec().to_xml()
    )
    assert pickle.loads(pickle.dumps(other)) == other != robot


def test_an_option_that_mujoco_lacks_and_time_that_stands_still_are_refused():
    with pytest.raises(ValueError, match=r"no option 'timestop'.*Give one of mjOption"):
        with_options(z1(), timestop=0.001)
    with pytest.raises(ValueError, match="no option '__doc__'"):
        with_options(z1(), __doc__=1.0)
    with pytest.raises(ValueError, match=r"timestep is 0\.0 s.*Give more than 0"):
        with_options(z1(), timestep=0.0)
