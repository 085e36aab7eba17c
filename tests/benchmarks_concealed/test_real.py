"""What is concealed on a real bench is what the case says, and the grade of an answer is what its words say."""

from __future__ import annotations

import json
from dataclasses import replace
from functools import partial

import mujoco
import numpy as np
import pytest

from benchmarks import concealed_real
from benchmarks.concealed.run import program_digest
from benchmarks.concealed_real import Case, Takes, cases, coarse, complete, graded, late, misread, moved, stiff, weak
from benchmarks.real_robots.complete import ARMS
from torchrl_athletic.effects import CATALOGUE
from torchrl_athletic.recordings import Recording
from torchrl_athletic.robots.benches import pendulum


def take(samples: int = 200, **more) -> Recording:
    time = 0.005 * np.arange(samples)
    motion = np.column_stack([np.sin(7 * time), np.cos(5 * time)])
    given = {"torque_command": np.column_stack([np.arange(samples), -np.arange(samples)]).astype(float)} | more
    return Recording(time, ("a", "b"), motion, velocity=np.gradient(motion, time, axis=0), **given)


def test_the_cases_have_names_of_their_own_and_truths_of_the_catalogue():
    names = [c.name for c in cases()]
    assert len(set(names)) == len(names) == 159
    assert all(name.isascii() and "/" not in name and " " not in name for name in names)
    assert {effect for c in cases() for effect, _ in c.truths} <= {e.name for e in CATALOGUE}
    injected = [c for c in cases() if c.kind == "injected" and c.bench not in ARMS]
    assert all(sum((d.bench, d.what) == (c.bench, c.what) for d in injected) == 3 for c in injected)


def test_a_robot_that_answers_late_logged_its_command_early():
    shifted = late(take(), -0.02, joint=1).torque_command
    np.testing.assert_array_equal(shifted[:-4, 1], take().torque_command[4:, 1])
    np.testing.assert_array_equal(shifted[:, 0], take().torque_command[:, 0])


def test_a_stiffer_servo_logged_a_gain_that_was_too_small():
    gains = {"kp": np.array([8.0, 6.0]), "kd": np.ones(2)}
    servo = replace(take(), torque_command=None, position_target=take().position, **gains)
    assert stiff(servo, joint=1, scale=0.5).kp.tolist() == [8.0, 12.0]


def test_stamps_that_jitter_less_than_a_quarter_of_a_sample_shift_alike():
    jitter = np.random.default_rng(0).uniform(-5e-4, 5e-4, 200)
    steady = take()
    shaken = Recording(steady.time + jitter, steady.joint_names, steady.position, torque_command=steady.torque_command)
    np.testing.assert_array_equal(late(shaken, 0.02).torque_command, late(steady, 0.02).torque_command)


def test_a_late_command_and_an_early_one_take_each_other_back_but_for_the_ends():
    there_and_back = late(late(take(), 0.015), -0.015).torque_command
    np.testing.assert_array_equal(there_and_back[:-3], take().torque_command[:-3])


def test_a_position_target_is_shifted_where_it_is_the_command():
    targets = take(torque_command=None, position_target=take().position, kp=np.ones(2), kd=np.ones(2))
    np.testing.assert_array_equal(late(targets, -0.005).position_target[:-1], targets.position_target[1:])


def test_a_servo_that_misreads_its_encoder_gives_the_same_torque():
    targets = take(torque_command=None, position_target=take().position + 0.1, kp=np.ones(2), kd=np.ones(2))
    wrong = misread(targets, 1, 0.3)
    np.testing.assert_allclose(wrong.position_target - wrong.position, 0.1)
    np.testing.assert_allclose(wrong.position - targets.position, [[0.0, 0.3]] * 200)


def test_a_coarse_encoder_reads_whole_steps_within_half_a_step_and_has_no_better_velocity():
    read = coarse(take(), 0.02)
    np.testing.assert_allclose(read.position / 0.02, np.round(read.position / 0.02), atol=1e-9)
    assert 0.005 < np.abs(read.position - take().position).max() <= 0.01 + 1e-12
    assert read.velocity is None


def test_a_weak_motor_is_one_that_was_asked_for_more():
    np.testing.assert_allclose(0.6 * weak(take(), 0, 0.6).torque_command[:, 0], take().torque_command[:, 0])


def test_what_concealing_moves_is_nothing_where_nothing_is_concealed_and_grows_with_the_size():
    swing = Recording(
        0.005 * np.arange(400), ("pendulum",), np.sin(4 * 0.005 * np.arange(400))[:, None],
        torque_command=np.zeros((400, 1)),
    )  # fmt: skip
    whole = Takes(pendulum(frictionloss=0.2), (swing,), ())
    size = [moved(whole, Takes(pendulum(frictionloss=f), (swing,), ()))["pendulum"] for f in (0.2, 0.15, 0.0)]
    assert size[0] == 0.0
    assert 2 * size[1] < size[2]


