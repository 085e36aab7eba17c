"""Robots are examined in parts, and are the same robots as in one batch."""

import json
import math
import re
from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from torchrl_athletic.envs import NO_DISTURBANCES, Disturbances
from torchrl_athletic.functional.commands import CommandRanges
from torchrl_athletic.networks import pretrained
from torchrl_athletic.physics import CapacityError
from torchrl_athletic.robots import Terrain, b2z1
from torchrl_athletic.training import Episodes, examine
from torchrl_athletic.training import wbc_evaluation as module
from torchrl_athletic.training.wbc_evaluation import ERRORS, Condition
from torchrl_athletic.transforms import RandomizationRanges, StartRanges

STEPS = 6


@pytest.fixture
def examined(tmp_path, monkeypatch):
    """What became of each of four robots, examined in batches of some size."""
    starts = Disturbances(None, (), StartRanges(), (0.0, 0.0), (0, 0))
    policy, condition = pretrained("wbc"), Condition(b2z1(cone="pyramidal"), starts)
    told_of = module._told_of

    def run(**told):
        seen = []
        monkeypatch.setattr(module, "_told_of", lambda episodes: seen.append(episodes) or told_of(episodes))
        table = tmp_path / f"{len(list(tmp_path.iterdir()))}.json"
        told = {"episodes": 4, "steps": STEPS, "actuation": "ideal", "progress": False} | told
        examine(policy, {"all": condition}, table, **told)
        return seen[0]

    return run


def test_rows_of_two_parts_are_the_rows_of_one_batch_and_another_seed_s_are_not(examined):
    whole, parts, others = examined(batch=4, seed=1), examined(batch=3, seed=1), examined(batch=4, seed=2)
    assert parts.steps.tolist() == whole.steps.tolist() == [STEPS] * 4
    for name in ERRORS:
        one, two, other = (found.means[f"tracking/{name}"] for found in (whole, parts, others))
        np.testing.assert_allclose(two, one, atol=1e-5, rtol=1e-4)
        assert np.abs(other - one).max() > 1e-3, name
        assert np.diff(np.sort(one)).min() > 1e-4, name  # four robots that cannot be taken for each other


def fell(rows, first=0, seed=0):
    """Made-up episodes, unlike each other: of every third robot in the whole examination it is said that it fell."""
    numbers = first + np.arange(rows)
    means = {f"tracking/{name}": 0.1 * k + 0.01 * (numbers + seed) ** 2 for k, name in enumerate(ERRORS)}
    return Episodes(numbers % 3 == 0, 5 + numbers, means)


@pytest.fixture
def played(monkeypatch):
    """What was played, in place of playing it: condition, robots, the first one's number, and what else was told."""
    parts = []

    def play(policy, condition, rows, first, steps, seed, label, told):
        if condition == "breaks":
            raise KeyboardInterrupt
        parts.append((condition, rows, first, steps, seed, told))
        return fell(rows, first, seed)

    monkeypatch.setattr(module, "_play", play)
    return parts


def test_an_examination_goes_on_where_it_stood_and_keeps_what_every_condition_came_to(played, tmp_path):
    policy, table = pretrained("wbc"), tmp_path / "t" / "u" / "table.json"
    told = {"episodes": 7, "steps": 11, "batch": 3, "seed": 4, "actuation": "ideal", "progress": False, "history": 10}
    with pytest.raises(KeyboardInterrupt):
        examine(policy, {"one": "first", "two": "breaks"}, table, **told)
    found = examine(policy, {"one": "first", "two": "second"}, table, **told)
    assert [part[:5] for part in played] == [
        (name, rows, first, 11, 4) for name in ("first", "second") for rows, first in ((3, 0), (3, 3), (1, 6))
    ]
    assert played[0][5] == {"actuation": "ideal", "device": "cpu", "history": 10}
    whole = fell(7, seed=4)
    assert json.loads(table.read_text())["conditions"] == found == examine(policy, {}, table, **told)
    for result in found.values():
        assert (result["episodes"], result["fallen"]) == (7, [0, 3, 6])
        assert result["falls"] == pytest.approx(whole.falls())
        for name in ERRORS:
            assert result[name] == pytest.approx(whole.mean(f"tracking/{name}"))


@pytest.mark.parametrize(
    "other", [{"episodes": 3}, {"steps": 9}, {"seed": 5}, {"actuation": "uan"}, {"device": "cuda"}, {"commands": "few"}]
)
def test_a_table_of_another_examination_is_refused(other, played, tmp_path):
    policy, told = pretrained("wbc"), {"episodes": 2, "steps": 11, "seed": 4, "actuation": "ideal", "progress": False}
    examine(policy, {"one": "first"}, tmp_path / "table.json", **told, commands="many")
    (name,) = other
    with pytest.raises(ValueError, match=f"holds an examination with {name} .*file of its own"):
        examine(policy, {"one": "first"}, tmp_path / "table.json", **{**told, "commands": "many", **other})


