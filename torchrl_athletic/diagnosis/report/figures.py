"""The pictures: how the fit moved, missing torque against a quantity, recorded and simulated motion.

Figures are drawn at one user unit a pixel. :func:`svg` turns one into inline SVG whose colours and fonts are CSS
variables of the page, so that dark mode and print need no second drawing.
"""

from __future__ import annotations

import io
import re
import textwrap
import warnings
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from html import escape
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from torchrl_athletic.diagnosis.report.quantity import joint_units, quantities, readable
from torchrl_athletic.diagnosis.report.telling import first_map, joint_order, telling_overlays, telling_window
from torchrl_athletic.diagnosis.result import Answer, Overlay, RegimeMap

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

INK, MUTED, LINE, NOISE = "#1c2430", "#5d6673", "#d9dce0", "#8a8f98"
BEFORE, AFTER = "#b84a00", "#0067a5"  # Okabe and Ito's vermilion and blue, darkened for text contrast
_LINES: dict[str, dict[str, Any]] = {  # told apart by dashes too, for prints and for eyes that see no colour
    "before": {"color": BEFORE, "dashes": (4, 1.6)},
    "after": {"color": AFTER},
}
_CSS_VARIABLES = {INK: "ink", MUTED: "muted", LINE: "line", NOISE: "noise", BEFORE: "before", AFTER: "after"}

_STYLE: Any = {
    "svg.fonttype": "none",
    "text.parse_math": False,  # a joint may be called $x$
    "axes.formatter.useoffset": False,
    "font.size": 11,
    "text.color": INK,
    "axes.edgecolor": LINE,
    "axes.labelcolor": MUTED,
    "axes.spines.top": False,
    "axes.spines.right": False,
    "axes.spines.left": False,
    "axes.grid": True,
    "axes.grid.axis": "y",
    "axes.axisbelow": True,
    "grid.color": LINE,
    "grid.linewidth": 0.7,
    "xtick.color": MUTED,
    "ytick.color": MUTED,
    "xtick.major.size": 3,
    "ytick.major.size": 0,
    "xtick.labelsize": 10.5,
    "ytick.labelsize": 10.5,
    "lines.linewidth": 1.6,
    "lines.solid_capstyle": "round",
}


@contextmanager
def _styled() -> Iterator[None]:
    import matplotlib

    with matplotlib.rc_context(_STYLE), warnings.catch_warnings():
        warnings.filterwarnings("ignore", message="Glyph .* missing")  # the browser's fonts have it
        yield


def _figure(width: float, height: float) -> Figure:
    from matplotlib.figure import Figure

    return Figure(figsize=(width / 72, height / 72))  # SVG user units are points of 1/72 inch


def _axes(figure: Figure, left: float, right: float, top: float, bottom: float) -> Axes:
    """Axes with margins [px] instead of fractions, so that labels keep their room in every size."""
    width, height = figure.get_size_inches() * 72
    return figure.add_axes((left / width, bottom / height, 1 - (left + right) / width, 1 - (top + bottom) / height))


def fit_figure(rows: Sequence[tuple[str, str, float, float, float]]) -> Figure:
    """RMSE before -> after, with the floor, one track a row.

    Args:
        rows: (joint, unit, before, after, floor) [unit]. Rows of one unit share one scale.
    """
    top, pitch, width = 6.0, 60.0, 420.0
    height = top + pitch * len(rows)
    groups = {unit: [v for row in rows if row[1] == unit for v in row[2:]] for _, unit, *_ in rows}
    largest = {unit: max([1e-30, *(v for v in values if np.isfinite(v))]) for unit, values in groups.items()}
    labels = {unit: quantities(values, unit) for unit, values in groups.items()}
    with _styled():
        figure = _figure(width, height)
        ax = figure.add_axes((0, 0, 1, 1))
        ax.set(xlim=(0, width), ylim=(height, 0))
        ax.axis("off")
        for i, (joint, unit, before, after, floor) in enumerate(rows):
            line, track = top + pitch * i + 12, top + pitch * i + 31
            numbers, name = labels[unit]
            b, a, f = numbers[:3]
            del numbers[:3]
            x_before, x_after, x_floor = (8 + (width - 16) * v / largest[unit] for v in (before, after, floor))
            ax.text(0, line, shorten(joint), ha="left", va="baseline", weight="bold", size=13)
            ax.text(width, line, f"{b} → {a} {name}", ha="right", va="baseline", size=13)
            ax.plot([8, width - 8], [track, track], color=LINE, lw=2)
            ax.plot([8, x_floor], [track, track], color=NOISE, lw=7, solid_capstyle="butt", alpha=0.45)
            ax.plot([x_floor, x_floor], [track - 7, track + 7], color=NOISE, lw=2)
            if abs(x_before - x_after) > 14:
                ax.annotate(
                    "",
                    (x_after, track),
                    (x_before, track),
                    arrowprops={"arrowstyle": "->", "color": INK, "lw": 1.4, "shrinkA": 7, "shrinkB": 7},
                )
            ax.plot(x_before, track, "o", ms=10, mfc="none", mec=BEFORE, mew=2.2)
            ax.plot(x_after, track, "o", ms=9, color=AFTER)
            on_right = x_floor > 0.8 * width
            ax.text(x_floor, track + 18, f"floor {f}", ha="right" if on_right else "left", color=MUTED, size=11)
    return figure


