r"""A recording in the torque domain: what inverse dynamics asks for beyond what was commanded.

Position, velocity and acceleration are projections of the samples on a Gaussian test function and its derivatives (the
weak
form: the derivative moves onto the kernel, so that noise is never differentiated twice), and the command is projected
on the same function. The *missing torque* is

.. math:: y = \mathrm{ID}(q, \dot q, \ddot q) - \tau_\mathrm{command}

and every effect of the catalogue predicts a part of it.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import mujoco
import numpy as np
from numpy.typing import NDArray
from scipy.interpolate import CubicSpline
from scipy.ndimage import gaussian_filter1d, maximum_filter1d, minimum_filter1d
from scipy.signal import welch
from scipy.sparse import csr_array

from torchrl_athletic.effects.base import BaseMotion, base_columns, base_motion, carried, free_joint
from torchrl_athletic.functional.gears import link_joint
from torchrl_athletic.recordings.noise import base_noise
from torchrl_athletic.recordings.recording import Recording, RecordingError

Array = NDArray[np.float64]

KERNEL = (0.010, 0.040)
"""Least and greatest width of the test function [s]: noise below, smoothing bias above."""
QUICKEST = 0.006
"""Least width of the test function for the take of a planned experiment [s]: the plan has counted its noise."""
HALF_POWER = float(np.sqrt(np.log(2) / 2) / np.pi)
"""Frequency that a Gaussian test function passes with half the power, times its width."""
FEWEST = 50
"""Instants of a joint from which on its torques have a say [1]."""
TRUNCATE = 7.0
"""Half width of the test function's support, in widths: at 4, the second derivative of a constant shows."""
PROMPT = 2e-4
"""Least lateness of a velocity channel at which a quick take does without it [s]."""
STUCK = 0.1
"""A joint rests where the encoder's noise hides its motion over this time [s]."""
FINE_STEP = 0.0025
"""Coarsest grid on which nonlinear features are evaluated before smoothing [s]."""


@dataclass(frozen=True)
class JointAddress:
    """Where the recorded joints are in the model. Each field has shape (J,).

    The free joint of a floating base is none of them: its motion is prescribed.
    """

    joint: NDArray[np.intp]
    qpos: NDArray[np.intp]
    dof: NDArray[np.intp]
    body: NDArray[np.intp]

    @classmethod
    def of(cls, model: mujoco.MjModel, names: tuple[str, ...], source: str = "recording") -> JointAddress:
        """Find the recorded joints.

        Raises:
            RecordingError: If the model lacks a recorded joint, or has a degree of freedom that was not recorded,
                because its motion would have to be invented; the base may float.
        """
        base = free_joint(model)
        known = {model.joint(i).name: i for i in range(model.njnt) if i != base}
        unknown = [name for name in names if name not in known]
        if unknown:
            raise RecordingError(
                f"{source}: joint_names has {unknown[0]!r}, the model has {sorted(known)}. Rename it with a "
                "column map, whose joint_names are the model's and file_joint_names the file's."
            )
        silent = sorted(set(known) - set(names))
        if silent:
            mend = "Record it, or remove the joint from the model where it was clamped."
            if silent[0] in {link_joint(model, name) for name in names}:
                mend = "It is the link behind a gear in a corrected.xml: diagnose the model that was given."
            raise RecordingError(f"{source}: joint {silent[0]!r} moves in the model but was not recorded. {mend}")
        single = (int(mujoco.mjtJoint.mjJNT_HINGE), int(mujoco.mjtJoint.mjJNT_SLIDE))
        if any(int(model.jnt_type[known[name]]) not in single for name in names):
            raise RecordingError(
                f"{source}: only hinge and slide joints can be diagnosed, of a robot whose base may float. Record "
                "the base's pose as base_position and base_orientation, and take other free bodies out of the model."
            )
        joint = np.array([known[name] for name in names], dtype=np.intp)
        return cls(joint, model.jnt_qposadr[joint], model.jnt_dofadr[joint], model.jnt_bodyid[joint])


