"""What throws in many worlds say: tables and figures of ``throw_transfer.py``."""

from __future__ import annotations

import math
import re
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from statistics import fmean, median
from typing import Any

import numpy as np

from torchrl_athletic.identification import comparison
from torchrl_athletic.identification.comparison import deviation

ARM = "arm"
"""Name of the world that is real."""
NAMES = {"reference": "by hand", "default": "Default", "dr": "DR", "roa": "ROA"} | comparison.NAMES
"""In the order of tables and figures; others follow under names of their own."""
BASELINES = ("default", "dr", "roa", "cem", "actuator_net")
COLOURS = comparison.COLOURS | {"reference": "#DDDDDD", "dr": "#A8DADC", "roa": "#E9C46A"}
"""Those of the comparison of replays."""


@dataclass(frozen=True)
class Throws:
    """What came of one policy in one world."""

    distance: list[float]
    """[m]; 0 where the throw failed."""
    failed: list[bool]
    release: dict[str, list[float]] = field(default_factory=dict)
    """When the ball leaves, means over the throws: ``release_time`` (1) [s], ``release_velocity`` (3) of the ball [m/s]
    and ``release_joint_velocity`` (J) [rad/s]."""


@dataclass(frozen=True)
class Score:
    """What came of one policy in all worlds."""

    method: str
    name: str
    """Name of its folder."""
    own: str
    """World that it was trained in."""
    samples: int
    """That it learnt from."""
    throws: Mapping[str, Throws]
    """By world, :data:`ARM` among them."""

    @property
    def simulated(self) -> float:
        """In its own simulator [m]."""
        return fmean(self.throws[self.own].distance)

    @property
    def real(self) -> float:
        """[m]."""
        return fmean(self.throws[ARM].distance)

    @property
    def difference(self) -> float:
        """Differences of simulated and real, throw by throw, absolute [m]."""
        pairs = zip(self.throws[self.own].distance, self.throws[ARM].distance, strict=True)
        return fmean(abs(a - b) for a, b in pairs)

    def foretold(self, world: str) -> float:
        """Mean of a world's distances less that of the arm's [m]."""
        return fmean(self.throws[world].distance) - self.real


def label(method: str) -> str:
    """As it is written: ``"cem"`` is CEM."""
    return NAMES.get(method, method)


def tick(method: str) -> str:
    """Its label in a figure, where there is little room."""
    return label(method).replace(", told joint and arm", ", told").replace(" with memory", ", memory")


def method_of(world: str) -> str:
    """Whatever it was identified with: ``"uan_seed1"`` is of ``"uan"``."""
    return re.sub(r"_seed\d+$", "", world)


def in_order(names: Iterable[str]) -> list[str]:
    """Methods, or worlds, as tables and figures have them."""
    known = list(NAMES)
    place = {name: known.index(method_of(name)) if method_of(name) in known else len(known) for name in set(names)}
    return sorted(place, key=lambda name: (place[name], name))


def by_method(scores: Iterable[Score]) -> dict[str, list[Score]]:
    """In order."""
    groups: dict[str, list[Score]] = {}
    for each in scores:
        groups.setdefault(each.method, []).append(each)
    return {method: groups[method] for method in in_order(groups)}


def markdown(scores: Sequence[Score]) -> str:
    """All tables."""
    parts = [
        methods_table(scores),
        "Means over policies ± standard deviation between policies, whose squares are divided by one less than their "
        "number. The share is of the real distance.",
        best_table(scores),
        "Real distance over that of the best baseline; ± from the spread between policies on both sides.",
        foretelling_table(scores),
        "Every policy thrown in every simulator, whatever it was trained in: simulated less real distance, over all "
        "policies but those trained in a simulator of that method. What fails there counts as 0 m.",
        release_table(scores),
        "When the ball leaves the bucket: arm less own simulator, means over policies.",
        policies_table(scores),
        "Each policy: means over its throws ± standard deviation between throws.",
    ]
    return "\n\n".join(part for part in parts if part) + "\n"


def methods_table(scores: Sequence[Score]) -> str:
    rows = []
    for method, group in by_method(scores).items():
        real = fmean(each.real for each in group)
        difference = fmean(each.difference for each in group)
        rows.append(
            [
                label(method),
                str(len(group)),
                spread([each.simulated for each in group]),
                spread([each.real for each in group]),
                spread([each.difference for each in group]),
                f"{100 * difference / real:.1f} %" if real > 0 else "-",
                failures(group),
            ]
        )
    return table(["trained in", "policies", "simulated [m]", "real [m]", "difference [m]", "share", "failed"], rows)


