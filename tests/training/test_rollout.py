from types import SimpleNamespace

import pytest
import torch
from tensordict import TensorDict
from tensordict.nn import TensorDictModule
from torchrl.envs import Compose, GymEnv, InitTracker, RewardSum, StepCounter, TransformedEnv
from torchrl.testing.mocking_classes import CountingEnv, NestedCountingEnv
from training.tasks import SEEN, arm_env

from torchrl_athletic.networks import actor
from torchrl_athletic.training import Rollout, control_step
from torchrl_athletic.training.rollout import done_rows, kept_keys, reset_key_of, start_anew


def entries(tensordict):
    return set(tensordict.keys(include_nested=True, leaves_only=True))


def policy(seed=0):
    torch.manual_seed(seed)
    return actor(7, 7, in_keys=SEEN, hidden=(8,))


def arm_with_stock_transforms():
    return TransformedEnv(arm_env(), Compose(RewardSum(), InitTracker()))


def test_batches_are_those_of_the_collector_of_torchrl():
    """Three batches in a row, so that episodes end within one and go on into the next; random actions and resets."""
    act, batches = policy(), []
    for collector in (False, True):
        torch.manual_seed(1)
        rollout = Rollout(arm_with_stock_transforms(), act, horizon=7, collector=collector)
        batches.append([rollout().clone() for _ in range(3)])
    for ours, theirs in zip(*batches, strict=True):
        assert entries(ours) == entries(theirs)
        assert ours.batch_size == theirs.batch_size == (4, 7)
        assert ours.names == theirs.names
        for key in entries(ours):
            assert ours[key].dtype == theirs[key].dtype
            torch.testing.assert_close(ours[key], theirs[key], rtol=0, atol=0)
    assert batches[0][0]["next", "truncated"].any()


def counting_env(num_envs=3):
    return TransformedEnv(CountingEnv(max_steps=4, batch_size=[num_envs]), StepCounter())


def count_up(tensordict):
    return tensordict.set("action", torch.ones(*tensordict.batch_size, 1, dtype=torch.int32))


def test_an_episode_shows_its_last_observation_before_it_starts_anew():
    batch = Rollout(counting_env(), count_up, horizon=7)()
    assert batch["observation"][0, :, 0].tolist() == [0, 1, 2, 3, 4, 0, 1]
    assert batch["next", "observation"][0, :, 0].tolist() == [1, 2, 3, 4, 5, 1, 2]
    assert batch["next", "done"][0, :, 0].tolist() == [False] * 4 + [True] + [False] * 2


def test_rows_that_go_on_are_not_touched_by_a_reset_beside_them():
    env = counting_env(2)
    current = env.reset()
    current["step_count"][:] = torch.tensor([[3], [0]])
    _, following = control_step(env, count_up, current)
    assert following["step_count"].squeeze(-1).tolist() == [4, 1]
    shown = following.clone()
    shown["done"] = shown["terminated"] = torch.tensor([[True], [False]])
    renewed = start_anew(env, shown)
    assert renewed["step_count"].squeeze(-1).tolist() == [0, 1]
    assert renewed["done"].sum() == 0


def test_any_flag_ends_a_row():
    env = TransformedEnv(CountingEnv(max_steps=4, batch_size=[4]), StepCounter(9))
    shown = env.reset()
    assert len(env.done_keys) == 3
    for row, key in enumerate(env.done_keys):
        shown[key] = torch.arange(4).unsqueeze(-1) == row
    assert done_rows(env, shown).squeeze(-1).tolist() == [True, True, True, False]


def test_a_step_leaves_its_input_alone():
    env = counting_env()
    current = env.reset()
    before = current.clone()
    control_step(env, count_up, current)
    assert entries(current) == entries(before)
    assert (current == before).all()


def test_memory_of_transforms_is_carried_but_not_stored():
    rollout = Rollout(arm_env(), policy(), horizon=3, keys=["joint_velocity"])
    batch = rollout()
    assert "action_queue" in rollout.current.keys()
    wanted = {"joint_position", "joint_velocity", "done", "terminated", "truncated"}
    made = {"loc", "scale", "action", "action_log_prob"}
    after = {("next", key) for key in (wanted - {"joint_position"}) | {"reward"}}
    assert entries(batch) == wanted | made | after


def test_storage_is_allocated_once():
    rollout = Rollout(counting_env(), count_up, horizon=2)
    first, second = rollout(), rollout()
    assert first["observation"].data_ptr() == second["observation"].data_ptr()
    assert second["observation"][0, :, 0].tolist() == [2, 3]


def test_a_step_of_ones_own_takes_the_place_of_the_plain_one():
    env, calls = counting_env(), []

    def step(tensordict):
        calls.append(tensordict)
        return control_step(env, count_up, tensordict)

    Rollout(env, count_up, horizon=5, step=step)()
    assert len(calls) == 5


