"""Soft gears and play in MJCF: the closed form of two inertias, and the diagnosis' own simulation."""

from itertools import pairwise

import mujoco
import numpy as np
import pytest
from diagnosis.plants import pendulum, record, slider, smooth_torque
from diagnosis.test_corrected import EFFECTS, MOTOR, corrected
from torchrl.envs import TransformedEnv

from torchrl_athletic.diagnosis import corrected_gears
from torchrl_athletic.diagnosis.corrected import Simulation
from torchrl_athletic.diagnosis.corrected_xml import corrected_xml
from torchrl_athletic.diagnosis.fit import Hypothesis
from torchrl_athletic.diagnosis.screen import Candidate
from torchrl_athletic.effects import JointAddress
from torchrl_athletic.effects.gear import ROTOR_FLOOR
from torchrl_athletic.envs import TorqueEnv
from torchrl_athletic.robots import from_mjcf
from torchrl_athletic.transforms import CorrectedActuation

ROTOR, LINK = 0.5, 2.0
"""Masses of a slider without gravity [kg]."""


def geared_slider(terms, step=0.002, joint=""):
    given = slider(step, f'armature="{ROTOR}" {joint}')
    return mujoco.MjModel.from_xml_string(corrected_xml(given, corrected(terms, name="carriage", xml=given)))


def moved(model, motor, seconds, start=None, force=0.0):
    """Motor's and link's positions and velocities from a start, under a constant force. Shape (T, 4)."""
    data = mujoco.MjData(model)
    at = [model.joint(name).qposadr[0] for name in (motor, f"{motor}_link")]
    if start is not None:
        data.qpos[at], data.qvel[at] = start[:2], start[2:]
    data.ctrl[:] = force
    out = []
    for _ in range(round(seconds / model.opt.timestep)):
        mujoco.mj_step(model, data)
        out.append([*data.qpos[at], *data.qvel[at]])
    return np.array(out)


@pytest.mark.parametrize("step", [0.0005, 0.002, 0.005])
@pytest.mark.parametrize("frequency", [3.0, 12.0, 30.0])
def test_two_inertias_ring_as_their_closed_form_says_at_any_time_step(step, frequency):
    reduced = 1 / (1 / ROTOR + 1 / LINK)
    stiffness = reduced * (2 * np.pi * frequency) ** 2
    damping = 2 * 0.05 * np.sqrt(stiffness * reduced)
    model = geared_slider({"compliance": [stiffness, damping]}, step)
    path = moved(model, "carriage", 12 / frequency, (0.01, 0.0, 0.0, 0.0))
    bent = path[:, 0] - path[:, 1]
    crossings = np.flatnonzero(np.diff(np.sign(bent)))
    between = crossings + bent[crossings] / (bent[crossings] - bent[crossings + 1])
    half_periods = np.diff(between) * step
    assert 1 / (2 * half_periods.mean()) == pytest.approx(frequency * np.sqrt(1 - 0.05**2), rel=0.02)
    decay = np.exp(-0.05 * 2 * np.pi * frequency * 4 / frequency)  # of four periods
    peaks = [np.abs(bent[a:b]).max() for a, b in pairwise(crossings)]
    assert peaks[8] / peaks[0] == pytest.approx(decay, rel=0.15)


def test_a_constant_force_bends_the_gear_by_its_share_and_moves_both_as_one():
    model = geared_slider({"compliance": [400.0, 20.0]})
    path = moved(model, "carriage", 3.0, force=5.0)
    assert path[-1, 2:] == pytest.approx([3.0 * 5.0 / (ROTOR + LINK)] * 2, rel=1e-3)
    assert path[-1, 0] - path[-1, 1] == pytest.approx(5.0 * LINK / (ROTOR + LINK) / 400.0, rel=1e-3)


def test_teeth_push_and_never_pull_and_pass_all_momentum_on():
    gap = 0.004
    model = geared_slider({"backlash": [gap, 2e4]}, 0.0005)
    path = moved(model, "carriage", 2.0, (0.0, 0.0, 0.1, 0.0))
    momentum = path[:, 2] * ROTOR + path[:, 3] * LINK
    np.testing.assert_allclose(momentum, 0.1 * ROTOR, rtol=1e-5)
    bent = path[:, 0] - path[:, 1]
    apart = np.abs(bent[:-1]) < gap / 2 - 1e-4
    rates = path[:, 2] - path[:, 3]
    free = np.diff(rates)[apart]
    assert np.abs(free).max() < 1e-9  # nothing acts between the teeth
    energy = path[:, 2] ** 2 * ROTOR / 2 + path[:, 3] ** 2 * LINK / 2
    assert energy.max() <= ROTOR * 0.1**2 / 2 * (1 + 1e-9)
    assert np.abs(bent).max() < gap / 2 + 1e-3
    assert bent.max() >= gap / 2  # they met on either side
    assert bent.min() <= -gap / 2


