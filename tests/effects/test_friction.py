import mujoco
import numpy as np
import pytest
from effects.arm import JOINTS, address, arm
from effects.explained import explained, projected
from effects.slider import MASS, STEP, push, slider, speed

from torchrl_athletic.effects import (
    AsymmetricFriction,
    CoulombFriction,
    JointAddress,
    ViscousFriction,
    project_recording,
)
from torchrl_athletic.effects.friction import LoadDependentFriction, StribeckFriction
from torchrl_athletic.recordings import Recording

PUSH = np.full(1000, 3.0)


def test_what_pushes_less_than_dry_friction_does_not_move_it_and_what_pushes_more_does():
    below, above = push(PUSH, (CoulombFriction(), [[3.3, 0.0], [2.7, 0.0]]))
    assert np.abs(below).max() < 1e-3  # MuJoCo's friction creeps
    assert above[-1] > 0.05


def test_dry_friction_takes_its_force_from_the_acceleration_either_way():
    for sign in (1, -1):
        (position,) = push(sign * PUSH, (CoulombFriction(), [1.0, 0.0]))
        acceleration = np.diff(speed(position))[200:] / STEP
        np.testing.assert_allclose(acceleration, sign * (3.0 - 1.0) / MASS, rtol=1e-6)


def test_dry_friction_stops_a_coasting_mass_after_its_kinetic_energy_is_spent():
    force = np.where(np.arange(2000) < 500, 4.0, 0.0)
    (position,) = push(force, (CoulombFriction(), [1.5, 0.0]))
    v = speed(position)
    distance = position[-1] - position[499]
    assert distance == pytest.approx(MASS * v[499] ** 2 / 2 / 1.5, rel=0.01)
    assert abs(v[-1]) < 1e-4


def test_viscous_friction_approaches_the_speed_at_which_it_balances_the_push():
    (position,) = push(np.full(3000, 3.0), (ViscousFriction(), [6.0]))
    time = STEP * (np.arange(len(position) - 1) + 1.5)
    np.testing.assert_allclose(speed(position), 3.0 / 6.0 * (1 - np.exp(-6.0 / MASS * time)), atol=2e-3)


@pytest.mark.parametrize("sign", [1, -1])
def test_the_terminal_speed_of_asymmetric_friction_is_that_of_its_direction(sign):
    coulomb, viscous = {1: (0.5, 4.0), -1: (1.25, 7.0)}[sign]
    (position,) = push(sign * np.full(3500, 3.0), (AsymmetricFriction(), [0.5, 1.25, 4.0, 7.0]))
    assert speed(position)[-1] == pytest.approx(sign * (3.0 - coulomb) / viscous, rel=1e-3)


def test_asymmetric_friction_with_equal_sides_is_coulomb_and_viscous_friction():
    force = 4.0 * np.sin(2 * np.pi * 2.0 * STEP * np.arange(1500))
    both = push(force, (AsymmetricFriction(), [0.7, 0.7, 3.0, 3.0]))
    apart = push(force, (CoulombFriction(), [0.7, 0.0]), (ViscousFriction(), [3.0]))
    np.testing.assert_allclose(both, apart, atol=1e-9)


def test_asymmetric_friction_holds_a_mass_at_rest_up_to_the_level_of_each_direction():
    moved = [push(np.full(400, f), (AsymmetricFriction(), [1.0, 2.0, 0.0, 0.0]))[0, -1] for f in (0.9, 1.2, -1.9, -2.2)]
    assert np.abs(moved[0]) < 1e-3
    assert np.abs(moved[2]) < 1e-3
    assert moved[1] > 5e-3
    assert moved[3] < -5e-3


def test_a_saturated_motor_does_not_lift_the_friction_of_a_direction():
    """Friction is beside the motor, whose limit it must not share."""
    (position,) = push(np.full(3500, -9.0), (AsymmetricFriction(), [0.5, 1.5, 4.0, 4.0]), limit=3.0)
    assert speed(position)[-1] == pytest.approx(-(3.0 - 1.5) / 4.0, rel=1e-3)


def rail_take(position):
    """Signals of a motion on the rail, without noise."""
    time = 0.002 * np.arange(len(position))
    recording = Recording(time, ("rail",), position[:, None], torque_command=np.zeros((len(time), 1)))
    return project_recording(recording, slider(), np.zeros(1), kernel=0.02)


