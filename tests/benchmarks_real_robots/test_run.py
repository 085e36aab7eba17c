"""What of a robot is fitted anew, and what is taken from an earlier run."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import mujoco
import numpy as np
import pytest
from benchmarks_real_robots.test_replay import swing

from benchmarks.real_robots import run
from benchmarks.real_robots.replay import JUDGE, Replay
from benchmarks.real_robots.run import RIVALS, Config
from torchrl_athletic.diagnosis.corrected import Simulation
from torchrl_athletic.diagnosis.fit import Hypothesis

BENCH = "pendulum"


@pytest.mark.parametrize("kept", [{"ours": False}, {"rivals": ()}])
def test_what_is_not_fitted_has_to_be_known(tmp_path, kept):
    with pytest.raises(ValueError, match=f"none.json: it holds no '{BENCH}'"):
        run.run(BENCH, Config(output=tmp_path / "none.md", **kept))


def test_each_number_says_which_commit_made_it(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    """Ours and one rival are kept from an earlier commit; another is fitted, and all are scored by today's judge."""
    robot, take = swing(friction=0.2)
    robot = replace(robot, heldout=[take])
    monkeypatch.setitem(run.ROBOTS, BENCH, lambda data: robot)
    monkeypatch.setattr(run, "commit", lambda: "new")
    monkeypatch.setattr(run, "by_hand", lambda replay, names: replay.nominal())
    viscous = Replay(robot, [take]).nominal()
    viscous[1] += 1.0
    store = tmp_path / "results.json"
    earlier = {
        "parameters": {"PACE's list": viscous.tolist()},
        "seconds": {"ours": 7.0, "PACE's list": 8.0},
        "commits": {"ours": "old", "PACE's list": "older"},
        **{key: 0 for key in ("cpu", "memory", "fitted", "remarks")},
    }
    store.write_text(json.dumps({BENCH: earlier}), "utf-8")
    folder = run.folder_of(tmp_path, BENCH)
    folder.mkdir()
    model = mujoco.MjModel.from_xml_string(robot.xml)
    nothing = Simulation(model, ("pendulum",), Hypothesis(()), np.zeros(0))
    (folder / "corrected.json").write_text(json.dumps(nothing.to_json()), "utf-8")
    asked = Config(ours=False, rivals=(RIVALS[0],), fits=tmp_path, output=store.with_suffix(".md"))
    row = run.run(BENCH, asked)
    assert row["commits"] == {"ours": "old", RIVALS[0]: "new", "PACE's list": "older"}
    assert (row["judge"], row["seconds"]["ours"], row["seconds"]["PACE's list"]) == (JUDGE, 7.0, 8.0)
    assert row["errors"]["ours"]["heldout"] == pytest.approx(row["errors"]["given"]["heldout"], rel=0.05)
    assert row["errors"]["PACE's list"]["heldout"] > row["errors"][RIVALS[0]]["heldout"]
