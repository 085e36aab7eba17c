"""What a gear's teeth give way by along a motion."""

import warnings

import numpy as np
import pytest

from torchrl_athletic.effects.gear import Spring, deflection

PERIOD, SAMPLES = 1e-3, 4000


def bent(spring: Spring, damping: float, inertia: float) -> np.ndarray:
    """Under a constant load of one, from rest without any."""
    load = np.ones((SAMPLES, 1))
    slopes = np.stack([np.full((SAMPLES, 1), x) for x in (0.0, damping, inertia)])
    return deflection(load, slopes, spring, PERIOD, np.zeros((2, 1)), None)


def test_under_a_constant_load_it_vibrates_about_the_load_over_its_stiffness_and_comes_to_rest_there():
    stiffness, inertia, damping = 50.0, 0.02, 0.4
    spring = Spring(np.array([stiffness]), np.array([0.0]), np.array([0.0]))
    x = bent(spring, damping, inertia)[0, :, 0]
    time, decay = PERIOD * np.arange(SAMPLES), damping / (2 * inertia)
    ringing = np.sqrt(stiffness / inertia - decay**2)
    closed = (
        1 - np.exp(-decay * time) * (np.cos(ringing * time) + decay / ringing * np.sin(ringing * time))
    ) / stiffness
    assert x[-1] == pytest.approx(1 / stiffness, rel=1e-3)
    quickest = 1 / np.sqrt(stiffness * inertia)
    np.testing.assert_allclose(x, closed, atol=quickest * PERIOD / 2)  # a leapfrog from rest is half a step ahead


def test_one_that_diverges_says_nothing_and_is_not_finite():
    """Nobody takes it: the bank passes over columns that are not finite."""
    spring = Spring(np.array([50.0]), np.array([0.0]), np.array([0.0]))
    with warnings.catch_warnings(action="error"):
        assert not np.isfinite(bent(spring, -40.0, 0.02)).all()
