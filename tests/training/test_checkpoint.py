import multiprocessing
import os
import signal
from copy import deepcopy

import pytest
import torch
from tensordict import TensorDict
from torchrl.envs import Compose, StepCounter, TransformedEnv
from torchrl.testing.mocking_classes import CountingEnv
from training.tasks import arm_env, arm_learner

from torchrl_athletic.envs import TorqueEnv
from torchrl_athletic.robots import z1
from torchrl_athletic.training import Checkpoints, CSVTable, Processes, train
from torchrl_athletic.training.checkpoint import env_state, restore_env
from torchrl_athletic.transforms import DomainRandomization, ExternalPush, Push, RandomizationRanges

FORKS = multiprocessing.get_context("fork")  # another interpreter would import all libraries again


def state_of(learner):
    return [*learner.actor.state_dict().values(), *learner.critic.state_dict().values(), learner.stepper.actor_lr]


def assert_same(ours, theirs):
    for one, other in zip(state_of(ours), state_of(theirs), strict=True):
        torch.testing.assert_close(one, other, rtol=0, atol=0)


def test_a_run_in_two_parts_is_the_run_in_one(tmp_path):
    """To the last bit: weights, optimisers, learning rate, random numbers, physics, delays, where episodes stand."""
    whole, first, second = (arm_learner() for _ in range(3))
    torch.manual_seed(3)
    train(whole, iterations=5, progress=False)
    torch.manual_seed(3)
    train(first, iterations=3, checkpoints=Checkpoints(tmp_path), progress=False)
    torch.manual_seed(99)  # a new process knows nothing
    train(second, iterations=5, checkpoints=Checkpoints(tmp_path), progress=False)
    assert_same(whole, second)
    assert (whole.rollout.current == second.rollout.current).all()
    assert (whole.iteration, whole.samples) == (second.iteration, second.samples)
    with pytest.raises(AssertionError):  # so that training changes what is compared
        assert_same(whole, first)


def killed_in_its_third_iteration(folder):
    learner = arm_learner()

    def evaluate():
        if learner.iteration == 3:
            os.kill(os.getpid(), signal.SIGKILL)
        return {}

    train(learner, iterations=5, evaluate=evaluate, evaluate_every=1, checkpoints=Checkpoints(folder),
          checkpoint_every=2, logger=CSVTable(folder / "progress.csv"), progress=False)  # fmt: skip


def test_a_killed_process_is_gone_on_with_and_its_log_has_each_step_once(tmp_path):
    killed = FORKS.Process(target=killed_in_its_third_iteration, args=(tmp_path,))
    killed.start()
    killed.join(60)
    assert killed.exitcode == -signal.SIGKILL
    table, resumed = CSVTable(tmp_path / "progress.csv"), arm_learner()
    train(resumed, iterations=5, checkpoints=Checkpoints(tmp_path), logger=table, progress=False)
    assert [row["step"] for row in CSVTable(table.path).rows] == ["1", "2", "3", "4", "5"]
    torch.manual_seed(0)
    whole = arm_learner()
    train(whole, iterations=5, progress=False)
    assert_same(whole, resumed)


def test_a_log_of_a_run_that_was_killed_before_its_first_state_begins_anew(tmp_path):
    table = CSVTable(tmp_path / "progress.csv")
    table.log_metrics({"reward": 9.0}, step=1)
    table.log_metrics({"reward": 9.0}, step=2)
    train(arm_learner(), iterations=2, checkpoints=Checkpoints(tmp_path), logger=table, progress=False)
    rows = CSVTable(table.path).rows
    assert [row["step"] for row in rows] == ["1", "2"]
    assert all(float(row["reward"]) < 0 for row in rows)


def test_what_was_being_written_when_the_process_died_is_passed_over(tmp_path):
    learner, checkpoints = arm_learner(), Checkpoints(tmp_path)
    learner.iteration = 4
    checkpoints.save(learner)
    (tmp_path / ".checkpoint-000000000005.stage-abc").mkdir()
    learner.iteration = 0
    assert checkpoints.resume(learner)
    assert learner.iteration == 4


