"""From recordings to what the other stages work on.

Checked, split at gaps, projected, and put on the simulation's grid.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any, Literal, get_args

import mujoco
import numpy as np
from numpy.typing import NDArray

from torchrl_athletic.diagnosis.replay import Take, join, take_of
from torchrl_athletic.effects import JointAddress, Signals, project_recording
from torchrl_athletic.effects.base import Base, base_columns, free_joint, held_base, pose_of
from torchrl_athletic.effects.payload import with_payload
from torchrl_athletic.effects.signals import QUICKEST, kernel_for, torque_range
from torchrl_athletic.recordings import (
    Quality,
    Recording,
    RecordingError,
    check_quality,
    repeat_noise,
    split_at_gaps,
)
from torchrl_athletic.recordings.base import base_moves
from torchrl_athletic.recordings.misread import mended
from torchrl_athletic.recordings.quality import with_known_base
from torchrl_athletic.recordings.recording import BEGAN, MEAN_READING

Array = NDArray[np.float64]
Drive = Literal["command", "measured"]

SAME_RATE = 0.002
"""Relative difference of sampling rates below which takes share a grid."""
LOOKS = 500
"""Instants of a take at which contact is looked for."""
BRIDGED = 2.0
"""Widths of the test function that good readings may be apart for those between them to be told by them: between many
good ones a cubic misses one part in 24 of a motion at the end of its band, and less of slower ones [1]."""
PAYLOAD = "payload_kg"
"""Key of a recording's metadata: known mass fastened to the far end of the last link, which the model lacks [kg]."""


@dataclass(frozen=True, eq=False)
class Prepared:
    """One set of recordings, ready to be compared with a model."""

    quality: tuple[Quality, ...]
    """One a recording."""
    signals: tuple[Signals, ...]
    """In the torque domain, one a gap-free piece that is long enough."""
    takes: tuple[Take, ...]
    """On the simulation's grid, gap-free pieces of a kind joined."""
    position_noise: Array
    """Standard deviation of one reading, the median over the recordings [rad, m]. Shape (J,)."""
    repeatability: Array | None
    """Scatter between repeats of the same take [rad, m], shape (J,), when there are any that followed targets."""
    left_out: tuple[str, ...] = ()
    """Why pieces were left out: too short to see a motion in."""

    def used_share(self) -> dict[str, float]:
        """Share of the instants that say something of a joint.

        It moves, clear of its stops, and no reading is masked.
        """
        valid = np.concatenate([s.valid for s in self.signals])
        return dict(zip(self.signals[0].recording.joint_names, valid.mean(0).tolist(), strict=True))

    def report(self) -> dict[str, Any]:
        """The part of ``diagnosis.json`` on quality."""
        reports = [q.report() for q in self.quality]
        for report in reports:
            report["warnings"] = [w.removeprefix(f"{report['source']}: ") for w in report["warnings"]]
        return {"recordings": reports, "used_share": self.used_share(), "left_out": list(self.left_out)}


