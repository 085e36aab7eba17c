"""Tuning begins as the controller that it goes on from, and leaves all that it says."""

import json
import sys
from dataclasses import replace
from types import SimpleNamespace

import pytest
import torch
from tensordict import TensorDict
from torchrl.envs.utils import ExplorationType, set_exploration_type

from torchrl_athletic.envs import (
    ball_throw_env,
    dumbbell_snatch,
    dumbbell_snatch_env,
    sled_pull,
    sled_pull_env,
    whole_body_env,
)
from torchrl_athletic.envs.ball_throw import KNOWN
from torchrl_athletic.envs.whole_body import phase_inputs
from torchrl_athletic.functional.phase import sled_phases
from torchrl_athletic.networks import pretrained, read_metadata, read_network, trunk_of
from torchrl_athletic.training import (
    FINE_TUNE,
    PPO,
    CSVTable,
    FineTune,
    fine_tune,
    iterate,
    save_wbc,
    task_learner,
    train,
)
from torchrl_athletic.training.wbc import WATCHED

module = sys.modules["torchrl_athletic.training.fine_tune"]  # beside which lies a function of its name
SMALL = replace(FINE_TUNE, num_envs=4, horizon=4)


@pytest.fixture(scope="module")
def env():
    return ball_throw_env(num_envs=4)


def actions(policy, shown):
    with set_exploration_type(ExplorationType.DETERMINISTIC), torch.no_grad():
        return policy(shown.clone())["action"]


def test_the_policy_acts_at_first_as_the_controller_does_whatever_phase_it_is_told(env):
    learner, controller = task_learner(env, SMALL, known=KNOWN), pretrained("wbc")
    shown = env.reset().select("observation")
    frames = shown["observation"].unflatten(-1, (10, 77))
    assert frames[..., -4:].abs().max() == 1.0  # it is told a phase
    silent = shown.clone()
    silent["observation"].unflatten(-1, (10, 77))[..., -4:] = 0.0  # as in the pre-training
    torch.testing.assert_close(actions(learner.actor, shown), actions(controller, silent), rtol=0, atol=1e-5)
    assert (actions(controller, shown) - actions(controller, silent)).abs().max() > 0.01


def test_it_explores_as_the_pre_training_did_at_its_end_and_learns_slowly(env):
    learner = task_learner(env, SMALL, known=KNOWN)
    shown = env.reset().select("observation")
    torch.testing.assert_close(learner.actor(shown)["scale"], pretrained("wbc")(shown)["scale"])
    before = [parameter.clone() for parameter in learner.actor.parameters()]
    report = iterate(learner)
    assert report["actor_lr"] < 1e-4
    moved = max((new - old).abs().max() for new, old in zip(learner.actor.parameters(), before, strict=True))
    assert 0 < moved < 1e-3


def test_the_critic_values_what_it_did_and_takes_in_the_task(env):
    learner = task_learner(env, SMALL, known=KNOWN)
    shown = env.reset().select("privileged")
    old = shown["privileged"][:, :-10].clone()
    old[:, 73:77] = 0.0
    value = pretrained("wbc_critic")(shown.clone().set("privileged", old))["state_value"]
    torch.testing.assert_close(learner.critic(shown.clone())["state_value"], value, rtol=1e-4, atol=1e-4)


def test_what_the_task_adds_is_seen_in_its_usual_sizes_and_what_is_watched_is_that_of_the_controller(env):
    learner = task_learner(env, SMALL, known=KNOWN, seed=5)
    sizes = [size for key, size in KNOWN.items() for _ in range(env.observation_spec[key].shape[-1])]
    assert len(set(sizes)) > 1
    variance = trunk_of(learner.critic).normalizer.variance[-len(sizes) :]
    torch.testing.assert_close(variance.sqrt(), torch.tensor(sizes))
    assert learner.watch == WATCHED
    assert learner.stepper.generator.initial_seed() == 5
    assert learner.config is SMALL
    assert not learner.normalizers  # what inputs are normalised by stays as it was


def test_a_tuned_policy_goes_on_as_it_was(env, tmp_path):
    learner = task_learner(env, SMALL, known=KNOWN)
    iterate(learner)  # from here on it listens to phases
    path = save_wbc(learner, tmp_path, name="throw")
    again = task_learner(env, SMALL, start=path, known=KNOWN)
    shown = env.reset().select("observation", "privileged")
    torch.testing.assert_close(actions(again.actor, shown), actions(learner.actor, shown), rtol=0, atol=0)
    assert (again.critic(shown.clone())["state_value"] == learner.critic(shown.clone())["state_value"]).all()


