"""Takes on the grid of the physics are played at the speed at which they were recorded."""

import numpy as np
import pytest

from torchrl_athletic.identification import on_grid
from torchrl_athletic.recordings import Recording, RecordingError
from torchrl_athletic.robots import z1


def sine(time):
    return Recording(time, ("joint1",), np.sin(time)[:, None], torque_command=np.zeros((len(time), 1)))


def test_a_take_at_the_rate_of_the_physics_stays_as_it_is_whatever_little_its_stamps_jitter():
    time = np.arange(800) / 200
    time[10:790:20] += 1e-3
    np.testing.assert_array_equal(on_grid(sine(time), z1()).time, time)


def test_where_rows_were_lost_a_take_is_no_faster_for_it():
    time = np.arange(800) / 200
    fine = on_grid(sine(time[np.arange(800) % 20 != 7]), z1())  # the usual step is that of the physics
    assert np.diff(fine.time) == pytest.approx(0.005)
    assert np.abs(fine.velocity).max() == pytest.approx(1.0, abs=1e-3)


def test_a_gap_is_refused_at_the_rate_of_the_physics_too():
    time = np.arange(800) / 200
    with pytest.raises(RecordingError, match=r"nothing was logged between 1\.495 s and 2\.500 s"):
        on_grid(sine(np.delete(time, slice(300, 500))), z1())
