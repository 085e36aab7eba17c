"""Logs as they are: no gains, no command, commands in a file of their own, lists in cells, joints that stood still."""

import json
from dataclasses import dataclass, replace
from pathlib import Path
from types import SimpleNamespace

import mujoco
import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest
from diagnosis.plants import pendulum, record, smooth_torque

from torchrl_athletic.diagnosis import inputs as inputs_module
from torchrl_athletic.diagnosis.fit_command import FitConfig, main
from torchrl_athletic.diagnosis.inputs import Inputs, checked, columns_for, gains_of, inputs
from torchrl_athletic.diagnosis.locking import locked_joints
from torchrl_athletic.recordings import (
    ColumnMap,
    FetchError,
    Recording,
    RecordingError,
    read_recordings,
    write_recording,
)

SERVO = """<mujoco><worldbody><body><joint name="hip" axis="0 1 0"/><geom size="0.1" pos="0.3 0 0"/>
  <body pos="0.5 0 0"><joint name="knee" axis="0 1 0" pos="0.1 0 0.05"/><geom size="0.1" pos="0.2 0 0"/></body></body>
  </worldbody><actuator><position joint="hip" kp="30" kv="2"/><motor joint="knee"/></actuator></mujoco>"""


@dataclass(frozen=True)
class Flags:
    model: Path | None = None
    recordings: tuple[Path, ...] = ()
    heldout: tuple[Path, ...] = ()
    columns: Path | None = None
    lock: tuple[str, ...] = ()
    drive: str = "command"
    dataset: str | None = None
    output: Path = Path("out")


def targets(path: Path) -> None:
    time = np.arange(200) / 100
    names = {"time": time, "position/hip": np.sin(time), "position_target/hip": np.sin(time)}
    np.savetxt(path, np.stack(list(names.values()), 1), delimiter=",", header=",".join(names), comments="")


def test_gains_are_those_of_position_actuators():
    assert gains_of(mujoco.MjModel.from_xml_string(SERVO)) == {"hip": (30.0, 2.0)}


def test_gains_are_those_of_the_only_actuator_of_a_joint_if_it_is_a_position_one():
    def gains(*actuators):
        inner = "".join(actuators)
        old = '<position joint="hip" kp="30" kv="2"/><motor joint="knee"/>'
        return gains_of(mujoco.MjModel.from_xml_string(SERVO.replace(old, inner)))

    hip, knee = '<position joint="hip" kp="30" kv="2"/>', '<position joint="knee" kp="7"/>'
    assert gains(hip, knee) == {"hip": (30.0, 2.0), "knee": (7.0, 0.0)}
    assert gains(hip, knee, hip) == {"knee": (7.0, 0.0)}
    general = '<general joint="hip" biastype="affine" gainprm="{}" biasprm="0 {} {}"/>'
    assert gains(general.format(5, -5, -1)) == {"hip": (5.0, 1.0)}
    plain = general.format(5, -5, -1).replace("affine", "none")
    for other in (general.format(5, -4, -1), general.format(-5, 5, -1), plain, '<velocity joint="hip" kv="3"/>'):
        assert gains(other) == {}


def test_gains_are_those_of_the_joint_where_an_actuator_has_a_gear():
    geared = mujoco.MjModel.from_xml_string(SERVO.replace("<position ", '<position gear="3" '))
    data = mujoco.MjData(geared)
    data.qpos[:] = 0.1
    mujoco.mj_forward(geared, data)
    assert gains_of(geared)["hip"] == pytest.approx((-data.qfrc_actuator[0] / 0.1, 9 * 2.0))


def test_dynamics_of_an_actuator_that_are_left_out_are_said():
    filtered = SERVO.replace("<position ", '<position timeconst="0.1" ')
    [said] = Inputs(filtered, [], []).notes
    assert "(filterexact, 0.1 s)" in said
    assert Inputs(SERVO, [], []).notes == []


