"""Training a UAN without reinforcement learning: down the gradient of the position error, through the simulator.

A step of the physics is a function of positions, velocities and torques. Its derivative, by finite differences, makes a
replay differentiable over windows of some dozen steps, so that the error of a position tells each torque before it
which way it was wrong.
"""

from __future__ import annotations

import math
from copy import deepcopy
from dataclasses import replace
from typing import Any

import torch
from tensordict import TensorDict, TensorDictBase
from torch import Tensor, nn
from torchrl.envs import TransformedEnv

from torchrl_athletic.envs import Takes, TorqueEnv, make_physics
from torchrl_athletic.functional import actuation
from torchrl_athletic.physics.joints import joint_columns
from torchrl_athletic.robots import Robot
from torchrl_athletic.training.checkpoint import env_state, restore_env
from torchrl_athletic.training.rollout import control_step
from torchrl_athletic.training.uan import MeanPolicy

WINDOWS = (32, 48)
"""Steps that the gradient goes back, in the first and the second half of the time. Over more it can explode."""
NUDGE = 1e-3
"""Nudge of a position [rad] and a velocity [rad/s]; a torque is nudged as many N·m as its limit times this."""

EXPLODED = 20.0
"""How many times as long as usual a gradient may be before the net is taken back."""
STEADY = 25
"""Windows between the states that it is taken back to."""
EVERY = 8
"""Samples of a recording from one known Jacobian to the next: 40 ms."""


class _StepOfPhysics(torch.autograd.Function):
    """What the simulation came to, with the derivative that was measured."""

    @staticmethod
    def forward(ctx: Any, state: Tensor, following: Tensor, jacobian: Tensor) -> Tensor:
        """Shapes (N, 3D), (N, 2D), (N, 3D, 2D) to (N, 2D)."""
        ctx.save_for_backward(jacobian)
        return following

    @staticmethod
    def backward(ctx: Any, *gradients: Tensor) -> tuple[Tensor, None, None]:
        (jacobian,) = ctx.saved_tensors
        return torch.einsum("nij,nj->ni", jacobian, gradients[0]), None, None


