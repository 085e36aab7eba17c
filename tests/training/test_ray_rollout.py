import os
import sys
from contextlib import nullcontext
from pathlib import Path
from types import SimpleNamespace

import pytest
import torch
from torchrl.envs import StepCounter, TransformedEnv
from torchrl.envs.utils import ExplorationType
from training.tasks import SEEN, Repeat, arm_env, repeat_learner

from torchrl_athletic.networks import RunningNormalizer, actor
from torchrl_athletic.training import PPO, Learner, RayRollout, Rollout, iterate, rows_of_a_worker
from torchrl_athletic.training.ray_rollout import _made

WORKERS, ROWS, HORIZON = 2, 16, 8


def repeat_env(rows, first_row):
    return TransformedEnv(Repeat(rows), StepCounter(4))


def arm_rows(rows, first_row):
    return arm_env(rows, first_row=first_row)


def joined(make_env, rows, policy, seeds, horizon, keys, change, count=2):
    """What plain rollouts with the workers' seeds collect, each alone, with the policy changed in between."""
    parts = []
    for worker, seed in enumerate(seeds):
        torch.manual_seed(seed)
        rollout = Rollout(make_env(rows, worker * rows), policy, horizon, keys=keys)
        before = {name: value.clone() for name, value in policy.state_dict().items()}
        batches = []
        for _ in range(count):
            batches.append(rollout().clone())
            change(policy)
        policy.load_state_dict(before)
        parts.append(batches)
    return [torch.cat(batches) for batches in zip(*parts, strict=True)]


def assert_same(ours, theirs):
    keys = set(theirs.keys(True, True))
    assert set(ours.keys(True, True)) == keys
    assert (ours.batch_size, ours.names, ours.device) == (theirs.batch_size, theirs.names, theirs.device)
    for key in keys:
        assert ours[key].dtype == theirs[key].dtype
        torch.testing.assert_close(ours[key], theirs[key], rtol=0, atol=0)


@torch.no_grad()
def bigger(policy):
    for parameter in policy.parameters():
        parameter.mul_(1.5)


@pytest.fixture(scope="module")
def importable():
    """The tests' folder, in Ray's processes too."""
    pytest.importorskip("ray")
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("PYTHONPATH", os.pathsep.join([str(Path(__file__).parents[1]), os.environ.get("PYTHONPATH", "")]))
        yield


@pytest.fixture(scope="module")
def seen(importable):
    """Two batches, those of plain rollouts, then a training with the same workers, and what is left of Ray."""
    import ray

    theirs = repeat_learner(WORKERS * ROWS)
    policy, critic = theirs.actor, theirs.critic
    start = {name: value.clone() for name, value in policy.state_dict().items()}
    with RayRollout(repeat_env, policy, HORIZON, workers=WORKERS, rows=ROWS, keys=["observation"], seed=3) as rollout:
        seeds = [rollout._seed(worker) for worker in range(WORKERS)]
        first = rollout()
        where, first = first["observation"].data_ptr(), first.clone()
        bigger(policy)
        second = rollout()
        again, second = second["observation"].data_ptr(), second.clone()
        policy.load_state_dict(start)
        wanted = joined(repeat_env, ROWS, policy, seeds, HORIZON, ["observation"], bigger)
        ours = Learner(rollout.env, policy, critic, theirs.config, rollout=rollout)
        rewards = torch.stack([iterate(ours)["reward"] for _ in range(12)])
        state = ours.state_dict()["rollout"]
    alone = repeat_learner(WORKERS * ROWS)
    return SimpleNamespace(
        batches=(first, second),
        wanted=wanted,
        places=(where, again),
        rewards=rewards,
        alone=torch.stack([iterate(alone)["reward"] for _ in range(12)]),
        samples=ours.samples,
        state=state,
        ray_is_up=ray.is_initialized(),
    )


