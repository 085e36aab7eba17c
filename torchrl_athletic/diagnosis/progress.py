"""How far a diagnosis is and how long it will still take: one bar over all stages."""

from __future__ import annotations

from collections.abc import Mapping
from itertools import accumulate
from types import MappingProxyType
from typing import Any, TextIO

from tqdm import tqdm

STAGES: Mapping[str, float] = MappingProxyType(
    {"prepare": 3, "locate": 6, "propose": 25, "simulate": 57, "decide": 2, "state": 3, "deliver": 4}
)
"""Weight of each stage, about its share of the time [1], in the order of work."""


class Progress:
    """A bar with the stage and the time left; silent where the output is not a terminal.

    Args:
        stages: Name -> weight, in the order of work. Those left out count as done, not as fast work.
        force: Show the bar in any case.
        file: Where to draw. Default standard error.

    Example:
        >>> with Progress({"screen": 1, "fit": 3}) as progress:
        ...     progress.stage("fit")
        ...     progress.update(0.5)
        ...     progress.fraction
        0.625
    """

    def __init__(self, stages: Mapping[str, float] = STAGES, *, force: bool = False, file: TextIO | None = None):
        ends = list(accumulate(stages.values()))
        self._span = {name: (end - weight, end) for (name, weight), end in zip(stages.items(), ends, strict=True)}
        self._total = ends[-1]
        self._stage, self._done = "", 0.0
        look = "{desc:<9}{percentage:3.0f} %|{bar}| {elapsed} elapsed, {remaining} left"
        self._bar = tqdm(total=self._total, disable=False if force else None, file=file, smoothing=0, bar_format=look)

    @property
    def now(self) -> str:
        """The stage that is under way."""
        return self._stage

    @property
    def fraction(self) -> float:
        """Share of the whole work that is done, 0..1."""
        return self._done / self._total

    def stage(self, name: str) -> None:
        """Begin stage ``name``: all before it is done.

        Raises:
            ValueError: If there is no such stage.
        """
        if name not in self._span:
            raise ValueError(f"there is no stage {name!r}; the stages are {', '.join(self._span)}.")
        if self._stage:
            self.update(1.0)
        self._stage = name
        start = self._span[name][0]
        if not self._bar.disable:
            self._bar.desc = name
            self._bar.initial += max(0.0, start - self._done)  # skipping took no time: keep it out of the rate
        self._draw(start)

    def update(self, fraction: float) -> None:
        """Say how much of the current stage is done, 0..1. The bar never goes back."""
        if not self._stage:
            raise ValueError("no stage has begun: call stage(name) first.")
        start, end = self._span[self._stage]
        self._draw(start + (end - start) * min(max(fraction, 0.0), 1.0))

    def say(self, text: str) -> None:
        """Print a line above the bar, where there is one."""
        if not self._bar.disable:
            self._bar.write(text, file=self._bar.fp)

    def _draw(self, done: float) -> None:
        self._done = self._bar.n = max(self._done, done)
        self._bar.refresh()

    def __enter__(self) -> Progress:
        return self

    def __exit__(self, *_: Any) -> None:
        self._bar.close()
