"""The quadruped against its data sheet, its mirror image and half a minute of standing."""

import mujoco
import numpy as np
import pytest
from robots.standing import Plant

from torchrl_athletic.robots import Terrain, b2z1
from torchrl_athletic.robots.arm import MOST_FORCE
from torchrl_athletic.robots.b2z1 import LEGS, STAND_HEIGHT

MIRROR = {"FR": "FL", "FL": "FR", "RR": "RL", "RL": "RR"}
G = 9.81


def test_sixty_kilograms_of_dog_and_six_point_eight_of_arm():
    model = b2z1().model()
    links = [model.body(name).mass.item() for name in ("link00", "mount")]
    arm = model.body_subtreemass[model.body("link00").id] + links[1]
    assert arm == pytest.approx(6.8, abs=1e-3)
    assert model.body_mass.sum() - arm == pytest.approx(60.0, abs=1e-3)


def test_legs_come_in_the_order_of_the_paper():
    legs = [name.split("_")[0] for name in b2z1().joint_names[:12:3]]
    assert legs == ["FR", "FL", "RR", "RL"]
    feet = Plant(b2z1()).sensed("foot_position")
    assert (np.sign(feet[:, 0]) == [1, 1, -1, -1]).all()
    assert (np.sign(feet[:, 1]) == [-1, 1, -1, 1]).all()


def test_its_feet_touch_the_floor_in_the_keyframe():
    feet = Plant(b2z1()).sensed("foot_position")
    np.testing.assert_allclose(feet[:, 2], 0.032, atol=1e-12)
    assert pytest.approx(0.589, abs=1e-3) == STAND_HEIGHT


@pytest.mark.parametrize(("cone", "lowest"), [("elliptic", 0.54), ("pyramidal", 0.52)])
def test_it_stands_for_half_a_minute_under_its_gains(cone, lowest):
    plant = Plant(b2z1(cone=cone))
    plant.hold(30.0)
    upright = -plant.sensed("projected_gravity")[2]
    assert lowest < plant.sensed("base_position")[2] < STAND_HEIGHT
    assert upright > 0.999
    assert not plant.sensed("trunk_force")
    assert not plant.sensed("leg_force").any()
    assert (np.abs(plant.data.ctrl) < 0.3 * np.array(plant.robot.torque_limit)).all()


def test_standing_feet_carry_its_weight():
    plant = Plant(b2z1())
    plant.hold(3.0)
    weight = plant.model.body_mass.sum() * G
    assert plant.sensed("foot_force").sum() == pytest.approx(weight, rel=0.01)
    assert (plant.sensed("foot_force") > 0.15 * weight).all()


def test_a_foot_wedged_in_rough_ground_reads_no_more_than_its_range():
    plant = Plant(b2z1(terrain=Terrain(roughness=(0.0, 0.0)), cone="pyramidal"))
    plant.data.qpos[2] -= 0.045  # deeper than a foot's radius, where prisms press from the sides
    mujoco.mj_forward(plant.model, plant.data)
    feet = plant.sensed("foot_force")
    assert feet.max() == MOST_FORCE
    assert plant.data.efc_force.max() > 10 * MOST_FORCE  # the wedge that is not to be felt


def test_a_force_is_felt_where_it_lies():
    robot = b2z1()
    plant = Plant(robot)
    weight = plant.model.body_mass.sum() * G
    for thigh, calf, height, bearer in ((3.1, -0.43, 0.1, "trunk_force"), (0.0, -2.8, 0.38, "leg_force")):
        plant = Plant(robot)
        pose = np.array(robot.default_pose)
        for joint in robot.joint_groups["thigh"]:
            pose[joint : joint + 2] = thigh, calf
        plant.data.qpos[plant.qpos] = pose
        plant.data.qpos[2] = height
        plant.hold(1.0, pose)  # legs in the air; kneeling
        assert plant.sensed(bearer).sum() == pytest.approx(weight, rel=0.05)
        assert not plant.sensed("foot_force").any()
    plant = Plant(robot)
    plant.data.qpos[2:7] = 1.2, 0.0, 1.0, 0.0, 0.0  # upside down: the arm is below
    plant.hold(2.0)
    assert plant.sensed("arm_force").max() > 10.0


