"""What every test runs under: one thread a worker, seeded hypothesis, and real recordings where there are some."""

import gc
import os

os.environ.setdefault("OMP_NUM_THREADS", "1")  # before numpy and torch; the workers share the cores already
os.environ.setdefault("MPLBACKEND", "Agg")

from collections.abc import Iterator
from pathlib import Path

import pytest
from hypothesis import HealthCheck, settings

from torchrl_athletic.physics import batch_physics

gc.disable()  # until all tests are collected: a third of that time went into looking for what is garbage

settings.register_profile(
    "repeatable", deadline=None, derandomize=True, max_examples=50, suppress_health_check=[HealthCheck.too_slow]
)
settings.load_profile("repeatable")

PROCESSORS = batch_physics._processors

# Compiling a step, or starting processes, takes seconds for each of thirty transforms: half of the time of their tests.
# Transforms seldom fail these clauses alone: what breaks a graph mostly syncs with the host too, and what goes wrong in
# a ParallelEnv mostly does so in a SerialEnv. So few stand for all by default: one that remembers, one with
# several steps in one and one that draws. -m slow asks the others.
SLOW_CLAUSES = {"test_no_graph_breaks", "test_parallel_trans_env_check", "test_trans_parallel_env_check"}
REPRESENTATIVES = {
    ("test_contract.py", "TestActionDelay"),
    ("test_contract.py", "TestDecimation"),
    ("test_command_sampler.py", "TestContract"),
}


@pytest.hookimpl(tryfirst=True)  # before pytest deselects what is slow
def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    """Mark the contract's clauses that take long, but for some transforms."""
    for item in items:
        contract = item.parent.name if item.parent else ""
        if item.name in SLOW_CLAUSES and (item.path.name, contract) not in REPRESENTATIVES:
            item.add_marker(pytest.mark.slow)


def pytest_collection_finish() -> None:
    """Look for garbage again, but not among modules and tests, which stay."""
    gc.freeze()
    gc.enable()


@pytest.fixture(scope="session", autouse=True)
def one_thread() -> Iterator[None]:
    """Simulate on the worker's own thread: where both CPUs are busy, a second one is waited for seven times as long.

    The numbers do not depend on it, which physics/test_batch_physics.py asks with threads of its own.
    """
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(batch_physics, "_processors", lambda: 1)
        yield


@pytest.fixture
def every_cpu(monkeypatch: pytest.MonkeyPatch) -> None:
    """Simulate on as many threads as outside the tests."""
    monkeypatch.setattr(batch_physics, "_processors", PROCESSORS)


@pytest.fixture(scope="session")
def real_recordings() -> Path:
    """Folder of the public recordings; skips where there is none."""
    folder = os.environ.get("ATHLETIC_DATA")
    if not folder:
        pytest.skip("ATHLETIC_DATA names no folder of real recordings")
    assert Path(folder).is_dir(), f"ATHLETIC_DATA={folder} is not a folder"
    return Path(folder)
