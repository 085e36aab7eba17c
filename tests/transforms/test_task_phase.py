import pytest
import torch
from torchrl.envs import TransformedEnv

from torchrl_athletic.functional.phase import Phase, PhaseSchedule, sled_phases, snatch_phases, throw_phases
from torchrl_athletic.testing import ToyEnv, TransformContract
from torchrl_athletic.transforms import TaskPhase

SHORT = PhaseSchedule((Phase("a", 0.03, 0.6), Phase("b", 0.02, 0.6, timer=0.03, start_probability=0.3), Phase("c")))
"""A few steps of 0.01 s long, so that phases and episodes end in all orders."""


class TestContract(TransformContract):
    def make_transform(self, key=str, first_row=0):
        names = {"phase_key": "task_phase", "index_key": "index", "step_key": "age", "last_key": "last"}
        return TaskPhase(SHORT, 0.01, first_row=first_row, **{name: key(entry) for name, entry in names.items()})


class TestContractWithoutPhases(TransformContract):
    def make_transform(self, key=str, first_row=0):
        return TaskPhase(None, 0.01, width=4, phase_key=key("task_phase"), first_row=first_row)


def rollout(schedule, steps, num_envs=1, dt=0.02, **settings):
    env = TransformedEnv(ToyEnv(num_envs, shortest=10_000), TaskPhase(schedule, dt, **settings))
    return env.rollout(steps)


def test_a_sled_is_pulled_after_2_5_s():
    seen = rollout(sled_phases(), 200)["task_phase"][0]
    assert seen[:125].tolist() == [[1, 0]] * 125
    assert seen[125:].tolist() == [[0, 1]] * 75


def test_the_next_observation_shows_the_phase_that_is_on_then():
    steps = rollout(sled_phases(), 130)
    assert steps["next", "task_phase"][0, 124].tolist() == [0, 1]
    assert steps["task_phase"][0, 124].tolist() == [1, 0]


def test_the_timer_of_the_throw_counts_its_second_and_no_other():
    steps = rollout(throw_phases(stay_probability=0, settle_probability=0), 200)
    timer, phase = steps["task_phase"][0, :, 3], steps["task_phase"][0, :, :3].argmax(-1)
    assert (timer[phase != 1] == 0).all()
    torch.testing.assert_close(timer[phase == 1], torch.arange(50) / 50)


def test_a_throw_that_is_not_left_keeps_its_timer_at_one():
    steps = rollout(throw_phases(stay_probability=1, stay_in="throw", settle_probability=0), 250)
    assert steps["task_phase"][0, 175:].tolist() == [[0, 1, 0, 1]] * 75


def test_one_snatch_in_ten_stays_in_its_set_up():
    last = rollout(snatch_phases(), 127, num_envs=2000)["task_phase"][:, -1]
    assert last[:, 0].mean().item() == pytest.approx(0.1, abs=0.02)


def test_whether_a_phase_is_left_has_nothing_to_do_with_whether_the_one_before_was():
    schedule = PhaseSchedule((Phase("a", 0.02, 0.5), Phase("b", 0.02, 0.5), Phase("c")))
    env = TransformedEnv(ToyEnv(2000, shortest=10_000), TaskPhase(schedule, 0.02))
    last = env.reset()["task_phase_last"].flatten().bincount(minlength=3) / 2000
    assert last.tolist() == pytest.approx([0.5, 0.25, 0.25], abs=0.04)


def test_an_input_just_wide_enough_is_wide_enough():
    assert rollout(SHORT, 2, dt=0.01, width=4)["task_phase"].shape == (1, 2, 4)  # three phases and a timer


def test_episodes_of_one_row_start_in_phases_drawn_anew():
    env = TransformedEnv(ToyEnv(16, shortest=1), TaskPhase(throw_phases(settle_probability=0.4), 0.02))
    steps = env.rollout(100, break_when_any_done=False)
    begins = torch.cat((torch.ones(16, 1, dtype=torch.bool), steps["next", "done"][:, :-1, 0]), 1)
    rows = [steps["task_phase"][row, begins[row], 2] for row in range(16)]
    settled = torch.stack([row[:25] for row in rows])
    assert settled.shape == (16, 25)
    assert settled.mean().item() == pytest.approx(0.4, abs=0.05)
    assert ((settled.mean(1) > 0.1) & (settled.mean(1) < 0.8)).all()  # no row always starts as it once did
    both = (settled[:, 1:] * settled[:, :-1]).mean().item()
    assert both == pytest.approx(0.16, abs=0.05)  # nor does an episode start as the one before it


def test_before_there_is_a_task_the_same_places_hold_zeros():
    steps = rollout(None, 5, width=throw_phases().width)
    assert steps["task_phase"].shape == (1, 5, 4)
    assert not steps["task_phase"].any()
    assert "task_phase_index" not in steps.keys()


def test_another_seed_draws_other_episodes():
    first, second = (rollout(SHORT, 1, 200, seed=seed)["task_phase_last"] for seed in (0, 1))
    assert (first != second).any()


@pytest.mark.parametrize(
    ("arguments", "told"),
    [
        ({"schedule": throw_phases(), "dt": 0.02, "width": 3}, "at least 4 places"),
        ({"schedule": None, "dt": 0.02}, "no phases"),
        ({"schedule": sled_phases(), "dt": 0.0}, "more than 0"),
    ],
)
def test_what_cannot_be_shown_is_refused(arguments, told):
    with pytest.raises(ValueError, match=told):
        TaskPhase(**arguments)


def test_numbers_of_phases_are_announced_up_to_the_last_one() -> None:
    """A one-hot code of the spec would have a place that no phase takes."""
    env = TransformedEnv(ToyEnv(2), TaskPhase(throw_phases(), 0.02))
    for key in ("task_phase_index", "task_phase_last"):
        space = env.observation_spec[key].space
        assert (int(space.low.max()), int(space.high.max())) == (0, len(throw_phases().phases) - 1)
