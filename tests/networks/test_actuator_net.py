import torch
from networks.samples import move
from tensordict import TensorDict
from torch import nn
from torchrl.envs.utils import ExplorationType, set_exploration_type

from torchrl_athletic.losses import SplitClipPPOLoss
from torchrl_athletic.networks import critic, uan, uan_actor


def moved():
    net = uan()
    move(net)
    return net


def test_it_has_the_papers_layers():
    layers = [module for module in uan().modules() if isinstance(module, nn.Linear)]
    assert [(layer.in_features, layer.out_features) for layer in layers] == [(40, 128), (128, 128), (128, 1)]


def test_untrained_it_corrects_nothing():
    assert uan()(torch.randn(4, 6, 40)).abs().max() == 0


def test_every_joint_is_corrected_by_the_same_network_and_by_its_own_errors_alone():
    net, errors = moved(), torch.randn(4, 6, 40)
    out = net(errors)
    shuffled = torch.tensor([3, 1, 5, 0, 2, 4])
    torch.testing.assert_close(net(errors[:, shuffled]), out[:, shuffled])
    errors[:, 2] += 1.0
    changed = (net(errors) - out).abs().amax((0, 2)) > 1e-6
    assert changed.tolist() == [False, False, True, False, False, False]


def test_the_policy_that_trains_it_explores_around_it():
    net = moved()
    policy = uan_actor(net, scale=0.5)
    states = TensorDict({"observation": torch.randn(3000, 6, 40)}, [3000])
    with set_exploration_type(ExplorationType.RANDOM):
        out = policy(states)
    assert out["loc"].equal(net(states["observation"]).squeeze(-1))
    assert 0.49 < (out["action"] - out["loc"]).std() < 0.51
    assert out["action_log_prob"].shape == (3000,)


def test_training_the_policy_trains_the_network():
    net = moved()
    policy = uan_actor(net)
    batch = policy(TensorDict({"observation": torch.randn(16, 6, 40)}, [16])).detach()
    batch["advantage"] = torch.randn(16, 1)
    batch["value_target"] = torch.randn(16, 1)
    loss = SplitClipPPOLoss(policy, critic(6, in_keys=["privileged"]))
    batch["action"] = batch["action"] + 0.1
    loss.loss_actor(batch)["loss_objective"].backward()
    assert all(parameter.grad.abs().max() > 0 for parameter in net.parameters())
