"""A robot that got what a diagnosis found moves as the diagnosis' own corrected simulation does."""

from __future__ import annotations

import json
import pickle

import mujoco
import numpy as np
import pytest

from torchrl_athletic.diagnosis.corrected import Simulation
from torchrl_athletic.effects import CATALOGUE, FIT_TRIMS, JointAddress, Plant
from torchrl_athletic.robots import b2z1, from_mjcf, z1
from torchrl_athletic.robots.corrected import SCHEMA, with_correction

ARM = z1()
VALUES = {
    "coulomb_friction": {"joint2": {"torque": 2.5, "turnover": 0.0}, "joint3": {"torque": 0.4, "turnover": 0.02}},
    "asymmetric_friction": {
        "joint4": {
            "coulomb_positive": 1.0,
            "coulomb_negative": 0.4,
            "viscous_positive": 0.9,
            "viscous_negative": 0.5,
        }
    },
    "stribeck_friction": {"joint6": {"coulomb": 0.8, "stribeck": 0.6, "stribeck_speed": 0.2}},
    "viscous_friction": {"joint1": {"damping": 1.7}},
    "reflected_inertia": {"joint5": {"armature": 0.08}},
    "link_mass": {"joint2": {"mass": 2.0}},
    "link_inertia": {"joint3": {"scale": 1.5}},
    "link_com": {"joint3": {"distance": 0.05}},
    "link_com_shift": {"joint4": {"x": 0.01, "y": -0.02, "z": 0.005}},
    "actuation_delay": {"joint2": {"delay": 0.012}},
}
FIELDS = (
    "dof_frictionloss",
    "dof_solref",
    "dof_solimp",
    "dof_damping",
    "dof_armature",
    "body_mass",
    "body_inertia",
    "body_ipos",
)


def correction(*effects: str, **others: object) -> dict[str, object]:
    """A corrected.json of the arm, which gives each parameter with the model's own value."""
    model = ARM.model()
    address = JointAddress.of(model, ARM.joint_names, "test")
    known = {effect.name: effect for effect in (*FIT_TRIMS, *CATALOGUE)}
    entries = []
    for name in effects:
        for joint, values in VALUES[name].items():
            given = known[name].parameters(model, address, ARM.joint_names.index(joint))
            parameters = {p.name: {"value": values[p.name], "nominal": p.nominal, "unit": p.unit} for p in given}
            entries.append({"effect": name, "joint": joint, "parameters": parameters})
    return {"schema": SCHEMA, "joint_names": list(ARM.joint_names), "effects": entries, "trims": [], **others}


def diagnosed(content: dict[str, object]) -> Plant:
    """The fields with which the diagnosis simulates it."""
    model = ARM.model()
    simulation = Simulation.from_json(content, model)
    plant = Plant(model, JointAddress.of(model, ARM.joint_names), 1)
    simulation.hypothesis.build(plant, simulation.values[None])
    return plant


def arm_rows(model: mujoco.MjModel, field: str) -> np.ndarray:
    """Rows of the arm's joints, or of the links that they move."""
    joints = [model.joint(name) for name in ARM.joint_names]
    at = [int(j.dofadr[0]) if field.startswith("dof") else int(j.bodyid[0]) for j in joints]
    return np.asarray(getattr(model, field))[at]


@pytest.mark.parametrize("effects", [[name] for name in VALUES] + [list(VALUES)], ids=lambda names: "+".join(names))
def test_it_is_the_model_that_the_diagnosis_simulated(effects):
    content = correction(*effects)
    plant, model, given = diagnosed(content), with_correction(ARM, content).model(), ARM.model()
    for field in FIELDS:
        expected = np.array(getattr(given, field))
        if field in plant.fields:
            expected = plant.fields[field][0]
        np.testing.assert_allclose(getattr(model, field), expected, rtol=1e-6, atol=1e-9, err_msg=field)


def test_the_arm_of_a_quadruped_gets_what_was_found_on_its_stand():
    content = correction("coulomb_friction", "reflected_inertia", "link_mass", "link_com")
    alone, whole, given = (
        with_correction(ARM, content).model(),
        with_correction(b2z1(), content).model(),
        b2z1().model(),
    )
    for field in FIELDS:
        np.testing.assert_allclose(arm_rows(whole, field), arm_rows(alone, field), rtol=1e-6, atol=1e-9, err_msg=field)
    assert not np.allclose(arm_rows(whole, "dof_frictionloss"), arm_rows(given, "dof_frictionloss"))
    legs = [int(given.joint(name).dofadr[0]) for name in b2z1().joint_names if name not in ARM.joint_names]
    for field in ("dof_frictionloss", "dof_armature", "dof_solref"):
        np.testing.assert_array_equal(getattr(whole, field)[legs], getattr(given, field)[legs])
    heavier = VALUES["link_mass"]["joint2"]["mass"] - given.body(given.joint("joint2").bodyid[0]).mass[0]
    assert whole.body_mass.sum() - given.body_mass.sum() == pytest.approx(heavier)


def test_the_rest_of_the_robot_and_the_given_one_stay_as_they_are():
    before = ARM.model().dof_frictionloss.copy()
    corrected = with_correction(ARM, correction("coulomb_friction"))
    np.testing.assert_array_equal(ARM.model().dof_frictionloss, before)
    assert (corrected.kp, corrected.joint_names, corrected.keyframe) == (ARM.kp, ARM.joint_names, ARM.keyframe)


def test_what_a_model_cannot_say_changes_nothing():
    model, given = with_correction(ARM, correction("actuation_delay")).model(), ARM.model()
    for field in FIELDS:
        np.testing.assert_array_equal(getattr(model, field), getattr(given, field))


def test_it_comes_from_a_file_and_goes_to_another_process(tmp_path):
    path = tmp_path / "corrected.json"
    path.write_text(json.dumps(correction("viscous_friction")), encoding="utf-8")
    robot = pickle.loads(pickle.dumps(with_correction(ARM, path)))
    assert robot.model().joint("joint1").damping.flat[0] == pytest.approx(1.7)


def test_a_joint_may_go_by_another_name():
    content = correction("viscous_friction")
    content["effects"][0]["joint"] = "shoulder_pan"
    model = with_correction(ARM, content, joints={"shoulder_pan": "joint1"}).model()
    assert model.joint("joint1").damping.flat[0] == pytest.approx(1.7)
    with pytest.raises(ValueError, match=r"'shoulder_pan'.*joints="):
        with_correction(ARM, content)


def test_a_link_that_is_another_is_refused():
    content = correction("link_mass")
    content["effects"][0]["parameters"]["mass"]["nominal"] *= 1.1
    with pytest.raises(ValueError, match="would be lost"):
        with_correction(ARM, content)


def test_another_schema_is_refused():
    with pytest.raises(ValueError, match="schema is 'other'"):
        with_correction(ARM, correction(schema="other"))


def test_a_link_without_a_name_gets_its_mass_too():
    xml = """<mujoco><worldbody><body><joint name="hinge" axis="0 1 0"/>
      <geom type="capsule" fromto="0 0 0 0 0 -0.3" size="0.02" mass="1"/></body></worldbody>
      <actuator><motor joint="hinge" forcerange="-30 30"/></actuator></mujoco>"""
    heavy = {"effect": "link_mass", "joint": "hinge", "parameters": {"mass": {"value": 1.3, "nominal": 1.0}}}
    found = {"schema": SCHEMA, "joint_names": ["hinge"], "effects": [heavy], "trims": []}
    assert with_correction(from_mjcf(xml), found).model().body_mass.sum() == pytest.approx(1.3)
