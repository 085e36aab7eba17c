"""A second mass behind a spring rings when it is pushed with pulses; a rigid one does not."""

from types import SimpleNamespace

import mujoco
import numpy as np
import pytest
from diagnosis.columns import Given, candidate, signals
from scipy.signal import butter, sosfilt

from torchrl_athletic.diagnosis import remainder
from torchrl_athletic.diagnosis.remainder import Flexibility, flexibilities, remarks_on
from torchrl_athletic.diagnosis.screen import Bank, candidates_for
from torchrl_athletic.diagnosis.search import Judge
from torchrl_athletic.effects import JointAddress, ReflectedInertia, Signals, ViscousFriction, project_recording
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


def test_what_chance_gives_short_takes_is_no_flexibility_beside_a_long_one():
    """Coherence of eight segments is an eighth by chance, of sixty a sixtieth: whichever take comes first."""

    def shaken(seconds, seed):
        r, rng = recorded(False, seconds, seed), np.random.default_rng(seed + 500)
        shake = sosfilt(butter(4, [9, 30], "band", fs=RATE, output="sos"), rng.normal(0, 4e-4, len(r.time)))
        moved = r.position + shake[:, None]
        return projected(Recording(r.time, ("rail",), moved, torque_command=r.command))

    takes = [shaken(60.0, 0), *(shaken(8.5, seed) for seed in range(1, 9))]
    assert flexibilities(takes, nothing(takes), BAND) == flexibilities(takes[::-1], nothing(takes), BAND) == []


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


# --- on missing torque that is given, so that shares, ends and sizes are known ---

SECONDS, FAST = 40.0, 400.0
HALL = """
<mujoco><worldbody><body><joint name="hip"/><inertial pos="0 0 0" mass="1" diaginertia="1 1 1"/>
  <body><joint name="rail" type="slide" axis="1 0 0"/><inertial pos="0 0 0" mass="1" diaginertia="1 1 1"/></body>
</body></worldbody></mujoco>"""


def hum(low: float, high: float, seed: int = 0, seconds: float = SECONDS) -> np.ndarray:
    """A unit torque of all frequencies from ``low`` to ``high`` [Hz], and none beside them."""
    size = int(seconds * FAST)
    f, rng = np.fft.rfftfreq(size, 1 / FAST), np.random.default_rng(seed)
    x = np.fft.irfft(np.exp(2j * np.pi * rng.random(len(f))) * ((f > low) & (f < high)), size)
    return np.asarray(x / x.std())


@pytest.fixture
def found_in(monkeypatch):
    """Flexibilities of a hip and a rail in takes of which the missing torque and the command are given, (N, J) each."""
    monkeypatch.setattr(remainder, "sensor_noise", lambda recording: ())
    monkeypatch.setattr(remainder, "project_recording", lambda recording, *_, kernel: recording.fine)
    monkeypatch.setattr(remainder, "_left", lambda fine, best: fine.left)
    model = mujoco.MjModel.from_xml_string(HALL)

    def found(*takes, noise=1e-3, rate=250.0, band=BAND) -> list[Flexibility]:
        signals = []
        for left, command in takes:
            time = np.arange(len(left)) / FAST
            fine = SimpleNamespace(left=left, command=command, time=time, num_joints=2, noise=np.full(2, noise))
            told = {"rate": rate, "duration": time[-1], "joint_names": ("hip", "rail"), "fine": fine}
            address = JointAddress.of(model, ("hip", "rail"))
            signals.append(SimpleNamespace(recording=SimpleNamespace(**told), nominal=model, address=address))
        return flexibilities(signals, None, band)

    return found


def test_what_the_test_function_of_the_log_cannot_show_is_no_part_of_the_band(found_in):
    """A kernel of 1.2 samples at 150 Hz sees up to 16 Hz; above, the missing torque is what smoothing has left."""
    answer = hum(8.5, 60.0)[:, None] * [0.0, 1.0]
    (found,) = found_in((answer, answer), rate=150.0)
    assert found.band == (pytest.approx(8.5, abs=0.5), pytest.approx(15.6, abs=0.7))
    assert found_in((answer, answer), rate=150.0, band=6.0) == []  # from 12 to 16 Hz is too little to tell
    assert len(found_in((answer, answer), rate=150.0, band=5.0)) == 1


