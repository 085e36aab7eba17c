"""What named physics leaves of an error, handed to a UAN: trained on the diagnosis's own takes, scored as it scores."""

from __future__ import annotations

import shutil
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import mujoco
import numpy as np
import torch
from numpy.typing import NDArray
from torch import nn
from torchrl.envs import Transform

from torchrl_athletic.diagnosis import Diagnosis, Score
from torchrl_athletic.diagnosis.checkpoint import inputs_digest
from torchrl_athletic.diagnosis.compare import score
from torchrl_athletic.diagnosis.corrected import Simulation
from torchrl_athletic.diagnosis.corrected_xml import corrected_xml
from torchrl_athletic.diagnosis.fit import Hypothesis
from torchrl_athletic.diagnosis.prepare import prepare
from torchrl_athletic.diagnosis.replay import SHORTEST
from torchrl_athletic.effects import JointAddress, Law, Now, Parameter, Plant, Start
from torchrl_athletic.effects.effect import torque_bound
from torchrl_athletic.envs import replay_env
from torchrl_athletic.envs.replay import Driven
from torchrl_athletic.networks import save_checkpoint, uan
from torchrl_athletic.recordings import Recording, split_at_gaps
from torchrl_athletic.robots import Robot, from_mjcf
from torchrl_athletic.training.checkpoint import Checkpoints
from torchrl_athletic.training.ppo import train
from torchrl_athletic.training.uan import takes_of, torque_unit, units_of
from torchrl_athletic.training.uan_gradient import DifferentiableTorqueEnv, GradientLearner, descend
from torchrl_athletic.transforms import CorrectedActuation, EquivalentTarget
from torchrl_athletic.transforms.corrected_actuation import NOT_ACTED_OUT

Array = NDArray[np.float64]

HISTORY = 20
"""Physics steps that the net looks back."""
HIDDEN = (32, 32)
"""What is left is small, and so is the net: takes of a minute would teach a larger one their noise."""
FILE, CHECKPOINTS = "uan.pt", "uan_checkpoints"


def learn_remainder(
    diagnosis: Diagnosis,
    output: str | Path | None = None,
    *,
    minutes: float = 2.0,
    rows: int = 16,
    rate: float = 2e-3,
    iterations: int | None = None,
    progress: bool = True,
) -> Diagnosis:
    """Teach a net the torques that the corrected simulation still lacks, and score it on the same windows.

    The net is trained down the gradient of the position error on the fitted takes; those kept aside only score. Its
    score is ``train_uan`` and ``heldout_uan`` of the answer's ``fit``, beside those of the named physics. Findings that
    have no place in a policy's simulation (:data:`~torchrl_athletic.transforms.corrected_actuation.NOT_ACTED_OUT`) are
    left to the net as well, and a remark says so.

    Args:
        diagnosis: Complete, as :func:`~torchrl_athletic.diagnosis.diagnose` returns it.
        output: Folder of the diagnosis, which is written again, with ``uan.pt`` beside it. A training that was killed
            goes on from its last checkpoint there, if diagnosis and arguments are as they were.
        minutes: Of training [min].
        rows: Replayed at once.
        rate: First learning rate; it falls to zero in ``minutes``.
        iterations: When to stop in any case.
        progress: Whether to show a bar.

    Returns:
        The diagnosis with the two scores.

    Raises:
        ValueError: If the diagnosis holds no recordings, takes of several kinds or gains, or drop-outs everywhere.
    """
    if not diagnosis.recordings:
        raise ValueError(
            "the diagnosis holds no recordings (it was loaded, or stopped early), so there is nothing to learn from. "
            "Diagnose to the end, and hand over what diagnose() returns."
        )
    if diagnosis.recordings[0].base_position is not None:
        raise ValueError(
            "the base of this robot floats, and a net is trained on a robot that stands. Name what you can, and leave "
            "out --uan."
        )
    named = acted_out(diagnosis.corrected)
    robot = driven_robot(corrected_xml(diagnosis.xml, named, drive=False), diagnosis.recordings)
    torch.manual_seed(diagnosis.answer.seed)
    takes = takes_of([_named(r, robot) for r in without_gaps(diagnosis.recordings)], robot)
    net = uan(HISTORY, HIDDEN, **units_of(takes, robot))
    base = DifferentiableTorqueEnv(robot, num_envs=rows)
    env = replay_env(
        robot,
        takes,
        chain=chain_of(named, robot, takes.driven),
        unit=torque_unit(net),
        base=base,
        max_steps=round(0.5 / float(robot.model().opt.timestep)),
        seed=diagnosis.answer.seed,
    )
    learner = GradientLearner(env, net, minutes=minutes, rate=rate)
    run = {"minutes": minutes, "rows": rows, "rate": rate, "iterations": iterations}
    train(
        learner,
        minutes=minutes,
        iterations=iterations,
        checkpoints=None if output is None else _checkpoints(diagnosis, Path(output), run),
        progress=progress,
        show=["train_mse"],
        step=descend,
    )
    scores = {
        f"{split}_uan": scored(diagnosis, named, net, robot, split)
        for split, group in (("train", diagnosis.recordings), ("heldout", diagnosis.heldout))
        if group
    }
    answer, left = (
        diagnosis.answer,
        [c for c in diagnosis.corrected.hypothesis.terms if c not in named.hypothesis.terms],
    )
    remark = _remark(answer.fit, scores, [f"{c.effect.name.replace('_', ' ')} of {c.where}" for c in left])
    answer = replace(answer, fit={**answer.fit, **scores}, remarks=(*answer.remarks, remark))
    found = replace(diagnosis, answer=answer)
    if output is not None:
        save_checkpoint(Path(output) / FILE, {"hidden": list(HIDDEN), "history": HISTORY}, net=net)
        found.save(output)
        shutil.rmtree(Path(output) / CHECKPOINTS, ignore_errors=True)
    return found


