import numpy as np
import pytest
import torch
from scipy import stats
from torchrl.data import Unbounded
from torchrl.envs import RenameTransform, TransformedEnv
from training.tasks import SEEN, arm_env

from torchrl_athletic.networks import actor
from torchrl_athletic.testing import ToyEnv
from torchrl_athletic.training import Episodes, last_of, play, whole_episodes, whole_rollout
from torchrl_athletic.transforms import StatefulTransform


def policy():
    torch.manual_seed(0)
    return actor(7, 7, in_keys=SEEN, hidden=(8,))


def test_a_policy_is_measured_without_its_noise_up_to_the_end_of_an_episode():
    seen = play(arm_env(episode=5), policy(), steps=20)
    assert seen.batch_size == (4, 5)
    assert seen["next", "done"][:, -1].all()
    torch.testing.assert_close(seen["action"], seen["loc"], rtol=0, atol=0)
    torch.testing.assert_close(seen["joint_position"][:, 1:], seen["next", "joint_position"][:, :-1], rtol=0, atol=0)


def test_no_more_steps_are_played_than_asked_for():
    assert play(arm_env(episode=50), policy(), steps=3).batch_size == (4, 3)


class Counting(StatefulTransform):
    """Shows how many steps the episode has had."""

    def __init__(self):
        super().__init__([], ["age"])

    def initial(self, tensordict_reset):
        return {"age": torch.zeros(*tensordict_reset.batch_size, 1)}

    def advance(self, tensordict, next_tensordict):
        next_tensordict.set("age", tensordict.get("age") + 1)

    def state_spec(self, observation_spec):
        return {"age": Unbounded((*observation_spec.shape, 1))}


class Falling(torch.nn.Module):
    """Does nothing: the environment ends by itself."""

    def forward(self, tensordict):
        return tensordict.set("action", torch.zeros(*tensordict.batch_size, 3))


def test_each_row_counts_once_up_to_its_first_end():
    """The toy's rows end after 4, 2, 5, 3 and 6 steps; those of even number fail."""
    episodes = whole_episodes(TransformedEnv(ToyEnv(num_envs=5), Counting()), Falling(), ["age"], steps=10)
    assert episodes.steps.tolist() == [4, 2, 5, 3, 6]
    assert episodes.fell.tolist() == [False, True, False, True, False]
    assert episodes.means["age"].tolist() == [2.5, 1.5, 3.0, 2.0, 3.5]  # of 1, 2, 3... up to the end


def test_a_rollout_of_whole_episodes_tells_which_steps_belong_to_them():
    """The rows end after 4, 2, 5, 3 and 6 steps; what a row shows at its end is the age that it came to."""
    episodes = whole_rollout(TransformedEnv(ToyEnv(num_envs=5), Counting()), Falling(), ["age"], steps=10)
    assert episodes["counts"].sum((1, 2)).tolist() == [4, 2, 5, 3, 6]
    assert episodes["counts"][:, 0].all()
    assert last_of(episodes, "age").flatten().tolist() == [4.0, 2.0, 5.0, 3.0, 6.0]


def test_whole_episodes_are_played_without_noise_and_no_longer_than_asked_for():
    seen = play(arm_env(episode=50), policy(), steps=3)["next"]
    kept = whole_rollout(arm_env(episode=50), policy(), ["joint_position", "reward"], steps=3)
    assert kept.batch_size == (4, 3)
    for key in ("joint_position", "reward"):
        torch.testing.assert_close(kept[key], seen[key], rtol=0, atol=0)
    means = whole_episodes(arm_env(episode=50), policy(), ["reward"], steps=3).means
    np.testing.assert_allclose(means["reward"], seen["reward"].mean((1, 2)), rtol=1e-5)


def test_playing_stops_at_the_first_end_of_any_row():
    assert play(TransformedEnv(ToyEnv(num_envs=5), Counting()), Falling(), steps=10).batch_size == (5, 2)


def test_an_episode_longer_than_asked_for_is_cut_and_did_not_fall():
    episodes = whole_episodes(TransformedEnv(ToyEnv(num_envs=3, shortest=50), Counting()), Falling(), ["age"], steps=7)
    assert episodes.steps.tolist() == [7, 7, 7]
    assert not episodes.fell.any()


def test_intervals_are_those_of_scipy_and_none_of_a_thousand_is_not_certainty():
    values = np.random.default_rng(0).normal(2.0, 0.5, 200)
    episodes = Episodes(np.arange(200) < 4, np.full(200, 9), {"error": values})
    mean, low, high = episodes.mean("error")
    expected = stats.ttest_1samp(values, 0.0).confidence_interval(0.95)
    assert (mean, low, high) == pytest.approx((values.mean(), expected.low, expected.high))
    share, low, high = episodes.falls()
    assert low < share == 0.02 < high
    centre = (0.02 + 1.96**2 / 400) / (1 + 1.96**2 / 200)  # Wilson's, by hand
    half = 1.96 / (1 + 1.96**2 / 200) * np.sqrt(0.02 * 0.98 / 200 + 1.96**2 / 4 / 200**2)
    assert (low, high) == pytest.approx((centre - half, centre + half), rel=1e-3)
    none = Episodes(np.zeros(1000, bool), np.full(1000, 9), {})
    assert none.falls()[:2] == (0.0, 0.0)
    assert 0.003 < none.falls()[2] < 0.004


def test_a_row_that_came_to_its_time_did_not_fall_though_its_next_episode_does_meanwhile():
    """Row 2 comes to its time after 4 steps and fails in the next one, when row 4 still goes on."""
    episodes = whole_episodes(TransformedEnv(ToyEnv(num_envs=5, shortest=1), Counting()), Falling(), ["age"], steps=9)
    assert episodes.steps.tolist() == [3, 1, 4, 2, 5]
    assert episodes.fell.tolist() == [False, True, False, True, False]


def test_a_mean_of_an_entry_in_a_group_is_named_by_its_whole_path():
    """Two groups may have an entry of one name."""
    env = TransformedEnv(ToyEnv(num_envs=5), Counting())
    env.append_transform(RenameTransform(["age"], [("told", "age")], create_copy=True))
    episodes = whole_episodes(env, Falling(), [("told", "age")], steps=10)
    assert list(episodes.means) == ["told/age"]


@pytest.mark.parametrize("play_whole", [whole_episodes, whole_rollout])
def test_a_bar_is_shown_under_its_label_or_none_at_all(play_whole, capsys):
    for label, shown in ((None, False), ("falls", True)):
        play_whole(TransformedEnv(ToyEnv(num_envs=2), Counting()), Falling(), ["age"], steps=2, progress=label)
        assert ("falls" in capsys.readouterr().err) is shown


def test_a_rollout_of_whole_episodes_keeps_which_steps_were_falls_beside_what_was_asked_for():
    """Rows of even number fail at their ends, after 2 and 3 steps."""
    episodes = whole_rollout(TransformedEnv(ToyEnv(num_envs=5), Counting()), Falling(), ["age"], steps=10)
    assert set(episodes.keys()) == {"age", "counts", "terminated"}
    falls = episodes["terminated"] & episodes["counts"]
    assert falls.sum((1, 2)).tolist() == [0, 1, 0, 1, 0]
