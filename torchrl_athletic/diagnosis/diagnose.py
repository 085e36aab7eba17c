"""From a model and recordings to a statement of what physics the model leaves out, and a simulation that has it."""

from __future__ import annotations

import json
import time
from collections.abc import Collection, Iterable, Sequence
from contextlib import nullcontext
from dataclasses import dataclass, field, replace
from functools import cached_property
from pathlib import Path
from typing import Any, TypeAlias, get_args

import mujoco
import numpy as np
from numpy.typing import NDArray

from torchrl_athletic.diagnosis.checkpoint import Checkpoint, inputs_digest
from torchrl_athletic.diagnosis.compare import follows, harms, open_share, score
from torchrl_athletic.diagnosis.corrected import Simulation, write_atomically, write_json
from torchrl_athletic.diagnosis.corrected_xml import Commands, corrected_xml
from torchrl_athletic.diagnosis.experiment import Experiment, next_experiment, write
from torchrl_athletic.diagnosis.fit import Fitted, Hypothesis, as_trims, fit, idle_terms, without
from torchrl_athletic.diagnosis.folder import locked
from torchrl_athletic.diagnosis.gates import Evidence, judge_findings, summarise, verdict_of
from torchrl_athletic.diagnosis.identities import with_alternatives
from torchrl_athletic.diagnosis.locate import locate, regime_maps
from torchrl_athletic.diagnosis.motions import Limits
from torchrl_athletic.diagnosis.prepare import PAYLOAD, Drive, Prepared, drive_signals, prepare
from torchrl_athletic.diagnosis.progress import Progress
from torchrl_athletic.diagnosis.remainder import remarks_on
from torchrl_athletic.diagnosis.report import write_report
from torchrl_athletic.diagnosis.result import Answer, Location, Overlay, RegimeMap, Score
from torchrl_athletic.diagnosis.screen import (
    FIT_TRIMS,
    OWN_JOINT,
    TRIMS,
    Bank,
    Candidate,
    Key,
    candidates_for,
    is_trim,
    trims_for,
)
from torchrl_athletic.diagnosis.search import RICHER, Judge, Scored, keys, noisy_joints, richer, rivals, search, singles
from torchrl_athletic.diagnosis.veto import veto_sentence, vetoed
from torchrl_athletic.effects import CATALOGUE, Effect
from torchrl_athletic.effects.base import Base, free_joint, held_base
from torchrl_athletic.effects.effect import is_slide
from torchrl_athletic.recordings import Recording, RecordingError

Array = NDArray[np.float64]
Model: TypeAlias = str | Path | mujoco.MjSpec

CHECKPOINT = "progress.json"
CLOSE = 10.0
"""Evidence within which combinations are left to the simulation to decide."""
MOST_FITS = 4
ASKED = 6.0
"""Evidence behind which a rival is not asked about in the simulation: a twentieth of the odds."""
LOST = 0.5
"""Share of the error energy that the best may leave before each effect is asked about alone."""
FOLLOWS = 2.5
"""Window error over the floor that trims alone may leave before the same."""
ALONE = 2
"""How many of these at a time."""
BEHIND = 9.0
"""Evidence against them: only a simulation that is decisively better speaks for one."""
CLEAR = 0.1
"""Share of the error energy that one may leave to refute those that leave :data:`LOST`, few as its windows may be."""
APART = 2.0
"""Between windows that see two occasions: one blow may be felt that long [s]."""
DRIVE_EFFECTS = ("actuation_delay", "actuation_lag", "torque_scale", "torque_offset")
"""What can happen between a command and a measured torque."""
BEFORE_THE_MOTOR = frozenset({"actuation_delay", "actuation_lag", "torque_saturation", "speed_torque_limit"})
"""What a measured torque has behind it."""
ALIKE = 0.05
"""Difference of the logarithm of the windows' error below which two fits are equally good."""
EXERCISED = 0.02
"""Share of usable instants below which a joint counts as not exercised."""
WORTH = 0.1
"""Share of its tolerance that a trim must use in the torque domain to be adjusted in the simulation."""
OVERLAYS = 4
"""Recordings drawn at most, of each kind."""


