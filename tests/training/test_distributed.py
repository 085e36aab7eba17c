import os
import shutil
import subprocess
import sys
from contextlib import nullcontext
from pathlib import Path

import pytest
import torch
from tensordict import TensorDict
from torchrl.objectives.value import GAE
from training import together as jobs
from training.tasks import arm_env, arm_learner
from training.together import together

from torchrl_athletic.losses import SplitClipPPOLoss, SplitOptimizationStepper
from torchrl_athletic.networks import actor, critic
from torchrl_athletic.training import Checkpoints, CSVTable, NonFiniteError, Processes, join_processes
from torchrl_athletic.training.distributed import ALONE, check_finite_everywhere, check_seeds_differ

module = sys.modules["torchrl_athletic.training.distributed"]


def agree(ours, theirs, **tolerance):
    for key in theirs:
        torch.testing.assert_close(ours[key], theirs[key], msg=lambda text, key=key: f"{key}: {text}", **tolerance)


@pytest.mark.parametrize(("masked", "critic_minibatches"), [(False, 1), (True, 1), (True, 4)])
def test_an_update_of_two_halves_is_that_of_the_whole(tmp_path, masked, critic_minibatches):
    """Parameters, learning rate and reports, with as many or with unlike numbers of samples that count."""
    whole = jobs.update(ALONE, masked, critic_minibatches)
    for half in together(tmp_path, jobs.update, masked, critic_minibatches):
        agree(half, whole, rtol=1e-9, atol=1e-12)
    assert whole["actor_grad_norm"] > 0.1  # so that clipping comes after the average


def test_statistics_are_those_of_all_rows(tmp_path):
    whole = jobs.statistics(ALONE)
    halves = together(tmp_path, jobs.statistics)
    for half in halves:
        agree(half["normalizer"], whole["normalizer"], rtol=1e-5, atol=1e-6)
        assert half["means"].tolist() == [4.0, 4.0, 3.0]  # (1 * 1 + 3 * 5) / 4, and a NaN that has no weight
    assert halves[0]["normalizer"]["mean"].equal(halves[1]["normalizer"]["mean"])
    joined = torch.cat([half["advantage"] for half in halves])
    torch.testing.assert_close(joined, whole["advantage"])


def test_advantages_are_standardised_as_torchrl_does():
    learner = arm_learner()
    batch = learner.rollout()
    for shown in (batch, batch["next"]):
        shown["state_value"] = learner.critic(shown.select("joint_position").clone())["state_value"].detach()
    stock, plain = (
        GAE(gamma=0.9, lmbda=0.9, value_network=None, average_gae=average, vectorized=False)(batch.clone())
        for average in (True, False)
    )
    ours = jobs.standardized(plain["advantage"], ALONE)
    torch.testing.assert_close(ours, stock["advantage"])
    assert plain["value_target"].equal(stock["value_target"])


@pytest.mark.parametrize(("spread", "left"), [(1e-3, 1.0), (1e-5, 0.1), (0.0, 0.0)])
def test_advantages_that_hardly_differ_are_not_blown_up(spread, left):
    value = 2.0 + spread * torch.tensor([-1.0, 0.0, 1.0], dtype=torch.float64).view(3, 1)
    assert float(jobs.standardized(value, ALONE).std()) == pytest.approx(left, rel=1e-6)


def test_training_in_two_processes_is_training_in_one_where_rows_explore_alike(tmp_path):
    """Three iterations of everything: collection, normaliser, advantages, update, learning rate, reports."""
    whole = jobs.exact_training(ALONE)
    for half in together(tmp_path, jobs.exact_training):
        agree(half, whole, rtol=1e-3, atol=1e-5)
    assert whole["actor_lr"].unique().numel() > 1


def test_two_processes_end_with_the_same_weights_and_learn_as_fast_as_one(tmp_path):
    ours, theirs = together(tmp_path, jobs.training)
    assert ours["weights"].equal(theirs["weights"])
    assert ours["rewards"].equal(theirs["rewards"])
    assert not ours["noise"].equal(theirs["noise"])
    alone = jobs.training(ALONE)
    late = slice(-5, None)
    assert ours["rewards"][late].mean() / alone["rewards"][late].mean() == pytest.approx(1.0, abs=0.4)
    assert ours["rewards"][late].mean() > ours["rewards"][0] / 2


def test_the_first_process_has_the_clock_and_measures(tmp_path):
    ours, theirs = together(tmp_path, jobs.in_time)
    assert ours["iterations"] == theirs["iterations"] > 0
    assert ours["metrics"] == theirs["metrics"]
    assert ours["metrics"]["error"] == 0.0
    assert (len(ours["evaluated"]), theirs["evaluated"]) == (1, [])


