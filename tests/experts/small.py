"""One small expert for all tests that train, because every other configuration compiles another program."""

from dataclasses import replace

import numpy as np

from levelproof.experts.config import ExpertConfig, Rule, StopConfig
from levelproof.experts.procedure import Procedure
from levelproof.experts.search.config import SearchConfig
from levelproof.levelgen.task.rules import DEFAULT_RULES

IDS = np.array([0, 2, 3, 4, 6, 7, 9])  # levels of size s that need an expert
CONFIG = ExpertConfig(
    environments=16, horizon=32, width=16, attempts=4, sticky_attempts=4, perturbed_attempts=4, slots=2, rehearsals=2
)
SHAPED = replace(DEFAULT_RULES, dense_reward_scale=CONFIG.dense_reward_scale)  # as a pool has them
WHOLE = StopConfig(rule=Rule.BUDGET)


def untouched(stopping: StopConfig, config: ExpertConfig = CONFIG) -> Procedure:
    """Return a procedure without a search."""
    return Procedure(SearchConfig(env_steps=0), config, stopping)
