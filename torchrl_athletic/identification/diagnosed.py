"""The simulator that a diagnosis corrects, with physics that has a name."""

from __future__ import annotations

import time
from collections.abc import Sequence
from dataclasses import asdict, replace
from pathlib import Path

import numpy as np

from torchrl_athletic.diagnosis import Diagnosis, diagnose
from torchrl_athletic.diagnosis.progress import Progress
from torchrl_athletic.effects import CATALOGUE, Effect
from torchrl_athletic.identification.cem import CEM, identify_cem
from torchrl_athletic.identification.simulator import Simulator
from torchrl_athletic.identification.takes import velocity_of
from torchrl_athletic.recordings import Recording
from torchrl_athletic.robots import Robot
from torchrl_athletic.transforms.corrected_actuation import NOT_ACTED_OUT, OF_THE_RECORDING

NOT_IN_A_ROBOT = frozenset({"payload", "offset_payload", "gravity_tilt", "joint_spring"})
"""Effects that change the model in a way that :func:`~torchrl_athletic.robots.with_correction` does not carry over."""
KNOWN = frozenset({"speed_torque_limit", "torque_saturation", "gain_mismatch"})
"""What the data sheet and the recording say of the drives."""


def actable_effects() -> tuple[Effect, ...]:
    """Effects of the catalogue with which policies can be trained, on any robot that has the diagnosed joints."""
    left_out = NOT_ACTED_OUT.keys() | NOT_IN_A_ROBOT | OF_THE_RECORDING | KNOWN
    return tuple(effect for effect in CATALOGUE if effect.name not in left_out)


def identify_diagnosed(
    robot: Robot,
    recordings: Sequence[Recording],
    *,
    heldout: Sequence[Recording] = (),
    seed: int = 0,
    seconds_per_take: float | None = None,
    refine: CEM | None = CEM(),  # noqa: B008  frozen
    time_budget: float | None = None,
    output: str | Path | None = None,
) -> Simulator:
    """Diagnose what the robot's model leaves out, among the effects that a policy's simulation can act out.

    The diagnosis says which physics there is. Then friction, damping and armature of all joints are adjusted once more
    by CMA-ES, in the very simulation that policies are trained in, while the rest of the findings stays.

    Measured torques are not shown to the diagnosis: a policy's simulation is driven by commands, and what a drive logs
    of its current may be late by a filter of the log that no joint feels. The drives' limits by speed are known, so
    that takes are diagnosed as driven :func:`within_limits`. What has no place in a policy's simulation (a gear's
    flexibility and play, friction by load, slow drift) is left to a net on the remainder: train a UAN on this one.

    Args:
        robot: Its model is diagnosed.
        recordings: Takes to fit.
        heldout: Takes of another kind, that the diagnosis checks its findings on; none of those that score.
        seed: Of the diagnosis.
        seconds_per_take: How much of each take the diagnosis looks at, from its start [s]; None takes all.
        refine: How the numbers are adjusted, on whole takes; None leaves them as diagnosed.
        time_budget: After which no further combination is fitted [s].
        output: Folder for the diagnosis' own report.
    """
    started = time.perf_counter()
    taken = [_first(recording, seconds_per_take) for recording in recordings]
    fit, aside = (
        [within_limits(robot, replace(r, torque_measured=None, torque_semantics=None)) for r in group]
        for group in (taken, heldout)
    )
    with Progress() as progress:
        diagnosis = diagnose(
            robot.spec(),
            fit,
            aside,
            catalogue=actable_effects(),
            seed=seed,
            time_budget=time_budget,
            output=output,
            progress=progress,
        )
    found = simulator_of(diagnosis, robot, taken, time.perf_counter() - started, seed)
    return found if refine is None else identify_cem(robot, recordings, refine, given=found, seed=seed)


def within_limits(robot: Robot, recording: Recording) -> Recording:
    """The take with targets and torques no further off than the drives could follow them, by their data sheet.

    Where :class:`~torchrl_athletic.transforms.TorqueSpeedClip` would have cut the torque at the measured state, the
    target becomes the one that commands what was left. A replay without that transform then gets the same torques.

    Args:
        robot: Whose limits they are.
        recording: Of its joints, in any order.

    Example:
        >>> import numpy as np
        >>> from torchrl_athletic.robots import z1
        >>> robot, rest = z1(), np.zeros((2, 1))
        >>> gains = {"kp": np.array([100.0]), "kd": np.array([1.0])}
        >>> far = Recording(np.array([0.0, 0.005]), ("joint1",), rest, position_target=rest + 1.0, **gains)
        >>> within_limits(robot, far).position_target[0]  # of 100 N·m the motor has 30
        array([0.3])
    """
    columns = [robot.joint_names.index(name) for name in recording.joint_names]
    limit, fastest = (np.asarray(v)[columns] for v in (robot.torque_limit, robot.velocity_limit))
    velocity, position = velocity_of(recording), recording.position
    used = velocity / fastest
    low, high = -limit * (1 + np.clip(used, -1, 0)), limit * (1 - np.clip(used, 0, 1))
    if recording.position_target is None:
        return replace(recording, torque_command=np.clip(recording.command, low, high))
    assert recording.kp is not None
    assert recording.kd is not None
    torque = recording.kp * (recording.position_target - position) - recording.kd * velocity
    target = position + (np.clip(torque, low, high) + recording.kd * velocity) / np.maximum(recording.kp, 1e-12)
    cut = (torque < low) | (torque > high)
    return replace(recording, position_target=np.where(cut, target, recording.position_target))


def _first(recording: Recording, seconds: float | None) -> Recording:
    samples = recording.num_samples if seconds is None else max(2, round(seconds * recording.rate))
    return recording if samples >= recording.num_samples else recording.slice(0, samples)


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
