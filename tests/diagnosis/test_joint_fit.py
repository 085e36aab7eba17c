"""The search of the standard joints: what it must find, and what it must not fall for."""

import sys
from dataclasses import dataclass, replace
from types import SimpleNamespace

import mujoco
import numpy as np
import pytest
from diagnosis.plants import behind_a_spring, pendulum, smooth_torque
from diagnosis.test_fitting import NOISE, RATE, STEP, integrated, parameter, recording

from torchrl_athletic.diagnosis import fit
from torchrl_athletic.diagnosis.deadline import Deadline
from torchrl_athletic.diagnosis.joint_fit import DOUBT, WORTH, descend, problem_of, prune, weighed, window_cost
from torchrl_athletic.diagnosis.prepare import prepare
from torchrl_athletic.diagnosis.standard import agreement, seen_in, standard_joints
from torchrl_athletic.recordings import Recording

module = sys.modules["torchrl_athletic.diagnosis.joint_fit"]
TABLE = """<mujoco><option timestep="0.005" gravity="0 0 0"/><worldbody><body><joint name="pendulum" axis="0 0 1"/>
  <inertial pos="0 0 0" mass="0.1" diaginertia="{0} {0} {0}"/></body></worldbody>
  <actuator><motor joint="pendulum" ctrlrange="-20 20"/></actuator></mujoco>"""


def turned(command, *, inertia, friction=0.0, damping=0.0, limit=np.inf, fine=10):
    """Positions of a turntable at the samples. Shape (T, 1)."""
    step, q, v, out = 1 / RATE / fine, 0.0, 0.0, []
    for k, u in enumerate(np.repeat(command[:, 0], fine)):
        if k % fine == 0:
            out.append(q)
        free = v + step * (np.clip(u, -limit, limit) - damping * v) / inertia
        v = np.sign(free) * max(abs(free) - step * friction / inertia, 0.0)
        q += step * v
    return np.array(out)[:, None] + NOISE * np.random.default_rng(0).standard_normal((len(out), 1))


@pytest.fixture(scope="module")
def swings():
    """Recordings with dry friction and a weak motor, and all that a search needs."""
    command = smooth_torque(4.0, 2.5, 1)
    take = recording(command, integrated(command, friction=0.1, scale=0.8))
    prepared = prepare([take], mujoco.MjModel.from_xml_string(pendulum(STEP)))
    h = standard_joints(prepared, seen_in(prepared))
    return h, prepared, {(c.effect.name, p.name): k for k, (c, p) in enumerate(h_places(h))}


def h_places(h):
    return [(c, p) for c in h.terms for p in c.parameters]


def test_a_descent_from_numbers_by_hand_never_ends_worse(swings):
    """The error that is stated, from near the truth and from far off."""
    h, prepared, at = swings
    problem = problem_of(h, prepared.takes, 0.5, 20, np.random.default_rng(0), h.nominal)
    for friction, scale in ((0.1, 0.8), (0.5, 0.3)):
        x = h.nominal
        x[at["coulomb_friction", "torque"]], x[at["torque_scale", "scale"]] = friction, scale
        own = weighed(replace(problem, tuning=np.inf), x)
        y = descend(own, x, h.bounds[1] > h.bounds[0], 2, Deadline())
        before, after = window_cost(own, own.mean_square(np.stack([x, y]))).mean(1)
        assert after <= before


def test_torques_tell_a_motion_that_coasts_from_one_that_is_driven(swings):
    """A rotor of a hundred links follows half a second of smooth motion, but not the torques."""
    h, prepared, at = swings
    truth, coasting = h.nominal, h.nominal
    truth[at["coulomb_friction", "torque"]], truth[at["torque_scale", "scale"]] = 0.1, 0.8
    coasting[at["reflected_inertia", "armature"]] = 9.0
    rows = agreement(h, prepared).rows(np.stack([truth, coasting]))
    cost = (rows**2).sum(0)
    assert cost[0] < 1.0
    assert cost[1] > 100 * cost[0]


@pytest.mark.slow
def test_a_wrist_whose_rotor_is_a_hundred_times_its_link_is_found():
    command = 3 * smooth_torque(4.0, 2.5, 2)
    take = recording(command, turned(command, inertia=0.101, damping=0.05))
    fitted = fit(TABLE.format(0.001), [take], extended=False)
    assert parameter(fitted, "reflected_inertia").value == pytest.approx(0.1, rel=0.05)


