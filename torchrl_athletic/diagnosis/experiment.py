"""Which experiment would tell rivals apart: planned along candidate motions, in the torque domain, before any is run.

The separation of the rivals (:mod:`torchrl_athletic.diagnosis.separation`) is maximised over candidate motions within
the robot's limits: optimal design for model discrimination (Atkinson, Fedorov 1975, doi:10.1093/biomet/62.1.57).
"""

from __future__ import annotations

import json
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import reduce
from pathlib import Path
from typing import Any

import mujoco
import numpy as np
from numpy.typing import NDArray
from scipy.interpolate import CubicSpline
from scipy.ndimage import gaussian_filter1d

from torchrl_athletic.diagnosis.corrected import write_json
from torchrl_athletic.diagnosis.fit import Hypothesis
from torchrl_athletic.diagnosis.motions import Limits, Motion, motions, touches, way
from torchrl_athletic.diagnosis.proposal import Proposal, answer_set
from torchrl_athletic.diagnosis.replay import simulate, take_of, windows_of
from torchrl_athletic.diagnosis.result import Finding
from torchrl_athletic.diagnosis.screen import Key, row_noise
from torchrl_athletic.diagnosis.search import Judge, Scored
from torchrl_athletic.diagnosis.separation import PairProducts, Rivals, every_nth
from torchrl_athletic.diagnosis.thresholds import PLAN
from torchrl_athletic.effects.base import carried
from torchrl_athletic.effects.effect import is_slide
from torchrl_athletic.effects.payload import with_payload
from torchrl_athletic.effects.signals import (
    HALF_POWER,
    QUICKEST,
    JointAddress,
    Signals,
    inertia_matrix,
    inverse_dynamics,
    kernel_for,
    project_recording,
    smooth_dynamics,
)
from torchrl_athletic.recordings import Recording, noise_correlation, sensor_noise
from torchrl_athletic.recordings.whole_file import whole_file

Array = NDArray[np.float64]
SMALLER = (1.0, 0.75, 0.55, 0.4, 0.3, 0.2, 0.15, 0.1, 0.07, 0.05)
"""Shares of its amplitude at which a motion is tried until the torque suffices and every rival keeps the limits."""


