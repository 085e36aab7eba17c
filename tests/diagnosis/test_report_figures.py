import re
from dataclasses import replace
from types import SimpleNamespace

import mujoco
import numpy as np
import pytest
from diagnosis.sample import RATE, arm, nothing_missing, slider

from torchrl_athletic.diagnosis.corrected import Simulation
from torchrl_athletic.diagnosis.fit import Hypothesis
from torchrl_athletic.diagnosis.report.figures import (
    _broken_at_restarts,
    fit_figure,
    force_word,
    overlay_figure,
    regime_figure,
    shorten,
    summary_figure,
    svg,
    torque_limit,
    why_figure,
)
from torchrl_athletic.diagnosis.report.fit_picture import fit_picture
from torchrl_athletic.diagnosis.report.telling import (
    by_telling,
    first_map,
    joint_order,
    map_of,
    rms,
    telling_overlays,
    telling_window,
    visible_energy,
)
from torchrl_athletic.effects.payload import with_payload
from torchrl_athletic.recordings import Recording
from torchrl_athletic.robots import benches


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
    assert left.get_xlabel() == "speed [m/s]"
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


def heights(figure, gid):
    """Lowest and highest place of a band or a span, in the numbers of its axis."""
    for ax in figure.axes:
        for shape in (*ax.collections, *ax.patches):
            if shape.get_gid() == gid:
                path = shape.get_paths()[0] if hasattr(shape, "get_paths") else shape.get_path()
                corners = path.vertices
                if gid.startswith("noise"):
                    corners = shape.get_patch_transform().transform(corners)
                return corners[:, 1].min(), corners[:, 1].max()
    raise AssertionError(f"no {gid} was drawn")


def in_micronewtons(m):
    """A copy of a map with forces a million times as small, and a correction that leaves a hundredth of them."""
    small = {name: 1e-6 * getattr(m, name) for name in ("before", "before_band", "noise")}
    return replace(m, **small, after=1e-8 * m.before, after_band=1e-8 * m.before_band)


@pytest.mark.parametrize("draw", [regime_figure, why_figure])
def test_bands_noise_and_axes_are_in_the_unit_that_stands_above_them(draw):
    m = in_micronewtons(slider().maps[1])
    figure = draw(m)
    above, below = figure.axes[0], figure.axes[-1]
    assert above.texts[0].get_text() == "missing force [×10⁻⁶ N]"
    assert heights(figure, "before-band") == pytest.approx((1e6 * m.before_band.min(), 1e6 * m.before_band.max()))
    assert heights(figure, "noise") == pytest.approx((-1e6 * m.noise, 1e6 * m.noise))
    assert above.get_ylim()[1] == pytest.approx(1e6 * 1.08 * np.abs(m.before_band).max())
    fine = 1e6
    if draw is why_figure:
        assert below.texts[0].get_text() == "left after the correction [×10⁻⁶ N]"
        assert heights(figure, "noise-left") == pytest.approx((-fine * m.noise, fine * m.noise))
        assert below.get_ylim()[1] == pytest.approx(1.08 * fine * 1.5 * m.noise)
    assert heights(figure, "after-band") == pytest.approx((fine * m.after_band.min(), fine * m.after_band.max()))
    np.testing.assert_allclose(lines(figure)["after-line"], fine * m.after)


def test_what_is_left_has_a_unit_of_its_own():
    m = replace(slider().maps[1], noise=2e-6)
    m = replace(m, after=1e-6 * m.before, after_band=1e-6 * m.before_band)
    figure = why_figure(m)
    assert [ax.texts[0].get_text() for ax in figure.axes] == [
        "missing force [N]", "left after the correction [×10⁻⁶ N]"
    ]  # fmt: skip
    np.testing.assert_allclose(lines(figure)["after-line"], 1e6 * m.after)
    assert heights(figure, "after-band")[1] == pytest.approx(1e6 * m.after_band.max())
    assert heights(figure, "noise-left") == pytest.approx((-2.0, 2.0))


def test_panels_of_one_joint_share_the_scale_that_holds_the_loudest_of_them():
    quiet, loud = (replace(slider().maps[1], noise=noise) for noise in (1.0, 100.0))
    limit = torque_limit([quiet, loud])
    assert limit == torque_limit([loud, quiet]) == pytest.approx(1.08 * 150.0)
    assert regime_figure(quiet, limit).axes[0].get_ylim() == pytest.approx((-limit, limit))
    assert torque_limit([quiet]) < limit


