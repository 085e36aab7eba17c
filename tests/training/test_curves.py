import numpy as np
import pytest
from matplotlib.axes import Axes
from matplotlib.figure import Figure

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


def test_each_line_is_its_runs_column_over_what_is_asked_for_under_its_title(tmp_path, monkeypatch):
    """Cells that are empty, of iterations without an evaluation, are passed over."""
    rows = {"one": [(1.0, 5.0), (2.0, 3.0), (3.0, 8.0)], "two": [(4.0, 1.0), (5.0, 0.0), (6.0, 2.0)]}
    for name, values in rows.items():
        table = CSVTable(tmp_path / f"{name}.csv")
        for k, (reward, error) in enumerate(values):
            told = {"samples": 10.0 * k, "seconds": 7.0 + k, "reward": reward}
            table.log_metrics(told if k == 1 else told | {"error": error}, step=k)
    drawn = {}
    monkeypatch.setattr(Axes, "plot", lambda axis, x, y, label, **_: drawn.setdefault(axis, []).append((label, x, y)))
    shown = {"error": "how far", "reward": "how well"}
    draw_curves({name: tmp_path / f"{name}.csv" for name in rows}, shown, tmp_path / "c.png", against="seconds")
    for axis, column in zip(drawn, (1, 0), strict=True):
        assert axis.get_title() == ("how well", "how far")[column]
        assert [label for label, _, _ in drawn[axis]] == ["one", "two"]
        for label, x, y in drawn[axis]:
            kept = [0, 2] if column else [0, 1, 2]
            np.testing.assert_allclose(x, [7.0 + k for k in kept])
            np.testing.assert_allclose(y, [rows[label][k][column] for k in kept])


@pytest.mark.parametrize("count", [1, 2])
def test_panels_stand_three_in_a_row_and_the_first_says_which_line_is_which_run(tmp_path, monkeypatch, count):
    columns = {name: f"title of {name}" for name in ("a", "b", "c", "d")}
    for name in ("one", "two"):
        table = CSVTable(tmp_path / f"{name}.csv")
        for k in range(3):
            table.log_metrics({"samples": 1.0 * k, **dict.fromkeys(columns, 2.0 * k)}, step=k)
    drawn = []
    monkeypatch.setattr(Figure, "savefig", lambda figure, path, dpi: drawn.append(figure))
    runs = {name: tmp_path / f"{name}.csv" for name in ("one", "two")[:count]}
    draw_curves(runs, columns, tmp_path / "c.png")
    (figure,) = drawn
    places = [axis.get_subplotspec() for axis in figure.axes]
    assert [(p.rowspan.start, p.colspan.start) for p in places] == [(0, 0), (0, 1), (0, 2), (1, 0)]
    assert tuple(figure.get_size_inches()) == pytest.approx((12.0, 5.2))
    assert {axis.get_xlabel() for axis in figure.axes} == {"samples"}
    legends = [axis.get_legend() for axis in figure.axes]
    assert legends[1:] == [None] * 3
    told = [] if legends[0] is None else [text.get_text() for text in legends[0].get_texts()]
    assert told == ([] if count == 1 else ["one", "two"])
    draw_curves(runs, {"a": "alone"}, tmp_path / "d.png")
    assert tuple(drawn[1].get_size_inches()) == pytest.approx((4.0, 2.6))


def test_a_column_that_one_run_lacks_is_drawn_of_the_others(tmp_path, monkeypatch):
    for name, column in (("one", "error"), ("two", "reward")):
        table = CSVTable(tmp_path / f"{name}.csv")
        for k in range(2):
            table.log_metrics({"samples": 1.0 * k, column: 2.0}, step=k)
    drawn = {}
    monkeypatch.setattr(Axes, "plot", lambda axis, x, y, label, **_: drawn.setdefault(axis.get_position().x0, label))
    draw_curves({n: tmp_path / f"{n}.csv" for n in ("one", "two")}, {"reward": "a", "error": "b"}, tmp_path / "c.png")
    assert [drawn[place] for place in sorted(drawn)] == ["two", "one"]


def test_smoothing_takes_the_share_that_it_says_half_before_and_half_after():
    """A fifth of a hundred values: ten before, the value, ten after, and at the ends what there is."""
    spike = np.zeros(100)
    spike[50] = 21.0
    found = smoothed(spike, 0.2)
    np.testing.assert_array_equal(np.flatnonzero(found), np.arange(40, 61))
    np.testing.assert_allclose(found[40:61], 1.0)
    assert smoothed(np.arange(100.0), 0.2)[0] == pytest.approx(5.0)
    assert smoothed(np.arange(100.0), 0.2)[-1] == pytest.approx(94.0)


def test_a_line_is_the_mean_over_a_fiftieth_of_the_run_and_its_axis_says_over_what(tmp_path, monkeypatch):
    """A fiftieth of 150 rows is three: one row that stands out is drawn a third as high and three wide."""
    table = CSVTable(tmp_path / "one.csv")
    table.rows = [{"step": str(k), "seconds": str(k), "error": str(3.0 * (k == 75))} for k in range(150)]
    table.columns = ["step", "seconds", "error"]
    table._write()
    lines, labels = [], []
    monkeypatch.setattr(Axes, "plot", lambda axis, x, y, **_: lines.append(y))
    monkeypatch.setattr(Axes, "set_xlabel", lambda axis, label, **_: labels.append(label))
    path = draw_curves({"one": table.path}, {"error": "how far"}, tmp_path / "a" / "b" / "c.png", against="seconds")
    assert path.exists()
    assert labels == ["seconds"]
    np.testing.assert_allclose(lines[0], np.isin(np.arange(150), (74, 75, 76)))


@pytest.mark.parametrize("shaded", [0.0, 12.0])
def test_every_panel_is_grey_as_far_as_is_told_and_not_at_all_by_itself(tmp_path, monkeypatch, shaded):
    table, grey = CSVTable(tmp_path / "one.csv"), []
    for k in range(3):
        table.log_metrics({"samples": 10.0 * k, "a": 1.0, "b": 2.0}, step=k)
    monkeypatch.setattr(Axes, "axvspan", lambda axis, low, high, **_: grey.append((low, high)))
    draw_curves({"one": tmp_path / "one.csv"}, {"a": "a", "b": "b"}, tmp_path / "c.png", shaded=shaded)
    assert grey == ([(0, shaded)] * 2 if shaded else [])
