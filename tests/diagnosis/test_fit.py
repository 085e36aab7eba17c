"""A fit finds what was put in, says how sure it is, and leaves alone what cannot be followed."""

from dataclasses import replace
from types import SimpleNamespace

import mujoco
import numpy as np
import pytest
from diagnosis.plants import RATE, candidate, double_pendulum, pendulum, record, slider, smooth_torque, take

from torchrl_athletic.diagnosis.fit import (
    Fitted,
    Hypothesis,
    _bootstrap,
    _follows,
    _is_stepped,
    _Problem,
    _weights,
    _with_telling,
    as_trims,
    draw_windows,
    fit,
    idle_terms,
    set_back_together,
    shares_closed,
    without,
)
from torchrl_athletic.diagnosis.prepare import prepare
from torchrl_athletic.diagnosis.replay import Windows, simulate, windows_of
from torchrl_athletic.diagnosis.screen import Candidate
from torchrl_athletic.effects import (
    ActuationDelay,
    CoulombFriction,
    JointAddress,
    JointStop,
    LinkMass,
    Parameter,
    Payload,
    Plant,
    ReflectedInertia,
    TorqueOffset,
    TorqueScale,
    ViscousFriction,
)
from torchrl_athletic.recordings.demo import HiddenEffect, make_recordings
from torchrl_athletic.recordings.demo import pendulum as demo_pendulum


def fit_one(true_xml, effects, seconds=3.0, seed=0, noise=1e-4, start=None, given=None):
    """Fit a recording of ``true_xml`` with effects added to the given model."""
    given = given or pendulum()
    r = record(true_xml, smooth_torque(seconds, seed=seed), noise=noise, seed=seed)
    h = Hypothesis(tuple(candidate(e, r, given) for e in effects))
    t = take(given, r, noise)
    return fit(h, [t], h.nominal if start is None else np.array(start), np.random.default_rng(seed), max_windows=20)


def test_parameters_of_data_made_by_mujoco_come_back():
    true = pendulum(joint='damping="0.12" armature="0.03" frictionloss="0"')
    fitted = fit_one(true, [ViscousFriction(), ReflectedInertia()], seconds=6.0)
    # its semi-implicit steps are half a step ahead of what a reading would be
    assert fitted.values == pytest.approx([0.12, 0.03], rel=0.03)


def test_a_payload_hangs_on_the_link_as_its_other_terms_and_trims_make_it():
    """Whatever the order: a heavier link, its inertia with it, does not weigh what hangs on it a second time."""
    r = record(pendulum(), smooth_torque(1.0))
    hung, link = candidate(Payload(), r, pendulum()), candidate(LinkMass(), r, pendulum())
    model = mujoco.MjModel.from_xml_string(pendulum())
    fields = []
    for h, values in ((Hypothesis((hung, link)), [0.3, 1.2]), (Hypothesis((link,), (hung,)), [1.2, 0.3])):
        plant = Plant(model, JointAddress.of(model, r.joint_names), 1)
        h.build(plant, np.array([values]))
        fields.append(plant.fields)
    body = int(plant.address.body[0])
    assert fields[0]["body_mass"][0, body] == pytest.approx(1.2 + 0.3)
    for name, value in fields[1].items():
        np.testing.assert_array_equal(fields[0][name], value, err_msg=name)


def test_several_takes_are_fitted_together():
    true = slider(joint='damping="1.5"')
    rs = [record(true, smooth_torque(3.0, seed=k), seed=k) for k in range(2)]
    h = Hypothesis((candidate(ViscousFriction(), rs[0], slider()), candidate(TorqueScale(), rs[0], slider())))
    fitted = fit(h, [take(slider(), r) for r in rs], h.nominal, np.random.default_rng(0), max_windows=20)
    assert fitted.values == pytest.approx([1.5, 1.0], rel=0.02)


@pytest.mark.parametrize(
    ("effect", "name", "true"),
    [
        (CoulombFriction(), "coulomb_friction", {"torque": 0.15}),
        (ReflectedInertia(), "reflected_inertia", {"armature": 0.02}),
        (TorqueOffset(), "torque_offset", {"torque": 0.2}),
        (ActuationDelay(), "actuation_delay", {"delay": 0.012}),
    ],
)
def test_parameters_of_an_independent_plant_come_back(effect, name, true):
    robot = demo_pendulum()
    recordings = make_recordings(robot, [HiddenEffect(name, "pendulum", true)], ["gaussian"], duration=5.0)
    model = mujoco.MjModel.from_xml_string(robot.model_xml)
    parameters = effect.parameters(model, JointAddress.of(model, ("pendulum",)), 0)
    h = Hypothesis((Candidate(effect, 0, "pendulum", parameters),))
    takes = prepare(recordings, model).takes
    fitted = fit(h, takes, h.nominal + 0.5 * h.scale, np.random.default_rng(0), max_windows=12)
    assert fitted.values[: len(true)] == pytest.approx(list(true.values()), rel=0.05)


@pytest.mark.parametrize("start", [0.2, 3.0, 50.0])
def test_values_and_intervals_stay_within_their_bounds(start):
    true = pendulum(joint='damping="0"')  # and the torque five times what the bound on its scale allows
    true = true.replace('mass="0.5"', 'mass="0.1"').replace(
        'diaginertia="0.01 0.01 0.01"', 'diaginertia=".002 .002 .002"'
    )
    fitted = fit_one(true, [TorqueScale(), ViscousFriction()], start=[start, 0.0])
    low, high = fitted.hypothesis.bounds
    assert fitted.values[0] == pytest.approx(high[0])
    for values in (fitted.values, *fitted.interval().T):
        assert (values >= low - 1e-9).all()
        assert (values <= high + 1e-9).all()


