"""The answer as one page that loads nothing: text and tables by a template, figures as inline SVG."""

from __future__ import annotations

import math
import os
import re
from collections.abc import Mapping, Sequence
from importlib import resources
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from torchrl_athletic.diagnosis.report.figures import (
    fit_figure,
    force_word,
    overlay_figure,
    regime_figure,
    svg,
    torque_limit,
    why_figure,
)
from torchrl_athletic.diagnosis.report.quantity import (
    CHOSEN,
    estimate,
    joint_units,
    percent,
    quantities,
    quantity,
    share_closed,
)
from torchrl_athletic.diagnosis.report.robot import robot_svg
from torchrl_athletic.diagnosis.report.shares import NAMES, energy_shares
from torchrl_athletic.diagnosis.report.telling import (
    by_telling,
    first_map,
    joint_order,
    map_of,
    rms,
    telling_overlays,
    telling_window,
)
from torchrl_athletic.diagnosis.report.words import (
    IF_KNOWN,
    banners,
    besides,
    bridged_readings,
    go_on,
    grounds_words,
    joints_and_regimes,
    lead,
    next_takes,
    of_class,
    place,
    same_as,
    title,
    unexplained,
    verdict_words,
    words,
    would_change,
)
from torchrl_athletic.diagnosis.result import Answer, Overlay, RegimeMap, Score
from torchrl_athletic.effects import CATALOGUE
from torchrl_athletic.recordings.whole_file import whole_file

if TYPE_CHECKING:
    import mujoco
    from markupsafe import Markup

MOST_TRACKS = 6  # of the fit figure
MOST_WHYS = 4  # drawn large, one a finding
MOST_MAPS = 24  # drawn; a figure costs about 0.1 s and 5 kB
MOST_OVERLAYS = 8
MOST_JOINTS = 4  # of one recording
_BEFORE_UNIT = re.compile(r"(?<=\d) (?=%|(?:[mµ]?rad|[mµ]?s|[mµ]?m|N·m|N|kg|Hz)\b)")
COMMAND_FILE = "next_experiment.npz"


def write_report(
    answer: Answer,
    maps: Sequence[RegimeMap],
    overlays: Sequence[Overlay],
    path: str | os.PathLike[str],
    model: mujoco.MjModel | None = None,
    experiment: str = "",
    payload: float = 0.0,
) -> Path:
    """Write the page that shows ``answer``: one self-contained HTML file, no script, nothing loaded from anywhere.

    Args:
        answer: What the diagnosis states.
        maps: Missing torque by regime; may be empty.
        overlays: Recorded and simulated motion; may be empty.
        path: The file to write, such as ``OUT/report.html``; its folder is made. Written beside and then renamed, so
            that a reader never sees half a page.
        model: The given model, for the picture of the robot; without it there is none.
        experiment: What the planned experiment asks for, in words, if ``next_experiment.npz`` lies beside the page.
        payload: Mass that it asks to fasten [kg].

    Returns:
        ``path``.

    Example:
        >>> import tempfile
        >>> folder = tempfile.mkdtemp()
        >>> write_report(Answer("nothing_missing", ("All is well.",)), (), (), Path(folder) / "report.html").name
        'report.html'
    """
    path = Path(path)
    text = render(answer, maps, overlays, path.parent.name or ".", model, experiment, payload)
    path.parent.mkdir(parents=True, exist_ok=True)
    with whole_file(path) as part:
        part.write_text(text, encoding="utf-8")
    return path


def render(
    answer: Answer,
    maps: Sequence[RegimeMap],
    overlays: Sequence[Overlay],
    folder: str = "OUT",
    model: mujoco.MjModel | None = None,
    experiment: str = "",
    payload: float = 0.0,
) -> str:
    """The text of the page; ``folder`` is the name of the output folder in its examples."""
    import jinja2
    from markupsafe import escape

    here = resources.files(__package__)
    environment = jinja2.Environment(
        autoescape=True, trim_blocks=True, lstrip_blocks=True, undefined=jinja2.StrictUndefined, finalize=_together
    )
    environment.filters.update(percent=percent, title=title, words=words, place=place)
    environment.globals.update(
        estimate=estimate,
        python=lambda text: escape(repr(text)),
        chosen=CHOSEN,
        grounds=grounds_words,
        same_as=same_as,
        of_class=of_class,
    )
    units = joint_units(answer, maps)
    return environment.from_string((here / "page.html").read_text("utf-8")).render(
        a=answer,
        units=units,
        css=_markup((here / "page.css").read_text("utf-8")),
        verdict=verdict_words(answer),
        banners=banners(answer),
        unexplained=unexplained(answer),
        lead=lead(answer),
        besides=besides(answer),
        would_change=would_change(answer),
        if_known=IF_KNOWN,
        robot=_robot(answer, model),
        where=joints_and_regimes(answer.locations),
        hero=_hero(answer, units),
        whys=_whys(answer, maps),
        regimes=_regimes(answer, maps),
        motion=_motion(answer, overlays, units),
        fit=[(split, _fit_rows(answer.fit[split], units)) for split in ("heldout", "train") if split in answer.fit],
        experiment=experiment,
        go_on=escape(go_on(folder, payload)),
        command_file=COMMAND_FILE,
        next_takes=next_takes(answer),
        quality=_quality(answer.quality),
        folder=folder,
    )


