from dataclasses import replace

import mujoco
import numpy as np
import pytest
from effects.arm import JOINTS, RATE, arm, record, waves
from scipy.integrate import solve_ivp
from scipy.signal import lfilter

from torchrl_athletic.effects import JointAddress, Signals, project_recording
from torchrl_athletic.effects.signals import (
    KERNEL,
    QUICKEST,
    bristle,
    held_command,
    inertia_matrix,
    inverse_dynamics,
    kernel_for,
    presliding_width,
    torque_range,
)
from torchrl_athletic.recordings import Recording, RecordingError, noise_correlation, sensor_noise

MASS, LEVER, INERTIA, DAMPING = 1.3, 0.25, 0.04, 0.07
PENDULUM = f"""
<mujoco><worldbody><body><joint name="hinge" axis="0 1 0" damping="{DAMPING}"/>
  <inertial pos="0 0 {-LEVER}" mass="{MASS}" diaginertia="{INERTIA} {INERTIA} {INERTIA}"/></body></worldbody>
</mujoco>"""


def pendulum() -> mujoco.MjModel:
    return mujoco.MjModel.from_xml_string(PENDULUM)


def take(time, position, torque=None, **fields) -> Recording:
    position = position.reshape(len(time), -1)
    torque = np.zeros_like(position) if torque is None else torque.reshape(len(time), -1)
    names = ("hinge",) if position.shape[1] == 1 else JOINTS
    return Recording(time, names, position, torque_command=torque, **fields)


def project(recording: Recording, kernel: float = 0.02, **options) -> Signals:
    return project_recording(recording, pendulum(), np.zeros(1), kernel=kernel, **options)


TIME = np.arange(0.0, 6.0, 0.005)


@pytest.mark.parametrize("kernel", [0.01, 0.025, 0.04])
@pytest.mark.parametrize("frequency", [0.5, 3.0])
def test_a_sine_comes_out_as_the_gaussian_attenuates_it(kernel, frequency):
    omega = 2 * np.pi * frequency
    s = project(take(TIME, np.sin(omega * TIME)), kernel)
    left = np.exp(-((omega * kernel) ** 2) / 2)
    for got, exact in (
        (s.position, np.sin(omega * s.time)),
        (s.velocity, omega * np.cos(omega * s.time)),
        (s.acceleration, -(omega**2) * np.sin(omega * s.time)),
    ):
        np.testing.assert_allclose(got[:, 0], left * exact, atol=2e-3 * np.abs(exact).max())


def test_a_parabola_keeps_its_slope_and_curvature():
    s = project(take(TIME, 0.3 - 0.2 * TIME + 0.5 * TIME**2), kernel=0.03)
    np.testing.assert_allclose(s.position[:, 0], 0.3 - 0.2 * s.time + 0.5 * (s.time**2 + 0.03**2), atol=1e-6)
    np.testing.assert_allclose(s.velocity[:, 0], -0.2 + s.time, atol=1e-4)
    np.testing.assert_allclose(s.acceleration[:, 0], 1.0, rtol=1e-3)


@pytest.mark.parametrize("kernel", [0.003, 0.006, 0.01])
def test_a_joint_at_rest_far_from_zero_asks_for_no_torque(kernel):
    s = project(take(TIME, np.full(len(TIME), 4 * np.pi)), kernel)
    np.testing.assert_allclose(s.acceleration, 0, atol=1e-4)
    np.testing.assert_allclose(s.missing, 0, atol=1e-4)


def test_the_fine_signals_projected_on_the_rest_are_the_projected_signals():
    s = project(take(TIME, np.sin(5 * TIME)))
    np.testing.assert_allclose(s.project(s.fine_position), s.position, atol=1e-6)
    np.testing.assert_allclose(s.project(s.fine_velocity), s.velocity, atol=1e-4)


def test_stamps_that_jitter_are_used_as_they_are():
    jittered = TIME + np.random.default_rng(0).uniform(-1e-3, 1e-3, len(TIME))
    omega, kernel = 6.0, 0.02
    s = project(take(jittered, np.sin(omega * jittered)), kernel)
    left = np.exp(-((omega * kernel) ** 2) / 2)
    np.testing.assert_allclose(s.velocity[:, 0], left * omega * np.cos(omega * s.time), atol=5e-3 * omega)


