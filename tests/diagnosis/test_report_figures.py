import re
from dataclasses import replace

import numpy as np
import pytest
from diagnosis.sample import RATE, arm, nothing_missing, slider

from torchrl_athletic.diagnosis.report.figures import (
    _broken_at_restarts,
    fit_figure,
    overlay_figure,
    regime_figure,
    summary_figure,
    svg,
    why_figure,
)
from torchrl_athletic.diagnosis.report.telling import (
    by_telling,
    joint_order,
    map_of,
    telling_overlays,
    telling_window,
    visible_energy,
)


def lines(figure) -> dict[str, np.ndarray]:
    return {line.get_gid(): line.get_ydata() for ax in figure.axes for line in ax.lines if line.get_gid()}


def test_a_regime_map_shows_what_it_is_given():
    m = slider().maps[1]
    drawn = lines(regime_figure(m))
    np.testing.assert_allclose(drawn["before-line"], m.before)
    np.testing.assert_allclose(drawn["after-line"], m.after)
    labels = [t.get_text() for t in regime_figure(m).axes[0].texts] + [regime_figure(m).axes[0].get_xlabel()]
    assert labels == ["missing force [N]", "speed [m/s]"]


def test_the_law_is_what_the_correction_takes_away():
    m = slider().maps[1]
    drawn = lines(why_figure(m))
    np.testing.assert_allclose(drawn["law-line"], m.before - m.after)
    np.testing.assert_allclose(drawn["before-line"], m.before)
    np.testing.assert_allclose(drawn["after-line"], m.after)


def test_both_parts_of_a_why_share_the_quantity_and_hold_their_bands():
    m = slider().maps[1]
    missing, left = why_figure(m).axes
    assert missing.get_xlim() == left.get_xlim()
    assert missing.get_ylim()[1] > np.abs(m.before_band).max()
    assert left.get_ylim()[1] > max(np.abs(m.after_band).max(), m.noise)


def test_a_finding_is_shown_along_the_quantity_of_its_effect():
    s = arm()
    inertia = s.answer.findings[1]
    assert map_of(inertia, s.maps).feature == "acceleration"
    assert map_of(replace(inertia, effect="my_own_effect", regime="at large load"), s.maps).feature == "load"
    assert map_of(replace(inertia, joint="wrist"), s.maps) is None


def test_the_axis_of_a_regime_map_holds_curves_bands_and_noise():
    m = arm().maps[0]
    low, high = regime_figure(m).axes[0].get_ylim()
    assert low == -high
    assert high > max(np.abs(m.before_band).max(), m.noise)


def test_the_lower_strip_of_an_overlay_is_the_error_in_its_unit():
    overlay = slider().overlays[1]
    window = slice(100, 500)
    drawn = lines(overlay_figure(overlay, "carriage", "m", window))
    error = (overlay.before - overlay.measured)[window, 0]
    seen = np.isfinite(drawn["before-error"])
    assert seen.mean() > 0.95
    np.testing.assert_allclose(drawn["before-error"][seen], 1e3 * error[seen])  # mm


def test_a_simulation_that_ran_away_does_not_flatten_the_recording():
    overlay = arm().overlays[0]
    away = replace(overlay, before=overlay.before * 1e6)
    low, high = overlay_figure(away, "elbow", "rad", slice(0, 500)).axes[0].get_ylim()
    span = np.ptp(overlay.measured[:500, 1])
    assert span < high - low < 5 * span


def test_the_tracks_of_the_fit_are_to_scale_within_a_unit():
    figure = fit_figure([("a", "rad", 0.4, 0.2, 0.1), ("b", "rad", 0.1, 0.05, 0.0), ("c", "m", 2e-3, 1e-3, 0.0)])
    marks = [float(line.get_xdata()[0]) - 8 for line in figure.axes[0].lines if line.get_marker() == "o"]
    assert np.array(marks) / marks[0] == pytest.approx([1, 0.5, 0.25, 0.125, 1, 0.5])


def test_the_pen_is_up_at_restarts_and_only_there():
    time = np.arange(1000) / RATE
    measured = np.sin(time)
    saw = measured + (time % 0.5) ** 2
    assert np.flatnonzero(np.isnan(_broken_at_restarts(saw, measured))).tolist() == list(range(125, 1000, 125))
    assert not np.isnan(_broken_at_restarts(measured + 0.1 * np.sin(3 * time), measured)).any()


