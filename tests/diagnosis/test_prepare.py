from dataclasses import dataclass, replace
from types import SimpleNamespace

import mujoco
import numpy as np
import pytest
from diagnosis.plants import pendulum, smooth_torque
from diagnosis.plants import record as swing
from effects.arm import JOINTS, arm, record
from scipy.signal import lfilter

from torchrl_athletic.diagnosis import prepare as preparing
from torchrl_athletic.diagnosis.prepare import (
    PAYLOAD,
    _limit,
    _periods,
    _torque_noise,
    _velocity_fits,
    _with_known_noise,
    drive_signals,
    prepare,
)
from torchrl_athletic.effects import ActuationDelay, TorqueScale, project_recording
from torchrl_athletic.effects.signals import KERNEL
from torchrl_athletic.recordings import Recording, RecordingError, repeat_noise

NOISE = 2e-5


@pytest.fixture(scope="module")
def takes() -> list[Recording]:
    rng = np.random.default_rng(0)
    made = [record(seconds=5.0, seed=seed) for seed in (0, 1)]
    return [
        replace(r, position=r.position + rng.normal(0, NOISE, r.position.shape), source=f"{k}.npz")
        for k, r in enumerate(made)
    ]


def test_every_recording_is_checked_projected_and_put_on_the_grid(takes):
    prepared = prepare(takes, arm())
    assert len(prepared.quality) == len(prepared.signals) == sum(len(t.parts) for t in prepared.takes) == 2
    np.testing.assert_allclose(prepared.position_noise, NOISE, rtol=0.2)
    assert len(prepared.takes) == 1  # of one kind, which are simulated together
    assert prepared.repeatability is None
    assert len({s.kernel for s in prepared.signals}) == 1
    for s in prepared.signals:
        assert s.missing.std() < 0.02 * s.command.std()


def test_a_width_that_is_given_is_used(takes):
    assert [s.kernel for s in prepare(takes, arm(), kernel=0.017).signals] == [0.017] * 2


def test_a_take_of_an_experiment_is_seen_in_its_own_band_and_the_others_as_ever(takes):
    slow, quick = takes[0], takes[1]
    quick = replace(quick, position=quick.position + 5e-3 * np.sin(2 * np.pi * 15 * quick.time)[:, None])
    alone, together = prepare([slow], arm()), prepare([slow, quick], arm(), joined=1)
    assert together.signals[0].kernel == alone.signals[0].kernel
    assert together.signals[1].kernel < 0.6 * alone.signals[0].kernel
    quicker = replace(slow, position=slow.position + 5e-3 * np.sin(2 * np.pi * 25 * slow.time)[:, None])
    assert prepare([slow, quicker], arm(), joined=1).signals[1].kernel < KERNEL[0]  # the plan has counted its noise
    np.testing.assert_array_equal(together.signals[0].missing, alone.signals[0].missing)


def test_a_motion_of_few_samples_a_period_does_not_pass_for_noise_of_the_encoder(takes):
    slow, quick = takes
    rough = 2e-3 * np.sin(2 * np.pi * 60 * quick.time)[:, None]  # four samples a period
    quick = replace(quick, position=quick.position + rough)
    alone, together = prepare([quick], arm()), prepare([slow, quick], arm(), joined=1)
    np.testing.assert_allclose(together.quality[1].position_noise, NOISE, rtol=0.2)
    assert alone.quality[0].position_noise.max() > 2 * NOISE


def test_a_take_with_a_known_weight_is_compared_with_the_model_that_carries_it():
    xml, weight = pendulum(), 0.2
    model = mujoco.MjModel.from_xml_string(xml)
    point = f'<body pos="0 0 -0.8"><inertial pos="0 0 0" mass="{weight}" diaginertia="1e-9 1e-9 1e-9"/></body>'
    take = swing(xml.replace("</body>", f"{point}</body>"), smooth_torque(3.0))
    told = replace(take, metadata={PAYLOAD: weight})
    silent, carried = (prepare([r], model, xml=xml) for r in (take, told))
    assert np.abs(carried.signals[0].missing).max() < 0.05 * np.abs(silent.signals[0].missing).max()
    assert carried.takes[0].model.nbody == model.nbody + 1
    with pytest.raises(RecordingError, match="the model's MJCF is needed"):
        prepare([told], model)
    with pytest.raises(RecordingError, match="A mass of 0 kg or more"):
        prepare([replace(take, metadata={PAYLOAD: -1.0})], model, xml=xml)


