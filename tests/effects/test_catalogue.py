"""What holds for every effect: numbers, words, rivals, and that its fingerprint is what its simulation misses."""

import inspect
import re
from operator import attrgetter

import mujoco
import numpy as np
import pytest
from effects.arm import JOINTS, address, arm, record

from torchrl_athletic.diagnosis.screen import Candidate
from torchrl_athletic.effects import (
    CATALOGUE,
    ClockShift,
    Compliance,
    Effect,
    JointAddress,
    LinkComShift,
    LinkInertia,
    Plant,
    project_recording,
)
from torchrl_athletic.effects.plant import Law, Now, Start
from torchrl_athletic.recordings import Recording

FAMILIES = {
    *("friction", "presliding", "transmission", "coupling", "inertia", "timing", "torque", "elastic", "sensing"),
    *("control", "change"),
}
TRIMS_ALONE = (LinkInertia(), LinkComShift(), ClockShift())  # adjusted beside the findings, never found
EVERY = (*CATALOGUE, *TRIMS_ALONE)
OF_THE_DESIGN = {
    *("coulomb_friction", "viscous_friction", "stribeck_friction", "load_dependent_friction", "asymmetric_friction"),
    *(
        "hysteresis",
        "backlash",
        "compliance",
        "coupled_drive",
        "reflected_inertia",
        "link_mass",
        "link_com",
        "payload",
        "gravity_tilt",
    ),
    "offset_payload",
    *("actuation_delay", "actuation_lag", "torque_scale", "torque_offset", "torque_saturation", "speed_torque_limit"),
    *("torque_ripple", "joint_spring", "joint_stop", "encoder_offset", "encoder_scale", "clock_offset"),
    *("gain_mismatch", "thermal_drift", "disturbance"),
}
RIGID = [Compliance().parameters(arm(), address(), joint)[0].nominal for joint in (0, 1)]
CHANGE = {  # true value less the given one: shoulder, elbow
    "backlash": ([0.05, 2000.0 - RIGID[0]], [0.06, 400.0 - RIGID[1]]),
    "compliance": ([90.0 - RIGID[0], 0.9], [25.0 - RIGID[1], 0.25]),
    "coupled_drive": ([], [0.1, 0.05, 0.005, 1.0]),  # the first joint has none before it
    "payload": ([], [0.3]),  # only the last link carries one
    "offset_payload": ([], [0.3, 0.012, -0.006, 0.018]),
    "gravity_tilt": ([0.03, -0.1], []),  # of the whole robot
    "coulomb_friction": ([0.3, 0.0], [0.1, 0.0]),
    "stribeck_friction": ([0.2, 0.2, -0.2], [0.06, 0.06, -0.2]),
    "load_dependent_friction": ([0.1, 0.15], [0.03, 0.15]),
    "hysteresis": ([0.5, -0.9], [0.15, -0.7]),
    "torque_saturation": ([-38.5], [-14.5]),
    "speed_torque_limit": ([-38.0, -997.0], [-14.3, -996.0]),
    "torque_ripple": ([0.2, 0.1, 6.0], [0.1, -0.05, 8.0]),
    "joint_spring": ([0.6, 0.3], [0.3, -0.1]),
    "joint_stop": ([-0.3, -2.0, 20.0], [0.3, 0.0, 10.0]),
    "encoder_scale": ([0.03], [-0.04]),
    "clock_offset": ([0.01], [-0.01]),
    "thermal_drift": ([0.2, 0.3, 0.2, 2.0], [0.1, 0.1, 0.1, 2.0]),
    "disturbance": ([2.0, -0.5, 0.6, 0.0], [2.0, -0.5, 0.2, 0.0]),
    "viscous_friction": ([0.15], [0.15]),
    "asymmetric_friction": ([0.3, 0.1, 0.05, 0.2], [0.1, 0.03, 0.05, 0.2]),
    "reflected_inertia": ([0.03], [0.02]),
    "link_mass": ([0.3], [0.2]),
    "link_com": ([0.02], [-0.02]),
    "link_inertia": ([0.5], [-0.4]),
    "link_com_shift": ([0.02, 0.01, -0.015], [-0.02, 0.01, 0.02]),
    "clock_shift": ([0.002], []),
    "actuation_delay": ([0.014], [0.02]),
    "actuation_lag": ([0.014], [0.02]),
    "torque_scale": ([0.1], [-0.1]),
    "torque_offset": ([0.4], [-0.3]),
    "encoder_offset": ([0.05], [-0.05]),
    "gain_mismatch": ([-0.2, 0.3], [0.3, -0.2]),
}
SLIDER = """
<mujoco><worldbody><body><joint name="rail" type="slide" axis="1 0 0"/><geom size="0.1" mass="4"/></body></worldbody>
</mujoco>"""