def test_a_policy_tuned_to_a_task_that_adds_nothing_still_hears_of_phases_when_it_goes_on(tmp_path):
    env = whole_body_env(num_envs=4, schedule=sled_phases(), net=None)
    learner = task_learner(env, SMALL)
    columns = phase_inputs(env)
    with torch.no_grad():
        trunk_of(learner.actor).mlp[0].weight[:, columns] += 0.1  # as a training may
    again = task_learner(env, SMALL, start=save_wbc(learner, tmp_path, name="kick"))
    assert (trunk_of(again.actor).mlp[0].weight[:, columns] == trunk_of(learner.actor).mlp[0].weight[:, columns]).all()
    assert (trunk_of(again.critic).mlp[0].weight == trunk_of(learner.critic).mlp[0].weight).all()


def test_a_critic_of_another_task_is_refused_though_it_sees_as_many_numbers():
    """The sled's would take a force of 100 N on the hand for a friction of 100, which is 0.2 at most."""
    small = replace(SMALL, num_envs=1)
    with pytest.raises(ValueError, match=r"sled divides .* by \[100.*'added_mass': 5.0.*Start from the controller"):
        task_learner(dumbbell_snatch_env(num_envs=1), small, start="sled", known=dumbbell_snatch.KNOWN)
    task_learner(sled_pull_env(num_envs=1), small, start="sled", known=sled_pull.KNOWN)


def test_a_critic_may_learn_before_its_policy_does(env, monkeypatch):
    learner = task_learner(env, replace(SMALL, critic_first=2), known=KNOWN)
    update, rates, moved = learner.stepper.update, [], []
    monkeypatch.setattr(
        learner.stepper, "update", lambda batch: rates.append(float(learner.stepper.actor_lr)) or update(batch)
    )
    for _ in range(3):
        before = [[p.clone() for p in net.parameters()] for net in (learner.actor, learner.critic)]
        iterate(learner)
        after = [list(net.parameters()) for net in (learner.actor, learner.critic)]
        moved.append(
            [any((a != b).any() for a, b in zip(*pair, strict=True)) for pair in zip(before, after, strict=True)]
        )
    assert moved == [[False, True], [False, True], [True, True]]
    assert rates == pytest.approx([0.0, 0.0, SMALL.actor_lr])


def test_without_a_start_it_begins_anew(env):
    learner = task_learner(env, SMALL, start=None, known=KNOWN, watch=["bucket_axis"])
    assert actions(learner.actor, env.reset().select("observation")).abs().max() < 0.1
    assert {"reward_terms/distance", "bucket_axis"} <= set(iterate(learner).keys())


def test_a_controller_of_other_sizes_is_refused(env):
    with pytest.raises(ValueError, match="of 'privileged'"):
        task_learner(env, SMALL)  # what the task adds is not named
    with pytest.raises(ValueError, match="of 'observation'"):
        task_learner(whole_body_env(num_envs=4, history=2), SMALL)


def test_it_leaves_policy_curves_and_figures_and_goes_on(tmp_path):
    cfg = FineTune(
        iterations=2, ppo=PPO(horizon=2, entropy_coeff=0.0), num_envs=4, episodes=3, output=tmp_path, video=False
    )
    told = {"name": "throw", "known": KNOWN, "curves": {"reward": "reward"}, "look_at": ["reward"], "steps": 2}
    seen, seeds = [], {False: set(), True: set()}

    def make_env(num_envs, exam=False, *, seed, **told):
        seeds[exam].add(seed)
        return ball_throw_maker(num_envs, seed=seed, **told)

    def judge(episodes):
        seen.append(episodes)
        return {"mean": float(episodes["reward"].mean())}

    figures = fine_tune(cfg, make_env, judge=judge, **told)
    assert not seeds[True] & seeds[False]  # what judges a policy was not trained on
    assert seen[0].shape == (3, 2)
    assert figures["reward_per_step"] == pytest.approx(figures["mean"])
    assert json.loads((tmp_path / "figures.json").read_text()) == figures
    before = json.loads((tmp_path / "figures_before.json").read_text())
    assert before.keys() == figures.keys()
    assert len(seen) == 2
    assert (tmp_path / "curves.png").stat().st_size > 5000
    assert read_network(tmp_path / "throw.npz").in_keys == ["observation"]
    assert read_metadata(tmp_path / "throw.npz")["actuation"] == cfg.actuation
    assert not (tmp_path / "throw.png").exists()  # no video was asked for
    fine_tune(replace(cfg, iterations=3), ball_throw_maker, judge=judge, **told)
    assert [row["step"] for row in CSVTable(tmp_path / "progress.csv").rows] == ["1", "2", "3"]
    assert len(seen) == 3  # what came before is known
    with pytest.raises(ValueError, match="seed"):
        fine_tune(replace(cfg, iterations=4, seed=1), ball_throw_maker, judge=judge, **told)


