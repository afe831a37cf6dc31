"""Labelling without a worker: one unit in a call, or many units side by side."""

from collections.abc import Callable, Iterable, Iterator, Mapping
from typing import TypeVar

import numpy as np

from levelproof.experts.labels import Label
from levelproof.experts.pool.pool import NOTHING_BEGUN, Pool
from levelproof.experts.pool.run import TrainingRun, UnitResult
from levelproof.experts.procedure import Procedure
from levelproof.experts.verdict.judge import KeptExpert
from levelproof.levelgen.level import Level
from levelproof.levelgen.task.rules import DEFAULT_RULES, TaskParams

Report = Callable[[int, float, int], None]  # totals so far: env steps, levels (fractions count), solved levels
Name = TypeVar("Name")


def label(
    levels: Level,
    level_ids: np.ndarray,
    budget: int,
    procedure: Procedure,
    rules: TaskParams = DEFAULT_RULES,
    report: Report = lambda *_: None,
    begun: Mapping[int, KeptExpert] = NOTHING_BEGUN,
) -> UnitResult:
    """Label levels with `budget` env steps for each expert; `report` is called after each pool step.

    Raises:
        ValueError: experts cannot use this budget.
    """
    pool = Pool(budget, procedure, rules)
    run = TrainingRun(pool, levels, level_ids, begun)
    while not pool.step():
        run.submit_searched()
        report(*run.totals())
    result = run.finish()
    solved = sum(verdict.label is Label.SOLVED for verdict in result.verdicts)
    report(result.spent.shown, len(result.verdicts), solved)
    return result


def side_by_side(
    pool: Pool,
    units: Iterable[tuple[Name, Level, np.ndarray]],
    report: Callable[[Mapping[Name, TrainingRun]], None] = lambda _: None,
) -> Iterator[tuple[Name, UnitResult]]:
    """Label units, adding one whenever the pool wants levels; yield each result when it is ready.

    Args:
        pool: where their experts train.
        units: name, levels and their ids of each unit.
        report: called after each step with the runs in progress.
    """
    runs: dict[Name, TrainingRun] = {}
    waiting = iter(units)
    while True:
        while pool.wants(sum(run.searching for run in runs.values())):
            unit = next(waiting, None)
            if unit is None:
                break
            name, levels, level_ids = unit
            runs[name] = TrainingRun(pool, levels, level_ids)
        if not runs:
            return
        finished = pool.step()
        for run in runs.values():
            run.submit_searched()
        report(runs)
        for name in [name for name, run in runs.items() if run.submission in finished]:
            yield name, runs.pop(name).finish()