def test_intervals_cover_the_truth_in_most_cases_and_are_as_wide_as_the_scatter():
    fine = pendulum(step=0.001)  # so that the integrator adds no bias
    true = pendulum(step=0.001, joint='damping="0.12"')
    fits = [fit_one(true, [ViscousFriction()], 3.0, seed, noise=1e-3, given=fine) for seed in range(20)]
    values = np.array([f.values[0] for f in fits])
    low, high = np.array([f.interval()[0] for f in fits]).T
    assert np.mean((low <= 0.12) & (high >= 0.12)) > 0.5
    assert 0.6 < np.median(high - low) / (4 * values.std()) < 1.7


def test_the_same_seed_gives_the_same_answer_and_another_one_a_different_interval():
    one, two = (fit_one(pendulum(joint='damping="0.12"'), [ViscousFriction()], seed=3) for _ in range(2))
    np.testing.assert_array_equal(one.values, two.values)
    np.testing.assert_array_equal(one.samples, two.samples)
    assert one.cost == two.cost
    assert np.ptp(one.samples) > 0


def test_a_number_that_may_not_move_stays_and_the_others_are_found():
    true = pendulum(joint='damping="0.12" armature="0.03" frictionloss="0"')
    r = record(true, smooth_torque(3.0), noise=1e-4)
    viscous, rotor = (candidate(e, r, pendulum()) for e in (ViscousFriction(), ReflectedInertia()))
    held = replace(rotor, parameters=(replace(rotor.parameters[0], lower=0.0, upper=0.0),))
    h = Hypothesis((viscous, held))
    fitted = fit(h, [take(pendulum(), r, 1e-4)], h.nominal, np.random.default_rng(0), max_windows=20)
    assert fitted.values[1] == 0.0
    assert not fitted.samples[:, 1].any()
    assert 0.05 < fitted.values[0] < 0.3


def test_no_effect_at_all_is_a_fit_too():
    fitted = fit_one(pendulum(), [])
    assert fitted.values.shape == (0,)
    assert fitted.interval().shape == (0, 2)


def test_only_takes_that_the_model_follows_are_fitted_end_to_end():
    nothing = Hypothesis(())
    regular = take(pendulum(), record(pendulum(), smooth_torque(5.0)))
    chaotic = take(
        double_pendulum(), record(double_pendulum(), np.zeros((1000, 2)), start=(2.5, 2.0), noise=1e-3), 1e-3
    )
    loose = np.full(1, 1.0)
    assert _follows(nothing, windows_of(regular, None), np.zeros(0), loose)
    assert not _follows(nothing, windows_of(chaotic, None), np.zeros(0), loose)
    assert not _follows(
        nothing, windows_of(regular, None), np.zeros(0), 1e-9 * loose
    )  # it drifts, for what windows show
    short = windows_of(chaotic, 0.1)  # although half a tenth of a second after a start it is followed
    assert np.abs(simulate(short, nothing.build, np.zeros((1, 0)))[0] - short.measured).mean() < 0.02


def test_a_take_is_followed_only_if_every_joint_is():
    calm = windows_of(take(double_pendulum(), record(double_pendulum(), np.zeros((200, 2)), start=(0.3, 0.2))), None)
    loose, tight = 1.0, 1e-12
    assert _follows(Hypothesis(()), calm, np.zeros(0), np.array([loose, loose]))
    for typical in ([loose, tight], [tight, loose], [tight, tight]):
        assert not _follows(Hypothesis(()), calm, np.zeros(0), np.array(typical))


def problem(terms, trims, unit=1.0):
    """A fit of a pendulum with more friction than its model, at some values of terms and trims."""
    r = record(pendulum(joint='damping="0.12"'), smooth_torque(6.0), noise=1e-4)
    h = Hypothesis(*(tuple(candidate(e, r, pendulum()) for e in part) for part in (terms, trims)))
    windows = draw_windows([take(pendulum(), r, 1e-4)], 0.5, 20, np.random.default_rng(0))
    return h, _Problem(h, windows, np.full(len(h.nominal), unit), h.nominal / unit)


def test_a_trim_pays_for_leaving_the_model_and_a_term_does_not():
    """0.3 at its bound, in units of a window that is followed as well as others are."""
    h, fitted = problem([ViscousFriction()], [TorqueScale()], unit=0.5)
    at = {"nominal": h.nominal, "bounds": h.bounds[1], "friction": [h.bounds[1][0], h.nominal[1]]}
    paid = {name: fitted.residual(np.array(values)[:, None] / 0.5)[-2:, 0] for name, values in at.items()}
    assert paid["nominal"].tolist() == paid["friction"].tolist() == [0, 0]
    assert paid["bounds"] == pytest.approx([0, 0.3])


def test_replicates_scatter_about_the_fitted_values_even_if_the_solver_stopped_early():
    """A trim's cost, or a step that was refused, leaves a gradient in the windows; it is no scatter between them."""
    h, fitted = problem([ViscousFriction()], [])
    for early in (0.06, 0.1, 0.119):
        samples, _ = _bootstrap(fitted, np.array([early]), np.random.default_rng(0), *h.bounds)
        assert abs(samples.mean() - early) < 0.3 * samples.std()
        assert samples.std() < 0.5 * (0.12 - 0.05)


def test_nothing_is_known_of_a_parameter_that_changes_nothing():
    """The stiffness of a stop that is never met may be anything within its bounds."""
    h, fitted = problem([ViscousFriction(), JointStop()], [])
    low, high = h.bounds
    never = np.array([0.12, high[1], 1.0, 0.5 * high[3]])
    samples, _ = _bootstrap(fitted, never, np.random.default_rng(0), low, high)
    assert np.ptp(samples[:, 3]) > 0.9 * (high[3] - low[3])
    assert np.ptp(samples[:, 0]) < 0.1


def test_a_push_does_not_steer_the_parameters():
    r = record(pendulum(joint='damping="0.12"'), smooth_torque(6.0), noise=1e-4)
    pushed = r.position.copy()
    pushed[300:350] += 0.3 * np.sin(np.pi * np.arange(50) / 50)[:, None]  # something held it for half a second
    h = Hypothesis((candidate(ViscousFriction(), r, pendulum()),))
    disturbed = type(r)(r.time, r.joint_names, pushed, torque_command=r.torque_command)
    fitted = fit(h, [take(pendulum(), disturbed, 1e-4)], h.nominal, np.random.default_rng(0))
    assert fitted.values == pytest.approx([0.12], rel=0.15)