def smooth_dynamics(model: mujoco.MjModel) -> mujoco.MjModel:
    """A copy whose inverse dynamics is smooth.

    No dry friction (effects add it), no contacts, no stops, no actuators.
    """
    copy = model.__copy__()
    copy.opt.disableflags |= int(
        mujoco.mjtDisableBit.mjDSBL_FRICTIONLOSS
        | mujoco.mjtDisableBit.mjDSBL_LIMIT
        | mujoco.mjtDisableBit.mjDSBL_CONTACT
        | mujoco.mjtDisableBit.mjDSBL_ACTUATION
    )
    return copy


def inverse_dynamics(
    model: mujoco.MjModel, address: JointAddress, q: Array, v: Array, a: Array, base: BaseMotion | None = None
) -> Array:
    """Joint torques that the motion asks for [N·m]. Shapes (N, J) in and out.

    A floating base moves as prescribed; without ``base`` it rests where the model has it.
    """
    data, torque = mujoco.MjData(model), np.empty((len(q), model.nv))
    full_q, full_v, full_a = np.tile(model.qpos0, (len(q), 1)), np.zeros_like(torque), np.zeros_like(torque)
    full_q[:, address.qpos], full_v[:, address.dof], full_a[:, address.dof] = q, v, a
    if base is not None:
        at, dof = base_columns(model)
        full_q[:, at], full_v[:, dof], full_a[:, dof] = base.pose, base.velocity, base.acceleration
    qpos, qvel, qacc, wanted = data.qpos, data.qvel, data.qacc, data.qfrc_inverse
    everything = int(mujoco.mjtStage.mjSTAGE_NONE)
    for k in range(len(q)):
        qpos[:], qvel[:], qacc[:] = full_q[k], full_v[k], full_a[k]
        mujoco.mj_inverseSkip(model, data, everything, 1)
        torque[k] = wanted
    return torque[:, address.dof]


def inertia_matrix(model: mujoco.MjModel, address: JointAddress, q: Array) -> Array:
    """Joint-space inertia at each sample, of a base that does not give way. Shape (N, J, J)."""
    return _full_inertia(model, address, q)[:, address.dof[:, None], address.dof]


def _full_inertia(model: mujoco.MjModel, address: JointAddress, q: Array) -> Array:
    """Inertia matrix of all degrees of freedom, a floating base's among them. Shape (N, nv, nv)."""
    data, out = mujoco.MjData(model), np.empty((len(q), model.nv, model.nv))
    full_q = np.tile(model.qpos0, (len(q), 1))
    full_q[:, address.qpos] = q
    qpos = data.qpos
    for k in range(len(q)):
        qpos[:] = full_q[k]
        mujoco.mj_kinematics(model, data)
        mujoco.mj_comPos(model, data)
        mujoco.mj_makeM(model, data)
        mujoco.mj_fullM(model, data, out[k])
    return out


def held_command(time: Array, command: Array, edges: Array) -> Array:
    """Mean of a zero-order-held command over each interval between edges, so that no half sample is lost.

    Args:
        time: Stamps [s]. Shape (T,).
        command: Values that hold from their stamp on. Shape (T, J).
        edges: Interval edges [s], increasing. Shape (N + 1,).

    Returns:
        Shape (N, J).
    """
    integral = np.vstack([np.zeros((1, command.shape[1])), np.cumsum(command[:-1] * np.diff(time)[:, None], axis=0)])
    out = np.empty((len(edges) - 1, command.shape[1]))
    for j in range(command.shape[1]):
        at = np.interp(edges, time, integral[:, j])
        at += np.minimum(edges - time[0], 0.0) * command[0, j] + np.maximum(edges - time[-1], 0.0) * command[-1, j]
        out[:, j] = np.diff(at) / np.diff(edges)
    return out


