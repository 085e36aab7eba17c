"""The drawing of the robot, checked against where its joints and links are by hand."""

import re
from itertools import pairwise

import mujoco
import numpy as np
import pytest
from diagnosis import plants
from diagnosis.sample import ARM, SLIDER
from hypothesis import given
from hypothesis import strategies as st

from torchrl_athletic.diagnosis.report.robot import (
    DRAWING,
    HEIGHT,
    MOST_NAMES,
    _arrow,
    _rail,
    default_pose,
    robot_svg,
    solids_of,
    spread,
    view_of,
)
from torchrl_athletic.robots import b2z1, z1


def chain(axes: list[str], name: str = "chain", link: str = "0.2 0 0") -> str:
    """Equal links one after the other, each turned by a hinge."""
    text = ""
    for i, axis in reversed(list(enumerate(axes))):
        text = (
            f'<body name="link{i}" pos="{link if i else "0 0 0"}"><joint name="joint{i}" axis="{axis}"/>'
            f'<geom type="capsule" fromto="0 0 0 {link}" size=".02"/>{text}</body>'
        )
    return f'<mujoco model="{name}"><worldbody>{text}</worldbody></mujoco>'


LEG = """
<mujoco model="leg"><worldbody><body name="hip" pos="0 0 .6"><joint name="hip" axis="1 0 0"/>
  <geom type="cylinder" size=".05 .03" quat="1 0 1 0"/>
  <body name="thigh"><joint name="thigh" axis="0 1 0"/><geom type="box" pos="0 0 -.15" size=".02 .03 .15"/>
    <body name="calf" pos="0 0 -.3"><joint name="calf" axis="0 1 0"/>
      <geom type="capsule" fromto="0 0 0 0 0 -.3" size=".015"/><geom type="sphere" pos="0 0 -.3" size=".02"/></body>
  </body></body></worldbody></mujoco>"""

ROBOTS = {
    "pendulum": plants.pendulum(),
    "double pendulum": plants.double_pendulum(),
    "slider": plants.slider(),
    "two-link arm": ARM,
    "carriage": SLIDER,
    "three joints": chain(["0 0 1", "0 1 0", "0 1 0"]),
    "six joints": chain(["0 0 1", "0 1 0", "0 1 0", "1 0 0", "0 1 0", "1 0 0"]),
    "leg": LEG,
}


def compiled(name: str) -> mujoco.MjModel:
    if name in ROBOTS:
        return mujoco.MjModel.from_xml_string(ROBOTS[name])
    return {"z1": z1, "b2z1": b2z1}[name]().model()


def joints_of(model: mujoco.MjModel) -> list[str]:
    return [model.joint(j).name for j in range(model.njnt) if model.jnt_type[j] != mujoco.mjtJoint.mjJNT_FREE]


def projected(model: mujoco.MjModel):
    data = default_pose(model)
    return data, view_of(model, data, solids_of(model, data))


def dots(svg: str) -> dict[str, tuple[str, float, float]]:
    """Joint -> class and place of what marks it, for hinges that point at the reader."""
    found = re.findall(r'<g class="([^"]*)"><title>([^<]*)</title><circle cx="([-\d.]+)" cy="([-\d.]+)"', svg)
    return {name: (style, float(x), float(y)) for style, name, x, y in found}