@pytest.mark.parametrize(("unit", "used"), [(1.0, True), (180 / np.pi, False), (0.5, False)])
def test_a_velocity_in_another_unit_neither_drives_the_torques_nor_starts_a_window(unit, used, takes):
    """What is no slope of the position is left aside, as if nobody had logged it."""
    (first, _) = takes
    rng = np.random.default_rng(1)
    coarse = first.position + rng.normal(0, 1e-3, first.position.shape)  # a drive's velocity says more than this
    slope = np.gradient(takes[0].position, first.time, axis=0)
    silent = replace(first, position=coarse)
    seeing = replace(silent, velocity=unit * lfilter([0.2], [1, -0.8], slope, axis=0))
    (without, told) = (prepare([r], arm()) for r in (silent, seeing))
    assert told.quality[0].velocity_noise is not None
    assert np.array_equal(told.signals[0].missing, without.signals[0].missing) is not used
    assert np.array_equal(told.takes[0].velocity, without.takes[0].velocity) is not used


def test_a_gap_splits_a_take_and_nothing_is_made_up_across_it(takes):
    (first, _) = takes
    cut = np.r_[0:500, 650:1250]
    gapped = replace(
        first, time=first.time[cut], position=first.position[cut], torque_command=first.command[cut], source="gap.npz"
    )
    prepared = prepare([gapped], arm())
    assert [s.recording.source for s in prepared.signals] == ["gap.npz"] * 2
    inside = np.concatenate([s.time for s in prepared.signals])
    assert not ((inside > first.time[499]) & (inside < first.time[650])).any()
    whole = prepare([first], arm(), kernel=prepared.signals[0].kernel)
    left, right = prepared.signals
    assert np.abs(left.missing).max() < 0.05
    assert np.abs(right.missing).max() < 0.05
    assert len(left.time) + len(right.time) < len(whole.signals[0].time)


def test_what_is_frozen_after_a_gap_is_masked_where_it_was_logged(takes):
    """Rows of the mask are those of the take, of which the second piece starts later."""
    (first, _) = takes
    position = first.position.copy()
    position[900:940, 1] = position[900, 1]
    cut = np.r_[0:500, 650:1250]
    gapped = replace(first, time=first.time[cut], position=position[cut], torque_command=first.command[cut])
    before, after = prepare([gapped], arm()).signals
    assert not after.valid[np.abs(after.time - first.time[920]) < 0.05].any()
    assert np.abs(after.missing[after.valid]).max() < 0.1
    assert after.valid[after.time > first.time[1020]].mean() > 0.9
    assert before.valid.mean() > 0.9


def test_pieces_remember_when_their_take_began_and_what_it_read(takes):
    """A clock that drifts and a reading that rests count from the beginning of the take."""
    (first, _) = takes
    cut = np.r_[0:500, 650:1250]
    kept = {"position": first.position[cut], "torque_command": first.command[cut], "metadata": {"robot": "arm"}}
    gapped = replace(first, time=first.time[cut], **kept)
    pieces = [s.recording for s in prepare([gapped], arm()).signals]
    assert [p.began for p in pieces] == [gapped.time[0]] * 2
    for piece in pieces:
        np.testing.assert_array_equal(piece.mean_reading, gapped.mean_reading)
        assert piece.metadata["robot"] == "arm"


def test_a_piece_too_short_to_see_a_motion_in_is_left_out(takes):
    (first, _) = takes
    cut = np.r_[0:20, 200:1250]
    gapped = replace(first, time=first.time[cut], position=first.position[cut], torque_command=first.command[cut])
    prepared = prepare([gapped], arm())
    assert len(prepared.signals) == len(prepared.takes) == 1
    assert prepared.signals[0].recording.time[0] == pytest.approx(first.time[200])
    (why,) = prepared.report()["left_out"]
    assert "the take lasts 0.08 s" in why


def test_only_short_pieces_are_refused_with_the_mend(takes):
    (first, _) = takes
    cut = np.concatenate([np.arange(k, k + 20) for k in range(0, 1200, 100)])
    gapped = replace(
        first, time=first.time[cut], position=first.position[cut], torque_command=first.command[cut], source="gaps.npz"
    )
    with pytest.raises(RecordingError, match=r"gaps\.npz.*the take lasts .* s are needed to see a motion in it"):
        prepare([gapped], arm())


