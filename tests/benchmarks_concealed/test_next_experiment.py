"""A command file is replayed as a user would, and what it leaves is graded by what no motion can tell apart."""

from __future__ import annotations

import json
from dataclasses import replace
from functools import cache
from types import SimpleNamespace

import numpy as np
import pytest

from benchmarks.concealed import next_experiment
from benchmarks.concealed.cases import Case, Session, prepare
from benchmarks.concealed.hidden import Truth
from benchmarks.concealed.next_experiment import (
    ambiguous,
    grade,
    is_alike,
    is_level,
    is_planar,
    replayed,
    report,
    same_physics,
    stands_on_level_axis,
    weights_alike,
)
from benchmarks.concealed.plant import inverse
from benchmarks.concealed.robots import SEALED, TUNING, with_point
from benchmarks.concealed.score import Row
from torchrl_athletic.diagnosis.thresholds import PLAN


@cache
def session_of(mode: str) -> Session:
    """A case of one joint that hides nothing and errs in nothing but its sensors."""
    return next(
        s
        for s in (prepare("tuning", "nothing", k) for k in range(60))
        if s.robot.joints == 1 and s.case.mode == mode and not s.robot.tree.slide[0]
    )


def command_file(session, folder, swing=0.3, payload=0.0):
    time = np.arange(round(6 * PLAN.rate)) / PLAN.rate
    target = session.robot.centre + swing * np.sin(2 * np.pi * 0.25 * time)[:, None]
    kp, kd = (session.kp, session.kd) if session.case.mode == "position_target" else (np.array([20.0]), np.array([2.0]))
    path = folder / "next_experiment.npz"
    metadata = np.array(json.dumps({"payload_kg": payload}))
    np.savez(path, time=time, position_target=target, kp=kp, kd=kd, metadata=metadata)
    return path, target, kp, kd


def test_who_takes_torques_is_sent_those_of_the_files_loop(tmp_path):
    session = session_of("torque_command")
    path, target, kp, kd = command_file(session, tmp_path)
    log = replayed(session, path, 1000)
    assert log.rate == pytest.approx(session.case.rate, rel=0.01)
    speed = np.gradient(log.position, log.time, axis=0)
    held = target[np.clip(np.searchsorted(np.arange(len(target)) / PLAN.rate, log.time + 1e-4) - 1, 0, None)]
    sent = np.linalg.lstsq(np.hstack([held - log.position, -speed]), log.torque_command[:, 0], rcond=None)[0]
    np.testing.assert_allclose(sent, [kp[0], kd[0]], rtol=0.15)  # the speed is a difference of noisy readings
    assert np.ptp(log.position) > 0.1  # it did move


def test_who_takes_targets_is_sent_the_files_and_follows(tmp_path):
    session = session_of("position_target")
    path, target, kp, _ = command_file(session, tmp_path)
    log = replayed(session, path, 1000)
    np.testing.assert_array_equal(log.kp, kp)
    assert log.torque_command is None
    assert set(np.unique(log.position_target)) <= set(np.unique(target))
    assert np.corrcoef(log.position[:, 0], log.position_target[:, 0])[0, 1] > 0.8


def test_what_the_file_asks_to_fasten_is_fastened(tmp_path):
    session = session_of("torque_command")
    bare, loaded = (
        replayed(session, command_file(session, tmp_path, payload=p)[0], 1000)
        for p in (0.0, float(session.robot.tree.mass[0]))
    )
    # about the level, a loop on the user's side sends more torque for more weight
    assert np.abs(loaded.torque_command - bare.torque_command).max() > 0.2 * np.abs(bare.torque_command).max()


def test_a_robot_that_is_driven_away_is_no_experiment(tmp_path):
    session = session_of("position_target")
    path, *_ = command_file(session, tmp_path, swing=50.0)
    session = replace(session, kp=100 * session.kp)
    with pytest.raises(RuntimeError, match="out of its range"):
        replayed(session, path, 1000)


def hidden(effect: str, joint: str | None, *equivalents) -> Case:
    """On a hinge of one joint."""
    drawn = session_of("torque_command").case
    return replace(drawn, truths=(Truth(effect, joint, {}),), equivalents=(equivalents,))


def finding(effect, joint, probability, *rivals) -> dict:
    given = [{"effect": e, "joint": j, "probability": p} for e, j, p in rivals]
    return {"effect": effect, "joint": joint, "probability": probability, "rivals": given}