@dataclass(frozen=True, eq=False)
class Diagnosis:
    """What a diagnosis says, and the two simulations that it compares."""

    answer: Answer
    nominal: Simulation
    """The given model."""
    corrected: Simulation
    """The given model with the physics that was found."""
    xml: str
    """The given model."""
    maps: tuple[RegimeMap, ...] = field(default=(), repr=False)
    recordings: tuple[Recording, ...] = field(default=(), repr=False)
    """As they drove the simulation; empty after :meth:`load`."""
    heldout: tuple[Recording, ...] = field(default=(), repr=False)
    evidence: tuple[Evidence, ...] = field(default=(), repr=False)
    highest_frequency: float | None = None
    """Of a planned experiment [Hz]."""

    @cached_property
    def experiment(self) -> Experiment | None:
        """What to record next, where a finding has rivals."""
        limits = None
        if self.highest_frequency is not None and self.evidence:
            limits = replace(Limits.of(self.evidence[0].judge.bank.takes), frequency=self.highest_frequency)
        return next_experiment(self.evidence, self.answer.findings, limits, self.xml)

    @property
    def _commands(self) -> Commands | None:
        """What was recorded as commands, if all recordings agree."""
        kinds = {r.position_target is None for r in self.recordings}
        return None if len(kinds) != 1 else "torques" if kinds.pop() else "targets"

    @cached_property
    def overlays(self) -> tuple[Overlay, ...]:
        """Recorded and simulated positions of some recordings."""
        return tuple(
            Overlay(
                r.source, heldout, r.time, r.joint_names, r.position, self.nominal.rollout(r), self.corrected.rollout(r)
            )
            for heldout, recordings in ((True, self.heldout), (False, self.recordings))
            for r in recordings[:OVERLAYS]
        )

    def save(self, output: str | Path) -> None:
        """Write ``diagnosis.json``, ``corrected.json``, ``corrected.xml`` and ``report.html``.

        Each whole or not at all; ``diagnosis.json``, which says that all are there, comes last.

        Raises:
            BlockingIOError: If another diagnosis is writing there.
            OSError: If the disk is full, or the folder cannot be written to; names the file.
        """
        with locked(Path(output)):
            self._save(Path(output))

    def _save(self, output: Path) -> None:
        write_json(output / "corrected.json", {**self.corrected.to_json(), "model_xml": self.xml})
        write_atomically(output / "corrected.xml", corrected_xml(self.xml, self.corrected, self._commands))
        write(self.experiment, output)
        plan, payload = (self.experiment.sentence, self.experiment.payload) if self.experiment else ("", 0.0)
        write_report(self.answer, self.maps, self.overlays, output / "report.html", self.nominal.model, plan, payload)
        write_json(output / "diagnosis.json", self.answer.to_json())

    @classmethod
    def load(cls, output: str | Path, catalogue: Sequence[Effect] = CATALOGUE) -> Diagnosis:
        """Read back what :meth:`save` wrote; the pictures stay in ``report.html``.

        Raises:
            FileNotFoundError: If the folder holds no diagnosis.
        """
        output = Path(output)
        if not (output / "diagnosis.json").exists():
            raise FileNotFoundError(f"{output} holds no diagnosis.json. Name the folder given as --output.")
        answer = Answer.from_json(json.loads((output / "diagnosis.json").read_text(encoding="utf-8")))
        content = json.loads((output / "corrected.json").read_text(encoding="utf-8"))
        xml = content["model_xml"]
        model = mujoco.MjModel.from_xml_string(xml)
        corrected = Simulation.from_json(content, model, catalogue)
        return cls(answer, _as_given(model, corrected.joint_names, corrected.base), corrected, xml)


