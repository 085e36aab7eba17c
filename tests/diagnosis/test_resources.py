"""Long logs are thinned to what memory holds, and a run that is out of time says what it has found."""

import threading
import time
from dataclasses import replace

import numpy as np
import pytest
from diagnosis.plants import pendulum, record, smooth_torque

from torchrl_athletic.diagnosis import diagnose, resources
from torchrl_athletic.diagnosis.resources import GIGABYTE, OutOfTime, alarm, free_memory, room_for_data, within_memory
from torchrl_athletic.diagnosis.thresholds import SPENDING
from torchrl_athletic.effects import CATALOGUE
from torchrl_athletic.recordings import Recording, split_at_gaps

FEW = tuple(e for e in CATALOGUE if e.name in ("coulomb_friction", "viscous_friction"))


def long_log(seconds: float, rate: float) -> Recording:
    stamps = np.arange(int(seconds * rate)) / rate
    return Recording(stamps, ("hinge",), np.sin(stamps)[:, None], torque_command=np.cos(stamps)[:, None])


def need(r: Recording) -> float:
    return r.num_joints * (SPENDING.per_second * r.duration + SPENDING.per_sample * r.num_samples)


@pytest.mark.parametrize("share", [0.05, 0.5])
def test_of_a_log_that_does_not_fit_stretches_from_its_whole_length_are_used(share):
    log = long_log(3600.0, 50.0)
    found = within_memory([log], share * need(log))
    [kept] = found.recordings
    pieces = split_at_gaps(kept)
    assert found.share == pytest.approx(share, rel=0.15)
    assert f"{100 * found.share:.0f} % are used" in found.warning
    assert sum(need(p) for p in pieces) < 1.05 * share * need(log)
    assert all(p.duration >= SPENDING.stretch - 0.1 for p in pieces)
    assert pieces[0].time[0] == 0.0
    assert kept.time[-1] > 3600.0 - 1.0
    assert max(np.diff([p.time[0] for p in pieces])) < 2.2 * SPENDING.stretch / share


def test_a_log_whose_clock_began_long_before_is_cut_as_one_that_begins_at_zero():
    log = long_log(3600.0, 50.0)
    late = replace(log, time=log.time + 1e5)
    kept, later = (within_memory([r], 0.2 * need(log)).recordings[0] for r in (log, late))
    np.testing.assert_allclose(later.time - 1e5, kept.time, atol=1e-6)


@pytest.mark.parametrize(("seconds", "share", "kept"), [(60.0, 0.25, 15.0), (60.0, 0.05, 5.0), (100.0, 0.35, 20.0)])
def test_of_a_log_that_is_short_or_hardly_fits_its_beginning_is_used(seconds, share, kept):
    """No less than five seconds, and no more than a stretch."""
    log = long_log(seconds, 50.0)
    (found,) = within_memory([log], share * need(log)).recordings
    assert (found.time[0], found.time[-1]) == (0.0, pytest.approx(kept, abs=0.03))
    assert len(split_at_gaps(found)) == 1


def test_room_is_what_is_asked_for_or_half_of_what_is_free_without_what_a_run_takes_in_any_case(monkeypatch):
    monkeypatch.setattr(resources, "free_memory", lambda: 40 * GIGABYTE)
    assert room_for_data(None) == SPENDING.share * 40 * GIGABYTE - SPENDING.fixed
    assert room_for_data(30.0) == 30 * GIGABYTE - SPENDING.fixed
    assert room_for_data(1e-3) == SPENDING.least


def test_what_fits_stays_as_it_is():
    log = long_log(60.0, 100.0)
    found = within_memory([log], need(log))
    assert (found.recordings, found.share) == ((log,), 1.0)
    assert found.warning == ""


def test_a_run_that_is_out_of_time_is_stopped_in_the_midst_of_a_stage():
    def work() -> None:
        with alarm(0.05):
            while time.monotonic() - begin < 5.0:
                pass

    begin = time.monotonic()
    with pytest.raises(OutOfTime):
        work()
    assert time.monotonic() - begin < 1.0
    with alarm(0.05):
        pass
    time.sleep(0.1)  # it does not ring any more


@pytest.mark.parametrize("seconds", [0.0, -5.0])
def test_what_is_out_of_time_from_the_start_is_stopped_and_what_has_time_is_not(seconds):
    def work() -> None:
        with alarm(seconds):
            time.sleep(2.0)

    with pytest.raises(OutOfTime):
        work()
    with alarm(30.0):
        time.sleep(0.01)


def test_another_thread_has_no_alarm_and_runs_on():
    done = []

    def run() -> None:
        with alarm(0.01):
            time.sleep(0.05)
            done.append(True)

    thread = threading.Thread(target=run)
    thread.start()
    thread.join()
    assert done == [True]


def test_there_is_a_report_however_short_the_time(tmp_path):
    takes = [record(pendulum(), smooth_torque(3.0, 1.0, seed=k), noise=1e-4, seed=k) for k in range(2)]
    stopped = diagnose(pendulum(), takes[:1], takes[1:], catalogue=FEW, time_budget=1e-3, output=tmp_path)
    assert not stopped.answer.complete
    assert stopped.answer.stage == "propose"
    assert stopped.answer.locations
    assert (tmp_path / "report.html").exists()
    assert diagnose(pendulum(), takes[:1], takes[1:], catalogue=FEW, output=tmp_path).answer.complete


def test_what_is_free_is_no_more_than_a_machine_has():
    assert 0.01 * GIGABYTE < free_memory() < 1e5 * GIGABYTE
