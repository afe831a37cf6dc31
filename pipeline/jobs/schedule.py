"""What is left to do: work units, their attempts and their quarantine; and who gets which, in `Scheduler`.

Knows nothing of files, of Ray, or of the time.
"""

from collections import deque
from collections.abc import Callable, Collection, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from heapq import nlargest
from itertools import chain, groupby
from typing import Any, NamedTuple

import numpy as np

from levelproof.experts.steps import NO_SECONDS, EnvSteps, Seconds
from levelproof.pipeline.jobs.sizing import UnitSize
from levelproof.pipeline.store.layout import unit_name
from levelproof.pipeline.store.origins import Origin
from levelproof.pipeline.store.runs import ascending, runs, told_levels, without

# How many units a worker may have at once, those included that failed as often: a unit that kills its worker takes
# fewer with it each time, and none that has not failed. One more failure, and a unit is quarantined.
COMPANY = (64, 8, 1)
ROUND = 1.0  # s that a worker trains between reports; a step that is compiled takes longer
REPORTS = 100.0  # a second that the driver takes: of more workers each reports less often
STRETCH = 2**13  # levels that are planned together, of which units are cut once their size is known
PARTS = 8  # of a unit, below which it is not cut where there are too few for all workers
TIMED_PARTS = 4  # the same where times decide its size: every worker comes for parts, so each is to take 10 s
JAX_NOTE = "\n--------------------\n"  # begins what JAX adds to an error about tracebacks
LEAST_SHARE = 2  # levels that a worker has not begun, below which it is not asked to share them


@dataclass(frozen=True)
class WorkUnit:
    """Levels done together and committed together: ids of one multiple of the job's `unit`, or as many from files."""

    level_ids: tuple[int, ...] | range  # ascending
    origins: tuple[Origin, ...] = field(default=(), compare=False, repr=False)  # of each; empty: ids make them

    @property
    def name(self) -> str:
        return unit_name(self.level_ids[0], self.level_ids[-1])

    def only(self, level_ids: Collection[int]) -> "WorkUnit | None":
        """Its levels that are among these; None: there are none."""
        at = [i for i, level_id in enumerate(self.level_ids) if level_id in level_ids]
        ids, origins = tuple(self.level_ids[i] for i in at), tuple(self.origins[i] for i in at if self.origins)
        return WorkUnit(ids, origins) if ids else None

    def split(self, count: int) -> "tuple[WorkUnit, WorkUnit | None]":
        """Its first `count` levels, and the others, if there are any. Of a range both are ranges."""
        first, rest = (WorkUnit(self.level_ids[of], self.origins[of]) for of in (slice(count), slice(count, None)))
        return first, rest if rest.level_ids else None


def plan_units(
    wanted: Sequence[int] | np.ndarray,
    done: Collection[int] | np.ndarray,
    unit: int,
    origins: Mapping[int, Origin] | None = None,
) -> Iterator[WorkUnit]:
    """Units that cover what is wanted and not done, ascending; made as they are asked for.

    A unit never crosses an absolute multiple of `unit`, so jobs that start elsewhere cut at the same ids. Ids of levels
    with origins lie far apart: of those a unit has as many as it may.
    """
    there = ascending(np.fromiter(done, np.int64, len(done)))
    if origins is None:
        return _by_multiple(without(runs(wanted), there), unit)
    left = np.setdiff1d(np.asarray(wanted, np.int64), there)
    parts = (left[i : i + unit].tolist() for i in range(0, len(left), unit))
    return (WorkUnit(tuple(part), tuple(origins[i] for i in part)) for part in parts)


