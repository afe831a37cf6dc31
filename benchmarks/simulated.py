"""Workers under a simulated clock, for `benchmarks.rehearsal`: their orders, work and reports."""

from collections import deque
from dataclasses import dataclass, field

import numpy as np
from jaxtyping import Float

from levelproof.experts.steps import EnvSteps, Seconds
from levelproof.pipeline.jobs.schedule import Cut, Order, Round, Summary, UnitOutcome, WorkUnit


class Work:
    """Seconds of every level, the same on any worker."""

    def __init__(self, seconds: Float[np.ndarray, " level"]) -> None:
        drawn = np.random.default_rng(0).choice(seconds, 2**20)
        self._sums = np.concatenate([[0.0], np.cumsum(drawn)])

    def of(self, unit: WorkUnit) -> float:
        ids, period = unit.level_ids, len(self._sums) - 1
        if isinstance(ids, range):
            first, end = ids[0] % period, ids[-1] % period + 1
            return float(self._sums[end] - self._sums[first] + (self._sums[-1] if end <= first else 0.0))
        indices = np.array(ids) % period
        return float((self._sums[indices + 1] - self._sums[indices]).sum())


@dataclass(eq=False)
class SimulatedWorker:
    """Works through its units in order; like the real worker, reports when one ends or when time is up."""

    machine: int
    speed: float
    slots: int
    joined: float  # time
    units: deque[tuple[WorkUnit, float]] = field(default_factory=deque)
    into: float = 0.0  # s of work done on the first unit
    since: float = 0.0  # time when its current stretch of work began
    until: float = 0.0  # time of its next report
    cuts: list[Cut] = field(default_factory=list)
    alive: bool = True

    def begin(self, order: Order, now: float, seconds: float, work: Work) -> float:
        """Accept an order; return the time of the next report."""
        self.into = self.into if self.units else 0.0
        self._give(order.give, work)
        self.units.extend((unit, work.of(unit)) for unit in order.units)
        first = (self.units[0][1] - self.into) / self.speed if self.units else seconds
        self.since, self.until = now, now + min(seconds, max(first, 0.0))
        return self.until

    @property
    def decided(self) -> int:
        """Number of decided levels in its first unit."""
        unit, seconds = self.units[0] if self.units else (None, 0.0)
        return min(int(self.into / seconds * len(unit.level_ids)), len(unit.level_ids)) if unit and seconds else 0

    def report(self, now: float) -> tuple[Round, float]:
        """Report what is done by now, with the s of work in it."""
        self.into += (now - self.since) * self.speed if self.units else 0.0
        self.since = now
        outcomes, useful = [], 0.0
        while self.units and self.into >= self.units[0][1] - 1e-9:
            unit, seconds = self.units.popleft()
            self.into -= seconds
            useful += seconds
            outcomes.append(committed(unit, seconds / self.speed))
        waiting = max(0, sum(len(unit.level_ids) for unit, _ in self.units) - self.decided - self.slots)
        cuts, self.cuts = self.cuts, []
        return Round(outcomes, {}, max(0, self.slots - waiting), waiting, cuts), useful

    def leave(self, now: float) -> tuple[Round, float]:
        """Commit decided levels and return the others; report as `report` does."""
        round, useful = self.report(now)
        done = self.decided
        for unit, seconds in self.units:
            kept, back = (unit.only(part) for part in (unit.level_ids[:done], unit.level_ids[done:]))
            round.cuts.append(Cut(unit, kept, back))
            took = seconds * done / len(unit.level_ids)
            round.outcomes.extend([committed(kept, took / self.speed)] if kept else [])
            useful += took
            self.into -= took
            done = 0
        return Round(round.outcomes, {}, 0, cuts=round.cuts, leaves=True), useful

    def _give(self, levels: int, work: Work) -> None:
        """Return levels that have not begun, from the last units first."""
        missing = levels
        for i in range(len(self.units) - 1, -1, -1):
            unit = self.units[i][0]
            count = min(missing, len(unit.level_ids) - (0 if i else self.decided + self.slots))
            if count <= 0:
                return
            kept, back = (unit.only(part) for part in (unit.level_ids[:-count], unit.level_ids[-count:]))
            self.cuts.append(Cut(unit, kept, back))
            missing -= count
            if kept:
                self.units[i] = kept, work.of(kept)
            else:
                del self.units[i]


def committed(unit: WorkUnit, seconds: float) -> UnitOutcome:
    """Return the outcome of a unit that took its worker `seconds`."""
    return UnitOutcome(unit, Summary(len(unit.level_ids), 0, EnvSteps(), Seconds(training=seconds)))