def test_motors_whose_control_is_not_the_torque_are_said_where_torques_were_logged():
    still = np.zeros((4, 2))
    torques = Recording(np.arange(4.0), ("hip", "knee"), still, torque_command=still)
    targets = replace(torques, torque_command=None, position_target=still, kp=np.ones(2), kd=np.zeros(2))

    def said(motor, log=torques):
        return Inputs(SERVO.replace('<motor joint="knee"/>', motor), [log], []).notes

    [line] = said('<motor joint="knee" gear="0.25"/>')
    assert "0.25 (knee) times" in line
    assert "columns.json" in line
    [line] = said('<general joint="knee" gainprm="0.1" gear="5" biastype="affine" biasprm="-0.3"/>')
    assert "0.5 (knee)" in line
    assert said('<motor joint="knee" gear="0.25"/>', targets) == said('<motor joint="knee"/>') == []


def test_what_pulls_a_tendon_of_the_same_number_is_no_drive_of_the_joint():
    tendon = '<tendon><fixed name="cord"><joint joint="knee" coef="1"/></fixed></tendon>'
    pulled = SERVO.replace("<actuator>", f'{tendon}<actuator><position tendon="cord" kp="4"/>')
    assert gains_of(mujoco.MjModel.from_xml_string(pulled)) == {"hip": (30.0, 2.0)}


def test_what_is_left_of_a_recording_keeps_its_order_and_its_numbers():
    three = np.arange(12.0).reshape(4, 3)
    take = Recording(np.arange(4.0), ("a", "b", "c"), three, velocity=10 + three, position_target=20 + three,
                     kp=np.array([1.0, 2.0, 3.0]), kd=np.array([4.0, 5.0, 6.0]))  # fmt: skip
    left = inputs_module.freed(take, ("b=0.3", "elsewhere"))
    assert left.joint_names == ("a", "c")
    for name in ("position", "velocity", "position_target", "kp", "kd"):
        np.testing.assert_array_equal(getattr(left, name), getattr(take, name)[..., [0, 2]])
    assert inputs_module.freed(take, ("elsewhere",)) is take


def test_what_is_wrong_with_a_file_that_is_named_twice_is_said_once(tmp_path):
    said, usable = checked(Flags(None, (tmp_path / "gone.npz",), (tmp_path / "gone.npz",)))
    lines = said.splitlines()
    assert len(lines) == len(set(lines)) == 3  # no model, no file, and that they cannot be used
    assert not usable


def test_all_files_of_a_folder_are_checked_with_the_models_gains_and_each_warning_names_its_file(tmp_path, monkeypatch):
    (tmp_path / "robot.xml").write_text(SERVO)
    (tmp_path / "takes" / "deep").mkdir(parents=True)
    for name in ("a.npz", "deep/b.npz"):
        (tmp_path / "takes" / name).touch()
    rest, read = np.zeros((3, 2)), []

    def take(path, columns):
        read.append((path.name, columns.model_gains))
        names = ("hip", "knee") if path.name == "a.npz" else ("knee", "hip")  # which order is nobody's fault
        return [Recording(np.arange(3.0), names, rest, torque_command=rest, source=path.name)]

    monkeypatch.setattr(inputs_module, "read_recordings", take)
    monkeypatch.setattr(
        inputs_module, "check_quality", lambda r: SimpleNamespace(warnings=(f"{r.source}: late.", "it is short."))
    )
    monkeypatch.setattr(inputs_module, "prepare", lambda *_, **__: SimpleNamespace(left_out=(), signals=()))
    said, usable = checked(Flags(tmp_path / "robot.xml", (tmp_path / "takes",)))
    assert read == [(name, {"hip": (30.0, 2.0)}) for name in ("a.npz", "b.npz")]
    assert usable
    expected = [f"- warning: {name}: {what}" for name in ("a.npz", "b.npz") for what in ("late.", "it is short.")]
    assert said.splitlines() == [*expected, "The inputs can be used."]


