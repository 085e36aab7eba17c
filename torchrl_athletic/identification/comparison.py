"""Methods of identification side by side: one table, one figure, every seed."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np

from torchrl_athletic.identification.open_loop import Replay, open_loop, score
from torchrl_athletic.identification.simulator import Simulator
from torchrl_athletic.recordings import Recording

_NAMES = {
    "default": "Default",
    "cem": "CEM",
    "actuator_net": "Actuator Net",
    "uan": "UAN",
    "uan_joint": "UAN, told the joint",
    "uan_arm": "UAN, told joint and arm",
    "uan_memory": "UAN with memory",
    "uan_arm_memory": "UAN with memory, told joint and arm",
    "inertia_uan": "UAN on CEM's inertia",
    "inertia_uan_joint": "UAN on CEM's inertia, told the joint",
    "inertia_uan_joint_memory": "UAN with memory on CEM's inertia, told the joint",
    "inertia_uan_memory": "UAN with memory on CEM's inertia",
    "inertia_uan_arm_memory": "UAN with memory on CEM's inertia, told joint and arm",
    "diagnosed": "Diagnosed",
    "diagnosed_uan": "Diagnosed + UAN",
    "diagnosed_uan_joint": "Diagnosed + UAN, told the joint",
    "diagnosed_uan_arm": "Diagnosed + UAN, told joint and arm",
    "diagnosed_uan_memory": "Diagnosed + UAN with memory",
    "diagnosed_uan_arm_memory": "Diagnosed + UAN with memory, told joint and arm",
}
_TAUGHT = {"": "", "_ppo": " by PPO", "_ppo_credit": " by PPO, credit by joint"}
NAMES = {m + by: name + how for m, name in _NAMES.items() for by, how in _TAUGHT.items() if not by or "uan" in m}
"""Methods in the order of tables and figures; others follow under their own names."""
COLOURS = {
    "default": "#457B9D",
    "cem": "#E07A5F",
    "actuator_net": "#52936C",
    "uan": "#C45552",
    "uan_ppo": "#A3B18A",
    "uan_ppo_credit": "#606C38",
    "uan_joint": "#F2B134",
    "uan_arm": "#8C2F39",
    "uan_memory": "#D4A373",
    "uan_arm_memory": "#7F5539",
    "inertia_uan": "#E5989B",
    "inertia_uan_joint": "#B56576",
    "inertia_uan_joint_memory": "#7B2D5B",
    "inertia_uan_memory": "#6D597A",
    "inertia_uan_arm_memory": "#355070",
    "diagnosed": "#9A97C4",
    "diagnosed_uan": "#5A6F8C",
    "diagnosed_uan_joint": "#16425B",
    "diagnosed_uan_arm": "#2F4858",
    "diagnosed_uan_memory": "#3D8B8B",
    "diagnosed_uan_arm_memory": "#1B3B5A",
}


@dataclass(frozen=True)
class Result:
    """Score of one simulator on one group of recordings, restarted in one way."""

    method: str
    seed: int
    group: str
    window: str
    """``"whole"``, or the seconds after which rollouts start anew from the measured state."""
    mse: float
    """[rad²]."""
    per_joint: Mapping[str, float]
    diverged: float
    """Share of rollouts in which a joint was ever off by more than a radian."""
    training_seconds: float
    data_seconds: float

    def to_json(self) -> dict[str, Any]:
        """As numbers and texts."""
        return asdict(self)


def compare(
    simulator: Simulator, groups: Mapping[str, Sequence[Recording]], windows: Sequence[float | None] = (None, 0.5)
) -> list[Result]:
    """Score a simulator on each group of recordings, over whole takes (None) and over windows [s].

    A window is left out for a group whose takes are all shorter.
    """
    notes, out = simulator.notes, {}
    for window in windows:
        kept = {g: of for g, of in groups.items() if of and max(r.duration for r in of) >= (window or 0.0)}
        rollouts = iter(open_loop(simulator, [r for of in kept.values() for r in of], window))  # all at once
        for group, recordings in kept.items():
            found = score([next(rollouts) for _ in recordings])
            out[group, window] = Result(
                simulator.name, int(notes.get("seed", 0)), group, "whole" if window is None else f"{window:g} s",
                found.mse, found.per_joint, found.diverged,
                float(notes.get("training_seconds", 0.0)), float(notes.get("data_seconds", 0.0)),
            )  # fmt: skip
    return [out[group, window] for group in groups for window in windows if (group, window) in out]


def table(results: Sequence[Result], baseline: str = "default") -> str:
    """Mean and :func:`deviation` over seeds, in Markdown, and each method's error as a share of the baseline's.

    A method of which some rollout diverged is marked with the share of those that did. The last columns say the wall
    clock of identification, and the seconds of recordings that it looked at.
    """
    methods, columns = _methods(results), _columns(results)
    head = ["method", *(f"{group}, {window}" for group, window in columns), "training", "looked at", "seeds"]
    lines = ["| " + " | ".join(head) + " |", "|" + " --- |" * len(head)]
    for method in methods:
        of_method = [r for r in results if r.method == method]
        cells = [_cell(of_method, column, _mean(results, baseline, column)) for column in columns]
        seeds = sorted({r.seed for r in of_method})
        spent, used = (float(np.mean([getattr(r, n) for r in of_method])) for n in ("training_seconds", "data_seconds"))
        last = [f"{spent:.0f} s", f"{used:.0f} s", ", ".join(map(str, seeds))]
        lines.append("| " + " | ".join([NAMES.get(method, method), *cells, *last]) + " |")
    return "\n".join(lines) + "\n"


def every_seed(results: Sequence[Result], window: str = "whole") -> str:
    """Each seed's mean squared error [rad²] in Markdown, of the rollouts of one window, in the order of the seeds."""
    methods, columns = _methods(results), [column for column in _columns(results) if column[1] == window]
    head = ["each seed", *(", ".join(column) for column in columns)]
    lines = ["| " + " | ".join(head) + " |", "|" + " --- |" * len(head)]
    for method in methods:
        cells = [", ".join(f"{mse:.2e}" for mse in _values(results, method, column)) for column in columns]
        lines.append("| " + " | ".join([NAMES.get(method, method), *cells]) + " |")
    return "\n".join(lines) + "\n"


