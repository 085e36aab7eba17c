"""Whether the proposed experiment leaves one name, where the recordings at hand left several.

    python benchmarks/concealed/run.py --split tuning --block unidentifiable --jobs 2
    python benchmarks/concealed/next_experiment.py --split tuning --jobs 2
    python benchmarks/concealed/next_experiment.py --split tuning --table      # of what is done so far; runs nothing

Takes the cases whose answer has rivals, and goes through what a user would do: ``recipes/diagnose.py``, its
``next_experiment.npz`` replayed on the concealed robot and logged by the same sensors, ``--continue``. What is done is
kept, one file a case beside the answers, and skipped the next time. Two diagnoses a case.
"""

from __future__ import annotations

import json
import os
import subprocess
import sys
import tempfile
import time
from collections import Counter
from collections.abc import Mapping, Sequence
from concurrent.futures import ProcessPoolExecutor, as_completed
from dataclasses import dataclass
from multiprocessing import Value
from pathlib import Path
from typing import Any, Literal, get_args

import numpy as np
import tyro
from numpy.typing import NDArray
from tqdm import tqdm

sys.path.append(str(Path(__file__).parents[2]))

from benchmarks.concealed.cases import (
    Case,
    Session,
    Split,
    _inside,
    generator,
    identities,
    move,
    prepare,
    source_digest,
)
from benchmarks.concealed.hidden import Truth, conceal
from benchmarks.concealed.robots import Robot
from benchmarks.concealed.run import _pin, export, is_done, program_digest
from benchmarks.concealed.score import Row, load
from benchmarks.concealed.takes import Plan, drive_for, log
from torchrl_athletic.diagnosis.corrected import write_json
from torchrl_athletic.recordings import Recording, write_recording

Array = NDArray[np.float64]
Name = tuple[str, str | None]
Grade = Literal["one", "identical", "several", "wrong", "lost", "not proposed", "failed", "clear"]
GRADES: tuple[Grade, ...] = get_args(Grade)

BLOCKS = ("unidentifiable", "single")
LEFT = 0.9
"""Share of an answer set's probability from which a name is the one that is left."""
INERTIA = 0.15
"""Share of a link's inertia that any model may be off, without that being a finding."""
TAKE = 1000
"""Number of the first experiment's take, far from those of the case: it has random numbers of its own."""
RECIPE = Path(__file__).parents[2] / "recipes" / "diagnose.py"


@dataclass(frozen=True)
class Config:
    """Every field is a flag."""

    split: Split = "tuning"
    seed: int = 0
    folder: Path = Path("outputs/concealed")
    """As written by run.py; answers come from diagnosis/ of it, what is done goes into experiment/."""
    limit: int | None = None
    """Ambiguous cases of each block; all of them if left out."""
    rounds: int = 1
    """Experiments in a row, as long as rivals are left and another one is proposed."""
    jobs: int = 2
    """Processes at a time, each on one core."""
    timeout: float = 900.0
    """Time limit of one diagnosis [s]."""
    table: bool = False
    """Run nothing."""
    output: Path = Path("benchmarks/results")


def main(cfg: Config) -> None:
    rows = [r for r in load(cfg.folder / "diagnosis", cfg.split, cfg.seed) if r.case.block in BLOCKS and ambiguous(r)]
    wanted = [r.case for block in BLOCKS for r in [r for r in rows if r.case.block == block][: cfg.limit]]
    folder = cfg.folder / "experiment"
    folder.mkdir(parents=True, exist_ok=True)
    todo = [] if cfg.table else [case for case in wanted if not is_done(folder / f"{case.name}.json")]
    alike = {r.case.name for r in rows if is_alike(r)}
    todo.sort(key=lambda case: case.name in alike)  # what a run cut short leaves out is what a motion hardly tells
    print(f"{len(wanted)} ambiguous cases, {len(wanted) - len(todo)} of them not to be run")
    with ProcessPoolExecutor(cfg.jobs, initializer=_pin, initargs=(Value("i", 0),)) as pool:
        pending = [pool.submit(run_case, cfg, case.block, case.index) for case in todo]
        for done in tqdm(as_completed(pending), total=len(pending), unit="case", disable=not todo):
            tqdm.write(done.result())
    graded = [(case, _read(path)) for case in wanted if (path := folder / f"{case.name}.json").exists()]
    if not graded:
        raise SystemExit(f"{folder} holds no answer of {cfg.split}, seed {cfg.seed}.")
    text = "\n".join(report(graded, cfg.split, cfg.seed))
    (cfg.output / f"concealed_experiment_{cfg.split}_{cfg.seed}.md").write_text(text + "\n", encoding="utf-8")
    print(text)


