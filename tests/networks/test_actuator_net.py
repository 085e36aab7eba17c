import pytest
import torch
from networks.samples import move
from tensordict import TensorDict
from torch import nn
from torchrl.envs.utils import ExplorationType, set_exploration_type

from torchrl_athletic.losses import SplitClipPPOLoss
from torchrl_athletic.networks import Sizes, critic, load_checkpoint, save_checkpoint, sizes_of, uan, uan_actor


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


@pytest.mark.parametrize("told", [{}, {"joints": 3}, {"joints": 3, "state_unit": [1.0] * 9, "memory": (0.01,)}])
def test_an_odd_net_turns_about_with_the_motion_and_knows_its_joint_all_the_same(told):
    torch.manual_seed(0)
    net = uan(odd=True, unit=(0.5, 2.0), sharpness_of_velocity=30.0, **told)
    move(net)
    seen = torch.randn(4, 3, 40 + 9 * ("state_unit" in told) + len(told.get("memory", ())))
    torch.testing.assert_close(net(-seen), -net(seen))
    assert net(seen).abs().max() > 1e-3
    alike = net(seen[:, :1].expand(-1, 3, -1))
    assert (alike.std(1).max() > 1e-3) == ("joints" in told)


def test_in_units_a_joint_of_twice_the_strength_gets_twice_the_torque():
    torch.manual_seed(0)
    plain, strong = uan(), uan(torque_unit=[1.0, 2.0, 1.0])
    move(plain)
    strong.load_state_dict(
        {key: value for key, value in plain.state_dict().items() if "extra" not in key}, strict=False
    )
    errors = torch.randn(4, 3, 40)
    torch.testing.assert_close(strong(errors), plain(errors) * torch.tensor([[1.0], [2.0], [1.0]]))


def test_without_units_it_sees_errors_as_they_are():
    errors = 5 * torch.randn(100, 40)
    torch.testing.assert_close(uan()[0](errors), errors, rtol=1e-4, atol=1e-5)


def test_velocities_are_told_apart_about_rest_and_positions_are_not_bent():
    seen = uan(unit=(0.1, 2.0), sharpness_of_velocity=30.0)[0]
    at = torch.tensor([0.0, 0.01, 0.02, 2.0])
    positions = seen((at / 20).unsqueeze(-1).expand(4, 40))[:, 0]
    velocities = seen(at.unsqueeze(-1).expand(4, 40))[:, 20]
    torch.testing.assert_close(positions, at / 2, rtol=1e-4, atol=1e-6)
    assert velocities[-1] == pytest.approx(1.0)
    assert velocities[1] > 5 * 0.01 / 2.0
    torch.testing.assert_close(seen(-at.unsqueeze(-1).expand(4, 40))[:, 20], -velocities)


def test_units_are_saved_and_come_back_with_the_parameters(tmp_path):
    net = uan(unit=(0.1, 2.0), sharpness_of_velocity=30.0, torque_unit=[1.0, 2.0])
    move(net)
    other, errors = uan(), torch.randn(4, 2, 40)
    load_checkpoint(save_checkpoint(tmp_path / "net.pt", net=net), net=other)
    torch.testing.assert_close(other(errors), net(errors))


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


def test_a_net_that_is_told_the_joint_gives_equal_errors_other_torques():
    net = uan(joints=3)
    move(net)
    same = torch.randn(4, 1, 40).expand(4, 3, 40)
    out = net(same)
    assert (out[:, 0] - out[:, 1]).abs().max() > 1e-2
    shuffled = net(same[[2, 0, 3, 1]])
    torch.testing.assert_close(shuffled, out[[2, 0, 3, 1]])


def test_what_the_arm_does_is_seen_in_its_units_and_by_every_joint():
    net = uan(joints=2, state_unit=[1.0, 1.0, 2.0, 2.0, 10.0, 5.0])
    move(net)
    seen = torch.zeros(1, 2, 46)
    seen[..., 44:] = torch.tensor([10.0, -5.0])  # of torque
    torch.testing.assert_close(net[0](seen)[0, :, 44:], torch.tensor([[1.0, -1.0]] * 2), rtol=1e-4, atol=1e-5)
    assert (net(seen) - net(torch.zeros(1, 2, 46))).abs().min() > 1e-3


@pytest.mark.parametrize(
    "told",
    [
        {},
        {"joints": 3},
        {"joints": 3, "state_unit": [1.0] * 9},
        {"memory": (0.01, 0.1)},
        {"joints": 3, "memory": (0.1,)},
        {"joints": 3, "odd": True},
    ],
    ids=["errors", "joint", "arm", "memory", "joint and memory", "odd"],
)
def test_sizes_tell_how_to_make_such_a_net_again(told):
    net = uan(7, (16, 8), **told)
    sizes = sizes_of(net)
    known = told.get("joints"), "state_unit" in told, told.get("memory", ()), told.get("odd", False)
    assert sizes == Sizes(7, (16, 8), *known)
    again = sizes.net()
    again.load_state_dict(net.state_dict())
    assert [p.shape for p in again.parameters()] == [p.shape for p in net.parameters()]


def test_a_state_without_joints_is_refused():
    with pytest.raises(ValueError, match="joints=6 and 18 numbers"):
        uan(state_unit=[1.0] * 18)
    with pytest.raises(ValueError, match="state_unit has 5 numbers for 2 joints"):
        uan(joints=2, state_unit=[1.0] * 5)
