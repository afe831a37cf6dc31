"""Levels labelled in a pool of their own: what a worker does with a unit, in one call."""

from collections.abc import Callable, Mapping

import numpy as np

from experts.judge import Kept
from experts.labels import Label
from experts.pool import NOTHING_BEGUN, Pool
from experts.procedure import Procedure
from experts.train import TrainingRun, UnitResult
from levelgen.level import Level
from levelgen.task.rules import DEFAULT_RULES, TaskParams

Tell = Callable[[int, float, int], None]  # totals so far: env steps, levels (parts count), solved levels


def label(
    levels: Level,
    level_ids: np.ndarray,
    budget: int,
    procedure: Procedure,
    rules: TaskParams = DEFAULT_RULES,
    tell: Tell = lambda *_: None,
    begun: Mapping[int, Kept] = NOTHING_BEGUN,
) -> UnitResult:
    """Label levels; `budget` are env steps that each expert may use, `tell` is called after each rollout.

    Raises:
        ValueError: the budget is none that experts can use.
    """
    pool = Pool(budget, procedure, rules)
    run = TrainingRun(pool, levels, level_ids, begun)
    while not pool.step():
        run.look()
        tell(*run.totals())
    result = run.finish()
    solved = sum(verdict.label is Label.SOLVED for verdict in result.verdicts)
    tell(result.spent.shown, len(result.verdicts), solved)
    return result
