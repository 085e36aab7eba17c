"""How far a simulator drifts from the robot when it gets the commands of a recording and nothing else."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from itertools import groupby

import numpy as np
import torch
from numpy.typing import NDArray
from tensordict import TensorDictBase
from torch import Tensor
from torchrl.envs import Compose, TransformedEnv

from torchrl_athletic.envs import TorqueEnv
from torchrl_athletic.identification.simulator import Simulator
from torchrl_athletic.identification.takes import on_all_joints, on_grid, velocity_of
from torchrl_athletic.physics import BatchPhysics
from torchrl_athletic.recordings import Recording, RecordingError
from torchrl_athletic.transforms import CorrectedActuation

Array = NDArray[np.float64]

LOST = 1.0
"""A rollout in which a joint is ever off by more than this counts as diverging [rad, m]."""
MOST = np.pi
"""An error counts for no more than this in a mean, which a rollout that left for good would otherwise rule [rad, m]."""
WARM_UP = 40
"""Recorded steps before the start that histories, delays and lags of the chain are filled with."""


@dataclass(frozen=True, eq=False)
class Replay:
    """A recording, and what a simulator made of its commands. W windows of L steps, J joints."""

    recording: Recording
    """The recording, on the grid of the physics."""
    index: NDArray[np.intp]
    """Samples of the recording that are predicted; a window's start is the sample before. Shape (W, L)."""
    position: Array
    """Simulated positions at these samples, as the encoders would read them. Shape (W, L, J)."""
    joints: tuple[str, ...]
    """Names of the J joints: those that are identified."""
    failed: NDArray[np.bool_]
    """Windows in which the simulation itself became unstable. Shape (W,)."""

    @property
    def measured(self) -> Array:
        """Shape (W, L, J)."""
        columns = [self.recording.joint_names.index(name) for name in self.joints]
        return self.recording.position[self.index][..., columns]

    @property
    def error(self) -> Array:
        """Simulated minus measured, bounded by :data:`MOST`. Shape (W, L, J)."""
        return np.clip(self.position - self.measured, -MOST, MOST)

    @property
    def diverged(self) -> NDArray[np.bool_]:
        """Windows in which a joint was ever off by more than :data:`LOST`. Shape (W,)."""
        return self.failed | (np.abs(self.error).max((1, 2)) > LOST)


@dataclass(frozen=True)
class OpenLoopScore:
    """Error of one or several rollouts."""

    mse: float
    """Mean squared error of the position over joints and samples [rad²]."""
    per_joint: dict[str, float]
    """Mean squared error of each joint by its name [rad²]."""
    diverged: float
    """Share of windows that diverged."""


def open_loop(simulator: Simulator, recordings: Sequence[Recording], window: float | None = None) -> list[Replay]:
    """Start where the robot was, then let the recorded commands act through the chain that policies are trained with.

    Position targets act through the drives' law on the *simulated* state, with the recording's gains; torques act as
    they are. Histories, delays and lags are filled from the samples before the start, where there are any. All takes
    are simulated at once.

    Args:
        simulator: What is judged.
        recordings: Of the robot's joints, or of those that were identified; the others then hold their default.
        window: Start anew from the measured state every so often [s]; None is one rollout over the whole take.
            Recordings of another rate than the physics' are resampled.

    Returns:
        One rollout for each recording, in their order.

    Raises:
        RecordingError: If a recording lacks joints that were identified, or names others than the robot's.

    Source:
        Fey et al. 2025, section III-A, figure 5.

    Example:
        >>> import numpy as np
        >>> from torchrl_athletic.robots import z1
        >>> robot, time = z1(), np.arange(0.0, 1.0, 0.005)
        >>> hold = np.tile(robot.default_pose, (200, 1))
        >>> take = Recording(time, robot.joint_names, hold, position_target=hold, kp=robot.kp, kd=robot.kd)
        >>> [rollout] = open_loop(Simulator("default", robot), [take], window=0.5)
        >>> rollout.position.shape, score([rollout]).mse < 0.01, score([rollout]).diverged  # it sags a little
        ((1, 100, 6), True, 0.0)
    """
    found: list[Replay | None] = [None] * len(recordings)
    order = sorted(range(len(recordings)), key=lambda k: gains_of(recordings[k]))
    for _, group in groupby(order, key=lambda k: gains_of(recordings[k])):
        together = list(group)
        for k, rollout in zip(together, _rolled(simulator, [recordings[k] for k in together], window), strict=True):
            found[k] = rollout
    return [rollout for rollout in found if rollout is not None]


def score(rollouts: Sequence[Replay]) -> OpenLoopScore:
    """Score rollouts together; every sample weighs the same."""
    squared = np.concatenate([r.error.reshape(-1, len(r.joints)) ** 2 for r in rollouts])
    by_joint = dict(zip(rollouts[0].joints, squared.mean(0).tolist(), strict=True))
    diverged = np.concatenate([r.diverged for r in rollouts])
    return OpenLoopScore(float(squared.mean()), by_joint, float(diverged.mean()))


def gains_of(recording: Recording) -> tuple[tuple[float, ...], ...]:
    """What tells recordings apart that cannot run in one batch: gains, or none."""
    if recording.position_target is None:
        return ()
    assert recording.kp is not None
    assert recording.kd is not None
    return tuple(recording.kp.tolist()), tuple(recording.kd.tolist())


