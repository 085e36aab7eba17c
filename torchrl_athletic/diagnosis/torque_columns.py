"""Whether the torques of a log are those of its joints: their signs, their columns, and whether they are torques.

The motion of a joint asks for a torque: what inverse dynamics says, more of it against a rotor, and what friction and
damping hold back. However wrong the numbers of a model are, none of these parts is negative. A log whose torque does
not follow their sum, at no delay, or follows it only when it is turned round, was likely mixed up before it came here.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import nnls

from torchrl_athletic.diagnosis.prepare import Prepared
from torchrl_athletic.diagnosis.standard import NO_TORQUE
from torchrl_athletic.effects.signals import FEWEST, Signals
from torchrl_athletic.recordings.mixed_up import exchange_sentence, mixed_up, target_doubts

Array = NDArray[np.float64]

HALF = 0.5
"""Share of a torque that its joint's motion explains, from which the two belong together [1]."""
LITTLE = 0.3
"""Share below which they do not; a motor that gives far less than it is asked for is between the two [1]."""
DELAYS = (0.02, 0.05, 0.1)
"""Lateness of a drive that is no mistake of its log [s]."""


def column_doubts(train: Prepared, held: Prepared | None = None) -> tuple[str, ...]:
    """:func:`torque_doubts`, and what is wrong with targets, each thing once."""
    sets = [part for part in (train, held) if part is not None]
    targets = [text for part in sets for s in part.signals for text in target_doubts(s.recording, part.position_noise)]
    return tuple(dict.fromkeys([*torque_doubts(train, held), *targets]))


def torque_doubts(train: Prepared, held: Prepared | None = None) -> tuple[str, ...]:
    """What is wrong with the torques that drive the joints, in sentences with the mend.

    Nothing is said of joints that follow targets, that hardly move, or whose motors are off.

    Args:
        train: Recordings to fit.
        held: Those kept aside. What is wrong with these too is said once.
    """
    fitted = [*_doubts(train.signals)]
    aside = [] if held is None else [*_doubts(held.signals)]
    known = {about for about, _ in fitted}
    return (*(text for _, text in fitted), *(f"Kept aside, {text}" for about, text in aside if about not in known))


def _doubts(signals: Sequence[Signals]) -> Iterator[tuple[tuple[object, ...], str]]:
    """What is said, and of which joints, with the sentence."""
    driven = [s for s in signals if s.recording.position_target is None]
    if not driven:
        return
    names = driven[0].recording.joint_names
    shares, against = explained(driven)
    own, turned = np.diag(shares), np.diag(against)
    if (own < HALF).any() or (turned > HALF).any():  # a late drive is none of it
        own = np.max([own, *(np.diag(explained(driven, delay)[0]) for delay in DELAYS)], axis=0)
    known: list[int] = np.flatnonzero(~np.isnan(own)).tolist()
    left = np.nan_to_num(1.0 - shares[np.ix_(known, known)], nan=1.0)
    left[np.diag(own[known] >= HALF)] = 0.0  # in order as it is, whatever else would explain it
    pairs = [(known[j], known[k]) for j, k in mixed_up(left)]
    exchanged = tuple(j for j, _ in pairs)
    if pairs:
        yield ("exchanged", *exchanged), exchange_sentence(names, "torque", pairs)
    for j in known:
        if j in exchanged:
            continue
        about = f"the torque of {names[j]} has"
        if turned[j] > HALF and 1.0 - turned[j] < HALF * (1.0 - own[j]):
            yield (
                ("turned", j),
                f"{about} the other sign than its motion: the model, a rotor and friction explain {own[j]:.0%} of it, "
                f"and {turned[j]:.0%} where it is turned round. Flip it, or the joint's axis in the model. A spring or "
                "a counterweight that the model lacks, or a very late drive, could look like this, too.",
            )
        elif own[j] < LITTLE and (share := explained_by_any(driven, j)) < LITTLE:
            yield (
                ("little", j),
                f"{about} little to do with its motion: the model, a rotor, friction, springs and weights explain "
                f"{share:.0%} of it. Ask whether it is the torque of this joint, and whether the motor gave what it "
                "was asked for. What is fitted to it may say nothing.",
            )


def explained(signals: Sequence[Signals], delay: float = 0.0) -> tuple[Array, Array]:
    """Share of each torque, and of each turned round, that the motion of each joint explains by positive parts [1].

    The parts are the model's torque, the acceleration, and friction and damping. Each recording counts about its mean:
    a sensor may have another zero in each.

    Args:
        signals: Recordings in the torque domain, of the same joints.
        delay: How late the torques act [s].

    Returns:
        Two of shape (joints, columns); nan where a joint moves in fewer than :data:`FEWEST` instants, or there is no
        torque.
    """
    count = signals[0].num_joints
    out = np.full((2, count, count), np.nan)
    torques = [s.project_command(s.raw_command(delay)) if delay else s.command for s in signals]
    for j in range(count):
        speed = [s.velocity[:, j] for s in signals]
        parts = [
            np.stack([s.required[:, j], s.acceleration[:, j], np.sign(v), v], axis=1)
            for s, v in zip(signals, speed, strict=True)
        ]
        columns, torque = _where_it_moves(signals, j, parts, torques)
        if len(torque):
            triangle: Array = np.asarray(np.linalg.qr(np.hstack([columns, torque]), mode="r"))
            first = columns.shape[1]
            for k, column in enumerate(triangle[:, first:].T):
                whole = float(column @ column)
                if whole > NO_TORQUE**2 * len(torque):
                    for n, sign in enumerate((1.0, -1.0)):
                        out[n, j, k] = 1.0 - min(nnls(triangle[:, :first], sign * column)[1] ** 2 / whole, 1.0)
    return out[0], out[1]


def explained_by_any(signals: Sequence[Signals], joint: int) -> float:
    """Share of a joint's torque that any part of any sign explains, springs and weights that nobody knows too [1]."""
    parts = [
        np.stack([s.required[:, joint], s.acceleration[:, joint], np.sign(v), v, q, np.sin(q), np.cos(q)], axis=1)
        for s in signals
        for q, v in [(s.position[:, joint], s.velocity[:, joint])]
    ]
    columns, torque = _where_it_moves(signals, joint, parts, [s.command for s in signals])
    own = torque[:, joint]
    error = own - columns @ np.linalg.lstsq(columns, own, rcond=None)[0]
    return 1.0 - float(error @ error) / float(own @ own)


def _where_it_moves(
    signals: Sequence[Signals], joint: int, parts: Sequence[Array], torques: Sequence[Array]
) -> tuple[Array, Array]:
    """Parts (M, P) and torques (M, J) where a joint moves, about their means in each recording; none if too few."""
    valid = [s.valid[:, joint] for s in signals]
    columns, torque = (
        np.concatenate([x[v] - x[v].mean(0) for x, v in zip(of, valid, strict=True) if v.any()] or [of[0][:0]])
        for of in (parts, torques)
    )
    if len(columns) < FEWEST:
        return columns[:0], torque[:0]
    return columns / np.maximum(columns.std(0), 1e-12), torque
