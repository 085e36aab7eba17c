"""The recipes that tune the controller to a task run as they say."""

import dataclasses
import importlib
import json
import math
import os
import subprocess
import sys
from pathlib import Path

import pytest
import torch
import tyro
from tensordict import TensorDict

from torchrl_athletic import training
from torchrl_athletic.envs import NO_DISTURBANCES, draw_ball, draw_sled
from torchrl_athletic.networks import pretrained
from torchrl_athletic.robots import with_options
from torchrl_athletic.training import FINE_TUNE, CSVTable

ROOT = Path(__file__).parents[2]
sys.path.insert(0, str(ROOT / "recipes"))
throw, snatch, sled = (importlib.import_module(f"finetune_{name}") for name in ("throw", "snatch", "sled"))


def told(output):
    """Flags of a run that is over soon."""
    flags = ["--iterations", "2", "--num-envs", "4", "--ppo.horizon", "3", "--episodes", "2", "--no-video"]
    return [*flags, "--output", str(output)]


def assert_left(output, name):
    assert [row["step"] for row in CSVTable(output / "progress.csv").rows] == ["1", "2"]
    figures = json.loads((output / "figures.json").read_text())
    assert all(math.isfinite(value) for value in figures.values())
    assert {"curves.png", f"{name}.npz", f"{name}_critic.npz"} <= {path.name for path in output.iterdir()}


def test_it_learns_and_says_how_good_it_is(tmp_path, monkeypatch, capsys):
    monkeypatch.setattr(sled, "STEPS", 3)  # of an episode that is judged
    sled.main(tyro.cli(sled.Config, args=told(tmp_path)))
    assert_left(tmp_path, "sled")
    assert "the policy will stay as it is" in capsys.readouterr().out  # two iterations, of the critic alone
    assert set(sled.CURVES) <= CSVTable(tmp_path / "progress.csv").rows[0].keys()


def test_a_sled_learns_from_each_batch_once_and_in_small_steps_on_cpus_unless_told(monkeypatch):
    seen = []
    monkeypatch.setattr(sled.training, "fine_tune", lambda cfg, *args, **told: seen.append((cfg.epochs, cfg.ppo)))
    usual = sled.Config().ppo
    thrice = {"ppo": dataclasses.replace(sled.Config().ppo, epochs=3)}
    for told in ({}, {"epochs": 5}, {"epochs": 0}, thrice, {"device": "cuda"}, {"device": "cuda", "epochs": 4}):
        sled.main(sled.Config(**told))
    epochs, (small, *others) = zip(*seen, strict=True)
    assert epochs == (1, 5, 0, None, None, 4)  # None takes those of ``ppo``, 0 is refused
    assert small.kl_target < usual.kl_target
    assert small.critic_first > usual.critic_first
    assert small.least_actor_lr < small.actor_lr  # or nothing could make the steps smaller
    assert others == [usual, usual, thrice["ppo"], usual, usual]


@pytest.mark.slow
@pytest.mark.parametrize("name", ["throw", "snatch", "sled"])
def test_from_the_command_line_it_does_so_too(name, tmp_path):
    command = [sys.executable, f"recipes/finetune_{name}.py", *told(tmp_path)]
    ended = subprocess.run(command, cwd=ROOT, env=os.environ | {"OMP_NUM_THREADS": "1"}, capture_output=True, text=True)
    assert ended.returncode == 0, ended.stderr[-2000:]
    assert_left(tmp_path, name)


@pytest.mark.slow
def test_ways_to_a_throw_are_set_side_by_side(tmp_path, capsys):
    ablation = importlib.import_module("ablate_finetuning")
    ways = ("No-Fine-Tuning", "No-E2E")
    ablation.main(ablation.Config(iterations=1, num_envs=4, seeds=(0,), ways=ways, episodes=2, output=tmp_path))
    found = json.loads((tmp_path / "figures.json").read_text())
    assert list(found) == list(ways)
    assert not (tmp_path / "No-Fine-Tuning_0" / "progress.csv").exists()
    assert len(CSVTable(tmp_path / "No-E2E_0" / "progress.csv").rows) == 1
    assert (tmp_path / "figures.svg").stat().st_size > 5000
    assert "| No-E2E | " in capsys.readouterr().out
    with pytest.raises(SystemExit, match="no way 'Theirs'"):
        ablation.main(ablation.Config(ways=("Theirs",)))


