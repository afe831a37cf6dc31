"""Experts that train without end and without evaluations: what the benchmarks of training time."""

import numpy as np

from levelproof.experts.config import ExpertConfig, Rule, StopConfig
from levelproof.experts.pool.queue import GROUP, empty_queue, enter
from levelproof.experts.training.advance import advance
from levelproof.experts.training.slots import LevelQueue, Report, Slots
from levelproof.experts.training.stop import rules_of
from levelproof.experts.witness.success import no_success
from levelproof.levelgen.batching import take
from levelproof.levelgen.level import Level
from levelproof.levelgen.task.rules import DEFAULT_RULES, TaskParams

UPDATES = 10**6  # more than a benchmark waits for


def endless_queue(levels: Level, config: ExpertConfig) -> LevelQueue:
    """All of these levels, with as many places."""
    queue = empty_queue(levels, levels.role.shape[-1], config)
    for first in range(0, queue.capacity, GROUP):
        some = np.arange(first, min(first + GROUP, queue.capacity))
        queue = enter(queue, some.tolist(), take(levels, some), some, no_success(len(some)), config, UPDATES)
    return queue


def go_on(
    slots: Slots, queue: LevelQueue, config: ExpertConfig, rules: TaskParams = DEFAULT_RULES
) -> tuple[Slots, Report]:
    """An update in every slot (`slots` are used up)."""
    return advance(slots, queue, config, rules_of(StopConfig(rule=Rule.BUDGET), config), rules)
