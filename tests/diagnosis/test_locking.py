"""Joints that stood still are held where they stood; what speaks of them goes with them."""

import mujoco
import numpy as np
import pytest

from torchrl_athletic.diagnosis import locking
from torchrl_athletic.diagnosis.locking import STILL, locked_joints
from torchrl_athletic.recordings import Recording, RecordingError

ARM = """<mujoco><worldbody><body><joint name="hip" axis="0 1 0"/><geom size="0.1" pos="0.3 0 0"/>
  <body pos="0.5 0 0"><joint name="knee" axis="0 1 0"/><geom size="0.1" pos="0.2 0 0"/></body></body></worldbody>
  <actuator><motor joint="hip"/><motor joint="knee"/></actuator>
  <sensor><jointpos joint="hip"/><jointpos joint="knee"/></sensor>
  <keyframe><key name="home" qpos="0.1 0.2"/></keyframe></mujoco>"""

TURNED = '<body pos="0.5 0 0" quat="0.8 0.2 -0.4 0.4">'

GRIPPER = """<mujoco><worldbody><body name="hand"><joint name="wrist" axis="0 1 0"/><geom size="0.1" pos="0.3 0 0"/>
  <body name="left"><joint name="left" type="slide" axis="0 1 0"/><geom size="0.02"/><site name="left"/></body>
  <body name="right"><joint name="right" type="slide" axis="0 -1 0"/><geom size="0.02"/></body></body></worldbody>
  {}</mujoco>"""
COUPLED = GRIPPER.format(
    """<tendon><fixed name="cord"><joint joint="left" coef="1"/><joint joint="right" coef="1"/></fixed>
    <fixed name="own"><joint joint="wrist" coef="1"/></fixed></tendon>
    <equality><joint joint1="left" joint2="right"/><tendon tendon1="cord"/><joint joint1="wrist"/></equality>
    <actuator><motor name="grip" tendon="cord"/><motor name="left" joint="left"/><motor name="turn" joint="wrist"/>
    <motor name="press" site="left"/></actuator>
    <sensor><tendonpos tendon="cord"/><actuatorfrc actuator="grip"/><jointpos joint="left"/><jointpos joint="wrist"/>
    <tendonpos tendon="own"/><actuatorfrc actuator="turn"/><accelerometer name="felt" site="left"/></sensor>"""
)


def held(angle, travel=0.0, count=100, names=("hip", "knee")):
    time = np.arange(count) / 100
    knee = angle + travel * np.linspace(0, 1, count)
    return Recording(time, names, np.stack([time, knee], 1), torque_command=np.zeros((count, 2)))


def attitude(lock, *recordings):
    """Orientation of the lower link as a quaternion, with the hip at its zero."""
    xml, left = locked_joints(ARM, lock, recordings)
    assert left == ("hip",)
    model = mujoco.MjModel.from_xml_string(xml)
    data = mujoco.MjData(model)
    mujoco.mj_kinematics(model, data)
    return data.xquat[-1]


def test_it_is_held_at_the_median_of_all_recordings_that_have_it_and_else_at_zero():
    several = held(0.69, 0.01), held(0.69, 0.015), held(0.7, count=900)  # the first reading is off
    np.testing.assert_allclose(attitude(("knee",), *several), attitude(("knee=0.7",)), atol=1e-6)
    np.testing.assert_allclose(attitude(("knee",)), attitude(("knee=0",)), atol=1e-6)
    elsewhere = held(0.7, names=("hip", "foot"))
    np.testing.assert_allclose(attitude(("knee",), elsewhere), attitude(("knee=0",)), atol=1e-6)
    np.testing.assert_allclose(attitude(("knee=0.3",), *several), attitude(("knee=0.3",)), atol=1e-6)  # as it is told
    assert np.abs(attitude(("knee=0.7",)) - attitude(("knee=0",))).max() > 0.1


