"""The standard joints fitted to real robots, beside what others would do with the same logs: errors kept aside.

    ATHLETIC_DATA=... python -m benchmarks.real_robots.run --data CLONES

``CLONES`` is a folder of clones, named in :mod:`benchmarks.real_robots.robots`. All are scored by one neutral replay:
plain MuJoCo with its own actuators, in windows of half a second from the measured state, over recordings that none of
them fitted. The rivals minimise just that error over the others; ours is what ``fit`` writes. mujoco.sysid needs
``pip install "mujoco[sysid]"`` and is left out without, as it is where one model cannot hold all recordings.
"""

from __future__ import annotations

import contextlib
import json
import resource
import time
from collections.abc import Mapping
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import mujoco
import numpy as np
import tyro

from benchmarks.by_case import Row, commit, run_cases
from benchmarks.real_robots.replay import JUDGE, Replay
from benchmarks.real_robots.rivals import RIVALS, SHORT, by_hand, by_pace, by_sysid
from benchmarks.real_robots.robots import ROBOTS
from benchmarks.real_robots.robots.robot import Robot
from torchrl_athletic.diagnosis import fit
from torchrl_athletic.diagnosis.corrected import Simulation

SCORED = 400
"""Windows that the error on the fitted recordings is stated over; those kept aside are all scored."""
WORSE = 1.01
"""Error per the given model's from which on a joint counts as made worse."""


@dataclass(frozen=True)
class Config:
    """Every field is a flag."""

    data: Path = Path("clones")
    """Folder of clones; the five benches of ``load_dataset`` need none."""
    cases: tuple[str, ...] = tuple(ROBOTS)
    seed: int = 0
    output: Path = Path("benchmarks/results/real_robots.md")
    fits: Path | None = Path("out/real_robots")
    """Where the files of our fits go; None for none."""
    ours: bool = True
    """Without, ours is the fit in ``fits``, and what it took is that in ``output``."""
    most: int = 100
    """Windows that a rival fits; more are thinned evenly."""
    rivals: tuple[str, ...] = RIVALS
    """Those that are fitted; the others' numbers are those in ``output``."""


def main(cfg: Config) -> None:
    run_cases(cfg.cases, lambda case: run(case, cfg), table, cfg.output)


def run(case: str, cfg: Config) -> Row:
    """Fit one robot in every way, and score each on what was kept aside."""
    known, robot = _known(case, cfg), ROBOTS[case](cfg.data)
    folder = None if cfg.fits is None else folder_of(cfg.fits, case)
    ours, corrected = _fitted(robot, folder, cfg.seed) if cfg.ours else _kept(robot, folder, known)
    train, held = (Replay(robot, group) for group in (robot.recordings, robot.heldout))
    commits = {"ours": commit() if cfg.ours else known["commits"]["ours"]}
    points, seconds = {"given": train.nominal()}, {"ours": ours.pop("seconds")}
    fewer = train.with_windows(cfg.most)
    ways = {
        "by hand, 4 numbers": lambda: by_hand(fewer, [n for n in SHORT if n in train.movable]),
        "by hand, the same list": lambda: by_hand(fewer, train.movable),
        "PACE's list": lambda: by_pace(fewer, cfg.seed),
        "mujoco.sysid": lambda: by_sysid(fewer),
    }
    for rival, way in ways.items():
        if rival in cfg.rivals:
            begin = time.monotonic()
            found = way()
            took, commits[rival] = time.monotonic() - begin, commit()
        else:
            found, took = known.get("parameters", {}).get(rival), known.get("seconds", {}).get(rival)
            commits[rival] = known.get("commits", {}).get(rival)
        if found is not None:
            points[rival], seconds[rival] = np.asarray(found), took
    errors: dict[str, dict[str, list[float]]] = {}
    medians: dict[str, dict[str, list[float]]] = {}
    for who in ("given", "ours", *(who for who in points if who != "given")):
        for split, replay in (("train", train.with_windows(SCORED)), ("heldout", held)):
            square = replay.mean_square_of(corrected) if who == "ours" else replay.mean_square(points[who])
            errors.setdefault(who, {})[split] = np.sqrt(square.mean(0)).tolist()
            medians.setdefault(who, {})[split] = np.sqrt(np.median(square, axis=0)).tolist()
    return {
        "errors": errors,
        "medians": medians,
        "parameters": {who: np.round(x, 9).tolist() for who, x in points.items()},
        "joints": list(train.names),
        "unit": robot.unit,
        "looked_at": robot.looked_at,
        "log": [len(robot.recordings), round(sum(r.duration for r in robot.recordings), 1)],
        "seconds": {who: round(s, 1) for who, s in seconds.items()},
        "commits": {who: of for who, of in commits.items() if who in seconds},
        "judge": JUDGE,
        **ours,
    }


def _fitted(robot: Robot, folder: Path | None, seed: int) -> tuple[dict[str, Any], Simulation]:
    """What our fit took and found, and its simulation."""
    forget_memory()
    begin, used = time.monotonic(), time.process_time()
    found = fit(robot.xml, robot.recordings, robot.heldout, seed=seed, output=folder)
    told = {
        "seconds": time.monotonic() - begin,
        "cpu": round(time.process_time() - used, 1),
        "memory": round(most_memory() / 1e9, 2),
        "fitted": [asdict(p) for p in found.parameters if p.value != p.given],
        "remarks": list(found.remarks),
    }
    return told, found.corrected