def regime_figure(regime_map: RegimeMap, limit: float | None = None) -> Figure:
    """Missing torque against one quantity, before and after.

    Args:
        regime_map: What to draw.
        limit: Half height of the axis [torque_unit], to give the panels of one joint the same scale.
    """
    with _styled():
        figure = _figure(340, 210)
        draw_regime(_axes(figure, 50, 10, 26, 42), regime_map, limit)
    return figure


def draw_regime(ax: Axes, m: RegimeMap, limit: float | None = None) -> None:
    """Draw :func:`regime_figure` into ``ax``."""
    limit = limit or torque_limit([m])
    factor, torque_name = readable(m.torque_unit, limit)
    centre, x_name = _scaled_axis(m.centre, m.unit)
    ax.axhspan(-m.noise * factor, m.noise * factor, color=NOISE, alpha=0.16, lw=0, gid="noise")
    ax.axhline(0, color=MUTED, lw=0.8)
    for series, values, band in (("before", m.before, m.before_band), ("after", m.after, m.after_band)):
        colour = _LINES[series]["color"]
        ax.fill_between(centre, *(band.T * factor), color=colour, alpha=0.18, lw=0, gid=f"{series}-band")
        ax.plot(centre, values * factor, **_LINES[series], gid=f"{series}-line")
    ax.set_ylim(-limit * factor, limit * factor)
    _few_ticks(ax)
    ax.set_xlabel(f"{m.feature} [{x_name}]")
    _label_above(ax, f"missing {force_word(m.torque_unit)} [{torque_name}]")


def why_figure(m: RegimeMap) -> Figure:
    """What gave an effect away: missing torque against one quantity with the law over it, and below what it leaves.

    The law is drawn as what the correction takes away, before minus after.
    """
    with _styled():
        figure = _figure(440, 310)
        draw_why(_axes(figure, 54, 12, 24, 146), _axes(figure, 54, 12, 210, 42), m)
    return figure


def draw_why(missing: Axes, left: Axes, m: RegimeMap) -> None:
    """Draw :func:`why_figure` into two axes that share the quantity."""
    force = force_word(m.torque_unit)
    limit = torque_limit([m])
    factor, torque_name = readable(m.torque_unit, limit)
    small = max(_largest(m.after), _largest(m.after_band), 1.5 * m.noise if np.isfinite(m.noise) else 0.0) or limit
    small_factor, small_name = readable(m.torque_unit, small)
    centre, x_name = _scaled_axis(m.centre, m.unit)
    missing.fill_between(centre, *(m.before_band.T * factor), color=BEFORE, alpha=0.18, lw=0, gid="before-band")
    missing.plot(centre, m.before * factor, "o", ms=5.5, color=BEFORE, zorder=3, gid="before-line")
    missing.plot(centre, (m.before - m.after) * factor, color=INK, lw=2, gid="law-line")
    missing.set_ylim(-limit * factor, limit * factor)
    left.fill_between(centre, *(m.after_band.T * small_factor), color=AFTER, alpha=0.18, lw=0, gid="after-band")
    left.plot(centre, m.after * small_factor, color=AFTER, marker="o", ms=4, gid="after-line")
    left.set_ylim(-1.08 * small * small_factor, 1.08 * small * small_factor)
    for ax, scale, text, name in (
        (missing, factor, f"missing {force} [{torque_name}]", "noise"),
        (left, small_factor, f"left after the correction [{small_name}]", "noise-left"),
    ):
        ax.axhspan(-m.noise * scale, m.noise * scale, color=NOISE, alpha=0.16, lw=0, gid=name)
        ax.axhline(0, color=MUTED, lw=0.8)
        _few_ticks(ax)
        _label_above(ax, text)
    left.set_xlim(missing.get_xlim())
    missing.tick_params(labelbottom=False, bottom=False)
    left.set_xlabel(f"{m.feature} [{x_name}]")


