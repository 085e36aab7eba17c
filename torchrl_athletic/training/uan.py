"""Training an Unsupervised Actuator Net: from recordings to takes, the two ways to give credit, the validation."""

from __future__ import annotations

from collections.abc import Sequence
from copy import deepcopy
from dataclasses import replace
from itertools import pairwise
from statistics import median
from typing import Any, Literal

import numpy as np
import torch
from tensordict import TensorDict, TensorDictBase
from torch import Tensor, nn
from torchrl.envs import EnvBase, Transform, TransformedEnv
from torchrl.modules import MLP, ValueOperator

from torchrl_athletic.envs.replay import HISTORY, Takes, replay_env
from torchrl_athletic.functional import actuation
from torchrl_athletic.identification import Simulator
from torchrl_athletic.identification.takes import check_joints, on_all_joints, velocity_of
from torchrl_athletic.networks.actor_critic import GaussianHead, gaussian_actor
from torchrl_athletic.networks.actuator_net import LINEAR, InUnits, PerJoint, sizes_of, uan_actor
from torchrl_athletic.recordings import Recording, RecordingError
from torchrl_athletic.robots import Robot
from torchrl_athletic.training.captured import CapturedRollout
from torchrl_athletic.training.distributed import ALONE, Processes
from torchrl_athletic.training.ppo import PPO, UAN, Learner

Credit = Literal["arm", "joint"]
"""Whether all joints share one reward, as in the paper, or each earns its own."""
Knows = Literal["errors", "joint", "arm"]
"""What a net is told: a joint's errors, as in the paper; also which joint it is; also how the arm stands and moves."""

SHARPNESS = 30.0
"""How much finer velocities are seen about zero than at their standard deviation."""


def takes_of(recordings: Sequence[Recording], robot: Robot) -> Takes:
    """Recordings as :class:`~torchrl_athletic.envs.replay.Takes`, in the robot's order and on its physics' time step.

    What :func:`~torchrl_athletic.identification.takes.on_all_joints` makes of each take, as for scores.

    Args:
        recordings: All driven by position targets, or all by torques.
        robot: Whose gains are those of the takes.

    Raises:
        RecordingError: If a recording names other joints or gains than the robot, or is too short; says what to do.

    Example:
        >>> from torchrl_athletic.robots import z1
        >>> robot, time = z1(), np.arange(0.0, 1.0, 0.005)
        >>> rest = np.tile(robot.default_pose, (200, 1))
        >>> take = Recording(time, robot.joint_names, rest, position_target=rest, kp=robot.kp, kd=robot.kd)
        >>> takes_of([take], robot).lengths
        (200,)
    """
    if not recordings:
        raise RecordingError("no recordings: a net that shall learn what is missing needs at least one.")
    driven = {"torque" if r.torque_command is not None else "position" for r in recordings}
    if len(driven) > 1:
        raise RecordingError(
            "some takes are driven by position targets and others by torques: the errors that the net sees would mean "
            "two things. Train on one kind."
        )
    whole = [on_all_joints(_of_these_gains(r, robot), robot) for r in recordings]
    position, velocity, command = (
        torch.from_numpy(np.concatenate(column)).float()
        for column in zip(*((r.position, velocity_of(r), r.command) for r in whole), strict=True)
    )
    lengths = tuple(r.num_samples for r in whole)
    return Takes(position, velocity, command, lengths, "torque" if "torque" in driven else "position")


def _of_these_gains(recording: Recording, robot: Robot) -> Recording:
    """As it came, if its gains are the robot's."""
    if recording.kp is None or recording.kd is None or not set(recording.joint_names) <= set(robot.joint_names):
        return recording
    columns = [robot.joint_names.index(name) for name in recording.joint_names]
    for name, given, known in (("kp", recording.kp, robot.kp), ("kd", recording.kd, robot.kd)):
        wanted = np.asarray(known)[columns]
        if not np.allclose(given, wanted, rtol=1e-3):
            raise RecordingError(
                f"{recording.source}: {name} is {given.tolist()}, {robot.name}'s is {wanted.tolist()}: the replayed "
                "torques would be others. Give the robot the gains of the takes: dataclasses.replace(robot, "
                f"{name}=...)."
            )
    return recording


