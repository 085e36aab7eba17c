"""The standard joints of a robot fitted to its recordings: every number with its interval, or why it has none."""

from __future__ import annotations

import time
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, field, replace
from pathlib import Path
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from torchrl_athletic.diagnosis.acting import acting
from torchrl_athletic.diagnosis.coarse import coarse, in_steps_of, steps_alike
from torchrl_athletic.diagnosis.compare import harms, score
from torchrl_athletic.diagnosis.corrected import Simulation, write_atomically, write_json
from torchrl_athletic.diagnosis.corrected_xml import Commands, corrected_xml, logged_gains
from torchrl_athletic.diagnosis.coupled import with_coupled_drives
from torchrl_athletic.diagnosis.deadline import Deadline
from torchrl_athletic.diagnosis.descent import Linearised, descend, linearise
from torchrl_athletic.diagnosis.extension import extend, with_gear
from torchrl_athletic.diagnosis.fit import Hypothesis
from torchrl_athletic.diagnosis.folder import locked
from torchrl_athletic.diagnosis.given_scale import held_back, with_given_scales
from torchrl_athletic.diagnosis.joint_fit import MOST, affordable, best_of, over_needed, prune, search
from torchrl_athletic.diagnosis.links import asks_for_links, with_links
from torchrl_athletic.diagnosis.memory import free_memory
from torchrl_athletic.diagnosis.model import Model, load_model
from torchrl_athletic.diagnosis.prepare import Drive, Prepared, prepare
from torchrl_athletic.diagnosis.problem import Problem, tellings, weighed, window_cost
from torchrl_athletic.diagnosis.progress import Progress
from torchrl_athletic.diagnosis.replay import Take
from torchrl_athletic.diagnosis.result import Score
from torchrl_athletic.diagnosis.screen import Candidate
from torchrl_athletic.diagnosis.standard import STILL, Agreement, Seen, agreement, seen_in, standard_joints, starts
from torchrl_athletic.diagnosis.torque_columns import column_doubts
from torchrl_athletic.diagnosis.veto import veto_sentence, vetoed
from torchrl_athletic.effects import Parameter
from torchrl_athletic.recordings import Recording, cut_stretches, recorded_time

Array = NDArray[np.float64]
State = Literal["identified", "not needed", "not identified", "taken back"]

SCHEMA = "torchrl_athletic/fit/1"
STAGES = {"quality": 2.0, "search": 40.0, "extend": 25.0, "prune": 20.0, "score": 10.0}
DRAWS = 24
"""Starts by chance."""
SCARCE = 100
"""Windows of half a second, fewer of which a search can afford only of six joints or so: then it takes longer physics
steps, and so many windows."""
SLOPES = 3
"""Jacobians at most after what is not needed has gone."""
LONGEST = 300.0
"""Time that is used of the recordings that are fitted, and of those kept aside [s]."""
GIGABYTE = 2.0**30
FIXED, VALUE = 0.9e9, 600.0
"""Memory of the libraries and of a batch of simulations, and of one reading of one joint [byte]."""
UNREACHED = "never reached"
"""How it is said that a torque limit was not met."""
UNSHOWN = "no recording shows it"
ALSO = "the same motion follows from"
"""Why a parameter has no number where another one does as well."""
SAME = 1.01
"""Error up to which a fit without parameters that have no number of their own follows as well [1]."""
INVISIBLE = 1e-3
"""Change of a window's error, in typical errors, that five changes worth mentioning must make to be seen [1]."""
ALIKE = 1e-4
"""Least eigenvalue of the correlations between parameters' motions; below it two or more are one and the same [1]."""
SHARE = 0.05
"""Share of a parameter in such a combination from which on it has no number of its own [1]."""
WIDE = 5.0
"""Changes worth mentioning that the half of an interval may hold, unless the number itself is larger [1]."""


@dataclass(frozen=True)
class JointParameter:
    """One number of one joint."""

    joint: str
    effect: str
    """Name from the catalogue."""
    name: str
    unit: str
    given: float
    """The given model's."""
    value: float
    """The corrected simulation's; the given model's where it is not needed."""
    ci95: tuple[float, float]
    """Interval of the fit of all parameters where this one is not needed."""
    state: State
    remark: str = ""
    """Why it is not identified."""