def test_windows_are_drawn_evenly_over_the_takes():
    takes = [take(pendulum(), record(pendulum(), smooth_torque(s))) for s in (10.0, 5.0)]
    drawn = draw_windows(takes, 0.1, 45, np.random.default_rng(0))
    assert [len(w.start) for w in drawn] == [30, 15]
    for w in drawn:
        assert len(set(w.start.tolist())) == len(w.start)
        assert set(w.start.tolist()) <= set(windows_of(w.take, 0.1).start.tolist())
    everything = draw_windows(takes, 0.1, 10_000, np.random.default_rng(0))
    assert sum(w.index.size for w in everything) == sum(windows_of(t, 0.1).index.size for t in takes)


def test_a_hypothesis_hands_out_the_numbers_of_each_candidate():
    r = record(pendulum(), smooth_torque(1.0))
    friction, delay, scale = (candidate(e, r, pendulum()) for e in (ViscousFriction(), ActuationDelay(), TorqueScale()))
    h = Hypothesis((friction, delay), trims=(scale,))
    values = np.array([0.1, 0.02, 1.03])
    assert [float(h.values_of(c, values)[0]) for c in (scale, friction, delay)] == [1.03, 0.1, 0.02]
    assert h.nominal.tolist() == [0.05, 0.0, 1.0]
    with pytest.raises(ValueError, match="not part of the hypothesis"):
        h.values_of(candidate(TorqueOffset(), r, pendulum()), values)


def stopped(*pushes, seconds=40.0):
    """A pendulum that meets a stop once or twice in 40 s, when a push carries it there."""
    torque = 0.3 * smooth_torque(seconds)
    for push in pushes:
        torque[push : push + 40] += 3.0
    free = pendulum()
    model = mujoco.MjModel.from_xml_string(free)
    data, position = mujoco.MjData(model), []
    for u in torque[:, 0]:
        position.append(float(data.qpos[0]))
        for _ in range(round(1 / RATE / model.opt.timestep)):
            data.qfrc_applied[:] = u - 100.0 * max(data.qpos[0] - 0.7, 0.0)
            mujoco.mj_step(model, data)
    r = replace(record(free, torque), position=np.array(position)[:, None])
    assert 0 < (r.position > 0.7).sum() < 0.05 * len(r.time)  # it is a rare thing
    return free, r


@pytest.mark.parametrize("pushes", [(2000, 3000), (2000,)], ids=["twice", "once"])
def test_a_stop_that_is_seldom_met_is_not_idle_and_a_spring_that_does_nothing_is(pushes):
    free, r = stopped(*pushes)
    stop, friction = candidate(JointStop(), r, free), candidate(ViscousFriction(), r, free)
    h = Hypothesis((stop, friction))
    values = np.array([0.7, 1.0, 100.0, 0.05001])  # the friction is that of the given model
    fitted = Fitted(h, values, np.zeros((1, 4)), 0.0)
    assert idle_terms(fitted, [take(free, r, 1e-4)], np.random.default_rng(0)) == (friction,)
    nowhere = Fitted(h, np.array([2.5, 1.0, 100.0, 0.06]), np.zeros((1, 4)), 0.0)  # a stop that is never met
    assert stop in idle_terms(nowhere, [take(free, r, 1e-4)], np.random.default_rng(0))


def test_no_draw_of_windows_misses_a_stop_that_is_met_once_in_three_minutes():
    free, r = stopped(15000, seconds=180.0)
    stop = candidate(JointStop(), r, free)
    fitted = Fitted(Hypothesis((stop,)), np.array([0.7, 1.0, 100.0]), np.zeros((1, 3)), 0.0)
    t = take(free, r, 1e-4)
    assert not any(idle_terms(fitted, [t], np.random.default_rng(seed)) for seed in range(12))


def test_a_term_that_moves_the_simulation_away_from_the_recording_is_idle():
    r = record(pendulum(), smooth_torque(6.0), noise=1e-4)
    friction = candidate(ViscousFriction(), r, pendulum())
    worse = Fitted(Hypothesis((friction,)), np.array([0.2]), np.zeros((1, 1)), 0.0)
    assert idle_terms(worse, [take(pendulum(), r, 1e-4)], np.random.default_rng(0)) == (friction,)


def shares(moved, error, error_without, monkeypatch, near=(1.0, 1.0), joints=None, together=None, motion=np.inf):
    """Of terms on two joints, of mean squares over windows; what several together do is no less if it is not said."""
    terms = tuple(
        SimpleNamespace(key=("term", str(k)), joint_name=joint)
        for k, joint in enumerate(joints or [str(k) for k in range(len(moved))])
    )
    whole = together or ([np.max(error_without, axis=0) * 1e12] if len(moved) > 1 else [])
    without = [*error_without, *whole]
    told = lambda h, drawn, values, sets: tuple(np.array(x, dtype=float) for x in (moved, error, without))  # noqa: E731
    monkeypatch.setitem(shares_closed.__globals__, "_actions", told)
    monkeypatch.setitem(shares_closed.__globals__, "motion_of", lambda windows: motion)
    fitted = Fitted(SimpleNamespace(terms=terms), np.zeros(1), np.zeros((0, 1)), 0.0)
    return list(shares_closed(fitted, [], np.array(near)).values())


def test_a_term_closes_its_part_of_what_is_open_beside_it_at_the_joints_that_it_moves(monkeypatch):
    error = [[5.0, 101.0], [5.0, 101.0]]  # four and a hundred over what counts as followed
    first, second, nowhere = ([[17.0, 101.0]] * 2, [[5.0, 126.0]] * 2, error)
    moved = [[[12.0, 0.0]] * 2, [[0.0, 25.0]] * 2, [[0.0, 0.0]] * 2]
    found = shares(moved, error, [first, second, nowhere], monkeypatch)
    assert found == [pytest.approx(12 / 16), pytest.approx(25 / 125), 0.0]
    assert shares(moved, error, [first, second, nowhere], monkeypatch, near=(100.0, 100.0)) == [1.0, 1.0, 1.0]