def prepare(
    recordings: Sequence[Recording],
    model: mujoco.MjModel,
    drive: Drive = "command",
    kernel: float | None = None,
    joined: int = 0,
    xml: str = "",
) -> Prepared:
    """Check, split and project recordings.

    Args:
        recordings: Takes of the same joints.
        model: The model to compare them with.
        drive: Whether the commanded or the measured torque drives the simulation.
        kernel: Width of the test function [s]; chosen for the recordings if None.
        joined: How many of the recordings, the last ones, are of experiments that were planned. Each has a test
            function for its own band, which was chosen to show something.
        xml: MJCF of the model, for takes with a known weight fastened to the last link (:data:`PAYLOAD`).

    Raises:
        RecordingError: If there is no recording, if the joints differ between them or from the model's, or if nothing
        usable is left.
    """
    if not recordings:
        raise RecordingError("no recordings: name a file or a folder that holds at least one.")
    first = recordings[0]
    recordings = [r.ordered(first.joint_names) for r in recordings]
    if drive == "measured":
        recordings = [r.driven_by_measured_torque() for r in recordings]
    limit = _limit(model, JointAddress.of(model, first.joint_names, first.source))
    old = len(recordings) - joined
    checked = _with_known_noise([check_quality(r, limit) for r in recordings], old)
    kernel = kernel_for(recordings[:old] or recordings) if kernel is None else kernel
    kernels = [kernel] * old + [
        kernel_for([r], q.position_noise, QUICKEST) for r, q in zip(recordings[old:], checked[old:], strict=True)
    ]
    pairs = [mended(r, q, BRIDGED * own, limit) for r, q, own in zip(recordings, checked, kernels, strict=True)]
    recordings, quality = [r for r, _ in pairs], tuple(_with_known_noise([q for _, q in pairs], old))
    signals: list[Signals] = []
    takes: list[Take] = []
    left_out: list[str] = []
    for r, q, own, period in zip(recordings, quality, kernels, _periods(recordings), strict=True):
        carried = carrying(model, xml, r)
        known = with_known_base(r)  # a lost pose must not push the base of a replay
        unfit = _unfit(q)[np.isin(r.time, known.time)]
        refuse_stance(known, model)
        for piece in _pieces(known):
            start = int(np.searchsorted(known.time, piece.time[0]))
            mask = unfit[start : start + piece.num_samples]
            velocity_noise = q.velocity_noise if _velocity_fits(q) else None
            try:
                s = project_recording(piece, carried, q.position_noise, velocity_noise, mask, own, q.noise_correlation)
            except RecordingError as error:
                left_out.append(str(error))
                continue
            signals.append(s)
            takes.append(take_of(piece, carried, q.position_noise, velocity_noise, q.noise_correlation, period))
    if not signals:
        raise RecordingError(left_out[0])
    if not any(s.valid.any() for s in signals):
        raise RecordingError(
            f"{first.source}: no joint moves, or all is masked. "
            "Excite the joints, clear of their stops, and record again."
        )
    noise = np.median([q.position_noise for q in quality], axis=0)
    # a loop brings repeats back together; pushed by torques they drift apart, however well a window is followed
    held = [r for r in recordings if r.position_target is not None]
    repeatable = [r for r in held if not base_moves(r)]  # nobody carries a robot twice the same way
    return Prepared(quality, tuple(signals), tuple(join(takes)), noise, repeat_noise(repeatable), tuple(left_out))


def stood(recording: Recording, model: mujoco.MjModel, base: Base) -> Recording:
    """The recording with the base where the model has it, if it is said to be fixed.

    Raises:
        RecordingError: If its pose was recorded.
    """
    if base not in get_args(Base):
        raise ValueError(f"base is {base!r}, needed is one of {', '.join(map(repr, get_args(Base)))}.")
    if base == "fixed" and free_joint(model) is not None and recording.base_position is not None:
        raise RecordingError(
            f"{recording.source}: base_position was recorded, and base is said to be 'fixed'. Leave one out: the "
            "recorded pose may be constant."
        )
    return recording if base == "recorded" else held_base(recording, model)


def refuse_stance(recording: Recording, model: mujoco.MjModel) -> None:
    """Refuse a take in which a floating robot touches the world of its model, at up to :data:`LOOKS` instants.

    A base that never moves may be held elsewhere than the model's floor is: nothing is asked of it.

    Raises:
        RecordingError: If it does, since nobody recorded the forces there.
    """
    pose = pose_of(recording, model)
    if pose is None or not base_moves(recording):
        return
    address, data = JointAddress.of(model, recording.joint_names, recording.source), mujoco.MjData(model)
    at, _ = base_columns(model)
    standing = model.body_weldid[model.geom_bodyid] == 0
    rows = np.linspace(0, recording.num_samples - 1, min(LOOKS, recording.num_samples)).astype(int)
    touching = []
    for row in rows:
        data.qpos[at], data.qpos[address.qpos] = pose[row], recording.position[row]
        mujoco.mj_kinematics(model, data)
        mujoco.mj_collision(model, data)
        pairs = data.contact.geom[data.contact.dist < 0]
        touching.append(bool(standing[pairs].any()))
    if any(touching):
        raise RecordingError(
            f"{recording.source}: the robot touches the world of the model in {np.mean(touching):.0%} of the take, "
            f"first at {recording.time[rows[int(np.argmax(touching))]]:.3f} s, and nobody recorded the forces there. "
            "Cut the take to where its legs are in the air; or take the floor out of the model, if it hung above one."
        )


