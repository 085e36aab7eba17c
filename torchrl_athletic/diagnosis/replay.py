"""Recordings replayed in simulation: many windows and many parameter sets at once.

Every window restarts from the measured state (multiple shooting), so that an error shows where it arises instead of
drifting through the rest of the take.
"""

from __future__ import annotations

import warnings
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field, replace
from functools import cached_property

import mujoco
import numpy as np
import torch
from numpy.typing import NDArray
from scipy.interpolate import CubicSpline
from scipy.ndimage import gaussian_filter1d
from scipy.signal import lfilter, savgol_coeffs, savgol_filter

from torchrl_athletic.effects.base import BaseMotion, base_columns, base_velocity, carried, pose_of
from torchrl_athletic.effects.gear import JoinedMotion, LinkMotion
from torchrl_athletic.effects.inertia import free_of_simple_bodies
from torchrl_athletic.effects.plant import Law, Now, Plant, Start
from torchrl_athletic.effects.signals import (
    JointAddress,
    held_command,
    inertia_matrix,
    kernel_for,
    torque_range,
)
from torchrl_athletic.effects.timing import low_pass
from torchrl_athletic.physics import BatchPhysics
from torchrl_athletic.recordings.noise import base_noise
from torchrl_athletic.recordings.recording import Recording

Array = NDArray[np.float64]
Build = Callable[[Plant, Array], None]
"""Writes parameter values (rows, P) into a plant."""

CHUNK = 3_000_000
"""Rows times physics steps times joints simulated in one go: bounds the memory to some 100 MB."""
FARTHEST = 1e4
"""Way from its start beyond which a simulation has diverged [rad, m]; a wheel that turns may be anywhere."""
EXPLICIT = 0.3
"""Share of its velocity that a controller's damping may take from a joint in one explicit step [1]."""
EXPLICIT_STEPS = 20
"""Steps a sample from which on that damping is integrated implicitly, instead of in ever finer steps [1]."""
SHORTEST = 1.0
"""Pieces that are joined; shorter ones may not hold a whole window of a fit [s]."""