def slider() -> mujoco.MjModel:
    return mujoco.MjModel.from_xml_string(SLIDER)


def now_at_one(rows: int) -> Now:
    one = np.ones((rows, 2))
    return Now(one, one, one, np.ones(rows), 1e-3)


def law_outputs(plant: Plant) -> list[np.ndarray]:
    """What laws add, and what motors change, after a start from a motion."""
    time = np.linspace(0.0, 1.0, 50)
    motion = np.stack([np.sin(3 * time), np.cos(3 * time)], -1)
    start = Start(
        time, motion, 3 * motion[:, ::-1], motion, np.full(plant.rows, 10), began=np.zeros(1), mean_reading=np.zeros(1)
    )
    out = []
    for law in (*plant.laws, *plant.motor):
        if isinstance(law, Law):
            law.begin(start)
        out.append(law(now_at_one(plant.rows)) - (1.0 if law in plant.motor else 0.0))
    return out


def of_each(*effects: Effect):
    return pytest.mark.parametrize("effect", effects or EVERY, ids=lambda e: e.name)


def of_each_joint(*effects: Effect):
    """Each effect on each of the arm's joints that can have it; one of the whole robot is asked for the first."""
    return pytest.mark.parametrize(
        ("effect", "joint"),
        [
            pytest.param(effect, joint, id=f"{name}-{effect.name}")
            for effect in effects or EVERY
            for joint, name in enumerate(JOINTS[: 1 if effect.whole_robot else None])
            if effect.parameters(arm(), address(), joint)
        ],
    )


def rail() -> JointAddress:
    return JointAddress.of(slider(), ("rail",))


def nominal_values(effect: Effect, joint: int) -> np.ndarray:
    return np.array([p.nominal for p in effect.parameters(arm(), address(), joint)])


def named(effect: Effect, joint: int, values: np.ndarray) -> dict[str, float]:
    return {p.name: float(v) for p, v in zip(effect.parameters(arm(), address(), joint), values, strict=True)}


def test_names_are_the_designs_and_occur_once():
    names = [e.name for e in CATALOGUE]
    assert len(set(names)) == len(names)
    assert set(names) == OF_THE_DESIGN
    assert {e.name for e in TRIMS_ALONE}.isdisjoint(names)


@of_each_joint()
def test_the_given_value_lies_within_the_bounds_and_the_scale_is_a_small_step(effect, joint):
    parameters = effect.parameters(arm(), address(), joint)
    assert len({p.name for p in parameters}) == len(parameters) > 0
    for p in parameters:
        assert p.lower <= p.nominal <= p.upper
        fixed = effect.name == "offset_payload" and p.name == "moment_y"  # along both axes of this arm: none feels it
        assert (p.upper == p.lower) == fixed
        assert 0 < p.scale <= (np.inf if fixed else 0.2 * (p.upper - p.lower))


@of_each()
def test_the_docstring_names_every_parameter_with_its_unit(effect):
    text = inspect.getdoc(type(effect))
    units = " ".join(re.findall(r"\[([^]]*)\]", text)).replace(",", "").split()
    for model, at in ((arm(), address()), (slider(), rail())):
        for p in effect.parameters(model, at, 0):
            assert f"``{p.name}``" in text
            assert p.unit in units