def ambiguous(row: Row) -> bool:
    """Whether an answer leaves several names for what is hidden.

    One that stands in for something else, beside a finding with the right name alone, has no name to be left with.
    """
    sets = [answer_set(f) for f in row.findings]
    if all(max(s.values()) >= LEFT for s in sets):
        return False
    same = same_physics(row.case)
    return any(max(s.values()) < LEFT for s in [s for s in sets if s.keys() & same] or sets)


def is_alike(row: Row) -> bool:
    """Whether all that an answer leaves open is which name of the same physics to use."""
    same = same_physics(row.case)
    return all(s.keys() <= same for s in map(answer_set, row.findings) if max(s.values()) < LEFT)


def _read(path: Path) -> dict[str, Any]:
    content: dict[str, Any] = json.loads(path.read_text(encoding="utf-8"))
    return content


# --- one case ---------------------------------------------------------------------------------------------------------


def run_case(cfg: Config, block: str, index: int) -> str:
    """Diagnose, experiment, continue; keep the answers. Returns a line for the terminal."""
    session, begin = prepare(cfg.split, block, index, cfg.seed), time.monotonic()
    made_by = {"source": source_digest(), "program": program_digest("diagnosis")}
    result: dict[str, Any] = {"case": session.case.name, **made_by, "answers": [], "experiments": []}
    try:
        with tempfile.TemporaryDirectory(prefix="concealed_") as temporary:
            _rounds(cfg, session, Path(temporary), result)
    except subprocess.TimeoutExpired:
        result["error"] = f"not finished after {cfg.timeout:g} s"
    except Exception as error:  # a case that fails is a result, and must not stop the others
        result["error"] = f"{type(error).__name__}: {error}"[-2000:]
    result["seconds"] = round(time.monotonic() - begin, 1)
    write_json(cfg.folder / "experiment" / f"{session.case.name}.json", result)
    return f"{session.case.name}  {result['seconds']:.0f} s  {grade(session.case, result)} {result.get('error', '')}"


def _rounds(cfg: Config, session: Session, folder: Path, result: dict[str, Any]) -> None:
    export(session, folder)
    out = folder / "out"
    given: list[str | Path] = [
        "--model",
        folder / "model.xml",
        "--recordings",
        folder / "fit",
        "--heldout",
        folder / "aside",
    ]
    result["answers"].append(_diagnosis(given, out, cfg.timeout))
    for k in range(cfg.rounds):
        if not (out / "next_experiment.npz").exists():
            break
        recording = replayed(session, out / "next_experiment.npz", TAKE + k)
        plan = _read(out / "next_experiment.json")
        result["experiments"].append(plan)
        write_recording(recording, folder / f"experiment_{k + 1}.npz")
        flags: list[str | Path] = [
            "--continue",
            folder / f"experiment_{k + 1}.npz",
            "--payload",
            str(plan["payload_kg"]),
        ]
        result["answers"].append(_diagnosis(flags, out, cfg.timeout))


def _diagnosis(flags: Sequence[str | Path], out: Path, timeout: float) -> dict[str, Any]:
    command = [sys.executable, str(RECIPE), *map(str, flags), "--output", str(out)]
    done = subprocess.run(
        command, capture_output=True, text=True, check=False, timeout=timeout,
        env={**os.environ, "OMP_NUM_THREADS": "1"},
    )  # fmt: skip
    if done.returncode:
        raise RuntimeError(done.stderr[-1500:])
    return _read(out / "diagnosis.json")


