"""Numbers by which a diagnosis decides are what their rules of inference say, and stand in the order that they mean."""

import math

import pytest

from torchrl_athletic.diagnosis.thresholds import DECISION, PLAN, SEARCH, SIMULATION, SPENDING, STATEMENT, TORQUES


@pytest.mark.parametrize(
    ("evidence", "odds"),
    [
        (SEARCH.decisive, 150.0),
        (SEARCH.term, 20.0),  # of twenty effects of the catalogue one is missing
        (SEARCH.rival_price, math.e),  # Akaike 1974: a parameter is worth its weight in likelihood
        (DECISION.asked, 20.0),
    ],
)
def test_evidence_is_twice_the_log_of_the_odds_that_are_said(evidence, odds):
    assert math.exp(evidence / 2) == pytest.approx(odds, rel=0.02)


def test_separations_and_shares_are_the_odds_that_are_said():
    assert PLAN.enough**2 / 2 == 72  # e to the 72
    assert STATEMENT.refutes / (1 - STATEMENT.refutes) == pytest.approx(3.0)  # Kass and Raftery: three to one
    assert STATEMENT.likely == 0.5  # beside an equal nobody is likely


def test_windows_last_as_long_as_tables_and_docstrings_say():
    assert SIMULATION.window == 0.5  # "error over 0.5 s" stands above every table
    assert SIMULATION.windows * SIMULATION.window == 200.0
    assert SIMULATION.looked_at * SIMULATION.window == 500.0
    assert SIMULATION.at_once <= SIMULATION.windows


def test_what_is_surer_has_the_stricter_bound():
    assert 1.0 < SEARCH.open  # which noise alone gives
    assert DECISION.asked < DECISION.behind < SEARCH.decisive
    assert SEARCH.seen < SEARCH.material < SEARCH.richer < SEARCH.all < 1
    assert SEARCH.steady < SEARCH.invariant < 1
    assert SEARCH.accuracy < SEARCH.material
    assert STATEMENT.refused < STATEMENT.senseless < STATEMENT.likely < STATEMENT.refutes
    assert STATEMENT.least_share < 1 - STATEMENT.refutes
    assert STATEMENT.explained < STATEMENT.kept < STATEMENT.partly < 1
    assert 1 < STATEMENT.shown < STATEMENT.near_floor
    assert 1 < STATEMENT.at_floor < STATEMENT.near_floor
    assert DECISION.clear < DECISION.lost < 1 < DECISION.follows
    assert DECISION.occasions > SIMULATION.window  # or one blow would be two occasions
    assert PLAN.apart < PLAN.spare < PLAN.enough
    assert PLAN.seconds <= PLAN.longest
    assert 2 / PLAN.slowest > PLAN.seconds > 1 / PLAN.slowest  # its slowest wave has a whole period
    assert PLAN.slack < 1 - PLAN.margin < 0.5
    assert SPENDING.shortest < SPENDING.stretch
    assert SPENDING.share < 0.6 < SPENDING.to_find < SPENDING.to_tell < 1
    assert SPENDING.least < SPENDING.fixed
    assert TORQUES.block < TORQUES.stretch
    assert TORQUES.torque_floor < SEARCH.accuracy