@of_each()
def test_units_are_forces_for_a_slide_and_torques_for_a_hinge(effect):
    hinge = {p.name: p.unit for p in effect.parameters(arm(), address(), 1)}
    slide = {p.name: p.unit for p in effect.parameters(slider(), rail(), 0)}
    in_newton = {"N·m": "N", "N·m·s/rad": "N·s/m", "kg·m²": "kg", "rad": "m"}
    in_newton |= {"rad/s": "m/s", "N·m/rad": "N/m", "1/rev": "1/m"}
    if effect.name == "gravity_tilt":  # the base turns, whatever its joints do
        in_newton = {}
    assert slide == {name: in_newton.get(hinge[name], hinge[name]) for name in slide}
    of_hinges = {"link_com", "link_com_shift", "link_inertia", "offset_payload", "coupled_drive"}
    assert bool(slide) == (effect.name not in of_hinges)


@of_each_joint()
def test_the_given_values_change_nothing(effect, joint):
    plant = Plant(arm(), address(), 3)
    effect.apply(plant, joint, np.tile(nominal_values(effect, joint), (3, 1)))
    for name, value in plant.fields.items():
        if name not in ("dof_solref", "dof_solimp"):  # of a friction that is not there
            given = np.asarray(attrgetter(name)(arm()))
            np.testing.assert_allclose(value, np.tile(given, (3, *[1] * (value.ndim - 1))), atol=1e-15)
    for name in ("delay", "lag", "torque_offset", "encoder_offset"):
        assert not getattr(plant, name).any()
    assert not plant.clock_offset.any()
    for name in ("torque_scale", "kp_scale", "kd_scale", "encoder_scale"):
        np.testing.assert_array_equal(getattr(plant, name), 1.0)
    for added in law_outputs(plant):
        np.testing.assert_allclose(added, 0, atol=1e-15)
    assert not plant.gears


@of_each()
def test_every_row_gets_its_own_value_and_other_joints_none(effect):
    joint = 0 if effect.whole_robot else 1
    given = nominal_values(effect, joint)
    rows = given + np.array([[0.0], [0.5], [1.0]]) * CHANGE[effect.name][joint]
    plant = Plant(arm(), address(), 3)
    effect.apply(plant, joint, rows)

    added = law_outputs(plant)
    chain = [plant.delay, plant.lag, plant.torque_scale, plant.torque_offset, plant.kp_scale, plant.kd_scale]
    chain += [plant.torque_limit, plant.encoder_offset, plant.encoder_scale, *added]
    if effect.name != "coupled_drive":  # which the shoulder turns, too
        assert all((value[:, 0] == value[0, 0]).all() for value in chain)  # the shoulder's
    assert all(gear.joint == joint for gear in plant.gears)
    springs = [part for gear in plant.gears for part in (gear.spring.stiffness, gear.spring.damping)]
    shared = [plant.clock_offset, *plant.fields.values(), *springs]
    if effect.name != "disturbance":  # which belongs to one take, and this is another
        assert any((value[row] != value[0]).any() for value in (*chain, *shared) for row in (1, 2))