@dataclass(frozen=True, eq=False)
class Take:
    """A recording on the grid of the simulation, or several. S samples, each ``substeps`` physics steps apart."""

    recording: Recording
    """The first, if there are several."""
    model: mujoco.MjModel
    """The model, at the physics step of the replay, with its actuators off: the recorded command drives the joints."""
    address: JointAddress
    substeps: int
    time: Array
    """Shape (S,)."""
    measured: Array
    """Measured position, interpolated and otherwise untouched. Shape (S, J)."""
    position: Array
    """Local cubic fit, as wide as the motion is smooth, to start from. Shape (S, J)."""
    velocity: Array
    """Shape (S, J)."""
    start_noise: Array
    """Standard deviation of ``position`` and ``velocity``. Shape (2, S, J)."""
    base: BaseMotion | None = None
    """How the base of a floating robot moved, fitted likewise. S samples."""
    base_noise: Array = field(default_factory=lambda: np.zeros((1, 6)))
    """Standard deviation of its velocity. Shape (S, 6), or (1, 6) without one."""
    halvings: int = 0
    """How often its step was halved to see what the step does."""
    pieces: tuple[Take, ...] = ()
    """What it was joined from, one after the other; empty if it is one gap-free recording."""

    @property
    def parts(self) -> tuple[Take, ...]:
        """Gap-free recordings; no window reaches from one into the next."""
        return self.pieces or (self,)

    @cached_property
    def begins(self) -> NDArray[np.intp]:
        """Sample at which each part begins. Shape (parts,)."""
        return np.cumsum([0, *(len(part.time) for part in self.parts[:-1])])

    @property
    def period(self) -> float:
        """Time between samples [s]."""
        return self.substeps * float(self.model.opt.timestep)

    def commands(self, delay: float, joint: int | slice = slice(None)) -> Array:
        """Mean command over each physics step, ``delay`` late, of all joints or of one. Shape (S * substeps, J)."""
        if self.pieces:
            return np.concatenate([piece.commands(delay, joint) for piece in self.pieces])
        edges = self.time[0] + float(self.model.opt.timestep) * np.arange(len(self.time) * self.substeps + 1)
        command = self.recording.command[:, joint].reshape(len(self.recording.time), -1)
        return held_command(self.recording.time, command, edges - delay)

    @cached_property
    def torque(self) -> Array:
        """Torque commanded until the next sample; of the PD law where positions are. Shape (S, J)."""
        if self.pieces:
            return np.concatenate([piece.torque for piece in self.pieces])
        command = self.commands(0.0).reshape(len(self.time), self.substeps, -1).mean(1)
        r = self.recording
        if r.position_target is None:
            return command
        assert r.kp is not None
        assert r.kd is not None
        q, v = _until_next(self.position), _until_next(self.velocity)
        return np.asarray(r.kp * (command - q) - r.kd * v, dtype=np.float64)

    @cached_property
    def link(self) -> LinkMotion:
        """What the measured motion asks of the links."""
        if self.pieces:
            return JoinedMotion.of(tuple(piece.link for piece in self.pieces))
        return LinkMotion(self.model, self.address, self.period, self.position, self.velocity, base=self.base)

    def misread(self, rng: np.random.Generator) -> Take:
        """A copy in which the base of a floating robot has the noise of its velocity."""
        if self.base is None:
            return self
        velocity = self.base.velocity + self.base_noise * rng.standard_normal(self.base.velocity.shape)
        return replace(self, base=replace(self.base, velocity=velocity))

    @cached_property
    def inertia(self) -> Array:
        """That each joint turns in the given model where the take begins [kg·m², kg]. Shape (J,)."""
        return np.diag(inertia_matrix(self.model, self.address, self.position[:1])[0]).copy()

    @cached_property
    def explicit(self) -> Take:
        """A copy with steps in which a controller's damping needs no implicit integration, or this one."""
        take, kd = self, self.recording.kd
        longest = np.inf if kd is None else _explicit_step(self.inertia, kd) / 2**self.halvings
        while take.model.opt.timestep > longest:
            take = replace(take.halved(), halvings=self.halvings)
        return take

    def halved(self) -> Take:
        """A copy at half the physics step."""
        return replace(self.stepped(2 * self.substeps), halvings=self.halvings + 1)

    def stepped(self, substeps: int) -> Take:
        """A copy with so many physics steps a sample."""
        model = self.model.__copy__()
        model.opt.timestep = self.period / substeps
        return replace(self, model=model, substeps=substeps, pieces=tuple(p.stepped(substeps) for p in self.pieces))

    def thinned(self, every: int) -> Take:
        """A copy on every so many-th sample, with one physics step for each of these."""
        if self.pieces:
            return _joined([piece.thinned(every) for piece in self.pieces])
        model = self.model.__copy__()
        model.opt.timestep = every * self.period
        kept = slice(None, None, every)
        return replace(
            self, model=model, substeps=1, time=self.time[kept], measured=self.measured[kept],
            position=self.position[kept], velocity=self.velocity[kept], start_noise=self.start_noise[:, kept],
            base=None if self.base is None else self.base[kept],
            base_noise=self.base_noise[kept] if len(self.base_noise) > 1 else self.base_noise,
        )  # fmt: skip


def take_of(
    recording: Recording,
    model: mujoco.MjModel,
    position_noise: Array,
    velocity_noise: Array | None = None,
    noise_correlation: Array | float = 0.0,
    period: float | None = None,
) -> Take:
    """Put a recording on the grid of the simulation.

    A sampling period is a whole number of physics steps: of the model's time step, or of a slightly shorter one, or of
    a shorter one where the derivative gain would make it unstable; no more than :data:`EXPLICIT_STEPS` a sample for
    that, since :func:`_stiffness` takes care of what is still too stiff. It is the recording's own if it is None.
    """
    address = JointAddress.of(model, recording.joint_names, recording.source)
    period = 1.0 / recording.rate if period is None else period
    step = float(model.opt.timestep)
    if recording.kd is not None:
        inertia = np.diag(inertia_matrix(model, address, recording.position[:1])[0])
        step = min(
            step, max(_explicit_step(inertia, recording.kd), period / EXPLICIT_STEPS if _is_implicit(model) else 0.0)
        )
    substeps = int(np.ceil(period / step - 1e-3))
    step = period / substeps
    driven = carried(model).__copy__()
    driven.opt.timestep = step
    driven.opt.disableflags |= int(mujoco.mjtDisableBit.mjDSBL_ACTUATION)
    free_of_simple_bodies(driven)

    period = substeps * step
    time = recording.time[0] + period * np.arange(int((recording.duration + 1e-9) / period) + 1)
    measured = _interpolate(time, recording.time, recording.position)
    longest = kernel_for([recording])
    late = _stamp_jitter(recording.time)  # a reading is off by what the joint moved meanwhile
    slow = np.sqrt((1 + noise_correlation) / (1 - noise_correlation))  # its mean over many samples is off by more
    rough = _rough_velocity(measured, period, longest)
    position_noise = np.hypot(slow * position_noise, late * np.abs(rough))
    position, position_sigma = _local_fit(_cubics(measured, 0, period, longest, position_noise))
    slopes = _cubics(measured, 1, period, longest, position_noise)
    if recording.velocity is not None and velocity_noise is not None:
        velocity_noise = np.hypot(velocity_noise, late * np.abs(np.gradient(rough, period, axis=0)))
        slopes += _cubics(_interpolate(time, recording.time, recording.velocity), 0, period, longest, velocity_noise)
    velocity, velocity_sigma = _local_fit(slopes)
    noise = np.stack([position_sigma, velocity_sigma])
    base, base_noise = _base_of(recording, driven, time, longest, late)
    return Take(recording, driven, address, substeps, time, measured, position, velocity, noise, base, base_noise)


