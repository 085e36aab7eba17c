"""Robots of random size: their bodies for our own integrator, and the same numbers as MJCF for the diagnosis.

The robots that score (``SEALED``) and those to tune on (``TUNING``) share no mechanism.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from math import cos, sin

import numpy as np
from numpy.typing import NDArray

from benchmarks.concealed.plant import Tree, inverse

Array = NDArray[np.float64]
X, Y, Z = np.eye(3)


@dataclass(frozen=True, eq=False)
class Robot:
    """A robot as its model describes it. Arrays have one row a joint."""

    name: str
    joint_names: tuple[str, ...]
    tree: Tree
    tip: Array
    """Far end of each link in its body's frame [m]. Shape (J, 3)."""
    armature: Array
    """[kg·m²]"""
    damping: Array
    """[N·m·s/rad]"""
    torque_limit: Array
    """[N·m]"""
    centre: Array
    """Pose about which it moves [rad]."""
    reach: Array
    """How far it moves to either side [rad]."""

    @property
    def joints(self) -> int:
        """Number of joints J."""
        return len(self.joint_names)

    def mass_matrix(self, q: Array) -> Array:
        """M(q) with rotors [kg·m²]. Shape (J, J)."""
        matrix, _ = self._at_rest(q)
        return matrix + np.diag(self.armature)

    def gravity_torque(self, q: Array) -> Array:
        """Torque that holds the robot still [N·m]. Shape (J,)."""
        return self._at_rest(q)[1]

    def _at_rest(self, q: Array) -> tuple[Array, Array]:
        still = np.zeros((1, self.joints))
        torque, matrix = inverse(self.tree, np.asarray(q, dtype=np.float64)[None], still, still)
        return matrix[0], torque[0]

    @property
    def model_xml(self) -> str:
        """The nominal model as MJCF, one motor of gear 1 a joint."""
        tree, inner = self.tree, [""] * self.joints
        for b in reversed(range(self.joints)):
            children = "".join(inner[c] for c in range(self.joints) if tree.parent[c] == b)
            inner[b] = self._body(b, children)
        roots = "".join(inner[b] for b in range(self.joints) if tree.parent[b] < 0)
        motors = "".join(
            f'<motor name="{name}" joint="{name}" gear="1" ctrllimited="true" ctrlrange="{-limit:.9g} {limit:.9g}"/>'
            for name, limit in zip(self.joint_names, self.torque_limit, strict=True)
        )
        gravity = _numbers(tree.gravity)
        return (
            f'<mujoco model="{self.name}"><compiler angle="radian" autolimits="true"/>'
            f'<option timestep="0.001" integrator="implicitfast" gravity="{gravity}"><flag contact="disable"/></option>'
            f"<worldbody>{roots}</worldbody><actuator>{motors}</actuator></mujoco>"
        )

    def _body(self, b: int, children: str) -> str:
        tree, name = self.tree, self.joint_names[b]
        inertia = tree.inertia[b]
        full = _numbers(inertia[[0, 1, 2, 0, 0, 1], [0, 1, 2, 1, 2, 2]])
        room = 2.0 * self.reach[b] + (0.5 if tree.slide[b] else 1.2)
        limits = _numbers(np.array([self.centre[b] - room, self.centre[b] + room]))
        radius = 0.12 * float(np.linalg.norm(self.tip[b])) + 0.005
        return (
            f'<body name="{name}_link" pos="{_numbers(tree.place[b])}" quat="{_numbers(_quaternion(tree.turn[b]))}">'
            f'<inertial pos="{_numbers(tree.com[b])}" mass="{tree.mass[b]:.12g}" fullinertia="{full}"/>'
            f'<joint name="{name}" type="{"slide" if tree.slide[b] else "hinge"}" axis="{_numbers(tree.axis[b])}" '
            f'range="{limits}" armature="{self.armature[b]:.12g}" damping="{self.damping[b]:.12g}"/>'
            f'<geom name="{name}_geom" type="capsule" size="{radius:.6g}" fromto="0 0 0 {_numbers(self.tip[b])}" '
            f'contype="0" conaffinity="0"/>{children}</body>'
        )


def _numbers(x: Array) -> str:
    return " ".join(f"{value:.12g}" for value in np.ravel(x))


def _quaternion(rotation: Array) -> Array:
    """w, x, y, z of a rotation matrix (none here turns by half a turn)."""
    w = 0.5 * np.sqrt(max(1.0 + np.trace(rotation), 1e-12))
    skew = rotation - rotation.T
    return np.array([w, skew[2, 1] / (4 * w), skew[0, 2] / (4 * w), skew[1, 0] / (4 * w)])


def turn(axis: Array, angle: float) -> Array:
    """Rotation matrix about a unit axis."""
    x, y, z = axis
    skew = np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]])
    rotation: Array = np.eye(3) + sin(angle) * skew + (1 - cos(angle)) * skew @ skew
    return rotation


