"""The robot as a picture: its links and joints as the model has them, the joints of the findings marked.

Drawn from the kinematics alone, as SVG: it needs neither a display nor OpenGL.
"""

from __future__ import annotations

from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass
from html import escape
from itertools import product

import mujoco
import numpy as np
from numpy.typing import NDArray
from scipy.spatial import ConvexHull, QhullError

Array = NDArray[np.float64]

WIDTH, HEIGHT = 440.0, 270.0
DRAWING = (24.0, 30.0, 250.0, 242.0)
"""Left, top, right and bottom of the robot's own room [px]; the names stand to the right of it."""
PITCH = 36.0
"""Least distance between names [px]."""
MOST_NAMES = 7
FACING = 0.7
"""Cosine from which on an axis counts as pointing at the reader."""
SWING = 0.6
"""How far each hinge is turned to see where the robot moves [rad]; a slide moves as many times 0.3 m."""
_GEOM, _JOINT = mujoco.mjtGeom, mujoco.mjtJoint


@dataclass(frozen=True, eq=False)
class Solid:
    """A convex piece of a body: the hull of ``points``, grown by ``radius``."""

    body: int
    points: Array
    """World frame [m]. Shape (n, 3)."""
    radius: float
    """[m]."""


@dataclass(frozen=True, eq=False)
class View:
    """Orthographic projection to the picture."""

    axes: Array
    """Right, up and towards the reader, in the world. Shape (3, 3)."""
    centre: Array
    """What stands in the middle of the drawing [m]. Shape (2,)."""
    scale: float
    """[px/m]."""

    def __call__(self, points: Array) -> Array:
        """World points as picture points, y downwards [px]. Shape (..., 3) to (..., 2)."""
        left, top, right, bottom = DRAWING
        flat = (points @ self.axes[:2].T - self.centre) * self.scale
        return np.asarray(flat * (1, -1) + ((left + right) / 2, (top + bottom) / 2))


def robot_svg(model: mujoco.MjModel, guilty: Collection[str | None], notes: Mapping[str, str]) -> str:
    """The robot at its default pose, orthographic, from the side from which most of its joints are seen to move.

    Args:
        model: What to draw; scenery larger than the robot is left out.
        guilty: Joints to mark, each with its link; None among them marks all links.
        notes: Joint -> what stands below its name. The joints named here get their names while there is room, those
            marked first; the others stay dots.

    Returns:
        Inline SVG whose colours are CSS variables of the page.
    """
    data = default_pose(model)
    solids = solids_of(model, data)
    view = view_of(model, data, solids)
    bodies = {int(model.jnt_bodyid[j]) for j in _joints(model) if model.joint(j).name in guilty}
    drawn = sorted(solids, key=lambda s: float((s.points @ view.axes[2]).mean()))
    mounts = "".join(_mount(model, data, view, j, solids) for j in _joints(model))
    links = "".join(_solid(s, view, None in guilty or s.body in bodies) for s in drawn)
    joints = sorted(_joints(model), key=lambda j: model.joint(j).name in guilty)
    marks = "".join(_joint(model, data, view, j, model.joint(j).name in guilty) for j in joints)
    named = sorted(
        (j for j in joints if model.joint(j).name in {*notes, *guilty}), key=lambda j: _rank(model, j, guilty, notes)
    )
    names = _names(model, view(data.xanchor), named[:MOST_NAMES], guilty, notes)
    marked = [str(name or "the whole robot") for name in guilty]
    alt = f"Drawing of the robot with its {len(joints)} joints. Marked: {', '.join(marked) or 'none of them'}."
    return (
        f'<svg role="img" class="robot" aria-label="{escape(alt)}" viewBox="0 0 {WIDTH:g} {HEIGHT:g}" '
        f'width="{WIDTH:g}" height="{HEIGHT:g}">\n{mounts}{links}{names}{marks}</svg>'
    )


def default_pose(model: mujoco.MjModel) -> mujoco.MjData:
    """The keyframe called home, else the first one, else the pose in which the model is written."""
    data = mujoco.MjData(model)
    if model.nkey:
        home = mujoco.mj_name2id(model, mujoco.mjtObj.mjOBJ_KEY, "home")
        mujoco.mj_resetDataKeyframe(model, data, max(home, 0))
    mujoco.mj_forward(model, data)
    return data