def _rolled(simulator: Simulator, recordings: Sequence[Recording], window: float | None) -> Iterator[Replay]:
    """Rollouts of takes with the same gains."""
    for recording in recordings:
        _check_identified(simulator, recording)
    recordings = [on_grid(recording, simulator.robot) for recording in recordings]
    takes = [on_all_joints(recording, simulator.robot) for recording in recordings]
    index = [windows_of(recording, window) for recording in recordings]
    rows = sum(len(i) for i in index)
    env = open_loop_env(simulator, takes[0], rows)
    steps = max(i.shape[1] for i in index)
    position, failed = simulate(env, takes, index, steps)
    joints = [n for n in identified_joints(simulator) if n in recordings[0].joint_names]
    columns = [simulator.robot.joint_names.index(name) for name in joints]
    first = 0
    for recording, i in zip(recordings, index, strict=True):
        rolled = position[first : first + len(i), : i.shape[1]][..., columns]
        yield Replay(recording, i, rolled, tuple(joints), failed[first : first + len(i)])
        first += len(i)


def _check_identified(simulator: Simulator, recording: Recording) -> None:
    missing = [name for name in identified_joints(simulator) if name not in recording.joint_names]
    if missing:
        raise RecordingError(
            f"{recording.source} holds the joints {recording.joint_names}; {missing} of {simulator.robot.name!r} are "
            "missing, so the robot would not move as it did. Record all joints under the model's names."
        )


def identified_joints(simulator: Simulator) -> tuple[str, ...]:
    robot = simulator.robot
    arm = robot.joint_groups.get("arm", range(len(robot.joint_names)))
    return tuple(robot.joint_names[j] for j in arm)


def windows_of(recording: Recording, window: float | None) -> NDArray[np.intp]:
    """Samples that each window predicts, back to back; the last one that does not fill is left out. Shape (W, L)."""
    last = recording.num_samples - 1
    length = last if window is None else min(max(1, round(window * recording.rate)), last)
    return np.arange(0, last - length + 1, length)[:, None] + np.arange(1, length + 1)


def open_loop_env(simulator: Simulator, take: Recording, rows: int, fields: Sequence[str] = ()) -> TransformedEnv:
    """Rows that follow a simulator's chain under commands as the take's, with fields of the model of their own."""
    robot = simulator.robot
    positions = take.kp is not None
    if take.kp is not None and take.kd is not None:
        driven = replace(simulator.nominal, kp=tuple(take.kp.tolist()), kd=tuple(take.kd.tolist()))
        simulator = replace(simulator, nominal=driven)
    chain = simulator.chain(command="position" if positions else "torque", decimation=1, randomize=False)
    threads = 1 if rows < 64 else None  # fewer rows are through before threads have met
    physics = BatchPhysics(robot.model(), rows, threads, fields, robot.joint_names)
    return TransformedEnv(TorqueEnv(robot, physics), Compose(*chain))


def simulate(
    env: TransformedEnv, takes: Sequence[Recording], index: Sequence[NDArray[np.intp]], steps: int
) -> tuple[Array, NDArray[np.bool_]]:
    """Positions as the encoders read them, shape (rows, steps, J), and which rows became unstable."""
    chain, base = env.transform, env.base_env
    start = [i[:, 0] - 1 for i in index]
    command = stacked([t.command for t in takes], start, range(steps))
    before = range(-WARM_UP, 1)
    shown = {
        "joint_position": _true(chain, stacked([t.position for t in takes], start, before)),
        "joint_velocity": stacked([velocity_of(t) for t in takes], start, before),
    }
    earlier = stacked([t.command for t in takes], start, before)
    model, rows = base.physics.model, command.shape[0]
    at = [model.joint(name) for name in base.robot.joint_names]
    qpos = torch.tensor(model.key(base.robot.keyframe).qpos).expand(rows, -1).clone()
    qvel = torch.zeros(rows, model.nv, dtype=torch.float64)
    qpos[:, [int(j.qposadr[0]) for j in at]] = shown["joint_position"][:, -1].double()
    qvel[:, [int(j.dofadr[0]) for j in at]] = shown["joint_velocity"][:, -1].double()
    seen = env.reset()  # what the chain remembers of nothing
    base.physics.reset(qpos=qpos, qvel=qvel)
    with torch.no_grad():
        for k in range(WARM_UP):
            acted = chain._inv_call(_seen(seen, earlier[:, k]))
            seen = chain._step(acted, seen.empty().update({key: value[:, k + 1] for key, value in shown.items()}))
        out = torch.empty(rows, steps, len(at), dtype=torch.float32)
        for k in range(steps):
            acted = chain._inv_call(_seen(seen, command[:, k]))
            seen = chain._step(acted, base._step(acted))
            out[:, k] = seen["joint_position"]
    return out.double().numpy(), base.physics.diverged.numpy().copy()


def _seen(seen: TensorDictBase, command: Tensor) -> TensorDictBase:
    """What a step starts from; of what follows it, joints alone are looked at."""
    return seen.set("action", command).set("_substep", torch.ones(len(command), 1, dtype=torch.bool))


def _true(chain: Compose, read: Tensor) -> Tensor:
    """Where joints are whose encoders read that."""
    for transform in chain:
        if isinstance(transform, CorrectedActuation):
            return (read - transform.encoder_offset) / transform.encoder_scale
    return read


def stacked(values: Sequence[Array], start: Sequence[NDArray[np.intp]], steps: range) -> Tensor:
    """Samples at ``start + steps`` of each take, the first and the last one held beyond its ends.

    Shape (rows, steps, J).
    """
    parts = []
    for value, first in zip(values, start, strict=True):
        index = np.clip(first[:, None] + np.arange(steps.start, steps.stop), 0, len(value) - 1)
        parts.append(torch.from_numpy(value[index]).float())
    return torch.cat(parts)
