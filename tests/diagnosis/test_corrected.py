"""A correction survives its file, and what MJCF can say of it is said in MJCF."""

import json
from dataclasses import replace

import mujoco
import numpy as np
import pytest
from diagnosis.plants import double_pendulum, pendulum, record, smooth_torque

from torchrl_athletic.diagnosis.corrected import Simulation, write_atomically, write_json
from torchrl_athletic.diagnosis.corrected_xml import corrected_xml, logged_gains, written
from torchrl_athletic.diagnosis.fit import Hypothesis
from torchrl_athletic.diagnosis.screen import Candidate
from torchrl_athletic.effects import CATALOGUE, FIT_TRIMS, JointAddress, Plant
from torchrl_athletic.recordings import Recording, RecordingError
from torchrl_athletic.robots import from_mjcf
from torchrl_athletic.robots.benches import two_link_arm

EFFECTS = {e.name: e for e in (*CATALOGUE, *FIT_TRIMS)}
NATIVE = {name for name, e in EFFECTS.items() if e.mjcf == "model"}
DRIVE = ("torque_scale", "torque_offset", "torque_saturation", "actuation_lag", "actuation_delay")
PASSIVE = ("torque_ripple", "hysteresis")
NATIVE_TERMS = {
    "coulomb_friction": [0.1, 0.0],
    "viscous_friction": [0.12],
    "reflected_inertia": [0.02],
    "link_mass": [0.6],
    "link_com": [0.35],
    "link_com_shift": [0.02, 0.0, -0.03],
    "link_inertia": [1.4],
    "payload": [0.2],
    "offset_payload": [0.2, 0.01, 0.0, 0.02],
    "gravity_tilt": [0.05, 0.2],
    "joint_spring": [0.8, 0.3],
}
PART_TERMS = {
    "asymmetric_friction": [0.1, 0.05, 0.02, 0.01],
    "stribeck_friction": [0.1, 0.05, 0.1],
    "load_dependent_friction": [0.1, 0.1],
    "thermal_drift": [0.1, 0.1, 0.1, 20.0],
}
MEMORY_TERMS = {
    "actuation_delay": [0.02],
    "actuation_lag": [0.02],
    "torque_scale": [1.2],
    "torque_offset": [-0.1],
    "torque_saturation": [0.5],
    "speed_torque_limit": [0.8, 5.0],
    "torque_ripple": [0.05, 0.02, 7.0],
    "hysteresis": [0.1, 0.05],
    "compliance": [40.0, 0.1],
    "backlash": [0.03, 60.0],
    "joint_stop": [0.3, 1.0, 20.0],
    "encoder_offset": [0.05],
    "encoder_scale": [1.05],
    "clock_offset": [0.01],
    "base_clock_shift": [0.002],
    "clock_shift": [0.001],
    "gain_mismatch": [1.1, 0.9],
    "disturbance": [0.2, 0.5, 0.1, 0.0],
}


def corrected(terms, trims=None, name="pendulum", effects=EFFECTS, xml=None) -> Simulation:
    model = mujoco.MjModel.from_xml_string(pendulum(name=name) if xml is None else xml)
    address = JointAddress.of(model, (name,))

    def candidates(named):
        return tuple(Candidate(effects[n], 0, name, effects[n].parameters(model, address, 0)) for n in named)

    trims = trims or {}
    values = np.array([v for part in (terms, trims) for numbers in part.values() for v in numbers])
    return Simulation(model, (name,), Hypothesis(candidates(terms), candidates(trims)), values)


def recording(name="pendulum"):
    return record(pendulum(name=name), smooth_torque(3.0), start=0.3)


@pytest.mark.parametrize(
    "terms", [{}, NATIVE_TERMS, MEMORY_TERMS, {"asymmetric_friction": [0.1, 0.05, 0.02, 0.01]}], ids=len
)
def test_what_json_holds_rolls_out_the_same(terms):
    one = corrected(terms, {"link_inertia": [1.1]})
    text = json.dumps(one.to_json(), allow_nan=False)
    two = Simulation.from_json(json.loads(text), one.model)
    np.testing.assert_array_equal(two.values, one.values)
    assert [c.key for c in two.hypothesis.trims] == [("link_inertia", "pendulum")]
    (trim,) = one.to_json()["trims"]
    assert [(p["value"], p["nominal"]) for p in trim["parameters"].values()] == [(1.1, 1.0)]
    units = {p.name: p.unit for c in one.hypothesis.terms for p in c.parameters}
    said = {name: p["unit"] for e in one.to_json()["effects"] for name, p in e["parameters"].items()}
    assert said == units
    for window in (0.5, None):
        np.testing.assert_array_equal(one.rollout(recording(), window), two.rollout(recording(), window))
    assert np.abs(one.rollout(recording()) - corrected({}).rollout(recording())).max() > 1e-3


@pytest.mark.parametrize("beyond", [0, 1, 2])
def test_what_does_not_fill_a_window_is_simulated_from_where_the_last_one_ends(beyond):
    """To the last sample: an offset of 5 N·m turns the link by milliradians within one."""
    r = recording().slice(0, 51 + beyond)
    given, pushed = (corrected(terms).rollout(r)[:, 0] for terms in ({}, {"torque_offset": [5.0]}))
    apart = np.abs(given - pushed) > 1e-3
    assert apart.tolist() == [False, *[True] * 50, *[True] * beyond]
    np.testing.assert_array_equal(given, corrected({}).rollout(r, 0.5)[:, 0])


def test_a_path_is_read_at_the_stamps_of_a_log_that_lost_samples():
    whole = record(pendulum(), np.zeros((200, 1)), start=1.0, noise=0.0)
    kept = np.delete(np.arange(200), np.arange(5, 195, 9))
    r = replace(whole, time=whole.time[kept], position=whole.position[kept], torque_command=whole.torque_command[kept])
    np.testing.assert_allclose(corrected({}).rollout(r, None), r.position, atol=5e-3)