def solids_of(model: mujoco.MjModel, data: mujoco.MjData) -> list[Solid]:
    """Geoms as convex pieces, and a rod to the centre of mass and to the next joints for bodies without any."""
    shown = [g for g in range(model.ngeom) if model.geom_group[g] < 3 and model.geom_rgba[g, 3] > 0]
    solids = [s for g in shown or range(model.ngeom) if (s := _geom(model, data, g)) is not None]
    bare = set(range(1, model.nbody)) - {s.body for s in solids}
    for body in sorted(bare):
        start = _origin(model, data, body)
        ends = [_origin(model, data, child) for child in range(1, model.nbody) if model.body_parentid[child] == body]
        if model.body_mass[body] > 0:
            ends.append(data.xipos[body])
        solids += [Solid(body, np.stack((start, end)), 0.0) for end in ends] or [Solid(body, start[None], 0.0)]
    moving = [s for s in solids if s.body]
    size = np.ptp(np.concatenate([s.points for s in moving]), axis=0).max() if moving else np.inf
    return [s for s in solids if s.body or np.ptp(s.points, axis=0).max() <= size]


def view_of(model: mujoco.MjModel, data: mujoco.MjData, solids: Sequence[Solid]) -> View:
    """The side from which most of the joints are seen to move, and among those the one of the greatest extent.

    Gravity points down, unless the robot moves in a horizontal plane, which is seen from above.
    """
    anchors = data.xanchor.reshape(-1, 3)
    corners = [s.points + s.radius * way for s in solids for way in (np.ones(3), -np.ones(3))]
    cloud = np.concatenate([*corners, *_swung(model, data), anchors])
    axes = max(_views(model, data), key=lambda view: (_seen(model, data, view[2]), _area(cloud, view)))
    rails = [end for j in _joints(model) if _on_rail(model, j) for end in _rail(model, data, solids, j)]
    shown = np.concatenate([*corners, anchors, np.reshape(rails, (-1, 3))]) @ axes[:2].T
    low, high = shown.min(0), shown.max(0)
    room = np.array([DRAWING[2] - DRAWING[0], DRAWING[3] - DRAWING[1]])
    return View(axes, (low + high) / 2, float((room / np.maximum(high - low, 1e-6)).min()))


def _views(model: mujoco.MjModel, data: mujoco.MjData) -> list[Array]:
    """From the sides, along the world's axes and along the joints', and from above. Right, up, towards the reader."""
    weight = float(np.linalg.norm(model.opt.gravity))
    up = -model.opt.gravity / weight if weight > 0 else np.array([0.0, 0.0, 1.0])
    sides = []
    for axis in (np.array([0.0, -1.0, 0.0]), np.array([1.0, 0.0, 0.0]), *data.xaxis.reshape(-1, 3)):
        right = np.cross(up, axis)
        if np.linalg.norm(right) > 0.1:
            right *= np.sign(right[np.argmax(np.abs(right))]) / np.linalg.norm(right)
            sides.append(np.stack((right, up, np.cross(right, up))))
    return [*sides, *(np.stack((right, np.cross(up, right), up)) for right, _, _ in sides)]


def _seen(model: mujoco.MjModel, data: mujoco.MjData, towards: Array) -> float:
    """How many joints are seen to move: hinges that point at the reader and slides that do not."""
    facing = {j: abs(float(data.xaxis[j] @ towards)) for j in _joints(model)}
    return round(sum(1 - f if model.jnt_type[j] == _JOINT.mjJNT_SLIDE else f for j, f in facing.items()), 3)


def _area(points: Array, axes: Array) -> float:
    """Area of the picture that a view makes of some points [m²]."""
    return float(np.prod(np.ptp(points @ axes[:2].T, axis=0)))


def _joints(model: mujoco.MjModel) -> list[int]:
    return [j for j in range(model.njnt) if model.jnt_type[j] != _JOINT.mjJNT_FREE]


def _origin(model: mujoco.MjModel, data: mujoco.MjData, body: int) -> Array:
    first = int(model.body_jntadr[body])
    held = first >= 0 and model.jnt_type[first] != _JOINT.mjJNT_FREE
    return np.array(data.xanchor[first] if held else data.xpos[body])


def _swung(model: mujoco.MjModel, data: mujoco.MjData) -> list[Array]:
    """Where the bodies come to when each joint alone moves both ways."""
    other, out = mujoco.MjData(model), []
    for j in _joints(model):
        if model.jnt_type[j] == _JOINT.mjJNT_BALL:
            continue
        for way in (-SWING, SWING):
            other.qpos[:] = data.qpos
            other.qpos[model.jnt_qposadr[j]] += way * (0.3 if model.jnt_type[j] == _JOINT.mjJNT_SLIDE else 1.0)
            mujoco.mj_kinematics(model, other)
            out += [np.array(other.xipos[1:]), np.array(other.xanchor)]
    return out