@dataclass(frozen=True, eq=False)
class Experiment:
    """One excitation that would tell rivals apart, as a command to replay. T samples, J joints."""

    rivals: tuple[Key, ...]
    """(effect, joint) of each."""
    motions: tuple[Motion, ...]
    """One, or two where no single one separates every pair."""
    repeats: int
    """How often to do them, one after the other."""
    payload: float
    """Mass to fasten at the far end of the last link, zero for none [kg]."""
    duration: float
    """[s]"""
    before: float
    """Separation of the closest pair on the recordings at hand [standard deviations, at most PLAN.enough].

    Only pairs that can be separated at all count.
    """
    repeated: float
    """Separation of the closest pair if the old excitation were repeated for as long as the experiment lasts."""
    after: float
    """Separation of the closest pair with the experiment."""
    pairs: Mapping[tuple[Key, Key], tuple[float, float]]
    """Separation of each pair before and after."""
    inseparable: tuple[tuple[Key, Key], ...]
    """Pairs that no motion within the limits separates."""
    spread: float
    """Largest difference between the positions that the rivals predict for it [rad, m]."""
    units: tuple[str, ...]
    """Unit of each joint's position: 'rad' or 'm'. Length J."""
    joint_names: tuple[str, ...]
    time: Array
    """Uniform stamps [s]. Shape (T,)."""
    target: Array
    """Position target of the PD loop [rad, m]. Shape (T, J)."""
    reference: Array
    """Position that the likeliest rival predicts [rad, m]. Shape (T, J)."""
    torque: Array
    """Torque that it predicts [N·m, N]. Shape (T, J)."""
    kp: Array
    """Shape (J,)."""
    kd: Array
    """Shape (J,)."""
    limits: Limits

    @property
    def sentence(self) -> str:
        """What to do and what it tells, in words."""
        how = ", then ".join(m.words(self._unit(m)) for m in self.motions)
        often = f", {self.repeats} times" if self.repeats > 1 else ""
        load = f" with {self.payload:g} kg fastened to the end" if self.payload else ""
        text = (
            f"{how[0].upper()}{how[1:]}{often}{load}, {self.duration:.0f} s in all. It should set "
            f"{_words(self.rivals)} about {self.after:.1f} standard deviations apart; now they are "
            f"{self.before:.1f} apart, and repeating the old motion would make it {self.repeated:.1f}."
        )
        if self.inseparable:
            which = "; ".join(_words(pair) for pair in self.inseparable)
            text += f" No motion within the limits separates {which}."
        return text

    def _unit(self, motion: Motion) -> str:
        """Unit of a motion's amplitude; of all joints at once, each one's own."""
        of = dict(zip(self.joint_names, self.units, strict=True))
        return of.get(motion.joint) or " or ".join(sorted(set(self.units), reverse=True))

    def report(self) -> dict[str, Any]:
        """All but the samples, as plain lists and numbers."""
        return {
            "schema": "torchrl_athletic/experiment/1",
            "sentence": self.sentence,
            "separates": [{"effect": effect, "joint": joint} for effect, joint in self.rivals],
            "pairs": [
                {"rivals": [list(a), list(b)], "before": before, "after": after}
                for (a, b), (before, after) in self.pairs.items()
            ],
            "inseparable": [[list(a), list(b)] for a, b in self.inseparable],
            "expected_separation": {"before": self.before, "repeating": self.repeated, "after": self.after},
            "motions": [
                {
                    "joint": m.joint,
                    "kind": m.kind,
                    "amplitude": m.amplitude,
                    "unit": self._unit(m),
                    "frequency": m.frequency,
                    "pose": m.pose.tolist(),
                }
                for m in self.motions
            ],
            "repeats": self.repeats,
            "payload_kg": self.payload,
            "duration": self.duration,
            "rate": PLAN.rate,
            "joint_names": list(self.joint_names),
            "kp": self.kp.tolist(),
            "kd": self.kd.tolist(),
            "limits": {
                "position": self.limits.position.tolist(),
                "velocity": self.limits.velocity.tolist(),
                "torque": self.limits.torque.tolist(),
                "frequency": self.limits.frequency if np.isfinite(self.limits.frequency) else None,
            },
            "largest": {
                "position": [self.reference.min(0).tolist(), self.reference.max(0).tolist()],
                "velocity": (PLAN.rate * np.abs(np.diff(self.reference, axis=0)).max(0)).tolist(),
                "torque": np.abs(self.torque).max(0).tolist(),
                "difference_between_rivals": self.spread,
            },
        }


def next_experiment(
    evidence: Sequence[Proposal], findings: Sequence[Finding], limits: Limits | None = None, xml: str = ""
) -> Experiment | None:
    """The experiment for the finding whose rivals share most of the evidence, of those that one would help.

    None where no finding has rivals that a motion separates, with or without a weight fastened to the last link.

    Args:
        evidence: The parts of the search.
        findings: What is stated, each with its rivals.
        limits: Of the robot; :meth:`Limits.of` the recordings if None.
        xml: MJCF of the given model; without it no weight is asked for.
    """
    for finding in sorted((f for f in findings if f.rivals), key=lambda f: f.probability):
        asked = {(r.effect, r.joint): r.probability for r in finding.rivals}
        asked[finding.effect, finding.joint] = finding.probability
        for part in evidence:
            for term in part.best.fit.terms:
                if term.candidate.key == (finding.effect, finding.joint):
                    options = {o.atom.candidate.key: o.scored for o in answer_set(part, term)}
                    options = {key: s for key, s in options.items() if key in asked}
                    if len(options) > 1:
                        shared = [asked[key] for key in options]
                        plan = propose(part.judge, options, shared, limits)
                        if (plan is None or plan.inseparable or plan.after < PLAN.spare) and xml:
                            loaded = propose(part.judge, options, shared, limits, _weights(part.judge, xml))
                            plan = loaded if loaded is not None and _tells_more(loaded, plan) else plan
                        if plan is not None:
                            return plan
    return None


def _tells_more(loaded: Experiment, bare: Experiment | None) -> bool:
    """Whether a plan with a weight is worth fastening it: it separates more pairs, or the closest one far better."""
    if bare is None or len(loaded.inseparable) != len(bare.inseparable):
        return bare is None or len(loaded.inseparable) < len(bare.inseparable)
    return loaded.after > bare.after + PLAN.apart


