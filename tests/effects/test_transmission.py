"""Gears against a pendulum behind a spring, integrated by SciPy, and against closed forms."""

from functools import cache

import mujoco
import numpy as np
import pytest
from effects.arm import JOINTS, address, arm
from effects.arm import record as record_arm
from effects.slider import MASS as MASS_ON_RAIL
from effects.slider import STEP, push
from scipy.integrate import solve_ivp
from scipy.signal import lsim

from torchrl_athletic.diagnosis.replay import simulate, take_of, windows_of
from torchrl_athletic.effects import JointAddress, Plant, project_recording
from torchrl_athletic.effects.gear import CONTACT_STEP, ROTOR_FLOOR, Gear, Spring
from torchrl_athletic.effects.signals import inertia_matrix
from torchrl_athletic.effects.transmission import Backlash, Compliance
from torchrl_athletic.recordings import Recording

LINK, ROTOR, WEIGHT, DAMPING, LENGTH, RATE = 0.25, 0.03, 5.0, 0.4, 0.4, 250.0
MASS = WEIGHT / 9.81 / LENGTH
OWN = LINK - MASS * LENGTH**2
PENDULUM = f"""
<mujoco><option timestep="0.002"/><worldbody><body>
  <joint name="hinge" axis="0 -1 0" damping="{DAMPING}" armature="{ROTOR}"/>
  <inertial pos="0 0 -{LENGTH}" mass="{MASS}" diaginertia="{OWN} {OWN} {OWN}"/></body></worldbody></mujoco>"""
SOFT, TEETH = (60.0, 0.3, 0.0), (1000.0, 15.0, 0.05)


def pendulum() -> mujoco.MjModel:
    return mujoco.MjModel.from_xml_string(PENDULUM)


@cache
def two_inertias(stiffness: float, damping: float, gap: float, bias: float = 0.0) -> Recording:
    """Encoder on the rotor, from rest under six sines and a bias that fade in; torques hold between the samples."""
    time = np.arange(0.0, 12.0, 1 / RATE)
    frequency = np.geomspace(0.3, 5.0, 6)
    phase = np.random.default_rng(1).uniform(0, 2 * np.pi, 6)
    command = np.minimum(time, 1) * (bias + 1.1 * np.sin(2 * np.pi * frequency * time[:, None] + phase).sum(1))

    def passed(x: float, rate: float) -> float:
        bend = max(abs(x) - gap / 2, 0.0)
        return 0.0 if gap and bend == 0 else float(np.sign(x) * stiffness * bend + damping * rate)

    def motion(t: float, y: np.ndarray) -> list[float]:
        rotor, rate, link, its_rate = y
        torque = passed(rotor - link, rate - its_rate)
        weight = WEIGHT * np.sin(link) + DAMPING * its_rate
        return [rate, (command[int(t * RATE + 1e-6)] - torque) / ROTOR, its_rate, (torque - weight) / LINK]

    end = time[-1] - 1e-9
    found = solve_ivp(motion, (0.0, end), np.zeros(4), t_eval=time[:-1], max_step=0.5 / RATE, rtol=1e-6, atol=1e-8)
    return Recording(time[:-1], ("hinge",), found.y[:1].T, torque_command=command[:-1, None])


def left(s, fingerprint) -> float:
    """Energy of the missing torque that a fingerprint leaves, as a share."""
    assert fingerprint.columns.shape == (*s.missing.shape, 0)
    return float(((s.missing - fingerprint.constant) ** 2).sum() / (s.missing**2).sum())


def error(recording: Recording, values, effect, window: float | None = 0.5) -> float:
    w = windows_of(take_of(recording, pendulum(), np.full(1, 1e-6)), window)

    def build(plant, rows):
        if effect is not None:
            effect.apply(plant, 0, rows)

    found = simulate(w, build, np.atleast_2d(np.asarray(values, dtype=float)))[0]
    return float(np.sqrt(((found - w.measured) ** 2).mean()))


def test_a_soft_gear_is_recognised_along_the_motion_of_its_motor():
    stiffness, damping, _ = SOFT
    s = project_recording(two_inertias(*SOFT), pendulum(), np.full(1, 1e-6))
    grid = Compliance().grid(s, 0)
    assert left(s, Compliance().fingerprint(s, 0, {"stiffness": stiffness, "damping": damping})) < 0.03
    every = [left(s, f) for f in Compliance().fingerprints(s, 0, grid)]
    best = grid[int(np.argmin(every))]["stiffness"]
    every = sorted({point["stiffness"] for point in grid})
    assert abs(np.log(best / stiffness)) < np.log(every[1] / every[0])  # a neighbour on the grid


def test_a_point_alone_and_in_a_grid_are_predicted_alike():
    s = project_recording(two_inertias(*SOFT), pendulum(), np.full(1, 1e-6))
    for effect in (Compliance(), Backlash()):
        grid = effect.grid(s, 0)[4:8]
        together = effect.fingerprints(s, 0, grid)
        for fixed, one in zip(grid, together, strict=True):
            assert one.fixed == fixed
            np.testing.assert_allclose(effect.fingerprint(s, 0, fixed).constant, one.constant, atol=1e-9)


