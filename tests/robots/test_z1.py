"""The arm against its data sheet."""

import mujoco
import numpy as np
import pytest
from robots.standing import Plant

from torchrl_athletic.robots import z1
from torchrl_athletic.robots.arm import BRACES, LINKS


def test_it_weighs_what_unitree_says():
    assert z1().model().body_mass.sum() == pytest.approx(5.221, abs=1e-3)


def test_it_reaches_74_centimetres_and_no_further():
    plant = Plant(z1())
    rng = np.random.default_rng(0)
    low, high = np.array(plant.robot.position_limit).T
    shoulder = np.array([0.0, 0.0, 0.1035])
    # straight: the elbow unfolds by its own angle less the forearm's bend of 57 mm in 218 mm
    poses = [*rng.uniform(low, high, size=(2000, 7)), [0, 1.5, low[2], 0.257, 0, 0, 0], [0, 1.5, low[2], 0.0, 0, 0, 0]]
    reach = []
    for pose in poses:
        plant.data.qpos[plant.qpos] = pose
        mujoco.mj_kinematics(plant.model, plant.data)
        reach.append(np.linalg.norm(plant.data.site("flange").xpos - shoulder))
    assert max(reach) == pytest.approx(0.74, abs=0.005)


def test_positive_joint2_lifts_the_folded_arm_and_negative_joint3_unfolds_it():
    plant = Plant(z1())
    plant.data.qpos[:] = 0.0
    folded = plant.sensed("end_effector_position")
    plant.data.qpos[plant.qpos[1]] = 0.1
    lifted = plant.sensed("end_effector_position")
    plant.data.qpos[plant.qpos[1]], plant.data.qpos[plant.qpos[2]] = np.pi / 2, 0.0
    upright = plant.sensed("end_effector_position")
    plant.data.qpos[plant.qpos[2]] = -np.pi / 2
    unfolded = plant.sensed("end_effector_position")
    assert plant.data.body("link03").xpos[2] > 0.1035
    assert lifted[0] != pytest.approx(folded[0], abs=1e-3)
    assert upright[2] < 0.2  # the forearm hangs down along the upper arm
    assert unfolded[0] > 0.5


def test_a_second_motor_doubles_what_a_joint_has():
    plant = Plant(z1())
    motors = np.array([1, 2, 1, 1, 1, 1])  # Unitree's description: joint2 has two of what the others have
    joints = [plant.model.joint(name) for name in plant.robot.joint_names[:6]]
    for field, one in (("damping", 1.0), ("frictionloss", 1.0), ("armature", 0.03)):
        np.testing.assert_allclose([getattr(joint, field).item() for joint in joints], one * motors)
    np.testing.assert_allclose(plant.robot.torque_limit, [*(30.0 * motors), 20.0])
    np.testing.assert_allclose(plant.robot.velocity_limit, 3.1415)


def test_each_joint_turns_its_way():
    plant = Plant(z1())
    plant.data.qpos[plant.qpos] = level = np.array([0.0, 1.5, -1.0, -0.5, 0.0, 0.0, 0.0])

    def seen(joint, angle):
        plant.data.qpos[plant.qpos] = level
        plant.data.qpos[plant.qpos[joint]] += angle
        position = plant.sensed("end_effector_position")
        jaw = plant.data.geom("z1_moving_jaw").xpos - plant.data.geom("z1_jaw").xpos
        return position, plant.data.body("link06").xmat.reshape(3, 3).copy(), jaw

    at, turn, jaws = seen(0, 0.0)
    for joint, axis, sign in ((0, 1, 1), (1, 2, -1), (2, 2, -1), (3, 2, -1), (4, 1, 1)):  # left, down, down, down, left
        assert sign * (seen(joint, 0.1)[0] - at)[axis] > 0.01
    assert seen(5, 0.1)[1][2, 1] > turn[2, 1] + 0.05  # the left side of the gripper goes up
    assert np.linalg.norm(seen(6, -1.0)[2]) > np.linalg.norm(jaws) + 0.02  # open