def _checkpoints(diagnosis: Diagnosis, output: Path, run: Mapping[str, float | None]) -> Checkpoints:
    """In a folder of its own for each diagnosis and choice of arguments: nothing else is gone on with."""
    told = {**run, "corrected": diagnosis.corrected.to_json(), "seed": diagnosis.answer.seed}
    return Checkpoints(output / CHECKPOINTS / inputs_digest(diagnosis.xml, diagnosis.recordings, told)[:12])


def driven_robot(xml: str, recordings: Sequence[Recording]) -> Robot:
    """The given model with the gains of its takes; with a unit gain where they are torques.

    Raises:
        ValueError: If the gains differ between takes, since the errors that a net sees would mean several things.
    """
    kp, kd = recordings[0].kp, recordings[0].kd
    if len({(str(r.kp), str(r.kd)) for r in recordings}) > 1:
        raise ValueError(
            "the takes have several gains, or positions and torques for commands: the errors that a net sees would "
            "mean several things. Diagnose takes of one kind to hand the rest to a UAN."
        )
    robot = from_mjcf(xml, kp=1.0, kd=0.0, torque_limit=1.0)
    model = robot.model()
    address = JointAddress.of(model, robot.joint_names)
    limits = [torque_bound(model, address, j) for j in range(len(robot.joint_names))]
    robot = replace(robot, torque_limit=tuple(limits))
    if kp is None or kd is None:
        return robot
    columns = [recordings[0].joint_names.index(name) for name in robot.joint_names]
    return replace(robot, kp=tuple(kp[columns].tolist()), kd=tuple(kd[columns].tolist()))


def without_gaps(recordings: Sequence[Recording]) -> list[Recording]:
    """Recordings with drop-outs cut into takes, the others as they are; pieces under a second are left out.

    Raises:
        ValueError: If nothing is left; says how long the longest piece is.
    """
    cut = [split_at_gaps(r) for r in recordings]
    kept = [piece for pieces in cut for piece in pieces if len(pieces) == 1 or piece.duration >= SHORTEST]
    if not kept:
        longest = max(piece.duration for pieces in cut for piece in pieces)
        raise ValueError(
            f"{recordings[0].source}: drop-outs leave no second in one piece, the longest has {longest:.2f} s, too "
            "short for a net to learn from. Leave out --uan, or record again without drop-outs."
        )
    return kept


def _named(recording: Recording, robot: Robot) -> Recording:
    """Without the channels that training does not look at."""
    return replace(recording.ordered(robot.joint_names), torque_measured=None, torque_semantics=None)


def acted_out(corrected: Simulation) -> Simulation:
    """The correction without what no simulation of a policy acts out."""
    whole = corrected.hypothesis
    kept = tuple(c for c in whole.terms if c.effect.name not in NOT_ACTED_OUT)
    values = [whole.values_of(c, corrected.values) for c in (*kept, *whole.trims)]
    numbers = np.concatenate(values) if values else np.zeros(0)
    return replace(corrected, hypothesis=Hypothesis(kept, whole.trims), values=numbers)


def chain_of(corrected: Simulation, robot: Robot, driven: Driven) -> list[Transform]:
    """What stands between a command and the corrected model's joints, with the limits of its motors."""
    gains = (robot.kp, robot.kd) if driven == "position" else (None, None)
    law = CorrectedActuation(
        corrected.to_json(),
        timestep=float(robot.model().opt.timestep),
        joint_names=robot.joint_names,
        kp=gains[0],
        kd=gains[1],
        torque_limit=robot.torque_limit,
    )
    return [law] if driven == "position" else [law, EquivalentTarget(robot.kp, robot.kd)]


