"""Which gains were logged, which commands, and which recordings are drawn."""

from dataclasses import replace
from types import SimpleNamespace

import mujoco
import numpy as np
import pytest
from diagnosis.plants import pendulum

from torchrl_athletic.diagnosis import outcome
from torchrl_athletic.diagnosis.corrected import Simulation, write_json
from torchrl_athletic.diagnosis.corrected_xml import logged_gains
from torchrl_athletic.diagnosis.fit import Hypothesis
from torchrl_athletic.diagnosis.motions import Limits
from torchrl_athletic.diagnosis.outcome import OVERLAYS, Diagnosis
from torchrl_athletic.diagnosis.result import Answer
from torchrl_athletic.diagnosis.screen import Candidate
from torchrl_athletic.effects import CoulombFriction, JointAddress
from torchrl_athletic.recordings import Recording

STILL = np.zeros((50, 2))


def take(kp=(30.0, 20.0), kd=(3.0, 2.0), source="a.npz", **changes) -> Recording:
    time = np.arange(50) / 100
    return Recording(
        time, ("hip", "knee"), STILL, position_target=STILL, kp=np.array(kp), kd=np.array(kd), source=source, **changes
    )


def torques() -> Recording:
    return replace(take(), position_target=None, torque_command=STILL, kp=None, kd=None)


@pytest.mark.parametrize(
    ("takes", "alike"),
    [
        ([], False),
        ([take()], True),
        ([take(), take()], True),
        ([take(), take(kp=(30.0, 21.0))], False),
        ([take(), take(kd=(3.0, 2.1))], False),
        ([take(), torques()], False),
        ([torques(), take()], False),
    ],
)
def test_gains_are_known_where_all_takes_have_the_same(takes, alike):
    assert logged_gains(takes) == ({"hip": (30.0, 3.0), "knee": (20.0, 2.0)} if alike else None)


@pytest.mark.parametrize(
    ("takes", "commands"),
    [((), None), ((take(),), "targets"), ((torques(),), "torques"), ((take(), torques()), None)],
)
def test_commands_are_of_one_kind_or_none(takes, commands):
    assert Diagnosis(None, None, None, "", recordings=takes)._commands == commands


def test_of_each_kind_some_recordings_are_drawn_with_the_given_and_the_corrected_model():
    given, corrected = (SimpleNamespace(rollout=lambda r, by=by: r.position + by) for by in (1.0, 2.0))
    takes, aside = (tuple(take(source=f"{kind}{k}") for k in range(OVERLAYS + 1)) for kind in ("fitted", "aside"))
    drawn = Diagnosis(None, given, corrected, "", recordings=takes, heldout=aside[:1]).overlays
    assert [(d.recording, d.heldout) for d in drawn] == [
        ("aside0", True),
        *((f"fitted{k}", False) for k in range(OVERLAYS)),
    ]
    for d in drawn:
        assert (d.measured == 0).all()
        assert (d.before == 1).all()
        assert (d.after == 2).all()


@pytest.mark.parametrize(
    ("plan", "told"), [(None, ("", 0.0)), (SimpleNamespace(sentence="Swing.", payload=0.5), ("Swing.", 0.5))]
)
def test_all_files_are_written_and_the_answer_that_says_so_comes_last(tmp_path, monkeypatch, plan, told):
    files = []
    monkeypatch.setattr(outcome, "write_json", lambda path, content: files.append((path, content)))
    monkeypatch.setattr(outcome, "write_atomically", lambda path, text: files.append((path, text)))
    monkeypatch.setattr(outcome, "write", lambda experiment, folder: files.append((folder, experiment)))
    monkeypatch.setattr(outcome, "write_report", lambda *given: files.append((given[3], given)))
    given, corrected = SimpleNamespace(model="model"), SimpleNamespace(to_json=lambda: {"values": 1})
    answer = SimpleNamespace(to_json=lambda: {"verdict": "explained"})
    diagnosis = Diagnosis(answer, given, corrected, "<mujoco/>", maps=("map",))
    diagnosis.__dict__.update(experiment=plan, mjcf=SimpleNamespace(xml="<corrected/>"), overlays=("overlay",))
    diagnosis.save(tmp_path / "out")
    out = tmp_path / "out"
    assert files[0] == (out / "corrected.json", {"values": 1, "model_xml": "<mujoco/>"})
    assert files[1] == (out / "corrected.xml", "<corrected/>")
    assert files[2] == (out, plan)
    assert files[3][1] == (answer, ("map",), ("overlay",), out / "report.html", "model", *told)
    assert files[4] == (out / "diagnosis.json", {"verdict": "explained"})


def test_a_kill_while_it_is_saved_leaves_no_older_answer_beside_newer_files(tmp_path, monkeypatch):
    model = mujoco.MjModel.from_xml_string(pendulum())
    given = Simulation(model, ("pendulum",), Hypothesis(()), np.zeros(0))
    monkeypatch.setattr(Diagnosis, "overlays", ())
    for said in ("The first.", "The second."):
        diagnosis = Diagnosis(Answer("nothing_missing", (said,)), given, given, pendulum())
        diagnosis.save(tmp_path)
        assert Diagnosis.load(tmp_path).answer.summary == (said,)

    def killed(*_given):
        raise SystemExit

    monkeypatch.setattr(outcome, "write_report", killed)
    with pytest.raises(SystemExit):
        diagnosis.save(tmp_path)
    with pytest.raises(FileNotFoundError, match=r"holds no diagnosis\.json"):
        Diagnosis.load(tmp_path)