def _weights(judge: Judge, xml: str) -> dict[float, mujoco.MjModel]:
    """A weight that the last link feels well, and the model with it; none where its weight is unknown."""
    s = judge.bank.takes[0]
    mass = float(f"{PLAN.heavy * s.nominal.body_subtreemass[s.address.body[-1]]:.1g}")
    return {mass: carried(with_payload(xml, s.recording.joint_names, mass))} if mass else {}


def propose(
    judge: Judge,
    rivals: Mapping[Key, Scored],
    probabilities: Sequence[float] | None = None,
    limits: Limits | None = None,
    payloads: Mapping[float, mujoco.MjModel] | None = None,
    seconds: float = PLAN.seconds,
) -> Experiment | None:
    """Find the excitation that separates rival explanations best.

    Among equally good ones it is the short and gentle one.

    Args:
        judge: Of the search that found the rivals.
        rivals: Combinations that the recordings cannot tell apart, each fitted to them, by the effect and the joint
            that each stands for; the likeliest first.
        probabilities: Of the rivals; they weigh the pairs. Equal if None.
        limits: Of the robot; :meth:`Limits.of` the recordings if None.
        payloads: Mass that may be fastened [kg] -> the model with it (:func:`with_payload`).
        seconds: Length of the excitation, without the ways there and back [s].

    Returns:
        The experiment; None if no motion within the limits separates any pair better than repeating the old one.

    Raises:
        ValueError: If there are fewer than two rivals.
    """
    if len(rivals) < 2:
        raise ValueError(f"{len(rivals)} rival: an experiment separates at least two. Pass all of an answer set.")
    takes = judge.bank.takes
    limits = limits or Limits.of(takes)
    limits = replace(limits, frequency=min(limits.frequency, _highest_frequency(rivals.values())))
    scene = Rivals(judge, list(rivals.values()), probabilities)
    known = scene.products([every_nth(s) for s in takes], scene.sigma)
    sensors = _Sensors.of(takes)
    before = scene.separations(known)
    plans = []
    for mass, model in {0.0: takes[0].nominal, **(payloads or {})}.items():
        loop = _gains(takes, model)
        for motion in motions(takes, limits, _joints_of(rivals), seconds):
            plan = _planned(motion, mass, model, takes, limits, loop)
            if plan is not None:
                plans.append(_measured(scene, known, plan, sensors))
    if not plans:
        return None
    # what little a motion tells adds up
    repeated = [scene.separations(known + p.products.times(_most_repeats(p))) for p in plans]
    hopeful = np.max([*repeated, *(p.separations for p in plans)], axis=0) > PLAN.apart
    best = max(plans, key=lambda p: _worth(scene, p, hopeful))
    for other in _followers(plans, best, hopeful):
        both = _joined(best, other)
        if best.signals[0].kernel == other.signals[0].kernel:
            signals, products = (*best.signals, *other.signals), best.products + other.products
            plans.append(_judged(scene, known, both, signals, products))
        else:  # one take will be made of both
            plans.append(_measured(scene, known, both, sensors))
    hopeful |= np.max([p.separations for p in plans], axis=0) > PLAN.apart
    length = sum(float(np.ptp(s.time)) for s in takes)
    for chosen in sorted(plans, key=lambda p: -_worth(scene, p, hopeful))[: PLAN.confirmed]:
        for share in SMALLER:
            smaller = chosen if share == 1.0 else _smaller(scene, known, chosen, share, limits, sensors)
            if smaller is None:
                break
            plan = _compensated(scene, _repeated(scene, known, smaller, hopeful), sensors)
            as_long = scene.separations(known + known.times(plan.recording.duration / length))
            if not (plan.separations - as_long)[hopeful].max(initial=0.0) > 1.0:
                break
            passed = _passed(plan, scene)
            paths = _simulated(passed, plan.model, scene)
            if _keeps(plan, paths, passed.duration, limits):
                separations = before, as_long, plan.separations
                return _experiment(plan, scene, list(rivals), separations, hopeful, paths, limits)
    return None


