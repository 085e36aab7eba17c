"""A fit finds the numbers of joints whose motion is known in closed form or comes from another integrator."""

import json
import sys
from dataclasses import replace
from functools import partial
from types import SimpleNamespace

import mujoco
import numpy as np
import pytest
from diagnosis.plants import pendulum, smooth_torque

from torchrl_athletic.diagnosis import Fit, fit, fit_command
from torchrl_athletic.diagnosis.corrected import Simulation
from torchrl_athletic.diagnosis.deadline import Deadline
from torchrl_athletic.diagnosis.fit import Hypothesis
from torchrl_athletic.diagnosis.fit_command import FitConfig, fit_table, main
from torchrl_athletic.diagnosis.fitting import JointParameter, _binds, _taken_back
from torchrl_athletic.diagnosis.result import Score
from torchrl_athletic.diagnosis.screen import Candidate
from torchrl_athletic.effects import Parameter
from torchrl_athletic.recordings import Recording, write_recording

fitting = sys.modules["torchrl_athletic.diagnosis.fitting"]
STEP = 0.005
RATE = 100.0
INERTIA, GRAVITY_TORQUE = 0.09, 0.5 * 9.81 * 0.4  # of the model
NOISE = 1e-4


def bench() -> str:
    """The pendulum, and a turntable beside it that nothing moves."""
    table = """<body name="table" pos="1 0 0"><joint name="table" axis="0 0 1"/>
      <inertial pos="0 0 0" mass="1" diaginertia="0.1 0.1 0.1"/></body></worldbody>"""
    return pendulum(STEP).replace("</worldbody>", table)


def integrated(
    command, seed=0, *, friction=0.0, damping=0.05, rotor=0.0, scale=1.0, late=0.0, fine=20, start=0.0
) -> np.ndarray:
    """Positions at the samples, by steps of half a millisecond that are not MuJoCo's. Shape (T, 1)."""
    step = 1 / RATE / fine
    held = np.repeat(command[:, 0], fine)
    delayed = np.concatenate([np.zeros(round(late / step)), held])[: len(held)]
    q, v, out = start, 0.0, []
    for k, u in enumerate(delayed):
        if k % fine == 0:
            out.append(q)
        torque = scale * u - GRAVITY_TORQUE * np.sin(q) - damping * v
        free = v + step * torque / (INERTIA + rotor)
        v = np.sign(free) * max(abs(free) - step * friction / (INERTIA + rotor), 0.0)
        q += step * v
    return np.array(out)[:, None] + NOISE * np.random.default_rng(seed).standard_normal((len(out), 1))


def recording(command, position, names=("pendulum",)) -> Recording:
    still = np.zeros((len(command), len(names) - 1))
    return Recording(
        np.arange(len(command)) / RATE, names, np.hstack([position, still]), torque_command=np.hstack([command, still])
    )


def parameter(fitted: Fit, effect: str, joint: str = "pendulum", name: str | None = None):
    [found] = [p for p in fitted.parameters if (p.effect, p.joint) == (effect, joint) and name in (None, p.name)]
    return found


@pytest.fixture(scope="module")
def concealed(tmp_path_factory) -> tuple[Fit, dict]:
    """Dry friction, a rotor and a weak, late motor; and what was written."""
    truth = {"friction": 0.08, "rotor": 0.02, "scale": 0.85, "late": 0.012}
    train, held = (smooth_torque(4.0, amplitude, seed) for amplitude, seed in ((2.5, 1), (2.0, 2)))
    takes = [recording(u, integrated(u, k, **truth), ("pendulum", "table")) for k, u in enumerate((train, held))]
    output = tmp_path_factory.mktemp("fit")
    return fit(bench(), takes[:1], takes[1:], output=output), output


@pytest.mark.parametrize(
    ("effect", "truth", "tolerance"),
    [
        ("coulomb_friction", 0.08, 0.008),
        ("reflected_inertia", 0.02, 0.002),
        ("torque_scale", 0.85, 0.02),
        ("actuation_delay", 0.012, 0.002),
    ],
)
def test_concealed_numbers_are_found_together(concealed, effect, truth, tolerance):
    found = parameter(concealed[0], effect)
    assert found.state == "identified"
    assert found.value == pytest.approx(truth, abs=tolerance)
    assert found.ci95[0] - tolerance < truth < found.ci95[1] + tolerance


def test_the_concealed_simulation_follows_what_was_kept_aside(concealed):
    score = concealed[0].scores["heldout"].per_joint["pendulum"]
    assert score["after"] < 0.1 * score["before"]


def test_what_is_not_there_is_not_needed(concealed):
    for effect in ("torque_offset", "encoder_offset"):
        assert abs(parameter(concealed[0], effect).value) < 0.01


def test_a_joint_that_never_moves_has_no_numbers(concealed):
    for effect in ("coulomb_friction", "viscous_friction", "reflected_inertia", "torque_scale"):
        found = parameter(concealed[0], effect, "table")
        assert found.state == "not identified"
        assert "never moves" in found.remark
    assert "not identified: table never moves" in fit_table(concealed[0])


def test_a_limit_that_was_never_reached_is_at_least_what_was_asked_for(concealed):
    limit = parameter(concealed[0], "torque_saturation")
    asked = np.abs(concealed[0].recordings[0].torque_command[:, 0]).max()
    assert limit.state == "not identified"
    assert limit.ci95[0] == pytest.approx(asked, rel=0.05)
    assert "at least" in limit.remark


def test_the_files_say_the_same(concealed):
    fitted, output = concealed
    content = json.loads((output / "fit.json").read_text())
    assert content["schema"] == "torchrl_athletic/fit/1"
    [said] = [p for p in content["parameters"] if (p["joint"], p["effect"]) == ("pendulum", "coulomb_friction")]
    assert said["value"] == parameter(fitted, "coulomb_friction").value
    joint = mujoco.MjModel.from_xml_path(str(output / "corrected.xml")).joint("pendulum")
    assert joint.armature[0] == pytest.approx(parameter(fitted, "reflected_inertia").value, rel=1e-4)
    assert (output / "fit.png").stat().st_size > 10_000
    assert (output / "corrected.json").exists()


@pytest.fixture(scope="module")
def swinging() -> Fit:
    """Free small swings, which have a closed form: A exp(-γ t) cos(ω t), γ = b / 2J, ω² = m g l / J - γ²."""
    inertia, damping = INERTIA + 0.03, 0.12
    decay = damping / (2 * inertia)
    speed = np.sqrt(GRAVITY_TORQUE / inertia - decay**2)
    time = np.arange(300) / RATE
    noise = 1e-6 * np.random.default_rng(0).standard_normal(len(time))
    position = 0.05 * np.exp(-decay * time) * np.cos(speed * time) + noise
    return fit(pendulum(STEP), [recording(np.zeros((300, 1)), position[:, None])], extended=False)


