"""The table of throws in several simulators, of figures that are known."""

from benchmarks.throw_simulators import table


def test_what_is_lost_is_told_beside_the_steps_that_the_concealed_arm_needs():
    worlds = {
        "own": {"distance_m": 12.0, "failed": 0.03},
        "own, 0.2 ms": {"distance_m": 10.0, "failed": 0.5},
        "concealed": {"distance_m": 9.0, "failed": 0.1},
    }
    rows = table({"cem_seed0": worlds}).splitlines()
    assert rows[-1] == "| CEM | 12.0 | 10.0 | 9.0 | -10% | 3%, 10% |"
    assert rows[0].count("|") == rows[1].count("|") == rows[-1].count("|")
