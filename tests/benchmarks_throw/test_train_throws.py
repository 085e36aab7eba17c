"""Which policies are trained, where, and what happens to those that fail or take too long."""

import subprocess
import sys
from pathlib import Path

import pytest
import tyro

from benchmarks import train_throws
from benchmarks.throw_transfer import load_recipe
from benchmarks.train_throws import Config, Job, jobs_of, keep_simulator, last_line, main, policy_of, start


@pytest.fixture
def simulators(tmp_path):
    """Folders of three methods, one of which was identified twice."""
    folders = [tmp_path / name for name in ("default", "uan_seed0", "uan_seed1", "cem_seed0", "notes")]
    for folder in folders:
        folder.mkdir()
        if folder.name != "notes":
            (folder / "simulator.json").write_text(folder.name)
    return tuple(folders)


def leave_policy(output, iterations):
    output.mkdir(parents=True, exist_ok=True)
    (output / "policy.pt").touch()
    (output / "progress.csv").write_text(f"step,seconds,distance_m\n1,60.0,\n{iterations},120.0,1.5\n")


def test_every_method_has_as_many_policies_and_the_first_of_each_comes_first(simulators, tmp_path):
    jobs = jobs_of(Config(simulators, output=tmp_path, seeds=(0, 1, 5)))
    assert [job.output.name for job in jobs] == [
        *("default-0", "uan_seed0-0", "cem_seed0-0"),
        *("default-1", "uan_seed1-1", "cem_seed0-1"),
        *("default-5", "uan_seed0-5", "cem_seed0-5"),
    ]
    assert all(job.output.name == f"{job.folder.name}-{job.seed}" for job in jobs)


@pytest.fixture
def started(monkeypatch):
    """Trainings that do nothing but end with the code that ``codes`` holds for their device; as they were started."""
    jobs, codes = [], {}

    def pretend(job, cfg, place, seconds):
        jobs.append((job.output.name, job.device, place))
        leave_policy(job.output, 0)
        (job.output / "log.txt").write_text("out of memory\n")
        return subprocess.Popen([sys.executable, "-S", "-c", codes.get(job.device, "")])

    monkeypatch.setattr(train_throws, "start", pretend)
    return jobs, codes


def test_policies_that_had_their_iterations_are_left_alone(simulators, tmp_path, started):
    leave_policy(tmp_path / "out" / "default-0", 120)
    leave_policy(tmp_path / "out" / "uan_seed0-0", 119)
    main(Config(simulators, output=tmp_path / "out", seeds=(0,), iterations=120))
    assert [name for name, *_ in started[0]] == ["uan_seed0-0", "cem_seed0-0"]


def test_what_fails_on_a_gpu_is_tried_on_the_cpu_once(simulators, tmp_path, started):
    started[1].update(cuda="raise SystemExit(1)", cpu="raise SystemExit(1)")
    main(Config(simulators[:1], output=tmp_path / "out", seeds=(0,), device="cuda"))
    assert [device for _, device, _ in started[0]] == ["cuda", "cpu"]


def test_trainings_at_a_time_have_places_of_their_own(simulators, tmp_path, started):
    started[1]["cpu"] = "import time; time.sleep(0.3)"
    main(Config(simulators, output=tmp_path / "out", seeds=(0,), jobs=3))
    assert sorted(place for *_, place in started[0]) == [0, 1, 2]


def test_all_stops_when_the_budget_is_spent(simulators, tmp_path, started, monkeypatch):
    started[1]["cpu"] = "import time; time.sleep(100)"
    ended, wait = [], subprocess.Popen.wait
    monkeypatch.setattr(subprocess.Popen, "wait", lambda self: ended.append(wait(self)))
    main(Config(simulators, output=tmp_path / "out", seeds=(0,), jobs=2, budget=0.2))
    assert ended == [-9, -9]
    assert len(started[0]) == 2  # none is begun after the end


class Ended:
    """What :func:`start` gets in place of a process: it notes how it was called."""

    pid = 0

    def __init__(self, words, **options):
        Ended.words, Ended.env = words, options["env"]