@pytest.mark.parametrize("step", [0.002, 0.01])
def test_teeth_of_any_stiffness_stay_calm_at_a_coarse_step(step):
    model = geared_slider({"backlash": [0.002, 7e5]}, step)
    path = moved(model, "carriage", 2.0, force=3.0)
    assert np.isfinite(path).all()
    assert np.abs(path[:, 0] - path[:, 1]).max() < 0.001 + 2e-3
    assert path[-1, 2:] == pytest.approx([2.0 * 3.0 / (ROTOR + LINK)] * 2, rel=0.02)


@pytest.mark.parametrize("joint", ['damping="0.05"', 'damping="0.05" armature="0.01"'])
@pytest.mark.parametrize(
    ("terms", "tooth"),
    [
        ({"compliance": [40.0, 0.1]}, 0.0),
        ({"compliance": [8.0, 0.02]}, 0.0),
        ({"backlash": [0.03, 60.0]}, 0.015),  # the teeth on which the replay finds the link at the start
        ({"compliance": [8.0, 0.02], "coulomb_friction": [0.05, 0.0], "reflected_inertia": [0.02]}, 0.0),
        ({"compliance": [8.0, 0.02], "torque_ripple": [0.05, 0.02, 7.3], "torque_scale": [1.2]}, 0.0),
        ({"compliance": [8.0, 0.02], "hysteresis": [0.1, 0.05], "actuation_lag": [0.02]}, 0.0),
    ],
    ids=lambda x: "-".join(x) if isinstance(x, dict) else "",
)
def test_the_motor_moves_as_the_encoder_reads_in_the_diagnosis_own_simulation(joint, terms, tooth):
    given = pendulum(0.0005, joint).replace('<motor joint="pendulum"/>', MOTOR)
    simulation = corrected(terms, xml=given)
    xml = corrected_xml(given, simulation, "torques")
    assert "not expressed" not in xml
    model = mujoco.MjModel.from_xml_string(xml)
    assert (model.nu, model.nv) == (1, 2)
    torque = smooth_torque(3.0)
    torque[:10] = 0.0
    r = record(given, torque, noise=0.0)
    data, read = mujoco.MjData(model), []
    motor, link = (model.joint(name).qposadr[0] for name in ("pendulum", "pendulum_link"))
    data.qpos[link] = -tooth
    for u in torque / 2:
        read.append(data.qpos[motor].copy())
        for _ in range(20):
            data.ctrl[:] = u
            mujoco.mj_step(model, data)
    replayed = simulation.rollout(r, None)
    np.testing.assert_allclose(np.array(read)[:, None], replayed, rtol=0, atol=2e-3)
    assert np.abs(replayed - corrected({}, xml=given).rollout(r, None)).max() > 8e-3


ARM = """
<mujoco><compiler angle="radian"/><option timestep="0.002"/>
  <default><joint damping="0.3" armature="0.02" frictionloss="0.1" stiffness="1"/>
    <tendon stiffness="5" damping="2" margin="0.05" armature="5"/></default>
  <worldbody><body name="base" pos="0 0 1"><freejoint/><geom size=".1"/>
    <body name="link" pos="0 0 .1" euler="0.3 0 0"><joint name="pendulum" axis="0 1 0" range="-1 1" ref="0.2"
      actuatorfrcrange="-4 4"/><geom type="capsule" size=".02" fromto="0 0 0 0 0 .4"/>
      <body name="tip" pos="0 0 .4"><joint name="tip" axis="0 1 0"/><geom size=".05"/></body></body>
    <body name="tail" pos="0 0 -.1"><joint name="tail" type="slide"/><geom size=".05"/></body></body></worldbody>
  <actuator><position name="servo" joint="pendulum" kp="20"/><motor joint="tip"/></actuator>
  <sensor><jointpos name="encoder" joint="pendulum"/><jointlimitfrc name="end" joint="pendulum"/></sensor>
  <keyframe><key name="up" qpos="1 2 3 1 0 0 0 0.5 0.7 0.1" qvel="1 2 3 4 5 6 7 8 9" ctrl="0.1 0.2"/>
    <key name="empty"/></keyframe>
</mujoco>"""


def parted_arm(xml=ARM):
    """With a soft gear at the second of three joints, beneath a free base."""
    model, names = mujoco.MjModel.from_xml_string(xml), ("tip", "pendulum", "tail")
    soft = EFFECTS["compliance"]
    gear = Candidate(soft, 1, "pendulum", soft.parameters(model, JointAddress.of(model, names), 1))
    return corrected_xml(xml, Simulation(model, names, Hypothesis((gear,)), np.array([30.0, 0.1])))


