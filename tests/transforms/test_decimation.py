"""One action, several steps: against the same steps by hand, one row at a time."""

from functools import partial

import pytest
import torch
from tensordict import TensorDict
from torchrl.data import Composite
from torchrl.envs import Compose, FrameSkipTransform, SerialEnv, StepCounter, Transform, TransformedEnv

from torchrl_athletic.testing import ToyEnv, difference, make_actions, play, rows_together
from torchrl_athletic.transforms import Decimation, ObservationHistory, PDControl
from torchrl_athletic.transforms.decimation import _done

OURS = ("joint_position", "joint_velocity", "observation", "reward", "done", "terminated", "truncated")


class Half(Transform):
    """A link in the chain: half of the action arrives."""

    def __init__(self):
        super().__init__(in_keys=[], out_keys=[], in_keys_inv=["action"], out_keys_inv=["action"])

    def _inv_call(self, tensordict):
        return tensordict.set("action", 0.5 * tensordict.get("action"))


class Recording(ToyEnv):
    """A toy that notes which actions reached it, and whether a step had to show all."""

    def _step(self, tensordict):
        self.__dict__.setdefault("arrived", []).append(tensordict.get("action").clone())
        self.__dict__.setdefault("substeps", []).append("_substep" in tensordict.keys())
        return super()._step(tensordict)


class Whole(ToyEnv):
    """A toy that cannot step some of its rows only."""

    supports_partial_step = False

    def _step(self, tensordict):
        return super()._step(tensordict.exclude("_step"))


def by_hand(row, actions, substeps):
    """Rows alone: repeat each action until the count is full or the episode over; sum up the reward."""
    env = ToyEnv(1, first_row=row, shortest=4)
    shown, steps = env.reset(), []
    for action in actions.unbind(0):
        reward = 0
        for _ in range(substeps):
            following = env.step(shown.copy().update(action))["next"]
            reward = reward + following["reward"]
            shown = following.exclude("reward")
            if following["done"]:
                break
        steps.append(following.set("reward", reward))
        if following["done"]:
            shown = env.reset()
    return torch.stack(steps)


@pytest.mark.parametrize("make", [ToyEnv, Whole], ids=["partial steps", "whole batch steps"])
def test_an_episode_that_ends_within_an_action_ends_with_its_true_last_observation_and_reward(make):
    env = TransformedEnv(make(4, shortest=4), Decimation(3))
    actions = make_actions(env, 1)
    following = play(env, actions)[0]["next"].clone()
    alone = rows_together([by_hand(row, actions[:, row : row + 1], 3) for row in range(4)])
    assert difference(following.select(*OURS), alone.select(*OURS)) is None


def test_a_batch_does_what_each_row_does_by_hand_through_several_episodes():
    env = TransformedEnv(ToyEnv(4, shortest=4), Decimation(3))
    actions = make_actions(env, 12)
    steps = play(env, actions)[0]
    assert steps["next", "done"].any()
    alone = rows_together([by_hand(row, actions[:, row : row + 1], 3) for row in range(4)])
    assert difference(steps["next"].select(*OURS), alone.select(*OURS)) is None


@pytest.mark.parametrize("rows", [None, 2], ids=["one row each", "two rows each"])
def test_around_workers_it_does_what_it_does_within_them(rows):
    def workers(*, inside):
        def make(first_row):
            env = ToyEnv(rows, first_row=first_row, shortest=4)
            return TransformedEnv(env, Decimation(3)) if inside else env

        env = SerialEnv(2, [partial(make, first_row) for first_row in (0, 2)])
        return env if inside else TransformedEnv(env, Decimation(3))

    around, within = workers(inside=False), workers(inside=True)
    actions = make_actions(around, 8)
    assert difference(play(around, actions)[0], play(within, actions)[0]) is None


def test_every_step_of_the_physics_gets_the_policy_s_action_through_the_chain_once():
    base = Recording(1, shortest=9)
    env = TransformedEnv(base, Compose(Half(), Decimation(3)))
    env.step(env.reset().set("action", torch.full((1, 3), 0.8)))
    assert torch.stack(base.arrived).flatten().tolist() == pytest.approx([0.4] * 9)
    assert base.substeps == [True, True, False]


def test_torchrl_s_frame_skip_applies_the_chain_to_its_own_output():
    """The defect that this transform is there to avoid; once it is gone upstream, this test says so."""
    base = Recording(1, shortest=9)
    env = TransformedEnv(base, Compose(Half(), FrameSkipTransform(3)))
    env.step(env.reset().set("action", torch.full((1, 3), 0.8)))
    assert torch.stack(base.arrived)[:, 0, 0].tolist() == pytest.approx([0.4, 0.2, 0.2])


def test_a_controller_in_the_chain_sees_the_joints_at_every_step():
    base = Recording(1, shortest=9)
    control = PDControl(20.0, 0.5, torque_key="action", action_key="goal")
    env = TransformedEnv(base, Compose(control, Decimation(4)))
    shown = env.reset()
    q, v = shown["joint_position"], shown["joint_velocity"]
    env.step(shown.set("goal", torch.ones(1, 3)))
    for torque in base.arrived:
        assert torch.equal(torque, 20.0 * (1 - q) - 0.5 * v)
        v = 0.875 * v + 0.25 * torque.clamp(-8, 8)
        q = q + 0.125 * v
    assert len(base.arrived) == 4