def call_of(monkeypatch, job, cfg, place=0, seconds=600.0):
    """What a training is started with: flags, as the recipe reads them, environment and cores."""
    cores = []
    monkeypatch.setattr(train_throws.subprocess, "Popen", Ended)
    monkeypatch.setattr(train_throws.os, "sched_setaffinity", lambda pid, mine: cores.extend(mine))
    monkeypatch.setattr(train_throws.os, "sched_getaffinity", lambda pid: {0, 1, 2, 3})
    start(job, cfg, place, seconds)
    assert Path(Ended.words[1]).name == "throw_arm.py"
    return tyro.cli(load_recipe().Config, args=Ended.words[2:]), Ended.env, cores


def test_a_training_is_told_all_that_it_needs(simulators, tmp_path, monkeypatch):
    job = Job(simulators[1], 3, tmp_path / "uan_seed0-3", "cuda")
    cfg = Config(simulators, device="cuda", num_envs=2048, jobs=4, gpus=2, iterations=7)
    told, env, cores = call_of(monkeypatch, job, cfg, place=3)
    assert (told.seed, told.iterations, told.device, told.begin_with) == (3, 7, "cuda", None)
    assert (told.ppo.num_envs, told.ppo.actor_minibatches) == (2048, 4)
    assert told.simulator == tmp_path / "uan_seed0-3" / "simulator"
    assert (told.simulator / "simulator.json").read_text() == "uan_seed0"
    assert told.minutes == pytest.approx((600 - train_throws.STARTING) / 60)
    assert env["CUDA_VISIBLE_DEVICES"] == "1"
    assert cores == [3]


def test_trainings_on_the_cpu_share_its_cores(simulators, tmp_path, monkeypatch):
    job = Job(simulators[0], 0, tmp_path / "default-0", "cpu")
    seen = [call_of(monkeypatch, job, Config(simulators, jobs=jobs), place)[2] for jobs, place in ((2, 1), (9, 6))]
    assert seen == [[1, 3], [2]]


def test_the_time_of_earlier_runs_does_not_count_against_the_budget(simulators, tmp_path, monkeypatch):
    job, cfg = Job(simulators[0], 0, tmp_path / "default-0", "cpu"), Config(simulators)
    first = call_of(monkeypatch, job, cfg)[0]
    (job.output / "checkpoints").mkdir()
    leave_policy(job.output, 2)
    again = call_of(monkeypatch, job, cfg)[0]
    assert again.minutes - first.minutes == pytest.approx(2.0)


def test_a_policy_stays_in_the_simulator_that_it_was_begun_in(simulators, tmp_path):
    default, one, other = simulators[:3]
    (one / "net.pt").write_bytes(b"net")
    keep_simulator(one, tmp_path / "p" / "simulator")
    keep_simulator(one, tmp_path / "p" / "simulator")
    assert (tmp_path / "p" / "simulator" / "net.pt").read_bytes() == b"net"
    with pytest.raises(ValueError, match=r"simulator\.json differ.*Remove that folder"):
        keep_simulator(other, tmp_path / "p" / "simulator")
    (one / "net.pt").write_bytes(b"new")
    with pytest.raises(ValueError, match=r"net\.pt differ"):
        keep_simulator(one, tmp_path / "p" / "simulator")
    assert (default / "simulator.json").exists()


def test_what_is_reported_of_a_training(tmp_path):
    (tmp_path / "log.txt").write_text("9 %\r1.50 ± 0.10 m, 0 % of throws failed\nsome warning\n")
    assert last_line(tmp_path).startswith("1.50 ± 0.10 m")
    assert last_line(tmp_path, failed=True) == "some warning"


def test_a_training_begins_with_the_policy_of_its_seed(simulators, tmp_path, monkeypatch):
    base = tmp_path / "base"
    for name in ("default-1", "default-2", "mine-2"):
        leave_policy(base / name, 90)
    cfg = Config(simulators, begin_with=base)
    told = call_of(monkeypatch, Job(simulators[0], 1, tmp_path / "default-1", "cpu"), cfg)[0]
    assert told.begin_with == base / "default-1" / "policy.pt"
    for seed, count in ((0, 0), (2, 2)):
        with pytest.raises(ValueError, match=f"holds {count} policies of seed {seed}"):
            policy_of(seed, base)
