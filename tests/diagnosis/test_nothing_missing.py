"""A right model is called right, whatever its sensors do; and physics outside the catalogue gets no confident name."""

from collections.abc import Callable

import numpy as np
import pytest
from numpy.typing import NDArray

from torchrl_athletic.diagnosis import diagnose
from torchrl_athletic.diagnosis.result import Answer
from torchrl_athletic.recordings import Recording
from torchrl_athletic.recordings.demo import (
    Robot,
    Sensors,
    excitation_for,
    machine_with,
    make_recordings,
    pendulum,
    simulate,
    slider,
    two_link_arm,
)

Array = NDArray[np.float64]

SENSORS = {
    "white noise": Sensors(),
    "noise with a memory of 10 samples": Sensors(correlation=0.9),
    "noise with a memory of 3 samples": Sensors(correlation=0.7),
    "an encoder of 12 bits": Sensors(position_noise=0.0, encoder_bits=12),
    "an encoder of 14 bits alone": Sensors(position_noise=0.0, encoder_bits=14, velocity_noise=None),
    "a loop that jitters": Sensors(loop_jitter=5e-4),
    "stamps that jitter": Sensors(stamp_jitter=2e-4),
    "drop-outs": Sensors(dropouts=0.03),
    "no velocity": Sensors(velocity_noise=None),
}
"""The robots' seeds are below 100; seeds from 3000 on served to find the reasons of false alarms."""


def answer_without_effects(robot: Robot, sensors: Sensors, seed: int, duration: float = 7.0) -> Answer:
    takes = make_recordings(robot, (), ("gaussian", "square"), seed, duration, sensors=sensors)
    heldout = make_recordings(robot, (), ("multisine",), seed + 1, duration, sensors=sensors)
    return diagnose(robot.model_xml, takes, heldout, seed=0).answer


def assert_nothing_missing(answer: Answer) -> None:
    assert answer.findings == ()
    assert answer.verdict == "nothing_missing"
    assert answer.unexplained_share == 0.0


def sensors_of(*default: str) -> list:
    """Those that the default run asks, and the others for -m slow."""
    return [pytest.param(name, marks=() if name in default else pytest.mark.slow) for name in SENSORS]


@pytest.mark.parametrize(  # white noise and 12 bits are asked of the arm, and a memory of 10 samples is worse than of 3
    "sensors",
    sensors_of("noise with a memory of 10 samples", "an encoder of 14 bits alone", "a loop that jitters",
               "stamps that jitter", "drop-outs", "no velocity"),
)  # fmt: skip
def test_a_right_model_of_a_pendulum_is_called_right(sensors):
    assert_nothing_missing(answer_without_effects(pendulum(), SENSORS[sensors], seed=71))


@pytest.mark.parametrize("sensors", ["white noise", "an encoder of 12 bits", "stamps that jitter"])
def test_a_right_model_of_an_arm_is_called_right(sensors):
    assert_nothing_missing(answer_without_effects(two_link_arm(), SENSORS[sensors], seed=81))


@pytest.mark.parametrize("sensors", sensors_of("white noise"))
def test_a_right_model_of_a_slider_is_called_right(sensors):
    assert_nothing_missing(answer_without_effects(slider(), SENSORS[sensors], seed=81))


@pytest.mark.slow
@pytest.mark.parametrize("seed", [83, 85, 87])
@pytest.mark.parametrize("sensors", SENSORS)
@pytest.mark.parametrize("robot", [pendulum(), slider(), two_link_arm()], ids=["pendulum", "slider", "arm"])
def test_right_models_are_called_right_on_more_seeds(robot, sensors, seed):
    assert_nothing_missing(answer_without_effects(robot, SENSORS[sensors], seed))


def pendulum_with(law: Callable[[Array, Array], Array], kind: str, seed: int, duration: float = 7.0) -> Recording:
    """A pendulum with another torque of position and velocity; its log holds the command alone.

    The torque is found by iteration: the motion that it causes has to be the motion that causes it.
    """
    robot, rng = pendulum(), np.random.default_rng(seed)
    command, notes = excitation_for(robot, kind, seed, duration)
    time, torque = np.arange(len(command)) / 200.0, np.zeros_like(command)
    for _ in range(60):
        q, v = simulate(machine_with(robot), time, command + torque, step=0.001)
        change = law(q, v) - torque
        if np.abs(change).max() < 1e-3 * np.abs(command).max():
            break
        torque = torque + 0.7 * change
    else:
        raise RuntimeError("the iteration did not settle")
    q, v = q + 1e-4 * rng.normal(size=q.shape), v + 5e-3 * rng.normal(size=v.shape)
    return Recording(time, robot.joint_names, q, velocity=v, torque_command=command, metadata=notes, source=kind)


@pytest.mark.slow  # the default run asks this of a drag in effects/test_own_effect.py
@pytest.mark.parametrize(
    "law",
    [
        pytest.param(
            lambda q, v: 0.4 * np.sign(q) * q**2 * np.abs(v), id="a push that grows with speed and deflection"
        ),
        pytest.param(lambda q, v: -0.06 * v * np.abs(v), id="a drag that grows with the square of the speed"),
    ],
)
def test_physics_outside_the_catalogue_is_not_explained_by_a_confident_wrong_name(law):
    takes = [pendulum_with(law, kind, 91) for kind in ("gaussian", "square")]
    answer = diagnose(pendulum().model_xml, takes, [pendulum_with(law, "multisine", 92)], seed=0).answer
    assert answer.verdict in ("unexplained", "partly_explained")
    assert answer.unexplained_share > 0.1
    assert all(f.probability < 0.9 for f in answer.findings)