@pytest.mark.parametrize("base", ["recorded", "fixed"])
def test_a_floating_base_moves_as_recorded_and_is_held_only_where_the_model_says_so(base):
    """A hanging trunk that is carried sideways swings the leg; one that is held where the model has it does not."""
    model = mujoco.MjModel.from_xml_string("""<mujoco><worldbody><body pos="0 0 1"><freejoint/><geom size="0.1"/>
      <body><joint name="hip" axis="0 1 0"/><geom size="0.05" pos="0 0 -0.3"/></body></body></worldbody></mujoco>""")
    time, still = np.arange(101) / 100.0, np.zeros((101, 1))
    bare = Recording(time, ("hip",), still, torque_command=still)
    carried = np.stack([0.2 * np.sin(6 * time) ** 2, 0 * time, 1 + 0 * time], -1)
    moving = replace(bare, base_position=carried, base_orientation=np.tile([1.0, 0, 0, 0], (101, 1)))
    simulation = Simulation(model, ("hip",), Hypothesis((), ()), np.zeros(0), base)
    assert Simulation.from_json(simulation.to_json(), model).base == base
    assert np.abs(simulation.rollout(moving, None)).max() > 0.1
    if base == "fixed":
        np.testing.assert_allclose(simulation.rollout(bare, None), still, atol=1e-6)
    else:
        with pytest.raises(RecordingError, match="were not recorded"):
            simulation.rollout(bare, None)


def test_a_path_has_the_columns_of_its_recording():
    """Which may name the joints in another order than the model."""
    xml = double_pendulum()
    model = mujoco.MjModel.from_xml_string(xml)
    names = tuple(model.joint(k).name for k in range(model.njnt))
    torque = np.hstack([smooth_torque(3.0, seed=0), smooth_torque(3.0, seed=1)])
    own = record(xml, torque, start=(0.3, -0.4))
    assert own.joint_names == names
    simulation = Simulation(model, names, Hypothesis((), ()), np.zeros(0))
    turned = own.ordered(names[::-1])
    path = simulation.rollout(own)
    assert abs(path[:, 0] - path[:, 1]).max() > 0.1
    np.testing.assert_allclose(simulation.rollout(turned), path[:, ::-1], atol=1e-12)


def test_an_effect_of_your_own_takes_the_place_of_the_one_of_its_name():
    own = type("Own", (type(EFFECTS["link_inertia"]),), {})()
    content = corrected({}, {"link_inertia": [1.1]}).to_json()
    (trim,) = Simulation.from_json(content, corrected({}).model, (own,)).hypothesis.trims
    assert trim.effect is own


def test_a_file_names_the_joint_of_each_effect_and_without_a_base_means_the_recorded_one():
    model, names = mujoco.MjModel.from_xml_string(double_pendulum()), ("upper", "lower")
    friction, address = EFFECTS["viscous_friction"], JointAddress.of(model, names)
    terms = tuple(Candidate(friction, j, n, friction.parameters(model, address, j)) for j, n in enumerate(names))
    content = Simulation(model, names, Hypothesis(terms), np.array([0.1, 0.2]), "fixed").to_json()
    assert [c.joint for c in Simulation.from_json(content, model).hypothesis.terms] == [0, 1]
    del content["base"]
    assert Simulation.from_json(content, model).base == "recorded"


def test_an_effect_of_another_catalogue_is_refused_by_name():
    content = corrected(NATIVE_TERMS).to_json()
    few = tuple(e for e in CATALOGUE if e.name != "coulomb_friction")
    with pytest.raises(ValueError, match=r"'coulomb_friction' is not in the catalogue.*Pass yours"):
        Simulation.from_json(content, corrected({}).model, few)
    content["trims"] = [e for e in content["effects"] if e["effect"] == "coulomb_friction"]  # that rests beside others
    content["effects"] = []
    assert [c.effect.name for c in Simulation.from_json(content, corrected({}).model, few).hypothesis.trims] == [
        "coulomb_friction"
    ]


@pytest.mark.parametrize("name", [*sorted(NATIVE_TERMS), "all"])
@pytest.mark.parametrize("angle", ["degree", "radian"])
def test_mjcf_alone_moves_as_the_corrected_simulation_when_it_can_say_all(name, angle):
    given = pendulum().replace("<option", f'<compiler angle="{angle}"/><option')
    terms = NATIVE_TERMS if name == "all" else {name: NATIVE_TERMS[name]}
    simulation = corrected(terms, xml=given)
    xml = corrected_xml(given, simulation)
    alone = Simulation(mujoco.MjModel.from_xml_string(xml), ("pendulum",), Hypothesis(()), np.zeros(0))
    r = recording()
    for window in (0.5, None):
        np.testing.assert_allclose(alone.rollout(r, window), simulation.rollout(r, window), rtol=0, atol=2e-5)
    assert np.abs(alone.rollout(r, None) - corrected({}).rollout(r, None)).max() > 5e-3
    assert "not expressed" not in xml


DRIVE_TERMS = {name: MEMORY_TERMS[name] for name in DRIVE}
PASSIVE_TERMS = {name: MEMORY_TERMS[name] for name in PASSIVE}
MOTOR = '<motor joint="pendulum" gear="2" ctrlrange="-1 1"/>'
SERVO = '<position joint="pendulum" kp="6" kv="0.4"/>'


def by_actuator(xml: str, command: np.ndarray, start: float, rate: float = 100.0) -> np.ndarray:
    """Positions of a plain loop that tells the actuator each command for one sample. Shape (T, 1)."""
    model = mujoco.MjModel.from_xml_string(xml)
    data = mujoco.MjData(model)
    data.qpos[:], position = start, []
    for u in command:
        position.append(data.qpos.copy())
        for _ in range(round(1 / rate / model.opt.timestep)):
            data.ctrl[:] = u
            mujoco.mj_step(model, data)
    return np.array(position)


@pytest.mark.parametrize(
    "names",
    [
        *((name,) for name in (*sorted(DRIVE), *PASSIVE)),
        *(tuple(n for n in sorted(DRIVE) if n != left) for left in DRIVE[1:3]),
        ("torque_ripple", "torque_scale"),
        ("torque_scale", "hysteresis"),
    ],
    ids="-".join,
)
def test_a_motor_of_mjcf_moves_the_robot_as_the_corrected_drive_does(names):
    given = pendulum().replace('<motor joint="pendulum"/>', MOTOR)
    simulation = corrected({name: (DRIVE_TERMS | PASSIVE_TERMS)[name] for name in names}, xml=given)
    xml = corrected_xml(given, simulation, "torques")
    assert "not expressed" not in xml
    assert mujoco.MjModel.from_xml_string(xml).nu == 1
    torque = smooth_torque(3.0)
    torque[:10] = 0.0  # what a line holds before is nothing to MuJoCo, and the first command to a replay
    r = record(given, torque, start=0.3, noise=0.0)
    moved = by_actuator(xml, torque / 2, 0.3)
    np.testing.assert_allclose(moved, simulation.rollout(r, None), rtol=0, atol=5e-3)  # half a step
    assert np.abs(moved - by_actuator(given, torque / 2, 0.3)).max() > 3e-2


