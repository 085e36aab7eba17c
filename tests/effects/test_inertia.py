import mujoco
import numpy as np
import pytest
import torch
from effects.arm import ARM, JOINTS, address, arm
from effects.slider import MASS, STEP, push, slider, speed

from torchrl_athletic.effects import (
    JointAddress,
    LinkCom,
    LinkInertia,
    LinkMass,
    Plant,
    ReflectedInertia,
    project_recording,
)
from torchrl_athletic.effects.signals import inertia_matrix, inverse_dynamics
from torchrl_athletic.physics import BatchPhysics
from torchrl_athletic.recordings import Recording

UPPER, LOWER = {"mass": 1.5, "c": (0.01, -0.2), "I": 0.02}, {"mass": 0.8, "c": (0.0, -0.15), "I": 0.007}
ARMATURE, LENGTH = (0.02, 0.005), 0.4


def changed(effect, joint, value) -> mujoco.MjModel:
    """The arm with an effect in it."""
    plant = Plant(arm(), address(), 1)
    effect.apply(plant, joint, np.array([[value]]))
    model = arm()
    for name, rows in plant.fields.items():
        getattr(model, name)[:] = rows[0]
    return model


def straight_down(model) -> np.ndarray:
    return inertia_matrix(model, address(), np.zeros((1, 2)))[0]


def steiner(upper, lower) -> np.ndarray:
    """Inertia matrix of the arm that hangs straight down, by the parallel-axis theorem."""

    def about(link, x, z):
        return link["I"] + link["mass"] * ((link["c"][0] + x) ** 2 + (link["c"][1] + z) ** 2)

    def cross(link):  # of the lower link's motion about both axes
        (x, z), far = link["c"], -LENGTH
        return link["I"] + link["mass"] * (x**2 + z * (z + far))

    first, second, both = about(upper, 0, 0) + about(lower, 0, -LENGTH), about(lower, 0, 0), cross(lower)
    return np.array([[first + ARMATURE[0], both], [both, second + ARMATURE[1]]])


def test_the_arm_is_as_the_theorem_says():
    np.testing.assert_allclose(straight_down(arm()), steiner(UPPER, LOWER), rtol=1e-9)


@pytest.mark.parametrize("joint", [0, 1], ids=JOINTS)
def test_a_mass_scales_its_links_whole_inertia(joint):
    links = [dict(UPPER), dict(LOWER)]
    given = links[joint]["mass"]
    links[joint] |= {"mass": 1.4 * given, "I": 1.4 * links[joint]["I"]}
    np.testing.assert_allclose(straight_down(changed(LinkMass(), joint, 1.4 * given)), steiner(*links), rtol=1e-9)


@pytest.mark.parametrize("joint", [0, 1], ids=JOINTS)
def test_a_centre_of_mass_moves_along_the_lever_and_keeps_its_own_inertia(joint):
    links = [dict(UPPER), dict(LOWER)]
    x, z = links[joint]["c"]
    y = arm().body_ipos[joint + 1, 1]  # along the axis: no inertia about it, but about the axes of other joints
    distance = np.sqrt(x**2 + y**2 + z**2)
    (parameter,) = LinkCom().parameters(arm(), address(), joint)
    assert parameter.nominal == pytest.approx(distance)
    links[joint]["c"] = (1.3 * x, 1.3 * z)
    np.testing.assert_allclose(straight_down(changed(LinkCom(), joint, 1.3 * distance)), steiner(*links), rtol=1e-9)
    assert changed(LinkCom(), joint, 1.3 * distance).body_ipos[joint + 1, 1] == pytest.approx(1.3 * y)