@pytest.mark.parametrize("roll", [0.0, 1.57, 2.7])
def test_the_tips_of_its_jaws_stand_on_the_ground_and_the_hand_feels_it(roll):
    plant = Plant(z1())
    plant.hold(0.5)
    assert not plant.sensed("hand_force")
    down = np.array([0.0, 2.9, -1.3, 0.0, 0.0, roll, 0.0])
    for share in np.linspace(0, 1, 20):
        plant.hold(0.1, plant.robot.default_pose + share * (down - plant.robot.default_pose))
    plant.hold(2.0, down)
    felt, force = plant.sensed("hand_force"), np.zeros(6)
    link, axis = plant.data.body("link06").xpos, plant.data.body("link06").xmat.reshape(3, 3)[:, 0]
    assert axis[2] < -0.6  # it points down, and would reach 8 cm into the ground
    assert abs((link + 0.2 * axis)[2]) < 0.02
    pressed = 0.0
    for number in range(plant.data.ncon):
        mujoco.mj_contactForce(plant.model, plant.data, number, force)
        pressed += force[0]
    assert pressed > 50.0
    assert felt == pytest.approx(pressed)
    assert plant.sensed("arm_force").max() == 0  # gripper, wrist and elbow stay off the ground


def test_its_gains_hold_it_against_gravity_with_a_sag_of_torque_over_gain():
    plant = Plant(z1())
    plant.hold(5.0)
    joint2, joint3 = plant.data.qpos[plant.qpos[1:3]] - plant.robot.default_pose[1:3]
    assert abs(plant.data.qvel).max() < 1e-3
    gravity = plant.data.qfrc_bias[plant.dof[1:3]]
    # what the gains do not hold, Coulomb friction does
    assert abs(plant.robot.kp[1] * joint2 + gravity[0]) <= 2.0 + 0.1
    assert abs(plant.robot.kp[2] * joint3 + gravity[1]) <= 1.0 + 0.1


def test_reinforcement_changes_the_links_as_if_the_parts_were_bodies_of_their_own():
    """MuJoCo composes a welded child with its parent: no formula of ours."""
    spec, bare = z1().spec(), z1().model()
    for link, braces in BRACES.items():
        for number, brace in enumerate(braces):
            part = spec.body(link).add_body(name=f"{link}_part{number}", pos=brace.centre)
            outer, inner = np.prod(brace.size), np.prod(brace.hollow)
            density = brace.mass / (outer - inner)
            for size, sign in ((brace.size, 1.0), (brace.hollow, -1.0)):
                if np.prod(size):
                    _add_moments(part, size, sign * density * np.prod(size))
    welded, combined = spec.compile(), z1(reinforced=True).model()
    rng = np.random.default_rng(1)
    low, high = np.array(z1().position_limit).T
    for _ in range(5):
        q, v = rng.uniform(low, high), rng.normal(size=7)
        expected, ours, before = (_motion(model, q, v) for model in (welded, combined, bare))
        for theirs, mine, was in zip(expected, ours, before, strict=True):
            np.testing.assert_allclose(mine, theirs, rtol=1e-9, atol=1e-9)
            assert np.abs(mine - was).max() > 1e-3
    added = sum(brace.mass for braces in BRACES.values() for brace in braces)
    assert combined.body_mass.sum() - bare.body_mass.sum() == pytest.approx(added)


def _add_moments(body, size, mass):
    a, b, c = np.square(size)
    body.explicitinertial = True
    body.ipos = [0, 0, 0]
    body.mass += mass
    body.inertia += mass / 12 * np.array([b + c, a + c, a + b])


def _motion(model, q, v):
    data = mujoco.MjData(model)
    data.qpos[:], data.qvel[:] = q, v
    mujoco.mj_forward(model, data)
    mass_matrix = np.zeros((7, 7))
    for row, unit in zip(mass_matrix, np.eye(7), strict=True):
        mujoco.mj_mulM(model, data, row, unit)
    return mass_matrix, data.qfrc_bias.copy()


def test_tube_and_plates_are_of_aluminium():
    for braces in BRACES.values():
        sheet = braces[0]  # bearings come after it
        volume = np.prod(sheet.size) - np.prod(sheet.hollow)
        assert sheet.mass / volume == pytest.approx(2700.0, rel=0.02)


def test_only_links_two_to_five_are_reinforced():
    bare, braced = z1().model(), z1(reinforced=True).model()
    heavier = {name for name in LINKS if braced.body(name).mass > bare.body(name).mass + 1e-9}
    assert heavier == {"link02", "link03", "link04", "link05"}
