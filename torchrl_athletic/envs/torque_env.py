"""A robot that takes torques: one step of the environment is one step of the physics."""

from __future__ import annotations

from collections.abc import Callable, Collection, Sequence

import mujoco
import torch
from tensordict import NestedKey, TensorDict, TensorDictBase
from torch import Tensor
from torchrl.data import Binary, Bounded, Composite, Unbounded
from torchrl.envs import EnvBase

from torchrl_athletic.functional import rotations
from torchrl_athletic.physics import BatchPhysics, Physics
from torchrl_athletic.physics.data_fields import late_columns
from torchrl_athletic.physics.ground import Clearance, ground_of
from torchrl_athletic.robots import Robot

_BASE = {"base_position", "base_quaternion", "base_linear_velocity", "base_angular_velocity", "projected_gravity"}
"""What is shown of a floating base; sensors of these names go before what is computed."""


class TorqueEnv(EnvBase):
    """N copies of a robot, driven by joint torques at the physics rate.

    There is no task in it: the reward is 0, and an episode ends only where the simulation diverged or ``terminate``
    says so. Actuators, observations and rewards are transforms around it.

    Entries, float32 in SI units, J joints in the robot's order:

    - ``torque`` (N, J), the action, unlimited: :class:`~torchrl_athletic.transforms.TorqueSpeedClip` limits it;
    - ``joint_position``, ``joint_velocity``, ``applied_torque``, ``joint_power``, torque times velocity [W] (N, J);
    - with a floating base, ``base_position``, ``base_quaternion`` (wxyz), in the world; ``base_linear_velocity``,
      ``base_angular_velocity``, ``projected_gravity``, in the base's axes; where the robot has ground, ``base_height``
      over it, its bumps rounded off over ``footprint`` (N, 1);
    - the robot's ``sensors``: ``end_effector_position`` and so on, ``foot_force``; with ``foot_position``, also
      ``foot_height`` over the ground below each foot (N, F).

    Observations describe the state after the step; forces are those that acted during it. ``next`` holds the true last
    observation of an episode. A step whose tensordict holds ``_substep`` shows joints and ``every_step`` only, and
    ``_step`` is a mask of the rows that it advances (:class:`~torchrl_athletic.transforms.Decimation` uses both, and
    takes the mean of ``averaged_keys`` over the steps of an action).

    A reset puts the robot at its keyframe, or at ``reset_qpos`` (N, nq) and ``reset_qvel`` (N, nv) where the tensordict
    given to this environment's reset holds them, as transforms do that choose where an episode starts. A floating robot
    that would start in the ground is lifted until nothing is.

    Args:
        robot: What to simulate.
        physics: Simulations of its model. None makes them: threads on the CPU, a GPU's on CUDA.
        num_envs: N, where ``physics`` is None.
        device: Where ``physics`` is None.
        seed: Accepted for TorchRL's sake; nothing here is random.
        terminate: From what a step shows to whether the episode has failed, bool of shape (N, 1).
        fields: Of the model, to differ between environments, where ``physics`` is None.
        every_step: Of the robot's ``sensors``, those to show at every physics step, for transforms within
            :class:`~torchrl_athletic.transforms.Decimation`. Refreshing them takes time, but for those of touch and
            acceleration, which each step computes.
        substeps: Physics steps that each torque is held for, so that drives act as often in a finer simulation.
        footprint: Edge of the square around the base whose mean height is the ground below it [m].

    Raises:
        ValueError: If the physics drives other joints than the robot's, or the robot lacks one of the sensors.

    Example:
        >>> from torchrl_athletic.robots import z1
        >>> env = TorqueEnv(z1(), num_envs=3)
        >>> env.rollout(5)["joint_position"].shape
        torch.Size([3, 5, 7])
    """

    def __init__(
        self,
        robot: Robot,
        physics: Physics | None = None,
        *,
        num_envs: int = 1,
        device: torch.device | str = "cpu",
        seed: int = 0,
        terminate: Callable[[TensorDictBase], Tensor] | None = None,
        fields: Sequence[str] = (),
        every_step: Sequence[str] = (),
        substeps: int = 1,
        footprint: float = 0.5,
    ) -> None:
        if missing := [name for name in every_step if name not in robot.sensors]:
            raise ValueError(
                f"every_step names {missing}, but {robot.name} has the sensors {sorted(robot.sensors)}. Name some of "
                "these; joints are shown in any case."
            )
        if physics is None:
            physics = make_physics(robot, num_envs, device, fields)
        if physics.joint_names != robot.joint_names:
            raise ValueError(
                f"the physics drives {physics.joint_names}, the robot has {robot.joint_names}: torques would reach the "
                "wrong joints. Give the physics joint_names=robot.joint_names."
            )
        super().__init__(device=physics.device, batch_size=[physics.num_envs])
        self.robot, self.physics, self.terminate, self.every_step = robot, physics, terminate, tuple(every_step)
        self.substeps = substeps
        model = physics.model
        self._base_qpos, self._base_dof = _free_joint(model, robot.base)
        self._sensors = {key: _columns(model, names, physics.device) for key, names in robot.sensors.items()}
        self._keyframe = model.key(robot.keyframe).id
        late = set(late_columns(model).tolist())
        self._late = {key: set(_numbers(columns)) <= late for key, (columns, _) in self._sensors.items()}
        self.averaged_keys = ("joint_power", *(key for key in self.every_step if self._late[key]))
        self.wrenches: dict[NestedKey, Tensor] = {}
        """What :meth:`set_wrench` added to ``xfrc_applied``, by its name. Shape (N, bodies, 6) each."""
        if self.on_ground:
            self.ground = ground_of(model, robot.ground, physics.device)
            self._ground_around = self.ground.averaged(footprint)
            self.clearance = Clearance.of(model, robot.ground, physics.device)
        self._make_specs()
        self.set_seed(seed)

    @property
    def supports_partial_step(self) -> bool:
        """Whether to be told of rows that are done: on a GPU a mask costs more than stepping them in vain."""
        return self.physics.device.type == "cpu"

    @property
    def joint_groups(self) -> dict[str, tuple[int, ...]]:
        """Numbers of the joints by the name of their group."""
        return dict(self.robot.joint_groups)

    def _make_specs(self) -> None:
        n, device = self.physics.num_envs, self.device
        limit = torch.tensor(self.robot.torque_limit, dtype=torch.float32, device=device).expand(n, -1)
        self.action_spec = Composite(
            torque=Bounded(-limit, limit, dtype=torch.float32, device=device), shape=[n], device=device
        )
        self.physics.forward()
        shown = self._observe(torch.zeros_like(limit))
        self.observation_spec = Composite(
            {key: Unbounded(shape=value.shape, dtype=value.dtype, device=device) for key, value in shown.items()},
            shape=[n],
            device=device,
        )
        self.reward_spec = Unbounded(shape=(n, 1), device=device)
        flag = Binary(shape=(n, 1), dtype=torch.bool, device=device)
        self.done_spec = Composite(done=flag, terminated=flag.clone(), truncated=flag.clone(), shape=[n], device=device)

    def _reset(self, tensordict: TensorDictBase | None = None, **kwargs: object) -> TensorDictBase:
        starts = qpos = qvel = None
        if tensordict is not None:
            starts = tensordict.get("_reset", None)
            starts = None if starts is None else starts.reshape(self.batch_size)
            qpos, qvel = tensordict.get("reset_qpos", None), tensordict.get("reset_qvel", None)
        self.physics.reset(starts, self._keyframe, qpos, qvel)
        for wrench in self.wrenches.values():  # the physics' reset took them away
            if starts is None:
                wrench.zero_()
            else:
                wrench.masked_fill_(starts.view(-1, 1, 1), 0.0)
        if self.on_ground:
            self._lift(starts)
        flag = torch.zeros(*self.batch_size, 1, dtype=torch.bool, device=self.device)
        shown = self._observe(torch.zeros_like(self._copied(self.physics.joint_position)))
        return self._tensordict(shown, done=flag, terminated=flag.clone(), truncated=flag.clone())

    @property
    def on_ground(self) -> bool:
        """Whether the robot floats over ground whose height is known."""
        return self._base_qpos is not None and bool(self.robot.ground)

    def set_wrench(self, name: NestedKey, bodies: Tensor, wrench: Tensor) -> None:
        """Push and twist bodies from now on, in place of what was set under this name before.

        It is added to what else acts on them. A reset ends it.

        Args:
            name: Of whoever pushes.
            bodies: Their numbers in the model, always the same for a name. int64, shape (B,).
            wrench: Force [N] and torque [N·m] in world axes. Shape (N, B, 6).
        """
        acting = self.wrenches.setdefault(name, torch.zeros_like(wrench))
        applied = self.physics.xfrc_applied
        applied.index_add_(1, bodies, (wrench - acting).to(applied.dtype))  # a body may be named twice
        acting.copy_(wrench)

    def _lift(self, starts: Tensor | None) -> None:
        """Raise the robots that start with something in the ground."""
        depth = (-self.clearance(self.physics.data("xpos"), self.physics.data("xmat"))).clamp(min=0)
        self.physics.raise_up(depth if starts is None else torch.where(starts.unsqueeze(-1), depth, 0.0))

    def _step(self, tensordict: TensorDictBase) -> TensorDictBase:
        torque = tensordict.get("torque")
        only_joints = "_substep" in tensordict.keys()
        self.physics.apply_torque(torque)
        refresh = any(not self._late[key] for key in (self.every_step if only_joints else self._sensors))
        self.physics.step(self.substeps, refresh=refresh, envs=tensordict.get("_step", None))
        failed = self.physics.diverged.unsqueeze(-1)
        flags = {"done": failed, "terminated": failed.clone(), "truncated": torch.zeros_like(failed)}
        reward = torch.zeros(*self.batch_size, 1, device=self.device)
        observed = self._show_joints(torque) | self._read(self.every_step) if only_joints else self._observe(torque)
        shown = self._tensordict(observed, reward=reward, **flags)
        if self.terminate is not None and not only_joints:
            ended = self.terminate(shown)
            if ended.shape != failed.shape:
                raise ValueError(
                    f"terminate gives shape {tuple(ended.shape)}, needed is {tuple(failed.shape)}: one robot's failure "
                    "would end others. Give one flag a robot and a last dimension of 1."
                )
            failed = failed | ended
            shown.set("done", failed).set("terminated", failed.clone())
        return shown

    def _set_seed(self, seed: int | None) -> None:
        """Nothing here is random."""

    def _show_joints(self, torque: Tensor) -> dict[str, Tensor]:
        velocity = self._copied(self.physics.joint_velocity)
        return {
            "joint_position": self._copied(self.physics.joint_position),
            "joint_velocity": velocity,
            "joint_power": torque.float() * velocity,
        }

    def _observe(self, torque: Tensor) -> dict[str, Tensor]:
        shown = self._show_joints(torque) | {"applied_torque": torque.float()}
        if self._base_qpos is not None and not self._sensors.keys() >= _BASE:
            shown |= self._show_base()
        shown |= self._read(self._sensors)
        if self.on_ground:
            shown |= self.heights(shown["base_position"], shown.get("foot_position"))
        return shown

    def heights(self, base: Tensor, feet: Tensor | None) -> dict[str, Tensor]:
        """Over the ground: ``base_height`` and, of a robot with feet, ``foot_height``.

        Args:
            base: Its position in the world [m]. Shape (N, 3).
            feet: Theirs [m]. Shape (N, F, 3).
        """
        heights = {"base_height": base[:, 2:] - self._ground_around.height(base[:, :2])}
        if feet is not None:
            heights["foot_height"] = feet[..., 2] - self.ground.height(feet[..., :2]).squeeze(-1)
        return heights

    def _read(self, keys: Collection[str]) -> dict[str, Tensor]:
        """Sensors as the physics last refreshed them."""
        shown: dict[str, Tensor] = {}
        if not keys:
            return shown
        readings = self._copied(self.physics.data("sensordata"))
        for key in keys:
            columns, shape = self._sensors[key]
            taken = readings[:, columns] if isinstance(columns, slice) else readings.index_select(1, columns)
            shown[key] = taken.unflatten(-1, shape)
        return shown

    def _show_base(self) -> dict[str, Tensor]:
        """MuJoCo's free joint: position and attitude in the world, linear velocity there too, angular in the body."""
        pose = self._copied(self.physics.qpos[:, self._base_qpos])
        velocity = self._copied(self.physics.qvel[:, self._base_dof])
        attitude = pose[:, 3:]
        shown = {
            "base_position": pose[:, :3],
            "base_quaternion": attitude,
            "base_linear_velocity": rotations.rotate_inverse(attitude, velocity[:, :3]),
            "base_angular_velocity": velocity[:, 3:],
        }
        if "projected_gravity" not in self._sensors:
            shown["projected_gravity"] = rotations.projected_gravity(attitude)
        return shown

    @staticmethod
    def _copied(live: Tensor) -> Tensor:
        """A copy, since the physics writes its tensors anew."""
        return live.to(torch.float32, copy=True)

    def _tensordict(self, shown: dict[str, Tensor], **others: Tensor) -> TensorDict:
        return TensorDict({**shown, **others}, batch_size=self.batch_size, device=self.device)


