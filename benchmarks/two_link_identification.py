"""Methods of identification on a real arm: fitted on some files, scored on others, with 5 to 60 s of data.

python benchmarks/two_link_identification.py --jobs 8

The two-link arm of DFKI's lab follows torque commands late, through friction; measured torques come from the motor
current. Every method starts from the published links without rotors and friction. Six takes with sines on both motors
are for fitting, in their order: 5 s are the first half of the first take. Kept aside are the swing-up and the two takes
where the elbow alone is driven. Each case leaves a simulator, so that the same command goes on after a kill.
Results: docs/identification.md.
"""

from __future__ import annotations

import json
from collections.abc import Iterator, Sequence
from concurrent.futures import ProcessPoolExecutor, as_completed
from dataclasses import dataclass, replace
from itertools import product
from pathlib import Path
from typing import Literal, get_args

import numpy as np
import torch
import tyro
from tqdm import tqdm

from torchrl_athletic import training
from torchrl_athletic.envs import replay_env
from torchrl_athletic.identification import (
    CEM,
    ActuatorNetTraining,
    Replay,
    Result,
    Simulator,
    compare,
    every_seed,
    figure,
    identify_actuator_net,
    identify_cem,
    identify_diagnosed,
    inertia_of,
    open_loop,
    table,
)
from torchrl_athletic.identification.comparison import COLOURS, NAMES, deviation
from torchrl_athletic.networks import uan
from torchrl_athletic.recordings import Recording, resample
from torchrl_athletic.recordings.datasets.two_link_arm import load
from torchrl_athletic.robots import Robot, from_mjcf
from torchrl_athletic.robots.benches import two_link_arm

Method = Literal[
    "default",
    "cem",
    "actuator_net",
    "uan",
    "uan_joint",
    "uan_arm",
    "uan_arm_memory",
    "inertia_uan",
    "inertia_uan_joint",
    "inertia_uan_joint_memory",
    "diagnosed",
    "diagnosed_uan",
    "diagnosed_uan_joint",
    "diagnosed_uan_arm_memory",
]
STEP = 0.005
MEMORY = (0.003, 0.03)
"""Ways over which a net remembers, as in recipes/train_uan.py's example [rad]."""
TORQUE = 0.5
"""Unit of a net's torque, about that of the commands [N·m]."""
OUTLIER = 0.3
"""Errors far beyond it count by their logarithm [rad]."""
GROUPS = {"swing-up": "swing-up", "open-loop sines on the elbow": "elbow alone"}


@dataclass(frozen=True)
class Config:
    output: Path = Path("outputs/two_link")
    """Folder of simulators, numbers and pictures."""
    seconds: tuple[float, ...] = (5.0, 10.0, 20.0, 40.0, 60.0)
    """Seconds of data to fit."""
    seeds: tuple[int, ...] = (0, 1, 2)
    """Seeds of methods that draw random numbers, with all the data; the first ``seeds_with_less`` of them with less."""
    seeds_with_less: int = 3
    methods: tuple[Method, ...] = get_args(Method)
    """Which to run."""
    iterations: int = 200
    """Iterations of training each net, by gradient descent: a minute of a core, however busy it is."""
    jobs: int = 1
    """Cases at a time."""
    score_only: bool = False
    """Whether to score what is there and identify nothing."""


@dataclass(frozen=True)
class Case:
    method: Method
    seconds: float
    seed: int

    @property
    def name(self) -> str:
        return f"{self.method}_{self.seconds:g}s_seed{self.seed}"

    @property
    def given(self) -> Case | None:
        """What its net is trained on top of, if that is fitted itself."""
        if self.method.startswith("inertia_uan"):
            return Case("cem", self.seconds, self.seed)
        return Case("diagnosed", self.seconds, self.seed) if self.method.startswith("diagnosed_uan") else None