def test_free_swings_tell_damping_and_rotor(swinging):
    assert parameter(swinging, "viscous_friction").value == pytest.approx(0.12, rel=0.05)
    assert parameter(swinging, "reflected_inertia").value == pytest.approx(0.03, rel=0.1)


def test_a_joint_that_was_never_driven_has_no_numbers_of_a_motor(swinging):
    stated = {p.effect for p in swinging.parameters}
    assert "coulomb_friction" in stated
    assert not stated & {"torque_scale", "actuation_delay", "torque_saturation"}


def test_every_interval_holds_the_value_that_is_stated(swinging, concealed):
    for p in (*swinging.parameters, *concealed[0].parameters):
        assert p.ci95[0] <= p.value <= p.ci95[1]


def test_what_ends_where_the_given_model_has_it_is_not_needed(swinging, concealed):
    for p in (*swinging.parameters, *concealed[0].parameters):
        assert p.state != "identified" or p.value != p.given


def test_a_bound_that_binds_is_said():
    command = smooth_torque(3.0, 2.5, 3)
    in_other_units = recording(command / 40, integrated(command))
    fitted = fit(pendulum(STEP), [in_other_units], extended=False)
    assert parameter(fitted, "torque_scale").value == pytest.approx(20)
    assert any("torque scale" in r and "bound of 20" in r for r in fitted.remarks)


def test_a_torque_of_the_other_sign_is_said_first_and_while_it_runs():
    command, said = smooth_torque(3.0, 2.5, 3), []
    progress = SimpleNamespace(stage=lambda name: None, update=lambda fraction: None, say=said.append)
    turned = recording(-command, integrated(command))
    fitted = fit(pendulum(STEP), [turned], extended=False, time_budget=0.5, progress=progress)
    assert fitted.remarks[0].startswith("Warning: the torque of pendulum has the other sign")
    assert said == [fitted.remarks[0]]


def test_a_long_log_is_fitted_in_part_which_is_said_and_only_what_was_kept_aside_takes_back(monkeypatch):
    monkeypatch.setattr(fitting, "LONGEST", 12.0)
    asked = []
    monkeypatch.setattr(fitting, "vetoed", lambda h, y, takes, rng, floor: asked.extend(takes) or [])
    long, short = smooth_torque(30.0, 2.5, 1), smooth_torque(2.0, 2.5, 2)
    takes = [recording(u, integrated(u, friction=0.1)) for u in (long, short)]
    fitted = fit(pendulum(STEP), takes[:1], takes[1:], extended=False, time_budget=0.5)  # how well is not asked
    assert any(r.startswith("Of 30 s of recordings, 12 s were fitted") for r in fitted.remarks)
    assert sum(part.recording.duration for take in asked for part in take.parts) == pytest.approx(2.0, abs=0.05)


@pytest.mark.parametrize("seed", [0])
def test_a_fit_never_ends_worse_than_it_began(seed):
    """Not even of a motion that has nothing to do with the command."""
    position = integrated(smooth_torque(1.2, 2.5, seed), friction=0.1)
    fitted = fit(pendulum(STEP), [recording(smooth_torque(1.2, 1.5, seed + 10), position)], seed=seed, extended=False)
    score = fitted.scores["train"]
    assert score.after <= score.before


def test_the_command_prints_a_table_and_leaves_files(tmp_path, monkeypatch, capsys):
    monkeypatch.setattr(fit_command, "fit", partial(fit, extended=False))  # in half the time
    command = smooth_torque(2.0, 2.5, 5)
    (tmp_path / "model.xml").write_text(pendulum(STEP))
    write_recording(recording(command, integrated(command, friction=0.1)), tmp_path / "take.npz")
    main(FitConfig(tmp_path / "model.xml", (tmp_path / "take.npz",), output=tmp_path / "out", time_budget=1.0))
    shown = capsys.readouterr().out
    assert "coulomb friction [N·m]" in shown
    assert "95 %" in shown
    assert (tmp_path / "out" / "fit.json").exists()


def test_the_written_servo_has_the_gains_that_were_logged(tmp_path):
    servo = pendulum(STEP).replace('<motor joint="pendulum"/>', '<position joint="pendulum" kp="6" kv="0.4" gear="2"/>')
    model, still = mujoco.MjModel.from_xml_string(servo), np.zeros((50, 1))
    take = replace(recording(still, still), torque_command=None, position_target=still, kp=np.array([12.0]),
                   kd=np.array([0.2]))  # fmt: skip
    given = Simulation(model, ("pendulum",), Hypothesis(()), np.zeros(0))
    score = Score(0.1, 0.1, 0.1, 0.0, {"pendulum": {"before": 0.1, "after": 0.1, "floor": 0.1}})
    Fit((), given, given, {"train": score}, (), "pendulum", servo, 1.0, (take,)).save(tmp_path)
    written = mujoco.MjModel.from_xml_path(str(tmp_path / "corrected.xml"))
    assert written.actuator_gainprm[0, 0] == pytest.approx(3.0)
    assert written.actuator_biasprm[0, 1:3] == pytest.approx([-3.0, -0.05])


def test_every_flag_reaches_the_fit(tmp_path, monkeypatch, capsys):
    told = []
    fitted = SimpleNamespace(parameters=(), scores={}, remarks=("A remark.",))
    monkeypatch.setattr(fit_command, "fit", lambda *given, **settings: told.append((given, settings)) or fitted)
    (tmp_path / "model.xml").write_text(pendulum(STEP))
    takes = [tmp_path / name for name in ("take.npz", "aside.npz")]
    for k, path in enumerate(takes):
        write_recording(recording(k + np.ones((100, 1)), np.zeros((100, 1))), path)
    flags = {"drive": "measured", "seed": 7, "time_budget": 3.0, "memory": 2.0, "output": tmp_path / "out"}
    assert main(FitConfig(tmp_path / "model.xml", (takes[0],), (takes[1],), **flags)) is fitted
    (((model, fits, aside), settings),) = told
    assert model == tmp_path / "model.xml"
    assert [r.torque_command[0, 0] for r in (*fits, *aside)] == [1.0, 2.0]
    assert {name: settings[name] for name in flags} == flags
    assert settings["progress"] is not None
    shown = capsys.readouterr().out
    assert "A remark." in shown
    assert f"Files: {tmp_path / 'out'}" in shown


