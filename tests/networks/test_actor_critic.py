import math

import pytest
import torch
from tensordict import TensorDict
from torch import nn
from torchrl.envs.utils import ExplorationType, set_exploration_type

from torchrl_athletic.networks import RunningNormalizer, actor, critic, open_inputs, trunk_of


def test_the_papers_networks_have_three_layers_of_512_and_elu():
    for network in (actor(100, 19), critic(100)):
        layers = [module for module in network.modules() if isinstance(module, nn.Linear)]
        assert [layer.out_features for layer in layers[:-1]] == [512, 512, 512]
        assert sum(isinstance(module, nn.ELU) for module in network.modules()) == 3


def test_the_spread_is_the_same_in_every_state_and_starts_as_asked():
    policy = actor(3, 2, scale=0.25)
    out = policy(TensorDict({"observation": torch.randn(50, 3)}, [50]))
    torch.testing.assert_close(out["scale"], torch.full((50, 2), 0.25))
    assert out["loc"].std(0).min() > 0


def test_it_acts_on_its_mean_until_it_explores():
    policy = actor(3, 2, scale=0.5)
    states = TensorDict({"observation": torch.randn(1, 3).expand(20_000, 3)}, [20_000])
    calm = policy(states.clone())
    assert calm["action"].equal(calm["loc"])
    torch.manual_seed(0)
    with set_exploration_type(ExplorationType.RANDOM):
        wild = policy(states.clone())
    assert (wild["action"] - wild["loc"]).std(0).tolist() == pytest.approx([0.5, 0.5], rel=0.03)


def test_the_log_probability_is_that_of_all_actions_together():
    out = actor(3, 2, scale=0.5)(TensorDict({"observation": torch.randn(4, 3)}, [4]))
    at_mean = -2 * math.log(0.5 * math.sqrt(2 * math.pi))
    assert out["action_log_prob"].tolist() == pytest.approx([at_mean] * 4)


def test_inputs_are_put_side_by_side_in_the_order_given():
    torch.manual_seed(0)
    value = critic(3, in_keys=["observation", ("critic", "privileged")])
    a, b = torch.randn(5, 1), torch.randn(5, 2)
    given = TensorDict({"observation": a, "critic": {"privileged": b}}, [5])
    expected = value.module.mlp(torch.cat((a, b), -1))
    assert value(given)["state_value"].equal(expected)


def test_a_critic_may_see_what_its_actor_does_not():
    policy, value = actor(3, 2), critic(5, in_keys=["observation", "privileged"])
    batch = value(policy(TensorDict({"observation": torch.randn(4, 3), "privileged": torch.randn(4, 2)}, [4])))
    assert batch["state_value"].shape == (4, 1)
    assert policy.in_keys == ["observation"]


def test_a_normalizer_makes_units_irrelevant():
    torch.manual_seed(0)
    normalizer = RunningNormalizer(3)
    policy = actor(3, 2, normalizer=normalizer)
    states = torch.randn(200, 3)
    normalizer.update(states)
    metres = policy(TensorDict({"observation": states}, [200]))["loc"]
    normalizer.count.zero_()
    normalizer.update(1e3 * states)
    millimetres = policy(TensorDict({"observation": 1e3 * states}, [200]))["loc"]
    torch.testing.assert_close(metres, millimetres, rtol=1e-3, atol=1e-4)


def test_it_holds_for_any_leading_dims():
    states = torch.randn(6, 3)
    policy = actor(3, 2)
    flat = policy(TensorDict({"observation": states}, [6]))["loc"]
    deep = policy(TensorDict({"observation": states.view(2, 3, 3)}, [2, 3]))["loc"]
    torch.testing.assert_close(deep.view(6, 2), flat)


def trained(size, make):
    torch.manual_seed(0)
    normalizer = RunningNormalizer(size)
    normalizer.update(torch.cat((torch.randn(100, size - 1), torch.zeros(100, 1)), -1))  # one input was always 0
    return make(normalizer)


def test_inputs_that_are_opened_change_nothing_at_first_but_can_be_learnt_to():
    policy = trained(4, lambda normalizer: actor(4, 2, hidden=(8,), normalizer=normalizer))
    silent = torch.cat((torch.randn(5, 3), torch.zeros(5, 1)), -1)
    spoken = silent + torch.tensor([0.0, 0.0, 0.0, 1.0])
    before = policy(TensorDict({"observation": silent}, [5]))["loc"]
    assert (policy(TensorDict({"observation": spoken}, [5]))["loc"] - before).abs().max() > 0.1
    open_inputs(policy, [3])
    after = policy(TensorDict({"observation": spoken}, [5]))["loc"]
    torch.testing.assert_close(after, before, rtol=0, atol=1e-6)
    after.sum().backward()
    gradient = trunk_of(policy).mlp[0].weight.grad[:, 3]
    assert gradient.abs().max() > 0
    assert trunk_of(policy).normalizer(spoken)[:, 3].tolist() == [1.0] * 5


def test_a_critic_takes_more_inputs_behind_those_it_has():
    value = trained(4, lambda normalizer: critic(4, hidden=(8,), normalizer=normalizer))
    seen = torch.randn(5, 4)
    before = value(TensorDict({"observation": seen}, [5]))["state_value"]
    open_inputs(value, new=[1.0, 100.0])
    more = torch.cat((seen, 100 * torch.randn(5, 2)), -1)
    torch.testing.assert_close(value(TensorDict({"observation": more}, [5]))["state_value"], before)
    shown = trunk_of(value).normalizer(torch.tensor([[0.0, 0.0, 0.0, 0.0, 3.0, 150.0]]))
    assert shown[0, 4:].tolist() == [3.0, 1.5]  # by their usual sizes: none is cut off


def test_inputs_that_are_opened_are_normalised_by_nothing_and_new_ones_by_their_usual_size():
    """Those in between go on as they were."""
    normalizer = RunningNormalizer(4)
    normalizer.update(torch.tensor([[1.0, 2.0, 3.0, 4.0], [3.0, 6.0, 9.0, 12.0]]))
    value = critic(4, hidden=(8,), normalizer=normalizer)
    open_inputs(value, [1, 3], [0.5, 20.0])
    assert normalizer.mean.tolist() == [2.0, 0.0, 6.0, 0.0, 0.0, 0.0]
    assert normalizer.variance.sqrt().tolist() == pytest.approx([1.0, 1.0, 3.0, 1.0, 0.5, 20.0])
    weight = trunk_of(value).mlp[0].weight
    assert weight.any(0).tolist() == [True, False, True, False, False, False]
