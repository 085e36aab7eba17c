"""The tasks as Gymnasium sees them."""

import subprocess
import sys
import warnings
from types import SimpleNamespace

import gymnasium
import numpy as np
import pytest
import torch
from gymnasium.utils.env_checker import check_env
from gymnasium.vector import AutoresetMode
from torchrl.envs import TransformedEnv

from torchrl_athletic.envs.gymnasium_env import TASKS, GymnasiumEnv, GymnasiumVectorEnv
from torchrl_athletic.envs.registration import TASKS as NAMES
from torchrl_athletic.envs.registration import register_with_gymnasium
from torchrl_athletic.testing import ToyEnv
from torchrl_athletic.transforms import GaitClock, ObservationHistory


def test_every_task_is_registered_under_its_name():
    assert tuple(TASKS) == NAMES
    for name in NAMES:
        spec = gymnasium.spec(f"torchrl_athletic/{name}-v0")
        assert spec.kwargs == {"task": name}


def test_gymnasium_imports_what_stands_before_the_colon():
    lines = "import gymnasium as g; e = g.make_vec('torchrl_athletic.envs:torchrl_athletic/SledPull-v0', num_envs=8); "
    told = subprocess.run(
        [sys.executable, "-c", lines + "print(e.reset(seed=0)[0].shape)"], capture_output=True, text=True, check=True
    )
    assert told.stdout.strip() == "(8, 770)"


@pytest.mark.parametrize(
    "name",
    [name if name == "SledPull" else pytest.param(name, marks=pytest.mark.slow) for name in NAMES],
)
def test_gymnasium_s_own_checker_finds_nothing(name):
    with warnings.catch_warnings(record=True) as found:
        warnings.simplefilter("always")
        warnings.filterwarnings("ignore", message=".*(infinity|symmetric and normalized).*")  # actions have no bounds
        check_env(gymnasium.make(f"torchrl_athletic/{name}-v0").unwrapped, skip_render_check=True)
    assert [str(warning.message) for warning in found] == []


def test_many_at_once_start_anew_in_the_step_and_show_their_last_observation():
    envs = gymnasium.make_vec("torchrl_athletic/SledPull-v0", num_envs=3, max_steps=2)
    assert isinstance(envs.unwrapped, GymnasiumVectorEnv)
    assert envs.metadata["autoreset_mode"] is AutoresetMode.SAME_STEP  # by which wrappers and learners tell
    first, _ = envs.reset(seed=4)
    assert envs.observation_space.contains(first)
    action = np.zeros((3, 19), np.float32)
    _, reward, terminated, truncated, infos = envs.step(action)
    assert reward.shape == (3,)
    assert not (terminated | truncated).any()
    assert infos == {}
    shown, _, _, truncated, infos = envs.step(action)
    assert truncated.all()
    assert infos["_final_obs"].all()
    assert np.abs(shown - infos["final_obs"]).max(1).min() > 0
    history = shown.reshape(3, 10, 77)
    assert (history == history[:, :1]).all()  # an episode starts with its first frame in every place


def test_a_seed_says_what_happens():
    def played(seed):
        envs = gymnasium.make_vec("torchrl_athletic/WholeBody-v0", num_envs=2)
        envs.reset(seed=1)
        start, _ = envs.reset(seed=seed)
        return np.stack([start, *(envs.step(np.zeros((2, 19), np.float32))[0] for _ in range(3))])

    seven = played(7)
    assert (seven == played(7)).all()
    assert (seven != played(8)).any()


def test_robots_that_are_told_no_seed_draw_episodes_of_their_own():
    """As Gymnasium asks, whose sync and async vectors would else be many copies of one robot."""
    envs = gymnasium.make_vec("torchrl_athletic/WholeBody-v0", num_envs=2, vectorization_mode="sync", net=None)
    one, other = envs.reset()[0]
    assert (one != other).any()
    told = [GymnasiumVectorEnv("WholeBody", 1, net=None, seed=3) for _ in range(2)]
    np.testing.assert_array_equal(*(env.reset()[0] for env in told))


def test_it_earns_what_the_environment_earns():
    envs = GymnasiumVectorEnv("WholeBody", 2, seed=3)
    envs.reset()
    env = TASKS["WholeBody"](num_envs=2, seed=3)
    td = env.reset()
    for _ in range(3):
        td = env.step(td.set("action", torch.full((2, 19), 0.1)))["next"]
        shown, reward, *_ = envs.step(np.full((2, 19), 0.1, np.float32))
        np.testing.assert_array_equal(shown, td["observation"].numpy())
        np.testing.assert_array_equal(reward, td["reward"].flatten().numpy())


def test_one_robot_draws_the_episodes_that_a_row_of_many_draws():
    one, many = (
        gymnasium.make("torchrl_athletic/WholeBody-v0", max_steps=2),
        GymnasiumVectorEnv("WholeBody", 1, max_steps=2),
    )
    action = np.zeros(19, np.float32)
    one.reset(seed=3)
    many.reset(seed=3)
    for _ in range(2):
        one.step(action)
        last, *_, infos = many.step(action[None])
    np.testing.assert_array_equal(one.reset()[0], last[0])
    assert infos["_final_obs"].all()


