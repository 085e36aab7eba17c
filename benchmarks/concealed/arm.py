"""A Z1 that stands for the real one: an arm on harmonic drives, of whose insides nobody who identifies it may know.

It shares no code with the library's physics, its effects or MuJoCo's integrator: the bodies' dynamics are our own
(:mod:`benchmarks.concealed.plant`), so are the drives (:mod:`benchmarks.concealed.harmonic`), and a Runge-Kutta method
of fourth order moves both at 0.1 ms. Only lengths, masses and limits are read once from the robot's model, as from a
data sheet, and the masses are then wrong by some per cent.

The drives take a position target every 5 ms and close the loop themselves, at 1 kHz, from quantised encoders on the
rotors: what they report is not where the links are.
"""

from __future__ import annotations

from typing import NamedTuple

import mujoco
import numpy as np
from numpy.typing import ArrayLike, NDArray

from benchmarks.concealed.harmonic import (
    PERIOD,
    POSITION,
    RESOLUTION,
    ROTOR,
    SPEED,
    STATES,
    TORQUE,
    ideal,
    play,
    workroom,
)
from benchmarks.concealed.plant import Tree
from torchrl_athletic.recordings import Recording
from torchrl_athletic.robots import Robot, z1

Array = NDArray[np.float64]

SETTLE = 1.0
"""How long a pose is held before anything else happens [s]."""
ARCMIN = np.pi / 180 / 60
IDENTITY = 20261121
"""Seed of all that the arm hides."""
CATALOGUE = {14: (3400.0, 4700.0, 5700.0, 2.0, 6.9), 17: (8100.0, 11000.0, 13000.0, 3.9, 12.0)}
"""Gear size -> K1, K2, K3 [N·m/rad], T1, T2 [N·m] at 50:1: Harmonic Drive's CSG and SHG tables."""
SIZES = (17, 17, 17, 14, 14, 14)


class Reading(NamedTuple):
    """What the drives report."""

    position: Array
    """Position of the rotor behind the gear [rad]. Shape (7,)."""
    velocity: Array
    """Velocity from differences of the encoder, filtered by the drive [rad/s]. Shape (7,)."""
    torque: Array
    """Motor current times the constant that the drive believes in [N·m]. Shape (7,)."""


class TrueState(NamedTuple):
    """What only a referee may see: the links, and the tool at their end, in the base's frame."""

    time: float
    """Since the last reset [s]."""
    position: Array
    """[rad]. Shape (7,)."""
    velocity: Array
    """[rad/s]. Shape (7,)."""
    site_position: Array
    """[m]. Shape (3,)."""
    site_rotation: Array
    """From the site's frame into the base's. Shape (3, 3)."""
    site_velocity: Array
    """[m/s]. Shape (3,)."""