@pytest.mark.parametrize(
    "terms",
    [
        {"actuation_delay": [0.03], "torque_saturation": [0.5]},
        {"gain_mismatch": [1.4, 0.6]},
        {"torque_scale": [0.7], "torque_saturation": [0.5]},
        {"torque_scale": [0.7], "torque_offset": [0.2], "torque_saturation": [0.5]},
        {"gain_mismatch": [0.5, 1.5], "actuation_delay": [0.02]},
    ],
    ids=lambda terms: "-".join(terms),
)
def test_a_servo_of_mjcf_takes_gains_a_scale_a_late_target_and_a_limit_but_no_lag(terms):
    given = pendulum().replace('<motor joint="pendulum"/>', SERVO)
    simulation = corrected(terms, xml=given)
    target = 0.5 * smooth_torque(3.0)
    target[:10] = 0.0
    gains = {"kp": np.array([6.0]), "kd": np.array([0.4])}
    r = record(given, target, noise=0.0, **gains)
    xml = corrected_xml(given, simulation, "targets")
    moved = by_actuator(xml, target, 0.0)
    np.testing.assert_allclose(moved, simulation.rollout(r, None), rtol=0, atol=3e-3)
    assert np.abs(moved - by_actuator(given, target, 0.0)).max() > 3e-2
    assert "not expressed" not in xml
    late = corrected({"torque_scale": [1.5], "actuation_lag": [0.02]}, xml=given)
    both = written(given, late, "targets")
    assert both.left_out == ("actuation_lag of pendulum",)
    assert "WARNING: corrected.xml alone is not the whole correction" in both.xml.splitlines()[1]
    assert from_mjcf(both.xml, torque_limit=5.0).kp == (9.0,)


def test_recordings_have_gains_in_common_only_if_stiffness_and_damping_are_the_same():
    target = 0.5 * smooth_torque(1.0)
    soft, same, damped, stiff = (
        record(pendulum(), target, kp=np.array([kp]), kd=np.array([kd]))
        for kp, kd in ((6.0, 0.4), (6.0, 0.4), (6.0, 0.8), (9.0, 0.4))
    )
    assert logged_gains([soft, same]) == {"pendulum": (6.0, 0.4)}
    assert logged_gains([soft, damped]) is None
    assert logged_gains([soft, stiff]) is None
    assert logged_gains([soft, record(pendulum(), target)]) is None


def test_the_logged_gains_take_the_place_of_those_that_somebody_put_into_the_model():
    given = pendulum().replace('<motor joint="pendulum"/>', SERVO)
    simulation = corrected({"gain_mismatch": [2.0, 3.0]}, xml=given)
    xml = corrected_xml(given, simulation, "targets", gains={"pendulum": (10.0, 0.1)})
    model = mujoco.MjModel.from_xml_string(xml)
    assert model.actuator_gainprm[0, 0] == pytest.approx(20.0)
    assert model.actuator_biasprm[0, 1:3] == pytest.approx([-20.0, -0.3])
    ratio = pendulum().replace('<motor joint="pendulum"/>', '<position joint="pendulum" kp="6" dampratio="1"/>')
    assert written(ratio, corrected({"gain_mismatch": [2.0, 3.0]}, xml=ratio), "targets").left_out


@pytest.mark.parametrize("terms", [{}, {"coulomb_friction": [0.1, 0.0]}, {"gain_mismatch": [1.4, 0.6]}])
@pytest.mark.parametrize("gear", [1.0, 2.0, -0.5])
@pytest.mark.parametrize("own", ['kp="6" kv="0.4"', 'kp="90" dampratio="1"'])
def test_the_written_servo_follows_with_the_logged_gains_as_the_corrected_simulation_does(terms, gear, own):
    """Whatever the model's gains and gear are, and also where nothing is missing; the actuator turns gear times."""
    given = pendulum().replace('<motor joint="pendulum"/>', f'<position joint="pendulum" {own} gear="{gear}"/>')
    simulation = corrected(terms, xml=given)
    target = 0.5 * smooth_torque(3.0)
    target[:10] = 0.0
    r = record(given, target, noise=0.0, kp=np.array([12.0]), kd=np.array([1.2]))
    xml = corrected_xml(given, simulation, "targets", gains=logged_gains([r]))
    moved = by_actuator(xml, gear * target, 0.0)
    np.testing.assert_allclose(moved, simulation.rollout(r, None), rtol=0, atol=3e-3)
    assert np.abs(moved - by_actuator(given, gear * target, 0.0)).max() > 3e-2


def test_gains_of_joints_in_another_order_are_the_same_joint_by_joint():
    still, time = np.zeros((50, 2)), np.arange(50) / 100
    hip_first = Recording(
        time, ("hip", "knee"), still, position_target=still, kp=np.array([9.0, 4.0]), kd=np.array([1.0, 0.5])
    )
    knee_first = hip_first.ordered(("knee", "hip"))
    assert logged_gains([hip_first, knee_first]) == {"hip": (9.0, 1.0), "knee": (4.0, 0.5)}
    assert logged_gains([hip_first, replace(knee_first, kp=hip_first.kp, kd=hip_first.kd)]) is None


@pytest.mark.parametrize("commands", [None, "torques"])
def test_gains_that_no_target_was_followed_with_are_not_written(commands):
    given = pendulum().replace('<motor joint="pendulum"/>', SERVO)
    xml = corrected_xml(given, corrected({}, xml=given), commands, gains={"pendulum": (10.0, 0.1)})
    assert mujoco.MjModel.from_xml_string(xml).actuator_gainprm[0, 0] == pytest.approx(6.0)


@pytest.mark.parametrize(
    "actuators",
    [
        "",
        '<motor joint="pendulum"/><motor joint="pendulum"/>',
        '<velocity joint="pendulum" kv="1"/>',
        '<intvelocity joint="pendulum" kp="1" actrange="-1 1"/>',
    ],
)
def test_what_no_single_motor_or_servo_drives_keeps_its_drive_in_json(actuators):
    given = pendulum().replace('<motor joint="pendulum"/>', actuators)
    xml = corrected_xml(given, corrected(DRIVE_TERMS, xml=given), "torques")
    assert {name for name in DRIVE if f"{name} of pendulum" in xml} == set(DRIVE)