def test_a_term_of_the_whole_robot_closes_what_it_closes_of_one_joint_and_its_harm_elsewhere_counts(monkeypatch):
    alike = shares([[[10.0, 10.0]] * 2], [[91.0, 91.0]] * 2, [[[101.0, 101.0]] * 2], monkeypatch)
    alone = shares([[[10.0, 0.0]] * 2], [[91.0, 91.0]] * 2, [[[101.0, 91.0]] * 2], monkeypatch)
    assert alike == alone == [pytest.approx(0.1)]
    assert shares([[[9.0, 9.0]] * 2], [[2.0, 20.0]] * 2, [[[12.0, 9.0]] * 2], monkeypatch)[0] < 0.5
    assert shares([[[9.0, 9.0]] * 2], [[2.0, 2.0]] * 2, [[[12.0, 9.0]] * 2], monkeypatch)[0] > 0.8


def test_what_falls_without_a_term_errs_by_a_radian_or_its_motion_at_most(monkeypatch):
    """Else two numbers that keep a joint from falling would each close all, however badly it follows with them."""
    moved, error, fallen = [[[900.0, 0.0]] * 2], [[0.5, 0.0]] * 2, [[[900.0, 0.0]] * 2]
    for motion, most in ((0.1, 1.0), (4.0, 4.0)):
        found = shares(moved, error, fallen, monkeypatch, near=(0.1, 0.1), motion=np.full((2, 2), motion))
        assert found == [pytest.approx(1 - 0.49 / (most - 0.01), rel=0.02)]
        half = [[900.0, 0.0], [0.5, 0.0]]  # with it one window falls as well
        lost = shares(moved, half, fallen, monkeypatch, near=(0.1, 0.1), motion=np.full((2, 2), motion))
        assert lost == [pytest.approx(1 - np.sqrt(0.5 / most))]  # of the typical window


def test_a_term_that_does_harm_closes_nothing_and_without_terms_nothing_is_asked(monkeypatch):
    assert shares([[[4.0, 0.0]]], [[9.0, 9.0]], [[[5.0, 9.0]]], monkeypatch) == [0.0]
    assert shares([], [[9.0, 9.0]], np.zeros((0, 1, 2)), monkeypatch) == []


def test_of_all_windows_and_the_typical_one_the_larger_share_counts(monkeypatch):
    moved = [[[8.0, 0.0]] * 4]
    lost = [[2.0, 0.0], [2.0, 0.0], [2.0, 0.0], [9994.0, 0.0]]  # one window has fallen, and hides what the others show
    without = [[8.0, 0.0], [8.0, 0.0], [8.0, 0.0], [9994.0, 0.0]]
    assert shares(moved, lost, [without], monkeypatch) == [pytest.approx(1 - 0.25**0.75)]
    pushed = [[2.0, 0.0], [2.0, 0.0], [2.0, 0.0], [86.0, 0.0]]  # a push comes once
    assert shares(moved, [[2.0, 0.0]] * 4, [pushed], monkeypatch) == [pytest.approx(21 / 22)]


def test_halves_that_undo_each_other_close_no_more_than_both_together(monkeypatch):
    """Each alone is far off without the other; the given model was hardly worse than both."""
    moved, error, alone = [[[90.0, 0.0]] * 2] * 2, [[2.0, 0.0]] * 2, [[[92.0, 0.0]] * 2] * 2
    given = [[2.5, 0.0]] * 2
    assert shares(moved, error, alone, monkeypatch) == [pytest.approx(90 / 91)] * 2
    at_one_joint = shares(moved, error, alone, monkeypatch, joints=["hip", "hip"], together=[given])
    assert at_one_joint == [pytest.approx(0.5 / 1.5)] * 2
    # what is beside them at another joint is as it was: there nothing of the given model's error is closed with them
    far, beside = [[[90.0, 0.0]] * 2] * 2 + [[[0.0, 9.0]] * 2], [[2.0, 2.0]] * 2
    alone = [[[92.0, 2.0]] * 2] * 2 + [[[2.0, 11.0]] * 2]
    of_three = shares(
        far, beside, alone, monkeypatch, joints=["hip", "hip", "knee"],
        together=[[[2.5, 2.0]] * 2, [[2.5, 11.0]] * 2],
    )  # fmt: skip
    assert of_three == [pytest.approx(0.5 / 1.5)] * 2 + [pytest.approx(0.9)]


def test_terms_are_set_back_alone_by_joints_and_all():
    on = lambda *joints: SimpleNamespace(terms=[SimpleNamespace(joint_name=j) for j in joints])  # noqa: E731
    assert set_back_together(on("hip")) == [[0]]
    assert set_back_together(on("hip", "knee")) == [[0], [1], [0, 1]]
    assert set_back_together(on("hip", "hip")) == [[0], [1], [0, 1]]
    assert set_back_together(on("hip", None, "hip", None)) == [[0], [1], [2], [3], [0, 2], [1, 3], [0, 1, 2, 3]]
    assert set_back_together(on()) == []


def test_a_strong_drive_and_much_damping_beside_a_model_that_is_right_close_nothing():
    """Either closes what the other does; the given model needs neither."""
    xml = pendulum(joint='damping="0.25" frictionloss="0.2" armature="0.001"')
    r = record(xml, smooth_torque(6.0), noise=1e-4)
    damping, scale = (candidate(e, r, xml) for e in (ViscousFriction(), TorqueScale()))
    drawn = draw_windows([take(xml, r, 1e-4)], 0.5, 100, np.random.default_rng(0))
    both = Fitted(Hypothesis((damping, scale)), np.array([0.3, 1.05]), np.zeros((1, 2)), 0.0)
    assert max(shares_closed(both, drawn, np.array([1e-3])).values()) < 0.05