class ConcealedArm:
    """The one concealed Z1, on a table, its gripper clamped shut.

    Joints are those of :func:`~torchrl_athletic.robots.z1`. The gripper's column stays at zero, whatever is asked.

    Args:
        robot: A Z1 as its data sheet has it. What hangs on its last link is fixed to it; a free ball is left out.
        payload: Point mass at the site ``bucket``, or at ``end_effector`` without a bucket [kg].
        seed: Of the noise of the measured torques. What the arm hides never changes.

    Example:
        >>> arm = ConcealedArm()
        >>> reading = arm.reset(z1().default_pose)
        >>> arm.step(z1().default_pose).position.shape
        (7,)
    """

    rate = 1 / PERIOD
    """Commands and readings a second [Hz]."""

    def __init__(self, robot: Robot | None = None, payload: float = 0.0, seed: int = 0):
        robot = z1() if robot is None else robot
        if robot.base is not None or len(robot.joint_names) != len(SIZES) + 1:
            raise ValueError(
                f"the robot is {robot.name} with {len(robot.joint_names)} joints, but the concealed arm is a Z1 on a "
                "table: its dynamics would be another robot's. Give z1(), with or without a tool."
            )
        if not 0 <= payload < np.inf:
            raise ValueError(f"payload is {payload} kg, which no arm can hold. Give a mass of 0 or more.")
        self.robot, self.joint_names = robot, robot.joint_names
        hidden = np.random.default_rng(IDENTITY)
        self._drives = _drives(robot, hidden)
        self._torque_scale = hidden.uniform(0.92, 1.08, len(SIZES))
        self._delay = float(hidden.uniform(0.002, 0.005))
        self._current_noise = 0.005 * np.array(robot.torque_limit[:-1])
        self._tree, self._site_place, self._site_turn = bodies(robot, payload, hidden)
        self._limit, self._no_load = np.array(robot.torque_limit[:-1]), np.array(robot.velocity_limit[:-1])
        self._noise = np.random.default_rng(seed)
        self._room, self._slopes = workroom(len(SIZES)), np.zeros((5, len(SIZES), STATES))
        self.reset(robot.default_pose)

    def reset(self, pose: ArrayLike, kp: ArrayLike | None = None, kd: ArrayLike | None = None) -> Reading:
        """Put the arm at a pose, at rest, and let its drives hold it there for :data:`SETTLE`: it sags a little.

        Args:
            pose: [rad]. Shape (7,).
            kp: Of the drives [N·m/rad], the robot's own by default. Shape (7,).
            kd: [N·m·s/rad], likewise.
        """
        start = self._row("pose", pose)
        self._kp = self._row("kp", self.robot.kp if kp is None else kp)[:-1].copy()
        self._kd = self._row("kd", self.robot.kd if kd is None else kd)[:-1].copy()
        self._x = np.zeros((len(SIZES), STATES))
        self._x[:, POSITION] = self._x[:, ROTOR] = start[:-1]
        self._register = np.stack([np.round(start[:-1] / RESOLUTION) * RESOLUTION, np.zeros(len(SIZES))])
        self._last_target = start[:-1].copy()
        self._ticks = -round(SETTLE / PERIOD)
        self._run(np.tile(start, (-self._ticks, 1)))
        return self._reading()

    def step(self, target: ArrayLike) -> Reading:
        """Send a position target [rad], shape (7,), and say what the drives report 5 ms later."""
        self._run(self._row("target", target)[None])
        return self._reading()

    def stop(self) -> None:
        """Nothing to do: a simulated arm that is left alone hurts nobody."""

    def play(
        self,
        target: ArrayLike,
        start: ArrayLike | None = None,
        kp: ArrayLike | None = None,
        kd: ArrayLike | None = None,
    ) -> Recording:
        """Send a row of targets, one every 5 ms, from rest.

        Args:
            target: [rad]. Shape (T, 7).
            start: Pose to begin at, the first target by default. Shape (7,).
            kp: As in :meth:`reset`.
            kd: As in :meth:`reset`.

        Returns:
            T samples; each row was read just before its target was sent.
        """
        targets = np.asarray(target, dtype=np.float64)
        if targets.ndim != 2 or targets.shape[1] != len(self.joint_names):
            raise ValueError(f"target has shape {targets.shape}; give one row a command and 7 columns, (T, 7).")
        first = self.reset(targets[0] if start is None else start, kp, kd)
        rows = self._run(targets)
        torque = rows[:, 2] + self._current_noise * self._noise.normal(size=rows[:, 2].shape)
        torque[0] = first.torque[:-1]
        return Recording(
            time=PERIOD * np.arange(len(targets), dtype=np.float64),
            joint_names=self.joint_names,
            position=_with_gripper(rows[:, 0]),
            velocity=_with_gripper(rows[:, 1]),
            position_target=targets,
            kp=self._row("kp", self.robot.kp if kp is None else kp),
            kd=self._row("kd", self.robot.kd if kd is None else kd),
            torque_measured=_with_gripper(torque),
            torque_semantics="current_derived",
            metadata={"robot": self.robot.name},
        )

    def true_state(self) -> TrueState:
        """Where the links are. For scoring only: no real arm tells this."""
        q, v = self._x[:, POSITION], self._x[:, SPEED]
        position, rotation, velocity = _tip(self._tree, q, v, self._site_place)
        return TrueState(
            self._ticks * PERIOD,
            _with_gripper(q),
            _with_gripper(v),
            position,
            rotation @ self._site_turn,
            velocity,
        )

    def _run(self, targets: Array) -> Array:
        """Rows (position, velocity, torque) before each target. Shape (T, 3, 6)."""
        wanted = np.ascontiguousarray(targets[:, :-1])
        rows = np.empty((len(wanted), 3, wanted.shape[1]))
        play(
            self._tree, self._drives, self._x, self._register, self._last_target, wanted, self._kp, self._kd,
            self._limit, self._no_load, self._torque_scale, self._delay, self._room, self._slopes, rows,
        )  # fmt: skip
        if not np.isfinite(self._x).all():
            raise FloatingPointError(
                "the concealed arm's state is no longer finite: its integrator was driven beyond what 0.1 ms can "
                "follow. Use gains and targets of a real arm's size."
            )
        self._last_target = wanted[-1].copy()
        self._ticks += len(wanted)
        return rows

    def _reading(self) -> Reading:
        position = np.round(self._x[:, ROTOR] / RESOLUTION) * RESOLUTION
        torque = self._x[:, TORQUE] / self._torque_scale
        torque = torque + self._current_noise * self._noise.normal(size=torque.shape)
        return Reading(_with_gripper(position), _with_gripper(self._register[1]), _with_gripper(torque))

    def _row(self, name: str, value: ArrayLike) -> Array:
        row = np.asarray(value, dtype=np.float64)
        if row.shape != (len(self.joint_names),) or not np.isfinite(row).all():
            raise ValueError(
                f"{name} is {row}; give one finite number for each of {', '.join(self.joint_names)}, in this order."
            )
        return row