def write(experiment: Experiment | None, folder: str | Path) -> None:
    """Write ``next_experiment.npz``, to replay, and ``next_experiment.json``, to read.

    The archive holds ``time``, ``joint_names``, ``position_target``, ``kp``, ``kd``, ``reference_position``,
    ``predicted_torque`` and ``metadata`` (JSON). Send each target at its stamp to the position loop with these gains,
    from rest at the first one, and log as ever. Without an experiment, files of an earlier one are removed.
    """
    folder = Path(folder)
    if experiment is None:
        for name in ("next_experiment.npz", "next_experiment.json"):
            (folder / name).unlink(missing_ok=True)
        return
    folder.mkdir(parents=True, exist_ok=True)
    report = experiment.report()
    with whole_file(folder / "next_experiment.npz") as part, part.open("wb") as file:
        np.savez_compressed(
            file,
            allow_pickle=False,
            time=experiment.time,
            joint_names=np.array(experiment.joint_names, dtype=np.str_),
            position_target=experiment.target,
            kp=experiment.kp,
            kd=experiment.kd,
            reference_position=experiment.reference,
            predicted_torque=experiment.torque,
            metadata=np.array(json.dumps(report)),
        )
    write_json(folder / "next_experiment.json", report)


@dataclass(frozen=True, eq=False)
class _Plan:
    """A motion that the robot can do, as the recording that it would leave."""

    motions: tuple[Motion, ...]
    payload: float
    model: mujoco.MjModel
    recording: Recording
    torque: Array
    """Shape (T, J)."""
    share: tuple[float, float]
    """Shares of the speed limit and of the torque limit that it uses, 0..1."""
    repeats: int = 1
    signals: tuple[Signals, ...] = ()
    products: PairProducts = field(default_factory=lambda: PairProducts({}, *np.zeros((4, 0))))
    separations: Array = field(default_factory=lambda: np.zeros(0))
    """Separation of each pair, with the recordings at hand. Shape (pairs,)."""

    @property
    def effort(self) -> float:
        """Mean share of the speed, torque, time and band that it uses, 0..1."""
        band = max(m.highest for m in self.motions) * QUICKEST / HALF_POWER
        return float(np.mean([*self.share, min(self.recording.duration / 30, 1.0), band]))


def _followers(plans: Sequence[_Plan], best: _Plan, hopeful: NDArray[np.bool_]) -> list[_Plan]:
    """Motions that may follow the best one, if it leaves a pair too close: those that tell this pair best."""
    weakest = int(np.argmin(np.where(hopeful, best.separations, np.inf)))
    if best.separations[weakest] >= PLAN.enough:
        return []
    others = [p for p in plans if p.payload == best.payload and p is not best]
    return sorted(others, key=lambda p: -p.separations[weakest])[: PLAN.followers]


@dataclass(frozen=True, eq=False)
class _Sensors:
    """What the readings of a plan will be like: those of the recordings at hand."""

    position: Array
    """Standard deviation of one reading [rad, m]. Shape (J,)."""
    velocity: Array | None
    """Standard deviation of one reading [rad/s, m/s]; None if velocity is not read. Shape (J,)."""
    correlation: Array
    """Correlation of the position's noise from one sample to the next [1]. Shape (J,)."""
    louder: Array
    """Noise of the recordings' missing torque over what these numbers make of it. Shape (J,)."""

    @classmethod
    def of(cls, takes: Sequence[Signals]) -> _Sensors:
        recordings, first = [s.recording for s in takes], takes[0]
        positions, velocities = zip(*(sensor_noise(r) for r in recordings), strict=True)
        position = np.median(positions, axis=0)
        velocity = None if any(v is None for v in velocities) else np.median(np.stack(velocities), axis=0)
        correlation = np.median([noise_correlation(r) for r in recordings], axis=0)
        again = project_recording(
            first.recording, first.nominal, position, velocity, kernel=first.kernel, noise_correlation=correlation
        ).noise
        alike = [s.noise for s in takes if s.kernel == first.kernel]
        louder = np.sqrt(np.mean(np.square(alike), axis=0)) / again
        more = first.recording.rate / PLAN.rate
        if more > 1.001:  # a plan is seen at PLAN.rate: of noise that passes as soon and is as loud at low frequencies
            fading = np.maximum(correlation, 0.0) ** more
            loud = (1 + correlation) / (1 - correlation) * (1 - fading) / (1 + fading)
            position, correlation = position * np.sqrt(loud / more), fading
            velocity = None if velocity is None else velocity / np.sqrt(more)
        return cls(position, velocity, correlation, louder)