def for_training(recordings: Sequence[Recording]) -> list[Recording]:
    """Those that may be trained on: all but those whose metadata say ``split: heldout``, and throws.

    Raises:
        RecordingError: If none is left.
    """
    kept = [r for r in recordings if r.metadata.get("split", "train") == "train" and r.metadata.get("kind") != "throw"]
    if not kept:
        raise RecordingError(
            f"all {len(recordings)} recordings are held out, so there is nothing to train on. Collect takes with "
            "metadata split='train'."
        )
    return kept


def set_aside(
    recordings: Sequence[Recording], share: float = 0.1, seconds: float = 5.0, seed: int = 0
) -> tuple[list[Recording], list[Recording]]:
    """Cut windows out of takes to validate on; what lies between them is trained on.

    Args:
        recordings: To be cut.
        share: Of each take's duration; a take too short for one window beside as much again is left whole.
        seconds: Of a window [s].
        seed: Of where the windows lie.

    Returns:
        Pieces to train on, and windows of equal length.

    Raises:
        RecordingError: If no take is long enough for a window.
    """
    generator = np.random.default_rng(seed)
    pieces, windows = [], []
    for r in recordings:
        length = round(seconds * r.rate) + HISTORY
        count = max(1, int(r.num_samples * share / length)) if r.num_samples >= 2 * length else 0
        cells = np.linspace(0, r.num_samples, count + 1).astype(int)
        begin = 0
        for low, high in pairwise(cells):
            start = int(generator.integers(low, high - length + 1))
            windows.append(r.slice(start, start + length))
            if start - begin > 2 * HISTORY:
                pieces.append(r.slice(begin, start))
            begin = start + length
        if r.num_samples - begin > 2 * HISTORY:
            pieces.append(r.slice(begin, r.num_samples))
    if not windows:
        raise RecordingError(
            f"no take lasts {2 * seconds:.1f} s, so none can spare a window of {seconds} s to validate on. Validate on "
            "shorter windows."
        )
    return pieces, windows


def units_of(takes: Takes, robot: Robot, knows: Knows = "errors", memory: Sequence[float] = ()) -> dict[str, Any]:
    """What :func:`~torchrl_athletic.networks.uan` measures in: ``unit``, ``sharpness_of_velocity``, ``torque_unit``.

    Errors of position and velocity come in their standard deviations over the joints that move, velocities on a scale
    that tells creeping from rest. Torques come in N·m for a joint of the arm's median strength, and for others as much
    as their motors are stronger.

    Args:
        takes: To be trained on.
        robot: Whose torque limits tell how strong its motors are.
        knows: With ``"joint"``, ``joints`` is among them, with ``"arm"`` also ``state_unit``, standard deviations.
        memory: Ways [rad] over which it is shown how far a joint has wound up since it turned.

    Example:
        >>> from torchrl_athletic.robots import z1
        >>> moved = torch.rand(100, 7)
        >>> units_of(Takes(moved, moved, moved + 0.1 * torch.randn(100, 7), (100,)), z1())["torque_unit"]
        [1.0, 2.0, 1.0, 1.0, 1.0, 1.0]
    """
    kp, kd = torch.tensor(robot.kp), torch.tensor(robot.kd)
    off, torque = takes.command - takes.position, takes.command
    if takes.driven == "torque":
        off = (takes.command + kd * takes.velocity) / kp
    else:
        torque = actuation.pd_torque(takes.command, takes.position, takes.velocity, kp, kd)
    moves = takes.velocity.std(0) > 1e-6
    group = list(robot.joint_groups.get("arm", range(len(robot.joint_names))))
    limit = torch.tensor(robot.torque_limit)
    strength = limit[group].tolist()
    units: dict[str, Any] = {
        "unit": (float(off[:, moves].std()), float(takes.velocity[:, moves].std())),
        "sharpness_of_velocity": SHARPNESS,
        "torque_unit": [value / median(strength) for value in strength],
    }
    if memory:
        units["memory"] = tuple(memory)
    if knows != "errors":
        units["joints"] = len(group)
    if knows == "arm":
        state = (takes.position, takes.velocity, torque.clamp(-limit, limit))
        units["state_unit"] = torch.cat([v[:, group].std(0).clamp(min=1e-2) for v in state]).tolist()
    return units


