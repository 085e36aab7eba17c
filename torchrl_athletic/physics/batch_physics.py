"""Many simulations of one model on the threads of a CPU, bit-identical to a loop of ``mj_step``."""

from __future__ import annotations

import os
import warnings
from collections.abc import Callable, Mapping, Sequence

import mujoco
import numpy as np
import torch
from mujoco.batch import Batch, SimulationError
from numpy.typing import NDArray
from torch import Tensor

from torchrl_athletic.physics.data_fields import check_computed
from torchrl_athletic.physics.joints import driven_joints, floating_heights, joint_columns
from torchrl_athletic.physics.model_fields import has_constants, refuse_ignored_limits
from torchrl_athletic.physics.protocol import CapacityError, Envs, Physics, Result, Values
from torchrl_athletic.physics.rows import check_shape, env_ids, expand_to

__all__ = ["BatchPhysics", "SimulationError"]

_NONE, _VEL = mujoco.mjtStage.mjSTAGE_NONE.value, mujoco.mjtStage.mjSTAGE_VEL.value
_INPUTS = {
    "ctrl": mujoco.mjtState.mjSTATE_CTRL,
    "torque": mujoco.mjtState.mjSTATE_QFRC_APPLIED,
    "qfrc_applied": mujoco.mjtState.mjSTATE_QFRC_APPLIED,
    "xfrc_applied": mujoco.mjtState.mjSTATE_XFRC_APPLIED,
}
_FULL = [mujoco.mjtWarning.mjWARN_CONTACTFULL.value, mujoco.mjtWarning.mjWARN_CNSTRFULL.value]


def _processors() -> int:
    """Those that the process may run on: threads beyond them wait for each other."""
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1


