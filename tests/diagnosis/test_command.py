"""The command line: flags to inputs, errors in one line, an ending that says where the report is."""

import json
import subprocess
import sys
from concurrent.futures import ThreadPoolExecutor
from dataclasses import asdict, replace
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
import tyro
from diagnosis.plants import pendulum, record, smooth_torque

from torchrl_athletic.diagnosis import command, fit_command
from torchrl_athletic.diagnosis.command import Config, inputs, main
from torchrl_athletic.diagnosis.folder import locked
from torchrl_athletic.diagnosis.model import ModelError
from torchrl_athletic.diagnosis.prepare import PAYLOAD
from torchrl_athletic.diagnosis.result import Answer
from torchrl_athletic.recordings import FetchError, RecordingError, read_recordings, write_recording

RECIPE = Path(__file__).parents[2] / "recipes/diagnose.py"
CONFIGS = {command: Config, fit_command: fit_command.FitConfig}


@pytest.fixture
def folder(tmp_path, monkeypatch):
    """A robot with three takes, as a user has it."""
    monkeypatch.chdir(tmp_path)
    Path("robot.xml").write_text(pendulum())
    Path("train").mkdir()
    for k, path in enumerate(("train/a.npz", "train/b.npz", "c.npz")):
        write_recording(record(pendulum(), smooth_torque(1.0, seed=k), seed=k), Path(path))
    return tmp_path


@pytest.fixture
def asked(monkeypatch):
    """What reaches the diagnosis; it answers at once that nothing is missing."""
    calls = []

    def answer(*args, **settings):
        calls.append((args, settings))
        return SimpleNamespace(
            experiment=None, answer=Answer("nothing_missing", ("All is well.",), complete=len(calls) == 1)
        )

    monkeypatch.setattr(command, "diagnose", answer)
    return calls


def parsed(*args: str) -> Config:
    return tyro.cli(Config, args=args)


def test_files_and_folders_are_named_one_after_the_other(folder):
    config = parsed("--model", "robot.xml", "--recordings", "train", "c.npz", "--heldout", "c.npz", "--seed", "3")
    model, recordings, heldout = inputs(config)
    assert config.seed == 3
    assert model == Path("robot.xml")
    assert [Path(r.source).name for r in recordings] == ["a.npz", "b.npz", "c.npz"]
    assert [Path(r.source).name for r in heldout] == ["c.npz"]


def test_every_flag_reaches_the_diagnosis(folder, asked, capsys):
    flags = "--model robot.xml --recordings train --drive measured --base fixed --seed 4 --time-budget 60"
    flags += " --highest-frequency 5 --memory 2 --output there"
    main(parsed(*flags.split()))
    [((model, recordings, heldout), settings)] = asked
    assert (model, len(recordings), heldout) == (Path("robot.xml"), 2, [])
    assert settings["joined"] == []
    told = ("drive", "base", "seed", "time_budget", "memory", "highest_frequency", "output")
    assert {k: settings[k] for k in told} == {
        "drive": "measured",
        "base": "fixed",
        "seed": 4,
        "time_budget": 60.0,
        "memory": 2.0,
        "highest_frequency": 5.0,
        "output": Path("there"),
    }
    shown = capsys.readouterr()
    assert "All is well." in shown.out
    assert "there/report.html" in shown.out
    assert "Stopped early" not in shown.out
    assert shown.err == ""  # no bar where nobody looks


def test_a_stopped_run_goes_on_only_from_what_was_kept_of_it(folder, asked, capsys):
    run = "--model robot.xml --recordings train --output there"
    main(parsed(*run.split()))  # complete, as no later one is
    endings = []
    for flags in ("", " --time-budget 5"):
        for digest in ("", "of another run"):
            kept = {"digest": digest, "results": {"fit": 1}}
            Path("there").mkdir(exist_ok=True)
            Path("there/progress.json").write_text(json.dumps(kept))
            main(parsed(*f"{run}{flags}".split()))
            endings.append(capsys.readouterr().out.splitlines()[-1])
    begin = "Stopped early. No fit was finished by then, so that nothing is kept: begin anew"
    on = "Stopped early. The same command goes on from here."
    assert endings == [on, f"{begin}.", on, f"{begin}, with a larger --time-budget than 5 s."]


