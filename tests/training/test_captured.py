"""Without a GPU a captured rollout is a rollout; compiled transforms do what plain ones do."""

from types import SimpleNamespace

import pytest
import torch
from torchrl.envs import Compose, GymEnv, StepCounter, TransformedEnv
from torchrl.envs.utils import ExplorationType, exploration_type

from torchrl_athletic.envs import TorqueEnv, actuation_chain, ball_throw_env, dumbbell_snatch_env, sled_pull_env
from torchrl_athletic.robots import z1
from torchrl_athletic.training import Rollout, control_step
from torchrl_athletic.training import captured as module
from torchrl_athletic.training.captured import CapturedRollout, fuse_transforms
from torchrl_athletic.transforms import Decimation, ObservationHistory, stateful

ARM = z1()
POSE = torch.tensor(ARM.default_pose)


def make_env(num_envs=3):
    return TransformedEnv(
        TorqueEnv(ARM, num_envs=num_envs),
        Compose(
            *actuation_chain(ARM, arm_power=50.0, max_delay=3, seed=1),
            StepCounter(4),
            ObservationHistory(["joint_position"], 3),
        ),
    )


def swing(tensordict):
    return tensordict.set("action", POSE + 0.3 * torch.sin(tensordict["step_count"].float() + 1))


def test_on_the_cpu_it_collects_what_a_rollout_collects():
    captured, plain = CapturedRollout(make_env(), swing, 6)(), Rollout(make_env(), swing, 6)()
    assert set(captured.keys(True, True)) == set(plain.keys(True, True))
    assert all((captured[key] == plain[key]).all() for key in plain.keys(True, True))


def test_an_environment_without_physics_of_ours_is_refused():
    with pytest.raises(ValueError, match="Collect with Rollout"):
        CapturedRollout(GymEnv("Pendulum-v1"), swing, 3)


@pytest.mark.slow
def test_compiled_transforms_lead_to_the_same_steps_and_resets():
    compiled, plain = make_env(), make_env()
    fuse_transforms(compiled, backend="aot_eager")
    ours, theirs = compiled.reset(), plain.reset()
    assert (ours["action_delay"] == theirs["action_delay"]).all()
    for _ in range(9):
        (step, ours), (other, theirs) = control_step(compiled, swing, ours), control_step(plain, swing, theirs)
        for key in other["next"].keys(True, True):
            torch.testing.assert_close(
                step["next", key] if isinstance(key, str) else step["next"][key], other["next"][key]
            )
    assert ours["step_count"].unique().tolist() == [1]


def arm_env(num_envs, staggered):
    return make_env(num_envs)


@pytest.mark.parametrize(
    "task",
    [
        arm_env,
        pytest.param(sled_pull_env, marks=pytest.mark.slow),
        pytest.param(ball_throw_env, marks=pytest.mark.slow),
        pytest.param(dumbbell_snatch_env, marks=pytest.mark.slow),
    ],
)
def test_what_a_gpu_records_of_a_task_is_traced_whole_and_makes_no_specs(task, monkeypatch):
    """Specs made while a graph is recorded copy to the device, which it cannot hold; a break compiles for minutes."""
    env = task(num_envs=2, staggered=True)
    still = torch.zeros(env.action_spec.shape)
    torch._dynamo.reset()
    fuse_transforms(env, backend="eager")
    shown = env.reset()

    def refuse(*arguments):
        raise AssertionError("a spec is made in a step")

    monkeypatch.setattr(stateful, "_in_order", refuse)
    for _ in range(3):
        _, shown = control_step(env, lambda step: step.set("action", still.clone()), shown)
    assert not torch._dynamo.utils.counters["graph_break"]
    assert torch._dynamo.utils.counters["stats"]["unique_graphs"] > 5