def test_each_leg_is_that_of_the_description():
    robot, model = b2z1(), b2z1().model()
    assert model.opt.timestep == 0.005
    for leg in range(0, 12, 3):
        assert robot.position_limit[leg : leg + 3] == ((-0.87, 0.87), (-0.94, 4.69), (-2.82, -0.43))
        assert robot.torque_limit[leg : leg + 3] == (200.0, 200.0, 320.0)
        assert robot.velocity_limit[leg : leg + 3] == (23.0, 23.0, 14.0)
    # hips hang inwards and towards the middle of the robot: b2w_description
    for name, side in LEGS.items():
        assert (np.sign(model.body(f"{name}_hip").ipos[:2]) == np.multiply(side, -1)).all()
        assert np.sign(model.body(f"{name}_thigh").ipos[1]) == -side[1]


def test_a_heavier_rotor_and_more_friction_slow_a_joint():
    """What the tables say reaches the model: a freely swung calf against the same without it."""
    for field in ("dof_armature", "dof_damping", "dof_frictionloss"):
        speeds = []
        for share in (1.0, 0.0):
            plant = Plant(b2z1())
            plant.data.qpos[2] = 3.0
            getattr(plant.model, field)[plant.dof[2]] *= share
            plant.data.ctrl[2] = -40.0
            for _ in range(5):
                mujoco.mj_step(plant.model, plant.data)
            speeds.append(abs(plant.data.qvel[plant.dof[2]]))
        assert speeds[0] < 0.999 * speeds[1], field


@pytest.mark.parametrize("terrain", [None, Terrain(tiles=1)])
def test_the_ground_alone_sets_the_friction_under_the_feet(terrain):
    robot = b2z1(terrain=terrain)
    plant = Plant(robot)
    for name in robot.ground:
        plant.model.geom(name).friction[0] = 0.1
    plant.hold(0.3)
    assert plant.data.ncon >= 4
    assert {plant.model.geom(int(g)).name for g in plant.data.contact.geom[:, 0]} == {robot.ground[-1]}
    np.testing.assert_allclose(plant.data.contact.friction[:, 0], 0.1)


def test_the_arm_cannot_pass_through_the_trunk():
    plant = Plant(b2z1())
    low, high = np.array(plant.robot.position_limit)[12:].T
    rng = np.random.default_rng(0)
    met = set()
    for pose in rng.uniform(low, high, size=(300, 7)):
        plant.data.qpos[plant.qpos[12:]] = pose
        mujoco.mj_forward(plant.model, plant.data)
        pairs = [{plant.model.geom(int(g)).name for g in pair} for pair in plant.data.contact.geom]
        met |= {name for pair in pairs if "trunk" in pair for name in pair}
    assert met == {"trunk", "z1_wrist", "z1_gripper"}  # the elbow stays above the shoulder


def test_right_legs_are_mirror_images_of_left_ones():
    model = b2z1().model()
    for right, left in (("FR", "FL"), ("RR", "RL")):
        for part in ("hip", "thigh", "calf"):
            ours, theirs = model.body(f"{right}_{part}"), model.body(f"{left}_{part}")
            np.testing.assert_allclose(ours.pos, theirs.pos * [1, -1, 1])
            np.testing.assert_allclose(ours.ipos, theirs.ipos * [1, -1, 1])
            np.testing.assert_allclose(ours.inertia, theirs.inertia)
            assert ours.mass == theirs.mass