def best_table(scores: Sequence[Score]) -> str:
    """Each method that is no baseline against the baseline that throws farthest on the arm."""
    groups = {method: [each.real for each in group] for method, group in by_method(scores).items()}
    baselines = {method: real for method, real in groups.items() if method in BASELINES}
    if not baselines:
        return ""
    best = max(baselines, key=lambda method: fmean(baselines[method]))
    rows = []
    for method, real in groups.items():
        if method not in (*BASELINES, "reference"):
            ratio, error = ratio_of(real, baselines[best])
            rows.append([label(method), f"{label(best)}, {spread(baselines[best])} m", f"{ratio:.2f} ± {error:.2f}"])
    return table(["ours", "best baseline", "ratio"], rows) if rows else ""


def ratio_of(these: Sequence[float], those: Sequence[float]) -> tuple[float, float]:
    """Ratio of two means, and what the standard deviations make of it [1]."""
    if fmean(those) == 0:
        return math.inf, math.inf
    ratio = fmean(these) / fmean(those)
    return ratio, math.hypot(deviation(these), ratio * deviation(those)) / fmean(those)


def foretelling_table(scores: Sequence[Score]) -> str:
    """How well each simulator foretells throws that were not learnt in it."""
    rows = []
    for method, worlds in worlds_by_method(scores).items():
        asked = [(each, world) for each in scores for world in worlds if method_of(each.own) != method]
        if not asked:
            continue
        errors = [each.foretold(world) for each, world in asked]
        root, middle = math.sqrt(fmean(error**2 for error in errors)), median(map(abs, errors))
        failing = sum(any(each.throws[world].failed) and not any(each.throws[ARM].failed) for each, world in asked)
        sizes = [f"{value:.3f}" for value in (middle, root, max(map(abs, errors)))]
        rows.append([label(method), f"{fmean(errors):+.3f}", *sizes, f"{failing} of {len(asked)}"])
    header = ["simulator", "mean [m]", "median size [m]", "root mean square [m]", "largest [m]", "fails there alone"]
    return table(header, rows) if rows else ""


def release_table(scores: Sequence[Score]) -> str:
    """What differs when the ball leaves."""
    rows = []
    for method, group in by_method(scores).items():
        if not all(each.throws[each.own].release for each in group):
            continue
        gaps = {
            key: np.mean(
                [np.subtract(each.throws[ARM].release[key], each.throws[each.own].release[key]) for each in group], 0
            )
            for key in ("release_time", "release_velocity", "release_joint_velocity")
        }
        ball = gaps["release_velocity"]
        joints = " ".join(f"{gap:+.2f}" for gap in gaps["release_joint_velocity"][:6])
        rows.append(
            [label(method), f"{1e3 * gaps['release_time'][0]:+.0f}", f"{ball[0]:+.2f}", f"{ball[2]:+.2f}", joints]
        )
    header = ["trained in", "time [ms]", "ball forward [m/s]", "ball up [m/s]", "joints 1 to 6 [rad/s]"]
    return table(header, rows) if rows else ""


def policies_table(scores: Sequence[Score]) -> str:
    rows = [
        [
            each.name,
            f"{each.samples / 1e6:.1f} M",
            spread(each.throws[each.own].distance),
            spread(each.throws[ARM].distance),
            f"{each.difference:.3f}",
            failures([each]),
        ]
        for group in by_method(scores).values()
        for each in sorted(group, key=lambda each: each.name)
    ]
    return table(["policy", "samples", "simulated [m]", "real [m]", "difference [m]", "failed"], rows)


def samples_table(scores: Sequence[Score]) -> str:
    """Simulated and real distance after as many samples, of the policies whose training went on for so long."""
    sizes = sorted({each.samples for each in scores})
    rows = []
    for method, group in by_method(scores).items():
        cells = [label(method)]
        for samples in sizes:
            of_size = [each for each in group if each.samples == samples]
            found = [spread([getattr(each, which) for each in of_size]) for which in ("simulated", "real") if of_size]
            cells += [*(found or ["-", "-"]), str(len(of_size))]
        rows.append(cells)
    heads = [
        f"{samples / 1e6:.1f} M: {what}" for samples in sizes for what in ("simulated [m]", "real [m]", "policies")
    ]
    return table(["trained in", *heads], rows) + "\n"


def spread(values: Sequence[float]) -> str:
    """Mean and standard deviation, as far as one can be told from so many."""
    return f"{fmean(values):.3f}" + (f" ± {deviation(values):.3f}" if len(values) > 1 else "")


def failures(group: Sequence[Score]) -> str:
    """On the arm."""
    failed = [each for score in group for each in score.throws[ARM].failed]
    return f"{sum(failed)} of {len(failed)}"


