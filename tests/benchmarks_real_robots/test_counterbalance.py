"""The truth about a KR300's counterbalance, and what is told of it."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.integrate import quad

from benchmarks.real_robots.counterbalance import accumulator_torque, table
from torchrl_athletic.diagnosis.result import Answer, Estimate, Finding, Score


def test_the_accumulators_torque_is_what_its_gas_gives_up_as_work():
    """Isothermal gas: the work between two angles is p V ln of the ratio of volumes."""
    low, high = np.radians([10.0, 40.0])
    work, _ = quad(lambda q: float(accumulator_torque(np.array([q]))[0]), low, high)
    area = np.pi * (0.055**2 - 0.030**2) / 4

    def volume(q: float) -> float:
        length = np.sqrt(0.68 - 0.32 * np.cos(q + np.radians(5.0)))
        return 0.00096 - (length - 0.6) * area

    assert work == pytest.approx(1.01 * 296.8 * 328 * 0.159 * np.log(volume(high) / volume(low)), rel=1e-6)
    assert accumulator_torque(np.radians([-5.0])) == pytest.approx([0.0], abs=1e-9)


def test_a_spring_is_told_beside_the_truth_and_its_lack_as_well():
    position = np.radians(np.linspace(-20, 29, 50))
    parameters = {
        "stiffness": Estimate(5700.0, (4000.0, 7800.0), "N·m/rad"),
        "preload": Estimate(-1.0, (-2.0, 0.0), "N·m"),
    }
    spring = Finding("joint_spring", "axis_2", 0.6, "A spring.", parameters, "everywhere", class_probability=0.9)
    fit = {"heldout": Score(2.0, 0.03, 1e-4, 0.99, {})}
    told = table(Answer("partly_explained", (), findings=(spring,), fit=fit), position, 12.0)
    truth = -np.polyfit(position, accumulator_torque(position), 1)[0]
    assert f"| stiffness [N·m/rad] | 5700 (4000 to 7800) | {truth:.0f} |" in told
    assert "| `joint_spring` | axis_2 | 60% | 90% |" in told
    assert "2000 mrad before, 30 after" in told
    assert "none was named" in table(Answer("partly_explained", (), fit=fit), position, 12.0)
