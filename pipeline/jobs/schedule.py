"""Work units, their attempts and quarantine, and `Scheduler`, which decides which worker gets which unit.

Knows nothing of files, Ray, or the time.
"""

from collections import deque
from collections.abc import Callable, Collection, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from heapq import nlargest
from itertools import chain, groupby
from typing import Any, NamedTuple

import numpy as np

from levelproof.experts.steps import NO_SECONDS, EnvSteps, Seconds, Totals
from levelproof.pipeline.errors import Failure, LevelproofError
from levelproof.pipeline.jobs.sizing import UnitSize
from levelproof.pipeline.store.layout import unit_name
from levelproof.pipeline.store.origins import Origin
from levelproof.pipeline.store.runs import ascending, runs, runs_text, without

# Maximum number of units that a worker has at once, by the failed attempts at each. Units with different numbers of
# failures never share a worker. So a unit that kills its worker takes fewer others with it each time, and none that
# has not failed. After len(MAX_UNITS) failures a unit is quarantined.
MAX_UNITS = (64, 8, 1)
ROUND = 1.0  # s that a worker trains between reports; a step that compiles takes longer
REPORTS = 100.0  # reports per second that the driver can take; with more workers, each reports less often
STRETCH = 2**13  # levels planned together if units are timed; units are cut from them once their size is known
PARTS = 8  # a unit is not cut below 1/PARTS of its size, even if there are too few for all workers
TIMED_PARTS = 4  # the same for timed units: each part should take 10 s, because workers ask for every one
JAX_NOTE = "\n--------------------\n"  # precedes the note on tracebacks that JAX adds to an error
MIN_SHARE = 2  # unstarted levels of a worker below which it is not asked to share them


@dataclass(frozen=True)
class WorkUnit:
    """Levels made and committed together; `plan_units` says which."""

    level_ids: tuple[int, ...] | range  # ascending
    origins: tuple[Origin, ...] = field(default=(), compare=False, repr=False)  # by level; empty: sampled levels

    @property
    def name(self) -> str:
        return unit_name(self.level_ids[0], self.level_ids[-1])

    def only(self, level_ids: Collection[int]) -> "WorkUnit | None":
        """Return the part of this unit with these levels; None if it has none of them."""
        at = [i for i, level_id in enumerate(self.level_ids) if level_id in level_ids]
        ids, origins = tuple(self.level_ids[i] for i in at), tuple(self.origins[i] for i in at if self.origins)
        return WorkUnit(ids, origins) if ids else None

    def split(self, count: int) -> "tuple[WorkUnit, WorkUnit | None]":
        """Return the first `count` levels and the rest, or None if there is none. A range is split into ranges."""
        first, rest = (WorkUnit(self.level_ids[cut], self.origins[cut]) for cut in (slice(count), slice(count, None)))
        return first, rest if rest.level_ids else None


def plan_units(
    wanted: Sequence[int] | np.ndarray,
    done: Collection[int] | np.ndarray,
    unit: int,
    origins: Mapping[int, Origin] | None = None,
) -> Iterator[WorkUnit]:
    """Yield units, ascending, that cover the level ids that are wanted and not done.

    A unit never crosses an absolute multiple of `unit`, so jobs with other first levels cut at the same ids. If
    `origins` is not None (it may be empty), ids are far apart, so each unit simply takes `unit` levels.
    """
    committed = ascending(np.fromiter(done, np.int64, len(done)))
    if origins is None:
        return _by_multiple(without(runs(wanted), committed), unit)
    left = np.setdiff1d(np.asarray(wanted, np.int64), committed)
    parts = (left[i : i + unit].tolist() for i in range(0, len(left), unit))
    return (WorkUnit(tuple(part), tuple(origins[i] for i in part) if origins else ()) for part in parts)


