"""What is wrong with a take is found, what is right is left alone, and every masked sample is counted."""

import json
from dataclasses import replace

import numpy as np
import pytest

from torchrl_athletic.recordings import Recording, RecordingError, check_quality
from torchrl_athletic.recordings.datasets import load_dataset
from torchrl_athletic.recordings.mixed_up import target_doubts

RATE = 200.0


def swing(time=None, **fields):
    """A joint that swings by 1.2 rad with a little noise, driven by a sine of 3 N·m."""
    time = np.arange(2000) / RATE if time is None else time
    rng = np.random.default_rng(0)
    given = {
        "position": (1.2 * np.sin(5 * time) + rng.normal(0, 1e-4, len(time)))[:, None],
        "velocity": (6.0 * np.cos(5 * time) + rng.normal(0, 2e-3, len(time)))[:, None],
        "torque_command": 3.0 * np.sin(5 * time)[:, None],
        **fields,
    }
    return Recording(time=time, joint_names=("hinge",), **given)


def changed(recording, name, rows, value):
    values = np.array(getattr(recording, name))
    values[rows] = value
    return replace(recording, **{name: values})


def test_a_clean_take_is_left_alone():
    quality = check_quality(swing(), torque_limit=5.0)
    assert quality.usable().all()
    assert quality.warnings == ()
    assert quality.rate == pytest.approx(RATE)
    assert quality.velocity_scale == pytest.approx((1.0,), abs=0.01)
    assert quality.velocity_shift == pytest.approx((0.0,), abs=2e-4)


def test_the_report_is_json_and_counts_what_usable_leaves_out():
    dirty = changed(swing(), "position", slice(500, 503), -3.0)
    quality = check_quality(dirty, torque_limit=2.9)
    report = json.loads(json.dumps(quality.report()))
    assert {"source", "rate", "duration", "masked", "warnings"} <= set(report)
    assert report["masked"]["dropout"] == 3
    assert report["masked"]["saturated"] == (np.abs(dirty.torque_command) >= 2.9 * 0.999).sum() > 100
    masked = np.any([quality.masks[reason] for reason in ("dropout", "saturated")], axis=0)
    assert (~quality.usable() == masked).all()
    assert quality.usable(ignore=("saturated",)).sum() == 2000 - 3
    with pytest.raises(ValueError, match=r"\['satturated'\] is no reason"):
        quality.usable(ignore=("satturated",))


# --- stamps -----------------------------------------------------------------------------------------------------------


def test_under_30_hz_is_refused_and_under_100_hz_is_warned_of():
    with pytest.raises(RecordingError, match=r"memory: sampled at 25\.0 Hz .* Log at 200 Hz"):
        check_quality(swing(np.arange(200) / 25))
    assert "sampled at 30.0 Hz" in check_quality(swing(np.arange(300) / 30)).warnings[0]
    assert "sampled at 99.0 Hz" in check_quality(swing(np.arange(300) / 99)).warnings[0]
    assert check_quality(swing(np.arange(300) / 100)).warnings == ()


@pytest.mark.parametrize(("unit", "said"), [(1000.0, True), (1.0, False)])
def test_where_time_counts_milliseconds_the_velocities_tell(unit, said):
    """A clock that is off by a thousand is not slow logging: the mend is another one."""
    take = swing(np.arange(300) / (20.0 if unit == 1.0 else RATE))
    with pytest.raises(RecordingError) as caught:
        check_quality(replace(take, time=unit * take.time))
    assert (f"by the logged velocities a sample lasts {1e3 / RATE:.3g} ms" in str(caught.value)) == said
    with pytest.raises(RecordingError) as caught:
        check_quality(replace(take, time=unit * take.time, velocity=None))
    assert "logged velocities" not in str(caught.value)


def test_joints_that_never_move_are_named_together():
    still = np.zeros((2000, 3))
    still[:, 1] = swing().position[:, 0]
    take = Recording(swing().time, ("pan", "hinge", "tilt"), still, torque_command=np.zeros((2000, 3)))
    warnings = [w for w in check_quality(take).warnings if "never move" in w]
    assert warnings == ["memory: pan, tilt never move. Nothing can be said about them from this take."]


