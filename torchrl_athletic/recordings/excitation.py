"""Commands that make a robot show its physics: the paper's square, sine and Gaussian torques, chirps and multisines."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Literal

import numpy as np
from numpy.typing import ArrayLike, NDArray

CommandField = Literal["torque_command", "position_target"]
Floats = NDArray[np.float64]

DEFAULT_FREQUENCIES = (0.5, 1.0, 2.0, 4.0)
"""Frequencies of :func:`amplitude_frequency_pairs` [Hz]: two seconds hold whole periods of each."""


class ExcitationError(ValueError):
    """A signal that must not be sent; the message says what exceeds what, and the mend."""


@dataclass(frozen=True, eq=False)
class Excitation:
    """A command to replay on the robot. A sample stamped ``t`` is held until the next stamp."""

    time: Floats
    """Uniform stamps from 0 [s]. Shape (T,)."""
    command: Floats
    """Torque [N·m, N] or position target [rad, m]. Shape (T, J)."""
    joint_names: tuple[str, ...]
    """Length J."""
    kind: str
    """'square', 'sine', 'gaussian', 'chirp' or 'multisine'."""
    field: CommandField
    """The field of :class:`~torchrl_athletic.recordings.Recording` that this command fills."""
    metadata: Mapping[str, Any]
    """JSON-compatible: all parameters, the seed, and how many samples were clipped. Goes well into a recording's."""


@dataclass(frozen=True)
class Safety:
    """What keeps a command inside what robot and operator can take.

    The order is: fade, then centre, then slew, then limit.
    """

    limit: ArrayLike | None = None
    """Largest magnitude, one number or (J,); or lowest and highest value, (J, 2), as position targets need it. In the
    unit of the command. None: no limit is known, so none is checked."""
    clip: bool = False
    """Clip what exceeds ``limit``. Without it such a signal is refused, since a clipped one is no longer the asked
    one."""
    slew: ArrayLike | None = None
    """Fastest change [unit of the command / s], one number or (J,). Steps become ramps."""
    fade: float = 0.0
    """Raised-cosine fade in and out, each of this length [s]."""
    centre: ArrayLike = 0.0
    """Added to the signal, one number or (J,): the pose about which a position target moves, or a torque that bears a
    load."""


def amplitude_frequency_pairs(
    largest: float, shares: Sequence[float] = (1 / 3, 2 / 3, 1.0), frequencies: Sequence[float] = DEFAULT_FREQUENCIES
) -> tuple[tuple[float, float], ...]:
    """Every share of the largest amplitude at every frequency: 3 x 4 = 12 pairs, as many as the paper sweeps.

    Args:
        largest: Largest amplitude [unit of the command].
        shares: Shares of it [1].
        frequencies: [Hz].

    Returns:
        Pairs (amplitude, frequency [Hz]), weak and slow ones first.

    Source:
        UAN paper, section "Data collection". It states the number of pairs, not their values.

    Example:
        >>> amplitude_frequency_pairs(3.0)[:2], len(amplitude_frequency_pairs(3.0))
        (((1.0, 0.5), (1.0, 1.0)), 12)
    """
    return tuple((largest * share, frequency) for share in shares for frequency in frequencies)


def square(
    joint_names: Sequence[str],
    joint: str,
    pairs: Sequence[tuple[float, float]],
    rate: float = 200.0,
    seconds: float = 2.0,
    field: CommandField = "torque_command",
    safety: Safety = Safety(),
) -> Excitation:
    """Square waves on one joint, one amplitude and frequency after the other; the other joints stay at the centre.

    Args:
        joint_names: All joints, in the model's order.
        joint: The one that moves.
        pairs: (amplitude [unit of the command], frequency [Hz]), such as :func:`amplitude_frequency_pairs`.
        rate: Sampling rate of the command [Hz].
        seconds: Length of each pair [s]. Twelve pairs of 2 s, as square and as sine, are 48 s: the paper's "about 50
            s".
        field: Whether the command is a torque or a position target.
        safety: Limit, slew, fade and centre. The fade counts for each pair.

    Raises:
        ExcitationError: If the command exceeds the limit and clipping was not asked for, if a frequency exceeds half
            the rate, or if the joint does not exist.

    Source:
        UAN paper, section "Data collection".

    Example:
        >>> wave = square(("hip", "knee"), "knee", amplitude_frequency_pairs(5.0), safety=Safety(limit=10.0))
        >>> wave.command.shape, float(abs(wave.command[:, 0]).max()), float(wave.command[:, 1].max())
        ((4800, 2), 0.0, 5.0)
    """
    return _sweep("square", joint_names, joint, pairs, rate, seconds, field, safety)


