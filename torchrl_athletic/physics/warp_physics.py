"""Thousands of simulations of one model on a GPU, through MuJoCo Warp, without a copy and without a wait."""

from __future__ import annotations

import copy
import difflib
import functools
import gc
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import AbstractContextManager, contextmanager
from typing import Any

import mujoco
import numpy as np
import torch
from torch import Tensor

from torchrl_athletic.physics.capacity import estimate_capacity
from torchrl_athletic.physics.data_fields import (
    check_computed,
    floating_places,
    late_columns,
    sensors_need_constraints,
    sensors_read_actuators,
)
from torchrl_athletic.physics.inertial_constants import INERTIAL_FIELDS, InertialConstants
from torchrl_athletic.physics.joints import Columns, driven_joints, floating_heights, joint_columns
from torchrl_athletic.physics.model_fields import has_constants, refuse_ignored_limits
from torchrl_athletic.physics.protocol import CapacityError, Envs, Physics, Result, Values
from torchrl_athletic.physics.rows import check_mask, check_shape, env_ids, expand_to

__all__ = ["WarpPhysics"]

_INPUTS = ("ctrl", "torque", "qfrc_applied", "xfrc_applied")
_MOVED = ("time", "qpos", "qvel", "act", "qacc_warmstart")  # what a step changes of the state
_STATE = (*_MOVED, "ctrl", "qfrc_applied", "xfrc_applied", "eq_active", "mocap_pos", "mocap_quat", "userdata")
_OF_KEYFRAME = {"time": "key_time", "qpos": "key_qpos", "qvel": "key_qvel", "act": "key_act", "ctrl": "key_ctrl"}
_CONSTANTS = (  # what set_const computes; with a value per env as soon as anything it reads has
    *("body_subtreemass", "dof_invweight0", "body_invweight0", "tendon_invweight0", "tendon_length0"),
    *("actuator_acc0", "eq_data", "geom_aabb", "geom_rbound"),
)
_AT_ONCE = 128  # envs whose constants follow from their masses in one step of a recorded graph
_LARGEST = mujoco.mjMAXVAL  # of a position or velocity that MuJoCo accepts