def test_only_the_newest_stay(tmp_path):
    learner, checkpoints = arm_learner(), Checkpoints(tmp_path, keep=2)
    for learner.iteration in range(4):
        checkpoints.save(learner)
    assert sorted(path.name[-1] for path in tmp_path.iterdir()) == ["2", "3"]


class OneOfTwo(Processes):
    """The other one does alike."""

    def gather(self, value):
        return [value] * 2


def test_a_process_that_writes_first_keeps_one_state_more(tmp_path):
    """If the first process dies before it writes, all go on from the one before, and no older one is of use."""
    net = torch.nn.Linear(2, 1)
    for net.processes in (OneOfTwo(0, 2), OneOfTwo(1, 2)):
        for net.iteration in range(5):
            Checkpoints(tmp_path, keep=2).save(net)
    left = sorted(path.relative_to(tmp_path).as_posix() for path in tmp_path.rglob("checkpoint-*"))
    name = "checkpoint-00000000000"
    assert left == [f"{name}3", f"{name}4", *(f"rank1/{name}{k}" for k in (2, 3, 4))]


@pytest.mark.parametrize(("then", "now"), [({}, {"seed": 1}), ({"seed": 1}, {}), ({"seed": 2}, {"seed": 1})])
def test_a_run_of_something_else_is_not_gone_on_with_and_takes_nothing_over(then, now, tmp_path):
    saved, other = torch.nn.Linear(2, 1), torch.nn.Linear(2, 1)
    saved.iteration = 3
    Checkpoints(tmp_path, made_of={"task": "throw", **then}).save(saved)
    before = other.weight.clone()
    told = rf"run whose seed is {then.get('seed')}; here it is {now.get('seed')}\."
    with pytest.raises(ValueError, match=told):
        Checkpoints(tmp_path, made_of={"task": "throw", **now}).resume(other)
    assert other.weight.equal(before)
    assert Checkpoints(tmp_path, made_of={"task": "throw", **then}).resume(other)
    assert other.weight.equal(saved.weight)


def test_what_lies_beside_a_learner_is_as_it_was(tmp_path):
    net = torch.nn.Linear(2, 1)
    net.iteration, scale, again = 1, torch.nn.Linear(3, 3), torch.nn.Linear(3, 3)
    Checkpoints(tmp_path, beside={"scale": scale}).save(net)
    assert Checkpoints(tmp_path, beside={"scale": again}).resume(torch.nn.Linear(2, 1))
    assert again.weight.equal(scale.weight)


@pytest.mark.parametrize(
    ("iteration_takes", "kept"), [(4.0, [3, 6, 7]), (5.0, [2, 4, 6, 7]), (12.0, [1, 2, 3, 4, 5, 6, 7]), (1.0, [7])]
)
def test_slow_iterations_are_saved_by_the_clock(iteration_takes, kept, tmp_path, monkeypatch):
    """Every ten seconds, whatever the number of iterations, so that a kill loses no more than that and an iteration."""
    now, learner = [100.0], arm_learner()
    monkeypatch.setattr("torchrl_athletic.training.ppo.time.perf_counter", lambda: now[0])

    def step(learner):
        learner.iteration += 1
        now[0] += iteration_takes
        return TensorDict({"reward": torch.zeros(())})

    checkpoints = Checkpoints(tmp_path, keep=9)
    train(learner, iterations=7, checkpoints=checkpoints, checkpoint_seconds=10.0, progress=False, step=step)
    assert sorted(int(path.name.rpartition("-")[2]) for path in tmp_path.iterdir()) == kept


def test_with_another_number_of_environments_new_episodes_start(tmp_path):
    large, small = arm_learner(num_envs=4), arm_learner(num_envs=2, seed=1)
    train(large, iterations=1, checkpoints=Checkpoints(tmp_path), progress=False)
    train(small, iterations=2, checkpoints=Checkpoints(tmp_path), progress=False)
    assert small.iteration == 2
    assert small.rollout.current.batch_size == (2,)