def test_what_the_first_run_was_told_is_told_again_where_a_recording_joins(folder, asked):
    first = "--model robot.xml --recordings train --heldout c.npz --drive measured --seed 4"
    main(parsed(*first.split(), "--output", "there"))
    main(parsed(*"--output there --continue train/a.npz".split()))
    for (model, *groups), settings in asked:
        assert Path(model).name == "robot.xml"
        assert [[Path(r.source).name for r in group] for group in groups] == [["a.npz", "b.npz"], ["c.npz"]]
        assert (settings["drive"], settings["seed"]) == ("measured", 4)


@pytest.mark.parametrize(("weight", "said"), [(0.0, "new_recording.npz\n"), (0.5, "new_recording.npz --payload 0.5\n")])
def test_how_the_diagnosis_goes_on_is_said_with_the_weight_that_the_plan_asks_for(
    folder, monkeypatch, capsys, weight, said
):
    plan = SimpleNamespace(sentence="Swing the elbow alone.", payload=weight)
    answer = Answer("nothing_missing", ("All is well.",))
    monkeypatch.setattr(command, "diagnose", lambda *_, **__: SimpleNamespace(experiment=plan, answer=answer))
    main(parsed("--model", "robot.xml", "--recordings", "train", "--output", "my out"))
    assert f"--output 'my out' --continue {said}" in capsys.readouterr().out


def test_what_was_fastened_goes_with_the_recordings_that_join_and_stays_with_them(folder, asked):
    flags = "--model robot.xml --recordings train --output there"
    main(parsed(*flags.split()))
    main(parsed(*"--output there --continue c.npz --payload 0.5".split()))
    main(parsed(*"--output there --continue train/a.npz".split()))
    new = [settings["joined"] for _, settings in asked]
    assert [[r.metadata.get(PAYLOAD) for r in group] for group in new] == [[], [0.5], [0.5, None]]
    np.testing.assert_array_equal(
        new[1][0].position, inputs(parsed(*flags.split(), "--heldout", "c.npz"))[2][0].position
    )


def test_joints_that_are_locked_stay_so_where_a_recording_joins(folder, asked):
    inner = '<body pos="0.1 0 0"><joint name="wrist" axis="0 1 0"/><geom size="0.01"/></body></body></worldbody>'
    Path("two.xml").write_text(pendulum().replace("</body></worldbody>", inner))
    one = record(pendulum(), smooth_torque(1.0))
    for name in ("first.npz", "new.npz"):
        both = {
            f: np.stack([getattr(one, f)[:, 0], np.full(one.num_samples, 0.2)], 1)
            for f in ("position", "torque_command")
        }
        write_recording(replace(one, joint_names=("pendulum", "wrist"), velocity=None, **both), Path(name))
    main(parsed(*"--model two.xml --recordings first.npz --lock wrist --output there".split()))
    main(parsed(*"--output there --continue new.npz".split()))
    (_, recordings, _), settings = asked[1]
    assert [r.joint_names for r in (*recordings, *settings["joined"])] == [("pendulum",)] * 2


def test_a_check_of_recordings_that_join_knows_the_first_ones(folder, asked, capsys):
    def check(flags):
        capsys.readouterr()
        with pytest.raises(SystemExit) as ended:
            main(parsed(*f"--output there {flags} --check".split()))
        return ended.value.code, capsys.readouterr().out

    said = check("--continue c.npz --memory -1")[1]
    assert "nothing to continue" in said
    assert "--memory is -1" in said
    main(parsed(*"--model robot.xml --recordings train --output there".split()))
    assert check("--continue c.npz") == (0, "The inputs can be used.\n")
    assert check("--continue c.npz --payload 0.5")[0] == 0
    code, said = check("--continue gone.npz")
    assert code == 1
    assert "gone.npz: there is no such file" in said
    assert "--payload speaks of the recordings of --continue" in check("--payload 0.5")[1]


def test_flags_that_are_given_with_a_recording_that_joins_win_and_those_that_stay_are_told(folder, asked, capsys):
    main(parsed(*"--model robot.xml --recordings train --seed 4 --time-budget 60 --uan --output there".split()))
    capsys.readouterr()
    main(parsed(*"--output there --continue c.npz --seed 7 --memory 2".split()))
    assert [asked[1][1][name] for name in ("seed", "time_budget", "memory")] == [7, 60.0, 2.0]
    first, *_ = capsys.readouterr().out.splitlines()
    assert first.startswith("As in the earlier diagnosis: --model ")
    assert first.endswith("/train --time-budget 60.0 --uan")