def main(cfg: Config) -> None:
    cases = list(cases_of(cfg))
    for last in (False, True):
        todo = [c for c in cases if (c.given is not None) == last and not is_there(c, cfg) and not cfg.score_only]
        with ProcessPoolExecutor(cfg.jobs) as pool:
            running = [pool.submit(identify, case, cfg) for case in todo]
            for done in tqdm(as_completed(running), total=len(todo), desc="nets on a fit" if last else "alone"):
                done.result()
    robot, (_, heldout) = arm(), takes()
    groups = {name: [t for t in heldout if kind in t.metadata["excitation"]] for kind, name in GROUPS.items()}
    found = {c: Simulator.load(cfg.output / c.name, robot) for c in cases if is_there(c, cfg)}
    results = {c: compare(s, groups, (None, 2.0, 0.5)) for c, s in tqdm(found.items(), desc="scores")}
    most = max(cfg.seconds)
    whole = [r for c, of in results.items() if c.seconds == most or c.method == "default" for r in of]
    everything = [{"seconds": c.seconds, **r.to_json()} for c, of in results.items() for r in of]
    (cfg.output / "two_link.json").write_text(json.dumps(everything, indent=1))
    text = table(whole) + "\n" + every_seed(whole, "0.5 s") + "\n" + efficiency_table(results, cfg.seconds)
    (cfg.output / "two_link.md").write_text(text)
    first = {c.method: s for c, s in reversed(found.items()) if c.seconds in (most, 0.0)}
    figure(whole, overlays(first, groups), cfg.output / "two_link.svg", window="0.5 s", seconds=4.0)
    draw_efficiency(results, cfg.output / "two_link_efficiency.svg")
    print(text)


def is_there(case: Case, cfg: Config) -> bool:
    return (cfg.output / case.name / "simulator.json").exists()


def cases_of(cfg: Config) -> Iterator[Case]:
    for method, seconds, seed in product(cfg.methods, cfg.seconds, cfg.seeds):
        if method == "default":
            continue
        counted = cfg.seeds if seconds == max(cfg.seconds) else cfg.seeds[: cfg.seeds_with_less]
        if seed in counted:
            yield Case(method, seconds, seed)
    if "default" in cfg.methods:
        yield Case("default", 0.0, 0)


def arm() -> Robot:
    """The gains belong to the drive that nets imagine behind a torque command; the arm has none.

    With little damping the position errors that nets see tell of the torque as much as of the velocity, which nets see
    besides; with 0.5 N·m·s/rad they told of little else.
    """
    return from_mjcf(two_link_arm(timestep=STEP), kp=20.0, kd=0.1)


def takes() -> tuple[list[Recording], list[Recording]]:
    """To fit and kept aside, on the grid of the simulation."""
    data = load()
    return tuple([resample(take, STEP) for take in group] for group in (data.recordings, data.heldout))  # type: ignore[return-value]


def first_seconds(recordings: Sequence[Recording], seconds: float) -> list[Recording]:
    """As many takes as it takes, the last one cut."""
    out: list[Recording] = []
    left = round(seconds / STEP)
    for take in recordings:
        if left > 1:
            out.append(take.slice(0, min(left, take.num_samples)))
            left -= out[-1].num_samples
    return out


def identify(case: Case, cfg: Config) -> None:
    torch.set_num_threads(1)
    robot, fit = arm(), first_seconds(takes()[0], case.seconds)
    simulator = Simulator("default", robot)
    if case.method == "cem":
        simulator = identify_cem(robot, fit, search(case), seed=case.seed)
    elif case.method == "actuator_net":
        simulator = identify_actuator_net(robot, fit, ActuatorNetTraining(batch=1024, epochs=100), seed=case.seed)
    elif case.method == "diagnosed":
        report = cfg.output / case.name / "diagnosis"
        simulator = identify_diagnosed(robot, fit, refine=search(case), seed=case.seed, output=report)
    elif "uan" in case.method:
        if case.given is not None:
            simulator = Simulator.load(cfg.output / case.given.name, robot)
        if case.method.startswith("inertia"):
            simulator = replace(simulator, correction=inertia_of(simulator.correction or {}))
        simulator = with_uan(replace(simulator, name=case.method), fit, case.seed, cfg.iterations)
    simulator.save(cfg.output / case.name)


def search(case: Case) -> CEM:
    return CEM(generations=60, population=12, windows=max(4, min(48, round(case.seconds))), window=0.5)