@of_each_joint(*(e for e in EVERY if e.name != "disturbance"))  # which knows the take that it belongs to
def test_the_fingerprint_of_the_true_change_is_what_the_simulation_misses(effect, joint):
    change = np.array(CHANGE[effect.name][joint])
    values = nominal_values(effect, joint) + change
    long = 12.0 if effect.name == "thermal_drift" else 5.0
    recording = record(effect, joint, values, position_control=effect.name == "gain_mismatch", seconds=long)
    s = project_recording(recording, arm(), np.zeros(2), kernel=0.01)
    assert s.valid.mean() > 0.9
    given = named(effect, joint, values)
    nonlinear = effect.grid(s, joint)[-1 if "turnover" not in given else 3]  # with the sign of the velocity
    fingerprint = effect.fingerprint(s, joint, {name: given.get(name, x) for name, x in nonlinear.items()})
    linear = [
        c for p, c in zip(effect.parameters(arm(), address(), joint), change, strict=True) if p.name not in nonlinear
    ]
    predicted = fingerprint.columns @ np.array(linear)
    if fingerprint.constant is not None:
        predicted = predicted + fingerprint.constant
    assert predicted.shape == s.missing.shape
    moving = np.abs(s.velocity[:, joint]) > 0.05 * np.abs(s.velocity[:, joint]).max()  # a stuck joint has any friction
    missing, predicted = s.missing[moving], predicted[moving]
    left = ((missing - predicted) ** 2).sum() / (missing**2).sum()
    assert left < 0.06
    assert np.vdot(missing, predicted) / np.vdot(predicted, predicted) == pytest.approx(1, abs=0.12)


@of_each()
def test_what_a_grid_tries_lies_within_the_bounds(effect):
    servo = effect.name == "gain_mismatch"
    s = project_recording(record(position_control=servo, seconds=12.0), arm(), np.zeros(2))
    bounds = {p.name: (p.lower, p.upper) for p in effect.parameters(arm(), address(), 1)}
    for point in effect.grid(s, 1):
        for name, (low, high) in bounds.items():
            assert low <= point.get(name, low) <= high


@of_each(*(e for e in EVERY if e.name != "gain_mismatch"))  # which is asked of position control only
@pytest.mark.parametrize("joint", ['type="slide" axis="1 0 0"', 'axis="0 1 0"'], ids=["rail", "axle"])
def test_what_is_predicted_of_a_body_on_its_own_frame_is_a_number(effect, joint):
    """A carriage, and a wheel whose axle goes through its centre: MuJoCo keeps such bodies as simple ones."""
    model = mujoco.MjModel.from_xml_string(
        f'<mujoco><worldbody><body><joint name="rail" {joint}/><geom type="box" size="0.3 0.1 0.1" mass="4"/>'
        "</body></worldbody></mujoco>"
    )
    assert model.body_simple[1]
    time = np.arange(0.0, 4.0, 0.004)
    read = 0.2 * np.sin(3 * time) + 0.1 * np.sin(8 * time)
    recording = Recording(time, ("rail",), read[:, None], torque_command=4 * np.cos(5 * time)[:, None])
    s = project_recording(recording, model, np.zeros(1))
    grid = effect.grid(s, 0) if effect.parameters(model, s.address, 0) else []
    for predicted in effect.fingerprints(s, 0, grid) if grid else ():
        assert np.isfinite(predicted.columns).all()
        assert predicted.constant is None or np.isfinite(predicted.constant).all()
    if effect.name == "link_com":  # no lever, no direction to move along
        assert effect.grid(s, 0) == []
        np.testing.assert_allclose(effect.fingerprint(s, 0, {}).columns, 0, atol=1e-6)


@of_each_joint()
def test_the_sentence_says_the_joint_the_numbers_and_the_units(effect, joint):
    parameters = effect.parameters(arm(), address(), joint)
    values = nominal_values(effect, joint) + np.array(CHANGE[effect.name][joint])
    text = effect.sentence(JOINTS[joint], named(effect, joint, values), parameters)
    assert JOINTS[joint] in text or effect.whole_robot
    assert text.endswith(".")
    numbers = [abs(float(x)) for x in re.findall(r"[-+]?\d+\.?\d*(?:e[-+]?\d+)?", text)]
    for p, value in zip(parameters, values, strict=True):
        if p.name in ("side", "take"):
            continue  # said in words
        shown = [
            abs(value),
            1e3 * abs(value),
            100 * abs(value - 1),
        ]  # in the unit, in thousandths, in percent of change
        assert any(n == pytest.approx(x, rel=6e-3) for n in numbers for x in shown), (p.name, value, text)
        units = {"s": ("ms", " s "), "m": ("mm",), "rad": ("mrad",), "1": ("times", "%")}.get(p.unit, (p.unit,))
        assert any(unit in text for unit in units)