def test_what_is_true_closes_what_a_stand_in_beside_it_does_not():
    r = record(pendulum(joint='damping="0.25"'), smooth_torque(6.0), noise=1e-4)
    damping, offset = (candidate(e, r, pendulum()) for e in (ViscousFriction(), TorqueOffset()))
    drawn = draw_windows([take(pendulum(), r, 1e-4)], 0.5, 100, np.random.default_rng(0))
    both = Fitted(Hypothesis((damping, offset)), np.array([0.24, 0.01]), np.zeros((1, 2)), 0.0)
    found = shares_closed(both, drawn, np.array([1e-3]))
    assert found[damping.key] > 0.9
    assert found[offset.key] < 0.3
    assert shares_closed(Fitted(Hypothesis(()), np.zeros(0), np.zeros((1, 0)), 0.0), drawn, np.array([1e-3])) == {}


def test_windows_in_which_a_term_acts_are_always_fitted():
    free, r = stopped(2000, 3000)
    t = take(free, r, 1e-4)
    h = Hypothesis((candidate(JointStop(), r, free),))
    drawn = draw_windows([t], 0.5, 3, np.random.default_rng(0))
    (windows,) = _with_telling(h, [t], np.array([0.7, 1.0, 100.0]), drawn, np.random.default_rng(0))
    met = np.flatnonzero(r.position[:, 0] > 0.7)
    assert any(((met >= s) & (met < s + windows.length)).any() for s in windows.start)
    assert set(drawn[0].start.tolist()) <= set(windows.start.tolist())


def test_what_becomes_a_trim_keeps_its_value():
    r = record(pendulum(), smooth_torque(1.0))
    friction, delay, scale = (candidate(e, r, pendulum()) for e in (ViscousFriction(), ActuationDelay(), TorqueScale()))
    samples = np.arange(6.0).reshape(2, 3)
    fitted = Fitted(Hypothesis((friction, delay), (scale,)), np.array([0.1, 0.02, 1.03]), samples, 0.0)
    moved = as_trims(fitted, [friction])
    assert moved.hypothesis.terms == (delay,)
    assert moved.hypothesis.trims == (friction, scale)
    for c in (friction, delay, scale):
        before, after = (f.hypothesis.values_of(c, f.values) for f in (fitted, moved))
        np.testing.assert_array_equal(before, after)
        before, after = (f.hypothesis.values_of(c, f.samples) for f in (fitted, moved))
        np.testing.assert_array_equal(before, after)


def windows_like(length, *starts):
    """Windows of a take of two joints that rest, sampled every 10 ms."""
    t = SimpleNamespace(period=0.01, measured=np.zeros((300, 2)))
    return Windows(t, np.array(starts), length)


def test_a_window_weighs_by_its_length_over_its_error_and_less_where_it_is_not_followed():
    """Half a second off by the typical error, and by three times as much; a take of two seconds, by its own."""
    typical = np.array([0.1, 0.2])
    short = windows_like(50, 0, 50)
    predicted = np.ones((2, 50, 1)) * np.array([[[0.1, 0.2]], [[0.3, 0.6]]])
    per_row = np.sqrt(50 * 2)
    np.testing.assert_allclose(
        _weights(short, predicted, typical) * per_row,
        [[1 / np.sqrt(1 + 1 / 9) / 0.1, 1 / np.sqrt(1 + 1 / 9) / 0.2], [np.sqrt(0.5) / 0.1, np.sqrt(0.5) / 0.2]],
    )
    whole = windows_like(200, 0)
    drifts = np.ones((1, 200, 1)) * np.array([0.4, 0.05])
    np.testing.assert_allclose(_weights(whole, drifts, typical) * np.sqrt(200 * 2), [[2 / 0.4, 2 / 0.2]])
    quick = _weights(windows_like(25, 0), np.zeros((1, 25, 2)), typical) * np.sqrt(25 * 2)
    np.testing.assert_allclose(quick, [[np.sqrt(0.5) / 0.1, np.sqrt(0.5) / 0.2]])


def test_a_window_is_a_block_of_the_bootstrap_and_a_take_that_is_followed_is_four():
    fitted = object.__new__(_Problem)
    fitted.windows = [windows_like(3, 0, 3), windows_like(101, 0), windows_like(102, 0), windows_like(100, 0)]
    fitted.weight = [np.zeros((2, 2))]
    blocks = np.bincount(fitted.groups())
    # a second and a hundredth is long: quarters of 26, of which the last is shorter
    assert blocks.tolist() == [6, 6, 52, 52, 52, 46, 52, 52, 52, 48, 200]


def test_an_interval_leaves_a_fortieth_out_at_either_end():
    samples = np.stack([np.arange(1001.0), -2 * np.arange(1001.0)], 1)
    np.testing.assert_allclose(Fitted(Hypothesis(()), np.zeros(2), samples, 0.0).interval(), [[25, 975], [-1950, -50]])


def test_what_is_left_out_of_a_fit_takes_its_own_numbers_with_it():
    r = record(pendulum(), smooth_torque(1.0))
    friction, delay, scale = (candidate(e, r, pendulum()) for e in (ViscousFriction(), ActuationDelay(), TorqueScale()))
    fitted = Fitted(
        Hypothesis((friction, delay), (scale,)), np.array([1.0, 2.0, 3.0]), np.arange(6.0).reshape(2, 3), 0.5
    )
    left = without(fitted, [friction])
    assert (left.hypothesis.terms, left.hypothesis.trims) == ((delay,), (scale,))
    assert (left.values.tolist(), left.samples.tolist(), left.cost) == ([2.0, 3.0], [[1.0, 2.0], [4.0, 5.0]], 0.5)
    assert without(fitted, [scale]).values.tolist() == [1.0, 2.0]
    nothing = without(fitted, [friction, delay, scale])
    assert (nothing.values.shape, nothing.samples.shape) == ((0,), (2, 0))


