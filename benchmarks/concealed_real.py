"""Conceal physics on real benches and arms, and see whether the diagnosis finds it.

    ATHLETIC_DATA=... ATHLETIC_CLONES=... python benchmarks/concealed_real.py --jobs 2
    python benchmarks/concealed_real.py --only 'pendulum-*' 'emps-removed-*'
    python benchmarks/concealed_real.py --table            # of what is done so far; runs nothing

A bench's *complete* model is the published one, with its friction, rotors, masses and delays; three arms of several
joints, whose published models have none of these, have a hand fit instead (``real_robots/complete.py``), and their logs
lie in the folder of clones that ``ATHLETIC_CLONES`` names; without one their cases are left out. From it one effect is
taken away (``removed``), or one is put into the recordings (``injected``); the ``complete`` model itself is the
control. One robot was really recorded with a weight that its model lacks (``added``). ``left_out`` keeps one kind of
motion aside and fits the others. Nothing tells the diagnosis which case it has.

A case takes ten seconds to two minutes of one core, in a process of its own. What is done is kept, one JSON a case
under ``--answers``, and skipped the next time, unless the diagnosis has changed since; tables go to ``--output``.
"""

from __future__ import annotations

import json
import os
import platform
import re
import subprocess
import sys
import time
from collections.abc import Callable, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor, as_completed
from dataclasses import dataclass, replace
from fnmatch import fnmatch
from functools import cache, partial
from multiprocessing import Value
from pathlib import Path
from typing import Any, Literal

import mujoco
import numpy as np
import tyro
from numpy.typing import NDArray
from tqdm import tqdm

sys.path.append(str(Path(__file__).parents[1]))

from benchmarks.concealed.run import _pin, program_digest
from benchmarks.real_robots.complete import ARMS, complete_arm, loaded_arm
from benchmarks.real_robots.robots.robot import Robot
from torchrl_athletic.diagnosis import diagnose
from torchrl_athletic.diagnosis.corrected import Simulation, write_atomically, write_json
from torchrl_athletic.diagnosis.fit import Hypothesis
from torchrl_athletic.recordings import Recording
from torchrl_athletic.recordings.datasets import load_dataset
from torchrl_athletic.robots import benches

Kind = Literal["complete", "removed", "injected", "added", "left_out"]
Name = tuple[str, str | None]
"""An effect and its joint; None for the whole robot."""

CLONES = "ATHLETIC_CLONES"
"""Environment variable that names the folder of clones, see ``real_robots/robots/``."""
LEAST = 0.05
"""Probability from which a name counts as stated, or as a rival."""
VISIBLE = 3.0
"""What concealing moves the simulated fitted takes by, over their noise floor, from which the noise allows a name."""
CLOSED = 0.5
"""Share of the gap on a kind of motion that was left out, from which its physics counts as understood."""
CONTAINS: Mapping[str, frozenset[str]] = {
    "coulomb_friction": frozenset({"stribeck_friction", "load_dependent_friction", "asymmetric_friction"}),
    "viscous_friction": frozenset({"asymmetric_friction"}),
    "torque_offset": frozenset({"asymmetric_friction"}),
}
"""Laws that hold another one as a special case, and what real friction may well be: listed apart."""
GRADES = ("named", "contained", "rival", "control", "joint", "missed", "failed")
"""Best first, see :func:`graded`."""


@dataclass(frozen=True)
class Config:
    """Every field is a flag."""

    only: tuple[str, ...] = ()
    """Patterns, such as 'emps-*' and '*-removed-*'; cases whose name fits one are run. All of them if left out."""
    jobs: int = 2
    """Processes at a time, each on one core."""
    timeout: float = 900.0
    """Time limit of a case [s]; one that takes longer counts as failed."""
    time_budget: float | None = None
    """That each diagnosis is given [s], of one core; six joints take ten minutes or more without."""
    fresh: tuple[str, ...] = ()
    """Benches whose cases are run again although they are done, such as 'emps'; '*' for all."""
    table: bool = False
    """Run nothing."""
    case: str | None = None
    """Run this case alone and keep its answer: what the benchmark starts for each."""
    answers: Path = Path("outputs/concealed_real")
    output: Path = Path("benchmarks/results/concealed_real.md")


@dataclass(frozen=True, eq=False)
class Takes:
    """What a diagnosis is given."""

    model: str
    """MJCF."""
    fit: tuple[Recording, ...]
    aside: tuple[Recording, ...]

    def changed(self, by: Callable[[Recording], Recording]) -> Takes:
        """The takes with every recording changed."""
        return replace(self, fit=tuple(map(by, self.fit)), aside=tuple(map(by, self.aside)))


@dataclass(frozen=True, eq=False)
class Case:
    """One effect that is concealed in one bench."""

    bench: str
    kind: Kind
    what: str
    size: str
    takes: Callable[[], Takes]
    truths: tuple[Name, ...] = ()
    """Names that are right, identities included; none where nothing may be named."""

    @property
    def name(self) -> str:
        """Name of its file."""
        return "-".join(re.sub(r"[^A-Za-z0-9.-]+", "_", p) for p in (self.bench, self.kind, self.what, self.size) if p)