def diagnose(
    model: Model,
    recordings: Sequence[Recording],
    heldout: Sequence[Recording] = (),
    *,
    joined: Sequence[Recording] = (),
    catalogue: Sequence[Effect] = CATALOGUE,
    drive: Drive = "command",
    base: Base = "recorded",
    seed: int = 0,
    time_budget: float | None = None,
    highest_frequency: float | None = None,
    output: str | Path | None = None,
    progress: Progress | None = None,
) -> Diagnosis:
    """Locate where a model and recordings differ, say what physics was left out, model it, and measure the gain.

    Args:
        model: MJCF as a path, as text or as an ``MjSpec``; every joint of it must be recorded. Its base may float, in
            the air: nobody records the forces of the ground.
        recordings: Takes to fit.
        heldout: Takes of another kind, used only to compare and to score.
        joined: Takes of experiments that an earlier diagnosis proposed, to fit as well.
        catalogue: Effects to consider.
        drive: Whether the commanded or the measured torque drives the simulation.
        base: Of a floating robot: ``"recorded"`` takes its pose from the recordings, ``"fixed"`` holds it where the
            model has it.
        seed: Of the bootstrap and of the choice of windows.
        time_budget: Wall-clock time after which no further combination is fitted [s].
        highest_frequency: Of the experiment that is planned for rivals [Hz]; as high as the logs allow if None.
        output: Folder for the report. Without it nothing is written, and nothing can be resumed.
        progress: Bar to move.

    Returns:
        The diagnosis; ``answer.complete`` is False if a KeyboardInterrupt stopped it, and what was found by then
        stands in it.

    Raises:
        RecordingError: If the recordings cannot be used, or do not fit the model.
        ModelError: If MuJoCo cannot compile the model.
        ValueError: If ``highest_frequency`` is not above zero.
        BlockingIOError: If another diagnosis is writing to the same folder.
        OSError: If the disk is full, or the folder cannot be written to; names the file.
        KeyboardInterrupt: If it came before anything was found.

    Example:
        >>> from torchrl_athletic.recordings.demo import concealed_demo
        >>> demo = concealed_demo(seed=3)
        >>> diagnosis = diagnose(demo.model_xml, demo.recordings, demo.heldout)  # doctest: +SKIP
        >>> diagnosis.answer.findings[0].effect == demo.secret.name  # doctest: +SKIP
        True
    """
    if highest_frequency is not None and not highest_frequency > 0:
        raise ValueError(f"highest_frequency is {highest_frequency} Hz. Give more than 0, or leave it out.")
    compiled, xml, name = load_model(model)
    order = recordings[0].joint_names if recordings else ()
    takes = ((*recordings, *joined), heldout)
    fitted, aside = (tuple(_stood(r.ordered(order), compiled, base) for r in group) for group in takes)
    work = _Work(
        compiled, xml, name, fitted, aside, tuple(catalogue), drive, seed, time_budget,
        None if output is None else Path(output), progress or Progress(), len(joined), base, highest_frequency,
    )  # fmt: skip
    with locked(work.output) if work.output is not None else nullcontext():
        return _finished(work)


def _finished(work: _Work) -> Diagnosis:
    """All stages, or those until Ctrl-C, and their report."""
    try:
        work.run()
        result = work.conclude()
        if work.output is not None:  # the dear part of the report, while Ctrl-C still leaves a shorter one
            _ = result.overlays, result.experiment
    except KeyboardInterrupt:
        if work.signals_bank is None:
            raise
        work.interrupted = True
        result = work.conclude()
    if work.output is not None:
        result.save(work.output)
        if result.answer.complete:
            work.checkpoint.remove()
    if result.answer.complete:
        work.progress.update(1.0)
    return result


def _stood(recording: Recording, model: mujoco.MjModel, base: Base) -> Recording:
    """The recording with the base where the model has it, if it is said to be fixed."""
    if base not in get_args(Base):
        raise ValueError(f"base is {base!r}, needed is one of {', '.join(map(repr, get_args(Base)))}.")
    if base == "fixed" and free_joint(model) is not None and recording.base_position is not None:
        raise RecordingError(
            f"{recording.source}: base_position was recorded, and base is said to be 'fixed'. Leave one out: the "
            "recorded pose may be constant."
        )
    return recording if base == "recorded" else held_base(recording, model)


def load_model(model: Model) -> tuple[mujoco.MjModel, str, str]:
    """Compile MJCF given as a path, as text or as a spec.

    Returns:
        The model, its MJCF and its name.

    Raises:
        FileNotFoundError: If the path does not exist.
        ModelError: If MuJoCo cannot compile it.
    """
    source = "the model"
    try:
        if isinstance(model, mujoco.MjSpec):
            spec = model.copy()
        elif isinstance(model, str) and model.lstrip().startswith("<"):
            spec = mujoco.MjSpec.from_string(model)
        else:
            source = str(model)
            if not Path(model).is_file():
                raise FileNotFoundError(f"{source}: there is no such model. Name an MJCF file, or pass its text.")
            spec = mujoco.MjSpec.from_file(str(Path(model).resolve()))  # absolute, or it forgets its folder
        if spec.modelfiledir and (spec.meshes or spec.textures or spec.hfields):  # its MJCF is written elsewhere
            spec.meshdir = str(Path(spec.modelfiledir, spec.meshdir).resolve())
            spec.texturedir = str(Path(spec.modelfiledir, spec.texturedir).resolve())
        return spec.compile(), spec.to_xml(), spec.modelname or "model"
    except ValueError as error:
        reason = " ".join(str(error).split())
        raise ModelError(
            f"{source}: MuJoCo cannot compile it ({reason}). Mend it until MuJoCo's viewer opens it."
        ) from error


class ModelError(ValueError):
    """A model that MuJoCo cannot compile; the message names it and says why."""


