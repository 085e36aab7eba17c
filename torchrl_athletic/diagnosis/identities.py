"""Findings and rivals that state the same physics as other names do: one answer, with all of its names."""

from __future__ import annotations

from collections.abc import Callable, Collection, Mapping, Sequence
from dataclasses import replace

from torchrl_athletic.diagnosis.result import Estimate, Finding, Name, Rival
from torchrl_athletic.effects import Effect

Values = Mapping[str, Estimate]


def with_alternatives(
    findings: Sequence[Finding], joints: Sequence[str], catalogue: Sequence[Effect], damped: Collection[str] = ()
) -> tuple[Finding, ...]:
    """Add to each finding the rivals that no recording can tell from it.

    What an effect declares in ``identical_to`` holds where its values make it so: friction by direction is dry friction
    with an offset only as long as its viscous part is the same both ways, only a clock that is late is a delay, gains
    are a torque's scale if both are off by one factor, and viscous friction if kd alone is too large, and always the
    same.

    Args:
        findings: As stated.
        joints: Of the robot: a delay is a clock's offset where all of them have it.
        catalogue: Of the diagnosis, as far as its effects apply to the recordings.
        damped: Joints that follow their targets with one kd, above zero, in all recordings.

    Example:
        >>> from torchrl_athletic.effects import CATALOGUE
        >>> late = Finding("actuation_delay", "disk", 0.9, "", {"delay": Estimate(0.025, (0.024, 0.026), "s")}, "")
        >>> with_alternatives([late], ["disk"], CATALOGUE)[0].alternatives
        ((Name(effect='clock_offset', joint=None),),)
        >>> with_alternatives([late], ["disk", "lever"], CATALOGUE)[0].alternatives
        ()
    """
    return tuple(
        replace(
            f,
            alternatives=_alternatives(f, findings, joints, catalogue, damped),
            rivals=tuple(replace(r, alternatives=_of_rival(r, f, joints, catalogue, damped)) for r in f.rivals),
        )
        for f in findings
    )


def _of_rival(
    rival: Rival, f: Finding, joints: Sequence[str], catalogue: Sequence[Effect], damped: Collection[str]
) -> tuple[tuple[Name, ...], ...]:
    """Single names that are a rival's own at any values, and not the finding's."""
    alone = Finding(rival.effect, rival.joint, rival.probability, "", {}, "")
    same = _alternatives(alone, [alone], joints, catalogue, damped)
    return tuple(names for names in same if len(names) == 1 and names[0] != Name(f.effect, f.joint))


def _alternatives(
    f: Finding,
    findings: Sequence[Finding],
    joints: Sequence[str],
    catalogue: Sequence[Effect],
    damped: Collection[str],
) -> tuple[tuple[Name, ...], ...]:
    same = _declared(f, joints, {effect.name: effect for effect in catalogue})
    same += [(Name(whole.name, _joint(whole, f)),) for whole in catalogue if _is_part(f, whole, findings, joints)]
    told = [names for names in same if f.joint not in damped and _DAMPING <= {f.effect, *(n.effect for n in names)}]
    return tuple(names for names in same if names not in told)


def _declared(f: Finding, joints: Sequence[str], known: Mapping[str, Effect]) -> list[tuple[Name, ...]]:
    if f.effect not in known:
        return []
    where = joints if f.joint is None else [f.joint]
    beside = {"viscous_friction"} if f.effect == "asymmetric_friction" and _damps(f.parameters) else set()
    return [
        tuple(Name(n, joint) for joint in where for n in sorted(set(names) | beside))
        for names in known[f.effect].identical_to
        if names <= known.keys() and _holds(f, names)
    ]


def _is_part(f: Finding, whole: Effect, findings: Sequence[Finding], joints: Sequence[str]) -> bool:
    """Whether the findings, this one among them, add up to another effect."""
    where = joints if whole.whole_robot else [f.joint]
    for names in whole.identical_to:
        parts = [g for g in findings if g.effect in names and g.joint in where]
        if not all(_holds(g, {whole.name}) for g in parts):
            continue
        damps = whole.name == "asymmetric_friction" and f.effect == "viscous_friction"
        if (f in parts or damps) and len({(g.effect, g.joint) for g in parts}) == len(names) * len(where):
            if not whole.whole_robot or len(parts) == 1:
                return True
            return all(g.parameters for g in parts) and _agree([e for g in parts for e in g.parameters.values()])
    return False


def _holds(f: Finding, others: Collection[str]) -> bool:
    """Whether the finding's values make it the same as the others; without values, whether all of them do."""
    conditions = [_HOLDS[f.effect, other] for other in others if (f.effect, other) in _HOLDS]
    return all(bool(f.parameters) and holds(f.parameters) for holds in conditions)


def _joint(effect: Effect, f: Finding) -> str | None:
    return None if effect.whole_robot else f.joint


def _agree(estimates: Sequence[Estimate]) -> bool:
    """Whether one value lies in all intervals."""
    return max(e.ci95[0] for e in estimates) <= min(e.ci95[1] for e in estimates)


def _same_both_ways(values: Values) -> bool:
    sides = [values[name] for name in ("viscous_positive", "viscous_negative") if name in values]
    return len(sides) == 2 and _agree(sides)


def _damps(values: Values) -> bool:
    """Whether friction grows with the speed, which dry friction and an offset alone do not."""
    return any(values[name].ci95[0] > 0 for name in ("viscous_positive", "viscous_negative") if name in values)


def _only_kd(values: Values) -> bool:
    """Whether kp may be the logged one, and kd is too large: a loop that damps more than it should."""
    if not {"kp_scale", "kd_scale"} <= values.keys():
        return False
    low, high = values["kp_scale"].ci95
    return low <= 1.0 <= high and values["kd_scale"].value > 1.0


_DAMPING = frozenset({"gain_mismatch", "viscous_friction"})
"""What a loop cannot tell apart until its kd changes."""
_HOLDS: Mapping[tuple[str, str], Callable[[Values], bool]] = {
    ("asymmetric_friction", "coulomb_friction"): _same_both_ways,
    ("clock_offset", "actuation_delay"): lambda values: values["offset"].value >= 0,
    ("gain_mismatch", "torque_scale"): lambda values: _agree(list(values.values())),
    ("gain_mismatch", "viscous_friction"): _only_kd,
}
"""Effect and another one -> whether they are the same at the first one's values."""