class WarpPhysics(Physics):
    """N simulations on a GPU, through :mod:`mujoco_warp`. Numbers are float32.

    Tensors of the state are the simulation's own memory. Steps replay a CUDA graph, recorded at the first of their
    kind; to put the physics into one graph with all that surrounds it, see :meth:`capture`. No method waits for the
    device, but for :meth:`check` and for values that come from the host.

    A reset brings the poses and velocities of all envs up to date, not only of those reset. A diverged env is not
    restarted: it holds what it came to until its reset.

    Args:
        model: What to simulate. Copied.
        num_envs: N.
        device: ``"cuda"``, ``"cuda:1"``... ``"cpu"`` runs the same code slowly, for tests.
        fields: Names of ``mjModel`` fields, or ``"opt.gravity"`` and the like, that get values per env.
        joint_names: Joints for :meth:`apply_torque`. None takes the actuators' joints in their order or, in a model
            without actuators on joints, every hinge and slide.
        nconmax: Contacts per env to set memory aside for, on average. None takes
            :func:`~torchrl_athletic.physics.capacity.estimate_capacity`.
        njmax: Constraint rows of any one env to set memory aside for. None as above.

    Raises:
        ImportError: If MuJoCo Warp is not installed.
        NotImplementedError: If the model has what MuJoCo Warp, or this class, cannot simulate.
        ValueError: If a field cannot differ between envs, or a joint is unknown or has several degrees of freedom.
    """

    dtype = torch.float32

    def __init__(
        self,
        model: mujoco.MjModel,
        num_envs: int,
        device: torch.device | str = "cuda",
        fields: Sequence[str] = (),
        joint_names: Sequence[str] | None = None,
        nconmax: int | None = None,
        njmax: int | None = None,
    ) -> None:
        self._warp, self._mjw = _import_warp()
        _refuse_unsupported(model)
        self.model, self.num_envs, self.fields = copy.copy(model), num_envs, tuple(fields)
        self.device = _device(device)
        estimate = estimate_capacity(model)
        self.nconmax, self.njmax = nconmax or estimate[0], njmax or estimate[1]
        self._inline = False  # whether work goes straight to the current stream, which may be recording it
        self._graphs: dict[tuple[str | int, ...], Callable[[], None]] = {}
        self._pools: list[Any] = []  # memory of the graphs
        self._views: dict[str, Tensor] = {}
        with self._on_stream():
            self.warp_model = self._mjw.put_model(model, batch_sizes=self._batch_sizes())
            self.warp_model.opt.warn_overflow = 0  # a print from the device would wait for it: see check()
            self.warp_data = self._mjw.make_data(model, num_envs, nconmax=self.nconmax, njmax=self.njmax)
            self._fields = {name: self._expanded(name) for name in self.fields}
        self.joint_names = driven_joints(model) if joint_names is None else tuple(joint_names)
        self._joint_qpos, self._joint_dof = (
            _columns_on(columns, self.device) for columns in joint_columns(model, self.joint_names)
        )
        self._state = {name: view for name in _STATE if (view := self._view(name)).numel()}
        self._views |= self._state
        self._derived_rows: dict[int, dict[str, Tensor]] = {}
        self._initial = [self._keyframe(key) for key in range(-1, model.nkey)]  # the default state is the last: -1 + 1
        self._late = torch.from_numpy(late_columns(model)).to(self.device)
        self._full_refresh = sensors_need_constraints(model)
        self._drives_sensed = model.ntendon > 0 or sensors_read_actuators(model)
        self._overflow, self._sensors = self._view("overflow"), self._view("sensordata")
        self._floating = torch.tensor(floating_heights(model), dtype=torch.int64, device=self.device)
        self._places = {name: torch.from_numpy(rows).to(self.device) for name, rows in floating_places(model).items()}
        self._peak = torch.zeros(num_envs, device=self.device)
        self._prepare_constants()
        self._chosen = torch.zeros(num_envs, dtype=torch.bool, device=self.device)
        self.forward()

    @property
    def timestep(self) -> float:
        return float(self.model.opt.timestep)

    @property
    def time(self) -> Tensor:
        return self._state["time"]

    @property
    def qpos(self) -> Tensor:
        return self._state["qpos"]

    @property
    def qvel(self) -> Tensor:
        return self._state["qvel"]

    @property
    def ctrl(self) -> Tensor:
        return self.data("ctrl")

    @property
    def qfrc_applied(self) -> Tensor:
        return self._state["qfrc_applied"]

    @property
    def xfrc_applied(self) -> Tensor:
        return self._state["xfrc_applied"]

    @property
    def joint_position(self) -> Tensor:
        return self.qpos[:, self._joint_qpos]

    @property
    def joint_velocity(self) -> Tensor:
        return self.qvel[:, self._joint_dof]

    @property
    def diverged(self) -> Tensor:
        return ~(self._peak < _LARGEST)  # also of what is not a number

    @property
    def overflow(self) -> Tensor:
        """Envs that ever lost a contact or a constraint for want of room. Bool, shape (N,). See :meth:`check`."""
        return (self._overflow & ~_benign(self._mjw)) != 0

    def data(self, name: str) -> Tensor:
        if name not in self._views:
            check_computed(name)
            view = self._view(name)
            if self._recording():
                raise RuntimeError(f"look at data({name!r}) once before the capture: it is computed at first sight.")
            self._views[name] = view
            self.forward()
        return self._views[name]

    def field(self, name: str) -> Tensor:
        if name not in self._fields:
            raise ValueError(f"all envs share {name}. Declare it: WarpPhysics(..., fields={[*self.fields, name]}).")
        return self._fields[name]

    def set_field(self, name: str, value: Values, envs: Envs = None) -> None:
        """As promised by the protocol, but for values that lie on the GPU: looking at those would wait for it.

        With a mask and values on the device it may be captured. Fields that ``mj_setConst`` reads cost a few dozen
        launches if they are masses, inertias and centres of mass, else hundreds: a few milliseconds.
        """
        self.set_fields({name: value}, envs)

    def set_fields(self, values: Mapping[str, Values], envs: Envs = None) -> None:
        mask = self._mask(envs)
        for name, value in values.items():
            field = self.field(name)
            if not (isinstance(value, Tensor) and value.is_cuda):
                self._check_values(name, value)
            self._write(field, value, mask, name)
        follow = [name for name in values if has_constants(name) and not name.startswith("opt.")]
        if not follow:
            return
        if self._inertial is None:
            self._run(("set_const",), lambda _: self._set_const())
        elif mask is None or not self._recording():
            for name, found in self._inertial(self._inertial_fields).items():
                self._write(self._constants[name], found, mask, name)
            self._stale &= False if mask is None else ~mask
        else:
            self._follow_few(mask)

    def _follow_few(self, mask: Tensor) -> None:
        """Constants of the envs of the mask, in a graph that is recorded once for however many there will be.

        It has room for ``_AT_ONCE`` of them. Should more change, the rest follows at the next calls. Until then the
        weights by which MuJoCo softens their contacts and friction are those of the robot before; masses are right.
        """
        assert self._inertial is not None
        total = self._inertial.subtree_mass(self._inertial_fields["body_mass"])
        self._write(self._constants["body_subtreemass"], total, mask, "body_subtreemass")
        self._stale |= mask
        chosen = self._stale.to(torch.float32).topk(min(_AT_ONCE, self.num_envs)).indices
        fields = {name: value[chosen] for name, value in self._inertial_fields.items()}
        due = self._stale[chosen]
        for name, found in self._inertial(fields).items():
            now = self._constants[name][chosen]
            self._constants[name].index_copy_(0, chosen, torch.where(_rows(due, now), found, now))
        self._stale.index_fill_(0, chosen, False)

    def raise_up(self, height: Tensor) -> None:
        """By shifting what was looked at, too: computing it anew takes a tenth of a control step.

        The centre of mass of the whole world, ``subtree_com[:, 0]``, stays as it was until the next step.
        """
        self.qpos[:, self._floating] += height
        for name, rows in self._places.items():
            if name in self._views:
                view = self._views[name]
                (view if name == "sensordata" else view[..., 2])[:, rows] += height

    def reset(
        self, envs: Envs = None, keyframe: int | str = -1, qpos: Values | None = None, qvel: Values | None = None
    ) -> None:
        mask = self._mask(envs)
        key = self.model.key(keyframe).id if isinstance(keyframe, str) else keyframe
        if not -1 <= key < self.model.nkey:
            raise ValueError(f"keyframe {key} must be -1, the default state, or among the model's {self.model.nkey}.")
        initial = self._initial[key + 1]
        for name, state in self._state.items():
            self._write(state, initial[name], mask, name)
        if "qpos0" in self._fields and key == -1:
            self._write(self.qpos, self._fields["qpos0"], mask, "qpos")
        for name, value in (("qpos", qpos), ("qvel", qvel)):
            if value is not None:
                self._write(self._state[name], value, mask, name)
        self._write(self._peak, 0.0, mask, "peak")
        if qpos is None and qvel is None and not self.fields:  # what follows from the state is known already
            for name, rows in self._follows_from(key).items():
                self._write(self._views[name], rows, mask, name)
        else:
            self._run(("refresh",), lambda _: self._refresh())

    def apply_torque(self, torque: Tensor) -> None:
        check_shape("torque", torque, (self.num_envs, len(self.joint_names)), self.joint_names)
        self.qfrc_applied[:, self._joint_dof] = torque.detach().to(self.device, self.dtype)

    def apply_wrench(self, body: str, force: Values = 0.0, torque: Values = 0.0) -> None:
        wrench = self.xfrc_applied[:, self.model.body(body).id]
        self._write(wrench[:, :3], force, None, "force")
        self._write(wrench[:, 3:], torque, None, "torque")

    def step(self, nstep: int = 1, refresh: bool = False, envs: Envs = None) -> None:
        work = functools.partial(self._advance, nstep, refresh)
        self._run(("step", nstep, refresh), work, self._mask(envs))

    def forward(self, envs: Envs = None) -> None:
        self._run(("forward",), self._forward, self._mask(envs))

    def rollout(
        self, nstep: int, control: Tensor | None = None, into: str = "ctrl", record: Sequence[str] = ("qpos", "qvel")
    ) -> dict[str, Tensor]:
        """As promised by the protocol; Python is in the loop, but the device is never waited for."""
        if into not in _INPUTS:
            raise ValueError(f"control cannot go into {into!r}; known are {_INPUTS}.")
        if control is not None:
            columns = (len(self.joint_names),) if into == "torque" else tuple(self.data(into).shape[1:])
            check_shape(f"control into {into!r}", control, (self.num_envs, nstep, *columns), self.joint_names)
        path: dict[str, list[Tensor]] = {name: [] for name in record}
        for k in range(nstep):
            if control is not None and into == "torque":
                self.apply_torque(control[:, k])
            elif control is not None:
                self.data(into).copy_(control[:, k])
            self.step(envs=~self.diverged)
            for name in record:
                path[name].append(self.data(name).clone())
        return {name: torch.stack(rows, 1) for name, rows in path.items()}

    def check(self) -> None:
        lost = torch.nonzero(self.overflow).flatten().tolist()
        if not lost:
            return
        kinds = int(np.bitwise_or.reduce(self._overflow[lost].cpu().numpy()))
        names = [kind.name for kind in self._mjw.OverflowType if kind.value & kinds & ~_benign(self._mjw)]
        rows, pairs = int(self._view("nefc").max()), int(self.warp_data.ncollision.numpy()[0])
        contacts = max(pairs, int(self.warp_data.nacon.numpy()[0])) / self.num_envs
        raise CapacityError(
            f"{len(lost)} of {self.num_envs} envs, such as {lost[0]}, lost contacts or constraints for want of room "
            f"({', '.join(str(name) for name in names)}), so that their motion is wrong. Set aside are njmax="
            f"{self.njmax} constraint rows for each env and nconmax={self.nconmax} contacts for each on average; "
            f"at the last step they took up to {rows} and {contacts:.1f}. Make WarpPhysics with njmax and nconmax "
            "half as large again, or more."
        )

    def capture(self, function: Callable[[], Result], warmup: int = 3) -> Callable[[], Result]:
        """Record a function that calls this physics into one CUDA graph. On the CPU it is returned as it is.

        Args:
            function: As promised by the protocol; torch operations and physics may alternate, in the calling thread
                alone: no ``backward()`` after the physics.
            warmup: As promised by the protocol; at least 1.

        Returns:
            Replays the graph on the current stream, and returns what the function did when it was recorded.
        """
        if self.device.type == "cpu":
            return function
        drawn = torch.cuda.get_rng_state(self.device)
        stream, graph = torch.cuda.Stream(self.device), torch.cuda.CUDAGraph()
        stream.wait_stream(torch.cuda.current_stream(self.device))
        with torch.cuda.stream(stream), self._set_inline():
            seen = len(self._views)
            held = [(tensor, tensor.clone()) for tensor in (*self._views.values(), self._peak)]
            for _ in range(warmup):
                function()
            for tensor, before in held:
                tensor.copy_(before)
            if len(self._views) > seen:  # what was looked at for the first time describes the warm-up
                self._forward(None)
        with _no_garbage_collection(), torch.cuda.graph(graph, stream=stream, capture_error_mode="thread_local"):
            with self.capturing():
                result = function()
        torch.cuda.current_stream(self.device).wait_stream(stream)
        torch.cuda.set_rng_state(drawn, self.device)  # or a run that goes on would explore otherwise than one that ran

        def replay() -> Result:
            graph.replay()
            return result

        return replay

    @contextmanager
    def capturing(self) -> Iterator[None]:
        """Let a capture of torch's own record the physics: to be entered inside ``torch.cuda.graph``.

        The graph's stream must not be the default one, its ``capture_error_mode`` must be ``"thread_local"``, and
        what is recorded must have run before, so that every kernel is loaded. :meth:`capture` does all of it.

        MuJoCo Warp's solver is a loop on the device, for which Warp ends the stream's capture and begins another. Torch
        tells its captures by number: it would take memory for all that follows from the common pool, and give it to
        others after the capture, while replays still write there. So what this thread allocates gets a pool of its own.
        """
        stream, pool = _warp_stream(torch.cuda.current_stream(self.device)), torch.cuda.MemPool()
        self._pools.append(pool)
        self._warp.capture_begin(stream=stream, external=True)
        try:
            with self._set_inline(), torch.cuda.use_mem_pool(pool, self.device):
                yield
        finally:
            self._warp.capture_end(stream=stream)

    @contextmanager
    def _set_inline(self) -> Iterator[None]:
        before, self._inline = self._inline, True
        try:
            yield
        finally:
            self._inline = before

    def _recording(self) -> bool:
        return self.device.type == "cuda" and torch.cuda.is_current_stream_capturing()

    def _on_stream(self) -> AbstractContextManager[Any]:
        """Warp's work goes where torch's does: to the current stream. Entering must not wait, which ends a capture."""
        if self.device.type == "cpu":
            scope: AbstractContextManager[Any] = self._warp.ScopedDevice("cpu")
        else:
            stream = _warp_stream(torch.cuda.current_stream(self.device))
            scope = self._warp.ScopedStream(stream, sync_enter=False)
        return scope

    def _run(
        self, name: tuple[str | int, ...], work: Callable[[Tensor | None], None], mask: Tensor | None = None
    ) -> None:
        """Do work on the envs of the mask: from a graph of its own, or as part of one being recorded."""
        if self._inline or self.device.type == "cpu":
            work(mask)
            return
        if self._recording():
            raise RuntimeError(
                "the physics cannot be recorded by a capture that it does not know of. Take physics.capture(function), "
                "or put `with physics.capturing():` inside torch.cuda.graph(...)."
            )
        if mask is not None:
            self._chosen.copy_(mask)
        kind = (*name, 0 if mask is None else len(self._views))  # a masked one holds what is looked at
        if kind not in self._graphs:
            chosen = None if mask is None else self._chosen
            self._graphs[kind] = self.capture(lambda: work(chosen), warmup=1)
        self._graphs[kind]()

    def _forward(self, mask: Tensor | None) -> None:
        with self._untouched(mask, self._derived()), self._on_stream():
            self._mjw.forward(self.warp_model, self.warp_data)

    def _set_const(self) -> None:
        with self._on_stream():
            self._mjw.set_const(self.warp_model, self.warp_data)

    def _advance(self, nstep: int, refresh: bool, mask: Tensor | None) -> None:
        moved = [self._state[name] for name in _MOVED if name in self._state]
        with self._untouched(mask, moved + self._derived()):
            with self._on_stream():
                for _ in range(nstep):
                    self._mjw.step(self.warp_model, self.warp_data)
            if refresh:
                self._refresh()
        self._peak.copy_(self._largest())

    def _refresh(self) -> None:
        """Compute poses, velocities and their sensors; contacts only if one of these sensors reads them."""
        mjw, m, d = self._mjw, self.warp_model, self.warp_data
        with self._on_stream():
            if self._full_refresh:
                self._refresh_all()
                return
            mjw.kinematics(m, d)
            mjw.com_pos(m, d)
            mjw.camlight(m, d)
            if self._drives_sensed:
                mjw.tendon(m, d)
                mjw.transmission(m, d)
                mjw.fwd_velocity(m, d)
            else:
                mjw.com_vel(m, d)
            mjw.sensor_pos(m, d)
            mjw.sensor_vel(m, d)

    def _refresh_all(self) -> None:
        """With collisions and constraints. Their sensors are added up, from zero; the later ones stay."""
        mjw, m, d = self._mjw, self.warp_model, self.warp_data
        late = self._sensors[:, self._late]
        mjw.step1(m, d)
        self._sensors[:, self._late] = late

    @contextmanager
    def _untouched(self, mask: Tensor | None, tensors: Sequence[Tensor]) -> Iterator[None]:
        """Undo what happens to the rows of envs that the mask leaves out."""
        before = [] if mask is None else [tensor.clone() for tensor in tensors]
        yield
        if mask is not None:
            for tensor, rows in zip(tensors, before, strict=True):
                torch.where(_rows(mask, tensor), tensor, rows, out=tensor)

    def _derived(self) -> list[Tensor]:
        return [view for name, view in self._views.items() if name not in self._state]

    def _largest(self) -> Tensor:
        """The largest position or velocity of each env since its reset; not a number if one was not. Shape (N,)."""
        seen = (torch.linalg.vector_norm(tensor, torch.inf, dim=1) for tensor in (self.qpos, self.qvel))
        return functools.reduce(torch.maximum, seen, self._peak)

    def _mask(self, envs: Envs) -> Tensor | None:
        """On the device; a mask that is there already costs nothing. None for all."""
        if envs is None:
            return None
        if isinstance(envs, Tensor) and envs.dtype == torch.bool:
            check_mask(tuple(envs.shape), self.num_envs)
            return envs.to(self.device)
        mask = torch.zeros(self.num_envs, dtype=torch.bool)
        mask[torch.from_numpy(env_ids(envs, self.num_envs))] = True
        return mask.to(self.device)

    def _write(self, target: Tensor, value: Values, mask: Tensor | None, name: str) -> None:
        """Where the mask allows. A Python number needs no copy from the host, and can be captured."""
        if isinstance(value, int | float):
            rows = torch.full((), float(value), device=self.device).to(target.dtype).expand(target.shape)
        else:
            rows = expand_to(target, value, name).to(self.device, target.dtype)
        if mask is None:
            target.copy_(rows)
        else:
            torch.where(_rows(mask, target), rows, target, out=target)

    def _check_values(self, name: str, value: Values) -> None:
        """Raise if the simulation would ignore the values or store others."""
        field = self.field(name)
        wanted = expand_to(field, value, name)
        refuse_ignored_limits(self.model, name, wanted.cpu(), self.fields)
        if not field.dtype.is_floating_point and bool((wanted != wanted.to(field.dtype)).any()):
            lost = wanted[wanted != wanted.to(field.dtype)].flatten()[0].item()
            raise ValueError(f"{name} cannot hold {lost}: it is stored as {field.dtype}.")

    def _view(self, name: str) -> Tensor:
        """A field of the data as a tensor on the same memory, shaped as MuJoCo's."""
        array = getattr(self.warp_data, name, None)
        if not isinstance(array, self._warp.array) or array.shape[0] != self.num_envs:
            near = difflib.get_close_matches(name, vars(self.warp_data), n=1)
            hint = f"; did you mean {near[0]!r}?" if near else "."
            raise ValueError(f"MuJoCo Warp has no field {name!r} with a row for each env{hint}")
        like = getattr(mujoco.MjData(self.model), name, None)
        return _shaped_like(self._warp.to_torch(array), like)

    def _prepare_constants(self) -> None:
        """Know the quick way to what follows from masses, where nothing else that other constants need differs."""
        own = [name for name in self.fields if has_constants(name) and not name.startswith("opt.")]
        self._inertial: InertialConstants | None = None
        if not own or self.model.ntendon or not set(own) <= set(INERTIAL_FIELDS):
            return
        self._inertial = InertialConstants.of(self.model, self.device)
        shared = (name for name in INERTIAL_FIELDS if name not in own)
        self._inertial_fields = {name: self._fields[name] for name in own}
        for name in shared:
            value = torch.tensor(getattr(self.model, name), dtype=self.dtype, device=self.device)
            self._inertial_fields[name] = value.expand(self.num_envs, *value.shape)
        self._stale = torch.zeros(self.num_envs, dtype=torch.bool, device=self.device)
        computed = self._inertial(self._inertial_fields)
        self._constants = {name: self._expanded(name) for name in computed}

    def _batch_sizes(self) -> dict[str, int]:
        """Fields of the model that get a row for each env, with those computed from them."""
        own = [name for name in self.fields if not name.startswith("opt.")]
        if any(has_constants(name) for name in own):
            own += [name for name in _CONSTANTS if name not in own]
        known = {name for name in vars(mujoco.MjModel) if not name.startswith("_")}
        for name in own:
            if name not in known:
                near = difflib.get_close_matches(name, known, n=1)
                raise ValueError(f"a model has no field {name!r}" + (f"; did you mean {near[0]!r}?" if near else "."))
        return dict.fromkeys(own, self.num_envs)

    def _expanded(self, name: str) -> Tensor:
        """Per-env values of a field of the model, or of its options, which MuJoCo Warp does not expand itself."""
        if not name.startswith("opt."):
            return _shaped_like(self._warp.to_torch(getattr(self.warp_model, name)), getattr(self.model, name))
        option = name.removeprefix("opt.")
        shared = getattr(self.warp_model.opt, option, None)
        if not isinstance(shared, self._warp.array):
            raise ValueError(f"{name} cannot differ between envs in MuJoCo Warp.")
        values = np.repeat(shared.numpy(), self.num_envs, axis=0)
        own = self._warp.array(values, dtype=shared.dtype, shape=(self.num_envs, *shared.shape[1:]))
        setattr(self.warp_model.opt, option, own)
        return _shaped_like(self._warp.to_torch(own), np.asarray(getattr(self.model.opt, option)))

    def _keyframe(self, key: int) -> dict[str, Tensor]:
        """State after a reset to a keyframe, or to the default state for -1: one row, on the device."""
        data = _data_at(self.model, key)
        return {name: self._row(data, name, state) for name, state in self._state.items()}

    def _follows_from(self, key: int) -> dict[str, Tensor]:
        """What is looked at besides the state, after such a reset: computed by MuJoCo when first asked for."""
        known = self._derived_rows.setdefault(key, {})
        shown = {name: view for name, view in self._views.items() if name not in self._state}
        if missing := [name for name in shown if name not in known]:
            data = _data_at(self.model, key)
            mujoco.mj_forward(self.model, data)
            known |= {name: self._row(data, name, shown[name]) for name in missing}
        return {name: known[name] for name in shown}

    def _row(self, data: mujoco.MjData, name: str, like: Tensor) -> Tensor:
        return torch.as_tensor(np.array(getattr(data, name))).to(self.device, like.dtype)


