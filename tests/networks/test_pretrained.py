"""Networks that are shipped do what they did when they were written, or are refused."""

from pathlib import Path

import numpy as np
import pytest
import torch
from tensordict import TensorDict

from torchrl_athletic.networks import (
    RunningNormalizer,
    actor,
    critic,
    describe,
    digest_of,
    pretrained,
    read_network,
    shipped_path,
    uan,
    write_network,
)
from torchrl_athletic.training import table_of


def policy():
    torch.manual_seed(0)
    normalizer = RunningNormalizer(6)
    normalizer.update(3 + 2 * torch.randn(100, 6))
    return actor(6, 2, hidden=(8, 8), normalizer=normalizer, scale=0.3)


def test_what_was_written_acts_the_same_when_it_is_read(tmp_path):
    seen = TensorDict(observation=torch.randn(5, 6), batch_size=[5])
    one = policy()
    read = read_network(tmp_path / "a.npz", write_network(tmp_path / "a.npz", one, seed=3))
    for key in ("loc", "scale"):
        torch.testing.assert_close(read(seen.clone())[key], one(seen.clone())[key].detach(), rtol=0, atol=0)
    assert not any(parameter.requires_grad for parameter in read.parameters())


def test_a_value_function_and_an_actuator_net_too(tmp_path):
    torch.manual_seed(1)
    value = critic(4, in_keys=["privileged"], hidden=(8,))
    write_network(tmp_path / "v.npz", value)
    seen = TensorDict(privileged=torch.randn(5, 4), batch_size=[5])
    torch.testing.assert_close(
        read_network(tmp_path / "v.npz")(seen)["state_value"], value(seen)["state_value"].detach()
    )
    net = uan(torque_unit=[1.0, 2.0], memory=(0.01,))
    for parameter in net.parameters():
        torch.nn.init.normal_(parameter, std=0.1)
    write_network(tmp_path / "n.npz", net)
    errors = torch.randn(3, 2, 41)
    torch.testing.assert_close(read_network(tmp_path / "n.npz")(errors), net(errors).detach())