def test_the_true_gear_follows_the_recording_ten_times_closer_than_the_rigid_one():
    for window in (0.5, None):
        rigid = error(two_inertias(*SOFT), np.zeros(0), None, window)
        assert error(two_inertias(*SOFT), SOFT[:2], Compliance(), window) < 0.1 * rigid
        assert error(two_inertias(*SOFT), (2 * SOFT[0], SOFT[1]), Compliance(), window) > 0.3 * rigid


def test_play_is_found_within_fifteen_percent_of_its_width():
    s = project_recording(two_inertias(*TEETH), pendulum(), np.full(1, 1e-6), kernel=0.01)
    points = [(left(s, f), f.fixed["gap"]) for f in Backlash().fingerprints(s, 0, Backlash().grid(s, 0))]
    assert min(points)[0] < 0.1
    assert 0.6 < min(points)[1] / TEETH[2] < 1.6  # a neighbour on the grid
    width = TEETH[2] * np.linspace(0.5, 1.5, 11)
    windows = [error(two_inertias(*TEETH), (gap, TEETH[0]), Backlash()) for gap in width[::2]]
    assert width[::2][int(np.argmin(windows))] == pytest.approx(TEETH[2], rel=0.15)


def test_play_of_a_link_whose_weight_leans_on_stiff_teeth_is_recognised():
    s = project_recording(two_inertias(4000.0, 15.0, 0.01, bias=4.0), pendulum(), np.full(1, 1e-6), kernel=0.01)
    points = [(left(s, f), f.fixed["gap"]) for f in Backlash().fingerprints(s, 0, Backlash().grid(s, 0))]
    assert min(points)[0] < 0.2
    assert min(points)[1] == pytest.approx(0.01, rel=0.1)


def test_the_true_play_follows_the_recording_far_closer_than_none():
    for window in (0.5, None):
        none = error(two_inertias(*TEETH), np.zeros(0), None, window)
        assert error(two_inertias(*TEETH), (TEETH[2], TEETH[0]), Backlash(), window) < 0.25 * none


def test_a_spring_and_teeth_are_told_apart():
    for recording, right, wrong in (
        (two_inertias(*SOFT), Compliance(), Backlash()),
        (two_inertias(*TEETH), Backlash(), Compliance()),
    ):
        s = project_recording(recording, pendulum(), np.full(1, 1e-6), kernel=0.01)
        best = [min(left(s, f) for f in e.fingerprints(s, 0, e.grid(s, 0))) for e in (right, wrong)]
        assert best[0] < 0.6 * best[1]


@pytest.mark.parametrize("joint", [0, 1], ids=JOINTS)
def test_the_other_joint_feels_a_gear_too(joint):
    stiffness = (90.0, 25.0)[joint]
    fixed = {"stiffness": stiffness, "damping": 0.01 * stiffness}
    recording = record_arm(Compliance(), joint, list(fixed.values()), seconds=6.0)
    s = project_recording(recording, arm(), np.zeros(2), kernel=0.01)
    predicted = Compliance().fingerprint(s, joint, fixed).constant
    for j in range(2):
        assert ((s.missing - predicted)[:, j] ** 2).sum() < 0.05 * (s.missing[:, j] ** 2).sum()
        assert (s.missing[:, j] ** 2).sum() > 0


def test_no_experiment_goes_where_teeth_rattle():
    address, effect = JointAddress.of(pendulum(), ("hinge",)), Backlash()
    parameters = effect.parameters(pendulum(), address, 0)
    inertia = inertia_matrix(pendulum(), address, np.zeros((1, 1)))[0, 0, 0] - pendulum().dof_armature[0]
    values = np.array([inertia * (2 * np.pi * 7.0) ** 2 if p.name == "stiffness" else 0.01 for p in parameters])
    assert effect.highest_frequency(parameters, values) == pytest.approx(3.5)
    soft = Compliance().parameters(pendulum(), address, 0)
    assert Compliance().highest_frequency(soft, np.array([p.nominal for p in soft])) == np.inf


@pytest.mark.parametrize("effect", [Compliance(), Backlash()])
def test_a_rigid_gear_is_the_given_model(effect):
    plant = Plant(pendulum(), JointAddress.of(pendulum(), ("hinge",)), 2)
    given = np.array([p.nominal for p in effect.parameters(plant.model, plant.address, 0)])
    effect.apply(plant, 0, np.tile(given, (2, 1)))
    assert plant.open_loop
    assert not plant.fields
    nearly = given.copy()
    nearly[effect.name == "backlash"] *= 0.99  # the stiffness
    recording = two_inertias(*SOFT)
    (a,), (b,) = (
        simulate(windows_of(take_of(recording, pendulum(), np.full(1, 1e-6)), 0.5), build, np.zeros((1, 0)))
        for build in (lambda plant, _: None, lambda plant, _: effect.apply(plant, 0, np.tile(nearly, (plant.rows, 1))))
    )
    assert np.abs(a - b).max() < 0.02 * np.abs(a).max()