@pytest.mark.parametrize("commands", [None, "targets"])
def test_a_delay_is_not_given_to_an_actuator_that_takes_other_commands_than_were_late(commands):
    xml = corrected_xml(pendulum(), corrected({"actuation_delay": [0.02]}), commands)
    assert "actuation_delay of pendulum" in xml
    assert mujoco.MjModel.from_xml_string(xml).actuator_delay == pytest.approx([0.0])


def test_limits_that_are_there_stay_and_a_constant_torque_makes_no_servo():
    given = pendulum(joint='actuatorfrcrange="-0.4 0.2"').replace('<motor joint="pendulum"/>', MOTOR)
    terms = {"torque_saturation": [0.35], "torque_scale": [0.8]}
    model = mujoco.MjModel.from_xml_string(corrected_xml(given, corrected(terms, xml=given)))
    assert model.jnt_actfrcrange[0] == pytest.approx([-0.28, 0.2])
    assert model.actuator_forcerange[0] == pytest.approx([-1.0, 1.0])
    xml = corrected_xml(given, corrected({"torque_offset": [0.1], "torque_saturation": [0.35]}, xml=given))
    assert "torque_saturation of pendulum" not in xml
    model = mujoco.MjModel.from_xml_string(xml)
    assert model.jnt_actfrcrange[0] == pytest.approx([-0.25, 0.2])  # of what is commanded, before the offset
    assert model.actuator_forcerange[0] == pytest.approx([-1.0, 1.0])
    assert from_mjcf(xml).kp == (0.0,)


def test_a_drive_that_a_chain_acts_out_stays_out_of_the_actuators():
    given = pendulum().replace('<motor joint="pendulum"/>', MOTOR)
    xml = corrected_xml(given, corrected(DRIVE_TERMS, xml=given), "torques", drive=False)
    assert {name for name in DRIVE if f"{name} of pendulum" in xml} == set(DRIVE)
    model = mujoco.MjModel.from_xml_string(xml)
    assert (model.na, model.actuator_gainprm[0, 0], model.jnt_actfrclimited[0]) == (0, 1.0, 0)


@pytest.mark.parametrize("effect", ["actuation_lag", "hysteresis"])
def test_nothing_adds_a_state_to_a_model_whose_keyframes_hold_some(effect):
    other = '<general joint="pendulum" dyntype="integrator" gear="0"/>'
    given = pendulum()
    key = '<keyframe><key qpos="0" act="0.5"/></keyframe></mujoco>'
    two = given.replace('<body name="link">', '<body name="arm"><joint name="arm"/><inertial pos="0 0 0" mass="1" '
                        'diaginertia="1 1 1"/></body><body name="link">')  # fmt: skip
    two = two.replace("</actuator>", other.replace("pendulum", "arm") + "</actuator>")
    two = two.replace("</mujoco>", key.replace('qpos="0"', 'qpos="0 0"'))
    model = mujoco.MjModel.from_xml_string(two)
    names = ("arm", "pendulum")
    address = JointAddress.of(model, names)
    law = Candidate(EFFECTS[effect], 1, "pendulum", EFFECTS[effect].parameters(model, address, 1))
    xml = corrected_xml(two, Simulation(model, names, Hypothesis((law,)), np.array(MEMORY_TERMS[effect])), "torques")
    assert f"{effect} of pendulum" in xml
    assert mujoco.MjModel.from_xml_string(xml).key_act.tolist() == [[0.5]]


@pytest.mark.parametrize("limits", ['actuatorfrcrange="-0.6 0.4"', ""])
def test_a_range_of_the_motor_does_not_limit_the_friction_beside_it(limits):
    given = pendulum(joint=limits).replace('<motor joint="pendulum"/>', MOTOR)
    model = mujoco.MjModel.from_xml_string(corrected_xml(given, corrected({"hysteresis": [0.9, 0.01]}, xml=given)))
    data = mujoco.MjData(model)
    data.ctrl[0] = 5.0
    for _ in range(200):  # turned by hand, against its weight too
        data.qvel[0] = 1.0
        mujoco.mj_step(model, data)
    assert data.qfrc_actuator[0] == pytest.approx((0.4 if limits else 2.0) - 0.9, abs=1e-6)
    assert from_mjcf(corrected_xml(given, corrected({"hysteresis": [0.9, 0.01]}, xml=given)), torque_limit=3.0).kp == (
        0,
    )


@pytest.mark.parametrize(
    "more",
    ['<motor joint="pendulum"/><motor joint="pendulum"/>', '<motor name="pendulum_hysteresis" joint="pendulum"/>'],
)
def test_friction_that_a_range_of_two_motors_would_limit_or_whose_name_is_in_use_stays_in_json(more):
    given = pendulum(joint='actuatorfrcrange="-1 1"').replace('<motor joint="pendulum"/>', more)
    xml = corrected_xml(given, corrected({"hysteresis": [0.1, 0.05]}, xml=given))
    assert "not expressed here, see corrected.json: hysteresis of pendulum" in xml


HOSTILE = """<default><general gear="50" delay="0.01" nsample="5" damping="1" armature="2" forcerange="-.01 .01"
  ctrlrange="-3 3"/><tendon margin="0.05" armature="5" stiffness="7" damping="3" range="-.1 .1"/></default>"""


@pytest.mark.parametrize("terms", [{"hysteresis": [0.1, 0.05]}, {"torque_ripple": [0.3, 0.0, 7.0]}])
def test_no_default_of_the_model_reaches_what_is_added(terms):
    plain = pendulum().replace('<motor joint="pendulum"/>', "")
    xmls = [
        corrected_xml(given, corrected(terms, xml=given))
        for given in (plain, plain.replace("<world", HOSTILE + "<world"))
    ]
    models = [mujoco.MjModel.from_xml_string(xml) for xml in xmls]
    for name in ("gear", "forcelimited", "delay", "damping", "armature", "biasprm", "dynprm"):
        one, other = (getattr(model, f"actuator_{name}") for model in models)
        np.testing.assert_allclose(other, one, err_msg=name)


