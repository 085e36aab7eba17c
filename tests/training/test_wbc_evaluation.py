"""Robots are examined in parts, and are the same robots as in one batch."""

import numpy as np
import pytest

from torchrl_athletic.envs import Disturbances
from torchrl_athletic.networks import pretrained
from torchrl_athletic.robots import b2z1
from torchrl_athletic.training import examine
from torchrl_athletic.training import wbc_evaluation as module
from torchrl_athletic.training.wbc_evaluation import ERRORS, Condition
from torchrl_athletic.transforms import StartRanges

STEPS = 6


@pytest.fixture
def examined(tmp_path, monkeypatch):
    """What became of each of four robots, examined in batches of some size."""
    starts = Disturbances(None, (), StartRanges(), (0.0, 0.0), (0, 0))
    policy, condition = pretrained("wbc"), Condition(b2z1(cone="pyramidal"), starts)
    told_of = module._told_of

    def run(**told):
        seen = []
        monkeypatch.setattr(module, "_told_of", lambda episodes: seen.append(episodes) or told_of(episodes))
        table = tmp_path / f"{len(list(tmp_path.iterdir()))}.json"
        told = {"episodes": 4, "steps": STEPS, "actuation": "ideal", "progress": False} | told
        examine(policy, {"all": condition}, table, **told)
        return seen[0]

    return run


def test_rows_of_two_parts_are_the_rows_of_one_batch_and_another_seed_s_are_not(examined):
    whole, parts, others = examined(batch=4, seed=1), examined(batch=3, seed=1), examined(batch=4, seed=2)
    assert parts.steps.tolist() == whole.steps.tolist() == [STEPS] * 4
    for name in ERRORS:
        one, two, other = (found.means[f"tracking/{name}"] for found in (whole, parts, others))
        np.testing.assert_allclose(two, one, atol=1e-5, rtol=1e-4)
        assert np.abs(other - one).max() > 1e-3, name
        assert np.diff(np.sort(one)).min() > 1e-4, name  # four robots that cannot be taken for each other


def test_an_action_is_held_as_long_however_fine_the_steps_are():
    conditions = module.wbc_conditions()
    assert len(conditions) > 20
    for name in ("all randomised", "all randomised, 1 ms steps"):
        condition = conditions[name]
        assert condition.substeps * condition.robot.model().opt.timestep == pytest.approx(0.005), name
