"""The search finds friction, damping and armature that were changed, and its error is that of the rollouts."""

from __future__ import annotations

import numpy as np
import pytest
from identification.arms import commands, recorded, robot

from torchrl_athletic.identification import Simulator
from torchrl_athletic.identification.cem import (
    CEM,
    WindowError,
    correction_of,
    correction_with,
    free_parameters,
    identify_cem,
)
from torchrl_athletic.identification.open_loop import open_loop, score

ROBOT = robot()
TRUE = np.array([1.2, 0.8, 1.0, 0.6, 0.08, 0.05])  # friction, damping, armature of hip and knee
TRUTH = Simulator("cem", ROBOT, correction_of(ROBOT.joint_names, TRUE))


@pytest.mark.parametrize("torques", [False, True], ids=["targets", "torques"])
def test_the_error_of_a_population_is_that_of_its_members_rollouts(torques: bool) -> None:
    takes = [recorded(TRUTH, commands(201, seed, 2.0 if torques else 0.5), torques) for seed in (1, 2)]
    population = np.stack([TRUE, 0.5 * TRUE, 2.0 * TRUE])
    errors = WindowError(Simulator("default", ROBOT), takes, CEM(population=4, windows=100, window=0.5))(population)
    for values, error in zip(population, errors, strict=True):
        simulator = Simulator("cem", ROBOT, correction_of(ROBOT.joint_names, values))
        assert error == pytest.approx(score(open_loop(simulator, takes, window=0.5)).mse, rel=1e-3, abs=1e-9)
    assert errors[0] < 1e-3 * errors[1:].min()


def test_it_finds_what_was_changed() -> None:
    takes = [recorded(TRUTH, commands(801, seed)) for seed in (1, 2)]
    unseen = recorded(TRUTH, commands(801, 3))
    found = identify_cem(ROBOT, takes, CEM(generations=32, population=10, windows=8, window=0.5), seed=0)
    before, after = (score(open_loop(s, [unseen])).mse for s in (Simulator("default", ROBOT), found))
    assert after < before / 50
    values = [next(iter(e["parameters"].values()))["value"] for e in found.correction["effects"]]
    np.testing.assert_allclose(values[4:], TRUE[4:], rtol=0.15)  # dry and viscous friction do for each other longest
    assert found.notes["data_seconds"] == pytest.approx(4.0)  # eight windows of half a second, of 8 s
    assert found.notes["training_seconds"] > 0


def test_a_seed_gives_the_same_answer_again_and_another_one_searches_elsewhere() -> None:
    take = recorded(TRUTH, commands(301, 1))
    quick = CEM(generations=3, population=6, windows=4, window=0.2)
    a, b, c = (identify_cem(ROBOT, [take], quick, seed=seed).correction for seed in (0, 0, 1))
    assert a == b != c


def test_takes_of_other_gains_are_refused() -> None:
    take = recorded(TRUTH, commands(101, 1))
    other = recorded(TRUTH, commands(101, 1, 2.0), torques=True)
    with pytest.raises(ValueError, match="Fit those of one kind"):
        WindowError(Simulator("default", ROBOT), [take, other], CEM(windows=2, window=0.1))


def test_a_given_simulator_keeps_its_other_physics_and_gets_better_numbers() -> None:
    late = {"effect": "actuation_delay", "joint": "hip", "parameters": {"delay": {"value": 0.02}}}
    falling = {"coulomb": {"value": 0.6}, "stribeck": {"value": 0.5}, "stribeck_speed": {"value": 0.3}}
    other = [late, {"effect": "stribeck_friction", "joint": "knee", "parameters": falling}]
    free = [f for f in free_parameters(ROBOT.joint_names, {"effects": other, "trims": []}) if f.joint == "hip"]
    start = {**correction_with(None, free, [0.5, 0.5, 0.03]), "joint_names": list(ROBOT.joint_names)}
    start["effects"] += other
    truth = Simulator("diagnosed", ROBOT, correction_with(start, free, [1.5, 1.0, 0.08]))
    takes = [recorded(truth, commands(401, seed)) for seed in (1, 2)]
    given = Simulator("diagnosed", ROBOT, start, notes={"verdict": "explained", "training_seconds": 5.0})
    quick = CEM(generations=30, population=8, windows=8, window=0.5)
    found = identify_cem(ROBOT, takes, quick, given=given)
    assert (found.name, found.notes["verdict"]) == ("diagnosed", "explained")
    assert found.notes["training_seconds"] > 5.0
    before, after = (score(open_loop(s, [recorded(truth, commands(401, 3))])).mse for s in (given, found))
    assert after < before / 20
    kept = {(e["effect"], e["joint"]): e["parameters"] for e in found.correction["effects"]}
    assert kept["actuation_delay", "hip"] == late["parameters"]
    assert kept["stribeck_friction", "knee"] == falling
    assert ("coulomb_friction", "knee") not in kept
    assert start["effects"][0]["parameters"]["torque"]["value"] == 0.5  # what was given stays