@dataclass(eq=False)
class _Work:
    """A diagnosis in the making: each stage adds its result, and :meth:`conclude` states what there is at any time."""

    model: mujoco.MjModel
    xml: str
    name: str
    recordings: tuple[Recording, ...]
    heldout: tuple[Recording, ...]
    catalogue: tuple[Effect, ...]
    drive: Drive
    seed: int
    time_budget: float | None
    output: Path | None
    progress: Progress
    joined: int = 0
    """How many of the recordings, the last ones, are of experiments."""
    base: Base = "recorded"
    highest_frequency: float | None = None
    started: float = field(default_factory=time.monotonic)
    interrupted: bool = False
    inputs: str = ""
    """Their digest."""
    stage: str = "quality"
    train: Prepared | None = None
    held: Prepared | None = None
    signals_bank: Bank | None = None
    locations: tuple[Location, ...] = ()
    drive_evidence: Evidence | None = None
    options: tuple[Evidence, ...] = ()
    """Combinations for the mechanics, best first."""
    fits: list[Fitted] = field(default_factory=list)
    """One for each option that was fitted."""
    scores: list[dict[str, Score]] = field(default_factory=list)
    adjusted: set[Key] = field(default_factory=set)
    """Trims that may move in all fits alike."""
    errors: list[Array] = field(default_factory=list)
    """Of every window of the fitted recordings, of each fit. Shapes (W, J)."""
    began: Array = field(default_factory=lambda: np.zeros(0))
    """When these windows start [s]. Shape (W,)."""
    chosen: int = 0

    def run(self) -> None:
        """All stages, in order."""
        settings = {
            "drive": self.drive,
            "seed": self.seed,
            "catalogue": [e.name for e in self.catalogue],
            "fitted": len(self.recordings),
            "joined": self.joined,
        }
        self.inputs = inputs_digest(self.xml, (*self.recordings, *self.heldout), settings)
        self.checkpoint = Checkpoint(None if self.output is None else self.output / CHECKPOINT, self.inputs)
        self._begin("quality")
        self.train = prepare(self.recordings, self.model, self.drive, joined=self.joined, xml=self.xml)
        self.progress.update(0.6)
        kernel = self.train.signals[0].kernel
        self.held = prepare(self.heldout, self.model, self.drive, kernel, xml=self.xml) if self.heldout else None
        self._begin("floor")
        self._begin("locate")
        self.signals_bank = Bank(self.train.signals, ())
        self.locations = locate(self.signals_bank, self._rng("locate"))
        self._begin("screen")
        self._screen()
        self._begin("fit")
        self._fit()
        self._begin("compare")
        self._compare()
        self._start_over()
        self._begin("gates")
        self._begin("report")

    def _begin(self, stage: str) -> None:
        self.stage = stage
        self.progress.stage(stage)

    def _rng(self, purpose: str) -> np.random.Generator:
        return np.random.default_rng([self.seed, *purpose.encode()])

    def _late(self) -> bool:
        return self.time_budget is not None and time.monotonic() - self.started > 0.6 * self.time_budget

    def _screen(self) -> None:
        assert self.train is not None
        signals = self.train.signals
        catalogue = self.catalogue
        cut = self.drive == "command" and all(
            s.recording.torque_semantics == "current_derived" and s.recording.torque_command is not None
            for s in signals
        )
        if cut:  # the measured torque cuts the chain in two: the drive before it, the mechanics behind it
            of_drive = [e for e in catalogue if e.name in DRIVE_EFFECTS]
            self.drive_evidence = _search(drive_signals(self.train), of_drive, ())[0]
            signals = prepare(self.recordings, self.model, "measured", signals[0].kernel, self.joined, self.xml).signals
        if cut or self.drive == "measured":  # what was measured has passed the drive's lags and limits
            catalogue = tuple(e for e in catalogue if e.name not in BEFORE_THE_MOTOR)
        taken = {a.candidate.key for a in self.drive_evidence.best.fit.terms} if self.drive_evidence else set()
        self.options = tuple(_search(signals, catalogue, trims_for(signals, TRIMS), taken, self.progress))

    def _fit(self) -> None:
        """Fit the options that are not fitted yet, all with the same trims."""
        assert self.train is not None
        takes = self.train.takes
        self.adjusted = self.adjusted or set().union(*map(_adjusted, self.options))
        for k, option in list(enumerate(self.options))[len(self.fits) :]:
            if k and self._late():
                break
            hypothesis, start = _hypothesis(option, self.drive_evidence, self.adjusted)

            def compute(hypothesis: Hypothesis = hypothesis, start: Array = start) -> Fitted:
                return fit(hypothesis, takes, start, self._rng("fit"), progress=self.progress.update)

            def decode(content: dict[str, Any], hypothesis: Hypothesis = hypothesis) -> Fitted:
                samples = np.array(content["samples"]).reshape(-1, len(content["values"]))
                return Fitted(hypothesis, np.array(content["values"]), samples, content["cost"])

            fitted = self.checkpoint.result(_key(hypothesis), compute, _encode, decode)
            direct = self.drive_evidence.best.fit.terms if self.drive_evidence else ()  # two channels show it
            seen = {a.candidate.key for a in direct}
            idle = [c for c in idle_terms(fitted, takes, self._rng("idle")) if c.key not in seen]
            self._keep(fitted, idle)

    def _keep(self, fitted: Fitted, idle: Sequence[Candidate]) -> None:
        """Take a fit over, without the terms that it does not need; what is too small for a finding becomes a trim."""
        fitted = without(fitted, idle)
        h, period = fitted.hypothesis, max(1.0 / r.rate for r in self.recordings)
        joints = len(self.recordings[0].joint_names)
        small = [t for t in h.terms if is_trim(t, h.values_of(t, fitted.values), period, joints)]
        self.fits.append(as_trims(fitted, small))

    def _compare(self) -> None:
        """Score the fits that are not scored yet, and choose."""
        assert self.train is not None
        for k, fitted in list(enumerate(self.fits))[len(self.scores) :]:
            self.scores.append(self._score(fitted, choose=True))
            self.progress.update((k + 1) / len(self.fits))
        if not self.errors:
            return
        scored = [s["train"] for s in self.scores]
        self.chosen, against, taken = _decide(self.options, self.errors, scored, self.began)
        needed = [
            {c.key for c in (*f.hypothesis.terms, *f.hypothesis.trims) if t and c in _candidates(o)}
            for o, f, t in zip(self.options, self.fits, taken, strict=False)
        ]
        simulated = {keys(o.best.fit.terms): float(a) for o, a in zip(self.options, against, strict=False)}
        self.options = tuple(
            replace(o, simulated=simulated, others=_others(self.options, needed, k)) for k, o in enumerate(self.options)
        )

    def _score(self, fitted: Fitted, choose: bool = False) -> dict[str, Score]:
        """Error of a fit; to choose by it, the windows of the fitted recordings are kept."""
        scores: dict[str, Score] = {}
        for split, prepared in (("train", self.train), ("heldout", self.held)):
            if prepared is not None:
                scores[split], _, after, began = score(
                    prepared.takes, fitted.hypothesis, fitted.values, prepared.position_noise, self._rng(split),
                    prepared.repeatability,
                )  # fmt: skip
                if choose and split == "train":  # what was kept aside scores the answer, it does not choose it
                    self.errors.append(after)
                    self.began = began
        return scores

    def _start_over(self) -> None:
        """Where what fits the torques best leaves most of the motion open, ask about each effect alone.

        A combination may mimic the torques of a joint that sticks, and move otherwise. And trims that take all of a
        small effect's torque for their own, since each is within its tolerance, may not move like it.

        What closes most of the torque comes first. The others that close a material share follow as long as nothing is
        named and most stays open; of so many, one may look better by chance or stand in, so that more is asked of them.
        """
        if not self.scores or self._late() or not (self._is_lost() or self._is_unnamed()):
            return
        known = {keys(o.best.fit.terms) for o in self.options}
        judge = self.options[0].judge
        material, others = singles(judge)
        alone = [s for s in material or others if keys(s.fit.terms) not in known]
        self._ask(Evidence(judge, s, BEHIND, alone=True) for s in alone[:ALONE])
        later = [Evidence(judge, s, BEHIND, on_trial=True, alone=True) for s in alone[ALONE:] if material]
        while later and self._is_lost() and self._is_unnamed() and not self._late():
            self._ask(later[:ALONE])
            later = later[ALONE:]

    def _ask(self, options: Iterable[Evidence]) -> None:
        """Fit and compare further options."""
        self.options = (*self.options[: len(self.fits)], *options)
        self._fit()
        self._compare()

    def _is_lost(self) -> bool:
        """Whether most of the motion is still open, and torque that noise does not explain."""
        return open_share(self.scores[self.chosen]["train"]) >= LOST and self._is_open(self.fits[self.chosen])

    def _is_unnamed(self) -> bool:
        """Whether nothing is named and the simulation does not follow."""
        return not self.fits[self.chosen].hypothesis.terms and not follows(self.scores[self.chosen]["train"], FOLLOWS)

    def conclude(self) -> Diagnosis:
        """State what there is."""
        assert self.train is not None
        assert self.signals_bank is not None
        names = self.recordings[0].joint_names
        nominal = _as_given(self.model, names, self.base)
        fitted = self.fits[self.chosen] if self.fits else None
        corrected = nominal if fitted is None else replace(nominal, hypothesis=fitted.hypothesis, values=fitted.values)
        scores = self.scores[self.chosen] if self.scores else {}
        evidence = [
            e for e in (self.drive_evidence, self.options[self.chosen] if self.options else None) if e is not None
        ]
        findings = judge_findings(evidence, fitted, scores.values()) if fitted is not None else ()
        applying = [e for e in self.catalogue if all(e.applies(s) for s in self.train.signals)]
        findings = with_alternatives(findings, names, applying, _damped(self.recordings))
        is_open = self._is_open(fitted)
        verdict, share = verdict_of(evidence, findings, scores.get("train"), scores.get("heldout"), is_open)
        if verdict == "nothing_missing" or harms(scores.get("train")):
            corrected = nominal
        taken_back = ""
        if self.held is not None and "heldout" in scores and fitted is not None and corrected is not nominal:
            floor = np.array([joint["floor"] for joint in scores["heldout"].per_joint.values()])
            gone = vetoed(fitted.hypothesis, fitted.values, self.held.takes, self._rng("heldout"), floor)
            if gone:
                taken_back = veto_sentence(gone, names)
                fitted = without(fitted, gone)
                corrected = replace(nominal, hypothesis=fitted.hypothesis, values=fitted.values)
                scores = self._score(fitted)
        last = scores.get("heldout", scores.get("train"))
        summary = summarise(verdict, findings, self.locations, last, "heldout" in scores, share)
        if harms(scores.get("train")):
            summary += ("What fits best makes the simulation worse, so that the corrected model is the given one.",)
        if taken_back:
            summary += (taken_back,)
        if self.interrupted and not self.fits:
            summary = ("Stopped before anything was named; where the error is stands below.",)
        summary += tuple(
            f"{joint} hardly moves, so that nothing is known of it."
            for joint, used in self.train.used_share().items()
            if used < EXERCISED
        )
        complete = not self.interrupted and self.stage == "report"
        answer = Answer(
            verdict=verdict,
            summary=summary,
            findings=findings,
            locations=self.locations,
            fit=scores,
            unexplained_share=share,
            quality=self._quality(),
            model=self.name,
            complete=complete,
            stage=self.stage,
            seed=self.seed,
            inputs=self.inputs,
            remarks=self._remarks(evidence, corrected) if complete else (),
        )
        maps = tuple(self._maps(evidence))
        if not complete:
            return Diagnosis(answer, nominal, corrected, self.xml, maps)
        recordings, heldout = (
            tuple(
                r.driven_by_measured_torque() if self.drive == "measured" else r
                for r in group
                if not r.metadata.get(PAYLOAD)  # neither simulation carries it
            )
            for group in (self.recordings, self.heldout)
        )
        return Diagnosis(
            answer, nominal, corrected, self.xml, maps, recordings, heldout, tuple(evidence), self.highest_frequency
        )

    def _is_open(self, fitted: Fitted | None) -> bool:
        """Whether some joint misses torque that noise does not explain, with all numbers within their tolerances."""
        if not self.options:
            return False
        option = self.options[self.chosen]
        small = {c.key for c in fitted.hypothesis.trims} if fitted is not None else set()
        within = [a for a in option.best.fit.terms if a.candidate.key in small]
        return bool(option.judge.is_open(option.judge.score(within).fit).any())

    def _quality(self) -> dict[str, Any]:
        assert self.train is not None
        s = self.train.signals[0]
        units = {n: "m" if is_slide(s.nominal, s.address, j) else "rad" for j, n in enumerate(s.recording.joint_names)}
        report = self.train.report()
        if self.held is not None:
            report["recordings"] += self.held.report()["recordings"]
        return {**report, "units": units, "drive": self.drive, "warnings": []}

    def _remarks(self, evidence: Sequence[Evidence], corrected: Simulation) -> tuple[str, ...]:
        assert self.train is not None
        signals = self.train.signals
        left: tuple[str, ...] = ()
        if evidence and self.drive_evidence is None:
            heldout = self.held.signals if self.held else ()
            left = remarks_on(signals, heldout, evidence[-1].best, 0.133 / signals[0].kernel)
        return left + _trimmed(corrected)

    def _maps(self, evidence: Sequence[Evidence]) -> list[RegimeMap]:
        if not evidence:
            assert self.signals_bank is not None
            return regime_maps(self.signals_bank, self.signals_bank.target, self._rng("maps"))
        part = evidence[-1]
        return regime_maps(part.judge.bank, part.judge.bank.rows(part.best.fit), self._rng("maps"))