def _by_multiple(runs: Iterable[tuple[int, int]], unit: int) -> Iterator[WorkUnit]:
    """Yield units of these runs of ids. A unit of consecutive ids stores a range, so its memory is constant."""
    pieces = (
        range(max(first, number * unit), min(last, number * unit + unit - 1) + 1)
        for first, last in runs
        for number in range(first // unit, last // unit + 1)
    )
    for _, group in groupby(pieces, lambda piece: piece[0] // unit):
        ranges = list(group)
        yield WorkUnit(tuple(chain(*ranges)) if ranges[1:] else ranges[0])


@dataclass(frozen=True)
class Summary:
    """A committed unit's totals, as the driver gets them."""

    levels: int
    solved: int
    spent: EnvSteps
    seconds: Seconds = NO_SECONDS
    fragment: str = ""  # name of its fragment; empty: that of the unit


@dataclass(frozen=True)
class UnitOutcome:
    """How one attempt at a unit ended."""

    unit: WorkUnit
    summary: Summary | None = None  # None: it failed
    reason: str = ""  # traceback of the failure, for the quarantine file
    fatal: str = ""  # a sentence that stops the run, if no further attempt can succeed
    kind: type[LevelproofError] = Failure  # of the error that stops the run

    @property
    def cause(self) -> str:
        """The last line of the reason, without the note that JAX adds."""
        lines = self.reason.split(JAX_NOTE)[0].strip().splitlines()
        return lines[-1] if lines else self.fatal

    def on(self, host: str) -> "UnitOutcome":
        """Name the worker's machine in the sentence that stops the run, unless it does."""
        return self if not self.fatal or f"on {host}" in self.fatal else replace(self, fatal=f"On {host}: {self.fatal}")


Settle = Callable[[Sequence[UnitOutcome]], None]  # accounts for attempts that ended together


class Cut(NamedTuple):
    """A unit from which a worker has given levels back."""

    unit: WorkUnit  # the unit before the cut
    kept: WorkUnit | None  # continues on the worker
    back: WorkUnit | None  # returns to the scheduler


@dataclass(frozen=True)
class Round:
    """A worker's report on one round."""

    outcomes: list[UnitOutcome]  # of the units that ended
    totals: dict[WorkUnit, Totals]  # of running units, so far
    wants: int  # further levels for which it has room
    spare: int = 0  # unstarted levels
    cuts: list[Cut] = field(default_factory=list)  # units from which it has given levels back
    leaves: bool = False  # the worker ends now; it has committed what it could
    unsaved: str = ""  # why unfinished experts could not be saved lately


@dataclass(frozen=True)
class Order:
    """The driver's instructions for a worker's next round."""

    units: list[WorkUnit]  # units to begin
    give: int = 0  # unstarted levels to give back


@dataclass
class Assignment:
    """The units of one worker, and what it last reported."""

    units: dict[WorkUnit, None] = field(default_factory=dict)  # in the order in which the worker got them
    wants: int = 1  # further levels for which it has room
    spare: int = 0  # unstarted levels
    asked: int = 0  # levels to give back
    heard: float = 0.0  # s, time of the last order or report
    slowness: float | None = None  # the worker's time per level, divided by other workers'; None: it has ended no unit


class Scheduler:
    """Decides which worker gets which units. The executor reports joins, rounds and losses, and passes the time.

    A worker gets units while it has room for their levels; all others wait here. Towards the end, units are cut to a
    worker's share of what is left, and idle workers get levels that others have not begun. A level's result does not
    depend on its unit, so this changes no result.

    If units are timed, they are cut from stretches of levels, by the time that the latest units took.

    Memory and time grow with the numbers of workers and of failed units, not with the number of waiting units.
    """

    def __init__(self, units: Iterable[WorkUnit], levels: int, unit: int = 1, timed: bool = False) -> None:
        """Schedule units.

        Args:
            units: ascending.
            levels: number of levels in all units.
            unit: number of levels in a whole unit; if `timed`, of a unit before the first one has ended.
            timed: `units` are stretches, from which units are cut by the time that levels take.
        """
        self._fresh = iter(units)
        self._next = next(self._fresh, None)
        self._returned: list[deque[WorkUnit]] = [deque() for _ in MAX_UNITS]  # by failed attempts; at 0: parts of units
        self.waiting, self._unit = levels, unit  # levels
        self._size = UnitSize(levels, unit) if timed else None  # None: units keep their size
        self.attempts: dict[WorkUnit, int] = {}  # failed attempts
        self.quarantined: list[WorkUnit] = []
        self.workers: dict[Any, Assignment] = {}  # by the executor's handles
        self._idle: set[Any] = set()  # workers without units

    @property
    def over(self) -> bool:
        """Whether no unit is running or waiting."""
        return not self.waiting and len(self._idle) == len(self.workers)

    @property
    def first(self) -> int | None:
        """Lowest level id among units whose first attempt has not ended; None: all have."""
        running = (unit for mine in self.workers.values() for unit in mine.units if unit not in self.attempts)
        units = chain(running, self._returned[0], [self._next] if self._next else [])
        return min((unit.level_ids[0] for unit in units), default=None)

    def join(self, worker: Any, now: float) -> None:
        """Add a worker, which has no units yet."""
        self.workers[worker] = Assignment(heard=now)
        self._idle.add(worker)

    def order(self, worker: Any, now: float) -> Order:
        """Assign units to a worker that has reported; return its order."""
        mine, new = self.workers[worker], []
        mine.heard = now
        while unit := self._take(mine):
            mine.units[unit] = None
            mine.wants -= len(unit.level_ids)
            self._idle.discard(worker)
            new.append(unit)
        return Order(new, mine.asked)

    def report(self, worker: Any, round: Round, now: float) -> None:
        """Account for a worker's round. The executor passes failed outcomes to `failed` itself."""
        mine = self.workers[worker]
        for unit, kept, back in round.cuts:
            del mine.units[unit]
            mine.units |= {kept: None} if kept else {}
            self.attempts |= {part: self.attempts[unit] for part in (kept, back) if part and unit in self.attempts}
            self._put_back(back)
        for outcome in round.outcomes:
            del mine.units[outcome.unit]
            if self._size and outcome.summary:
                summary = outcome.summary
                mine.slowness = self._size.note(summary.levels, summary.seconds.working, mine.slowness)
        mine.wants, mine.spare, mine.asked, mine.heard = round.wants, round.spare, 0, now
        if not mine.units:
            self._idle.add(worker)

    def leave(self, worker: Any) -> None:
        """Remove a worker that left in order; its units wait again."""
        for unit in self._remove(worker):
            self._put_back(unit)

    def lost(self, worker: Any, reason: str) -> list[UnitOutcome]:
        """Remove a worker that died; return its units as failed outcomes."""
        return [UnitOutcome(unit, reason=reason) for unit in self._remove(worker)]

    def failed(self, unit: WorkUnit) -> bool:
        """Count a failed attempt; return whether the unit is now quarantined. If not, it waits for another attempt.

        The unit stays whole, so that an attempt finds the levels that an earlier one committed. Only for the last
        attempt it is split into parts no larger than untimed units, so that a level that always fails takes few others
        into quarantine.
        """
        self.attempts[unit] = attempts = self.attempts.get(unit, 0) + 1
        if attempts == len(MAX_UNITS):
            self.quarantined.append(unit)
            return True
        rest, last = unit, attempts == len(MAX_UNITS) - 1
        while rest:
            part, rest = rest.split(self._unit) if self._size and last else (rest, None)
            self.attempts[part] = attempts
            self._put_back(part)
        return False

    def share(self) -> None:
        """If workers are idle, ask others to return half of their unstarted levels."""
        if self.waiting or not self._idle:
            return
        never_failed = lambda other: self.attempts.keys().isdisjoint(other.units)
        part = self._size.now(len(self.workers), 1.0) // TIMED_PARTS if self._size else 1
        minimum = lambda other: max(MIN_SHARE, 2 * part / (other.slowness or 1.0))
        able = (other for other in self.workers.values() if other.spare >= minimum(other) and never_failed(other))
        for other in nlargest(len(self._idle), able, key=lambda other: other.spare):
            other.asked = -(-other.spare // 2)

    def silent(self, since: float) -> list[Any]:
        """Return the workers that have units but have neither reported nor got an order since then."""
        return [worker for worker, mine in self.workers.items() if mine.units and mine.heard < since]

    def _take(self, mine: Assignment) -> WorkUnit | None:
        """Return the next unit for a worker.

        None if the worker wants none, if it has units while other workers are idle, or if no waiting unit may run
        beside its units.
        """
        if mine.units and (mine.wants <= 0 or self._idle):
            return None
        failures = {self.attempts.get(unit, 0) for unit in mine.units}  # at most one number
        if failures and len(mine.units) >= MAX_UNITS[max(failures)]:
            return None
        for attempts in failures or range(len(MAX_UNITS)):
            if self._returned[attempts]:
                return self._part(self._returned[attempts].popleft(), mine.slowness)
            if not attempts and self._next:
                unit, self._next = self._next, next(self._fresh, None)
                return self._part(unit, mine.slowness)
        return None

    def _part(self, unit: WorkUnit, slowness: float | None) -> WorkUnit:
        """Return the unit or its first part: at most this worker's unit size and its share of all waiting levels.

        Units that have failed stay whole.
        """
        count = len(unit.level_ids)
        self.waiting -= count
        if unit in self.attempts:
            return unit
        whole = self._size.now(len(self.workers), slowness) if self._size else self._unit
        size, least = (min(count, whole), whole // TIMED_PARTS) if self._size else (count, whole // PARTS)
        shares = len(self.workers) * (slowness or 1.0)
        while size // 2 >= max(1, least) and size * shares > self.waiting + count:
            size = -(-size // 2)
        part, rest = unit.split(size)
        if rest:
            self._returned[0].appendleft(rest)
            self.waiting += count - size
        return part

    def _put_back(self, unit: WorkUnit | None) -> None:
        if unit:
            self._returned[self.attempts.get(unit, 0)].append(unit)
            self.waiting += len(unit.level_ids)

    def _remove(self, worker: Any) -> list[WorkUnit]:
        self._idle.discard(worker)
        return list(self.workers.pop(worker).units)


def until_report(order: Order, workers: int) -> float:
    """Return the seconds after which one of `workers` workers reports even if none of its units has ended."""
    return ROUND if order.give else max(ROUND, workers / REPORTS)


def schedule(
    wanted: Sequence[int] | np.ndarray,
    done: Collection[int] | np.ndarray,
    levels: int,
    unit: int,
    timed: bool,
    origins: Mapping[int, Origin] | None = None,
) -> Scheduler:
    """Return a scheduler of those `wanted` levels, `levels` in number, that are not done.

    `Scheduler` documents `unit` and `timed`.
    """
    return Scheduler(plan_units(wanted, done, STRETCH if timed else unit, origins), levels, unit, timed)


def levels_text(units: Iterable[WorkUnit]) -> str:
    """Describe the levels of units for messages: `levels 0 to 31, 96 to 127`."""
    return runs_text(runs([level_id for unit in units for level_id in unit.level_ids]))