def test_motion_and_error_are_drawn_over_the_seconds_of_the_window():
    overlay = arm().overlays[3]
    small = replace(overlay, **{name: 0.01 * getattr(overlay, name) for name in ("measured", "before", "after")})
    window = slice(250, 500)
    figure = overlay_figure(small, "elbow", "rad", window)
    drawn, j = lines(figure), overlay.joint_names.index("elbow")
    measured = small.measured[window, j]
    np.testing.assert_allclose(drawn["measured-motion"], 1e3 * measured)
    assert figure.axes[0].texts[0].get_text() == "position [mrad]"
    size = 1e6 if "µrad" in figure.axes[1].texts[0].get_text() else 1e3
    for name in ("before", "after"):
        path = getattr(small, name)[window, j]
        seen = np.isfinite(drawn[f"{name}-motion"])
        assert seen.mean() > 0.9
        np.testing.assert_allclose(drawn[f"{name}-motion"][seen], 1e3 * path[seen])
        np.testing.assert_allclose(drawn[f"{name}-error"][seen], size * (path - measured)[seen])
    for ax in figure.axes:
        assert ax.get_xlim() == pytest.approx((small.time[250], small.time[499]))
    assert 200 < len(lines(overlay_figure(small, "elbow", "rad", slice(0, len(small.time))))["measured-motion"]) < 600


def test_a_track_says_its_errors_shows_its_floor_and_points_the_way_that_it_went():
    rows = [("a", "rad", 0.4, 0.2, 0.1), ("worse", "rad", 0.1, 0.3, 0.36), ("alike", "rad", 0.4, 0.39, 0.0)]
    ax = fit_figure(rows).axes[0]
    texts = [text.get_text() for text in ax.texts if text.get_text()]
    assert texts[:3] == ["a", "0.400 → 0.200 rad", "floor 0.100"]
    floors = [text for text in ax.texts if text.get_text().startswith("floor")]
    assert [text.get_ha() for text in floors] == ["left", "right", "left"]  # none leaves the picture
    bars = [line.get_xdata() for line in ax.lines if line.get_linewidth() == 7]
    assert [8 + 404 * share for share in (0.25, 0.9, 0.0)] == pytest.approx([bar[1] for bar in bars])
    arrows = [text for text in ax.texts if text.get_text() == ""]
    assert [np.sign(arrow.xy[0] - arrow.xyann[0]) for arrow in arrows] == [-1, 1]  # none where hardly anything changed


def test_a_long_name_is_cut_in_the_middle_to_its_place():
    assert shorten("x" * 24) == "x" * 24
    assert shorten("abcdefghijkl" + "m" * 20 + "nopqrstuvwxyz") == "abcdefghijkl…pqrstuvwxyz"
    assert len(shorten("left_front_hip_and_some_more", 10)) == 10
    assert (force_word("N"), force_word("N·m")) == ("force", "torque")


def test_of_recordings_kept_aside_the_one_that_errs_most_for_its_motion_comes_first():
    """Three times the error on ten times the motion is the lesser one; what the correction leaves does not count."""
    o = arm().overlays[0]
    wide, narrow = (replace(o, recording=name, measured=size * o.measured) for name, size in (("w", 10.0), ("n", 1.0)))
    wide = replace(wide, before=wide.measured + 0.03, after=wide.measured + 9.0)
    narrow = replace(narrow, before=narrow.measured + 0.01, after=narrow.measured)
    assert [x.recording for x in telling_overlays([wide, narrow])] == ["n", "w"]
    assert [x.recording for x in telling_overlays([narrow, wide])] == ["n", "w"]


def test_a_joint_is_shown_along_what_gave_its_finding_or_the_whole_robots_away_else_along_most():
    s = arm()
    friction = replace(s.answer.findings[0], joint="shoulder")
    shoulder = by_telling([m for m in s.maps if m.joint == "shoulder"])
    assert shoulder[0].feature == "acceleration"
    for joint, feature in (("shoulder", "speed"), (None, "speed"), ("elbow", "acceleration")):
        answer = replace(s.answer, findings=(replace(friction, joint=joint),))
        assert first_map(answer, s.maps, "shoulder").feature == feature


def test_a_wide_band_hides_a_missing_torque_as_its_half_does():
    m = slider().maps[1]
    flat = np.full_like(m.before, 2.0)
    banded = replace(m, before=flat, before_band=np.stack([flat - 1.0, flat + 1.0], -1))
    assert visible_energy(banded) == pytest.approx(4.0 - 1.0)


