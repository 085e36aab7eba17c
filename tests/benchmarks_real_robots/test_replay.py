"""The neutral judge: where its windows begin, what drives them, and that the corrected simulation is judged alike."""

from __future__ import annotations

import mujoco
import numpy as np
import pytest

from benchmarks.real_robots import replay as module
from benchmarks.real_robots.replay import NAMES, Replay, smoothed_samples
from benchmarks.real_robots.robots.robot import Robot
from torchrl_athletic.diagnosis.corrected import Simulation
from torchrl_athletic.diagnosis.fit import Hypothesis
from torchrl_athletic.recordings import Recording
from torchrl_athletic.robots.benches import pendulum

PERIOD = 0.002


def swing(seconds: float = 2.1, friction: float = 0.0, gap: float = 0.0, until: float = 0.0) -> tuple[Robot, Recording]:
    """A pendulum that is driven by a sine from an angle, and its recording; a gap may follow ``until``."""
    xml = pendulum(frictionloss=friction)
    model = mujoco.MjModel.from_xml_string(xml)
    data = mujoco.MjData(model)
    data.qpos[0] = 0.4
    time = PERIOD * np.arange(round(seconds / PERIOD) + 1)
    torque, position = 1.0 + np.sin(5 * time), np.empty_like(time)
    for k, u in enumerate(torque):
        position[k] = data.qpos[0]
        data.ctrl[0] = u
        mujoco.mj_step(model, data, nstep=2)
    kept = (time <= until) | (time > until + gap) if gap else np.ones(len(time), dtype=bool)
    take = Recording(time[kept], ("pendulum",), position[kept, None], torque_command=torque[kept, None], source="swing")
    return Robot(pendulum(), [take], [], "no"), take


def test_windows_begin_where_both_sides_are_smoothed_and_follow_each_other(monkeypatch):
    monkeypatch.setattr(module, "ENOUGH", 1)
    robot, take = swing()
    replay = Replay(robot, [take])
    assert [w.first for w in replay.windows] == [5, 255, 505, 755]
    assert all(len(w.measured) == 250 for w in replay.windows)
    for w in replay.windows:
        np.testing.assert_allclose(w.measured, take.position[w.first + 1 : w.first + 251], atol=1e-9)
        assert w.v[0] == pytest.approx(np.gradient(take.position[:, 0], PERIOD)[w.first], abs=0.02)


def test_few_windows_overlap_until_there_are_enough(monkeypatch):
    """Four back to back; ten are asked for, so that there are three times as many."""
    monkeypatch.setattr(module, "ENOUGH", 10)
    robot, take = swing()
    replay = Replay(robot, [take])
    assert [w.first for w in replay.windows] == [5 + 83 * k for k in range(10)]
    assert all(len(w.measured) == 250 for w in replay.windows)


@pytest.mark.parametrize(("rate", "samples"), [(20, 5), (50, 5), (63, 7), (100, 11), (333, 11), (665, 15), (1000, 21)])
def test_windows_start_from_eleven_samples_within_a_tenth_and_a_fiftieth_of_a_second(rate: float, samples: int):
    assert smoothed_samples(1 / rate) == samples


def test_an_encoder_of_4096_steps_read_at_200_hz_starts_windows_within_a_tenth_of_its_speed():
    """Of five samples, a hundredth of a second each way, it would be off by a sixth."""
    time, step = 0.005 * np.arange(4000), 2 * np.pi / 4096
    true = 0.3 * np.sin(2.5 * time)
    read = step * np.round(true / step)
    robot, _ = swing()
    take = Recording(time, ("pendulum",), read[:, None], torque_command=0 * read[:, None], source="sine")
    windows = Replay(robot, [take]).windows
    speed = 0.75 * np.cos(2.5 * time[[w.first for w in windows]])
    found = np.array([w.v[0] for w in windows])
    assert np.sqrt(np.mean((found - speed) ** 2)) < 0.1 * np.sqrt(np.mean(speed**2))


def test_a_late_command_is_the_first_one_as_long_as_the_log_has_none():
    robot, take = swing()
    replay = Replay(robot, [take])
    window, late = replay.windows[0], np.array([0.05])
    command = replay.control(window, late)[:, 0]
    before = window.edges[1:] - 0.05 <= take.time[0]
    assert before.sum() > 30
    np.testing.assert_allclose(command[before], take.command[0, 0], rtol=1e-6)
    at = window.edges[:-1] - 0.05
    np.testing.assert_allclose(command[~before], (1 + np.sin(5 * at))[~before], atol=0.02)


@pytest.mark.parametrize("friction", [0.0, 0.2])
def test_the_judge_and_the_corrected_simulation_agree_and_truth_leaves_no_error(friction):
    """With friction concealed, its value gives the error of rounding and the given model a large one."""
    robot, take = swing(friction=friction)
    replay = Replay(robot, [take])
    x = replay.nominal()
    given = np.sqrt(replay.mean_square(x))
    model = mujoco.MjModel.from_xml_string(robot.xml)
    corrected = Simulation(model, ("pendulum",), Hypothesis(()), np.zeros(0))
    np.testing.assert_allclose(np.sqrt(replay.mean_square_of(corrected)), given, atol=3e-3)
    x[NAMES.index("frictionloss")] = friction
    assert np.sqrt(replay.mean_square(x)).max() < 3e-3
    assert bool(given.min() > 0.01) is (friction > 0)


def test_each_part_beside_a_gap_begins_anew_and_a_short_one_has_no_window(monkeypatch):
    monkeypatch.setattr(module, "ENOUGH", 1)
    robot, take = swing(3.0, gap=0.3, until=1.2)
    starts = [(w.recording.time[0] + PERIOD * w.first) for w in Replay(robot, [take]).windows]
    assert starts == pytest.approx([0.010, 0.510, 1.512, 2.012], abs=1e-6)
    robot, take = swing(2.1, gap=0.3, until=0.008)
    assert [w.recording.time[0] for w in Replay(robot, [take]).windows] == pytest.approx([0.31] * 3)
    robot, take = swing(0.4)
    with pytest.raises(ValueError, match=r"swing: no part of the logs holds a window of 0\.5 s"):
        Replay(robot, [take])