@dataclass(frozen=True, eq=False)
class Fit:
    """The standard joints, fitted."""

    parameters: tuple[JointParameter, ...]
    """All, joint by joint."""
    nominal: Simulation
    """The given model."""
    corrected: Simulation
    """The given model with what is needed."""
    scores: Mapping[str, Score]
    """'train' and, when recordings were kept aside, 'heldout'."""
    remarks: tuple[str, ...]
    """Bounds that bind, corrections that were taken back."""
    model: str
    xml: str
    seconds: float
    recordings: tuple[Recording, ...] = field(default=(), repr=False)
    heldout: tuple[Recording, ...] = field(default=(), repr=False)

    def to_json(self) -> dict[str, Any]:
        """The content of ``fit.json``, schema 1."""
        return {
            "schema": SCHEMA,
            "model": self.model,
            "parameters": [{**asdict(p), "ci95": list(p.ci95)} for p in self.parameters],
            "fit": {split: {**asdict(s), "per_joint": dict(s.per_joint)} for split, s in self.scores.items()},
            "remarks": list(self.remarks),
            "seconds": round(self.seconds, 1),
        }

    def save(self, output: str | Path) -> None:
        """Write ``fit.png``, ``corrected.json``, ``corrected.xml`` and, last, ``fit.json``.

        Raises:
            BlockingIOError: If another diagnosis or fit is writing there.
            FileExistsError: If the folder holds a diagnosis.
        """
        with locked(Path(output), "diagnosis.json"):
            self._save(Path(output))

    def _save(self, output: Path) -> None:
        from torchrl_athletic.diagnosis.report.fit_picture import fit_picture

        (output / "fit.json").unlink(missing_ok=True)
        write_json(output / "corrected.json", {**self.corrected.to_json(), "model_xml": self.xml})
        kinds = {r.position_target is None for r in self.recordings}
        commands: Commands | None = None if len(kinds) != 1 else "torques" if kinds.pop() else "targets"
        gains = logged_gains(self.recordings)
        write_atomically(output / "corrected.xml", corrected_xml(self.xml, self.corrected, commands, gains=gains))
        fit_picture(self).savefig(output / "fit.png", dpi=150)
        write_json(output / "fit.json", self.to_json())