def test_one_take_that_is_too_short_is_refused(takes):
    with pytest.raises(RecordingError, match=r"0\.npz: the take lasts 0\.20 s, at least"):
        prepare([takes[0].slice(0, 50)], arm())


def test_frozen_readings_of_one_joint_are_masked_at_all_that_feel_its_acceleration(takes):
    (first, _) = takes
    position = first.position.copy()
    position[400:440, 1] = position[400, 1]
    (s,) = prepare([replace(first, position=position)], arm()).signals
    assert np.abs(s.missing).max() > 10
    assert np.abs(s.missing[s.valid]).max() < 0.1
    away = np.abs(s.time - first.time[420]) > 0.3
    assert s.valid[away].mean() > 0.9


def test_no_recording_other_joints_and_joints_the_model_lacks_are_refused(takes):
    with pytest.raises(RecordingError, match="no recordings: name a file or a folder"):
        prepare([], arm())
    other = replace(takes[1], joint_names=("shoulder", "wrist"))
    with pytest.raises(RecordingError, match=r"1\.npz: joint_names are .*Diagnose takes of the same joints together"):
        prepare([takes[0], other], arm())
    with pytest.raises(RecordingError, match=r"joint_names has 'knee'.*Rename it with a column map"):
        prepare([replace(takes[0], joint_names=("shoulder", "knee"))], arm())


def test_joints_may_come_in_any_order(takes):
    swapped = takes[1].ordered(JOINTS[::-1])
    np.testing.assert_array_equal(swapped.position[:, 0], takes[1].position[:, 1])
    alike, straight = prepare([takes[0], swapped], arm()), prepare(takes, arm())
    np.testing.assert_array_equal(alike.signals[1].missing, straight.signals[1].missing)


def test_a_robot_that_rests_is_refused(takes):
    still = replace(takes[0], position=0 * takes[0].position, source="still.npz")
    with pytest.raises(RecordingError, match=r"still\.npz: no joint moves.*Excite the joints"):
        prepare([still], arm())


def test_a_take_in_which_the_robot_rests_takes_no_other_with_it(takes):
    still = replace(takes[0], position=0 * takes[0].position, source="still.npz")
    prepared = prepare([still, takes[1]], arm())
    assert [s.valid.any() for s in prepared.signals] == [False, True]


def test_the_share_that_is_used_is_told_of_each_joint_by_its_name(takes):
    (first, _) = takes
    resting = replace(first, position=first.position * [1.0, 0.0])
    assert prepare([resting], arm()).used_share() == {"shoulder": pytest.approx(1.0, abs=0.2), "elbow": 0.0}


def test_the_measured_torque_drives_when_asked(takes):
    (first, _) = takes
    logged = replace(
        first, torque_command=0.5 * first.command, torque_measured=first.command, torque_semantics="link_side"
    )
    commanded, measured = (prepare([logged], arm(), drive).signals[0] for drive in ("command", "measured"))
    assert np.abs(measured.missing).max() < 0.05
    np.testing.assert_allclose(commanded.missing, measured.missing + 0.5 * measured.command, atol=1e-9)
    with pytest.raises(RecordingError, match="there is no torque_measured to drive the simulation with"):
        prepare([first], arm(), "measured")


def following_targets(r: Recording) -> Recording:
    """The same positions, as a loop made them."""
    return replace(r, torque_command=None, position_target=r.position, kp=np.full(2, 20.0), kd=np.full(2, 0.5))


def test_repeats_tell_the_repeatability(takes):
    first = following_targets(takes[0])
    rng = np.random.default_rng(3)
    again = replace(first, position=first.position + rng.normal(0, 10 * NOISE, first.position.shape), source="2.npz")
    prepared = prepare([replace(r, metadata={"repeat_id": "a"}) for r in (first, again)], arm())
    assert prepared.repeatability is not None
    np.testing.assert_allclose(prepared.repeatability, 10 * NOISE / np.sqrt(2), rtol=0.3)


def test_repeats_that_drift_apart_under_torques_set_no_floor_for_windows_that_start_anew(takes):
    """A pendulum that goes over the top once more than the last time is 6 rad away; a window is followed as ever."""
    apart = replace(takes[0], position=takes[0].position + np.linspace(0, 6, len(takes[0].time))[:, None])
    repeats = [replace(r, metadata={"repeat_id": "a"}) for r in (takes[0], apart)]
    assert repeat_noise(repeats) is not None
    assert prepare(repeats, arm()).repeatability is None