def test_the_motor_takes_the_drive_and_the_link_keeps_the_rest():
    model = mujoco.MjModel.from_xml_string(parted_arm())
    motor, link = model.joint("pendulum"), model.joint("pendulum_link")
    parts = ("armature", "frictionloss")
    assert [getattr(motor, name)[0] for name in parts] == pytest.approx([0.02, 0.0])
    assert [getattr(link, name)[0] for name in parts] == pytest.approx([0.0, 0.1])
    assert (np.ravel(motor.damping)[0], np.ravel(link.damping)[0]) == pytest.approx((0.0, 0.3))
    assert (np.ravel(motor.stiffness)[0], np.ravel(link.stiffness)[0]) == pytest.approx((0.0, 1.0))
    limited = model.jnt_limited, model.jnt_actfrclimited
    assert [[bool(flags[j.id]) for j in (motor, link)] for flags in limited] == [[False, True], [True, False]]
    assert model.jnt_actfrcrange[motor.id] == pytest.approx([-4, 4])
    assert model.actuator("servo").trnid[0] == motor.id
    assert (model.sensor("encoder").objid[0], model.sensor("end").objid[0]) == (motor.id, link.id)
    assert model.nu == 2
    of_tendon = (model.tendon_stiffness, model.tendon_damping, model.tendon_margin, model.tendon_armature)
    assert [float(np.ravel(x)[0]) for x in of_tendon] == [0.0] * 4
    assert from_mjcf(parted_arm(), torque_limit=9.0).position_limit[0] == pytest.approx((-1.0, 1.0))
    np.testing.assert_allclose(model.qpos0[[motor.qposadr[0], link.qposadr[0]]], 0.2)
    free = mujoco.MjModel.from_xml_string(
        parted_arm(ARM.replace("actuatorfrcr", 'actuatorfrclimited="false" actuatorfrcr'))
    )
    assert not free.jnt_actfrclimited.any()  # a range that does not act does not begin to


def test_keyframes_start_the_motor_where_the_link_is_and_keep_all_else():
    before, after = (mujoco.MjModel.from_xml_string(x) for x in (ARM, parted_arm()))
    states = []
    for model in (before, after):
        data = mujoco.MjData(model)
        mujoco.mj_resetDataKeyframe(model, data, model.key("up").id)
        mujoco.mj_forward(model, data)
        states.append(data)
    for name in ("base", "link", "tip", "tail"):
        np.testing.assert_allclose(states[1].body(name).xpos, states[0].body(name).xpos, atol=1e-5)
        np.testing.assert_allclose(states[1].body(name).xquat, states[0].body(name).xquat, atol=1e-5)
        np.testing.assert_allclose(states[1].body(name).cvel, states[0].body(name).cvel, atol=1e-4)
    assert states[1].joint("pendulum").qpos == pytest.approx([0.5])
    assert states[1].joint("pendulum").qvel == states[0].joint("pendulum").qvel
    np.testing.assert_array_equal(states[1].ctrl, states[0].ctrl)
    np.testing.assert_allclose(after.key("empty").qpos, after.qpos0)


def test_the_motor_turns_about_the_links_own_hinge_and_sensors_of_other_joints_stay_theirs():
    """Wherever the hinge is in its link, and the link on its parent."""
    given = ARM.replace('axis="0 1 0" range', 'axis="0.6 0.8 0" pos=".03 -.02 .05" range')
    given = given.replace('name="tip" axis', 'name="tip" range="-2 2" axis')
    stays = "jointlimitpos", "jointlimitvel", "jointlimitfrc"
    ends = "".join(f'<{kind} name="{kind}" joint="pendulum"/>' for kind in stays)
    given = given.replace("<sensor>", f'<sensor><jointlimitfrc name="stop" joint="tip"/>{ends}')
    model = mujoco.MjModel.from_xml_string(parted_arm(given))
    data = mujoco.MjData(model)
    for j in range(model.njnt):
        if model.jnt_type[j] == mujoco.mjtJoint.mjJNT_FREE:
            data.qpos[model.jnt_qposadr[j] :][:7] = 1.0, 2.0, 3.0, 0.5, -0.5, 0.5, 0.5
    mujoco.mj_kinematics(model, data)
    motor, link = (model.joint(name).id for name in ("pendulum", "pendulum_link"))
    np.testing.assert_allclose(data.xanchor[motor], data.xanchor[link], atol=1e-6)
    np.testing.assert_allclose(data.xaxis[motor], data.xaxis[link], atol=1e-6)
    assert model.sensor("stop").objid[0] == model.joint("tip").id
    assert [model.sensor(kind).objid[0] for kind in stays] == [link] * 3