def test_the_columns_of_asymmetric_friction_are_one_sided_and_add_up_to_the_symmetric_ones():
    time = 0.002 * np.arange(3000)
    s = rail_take(np.sin(2 * time) + 0.2 * np.sin(5 * time))
    columns = AsymmetricFriction().fingerprint(s, 0, {}).columns[:, 0]
    dry = CoulombFriction().fingerprint(s, 0, {}).columns[:, 0, 0]
    viscous = ViscousFriction().fingerprint(s, 0, {}).columns[:, 0, 0]
    np.testing.assert_allclose(columns[:, 0] + columns[:, 1], dry, atol=1e-12)
    np.testing.assert_allclose(columns[:, 2] + columns[:, 3], viscous, atol=1e-4)
    v = s.velocity[:, 0]
    fast = np.abs(v) > 0.5
    np.testing.assert_allclose(columns[fast, 0], -(v[fast] > 0).astype(float), atol=0.03)  # brakes the forward motion
    np.testing.assert_allclose(columns[fast, 1], (v[fast] < 0).astype(float), atol=0.03)
    np.testing.assert_allclose(columns[fast, 2], -np.maximum(v[fast], 0), atol=1e-2)
    np.testing.assert_allclose(columns[fast, 3], -np.minimum(v[fast], 0), atol=1e-2)


def test_a_link_without_a_motor_limit_may_have_friction_beyond_its_weight():
    model = mujoco.MjModel.from_xml_string(
        '<mujoco><worldbody><body><joint name="hinge" axis="0 1 0"/>'
        '<inertial pos="0 0 -0.4" mass="0.5" diaginertia="1e-3 1e-3 1e-3"/></body></worldbody></mujoco>'
    )
    torque, _ = CoulombFriction().parameters(model, JointAddress.of(model, ("hinge",)), 0)
    weight = 0.5 * 9.81 * 0.4  # felt a quarter turn away: hanging down it feels none
    assert torque.upper >= weight
    assert torque.scale == pytest.approx(0.02 * weight)


@pytest.mark.parametrize("kind", ["slide", "hinge"])
def test_a_joint_that_crawls_at_full_torque_is_within_the_bounds_of_viscous_friction(kind):
    """A lift that needs 200 of its 225 N at 0.45 m/s, and a gear that turns at one radian in ten seconds."""
    model = mujoco.MjModel.from_xml_string(f"""
<mujoco><worldbody><body><joint name="joint" type="{kind}"/><geom size="0.1"/></body></worldbody>
  <actuator><motor joint="joint" ctrlrange="-225 225"/></actuator></mujoco>""")
    speed = 0.45 if kind == "slide" else 0.1
    for effect in (ViscousFriction(), AsymmetricFriction()):
        for p in effect.parameters(model, JointAddress.of(model, ("joint",)), 0):
            if "N·m·s" in p.unit or "N·s" in p.unit:
                assert p.upper > 200.0 / speed


# --- MuJoCo's own form ---

SWING = 4.0 * np.sin(2 * np.pi * 2.0 * STEP * np.arange(1500))


def test_a_turnover_of_9_5_ms_is_mujocos_own_friction():
    (position,) = push(SWING, (CoulombFriction(), [1.2, 0.0095]))
    model = slider()
    model.dof_frictionloss[0] = 1.2
    data, own = mujoco.MjData(model), []
    for force in SWING:
        data.qfrc_applied[0] = force
        mujoco.mj_step(model, data)
        own.append(data.qpos[0])
    np.testing.assert_allclose(position, own, atol=1e-9)
    (ideal,) = push(SWING, (CoulombFriction(), [1.2, 0.0]))
    assert np.abs(ideal - own).max() > 1e-3


@pytest.mark.parametrize("joint", [0, 1], ids=JOINTS)
def test_the_form_that_fits_best_is_the_one_that_was_simulated(joint):
    torque = (0.3, 0.1)[joint]
    for turnover in (0.0, 0.0095):
        s = projected(CoulombFriction(), joint, (torque, turnover))
        grid = CoulombFriction().grid(s, joint)
        fits = []
        for fingerprint in CoulombFriction().fingerprints(s, joint, grid):
            column, missing = fingerprint.columns[:, joint, 0], s.missing[:, joint]
            level = column @ missing / (column @ column)
            fits.append((((missing - level * column) ** 2).sum() / (missing**2).sum(), level))
        best = int(np.argmin([left for left, _ in fits]))
        assert grid[best]["turnover"] == turnover
        assert fits[best][0] < 0.02
        assert fits[best][1] == pytest.approx(torque, rel=0.03)


