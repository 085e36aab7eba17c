"""Numbers of the paper and of the docstrings, for those who say nothing: users notice if they change."""

import inspect

import pytest

from torchrl_athletic.losses import (
    AdaptiveKL,
    SplitOptimizationStepper,
)


@pytest.mark.parametrize(
    ("made", "defaults"),
    [
        (AdaptiveKL, {"target": 0.01, "factor": 1.5, "bounds": (1e-05, 0.01)}),
        (
            SplitOptimizationStepper,
            {
                "actor_lr": 0.001,
                "critic_lr": 0.0005,
                "weight_decay": 0.01,
                "epochs": 5,
                "minibatches": 4,
                "critic_minibatches": 1,
                "micro_batch": 24576,
                "max_grad_norm": 1.0,
                "seed": 0,
                "cuda_graph": False,
            },
        ),
    ],
)
def test_what_is_not_said_is_as_documented(made, defaults):
    parameters = inspect.signature(made).parameters
    assert {name: parameters[name].default for name in defaults} == defaults