def _data_at(model: mujoco.MjModel, key: int) -> mujoco.MjData:
    data = mujoco.MjData(model)
    if key == -1:
        mujoco.mj_resetData(model, data)
    else:
        mujoco.mj_resetDataKeyframe(model, data, key)
    return data


def _import_warp() -> tuple[Any, Any]:
    try:
        import mujoco_warp
        import warp
    except ImportError as error:
        raise ImportError("WarpPhysics needs MuJoCo Warp: pip install torchrl-athletic[warp]") from error
    warp.init()  # most calls do so themselves, but not the one that takes a stream of torch's
    return warp, mujoco_warp


def _benign(mjw: Any) -> int:
    """Overflows that are no loss: the solver stopped at the iterations that the model allows."""
    return int(mjw.OverflowType.ITERATIONS | mjw.OverflowType.LS_ITERATIONS)


def _refuse_unsupported(model: mujoco.MjModel) -> None:
    """Raise for what a masked reset or step of this class would leave behind."""
    for present, what in (
        (model.nflex > 0, "flexible bodies"),
        (model.nhistory > 0, "delays of actuators or sensors"),
        (bool(model.opt.enableflags & mujoco.mjtEnableBit.mjENBL_SLEEP), "sleeping bodies"),
        (model.nv == 0, "nothing that moves"),
    ):
        if present:
            raise NotImplementedError(f"the model has {what}, for which WarpPhysics knows no masked reset.")


