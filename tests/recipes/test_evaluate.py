"""The examination of a controller: each condition is what it says, and what is done is not done again."""

import json
import math

import numpy as np
import pytest
import torch
from recipes.test_commands import load

from torchrl_athletic.functional.commands import command_ranges
from torchrl_athletic.networks import pretrained, shipped_path, write_network
from torchrl_athletic.training import examine, table_of, wbc_conditions
from torchrl_athletic.training import wbc_evaluation as module

recipe = load("recipes/evaluate.py")
CONDITIONS = wbc_conditions()


def test_all_that_was_asked_for_is_examined():
    names = " ".join(CONDITIONS)
    for word in (
        "all randomised",
        "1 ms",
        "elliptic",
        "100 iterations",
        "nominal",
        "pushes",
        "slope 5°",
        "slope 10°",
        "bumps 5 cm",
    ):
        assert word in names
    for axis in ("friction", "restitution", "stiffness", "damping", "stall torque", "masses", "centres", "encoders"):
        assert names.count(axis) == 2, axis


@pytest.mark.parametrize("name", ["masses x 0.5", "friction 4", "delay 30 ms", "encoders +0.05 rad", "slope 10°"])
def test_a_condition_differs_in_what_it_says_and_in_nothing_else(name):
    env, nominal = (CONDITIONS[which].env(2, actuation="ideal") for which in (name, "nominal"))
    td, plain = env.reset(), nominal.reset()
    physics, model = env.base_env.physics, nominal.base_env.physics.model
    fields = {field: physics.field(field)[0].numpy() for field in physics.fields}
    changed = {field for field, value in fields.items() if not np.allclose(value, getattr(model, field))}
    if name == "masses x 0.5":
        assert changed == {"body_mass", "body_inertia"}
        assert fields["body_mass"].sum() == pytest.approx(0.5 * model.body_mass.sum())
    elif name == "friction 4":
        assert changed == {"geom_friction"}
        assert fields["geom_friction"][model.geom("floor").id, 0] == 4.0
    elif name == "delay 30 ms":
        assert td["action_delay"].flatten().tolist() == [6, 6]
    elif name == "encoders +0.05 rad":
        shift = td["joint_position"] - plain["joint_position"]
        torch.testing.assert_close(shift, torch.full_like(shift, 0.05), atol=1e-6, rtol=0)
    else:
        low, high = env.base_env.ground.height(torch.tensor([[-3.0, 0.0], [3.0, 0.0]])).flatten().tolist()
        assert high - low == pytest.approx(6 * math.tan(math.radians(10)), abs=1e-3)


def test_a_finer_simulation_moves_as_often():
    fine, coarse = (
        CONDITIONS[name].env(1, actuation="ideal") for name in ("all randomised, 1 ms steps", "all randomised")
    )
    assert fine.base_env.physics.timestep == 0.001
    for env in (fine, coarse):
        env.step(env.rand_action(env.reset()))
        assert float(env.base_env.physics.time) == pytest.approx(0.02)


def test_the_recipe_writes_a_table_a_picture_and_the_episodes_it_counted(tmp_path, capsys, monkeypatch):
    drawn = []
    monkeypatch.setattr(recipe.training, "draw_episode", lambda *args, **_: drawn.append(args) or PICTURE * 20)
    monkeypatch.setattr(recipe.training, "write_video", lambda frames, path, rate: path)
    cfg = recipe.Config(conditions=("nominal", "pushes"), episodes=3, batch=2, seconds=0.4, output=tmp_path)
    recipe.main(cfg)
    told = json.loads((tmp_path / "evaluation.json").read_text())
    assert list(told["conditions"]) == ["nominal", "pushes"]
    assert told["conditions"]["nominal"]["episodes"] == 3
    assert "| nominal | 0.0 % (0.0 to" in capsys.readouterr().out
    assert (tmp_path / "evaluation.svg").stat().st_size > 1000
    assert len(drawn) == 1  # nobody fell
    assert drawn[0][0].numel() == 1