def test_a_clear_velocity_channel_replaces_the_derivative_of_a_noisy_position():
    noise = np.random.default_rng(0).normal(0, 5e-3, len(TIME))
    recording = take(TIME, np.sin(3 * TIME) + noise, velocity=3 * np.cos(3 * TIME)[:, None])
    without = project_recording(recording, pendulum(), np.array([5e-3]), kernel=0.02)
    with_it = project_recording(recording, pendulum(), np.array([5e-3]), np.array([1e-4]), kernel=0.02)
    exact = -9 * np.sin(3 * without.time) * np.exp(-((3 * 0.02) ** 2) / 2)
    assert np.abs(with_it.acceleration[:, 0] - exact).max() < 0.02
    assert np.abs(without.acceleration[:, 0] - exact).max() > 0.5
    assert with_it.noise < 0.05 * without.noise


@pytest.mark.parametrize(
    ("noise", "late", "is_used"),
    [(1e-3, 0.0, True), (1e-3, 1e-4, True), (1e-3, 1e-3, False), (1e-3, -1e-3, False), (0.1, 0.0, False)],
)
def test_a_quick_take_uses_a_velocity_channel_only_if_it_is_seen_to_be_prompt(noise, late, is_used):
    """A lag of the channel would be taken for one of the motor."""
    reading = 0.05 * np.sin(60 * TIME) + np.random.default_rng(0).normal(0, noise, len(TIME))
    recording = take(TIME, reading, velocity=3 * np.cos(60 * (TIME - late))[:, None])
    noises = np.array([noise]), np.array([1e-3])
    quick, wide = (project_recording(recording, pendulum(), *noises, kernel=kernel) for kernel in (0.008, 0.012))
    without = project_recording(replace(recording, velocity=None), pendulum(), noises[0], None, kernel=0.008)
    assert np.array_equal(quick.acceleration, without.acceleration) == (not is_used)
    assert wide.noise < 0.1 * without.noise  # an ordinary take uses it in any case


def swing(time, amplitude: float):
    """A motion in closed form, its derivative, and the torque that Newton asks for."""
    slow, fast = 2.1 * time, 5.3 * time + 1
    q = amplitude * (np.sin(slow) + 0.4 * np.sin(fast))
    v = amplitude * (2.1 * np.cos(slow) + 0.4 * 5.3 * np.cos(fast))
    a = -amplitude * (2.1**2 * np.sin(slow) + 0.4 * 5.3**2 * np.sin(fast))
    return q, v, (INERTIA + MASS * LEVER**2) * a + DAMPING * v + MASS * 9.81 * LEVER * np.sin(q)


SWING = np.arange(0.0, 8.0, 0.002)
MIDDLE = SWING + 0.001
"""Middle of each hold, for which a held command stands."""


def pendulum_take(amplitude: float, friction: float = 0.0) -> Recording:
    """Newton's pendulum under torque control, with Coulomb friction overcome by the torque."""
    _, v, torque = swing(MIDDLE, amplitude)
    return take(SWING, swing(SWING, amplitude)[0], torque + friction * np.sign(v))


@pytest.mark.parametrize(("amplitude", "tolerance"), [(0.1, 1e-4), (1.0, 2e-3)])
def test_nothing_is_missing_from_newtons_pendulum(amplitude, tolerance):
    s = project(pendulum_take(amplitude), kernel=0.015)
    assert np.abs(s.missing).max() < tolerance * np.abs(s.command).max()


def test_a_pd_loops_torque_is_found_from_its_target_and_gains():
    kp, kd = np.array([25.0]), np.array([0.9])
    q, v, torque = swing(MIDDLE, 0.8)
    target = q + (torque + kd * v) / kp
    recording = Recording(
        SWING, ("hinge",), swing(SWING, 0.8)[0][:, None], position_target=target[:, None], kp=kp, kd=kd
    )
    s = project(recording, kernel=0.015)
    assert np.abs(s.missing).max() < 2e-3 * np.abs(s.command).max()
    for gains, more in (({"kp": 1.2 * kp}, 0.2 * (s.command + kd * s.velocity)), ({"kd": 2 * kd}, -kd * s.velocity)):
        wrong = project(replace(recording, **gains), kernel=0.015)
        np.testing.assert_allclose(wrong.missing, s.missing - more, atol=1e-9)


