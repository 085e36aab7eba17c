"""Legs in the air: a trunk that is clamped, and one that swings in springs of which nobody knows."""

import re
from dataclasses import replace

import mujoco
import numpy as np
import pytest
from effects.hung import late, model, record

from torchrl_athletic.diagnosis import Diagnosis, diagnose
from torchrl_athletic.diagnosis.experiment import _gains, _planned, _stood
from torchrl_athletic.diagnosis.fit import Hypothesis
from torchrl_athletic.diagnosis.motions import Limits, motions
from torchrl_athletic.diagnosis.prepare import prepare, refuse_stance
from torchrl_athletic.diagnosis.replay import simulate, take_of, windows_of
from torchrl_athletic.diagnosis.thresholds import PLAN
from torchrl_athletic.effects import CATALOGUE
from torchrl_athletic.recordings import Recording, RecordingError

FEW = tuple(
    e for e in CATALOGUE if e.name in ("coulomb_friction", "viscous_friction", "reflected_inertia", "torque_scale")
)
"""Effects, to be quick."""
FRICTION = 0.25
"""Hidden in the left knee [N·m]."""
ROBOT = mujoco.MjModel.from_xml_string(model())


def told(diagnosis):
    """The likeliest finding and its first parameter."""
    finding = diagnosis.answer.findings[0]
    return finding.effect, finding.joint, next(iter(finding.parameters.values())).value


def without_base(recording):
    return replace(recording, base_position=None, base_orientation=None)


@pytest.fixture(scope="module")
def clamped(tmp_path_factory):
    out = tmp_path_factory.mktemp("clamped")
    takes = [record(6.0, friction=FRICTION, held=True, seed=k) for k in (1, 2)]
    return diagnose(model(), takes[:1], takes[1:], catalogue=FEW, base="fixed", output=out), out


def test_legs_in_the_air_are_diagnosed_where_the_model_holds_its_trunk(clamped):
    diagnosis, _ = clamped
    effect, joint, torque = told(diagnosis)
    assert (effect, joint) == ("coulomb_friction", "left_knee")
    assert torque == pytest.approx(FRICTION, rel=0.1)
    assert diagnosis.answer.fit["heldout"].share_closed > 0.9


def test_the_corrected_model_still_floats(clamped):
    diagnosis, out = clamped
    corrected = mujoco.MjModel.from_xml_path(str(out / "corrected.xml"))
    assert corrected.joint("root").type[0] == mujoco.mjtJoint.mjJNT_FREE
    changed = corrected.dof_frictionloss - ROBOT.dof_frictionloss
    assert changed[corrected.joint("left_knee").dofadr[0]] == pytest.approx(FRICTION, rel=0.1)
    assert np.count_nonzero(changed) == 1
    np.testing.assert_array_equal(corrected.dof_armature[:6], 0.0)  # what carries it in a replay stays there
    np.testing.assert_array_equal(corrected.geom_contype, ROBOT.geom_contype)
    take = record(6.0, friction=FRICTION, held=True, seed=1)
    take = take if take.base_position is None else without_base(take)  # as it was handed in
    again = Diagnosis.load(out, FEW).corrected
    np.testing.assert_array_equal(again.rollout(take), diagnosis.corrected.rollout(take))


def test_a_swinging_trunk_is_followed_and_what_hides_in_a_knee_is_named():
    takes = [record(6.0, friction=FRICTION, seed=k) for k in (1, 2)]
    diagnosis = diagnose(model(), takes[:1], takes[1:], catalogue=FEW)
    effect, joint, torque = told(diagnosis)
    assert (effect, joint) == ("coulomb_friction", "left_knee")
    assert torque == pytest.approx(FRICTION, rel=0.15)
    assert len(diagnosis.answer.findings) == 1
    assert diagnosis.answer.fit["heldout"].share_closed > 0.9


def test_a_motion_capture_that_is_late_is_put_right_and_said():
    takes = [late(record(6.0, friction=FRICTION, seed=k), 0.006) for k in (1, 2)]
    diagnosis = diagnose(model(), takes[:1], takes[1:], catalogue=FEW)
    assert told(diagnosis)[:2] == ("coulomb_friction", "left_knee")
    assert diagnosis.answer.fit["heldout"].share_closed > 0.9
    shift = re.search(r"base clock shift of the robot offset \+(\S+) s", " ".join(diagnosis.answer.remarks))
    assert shift is not None
    assert float(shift[1]) == pytest.approx(0.006, rel=0.1)


def test_pieces_that_are_replayed_as_one_keep_their_own_base():
    take = record(6.0, noise=0.0)
    gap = replace(take, time=np.where(take.time > 3.0, take.time + 1.0, take.time))
    (joined,) = prepare([gap], ROBOT).takes
    assert len(joined.pieces) == 2
    together, apart = (
        np.concatenate([simulate(windows_of(t, 0.5), lambda *_: None, np.zeros((1, 0)))[0] for t in takes])
        for takes in ([joined], joined.pieces)
    )
    np.testing.assert_allclose(together, apart, atol=1e-12)


def test_a_robot_that_swung_otherwise_was_not_repeated():
    again = {"metadata": {"repeat": 1}}
    swung = [replace(record(3.0, noise=n), **again) for n in (1.0, 2.0)]
    held = [replace(without_base(r).with_base_held((0.0, 0.0, 0.3)), **again) for r in swung]
    assert prepare(swung, ROBOT).repeatability is None
    assert prepare(held, ROBOT).repeatability is not None


