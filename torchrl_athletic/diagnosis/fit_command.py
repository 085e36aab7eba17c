"""The command line of a fit: ``torchrl-athletic fit``."""

from __future__ import annotations

import sys
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

from torchrl_athletic.diagnosis.draws import best_of_draws
from torchrl_athletic.diagnosis.extension import GEARS, LAWS
from torchrl_athletic.diagnosis.fitting import STAGES, Fit, JointParameter, fit
from torchrl_athletic.diagnosis.folder import locked
from torchrl_athletic.diagnosis.inputs import checked, inputs, refuse_wrong_flags
from torchrl_athletic.diagnosis.model import ModelError, position_unit
from torchrl_athletic.diagnosis.progress import Progress
from torchrl_athletic.recordings import FetchError, RecordingError

BEYOND = frozenset(law.name for law in (*LAWS, *GEARS))
"""Laws that may have several numbers, so that each is said by its name."""


@dataclass(frozen=True)
class FitConfig:
    """Fit friction, rotor, torque scale and limit, delay, offsets and gains of every joint to recordings."""

    model: Path | None = None
    """MJCF of the robot."""
    recordings: tuple[Path, ...] = ()
    """Files or folders to fit."""
    heldout: tuple[Path, ...] = ()
    """Files or folders kept aside: they are scored, and take back what makes a joint worse."""
    output: Path = Path("out/fit")
    """Folder for fit.json, fit.png, corrected.xml and corrected.json."""
    columns: Path | None = None
    """JSON column map for foreign names and units."""
    lock: tuple[str, ...] = ()
    """Joints that stood still, as NAME or NAME=POSITION: they become part of their links in the model."""
    check: bool = False
    """Say all that is wrong with the inputs, and do nothing else."""
    drive: Literal["command", "measured"] = "command"
    """Torque that drives the simulation: what was commanded, or what was measured."""
    dataset: Literal["emps", "two_link_arm", "pendulum", "xl330", "unbalanced_disk"] | None = None
    """Fit a public recording of a real robot instead."""
    time_budget: float | None = None
    """Time after which the best that was found by then is handed back [s]."""
    memory: float | None = None
    """Memory that it may take [GB]; half of what is free unless said. Of longer logs, stretches are fitted."""
    seed: int = 0
    """Seed of the starts and of the choice of windows."""
    draws: int = 1
    """Fits by so many seeds, from ``seed`` on, of which the one stays that follows best what was fitted."""


def main(config: FitConfig) -> Fit:
    """Run a fit, print its table, and leave the files in ``config.output``."""
    if config.check:
        text, usable = checked(config)
        print(text)
        sys.exit(0 if usable else 1)
    if config.draws < 1:
        sys.exit(f"error: --draws {config.draws}. Ask for one fit or more.")
    try:
        if config.output.is_file():  # said now, not after the fit
            raise NotADirectoryError(f"--output {config.output} is a file. Name a folder.")
        with locked(config.output, "diagnosis.json"):
            fitted = _fitted(config)
    except (RecordingError, FetchError, ModelError, OSError, ImportError) as error:
        sys.exit(f"error: {' '.join(str(error).split())}")
    except KeyboardInterrupt:
        sys.exit("Stopped before there was anything to report.")
    print(fit_table(fitted))
    print(f"\nFiles: {config.output}")
    return fitted


def _fitted(config: FitConfig) -> Fit:
    refuse_wrong_flags(config)
    given = inputs(config)
    print("\n".join(given.notes), end="\n" if given.notes else "")

    def once(seed: int, time_budget: float | None, output: Path | None = None) -> Fit:
        with Progress(STAGES) as progress:
            return fit(
                given.model,
                given.recordings,
                given.heldout,
                drive=config.drive,
                seed=seed,
                time_budget=time_budget,
                memory=config.memory,
                output=output,
                progress=progress,
            )

    if config.draws == 1:
        return once(config.seed, config.time_budget, config.output)
    fitted = best_of_draws(once, config.draws, config.seed, config.time_budget)
    fitted.save(config.output)
    return fitted


def fit_table(fitted: Fit) -> str:
    """All parameters, the errors and the remarks, in lines for a terminal."""
    return "\n".join(_lines(fitted))


def _lines(fitted: Fit) -> Iterator[str]:
    wide = max((len(p.joint) for p in fitted.parameters), default=5)
    long = max((len(_name(p)) for p in fitted.parameters), default=26) + 2
    yield f"{'joint':<{wide}}  {'parameter':<{long}}{'given':>12}{'fitted':>12}  95 %"
    for p in fitted.parameters:
        yield f"{p.joint:<{wide}}  {_name(p):<{long}}{p.given:>12.4g}{_value(p):>12}  {_interval(p)}"
    for split, words in (("heldout", "kept aside"), ("train", "fitted")):
        if split in fitted.scores:
            yield ""
            yield f"{f'error over 0.5 s, {words}':<{wide + long + 2}}{'given':>12}{'fitted':>12}{'floor':>12}"
            for joint, e in fitted.scores[split].per_joint.items():
                name = f"{joint} [{position_unit(fitted.nominal.model, joint)}]"
                yield f"  {name:<{wide + long}}{e['before']:>12.4g}{e['after']:>12.4g}{e['floor']:>12.4g}"
    if fitted.remarks:
        yield ""
        yield from fitted.remarks


def _name(p: JointParameter) -> str:
    words, unit = p.effect.replace("_", " "), "" if p.unit == "1" else f" [{p.unit}]"
    several = p.effect == "gain_mismatch" or p.effect in BEYOND
    return (f"{words}, {p.name.removesuffix('_scale').replace('_', ' ')}" if several else words) + unit


def _value(p: JointParameter) -> str:
    return "" if p.state in ("not needed", "not identified") and p.value == p.given else f"{p.value:.4g}"


def _interval(p: JointParameter) -> str:
    low, high = p.ci95
    said = f"{low:.3g} to {high:.3g}"
    if p.state == "not identified":
        return f"not identified: {p.remark}"
    return said if p.state == "identified" else f"{said}, {p.state}"