def test_one_episode_has_no_interval(tmp_path):
    with pytest.raises(ValueError, match="one alone has no interval"):
        examine(pretrained("wbc"), {}, tmp_path / "table.json", episodes=1)


def test_table_and_picture_tell_each_conditions_own_numbers(tmp_path, monkeypatch):
    results = {
        name: {"episodes": 50, "falls": (0.04 * k, 0.02 * k, 0.11 * k)}
        | {error: (k + 0.1 * n, k + 0.1 * n - 0.03, k + 0.1 * n + 0.03) for n, error in enumerate(ERRORS)}
        for k, name in enumerate(("flat", "rough"), 1)
    }
    head, _, *rows = module.table_of(results).splitlines()
    assert head == "| condition | falls | " + " | ".join(ERRORS.values()) + " |"
    told = " | ".join(f"{2 + 0.1 * n:.3f} ± 0.030" for n in range(len(ERRORS)))
    assert rows[1] == f"| rough | 8.0 % (4.0 to 22.0) | {told} |"
    drawn = []
    plot = Axes.plot
    monkeypatch.setattr(Axes, "plot", lambda axis, *data, **look: drawn.append(data) or plot(axis, *data, **look))
    module.draw_conditions(results, tmp_path / "p" / "q" / "conditions.png")
    assert (tmp_path / "p" / "q" / "conditions.png").exists()
    (line, heights), (mean, height, _) = drawn[:2]  # falls of the last one, which is drawn lowest
    assert (line, heights, height) == (pytest.approx([4.0, 22.0]), [0, 0], 0)
    assert mean == pytest.approx(8.0)
    assert [float(d[0]) for d in drawn[1::2]] == pytest.approx([8, 4, 2.0, 1.0, 2.1, 1.1, 2.3, 1.3, 2.4, 1.4])


def number_of(name):
    return float(re.findall(r"[-+]?[0-9.]+", name)[-1])


def test_each_condition_differs_from_the_nominal_one_in_what_it_is_named_after_and_nothing_else():
    conditions = module.wbc_conditions()
    nominal, trained = conditions["nominal"], conditions["all randomised"]
    assert nominal.disturbances == NO_DISTURBANCES
    assert trained.disturbances == Disturbances()
    axes = {
        "friction": "friction", "restitution": "restitution", "leg stiffness": "stiffness_scale",
        "leg damping": "damping_scale", "leg stall": "torque_limit_scale", "masses": "mass_scale",
        "centres": "com_offset",
    }  # fmt: skip
    plain = nominal.robot.model()
    for words, field in axes.items():
        ends = {number_of(name): c for name, c in conditions.items() if name.startswith(words)}
        assert sorted(ends) == sorted(getattr(RandomizationRanges(), field))
        for end, condition in ends.items():
            ranges = vars(condition.disturbances.randomization)
            assert {name: value for name, value in ranges.items() if value is not None} == {field: (end, end)}
            assert replace(condition.disturbances, randomization=None) == NO_DISTURBANCES
            assert condition.robot is nominal.robot
    least, most = Disturbances().encoder_offset
    for end in (least, most):
        condition = conditions[f"encoders {end:+g} rad"]
        assert condition.disturbances == replace(NO_DISTURBANCES, encoder_offset=(end, end))
    assert conditions["delay 30 ms"].disturbances == replace(NO_DISTURBANCES, delay=(6, 6))
    assert conditions["pushes"].disturbances == replace(NO_DISTURBANCES, pushes=Disturbances().pushes)
    for degrees in (5, 10):
        slope = conditions[f"slope {degrees}°"]
        heights, place = field_of(slope.robot.model())
        assert np.ptp(heights) == pytest.approx(math.tan(math.radians(degrees)) * 2 * place, rel=1e-3)
    for height in (2.5, 5):
        heights, _ = field_of(conditions[f"bumps {height:g} cm"].robot.model())
        assert heights.max() == pytest.approx(height / 100, rel=0.01)
        assert heights.mean() == pytest.approx(height / 200, rel=0.02)  # alike all over the field
        assert conditions[f"bumps {height:g} cm"].disturbances == NO_DISTURBANCES
    options = {name: conditions[f"all randomised, {name}"].robot.model().opt for name in
               ("1 ms steps", "elliptic cones", "100 iterations")}  # fmt: skip
    assert options["1 ms steps"].timestep == pytest.approx(0.001)
    assert options["elliptic cones"].cone != plain.opt.cone == options["1 ms steps"].cone
    trained_on, practised = field_of(trained.robot.model())[0], b2z1(terrain=Terrain()).model()
    assert np.abs(trained_on - field_of(practised)[0]).max() > 1e-3  # nor its bumps
    for name in options:
        condition = conditions[f"all randomised, {name}"]
        assert condition.disturbances == Disturbances()
        np.testing.assert_array_equal(field_of(condition.robot.model())[0], trained_on)
    for name in ("slope 5°", "bumps 5 cm"):  # nor does one that walks straight on for 20 s fall off it
        assert field_of(conditions[name].robot.model())[1] > 20 * max(CommandRanges().forward)
    for name in ("slope 5°", "bumps 5 cm", "all randomised"):
        assert conditions[name].robot.model().opt.cone == plain.opt.cone, name
    assert (options["100 iterations"].iterations, options["100 iterations"].ls_iterations) == (100, 50)