def test_what_cannot_be_is_refused():
    with pytest.raises(ValueError, match="only None is known"):
        GymnasiumVectorEnv("WholeBody", 1, render_mode="rgb_array")
    envs = GymnasiumVectorEnv("WholeBody", 2)
    envs.reset()
    with pytest.raises(ValueError, match=r"shape \(19,\), needed is \(2, 19\)"):
        envs.step(np.zeros(19, np.float32))


def test_an_episode_is_as_long_as_gymnasium_is_told_and_no_options_are_passed_over():
    envs = gymnasium.make_vec("torchrl_athletic/WholeBody-v0", num_envs=2, max_episode_steps=2)
    with pytest.raises(ValueError, match=r"no options, but was told \['reset_mask'\]"):
        envs.reset(options={"reset_mask": np.array([True, False])})
    envs.reset(seed=0, options={})
    ends = [envs.step(np.zeros((2, 19), dtype=np.float32))[3].tolist() for _ in range(2)]
    assert ends == [[False, False], [True, True]]


def test_an_unknown_task_and_a_step_before_the_start_are_refused():
    with pytest.raises(ValueError, match=r"no task is called 'Jump'.*'SledPull'"):
        GymnasiumVectorEnv("Jump")
    with pytest.raises(gymnasium.error.ResetNeeded, match="Call reset first"):
        GymnasiumVectorEnv("WholeBody", 1).step(np.zeros((1, 19), np.float32))


@pytest.fixture
def toy(monkeypatch):
    """Rows whose episodes end at different times, terminated or truncated in turn."""

    def make(num_envs):
        history = ObservationHistory(["joint_position"], 3, ["seen"], flatten=True)
        env = TransformedEnv(ToyEnv(num_envs), history)
        return env.append_transform(GaitClock(0.02, random_start=True))

    monkeypatch.setitem(TASKS, "Toy", make)
    return make


def test_rows_start_anew_one_by_one_as_they_end(toy):
    """As TorchRL's own loop has it."""
    envs, env = GymnasiumVectorEnv("Toy", 4), toy(4)
    first, _ = envs.reset(seed=0)
    td = env.reset()
    np.testing.assert_array_equal(first, td["observation"])
    some = 0
    for k in range(20):
        action = torch.full((4, 3), 0.1 * k)
        step, td = env.step_and_maybe_reset(td.set("action", action))
        after, done = step["next"], step["next", "done"].flatten().numpy()
        shown, reward, terminated, truncated, infos = envs.step(action.numpy())
        np.testing.assert_array_equal(shown, td["observation"])
        np.testing.assert_array_equal(envs._shown["seen"], td["seen"])
        np.testing.assert_array_equal(reward, after["reward"].flatten())
        np.testing.assert_array_equal(terminated, after["terminated"].flatten())
        np.testing.assert_array_equal(truncated, after["truncated"].flatten())
        assert bool(infos) == done.any()
        if done.any():
            np.testing.assert_array_equal(infos["_final_obs"], done)
            np.testing.assert_array_equal(infos["final_obs"], after["observation"])
        some += done.any() and not done.all()
    assert some > 5


def test_of_a_list_of_seeds_the_first_one_counts(toy):
    envs = GymnasiumVectorEnv("Toy", 2)
    envs.reset(seed=[4, 9])
    assert (envs.env.transform[-1].seed, envs.np_random_seed) == (4, 4)


@pytest.mark.parametrize("seed", [0, [0, 9]])
def test_zero_is_a_seed_like_any_other(toy, seed):
    """Both streams open again, whatever they were before."""
    envs, fresh = GymnasiumVectorEnv("Toy", 2), GymnasiumVectorEnv("Toy", 2)
    envs.reset(seed=4)
    envs.reset()
    envs.reset(seed=seed)
    fresh.reset(seed=0)
    assert envs.env.transform[-1].seed == 0
    assert envs.np_random_seed == 0
    assert envs._shown["gait_phase"].equal(fresh._shown["gait_phase"])
    kept = envs._shown["gait_phase"]
    envs.reset()  # without one, the streams go on
    assert not envs._shown["gait_phase"].equal(kept)


@pytest.mark.parametrize("ends", [(True, False), (False, True), (False, False)])
def test_a_single_robot_tells_a_fall_from_the_end_of_its_time(ends):
    env = object.__new__(GymnasiumEnv)
    terminated, truncated = (np.array([end]) for end in ends)
    env.rows = SimpleNamespace(step=lambda action: (np.ones((1, 770)), np.ones(1), terminated, truncated, {}))
    assert env.step(np.zeros(19, np.float32))[2:4] == ends


def test_without_gymnasium_there_is_nothing_to_register(monkeypatch):
    monkeypatch.setattr("torchrl_athletic.envs.registration.find_spec", lambda name: None)
    monkeypatch.setitem(sys.modules, "gymnasium", None)  # whose import would fail
    monkeypatch.delitem(gymnasium.registry, "torchrl_athletic/SledPull-v0")
    register_with_gymnasium()
    assert "torchrl_athletic/SledPull-v0" not in gymnasium.registry
