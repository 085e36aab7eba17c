"""What a run may spend: memory, by which long logs are thinned, and time, after which it says what it has found."""

from __future__ import annotations

import signal
import threading
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from typing import Any

import numpy as np

from torchrl_athletic.diagnosis.memory import free_memory
from torchrl_athletic.diagnosis.thresholds import SPENDING
from torchrl_athletic.recordings import Recording

GIGABYTE = 2.0**30


@dataclass(frozen=True, eq=False)
class WithinMemory:
    """Recordings that fit into memory."""

    recordings: tuple[Recording, ...]
    share: float
    """Share of their samples that is used."""

    @property
    def warning(self) -> str:
        """What was left out, in a sentence; empty if nothing was."""
        if self.share >= 1.0:
            return ""
        return (
            f"Of these recordings {100 * self.share:.0f} % are used, in stretches of {SPENDING.stretch:.0f} s spread "
            "evenly: all of them would not fit into the memory that --memory allows."
        )


def within_memory(recordings: Sequence[Recording], room: float) -> WithinMemory:
    """Keep as much of each recording as some memory holds: stretches spread evenly, with gaps between them.

    Args:
        recordings: Any.
        room: Memory [B].
    """
    need = sum(
        r.num_joints * (SPENDING.per_second * r.duration + SPENDING.per_sample * r.num_samples) for r in recordings
    )
    if need <= room:
        return WithinMemory(tuple(recordings), 1.0)
    kept = tuple(_stretches(r, room / need) for r in recordings)
    share = sum(r.num_samples for r in kept) / sum(r.num_samples for r in recordings)
    return WithinMemory(kept, share)


def _stretches(recording: Recording, share: float) -> Recording:
    """A share of a recording; the gaps between its stretches are gaps to all that follows."""
    time = recording.time - recording.time[0]
    count = max(1, int(share * time[-1] / SPENDING.stretch))
    length = SPENDING.stretch if count > 1 else min(max(share * time[-1], SPENDING.shortest), SPENDING.stretch)
    starts = np.linspace(0.0, time[-1] - length, count) if count > 1 else np.zeros(1)
    kept = ((time[:, None] >= starts) & (time[:, None] <= starts + length)).any(1)
    return recording.where(kept)


def room_for_data(memory: float | None) -> float:
    """Memory that a run may take for recordings [B], of what is asked for in GB, or of half of what is free."""
    whole = SPENDING.share * free_memory() if memory is None else memory * GIGABYTE
    return max(whole - SPENDING.fixed, SPENDING.least)


class OutOfTime(KeyboardInterrupt):
    """The time is spent: as if somebody had pressed Ctrl-C."""


@contextmanager
def alarm(seconds: float | None) -> Iterator[None]:
    """Raise :class:`OutOfTime` in here once so much time has passed.

    Without effect where no signal comes: in another thread than the main one, or if None.
    """
    main = threading.current_thread() is threading.main_thread()
    if seconds is None or not main or not hasattr(signal, "setitimer"):
        yield
        return

    def ring(*_: Any) -> None:
        raise OutOfTime

    before = signal.signal(signal.SIGALRM, ring)
    signal.setitimer(signal.ITIMER_REAL, max(seconds, 1e-3))
    try:
        yield
    finally:
        signal.setitimer(signal.ITIMER_REAL, 0.0)
        signal.signal(signal.SIGALRM, before)