@pytest.mark.parametrize("nothing", ["ways", "seeds"])
def test_an_ablation_of_nothing_says_so(nothing, tmp_path):
    ablation = importlib.import_module("ablate_finetuning")
    with pytest.raises(SystemExit, match=rf"--{nothing} \(\)"):
        ablation.main(ablation.Config(**{nothing: ()}, output=tmp_path))


def test_an_ablation_on_a_gpu_stops_by_its_minutes_where_they_are_said(monkeypatch, tmp_path):
    ablation = importlib.import_module("ablate_finetuning")
    tunings = []
    monkeypatch.setattr(ablation.training, "fine_tune", lambda tune, *_, **__: tunings.append(tune))
    for minutes in (None, 3.0):
        ablation.thrown("Ours", 0, ablation.Config(device="cuda", minutes=minutes, output=tmp_path))
    assert [(t.iterations, t.ppo.anneal) for t in tunings] == [
        (1950, 1950),
        (None, ablation.WAYS["Ours"]["ppo"].anneal),
    ]


def test_a_led_controller_acts_as_in_its_training_whatever_phase_it_is_told():
    ablation = importlib.import_module("ablate_finetuning")
    env = ablation.led(throw.make_env("ideal", 2))
    shown = env.reset()
    assert shown["task_phase"].abs().max() == 1.0  # it is told a phase
    silent = shown.select("observation").clone()
    silent["observation"].unflatten(-1, (10, 77))[..., -4:] = 0.0
    own = pretrained(ablation.START)(silent)["loc"]
    led = env.transform[-1].inv(shown.set("action", torch.zeros(2, 12)))["action"]
    torch.testing.assert_close(led, own, rtol=1e-3, atol=1e-4)


def episodes(**entries):
    """Rows of steps of which all count."""
    tensors = {key: torch.tensor(value).unsqueeze(-1) for key, value in entries.items()}
    rows, steps = next(iter(tensors.values())).shape[:2]
    flags = torch.ones(rows, steps, 1, dtype=torch.bool)
    return TensorDict({"counts": flags, "terminated": ~flags, **tensors}, [rows, steps])


def test_a_throw_counts_from_where_the_robot_started_and_one_that_was_kept_is_no_throw():
    flies, kept = [False, True, True], [False, False, False]
    shown = episodes(ball_away=[flies, kept, flies], peak_power=[[1.0, 2e3, 4e3]] * 3)
    shown["ball_position"] = torch.tensor([2.0, 3.0, 0.035]).expand(3, 3, 3)
    shown["ball_linear_velocity"] = torch.zeros(3, 3, 3)
    shown["ball_launch_velocity"] = torch.tensor([-3.0, 3.0, 3 * 2**0.5]).expand(3, 3, 3)  # ahead is along y
    shown["start_line"] = torch.tensor([2.0, 0.0, math.pi / 2]).expand(3, 3, 3)
    shown["joint_velocity"] = torch.zeros(3, 3, 19)
    shown["joint_velocity"][0, 1, 14], shown["joint_velocity"][1, 0, 17] = -5.0, 4.0
    shown["joint_velocity"][0, 1, 3], shown["joint_velocity"][2, 2, 14] = 20.0, 99.0  # of a leg, and after the end
    shown["terminated"][2, 1], shown["counts"][2, 2] = True, False  # it was lost: its episode ended there
    found = throw.judge(shown)
    assert found["distance_m"] == pytest.approx(1.0)
    assert found["release_speed_m_s"] == pytest.approx(6.0)
    assert (found["elevation_deg"], found["azimuth_deg"]) == (pytest.approx(45.0), pytest.approx(45.0))  # to the left
    assert (found["peak_leg_power_kw"], found["thrown"]) == (pytest.approx(10 / 3), pytest.approx(1 / 3))
    assert found["peak_arm_speed_rad_s"] == pytest.approx(3.0)  # means of each episode's peak: 5, 4 and 0