def test_of_several_draws_the_best_one_is_written(tmp_path, monkeypatch, capsys):
    told = []

    def fitted(*given, seed, output, time_budget, **settings):
        told.append((seed, output, time_budget))
        error = {3: 0.3, 4: 0.1}[seed]
        score = Score(1.0, error, 0.0, 0.0, {"pendulum": {"before": 1.0, "after": error, "floor": 0.1}})
        bare = Simulation(mujoco.MjModel.from_xml_string(pendulum(STEP)), ("pendulum",), Hypothesis(()), np.zeros(0))
        return Fit((), bare, bare, {"train": score}, (), "pendulum", pendulum(STEP), 1.0, tuple(given[1]))

    monkeypatch.setattr(fit_command, "fit", fitted)
    (tmp_path / "model.xml").write_text(pendulum(STEP))
    write_recording(recording(np.ones((100, 1)), np.zeros((100, 1))), tmp_path / "take.npz")
    flags = {"output": tmp_path / "out", "seed": 3}
    main(FitConfig(tmp_path / "model.xml", (tmp_path / "take.npz",), draws=2, **flags))
    assert told == [(3, None, None), (4, None, None)]
    written = json.loads((tmp_path / "out" / "fit.json").read_text("utf-8"))
    assert written["fit"]["train"]["after"] == 0.1
    assert "that of seed 4 stays." in capsys.readouterr().out
    with pytest.raises(SystemExit, match=r"error: --draws 0\. Ask for one fit or more\."):
        main(FitConfig(tmp_path / "model.xml", (tmp_path / "take.npz",), draws=0, **flags))


def test_a_table_names_what_a_law_has_several_of_and_says_why_a_number_is_none():
    """A number that is not needed or known is left blank, unless it differs from the given one all the same."""
    rows = [
        friction(effect="torque_scale", name="scale", unit="1", given=1.0, value=0.87654, ci95=(0.8, 0.9123)),
        friction(effect="gain_mismatch", name="kp_scale", unit="1", given=1.0, value=2.0, state="not needed"),
        friction(effect="stribeck_friction", name="stribeck_speed", unit="rad/s"),
        friction(joint="wrist", value=0.0, state="not needed"),
        friction(value=0.0, state="not identified", remark="never moves"),
    ]
    error = {"before": 0.5, "after": 0.25, "floor": 0.125}
    scores = {split: SimpleNamespace(per_joint={"elbow": {k: v * x for k, v in error.items()}})
              for split, x in (("train", 1.0), ("heldout", 2.0))}  # fmt: skip
    arm = '<mujoco><worldbody><body><joint name="elbow" type="{}"/><geom size="0.1"/></body></worldbody></mujoco>'
    models = {
        unit: mujoco.MjModel.from_xml_string(arm.format(kind)) for unit, kind in (("rad", "hinge"), ("m", "slide"))
    }
    told = {"parameters": rows, "scores": scores, "remarks": ()}
    rail = fit_table(SimpleNamespace(nominal=SimpleNamespace(model=models["m"]), **told))
    assert [line.split("  ")[1] for line in rail.splitlines() if line.startswith("  ")] == ["elbow [m]"] * 2
    text = fit_table(SimpleNamespace(nominal=SimpleNamespace(model=models["rad"]), **told))
    found = [line.split("  ") for line in text.splitlines()]
    cells = [[cell.strip() for cell in line if cell.strip()] for line in found]
    assert cells[1:6] == [
        ["elbow", "torque scale", "1", "0.8765", "0.8 to 0.912"],
        ["elbow", "gain mismatch, kp", "1", "2", "0.4 to 0.6, not needed"],
        ["elbow", "stribeck friction, stribeck speed [rad/s]", "0", "0.5", "0.4 to 0.6"],
        ["wrist", "coulomb friction [N·m]", "0", "0.4 to 0.6, not needed"],
        ["elbow", "coulomb friction [N·m]", "0", "not identified: never moves"],
    ]
    assert cells[7:9] == [
        ["error over 0.5 s, kept aside", "given", "fitted", "floor"],
        ["elbow [rad]", "1", "0.5", "0.25"],
    ]
    assert cells[10:12] == [
        ["error over 0.5 s, fitted", "given", "fitted", "floor"],
        ["elbow [rad]", "0.5", "0.25", "0.125"],
    ]


def test_a_missing_model_is_said_in_one_line(tmp_path):
    write_recording(recording(np.ones((100, 1)), np.zeros((100, 1))), tmp_path / "take.npz")
    with pytest.raises(SystemExit, match=r"error: .*no such model"):
        main(FitConfig(tmp_path / "none.xml", (tmp_path / "take.npz",), output=tmp_path / "out"))


def friction(**changes):
    told = JointParameter("elbow", "coulomb_friction", "torque", "N·m", 0.0, 0.5, (0.4, 0.6), "identified")
    return replace(told, **changes)


@pytest.mark.parametrize(
    ("changes", "value", "state"),
    [
        ({}, 0.0, "taken back"),
        ({"state": "not identified", "remark": "never moves"}, 0.0, "not identified"),
        ({"joint": "wrist"}, 0.5, "identified"),
        ({"effect": "viscous_friction"}, 0.5, "identified"),
        ({"value": 0.0, "state": "not needed"}, 0.0, "not needed"),
    ],
)
def test_only_what_was_taken_back_is_told_so(changes, value, state):
    gone = [SimpleNamespace(key=("coulomb_friction", "elbow"))]
    told = _taken_back(friction(**changes), gone)
    assert (told.value, told.state) == (value, state)
    assert (told.remark == "recordings kept aside got worse") is (state == "taken back")
    assert told.ci95 == (0.4, 0.6)


