import numpy as np
import pytest

from torchrl_athletic.training import CSVTable, draw_curves
from torchrl_athletic.training.curves import smoothed


def test_a_picture_has_a_panel_for_each_column_that_a_run_has(tmp_path):
    for name in ("one", "two"):
        table = CSVTable(tmp_path / name / "progress.csv")
        for k in range(30):
            table.log_metrics({"samples": 10.0 * k, "reward": k / (2 if name == "one" else 3)}, step=k)
    runs = {name: tmp_path / name / "progress.csv" for name in ("one", "two")}
    picture = draw_curves(runs, {"reward": "reward per step", "falls": "falls"}, tmp_path / "c" / "curves.svg")
    drawn = picture.read_text()
    assert "reward per step" in drawn
    assert "falls" not in drawn
    with pytest.raises(ValueError, match=r"none of \['falls'\] is a column"):
        draw_curves(runs, {"falls": "falls"}, tmp_path / "d.svg")


def test_smoothing_keeps_a_line_and_takes_noise():
    line = np.linspace(0, 1, 200)
    noise = np.random.default_rng(0).normal(size=200)
    inner = slice(20, -20)
    np.testing.assert_allclose(smoothed(line, 0.1)[inner], line[inner])
    assert smoothed(noise, 0.1).std() < 0.4