@pytest.mark.parametrize("limits", ['ctrlrange="-1 1"', 'forcerange="-1 1"', 'ctrlrange="-9 9" forcerange="-1 1"'])
def test_a_ripple_stays_within_the_range_of_the_motor(limits):
    given = pendulum().replace('<motor joint="pendulum"/>', f'<motor joint="pendulum" {limits}/>')
    simulation = corrected({"torque_ripple": [0.4, 0.0, 3.0]}, xml=given)
    xml = corrected_xml(given, simulation, "torques")
    assert "not expressed" not in xml
    torque = smooth_torque(3.0, amplitude=1.6)
    torque[:10] = 0.0
    if "9" not in limits and "ctrl" in limits:
        torque = torque.clip(-1, 1)  # beyond it there is no command
    r = record(given, torque, start=0.3, noise=0.0)
    moved = by_actuator(xml, torque, 0.3)
    np.testing.assert_allclose(moved, simulation.rollout(r, None), rtol=0, atol=8e-3)
    unlimited = corrected({"torque_ripple": [0.4, 0.0, 3.0]}, xml=pendulum())
    assert np.abs(moved - by_actuator(corrected_xml(pendulum(), unlimited), torque, 0.3)).max() > 3e-2


def test_a_range_cannot_limit_ripple_and_leave_friction_out_at_one_joint():
    given = pendulum(joint='actuatorfrcrange="-1 1"')
    xml = corrected_xml(given, corrected({"torque_ripple": [0.4, 0.0, 3.0], "hysteresis": [0.1, 0.05]}, xml=given))
    assert "not expressed here, see corrected.json: torque_ripple of pendulum" in xml
    assert "hysteresis of pendulum" not in xml


@pytest.mark.parametrize("terms", [{"link_mass": [0.8]}, {"reflected_inertia": [0.4]}, {"compliance": [40.0, 0.1]}])
def test_a_spring_given_by_its_frequency_stays_as_it_was_diagnosed(terms):
    given = pendulum(joint='springdamper="0.3 1" armature="0.1"')
    model = mujoco.MjModel.from_xml_string(given)
    written = mujoco.MjModel.from_xml_string(corrected_xml(given, corrected(terms, xml=given)))
    link = written.joint("pendulum_link" if "compliance" in terms else "pendulum").id
    assert np.ravel(written.jnt_stiffness[link])[0] == pytest.approx(np.ravel(model.jnt_stiffness)[0], rel=1e-5)
    assert np.ravel(written.dof_damping[link])[0] == pytest.approx(np.ravel(model.dof_damping)[0], rel=1e-5)


GEOMETRY = """
<mujoco><compiler {compiler}/><worldbody><body name="stand"><geom size=".05"/>
  <body name="link"><joint name="pendulum" axis="0 -1 0"/><geom type="capsule" size=".02" fromto="0 0 0 0 0 -.4"/>
    <body name="tool" pos="0 0 -.4"><geom size=".03"/></body></body></body></worldbody></mujoco>"""
ROUND = '<inertia ixx="0.01" iyy="0.01" izz="0.01" ixy="0" ixz="0" iyz="0"/></inertial>'
URDF = f"""
<robot name="arm">
  <link name="stand"><inertial><mass value="9"/>{ROUND}</link>
  <link name="stage"><inertial><mass value="3"/>{ROUND}</link>
  <link name="link"><inertial><origin xyz="0 0 -0.2"/><mass value="0.5"/>{ROUND}</link>
  <joint name="held" type="fixed"><parent link="stand"/><child link="stage"/></joint>
  <joint name="pendulum" type="continuous"><parent link="stage"/><child link="link"/><axis xyz="0 1 0"/></joint>
</robot>"""


@pytest.mark.parametrize(
    "given",
    [
        *(
            GEOMETRY.format(compiler=c)
            for c in (
                'fusestatic="true"',
                'inertiafromgeom="true"',
                'inertiafromgeom="true" fusestatic="true"',
                'boundmass="0.2" boundinertia="0.001"',
                'boundinertia="0.01"',
                'boundmass="0.9"',
            )
        ),
        pytest.param(
            GEOMETRY.format(compiler='settotalmass="5"'),
            marks=pytest.mark.filterwarnings("ignore:compiler attribute 'settotalmass' is deprecated"),
        ),
        URDF,
    ],
    ids=["fused", "geometry", "both", "bounds", "inertia", "mass", "total", "urdf"],
)
def test_a_mass_reaches_its_own_link_past_whatever_the_compiler_does(given):
    model = mujoco.MjModel.from_xml_string(given)
    xml = corrected_xml(given, corrected({"link_mass": [0.77]}, xml=given))
    heavier = mujoco.MjModel.from_xml_string(xml)
    body = int(model.joint("pendulum").bodyid[0])
    wanted = model.body_mass.copy()
    wanted[body] = 0.77
    assert [heavier.body(i).name for i in range(heavier.nbody)] == [model.body(i).name for i in range(model.nbody)]
    np.testing.assert_allclose(heavier.body_mass, wanted, rtol=1e-5)
    assert heavier.body_inertia[body] == pytest.approx(
        model.body_inertia[body] * 0.77 / model.body_mass[body], rel=1e-4
    )


def test_dry_friction_brings_its_stiffness_into_mjcf():
    model = mujoco.MjModel.from_xml_string(corrected_xml(pendulum(), corrected({"coulomb_friction": [0.1, 0.0]})))
    assert model.dof_frictionloss == pytest.approx([0.1])
    assert model.dof_solref[0] == pytest.approx([2 * model.opt.timestep, 1.0])
    assert model.dof_solimp[0, :2] == pytest.approx([0.99, 0.99])


@pytest.mark.parametrize("angle", ["degree", "radian"])
def test_every_number_of_every_joint_reaches_its_own_place(angle):
    """Beneath a free base, where no joint has its degree of freedom's number, nor its position's; named backwards."""
    xml = f"""<mujoco><compiler angle="{angle}"/><worldbody><body><freejoint/><geom size="0.1"/>
      <body><joint name="hip" axis="0 1 0"/><geom size="0.1" pos="0 0 -0.2"/>
        <body pos="0 0 -0.4"><joint name="rail" type="slide"/><geom size="0.1"/></body></body></body></worldbody>
    </mujoco>"""
    model, names = mujoco.MjModel.from_xml_string(xml), ("rail", "hip")
    address, terms = JointAddress.of(model, names), []
    effects = ("coulomb_friction", "viscous_friction", "reflected_inertia", "joint_spring")
    for j, name in enumerate(names):
        terms += [Candidate(EFFECTS[e], j, name, EFFECTS[e].parameters(model, address, j)) for e in effects]
    values = np.array([0.1, 0.01, 0.2, 0.03, 4.0, 0.5, 0.6, 0.02, 0.7, 0.08, 9.0, 1.1])
    simulation = Simulation(model, names, Hypothesis(tuple(terms)), values)
    plant = Plant(model, address, 1)
    simulation.hypothesis.build(plant, values[None])
    written_down = mujoco.MjModel.from_xml_string(corrected_xml(xml, simulation))
    given = {"dof_frictionloss", "dof_damping", "dof_armature", "jnt_stiffness", "qpos_spring", "dof_solref"}
    assert given <= plant.fields.keys()
    for field, wanted in plant.fields.items():
        np.testing.assert_allclose(getattr(written_down, field), wanted[0], atol=1e-6, err_msg=field)