def fit(
    model: Model,
    recordings: Sequence[Recording],
    heldout: Sequence[Recording] = (),
    *,
    drive: Drive = "command",
    seed: int = 0,
    extended: bool = True,
    time_budget: float | None = None,
    memory: float | None = None,
    output: str | Path | None = None,
    progress: Progress | None = None,
) -> Fit:
    """Fit the standard joint model in simulation, and leave out what recordings kept aside do not ask for.

    Dry and viscous friction, rotor, torque scale (or gains), torque limit, delay and offsets of every joint, together.
    The error that is stated, over windows of half a second, never ends above the given model's.

    Args:
        model: MJCF as a path, as text or as an ``MjSpec``; every joint of it must be recorded.
        recordings: Takes to fit; folds of them decide what is needed.
        heldout: Takes kept aside: they are scored, and may take back what was corrected at a joint.
        drive: Whether the commanded or the measured torque drives the simulation.
        seed: Of starts and of the choice of windows.
        extended: Whether laws beyond the standard joint are tried, and kept where folds ask for them.
        time_budget: Time after which the best that was found by then is handed back [s].
        memory: To take at most, about [GB]; None for half of what is free. Longer recordings are thinned.
        output: Folder for ``fit.json``, ``fit.png``, ``corrected.json`` and ``corrected.xml``; nothing is written
            without.
        progress: Bar to move.

    Raises:
        RecordingError: If the recordings cannot be used, or do not fit the model.
        ModelError: If MuJoCo cannot compile the model.
        BlockingIOError: If another diagnosis or fit is writing to the same folder.
        FileExistsError: If the folder holds a diagnosis.

    Example:
        >>> from torchrl_athletic.recordings.datasets import load_dataset
        >>> bench = load_dataset("pendulum")  # doctest: +SKIP
        >>> fit(bench.model, bench.recordings, bench.heldout).parameters[0]  # doctest: +SKIP
        JointParameter(joint='pendulum', effect='coulomb_friction', ...)
    """
    if output is not None:
        with locked(Path(output), "diagnosis.json"):
            pass  # what would keep it from being written is said now, not after the fit
    begun, deadline = time.monotonic(), Deadline(np.inf if time_budget is None else time_budget)
    progress = progress or Progress(STAGES)
    compiled, xml, name = load_model(model)
    progress.stage("quality")
    order = recordings[0].joint_names if recordings else ()
    values = ((free_memory() / 2 if memory is None else memory * GIGABYTE) - FIXED) / VALUE
    whole = sum(recorded_time(r)[-1] for r in recordings)
    recordings = cut_stretches(recordings, LONGEST, 0.6 * values)
    heldout = cut_stretches(heldout, LONGEST, 0.4 * values)
    kept = sum(recorded_time(r)[-1] for r in recordings)
    train = prepare([r.ordered(order) for r in recordings], compiled, drive, xml=xml)
    kernel = train.signals[0].kernel
    held = prepare([r.ordered(order) for r in heldout], compiled, drive, kernel, xml=xml) if heldout else None
    doubts = [f"Warning: {text}" for text in column_doubts(train, held)]
    for doubt in doubts:
        progress.say(doubt)
    seen = seen_in(train)
    h = with_coupled_drives(standard_joints(train, seen), train, seen)
    free = h.bounds[1] > h.bounds[0]

    progress.stage("search")
    near, takes = _searched(h, train, seen, seed, deadline, progress)
    torques = near.problem.torques or agreement(h, train)
    if extended:
        progress.stage("extend")
        known = near.problem.hypothesis
        near = _with_laws(near, train, seen, seed, deadline, progress)
        h = near.problem.hypothesis
        free, torques = h.bounds[1] > h.bounds[0], near.problem.torques or agreement(h, train)
        if h is not known:  # a new law may be what is scaled alike
            near = with_given_scales(near, torques, deadline.part(0.65))
    progress.stage("prune")
    needed = prune(near, deadline.part(0.7), progress.update)
    x, y = near.values, over_needed(near, needed)
    y = best_of(near.problem, (y, np.where(needed, x, h.nominal)), 1)[0]
    fine, y = _polished(near.problem, takes, y, needed, _rng(seed, "steps"), deadline.part(0.76))
    again = linearise(weighed(fine, y), y, needed)
    needed = needed & (y != h.nominal)  # what ends where the given model has it
    asked, before = needed, _parameters(h, near, again, y, needed, seen)
    if deadline.part(0.78).allows(3 * again.seconds):
        again, needed = _without_unknown(near, again, needed, seen, torques, deadline.part(0.8))
        y = again.values

    progress.stage("score")
    y, needed = _no_worse(h, (y, x), (needed, free & (x != h.nominal)), train, seed)
    parameters = _parameters(h, near, again, y, needed, seen)
    parameters = _still_unknown(parameters, before, (asked & ~needed)[free])
    parameters = tuple(replace(p, ci95=_around(p.value, p.ci95)) for p in parameters)
    remarks = doubts + [_binds(p, bounds) for p, bounds in zip(parameters, _free_parameters(h), strict=True)]
    if kept < 0.99 * whole:
        remarks.append(f"Of {whole:.0f} s of recordings, {kept:.0f} s were fitted, in stretches over all of them.")
    gone: tuple[Candidate, ...] = ()
    if held is not None:
        stated = score(held.takes, h, y, held.position_noise, _rng(seed, "heldout"))[0]
        floor = np.array([joint["floor"] for joint in stated.per_joint.values()])
        gone = vetoed(h, y, held.takes, _rng(seed, "heldout"), floor)
        moved = [c.where for c in h.terms if any(h.values_of(c, needed))]
        remarks.append(veto_sentence(gone, moved))
        parameters = tuple(_taken_back(p, gone) for p in parameters)
        for c in gone:
            h.values_of(c, needed)[:] = False
    corrected = Simulation(compiled, tuple(order), *acting(again.problem, y, needed, gone))
    result = Fit(
        parameters=parameters,
        nominal=Simulation(compiled, tuple(order), Hypothesis(()), np.zeros(0)),
        corrected=corrected,
        scores=_scores(corrected, train, held, seed),
        remarks=tuple(r for r in remarks if r),
        model=name,
        xml=xml,
        seconds=time.monotonic() - begun,
        recordings=_driven(recordings, drive),
        heldout=_driven(heldout, drive),
    )
    if output is not None:
        result.save(output)
    progress.update(1.0)
    return result