def _kept(robot: Robot, folder: Path | None, known: Mapping[str, Any]) -> tuple[dict[str, Any], Simulation]:
    """What an earlier fit of ours took and found, and its simulation, from its folder."""
    if folder is None:
        raise ValueError("without --ours its fit is read from --fits, which is None: name the folder.")
    model = mujoco.MjModel.from_xml_string(robot.xml)
    corrected = Simulation.from_json(json.loads((folder / "corrected.json").read_text("utf-8")), model)
    told = {key: known[key] for key in ("cpu", "memory", "fitted", "remarks")}
    return {"seconds": known["seconds"]["ours"], **told}, corrected


def _known(case: str, cfg: Config) -> dict[str, Any]:
    """What an earlier run left of a robot.

    Raises:
        ValueError: If it is needed and there is none.
    """
    store = cfg.output.with_suffix(".json")
    rows: dict[str, dict[str, Any]] = json.loads(store.read_text("utf-8")) if store.exists() else {}
    if case not in rows and not (cfg.ours and cfg.rivals):
        raise ValueError(f"{store}: it holds no {case!r}. Run it with ours and with rivals first.")
    return rows.get(case, {})


def folder_of(fits: Path, case: str) -> Path:
    """Where our fit of a robot lies."""
    return fits / "".join(letter if letter.isalnum() else "_" for letter in case)


def forget_memory() -> None:
    """Let :func:`most_memory` start anew, where Linux allows it."""
    with contextlib.suppress(OSError):
        Path("/proc/self/clear_refs").write_text("5")


def most_memory() -> float:
    """Most memory that this process held since [byte]; what it loaded before counts."""
    try:
        [line] = [x for x in Path("/proc/self/status").read_text().splitlines() if x.startswith("VmHWM")]
        return 1024.0 * float(line.split()[1])
    except (OSError, ValueError):
        return 1024.0 * resource.getrusage(resource.RUSAGE_SELF).ru_maxrss


def ratio(r: Row) -> float:
    """Error kept aside per that of the best rival, joints pooled."""
    pooled = {who: float(np.sqrt(np.mean(np.square(e["heldout"])))) for who, e in r["errors"].items()}
    return pooled["ours"] / min((e for who, e in pooled.items() if who not in ("given", "ours")), default=float("nan"))


def worse(r: Row) -> list[str]:
    """Joints that follow recordings kept aside worse than the given model does."""
    given, ours = (r["errors"][who]["heldout"] for who in ("given", "ours"))
    return [name for name, g, o in zip(r["joints"], given, ours, strict=True) if o > WORSE * g]


def dry_friction(r: Row) -> float:
    """Dry friction of the first joint by whatever law it was named: the mean of both ways [N·m, N]."""
    own = {p["effect"] + "." + p["name"]: p["value"] for p in r["fitted"] if p["joint"] == r["joints"][0]}
    both_ways = [own.get(f"asymmetric_friction.coulomb_{side}", 0.0) for side in ("positive", "negative")]
    alone = ("coulomb_friction.torque", "stribeck_friction.coulomb", "load_dependent_friction.coulomb")
    return float(np.mean(both_ways) + sum(own.get(name, 0.0) for name in (*alone, "hysteresis.torque")))


def table(rows: Mapping[str, Row]) -> str:
    """The results as Markdown."""
    rivals = list(dict.fromkeys(who for r in rows.values() for who in r["errors"]))
    lines = [
        "Made by `python -m benchmarks.real_robots.run --data CLONES`. RMSE over 0.5 s windows of recordings kept "
        "aside, by one neutral replay, joint by joint; in brackets that of the median window. The machine was shared: "
        "times are upper bounds.",
        "",
        f"| robot | {' | '.join(rivals)} | ours / best rival | joints made worse | looked at |",
        "|---" * (len(rivals) + 4) + "|",
    ]
    for case, r in rows.items():
        cells = " | ".join(_cell(r, who) for who in rivals)
        lines.append(f"| {case} | {cells} | {_said(ratio(r))} | {', '.join(worse(r)) or 'none'} | {r['looked_at']} |")
    lines += [
        "",
        f"Median of the ratios: {_said(float(np.nanmedian([ratio(r) for r in rows.values()])))}.",
        "",
        "| robot | log | CPU time, ours | memory, ours | time: ours, rivals; by hand is two fits "
        "| commits: ours, rivals | machine |",
        "|---|---|---|---|---|---|---|",
    ]
    for case, r in rows.items():
        times = ", ".join(f"{s:.0f} s" for s in r["seconds"].values())
        commits = ", ".join(dict.fromkeys(r["commits"].values()))
        takes = f"{r['log'][0]} × {r['log'][1] / r['log'][0]:.0f} s"
        lines.append(
            f"| {case} | {takes} | {r['cpu']:.0f} s | {r['memory']:.2f} GB | {times} | {commits} | {r['machine']} |"
        )
    damped = {case: dry_friction(r) for case, r in rows.items() if case.startswith("damper")}
    if damped:
        lines += ["", "Dry friction that was fitted: " + ", ".join(f"{c} {1e-3 * f:.2f} kN" for c, f in damped.items())]
    remarks = [f"- {case}: {text}" for case, r in rows.items() for text in r["remarks"]]
    return "\n".join([*lines, "", *remarks]).rstrip() + "\n"


def _said(number: float) -> str:
    return "" if np.isnan(number) else f"{number:.2f}"


def _cell(r: Row, who: str) -> str:
    if who not in r["errors"]:
        return ""
    scale, unit = (1e3, "mm" if r["unit"] == "m" else "mrad")
    e, m = (" / ".join(f"{scale * v:.3g}" for v in r[k][who]["heldout"]) for k in ("errors", "medians"))
    return f"{e} ({m}) {unit}"


if __name__ == "__main__":
    main(tyro.cli(Config))