def test_mass_keeps_the_rest_of_the_link():
    model = mujoco.MjModel.from_xml_string(corrected_xml(pendulum(), corrected({"link_mass": [0.6]})))
    body = model.body("link")
    assert body.mass == pytest.approx([0.6])
    assert body.inertia == pytest.approx([0.012] * 3)
    assert body.ipos == pytest.approx([0, 0, -0.4])


def test_a_turned_link_of_two_keeps_its_principal_axes():
    given = two_link_arm()
    model = mujoco.MjModel.from_xml_string(given)
    names = tuple(model.joint(i).name for i in range(model.njnt))
    payload = EFFECTS["payload"]
    held = Candidate(payload, 1, names[1], payload.parameters(model, JointAddress.of(model, names), 1))
    simulation = Simulation(model, names, Hypothesis((held,)), np.array([0.4]))
    heavier = mujoco.MjModel.from_xml_string(corrected_xml(given, simulation))
    body = int(model.jnt_bodyid[1])
    assert heavier.body_mass[body] == pytest.approx(model.body_mass[body] + 0.4, rel=1e-5)  # six digits
    other = np.arange(model.nbody) != body
    for field in ("body_mass", "body_ipos", "body_inertia", "body_iquat"):
        np.testing.assert_allclose(getattr(heavier, field)[other], getattr(model, field)[other], rtol=1e-5, atol=1e-9)
    plant = Plant(model, JointAddress.of(model, names), 1)
    payload.apply(plant, 1, np.array([[0.4]]))
    inertia = [
        turned(quat, moments)
        for quat, moments in (
            (heavier.body_iquat[body], heavier.body_inertia[body]),
            (plant.fields["body_iquat"][0, body], plant.fields["body_inertia"][0, body]),
        )
    ]
    np.testing.assert_allclose(inertia[0], inertia[1], atol=1e-6)


def turned(quat: np.ndarray, moments: np.ndarray) -> np.ndarray:
    turn = np.zeros(9)
    mujoco.mju_quat2Mat(turn, quat)
    return turn.reshape(3, 3) @ np.diag(moments) @ turn.reshape(3, 3).T


def test_what_mjcf_cannot_say_or_not_wholly_is_named_in_a_comment():
    given = pendulum().replace('<motor joint="pendulum"/>', "")
    xml = corrected_xml(given, corrected({**NATIVE_TERMS, **PART_TERMS, **MEMORY_TERMS}, xml=given))
    head = xml[: xml.index("-->")]
    left = set(MEMORY_TERMS) - {"hysteresis"}  # two gears at one joint are none, and a ripple may come before a limit
    for said, terms in (("not expressed", left), ("in part only", set(PART_TERMS))):
        assert {n for n in EFFECTS if f"{said} here, see corrected.json: {n} of pendulum" in head} == terms
    assert set(NATIVE_TERMS) == NATIVE
    of_two_joints = {"coupled_drive"}  # see test_coupled.py
    assert {*NATIVE, *PART_TERMS, *MEMORY_TERMS} == set(EFFECTS) - of_two_joints
    mujoco.MjModel.from_xml_string(xml)


def test_trims_that_mjcf_cannot_say_are_named_too():
    xml = corrected_xml(pendulum(), corrected({"link_mass": [0.6]}, {"clock_shift": [0.001], "link_inertia": [1.1]}))
    head = xml[: xml.index("-->")]
    assert "clock_shift of pendulum" in head
    assert "link_inertia" not in head


@pytest.mark.parametrize("name", ["left elbow", "épaule/関節", "a--b", "R&amp;D &lt;1&gt;"])
def test_names_of_joints_survive(name):
    plain = name.replace("&amp;", "&").replace("&lt;", "<").replace("&gt;", ">")
    model = mujoco.MjModel.from_xml_string(pendulum(name=name))
    assert model.joint(0).name == plain
    address = JointAddress.of(model, (plain,))
    terms = tuple(
        Candidate(EFFECTS[n], 0, plain, EFFECTS[n].parameters(model, address, 0))
        for n in ("viscous_friction", "torque_scale")
    )
    simulation = Simulation(model, (plain,), Hypothesis(terms), np.array([0.2, 1.1]))
    back = Simulation.from_json(json.loads(json.dumps(simulation.to_json(), ensure_ascii=False)), model)
    assert back.joint_names == (plain,)
    xml = corrected_xml(pendulum(name=name), simulation)
    again = mujoco.MjModel.from_xml_string(xml)
    assert again.joint(plain).damping[0] == pytest.approx(0.2)


def test_a_file_is_written_whole_or_not_at_all(tmp_path):
    path = tmp_path / "new" / "one" / "a.json"
    write_json(path, {"π": [1.0]})
    assert path.read_text(encoding="utf-8") == '{\n "π": [\n  1.0\n ]\n}\n'
    with pytest.raises(ValueError, match="not JSON compliant"):
        write_json(path, {"x": float("nan")})
    with pytest.raises(TypeError):
        write_atomically(path, 3)
    assert json.loads(path.read_text(encoding="utf-8")) == {"π": [1.0]}


def test_a_cause_of_the_whole_robot_comes_back_as_one():
    (tilt,) = (e for e in CATALOGUE if e.name == "gravity_tilt")
    model = mujoco.MjModel.from_xml_string(pendulum())
    own = tilt.parameters(model, JointAddress.of(model, ("pendulum",)), 0)
    values = np.linspace(0.01, 0.02, len(own))
    one = Simulation(model, ("pendulum",), Hypothesis((Candidate(tilt, 0, None, own),)), values)
    back = Simulation.from_json(json.loads(json.dumps(one.to_json())), model)
    (term,) = back.hypothesis.terms
    assert (term.joint, term.joint_name) == (0, None)
    np.testing.assert_allclose(back.values, values)