@dataclass(frozen=True, eq=False)
class Signals:
    """One recording, projected on the test function. N instants, J joints, M fine instants."""

    recording: Recording
    model: mujoco.MjModel
    """Smooth dynamics of the diagnosed model (see :func:`smooth_dynamics`)."""
    nominal: mujoco.MjModel
    """The diagnosed model itself."""
    address: JointAddress
    kernel: float
    """Standard deviation of the test function [s]."""
    fine_step: float
    fine_time: Array
    """Shape (M,)."""
    keep: NDArray[np.intp]
    """Fine instants at which the missing torque is evaluated. Shape (N,)."""
    position: Array
    """Shape (N, J), like the next six."""
    velocity: Array
    acceleration: Array
    command: Array
    """Projected torque command [N·m]."""
    required: Array
    """Projected torque that the motion asks for [N·m].

    Inverse dynamics of the lightly smoothed motion, then projected.
    """
    missing: Array
    """Projected missing torque [N·m]."""
    bias: Array
    """Estimate of what smoothing bends into ``missing`` [N·m]."""
    noise: Array
    """Standard deviation of ``missing`` that sensor noise explains [N·m]. Shape (J,)."""
    valid: NDArray[np.bool_]
    """False where a stop, a contact or a mask makes the torque meaningless. Shape (N, J)."""
    fine_position: Array
    """Lightly smoothed, for nonlinear features. Shape (M, J)."""
    fine_velocity: Array
    """Shape (M, J)."""
    base: BaseMotion | None = None
    """Motion of the base of a floating robot, projected like the joints. N instants."""
    fine_base: BaseMotion | None = None
    """Motion of the base, lightly smoothed. M instants."""

    @property
    def time(self) -> Array:
        """Instants of the missing torque [s]. Shape (N,)."""
        return self.fine_time[self.keep]

    @property
    def num_joints(self) -> int:
        """J."""
        return self.missing.shape[1]

    def project(self, fine: Array) -> Array:
        """Project a feature, computed from the lightly smoothed signals, on the rest of the test function.

        (M, ...) to (N, ...).
        """
        return _apply(self._projection_of_motion, fine)

    def project_command(self, fine: Array) -> Array:
        """Project something that was never smoothed, such as a held command. (M, ...) to (N, ...)."""
        return _apply(self._projection, fine)

    @cached_property
    def _projection_of_motion(self) -> csr_array:
        rest = np.sqrt(self.kernel**2 - _light(self.kernel) ** 2)
        return _projection(len(self.fine_time), self.keep, rest / self.fine_step)

    @cached_property
    def _projection(self) -> csr_array:
        return _projection(len(self.fine_time), self.keep, self.kernel / self.fine_step)

    def raw_command(self, delay: float = 0.0) -> Array:
        """The command, ``delay`` seconds late, averaged around each fine instant [N·m or rad]. Shape (M, J)."""
        edges = np.append(self.fine_time - self.fine_step / 2, self.fine_time[-1] + self.fine_step / 2)
        return held_command(self.recording.time, self.recording.command, edges - delay)

    def torque_of(self, command: Array) -> Array:
        """Torque that a projected command asks of the motors: itself, or the PD law's. Shape (N, J) to (N, J)."""
        r = self.recording
        if r.position_target is None:
            return command
        assert r.kp is not None
        assert r.kd is not None
        return r.kp * (command - self.position) - r.kd * self.velocity

    def inverse(self, model: mujoco.MjModel | None = None, position: Array | None = None) -> Array:
        """Inverse dynamics along the motion, of another model or from another position [N·m]. Shape (N, J)."""
        q = self.position if position is None else position
        return inverse_dynamics(model or self.model, self.address, q, self.velocity, self.acceleration, self.base)

    @cached_property
    def rigid(self) -> Array:
        """Inverse dynamics of the given model along the projected motion [N·m]. Shape (N, J)."""
        return self.inverse()

    @cached_property
    def load(self) -> Array:
        """Torque that gravity and springs ask for at rest [N·m]. Shape (N, J)."""
        zero = np.zeros_like(self.velocity)
        base = None if self.base is None else self.base.at_rest
        return inverse_dynamics(self.model, self.address, self.position, zero, zero, base)

    @cached_property
    def inertia(self) -> Array:
        """Joint-space inertia along the motion. Shape (N, J, J)."""
        return inertia_matrix(self.model, self.address, self.position)