def test_jitter_is_measured():
    rng = np.random.default_rng(0)
    time = (np.arange(4000) + 0.4 * rng.uniform(-0.5, 0.5, 4000)) / RATE  # steps off by up to 40 %, triangular
    quality = check_quality(swing(time))
    assert quality.jitter["0.5"] == pytest.approx(0.4 * (1 - np.sqrt(0.5)), rel=0.05)
    assert quality.jitter["1"] < 0.45
    assert "one step in twenty is off by 3" in quality.warnings[0]


def test_gaps_are_named_with_time_and_length_and_lost_samples_are_counted():
    kept = np.ones(2000, dtype=bool)
    kept[300:330] = kept[800:803] = kept[1200] = False
    quality = check_quality(swing(np.arange(2000)[kept] / RATE))
    assert [(gap.row, round(gap.time, 6), round(gap.length, 6)) for gap in quality.gaps] == [(299, 1.495, 0.155)]
    assert quality.lost_samples == 34
    assert np.flatnonzero(quality.masks["gap"][:, 0]).tolist() == [299, 300]
    assert "0.155 s after 1.495 s (row 299)" in quality.warnings[0]


def test_stamps_that_come_late_are_no_lost_samples():
    time = np.arange(2000) / RATE
    time[10:1990:20] += 0.7 / RATE
    quality = check_quality(swing(time))
    assert quality.lost_samples == 0
    assert not any("missing" in text for text in quality.warnings)
    kept = np.ones(2000, dtype=bool)
    kept[500:1500:25] = False
    assert "40 of 2000 samples are missing" in check_quality(swing(time[kept])).warnings[-1]


def commanded(kept: np.ndarray, command: np.ndarray) -> Recording:
    time = np.arange(len(kept))[kept] / RATE
    return swing(time, torque_command=command[kept, None])


def test_what_was_commanded_while_rows_were_lost_is_not_known():
    kept = np.ones(2000, dtype=bool)
    kept[700:703] = kept[1200] = False
    quality = check_quality(commanded(kept, np.sin(np.arange(2000) / 10)))
    assert np.flatnonzero(quality.masks["lost"][:, 0]).tolist() == [699, 700, 1196, 1197]
    assert (~quality.usable()[:, 0]).sum() == 4
    held = check_quality(commanded(kept, np.repeat([0.0, 1.0], 1000)))
    assert not held.masks["lost"].any()  # nothing happened meanwhile


@pytest.mark.parametrize("lost", [0.003, 0.01, 0.03, 0.1, 0.3])
def test_a_logger_that_loses_many_rows_leaves_enough_to_ask_about(lost):
    rng = np.random.default_rng(0)
    kept = rng.random(6000) > lost
    kept[:1] = True
    mask = check_quality(commanded(kept, np.sin(np.arange(6000) / 5))).masks["lost"][:, 0]
    assert 0 < mask.sum() <= 2 * (1 + 30 / 3)


@pytest.mark.parametrize("jitter", [0.1, 0.2, 0.3])
def test_a_stamp_that_came_late_is_no_lost_row(jitter):
    rng = np.random.default_rng(0)
    time = np.sort(np.arange(6000) + jitter * rng.uniform(-1, 1, 6000)) / RATE
    recording = swing(time, torque_command=np.sin(np.arange(6000) / 5)[:, None])
    assert check_quality(recording).masks["lost"][:, 0].mean() < 0.005


# --- masks ------------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("columns", ["position and velocity", "position alone", "held position, zero velocity"])
def test_a_logger_that_repeats_old_readings_is_caught(columns):
    take = swing()
    rows = np.arange(380, 388)  # 5 t = 9.5: fast
    take = changed(take, "position", rows, take.position[379])
    if columns == "position and velocity":
        take = changed(take, "velocity", rows, take.velocity[379])
    elif columns == "position alone":
        take = replace(take, velocity=None)
    else:
        take = changed(take, "velocity", rows, 0.0)
    assert np.flatnonzero(check_quality(take).masks["frozen"][:, 0]).tolist() == rows.tolist()


def test_a_log_that_freezes_to_its_end_is_caught():
    take = swing()
    for name in ("position", "velocity"):
        take = changed(take, name, slice(1901, None), getattr(take, name)[1900])
    assert np.flatnonzero(check_quality(take).masks["frozen"][:, 0]).tolist() == list(range(1901, 2000))