def test_a_joint_that_is_no_hinge_nor_slide_is_told_before_anything_is_run(tmp_path):
    (tmp_path / "robot.xml").write_text(
        '<mujoco><worldbody><body><joint name="hip" type="ball"/><geom size="0.1"/></body></worldbody></mujoco>'
    )
    write_recording(replace(record(pendulum(), smooth_torque(1.0)), joint_names=("hip",)), tmp_path / "take.npz")
    said, usable = checked(Flags(tmp_path / "robot.xml", (tmp_path / "take.npz",)))
    assert "only hinge and slide joints" in said
    assert not usable


def test_what_one_of_several_recordings_lacks_is_told():
    log = record(pendulum(), smooth_torque(1.0))
    lacking = replace(log, metadata={"gains": "of the model", "driven_by": "torque_measured"})
    told = inputs_module.Inputs(SERVO, [log, lacking], []).notes
    assert [note.partition(":")[0] for note in told] == [
        "The recordings say no gains", "The recordings hold no command"
    ]  # fmt: skip
    assert inputs_module.Inputs(SERVO, [log], []).notes == []


def test_targets_without_gains_take_the_models(tmp_path):
    targets(tmp_path / "log.csv")
    (tmp_path / "robot.xml").write_text(SERVO)
    given = inputs(Flags(tmp_path / "robot.xml", (tmp_path / "log.csv",)))
    assert (given.recordings[0].kp, given.recordings[0].kd) == (30.0, 2.0)
    assert any("gains" in note for note in given.notes)
    with pytest.raises(RecordingError, match="needs the gains"):
        read_recordings(tmp_path / "log.csv")


def test_a_measured_torque_is_the_command_where_that_is_said(tmp_path):
    time = np.arange(100) / 100
    np.savez(tmp_path / "a.npz", time=time, joint_names=["hip"], position=time[:, None], torque_measured=time[:, None])
    with pytest.raises(RecordingError, match="a measured torque, but no command"):
        read_recordings(tmp_path / "a.npz", ColumnMap(torque_semantics="link_side"))
    [read] = read_recordings(tmp_path / "a.npz", ColumnMap(measured_drives=True))
    np.testing.assert_array_equal(read.torque_command[:, 0], time)
    assert read.torque_measured is None
    assert read.driven_by_measured_torque() is read


def test_commands_of_their_own_file_hold_until_the_next_and_never_act_ahead(tmp_path):
    (tmp_path / "state.csv").write_text('t,q\n0,"[0.0, 1.0]"\n10,"[0.1, 1.1]"\n20,"[0.2, 1.2]"\n30,"[0.3, 1.3]"\n')
    (tmp_path / "control.csv").write_text('t,q\n5,"[1, 2]"\n20,"[3, 4]"\n')
    columns = ColumnMap(
        ("hip", "knee"), time={"name": "t", "unit": "ms"}, position="q", torque_command="control.csv:q",
        command_file="control.csv",
    )  # fmt: skip
    [read] = read_recordings(tmp_path, columns)
    np.testing.assert_allclose(read.time, [0.01, 0.02, 0.03])  # before the first command nobody knows
    np.testing.assert_array_equal(read.torque_command, [[1, 2], [3, 4], [3, 4]])
    np.testing.assert_allclose(read.position[0], [0.1, 1.1])


@pytest.mark.parametrize("cell", ['"[1, true]"', '"[1, NaN]"', '"[[1], 2]"', '"[1]"'])
def test_what_is_no_list_of_as_many_numbers_is_refused(tmp_path, cell):
    (tmp_path / "log.csv").write_text(f'time,position,torque_command\n0,"[0, 1]","[0, 0]"\n1,{cell},"[0, 0]"\n')
    with pytest.raises(RecordingError, match="position"):
        read_recordings(tmp_path / "log.csv", ColumnMap(("hip", "knee")))