FIELDS = {
    "coulomb_friction": {"dof_frictionloss"},
    "viscous_friction": {"dof_damping"},
    "reflected_inertia": {"dof_armature", "tendon_armature", "body_inertia"},
    "link_mass": {"body_mass", "body_inertia"},
    "encoder_offset": {"body_quat"},
    "torque_offset": {"opt.gravity"},
}


def test_the_model_lacks_what_was_removed_and_nothing_else(real_recordings):
    for case in (c for c in cases() if c.bench not in ARMS):  # whose logs one fetches
        before, after = complete(case.bench), case.takes()
        if case.kind != "removed" or case.what.startswith(("drive", "actuation")) or before.model == after.model:
            continue
        models = [mujoco.MjModel.from_xml_string(takes.model) for takes in (before, after)]
        watched = set().union(*FIELDS.values()) - {"opt.gravity"}
        changed = {
            f for f in watched if not np.allclose(*(getattr(m, f) for m in models), rtol=1e-5, atol=1e-12)
        }  # MJCF is written in six digits
        changed |= {"opt.gravity"} if not np.allclose(*(m.opt.gravity for m in models), atol=1e-12) else set()
        assert changed, case.name
        assert changed <= FIELDS[case.what.split()[0]], case.name


def test_a_kind_of_motion_that_is_kept_aside_is_not_fitted(real_recordings):
    kept = [c for c in cases() if c.kind == "left_out"]
    assert len(kept) == 13
    for case in kept:
        takes = case.takes()
        assert {r.metadata["excitation"] for r in takes.aside} == {case.what}
        assert case.what not in {r.metadata["excitation"] for r in takes.fit}


def finding(effect: str, joint: str | None, probability: float = 0.9, *rivals: tuple[str, str, float]) -> dict:
    return {
        "effect": effect, "joint": joint, "probability": probability, "parameters": {},
        "grounds": {"open": 0.1, "energy": 0.9, "senseless": False},
        "rivals": [{"effect": e, "joint": j, "probability": p} for e, j, p in rivals],
    }  # fmt: skip


def answered(*findings: dict, closed: float = 0.9, **more) -> dict:
    score = {"before": 2.0, "after": 1.0, "floor": 0.1, "share_closed": closed}
    fit = {"heldout": score, "train": {"per_joint": {"elbow": score, "hip": score}}}
    answer = {"verdict": "explained", "findings": list(findings), "fit": fit, "quality": {"recordings": []}}
    return {"commit": "c", "seconds": 1.0, "answer": answer, **more}


FRICTION = Case("bench", "removed", "coulomb_friction elbow", "1 N·m", lambda: None, (("coulomb_friction", "elbow"),))


@pytest.mark.parametrize(
    ("said", "grade"),
    [
        ([finding("coulomb_friction", "elbow")], "named"),
        ([finding("stribeck_friction", "elbow")], "contained"),
        ([finding("backlash", "elbow", 0.6, ("coulomb_friction", "elbow", 0.2))], "rival"),
        ([finding("backlash", "elbow")], "joint"),
        ([finding("payload", "elbow")], "missed"),  # the complete model's own answer says so too
        ([finding("coulomb_friction", "elbow", 0.04)], "missed"),
        ([finding("backlash", "elbow", 0.1, ("coulomb_friction", "elbow", 0.6))], "named"),  # the likelier one
        ([finding("coulomb_friction", "elbow", 0.1, ("backlash", "elbow", 0.6))], "rival"),
        ([finding("coulomb_friction", "elbow", 0.2, ("backlash", "elbow", 0.2))], "named"),  # of equals the first
        ([finding("backlash", "elbow", 0.6, ("coulomb_friction", "elbow", 0.04))], "joint"),
        ([finding("coulomb_friction", "hip")], "missed"),
        ([], "missed"),
    ],
)
def test_a_name_counts_with_its_joint_and_less_the_further_it_is_from_the_truth(said, grade):
    control = answered(finding("payload", "elbow"))
    assert graded(FRICTION, answered(*said), control)["grade"] == grade


@pytest.mark.parametrize(
    ("said", "of_control", "grade"),
    [
        ([finding("coulomb_friction", "elbow")], [finding("coulomb_friction", "elbow", 0.1)], "control"),
        ([finding("coulomb_friction", "elbow")], [finding("coulomb_friction", "elbow", 0.04)], "named"),
        ([finding("coulomb_friction", "elbow")], [finding("coulomb_friction", "hip")], "named"),
        ([finding("stribeck_friction", "elbow")], [finding("stribeck_friction", "elbow")], "control"),
        (
            [finding("backlash", "elbow", 0.6, ("coulomb_friction", "elbow", 0.2))],
            [finding("payload", "elbow", 0.6, ("coulomb_friction", "elbow", 0.2))],
            "control",
        ),
    ],
)
def test_a_name_that_the_complete_model_gives_too_is_no_discovery(said, of_control, grade):
    assert graded(FRICTION, answered(*said), answered(*of_control))["grade"] == grade