@pytest.mark.parametrize("share", [0.4, 1.3, 2.5])
def test_a_centre_that_moved_far_is_predicted_with_the_square_of_its_distance(share):
    time = 0.004 * np.arange(500)
    swing = np.stack([np.sin(5 * time), np.sin(9 * time)], -1)
    s = project_recording(Recording(time, JOINTS, swing, torque_command=np.zeros((500, 2))), arm(), np.zeros(2))
    given = LinkCom().parameters(arm(), address(), 1)
    value = share * given[0].nominal
    fixed = LinkCom().near(given, np.array([value]))
    assert fixed["near"] == pytest.approx(share, rel=0.03)
    moved = arm()
    moved.body_ipos[2] = changed(LinkCom(), 1, value).body_ipos[2]
    exact = s.rigid - s.inverse(moved)
    (column,) = np.moveaxis(LinkCom().fingerprint(s, 1, {"near": share}).columns, -1, 0)
    np.testing.assert_allclose(column * (value - given[0].nominal), exact, atol=1e-9)


@pytest.mark.parametrize("joint", [0, 1], ids=JOINTS)
def test_a_links_own_inertia_scales_without_its_mass(joint):
    links = [dict(UPPER), dict(LOWER)]
    links[joint]["I"] *= 1.7
    model = changed(LinkInertia(), joint, 1.7)
    np.testing.assert_allclose(straight_down(model), steiner(*links), rtol=1e-9)
    still = np.zeros((1, 2)), np.zeros((1, 2))
    pose = np.array([[0.7, -0.4]])
    np.testing.assert_allclose(
        inverse_dynamics(model, address(), pose, *still), inverse_dynamics(arm(), address(), pose, *still)
    )


def test_mass_centre_and_inertia_of_one_link_compose():
    plant = Plant(arm(), address(), 1)
    far = 1.2 * float(np.linalg.norm(arm().body_ipos[2]))
    for effect, value in ((LinkMass(), 1.2), (LinkCom(), far), (LinkInertia(), 1.5)):
        effect.apply(plant, 1, np.array([[value]]))
    model = arm()
    for name, rows in plant.fields.items():
        getattr(model, name)[:] = rows[0]
    lower = {"mass": 1.2, "c": (0.0, -0.18), "I": 0.007 * 1.5 * 1.5}
    np.testing.assert_allclose(straight_down(model), steiner(UPPER, lower), rtol=1e-9)


def test_a_mass_weighs():
    pose, still = np.array([[0.5, 0.0]]), np.zeros((1, 2))
    heavier = changed(LinkMass(), 1, 1.0)
    more = inverse_dynamics(heavier, address(), pose, still, still) - inverse_dynamics(
        arm(), address(), pose, still, still
    )
    lever = np.array([LENGTH + 0.15, 0.15]) * np.sin(0.5)
    np.testing.assert_allclose(np.abs(more[0]), 0.2 * 9.81 * lever, rtol=1e-9)


def test_a_carriage_of_another_mass_is_simulated_and_predicted():
    """MuJoCo keeps the inertia of a body as simple as this one aside."""
    (position,) = push(np.full(400, 5.0), (LinkMass(), [1.5 * MASS]))
    np.testing.assert_allclose(np.diff(speed(position)) / STEP, 5.0 / (1.5 * MASS), rtol=1e-6)
    time = 0.004 * np.arange(500)
    recording = Recording(time, ("rail",), np.sin(5 * time)[:, None], torque_command=np.zeros((500, 1)))
    s = project_recording(recording, slider(), np.zeros(1))
    np.testing.assert_allclose(LinkMass().fingerprint(s, 0, {}).columns[..., 0], -s.acceleration, rtol=1e-6)


def test_the_inertia_of_a_wheel_is_predicted():
    model = mujoco.MjModel.from_xml_string(
        '<mujoco><worldbody><body><joint name="hinge" axis="0 0 1"/>'
        '<inertial pos="0 0 0" mass="1" diaginertia="0.1 0.1 0.2"/></body></worldbody></mujoco>'
    )
    time = 0.004 * np.arange(500)
    recording = Recording(time, ("hinge",), np.sin(5 * time)[:, None], torque_command=np.zeros((500, 1)))
    s = project_recording(recording, model, np.zeros(1))
    np.testing.assert_allclose(LinkInertia().fingerprint(s, 0, {}).columns[..., 0], -0.2 * s.acceleration, rtol=1e-6)