def _robot(answer: Answer, model: mujoco.MjModel | None) -> Markup | None:
    """The robot with the joints of the findings marked, or, without findings, none."""
    if model is None:
        return None
    notes = {x.joint: f"{percent(x.share_of_error)} of the error" for x in joints_and_regimes(answer.locations)[0]}
    if len(notes) > 7:  # a robot of many joints: those that matter
        notes = {x.joint: notes[x.joint] for x in answer.locations if x.joint in notes and x.share_of_error >= 0.03}
    for joint in {f.joint for f in answer.findings if f.joint is not None}:
        first, *more = [words(f.effect) for f in answer.findings if f.joint == joint]
        notes[joint] = f"{first}, {len(more)} more" if more else first
    if answer.verdict == "nothing_missing":
        notes = dict.fromkeys(notes, "")
    return _markup(robot_svg(model, dict.fromkeys(f.joint for f in answer.findings), notes))


def _hero(answer: Answer, units: Mapping[str, str]) -> dict[str, Any] | None:
    """The fit on the recordings kept aside, or on those of the fit where none were: key numbers and a figure."""
    split = next((s for s in ("heldout", "train") if s in answer.fit), None)
    if split is None:
        return None
    score = answer.fit[split]
    rows = [(joint, units[joint], row["before"], row["after"], row["floor"]) for joint, row in score.per_joint.items()]
    rows.sort(key=lambda row: -row[2] / max(row[4], 1e-30))
    pooled = _pooled_unit(score, units)
    drawn = rows[:MOST_TRACKS] or [("all joints", pooled or "rad", score.before, score.after, score.floor)]
    spoken = "; ".join(
        f"{joint} {quantity(b, unit)} before, {quantity(a, unit)} after, noise floor {quantity(f, unit)}"
        for joint, unit, b, a, f in drawn
    )
    return {
        "split": split,
        "numbers": quantities([score.before, score.after, score.floor], pooled) if pooled else None,
        "share_closed": score.share_closed,
        "figure": _markup(svg(fit_figure(drawn), "fit", f"Position error over 0.5 second windows: {spoken}.")),
        "left_out": len(rows) - len(drawn) if rows else 0,
        "shares": _shares(answer, split),
    }


def _shares(answer: Answer, split: str) -> list[tuple[str, str, float]]:
    """Part, its name and its share of the error energy."""
    names = NAMES if answer.findings else {**NAMES, "physics": "adjusted within tolerances"}
    if answer.verdict == "nothing_missing":
        names = {**names, "unexplained": "beyond the noise"}
    shares = energy_shares(answer, split)
    return [(part, names[part], share) for part, share in shares.items() if answer.findings or share > 0]


def _fit_rows(score: Score, units: Mapping[str, str]) -> list[dict[str, Any]]:
    joints = [
        (joint, units[joint], row["before"], row["after"], row["floor"]) for joint, row in score.per_joint.items()
    ]
    pooled = _pooled_unit(score, units)
    if pooled and len(joints) != 1:
        joints.insert(0, ("all joints", pooled, score.before, score.after, score.floor))
    rows = []
    for joint, unit, before, after, floor in joints:
        numbers, name = quantities([before, after, floor], unit)
        closed = share_closed(before, after, floor)
        rows.append(
            {"joint": joint, "numbers": numbers, "unit": name, "closed": closed if math.isfinite(closed) else None}
        )
    return rows


def _pooled_unit(score: Score, units: Mapping[str, str]) -> str | None:
    """Unit of the error over all joints; None where hinges and slides make it a number without meaning."""
    used = {units[joint] for joint in score.per_joint} or {"rad"}
    return used.pop() if len(used) == 1 else None


def _whys(answer: Answer, maps: Sequence[RegimeMap]) -> list[dict[str, Any]]:
    """The maps that gave the findings away, each once; without findings the one with the most missing torque."""
    found = [(f, m) for f in answer.findings if (m := map_of(f, maps)) is not None]
    shown = list({id(m): m for _, m in found}.values())[:MOST_WHYS]
    if not found and maps:
        shown = [first_map(answer, maps, joint_order(answer, [m.joint for m in maps])[0])]
    laws = {e.name: (e.equation, e.source) for e in CATALOGUE}
    whys = []
    for i, m in enumerate(shown):
        findings = [f for f, own in found if own is m]
        figure = why_figure(m) if findings else regime_figure(m)
        whys.append(
            {
                "findings": findings,
                "joint": m.joint,
                "feature": m.feature,
                "force": force_word(m.torque_unit),
                "laws": [laws[f.effect] for f in findings if f.effect in laws],
                "words": _spoken(m),
                "figure": _markup(svg(figure, f"why{i}", _spoken(m))),
            }
        )
    return whys