def test_what_was_recorded_collects_what_a_rollout_collects_and_goes_on_where_a_state_was_taken():
    """Recorded as on a GPU, a few steps that never were first, by physics that hands back what it was given."""
    recordings = []

    def capture(step):
        recordings.append(step)
        step()
        step()
        return step

    recorded = CapturedRollout(make_env(), swing, 3, fuse=False)
    recorded.physics = SimpleNamespace(device=SimpleNamespace(type="cuda"), capture=capture)
    plain = Rollout(make_env(), swing, 3)
    for _ in range(2):
        ours, theirs = recorded().clone(), plain()
        for key in theirs.keys(True, True):
            assert (ours[key] == theirs[key]).all(), key
    memory, state = recorded.current, recorded.state_dict()
    third = recorded().clone()
    assert (third["step_count"] != ours["step_count"]).any()
    recorded.load_state_dict(state)
    assert recorded.current is memory  # what was recorded reads and writes no other
    again = recorded()
    for key in third.keys(True, True):
        assert (again[key] == third[key]).all(), key
    assert len(recordings) == 1


class Noting:
    """A transform that notes its name in what it changes."""

    def __init__(self, name):
        self.name = name

    def _step(self, before, changed):
        return (*changed, before + self.name)

    def _reset(self, changed):
        return (*changed, self.name)


class Writing(Noting):
    """To the physics."""


def test_neighbours_are_compiled_as_one_and_what_writes_to_the_physics_not_at_all(monkeypatch):
    monkeypatch.setattr(module, "_NOT_COMPILED", (Writing,))
    compiled = []
    row = [Noting("a"), Noting("b"), Writing("c"), Writing("d"), Noting("e")]
    run = module._in_groups(row, "_step", lambda group: compiled.append(group) or group)
    assert run("-", ()) == ("-a", "-b", "-c", "-d", "-e")
    assert [group("-", ()) for group in compiled] == [("-a", "-b"), ("-e",)]
    monkeypatch.setattr(module, "StepCounter", Noting)
    for method, count in (("_step", 1), ("_reset", 0)):  # its reset looks up specs
        compiled.clear()
        module._in_groups(row[:2], method, lambda group: compiled.append(group) or group)
        assert len(compiled) == count


def test_a_decimation_is_found_however_deep_it_stands():
    inner = Compose(StepCounter(4), Compose(Decimation(2)))
    found = module._place_of_decimation(Compose(StepCounter(3), inner))
    assert found[0] is inner
    assert isinstance(found[-1], Decimation)
    assert len(found) == 3
    assert module._place_of_decimation(Compose(StepCounter(3))) is None


def test_in_groups_an_environment_does_what_it_did_before(monkeypatch):
    """Nothing is compiled here: the order of transforms and the state that episodes go on from are what is asked."""
    monkeypatch.setattr(torch, "compile", lambda run, **told: run)
    grouped, plain = make_env(), make_env()
    ours, theirs = grouped.reset(), plain.reset()
    _, ours = control_step(grouped, swing, ours)
    _, theirs = control_step(plain, swing, theirs)
    fuse_transforms(grouped)
    for _ in range(6):
        (step, ours), (other, theirs) = control_step(grouped, swing, ours), control_step(plain, swing, theirs)
        for key in other.keys(True, True):
            assert step[key].equal(other[key]), key
    assert ours["step_count"].unique().tolist() == [3]


def test_without_a_decimation_all_stays_as_it_is():
    env = TransformedEnv(TorqueEnv(ARM, num_envs=1), Compose(StepCounter(4)))
    step = env.transform._step
    fuse_transforms(env)
    assert env.transform._step == step
    assert env.reset()["step_count"].item() == 0


@pytest.mark.parametrize("on_gpu", [False, True])
def test_no_more_is_stored_than_is_asked_for_and_the_policy_explores(on_gpu):
    """A batch of one step too, though a few are taken before that one is recorded."""
    seen = []

    def explore(tensordict):
        seen.append(exploration_type())
        return swing(tensordict)

    def capture(step):
        for _ in range(3):
            step()
        return step

    rollout = CapturedRollout(make_env(), explore, 1, keys=["joint_velocity"], fuse=False)
    if on_gpu:
        rollout.physics = SimpleNamespace(device=SimpleNamespace(type="cuda"), capture=capture)
    batch = rollout()
    assert batch["joint_velocity"].shape == (3, 1, 7)
    assert "joint_position" not in batch.keys()
    assert set(seen) == {ExplorationType.RANDOM}