def test_a_highest_frequency_is_remembered_until_another_one_is_said(folder, asked):
    main(parsed(*"--model robot.xml --recordings train --output there".split()))
    main(parsed(*"--output there --continue c.npz --highest-frequency 5".split()))
    main(parsed(*"--output there --continue c.npz".split()))
    main(parsed(*"--output there --continue c.npz --highest-frequency 3".split()))
    assert [settings["highest_frequency"] for _, settings in asked] == [None, 5.0, 5.0, 3.0]


def test_takes_with_a_weight_join_once_and_those_of_two_rounds_may_bear_one_name(folder, asked):
    main(parsed(*"--model robot.xml --recordings train --output there".split()))
    for round_, source in enumerate(("train/a.npz", "c.npz")):
        Path(f"r{round_}").mkdir()
        Path(f"r{round_}/new.npz").write_bytes(Path(source).read_bytes())
    for flags in ("--continue r0/new.npz --payload .5", "--continue r1/new.npz --payload .7") * 2:
        main(parsed(*f"--output there {flags}".split()))
    last = asked[-1][1]["joined"]
    assert sorted(r.metadata[PAYLOAD] for r in last) == [0.5, 0.7]
    first = next(r for r in last if r.metadata[PAYLOAD] == 0.5)
    np.testing.assert_array_equal(first.position, read_recordings([Path("train/a.npz")])[0].position)


def test_a_fit_alone_gets_the_same_inputs_and_asks_for_no_names(folder, asked, monkeypatch):
    fitted = []
    monkeypatch.setattr(fit_command, "main", fitted.append)
    main(parsed(*"--model robot.xml --recordings train --output there --drive measured --fit-only".split()))
    assert asked == []
    assert fitted == [
        fit_command.FitConfig(Path("robot.xml"), (Path("train"),), output=Path("there"), drive="measured")
    ]


def test_without_arguments_the_demo_runs(asked, monkeypatch):
    import torchrl_athletic.recordings.demo as demo

    r = record(pendulum(), smooth_torque(1.0))
    seeds = []
    made = SimpleNamespace(model_xml="<mujoco/>", recordings=[r], heldout=[r, r])
    monkeypatch.setattr(demo, "concealed_demo", lambda seed: seeds.append(seed) or made)
    main(parsed())
    main(parsed("--demo", "7"))
    assert seeds == [0, 7]
    assert asked[0][0] == ("<mujoco/>", [r], [r, r])


def test_a_data_set_brings_model_and_recordings(monkeypatch):
    import torchrl_athletic.recordings.datasets as datasets

    monkeypatch.setattr(
        datasets, "load_dataset", lambda name: SimpleNamespace(model=name, recordings=[1], heldout=(2,))
    )
    assert inputs(parsed("--dataset", "xl330")) == ("xl330", [1], [2])
    with pytest.raises(SystemExit):
        parsed("--dataset", "nonsense")


def foreign(*names):
    """One take in logs whose columns a map.json names; what was recorded."""
    r = record(pendulum(), smooth_torque(1.0))
    table = np.stack([1e3 * r.time, np.rad2deg(r.position[:, 0]), r.torque_command[:, 0]], axis=1)
    for name in names:
        np.savetxt(name, table, delimiter=",", header="t,angle,u", comments="")
    columns = {"time": {"name": "t", "unit": "ms"}, "position": {"name": "angle", "unit": "deg"}, "torque_command": "u"}
    Path("map.json").write_text(json.dumps({"joint_names": ["pendulum"], **columns}))
    return r


def test_foreign_columns_are_read_by_their_map(folder):
    r = foreign("log.csv")
    _, [read], _ = inputs(parsed("--model", "robot.xml", "--recordings", "log.csv", "--columns", "map.json"))
    np.testing.assert_allclose(read.position, r.position, atol=1e-9)


def test_recordings_that_join_are_read_by_the_columns_of_the_first_ones(folder, asked):
    r = foreign("log.csv", "more.csv")
    main(parsed(*"--model robot.xml --recordings log.csv --columns map.json --output there".split()))
    main(parsed(*"--output there --continue more.csv".split()))
    [new] = asked[1][1]["joined"]
    np.testing.assert_allclose(new.position, r.position, atol=1e-9)


