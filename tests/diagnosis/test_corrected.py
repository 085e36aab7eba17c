"""A correction survives its file, and what MJCF can say of it is said in MJCF."""

import json

import mujoco
import numpy as np
import pytest
from diagnosis.plants import pendulum, record, smooth_torque

from torchrl_athletic.diagnosis.corrected import NATIVE, Simulation, corrected_xml, write_atomically, write_json
from torchrl_athletic.diagnosis.fit import Hypothesis
from torchrl_athletic.diagnosis.screen import FIT_TRIMS, Candidate
from torchrl_athletic.effects import CATALOGUE, JointAddress

EFFECTS = {e.name: e for e in (*CATALOGUE, *FIT_TRIMS)}
NATIVE_TERMS = {
    "coulomb_friction": [0.1, 0.0],
    "viscous_friction": [0.12],
    "reflected_inertia": [0.02],
    "link_mass": [0.6],
}
MEMORY_TERMS = {"actuation_delay": [0.02], "torque_scale": [1.2], "torque_offset": [-0.1], "encoder_offset": [0.05]}


def corrected(terms, trims=None, name="pendulum", effects=EFFECTS) -> Simulation:
    model = mujoco.MjModel.from_xml_string(pendulum(name=name))
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
    for window in (0.5, None):
        np.testing.assert_array_equal(one.rollout(recording(), window), two.rollout(recording(), window))
    assert np.abs(one.rollout(recording()) - corrected({}).rollout(recording())).max() > 1e-3


def test_an_effect_of_another_catalogue_is_refused_by_name():
    content = corrected(NATIVE_TERMS).to_json()
    few = tuple(e for e in CATALOGUE if e.name != "coulomb_friction")
    with pytest.raises(ValueError, match=r"'coulomb_friction' is not in the catalogue.*Pass yours"):
        Simulation.from_json(content, corrected({}).model, few)


@pytest.mark.parametrize("name", [*sorted(NATIVE_TERMS), "all"])
def test_mjcf_alone_moves_as_the_corrected_simulation_when_it_can_say_all(name):
    terms = NATIVE_TERMS if name == "all" else {name: NATIVE_TERMS[name]}
    simulation = corrected(terms)
    xml = corrected_xml(pendulum(), simulation)
    alone = Simulation(mujoco.MjModel.from_xml_string(xml), ("pendulum",), Hypothesis(()), np.zeros(0))
    r = recording()
    for window in (0.5, None):
        np.testing.assert_allclose(alone.rollout(r, window), simulation.rollout(r, window), rtol=0, atol=1e-9)
    assert np.abs(alone.rollout(r, None) - corrected({}).rollout(r, None)).max() > 1e-2
    assert "not expressed" not in xml


def test_dry_friction_brings_its_stiffness_into_mjcf():
    model = mujoco.MjModel.from_xml_string(corrected_xml(pendulum(), corrected({"coulomb_friction": [0.1, 0.0]})))
    assert model.dof_frictionloss == pytest.approx([0.1])
    assert model.dof_solref[0] == pytest.approx([2 * model.opt.timestep, 1.0])
    assert model.dof_solimp[0, :2] == pytest.approx([0.99, 0.99])


def test_mass_keeps_the_rest_of_the_link():
    model = mujoco.MjModel.from_xml_string(corrected_xml(pendulum(), corrected({"link_mass": [0.6]})))
    body = model.body("link")
    assert body.mass == pytest.approx([0.6])
    assert body.inertia == pytest.approx([0.012] * 3)
    assert body.ipos == pytest.approx([0, 0, -0.4])


def test_what_mjcf_cannot_say_is_named_in_a_comment():
    xml = corrected_xml(pendulum(), corrected({**NATIVE_TERMS, **MEMORY_TERMS}))
    head = xml[: xml.index("-->")]
    assert {n for n in EFFECTS if f"not expressed here, see corrected.json: {n} of pendulum" in head} == set(
        MEMORY_TERMS
    )
    assert NATIVE.isdisjoint(MEMORY_TERMS)
    mujoco.MjModel.from_xml_string(xml)


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
    path = tmp_path / "new" / "a.json"
    write_json(path, {"π": [1.0]})
    assert path.read_text(encoding="utf-8") == '{\n "π": [\n  1.0\n ]\n}\n'
    with pytest.raises(ValueError, match="not JSON compliant"):
        write_json(path, {"x": float("nan")})
    with pytest.raises(TypeError):
        write_atomically(path, 3)
    assert json.loads(path.read_text(encoding="utf-8")) == {"π": [1.0]}