def test_repeated_readings_of_a_coarse_encoder_are_not_frozen():
    take = swing()
    coarse = 0.01 * np.round(take.position / 0.01)
    repeated = (np.diff(coarse[:, 0]) == 0).mean()
    assert repeated > 0.1
    for velocity in (take.velocity, 0.05 * np.round(take.velocity / 0.05), None):
        assert not check_quality(replace(take, position=coarse, velocity=velocity)).masks["frozen"].any()


def test_a_joint_that_pauses_and_goes_on_is_not_frozen():
    travelled = np.cumsum(np.where(np.arange(2000) % 300 < 200, 0.02, 0.0))  # stick-slip: nothing to catch up with
    take = swing(position=0.001 * np.round(travelled / 0.001)[:, None], velocity=None)
    assert not check_quality(take).masks["frozen"].any()


def test_a_velocity_that_does_not_come_to_zero_freezes_nothing():
    travelled = np.cumsum(np.where(np.arange(2000) % 300 < 200, 0.02, 0.0))
    moving = np.diff(travelled, append=travelled[-1]) > 0
    velocity = np.where(moving, 4.0 + np.random.default_rng(0).normal(0, 1e-3, 2000), 0.5)
    take = swing(position=travelled[:, None], velocity=velocity[:, None])
    assert not check_quality(take).masks["frozen"][:1790].any()


def test_one_reading_of_thousands_that_jumps_is_counted_and_not_said_to_be_no_share():
    take = swing(np.arange(4000) / RATE)
    assert "hinge: 1 of the samples jump away" in check_quality(changed(take, "position", 62, 40.0)).warnings[0]


@pytest.mark.parametrize(("name", "value"), [("position", 0.0), ("position", 40.0), ("velocity", 0.0)])
@pytest.mark.parametrize("length", [1, 3])
def test_readings_that_jump_away_and_back_are_dropouts(name, value, length):
    start = 378 if name == "velocity" else 62  # far from zero
    take = changed(swing(), name, slice(start, start + length), value)
    assert np.flatnonzero(check_quality(take).masks["dropout"][:, 0]).tolist() == list(range(start, start + length))


def test_saturation_needs_a_limit_or_a_measurement_that_is_clipped_flat():
    take = swing(torque_measured=np.clip(3 * np.sin(5 * np.arange(2000) / RATE), -2, 2.5)[:, None],
                 torque_semantics="link_side")  # fmt: skip
    flat = (take.torque_measured == 2.5) | (take.torque_measured == -2)
    assert (check_quality(take).masks["saturated"] == flat).all()
    per_joint = check_quality(replace(swing(), joint_names=("hinge",)), torque_limit=[2.0])
    assert (per_joint.masks["saturated"] == (np.abs(swing().torque_command) >= 2.0 * 0.999)).all()


def test_the_torque_that_a_position_target_asks_for_saturates():
    target = 1.2 * np.sin(5 * np.arange(2000) / RATE)[:, None] + 0.3
    take = replace(swing(), torque_command=None, position_target=target, kp=[10.0], kd=[0.5])
    asked = 10.0 * (target - take.position) - 0.5 * take.velocity
    assert 0.1 < (np.abs(asked) >= 5.0).mean() < 0.9
    assert (check_quality(take, torque_limit=5.0).masks["saturated"] == (np.abs(asked) >= 5.0 * 0.999)).all()


def test_flat_tops_ask_for_a_limit_in_the_model_unless_one_is_known():
    time = swing().time
    take = swing(torque_command=np.clip(3 * np.sin(5 * time), -2, 2)[:, None])
    [said] = [w for w in check_quality(take).warnings if "flat tops" in w]
    assert said.endswith("state its limit in the model, as the joint's actuatorfrcrange.")
    assert not any("flat tops" in w for w in check_quality(take, torque_limit=2.0).warnings)


