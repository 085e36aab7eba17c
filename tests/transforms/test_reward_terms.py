"""Rewards as sums of named terms, with the actions that terms of smoothness look back on."""

import pytest
import torch
from tensordict import TensorDict
from torchrl.envs import Compose, TransformedEnv
from torchrl.envs.utils import check_env_specs

from torchrl_athletic.envs import TorqueEnv
from torchrl_athletic.functional import rewards
from torchrl_athletic.robots import z1
from torchrl_athletic.testing import ToyEnv
from torchrl_athletic.transforms import ActionHistory, Decimation, InPhase, PDControl, RewardTerms, Term

ROBOT = z1()
TERMS = {
    "power": Term(rewards.mechanical_power, "applied_torque", "joint_velocity"),
    "smoothness": Term(rewards.action_roughness, "action_history"),
    "limits": Term(rewards.beyond_limits, "joint_position", limits=torch.tensor(ROBOT.position_limit)),
    "alive": lambda before, after: (~after["terminated"]).float().squeeze(-1),
}
SCALES = {"power": -0.01, "smoothness": -0.05, "limits": -10.0, "alive": 2.0}


def make_env(n: int = 3, *, before: bool = True, **kwargs) -> TransformedEnv:
    history = ActionHistory(3, before=ROBOT.default_pose if before else None)
    chain = PDControl(ROBOT.kp, ROBOT.kd), Decimation(4), history, RewardTerms(TERMS, SCALES, **kwargs)
    return TransformedEnv(TorqueEnv(ROBOT, num_envs=n), Compose(*chain))


def steps(env: TransformedEnv, count: int = 6, seed: int = 0) -> torch.Tensor:
    noise = torch.Generator().manual_seed(seed)
    actions = torch.tensor(ROBOT.default_pose) + 0.3 * torch.randn(count, *env.batch_size, 7, generator=noise)
    td, out = env.reset(), []
    for action in actions:
        td, following = env.step_and_maybe_reset(td.set("action", action))
        out.append(td)
        td = following
    return torch.stack(out, 1)


@pytest.mark.parametrize("sums_key", [None, "episode_reward_terms"])
@pytest.mark.parametrize("show", [True, False])
def test_specs_hold(show, sums_key):
    check_env_specs(make_env(show=show, sums_key=sums_key))
    check_env_specs(make_env(before=False))


def test_the_reward_is_the_sum_of_what_is_shown_and_each_term_is_scaled():
    data = steps(make_env())["next"]
    shown = data["reward_terms"]
    assert set(shown.keys()) == set(TERMS)
    torch.testing.assert_close(data["reward"], sum(shown[name] for name in TERMS))
    power = (data["applied_torque"] * data["joint_velocity"]).sum(-1, keepdim=True).abs()
    torch.testing.assert_close(shown["power"], -0.01 * power)
    assert (shown["alive"] == 2).all()
    assert (shown["smoothness"] < 0).all()


def test_scales_are_per_second_where_dt_is_given():
    plain, timed = steps(make_env())["next"], steps(make_env(dt=0.02))["next"]
    torch.testing.assert_close(timed["reward"], 0.02 * plain["reward"])


def test_the_actions_are_the_policys_own_outside_decimation_and_delays_further_in():
    data = steps(make_env())
    past = torch.tensor(ROBOT.default_pose).expand(3, 2, 7)
    actions = torch.cat((past, data["action"]), 1)
    for t in range(6):
        assert torch.equal(data["next", "action_history"][:, t], actions[:, t : t + 3])


def test_the_first_action_is_no_jump_unless_one_stood_before_it():
    without = steps(make_env(before=False))["next", "reward_terms", "smoothness"]
    assert (without[:, 0] == 0).all()
    assert (without[:, 1] < 0).all()
    assert (steps(make_env(before=True))["next", "reward_terms", "smoothness"][:, 0] < 0).all()


def test_sums_run_over_an_episode_and_start_anew_in_the_rows_that_start():
    env = make_env(sums_key="total", show=False, before=False)
    td = env.reset()
    gained = torch.zeros(3, 1)
    for k in range(5):
        if k == 3:
            mask = torch.tensor([[False], [True], [False]])
            td = env.reset(td.set("_reset", mask))
            gained[1] = 0
        td = env.step(td.set("action", torch.randn(3, 7)))["next"]
        gained += td["reward"]
        torch.testing.assert_close(sum(td["total", name] for name in TERMS), gained)
    assert td["total", "alive"].flatten().tolist() == [10.0, 4.0, 10.0]


