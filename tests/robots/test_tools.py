"""A bucket holds its ball until it is swung, a dumbbell is heavy, and a handle is pulled where it is."""

import mujoco
import numpy as np
import pytest
from robots.standing import Plant

from torchrl_athletic.robots import Bucket, Dumbbell, Handle, b2z1, with_bucket, z1

FRONT_BACK_SIDES = np.array([0.0, 0.3, -0.2, -0.1, 0.4, 0.2, 0.0])


@pytest.mark.parametrize("robot", [z1(tool=Bucket()), b2z1(tool=Bucket())], ids=["z1", "b2z1"])
def test_the_ball_stays_in_its_bucket_while_the_arm_moves_slowly(robot):
    plant = Plant(robot)
    start = np.array(robot.default_pose)
    for share in np.linspace(0.0, 1.0, 20):
        target = start.copy()
        target[-7:] += share * FRONT_BACK_SIDES
        plant.hold(0.1, target)
    plant.hold(1.0, target)
    moved = plant.sensed("bucket_position") - robot_bucket_at_rest(robot)
    assert np.linalg.norm(moved) > 0.1
    assert np.abs(in_bucket(plant)).max() < 0.03  # 0.05 less the ball's radius each way, and a rim of 4 cm above


def robot_bucket_at_rest(robot):
    return Plant(robot).sensed("bucket_position")


def in_bucket(plant):
    """The ball's centre from where it should lie, along the bucket's sides and its opening."""
    turn = plant.data.site("bucket").xmat.reshape(3, 3)
    return turn.T @ (plant.sensed("ball_position") - plant.sensed("bucket_position"))


def test_the_ball_falls_out_of_a_bucket_that_is_turned_over():
    plant = Plant(z1(tool=Bucket(opening=(0.0, 0.0, -1.0))))
    plant.hold(1.0)
    assert plant.sensed("ball_position")[2] == pytest.approx(0.035, abs=0.005)  # on the floor, a radius high


def test_an_overhead_swing_throws_the_ball_forward():
    robot = z1(tool=Bucket(opening=(0.0, 0.0, -1.0)))
    plant = Plant(robot)
    back = np.array([0.0, 0.6, -2.6, -1.0, 0.0, 0.0, 0.0])
    plant.data.qpos[plant.qpos] = back
    mujoco.mj_forward(plant.model, plant.data)
    ball = plant.model.joint("ball")
    plant.data.qpos[ball.qposadr[0] : ball.qposadr[0] + 3] = plant.sensed("bucket_position")
    plant.hold(0.5, back)
    assert np.abs(in_bucket(plant)).max() < 0.03  # it lies there with the arm stretched backwards
    plant.hold(0.6, np.array([0.0, 2.6, -1.3, 0.6, 0.0, 0.0, 0.0]))
    assert plant.sensed("ball_position")[0] > plant.sensed("bucket_position")[0]


def test_bucket_and_ball_weigh_what_they_say():
    bare, full = z1().model(), z1(tool=Bucket(mass=0.3)).model()
    assert full.body("bucket").mass == pytest.approx(0.3)
    assert full.body("ball").mass == pytest.approx(0.1)
    assert full.body_mass.sum() - bare.body_mass.sum() == pytest.approx(0.4)


@pytest.mark.parametrize("opening", [(0.0, 0.0, 1.0), (0.0, 0.0, -2.0), (1.0, 0.0, 0.0), (0.0, 1.0, 1.0)])
def test_the_bucket_opens_where_it_was_told_to(opening):
    plant = Plant(z1(tool=Bucket(opening=opening)))
    turn = plant.data.body("link06").xmat.reshape(3, 3)
    wall = plant.data.geom("bucket_bottom").xpos - plant.data.body("bucket").xpos
    np.testing.assert_allclose(-wall / np.linalg.norm(wall), turn @ opening / np.linalg.norm(opening), atol=1e-9)


def test_a_dumbbell_weighs_on_the_shoulder_by_its_lever():
    bare, laden = Plant(z1()), Plant(z1(tool=Dumbbell(3.0)))
    lever = laden.sensed("end_effector_position")[0] - laden.data.body("link02").xpos[0]
    more = laden.data.qfrc_bias[laden.dof[1]] - bare.data.qfrc_bias[bare.dof[1]]
    assert more == pytest.approx(-3.0 * 9.81 * lever, rel=1e-6)  # positive joint2 lowers an arm that points forward