def test_batches_are_those_of_plain_rollouts_side_by_side(seen):
    """Entry by entry, in the order of workers; the second one by the policy as it was then."""
    for ours, theirs in zip(seen.batches, seen.wanted, strict=True):
        assert_same(ours, theirs)
    assert seen.batches[0].batch_size == (WORKERS * ROWS, HORIZON)
    assert not seen.batches[0]["action"][:ROWS].equal(seen.batches[0]["action"][ROWS:])
    assert "step_count" not in seen.batches[0].keys()


def test_the_next_call_overwrites_the_batch(seen):
    assert seen.places[0] == seen.places[1]


def test_training_goes_as_with_rows_of_ones_own(seen):
    late = slice(-5, None)
    assert seen.rewards[late].mean() / seen.alone[late].mean() == pytest.approx(1.0, abs=0.4)
    assert seen.rewards[late].mean() > seen.rewards[0] / 2
    assert seen.samples == 12 * WORKERS * ROWS * HORIZON


def test_a_state_is_how_many_batches_there_were(seen):
    assert seen.state == {"batches": 14}


def test_nothing_of_ray_is_left_once_closed(seen):
    assert not seen.ray_is_up


@pytest.mark.slow
def test_physics_travels_and_a_run_goes_on_with_new_episodes(importable):
    """Random transforms draw by the numbers of their rows; the normaliser is sent with the weights."""
    torch.manual_seed(0)
    normalizer = RunningNormalizer(7)
    policy = actor(7, 7, in_keys=SEEN, hidden=(8,), normalizer=normalizer)

    def learn(_):
        normalizer.update(torch.linspace(-1, 2, 14).view(2, 7))

    rollout = RayRollout(arm_rows, policy, 6, workers=2, rows=2, keys=["action_delay"], seed=1)
    seeds = [rollout._seed(worker) for worker in range(2)]
    wanted = joined(arm_rows, 2, policy, seeds, 6, ["action_delay"], learn)
    assert wanted[0]["action_delay"].unique().numel() > 1
    before = {name: value.clone() for name, value in policy.state_dict().items()}
    for theirs in wanted:
        assert_same(rollout(), theirs)
        learn(policy)
    policy.load_state_dict(before)
    rollout.load_state_dict({"batches": 5})
    seeds = [rollout._seed(worker) for worker in range(2)]
    assert_same(rollout(), joined(arm_rows, 2, policy, seeds, 6, ["action_delay"], learn, count=1)[0])
    rollout.close()


@pytest.fixture
def idle(monkeypatch):
    """Nothing is started before the first call."""
    monkeypatch.setattr("torchrl_athletic.training.ray_rollout.find_spec", lambda name: object())
    return RayRollout(repeat_env, repeat_learner(ROWS).actor, HORIZON, workers=3, rows=ROWS)


def test_workers_explore_differently_and_anew_after_a_resumption(idle):
    seeds = [idle._seed(worker) for worker in range(3)]
    idle.load_state_dict({"batches": 4})
    assert len({*seeds, *(idle._seed(worker) for worker in range(3))}) == 6
    assert idle.state_dict() == {"batches": 4}


def test_more_workers_than_cpus_are_refused_before_ray_waits_for_ever(idle):
    with pytest.raises(ValueError, match=r"3 workers but 2 CPUs.*Take workers=2"):
        idle._check_resources({"CPU": 2.0})


def test_the_learner_counts_the_rows_of_all_workers(idle):
    nets = repeat_learner(ROWS)
    with pytest.raises(ValueError, match=f"has {3 * ROWS} rows"):
        Learner(idle.env, nets.actor, nets.critic, PPO(num_envs=ROWS), rollout=idle)
    Learner(idle.env, nets.actor, nets.critic, PPO(num_envs=3 * ROWS), rollout=idle)


def test_a_worker_of_another_number_of_rows_is_refused_and_the_learner_makes_one_row(idle):
    assert (idle.env.numel(), idle.num_envs) == (1, 3 * ROWS)
    with pytest.raises(ValueError, match=r"make_env\(2, 2\) has 3 rows.*Make an environment of 2"):
        _made(lambda rows, first_row: Repeat(3), 2, 1, seed=0)


