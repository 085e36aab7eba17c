"""A task's own end of an episode."""

from types import SimpleNamespace

import pytest
import torch
from tensordict import TensorDict
from torchrl.envs import TransformedEnv

from torchrl_athletic.testing import ToyEnv, TransformContract
from torchrl_athletic.transforms import EarlyTermination


class IsFast:
    """A condition that can be copied to a worker."""

    def __init__(self, key):
        self.key = key

    def __call__(self, tensordict, next_tensordict):
        return tensordict[self.key][..., :1] > 1.5


class TestContract(TransformContract):
    def make_transform(self, key=str, first_row=0):
        return EarlyTermination(IsFast(key("joint_velocity")))


def test_it_ends_the_rows_that_it_says_as_failed_and_leaves_ends_that_others_found():
    second = EarlyTermination(lambda before, after: torch.tensor([[False], [True], [False]]))
    plain, ended = ToyEnv(3, shortest=2), TransformedEnv(ToyEnv(3, shortest=2), second)
    action = torch.zeros(3, 3)
    before, after = (env.reset().set("action", action) for env in (plain, ended))
    for _ in range(2):
        one, other = plain.step(before.clone())["next"], ended.step(after.clone())["next"]
        expected = one["terminated"] | torch.tensor([[False], [True], [False]])
        assert other["terminated"].equal(expected)
        assert other["done"].equal(one["done"] | expected)
        assert other["truncated"].equal(one["truncated"])
        before, after = one.set("action", action), other.set("action", action)


def test_the_condition_sees_what_the_step_started_from():
    seen = []

    def condition(before, after):
        seen.append((before["joint_position"].clone(), after["joint_position"].clone()))
        return torch.zeros(1, 1, dtype=torch.bool)

    steps = TransformedEnv(ToyEnv(1, shortest=9), EarlyTermination(condition)).rollout(2)
    for time, (before, after) in enumerate(seen[-2:]):
        assert before.equal(steps["joint_position"][:, time])
        assert after.equal(steps["next", "joint_position"][:, time])


def test_flags_may_be_named():
    end = EarlyTermination(lambda before, after: before["here"], ["truncated"])
    before, no = TensorDict(here=torch.tensor([[True], [False]]), batch_size=[2]), torch.zeros(2, 1, dtype=torch.bool)
    after = TensorDict({key: no.clone() for key in ("done", "terminated", "truncated")}, [2])
    end._step(before, after)
    assert after["truncated"].flatten().tolist() == [True, False]
    assert not (after["done"] | after["terminated"]).any()


def test_flags_within_a_group_are_raised_where_they_tell_of_an_end_or_a_failure():
    class Within(EarlyTermination):
        parent = SimpleNamespace(done_keys=[("done", name) for name in ("done", "terminated", "truncated")])

    no = torch.zeros(2, 1, dtype=torch.bool)
    after = TensorDict({"done": {name: no.clone() for name in ("done", "terminated", "truncated")}}, [2])
    Within(lambda before, after: torch.tensor([[True], [False]]))._step(after, after)
    raised = [after["done", name].flatten().tolist() for name in ("done", "terminated", "truncated")]
    assert raised == [[True, False], [True, False], [False, False]]


def test_a_condition_without_a_last_dimension_would_end_others_and_is_refused():
    ended = TransformedEnv(ToyEnv(3), EarlyTermination(lambda before, after: torch.tensor([False, True, False])))
    with pytest.raises(ValueError, match=r"shape \(3,\) and 'done' has \(3, 1\)"):
        ended.rollout(2)
