"""A drive of two joints is offered to a fit where the torques ask for it, and nowhere else."""

import mujoco
import numpy as np
import pytest
from effects.arm import ARM, JOINTS, address, arm, record

from torchrl_athletic.diagnosis.corrected import Simulation
from torchrl_athletic.diagnosis.corrected_xml import written
from torchrl_athletic.diagnosis.coupled import with_coupled_drives
from torchrl_athletic.diagnosis.fit import Hypothesis
from torchrl_athletic.diagnosis.prepare import prepare
from torchrl_athletic.diagnosis.screen import Candidate
from torchrl_athletic.diagnosis.standard import seen_in, standard_joints, torque_domain
from torchrl_athletic.effects import (
    CoulombFriction,
    CoupledDrive,
    LinkCom,
    LinkInertia,
    LinkMass,
    Payload,
    ReflectedInertia,
    ViscousFriction,
)
from torchrl_athletic.recordings import Recording

DRIVE = CoupledDrive()


def of_tendon(*values: float) -> Recording:
    spec = mujoco.MjSpec.from_string(ARM)
    assert DRIVE.write(spec, "elbow", np.array(values))
    return record(model=spec.compile())


def hypothesis(recording: Recording):
    prepared = prepare([recording], arm())
    return with_coupled_drives(standard_joints(prepared, seen_in(prepared)), prepared, seen_in(prepared)), prepared


def drives(recording: Recording):
    return [c for c in hypothesis(recording)[0].terms if c.effect.name == "coupled_drive"]


@pytest.mark.parametrize("ratio", [1.0, -1.0])
def test_a_coupled_drive_is_offered_with_its_ratio(ratio):
    [found] = drives(of_tendon(0.15, 0.05, 0.005, ratio))
    assert found.where == "elbow"
    assert {p.name: p.nominal for p in found.parameters}["ratio"] == ratio


@pytest.mark.parametrize(
    ("effect", "joint", "values"),
    [
        (None, 0, []),
        (CoulombFriction(), 1, [0.2, 0.0]),
        (CoulombFriction(), 0, [0.5, 0.0]),
        (ViscousFriction(), 1, [0.4]),
        (LinkMass(), 1, [1.2]),
        (LinkInertia(), 1, [3.0]),
        (LinkInertia(), 1, [0.3]),
        (Payload(), 1, [0.3]),
        (LinkCom(), 1, [0.2]),
    ],
)
@pytest.mark.parametrize("gravity", [(0, 0, -9.81), (0, -9.81, 0)], ids=["vertical", "horizontal"])
def test_what_one_joint_or_link_has_offers_none(effect, joint, values, gravity):
    """On parallel axes an inertia that the model has wrong acts on the sum of two accelerations, as a rotor would."""
    model = arm()
    model.opt.gravity[:] = gravity
    recording = record(effect, joint, values, model=model)
    prepared = prepare([recording], model)
    h = with_coupled_drives(standard_joints(prepared, seen_in(prepared)), prepared, seen_in(prepared))
    assert not [c for c in h.terms if c.effect.name == "coupled_drive"]


def test_torques_of_a_controller_offer_none():
    spec = mujoco.MjSpec.from_string(ARM)
    assert DRIVE.write(spec, "elbow", np.array([0.15, 0.05, 0.005, 1.0]))
    followed = record(model=spec.compile(), position_control=True)
    assert not drives(followed)


def test_the_scales_of_both_joints_and_the_ratio_are_held():
    h, _ = hypothesis(of_tendon(0.15, 0.05, 0.005, 1.0))
    held = {(c.where, p.name) for c in h.terms for p in c.parameters if p.upper == p.lower}
    assert {("shoulder", "scale"), ("elbow", "scale"), ("elbow", "ratio")} <= held


def test_a_rotor_may_be_what_the_torques_allow_however_light_its_link():
    recording = of_tendon(0.15, 0.05, 0.005, 1.0)
    h, prepared = hypothesis(recording)
    [drive] = [c for c in h.terms if c.effect.name == "coupled_drive"]
    seen = seen_in(prepared)
    assert drive.parameters[2].upper >= 10.0 * seen.torque[1] / seen.acceleration[1]


def test_the_torques_of_both_joints_tell_the_drives_numbers():
    values = (0.15, 0.05, 0.005)
    h, prepared = hypothesis(of_tendon(*values, 1.0))
    [drive] = [c for c in h.terms if c.effect.name == "coupled_drive"]
    assert h.values_of(drive, torque_domain(h, prepared))[:3] == pytest.approx(values, rel=0.15)


@pytest.mark.parametrize("values", [[0.0, 0.0, 0.01, 1.0], [0.1, 0.1, 0.01, -1.0]])
def test_what_is_written_as_mjcf_moves_as_the_correction_does(values):
    own = DRIVE.parameters(arm(), address(), 1)
    rotor = Candidate(ReflectedInertia(), 1, "elbow", ReflectedInertia().parameters(arm(), address(), 1))
    h = Hypothesis((Candidate(DRIVE, 1, "elbow", own), rotor))
    file = written(ARM, Simulation(arm(), JOINTS, h, np.array([*values, 0.008])))
    assert not file.left_out
    model = mujoco.MjModel.from_xml_string(file.xml)
    assert model.dof_armature == pytest.approx([0.02, 0.008])
    spec = mujoco.MjSpec.from_string(ARM)
    spec.joint("elbow").armature = 0.008
    ours, given = record(DRIVE, 1, values, model=spec.compile()), record(model=arm())
    off, moved = (np.abs(r.position - record(model=model).position).max(0) for r in (ours, given))
    assert (off < 0.02 * moved).all()
