"""What was seen in the last steps, against the list of what was seen, and against TorchRL's CatFrames."""

import pytest
import torch
from torchrl.envs import CatFrames, TransformedEnv

from torchrl_athletic.testing import ToyEnv, difference, make_actions, play
from torchrl_athletic.transforms import ObservationHistory


def played(*, steps=12, length=3, **settings):
    env = TransformedEnv(ToyEnv(4), ObservationHistory(["joint_position"], length, **settings))
    return play(env, make_actions(env, steps))[0]


def test_it_shows_the_last_values_oldest_first_and_the_first_one_until_there_are_enough():
    steps = played()
    for row in range(4):
        seen: list[torch.Tensor] = []
        for step in steps[:, row].unbind(0):
            seen.append(step["joint_position"])
            expected = ([seen[0]] * 2 + seen)[-3:]
            assert torch.equal(step["joint_position_history"], torch.stack(expected))
            assert torch.equal(step["next", "joint_position_history"][-1], step["next", "joint_position"])
            assert torch.equal(step["next", "joint_position_history"][:-1], step["joint_position_history"][1:])
            if step["next", "done"]:
                seen = []


def test_with_length_one_it_is_the_entry_itself():
    steps = played(length=1)
    assert torch.equal(steps["joint_position_history"].squeeze(-2), steps["joint_position"])


def test_flat_it_holds_the_same_numbers_in_the_same_order():
    flat = played(flatten=True)["joint_position_history"]
    assert torch.equal(flat, played()["joint_position_history"].flatten(-2))


def test_it_equals_catframes_bit_for_bit():
    """CatFrames is TorchRL's, and stacks on the last dimension."""
    ours = TransformedEnv(ToyEnv(4), ObservationHistory(["observation"], 5, ["seen"], flatten=True))
    stock = TransformedEnv(ToyEnv(4), CatFrames(5, -1, in_keys=["observation"], out_keys=["seen"]))
    actions = make_actions(ours, 15)
    assert difference(play(ours, actions)[0], play(stock, actions)[0]) is None


def test_a_history_in_place_of_its_source_is_refused():
    for sources, names in ((["a"], ["a"]), (["a", "b"], ["c", "a"]), (["a", "b"], ["c"])):
        with pytest.raises(ValueError, match="must name one new entry"):
            ObservationHistory(sources, 3, names)


def test_a_history_of_nothing_is_refused():
    with pytest.raises(ValueError, match="at least 1"):
        ObservationHistory(["a"], 0)


def test_on_a_buffer_it_says_where_the_history_is():
    steps = played()
    with pytest.raises(RuntimeError, match=r"joint_position_history.*from the buffer"):
        ObservationHistory(["joint_position"], 3)(steps)


@pytest.mark.parametrize(
    ("key", "shown"),
    [("q", "q_history"), (("arm", "q"), ("arm", "q_history")), (("a", "b", "q"), ("a", "b", "q_history"))],
)
def test_it_is_shown_beside_its_source_under_a_longer_name(key, shown):
    assert ObservationHistory([key], 3).out_keys == [shown]