def test_friction_that_nobody_modelled_is_missing_against_the_motion():
    s = project(pendulum_take(1.0, friction=0.2), kernel=0.015)
    sliding = np.abs(s.velocity) > 0.5
    np.testing.assert_allclose(s.missing[sliding], -0.2 * np.sign(s.velocity[sliding]), atol=0.01)


def test_dry_friction_of_the_model_is_not_missing():
    model = pendulum()
    model.dof_frictionloss[:] = 0.2
    s = project_recording(pendulum_take(1.0, friction=0.2), model, np.zeros(1), kernel=0.015)
    sliding = np.abs(s.velocity) > 0.5
    np.testing.assert_allclose(s.missing[sliding], 0, atol=0.02)
    assert s.missing.std() < 0.25 * 0.2  # the reversals, which presliding rounds


@pytest.mark.parametrize("kernel", [0.012, 0.03])
@pytest.mark.parametrize("rate", [100.0, 250.0])
def test_noise_is_predicted_as_monte_carlo_finds_it(kernel, rate):
    rng = np.random.default_rng(0)
    time = np.arange(0.0, 25.0, 1 / rate)
    sigma = np.array([1e-3, 2e-3])
    recording = take(time, rng.normal(0, sigma, (len(time), 2)))
    s = project_recording(recording, arm(), sigma, kernel=kernel)
    np.testing.assert_allclose(s.missing.std(0), s.noise, rtol=0.1)


@pytest.mark.parametrize("kernel", [0.012, 0.03])
@pytest.mark.parametrize("rho", [0.3, 0.85])
def test_noise_with_a_memory_is_predicted_as_monte_carlo_finds_it(rho, kernel):
    rng = np.random.default_rng(0)
    time, sigma = np.arange(0.0, 60.0, 0.005), np.array([1e-3, 2e-3])
    noise = lfilter([np.sqrt(1 - rho**2)], [1, -rho], rng.normal(0, sigma, (len(time), 2)), axis=0)
    s = project_recording(take(time, noise), arm(), sigma, kernel=kernel, noise_correlation=np.full(2, rho))
    np.testing.assert_allclose(s.missing.std(0), s.noise, rtol=0.1)


@pytest.mark.parametrize("seed", range(4))
@pytest.mark.parametrize("rho", [0.0, 0.3, 0.6, 0.85])
def test_noise_that_was_measured_in_a_take_is_that_of_its_missing_torque(rho, seed):
    rng = np.random.default_rng(seed)
    time = np.arange(0.0, 30.0, 0.005)
    noise = lfilter([np.sqrt(1 - rho**2)], [1, -rho], rng.normal(0, 1e-3, (len(time), 2)), axis=0)
    told = take(time, noise)
    s = project_recording(told, arm(), sensor_noise(told)[0], kernel=0.02, noise_correlation=noise_correlation(told))
    np.testing.assert_allclose(s.missing.std(0), s.noise, rtol=0.25)


def test_noise_of_a_velocity_channel_is_predicted_as_monte_carlo_finds_it():
    rng = np.random.default_rng(1)
    time = np.arange(0.0, 25.0, 0.005)
    recording = take(time, np.zeros(len(time)), velocity=rng.normal(0, 0.01, (len(time), 1)))
    s = project_recording(recording, pendulum(), np.array([1e-2]), np.array([0.01]), kernel=0.02)
    assert s.missing.std() == pytest.approx(s.noise[0], rel=0.1)


def test_a_held_command_keeps_its_integral():
    rng = np.random.default_rng(0)
    time = np.cumsum(rng.uniform(0.001, 0.02, 200))
    command = rng.normal(size=(200, 2))
    edges = np.concatenate([[time[0]], np.sort(rng.uniform(time[0], time[-1], 50)), [time[-1]]])
    mean = held_command(time, command, edges)
    np.testing.assert_allclose(np.diff(edges) @ mean, np.diff(time) @ command[:-1], rtol=1e-12)


def test_a_held_command_is_held_and_not_interpolated():
    time, command = np.array([0.0, 1.0, 2.0]), np.array([[1.0], [3.0], [-2.0]])
    got = held_command(time, command, np.array([-1.0, 0.0, 0.5, 1.0, 1.5, 2.0, 4.0]))
    np.testing.assert_allclose(got[:, 0], [1, 1, 1, 3, 3, -2])  # before the first and after the last stamp it stays
    np.testing.assert_allclose(held_command(time, command, np.array([0.5, 1.5]))[:, 0], [2.0])