def test_copies_that_say_what_was_fastened_are_read_without_the_map_of_the_logs(folder, asked):
    r = foreign("log.csv", "more.csv", "last.csv")
    main(parsed(*"--model robot.xml --recordings log.csv --columns map.json --output there".split()))
    main(parsed(*"--output there --continue more.csv --payload 0.5".split()))
    main(parsed(*"--output there --continue last.csv".split()))
    first, then = asked[2][1]["joined"]
    assert [t.metadata.get(PAYLOAD) for t in (first, then)] == [0.5, None]
    for new in (*asked[1][1]["joined"], first, then):
        np.testing.assert_allclose(new.position, r.position, atol=1e-9)


def test_recordings_that_join_have_the_gains_of_the_model_and_the_measured_drive_as_the_first_ones(folder, asked):
    servo = pendulum().replace('<motor joint="pendulum"/>', '<position joint="pendulum" kp="30" kv="2"/>')
    Path("servo.xml").write_text(servo)
    r = record(pendulum(), smooth_torque(1.0))
    bare = {"time": r.time, "joint_names": ["pendulum"], "position": r.position}
    for name in ("a.npz", "b.npz"):
        np.savez(f"targets_{name}", **bare, position_target=r.position)
        np.savez(f"measured_{name}", **bare, torque_measured=r.torque_command)
    for kind in ("targets", "measured"):
        flags = "--drive measured" if kind == "measured" else "--drive command"
        main(parsed(*f"--model servo.xml --recordings {kind}_a.npz --output {kind} {flags}".split()))
        for weight in ("", " --payload 0.5"):
            main(parsed(*f"--output {kind} --continue {kind}_b.npz{weight}".split()))
    joining = [settings["joined"][0] for _, settings in asked if settings["joined"]]
    assert [(new.kp, new.kd) for new in joining[:2]] == [(30.0, 2.0)] * 2
    for new in joining[2:]:
        np.testing.assert_array_equal(new.torque_command, r.torque_command)


@pytest.mark.parametrize(
    ("flags", "missing"), [(["--model", "x.xml"], "--recordings"), (["--recordings", "x"], "--model")]
)
def test_half_of_what_is_needed_is_refused(flags, missing):
    with pytest.raises(RecordingError, match=f"{missing} is missing. Give both, or --dataset NAME, or nothing at all"):
        inputs(parsed(*flags))


@pytest.mark.parametrize(
    ("flags", "says"),
    [
        ("--model robot.xml", "error: --recordings is missing"),
        ("--model nowhere.xml --recordings train", "nowhere.xml: there is no such model"),
        ("--model bad.xml --recordings train", "bad.xml: MuJoCo cannot compile it"),
        ("--model robot.xml --recordings nowhere", "nowhere: there is no such file or folder"),
        ("--model robot.xml --recordings robot.xml", "not a known kind of file"),
        ("--model robot.xml --recordings broken.npz", "broken.npz"),
        ("--model robot.xml --recordings train --columns nowhere.json", "nowhere.json"),
        ("--model robot.xml --recordings train --columns broken.npz", "broken.npz"),
        ("--model knee.xml --recordings train", "joint_names has 'pendulum', the model has ['knee']"),
        ("--model robot.xml --recordings train --payload 0.5", "--payload speaks of the recordings of --continue"),
        ("--model robot.xml --recordings train --highest-frequency 0", "--highest-frequency is 0.0 Hz. Give more"),
        ("--model robot.xml --recordings train --drive measured", "there is no torque_measured"),
        ("--model robot.xml --recordings train --output robot.xml", "--output robot.xml is a file. Name a folder."),
    ],
)
def test_a_mistake_is_answered_in_one_line(folder, flags, says):
    Path("bad.xml").write_text("<mujoco><worldbody><body><joint/></body></worldbody></mujoco>")
    Path("knee.xml").write_text(pendulum(name="knee"))
    Path("broken.npz").write_bytes(b"PK\x03\x04 not a zip")
    with pytest.raises(SystemExit) as stopped:
        main(parsed(*flags.split()))
    message = str(stopped.value.code)  # text makes the exit code 1
    assert message.startswith("error: ")
    assert says in message
    assert "\n" not in message


