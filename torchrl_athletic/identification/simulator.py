"""An identified simulator: a robot, what was found out about it, and what stands between targets and its motors."""

from __future__ import annotations

import hashlib
import json
import math
import os
from collections.abc import Mapping
from dataclasses import asdict, dataclass, field, replace
from functools import cached_property
from pathlib import Path
from typing import Any, Literal

import torch
from torch import nn
from torchrl.envs import Transform

from torchrl_athletic.networks import Sizes, load_checkpoint, save_checkpoint, sizes_of
from torchrl_athletic.recordings.whole_file import whole_file
from torchrl_athletic.robots import Robot, with_correction
from torchrl_athletic.transforms import (
    ActionDelay,
    ActuatorNet,
    CorrectedActuation,
    Decimation,
    DomainRandomization,
    EquivalentTarget,
    LimitedTarget,
    PDControl,
    PowerClip,
    RandomizationRanges,
    TorqueSpeedClip,
    UANCorrection,
)

SCHEMA = "torchrl_athletic/simulator/1"
Kind = Literal["none", "correction", "torque"]
"""What the net's output is: there is no net, a torque on top of the controller's, or the torque in place of it."""
Command = Literal["position", "torque"]
"""What the robot is told: position targets of a PD law, or torques."""


@dataclass(frozen=True, eq=False)
class Simulator:
    """A robot as a method of identification simulates it.

    All methods end here, so that recordings are replayed and policies are trained in the same way in each of them:
    ``TorqueEnv(simulator.robot, fields=simulator.fields)`` with the transforms of :meth:`chain` around it.

    Example:
        >>> from torchrl.envs import Compose, TransformedEnv
        >>> from torchrl_athletic.envs import TorqueEnv
        >>> from torchrl_athletic.networks import uan
        >>> from torchrl_athletic.robots import z1
        >>> simulator = Simulator("uan", z1(), net=uan(), kind="correction")
        >>> env = TorqueEnv(simulator.robot, num_envs=2, fields=simulator.fields)
        >>> TransformedEnv(env, Compose(*simulator.chain())).rollout(3)["torque_correction"].shape
        torch.Size([2, 3, 6])
    """

    name: str
    """Name of the method: ``"default"``, ``"cem"``, ``"uan"``..."""
    nominal: Robot
    """As given, before anything was identified."""
    correction: Mapping[str, Any] | None = None
    """Content of a ``corrected.json``: friction, damping, armature and what else has a name. None changes nothing."""
    net: nn.Module | None = None
    """As :func:`~torchrl_athletic.networks.uan` makes it: what it sees, (*B, J, F), to (*B, J, 1) [N·m]."""
    kind: Kind = "none"
    randomization: RandomizationRanges | None = None
    """What differs between episodes of a policy's training; replays take the robot as it is."""
    notes: Mapping[str, Any] = field(default_factory=dict)
    """What JSON can keep: ``training_seconds``, ``data_seconds``, ``seed`` and whatever a method wants to say."""

    def __post_init__(self) -> None:
        if (self.net is None) != (self.kind == "none"):
            raise ValueError(
                f"simulator {self.name!r} has {'no' if self.net is None else 'a'} net and kind {self.kind!r}: it would "
                "not be known what acts. Give both a net and 'correction' or 'torque', or neither."
            )
        if self.kind == "torque" and self.correction is not None:
            raise ValueError(
                f"simulator {self.name!r} has a correction and a net in place of the torque law, which would overrule "
                "each other. Give one of them, or a net of kind 'correction'."
            )

    @cached_property
    def robot(self) -> Robot:
        """The robot with the correction in its model, as far as a model can say it."""
        return self.nominal if self.correction is None else with_correction(self.nominal, self.correction)

    @property
    def history(self) -> int:
        """Steps that the net looks back; 0 without one."""
        return 0 if self.net is None else sizes_of(self.net).history

    @property
    def fields(self) -> tuple[str, ...]:
        """Model fields that differ between rows of an environment: ``TorqueEnv(..., fields=simulator.fields)``."""
        return () if self.randomization is None else self._randomizer(0).fields

    @property
    def digest(self) -> str:
        """Names what acts in it: another model, correction, net or range of randomisation gives another digest."""
        total = hashlib.sha256(self.robot.spec().to_xml().encode())
        told = (self.kind, self.nominal.kp, self.nominal.kd, self.nominal.torque_limit, self.nominal.velocity_limit)
        total.update(repr((told, self.randomization)).encode())
        total.update(json.dumps(self.correction, sort_keys=True).encode())
        memory = () if self.net is None else sizes_of(self.net).memory
        if memory:
            total.update(repr(memory).encode())
        for name, value in () if self.net is None else self.net.state_dict().items():
            total.update(f"{name} {value if isinstance(value, list) else value.cpu().numpy().tobytes()!r}".encode())
        return total.hexdigest()[:16]

    def on(self, robot: Robot) -> Simulator:
        """Put this identification on a variant of the robot, such as one with a tool in its hand."""
        return replace(self, nominal=robot)

    def chain(
        self,
        *,
        command: Command = "position",
        limits: bool = True,
        arm_power: float | None = None,
        max_delay: int = 0,
        min_delay: int = 0,
        decimation: int = 4,
        substeps: int = 1,
        randomize: bool = True,
        seed: int = 0,
        first_row: int = 0,
    ) -> list[Transform]:
        """All that stands between a policy's action and the joints, from the joint outwards.

        A UAN comes last on the way in, behind the motor's limits: what it corrects, friction say, happens there, and a
        saturated motor would hide it.

        Args:
            command: What the action is: position targets, or torques.
            limits: Whether the motors' limits by speed apply.
            arm_power: Greatest power of the arm [W]; None sets no limit.
            max_delay: Greatest delay of the action, drawn per episode [torques].
            min_delay: Least delay.
            decimation: Torques per action; with 1 the chain has no :class:`Decimation`.
            substeps: Physics steps that each torque is held for, as of :class:`~torchrl_athletic.envs.TorqueEnv`.
            randomize: Whether to draw another robot for each episode, where the method does.
            seed: Of the draws.
            first_row: Number of the first row, for parts of a larger batch.

        Returns:
            Transforms for ``Compose``. The net's errors are noted in ``error_history``, shape (N, J, 2, history).
        """
        robot, group = self.robot, _group(self.robot)
        step = substeps * float(robot.model().opt.timestep)
        chain: list[Transform] = []
        if self.net is not None and self.kind == "correction":  # what it corrects happens behind the motor
            sizes = sizes_of(self.net)
            chain.append(
                UANCorrection(
                    self.net,
                    joints=group,
                    length=sizes.history,
                    state=sizes.state,
                    memory=sizes.memory,
                    timestep=step,
                )
            )
        if arm_power is not None:
            chain.append(PowerClip(arm_power, joints=group))
        chain += self._motor(group, limits) + self._law(command, limits, step)
        if max_delay:
            before = robot.default_pose
            chain.append(ActionDelay(max_delay, min_delay, before=before, seed=seed, first_row=first_row))
        if decimation > 1:
            chain.append(Decimation(decimation))
        if randomize and self.randomization is not None:
            chain.append(self._randomizer(seed, first_row))
        return chain

    def _motor(self, group: str | None, limits: bool) -> list[Transform]:
        """The motor, where no correction holds it."""
        if self.correction is not None:
            return []
        robot = self.robot
        motor: list[Transform] = [TorqueSpeedClip(robot.torque_limit, _finite(robot.velocity_limit))] if limits else []
        if self.net is not None and self.kind == "torque":
            motor.append(ActuatorNet(self.net, joints=group, length=self.history))
        return motor

    def _law(self, command: Command, limits: bool, step: float) -> list[Transform]:
        """From the command to a torque, and the target that nets look at."""
        robot, positions = self.robot, command == "position"
        if self.correction is None:
            return [(PDControl if positions else EquivalentTarget)(robot.kp, robot.kd)]
        corrected = CorrectedActuation(
            self.correction,
            timestep=step,
            joint_names=robot.joint_names,
            kp=robot.kp if positions else None,
            kd=robot.kd if positions else None,
            torque_limit=robot.torque_limit,
        )
        most = robot.torque_limit, _finite(robot.velocity_limit)
        if positions:  # the drive's limits come before its lag, and before what friction does
            return [corrected, *([LimitedTarget(robot.kp, robot.kd, *most)] if limits else [])]
        return [corrected, *([TorqueSpeedClip(*most)] if limits else []), EquivalentTarget(robot.kp, robot.kd)]

    def _randomizer(self, seed: int, first_row: int = 0) -> DomainRandomization:
        return DomainRandomization(self.randomization, joints=_group(self.robot), seed=seed, first_row=first_row)

    def save(self, folder: str | os.PathLike[str]) -> Path:
        """Write ``simulator.json``, and ``corrected.json`` and ``net.pt`` where there is a correction or a net.

        ``simulator.json`` comes last: a folder that has it is complete.
        """
        folder = Path(folder)
        folder.mkdir(parents=True, exist_ok=True)
        if self.correction is not None:
            _write(folder / "corrected.json", dict(self.correction))
        if self.net is not None:
            save_checkpoint(folder / "net.pt", asdict(sizes_of(self.net)), net=self.net)
        content = {
            "schema": SCHEMA,
            "method": self.name,
            "kind": self.kind,
            "corrected": self.correction is not None,
            "randomization": None if self.randomization is None else asdict(self.randomization),
            "joint_names": list(self.nominal.joint_names),
            "kp": list(self.nominal.kp),
            "kd": list(self.nominal.kd),
            "notes": dict(self.notes),
        }
        _write(folder / "simulator.json", content)
        return folder

    @classmethod
    def load(cls, folder: str | os.PathLike[str], robot: Robot) -> Simulator:
        """Read :meth:`save` back.

        Args:
            folder: That was written.
            robot: The nominal robot, or a variant of it that holds a tool.

        Raises:
            FileNotFoundError: If the folder holds no simulator.
            ValueError: If it was written by another version, or the robot has other joints than were identified, or a
                net was trained under other gains.
        """
        folder = Path(folder)
        if not (folder / "simulator.json").exists():
            raise FileNotFoundError(
                f"{folder} holds no simulator.json, so no method has finished there. Name the folder that a recipe "
                "of identification gave as --output."
            )
        content = json.loads((folder / "simulator.json").read_text(encoding="utf-8"))
        if content.get("schema") != SCHEMA:
            raise ValueError(f"{folder}: schema is {content.get('schema')!r}, needed is {SCHEMA!r}. Identify it again.")
        correction = None
        if content["corrected"]:
            correction = json.loads((folder / "corrected.json").read_text(encoding="utf-8"))
        ranges = content["randomization"]
        if ranges is not None:
            ranges = RandomizationRanges(**{k: None if v is None else tuple(v) for k, v in ranges.items()})
        net = None if content["kind"] == "none" else load_net(folder / "net.pt")
        _check_robot(folder, content, robot)
        return cls(content["method"], robot, correction, net, content["kind"], ranges, content["notes"])