def sine(
    joint_names: Sequence[str],
    joint: str,
    pairs: Sequence[tuple[float, float]],
    rate: float = 200.0,
    seconds: float = 2.0,
    field: CommandField = "torque_command",
    safety: Safety = Safety(),
) -> Excitation:
    """Sine waves on one joint, one amplitude and frequency after the other. Everything else as in :func:`square`.

    Raises:
        ExcitationError: As in :func:`square`.

    Example:
        >>> safety = Safety(limit=[[0.5, 1.5]], centre=1.0)
        >>> wave = sine(("hinge",), "hinge", [(0.3, 1.0)], field="position_target", safety=safety)
        >>> round(float(wave.command.max()), 3), wave.field
        (1.3, 'position_target')
    """
    return _sweep("sine", joint_names, joint, pairs, rate, seconds, field, safety)


def gaussian(
    joint_names: Sequence[str],
    deviation: ArrayLike,
    seed: int,
    seconds: float = 300.0,
    rate: float = 200.0,
    hold: tuple[float, float] = (0.005, 0.4),
    field: CommandField = "torque_command",
    safety: Safety = Safety(),
) -> Excitation:
    """Gaussian commands on all joints at once, drawn anew after 5 to 400 ms.

    The length of each hold is uniform over whole samples of ``hold``, and common to the joints.

    Args:
        joint_names: All joints, in the model's order.
        deviation: Standard deviation, one number or (J,) [unit of the command].
        seed: Of the draws. The same seed gives the same signal.
        seconds: Length [s]. The paper records about 5 minutes.
        rate: Sampling rate of the command [Hz].
        hold: Shortest and longest hold [s].
        field: Whether the command is a torque or a position target.
        safety: Limit, slew, fade and centre. A Gaussian has rare large values: a limit of three deviations clips one
            in 370.

    Raises:
        ExcitationError: If the command exceeds the limit and clipping was not asked for, or if ``hold`` is shorter
            than a sample.

    Source:
        UAN paper, section "Data collection".

    Example:
        >>> noise = gaussian(("hip", "knee"), 2.0, seed=0, seconds=10.0, safety=Safety(limit=4.0, clip=True))
        >>> noise.command.shape, float(abs(noise.command).max())
        ((2000, 2), 4.0)
    """
    step, samples = _grid(rate, seconds)
    shortest, longest = round(hold[0] / step), round(hold[1] / step)
    if not 1 <= shortest <= longest:
        raise ExcitationError(
            f"hold is {hold} s, which is {shortest} to {longest} samples at {rate:g} Hz. Give a shortest and a "
            "longest hold of at least one sample each, or a faster rate."
        )
    rng = np.random.default_rng(seed)
    lengths = rng.integers(shortest, longest + 1, size=samples // shortest + 1)
    draws = rng.normal(size=(len(lengths), len(joint_names))) * np.broadcast_to(deviation, (len(joint_names),))
    signal = np.repeat(draws, lengths, axis=0)[:samples]
    parameters = {"deviation": np.asarray(deviation).tolist(), "seed": seed, "hold": list(hold)}
    return _finish("gaussian", joint_names, signal, rate, field, safety, parameters)


def chirp(
    joint_names: Sequence[str],
    joint: str,
    amplitude: float,
    frequencies: tuple[float, float] = (0.1, 10.0),
    seconds: float = 30.0,
    rate: float = 200.0,
    method: Literal["linear", "logarithmic"] = "logarithmic",
    field: CommandField = "torque_command",
    safety: Safety = Safety(),
) -> Excitation:
    """A sine on one joint whose frequency sweeps from the first to the second of ``frequencies`` [Hz].

    Args:
        joint_names: All joints, in the model's order.
        joint: The one that moves.
        amplitude: [unit of the command].
        frequencies: First and last [Hz].
        seconds: Length [s].
        rate: Sampling rate of the command [Hz].
        method: 'logarithmic' spends equal time in each octave, 'linear' in each Hz.
        field: Whether the command is a torque or a position target.
        safety: Limit, slew, fade and centre.

    Raises:
        ExcitationError: As in :func:`square`.

    Example:
        >>> sweep = chirp(("hinge",), "hinge", amplitude=2.0, seconds=20.0, safety=Safety(limit=2.0, fade=1.0))
        >>> sweep.kind, len(sweep.time)
        ('chirp', 4000)
    """
    from scipy.signal import chirp as swept_sine  # light import of the package

    step, samples = _grid(rate, seconds)
    for frequency in frequencies:
        _check_frequency(frequency, rate)
    wave = amplitude * swept_sine(
        step * np.arange(samples), *(frequencies[0], seconds, frequencies[1]), method, phi=-90
    )
    parameters = {"joint": joint, "amplitude": amplitude, "frequencies": list(frequencies), "method": method}
    return _finish("chirp", joint_names, _on_joint(joint_names, joint, wave), rate, field, safety, parameters)


def multisine(
    joint_names: Sequence[str],
    joints: Sequence[str] | None,
    amplitude: float,
    band: tuple[float, float] = (0.1, 10.0),
    period: float = 20.0,
    periods: int = 1,
    rate: float = 200.0,
    field: CommandField = "torque_command",
    safety: Safety = Safety(),
) -> Excitation:
    r"""Sum of equally strong harmonics with Schroeder's phases: all of a band at once, at a low peak.

    .. math:: u(t) \propto \sum_{k=1}^{K} \cos(2 \pi f_k t - \pi k (k - 1) / K)

    Several joints get interleaved harmonics of the period, so that their responses can be told apart by frequency.

    Args:
        joint_names: All joints, in the model's order.
        joints: Those that move; None for all.
        amplitude: Peak of each joint's signal [unit of the command].
        band: Lowest and highest frequency [Hz].
        period: [s]. Harmonics are 1 / period apart.
        periods: How often the period is repeated: what differs between periods is not the command's doing.
        rate: Sampling rate of the command [Hz].
        field: Whether the command is a torque or a position target.
        safety: Limit, slew, fade and centre. A fade spoils the first and the last period.

    Raises:
        ExcitationError: As in :func:`square`; or if a joint gets no harmonic, or the period is no whole number of
            samples.

    Source:
        Schroeder 1970, IEEE Trans. Inf. Theory 16(1), 85-89.

    Example:
        >>> signal = multisine(("hip", "knee"), None, amplitude=3.0, safety=Safety(limit=3.0))
        >>> bool(max(signal.metadata["crest_factor"].values()) < 1.9)
        True
    """
    step, samples = _grid(rate, period)
    if abs(samples * step - period) > 1e-9 * period:
        raise ExcitationError(
            f"a period of {period} s is {period * rate:.3f} samples at {rate:g} Hz. Choose a whole number of samples."
        )
    _check_frequency(band[1], rate)
    moving = tuple(joint_names if joints is None else joints)
    harmonics = np.arange(int(np.ceil(band[0] * period - 1e-9)), int(np.floor(band[1] * period + 1e-9)) + 1)
    harmonics = harmonics[harmonics > 0]
    signal = np.zeros((samples * periods, len(joint_names)))
    crest, used = {}, {}
    for i, joint in enumerate(moving):
        own = harmonics[i :: len(moving)]
        if len(own) == 0:
            raise ExcitationError(
                f"no harmonic of 1/{period} s between {band[0]} and {band[1]} Hz is left for {joint}. Take a longer "
                "period or a wider band."
            )
        k = np.arange(1, len(own) + 1)[:, None]
        angle = 2 * np.pi * own[:, None] * np.arange(samples) / samples - np.pi * k * (k - 1) / len(own)
        wave = np.cos(angle).sum(axis=0)
        crest[joint] = float(np.abs(wave).max() / np.sqrt(np.mean(wave**2)))
        used[joint] = (own / period).tolist()
        signal += _on_joint(joint_names, joint, np.tile(amplitude * wave / np.abs(wave).max(), periods))
    parameters = {
        "amplitude": amplitude,
        "band": list(band),
        "period": period,
        "periods": periods,
        "crest_factor": crest,
        "frequencies": used,
    }
    return _finish("multisine", joint_names, signal, rate, field, safety, parameters)


def _sweep(
    kind: Literal["square", "sine"],
    joint_names: Sequence[str],
    joint: str,
    pairs: Sequence[tuple[float, float]],
    rate: float,
    seconds: float,
    field: CommandField,
    safety: Safety,
) -> Excitation:
    step, samples = _grid(rate, seconds)
    if not pairs:
        raise ExcitationError(
            "pairs is empty. Give (amplitude, frequency) pairs, such as amplitude_frequency_pairs(5.0)."
        )
    time = step * np.arange(samples)
    fade = _fade(samples, safety.fade, rate)
    waves = []
    for amplitude, frequency in pairs:
        _check_frequency(frequency, rate)
        cycles = frequency * time
        # Half a period ahead by a hair, so that rounding of the stamps cannot move an edge by a sample.
        wave = np.where((cycles + 1e-9) % 1.0 < 0.5, 1.0, -1.0) if kind == "square" else np.sin(2 * np.pi * cycles)
        waves.append(amplitude * wave * fade)
    segments = [
        {"start": i * samples * step, "amplitude": float(amplitude), "frequency": float(frequency)}
        for i, (amplitude, frequency) in enumerate(pairs)
    ]
    signal = _on_joint(joint_names, joint, np.concatenate(waves))
    parameters = {"joint": joint, "seconds": seconds, "segments": segments}
    return _finish(kind, joint_names, signal, rate, field, safety, parameters, faded=True)


def _grid(rate: float, seconds: float) -> tuple[float, int]:
    samples = int(np.floor(seconds * rate + 1e-9)) if rate > 0 else 0
    if samples < 2:
        raise ExcitationError(f"{seconds} s at {rate} Hz are {samples} samples. Give at least two: longer, or faster.")
    return 1.0 / rate, samples


def _check_frequency(frequency: float, rate: float) -> None:
    if not 0 < frequency < rate / 2:
        raise ExcitationError(
            f"{frequency} Hz cannot be commanded at {rate:g} Hz: frequencies lie above 0 and below half the rate, "
            f"{rate / 2:g} Hz."
        )


def _on_joint(joint_names: Sequence[str], joint: str, wave: Floats) -> Floats:
    if joint not in joint_names:
        raise ExcitationError(f"there is no joint {joint!r}. Known are {', '.join(joint_names)}.")
    signal = np.zeros((len(wave), len(joint_names)))
    signal[:, list(joint_names).index(joint)] = wave
    return signal


def _fade(samples: int, seconds: float, rate: float) -> Floats:
    ramp = round(seconds * rate)
    if seconds < 0 or 2 * ramp > samples:
        raise ExcitationError(
            f"a fade of {seconds} s at both ends does not fit into {samples / rate:.3f} s. Shorten it."
        )
    envelope = np.ones(samples)
    if ramp:
        envelope[:ramp] = 0.5 - 0.5 * np.cos(np.pi * np.arange(ramp) / ramp)
        envelope[-ramp:] = envelope[:ramp][::-1]
    return envelope


def _finish(
    kind: str,
    joint_names: Sequence[str],
    signal: Floats,
    rate: float,
    field: CommandField,
    safety: Safety,
    parameters: Mapping[str, Any],
    faded: bool = False,
) -> Excitation:
    """Apply ``safety`` to a signal about zero, and note everything down."""
    samples, joints = signal.shape
    centre = np.broadcast_to(np.asarray(safety.centre, dtype=np.float64), (joints,))
    if not faded:
        signal = signal * _fade(samples, safety.fade, rate)[:, None]
    command = signal + centre
    if safety.slew is not None:
        command = _slewed(command, centre, np.broadcast_to(np.asarray(safety.slew, dtype=np.float64), (joints,)) / rate)
    command, clipped = _limited(command, joint_names, safety)
    metadata = {
        "excitation": kind,
        "rate": rate,
        **parameters,
        "limit": None if safety.limit is None else np.asarray(safety.limit).tolist(),
        "slew": None if safety.slew is None else np.asarray(safety.slew).tolist(),
        "fade": safety.fade,
        "centre": np.asarray(safety.centre).tolist(),
        "clipped_samples": clipped,
    }
    return Excitation(np.arange(samples) / rate, command, tuple(joint_names), kind, field, metadata)


def _slewed(command: Floats, start: Floats, step: Floats) -> Floats:
    if not (step > 0).all():
        raise ExcitationError(
            f"slew must be positive, came {step}. Give the fastest change in units of the command a second."
        )
    followed = np.empty_like(command)
    last = start
    for i, wanted in enumerate(command):
        last = last + np.clip(wanted - last, -step, step)
        followed[i] = last
    return followed


def _limited(command: Floats, joint_names: Sequence[str], safety: Safety) -> tuple[Floats, int]:
    if safety.limit is None:
        return command, 0
    joints = command.shape[1]
    limit = np.asarray(safety.limit, dtype=np.float64)
    if limit.shape == (joints, 2):
        lowest, highest = limit.T
    elif limit.shape in ((), (joints,)):
        highest = np.broadcast_to(limit, (joints,))
        lowest = -highest
    else:
        raise ExcitationError(
            f"limit has shape {limit.shape}; give one number, one for each of {joints} joints, or (lowest, highest) "
            "for each."
        )
    if not (lowest < highest).all():
        raise ExcitationError(
            f"limit leaves no room: lowest {lowest}, highest {highest}. A magnitude must be positive."
        )
    slack = 1e-9 * (highest - lowest)
    over = (command > highest + slack) | (command < lowest - slack)
    if over.any() and not safety.clip:
        j = int(np.argmax(over.any(axis=0)))
        column = command[:, j]
        raise ExcitationError(
            f"{joint_names[j]}: the command reaches {column.min():.4g} to {column.max():.4g}, its limit is "
            f"{lowest[j]:.4g} to {highest[j]:.4g} ({int(over[:, j].sum())} of {len(column)} samples exceed it). Lower "
            "the amplitude, or ask for clip=True: a clipped signal is another one than planned."
        )
    return np.clip(command, lowest, highest), int(over.any(axis=1).sum())
