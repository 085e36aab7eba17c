"""A second mass behind a spring rings when it is pushed with pulses; a rigid one does not."""

import mujoco
import numpy as np
import pytest

from torchrl_athletic.diagnosis.remainder import flexibilities, remarks_on
from torchrl_athletic.diagnosis.screen import Bank, candidates_for
from torchrl_athletic.diagnosis.search import Judge
from torchrl_athletic.effects import ReflectedInertia, Signals, ViscousFriction, project_recording
from torchrl_athletic.recordings import Recording

MOTOR, LOAD = 2.0, 0.6
RINGS_AT = 18.0
BAND, NOISE, RATE = 4.0, 5e-6, 250.0
RIGID = f"""
<mujoco><worldbody><body><joint name="rail" type="slide" axis="1 0 0" damping="8" actuatorfrcrange="-60 60"/>
  <inertial pos="0 0 0" mass="{MOTOR + LOAD}" diaginertia="0.1 0.1 0.1"/></body></worldbody></mujoco>"""


def rail() -> mujoco.MjModel:
    return mujoco.MjModel.from_xml_string(RIGID)


def pulses(time, seed: int):
    """Slow waves with short pushes on top."""
    rng = np.random.default_rng(seed)
    force = 10 * np.sin(2 * np.pi * 0.7 * time)
    for start in np.arange(0.3, time[-1] - 0.1, 0.35):
        force += rng.choice([-40.0, 40.0]) * ((time >= start) & (time < start + 0.012))
    return force


def recorded(flexible: bool, seconds: float = 9.0, seed: int = 0) -> Recording:
    """Position of the motor, by small steps of the equations of motion."""
    time = np.arange(0.0, seconds, 1 / RATE)
    force, fine = pulses(time, seed), 10
    stiffness = (2 * np.pi * RINGS_AT) ** 2 * MOTOR * LOAD / (MOTOR + LOAD)
    mass = MOTOR if flexible else MOTOR + LOAD
    loss = 4.0
    x, v, y, w, position, h = 0.0, 0.0, 0.0, 0.0, [], 1 / RATE / fine
    for f in force:
        position.append(x)
        for _ in range(fine):
            spring = stiffness * (x - y) + loss * (v - w) if flexible else 0.0
            v += h * (f - 8 * v - spring) / mass
            x += h * v
            w += h * spring / LOAD
            y += h * w
    noise = np.random.default_rng(seed + 10).normal(0, NOISE, len(time))
    return Recording(time, ("rail",), (np.array(position) + noise)[:, None], torque_command=force[:, None])


def projected(recording: Recording) -> Signals:
    return project_recording(recording, rail(), np.array([NOISE]), kernel=0.133 / BAND)


def nothing(takes):
    return Judge(Bank(takes, [])).score(())


@pytest.fixture(scope="module")
def flexible() -> Signals:
    return projected(recorded(True))


@pytest.fixture(scope="module")
def rigid() -> Signals:
    return projected(recorded(False))


def test_a_flexible_second_mass_is_reported_around_its_resonance(flexible):
    (found,) = flexibilities([flexible], nothing([flexible]), BAND)
    assert found.joint == "rail"
    assert found.unit == "N"
    assert 2 * BAND <= found.band[0] < RINGS_AT < found.band[1] + 10
    assert found.rms > 3 * found.noise
    assert 0 < found.coherence <= 1


def test_takes_whose_rates_let_unlike_bands_be_seen_say_nothing_together(flexible):
    slower = recorded(True)
    every = slice(None, None, 2)
    slow = projected(Recording(slower.time[every], ("rail",), slower.position[every],
                               torque_command=slower.command[every]))  # fmt: skip
    assert flexibilities([flexible, slow], nothing([flexible]), BAND) == []


def test_a_rigid_mass_is_not_reported(rigid):
    assert flexibilities([rigid], nothing([rigid]), BAND) == []


def test_noise_that_does_not_answer_to_the_command_is_no_flexibility(rigid):
    noisy = rigid.recording
    wobble = 3e-5 * np.random.default_rng(0).normal(size=noisy.position.shape)
    loud = Recording(noisy.time, noisy.joint_names, noisy.position + wobble, torque_command=noisy.command)
    s = projected(loud)
    assert flexibilities([s], nothing([s]), BAND) == []


def test_what_a_finding_explains_is_taken_away_first(rigid):
    """A model without the load misses its inertia at every frequency."""
    light = rail()
    light.body_mass[1] = MOTOR
    mujoco.mj_setConst(light, mujoco.MjData(light))
    s = project_recording(rigid.recording, light, np.array([NOISE]), kernel=rigid.kernel)
    (rotor,) = candidates_for([s], [ReflectedInertia()])
    weigh = Judge(Bank([s], [rotor]))
    assert len(flexibilities([s], weigh.score(()), BAND)) == 1
    explained = weigh.score(weigh.bank.atoms)
    assert explained.fit.values()[0] == pytest.approx([LOAD], rel=0.02)
    assert flexibilities([s], explained, BAND) == []


def test_a_band_too_wide_or_a_take_too_short_says_nothing(flexible):
    assert flexibilities([flexible], nothing([flexible]), 20.0) == []
    brief = projected(recorded(True, seconds=5.0))
    assert flexibilities([brief], nothing([brief]), BAND) == []


def test_without_a_command_there_is_nothing_to_answer_to(rigid):
    r = rigid.recording
    s = projected(Recording(r.time, r.joint_names, r.position, torque_command=np.zeros_like(r.command)))
    assert flexibilities([s], nothing([s]), BAND) == []


def test_the_remark_says_where_how_much_and_what_to_record(flexible, rigid):
    best = nothing([flexible])
    (kept_aside,) = remarks_on([rigid], [flexible], best, BAND)
    (found,) = flexibilities([flexible], best, BAND)
    assert kept_aside.startswith("The recordings kept aside leave a flexibility unexplained at rail: from ")
    assert f"{found.rms:.2g} N of what is missing" in kept_aside
    assert f"to {found.band[1]:.0f} Hz" in kept_aside
    assert "second encoder" in kept_aside
    (fitted,) = remarks_on([flexible], [rigid], best, BAND)
    assert fitted.startswith("The fitted recordings leave a flexibility")
    assert remarks_on([flexible], [flexible], best, BAND) == (kept_aside,)  # said once


def test_viscous_friction_is_no_flexibility(rigid):
    model = rail()
    model.dof_damping[:] = 2.0
    wrong = project_recording(rigid.recording, model, np.array([NOISE]), kernel=rigid.kernel)
    (viscous,) = candidates_for([wrong], [ViscousFriction()])
    weigh = Judge(Bank([wrong], [viscous]))
    assert flexibilities([wrong], weigh.score(weigh.bank.atoms), BAND) == []