def test_friction_as_stiff_as_a_time_step_allows_counts_as_a_bearings():
    """Ideal friction beside such a model is one number more, not two: no richer than friction that grows with load."""
    model = arm()
    model.dof_frictionloss[0], model.dof_solref[0] = 0.2, [2 * model.opt.timestep, 1.0]
    _, turnover = CoulombFriction().parameters(model, address(), 0)
    assert turnover.nominal == 0.0


def test_a_model_with_friction_brings_its_own_turnover():
    model = arm()
    model.dof_frictionloss[0] = 0.2
    torque, turnover = CoulombFriction().parameters(model, address(), 0)
    assert (torque.nominal, turnover.nominal) == (0.2, pytest.approx(0.0095))
    assert CoulombFriction().parameters(arm(), address(), 0)[1].nominal == 0.0


def test_the_sentence_says_which_form_fits():
    parameters = CoulombFriction().parameters(arm(), address(), 0)
    say = CoulombFriction().sentence
    assert "turns over at once" in say("shoulder", {"torque": 0.3, "turnover": 0.0}, parameters)
    soft = say("shoulder", {"torque": 0.3, "turnover": 0.0095}, parameters)
    assert "turns over 9.5 ms before the motion does, as MuJoCo's frictionloss" in soft


# --- Stribeck ---


def test_stribeck_friction_lets_go_at_breakaway_and_holds_less_at_speed():
    """Coulomb 1 N, 0.8 N more to break away."""
    held, gone = (push(np.full(800, f), (StribeckFriction(), [1.0, 0.8, 0.02]))[0] for f in (1.7, 1.9))
    assert np.abs(held).max() < 1e-3
    assert gone[-1] > 0.05
    np.testing.assert_allclose(np.diff(speed(gone))[-100:] / STEP, (1.9 - 1.0) / MASS, rtol=1e-3)


@pytest.mark.parametrize("sign", [1, -1])
def test_at_the_stribeck_speed_37_percent_of_the_excess_are_left(sign):
    coulomb, excess, at = 1.0, 0.8, 0.1
    (position,) = push(sign * np.full(800, 3.0), (StribeckFriction(), [coulomb, excess, at]))
    v, push_left = sign * speed(position), sign * MASS * np.diff(speed(position)) / STEP
    friction = np.interp(at, v[:-1], 3.0 - push_left)
    assert friction == pytest.approx(coulomb + excess * np.exp(-1), rel=0.01)


def test_dry_friction_that_all_but_vanishes_at_speed_is_a_spline_of_something_else():
    parameters = StribeckFriction().parameters(arm(), address(), 1)
    assert StribeckFriction().is_physical(parameters, np.array([0.5, 0.9, 0.1]))
    assert not StribeckFriction().is_physical(parameters, np.array([0.5, 1.1, 0.1]))
    assert not StribeckFriction().is_physical(parameters, np.array([0.0, 0.1, 0.1]))


def test_without_excess_stribeck_friction_is_dry_friction():
    stribeck = push(SWING, (StribeckFriction(), [1.2, 0.0, 0.1]))
    np.testing.assert_allclose(stribeck, push(SWING, (CoulombFriction(), [1.2, 0.0])), atol=1e-12)


# --- load ---


@pytest.mark.parametrize("force", [3.0, -6.0])
def test_load_dependent_friction_takes_its_share_of_what_passes_it(force):
    """Driving, the motor gives F = 0.5 + 0.2 T more than what passes, T."""
    (position,) = push(np.full(500, force), (LoadDependentFriction(), [0.5, 0.2]))
    passes = np.sign(force) * (abs(force) - 0.5) / 1.2
    np.testing.assert_allclose(np.diff(speed(position))[100:] / STEP, passes / MASS, rtol=1e-4)


def test_a_motor_that_brakes_has_more_friction_on_its_side_than_one_that_drives():
    """Braking, F = 0.5 + 0.2 T and T = u + F."""
    force = np.where(np.arange(1200) < 800, 6.0, -1.0)
    (position,) = push(force, (LoadDependentFriction(), [0.5, 0.2]))
    v = speed(position)
    assert v[1100] > 0
    np.testing.assert_allclose(np.diff(v)[820:1100] / STEP, -(1.0 + 0.5) / 0.8 / MASS, rtol=1e-3)