@pytest.mark.parametrize("delay", [0.0, 0.004, 0.0325])
def test_a_step_arrives_when_it_was_stamped_and_later_by_the_delay(delay):
    time = np.arange(0.0, 4.0, 0.01)
    step = np.where(time < 1.995, 0.0, 1.0)  # from the stamp at 2 s on
    s = project(take(time, np.zeros(len(time)), step), kernel=0.02)
    late = s.project_command(s.raw_command(delay))[:, 0]
    rise = s.time[-1] - np.trapezoid(late, s.time)  # of a symmetric rise to 1
    assert rise == pytest.approx(2.0 + delay, abs=2e-4)


def test_torque_beyond_the_motors_range_is_not_commanded():
    model = arm()
    low, high = torque_range(model, JointAddress.of(model, JOINTS))
    np.testing.assert_allclose([low, high], [[-40, -15], [40, 15]])
    time = np.arange(0.0, 3.0, 0.004)
    told = take(time, np.zeros((len(time), 2)), np.tile([100.0, -100.0], (len(time), 1)))
    s = project_recording(told, model, np.zeros(2))
    np.testing.assert_allclose(s.command, np.tile([40.0, -15.0], (len(s.time), 1)))


def test_a_motors_range_counts_its_gear():
    motor = '<actuator><motor joint="hinge" gear="50" forcelimited="true" forcerange="-0.2 0.3"/></actuator>'
    model = mujoco.MjModel.from_xml_string(PENDULUM.replace("</mujoco>", motor + "</mujoco>"))
    low, high = torque_range(model, JointAddress.of(model, ("hinge",)))
    assert (low[0], high[0]) == pytest.approx((-10.0, 15.0))


@pytest.mark.parametrize(
    ("motors", "expected"),
    [
        ('<motor joint="hinge" gear="-2" forcerange="-3 5" forcelimited="true"/>', (-10.0, 6.0)),
        ('<motor joint="hinge" gear="7" ctrlrange="-1 1" ctrllimited="true"/>', (-7.0, 7.0)),
        ('<motor joint="hinge" ctrlrange="-9 9"/><motor joint="hinge" gear="2" ctrlrange="-1 2"/>', (-11.0, 13.0)),
        ('<motor joint="hinge" ctrlrange="-9 9"/><motor joint="hinge"/>', (-np.inf, np.inf)),
        ('<position joint="hinge" kp="5" ctrlrange="-1 1"/>', (-np.inf, np.inf)),
        (
            '<dcmotor joint="hinge" input="none" motorconst="0" resistance="1" cogging="1 7 0"/>'
            '<motor joint="hinge" ctrlrange="-2 3"/>',
            (-2.0, 3.0),
        ),
        ('<pid joint="hinge" input="pos vel ff" kp="5" forcerange="-4 4"/>', (-4.0, 4.0)),
    ],
)
def test_the_torque_range_is_what_all_motors_of_a_joint_can_give(motors, expected):
    model = mujoco.MjModel.from_xml_string(
        PENDULUM.replace("</worldbody>", f"</worldbody><actuator>{motors}</actuator>")
    )
    low, high = torque_range(model, JointAddress.of(model, ("hinge",)))
    assert (low[0], high[0]) == pytest.approx(expected)


def test_a_joint_without_a_motor_has_no_range():
    low, high = torque_range(pendulum(), JointAddress.of(pendulum(), ("hinge",)))
    assert (low[0], high[0]) == (-np.inf, np.inf)


# --- bristle ---


def test_the_bristle_follows_its_differential_equation():
    width = 0.05
    time = np.linspace(0, 3, 4000)

    def dz(t, z):
        v = 2 * np.cos(2 * t) - 0.9 * np.sin(3 * t)
        return (np.sign(v) - z) * np.abs(v) / width

    position = np.sin(2 * time) + 0.3 * np.cos(3 * time)
    exact = solve_ivp(dz, (0, 3), [1.0], t_eval=time, max_step=2e-3, rtol=1e-6).y[0]
    np.testing.assert_allclose(bristle(position, width), exact, atol=5e-3)


