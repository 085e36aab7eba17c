"""The tasks with the paper's own terms and scales."""

import importlib

import pytest

TASKS = {"ball_throw": "ball_throw_env", "dumbbell_snatch": "dumbbell_snatch_env", "sled_pull": "sled_pull_env"}


@pytest.mark.parametrize(("module", "name"), TASKS.items())
def test_an_environment_is_rewarded_as_printed_where_it_is_asked_for_and_then_alone(monkeypatch, module, name):
    below, told = importlib.import_module(f"torchrl_athletic.envs.{module}"), []
    monkeypatch.setattr(below, "whole_body_env", lambda robot, **asked: told.append(asked["terms"]))
    for as_printed in (False, True):
        getattr(below, name)(num_envs=1, as_printed=as_printed)
    (terms, scales), (printed, printed_scales) = told
    assert ("failure" in terms, "failure" in printed) == (True, False)
    assert terms.keys() == scales.keys()
    assert printed.keys() == printed_scales.keys()