def bodies(robot: Robot, payload: float = 0.0, hidden: np.random.Generator | None = None) -> tuple[Tree, Array, Array]:
    """Six links in a row, with all that is fixed to the last one.

    Args:
        robot: A Z1.
        payload: Point mass at the site [kg].
        hidden: Of the errors of masses, centres and inertias; None for what the data sheet says.

    Returns:
        The links; place [m] and rotation of the site in the last link's frame. Shapes (3,) and (3, 3).
    """
    model = robot.model()
    joints = [model.joint(name).id for name in robot.joint_names[:-1]]
    links = [int(model.jnt_bodyid[j]) for j in joints]
    error = np.zeros((len(links) + 1, 5)) if hidden is None else hidden.normal(size=(len(links) + 1, 5))
    mass, first, inertia = np.zeros(len(links)), np.zeros((len(links), 3)), np.zeros((len(links), 3, 3))
    for body in range(1, model.nbody):
        owner, place, turn = _owner(model, body, links)
        if owner is None:
            continue
        own = body in links or model.body_jntnum[body] > 0  # a part of the arm, not a tool, which was weighed
        e = error[links.index(body) if body in links else -1] if own else np.zeros(5)
        m = model.body_mass[body] * (1.0 + 0.04 * e[0])
        frame = turn @ rotation(model.body_iquat[body])
        about = frame @ np.diag(model.body_inertia[body]) @ frame.T * (1.0 + 0.04 * e[0]) * (1.0 + 0.05 * e[4])
        _add(mass, first, inertia, owner, m, place + turn @ (model.body_ipos[body] + 0.003 * e[1:4]), about)
    name = "bucket" if mujoco.mj_name2id(model, mujoco.mjtObj.mjOBJ_SITE, "bucket") >= 0 else "end_effector"
    site = model.site(name)
    owner, place, turn = _owner(model, int(site.bodyid[0]), links)
    assert owner is not None
    site_place, site_turn = place + turn @ site.pos, turn @ rotation(site.quat)
    _add(mass, first, inertia, owner, payload, site_place, np.zeros((3, 3)))
    com = first / mass[:, None]
    central = np.stack([i - _point(m, c) for i, m, c in zip(inertia, mass, com, strict=True)])
    tree = Tree(
        parent=np.arange(-1, len(links) - 1),
        slide=np.zeros(len(links), dtype=np.bool_),
        axis=np.ascontiguousarray(model.jnt_axis[joints]),
        place=np.stack([_before(model, body) for body in links]),
        turn=np.stack([rotation(model.body_quat[body]) for body in links]),
        mass=mass,
        com=com,
        inertia=central,
        gravity=np.array(model.opt.gravity),
    )
    return tree, site_place, site_turn


def rotation(quaternion: Array) -> Array:
    """Rotation matrix of a unit quaternion w, x, y, z. Shape (3, 3)."""
    w, x, y, z = quaternion
    skew = np.array([[0.0, -z, y], [z, 0.0, -x], [-y, x, 0.0]])
    matrix: Array = np.eye(3) + 2.0 * w * skew + 2.0 * skew @ skew
    return matrix