def test_an_empty_horizon_is_refused():
    with pytest.raises(ValueError, match="at least 1 step"):
        Rollout(counting_env(), count_up, horizon=0)


def test_environments_with_several_flags_are_sent_to_the_collector_of_torchrl():
    with pytest.raises(ValueError, match="collector=True"):
        Rollout(NestedCountingEnv(batch_size=[2]), lambda tensordict: tensordict, horizon=2)


def test_where_values_must_not_be_looked_at_a_mask_gives_the_same_batch(monkeypatch):
    """As on a GPU: every step resets, and the mask says whom."""
    act, batches = policy(), []
    for on_host in (True, False):
        monkeypatch.setattr("torchrl_athletic.training.rollout._on_host", lambda tensor, answer=on_host: answer)
        torch.manual_seed(1)
        batches.append(Rollout(arm_env(), act, horizon=12)().clone())
    assert batches[0]["next", "done"].any()
    assert (batches[0] == batches[1]).all()


def test_a_rollout_that_is_gone_on_with_has_its_simulation_again():
    def collected(rollout):
        torch.manual_seed(1)
        return rollout().clone()

    first, second = (Rollout(arm_env(), policy(), horizon=3, keys=["joint_position", "joint_velocity"]) for _ in "ab")
    for _ in range(3):
        first()
    state = first.state_dict()
    wanted = collected(first)
    second.load_state_dict(state)
    found = collected(second)
    for key in ("joint_position", "joint_velocity", ("next", "joint_velocity")):
        torch.testing.assert_close(found[key], wanted[key], rtol=0, atol=0)


@pytest.mark.parametrize("keys", [[("agents", "_reset")], ["_reset", ("agents", "_reset")], []])
def test_rows_are_reset_by_one_flag_at_the_root_and_by_no_other(keys):
    assert reset_key_of(SimpleNamespace(reset_keys=["_reset"])) == "_reset"
    with pytest.raises(ValueError, match="one flag per row, at the root"):
        reset_key_of(SimpleNamespace(reset_keys=keys))


def test_the_collector_of_torchrl_has_no_state_and_takes_none_over():
    stock, ours = (Rollout(counting_env(), count_up, horizon=2, collector=collector) for collector in (True, False))
    assert stock.state_dict() == {}
    stock.load_state_dict(ours.state_dict())
    assert stock()["observation"].shape == (3, 2, 1)
    ours.load_state_dict(stock.state_dict())
    assert ours()["observation"][0, :, 0].tolist() == [0, 1]


def test_what_the_policy_sees_next_holds_neither_its_action_nor_whom_to_reset():
    env = counting_env()
    current = env.reset()
    for _ in range(6):  # over the end of an episode
        current = control_step(env, count_up, current)[1]
        assert not {"action", "next", "reward", "_reset"} & set(current.keys())


@pytest.mark.parametrize("act", [count_up, TensorDictModule(torch.nn.Identity(), ["observation"], ["action"])])
def test_what_was_done_and_what_is_asked_for_of_the_step_after_is_kept_of_any_policy(act):
    """An entry may be called ``next`` and be none of what a step led to."""
    keys = [("told", "next"), ("next", "step_count")]
    kept = kept_keys(counting_env(), act, keys)
    assert {"action", ("told", "next"), ("next", "told", "next"), ("next", "step_count")} <= set(kept)
    assert "step_count" not in kept
    assert {"done", ("next", "done"), ("next", "reward")} <= set(kept)


def test_an_environment_that_shows_whom_it_reset_does_not_make_the_policy_see_that():
    flags = {name: torch.tensor([[True], [False]]) for name in ("done", "terminated")}
    shown = TensorDict(seen=torch.tensor([[5.0], [6.0]]), **flags, batch_size=[2])
    fresh = {"seen": torch.zeros(2, 1), **{name: torch.zeros(2, 1, dtype=torch.bool) for name in flags}}
    env = SimpleNamespace(
        done_keys=["done", "terminated"],
        reset_keys=["_reset"],
        batch_size=[2],
        device=None,
        _reset=lambda reset: reset.clone().update(fresh),
    )
    renewed = start_anew(env, shown)
    assert set(renewed.keys()) == {"seen", *flags}
    assert renewed["seen"].flatten().tolist() == [0.0, 6.0]


def test_a_state_stays_as_it_was_taken():
    rollout = Rollout(counting_env(), count_up, horizon=2)
    rollout()
    state = rollout.state_dict()["current"]
    for value in rollout.current.values():
        value.zero_()
    assert state["observation"].flatten().tolist() == [2, 2, 2]


def test_an_environment_without_one_dimension_of_rows_is_refused_with_its_mend():
    env = GymEnv("Pendulum-v1")
    with pytest.raises(ValueError, match=r"batch size \(\).*SerialEnv"):
        Rollout(env, env.rand_action, 3)
