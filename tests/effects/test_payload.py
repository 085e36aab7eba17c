from types import SimpleNamespace

import mujoco
import numpy as np
import pytest
from effects.arm import JOINTS, address, arm, record

from torchrl_athletic.effects import JointAddress, Plant, project_recording
from torchrl_athletic.effects.payload import INERTIAL, OffsetPayload, Payload, far_end, with_payload, with_point
from torchrl_athletic.recordings import Recording

CARRIER = """
<mujoco><compiler angle="radian"/><worldbody><body><joint name="j" axis="0 1 0" pos="0 0 0.1"/>
  <geom type="capsule" fromto="0 0 0.1 0 0 -0.3" size="0.02" mass="1.2"/>{hand}</body></worldbody></mujoco>"""
HAND = '<body pos="0.05 0 -0.3"><geom type="box" size="0.02 0.01 0.06" mass="0.3"/></body>'
SITE = '<site name="tool" pos="0.1 0 -0.6"/>'


def carrier(hand: str = "") -> tuple[mujoco.MjModel, JointAddress]:
    model = mujoco.MjModel.from_xml_string(CARRIER.format(hand=hand))
    return model, JointAddress.of(model, ("j",))


@pytest.mark.parametrize(
    ("hand", "end"),
    [("", [0, 0, -0.3]), (HAND, [0.05, 0, -0.36]), (HAND + SITE, [0.1, 0, -0.6])],
    ids=["rod", "hand", "tool"],
)
def test_a_payload_sits_at_the_end_farthest_from_the_joint(hand, end):
    """A capsule's is the point that its modeller named, not the cap about it."""
    model, at = carrier(hand)
    np.testing.assert_allclose(far_end(model, at, 0), end, atol=1e-6)


def test_without_geoms_a_link_is_taken_for_a_uniform_rod():
    np.testing.assert_allclose(far_end(arm(), address(), 1), [0, 0.01, -0.3])


def test_only_the_last_link_carries():
    assert not Payload().parameters(arm(), address(), 0)
    (mass,) = Payload().parameters(arm(), address(), 1)
    assert (mass.nominal, mass.lower) == (0, 0)
    assert mass.unit == "kg"


def test_a_point_mass_is_what_the_compiler_makes_of_it():
    """MuJoCo merges a ball that is nearly a point with its link."""
    model, _ = carrier()
    ball = '<geom type="sphere" size="1e-4" pos="0.1 0.2 -0.3" mass="0.7"/>'
    merged, _ = carrier(ball)
    given = [getattr(model, name)[1:2] for name in ("body_mass", "body_ipos", "body_iquat", "body_inertia")]
    mass, centre, quat, inertia = with_point(*given, np.array([0.1, 0.2, -0.3]), np.array([0.7]))
    assert mass[0] == pytest.approx(merged.body_mass[1])
    np.testing.assert_allclose(centre[0], merged.body_ipos[1], atol=1e-9)
    whole = []
    for q, moments in ((quat[0], inertia[0]), (merged.body_iquat[1], merged.body_inertia[1])):
        turn = np.zeros(9)
        mujoco.mju_quat2Mat(turn, q)
        whole.append(turn.reshape(3, 3) @ np.diag(moments) @ turn.reshape(3, 3).T)
    np.testing.assert_allclose(whole[0], whole[1], atol=1e-7)


def test_nothing_added_changes_nothing_and_rows_stay_apart():
    plant = Plant(arm(), address(), 3)
    Payload().apply(plant, 1, np.zeros((3, 1)))
    assert not plant.fields
    Payload().apply(plant, 1, np.array([[0.0], [0.2], [0.4]]))
    for name, value in plant.fields.items():
        np.testing.assert_array_equal(value[0], getattr(arm(), name), err_msg=name)
        np.testing.assert_array_equal(value[:, 1], np.tile(getattr(arm(), name)[1], (3, *[1] * (value.ndim - 2))))
    np.testing.assert_allclose(plant.fields["body_mass"][:, 2], [0.8, 1.0, 1.2])


def test_the_missing_torque_is_the_column_times_the_mass_on_every_joint():
    s = project_recording(record(Payload(), 1, [0.25], seconds=5.0), arm(), np.zeros(2), kernel=0.01)
    (column,) = np.moveaxis(Payload().fingerprint(s, 1, {}).columns, -1, 0)
    for j in range(len(JOINTS)):
        assert np.vdot(column[:, j], s.missing[:, j]) / np.vdot(column[:, j], column[:, j]) == pytest.approx(
            0.25, rel=0.02
        )
        left = ((s.missing - 0.25 * column)[:, j] ** 2).sum()
        assert left < 0.01 * (s.missing[:, j] ** 2).sum()