def main(cfg: Config) -> None:
    if cfg.case is not None:
        run(cfg.case, cfg.answers, cfg.time_budget)
        return
    wanted = [c for c in cases() if not cfg.only or any(fnmatch(c.name, pattern) for pattern in cfg.only)]
    if CLONES not in os.environ:
        print(f"Without {CLONES}, the arms {', '.join(ARMS)} are left out.")
        wanted = [c for c in wanted if c.bench not in ARMS]
    undone = [c for c in wanted if _again(c, cfg) or not _is_done(cfg.answers / f"{c.name}.json", cfg)]
    todo = [] if cfg.table else undone
    print(f"{len(wanted)} cases, {len(wanted) - len(todo)} of them not to be run")
    todo.sort(key=lambda c: DEAREST.index(c.bench))
    for bench in {c.bench for c in todo}:  # said now, and once
        complete(bench)
    with ThreadPoolExecutor(cfg.jobs, initializer=_pin, initargs=(Value("i", 0),)) as pool:
        pending = [pool.submit(in_own_process, c.name, cfg) for c in todo]
        for done in tqdm(as_completed(pending), total=len(pending), unit="case", disable=not todo):
            tqdm.write(done.result())
    rows = load(cfg.answers)
    if not rows:
        raise SystemExit(f"{cfg.answers} holds no answer of any case.")
    write_json(cfg.output.with_suffix(".json"), {"cases": rows, "figures": figures(rows)})
    write_atomically(cfg.output, report(rows))
    print("\n".join(summary(rows)))
    print(f"Tables: {cfg.output}")


def _again(case: Case, cfg: Config) -> bool:
    return any(fnmatch(case.bench, pattern) for pattern in cfg.fresh)


def _is_done(path: Path, cfg: Config) -> bool:
    kept = _read(path) or {}
    same = kept.get("program") == program_digest("diagnosis") and kept.get("time_budget") == cfg.time_budget
    return "answer" in kept and same


def in_own_process(name: str, cfg: Config) -> str:
    """Diagnose one case on the core that this thread is pinned to. Returns a line for the terminal.

    A case that fails is a result, and must not stop the others: what is known of it by then is kept with the error.
    """
    path, begin = cfg.answers / f"{name}.json", time.monotonic()
    path.unlink(missing_ok=True)
    command = [sys.executable, __file__, "--case", name, "--answers", str(cfg.answers)]
    command += [] if cfg.time_budget is None else ["--time-budget", str(cfg.time_budget)]
    environment = {**os.environ, "OMP_NUM_THREADS": "1"}
    error = ""
    try:
        done = subprocess.run(
            command, capture_output=True, text=True, check=False, timeout=cfg.timeout, env=environment
        )
        if done.returncode:
            error = f"exit {done.returncode}: {' '.join(done.stderr[-1500:].split())}"
    except subprocess.TimeoutExpired:
        error = f"not finished after {cfg.timeout:g} s"
    seconds = round(time.monotonic() - begin, 1)
    content = _read(path) or _begun(name, cfg.time_budget)
    if error:
        content |= {"error": error, "seconds": seconds}
        write_json(path, content)
    said = ", ".join(_said(f) for f in content.get("answer", {}).get("findings", ()))
    return f"{name}  {seconds:.0f} s  {said or error[-200:] or 'nothing named'}"


def _begun(name: str, time_budget: float | None) -> dict[str, Any]:
    made = {"commit": _commit(), "program": program_digest("diagnosis"), "machine": platform.machine()}
    return {"case": name, "time_budget": time_budget, **made}


def run(name: str, folder: Path, time_budget: float | None = None) -> None:
    """Diagnose one case and keep what was said; what concealing moves is kept before, as no failure changes it."""
    begin = time.monotonic()
    case = next(c for c in cases() if c.name == name)
    content, takes = _begun(name, time_budget), case.takes()
    if case.kind in ("removed", "injected"):
        content["moved"] = moved(complete(case.bench), takes)
        write_json(folder / f"{name}.json", content)
    found = diagnose(takes.model, takes.fit, takes.aside, seed=0, time_budget=time_budget)
    content["answer"] = found.answer.to_json()
    content["seconds"] = round(time.monotonic() - begin, 1)
    write_json(folder / f"{name}.json", content)


def moved(whole: Takes, concealed: Takes) -> dict[str, float]:
    """RMS by which concealing changes the error of the fitted takes over 0.5 s windows [rad, m], joint by joint."""
    names = whole.fit[0].joint_names
    square = np.zeros(len(names))
    for before, after in zip(whole.fit, concealed.fit, strict=True):
        square += ((_error(concealed.model, after) - _error(whole.model, before)) ** 2).sum(0)
    rms = np.sqrt(square / sum(r.num_samples for r in whole.fit))
    return {name: float(value) for name, value in zip(names, rms, strict=True)}


def _error(model: str, recording: Recording) -> NDArray[np.float64]:
    given = Simulation(mujoco.MjModel.from_xml_string(model), recording.joint_names, Hypothesis(()), np.zeros(0))
    return given.rollout(recording) - recording.position