def test_an_identity_holds_both_ways_and_a_likeness_of_the_recordings_does_not_count():
    joint = session_of("torque_command").robot.joint_names[0]
    tilt = hidden("gravity_tilt", None, ("encoder_offset", joint))
    assert same_physics(tilt) == {("gravity_tilt", None), ("encoder_offset", joint)}
    lag = hidden("actuation_lag", joint, ("actuation_delay", joint))
    assert same_physics(lag) == {("actuation_lag", joint)}


@pytest.mark.parametrize(("name", "is_one"), [("leg3", True), ("arm3", False), ("pendulum", True)])
def test_an_offset_of_a_first_joint_with_a_level_axis_is_a_base_that_leans_about_it(name, is_one):
    draws = {**SEALED, **TUNING}
    robot = draws[name](np.random.default_rng(0))
    assert stands_on_level_axis(robot) == is_one
    tree, lean = robot.tree, 0.1
    axis = tree.turn[0] @ tree.axis[0]
    down = np.cos(lean) * tree.gravity - np.sin(lean) * np.cross(axis, tree.gravity)  # level axes only
    q, v, a = np.random.default_rng(1).normal(size=(3, 20, robot.joints))
    offset = np.eye(robot.joints)[0] * lean
    leaning = inverse(tree._replace(gravity=down), q, v, a)[0]
    assert np.allclose(leaning, inverse(tree, q + offset, v, a)[0]) == is_one


def test_on_a_planar_robot_a_leaning_base_is_an_offset_of_the_first_encoder():
    robots = {name: draw(np.random.default_rng(0)) for name, draw in {**SEALED, **TUNING}.items()}
    robot = robots["arm2"]
    lean = 0.1
    down = np.array([np.sin(lean), 0.0, np.cos(lean)]) * robot.tree.gravity[2]
    leaning = robot.tree._replace(gravity=down)
    q, v, a = np.random.default_rng(1).normal(size=(3, 20, 2))
    torque, upright = inverse(leaning, q, v, a)[0], inverse(robot.tree, q, v, a)[0]
    offset = np.array([lean, 0.0])
    turned = [np.abs(torque - inverse(robot.tree, q + sign * offset, v, a)[0]).max() for sign in (1, -1)]
    assert min(turned) < 1e-9 * np.abs(torque).max()
    assert np.abs(torque - upright).max() > 0.01 * np.abs(torque).max()
    assert {name for name, r in robots.items() if is_planar(r)} == {"pendulum", "arm2", "leg2"}


def test_on_a_level_slide_all_that_is_heavier_is_one_and_on_a_steep_one_a_rotor_weighs_nothing(monkeypatch):
    sliders = [SEALED["slider"](np.random.default_rng(seed)) for seed in range(8)]
    assert {is_level(slider) for slider in sliders} == {True, False}
    loaded = hidden("payload", "carriage")
    for slider in sliders:
        monkeypatch.setattr(next_experiment, "prepare", lambda *_, robot=slider: SimpleNamespace(robot=robot))
        rotor = {("reflected_inertia", "carriage")} if is_level(slider) else set()
        assert same_physics(loaded) == {("payload", "carriage"), ("link_mass", "carriage"), *rotor}


def test_on_a_pendulum_a_small_payload_is_a_centre_that_lies_farther_out_and_a_large_one_is_not():
    robot = SEALED["pendulum"](np.random.default_rng(0))
    tree, joint = robot.tree, robot.joint_names[0]
    both = {("payload", joint), ("link_com", joint)}
    pose, still, pushed = np.array([[0.4]]), np.zeros((1, 1)), np.array([[10.0]])
    near, far = float(np.linalg.norm(tree.com[0])), float(np.linalg.norm(robot.tip[0]))
    for share, alike in ((0.1, True), (1.0, False)):
        moved = share * float(tree.mass[0]) * far
        loaded = with_point(tree, 0, share * float(tree.mass[0]), robot.tip[0])
        distance = near + moved / float(tree.mass[0])
        longer = tree._replace(com=tree.com * distance / near)
        weights, torques = zip(
            *((inverse(t, pose, still, still)[0], inverse(t, pose, still, pushed)[0]) for t in (loaded, longer)),
            strict=True,
        )
        np.testing.assert_allclose(*weights, rtol=0.05)  # the centre lies nearly towards the tip
        own = inverse(tree, pose, still, pushed)[0] - inverse(tree, pose, still, still)[0]
        assert (abs(torques[0] - torques[1]) < 0.15 * abs(own)).all() == alike
        for truth in (Truth("payload", joint, {"mass": moved / far}), Truth("link_com", joint, {"distance": distance})):
            assert weights_alike(truth, robot) == (both if alike else set())
    assert weights_alike(Truth("link_mass", joint, {"mass": 1.0}), robot) == set()