class DifferentiableTorqueEnv(TorqueEnv):
    """A :class:`~torchrl_athletic.envs.TorqueEnv` of joints alone whose steps have a gradient.

    Beside each row run 3 D nudged copies of it, D being the joints that are told apart: one for each position, velocity
    and torque. What they come to tells the Jacobian of the step. Where it is to be replayed what is known beforehand,
    Jacobians can be measured once, along the recording: with 19 times fewer simulations a step, for gradients that are
    those of a simulation which stays near it.

    Args:
        robot: Bolted to the world, with nothing that moves but its joints.
        joints: Numbers of the joints that gradients pass through; None for all.
        num_envs: N.
        device: CPU threads or a GPU.
        along: What will be replayed, by steps that hold ``sample``; None measures at each step, where it is.

    Raises:
        ValueError: If the model has more degrees of freedom than joints.

    Example:
        >>> from torchrl_athletic.robots import z1
        >>> env = DifferentiableTorqueEnv(z1(), num_envs=2)
        >>> torque = torch.zeros(2, 7, requires_grad=True)
        >>> speed = env._step(env.reset().set("torque", torque))["joint_velocity"]
        >>> slope = torch.autograd.grad(speed[:, 0].sum(), torque)[0]
        >>> bool((slope[:, 0] > 0).all())
        True
    """

    def __init__(
        self,
        robot: Robot,
        *,
        joints: tuple[int, ...] | None = None,
        num_envs: int = 1,
        device: torch.device | str = "cpu",
        along: Takes | None = None,
    ) -> None:
        robot = replace(robot, sensors={})
        super().__init__(robot, num_envs=num_envs, device=device)
        count = len(robot.joint_names)
        if self.physics.model.nv != count:
            raise ValueError(
                f"{robot.name!r} has {self.physics.model.nv} degrees of freedom and {count} joints: the state of the "
                "rest would have no gradient. Bolt it to the world, and leave tools out."
            )
        chosen = tuple(range(count)) if joints is None else joints
        self.told_apart = len(chosen)
        self.columns = torch.tensor(chosen, device=self.device)
        self.copies = make_physics(robot, num_envs * 3 * len(chosen), device)
        place, dof = joint_columns(self.physics.model, robot.joint_names)
        size = NUDGE * torch.tensor(robot.torque_limit).clamp(max=100.0)
        nudges = torch.zeros(3, len(chosen), 3, count, dtype=self.physics.dtype)  # of what, which, then the values
        for k, joint in enumerate(chosen):
            nudges[0, k, 0, joint] = nudges[1, k, 1, joint] = NUDGE
            nudges[2, k, 2, joint] = size[joint]
        self.nudges = nudges.flatten(0, 1).to(self.device)  # (3D, 3, J)
        self.steps = nudges.sum((-1, -2)).flatten().to(self.device)  # (3D,)
        self._place = place.to(self.device) if isinstance(place, Tensor) else place
        self._dof = dof.to(self.device) if isinstance(dof, Tensor) else dof
        self.known: tuple[Tensor, Tensor] | None = None if along is None else self._measure(along)

    def _step(self, tensordict: TensorDictBase) -> TensorDictBase:
        torque = tensordict.get("torque")
        if not torch.is_grad_enabled():
            return super()._step(tensordict)
        if self.known is None:
            self._nudge_copies(torque.detach())
        shown = super()._step(tensordict)
        if self.known is None:
            jacobian = self._jacobian()
        else:
            jacobians, of_sample = self.known
            jacobian = jacobians[of_sample[tensordict.get("sample").squeeze(-1)]]
        seen = torch.cat([tensordict.get("joint_position"), tensordict.get("joint_velocity"), torque], -1)
        state = seen.unflatten(-1, (3, -1))[..., self.columns].flatten(-2)
        after = torch.cat((shown.get("joint_position"), shown.get("joint_velocity")), -1)
        told = after.unflatten(-1, (2, -1))[..., self.columns].flatten(-2)
        told = _StepOfPhysics.apply(state, told, jacobian)
        whole = after.unflatten(-1, (2, -1)).clone()
        whole[..., self.columns] = told.unflatten(-1, (2, -1))
        return shown.set("joint_position", whole[:, 0]).set("joint_velocity", whole[:, 1])

    def _measure(self, takes: Takes) -> tuple[Tensor, Tensor]:
        """Jacobians at every so many samples of each take, under the torques that were commanded.

        Returns:
            Shape (S', 3D, 2D), and which of them is the last one before each sample in its take, (S,).
        """
        kp, kd = torch.tensor(self.robot.kp), torch.tensor(self.robot.kd)
        in_take = torch.cat([torch.arange(length) for length in takes.lengths])
        measured, found = in_take % EVERY == 0, []
        for part in torch.nonzero(measured).squeeze(-1).split(self.physics.num_envs):
            rows = torch.cat((part, part[-1:].expand(self.physics.num_envs - len(part))))
            position, velocity, command = (v[rows] for v in (takes.position, takes.velocity, takes.command))
            torque = command if takes.driven == "torque" else actuation.pd_torque(command, position, velocity, kp, kd)
            self.physics.qpos[:, self._place] = position.to(self.physics.qpos)
            self.physics.qvel[:, self._dof] = velocity.to(self.physics.qvel)
            self._nudge_copies(torque.to(self.device))
            self.physics.apply_torque(torque.to(self.device))
            self.physics.step()
            found.append(self._jacobian()[: len(part)])
        return torch.cat(found), (measured.cumsum(0) - 1).to(self.device)

    def _nudge_copies(self, torque: Tensor) -> None:
        rows = len(self.nudges)
        position = self.physics.joint_position.unsqueeze(1) + self.nudges[:, 0]
        velocity = self.physics.joint_velocity.unsqueeze(1) + self.nudges[:, 1]
        self.copies.qpos.copy_(self.physics.qpos.repeat_interleave(rows, 0))
        self.copies.qpos[:, self._place] = position.flatten(0, 1)
        self.copies.qvel[:, self._dof] = velocity.flatten(0, 1)
        warm = self.physics.data("qacc_warmstart")  # the solver begins alike, so that differences are the nudge's
        self.copies.data("qacc_warmstart").copy_(warm.repeat_interleave(rows, 0))
        self.copies.apply_torque((torque.to(self.nudges.dtype).unsqueeze(1) + self.nudges[:, 2]).flatten(0, 1))
        self.copies.step()

    def _jacobian(self) -> Tensor:
        """Jacobian of positions and velocities by positions, velocities and torques before. Shape (N, 3D, 2D)."""
        after = torch.cat((self.copies.joint_position, self.copies.joint_velocity), -1)
        plain = torch.cat((self.physics.joint_position, self.physics.joint_velocity), -1)
        moved = (after.unflatten(0, (-1, len(self.nudges))) - plain.unsqueeze(1)) / self.steps[:, None]
        moved = moved.unflatten(-1, (2, -1))[..., self.columns].flatten(-2)
        return torch.nan_to_num(moved, 0.0, 0.0, 0.0).float()