def test_each_worker_makes_its_own_rows_of_the_whole_batch():
    asked = []
    for worker in range(3):
        _made(lambda rows, first_row: asked.append((rows, first_row)) or Repeat(rows), ROWS, worker, seed=0)
    assert asked == [(ROWS, 0), (ROWS, ROWS), (ROWS, 2 * ROWS)]


@pytest.mark.skipif(not hasattr(os, "sched_getaffinity"), reason="CPUs cannot be shared out here")
def test_a_workers_physics_starts_one_thread(every_cpu):
    before = os.sched_getaffinity(0)
    assert _made(lambda rows, first_row: arm_env(rows), 8, 1, seed=0).base_env.physics.batch.nthread == 1
    assert os.sched_getaffinity(0) == before


def test_a_worker_takes_the_first_of_the_cpus_that_it_may_use_and_gives_the_others_back(monkeypatch):
    given = []
    monkeypatch.setattr(os, "sched_getaffinity", lambda process: {5, 3} if process == 0 else {0, 1}, raising=False)
    monkeypatch.setattr(
        os, "sched_setaffinity", lambda process, cpus: given.append((process, set(cpus))), raising=False
    )
    _made(lambda rows, first_row: given.append("made") or Repeat(rows), 2, 1, seed=0)
    assert given == [(0, {3}), "made", (0, {3, 5})]


class Started:
    def __init__(self, shutdown):
        self.shutdown = shutdown

    def __iter__(self):
        return iter(())


class Workers:
    """Stand for Ray and its collector, and note what is asked of them."""

    def __init__(self, running):
        self.running, self.asked, self.shut = running, {}, []

    def is_initialized(self):
        return self.running

    def init(self, **options):
        self.asked["init"] = options

    def cluster_resources(self):
        return {"CPU": 8.0}

    def collector(self, make, policy, **options):
        self.asked |= {"make": make, "policy": policy, "options": options}
        return Started(lambda: self.shut.append("workers"))

    def shutdown(self):
        self.shut.append("ray")


def started(monkeypatch, running=False, **told):
    monkeypatch.setattr("torchrl_athletic.training.ray_rollout.find_spec", lambda name: object())
    ray = Workers(running)
    monkeypatch.setitem(sys.modules, "ray", ray)
    monkeypatch.setitem(sys.modules, "torchrl.collectors.distributed", SimpleNamespace(RayCollector=ray.collector))
    rollout = RayRollout(repeat_env, repeat_learner(ROWS).actor, HORIZON, workers=3, rows=ROWS, **told)
    rollout._start()
    return rollout, ray


def test_a_cluster_that_ray_s_own_variable_names_is_joined_unless_another_is_told(monkeypatch):
    monkeypatch.setenv("RAY_ADDRESS", "10.0.0.1:6379")
    _, ray = started(monkeypatch)
    assert ray.asked["init"] == {"address": "10.0.0.1:6379", "log_to_driver": False, "logging_level": "warning"}
    _, ray = started(monkeypatch, address="auto")
    assert ray.asked["init"]["address"] == "auto"
    monkeypatch.setenv("RAY_ADDRESS", "")
    _, ray = started(monkeypatch)
    assert ray.asked["init"]["address"] == "local"


@pytest.mark.parametrize(("num_envs", "workers", "near"), [(8, 3, "num_envs=6"), (8, 0, "num_envs=8"), (2, 3, "=3")])
def test_robots_are_dealt_out_evenly_or_the_next_fitting_number_is_named(num_envs, workers, near):
    assert rows_of_a_worker(12, 3) == 4
    with pytest.raises(ValueError, match=near):
        rows_of_a_worker(num_envs, workers)