def _check_robot(folder: Path, content: Mapping[str, Any], robot: Robot) -> None:
    names = content.get("joint_names", [])
    missing = [name for name in names if name not in robot.joint_names]
    if missing:
        raise ValueError(
            f"{folder}: {missing} were identified, {robot.name!r} has the joints {list(robot.joint_names)}: what was "
            "found would act on other joints. Give the robot that was identified, or a variant of it."
        )
    if content["kind"] == "none":
        return
    for gain in ("kp", "kd"):
        then = content.get(gain, [])
        now = [getattr(robot, gain)[robot.joint_names.index(name)] for name in names]
        if any(abs(a - b) > 1e-3 * abs(a) for a, b in zip(then, now, strict=True)):
            raise ValueError(
                f"{folder}: the net was trained with {gain} {then}, {robot.name!r} has {now}: the errors that it sees "
                f"would mean other torques. Give the robot these gains, dataclasses.replace(robot, {gain}=...), or "
                "train a net with its own."
            )


def read_correction(path: str | os.PathLike[str]) -> dict[str, Any]:
    """Content of a ``corrected.json``, named itself or by the folder of a diagnosis or a simulator that holds it."""
    path = Path(path)
    content: dict[str, Any] = json.loads((path / "corrected.json" if path.is_dir() else path).read_text("utf-8"))
    return content