def torque_limit(maps: Sequence[RegimeMap]) -> float:
    """Half height that shows every curve and band of ``maps`` [torque_unit]."""
    curves = np.concatenate([np.ravel(x) for m in maps for x in (m.before, m.after, m.before_band, m.after_band)])
    curves = np.abs(curves[np.isfinite(curves)])
    noise = max(m.noise for m in maps)
    return 1.08 * max(float(curves.max(initial=0.0)), 1.5 * noise if np.isfinite(noise) else 0.0, 1e-9)


def overlay_figure(overlay: Overlay, joint: str, unit: str, window: slice) -> Figure:
    """Recorded and simulated position above, what is left of the error below."""
    with _styled():
        figure = _figure(420, 262)
        motion = _axes(figure, 52, 10, 22, 114)
        draw_overlay(motion, _axes(figure, 52, 10, 176, 40), overlay, joint, unit, window)
    return figure


def draw_overlay(motion: Axes, error: Axes, overlay: Overlay, joint: str, unit: str, window: slice) -> None:
    """Draw :func:`overlay_figure` into two axes that share the time."""
    j = overlay.joint_names.index(joint)
    rows = _strided(window)
    time, measured = overlay.time[rows], overlay.measured[rows, j]
    simulated = {
        series: _broken_at_restarts(x[rows, j], measured)
        for series, x in (("before", overlay.before), ("after", overlay.after))
    }
    factor, name = readable(unit, _largest(measured))
    motion.plot(time, measured * factor, color=INK, lw=2.6, alpha=0.55, gid="measured-motion")
    largest = max(_largest(x - measured) for x in simulated.values()) or 1.0
    small, small_name = readable(unit, largest)
    for series, x in simulated.items():
        motion.plot(time, x * factor, **_LINES[series], lw=1.4, gid=f"{series}-motion")
        error.plot(time, (x - measured) * small, **_LINES[series], lw=1.4, gid=f"{series}-error")
    low, high = motion.get_ylim()
    span = 2 * _largest(measured - measured.mean()) * factor or high - low
    centre = measured.mean() * factor
    motion.set_ylim(max(low, centre - span), min(high, centre + span))  # a simulation that ran away leaves the picture
    error.axhline(0, color=MUTED, lw=0.8)
    error.set_ylim(-1.1 * largest * small, 1.1 * largest * small)
    for ax, text in ((motion, f"position [{name}]"), (error, f"simulated − recorded [{small_name}]")):
        ax.set_xlim(time[0], time[-1])
        _few_ticks(ax)
        _label_above(ax, text)
    motion.tick_params(labelbottom=False, bottom=False)
    error.set_xlabel("time [s]")


def summary_figure(answer: Answer, maps: Sequence[RegimeMap], overlays: Sequence[Overlay]) -> Figure:
    """One wide picture of a diagnosis: the missing torque on the left, the motion on the right.

    Shows the joint of the first finding, the quantity along which that shows, and the recording kept aside that erred
    most.

    Returns:
        A figure of 12 x 4.4 inches on white; ``figure.savefig("diagnosis.png", dpi=150)``.

    Raises:
        ValueError: If there is no map or no overlay to draw, or none of one joint.
    """
    if not maps or not overlays:
        raise ValueError("no maps or no overlays to draw: the diagnosis stopped before it compared. Run it again.")
    recorded = {joint for o in overlays for joint in o.joint_names}
    joints = [m.joint for m in maps if m.joint in recorded]
    if not joints:
        raise ValueError(f"the maps are of {sorted({m.joint for m in maps})}, the overlays of {sorted(recorded)}.")
    joint = joint_order(answer, joints)[0]
    regime_map = first_map(answer, maps, joint)
    overlay = telling_overlays([o for o in overlays if joint in o.joint_names])[0]
    headline = answer.findings[0].sentence if answer.findings else next(iter(answer.summary), answer.verdict)
    first, _, more = headline.partition(". ")
    title = textwrap.wrap(f"{first}." if more else first, 92, max_lines=2, placeholder=" …")
    with _styled():
        figure = _figure(12 * 72, 4.4 * 72)
        figure.set_facecolor("white")
        figure.text(0.035, 0.875, "\n".join(title), size=15, weight="bold", va="center")
        draw_regime(_axes(figure, 70, 490, 92, 48), regime_map)
        motion, error = _axes(figure, 440, 26, 92, 134), _axes(figure, 440, 26, 218, 48)
        draw_overlay(motion, error, overlay, joint, joint_units(answer, maps)[joint], telling_window(overlay))
        keys = (
            {"label": "recorded", "color": INK, "lw": 2.6, "alpha": 0.55},
            {"label": "model as given", **_LINES["before"]},
            {"label": "corrected", **_LINES["after"]},
        )
        handles = [motion.plot([], [], **key)[0] for key in keys]
        figure.legend(
            handles=handles, loc="upper right", ncols=3, frameon=False, bbox_to_anchor=(0.985, 0.82), borderaxespad=0
        )
    return figure