def test_an_interval_of_95_percent_is_1_96_deviations_to_either_side_of_its_own_fit_within_its_bounds(monkeypatch):
    """A needed number has the last fit's deviation and value; one that is not needed has those of the fit of all."""
    p = [
        Parameter(f"p{k}", "1", 0.0, low, high, 1.0) for k, (low, high) in enumerate([(-9, 9), (-9, 9), (0, 9), (0, 0)])
    ]
    candidate = SimpleNamespace(where="elbow", joint=0, effect=SimpleNamespace(name="drag"), parameters=tuple(p))
    free = np.array([True, True, True, False])
    near = SimpleNamespace(free=free, values=np.array([1.0, 8.9, 3.0, 0.0]), sigma=np.array([0.1, 0.2, 0.3]))
    again = SimpleNamespace(free=np.array([True, False, True, False]), sigma=np.array([0.5, 2.0]))
    monkeypatch.setattr(fitting, "spread_of", lambda fit: fit.sigma)
    asked = []
    monkeypatch.setattr(fitting, "_reasons", lambda *given: asked.append(given) or ["", "", "unseen"])
    y, needed = np.array([1.5, 0.0, 3.5, 0.0]), np.array([True, False, True, False])
    told = fitting._parameters(SimpleNamespace(terms=[candidate]), near, again, y, needed, "seen")
    assert asked == [(near, again, needed, "seen")]
    expected = [(1.5 - 0.98, 1.5 + 0.98), (8.9 - 0.392, 9.0), (0.0, 3.5 + 3.92)]
    assert [t.ci95 for t in told] == [pytest.approx(ends) for ends in expected]
    assert [t.value for t in told] == [1.5, 0.0, 3.5]
    assert [t.state for t in told] == ["identified", "not needed", "not identified"]


def test_a_bound_binds_where_it_is_neither_natural_nor_given():
    p = Parameter("torque", "N·m", 2.0, 0.0, 9.0, 1.0)
    binds = [bool(_binds(friction(value=value), p)) for value in (0.0, 2.0, 5.0, 9.0)]
    assert binds == [False, False, False, True]
    assert "torque of elbow (coulomb friction) ends at its bound of 9 N·m" in _binds(friction(value=9.0), p)
    low = Parameter("scale", "1", 1.0, 0.2, 3.0, 1.0)
    assert "bound of 0.2:" in _binds(friction(value=0.2), low)
    wide = replace(p, lower=-9.0)  # within a millionth of what lies between its bounds
    assert [bool(_binds(friction(value=9.0 - gap), wide)) for gap in (1.7e-5, 1.9e-5)] == [True, False]


def solved(*, free=(True,), sigma=(0.0,), values=None, **changes):
    """What a fit ends with, its deviations told."""
    free = np.array(free)
    values = np.zeros(len(free)) if values is None else np.array(values, dtype=float)
    h = SimpleNamespace(scale=np.ones(len(free)), nominal=np.zeros(len(free)))
    told = {"problem": SimpleNamespace(hypothesis=h), "free": free, "values": values, "sigma": np.array(sigma)}
    return SimpleNamespace(**(told | changes))


def test_deviations_count_windows_and_not_samples_and_what_the_torques_say():
    """By hand: curvature 4 · 2 + 2² = 12, gradients 1, -1, 2, -2 of the windows, in units of a half."""
    near = solved(free=[False, True, True])
    near.problem.hypothesis.scale = np.array([9.0, 0.5, 3.0])
    near.normal = np.tile(np.diag([2.0, 5.0]), (4, 1, 1))
    near.right = np.array([[1.0, 0.0], [-1.0, 3.0], [2.0, 0.0], [-2.0, -4.0]])
    near.pull_columns = np.array([[2.0, 0.0]])
    near.problem.windows = (SimpleNamespace(start=10 * np.arange(4), length=10),)
    assert fitting.spread_of(near) == pytest.approx([np.sqrt(10) / 12 * 0.5, 5 / 20 * 3.0])


def test_windows_that_are_looked_at_over_and_over_tell_no_more():
    near = solved(free=[True])
    near.pull_columns = np.zeros((0, 1))
    for times in (1, 5):
        near.normal = np.full((4 * times, 1, 1), 2.0)
        near.right = np.repeat([[1.0], [-1.0], [2.0], [-2.0]], times, axis=0)
        near.problem.windows = (SimpleNamespace(start=np.repeat(10 * np.arange(4), times), length=10),)
        assert fitting.spread_of(near) == pytest.approx([np.sqrt(10) / 8])


def test_what_is_not_seen_and_what_is_one_and_the_same_has_no_number_of_its_own():
    """In four windows, 0.4 thousandths of a typical error per change worth mentioning is the least that is seen."""
    names = ["drag", "slip", "spring", "play", "torque_saturation"]
    terms = []
    for n in names:
        own = [Parameter(n, "1", 0, 0, 1, 1)]
        terms.append(SimpleNamespace(where="elbow", joint=0, effect=SimpleNamespace(name=n), parameters=own))
    near = solved(free=[True] * 5)
    near.problem.hypothesis.terms = terms
    columns = np.array([[1, 2, 0, 0, 0], [0, 0, 0.29e-3, 0, 0], [0, 0, 0.29e-3, 0.39e-3, 0], [0, 0, 0, 0, 1e-9]])
    near.normal = columns[:, :, None] * columns[:, None, :]
    seen = SimpleNamespace(travel=np.array([1.0]), asked=np.array([3.25]))
    assert fitting._doubts(near, seen) == [
        "the same motion follows from slip of elbow", "the same motion follows from drag of elbow", "",
        "no recording shows it", "never reached: it is at least 3.25 1",
    ]  # fmt: skip
    seen.travel[0] = 0.9e-3
    assert fitting._doubts(near, seen)[3:] == ["elbow never moves"] * 2
    near.free, near.normal = np.array([True, True, False, False, False]), near.normal[:, :2, :2]  # only these two
    assert [bool(why) for why in fitting._doubts(near, seen)] == [True, True]


def test_a_number_that_several_others_make_up_for_is_told_with_the_two_that_do_so_most():
    """One column is the sum of two, three and four of others: of its size, these are 4, 9 and 16 of 58 parts of it."""
    near = solved(free=[True] * 4)
    near.problem.hypothesis.terms = [joint_term(0, name, name) for name in ("drag", "slip", "spring", "whole")]
    columns = np.hstack([np.eye(3), [[2.0], [3.0], [4.0]]])
    near.normal = columns[:, :, None] * columns[:, None, :]
    most = ["whole of hip and spring of hip"] * 2 + ["whole of hip and slip of hip", "spring of hip and slip of hip"]
    assert fitting._doubts(near, None) == [f"the same motion follows from {two}" for two in most]