# --- the benches, complete --------------------------------------------------------------------------------------------


dataset = cache(load_dataset)


@cache
def complete(bench: str) -> Takes:
    """A bench with the published physics in its model; what MJCF cannot hold is taken out of the recordings instead."""
    if bench in ARMS:
        return _takes(complete_arm(bench, Path(os.environ[CLONES])))
    data = dataset(bench)
    takes = Takes(data.model, tuple(data.recordings), tuple(data.heldout))
    if bench == "two_link_arm":  # model_2.0; driven by the measured torque, so that the drives' lag is not in question
        model = benches.two_link_arm(
            rotor_inertia=7.659297952841183e-05, damping=(0.001, 0.001), frictionloss=(0.093, 0.078)
        )
        return replace(takes, model=model).changed(Recording.driven_by_measured_torque)
    if bench == "pendulum":  # of the published numbers, which contradict each other, those that shorten every error
        return replace(takes, model=benches.pendulum(frictionloss=0.1839, armature=6**2 * 6.07e-5))
    if bench == "unbalanced_disk":  # one sample of delay and the encoder's zero, as a refit of the source's model has
        return takes.changed(lambda r: misread(late(r, 0.025), 0, -0.0333))
    return takes  # emps and xl330 start from published models that have everything


def _takes(robot: Robot) -> Takes:
    return Takes(robot.xml, tuple(robot.recordings), tuple(robot.heldout))


def carrying(harmonics: int) -> Takes:
    """The UR10e with a weight at its flange."""
    return _takes(loaded_arm(Path(os.environ[CLONES]), harmonics))


def edited(bench: str, edit: Callable[[mujoco.MjSpec], None]) -> Takes:
    """A complete bench with something changed in its model."""
    takes = complete(bench)
    spec = mujoco.MjSpec.from_string(takes.model)
    edit(spec)
    spec.compile()
    return replace(takes, model=spec.to_xml())


def recorded(bench: str, change: Callable[[Recording], Recording]) -> Takes:
    """A complete bench with something changed in its recordings."""
    return complete(bench).changed(change)


# --- what is concealed ------------------------------------------------------------------------------------------------


def without_friction(spec: mujoco.MjSpec, joint: str) -> None:
    """No dry friction."""
    spec.joint(joint).frictionloss = 0.0


def without_damping(spec: mujoco.MjSpec, joint: str) -> None:
    """No viscous friction."""
    spec.joint(joint).damping[0] = 0.0


def without_rotor(spec: mujoco.MjSpec, joint: str) -> None:
    """No rotor behind the gear; the arm's elbow has it in a tendon, since it turns with the shoulder too."""
    spec.joint(joint).armature = 0.0
    for tendon in spec.tendons:
        tendon.armature = 0.0


def with_mass(spec: mujoco.MjSpec, joint: str, share: float) -> None:
    """A link of another density."""
    link = spec.joint(joint).parent
    link.mass *= share
    link.inertia = np.array(link.inertia) * share


def with_inertia(spec: mujoco.MjSpec, joint: str, missing: float) -> None:
    """A link that is harder to turn in truth, by ``missing`` [kg·m²]."""
    link = spec.joint(joint).parent
    link.inertia = np.array(link.inertia) - missing


def level(spec: mujoco.MjSpec) -> None:
    """Gravity straight down."""
    spec.option.gravity = [0.0, 0.0, spec.option.gravity[2]]


def upright(spec: mujoco.MjSpec, body: str) -> None:
    """The encoder's zero at the vertical."""
    spec.body(body).alt.axisangle = [0, 1, 0, 0]


def late(recording: Recording, seconds: float, joint: int | None = None) -> Recording:
    """A log whose commands are stamped later, by whole samples; negative ones make the robot answer late.

    Args:
        recording: As logged.
        seconds: By which the stamps of the commands grow [s].
        joint: Index of the joint; None for all.
    """
    half = 0.25 / recording.rate  # so that rounding of stamps takes no sample for its neighbour
    at = np.searchsorted(recording.time, recording.time - seconds + half, side="right") - 1
    shifted = recording.command[np.clip(at, 0, recording.num_samples - 1)]
    command = recording.command.copy()
    chosen = slice(None) if joint is None else joint
    command[:, chosen] = shifted[:, chosen]
    if recording.position_target is not None:
        return replace(recording, position_target=command)
    return replace(recording, torque_command=command)


def misread(recording: Recording, joint: int, offset: float) -> Recording:
    """A log whose encoder reads ``offset`` too much [rad]; a position target follows, since the servo reads it too."""
    shift = offset * (np.arange(recording.num_joints) == joint)
    target = None if recording.position_target is None else recording.position_target + shift
    return replace(recording, position=recording.position + shift, position_target=target)


def coarse(recording: Recording, step: float) -> Recording:
    """A log of an encoder with this step [rad, m]; who reads it has no better velocity either."""
    return replace(recording, position=step * np.round(recording.position / step), velocity=None)