def table(header: Sequence[str], rows: Iterable[Sequence[str]]) -> str:
    lines = [header, ["---"] * len(header), *rows]
    return "\n".join(f"| {' | '.join(line)} |" for line in lines)


def worlds_by_method(scores: Sequence[Score]) -> dict[str, list[str]]:
    """Simulated worlds, in order."""
    groups: dict[str, list[str]] = {}
    for world in in_order(scores[0].throws):
        if world != ARM:
            groups.setdefault(method_of(world), []).append(world)
    return groups


def draw(scores: Sequence[Score], path: Path) -> None:
    """Two bar charts: how far simulation and reality are apart, and how far the real arm throws."""
    pyplot = plotting()
    groups = by_method(scores)
    figure, axes = pyplot.subplots(1, 2, figsize=(10, 4))
    place = np.arange(len(groups))
    colours = [COLOURS.get(method, "#888888") for method in groups]
    for panel, which, title in (
        (axes[0], "difference", "simulated less real distance, absolute [m]"),
        (axes[1], "real", "real distance [m]"),
    ):
        values = [[getattr(each, which) for each in group] for group in groups.values()]
        panel.bar(place, [fmean(x) for x in values], yerr=[deviation(x) for x in values], capsize=3, color=colours)
        for x, each in zip(place, values, strict=True):
            panel.plot(x + np.linspace(-0.15, 0.15, len(each)) * (len(each) > 1), each, "k.", markersize=4)
        panel.set_xticks(place, [tick(method) for method in groups], rotation=35, ha="right")
        panel.set_ylim(bottom=0)
        panel.set_title(title, fontsize="medium")
        panel.grid(axis="y", alpha=0.3)
        panel.set_axisbelow(True)
    figure.tight_layout()
    figure.savefig(path)
    pyplot.close(figure)


def draw_matrix(scores: Sequence[Score], path: Path) -> None:
    """What every simulator foretells of every method's policies, and what they do on the arm.

    On the diagonal stand the policies in the very simulator that they were trained in, elsewhere in all of a method.
    """
    pyplot = plotting()
    groups, worlds = by_method(scores), worlds_by_method(scores)
    errors = np.array([[mean_error(group, *column) for column in worlds.items()] for group in groups.values()])
    everyone = np.sqrt((errors**2).mean(0))
    real = [fmean(each.real for each in group) for group in groups.values()]
    size = (2.6 + 0.85 * (len(worlds) + 1), 1.6 + 0.42 * (len(groups) + 1))
    figure, axes = pyplot.subplots(figsize=size)
    shown = np.full((len(groups) + 1, len(worlds) + 1), np.nan)
    shown[:-1, :-1] = errors
    most = max(0.05, float(np.quantile(np.abs(errors), 0.95)))  # a throw that fails in a simulator alone is off by all
    image = axes.imshow(shown, cmap="RdBu_r", vmin=-most, vmax=most, aspect="auto")
    for (row, column), error in np.ndenumerate(errors):
        colour = "white" if abs(error) > 0.6 * most else "black"
        axes.text(column, row, f"{error:+.3f}", ha="center", va="center", fontsize=8, color=colour)
    for row, distance in enumerate(real):
        axes.text(len(worlds), row, f"{distance:.2f}", ha="center", va="center", fontsize=8, weight="bold")
    for column, error in enumerate(everyone):
        axes.text(column, len(groups), f"{error:.3f}", ha="center", va="center", fontsize=8, style="italic")
    ticks = [tick(method) for method in worlds]
    axes.set_xticks(range(len(ticks) + 1), [*ticks, "arm [m]"], rotation=35, ha="right")
    axes.set_yticks(range(len(groups) + 1), [*(tick(method) for method in groups), "root mean square"])
    axes.set_xlabel("thrown in")
    axes.set_ylabel("trained in")
    axes.tick_params(length=0)
    axes.spines[:].set_visible(False)
    figure.colorbar(image, ax=axes, label="simulated less real [m]", extend="both")
    figure.tight_layout()
    figure.savefig(path)
    pyplot.close(figure)


def mean_error(group: Sequence[Score], method: str, worlds: Sequence[str]) -> float:
    """Mean error of a method's simulators about some policies [m]; a policy trained in one of them has that alone."""
    return fmean(
        fmean(each.foretold(world) for world in ([each.own] if method_of(each.own) == method else worlds))
        for each in group
    )


def plotting() -> Any:
    """Matplotlib without a screen, loaded when it is used."""
    import matplotlib

    matplotlib.use("Agg")
    from matplotlib import pyplot

    return pyplot
