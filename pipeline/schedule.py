"""What is left to do: work units, their attempts and their quarantine. Knows nothing of workers or files."""

from collections import deque
from collections.abc import Collection, Iterable
from dataclasses import dataclass, field

from pipeline.layout import unit_name

ATTEMPTS = 3  # at a unit before it is quarantined


@dataclass(frozen=True)
class WorkUnit:
    """Level ids of one multiple of the job's `unit`, done together and committed together."""

    level_ids: tuple[int, ...]  # ascending

    @property
    def name(self) -> str:
        return unit_name(self.level_ids[0], self.level_ids[-1])

    @property
    def text(self) -> str:
        """For people: `16 to 31`."""
        return f"{self.level_ids[0]} to {self.level_ids[-1]}"


def plan_units(wanted: Iterable[int], done: Collection[int], unit: int) -> list[WorkUnit]:
    """Units that cover what is wanted and not done.

    A unit never crosses an absolute multiple of `unit`, so jobs that start elsewhere cut at the same places.
    """
    left: dict[int, list[int]] = {}
    for level_id in wanted:
        if level_id not in done:
            left.setdefault(level_id // unit, []).append(level_id)
    return [WorkUnit(tuple(level_ids)) for level_ids in left.values()]


@dataclass(frozen=True)
class Summary:
    """What travels back from a committed unit."""

    levels: int
    solved: int
    env_steps: int  # of training
    evaluated: int  # env steps of evaluations
    idle: int  # env steps in slots without a level


@dataclass(frozen=True)
class Outcome:
    """How one attempt at a unit ended."""

    unit: WorkUnit
    summary: Summary | None = None  # None: it failed
    reason: str = ""  # of the failure, for the quarantine file
    fatal: str = ""  # a sentence, where no further attempt can succeed


@dataclass
class Queue:
    """Units waiting, each with the attempts it has had."""

    waiting: deque[WorkUnit]
    attempts: dict[WorkUnit, int] = field(default_factory=dict)
    quarantined: list[WorkUnit] = field(default_factory=list)

    @classmethod
    def of(cls, units: Iterable[WorkUnit]) -> "Queue":
        return cls(deque(units))

    def take(self, alone: bool) -> WorkUnit | None:
        """The next unit to work on; None when no more wait.

        A unit that has failed goes only to a worker that has no other (`alone`): it must not take others with it.
        Such units wait behind all that have not failed.
        """
        if not self.waiting or (self.waiting[0] in self.attempts and not alone):
            return None
        return self.waiting.popleft()

    def failed(self, unit: WorkUnit) -> bool:
        """Note a failed attempt; the unit waits again, or True when it is now quarantined."""
        self.attempts[unit] = self.attempts.get(unit, 0) + 1
        if self.attempts[unit] < ATTEMPTS:
            self.waiting.append(unit)
            return False
        self.quarantined.append(unit)
        return True