def test_flat_tops_of_a_command_are_told_apart_from_square_waves_and_holds():
    time = np.arange(2000) / RATE
    clipped = np.clip(3 * np.sin(5 * time), -2, 2)[:, None]
    quality = check_quality(swing(torque_command=clipped))
    assert (quality.masks["clipped"] == (np.abs(clipped) == 2)).all()
    assert quality.usable().all()  # what was sent did act
    assert not quality.usable(ignore=())[np.abs(clipped) == 2].any()
    held = np.repeat(np.random.default_rng(0).normal(size=50), 40)
    for torque in (3 * np.sign(np.sin(5 * time)), held, 3 * np.sin(5 * time)):
        assert not check_quality(swing(torque_command=torque[:, None])).masks["clipped"].any()


def push(torque, friction=0.0, low=-np.inf, high=np.inf, static=None, rate=RATE):
    """A mass of 0.1 with dry friction between two stops, under a held torque: semi-implicit Euler."""
    static = friction if static is None else static
    position, speed, positions = 0.0, 0.0, []
    step = 1 / rate / 20
    for u in torque:
        positions.append(position)
        for _ in range(20):
            if speed == 0.0 and abs(u) <= static:
                continue
            way = np.sign(speed) if speed else np.sign(u)
            faster = speed + step * (u - friction * way - 0.5 * speed) / 0.1
            speed = 0.0 if speed and faster * speed < 0 else faster
            position += step * speed
            if not low <= position <= high:
                position, speed = min(max(position, low), high), 0.0
    time = np.arange(len(torque)) / rate
    noise = np.random.default_rng(0).normal(0, 1e-4, len(time))
    return Recording(time, ("hinge",), (np.array(positions) + noise)[:, None], torque_command=torque[:, None])


@pytest.mark.parametrize("wave", ["sine", "square"])
def test_pushing_against_a_stop_is_a_stall(wave):
    time = np.arange(3000) / RATE
    torque = 2.0 * np.sin(2 * np.pi * 0.4 * time)
    torque = torque if wave == "sine" else 2.0 * np.sign(torque + 1e-9)
    take = push(torque, friction=0.2, low=-0.5, high=0.4)
    stalled = check_quality(take).masks["stalled"][:, 0]
    resting = (np.abs(take.position[:, 0] - 0.4) < 1e-3) | (np.abs(take.position[:, 0] + 0.5) < 1e-3)
    outward = torque * take.position[:, 0] > 0
    assert not stalled[~resting | ~outward].any()
    assert stalled[resting & outward].mean() > 0.95


@pytest.mark.parametrize(("friction", "static"), [(0.5, 0.5), (1.0, 1.0), (1.2, 1.8), (1.7, 1.7)])
@pytest.mark.parametrize("wave", ["sine", "square", "growing sine"])
def test_sticking_in_friction_is_not_a_stall(friction, static, wave):
    time = np.arange(3000) / RATE
    torque = 2.0 * np.sin(2 * np.pi * 0.4 * time)
    torque = {"sine": torque, "square": 2.0 * np.sign(torque + 1e-9), "growing sine": torque * time / time[-1]}[wave]
    take = push(torque, friction, static=static)
    still = np.abs(np.gradient(take.position[:, 0], time)) < 0.03
    assert still.mean() > 0.05 or wave == "square"
    assert not check_quality(take).masks["stalled"].any()


def test_holding_a_load_is_not_a_stall():
    time = np.arange(2000) / RATE
    rise = np.clip(time / 4, 0, 1)
    angle = 1.3 * (3 * rise**2 - 2 * rise**3)
    load = 8.0 * np.sin(angle) + 0.5 * (rise < 1)
    noise = np.random.default_rng(0).normal(0, 1e-4, 2000)
    take = Recording(time, ("elbow",), (angle + noise)[:, None], torque_command=load[:, None])
    assert not check_quality(take).masks["stalled"].any()


def test_a_joint_that_rests_at_the_torque_limit_is_stalled_and_one_that_never_moves_is_named():
    time = np.arange(2000) / RATE
    torque = np.clip(2 * time, 0, 6)
    take = push(torque, friction=0.2, high=0.4)
    quality = check_quality(take, torque_limit=6.0)
    assert (quality.masks["stalled"][:, 0] == (torque >= 6.0 * 0.999)).mean() > 0.99
    blocked = check_quality(push(torque, static=9.0, friction=9.0))
    assert not blocked.masks["stalled"].any()
    assert "hinge never moves" in blocked.warnings[0]