class BatchPhysics(Physics):
    """N simulations on CPU threads, through :class:`mujoco.batch.Batch`.

    The tensors of the state are views of the batch's rows, and so is what ``.numpy()`` makes of them.

    Args:
        model: What to simulate. Copied.
        num_envs: N.
        num_threads: Including the caller's. None takes every CPU that the process may use. The numbers do not depend
            on it.
        fields: Names of ``mjModel`` fields, or ``"opt.gravity"`` and the like, that get values per env.
        joint_names: Joints for :meth:`apply_torque`. None takes the actuators' joints in their order or, in a model
            without actuators on joints, every hinge and slide.

    Raises:
        ValueError: If a field cannot differ between envs, or a joint is unknown or has several degrees of freedom.
        SimulationError: From every call that runs MuJoCo, if MuJoCo raised. Its ``ids`` are the envs concerned: they
            keep the state they had, the others have advanced.

    Example:
        >>> xml = "<mujoco><worldbody><body><joint name='hinge'/><geom size='.1'/></body></worldbody></mujoco>"
        >>> physics = BatchPhysics(mujoco.MjModel.from_xml_string(xml), num_envs=3, fields=["dof_damping"])
        >>> physics.set_field("dof_damping", [[0.0], [1.0], [2.0]])
        >>> physics.apply_torque(torch.full((3, 1), 5.0))
        >>> physics.step(nstep=10)
        >>> bool((physics.qvel.diff(dim=0) < 0).all())  # the more damping, the slower
        True
    """

    device = torch.device("cpu")
    dtype = torch.float64

    def __init__(
        self,
        model: mujoco.MjModel,
        num_envs: int,
        num_threads: int | None = None,
        fields: Sequence[str] = (),
        joint_names: Sequence[str] | None = None,
    ) -> None:
        self.model, self.num_envs, self.fields = model, num_envs, tuple(fields)
        self.batch = Batch(model, num_envs, num_threads or _processors())
        self._fields = {name: torch.from_numpy(self.batch.expand(name)) for name in self.fields}
        self._forces = self.batch.bind("qfrc_applied")
        self._data: dict[str, Tensor] = {}
        self._derived = False  # whether any output is copied out, so that there is a use in forward()
        self.joint_names = driven_joints(model) if joint_names is None else tuple(joint_names)
        self._joint_qpos, self._joint_dof = joint_columns(model, self.joint_names)
        self._floating = floating_heights(model)

    @property
    def timestep(self) -> float:
        return float(self.model.opt.timestep)

    @property
    def time(self) -> Tensor:
        return self.data("time")

    @property
    def qpos(self) -> Tensor:
        return self.data("qpos")

    @property
    def qvel(self) -> Tensor:
        return self.data("qvel")

    @property
    def ctrl(self) -> Tensor:
        return self.data("ctrl")

    @property
    def qfrc_applied(self) -> Tensor:
        return self.data("qfrc_applied")

    @property
    def xfrc_applied(self) -> Tensor:
        return self.data("xfrc_applied")

    @property
    def joint_position(self) -> Tensor:
        return self.qpos[:, self._joint_qpos]

    @property
    def joint_velocity(self) -> Tensor:
        return self.qvel[:, self._joint_dof]

    @property
    def diverged(self) -> Tensor:
        warned = self.batch.warning[..., 1].any(1)  # last axis: lastinfo, number
        healthy = np.isfinite(self.qpos.numpy()).all(1) & np.isfinite(self.qvel.numpy()).all(1)
        return torch.from_numpy(warned | ~healthy)

    def data(self, name: str) -> Tensor:
        if name not in self._data:
            check_computed(name)
            array = self.batch.bind(name)
            with warnings.catch_warnings():  # a derived field is read-only, which a tensor cannot say
                warnings.filterwarnings("ignore", "The given NumPy array is not writable", UserWarning)
                self._data[name] = torch.from_numpy(array)
            if not array.flags.writeable:
                self._derived = True
                self.forward()  # it holds zeros so far
        return self._data[name]

    def field(self, name: str) -> Tensor:
        if name not in self._fields:
            raise ValueError(f"all envs share {name}. Declare it: BatchPhysics(..., fields={[*self.fields, name]}).")
        return self._fields[name]

    def set_field(self, name: str, value: Values, envs: Envs = None) -> None:
        self.set_fields({name: value}, envs)

    def set_fields(self, values: Mapping[str, Values], envs: Envs = None) -> None:
        ids = self._ids(envs)
        rows = _rows(ids)
        wanted = {name: expand_to(self.field(name), value, name)[rows] for name, value in values.items()}
        for name, value in wanted.items():
            refuse_ignored_limits(self.model, name, value, self.fields)
            self.field(name)[rows] = value.to(self.field(name).dtype)
        if any(has_constants(name) for name in wanted):
            self.batch.set_const(ids)
        for name, value in wanted.items():
            held = self.field(name)[rows]
            lost = held.double() != value.double()
            if lost.any():
                raise ValueError(
                    f"{name} holds {held[lost][0].item()} where {value[lost][0].item()} was written: it is stored as "
                    f"{held.dtype}."
                )

    def raise_up(self, height: Tensor) -> None:
        self.qpos[:, self._floating] += height.to(self.dtype)
        if self._derived:
            self.batch.forward(env_ids(height.flatten() != 0, self.num_envs))

    def reset(
        self, envs: Envs = None, keyframe: int | str = -1, qpos: Values | None = None, qvel: Values | None = None
    ) -> None:
        ids = self._ids(envs)
        key = self.model.key(keyframe).id if isinstance(keyframe, str) else keyframe
        self.batch.reset(ids, key, _NONE)
        for name, value in (("qpos", qpos), ("qvel", qvel)):
            if value is not None:
                state = self.data(name)
                state[_rows(ids)] = expand_to(state, value, name)[_rows(ids)].to(state.dtype)
        if self._derived:
            self.batch.forward(ids)

    def apply_torque(self, torque: Tensor) -> None:
        check_shape("torque", torque, (self.num_envs, len(self.joint_names)), self.joint_names)
        self._forces[:, self._joint_dof] = torque.detach().numpy()  # for small batches several times as quick as torch

    def apply_wrench(self, body: str, force: Values = 0.0, torque: Values = 0.0) -> None:
        wrench = self.xfrc_applied[:, self.model.body(body).id]
        wrench[:, :3] = expand_to(wrench[:, :3], force, "force")
        wrench[:, 3:] = expand_to(wrench[:, 3:], torque, "torque")

    def step(self, nstep: int = 1, refresh: bool = False, envs: Envs = None) -> None:
        self.batch.step(self._ids(envs), nstep, _VEL if refresh else _NONE)

    def forward(self, envs: Envs = None) -> None:
        self.batch.forward(self._ids(envs))

    def rollout(
        self, nstep: int, control: Tensor | None = None, into: str = "ctrl", record: Sequence[str] = ("qpos", "qvel")
    ) -> dict[str, Tensor]:
        if into not in _INPUTS:
            raise ValueError(f"control cannot go into {into!r}; known are {tuple(_INPUTS)}.")
        for name in record:
            check_computed(name)
        rows = None if control is None else self._control(nstep, control, into).numpy()
        recorded = self.batch.rollout(nstep, rows, _INPUTS[into].value, record)
        return {str(name): torch.from_numpy(array) for name, array in recorded.items()}

    def check(self) -> None:
        lost = np.flatnonzero(self.batch.warning[:, _FULL, 1].any(1))
        if lost.size:
            raise CapacityError(
                f"in {lost.size} of {self.num_envs} envs, such as {lost[0]}, contacts or constraints found no place in "
                f"the model's memory of {self.model.narena} bytes and were left out. Give it more: "
                "<size memory='...'/> in the MJCF."
            )

    def capture(self, function: Callable[[], Result], warmup: int = 3) -> Callable[[], Result]:
        return function

    def _control(self, nstep: int, control: Tensor, into: str) -> Tensor:
        """Inputs of a rollout as the batch takes them, (N, T, flat)."""
        columns = (len(self.joint_names),) if into == "torque" else self.data(into).shape[1:]
        check_shape(f"control into {into!r}", control, (self.num_envs, nstep, *columns), self.joint_names)
        control = control.detach().to(self.dtype)
        if into != "torque" or self._joint_dof == slice(0, self.model.nv):
            return control.reshape(self.num_envs, nstep, -1)
        forces = self.qfrc_applied[:, None].repeat(1, nstep, 1)  # of other degrees of freedom: stay as they are
        forces[..., self._joint_dof] = control
        return forces

    def _ids(self, envs: Envs) -> NDArray[np.int64] | None:
        """Sorted, as the batch takes them; None for all."""
        return None if envs is None else env_ids(envs, self.num_envs)


def _rows(ids: NDArray[np.int64] | None) -> slice | Tensor:
    return slice(None) if ids is None else torch.from_numpy(ids)
