"""A stopped diagnosis leaves a report, goes on where it was, and comes to the answer it would have come to."""

import importlib
import json
from dataclasses import replace

import numpy as np
import pytest
from diagnosis.plants import pendulum, record, smooth_torque

from torchrl_athletic.diagnosis import Diagnosis, diagnose
from torchrl_athletic.diagnosis.checkpoint import Checkpoint, inputs_digest
from torchrl_athletic.diagnosis.corrected import Simulation
from torchrl_athletic.effects import CATALOGUE

ROOM = "torchrl_athletic.diagnosis."
work, propose, simulate = (importlib.import_module(ROOM + name) for name in ("diagnose", "propose", "simulate"))

FEW = tuple(e for e in CATALOGUE if e.name in ("coulomb_friction", "viscous_friction"))
MODEL = pendulum(joint='damping="0.05"')


@pytest.fixture(scope="module")
def recordings():
    true = pendulum(joint='damping="0.2"')
    return [record(true, smooth_torque(3.0, 1.0, seed=k), noise=1e-4, seed=k) for k in range(2)]


def run(recordings, output=None, **settings) -> Diagnosis:
    return diagnose(MODEL, recordings[:1], recordings[1:], catalogue=FEW, output=output, **settings)


@pytest.fixture(scope="module")
def undisturbed(recordings):
    return run(recordings)


def stop(*_args, **_kwargs):
    raise KeyboardInterrupt


def counted(monkeypatch, module, name):
    """Calls of a function from now on."""
    calls, inner = [], getattr(module, name)
    monkeypatch.setattr(module, name, lambda *a, **k: calls.append(1) or inner(*a, **k))
    return calls


@pytest.mark.parametrize(
    ("stage", "module", "name"),
    [("propose", propose, "search"), ("simulate", simulate, "fit_in_steps_of"), ("simulate", simulate, "score")],
)
def test_ctrl_c_leaves_a_partial_report_and_the_next_run_completes_it(
    stage, module, name, recordings, undisturbed, monkeypatch, tmp_path
):
    with monkeypatch.context() as interrupted:
        interrupted.setattr(module, name, stop)
        partial = run(recordings, tmp_path)
    content = json.loads((tmp_path / "diagnosis.json").read_text())
    assert content["complete"] is False
    assert content["stage"] == stage
    assert content["locations"]
    assert partial.answer == Diagnosis.load(tmp_path).answer
    assert "<html" in (tmp_path / "report.html").read_text()
    assert (tmp_path / "corrected.xml").exists()
    assert not list(tmp_path.glob(".*"))  # nothing half written
    fits = counted(monkeypatch, simulate, "fit_in_steps_of")
    resumed = run(recordings, tmp_path)
    assert bool(fits) == (name != "score")
    assert resumed.answer == undisturbed.answer
    assert resumed.answer.complete
    np.testing.assert_array_equal(resumed.corrected.values, undisturbed.corrected.values)
    assert not (tmp_path / "progress.json").exists()


def test_ctrl_c_while_the_report_is_made_leaves_one_without_pictures(recordings, monkeypatch, tmp_path):
    monkeypatch.setattr(Simulation, "rollout", stop)
    partial = run(recordings, tmp_path)
    assert partial.overlays == ()
    assert not partial.answer.complete
    assert partial.answer.findings
    assert json.loads((tmp_path / "diagnosis.json").read_text())["complete"] is False


def test_ctrl_c_before_there_is_anything_to_say_is_passed_on(recordings, monkeypatch, tmp_path):
    monkeypatch.setattr(work, "prepare", stop)
    with pytest.raises(KeyboardInterrupt):
        run(recordings, tmp_path)
    assert not (tmp_path / "diagnosis.json").exists()


@pytest.mark.parametrize("text", ["", "{", "[]", "null", '{"digest": 3}', "\x00"])
def test_a_damaged_checkpoint_is_ignored(text, tmp_path):
    (tmp_path / "progress.json").write_text(text)
    checkpoint = Checkpoint(tmp_path / "progress.json", "abc")
    assert checkpoint.result("fit", lambda: [1.0], list, list) == [1.0]
    assert json.loads((tmp_path / "progress.json").read_text()) == {"digest": "abc", "results": {"fit": [1.0]}}