def test_the_report_names_its_source_once(takes):
    (report, _) = prepare(takes, arm()).report()["recordings"]
    assert report["source"] == "0.npz"
    assert not any(w.startswith("0.npz") for w in report["warnings"])


# --- the drive alone ---


def drive(takes, received, noise=0.0):
    (first, _) = takes
    measured = received(first.command) + np.random.default_rng(5).normal(0, noise, first.command.shape)
    logged = replace(first, torque_measured=measured, torque_semantics="link_side")
    return drive_signals(prepare([logged], arm()))[0]


def test_a_perfect_drive_misses_nothing(takes):
    s = drive(takes, lambda u: u)
    assert np.abs(s.missing).max() < 0.02 * np.abs(s.command).max()  # half a hold


def test_a_drive_that_scales_is_seen_as_a_scale(takes):
    s = drive(takes, lambda u: 0.8 * u)
    predicted = TorqueScale().fingerprint(s, 1, {}).columns[:, 1, 0] * (1 - 1 / 0.8)
    np.testing.assert_allclose(s.missing[:, 1], predicted, atol=0.03 * np.abs(s.command[:, 1]).max())


def test_a_drive_that_is_late_is_seen_as_a_delay(takes):
    s = drive(takes, lambda u: np.vstack([np.tile(u[:1], (5, 1)), u[:-5]]))
    predicted = ActuationDelay().fingerprint(s, 0, {"delay": 0.02}).constant[:, 0]
    left = s.missing[:, 0] - predicted
    assert left.std() < 0.15 * s.missing[:, 0].std()


def test_the_noise_of_the_drive_is_that_of_its_torque_sensor(takes):
    quiet, loud = (drive(takes, lambda u: lfilter([0.2], [1, -0.8], u, axis=0), noise) for noise in (0.0, 0.05))
    extra = (loud.missing - quiet.missing).std(0)
    np.testing.assert_allclose(loud.noise, extra, rtol=0.25)


def test_noise_of_a_torque_is_read_from_what_no_smooth_torque_has():
    """White noise is told by its deviation; a smooth torque has none, and a channel of zeros the least there is."""
    time = np.arange(4000) / 500
    rng = np.random.default_rng(0)
    clean = np.stack([3 * np.sin(2 * time), np.cos(time), 0 * time], 1)
    noise = np.array([0.2, 0.05, 0.0])
    found = _torque_noise(clean + noise * rng.standard_normal(clean.shape))
    np.testing.assert_allclose(found[:2], noise[:2], rtol=0.05)
    assert found[2] == pytest.approx(1e-12)


def test_grids_are_shared_by_takes_of_one_rate_whatever_the_jitter():
    takes = [SimpleNamespace(rate=rate) for rate in (500.0, 500.6, 505.0, 250.0, 504.5)]
    assert _periods(takes) == pytest.approx([1 / 500, 1 / 500, 1 / 505, 1 / 250, 1 / 505])


@pytest.mark.parametrize(
    ("scales", "fits"), [((1.0, None), True), ((1.0, 1.3), False), ((0.7, 1.0), False), ((None, None), True)]
)
def test_velocities_count_where_they_are_slopes_of_the_positions_on_every_joint(scales, fits):
    assert _velocity_fits(SimpleNamespace(velocity_scale=scales)) is fits


def test_the_limit_of_a_motor_is_the_less_of_both_ways_and_known_of_all_joints_or_none(monkeypatch):
    told = {"of": ([-30.0, -8.0], [20.0, 9.0])}
    monkeypatch.setattr("torchrl_athletic.diagnosis.prepare.torque_range", lambda *_: map(np.array, told["of"]))
    assert _limit(None, None).tolist() == [20.0, 8.0]
    for told["of"] in (([-30.0, -np.inf], [20.0, np.inf]), ([-30.0, 0.0], [20.0, 9.0])):  # or drives one way only
        assert _limit(None, None) is None


@dataclass(frozen=True)
class Noise:
    position_noise: np.ndarray
    noise_correlation: np.ndarray
    velocity_noise: np.ndarray | None