@pytest.mark.parametrize("angle", [0.0, 0.7])
def test_a_locked_joint_leaves_all_bodies_where_they_were(angle):
    free = mujoco.MjModel.from_xml_string(SERVO)
    xml, left = locked_joints(SERVO, (f"knee={angle}",), [])
    held = mujoco.MjModel.from_xml_string(xml)
    data = mujoco.MjData(free), mujoco.MjData(held)
    data[0].qpos[:] = 0.3, angle
    data[1].qpos[:] = 0.3
    for model, one in zip((free, held), data, strict=True):
        mujoco.mj_forward(model, one)
    assert left == ("hip",)
    np.testing.assert_allclose(data[1].xpos, data[0].xpos, atol=1e-5)
    np.testing.assert_allclose(data[1].xipos, data[0].xipos, atol=1e-5)
    np.testing.assert_allclose(data[1].qfrc_bias, data[0].qfrc_bias[:1], atol=1e-3)


@pytest.mark.parametrize("kind", ["hinge", "slide"])
def test_a_locked_joint_is_held_at_its_reading_whatever_the_models_zero_and_the_turn_of_its_body(kind):
    """``ref`` is the reading where the model draws the joint; its body is turned, and its axis is no unit vector."""
    xml = f"""<mujoco><worldbody><body><joint name="hip" axis="0 1 0"/><geom size="0.1" pos="0.3 0 0"/>
      <body pos="0.5 0.1 0" quat="0.8 0.3 -0.2 0.4"><joint name="knee" type="{kind}" axis="0 2 1" pos="0.1 0.2 0.05"
        ref="{0.4 if kind == "slide" else 20}"/><geom size="0.1" pos="0.2 0 0"/></body></body></worldbody></mujoco>"""
    free = mujoco.MjModel.from_xml_string(xml)
    held = mujoco.MjModel.from_xml_string(locked_joints(xml, ("knee=0.7",), [])[0])
    data = mujoco.MjData(free), mujoco.MjData(held)
    data[0].qpos[:], data[1].qpos[:] = (0.3, 0.7), 0.3
    for model, one in zip((free, held), data, strict=True):
        mujoco.mj_kinematics(model, one)
    np.testing.assert_allclose(data[1].geom_xpos, data[0].geom_xpos, atol=1e-5)
    np.testing.assert_allclose(data[1].xmat, data[0].xmat, atol=1e-5)
    assert np.abs(free.body_pos[-1] - held.body_pos[-1]).max() > 0.01


def test_recordings_keep_every_channel_of_the_joints_that_are_left(tmp_path):
    """Columns all differ, so that none can be taken for another's."""
    (tmp_path / "robot.xml").write_text(SERVO)
    time = np.arange(100) / 100
    columns = {name: np.stack([0.001 * k + np.sin(time), 1.0 + k + 0 * time], 1) for k, name in enumerate(
        ("position", "velocity", "position_target", "torque_measured"))}  # fmt: skip
    whole = Recording(
        time,
        ("hip", "knee"),
        **columns,
        kp=np.array([30.0, 40.0]),
        kd=np.array([2.0, 3.0]),
        torque_semantics="link_side",
    )
    for name in ("fitted", "aside"):
        write_recording(whole, tmp_path / f"{name}.npz")
    asked = Flags(tmp_path / "robot.xml", (tmp_path / "fitted.npz",), (tmp_path / "aside.npz",), lock=("knee",))
    given = inputs(asked)
    for (left,) in (given.recordings, given.heldout):
        assert left.joint_names == ("hip",)
        for name, column in columns.items():
            np.testing.assert_allclose(getattr(left, name), column[:, :1], err_msg=name)
        assert (left.kp.tolist(), left.kd.tolist()) == ([30.0], [2.0])


def test_a_joint_that_moves_is_not_locked_in_silence(tmp_path):
    time = np.arange(100) / 100
    swings = Recording(time, ("hip", "knee"), np.stack([time, time], 1), torque_command=np.zeros((100, 2)))
    with pytest.raises(RecordingError, match=r"knee: it moves by 0\.99"):
        locked_joints(SERVO, ("knee",), [swings])
    with pytest.raises(RecordingError, match="no such joint; it has hip, knee"):
        locked_joints(SERVO, ("ankle",), [swings])