def test_where_there_is_one_joint_naming_it_is_no_merit():
    alone = answered(finding("backlash", "elbow"))
    del alone["answer"]["fit"]["train"]["per_joint"]["hip"]
    assert graded(FRICTION, alone, answered())["grade"] == "missed"


def test_a_case_that_fails_is_counted_among_those_that_the_noise_allows():
    failed = {"commit": "c0ffee", "error": "ValueError: x", "moved": {"elbow": 0.5, "hip": 0.01}}
    row = graded(FRICTION, failed, answered())
    assert row["grade"] == "failed"
    counts = concealed_real.figures([row])["removed"]
    assert counts["all"]["failed"] == counts["noise_allows"]["failed"] == 1
    assert "| failed | `c0ffee` |" in concealed_real.report([row])


def test_a_case_whose_time_ended_before_anything_was_simulated_has_failed():
    ended = {**answered(), "answer": {**answered()["answer"], "fit": {}, "complete": False}}
    ended["moved"] = {"elbow": 0.5, "hip": 0.01}
    row = graded(FRICTION, ended, answered())
    assert (row["grade"], row["error"]) == ("failed", "nothing simulated within its time budget")
    assert row["over_noise"] > 0
    assert "over_noise" not in graded(FRICTION, ended, ended)  # nothing is known of the bench's own error


def test_a_name_stated_above_one_half_is_counted_where_it_is_the_truths():
    likely, unlikely, wrong = (
        graded(FRICTION, answered(finding(name, "elbow", p)), answered())
        for name, p in (("coulomb_friction", 0.6), ("coulomb_friction", 0.4), ("backlash", 0.9))
    )
    assert concealed_real.figures([likely, unlikely, wrong])["removed"]["all"]["named_over_half"] == 1


def test_only_a_new_name_that_is_likely_is_a_false_one():
    case = Case("bench", "injected", "quantisation", "1 mrad", lambda: None)
    control = answered(finding("payload", "elbow"))
    assert graded(case, answered(finding("payload", "elbow")), control)["grade"] == "quiet"
    assert graded(case, answered(finding("backlash", "elbow", 0.4)), control)["grade"] == "quiet"
    assert graded(case, answered(finding("backlash", "elbow", 0.6)), control)["grade"] == "false"


def test_a_kind_left_out_is_understood_when_half_of_its_gap_closes():
    case = Case("bench", "left_out", "swing-up", "", lambda: None)
    assert graded(case, answered(closed=0.6), None)["grade"] == "closed"
    assert graded(case, answered(closed=0.4), None)["grade"] == "open"


def test_what_is_moved_is_held_against_the_noise_and_the_misfit_of_the_complete_model():
    row = graded(FRICTION, answered(moved={"elbow": 0.5, "hip": 0.01}), answered())
    assert row["over_noise"] == pytest.approx(5.0)
    assert row["over_misfit"] == pytest.approx(0.25)
    counts = concealed_real.figures([row])["removed"]
    assert (counts["noise_allows"]["missed"], counts["larger_than_other_misfit"]["cases"]) == (1, 0)


@pytest.mark.slow
def test_a_removed_friction_is_found_and_kept_for_the_next_time(real_recordings, tmp_path, monkeypatch):
    case = next(c for c in cases() if c.name.startswith("pendulum-removed-coulomb"))
    concealed_real.main(concealed_real.Config(only=(case.name,), answers=tmp_path, output=tmp_path / "table.md"))
    content = json.loads((tmp_path / f"{case.name}.json").read_text(encoding="utf-8"))
    assert content["answer"]["findings"][0]["joint"] == "pendulum"
    assert content["moved"]["pendulum"] > 0.01  # rad
    monkeypatch.setattr(concealed_real, "in_own_process", partial(pytest.fail, "it was run again"))
    concealed_real.main(concealed_real.Config(only=(case.name,), answers=tmp_path, output=tmp_path / "table.md"))
    assert "coulomb_friction pendulum" in (tmp_path / "table.md").read_text(encoding="utf-8")


def test_a_case_that_does_not_finish_is_kept_as_failed_and_run_again_when_asked_for(tmp_path):
    name = "pendulum-complete"
    said = concealed_real.in_own_process(name, concealed_real.Config(answers=tmp_path, timeout=0.01))
    assert "not finished after 0.01 s" in said
    kept = json.loads((tmp_path / f"{name}.json").read_text(encoding="utf-8"))
    assert kept["case"] == name
    assert "not finished" in kept["error"]
    assert not concealed_real._is_done(tmp_path / f"{name}.json", concealed_real.Config())


def test_an_answer_of_another_diagnosis_is_not_done(tmp_path):
    path = tmp_path / "case.json"
    path.write_text(json.dumps({"answer": {}, "program": program_digest("diagnosis")}), encoding="utf-8")
    assert concealed_real._is_done(path, concealed_real.Config())
    assert not concealed_real._is_done(path, concealed_real.Config(time_budget=120.0))  # it had more time
    path.write_text(json.dumps({"answer": {}, "program": "older"}), encoding="utf-8")
    assert not concealed_real._is_done(path, concealed_real.Config())
