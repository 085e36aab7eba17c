"""What is said, and which simulation stands for it: recordings kept aside choose no names, but may refuse a model."""

from types import SimpleNamespace

import numpy as np
import pytest

from torchrl_athletic.diagnosis.proposal import Proposal
from torchrl_athletic.diagnosis.result import Score
from torchrl_athletic.diagnosis.stages import Decided, Trial
from torchrl_athletic.diagnosis.state import _best_followed


def trial(aside: float, joints: bool = False, floor: float = 1.0) -> Trial:
    """One that leaves an error of ``aside`` on recordings kept aside, and follows the fitted ones alike."""
    scores = {split: Score(9.0, after, floor, 0.0, {}) for split, after in (("train", 2.0), ("heldout", aside))}
    return Trial(Proposal(None, None, joints=joints), SimpleNamespace(), scores, np.zeros((1, 1)), np.zeros(1))


@pytest.mark.parametrize(
    ("named", "standard", "taken"),
    [
        (4.0, 3.0, True),
        (3.0, 4.0, False),
        (3.0, 2.99, False),  # as the windows fall
        (1.1, 0.9, False),  # noise
    ],
)
def test_the_standard_joints_are_the_corrected_simulation_where_recordings_kept_aside_say_so(named, standard, taken):
    chosen, joints = trial(named), trial(standard, joints=True)
    found = _best_followed(Decided(None, None, chosen, (joints,)))
    assert (found.fitted is joints.fitted) is taken
    assert found.scores is (joints if taken else chosen).scores
    assert ("standard joints instead of what is named" in " ".join(found.sentences)) is taken


def test_nothing_that_was_kept_aside_lets_the_fitted_recordings_say_so():
    chosen, first = trial(4.0), trial(3.0)
    for t in (chosen, first):
        del t.scores["heldout"]
    first.scores["train"] = Score(9.0, 1.5, 1.0, 0.0, {})
    [said] = _best_followed(Decided(None, None, chosen, (first,))).sentences
    assert "what the torques alone speak for" in said
    assert "the fitted recordings" in said
