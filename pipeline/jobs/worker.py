"""A worker's loop: begin the ordered units, train them side by side in one pool, commit each when it is finished.

The same code runs in this process and in a Ray worker, and knows nothing of either.
"""

import time
from collections.abc import Callable, Collection, Sequence
from pathlib import Path

from levelproof.configs.schema import GrowConfig, JobConfig
from levelproof.experts.ledger import Lap
from levelproof.experts.pool.run import TrainingRun
from levelproof.pipeline.errors import LevelproofError, last_line
from levelproof.pipeline.jobs.grower import Grower
from levelproof.pipeline.jobs.schedule import Cut, Order, Round, UnitOutcome, WorkUnit
from levelproof.pipeline.jobs.unit import begin_unit, failure, finish_unit, pool_for
from levelproof.pipeline.store.paused import save_paused


class Worker:
    """The units that this process trains."""

    def __init__(self, job: JobConfig, split: Path) -> None:
        self._job, self._split = job, split
        self.pool = pool_for(job)
        self._runs: dict[WorkUnit, TrainingRun] = {}
        self._keep_at = time.monotonic() + job.checkpoint_seconds
        self._unsaved = ""  # why the last save failed
        self.compiling = 0.0  # s of compiling before any unit came, charged to the first one
        self.stopping = False  # set by the executor to make the worker leave after the current step

    def work(self, order: Order, seconds: float, ended: Callable[[], bool] = lambda: False) -> Round:
        """Give levels back and begin units as ordered, then train for `seconds`.

        Training stops early when a unit ends, when `ended` returns True, or when the worker is `stopping`. If a unit
        fails, only its own outcome says so; if the step that all units share fails, every outcome does.
        """
        until = time.monotonic() + seconds
        cuts = self._give(order.give)
        outcomes = [outcome for unit in order.units if (outcome := self._begin(unit))]
        while self._runs and not (outcomes or self.stopping or ended()) and time.monotonic() < until:
            outcomes = self._step()
        if self._job.checkpoint and time.monotonic() >= self._keep_at:
            self._keep()
        if self.stopping:
            return self.leave(outcomes, cuts)
        now = {unit: run.totals() for unit, run in self._runs.items()}
        wants = self.pool.wants(sum(run.searching for run in self._runs.values()))
        spare = sum(len(run.unbegun) for run in self._runs.values())
        return Round(outcomes, now, wants, spare, cuts, unsaved=self._unsaved)

    def leave(self, outcomes: Sequence[UnitOutcome] = (), cuts: Sequence[Cut] = ()) -> Round:
        """Commit the decided levels of all running units, and cut off the undecided ones."""
        if self._job.checkpoint:
            self._keep()
        last = [self._cut(unit, run.undecided) for unit, run in list(self._runs.items())]
        ended = [self._finish(unit) for unit in list(self._runs)]
        return Round([*outcomes, *ended], {}, 0, cuts=[*cuts, *last], leaves=True, unsaved=self._unsaved)

    def _keep(self) -> None:
        """Save unfinished experts beside the split, so that whichever worker gets their levels next resumes them.

        A save that fails is reported, and retried at the next interval.
        """
        self._keep_at, self._unsaved = time.monotonic() + self._job.checkpoint_seconds, ""
        in_slots = list(self.pool.paused())
        for unit, run in self._runs.items():
            if paused := run.paused(in_slots):
                try:
                    save_paused(self._split, unit.name, paused, self._job)
                except (OSError, LevelproofError) as error:
                    self._unsaved = last_line(error)

    def _give(self, levels: int) -> list[Cut]:
        """Give back up to `levels` levels that have not begun, from the latest units first."""
        cuts = []
        for unit, run in reversed(self._runs.items()):
            some = run.unbegun[-levels:] if levels > 0 else []
            levels -= len(some)
            cuts += [(unit, some)] if some else []
        return [self._cut(unit, some) for unit, some in cuts]

    def _cut(self, unit: WorkUnit, level_ids: Collection[int]) -> Cut:
        """Drop these levels from a unit and continue with the others."""
        run = self._runs.pop(unit)
        run.leave_out(level_ids)
        kept, back = unit.only(set(unit.level_ids).difference(level_ids)), unit.only(level_ids)
        if kept:
            self._runs[kept] = run
        return Cut(unit, kept, back)

    def _begin(self, unit: WorkUnit) -> UnitOutcome | None:
        try:
            self._runs[unit] = run = begin_unit(self._job, self._split, unit, self.pool)
            run.ledger.add("sampling", Lap(compiling=self.compiling))
            self.compiling = 0.0
        except Exception as error:
            return failure(self._split, unit, error)
        return None

    def _step(self) -> list[UnitOutcome]:
        """Advance the pool by one step; return the outcomes of the units that finished."""
        try:
            finished = self.pool.step()
            for run in self._runs.values():
                run.submit_searched()
        except Exception as error:
            units = list(self._runs)
            self._runs, self.pool = {}, pool_for(self._job)
            return [failure(self._split, unit, error) for unit in units]
        ended = [unit for unit, run in self._runs.items() if run.submission in finished]
        return [self._finish(unit) for unit in ended]

    def _finish(self, unit: WorkUnit) -> UnitOutcome:
        run = self._runs.pop(unit)
        try:
            return UnitOutcome(unit, finish_unit(self._job, self._split, unit, run))
        except Exception as error:
            return failure(self._split, unit, error)


def worker_for(job: JobConfig, split: Path) -> Worker | Grower:
    """Return this process's worker for a job, so that executors need not know the kind of job."""
    return Grower(job, split) if isinstance(job, GrowConfig) else Worker(job, split)
