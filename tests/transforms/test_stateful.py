"""Chance in one transform tells nothing of chance in another."""

import inspect
from types import SimpleNamespace

import pytest
import torch
from tensordict import TensorDict
from torchrl.data import Unbounded
from torchrl.envs import Compose, TransformedEnv

from torchrl_athletic import transforms
from torchrl_athletic.functional.commands import CommandRanges
from torchrl_athletic.functional.phase import sled_phases
from torchrl_athletic.testing import ToyEnv
from torchrl_athletic.transforms import (
    ActionHistory,
    EncoderOffset,
    GaitClock,
    Push,
    RandomTransform,
    StatefulTransform,
)
from torchrl_athletic.transforms.stateful import base_env_of, joint_index, spread, unbounded_like

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
MIXED = ([0, 2, 1, 3], [2, 1, 0], [0, 2], [3, 0])
"""Joints that do not follow one another."""
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


@pytest.mark.parametrize("joints", [[0, 1, 2], [1, 2], [3], [0, 2, 1, 3], [2, 1, 0], [0, 2], [3, 0], slice(1, 3), None])
def test_joints_are_taken_in_the_order_in_which_they_are_given(joints: list[int] | slice | None) -> None:
    """Those that follow one another are a view, which spares a copy."""
    value = torch.arange(8.0).reshape(2, 4)
    taken = value[..., joint_index(StatefulTransform([], []), joints)]
    expected = value if joints is None else value[:, joints]
    assert torch.equal(taken, expected)
    assert (taken.untyped_storage().data_ptr() == value.untyped_storage().data_ptr()) == (joints not in MIXED)


@pytest.mark.parametrize(
    ("mask", "shape", "rows"),
    [
        ([[True], [False]], (2, 3), [[True], [False]]),
        ([[True], [False]], (2,), [True, False]),
        ([[True], [False]], (2, 1, 4), [[[True]], [[False]]]),
        ([[True, False], [False, False]], (2,), [True, False]),
    ],
)
def test_a_mask_of_rows_is_spread_over_values_of_any_width(
    mask: list[list[bool]], shape: tuple[int, ...], rows: list
) -> None:
    """One of several flags of a row is enough."""
    assert spread(torch.tensor(mask), torch.zeros(shape)).tolist() == rows


def test_which_rows_start_is_asked_where_an_environment_has_several_places_for_it() -> None:
    class Within(GaitClock):
        parent = SimpleNamespace(reset_keys=["_reset", ("other", "_reset")])

    with pytest.raises(ValueError, match=r"cannot tell which .* Name one"):
        _ = Within(0.02).reset_key
    assert Within(0.02, reset_key=("other", "_reset")).reset_key == ("other", "_reset")


def test_in_an_environment_with_one_place_for_it_no_other_environment_is_built_to_ask(monkeypatch) -> None:
    env = TransformedEnv(ToyEnv(2), Compose(ActionHistory(2), GaitClock(0.02)))
    assert env.reset_keys == ["_reset"]
    monkeypatch.setattr(StatefulTransform, "parent", property(lambda self: pytest.fail("was built")), raising=False)
    assert [part.reset_key for part in env.transform] == ["_reset", "_reset"]


def test_a_clone_in_another_chain_knows_nothing_of_the_first_one() -> None:
    """A history of three toy joints, put before a toy that has other actions."""
    first = TransformedEnv(ToyEnv(2), ActionHistory(2))
    assert first.observation_spec["action_history"].shape == (2, 2, 3)
    copied = first.transform.clone()
    copied.reset_parent()
    scaled = TransformedEnv(ToyEnv(5), copied)
    assert scaled.reset()["action_history"].shape == (5, 2, 3)
    assert first.reset()["action_history"].shape == (2, 2, 3)


def test_in_another_chain_it_asks_anew_what_lies_further_in() -> None:
    part = TransformedEnv(ToyEnv(2), ActionHistory(2)).transform
    first = TransformedEnv(ToyEnv(2), part.clone())
    assert first.reset()["action_history"].shape == (2, 2, 3)
    moved = first.transform
    for forget in (moved.empty_cache, moved.reset_parent):
        moved._specs["action"] = moved._specs["reward"] = object()
        forget()
        assert not moved._specs


def test_rows_of_another_batch_have_streams_of_their_own_and_no_episodes_yet() -> None:
    part = EncoderOffset(seed=5, first_row=2)
    larger = EncoderOffset(seed=5)
    larger._count_episodes_of(TensorDict(batch_size=[10]))
    for size in ([3], [2, 4], [5]):
        part._count_episodes_of(TensorDict(batch_size=size))
        assert part.episode.tolist() == torch.zeros(size).tolist()
        part.episode += 1
        assert torch.equal(part.row_stream.flatten(), larger.row_stream[2 : 2 + part.row_stream.numel()])


def test_a_row_starts_anew_if_any_of_its_flags_says_so() -> None:
    part = EncoderOffset()
    part._count_episodes_of(TensorDict(batch_size=[3]))
    asked = TensorDict(_reset=torch.tensor([[True, False], [False, False], [True, True]]), batch_size=[3])
    assert part._starts(asked).tolist() == [True, False, True]
    assert part._starts(TensorDict(batch_size=[3])) == 1


def test_what_lies_under_all_transforms_is_found_in_any_depth() -> None:
    base = env = ToyEnv(2)
    for _ in range(3):
        env = TransformedEnv(env, Compose(), auto_unwrap=False)
        assert base_env_of(env) is base


def test_an_entry_like_another_has_its_type() -> None:
    like = unbounded_like(Unbounded((2, 3), dtype=torch.float64), [2, 7])
    assert (like.shape, like.dtype) == ((2, 7), torch.float64)


def test_entries_on_the_way_in_are_told_to_torchrl() -> None:
    part = StatefulTransform(["a"], ["b"], ["c"], ["d"])
    assert (part.in_keys, part.out_keys, part.in_keys_inv, part.out_keys_inv) == (["a"], ["b"], ["c"], ["d"])


def test_a_copy_counts_episodes_of_its_own() -> None:
    part = EncoderOffset()
    part._count_episodes_of(TensorDict(batch_size=[3]))
    other = part.clone()
    other.episode += 1
    assert part.episode.tolist() == [0, 0, 0]
    assert other.row_stream.equal(part.row_stream)


def test_memory_that_a_partial_reset_would_leave_alone_is_refused() -> None:
    """TorchRL merges what stands beside the reset's flag and nothing else."""
    part = ActionHistory(2)
    with pytest.raises(ValueError, match=r"\('data', 'action_history'\)"):
        part._check_place("action_history", ("data", "_reset"))
    part._check_place(("data", "action_history"), ("data", "_reset"))
    part._check_place("action_history", "_reset")


def test_a_joint_counted_from_the_end_is_that_joint() -> None:
    numbers = torch.arange(4)
    for joints, expected in (([-1], [3]), ([-2, -1], [2, 3]), ([1, 2], [1, 2])):
        assert numbers[joint_index(ActionHistory(2), joints)].tolist() == expected
