"""Which experiment would tell rivals apart: planned along candidate motions, in the torque domain, before any is run.

Every rival was fitted to the recordings, and its fingerprint says what torque it would add along a motion that nobody
has recorded yet. Two rivals are as far apart as the torques that one predicts, on old and planned recordings together,
are from anything that the other can still predict once its parameters and the trims are fitted again. That distance,
in standard deviations of what the encoders let through, is maximised over candidate motions within the robot's limits
(optimal design for model discrimination: Atkinson, Fedorov 1975, doi:10.1093/biomet/62.1.57).
"""

from __future__ import annotations

import json
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import combinations, permutations
from pathlib import Path
from typing import Any, TypeAlias

import mujoco
import numpy as np
from numpy.typing import NDArray
from scipy.interpolate import CubicSpline
from scipy.ndimage import gaussian_filter1d

from torchrl_athletic.diagnosis.corrected import write_json
from torchrl_athletic.diagnosis.fit import Hypothesis
from torchrl_athletic.diagnosis.gates import LEAST_PROBABILITY, Evidence
from torchrl_athletic.diagnosis.replay import simulate, take_of, windows_of
from torchrl_athletic.diagnosis.result import Finding
from torchrl_athletic.diagnosis.screen import KERNEL_CORRELATION, Atom, Key, bounded_least_squares, row_noise
from torchrl_athletic.diagnosis.search import Judge, Scored, alternatives
from torchrl_athletic.effects.effect import is_slide, torque_scale
from torchrl_athletic.effects.payload import far_end
from torchrl_athletic.effects.signals import (
    JointAddress,
    Signals,
    inertia_matrix,
    inverse_dynamics,
    project_recording,
    smooth_dynamics,
    torque_range,
)
from torchrl_athletic.recordings import ExcitationError, Recording, Safety, chirp, multisine, sensor_noise, sine, square

Array = NDArray[np.float64]
Cache: TypeAlias = dict[tuple[Key, tuple[tuple[str, float], ...]], Array]

RATE = 200.0
"""Of the command file [Hz]."""
ENOUGH = 12.0
"""Standard deviations beyond which rivals need not be farther apart: odds of e to the 72, were the noise all."""
MARGIN = 0.9
"""Share of a limit that a plan may use."""
THINNED = 4
"""Every fourth instant of the torque domain is nearly independent of the next: the rest costs time only."""
DRAWS = 6
"""Parameter sets of each rival, as uncertain as the recordings leave them."""
SECONDS = 8.0
"""Length of the excitation, without the ways there and back [s]."""
APART = 3.0
"""Standard deviations that separate a pair; one that no plan sets so far apart is not what a plan is chosen for."""
MOST_PLANS = 60
CONFIRMED = 2
"""Plans that are simulated under every rival before one is proposed."""
GENTLE = 0.2
"""Share of its worth that a plan loses by using up all limits and half a minute."""
BANDWIDTH = 3.0
"""Natural frequency of the position loop where the recordings state no gains [Hz]."""
ROUNDING: Mapping[str, float] = {"steps": 0.02, "sweep": 0.05}
"""Width of the Gaussian that rounds corners which no drive can follow [s]."""


@dataclass(frozen=True, eq=False)
class Limits:
    """What robot and surroundings can take. State yours; :meth:`of` guesses from the model and the recordings."""

    position: Array
    """Lowest and highest position [rad, m]. Shape (J, 2)."""
    velocity: Array
    """Fastest motion [rad/s, m/s]. Shape (J,)."""
    torque: Array
    """Largest torque [N·m, N]. Shape (J,)."""

    @classmethod
    def of(cls, takes: Sequence[Signals]) -> Limits:
        """The model's joint and motor limits.

        Where it states none, 1 rad to both sides of the start, and half more speed and torque than was recorded (but
        1 rad/s, and what bears the link).
        """
        s = takes[0]
        model, address, joints = s.nominal, s.address, range(s.num_joints)
        slide = np.array([is_slide(model, address, j) for j in joints])
        recorded = np.concatenate([t.recording.position for t in takes])
        start = s.recording.position[0]
        reach = np.where(slide, 0.0, 1.0)
        low, high = np.minimum(recorded.min(0), start - reach), np.maximum(recorded.max(0), start + reach)
        limited = model.jnt_limited[address.joint].astype(bool)
        given = model.jnt_range[address.joint]
        clear = np.where(slide, 0.05 * (given[:, 1] - given[:, 0]), 0.06)
        low = np.where(limited, given[:, 0] + clear, low)
        high = np.where(limited, given[:, 1] - clear, high)
        fastest = np.max([np.abs(t.velocity).max(0) for t in takes], axis=0)
        strongest = np.max([np.abs(t.command).max(0) for t in takes], axis=0)
        motor = np.minimum(*np.abs(torque_range(model, address)))
        typical = np.array([torque_scale(model, address, j) for j in joints])
        torque = np.where(np.isfinite(motor), motor, np.maximum(1.5 * strongest, typical))
        return cls(np.stack([low, high], -1), np.maximum(1.5 * fastest, np.where(slide, 0.0, 1.0)), torque)