def test_shares_of_a_joint_add_up_over_its_regimes():
    answer = arm().answer
    first = answer.locations[0]
    parts = [replace(first, joint=joint, share_of_error=share) for joint, share in
             (("elbow", 0.3), ("shoulder", 0.4), ("elbow", 0.3))]  # fmt: skip
    quiet = replace(answer, findings=(), locations=tuple(parts))
    assert joint_order(quiet, ["shoulder", "elbow"]) == ["elbow", "shoulder"]


def test_a_joint_of_several_findings_stands_where_its_first_one_does():
    first, second = arm().answer.findings
    answer = replace(arm().answer, findings=(first, second, first))
    assert joint_order(answer, ["shoulder", "elbow"]) == ["elbow", "shoulder"]


def test_a_law_is_shown_along_its_own_quantity_and_what_has_none_along_what_shows_most():
    s = arm()
    friction = replace(s.answer.findings[0], regime="position beyond 1 rad")
    assert map_of(friction, s.maps).feature == "speed"
    unknown = replace(friction, effect="my_own_effect", regime="everywhere")
    assert map_of(unknown, s.maps) is by_telling([m for m in s.maps if m.joint == "elbow"])[0]
    for joint in ("shoulder", "elbow"):
        assert first_map(replace(s.answer, findings=()), s.maps, joint).joint == joint


def test_what_is_no_number_says_nothing_of_what_is_shown_first():
    m, o = slider().maps[1], arm().overlays[0]
    gap = np.arange(len(m.before)) == 3
    assert visible_energy(replace(m, before=np.where(gap, np.nan, m.before))) > 10.0
    assert rms(np.array([3.0, np.nan, -3.0, np.inf])) == 3.0
    burst = (1.0 * (np.abs(o.time - 6.0) < 0.5))[:, None] * np.ones(2)
    burst[3] = np.inf  # a simulation that ran away for a moment
    start, stop = o.time[telling_window(replace(o, before=o.measured + burst))][[0, -1]]
    assert start < 5.51 < 6.49 < stop


def test_the_last_seconds_of_a_recording_are_shown_where_they_tell_most():
    o, time = arm().overlays[0], np.arange(7.0)
    still = np.zeros((7, 2))
    end = replace(o, time=time, measured=still, before=still + (time == 5.0)[:, None], after=still)
    assert telling_window(end, 3.0) == slice(3, 6)


def test_an_error_counts_by_the_motion_of_its_own_joint():
    """A hundredth of a slow joint's motion is less than a tenth of a quick one's, in whichever order they stand."""
    o = arm().overlays[0]
    motion = np.stack([100 * np.sin(o.time), np.sin(o.time)], 1)
    one, other = (
        replace(o, recording=name, measured=motion, before=motion + by) for name, by in (("a", [2, 0]), ("b", [0, 1]))
    )
    assert [x.recording for x in telling_overlays([one, other])] == ["b", "a"]


def test_each_track_stands_on_its_own_line_with_its_own_numbers():
    ax = fit_figure([("a", "rad", 0.4, 0.2, 0.1), ("b", "rad", 0.3, 0.1, 0.05)]).axes[0]
    said = {text.get_text(): text.get_position()[1] for text in ax.texts if text.get_text()}
    assert {"0.400 → 0.200 rad", "0.300 → 0.100 rad", "floor 0.100", "floor 0.050"} <= said.keys()
    assert said["a"] == said["0.400 → 0.200 rad"] < said["b"] == said["0.300 → 0.100 rad"]


def test_an_axis_holds_what_is_left_in_its_own_unit_and_the_quantity_of_the_part_above():
    m = slider().maps[1]
    shorter = replace(m, after=np.where(m.centre > 0, np.nan, 1e-5 * m.before), noise=np.nan)
    shorter = replace(shorter, after_band=np.repeat(shorter.after[:, None], 2, 1))
    missing, left = why_figure(shorter).axes
    assert left.get_xlim() == missing.get_xlim()
    largest = 1e6 * np.nanmax(np.abs(shorter.after))
    assert largest < left.get_ylim()[1] < 1.2 * largest


def test_nothing_missing_and_no_noise_known_leave_an_axis_with_a_height():
    m = slider().maps[1]
    nothing = {"after": np.zeros_like(m.after), "after_band": np.zeros_like(m.after_band), "noise": np.nan}
    assert why_figure(replace(m, **nothing)).axes[1].get_ylim()[1] > 0
    nothing |= {"before": nothing["after"], "before_band": nothing["after_band"]}
    assert torque_limit([replace(m, **nothing)]) > 0
    worse = replace(m, after=3 * m.before)
    assert torque_limit([worse]) > np.abs(worse.after).max()


