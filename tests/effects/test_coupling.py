"""A drive that two joints turn: MuJoCo's own fixed tendon is the oracle."""

import mujoco
import numpy as np
import pytest
from effects.arm import ARM, JOINTS, address, arm, record

from torchrl_athletic.diagnosis.replay import simulate, take_of, windows_of
from torchrl_athletic.effects import CoupledDrive, JointAddress, project_recording
from torchrl_athletic.effects.coupling import joint_before

DRIVE = CoupledDrive()
ELBOW = 1


def with_tendon(values) -> mujoco.MjModel:
    """The arm with the drive as ``corrected.xml`` says it."""
    spec = mujoco.MjSpec.from_string(ARM)
    assert DRIVE.write(spec, "elbow", np.array(values))
    return spec.compile()


def moved(found, without) -> np.ndarray:
    return np.abs(found.position - without.position).max(0)


@pytest.mark.parametrize(
    ("values", "off"),
    [
        ([0.0, 0.1, 0.0, -1.0], 0.03),
        ([0.0, 0.0, 0.01, 1.0], 0.01),
        ([0.1, 0.0, 0.0, -1.0], 0.03),
        ([0.1, 0.1, 0.01, -0.5], 0.02),
    ],
)
@pytest.mark.parametrize("targets", [False, True])
def test_it_moves_the_arm_as_a_tendon_of_mujoco_does(values, off, targets):
    truth = record(model=with_tendon(values), position_control=targets)
    ours, none = record(DRIVE, ELBOW, values, position_control=targets), record(position_control=targets)
    assert (moved(none, truth) > 0.002).all()
    assert (moved(ours, truth) < off * moved(none, truth)).all()


@pytest.mark.parametrize("ratio", [1.0, -1.0])
@pytest.mark.parametrize(("values", "off"), [([0.1, 0.0, 0.0], 0.3), ([0.0, 0.1, 0.0], 0.03), ([0.0, 0.0, 0.01], 0.03)])
def test_its_fingerprint_is_what_a_tendon_of_mujoco_lacks(values, off, ratio):
    s = project_recording(record(model=with_tendon([*values, ratio])), arm(), np.full(2, 1e-9))
    predicted = DRIVE.fingerprint(s, ELBOW, {"ratio": ratio}).columns @ np.array(values)
    for joint in range(2):
        good = s.valid[:, joint]
        left = s.missing[good, joint] - predicted[good, joint]
        assert np.sqrt(np.mean(left**2)) < off * np.sqrt(np.mean(predicted[good, joint] ** 2))


def test_without_friction_and_rotor_nothing_changes():
    assert (record(DRIVE, ELBOW, [0.0, 0.0, 0.0, 1.0]).position == record().position).all()


def test_a_ratio_of_nothing_is_the_joints_own_damping_and_rotor():
    values = [0.0, 0.15, 0.02, 0.0]
    spec = mujoco.MjSpec.from_string(ARM)
    spec.joint("elbow").damping[0] += values[1]
    spec.joint("elbow").armature += values[2]
    own = record(model=spec.compile())
    assert (moved(record(DRIVE, ELBOW, values), own) < 0.01 * moved(record(), own)).all()


def test_rows_do_not_look_at_each_other():
    told = record()
    take = take_of(told, arm(), np.zeros(2))
    sets = np.array([[0.1, 0.0, 0.0, 1.0], [0.05, 0.1, 0.01, -0.5], [0.0, 0.0, 0.0, 1.0]])

    def build(plant, rows):
        DRIVE.apply(plant, ELBOW, rows)

    together = simulate(windows_of(take, 0.5), build, sets)
    for k, one in enumerate(sets):
        assert np.allclose(simulate(windows_of(take, 0.5), build, one[None])[0], together[k], rtol=0, atol=1e-12)


def test_the_first_joint_has_no_drive_that_another_turns_and_slides_have_none():
    assert not DRIVE.parameters(arm(), address(), 0)
    for kinds in (("slide", "hinge"), ("hinge", "slide")):
        model = mujoco.MjModel.from_xml_string(ARM.replace('name="shoulder"', f'name="shoulder" type="{kinds[0]}"')
            .replace('name="elbow"', f'name="elbow" type="{kinds[1]}"'))  # fmt: skip
        assert not DRIVE.parameters(model, JointAddress.of(model, JOINTS), ELBOW)


def test_the_joint_before_is_the_next_on_the_way_to_the_base_and_one_that_was_recorded():
    model = mujoco.MjModel.from_xml_string("""
    <mujoco><worldbody>
      <body><joint name="a"/><joint name="b" axis="0 1 0"/><inertial pos="0 0 0" mass="1" diaginertia="1 1 1"/>
        <body><joint name="c"/><inertial pos="0 0 0" mass="1" diaginertia="1 1 1"/>
          <body><joint name="d"/><inertial pos="0 0 0" mass="1" diaginertia="1 1 1"/></body></body>
        <body><joint name="e"/><inertial pos="0 0 0" mass="1" diaginertia="1 1 1"/></body></body>
    </worldbody></mujoco>""")
    names = ("e", "d", "c", "b", "a")
    every = JointAddress.of(model, names, "chain")
    before = {n: joint_before(model, every, j) for j, n in enumerate(names)}
    assert {n: None if b is None else names[b] for n, b in before.items()} == {
        "a": None,
        "b": "a",
        "c": "b",
        "d": "c",
        "e": "b",
    }


def test_what_turns_with_its_own_joint_alone_is_no_coupled_drive():
    own = DRIVE.parameters(arm(), address(), ELBOW)
    assert DRIVE.is_physical(own, np.array([0.1, 0.0, 0.0, 1.0]))
    assert not DRIVE.is_physical(own, np.array([0.1, 0.1, 0.01, 0.05]))
    assert not DRIVE.is_physical(own, np.array([0.0, 0.0, 0.0, 1.0]))


def test_the_sentence_says_all_four_numbers():
    own = DRIVE.parameters(arm(), address(), ELBOW)
    said = DRIVE.sentence(JOINTS[ELBOW], {"torque": 1.95, "damping": 0.616, "armature": 0.0096, "ratio": 1.0}, own)
    assert all(text in said for text in ("elbow", "1.95 N·m", "0.616 N·m·s/rad", "0.0096 kg·m²", "1 times as far"))


@pytest.mark.parametrize(("damping", "rotor"), [(0.5, 0.01), (2.0, 0.01), (0.0, 1.0), (2.0, 1.0)])
@pytest.mark.parametrize("ratio", [1.0, -1.0])
def test_it_stays_stable_however_light_the_links_are_beside_its_rotor(damping, rotor, ratio):
    light = ARM.replace('armature="0.02"', "").replace('armature="0.005"', "").replace('mass="0.8"', 'mass="0.01"')
    light = light.replace('diaginertia="0.008 0.007 0.002"', 'diaginertia="1e-4 1e-4 1e-5"')
    given = mujoco.MjModel.from_xml_string(light)
    assert np.abs(record(DRIVE, ELBOW, [0.0, damping, rotor, ratio], model=given).position).max() < 100.0


def test_a_tendon_of_the_same_name_stays_the_users():
    spec = mujoco.MjSpec.from_string(ARM)
    spec.add_tendon(name="elbow_drive").wrap_joint("elbow", 1.0)
    assert not DRIVE.write(spec, "elbow", np.array([0.1, 0.1, 0.01, 1.0]))
    assert len(list(spec.tendons)) == 1