def test_a_file_that_was_changed_is_refused(tmp_path):
    path = tmp_path / "a.npz"
    digest = write_network(path, policy())
    content = bytearray(path.read_bytes())
    content[len(content) // 2] ^= 1
    path.write_bytes(content)
    with pytest.raises(ValueError, match=r"a\.npz has SHA-256 .*expected is .*Install the library again"):
        read_network(path, digest)


def test_a_file_that_would_run_code_or_is_something_else_is_refused(tmp_path):
    np.savez(tmp_path / "p.npz", metadata=np.array([{"format": "x"}], dtype=object))
    with pytest.raises(ValueError, match="allow_pickle=False"):
        read_network(tmp_path / "p.npz")
    np.savez(tmp_path / "q.npz", weights=np.zeros(3))
    with pytest.raises(ValueError, match="is not a network of format"):
        read_network(tmp_path / "q.npz")


def test_all_that_is_shipped_is_small_sound_and_known_by_name():
    names = ("sled", "sled_critic", "snatch", "throw", "throw_critic", "uan", "wbc", "wbc_critic", "wbc_wide")
    names += ("wbc_wide_critic",)
    assert sum(shipped_path(name).stat().st_size for name in names) < 20e6
    for name in names:
        net = pretrained(name)
        assert all(torch.isfinite(parameter).all() for parameter in net.parameters())
        assert describe(name)["trained_with"].startswith("python recipes/")
    with pytest.raises(ValueError, match=r"no network 'walk'.*\['sled', 'sled_critic', 'snatch', 'throw'"):
        pretrained("walk")


def test_the_controller_says_which_actuator_net_it_was_trained_with_and_how_good_it_is():
    told = describe("wbc")
    assert told["uan_sha256"] == __import__("hashlib").sha256(shipped_path("uan").read_bytes()).hexdigest()
    results = told["evaluation"]
    for name in ("all randomised", "all randomised, 1 ms steps", "all randomised, elliptic cones"):
        worst = {of: results[name][of][0] for of in ("falls", "keypoints", "attitude", "velocity", "yaw_rate")}
        asked = {"falls": 0.02, "keypoints": 0.06, "attitude": 0.15, "velocity": 0.15, "yaw_rate": 0.15}
        assert all(worst[of] < asked[of] for of in asked), (name, worst)
    table = (Path(__file__).parents[2] / "benchmarks/results/wbc_evaluation.md").read_text(encoding="utf-8")
    assert set(table_of(results).splitlines()) <= set(table.splitlines())  # the page shows what the file says of itself


@pytest.mark.parametrize("name", ["throw", "snatch", "sled"])
def test_a_tuned_policy_tells_its_start_and_the_figures_of_its_examination(name):
    told = describe(name)
    assert told["start"] in ("wbc", "wbc_wide")
    assert told["evaluation"]["episodes"] == 100
    assert 0 <= told["evaluation"]["failed"] < 1


def test_half_of_the_bits_make_half_the_file_and_nearly_the_same_policy(tmp_path):
    torch.manual_seed(0)
    normalizer = RunningNormalizer(40)
    normalizer.update(torch.randn(50, 40))
    net = actor(40, 3, hidden=(64, 64), normalizer=normalizer)
    write_network(tmp_path / "whole.npz", net)
    write_network(tmp_path / "half.npz", net, half=True)
    whole, half = (read_network(tmp_path / f"{name}.npz") for name in ("whole", "half"))
    seen = TensorDict(observation=torch.randn(100, 40), batch_size=[100])
    one, other = (read(seen.clone())["loc"] for read in (whole, half))
    assert next(half.parameters()).dtype == torch.float32
    assert 0 < (one - other).abs().max() < 1e-2 * one.abs().max()
    sizes = [(tmp_path / f"{name}.npz").stat().st_size for name in ("whole", "half")]
    assert sizes[1] < 0.65 * sizes[0]
    for name, value in whole.state_dict().items():
        if isinstance(value, torch.Tensor) and value.any():  # what is no matrix takes little room
            assert half.state_dict()[name].equal(value) is (value.ndim < 2), name


def test_a_weight_that_16_bits_cannot_hold_is_refused_and_no_file_is_written(tmp_path):
    net = actor(4, 2, hidden=(8,))
    with torch.no_grad():
        next(parameter for parameter in net.parameters() if parameter.ndim == 2)[0, 0] = 7e4
    with pytest.raises(ValueError, match=r"a\.npz: .*a weight of 70000.*65504.*half=False"):
        write_network(tmp_path / "a.npz", net, half=True)
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize("name", ["weight", "scale of what it saw", "entry"])
def test_one_number_more_or_less_is_another_network(name):
    one, other = policy(), policy()
    assert digest_of(one) == digest_of(other)
    values = dict(other.state_dict())
    if name == "weight":
        next(other.parameters()).data.view(-1)[0] += 1e-6
    elif name == "scale of what it saw":
        next(value for key, value in values.items() if key.endswith("variance"))[3] += 1e-5
    else:
        other.extra = torch.nn.Parameter(torch.zeros(1))
    assert digest_of(one) != digest_of(other)


def test_a_network_that_shall_go_on_learning_takes_gradients(tmp_path):
    write_network(tmp_path / "a.npz", policy())
    still, learns = read_network(tmp_path / "a.npz"), read_network(tmp_path / "a.npz", trainable=True)
    assert (still.training, learns.training) == (False, True)
    assert all(parameter.requires_grad for parameter in learns.parameters())
    seen = TensorDict(observation=torch.randn(5, 6), batch_size=[5])
    learns(seen)["loc"].sum().backward()
    assert any(parameter.grad.abs().max() > 0 for parameter in learns.parameters() if parameter.grad is not None)
    assert all(parameter.requires_grad for parameter in pretrained("uan", trainable=True).parameters())
    assert digest_of(learns) == digest_of(still)


@pytest.mark.parametrize("told", [torch.zeros(2), float("nan"), {1, 2}])
def test_what_json_cannot_hold_is_refused_before_a_file_is_written(tmp_path, told):
    with pytest.raises(ValueError, match=r"a\.npz cannot hold what was told.*Give what JSON has"):
        write_network(tmp_path / "a.npz", policy(), told=told)
    assert not list(tmp_path.iterdir())
