import mujoco
import numpy as np
import pytest
from effects.arm import JOINTS, address, arm
from effects.explained import explained, projected
from effects.slider import MASS, STEP, push, slider, speed

from torchrl_athletic.effects import JointAddress, Plant
from torchrl_athletic.effects.elastic import JointSpring, JointStop

SPRUNG = """
<mujoco><compiler angle="radian"/><worldbody><body><joint name="hinge" axis="0 1 0" stiffness="3" springref="0.2"/>
  <inertial pos="0 0 -0.4" mass="0.5" diaginertia="1e-3 1e-3 1e-3"/></body></worldbody></mujoco>"""


def test_a_mass_on_a_spring_swings_about_its_rest_at_its_own_frequency():
    stiffness, preload = 50.0, 3.0
    (position,) = push(np.zeros(2000), (JointSpring(), [stiffness, preload]))
    time = STEP * (1 + np.arange(2000))
    rest = preload / stiffness
    expected = rest * (1 - np.cos(np.sqrt(stiffness / MASS) * time))
    np.testing.assert_allclose(position, expected, atol=0.02 * rest)


def test_without_stiffness_the_preload_is_a_constant_force():
    (position,) = push(np.zeros(500), (JointSpring(), [0.0, -1.2]))
    np.testing.assert_allclose(np.diff(speed(position)) / STEP, -1.2 / MASS, atol=1e-6)


def test_the_models_own_spring_is_counted_in():
    model = mujoco.MjModel.from_xml_string(SPRUNG)
    hinge = JointAddress.of(model, ("hinge",))
    stiffness, preload = JointSpring().parameters(model, hinge, 0)
    assert (stiffness.nominal, preload.nominal) == (3.0, pytest.approx(0.6))
    plant = Plant(model, hinge, 2)
    JointSpring().apply(plant, 0, np.array([[3.0, 0.6], [6.0, 0.6]]))
    np.testing.assert_allclose(plant.of("jnt_stiffness")[:, 0], [3, 6])
    np.testing.assert_allclose(plant.of("qpos_spring")[:, 0], [0.2, 0.1])
    assert "the model has 3 N·m/rad and 0.6 N·m" in JointSpring().sentence(
        "hinge", {"stiffness": 6.0, "preload": 0.6}, (stiffness, preload)
    )


@pytest.mark.parametrize("side", [1.0, -1.0])
def test_a_mass_bounces_off_a_stop_with_the_speed_it_came_with(side):
    stiffness, at = 2000.0, 0.05
    force = side * np.where(np.arange(900) < 200, 2.0, 0.0)
    (position,) = push(force, (JointStop(), [side * at, side, stiffness]))
    v = speed(position)
    arrival = side * v[250]
    assert np.abs(position).max() - at == pytest.approx(arrival * np.sqrt(MASS / stiffness), rel=0.02)
    assert side * v[-1] == pytest.approx(-arrival, rel=0.02)


def test_a_stop_does_nothing_before_it_and_pushes_only_back():
    force = 2.0 * np.sin(2 * np.pi * 2.0 * STEP * np.arange(400))
    (free,) = push(force)
    (far,) = push(force, (JointStop(), [free.max() + 0.01, 1.0, 1e4]))
    np.testing.assert_allclose(far, free, atol=1e-12)
    (below,) = push(force, (JointStop(), [free.min() - 0.01, -1.0, 1e4]))
    np.testing.assert_allclose(below, free, atol=1e-12)


@pytest.mark.parametrize(
    ("effect", "joint", "values"),
    [
        (JointSpring(), 0, (0.6, 0.3)),
        (JointSpring(), 1, (0.3, -0.1)),
        (JointStop(), 0, (0.3, 1.0, 20.0)),
        (JointStop(), 1, (-0.3, -1.0, 10.0)),
    ],
)
def test_their_fingerprints_are_what_the_simulation_misses(effect, joint, values):
    share, factor = explained(effect, joint, values, projected(effect, joint, values))
    assert share > 0.98
    assert factor == pytest.approx(1, abs=0.03)


def test_stops_are_looked_for_in_the_outer_fifth_either_side():
    s = projected(JointSpring(), 0, (0.0, 0.0))
    low, high = s.fine_position[:, 0].min(), s.fine_position[:, 0].max()
    for point in JointStop().grid(s, 0):
        end = high if point["side"] > 0 else low
        assert 0 < point["side"] * (end - point["position"]) <= 0.2 * (high - low) + 1e-12
    assert {point["side"] for point in JointStop().grid(s, 0)} == {1.0, -1.0}


def test_stops_are_looked_for_in_what_all_takes_travel_together():
    short, long = (projected(JointSpring(), 0, (k, 0.0)) for k in (40.0, 0.0))
    both = JointStop().grid_of([short, long], 0)
    assert both == JointStop().grid_of([long, short], 0)
    assert max(p["position"] for p in both) > short.fine_position[:, 0].max()


@pytest.mark.parametrize("joint", [0, 1], ids=JOINTS)
def test_the_stiffest_stop_is_one_that_the_time_step_follows(joint):
    stiffest = JointStop().parameters(arm(), address(), joint)[2].upper
    inertia = 1.0 / arm().dof_invweight0[joint]
    assert arm().opt.timestep * np.sqrt(stiffest / inertia) < 0.5


@pytest.mark.parametrize(("stiffness", "stops"), [(2.0, False), (79.0, False), (81.0, True), (5000.0, True)])
def test_what_the_motor_pushes_in_by_half_a_radian_is_no_stop(stiffness, stops):
    parameters = JointStop().parameters(arm(), address(), 0)  # its motor has 40 N·m
    assert JointStop().is_physical(parameters, np.array([0.3, 1.0, stiffness])) == stops


def test_on_a_slide_it_is_five_centimetres_and_without_a_motors_limit_gravity_pushes():
    (_, _, limited), (_, _, free) = (
        JointStop().parameters(slider(limit), JointAddress.of(slider(), ("rail",)), 0) for limit in (6.0, None)
    )
    assert limited.scale == pytest.approx(6.0 / 0.05)
    assert free.scale == pytest.approx(MASS / 0.05)  # a level slide feels none: 1 m/s² does
    coarse = slider(6.0)
    coarse.opt.timestep = 0.1  # follows none stiffer than 40 N/m
    stiffness = JointStop().parameters(coarse, JointAddress.of(coarse, ("rail",)), 0)[2]
    assert stiffness.scale == pytest.approx(0.2 * stiffness.upper)


def test_the_sentences_say_where():
    spring = JointSpring().parameters(arm(), address(), 1)
    assert "towards -0.5 rad" in JointSpring().sentence("elbow", {"stiffness": 0.8, "preload": -0.4}, spring)
    stop = JointStop().parameters(slider(), JointAddress.of(slider(), ("rail",)), 0)
    text = JointStop().sentence("rail", {"position": -0.12, "side": -1.0, "stiffness": 900.0}, stop)
    assert "back below -120 mm" in text
    assert "900 N/m" in text
