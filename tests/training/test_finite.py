import pytest
import torch
from tensordict import TensorDict
from training.tasks import arm_learner

from torchrl_athletic.training import NonFiniteError, check_finite, iterate


def batch():
    shown = {"observation": torch.zeros(2, 4, 3), "done": torch.zeros(2, 4, 1, dtype=torch.bool)}
    after = TensorDict({key: value.clone() for key, value in shown.items()} | {"reward": torch.zeros(2, 4, 1)}, [2, 4])
    return TensorDict({**shown, "loc": torch.zeros(2, 4, 2), "action": torch.zeros(2, 4, 2), "next": after}, [2, 4])


def test_numbers_pass_however_large_until_one_is_infinite():
    large = batch()
    large["loc"].fill_(torch.finfo(torch.float32).max)
    check_finite(large)
    large["loc"][0, 0] *= 2
    with pytest.raises(NonFiniteError, match="loc"):
        check_finite(large)


def test_the_entry_that_came_first_in_time_is_named():
    """The reward breaks in the second step, the observation in the third, as what follows from it."""
    broken = batch()
    broken["observation"][0, 2:] = torch.nan
    broken["next", "reward"][1, 1:] = torch.inf
    with pytest.raises(NonFiniteError, match=r"\('next', 'reward'\) of the batch is inf in row 1 at step 1; then also"):
        check_finite(broken)


@pytest.mark.parametrize(
    ("entries", "first", "advice"),
    [
        ([("next", "observation"), ("next", "reward")], "'next', 'observation'", "environment made it"),
        (["action", ("next", "observation")], "'action'", "network's weights"),
        (["observation", "loc", "action"], "'observation'", "environment made it"),
        (["action", "loc"], "'loc'", "network's weights"),
    ],
)
def test_of_several_at_one_time_the_cause_is_named(entries, first, advice):
    broken = batch()
    for entry in entries:
        broken[entry][0, 0] = torch.nan
    with pytest.raises(NonFiniteError, match=rf"^\(?{first}\)? of .*{advice}"):
        check_finite(broken)


def test_rows_are_counted():
    broken = batch()
    broken["observation"][:, 3] = -torch.inf
    with pytest.raises(NonFiniteError, match="-inf in row 0 and 1 other rows at step 3"):
        check_finite(broken)


def test_one_number_of_a_row_is_enough_and_the_others_do_not_move_the_step():
    broken = batch()
    broken["observation"][1, 2, 0] = torch.nan
    broken["observation"][0, 3, 1] = torch.inf
    with pytest.raises(NonFiniteError, match="is nan in row 1 at step 2; all else is finite"):
        check_finite(broken)


def test_an_entry_of_one_number_a_step_breaks_at_its_own_step_and_empty_and_whole_ones_break_never():
    broken = batch()
    broken["action_log_prob"], broken["nothing"] = torch.zeros(2, 4), torch.zeros(2, 4, 0)
    broken["count"] = torch.full((2, 4, 1), 2**40)
    check_finite(broken)
    broken["action_log_prob"][1, 2:], broken["observation"][0, 3] = torch.nan, torch.nan
    with pytest.raises(NonFiniteError, match="'action_log_prob' of the batch is nan in row 1 at step 2; then also"):
        check_finite(broken)


def test_without_a_time_the_numbers_that_are_none_are_counted():
    report = TensorDict({"kl": torch.tensor(0.1), "loss": torch.tensor([1.0, torch.inf, 2.0, torch.inf, 3.0])})
    with pytest.raises(NonFiniteError, match="'loss' of the update is inf in 2 of 5 numbers; all else is finite"):
        check_finite(report, "update")


def test_a_network_gone_bad_stops_the_training_before_it_learns_from_it():
    learner = arm_learner()
    iterate(learner)
    with torch.no_grad():
        learner.actor.get_submodule("module.0.module.network.mlp")[-1].bias[0] = torch.nan
    before = [parameter.clone() for parameter in learner.critic.parameters()]
    with pytest.raises(NonFiniteError, match="'loc' of the batch is nan"):
        iterate(learner)
    assert all((one == other).all() for one, other in zip(before, learner.critic.parameters(), strict=True))


def test_of_numbers_made_at_one_time_each_is_named_before_what_is_made_of_it():
    order = ["observation", "loc", "scale", "action", "action_log_prob", "reward", "advantage", "value_target"]
    broken = TensorDict({key: torch.full((1, 1), torch.nan) for key in reversed(order)}, [1, 1])
    for key in order:
        with pytest.raises(NonFiniteError, match=f"^'{key}' of the batch"):
            check_finite(broken)
        broken[key].zero_()
    check_finite(broken)


def test_of_several_rows_the_number_is_that_of_the_row_that_is_named():
    broken = batch()
    broken["observation"][0, 1], broken["observation"][1, 1] = torch.inf, torch.nan
    with pytest.raises(NonFiniteError, match="is inf in row 0 and 1 other rows at step 1"):
        check_finite(broken)


def test_where_nothing_is_a_fraction_nothing_is_no_number():
    check_finite(TensorDict(count=torch.ones(2, 3, dtype=torch.int64), batch_size=[2, 3]))