@pytest.mark.parametrize(
    ("centre", "sigma", "wide"), [(0.0, 2.5, False), (0.0, 2.6, True), (-6.0, 3.0, False), (-6.0, 3.1, True)]
)
def test_an_interval_may_be_as_wide_as_five_changes_worth_mentioning_or_the_number_itself(
    monkeypatch, centre, sigma, wide
):
    """A needed number's interval is the one that is shown: 1.96 deviations to either side of the last fit's value."""
    monkeypatch.setattr(fitting, "spread_of", lambda fit: fit.sigma)
    monkeypatch.setattr(fitting, "_doubts", lambda near, seen: ["", ""])
    near = solved(free=[True, True], sigma=[9.0, sigma], values=[50.0, centre])
    near.problem.hypothesis.parameters = [Parameter("p", "1", 0.0, -99, 99, 1.0)] * 2
    again = solved(free=[True, False], sigma=[sigma], values=[centre, 50.0])
    said = "its interval is wider than the number itself" if wide else ""
    assert fitting._reasons(near, again, np.array([True, False]), None) == [said, said]
    monkeypatch.setattr(fitting, "_doubts", lambda near, seen: ["never moves", ""])
    assert fitting._reasons(near, again, np.array([True, False]), None) == ["never moves", said]


@pytest.mark.parametrize("turn", range(3))
def test_each_interval_is_as_wide_as_its_own_number_and_its_own_unit_allow(monkeypatch, turn):
    """Three numbers have units of 1, 10 and 0.1; for the needed ones the last fit's deviation counts, as is shown."""
    monkeypatch.setattr(fitting, "spread_of", lambda fit: fit.sigma)
    monkeypatch.setattr(fitting, "_doubts", lambda near, seen: [""] * 3)
    own = [Parameter("p", "1", 0.0, -999, 999, scale) for scale in np.roll([1.0, 10.0, 0.1], turn)]
    needed = np.roll([False, True, True], turn)
    wide = "its interval is wider than the number itself"
    for centres, first, last, said in (
        ([0.0, 0.0, 0.0], [2.0, 26.0, 1.0], [0.0, 26.0, 1.0], ["", wide, wide]),
        ([0.0, 0.0, 0.0], [2.0, 26.0, 1.0], [0.0, 25.0, 0.2], ["", "", ""]),
        ([0.0, 0.0, 0.0], [2.6, 25.0, 0.2], [0.0, 99.0, 99.0], [wide, wide, wide]),
        ([9.0, 60.0, 2.0], [4.0, 30.0, 1.0], [0.0, 30.0, 1.0], ["", "", ""]),
    ):
        centre, sigma = np.roll(centres, turn), np.roll(last, turn)[needed]
        near = solved(free=[True] * 3, sigma=np.roll(first, turn), values=np.where(needed, 999.0, centre))
        near.problem.hypothesis.parameters = own
        again = solved(free=needed, sigma=sigma, values=np.where(needed, centre, 999.0))
        assert fitting._reasons(near, again, needed, None) == np.roll(said, turn).tolist()


def test_what_drove_the_simulation_is_handed_back():
    """The measured torque, or the recording as it is."""
    take = SimpleNamespace(driven_by_measured_torque=lambda: "by the measured one")
    assert fitting._driven([take], "measured") == ("by the measured one",)
    assert fitting._driven([take], "command") == (take,)


@pytest.mark.parametrize(("worse", "goes"), [(1.009, True), (1.011, False)])
def test_what_has_no_number_of_its_own_goes_unless_the_motion_is_followed_worse_by_a_hundredth(
    monkeypatch, worse, goes
):
    """What another number does as well stays, and so does the unknown that was not needed."""
    started = []
    monkeypatch.setattr(fitting, "held_back", lambda h, torques, x, gone: np.where(gone, h.nominal, x))
    monkeypatch.setattr(fitting, "_reasons", lambda *_: ["no recording shows it", f"{fitting.ALSO} drag", "", "unseen"])
    monkeypatch.setattr(fitting, "weighed", lambda problem, x: problem)
    monkeypatch.setattr(
        fitting, "descend", lambda problem, x, free, *_: started.append((x.tolist(), free.tolist(), *_)) or x
    )
    monkeypatch.setattr(fitting, "linearise", lambda problem, x, free: solved(free=free, values=x))
    monkeypatch.setattr(fitting, "window_cost", lambda problem, square: square)
    near = solved(free=[True, True, False, True, True])
    again = solved(free=[True] * 5, values=[5.0, 6.0, 7.0, 8.0, 9.0])
    again.problem.hypothesis.nominal = np.array([1.0, 2.0, 3.0, 4.0, 4.5])
    again.problem.errors = lambda x: np.where(x[0, :1] == 5.0, 0.01, 0.01 * worse)[:, None]
    again.problem.squares = lambda errors: errors
    again.problem.mean_square = lambda x: np.where(x[:, :1] == 5.0, 0.01, 0.01 * worse)
    needed = np.array([True, True, False, True, False])
    found, left = fitting._without_unknown(near, again, needed, None, "torques", "deadline")
    assert started == [([1.0, 6.0, 7.0, 8.0, 9.0], [False, True, False, True, False], 2, "deadline")]
    assert left.tolist() == ([False, True, False, True, False] if goes else needed.tolist())
    assert (found is again) is not goes
    assert fitting._without_unknown(near, again, needed[[2, 0, 0, 0, 2]], None, None, None)[0] is again


def test_of_what_is_not_known_well_that_goes_which_is_not_missed_where_all_of_it_together_is(monkeypatch):
    """Without the second number the motion is followed twice as badly, without the others by 0.4, 0.5 and 0.6 %."""
    monkeypatch.setattr(fitting, "held_back", lambda h, torques, x, gone: np.where(gone, h.nominal, x))
    monkeypatch.setattr(fitting, "_reasons", lambda *_: ["its interval is wide"] * 4)
    monkeypatch.setattr(fitting, "weighed", lambda problem, x: problem)
    monkeypatch.setattr(fitting, "descend", lambda problem, x, *_: x)
    monkeypatch.setattr(fitting, "linearise", lambda problem, x, free: solved(free=free, values=x))
    monkeypatch.setattr(fitting, "window_cost", lambda problem, square: square)
    near, again = solved(free=[True] * 4), solved(free=[True] * 4, values=[5.0, 6.0, 7.0, 8.0])
    again.problem.hypothesis.nominal = np.array([1.0, 2.0, 3.0, 4.0])
    missed = np.array([0.005, 1.0, 0.004, 0.006])
    cost = lambda x: 1.0 + (x == again.problem.hypothesis.nominal) @ missed  # noqa: E731
    again.problem.errors, again.problem.squares = (lambda x: cost(x)[:, None]), (lambda errors: errors)
    again.problem.mean_square = lambda x: cost(x)[:, None]
    needed = np.array([True, True, True, True])
    again.seconds = 10.0
    found, left = fitting._without_unknown(near, again, needed, None, None, Deadline())
    assert left.tolist() == [False, True, False, True]
    assert found.values.tolist() == [1.0, 6.0, 3.0, 8.0]
    assert fitting._without_unknown(near, again, needed, None, None, Deadline(35.0)) == (
        again,
        needed,
    )  # no time to ask
    missed[:] = 1.0
    assert fitting._without_unknown(near, again, needed, None, None, Deadline()) == (again, needed)