def _explicit_step(inertia: Array, kd: Array) -> float:
    """Longest step in which no joint loses more than its share of velocity to a controller's damping [s]."""
    return float(np.min(EXPLICIT * inertia / np.maximum(kd, 1e-12)))


def _is_implicit(model: mujoco.MjModel) -> bool:
    """Whether MuJoCo integrates a joint's damping implicitly."""
    if model.opt.disableflags & mujoco.mjtDisableBit.mjDSBL_DAMPER:
        return False
    if model.opt.integrator == mujoco.mjtIntegrator.mjINT_EULER:
        return not model.opt.disableflags & mujoco.mjtDisableBit.mjDSBL_EULERDAMP
    return model.opt.integrator != mujoco.mjtIntegrator.mjINT_RK4


def _base_of(
    recording: Recording, model: mujoco.MjModel, time: Array, longest: float, late: float
) -> tuple[BaseMotion | None, Array]:
    """How the base moved, from local cubic fits like the joints' states, and the noise of its velocity."""
    pose, period = pose_of(recording, model), float(time[1] - time[0])
    if pose is None:
        return None, np.zeros((1, 6))
    measured = _interpolate(time, recording.time, pose)
    linear, angular = base_noise(recording)
    noise = np.hypot([linear] * 3 + [angular / 2] * 4, late * np.abs(_rough_velocity(measured, period, longest)))
    fitted, _ = _local_fit(_cubics(measured, 0, period, longest, noise))
    rate, sigma = _local_fit(_cubics(measured, 1, period, longest, noise))
    fitted[:, 3:] /= np.linalg.norm(fitted[:, 3:], axis=1, keepdims=True)
    velocity = base_velocity(fitted, rate)
    sigma_of_turn = 2 * np.sqrt((sigma[:, 3:] ** 2).mean(1, keepdims=True)).repeat(3, axis=1)
    motion = BaseMotion(fitted, velocity, CubicSpline(time, velocity)(time, 1))
    return motion, np.hstack([sigma[:, :3], sigma_of_turn])


def _rough_velocity(measured: Array, period: float, longest: float) -> Array:
    smooth = gaussian_filter1d(measured, max(longest / period, 1.0), axis=0)
    return np.asarray(np.gradient(smooth, period, axis=0), dtype=np.float64)


def follow_targets(takes: Sequence[Take]) -> bool:
    """Whether some of the recordings are of a controller, whose loop a replay closes step by step."""
    return any(take.recording.position_target is not None for take in takes)


def join(takes: Sequence[Take]) -> list[Take]:
    """Takes that differ in their data only as one, to be replayed as one batch: a step costs little more for many rows.

    Drop-outs cut a recording into dozens of pieces. Those that are shorter than :data:`SHORTEST` stay alone.
    """
    alike: dict[tuple[object, ...], list[Take]] = {}
    for k, take in enumerate(takes):
        short = len(take.time) * take.period < SHORTEST
        alike.setdefault((k,) if short else _kind(take), []).append(take)
    return [_joined(group) if len(group) > 1 else group[0] for group in alike.values()]


def _kind(take: Take) -> tuple[object, ...]:
    """What takes of one batch share: model, step, grid and gains."""
    r, model = take.recording, np.empty(mujoco.mj_sizeModel(take.model), dtype=np.uint8)
    mujoco.mj_saveModel(take.model, None, model)
    gains = () if r.position_target is None else (r.kp.tobytes(), r.kd.tobytes())  # type: ignore[union-attr]
    return model.tobytes(), take.substeps, gains