@pytest.mark.parametrize(
    ("target", "open_loop", "stepped"), [(None, True, False), (None, False, True), (1, True, True)]
)
def test_the_state_is_looked_at_each_step_where_a_loop_closes(monkeypatch, target, open_loop, stepped):
    plant = SimpleNamespace(open_loop=None)
    built = lambda plant, values: setattr(plant, "open_loop", open_loop)  # noqa: E731
    monkeypatch.setitem(_is_stepped.__globals__, "Plant", lambda model, address, rows: plant)
    t = SimpleNamespace(model=None, address=None, recording=SimpleNamespace(position_target=target))
    assert _is_stepped(SimpleNamespace(build=built), t, np.zeros(1)) is stepped


@pytest.mark.parametrize(("targets", "most"), [([None, None], 1000), ([None, 1], 333)])
def test_fewer_windows_are_looked_at_where_a_controller_closes_the_loop(monkeypatch, targets, most):
    takes = [SimpleNamespace(recording=SimpleNamespace(position_target=t)) for t in targets]
    monkeypatch.setitem(_with_telling.__globals__, "_actions", lambda *_: (np.ones((1, 1, 1)), np.ones((1, 1)), None))
    asked = []
    nothing = lambda takes, seconds, count, rng: asked.append(count) or []  # noqa: E731
    monkeypatch.setitem(_with_telling.__globals__, "draw_windows", nothing)
    h = SimpleNamespace(terms=("term",))
    _with_telling(h, takes, np.zeros(1), [], np.random.default_rng(0))
    assert asked == [most]


# --- terms that do nothing, windows that tell, and what a trim pays, by hand ---


def actions(*windows: tuple[float, float, float]) -> np.ndarray:
    """One term's motion, the error with it and the error without it, all of the first joint. Shape (3, W, J)."""
    return np.stack([np.array(windows).T, np.ones((3, len(windows)))], -1) * [1.0, 1e-6]


@pytest.mark.parametrize(
    ("windows", "idle"),
    [
        ([(4.0, 1.0, 5.0)] * 2, False),
        ([(0.2, 1.0, 1.2)] * 9, True),  # it moves less than half of what is left
        ([(0.3, 1.0, 1.3)] * 9, False),  # mean squares: half of the motion is a quarter of them
        ([(4.0, 1.0, 2.1)] * 9, True),  # of its motion three tenths are error without it, of a true one all is
        ([(4.0, 1.0, 2.3)] * 9, False),
        ([(4.0, 1.0, 5.0)] + [(0.0, 1.0, 1.0)] * 9, True),  # once by accident
        ([(4.0, 0.4, 5.0)] + [(0.0, 1.0, 1.0)] * 9, False),  # once, and nearly all is explained
        ([(4.0, 1.0, 5.0)] * 3 + [(4.0, 1.0, 0.5)] * 4, True),  # in less than half of where it acts
        ([(4.0, 1.0, 5.0)] * 3 + [(4.0, 1.0, 0.5)] * 3, False),
    ],
)
@pytest.mark.parametrize(("joint", "size"), [(0, 1.0), (1, 1e-4)])
def test_a_term_is_idle_unless_it_moves_what_is_left_and_to_its_good(windows, idle, joint, size, monkeypatch):
    moved, error, error_without = size * np.roll(actions(*windows), joint, axis=2)
    told = lambda h, drawn, values: (moved[None], error, error_without[None])  # noqa: E731
    monkeypatch.setitem(idle_terms.__globals__, "_actions", told)
    monkeypatch.setitem(idle_terms.__globals__, "draw_windows", lambda *_: [])
    fitted = Fitted(SimpleNamespace(terms=("term",)), np.zeros(1), np.zeros((0, 1)), 0.0)
    assert idle_terms(fitted, [], np.random.default_rng(0)) == (("term",) if idle else ())


def test_two_joints_that_a_term_helps_once_each_are_no_two_windows(monkeypatch):
    once = np.array([[4.0, 0.0], [0.0, 4.0]])  # windows, joints
    told = lambda h, drawn, values: (once[None], np.ones((2, 2)), 1.0 + once[None])  # noqa: E731
    monkeypatch.setitem(idle_terms.__globals__, "_actions", told)
    monkeypatch.setitem(idle_terms.__globals__, "draw_windows", lambda *_: [])
    fitted = Fitted(SimpleNamespace(terms=("term",)), np.zeros(1), np.zeros((0, 1)), 0.0)
    assert idle_terms(fitted, [], np.random.default_rng(0)) == ("term",)


def test_telling_windows_of_all_takes_join_those_that_were_drawn(monkeypatch):
    """Takes have three and two windows: one term acts most in the last two of all, the other in the one before them."""
    full = [Windows("one", np.array([0, 10, 20]), 10), Windows("two", np.array([0, 10]), 10)]
    moved = np.zeros((2, 5, 2))
    moved[0, 3:, 1], moved[1, 2, 0], moved[1, 3, 0], moved[0, 1, 0] = [3.0, 4.0], 5.0, 4.0, 8.0
    error = np.array([[1.0, 1.0], [9.0, 1.0], [1.0, 1.0], [1.0, 1.0], [1.0, 1.0]])  # much is left where it moves most
    names = _with_telling.__globals__
    monkeypatch.setitem(names, "SIMULATION", replace(names["SIMULATION"], telling=2))
    monkeypatch.setitem(names, "draw_windows", lambda *_: full)
    monkeypatch.setitem(names, "_looked_at", lambda takes: 5)
    monkeypatch.setitem(names, "_actions", lambda *_: (moved, error, None))
    h = SimpleNamespace(terms=("first", "second"))
    drawn = [Windows("one", np.array([0]), 10)]
    found = _with_telling(h, ["one", "two"], np.zeros(1), drawn, np.random.default_rng(0))
    assert {w.take: w.start.tolist() for w in found} == {"one": [0, 20], "two": [0, 10]}
    assert _with_telling(SimpleNamespace(terms=()), [], np.zeros(0), drawn, np.random.default_rng(0)) is drawn