def test_a_mirrored_push_gives_the_mirrored_motion():
    """Off the ground and without the arm and the trunk's own few millimetres of asymmetry."""
    spec = b2z1().spec()
    spec.delete(spec.body("link00"))
    base = spec.body("base")
    base.ipos[1] = base.fullinertia[3] = base.fullinertia[5] = 0.0
    for name in b2z1().sensors:
        if name.startswith(("end_effector", "arm_")):
            for sensor in b2z1().sensors[name]:
                if spec.sensor(sensor) is not None:
                    spec.delete(spec.sensor(sensor))
    spec.delete(spec.keys[0])
    model = spec.compile()
    rng = np.random.default_rng(0)
    legs = np.array(b2z1().default_pose[:12]).reshape(4, 3) + 0.1 * rng.normal(size=(4, 3))
    speeds, torques = rng.normal(size=(4, 3)), 20.0 * rng.normal(size=(4, 3))
    swap = [list(LEGS).index(MIRROR[leg]) for leg in LEGS]
    across = np.array([-1.0, 1.0, 1.0])  # hips turn about x, the others about y

    left = _fly(model, legs, speeds, torques)
    right = _fly(model, legs[swap] * across, speeds[swap] * across, torques[swap] * across)
    np.testing.assert_allclose(right[:3], left[:3] * [1, -1, 1], atol=1e-9)
    np.testing.assert_allclose(right[3:7], left[3:7] * [1, -1, 1, -1], atol=1e-9)
    np.testing.assert_allclose(right[7:].reshape(4, 3), left[7:].reshape(4, 3)[swap] * across, atol=1e-9)
    assert np.abs(left[4]) > 1e-3  # it did roll


def _fly(model, legs, speeds, torques):
    data = mujoco.MjData(model)
    data.qpos[2] = 3.0
    data.qpos[7:] = legs.ravel()
    data.qvel[6:] = speeds.ravel()
    data.ctrl[:] = torques.ravel()
    for _ in range(20):
        mujoco.mj_step(model, data)
    return data.qpos.copy()


def test_base_velocities_are_those_of_a_rider_and_gravity_points_down():
    plant = Plant(b2z1())
    plant.data.qpos[3:7] = [np.cos(np.pi / 4), 0, 0, np.sin(np.pi / 4)]  # facing +y
    plant.data.qvel[:3] = [0.0, 2.0, 0.0]
    plant.data.qvel[3:6] = [0.5, 0.0, 0.0]  # free joints turn in the body's frame
    np.testing.assert_allclose(plant.sensed("base_linear_velocity"), [2.0, 0.0, 0.0], atol=1e-12)
    np.testing.assert_allclose(plant.sensed("base_angular_velocity"), [0.5, 0.0, 0.0], atol=1e-12)
    np.testing.assert_allclose(plant.sensed("projected_gravity"), [0.0, 0.0, -1.0], atol=1e-12)
    plant.data.qpos[3:7] = [np.cos(0.1), 0, np.sin(0.1), 0]  # nose down
    np.testing.assert_allclose(plant.sensed("projected_gravity"), [np.sin(0.2), 0.0, -np.cos(0.2)], atol=1e-12)


def test_a_payload_presses_on_the_feet():
    plant, laden = Plant(b2z1()), Plant(b2z1(payload=10.0))
    for p in (plant, laden):
        p.hold(2.0)
    more = laden.sensed("foot_force").sum() - plant.sensed("foot_force").sum()
    assert more == pytest.approx(10.0 * G, rel=0.05)
    with pytest.raises(ValueError, match="positive mass"):
        b2z1(payload=-1.0)


def test_it_stands_on_rough_ground_above_the_floor():
    plant = Plant(b2z1(terrain=Terrain(roughness=(0.025, 0.025), tiles=1)))
    assert plant.data.ncon == 0  # the keyframe is clear of every bump
    plant.hold(10.0)
    assert -plant.sensed("projected_gravity")[2] > 0.99
    feet = plant.sensed("foot_position")[:, 2] - 0.032
    assert feet.max() > 0.005
    assert feet.max() < 0.025
    assert plant.sensed("foot_force").sum() == pytest.approx(plant.model.body_mass.sum() * G, rel=0.02)