def test_a_plan_for_a_robot_in_the_air_is_that_of_one_bolted_there():
    take, plans = record(3.0, held=True), []
    bolted = mujoco.MjModel.from_xml_string(model().replace('<freejoint name="root"/>', ""))
    for recording, robot in ((take, bolted), (take.with_base_held((0.0, 0.0, 0.3)), ROBOT)):
        takes = prepare([recording], robot).signals
        limits = Limits.of(takes)
        motion = next(iter(motions(takes, limits, [2], PLAN.seconds)))
        plan = _planned(motion, 0.0, takes[0].nominal, takes, limits, _gains(takes, robot))
        assert plan is not None
        plans.append(plan)
        take_of(_stood(plan.recording, takes), takes[0].nominal, np.full(4, 1e-9))
    np.testing.assert_allclose(plans[1].torque, plans[0].torque, atol=1e-6)
    np.testing.assert_allclose(plans[1].recording.command, plans[0].recording.command, atol=1e-6)


def test_a_swinging_trunk_that_is_taken_for_a_clamped_one_looks_like_missing_physics():
    take = record(6.0, seed=3)
    recorded, ignored = (
        diagnose(model(), [take], catalogue=FEW),
        prepare([without_base(take).with_base_held((0.0, 0.0, 0.3))], ROBOT),
    )
    assert recorded.answer.verdict == "nothing_missing"
    known = prepare([take], ROBOT)
    missing = [np.sqrt((p.signals[0].missing ** 2).mean(0)) for p in (known, ignored)]
    assert (missing[1] > 50 * missing[0]).all()


def test_a_pose_that_was_recorded_and_said_to_be_fixed_is_refused():
    take = record(2.0)
    with pytest.raises(RecordingError, match="base_position was recorded, and base is said to be 'fixed'"):
        diagnose(model(), [take], base="fixed")
    with pytest.raises(RecordingError, match=r"were not recorded\..*--base fixed"):
        diagnose(model(), [without_base(take)])


def test_a_robot_that_stands_is_refused():
    take = record(2.0)
    low = replace(take, base_position=take.base_position - [0.0, 0.0, 0.3])
    with pytest.raises(RecordingError, match=r"touches the world of the model in \d+% of the take, .* in the air"):
        refuse_stance(low, ROBOT)
    refuse_stance(take, ROBOT)
    refuse_stance(without_base(take).with_base_held((0.0, 0.0, 0.0)), ROBOT)  # a gantry over another floor


def test_legs_that_touch_each_other_in_the_air_do_not_stand():
    leg = '<body pos="0 {y} 0"><joint name="{name}" axis="1 0 0"/><geom size="0.11" pos="0 0 -0.3"/></body>'
    legs = leg.format(y=0.1, name="left") + leg.format(y=-0.1, name="right")
    drives = '<motor joint="left"/><motor joint="right"/>'
    touching = mujoco.MjModel.from_xml_string(
        f'<mujoco><worldbody><geom type="plane" size="1 1 1"/><body pos="0 0 5"><freejoint/><geom size="0.05"/>{legs}'
        f"</body></worldbody><actuator>{drives}</actuator></mujoco>"
    )
    time = np.arange(100) / 100.0
    place = np.stack([0.1 * np.sin(9.0 * time), 0 * time, 5.0 + 0 * time], 1)
    upright = np.tile([1.0, 0.0, 0.0, 0.0], (100, 1))
    rest = np.zeros((100, 2))
    take = Recording(time, ("left", "right"), rest, torque_command=rest, base_position=place, base_orientation=upright)
    refuse_stance(take, touching)
    with pytest.raises(RecordingError, match="touches the world"):
        refuse_stance(replace(take, base_position=place - [0.0, 0.0, 4.9]), touching)


def test_when_a_robot_first_stands_is_told_though_not_every_sample_is_looked_at(monkeypatch):
    take = record(2.0)
    monkeypatch.setattr("torchrl_athletic.diagnosis.prepare.LOOKS", 100)
    steps = replace(take, base_position=take.base_position - 0.3 * (take.time[:, None] > 1.5) * [0.0, 0.0, 1.0])
    with pytest.raises(RecordingError, match=r"in 2[3-7]% of the take, first at 1\.5[0-2]\d s"):
        refuse_stance(steps, ROBOT)


def test_a_pose_that_was_lost_does_not_push_the_replay():
    clean = record(6.0, seed=1)
    lost = clean.base_position.copy()
    lost[800] = 0.0
    windows = [windows_of(prepare([r], ROBOT).takes[0], 0.5) for r in (clean, replace(clean, base_position=lost))]
    off = []
    for w in windows:
        moved = simulate(w, Hypothesis(()).build, np.zeros((1, 0)))[0]
        off.append(np.sqrt(np.mean((moved - w.take.position[w.index]) ** 2)))
    assert off[1] == pytest.approx(off[0], rel=0.1)


def test_a_base_is_recorded_or_fixed_and_nothing_else():
    with pytest.raises(ValueError, match="base is 'clamped', needed is one of 'recorded', 'fixed'"):
        diagnose(model(), [record(6.0, held=True, seed=1)], base="clamped")  # type: ignore[arg-type]