def project_recording(
    recording: Recording,
    model: mujoco.MjModel,
    position_noise: Array,
    velocity_noise: Array | None = None,
    mask: NDArray[np.bool_] | None = None,
    kernel: float | None = None,
    noise_correlation: Array | None = None,
) -> Signals:
    """Project a recording on the test function.

    Args:
        recording: One take.
        model: The model to compare with.
        position_noise: Standard deviation of one position sample [rad]. Shape (J,).
        velocity_noise: Of one velocity sample [rad/s]. Shape (J,). None ignores the velocity channel.
        mask: True where a sample is not to be trusted. Shape (T, J).
        kernel: Width of the test function [s]; :func:`kernel_for` the recording if None.
        noise_correlation: Of the position's noise from one sample to the next, white if None. Shape (J,).
    """
    address = JointAddress.of(model, recording.joint_names, recording.source)
    model = carried(model)
    smooth = smooth_dynamics(model)
    period = 1.0 / recording.rate
    kernel = kernel_for([recording]) if kernel is None else kernel
    # below 1.2 samples the second derivative of a Gaussian, sampled, no longer takes a constant to zero
    fine_step = period / np.ceil(period / min(FINE_STEP, _light(kernel) / 1.2) - 1e-6)
    fine_time = recording.time[0] + fine_step * np.arange(int(recording.duration / fine_step) + 1)
    width = kernel / fine_step

    q = CubicSpline(recording.time, recording.position)(fine_time)
    gain = [_noise_gain(period, kernel, n) for n in range(3)]
    memory = [_memory_gain(period, kernel, n, noise_correlation) for n in range(3)]
    sigma_q, sigma_v, sigma_a = (g * m * position_noise for g, m in zip(gain, memory, strict=True))
    v, direct = None, np.zeros(len(address.dof), dtype=bool)
    if recording.velocity is not None and velocity_noise is not None:
        v = CubicSpline(recording.time, recording.velocity)(fine_time)
        direct = gain[1] * velocity_noise < 0.5 * sigma_a  # a drive's velocity may be filtered: only for a clear gain
        if kernel < KERNEL[0]:  # of a take that is to tell lags from delays: not with one of its own
            loud = position_noise * _noise_gain(period, KERNEL[0], 2)
            loud = loud * _memory_gain(period, KERNEL[0], 2, noise_correlation)
            direct &= np.abs(_lateness(q, v, fine_step, loud)) < PROMPT
        sigma_v = np.where(direct, gain[0] * velocity_noise, sigma_v)
        sigma_a = np.where(direct, gain[1] * velocity_noise, sigma_a)

    def motion(seconds: float) -> tuple[Array, Array, Array]:
        return _motion(q, v, direct, seconds / fine_step, fine_step)

    def base(seconds: float) -> BaseMotion | None:
        return base_motion(recording, model, fine_time, seconds)

    edge = int(np.ceil(5 * width))
    if len(fine_time) < 2 * edge + 50:
        raise RecordingError(
            f"{recording.source}: the take lasts {recording.duration:.2f} s, at least "
            f"{(2 * edge + 50) * fine_step:.2f} s are needed to see a motion in it. Leave it out."
        )
    keep = np.arange(edge, len(fine_time) - edge, max(1, int(0.8 * width)))
    light, coarse = _light(kernel), min(2 * _light(kernel), kernel)
    fine_q, fine_v, fine_a = motion(light)
    fine_base, whole_base = base(light), base(kernel)
    position, velocity, acceleration = (x[keep] for x in motion(kernel))
    empty = np.zeros_like(position)
    draft = Signals(
        recording=recording,
        model=smooth,
        nominal=model,
        address=address,
        kernel=kernel,
        fine_step=fine_step,
        fine_time=fine_time,
        keep=keep,
        position=position,
        velocity=velocity,
        acceleration=acceleration,
        command=empty,
        required=empty,
        missing=empty,
        bias=empty,
        noise=np.zeros(len(address.dof)),
        valid=np.ones(empty.shape, dtype=np.bool_),
        fine_position=fine_q,
        fine_velocity=fine_v,
        base=None if whole_base is None else whole_base[keep],
        fine_base=fine_base,
    )
    required = inverse_dynamics(smooth, address, fine_q, fine_v, fine_a, fine_base)
    required = draft.project(required) + _nominal_dry_friction(draft)
    rougher = inverse_dynamics(smooth, address, *motion(coarse), base(coarse))
    rest = np.sqrt(kernel**2 - coarse**2)
    rougher = (_gaussian(rougher, rest / fine_step) if rest > 0 else rougher)[keep] + _nominal_dry_friction(draft)
    torque = _limited(draft, draft.torque_of(draft.project_command(draft.raw_command())))
    noise = np.sqrt(
        np.mean((draft.inertia**2 @ (sigma_a**2)[:, None])[..., 0], axis=0) + (_damping(draft) * sigma_v) ** 2
    )
    if fine_base is not None:
        noise = np.hypot(noise, _noise_of_base(draft, gain[2] * base_noise(recording)))
    if recording.kp is not None and recording.kd is not None:  # the torque is computed from the readings
        noise = np.sqrt(noise**2 + (recording.kp * sigma_q) ** 2 + (recording.kd * sigma_v) ** 2)
    return replace(
        draft,
        required=required,
        command=torque,
        missing=required - torque,
        bias=(rougher - required) / ((coarse / light) ** 2 - 1),  # grows with the square of the width
        noise=noise,
        valid=_valid(draft, mask) & ~_stuck(draft, position_noise),
    )