def test_both_errors_fit_their_axis_and_a_motion_about_any_place_its_own():
    o = slider().overlays[0]
    aside = replace(o, measured=o.measured + 5.0, before=o.measured + 5.001, after=o.measured + 5.01)
    for x in (aside, replace(aside, before=aside.after, after=aside.before)):
        motion, error = overlay_figure(x, "carriage", "m", slice(0, 500)).axes
        assert error.get_ylim()[1] > 10.0  # mm
        low, high = motion.get_ylim()
        assert low < 5.0 + o.measured[:500].min() < 5.0 + o.measured[:500].max() < high
    small = replace(o, measured=1e-2 * o.measured, before=1e3 * o.before, after=1e-2 * o.after)
    low, high = overlay_figure(small, "carriage", "m", slice(0, 500)).axes[0].get_ylim()
    assert np.ptp(10 * small.measured[:500]) < high - low < np.ptp(5e3 * small.measured[:500])  # mm


def test_a_window_late_in_a_recording_is_drawn_as_finely_as_an_early_one():
    o = arm().overlays[0]
    early, late = (lines(overlay_figure(o, "elbow", "rad", slice(at, at + 250)))["measured-motion"] for at in (0, 2000))
    assert len(early) == len(late) == 250


def test_an_error_that_shrinks_on_its_own_is_no_restart():
    time = np.arange(1000) / RATE
    error = np.where(time % 0.5 < 0.25, 1.0, 0.5) + 1e-3 * time
    assert not np.isnan(_broken_at_restarts(error, np.zeros(1000))).any()


def test_the_quantity_has_its_readable_unit_and_a_number_without_one_is_marked_so():
    m = replace(slider().maps[1], centre=1e-3 * slider().maps[1].centre, unit="m")
    ax = regime_figure(m).axes[0]
    assert ax.get_xlabel() == "speed [mm]"
    np.testing.assert_allclose(ax.lines[-1].get_xdata(), 1e3 * m.centre)
    assert regime_figure(replace(slider().maps[1], unit="1")).axes[0].get_xlabel() == "speed [1]"


def test_the_summary_is_of_the_joint_that_matters_in_the_recordings_that_have_it():
    s = arm()
    shoulder = replace(s.answer, findings=s.answer.findings[1:])
    figure = summary_figure(shoulder, s.maps, s.overlays)  # the elbow has the first map
    assert figure.axes[0].get_xlabel().startswith("acceleration")
    other = slider().overlays[1]  # kept aside, too, and errs more beside its motion
    loud = replace(other, before=other.before + 1.0)
    figure = summary_figure(s.answer, s.maps, (loud, *s.overlays))
    assert figure.axes[1].texts[0].get_text() == "position [rad]"
    metres = replace(s.answer, quality={**s.answer.quality, "units": {"shoulder": "rad", "elbow": "m"}})
    assert summary_figure(metres, s.maps, s.overlays).axes[1].texts[0].get_text() == "position [m]"
    unnamed = replace(s.answer, findings=())
    assert summary_figure(unnamed, s.maps, s.overlays).texts[0].get_text() == s.answer.summary[0].replace(". ", ".\n")


class Still:
    """A simulation whose joints stay where they are told."""

    def __init__(self, xml, by):
        self.model, self.by = mujoco.MjModel.from_xml_string(xml), by
        self.joint_names = tuple(self.model.joint(j).name for j in range(self.model.njnt))

    def rollout(self, recording):
        return recording.position + self.by


