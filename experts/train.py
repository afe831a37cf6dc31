"""Training: levels go through the slots, then witnesses are chosen and verdicts given.

Levels that need no expert (`experts.before`) get none, and use nothing of their budget.
"""

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from typing import NamedTuple

import jax
import numpy as np
from jaxtyping import Int

from experts.before import Before, decide
from experts.config import RECORD_STEPS, ExpertConfig, StopConfig, check_budget
from experts.judge import Kept, judge
from experts.labels import WITNESSED, Label, Verdict
from experts.pool import NOTHING_BEGUN, Pool, Spent, Submission, Totals
from experts.witness import Record, replay, take
from levelgen.identity.keys import level_id_array
from levelgen.level import ACTIONS, Level
from levelgen.task.rules import DEFAULT_RULES, TaskParams

DEFAULT_STOP = StopConfig()
Tell = Callable[[int, float, int], None]  # totals so far: env steps, levels (parts count), solved levels


def quiet(env_steps: int, levels: float, solved: int) -> None:
    """Tells nobody."""


@dataclass(frozen=True)
class UnitResult:
    """What came of some levels, on the host, in the order they were given."""

    level_ids: Int[np.ndarray, " level"]
    levels: Level
    record: Record  # all zero where the level has no witness
    verdicts: list[Verdict]
    spent: Spent
    experts: dict[int, Kept] = field(default_factory=dict)  # by level id, where they are kept


class TrainingRun(NamedTuple):
    """Levels of which each has its verdict or is in a pool."""

    level_ids: np.ndarray
    levels: Level
    before: Before
    left: np.ndarray  # indices of the levels that need an expert
    submission: Submission  # of those


def train_levels(
    levels: Level,
    level_ids: np.ndarray,
    budget: int,
    config: ExpertConfig,
    stopping: StopConfig = DEFAULT_STOP,
    rules: TaskParams = DEFAULT_RULES,
    tell: Tell = quiet,
    begun: Mapping[int, Kept] = NOTHING_BEGUN,
    keep: bool = False,
) -> UnitResult:
    """Label the levels; train an expert for each that needs one, in a pool of their own.

    Args:
        levels: the levels, as their ids rebuild them.
        level_ids: their ids; the seeds of all randomness.
        budget: env steps that each expert may use.
        config: what an expert is.
        stopping: when a level leaves its slot.
        rules: of the task; records hold its rewards, training shapes with the configuration's.
        tell: called after each rollout with env steps, levels and solved levels so far.
        begun: as for `begin`.
        keep: as for `begin`.

    Raises:
        ValueError: as `check_budget`.
    """
    pool = new_pool(budget, config, stopping, rules)
    run = begin(pool, levels, level_ids, begun, keep)
    while not pool.step():
        tell(*totals(pool, run))
    result = finish(pool, run)
    solved = sum(verdict.label is Label.SOLVED for verdict in result.verdicts)
    tell(result.spent.trained, len(result.verdicts), solved)
    return result


def begin(
    pool: Pool,
    levels: Level,
    level_ids: np.ndarray,
    begun: Mapping[int, Kept] = NOTHING_BEGUN,
    keep: bool = False,
) -> TrainingRun:
    """Submit to the pool those levels that need an expert.

    Args:
        pool: where experts train, perhaps beside those of other runs.
        levels: the levels, as their ids rebuild them.
        level_ids: their ids; the seeds of all randomness.
        begun: by level id, experts that go on with what they have left of the budget; the others begin.
        keep: whether the result has the experts.
    """
    level_ids = level_id_array(level_ids)
    levels = jax.tree.map(np.asarray, levels)
    before = decide(levels, pool.rules)
    left = np.array([i for i, verdict in enumerate(before.verdicts) if verdict is None], int)
    mine = {index: begun[level_id] for index, level_id in enumerate(level_ids[left].tolist()) if level_id in begun}
    return TrainingRun(level_ids, levels, before, left, pool.submit(take(levels, left), level_ids[left], mine, keep))


def totals(pool: Pool, run: TrainingRun) -> Totals:
    """How far all levels of a run are, those that need no expert included."""
    now = pool.totals(run.submission)
    return now._replace(levels=len(run.level_ids) - len(run.left) + now.levels)


def finish(pool: Pool, run: TrainingRun) -> UnitResult:
    """Choose witnesses and give verdicts, once the run's submission has finished."""
    level_ids, levels, (before, failed), left, submission = run
    trained = submission.trained()
    actions = np.zeros((RECORD_STEPS, ACTIONS, len(level_ids)), np.int32)  # doing nothing, where none are found
    for i, of in zip(left, trained, strict=True):
        if of.witness is not None:
            actions[..., i] = of.witness.action
    record = replay(levels, actions, pool.rules)
    judged = judge(trained, take(record, left), pool.updates, pool.config, failed[left])
    verdicts = {int(i): verdict for i, verdict in zip(left, judged, strict=True)}
    known = [verdict or verdicts[i] for i, verdict in enumerate(before)]
    witnessed = np.array([verdict.label in WITNESSED for verdict in known])
    record = jax.tree.map(lambda x: np.where(witnessed, x, np.zeros_like(x)), record)
    ended = zip(level_ids[left].tolist(), trained, strict=True)
    experts = {level_id: of.expert for level_id, of in ended if of.expert is not None}
    return UnitResult(level_ids, levels, record, known, submission.spent(pool.config), experts)


def new_pool(
    budget: int, config: ExpertConfig, stopping: StopConfig = DEFAULT_STOP, rules: TaskParams = DEFAULT_RULES
) -> Pool:
    """A pool for experts of one budget, env steps.

    Raises:
        ValueError: as `check_budget`.
    """
    check_budget(budget, config, stopping)
    return Pool(config.updates_in(budget), config, stopping, rules)