def replayed(session: Session, command: Path, take: int) -> Recording:
    """The concealed robot follows a command file, at the rate of its own loop, and logs as ever.

    A robot that takes position targets gets them with the file's gains, which are its own; for one that takes torques
    the loop ``kp (target - q) - kd v`` runs on the user's side, and the torques are logged.

    Raises:
        RuntimeError: If the robot leaves the range of its model.
    """
    case, robot = session.case, session.robot
    with np.load(command, allow_pickle=False) as file:
        stamps, target, kp, kd = (np.asarray(file[k]) for k in ("time", "position_target", "kp", "kd"))
        weight = float(json.loads(str(file["metadata"]))["payload_kg"])
    time_ = np.arange(0.0, stamps[-1], 1.0 / case.rate)
    # a target is held until the next one comes
    held = target[np.clip(np.searchsorted(stamps, time_ + 1e-9, side="right") - 1, 0, None)]
    still = np.zeros_like(held)
    rng = generator(case.split, case.block, case.index, case.seed + 7919 * (take + 1))
    motion = Plan("experiment", time_, held, still, still, still)
    drive = drive_for(robot, motion, case.mode, kp, kd, session.sensors, take, rng)._replace(feedforward=still)
    fastened = Truth("payload", robot.joint_names[-1], {"mass": weight})
    body = conceal(session.body, robot, fastened, False, rng) if weight else session.body
    logged, reading, speed, clean, _ = move(body, robot, drive)
    if not _inside(robot, clean):
        raise RuntimeError(f"{case.name}: the proposed experiment drives the robot out of its range.")
    return log(robot, drive, session.sensors, logged, reading, speed, f"experiment_{take}", rng)


# --- what is left -----------------------------------------------------------------------------------------------------


def grade(case: Case, result: Mapping[str, Any]) -> Grade:
    """What the last answer leaves of the finding that speaks of what is hidden.

    ``one``: the truth has nine tenths of the answer set's probability or more; ``identical``: names that are the same
    physics of this robot in any motion have; ``several``: the truth is among others; ``wrong``: another name has, or is
    stated above one half beside these; ``lost``: nothing in any answer set is true; ``not proposed``: there was no
    experiment, and more than one name; ``clear``: nor was there more than one, since another program gave the answers
    that were ambiguous.
    """
    if "error" in result:
        return "failed"
    right: Name = (case.truths[0].effect, case.truths[0].joint)
    same = same_physics(case)
    last = result["answers"][-1]["findings"]
    sets = [answer_set(f) for f in last]
    about = [s for s in sets if s.keys() & same]
    if not about:
        return "lost"
    if any(f["probability"] > 0.5 and (f["effect"], f["joint"]) not in same for f in last):
        return "wrong"
    shares = max(about, key=lambda s: sum(p for name, p in s.items() if name in same))
    if shares.get(right, 0.0) >= LEFT:
        return "one" if result["experiments"] else "clear"
    if sum(p for name, p in shares.items() if name in same) >= LEFT:
        return "identical"
    if max(shares.values()) >= LEFT:
        return "wrong"
    return "several" if result["experiments"] else "not proposed"


def same_physics(case: Case) -> set[Name]:
    """The truth, and what no motion of this robot tells from it; an identity holds both ways."""
    truth, robot = case.truths[0], prepare(case.split, case.block, case.index, case.seed).robot
    right: Name = (truth.effect, truth.joint)
    others = [o for o in case.equivalents[0] if right in identities(Truth(*o, {}), robot, case.mode)]
    first = robot.joint_names[0]
    turned: set[Name] = {("gravity_tilt", None), ("encoder_offset", first)} if is_planar(robot) else set()
    if truth.effect == "encoder_offset" and stands_on_level_axis(robot):
        turned = {("gravity_tilt", None), ("encoder_offset", first)}
    heavier: set[Name] = (
        {(e, first) for e in ("payload", "link_mass", "reflected_inertia")} if is_level(robot) else set()
    )
    measured: set[Name] = {(e, first) for e in ("torque_scale", "encoder_scale")} if is_level(robot) else set()
    more = [name for group in (turned, heavier, measured) if right in group for name in group]
    return {right, *identities(truth, robot, case.mode), *others, *more, *weights_alike(truth, robot)}


def weights_alike(truth: Truth, robot: Robot) -> set[Name]:
    """What else gives a single hinge the same moment of weight, and an inertia within what any model's may be off.

    Weight and inertia are all that such a robot has, and a known weight at its end adds the same to both names.
    """
    tree, own, p = robot.tree, robot.joint_names[0], truth.parameters
    if robot.joints > 1 or tree.slide[0] or truth.effect not in ("payload", "link_com") or not p:
        return set()
    mass, near, far = float(tree.mass[0]), float(np.linalg.norm(tree.com[0])), float(np.linalg.norm(robot.tip[0]))
    moved = p["mass"] * far if truth.effect == "payload" else mass * (p["distance"] - near)
    by_payload, by_centre = moved * far, mass * ((near + moved / mass) ** 2 - near**2)
    inertia = float(tree.axis[0] @ tree.inertia[0] @ tree.axis[0]) + mass * near**2
    alike = moved > 0 and abs(by_payload - by_centre) < INERTIA * inertia
    return {("payload", own), ("link_com", own)} if alike else set()


