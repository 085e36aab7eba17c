"""Tables and figures of throws whose distances are known."""

import pytest

from benchmarks.throw_report import (
    ARM,
    Score,
    Throws,
    best_table,
    by_method,
    draw,
    draw_matrix,
    foretelling_table,
    in_order,
    label,
    markdown,
    mean_error,
    methods_table,
    ratio_of,
    release_table,
)


def scored(method, name, own, worlds, real, failed=(False, False), release=None):
    """A policy that throws ``worlds[w]`` far in each world and ``real`` on the arm, twice each."""
    found = {world: Throws([distance] * 2, [False, False]) for world, distance in worlds.items()}
    found[ARM] = Throws(list(real), list(failed))
    if release is not None:
        for world, (time, forward, joint) in release.items():
            shown = {
                "release_time": [time],
                "release_velocity": [forward, 0.0, 1.0],
                "release_joint_velocity": [joint] * 7,
            }
            found[world] = Throws(found[world].distance, found[world].failed, shown)
    return Score(method, name, own, 1_000_000, found)


UAN = [
    scored("uan", "uan_seed0-0", "uan_seed0", {"default": 2.5, "uan_seed0": 2.0, "uan_seed1": 2.2}, (2.0, 1.8)),
    scored("uan", "uan_seed1-1", "uan_seed1", {"default": 2.3, "uan_seed0": 1.8, "uan_seed1": 2.2}, (2.3, 2.1)),
]
DEFAULT = scored(
    "default", "default-0", "default", {"default": 3.0, "uan_seed0": 1.0, "uan_seed1": 0.5}, (0.0, 1.0), (True, False)
)
HAND = scored("reference", "reference", "default", {"default": 1.0, "uan_seed0": 1.1, "uan_seed1": 1.3}, (1.0, 1.0))
ALL = [*UAN, DEFAULT, HAND]


def cells(text):
    return [[cell.strip() for cell in line.strip("|").split("|")] for line in text.splitlines()[2:]]


def test_a_policy_is_measured_in_its_own_simulator_against_the_arm():
    assert (UAN[0].simulated, UAN[0].real) == pytest.approx((2.0, 1.9))
    assert UAN[1].difference == pytest.approx(0.1)  # throw by throw: the means agree
    assert UAN[1].simulated == UAN[1].real
    assert UAN[0].foretold("default") == pytest.approx(0.6)


def test_methods_come_in_the_order_of_the_figure_and_unknown_ones_last():
    assert list(by_method(ALL)) == ["reference", "default", "uan"]
    assert in_order(["uan_seed1", "mine", "cem_seed0", "uan_seed0"]) == ["cem_seed0", "uan_seed0", "uan_seed1", "mine"]
    assert label("actuator_net") == "Actuator Net"
    assert label("mine") == "mine"


def test_the_table_of_methods_gives_means_and_spreads_over_policies():
    rows = cells(methods_table(ALL))
    assert rows[1] == ["Default", "1", "3.000", "0.500", "2.500", "500.0 %", "1 of 2"]  # one tells of no spread
    assert rows[2] == ["UAN", "2", "2.100 ± 0.141", "2.050 ± 0.212", "0.100 ± 0.000", "4.9 %", "0 of 4"]


def test_ours_are_held_against_the_baseline_that_throws_farthest():
    far = scored("cem", "cem-0", "default", {"default": 1.0, "uan_seed0": 1.0, "uan_seed1": 1.0}, (1.0, 1.0))
    assert cells(best_table([*ALL, far])) == [["UAN", "CEM, 1.000 m", "2.05 ± 0.21"]]
    assert best_table([*UAN, HAND]) == ""  # thrown by hand is no baseline


def test_a_ratio_is_as_uncertain_as_both_of_its_sides():
    assert ratio_of([1.9, 2.0, 2.1], [1.0]) == pytest.approx((2.0, 0.1))
    assert ratio_of([2.0], [0.9, 1.0, 1.1]) == pytest.approx((2.0, 0.2))
    assert ratio_of([2.0], [0.0])[0] == float("inf")


def test_simulators_foretell_what_was_learnt_elsewhere():
    rows = cells(foretelling_table(ALL))
    assert rows[0][0] == "Default"
    assert rows[0][1:] == ["+0.350", "0.350", "0.430", "0.600", "0 of 2"]  # of both UANs' policies: 0.6 and 0.1
    assert rows[1][0] == "UAN"
    assert rows[1][1] == "+0.225"  # 0.5 and 0 of Default's, 0.1 and 0.3 by hand


def test_the_matrix_has_a_policy_in_its_own_simulator_on_the_diagonal():
    worlds = ["uan_seed0", "uan_seed1"]
    assert mean_error(UAN, "uan", worlds) == pytest.approx(0.05)  # 2.0 - 1.9 and 2.2 - 2.2
    assert mean_error([DEFAULT], "uan", worlds) == pytest.approx(0.25)


def test_the_release_is_compared_arm_less_simulator():
    release = {"default": (2.80, 3.0, 5.0), ARM: (2.85, 2.5, 5.5)}
    rows = cells(
        release_table([scored("default", "default-0", "default", {"default": 1.0}, (1.0, 1.0), release=release)])
    )
    assert rows == [["Default", "+50", "-0.50", "+0.00", " ".join(["+0.50"] * 6)]]
    assert release_table(ALL) == ""


def test_all_tables_and_figures_are_made(tmp_path):
    text = markdown(ALL)
    assert text.count("uan_seed1-1") == 1
    assert "1.0 M" in text
    draw(ALL, tmp_path / "bars.svg")
    draw_matrix(ALL, tmp_path / "matrix.svg")
    bars, matrix = ((tmp_path / name).read_text() for name in ("bars.svg", "matrix.svg"))
    assert all(f"<!-- {label(method)} -->" in bars for method in ("reference", "default", "uan"))
    assert "<!-- +0.250 -->" in matrix
    assert "<!-- root mean square -->" in matrix
