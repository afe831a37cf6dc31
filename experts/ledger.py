"""What levels cost: seconds of a worker, and with it of its core or its GPU, by what they were for.

Levels run side by side. What belongs to all levels of a unit alike is parted evenly; search, training and
evaluation in proportion to env steps. What was compiled is apart: it is paid once a worker, whatever it makes.
"""

import time
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass

import numpy as np
from jax import monitoring
from jaxtyping import Int

from levelproof.experts.steps import Seconds

COMPILING = "/jax/core/compile/"  # what JAX's events of tracing, lowering and compiling begin with


@dataclass
class Lap:
    """What a stretch of work took, s."""

    seconds: float = 0.0  # without compiling
    compiling: float = 0.0


class _Compiled:
    """Seconds that JAX has compiled in this process; of what is traced within another trace, the outer one counts."""

    def __init__(self) -> None:
        self.seconds = 0.0
        self._last: list[tuple[float, float]] = []  # beginning and duration of the latest, none within another
        monitoring.register_event_duration_secs_listener(self._note)

    def _note(self, event: str, duration_secs: float, **_: object) -> None:
        if not event.startswith(COMPILING):
            return
        begun = time.perf_counter() - duration_secs
        while self._last and self._last[-1][0] >= begun:
            self.seconds -= self._last.pop()[1]
        self._last = [*self._last[-99:], (begun, duration_secs)]
        self.seconds += duration_secs


_compiled = _Compiled()


@contextmanager
def lap() -> Iterator[Lap]:
    """Times what is done meanwhile; what runs on a device has to have come back to the host by its end."""
    of, begun, compiled = Lap(), time.perf_counter(), _compiled.seconds
    yield of
    of.compiling = _compiled.seconds - compiled
    of.seconds = max(0.0, time.perf_counter() - begun - of.compiling)


class Ledger:
    """The account of some levels."""

    def __init__(self, count: int) -> None:
        self._of = {stage: np.zeros(count) for stage in Seconds._fields}

    @contextmanager
    def timing(self, stage: str) -> Iterator[None]:
        """What is done meanwhile is this stage's (a field of `Seconds`), and evenly all levels'."""
        with lap() as took:
            yield
        self.add(stage, took)

    def add(self, stage: str, took: Lap) -> None:
        """Part it evenly between the levels."""
        for of, seconds in (stage, took.seconds), ("compiling", took.compiling):
            self._of[of] += seconds / max(len(self._of[of]), 1)

    def put(self, stage: str, index: int, seconds: float) -> None:
        """Add to one level."""
        self._of[stage][index] += seconds

    def take(self, other: "Ledger", indices: Int[np.ndarray, " index"]) -> None:
        """Add the account of these of the levels."""
        for stage, theirs in other._of.items():
            self._of[stage][indices] += theirs

    def share(self, stage: str, steps: Int[np.ndarray, " level"]) -> None:
        """Part what a stage took in proportion to the env steps that each level had of it."""
        values = self._of[stage]
        if steps.sum():
            values[:] = values.sum() * (steps / steps.sum())

    def only(self, indices: Int[np.ndarray, " index"]) -> "Ledger":
        """The account of these levels; what was done in vain for the others is theirs, too."""
        some = Ledger(len(indices))
        for stage, values in self._of.items():
            some._of[stage] = values[indices] + (values.sum() - values[indices].sum()) / max(len(indices), 1)
        return some

    def of(self, index: int) -> Seconds:
        """A level's."""
        return Seconds(*(float(values[index]) for values in self._of.values()))

    def total(self) -> Seconds:
        return Seconds(*(float(values.sum()) for values in self._of.values()))


class Steps:
    """Parts what a pool's steps take between slots that train and slots that are evaluated.

    Every slot plays the same number of env steps; what an update takes beyond them is the slope of a line through the
    steps so far, by least squares: on a CPU slots that do not train are skipped, on a GPU they cost the same.
    """

    def __init__(self) -> None:
        self._sums = np.zeros(5)  # of 1, training slots x, seconds y, x x, x y

    def part(self, seconds: float, training: int, slots: int) -> tuple[float, float]:
        """Of a step of all slots that took so long, the part of each that trains, and of each other one."""
        x, y = training, seconds
        self._sums += 1, x, y, x * x, x * y
        n, xs, ys, xx, xy = self._sums
        spread = n * xx - xs * xs
        slope = (n * xy - xs * ys) / spread if spread else 0.0
        update = min(max(slope, 0.0), seconds / max(training, 1))
        play = (seconds - training * update) / slots
        return play + update, play