def _search(
    signals: Sequence[Any],
    catalogue: Sequence[Effect],
    trims: Sequence[Candidate],
    taken: set[Key] = frozenset(),  # type: ignore[assignment]
    progress: Progress | None = None,
) -> list[Evidence]:
    bank = Bank(signals, (), [t for t in trims if t.key not in taken])
    judge = Judge(bank)
    is_open = judge.is_open(judge.bare)
    if is_open.any():
        candidates = [c for c in candidates_for(signals, catalogue) if c.key not in taken]
        bank.extend(c for c in candidates if is_open[c.joint] or c.effect.family not in OWN_JOINT)
    found = search(judge, progress.update if progress else lambda fraction: None)
    if noisy := noisy_joints(judge):
        judge = Judge(bank, noisy)
        found = search(judge)
    return _options(judge, found)


def _options(judge: Judge, found: Sequence[Scored]) -> list[Evidence]:
    """What the simulation decides about: the best combination, a richer law that it gave up, what rivals it closely."""
    first, rich = found[0], richer(judge, found[0])
    out = [Evidence(judge, first)] + ([Evidence(judge, rich, 0.0, on_trial=True)] if rich is not None else [])
    near = [Evidence(judge, s, behind) for s, behind in rivals(judge, first, ASKED)]
    near += [Evidence(judge, s, s.evidence - first.evidence) for s in found[1:]]
    for option in sorted(near, key=lambda e: e.behind):
        if all(keys(option.best.fit.terms) != keys(e.best.fit.terms) for e in out):
            out.append(option)
    return [option for option in out if option.behind <= CLOSE][:MOST_FITS]