@pytest.mark.slow
def test_a_limit_at_a_fifth_of_the_largest_command_is_found():
    command = 4 * smooth_torque(4.0, 2.5, 3)
    limit = 0.2 * float(np.abs(command).max())
    take = recording(command, turned(command, inertia=0.1, damping=0.2, limit=limit))
    fitted = fit(TABLE.format(0.1), [take], extended=False)
    assert parameter(fitted, "torque_saturation").value == pytest.approx(limit, rel=0.03)


@pytest.mark.slow
def test_what_only_ratios_show_gets_no_numbers():
    """Without gravity or friction, a motor's scale and the inertia are one number: no interval excludes either."""
    command = smooth_torque(4.0, 2.5, 4)
    fitted = fit(TABLE.format(0.1), [recording(command, turned(command, inertia=0.1))], extended=False)
    both = [parameter(fitted, "torque_scale"), parameter(fitted, "reflected_inertia")]
    assert all(p.value == p.given for p in both)
    assert any(p.state == "not identified" for p in both)


@pytest.mark.slow
def test_a_resonance_comes_back_as_a_gear_and_not_as_damping():
    """A drive whose link swings behind the encoder at 6.8 Hz, and which has next to no friction."""
    stiffness, link, rotor, rng = 40.0, 0.05, 0.04, np.random.default_rng(1)
    time, command, read = behind_a_spring(stiffness, link, rotor, rng)
    xml = TABLE.format(link).replace('axis="0 0 1"', f'axis="0 0 1" armature="{rotor}"')
    position = read[:, None] + 1e-5 * rng.standard_normal((len(read), 1))
    fitted = fit(xml, [Recording(time, ("pendulum",), position, torque_command=command[:, None])])
    assert parameter(fitted, "viscous_friction").value < 0.05
    assert parameter(fitted, "compliance", name="stiffness").value == pytest.approx(stiffness, rel=0.15)
    assert fitted.scores["train"].after < 0.05 * fitted.scores["train"].before


@pytest.mark.slow
def test_without_any_time_there_is_a_result_all_the_same():
    command = smooth_torque(3.0, 2.5, 5)
    fitted = fit(pendulum(STEP), [recording(command, integrated(command, friction=0.1))], time_budget=0.0)
    assert fitted.scores["train"].after <= fitted.scores["train"].before
    assert fitted.parameters


@dataclass(frozen=True)
class Costs:
    """A problem whose one parameter is worth ``stated`` and ``weighed`` errors a window, in place of simulations."""

    stated: np.ndarray
    weighed: np.ndarray
    tuning: float = 1.0

    @property
    def hypothesis(self) -> SimpleNamespace:
        return SimpleNamespace(terms=(SimpleNamespace(joint=0, parameters=(None,)),))

    def of(self, without: bool) -> np.ndarray:
        return 1.0 + without * (self.stated if np.isinf(self.tuning) else self.weighed)


@pytest.mark.parametrize(
    ("stated", "weighed", "needed"),
    [
        (0.5 * WORTH, 0.5 * WORTH, False),  # not worth having
        (2.0 * WORTH, 0.0, True),  # the stated error must not rise
        (0.0, 0.9 * DOUBT * 0.1, False),  # within what folds leave open: 0.1
        (0.0, 1.1 * DOUBT * 0.1, True),
    ],
)
def test_a_parameter_goes_where_folds_do_not_ask_for_it(monkeypatch, stated, weighed, needed):
    windows = np.tile([-1.0, 1.0], 50)  # a mean of zero, a deviation of one
    problem = Costs(np.full(100, stated), weighed + windows * (weighed > WORTH))
    near = SimpleNamespace(problem=problem, free=np.ones(1, dtype=bool))
    monkeypatch.setattr(module, "folds_of", lambda problem: np.zeros(100, dtype=int))
    monkeypatch.setattr(module, "folded", lambda near, trials, fold, first_order=False: [t.any() for t in trials])
    monkeypatch.setattr(module, "window_cost", lambda problem, trials: np.array([problem.of(t) for t in trials]))
    assert prune(near, Deadline(np.inf)).tolist() == [needed]