def _measured(rivals: Rivals, known: PairProducts, plan: _Plan, sensors: _Sensors) -> _Plan:
    """The plan with what its log would separate."""
    s = every_nth(_seen(rivals, plan, sensors))
    return _judged(rivals, known, plan, [s], rivals.products([s], row_noise([*rivals.takes, s])[-1:]))


def _judged(
    rivals: Rivals, known: PairProducts, plan: _Plan, signals: Sequence[Signals], products: PairProducts
) -> _Plan:
    """The plan with what it would separate."""
    noise, at_hand = row_noise([*rivals.takes, *signals]), len(rivals.takes)
    of_groups = np.concatenate([np.sqrt(np.mean(noise[:at_hand] ** 2, axis=0)), *noise[at_hand:]])
    after = rivals.separations(known + products, of_groups)
    return replace(plan, signals=tuple(signals), products=products, separations=after)


def _worth(rivals: Rivals, plan: _Plan, hopeful: NDArray[np.bool_]) -> float:
    """Halfway between the closest pair's separation and the mean, where pairs weigh by how probable both are.

    Without pairs that nothing separates; less for a plan that takes more effort.
    """
    if not hopeful.any():
        return 0.0
    some, weight = plan.separations[hopeful], rivals.weight[hopeful]
    return float(some.min() + weight @ some / max(weight.sum(), 1e-300)) / 2 * (1 - PLAN.gentle * plan.effort)


def _repeated(rivals: Rivals, known: PairProducts, plan: _Plan, hopeful: NDArray[np.bool_]) -> _Plan:
    """The plan as often as tells the pairs apart best: once, twice, four times and so on, or all that a minute holds.

    No more often than leaves something to spare, and not always the longest: the longer it is, the more of the older
    recordings a rival may get wrong for its sake.
    """
    best, most = plan, _most_repeats(plan)
    doubled = [2**k for k in range(1, most) if 2**k < most]
    for often in [*doubled, most] if most > 1 else []:
        if best.separations[hopeful].min(initial=PLAN.enough) >= PLAN.spare:
            break
        longer = replace(reduce(_joined, [plan] * often), motions=plan.motions, repeats=often)
        longer = _judged(rivals, known, longer, plan.signals, plan.products.times(often))
        best = max(best, longer, key=lambda p: _worth(rivals, p, hopeful))
    return best


def _most_repeats(plan: _Plan) -> int:
    return max(1, int(PLAN.longest * PLAN.rate / plan.recording.num_samples))


def _compensated(rivals: Rivals, plan: _Plan, sensors: _Sensors) -> _Plan:
    """The plan with targets that make the likeliest rival, not the given model, follow the reference."""
    r, s = plan.recording, _seen(rivals, plan, sensors)
    added = CubicSpline(s.time, rivals.known[0].prediction(s))(np.clip(r.time, s.time[0], s.time[-1]))
    assert r.kp is not None
    target = r.command - added / r.kp
    return replace(plan, recording=replace(r, position_target=target), torque=plan.torque - added)


def _seen(rivals: Rivals, plan: _Plan, sensors: _Sensors) -> Signals:
    """The plan as it will be logged: with what earlier recordings have, targets and gains or torques, at their rate.

    A delay of targets leaves other traces than one of the torques that a loop on the user's side sends. It has a test
    function of its own, and the noise that the earlier recordings' sensors make there.
    """
    r, like = plan.recording, rivals.takes[0].recording
    time = np.arange(0.0, r.duration, 1 / min(like.rate, PLAN.rate))
    held = np.searchsorted(r.time, time + 1e-9, side="right") - 1
    spline = CubicSpline(r.time, r.position)
    path, velocity = spline(time), None if sensors.velocity is None else spline(time, 1)
    if like.position_target is None:
        log = replace(
            r, time=time, position=path, velocity=velocity, position_target=None, kp=None, kd=None,
            torque_command=plan.torque[held],
        )  # fmt: skip
    else:
        log = replace(r, time=time, position=path, velocity=velocity, position_target=r.command[held])
    log = _stood(log, rivals.takes)
    kernel = kernel_for([log], least=QUICKEST)
    s = project_recording(log, plan.model, sensors.position, sensors.velocity, None, kernel, sensors.correlation)
    return replace(s, noise=sensors.louder * s.noise)