def _device(device: torch.device | str) -> torch.device:
    chosen = torch.device(device)
    if chosen.type != "cuda":
        return chosen
    if not torch.cuda.is_available():
        raise RuntimeError("torch sees no GPU. Take BatchPhysics, or WarpPhysics(..., device='cpu') to test.")
    return torch.device("cuda", torch.cuda.current_device() if chosen.index is None else chosen.index)


@functools.cache
def _warp_stream(stream: torch.cuda.Stream) -> Any:
    """Made once for each stream: Warp forgets a stream as soon as any of its names for it is gone."""
    import warp

    return warp.stream_from_torch(stream)


@contextmanager
def _no_garbage_collection() -> Iterator[None]:
    """A collection within a capture could free memory of the device there, which breaks it."""
    enabled = gc.isenabled()
    gc.disable()
    try:
        yield
    finally:
        if enabled:
            gc.enable()


def _rows(mask: Tensor, like: Tensor) -> Tensor:
    return mask.view(-1, *[1] * (like.ndim - 1))


def _shaped_like(view: Tensor, field: Any) -> Tensor:
    """(N, nbody, 3, 3) as MuJoCo has it: (N, nbody, 9)."""
    shape = (view.shape[0], *np.shape(field))
    return view.view(shape) if field is not None and np.prod(shape) == view.numel() else view


def _columns_on(columns: Columns, device: torch.device) -> Columns:
    return columns.to(device) if isinstance(columns, Tensor) else columns