GENERAL = '<general joint="pendulum" {}/>'
CORD = '<tendon><fixed name="cord"><joint joint="pendulum" coef="1"/></fixed></tendon>'


def driven(actuators: str, joint: str = "", more: str = "") -> str:
    """The pendulum with other actuators."""
    return (
        pendulum(joint=joint).replace('<motor joint="pendulum"/>', actuators).replace("<actuator>", more + "<actuator>")
    )


@pytest.mark.parametrize(
    ("actuator", "joint", "terms", "numbers"),
    [
        # what is there is scaled and shifted, not replaced
        (GENERAL.format('gainprm="3"'), "", {"torque_scale": [1.2]}, {"gainprm": 3.6}),
        (GENERAL.format('gainprm="6" biastype="affine" biasprm="0.5 -6 -0.4" gear="2"'), "",
         {"torque_offset": [-0.1]}, {"biasprm": [0.45, -6.0, -0.4]}),
        # logged gains are of the joint, and those of a servo behind a gear are not
        ('<position joint="pendulum" kp="6" kv="0.4" gear="2"/>', "", {"gain_mismatch": [2.0, 3.0]},
         {"gainprm": 12.0, "biasprm": [0.0, -12.0, -1.2]}),
        # a motor that turns the other way has its range the other way round
        ('<motor joint="pendulum" gear="-2"/>', 'actuatorfrcrange="-0.6 0.4"', {"hysteresis": [0.1, 0.05]},
         {"forcerange": [-0.2, 0.3]}),
        ('<motor joint="pendulum" gear="2" forcerange="-0.1 0.9"/>', 'actuatorfrcrange="-0.6 0.4"',
         {"hysteresis": [0.1, 0.05]}, {"forcerange": [-0.1, 0.2]}),
        (GENERAL.format('gainprm="-2" ctrlrange="-1 0.5"'), "", {"torque_scale": [1.5]}, {"forcerange": [-1.0, 2.0]}),
        ('<motor joint="pendulum" ctrlrange="-1 1" forcerange="-0.5 3"/>', "", {"torque_offset": [0.1]},
         {"forcerange": [-0.5, 1.0]}),
        ('<motor joint="pendulum" ctrllimited="false" ctrlrange="-1 1"/>', "", {"torque_scale": [1.5]},
         {"forcelimited": 0, "gainprm": 1.5}),
        # a delay is held in as many samples as it begins
        ('<motor joint="pendulum"/>', "", {"actuation_delay": [0.0205]}, {"history": 11, "delay": 0.0205}),
        ('<motor joint="pendulum"/>', "", {"actuation_lag": [0.03]}, {"dynprm": 0.03, "dyntype": "filterexact"}),
    ],
)  # fmt: skip
def test_an_actuator_keeps_what_it_had_beside_what_is_corrected(actuator, joint, terms, numbers):
    given = driven(actuator, joint)
    result = written(given, corrected(terms, xml=given), "torques", gains={"pendulum": (10.0, 0.1)})
    assert result.left_out == ()
    model = mujoco.MjModel.from_xml_string(result.xml)
    for name, expected in numbers.items():
        found = getattr(model, f"actuator_{name}")[0]
        if name == "history":
            found = found[0]
        if name == "dyntype":
            assert found == mujoco.mjtDyn.mjDYN_FILTEREXACT
        else:
            assert np.ravel(found)[: np.size(expected)] == pytest.approx(np.ravel(expected)), name


@pytest.mark.parametrize(
    ("actuators", "joint", "more", "terms", "said"),
    [
        # a range that does not act limits nothing
        ('<motor joint="pendulum"/>' * 2, 'actuatorfrclimited="false" actuatorfrcrange="-1 1"', "", "hysteresis", True),
        # a range that must not limit friction cannot be the motor's where it limits something else, too
        ('<motor joint="pendulum"/>', 'actuatorfrcrange="-1 1" actuatorgravcomp="true"', "", "hysteresis", False),
        ('<motor joint="pendulum"/><motor tendon="cord"/>', 'actuatorfrcrange="-1 1"', CORD, "hysteresis", False),
        ('<motor joint="pendulum" gear="0"/>', 'actuatorfrcrange="-1 1"', "", "hysteresis", False),
        ('<motor joint="pendulum" forcerange="2 3"/>', 'actuatorfrcrange="-1 1"', "", "hysteresis", False),
        # nor can the joint's be the motor's where others act beside it
        ('<motor joint="pendulum" forcerange="-1 1"/><motor joint="pendulum" forcerange="-1 1"/>', "", "",
         "torque_ripple", False),
        ('<motor joint="pendulum" forcerange="-1 1"/><motor tendon="cord"/>', "", CORD, "torque_ripple", False),
        ('<motor joint="pendulum"/>' * 2, "", "", "torque_ripple", True),
        # which comes first, ripple or limit, no range says
        ('<motor joint="pendulum"/>', "", "", "torque_ripple torque_saturation", False),
        # what is neither a motor nor a servo
        (GENERAL.format('dyntype="integrator" actrange="-1 1"'), "", "", "torque_scale", False),
        (GENERAL.format('biastype="affine" biasprm="0 0 -1"'), "", "", "torque_scale", False),
        (GENERAL.format('gear="0"'), "", "", "torque_scale", False),
        (GENERAL.format('gaintype="affine" gainprm="1 0.5 0"'), "", "", "torque_scale", False),
        # of a range nothing may be left
        ('<motor joint="pendulum"/>', 'actuatorfrcrange="2 3"', "", "torque_saturation", False),
        (GENERAL.format('gainprm="6" biastype="affine" biasprm="0 -5 -0.4"'), "", "", "gain_mismatch", False),
    ],
)  # fmt: skip
def test_what_a_range_or_an_actuator_cannot_say_stays_in_json(actuators, joint, more, terms, said):
    given = driven(actuators, joint, more)
    names = terms.split()
    result = written(given, corrected({name: MEMORY_TERMS[name] for name in names}, xml=given), "torques")
    assert (f"{names[0]} of pendulum" not in result.left_out) is said
    assert bool(result.warning) is bool(result.left_out)


def test_two_dashes_in_a_name_do_not_end_the_comment_that_names_it():
    given = pendulum(name="a--b")
    xml = written(given, corrected({"encoder_scale": [1.05]}, name="a--b", xml=given)).xml
    assert mujoco.MjModel.from_xml_string(xml).joint(0).name == "a--b"
    assert "encoder_scale of a- -b" in xml