def deviation(values: Sequence[float]) -> float:
    """Standard deviation between seeds, estimated from these few: squares are divided by one less than their number.

    0 of a single one, which tells nothing of it.

    Example:
        >>> deviation([1.0, 2.0, 3.0]), deviation([1.0])
        (1.0, 0.0)
    """
    return float(np.std(values, ddof=1)) if len(values) > 1 else 0.0


def name_of_uan(method: str, credit: str = "joint", knows: str = "errors", memory: bool = False) -> str:
    """What a UAN's simulator is called by in :data:`NAMES`, so that tables keep the ways of training apart.

    Args:
        method: ``"gradient"`` or ``"ppo"``.
        credit: Of PPO, ``"arm"`` as in the paper or ``"joint"``; the gradient knows none.
        knows: What the net is told: ``"errors"``, ``"joint"`` or ``"arm"``.
        memory: Whether it is shown where its joint turned.

    Example:
        >>> NAMES[name_of_uan("ppo", "arm")], NAMES[name_of_uan("gradient", knows="arm", memory=True)]
        ('UAN by PPO', 'UAN with memory, told joint and arm')
    """
    told = "uan" + ("" if knows == "errors" else f"_{knows}") + "_memory" * memory
    return told if method == "gradient" else told + {"arm": "_ppo", "joint": "_ppo_credit"}[credit]


def figure(
    results: Sequence[Result],
    examples: Mapping[str, Mapping[str, Replay]],
    path: str | Path,
    *,
    window: str = "whole",
    joint: str | None = None,
    seconds: float = 3.0,
) -> None:
    """Draw bars on a logarithmic scale, mean and spread over seeds, and rollouts below them.

    Args:
        results: As :func:`compare` gives them.
        examples: By what they show ("an unseen throw"), rollouts of one recording by method.
        path: Of the picture; its ending tells the format.
        window: Whose results are drawn.
        joint: Of the examples; None takes the one that moves most.
        seconds: How much of each example is drawn, where the joint moves most.
    """
    from matplotlib.figure import Figure
    from matplotlib.lines import Line2D

    methods = _methods(results)
    groups = [group for group, of in _columns(results) if of == window]
    rows = 1 + len(examples)
    picture = Figure(figsize=(2.9 * max(3, len(groups)), 2.6 * rows), layout="constrained")
    grid = picture.add_gridspec(rows, len(groups))
    for k, group in enumerate(groups):
        _bars(picture.add_subplot(grid[0, k]), results, methods, (group, window), first=k == 0)
    for row, (title, rollouts) in enumerate(examples.items(), start=1):
        _traces(picture.add_subplot(grid[row, :]), title, rollouts, joint, seconds)
    handles = [*([Line2D([], [], color="black", label="recorded")] if examples else []), *map(_patch, methods)]
    legend = {"ncols": min(4, len(handles)), "fontsize": 8, "frameon": False}
    picture.legend(handles=handles, loc="outside lower center", **legend)
    Path(path).parent.mkdir(parents=True, exist_ok=True)
    picture.savefig(path)