def _stood(recording: Recording, takes: Sequence[Signals]) -> Recording:
    """A plan's recording; of a floating robot with its base held where that of the recordings at hand began."""
    base = takes[0].base
    return recording if base is None else recording.with_base_held(base.pose[0, :3], base.pose[0, 3:])


def _joints_of(rivals: Mapping[Key, Scored]) -> list[int]:
    """Joints that the rivals speak of, and the one before each, whose motion its effects feel."""
    named = {a.candidate.joint for s in rivals.values() for a in s.fit.terms if a.candidate.key in rivals}
    return sorted(named | {j - 1 for j in named if j})


def _highest_frequency(rivals: Iterable[Scored]) -> float:
    """Up to which every rival says how the robot moves [Hz]."""
    return min(
        atom.candidate.effect.highest_frequency(atom.candidate.parameters, values)
        for s in rivals
        for atom, values in zip(s.fit.atoms, s.fit.values(), strict=True)
    )


def _planned(
    motion: Motion,
    mass: float,
    model: mujoco.MjModel,
    takes: Sequence[Signals],
    limits: Limits,
    loop: tuple[Array, Array],
) -> _Plan | None:
    """The recording that a motion would leave on the given model, smaller where the torque does not suffice.

    None if it exceeds a limit all the same or touches something.
    """
    names, start = takes[0].recording.joint_names, takes[0].recording.position[0]
    address, smooth, (kp, kd) = JointAddress.of(model, names), smooth_dynamics(model), loop
    low, high = limits.position.T
    slack = 1e-3 * (high - low)
    for share in SMALLER:
        smaller = motion.smaller(share)
        path = _path(smaller, start, limits)
        time = np.arange(len(path)) / PLAN.rate
        spline = CubicSpline(time, path)
        velocity, acceleration = spline(time, 1), spline(time, 2)
        moved = np.ptp(path, axis=0) > 0
        speed_share = float((np.abs(velocity) / limits.velocity).max())
        if ((path < low - slack) | (path > high + slack))[:, moved].any() or speed_share > 1:
            return None
        base = None if takes[0].base is None else takes[0].base[np.zeros(len(path), dtype=np.intp)].at_rest
        torque = inverse_dynamics(smooth, address, path, velocity, acceleration, base)
        torque_share = float((np.abs(torque) / limits.torque).max())
        if torque_share <= PLAN.margin:
            break
    else:
        return None
    if touches(model, address, path):
        return None
    target = path + (torque + kd * velocity) / kp
    recording = Recording(time, names, path, position_target=target, kp=kp, kd=kd, source="planned")
    return _Plan((smaller,), mass, model, recording, torque, (speed_share, torque_share))


def _path(motion: Motion, start: Array, limits: Limits) -> Array:
    """Path from the start there and back, corners rounded. Shape (T, J)."""
    path = motion.pose + motion.wave
    if motion.rounding:
        rest = np.repeat(motion.pose[None], round(4 * motion.rounding * PLAN.rate), axis=0)
        path = gaussian_filter1d(
            np.concatenate([rest, path, rest]), motion.rounding * PLAN.rate, axis=0, mode="nearest"
        )
    return np.concatenate([way(start, path[0], limits), path, way(path[-1], start, limits)])


def _joined(one: _Plan, other: _Plan) -> _Plan:
    """One after the other; both begin and end at rest in the same pose."""
    a, b = one.recording, other.recording
    assert a.position_target is not None
    assert b.position_target is not None
    position = np.concatenate([a.position, b.position])
    recording = replace(
        a,
        time=np.arange(len(position)) / PLAN.rate,
        position=position,
        position_target=np.concatenate([a.position_target, b.position_target]),
    )
    share = (max(one.share[0], other.share[0]), max(one.share[1], other.share[1]))
    torque = np.concatenate([one.torque, other.torque])
    return _Plan((*one.motions, *other.motions), one.payload, one.model, recording, torque, share)


def _gains(takes: Sequence[Signals], model: mujoco.MjModel) -> tuple[Array, Array]:
    """The recordings' gains, or a critically damped loop of PLAN.bandwidth."""
    r = takes[0].recording
    if r.kp is not None and r.kd is not None:
        return r.kp, r.kd
    inertia = np.diag(inertia_matrix(model, takes[0].address, r.position[:1])[0])
    w = 2 * np.pi * PLAN.bandwidth
    return inertia * w**2, inertia * 2 * w


