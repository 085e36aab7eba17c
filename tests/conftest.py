"""What every test runs under: one thread a worker, seeded hypothesis, and real recordings where there are some."""

import os

os.environ.setdefault("OMP_NUM_THREADS", "1")  # before numpy and torch; the workers share the cores already
os.environ.setdefault("MPLBACKEND", "Agg")

from pathlib import Path

import pytest
from hypothesis import HealthCheck, settings

settings.register_profile(
    "repeatable", deadline=None, derandomize=True, max_examples=50, suppress_health_check=[HealthCheck.too_slow]
)
settings.load_profile("repeatable")


@pytest.fixture(scope="session")
def real_recordings() -> Path:
    """Folder of the public recordings; skips where there is none."""
    folder = os.environ.get("ATHLETIC_DATA")
    if not folder:
        pytest.skip("ATHLETIC_DATA names no folder of real recordings")
    assert Path(folder).is_dir(), f"ATHLETIC_DATA={folder} is not a folder"
    return Path(folder)