def _geom(model: mujoco.MjModel, data: mujoco.MjData, geom: int) -> Solid | None:
    kind, size = model.geom_type[geom], model.geom_size[geom]
    radius = 0.0
    if kind == _GEOM.mjGEOM_SPHERE:
        local, radius = np.zeros((1, 3)), size[0]
    elif kind == _GEOM.mjGEOM_CAPSULE:
        local, radius = np.array([[0, 0, -size[1]], [0, 0, size[1]]]), size[0]
    elif kind == _GEOM.mjGEOM_CYLINDER:
        rim = np.array([(np.cos(a), np.sin(a)) for a in np.linspace(0, 2 * np.pi, 16, endpoint=False)])
        local = np.array([(size[0] * x, size[0] * y, side * size[1]) for x, y in rim for side in (-1, 1)])
    elif kind == _GEOM.mjGEOM_BOX:
        local = size * np.array(list(product((-1, 1), repeat=3)))
    elif kind == _GEOM.mjGEOM_ELLIPSOID:
        angle = np.linspace(0, np.pi, 9)
        local = size * np.array([
            (np.sin(b) * np.cos(a), np.sin(b) * np.sin(a), np.cos(b)) for a in 2 * angle for b in angle
        ])  # fmt: skip
    elif kind == _GEOM.mjGEOM_MESH:
        mesh = int(model.geom_dataid[geom])
        start = int(model.mesh_vertadr[mesh])
        local = np.array(model.mesh_vert[start : start + int(model.mesh_vertnum[mesh])], dtype=np.float64)
    else:  # planes and height fields are ground
        return None
    points = data.geom_xpos[geom] + local @ data.geom_xmat[geom].reshape(3, 3).T
    return Solid(int(model.geom_bodyid[geom]), points, float(radius))


def _solid(solid: Solid, view: View, guilty: bool) -> str:
    points = _hull(view(solid.points))
    path = "M" + "L".join(f"{x:.1f} {y:.1f}" for x, y in points) + "Z"
    least = 2.5 if len(points) > 1 else 9.0  # rods and lone bodies, which have no shape
    thick = 2 * (solid.radius * view.scale if solid.radius or len(solid.points) > 2 else least)
    name = "link guilty" if guilty else "link"
    return f'<path class="{name} edge" stroke-width="{thick + 2:.1f}" d="{path}"/><path class="{name}" stroke-width="{thick:.1f}" d="{path}"/>\n'  # noqa: E501  # fmt: skip


def _hull(points: Array) -> Array:
    """Corners of the convex hull, in order."""
    points = np.unique(np.round(points, 1), axis=0)
    try:
        return np.asarray(points[ConvexHull(points).vertices])
    except (QhullError, ValueError):  # a point or a line
        return points[[0, -1]] if len(points) > 1 else points


def _on_rail(model: mujoco.MjModel, joint: int) -> bool:
    parent = int(model.body_parentid[model.jnt_bodyid[joint]])
    return bool(model.jnt_type[joint] == _JOINT.mjJNT_SLIDE and model.body_weldid[parent] == 0)


def _rail(model: mujoco.MjModel, data: mujoco.MjData, solids: Sequence[Solid], joint: int) -> Array:
    """Ends of a rail as long as twice the robot. Shape (2, 3)."""
    extent = np.ptp(np.concatenate([s.points for s in solids]) @ data.xaxis[joint])
    return np.asarray(data.xanchor[joint] + np.outer((-1, 1), data.xaxis[joint]) * max(extent, 0.1))


def _mount(model: mujoco.MjModel, data: mujoco.MjData, view: View, joint: int, solids: Sequence[Solid]) -> str:
    """What holds a joint that hangs on the world: a rail below a slide, a bearing at a hinge without a base."""
    parent = int(model.body_parentid[model.jnt_bodyid[joint]])
    if model.body_weldid[parent] != 0:
        return ""
    if _on_rail(model, joint):
        (ax, ay), (bx, by) = view(_rail(model, data, solids, joint))
        return f'<path class="mount" d="M{ax:.1f} {ay:.1f}L{bx:.1f} {by:.1f}"/>\n'
    if model.jnt_type[joint] == _JOINT.mjJNT_SLIDE or any(s.body == parent for s in solids):
        return ""
    x, y = view(data.xanchor[joint])
    below = -1 if view(np.concatenate([s.points for s in solids]))[:, 1].mean() >= y else 1  # away from the links
    top = y + 17 * below
    hatches = "".join(f"M{x + dx:.1f} {top:.1f}l6 {6 * below}" for dx in (-16, -8, 0, 8))
    return (
        f'<path class="mount" d="M{x - 10:.1f} {top:.1f}L{x:.1f} {y:.1f}L{x + 10:.1f} {top:.1f}'
        f'M{x - 18:.1f} {top:.1f}H{x + 18:.1f}{hatches}"/>\n'
    )