def test_a_trim_at_its_end_costs_a_tenth_of_a_typical_error_and_a_term_nothing(monkeypatch):
    given = [("term", 1.0, 0.0, 5.0, 0.5), ("trim", 2.0, 1.0, 4.0, 0.1)]
    term, trim = (
        Candidate(SimpleNamespace(name=name), 0, "hip", (Parameter(name, "1", nominal, low, high, scale),))
        for name, nominal, low, high, scale in given
    )
    windows = [windows_like(50, 0, 50, 100)]
    monkeypatch.setattr(_Problem, "predict", lambda self, x: [np.full((x.shape[1], 3, 50, 2), 0.1)])
    h = Hypothesis((term,), (trim,))
    problem = _Problem(h, windows, np.array([0.5, 0.1]), np.array([2.0, 20.0]))
    at_nominal, beyond = np.array([[2.0], [20.0]]), np.array([[10.0], [40.0]])  # in units; the ends of both
    assert problem.residual(at_nominal)[-2:, 0].tolist() == [0.0, 0.0]
    assert problem.residual(beyond)[-2:, 0] == pytest.approx([0.0, 0.3])
    both = problem.residual(np.hstack([at_nominal, beyond]))
    assert both.shape == (3 * 50 * 2 + 2, 2)
    assert (both[:-2, 0] ** 2).sum() == pytest.approx(3 / (1 + 1 / 9))  # three windows, of typical errors


def test_a_short_take_keeps_a_window_however_few_are_drawn(monkeypatch):
    full = {"long": windows_like(10, *range(0, 290, 10)), "short": windows_like(10, 0), "none": windows_like(10)}
    monkeypatch.setitem(draw_windows.__globals__, "windows_of", lambda take, seconds: full[take])
    drawn = draw_windows(["long", "short", "none"], 0.1, 6, np.random.default_rng(0))
    assert [len(w.start) for w in drawn] == [6, 1]
    assert (np.diff(drawn[0].start) > 0).all()
    assert [len(w.start) for w in draw_windows(["long", "short", "none"], 0.1, 30, np.random.default_rng(0))] == [29, 1]


def test_what_is_no_part_of_a_hypothesis_has_no_values_in_it():
    r = record(pendulum(), smooth_torque(1.0))
    friction, scale = (candidate(e, r, pendulum()) for e in (ViscousFriction(), TorqueScale()))
    with pytest.raises(ValueError, match="torque_scale"):
        Hypothesis((friction,)).values_of(scale, np.zeros(1))


# --- the order of a fit, and its parts on problems with a known answer ---


@pytest.mark.parametrize("stepped", [False, True])
@pytest.mark.parametrize("followed", [("b",), ()])
def test_a_fit_goes_from_short_windows_to_telling_ones_to_takes_that_it_follows_from_end_to_end(
    monkeypatch, stepped, followed
):
    """In units of a quarter of what may be, or of the scale; a loop that is stepped through has one shorter round."""
    own = [Parameter("p0", "1", 0.0, 0.0, 2.0, 1.0), Parameter("p1", "1", 0.0, -50.0, 50.0, 2.5)]
    h = Hypothesis((Candidate(SimpleNamespace(name="law"), 0, "hip", tuple(own)),))
    takes, names = [SimpleNamespace(parts=("a", "b")), SimpleNamespace(parts=("c",))], fit.__globals__
    drawn, solved, told = [], [], {}
    rng = np.random.default_rng(0)

    def telling(hypothesis, its_takes, values, windows, dice):
        assert (hypothesis, its_takes, dice) == (h, takes, rng)
        told["begin"] = values.tolist()
        return [*windows, "telling"]

    def solve(problem, x, low, high, iterations):
        solved.append((problem[1], (low.tolist(), high.tolist()), iterations))
        assert problem[0] is h
        assert problem[2].tolist() == [0.5, 2.5]
        np.testing.assert_array_equal(problem[3], x)
        return x + 1.0

    def bootstrap(problem, x, dice, low, high):
        told["bootstrap"] = (problem[1], x.tolist(), low.tolist(), high.tolist())
        return np.ones((3, 2)), 0.25

    stand_ins = {
        "_is_stepped": lambda hypothesis, take, values: stepped and take is takes[1] and values.tolist() == [2.0, 2.5],
        "draw_windows": lambda its_takes, seconds, most, dice: drawn.append((seconds, most)) or [f"{seconds} s"],
        "_with_telling": telling, "_solve": solve, "_Problem": lambda *given: given, "_bootstrap": bootstrap,
        "simulate": lambda w, build, values: [f"end of {w} at {values.tolist()}"],
        "window_rmse": lambda windows, ends: told.update(ends=ends) or ("typical", None),
        "windows_of": lambda part, seconds: (part, seconds),
        "_follows": lambda hypothesis, w, values, typical: (
            w[0] in followed and w[1] is None and (typical, [values.tolist()]) == ("typical", ended)
        ),
    }  # fmt: skip
    for name, stand_in in stand_ins.items():
        monkeypatch.setitem(names, name, stand_in)
    rounds, last = 1 if stepped else 2, ["0.5 s", "telling"]
    ended = [[0.5 * (4.0 + rounds), 2.5 * (1.0 + rounds)]]
    progress = []
    found = fit(h, takes, np.array([3.0, 2.5]), rng, max_windows=60, max_iter=8, progress=progress.append)
    bounds = ([0.0, -20.0], [4.0, 20.0])
    whole = [(part, None) for part in followed if not stepped]
    shot = [(last, bounds, 4)] if stepped else [(["0.2 s"], bounds, 8), (last, bounds, 8)]
    assert drawn == ([(0.5, 30)] if stepped else [(0.2, 60), (0.5, 60)])
    assert told["begin"] == [2.0, 2.5]  # within the bounds
    assert solved == shot + [(last + whole, bounds, 4)] * bool(whole)
    steps = len(solved)
    assert told["ends"] == [f"end of {w} at {ended}" for w in last]
    assert told["bootstrap"] == (last + whole, [4.0 + steps, 1.0 + steps], *bounds)
    assert found.values.tolist() == [2.0, 2.5 * (1.0 + steps)]
    assert (found.samples.tolist(), found.cost) == ([[0.5, 2.5]] * 3, 0.25)
    assert progress == pytest.approx([(k + 1) / (rounds + 1) for k in range(rounds + 1)])