def _searched(
    h: Hypothesis, train: Prepared, seen: Seen, seed: int, deadline: Deadline, progress: Progress
) -> tuple[Linearised, Mapping[Take, Take]]:
    """The standard joints where the search of them ends, and the take of each copy that was searched by."""
    begin = starts(h, train, seen, _rng(seed, "starts"), DRAWS)
    takes, most = {take: take for take in train.takes}, MOST
    if affordable(h, train.takes, deadline) < SCARCE:
        given, regressed = begin[:2]
        takes, most = coarse(train.takes, h, [given, regressed], _rng(seed, "coarse")), SCARCE
    rng, until, torques = _rng(seed, "search"), deadline.part(0.5), agreement(h, train)
    near = search(h, tuple(takes), begin, rng, until, torques, most, progress.update)
    return with_given_scales(near, torques, deadline.part(0.55)), takes


def _polished(
    problem: Problem,
    takes: Mapping[Take, Take],
    x: Array,
    needed: NDArray[np.bool_],
    rng: np.random.Generator,
    deadline: Deadline,
) -> tuple[Problem, Array]:
    """The solution over what is needed, from values (P,), in the longest steps that move by it as the takes' own do.

    Args:
        problem: In the steps of the search.
        takes: Copy of each take in those steps -> the take.
        x: First guess. Shape (P,).
        needed: What may move. Shape (P,).
        rng: Draws the windows by which steps are compared.
        deadline: Of the descents.

    Returns:
        The problem in those steps, and its solution.
    """
    h, copies = problem.hypothesis, takes
    shorter = steps_alike(copies, h, x, rng)
    while True:
        problem = in_steps_of(problem, shorter)
        copies = {shorter[copy]: take for copy, take in copies.items()}
        x = descend(weighed(problem, x), x, needed, SLOPES, deadline)
        if deadline.over:
            return problem, x
        shorter = steps_alike(copies, h, x, rng)
        if all(copy is other for copy, other in shorter.items()):
            return problem, x


def _rng(seed: int, purpose: str) -> np.random.Generator:
    return np.random.default_rng([seed, *purpose.encode()])


def _driven(recordings: Sequence[Recording], drive: Drive) -> tuple[Recording, ...]:
    return tuple(r.driven_by_measured_torque() if drive == "measured" else r for r in recordings)


def _scores(corrected: Simulation, train: Prepared, held: Prepared | None, seed: int) -> dict[str, Score]:
    sets = {"train": train} if held is None else {"train": train, "heldout": held}
    return {
        split: score(
            p.takes, corrected.hypothesis, corrected.values, p.position_noise, _rng(seed, split), p.repeatability
        )[0]
        for split, p in sets.items()
    }


def _with_laws(
    near: Linearised, train: Prepared, seen: Seen, seed: int, deadline: Deadline, progress: Progress
) -> Linearised:
    """The fit with a gear, laws and links that folds ask for; what links leave is asked for laws again."""
    near = with_gear(near, train, _rng(seed, "gear"), deadline.part(0.6))
    near = extend(near, train, seen, deadline.part(0.62), progress.update)
    if not asks_for_links(near):
        return near
    linked = with_links(near, train, _rng(seed, "links"), deadline.part(0.63))
    return near if linked is near else extend(linked, train, seen, deadline.part(0.64), progress.update)


def _no_worse(
    h: Hypothesis, points: Sequence[Array], free: Sequence[NDArray[np.bool_]], train: Prepared, seed: int
) -> tuple[Array, NDArray[np.bool_]]:
    """The first of some fits whose stated error is not above the given model's, with what it needs; else nothing."""
    for x, needed in zip(points, free, strict=True):
        stated = score(train.takes, h, x, train.position_noise, _rng(seed, "train"), train.repeatability)[0]
        if not harms(stated):
            return x, needed
    return h.nominal, np.zeros(len(h.nominal), dtype=bool)


def _free_parameters(h: Hypothesis) -> list[Parameter]:
    return [p for p in h.parameters if p.upper > p.lower]