class MeanPolicy(nn.Module):
    """The net as a policy that does not explore. Writes ``action`` (N, A), in units of torque."""

    def __init__(self, net: nn.Sequential) -> None:
        super().__init__()
        self.net = net[:-1]

    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        return tensordict.set("action", self.net(tensordict.get("observation")).squeeze(-1))


class Validation:
    """Open-loop replays of windows that nothing is trained on, one a row, from their first moments to their ends.

    A replay that diverges, or leaves the recording by more than the bound, is lost: from there to the window's end it
    is charged the square of the bound, or a net would gain by losing it.

    Args:
        env: :func:`~torchrl_athletic.envs.replay.replay_env` with a row for each window and ``by_row``.
        net: What corrects, as it is at each call; ``best`` keeps the lowest error and the net's state then.
        steps: Of each window.
    """

    def __init__(self, env: TransformedEnv, net: nn.Sequential, steps: int) -> None:
        self.net, self.best = net, (float("inf"), deepcopy(net.state_dict()))
        self.bound = env.transform[-1].bound
        self.rollout = CapturedRollout(env, MeanPolicy(net), steps, keys=["privileged"], fuse=False)

    @torch.no_grad()
    def __call__(self) -> dict[str, float]:
        """``mse`` [rad²], the mean over windows, time and joints, and ``lost``, the share of windows that were lost."""
        batch = self.rollout()
        lost = batch["next", "terminated"].cummax(1).values  # (N, T, 1)
        mse = float(torch.where(lost, self.bound**2, batch["next", "privileged"][..., 0].square()).mean())
        if mse < self.best[0]:
            self.best = mse, deepcopy(self.net.state_dict())
        return {"mse": mse, "lost": float(lost[:, -1].float().mean())}

    def state_dict(self) -> dict[str, Any]:
        """The best net so far, for a checkpoint."""
        return {"mse": self.best[0], "net": self.best[1]}

    def load_state_dict(self, state_dict: dict[str, Any]) -> None:
        """Take it over."""
        self.best = state_dict["mse"], state_dict["net"]


def validation_of(
    simulator: Simulator, windows: Sequence[Recording], net: nn.Sequential, device: torch.device | str = "cpu"
) -> Validation:
    """Replays of windows by a simulator without a net, corrected by one that is being trained.

    Args:
        simulator: What it is trained in.
        windows: Of :func:`set_aside`, of equal length.
        net: On the device.
        device: Of the physics.
    """
    takes = takes_of(windows, simulator.robot)
    steps = min(takes.lengths) - HISTORY
    first = torch.tensor([0, *takes.lengths[:-1]]).cumsum(0) + HISTORY - 1
    env = replay_env(
        simulator.robot,
        takes,
        chain=chain_with(simulator, net, takes),
        unit=torque_unit(net),
        num_envs=len(windows),
        device=device,
        max_steps=steps,
        by_row=True,
        starts=first,
    )
    return Validation(env, net, steps)


def chain_with(simulator: Simulator, net: nn.Module, takes: Takes) -> list[Transform]:
    """What stands between the takes' commands and the joints once the simulator has the net.

    Args:
        simulator: Without a net.
        net: To be trained; :func:`~torchrl_athletic.envs.replay.replay_env` puts the action in its place.
        takes: Whose commands they are.
    """
    corrected = replace(simulator, net=net, kind="correction")
    return corrected.chain(command=takes.driven, decimation=1, randomize=False)