def kernel_for(recordings: Sequence[Recording], noise: Array | None = None, least: float = KERNEL[0]) -> float:
    """Width of the test function that passes the band in which the robot moves: 99 % of the velocity's power [s].

    Above that band there is little to learn and much to be misled by, since flexible parts ring there.

    Args:
        recordings: Of one test function.
        noise: Standard deviation of a position reading [rad, m], shape (J,): twice its power is no motion. One slow
            take asks for this, where noise may have a hundredth of the power.
        least: Least width [s].
    """
    widest = []
    for r in recordings:
        period = 1.0 / r.rate
        time = np.arange(r.time[0], r.time[-1], period)
        position = np.stack([np.interp(time, r.time, q) for q in r.position.T], -1)
        velocity = _gaussian(position, max(least / period, 1.0), order=1)
        frequency, power = welch(velocity, 1 / period, nperseg=min(len(time), int(4 / period)), axis=0)
        if noise is not None:
            omega = 2 * np.pi * frequency[:, None]
            width = max(least, period)
            passed = 2 * period * (omega * period * noise) ** 2 * np.exp(-((omega * width) ** 2))
            power = np.maximum(power - 2 * passed, 0.0)
        moving = power.sum(0) > 0
        if moving.any():
            share = np.cumsum(power[:, moving], 0) / power[:, moving].sum(0)
            widest.append(float(frequency[(share > 0.99).argmax(0)].max()))
    band = float(np.quantile(widest, 0.75)) if widest else 1.0
    return max(float(np.clip(HALF_POWER / max(band, 1e-3), least, KERNEL[1])), *(1.2 / r.rate for r in recordings))


def bristle(position: Array, width: float) -> Array:
    r"""Direction of sliding in [-1, 1], which turns over within a presliding ``width`` [rad] of a reversal.

    The exact solution of :math:`dz = (\mathrm{sign}(dq) - z)\,|dq| / w` along the motion (Dahl 1968).

    Args:
        position: Shape (M,).
        width: w > 0 [rad].

    Returns:
        Shape (M,).
    """
    step = np.diff(position)
    direction = np.sign(step)
    moving = np.flatnonzero(direction)
    z = np.zeros(len(position))
    if not len(moving):
        return z
    starts = moving[np.flatnonzero(np.diff(direction[moving], prepend=0.0))]  # first step of each run in one direction
    path = np.concatenate([[0.0], np.cumsum(np.abs(step))])
    state = direction[starts[0]]
    z[: starts[0] + 1] = state
    for start, stop in zip(starts, [*starts[1:], len(step)], strict=True):
        run = slice(start + 1, stop + 1)
        z[run] = direction[start] + (state - direction[start]) * np.exp(-(path[run] - path[start]) / width)
        state = z[stop]
    return z


def joint_feature(s: Signals, joint: int, feature: Callable[[Array, Array], Array]) -> Array:
    """Project ``feature(position (M,), velocity (M,)) -> (M,)`` of one joint. Shape (N,)."""
    return s.project(feature(s.fine_position[:, joint], s.fine_velocity[:, joint]))


def presliding_width(s: Signals, joint: int) -> float:
    """A presliding width that suits the joint's travel and encoder.

    1.5 mrad on a joint that moves a radian [rad, m].
    """
    travel = float(np.ptp(s.fine_position[:, joint]))
    return max(1.5e-3 * min(travel, 1.0), 1e-9)