@pytest.mark.parametrize(
    ("flag", "says"),
    [
        ("--memory nan", "--memory is nan GB. Give more than 0, or leave it out."),
        ("--memory -1", "--memory is -1.0 GB. Give more than 0"),
        ("--time-budget -5", "--time-budget is -5.0 s. Give more than 0"),
        ("--time-budget 0", "--time-budget is 0.0 s. Give more than 0"),
        ("--time-budget inf", "--time-budget is inf s."),
        ("--seed -1", "--seed is -1. Give 0 or more, or leave it out."),
        ("--memory 0 --seed -2", "--memory is 0.0 GB. Give more than 0, or leave it out. --seed is -2."),
        ("--demo -1", "--demo is -1. Give 0 or more"),
        ("--continue c.npz --payload nan", "--payload is nan kg. Give 0 or more"),
        ("--continue c.npz --payload -0.5", "--payload is -0.5 kg. Give 0 or more"),
    ],
)
@pytest.mark.parametrize("module", [command, fit_command])
def test_a_number_that_is_none_or_too_small_is_refused_before_any_work(folder, module, flag, says):
    if module is fit_command and ("--demo" in flag or "--continue" in flag):
        return
    config = tyro.cli(CONFIGS[module], args=f"--model robot.xml --recordings train --output there {flag}".split())
    with pytest.raises(SystemExit) as stopped:
        module.main(config)
    assert str(stopped.value.code).startswith(f"error: {says}")
    assert not Path("there").exists()


def test_ctrl_c_before_anything_was_found_ends_without_a_traceback(folder, monkeypatch):
    def stop(*_args, **_kwargs):
        raise KeyboardInterrupt

    monkeypatch.setattr(command, "diagnose", stop)
    with pytest.raises(SystemExit, match="Stopped before there was anything to report"):
        main(parsed("--model", "robot.xml", "--recordings", "train"))


def test_a_run_that_is_killed_leaves_the_inputs_of_the_diagnosis_that_lies_there(folder, asked, monkeypatch):
    main(parsed(*"--model robot.xml --recordings train --output there --seed 1".split()))
    before = Path("there/inputs.json").read_text()

    def die(*_args, **_settings):
        raise SystemError

    monkeypatch.setattr(command, "diagnose", die)
    with pytest.raises(SystemError):
        main(parsed(*"--model robot.xml --recordings c.npz --output there --seed 2".split()))
    assert Path("there/inputs.json").read_text() == before


def test_a_second_run_in_the_folder_is_refused_while_the_first_one_runs(folder, monkeypatch):
    flags = "--model robot.xml --recordings train --output there"
    refused = []

    def meanwhile(*_args, **_settings):
        with ThreadPoolExecutor(1) as pool:
            refused.append(pool.submit(main, parsed(*flags.split())).exception())
        raise KeyboardInterrupt

    monkeypatch.setattr(command, "diagnose", meanwhile)
    with pytest.raises(SystemExit):
        main(parsed(*flags.split()))
    assert str(refused[0]).startswith("error: there: another run is writing there")


def test_a_mistake_leaves_no_empty_folder(folder):
    with pytest.raises(SystemExit, match="there is no such file or folder"):
        main(parsed(*"--model robot.xml --recordings nowhere --output there".split()))
    assert not Path("there").exists()


def test_the_recipe_ends_with_one_line_on_stderr_and_code_1(folder):
    run = subprocess.run(
        [sys.executable, RECIPE, "--model", "nowhere.xml", "--recordings", "train"],
        capture_output=True,
        text=True,
        check=False,
    )
    assert run.returncode == 1
    assert run.stdout == ""
    assert run.stderr == "error: nowhere.xml: there is no such model. Name an MJCF file, or pass its text.\n"


def test_what_is_left_is_handed_over_when_asked_and_only_then(folder, asked):
    handed = []

    def hand_over(diagnosis, output):
        handed.append(output)
        return SimpleNamespace(experiment=None, answer=Answer("nothing_missing", ("A net was taught.",)))

    given = parsed("--model", "robot.xml", "--recordings", "train", "--uan")
    assert main(given, hand_over).answer.summary == ("A net was taught.",)
    assert handed == [given.output]
    main(given, hand_over)  # which was stopped before its end
    assert len(handed) == 1
    main(parsed("--model", "robot.xml", "--recordings", "train"), hand_over)
    assert len(handed) == 1


def test_a_remainder_that_cannot_be_learnt_leaves_the_diagnosis_and_says_why(folder, asked, capsys):
    def hand_over(diagnosis, output):
        raise ValueError("the takes have several gains")

    found = main(parsed("--model", "robot.xml", "--recordings", "train", "--uan"), hand_over)
    assert found.answer.summary == ("All is well.",)
    assert "No UAN was trained: the takes have several gains" in capsys.readouterr().out