def _parameters(
    h: Hypothesis, near: Linearised, again: Linearised, y: Array, needed: NDArray[np.bool_], seen: Seen
) -> tuple[JointParameter, ...]:
    """All free parameters, with what the fit of all of them and that of the needed ones say."""
    doubt, reasons = spread_of(near), _reasons(near, again, needed, seen)
    own = dict(zip(np.flatnonzero(again.free), spread_of(again), strict=True))
    out, at = [], np.flatnonzero(near.free)
    place = [(c, p) for c in h.terms for p in c.parameters]
    for k, i in enumerate(at):
        c, p = place[i]
        centre, sigma = (y[i], own.get(i, doubt[k])) if needed[i] else (near.values[i], doubt[k])
        low, high = np.clip([centre - 1.96 * sigma, centre + 1.96 * sigma], p.lower, p.upper)
        why = reasons[k]
        if why.startswith(UNREACHED) and y[i] < seen.asked[c.joint]:  # it is, by what is stated
            why = UNSHOWN
        elif why.startswith(UNREACHED):
            low, high = float(seen.asked[c.joint]), p.upper
        state: State = "not identified" if why else "identified" if needed[i] else "not needed"
        out.append(
            JointParameter(
                c.where, c.effect.name, p.name, p.unit, p.nominal, float(y[i]), (float(low), float(high)), state, why
            )
        )
    return tuple(out)


def _still_unknown(
    parameters: Sequence[JointParameter], before: Sequence[JointParameter], dropped: NDArray[np.bool_]
) -> tuple[JointParameter, ...]:
    """What was dropped since it has no number of its own is not identified, with the interval that says so."""
    return tuple(
        replace(b, value=p.value) if gone else p for p, b, gone in zip(parameters, before, dropped, strict=True)
    )


def _around(value: float, interval: tuple[float, float]) -> tuple[float, float]:
    """The interval with the value that is stated: of what is held at the given one, a fit of all may say another."""
    return min(interval[0], value), max(interval[1], value)


def _reasons(near: Linearised, again: Linearised, needed: NDArray[np.bool_], seen: Seen) -> list[str]:
    """Why each parameter of the fit of all has no number of its own, or empty."""
    doubt, out = spread_of(near), _doubts(near, seen)
    own = dict(zip(np.flatnonzero(again.free), spread_of(again), strict=True))
    parameters = near.problem.hypothesis.parameters
    for k, i in enumerate(np.flatnonzero(near.free)):
        p = parameters[i]
        centre, sigma = (again.values[i], own.get(i, doubt[k])) if needed[i] else (near.values[i], doubt[k])
        if not out[k] and 1.96 * sigma > max(WIDE * p.scale, abs(centre)):
            out[k] = "its interval is wider than the number itself"
    return out


def _without_unknown(
    near: Linearised,
    again: Linearised,
    needed: NDArray[np.bool_],
    seen: Seen,
    torques: Agreement,
    deadline: Deadline,
) -> tuple[Linearised, NDArray[np.bool_]]:
    """The fit with what has no number of its own as the given model has it, unless it follows the motion worse then.

    Where all of it together is missed, that part goes which is not: in another motion it may drive a joint into a stop.
    """
    unknown = np.zeros(len(needed), dtype=bool)
    unknown[near.free] = [bool(why) and not why.startswith(ALSO) for why in _reasons(near, again, needed, seen)]
    unknown &= needed
    without = _without(again, unknown, needed, torques, deadline)
    if without is None and unknown.sum() > 1 and deadline.allows(4 * again.seconds):
        unknown = _not_missed(again.problem, again.values, unknown)
        without = _without(again, unknown, needed, torques, deadline)
    return (again, needed) if without is None else without


def _without(
    near: Linearised, gone: NDArray[np.bool_], needed: NDArray[np.bool_], torques: Agreement, deadline: Deadline
) -> tuple[Linearised, NDArray[np.bool_]] | None:
    """The fit with some parameters (P,) as the given model has them; None where it follows the motion worse."""
    if not gone.any():
        return None
    problem, left = near.problem, needed & ~gone
    x = held_back(problem.hypothesis, torques, near.values, gone)
    x = descend(weighed(problem, x), x, left, 2, deadline)
    costs = [
        window_cost(problem, problem.squares(problem.errors(v[None])[:, 0])[None]).mean() for v in (near.values, x)
    ]
    return (linearise(weighed(problem, x), x, left), left) if costs[1] < SAME * costs[0] else None