def torque_unit(net: nn.Sequential) -> Tensor:
    """What a :func:`~torchrl_athletic.networks.uan` multiplies its output with [N·m]. Shape (1,) or (J,)."""
    return net[-1].get_buffer("unit").flatten()


def uan_learner(
    env: TransformedEnv,
    net: nn.Sequential,
    config: PPO = UAN,
    *,
    credit: Credit = "arm",
    scale: float = 1.0,
    hidden: Sequence[int] = (256, 256),
    seed: int = 0,
    cuda_graph: bool = False,
    processes: Processes = ALONE,
) -> Learner:
    """PPO of a net in its replay environment.

    The critic is told what no actuator knows: how far simulation and recording are apart. With ``credit="arm"`` it sees
    that and the histories of all joints side by side, 42 numbers each, which takes wider layers than the net's; with
    ``"joint"`` those of its joint, and which one that is, and a joint is a sample.

    Args:
        env: Of :func:`~torchrl_athletic.envs.replay.replay_env`, with ``unit=torque_unit(net)``.
        net: Of :func:`~torchrl_athletic.networks.uan`, trained in place.
        config: Numbers chosen by hand; the paper's by default.
        credit: Whose reward a joint's correction is judged by.
        scale: First standard deviation of exploration, in units of torque.
        hidden: Layers of the critic.
        seed: Of the order of samples.
        cuda_graph: As of :class:`~torchrl_athletic.training.Learner`.
        processes: As of :class:`~torchrl_athletic.training.Learner`.

    Returns:
        For :func:`~torchrl_athletic.training.train`; its ``samples`` count joints with ``credit="joint"``.

    Raises:
        ValueError: If a net that knows its joint shall be credited by joint.

    Source:
        Fey et al. 2025, sections II-A and appendix A. The critic's inputs are ours, the paper states none.
    """
    joints = env.observation_spec["observation"].shape[-2]
    if credit == "joint" and sizes_of(net).joints is not None:
        raise ValueError(
            "credit by joint shows the net one joint at a time, but this one is told which of its joints is which by "
            "their order. Take credit='arm', or the gradient method."
        )
    policy = uan_actor(net[:-1], scale=scale, device=env.device)
    seen = net[0].get_buffer("unit")
    speed = seen[2 * HISTORY - 1 : 2 * HISTORY]
    features = torch.cat((seen, torch.full_like(speed, 0.05), speed / 4))
    if credit == "arm":
        critic = ValueOperator(_ArmValue(features, joints, hidden, env.device), in_keys=["observation", "privileged"])
        learner = Learner(env, policy, critic, config, seed=seed, cuda_graph=cuda_graph, processes=processes)
    else:
        head = policy.module[0].module
        assert isinstance(head, GaussianHead)
        assert isinstance(head.network, PerJoint)
        alone = GaussianHead(head.network.net, 1, scale, env.device)
        alone.log_scale = head.log_scale  # one policy, looked at joint by joint
        critic = ValueOperator(
            _JointValue(features, joints, hidden, env.device), in_keys=["observation", "privileged", "joint"]
        )
        learner = Learner(
            env,
            gaussian_actor(alone, ["observation"]),
            critic,
            config,
            rollout=JointRollout(env, policy, config.horizon),
            seed=seed,
            cuda_graph=cuda_graph,
            processes=processes,
        )
    left = learner.rollout.current["steps_left"]
    left.copy_((left * torch.rand(left.shape, device=left.device)).ceil().clamp(min=1))  # do not all end at once
    return learner


class _ArmValue(nn.Module):
    """(*B, J, 40), (*B, J, 2) -> (*B, 1)."""

    def __init__(self, unit: Tensor, joints: int, hidden: Sequence[int], device: torch.device | None) -> None:
        super().__init__()
        self.units = InUnits(unit, torch.full_like(unit, LINEAR))
        self.mlp = MLP(joints * len(unit), 1, num_cells=list(hidden), activation_class=nn.ELU, device=device)

    def forward(self, observation: Tensor, privileged: Tensor) -> Tensor:
        return self.mlp(self.units(torch.cat((observation, privileged), -1)).flatten(-2))