def test_a_cluster_of_ones_own_is_as_large_as_needed_and_takes_what_else_is_told(monkeypatch):
    _, ray = started(monkeypatch, init={"log_to_driver": True, "num_cpus": 6})
    told = {"address": "local", "include_dashboard": False, "logging_level": "warning"}
    assert ray.asked["init"] == told | {"log_to_driver": True, "num_cpus": 6}
    _, ray = started(monkeypatch)
    assert ray.asked["init"] == told | {"log_to_driver": False, "num_cpus": 3}
    _, ray = started(monkeypatch, address="auto")
    assert ray.asked["init"] == {"address": "auto", "log_to_driver": False, "logging_level": "warning"}
    assert ray.asked["options"]["frames_per_batch"] == 3 * ROWS * HORIZON
    assert len(ray.asked["make"]) == 3


@pytest.mark.parametrize(("running", "shut"), [(False, ["workers", "ray"]), (True, ["workers"])])
def test_a_cluster_that_ran_before_runs_on(running, shut, monkeypatch):
    rollout, ray = started(monkeypatch, running)
    assert ("init" in ray.asked) is not running
    rollout.load_state_dict({"batches": 5})
    assert ray.shut == shut  # and the next call starts others
    rollout.close()
    assert ray.shut == shut


def test_without_ray_the_way_to_get_it_is_told(monkeypatch):
    monkeypatch.setattr("torchrl_athletic.training.ray_rollout.find_spec", lambda name: None)
    with pytest.raises(ModuleNotFoundError, match=r"pip install 'torchrl-athletic\[ray\]'"):
        RayRollout(repeat_env, repeat_learner(ROWS).actor, HORIZON, workers=2, rows=ROWS)


@pytest.mark.parametrize(
    ("options", "advice"),
    [
        ({"workers": 0, "rows": 2}, "1 or more"),
        ({"workers": 1, "rows": 0}, "rows is 0"),
        ({"workers": 1, "rows": 2}, "at least 1 step"),
    ],
)
def test_nothing_to_collect_is_refused(options, advice):
    with pytest.raises(ValueError, match=advice):
        RayRollout(repeat_env, repeat_learner(ROWS).actor, 0 if options["workers"] * options["rows"] else 1, **options)


def test_each_worker_takes_one_cpu_and_explores_by_a_copy_of_the_policy_with_a_seed_of_its_own(monkeypatch):
    monkeypatch.delenv("RAY_USAGE_STATS_ENABLED", raising=False)
    rollout, ray = started(monkeypatch, keys=["observation"], seed=4, device="meta")
    assert os.environ["RAY_USAGE_STATS_ENABLED"] == "0"
    told = ray.asked["options"]
    assert (told["sync"], told["remote_configs"]) == (True, {"num_cpus": 1, "num_gpus": 0})
    assert told["exploration_type"] is ExplorationType.RANDOM
    made = [(repeat_env, ROWS, worker, rollout._seed(worker)) for worker in range(3)]
    assert [make.args for make in ray.asked["make"]] == made
    assert ray.asked["policy"] is not rollout.policy
    assert rollout.device == "meta"
    step = repeat_env(2, 0).rollout(1)[:, 0]
    kept = told["collector_kwargs"]["postproc"](step).keys(True, True)
    assert {"observation", "action", ("next", "observation"), ("next", "reward"), ("next", "done")} <= set(kept)
    assert "step_count" not in kept
    _, ray = started(monkeypatch)
    assert ray.asked["options"]["collector_kwargs"]["postproc"] is None  # all is asked for


@pytest.mark.parametrize(("running", "shut"), [(False, ["ray"]), (True, [])])
def test_a_cluster_that_is_too_small_is_left_as_it_was_found(running, shut, monkeypatch):
    for found in (3.0, 2.0):
        monkeypatch.setattr(Workers, "cluster_resources", lambda ray, found=found: {"CPU": found})
        seen = []
        monkeypatch.setattr(Workers, "shutdown", lambda ray, seen=seen: seen.append("ray"))
        with pytest.raises(ValueError, match="3 workers but 2 CPUs") if found < 3 else nullcontext():
            started(monkeypatch, running)
    assert seen == shut