@of_each()
def test_the_given_models_number_stands_beside_the_true_one(effect):
    joint = 1 if effect.name in ("payload", "offset_payload", "coupled_drive") else 0
    parameters = effect.parameters(arm(), address(), joint)
    values = nominal_values(effect, joint) + np.array(CHANGE[effect.name][joint])
    text = effect.sentence(JOINTS[joint], named(effect, joint, values), parameters)
    for p in parameters:
        if p.nominal not in (0.0, 1.0) and p.name not in ("no_load_speed", "time_constant"):
            assert f"{p.nominal:.3g} {p.unit}" in text or f"{1e3 * p.nominal:.3g} m{p.unit}" in text
    if all(p.nominal == 0 for p in parameters) and effect.name != "encoder_offset" and effect in CATALOGUE:
        assert re.search("the model (has none|acts at once)|the model's follows at once", text)


@of_each()
def test_experiments_are_against_known_rivals_and_name_the_joint(effect):
    for rival, text in effect.experiments.items():
        assert rival in OF_THE_DESIGN - {effect.name}
        assert set(re.findall(r"{(\w*)}", text)) == {"joint"}
        assert "elbow" in effect.experiment(rival, "elbow")
    unheard_of = effect.experiment("an effect of your own", "elbow")
    assert "record elbow alone" in unheard_of
    assert "{" not in unheard_of


@of_each()
def test_what_it_excludes_is_known_and_not_itself(effect):
    assert effect.excludes <= OF_THE_DESIGN - {effect.name}
    assert effect.shows_in in ("speed", "acceleration", "position", "load", "time")
    assert effect.equation
    assert re.search(r"\d{4}|Isaac|MuJoCo", effect.source)


@of_each()
def test_it_is_of_one_family_and_what_is_identical_to_it_can_stand_together(effect):
    assert effect.family in FAMILIES
    by_name = {e.name: e for e in CATALOGUE}
    for others in effect.identical_to:
        assert others <= OF_THE_DESIGN - {effect.name}
        assert all(others.isdisjoint(by_name[name].excludes) for name in others)


def test_exclusion_holds_both_ways_on_a_joint_and_not_across_joints():
    def candidates(joint: int) -> list[Candidate]:
        return [Candidate(e, joint, JOINTS[joint], e.parameters(arm(), address(), joint)) for e in EVERY]

    shoulder, elbow = candidates(0), candidates(1)
    for a in shoulder:
        assert not a.allows(a)
        assert all(a.allows(b) for b in elbow)
        for b in shoulder:
            assert a.allows(b) == b.allows(a)
            if b.effect.name in a.effect.excludes:
                assert not a.allows(b)
    by_name = {c.effect.name: c for c in shoulder}
    assert not by_name["coulomb_friction"].allows(by_name["asymmetric_friction"])
    assert by_name["coulomb_friction"].allows(by_name["viscous_friction"])


@pytest.mark.parametrize(
    ("name", "sensible", "nonsense"),
    [
        ("reflected_inertia", [[0.001], [0.5]], [[0.0]]),
        ("torque_scale", [[0.3], [2.5]], [[0.2], [3.0]]),
        ("backlash", [[0.002, 50.0], [0.09, 50.0]], [[0.0, 50.0], [0.1, 50.0]]),
    ],
)
def test_what_lies_at_the_end_of_what_may_be_makes_no_sense(name, sensible, nonsense):
    (effect,) = (e for e in EVERY if e.name == name)
    parameters = effect.parameters(arm(), address(), 1)
    assert all(effect.is_physical(parameters, np.array(values)) for values in sensible)
    assert not any(effect.is_physical(parameters, np.array(values)) for values in nonsense)
