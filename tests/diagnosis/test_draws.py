"""Several fits, of which the one stays that follows best what was fitted."""

import numpy as np
import pytest

from torchrl_athletic.diagnosis import Fit, Score
from torchrl_athletic.diagnosis.draws import best_of_draws


def found(error, remark="A bound binds.", aside=0.0):
    scores = {split: Score(1.0, e, 0.0, 0.0, {}) for split, e in (("train", error), ("heldout", aside))}
    return Fit((), None, None, scores, (remark,), "arm", "<mujoco/>", 2.0)


def fits(errors, told):
    """A fit of each seed, with these errors; an error of None is a Ctrl-C."""

    def once(seed, time_budget):
        told.append((seed, time_budget))
        error = errors[len(told) - 1]
        if error is None:
            raise KeyboardInterrupt
        return found(error, f"Of seed {seed}.", aside=1.0 - error)

    return once


@pytest.mark.parametrize(("errors", "kept"), [((0.3, 0.1, 0.2), 8), ((0.1, 0.1, 0.2), 7), ((0.3, 0.2, 0.1), 9)])
def test_the_fit_stays_that_follows_best_what_was_fitted_whatever_is_kept_aside(errors, kept):
    told = []
    best = best_of_draws(fits(errors, told), 3, seed=7)
    assert told == [(7, None), (8, None), (9, None)]
    assert best.scores["train"].after == min(errors)
    assert best.remarks[0] == f"Of seed {kept}."
    listed = ", ".join(f"{error:g}" for error in errors)
    assert best.remarks[1:] == (
        f"Of 3 fits by seeds from 7 on, whose errors on what was fitted are {listed}, that of seed {kept} stays.",
    )
    assert best.seconds == 6.0


def test_one_fit_is_that_fit():
    told = []
    best = best_of_draws(fits([0.3], told), 1, seed=2, time_budget=5.0)
    assert best.remarks == ("Of seed 2.",)
    assert (told[0][0], best.seconds) == (2, 2.0)


def test_draws_share_the_time_that_is_left():
    told = []
    best_of_draws(fits([0.3, 0.2, 0.1], told), 3, time_budget=30.0)  # which take no time at all
    np.testing.assert_allclose([seconds for _, seconds in told], [10.0, 15.0, 30.0], atol=0.5)
    best_of_draws(fits([0.3, 0.2], late := []), 2, time_budget=0.0)
    assert [seconds for _, seconds in late] == [0.0, 0.0]


def test_ctrl_c_keeps_the_best_of_those_that_are_done():
    assert best_of_draws(fits([0.3, 0.2, None], []), 3).scores["train"].after == 0.2
    assert best_of_draws(fits([0.3, None], []), 3).remarks == ("Of seed 0.",)
    with pytest.raises(KeyboardInterrupt):
        best_of_draws(fits([None], []), 3)


def test_no_fit_is_refused():
    with pytest.raises(ValueError, match=r"^draws is 0\. Ask for one fit or more\.$"):
        best_of_draws(fits([], []), 0)