def test_the_bristle_of_a_reversal_is_an_exponential_of_the_way_back():
    out, back = np.linspace(0, 1, 50), np.linspace(1, 0, 200)[1:]
    z = bristle(np.concatenate([out, np.full(7, 1.0), back]), 0.2)
    np.testing.assert_allclose(z[:57], 1.0)  # a pause does not turn it over
    np.testing.assert_allclose(z[57:], -1 + 2 * np.exp(-(1 - back) / 0.2), atol=1e-12)


def test_the_bristle_is_odd_and_at_rest_without_motion():
    position = np.cumsum(np.random.default_rng(0).normal(size=300))
    np.testing.assert_allclose(bristle(-position, 0.5), -bristle(position, 0.5))
    assert not bristle(np.full(10, 0.7), 0.1).any()
    assert np.abs(bristle(position, 0.5)).max() <= 1


def test_presliding_shrinks_with_a_short_travel():
    long, short = (project(take(TIME, reach * np.sin(3 * TIME))) for reach in (2.0, 0.05))
    assert presliding_width(long, 0) == pytest.approx(1.5e-3)
    assert presliding_width(short, 0) == pytest.approx(1.5e-3 * 0.1, rel=0.01)


# --- kernel ---


def test_the_kernel_narrows_as_the_motion_gets_faster():
    widths = [kernel_for([take(TIME, np.sin(2 * np.pi * f * TIME))]) for f in (1.0, 7.0, 12.0, 60.0)]
    assert widths[0] == KERNEL[1]
    assert widths[1] > widths[2] > widths[3] == KERNEL[0]
    assert kernel_for([take(TIME, np.sin(2 * np.pi * 60.0 * TIME))], least=QUICKEST) == QUICKEST
    assert kernel_for([take(TIME, np.sin(2 * np.pi * 7.0 * TIME))], least=QUICKEST) == pytest.approx(widths[1])


def test_the_kernel_halves_the_edge_of_the_band():
    width = kernel_for([take(TIME, np.sin(2 * np.pi * 9.0 * TIME))])
    band = np.sqrt(np.log(2) / 2) / np.pi / width
    assert band == pytest.approx(9.0, abs=0.5)  # Welch's resolution is 0.25 Hz


def test_the_kernel_spans_a_sample_and_ignores_joints_at_rest():
    slow = np.arange(0.0, 20.0, 0.05)
    assert kernel_for([take(slow, np.sin(slow))]) == pytest.approx(1.2 * 0.05)
    both = np.stack([np.sin(2 * np.pi * 9 * TIME), np.zeros(len(TIME))], -1)
    assert kernel_for([take(TIME, both)]) == pytest.approx(kernel_for([take(TIME, both[:, :1])]))
    assert kernel_for([take(TIME, np.zeros(len(TIME)))]) == KERNEL[1]


def test_the_noise_of_a_coarse_encoder_is_no_motion():
    noise = 2e-3
    read = 0.2 * np.sin(2 * np.pi * 0.3 * TIME) + np.random.default_rng(0).normal(0, noise, len(TIME))
    assert kernel_for([take(TIME, read)]) < 0.6 * KERNEL[1]  # slow, but a hundredth of the power is noise
    assert kernel_for([take(TIME, read)], np.array([noise])) == KERNEL[1]
    quick = read + 0.005 * np.sin(2 * np.pi * 12 * TIME)
    assert kernel_for([take(TIME, quick)], np.array([noise])) == pytest.approx(0.187 / 12, rel=0.1)


# --- model and joints ---


def test_inverse_dynamics_is_inertia_times_acceleration_beside_what_remains_at_constant_speed():
    rng = np.random.default_rng(0)
    q, v, a = rng.normal(size=(3, 20, 2))
    model = arm()
    address = JointAddress.of(model, JOINTS)
    torque = inverse_dynamics(model, address, q, v, a) - inverse_dynamics(model, address, q, v, 0 * a)
    np.testing.assert_allclose(torque, np.einsum("nij,nj->ni", inertia_matrix(model, address, q), a), atol=1e-10)