@pytest.mark.parametrize("swing", [0.3, 1.0, 2.0, 8.0])
def test_a_free_vibration_keeps_its_period_and_its_momentum(swing):
    """``swing`` radians of the vibration pass in a step; above 2.4 it only stays bounded."""
    step, rotor, link = 0.002, 0.5, 2.0
    seen = 1 / (1 / rotor + 1 / link)
    spring = Spring(np.array([seen * (swing / step) ** 2]), np.zeros(1), np.zeros(1))
    softness = spring.softness(np.array([seen]), step)
    x, w, path = np.array([1e-3]), np.zeros(1), []
    for _ in range(400):
        path.append(x[0])
        w = w - step * spring.torque(x, w, np.zeros(1), seen, softness, step) / seen
        x = x + step * w
    assert np.abs(path).max() < 5e-3
    if swing < 2.4:
        back = np.array(path[2:]) + np.array(path[:-2])  # x[n+1] + x[n-1] = 2 cos(swing) x[n]
        np.testing.assert_allclose(back, 2 * np.cos(swing) * np.array(path[1:-1]), atol=1e-12)


def test_a_servo_behind_a_spring_holds_the_motor_and_not_the_link():
    """A carriage whose model has no rotor gets one of 2 % of its mass; its encoder reads the motor."""
    kp, kd, stiffness, damping, rotor = 400.0, 8.0, 300.0, 2.0, ROTOR_FLOOR * MASS_ON_RAIL
    target = np.where(STEP * np.arange(800) < 0.1, 0.0, 0.05)
    (position,) = push(target, (Compliance(), [stiffness, damping]), servo=(kp, kd))
    a = [  # motor, its speed, carriage, its speed
        [0, 1, 0, 0],
        np.array([-stiffness - kp, -damping - kd, stiffness, damping]) / rotor,
        [0, 0, 0, 1],
        np.array([stiffness, damping, -stiffness, -damping]) / MASS_ON_RAIL,
    ]
    system = (a, [[0], [kp / rotor], [0], [0]], [[1, 0, 0, 0]], [[0]])
    time = STEP * np.arange(801)
    exact = lsim(system, np.append(target, target[-1]), time, interp=False)[1][1:]
    np.testing.assert_allclose(position, exact, atol=0.03 * 0.05)
    (rigid,) = push(target, servo=(kp, kd))
    assert np.abs(rigid - exact).max() > 0.2 * 0.05


def test_teeth_push_and_never_pull():
    spring = Spring(np.full(5, 100.0), np.full(5, 50.0), np.full(5, 0.02))
    x = np.array([-0.02, -0.011, 0.0, 0.011, 0.02])
    for rate in (-3.0, 0.0, 3.0):
        torque = spring.torque(x, np.full(5, rate), np.zeros(5), np.ones(5), np.zeros(5), CONTACT_STEP)
        assert (torque[:2] <= 0).all()
        assert torque[2] == 0
        assert (torque[3:] >= 0).all()


def test_sentences_say_the_numbers_and_their_units():
    parameters = Compliance().parameters(arm(), address(), 0)
    text = Compliance().sentence("shoulder", {"stiffness": 431.0, "damping": 0.52}, parameters)
    assert "431 N·m/rad" in text
    assert "0.52 N·m·s/rad" in text
    parameters = Backlash().parameters(arm(), address(), 1)
    assert "23 mrad of play" in Backlash().sentence("elbow", {"gap": 0.023, "stiffness": 900.0}, parameters)


def test_only_one_gear_a_joint():
    assert Compliance().name in Backlash().excludes
    assert Backlash().name in Compliance().excludes
    plant = Plant(arm(), address(), 1)
    Compliance().apply(plant, 1, np.array([[50.0, 0.1]]))
    assert [type(gear) for gear in plant.gears] == [Gear]
    assert plant.gears[0].joint == 1


def test_rows_that_start_alike_are_looked_at_once_and_start_as_they_would_alone():
    w = windows_of(take_of(two_inertias(*SOFT), pendulum(), np.full(1, 1e-6)), 2.0)

    def build(plant, rows):
        Compliance().apply(plant, 0, rows[:, :2])
        plant.torque_scale[:, 0] = rows[:, 2]

    rows = np.array([[60.0, 0.3, 1.0], [60.0, 0.3, 1.1], [40.0, 0.3, 1.0]])
    together = simulate(w, build, rows)
    assert len(w.take.link.starts) == 2 * len(w.start)
    alone = windows_of(take_of(two_inertias(*SOFT), pendulum(), np.full(1, 1e-6)), 2.0)
    np.testing.assert_allclose(together[2], simulate(alone, build, rows[2:])[0], atol=1e-9)
