"""A finished diagnosis: what it says, its two simulations, and the files that it is delivered as."""

from __future__ import annotations

import json
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from pathlib import Path

import mujoco
import numpy as np

from torchrl_athletic.diagnosis.corrected import Simulation, write_atomically, write_json
from torchrl_athletic.diagnosis.corrected_xml import Commands, Written, logged_gains, written
from torchrl_athletic.diagnosis.experiment import Experiment, next_experiment, write
from torchrl_athletic.diagnosis.fit import Hypothesis
from torchrl_athletic.diagnosis.folder import locked
from torchrl_athletic.diagnosis.motions import Limits
from torchrl_athletic.diagnosis.prepare import PAYLOAD
from torchrl_athletic.diagnosis.proposal import Proposal
from torchrl_athletic.diagnosis.report import write_report
from torchrl_athletic.diagnosis.result import Answer, Overlay, RegimeMap
from torchrl_athletic.diagnosis.state import Stated
from torchrl_athletic.effects import CATALOGUE, Effect
from torchrl_athletic.recordings import Recording

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
    evidence: tuple[Proposal, ...] = field(default=(), repr=False)
    highest_frequency: float | None = None
    """Highest frequency that a planned experiment may have [Hz]."""

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
    def mjcf(self) -> Written:
        """What ``corrected.xml`` says."""
        return written(self.xml, self.corrected, self._commands, gains=logged_gains(self.recordings))

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

        Each whole or not at all. ``diagnosis.json``, which says that all are there, goes first and comes last: a kill
        in between leaves no older answer beside newer files.

        Raises:
            BlockingIOError: If another diagnosis or fit is writing there.
            FileExistsError: If the folder holds a fit.
            OSError: If the disk is full, or the folder cannot be written to; names the file.
        """
        with locked(Path(output), "fit.json"):
            self._save(Path(output))

    def _save(self, output: Path) -> None:
        (output / "diagnosis.json").unlink(missing_ok=True)
        write_json(output / "corrected.json", {**self.corrected.to_json(), "model_xml": self.xml})
        write_atomically(output / "corrected.xml", self.mjcf.xml)
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
        nominal = Simulation(model, corrected.joint_names, Hypothesis(()), np.zeros(0), corrected.base)
        return cls(answer, nominal, corrected, xml)


def deliver(stated: Stated, output: Path | None) -> Diagnosis:
    """The diagnosis; in a folder, too, if there is one. An incomplete one comes without pictures of recordings."""
    given = stated.decided.located.ready.given
    diagnosis = Diagnosis(stated.answer, stated.nominal, stated.corrected, given.xml, stated.maps)
    if stated.answer.complete:
        recordings, heldout = (
            tuple(
                r.driven_by_measured_torque() if given.drive == "measured" else r
                for r in group
                if not r.metadata.get(PAYLOAD)  # neither simulation carries it
            )
            for group in (given.recordings, given.heldout)
        )
        diagnosis = replace(
            diagnosis,
            recordings=recordings,
            heldout=heldout,
            evidence=stated.decided.evidence,
            highest_frequency=given.highest_frequency,
        )
        if warning := diagnosis.mjcf.warning:
            answer = replace(diagnosis.answer, remarks=(*diagnosis.answer.remarks, warning))
            diagnosis = replace(diagnosis, answer=answer)
    if output is not None:
        _ = diagnosis.overlays, diagnosis.experiment  # the dear part, while Ctrl-C still leaves a shorter report
        diagnosis.save(output)
    return diagnosis