def test_a_checkpoint_answers_for_the_same_digest_only(tmp_path):
    path = tmp_path / "progress.json"
    Checkpoint(path, "abc").result("fit", lambda: 1, int, int)
    assert Checkpoint(path, "abc").result("fit", lambda: 2, int, int) == 1
    assert Checkpoint(path, "abc").result("other", lambda: 2, int, int) == 2
    assert Checkpoint(path, "xyz").result("fit", lambda: 3, int, int) == 3
    Checkpoint(path, "xyz").remove()
    assert not path.exists()
    assert Checkpoint(None, "abc").result("fit", lambda: 4, int, int) == 4


def test_everything_that_decides_the_answer_is_in_the_digest(recordings):
    one = recordings[0]
    digests = [
        inputs_digest(MODEL, recordings, {"seed": 0}),
        inputs_digest(pendulum(), recordings, {"seed": 1}),
        inputs_digest(pendulum(step=0.001), recordings, {"seed": 0}),
        inputs_digest(MODEL, recordings[::-1], {"seed": 0}),
        inputs_digest(MODEL, recordings[:1], {"seed": 0}),
        inputs_digest(MODEL, [one.slice(0, 299), recordings[1]], {"seed": 0}),
        inputs_digest(MODEL, [replace(one, joint_names=("other",)), recordings[1]], {"seed": 0}),
        inputs_digest(MODEL, [replace(one, metadata={"repeat": 1}), recordings[1]], {"seed": 0}),
        inputs_digest(MODEL, [one.with_base_held((0, 0, 1)), recordings[1]], {"seed": 0}),
        inputs_digest(MODEL, [one.with_base_held((0, 0, 2)), recordings[1]], {"seed": 0}),
        inputs_digest(MODEL, [one.with_base_held((0, 0, 1), (0, 1, 0, 0)), recordings[1]], {"seed": 0}),
        inputs_digest(
            MODEL, [type(one)(one.time, one.joint_names, -one.position, torque_command=one.command)], {"seed": 0}
        ),
    ]
    assert len(set(digests)) == len(digests)
    assert inputs_digest(MODEL, list(recordings), {"seed": 0}) == digests[0]


def test_every_argument_that_decides_the_answer_makes_another_digest(recordings, monkeypatch):
    digests = []
    inner = work.inputs_digest
    monkeypatch.setattr(work, "inputs_digest", lambda *a: digests.append(inner(*a)) or digests[-1])
    monkeypatch.setattr(work, "prepare", stop)
    settings = {"catalogue": FEW}
    for model, train, heldout, changed in [
        (MODEL, recordings[:1], recordings[1:], {}),
        (MODEL, recordings, [], {}),
        (MODEL, recordings[1:], recordings[:1], {}),
        (pendulum(step=0.001), recordings[:1], recordings[1:], {}),
        (MODEL, recordings[:1], recordings[1:], {"seed": 1}),
        (MODEL, recordings[:1], recordings[1:], {"drive": "measured"}),
        (MODEL, recordings[:1], recordings[1:], {"catalogue": FEW[:1]}),
    ]:
        with pytest.raises(KeyboardInterrupt):
            diagnose(model, train, heldout, **{**settings, **changed})
    assert len(set(digests)) == len(digests) == 7


def test_settings_in_another_order_are_the_same_settings_and_others_are_not():
    one = inputs_digest("<mujoco/>", [], {"seed": 1, "drive": "command"})
    assert one == inputs_digest("<mujoco/>", [], {"drive": "command", "seed": 1})
    assert one != inputs_digest("<mujoco/>", [], {"seed": 2, "drive": "command"})
    assert one != inputs_digest("<mujoco />", [], {"seed": 1, "drive": "command"})


def test_a_diagnosis_that_fitted_nothing_has_nothing_to_forget(tmp_path):
    Checkpoint(tmp_path / "progress.json", "inputs").remove()
    assert list(tmp_path.iterdir()) == []