def test_a_nan_in_one_process_stops_both(tmp_path):
    for found in together(tmp_path, jobs.a_nan):
        assert "in process 1 of 2: ('next', 'reward') of the batch is nan in row 0 at step 3" in found["error"]


def test_processes_that_would_explore_alike_are_refused(tmp_path):
    for found in together(tmp_path, jobs.alike):
        assert "torch.manual_seed(processes.seed(seed))" in found["error"]


@pytest.fixture(scope="module")
def whole(tmp_path_factory):
    """A run that is left alone."""
    folder = tmp_path_factory.mktemp("whole")
    return folder, together(folder / "found", jobs.saved_training, folder)


@pytest.mark.parametrize("victim", [0, 1])
def test_a_killed_run_goes_on_from_the_newest_state_that_all_have(whole, tmp_path, victim):
    """The first process writes when the others have: if it dies before that, theirs is one too many."""
    assert together(tmp_path / "found", jobs.saved_training, tmp_path, 5, victim) == [None, None]
    left = sorted(path.relative_to(tmp_path).as_posix() for path in tmp_path.rglob("checkpoint-*"))
    newest, incomplete = "checkpoint-000000000002", "checkpoint-000000000004"
    assert left == [newest, f"rank1/{newest}", *([f"rank1/{incomplete}"] if victim == 0 else [])]
    again = together(tmp_path / "found", jobs.saved_training, tmp_path)
    for ours, theirs in zip(again, whole[1], strict=True):
        assert ours["iteration"] == 5
        assert ours["weights"].equal(theirs["weights"])
        assert (ours["current"] == theirs["current"]).all()
    assert again[0]["weights"].equal(again[1]["weights"])
    assert not (again[0]["current"] == again[1]["current"]).all()  # each has rows of its own
    assert [row["step"] for row in CSVTable(tmp_path / "progress.csv").rows] == ["1", "2", "3", "4", "5"]


def test_another_number_of_processes_is_refused(whole, tmp_path):
    folder = shutil.copytree(whole[0], tmp_path / "copy")
    with pytest.raises(ValueError, match="number of processes is 2; here it is None"):
        Checkpoints(folder).resume(arm_learner())
    shutil.rmtree(folder / "rank1")
    for found in together(tmp_path, jobs.saved_training, folder):
        assert "of which process 1 of 2 finds no state. Go on with as many processes" in found["error"]


@pytest.mark.skipif(not hasattr(os, "sched_getaffinity"), reason="CPUs cannot be shared out here")
def test_processes_share_out_the_cpus_of_their_host(tmp_path):
    ours, theirs = together(tmp_path, jobs.cpus)
    every = os.sched_getaffinity(0)
    assert ours | theirs == every
    assert not ours & theirs or len(every) == 1


def test_rows_that_cannot_be_shared_out_are_refused():
    with pytest.raises(ValueError, match="Take a multiple, num_envs=9 say"):
        Processes(0, 3).share(8)


def test_a_batch_of_another_size_than_the_share_is_refused():
    with pytest.raises(ValueError, match=r"num_envs=processes\.share\(config\.num_envs\)"):
        arm_learner(4, env=arm_env(4), processes=Processes(0, 2))


def test_standardising_each_minibatch_in_each_process_is_refused():
    loss = SplitClipPPOLoss(actor(3, 2), critic(3), normalize_advantage=True)
    with pytest.raises(ValueError, match=r"training\.standardized"):
        SplitOptimizationStepper(loss, average=ALONE.average_)


@pytest.mark.parametrize(("count", "joined", "left"), [(2, True, 1), (2, False, 0), (1, True, 0)])
def test_connections_are_closed_where_there_are_some(count, joined, left, monkeypatch):
    closed = []
    monkeypatch.setattr(torch.distributed, "is_initialized", lambda: joined)
    monkeypatch.setattr(torch.distributed, "destroy_process_group", lambda: closed.append(count))
    Processes(0, count).leave()
    assert len(closed) == left


def test_without_torchrun_there_is_one_process():
    assert join_processes() == ALONE
    assert ALONE.seed(7) == 7


def test_seeds_differ_between_processes_and_between_trainings():
    first, second = Processes(0, 2), Processes(1, 2)
    seeds = [process.seed(seed) for process in (first, second) for seed in (7, 8)]
    assert len(set(seeds)) == 4
    assert seeds[:2] == [7, 8]
    assert len({Processes(rank, 4).seed(7) for rank in range(4)}) == 4