def test_what_stands_before_it_runs_at_the_physics_rate_and_what_stands_after_it_at_the_policy_s():
    env = TransformedEnv(
        ToyEnv(2, shortest=9),
        Compose(StepCounter(step_count_key="physics"), Decimation(4), StepCounter(step_count_key="policy")),
    )
    steps = play(env, make_actions(env, 2))[0]
    assert steps["next", "physics"][:, 0, 0].tolist() == [4, 8]
    assert steps["next", "policy"][:, 0, 0].tolist() == [1, 2]


def test_a_history_before_it_holds_every_step_of_the_physics():
    env = TransformedEnv(ToyEnv(1, shortest=9), Compose(ObservationHistory(["joint_position"], 5), Decimation(4)))
    actions = make_actions(env, 1)
    seen = play(env, actions)[0]["next", "joint_position_history"][0, 0]
    base = ToyEnv(1, shortest=9)
    shown = base.reset()
    positions = [shown["joint_position"][0]]
    for _ in range(4):
        shown = base.step(shown.update(actions[0]))["next"]
        positions.append(shown["joint_position"][0])
    assert torch.equal(seen, torch.stack(positions))


def test_one_step_per_action_is_no_decimation():
    env = TransformedEnv(ToyEnv(3), Decimation(1))
    actions = make_actions(env, 10)
    assert difference(play(env, actions)[0], play(ToyEnv(3), actions)[0]) is None


def test_it_holds_within_an_environment_without_a_batch():
    env = TransformedEnv(ToyEnv(None, shortest=4), Decimation(3))
    actions = make_actions(env, 6)
    batched = play(TransformedEnv(ToyEnv(1, shortest=4), Decimation(3)), actions.unsqueeze(1))[0]
    assert difference(play(env, actions)[0].unsqueeze(1), batched) is None


def test_no_steps_at_all_are_refused():
    with pytest.raises(ValueError, match="at least 1"):
        Decimation(0)


class Averaging(ToyEnv):
    """A toy whose ``load`` counts the steps since the episode's start, and is a mean over those of an action."""

    averaged_keys = ("load",)

    def _step(self, tensordict):
        shown = super()._step(tensordict)
        return shown.set("load", self._time.unsqueeze(-1).float())


def test_what_the_environment_names_is_averaged_over_the_steps_of_an_action_up_to_its_end():
    env = TransformedEnv(
        Averaging(num_envs=2, extra={"load": [1]}), Decimation(4)
    )  # rows end after 4 and after 2 steps
    after = env.step(env.reset().set("action", torch.zeros(2, 3)))["next"]
    assert after["done"].flatten().tolist() == [True, True]
    assert after["load"].flatten().tolist() == [2.5, 1.5]


def test_without_decimation_it_is_the_step_s_own():
    env = TransformedEnv(Averaging(num_envs=2, extra={"load": [1]}), Decimation(1))
    assert env.step(env.reset().set("action", torch.zeros(2, 3)))["next", "load"].flatten().tolist() == [1.0, 1.0]


def test_what_an_action_started_from_stays_as_it_was():
    """The steps in between are the transform's own: data that is collected shows each action beside what it saw."""
    env = TransformedEnv(ToyEnv(3), Decimation(4))
    before = env.reset().set("action", torch.ones(3, 3))
    kept = before.clone()
    after = env._step(before)
    assert not after["joint_position"].equal(kept["joint_position"])
    assert before["joint_position"].equal(kept["joint_position"])
    assert before["action"].equal(kept["action"])


@pytest.mark.parametrize("steps", [1, 2, 3])
def test_only_the_last_step_of_an_action_has_to_show_all(steps):
    env = TransformedEnv(Recording(2, shortest=9), Decimation(steps))
    env.step(env.reset().set("action", torch.ones(2, 3)))
    assert env.base_env.substeps == [True] * (steps - 1) + [False]


def test_every_reward_is_summed():
    class TwoRewards(ToyEnv):
        def _make_specs(self, dtype):
            super()._make_specs(dtype)
            reward = self.reward_spec
            self.reward_spec = Composite(reward=reward.clone(), bonus=reward.clone(), shape=self.batch_size)

        def _step(self, tensordict):
            step = super()._step(tensordict)
            return step.set("bonus", 2 * step["reward"] + 1)

    steps = TransformedEnv(TwoRewards(2, shortest=20), Decimation(4)).rollout(3)["next"]
    assert steps["reward"].abs().min() > 0
    torch.testing.assert_close(steps["bonus"], 2 * steps["reward"] + 4)


@pytest.mark.parametrize("raised", ["done", "terminated", "truncated"])
def test_a_row_is_at_its_end_by_any_of_its_flags(raised):
    env = ToyEnv(3)
    flags = dict.fromkeys(env.done_keys, torch.zeros(3, 1, dtype=torch.bool))
    flags |= {raised: torch.tensor([[True], [False], [True]])}
    assert _done(env, TensorDict(flags, batch_size=[3])).equal(flags[raised])
    assert _done(env, TensorDict({raised: flags[raised]}, batch_size=[3])).equal(flags[raised])
    assert not _done(env, TensorDict(batch_size=[3])).any()