def test_the_window_holds_the_burst_of_error_and_no_more_than_its_seconds():
    overlay = slider().overlays[0]
    burst = np.exp(-(((overlay.time - 17.0) / 0.3) ** 2))[:, None]
    window = telling_window(replace(overlay, before=overlay.measured + burst), seconds=3.0)
    start, stop = overlay.time[window][[0, -1]]
    assert start < 16.5 < 17.5 < stop
    assert stop - start <= 3.0
    assert telling_window(overlay, seconds=100.0) == slice(0, len(overlay.time))


def test_a_quiet_joint_has_its_say_in_the_choice_of_the_window():
    overlay = arm().overlays[0]
    burst = np.stack((1e-3 * (np.abs(overlay.time - 4.5) < 0.5), 1.0 + 0.1 * np.sin(overlay.time)), axis=1)
    start, stop = overlay.time[telling_window(replace(overlay, before=overlay.measured + burst))][[0, -1]]
    assert start < 4.01 < 4.99 < stop


def test_joints_of_findings_come_first_then_those_with_more_error():
    answer = arm().answer
    assert joint_order(answer, ["wrist", "shoulder", "elbow"]) == ["elbow", "shoulder", "wrist"]
    assert joint_order(replace(answer, findings=answer.findings[1:]), ["elbow", "shoulder"]) == ["shoulder", "elbow"]
    assert joint_order(replace(answer, findings=()), ["wrist", "shoulder", "elbow"]) == ["elbow", "shoulder", "wrist"]


def test_the_most_telling_map_is_the_one_with_structure_beyond_its_band():
    assert by_telling(slider().maps)[0].feature == "speed"
    assert visible_energy(slider().maps[1]) > 10.0
    assert visible_energy(nothing_missing().maps[0]) <= 0.0


def test_recordings_kept_aside_are_shown_first():
    assert [o.heldout for o in telling_overlays(arm().overlays)] == [True, True, False, False, False]


def test_the_summary_shows_the_joint_of_the_first_finding_and_says_the_finding():
    s = arm()
    figure = summary_figure(s.answer, s.maps, s.overlays)
    drawn = lines(figure)
    np.testing.assert_allclose(drawn["before-line"], s.maps[0].before)  # elbow against speed
    assert s.answer.findings[0].sentence == figure.texts[0].get_text().replace("\n", " ")
    held = telling_overlays(s.overlays)[0]
    assert held.heldout
    np.testing.assert_allclose(drawn["measured-motion"][0], held.measured[telling_window(held), 1][0])


def test_the_summary_is_headed_by_a_whole_sentence():
    s = arm()
    finding = s.answer.findings[0]
    long = replace(finding, sentence=f"{finding.sentence} With it {'the simulation is closer ' * 10}.")
    figure = summary_figure(replace(s.answer, findings=(long, *s.answer.findings[1:])), s.maps, s.overlays)
    assert figure.texts[0].get_text().replace("\n", " ") == finding.sentence


def test_the_summary_refuses_when_there_is_nothing_to_draw():
    s = arm()
    with pytest.raises(ValueError, match="Run it again"):
        summary_figure(s.answer, s.maps, ())
    with pytest.raises(ValueError, match="overlays of"):
        summary_figure(s.answer, slider().maps, s.overlays)


def test_inline_svg_is_deterministic_scalable_and_coloured_by_the_page():
    m = slider().maps[1]
    text = svg(regime_figure(m), "map7", 'a <b> & "c"')
    assert text == svg(regime_figure(m), "map7", 'a <b> & "c"')
    assert text.startswith('<svg role="img" aria-label="a &lt;b&gt; &amp; &quot;c&quot;" viewBox="0 0 340 210"')
    assert {"var(--before)", "var(--after)", "var(--noise)"} <= set(re.findall(r"var\(--\w+\)", text))
    assert re.findall(r"#[0-9a-f]{6}\b", text) == []
    assert all(name.startswith("map7-") for name in re.findall(r'\bid="([^"]+)"', text))
    assert "font-family" not in text
    assert text.count("<text") > 5  # text stays text