@dataclass(frozen=True)
class _Link:
    """One link of a serial robot, before the sizes are drawn."""

    joint: str
    axis: Array
    direction: Array
    """From this joint to the next."""
    length: float
    mass: float
    centre: float = 0.0
    reach: float = 0.6
    slide: bool = False
    lean: Array | None = None
    """Rotation of the frame at q = 0; only the first link's."""


def _assemble(name: str, links: list[_Link], rng: np.random.Generator) -> Robot:
    """Draw sizes about the given ones, and rotors, damping and limits that go with them."""
    n = len(links)
    size, heavy = np.exp(rng.uniform(np.log(0.6), np.log(1.6))), np.exp(rng.uniform(np.log(0.6), np.log(1.8)))
    length = size * np.array([k.length for k in links]) * rng.uniform(0.8, 1.25, n)
    mass = heavy * size**2 * np.array([k.mass for k in links]) * rng.uniform(0.7, 1.4, n)
    place, com, tip, inertia = np.zeros((n, 3)), np.zeros((n, 3)), np.zeros((n, 3)), np.zeros((n, 3, 3))
    for b, link in enumerate(links):
        d = link.direction
        place[b] = links[b - 1].direction * length[b - 1] if b else np.array([0.0, 0.0, 0.4 * size])
        tip[b] = d * length[b]
        across = np.cross(d, Y if abs(d[1]) < 0.9 else X)
        com[b] = tip[b] * rng.uniform(0.35, 0.65) + 0.03 * length[b] * rng.uniform(-1, 1) * across
        long, thick = rng.uniform(0.06, 0.11) * length[b] ** 2, rng.uniform(0.006, 0.015) * length[b] ** 2
        inertia[b] = mass[b] * (long * np.eye(3) + (thick - long) * np.outer(d, d))
    tree = Tree(
        np.arange(-1, n - 1), np.array([k.slide for k in links]), np.array([k.axis for k in links]), place,
        np.stack([np.eye(3) if k.lean is None else k.lean for k in links]), mass, com, inertia,
        np.array([0.0, 0.0, -9.81]),
    )  # fmt: skip
    centre = np.array([k.centre for k in links]) + np.where(tree.slide, 0.0, rng.uniform(-0.2, 0.2, n))
    reach = np.array([k.reach for k in links]) * rng.uniform(0.8, 1.2, n)
    none = np.zeros(n)
    robot = Robot(name, tuple(k.joint for k in links), tree, tip, none, none, none, centre, reach)
    inertia_at = np.diag(robot.mass_matrix(centre))
    rotor = inertia_at * np.exp(rng.uniform(np.log(0.08), np.log(0.5), n))
    rotor = np.maximum(rotor, 0.02 * inertia_at.max() if not tree.slide[0] else 0.0)  # a wrist's rotor outweighs it
    poses = centre + reach * rng.uniform(-1, 1, (64, n))
    weight = np.abs([robot.gravity_torque(q) for q in poses]).max(0)
    pace = np.where(tree.slide, 6.0, 20.0)  # [rad/s²]
    typical = weight + (inertia_at + rotor) * pace
    damping = rng.choice([0.0, 1.0]) * rng.uniform(0.005, 0.03, n) * typical / np.where(tree.slide, 0.5, 2.0)
    return replace(robot, armature=rotor, damping=damping, torque_limit=2.5 * typical)


def pendulum(rng: np.random.Generator) -> Robot:
    """One link that hangs on a horizontal axis."""
    return _assemble("pendulum", [_Link("swing", Y, -Z, 0.45, 1.2, rng.uniform(-0.5, 0.5), 1.0)], rng)


def slider(rng: np.random.Generator) -> Robot:
    """A carriage on a rail, level or inclined."""
    lean = turn(Y, -rng.uniform(0.15, 0.6)) if rng.random() < 0.5 else None
    return _assemble("slider", [_Link("carriage", X, X, 0.3, 4.0, 0.0, 0.25, slide=True, lean=lean)], rng)


def arm3(rng: np.random.Generator) -> Robot:
    """A column that turns, a shoulder, an elbow."""
    links = [
        _Link("column", Z, Z, 0.12, 1.5, 0.0, 0.8),
        _Link("shoulder", Y, X, 0.40, 2.2, -0.7, 0.6),
        _Link("elbow", Y, X, 0.35, 1.2, 1.0, 0.7),
    ]
    return _assemble("arm3", links, rng)


def arm6(rng: np.random.Generator) -> Robot:
    """An arm with a wrist of three axes."""
    links = [
        _Link("waist", Z, Z, 0.15, 2.5, 0.0, 0.7),
        _Link("shoulder", Y, X, 0.40, 2.6, -0.7, 0.5),
        _Link("elbow", Y, X, 0.30, 1.6, 1.1, 0.6),
        _Link("forearm", X, X, 0.10, 0.6, 0.3, 0.8),
        _Link("wrist", Y, X, 0.10, 0.5, 0.5, 0.8),
        _Link("flange", X, (X + 0.7 * Z) / np.linalg.norm(X + 0.7 * Z), 0.14, 0.5, 0.0, 0.9),
    ]
    return _assemble("arm6", links, rng)


