"""What is left to do: work units, who has them, their attempts and their quarantine. Knows nothing of files."""

from collections import deque
from collections.abc import Callable, Collection, Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from itertools import pairwise

import numpy as np

from experts.steps import EnvSteps
from pipeline.store.layout import unit_name
from pipeline.store.origins import Origin
from pipeline.store.runs import runs, told_levels

# How many units a worker may have at once, those included that failed as often: a unit that kills its worker takes
# fewer with it each time, and none that has not failed. One more failure, and a unit is quarantined.
COMPANY = (64, 8, 1)
ROUND = 1.0  # s that a worker trains between reports; a step that is compiled takes longer


@dataclass(frozen=True)
class WorkUnit:
    """Levels done together and committed together: ids of one multiple of the job's `unit`, or as many from files."""

    level_ids: tuple[int, ...] | range  # ascending
    origins: tuple[Origin, ...] = field(default=(), compare=False, repr=False)  # of each; empty: ids make them

    @property
    def name(self) -> str:
        return unit_name(self.level_ids[0], self.level_ids[-1])


def plan_units(
    wanted: Collection[int] | np.ndarray,
    done: Collection[int] | np.ndarray,
    unit: int,
    origins: Mapping[int, Origin] | None = None,
) -> list[WorkUnit]:
    """Units that cover what is wanted (ascending) and not done, ascending.

    A unit never crosses an absolute multiple of `unit`, so jobs that start elsewhere cut at the same ids. Ids of levels
    with origins lie far apart: of those a unit has as many as it may.
    """
    there = np.fromiter(wanted, np.int64, len(wanted))
    left = there[~np.isin(there, np.fromiter(done, np.int64, len(done)))]
    numbers = (np.arange(len(left)) if origins else left) // unit
    firsts = np.flatnonzero(np.diff(numbers, prepend=-1)).tolist()
    ids, of = left.tolist(), origins or {}
    parts = [tuple(ids[first:end]) for first, end in pairwise([*firsts, len(ids)])]
    return [WorkUnit(part, tuple(of[i] for i in part if i in of)) for part in parts]


@dataclass(frozen=True)
class Summary:
    """What travels back from a committed unit."""

    levels: int
    solved: int
    spent: EnvSteps


@dataclass(frozen=True)
class UnitOutcome:
    """How one attempt at a unit ended."""

    unit: WorkUnit
    summary: Summary | None = None  # None: it failed
    reason: str = ""  # of the failure, for the quarantine file
    fatal: str = ""  # a sentence, where no further attempt can succeed


Settle = Callable[[Sequence[UnitOutcome]], None]  # takes note of attempts that ended together


@dataclass(frozen=True)
class Round:
    """What a worker reports of some time at work."""

    outcomes: list[UnitOutcome]  # of the units that ended
    totals: dict[WorkUnit, tuple[int, float, int]]  # of the others: env steps, levels, solved levels so far
    wants: int  # levels more for which it has room


@dataclass
class UnitQueue:
    """Units waiting, each with the attempts it has had."""

    waiting: deque[WorkUnit]
    attempts: dict[WorkUnit, int] = field(default_factory=dict)
    quarantined: list[WorkUnit] = field(default_factory=list)

    def take(self, running: Collection[WorkUnit] = ()) -> WorkUnit | None:
        """The next unit for a worker that has these; None when none may join them (see `COMPANY`)."""
        failures = {self.attempts.get(unit, 0) for unit in running}  # one number at most
        if failures and len(running) >= COMPANY[max(failures)]:
            return None  # without a look at all that wait: workers ask several times a second
        for unit in self.waiting:
            if not failures or self.attempts.get(unit, 0) in failures:
                self.waiting.remove(unit)
                return unit
        return None

    def failed(self, unit: WorkUnit) -> bool:
        """Note a failed attempt; the unit waits again, or True when it is now quarantined."""
        self.attempts[unit] = self.attempts.get(unit, 0) + 1
        if self.attempts[unit] < len(COMPANY):
            self.waiting.append(unit)
            return False
        self.quarantined.append(unit)
        return True


@dataclass
class Assignment:
    """The units that one worker has."""

    units: list[WorkUnit] = field(default_factory=list)
    wants: int = 1  # levels more for which it has room

    def take(self, queue: UnitQueue) -> bool:
        """Another unit from the queue, if there is room for one and one may join these."""
        unit = queue.take(self.units) if self.wants > 0 or not self.units else None
        if unit is None:
            return False
        self.units.append(unit)
        self.wants -= len(unit.level_ids)
        return True

    def account(self, round: Round) -> None:
        """Follow the worker's report."""
        ended = {outcome.unit for outcome in round.outcomes}
        self.units = [unit for unit in self.units if unit not in ended]
        self.wants = round.wants

    def lose(self, reason: str) -> list[UnitOutcome]:
        """The worker died, and its units failed."""
        units, self.units, self.wants = self.units, [], 1
        return [UnitOutcome(unit, reason=reason) for unit in units]


def levels_text(units: Iterable[WorkUnit]) -> str:
    """Their levels, for people: `levels 0 to 31, 96 to 127`."""
    return told_levels(runs([level_id for unit in units for level_id in unit.level_ids]))
