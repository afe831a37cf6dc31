"""Levels labelled without a worker: what it does with a unit, in one call, or with one unit after another."""

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

Tell = Callable[[int, float, int], None]  # totals so far: env steps, levels (parts count), solved levels
Name = TypeVar("Name")


def label(
    levels: Level,
    level_ids: np.ndarray,
    budget: int,
    procedure: Procedure,
    rules: TaskParams = DEFAULT_RULES,
    tell: Tell = lambda *_: None,
    begun: Mapping[int, KeptExpert] = NOTHING_BEGUN,
) -> UnitResult:
    """Label levels; `budget` are env steps that each expert may use, `tell` is called after each rollout.

    Raises:
        ValueError: the budget is none that experts can use.
    """
    pool = Pool(budget, procedure, rules)
    run = TrainingRun(pool, levels, level_ids, begun)
    while not pool.step():
        run.submit_searched()
        tell(*run.totals())
    result = run.finish()
    solved = sum(verdict.label is Label.SOLVED for verdict in result.verdicts)
    tell(result.spent.shown, len(result.verdicts), solved)
    return result


def side_by_side(
    pool: Pool,
    units: Iterable[tuple[Name, Level, np.ndarray]],
    tell: Callable[[Mapping[Name, TrainingRun]], None] = lambda _: None,
) -> Iterator[tuple[Name, UnitResult]]:
    """Label units, each when the pool wants levels; what came of each, as it is done.

    Args:
        pool: where their experts train.
        units: of each a name, its levels and their ids.
        tell: called after each step with all that is under way.
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
        tell(runs)
        for name in [name for name, run in runs.items() if run.submission in finished]:
            yield name, runs.pop(name).finish()