def weak(recording: Recording, joint: int, scale: float) -> Recording:
    """A log whose motor of one joint gives ``scale`` times what was commanded."""
    assert recording.torque_command is not None
    per_joint = np.where(np.arange(recording.num_joints) == joint, 1 / scale, 1.0)
    return replace(recording, torque_command=recording.torque_command * per_joint)


def stiff(recording: Recording, joint: int, scale: float) -> Recording:
    """A log whose servo of one joint is ``scale`` times as stiff as its gain says."""
    assert recording.kp is not None
    return replace(recording, kp=recording.kp / np.where(np.arange(recording.num_joints) == joint, scale, 1.0))


def commanded_arm() -> Takes:
    """The arm's log without its measured torque: the drives' lag is between the lines."""
    data = dataset("two_link_arm")
    bare = Takes(complete("two_link_arm").model, tuple(data.recordings), tuple(data.heldout))
    return bare.changed(lambda r: replace(r, torque_measured=None, torque_semantics=None))


def kinds_of(bench: str) -> dict[str, tuple[Recording, ...]]:
    """Takes by what moved the robot."""
    data = dataset(bench)
    out: dict[str, tuple[Recording, ...]] = {}
    for r in (*data.recordings, *data.heldout):
        kind = str(r.metadata["excitation"])
        out[kind] = (*out.get(kind, ()), r.driven_by_measured_torque() if bench == "two_link_arm" else r)
    return out


def without_kind(bench: str, kind: str) -> Takes:
    """The bench's start model, all takes of other kinds to fit, and this kind kept aside."""
    kinds = kinds_of(bench)
    others = tuple(r for k, takes in kinds.items() if k != kind for r in takes)
    return Takes(dataset(bench).model, others, kinds[kind])


# --- the list ---------------------------------------------------------------------------------------------------------

DEAREST = (
    "so101",
    "airbot",
    "ur10e",
    "double_pendulum",
    "two_link_arm",
    "xl330",
    "unbalanced_disk",
    "emps",
    "pendulum",
)
"""Benches, those that take longest first."""
KINDS = {  # of motion
    "two_link_arm": (
        "open-loop sines on both joints",
        "open-loop sines on both joints, the lower link goes over the top",
        "swing-up by a trajectory-tracking controller",
        "open-loop sines on the elbow",
    ),
    "pendulum": ("swing-up planned by DDP", "swing-up planned by direct collocation"),
    "emps": ("position profile, closed loop", "position profile with force pulses, closed loop"),
    "xl330": ("sin_sin", "lift_and_drop", "up_and_down", "sin_time_square", "free swing, motor off"),
}
ONE_OF_THREE = ("link_mass", "link_com", "torque_scale")
"""A hinge that moves one link shows ratios of these only."""
SLIDES_MASS = ("link_mass", "payload", "reflected_inertia", "torque_scale")
"""A level slide shows ratios of these only: a load, the carriage and the screw are one inertia."""


def cases() -> list[Case]:
    """All cases, in a fixed order; nothing is loaded before :attr:`Case.takes` is called."""
    return [*_controls(), *_removed(), *_injected(), *_added(), *_left_out()]


def _controls() -> list[Case]:
    return [Case(bench, "complete", "", "", partial(complete, bench)) for bench in DEAREST]


