"""Experts that train without end or evaluations, for the benchmarks that time training."""

import jax
import numpy as np

from levelproof.experts.config import ExpertConfig, Rule, StopConfig
from levelproof.experts.pool.pool import GROUP
from levelproof.experts.training.advance import advance
from levelproof.experts.training.slots import Pending, Report, Slots, begin, slots_of
from levelproof.experts.training.stop import rules_of
from levelproof.experts.witness.success import no_success
from levelproof.levelgen.batching import take
from levelproof.levelgen.level import Level
from levelproof.levelgen.task.rules import DEFAULT_RULES, TaskParams

UPDATES = 10**6  # more than any benchmark runs


def endless_slots(levels: Level, level_ids: np.ndarray, config: ExpertConfig, updates: int = UPDATES) -> Slots:
    """Return slots with new experts of these levels, which train for this many updates."""
    no, room = np.zeros(len(levels), bool), max(GROUP, len(levels))
    padded = np.minimum(np.arange(room), len(levels) - 1)  # to the pool's program and its bits, if they are few
    group = begin(take(levels, padded), level_ids[padded], no_success(room), config)
    experts = jax.tree.map(lambda x: x[: len(levels)], group)
    return slots_of(levels, level_ids, experts, Pending(no, no, np.full(len(levels), updates, np.int32)), config)


def update_slots(slots: Slots, config: ExpertConfig, rules: TaskParams = DEFAULT_RULES) -> tuple[Slots, Report]:
    """Advance every slot by an update; donates `slots`."""
    return advance(slots, config, rules_of(StopConfig(rule=Rule.BUDGET), config), rules)