class GradientLearner:
    """What gradient descent changes; :func:`descend` works on it, and :func:`~torchrl_athletic.training.train`.

    Rows go on from window to window through episodes as those of PPO, from measured start states, while the gradient is
    cut at each window's start. So the net learns at the states that its own replays come to.

    Args:
        env: :func:`~torchrl_athletic.envs.replay.replay_env` on a :class:`DifferentiableTorqueEnv`, with
            ``unit=torque_unit(net)``.
        net: Of :func:`~torchrl_athletic.networks.uan`, trained in place.
        minutes: That training will take, by which windows grow and the learning rate falls to zero [min].
        iterations: That it will take instead, for runs that shall not depend on how busy the machine is.
        rate: First learning rate of Adam.
        windows: Steps that the gradient goes back, one after the other.
        max_grad_norm: Longest gradient, of the error in squared hundredths of a radian.
        outlier: Errors that are far beyond it count by their logarithm (Cauchy's loss) [rad]. Without a controller's
            loop, near an upright pendulum say, a few rows leave whatever the net does, and would rule the gradient.
    """

    def __init__(
        self,
        env: TransformedEnv,
        net: nn.Sequential,
        *,
        minutes: float,
        iterations: int | None = None,
        rate: float = 1e-3,
        windows: tuple[int, ...] = WINDOWS,
        max_grad_norm: float = 1.0,
        outlier: float | None = None,
    ) -> None:
        if not minutes > 0:
            raise ValueError(
                f"minutes is {minutes}: windows and learning rate follow the share of it. Give more than 0."
            )
        self.iterations = iterations
        self.env, self.net, self.minutes, self.rate, self.windows = env, net, minutes, rate, windows
        self.max_grad_norm, self.outlier = max_grad_norm, outlier
        self.policy = MeanPolicy(net)
        self.optimizer = torch.optim.Adam(net.parameters(), lr=rate)
        self.current = env.reset()
        left = self.current["steps_left"]
        left.copy_((left * torch.rand(left.shape, device=left.device)).ceil().clamp(min=1))
        self.iteration, self.samples, self.seconds = 0, 0, 0.0
        self.usual = 0.0
        """Length of gradients of late, before clipping."""
        self.caution = 1.0
        """What the learning rate is multiplied with; halved whenever a gradient explodes."""
        self.kept = (deepcopy(net.state_dict()),) * 2
        """States of the net some windows ago, the older one first."""

    def step_back(self) -> None:
        """Go on from the older of the states that were kept, with new episodes and at half the rate.

        A net with too high a gain makes the simulation chatter, where gradients explode and show no way back.
        """
        self.net.load_state_dict(self.kept[0])
        self.kept = (self.kept[0],) * 2
        self.optimizer = torch.optim.Adam(self.net.parameters(), lr=self.rate)
        self.current, self.caution = self.env.reset(), self.caution / 2

    @property
    def share(self) -> float:
        """Share of the training that has gone."""
        gone = self.seconds / (60 * self.minutes) if self.iterations is None else self.iteration / self.iterations
        return min(1.0, gone)

    @property
    def window(self) -> int:
        """Steps that the gradient goes back now."""
        return self.windows[min(int(self.share * len(self.windows)), len(self.windows) - 1)]

    def state_dict(self) -> dict[str, Any]:
        """What it takes to go on."""
        return {
            "net": self.net.state_dict(),
            "kept": list(self.kept),
            "optimizer": self.optimizer.state_dict(),
            "current": self.current.clone().to_dict(),
            "env": env_state(self.env),
            "counters": {name: getattr(self, name) for name in ("iteration", "samples", "seconds", "caution", "usual")},
        }

    def load_state_dict(self, state_dict: dict[str, Any]) -> None:
        """Go on where :meth:`state_dict` was taken."""
        self.net.load_state_dict(state_dict["net"])
        older, newer = (deepcopy(state) for state in state_dict["kept"])
        self.kept = older, newer
        self.optimizer.load_state_dict(state_dict["optimizer"])
        current = TensorDict(state_dict["current"], device=self.env.device).auto_batch_size_(self.env.ndim)
        self.current = restore_env(self.env, current, state_dict["env"])
        for name, count in state_dict["counters"].items():
            setattr(self, name, count)