def _gaussian(x: Array, width: float, order: int = 0) -> Array:
    """Project on a Gaussian or its derivative along the first axis."""
    return gaussian_filter1d(x, width, axis=0, order=order, mode="nearest", truncate=TRUNCATE)


def _projection(length: int, keep: NDArray[np.intp], width: float) -> csr_array:
    """Projection at some instants only, as a matrix. Shape (N, M)."""
    taps = np.arange(-int(TRUNCATE * width + 0.5), int(TRUNCATE * width + 0.5) + 1)
    weight = np.exp(-0.5 * (taps / max(width, 1e-12)) ** 2)
    columns = np.clip(keep[:, None] + taps, 0, length - 1)
    rows = np.repeat(np.arange(len(keep)), len(taps))
    weights = np.tile(weight / weight.sum(), len(keep))
    return csr_array((weights, (rows, columns.ravel())), shape=(len(keep), length))


def _apply(projection: csr_array, fine: Array) -> Array:
    flat = projection @ fine.reshape(len(fine), -1)
    return np.asarray(flat).reshape(-1, *fine.shape[1:])


def sliding_direction(s: Signals, joint: int) -> Array:
    """Projected direction of sliding of a joint, rounded over its presliding width. Shape (N,)."""
    width = presliding_width(s, joint)
    return joint_feature(s, joint, lambda q, v: bristle(q, width))


def _lateness(q: Array, v: Array, step: float, noise: Array) -> Array:
    """How much later a velocity channel is than the position's derivative [s]. Shape (J,).

    Infinite where the ``noise`` of the acceleration [rad/s²] hides it.
    """
    width = KERNEL[0] / step
    speed, gain = _gaussian(q, width, 1) / step, _gaussian(q, width, 2) / step**2
    moved = (gain**2).mean(0) - noise**2
    late = -((_gaussian(v, width) - speed) * gain).mean(0) / np.maximum(moved, 1e-300)
    return np.where(moved > noise**2, late, np.inf)


def _light(kernel: float) -> float:
    """Width that motion is smoothed with before anything nonlinear is computed from it [s]."""
    return min(0.5 * kernel, KERNEL[0])


def _motion(
    q: Array, v: Array | None, direct: NDArray[np.bool_], width: float, step: float
) -> tuple[Array, Array, Array]:
    """Smoothed position, velocity and acceleration; from the velocity channel where ``direct``. Shapes (M, J)."""
    position, velocity, acceleration = (_gaussian(q, width, order=n) / step**n for n in range(3))
    if v is not None:
        velocity = np.where(direct, _gaussian(v, width), velocity)
        acceleration = np.where(direct, _gaussian(v, width, order=1) / step, acceleration)
    return position, velocity, acceleration


def _noise_gain(period: float, kernel: float, order: int) -> float:
    """Standard deviation of the projected derivative for unit white noise on the samples.

    The norm of the kernel's derivative.
    """
    integral = (1 / 2, 1 / 4, 3 / 8)[order] / (np.sqrt(np.pi) * kernel ** (2 * order + 1))
    return float(np.sqrt(period * integral))


def _memory_gain(period: float, kernel: float, order: int, correlation: Array | None) -> Array | float:
    """How much more of noise with a memory passes than of white noise with the same deviation. Shape (J,)."""
    if correlation is None:
        return 1.0
    omega = np.linspace(0.0, np.pi / period, 2000)
    passed = omega ** (2 * order) * np.exp(-((omega * kernel) ** 2))
    rho = correlation[:, None]
    density = (1 - rho**2) / (1 + rho**2 - 2 * rho * np.cos(omega * period))
    return np.asarray(np.sqrt((density * passed).sum(1) / passed.sum()))


def _limited(s: Signals, torque: Array) -> Array:
    """Clip at the model's actuator force range, which the simulation obeys too."""
    low, high = torque_range(s.nominal, s.address)
    return np.clip(torque, low, high)


