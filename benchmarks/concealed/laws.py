"""What one joint of a concealed robot obeys: from the command to the torque, along the gear, and back to the encoder.

Every number of a joint stands in one record, so that compiled code reads it by name. A record of :func:`plain` is a
rigid joint with viscous friction and nothing else; the drawing of cases changes some of its fields.
"""

from __future__ import annotations

from math import inf

import numpy as np
from numba import njit
from numpy.typing import NDArray

Array = NDArray[np.float64]

ELEMENTS = 6
"""Most Maxwell elements of a joint: the friction of the motor side, or the hysteresis, is split among them."""

FIELDS: dict[str, float] = {
    # from the command to the torque at the rotor
    "dead_zone": 0.0,  # [N·m] commands below it do nothing
    "delay": 0.0,  # [s]
    "lag": 0.0,  # [s] first order
    "loop_frequency": 0.0,  # [rad/s] of a torque loop of second order; 0 for none
    "loop_damping": 1.0,
    "scale": 1.0,
    "offset": 0.0,  # [N·m]
    "saturation": inf,  # [N·m]
    "saturation_order": inf,  # how sharp the corner is; inf for a kink
    "stall_torque": inf,  # [N·m]
    "no_load_speed": inf,  # [rad/s]
    "speed_bend": 0.0,  # 0 for a straight line, 1 for a parabola between stall and no load
    "ripple": 0.0,  # [N·m]
    "ripple_periods": 1.0,  # per turn
    "ripple_phase": 0.0,
    "ripple_second": 0.0,  # [N·m]
    "ripple_second_periods": 1.0,
    "ripple_second_phase": 0.0,
    "kp_scale": 1.0,
    "kd_scale": 1.0,
    # friction at the rotor
    "viscous_positive": 0.0,  # [N·m·s/rad]
    "viscous_negative": 0.0,
    "quadratic": 0.0,  # [N·m·s²/rad²]
    "coulomb_positive": 0.0,  # [N·m]
    "coulomb_negative": 0.0,
    "breakaway_ratio": 1.0,  # static level over sliding level
    "stribeck_speed": 1.0,  # [rad/s]
    "stribeck_exponent": 2.0,
    "load_coefficient": 0.0,  # friction per transmitted torque
    "friction_ripple": 0.0,  # share by which friction changes with position
    "friction_periods": 1.0,  # per turn
    "friction_phase": 0.0,
    "cold": 0.0,  # [N·m] more friction when cold
    "cold_time": 1.0,  # [s]
    "cold_heat": 0.0,  # 0: fades with time; 1: fades with the heat of friction, at cold_power
    "cold_power": 1.0,  # [W] at which it fades within cold_time
    "micro_damping": 0.0,  # [N·m·s/rad] while sticking
    "slip_rate": inf,  # [1/s] at which slipping asperities forget; inf at once
    # hysteresis at the rotor
    "hysteresis": 0.0,  # [N·m]
    "hysteresis_width": 1.0,  # [rad] exponential (Dahl) when there are no elements
    # gear
    "armature": 0.0,  # [kg·m²] rotor, seen at the joint
    "stiffness": inf,  # [N·m/rad]
    "stiffness_cubic": 0.0,  # [N·m/rad³]
    "gear_damping": 0.0,  # [N·m·s/rad]
    "gap": 0.0,  # [rad] total
    "rounding": 0.0,  # [rad] over which a flank takes hold
    "gear_loss": 0.0,  # [N·m] of the flexspline's own hysteresis
    "gear_loss_width": 1.0,  # [rad]
    # at the link
    "spring": 0.0,  # [N·m/rad]
    "spring_rest": 0.0,  # [rad]
    "spring_cubic": 0.0,  # [N·m/rad³]
    "stop_position": 0.0,  # [rad]
    "stop_side": 0.0,  # +1 above, -1 below, 0 none
    "stop_stiffness": 0.0,
    "stop_damping": 0.0,
    "stop_power": 1.0,  # torque grows with penetration to this power
    "rub": 0.0,  # [N·m] friction of something touched beyond stop_position in windows of time
    "rub_period": 1.0,  # [s]
    "pulse": 0.0,  # [N·m]
    "pulse_start": 0.0,  # [s]
    "pulse_duration": 1.0,  # [s]
    "pulse_take": -1.0,
    # encoder, on the motor's side
    "encoder_scale": 1.0,
    "encoder_offset": 0.0,  # [rad]
    "encoder_wave": 0.0,  # [rad] by eccentricity
    "encoder_wave_phase": 0.0,
    "encoder_wave_periods": 1.0,  # per turn
}  # fmt: skip

JOINT = np.dtype([(name, np.float64) for name in FIELDS])


def plain(joints: int) -> NDArray[np.void]:
    """Rigid joints without any friction. Shape (J,)."""
    out = np.zeros(joints, dtype=JOINT)
    for name, value in FIELDS.items():
        out[name] = value
    return out


def no_elements() -> Array:
    """No dry friction. Columns are shares of the friction, and stiffness [N·m/rad]. Shape (E, 2)."""
    return np.zeros((ELEMENTS, 2))


def single_element(torque: float, presliding: float) -> Array:
    """One Maxwell element, which slips at ``torque`` [N·m] after ``presliding`` [rad]. Shape (E, 2)."""
    out = no_elements()
    out[0] = 1.0, torque / presliding
    return out


def many_elements(torque: float, presliding: float, rng: np.random.Generator, count: int = 4) -> Array:
    """Elements that slip one after the other, from a quarter of ``presliding`` to twice of it. Shape (E, 2)."""
    out = no_elements()
    out[:count, 0] = rng.dirichlet(np.full(count, 6.0))
    out[:count, 1] = out[:count, 0] * torque / (presliding * np.geomspace(0.25, 2.0, count))
    return out


