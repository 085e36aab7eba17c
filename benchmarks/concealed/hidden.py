"""Draw an effect of a given severity, and put it into a robot: in the plain form to tune on, in a richer one to score.

Severity 0 to 3 runs from about the noise to gross. It is a share of the joint's typical torque for whatever makes a
torque, a time for delays, an angle for gaps. The parameters of a truth follow the conventions of the catalogue's names
(totals of the corrected model); where a law has no such parameter, it is left out.
"""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from benchmarks.concealed.laws import many_elements, no_elements, plain, single_element
from benchmarks.concealed.plant import Tree
from benchmarks.concealed.robots import Robot, turn, upright, with_point

Array = NDArray[np.float64]


@dataclass(frozen=True)
class Truth:
    """One piece of physics that the model lacks."""

    effect: str
    joint: str | None
    parameters: dict[str, float]
    """In the catalogue's conventions."""
    hidden: dict[str, float] = field(default_factory=dict)
    """What else the law needs."""


@dataclass(frozen=True, eq=False)
class Typical:
    """What the planned takes ask of the model, joint by joint. Shape (J,) each."""

    torque: Array
    """Root mean square [N·m]."""
    peak: Array
    """99.5 % quantile of its magnitude [N·m]."""
    weight: Array
    """Largest gravity torque [N·m]."""
    speed: Array
    """Root mean square [rad/s]."""
    top_speed: Array
    """99.5 % quantile [rad/s]."""
    low: Array
    """Lowest position [rad]."""
    high: Array
    inertia: Array
    """Diagonal of M at the centre, with rotors [kg·m²]."""


@dataclass(frozen=True, eq=False)
class Body:
    """The true robot in the making."""

    tree: Tree
    laws: NDArray[np.void]
    elements: Array
    gear_elements: Array
    clock: list[float]
    """[offset of the position stamps], one entry to write into [s]."""


def nominal_body(robot: Robot, tree: Tree) -> Body:
    """A robot without anything hidden; ``tree`` may err from the model's."""
    laws = plain(robot.joints)
    laws["armature"] = robot.armature
    laws["viscous_positive"] = laws["viscous_negative"] = robot.damping
    none = np.stack([no_elements()] * robot.joints)
    return Body(tree, laws, none, none.copy(), [0.0])


def _unit(robot: Robot, j: int) -> float:
    """Length that stands for a radian: 1 for a hinge, a share of the stroke for a slide."""
    return float(robot.reach[j] / 0.8) if robot.tree.slide[j] else 1.0


def _share(level: int, steps: tuple[float, float, float, float], rng: np.random.Generator) -> float:
    return float(steps[level] * np.exp(rng.uniform(-0.25, 0.25)))


TORQUE = (0.02, 0.06, 0.16, 0.40)