def _removed() -> list[Case]:
    def take_away(bench: str, what: str, size: str, edit: Callable[[mujoco.MjSpec], None], *truths: Name) -> Case:
        return Case(bench, "removed", what, size, partial(edited, bench, edit), truths)

    def friction(bench: str, joint: str, size: str) -> Case:
        return take_away(bench, f"coulomb_friction {joint}", size, partial(without_friction, joint=joint),
                         ("coulomb_friction", joint))  # fmt: skip

    def damping(bench: str, joint: str, size: str) -> Case:
        return take_away(bench, f"viscous_friction {joint}", size, partial(without_damping, joint=joint),
                         ("viscous_friction", joint))  # fmt: skip

    def rotor(bench: str, joint: str, size: str, *others: Name) -> Case:
        return take_away(bench, f"reflected_inertia {joint}", size, partial(without_rotor, joint=joint),
                         ("reflected_inertia", joint), *others)  # fmt: skip

    def mass(bench: str, joint: str, *names: str) -> Case:
        return take_away(bench, f"link_mass {joint}", "70 % of it given", partial(with_mass, joint=joint, share=0.7),
                         *((name, joint) for name in names))  # fmt: skip

    disk = "unbalanced_disk"
    return [
        friction("emps", "carriage", "20.4 N"),
        damping("emps", "carriage", "204 N·s/m"),
        take_away("emps", "torque_offset carriage", "3.16 N", level,
                  ("torque_offset", "carriage"), ("gravity_tilt", None)),
        mass("emps", "carriage", *SLIDES_MASS),
        friction("two_link_arm", "shoulder", "0.093 N·m"),
        friction("two_link_arm", "elbow", "0.078 N·m"),
        rotor("two_link_arm", "elbow", "0.00276 kg·m²"),
        mass("two_link_arm", "shoulder", *ONE_OF_THREE),
        mass("two_link_arm", "elbow", "link_mass"),
        Case("two_link_arm", "removed", "drive lag elbow", "", commanded_arm,
             (("actuation_lag", "elbow"), ("actuation_delay", "elbow"))),
        friction("pendulum", "pendulum", "0.184 N·m"),
        rotor("pendulum", "pendulum", "0.0022 kg·m²"),
        mass("pendulum", "pendulum", *ONE_OF_THREE),
        friction(disk, "disk", "0.00148 N·m"),
        damping(disk, "disk", "0.000325 N·m·s/rad"),
        take_away(disk, "reflected_inertia disk", "0.3 of J",
                  partial(with_inertia, joint="disk", missing=0.3 * benches.DISK_INERTIA),
                  ("reflected_inertia", "disk")),
        Case(disk, "removed", "actuation_delay disk", "25 ms",
             partial(recorded, disk, partial(late, seconds=-0.025)), (("actuation_delay", "disk"),)),
        Case(disk, "removed", "encoder_offset disk", "33.3 mrad",
             partial(recorded, disk, partial(misread, joint=0, offset=0.0333)),
             (("encoder_offset", "disk"), ("gravity_tilt", None))),
        friction("xl330", "pendulum", "0.0128 N·m"),
        damping("xl330", "pendulum", "0.00366 N·m·s/rad"),
        rotor("xl330", "pendulum", "0.00181 kg·m²"),
        mass("xl330", "pendulum", *ONE_OF_THREE),
        take_away("xl330", "encoder_offset pendulum", "31 mrad", partial(upright, body="pendulum"),
                  ("encoder_offset", "pendulum"), ("gravity_tilt", None)),
        friction("double_pendulum", "shoulder", "0.235 N·m"),
        friction("double_pendulum", "elbow", "0.182 N·m"),
        rotor("double_pendulum", "elbow", "0.00477 kg·m²"),
        mass("double_pendulum", "shoulder", *ONE_OF_THREE),
        mass("double_pendulum", "elbow", "link_mass"),
        damping("airbot", "joint2", "0.69 N·m·s/rad"),
        damping("airbot", "joint3", "0.322 N·m·s/rad"),
        friction("airbot", "joint5", "0.0649 N·m"),
        friction("airbot", "joint6", "0.0618 N·m"),
        rotor("airbot", "joint4", "0.243 kg·m²"),
        rotor("airbot", "joint5", "0.0202 kg·m²"),
        mass("airbot", "joint3", "link_mass"),
        friction("so101", "elbow_flex", "2.74 N·m"),
        friction("so101", "wrist_roll", "1.49 N·m"),
        damping("so101", "wrist_roll", "1.81 N·m·s/rad"),
        rotor("so101", "shoulder_pan", "0.0656 kg·m²"),
        mass("so101", "elbow_flex", "link_mass"),
        friction("ur10e", "elbow_joint", "7.17 N·m"),
        friction("ur10e", "wrist_2_joint", "2.92 N·m"),
        damping("ur10e", "shoulder_lift_joint", "18.4 N·m·s/rad"),
        rotor("ur10e", "shoulder_pan_joint", "5.24 kg·m²"),
        rotor("ur10e", "wrist_1_joint", "0.426 kg·m²"),
        mass("ur10e", "elbow_joint", "link_mass"),
    ]  # fmt: skip