def _bars(axes: Any, results: Sequence[Result], methods: Sequence[str], column: tuple[str, str], first: bool) -> None:
    for k, method in enumerate(methods):
        values = _values(results, method, column)
        if not values:
            continue
        mean, spread = float(np.mean(values)), deviation(values)
        colour = COLOURS.get(method, "#888888")
        axes.bar(k, mean, yerr=spread or None, color=colour, edgecolor="black", linewidth=0.6, capsize=3)
        axes.plot([k] * len(values), values, ".", color="black", markersize=3)
        lost = "*" if _diverged(results, method, column) else ""
        axes.annotate(
            f"{mean:.1e}{lost}",
            (k, mean + spread),
            xytext=(0, 4),
            textcoords="offset points",
            ha="center",
            va="bottom",
            fontsize=6,
            rotation=90,
        )
    axes.set_yscale("log")
    axes.margins(y=0.45)
    axes.set_xticks([])
    axes.set_title(f"{column[0]} ({'whole takes' if column[1] == 'whole' else column[1]})", fontsize=9)
    if first:
        axes.set_ylabel("mean squared error [rad²]", fontsize=8)
    axes.tick_params(which="both", labelsize=7)
    axes.grid(axis="y", which="major", linewidth=0.3)


def _traces(axes: Any, title: str, rollouts: Mapping[str, Replay], joint: str | None, seconds: float) -> None:
    some = next(iter(rollouts.values()))
    j = some.joints.index(joint) if joint else int(np.ptp(some.measured, axis=(0, 1)).argmax())
    measured = some.measured[..., j].ravel()
    period = 1.0 / some.recording.rate
    length = min(len(measured), round(seconds / period))
    strides = range(0, len(measured) - length + 1, max(1, length // 4))
    start = max(strides, key=lambda s: np.ptp(measured[s : s + length]))
    shown = slice(start, start + length)
    time = some.recording.time[some.index.ravel()][shown]
    axes.plot(time, measured[shown], color="black", linewidth=1.6)
    for method, rollout in rollouts.items():
        axes.plot(time, rollout.position[..., j].ravel()[shown], color=COLOURS.get(method, "#888888"), linewidth=0.9)
    axes.set_title(f"{title}, {some.joints[j]}", fontsize=9)
    axes.set_ylabel("position [rad]", fontsize=8)
    axes.set_xlabel("time [s]", fontsize=8)
    axes.tick_params(labelsize=7)


def _patch(method: str) -> Any:
    from matplotlib.patches import Patch

    return Patch(facecolor=COLOURS.get(method, "#888888"), edgecolor="black", label=NAMES.get(method, method))


def _methods(results: Sequence[Result]) -> list[str]:
    order = list(NAMES)
    found = dict.fromkeys(r.method for r in results)
    return sorted(found, key=lambda m: (order.index(m) if m in order else len(order), m))


def _columns(results: Sequence[Result]) -> list[tuple[str, str]]:
    return list(dict.fromkeys((r.group, r.window) for r in results))


def _values(results: Sequence[Result], method: str, column: tuple[str, str]) -> list[float]:
    """In the order of the seeds."""
    found = (r for r in results if r.method == method and (r.group, r.window) == column)
    return [r.mse for r in sorted(found, key=lambda r: r.seed)]


def _mean(results: Sequence[Result], method: str, column: tuple[str, str]) -> float:
    values = _values(results, method, column)
    return float(np.mean(values)) if values else math.nan


def _diverged(results: Sequence[Result], method: str, column: tuple[str, str]) -> float:
    found = [r.diverged for r in results if r.method == method and (r.group, r.window) == column]
    return float(np.mean(found)) if found else 0.0


def _cell(of_method: Sequence[Result], column: tuple[str, str], baseline: float) -> str:
    method = of_method[0].method
    values = _values(of_method, method, column)
    if not values:
        return ""
    mean = float(np.mean(values))
    spread = f" ± {deviation(values):.1e}" if len(values) > 1 else ""
    share = f" ({mean / baseline:.3f})" if baseline > 0 else ""
    lost = _diverged(of_method, method, column)
    return f"{mean:.2e}{spread}{share}" + (f", {100 * lost:.0f} % diverge" if lost else "")
