"""Experts that train without end or evaluations, for the benchmarks that time training."""

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

UPDATES = 10**6  # more than any benchmark runs


def endless_queue(levels: Level, config: ExpertConfig) -> LevelQueue:
    """Return a queue filled to capacity with exactly these levels."""
    queue = empty_queue(levels, levels.role.shape[-1], config)
    for first in range(0, queue.capacity, GROUP):
        positions = np.arange(first, min(first + GROUP, queue.capacity))
        queue = enter(
            queue, positions.tolist(), take(levels, positions), positions, no_success(len(positions)), config, UPDATES
        )
    return queue


def update_slots(
    slots: Slots, queue: LevelQueue, config: ExpertConfig, rules: TaskParams = DEFAULT_RULES
) -> tuple[Slots, Report]:
    """Advance every slot by an update; donates `slots`."""
    return advance(slots, queue, config, rules_of(StopConfig(rule=Rule.BUDGET), config), rules)