def test_a_take_of_an_experiment_has_the_noise_of_the_earlier_ones():
    """The median over them, of each channel; of velocities only where it has them itself."""
    earlier = [
        Noise(np.full(2, 1.0 * k), np.full(2, 0.1 * k), None if k == 2 else np.full(2, 5.0 * k)) for k in (1, 2, 9)
    ]
    new = [Noise(np.full(2, 99.0), np.full(2, 99.0), velocity) for velocity in (None, np.full(2, 99.0))]
    *kept, blind, seeing = _with_known_noise([*earlier, *new], 3)
    assert kept == earlier
    for q in (blind, seeing):
        assert q.position_noise.tolist() == [2.0, 2.0]
        assert q.noise_correlation.tolist() == pytest.approx([0.2, 0.2])
    assert blind.velocity_noise is None
    assert seeing.velocity_noise.tolist() == [25.0, 25.0]
    assert _with_known_noise(new, 0) == new


def test_both_torques_are_smoothed_alike_so_that_nothing_is_bent_into_what_the_drive_misses(takes):
    (first, _) = takes
    logged = replace(first, torque_measured=0.8 * first.command, torque_semantics="link_side")
    prepared = prepare([logged], arm())
    biased = replace(prepared, signals=tuple(replace(s, bias=np.ones_like(s.bias)) for s in prepared.signals))
    [s] = drive_signals(biased)
    assert not s.bias.any()
    np.testing.assert_allclose(s.required - s.command, s.missing)
    assert (s.missing * s.command).sum() < 0  # a drive that is weaker than the command lacks torque against it


def test_a_mask_stays_with_its_samples_where_those_of_a_lost_base_went_and_nobody_carries_a_robot_twice_alike(
    takes, monkeypatch
):
    first, again = (
        replace(following_targets(r), metadata={"repeat_id": "a"})
        for r in (takes[0], replace(takes[0], source="carried.npz"))
    )
    unfit = np.zeros(first.position.shape, dtype=bool)
    unfit[600:650, 1] = True
    kept, masks, repeats = np.r_[40:300, 330 : first.num_samples], [], []
    alike = []

    def without_lost(r):
        return r.where(np.isin(np.arange(r.num_samples), kept))

    def projected(piece, model, noise, velocity_noise, mask, *rest):
        masks.append((piece.time, mask))
        alike.append(rest[-1])
        return project_recording(piece, model, noise, velocity_noise, mask, *rest)

    monkeypatch.setattr(preparing, "_unfit", lambda quality: unfit)
    monkeypatch.setattr(preparing, "with_known_base", without_lost)
    monkeypatch.setattr(preparing, "project_recording", projected)
    monkeypatch.setattr(preparing, "base_moves", lambda r: r.source == "carried.npz")
    monkeypatch.setattr(preparing, "pose_of", lambda recording, model: None)
    monkeypatch.setattr(preparing, "repeat_noise", lambda found: repeats.extend(r.source for r in found))
    prepared = prepare([first, again], arm())
    assert repeats == ["0.npz"]
    for correlation in alike:  # of one sample's noise with the next one's
        np.testing.assert_array_equal(correlation, prepared.quality[0].noise_correlation)
    assert len(masks) >= 2
    for time, mask in masks:
        np.testing.assert_array_equal(mask, unfit[np.isin(first.time, time)])
    assert sum(mask.any() for _, mask in masks) == 2