@dataclass(frozen=True, eq=False)
class Experiment:
    """One excitation that would tell rivals apart, as a command to replay. T samples, J joints."""

    rivals: tuple[Key, ...]
    """(effect, joint) of each."""
    joint: str
    """The joint that moves, or all of them."""
    kind: str
    """'sine', 'sweep' (constant speeds both ways), 'steps', 'chirp' or 'multisine'."""
    amplitude: float
    """To both sides of the pose [rad, m]."""
    frequency: float
    """Of its repetition, or the highest of a band [Hz]."""
    pose: tuple[float, ...]
    """About which it moves [rad, m]. Length J."""
    payload: float
    """Mass to fasten at the far end of the last link, zero for none [kg]."""
    duration: float
    """[s]"""
    before: float
    """Separation of the closest pair on the recordings at hand [standard deviations, at most ENOUGH].

    Of the pairs that can be separated at all.
    """
    repeated: float
    """The same if the old excitation were repeated for as long as the experiment lasts."""
    after: float
    """The same with the experiment."""
    pairs: Mapping[tuple[Key, Key], tuple[float, float]]
    """Separation of each pair before and after."""
    inseparable: tuple[tuple[Key, Key], ...]
    """Pairs that no motion within the limits separates."""
    spread: float
    """Largest difference between the positions that the rivals predict for it [rad, m]."""
    unit: str
    """Of the amplitude: 'rad' or 'm'."""
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
        size = f"±{self.amplitude:.2g} {self.unit}"
        how = {
            "sine": f"Move {self.joint} in a sine of {size} at {self.frequency:.2g} Hz",
            "sweep": f"Move {self.joint} both ways over {size} at a constant "
            f"{4 * self.amplitude * self.frequency:.2g} {self.unit}/s",
            "steps": f"Step {self.joint} by {size} at {self.frequency:.2g} Hz",
            "chirp": f"Move {self.joint} in a sine of {size} that rises from 0.2 to {self.frequency:.2g} Hz",
            "multisine": f"Move all joints at once by up to {size}, up to {self.frequency:.2g} Hz",
        }[self.kind]
        pose = ", ".join(f"{q + 0.0:.2f}" for q in self.pose)
        load = f" with {self.payload:g} kg fastened to the end" if self.payload else ""
        text = (
            f"{how} about ({pose}){load} for {self.duration:.0f} s. It should set {_words(self.rivals)} at least "
            f"{self.after:.1f} standard deviations apart; they are {self.before:.1f} apart now, and repeating the old "
            f"motion would make it {self.repeated:.1f}."
        )
        if self.inseparable:
            which = "; ".join(_words(pair) for pair in self.inseparable)
            text += f" No motion within the limits separates {which}."
        return text

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
            "joint": self.joint,
            "kind": self.kind,
            "amplitude": self.amplitude,
            "unit": self.unit,
            "frequency": self.frequency,
            "pose": list(self.pose),
            "payload_kg": self.payload,
            "duration": self.duration,
            "rate": RATE,
            "joint_names": list(self.joint_names),
            "kp": self.kp.tolist(),
            "kd": self.kd.tolist(),
            "limits": {
                "position": self.limits.position.tolist(),
                "velocity": self.limits.velocity.tolist(),
                "torque": self.limits.torque.tolist(),
            },
            "largest": {
                "position": [self.reference.min(0).tolist(), self.reference.max(0).tolist()],
                "velocity": (RATE * np.abs(np.diff(self.reference, axis=0)).max(0)).tolist(),
                "torque": np.abs(self.torque).max(0).tolist(),
                "difference_between_rivals": self.spread,
            },
        }