@pytest.mark.parametrize(("rate", "kernel"), [(250.0, 4.8e-3), (400.0, 3e-3), (2000.0, 3e-3)])
def test_the_test_function_is_as_short_as_the_log_allows_and_no_shorter_than_three_milliseconds(
    rate, kernel, found_in, monkeypatch
):
    told = []
    monkeypatch.setattr(
        remainder, "project_recording", lambda recording, *_, kernel: told.append(kernel) or recording.fine
    )
    answer = hum(10.0, 20.0)[:, None] * [0.0, 1.0]
    found_in((answer, answer), rate=rate)
    assert told == pytest.approx([kernel])


def test_a_take_of_fewer_than_eight_segments_says_nothing(found_in, monkeypatch):
    answer = hum(10.0, 20.0, seconds=10.0)[:, None] * [0.0, 1.0]
    assert len(found_in((answer, answer))) == 1
    monkeypatch.setattr(remainder, "SEGMENT", 1.5)
    assert found_in((answer, answer)) == []


def test_what_the_noise_of_a_take_would_hide_is_not_taken_from_it(monkeypatch):
    class Bank:
        def __init__(self, takes, candidates):
            assert (takes, candidates) == (["take"], [])

        def add(self, candidate, fixed):
            return None if candidate == "hidden" else (candidate, fixed)

        def fit(self, atoms):
            return atoms

        def rows(self, fitted):
            return fitted

    monkeypatch.setattr(remainder, "Bank", Bank)
    terms = [SimpleNamespace(candidate=name, fixed=f"{name} at") for name in ("seen", "hidden")]
    best = SimpleNamespace(fit=SimpleNamespace(terms=terms))
    assert remainder._left("take", best) == [("seen", "seen at")]


def test_a_flexible_link_is_seen_up_to_where_the_log_shows_it(flexible):
    (found,) = flexibilities([flexible], nothing([flexible]), BAND)
    assert found.band[1] <= 0.13 * RATE / 1.2


@pytest.mark.parametrize("segment", [1.0, 2.0])
def test_the_coherent_part_is_as_strong_as_what_the_command_makes(segment, found_in, monkeypatch):
    """A force of 2 N between 10 and 20 Hz, all of which follows the command, is told as 2 N of the right joint."""
    monkeypatch.setattr(remainder, "SEGMENT", segment)  # however wide a line of the spectrum is
    answer, idle = hum(10.0, 20.0), hum(1.0, 30.0, seed=1)
    rough = answer + 0.1 * hum(1.0, 60.0, seed=3)
    left = np.stack([0.01 * idle, 2 * answer + 0.1 * idle], -1)
    (found,) = found_in((left, np.stack([hum(1, 30, 2), rough], -1)))
    assert (found.joint, found.unit, found.noise) == ("rail", "N", 1e-3)
    assert found.rms == pytest.approx(2.0, rel=0.05)
    assert found.band == (pytest.approx(9.5, abs=1.0), pytest.approx(20.5, abs=1.0))
    (turned,) = found_in((np.stack([2 * answer, 0.01 * idle], -1), np.stack([answer, hum(1, 30, 2)], -1)))
    assert (turned.joint, turned.unit) == ("hip", "N·m")


def test_noise_beside_the_answer_counts_for_neither_its_strength_nor_its_coherence(found_in):
    """Half of the power of each frequency follows the command, so that the coherent part is the root of half."""
    answer, noise = hum(10.0, 20.0), hum(10.0, 20.0, seed=1)
    left = np.stack([0 * answer, answer + noise], -1)
    (found,) = found_in((left, np.stack([0 * answer, hum(1.0, 30.0, seed=2) + 9 * answer], -1)))
    assert found.coherence == pytest.approx(0.5, abs=0.06)
    assert found.rms == pytest.approx(1.0, rel=0.1)


