"""What a whole-body controller's training begins with: a new pair of networks, or the shipped one."""

import sys
from types import SimpleNamespace

import pytest
import torch
from torchrl.envs.utils import ExplorationType, set_exploration_type

from torchrl_athletic.envs import NO_DISTURBANCES, whole_body_env
from torchrl_athletic.functional.rewards import WBC_SCALES
from torchrl_athletic.networks import RunningNormalizer, actor, digest_of, pretrained, read_metadata, trunk_of
from torchrl_athletic.robots import b2z1
from torchrl_athletic.training import PPO, Rollout, iterate, save_wbc, wbc_learner
from torchrl_athletic.training.ppo import collect
from torchrl_athletic.training.wbc import CURVES, WATCHED, check_sizes, read_wbc

module = sys.modules["torchrl_athletic.training.wbc"]
FEW = PPO(num_envs=4, horizon=3, epochs=1, actor_minibatches=2)


def still_env(**told):
    return whole_body_env(b2z1(), num_envs=4, net=None, disturbances=NO_DISTURBANCES, **told)


def test_it_goes_on_from_the_shipped_controller_and_its_critic():
    learner = wbc_learner(whole_body_env(b2z1(), num_envs=4, net=None), FEW, start="wbc")
    assert digest_of(learner.actor) == digest_of(pretrained("wbc"))
    assert digest_of(learner.critic) == digest_of(pretrained("wbc_critic"))
    nets = learner.actor, learner.critic
    assert all(parameter.requires_grad for net in nets for parameter in net.parameters())
    iterate(learner)
    assert digest_of(learner.actor) != digest_of(pretrained("wbc"))
    assert digest_of(learner.critic) != digest_of(pretrained("wbc_critic"))
    for name, net in (("wbc", learner.actor), ("wbc_critic", learner.critic)):
        assert trunk_of(net).normalizer.count == trunk_of(pretrained(name)).normalizer.count + 2 * 4 * 3


def test_a_robot_that_shows_something_else_is_refused():
    one_frame = r"wbc makes 19 numbers of 770 of 'observation', asked is for 19 of 77\..*history.*begin anew"
    with pytest.raises(ValueError, match=one_frame):
        wbc_learner(still_env(history=1), FEW, start="wbc")
    with pytest.raises(ValueError, match=r"wbc makes 1 numbers of \d+ of 'privileged', asked is for 1 of"):
        wbc_learner(still_env(), FEW, start="wbc")  # whose links nobody changed


def test_a_new_policy_begins_at_the_default_pose():
    learner = wbc_learner(still_env(), FEW, hidden=(64, 64))
    with set_exploration_type(ExplorationType.DETERMINISTIC), torch.no_grad():
        action = learner.actor(learner.env.reset())["action"]
    assert 0 < action.abs().max() < 0.05


def test_a_new_pair_is_as_large_and_as_bold_as_told_and_watches_what_curves_are_drawn_of():
    env = still_env()
    learner = wbc_learner(env, FEW, hidden=(8, 6), scale=0.2, seed=4)
    for net in (learner.actor, learner.critic):
        sizes = [layer.out_features for layer in trunk_of(net).mlp if isinstance(layer, torch.nn.Linear)]
        assert sizes[:-1] == [8, 6]
    torch.testing.assert_close(learner.actor(env.reset())["scale"], torch.full((4, 19), 0.2))
    assert learner.stepper.generator.initial_seed() == 4
    assert learner.watch == WATCHED
    report = iterate(learner)
    assert set(CURVES) | {f"reward_terms/{name}" for name in WBC_SCALES} <= set(report.keys())


def test_what_collects_in_place_of_the_environment_stores_what_critic_and_curves_need():
    asked = []

    def collect_by(policy, keys):
        asked.append((policy, keys))
        return Rollout(still_env(), policy, FEW.horizon, keys=keys)

    learner = wbc_learner(still_env(), FEW, hidden=(8,), collect_by=collect_by)
    ((policy, keys),) = asked
    assert policy is learner.actor
    assert set(keys) == {"privileged", *(("next", name) for name in WATCHED)}
    assert learner.env is learner.rollout.env