def test_all_problems_are_said_at_once(tmp_path, capsys):
    (tmp_path / "robot.xml").write_text(pendulum())
    write_recording(record(pendulum(), smooth_torque(1.0)), tmp_path / "good.npz")
    (tmp_path / "bad.npz").write_bytes(b"PK\x03\x04 not a zip")
    targets(tmp_path / "other.csv")
    paths = tuple(tmp_path / name for name in ("good.npz", "bad.npz", "other.csv", "gone.npz"))
    with pytest.raises(SystemExit) as stopped:
        main(FitConfig(tmp_path / "robot.xml", paths, check=True))
    shown = capsys.readouterr().out
    assert stopped.value.code == 1
    assert all(name in shown for name in ("bad.npz", "other.csv", "gone.npz", "The inputs cannot be used"))
    text, usable = checked(Flags(tmp_path / "robot.xml", (tmp_path / "good.npz",)))
    assert usable
    assert text.endswith("The inputs can be used.")


@pytest.mark.parametrize("aside", [False, True])
def test_a_torque_of_the_other_sign_is_a_warning(tmp_path, aside):
    (tmp_path / "robot.xml").write_text(pendulum())
    take = record(pendulum(), smooth_torque(4.0))
    write_recording(take, tmp_path / "good.npz")
    write_recording(replace(take, torque_command=-take.torque_command), tmp_path / "turned.npz")
    names = ("good.npz", "turned.npz") if aside else ("turned.npz", "good.npz")
    text, usable = checked(Flags(tmp_path / "robot.xml", *((tmp_path / name,) for name in names)))
    assert usable
    assert f"- warning: {'Kept aside, ' * aside}the torque of pendulum has the other sign than its motion" in text


def arm(path, seconds=3.0, knee=0.0, joints=("hip", "knee")):
    """A take of the servo's robot whose knee travels so far."""
    time = np.arange(int(100 * seconds)) / 100
    both = np.stack([np.sin(4 * time), 0.3 + knee * np.linspace(0, 1, len(time))], 1)[:, : len(joints)]
    write_recording(Recording(time, joints, both, torque_command=0.1 * both), path)


@pytest.fixture
def robot(tmp_path):
    (tmp_path / "robot.xml").write_text(SERVO)
    for name in ("empty", "texts", "takes", "moves"):
        (tmp_path / name).mkdir()
    (tmp_path / "texts" / "note.txt").write_text("Of Tuesday.")
    arm(tmp_path / "takes" / "a.npz")
    (tmp_path / "takes" / "._a.npz").write_bytes(b"\x00\x05\x16\x07")  # as macOS leaves it on a stick
    arm(tmp_path / "moves" / "a.npz", knee=1.0)
    arm(tmp_path / "short.npz", 0.39)
    return tmp_path


@pytest.mark.parametrize(
    ("takes", "flags", "says"),
    [
        ("empty", {}, "no file of a known kind"),
        ("texts", {}, "no file of a known kind"),
        ("short.npz", {}, "at least 0."),
        ("takes", {"lock": ("ankle",)}, "--lock ankle: the model has no such joint"),
        ("takes", {"lock": ("ankle", "knee=abc")}, "--lock knee=abc: give a number"),
        ("moves", {"lock": ("knee",)}, "--lock knee: it moves by 1 in the recordings"),
        ("takes", {"lock": ("hip=0", "knee")}, "a.npz: --lock names all of its joints"),
        ("takes", {"drive": "measured"}, "there is no torque_measured"),
        ("takes", {}, ""),
        ("takes", {"lock": ("knee",)}, ""),
        ("moves", {}, ""),
    ],
)
def test_a_check_and_a_run_refuse_the_same(robot, takes, flags, says):
    asked = Flags(robot / "robot.xml", (robot / takes,), **flags)
    said, usable = checked(asked)
    assert says in said
    try:
        given = inputs(asked)
        inputs_module.prepare(given.recordings, inputs_module.load_model(given.model)[0], asked.drive)
    except RecordingError:
        assert not usable
    else:
        assert usable, said


