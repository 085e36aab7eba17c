"""Where the model and the robot differ, before any naming: which joint, and in which regime."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from torchrl_athletic.diagnosis.fit import WINDOW
from torchrl_athletic.diagnosis.result import Location, RegimeMap
from torchrl_athletic.diagnosis.screen import Bank
from torchrl_athletic.diagnosis.thresholds import TORQUES
from torchrl_athletic.effects import Signals
from torchrl_athletic.effects.effect import is_slide, torque_unit

Array = NDArray[np.float64]

FEATURES = ("speed", "position", "load", "acceleration", "command", "time")


def feature(takes: Sequence[Signals], name: str, joint: int) -> Array:
    """One quantity along all takes, of one joint. Shape (sum of N,)."""
    parts = {
        "speed": lambda s: s.velocity[:, joint],
        "position": lambda s: s.position[:, joint],
        "load": lambda s: s.load[:, joint],
        "acceleration": lambda s: s.acceleration[:, joint],
        "command": lambda s: s.command[:, joint],
        "time": lambda s: s.time - s.time[0],
    }[name]
    return np.concatenate([parts(s) for s in takes])


def feature_unit(s: Signals, name: str, joint: int) -> str:
    """Unit of a feature."""
    length = "m" if is_slide(s.nominal, s.address, joint) else "rad"
    torque = torque_unit(s.nominal, s.address, joint)
    return {
        "speed": f"{length}/s",
        "position": length,
        "load": torque,
        "acceleration": f"{length}/s²",
        "command": torque,
        "time": "s",
    }[name]


def locate(bank: Bank, rng: np.random.Generator, most: int = 6) -> tuple[Location, ...]:
    """Shares of the error, joint by joint and then by regime, with block-bootstrap bands.

    The error of a joint is the acceleration that its own missing torque would cause, so that what reaches a joint
    through coupling is charged to the joint where it arises. A controller that follows targets holds it back by its
    gains, which a light joint's inertia is nothing against. Energy below the sensors' noise is not counted. Where
    slides and hinges are compared, whose accelerations have no common unit, the energy is that acceleration times the
    torque [W/s].

    Args:
        bank: The missing torque.
        rng: Draws the blocks.
        most: Regimes returned at most, beside one line a joint.
    """
    own = np.concatenate([_held_back(s) for s in bank.takes])
    slides = {is_slide(bank.takes[0].nominal, bank.takes[0].address, j) for j in range(bank.joints)}
    used = bank.weight > 0
    noise = np.array([s.noise for s in bank.takes]).mean(0)
    energy = np.where(used, np.maximum(bank.target**2 - noise**2, 0.0) / own ** (1 if len(slides) > 1 else 2), 0.0)
    if energy.sum() <= 0:
        return ()
    blocks = bank.block
    count = int(blocks[-1]) + 1
    draws = rng.integers(0, count, (TORQUES.replicates, count))
    weights = np.stack([np.bincount(d, minlength=count) for d in draws]).astype(float)  # (R, B)

    def share(inside: NDArray[np.bool_], joint: int) -> tuple[float, tuple[float, float]]:
        part = np.bincount(blocks, np.where(inside, energy[:, joint], 0.0), minlength=count)
        whole = np.bincount(blocks, energy.sum(1), minlength=count)
        resampled = (weights @ part) / np.maximum(weights @ whole, 1e-300)
        low, high = np.quantile(resampled, [0.025, 0.975])
        return float(part.sum() / whole.sum()), (float(low), float(high))

    names = bank.takes[0].recording.joint_names
    everywhere = np.ones(len(energy), dtype=bool)
    joints = [Location(names[j], "everywhere", *share(everywhere, j)) for j in range(bank.joints)]
    regimes: list[tuple[float, Location]] = []
    for j in range(bank.joints):
        total = energy[:, j].sum()
        for label, inside in _regimes(bank.takes, j):
            time_share = inside[used[:, j]].mean() if used[:, j].any() else 0.0
            own_share = energy[inside, j].sum() / max(total, 1e-300)
            if 0.02 < time_share < 0.7 and own_share > 1.3 * time_share:
                value, band = share(inside, j)
                regimes.append((value * (own_share / time_share - 1), Location(names[j], label, value, band)))
    telling = [location for _, location in sorted(regimes, key=lambda r: -r[0])[:most]]
    return tuple(sorted(joints, key=lambda x: -x.share_of_error) + telling)


def _held_back(s: Signals) -> Array:
    """Inertia of each joint, and what its controller's gains are worth beside it over a window of a fit. Shape (N, J).

    Within a time T a torque moves an inertia I by T²/2I. By that much 2 I/T² is a stiffness, and a damping kd one of
    2 kd/T.
    """
    own = np.diagonal(s.inertia, axis1=1, axis2=2)
    r = s.recording
    if r.position_target is None or r.kp is None or r.kd is None:
        return own
    return np.asarray(own + r.kd * WINDOW + r.kp * WINDOW**2 / 2, dtype=np.float64)


def regime_maps(bank: Bank, left: Array, rng: np.random.Generator) -> list[RegimeMap]:
    """Missing torque against speed, position, load, acceleration and time, before and after the correction.

    Args:
        bank: The missing torque.
        left: What the correction leaves of it [N·m]. Shape (sum of N, J).
        rng: Draws the blocks.
    """
    out = []
    s = bank.takes[0]
    for j, joint in enumerate(s.recording.joint_names):
        used = bank.weight[:, j] > 0
        if used.sum() < 5 * TORQUES.bins:
            continue
        for name in FEATURES:
            x = feature(bank.takes, name, j)
            low, high = np.quantile(x[used], [0.005, 0.995])
            if not high > low:
                continue
            edges = np.linspace(low, high, TORQUES.bins + 1)
            index = np.clip(np.digitize(x, edges) - 1, 0, TORQUES.bins - 1)
            before, before_band = _binned(bank.target[:, j], index, used, bank.block, rng)
            after, after_band = _binned(left[:, j], index, used, bank.block, rng)
            full = np.isfinite(before)
            out.append(
                RegimeMap(
                    joint=joint,
                    feature=name,
                    unit=feature_unit(s, name, j),
                    torque_unit=torque_unit(s.nominal, s.address, j),
                    centre=((edges[1:] + edges[:-1]) / 2)[full],
                    before=before[full],
                    before_band=before_band[full],
                    after=after[full],
                    after_band=after_band[full],
                    noise=float(np.mean([t.noise[j] for t in bank.takes])),
                )
            )
    return out


def regime_of(bank: Bank, explained: Array, joint: int, name: str) -> str:
    """In words, where along a feature an effect explains most of the missing torque.

    Args:
        bank: The missing torque.
        explained: Part that the effect predicts [N·m]. Shape (sum of N, J).
        joint: Its joint.
        name: A feature; 'speed' is split by magnitude.
    """
    used = bank.weight[:, joint] > 0
    x = (
        np.abs(feature(bank.takes, name, joint))
        if name in ("speed", "acceleration")
        else feature(bank.takes, name, joint)
    )
    y = bank.target[:, joint]
    gain = np.where(used, np.maximum(y**2 - (y - explained[:, joint]) ** 2, 0.0), 0.0)
    if gain.sum() <= 0:
        return "everywhere"
    cuts = np.quantile(x[used], [1 / 3, 2 / 3])
    thirds = [used & (x <= cuts[0]), used & (x > cuts[0]) & (x <= cuts[1]), used & (x > cuts[1])]
    shares = [float(gain[t].sum() / gain.sum()) for t in thirds]
    unit, top = feature_unit(bank.takes[0], name, joint), int(np.argmax(shares))
    word = f"{name}s"
    where = (
        f"{word} below {_said(cuts[0], x)} {unit}",
        f"{word} from {_said(cuts[0], x)} to {_said(cuts[1], x)} {unit}",
        f"{word} above {_said(cuts[1], x)} {unit}",
    )
    if shares[top] < 0.45:
        return f"at all {word}"
    return f"most at {where[top]}: {100 * shares[top]:.0f} % of what it explains in a third of the time"


def _said(edge: float, x: Array) -> str:
    """An edge of a regime in words; what is nothing beside the range of values is zero."""
    return f"{0.0 if abs(edge) < 1e-3 * np.ptp(x) else edge:.2g}"


def _regimes(takes: Sequence[Signals], joint: int) -> list[tuple[str, NDArray[np.bool_]]]:
    v = feature(takes, "speed", joint)
    out: list[tuple[str, NDArray[np.bool_]]] = [("moving forwards", v > 0), ("moving backwards", v < 0)]
    unit = feature_unit(takes[0], "speed", joint)
    speed = np.abs(v)
    slow, fast = np.quantile(speed, [1 / 3, 2 / 3])
    out += [(f"slower than {slow:.2g} {unit}", speed < slow), (f"faster than {fast:.2g} {unit}", speed > fast)]
    for name in ("position", "load", "command"):
        x, u = feature(takes, name, joint), feature_unit(takes[0], name, joint)
        if np.ptp(x) > 1e-9:
            low, high = np.quantile(x, [1 / 3, 2 / 3])
            out += [(f"{name} below {_said(low, x)} {u}", x < low), (f"{name} above {_said(high, x)} {u}", x > high)]
    a, u = np.abs(feature(takes, "acceleration", joint)), feature_unit(takes[0], "acceleration", joint)
    hard = np.quantile(a, 2 / 3)
    out.append((f"accelerating harder than {hard:.2g} {u}", a > hard))
    out.append(("just after a reversal", _after_reversal(takes, joint)))
    if len(takes) == 1:
        t = feature(takes, "time", joint)
        out += [
            ("in the first third of the take", t < t.max() / 3),
            ("in the last third of the take", t > 2 * t.max() / 3),
        ]
    return out


def _after_reversal(takes: Sequence[Signals], joint: int, seconds: float = 0.1) -> NDArray[np.bool_]:
    parts = []
    for s in takes:
        turned = np.diff(np.sign(s.velocity[:, joint]), prepend=np.sign(s.velocity[0, joint])) != 0
        last = np.maximum.accumulate(np.where(turned, s.time, -np.inf))
        parts.append(s.time - last < seconds)
    return np.concatenate(parts)


def _binned(
    y: Array, index: NDArray[np.intp], used: NDArray[np.bool_], block: NDArray[np.intp], rng: np.random.Generator
) -> tuple[Array, Array]:
    """Mean per bin, and its 95 % band over resampled blocks. Shapes (B,), (B, 2)."""
    count = int(block[-1]) + 1
    total, number = np.zeros((count, TORQUES.bins)), np.zeros((count, TORQUES.bins))
    np.add.at(total, (block[used], index[used]), y[used])
    np.add.at(number, (block[used], index[used]), 1.0)
    with np.errstate(invalid="ignore", divide="ignore"):
        mean = total.sum(0) / number.sum(0)
        draws = np.stack(
            [np.bincount(rng.integers(0, count, count), minlength=count) for _ in range(TORQUES.replicates)]
        )
        resampled = (draws @ total) / (draws @ number)
    mean[number.sum(0) < 3] = np.nan
    full, band = np.isfinite(mean), np.full((TORQUES.bins, 2), np.nan)
    known = np.where(np.isfinite(resampled), resampled, mean)[:, full]
    band[full] = np.quantile(known, [0.025, 0.975], axis=0).T
    return mean, band