def test_a_motor_at_rest_brakes_by_what_its_own_friction_presses():
    """F = 0.5 + 0.2 F at no torque, as a hair to either side of it."""
    force = np.where(np.arange(1200) < 800, 6.0, 0.0)
    (position,) = push(force, (LoadDependentFriction(), [0.5, 0.2]))
    v = speed(position)
    np.testing.assert_allclose(np.diff(v)[820:1100] / STEP, -0.5 / 0.8 / MASS, rtol=1e-3)


@pytest.mark.parametrize("held", [0.2, 0.45])
def test_a_motor_that_drives_by_less_than_its_friction_is_driven_by_its_load(held):
    """It still pushes the way it slides, but the load turns the gear: F = 0.5 + 0.2 T and T = F - u."""
    force = np.where(np.arange(1200) < 800, 6.0, held)
    (position,) = push(force, (LoadDependentFriction(), [0.5, 0.2]))
    v = speed(position)
    friction = (0.5 - 0.2 * held) / 0.8
    assert v[1100] > 0
    np.testing.assert_allclose(np.diff(v)[820:1100] / STEP, -(friction - held) / MASS, rtol=1e-3)


def test_a_gear_that_locks_itself_holds_what_pushes_it():
    """Pushed by less than its friction it comes to rest, however short its bristles, and does not ring on them."""
    (position,) = push(np.full(1000, 2.0), (LoadDependentFriction(), [2.5, 0.9]))
    assert np.abs(position).max() < 5e-3
    assert np.abs(speed(position)[-100:]).max() < 1e-4  # MuJoCo's frictionloss creeps


@pytest.mark.parametrize(
    ("effect", "joint", "values"),
    [
        (StribeckFriction(), 0, (0.2, 0.2, 0.8)),
        (StribeckFriction(), 1, (0.06, 0.06, 0.8)),
        (LoadDependentFriction(), 0, (0.1, 0.15)),
        (LoadDependentFriction(), 1, (0.03, 0.15)),
        (AsymmetricFriction(), 0, (0.3, 0.1, 0.45, 0.6)),
    ],
)
def test_their_fingerprints_are_what_the_simulation_misses(effect, joint, values):
    share, factor = explained(effect, joint, values, projected(effect, joint, values))
    assert share > 0.95
    assert factor == pytest.approx(1, abs=0.05)


def test_at_speed_all_dry_friction_looks_the_same_and_the_stribeck_part_is_gone():
    s = rail_take(np.sin(2 * 0.002 * np.arange(3000)))
    fast = np.abs(s.velocity[:, 0]) > 1.0
    stribeck = StribeckFriction().fingerprint(s, 0, {"stribeck_speed": 0.2}).columns[fast, 0]
    dry = CoulombFriction().fingerprint(s, 0, {}).columns[fast, 0, 0]
    np.testing.assert_allclose(stribeck[:, 0], dry, atol=1e-6)
    np.testing.assert_allclose(stribeck[:, 1], 0, atol=1e-6)
    np.testing.assert_allclose(dry, -np.sign(s.velocity[fast, 0]), atol=1e-6)


def test_several_points_of_a_grid_are_what_each_is_alone():
    s = projected(CoulombFriction(), 0, (0.3, 0.0))
    for effect in (CoulombFriction(), StribeckFriction()):
        grid = effect.grid(s, 0)
        assert len(grid) > 3
        for point, fingerprint in zip(grid, effect.fingerprints(s, 0, grid), strict=True):
            np.testing.assert_allclose(fingerprint.columns, effect.fingerprint(s, 0, point).columns, atol=1e-12)


def test_equal_sides_of_asymmetric_friction_and_an_offset_are_declared_identical():
    assert AsymmetricFriction.identical_to == (frozenset({"coulomb_friction", "torque_offset"}),)
    dry = (StribeckFriction, LoadDependentFriction, AsymmetricFriction, CoulombFriction)
    for effect in dry:
        assert {other.name for other in dry} - {effect.name} <= effect.excludes


def test_the_sentences_of_stribeck_and_load_say_breakaway_and_share():
    values = {"coulomb": 0.2, "stribeck": 0.15, "stribeck_speed": 0.3}
    text = StribeckFriction().sentence("elbow", values, StribeckFriction().parameters(arm(), address(), 1))
    assert "falls from 0.35 N·m at breakaway" in text
    assert "to 0.2 N·m well above 0.3 rad/s" in text
    loaded = LoadDependentFriction()
    text = loaded.sentence("elbow", {"coulomb": 0.2, "coefficient": 0.12}, loaded.parameters(arm(), address(), 1))
    assert "0.2 N·m and 0.12 times the torque that passes through its gear" in text