def test_a_fit_is_shown_on_what_was_kept_aside_with_the_worst_joints_first_and_their_units():
    xml = """<mujoco><worldbody><body><joint name="rail" type="slide"/><geom size="0.1"/>
      <body><joint name="hip"/><geom size="0.1"/></body></body></worldbody></mujoco>"""
    time = 3.0 + np.arange(700) / 100
    takes = [
        Recording(
            time, ("rail", "hip"), np.stack([k + time, k - time], 1), torque_command=np.zeros((700, 2)), source=k_
        )
        for k, k_ in ((0.0, "fitted"), (50.0, "aside"))
    ]
    errors = {"rail": {"before": 0.5, "after": 0.1, "floor": 0.0}, "hip": {"before": 0.25, "after": 0.2, "floor": 0.0}}
    worse = {name: {**e, "before": 1.0 if name == "hip" else 0.1} for name, e in errors.items()}
    scores = {"heldout": SimpleNamespace(per_joint=errors), "train": SimpleNamespace(per_joint=worse)}
    fit = SimpleNamespace(
        nominal=Still(xml, 0.25), corrected=Still(xml, 0.125), xml=xml, scores=scores, recordings=takes[:1]
    )
    for heldout, order, where in ((takes[1:], [0, 1], "kept aside: aside"), ([], [1, 0], "fitted: fitted")):
        fit.heldout = heldout
        figure = fit_picture(fit)
        names = [("rail", "hip")[j] for j in order]
        assert [ax.get_title(loc="left").split(":")[0] for ax in figure.axes] == names
        assert [ax.get_ylabel() for ax in figure.axes] == [{"rail": "[m]", "hip": "[rad]"}[name] for name in names]
        assert figure.axes[-1].get_xlabel() == f"time [s], {where}"
        take = (*heldout, *takes)[0]
        for ax, j in zip(figure.axes, order, strict=True):
            labels = [line.get_label() for line in ax.lines]
            assert labels == ["recorded", "given model", "fitted"]
            for line, by in zip(ax.lines, (0.0, 0.25, 0.125), strict=True):
                np.testing.assert_allclose(line.get_xdata(), np.arange(501) / 100, atol=1e-9)  # five seconds
                np.testing.assert_allclose(line.get_ydata(), take.position[:501, j] + by)
        score = scores["heldout" if heldout else "train"].per_joint[names[0]]
        unit = {"rail": "m", "hip": "rad"}[names[0]]
        said = f"{names[0]}: error over 0.5 s {score['before']:.3g} → {score['after']:.3g} {unit}"
        assert figure.axes[0].get_title(loc="left") == said


@pytest.mark.parametrize(("fell", "left"), [(200.0, True), (-200.0, True), (0.3, False)])
def test_a_given_model_that_falls_does_not_flatten_what_is_fitted(fell, left):
    xml = """<mujoco><worldbody><body><joint name="hip"/><geom size="0.1"/></body></worldbody></mujoco>"""
    time = np.arange(300) / 100
    take = Recording(time, ("hip",), np.sin(time)[:, None], torque_command=np.zeros((300, 1)), source="logs/aside.csv")
    scores = {"heldout": SimpleNamespace(per_joint={"hip": {"before": 9.0, "after": 0.1, "floor": 0.0}})}
    fit = SimpleNamespace(
        nominal=Still(xml, fell * time[:, None]),
        corrected=Still(xml, 0.01),
        xml=xml,
        scores=scores,
        recordings=[],
        heldout=[take],
    )
    (axes,) = fit_picture(fit).axes
    low, high = axes.get_ylim()
    assert low < take.position.min()
    assert high > take.position.max() + 0.01
    assert high - low < 3.5 * np.ptp(take.position)
    assert axes.get_title(loc="left").endswith("leaves the picture") == left
    assert axes.get_xlabel() == "time [s], kept aside: aside.csv"


def test_a_take_with_a_weight_is_shown_beside_simulations_that_carry_it():
    xml, mass, period, torque = benches.pendulum(timestep=0.01), 2.0, 0.01, 3.0
    loaded = with_payload(xml, ("pendulum",), mass)
    data, path = mujoco.MjData(loaded), []
    data.qfrc_applied[0] = torque
    for _ in range(200):
        path.append(data.qpos.copy())
        mujoco.mj_step(loaded, data)
    time, command = period * np.arange(200), np.full((200, 1), torque)
    take = Recording(
        time, ("pendulum",), np.array(path), torque_command=command, metadata={"payload_kg": mass}, source="loaded.csv"
    )
    given = Simulation(mujoco.MjModel.from_xml_string(xml), ("pendulum",), Hypothesis(()), np.zeros(0))
    scores = {"heldout": SimpleNamespace(per_joint={"pendulum": {"before": 0.1, "after": 0.1, "floor": 0.0}})}
    fit = SimpleNamespace(nominal=given, corrected=given, xml=xml, scores=scores, recordings=[], heldout=[take])
    _, *simulated = fit_picture(fit).axes[0].lines
    for line in simulated:
        assert np.abs(line.get_ydata() - take.position[:, 0]).max() < 0.01
    assert np.abs(given.rollout(take) - take.position).max() > 0.1
