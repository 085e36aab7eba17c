import math

import pytest
import torch

from torchrl_athletic.functional import streams
from torchrl_athletic.functional.phase import (
    Phase,
    PhaseSchedule,
    advance_phase,
    draw_phases,
    embed_phase,
    sled_phases,
    snatch_phases,
    throw_phases,
)

N = 20_000


def drawn(schedule: PhaseSchedule) -> tuple[torch.Tensor, torch.Tensor]:
    unit = streams.uniform(streams.stream(0, torch.arange(N)), 1 + len(schedule.phases))
    first, last = draw_phases(unit, schedule.start_bounds(), schedule.leave_probability())
    return first.squeeze(-1), last.squeeze(-1)


def share(mask: torch.Tensor) -> float:
    return mask.double().mean().item()


def played(schedule: PhaseSchedule, first: int, last: int, seconds: float, dt: float = 0.02) -> list[str]:
    """Name of the phase at each step."""
    index, step, end = torch.tensor([first]), torch.tensor([0]), torch.tensor([last])
    names = []
    for _ in range(round(seconds / dt)):
        names.append(schedule.names[index.item()])
        index, step = advance_phase(index, step, end, schedule.duration_steps(dt))
    return names


def test_a_throw_is_set_up_for_2_5_s_and_lasts_until_3_5_s():
    names = played(throw_phases(), first=0, last=2, seconds=10)
    assert [names.index(name) for name in ("throw-set-up", "throw", "settle")] == [0, 125, 175]
    assert names[-1] == "settle"


def test_a_phase_that_does_not_hand_over_stays_for_the_rest_of_the_episode():
    assert set(played(snatch_phases(), first=0, last=0, seconds=60)) == {"snatch-set-up"}


@pytest.mark.parametrize(("dt", "steps"), [(0.02, 125), (0.005, 500), (0.03, 84), (1 / 3, 8)])
def test_a_phase_ends_at_the_first_step_that_is_not_before_its_time(dt, steps):
    assert sled_phases().duration_steps(dt)[0] == steps
    assert (steps - 1) * dt < 2.5 <= steps * dt + 1e-9


def test_three_throws_in_ten_never_leave_the_set_up():
    first, last = drawn(throw_phases(settle_probability=0.1))
    assert share(first == 2) == pytest.approx(0.1, abs=0.01)
    assert share(first == 1) == 0
    starts = first == 0
    assert share(last[starts] == 0) == pytest.approx(0.3, abs=0.015)
    assert share(last[starts] == 2) == pytest.approx(0.7, abs=0.015)
    assert (last[first == 2] == 2).all()


def test_at_its_word_the_paper_keeps_three_throws_in_ten_in_the_throw():
    _, last = drawn(throw_phases(stay_in="throw", settle_probability=0.0))
    assert share(last == 1) == pytest.approx(0.3, abs=0.015)
    assert share(last == 0) == 0


def test_nine_snatches_in_ten_happen_and_every_sled_is_pulled():
    assert share(drawn(snatch_phases())[1] == 1) == pytest.approx(0.9, abs=0.01)
    assert share(drawn(sled_phases())[1] == 1) == 1


def test_phases_decide_independently():
    schedule = PhaseSchedule((Phase("a", 1.0, 0.5), Phase("b", 1.0, 0.4), Phase("c")))
    first, last = drawn(schedule)
    assert (first == 0).all()
    for phase, expected in enumerate((0.5, 0.5 * 0.6, 0.5 * 0.4)):
        assert share(last == phase) == pytest.approx(expected, abs=0.015)


def test_a_phase_that_was_skipped_at_the_start_decides_nothing():
    schedule = PhaseSchedule((Phase("a", 1.0, 0.0), Phase("b", 1.0, start_probability=1.0), Phase("c")))
    first, last = drawn(schedule)
    assert (first == 1).all()
    assert (last == 2).all()


def test_the_embedding_is_one_hot_with_a_timer_that_runs_in_the_throw_alone():
    timers = throw_phases().timer_steps(0.02)
    for index, step, expected in (
        (0, 0, [1, 0, 0, 0]),
        (0, 100, [1, 0, 0, 0]),
        (1, 0, [0, 1, 0, 0]),
        (1, 10, [0, 1, 0, 0.2]),
        (1, 50, [0, 1, 0, 1]),
        (1, 500, [0, 1, 0, 1]),
        (2, 10, [0, 0, 1, 0]),
    ):
        seen = embed_phase(torch.tensor([index]), torch.tensor([step]), timers, width=4)
        torch.testing.assert_close(seen, torch.tensor(expected, dtype=torch.float32))


def test_what_a_wider_embedding_adds_is_zero():
    seen = embed_phase(torch.tensor([1]), torch.tensor([5]), sled_phases().timer_steps(0.02), width=6)
    assert seen.tolist() == [0, 1, 0, 0, 0, 0]


def test_a_schedule_knows_its_width_and_places():
    assert (throw_phases().width, snatch_phases().width, sled_phases().width) == (4, 2, 2)
    assert throw_phases().index("settle") == 2
    with pytest.raises(ValueError, match="there are"):
        throw_phases().index("catch")


@pytest.mark.parametrize(
    ("phases", "told"),
    [
        ((), "at least one"),
        ((Phase("a"), Phase("a")), "a name of its own"),
        ((Phase("a", duration=0.0),), "more than 0"),
        ((Phase("a", duration=math.nan),), "more than 0"),
        ((Phase("a", timer=-1.0),), "more than 0"),
        ((Phase("a", leave_probability=1.5),), "outside of 0 to 1"),
        ((Phase("a"), Phase("b", start_probability=0.6), Phase("c", start_probability=0.6)), "sum to more than 1"),
    ],
)
def test_a_schedule_that_cannot_be_played_is_refused(phases, told):
    with pytest.raises(ValueError, match=told):
        PhaseSchedule(phases)


def test_a_throw_stays_in_one_of_its_two_phases_only():
    with pytest.raises(ValueError, match="'settle' lasts in any case"):
        throw_phases(stay_in="settle")