def test_what_answers_in_one_take_of_two_is_half_as_coherent(found_in):
    answer = hum(10.0, 20.0)
    both, one = (
        found_in(*[(left[:, None] * [0.0, 1.0], answer[:, None] * [0.0, 1.0]) for left in (answer, second)])
        for second in (answer, hum(10.0, 20.0, seed=1))
    )
    assert both[0].coherence == pytest.approx(1.0, abs=0.02)
    assert one[0].coherence == pytest.approx(0.5, abs=0.05)


def test_a_band_of_three_lines_is_no_band(found_in):
    """A window spreads a tone over three frequencies: that is a hum of the mains, not a link that rings."""
    time = np.arange(int(SECONDS * FAST)) / FAST
    tone = np.sin(2 * np.pi * 15.0 * time)
    rest = 1e-3 * hum(1.0, 30.0, seed=3)
    left, command = (x[:, None] * [0.0, 1.0] for x in (tone + rest, tone + 1e-3 * hum(1.0, 30.0, seed=4)))
    assert found_in((left, command)) == []


@pytest.mark.parametrize(("count", "share", "seen"), [(1, 0.18, False), (1, 0.6, True), (4, 0.3, True)])
def test_short_takes_have_to_answer_clearly_and_several_may_answer_less(count, share, seen, found_in):
    """Chance gives ten seconds a coherence of 0.15; three times that is an answer, or half as much in four takes."""
    takes = []
    for k in range(count):
        command, noise = (hum(8.0, 27.0, seed=seed, seconds=10.0) for seed in (k, k + 50))
        left = np.sqrt(share) * command + np.sqrt(1 - share) * noise
        takes.append((left[:, None] * [0.0, 1.0], command[:, None] * [0.0, 1.0]))
    found = found_in(*takes)
    assert bool(found) is seen
    assert not found or found[0].band[1] - found[0].band[0] > 8.0  # most of it answers, not the luckiest lines


@pytest.mark.parametrize(("answer", "noise", "seen"), [(2.0, 0.6, True), (2.0, 0.75, False)])
def test_what_the_sensors_may_make_is_no_flexibility(answer, noise, seen, found_in):
    x = hum(10.0, 20.0)[:, None] * [0.0, 1.0]
    assert bool(found_in((answer * x, x), noise=noise)) is seen


@pytest.mark.parametrize(("answer", "seen"), [(0.2, False), (0.5, True)])
def test_an_answer_that_is_next_to_nothing_of_what_is_missing_up_there_is_not_told(answer, seen, found_in):
    small, loud = hum(10.0, 15.0), hum(17.0, 27.0, seed=1)
    left, command = answer * small + loud, small + hum(17.0, 27.0, seed=2)
    assert bool(found_in((left[:, None] * [0.0, 1.0], command[:, None] * [0.0, 1.0]))) is seen


def test_what_hardly_follows_the_command_adds_nothing_to_the_strength_of_what_does(found_in):
    """Ten times the power beside the answer is as coherent as chance makes it, which is no answer."""
    answer, loud = hum(10.0, 15.0), np.sqrt(10.0) * hum(17.0, 27.0, seed=1)
    left, command = answer + loud, answer + hum(17.0, 27.0, seed=2)
    (found,) = found_in((left[:, None] * [0.0, 1.0], command[:, None] * [0.0, 1.0]))
    assert found.rms == pytest.approx(1.0, rel=0.05)
    assert found.coherence > 0.9


def test_a_joint_is_compared_with_the_noise_of_its_own_sensors(found_in):
    x = hum(10.0, 20.0)[:, None] * [0.0, 1.0]
    (found,) = found_in((x, x), noise=[9.0, 1e-3])
    assert (found.joint, found.noise) == ("rail", 1e-3)
    assert found_in((x, x), noise=[1e-3, 9.0]) == []


def test_all_that_was_found_is_taken_from_the_missing_torque():
    one, two = np.random.default_rng(0).normal(size=(2, 300))
    s = signals(np.stack([2 * one, 3 * two], -1))
    found = Judge(Bank([s], [candidate(Given("one", one), 0), candidate(Given("two", two), 1)], noise=np.ones(2)))
    left = remainder._left(s, found.score(found.bank.atoms))
    np.testing.assert_allclose(left, np.zeros((300, 2)), atol=1e-4)