@njit(cache=True)
def drive_torque(p, wanted, position, speed):  # type: ignore[no-untyped-def]
    """Torque at the rotor of what the torque loop was left with [N·m]."""
    u = p.scale * wanted + p.offset
    if p.saturation < np.inf:
        if p.saturation_order < np.inf:
            u /= (1.0 + abs(u / p.saturation) ** p.saturation_order) ** (1.0 / p.saturation_order)
        else:
            u = min(max(u, -p.saturation), p.saturation)
    if p.stall_torque < np.inf:
        forward = min(max(speed / p.no_load_speed, 0.0), 1.0)
        backward = min(max(-speed / p.no_load_speed, 0.0), 1.0)
        upper = p.stall_torque * (1.0 - forward) * (1.0 + p.speed_bend * forward)
        lower = -p.stall_torque * (1.0 - backward) * (1.0 + p.speed_bend * backward)
        u = min(max(u, lower), upper)
    if p.ripple != 0.0:
        u += p.ripple * np.sin(p.ripple_periods * position + p.ripple_phase)
    if p.ripple_second != 0.0:
        u += p.ripple_second * np.sin(p.ripple_second_periods * position + p.ripple_second_phase)
    return u


@njit(cache=True)
def friction_level(p, position, speed, load, cold):  # type: ignore[no-untyped-def]
    """Torque at which the asperities slip, in the direction of motion [N·m]."""
    level = p.coulomb_positive if speed >= 0 else p.coulomb_negative
    level += p.load_coefficient * abs(load) + p.cold * cold
    if p.breakaway_ratio != 1.0:
        level *= 1.0 + (p.breakaway_ratio - 1.0) * np.exp(-(abs(speed / p.stribeck_speed) ** p.stribeck_exponent))
    if p.friction_ripple != 0.0:
        level *= 1.0 + p.friction_ripple * np.sin(p.friction_periods * position + p.friction_phase)
    return max(level, 0.0)


@njit(cache=True)
def maxwell_slip(elements, state, moved, speed, level, slip_rate, damping, h):  # type: ignore[no-untyped-def]
    """Generalised Maxwell slip, driven by displacement: dry friction torque [N·m].

    Each element is a spring that slips at its share of the level; slipping, it follows a falling level at a finite
    rate. While it sticks it is damped a little, and never bears more than its share.

    Source:
        Al-Bender, Lampaert, Swevers 2005, IEEE Trans. Automatic Control 50(11), eq. 8-11.
    """
    total = 0.0
    for i in range(elements.shape[0]):
        share = elements[i, 0]
        if share == 0.0:
            continue
        limit = share * level
        force = state[i] + elements[i, 1] * moved
        if abs(force) > limit:
            edge = limit if force > 0 else -limit
            if slip_rate < np.inf and abs(state[i]) > limit and state[i] * force > 0:
                force = edge + (state[i] - edge) * np.exp(-slip_rate * h)
            else:
                force = edge
            total += force
        else:
            total += min(max(force + share * damping * speed, -limit), limit)
        state[i] = force
    return total


@njit(cache=True)
def dahl(z, moved, width):  # type: ignore[no-untyped-def]
    """Bristle in -1..1 that follows displacement with an exponential memory, exactly, after ``moved`` [rad]."""
    if moved == 0.0:
        return z
    side = 1.0 if moved > 0 else -1.0
    return side + (z - side) * np.exp(-abs(moved) / width)


@njit(cache=True)
def flank(p, windup):  # type: ignore[no-untyped-def]
    """Wind-up beyond the gap [rad]: half of it is lost on either side, with a rounded edge."""
    half = 0.5 * p.gap
    if half == 0.0:
        return windup
    if p.rounding == 0.0:
        return max(windup - half, 0.0) + min(windup + half, 0.0)
    r = p.rounding
    return 0.5 * (np.sqrt((windup - half) ** 2 + r * r) - np.sqrt((windup + half) ** 2 + r * r)) + windup


@njit(cache=True)
def link_torque(p, position, speed, time, take):  # type: ignore[no-untyped-def]
    """What pulls at the link beside the gear: spring, stop, something it rubs against, a push [N·m]."""
    away = position - p.spring_rest
    torque = -p.spring * away - p.spring_cubic * away**3
    if p.stop_side != 0.0:
        depth = p.stop_side * (position - p.stop_position)
        if depth > 0.0:
            if p.stop_stiffness > 0.0:
                push = p.stop_stiffness * depth**p.stop_power + p.stop_damping * depth * p.stop_side * speed
                torque -= p.stop_side * max(push, 0.0)
            if p.rub != 0.0 and (time / p.rub_period) % 1.0 < 0.4:
                torque -= p.rub * np.tanh(speed / 0.02)
    if p.pulse != 0.0 and take == p.pulse_take and 0.0 <= time - p.pulse_start < p.pulse_duration:
        torque += p.pulse
    return torque


@njit(cache=True)
def encoder(p, position):  # type: ignore[no-untyped-def]
    """What the encoder would read without noise and steps [rad]."""
    reading = p.encoder_scale * position + p.encoder_offset
    if p.encoder_wave != 0.0:
        reading += p.encoder_wave * np.sin(p.encoder_wave_periods * position + p.encoder_wave_phase)
    return reading


@njit(cache=True)
def encoder_gain(p, position):  # type: ignore[no-untyped-def]
    """Read speed over true speed [1]."""
    n = p.encoder_wave_periods
    return p.encoder_scale + n * p.encoder_wave * np.cos(n * position + p.encoder_wave_phase)