def _injected() -> list[Case]:
    def put(bench: str, what: str, size: str, change: Callable[[Recording], Recording], *truths: Name) -> Case:
        return Case(bench, "injected", what, size, partial(recorded, bench, change), truths)

    out = []
    for bench, joint, index, times in (
        ("emps", "carriage", 0, (2, 6, 20)),
        ("two_link_arm", "elbow", 1, (2, 6, 20)),
        ("pendulum", "pendulum", 0, (2, 6, 20)),
        ("unbalanced_disk", "disk", 0, (50, 75, 100)),
        ("xl330", "pendulum", 0, (5, 10, 20)),
        ("double_pendulum", "elbow", 1, (6, 20)),
        ("airbot", "joint2", 1, (10, 30)),
        ("airbot", "joint5", 4, (10, 30)),
        ("so101", "elbow_flex", 2, (20, 40)),
        ("ur10e", "elbow_joint", 2, (10, 30)),
    ):
        out += [
            put(
                bench,
                f"actuation_delay {joint}",
                f"{ms} ms",
                partial(late, seconds=-ms / 1000, joint=index),
                ("actuation_delay", joint),
            )
            for ms in times
        ]
    for bench, sign in (("emps", 1), ("two_link_arm", -1), ("pendulum", 1)):  # one joint's late clock is a delay
        out += [
            put(
                bench,
                "clock_offset",
                f"{-sign * ms} ms",
                partial(late, seconds=sign * ms / 1000),
                ("clock_offset", None),
            )
            for ms in (2, 6, 20)
        ]
    for bench, joint, index in (
        ("two_link_arm", "elbow", 1), ("pendulum", "pendulum", 0), ("xl330", "pendulum", 0),
        ("double_pendulum", "elbow", 1), ("airbot", "joint2", 1), ("ur10e", "shoulder_lift_joint", 1),
    ):  # fmt: skip
        out += [
            put(
                bench,
                f"encoder_offset {joint}",
                f"{mrad} mrad",
                partial(misread, joint=index, offset=mrad / 1000),
                ("encoder_offset", joint),
                *([("gravity_tilt", None)] if bench in ("pendulum", "xl330") else []),
            )
            for mrad in (20, 60, 150)
        ]
    for bench, joint, index, names in (
        ("emps", "carriage", 0, SLIDES_MASS),
        ("two_link_arm", "elbow", 1, ("torque_scale",)),
        ("unbalanced_disk", "disk", 0, ONE_OF_THREE),
        ("double_pendulum", "elbow", 1, ("torque_scale",)),
        ("airbot", "joint3", 2, ("torque_scale",)),
        ("airbot", "joint5", 4, ("torque_scale",)),
        ("ur10e", "elbow_joint", 2, ("torque_scale",)),
        ("ur10e", "wrist_1_joint", 3, ("torque_scale",)),
    ):
        out += [
            put(
                bench,
                f"torque_scale {joint}",
                f"{scale:g}",
                partial(weak, joint=index, scale=scale),
                *((name, joint) for name in names),
            )
            for scale in (0.95, 0.85, 0.6)
        ]
    for joint, index in (("shoulder_lift", 1), ("wrist_flex", 3)):
        out += [
            put("so101", f"gain_mismatch {joint}", f"{scale:g}", partial(stiff, joint=index, scale=scale),
                ("gain_mismatch", joint))
            for scale in (0.8, 0.5)
        ]  # fmt: skip
    for bench, unit, steps in (
        ("emps", "m", (1e-5, 1e-4, 1e-3)),
        ("two_link_arm", "rad", (2 * np.pi / 2**n for n in (12, 10, 8))),
        ("pendulum", "rad", (2 * np.pi / 2**n for n in (12, 10, 8))),
    ):
        out += [put(bench, "quantisation", f"{1000 * s:.3g} m{unit}", partial(coarse, step=s)) for s in steps]
    return out


def _added() -> list[Case]:
    flange = "wrist_3_joint"
    truths = tuple((name, flange) for name in ("offset_payload", "payload", "link_mass"))
    return [
        Case(
            "ur10e",
            "added",
            f"payload {flange}",
            f"2.805 kg, {harmonics} harmonics",
            partial(carrying, harmonics),
            truths,
        )
        for harmonics in (14, 15)
    ]


def _left_out() -> list[Case]:
    return [
        Case(bench, "left_out", kind, "", partial(without_kind, bench, kind))
        for bench, kinds in KINDS.items()
        for kind in kinds
    ]


# --- scores -----------------------------------------------------------------------------------------------------------


def load(folder: Path) -> list[dict[str, Any]]:
    """Every case that was answered, with its grade, in the order of :func:`cases`."""
    answers = {c.name: _read(folder / f"{c.name}.json") for c in cases()}
    controls = {c.bench: answers[c.name] for c in cases() if c.kind == "complete"}
    return [graded(c, a, controls[c.bench]) for c in cases() if (a := answers[c.name]) is not None]


def _read(path: Path) -> dict[str, Any] | None:
    return json.loads(path.read_text(encoding="utf-8")) if path.exists() else None


def graded(case: Case, answered: Mapping[str, Any], control: Mapping[str, Any] | None) -> dict[str, Any]:
    """What a table says of a case.

    ``grade`` is ``named``, ``contained`` (a law that holds the truth as a special case), ``rival`` (in the answer set
    only), ``control`` (any of these, but the complete model's diagnosis says the same), ``joint`` (another name, which
    the control does not state, on the right one of several joints), ``missed`` or ``failed``; where nothing may be
    named ``quiet`` or ``false``; of a kind left out ``closed`` or ``open``. What is less probable than ``LEAST`` is not
    stated, and of a finding and its rivals the most probable one is the name. ``over_noise`` and ``over_misfit``
    compare what concealing changes, at the joint where it shows most, with the noise floor and with the error that the
    complete model leaves.
    """
    answer, before = answered.get("answer"), (control or {}).get("answer")
    row: dict[str, Any] = {
        "bench": case.bench, "kind": case.kind, "what": case.what, "size": case.size, "truths": case.truths,
        "commit": answered["commit"], "seconds": answered.get("seconds"),
    }  # fmt: skip
    if before is not None and "moved" in answered and before["fit"]:
        own = before["fit"]["train"]["per_joint"]
        row["over_noise"] = max(m / own[joint]["floor"] for joint, m in answered["moved"].items())
        row["over_misfit"] = max(m / own[joint]["before"] for joint, m in answered["moved"].items())
    if answer is None:
        return row | {"grade": "failed", "error": answered.get("error", "not finished")}
    if not answer["fit"]:
        return row | {"grade": "failed", "error": "nothing simulated within its time budget"}
    row |= {
        "verdict": answer["verdict"],
        "findings": [
            {"effect": f["effect"], "joint": f["joint"], "probability": f["probability"],
             "grounds": f["grounds"],
             "parameters": {p: [e["value"], e["unit"]] for p, e in f["parameters"].items()},
             "rivals": [[r["effect"], r["joint"], r["probability"]] for r in f["rivals"]]}
            for f in answer["findings"]
        ],
        "heldout": {k: answer["fit"]["heldout"][k] for k in ("before", "after", "floor", "share_closed")},
        "quality": _quality(answer),
    }  # fmt: skip
    names, rivals = stated(answer)
    row["probability"] = max((p for name, p in names.items() if name in set(case.truths)), default=0.0)
    known = stated(before) if before is not None else ({}, set())
    joints = len(answer["fit"]["train"]["per_joint"])
    return row | {"grade": _grade(case, names, rivals, known, joints, row["heldout"]["share_closed"])}