def test_each_take_is_checked_and_seen_and_replayed_with_its_own_numbers(takes, monkeypatch):
    """Which is the limit of the motors, its noise and what of it is remembered, its period and its test function."""
    first, second = (replace(r, velocity=np.gradient(r.position, r.time, axis=0)) for r in takes)
    earlier = replace(first, source="earlier.npz")
    asked = {"limits": [], "kernels": [], "seen": [], "replayed": []}
    whole = {name: getattr(preparing, name) for name in ("check_quality", "kernel_for", "project_recording", "take_of")}

    def checked(r, limit=None):
        asked["limits"].append(limit)
        own = len(asked["limits"])
        noise = {"position_noise": np.full(2, NOISE * own**2), "velocity_noise": np.full(2, 0.01 * own)}
        return replace(whole["check_quality"](r, limit), **noise)

    def kernel(recordings, *rest, **named):
        asked["kernels"].append(([r.source for r in recordings], rest, named))
        return 0.02 + 0.001 * len(asked["kernels"])

    def seen(piece, model, *rest):
        asked["seen"].append(rest)
        return whole["project_recording"](piece, model, *rest)

    def replayed(piece, model, *rest):
        asked["replayed"].append(rest)
        return whole["take_of"](piece, model, *rest)

    for name, spy in (("check_quality", checked), ("kernel_for", kernel), ("project_recording", seen),
                      ("take_of", replayed)):  # fmt: skip
        monkeypatch.setattr(preparing, name, spy)
    monkeypatch.setattr(preparing, "_limit", lambda model, address: np.array([3.0, 4.0]))
    prepared = prepare([earlier, first, second], arm(), joined=2)
    assert [limit.tolist() for limit in asked["limits"]] == [[3.0, 4.0]] * 3
    (all_old, _, _), *own = asked["kernels"]
    assert all_old == ["earlier.npz"]
    for q, (sources, (noise, least), _), source in zip(prepared.quality[1:], own, ("0.npz", "1.npz"), strict=True):
        assert sources == [source]
        np.testing.assert_array_equal(noise, q.position_noise)
        assert least == preparing.QUICKEST
    assert [s.kernel for s in prepared.signals] == pytest.approx([0.021, 0.022, 0.023])
    for q, in_torques, in_time in zip(prepared.quality, asked["seen"], asked["replayed"], strict=True):
        for noise, velocity, correlation in ((*in_torques[:2], in_torques[4]), in_time[:3]):
            np.testing.assert_array_equal(noise, q.position_noise)
            np.testing.assert_array_equal(correlation, q.noise_correlation)
            np.testing.assert_array_equal(velocity, q.velocity_noise)
        assert in_time[3] == 1 / earlier.rate
    asked["limits"].clear()
    np.testing.assert_allclose(prepare([earlier, *takes], arm()).position_noise, 4 * NOISE)  # of 1, 4 and 9 that


def test_shares_are_of_all_instants_and_warnings_do_not_repeat_their_file(takes):
    names = SimpleNamespace(joint_names=("hip", "knee"))
    pieces = [
        SimpleNamespace(recording=names, valid=np.array(rows, dtype=bool)) for rows in ([[1, 0], [0, 0]], [[1, 1]] * 2)
    ]
    report = {"source": "x.npz", "warnings": ["x.npz: the clock jumps.", "x.npz is short."]}
    quality = (SimpleNamespace(report=lambda: report),)
    told = preparing.Prepared(quality, tuple(pieces), (), np.ones(2), None, ("y.npz: too short.",)).report()
    assert told["used_share"] == {"hip": 0.75, "knee": 0.5}
    assert told["recordings"][0]["warnings"] == ["the clock jumps.", "x.npz is short."]
    assert told["left_out"] == ["y.npz: too short."]


def test_a_wrong_reading_counts_at_every_joint_and_what_is_masked_for_other_reasons_at_its_own():
    wrong, other = np.zeros((2, 3, 2), dtype=bool)
    wrong[0, 1] = other[2, 0] = True
    for name in ("frozen", "dropout"):
        masks = {"frozen": np.zeros((3, 2), dtype=bool), "dropout": np.zeros((3, 2), dtype=bool)} | {name: wrong}
        quality = SimpleNamespace(masks=masks, usable=lambda: ~(wrong | other))
        assert preparing._unfit(quality).tolist() == [[True, True], [False, False], [True, False]]


def test_readings_that_repeat_now_and_then_leave_the_torques_what_they_say(takes):
    rng = np.random.default_rng(1)
    position = takes[0].position.copy()
    stale = 3 + 5 * np.flatnonzero(rng.random((len(position) - 5) // 5) < 0.5)  # a tenth of the rows
    position[stale, 1] = position[stale - 1, 1]
    repeated = replace(takes[0], position=position)
    clean, mended = (prepare([r], arm(), kernel=0.02) for r in (takes[0], repeated))
    assert mended.quality[0].bridged[1] > 0.02 * len(position)
    assert mended.signals[0].valid.mean() > 0.9 * clean.signals[0].valid.mean()
    assert mended.takes[0].recording is not repeated
    both = clean.signals[0].valid & mended.signals[0].valid
    difference = (mended.signals[0].missing - clean.signals[0].missing)[both[:, 1], 1]
    assert difference.std() < 0.05 * clean.signals[0].command[:, 1].std()
    held = position.copy()
    held[200:260, 1] = held[200, 1]  # three widths: nobody knows what it did meanwhile
    (signals,) = prepare([replace(takes[0], position=held)], arm(), kernel=0.02).signals
    time = signals.fine_time[signals.keep]
    hidden = (time > takes[0].time[200]) & (time < takes[0].time[259])
    assert not signals.valid[hidden].any()