def draw(effect: str, robot: Robot, j: int, level: int, typical: Typical, true: Tree, rich: bool,
         rng: np.random.Generator) -> Truth:  # fmt: skip
    """An effect on joint ``j`` of severity 0..3.

    Args:
        effect: A name of the catalogue, or of :data:`OUTSIDE`.
        robot: The model.
        j: Index of the joint.
        level: 0..3.
        typical: Sets the scale.
        true: Bodies with their nuisance errors: totals start from these.
        rich: Whether the richer law is drawn.
        rng: Of everything.
    """
    t, peak, v = float(typical.torque[j]), float(typical.peak[j]), float(typical.speed[j])
    unit, sign = _unit(robot, j), float(rng.choice([-1.0, 1.0]))
    f = _share(level, TORQUE, rng)
    link = float(typical.inertia[j] - robot.armature[j])
    joint: str | None = robot.joint_names[j]
    rotor = float(robot.armature[j])
    reduced = rotor * link / (rotor + link)
    damping, range_ = float(robot.damping[j]), float(typical.high[j] - typical.low[j])
    presliding = unit * float(np.exp(rng.uniform(np.log(2e-4), np.log(1.5e-3))))
    p: dict[str, float] = {}
    h: dict[str, float] = {}
    match effect:
        case "coulomb_friction":
            p, h = {"torque": f * t}, {"presliding": presliding}
        case "viscous_friction":
            p = {"damping": damping + f * t / v}
            h = {"quadratic": 0.08 * f * t / v**2} if rich else {}
        case "stribeck_friction":
            ratio, speed = rng.uniform(1.5, 2.2), rng.uniform(0.08, 0.35) * v
            p = {"coulomb": f * t, "breakaway": f * t * ratio, "stribeck_speed": speed}
            h = {"presliding": presliding, "exponent": float(rng.uniform(0.8, 1.6)) if rich else 2.0}
        case "load_dependent_friction":
            p, h = {"coulomb": 0.3 * f * t, "coefficient": min(f, 0.45)}, {"presliding": presliding}
        case "asymmetric_friction":
            c, b = rng.uniform(0.3, 0.6) * sign, rng.uniform(0.0, 0.5) * sign
            p = {
                "coulomb_positive": f * t * (1 + c), "coulomb_negative": f * t * (1 - c),
                "viscous_positive": damping + 0.5 * f * t / v * (1 + b),
                "viscous_negative": damping + 0.5 * f * t / v * (1 - b),
            }  # fmt: skip
            h = {"presliding": presliding}
        case "hysteresis":
            width = float(unit * np.exp(rng.uniform(np.log(0.025), np.log(0.12))))
            p, h = ({"torque": f * t}, {"width": width}) if rich else ({"torque": f * t, "width": width}, {})
        case "compliance":
            windup = unit * _share(level, (0.002, 0.006, 0.016, 0.04), rng)
            k = max(t / windup, link * (2 * np.pi * 3.5) ** 2)
            p, h = {"stiffness": k}, {"damping": 2 * rng.uniform(0.02, 0.08) * float(np.sqrt(k * reduced))}
            if rich:
                h |= {"cubic": 0.3 * k * (k / peak) ** 2, "loss": 0.03 * t, "loss_width": 0.3 * t / k}
        case "backlash":
            gap = unit * _share(level, (0.003, 0.008, 0.02, 0.05), rng)
            k = max(t / (unit * 0.002), link * (2 * np.pi * 12) ** 2)
            p, h = {"gap": gap}, {"stiffness": k, "damping": 2 * rng.uniform(0.1, 0.3) * float(np.sqrt(k * reduced))}
            h["rounding"] = 0.06 * gap if rich else 0.0
        case "reflected_inertia":
            p = {"armature": rotor + link * _share(level, (0.05, 0.15, 0.4, 1.0), rng)}
        case "link_mass":
            more = _share(level, (0.08, 0.2, 0.45, 1.0), rng)
            p = {"mass": float(true.mass[j]) * (1 + more if sign > 0 else 1 / (1 + more))}
        case "link_com":
            more = _share(level, (0.08, 0.2, 0.4, 0.75), rng)
            at = float(np.linalg.norm(true.com[j]))
            p = {"distance": at * (1 + more if sign > 0 else 1 / (1 + more))}
        case "payload":
            p = {"mass": float(true.mass[j]) * _share(level, (0.05, 0.15, 0.4, 1.0), rng)}
        case "gravity_tilt":
            joint, angle = None, _share(level, (0.012, 0.03, 0.08, 0.2), rng)
            direction = rng.uniform(0, 2 * np.pi)
            p = {"roll": float(angle * np.cos(direction)), "pitch": float(angle * np.sin(direction))}
        case "actuation_delay":
            p = {"delay": _share(level, (0.0015, 0.003, 0.007, 0.015), rng)}
        case "actuation_lag":
            p = {"time_constant": _share(level, (0.0015, 0.004, 0.010, 0.025), rng)}
        case "torque_scale":
            more = _share(level, (0.05, 0.1, 0.2, 0.4), rng)
            p = {"scale": 1 + more if sign > 0 else 1 / (1 + more)}
        case "torque_offset":
            p = {"torque": sign * f * t}
        case "torque_saturation":
            p = {"limit": max(peak * _share(level, (0.95, 0.8, 0.6, 0.45), rng), 1.15 * float(typical.weight[j]))}
        case "speed_torque_limit":
            top, room = float(typical.top_speed[j]), (2.5, 1.7, 1.3, 1.05)[level]
            stall = max(peak * (1.2, 1.05, 0.95, 0.85)[level], 1.3 * float(typical.weight[j]))
            p = {"stall_torque": stall, "no_load_speed": top * room}
        case "torque_ripple":
            turns = float(rng.integers(6, 37)) if not robot.tree.slide[j] else float(rng.integers(20, 60))
            p = {"amplitude": 0.7 * f * t, "phase": float(rng.uniform(0, 2 * np.pi)), "periods_per_turn": turns}
        case "joint_spring":
            p = {"stiffness": 4 * f * t / range_, "rest": float(robot.centre[j] + rng.uniform(-0.3, 0.3) * range_)}
        case "joint_stop":
            share = (0.04, 0.1, 0.2, 0.35)[level]
            at = typical.high[j] - share * range_ if sign > 0 else typical.low[j] + share * range_
            p = {"position": float(at), "stiffness": float(rng.uniform(15, 50) * t / (0.2 * unit))}
            h = {"side": sign}
        case "encoder_offset":
            p = {"offset": sign * unit * _share(level, (0.008, 0.02, 0.05, 0.12), rng)}
        case "encoder_scale":
            more = _share(level, (0.01, 0.03, 0.07, 0.15), rng)
            p = {"scale": 1 + more if sign > 0 else 1 / (1 + more)}
        case "clock_offset":
            joint, p = None, {"offset": _share(level, (0.003, 0.006, 0.012, 0.025), rng)}
        case "gain_mismatch":
            more = _share(level, (0.06, 0.15, 0.3, 0.6), rng)
            kd = np.exp(rng.uniform(-1, 1) * np.log(1 + more))
            p = {"kp_scale": 1 + more if sign > 0 else 1 / (1 + more), "kd_scale": float(kd)}
        case "thermal_drift":
            p = {"amplitude": 1.5 * f * t, "time_constant": float(rng.uniform(5.0, 15.0))}
            h = {"presliding": presliding, "heat": 0.5 if rich else 0.0, "power": 1.5 * f * t * v}
        case "disturbance":
            p = {"torque": sign * _share(level, (0.15, 0.4, 1.0, 2.5), rng) * t, "start": float(rng.uniform(4.0, 14.0)),
                 "duration": float(rng.uniform(0.3, 1.5))}  # fmt: skip
            h = {"take": 1.0}
        case "position_dependent_friction":
            h = {"torque": 2 * f * t, "presliding": presliding, "periods": float(rng.uniform(3, 8)),
                 "phase": float(rng.uniform(0, 6))}  # fmt: skip
        case "detent_of_two_periods":
            n = float(rng.uniform(7, 14))
            h = {"first": 1.2 * f * t, "periods": n, "second": 0.9 * f * t, "second_periods": n * 1.618 * 1.4}
        case "drag":
            h = {"quadratic": 2 * f * t / v**2}
        case "dead_zone":
            h = {"dead_zone": 2 * f * t}
        case "cable":
            h = {"cubic": 14 * f * t / range_**3 * 2, "torque": 0.6 * f * t, "width": 0.1 * unit,
                 "stiffness": 2 * f * t / range_}  # fmt: skip
        case "torque_loop_resonance":
            h = {"frequency": 2 * np.pi * (60.0, 40.0, 26.0, 18.0)[level], "damping": float(rng.uniform(0.15, 0.3))}
        case "rubbing":
            h = {"torque": 4 * f * t, "period": float(rng.uniform(3, 7)), "at": float(robot.centre[j]), "side": sign}
        case "encoder_eccentricity":
            around = 1.0 if unit == 1.0 else float(np.pi / robot.reach[j])  # a slide's pinion turns once in its stroke
            wave = unit * _share(level, (0.004, 0.012, 0.03, 0.08), rng)
            h = {"wave": wave, "phase": float(rng.uniform(0, 6)), "periods": around}
        case _:
            raise ValueError(f"{effect!r} is not known; known are {', '.join((*EFFECTS, *OUTSIDE))}.")
    return Truth(effect, joint, {k: float(x) for k, x in p.items()}, {k: float(x) for k, x in h.items()})