def _with_known_noise(quality: Sequence[Quality], old: int) -> list[Quality]:
    """Put the earlier recordings' noise into the quality of takes of experiments.

    The sensors are the same, and a motion with few samples a period looks like noise.
    """
    known = quality[:old]
    if not known:
        return list(quality)
    position = np.median([q.position_noise for q in known], axis=0)
    correlation = np.median([q.noise_correlation for q in known], axis=0)
    speeds = [q.velocity_noise for q in known if q.velocity_noise is not None]
    velocity = np.median(speeds, axis=0) if speeds else None
    told = [replace(q, position_noise=position, noise_correlation=correlation) for q in quality[old:]]
    return [*known, *(q if q.velocity_noise is None else replace(q, velocity_noise=velocity) for q in told)]


def carrying(model: mujoco.MjModel, xml: str, recording: Recording) -> mujoco.MjModel:
    """The model with what a take says was fastened to the last link (:data:`PAYLOAD`); itself without.

    Args:
        model: The robot.
        xml: Its MJCF, which is read only where something was fastened.
        recording: In the order of joints whose last one moves the link that carries.

    Raises:
        RecordingError: If the mass is negative or not finite, or if there is one and no MJCF.

    Example:
        >>> from torchrl_athletic.robots.benches import pendulum
        >>> xml = pendulum()
        >>> bare, time = mujoco.MjModel.from_xml_string(xml), np.arange(10) / 100
        >>> still = np.zeros((10, 1))
        >>> take = Recording(time, ("pendulum",), still, torque_command=still, metadata={"payload_kg": 2.0})
        >>> float(carrying(bare, xml, take).body_mass.sum() - bare.body_mass.sum())
        2.0
    """
    mass = float(recording.metadata.get(PAYLOAD, 0.0))
    if not 0.0 <= mass < np.inf:
        raise RecordingError(f"{recording.source}: {PAYLOAD} is {mass}. A mass of 0 kg or more was needed.")
    if mass and not xml:
        raise RecordingError(f"{recording.source}: {mass:g} kg were fastened, so that the model's MJCF is needed: xml.")
    return with_payload(xml, recording.joint_names, mass) if mass else model


def _velocity_fits(q: Quality) -> bool:
    """Whether the velocity channel is the derivative of the position, in the same unit."""
    return all(scale is None or 0.8 < scale < 1.25 for scale in q.velocity_scale)


def drive_signals(prepared: Prepared) -> tuple[Signals, ...]:
    """The way from the command to the measured torque alone, in the same form: what the drive leaves out or adds."""
    out = []
    for s in prepared.signals:
        measured = s.recording.torque_measured
        assert measured is not None
        fine = np.stack([np.interp(s.fine_time, s.recording.time, column) for column in measured.T], -1)
        received = s.project_command(fine)
        noise = _torque_noise(measured) * np.sqrt(1 / s.recording.rate / (2 * np.sqrt(np.pi) * s.kernel))
        missing = received - s.command
        out.append(replace(s, required=received, missing=missing, bias=np.zeros_like(missing), noise=noise))
    return tuple(out)


def _unfit(quality: Quality) -> NDArray[np.bool_]:
    """What not to judge the missing torque by.

    A wrong reading of one joint asks for torque at all that it is coupled to. Shape (T, J).
    """
    misread = (quality.masks["frozen"] | quality.masks["dropout"]).any(1, keepdims=True)
    return np.asarray(~quality.usable() | misread, dtype=np.bool_)


def _torque_noise(measured: Array) -> Array:
    spread = 1.4826 * np.median(np.abs(np.diff(measured, 4, axis=0)), axis=0) / np.sqrt(70)
    return np.maximum(spread, 1e-4 * np.abs(measured).max(0) + 1e-12)


def _limit(model: mujoco.MjModel, address: JointAddress) -> Array | None:
    low, high = torque_range(model, address)
    limit = np.minimum(-low, high)
    return limit if np.isfinite(limit).all() and (limit > 0).all() else None


def _pieces(recording: Recording) -> list[Recording]:
    pieces = split_at_gaps(recording)
    if len(pieces) == 1:
        return [recording]
    whole = {**recording.metadata, BEGAN: recording.began, MEAN_READING: recording.mean_reading}
    return [replace(p, source=recording.source, metadata=whole) for p in pieces]


def _periods(recordings: Sequence[Recording]) -> list[float]:
    """Period of each recording's grid [s]: that of the first that was logged at its rate, whatever the jitter."""
    out: list[float] = []
    for own in (1.0 / r.rate for r in recordings):
        out.append(next((p for p in out if abs(own / p - 1.0) < SAME_RATE), own))
    return out
