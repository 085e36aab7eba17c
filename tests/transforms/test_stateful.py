"""Chance in one transform tells nothing of chance in another."""

import inspect

import pytest
import torch
from torchrl.envs import Compose, TransformedEnv

from torchrl_athletic import transforms
from torchrl_athletic.functional.commands import CommandRanges
from torchrl_athletic.functional.phase import sled_phases
from torchrl_athletic.testing import ToyEnv
from torchrl_athletic.transforms import EncoderOffset, GaitClock, Push, RandomTransform, StatefulTransform

NEEDED = {
    "dt": 0.005,
    "correction": {"schema": "torchrl_athletic/corrected/1", "joint_names": ["a"], "effects": [], "trims": []},
    "in_keys": ["a"],
    "length": 3,
    "max_steps": 9,
    "net": torch.nn.Identity(),
    "pushes": [Push(("base",))],
    "radius": 0.035,
    "ranges": CommandRanges(),
    "references": {"a": torch.zeros(4, 3)},
    "rim": 0.05,
    "scales": {"a": 1.0},
    "schedule": sled_phases(),
    "table_dt": 0.02,
    "terms": {"a": torch.zeros},
    "timestep": 0.005,
}
"""What constructors ask for."""
KINDS = [
    kind
    for kind in map(vars(transforms).get, transforms.__all__)
    if inspect.isclass(kind)
    and issubclass(kind, StatefulTransform)
    and kind not in (StatefulTransform, RandomTransform)
]


@pytest.mark.parametrize("kind", KINDS, ids=lambda kind: kind.__name__)
def test_seed_and_rows_and_the_mask_of_a_reset_reach_whoever_takes_them(kind):
    asked = inspect.signature(kind).parameters
    given = {"seed": 5, "first_row": 3, "reset_key": ("of", "it")}
    given = {name: value for name, value in given.items() if name in asked}
    needed = {name: NEEDED[name] for name, of in asked.items() if of.default is of.empty}
    made = kind(**needed, **given)
    for name, value in given.items():
        assert getattr(made, name) == value, name
    assert {"seed", "first_row"} <= given.keys() or not issubclass(kind, RandomTransform)


def test_draws_of_two_kinds_of_transforms_with_one_seed_have_nothing_to_do_with_each_other():
    """Or robots whose encoders read too much would all begin late in their cycle."""
    chain = Compose(EncoderOffset(seed=5), GaitClock(0.02, random_start=True, seed=5))
    shown = TransformedEnv(ToyEnv(num_envs=2000), chain).reset()
    drawn = torch.cat((shown["encoder_offset"], shown["gait_cycle"]), -1)
    assert drawn.std(0).min() > 0
    assert torch.corrcoef(drawn.T)[:-1, -1].abs().max() < 0.1
