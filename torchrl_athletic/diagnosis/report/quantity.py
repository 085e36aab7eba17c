"""Numbers for people: sensible digits, a unit at a readable scale, intervals that share both."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence

from torchrl_athletic.diagnosis.result import Answer, Estimate, RegimeMap

_PREFIXED = {  # unit -> (lower limit of its use, factor, name), the largest first
    "rad": ((0.1, 1.0, "rad"), (1e-4, 1e3, "mrad"), (0.0, 1e6, "µrad")),
    "m": ((0.1, 1.0, "m"), (1e-4, 1e3, "mm"), (0.0, 1e6, "µm")),
    "s": ((0.1, 1.0, "s"), (1e-4, 1e3, "ms"), (0.0, 1e6, "µs")),
    "kg": ((0.1, 1.0, "kg"), (0.0, 1e3, "g")),
}
_SUPERSCRIPT = str.maketrans("-0123456789", "⁻⁰¹²³⁴⁵⁶⁷⁸⁹")


def readable(unit: str, largest: float) -> tuple[float, str]:
    """Factor and unit name that bring ``largest`` [unit] to a readable size.

    Example:
        >>> readable("rad", 0.022), readable("kg·m²", 7.66e-5), readable("1", 0.9)
        ((1000.0, 'mrad'), (1000000.0, '×10⁻⁶ kg·m²'), (1.0, ''))
    """
    name = "" if unit == "1" else unit
    if not math.isfinite(largest) or largest == 0:
        return 1.0, name
    largest = abs(largest)
    if unit in _PREFIXED:
        _, factor, name = next(row for row in _PREFIXED[unit] if largest >= row[0])
        return factor, name
    if 1e-3 <= largest < 1e5:
        return 1.0, name
    exponent = 3 * math.floor(math.log10(largest) / 3)
    return 10.0**-exponent, f"×10{str(exponent).translate(_SUPERSCRIPT)} {name}".rstrip()


def number(value: float, digits: int = 3) -> str:
    """``value`` with so many significant digits, never in exponent form.

    Example:
        >>> number(240.424), number(-3.1648), number(0.0021), number(1234.6)
        ('240', '−3.16', '0.00210', '1235')
    """
    return _fixed(value, max(0, digits - 1 - _magnitude(value)))


def quantity(value: float, unit: str, digits: int = 3) -> str:
    """One value with its unit.

    Example:
        >>> quantity(0.0225, "rad"), quantity(0.025, "s"), quantity(20.144, "N")
        ('22.5 mrad', '25.0 ms', '20.1 N')
    """
    factor, name = readable(unit, value)
    return f"{number(value * factor, digits)} {name}".rstrip()


def quantities(values: Sequence[float], unit: str) -> tuple[list[str], str]:
    """Several values at the scale of their geometric mean, and the name of their common unit.

    They share the decimals that give the largest three digits; a value that this would round away keeps one digit.

    Example:
        >>> quantities([0.296, 0.022, 0.003], "rad"), quantities([7.5e-3, 4.1e-3, 2.1e-6], "m")
        ((['296', '22', '3'], 'mrad'), (['7.50', '4.10', '0.002'], 'mm'))
    """
    logs = [math.log(abs(v)) for v in values if v and math.isfinite(v)]
    factor, name = readable(unit, math.exp(sum(logs) / len(logs)) if logs else 0.0)
    largest = max((abs(v) for v in values if math.isfinite(v)), default=0.0) * factor
    decimals = max(0, 2 - _magnitude(largest))
    return [_fixed(v * factor, max(decimals, -_magnitude(v * factor))) for v in values], name


def estimate(parameter: Estimate) -> tuple[str, str, str, str]:
    """Value, lower and upper end, and unit; as many decimals as two digits of the half width ask for.

    Example:
        >>> estimate(Estimate(166.706, (163.24, 170.11), "N·s/m"))
        ('166.7', '163.2', '170.1', 'N·s/m')
    """
    ends = (parameter.value, *parameter.ci95)
    factor, name = readable(parameter.unit, max((abs(v) for v in ends if math.isfinite(v)), default=0.0))
    half = abs(parameter.ci95[1] - parameter.ci95[0]) / 2 * factor
    scale = half if math.isfinite(half) and half > 0 else parameter.value * factor / 10
    # an interval of a millionth of the value would print digits that nobody reads
    decimals = min(1 - _magnitude(scale), 5 - _magnitude(parameter.value * factor))
    value, low, high = (_fixed(v * factor, decimals) for v in ends)
    return value, low, high, name


CHOSEN = frozenset({"side", "take", "turnover"})
"""Parameters that name a case instead of measuring something: they have no interval."""


def percent(share: float) -> str:
    """A share 0..1 in percent; a probability never reads as certainty.

    Example:
        >>> percent(0.97), percent(0.9987), percent(0.003), percent(0.0)
        ('97 %', '> 99 %', '< 1 %', '0 %')
    """
    if not math.isfinite(share):
        return "–"
    if 0.995 <= share < 1:
        return "> 99 %"
    if 0 < share < 0.005:
        return "< 1 %"
    return _fixed(100 * share, 0) + " %"


def share_closed(before: float, after: float, floor: float) -> float:
    """(before - after) / (before - floor), NaN where there was no gap to close."""
    return (before - after) / (before - floor) if before > floor else math.nan


def joint_units(answer: Answer, maps: Sequence[RegimeMap] = ()) -> dict[str, str]:
    """Position unit of each joint: as ``quality["units"]`` states, else m where the map is in newtons, else rad."""
    stated: Mapping[str, str] = answer.quality.get("units", {})
    pushed = {m.joint for m in maps if m.torque_unit == "N"}
    joints = dict.fromkeys(joint for score in answer.fit.values() for joint in score.per_joint)
    joints.update(dict.fromkeys(m.joint for m in maps))
    return {joint: stated.get(joint, "m" if joint in pushed else "rad") for joint in joints}


def _magnitude(value: float) -> int:
    return math.floor(math.log10(abs(value))) if value and math.isfinite(value) else 0


def _fixed(value: float, decimals: int) -> str:
    if not math.isfinite(value):
        return "–"
    text = f"{round(value, decimals):.{max(decimals, 0)}f}"
    return text.replace("-", "−") if float(text) else text.removeprefix("-")