def stated(answer: Mapping[str, Any]) -> tuple[dict[Name, float], set[Name]]:
    """Names with their probabilities, the likeliest of each finding and its rivals; and the others of these.

    Of equals it is the finding, which is what the page says first.
    """
    names: dict[Name, float] = {}
    rivals: set[Name] = set()
    for f in answer["findings"]:
        likely = {(a["effect"], a["joint"]): a["probability"] for a in (f, *f["rivals"]) if a["probability"] >= LEAST}
        if likely:
            first = max(likely, key=lambda name: likely[name])
            names[first] = max(names.get(first, 0.0), likely[first])
            rivals |= likely.keys() - {first}
    return names, rivals - names.keys()


def _grade(
    case: Case, names: Mapping[Name, float], rivals: set[Name], known: tuple[Mapping[Name, float], set[Name]],
    joints: int, closed: float,
) -> str:  # fmt: skip
    of_control, rivals_of_control = known
    if case.kind == "complete":
        return "complete"
    if case.kind == "left_out":
        return "closed" if closed >= CLOSED else "open"
    if not case.truths:
        return "false" if any(p > 0.5 for n, p in names.items() if n not in of_control) else "quiet"
    truths = set(case.truths)
    for grade, right, among, already in (
        ("named", truths, names.keys(), of_control.keys()),
        ("contained", _wider(case), names.keys(), of_control.keys()),
        ("rival", truths, rivals, rivals_of_control | of_control.keys()),
    ):
        if right & among:
            return "control" if right & among & already else grade
    elsewhere = {j for _, j in names.keys() - of_control.keys()} & {j for _, j in truths}
    return "joint" if elsewhere and joints > 1 else "missed"


def _wider(case: Case) -> set[Name]:
    return {(e, joint) for effect, joint in case.truths for e in CONTAINS.get(effect, ())}


def _quality(answer: Mapping[str, Any]) -> dict[str, float]:
    """The largest noise of a reading that quality control sees [rad, m], and the number of its warnings."""
    reports = answer["quality"]["recordings"]
    noise = max((n for r in reports for n in r["position_noise"].values()), default=0.0)
    return {"position_noise": noise, "warnings": sum(len(r["warnings"]) for r in reports)}


def figures(rows: Sequence[Mapping[str, Any]]) -> dict[str, Any]:
    """Counts of grades: of all cases, of those that the noise allows, and of those that other misfit does not hide."""
    out: dict[str, Any] = {}
    out["added"] = {"all": _counts([r for r in rows if r["kind"] == "added"])}
    for kind in ("removed", "injected"):
        of = [r for r in rows if r["kind"] == kind and r["truths"]]
        seen = [r for r in of if r.get("over_noise", 0.0) >= VISIBLE]
        clear = [r for r in seen if r["over_misfit"] >= 1.0]
        out[kind] = {"all": _counts(of), "noise_allows": _counts(seen), "larger_than_other_misfit": _counts(clear)}
    coarse_logs = [r for r in rows if r["kind"] == "injected" and not r["truths"]]
    out["quantisation"] = {"cases": len(coarse_logs), "quiet": sum(r["grade"] == "quiet" for r in coarse_logs)}
    closed = [r["heldout"]["share_closed"] for r in rows if r["kind"] == "left_out" and "heldout" in r]
    out["left_out"] = {
        "cases": len(closed), "closed": sum(c >= CLOSED for c in closed), "better": sum(c > 0 for c in closed),
        "median_share_closed": float(np.median(closed)) if closed else None,
    }  # fmt: skip
    return out


def _counts(rows: Sequence[Mapping[str, Any]]) -> dict[str, int]:
    graded = {grade: sum(r["grade"] == grade for r in rows) for grade in GRADES}
    over = sum(r["grade"] == "named" and r["probability"] > 0.5 for r in rows)
    return {"cases": len(rows), **graded, "named_over_half": over}