def test_what_was_examined_is_kept_and_another_policy_s_table_is_refused(tmp_path, monkeypatch):
    policy, told = pretrained("wbc"), {"episodes": 2, "steps": 5, "progress": False, "actuation": "ideal"}
    chosen = {name: CONDITIONS[name] for name in ("nominal", "pushes")}
    first = examine(policy, {"nominal": chosen["nominal"]}, tmp_path / "t.json", **told)
    played = []
    monkeypatch.setattr(module, "_play", lambda *args: played.append(args[1]) or real(*args))
    second = examine(policy, chosen, tmp_path / "t.json", **told)
    assert played == [chosen["pushes"]]
    assert second["nominal"] == first["nominal"]
    assert table_of(second).count("\n") == 3
    with pytest.raises(ValueError, match=r"with actuation 'ideal', asked for is 'uan'.*a file of its own"):
        examine(policy, chosen, tmp_path / "t.json", **told | {"actuation": "uan"})
    with torch.no_grad():
        next(policy.parameters()).mul_(2.0)
    with pytest.raises(ValueError, match=r"with policy '\w+', asked for is"):
        examine(policy, chosen, tmp_path / "t.json", **told)


real = module._play
PICTURE = [np.zeros((4, 4, 3), np.uint8)]


class Noted:
    """A condition that tells what was asked of it, and whose robots fall in the third of twenty steps, or do not."""

    def __init__(self, falls=()):
        self.asked, self.falls = [], falls

    def env(self, num_envs, **told):
        self.asked.append((num_envs, told))
        return 3 if told["first_row"] in self.falls else 20


def played(env, *args, **told):
    return PICTURE * env


@pytest.mark.parametrize(
    ("fallen", "drawn"),
    [
        ([1, 2], {"good": 0, "failed": 1}),
        ([0], {"good": 1, "failed": 0}),
        ([0, 1, 2], {"failed": 0}),
        ([], {"good": 0}),
    ],
    ids=["two fell", "the first fell", "all fell", "none fell"],
)
def test_videos_are_of_the_first_robot_that_stood_and_of_the_first_that_fell(tmp_path, monkeypatch, fallen, drawn):
    written = []
    monkeypatch.setattr(recipe.training, "draw_episode", played)
    monkeypatch.setattr(recipe.training, "write_video", lambda frames, path, rate: written.append(path) or path)
    cfg = recipe.Config(episodes=3, seconds=0.4, output=tmp_path)
    condition, told = Noted(fallen), {"seed": 5, "actuation": "ideal", "history": 10}
    recipe.draw(cfg, None, {"moon": condition}, {"moon": {"fallen": fallen}}, told)
    assert written == [tmp_path / f"{kind}.mp4" for kind in drawn]
    assert condition.asked == [(1, {"max_steps": 20, "first_row": row, **told}) for row in drawn.values()]


def test_a_failed_episode_is_looked_for_in_every_condition(tmp_path, monkeypatch):
    monkeypatch.setattr(recipe.training, "draw_episode", played)
    monkeypatch.setattr(recipe.training, "write_video", lambda frames, path, rate: path)
    moon, mars = Noted(), Noted([2])
    results = {"moon": {"fallen": []}, "mars": {"fallen": [2]}}
    cfg = recipe.Config(episodes=3, seconds=0.4, output=tmp_path)
    recipe.draw(cfg, None, {"moon": moon, "mars": mars}, results, {})
    assert [told["first_row"] for _, told in moon.asked] == [0]
    assert [told["first_row"] for _, told in mars.asked] == [2]