def _joint(model: mujoco.MjModel, data: mujoco.MjData, view: View, joint: int, guilty: bool) -> str:
    x, y = view(data.xanchor[joint])
    axis = view.axes @ data.xaxis[joint]
    along = axis[:2] * (1, -1)
    size = 1.5 if guilty else 1.0
    name = "joint guilty" if guilty else "joint"
    if model.jnt_type[joint] == _JOINT.mjJNT_SLIDE and np.linalg.norm(along) > 0.3:
        dx, dy = 24 * size * along / np.linalg.norm(along)
        mark = f'<path class="rail" d="{_arrow(x, y, dx, dy)}{_arrow(x, y, -dx, -dy)}"/><circle cx="{x:.1f}" cy="{y:.1f}" r="{3 * size:.1f}"/>'  # noqa: E501  # fmt: skip
    elif model.jnt_type[joint] == _JOINT.mjJNT_HINGE and abs(axis[2]) < FACING:
        turn = np.degrees(np.arctan2(along[1], along[0]))
        long, wide = 16 * size, 8 * size
        mark = (
            f'<rect x="{-long / 2:.1f}" y="{-wide / 2:.1f}" width="{long:.1f}" height="{wide:.1f}" rx="{wide / 3:.1f}" '
            f'transform="translate({x:.1f} {y:.1f}) rotate({turn:.0f})"/>'
        )
    else:
        mark = f'<circle cx="{x:.1f}" cy="{y:.1f}" r="{5 * size:.1f}"/><circle class="hub" cx="{x:.1f}" cy="{y:.1f}" r="{1.6 * size:.1f}"/>'  # noqa: E501  # fmt: skip
    return f'<g class="{name}"><title>{escape(model.joint(joint).name)}</title>{mark}</g>\n'


def _arrow(x: float, y: float, dx: float, dy: float) -> str:
    tip = np.array([x + dx, y + dy])
    back, side = -np.array([dx, dy]) / np.hypot(dx, dy) * 7, np.array([-dy, dx]) / np.hypot(dx, dy) * 4
    (ax, ay), (bx, by) = tip + back + side, tip + back - side
    return f"M{x:.1f} {y:.1f}L{tip[0]:.1f} {tip[1]:.1f}M{ax:.1f} {ay:.1f}L{tip[0]:.1f} {tip[1]:.1f}L{bx:.1f} {by:.1f}"


def _rank(
    model: mujoco.MjModel, joint: int, guilty: Collection[str | None], notes: Mapping[str, str]
) -> tuple[bool, int]:
    name = model.joint(joint).name
    return name not in guilty, list(notes).index(name) if name in notes else len(notes)


def _names(
    model: mujoco.MjModel,
    anchors: Array,
    joints: Sequence[int],
    guilty: Collection[str | None],
    notes: Mapping[str, str],
) -> str:
    """Names in a column, in the order of their joints' heights, so that no two of them meet."""
    from torchrl_athletic.diagnosis.report.figures import shorten

    order = sorted(joints, key=lambda j: (anchors[j, 1], anchors[j, 0]))
    out = []
    for j, y in zip(order, spread([anchors[j, 1] for j in order], PITCH, 18.0, HEIGHT - 26.0), strict=True):
        name = model.joint(j).name
        style = "name guilty" if name in guilty else "name"
        x, left = DRAWING[2] + 34, DRAWING[2] + 28
        out.append(
            f'<path class="leader {style}" d="M{anchors[j, 0]:.1f} {anchors[j, 1]:.1f}'
            f'L{left - 12:.1f} {y:.1f}H{left:.1f}"/>'
            f'<text class="{style}" x="{x:.1f}" y="{y + 4:.1f}">{escape(shorten(name, 20))}</text>'
            f'<text class="note" x="{x:.1f}" y="{y + 18:.1f}">{escape(shorten(notes.get(name, ""), 26))}</text>\n'
        )
    return "".join(out)


def spread(wished: Sequence[float], pitch: float, low: float, high: float) -> list[float]:
    """Positions near ascending wishes, ``pitch`` apart where the room allows it, within ``low`` and ``high``.

    Example:
        >>> spread([10.0, 12.0, 90.0], 20.0, 0.0, 100.0)
        [10.0, 30.0, 90.0]
        >>> spread([95.0, 99.0], 20.0, 0.0, 100.0)
        [80.0, 100.0]
    """
    if not wished:
        return []
    pitch = min(pitch, (high - low) / max(len(wished) - 1, 1))
    out: list[float] = []
    for i, y in enumerate(wished):
        room = high - pitch * (len(wished) - 1 - i)
        out.append(float(min(max(y, out[-1] + pitch if out else low), room)))
    return out