def leg3(rng: np.random.Generator) -> Robot:
    """A quadruped's leg in the air: abduction, hip, knee."""
    links = [
        _Link("abduction", X, Y, 0.09, 0.9, 0.1, 0.4),
        _Link("hip", Y, -Z, 0.25, 1.2, 0.7, 0.5),
        _Link("knee", Y, -Z, 0.25, 0.35, -1.4, 0.6),
    ]
    return _assemble("leg3", links, rng)


def arm2(rng: np.random.Generator) -> Robot:
    """Two links in a vertical plane."""
    return _assemble(
        "arm2", [_Link("upper", Y, X, 0.4, 1.8, -0.5, 0.6), _Link("lower", Y, X, 0.35, 1.1, 0.9, 0.7)], rng
    )


def scara(rng: np.random.Generator) -> Robot:
    """Four joints: two upright axes, a lift, and a pitching hand."""
    links = [
        _Link("base", Z, X, 0.35, 2.5, 0.0, 0.7),
        _Link("arm", Z, X, 0.30, 1.8, 0.6, 0.8),
        _Link("lift", Z, -Z, 0.15, 1.0, 0.0, 0.10, slide=True),
        _Link("hand", Y, X, 0.20, 0.6, 0.3, 0.8),
    ]
    return _assemble("scara", links, rng)


def arm4(rng: np.random.Generator) -> Robot:
    """A turret, a boom, a stick and a rolling hand."""
    skew = (X + 0.8 * Y) / np.linalg.norm(X + 0.8 * Y)
    links = [
        _Link("turret", Z, Z, 0.2, 2.0, 0.0, 0.7),
        _Link("boom", Y, X, 0.38, 2.0, -0.6, 0.5),
        _Link("stick", Y, X, 0.30, 1.2, 1.0, 0.6),
        _Link("hand", X, skew, 0.15, 0.5, 0.4, 0.9),
    ]
    return _assemble("arm4", links, rng)


def lift(rng: np.random.Generator) -> Robot:
    """A platform that goes straight up."""
    return _assemble("lift", [_Link("platform", Z, Z, 0.3, 5.0, 0.0, 0.2, slide=True)], rng)


def flap(rng: np.random.Generator) -> Robot:
    """A link on an axis that leans."""
    lean = turn(X, rng.uniform(0.3, 0.8))
    return _assemble("flap", [_Link("flap", Y, X, 0.4, 1.5, rng.uniform(-0.4, 0.6), 0.9, lean=lean)], rng)


def leg2(rng: np.random.Generator) -> Robot:
    """Hip and knee of a leg that hangs."""
    return _assemble("leg2", [_Link("hip", Y, -Z, 0.3, 1.6, 0.4, 0.6), _Link("knee", Y, -Z, 0.28, 0.6, -0.9, 0.6)], rng)


SEALED: dict[str, Callable[[np.random.Generator], Robot]] = {
    "pendulum": pendulum, "slider": slider, "arm3": arm3, "arm6": arm6, "leg3": leg3,
}  # fmt: skip
TUNING: dict[str, Callable[[np.random.Generator], Robot]] = {
    "arm2": arm2, "leg2": leg2, "lift": lift, "arm4": arm4, "flap": flap, "scara": scara,
}  # fmt: skip


def upright(robot: Robot, joint: int) -> bool:
    """True for a hinge whose axis is upright whatever the pose: gravity never turns it."""
    tree, b = robot.tree, joint
    axis = tree.turn[b] @ tree.axis[b]
    while tree.parent[b] >= 0:
        b = int(tree.parent[b])
        if not tree.slide[b] and abs(abs(tree.axis[b] @ axis) - 1) > 1e-9:
            return False
        axis = tree.turn[b] @ axis
    return not tree.slide[joint] and abs(abs(axis[2]) - 1) < 1e-9


def perturbed(robot: Robot, share: float, rng: np.random.Generator) -> Tree:
    """Bodies that are off by up to ``share`` in mass, centre of mass and inertia, as every model is."""
    tree, n = robot.tree, robot.joints
    mass = tree.mass * (1 + rng.uniform(-share, share, n))
    length = np.linalg.norm(robot.tip, axis=1)[:, None]
    com = tree.com * (1 + rng.uniform(-share, share, (n, 1))) + 0.2 * share * length * rng.uniform(-1, 1, (n, 3))
    inertia = tree.inertia * (1 + rng.uniform(-share, share, n))[:, None, None]
    return tree._replace(mass=mass, com=com, inertia=inertia)


def with_point(tree: Tree, body: int, mass: float, place: Array) -> Tree:
    """A point mass fixed to a body, at a place in its frame."""
    masses, coms, inertias = tree.mass.copy(), tree.com.copy(), tree.inertia.copy()
    total = masses[body] + mass
    com = (masses[body] * coms[body] + mass * place) / total
    for m, at in ((masses[body], coms[body] - com), (mass, place - com)):
        inertias[body] = inertias[body] + m * (at @ at * np.eye(3) - np.outer(at, at))
    masses[body], coms[body] = total, com
    return tree._replace(mass=masses, com=coms, inertia=inertias)