def test_a_take_that_is_too_short_is_left_out_of_several_and_a_warning_says_so(robot):
    said, usable = checked(Flags(robot / "robot.xml", (robot / "moves", robot / "short.npz")))
    assert usable
    assert f"- warning: {robot}/short.npz: the take lasts 0.38 s" in said
    said, usable = checked(Flags(robot / "robot.xml", (robot / "moves",), (robot / "short.npz",)))
    assert not usable


def test_a_data_set_that_is_a_folder_is_checked_as_a_whole(tmp_path):
    (tmp_path / "robot.xml").write_text(SERVO)
    for folder in ("set/meta", "set/data/chunk-000"):
        (tmp_path / folder).mkdir(parents=True)
    time = np.arange(200) / 50
    both = np.stack([np.sin(4 * time), np.sin(3 * time)], 1)
    rows = pa.array(list(both), pa.list_(pa.float64()))
    names = {"names": ["hip.pos", "knee.pos"]}
    table = {"observation.state": rows, "action": rows, "timestamp": time, "episode_index": np.zeros(200, int)}
    pq.write_table(pa.table(table), tmp_path / "set/data/chunk-000/file-000.parquet")
    (tmp_path / "set/meta/info.json").write_text(
        json.dumps({"codebase_version": "v3.0", "fps": 50, "features": {"observation.state": names, "action": names}})
    )
    columns = {"position": {"name": "observation.state", "unit": "rad"}, "kp": 20.0, "kd": 0.5,
               "position_target": {"name": "action", "unit": "rad"}}  # fmt: skip
    (tmp_path / "map.json").write_text(json.dumps(columns))
    said, usable = checked(Flags(tmp_path / "robot.xml", (tmp_path / "set",), columns=tmp_path / "map.json"))
    assert usable, said


@pytest.mark.parametrize("named", [True, False])
def test_a_public_data_set_and_the_demo_need_neither_model_nor_recordings(monkeypatch, named):
    log = record(pendulum(), smooth_torque(1.0))
    monkeypatch.setattr(inputs_module, "inputs", lambda *_: Inputs(pendulum(), [log], [log]))
    said, usable = checked(Flags(dataset="pendulum" if named else None))
    assert usable, said
    assert ("this is of the demo" in said) is not named

    def offline(*_):
        raise FetchError("no network")

    monkeypatch.setattr(inputs_module, "inputs", offline)
    assert checked(Flags(dataset="pendulum")) == ("- no network\nThe inputs cannot be used.", False)


def test_recordings_that_join_are_checked_too_and_copies_without_the_map(robot):
    arm(robot / "new.npz", joints=("hip",))
    asked = Flags(robot / "robot.xml", (robot / "moves",), output=robot / "out")
    said, usable = checked(asked, (robot / "new.npz", robot / "gone.npz"))
    assert not usable
    assert "new.npz: knee of the model is not recorded" in said
    assert "gone.npz: there is no such file" in said
    (robot / "out" / "with_payload").mkdir(parents=True)
    arm(robot / "out/with_payload/copy.npz", knee=0.5)
    time, names = np.arange(300) / 100, ("t", "q_hip", "q_knee", "u_hip", "u_knee")
    table = np.stack([time, np.sin(4 * time), np.sin(3 * time), np.sin(time), np.cos(time)], 1)
    np.savetxt(robot / "log.csv", table, delimiter=",", header=",".join(names), comments="")
    columns = {"time": "t", "position": "q_{joint}", "torque_command": "u_{joint}"}
    (robot / "map.json").write_text(json.dumps({"joint_names": ["hip", "knee"], **columns}))
    mapped = replace(asked, recordings=(robot / "log.csv",), columns=robot / "map.json")
    said, usable = checked(mapped, (robot / "out/with_payload/copy.npz",))
    assert usable, said