# --- units and alignment ----------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("factor", "words"),
    [
        (180 / np.pi, "degrees/s against rad"),
        (np.pi / 180, "rad/s against degrees"),
        (30 / np.pi, "rev/min against rad"),
        (9.0, "rev/min against rad"),  # within a tenth of it
        (6.0, "a gear ratio or a unit"),
        (-1.0, "the other sign"),
        (-180 / np.pi, "degrees/s against rad"),
    ],
)
def test_a_velocity_in_another_unit_is_named(factor, words):
    take = swing()
    quality = check_quality(replace(take, velocity=factor * take.velocity))
    assert quality.velocity_scale == pytest.approx((factor,), rel=0.01)
    assert any(words in warning and "hinge" in warning for warning in quality.warnings)
    assert check_quality(take).warnings == ()


def test_positions_in_degrees_or_with_jumps_of_a_turn_are_named():
    take = swing()
    degrees = replace(take, position=np.degrees(take.position), velocity=np.degrees(take.velocity))
    assert "looks like degrees" in check_quality(degrees).warnings[0]
    turning = 3.0 * np.arange(2000) / RATE
    wrapped = replace(take, position=((turning + np.pi) % (2 * np.pi) - np.pi)[:, None], velocity=None)
    assert "jumps 5 times, by 6.27. Unwrap it" in check_quality(wrapped).warnings[0]


@pytest.mark.parametrize("late", [-0.0123, 0.004, 0.0207])
def test_a_late_velocity_is_measured(late):
    time = np.arange(4000) / RATE
    take = swing(
        time,
        position=(np.sin(5 * time) + 0.3 * np.sin(13 * time))[:, None],
        velocity=(5 * np.cos(5 * (time - late)) + 3.9 * np.cos(13 * (time - late)))[:, None],
        torque_command=np.sin(time)[:, None],
    )
    quality = check_quality(take)
    assert quality.velocity_shift == pytest.approx((late,), abs=3e-4)
    said = f"{1e3 * abs(late):.1f} ms {'late' if late > 0 else 'early'} against its position"
    assert any(said in w for w in quality.warnings) == (abs(late) > 0.0075)


@pytest.mark.parametrize("late", [0.0, 0.01, 0.035])
def test_a_late_torque_is_measured(late):
    time = np.arange(4000) / RATE
    noise = np.random.default_rng(0).normal(size=4000)
    torque = np.convolve(noise, np.hanning(41), mode="same")
    measured = np.interp(time - late, time, torque)
    take = swing(time, torque_command=torque[:, None], torque_measured=measured[:, None], torque_semantics="link_side")
    quality = check_quality(take)
    assert quality.command_shift_of == "torque_measured"
    assert quality.command_shift == pytest.approx((late,), abs=5e-4)


@pytest.mark.parametrize("late", [0.0, 0.02])
def test_a_held_torque_on_a_free_mass_answers_without_half_a_sample_of_delay(late):
    time = np.arange(4000) / RATE
    torque = np.convolve(np.random.default_rng(0).normal(size=4000), np.hanning(41), mode="same")
    acting = np.roll(torque, round(late * RATE))
    speed = np.concatenate(([0.0], np.cumsum(acting)[:-1])) / RATE  # exact for a held force on a unit mass
    position = np.concatenate(([0.0], np.cumsum(speed + acting / RATE / 2)[:-1])) / RATE
    take = Recording(time, ("slide",), position[:, None], torque_command=torque[:, None])
    quality = check_quality(take)
    assert quality.command_shift_of == "acceleration"
    assert quality.command_shift == pytest.approx((late,), abs=5e-4)


def test_what_does_not_follow_has_no_delay():
    rng = np.random.default_rng(0)
    quality = check_quality(swing(torque_command=rng.normal(size=(2000, 1)), velocity=rng.normal(size=(2000, 1))))
    assert quality.command_shift == quality.velocity_scale == quality.velocity_shift == (None,)


@pytest.mark.parametrize("limit", [0.0, -1.0, [1.0, 2.0], float("nan")])
def test_an_impossible_limit_is_refused(limit):
    with pytest.raises(RecordingError, match=r"torque_limit is .* one for each of the joints hinge"):
        check_quality(swing(), torque_limit=limit)