def _by_multiple(runs: Iterable[tuple[int, int]], unit: int) -> Iterator[WorkUnit]:
    """Units of these runs of ids. Ids that follow one another are a range, however many they are."""
    pieces = (
        range(max(first, number * unit), min(last, number * unit + unit - 1) + 1)
        for first, last in runs
        for number in range(first // unit, last // unit + 1)
    )
    for _, of in groupby(pieces, lambda piece: piece[0] // unit):
        some = list(of)
        yield WorkUnit(tuple(chain(*some)) if some[1:] else some[0])


@dataclass(frozen=True)
class Summary:
    """What travels back from a committed unit."""

    levels: int
    solved: int
    spent: EnvSteps
    seconds: Seconds = NO_SECONDS


@dataclass(frozen=True)
class UnitOutcome:
    """How one attempt at a unit ended."""

    unit: WorkUnit
    summary: Summary | None = None  # None: it failed
    reason: str = ""  # of the failure, for the quarantine file
    fatal: str = ""  # a sentence, where no further attempt can succeed

    @property
    def cause(self) -> str:
        """The last line of the reason that is about the failure; JAX adds some about itself."""
        lines = self.reason.split(JAX_NOTE)[0].strip().splitlines()
        return lines[-1] if lines else self.fatal


Settle = Callable[[Sequence[UnitOutcome]], None]  # takes note of attempts that ended together


class Cut(NamedTuple):
    """A unit of which a worker has given levels back."""

    unit: WorkUnit  # as it was
    kept: WorkUnit | None  # what the worker goes on with
    back: WorkUnit | None  # what is to be done by others


@dataclass(frozen=True)
class Round:
    """What a worker reports of some time at work."""

    outcomes: list[UnitOutcome]  # of the units that ended
    totals: dict[WorkUnit, tuple[int, float, int]]  # of the others: env steps, levels, solved levels so far
    wants: int  # levels more for which it has room
    spare: int = 0  # levels that it has not begun
    cuts: list[Cut] = field(default_factory=list)  # what it has given back
    leaves: bool = False  # it goes, with all that it could keep committed


@dataclass(frozen=True)
class Order:
    """What a worker is told."""

    units: list[WorkUnit]  # to begin with
    give: int = 0  # levels to give back, of those that it has not begun


@dataclass
class Assignment:
    """What one worker has."""

    units: dict[WorkUnit, None] = field(default_factory=dict)  # in the order in which it got them
    wants: int = 1  # levels more for which it has room
    spare: int = 0  # levels that it has not begun, as it last said
    asked: int = 0  # levels to give back
    heard: float = 0.0  # s, when it was last told something, or reported
    slowness: float | None = None  # how many times as long as on others its levels take; None: it has ended no unit


class Scheduler:
    """Which worker gets which units. It is told who joins, what each reports, who is lost, and the time.

    A worker has units while it has room for their levels, so what waits on the driver is not what waits on workers.
    Towards the end units are cut to a worker's share of what is left, and who has nothing gets what others have not
    begun. A level's result does not depend on its unit, so neither changes any.

    Where it is to find the size of units, it cuts them from stretches of levels, by what the latest ones have taken.

    Its memory and time depend on how many workers there are and how many units have failed, not on how many wait.
    """

    def __init__(self, units: Iterable[WorkUnit], levels: int, unit: int = 1, timed: bool = False) -> None:
        """Of units, ascending, that have so many levels together; whole ones have `unit`.

        If `timed`, they are stretches, and `unit` is the size of a unit while nobody knows what a level takes.
        """
        self._fresh = iter(units)
        self._next = next(self._fresh, None)
        self._again: list[deque[WorkUnit]] = [deque() for _ in COMPANY]  # by failed attempts; first: parts of units
        self.waiting, self._unit = levels, unit  # levels
        self._size = UnitSize(levels, unit) if timed else None  # None: units have the size that they came with
        self.attempts: dict[WorkUnit, int] = {}  # that failed
        self.quarantined: list[WorkUnit] = []
        self.workers: dict[Any, Assignment] = {}  # by whatever tells them apart
        self._idle: set[Any] = set()  # workers without units

    @property
    def over(self) -> bool:
        """Whether nobody has or will get anything."""
        return not self.waiting and len(self._idle) == len(self.workers)

    @property
    def first(self) -> int | None:
        """The lowest level id of the units that are yet to end for the first time; None: there is none."""
        under_way = (unit for of in self.workers.values() for unit in of.units if unit not in self.attempts)
        units = chain(under_way, self._again[0], [self._next] if self._next else [])
        return min((unit.level_ids[0] for unit in units), default=None)

    def join(self, worker: Any, now: float) -> None:
        """A worker is there, and has nothing."""
        self.workers[worker] = Assignment(heard=now)
        self._idle.add(worker)

    def order(self, worker: Any, now: float) -> Order:
        """What to tell a worker that has nothing more to report."""
        mine, new = self.workers[worker], []
        mine.heard = now
        while unit := self._take(mine):
            mine.units[unit] = None
            mine.wants -= len(unit.level_ids)
            self._idle.discard(worker)
            new.append(unit)
        return Order(new, mine.asked)

    def report(self, worker: Any, round: Round, now: float) -> None:
        """What a worker has done of what it has. Its failures are told to `failed` by whom they concern, too."""
        mine = self.workers[worker]
        for unit, kept, back in round.cuts:
            del mine.units[unit]
            mine.units |= {kept: None} if kept else {}
            self.attempts |= {part: self.attempts[unit] for part in (kept, back) if part and unit in self.attempts}
            self._put_back(back)
        for outcome in round.outcomes:
            del mine.units[outcome.unit]
            if self._size and outcome.summary:
                of = outcome.summary
                mine.slowness = self._size.note(of.levels, of.seconds.working, mine.slowness)
        mine.wants, mine.spare, mine.asked, mine.heard = round.wants, round.spare, 0, now
        if not mine.units:
            self._idle.add(worker)

    def leave(self, worker: Any) -> None:
        """A worker goes that could say so; others do what it still has."""
        for unit in self._remove(worker):
            self._put_back(unit)

    def lost(self, worker: Any, reason: str) -> list[UnitOutcome]:
        """A worker died, and its units failed."""
        return [UnitOutcome(unit, reason=reason) for unit in self._remove(worker)]

    def failed(self, unit: WorkUnit) -> bool:
        """Note a failed attempt; the unit waits again, or True when it is now quarantined.

        It waits whole, so that an attempt finds what an earlier one has committed. But the last attempt is at parts no
        larger than untimed units: one level that always fails takes few others into quarantine.
        """
        self.attempts[unit] = attempts = self.attempts.get(unit, 0) + 1
        if attempts == len(COMPANY):
            self.quarantined.append(unit)
            return True
        rest, last = unit, attempts == len(COMPANY) - 1
        while rest:
            part, rest = rest.split(self._unit) if self._size and last else (rest, None)
            self.attempts[part] = attempts
            self._put_back(part)
        return False

    def share(self) -> None:
        """Have workers asked to give levels back, half of what each has not begun, where others have nothing."""
        if self.waiting or not self._idle:
            return
        untried = lambda of: self.attempts.keys().isdisjoint(of.units)
        part = self._size.now(len(self.workers), 1.0) // TIMED_PARTS if self._size else 1
        least = lambda of: max(LEAST_SHARE, 2 * part / (of.slowness or 1.0))
        can = (of for of in self.workers.values() if of.spare >= least(of) and untried(of))
        for of in nlargest(len(self._idle), can, key=lambda of: of.spare):
            of.asked = -(-of.spare // 2)

    def silent(self, since: float) -> list[Any]:
        """Workers that have units and have not been heard of since then."""
        return [worker for worker, of in self.workers.items() if of.units and of.heard < since]

    def _take(self, mine: Assignment) -> WorkUnit | None:
        """The next unit for a worker; None when it wants none, others have none, or none may join what it has."""
        if mine.units and (mine.wants <= 0 or self._idle):
            return None
        failures = {self.attempts.get(unit, 0) for unit in mine.units}  # one number at most
        if failures and len(mine.units) >= COMPANY[max(failures)]:
            return None
        for attempts in failures or range(len(COMPANY)):
            if self._again[attempts]:
                return self._part(self._again[attempts].popleft(), mine.slowness)
            if not attempts and self._next:
                unit, self._next = self._next, next(self._fresh, None)
                return self._part(unit, mine.slowness)
        return None

    def _part(self, unit: WorkUnit, slowness: float | None) -> WorkUnit:
        """The unit, or its beginning: at most the levels of a unit of this worker now, and its share of all that waits.

        What has failed stays whole.
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
            self._again[0].appendleft(rest)
            self.waiting += count - size
        return part

    def _put_back(self, unit: WorkUnit | None) -> None:
        if unit:
            self._again[self.attempts.get(unit, 0)].append(unit)
            self.waiting += len(unit.level_ids)

    def _remove(self, worker: Any) -> list[WorkUnit]:
        self._idle.discard(worker)
        return list(self.workers.pop(worker).units)


def until_report(order: Order, workers: int) -> float:
    """s after which a worker with this order reports, one of so many, if none of its units ends before."""
    return ROUND if order.give else max(ROUND, workers / REPORTS)


def schedule(
    wanted: Sequence[int] | np.ndarray,
    done: Collection[int] | np.ndarray,
    levels: int,
    unit: int,
    timed: bool,
    origins: Mapping[int, Origin] | None = None,
) -> Scheduler:
    """A scheduler of what is wanted and not done, so many levels; `unit` and `timed` are those of `Scheduler`."""
    return Scheduler(plan_units(wanted, done, STRETCH if timed else unit, origins), levels, unit, timed)


def levels_text(units: Iterable[WorkUnit]) -> str:
    """Their levels, for people: `levels 0 to 31, 96 to 127`."""
    return told_levels(runs([level_id for unit in units for level_id in unit.level_ids]))