@pytest.mark.parametrize("armature", [0.0, 3.0])
def test_a_rotor_slows_without_weighing(armature):
    (position,) = push(np.full(400, 5.0), (ReflectedInertia(), [armature]))
    np.testing.assert_allclose(np.diff(speed(position)) / STEP, 5.0 / (MASS + armature), rtol=1e-6)
    model = changed(ReflectedInertia(), 0, 0.5)
    np.testing.assert_allclose(
        straight_down(model) - straight_down(arm()), [[0.5 - ARMATURE[0], 0], [0, 0]], atol=1e-12
    )


@pytest.mark.parametrize(("effect", "value"), [(LinkMass(), 1.3), (LinkCom(), 0.2), (LinkInertia(), 2.0)])
def test_the_batch_steps_as_a_model_that_was_compiled_with_the_change(effect, value):
    plant = Plant(arm(), address(), 2)
    effect.apply(plant, 1, np.array([[value], [1.0 if isinstance(effect, LinkInertia) else 0.8]]))
    physics = BatchPhysics(arm(), 2, fields=tuple(plant.fields))
    for name, rows in plant.fields.items():
        physics.set_field(name, torch.from_numpy(rows))
    physics.reset(qpos=np.tile([0.6, -0.9], (2, 1)), qvel=np.tile([1.0, -2.0], (2, 1)))
    physics.step(200)
    spec = mujoco.MjSpec.from_string(ARM)
    body = spec.body("lower")
    if isinstance(effect, LinkMass):
        body.inertia = body.inertia * value / body.mass
        body.mass = value
    elif isinstance(effect, LinkCom):
        body.ipos = body.ipos * value / np.linalg.norm(body.ipos)
    else:
        body.inertia = body.inertia * value
    model = spec.compile()
    data = mujoco.MjData(model)
    data.qpos[:], data.qvel[:] = (0.6, -0.9), (1.0, -2.0)
    mujoco.mj_step(model, data, 200)
    np.testing.assert_allclose(physics.qpos[0].numpy(), data.qpos, atol=1e-10)
    assert np.abs(physics.qpos[1].numpy() - data.qpos).max() > 1e-3


def test_a_link_without_mass_or_lever_has_none_to_be_wrong():
    model = mujoco.MjModel.from_xml_string(
        "<mujoco><worldbody><body><joint name='shoulder' axis='0 1 0'/><body pos='0 0 -0.1'><geom size='.05' mass='2'/>"
        '<body pos="0 0 -0.1"><joint name="elbow" axis="0 1 0"/><geom size="0.05" mass="1"/></body></body></body>'
        "</worldbody></mujoco>"
    )
    at = JointAddress.of(model, JOINTS)
    assert LinkMass().parameters(model, at, 0) == ()  # all of it is in a body fixed to the link
    assert LinkInertia().parameters(model, at, 0) == ()
    assert LinkCom().parameters(model, at, 1) == ()  # its centre of mass is on the axis
    assert [p.nominal for p in LinkMass().parameters(model, at, 1)] == [1.0]


def test_a_link_with_two_joints_is_weighed_once():
    model = mujoco.MjModel.from_xml_string("""
    <mujoco><worldbody><body><joint name="x" type="slide" axis="1 0 0"/><joint name="turn" axis="0 1 0"/>
      <geom size="0.1" pos="0 0 -0.3"/></body></worldbody></mujoco>""")
    address = JointAddress.of(model, ("x", "turn"))
    for effect in (LinkMass(), LinkCom(), LinkInertia()):
        assert [bool(effect.parameters(model, address, joint)) for joint in (0, 1)] == [False, True]