def next_experiment(
    evidence: Sequence[Evidence], findings: Sequence[Finding], limits: Limits | None = None
) -> Experiment | None:
    """The experiment for the finding whose rivals share most of the evidence; None where no finding has rivals.

    Args:
        evidence: The parts of the search.
        findings: What is stated, each with its rivals.
        limits: Of the robot; :meth:`Limits.of` the recordings if None.
    """
    for finding in sorted((f for f in findings if f.rivals), key=lambda f: f.probability):
        asked = {(r.effect, r.joint): r.probability for r in finding.rivals}
        asked[finding.effect, finding.joint] = finding.probability
        for part in evidence:
            for term in part.best.fit.terms:
                if term.candidate.key == (finding.effect, finding.joint):
                    options = [
                        (s, asked[key]) for key, s in answer_set(part.judge, part.best, term).items() if key in asked
                    ]
                    if len(options) > 1:
                        return propose(part.judge, [s for s, _ in options], [p for _, p in options], limits)
    return None


def answer_set(judge: Judge, best: Scored, term: Atom) -> dict[Key, Scored]:
    """The combinations with a term replaced by each effect that could stand in its place, best first."""
    kept = {a.candidate.key for a in best.fit.terms if a is not term}
    return {
        next(a.candidate.key for a in s.fit.terms if a.candidate.key not in kept): s
        for s in alternatives(judge, best, term)
    }


def shares(options: Mapping[Key, Scored]) -> dict[Key, float]:
    """Share of the evidence that each option has, those above the least that is printed. Sums to one."""
    evidence = np.array([s.evidence for s in options.values()])
    weight = np.exp(-0.5 * (evidence - evidence.min()))
    kept = {key: float(w) for key, w in zip(options, weight / weight.sum(), strict=True) if w > LEAST_PROBABILITY}
    return {key: w / sum(kept.values()) for key, w in kept.items()}