def _not_missed(problem: Problem, x: Array, unknown: NDArray[np.bool_]) -> NDArray[np.bool_]:
    """The most of the unknown parameters that values (P,) do without, what is missed least alone coming first."""

    def costs(values: Array) -> Array:
        return np.asarray(window_cost(problem, problem.mean_square(values)).mean(1), dtype=np.float64)

    index = np.flatnonzero(unknown)
    alone = np.repeat(x[None], len(index), axis=0)
    alone[np.arange(len(index)), index] = problem.hypothesis.nominal[index]
    order = index[np.argsort(costs(alone), kind="stable")]
    sets = np.repeat(x[None], len(index) + 1, axis=0)
    for k, i in enumerate(order):
        sets[k + 1 :, i] = problem.hypothesis.nominal[i]
    cost = costs(sets)
    gone = np.zeros(len(x), dtype=bool)
    gone[order[: int(np.flatnonzero(cost <= SAME * cost[0])[-1])]] = True
    return gone


def spread_of(near: Linearised) -> Array:
    """Standard deviation of each free parameter; windows are independent of each other, samples are not. Shape (P,).

    The sandwich estimate (White 1980), clustered by window. Of a short recording windows overlap: what several of them
    tell they tell once.
    """
    scale = near.problem.hypothesis.scale[near.free]
    normal = near.normal.sum(0) + near.pull_columns.T @ near.pull_columns
    size = np.sqrt(np.maximum(np.diag(normal), 1e-300))
    inverse = np.linalg.pinv(normal / size / size[:, None], rcond=1e-8, hermitian=True) / size / size[:, None]
    middle = near.right.T @ near.right * tellings(near.problem)
    return np.asarray(np.sqrt(np.maximum(np.diag(inverse @ middle @ inverse), 0.0)) * scale, dtype=np.float64)


def _doubts(near: Linearised, seen: Seen) -> list[str]:
    """Why each free parameter has no number of its own; empty where it has one."""
    place = [(c, p) for c in near.problem.hypothesis.terms for p in c.parameters]
    own = [place[i] for i in np.flatnonzero(near.free)]
    normal = near.normal.sum(0)
    size = np.sqrt(np.diag(normal))
    visible = size * WIDE > INVISIBLE * np.sqrt(len(near.normal))
    out = ["" if seen_ else _unseen(c, p, seen) for (c, p), seen_ in zip(own, visible, strict=True)]
    index = np.flatnonzero(visible)
    if len(index) < 2:
        return out
    alike, mixed = np.linalg.eigh(normal[np.ix_(index, index)] / size[index] / size[index][:, None])
    for value, vector in zip(alike, mixed.T, strict=True):
        part = vector**2
        for k in np.flatnonzero(part > SHARE) if value < ALIKE else ():
            others = [own[index[n]] for n in np.argsort(-part) if n != k and part[n] > SHARE][:2]
            names = " and ".join(_words(c, p) for c, p in others)
            out[index[k]] = out[index[k]] or f"{ALSO} {names}"
    return out


def _unseen(c: Candidate, p: Parameter, seen: Seen) -> str:
    if seen.travel[c.joint] < STILL:
        return f"{c.where} never moves"
    if c.effect.name == "torque_saturation":
        return f"{UNREACHED}: it is at least {seen.asked[c.joint]:.3g} {p.unit}"
    return UNSHOWN


def _words(c: Candidate, p: Parameter) -> str:
    name = c.effect.name.replace("_", " ")
    return f"{name} of {c.where}" if p.name in name else f"{name} ({p.name.replace('_', ' ')}) of {c.where}"


def _binds(fitted: JointParameter, p: Parameter) -> str:
    """A sentence where a bound stopped a parameter; a friction of zero is none, and a given limit is given."""
    reach = 1e-6 * (p.upper - p.lower)
    for bound, natural in ((p.lower, 0.0), (p.upper, p.nominal)):
        if abs(fitted.value - bound) <= reach and bound not in (natural, p.nominal):
            unit = "" if p.unit == "1" else f" {p.unit}"
            return (
                f"The {p.name.replace('_', ' ')} of {fitted.joint} ({fitted.effect.replace('_', ' ')}) ends at its "
                f"bound of {bound:.4g}{unit}: the true one may lie beyond, or something else is missing."
            )
    return ""


def _taken_back(p: JointParameter, gone: Sequence[Candidate]) -> JointParameter:
    if p.value == p.given or (p.effect, p.joint) not in {c.key for c in gone}:
        return p
    if p.state == "not identified":
        return replace(p, value=p.given)
    return replace(p, value=p.given, state="taken back", remark="recordings kept aside got worse")
