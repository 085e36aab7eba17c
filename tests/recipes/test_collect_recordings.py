"""The recipe that records takes, on the concealed arm, for a moment each."""

import importlib.util
import sys
from dataclasses import replace
from pathlib import Path
from runpy import run_path

import numpy as np
import pytest

from torchrl_athletic.recordings import ExcitationError, TakeStopped, read_recordings
from torchrl_athletic.robots import z1

ROOT = Path(__file__).parents[2]
spec = importlib.util.spec_from_file_location("recipes_collect_recordings", ROOT / "recipes/collect_recordings.py")
recipe = importlib.util.module_from_spec(spec)
sys.modules[spec.name] = recipe  # where dataclasses look for annotations
spec.loader.exec_module(recipe)

ROBOT = z1()
make_arm = run_path(str(recipe.Config().arm))["make_arm"]


@pytest.fixture(autouse=True)
def hasty(monkeypatch):
    """Nothing here depends on the arm's coming to rest before each take."""
    monkeypatch.setattr(sys.modules[type(make_arm(0)).__module__], "SETTLE", 0.01)


@pytest.fixture(scope="module")
def takes():
    return recipe.excitations(ROBOT, recipe.Config())


def test_the_whole_set_is_the_papers(takes):
    assert len(takes) == 6 + 6 + 2 + 1
    for j in ROBOT.joint_groups["arm"]:
        both = [takes[f"{kind}_{ROBOT.joint_names[j]}"][0] for kind in ("square", "sine")]
        assert sum(len(take.time) for take in both) / 200.0 == pytest.approx(48.0)  # "about 50 s" an actuator
        for take in both:
            pairs = {(s["amplitude"], s["frequency"]) for s in take.metadata["segments"]}
            assert len(pairs) == 12
            still = np.delete(take.command, j, axis=1)
            assert (still == still[0]).all()
    train, heldout = takes["gaussian_0"], takes["gaussian_1"]
    assert (np.ptp(train[0].command[:, :6], axis=0) > 0.3).all()
    assert [len(take.time) / 200.0 for take, _ in (train, heldout)] == [300.0, 300.0]
    assert not np.array_equal(train[0].command, heldout[0].command)


def test_what_scores_is_marked_as_kept_aside(takes):
    aside = {name for name, (_, notes) in takes.items() if notes["split"] == "heldout"}
    assert aside == {"gaussian_1", "throw"}
    assert {notes["kind"] for _, notes in takes.values()} == {"square", "sine", "gaussian", "throw"}


def test_no_target_asks_for_more_than_the_joints_can(takes):
    for take, _ in takes.values():
        low, high = np.array(ROBOT.position_limit).T
        assert (take.command >= low).all()
        assert (take.command <= high).all()
    throw = takes["throw"][0]
    assert throw.time[-1] == pytest.approx(5.0, abs=0.01)
    fastest = np.abs(np.diff(throw.command, axis=0)).max() * 200.0
    assert 2.0 < fastest < 3.1415  # fast, and within the motors' speed


def test_a_run_that_was_cut_short_goes_on_with_what_is_missing(tmp_path, capsys):
    cfg = recipe.Config(output=tmp_path, seconds_per_take=0.02)
    recipe.main(cfg)
    assert "15 takes" in capsys.readouterr().out
    assert (tmp_path / "takes.png").read_bytes()[1:4] == b"PNG"
    first = {path.name: path.stat().st_mtime_ns for path in tmp_path.glob("*.npz")}
    (tmp_path / "sine_joint3.npz").unlink()
    recipe.main(cfg)
    assert "1 of them new" in capsys.readouterr().out
    again = {path.name: path.stat().st_mtime_ns for path in tmp_path.glob("*.npz")}
    assert {name for name in first if first[name] != again[name]} == {"sine_joint3.npz"}
    recording = next(r for r in read_recordings(tmp_path) if r.metadata["kind"] == "sine")
    assert recording.metadata["fixture"] == "table"
    assert recording.joint_names == ROBOT.joint_names


def test_takes_of_other_settings_are_not_mixed_in(tmp_path):
    recipe.main(recipe.Config(output=tmp_path, seconds_per_take=0.02))
    with pytest.raises(ExcitationError, match=r"4 samples; now 6.*another folder"):
        recipe.main(recipe.Config(output=tmp_path, seconds_per_take=0.03))


def test_an_arm_of_ones_own_comes_from_a_file(tmp_path):
    (tmp_path / "mine.py").write_text("def make_arm(seed):\n    raise ConnectionError(f'no arm on port {seed}')\n")
    with pytest.raises(ConnectionError, match="port 7"):
        recipe.main(recipe.Config(output=tmp_path / "takes", arm=tmp_path / "mine.py", seed=7))


def test_a_stopped_take_leaves_no_file_and_the_ones_before_stay(tmp_path):
    class Slipping(type(make_arm(0))):
        count = 0

        def step(self, target):
            reading = super().step(target)
            self.count += 1
            return reading if self.count < 6 else reading._replace(position=reading.position + 9.0)

    with pytest.raises(TakeStopped, match="position of joint"):
        recipe.main(replace(recipe.Config(), output=tmp_path, seconds_per_take=0.02), Slipping())
    assert [path.name for path in tmp_path.iterdir()] == ["square_joint1.npz"]