def _joined(takes: Sequence[Take]) -> Take:
    """Several takes of a kind as one."""

    def along(name: str, axis: int = 0) -> Array:
        return np.concatenate([getattr(take, name) for take in takes], axis)

    return replace(
        takes[0], time=along("time"), measured=along("measured"), position=along("position"),
        velocity=along("velocity"), start_noise=along("start_noise", 1), pieces=tuple(takes),
        base=None if takes[0].base is None else BaseMotion.joined([take.base for take in takes if take.base]),
        base_noise=along("base_noise"),
    )  # fmt: skip


@dataclass(frozen=True, eq=False)
class Windows:
    """Where the windows of one take start. W windows of ``length`` samples."""

    take: Take
    start: NDArray[np.intp]
    """Shape (W,)."""
    length: int

    @property
    def index(self) -> NDArray[np.intp]:
        """Samples that each window predicts, its start left out. Shape (W, length)."""
        return self.start[:, None] + np.arange(1, self.length + 1)

    @property
    def measured(self) -> Array:
        """Shape (W, length, J)."""
        return self.take.measured[self.index]

    def of(self, take: Take) -> Windows:
        """The same windows of a copy of the take: in other steps, or of which the take is every so many-th sample."""
        every = round(self.take.period / take.period)
        assert every >= 1, "a window may begin between two samples of a thinner copy"
        piece = np.searchsorted(self.take.begins, self.start, side="right") - 1
        start = take.begins[piece] + every * (self.start - self.take.begins[piece])
        return Windows(take, start, every * self.length)


def windows_of(take: Take, seconds: float | None) -> Windows:
    """Cut a take into windows, back to back; ``None`` is one window over the whole take, which must not be joined."""
    longest = max(len(part.time) for part in take.parts) - 1
    length = longest if seconds is None else min(max(1, round(seconds / take.period)), longest)
    start = [
        first + np.arange(0, len(p.time) - length, length) for first, p in zip(take.begins, take.parts, strict=True)
    ]
    return Windows(take, np.concatenate(start), length)


