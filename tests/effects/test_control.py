import numpy as np
import pytest
from effects.arm import KD, KP, arm, record
from effects.slider import MASS, STEP, push
from scipy.signal import lti, step

from torchrl_athletic.effects import GainMismatch, project_recording


@pytest.mark.parametrize(("kp_scale", "kd_scale"), [(1.0, 1.0), (1.6, 1.0), (1.0, 0.4), (0.5, 2.0)])
def test_a_servo_answers_a_step_with_its_true_gains(kp_scale, kd_scale):
    kp, kd = 80.0, 6.0
    (position,) = push(np.full(1500, 0.05), (GainMismatch(), [kp_scale, kd_scale]), servo=(kp, kd))
    time = STEP * np.arange(1, 1501)
    k, c = kp * kp_scale, kd * kd_scale
    exact = 0.05 * step(lti([k], [MASS, c, k]), T=np.append(0, time))[1][1:]
    np.testing.assert_allclose(position, exact, atol=0.015 * 0.05)


def test_only_a_servos_recording_can_show_it():
    torque, target = (
        project_recording(record(position_control=p, seconds=2.0), arm(), np.zeros(2)) for p in (False, True)
    )
    assert not GainMismatch().applies(torque)
    assert GainMismatch().applies(target)


def test_the_columns_are_the_proportional_and_the_derivative_torque():
    s = project_recording(record(position_control=True, seconds=3.0), arm(), np.zeros(2))
    columns = GainMismatch().fingerprint(s, 1, {}).columns
    np.testing.assert_allclose(columns[:, 1].sum(-1), s.command[:, 1], atol=1e-12)
    np.testing.assert_allclose(columns[:, 1, 1], -KD[1] * s.velocity[:, 1], atol=1e-12)
    target = s.project_command(s.raw_command())[:, 1]
    np.testing.assert_allclose(columns[:, 1, 0], KP[1] * (target - s.position[:, 1]), atol=1e-12)
    assert not columns[:, 0].any()