@pytest.fixture
def told(monkeypatch):
    """The sixth of eight processes, the second of four on its host, and what it asks for."""
    asked = []
    for name, number in {"RANK": 5, "WORLD_SIZE": 8, "LOCAL_RANK": 1, "LOCAL_WORLD_SIZE": 4}.items():
        monkeypatch.setenv(name, str(number))
    monkeypatch.setattr(module, "_keep_to_share_of_cpus", lambda *share: asked.append(share))
    monkeypatch.setattr(torch.cuda, "set_device", asked.append)
    monkeypatch.setattr(torch.distributed, "is_initialized", lambda: False)
    monkeypatch.setattr(torch.distributed, "init_process_group", lambda kind, **where: asked.append((kind, where)))
    return asked


def test_a_process_takes_its_place_among_all_and_its_share_of_its_host(told, monkeypatch):
    assert join_processes("cpu") == Processes(5, 8, "cpu")
    assert told == [(1, 4), ("gloo", {})]
    monkeypatch.setattr(torch.distributed, "is_initialized", lambda: True)
    told.clear()
    assert join_processes("cpu") == Processes(5, 8, "cpu")
    assert told == [(1, 4)]  # connected before


def test_a_process_takes_the_gpu_of_its_number_on_the_host(told, monkeypatch):
    monkeypatch.setattr(torch.cuda, "device_count", lambda: 2)
    assert join_processes("cuda") == Processes(5, 8, "cuda:1")
    assert told == ["cuda:1", ("cpu:gloo,cuda:nccl", {"device_id": torch.device("cuda:1")})]
    monkeypatch.setattr(torch.cuda, "device_count", lambda: 1)
    with pytest.raises(RuntimeError, match="process 1 of this host finds 1 GPUs"):
        join_processes("cuda")


@pytest.mark.parametrize(("count", "shares"), [(2, [{3, 5}, {6, 7, 9}]), (6, [{3, 5, 6, 7, 9}, {3}, {5}])])
def test_each_cpu_is_someones_and_who_would_have_none_may_use_all(count, shares, monkeypatch):
    given = []
    monkeypatch.setattr(os, "sched_getaffinity", lambda which: {9, 7, 3, 5, 6}, raising=False)
    monkeypatch.setattr(os, "sched_setaffinity", lambda which, cpus: given.append(set(cpus)), raising=False)
    for number in range(count):
        module._keep_to_share_of_cpus(number, count)
    assert given[: len(shares)] == shares
    assert set().union(*given) == {3, 5, 6, 7, 9}


@pytest.mark.parametrize(("seeds", "alike"), [([1, 2, 3], False), ([1, 2, 1], True), ([4, 4, 4], True)])
def test_two_of_many_that_would_explore_alike_are_found(seeds, alike):
    processes = type("Seeded", (Processes,), {"gather": lambda self, value: seeds})(0, 3)
    with pytest.raises(ValueError, match="two alike") if alike else nullcontext():
        check_seeds_differ(processes)


SCRIPT = """
import torch
from training.tasks import arm_env, arm_learner
from torchrl_athletic.training import iterate, join_processes

processes = join_processes()
learner = arm_learner(processes=processes)
iterate(learner)
print("norm", float(sum(p.square().sum() for p in learner.actor.parameters())))
learner.close()
"""


@pytest.mark.slow
def test_torchrun_starts_them(tmp_path):
    script = tmp_path / "recipe.py"
    script.write_text(SCRIPT)
    path = os.pathsep.join([str(Path(__file__).parents[1]), os.environ.get("PYTHONPATH", "")])
    command = [sys.executable, "-m", "torch.distributed.run", "--standalone", "--nproc-per-node", "2", str(script)]
    run = subprocess.run(command, env=os.environ | {"PYTHONPATH": path}, capture_output=True, text=True, check=True)
    norms = [line for line in run.stdout.splitlines() if line.startswith("norm")]
    assert len(norms) == 2
    assert norms[0] == norms[1]


def test_what_nobody_gives_weight_to_is_nothing_and_no_nan(monkeypatch):
    monkeypatch.setattr(torch.distributed, "all_reduce", lambda flat: None)
    found = torch.tensor([torch.nan, 2.0])
    Processes(0, 2).average_([found], weight=torch.tensor(0.0))
    assert found.tolist() == [0.0, 0.0]


def test_each_process_has_the_rows_behind_those_of_the_ones_before():
    firsts = [Processes(rank, 3).first_row(12) for rank in range(3)]
    assert firsts == [0, 4, 8]


def test_one_process_alone_stops_at_a_nan_too():
    with pytest.raises(NonFiniteError, match="reward"):
        check_finite_everywhere(TensorDict(reward=torch.tensor([[1.0], [torch.nan]]), batch_size=[2]), ALONE)