def test_a_number_that_is_dropped_for_its_interval_is_not_identified_and_keeps_that_interval(monkeypatch):
    """A limit of 0.46 that the last fit does not know, and the fit of all did: the given 9 is put in its place."""
    monkeypatch.setattr(fitting, "spread_of", lambda fit: fit.sigma)
    monkeypatch.setattr(fitting, "_doubts", lambda near, seen: ["", ""])
    monkeypatch.setattr(fitting, "held_back", lambda h, torques, x, gone: np.where(gone, h.nominal, x))
    monkeypatch.setattr(fitting, "weighed", lambda problem, x: problem)
    monkeypatch.setattr(fitting, "descend", lambda problem, x, *_: x)
    monkeypatch.setattr(fitting, "window_cost", lambda problem, square: square)
    own = [Parameter(name, "1", 9.0, 0.0, 99.0, 0.05) for name in ("pull", "drag")]
    terms = [SimpleNamespace(where="hip", joint=0, effect=SimpleNamespace(name=p.name), parameters=(p,)) for p in own]
    h = SimpleNamespace(terms=terms, parameters=own, nominal=np.array([9.0, 9.0]))
    near = solved(free=[True, True], sigma=[0.05, 0.05], values=[0.5, 5.0])
    again = solved(free=[True, True], sigma=[10.0, 0.05], values=[0.46, 5.0])
    near.problem.hypothesis = again.problem.hypothesis = h
    again.problem.errors, again.problem.squares = (lambda x: np.ones((1, 1))), (lambda errors: errors)
    monkeypatch.setattr(
        fitting, "linearise", lambda problem, x, free: solved(free=free, sigma=[0.05] * int(free.sum()), values=x)
    )
    needed = np.array([True, True])
    before = fitting._parameters(h, near, again, again.values, needed, None)
    last, left = fitting._without_unknown(near, again, needed, None, None, None)
    assert left.tolist() == [False, True]
    after = fitting._parameters(h, near, last, last.values, left, None)
    pull, drag = fitting._still_unknown(after, before, needed & ~left)
    assert (pull.value, pull.state, pull.ci95) == (9.0, "not identified", (0.0, pytest.approx(0.46 + 19.6)))
    assert pull.remark == "its interval is wider than the number itself"
    assert (drag.value, drag.state) == (5.0, "identified")


@pytest.mark.parametrize(("first", "second", "stated"), [(0.9, 0.5, 0), (1.0, 0.5, 0), (1.1, 0.9, 1), (1.1, 1.2, None)])
def test_the_first_fit_that_is_not_worse_than_the_given_model_is_stated_or_none(monkeypatch, first, second, stated):
    points = [np.array([first]), np.array([second])]
    needed = [np.array([True]), np.array([False])]

    def score(takes, h, x, noise, rng, again):
        assert (takes, noise, again) == ("takes", "noise", "again")
        return SimpleNamespace(before=1.0, after=x[0]), "errors"

    monkeypatch.setattr(fitting, "score", score)
    train = SimpleNamespace(takes="takes", position_noise="noise", repeatability="again")
    x, left = fitting._no_worse(SimpleNamespace(nominal=np.array([7.0])), points, needed, train, 0)
    assert (x[0], left[0]) == ((7.0, False) if stated is None else (points[stated][0], needed[stated][0]))


def test_half_of_the_free_memory_is_shared_by_what_is_fitted_and_what_is_kept_aside(monkeypatch):
    """0.9 GB for the libraries, 600 bytes for a reading; all are prepared alike, in the first take's order."""
    cut, made = [], []

    class Enough(Exception):
        pass

    def prepare(recordings, model, drive, kernel=None, *, xml):
        made.append((recordings, drive, kernel))
        if len(made) % 2 == 0:
            raise Enough
        return SimpleNamespace(signals=[SimpleNamespace(kernel=0.125)])

    def take(name):
        names = ("b", "a") if name == "one" else ("a", "b")
        return SimpleNamespace(joint_names=names, ordered=lambda order: (name, order))

    monkeypatch.setattr(fitting, "free_memory", lambda: 2 * (0.9e9 + 600.0 * 1000))
    monkeypatch.setattr(fitting, "cut_stretches", lambda r, longest, values: cut.append((longest, values)) or r)
    monkeypatch.setattr(fitting, "recorded_time", lambda r: [0.0, 1.0])
    monkeypatch.setattr(fitting, "prepare", prepare)
    for memory in (None, (0.9e9 + 600.0 * 500) / 2**30):
        with pytest.raises(Enough):
            fit(pendulum(STEP), [take("one"), take("two")], [take("aside")], drive="measured", memory=memory)
    assert [pytest.approx(values) for _, values in cut] == [600, 400, 300, 200]
    assert {longest for longest, _ in cut} == {300.0}
    order = ("b", "a")
    assert made[0] == ([("one", order), ("two", order)], "measured", None)
    assert made[1] == ([("aside", order)], "measured", 0.125)


@pytest.mark.parametrize(
    ("targets", "commands"), [([None, None], "torques"), ([1, 2], "targets"), ([None, 1], None), ([], None)]
)
def test_the_corrected_model_takes_what_the_robot_was_sent(tmp_path, monkeypatch, targets, commands):
    """Torques or targets; of recordings of both kinds, what the given model takes."""
    told, drawn = [], []
    picture = SimpleNamespace(savefig=lambda path, dpi: drawn.append(path))
    monkeypatch.setattr("torchrl_athletic.diagnosis.report.fit_picture.fit_picture", lambda fitted: picture)
    monkeypatch.setattr(
        fitting, "corrected_xml", lambda xml, corrected, sent, gains: told.append((xml, corrected, sent, gains)) or ""
    )
    monkeypatch.setattr(fitting, "logged_gains", lambda takes: ("gains of", takes))
    recordings = tuple(SimpleNamespace(position_target=t) for t in targets)
    corrected = SimpleNamespace(to_json=dict)
    Fit((), None, corrected, {}, (), "m", "<xml/>", 1.23456, recordings).save(tmp_path)
    assert told == [("<xml/>", corrected, commands, ("gains of", recordings))]
    assert drawn == [tmp_path / "fit.png"]
    assert json.loads((tmp_path / "corrected.json").read_text()) == {"model_xml": "<xml/>"}
    assert json.loads((tmp_path / "fit.json").read_text())["seconds"] == 1.2