EPISODES = TensorDict(
    reward=torch.tensor([[[0.5], [1.5], [9.0]]]), counts=torch.tensor([[[True], [True], [False]]]), batch_size=[1, 3]
)
"""One, of two steps."""


class Told(dict):
    """Stands for a function, and notes what each call was told."""

    def of(self, name, answer=None):
        return lambda *arguments, **told: self.setdefault(name, []).append((arguments, told)) or answer


@pytest.mark.parametrize(
    ("device", "minutes", "iterations", "num_envs", "expected"),
    [
        ("cpu", 3.0, 9, 12, (3.0, 9, 12, 20)),
        ("cpu", None, None, None, (9.0, None, 256, 20)),
        ("cuda", 3.0, 9, 12, (3.0, 9, 12, 100)),
        ("cuda", 3.0, None, 12, (3.0, None, 12, 100)),
        ("cuda", None, None, None, (15.0, 1950, 48, 100)),
    ],
)
def test_what_the_command_line_says_reaches_the_task_the_training_and_the_examination(
    tmp_path, monkeypatch, capsys, device, minutes, iterations, num_envs, expected
):
    spent, last, rows, every = expected
    told, policy = Told(), torch.nn.Linear(1, 1)
    learner = SimpleNamespace(actor=policy)
    (tmp_path / "progress.csv").touch()
    for name in ("train", "save_wbc", "draw_curves", "draw_episode", "write_video", "frame_strip"):
        monkeypatch.setattr(module, name, told.of(name))
    monkeypatch.setattr(module, "task_learner", told.of("learner", learner))
    monkeypatch.setattr(module, "_task_of", lambda env: {"reward": f"of {env}"})
    monkeypatch.setattr(module, "make_logger", told.of("logger", "log"))
    monkeypatch.setattr(module, "whole_rollout", told.of("rollout", EPISODES))
    monkeypatch.setattr(module, "Checkpoints", told.of("checkpoints", "states"))
    monkeypatch.setattr(torch, "manual_seed", told.of("seed"))
    ppo = PPO(num_envs=48, horizon=7, entropy_coeff=0.25, warm_up=1, critic_first=3)
    cfg = FineTune(
        device=device, minutes=minutes, iterations=iterations, seed=6, start="other", actuation="ideal",
        num_envs=num_envs, epochs=7 if iterations else None, ppo=ppo, episodes=5, logger="none", output=tmp_path,
    )  # fmt: skip
    task = {"name": "throw", "known": {"goal": 2.0}, "curves": {"kl": "how far"}, "look_at": ["hand"], "steps": 500}
    task |= {"watch": ["rope"], "annotate": "ball", "view": "far"}
    make_env = told.of("env", "world")
    fine_tune(cfg, make_env, judge=lambda episodes: {"far": float(len(told["rollout"]))}, **task)

    assert told["seed"] == [((6,), {})]
    training, *exams, film = told["env"]
    assert training == ((rows,), {"device": device, "seed": 6, "staggered": True})
    assert [(count, told["exam"]) for (count,), told in exams] == [(5, True)] * 2
    assert exams[0] == exams[1]
    assert film[0] == (1,)
    assert film[1]["exam"]
    assert len({training[1]["seed"], exams[0][1]["seed"], film[1]["seed"]}) == 3
    ((world, config), options), = told["learner"]  # fmt: skip
    ppo = replace(ppo, num_envs=rows, epochs=7 if iterations else ppo.epochs)
    assert (world, config) == ("world", ppo.annealed(last) if device == "cuda" and last else ppo)
    known = {"start": "other", "known": {"goal": 2.0}, "watch": ["rope"]}
    assert options == known | {"seed": 6, "cuda_graph": device == "cuda"}
    (((trained,), options),) = told["train"]
    assert trained is learner
    assert (options["minutes"], options["iterations"], options["checkpoint_every"]) == (spent, last, every)
    assert (options["logger"], options["checkpoints"]) == ("log", "states")
    assert options["show"] == ["reward", "kl"]
    assert told["logger"] == [(("none", tmp_path, "finetune_throw"), {})]
    (((folder,), options),) = told["checkpoints"]
    assert folder == tmp_path / "checkpoints"
    same = {"seed": "6", "start": "other", "actuation": "ideal", "task": "throw", "ppo": str(config)}
    assert options["made_of"] == same | {"reward": "of world"}
    for (world, played, look_at, steps), options in told["rollout"]:
        assert options == {"progress": "5 episodes"}
        assert (world, look_at, steps) == ("world", ["reward", "hand"], 500)
        assert played is not policy  # which may be part of what a graph has recorded
    trained_as = str(replace(cfg, ppo=config, iterations=last))
    assert told["save_wbc"][0][1] == {
        "name": "throw",
        "trained_as": trained_as,
        "history": 10,
        "actuation": cfg.actuation,
    }
    assert told["draw_episode"] == [(("world", policy, 400), {"annotate": "ball", "follow": "base", "view": "far"})]
    assert told["write_video"][0][0][1:] == (tmp_path / "throw.mp4", 50.0)
    assert told["frame_strip"][0][0][1:] == (6, tmp_path / "throw.png")
    curves = {"throw": tmp_path / "progress.csv"}, {"kl": "how far"}, tmp_path / "curves.png"
    assert told["draw_curves"] == [(curves, {"shaded": (1 + 3) * 7 * rows})]
    said = capsys.readouterr().out
    assert "far         1 -> 2\n" in said
    assert "reward_per_step         1 -> 1\n" in said  # the mean of what counts


