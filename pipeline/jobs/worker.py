"""A worker's loop: it begins the units it is given, trains them side by side in one pool, and commits what finishes.

The same in this process and in a Ray worker. Knows nothing of either.
"""

import time
from collections.abc import Sequence
from pathlib import Path

from configs.schema import JobConfig
from experts.train import TrainingRun
from pipeline.jobs.schedule import Round, UnitOutcome, WorkUnit
from pipeline.jobs.unit import begin_unit, failure, finish_unit, pool_for


class Worker:
    """Units under way in this process."""

    def __init__(self, job: JobConfig, split: Path) -> None:
        self._job, self._split = job, split
        self._pool = pool_for(job)
        self._runs: dict[WorkUnit, TrainingRun] = {}

    def work(self, units: Sequence[WorkUnit], seconds: float) -> Round:
        """Begin those of these units that are not under way, then train for so many seconds, or until one ends.

        A failure of one unit is that unit's outcome. One of the step that all share is the outcome of each.
        """
        until = time.monotonic() + seconds
        outcomes = [outcome for unit in units if unit not in self._runs and (outcome := self._begin(unit))]
        while self._runs and not outcomes and time.monotonic() < until:
            outcomes = self._step()
        now = {unit: run.totals() for unit, run in self._runs.items()}
        plain = {unit: (run.env_steps, run.levels, run.solved) for unit, run in now.items()}  # read without JAX
        wants = max(0, self._pool.wants - sum(run.searching for run in self._runs.values()))
        return Round(outcomes, plain, wants)

    def _begin(self, unit: WorkUnit) -> UnitOutcome | None:
        try:
            self._runs[unit] = begin_unit(self._job, unit, self._pool)
        except Exception as error:
            return failure(self._split, unit, error)
        return None

    def _step(self) -> list[UnitOutcome]:
        """A step of every search and a rollout of every expert; the outcomes of the units that it finished."""
        try:
            for run in self._runs.values():
                run.look()
            finished = self._pool.step()
        except Exception as error:
            units = list(self._runs)
            self._runs, self._pool = {}, pool_for(self._job)
            return [failure(self._split, unit, error) for unit in units]
        ended = [unit for unit, run in self._runs.items() if run.submission in finished]
        return [self._finish(unit) for unit in ended]

    def _finish(self, unit: WorkUnit) -> UnitOutcome:
        run = self._runs.pop(unit)
        try:
            return UnitOutcome(unit, finish_unit(self._job, self._split, unit, run))
        except Exception as error:
            return failure(self._split, unit, error)