def _regimes(answer: Answer, maps: Sequence[RegimeMap]) -> list[dict[str, Any]]:
    groups, room = [], MOST_MAPS
    for joint in joint_order(answer, [m.joint for m in maps]):
        own = by_telling([m for m in maps if m.joint == joint])
        limit = torque_limit(own)
        panels = []
        for m in own[:room]:
            name = f"map{MOST_MAPS - room}"
            panels.append((m.feature, _markup(svg(regime_figure(m, limit), name, _spoken(m)))))
            room -= 1
        groups.append(
            {
                "joint": joint,
                "force": force_word(own[0].torque_unit),
                "panels": panels,
                "left_out": len(own) - len(panels),
            }
        )
    return groups


def _spoken(m: RegimeMap) -> str:
    """A map in a sentence, for those who do not see it."""
    if not np.isfinite(m.before).any():
        return f"Missing {force_word(m.torque_unit)} of {m.joint} against {m.feature}: no bin holds enough samples."
    low, high = int(np.nanargmin(m.before)), int(np.nanargmax(m.before))
    after = float(np.nanmax(np.abs(m.after), initial=0.0))
    return (
        f"Missing {force_word(m.torque_unit)} of {m.joint} against {m.feature}. Before: from "
        f"{quantity(m.before[low], m.torque_unit)} at {quantity(m.centre[low], m.unit)} to "
        f"{quantity(m.before[high], m.torque_unit)} at {quantity(m.centre[high], m.unit)}. "
        f"After: at most {quantity(after, m.torque_unit)}. Sensor noise: {quantity(m.noise, m.torque_unit)}."
    )


def _motion(answer: Answer, overlays: Sequence[Overlay], units: Mapping[str, str]) -> dict[str, Any]:
    """One group a recording, the most telling seconds of each, while there is room."""
    groups, drawn, left_out = [], 0, []
    for overlay in telling_overlays(overlays):
        joints = joint_order(answer, overlay.joint_names)[: min(MOST_JOINTS, MOST_OVERLAYS - drawn)]
        if not joints:
            left_out.append(overlay.recording)
            continue
        window = telling_window(overlay)
        start, stop = overlay.time[window][[0, -1]]
        panels = []
        for joint in joints:
            unit = units.get(joint, "rad")
            j = overlay.joint_names.index(joint)
            errors = [rms((x - overlay.measured)[window, j]) for x in (overlay.before, overlay.after)]
            (b, a), name = quantities(errors, unit)
            spoken = f"Recorded and simulated position of {joint} from {start:.1f} s to {stop:.1f} s. "
            figure = overlay_figure(overlay, joint, unit, window)
            alt = f"{spoken}Error in these seconds {b} {name} before, {a} {name} after the correction."
            panels.append(
                {"joint": joint, "numbers": f"{b} → {a} {name}", "figure": _markup(svg(figure, f"motion{drawn}", alt))}
            )
            drawn += 1
        groups.append(
            {
                "overlay": overlay,
                "panels": panels,
                "start": start,
                "stop": stop,
                "left_out": overlay.measured.shape[1] - len(joints),
            }
        )
    return {"groups": groups, "left_out": left_out}


def _quality(quality: Mapping[str, Any]) -> dict[str, Any]:
    recordings = []
    for r in quality.get("recordings", ()):
        masked = {reason: int(n) for reason, n in r.get("masked", {}).items() if n}
        recordings.append(
            {
                "source": str(r.get("source", "–")),
                "rate": quantity(float(r.get("rate", math.nan)), "Hz"),
                "duration": quantity(float(r.get("duration", math.nan)), "s"),
                "masked": masked,
                "bridged": bridged_readings(r),
                "warnings": [str(w) for w in r.get("warnings", ())],
            }
        )
    known = ("recordings", "warnings", "units")
    return {
        "recordings": recordings,
        "total": quantity(sum(float(r.get("duration", 0.0)) for r in quality.get("recordings", ())), "s"),
        "warnings": [str(w) for w in quality.get("warnings", ())],
        "notes": {
            title(str(k)): _note(v) for k, v in quality.items() if k not in known and v not in (None, "", [], {})
        },
    }


def _note(value: Any) -> str:
    """A remark of the quality control; shares by joint as percentages."""
    if isinstance(value, Mapping) and all(isinstance(v, float) for v in value.values()):
        return ", ".join(f"{name} {percent(v)}" for name, v in value.items())
    return str(value)


def _together(value: Any) -> Any:
    """Keep a number and its unit on one line; code and SVG, which are marked as safe, stay as they are."""
    return _BEFORE_UNIT.sub("\N{NO-BREAK SPACE}", value) if type(value) is str else value


def _markup(text: str) -> Markup:
    from markupsafe import Markup

    return Markup(text)  # our own SVG and CSS; everything else is escaped