OUTSIDE: dict[str, tuple[str, ...]] = {
    "position_dependent_friction": ("coulomb_friction", "hysteresis"),
    "detent_of_two_periods": ("torque_ripple",),
    "drag": ("viscous_friction",),
    "dead_zone": (),
    "cable": ("hysteresis", "joint_spring"),
    "torque_loop_resonance": ("actuation_lag", "actuation_delay"),
    "rubbing": ("coulomb_friction", "disturbance", "joint_stop"),
    "encoder_eccentricity": ("encoder_offset", "encoder_scale"),
}
"""Laws that the catalogue has no name for, with the names that are true of a part of each."""
OUTSIDE_TUNING = ("position_dependent_friction", "detent_of_two_periods", "drag", "dead_zone")
OUTSIDE_SEALED = tuple(OUTSIDE)

EFFECTS = (
    "coulomb_friction", "actuation_delay", "link_mass", "compliance", "torque_offset", "encoder_offset",
    "viscous_friction", "hysteresis", "torque_saturation", "payload", "backlash", "gain_mismatch", "stribeck_friction",
    "reflected_inertia", "torque_ripple", "joint_spring", "actuation_lag", "load_dependent_friction", "gravity_tilt",
    "speed_torque_limit", "asymmetric_friction", "torque_scale", "joint_stop", "clock_offset", "thermal_drift",
    "link_com", "encoder_scale", "disturbance",
)  # fmt: skip
"""All names of the catalogue, in the order in which cases are drawn: classes mixed."""