def test_a_row_alone_earns_what_it_earns_in_a_batch():
    batch = steps(make_env(sums_key="total"))
    noise = torch.Generator().manual_seed(0)
    actions = torch.tensor(ROBOT.default_pose) + 0.3 * torch.randn(6, 3, 7, generator=noise)
    alone = make_env(1, sums_key="total")
    td = alone.reset()
    for t in range(6):
        td = alone.step(td.set("action", actions[t, 1:2]))["next"]
        assert torch.equal(td["reward"][0], batch["next", "reward"][1, t])
        assert torch.equal(td["total", "smoothness"][0], batch["next", "total", "smoothness"][1, t])


def test_a_term_that_mixes_rows_or_asks_for_what_is_not_there_is_named():
    def env_with(name, term):
        return TransformedEnv(TorqueEnv(ROBOT, num_envs=2), RewardTerms({name: term}, {name: 1.0}))

    wide = env_with("wide", lambda before, after: after["joint_position"])
    with pytest.raises(ValueError, match=r"'wide' has shape \(2, 7\).*Reduce it"):
        wide.rollout(1)
    early = env_with("early", Term(rewards.square, "absent"))
    with pytest.raises(KeyError, match=r"early.*asks for.*before RewardTerms"):
        early.rollout(1)
    with pytest.raises(ValueError, match=r"same names"):
        RewardTerms({"a": TERMS["power"]}, {"b": 1.0})


def test_rewards_add_up_over_two_groups_of_terms():
    one, two = (RewardTerms({"alive": TERMS["alive"]}, {"alive": s}, terms_key=k) for s, k in ((1.0, "a"), (2.0, "b")))
    data = TransformedEnv(TorqueEnv(ROBOT, num_envs=2), Compose(one, two)).rollout(2)
    assert (data["next", "reward"] == 3).all()


def test_a_second_group_under_the_same_key_stands_beside_the_first_one():
    """Terms that a task adds to those of a controller, say, take neither another term's place nor its sum."""
    told = {"terms_key": "terms", "sums_key": "sums"}
    one, two = (RewardTerms({name: TERMS["alive"]}, {name: s}, **told) for name, s in (("a", 1.0), ("b", 2.0)))
    after = TransformedEnv(TorqueEnv(ROBOT, num_envs=2), Compose(one, two)).rollout(3)["next"]
    for name, scale in (("a", 1.0), ("b", 2.0)):
        assert (after["terms", name] == scale).all()
        assert after["sums", name][:, -1].flatten().tolist() == [3 * scale] * 2


def test_a_term_counts_in_the_phases_that_its_action_was_taken_in():
    """A step that leads to another phase still counts for the one that it began in."""
    before = TensorDict(phase=[[0], [1], [2], [3]], speed=torch.zeros(4), batch_size=[4])
    after = TensorDict(phase=[[1], [2], [3], [0]], speed=torch.tensor([5.0, 6.0, 7.0, 8.0]), batch_size=[4])
    gain = InPhase([1, 3], lambda one, other: other["speed"] - one["speed"], "phase")
    assert gain(before, after).tolist() == [[0.0], [6.0], [0.0], [8.0]]


def test_terms_are_shown_unless_they_are_not_to_be() -> None:
    for show in (True, False):
        env = TransformedEnv(ToyEnv(2), RewardTerms({"one": one_each}, {"one": 2.0}, show=show))
        assert ("reward_terms" in env.rollout(1)["next"].keys()) == show


def one_each(before: TensorDict, after: TensorDict) -> torch.Tensor:
    return torch.ones(2, 1)


@pytest.mark.parametrize("scales", [{}, {"a": 1.0, "b": 1.0}, {"b": 1.0}])
def test_each_term_has_a_scale_and_each_scale_a_term(scales: dict[str, float]) -> None:
    with pytest.raises(ValueError, match="same names"):
        RewardTerms({"a": one_each}, scales)


def test_a_term_keeps_the_constants_that_it_was_given() -> None:
    """Though whoever gave them goes on writing into the same tensor."""
    target = torch.tensor([1.0, 0.0])
    term = Term(rewards.absolute_error, "joint_position", target=target)
    target += 9.0
    step = TensorDict(joint_position=[[0.5, 0.0]], batch_size=[1])
    assert term(step, step).tolist() == [[0.5]]