def simulate(windows: Windows, build: Build, values: Array, start: tuple[Array, Array] | None = None) -> Array:
    """Predict the measured position in every window, for every parameter set.

    Args:
        windows: Of one take.
        build: Puts parameters into a plant.
        values: Parameter sets. Shape (K, P).
        start: Positions and velocities to start from instead of the measured ones. Shapes (W, J).

    Returns:
        What the encoders would read. Shape (K, W, length, J). A simulation that diverges keeps its last finite values.
    """
    take, sets = _replayed(windows.take, build, values), len(values)
    windows = replace(windows, take=take)
    cost = max(1, len(windows.start) * windows.length * take.substeps * len(take.address.dof))
    per_chunk = max(1, CHUNK // cost)
    with _silent_divergence():
        parts = [_simulate(windows, build, values[k : k + per_chunk], start) for k in range(0, sets, per_chunk)]
    return np.concatenate(parts) if parts else np.zeros((0, *windows.index.shape, len(take.address.dof)))


def _replayed(take: Take, build: Build, values: Array) -> Take:
    """The take, in finer steps if a controller damps a motor that a gear holds too loosely for implicit steps."""
    if take.recording.position_target is None:
        return take
    plant = Plant(take.model, take.address, len(values))
    build(plant, values)
    stiff = _stiffness(take, plant, float(take.model.opt.timestep) * 2**take.halvings)
    return take.explicit if any(stiff[:, gear.joint].any() for gear in plant.gears) else take


@contextmanager
def _silent_divergence() -> Iterator[None]:
    """Drop what MuJoCo prints, and logs where the user stands, of rows that diverge, unless somebody listens to it.

    An optimiser tries what no robot could be. Other warnings are passed on, each once.
    """
    if mujoco.get_mju_user_warning() is not None:
        yield
        return
    told: list[str] = []
    mujoco.set_mju_user_warning(told.append)
    try:
        yield
    finally:
        mujoco.set_mju_user_warning(None)
        for text in dict.fromkeys(told):
            if "Nan, Inf or huge value" not in text:
                warnings.warn(text, RuntimeWarning, stacklevel=3)


def _simulate(windows: Windows, build: Build, values: Array, start: tuple[Array, Array] | None) -> Array:
    take, sets, count = windows.take, len(values), len(windows.start)
    rows, joints = sets * count, len(take.address.dof)
    plant = Plant(take.model, take.address, rows)
    build(plant, np.repeat(values, count, axis=0))
    stiff = _stiffness(take, plant, float(take.model.opt.timestep))
    stiff[:, [gear.joint for gear in plant.gears]] = 0.0  # the motor is damped, see _replayed
    if stiff.any():
        plant.of("dof_damping")[:, take.address.dof] += stiff
    measured = (take.position[windows.start], take.velocity[windows.start]) if start is None else start
    position = (np.tile(measured[0], (sets, 1)) - plant.encoder_offset) / plant.encoder_scale
    velocity = np.tile(measured[1], (sets, 1)) / plant.encoder_scale
    sample = np.tile(windows.start, sets)
    began, reads = (np.array([getattr(p.recording, n) for p in take.parts]) for n in ("began", "mean_reading"))
    before = Start(take.time, take.position, take.velocity, take.torque, sample, take.link, take.begins, began, reads)
    for gear in plant.gears:  # the encoder sits on the motor, MuJoCo simulates the link
        lag_of_link, its_rate = gear.begin(before, plant, velocity[:, gear.joint])
        position[:, gear.joint] -= lag_of_link
        velocity[:, gear.joint] -= its_rate
    for law in (*plant.motor, *plant.laws):
        if isinstance(law, Law):
            law.begin(before)
    physics = BatchPhysics(
        take.model, rows, fields=tuple(plant.fields), joint_names=[str(n) for n in take.recording.joint_names]
    )
    for name, value in plant.fields.items():
        physics.set_field(name, torch.from_numpy(value))
    qpos = np.repeat(take.model.qpos0[None], rows, axis=0)
    qpos[:, take.address.qpos] = position
    qvel = np.zeros((rows, take.model.nv))
    qvel[:, take.address.dof] = velocity
    at, dof = base_columns(take.model)
    if take.base is not None:
        begin = _base_from(before, plant, take, 0)
        qpos[:, at], qvel[:, dof] = begin.pose[:, 0], begin.velocity[:, 0]
    carry = _carry(before, plant, windows)
    physics.reset(qpos=qpos, qvel=qvel)

    steps = windows.length * take.substeps
    command = _delayed_commands(windows, plant, sets)  # (rows, steps, J)
    if take.recording.position_target is None and plant.open_loop:
        forces = np.zeros((rows, steps, take.model.nv))
        forces[..., take.address.dof], forces[..., dof] = _drive(command, plant, take), carry
        states = physics.rollout(steps, torch.from_numpy(forces), into="qfrc_applied", record=("qpos", "qvel"))
        q, v = (states[name].numpy()[:, take.substeps - 1 :: take.substeps] for name in ("qpos", "qvel"))
        out = q[:, :, take.address.qpos] - _lead(take.model) * (v[:, :, take.address.dof] - velocity[:, None])
    else:
        with np.errstate(all="ignore"):  # of rows that diverge
            out = _closed_loop(physics, command, carry, plant, stiff, windows, sets)
    out = _hold_finite(
        out * plant.encoder_scale[:, None] + plant.encoder_offset[:, None], np.tile(measured[0], (sets, 1))
    )
    return out.reshape(sets, count, windows.length, joints)


def _lead(model: mujoco.MjModel) -> float:
    """Time by which positions run ahead of the torques [s].

    Semi-implicit steps move by the velocity at their end: after a velocity has changed by Δv, the position is Δv h/2
    too far. A reading corrected by that is exact to second order, and a delay is told to less than a step.
    """
    return 0.0 if model.opt.integrator == mujoco.mjtIntegrator.mjINT_RK4 else 0.5 * float(model.opt.timestep)


def _closed_loop(
    physics: BatchPhysics, command: Array, carry: Array, plant: Plant, stiff: Array, windows: Windows, sets: int
) -> Array:
    """Step by step, for torques that depend on the state. Returns true positions where the encoders sit.

    What the model was damped by for the sake of stability, ``stiff``, is given back with the velocity that a step
    begins with, so that only the change of the damping within the step remains: a linearly implicit step. A motor at
    its limit damps by what it gives of what was asked for.
    """
    take, step = windows.take, float(windows.take.model.opt.timestep)
    r = take.recording
    qpos, qvel, applied = physics.qpos.numpy(), physics.qvel.numpy(), physics.qfrc_applied.numpy()
    at, dof = take.address.qpos, take.address.dof
    _, base = base_columns(take.model)
    keep = np.where(plant.lag > 1e-6, np.exp(-step / np.maximum(plant.lag, 1e-6)), 0.0)
    servo = None if r.position_target is None else _servo(r, plant)
    state = _lag_state(windows, plant, sets) if servo is not None and keep.any() else None
    low, high = torque_range(take.model, take.address)
    limited = bool(np.isfinite(plant.torque_limit).any())
    stamp = np.tile(take.time[windows.start], sets)
    lead, first_rate = _lead(take.model), _motor_side(plant, qpos[:, at], qvel[:, dof])[1].copy()
    damped = physics.field("dof_damping").numpy() if stiff.any() else None
    still = 0.0 if damped is None else damped[:, dof] - stiff
    out = np.empty((len(qpos), windows.length, len(dof)))
    for i in range(windows.length * take.substeps):
        q, v = qpos[:, at], qvel[:, dof]
        motor_q, motor_v = _motor_side(plant, q, v)
        torque = command[:, i]
        if servo is not None:
            torque = servo(torque, motor_q, motor_v)
            if state is not None:
                state = torque + (state - torque) * keep
                torque = state
        asked = torque
        if limited:
            torque = np.minimum(np.maximum(torque, -plant.torque_limit), plant.torque_limit)
        now = Now(motor_q, motor_v, torque, stamp + i * step, step)
        for law in plant.motor:
            now.torque = law(now)
        torque = np.minimum(np.maximum(now.torque * plant.torque_scale + plant.torque_offset, low), high)
        if damped is not None:
            own = stiff * _passed(torque - plant.torque_offset, asked * plant.torque_scale)
            damped[:, dof] = still + own
        if plant.gears:
            torque = torque.copy()
            for gear in plant.gears:
                torque[:, gear.joint] = gear.step(torque[:, gear.joint], v[:, gear.joint], now)
        now.position, now.velocity, now.torque = q, v, torque
        for law in plant.laws:
            torque = torque + law(now)
        if damped is not None:
            torque = torque + own * v
        applied[:, dof], applied[:, base] = torque, carry[:, i]
        physics.step()
        if (i + 1) % take.substeps == 0:
            read, rate = _motor_side(plant, qpos[:, at], qvel[:, dof])
            out[:, i // take.substeps] = read - lead * (rate - first_rate)
    return out


def _carry(start: Start, plant: Plant, windows: Windows) -> Array:
    """Forces that move a heavy base from one recorded velocity to the next. Shape (rows, steps, 6), or 0 for 6."""
    take = windows.take
    if take.base is None:
        return np.zeros((plant.rows, windows.length * take.substeps, 0))
    _, dof = base_columns(take.model)
    gain = np.diff(_base_from(start, plant, take, windows.length).velocity, axis=1) / take.period
    return (take.model.dof_armature[dof] * gain).repeat(take.substeps, axis=1)


def _base_from(start: Start, plant: Plant, take: Take, length: int) -> BaseMotion:
    """The base at each row's start and ``length`` samples on, with its stamps put right. Rows, length + 1, K."""
    assert take.base is not None
    late = (plant.base_offset / take.period)[:, None]
    at = np.clip(start.sample[:, None] + np.arange(length + 1) + late, start.first[:, None], start.last[:, None])
    low = np.minimum(at.astype(np.intp), start.last[:, None] - 1)
    share = (at - low)[..., None]
    return take.base.moved(lambda x: (1 - share) * x[low] + share * x[low + 1])


def _servo(r: Recording, plant: Plant) -> Callable[[Array, Array, Array], Array]:
    """The PD law on what the encoders read: target, true position, true velocity to torque. Shapes (rows, J)."""
    assert r.kp is not None
    assert r.kd is not None
    kp, kd = r.kp * plant.kp_scale, r.kd * plant.kd_scale * plant.encoder_scale
    per_target, per_position, constant = kp, kp * plant.encoder_scale, kp * plant.encoder_offset
    return lambda target, q, v: per_target * target - per_position * q - constant - kd * v


def _passed(torque: Array, asked: Array) -> Array:
    """Share of the torque that was asked for which the motor gives, 0..1. Shape (rows, J).

    With so much of the damping, a motor at its limit takes a light joint to the speed that was asked for, never beyond.
    """
    share = np.divide(torque, asked, out=np.ones_like(torque), where=np.abs(asked) > 1e-12)
    return np.clip(share, 0.0, 1.0)


def _stiffness(take: Take, plant: Plant, step: float) -> Array:
    """Part of a controller's damping that a step [s] is too long for [N·m·s/rad]. Shape (rows, J).

    A joint without much inertia, as the wrist of a model without rotors, comes to rest against it in microseconds.
    """
    r = take.recording
    if r.position_target is None or r.kd is None or not _is_implicit(take.model):
        return np.zeros((plant.rows, len(take.address.dof)))
    inertia = take.inertia
    if "dof_armature" in plant.fields:
        dof = take.address.dof
        inertia = inertia + plant.fields["dof_armature"][:, dof] - take.model.dof_armature[dof]
    at_once = -np.expm1(-step / np.maximum(plant.lag, 1e-9))  # share that passes the lag within the step
    damping = r.kd * plant.kd_scale * plant.encoder_scale * plant.torque_scale * at_once
    return np.maximum(damping - EXPLICIT * inertia / step, 0.0)


def _motor_side(plant: Plant, q: Array, v: Array) -> tuple[Array, Array]:
    """Positions and velocities where the encoders sit: at the joint, or before its gear. Shapes (rows, J)."""
    if plant.gears:
        q, v = q.copy(), v.copy()
        for gear in plant.gears:
            q[:, gear.joint] += gear.deflection
            v[:, gear.joint] = gear.velocity
    return q, v


def _delayed_commands(windows: Windows, plant: Plant, sets: int) -> Array:
    """Each row's command over each physics step of its window; torques have passed the lag. Shape (rows, steps, J)."""
    take, count = windows.take, len(windows.start)
    first = windows.start[:, None] * take.substeps + np.arange(windows.length * take.substeps)
    delay, lag = (plant.delay + plant.clock_offset[:, None])[::count], plant.lag[::count]  # one a set
    torques = take.recording.position_target is None
    out = np.empty((sets, count, first.shape[1], delay.shape[1]))
    for joint in range(delay.shape[1]):
        for value in np.unique(delay[:, joint]):
            late = take.commands(float(value), joint)[:, 0]
            for k in np.flatnonzero(delay[:, joint] == value):
                command = late
                if torques and lag[k, joint]:  # a window starts with what the commands before left there, in its part
                    parts = np.split(late[:, None], take.begins[1:] * take.substeps)
                    passed = [low_pass(part, float(lag[k, joint]), float(take.model.opt.timestep)) for part in parts]
                    command = np.concatenate(passed)[:, 0]
                out[k][:, :, joint] = command[first]
    return out.reshape(sets * count, first.shape[1], -1)


def _lag_state(windows: Windows, plant: Plant, sets: int) -> Array:
    """Torque behind the lag at each window's start, of the PD law along the measured motion before it.

    Shape (rows, J).
    """
    take, count = windows.take, len(windows.start)
    r = take.recording
    assert r.kp is not None
    assert r.kd is not None
    q, v = _until_next(take.position), _until_next(take.velocity)
    late = plant.delay + plant.clock_offset[:, None]
    laws = np.stack([late, plant.kp_scale, plant.kd_scale, np.maximum(plant.lag, 1e-6)], axis=2)[::count]  # one a set
    out = np.empty((sets, count, len(r.kp)))
    for j in range(len(r.kp)):
        own, of = np.unique(laws[:, j], axis=0, return_inverse=True)  # most sets of a Jacobian leave a joint as it is
        begun = np.empty((len(own), count))
        for k, (delay, kp_scale, kd_scale, lag) in enumerate(own):
            target = take.commands(float(delay), j).reshape(len(q), -1).mean(1)
            torque = r.kp[j] * kp_scale * (target - q[:, j]) - r.kd[j] * kd_scale * v[:, j]
            keep = np.exp(-take.period / lag)
            parts = np.split(torque, take.begins[1:])
            before = [np.append(p[0], lfilter([1 - keep], [1, -keep], p, zi=[keep * p[0]])[0][:-1]) for p in parts]
            begun[k] = np.concatenate(before)[windows.start]
        out[:, :, j] = begun[of.reshape(-1)]
    return out.reshape(sets * count, -1)


def _until_next(samples: Array) -> Array:
    """Mean until the next sample. Shape (S, J) in and out."""
    return np.asarray((samples + np.vstack([samples[1:], samples[-1:]])) / 2, dtype=np.float64)


def _drive(torque: Array, plant: Plant, take: Take) -> Array:
    """Limit, scale and offset of the torque, within the motor's range. Shape (rows, steps, J) in and out."""
    low, high = torque_range(take.model, take.address)
    if np.isfinite(plant.torque_limit).any():
        torque = np.clip(torque, -plant.torque_limit[:, None], plant.torque_limit[:, None])
    return np.clip(torque * plant.torque_scale[:, None] + plant.torque_offset[:, None], low, high)


def _hold_finite(out: Array, start: Array) -> Array:
    """What has run away, from where it started by more than any joint moves in a window, keeps its last good values.

    Args:
        out: Readings [rad, m]. Shape (rows, length, J).
        start: Readings before. Shape (rows, J).
    """
    with np.errstate(invalid="ignore"):
        bad = ~(np.abs(out - start[:, None]) <= FARTHEST)  # NaN is bad
    if bad.any():
        for row in np.flatnonzero(bad.any((1, 2))):
            first = int(np.argmax(bad[row].any(1)))
            out[row, first:] = out[row, first - 1] if first else start[row]
    return out


def _cubics(values: Array, order: int, period: float, longest: float, noise: Array) -> list[tuple[Array, Array]]:
    """Local cubic fits of growing width, and the standard deviation of each. A list of (S, J), (S, J).

    ``noise`` has shape (J,) or (S, J).
    """
    flat = np.broadcast_to(noise, values.shape)
    out = [(values, flat)] if order == 0 else []
    half = 2
    while half <= max(2.0, longest / period) and 2 * half + 1 <= len(values):
        window = 2 * half + 1
        gain = [
            np.linalg.norm(savgol_coeffs(window, 3, deriv=order, delta=period, pos=at, use="dot"))
            for at in range(half + 1)
        ]
        along = np.full(len(values), gain[-1])
        along[: half + 1], along[-half - 1 :] = gain, gain[::-1]  # at the ends of the take the fit extrapolates
        out.append((savgol_filter(values, window, 3, deriv=order, delta=period, axis=0), along[:, None] * noise))
        half = int(np.ceil(1.4 * half))
    return out


def _local_fit(estimates: list[tuple[Array, Array]]) -> tuple[Array, Array]:
    """At each sample the quietest estimate that agrees with all noisier ones (Lepski 1991).

    Wide in smooth motion, narrow at a kink.

    Returns:
        The estimate and its standard deviation. Shapes (S, J).
    """
    estimates = sorted(estimates, key=lambda e: -float(np.median(e[1])))
    best, sigma = estimates[0]
    agrees = np.ones(best.shape, dtype=bool)
    for k, (value, deviation) in enumerate(estimates[1:], start=1):
        for noisier, its_deviation in estimates[:k]:
            agrees &= np.abs(value - noisier) <= 3.0 * its_deviation
        better = agrees & (deviation < sigma)
        best, sigma = np.where(better, value, best), np.where(better, deviation, sigma)
    return best, sigma


def _stamp_jitter(time: Array) -> float:
    """Standard deviation of the stamps about an even clock [s], from the median, which gaps do not move."""
    step = np.diff(time)
    return float(1.4826 * np.median(np.abs(step - np.median(step))) / np.sqrt(2))


def _interpolate(at: Array, time: Array, values: Array) -> Array:
    return np.stack([np.interp(at, time, column) for column in values.T], axis=-1)


def window_rmse(windows: Sequence[Windows], predicted: Sequence[Array]) -> tuple[Array, Array]:
    """Root mean square error of the position.

    Args:
        windows: One a take.
        predicted: Shape (W, length, J) each.

    Returns:
        Over all windows [rad, m], shape (J,), and of each window, shape (sum of W, J).
    """
    square = np.concatenate([((p - w.measured) ** 2).mean(1) for w, p in zip(windows, predicted, strict=True)])
    return rms_over(windows, square), np.sqrt(square)


def rms_over(windows: Sequence[Windows], square: Array) -> Array:
    """Root of the mean over windows, by their samples, of mean squares (sum of W, J). Shape (J,)."""
    weight = np.concatenate([np.full(len(w.start), w.length, dtype=float) for w in windows])
    return np.asarray(np.sqrt((square * weight[:, None]).sum(0) / weight.sum()), dtype=np.float64)


def motion_of(windows: Sequence[Windows]) -> Array:
    """Mean square distance from where windows start: their error where nothing moves [rad², m²]. Shape (W, J)."""
    return np.concatenate([((w.measured - w.take.measured[w.start][:, None]) ** 2).mean(1) for w in windows])