@pytest.mark.parametrize(
    ("tool", "wrong", "advice"),
    [
        (Bucket, {"opening": (0.0, 0.0, 0.0)}, "Give a direction"),
        (Bucket, {"ball_mass": 0.0}, "positive number"),
        (Bucket, {"ball_radius": 0.06}, "less than 0.05"),
        (Dumbbell, {"mass": -1.0}, "positive number"),
    ],
)
def test_a_tool_that_cannot_be_is_refused(tool, wrong, advice):
    with pytest.raises(ValueError, match=advice):
        tool(**wrong)


def test_a_ball_that_is_fixed_in_its_bucket_weighs_the_same_and_flies_nowhere():
    bucket = Bucket(opening=(0.0, 0.0, -1.0))
    free, fixed = z1(tool=bucket), with_bucket(z1(), bucket)
    assert fixed.model().nq == len(fixed.joint_names)
    assert fixed.model().body_mass.sum() == pytest.approx(free.model().body_mass.sum())
    assert fixed.model().body("bucket").mass == pytest.approx(bucket.mass + bucket.ball_mass)
    plants = Plant(free), Plant(fixed)
    for sensor in ("bucket_position", "bucket_axis"):
        np.testing.assert_allclose(*(plant.sensed(sensor) for plant in plants), atol=1e-9)
    np.testing.assert_allclose(plants[0].sensed("ball_position"), plants[1].sensed("bucket_position"), atol=1e-9)


def test_the_ball_that_is_fixed_in_its_bucket_is_not_drawn_but_the_bucket_is():
    model = with_bucket(b2z1(), Bucket()).model()
    drawn = mujoco.MjvOption().geomgroup
    assert not drawn[model.geom("ball").group]  # after the release it would be seen twice
    walls = [g for g in range(model.ngeom) if model.body(model.geom_bodyid[g]).name == "bucket"]
    assert sum(drawn[model.geom_group[g]] for g in walls) == len(walls) - 1


def test_the_bucket_s_axis_points_out_of_its_opening():
    plant = Plant(with_bucket(z1(), Bucket(opening=(0.0, 0.0, -2.0))))
    link = plant.data.body("link06").xmat.reshape(3, 3)
    np.testing.assert_allclose(plant.sensed("bucket_axis"), -link[:, 2], atol=1e-9)
    deepest = plant.model.geom("bucket_bottom").pos[2] + 0.5 * 0.008
    rest = plant.model.site("bucket").pos[2]
    assert rest - deepest == pytest.approx(0.035)  # it lies on the bottom, a radius high
    assert Bucket().rim == pytest.approx(0.08 - 0.035)


def shaken(robot, seed=0):
    """A robot in some pose, in motion."""
    plant, rng = Plant(robot), np.random.default_rng(seed)
    mujoco.mj_integratePos(plant.model, plant.data.qpos, 0.3 * rng.normal(size=plant.model.nv), 1.0)
    plant.data.qvel[:] = 0.5 * rng.normal(size=plant.model.nv)
    mujoco.mj_forward(plant.model, plant.data)
    return plant


@pytest.mark.parametrize("make", [z1, b2z1])
@pytest.mark.parametrize("seed", range(3))
def test_a_force_on_the_handle_acts_at_the_grip(make, seed):
    plant = shaken(make(tool=Handle()), seed)
    force = np.array([120.0, -30.0, -45.0])
    jacobian = np.zeros((3, plant.model.nv))
    mujoco.mj_jacSite(plant.model, plant.data, jacobian, None, plant.model.site("end_effector").id)
    without = plant.data.qfrc_smooth.copy()
    plant.data.xfrc_applied[plant.model.body("handle").id, :3] = force
    mujoco.mj_forward(plant.model, plant.data)
    generalised = plant.data.qfrc_smooth - without
    np.testing.assert_allclose(generalised, jacobian.T @ force, atol=1e-9)
    assert np.abs(generalised[plant.dof[-7:]]).max() > 10


def test_the_handle_tells_the_place_and_velocity_of_the_grip():
    plant = shaken(b2z1(tool=Handle()))
    for name in ("position", "linear_velocity"):
        np.testing.assert_allclose(plant.sensed(f"handle_{name}"), plant.sensed(f"end_effector_{name}"), atol=1e-12)


def test_a_handle_is_a_load_of_a_gram_that_touches_nothing():
    bare, robot = b2z1().model(), b2z1(tool=Handle())
    held = robot.model()
    assert robot.loads == ("handle",)
    assert held.body_mass.sum() - bare.body_mass.sum() == pytest.approx(1e-3)
    assert (held.nv, held.ngeom) == (bare.nv, bare.ngeom)
    bending = [shaken(made).data.qfrc_bias for made in (b2z1(), robot)]
    np.testing.assert_allclose(*bending, atol=0.02)