def test_a_robot_that_stays_up_when_it_is_played_again_is_not_shown_as_one_that_fell(tmp_path, monkeypatch, capsys):
    monkeypatch.setattr(recipe.training, "draw_episode", played)
    written = []
    monkeypatch.setattr(recipe.training, "write_video", lambda frames, path, rate: written.append(len(frames)) or path)
    cfg = recipe.Config(episodes=9, seconds=0.4, output=tmp_path)
    moon = Noted([1])
    recipe.draw(cfg, None, {"moon": moon}, {"moon": {"fallen": [0, 1, 2]}}, {})
    assert [told["first_row"] for _, told in moon.asked] == [3, 0, 1]
    assert written == [20, 3]
    never = Noted()
    (tmp_path / "failed.mp4").touch()  # of an earlier examination
    recipe.draw(cfg, None, {"moon": never}, {"moon": {"fallen": list(range(9))}}, {})
    assert len(never.asked) == recipe.TRIES
    assert not (tmp_path / "failed.mp4").exists()
    assert "failed: no video" in capsys.readouterr().out
    always = Noted(range(9))
    recipe.draw(cfg, None, {"moon": always}, {"moon": {"fallen": [0, 1, 2]}}, {})
    assert [told["first_row"] for _, told in always.asked] == [*range(3, 3 + recipe.TRIES), 0]


@pytest.mark.parametrize(
    ("told", "expected"), [({}, "box"), ({"policy": "wbc_wide"}, "around"), ({"commands": "ahead"}, "ahead")]
)
def test_a_policy_is_examined_on_the_goals_that_it_was_trained_on(tmp_path, monkeypatch, told, expected):
    asked = {}
    monkeypatch.setattr(recipe.training, "examine", lambda *args, **told: asked.update(told) or {"nominal": {}})
    monkeypatch.setattr(recipe.training, "table_of", lambda results: "")
    monkeypatch.setattr(recipe.training, "draw_conditions", lambda results, path: path)
    recipe.main(recipe.Config(conditions=("nominal",), video=False, output=tmp_path, **told))
    assert asked["commands"] == command_ranges(expected)


@pytest.mark.parametrize(
    ("of_the_file", "told", "expected"), [({}, None, "uan"), ({"actuation": "ideal"}, None, "ideal"),
     ({"actuation": "ideal"}, "uan", "uan")],
)  # fmt: skip
def test_a_policy_is_examined_on_the_arm_that_it_was_trained_with(tmp_path, monkeypatch, of_the_file, told, expected):
    asked = {}
    monkeypatch.setattr(recipe.training, "examine", lambda *args, **told: asked.update(told) or {"nominal": {}})
    monkeypatch.setattr(recipe.training, "table_of", lambda results: "")
    monkeypatch.setattr(recipe.training, "draw_conditions", lambda results, path: path)
    write_network(tmp_path / "mine.npz", pretrained("wbc"), commands="box", **of_the_file)
    own = recipe.Config(str(tmp_path / "mine.npz"), ("nominal",), actuation=told, video=False, output=tmp_path)
    recipe.main(own)
    assert asked["actuation"] == expected


@pytest.mark.parametrize(
    ("changes", "said"),
    [
        ({"policy": "wbc_critic"}, "wbc_critic is no controller"),
        ({"policy": "uan"}, "uan is no controller"),
        ({"policy": "/nowhere/mine.npz"}, "no file /nowhere/mine.npz"),
        ({"batch": 0}, "batch is 0"),
        ({"episodes": -1}, "episodes is -1"),
        ({"seconds": 0.0}, "seconds is 0.0"),
    ],
)
def test_what_cannot_be_examined_is_refused_in_a_sentence(tmp_path, changes, said):
    with pytest.raises(SystemExit, match=said):
        recipe.main(recipe.Config(**{"output": tmp_path, "conditions": ("nominal",), **changes}))


def test_an_unknown_condition_is_named(tmp_path):
    with pytest.raises(SystemExit, match="no condition 'moon'"):
        recipe.main(recipe.Config(conditions=("moon",), output=tmp_path))


def test_the_shipped_controller_is_the_default():
    assert recipe.Config().policy == "wbc"
    assert shipped_path("wbc").name == "wbc.npz"