def with_uan(given: Simulator, recordings: Sequence[Recording], seed: int, iterations: int) -> Simulator:
    """An Unsupervised Actuator Net on what a simulator leaves, down the gradient of the position's error.

    The simulator's name says what the net is told.
    """
    torch.manual_seed(seed)
    knows: training.Knows = "arm" if "_arm" in given.name else "joint" if "_joint" in given.name else "errors"
    memory = MEMORY if given.name.endswith("memory") else ()
    takes = training.takes_of(recordings, given.robot)
    units = training.units_of(takes, given.robot, knows, memory) | {"torque_unit": TORQUE}
    net = uan(**units, odd=knows == "joint")
    base = training.DifferentiableTorqueEnv(given.robot, num_envs=128)
    unit, chain = training.torque_unit(net), training.chain_with(given, net, takes)
    env = replay_env(given.robot, takes, chain=chain, unit=unit, base=base, max_steps=100, seed=seed)
    learner = training.GradientLearner(env, net, minutes=1.0, iterations=iterations, outlier=OUTLIER)
    training.train(learner, iterations=iterations, step=training.descend, progress=False)
    seconds = float(sum(r.duration for r in recordings))
    notes = {"seed": seed, "training_seconds": learner.seconds, "data_seconds": seconds}
    return replace(given, net=net, kind="correction", notes=notes)


def overlays(simulators: dict[Method, Simulator], groups: dict[str, list[Recording]]) -> dict[str, dict[str, Replay]]:
    """Each group's first take, in windows of 2 s."""
    return {
        f"kept aside: {name}": {method: open_loop(s, kept[:1], 2.0)[0] for method, s in simulators.items()}
        for name, kept in groups.items()
    }


def efficiency(results: dict[Case, list[Result]], method: str, seconds: float) -> list[float]:
    """Mean squared error over 0.5 s windows of all takes kept aside, for each seed [rad²]."""
    return [
        float(np.mean([r.mse for r in of if r.window == "0.5 s"]))
        for c, of in results.items()
        if c.method == method and c.seconds == seconds
    ]


def efficiency_table(results: dict[Case, list[Result]], seconds: Sequence[float]) -> str:
    methods = list(dict.fromkeys(c.method for c in results if c.method != "default"))
    lines = ["| data | " + " | ".join(NAMES[m] for m in methods) + " |", "|" + " --- |" * (1 + len(methods))]
    for s in seconds:
        cells = [efficiency(results, m, s) for m in methods]
        text = [
            f"{np.mean(v):.2e} ± {deviation(v):.0e}" if len(v) > 1 else f"{np.mean(v):.2e}" if v else "" for v in cells
        ]
        lines.append(f"| {s:g} s | " + " | ".join(text) + " |")
    return "\n".join(lines) + "\n"


def draw_efficiency(results: dict[Case, list[Result]], path: Path) -> None:
    from matplotlib.figure import Figure

    picture = Figure(figsize=(8.5, 3.4), layout="constrained")
    axes = picture.add_subplot()
    for method in dict.fromkeys(c.method for c in results):
        if method == "default":
            axes.axhline(float(np.mean(efficiency(results, method, 0.0))), color=COLOURS[method], label=NAMES[method])
            continue
        seconds = sorted({c.seconds for c in results if c.method == method})
        values = [efficiency(results, method, s) for s in seconds]
        spread = [deviation(v) for v in values]
        means = [float(np.mean(v)) for v in values]
        axes.errorbar(seconds, means, spread, color=COLOURS[method], marker="o", capsize=3, label=NAMES[method])
    ticks = sorted({c.seconds for c in results if c.seconds})
    axes.set(xscale="log", yscale="log", xlabel="data to fit [s]", ylabel="error over 0.5 s [rad²]")
    axes.set_xticks(ticks, [f"{tick:g}" for tick in ticks])
    axes.set_xticks([], minor=True)
    picture.legend(loc="outside right upper", fontsize=8, frameon=False)
    picture.savefig(path)


if __name__ == "__main__":
    main(tyro.cli(Config, description=__doc__))