def is_level(robot: Robot) -> bool:
    """Whether the robot is one level slide, on which all that is heavier only resists.

    There is no place on it either: read in other units, all of its motion needs more torque by one factor.
    """
    tree = robot.tree
    return robot.joints == 1 and bool(tree.slide[0]) and abs(float(tree.turn[0][2] @ tree.axis[0])) < 1e-9


def stands_on_level_axis(robot: Robot) -> bool:
    """Whether the first joint is a hinge with a level axis.

    Nothing but gravity knows where a fixed base's first joint stands, so that its encoder's offset is a base that leans
    about its axis. A base that leans otherwise is no such offset, unless all axes are parallel.
    """
    tree = robot.tree
    return not tree.slide[0] and abs(float((tree.turn[0] @ tree.axis[0])[2])) < 1e-9


def is_planar(robot: Robot) -> bool:
    """Whether all joints turn about parallel level axes.

    Then a base that leans turns the whole robot, as the first encoder's offset does; what it leans sideways takes a
    cosine of the weight of all links, which is within what their masses may be off.
    """
    turn, axes = np.eye(3), []
    for k in range(robot.joints):
        turn = turn @ robot.tree.turn[k]
        axes.append(turn @ robot.tree.axis[k])
    level = all(abs(axis[2]) < 1e-9 and abs(abs(axis @ axes[0]) - 1) < 1e-9 for axis in axes)
    chain = all(int(robot.tree.parent[k]) == k - 1 for k in range(robot.joints))
    return level and chain and not robot.tree.slide.any()


def answer_set(finding: Mapping[str, Any]) -> dict[Name, float]:
    """A finding and its rivals, and the share that each has of their probability."""
    of = {(a["effect"], a["joint"]): float(a["probability"]) for a in (*finding["rivals"], finding)}
    total = sum(of.values())
    return {name: p / total if total > 0 else 0.0 for name, p in of.items()}


def report(graded: Sequence[tuple[Case, Mapping[str, Any]]], split: str, seed: int) -> list[str]:
    """Counts before and after, and every case."""
    out = [f"# The proposed experiment: the split `{split}`, seed {seed}", ""]
    out += ["| block | ambiguous cases | one name left | or names of the same physics | several | wrong | lost | "
            "not proposed | failed | clear from the start |", "|---|---|---|---|---|---|---|---|---|---|"]  # fmt: skip
    for block in (*BLOCKS, "all"):
        n = Counter(grade(case, r) for case, r in graded if block in (case.block, "all"))
        out.append(f"| {block} | {n.total()} | {' | '.join(str(n[g]) for g in GRADES)} |")
    told = n.total() - n["identical"] - n["clear"]  # of all blocks, which come last
    out += ["", f"Of the {told} cases whose names are not all the same physics, {n['one']} are left with one name."]
    out += ["", "| case | robot | hidden | before | experiment | after | left |", "|---|---|---|---|---|---|---|"]
    for case, r in graded:
        truth, answers = case.truths[0], r["answers"]
        said = [_said(a) for a in answers] or ["-"]
        plan = "; ".join(e["sentence"].split(", ")[0] for e in r["experiments"]) or "-"
        after = said[-1] if r["experiments"] and len(answers) > 1 else r.get("error", "-")[-80:]
        hidden = f"`{truth.effect}` {truth.joint}"
        words: list[str] = [f"{case.block} {case.index}", case.robot, hidden, said[0], plan, after, grade(case, r)]
        out.append(f"| {' | '.join(words)} |".replace("\n", " "))
    return out


def _said(answer: Mapping[str, Any]) -> str:
    return "<br>".join(
        ", ".join(f"`{e}` {j} {p:.2f}" for (e, j), p in sorted(answer_set(f).items(), key=lambda item: -item[1]))
        for f in answer["findings"]
    )


if __name__ == "__main__":
    main(tyro.cli(Config))