@pytest.mark.parametrize("angle", ["radian", "degree"])
@pytest.mark.parametrize("kind", ["hinge", "slide"])
def test_a_locked_joint_leaves_everything_where_the_joint_would_have_it(kind, angle):
    """The joint's anchor and axis are anything, and so are its body's attitude and its zero."""
    joint = f'<joint name="knee" type="{kind}" axis="1 2 -1" pos="0.1 -0.2 0.3" ref="0.2"/>'
    xml = ARM.replace('<joint name="knee" axis="0 1 0"/>', joint).replace('<body pos="0.5 0 0">', TURNED)
    xml = xml.replace("<mujoco>", f'<mujoco><compiler angle="{angle}"/>')
    free = mujoco.MjModel.from_xml_string(xml)
    moved = mujoco.MjData(free)
    moved.qpos[:] = (0.0, 0.7)
    mujoco.mj_kinematics(free, moved)
    locked = mujoco.MjModel.from_xml_string(locked_joints(xml, ("knee=0.7",), [])[0])
    still = mujoco.MjData(locked)
    mujoco.mj_kinematics(locked, still)
    np.testing.assert_allclose(still.geom_xpos, moved.geom_xpos, atol=1e-6)
    np.testing.assert_allclose(still.geom_xmat, moved.geom_xmat, atol=1e-6)


@pytest.mark.parametrize("lock", [("one",), ("two",), ("three",), ("one", "three"), ("three", "one"), ("three", "two")])
@pytest.mark.parametrize("kinds", [("hinge",) * 3, ("slide", "hinge", "hinge"), ("hinge", "slide", "hinge"),
                                   ("hinge", "hinge", "slide")])  # fmt: skip
def test_joints_of_a_body_that_has_several_move_it_as_before_whichever_of_them_are_locked(kinds, lock):
    """Anchors and axes are anything, none of which may stay behind when the body is turned under it."""
    axes, anchors = ("1 2 -1", "0 1 0.5", "-1 0.2 1"), ("0.1 -0.2 0.3", "0.3 0.1 0", "-0.1 0 0.2")
    zeros = [("one", 0.2), ("two", 0.0), ("three", -0.1)]
    joints = "".join(
        f'<joint name="{name}" type="{kind}" axis="{axis}" pos="{anchor}" ref="{zero}"/>'
        for (name, zero), kind, axis, anchor in zip(zeros, kinds, axes, anchors, strict=True)
    )
    xml = ARM.replace('<joint name="knee" axis="0 1 0"/>', joints).replace('<body pos="0.5 0 0">', TURNED)
    xml = '<mujoco><compiler angle="radian"/>' + xml[len("<mujoco>") : xml.index("<actuator>")] + "</mujoco>"
    places, geoms = {"hip": 0.3, "one": 0.7, "two": -0.4, "three": 0.9}, []
    locked = locked_joints(xml, [f"{name}={places[name]}" for name in lock], [])[0]
    for model in map(mujoco.MjModel.from_xml_string, (xml, locked)):
        data = mujoco.MjData(model)
        data.qpos[:] = [places[model.joint(j).name] for j in range(model.njnt)]
        mujoco.mj_kinematics(model, data)
        geoms.append((data.geom_xpos.copy(), data.geom_xmat.copy()))
    np.testing.assert_allclose(geoms[1][0], geoms[0][0], atol=5e-6)
    np.testing.assert_allclose(geoms[1][1], geoms[0][1], atol=5e-6)


def test_what_moves_no_further_than_backlash_and_noise_stood_still():
    locked_joints(ARM, ("knee",), [held(0.5, 0.99 * STILL)])
    for takes in ([held(0.5, 1.01 * STILL)], [held(0.5), held(0.5 + 1.01 * STILL)]):  # within one take or between two
        with pytest.raises(RecordingError, match=r"knee: it moves by 0\.02"):
            locked_joints(ARM, ("knee",), takes)