@pytest.mark.parametrize("extended", [True, False])
def test_what_is_needed_is_fitted_again_and_what_recordings_kept_aside_refuse_is_the_given_models(
    monkeypatch, extended
):
    """The fourth of five numbers is fixed; the last and one of the spring's are not needed; the first is taken back."""
    names = ("drag", "spring", "fixed", "idle")
    terms = tuple(
        Candidate(
            SimpleNamespace(name=n),
            k // 2,
            ("elbow", "wrist")[k // 2],
            (Parameter("p", "1", k / 8, 0.0, 9.0 * (n != "fixed"), 1.0),) * (1 + (n == "spring")),
        )
        for k, n in enumerate(names)
    )
    h, told, begun = Hypothesis(terms), {}, []
    needed = np.array([True, True, False, False, False])

    def over_needed(near, needed):
        told["needed"] = needed.tolist()
        return np.array([1.0, 2.0, 0.125, 0.25, 0.375])

    class Clock:
        """Whose parts say which shares of the time they are; it tells what was asked for."""

        def __init__(self, seconds):
            told["budget"] = seconds

        def part(self, share):
            return SimpleNamespace(
                share=share, over=False, allows=lambda seconds: told.update(allowed=(share, seconds)) or True
            )

    problem = SimpleNamespace(hypothesis=h, torques=None)
    near = SimpleNamespace(problem=problem, normal=np.zeros((3, 1, 1)), values=np.full(5, 5.0), seconds=0.0)
    again = SimpleNamespace(problem="weighed", seconds=2.0, values=np.array([1.5, 2.5, 0.125, 0.25, 0.375]))
    joint = {"before": 1.0, "after": 1.0, "floor": 0.0625}
    made = iter(["train", "aside"])

    def prepare(recordings, *_, xml):
        name = next(made)
        return SimpleNamespace(takes=name, position_noise=f"{name} noise", repeatability=name,
                               signals=[SimpleNamespace(kernel=1.0)])  # fmt: skip

    def score(takes, h, x, noise, rng, *again):
        begun.append((takes, noise, x.tolist(), rng.random()))
        assert again == (takes,) or (takes, len(begun)) == ("aside", 2)  # the floor of what is taken back is theirs
        return SimpleNamespace(before=1.0, after=1.0, per_joint={"elbow": joint}), "errors"

    def note(name, value):
        return lambda *given: told.update({name: given}) or value

    stand_ins = {
        "prepare": prepare, "column_doubts": lambda train, held: (), "score": score, "seen_in": lambda train: "seen",
        "standard_joints": lambda train, seen: "joints",
        "with_coupled_drives": lambda joints, train, seen: {"joints": h}[joints],
        "starts": note("starts", "starts"), "search": note("search", near), "agreement": lambda *given: given,
        "affordable": lambda h, takes, deadline: fitting.SCARCE - extended,
        "coarse": lambda takes, h, x, rng: {"in longer steps": "take"},
        "steps_alike": lambda copies, h, x, rng: told.setdefault("steps", []).append(copies) or dict.fromkeys(
            copies, "finer"
        ),
        "in_steps_of": lambda problem, steps: problem,
        "with_given_scales": note("given scales", near),
        "asks_for_links": lambda near: True, "with_links": note("links", near),
        "with_gear": note("gear", near), "extend": note("extend", near), "prune": note("prune", needed),
        "over_needed": over_needed,
        "best_of": note("best_of", [np.array([1.0, 2.0, 0.125, 0.25, 0.375])]), "Deadline": Clock,
        "weighed": lambda problem, x: (problem, x.tolist()), "descend": note("descend", again.values),
        "linearise": note("linearise", again), "_without_unknown": note("without", (again, needed)),
        "acting": note("acting", (Hypothesis((terms[1],)), np.array([2.5, 0.125]))),
        "vetoed": note("vetoed", [terms[0]]), "veto_sentence": lambda gone, moved: " ".join(moved),
        "cut_stretches": lambda r, *_: r, "recorded_time": lambda r: [0.0, 1.0],
        "load_model": lambda model: (None, "<xml/>", "m"), "_binds": lambda p, bounds: "",
        "_parameters": lambda *given: told.update(parameters=given) or tuple(
            friction(effect=c.effect.name, given=c.parameters[0].nominal, value=float(v))
            for c in terms if c.effect.name != "fixed" for v in h.values_of(c, given[3])
        ),
    }  # fmt: skip
    for name, stand_in in stand_ins.items():
        monkeypatch.setattr(fitting, name, stand_in)
    takes = [SimpleNamespace(joint_names=("elbow",), ordered=lambda order: None) for _ in range(2)]
    stages, progress = [], SimpleNamespace(update=lambda fraction: told.update(done=fraction))
    progress.stage = stages.append
    fitted = fit("model", takes[:1], takes[1:], extended=extended, seed=3, time_budget=60.0, progress=progress)
    assert stages == [name for name in fitting.STAGES if extended or name != "extend"]
    assert (told["done"], told["budget"]) == (1.0, 60.0)
    assert told["needed"] == [True, True, False, False, False]
    if extended:  # where a search can afford too few windows, it takes longer steps, and what is needed shorter ones
        assert (told["search"][1], told["search"][6]) == (("in longer steps",), fitting.SCARCE)
        assert told["steps"] == [{"in longer steps": "take"}, {"finer": "take"}]
    else:
        assert (told["search"][1], told["search"][6]) == (tuple(dict.fromkeys("train")), fitting.MOST)
        assert told["steps"] == [{letter: letter for letter in "train"}, {"finer": "n"}]
    pruned = [1.0, 2.0, 0.125, 0.25, 0.375]
    assert told["descend"][:3] == ((problem, pruned), pytest.approx(pruned), needed)
    assert [x.tolist() for x in told["best_of"][1]] == [pruned, [5.0, 5.0, 0.125, 0.25, 0.375]]
    train = told["starts"][1]
    assert train.takes == "train"
    assert (told["starts"][0], told["starts"][2]) == (h, "seen")
    assert (told["search"][0], told["search"][2]) == (h, "starts")
    assert (told["search"][5], told["search"][7]) == ((h, train), progress.update)
    assert ("extend" in told, "gear" in told) == (extended, extended)
    if extended:
        assert told["gear"][:2] == (near, train)
        assert told["links"][:2] == (near, train)
        assert told["extend"][:3] == (near, train, "seen")
        assert told["extend"][4] is progress.update
    assert told["prune"][0] is near
    assert told["prune"][2] is progress.update
    assert told["given scales"][:2] == (near, (h, train))
    assert (*told["without"][:2], *told["without"][3:5]) == (near, again, "seen", (h, train))
    assert told["without"][2].tolist() == [True, True, False, False, False]
    assert told["parameters"][:3] == (h, near, again)
    assert told["parameters"][5] == "seen"
    # each stage has time until a later share of all
    gears = (told["gear"][3], told["extend"][3]) if extended else ()
    stages = (told["search"][4], told["given scales"][2], *gears, told["prune"][1], told["descend"][4])
    parts = [*stages, SimpleNamespace(share=told["allowed"][0]), told["without"][5]]
    shares = [part.share for part in parts]
    assert shares == sorted(set(shares))
    assert 0.0 < shares[0] < shares[-1] < 1.0
    assert told["allowed"][1] == 6.0  # it takes three times as long as a slope
    assert told["vetoed"][1] is again.values
    assert told["vetoed"][2] == "aside"
    assert told["vetoed"][3].random() == begun[1][3]  # of the same windows
    assert told["vetoed"][4].tolist() == [0.0625]
    assert [(p.effect, p.value, p.state) for p in fitted.parameters] == [
        ("drag", 0.0, "taken back"), ("spring", 2.5, "identified"), ("spring", 0.125, "identified"),
        ("idle", 0.375, "identified"),
    ]  # fmt: skip
    assert told["acting"] == ("weighed", again.values, needed, [terms[0]])
    assert needed.tolist() == [False, True, False, False, False]  # the first was taken back
    assert fitted.corrected.hypothesis.terms == (terms[1],)
    assert fitted.corrected.values.tolist() == [2.5, 0.125]
    assert fitted.nominal.hypothesis.terms == ()
    assert fitted.remarks == ("elbow elbow",)
    assert (fitted.recordings, fitted.heldout) == (tuple(takes[:1]), tuple(takes[1:]))
    assert 0.0 <= fitted.seconds < 60.0
    assert set(fitted.scores) == {"train", "heldout"}
    # what was searched, what was decided and what is stated of a set of recordings are of the same windows
    assert [(takes, noise, x) for takes, noise, x, _ in begun] == [
        ("train", "train noise", [1.5, 2.5, 0.125, 0.25, 0.375]),
        ("aside", "aside noise", [1.5, 2.5, 0.125, 0.25, 0.375]),
        ("train", "train noise", [2.5, 0.125]), ("aside", "aside noise", [2.5, 0.125]),
    ]  # fmt: skip
    assert begun[0][3] == begun[2][3] != begun[1][3] == begun[3][3]


def joint_term(joint, name, *parameters):
    return SimpleNamespace(
        where=("hip", "knee", "foot")[joint],
        joint=joint,
        effect=SimpleNamespace(name=name),
        parameters=[Parameter(p, "1", 0.0, 0.0, 9.0, 1.0) for p in parameters],
    )


def test_why_a_number_is_none_is_said_of_its_own_joint_and_of_those_that_share_its_motion_most():
    """Three columns for two windows are one too many: by size, drag is 0.6 of the gain and 0.8 of slip."""
    near = solved(free=[True] * 6)
    near.problem.hypothesis.terms = [
        joint_term(0, "drag", "drag"),
        joint_term(1, "gain_mismatch", "kp_scale"),
        joint_term(2, "slip", "slip"),
        joint_term(1, "torque_saturation", "limit"),
        joint_term(2, "torque_saturation", "limit"),
        joint_term(0, "spring", "spring"),
    ]
    columns = np.array([[3.0, 1.0, 0.0, 0.0, 0.0, 0.0], [4.0, 0.0, 1.0, 0.0, 0.0, 0.0]])
    near.normal = columns[:, :, None] * columns[:, None, :]
    seen = SimpleNamespace(travel=np.array([0.0, 1.0, 1.0]), asked=np.array([1.0, 2.5, 7.0]))
    gain = "gain mismatch (kp scale) of knee"
    assert fitting._doubts(near, seen) == [
        f"the same motion follows from slip of foot and {gain}",
        "the same motion follows from drag of hip and slip of foot",
        f"the same motion follows from drag of hip and {gain}",
        "never reached: it is at least 2.5 1",
        "never reached: it is at least 7 1",
        "hip never moves",
    ]


def test_a_limit_that_was_never_reached_is_at_least_what_its_own_joint_was_asked_for(monkeypatch):
    monkeypatch.setattr(fitting, "spread_of", lambda fit: fit.sigma)
    monkeypatch.setattr(fitting, "_reasons", lambda *_: ["", "never reached", "never moves"])
    terms = [
        joint_term(0, "torque_saturation", "limit"),
        joint_term(1, "torque_saturation", "limit"),
        joint_term(2, "drag", "drag"),
    ]
    near = solved(free=[True] * 3, values=[4.0, 5.0, 6.0], sigma=[0.5] * 3)
    seen = SimpleNamespace(asked=np.array([1.0, 2.5, 7.0]))
    told = fitting._parameters(SimpleNamespace(terms=terms), near, near, near.values, np.zeros(3, dtype=bool), seen)
    assert [t.ci95 for t in told] == [pytest.approx(ends) for ends in ((3.02, 4.98), (2.5, 9.0), (5.02, 6.98))]
    assert [(t.joint, t.state) for t in told] == [
        ("hip", "not needed"), ("knee", "not identified"), ("foot", "not identified"),
    ]  # fmt: skip


def test_a_limit_below_what_was_asked_for_is_not_said_to_be_above_it(monkeypatch):
    monkeypatch.setattr(fitting, "spread_of", lambda fit: fit.sigma)
    monkeypatch.setattr(fitting, "_reasons", lambda *_: ["never reached: it is at least 6 1"])
    h = SimpleNamespace(terms=[joint_term(0, "torque_saturation", "limit")])
    near, seen = solved(free=[True], values=[4.0], sigma=[0.5]), SimpleNamespace(asked=np.array([6.0]))
    [told] = fitting._parameters(h, near, near, near.values, np.ones(1, dtype=bool), seen)
    assert told.value == 4.0
    assert told.ci95 == pytest.approx((3.02, 4.98))
    assert (told.state, told.remark) == ("not identified", "no recording shows it")