def field_of(model):
    """Heights of a model's ground [m], and half its length along x [m]."""
    return model.hfield_data * model.hfield_size[0, 2], model.hfield_size[0, 0]


def test_an_action_is_held_as_long_however_fine_the_steps_are():
    conditions = module.wbc_conditions()
    assert len(conditions) > 20
    for name in ("all randomised", "all randomised, 1 ms steps"):
        condition = conditions[name]
        assert condition.substeps * condition.robot.model().opt.timestep == pytest.approx(0.005), name


def test_a_condition_makes_its_environment_of_all_that_it_is_and_of_what_is_told(monkeypatch):
    chance, made = replace(NO_DISTURBANCES, delay=(1, 3)), []

    def actuated(robot, actuation, **told):
        made.append((robot, actuation, told))
        return "driven robot", ["chain"]

    monkeypatch.setattr(module, "with_actuation", actuated)
    monkeypatch.setattr(module, "whole_body_env", lambda *robot, **told: made.append((*robot, told)))
    Condition("robot", chance, substeps=5).env(7, actuation="ideal", seed=3, first_row=9, history=2)
    rows = {"seed": 3, "first_row": 9}
    assert made == [
        ("robot", "ideal", {"delay": (1, 3), "substeps": 5, **rows}),
        (
            "driven robot",
            {"num_envs": 7, "history": 2, "disturbances": chance, "substeps": 5, "chain": ["chain"], **rows},
        ),
    ]


def test_episodes_whose_contacts_were_left_out_are_not_counted(monkeypatch):
    def full():
        raise CapacityError("contacts were left out")

    env = SimpleNamespace(base_env=SimpleNamespace(physics=SimpleNamespace(check=full)))
    condition = SimpleNamespace(env=lambda rows, **told: env)
    monkeypatch.setattr(module, "whole_episodes", lambda *told, **label: fell(4))
    with pytest.raises(CapacityError):
        module._play(None, condition, 4, 0, 10, 1, None, {})


def test_parts_are_joined_row_by_row():
    joined, whole = module._joined([fell(3), fell(2, first=3)]), fell(5)
    assert joined.fell.tolist() == whole.fell.tolist()
    assert joined.steps.tolist() == whole.steps.tolist()
    assert {name: mean.tolist() for name, mean in joined.means.items()} == {
        name: mean.tolist() for name, mean in whole.means.items()
    }


@pytest.mark.parametrize(("progress", "label"), [(True, "flat"), (False, None)])
def test_the_bar_of_a_condition_bears_its_name(progress, label, monkeypatch, tmp_path):
    shown = []
    env = SimpleNamespace(base_env=SimpleNamespace(physics=SimpleNamespace(check=lambda: None)))
    monkeypatch.setattr(module, "whole_episodes", lambda *told, progress: shown.append(progress) or fell(2))
    condition = SimpleNamespace(env=lambda rows, **told: env)
    examine(pretrained("wbc"), {"flat": condition}, tmp_path / "t.json", episodes=2, progress=progress)
    assert shown == [label]


def test_each_row_of_the_picture_bears_its_conditions_name_and_each_panel_its_title(monkeypatch, tmp_path):
    drawn = []
    monkeypatch.setattr(Figure, "savefig", lambda figure, *path, **told: drawn.append(figure))
    results = {name: dict.fromkeys(("falls", *ERRORS), (0.5, 0.4, 0.6)) for name in ("flat", "rough", "steep")}
    module.draw_conditions(results, tmp_path / "c.png")
    axes = drawn[0].axes
    assert [label.get_text() for label in axes[0].get_yticklabels()] == ["steep", "rough", "flat"]  # from below
    shown = [ERRORS[name] for name in ("position", "attitude", "velocity", "yaw_rate")]
    assert [axis.get_title() for axis in axes] == ["falls [%]", *shown]
    assert all(axis.get_xlim()[0] == 0 for axis in axes)


def test_a_table_of_another_policy_is_refused(played, tmp_path):
    told = {"episodes": 2, "steps": 11, "progress": False}
    examine(pretrained("wbc"), {"one": "first"}, tmp_path / "table.json", **told)
    with pytest.raises(ValueError, match="holds an examination with policy"):
        examine(pretrained("wbc_critic"), {"one": "first"}, tmp_path / "table.json", **told)