def _smaller(
    rivals: Rivals, known: PairProducts, plan: _Plan, share: float, limits: Limits, sensors: _Sensors
) -> _Plan | None:
    """The plan with a share of its amplitudes; None if nothing so small can be done."""
    loop = _gains(rivals.takes, plan.model)
    parts = [_planned(m.smaller(share), plan.payload, plan.model, rivals.takes, limits, loop) for m in plan.motions]
    if any(p is None for p in parts):
        return None
    return _measured(rivals, known, reduce(_joined, [p for p in parts if p is not None]), sensors)


def _passed(plan: _Plan, rivals: Rivals) -> Recording:
    """What of a plan is simulated: one time of all, each from rest to rest, unless some rival changes meanwhile."""
    changes = any(a.candidate.effect.family == "change" for s in rivals.rivals for a in s.fit.atoms)
    once = plan.recording.num_samples // plan.repeats
    return plan.recording if changes else plan.recording.slice(0, once)


def _simulated(recording: Recording, model: mujoco.MjModel, rivals: Rivals) -> Array:
    """Positions that each rival predicts, with its values and with others that the recordings allow as well.

    On the simulation's grid. Shape (rivals, DRAWS, T, J).
    """
    stood = _stood(recording, rivals.takes)
    windows = windows_of(take_of(stood, model, np.full(stood.num_joints, 1e-9)), None)
    assert rivals.draws is not None
    out = []
    for s, coefficients, drawn in zip(rivals.rivals, rivals.known, rivals.draws, strict=True):
        hypothesis = Hypothesis(
            tuple(a.candidate for a in s.fit.terms), tuple(a.candidate for a in s.fit.atoms[s.fit.size :])
        )
        fitted = np.concatenate(s.fit.values())
        others = [coefficients.parameters(x) for x in drawn[1:]]
        out.append(simulate(windows, hypothesis.build, np.clip([fitted, *others], *hypothesis.bounds))[:, 0])
    return np.stack(out)


def _keeps(plan: _Plan, paths: Array, duration: float, limits: Limits) -> bool:
    """Whether no rival leaves the range or is faster than allowed, and the likeliest needs no more torque.

    ``duration`` of the paths [s].
    """
    low, high = limits.position.T
    slack = PLAN.slack * (high - low)
    fastest = np.abs(np.diff(paths, axis=2)).max((0, 1, 2)) * (paths.shape[2] - 1) / duration
    inside = ((paths > low - slack) & (paths < high + slack)).all()
    strong = (np.abs(plan.torque) <= limits.torque).all()
    return bool(
        np.isfinite(paths).all() and inside and strong and (fastest <= (1 + PLAN.slack) * limits.velocity).all()
    )


def _experiment(
    plan: _Plan,
    scene: Rivals,
    keys: Sequence[Key],
    separations: tuple[Array, Array, Array],
    hopeful: NDArray[np.bool_],
    paths: Array,
    limits: Limits,
) -> Experiment:
    r = plan.recording
    named = [(keys[a], keys[b]) for a, b in scene.pairs]
    before, repeated, after = (float(s[hopeful].min()) for s in separations)
    slides = [is_slide(plan.model, scene.takes[0].address, j) for j in range(r.num_joints)]
    assert r.kp is not None
    assert r.kd is not None
    return Experiment(
        rivals=tuple(keys),
        motions=plan.motions,
        repeats=plan.repeats,
        payload=plan.payload,
        duration=r.duration,
        before=before,
        repeated=repeated,
        after=after,
        pairs={pair: (float(x), float(y)) for pair, x, y in zip(named, separations[0], separations[2], strict=True)},
        inseparable=tuple(pair for pair, can in zip(named, hopeful, strict=True) if not can),
        spread=float(np.ptp(paths[:, 0], axis=0).max()),
        units=tuple("m" if slide else "rad" for slide in slides),
        joint_names=r.joint_names,
        time=r.time,
        target=r.command,
        reference=r.position,
        torque=plan.torque,
        kp=r.kp,
        kd=r.kd,
        limits=limits,
    )


def _words(keys: Sequence[Key]) -> str:
    names = [f"{effect.replace('_', ' ')} of {joint or 'the robot'}" for effect, joint in keys]
    return f"{', '.join(names[:-1])} and {names[-1]}"