@pytest.mark.parametrize(
    "more",
    [
        '<equality><joint joint1="pendulum" joint2="tip"/></equality>',
        '<equality><joint joint1="tip" joint2="pendulum"/></equality>',
        '<tendon><fixed name="cable"><joint joint="pendulum" coef="1"/></fixed></tendon>',
        '<tendon><fixed name="pendulum_gear"><joint joint="tip" coef="1"/></fixed></tendon>',
        '<equality><joint name="pendulum_gear" joint1="tip" joint2="tail"/></equality>',
        '<worldbody><body name="pendulum_motor"><geom size="0.1"/></body></worldbody>',
        '<option><flag equality="disable"/></option>',
        '<option><flag limit="disable"/></option>',
        '<option><flag constraint="disable"/></option>',
        'actuatorgravcomp="true"',
    ],
)
def test_a_gear_stays_in_json_where_the_joint_is_coupled_or_nothing_could_couple_it(more):
    given = ARM.replace("</mujoco>", more + "</mujoco>")
    if "=" in more and "<" not in more:
        given = ARM.replace('<joint name="pendulum"', f'<joint name="pendulum" {more}')
    xml = parted_arm(given)
    assert "not expressed here, see corrected.json: compliance of pendulum" in xml
    assert mujoco.MjModel.from_xml_string(xml).nv == mujoco.MjModel.from_xml_string(given).nv
    assert "its link" not in xml


def test_what_holds_a_body_or_a_site_of_the_joints_number_does_not_couple_the_joint():
    model = mujoco.MjModel.from_xml_string(ARM)
    body = model.body(model.joint("pendulum").id).name
    held = f'<equality><connect body1="{body}" anchor="0 0 0" active="false"/></equality></mujoco>'
    sites = "".join(f'<site name="{name}" pos="0 0 {name}"/>' for name in range(model.njnt))
    cord = '<tendon><spatial name="cord"><site site="0"/><site site="1"/></spatial></tendon></mujoco>'
    strung = ARM.replace('<body name="tail"', sites + '<body name="tail"').replace("</mujoco>", cord)
    for given in (ARM.replace("</mujoco>", held), strung):
        assert mujoco.MjModel.from_xml_string(parted_arm(given)).nv == model.nv + 1


def test_two_gears_of_one_joint_stay_in_json():
    given = pendulum()
    xml = corrected_xml(given, corrected({"compliance": [40.0, 0.1], "backlash": [0.03, 60.0]}, xml=given))
    assert mujoco.MjModel.from_xml_string(xml).nv == 1
    assert "compliance of pendulum, backlash of pendulum" in xml


def test_a_chain_that_acts_the_drive_out_gets_no_gear():
    given = pendulum()
    xml = corrected_xml(given, corrected({"compliance": [30.0, 0.1]}, xml=given), drive=False)
    assert mujoco.MjModel.from_xml_string(xml).nv == 1
    assert "compliance of pendulum" in xml


def test_the_rest_of_a_correction_acts_in_the_chain_beside_a_gear_that_the_model_has():
    given = pendulum(joint='damping="0.05" armature="0.01"')
    rest = {
        "viscous_friction": [0.2],
        "coulomb_friction": [0.05, 0.0],
        "joint_spring": [0.3, 0.0],
        "torque_offset": [0.1],
    }
    simulation = corrected({**rest, "compliance": [40.0, 0.1]}, xml=given)
    content = simulation.to_json()
    content["effects"] = [entry for entry in content["effects"] if entry["effect"] != "compliance"]
    robot = from_mjcf(corrected_xml(given, simulation), torque_limit=5.0)
    chain = CorrectedActuation(content, timestep=0.002, joint_names=robot.joint_names)
    env = TransformedEnv(TorqueEnv(robot), chain)
    td = env.rand_action(env.reset())
    for _ in range(3000):
        td = env.step_mdp(env.step(td.set("torque", td["torque"] * 0)))
    at_rest = td["joint_position"].item()  # 0.1 N·m against weight and spring, within the dry friction
    assert abs(0.5 * 9.81 * 0.4 * np.sin(at_rest) + 0.3 * at_rest - 0.1) < 0.06
    assert abs(td["joint_velocity"].item()) < 1e-2


def test_a_motor_without_a_rotor_gets_a_share_of_its_own_links_inertia():
    """Two carriages beside each other, the second four times as heavy; a rotor that is there stays."""
    body = '<body><joint name="{0}" type="slide" armature="{2}"/><inertial pos="0 0 0" mass="{1}" diaginertia="1 1 1"/>'
    bodies = "".join(body.format(*row) + "</body>" for row in (("a", 2, 0), ("b", 8, 0), ("c", 8, 3)))
    model = mujoco.MjModel.from_xml_string(f"<mujoco><worldbody>{bodies}</worldbody></mujoco>")
    rotors = [corrected_gears._rotor(model, dof) for dof in range(3)]
    assert rotors == pytest.approx([2 * ROTOR_FLOOR, 8 * ROTOR_FLOOR, 3.0])
