"""The comparison on the real two-link arm: what is fitted, what is kept aside, and what the tables say of it."""

import importlib.util
import sys
from pathlib import Path

import numpy as np
import pytest

from torchrl_athletic.identification import Result, Simulator
from torchrl_athletic.networks import sizes_of
from torchrl_athletic.recordings import Recording

PATH = Path(__file__).parents[2] / "benchmarks" / "two_link_identification.py"
SPEC = importlib.util.spec_from_file_location("benchmarks_two_link_identification", PATH)
benchmark = importlib.util.module_from_spec(SPEC)
sys.modules[SPEC.name] = benchmark  # where dataclasses look for annotations
SPEC.loader.exec_module(benchmark)


def take(samples):
    blank = np.zeros((samples, 2))
    return Recording(0.005 * np.arange(samples), ("shoulder", "elbow"), blank, torque_command=blank)


@pytest.mark.parametrize(("seconds", "lengths"), [(5, [1000]), (10, [2000]), (12.5, [2000, 500]), (100, [2000, 2000])])
def test_so_many_seconds_are_the_first_ones_in_the_order_of_the_takes(seconds, lengths):
    cut = benchmark.first_seconds([take(2000), take(2000)], seconds)
    assert [t.num_samples for t in cut] == lengths


def test_each_method_runs_with_each_seed_but_the_default_which_draws_nothing():
    cases = list(benchmark.cases_of(benchmark.Config(seconds=(5.0, 60.0), seeds=(0, 1, 2), seeds_with_less=2)))
    count = {m: sum(c.method == m for c in cases) for m in ("default", "cem", "uan", "diagnosed", "diagnosed_uan")}
    assert count == {"default": 1, "cem": 5, "uan": 5, "diagnosed": 5, "diagnosed_uan": 5}
    assert len({c.name for c in cases}) == len(cases)


@pytest.mark.parametrize(
    ("method", "given"),
    [("uan_joint", None), ("inertia_uan_joint", "cem_20s_seed2"), ("diagnosed_uan_joint", "diagnosed_20s_seed2")],
)
def test_a_net_learns_what_the_fit_of_its_own_seed_and_seconds_left(method, given):
    on = benchmark.Case(method, 20.0, 2).given
    assert (on and on.name) == given


def result(method, seed, mse, group="swing-up", window="0.5 s"):
    return Result(method, seed, group, window, mse, {}, 0.0, 0.0, 0.0)


def test_efficiency_is_the_mean_over_the_groups_kept_aside_for_each_seed():
    case = benchmark.Case
    results = {
        case("default", 0.0, 0): [result("default", 0, 0.4)],
        case("cem", 5.0, 0): [
            result("cem", 0, 0.1),
            result("cem", 0, 0.3, "elbow alone"),
            result("cem", 0, 9.0, window="whole"),
        ],
        case("cem", 5.0, 1): [result("cem", 1, 0.4), result("cem", 1, 0.4, "elbow alone")],
        case("cem", 60.0, 0): [result("cem", 0, 0.01)],
    }
    assert benchmark.efficiency(results, "cem", 5.0) == pytest.approx([0.2, 0.4])
    text = benchmark.efficiency_table(results, (5.0, 60.0))
    assert "| 5 s | 3.00e-01 ± 1e-01 |" in text
    assert "| 60 s | 1.00e-02 |" in text


def test_the_arm_steps_as_often_as_the_takes_are_sampled_and_has_neither_rotors_nor_friction():
    robot = benchmark.arm()
    model = robot.model()
    assert model.opt.timestep == benchmark.STEP
    assert robot.joint_names == ("shoulder", "elbow")
    assert not model.dof_frictionloss.any()
    assert not model.dof_armature.any()


@pytest.mark.parametrize(
    ("method", "joints", "odd", "memory"),
    [
        ("uan", None, False, ()),
        ("uan_joint", 2, True, ()),
        ("diagnosed_uan_joint", 2, True, ()),
        ("uan_arm_memory", 2, False, benchmark.MEMORY),
        ("inertia_uan_joint_memory", 2, True, benchmark.MEMORY),
    ],
)
def test_a_methods_name_says_what_its_net_is_told(method, joints, odd, memory):
    moved = 0.1 * np.sin(np.linspace(0, 9, 120))[:, None] * [1.0, 2.0]
    rate = np.gradient(moved, 0.005, axis=0)
    told = Recording(0.005 * np.arange(120), ("shoulder", "elbow"), moved, velocity=rate, torque_command=moved)
    found = benchmark.with_uan(Simulator(method, benchmark.arm()), [told], seed=0, iterations=1)
    sizes = sizes_of(found.net)
    assert (sizes.joints, sizes.odd, sizes.memory, sizes.state) == (joints, odd, memory, "_arm" in method)
    assert found.net[-1].unit.unique().tolist() == [benchmark.TORQUE]
    assert found.notes["data_seconds"] == pytest.approx(0.595, abs=0.01)


@pytest.mark.usefixtures("real_recordings")
def test_the_benchmark_scores_tabulates_and_draws(tmp_path, capsys):
    cfg = benchmark.Config(tmp_path, seconds=(60.0,), methods=("default",), score_only=True)
    benchmark.identify(benchmark.Case("default", 0.0, 0), cfg)
    benchmark.main(cfg)
    text = (tmp_path / "two_link.md").read_text()
    assert text in capsys.readouterr().out
    assert "| Default | 3.17e-01 | 1.38e-01 |" in text  # as committed: nothing is drawn at random
    assert {p.name for p in tmp_path.glob("*.svg")} == {"two_link.svg", "two_link_efficiency.svg"}