def test_what_is_wrong_with_numbers_is_said_with_all_else(robot):
    said, usable = checked(FitConfig(None, (robot / "empty",), memory=-1.0, seed=-2))
    assert [mark in said for mark in ("--memory", "--seed", "--model is missing", "no file of a known")] == [True] * 4
    assert not usable


def test_what_is_no_recording_may_lie_in_a_folder_but_is_not_named_and_joints_fit_each_other_and_the_model(tmp_path):
    (tmp_path / "robot.xml").write_text(SERVO)
    (tmp_path / "takes").mkdir()
    time = np.arange(300) / 100
    move = np.sin(4 * time)

    def take(path, *names):
        both = np.stack([move, 0.5 * move], 1)[:, : len(names)]
        write_recording(Recording(time, names, both, torque_command=0.1 * both), path)

    take(tmp_path / "takes" / "a.npz", "hip", "knee")
    (tmp_path / "takes" / "README.txt").write_text("Of Tuesday.")
    asked = Flags(tmp_path / "robot.xml", (tmp_path / "takes",))
    assert checked(asked)[1]
    assert "README" not in checked(asked)[0]
    said, usable = checked(replace(asked, recordings=(tmp_path / "takes" / "README.txt",)))
    assert "not a known kind of file" in said
    assert not usable
    take(tmp_path / "b.npz", "hip")
    said, usable = checked(replace(asked, heldout=(tmp_path / "b.npz",)))
    assert "knee of the model is not recorded. Record it, or say --lock knee." in said
    (tmp_path / "spaced.xml").write_text(SERVO.replace('"knee"', '"left knee"'))
    assert "or say --lock 'left knee'." in checked(Flags(tmp_path / "spaced.xml", (tmp_path / "b.npz",)))[0]
    (tmp_path / "slide.xml").write_text(SERVO.replace('name="knee"', 'name="knee" type="slide"'))
    slides = checked(replace(asked, model=tmp_path / "slide.xml", heldout=(tmp_path / "b.npz",)))[0]
    assert "knee of the model is not recorded." in slides
    assert "its joints are hip; " in said
    assert not usable
    said, usable = checked(Flags(tmp_path / "robot.xml", (tmp_path / "b.npz",), lock=("knee=0.1",)))
    assert usable, said
    take(tmp_path / "c.npz", "hip", "ankle")
    assert (
        "the model has no joint ankle; it has hip, knee."
        in checked(Flags(tmp_path / "robot.xml", (tmp_path / "c.npz",)))[0]
    )


def test_a_weight_that_changes_the_model_is_said_first(tmp_path):
    (tmp_path / "robot.xml").write_text(pendulum())
    heavy = replace(record(pendulum(), smooth_torque(1.0)), metadata={"payload_kg": 0.5})
    write_recording(heavy, tmp_path / "heavy.npz")
    notes = inputs(Flags(tmp_path / "robot.xml", (tmp_path / "heavy.npz",))).notes
    assert notes[0] == "Notes of the recordings change the model: payload_kg = 0.5, fastened to the last link."
    write_recording(replace(heavy, metadata={"payload_kg": 1.5}), tmp_path / "aside.npz")
    both = inputs(Flags(tmp_path / "robot.xml", (tmp_path / "heavy.npz",), (tmp_path / "aside.npz",))).notes
    assert "payload_kg = 0.5, 1.5, fastened" in both[0]
    assert json.dumps(notes)


@pytest.mark.parametrize(("said", "drive", "measured"), [(True, "command", True), (False, "measured", True),
                                                         (False, "command", False)])  # fmt: skip
def test_the_measured_torque_drives_where_the_map_or_the_flag_says_so(said, drive, measured, monkeypatch):
    monkeypatch.setattr(ColumnMap, "load", lambda path: ColumnMap(measured_drives=said))
    assert columns_for(Flags(columns=Path("map.json"), drive=drive)).measured_drives is measured