def inertia_of(correction: Mapping[str, Any]) -> dict[str, Any]:
    """The rotors' inertias of a correction alone, for a net to learn the rest on top of.

    A torque that answers an acceleration comes a step after it, which turns unstable as what is missing nears what the
    simulation has; friction it can be.

    Args:
        correction: Content of a ``corrected.json``, CEM's say.

    Example:
        >>> found = [{"effect": "coulomb_friction", "joint": "hip"}, {"effect": "reflected_inertia", "joint": "hip"}]
        >>> inertia_of({"schema": SCHEMA, "effects": found})["effects"]
        [{'effect': 'reflected_inertia', 'joint': 'hip'}]
    """
    return {**correction, "effects": [e for e in correction["effects"] if e["effect"] == "reflected_inertia"]}


def on_a_fit(path: str | os.PathLike[str], net: str, robot: Robot, inertia_only: bool = False) -> Simulator:
    """What a net shall be trained on top of.

    Args:
        path: As of :func:`read_correction`.
        net: What kind of net it will be: ``"uan"``, ``"uan_memory"``...
        robot: As nominal.
        inertia_only: Whether to take :func:`inertia_of` the correction.

    Returns:
        Without a net, named after the method that left the folder, ``"diagnosed_uan"`` say, or ``"inertia_uan"``.
    """
    path, correction = Path(path), read_correction(path)
    if inertia_only:
        return Simulator(f"inertia_{net}", robot, inertia_of(correction))
    told = (path if path.is_dir() else path.parent) / "simulator.json"
    method = json.loads(told.read_text("utf-8"))["method"] if told.exists() else "diagnosed"
    return Simulator(f"{method}_{net}", robot, correction)


def load_net(path: str | os.PathLike[str]) -> nn.Module:
    """The net of a ``net.pt``, of whatever sizes it was saved with."""
    sizes = torch.load(path, map_location="cpu", weights_only=True)["metadata"]
    told = sizes.get("joints"), sizes.get("state", False), tuple(sizes.get("memory", ())), sizes.get("odd", False)
    net = Sizes(sizes["history"], tuple(sizes["hidden"]), *told).net()
    load_checkpoint(Path(path), net=net)
    return net.eval().requires_grad_(False)


def _group(robot: Robot) -> str | None:
    """Joints that are identified: the arm's, or all of a robot without one."""
    return "arm" if "arm" in robot.joint_groups else None


def _finite(velocity_limit: tuple[float, ...]) -> tuple[float, ...]:
    return tuple(v if math.isfinite(v) else 1e9 for v in velocity_limit)


def _write(path: Path, content: Mapping[str, Any]) -> None:
    """Whole or not at all."""
    with whole_file(path) as part:
        part.write_text(json.dumps(content, indent=1, allow_nan=False) + "\n", encoding="utf-8")