def descend(learner: GradientLearner) -> TensorDict:
    """Replay one window, and move the net against the gradient of its mean square position error.

    Args:
        learner: Changed in place.

    Returns:
        ``train_mse`` [rad²], in which a row that is lost on the way counts with the square of the bound from there to
        the window's end; ``lost``, the share of such rows; ``grad_norm`` before clipping, ``rate``, ``window`` [steps],
        and the mean ``reward``. Shape ().
    """
    window = learner.window
    rate = learner.caution * learner.rate * 0.5 * (1 + math.cos(math.pi * learner.share))
    following, errors, ended, rewards = learner.current, [], [], []
    for _ in range(window):
        step, following = control_step(learner.env, learner.policy, following)
        errors.append(step["next", "privileged"][..., 0].square())
        ended.append(step["next", "terminated"])
        rewards.append(step["next", "reward"].detach().mean())
    learner.current, error = following.detach(), torch.stack(errors)
    lost = torch.stack(ended).cummax(0).values  # (T, N, 1)
    charged = torch.where(lost, learner.env.transform[-1].bound ** 2, error.detach()).mean()
    learner.optimizer.zero_grad()
    if learner.outlier is not None:
        error = learner.outlier**2 * torch.log1p(error / learner.outlier**2)
    (1e4 * error.mean()).backward()
    norm = nn.utils.clip_grad_norm_(learner.net.parameters(), learner.max_grad_norm)
    length = float(norm)
    if length < EXPLODED * (learner.usual or length):
        learner.usual = 0.95 * (learner.usual or length) + 0.05 * length
        for group in learner.optimizer.param_groups:
            group["lr"] = rate
        learner.optimizer.step()
        if learner.iteration % STEADY == 0:
            learner.kept = learner.kept[1], deepcopy(learner.net.state_dict())
    else:
        learner.step_back()
    learner.iteration += 1
    learner.samples += window * learner.env.numel()
    numbers = {"rate": rate, "window": float(window)}
    report = {name: torch.full_like(norm, value) for name, value in numbers.items()}
    report |= {"lost": lost[-1].to(norm.dtype).mean(), "reward": torch.stack(rewards).mean()}
    return TensorDict({"train_mse": charged, "grad_norm": norm, **report})