def eligible(effect: str, robot: Robot) -> list[int]:
    """Joints on which an effect can be told from every other one in principle; the rest is in ``unidentifiable``."""
    n, slide = robot.joints, robot.tree.slide
    hinges = [j for j in range(n) if not slide[j]]
    if effect == "encoder_offset":
        return [j for j in hinges if not upright(robot, j) and n > 1]
    if effect == "encoder_scale":
        return list(range(n)) if n > 1 else hinges
    if effect == "gravity_tilt":
        return [n - 1] if len(hinges) >= 2 else []
    if effect in ("link_mass", "link_com"):
        return [j for j in hinges if j > 0 or not upright(robot, j)]
    if effect == "payload":
        return [n - 1] if not slide[n - 1] else []
    if effect == "reflected_inertia":
        return hinges
    if effect == "clock_offset":
        return [0] if n > 1 else []
    return list(range(n))


def conceal(body: Body, robot: Robot, truth: Truth, rich: bool, rng: np.random.Generator) -> Body:
    """Add one more piece of physics to a robot. Fields of ``body.laws`` are written in place."""
    p, h = truth.parameters, truth.hidden
    j = robot.joint_names.index(truth.joint) if truth.joint is not None else 0
    law = body.laws[j]
    tree = body.tree

    def dry(torque: float) -> None:
        """Asperities that stick up to ``torque``."""
        presliding = h["presliding"]
        body.elements[j] = many_elements(torque, presliding, rng) if rich else single_element(torque, presliding)
        inertia = float(robot.mass_matrix(robot.centre)[j, j])
        law["micro_damping"] += 0.3 * np.sqrt(torque / presliding * inertia)
        law["slip_rate"] = 400.0 if rich else np.inf

    match truth.effect:
        case "coulomb_friction":
            law["coulomb_positive"] = law["coulomb_negative"] = p["torque"]
            dry(p["torque"])
        case "viscous_friction":
            law["viscous_positive"] = law["viscous_negative"] = p["damping"]
            law["quadratic"] = h.get("quadratic", 0.0)
        case "stribeck_friction":
            law["coulomb_positive"] = law["coulomb_negative"] = p["coulomb"]
            law["breakaway_ratio"] = p["breakaway"] / p["coulomb"]
            law["stribeck_speed"], law["stribeck_exponent"] = p["stribeck_speed"], h["exponent"]
            dry(p["breakaway"])
        case "load_dependent_friction":
            law["coulomb_positive"] = law["coulomb_negative"] = p["coulomb"]
            law["load_coefficient"] = p["coefficient"]
            dry(4 * p["coulomb"])
        case "asymmetric_friction":
            for name, value in p.items():
                law[name] = value
            dry(0.5 * (p["coulomb_positive"] + p["coulomb_negative"]))
        case "hysteresis":
            law["hysteresis"] = p["torque"]
            law["hysteresis_width"] = p.get("width", h.get("width", 1.0))
            if rich:
                body.gear_elements[j] = many_elements(p["torque"], h["width"], rng, count=5)
        case "compliance":
            law["stiffness"], law["gear_damping"] = p["stiffness"], h["damping"]
            law["stiffness_cubic"] = h.get("cubic", 0.0)
            law["gear_loss"], law["gear_loss_width"] = h.get("loss", 0.0), h.get("loss_width", 1.0)
        case "backlash":
            law["gap"], law["stiffness"], law["gear_damping"] = p["gap"], h["stiffness"], h["damping"]
            law["rounding"] = h["rounding"]
        case "reflected_inertia":
            law["armature"] = p["armature"]
        case "link_mass":
            mass, inertia = tree.mass.copy(), tree.inertia.copy()
            inertia[j] *= p["mass"] / mass[j]
            mass[j] = p["mass"]
            tree = tree._replace(mass=mass, inertia=inertia)
        case "link_com":
            com = tree.com.copy()
            com[j] *= p["distance"] / np.linalg.norm(com[j])
            tree = tree._replace(com=com)
        case "payload":
            tree = with_point(tree, j, p["mass"], robot.tip[j])
        case "gravity_tilt":
            down = turn(np.array([0.0, 1, 0]), p["pitch"]) @ turn(np.array([1.0, 0, 0]), p["roll"]) @ tree.gravity
            tree = tree._replace(gravity=down)
        case "actuation_delay":
            law["delay"] = p["delay"]
        case "actuation_lag":
            law["lag"] = p["time_constant"]
            if rich:  # a part of it is a well damped second-order loop
                law["lag"] *= 0.85
                law["loop_frequency"], law["loop_damping"] = 2.0 / (0.15 * p["time_constant"]), 1.0
        case "torque_scale":
            law["scale"] = p["scale"]
        case "torque_offset":
            law["offset"] = p["torque"]
        case "torque_saturation":
            law["saturation"] = p["limit"]
            law["saturation_order"] = 20.0 if rich else np.inf
        case "speed_torque_limit":
            law["stall_torque"], law["no_load_speed"] = p["stall_torque"], p["no_load_speed"]
            law["speed_bend"] = 0.15 if rich else 0.0
        case "torque_ripple":
            law["ripple"], law["ripple_phase"] = p["amplitude"], p["phase"]
            law["ripple_periods"] = p["periods_per_turn"]
            if rich:
                law["ripple_second"], law["ripple_second_periods"] = 0.12 * p["amplitude"], 2 * p["periods_per_turn"]
        case "joint_spring":
            law["spring"], law["spring_rest"] = p["stiffness"], p["rest"]
            near = abs(p["rest"] - robot.centre[j]) < robot.reach[j]  # a far one pulls alike everywhere, cubed it tears
            law["spring_cubic"] = 0.1 * p["stiffness"] / robot.reach[j] ** 2 if rich and near else 0.0
        case "joint_stop":
            law["stop_position"], law["stop_side"], law["stop_stiffness"] = p["position"], h["side"], p["stiffness"]
            law["stop_damping"] = 0.5 * p["stiffness"]
            law["stop_power"] = 1.0
        case "encoder_offset":
            law["encoder_offset"] = p["offset"]
        case "encoder_scale":
            law["encoder_scale"] = p["scale"]
        case "clock_offset":
            body.clock[0] = p["offset"]
        case "gain_mismatch":
            law["kp_scale"], law["kd_scale"] = p["kp_scale"], p["kd_scale"]
        case "thermal_drift":
            law["cold"], law["cold_time"] = p["amplitude"], p["time_constant"]
            law["cold_heat"], law["cold_power"] = h["heat"], h["power"]
            dry(p["amplitude"])
        case "disturbance":
            law["pulse"], law["pulse_start"], law["pulse_duration"] = p["torque"], p["start"], p["duration"]
            law["pulse_take"] = h["take"]
        case "position_dependent_friction":
            law["coulomb_positive"] = law["coulomb_negative"] = h["torque"]
            law["friction_ripple"], law["friction_periods"], law["friction_phase"] = 0.95, h["periods"], h["phase"]
            dry(h["torque"])
        case "detent_of_two_periods":
            law["ripple"], law["ripple_periods"] = h["first"], h["periods"]
            law["ripple_second"], law["ripple_second_periods"] = h["second"], h["second_periods"]
        case "drag":
            law["quadratic"] = h["quadratic"]
        case "dead_zone":
            law["dead_zone"] = h["dead_zone"]
        case "cable":
            law["spring"], law["spring_rest"], law["spring_cubic"] = h["stiffness"], robot.centre[j], h["cubic"]
            law["hysteresis"], law["hysteresis_width"] = h["torque"], h["width"]
            body.gear_elements[j] = many_elements(h["torque"], h["width"], rng, count=5)
        case "torque_loop_resonance":
            law["loop_frequency"], law["loop_damping"] = h["frequency"], h["damping"]
        case "rubbing":
            law["rub"], law["rub_period"] = h["torque"], h["period"]
            law["stop_position"], law["stop_side"] = h["at"], h["side"]
        case "encoder_eccentricity":
            law["encoder_wave"], law["encoder_wave_phase"] = h["wave"], h["phase"]
            law["encoder_wave_periods"] = h["periods"]
    return Body(tree, body.laws, body.elements, body.gear_elements, body.clock)
