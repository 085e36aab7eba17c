"""Fits by several seeds: rows keep their order of errors, and a joint made worse by any of them is told."""

from __future__ import annotations

import json

import pytest

from benchmarks.real_robots import run, seeds
from benchmarks.real_robots.replay import JUDGE


def row(ours: float, train: float, commit: str = "abc", given: float = 9.0) -> dict:
    errors = {
        "given": {"train": [given], "heldout": [given]},
        "ours": {"train": [train], "heldout": [ours]},
        "by hand": {"train": [1.0], "heldout": [2.0]},
    }
    return {"errors": errors, "joints": ["hip"], "cpu": 12.3, "commits": {"ours": commit}, "judge": JUDGE}


def test_a_robots_draws_are_told_in_the_order_of_their_errors_on_what_was_fitted():
    rows = {
        "leg, seed 1": {**seeds.drawn(row(3.0, 0.1)), "commit": "abc", "judge": JUDGE},
        "leg, seed 2": {**seeds.drawn(row(1.0, 0.3)), "commit": "def", "judge": JUDGE},
    }
    text = seeds.table(rows, {"leg": row(2.0, 0.2), "arm": row(1.0, 1.0)})
    assert "| leg | 1.00 | 1.50, 0.50 | 1.50, 1.00, 0.50 | none | 12 s, 12 s, 12 s | abc, def |" in text
    assert "arm" not in text


def test_a_joint_that_one_seed_made_worse_is_told():
    rows = {"leg, seed 1": {**seeds.drawn(row(9.5, 0.1)), "commit": "abc", "judge": JUDGE}}
    assert "| hip |" in seeds.table(rows, {"leg": row(2.0, 0.2)})


def test_each_seed_is_fitted_once_with_the_rivals_that_are_known(monkeypatch, tmp_path):
    asked = []
    monkeypatch.setattr(run, "run", lambda case, cfg: asked.append((case, cfg.seed, cfg.rivals)) or row(3.0, 0.1))
    known = tmp_path / "known.md"
    known.with_suffix(".json").write_text(json.dumps({"leg": row(2.0, 0.2)}), "utf-8")
    seeds.main(seeds.Config(cases=("leg",), seeds=(3, 4), results=known, output=tmp_path / "seeds.md"))
    assert asked == [("leg", 3, ()), ("leg", 4, ())]
    assert "1.50, 1.50" in (tmp_path / "seeds.md").read_text("utf-8")


def test_what_another_judge_scored_is_no_peer(tmp_path):
    rows = {"leg, seed 1": {**seeds.drawn(row(9.5, 0.1)), "commit": "abc", "judge": "5 samples"}}
    assert "leg" not in seeds.table(rows, {"leg": row(2.0, 0.2)})
    known = tmp_path / "known.md"
    known.with_suffix(".json").write_text(json.dumps({"leg": {**row(2.0, 0.2), "judge": "5 samples"}}), "utf-8")
    for case in ("leg", "arm"):
        with pytest.raises(ValueError, match=f"'{case}' is not there, or scored otherwise"):
            seeds.main(seeds.Config(cases=(case,), results=known, output=tmp_path / "seeds.md"))