def test_the_sentence_says_mass_and_joint():
    text = Payload().sentence("elbow", {"mass": 0.25}, Payload().parameters(arm(), address(), 1))
    assert "0.25 kg" in text
    assert "elbow" in text


def test_an_offset_payload_is_a_point_off_the_end_and_without_an_offset_a_payload():
    moments, mass = np.array([0.02, -0.01, 0.03]), 0.3
    plants = [Plant(arm(), address(), 1) for _ in range(4)]
    OffsetPayload().apply(plants[0], 1, np.array([[mass, *moments]]))
    at = int(address().body[1])
    link = [getattr(arm(), name)[at : at + 1] for name in INERTIAL]
    point = far_end(arm(), address(), 1) + moments / mass
    for name, value in zip(INERTIAL, with_point(*link, point, np.array([mass])), strict=True):
        np.testing.assert_allclose(plants[0].fields[name][0, at], value[0])
    OffsetPayload().apply(plants[1], 1, np.array([[mass, 0.0, 0.0, 0.0]]))
    Payload().apply(plants[2], 1, np.array([[mass]]))
    for name in INERTIAL:
        np.testing.assert_allclose(plants[1].fields[name], plants[2].fields[name])
    OffsetPayload().apply(plants[3], 1, np.array([[0.0, *moments]]))
    assert not plants[3].fields


HINGES = """<mujoco><worldbody>{more}<body pos="0 0 1">{a}<geom size="0.05" mass="2"/><body pos="0 0 -0.2">{b}
  <geom size="0.04" pos="0 0 -0.15" mass="1"/><body pos="0 0 -0.3">{c}
  <geom size="0.03" pos="0 0 -0.05" mass="0.3"/></body></body></body></worldbody></mujoco>"""


def three_joints(axes=("0 0 1", "0 1 0", "0 0 1"), kind="hinge", more="") -> mujoco.MjModel:
    names = ("j0", "j1", "j2")
    joints = [f'<joint name="{n}" type="{kind}" axis="{axis}"/>' for n, axis in zip(names, axes, strict=True)]
    return mujoco.MjModel.from_xml_string(HINGES.format(a=joints[0], b=joints[1], c=joints[2], more=more))


def offset_parameters(model: mujoco.MjModel, names=("j0", "j1", "j2"), joint=2):
    return OffsetPayload().parameters(model, JointAddress.of(model, names), joint)


def test_a_moment_that_no_joint_feels_stays_zero():
    widths = [p.upper - p.lower for p in offset_parameters(three_joints())]
    assert all(width > 0 for width in widths)
    planar = offset_parameters(three_joints(axes=("0 1 0",) * 3))
    assert [p.upper > p.lower for p in planar] == [True, True, False, True]
    assert planar[2].upper == planar[2].lower == 0
    assert offset_parameters(three_joints(kind="slide")) == ()  # which feel a mass wherever it is


def test_where_a_payload_is_is_asked_of_chains_of_three_joints_and_lies_within_reach():
    s = project_recording(record(Payload(), 1, [0.25], seconds=5.0), arm(), np.zeros(2), kernel=0.01)
    assert OffsetPayload().grid_of([s], 1) == []
    model = three_joints()
    take = SimpleNamespace(
        model=model, address=JointAddress.of(model, ("j0", "j1", "j2")), fine_position=np.zeros((2, 3))
    )
    assert OffsetPayload().grid_of([take], 2) == [{}]
    assert OffsetPayload().grid_of([take], 1) == []  # not of the upper link
    mass, x, *_ = parameters = offset_parameters(model)
    assert x.upper / mass.upper == pytest.approx(0.5 * (0.2 + 0.3 + 0.05))  # from joint to joint, and the far end
    assert OffsetPayload().is_physical(parameters, np.array([0.5, 0.0, 0.0, 0.13]))
    assert not OffsetPayload().is_physical(parameters, np.array([0.5, 0.1, 0.0, 0.1]))


def test_what_is_beyond_reach_is_brought_within_it():
    plant = Plant(three_joints(), JointAddress.of(three_joints(), ("j0", "j1", "j2")), 1)
    OffsetPayload().apply(plant, 2, np.array([[0.3, 30.0, 40.0, 0.0]]))
    centre = plant.fields["body_ipos"][0, 3]  # halfway, since both weigh the same
    np.testing.assert_allclose(centre, [0.3 * 0.275, 0.4 * 0.275, -0.05], atol=1e-9)


def test_reach_and_mass_are_those_of_the_chain_whatever_else_the_model_has():
    more = """<body><geom size="0.5" mass="500"/></body>
      <body pos="5 0 0"><joint name="other" axis="0 1 0"/><geom size="0.1"/></body>"""
    alone, crowded = offset_parameters(three_joints()), three_joints(more=more)
    beside = offset_parameters(crowded, ("j0", "j1", "j2", "other"))
    named = offset_parameters(crowded, ("other", "j2", "j0", "j1"), 1)
    for one, other, third in zip(alone, beside, named, strict=True):
        assert one.upper == pytest.approx(other.upper) == pytest.approx(third.upper)