def _remark(before: Mapping[str, Score], after: Mapping[str, Score], stood_in_for: Sequence[str]) -> str:
    """What the net did on the takes that decide."""
    split = "heldout" if "heldout" in before else "train"
    named, learnt = before[split].after, after[f"{split}_uan"].after
    where = "kept aside" if split == "heldout" else "that it was fitted on"
    net = f"A UAN in place of {' and '.join(stood_in_for)}" if stood_in_for else "A UAN on the remainder"
    if learnt >= named:
        return f"{net} does not help on recordings {where}: leave it out of the simulation."
    return f"{net} takes another {100 * (1 - learnt / max(named, 1e-12)):.0f} % off the error on recordings {where}."


# --- the net in the diagnosis's own replay ----------------------------------------------------------------------------


@dataclass(frozen=True, eq=False)
class WithNet(Hypothesis):
    """A hypothesis with a net beside it, which acts where its last parameter is one and not where that is zero."""

    net: nn.Module | None = None
    robot: Robot | None = None

    @property
    def parameters(self) -> tuple[Parameter, ...]:
        return (*super().parameters, Parameter("net", "1", 0.0, 0.0, 1.0, 1.0))

    def build(self, plant: Plant, values: Array) -> None:
        super().build(plant, values[:, :-1])
        assert self.net is not None
        assert self.robot is not None
        law = LearnedTorque(self.net, self.robot, plant, values[:, -1:])
        plant.motor.append(law.note)
        plant.laws.append(law)


class LearnedTorque(Law):
    """A UAN's torque beside the motor, from the errors of the last physics steps of the robot that it was trained on.

    Args:
        net: As :func:`~torchrl_athletic.networks.uan` makes it.
        robot: With the gains that make an error of position of a torque, and its time step.
        plant: That it acts in.
        share: 1 where it acts, 0 where not. Shape (rows, 1).
    """

    def __init__(self, net: nn.Module, robot: Robot, plant: Plant, share: Array) -> None:
        names = [mujoco.mj_id2name(plant.model, mujoco.mjtObj.mjOBJ_JOINT, j) for j in plant.address.joint]
        order = [robot.joint_names.index(name) for name in names]
        self.back = np.argsort(order)
        self.net, self.share = net, share
        self.kp, self.kd = np.array(robot.kp)[order], np.array(robot.kd)[order]
        self.servo = bool(self.kd.any())
        self.period, self.step = float(robot.model().opt.timestep), float(plant.model.opt.timestep)
        self.stride = max(1, round(self.period / self.step))

    def begin(self, start: Start) -> None:
        """Fill the history with what was measured before; before a piece's first sample it stood as it began."""
        self.start = start
        errors = self._errors(start.command, start.position, start.velocity)  # (S, J, 2)
        back = np.arange(HISTORY * self.stride, 0, -1) * self.step
        at = start.time[start.sample][:, None] - back  # (rows, L)
        columns = errors.reshape(len(errors), -1).T
        past = np.empty((*at.shape, len(columns)))
        for k, piece in enumerate(start.pieces):
            rows = start.piece == k
            past[rows] = np.stack([np.interp(at[rows], start.time[piece], column[piece]) for column in columns], -1)
        self.past = past.reshape(*at.shape, *errors.shape[1:])  # (rows, L, J, 2)

    def note(self, now: Now) -> Array:
        """See the motor's errors; its torque stays as it is."""
        torque = now.torque
        if not self.servo:  # as it was sent, whatever delays it on its way
            torque = self.start.command[self.start.at(now.time)]
        errors = self._errors(torque, now.position, now.velocity)[:, None]
        self.past = np.concatenate([self.past[:, 1:], errors], 1)
        return now.torque

    def __call__(self, now: Now) -> Array:
        seen = self.past[:, self.stride - 1 :: self.stride][:, :, self.back]  # (rows, L, J, 2), in the robot's order
        features = torch.from_numpy(seen.transpose(0, 2, 3, 1).reshape(*seen.shape[::2], -1)).float()
        with torch.no_grad():
            torque = self.net(features).squeeze(-1).double().numpy()
        return np.asarray(self.share * torque[:, np.argsort(self.back)])

    def _errors(self, torque: Array, position: Array, velocity: Array) -> Array:
        """Position error of the target that commands this torque, and velocity error. Shape (..., J, 2)."""
        return np.stack([(torque + self.kd * velocity) / self.kp, -velocity], -1)


def scored(diagnosis: Diagnosis, corrected: Simulation, net: nn.Module, robot: Robot, split: str) -> Score:
    """The given model against the corrected one with the net, over the windows that the diagnosis was scored on."""
    prepared = prepare(diagnosis.heldout if split == "heldout" else diagnosis.recordings, corrected.model)
    hypothesis = WithNet(corrected.hypothesis.terms, corrected.hypothesis.trims, net, robot)
    values = np.append(corrected.values, 1.0)
    rng = np.random.default_rng([diagnosis.answer.seed, *split.encode()])
    return score(prepared.takes, hypothesis, values, prepared.position_noise, rng, prepared.repeatability)[0]