def _hypothesis(option: Evidence, drive: Evidence | None, adjusted: Collection[Key]) -> tuple[Hypothesis, Array]:
    """Terms of the mechanics and of the drive, with the values that the torque domain gave them.

    What the two torque channels say of the drive is direct; the simulation may move it by a tenth only.

    Args:
        option: The mechanics.
        drive: The drive, if it was looked at alone.
        adjusted: Trims that may move: the same for all options, which are compared.
    """
    terms, start = [], []
    if drive is not None:
        for atom, values in zip(drive.best.fit.terms, drive.best.fit.values(), strict=False):
            narrow = tuple(
                replace(p, lower=max(p.lower, v - 0.1 * abs(v)), upper=min(p.upper, v + 0.1 * abs(v) + 1e-9))
                for p, v in zip(atom.candidate.parameters, values, strict=True)
            )
            terms.append(replace(atom.candidate, parameters=narrow))
            start.append(values)
    fitted = option.best.fit
    found = fitted.values()
    terms += [a.candidate for a in fitted.terms]
    start += found[: fitted.size]
    known = {a.candidate.key: v for a, v in zip(fitted.atoms, found, strict=True)}
    trims = [
        t
        for t in trims_for(option.judge.bank.takes, FIT_TRIMS)
        if t.key in adjusted and all(t.moves_beside(c) for c in terms)
    ]
    start += [known.get(t.key, np.array([p.nominal for p in t.parameters])) for t in trims]
    return Hypothesis(tuple(terms), tuple(trims)), np.concatenate(start) if start else np.zeros(0)