def svg(figure: Figure, name: str, alt: str) -> str:
    """``figure`` as inline SVG; its ids start with ``name``, its colours are CSS variables, ``alt`` is what it shows.

    Deterministic: the same figure gives the same text.
    """
    import matplotlib

    buffer = io.StringIO()
    with _styled(), matplotlib.rc_context({"svg.hashsalt": name}):
        figure.savefig(
            buffer, format="svg", transparent=True, metadata=dict.fromkeys(("Date", "Creator", "Type", "Format"))
        )
    text = buffer.getvalue()
    text = text[text.index("<svg") :]
    text = re.sub(r"<metadata>.*?</metadata>|<style.*?</style>|<!--.*?-->|<defs>\s*</defs>", "", text, flags=re.DOTALL)
    text = re.sub(r'(?:xlink:)?(\bid="|href="#|url\(#)', rf"\g<1>{name}-", text)
    text = re.sub(r' font-family: [^;"]*;| transform="rotate\(-0 [^"]*"', "", text)  # the page's font, and no-ops
    text = re.sub("|".join(_CSS_VARIABLES), lambda m: f"var(--{_CSS_VARIABLES[m[0]]})", text)
    text = re.sub(r"<[^>]+>", lambda tag: re.sub(r"(\d+\.\d)\d+", r"\1", tag[0]), text)  # 0.1 px is enough
    width, height = (round(v * 72) for v in figure.get_size_inches())
    head = (
        f'<svg role="img" aria-label="{escape(alt)}" viewBox="0 0 {width} {height}" width="{width}" height="{height}">'
    )
    return head + re.sub(r"\s*\n\s*", "\n", text[text.index(">") + 1 :]).strip()


def force_word(torque_unit: str) -> str:
    """'force' for slides, 'torque' for hinges."""
    return "force" if torque_unit == "N" else "torque"


def shorten(name: str, length: int = 24) -> str:
    """``name``, cut in the middle when it is too long for its place."""
    return name if len(name) <= length else f"{name[: length // 2]}…{name[-length // 2 + 1 :]}"


def _scaled_axis(values: NDArray[np.float64], unit: str) -> tuple[NDArray[np.float64], str]:
    factor, name = readable(unit, _largest(values))
    return values * factor, name or "1"


def _few_ticks(ax: Axes) -> None:
    from matplotlib.ticker import MaxNLocator

    height = ax.get_window_extent().height
    ax.yaxis.set_major_locator(MaxNLocator(4 if height > 90 else 2, min_n_ticks=3))
    ax.xaxis.set_major_locator(MaxNLocator(6))


def _label_above(ax: Axes, text: str) -> None:
    ax.annotate(text, (0, 1), (0, 7), xycoords="axes fraction", textcoords="offset points", color=MUTED, size=10.5)


def _largest(values: NDArray[np.float64]) -> float:
    return float(np.abs(values[np.isfinite(values)]).max(initial=0.0))


def _strided(window: slice, points: int = 300) -> slice:
    return slice(window.start, window.stop, max(1, (window.stop - window.start) // points))


def _broken_at_restarts(simulated: NDArray[np.float64], measured: NDArray[np.float64]) -> NDArray[np.float64]:
    """Leave the pen up where a window restarts from the measured state: the jump is bookkeeping, not motion."""
    error = np.abs(simulated - measured)
    error = np.where(np.isfinite(error), error, 0.0)
    restart = np.zeros(len(error), dtype=bool)
    restart[1:] = (error[1:] < 0.3 * error[:-1]) & (error[:-1] - error[1:] > 5 * np.median(np.abs(np.diff(error))))
    return np.where(restart, np.nan, simulated)