def test_a_level_slide_that_is_read_in_other_units_is_a_stronger_motor(monkeypatch):
    sliders = [SEALED["slider"](np.random.default_rng(seed)) for seed in range(8)]
    motion = np.random.default_rng(1).normal(size=(3, 20, 1))
    for slider in sliders:
        torque, other = (inverse(slider.tree, *(scale * motion))[0] for scale in (1.0, 1.3))
        assert np.allclose(other, 1.3 * torque) == is_level(slider)
        monkeypatch.setattr(next_experiment, "prepare", lambda *_, robot=slider: SimpleNamespace(robot=robot))
        same = same_physics(hidden("torque_scale", "carriage"))
        assert (("encoder_scale", "carriage") in same) == is_level(slider)


@pytest.mark.parametrize(
    ("last", "experiments", "left"),
    [
        ([("gravity_tilt", None, 0.6, ("joint_spring", "J", 0.03))], 1, "one"),
        ([("encoder_offset", "J", 0.6, ("gravity_tilt", None, 0.3))], 1, "identical"),
        ([("encoder_offset", "J", 0.4, ("joint_spring", "J", 0.3))], 1, "several"),
        ([("encoder_offset", "J", 0.4, ("joint_spring", "J", 0.3))], 0, "not proposed"),
        ([("gravity_tilt", None, 0.6, ("joint_spring", "J", 0.03))], 0, "clear"),
        ([("joint_spring", "J", 0.9, ("gravity_tilt", None, 0.05))], 1, "wrong"),
        ([("joint_spring", "J", 0.9)], 1, "lost"),
        ([], 1, "lost"),
        ([("coulomb_friction", "J", 0.4), ("gravity_tilt", None, 0.5)], 1, "one"),
        ([("coulomb_friction", "J", 0.9), ("gravity_tilt", None, 0.5)], 1, "wrong"),
    ],
)
def test_what_is_left_is_graded_by_its_share_of_the_answer_set(last, experiments, left):
    joint = session_of("torque_command").robot.joint_names[0]
    named = [[joint if part == "J" else part for part in f[:3]] for f in last]
    rivals = [[tuple(joint if part == "J" else part for part in r) for r in f[3:]] for f in last]
    findings = [finding(*f, *r) for f, r in zip(named, rivals, strict=True)]
    case = hidden("gravity_tilt", None, ("encoder_offset", joint))
    result = {"answers": [{"findings": []}, {"findings": findings}], "experiments": [{"sentence": "x"}] * experiments}
    assert grade(case, result) == left
    assert grade(case, {**result, "error": "broke"}) == "failed"


def test_an_answer_is_ambiguous_where_no_name_has_nine_tenths_of_its_set():
    case = hidden("gravity_tilt", None)
    clear, vague = (
        Row(case, {"answer": {"findings": [finding("gravity_tilt", None, 0.7, ("torque_offset", "a", p))]}})
        for p in (0.05, 0.2)
    )
    assert not ambiguous(clear)
    assert ambiguous(vague)
    stand_in = finding("joint_spring", "a", 0.2, ("torque_ripple", "a", 0.1))
    right, wrong = (finding(effect, None, 0.8) for effect in ("gravity_tilt", "joint_stop"))
    assert not ambiguous(Row(case, {"answer": {"findings": [right, stand_in]}}))
    assert ambiguous(Row(case, {"answer": {"findings": [wrong, stand_in]}}))
    assert not ambiguous(Row(case, {"error": "broke"}))


def test_names_of_one_physics_are_told_from_names_of_several():
    joint = session_of("torque_command").robot.joint_names[0]
    case = hidden("gravity_tilt", None, ("encoder_offset", joint))

    def answered(*rival):
        return Row(case, {"answer": {"findings": [finding("gravity_tilt", None, 0.6, rival)]}})

    assert is_alike(answered("encoder_offset", joint, 0.4))
    assert not is_alike(answered("joint_spring", joint, 0.4))


def test_every_case_is_in_the_report_those_that_failed_included():
    case = hidden("gravity_tilt", None)
    lines = report([(case, {"error": "broke", "answers": [], "experiments": []})], "tuning", 0)
    assert "| all | 1 | 0 | 0 | 0 | 0 | 0 | 0 | 1 | 0 |" in lines
    assert "Of the 1 cases whose names are not all the same physics, 0 are left with one name." in lines
    assert lines[-1].endswith("| broke | failed |")