# --- real recordings --------------------------------------------------------------------------------------------------


@pytest.mark.usefixtures("real_recordings")
def test_the_arm_is_clean_and_its_drives_follow_late():
    for take in load_dataset("two_link_arm").recordings:
        quality = check_quality(take)
        assert quality.usable()[2:].all()  # its loop starts with steps of up to 1.8 periods
        assert quality.warnings == ()
        assert quality.velocity_scale == pytest.approx((1.0, 1.0), abs=0.01)
        assert quality.velocity_shift == pytest.approx((0.001, 0.001), abs=1e-4)
        assert 0.010 < quality.command_shift[1] < 0.035


@pytest.mark.usefixtures("real_recordings")
def test_the_slow_disk_is_warned_of_and_the_slider_is_not():
    disk = check_quality(load_dataset("unbalanced_disk").recordings[0])
    assert disk.rate == pytest.approx(40)
    assert "sampled at 40.0 Hz" in disk.warnings[0]
    data = load_dataset("emps")
    for take in data.recordings + data.heldout:
        quality = check_quality(take)
        assert quality.rate == pytest.approx(1000, rel=1e-3)
        assert quality.usable().all()


@pytest.mark.usefixtures("real_recordings")
def test_the_servo_sticks_but_is_not_stalled_and_its_velocity_is_20_ms_late():
    shifts = []
    for take in load_dataset("xl330").recordings:
        quality = check_quality(take)
        assert not quality.masks["stalled"].any(), take.source
        shifts += quality.velocity_shift
    assert np.median(shifts) == pytest.approx(0.020, abs=5e-4)


def followed(position, target):
    """A joint follows each target a tenth of a second late."""
    time = np.arange(500) / 100
    names = tuple(f"joint{k}" for k in range(position(time).shape[1]))
    gains = np.full(len(names), 10.0)
    return Recording(time, names, position(time - 0.1), position_target=target(time), kp=gains, kd=gains / 10)


def three(time):
    return np.stack([0.4 + 0.3 * np.sin(2 * time), np.cos(3 * time), 0.2 * np.sin(5 * time) - 1.0], 1)


def test_targets_that_are_followed_are_in_order():
    assert not check_quality(followed(three, three)).warnings


@pytest.mark.parametrize("joint", range(3))
def test_a_target_of_the_other_sign_is_found(joint):
    signs = np.where(np.arange(3) == joint, -1.0, 1.0)
    (text,) = check_quality(followed(three, lambda t: signs * three(t))).warnings
    assert f"the position of joint{joint} follows its position_target with the other sign" in text


def test_targets_at_other_joints_are_found():
    (text,) = check_quality(followed(three, lambda t: three(t)[:, [1, 2, 0]])).warnings
    assert "position_target columns look exchanged" in text
    assert "joint0's follows the motion of joint1" in text


def wave(size, about, speed=2.0):
    return lambda t: (about + size * np.sin(speed * t))[:, None]


@pytest.mark.parametrize(
    ("position", "target"),
    [
        (lambda t: 0.2 * three(t), three),  # a weak drive
        (wave(0.01, -0.06), wave(0.01, 0.05)),  # it sags
        (wave(0.0, -0.2), wave(0.0, 0.3)),  # it only holds
        (wave(-0.2, 0.0, 6.0), wave(0.6, 0.0, 6.0)),  # a soft servo beyond its resonance
    ],
)
def test_a_joint_that_does_not_follow_its_target_well_is_no_mistake_of_the_log(position, target):
    take = followed(position, target)
    assert not target_doubts(take, np.full(take.num_joints, 1e-4))


def test_two_joints_that_hold_beside_their_targets_are_not_exchanged():
    def held(*values):
        return lambda t: np.array(values) + 1e-5 * np.sin(np.outer(t, (1.0, 2.0)))

    assert not target_doubts(followed(held(0.25, 0.1), held(0.1, 0.3)), np.full(2, 1e-4))


def test_stale_targets_of_a_motor_that_is_off_say_nothing():
    take = followed(three, lambda t: -three(t))
    assert target_doubts(take, np.full(3, 1e-4))
    assert not target_doubts(replace(take, kp=np.zeros(3)), np.full(3, 1e-4))