def test_joints_may_be_recorded_in_another_order_than_the_models():
    recording = record(seconds=3.0)
    swapped = replace(
        recording,
        joint_names=recording.joint_names[::-1],
        position=recording.position[:, ::-1],
        torque_command=recording.command[:, ::-1],
    )
    given, other = (project_recording(r, arm(), np.zeros(2)) for r in (recording, swapped))
    np.testing.assert_allclose(other.missing[:, ::-1], given.missing)
    np.testing.assert_allclose(other.inertia[:, ::-1, ::-1], given.inertia)
    np.testing.assert_allclose(other.load[:, ::-1], given.load)


@pytest.mark.parametrize(
    ("names", "advice"),
    [
        (("hinge", "knee"), r"log\.npz: joint_names has 'knee', the model has \['hinge'\]\. Rename it"),
        ((), r"log\.npz: joint 'hinge' moves in the model but was not recorded\. Record it, or remove"),
    ],
)
def test_joints_that_do_not_match_are_refused_by_name(names, advice):
    with pytest.raises(RecordingError, match=advice):
        JointAddress.of(pendulum(), names, "log.npz")


def test_the_link_behind_a_gear_of_a_corrected_model_sends_back_to_the_given_one():
    link = PENDULUM.replace("<body", '<body><joint name="hinge_link"/><geom size="0.1"/></body><body', 1)
    gear = '<tendon><fixed name="hinge_gear"><joint joint="hinge" coef="1"/></fixed></tendon></mujoco>'
    for xml, advice in ((link.replace("</mujoco>", gear), "diagnose the model that was given"), (link, "Record it")):
        with pytest.raises(RecordingError, match=rf"'hinge_link' moves .* {advice}"):
            JointAddress.of(mujoco.MjModel.from_xml_string(xml), ("hinge",))


def test_a_free_body_is_no_joint():
    model = mujoco.MjModel.from_xml_string(
        '<mujoco><worldbody><body><freejoint name="base"/><geom size="0.1"/></body></worldbody></mujoco>'
    )
    with pytest.raises(RecordingError, match=r"only hinge and slide joints .* take other free bodies out"):
        JointAddress.of(model, ("base",))


def test_too_short_a_take_is_refused_with_the_length_needed():
    time = np.arange(0.0, 0.3, 0.005)
    with pytest.raises(RecordingError, match=r"the take lasts 0\.2\d s, at least 0\.\d+ s are needed"):
        project(take(time, np.sin(time)))


# --- what is valid ---


def test_a_masked_sample_is_forgotten_within_the_reach_of_the_kernel():
    mask = np.zeros((len(TIME), 1), dtype=bool)
    mask[len(TIME) // 2] = True
    s = project(take(TIME, np.sin(TIME)), kernel=0.02, mask=mask)
    away = np.abs(s.time - TIME[len(TIME) // 2])
    assert not s.valid[away < 3 * 0.02].any()
    assert s.valid[away > 0.2].all()


def test_near_a_stop_its_own_joint_is_not_judged():
    model = mujoco.MjModel.from_xml_string(
        '<mujoco><compiler angle="radian"/><worldbody>'
        '<body><joint name="shoulder" axis="0 1 0" range="-1 0.9" limited="true"/><geom size="0.1" pos="0 0 -0.2"/>'
        '<body pos="0 0 -0.4"><joint name="elbow" axis="0 1 0"/><geom size="0.1" pos="0 0 -0.2"/></body></body>'
        "</worldbody></mujoco>"
    )
    position = np.stack([0.9 * np.sin(TIME), 0.5 * np.cos(TIME)], -1)  # the two never rest together
    s = project_recording(take(TIME, position), model, np.zeros(2), kernel=0.02)
    assert not s.valid[s.position[:, 0] > 0.88, 0].any()
    assert s.valid[np.abs(s.position[:, 0]) < 0.7, 0].all()
    assert s.valid[:, 1].all()  # a stop's reaction acts on its own degree of freedom


def test_a_command_is_projected_on_the_same_function_as_the_motion():
    time = np.arange(0.0, 6.0, 1 / RATE)
    command = waves(time, (1.0, 2.0))
    recording = take(time, np.zeros((len(time), 2)), command)
    s = project_recording(recording, arm(), np.zeros(2), kernel=0.03)
    as_motion = project_recording(take(time, command), arm(), np.zeros(2), kernel=0.03)
    half_hold = 0.5 / RATE * as_motion.velocity  # a held value stands for the middle of its hold
    np.testing.assert_allclose(s.command, as_motion.position - half_hold, atol=2e-3)