def test_what_three_joints_feel_tells_mass_and_place_of_a_weight_off_the_axis():
    """From a log of an arm that holds it, simulated by MuJoCo with the compiler's own merging of bodies."""
    at, mass, names = np.array([0.06, -0.03, 0.02]), 1.1, ("base", "upper", "wrist")
    wrist = """<body pos="0 0 -0.3"><joint name="wrist" axis="0 0 1" armature="0.02"/>
      <geom size="0.03" pos="0 0 -0.05" mass="0.3"/>{}</body>"""
    arm = """<mujoco><option timestep="0.001"/><worldbody>
      <body pos="0 0 1"><joint name="base" axis="0 0 1" armature="0.1"/><geom size="0.05" mass="2"/>
      <body><joint name="upper" axis="0 1 0" armature="0.1"/>
      <geom size="0.04" pos="0 0 -0.15" mass="1"/>{}</body></body>
      </worldbody></mujoco>"""
    bare = mujoco.MjModel.from_xml_string(arm.format(wrist.format("")))
    end = far_end(bare, JointAddress.of(bare, names), 2)
    ball = f'<geom size="1e-4" pos="{" ".join(map(str, end + at))}" mass="{mass}"/>'
    loaded = mujoco.MjModel.from_xml_string(arm.format(wrist.format(ball)))
    data, rows = mujoco.MjData(loaded), []
    for k in range(8000):
        t = 1e-3 * k
        target = np.array([0.8 * np.sin(1.7 * t), 1.0 * np.sin(2.3 * t), 1.4 * np.sin(3.1 * t)])
        data.qfrc_applied[:] = [80, 80, 8] * (target - data.qpos) - [6, 6, 0.4] * data.qvel
        rows.append((t, *data.qpos, *data.qfrc_applied))
        mujoco.mj_step(loaded, data)
    log = np.array(rows)[::5]
    take = Recording(log[:, 0], names, log[:, 1:4], torque_command=log[:, 4:])
    s = project_recording(take, bare, np.zeros(3), kernel=0.01)

    def found(effect):
        columns = effect.fingerprint(s, 2, {}).columns[s.valid.all(1)]
        columns, missing = columns.reshape(-1, columns.shape[2]), s.missing[s.valid.all(1)].ravel()
        values = np.linalg.lstsq(columns, missing, rcond=None)[0]
        return values, float(((missing - columns @ values) ** 2).sum() / (missing**2).sum())

    values, left = found(OffsetPayload())
    assert values[0] == pytest.approx(mass, rel=0.05)
    np.testing.assert_allclose(values[1:] / values[0], at, atol=0.005)
    assert left < 0.01
    assert found(Payload())[1] > 10 * left


def test_a_heavy_arm_may_carry_more_than_ten_of_its_light_last_links():
    """The flange of an industrial arm weighs 0.2 kg, and its payload 3."""
    light = mujoco.MjSpec()
    upper = light.worldbody.add_body()
    upper.add_joint(name="upper", axis=[0, 1, 0])
    upper.add_geom(size=[0.1, 0, 0], mass=20.0)
    lower = upper.add_body(pos=[0, 0, -0.5])
    lower.add_joint(name="lower", axis=[0, 1, 0])
    lower.add_geom(size=[0.02, 0, 0], pos=[0, 0, -0.1], mass=0.1)
    model = light.compile()
    (mass,) = Payload().parameters(model, JointAddress.of(model, ("upper", "lower")), 1)
    assert mass.upper == pytest.approx(0.5 * 20.1)


def test_a_weight_is_fastened_to_the_last_link_where_bodies_have_no_names():
    xml = """<mujoco><worldbody><body pos="1 0 0"><geom size="0.1"/></body>
      <body><joint name="upper" axis="0 1 0" armature="0.1"/><geom size="0.1" pos="0 0 -0.2"/>
        <body pos="0 0 -0.4"><joint name="lower" axis="0 1 0"/><geom size="0.1" pos="0 0 -0.2"/></body></body>
      </worldbody></mujoco>"""
    bare, loaded = mujoco.MjModel.from_xml_string(xml), with_payload(xml, ("upper", "lower"), 0.5)
    weight, lower = loaded.body("fastened_payload"), int(loaded.joint("lower").bodyid[0])
    assert int(weight.parentid[0]) == lower
    assert loaded.body_subtreemass[lower] == pytest.approx(
        bare.body_subtreemass[int(bare.joint("lower").bodyid[0])] + 0.5
    )