def test_both_networks_learn_the_scale_of_what_they_see():
    """By each entry's mean over all that was collected, a batch before the first included."""
    learner = wbc_learner(still_env(), FEW, hidden=(16,))
    assert trunk_of(learner.actor).normalizer is learner.normalizers["observation"]
    assert trunk_of(learner.critic).normalizer is learner.normalizers["privileged"]
    seen = {key: [] for key in learner.normalizers}
    rollout = learner.rollout

    def noting():
        batch = rollout()
        for key, batches in seen.items():
            batches.append(batch[key].flatten(0, 1).clone())
        return batch

    learner.rollout = noting
    iterate(learner)
    assert seen.keys() == {"observation", "privileged"}
    for key, normalizer in learner.normalizers.items():
        assert isinstance(normalizer, RunningNormalizer)
        whole = torch.cat(seen[key])
        assert normalizer.count == len(whole) == 2 * 4 * 3
        torch.testing.assert_close(normalizer.mean, whole.mean(0), atol=1e-4, rtol=1e-4)
        torch.testing.assert_close(normalizer.variance, whole.var(0, correction=0), atol=1e-3, rtol=1e-3)


def test_what_was_saved_is_gone_on_with(tmp_path):
    first = wbc_learner(still_env(history=1), FEW, hidden=(16,))
    iterate(first)
    first.seconds = 2.5
    path = save_wbc(first, tmp_path, history=1)
    for file in (path, tmp_path / "wbc_critic.npz"):
        told = read_metadata(file)
        assert (told["samples"], told["seconds"], told["history"]) == (first.samples, 2.5, 1)
    second = wbc_learner(still_env(history=1), FEW, start=path)
    assert digest_of(second.actor) == digest_of(first.actor)
    assert digest_of(second.critic) == digest_of(first.critic)
    assert collect(second)["action"].isfinite().all()
    (tmp_path / "wbc_critic.npz").unlink()
    with pytest.raises(
        FileNotFoundError,
        match=r"wbc_critic\.npz is missing: a policy goes on with its critic.*Of the shipped ones .*wbc, wbc_wide",
    ):
        wbc_learner(still_env(history=1), FEW, start=path)


@pytest.mark.parametrize(("seen", "made"), [(5, 3), (5, 2), (4, 3)])
def test_networks_must_take_in_and_give_as_many_numbers_as_asked(seen, made):
    wanted = {"observation": (actor(5, 3, hidden=(7,)), seen, made)}
    if (seen, made) == (5, 3):
        return check_sizes("it", wanted)
    with pytest.raises(ValueError, match=f"it makes 3 numbers of 5 of 'observation', asked is for {made} of {seen}"):
        check_sizes("it", wanted)


def test_a_policy_that_is_not_there_is_missed_before_anything_is_read(tmp_path):
    with pytest.raises(FileNotFoundError, match=r"mine\.npz is missing.*mine\.npz and mine_critic\.npz"):
        read_wbc(tmp_path / "mine.npz")
    assert not any(parameter.requires_grad for net in read_wbc("wbc") for parameter in net.parameters())


@pytest.mark.parametrize("collects", [False, True])
def test_both_networks_go_to_the_device_and_all_else_that_is_told_to_the_learner(monkeypatch, collects):
    told = {}
    monkeypatch.setattr(module, "Learner", lambda *parts, **rest: told.update(rest, parts=parts))
    shown = {"observation": torch.zeros(4, 7), "privileged": torch.zeros(4, 9)}
    env = SimpleNamespace(observation_spec=shown, action_spec=torch.zeros(4, 3), device="meta")
    rollout = SimpleNamespace(env="another")
    collect_by = (lambda policy, keys: rollout) if collects else None
    wbc_learner(env, FEW, hidden=(5,), cuda_graph=True, processes="two", collect_by=collect_by)
    assert (told["cuda_graph"], told["processes"], told["rollout"]) == (True, "two", rollout if collects else None)
    steps, *networks, config = told["parts"]
    assert (steps, config) == ("another" if collects else env, FEW)
    for network in networks:
        assert {tensor.device.type for tensor in (*network.parameters(), *network.buffers())} == {"meta"}


def test_a_name_is_that_of_a_shipped_policy_and_a_file_is_read_as_it_is(monkeypatch, tmp_path):
    read = []
    monkeypatch.setattr(module, "shipped_path", lambda name: tmp_path / f"{name}.npz")
    monkeypatch.setattr(module, "read_network", lambda path, trainable: read.append((path.name, trainable)))
    for name in ("mine", "mine_critic", "a", "a_critic"):
        (tmp_path / f"{name}.npz").touch()
    read_wbc("mine", trainable=True)
    read_wbc(tmp_path / "a.npz")
    both = [("mine.npz", True), ("mine_critic.npz", True), ("a.npz", False), ("a_critic.npz", False)]
    assert read == both
