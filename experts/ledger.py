"""Costs of levels: seconds of a worker, and so of its core or GPU, by stage.

Levels run side by side. Stages that serve all levels of a unit are split evenly; search, training and evaluation in
proportion to env steps. Compiling is counted separately, because a worker pays for it once, whatever it makes.
"""

import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass

import numpy as np
from jax import monitoring
from jaxtyping import Int

from levelproof.experts.steps import Seconds

COMPILING = "/jax/core/compile/"  # prefix of JAX's tracing, lowering and compiling events


@dataclass
class Lap:
    """Duration of some work, s."""

    seconds: float = 0.0  # compiling excluded
    compiling: float = 0.0


class _Compiled(threading.local):
    """Seconds that JAX has spent compiling in this thread; of nested traces only the outer one counts."""

    def __init__(self) -> None:
        self.seconds = 0.0
        self._last: list[tuple[float, float]] = []  # start and duration of the latest events, none nested

    def note(self, event: str, duration_secs: float, **_: object) -> None:
        if not event.startswith(COMPILING):
            return
        start = time.perf_counter() - duration_secs
        while self._last and self._last[-1][0] >= start:
            self.seconds -= self._last.pop()[1]
        self._last = [*self._last[-99:], (start, duration_secs)]
        self.seconds += duration_secs


_compiled = _Compiled()
monitoring.register_event_duration_secs_listener(_compiled.note)


@contextmanager
def lap() -> Iterator[Lap]:
    """Time the `with` block, which must wait for its device results."""
    took, start, compiled = Lap(), time.perf_counter(), _compiled.seconds
    yield took
    took.compiling = _compiled.seconds - compiled
    took.seconds = max(0.0, time.perf_counter() - start - took.compiling)


class Ledger:
    """Seconds of each level, by stage (a field of `Seconds`)."""

    def __init__(self, count: int) -> None:
        self._seconds = {stage: np.zeros(count) for stage in Seconds._fields}

    @contextmanager
    def timing(self, stage: str) -> Iterator[None]:
        """Time the `with` block; charge it evenly to all levels."""
        with lap() as took:
            yield
        self.add(stage, took)

    def add(self, stage: str, took: Lap) -> None:
        """Charge a lap evenly to all levels."""
        for name, seconds in (stage, took.seconds), ("compiling", took.compiling):
            self._seconds[name] += seconds / max(len(self._seconds[name]), 1)

    def put(self, stage: str, index: int, seconds: float) -> None:
        """Charge seconds to one level."""
        self._seconds[stage][index] += seconds

    def take(self, other: "Ledger", indices: Int[np.ndarray, " index"]) -> None:
        """Add another ledger's seconds; its levels have these indices in this ledger."""
        for stage, theirs in other._seconds.items():
            self._seconds[stage][indices] += theirs

    def share(self, stage: str, steps: Int[np.ndarray, " level"]) -> None:
        """Redistribute a stage's seconds in proportion to each level's env steps."""
        values = self._seconds[stage]
        if steps.sum():
            values[:] = values.sum() * (steps / steps.sum())

    def only(self, indices: Int[np.ndarray, " index"]) -> "Ledger":
        """Return the ledger of these levels; they share the seconds spent on the others."""
        some = Ledger(len(indices))
        for stage, values in self._seconds.items():
            some._seconds[stage] = values[indices] + (values.sum() - values[indices].sum()) / max(len(indices), 1)
        return some

    def seconds_of(self, index: int) -> Seconds:
        """Return one level's seconds."""
        return Seconds(*(float(values[index]) for values in self._seconds.values()))

    def total(self) -> Seconds:
        return Seconds(*(float(values.sum()) for values in self._seconds.values()))


class StepCosts:
    """Splits the time of a pool's steps between slots that train and all others.

    A step of n slots, x of which train, takes about y = n * play + x * update seconds: every slot plays the same
    number of env steps. The slope of a least-squares line through (x, y) estimates the update; on a GPU, where slots
    that do not train cost the same, it is near 0.
    """

    def __init__(self) -> None:
        self._sums = np.zeros(5)  # sums of 1, x, y, x x and x y

    def split(self, seconds: float, training: int, slots: int) -> tuple[float, float]:
        """Return the seconds of each training slot and of each other slot in a step of `seconds` s."""
        x, y = training, seconds
        self._sums += 1, x, y, x * x, x * y
        n, xs, ys, xx, xy = self._sums
        spread = n * xx - xs * xs
        slope = (n * xy - xs * ys) / spread if spread else 0.0
        update = min(max(slope, 0.0), seconds / max(training, 1))
        play = (seconds - training * update) / slots
        return play + update, play