def make_physics(robot: Robot, num_envs: int, device: torch.device | str, fields: Sequence[str] = ()) -> Physics:
    """Simulations of a robot: on the threads of the CPU, or on a GPU."""
    device = torch.device(device)
    if device.type == "cpu":
        return BatchPhysics(robot.model(), num_envs, fields=fields, joint_names=robot.joint_names)
    from torchrl_athletic.physics import WarpPhysics

    return WarpPhysics(robot.model(), num_envs, device=device, fields=fields, joint_names=robot.joint_names)


def _free_joint(model: mujoco.MjModel, base: str | None) -> tuple[slice | None, slice | None]:
    """Columns of the base's pose in ``qpos`` and of its velocity in ``qvel``."""
    if base is None:
        return None, None
    joint = int(model.body(base).jntadr[0])
    if joint < 0 or model.jnt_type[joint] != mujoco.mjtJoint.mjJNT_FREE:
        raise ValueError(f"body {base!r} has no free joint, so it is no floating base. Set the robot's base to None.")
    position, dof = int(model.jnt_qposadr[joint]), int(model.jnt_dofadr[joint])
    return slice(position, position + 7), slice(dof, dof + 6)


def _numbers(columns: slice | Tensor) -> list[int]:
    return list(range(columns.start, columns.stop)) if isinstance(columns, slice) else columns.tolist()


def _columns(
    model: mujoco.MjModel, names: Sequence[str], device: torch.device
) -> tuple[slice | Tensor, tuple[int, ...]]:
    """Where the sensors' readings are, and the shape they take: (S,) for scalars, (D,) for one, (S, D) for several."""
    columns: list[int] = []
    for name in names:
        sensor = model.sensor(name)
        columns += range(int(sensor.adr[0]), int(sensor.adr[0] + sensor.dim[0]))
    width = len(columns) // len(names)
    shape = (len(columns),) if width == 1 or len(names) == 1 else (len(names), width)
    one_block = columns == list(range(columns[0], columns[-1] + 1))
    return slice(columns[0], columns[-1] + 1) if one_block else torch.tensor(columns, device=device), shape
