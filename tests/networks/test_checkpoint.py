import pytest
import torch
from torch import nn

from torchrl_athletic.networks import RunningNormalizer, actor, critic, load_checkpoint, save_checkpoint


def networks():
    return actor(4, 2, hidden=(8,), normalizer=RunningNormalizer(4)), critic(4, hidden=(8,))


def same(a, b):
    return all(x.equal(y) for x, y in zip(a.state_dict().values(), b.state_dict().values(), strict=True))


def test_what_is_read_is_what_was_written(tmp_path):
    policy, value = networks()
    policy[0].module.network.normalizer.update(torch.randn(10, 4))
    path = save_checkpoint(tmp_path / "deep" / "policy.pt", {"robot": "z1", "steps": 3}, actor=policy, critic=value)
    other_policy, other_value = networks()
    assert not same(policy, other_policy)
    assert load_checkpoint(path, actor=other_policy, critic=other_value) == {"robot": "z1", "steps": 3}
    assert same(policy, other_policy)
    assert same(value, other_value)


def test_the_actor_alone_can_be_read(tmp_path):
    policy, value = networks()
    path = save_checkpoint(tmp_path / "policy.pt", actor=policy, critic=value)
    other, _ = networks()
    load_checkpoint(path, actor=other)
    assert same(policy, other)


def test_if_one_module_does_not_fit_none_is_changed(tmp_path):
    policy, value = networks()
    path = save_checkpoint(tmp_path / "policy.pt", actor=policy, critic=value)
    other, _ = networks()
    before = [tensor.clone() for tensor in other.state_dict().values()]
    with pytest.raises(ValueError, match=r"critic.module.mlp.0.weight has shape \[8, 4\], the module \[8, 5\]"):
        load_checkpoint(path, actor=other, critic=critic(5, hidden=(8,)))
    assert all(a.equal(b) for a, b in zip(other.state_dict().values(), before, strict=True))


def test_layers_that_one_side_lacks_are_named(tmp_path):
    path = save_checkpoint(tmp_path / "net.pt", net=nn.Linear(2, 1, bias=False))
    with pytest.raises(ValueError, match=r"net\.bias is in the module alone"):
        load_checkpoint(path, net=nn.Linear(2, 1))
    path = save_checkpoint(tmp_path / "net.pt", net=nn.Linear(2, 1))
    with pytest.raises(ValueError, match=r"net\.bias is in the file alone"):
        load_checkpoint(path, net=nn.Linear(2, 1, bias=False))


def test_a_name_that_the_file_lacks_is_answered_with_those_it_has(tmp_path):
    path = save_checkpoint(tmp_path / "net.pt", actor=nn.Linear(2, 1))
    with pytest.raises(ValueError, match=r"holds \['actor'\], not 'policy'"):
        load_checkpoint(path, policy=nn.Linear(2, 1))


def test_an_interrupted_write_leaves_the_old_file(tmp_path, monkeypatch):
    path = save_checkpoint(tmp_path / "net.pt", {"step": 1}, net=nn.Linear(2, 1))

    def full_disk(content, file):
        file.write_bytes(b"half of it")
        raise OSError("no space left")

    monkeypatch.setattr(torch, "save", full_disk)
    with pytest.raises(OSError, match="no space"):
        save_checkpoint(path, {"step": 2}, net=nn.Linear(2, 1))
    assert load_checkpoint(path, net=nn.Linear(2, 1)) == {"step": 1}
    assert [file.name for file in tmp_path.iterdir()] == ["net.pt"]


def test_another_file_is_refused(tmp_path):
    torch.save({"weights": torch.zeros(1)}, tmp_path / "other.pt")
    with pytest.raises(ValueError, match="Write it with save_checkpoint"):
        load_checkpoint(tmp_path / "other.pt", net=nn.Linear(2, 1))


class Spy:
    def __reduce__(self):
        return (eval, ("1 + 1",))


def test_code_in_a_file_is_not_run(tmp_path):
    torch.save({"format": Spy()}, tmp_path / "evil.pt")
    with pytest.raises(Exception, match=r"weights_only|Unsupported"):
        load_checkpoint(tmp_path / "evil.pt", net=nn.Linear(2, 1))


def test_nothing_to_save_is_refused(tmp_path):
    with pytest.raises(ValueError, match="Give each by a name"):
        save_checkpoint(tmp_path / "net.pt")