@pytest.mark.parametrize(
    ("config", "said"),
    [
        (Config, {"drive": "command", "base": "recorded", "output": Path("out/diagnosis")}),
        (fit_command.FitConfig, {"drive": "command", "draws": 1, "output": Path("out/fit")}),
    ],
)
def test_nothing_is_asked_for_unless_it_is_said(config, said):
    """No flag is up and no number but none or zero, but for one draw, where it writes and what drives a robot."""
    assert {name: value for name, value in asdict(tyro.cli(config, args=[])).items() if value} == said


@pytest.mark.parametrize("module", [command, fit_command])
@pytest.mark.parametrize("kind", [RecordingError, FetchError, ModelError, OSError, ImportError])
def test_whatever_is_wrong_with_the_inputs_is_said_in_one_line(module, kind, tmp_path, monkeypatch):
    def refuse(*_args):
        raise kind("take.npz:\n  it lies\t elsewhere")

    monkeypatch.setattr(module, "inputs", refuse)
    config = CONFIGS[module](output=tmp_path / "out")
    with pytest.raises(SystemExit) as stopped:
        module.main(config)
    assert stopped.value.code == "error: take.npz: it lies elsewhere"


@pytest.mark.parametrize("module", [command, fit_command])
def test_a_fit_that_is_stopped_or_has_nowhere_to_write_ends_in_a_sentence(module, tmp_path, monkeypatch):
    def stop(*_args):
        raise KeyboardInterrupt

    monkeypatch.setattr(module, "inputs", stop)
    (tmp_path / "file").touch()
    (tmp_path / "there").mkdir()  # as of an earlier run
    stopped, nowhere = "Stopped before there was anything to report", "file is a file. Name a folder."
    for output, says in (("new", stopped), ("there", stopped), ("file", nowhere)):
        with pytest.raises(SystemExit, match=says):
            module.main(CONFIGS[module](output=tmp_path / output))


@pytest.mark.parametrize(
    ("module", "flags", "other"),
    [(command, {}, "fit.json"), (fit_command, {}, "diagnosis.json"), (command, {"fit_only": True}, "diagnosis.json")],
)
def test_a_fit_and_a_diagnosis_do_not_share_a_folder_which_is_said_before_the_work(module, flags, other, tmp_path):
    (tmp_path / other).write_text("{}")
    with pytest.raises(SystemExit) as refused:
        module.main(CONFIGS[module](output=tmp_path, **flags))
    assert str(refused.value.code).startswith(f"error: {tmp_path} holds {other}")


@pytest.mark.parametrize("module", [command, fit_command])
def test_a_second_run_in_a_folder_is_refused_before_the_work(module, tmp_path):
    """From another thread, which the lock takes for a stranger as it does another process."""
    with ThreadPoolExecutor(1) as pool, locked(tmp_path, "fit.json"):
        run = pool.submit(module.main, CONFIGS[module](output=tmp_path))
        with pytest.raises(SystemExit, match="another run is writing there"):
            run.result()


@pytest.mark.parametrize("notes", [[], ["A first note.", "A second one."]])
@pytest.mark.parametrize("module", [command, fit_command])
def test_what_is_unusual_about_the_inputs_is_said_first_a_line_each(
    module, notes, asked, tmp_path, monkeypatch, capsys
):
    monkeypatch.setattr(module, "inputs", lambda *_: SimpleNamespace(model="", recordings=[], heldout=[], notes=notes))
    monkeypatch.setattr(fit_command, "fit", lambda *_, **__: SimpleNamespace(parameters=(), scores={}, remarks=()))
    config = CONFIGS[module]
    module.main(config(output=tmp_path / "out"))
    lines = capsys.readouterr().out.splitlines()
    assert lines[: len(notes)] == notes
    assert lines[len(notes)]  # and no empty line after them
    if module is command:
        assert asked[0][0] == ("", [], [])


def test_a_check_says_what_it_found_and_ends_with_whether_the_inputs_will_do(monkeypatch, capsys):
    for module, config in ((command, Config(check=True)), (fit_command, fit_command.FitConfig(check=True))):
        for usable in (True, False):
            monkeypatch.setattr(module, "checked", lambda given, *_, usable=usable: (f"usable: {usable}", usable))
            with pytest.raises(SystemExit) as ended:
                module.main(config)
            assert ended.value.code == int(not usable)
            assert capsys.readouterr().out == f"usable: {usable}\n"