class _JointValue(nn.Module):
    """(*B, 40), (*B, 2), number of the joint (*B, 1) -> (*B, 1)."""

    numbers: Tensor

    def __init__(self, unit: Tensor, joints: int, hidden: Sequence[int], device: torch.device | None) -> None:
        super().__init__()
        self.units = InUnits(unit, torch.full_like(unit, LINEAR))
        self.register_buffer("numbers", torch.arange(joints, device=device), persistent=False)
        self.mlp = MLP(len(unit) + joints, 1, num_cells=list(hidden), activation_class=nn.ELU, device=device)

    def forward(self, observation: Tensor, privileged: Tensor, joint: Tensor) -> Tensor:
        which = torch.eq(joint, self.numbers).to(observation.dtype)
        return self.mlp(torch.cat((self.units(torch.cat((observation, privileged), -1)), which), -1))


class JointRollout(CapturedRollout):
    """A rollout whose rows are joints: what each saw, did and earned. Shape (N * J, T).

    Args:
        env: Of :func:`~torchrl_athletic.envs.replay.replay_env`.
        policy: Of :func:`~torchrl_athletic.networks.uan_actor`.
        horizon: Steps T per call.
    """

    def __init__(self, env: EnvBase, policy: nn.Module, horizon: int) -> None:
        super().__init__(env, policy, horizon, keys=["observation", "privileged", "joint_reward"], fuse=False)
        self._rows: TensorDict | None = None

    @torch.no_grad()
    def __call__(self) -> TensorDict:
        """Collect. Shape (N * J, T), whose second dimension is called time."""
        rows = joint_rows(super().__call__())
        if self._rows is None:  # where a captured update goes on reading
            self._rows = rows.clone()
        return self._rows.update_(rows)


def joint_rows(batch: TensorDictBase) -> TensorDict:
    """A batch (N, T) of arms as one of joints, (N * J, T): with rewards and log-probabilities of their own."""
    arms, steps, joints = batch["action"].shape

    def each(value: Tensor) -> Tensor:
        """(N, T, J, ...) to (N * J, T, ...), with a last dimension."""
        rows = value.transpose(1, 2).flatten(0, 1)
        return rows if rows.ndim > 2 else rows.unsqueeze(-1)

    def shared(flag: Tensor) -> Tensor:
        return flag.unsqueeze(1).expand(arms, joints, steps, 1).flatten(0, 1)

    after = batch["next"]
    number = torch.arange(joints, device=batch.device).repeat(arms)[:, None, None].expand(-1, steps, 1)
    loc, scale, action = (each(batch[key]) for key in ("loc", "scale", "action"))
    log_prob = torch.distributions.Normal(loc, scale, validate_args=False).log_prob(action).squeeze(-1)
    shown = {
        "observation": each(batch["observation"]),
        "privileged": each(batch["privileged"]),
        "joint": number,
        "loc": loc,
        "scale": scale,
        "action": action,
        "action_log_prob": log_prob,
        "next": {
            "observation": each(after["observation"]),
            "privileged": each(after["privileged"]),
            "joint": number,
            "reward": each(after["joint_reward"]),
            **{key: shared(after[key]) for key in ("done", "terminated", "truncated")},
        },
    }
    return TensorDict(shown, [arms * joints, steps], device=batch.device, names=[None, "time"])


def with_gains_of(robot: Robot, recordings: Sequence[Recording]) -> Robot:
    """The robot with the gains that the takes were recorded with, its own where they state none.

    Raises:
        RecordingError: If a recording names a joint that the robot lacks.
    """
    kp, kd = list(robot.kp), list(robot.kd)
    for r in recordings:
        check_joints(r, robot)
        if r.kp is None or r.kd is None:
            continue
        for name, p, d in zip(r.joint_names, r.kp.tolist(), r.kd.tolist(), strict=True):
            kp[robot.joint_names.index(name)], kd[robot.joint_names.index(name)] = p, d
    return replace(robot, kp=tuple(kp), kd=tuple(kd))
