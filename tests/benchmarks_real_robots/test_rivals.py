"""The rivals: a least squares by hand finds what is concealed, also what the given model has none of."""

from __future__ import annotations

import mujoco
import numpy as np
import pytest

from benchmarks.real_robots.replay import NAMES, Replay
from benchmarks.real_robots.rivals import by_hand
from benchmarks.real_robots.robots.robot import Robot
from torchrl_athletic.recordings import Recording
from torchrl_athletic.robots.benches import pendulum

STEP = 0.002


@pytest.fixture(scope="module")
def late() -> Replay:
    """A pendulum with dry friction whose torque comes 12 ms late and 0.1 N·m too high; the given model has none."""
    model = mujoco.MjModel.from_xml_string(pendulum(frictionloss=0.15))
    data = mujoco.MjData(model)
    data.qpos[0] = 0.4
    model.opt.timestep = STEP
    time = STEP * np.arange(2000)
    torque, position = np.sin(5 * time) + 0.7 * np.sin(11 * time), np.empty_like(time)
    for k in range(len(time)):
        position[k] = data.qpos[0]
        data.ctrl[0] = torque[max(k - 6, 0)] + 0.1
        mujoco.mj_step(model, data)
    take = Recording(time, ("pendulum",), position[:, None], torque_command=torque[:, None], source="late")
    return Replay(Robot(pendulum(), [take], [], "no"), [take]).with_windows(20)


def test_a_fit_by_hand_moves_what_starts_at_nothing(late):
    names = ("frictionloss", "delay", "offset")
    found = dict(zip(NAMES, by_hand(late, names), strict=True))
    assert found["frictionloss"][0] == pytest.approx(0.15, rel=0.05)
    assert found["delay"][0] == pytest.approx(6 * STEP, abs=0.5 * STEP)
    assert found["offset"][0] == pytest.approx(0.1, rel=0.05)
    assert found["armature"] == late.nominal()[NAMES.index("armature")]  # what is not asked for stays