def _owner(model: mujoco.MjModel, body: int, links: list[int]) -> tuple[int | None, Array, Array]:
    """Index of the link that a body is part of, and the body's place and rotation in the link's frame."""
    place, turn = np.zeros(3), np.eye(3)
    while body not in links:
        if body == 0:
            return None, place, turn
        there = rotation(model.body_quat[body])
        place, turn = model.body_pos[body] + there @ place, there @ turn
        body = int(model.body_parentid[body])
    return links.index(body), place, turn


def _before(model: mujoco.MjModel, body: int) -> Array:
    """Place of a link in the frame of the link before it; the first one's in the world, whose links do not turn."""
    place, parent = np.array(model.body_pos[body]), int(model.body_parentid[body])
    while parent != 0 and model.body_jntnum[parent] == 0:
        place = model.body_pos[parent] + place
        parent = int(model.body_parentid[parent])
    return place


def _add(mass: Array, first: Array, inertia: Array, link: int, m: float, com: Array, about_com: Array) -> None:
    """Add a body to a link; inertias are kept about the link's origin."""
    mass[link] += m
    first[link] += m * com
    inertia[link] += about_com + _point(m, com)


def _point(m: float, place: Array) -> Array:
    """Inertia of a point mass about the origin [kg·m²]. Shape (3, 3)."""
    matrix: Array = m * (place @ place * np.eye(3) - np.outer(place, place))
    return matrix


def _drives(robot: Robot, hidden: np.random.Generator) -> NDArray[np.void]:
    """Draw what each joint hides, per motor; two motors of one joint add up (the data sheet's torque tells).

    Ranges: friction and rotors as identified on drives of this size, 0.5 to 3.5 N·m and 0.3 to 2 N·m·s/rad, narrowed
    to their middle so that the joints are brothers; stiffness of the catalogue within 15 %; hysteresis of 1 to 3
    arcmin; load-dependent friction for efficiencies between 86 and 94 %.
    """
    joints = len(SIZES)
    motors = np.array(robot.torque_limit[:joints]) / robot.torque_limit[0]
    p = ideal(joints)
    p["rotor"] = motors * hidden.uniform(0.024, 0.06, joints)
    p["viscous"] = motors * hidden.uniform(0.7, 1.8, joints)
    p["coulomb"] = motors * hidden.uniform(1.5, 3.0, joints)
    p["load_coefficient"] = hidden.uniform(0.06, 0.14, joints)
    p["breakaway_ratio"] = hidden.uniform(1.2, 1.5, joints)
    p["stribeck_speed"] = hidden.uniform(0.05, 0.15, joints)
    p["bristle_stiffness"] = p["coulomb"] / hidden.uniform(0.5e-3, 1.5e-3, joints)
    figures = np.array([CATALOGUE[size] for size in SIZES]).T * motors
    scale = hidden.uniform(0.85, 1.15, joints)
    p["first_stiffness"], p["second_stiffness"], p["third_stiffness"] = figures[:3] * scale
    p["first_torque"], p["second_torque"] = figures[3:]
    width = ARCMIN * hidden.uniform(1.0, 3.0, joints)  # of the loop at zero torque
    p["hysteresis"] = 0.5 * width * p["first_stiffness"]
    p["hysteresis_stiffness"] = p["hysteresis"] / width
    p["gear_damping"] = 2.0 * hidden.uniform(0.02, 0.05, joints) * np.sqrt(p["first_stiffness"] * p["rotor"])
    p["lag"] = hidden.uniform(0.002, 0.004, joints)
    p["lowest"], p["highest"] = np.array(robot.position_limit[:joints]).T
    p["stop_stiffness"], p["stop_damping"] = 1500.0, 1500.0
    return p


def _with_gripper(rows: Array) -> Array:
    return np.concatenate([rows, np.zeros((*rows.shape[:-1], 1))], axis=-1)


def _tip(tree: Tree, q: Array, v: Array, place: Array) -> tuple[Array, Array, Array]:
    """Place, rotation and velocity of a point of the last link."""
    frame, origin = np.eye(3), np.zeros(3)
    axes, origins = [], []
    for j in range(len(q)):
        origin = origin + frame @ tree.place[j]
        half = 0.5 * q[j]
        frame = frame @ tree.turn[j] @ rotation(np.array([np.cos(half), *(np.sin(half) * tree.axis[j])]))
        axes.append(frame @ tree.axis[j])
        origins.append(origin)
    point = origin + frame @ place
    velocity = sum((v[j] * np.cross(axes[j], point - origins[j]) for j in range(len(q))), np.zeros(3))
    return point, frame, velocity