def delivered(tmp_path, monkeypatch, *, drive="command", complete=True, warning="", output=True):
    """What is handed over of three takes, one of which carried a weight, and where it was saved."""
    measured = {"torque_measured": STILL + 5.0, "torque_semantics": "link_side"}
    takes = tuple(replace(torques(), **measured, source=f"{k}", metadata={"payload_kg": k}) for k in (0.0, 0.5))
    saved = []
    monkeypatch.setattr(Diagnosis, "save", lambda self, folder: saved.append((self, folder)))
    monkeypatch.setattr(Diagnosis, "overlays", ())
    monkeypatch.setattr(Diagnosis, "experiment", None)
    monkeypatch.setattr(Diagnosis, "mjcf", SimpleNamespace(warning=warning))
    aside = (replace(takes[1], source="aside loaded"), replace(takes[0], source="aside"))
    given = SimpleNamespace(xml="<mujoco/>", recordings=takes, heldout=aside, drive=drive, highest_frequency=7.0)
    decided = SimpleNamespace(located=SimpleNamespace(ready=SimpleNamespace(given=given)), evidence=("evidence",))
    answer = Answer("explained", (), complete=complete, remarks=("first",))
    stated = SimpleNamespace(decided=decided, answer=answer, nominal="given", corrected="corrected", maps=("map",))
    found = outcome.deliver(stated, tmp_path if output else None)
    assert [folder for _, folder in saved] == ([tmp_path] if output else [])
    assert all(one is found for one, _ in saved)
    assert (found.nominal, found.corrected, found.maps, found.xml) == ("given", "corrected", ("map",), "<mujoco/>")
    return found


def test_takes_are_handed_over_as_they_drove_the_simulation_without_those_that_carried_a_weight(tmp_path, monkeypatch):
    found = delivered(tmp_path, monkeypatch)
    assert [[r.source for r in takes] for takes in (found.recordings, found.heldout)] == [["0.0"], ["aside"]]
    assert (found.recordings[0].torque_command == 0).all()
    assert (found.evidence, found.highest_frequency) == (("evidence",), 7.0)
    assert found.answer.remarks == ("first",)
    by_current = delivered(tmp_path, monkeypatch, drive="measured", output=False)
    assert (by_current.recordings[0].torque_command == 5).all()


def test_what_the_written_model_cannot_say_is_remarked_and_an_incomplete_answer_brings_no_takes(tmp_path, monkeypatch):
    assert delivered(tmp_path, monkeypatch, warning="No gear.").answer.remarks == ("first", "No gear.")
    stopped = delivered(tmp_path, monkeypatch, complete=False, warning="No gear.")
    assert (stopped.recordings, stopped.heldout, stopped.evidence) == ((), (), ())
    assert stopped.answer.remarks == ("first",)


def test_the_highest_frequency_that_was_asked_for_limits_the_plan(monkeypatch):
    asked = []
    monkeypatch.setattr(outcome, "next_experiment", lambda *given: asked.append(given))
    monkeypatch.setattr(outcome.Limits, "of", lambda takes: Limits(STILL, STILL, STILL))
    part = SimpleNamespace(judge=SimpleNamespace(bank=SimpleNamespace(takes="takes")))
    answer = Answer("explained", (), findings=("finding",))
    for highest in (None, 4.0):
        _ = Diagnosis(answer, None, None, "xml", evidence=(part,), highest_frequency=highest).experiment
    assert [given[:2] + given[3:] for given in asked] == [((part,), ("finding",), "xml")] * 2
    assert asked[0][2] is None
    assert asked[1][2].frequency == 4.0
    _ = Diagnosis(answer, None, None, "xml", highest_frequency=4.0).experiment  # nothing says how far it may go
    assert asked[2] == ((), ("finding",), None, "xml")


def test_a_folder_is_read_back_with_the_base_as_it_was_held_and_effects_of_ones_own(tmp_path):
    """Both simulations hold the base; a catalogue that lacks the effect refuses the file."""
    xml, own = pendulum(), type("Own", (CoulombFriction,), {"name": "own_friction"})()
    model = mujoco.MjModel.from_xml_string(xml)
    parameters = own.parameters(model, JointAddress.of(model, ("pendulum",)), 0)
    law = Hypothesis((Candidate(own, 0, "pendulum", parameters),))
    corrected = Simulation(model, ("pendulum",), law, np.arange(1.0, 1 + len(parameters)), "fixed")
    write_json(tmp_path / "corrected.json", {**corrected.to_json(), "model_xml": xml})
    write_json(tmp_path / "diagnosis.json", Answer("explained", ("Said.",)).to_json())
    back = Diagnosis.load(tmp_path, (own,))
    assert (back.corrected.base, back.nominal.base) == ("fixed", "fixed")
    assert back.corrected.hypothesis.terms[0].effect is own
    np.testing.assert_array_equal(back.corrected.values, corrected.values)
    assert (back.nominal.hypothesis.terms, back.xml, back.answer.summary) == ((), xml, ("Said.",))


def test_the_written_model_takes_the_commands_and_the_gains_that_were_logged(monkeypatch):
    monkeypatch.setattr(outcome, "written", lambda *given, gains: (*given, gains))
    gains = {"hip": (30.0, 3.0), "knee": (20.0, 2.0)}
    for recordings, commands, logged in (((take(), take()), "targets", gains), ((torques(),), "torques", None)):
        diagnosis = Diagnosis("answer", "given", "corrected", "xml", recordings=recordings)
        assert diagnosis.mjcf == ("xml", "corrected", commands, logged)