def torque_range(model: mujoco.MjModel, address: JointAddress) -> tuple[Array, Array]:
    """Least and greatest torque of each recorded joint's motor, infinite where the model states none [N·m].

    Shapes (J,).
    """
    low, high = np.full(len(address.joint), -np.inf), np.full(len(address.joint), np.inf)
    for j, joint in enumerate(address.joint):
        drives = [
            i
            for i in map(int, np.flatnonzero(model.actuator_ctrlnum))  # without an input it is friction or cogging
            if model.actuator_trntype[i] == mujoco.mjtTrn.mjTRN_JOINT and model.actuator_trnid[i, 0] == joint
        ]
        if drives:  # several motors on one joint add up
            ranges = [_motor_range(model, i) for i in drives]
            low[j], high[j] = np.sum(ranges, axis=0)
        if model.jnt_actfrclimited[joint]:
            low[j] = max(low[j], model.jnt_actfrcrange[joint, 0])
            high[j] = min(high[j], model.jnt_actfrcrange[joint, 1])
    return low, high


def _motor_range(model: mujoco.MjModel, actuator: int) -> tuple[float, float]:
    """Joint torque that one actuator can give, as its force limits and, of a plain motor, its control limits say."""
    low, high = -np.inf, np.inf
    if model.actuator_forcelimited[actuator]:
        low, high = model.actuator_forcerange[actuator]
    kind = model.actuator_gaintype[actuator], model.actuator_biastype[actuator]
    is_motor = kind == (mujoco.mjtGain.mjGAIN_FIXED, mujoco.mjtBias.mjBIAS_NONE)
    control = model.actuator_ctrladr[actuator]
    if is_motor and model.actuator_ctrllimited[control]:
        ends = model.actuator_gainprm[actuator, 0] * model.actuator_ctrlrange[control]
        low, high = max(low, ends.min()), min(high, ends.max())
    gear = model.actuator_gear[model.actuator_outadr[actuator], 0] or 1.0
    ends = np.array([gear * low, gear * high])
    return float(ends.min()), float(ends.max())


def _nominal_dry_friction(s: Signals) -> Array:
    loss = s.nominal.dof_frictionloss[s.address.dof]
    friction = np.zeros_like(s.position)
    for j in map(int, np.flatnonzero(loss)):
        friction[:, j] = loss[j] * sliding_direction(s, j)
    return friction


def _noise_of_base(s: Signals, noise: Array) -> Array:
    """Torque that noise of the base's linear and angular acceleration, shape (2,), asks of the joints. Shape (J,)."""
    _, base = base_columns(s.model)
    coupling = _full_inertia(s.model, s.address, s.position)[:, s.address.dof, base]
    return np.asarray(np.sqrt((coupling**2 @ np.repeat(noise**2, 3)).mean(0)), dtype=np.float64)


def _damping(s: Signals) -> Array:
    return s.model.dof_damping[s.address.dof].reshape(len(s.address.dof), -1)[:, 0]


def _stuck(s: Signals, position_noise: Array) -> NDArray[np.bool_]:
    """Where a joint rests: static friction takes any torque up to its limit then, so that no torque is missing there.

    Shape (N, J).
    """
    size = 2 * int(STUCK / s.fine_step / 2) + 1
    moved = maximum_filter1d(s.fine_position, size, axis=0) - minimum_filter1d(s.fine_position, size, axis=0)
    return np.asarray((moved <= 6 * position_noise)[s.keep], dtype=np.bool_)


def _valid(s: Signals, mask: NDArray[np.bool_] | None) -> NDArray[np.bool_]:
    """Not masked, and more than 0.03 rad (3 % of a slide's travel) from a stop for 4 kernels around."""
    bad = np.zeros(s.fine_position.shape, dtype=bool)
    for j, joint in enumerate(s.address.joint):
        if s.nominal.jnt_limited[joint]:
            low, high = s.nominal.jnt_range[joint]
            margin = 0.03 if s.nominal.jnt_type[joint] == mujoco.mjtJoint.mjJNT_HINGE else 0.03 * (high - low)
            bad[:, j] = (s.fine_position[:, j] < low + margin) | (s.fine_position[:, j] > high - margin)
    if mask is not None:
        after = np.searchsorted(s.recording.time, s.fine_time).clip(0, len(mask) - 1)
        bad |= mask[after] | mask[np.maximum(after - 1, 0)]
    spread = _gaussian(bad.astype(float), 1.5 * s.kernel / s.fine_step)[s.keep]
    return spread < 1e-3
