import io

import pytest

from torchrl_athletic.diagnosis.progress import STAGES, Progress


def test_the_bar_names_the_stage_and_the_time_left():
    out = io.StringIO()
    with Progress(force=True, file=out) as progress:
        for name in STAGES:
            progress.stage(name)
            progress.update(0.5)
    for name in STAGES:
        assert name in out.getvalue()
    assert "left" in out.getvalue()


def test_it_is_silent_where_nobody_looks():
    out = io.StringIO()
    with Progress(file=out) as progress:
        progress.stage("simulate")
        progress.update(1.0)
    assert out.getvalue() == ""
    assert progress.fraction == pytest.approx(91 / 100)


@pytest.mark.parametrize("seen", [True, False])
def test_what_is_said_stands_above_the_bar_and_nowhere_without_one(seen):
    out = io.StringIO()
    with Progress(force=seen, file=out) as progress:
        progress.stage("prepare")
        progress.say("Warning: no torque.")
    assert ("Warning: no torque.\n" in out.getvalue()) == seen


def test_the_share_follows_the_weights_and_never_goes_back():
    with Progress({"a": 1, "b": 3}) as progress:
        seen = [progress.fraction]
        progress.stage("a")
        for fraction in (0.5, 0.2, 1.7):
            progress.update(fraction)
            seen.append(progress.fraction)
        progress.stage("b")
        progress.update(-1.0)
        seen.append(progress.fraction)
        progress.update(1.0)
        seen.append(progress.fraction)
    assert seen == [0.0, 0.125, 0.125, 0.25, 0.25, 1.0]


def test_skipped_stages_do_not_make_the_rest_look_fast(monkeypatch):
    out = io.StringIO()
    clock = iter([0.0] + [10.0] * 100)
    with Progress({"skipped": 90, "fit": 10}, force=True, file=out) as progress:
        progress._bar._time = lambda: next(clock)
        progress._bar.start_t = 0.0
        progress.stage("fit")
        progress.update(0.5)  # 5 units in 10 s: 5 units more take 10 s, not 0.5 s
    assert "00:10 elapsed, 00:10 left" in out.getvalue()


def test_an_unknown_stage_is_refused_with_the_known_ones():
    with Progress({"screen": 1, "fit": 1}) as progress:
        with pytest.raises(ValueError, match="no stage 'fti'; the stages are screen, fit"):
            progress.stage("fti")
        with pytest.raises(ValueError, match="call stage"):
            progress.update(0.1)