def test_a_drive_is_corrected_at_its_own_joint_alone():
    motors = '</worldbody><actuator><motor joint="upper"/><motor joint="lower"/></actuator>'
    given, names, scale = double_pendulum().replace("</worldbody>", motors), ("upper", "lower"), EFFECTS["torque_scale"]
    model = mujoco.MjModel.from_xml_string(given)
    law = Candidate(scale, 1, "lower", scale.parameters(model, JointAddress.of(model, names), 1))
    result = written(given, Simulation(model, names, Hypothesis((law,)), np.array([1.2])), "torques")
    assert result.left_out == ()
    assert mujoco.MjModel.from_xml_string(result.xml).actuator_gainprm[:, 0] == pytest.approx([1.0, 1.2])


def test_behind_a_gear_the_motors_range_limits_its_ripple_and_not_the_links_friction():
    given = driven('<motor joint="pendulum" forcerange="-1 1"/>')
    names = ("hysteresis", "torque_ripple", "compliance")
    result = written(given, corrected({name: MEMORY_TERMS[name] for name in names}, xml=given), "torques")
    assert result.left_out == ()
    model = mujoco.MjModel.from_xml_string(result.xml)
    assert model.jnt_actfrcrange[model.joint("pendulum").id] == pytest.approx([-1.0, 1.0])
    assert not model.jnt_actfrclimited[model.joint("pendulum_link").id]
    acts_at = {name: model.joint(model.actuator(f"pendulum_{name}").trnid[0]).name for name in ("hysteresis", "ripple")}
    assert acts_at == {"hysteresis": "pendulum_link", "ripple": "pendulum"}


@pytest.mark.parametrize("name", [*DRIVE, *PASSIVE, "compliance", "link_mass", "encoder_scale"])
def test_a_file_does_not_tell_whether_a_number_was_named_or_trimmed(name):
    given, numbers = driven(MOTOR), (NATIVE_TERMS | MEMORY_TERMS)[name]
    named, trimmed = corrected({name: numbers}, xml=given), corrected({}, {name: numbers}, xml=given)
    assert written(given, trimmed, "torques") == written(given, named, "torques")


CRANE = """<mujoco><option timestep="0.002"/><worldbody>
  <body><joint name="rail" type="slide" axis="1 0 0"/><geom size="0.1" mass="2"/>
    <body pos="0 0 -0.1"><joint name="arm" axis="0 1 0"/><geom size="0.05" pos="0 0 -0.4" mass="0.5"/></body>
  </body></worldbody><actuator>{}</actuator></mujoco>"""
CRANE_MOTORS = '<motor name="r" joint="rail" {}/><motor name="a" joint="arm" {}/>'


@pytest.mark.parametrize(
    ("actuators", "effect", "rail", "arm", "found"),
    [
        ('forcerange="-1 3"', "torque_ripple", [0.1, 0.0, 5.0], [0.0, 0.2, 7.0],
         {("jnt_actfrcrange", "rail"): [-1.0, 3.0], ("jnt_actfrcrange", "arm"): [-2.0, 4.0],
          ("actuator_forcelimited", "r"): [0], ("actuator_forcelimited", "a"): [0],
          ("actuator_biasprm", "rail_ripple"): [0.1, 10 * np.pi], ("actuator_biasprm", "arm_ripple"): [0.2, 7.0]}),
        ("", "torque_scale", [1.2], [0.8], {("actuator_gainprm", "r"): [1.2], ("actuator_gainprm", "a"): [0.8]}),
        ("", "hysteresis", [0.3, 0.05], [0.1, 0.02], {}),
        ("", "torque_saturation", [3.0], [2.0], {("jnt_actfrcrange", "rail"): [-3.0, 3.0]}),
        ("", "compliance", [400.0, 2.0], [40.0, 0.1], {}),
        ("servo", "gain_mismatch", [2.0, 3.0], [0.5, 4.0],
         {("actuator_gainprm", "r"): [20.0], ("actuator_biasprm", "r"): [0.0, -20.0, -3.0],
          ("actuator_gainprm", "a"): [4.0], ("actuator_biasprm", "a"): [0.0, -4.0, -2.0]}),
    ],
)  # fmt: skip
def test_each_joint_gets_its_own_numbers_in_whatever_order_the_joints_are_named(actuators, effect, rail, arm, found):
    """A rail and a hinge, whose ripples are counted by the metre and by the turn."""
    motors = CRANE_MOTORS.format(actuators, actuators.replace("-1 3", "-2 4"))
    if actuators == "servo":
        motors = CRANE_MOTORS.format('kp="9"', 'kp="9"').replace("motor", "position")
    given, numbers, models = CRANE.format(motors), {"rail": rail, "arm": arm}, []
    plain = mujoco.MjModel.from_xml_string(given)
    for names in (("rail", "arm"), ("arm", "rail")):
        address = JointAddress.of(plain, names)
        law = EFFECTS[effect]
        terms = tuple(Candidate(law, j, n, law.parameters(plain, address, j)) for j, n in enumerate(names))
        simulation = Simulation(plain, names, Hypothesis(terms), np.array([v for n in names for v in numbers[n]]))
        result = written(
            given, simulation, "targets" if actuators else "torques", gains={"rail": (10.0, 1.0), "arm": (8.0, 0.5)}
        )
        assert result.left_out == ()
        models.append(mujoco.MjModel.from_xml_string(result.xml))
    one, other = models
    for kind, count in (("actuator", one.nu), ("jnt", one.njnt), ("tendon", one.ntendon), ("eq", one.neq)):
        named = {"jnt": "joint", "eq": "equality"}.get(kind, kind)
        fields = [n for n in dir(one) if n.startswith(f"{kind}_") and isinstance(getattr(one, n), np.ndarray)]
        numeric = [n for n in fields if not n.endswith(("adr", "id", "_bodyid", "num", "plugin"))]
        for at, name in ((i, getattr(one, named)(i).name) for i in range(count)):
            for field in numeric:
                mine, its = getattr(one, field)[at], getattr(other, field)[getattr(other, named)(name).id]
                np.testing.assert_allclose(its, mine, rtol=1e-5, atol=1e-8, err_msg=f"{field} of {name}")
    for (field, name), expected in found.items():
        at = getattr(one, "joint" if field.startswith("jnt") else "actuator")(name).id
        assert np.ravel(getattr(one, field)[at])[: len(expected)] == pytest.approx(expected), field
