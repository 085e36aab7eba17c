"""What may be taken is the less of what the machine and its container have left."""

from pathlib import Path

import pytest

from torchrl_athletic.diagnosis import resources
from torchrl_athletic.diagnosis.memory import free_memory
from torchrl_athletic.diagnosis.resources import GIGABYTE, room_for_data
from torchrl_athletic.diagnosis.thresholds import SPENDING

MACHINE = "MemTotal:  9000000 kB\nMemFree:  1000 kB\nMemAvailable:  2000000 kB\n"


@pytest.mark.parametrize(
    ("most", "used", "free"),
    [
        ("max", "5000", 2_000_000 * 1024.0),
        ("1000000000", "400000000", 6e8),
        ("9000000000", "1000", 2_000_000 * 1024.0),
    ],
)
def test_a_container_may_have_less_than_its_machine(most, used, free, monkeypatch):
    files = {"meminfo": MACHINE, "memory.max": f"{most}\n", "memory.current": f"{used}\n"}
    monkeypatch.setattr(Path, "read_text", lambda path, *_: files[path.name])
    assert free_memory() == free


def test_libraries_are_taken_off_what_is_asked_for_and_a_little_is_taken_in_any_case(monkeypatch):
    monkeypatch.setattr(resources, "free_memory", lambda: 8 * GIGABYTE)
    assert room_for_data(3.0) == pytest.approx(3 * GIGABYTE - SPENDING.fixed)
    assert room_for_data(None) == pytest.approx(SPENDING.share * 8 * GIGABYTE - SPENDING.fixed)
    assert room_for_data(0.1) == SPENDING.least