def _adjusted(option: Evidence) -> set[Key]:
    """Trims that the torque domain asked for, and those that it was not asked about."""
    fitted = option.best.fit
    known = {a.candidate.key: v for a, v in zip(fitted.atoms, fitted.values(), strict=True)}
    return {t.key for t in trims_for(option.judge.bank.takes, FIT_TRIMS) if _moved(t, known.get(t.key))}


def _moved(trim: Candidate, value: Array | None) -> bool:
    """Whether the torque domain asked for a trim; one that it was not asked about may move in the simulation."""
    if value is None:
        return trim.effect.name == "torque_scale"
    reach = np.array([p.upper - p.nominal for p in trim.parameters])
    return bool((np.abs(value - [p.nominal for p in trim.parameters]) > WORTH * reach).any())


def _trimmed(corrected: Simulation) -> tuple[str, ...]:
    """Which of the given numbers were adjusted within their tolerance beside the findings."""
    h = corrected.hypothesis
    changes = []
    for trim in h.trims:
        for p, value in zip(trim.parameters, h.values_of(trim, corrected.values), strict=True):
            words = f"{trim.effect.name.replace('_', ' ')} of {trim.where}"
            if p.nominal and abs(value / p.nominal - 1) >= 0.01:
                changes.append(f"{words} {100 * (value / p.nominal - 1):+.0f} %")
            elif not p.nominal and abs(value) >= 0.1 * p.upper:
                changes.append(f"{words} {p.name} {value:+.2g} {p.unit}")
    if not changes:
        return ()
    return (f"Beside the findings the corrected model was adjusted within its tolerances: {', '.join(changes)}.",)