def test_motors_and_sensors_of_a_joint_go_with_it_and_those_of_others_stay():
    xml, left = locked_joints(ARM, ("hip=0.2",), [])
    model = mujoco.MjModel.from_xml_string(xml)
    assert left == ("knee",)
    assert (model.njnt, model.nu, model.nsensor, model.nkey) == (1, 1, 1, 0)  # a keyframe has a place for each joint
    assert model.joint(model.actuator_trnid[0, 0]).name == "knee"
    assert model.joint(model.sensor_objid[0]).name == "knee"
    xml, left = locked_joints(ARM, ("hip=0.2", "knee"), [])
    assert left == ()
    assert mujoco.MjModel.from_xml_string(xml).njnt == 0


def test_a_place_that_is_no_number_is_refused():
    with pytest.raises(RecordingError, match=r"--lock knee=left: give a number of rad or m"):
        locked_joints(ARM, ("knee=left",), [])


def test_fingers_that_are_tied_are_locked_with_what_ties_them_and_nothing_else():
    """Of one name are a site, a motor and a joint, and only what speaks of the joint goes."""
    xml, left = locked_joints(COUPLED, ("left", "right"), [])
    model = mujoco.MjModel.from_xml_string(xml)
    assert left == ("wrist",)
    assert [model.tendon(k).name for k in range(model.ntendon)] == ["own"]
    assert [model.actuator(k).name for k in range(model.nu)] == ["turn", "press"]
    assert (model.neq, model.nsensor) == (1, 4)
    assert model.joint(model.eq_obj1id[0]).name == "wrist"


@pytest.mark.parametrize(
    ("tie", "said"),
    [
        ('<equality><joint name="mimic" joint1="left" joint2="right"/></equality>', "equality mimic ties left"),
        ('<equality><joint joint1="right" joint2="left"/></equality>', "equality ties left"),
        ('<tendon><fixed name="cord"><joint joint="left" coef="1"/><joint joint="right" coef="1"/></fixed></tendon>',
         "tendon cord ties left"),
    ],
)  # fmt: skip
def test_half_of_a_pair_that_is_tied_is_refused(tie, said):
    with pytest.raises(RecordingError, match=f"{said}, which is held, to right, which is not. Lock that, too, or take"):
        locked_joints(GRIPPER.format(tie), ("left",), [])
    assert locked_joints(GRIPPER.format(tie), ("left", "right"), [])[1] == ("wrist",)


def test_an_equality_that_does_not_act_ties_nothing():
    idle = GRIPPER.format('<equality><joint joint1="left" joint2="right" active="false"/></equality>')
    assert locked_joints(idle, ("left",), [])[1] == ("wrist", "right")


def test_a_name_may_be_said_twice_but_not_of_two_places():
    assert locked_joints(ARM, ("knee=0.2", "knee=0.2"), []) == locked_joints(ARM, ("knee=0.2",), [])
    with pytest.raises(RecordingError, match="--lock knee: it is named twice, at two places"):
        locked_joints(ARM, ("knee=0.2", "knee"), [])


def test_all_that_is_wrong_with_what_is_locked_is_said_at_once():
    with pytest.raises(RecordingError, match=r"--lock foot: the model has no such joint.*--lock knee=nan: give a"):
        locked_joints(ARM, ("foot", "knee=nan"), [])
    with pytest.raises(RecordingError, match="--lock hip: only hinges and slides"):
        locked_joints(
            ARM.replace('name="hip"', 'name="hip" type="ball"').split("<actuator>")[0] + "</mujoco>", ("hip",), []
        )


def test_what_mujoco_does_not_compile_once_a_joint_is_gone_is_told_in_a_sentence(monkeypatch):
    monkeypatch.setattr(locking, "_untie", lambda spec, held: None)
    with pytest.raises(RecordingError, match="--lock left: MuJoCo cannot compile what is left of the model"):
        locked_joints(COUPLED, ("left",), [])
