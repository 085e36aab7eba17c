"""Tables and figures say what was scored: every seed, shares of the baseline, and which rollouts ran away."""

from __future__ import annotations

from dataclasses import replace

import pytest
from identification.arms import commands, recorded, robot

from torchrl_athletic.identification import Simulator, compare, every_seed, figure, open_loop, table
from torchrl_athletic.identification.cem import correction_of

ROBOT = robot()
TRUTH = Simulator("diagnosed", ROBOT, correction_of(ROBOT.joint_names, [1.2, 0.8, 1.0, 0.6, 0.08, 0.05]))
TAKE = recorded(TRUTH, commands(241))
GROUPS = {"steps": [TAKE], "short": [TAKE.slice(0, 61)], "nothing": []}


@pytest.fixture(scope="module")
def results():
    default = compare(Simulator("default", ROBOT), GROUPS, (None, 0.5))
    truth = compare(TRUTH, GROUPS, (None, 0.5))
    return [*default, *truth, *(replace(r, seed=1, mse=3 * r.mse) for r in truth)]


def test_a_group_is_scored_over_whole_takes_and_over_windows_that_fit(results) -> None:
    assert [(r.group, r.window) for r in results[:3]] == [("steps", "whole"), ("steps", "0.5 s"), ("short", "whole")]
    assert results[0].mse > 100 * results[3].mse


def test_the_table_gives_the_mean_over_seeds_and_the_share_of_the_baseline(results) -> None:
    mse = {("default", 0): 0.02, ("diagnosed", 0): 0.001, ("diagnosed", 1): 0.003}
    lines = table([replace(r, mse=mse[r.method, r.seed]) for r in results]).splitlines()
    assert lines[0].startswith("| method | steps, whole | steps, 0.5 s | short, whole |")
    assert lines[2].startswith("| Default | 2.00e-02 (1.000) |")
    assert lines[3].startswith("| Diagnosed | 2.00e-03 ± 1.4e-03 (0.100) |")
    assert lines[3].endswith("| 0, 1 |")


def test_every_seed_is_listed(results) -> None:
    mse = {("default", 0): 0.02, ("diagnosed", 0): 0.001, ("diagnosed", 1): 0.003}
    shuffled = [replace(r, mse=mse[r.method, r.seed]) for r in reversed(results)]
    lines = every_seed(shuffled, "0.5 s").splitlines()
    assert lines[0] == "| each seed | steps, 0.5 s |"
    assert lines[2:] == ["| Default | 2.00e-02 |", "| Diagnosed | 1.00e-03, 3.00e-03 |"]


def test_what_diverged_is_said(results) -> None:
    lost = [replace(r, diverged=0.25) if r.method == "diagnosed" else r for r in results]
    assert "25 % diverge" in table(lost)
    assert "diverge" not in table(results)


def test_the_figure_is_drawn(results, tmp_path) -> None:
    rollouts = {s.name: open_loop(s, [TAKE])[0] for s in (Simulator("default", ROBOT), TRUTH)}
    figure(results, {"fitted": rollouts}, tmp_path / "a.svg", seconds=0.5)
    text = (tmp_path / "a.svg").read_text()
    assert "<svg" in text
    figure(results, {}, tmp_path / "b.svg")
    assert len((tmp_path / "b.svg").read_text()) < len(text)