def propose(
    judge: Judge,
    rivals: Sequence[Scored],
    probabilities: Sequence[float] | None = None,
    limits: Limits | None = None,
    payloads: Mapping[float, mujoco.MjModel] | None = None,
    seconds: float = SECONDS,
) -> Experiment | None:
    """Find the excitation that separates rival explanations best.

    Of equally good ones the short and gentle.

    Args:
        judge: Of the search that found the rivals.
        rivals: Combinations that the recordings cannot tell apart, each fitted to them; the likeliest first.
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
    scene = _Scene(judge, rivals, probabilities)
    known = scene.products([_thinned(s) for s in takes])
    before = scene.separations(known)
    plans, gained = [], []
    for mass, model in {0.0: takes[0].nominal, **(payloads or {})}.items():
        loop = _gains(takes, model)
        for motion in _motions(takes, limits, _joints_of(rivals), seconds):
            plan = _planned(motion, mass, model, takes, limits, loop)
            if plan is not None:
                s = _thinned(project_recording(plan.recording, model, scene.noise, kernel=takes[0].kernel))
                plans.append(plan)
                gained.append(scene.separations(known + scene.products([s]), row_noise([*takes, s])))
    if not plans:
        return None
    hopeful = np.max(gained, axis=0) > APART
    worth = [scene.worth(g, hopeful) * (1 - GENTLE * plan.effort) for g, plan in zip(gained, plans, strict=True)]
    length = sum(float(np.ptp(s.time)) for s in takes)
    for k in np.argsort(worth)[::-1][:CONFIRMED]:
        plan = scene.compensated(plans[k])
        repeated = scene.separations(known + known.times(plan.recording.duration / length))
        if scene.worth(gained[k], hopeful) <= scene.worth(repeated, hopeful):
            return None
        paths = _simulated(plan, rivals)
        if _keeps(paths, limits):
            return _experiment(plan, scene, (before, repeated, gained[k]), hopeful, paths, limits)
    return None


def write(experiment: Experiment, folder: str | Path) -> None:
    """Write ``next_experiment.npz``, to replay, and ``next_experiment.json``, to read.

    The archive holds ``time``, ``joint_names``, ``position_target``, ``kp``, ``kd``, ``reference_position``,
    ``predicted_torque`` and ``metadata`` (JSON). Send each target at its stamp to the position loop with these gains,
    from rest at the first one, and log as ever.
    """
    folder = Path(folder)
    folder.mkdir(parents=True, exist_ok=True)
    report = experiment.report()
    with (folder / "next_experiment.npz").open("wb") as file:
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


def with_payload(xml: str, joint_names: Sequence[str], mass: float) -> mujoco.MjModel:
    """The model with a point mass welded to the far end of the last link.

    Args:
        xml: MJCF.
        joint_names: The recorded joints; the last one moves the link.
        mass: [kg]
    """
    spec = mujoco.MjSpec.from_string(xml)
    model = spec.compile()
    address = JointAddress.of(model, tuple(joint_names))
    last = len(joint_names) - 1
    body = spec.body(model.body(int(address.body[last])).name)
    weight = body.add_body(name="fastened_payload", pos=far_end(model, address, last))
    tiny = 1e-6 * mass
    weight.mass, weight.inertia, weight.explicitinertial = mass, (tiny, tiny, tiny), True
    return spec.compile()


@dataclass(frozen=True, eq=False)
class _Motion:
    """A candidate: what moves how, about which pose."""

    joint: str
    kind: str
    amplitude: float
    frequency: float
    pose: Array
    wave: Array
    """Position about the pose, from rest to rest. Shape (T, J)."""


@dataclass(frozen=True, eq=False)
class _Plan:
    """A motion that the robot can do, as the recording that it would leave."""

    motion: _Motion
    payload: float
    model: mujoco.MjModel
    recording: Recording
    torque: Array
    """Shape (T, J)."""
    effort: float
    """Of speed, torque and time, 0..1."""


@dataclass(frozen=True, eq=False)
class _Products:
    """Inner products of what the rivals predict, one group of rows a joint and set of takes. G groups."""

    of: dict[tuple[int, int], Array]
    """(rival, rival) -> products of their columns, in variances of the noise. Shapes (G, K, K')."""
    count: Array
    """Independent samples in each group. Shape (G,)."""

    def __add__(self, other: _Products) -> _Products:
        of = {pair: np.concatenate([own, other.of[pair]]) for pair, own in self.of.items()}
        return _Products(of, np.concatenate([self.count, other.count]))

    def times(self, factor: float) -> _Products:
        """Of takes that are longer by a factor."""
        return _Products({pair: factor * own for pair, own in self.of.items()}, factor * self.count)


class _Scene:
    """The rivals, what they predict, and how far apart they are."""

    def __init__(self, judge: Judge, rivals: Sequence[Scored], probabilities: Sequence[float] | None) -> None:
        bank, best = judge.bank, rivals[0]
        p = np.asarray(probabilities if probabilities is not None else np.ones(len(rivals)), dtype=float)
        self.rivals, self.takes = list(rivals), bank.takes
        self.pairs = list(combinations(range(len(rivals)), 2))
        self.weight = np.array([p[a] * p[b] for a, b in self.pairs]) / sum(p[a] * p[b] for a, b in self.pairs)
        total, independent = judge.total, judge.independent.sum(1)
        self.sigma = bank.noise
        self.left = (total * judge.mean_square(best.fit)).sum(1) / total.sum(1)
        """Mean square that the likeliest rival leaves, in variances of the noise. Shape (J,)."""
        self.floor = (total * judge.floor).sum(1) / total.sum(1)
        """Below it a difference is no evidence. Shape (J,)."""
        self.level = np.maximum(self.left, self.floor)
        self.memory = np.minimum(bank.independent_samples(bank.rows(best.fit)) / np.maximum(independent, 1e-9), 1.0)
        """Share of the independent samples that the residual's autocorrelation leaves. Shape (J,)."""
        noise = [sensor_noise(s.recording)[0] for s in bank.takes]
        self.noise = np.asarray(np.median(noise, axis=0), dtype=np.float64)
        """Of one position reading. Shape (J,)."""
        self.known = [_Numbers(s, bank.takes[0]) for s in rivals]
        self.draws: list[Array] | None = None

    def products(self, takes: Sequence[Signals]) -> _Products:
        """Of some takes, as one set."""
        columns: list[list[Array]] = [[] for _ in self.rivals]
        count = np.zeros(len(self.sigma))
        for s in takes:
            cache: Cache = {}
            share = min(float(np.median(np.diff(s.time))) / (KERNEL_CORRELATION * s.kernel), 1.0) * self.memory
            count += share * s.valid.sum(0)
            weight = s.valid * np.sqrt(share) / self.sigma
            for own, rival in zip(columns, self.known, strict=True):
                own.append(rival.columns(s, cache) * weight[:, :, None])
        whole = [np.concatenate(own).transpose(1, 0, 2) for own in columns]
        many = range(len(whole))
        pairs = [*permutations(many, 2), *((a, a) for a in many)]
        return _Products({(a, b): whole[a].transpose(0, 2, 1) @ whole[b] for a, b in pairs}, count)

    def separations(self, products: _Products, noise: Array | None = None) -> Array:
        """Of each pair: root of the evidence for the truth against the rival's best answer to it. Shape (pairs,).

        The larger of both directions, since an effect that contains the other can always imitate it, and only the
        count of its parameters speaks against it then.

        Args:
            products: Of the recordings at hand, which come first, and of what is planned.
            noise: Of a search through all of them [N·m], shape (J,); the bank's if None. Stronger motion asks for
                torques in which more passes for noise.
        """
        if self.draws is None:
            rng = np.random.default_rng(0)
            weighted = [products.of[n, n] / self.level[:, None, None] for n in range(len(self.known))]
            self.draws = [rival.draw(w.sum(0), rng) for rival, w in zip(self.known, weighted, strict=True)]
        quiet = np.ones(len(self.sigma)) if noise is None else (self.sigma / noise) ** 2
        out = []
        for a, b in self.pairs:
            ways = [
                np.mean([min(np.sqrt(self._evidence(products, x, one, other, quiet)), ENOUGH) for x in self.draws[one]])
                for one, other in ((a, b), (b, a))
            ]
            out.append(float(max(ways)))
        return np.array(out)

    def _evidence(self, products: _Products, truth: Array, a: int, b: int, quiet: Array) -> float:
        """For rival a with coefficients ``truth`` against rival b fitted to what that predicts, as a search weighs.

        ``quiet``: variance of the bank's noise in that of the search's. Shape (J,).
        """
        left, floor = self.left * quiet, 1.0 + (self.floor - 1.0) * quiet
        level, scale = (np.resize(x, len(products.count)) for x in (np.maximum(left, floor), quiet))
        left = np.resize(left, len(level))
        own, other, cross = self.known[a], self.known[b], products.of[a, b]
        weight = (scale / level)[:, None, None]
        normal = (weight * products.of[b, b]).sum(0) + np.diag(other.doubt)
        answer = bounded_least_squares(normal, truth @ (weight * cross).sum(0), other.low, other.high)
        square = (products.of[a, a] @ truth) @ truth - 2 * truth @ cross @ answer
        square = scale * np.maximum(square + (products.of[b, b] @ answer) @ answer, 0.0)
        worse = np.maximum(left + square / np.maximum(products.count, 1e-9), level)
        strain = float(other.doubt @ answer**2 - own.doubt @ truth**2)
        return max(float(products.count @ np.log(worse / level)) + strain, 0.0)

    def worth(self, separations: Array, hopeful: NDArray[np.bool_]) -> float:
        """Between the closest pair's separation and the mean, where pairs weigh by how probable both are.

        Without pairs that nothing separates.
        """
        if not hopeful.any():
            return 0.0
        some, weight = separations[hopeful], self.weight[hopeful]
        return float(some.min() + weight @ some / max(weight.sum(), 1e-300)) / 2

    def compensated(self, plan: _Plan) -> _Plan:
        """The plan with targets that make the likeliest rival, not the given model, follow the reference."""
        r = plan.recording
        s = project_recording(r, plan.model, self.noise, kernel=self.takes[0].kernel)
        missing = self.known[0].columns(s, {}) @ self.known[0].coefficients
        added = CubicSpline(s.time, missing)(np.clip(r.time, s.time[0], s.time[-1]))
        assert r.kp is not None
        target = r.command - added / r.kp
        return replace(plan, recording=replace(r, position_target=target), torque=plan.torque - added)


class _Numbers:
    """A rival's coefficients: of its linear parameters, and of small changes to its nonlinear ones."""

    def __init__(self, scored: Scored, example: Signals) -> None:
        fit, at = scored.fit, 0
        self.parts: list[tuple[Atom, Array, list[tuple[str, float, float]]]] = []
        numbers, low, high, doubt, prior = ([] for _ in range(5))  # type: tuple[list[float], ...]
        for k, atom in enumerate(fit.atoms):
            effect, parameters = atom.candidate.effect, atom.candidate.parameters
            given = fit.coefficients[at : at + len(atom.linear)]
            at += len(atom.linear)
            sample = effect.fingerprint(_thinned(example, 50), atom.candidate.joint, atom.fixed)
            free = [p for p in parameters if p.name not in atom.fixed][: sample.columns.shape[2]]
            own = np.zeros(len(free) + (sample.constant is not None))
            own[len(free) :] = 1.0
            own[list(atom.shown)] = given
            ends = [(effect.change(p, p.lower), effect.change(p, p.upper)) for p in free]
            steps = []
            for p in parameters:
                if p.name in atom.fixed and p.upper > p.lower:
                    size = max(abs(atom.fixed[p.name]), p.scale)
                    step = 0.05 * size if atom.fixed[p.name] + 0.05 * size <= p.upper else -0.05 * size
                    steps.append((p.name, step, 0.5 * size))
            self.parts.append((atom, own, steps))
            numbers += [*own, *(0.0 for _ in steps)]
            low += [*(e[0] for e in ends), *own[len(free) :], *(-reach for _, _, reach in steps)]
            high += [*(e[1] for e in ends), *own[len(free) :], *(reach for _, _, reach in steps)]
            trim = k >= fit.size
            doubt += [(4 / (e[1] - e[0])) ** 2 if trim else 0.0 for e in ends] + [0.0] * (len(own) - len(free))
            doubt += [(2 / reach) ** 2 for _, _, reach in steps]
            prior += [(0.1 / max(abs(effect.change(p, p.nominal + p.scale)), 1e-12)) ** 2 for p in free]
            prior += [1.0] * (len(own) - len(free) + len(steps))
        self.coefficients, self.low, self.high = np.array(numbers), np.array(low), np.array(high)
        self.doubt, self.prior = np.array(doubt), np.array(prior)

    def columns(self, s: Signals, cache: Cache) -> Array:
        """Of all coefficients [N·m]. Shape (N, J, K)."""
        out = []
        for atom, own, steps in self.parts:
            here = _fingerprint(s, atom, atom.fixed, cache)
            out.append(here)
            for name, step, _ in steps:
                there = _fingerprint(s, atom, {**atom.fixed, name: atom.fixed[name] + step}, cache)
                out.append(((there - here) @ own / step)[:, :, None])
        return np.concatenate(out, axis=2)

    def draw(self, gram: Array, rng: np.random.Generator) -> Array:
        """The fitted coefficients, and others that the recordings allow as well. Shape (DRAWS, K)."""
        normal = gram + np.diag(np.maximum(self.doubt, self.prior))
        scale = 1 / np.sqrt(np.diag(normal))
        root = np.linalg.cholesky(normal * scale * scale[:, None] + 1e-10 * np.eye(len(scale)))
        steps = np.linalg.solve(root.T, rng.standard_normal((len(scale), DRAWS - 1))).T * scale
        linear = np.concatenate([[1.0] * len(own) + [0.0] * len(steps) for _, own, steps in self.parts])
        drawn = [
            bounded_least_squares(normal, normal @ (self.coefficients + step), self.low, self.high) for step in steps
        ]
        return np.stack([self.coefficients, *drawn]) * linear


def _fingerprint(s: Signals, atom: Atom, fixed: Mapping[str, float], cache: Cache) -> Array:
    key = atom.candidate.key, tuple(sorted(fixed.items()))
    if key not in cache:
        f = atom.candidate.effect.fingerprint(s, atom.candidate.joint, fixed)
        cache[key] = f.columns if f.constant is None else np.concatenate([f.columns, f.constant[:, :, None]], 2)
    return cache[key]


def _thinned(s: Signals, every: int = THINNED) -> Signals:
    names = ("keep", "position", "velocity", "acceleration", "command", "required", "missing", "bias", "valid")
    return replace(s, **{name: getattr(s, name)[::every] for name in names})


def _joints_of(rivals: Sequence[Scored]) -> list[int]:
    """Joints that the rivals speak of, and the one before each, whose motion its effects feel."""
    named = {a.candidate.joint for s in rivals for a in s.fit.terms}
    return sorted(named | {j - 1 for j in named if j})


def _motions(takes: Sequence[Signals], limits: Limits, joints: Sequence[int], seconds: float) -> Iterator[_Motion]:
    """Candidates, the joints in turn, until there are enough."""
    low, high = limits.position.T
    start = np.clip(takes[0].recording.position[0], low, high)
    names, middle, half = takes[0].recording.joint_names, (low + high) / 2, (high - low) / 2
    poses = [start] if len(names) == 1 else [start, middle + 0.5 * half]
    count = 0
    streams = [_of_joint(names, j, pose, limits, seconds) for pose in poses for j in joints]
    if len(names) > 1:
        streams.append(_of_all(names, middle, half, seconds))
    while streams and count < MOST_PLANS:
        for stream in list(streams):
            motion = next(stream, None)
            if motion is None:
                streams.remove(stream)
            else:
                count += 1
                yield motion


def _of_joint(names: tuple[str, ...], joint: int, pose: Array, limits: Limits, seconds: float) -> Iterator[_Motion]:
    """Motions of one joint, wide and slow ones first."""
    low, high = limits.position[joint]
    name, fastest = names[joint], MARGIN * limits.velocity[joint]
    for share in (1.0, 0.5, 0.2):
        amplitude = share * MARGIN * (high - low) / 2
        about = pose.copy()
        about[joint] = np.clip(pose[joint], low + amplitude, high - amplitude)
        centred = Safety(fade=0.0)
        for speed in (0.8, 0.3, 0.1):
            frequency = speed * fastest / (4 * amplitude)
            whole = np.ceil(seconds * frequency) / frequency
            if 1 / seconds <= frequency <= 2.0:
                slewed = Safety(slew=speed * fastest)
                wave = square(names, name, [(amplitude, frequency)], RATE, whole, "position_target", slewed)
                yield _Motion(name, "sweep", amplitude, frequency, about, wave.command)
        for frequency in (0.25, 0.5, 1.0, 2.0, 4.0):
            if 2 * np.pi * frequency * amplitude < fastest:
                faded = Safety(fade=min(1.0, 1 / frequency))
                wave = sine(names, name, [(amplitude, frequency)], RATE, seconds, "position_target", faded)
                yield _Motion(name, "sine", amplitude, frequency, about, wave.command)
        highest = min(8.0, fastest / (2 * np.pi * amplitude))
        if highest > 0.4:
            faded = Safety(fade=0.5)
            wave = chirp(names, name, amplitude, (0.2, highest), seconds, RATE, field="position_target", safety=faded)
            yield _Motion(name, "chirp", amplitude, highest, about, wave.command)
        if amplitude / (ROUNDING["steps"] * np.sqrt(2 * np.pi)) < fastest / 2:
            wave = square(names, name, [(amplitude, 1.0)], RATE, seconds, "position_target", centred)
            yield _Motion(name, "steps", amplitude, 1.0, about, wave.command)


def _of_all(names: tuple[str, ...], middle: Array, half: Array, seconds: float) -> Iterator[_Motion]:
    """All joints at once, each over the same share of its range."""
    for share, highest in ((0.8, 0.6), (0.4, 1.2), (0.15, 3.0)):
        try:
            wave = multisine(
                names, None, 1.0, (0.2, highest), seconds, rate=RATE, field="position_target", safety=Safety(fade=0.5)
            )
        except ExcitationError:  # fewer harmonics than joints
            continue
        amplitude = share * half
        yield _Motion("all joints", "multisine", float(amplitude.max()), highest, middle, wave.command * amplitude)


def _planned(
    motion: _Motion,
    mass: float,
    model: mujoco.MjModel,
    takes: Sequence[Signals],
    limits: Limits,
    loop: tuple[Array, Array],
) -> _Plan | None:
    """The recording that a motion would leave on the given model; None if it exceeds a limit or touches something."""
    names, start = takes[0].recording.joint_names, takes[0].recording.position[0]
    path = motion.pose + motion.wave
    rounding = ROUNDING.get(motion.kind)
    if rounding is not None:
        rest = np.repeat(motion.pose[None], round(4 * rounding * RATE), axis=0)
        path = gaussian_filter1d(np.concatenate([rest, path, rest]), rounding * RATE, axis=0, mode="nearest")
    path = np.concatenate([_way(start, path[0], limits), path, _way(path[-1], start, limits)])
    time = np.arange(len(path)) / RATE
    spline = CubicSpline(time, path)
    velocity, acceleration = spline(time, 1), spline(time, 2)
    low, high = limits.position.T
    slack = 1e-3 * (high - low)
    moved = np.ptp(path, axis=0) > 0
    if ((path < low - slack) | (path > high + slack))[:, moved].any():
        return None
    address = JointAddress.of(model, names)
    smooth = smooth_dynamics(model)
    torque = inverse_dynamics(smooth, address, path, velocity, acceleration)
    speed_share, torque_share = np.abs(velocity) / limits.velocity, np.abs(torque) / limits.torque
    if speed_share.max() > 1 or torque_share.max() > MARGIN or _touches(model, address, path):
        return None
    kp, kd = loop
    target = path + (torque + kd * velocity) / kp
    recording = Recording(time, names, path, position_target=target, kp=kp, kd=kd, source="planned")
    effort = float(np.mean([speed_share.max(), torque_share.max(), min(time[-1] / 30, 1.0)]))
    return _Plan(motion, mass, model, recording, torque, effort)


def _way(start: Array, end: Array, limits: Limits) -> Array:
    """From rest to rest, a fifth of a second of waiting at both ends, at half the fastest speed. Shape (T, J)."""
    seconds = max(0.5, float((1.875 * np.abs(end - start) / (0.5 * limits.velocity)).max()))
    x = np.linspace(0, 1, round(seconds * RATE))[:, None]
    way = start + (end - start) * (10 * x**3 - 15 * x**4 + 6 * x**5)
    wait = round(0.2 * RATE)
    return np.concatenate([np.repeat(way[:1], wait, 0), way, np.repeat(way[-1:], wait, 0)])


def _touches(model: mujoco.MjModel, address: JointAddress, path: Array) -> bool:
    """Whether the motion makes parts of the model touch that do not at its start."""
    data, first = mujoco.MjData(model), None
    for q in path[:: round(0.1 * RATE)]:
        data.qpos[address.qpos] = q
        mujoco.mj_fwdPosition(model, data)
        pairs = {tuple(c.geom) for c in data.contact[: data.ncon]}
        first = pairs if first is None else first
        if pairs - first:
            return True
    return False


def _gains(takes: Sequence[Signals], model: mujoco.MjModel) -> tuple[Array, Array]:
    """The recordings' gains, or a critically damped loop of BANDWIDTH."""
    r = takes[0].recording
    if r.kp is not None and r.kd is not None:
        return r.kp, r.kd
    inertia = np.diag(inertia_matrix(model, takes[0].address, r.position[:1])[0])
    w = 2 * np.pi * BANDWIDTH
    return inertia * w**2, inertia * 2 * w


def _simulated(plan: _Plan, rivals: Sequence[Scored]) -> Array:
    """Positions that each rival predicts, on the simulation's grid. Shape (rivals, T, J)."""
    windows = windows_of(take_of(plan.recording, plan.model, np.full(plan.recording.num_joints, 1e-9)), None)
    out = []
    for s in rivals:
        terms = [a.candidate for a in s.fit.terms]
        trims = [a.candidate for a in s.fit.atoms[s.fit.size :]]
        values = np.concatenate(s.fit.values())
        out.append(simulate(windows, Hypothesis(tuple(terms), tuple(trims)).build, values[None])[0, 0])
    return np.stack(out)


def _keeps(paths: Array, limits: Limits) -> bool:
    """Whether no rival leaves the range; a tenth of it stands for what the guess of the reference misses."""
    low, high = limits.position.T
    slack = 0.1 * (high - low)
    return bool(np.isfinite(paths).all() and ((paths > low - slack) & (paths < high + slack)).all())


def _experiment(
    plan: _Plan,
    scene: _Scene,
    separations: tuple[Array, Array, Array],
    hopeful: NDArray[np.bool_],
    paths: Array,
    limits: Limits,
) -> Experiment:
    m, r = plan.motion, plan.recording
    keys = [_answer(s, scene.rivals) for s in scene.rivals]
    named = [(keys[a], keys[b]) for a, b in scene.pairs]
    before, repeated, after = (float(s[hopeful].min()) for s in separations)
    slides = [is_slide(plan.model, scene.takes[0].address, j) for j in range(r.num_joints)]
    assert r.kp is not None
    assert r.kd is not None
    return Experiment(
        rivals=tuple(keys),
        joint=m.joint,
        kind=m.kind,
        amplitude=float(m.amplitude),
        frequency=float(m.frequency),
        pose=tuple(m.pose.tolist()),
        payload=plan.payload,
        duration=r.duration,
        before=before,
        repeated=repeated,
        after=after,
        pairs={pair: (float(x), float(y)) for pair, x, y in zip(named, separations[0], separations[2], strict=True)},
        inseparable=tuple(pair for pair, can in zip(named, hopeful, strict=True) if not can),
        spread=float(np.ptp(paths, axis=0).max()),
        unit="m" if all(slides) else "rad",
        joint_names=r.joint_names,
        time=r.time,
        target=r.command,
        reference=r.position,
        torque=plan.torque,
        kp=r.kp,
        kd=r.kd,
        limits=limits,
    )


def _answer(scored: Scored, rivals: Sequence[Scored]) -> Key:
    """The term of a combination that not all of them have."""
    own = [a.candidate.key for a in scored.fit.terms]
    common = set(own)
    for other in rivals:
        common &= {a.candidate.key for a in other.fit.terms}
    return next(key for key in own if key not in common)


def _words(keys: Sequence[Key]) -> str:
    names = [f"{effect.replace('_', ' ')} of {joint or 'the robot'}" for effect, joint in keys]
    return f"{', '.join(names[:-1])} and {names[-1]}"