def test_a_run_goes_on_with_its_reward_or_not_at_all(env):
    """What a folder holds of an older reward would be learnt with the values of another one."""
    task = module._task_of(env)
    assert "'distance': 10.0" in task["reward"]
    assert "'lost_ball': -20.0" in task["reward"]
    assert "'ball_launch_velocity'" in task["shown"]


def ball_throw_maker(num_envs, exam=False, **told):
    return ball_throw_env(num_envs=num_envs, **told)


def test_figures_that_are_no_numbers_are_not_written_down(tmp_path, monkeypatch):
    told = Told()
    monkeypatch.setattr(module, "whole_rollout", told.of("rollout", EPISODES))
    path = tmp_path / "deep" / "down" / "figures.json"
    judge = lambda episodes: {"far": float("nan")}  # noqa: E731
    with pytest.raises(ValueError, match="not JSON compliant"):
        module._examine(FineTune(), told.of("env"), torch.nn.Linear(1, 1), path, [], judge, 3)
    assert not path.exists()


def test_a_controller_that_goes_on_with_a_task_that_adds_nothing_is_deaf_to_phases_too(monkeypatch):
    told = Told()
    for name in ("open_inputs", "Learner"):
        monkeypatch.setattr(module, name, told.of(name))
    monkeypatch.setattr(module, "phase_inputs", lambda env, frames=None: [73 if frames is None else frames])
    known = trunk_of(pretrained("wbc_critic")).mlp[0].in_features
    shown = {"observation": torch.zeros(4, 770), "privileged": torch.zeros(4, known)}
    env = SimpleNamespace(observation_spec=shown, ndim=1, action_spec=torch.zeros(4, 19), device="cpu")
    task_learner(env, seed=6, cuda_graph=True)
    ((_, options),) = told["Learner"]
    assert options == {"watch": WATCHED, "seed": 6, "cuda_graph": True}
    assert [arguments[1:] for arguments, _ in told["open_inputs"]] == [([73],), ([1], [])]


def test_one_that_begins_anew_is_told_the_configuration_its_seed_and_where_to_record(monkeypatch):
    told = Told()
    monkeypatch.setattr(module, "wbc_learner", told.of("anew", "learner"))
    assert task_learner("env", SMALL, start=None, known=KNOWN, watch=["rope"], seed=6, cuda_graph=True) == "learner"
    assert told["anew"] == [(("env", SMALL), {"watch": ["rope"], "seed": 6, "cuda_graph": True})]


NOTHING = {"name": "throw", "known": {}, "curves": {}, "look_at": [], "judge": dict, "steps": 2}
"""What a task is told that is not to be made."""


@pytest.mark.parametrize("flag", ["episodes", "num_envs"])
def test_no_episodes_and_no_robots_are_refused_before_anything_is_made(flag, tmp_path):
    for count in (0, -1):
        with pytest.raises(ValueError, match=f"--{flag.replace('_', '-')} is {count}: .*Give 1 or more"):
            fine_tune(FineTune(output=tmp_path, **{flag: count}), None, **NOTHING)
    with pytest.raises(TypeError, match="not callable"):  # one is enough: it goes on to make the task
        fine_tune(FineTune(output=tmp_path, **{flag: 1}), None, **NOTHING)


@pytest.mark.parametrize(("flag", "most"), [("minutes", -1.0), ("iterations", -5), ("minutes", float("nan"))])
def test_a_training_that_would_never_end_is_refused_before_anything_is_made(flag, most, tmp_path):
    with pytest.raises(ValueError, match=f"{flag} is {most}, .*Give 0 or more"):
        fine_tune(FineTune(output=tmp_path, **{flag: most}), None, **NOTHING)
    with pytest.raises(ValueError, match=f"{flag} is {most}"):
        train(None, **{flag: most})