def _decide(
    options: Sequence[Evidence], errors: Sequence[Array], scores: Sequence[Score], began: Array
) -> tuple[int, Array, list[bool]]:
    """Which option torques and simulation speak for, what the simulation says against each, and which are not refuted.

    Args:
        options: What was fitted, the preferred one first.
        errors: Error of each window, of each option. Shapes (W, J).
        scores: Of the same windows.
        began: When they start [s]. Shape (W,).
    """
    floors = [np.maximum([joint["floor"] for joint in s.per_joint.values()], 1e-12) for s in scores]
    logs = [np.log(np.maximum(e, floor)).sum(1) for e, floor in zip(errors, floors, strict=True)]
    left = [open_share(s) for s in scores]
    taken = [
        not option.on_trial or (_against(logs[0] - e) >= CLOSE and share <= (1 - RICHER) * left[0])
        for option, e, share in zip(options, logs, left, strict=False)
    ]
    least = min((k for k, t in enumerate(taken) if t), key=lambda k: left[k])
    if left[least] <= CLEAR:  # a stop that is reached twice says nothing in the mean of all windows
        for k, error in enumerate(errors):
            floor = np.maximum(floors[k], floors[least])
            if left[k] >= LOST and _misses(error, errors[least], floor, began):
                taken[k] = False
    best = min((e for e, t in zip(logs, taken, strict=True) if t), key=lambda e: float(e.mean()))
    against = np.array([_against(e - best) if t else CLOSE for e, t in zip(logs, taken, strict=True)])
    behind = np.array([o.behind if t else np.inf for o, t in zip(options, taken, strict=False)])
    return int(np.argmin(against + behind)), against, taken


def _candidates(option: Evidence) -> list[Candidate]:
    return [a.candidate for a in option.best.fit.terms]


def _others(options: Sequence[Evidence], needed: Sequence[Collection[Key]], own: int) -> tuple[Scored, ...]:
    """Combinations beside one of them that are not refuted, and of which the simulation needs what is new.

    For effects that were asked about alone only the simulation speaks, and it has decided.

    Args:
        options: All of them.
        needed: Terms that the simulation needs, as small as they may be, of each that was fitted; none of those that it
            refutes.
        own: Number of the one.
    """
    found = keys(options[own].best.fit.terms)
    if options[own].alone:
        return ()
    return tuple(
        o.best
        for k, o in enumerate(options)
        if k != own and not o.alone and (k >= len(needed) or keys(o.best.fit.terms) - found <= set(needed[k]))
    )


def _misses(worse: Array, better: Array, floor: Array, began: Array) -> bool:
    """Whether the one misses some joint on two occasions or more, the other follows there, and nowhere the reverse.

    Args:
        worse: Error of each window. Shape (W, J).
        better: The same of the other option.
        floor: Of the error, shape (J,).
        began: When each window starts [s]. Shape (W,).
    """
    if (better > FOLLOWS * np.maximum(worse, floor)).any():
        return False
    lost = (worse > FOLLOWS * np.maximum(better, floor)) & (better <= FOLLOWS * floor)
    return any((np.diff(began[joint]) > APART).any() for joint in lost.T)


def _against(worse: Array) -> float:
    """Twice the log odds against a combination whose windows have larger log errors.

    The square of their paired z-score, beyond the few per cent by which optimisers that stop sooner differ.
    """
    error = float(worse.std() / np.sqrt(max(len(worse), 1)))
    beyond = max(float(worse.mean()) - ALIKE, 0.0)
    return float(np.clip((beyond / error) ** 2, 0.0, CLOSE)) if error > 0 else 0.0


def _damped(recordings: Sequence[Recording]) -> list[str]:
    """Joints that follow their targets with one kd, above zero, in all recordings."""
    gains = [r.kd for r in recordings if r.kd is not None]
    if len(gains) < len(recordings):
        return []
    alike = (np.min(gains, axis=0) > 0) & (np.ptp(gains, axis=0) == 0)
    return [name for name, same in zip(recordings[0].joint_names, alike, strict=True) if same]


def _key(hypothesis: Hypothesis) -> str:
    """Of a fit in the checkpoint; a mass that is found and one that is adjusted have other bounds."""
    terms, trims = ([f"{c.effect.name}/{c.where}" for c in part] for part in (hypothesis.terms, hypothesis.trims))
    return " ".join(["fit", *terms, "|", *trims])


def _encode(fitted: Fitted) -> dict[str, Any]:
    return {"values": fitted.values.tolist(), "samples": fitted.samples.tolist(), "cost": fitted.cost}


def _as_given(model: mujoco.MjModel, names: tuple[str, ...], base: Base) -> Simulation:
    return Simulation(model, names, Hypothesis(()), np.zeros(0), base)