def test_the_ball_and_the_sled_are_drawn(monkeypatch):
    told = {}
    monkeypatch.setattr(training, "fine_tune", lambda cfg, make_env, name, **asked: told.update({name: asked}))
    for recipe in (throw, snatch, sled):
        recipe.main(recipe.Config())
    assert told["throw"]["annotate"] is draw_ball
    assert told["sled"]["annotate"] is draw_sled
    assert told["sled"]["view"].distance > 5  # the sled is three metres ahead


def test_every_episode_of_an_exam_has_its_deed_in_it():
    for recipe, last in ((throw, 2), (snatch, 1), (sled, 1)):
        env = recipe.make_env("ideal", 30, exam=True)
        shown = env.reset()
        assert (shown["task_phase_index"] == 0).all()
        assert (shown["task_phase_last"] == last).all()


def test_numbers_that_make_no_sense_are_refused_before_the_training(tmp_path):
    for flags in ({"episodes": 0}, {"num_envs": -1}, {"epochs": 0}):
        with pytest.raises(ValueError, match=r"--(episodes|num-envs|epochs) is (0|-1).*Give 1 or more"):
            throw.main(throw.Config(output=tmp_path, **flags))
    assert not list(tmp_path.iterdir())


def test_a_dumbbell_is_held_where_it_stays_up_without_a_break():
    steps = 600
    up = torch.full((3, steps), 1.5)
    up[1, 300] = 1.0  # a break in the middle
    up[2] = 1.0
    shown = episodes(base_height=[[0.5] * steps] * 3, added_mass=[[3.0] * steps] * 3)
    shown["base_position"] = torch.zeros(3, steps, 3) + torch.tensor([0.0, 0.0, 0.5])
    shown["end_effector_position"] = torch.stack((up, up, up), -1)
    shown["counts"][0, 260:] = False  # what comes after the end does not count
    shown["end_effector_position"][0, 260:] = 9.0
    found = snatch.judge(shown)
    assert found["held_s"] == pytest.approx(0.02 * (260 + 300 + 0) / 3)
    assert found["held_for_5_s"] == pytest.approx(2 / 3)
    assert found["highest_hand_m"] == pytest.approx((1.5 + 1.5 + 1.0) / 3)
    assert found["lowest_hand_m"] == pytest.approx((1.5 + 1.0 + 1.0) / 3)


def test_a_sled_s_way_and_the_robot_s_drift():
    shown = episodes(rope_tension=[[0.0, 100.0]])
    shown["sled_position"] = torch.tensor([[[1.0, 1.0], [1.0, -3.0]]])
    shown["base_position"] = torch.tensor([[[0.0, 0.0, 0.5], [-5.0, -0.4, 0.5]]])
    shown["base_quaternion"] = torch.tensor([1.0, 0.0, 0.0, 0.0]).expand(1, 2, 4)
    shown["start_line"] = torch.zeros(1, 2, 3)
    found = sled.judge(shown)
    assert found["sled_moved_m"] == pytest.approx(4.0)
    assert found["lateral_drift_m"] == pytest.approx(0.4)
    assert found["mean_tension_n"] == pytest.approx(50.0)


def test_the_actor_learns_nothing_from_the_first_episode_of_a_sled():
    """Its robots have not drifted yet: the curve would begin with their rewards and fall."""
    ppo = sled.Config().ppo
    assert (ppo.warm_up + ppo.critic_first) * ppo.horizon >= sled.STEPS
    assert ppo == dataclasses.replace(FINE_TUNE, critic_first=ppo.critic_first)


@pytest.mark.parametrize("task", [throw, snatch, sled], ids=["throw", "snatch", "sled"])
def test_finer_steps_of_the_physics_leave_an_action_its_20_ms(task):
    robot = with_options(task.nominal(), timestep=0.001)
    env = task.make_env("ideal", 1, robot=robot, substeps=5, disturbances=NO_DISTURBANCES)
    physics = env.base_env.physics
    steps = []
    step = physics.step
    physics.step = lambda nstep=1, **told: (steps.append(nstep), step(nstep, **told))
    env.rollout(1, break_when_any_done=False)
    assert 0.001 * sum(steps) == pytest.approx(0.02)
