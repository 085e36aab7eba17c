"""The simulator that a diagnosis corrects, with physics that has a name."""

from __future__ import annotations

import time
from collections.abc import Sequence
from dataclasses import asdict
from pathlib import Path

from torchrl_athletic.diagnosis import Diagnosis, diagnose
from torchrl_athletic.effects import CATALOGUE, Effect
from torchrl_athletic.identification.simulator import Simulator
from torchrl_athletic.recordings import Recording
from torchrl_athletic.robots import Robot
from torchrl_athletic.transforms.corrected_actuation import NOT_ACTED_OUT, OF_THE_RECORDING

NOT_IN_A_ROBOT = frozenset({"payload", "gravity_tilt", "joint_spring"})
"""Effects that change the model in a way that :func:`~torchrl_athletic.robots.with_correction` does not carry over."""


def actable_effects() -> tuple[Effect, ...]:
    """Those of the catalogue with which policies can be trained, on any robot that has the diagnosed joints."""
    left_out = NOT_ACTED_OUT.keys() | NOT_IN_A_ROBOT | OF_THE_RECORDING
    return tuple(effect for effect in CATALOGUE if effect.name not in left_out)


def identify_diagnosed(
    robot: Robot,
    recordings: Sequence[Recording],
    *,
    heldout: Sequence[Recording] = (),
    seed: int = 0,
    time_budget: float | None = None,
    output: str | Path | None = None,
) -> Simulator:
    """Diagnose what the robot's model leaves out, among the effects that a policy's simulation can act out.

    What has no place there (a gear's flexibility and play, friction by load, slow drift) is left to a net on the
    remainder: train a UAN on this simulator.

    Args:
        robot: Its model is diagnosed.
        recordings: Takes to fit.
        heldout: Takes of another kind, that the diagnosis checks its findings on; none of those that score.
        seed: Of the diagnosis.
        time_budget: After which no further combination is fitted [s].
        output: Folder for the diagnosis' own report.
    """
    started = time.perf_counter()
    spec = robot.spec()
    diagnosis = diagnose(
        spec, recordings, heldout, catalogue=actable_effects(), seed=seed, time_budget=time_budget, output=output
    )
    return simulator_of(diagnosis, robot, recordings, time.perf_counter() - started, seed)


def simulator_of(
    diagnosis: Diagnosis, robot: Robot, recordings: Sequence[Recording], seconds: float, seed: int = 0
) -> Simulator:
    """What a diagnosis found, as a simulator.

    Raises:
        ValueError: If it found an effect that a simulator cannot act out.
    """
    findings = [
        {"effect": f.effect, "joint": f.joint, "probability": f.probability, "sentence": f.sentence}
        for f in diagnosis.answer.findings
    ]
    notes = {
        "seed": seed,
        "training_seconds": seconds,
        "data_seconds": float(sum(r.duration for r in recordings)),
        "verdict": diagnosis.answer.verdict,
        "findings": findings,
        "fit": {split: asdict(score) for split, score in diagnosis.answer.fit.items()},
    }
    simulator = Simulator("diagnosed", robot, diagnosis.corrected.to_json(), notes=notes)
    simulator.chain(decimation=1)  # refuses here what it would refuse later
    return simulator