def summary(rows: Sequence[Mapping[str, Any]]) -> list[str]:
    """The counts as a table."""
    f = figures(rows)
    head = ("concealed", "cases", "named", "with over one half", "a law that holds it", "among rivals",
            "named, but the control says so too", "joint only, of several", "missed", "failed")  # fmt: skip
    lines = _head(head)
    for kind, words in (("removed", "taken from the model"), ("injected", "put into the recordings")):
        for of, which in (
            ("all", ""), ("noise_allows", "; noise allows it"), ("larger_than_other_misfit", "; and other misfit"),
        ):  # fmt: skip
            n = f[kind][of]
            cells = [n["cases"], n["named"], n["named_over_half"], *(n[grade] for grade in GRADES[1:])]
            lines.append(f"| {words}{which} | {' | '.join(map(str, cells))} |")
    n = f["added"]["all"]
    cells = [n["cases"], n["named"], n["named_over_half"], *(n[grade] for grade in GRADES[1:])]
    lines.append(f"| really added to the robot | {' | '.join(map(str, cells))} |")
    left, quiet = f["left_out"], f["quantisation"]
    median = left["median_share_closed"]
    return [
        *lines, "",
        f"Coarser encoders: nothing new stated over one half in {quiet['quiet']} of {quiet['cases']}. "
        f"Kinds of motion left out: better than the given model in {left['better']} of {left['cases']}, half of the "
        f"gap or more closed in {left['closed']}, median {'-' if median is None else f'{100 * median:.0f} %'}.",
    ]  # fmt: skip


def report(rows: Sequence[Mapping[str, Any]]) -> str:
    """All tables as Markdown."""
    commits = ", ".join(f"`{c}`" for c in sorted({r["commit"] for r in rows}))
    out = [
        "# Physics concealed on real benches", "",
        f"Made by `python benchmarks/concealed_real.py` at commit {commits}. Errors are RMSE of 0.5 s windows on "
        "recordings kept aside [mrad; mm on emps]: of the model that was given, and corrected. *Over noise* and *over "
        "misfit* compare what concealing moves the simulated fitted takes by with their noise floor and with the error "
        f"that the complete model leaves. Noise allows a name from {VISIBLE:g} on; other misfit from 1 on. A name "
        f"counts from a probability of {LEAST:.0%} on.",
        "",
        *summary(rows), "",
    ]  # fmt: skip
    for kind, title in (
        ("complete", "Nothing concealed: what the published models leave"),
        ("removed", "Taken from the model"),
        ("injected", "Put into the recordings"),
        ("added", "Really added to the robot"),
        ("left_out", "One kind of motion kept aside"),
    ):
        of = [r for r in rows if r["kind"] == kind]
        if of:
            out += [f"## {title}", "", *_table(of), ""]
    return "\n".join(out).rstrip() + "\n"


def _table(rows: Sequence[Mapping[str, Any]]) -> list[str]:
    lines = _head(("data set", "concealed", "size", "named (probability)", "verdict", "before", "after", "over noise",
                   "over misfit", "reached", "commit"))  # fmt: skip
    for r in rows:
        seen = " | ".join(f"{r[k]:.2g}" if k in r else "" for k in ("over_noise", "over_misfit"))
        lead, end = f"| {r['bench']} | {r['what'] or '-'} | {r['size']} |", f"{_reached(r)} | `{r['commit']}` |"
        if "heldout" not in r:
            lines.append(f"{lead} {r['error'][-80:].replace('|', '/')} | - | - | - | {seen} | {end}")
            continue
        before, after = (f"{1000 * r['heldout'][k]:.3g}" for k in ("before", "after"))
        said = "<br>".join(_said(f) for f in r["findings"]) or "nothing"
        lines.append(f"{lead} {said} | {r['verdict']} | {before} | {after} | {seen} | {end}")
    return lines


def _head(names: Sequence[str]) -> list[str]:
    return [f"| {' | '.join(names)} |", "|" + "---|" * len(names)]


def _reached(row: Mapping[str, Any]) -> str:
    if row["grade"] in ("closed", "open"):
        return f"{100 * row['heldout']['share_closed']:.0f} % closed"
    return {
        "complete": "", "named": "named", "contained": "as a law that holds it", "rival": "among the rivals",
        "control": "named, but the control says so too", "joint": "joint only", "missed": "missed",
        "failed": "failed", "quiet": "nothing named", "false": "false name",
    }[row["grade"]]  # fmt: skip


def _said(finding: Mapping[str, Any]) -> str:
    numbers = []
    for name, given in finding["parameters"].items():
        value, unit = given if isinstance(given, list) else (given["value"], given["unit"])
        numbers.append(f"{name} {value:.3g} {'' if unit == '1' else unit}".rstrip())
    rivals = ""
    if finding["rivals"] and isinstance(finding["rivals"][0], list):
        rivals = "".join(f"; or `{e}` {j or 'robot'} ({p:.0%})" for e, j, p in finding["rivals"])
    where = finding["joint"] or "robot"
    return f"`{finding['effect']}` {where} ({finding['probability']:.0%}): {', '.join(numbers)}{rivals}"


def _commit() -> str:
    done = subprocess.run(["git", "rev-parse", "--short", "HEAD"], capture_output=True, text=True, check=False)
    return done.stdout.strip() or os.environ.get("COMMIT", "unknown")


if __name__ == "__main__":
    main(tyro.cli(Config))