def test_the_physics_goes_on_where_it_stood():
    env, twin = arm_env(episode=50), arm_env(episode=50)
    shown = env.rollout(4, break_when_any_done=False)[:, -1]["next"].exclude("reward")
    current = restore_env(twin, shown.clone(), env_state(env))
    for name in ("qpos", "qvel", "time", "qacc_warmstart"):  # the solver starts from the last, too
        ours, theirs = (each.base_env.physics.data(name) for each in (twin, env))
        assert torch.equal(ours, theirs), name
        assert theirs.any(), name
    action = torch.ones(4, 7)
    for _ in range(3):
        shown = env._step(shown.set("action", action)).exclude("reward")
        current = twin._step(current.set("action", action)).exclude("reward")
    torch.testing.assert_close(current["joint_position"], shown["joint_position"], rtol=0, atol=0)


def test_a_robot_of_another_mass_that_is_being_pushed_goes_on_as_it_was():
    """In an environment of other robots that are pushed at other times."""
    ranges = RandomizationRanges(friction=None, restitution=None)

    def make(seed):
        drawn = DomainRandomization(ranges, joints="arm", seed=seed)
        times = {"dt": 0.005, "rest": (0.0, 0.02), "duration": (0.02, 0.06)}
        push = ExternalPush([Push(("link03",), force=(20.0, 40.0))], seed=seed, **times)
        return TransformedEnv(TorqueEnv(z1(), num_envs=4, fields=drawn.fields), Compose(drawn, push))

    env, twin = make(0), make(1)
    shown, other = (each.rollout(7, break_when_any_done=False)["next"][:, -1].exclude("reward") for each in (env, twin))
    assert shown["push_on"].any()
    assert (other["push"] != shown["push"]).any()
    state = env_state(env)
    stood = deepcopy(state)
    restore_env(twin, shown.clone(), {**state, "wrenches": {}})
    assert not any(wrench.any() for wrench in twin.base_env.wrenches.values())
    restore_env(fresh := make(1), shown.clone(), state)  # where no episode has begun yet
    for name, value in env_state(fresh)["buffers"].items():
        assert value.equal(state["buffers"][name]), name
    current = restore_env(twin, shown.clone(), state)
    assert torch.equal(twin.base_env.physics.xfrc_applied, env.base_env.physics.xfrc_applied)
    began = shown["push_on"].clone()
    for _ in range(20):
        shown = env._step(shown.set("torque", torch.zeros(4, 7))).exclude("reward")
        current = twin._step(current.set("torque", torch.zeros(4, 7))).exclude("reward")
        for key in ("joint_position", "push", "randomization"):
            torch.testing.assert_close(current[key], shown[key], rtol=0, atol=0)
    assert (shown["push_on"] != began).any()
    env.reset()
    for each in (env, twin):  # what was taken is a copy: it does not go on with the episode
        each.base_env.physics.set_fields({name: value + 1 for name, value in state["fields"].items()})
    for part, values in stood.items():
        assert values, part
        for name, value in values.items():
            assert value.equal(state[part][name]), name


def test_an_environment_of_another_library_starts_new_episodes():
    env = TransformedEnv(CountingEnv(max_steps=9, batch_size=[2]), StepCounter())
    seen = env.rollout(3, break_when_any_done=False)[:, -1]["next"]
    assert restore_env(env, seen, env_state(env))["step_count"].sum() == 0


class RunOfItsOwn:
    """A logger as wandb's is: every process starts a run of its own, which refuses the state of another."""

    def state_dict(self):
        return {"run": id(self)}

    def load_state_dict(self, state):
        raise ValueError("this is another run")


def test_a_run_goes_on_although_its_logger_starts_a_new_one(tmp_path):
    saved = torch.nn.Linear(2, 1)
    saved.iteration = 3
    Checkpoints(tmp_path).save(saved, RunOfItsOwn())
    resumed = torch.nn.Linear(2, 1)
    assert Checkpoints(tmp_path).resume(resumed, RunOfItsOwn())
    assert (resumed.weight == saved.weight).all()


def test_a_state_from_before_the_first_iteration_is_a_state(tmp_path):
    saved, again = torch.nn.Linear(2, 1), torch.nn.Linear(2, 1)
    saved.iteration = 0
    Checkpoints(tmp_path).save(saved)
    assert Checkpoints(tmp_path).resume(again)
    assert again.weight.equal(saved.weight)
