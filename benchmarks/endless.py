"""Experts that train without end and without evaluations: what the benchmarks of training time."""

import numpy as np

from experts.advance import advance
from experts.config import ExpertConfig, Rule, StopConfig
from experts.queue import empty_queue, enter
from experts.slots import LevelQueue, Report, Slots
from experts.stop import rules_of
from experts.success import no_success
from levelgen.level import Level
from levelgen.task.rules import DEFAULT_RULES, TaskParams

UPDATES = 10**6  # more than a benchmark waits for


def endless_queue(levels: Level, config: ExpertConfig) -> LevelQueue:
    """All of these levels, with as many places."""
    count = levels.role.shape[-1]
    return enter(empty_queue(levels, count, UPDATES, config), levels, np.arange(count), no_success(count), config)


def go_on(
    slots: Slots, queue: LevelQueue, config: ExpertConfig, rules: TaskParams = DEFAULT_RULES
) -> tuple[Slots, Report]:
    """An update in every slot (`slots` are used up)."""
    return advance(slots, queue, config, rules_of(StopConfig(rule=Rule.BUDGET), config), rules)