def test_short_windows_say_what_is_typical_of_each_joint_whatever_stands_before_them(monkeypatch):
    whole, short = windows_like(200, 0), windows_like(50, 0, 50, 100)
    errors = [np.full((1, 200, 2), 9.0), np.full((3, 50, 2), [0.1, 0.2])]
    monkeypatch.setattr(_Problem, "predict", lambda self, x: [e[None] for e in errors])
    problem = _Problem(Hypothesis(()), [whole, short], np.zeros(0), np.zeros(0))
    np.testing.assert_allclose(problem.weight[1] * 10.0, [[10.0, 5.0] / np.sqrt(1 + 1 / 9)] * 3)
    np.testing.assert_allclose(problem.weight[0] * 20.0, [[2 / 9.0] * 2])  # of two seconds, by its own error


def test_a_take_is_followed_within_a_tenth_of_each_joints_own_travel(monkeypatch):
    travel = np.linspace(0.0, 1.0, 21)[None, :, None] * [1.0, 0.1] + 10.0
    whole, names = SimpleNamespace(start=np.zeros(1), measured=travel), _follows.__globals__
    monkeypatch.setitem(names, "simulate", lambda w, build, values: ["end"])
    for error, loose in (((0.09, 0.009), True), ((0.11, 0.009), False), ((0.09, 0.011), False)):
        monkeypatch.setitem(names, "window_rmse", lambda windows, ends, error=error: (np.array(error), None))
        assert _follows(Hypothesis(()), whole, np.zeros(0), np.ones(2)) is loose
    whole.start = np.zeros(0)
    assert not _follows(Hypothesis(()), whole, np.zeros(0), np.ones(2))


@pytest.mark.parametrize("at_once", [2, 200])
def test_what_a_term_does_is_told_by_its_absence_window_by_window(monkeypatch, at_once):
    """By hand: a reading is twice the first number and thrice the second, which are 1 and 2, and 0.5 and 0 as given."""
    own = [(Parameter(name, "1", given, 0.0, 9.0, 1.0),) for name, given in (("p0", 0.5), ("p1", 0.0))]
    terms = tuple(Candidate(SimpleNamespace(name=f"law{k}"), k, "hip", p) for k, p in enumerate(own))
    h, names = Hypothesis(terms), _with_telling.__globals__
    monkeypatch.setitem(names, "SIMULATION", replace(names["SIMULATION"], at_once=at_once))

    def simulated(w, build, values):
        assert len(w.start) <= at_once
        read = (2 * values[:, 0] + 3 * values[:, 1])[:, None, None, None] * np.array([1.0, 2.0])
        return read * np.ones((1, len(w.start), 4, 1)) * beat[None, None, :, None]

    monkeypatch.setitem(names, "simulate", simulated)
    beat = np.sqrt([0.0, 0.0, 1.0, 3.0])  # of a mean square of one
    measured = np.repeat([8.0, 1.0], [4, 16])[:, None] * np.tile(beat, 5)[:, None] * np.ones(2)
    take = SimpleNamespace(measured=np.vstack([np.zeros((1, 2)), measured]))
    windows = [Windows(take, np.array([0, 4, 8]), 4), Windows(take, np.array([12]), 4)]
    values = np.array([1.0, 2.0])
    moved, error, error_without = names["_actions"](h, windows, values)
    assert values.tolist() == [1.0, 2.0]
    np.testing.assert_allclose(moved, [[[1.0, 4.0]] * 4, [[36.0, 144.0]] * 4])
    np.testing.assert_allclose(error, [[0.0, 64.0], *[[49.0, 225.0]] * 3])
    np.testing.assert_allclose(error_without[0], [[1.0, 36.0], *[[36.0, 169.0]] * 3])
    np.testing.assert_allclose(error_without[1], [[36.0, 16.0], *[[1.0, 9.0]] * 3])


def test_replicates_scatter_by_the_windows_gradients_over_their_curvature_and_that_of_the_tolerances():
    """A mean of 60 windows with slopes of 1 and residuals of ±1 scatters by 1 / √60; a prior as strong halves that."""

    def linear(prior):
        slope = np.append(np.ones(60), prior)
        rest = np.append(np.where(np.arange(60) % 2, 1.0, -1.0), -prior * 3.0)  # a tolerance that is used pulls
        problem = SimpleNamespace(groups=lambda: np.arange(60))
        problem.residual = lambda x: slope[:, None] * x + rest[:, None]
        return problem

    far = np.array([-99.0]), np.array([99.0])
    for prior, spread in ((0.0, 1 / np.sqrt(60)), (np.sqrt(60.0), 0.5 / np.sqrt(60))):
        samples, cost = _bootstrap(linear(prior), np.zeros(1), np.random.default_rng(0), *far)
        assert samples.shape == (200, 1)
        assert samples.std() == pytest.approx(spread, rel=0.15)
        assert abs(samples.mean()) < 0.2 * spread
        assert cost == pytest.approx(1.0)


def test_least_squares_end_at_the_bound_before_their_answer():
    problem = SimpleNamespace(residual=lambda x: np.concatenate([x - [[3.0], [-1.0]], 0.1 * x]))
    x = fit.__globals__["_solve"](problem, np.zeros(2), np.array([-5.0, -0.5]), np.array([2.0, 5.0]), 8)
    assert x == pytest.approx([2.0, -0.5], abs=1e-3)
