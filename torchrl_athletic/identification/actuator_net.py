"""A supervised actuator net: from the errors of a joint to the torque that its motor's current tells of."""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence
from copy import deepcopy
from dataclasses import dataclass

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor, nn

from torchrl_athletic.identification.open_loop import identified_joints
from torchrl_athletic.identification.simulator import Simulator
from torchrl_athletic.identification.takes import on_grid, velocity_of
from torchrl_athletic.networks import uan
from torchrl_athletic.recordings import Recording
from torchrl_athletic.robots import Robot

Array = NDArray[np.float64]


@dataclass(frozen=True)
class ActuatorNetTraining:
    """How the net is trained."""

    history: int = 20
    """Steps that it sees."""
    hidden: tuple[int, ...] = (128, 128)
    epochs: int = 40
    """At most."""
    patience: int = 5
    """Epochs without improvement on the validation slice, after which it stops."""
    batch: int = 4096
    """Samples, of any joints."""
    learning_rate: float = 1e-3
    validation: float = 0.1
    """Last part of each take, kept for stopping [1]."""


def identify_actuator_net(
    robot: Robot,
    recordings: Sequence[Recording],
    settings: ActuatorNetTraining | None = None,
    *,
    seed: int = 0,
    progress: Callable[[int, float], None] | None = None,
) -> Simulator:
    """Learn the measured torque from the history of errors, one net for all joints, and put it in the law's place.

    Args:
        robot: Whose simulation gets the net.
        recordings: With ``torque_measured``; where that is ``current_derived`` it tells of the motor, not of what
            reaches the link behind a gear, and neither will the net.
        settings: None takes the defaults.
        seed: Of weights and batches.
        progress: Called with the epoch and the root mean square error of the validation slice [N·m].

    Raises:
        ValueError: If a recording has no measured torque.

    Source:
        Hwangbo et al. 2019, https://arxiv.org/abs/1901.08652; Fey et al. 2025, section III-A, baseline "Actuator Net".
    """
    settings, started = settings or ActuatorNetTraining(), time.perf_counter()
    torch.manual_seed(seed)
    parts = [samples(robot, recording, settings.history) for recording in recordings]
    fit = [_split(part, settings.validation) for part in parts]
    seen, torque = (torch.cat([train[k].flatten(0, 1) for train, _ in fit]) for k in (0, 1))
    held_seen, held_torque = (torch.cat([held[k].flatten(0, 1) for _, held in fit]) for k in (0, 1))
    spread = seen.unflatten(-1, (2, settings.history)).std((0, 2)).clamp(min=1e-6)
    scale = float(torque.std().clamp(min=1e-6))
    units = (float(spread[0]), float(spread[1]))
    net = uan(settings.history, settings.hidden, unit=units, torque_unit=scale)
    optimiser = torch.optim.Adam(net.parameters(), settings.learning_rate)
    best, least, waited = deepcopy(net.state_dict()), np.inf, 0
    for epoch in range(settings.epochs):
        for chosen in torch.randperm(len(seen)).split(settings.batch):
            loss = ((net(seen[chosen]).squeeze(-1) - torque[chosen]) / scale).square().mean()
            optimiser.zero_grad()
            loss.backward()
            optimiser.step()
        error = _rms(net, held_seen, held_torque)
        if error < least:
            best, least, waited = deepcopy(net.state_dict()), error, 0
        else:
            waited += 1
        if progress is not None:
            progress(epoch, error)
        if waited >= settings.patience:
            break
    net.load_state_dict(best)
    notes = {
        "seed": seed,
        "training_seconds": time.perf_counter() - started,
        "data_seconds": float(sum(r.duration for r in recordings)),
        "torque_rmse": least,
        "epochs": epoch + 1,
    }
    return Simulator("actuator_net", robot, net=net.eval().requires_grad_(False), kind="torque", notes=notes)


def samples(robot: Robot, recording: Recording, history: int) -> tuple[Tensor, Tensor]:
    """Errors that a net sees at each step, and the torque that the drive reports once the step is over.

    Args:
        robot: Its identified joints are taken; its gains where the recording has torques for commands.
        recording: T samples.
        history: L.

    Returns:
        Shapes (T - L, J, 2 L), position errors before velocity errors, and (T - L, J) [N·m].
    """
    if recording.torque_measured is None:
        raise ValueError(
            f"{recording.source} holds no torque_measured, so there is nothing that a supervised actuator net could "
            "learn. Log the motor current, or train an Unsupervised Actuator Net, which needs none."
        )
    recording = on_grid(recording, robot)
    assert recording.torque_measured is not None
    names = [n for n in identified_joints(Simulator("default", robot)) if n in recording.joint_names]
    columns = [recording.joint_names.index(name) for name in names]
    errors = torch.from_numpy(tracking_errors(robot, recording)[:, columns]).float()  # (T, J, 2)
    windows = errors.unfold(0, history, 1)[:-1]  # (T - L, J, 2, L): the newest at T - 2
    torque = torch.from_numpy(recording.torque_measured[history:, columns]).float()
    return windows.flatten(-2), torque


def tracking_errors(robot: Robot, recording: Recording) -> Array:
    """Position errors and velocity errors, as ``UANCorrection`` would see them on the robot. Shape (T, J, 2)."""
    velocity = velocity_of(recording)
    if recording.position_target is not None:
        return np.stack([recording.position_target - recording.position, -velocity], axis=-1)
    columns = [robot.joint_names.index(name) for name in recording.joint_names]
    kp, kd = np.asarray(robot.kp)[columns], np.asarray(robot.kd)[columns]
    return np.stack([(recording.command + kd * velocity) / kp, -velocity], axis=-1)


def _split(part: tuple[Tensor, Tensor], share: float) -> tuple[tuple[Tensor, Tensor], tuple[Tensor, Tensor]]:
    """What is learned from, and the last ``share`` of the take."""
    seen, torque = part
    at = max(1, round((1 - share) * len(seen)))
    return (seen[:at], torque[:at]), (seen[at:], torque[at:])


@torch.no_grad()
def _rms(net: nn.Module, seen: Tensor, torque: Tensor) -> float:
    squared = [
        (net(s).squeeze(-1) - t).square().sum() for s, t in zip(seen.split(65536), torque.split(65536), strict=True)
    ]
    return float((torch.stack(squared).sum() / len(seen)).sqrt())