@pytest.mark.parametrize("name", [*ROBOTS, "z1", "b2z1"])
def test_every_robot_is_drawn_within_its_frame_with_the_guilty_joint_named(name):
    model = compiled(name)
    joints = joints_of(model)
    guilty = joints[len(joints) // 2]
    svg = robot_svg(model, [guilty], dict.fromkeys(joints, "a note"))
    assert set(re.findall(r'<g class="joint guilty"><title>(.*?)</title>', svg)) == {guilty}
    assert len(re.findall(r'<g class="joint"><title>', svg)) == len(joints) - 1
    assert re.findall(r'<text class="name guilty"[^>]*>(.*?)</text>', svg) == [guilty]
    assert "nan" not in svg
    assert len(svg) < 30e3
    paths = re.findall(r'class="link[^"]*"[^>]* d="([^"]*)"', svg)
    points = np.array([[float(v) for v in p.split()] for d in paths for p in re.split("[MLZ]", d) if p])
    assert len(paths) >= 2
    assert (points >= 0).all()
    assert points[:, 0].max() < DRAWING[2] + 25
    assert points[:, 1].max() <= HEIGHT
    widest = np.ptp(points, axis=0) / (DRAWING[2] - DRAWING[0], DRAWING[3] - DRAWING[1])
    assert widest.max() > 0.3 or name == "slider"  # that one has no shape at all


@pytest.mark.parametrize("name", ["six joints", "z1", "b2z1"])
def test_names_do_not_meet(name):
    model = compiled(name)
    svg = robot_svg(model, [], dict.fromkeys(joints_of(model), "a note"))
    heights = [float(y) for y in re.findall(r'<text class="name" x="[\d.]+" y="([\d.]+)"', svg)]
    assert len(heights) == min(MOST_NAMES, len(joints_of(model)))
    assert min(b - a for a, b in pairwise(heights)) > 30
    assert heights[-1] + 18 < HEIGHT


def test_what_hangs_below_is_drawn_below_and_to_scale():
    svg = dots(robot_svg(compiled("two-link arm"), ["elbow"], {}))
    (_, x1, y1), (_, x2, y2) = svg["shoulder"], svg["elbow"]
    assert x1 == x2
    length = 0.3 + 0.25 + 0.02 + 0.015  # with the round ends
    assert y2 - y1 == pytest.approx(0.3 / length * (DRAWING[3] - DRAWING[1]), rel=0.02)


def test_gravity_points_down_wherever_the_model_has_it():
    model = compiled("two-link arm")
    model.opt.gravity[:] = 0, 0, 9.81  # a robot on the ceiling
    svg = dots(robot_svg(model, [], {}))
    assert svg["elbow"][2] < svg["shoulder"][2]


def test_a_swing_is_seen_from_the_side():
    for axis in ("0 1 0", "1 0 0", "0.6 0.8 0"):
        model = mujoco.MjModel.from_xml_string(chain([axis], link="0 0 -0.3"))
        _, view = projected(model)
        swing = np.array([float(v) for v in axis.split()])
        assert abs(view.axes[2] @ swing) == pytest.approx(1.0)


def test_a_flat_robot_is_seen_from_above():
    _, view = projected(mujoco.MjModel.from_xml_string(chain(["0 0 1", "0 0 1"])))
    assert abs(view.axes[2]) == pytest.approx([0, 0, 1])
    assert set(dots(robot_svg(mujoco.MjModel.from_xml_string(chain(["0 0 1", "0 0 1"])), [], {}))) == {
        "joint0",
        "joint1",
    }


def test_a_view_is_a_right_handed_turn():
    for name in ROBOTS:
        _, view = projected(compiled(name))
        np.testing.assert_allclose(view.axes @ view.axes.T, np.eye(3), atol=1e-9)
        assert np.linalg.det(view.axes) == pytest.approx(1.0)


def test_a_hinge_across_the_view_is_a_drum_along_its_axis():
    model = compiled("three joints")
    svg = robot_svg(model, [], {})
    assert "joint0" not in dots(svg)
    turn = re.search(r"<title>joint0</title><rect[^>]*rotate\((-?\d+)\)", svg)[1]
    assert abs(int(turn)) == 90  # its axis is upright
    assert {"joint1", "joint2"} <= set(dots(svg))


@pytest.mark.parametrize(("axis", "way"), [("1 0 0", (1, 0)), ("0 0 1", (0, 1)), ("0.6 0 0.8", (0.6, 0.8))])
def test_a_slide_is_an_arrow_both_ways_along_its_axis(axis, way):
    model = mujoco.MjModel.from_xml_string(plants.slider().replace('axis="1 0 0"', f'axis="{axis}"'))
    path = re.search(r'class="rail" d="([^"]*)"', robot_svg(model, ["carriage"], {}))[1]
    lines = [tuple(map(float, p.split())) for p in re.split("[ML]", path)[1:]]
    forward, backward = np.subtract(lines[1], lines[0]), np.subtract(lines[6], lines[5])
    np.testing.assert_allclose(forward, -backward, atol=0.11)
    np.testing.assert_allclose(forward * (1, -1) / np.linalg.norm(forward), way, atol=0.02)


def test_the_link_of_a_guilty_joint_is_tinted_and_for_the_whole_robot_all_of_them():
    model = compiled("two-link arm")
    assert len(re.findall('class="link guilty"', robot_svg(model, ["elbow"], {}))) == 1
    assert len(re.findall('class="link guilty"', robot_svg(model, [None], {}))) == 2
    assert "Marked: the whole robot" in robot_svg(model, [None], {})
    assert "guilty" not in robot_svg(model, [], {"elbow": "69 % of the error"})


def test_a_box_keeps_its_proportions():
    model = mujoco.MjModel.from_xml_string(
        '<mujoco><worldbody><body><joint axis="0 1 0" name="a"/><geom type="box" size=".3 .1 .2"/></body>'
        "</worldbody></mujoco>"
    )
    path = re.search(r'class="link" [^>]*d="M([^"]*)Z"', robot_svg(model, [], {}))[1]
    corners = np.array([[float(v) for v in p.split()] for p in path.split("L")])
    width, height = np.ptp(corners, axis=0)
    assert width / height == pytest.approx(0.3 / 0.2, rel=0.01)
    assert len(corners) == 4


def test_a_mesh_is_drawn_by_its_outline():
    model = mujoco.MjModel.from_xml_string(
        '<mujoco><asset><mesh name="m" vertex="0 0 0  .4 0 0  0 0 .3  0 .1 0  .1 .02 .05"/></asset><worldbody><body>'
        '<joint axis="0 1 0" name="a"/><geom type="mesh" mesh="m"/></body></worldbody></mujoco>'
    )
    path = re.search(r'class="link" [^>]*d="M([^"]*)Z"', robot_svg(model, [], {}))[1]
    corners = np.array([[float(v) for v in p.split()] for p in path.split("L")])
    assert len(corners) == 3  # the other two vertices are inside
    assert np.ptp(corners[:, 0]) / np.ptp(corners[:, 1]) == pytest.approx(4 / 3, rel=0.01)


def test_the_ground_is_not_part_of_the_robot():
    ground = '<geom type="plane" size="5 5 .1"/><geom type="box" size="4 4 .1" pos="0 0 -1"/><body name="upper_arm">'
    with_ground = mujoco.MjModel.from_xml_string(ARM.replace('<body name="upper_arm">', ground))
    assert robot_svg(with_ground, ["elbow"], {}) == robot_svg(compiled("two-link arm"), ["elbow"], {})


def test_the_home_pose_is_preferred():
    keys = '</worldbody><keyframe><key name="other" qpos="1 1"/><key name="home" qpos="0 1.5708"/></keyframe>'
    model = mujoco.MjModel.from_xml_string(ARM.replace("</worldbody>", keys))
    assert default_pose(model).qpos == pytest.approx([0, 1.5708])


def test_a_body_without_a_shape_is_a_rod_to_its_mass():
    model = compiled("pendulum")
    [rod] = solids_of(model, default_pose(model))
    np.testing.assert_allclose(rod.points, [[0, 0, 0], [0, 0, -0.4]])


@given(st.lists(st.floats(-50, 350), max_size=9))
def test_names_are_spread_in_order_within_their_room(wished):
    wished = sorted(wished)
    places = spread(wished, 36.0, 18.0, 248.0)
    assert len(places) == len(wished)
    gaps = np.diff(places)
    assert (gaps >= min(36.0, 230 / max(len(wished) - 1, 1)) - 1e-6).all()
    assert all(18 - 1e-6 <= y <= 248 + 1e-6 for y in places)


def one_body(geoms: str, extra: str = "") -> mujoco.MjModel:
    return mujoco.MjModel.from_xml_string(
        f'<mujoco><worldbody><body><joint axis="0 1 0" name="a"/>{geoms}</body></worldbody>{extra}</mujoco>'
    )


@pytest.mark.parametrize(
    ("shape", "extent"),
    [
        ('type="box" size=".1 .2 .3"', (0.2, 0.4, 0.6)),
        ('type="ellipsoid" size=".1 .2 .3"', (0.2, 0.4, 0.6)),
        ('type="cylinder" size=".1 .3"', (0.2, 0.2, 0.6)),
        ('type="capsule" size=".1 .3"', (0.2, 0.2, 0.8)),
        ('type="sphere" size=".1"', (0.2, 0.2, 0.2)),
        ('type="cylinder" size=".1 .3" euler="0 90 0"', (0.6, 0.2, 0.2)),
    ],
)
def test_a_solid_reaches_as_far_as_its_geom(shape, extent):
    model = one_body(f"<geom {shape}/>")
    [solid] = solids_of(model, default_pose(model))
    assert np.ptp(solid.points, axis=0) + 2 * solid.radius == pytest.approx(extent, rel=0.02)


@pytest.mark.parametrize("hidden", ['group="3"', 'rgba="1 0 0 0"'])
def test_what_a_viewer_hides_is_drawn_only_where_nothing_else_is(hidden):
    seen, unseen = '<geom size=".1"/>', f'<geom size=".2" {hidden}/>'
    for geoms, radius in ((seen + unseen, 0.1), (unseen + seen, 0.1), (unseen, 0.2)):
        model = one_body(geoms)
        assert [s.radius for s in solids_of(model, default_pose(model))] == pytest.approx([radius])


def test_without_a_home_the_first_keyframe_is_the_pose():
    keys = '<keyframe><key name="one" qpos="0.5"/><key name="two" qpos="1"/></keyframe>'
    assert default_pose(one_body('<geom size=".1"/>', keys)).qpos == pytest.approx([0.5])


def test_a_hinge_on_the_world_has_a_bearing_unless_a_base_is_drawn_and_a_slide_its_rail():
    bare = one_body('<geom size=".1"/>')
    stand = mujoco.MjModel.from_xml_string(
        '<mujoco><worldbody><geom size=".05"/><body><joint axis="0 1 0" name="a"/><geom size=".1"/></body></worldbody>'
        "</mujoco>"
    )
    assert [robot_svg(model, [], {}).count('class="mount"') for model in (bare, stand)] == [1, 0]
    model = mujoco.MjModel.from_xml_string(
        plants.slider().replace("</body>", '<geom type="box" size=".3 .1 .1"/></body>')
    )
    data = default_pose(model)
    ends = _rail(model, data, solids_of(model, data), 0)
    np.testing.assert_allclose(ends[1] - ends[0], 2 * 0.6 * data.xaxis[0])  # as long as twice the robot


def test_where_names_are_too_many_the_guilty_joints_are_named_first_then_those_with_the_first_notes():
    model = compiled("six joints")
    many = mujoco.MjModel.from_xml_string(chain(["0 1 0"] * 12))
    notes = {f"joint{k}": "a note" for k in (11, 3, 5, 7, 9, 1, 0, 2)}
    named = set(re.findall(r'<text class="name[^"]*"[^>]*>(.*?)</text>', robot_svg(many, ["joint8"], notes)))
    assert named == {"joint8", *list(notes)[: MOST_NAMES - 1]}
    assert re.findall(r'<text class="name[^"]*"[^>]*>(.*?)</text>', robot_svg(model, [], {})) == []


def test_a_body_that_is_welded_on_is_a_rod_from_where_it_is():
    model = one_body(
        '<geom size=".1"/><body pos="0 0 -0.3"><inertial pos="0 0 -0.1" mass="1" diaginertia=".1 .1 .1"/></body>'
    )
    [rod] = [s for s in solids_of(model, default_pose(model)) if len(s.points) == 2]
    np.testing.assert_allclose(rod.points, [[0, 0, -0.3], [0, 0, -0.4]])


def test_what_is_nearer_is_drawn_over_what_is_behind():
    body = (
        '<body name="{0}" pos="0 {1} 0"><joint name="{0}" axis="0 1 0"/><geom type="box" size="0.1 0.01 0.2"/></body>'
    )
    model = mujoco.MjModel.from_xml_string(
        f"<mujoco><worldbody>{body.format('one', -0.3)}{body.format('other', 0.3)}</worldbody></mujoco>"
    )
    _, view = projected(model)
    nearer = "other" if view.axes[2][1] > 0 else "one"
    for name in ("one", "other"):
        links = re.findall(r'class="(link[^"]*) edge"', robot_svg(model, [name], {}))
        assert links == (["link", "link guilty"] if name == nearer else ["link guilty", "link"])


def test_a_robot_is_no_mirror_image_whichever_way_its_axis_points():
    for axis in ("0 1 0", "0 -1 0", "0.6 0.8 0", "-0.6 -0.8 0"):
        model = mujoco.MjModel.from_xml_string(chain([axis, axis], link="0.24 -0.18 0"))
        places = dots(robot_svg(model, [], {}))
        assert places["joint0"][1] < places["joint1"][1]


def test_names_stand_in_the_order_of_their_joints_heights():
    model = mujoco.MjModel.from_xml_string(chain(["0 1 0"] * 3, link="-0.05 0 -0.2"))  # the lower, the farther left
    svg = robot_svg(model, [], dict.fromkeys(joints_of(model), ""))
    named = re.findall(r'<text class="name" x="[\d.]+" y="([\d.]+)">(.*?)</text>', svg)
    assert [name for _, name in sorted(named, key=lambda n: float(n[0]))] == ["joint0", "joint1", "joint2"]


def test_a_drawn_stand_bears_its_hinge_and_carries_the_rail_of_its_slide():
    joint = '<body><joint type="{}" axis="1 0 0"/><geom size=".1"/></body>'
    stand = f'<mujoco><worldbody><body><geom size=".05"/>{joint}</body></worldbody></mujoco>'

    def mounts(kind):
        return robot_svg(mujoco.MjModel.from_xml_string(stand.format(kind)), [], {}).count('class="mount"')

    assert (mounts("hinge"), mounts("slide")) == (0, 1)


def test_a_guilty_joint_is_larger_and_what_has_no_shape_is_a_rod_or_a_dot():
    hub = re.compile(r'r="([\d.]+)"/><circle class="hub"')
    sizes = [float(hub.search(robot_svg(compiled("pendulum"), guilty, {}))[1]) for guilty in ([], ["pendulum"])]
    assert sizes[1] == 1.5 * sizes[0]
    widths = [
        max(float(w) for w in re.findall(r'class="link" stroke-width="([\d.]+)"', robot_svg(compiled(name), [], {})))
        for name in ("pendulum", "slider")
    ]
    assert 2 < widths[0] < 0.5 * widths[1]


def test_a_rod_begins_at_its_joint_and_an_empty_body_is_a_dot():
    inertial = '<inertial pos="0 0 -0.4" mass="1" diaginertia=".1 .1 .1"/>'
    model = mujoco.MjModel.from_xml_string(
        f'<mujoco><worldbody><body><joint pos="0.1 0 0"/>{inertial}<body pos="0 0 .3"/></body></worldbody></mujoco>'
    )
    points = [s.points.tolist() for s in solids_of(model, default_pose(model))]
    assert [0.1, 0.0, 0.0] in [ends[0] for ends in points if len(ends) == 2]
    assert [[0.0, 0.0, 0.3]] in points


def test_of_two_sides_that_show_a_slide_the_wider_picture_is_taken():
    for size, towards in ((".3 .5 .1", [0, 0, 1]), (".3 .1 .5", [0, -1, 0])):
        box = f'<body><joint type="slide" axis="1 0 0"/><geom type="box" size="{size}"/></body>'
        _, view = projected(mujoco.MjModel.from_xml_string(f"<mujoco><worldbody>{box}</worldbody></mujoco>"))
        assert view.axes[2] == pytest.approx(towards)


def test_a_base_smaller_than_the_robot_is_drawn_however_thin_the_robot_is():
    base = '<geom name="base" type="box" size=".1 .1 .1"/>'
    arm = '<body><joint axis="0 1 0"/><geom type="capsule" size=".01" fromto="0 0 0 0 0 .5"/></body>'
    model = mujoco.MjModel.from_xml_string(f"<mujoco><worldbody>{base}{arm}</worldbody></mujoco>")
    assert [s.body for s in solids_of(model, default_pose(model))] == [0, 1]


def test_each_mesh_has_its_own_corners():
    mesh = '<mesh name="{0}" vertex="0 0 0 {1} 0 0 0 {1} 0 0 0 {1}"/>'
    model = mujoco.MjModel.from_xml_string(
        f"<mujoco><asset>{mesh.format('small', 0.1)}{mesh.format('large', 0.5)}</asset><worldbody><body><joint/>"
        '<geom type="mesh" mesh="large"/><geom type="mesh" mesh="small"/></body></worldbody></mujoco>'
    )
    large, small = (np.ptp(s.points, axis=0).max() for s in solids_of(model, default_pose(model)))
    assert large == pytest.approx(5 * small, rel=1e-3)


@pytest.mark.parametrize("side", [-1, 1])
def test_a_bearing_is_away_from_what_it_bears(side):
    arm = f'<body><joint axis="0 1 0"/><geom type="capsule" size=".01" fromto="0 0 0 0 0 {0.5 * side}"/></body>'
    svg = robot_svg(mujoco.MjModel.from_xml_string(f"<mujoco><worldbody>{arm}</worldbody></mujoco>"), [], {})
    top, joint = (float(y) for y in re.search(r'class="mount" d="M[-\d.]+ ([-\d.]+)L[-\d.]+ ([-\d.]+)L', svg).groups())
    assert np.sign(top - joint) == side  # down in the picture is up in numbers


def test_the_link_that_is_tinted_is_the_guilty_joints_own():
    arm = '<body pos="0 0 -1"><joint name="hip" axis="0 1 0"/><geom type="box" size=".1 .1 .1"/></body>'
    stand = f'<body><geom type="box" size=".1 .1 .1"/>{arm}</body>'
    svg = robot_svg(mujoco.MjModel.from_xml_string(f"<mujoco><worldbody>{stand}</worldbody></mujoco>"), ["hip"], {})
    places = {
        style: float(re.match(r"M[-\d.]+ ([-\d.]+)", path)[1])
        for style, path in re.findall(r'class="(link[^"]*)" stroke-width="[\d.]+" d="([^"]*)"', svg)
    }
    assert places["link guilty"] > places["link"] + 50


def test_the_guilty_joint_is_drawn_over_the_others_and_a_box_is_no_larger_than_it_is():
    model = mujoco.MjModel.from_xml_string(chain(["0 1 0"] * 3))
    marks = re.findall(r'<g class="(joint[^"]*)"><title>(.*?)</title>', robot_svg(model, ["joint0"], {}))
    assert marks[-1] == ("joint guilty", "joint0")
    svg = robot_svg(one_body('<geom type="box" size=".1 .2 .3"/>'), [], {})
    assert re.findall(r'class="link" stroke-width="([\d.]+)"', svg) == ["0.0"]


def test_a_rail_is_within_the_drawing():
    box = '<body><joint type="slide" axis="1 0 0"/><geom type="box" size=".1 .1 .1"/></body>'
    svg = robot_svg(mujoco.MjModel.from_xml_string(f"<mujoco><worldbody>{box}</worldbody></mujoco>"), [], {})
    (rail,) = re.findall(r'class="mount" d="M([-\d.]+) [-\d.]+L([-\d.]+) ', svg)
    assert sorted(float(x) for x in rail) == pytest.approx([DRAWING[0], DRAWING[2]], abs=1)


def test_the_barbs_of_an_arrow_lie_behind_its_tip():
    numbers = [float(v) for v in re.findall(r"-?[\d.]+", _arrow(1.0, 2.0, 20.0, 0.0))]
    start, tip, one, _, other = np.reshape(numbers, (5, 2))
    assert (start.tolist(), tip.tolist()) == ([1.0, 2.0], [21.0, 2.0])
    assert one[0] == other[0] < tip[0]
    assert one[1] + other[1] == 2 * tip[1]
